"""The rule of falls against MuJoCo's rotations and distances worked by hand, in numpy and in JAX."""

import math
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bipedtrack import falls
from bipedtrack.nodes import Nodes


def turned(axis: Any, degrees: float, yaw: float = 0.0) -> np.ndarray:
    """A trunk turned by `yaw`, deg, then tilted."""
    tilt, about_z, product = np.zeros(4), np.zeros(4), np.zeros(4)
    mujoco.mju_axisAngle2Quat(tilt, np.array(axis) / np.linalg.norm(axis), math.radians(degrees))
    mujoco.mju_axisAngle2Quat(about_z, [0.0, 0, 1], math.radians(yaw))
    mujoco.mju_mulQuat(product, tilt, about_z)
    return product


def fell(trunk: Any = (0, 0, 0), ankles: Any = 0.0, turn: Any = (1.0, 0, 0, 0), at: Any = (3.0, -2.0, 0.7)) -> bool:
    """Whether a robot with a trunk turned so has fallen when these are target minus measured; numpy and JAX agree."""
    feet = np.array([[3.0, -1.9, 0.04], [3.1, -2.1, 0.04]])
    measured = Nodes(np.array(at), np.array(turn), feet, np.zeros(2))
    target = Nodes(np.array([3.0, -2.0, 0.7]) + trunk, np.array([1.0, 0, 0, 0]), feet + ankles, np.zeros(2))
    in_jax = [Nodes(*(jnp.asarray(part, jnp.float32) for part in state)) for state in (target, measured)]
    (found,) = {bool(falls.fell(target, measured)), bool(falls.fell(*in_jax))}
    return found


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (-1, 1, 0)])
def test_a_trunk_tilted_by_more_than_60_degrees_has_fallen(axis: Any) -> None:
    for yaw in (0, 100):
        assert not fell(turn=turned(axis, 59, yaw))
        assert fell(turn=turned(axis, 61, yaw))
        assert fell(turn=turned(axis, 180, yaw))


def test_a_trunk_far_below_its_target_or_a_lost_ankle_is_a_fall() -> None:
    for turn in ((1.0, 0, 0, 0), turned((0, 1, 0), 50)):
        assert not fell((0, 0, 0.34), turn=turn)
        assert fell((0, 0, 0.36), turn=turn)
        assert not fell((2.0, 1.0, -1.0), turn=turn)
    for foot in (0, 1):
        ankles = np.zeros((2, 3))
        ankles[foot] = 0.49 * np.array([0.6, 0, 0.8])
        assert not fell(ankles=ankles)
        ankles[foot] = 0.51 * np.array([0.6, 0, 0.8])
        assert fell(ankles=ankles)


def test_what_is_no_number_is_a_fall() -> None:
    assert fell(turn=(math.nan, 0, 0, math.nan), at=(0, 0, math.nan))
    assert fell(at=(3.0, -2.0, math.nan))


def test_a_state_is_finite_until_it_explodes() -> None:
    qpos, qvel = np.full((3, 19), 0.5), np.full((3, 18), -900.0)
    assert falls.finite(qpos, qvel).all()
    for worst in (math.nan, math.inf, -math.inf, 1100.0):
        spoiled = qvel.copy()
        spoiled[1, 7] = worst
        np.testing.assert_array_equal(falls.finite(qpos, spoiled), [True, False, True])
        spoiled = qpos.copy()
        spoiled[2, 0] = worst
        np.testing.assert_array_equal(falls.finite(spoiled, qvel), [True, True, False])


def test_many_robots_at_once_are_judged_one_by_one() -> None:
    feet, level = np.zeros((4, 2, 3)), np.tile([1.0, 0, 0, 0], (4, 1))
    measured = Nodes(np.zeros((4, 3)), level.copy(), feet, np.zeros((4, 2)))
    target = Nodes(np.zeros((4, 3)), level, feet.copy(), np.zeros((4, 2)))
    target.trunk_position[1, 2] = 0.4
    target.ankle_positions[2, 1, 0] = -0.6
    measured.trunk_orientation[3] = turned((0, 1, 0), 90)
    np.testing.assert_array_equal(falls.fell(target, measured), [False, True, True, True])
