"""The control law: eqs (4)-(7) by hand, and what the filter does to a step and to a ramp."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from commands import still
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from bipedtrack import control, footsteps, kinematics
from bipedtrack.control import ControlConfig
from bipedtrack.nodes import Nodes
from bipedtrack.robot import Robot, build_model

KNEE, RIGHT_ANKLE_ROLL = 3, 11
ZERO = np.zeros(12)
SHARES = st.lists(st.floats(-1, 1), min_size=12, max_size=12).map(np.array)


def standing(roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0, at: tuple = (0.0, 0.0)) -> Nodes:
    """Feet 0.2 m apart and turned by yaw, the trunk 0.75 m above them."""
    c, s = math.cos(yaw), math.sin(yaw)
    place = np.array([*at, 0.0])
    return Nodes(
        trunk_position=place + [0, 0, 0.75],
        trunk_orientation=Rotation.from_euler("xyz", [roll, pitch, yaw]).as_quat(scalar_first=True),
        ankle_positions=place + np.array([[-0.1 * s, 0.1 * c, 0.04], [0.1 * s, -0.1 * c, 0.04]]),
        ankle_yaws=np.array([yaw, yaw]),
    )


def test_normalization_maps_a_joints_range_to_minus_one_and_one(robot: Robot) -> None:
    joints = robot.joint_middle.copy()
    assert control.normalize(robot, joints) == pytest.approx(ZERO)
    assert control.normalize(robot, robot.joint_low) == pytest.approx(ZERO - 1)
    assert control.normalize(robot, robot.joint_high) == pytest.approx(ZERO + 1)
    joints[KNEE] = math.radians(105)  # of 0..140: three quarters of the way
    joints[RIGHT_ANKLE_ROLL] = math.radians(-12)  # of -30..30
    normalized = control.normalize(robot, joints)
    assert normalized[[KNEE, RIGHT_ANKLE_ROLL]] == pytest.approx([0.5, -0.4])


@given(st.lists(st.floats(-3, 3), min_size=12, max_size=12).map(np.array))
def test_denormalization_undoes_normalization(robot: Robot, joints: np.ndarray) -> None:
    assert control.denormalize(robot, control.normalize(robot, joints)) == pytest.approx(joints, abs=1e-12)


def test_mixing_worked_by_hand(robot: Robot) -> None:
    a_ff, a_fb = ZERO.copy(), ZERO.copy()
    a_ff[KNEE], a_fb[KNEE] = 0.2, -0.5  # 0.2 - 0.3 x 0.5 = 0.05 of 70 deg above the middle of 70 deg
    a_fb[RIGHT_ANKLE_ROLL] = 1.0  # 0.3 of 30 deg
    unfiltered = ControlConfig(filter=1.0)
    targets, state = control.joint_targets(robot, unfiltered, control.initial(ZERO), a_ff, a_fb)
    expected = robot.joint_middle.copy()
    expected[KNEE], expected[RIGHT_ANKLE_ROLL] = math.radians(73.5), math.radians(9)
    assert targets == pytest.approx(expected)
    assert state.filtered[KNEE] == pytest.approx(0.05)


def test_filter_worked_by_hand(robot: Robot) -> None:
    settings = ControlConfig(filter=0.4)
    before, a_ff, a_fb = ZERO.copy(), ZERO.copy(), ZERO.copy()
    before[KNEE], a_ff[KNEE], a_fb[KNEE] = -0.3, 0.2, 0.5
    targets, state = control.joint_targets(robot, settings, control.initial(before), a_ff, a_fb)
    assert state.filtered[KNEE] == pytest.approx(0.4 * (0.2 + 0.3 * 0.5) + 0.6 * -0.3)
    assert targets[KNEE] == pytest.approx(math.radians(70 + 70 * (0.14 - 0.18)))


@pytest.mark.parametrize("alpha", [0.1, 0.4, 1.0])
def test_step_response_is_that_of_a_first_order_low_pass(robot: Robot, alpha: float) -> None:
    settings, state = ControlConfig(filter=alpha), control.initial(ZERO)
    a_ff = np.linspace(-0.9, 0.9, 12)
    for n in range(1, 30):
        targets, state = control.joint_targets(robot, settings, state, a_ff, ZERO)
        share = 1 - (1 - alpha) ** n
        assert targets == pytest.approx(robot.joint_middle + robot.joint_half_range * a_ff * share)


def test_targets_are_clamped_to_the_ranges_and_leave_them_at_once(robot: Robot) -> None:
    settings, state = ControlConfig(filter=0.4), control.initial(ZERO)
    ones = np.ones(12)
    for _ in range(50):
        targets, state = control.joint_targets(robot, settings, state, ones, ones)  # asks for 1.3
    assert targets == pytest.approx(robot.joint_high)
    # what was beyond the clamp is not remembered
    targets, state = control.joint_targets(robot, settings, state, ZERO, ZERO)
    assert state.filtered == pytest.approx(0.6 * ones)
    for _ in range(50):
        targets, state = control.joint_targets(robot, settings, state, -ones, -ones)
    assert targets == pytest.approx(robot.joint_low)


@given(SHARES, SHARES, SHARES, st.floats(0.01, 1))
def test_targets_stay_within_the_ranges(
    robot: Robot, before: np.ndarray, a_ff: np.ndarray, a_fb: np.ndarray, alpha: float
) -> None:
    settings = ControlConfig(filter=alpha, integral=50.0)
    state = control.integrate(robot, settings, control.initial(before), 5 * a_ff, robot.joint_middle, ZERO, np.array(True))
    targets, _ = control.joint_targets(robot, settings, state, 5 * a_ff, a_fb)
    assert (targets >= robot.joint_low - 1e-12).all()
    assert (targets <= robot.joint_high + 1e-12).all()


@given(SHARES)
def test_a_controller_that_has_settled_goes_on_asking_for_the_same(robot: Robot, asked: np.ndarray) -> None:
    for velocity_feedforward in (False, True):
        settings = ControlConfig(filter=0.4, velocity_feedforward=velocity_feedforward)
        targets, state = control.joint_targets(robot, settings, control.initial(asked), asked, ZERO)
        assert targets == pytest.approx(control.denormalize(robot, asked), abs=1e-12)
        assert state.filtered == pytest.approx(asked, abs=1e-12)


def test_velocity_feedforward_adds_the_velocity_over_kp_times_kd(robot: Robot) -> None:
    velocity = np.linspace(-1, 1, 12)  # rad/s
    start = robot.joint_middle
    plain, ahead = ControlConfig(), ControlConfig(velocity_feedforward=True)
    states = [control.initial(control.normalize(robot, start))] * 2
    for n in range(1, 20):
        a_ff = control.normalize(robot, start + velocity * 0.005 * n)
        without, states[0] = control.joint_targets(robot, plain, states[0], a_ff, ZERO)
        with_it, states[1] = control.joint_targets(robot, ahead, states[1], a_ff, ZERO)
        assert with_it - without == pytest.approx(0.05 * velocity)  # kd/kp is 50 ms at every joint


def test_velocity_feedforward_begins_at_zero_wherever_the_robot_stands(robot: Robot) -> None:
    stands, a_ff = np.linspace(-0.5, 0.5, 12), np.linspace(0.5, -0.5, 12)
    state = control.initial(stands, a_ff)
    targets, _ = control.joint_targets(robot, ControlConfig(filter=0.4, velocity_feedforward=True), state, a_ff, ZERO)
    # the filter starts from where the robot stands
    assert targets == pytest.approx(control.denormalize(robot, 0.4 * a_ff + 0.6 * stands))
    assert control.initial(3 * stands).filtered == pytest.approx(np.clip(3 * stands, -1, 1))


def test_integral_grows_with_what_the_joints_miss_stops_at_its_limit_and_fades_in_motion(robot: Robot) -> None:
    settings, state = ControlConfig(integral=2.0), control.initial(ZERO)
    joints, ones = robot.joint_middle - 0.02 * robot.joint_half_range, np.ones(12)  # every joint stays 0.02 below
    stand, step = np.array(True), np.array(False)
    for n in range(1, 101):
        state = control.integrate(robot, settings, state, ZERO, joints, ZERO, stand)
        assert state.integral == pytest.approx(2.0 * 0.02 * 0.005 * n * ones)
    targets, state = control.joint_targets(robot, ControlConfig(filter=1.0), state, ZERO, ZERO)
    assert targets == pytest.approx(robot.joint_middle + 0.02 * robot.joint_half_range)
    for _ in range(1000):
        state = control.integrate(robot, settings, state, ZERO, joints, ZERO, stand)
    assert state.integral == pytest.approx(control.INTEGRAL_LIMIT * ones)
    above = control.integrate(robot, settings, state, ZERO, robot.joint_middle + robot.joint_half_range, ZERO, stand)
    assert above.integral == pytest.approx((control.INTEGRAL_LIMIT - 0.01) * ones)  # it leaves the limit at once
    fast = ZERO.copy()
    fast[KNEE] = 0.31  # rad/s
    assert control.integrate(robot, settings, state, ZERO, robot.joint_middle, fast, stand).integral == pytest.approx(
        state.integral
    )
    for _ in range(40):  # 0.2 s
        state = control.integrate(robot, settings, state, ZERO, joints, ZERO, step)
    assert state.integral == pytest.approx(control.INTEGRAL_LIMIT * math.exp(-1) * ones, rel=0.02)


@pytest.mark.parametrize("integral", [0.0, 3.0])
def test_the_integral_takes_away_what_a_load_leaves_a_pd(robot: Robot, integral: float) -> None:
    """MuJoCo's robot hangs by its trunk in space, with a constant torque on every joint: a PD alone gives by load / kp."""
    settings, model, load = ControlConfig(integral=integral), build_model("ranger_max"), 2.0
    model.opt.gravity[:] = 0.0
    data = mujoco.MjData(model)
    asked = np.resize([0.1, -0.2, 0.3], 12)
    start = np.concatenate([[0, 0, 5, 1, 0, 0, 0], control.denormalize(robot, asked)])
    data.qpos[:], data.qfrc_applied[6:], state = start, load, control.initial(asked)
    for _ in range(1000):
        state = control.integrate(robot, settings, state, asked, data.qpos[7:], data.qvel[6:], np.array(True))
        data.ctrl[:], state = control.joint_targets(robot, settings, state, asked, ZERO)
        mujoco.mj_step(model, data)
        data.qpos[:7], data.qvel[:6] = start[:7], 0.0
    missed = data.qpos[7:] - start[7:]
    assert missed == pytest.approx(np.zeros(12) if integral else load / robot.kp, abs=1e-4)


