"""Figures of hand-made traces whose errors, touchdowns, falls, rests and torques are known."""

import json
import math
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.spatial.transform import Rotation

from bipedtrack import footsteps, kinematics, metrics
from bipedtrack.metrics import Boxes
from bipedtrack.nodes import Nodes
from bipedtrack.robot import Robot
from bipedtrack.trace import Trace

DT = 0.005  # s
WEIGHT = 400.0  # N, so that a foot stands from more than 20 N on
POSITIONS = metrics.ERRORS[:3]
ANGLES = metrics.ERRORS[3:]


def standing(episodes: int = 1, n: int = 100) -> Trace:
    """Robots that stand on their target for n control steps; the command neither swings a foot nor rests."""
    feet = np.array([[0, 0.1, 0.04], [0, -0.1, 0.04]])

    def nodes() -> Nodes:
        ones = np.ones((episodes, n))
        return Nodes(
            trunk_position=ones[..., None] * [0, 0, 0.75],
            trunk_orientation=ones[..., None] * [1, 0, 0, 0],
            ankle_positions=ones[..., None, None] * feet,
            ankle_yaws=np.zeros((episodes, n, 2)),
        )

    target = nodes()
    joints = np.zeros((episodes, n, 12))
    return Trace(
        time=np.arange(n) * DT,
        qpos=np.concatenate([target.trunk_position, target.trunk_orientation, joints], axis=-1),
        qvel=np.zeros((episodes, n, 18)),
        target=target,
        measured=nodes(),
        timer=np.zeros((episodes, n, 2)),
        still=np.zeros((episodes, n), bool),
        feedback=joints.copy(),
        joint_targets=joints.copy(),
        torques=joints.copy(),
        foot_forces=np.full((episodes, n, 2), WEIGHT / 2),
        alive=np.ones((episodes, n), bool),
    )


def swing(trace: Trace, liftoff: int, touchdown: int, foot: int = 0, episode: int = 0) -> None:
    """Plans a swing of a foot from one entry to another, in place; the foot bears nothing meanwhile."""
    trace.timer[episode, liftoff:touchdown, foot] = np.arange(touchdown - liftoff, 0, -1) * DT
    trace.foot_forces[episode, liftoff:touchdown, foot] = 0


def wander(random: np.random.Generator, episodes: int, n: int) -> Nodes:
    """Nodes anywhere, of any orientation."""
    orientation = random.normal(size=(episodes, n, 4))
    return Nodes(
        trunk_position=random.uniform(-3, 3, (episodes, n, 3)),
        trunk_orientation=orientation / np.linalg.norm(orientation, axis=-1, keepdims=True),
        ankle_positions=random.uniform(-3, 3, (episodes, n, 2, 3)),
        ankle_yaws=random.uniform(-6, 6, (episodes, n, 2)),
    )


def summary(trace: Trace, robot: Robot, **options: Any) -> dict[str, Any]:
    return metrics.summarise(trace, robot, WEIGHT, **options)


# Errors


def test_a_robot_on_its_target_scores_zero(robot: Robot) -> None:
    moving = wander(np.random.default_rng(0), 3, 50)
    found = summary(standing(3, 50)._replace(target=moving, measured=moving), robot)["errors"]
    assert tuple(found) == metrics.ERRORS
    for name in metrics.ERRORS:
        assert found[name]["max"] == pytest.approx(0, abs=1e-12), name


