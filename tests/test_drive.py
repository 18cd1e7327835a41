"""A robot under somebody's hands: footholds worked by hand, and the shipped policy driven without a page."""

import math
import sys

import mujoco
import numpy as np
import pytest

from bipedtrack import drive as drives
from bipedtrack import env, footsteps, kinematics, nodes, paths, policy, rotations, sampling, scripts, steering, tasks
from bipedtrack import robot as robots
from bipedtrack.drive import Drive, Mode
from bipedtrack.footsteps import Box
from bipedtrack.nodes import Nodes, ankles_in_trunk_frame
from bipedtrack.steering import Foothold, Steering


@pytest.fixture(scope="module")
def shipped(robot: robots.Robot) -> policy.Policy:
    return policy.load(paths.data_dir("models") / "policies" / "best.npz", robot)


@pytest.fixture
def drive(shipped: policy.Policy) -> Drive:
    return Drive(policy.Controller(shipped))


def go(drive: Drive, seconds: float) -> np.ndarray:
    """Lets the time run; where the trunk is then, m."""
    for _ in range(round(seconds / drive.timestep)):
        drive.advance()
    return drive.data.qpos[:3].copy()


def ground(robot: robots.Robot, name: str) -> tuple[Box, ...]:
    return footsteps.load(scripts.ready()[name], robot).boxes


# Steering: footholds worked by hand. Feet begin at (0, ±0.1), the ankles 0.04 m above their soles.


def centre_of_mass(robot: robots.Robot, nodes: Nodes) -> np.ndarray:
    """MuJoCo's centre of mass, (2,) m, of the robot on its nodes."""
    data = mujoco.MjData(robots.build_model(robot.name))
    joints = kinematics.inverse(robot, *ankles_in_trunk_frame(nodes))
    data.qpos[:] = np.concatenate([nodes.trunk_position, nodes.trunk_orientation, joints])
    mujoco.mj_kinematics(data.model, data)
    mujoco.mj_comPos(data.model, data)
    return data.subtree_com[0][:2].copy()


def test_walking_puts_the_foot_one_step_ahead_of_the_other(robot: robots.Robot) -> None:
    asked = Steering(ahead=1.0, step_length=0.2, lift=0.1, period=0.6, trunk_height=0.74)
    step = steering.walk(robot, (), footsteps.initial_nodes(robot), 0, asked).step
    assert np.allclose(step.end.ankle_positions, [[0.2, 0.1, 0.04], [0, -0.1, 0.04]])
    assert np.allclose(step.end.trunk_position[1:], [0, 0.74])
    assert np.allclose(centre_of_mass(robot, step.end), [0.1, 0], atol=1e-3)
    assert (step.period, *step.swing, *step.lift) == (pytest.approx(0.6), 1, 0, 0.1, 0)
    following = steering.walk(robot, (), step.end, 1, asked).step
    assert np.allclose(following.end.ankle_positions, [[0.2, 0.1, 0.04], [0.4, -0.1, 0.04]])


@pytest.mark.parametrize(("foot", "y"), [(0, 0.1 + 2 * 0.06), (1, -0.1)])
def test_to_the_left_the_left_foot_opens_and_the_right_one_stays_beside(robot: robots.Robot, foot: int, y: float) -> None:
    step = steering.walk(robot, (), footsteps.initial_nodes(robot), foot, Steering(aside=1.0, sidle_length=0.06)).step
    assert np.allclose(step.end.ankle_positions[foot], [0, y, 0.04])


def test_turning_moves_the_foot_about_the_place_between_the_feet(robot: robots.Robot) -> None:
    step = steering.walk(robot, (), footsteps.initial_nodes(robot), 0, Steering(turn=1.0, turn_angle=0.3)).step
    assert np.allclose(step.end.ankle_positions[0], [-0.1 * math.sin(0.3), 0.1 * math.cos(0.3), 0.04])
    assert np.allclose(step.end.ankle_yaws, [0.3, 0])
    assert np.allclose(rotations.to_euler(step.end.trunk_orientation), [0, 0, 0.15])


def test_steps_are_those_of_training(robot: robots.Robot) -> None:
    """The same advance gives the same foothold as the task steps that a policy learns from."""
    start = footsteps.initial_nodes(robot)
    for foot in range(2):
        for ahead, turn in ((0.2, 0.0), (-0.1, 0.25), (0.0, -0.35)):
            motion = tasks.Motion(sampling.WALK, np.array([ahead, 0.0, turn]), foot, 0.55, 0.08, 0.75)
            places, yaws = tasks._foothold(motion, 0.0, False, foot, motion.advance, start)
            mine = steering._moved_on(start, foot, np.array([ahead, 0.0, turn]))
            assert np.allclose(mine[1:], [*places[foot][:2], yaws[foot]], atol=1e-6)


