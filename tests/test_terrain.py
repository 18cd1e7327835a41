"""Stairs: the boxes by hand, under the footholds, and out of the way of the swinging feet. Boxes anywhere."""

import math
from collections.abc import Callable
from typing import Any

import jax
import mujoco
import numpy as np
import pytest
from walks import parse

from bipedtrack import robot as robots
from bipedtrack import tasks, terrain
from bipedtrack.robot import Robot
from bipedtrack.terrain import STAIR_BOX, Stairs, stair_boxes, stair_edges

LENGTH, _, HEIGHT = STAIR_BOX


def stairs(rise: float, tread: float, height: float = 0.0) -> Stairs:
    return Stairs(*(np.asarray(v) for v in (rise, tread, height)))


def treads(boxes: np.ndarray) -> np.ndarray:
    """Rows (from x, to x, top) of the boxes that are there, by their tops."""
    found = [(x - LENGTH / 2, x + LENGTH / 2, z + HEIGHT / 2) for x, _, z in boxes if z > -5]
    return np.array(sorted(found, key=lambda tread: tread[2]))


def test_boxes_of_stairs_up_worked_by_hand() -> None:
    # treads of 0.3 m: tread i begins at 0.3 (i - 1/2) and reaches 1.2 m forward, under the next ones
    up = stairs(0.15, 0.3)
    second, third, fourth = (0.45, 1.65, 0.3), (0.75, 1.95, 0.45), (1.05, 2.25, 0.6)
    assert treads(stair_boxes(up, np.asarray(3))) == pytest.approx(np.array([second, third, fourth]))
    # tread 0 and what lies behind it is the ground
    first = (0.15, 1.35, 0.15)
    assert treads(stair_boxes(up, np.asarray(0))) == pytest.approx(np.array([first]))
    assert treads(stair_boxes(up, np.asarray(1))) == pytest.approx(np.array([first, second]))


def test_boxes_of_stairs_down_worked_by_hand() -> None:
    # tread i ends at 0.25 (i + 1/2) and reaches 1.2 m backward, under the ones before it
    down = stairs(-0.1, 0.25, height=3.0)
    first, second, third = (-0.825, 0.375, 2.9), (-0.575, 0.625, 2.8), (-0.325, 0.875, 2.7)
    assert treads(stair_boxes(down, np.asarray(2))) == pytest.approx(np.array([third, second, first]))
    # the uppermost tread is a box, with nothing before it
    assert treads(stair_boxes(down, np.asarray(0))) == pytest.approx(np.array([first, (-1.075, 0.125, 3.0)]))


def test_level_ground_needs_no_box() -> None:
    boxes = stair_boxes(stairs(0.0, 0.3), np.asarray(4))
    assert (boxes[:, 2] + HEIGHT / 2 < -5).all()
    assert len(set(boxes[:, 2])) == 3  # parked apart, so that they do not lie in one another


@pytest.mark.parametrize("rise", [0.17, -0.17])
def test_one_step_on_moves_one_box(rise: float) -> None:
    given_stairs = stairs(rise, 0.3, 5.1 if rise < 0 else 0.0)
    for level in range(2, 12):
        before, after = (stair_boxes(given_stairs, np.asarray(i)) for i in (level, level + 1))
        moved = (before != after).any(axis=1)
        assert moved.sum() == 1
        # the tread before the one that the rear foot stands on becomes the one after the next
        assert (after - before)[moved][0] == pytest.approx([3 * 0.3, 0, 3 * rise])


def test_upright_boxes_have_no_turn() -> None:
    centres = np.array([[1.0, 2, 3], [4, 5, 6]])
    assert terrain.upright(centres) == pytest.approx(np.array([[1.0, 2, 3, 1, 0, 0, 0], [4, 5, 6, 1, 0, 0, 0]]))


def test_jax_gives_numpys_boxes() -> None:
    for rise in (0.1, -0.1, 0.0):
        given_stairs = jax.tree.map(np.float32, stairs(rise, 0.3, 2.0))
        for level in (0, 5):
            found = jax.jit(stair_boxes)(given_stairs, level)
            assert np.asarray(found) == pytest.approx(stair_boxes(given_stairs, np.asarray(level)), abs=1e-6)