def test_one_frame_of_misalignment_scores_the_motion_of_one_frame() -> None:
    trace = standing(n=100)
    frames = np.arange(101.0)
    x = np.zeros((101, 3))
    x[:, 0] = frames
    turn = Rotation.from_euler("y", 0.4 * frames[:, None], degrees=True).as_quat(scalar_first=True)
    path = Nodes(
        trunk_position=0.002 * x,
        trunk_orientation=turn,
        ankle_positions=np.stack([0.001 * x, 0.003 * x], axis=1),
        ankle_yaws=np.radians(np.stack([0.5 * frames, -0.25 * frames], axis=1)),
    )
    late = trace._replace(
        target=Nodes(*(part[None, 1:] for part in path)), measured=Nodes(*(part[None, :-1] for part in path))
    )
    found = metrics.errors(late)
    known = [0.2, 0.1, 0.3, 0.4, 0.5, 0.25]
    for name, motion in zip(metrics.ERRORS, known, strict=True):
        np.testing.assert_allclose(found[name], motion, rtol=1e-9, err_msg=name)


def test_each_offset_shows_in_its_own_node_alone() -> None:
    shifts = {
        "trunk_position_cm": ("trunk_position", (0, slice(None)), [0.03, 0, -0.04], 5.0),
        "left_ankle_position_cm": ("ankle_positions", (0, slice(None), 0), [0, 0.01, 0], 1.0),
        "right_ankle_position_cm": ("ankle_positions", (0, slice(None), 1), [0, 0, 0.02], 2.0),
        "left_ankle_yaw_deg": ("ankle_yaws", (0, slice(None), 0), math.radians(3), 3.0),
        "right_ankle_yaw_deg": ("ankle_yaws", (0, slice(None), 1), math.radians(-7), 7.0),
    }
    for name, (part, where, shift, known) in shifts.items():
        trace = standing()
        getattr(trace.measured, part)[where] += shift
        for other, values in metrics.errors(trace).items():
            np.testing.assert_allclose(values, known if other == name else 0, atol=1e-12, err_msg=f"{name}: {other}")


@given(st.integers(0, 2**32 - 1).map(np.random.default_rng))
def test_trunk_orientation_error_is_the_angle_between_scipys_rotations(random: np.random.Generator) -> None:
    target, real = wander(random, 2, 5), wander(random, 2, 5)
    found = metrics.errors(standing(2, 5)._replace(target=target, measured=real))["trunk_orientation_deg"]
    a, b = (Rotation.from_quat(n.trunk_orientation.reshape(-1, 4), scalar_first=True) for n in (target, real))
    assert found.ravel() == pytest.approx(np.degrees((a.inv() * b).magnitude()), abs=1e-6)


def test_angles_are_wrapped() -> None:
    trace = standing()
    trace.target.ankle_yaws[:] = np.radians([179, -5])
    trace.measured.ankle_yaws[:] = np.radians([-179, 363])
    trace.measured.trunk_orientation[:] *= -1  # the same orientation
    found = metrics.errors(trace)
    np.testing.assert_allclose(found["left_ankle_yaw_deg"], 2)
    np.testing.assert_allclose(found["right_ankle_yaw_deg"], 8)
    assert not found["trunk_orientation_deg"].any()


def test_statistics_pool_the_entries_and_the_interval_is_over_episodes(robot: Robot) -> None:
    trace = standing(4, 101)
    # a ramp of 0..100 cm in the first episode, 10, 20 and 60 cm in the others
    trace.measured.trunk_position[0, :, 1] += np.arange(101) / 100
    for episode, offset in ((1, 0.1), (2, 0.2), (3, 0.6)):
        trace.measured.trunk_position[episode, :, 1] += offset
    trace.alive[3, 1:] = False  # so of the last episode one entry counts, but as much as the others in episode_mean
    found = summary(trace, robot)["errors"]["trunk_position_cm"]
    pooled = np.sort([*range(101), *[10] * 101, *[20] * 101, 60])
    assert found["mean"] == pytest.approx((5050 + 1010 + 2020 + 60) / 304)
    assert found["median"] == pytest.approx((pooled[151] + pooled[152]) / 2)
    assert found["p95"] == pytest.approx(pooled[287] + 0.85 * (pooled[288] - pooled[287]))  # 0.95 * 303 = 287.85
    assert found["max"] == pytest.approx(100)
    assert found["rms"] == pytest.approx(math.sqrt((338350 + 101 * 100 + 101 * 400 + 3600) / 304))
    means = np.array([50, 10, 20, 60])
    low, high = stats.t.interval(0.95, 3, means.mean(), stats.sem(means))
    assert found["episode_mean"] == pytest.approx(35)
    assert (found["episode_low"] - 35, found["episode_high"] - 35) == pytest.approx((low - 35, high - 35), rel=0.01)