def test_limits_are_those_of_training() -> None:
    ranges = sampling.Ranges()
    twins = {
        **{"period": "period", "lift": "lift", "turn_angle": "turn_yaw", "step_length": "walk_step"},
        **{"sidle_length": "sidle_step", "trunk_ahead": "posture_x", "trunk_aside": "posture_y"},
        **{"trunk_height": "posture_height", "trunk_roll": "posture_roll", "trunk_pitch": "posture_pitch"},
        "trunk_yaw": "posture_yaw",
    }
    assert set(twins) == set(steering.LIMITS)
    for mine, theirs in twins.items():
        low, _, high = getattr(ranges, theirs)
        assert steering.LIMITS[mine][1] == high
        assert steering.LIMITS[mine][0] >= low
    assert steering.FOOT_DISTANCE == tasks.FOOT_DISTANCE


def test_wishes_are_clamped_and_nonsense_becomes_the_default() -> None:
    asked = steering.clamped(Steering(ahead=7.0, period=99.0, lift=-1.0, trunk_height=math.nan))
    assert (asked.ahead, asked.period, asked.lift, asked.trunk_height) == (1.0, 0.7, 0.04, footsteps.TRUNK_HEIGHT)


TREADS = (Box(0.45, 0, 0, 0, 0.3, 1.2, 0.1), Box(0.75, 0, 0, 0, 0.3, 1.2, 0.2))  # edges at 0.30, 0.60 and 0.90 m


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
    found = steering.on_ground(robot, boxes, Foothold(0, home, 0.1, 0.0), Foothold(0, wanted, 0.1, 0.0))
    assert found.x == pytest.approx(x, abs=0.011)
    assert found[2:] == (pytest.approx(0.1), 0.0)


def test_the_nearest_possible_point_of_a_disc() -> None:
    wanted = np.array([3.0, 4.0])
    found = steering.nearest(lambda p: bool(np.hypot(*p) <= 1), wanted, np.array([-0.5, 0.0]))
    assert found is not None
    assert np.hypot(*found) <= 1
    assert math.dist(found, wanted) < 4.0 + 0.003
    assert steering.nearest(lambda p: False, wanted, np.zeros(2)) is None


def test_a_foothold_out_of_reach_is_moved_and_said_so(robot: robots.Robot) -> None:
    start = footsteps.initial_nodes(robot)
    wanted = Foothold(0, 2.0, 0.1, 0.0)
    planned = steering.place(robot, (), start, wanted, Steering())
    x, y, _ = planned.step.end.ankle_positions[0]
    assert (x, y) == (pytest.approx(0.35, abs=0.01), pytest.approx(0.1, abs=0.02))
    assert "left foothold was moved by 165 cm" in planned.note
    assert not footsteps.problems_of(robot, (), planned.step)
    within = Foothold(0, 0.2, 0.15, 0.1)
    planned = steering.place(robot, (), start, within, Steering())
    assert planned.note == ""
    assert np.allclose(planned.step.end.ankle_positions[0, :2], [0.2, 0.15])


def test_a_trunk_handle_gives_the_wishes_that_put_the_trunk_there(robot: robots.Robot) -> None:
    start = steering.walk(robot, (), footsteps.initial_nodes(robot), 0, Steering(ahead=1, turn=1)).step.end
    asked = Steering(trunk_ahead=0.03, trunk_aside=-0.02, trunk_height=0.7, trunk_roll=0.05, trunk_pitch=-0.1, trunk_yaw=0.2)
    end = steering.trunk_step(robot, start, asked).end
    found = steering.trunk_at(robot, start, end.trunk_position, end.trunk_orientation, Steering())
    assert np.allclose(found, asked, atol=1e-4)


def test_euler_angles_and_back() -> None:
    angles = (0.3, -0.4, 2.5)
    orientation = rotations.from_euler(*map(np.float64, angles))
    assert np.allclose(rotations.to_euler(orientation), angles)


# Scripts


def test_a_script_written_down_reads_back_the_same(robot: robots.Robot) -> None:
    for name, path in scripts.ready().items():
        script = footsteps.load(path, robot)
        again = footsteps.parse(scripts.text(robot, script.steps, script.boxes), robot, name)
        assert again.boxes == script.boxes
        assert footsteps.duration(again) == pytest.approx(footsteps.duration(script))
        for time in np.arange(0, footsteps.duration(script), 0.13):
            targets = [footsteps.command_at(each, float(time)).target for each in (script, again)]
            assert max(np.abs(part).max() for part in nodes.difference(*targets)) < 1e-4


def test_every_kind_and_both_courses_lie_ready() -> None:
    assert {*sampling.KINDS, "obstacles"} <= set(scripts.ready())


# Drives with the policy that ships