@pytest.fixture(scope="module")
def window() -> Callable[[Any], np.ndarray]:
    """Centres (episode, task step, 3, 3) of the boxes of drawn episodes, m."""
    batched = jax.jit(jax.vmap(jax.vmap(lambda task, i: tasks.stair_window(None, task, i), (None, 0)), (0, None)))

    def run(drawn: Any) -> np.ndarray:
        poses = np.asarray(batched(drawn.task, np.arange(drawn.step.period.shape[1])))
        assert (poses[..., 3:] == [1, 0, 0, 0]).all()
        return poses[..., :3].astype(np.float64)

    return run


def ground(x: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """The height of the floor or of the highest box at x (...,), boxes (..., 3, 3)."""
    under = np.abs(x[..., None] - boxes[..., 0]) <= LENGTH / 2
    return np.where(under, boxes[..., 2] + HEIGHT / 2, 0.0).max(axis=-1, initial=0.0)


@pytest.mark.parametrize("hold_after", [None, (0, 5)])
@pytest.mark.parametrize("difficulty", [0.0, 1.0])
def test_every_sole_starts_and_lands_flat_on_a_tread(
    episodes: Callable, window: Callable, robot: Robot, difficulty: float, hold_after: tuple | None
) -> None:
    drawn = episodes("stairs", difficulty, hold_after)
    boxes = window(drawn)[:, :, None, None]
    for nodes in (drawn.step.start, drawn.step.end):
        ankles = nodes.ankle_positions
        assert np.abs(ankles[..., 1]).max() + robot.sole[1] / 2 < STAIR_BOX[1] / 2
        corners = ankles[..., 0, None] + robot.sole[0] / 2 * np.array([-1, 0, 1])
        soles = ankles[..., 2, None] - robot.ankle_height
        assert ground(corners, boxes) == pytest.approx(np.broadcast_to(soles, corners.shape), abs=2e-5)


@pytest.mark.parametrize("hold_after", [None, (0, 5)])
def test_no_box_moves_while_a_sole_stands_over_it(
    episodes: Callable, window: Callable, robot: Robot, hold_after: tuple | None
) -> None:
    drawn = episodes("stairs", 1.0, hold_after)
    boxes = window(drawn)
    before, after = boxes[:, :-1], boxes[:, 1:]
    moved = np.abs(after - before).max(axis=-1) > 1e-6
    assert 0.05 < moved.mean() <= 1 / 3
    ankles = drawn.step.end.ankle_positions[:, :-1]  # where both feet stand at that instant
    soles = ankles[..., 2] - robot.ankle_height
    for place in (before, after):
        # a box that a sole would rest on or stand in, 1 cm of the sole's edge counted in
        beside = np.abs(ankles[:, :, :, None, 0] - place[:, :, None, :, 0]) - LENGTH / 2 - robot.sole[0] / 2 > 0.01
        below = place[:, :, None, :, 2] + HEIGHT / 2 < soles[..., None] - 0.01
        assert (beside | below)[np.broadcast_to(moved[:, :, None], below.shape)].all()


def clearances(robot: Robot, drawn: Any, boxes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least distances (episode, task step), m, of the swing foot's contact spheres from any box and from any tread's edge.

    A negative distance from a box is a depth; a foot at rest touches its tread, but stands off the edges.
    """
    radius = 0.01
    points = drawn.step.ankle_points.astype(np.float64)
    swing = drawn.step.swing.argmax(axis=-1)[..., None, None, None]
    points = np.take_along_axis(points, swing, axis=2)[:, :, 0][..., [0, 2]]
    order = points.shape[2] - 1
    s = np.linspace(0, 1, 201)
    bernstein = np.stack([math.comb(order, i) * s**i * (1 - s) ** (order - i) for i in range(order + 1)], axis=-1)
    ankle = np.einsum("ti,ekid->ektd", bernstein, points)
    side = np.where(drawn.task.stairs.rise > 0, -1, 1)[:, None, None]
    from_boxes, from_edges = np.full(points.shape[:2], np.inf), np.full(points.shape[:2], np.inf)
    for end in (-1, 1):  # heel and toe
        sphere = ankle + [end * robot.sole[0] / 2, radius - robot.ankle_height]
        for i in range(boxes.shape[2]):
            offset = sphere - boxes[:, :, None, i, [0, 2]]
            outside = np.abs(offset) - [LENGTH / 2, HEIGHT / 2]
            distance = np.linalg.norm(np.maximum(outside, 0), axis=-1) + np.minimum(outside.max(axis=-1), 0)
            from_boxes = np.minimum(from_boxes, distance.min(axis=-1) - radius)
            to_edge = np.hypot(offset[..., 0] - side * LENGTH / 2, offset[..., 1] - HEIGHT / 2)
            from_edges = np.minimum(from_edges, to_edge.min(axis=-1) - radius)
    return from_boxes, from_edges


@pytest.mark.parametrize("hold_after", [None, (0, 5)])
@pytest.mark.parametrize(("difficulty", "least"), [(0.0, 0.045), (0.5, 0.017), (1.0, 0.005)])
def test_swinging_soles_clear_the_edges_of_the_stairs(
    episodes: Callable, window: Callable, robot: Robot, difficulty: float, least: float, hold_after: tuple | None
) -> None:
    drawn = episodes("stairs", difficulty, hold_after)
    assert (drawn.step.trigonometric == 0).all()  # those curves would pass through the tread between two others
    from_boxes, from_edges = clearances(robot, drawn, window(drawn))
    assert from_boxes.min() > -1e-5
    assert from_edges.min() > least


@pytest.mark.parametrize("rise", [0.1, -0.1])
def test_edges_that_a_foot_passes_worked_by_hand(rise: float) -> None:
    start, end = np.array([0.6, 0.1, 2.04]), np.array([1.2, 0.1, 2.04 + 2 * rise])
    found = stair_edges(stairs(rise, 0.3, 2.0), start, end)
    tops = [2.14, 2.24] if rise > 0 else [2.04, 1.94]
    assert found == pytest.approx(np.array([[0.75, tops[0]], [1.05, tops[1]]]))


# Boxes anywhere


def test_boxes_stand_in_the_simulator_where_the_script_says() -> None:
    script = parse("# box 0.6 0.1 0.3 0.5 0.4 0.3 0.2\nleft")
    box = script.boxes[0]
    model = robots.build_model("ranger_max", boxes=[box.size for box in script.boxes])
    data = mujoco.MjData(model)
    data.mocap_pos[0], data.mocap_quat[0] = box.position, box.orientation
    mujoco.mj_kinematics(model, data)
    geom = model.geom("box_0").id
    local = model.geom_size[geom] * [[1, 1, -1], [-1, 1, -1], [-1, -1, 1]]
    corners = data.geom_xpos[geom] + local @ data.geom_xmat[geom].reshape(3, 3).T
    np.testing.assert_allclose(corners[:, :2], box.corners[:3], atol=1e-12)
    np.testing.assert_allclose(corners[:, 2], [0.3, 0.3, 0.5], atol=1e-12)
    # length along its own x, which points 0.5 rad to the left
    along = (corners[0] - corners[1])[:2]
    np.testing.assert_allclose(along, [0.4 * math.cos(0.5), 0.4 * math.sin(0.5)], atol=1e-12)


def test_rectangles_at_an_angle_are_apart_where_only_an_edge_of_one_tells() -> None:
    square = terrain.Box(0, 0, 0, 0, 1, 1, 1).corners
    diamond = terrain.Box(0.9, 0.9, 0, math.pi / 4, 1, 1, 1).corners
    apart = 0.9 * math.sqrt(2) - math.sqrt(0.5) - 0.5
    assert terrain.overlap(square, diamond) == pytest.approx(-apart)
    assert terrain.overlap(diamond, square) == pytest.approx(-apart)
    assert terrain.overlap(square, terrain.Box(0.9, 0, 0, 0.0, 1, 1, 1).corners) == pytest.approx(0.1)