@pytest.mark.parametrize("episodes", [3, 4, 8, 30, 256])
def test_interval_of_the_mean_is_students(episodes: int, robot: Robot) -> None:
    trace = standing(episodes, 2)
    offsets = np.random.default_rng(episodes).uniform(0, 0.1, episodes)
    trace.measured.ankle_positions[:, :, 1, 2] += offsets[:, None]
    found = summary(trace, robot)["errors"]["right_ankle_position_cm"]
    half = stats.t.ppf(0.975, episodes - 1) * stats.sem(100 * offsets)
    assert found["episode_high"] - found["episode_mean"] == pytest.approx(half, rel=0.01)
    assert found["episode_mean"] - found["episode_low"] == pytest.approx(half, rel=0.01)


def test_two_episodes_have_no_interval(robot: Robot) -> None:
    found = summary(standing(2), robot)["errors"]["trunk_position_cm"]
    assert (found["episode_mean"], found["episode_low"], found["episode_high"]) == (0, None, None)


def test_nothing_counts_from_a_fall_on(robot: Robot) -> None:
    trace = standing(2, 100)
    trace.measured.trunk_position[0, :60, 0] += 0.01
    # from entry 60 on the first robot is beyond all bounds, as a simulator may leave it
    wrong = trace._replace(measured=Nodes(*(part.copy() for part in trace.measured)))
    for part in (*wrong.measured, *wrong.target, wrong.qpos, wrong.qvel, wrong.torques, wrong.feedback, wrong.foot_forces):
        part[0, 60:70], part[0, 70:80], part[0, 80:] = np.nan, np.inf, 1e3
    wrong.timer[0, 60:80], wrong.still[0, 60:] = 0.1, True
    wrong.alive[0, 60:] = False
    boxes = Boxes(np.full((2, 1, 3), 0.1), np.full((2, 1, 3), 0.05), np.zeros((2, 1)))
    found = summary(wrong, robot, boxes=boxes)
    assert found["errors"]["trunk_position_cm"]["max"] == pytest.approx(1)
    assert found["errors"]["trunk_position_cm"]["mean"] == pytest.approx(60 / 160)
    assert found["effort"]["torque_rms_nm"] == 0
    assert found["rest"]["windows"] == 0
    assert found["touchdown"]["planned"] == 0
    json.dumps(found, allow_nan=False)


def test_time_course_is_the_mean_over_those_still_up() -> None:
    trace = standing(3, 4)
    trace.measured.trunk_position[:, :, 0] += np.array([[0.01], [0.02], [0.06]])
    trace.alive[2, 1:] = False
    trace.alive[1, 2:] = False
    trace.alive[0, 3:] = False
    course = metrics.time_course(trace)
    np.testing.assert_allclose(course["time_s"], [0, 0.005, 0.01, 0.015])
    np.testing.assert_allclose(course["alive_share"], [1, 2 / 3, 1 / 3, 0])
    np.testing.assert_allclose(course["trunk_position_cm"], [3, 1.5, 1, np.nan])
    assert set(course) == {"time_s", "alive_share", *metrics.ERRORS}


# Touchdowns