def test_it_needs_no_jax() -> None:
    import subprocess

    program = "import sys; sys.modules.update(jax=None, brax=None, flax=None); import bipedtrack.drive, bipedtrack.realtime"
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)


def test_it_walks_stops_and_holds(drive: Drive) -> None:
    drive.steer(ahead=1.0)
    assert go(drive, 6.0)[0] == pytest.approx(6.0 * 0.15 / 0.55, abs=0.2)
    drive.stop()
    go(drive, 2.0)
    standing = drive.step.end.ankle_positions
    assert standing[0, 0] == pytest.approx(standing[1, 0])  # feet together
    at = go(drive, 0.5)
    assert np.abs(go(drive, 2.0) - at).max() < 0.01
    assert drive.mode is Mode.STEER


def test_it_sidles_turns_and_goes_back(drive: Drive) -> None:
    drive.steer(aside=-1.0)
    assert go(drive, 4.0)[1] < -0.2
    drive.steer(aside=0.0, turn=1.0)
    go(drive, 4.0)
    drive.stop()
    go(drive, 1.5)
    assert drive.step.end.ankle_yaws[0] == pytest.approx(1.4, abs=0.41)
    drive.reset()
    drive.steer(ahead=-1.0, step_length=0.1)
    assert go(drive, 4.0)[0] < -0.4
    assert drive.mode is Mode.STEER


def test_a_wish_waits_for_the_next_task_step(drive: Drive) -> None:
    drive.steer(ahead=1.0)
    go(drive, 1.0)
    under_way = drive.step
    drive.stop()
    drive.advance()
    assert drive.step is under_way


def test_feet_alternate(drive: Drive) -> None:
    drive.steer(ahead=1.0)
    go(drive, 4.0)
    feet = [int(np.argmax(step.swing)) for step in drive.taken if step.swing.any()]
    assert len(feet) >= 6
    assert set(np.abs(np.diff(feet))) == {1}


def test_it_climbs_a_stair_and_stops_there(shipped: policy.Policy, robot: robots.Robot) -> None:
    drive = Drive(policy.Controller(shipped), ground(robot, "stairs"))
    drive.steer(ahead=1.0)
    go(drive, 1.2)
    drive.stop()
    go(drive, 3.0)
    heights = drive.step.end.ankle_positions[:, 2] - robot.ankle_height
    assert heights[0] == pytest.approx(heights[1])
    assert heights[0] > 0.09
    assert go(drive, 2.0)[2] == pytest.approx(heights[0] + 0.75, abs=0.03)
    drive.steer(ahead=1.0)
    assert go(drive, 6.0)[0] > 2.0
    assert drive.mode is Mode.STEER


def test_the_trunk_goes_where_it_is_asked(drive: Drive) -> None:
    drive.steer(trunk_height=0.66, trunk_pitch=0.1)
    at = go(drive, 3.0)
    assert at[2] == pytest.approx(0.66, abs=0.03)
    assert rotations.to_euler(drive.target.trunk_orientation)[1] == pytest.approx(0.1)
    assert 0.01 < rotations.to_euler(drive.data.qpos[3:7])[1] < 0.15


def test_it_steps_where_a_foothold_is_placed(drive: Drive) -> None:
    assert drive.place(Foothold(0, 0.15, 0.14, 0.1)) == ""
    go(drive, 2.5)
    assert np.allclose(drive.view().measured.ankle_positions[0, :2], [0.15, 0.14], atol=0.03)
    assert drive.wishes.foot == 1
    assert "moved" in drive.place(Foothold(1, 0.15, -3.0, 0.0))
    go(drive, 2.5)
    assert drive.mode is Mode.STEER
    assert drive.data.qpos[2] == pytest.approx(0.75, abs=0.05)
    with pytest.raises(ValueError, match="finite"):
        drive.place(Foothold(0, math.nan, 0.0, 0.0))


@pytest.mark.parametrize(("direction", "axis", "sign"), [(0, 0, 1), (90, 1, 1), (180, 0, -1)])
def test_a_push_gives_the_trunk_its_impulse(drive: Drive, direction: float, axis: int, sign: int) -> None:
    go(drive, 0.3)
    still = drive.data.qvel[axis]
    drive.push(15.0, direction)
    go(drive, drives.PUSH_SECONDS)
    # at most 15 N s on the trunk's 20 kg; legs and ground take their share
    assert 0.1 < sign * (drive.data.qvel[axis] - still) < 0.75
    go(drive, 0.05)
    assert not drive.data.body("trunk").xfrc_applied.any()
    with pytest.raises(ValueError, match="wanted 0 to"):
        drive.push(math.inf)


