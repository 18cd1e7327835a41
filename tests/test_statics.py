"""Static torques against MuJoCo's gravity and its Jacobians of the points where the feet push; balance on one foot."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from commands import still

from bipedtrack import control, footsteps, statics
from bipedtrack.control import ControlConfig
from bipedtrack.nodes import Nodes
from bipedtrack.robot import Robot
from bipedtrack.rotations import from_euler


def posture(robot: Robot, seed: int) -> Nodes:
    """Feet apart and turned, a tilted trunk, the centre of mass somewhere over the feet."""
    random = np.random.default_rng(seed)
    ankles = np.array([[0.0, 0.1, 0.04], [0.0, -0.1, 0.04]]) + random.uniform(-0.04, 0.04, (2, 3)) * [1, 1, 0]
    roll, pitch, yaw = random.uniform(-0.15, 0.15, 3)
    nodes = Nodes(
        np.array([0.0, 0.0, random.uniform(0.6, 0.77)]), from_euler(roll, pitch, yaw), ankles, random.uniform(-0.2, 0.2, 2)
    )
    return footsteps.balanced(robot, nodes, ankles.mean(axis=0)[:2] + random.uniform(-0.03, 0.03, 2))


def placed(robot: Robot, model: mujoco.MjModel, nodes: Nodes, level_feet: bool) -> tuple[np.ndarray, mujoco.MjData]:
    """The joint angles (12,), rad, of a robot on its nodes, and MuJoCo with it at rest there."""
    joints = control.denormalize(robot, control.feedforward(robot, ControlConfig(level_feet=level_feet), nodes))
    data = mujoco.MjData(model)
    data.qpos[:] = np.concatenate([nodes.trunk_position, nodes.trunk_orientation, joints])
    mujoco.mj_forward(model, data)
    return joints, data


@pytest.mark.parametrize("stands", [(True, True), (True, False), (False, True), (False, False)])
@pytest.mark.parametrize("seed", range(5))
def test_torques_are_those_of_mujocos_gravity_and_jacobians(
    robot: Robot, mj_model: mujoco.MjModel, seed: int, stands: tuple[bool, bool]
) -> None:
    """With the forces that the load says, MuJoCo's trunk is held up too: nothing is left over in any of 18 equations."""
    nodes = posture(robot, seed)
    joints, data = placed(robot, mj_model, nodes, level_feet=True)
    weight = 9.81 * mj_model.body_subtreemass[0]
    ankles = np.array([data.body(f"{leg}_foot").xpos for leg in ("left", "right")])
    centre = data.subtree_com[0]
    line = (ankles[0] - ankles[1])[:2]
    share = (centre - ankles[1])[:2] @ line / (line @ line)
    beside = centre[:2] - share * ankles[0, :2] - (1 - share) * ankles[1, :2]
    forces = [share, 1 - share] if all(stands) else [float(foot) for foot in stands]
    left_over = data.qfrc_bias.copy()
    for leg, ankle, force in zip(("left", "right"), ankles, forces, strict=True):
        jacobian = np.zeros((3, mj_model.nv))
        point = ankle + (np.append(beside, 0.0) if all(stands) else 0.0)
        mujoco.mj_jac(mj_model, data, jacobian, None, point, data.body(f"{leg}_foot").id)
        left_over -= jacobian[2] * force * weight
    found = statics.load(robot, joints, nodes.trunk_orientation, np.array(stands))
    assert found == pytest.approx(left_over[6:], abs=1e-9)
    assert np.abs(found).max() > 1.0
    if all(stands):
        assert left_over[:6] == pytest.approx(np.zeros(6), abs=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_with_it_a_robot_without_feedback_stands_where_it_should(robot: Robot, mj_model: mujoco.MjModel, seed: int) -> None:
    nodes = posture(robot, seed)
    command = still(nodes)
    missed = []
    for gravity_feedforward in (False, True):
        settings, data = ControlConfig(level_feet=True, gravity_feedforward=gravity_feedforward), mujoco.MjData(mj_model)
        a_ff = control.feedforward(robot, settings, nodes)
        data.qpos[:] = np.concatenate([nodes.trunk_position, nodes.trunk_orientation, control.denormalize(robot, a_ff)])
        state = control.initial(a_ff)
        for _ in range(400):
            data.ctrl[:], state = control.respond(robot, settings, state, a_ff, np.zeros(12), command, data.qpos, data.qvel)
            mujoco.mj_step(mj_model, data)
        missed.append(100 * np.linalg.norm(data.qpos[:3] - nodes.trunk_position))
    assert missed[0] > 1.0 and missed[1] < 0.5  # cm


def test_jax_gives_numpys_torques(robot: Robot) -> None:
    single, random = robot.cast(np.float32), np.random.default_rng(0)
    joints = random.uniform(robot.joint_low, robot.joint_high, (100, 12)).astype(np.float32)
    tilts = np.array([from_euler(*random.uniform(-0.5, 0.5, 3)) for _ in joints], np.float32)
    stands = random.random((100, 2)) < 0.5
    in_jax = jax.vmap(lambda *given: statics.load(single, *given))(*map(jnp.asarray, (joints, tilts, stands)))
    in_numpy = [statics.load(single, *given) for given in zip(joints, tilts, stands, strict=True)]
    assert in_jax.dtype == in_numpy[0].dtype == np.float32
    np.testing.assert_allclose(in_jax, in_numpy, atol=1e-3)


@pytest.mark.parametrize("foot", [0, 1])
@pytest.mark.parametrize("seed", range(3))
def test_a_pendulum_balances_mujocos_centre_of_mass_over_the_foot(
    robot: Robot, mj_model: mujoco.MjModel, seed: int, foot: int
) -> None:
    nodes = posture(robot, seed)
    _, data = placed(robot, mj_model, nodes, level_feet=False)
    pivot, frequency = statics.pendulum(robot, nodes, foot)
    moved = data.subtree_com[0][:2] + pivot - nodes.trunk_position[:2]
    assert moved == pytest.approx(nodes.ankle_positions[foot, :2], abs=3e-4)
    assert frequency**2 * data.subtree_com[0][2] == pytest.approx(9.81, rel=1e-3)  # the soles are at height 0