def test_swings_are_those_that_end_before_a_fall() -> None:
    trace = standing(2, 100)
    swing(trace, 0, 20, foot=1)  # in the air from the first entry on
    swing(trace, 20, 50, foot=0)
    swing(trace, 50, 70, foot=0)  # the same foot again, without a stand in between
    swing(trace, 80, 100, foot=1)  # ends with the trace
    swing(trace, 10, 30, foot=1, episode=1)
    swing(trace, 30, 50, foot=0, episode=1)
    trace.alive[1, 50:] = False  # falls at the very touchdown
    found = np.array(metrics.swings(trace)).T
    assert sorted(found.tolist()) == [[0, 0, 20, 50], [0, 0, 50, 70], [0, 1, 0, 20], [1, 1, 10, 30]]


def test_swings_of_a_script_end_on_its_footholds(robot: Robot) -> None:
    header = ",".join(footsteps.COLUMNS)
    rows = "left,0.2,0.1,,0,0.5\nright,0.4,-0.1,,0,0.6\nright,0.5,-0.1,,0.1,0.4\nboth,,,,,0.5\n"
    commands = list(footsteps.commands(footsteps.parse(f"{header}\n{rows}", robot, "walk.csv"), DT))
    trace = standing(n=len(commands))
    target = Nodes(*(np.array(part)[None] for part in zip(*(c.target for c in commands), strict=True)))
    trace = trace._replace(target=target, measured=target, timer=np.array([c.timer for c in commands])[None])
    found = metrics.swings(trace)
    order = np.argsort(found.touchdown)
    assert found.foot[order].tolist() == [0, 1, 1]
    assert found.liftoff[order].tolist() == [0, 100, 220]
    assert found.touchdown[order].tolist() == [100, 220, 300]
    came = metrics.touchdowns(trace, 20.0)
    np.testing.assert_allclose(came["step_length_cm"][order], [20, 40, 10])
    np.testing.assert_allclose(came["foothold_cm"], 0, atol=1e-12)
    np.testing.assert_allclose(came["yaw_deg"], 0, atol=1e-12)


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
    found = summary(trace, robot)["touchdown"]
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


# Clearance


@given(st.integers(0, 2**32 - 1).map(np.random.default_rng))
def test_sole_corners_are_where_mujoco_has_them(robot: Robot, mj_model: mujoco.MjModel, random: np.random.Generator) -> None:
    data = mujoco.MjData(mj_model)
    data.qpos[:3], data.qpos[3:7] = random.uniform(-1, 1, 3), random.normal(size=4)
    data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
    data.qpos[7:] = random.uniform(robot.joint_low, robot.joint_high)
    mujoco.mj_kinematics(mj_model, data)
    qpos = np.tile(data.qpos, (2, 1))
    ankles = kinematics.measure(robot, data.qpos).ankle_positions
    found = metrics.sole_corners(robot, qpos, ankles, np.array([0, 1]))
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
    edge, against = metrics.clearances(over(STEP_UP, yaw=yaw), robot, tread(0.15, 0.1, yaw))
    np.testing.assert_allclose(edge, [0.1])  # 0.24 - 0.04 - 0.1
    assert not against.any()


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.5])
def test_clearance_is_the_least_of_toe_and_heel_and_interpolated(yaw: float, robot: Robot) -> None:
    # 0.3 m forward while rising by 0.03 m, in 90 entries: the toe passes the edge at x = 0.07, the heel at 0.23
    rising = over([[0, 0.1, 0.16], [0.3, 0.1, 0.19]], 91, yaw)
    edge, _ = metrics.clearances(rising, robot, tread(0.15, 0.1, yaw))
    np.testing.assert_allclose(edge, [0.16 + 0.007 - 0.04 - 0.1])
    falling = over([[0, 0.1, 0.19], [0.3, 0.1, 0.16]], 91, yaw)
    edge, _ = metrics.clearances(falling, robot, tread(0.15, 0.1, yaw))
    np.testing.assert_allclose(edge, [0.19 - 0.023 - 0.04 - 0.1])


def test_a_foot_beside_a_box_does_not_pass_it(robot: Robot) -> None:
    beside = over([[x, y + 0.2, z] for x, y, z in STEP_UP], yaw=0.7)
    edge, against = metrics.clearances(beside, robot, tread(0.15, 0.1, 0.7))
    assert np.isnan(edge).all() and not against.any()