def test_after_a_fall_it_stands_up_at_the_last_foothold(drive: Drive) -> None:
    drive.steer(ahead=1.0)
    go(drive, 3.0)
    drive.push(200.0, 90.0)
    go(drive, 2.0)
    assert drive.mode is Mode.FALLEN
    assert "fallen" in drive.note
    with pytest.raises(ValueError, match="stand it up"):
        drive.steer(ahead=1.0)
    last = drive.step.start
    drive.stand_up()
    assert np.allclose(drive.view().measured.ankle_positions, last.ankle_positions, atol=1e-6)
    at = go(drive, 3.0)
    assert drive.mode is Mode.STEER
    assert at[2] > 0.7
    footsteps.parse(drive.as_script(), drive.robot, "after a fall")


def test_the_rule_of_falls_is_that_of_training() -> None:
    defaults = env.EnvConfig.__dataclass_fields__
    mine = (drives.FALL_TILT_DEG, drives.FALL_DEPTH, drives.LOST_ANKLE)
    assert mine == tuple(defaults[name].default for name in ("fall_tilt_deg", "fall_depth", "lost_ankle"))


def test_without_feedback_it_falls_and_with_it_again_it_does_not(drive: Drive) -> None:
    drive.feedback = False
    drive.steer(ahead=1.0)
    go(drive, 4.0)
    assert drive.mode is Mode.FALLEN
    assert not drive.view().feedback.any()
    drive.feedback = True
    drive.stand_up()
    go(drive, 2.0)
    assert drive.mode is Mode.STEER
    assert drive.view().feedback.any()


def test_a_state_that_is_not_finite_is_a_fall(drive: Drive) -> None:
    drive.data.qvel[3] = math.nan
    go(drive, 0.1)
    assert drive.mode is Mode.FALLEN
    drive.view()
    drive.stand_up()
    assert go(drive, 1.0)[2] > 0.7


def test_a_script_runs_to_its_end_and_again_in_a_loop(drive: Drive) -> None:
    script = footsteps.load(scripts.ready()["walk"], drive.robot)
    drive.run(script)
    assert drive.mode is Mode.SCRIPT
    assert len(drive.view().prints) == 6
    at = go(drive, footsteps.duration(script) + 0.1)
    assert drive.mode is Mode.STEER
    assert "over" in drive.note
    assert at[0] == pytest.approx(0.45, abs=0.05)  # bent knees carry the centre of mass ahead of the trunk
    drive.run(script, loop=True)
    go(drive, footsteps.duration(script) + 0.5)
    assert drive.mode is Mode.SCRIPT
    assert drive.data.qpos[0] < 0.3
    drive.steer(ahead=1.0)
    assert drive.mode is Mode.STEER


def test_a_drive_written_down_drives_the_same_way(drive: Drive, shipped: policy.Policy) -> None:
    drive.steer(ahead=1.0)
    go(drive, 2.0)
    drive.steer(turn=1.0, lift=0.1)
    go(drive, 2.0)
    drive.stop()
    go(drive, 1.5)
    drive.steer(trunk_height=0.7)
    at = go(drive, 2.5)
    script = footsteps.parse(drive.as_script(), drive.robot, "drive")
    again = Drive(policy.Controller(shipped))
    again.run(script)
    there = go(again, footsteps.duration(script))
    assert np.abs(there - at).max() < 0.02
    assert again.mode is not Mode.FALLEN


def test_a_view_does_not_change_later(drive: Drive) -> None:
    view = drive.view()
    before = view.qpos.copy()
    drive.steer(ahead=1.0)
    go(drive, 1.0)
    assert np.array_equal(view.qpos, before)
    assert view.time == 0.0


def test_what_was_planned_ahead_is_taken_and_a_later_wish_voids_it(shipped: policy.Policy) -> None:
    """Task steps are those of a drive that plans when a step is over."""
    ahead, otherwise = (Drive(policy.Controller(shipped)) for _ in range(2))
    for drive in (ahead, otherwise):
        drive.steer(ahead=1.0)
        go(drive, 0.3)
    ahead.plan_ahead()
    found = ahead._answered
    assert found is not None
    go(ahead, 0.55)
    assert ahead.step is found[1][0].step
    go(otherwise, 0.55)
    for drive in (ahead, otherwise):
        drive.plan_ahead() if drive is ahead else None
        drive.steer(ahead=0.0, turn=1.0)
        go(drive, 2.0)
    for mine, theirs in zip(ahead.taken, otherwise.taken, strict=True):
        assert max(np.abs(part).max() for part in nodes.difference(mine.end, theirs.end)) == 0.0


def test_a_loop_is_written_down_once(drive: Drive) -> None:
    script = footsteps.load(scripts.ready()["walk"], drive.robot)
    drive.run(script, loop=True)
    go(drive, footsteps.duration(script) + 0.1)
    assert len(drive.taken) == 1
