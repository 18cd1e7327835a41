"""The mirror image against MuJoCo C and against what it observes itself; symmetric policies and their networks."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from brax.training.acme import running_statistics
from policies import ROBOT, make_policy, random_network
from scipy.spatial.transform import Rotation

from bipedtrack import control, curriculum, footsteps, kinematics, networks, observation, planner, robot, symmetry
from bipedtrack.nodes import NodeRates, Nodes
from bipedtrack.planner import Command

FLIP = np.diag([1.0, -1.0, 1.0])


def reflected_nodes(place: Nodes) -> Nodes:
    """By matrices: what is at p is at F p, and a rotation R is F R F."""
    turn = Rotation.from_quat(place.trunk_orientation, scalar_first=True).as_matrix()
    return Nodes(
        trunk_position=FLIP @ place.trunk_position,
        trunk_orientation=Rotation.from_matrix(FLIP @ turn @ FLIP).as_quat(scalar_first=True),
        ankle_positions=place.ankle_positions[::-1] @ FLIP,
        ankle_yaws=-place.ankle_yaws[::-1],
    )


def reflected_state(qpos: np.ndarray, qvel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    turn = Rotation.from_quat(qpos[3:7], scalar_first=True).as_matrix()
    quaternion = Rotation.from_matrix(FLIP @ turn @ FLIP).as_quat(scalar_first=True)
    joints, rates = symmetry.mirrored_joints(qpos[7:]), symmetry.mirrored_joints(qvel[6:])
    # an angular velocity is a rotation, so it turns the other way about the reflected axis
    return (
        np.concatenate([FLIP @ qpos[:3], quaternion, joints]),
        np.concatenate([FLIP @ qvel[:3], -FLIP @ qvel[3:6], rates]),
    )


def random_state(random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Above the ground, tilted, with joints within their ranges."""
    quaternion = Rotation.from_euler("xyz", random.uniform(-0.5, 0.5, 3)).as_quat(scalar_first=True)
    joints = ROBOT.joint_middle + 0.5 * ROBOT.joint_half_range * random.uniform(-1, 1, 12)
    return np.concatenate([[*random.normal(size=2), 0.7], quaternion, joints]), random.normal(size=18)


def random_command(random: np.random.Generator) -> Command:
    def somewhere() -> Nodes:
        turn = Rotation.from_euler("xyz", random.uniform(-0.4, 0.4, 3)).as_quat(scalar_first=True)
        return Nodes(random.normal(size=3), turn, random.normal(size=(2, 3)), random.uniform(-1, 1, 2))

    rates = NodeRates(*(random.normal(size=shape) for shape in (3, 3, (2, 3), 2)))
    return Command(somewhere(), somewhere(), rates, np.array([0.3, 0.0]))


def reflected_command(command: Command) -> Command:
    rates = command.rates
    return Command(
        reflected_nodes(command.end),
        reflected_nodes(command.target),
        NodeRates(
            FLIP @ rates.trunk_velocity,
            -FLIP @ rates.trunk_angular_velocity,
            rates.ankle_velocities[::-1] @ FLIP,
            -rates.ankle_yaw_rates[::-1],
        ),
        command.timer[::-1],
    )


def seen(command: Command, qpos: np.ndarray, qvel: np.ndarray, feedforward: np.ndarray, last: np.ndarray) -> np.ndarray:
    real = kinematics.measure(ROBOT, qpos)
    return observation.flatten(observation.observe(command, real, qpos, qvel, feedforward, last))


@pytest.mark.parametrize("seed", range(20))
def test_the_mirror_image_observes_the_mirrored_observation(seed: int) -> None:
    random = np.random.default_rng(seed)
    (qpos, qvel), command = random_state(random), random_command(random)
    feedforward, last = random.normal(size=(2, 12))
    mine = seen(command, qpos, qvel, feedforward, last)
    its = (symmetry.mirrored_joints(signal) for signal in (feedforward, last))
    images = seen(reflected_command(command), *reflected_state(qpos, qvel), *its)
    assert symmetry.mirrored_observation(mine) == pytest.approx(images, abs=1e-9)
    assert np.abs(images - mine).max() > 0.1


@pytest.mark.parametrize("seed", range(5))
def test_the_mirror_image_moves_as_the_mirrored_robot(seed: int) -> None:
    """In MuJoCo C, from the air to the ground, each under its own joint targets."""
    random = np.random.default_rng(seed)
    model = robot.build_model("ranger_max")
    mine, its = mujoco.MjData(model), mujoco.MjData(model)
    qpos, qvel = random_state(random)
    mine.qpos[:], mine.qvel[:] = qpos, 0.3 * qvel
    its.qpos[:], its.qvel[:] = reflected_state(mine.qpos, mine.qvel)
    for _ in range(40):
        mine.ctrl[:] = ROBOT.joint_middle + 0.4 * ROBOT.joint_half_range * random.uniform(-1, 1, 12)
        its.ctrl[:] = symmetry.mirrored_joints(mine.ctrl)
        mujoco.mj_step(model, mine)
        mujoco.mj_step(model, its)
    wanted_qpos, wanted_qvel = reflected_state(mine.qpos, mine.qvel)
    assert its.qpos == pytest.approx(wanted_qpos, abs=1e-6)
    assert its.qvel == pytest.approx(wanted_qvel, abs=1e-4)
    assert np.abs(mine.qpos[7:] - qpos[7:]).max() > 0.1


