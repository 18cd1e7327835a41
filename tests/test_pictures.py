"""What is in the pictures of a trace made by hand, and which footholds it has."""

from typing import Any

import numpy as np
import pytest
from filmed import SIZE, Rendered, differences, green, moved, walk, yellow

from bipedtrack import pictures
from bipedtrack import robot as robots
from bipedtrack.nodes import Nodes
from bipedtrack.trace import Trace


def without_traces(recorded: Trace) -> Trace:
    """The same with all nodes far below the ground."""
    return recorded._replace(target=moved(recorded.target, (0, 0, -50)), measured=moved(recorded.measured, (0, 0, -50)))


def render(recorded: Trace, ticks: list[int], sizes: list[tuple[float, float, float]], boxes: Any) -> np.ndarray:
    model = robots.build_model("ranger_max", sizes)
    before = model.vis.quality.shadowsize, model.vis.global_.offwidth
    found = np.array(list(pictures.render(model, robots.load(), recorded, np.array(ticks), boxes, SIZE)))
    assert (model.vis.quality.shadowsize, model.vis.global_.offwidth) == before
    return found


def test_targets_are_green_and_measured_nodes_yellow(rendered: Rendered) -> None:
    recorded = walk()
    apart = recorded._replace(measured=moved(recorded.measured, (0, 0, 0.25)))
    (plain,) = rendered(render, without_traces(recorded), [199], [], None)
    start, both = rendered(render, apart, [0, 199], [], None)
    for color in (green, yellow):
        assert color(both).sum() > 20
        assert not color(plain).any() and not color(start).any()  # at the start nothing is behind the robot yet
    rows = [np.nonzero(color(both))[0].mean() for color in (yellow, green)]
    assert rows[0] < rows[1] - 8  # counted downwards


def test_traces_last_two_seconds() -> None:
    n = 1000
    line = Nodes(np.arange(3 * n).reshape(n, 3), np.zeros((n, 4)), np.arange(6 * n).reshape(n, 2, 3), np.zeros((n, 2)))
    early, late, next_one = (pictures._tail(line, tick, 0.005) for tick in (30, 777, 778))
    np.testing.assert_array_equal(early[:, 0], [[0, 1, 2], [0, 1, 2], [3, 4, 5]])
    np.testing.assert_array_equal(early[:, -1], [[90, 91, 92], [180, 181, 182], [183, 184, 185]])
    assert 377 <= late[0, 0, 0] / 3 < 377 + 7
    # what lies behind stays, while the end moves on
    assert set(late[0, :-1, 0]) < set(next_one[0, :, 0])


def test_the_robot_is_in_the_middle_wherever_it_goes(rendered: Rendered) -> None:
    recorded = without_traces(walk())
    (here,) = rendered(render, recorded, [100], [], None)
    (there,) = rendered(render, recorded._replace(qpos=recorded.qpos + [7, -3, *17 * [0]]), [100], [], None)
    assert here.shape == (180, 240, 3) and here.dtype == np.uint8
    for picture in (here, there):
        rows, columns = np.nonzero(picture.max(axis=-1) < 75)  # its dark shells; shadows are lighter
        assert len(rows) > 200
        assert abs(columns.mean() - 120) < 15 and abs(rows.mean() - 90) < 25
    # the chequered floor repeats itself, and the shadow comes along
    assert (differences(here, there) > 40).sum() < 50


def test_footholds_are_printed_from_before_the_swing(rendered: Rendered) -> None:
    recorded = walk()  # its right foot begins to swing after 0.4 s
    (with_prints,) = rendered(render, recorded, [0], [], None)
    (without,) = rendered(render, recorded._replace(timer=np.zeros((200, 2))), [0], [], None)
    changed = with_prints[differences(with_prints, without) > 60].astype(int)
    blue, orange = changed[:, 2] > changed[:, 0] + 60, changed[:, 0] > changed[:, 2] + 60
    assert blue.sum() > 15 and orange.sum() > 15


def test_a_print_needs_ground(rendered: Rendered) -> None:
    """On a tread that is not there, a print would hang in the air."""
    high = walk()._replace(target=moved(walk().target, (0, 0, 0.2)))
    tread, pose = [(2.0, 2.0, 0.2)], np.array([[0.0, 0, 0.1, 1, 0, 0, 0]])
    parked = pose - [0, 0, 10, 0, 0, 0, 0]
    no_timer = high._replace(timer=np.zeros((200, 2)))
    for boxes, wanted in ((pose, True), (parked, False)):
        with_prints, without = (rendered(render, each, [0], tread, boxes)[0] for each in (high, no_timer))
        assert (differences(with_prints, without).max() > 60) == wanted


def test_boxes_stand_where_they_are_put_and_may_move(rendered: Rendered) -> None:
    recorded = without_traces(walk())
    poses = np.tile([0.5, 0.5, 0.2, 1.0, 0, 0, 0], (200, 1, 1))
    poses[100:, 0, 2] = -10
    sizes = [(0.4, 0.4, 0.4)]
    there, gone = rendered(render, recorded, [99, 100], sizes, poses)
    (stays,) = rendered(render, recorded, [100], sizes, poses[0])
    (empty,) = rendered(render, recorded, [100], [], None)
    assert differences(gone, empty).max() < 5
    assert (differences(stays, empty) > 30).sum() > 500
    assert differences(there, stays).mean() < 2


def test_boxes_and_traces_of_other_shapes_are_refused(rendered: Rendered) -> None:
    with pytest.raises(ValueError, match=r"boxes have shape \(3, 7\); wanted \(1, 7\) or \(200, 1, 7\)"):
        rendered(render, walk(), [0], [(1, 1, 1)], np.zeros((3, 7)))
    with pytest.raises(ValueError, match=r"shape \(2, 200, 19\); wanted \(200, 19\)"):
        rendered(render, walk()._replace(qpos=np.zeros((2, 200, 19))), [0], [], None)


def test_the_camera_follows_smoothly() -> None:
    path = np.outer(np.arange(1000), [0.01, 0, 0])
    smooth = pictures._smoothed(path, 200)
    assert smooth.shape == path.shape
    np.testing.assert_allclose(smooth[100:900], path[100:900] - [0.005, 0, 0], atol=1e-9)
    np.testing.assert_allclose(pictures._smoothed(np.ones((7, 3)), 200), 1)


def test_each_swing_ends_on_its_foothold(robot: robots.Robot) -> None:
    left, right = pictures.footholds(walk(), robot.ankle_height)
    assert (left.foot, left.begin, right.foot, right.begin) == (0, 0, 1, pytest.approx(0.4))
    assert (left.touchdown, right.touchdown) == (pytest.approx(0.4), pytest.approx(0.8))
    np.testing.assert_allclose(left.position, [0.15, 0.1, 0], atol=1e-12)
    np.testing.assert_allclose(right.position, [0.30, -0.1, 0], atol=1e-12)
    assert (left.yaw, right.yaw) == (pytest.approx(0.3), 0)


def test_a_foot_that_swings_twice_in_a_row_has_two_footholds_and_an_unfinished_swing_none(robot: robots.Robot) -> None:
    recorded = walk()
    timer = np.zeros((200, 2))
    timer[20:60, 1] = np.arange(40, 0, -1) * 0.005
    timer[60:100, 1] = np.arange(40, 0, -1) * 0.005
    timer[150:, 0] = np.arange(60, 10, -1) * 0.005
    found = pictures.footholds(recorded._replace(timer=timer), robot.ankle_height)
    assert [(f.foot, round(f.begin / 0.005), round(f.touchdown / 0.005)) for f in found] == [(1, 20, 60), (1, 60, 100)]
