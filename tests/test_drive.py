"""The shipped policy under somebody's hands, driven without a page."""

import dataclasses
import math
import sys

import numpy as np
import pytest

from bipedtrack import drive as drives
from bipedtrack import footsteps, nodes, paths, policy, rotations, scripts
from bipedtrack import robot as robots
from bipedtrack.drive import Drive, Mode
from bipedtrack.footholds import Foothold
from bipedtrack.footsteps import Box
from bipedtrack.steering import FULL_SWAY


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


@pytest.mark.parametrize("wish", ["stop", "ahead", "aside", "trunk_height", "lead", "place"])
def test_a_foot_that_a_script_holds_up_comes_down_first(drive: Drive, robot: robots.Robot, wish: str) -> None:
    drive.run(footsteps.load(scripts.ready()["one-legged-stance"], robot))
    go(drive, 2.5)  # 1.5 s lead to the left foot in the air, which is held there for 3 s
    {
        "stop": drive.stop,
        "ahead": lambda: drive.steer(ahead=1.0),
        "aside": lambda: drive.steer(aside=-1.0),  # which the right foot would begin
        "trunk_height": lambda: drive.steer(trunk_height=0.7),
        "lead": drive.lead,
        "place": lambda: drive.place(Foothold(1, 0.1, -0.1, 0.0)),
    }[wish]()
    go(drive, 3.0)
    assert drive.mode is Mode.STEER
    steps = footsteps.parse(drive.as_script(), robot, "drive").steps
    feet = [int(np.argmax(step.swing)) for step in steps if step.swing.any()]
    assert feet[:2] == [0, 0]  # up, and down again
    assert (len(feet) > 2) == (wish in ("ahead", "aside")) and feet[2:3] in ([], [1])


def test_holds_in_a_row_are_one(drive: Drive) -> None:
    go(drive, 3.0)
    assert len(drive.taken) == 1
    assert footsteps.duration(footsteps.parse(drive.as_script(), drive.robot, "drive")) == pytest.approx(3.1)
    drive.steer(ahead=1.0)
    go(drive, 0.4)
    drive.stop()
    go(drive, 3.0)
    swings = [step.swing.any() for step in drive.taken]
    assert swings == [False, True, True, False]
    seconds = sum(float(step.period) for step in drive.taken)
    assert seconds == pytest.approx(6.4, abs=0.11)  # the hold under way ends later
    drive.data.qvel[:3] = 20.0  # falls while it holds
    go(drive, 1.0)
    drive.stand_up()
    assert sum(float(step.period) for step in drive.taken) == pytest.approx(seconds, abs=0.21)


def test_the_trunk_sways_as_the_policy_learned_it(shipped: policy.Policy) -> None:
    """In the middle of the first step, on the spot: by 0.1 - 0.1 / cosh(w T / 2) m to the stance foot, or not at all."""
    for sway in (0.0, 0.5, 1.0):
        drive = Drive(policy.Controller(dataclasses.replace(shipped, sway=sway)))
        drive.steer(ahead=1.0, step_length=0.02, period=0.5)
        while not drive.step.swing.any():
            drive.advance()
        go(drive, 0.25)
        expected = 0.1 - 0.1 / math.cosh(sway * drive.step.pendulum * 0.25)
        assert abs(drive.target.trunk_position[1]) == pytest.approx(expected, abs=2e-3)


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
    still, yaw = drive.data.qvel[axis], rotations.to_euler(drive.data.qpos[3:7])[2]
    drive.push(15.0, direction)
    impulse = np.zeros(3)
    for _ in range(round(drives.PUSH_SECONDS / drive.timestep)):
        drive.advance()
        impulse += drive.data.body("trunk").xfrc_applied[:3] * drive.timestep
    angle = yaw + math.radians(direction)
    assert impulse == pytest.approx([15 * math.cos(angle), 15 * math.sin(angle), 0], abs=1e-4)  # N s
    assert sign * (drive.data.qvel[axis] - still) > 0.1  # legs and ground take their share
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
    script = footsteps.parse(drive.as_script(), drive.robot, "drive", FULL_SWAY)
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