def test_clearance_of_a_pitched_foot_is_that_of_its_lower_toe(robot: Robot) -> None:
    trace = over(STEP_UP)
    trace.qpos[..., 7 + 4] = 0.3  # the left ankle's pitch turns the toes down
    edge, _ = metrics.clearances(trace, robot, tread(0.15, 0.1))
    assert edge == pytest.approx([0.24 - 0.1 - 0.04 * math.cos(0.3) - 0.08 * math.sin(0.3)])


def test_clearance_below_the_edge_is_negative(robot: Robot) -> None:
    found = summary(over([[0, 0.1, 0.12], [0.3, 0.1, 0.12]]), robot, boxes=tread(0.15, 0.1))["clearance"]
    assert found["edge_cm"]["min"] == pytest.approx(-2)
    assert (found["swings"], found["below_edge_share"], found["side_contact_share"]) == (1, 1, 1)


def test_a_foot_that_leaves_a_tread_downwards_passes_its_edge(robot: Robot) -> None:
    # from a tread that ends at x = 0.1 down to the ground beyond, with 3 cm to spare and the heel 7 cm from the side
    down = over([[-0.1, 0.1, 0.14], [-0.1, 0.1, 0.17], [0.25, 0.1, 0.17], [0.25, 0.1, 0.04]])
    edge, against = metrics.clearances(down, robot, tread(-0.9, 0.1))
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
        edge, against = metrics.clearances(over(path), robot, tread(0.15, 0.1))
        assert np.isnan(edge).all() and not against.any()


def test_only_swings_before_a_fall_are_looked_at(robot: Robot) -> None:
    trace = over(STEP_UP)
    trace.alive[0, 30:] = False  # with the foot up, but not yet over the edge
    edge, _ = metrics.clearances(trace, robot, tread(0.15, 0.1))
    assert edge.shape == (1,) and np.isnan(edge).all()
    trace = over(STEP_UP)
    trace.timer[:] = 0
    assert metrics.clearances(trace, robot, tread(0.15, 0.1))[0].shape == (0,)


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
    edge, _ = metrics.clearances(twice, robot, boxes)
    np.testing.assert_allclose(edge, [0.1, 0.15, 0.13])


def join(a: Any, b: Any) -> Any:
    if isinstance(a, Nodes):
        return Nodes(*(np.concatenate(pair) for pair in zip(a, b, strict=True)))
    return np.concatenate([a, b])


# Survival


@pytest.mark.parametrize(("successes", "total"), [(0, 1), (1, 1), (0, 256), (256, 256), (250, 256), (13, 20), (1, 3)])
def test_wilson_interval_is_scipys(successes: int, total: int) -> None:
    known = stats.binomtest(successes, total).proportion_ci(method="wilson")
    assert metrics.wilson(successes, total) == pytest.approx((known.low, known.high), abs=1e-9)


def test_wilson_interval_worked_by_hand() -> None:
    # z² = 3.8415; (0.5 + z²/20 ± z sqrt(0.25 / 10 + z²/400)) / (1 + z²/10)
    assert metrics.wilson(5, 10) == pytest.approx((0.2366, 0.7634), abs=5e-5)


def test_survival_worked_by_hand() -> None:
    trace = standing(4, 200)
    trace.alive[1, 100:] = False  # 0.5 s
    found = metrics.survival(trace)
    assert (found["share"], found["falls"]) == (0.75, 1)
    assert (found["share_low"], found["share_high"]) == metrics.wilson(3, 4)
    assert found["time_to_fall_mean_s"] == pytest.approx(0.5)
    assert found["time_to_fall_median_s"] is None  # most of them have not fallen
    trace.alive[2, 140:] = False
    trace.alive[0, 199:] = False
    found = metrics.survival(trace)
    assert (found["share"], found["falls"]) == (0.25, 3)
    assert found["time_to_fall_mean_s"] == pytest.approx((0.5 + 0.7 + 0.995) / 3)
    assert found["time_to_fall_median_s"] == pytest.approx((0.7 + 0.995) / 2)


