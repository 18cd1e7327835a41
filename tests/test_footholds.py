"""Places for a foot, worked by hand."""

import math

import numpy as np
import pytest

from bipedtrack import footholds, footsteps, sampling, tasks
from bipedtrack import robot as robots
from bipedtrack.footholds import Foothold
from bipedtrack.footsteps import Box

TREADS = (Box(0.45, 0, 0, 0, 0.3, 1.2, 0.1), Box(0.75, 0, 0, 0, 0.3, 1.2, 0.2))  # edges at 0.30, 0.60 and 0.90 m


def test_steps_are_those_of_training(robot: robots.Robot) -> None:
    """The same advance gives the same foothold as the task steps that a policy learns from."""
    start = footsteps.initial_nodes(robot)
    for foot in range(2):
        for ahead, turn in ((0.2, 0.0), (-0.1, 0.25), (0.0, -0.35)):
            motion = tasks.Motion(sampling.WALK, np.array([ahead, 0.0, turn]), foot, 0.55, 0.08, 0.75, 0.0)
            places, yaws = tasks._foothold(motion, 0.0, False, foot, motion.advance, start)
            mine = footholds.moved_on(start, foot, np.array([ahead, 0.0, turn]))
            assert np.allclose(mine[1:], [*places[foot][:2], yaws[foot]], atol=1e-6)


@pytest.mark.parametrize(
    ("boxes", "home", "wanted", "x"),
    [
        ((), 0.0, 0.25, 0.25),
        (TREADS, 0.0, 0.15, 0.15),  # the sole ends 5 cm before the edge
        (TREADS, 0.0, 0.25, 0.15),  # too far to the tread's middle: half a tread before the edge
        (TREADS, 0.15, 0.30, 0.45),  # across the edge: the middle of the tread
        (TREADS, 0.45, 0.48, 0.48),  # still on the tread
        (TREADS, 0.45, 0.60, 0.75),
        ((Box(0.3, 0, 0, 0, 0.04, 1, 0.06),), 0.13, 0.3, 0.32 + 0.15),  # a bar is stepped over
        ((Box(0.6, 0, 0, 0, 0.6, 1, 0.4),), 0.1, 0.3, 0.15),  # a wall is not
    ],
)
def test_footholds_before_on_and_over_boxes(
    robot: robots.Robot, boxes: tuple[Box, ...], home: float, wanted: float, x: float
) -> None:
    found = footholds.on_ground(robot, boxes, Foothold(0, home, 0.1, 0.0), Foothold(0, wanted, 0.1, 0.0))
    assert found.x == pytest.approx(x, abs=0.011)
    assert found[2:] == (pytest.approx(0.1), 0.0)


def test_the_nearest_possible_point_of_a_disc() -> None:
    wanted = np.array([3.0, 4.0])
    found = footholds.nearest(lambda p: bool(np.hypot(*p) <= 1), wanted, np.array([-0.5, 0.0]))
    assert found is not None
    assert np.hypot(*found) <= 1
    assert math.dist(found, wanted) < 4.0 + 0.003
    assert footholds.nearest(lambda p: False, wanted, np.zeros(2)) is None