def test_signals_keep_their_meaning_and_two_mirrors_cancel() -> None:
    random = np.random.default_rng(0)
    joints, flat = random.uniform(-0.3, 0.3, 12), random.normal(size=observation.SIZE)
    normal = control.normalize(ROBOT, joints)
    assert symmetry.mirrored_joints(normal) == pytest.approx(control.normalize(ROBOT, symmetry.mirrored_joints(joints)))
    assert (symmetry.mirrored_joints(symmetry.mirrored_joints(joints)) == joints).all()
    assert (symmetry.mirrored_observation(symmetry.mirrored_observation(flat)) == flat).all()


def test_the_foot_in_the_air_leads_and_of_two_that_stand_the_one_ahead() -> None:
    upright = Nodes(np.array([0, 0, 0.75]), np.array([1.0, 0, 0, 0]), np.zeros((2, 3)), np.zeros(2))

    def leads(left: float, right: float, timer: tuple[float, float]) -> bool:
        """Whether the right foot does, with the ankles so far ahead, m."""
        feet = upright._replace(ankle_positions=np.array([[left, 0.1, 0.05], [right, -0.1, 0.05]]))
        stand = footsteps.task_step(ROBOT, (), feet, (), {"period": 1.0})
        command = planner.command(stand, np.float64(0))._replace(timer=np.array(timer))
        a_ff = control.feedforward(ROBOT, control.ControlConfig(), feet)
        qpos = np.concatenate([upright.trunk_position, upright.trunk_orientation, np.zeros(12)])
        flat = seen(command, qpos, np.zeros(18), a_ff, np.zeros(12))
        in_jax = bool(symmetry.right_leads(jnp.asarray(flat, jnp.float32))[0])
        assert in_jax == bool(symmetry.right_leads(flat)[0])
        return in_jax

    assert leads(0.1, -0.1, (0.0, 0.2)) and not leads(-0.1, 0.1, (0.2, 0.0))  # in the air
    assert leads(-0.05, 0.05, (0.0, 0.0)) and not leads(0.05, -0.05, (0.0, 0.0))  # ahead
    assert not leads(0.0, 0.0, (0.0, 0.0))
    assert leads(-0.05, 0.05, (0.3, 0.3)) and not leads(0.05, -0.05, (0.3, 0.3))  # a jump


def leaning(count: int) -> np.ndarray:
    """Observations (count, 101) in each of which a foot leads: left, right, left ..."""
    flat = np.random.default_rng(1).normal(size=(count, observation.SIZE)).astype(np.float32)
    timer = observation.layout()["timer"]
    flat[:, timer] = np.resize([[0.3, 0.0], [0.0, 0.2]], (count, 2))
    return flat


def test_a_symmetric_policy_does_as_its_mirror_image_and_another_one_does_not() -> None:
    usual = make_policy(random_network(4))
    flat = leaning(50)
    for policy, equal in ((dataclasses.replace(usual, symmetric=True), True), (usual, False)):
        found, images = policy.feedback(flat), policy.feedback(symmetry.mirrored_observation(flat))
        assert np.allclose(symmetry.mirrored_joints(found), images, atol=1e-6) == equal
    assert (dataclasses.replace(usual, symmetric=True).feedback(flat)[::2] == usual.feedback(flat)[::2]).all()


def test_braxs_networks_are_symmetric_too() -> None:
    config = curriculum.NetworkConfig(actor=(16,), critic=(8,), symmetric=True)
    made = networks.make(config, observation.SIZE, 12, preprocess_observations_fn=running_statistics.normalize)
    keys = jax.random.split(jax.random.PRNGKey(0), 3)
    actor, critic = made.policy_network.init(keys[0]), made.value_network.init(keys[1])
    # every joint with a deviation of its own, so that an exchange of legs shows
    actor["params"]["std_logparam"]["log_value"] = jnp.linspace(-1.0, 1.0, 12)
    statistics = running_statistics.init_state(jnp.zeros(observation.SIZE))
    flat = jnp.asarray(leaning(10))
    images = symmetry.mirrored_observation(flat)
    mean, deviation = made.policy_network.apply(statistics, actor, flat)
    its_mean, its_deviation = made.policy_network.apply(statistics, actor, images)
    np.testing.assert_allclose(symmetry.mirrored_joints(mean), its_mean, atol=1e-6)
    np.testing.assert_allclose(symmetry.swapped(deviation), its_deviation, atol=1e-6)
    assert deviation[0, 0] == pytest.approx(np.exp(-1.0)) and deviation[1, 6] == pytest.approx(np.exp(-1.0))
    values, its_values = (made.value_network.apply(statistics, critic, part) for part in (flat, images))
    np.testing.assert_allclose(values, its_values, atol=1e-6)


def test_a_robot_with_a_stronger_leg_is_not_symmetric() -> None:
    assert symmetry.is_symmetric(ROBOT)
    for name, change in (("kp", 1.5), ("joint_low", 0.8), ("hips", 1.1)):
        values = getattr(ROBOT, name).copy()
        values[0] = values[0] * change
        assert not symmetry.is_symmetric(dataclasses.replace(ROBOT, **{name: values}))