def test_nobody_fell() -> None:
    found = metrics.survival(standing(3))
    assert (found["share"], found["share_high"], found["falls"]) == (1, 1, 0)
    assert found["time_to_fall_mean_s"] is found["time_to_fall_median_s"] is None


# Rest


def test_a_rest_begins_after_settling_and_ends_with_the_command_or_a_fall() -> None:
    trace = standing(3, 1000)
    trace.still[0, 100:600] = True
    trace.still[0, 700:850] = True  # shorter than the time to settle
    trace.still[1] = True
    trace.alive[1, 500:] = False
    assert metrics.rests(trace, 1.0) == [(0, slice(300, 600)), (1, slice(200, 500))]
    assert metrics.rests(trace, 0.5) == [(0, slice(200, 600)), (0, slice(800, 850)), (1, slice(100, 500))]


def test_rest_worked_by_hand(robot: Robot) -> None:
    trace = standing(2, 1000)
    trace.still[0] = True
    trace.qvel[..., :6] = 9.0  # the trunk's, not the joints'
    trace.qvel[..., 6:] = 9.0
    trace.qvel[0, 200:, 6:] = 0
    trace.qvel[0, 200:, 6] = np.where(np.arange(800) % 2, 0.6, -0.6)  # one joint of twelve trembles
    trace.measured.trunk_position[0, :200] = 5.0
    sway = np.where(np.arange(800) % 4 < 2, 0.01, -0.01)
    trace.measured.trunk_position[0, 200:, :2] = np.array([3, -4]) + sway[:, None] * [0.5, math.sqrt(0.75)]  # at 60 deg
    trace.measured.trunk_position[0, 200:, 2] += np.linspace(0, 0.3, 800)  # sinking is no sway
    lean = Rotation.from_euler("xyz", [0.4, 0.2, 2.0]) * Rotation.from_rotvec(np.radians(200 * sway)[:, None] * [0, 1, 0])
    trace.measured.trunk_orientation[0, 200:] = lean.as_quat(scalar_first=True)
    trace.measured.ankle_positions[0, 500:600, 1] += [0.003, 0, 0.004]
    trace.measured.ankle_positions[0, 600:, 1, 0] -= 0.002
    found = summary(trace, robot)["rest"]
    assert (found["episodes"], found["windows"], found["seconds"]) == (1, 1, pytest.approx(4))
    assert found["joint_speed_rms_rad_per_s"]["mean"] == pytest.approx(0.6 / math.sqrt(12))
    assert found["trunk_sway_rms_cm"]["mean"] == pytest.approx(1)
    assert found["trunk_sway_peak_to_peak_cm"]["mean"] == pytest.approx(2)
    assert found["trunk_turn_rms_deg"]["mean"] == pytest.approx(2)
    assert found["trunk_turn_peak_to_peak_deg"]["mean"] == pytest.approx(4)
    assert found["foot_motion_cm"]["max"] == pytest.approx(0.5)
    assert found["foot_moved_share"] == 0
    assert summary(trace, robot, settle=2.0)["rest"]["seconds"] == pytest.approx(3)


def test_feet_that_move_at_rest_are_counted_by_episode(robot: Robot) -> None:
    trace = standing(4, 1000)
    trace.still[:3] = True
    trace.still[0, 500] = False  # two rests, in both of which it steps
    trace.measured.ankle_positions[0, 300:350, 0, 2] += 0.05
    trace.measured.ankle_positions[0, 900:, 0, 0] += 0.02
    trace.measured.ankle_positions[1, 200:, 1, 0] += 0.2  # off its target all the time, but where it stood
    trace.measured.ankle_positions[2, :, 1, 0] += np.linspace(0, 0.009, 1000)
    found = summary(trace, robot)["rest"]
    assert (found["episodes"], found["windows"]) == (3, 4)
    assert found["foot_moved_share"] == pytest.approx(1 / 3)
    assert found["foot_motion_cm"]["max"] == pytest.approx(5)


