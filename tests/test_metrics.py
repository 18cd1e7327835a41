"""Figures of hand-made traces whose errors, falls, rests and torques are known."""

import json
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.spatial.transform import Rotation
from traces import standing, summary, swing

from bipedtrack import metrics
from bipedtrack.nodes import Nodes
from bipedtrack.robot import Robot
from bipedtrack.swings import Boxes
from bipedtrack.trace import Trace

POSITIONS = metrics.ERRORS[:3]
ANGLES = metrics.ERRORS[3:]


def wander(random: np.random.Generator, episodes: int, n: int) -> Nodes:
    """Nodes anywhere, of any orientation."""
    orientation = random.normal(size=(episodes, n, 4))
    return Nodes(
        trunk_position=random.uniform(-3, 3, (episodes, n, 3)),
        trunk_orientation=orientation / np.linalg.norm(orientation, axis=-1, keepdims=True),
        ankle_positions=random.uniform(-3, 3, (episodes, n, 2, 3)),
        ankle_yaws=random.uniform(-6, 6, (episodes, n, 2)),
    )


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
    assert metrics.survival(trace)["time_to_fall_median_s"] is None  # half of them have
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