def test_feedforward_of_standing_is_the_models_keyframe(robot: Robot, mj_model: mujoco.MjModel) -> None:
    a_ff = control.feedforward(robot, ControlConfig(), standing())
    assert control.denormalize(robot, a_ff) == pytest.approx(mj_model.key("stand").ctrl, abs=1e-6)


@given(st.floats(-3, 3), st.floats(-5, 5), st.floats(-5, 5))
def test_feedforward_does_not_depend_on_place_and_heading(robot: Robot, yaw: float, x: float, y: float) -> None:
    settings = ControlConfig()
    there = control.feedforward(robot, settings, standing(yaw=yaw, at=(x, y)))
    assert there == pytest.approx(control.feedforward(robot, settings, standing()), abs=1e-9)


@pytest.mark.parametrize("level_feet", [False, True])
def test_feet_are_parallel_to_the_trunk_or_to_the_ground(robot: Robot, mj_model: mujoco.MjModel, level_feet: bool) -> None:
    target = standing(roll=0.1, pitch=-0.2)
    a_ff = control.feedforward(robot, ControlConfig(level_feet=level_feet), target)
    data = mujoco.MjData(mj_model)
    data.qpos[:] = np.concatenate([target.trunk_position, target.trunk_orientation, control.denormalize(robot, a_ff)])
    mujoco.mj_kinematics(mj_model, data)
    up = [0, 0, 1] if level_feet else data.body("trunk").xmat[[2, 5, 8]]
    for foot, ankle in (("left_foot", 0), ("right_foot", 1)):
        assert data.body(foot).xpos == pytest.approx(target.ankle_positions[ankle], abs=1e-9)
        assert data.body(foot).xmat[[2, 5, 8]] == pytest.approx(up, abs=1e-9)


