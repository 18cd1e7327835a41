"""Task steps from what is asked for, worked by hand. Feet begin at (0, ±0.1), the ankles 0.04 m above their soles."""

import math

import mujoco
import numpy as np
import pytest

from bipedtrack import footsteps, kinematics, rotations, sampling, steering
from bipedtrack import robot as robots
from bipedtrack.footholds import Foothold
from bipedtrack.footsteps import Box
from bipedtrack.nodes import Nodes, ankles_in_trunk_frame
from bipedtrack.steering import Steering


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
        # where training has a sign for the direction, a drive has a wish, and the least step worth making
        least = {"step_length": 0.02, "sidle_length": 0.02, "turn_angle": 0.02}.get(mine, low)
        assert steering.LIMITS[mine][0] == least


def test_wishes_are_clamped_and_nonsense_becomes_the_default() -> None:
    asked = steering.clamped(Steering(ahead=7.0, period=99.0, lift=-1.0, trunk_height=math.nan))
    assert (asked.ahead, asked.period, asked.lift, asked.trunk_height) == (1.0, 0.7, 0.04, footsteps.TRUNK_HEIGHT)


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


def test_a_trunk_beyond_reach_is_brought_back_or_stays(robot: robots.Robot) -> None:
    start = footsteps.initial_nodes(robot)
    near, note = steering.lean(robot, (), start, Steering(trunk_height=0.7, trunk_roll=0.05))
    assert near is not None and (near.trunk_height, near.trunk_roll, note) == (0.7, 0.05, "")
    # so far apart that no leg reaches the ground with the trunk at 0.79 m
    wide = start._replace(ankle_positions=np.array([[0.0, 0.42, 0.04], [0.0, -0.42, 0.04]]))
    high, note = steering.lean(robot, (), wide, Steering(trunk_height=0.79))
    assert high is not None and 0.77 < high.trunk_height < 0.79 and "brought back within reach" in note
    assert not footsteps.problems_of(robot, (), steering.trunk_step(robot, wide, high))
    # one foot on 0.25 m, where even the default is out of reach: it stays, and says why
    block = (Box(0.4, 0.1, 0, 0, 0.5, 0.2, 0.25),)
    apart = start._replace(ankle_positions=np.array([[0.4, 0.10, 0.29], [-0.3, -0.10, 0.04]]))
    none, note = steering.lean(robot, block, apart, Steering(trunk_roll=0.05))
    assert none is None and "stays where it is: the" in note
    planned, left = steering.following(robot, block, apart, steering.Wishes(steering=Steering(trunk_roll=0.05), trunk=True))
    assert np.array_equal(planned.step.end.trunk_position, apart.trunk_position) and planned.note == note and not left.trunk


def test_a_walk_steps_over_what_only_the_edge_of_a_sole_would_meet(robot: robots.Robot) -> None:
    # a bar of 10 cm beside the way, a centimetre of it in the way of the left sole
    bar = Box(0.6, 0.24, 0, 0, 0.05, 0.2, 0.10)
    start = footsteps.initial_nodes(robot)
    for index in range(12):
        planned = steering.walk(robot, (bar,), start, index % 2, Steering(ahead=1))
        assert "no step" not in planned.note
        start = planned.step.end
    assert start.trunk_position[0] > 0.9
