"""Feedback-error learning: its gradient by hand, and a robot in MuJoCo C that stands where it should after descending it."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from commands import still

from bipedtrack import control, feedback_error, footsteps, observation
from bipedtrack.control import ControlConfig
from bipedtrack.nodes import Nodes
from bipedtrack.robot import Robot
from bipedtrack.rotations import from_euler

PARTS = observation.layout()


def unrolls(robot: Robot, errors: np.ndarray, timers: np.ndarray) -> np.ndarray:
    """Observations (robots, steps, 101) whose joints are `errors`, (robots, steps, 12) half ranges, short of 0.3."""
    flat = np.random.default_rng(1).normal(size=(*errors.shape[:2], observation.SIZE)).astype(np.float32)
    flat[..., PARTS["feedforward"]] = 0.3
    flat[..., PARTS["joint_positions"]] = robot.joint_middle + robot.joint_half_range * (0.3 - errors)
    flat[..., PARTS["timer"]] = timers[..., None] * [0.0, 1.0]
    return flat


def test_its_gradient_is_minus_the_mean_error_of_unrolls_in_which_the_robot_stands_or_squats_slowly(robot: Robot) -> None:
    errors = np.random.default_rng(0).uniform(-0.01, 0.01, (5, 5, 12))
    errors[0, :, 4] = 0.2  # more than is followed
    timers = np.zeros((5, 5))
    timers[1, 3] = 0.1  # the right foot swings in one step of five
    flat = unrolls(robot, errors, timers)
    flat[..., PARTS["trunk_velocity_target"]] = [0.0, 0.0, 0.08]
    flat[4, ::2, PARTS["trunk_velocity_target"]] = [0.0, 0.12, 0.09]  # 0.122 m/s on average
    flat[..., PARTS["trunk_velocity"]] = flat[..., PARTS["trunk_velocity_target"]] + [0.0, 0.03, 0.04]
    flat[2, 2:, PARTS["trunk_velocity"]] += [0.2, 0.0, 0.0]  # 0.143 m/s on average
    slope = jax.grad(lambda a: feedback_error.loss(robot, jnp.asarray(flat), a))(jnp.ones((5, 5, 12)))
    for i in range(5):
        for step in range(5):
            for joint in range(12):
                wanted = 0.02 if (i, joint) == (0, 4) else sum(errors[i, :, joint]) / 5
                assert slope[i, step, joint] == pytest.approx(-wanted / 25 if i in (0, 3) else 0.0, abs=1e-7)


def test_descending_it_makes_a_robot_stand_where_it_should(robot: Robot, mj_model: mujoco.MjModel) -> None:
    """The action is a constant here, corrected after every 32 steps of 0.02 s; at first the weight bends the knees."""
    settings = ControlConfig(level_feet=True)
    ankles = np.array([[0.0, 0.1, 0.04], [0.0, -0.1, 0.04]])
    nodes = Nodes(np.array([0.0, 0.0, 0.7]), from_euler(0.0, 0.1, 0.0), ankles, np.zeros(2))
    nodes = footsteps.balanced(robot, nodes, np.array([0.03, 0.01]))
    a_ff = control.feedforward(robot, settings, nodes)
    command = still(nodes)
    data, state, action, missed = mujoco.MjData(mj_model), control.initial(a_ff), np.zeros(12), []
    data.qpos[:] = np.concatenate([nodes.trunk_position, nodes.trunk_orientation, control.denormalize(robot, a_ff)])
    for _ in range(16):
        flat = np.zeros((1, 32, observation.SIZE), np.float32)
        flat[..., PARTS["feedforward"]] = a_ff
        for step in range(32):
            for _ in range(4):
                feedback = settings.feedback_scale * action
                now = data.qpos, data.qvel
                data.ctrl[:], state = control.respond(robot, settings, state, a_ff, feedback, command, *now)
                mujoco.mj_step(mj_model, data)
            flat[0, step, PARTS["joint_positions"]] = data.qpos[7:]
        missed.append(100 * np.linalg.norm(data.qpos[:3] - nodes.trunk_position))
        slope = jax.grad(lambda a, seen=flat: feedback_error.loss(robot, jnp.asarray(seen), a))(jnp.zeros((1, 32, 12)))
        action -= 8 * np.asarray(slope).sum(axis=(0, 1))
    assert missed[0] > 1.0 and missed[-1] < 0.2  # cm