@pytest.mark.parametrize("level_feet", [False, True])
@given(st.lists(st.floats(-1e6, 1e6), min_size=6, max_size=6))
def test_feedforward_of_a_target_out_of_reach_stays_within_the_ranges(
    robot: Robot, level_feet: bool, numbers: list[float]
) -> None:
    target = standing(roll=0.3)._replace(ankle_positions=np.reshape(numbers, (2, 3)))
    a_ff = control.feedforward(robot, ControlConfig(level_feet=level_feet), target)
    assert (np.abs(a_ff) <= 1 + 1e-6).all()


def state_with_a_foot_beside_its_foothold(robot: Robot, settings: ControlConfig) -> tuple[Nodes, np.ndarray]:
    """A target, and qpos (19,) of a robot whose trunk is at it, its left foot 3 cm and 0.2 rad off."""
    target = footsteps.balanced(robot, standing(at=(1.0, 2.0), yaw=0.5), np.array([1.0, 2.0]))
    ankles, yaws = target.ankle_positions.copy(), target.ankle_yaws.copy()
    ankles[0, :2] += 0.024, 0.018
    yaws[0] += 0.2
    beside = control.feedforward(robot, settings, target._replace(ankle_positions=ankles, ankle_yaws=yaws))
    return target, np.concatenate([target.trunk_position, target.trunk_orientation, control.denormalize(robot, beside)])


