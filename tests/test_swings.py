"""Touchdowns and clearances of hand-made traces whose contacts and edges are known."""

import math
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from traces import DT, WEIGHT, standing, summary, swing

from bipedtrack import footsteps, kinematics, swings
from bipedtrack.nodes import Nodes
from bipedtrack.robot import Robot
from bipedtrack.swings import Boxes
from bipedtrack.trace import Trace


def test_swings_are_those_that_end_before_a_fall() -> None:
    trace = standing(2, 100)
    swing(trace, 0, 20, foot=1)  # in the air from the first entry on
    swing(trace, 20, 50, foot=0)
    swing(trace, 50, 70, foot=0)  # the same foot again, without a stand in between
    swing(trace, 80, 100, foot=1)  # ends with the trace
    swing(trace, 10, 30, foot=1, episode=1)
    swing(trace, 30, 50, foot=0, episode=1)
    trace.alive[1, 50:] = False  # falls at the very touchdown
    found = np.array(swings.completed(trace)).T
    assert sorted(found.tolist()) == [[0, 0, 20, 50], [0, 0, 50, 70], [0, 1, 0, 20], [1, 1, 10, 30]]


def test_swings_of_a_script_end_on_its_footholds(robot: Robot) -> None:
    header = ",".join(footsteps.COLUMNS)
    rows = "left,0.2,0.1,,0,0.5\nright,0.4,-0.1,,0,0.6\nright,0.5,-0.1,,0.1,0.4\nboth,,,,,0.5\n"
    commands = list(footsteps.commands(footsteps.parse(f"{header}\n{rows}", robot, "walk.csv"), DT))
    trace = standing(n=len(commands))
    target = Nodes(*(np.array(part)[None] for part in zip(*(c.target for c in commands), strict=True)))
    trace = trace._replace(target=target, measured=target, timer=np.array([c.timer for c in commands])[None])
    found = swings.completed(trace)
    order = np.argsort(found.touchdown)
    assert found.foot[order].tolist() == [0, 1, 1]
    assert found.liftoff[order].tolist() == [0, 100, 220]
    assert found.touchdown[order].tolist() == [100, 220, 300]
    came = swings.touchdowns(trace, 20.0, robot)
    np.testing.assert_allclose(came["step_length_cm"][order], [20, 40, 10])
    np.testing.assert_allclose(came["foothold_cm"], 0, atol=1e-12)
    np.testing.assert_allclose(came["yaw_deg"], 0, atol=1e-12)


def test_a_foot_that_is_to_stay_in_the_air_touches_nothing_down(robot: Robot) -> None:
    header = ",".join(footsteps.COLUMNS)
    rows = "left up,0,0.1,0.1,,0.5\nleft up,0.1,0.1,0.15,,0.5\nleft,0.1,0.1,,,0.5\nright,0.3,-0.1,,,0.5\nboth,,,,,0.5\n"
    script = footsteps.parse(f"# box 0.3 -0.1 0 0.3 0.3 0.2 0.1\n{header}\n{rows}", robot, "kick.csv")
    commands = list(footsteps.commands(script, DT))
    trace = standing(n=len(commands))
    target = Nodes(*(np.array(part)[None] for part in zip(*(c.target for c in commands), strict=True)))
    trace = trace._replace(target=target, measured=target, timer=np.array([c.timer for c in commands])[None])
    boxes = Boxes(np.array([[[0.3, -0.1, 0.05]]]), np.array([[[0.15, 0.1, 0.05]]]), np.array([[0.3]]))
    assert len(swings.completed(trace).foot) == 4
    assert swings.landing(trace, robot, boxes).foot.tolist() == [0, 1]  # the right one on the box
    assert swings.landing(trace, robot, None).foot.tolist() == [0]
    above = boxes._replace(centres=boxes.centres + [0, 0, 0.2])  # a box overhead bears nothing
    assert swings.landing(trace, robot, above).foot.tolist() == [0]
    assert summary(trace, robot, boxes=boxes)["touchdown"]["planned"] == 2


LOADED, LIGHT = 25.0, 20.0  # N: more than 5 % of the weight, and just not more