# Effort


def test_effort_worked_by_hand(robot: Robot) -> None:
    trace = standing(1, 10)
    trace.torques[..., 0], trace.torques[..., 6] = 30, -40
    trace.qvel[..., 0] = 100  # the trunk's
    trace.qvel[..., 6], trace.qvel[..., 12] = -2, 0.5
    trace.feedback[..., 0:6] = -0.5
    trace.feedback[0, 3, 7] = 0.75
    found = metrics.effort(trace, robot.torque_limit)
    assert found["torque_rms_nm"] == pytest.approx(math.sqrt((900 + 1600) / 12))
    assert found["power_w"] == pytest.approx(60 + 20)
    assert found["feedback_mean"] == pytest.approx((60 * 0.5 + 0.75) / 120)
    assert found["feedback_max"] == 0.75
    assert found["saturation_share"] == 0
    trace.torques[0, 5, :3] = np.array([-1, 0.981, 0.979]) * robot.torque_limit[:3]
    assert metrics.effort(trace, robot.torque_limit)["saturation_share"] == pytest.approx(2 / 120)


# The whole


def leaves(tree: dict[str, Any]) -> list[Any]:
    return [leaf for part in tree.values() for leaf in (leaves(part) if isinstance(part, dict) else [part])]


def test_summary_without_swing_rest_or_box_has_none_and_is_json(robot: Robot) -> None:
    found = summary(standing(), robot)
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert {type(leaf) for leaf in leaves(found)} == {int, float, type(None)}
    assert (found["episodes"], found["seconds"], found["clearance"]) == (1, pytest.approx(0.5), None)
    assert found["touchdown"]["foothold_cm"]["mean"] is found["touchdown"]["missed_share"] is None
    assert found["rest"]["trunk_sway_rms_cm"]["max"] is found["rest"]["foot_moved_share"] is None


def test_single_precision_serves(robot: Robot) -> None:
    trace = standing(2, 100)
    swing(trace, 20, 60)
    trace.measured.trunk_position[..., 0] += 0.05
    single = Trace(trace.time, *(lower(part) for part in trace[1:]))
    found = summary(single, robot)
    assert found["errors"]["trunk_position_cm"]["mean"] == pytest.approx(5, rel=1e-5)
    json.dumps(found, allow_nan=False)


def lower(part: Any) -> Any:
    if isinstance(part, Nodes):
        return Nodes(*(lower(array) for array in part))
    return part.astype(np.float32) if part.dtype == np.float64 else part


def test_a_trace_that_cannot_be_summarised_is_refused(robot: Robot) -> None:
    trace = standing(2, 10)
    with pytest.raises(ValueError, match=r"axes \(episodes, entries\).*not \(10,\)"):
        summary(trace.episode(0), robot)
    with pytest.raises(ValueError, match="at least 1 and 2"):
        summary(standing(2, 1), robot)
    with pytest.raises(ValueError, match="at least 1 and 2"):
        metrics.time_course(standing(0, 10))
    trace.alive[0, 5] = False
    with pytest.raises(ValueError, match="not again after a fall"):
        summary(trace, robot)
    trace.alive[0] = False
    with pytest.raises(ValueError, match="alive at its first entry"):
        summary(trace, robot)
    trace.alive[0, :5] = True
    trace.measured.ankle_yaws[0, 5] = np.nan
    summary(trace, robot)
    trace.measured.ankle_yaws[0, 4] = np.nan
    with pytest.raises(ValueError, match="measured is not finite before a fall"):
        summary(trace, robot)