def feet_in_mujoco(mj_model: mujoco.MjModel, qpos: np.ndarray) -> list[np.ndarray]:
    """Place (3,) and orientation (9,) of the left and the right foot."""
    data = mujoco.MjData(mj_model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(mj_model, data)
    return [part for foot in ("left_foot", "right_foot") for part in (data.body(foot).xpos, data.body(foot).xmat)]


def test_anchor_keeps_the_feet_where_they_were_when_command_and_robot_last_moved(
    robot: Robot, mj_model: mujoco.MjModel
) -> None:
    settings, fast = ControlConfig(level_feet=True), np.where(np.arange(12) == KNEE, 0.31, 0.0)
    target, start = state_with_a_foot_beside_its_foothold(robot, settings)
    rests, moves = np.array(True), np.array(False)
    first, began = control.anchor(robot, control.initial(ZERO), target, start, ZERO, rests)
    assert [*first.ankle_positions.flat, *began.beside.flat] == pytest.approx([*target.ankle_positions.flat, *[0.0] * 8])
    for velocities, told in ((ZERO, moves), (fast, rests), (fast, moves)):
        _, state = control.anchor(robot, began, target, start, velocities, told)
        assert state.beside == pytest.approx(np.array([[0.024, 0.018, 0, 0.2], [0, 0, 0, 0]]), abs=1e-9)
        # the trunk leaves its target, and the feet creep
        crept = np.concatenate([start[:3] + [0.02, 0.01, -0.03], start[3:7], start[7:] + 0.01])
        wanted, kept = control.anchor(robot, state, target, crept, ZERO, rests)
        assert kept.beside == pytest.approx(state.beside, abs=0)
        joints = control.denormalize(robot, control.feedforward(robot, settings, wanted))
        placed = feet_in_mujoco(mj_model, np.concatenate([target.trunk_position, target.trunk_orientation, joints]))
        for found, expected in zip(placed, feet_in_mujoco(mj_model, start), strict=True):
            assert found == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("turned", [-0.1, 0.1])
def test_anchor_measures_a_foots_turn_the_short_way_round(robot: Robot, turned: float) -> None:
    _, start = state_with_a_foot_beside_its_foothold(robot, ControlConfig())
    target = kinematics.measure(robot, start)
    target = target._replace(ankle_yaws=target.ankle_yaws - turned + 2 * math.pi)
    _, state = control.anchor(robot, control.initial(ZERO), target, start, ZERO, np.array(False))
    assert state.beside[:, 3] == pytest.approx([turned, turned])


def test_the_integral_brings_the_trunk_to_its_target_with_a_foot_beside_its_foothold(
    robot: Robot, mj_model: mujoco.MjModel
) -> None:
    """MuJoCo's robot stands for 10 s without a network; aimed at the foothold, the trunk would stay 1.3 cm off."""
    settings = ControlConfig(level_feet=True, gravity_feedforward=True, integral=0.5)
    target, start = state_with_a_foot_beside_its_foothold(robot, settings)
    a_ff, stands = control.feedforward(robot, settings, target), still(target)
    arrives = stands._replace(rates=jax.tree.map(np.ones_like, stands.rates))
    data, state = mujoco.MjData(mj_model), control.initial(control.normalize(robot, start[7:]), a_ff)
    data.qpos[:] = start
    for tick in range(2000):
        command = stands if tick else arrives
        data.ctrl[:], state = control.respond(robot, settings, state, a_ff, ZERO, command, data.qpos, data.qvel)
        mujoco.mj_step(mj_model, data)
        if tick == 1000:
            before = kinematics.measure(robot, data.qpos.copy())
    after = kinematics.measure(robot, data.qpos)
    assert after.trunk_position == pytest.approx(target.trunk_position, abs=0.001)
    assert after.ankle_positions == pytest.approx(before.ankle_positions, abs=0.002)
    assert np.linalg.norm(after.ankle_positions[0] - target.ankle_positions[0]) > 0.015


def test_jax_gives_numpys_joint_targets(robot: Robot) -> None:
    single = robot.cast(np.float32)
    settings = ControlConfig(level_feet=True, velocity_feedforward=True, integral=1.0)
    random = np.random.default_rng(0)
    joints = random.uniform(robot.joint_low, robot.joint_high, (200, 12)).astype(np.float32)
    qvel = random.uniform(-1, 1, (200, 18)).astype(np.float32)
    qvel[::3] *= 0.3  # slow enough to rest
    commands, qpos = [], []
    for n in range(200):
        roll, pitch, yaw, *at = random.uniform(-0.3, 0.3, 5)
        target = standing(roll, pitch, yaw, tuple(at))
        target = target._replace(ankle_positions=target.ankle_positions + random.uniform(-0.1, 0.1, (2, 3)))
        rests = still(target)
        commands.append(rests._replace(rates=jax.tree.map(lambda x, share=n % 2: x + share, rests.rates)))
        qpos.append(np.concatenate([target.trunk_position, target.trunk_orientation, joints[n]], dtype=np.float32))
    commands = jax.tree.map(lambda x: np.asarray(x, np.float32), commands)
    before, a_fb = random.uniform(-1, 1, (2, 200, 12)).astype(np.float32)

    def run(command: Any, qpos: Any, qvel: Any, before: Any, a_fb: Any) -> tuple:
        a_ff = control.feedforward(single, settings, command.target)
        state = control.initial(before)._replace(integral=0.1 * a_fb, beside=0.1 * before[:8].reshape(2, 4))
        return a_ff, *control.respond(single, settings, state, a_ff, a_fb, command, qpos, qvel)

    in_jax = jax.jit(jax.vmap(run))(jax.tree.map(lambda *x: jnp.stack(x), *commands), np.stack(qpos), qvel, before, a_fb)
    in_numpy = jax.tree.map(lambda *x: np.stack(x), *map(run, commands, qpos, qvel, before, a_fb))
    # the velocity feedforward differentiates: kd/kp over 5 ms multiplies the rounding by ten
    for found, expected in zip(jax.tree.leaves(in_jax), jax.tree.leaves(in_numpy), strict=True):
        assert found.dtype == expected.dtype == np.float32
        assert np.asarray(found) == pytest.approx(expected, abs=5e-5)


@pytest.mark.parametrize(
    ("name", "value"), [("filter", 0.0), ("filter", 1.1), ("feedback_scale", 0.0), ("filter", math.nan), ("integral", -1.0)]
)
def test_settings_that_make_no_sense_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        dataclasses.replace(ControlConfig(), **{name: value})