# A swing is planned from entry 20 to 60; its middle is 40, and the search ends at 80. What follows: where the foot is
# loaded (all else is just light enough), and at which entry it has touched down; None: missed.
CONTACTS = {
    "on time": ([(0, 20), (60, 100)], 60),
    "early": ([(0, 20), (53, 100)], 53),
    "late": ([(0, 20), (67, 100)], 67),
    "as late as it may be": ([(0, 20), (80, 100)], 80),
    "too late": ([(0, 20), (81, 100)], None),
    "bouncing": ([(0, 20), (55, 57), (60, 62), (66, 100)], 55),
    "never": ([(0, 20)], None),
    "leaves late": ([(0, 45), (58, 100)], 58),
    "drags at first": ([(0, 20), (22, 30), (35, 39), (58, 100)], 58),
    "down since before the middle": ([(0, 20), (32, 100)], 40),
    "never up": ([(0, 100)], None),
    "up only after the planned touchdown": ([(0, 60), (65, 100)], None),
}


@pytest.mark.parametrize(("contacts", "known"), CONTACTS.values(), ids=CONTACTS)
@pytest.mark.parametrize("foot", [0, 1])
def test_touchdown_detector_on_scripted_contact(
    contacts: list[tuple[int, int]], known: int | None, foot: int, robot: Robot
) -> None:
    trace = standing(2, 100)
    swing(trace, 20, 60, foot, episode=1)
    trace.foot_forces[1, :, foot] = LIGHT
    for start, end in contacts:
        trace.foot_forces[1, start:end, foot] = LOADED
    found = summary(trace, robot)["touchdown"]
    assert (found["planned"], found["undecided"]) == (1, 0)
    assert found["missed_share"] == (known is None)
    late = None if known is None else pytest.approx((known - 60) * DT)
    assert found["time_s"]["mean"] == late


def test_the_threshold_of_contact_is_a_share_of_the_weight(robot: Robot) -> None:
    trace = standing()
    swing(trace, 20, 60)
    trace.foot_forces[0, 20:, 0] = np.arange(80)  # 20 N at entry 40, 40 N at 60
    assert summary(trace, robot)["touchdown"]["time_s"]["mean"] == pytest.approx(-19 * DT)
    assert summary(trace, robot, contact_share=0.11)["touchdown"]["time_s"]["mean"] == pytest.approx(5 * DT)


@pytest.mark.parametrize(("falls", "known"), [(False, (None, 1)), (True, (1.0, 0))])
def test_a_touchdown_cut_off_is_missed_only_if_the_robot_fell(falls: bool, known: tuple, robot: Robot) -> None:
    trace = standing(n=70)
    swing(trace, 20, 60)
    trace.foot_forces[0, 20:, 0] = 0
    if falls:
        trace.alive[0, 65:] = False
        trace.foot_forces[0, 65:, 0] = WEIGHT  # as it hits the ground
    found = summary(trace, robot)["touchdown"]
    assert (found["missed_share"], found["undecided"]) == known


def test_missed_share_counts_every_planned_touchdown(robot: Robot) -> None:
    trace = standing(2, 400)
    for start in (20, 100, 180, 260):
        swing(trace, start, start + 40, foot=0, episode=0)
        swing(trace, start, start + 40, foot=1, episode=1)
    trace.foot_forces[1, 220:260, 1] = 0  # the third one stays up
    found = summary(trace, robot)["touchdown"]
    assert (found["planned"], found["missed_share"]) == (8, 1 / 8)
    assert found["time_s"]["max"] == found["time_s"]["min"] == 0


def test_touchdown_errors_worked_by_hand(robot: Robot) -> None:
    trace = standing(2, 200)
    swing(trace, 20, 60, foot=1)
    trace.target.ankle_positions[0, 20:61, 1] = np.linspace([0, -0.1, 0.04], [0.3, 0.3, 0.14], 41)  # 0.5 m in the plane
    trace.target.ankle_positions[0, 61:, 1] = [0.3, 0.3, 0.14]
    trace.target.ankle_yaws[0, 60:, 1] = math.radians(179)
    trace.measured.ankle_positions[0, :59, 1] = 7.0  # what happens before does not matter
    trace.measured.ankle_positions[0, 60, 1] = [0.33, 0.26, 0.12]
    trace.measured.ankle_yaws[0, 60, 1] = math.radians(-177)
    swing(trace, 80, 120, foot=0, episode=1)  # steps on the spot, lands 1 cm off
    trace.measured.ankle_positions[1, 120, 0, 0] = 0.01
    block = Boxes(np.full((2, 1, 3), [0.3, 0.3, 0.05]), np.full((2, 1, 3), [0.1, 0.1, 0.05]), np.zeros((2, 1)))
    found = summary(trace, robot, boxes=block)["touchdown"]
    assert found["foothold_cm"] == pytest.approx(
        {"mean": 3, "rms": math.sqrt(13), "median": 3, "p5": 1.2, "p95": 4.8, "min": 1, "max": 5}
    )
    assert found["height_cm"]["min"] == pytest.approx(-2)
    assert found["height_cm"]["max"] == pytest.approx(0)
    assert found["yaw_deg"]["max"] == pytest.approx(4)
    # only the long step is divided by
    assert (found["foothold_per_step"]["min"], found["foothold_per_step"]["max"]) == pytest.approx((0.1, 0.1))
    assert (found["height_per_step"]["min"], found["height_per_step"]["max"]) == pytest.approx((0.04, 0.04))
    assert (found["yaw_deg_per_m"]["min"], found["yaw_deg_per_m"]["max"]) == pytest.approx((8, 8))


@given(st.integers(0, 2**32 - 1).map(np.random.default_rng))
def test_sole_corners_are_where_mujoco_has_them(robot: Robot, mj_model: mujoco.MjModel, random: np.random.Generator) -> None:
    data = mujoco.MjData(mj_model)
    data.qpos[:3], data.qpos[3:7] = random.uniform(-1, 1, 3), random.normal(size=4)
    data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
    data.qpos[7:] = random.uniform(robot.joint_low, robot.joint_high)
    mujoco.mj_kinematics(mj_model, data)
    qpos = np.tile(data.qpos, (2, 1))
    ankles = kinematics.measure(robot, data.qpos).ankle_positions
    found = swings.sole_corners(robot, qpos, ankles, np.array([0, 1]))
    for foot, leg in enumerate(("left", "right")):
        for i in range(4):
            sphere = data.geom(f"{leg}_sole_{i}")
            lowest = sphere.xpos - mj_model.geom(sphere.id).size[0] * sphere.xmat.reshape(3, 3)[:, 2]
            np.testing.assert_allclose(found[foot, i], lowest, atol=1e-9)


def over(path: list[list[float]], n: int = 101, yaw: float = 0.0) -> Trace:
    """A robot that faces `yaw` and whose flat left foot follows a path of ankle positions from entry 0 to n - 1."""
    trace = standing(n=n + 20)
    turn = Rotation.from_euler("z", yaw)
    swing(trace, 0, n)
    times = np.linspace(0, len(path) - 1, n)
    points = np.stack([np.interp(times, range(len(path)), column) for column in np.transpose(path)], axis=-1)
    trace.measured.ankle_positions[0, :, 0] = turn.apply(np.concatenate([points, np.tile(points[-1], (20, 1))]))
    trace.qpos[..., 3:7] = turn.as_quat(scalar_first=True)
    return trace


def tread(x: float, top: float, yaw: float = 0.0) -> Boxes:
    """A box of 1 m x 0.24 m x 0.4 m whose near edge crosses the heading `yaw` at a distance x, and a parked one."""
    centre = Rotation.from_euler("z", yaw).apply([x + 0.5, 0, top - 0.2])
    return Boxes(np.array([[centre, [0, 0, -10]]]), np.array([[[0.5, 0.12, 0.2]] * 2]), np.array([[yaw, 0]]))


# up, forward and down onto a tread of 0.1 m whose edge is 0.15 m ahead; the sole reaches 0.08 m ahead and behind
STEP_UP = [[0, 0.1, 0.04], [0, 0.1, 0.24], [0.3, 0.1, 0.24], [0.3, 0.1, 0.14]]


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.5])
def test_clearance_is_the_height_of_a_corner_over_the_edge_it_passes(yaw: float, robot: Robot) -> None:
    edge, against = swings.clearances(over(STEP_UP, yaw=yaw), robot, tread(0.15, 0.1, yaw))
    np.testing.assert_allclose(edge, [0.1])  # 0.24 - 0.04 - 0.1
    assert not against.any()


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.5])
def test_clearance_is_the_least_of_toe_and_heel_and_interpolated(yaw: float, robot: Robot) -> None:
    # 0.3 m forward while rising by 0.03 m, in 90 entries: the toe passes the edge at x = 0.07, the heel at 0.23
    rising = over([[0, 0.1, 0.16], [0.3, 0.1, 0.19]], 91, yaw)
    edge, _ = swings.clearances(rising, robot, tread(0.15, 0.1, yaw))
    np.testing.assert_allclose(edge, [0.16 + 0.007 - 0.04 - 0.1])
    falling = over([[0, 0.1, 0.19], [0.3, 0.1, 0.16]], 91, yaw)
    edge, _ = swings.clearances(falling, robot, tread(0.15, 0.1, yaw))
    np.testing.assert_allclose(edge, [0.19 - 0.023 - 0.04 - 0.1])


def test_a_foot_beside_a_box_does_not_pass_it(robot: Robot) -> None:
    beside = over([[x, y + 0.2, z] for x, y, z in STEP_UP], yaw=0.7)
    edge, against = swings.clearances(beside, robot, tread(0.15, 0.1, 0.7))
    assert np.isnan(edge).all() and not against.any()


def test_clearance_of_a_pitched_foot_is_that_of_its_lower_toe(robot: Robot) -> None:
    trace = over(STEP_UP)
    trace.qpos[..., 7 + 4] = 0.3  # the left ankle's pitch turns the toes down
    edge, _ = swings.clearances(trace, robot, tread(0.15, 0.1))
    assert edge == pytest.approx([0.24 - 0.1 - 0.04 * math.cos(0.3) - 0.08 * math.sin(0.3)])


def test_clearance_below_the_edge_is_negative(robot: Robot) -> None:
    found = summary(over([[0, 0.1, 0.12], [0.3, 0.1, 0.12]]), robot, boxes=tread(0.15, 0.1))["clearance"]
    assert found["edge_cm"]["min"] == pytest.approx(-2)
    assert (found["swings"], found["below_edge_share"], found["side_contact_share"]) == (1, 1, 1)


def test_a_foot_that_leaves_a_tread_downwards_passes_its_edge(robot: Robot) -> None:
    # from a tread that ends at x = 0.1 down to the ground beyond, with 3 cm to spare and the heel 7 cm from the side
    down = over([[-0.1, 0.1, 0.14], [-0.1, 0.1, 0.17], [0.25, 0.1, 0.17], [0.25, 0.1, 0.04]])
    edge, against = swings.clearances(down, robot, tread(-0.9, 0.1))
    np.testing.assert_allclose(edge, [0.03])
    assert not against.any()


def test_a_foot_stopped_by_a_riser_passes_no_edge_but_touches_its_side(robot: Robot) -> None:
    # the sphere at the toe stops 1 cm before the edge, its lowest point 4 cm under it
    stopped = over([[0, 0.1, 0.04], [0.06, 0.1, 0.1], [0.06, 0.1, 0.04]])
    found = summary(stopped, robot, boxes=tread(0.15, 0.1))["clearance"]
    assert (found["swings"], found["edge_cm"]["min"], found["side_contact_share"]) == (0, None, 1)


def test_a_foot_that_stands_on_a_box_does_not_pass_it(robot: Robot) -> None:
    # contacts are soft: sunk by 6 mm in the middle, by 4 mm with the heel 1 cm from the edge
    for path in ([[0.4, 0, 0.134], [0.5, 0, 0.134]], [[0.24, 0, 0.136], [0.3, 0, 0.136]]):
        edge, against = swings.clearances(over(path), robot, tread(0.15, 0.1))
        assert np.isnan(edge).all() and not against.any()


def test_only_swings_before_a_fall_are_looked_at(robot: Robot) -> None:
    trace = over(STEP_UP)
    trace.alive[0, 30:] = False  # with the foot up, but not yet over the edge
    edge, _ = swings.clearances(trace, robot, tread(0.15, 0.1))
    assert edge.shape == (1,) and np.isnan(edge).all()
    trace = over(STEP_UP)
    trace.timer[:] = 0
    assert swings.clearances(trace, robot, tread(0.15, 0.1))[0].shape == (0,)


def test_each_swing_and_each_episode_has_its_own_clearance(robot: Robot) -> None:
    parts = [over(STEP_UP), over(STEP_UP)]
    parts[1].measured.ankle_positions[..., 2] += 0.05
    # the second episode's left foot goes over twice: the other way 0.02 m lower
    both = Trace(parts[0].time, *(join(a, b) for a, b in zip(parts[0][1:], parts[1][1:], strict=True)))
    again = Nodes(*(np.concatenate([part, part[:, ::-1]], axis=1) for part in both.measured))
    again.ankle_positions[1, len(both.time) :, :, 2] -= 0.02
    twice = standing(2, 2 * len(both.time))._replace(measured=again)
    for episode in range(2):
        swing(twice, 0, 101, episode=episode)
    swing(twice, 141, 242, episode=1)
    boxes = Boxes(*(np.repeat(part, 2, axis=0) for part in tread(0.15, 0.1)))
    edge, _ = swings.clearances(twice, robot, boxes)
    np.testing.assert_allclose(edge, [0.1, 0.15, 0.13])


def join(a: Any, b: Any) -> Any:
    if isinstance(a, Nodes):
        return Nodes(*(np.concatenate(pair) for pair in zip(a, b, strict=True)))
    return np.concatenate([a, b])
