"""The balance that a critic sees against MuJoCo C, and a brax critic that sees it."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from brax.training.acme import running_statistics

from bipedtrack import balance, curriculum, networks, observation, rotations
from bipedtrack.robot import Robot

PARTS = observation.layout()


def random_state(robot: Robot, model: mujoco.MjModel, seed: int) -> tuple[mujoco.MjData, np.ndarray]:
    """A robot that moves in all its joints, and what balance follows from of its observation."""
    rng, data = np.random.default_rng(seed), mujoco.MjData(model)
    turn = rotations.from_euler(*rng.uniform(-0.3, 0.3, 2), rng.uniform(-3, 3))
    joints = np.array([0.0, 0.0, -0.4, 0.8, -0.4, 0.0] * 2) + rng.uniform(-0.15, 0.15, 12)
    data.qpos[:] = np.concatenate([[0.3, -0.2, 0.8], turn, joints])
    data.qvel[:] = rng.uniform(-0.3, 0.3, 18)
    mujoco.mj_forward(model, data)
    mujoco.mj_subtreeVel(model, data)
    flat = np.zeros(observation.SIZE, np.float32)
    to_b = rotations.to_matrix(turn)
    flat[PARTS["gravity"]], flat[PARTS["trunk_velocity"]] = -to_b[2], data.qvel[:3] @ to_b
    flat[PARTS["trunk_angular_velocity"]] = data.qvel[3:6]
    flat[PARTS["joint_positions"]], flat[PARTS["joint_velocities"]] = data.qpos[7:], data.qvel[6:]
    return data, flat


def expected(data: mujoco.MjData) -> list[float]:
    """Capture point, then centre of mass, ahead and to the left of both ankles, from MuJoCo's bodies, in 5 cm."""
    centre, velocity = data.subtree_com[1], data.subtree_linvel[1]
    numbers = []
    for moves in (1.0, 0.0):
        for side in (0.0, np.pi / 2):
            for foot in (data.body("left_foot"), data.body("right_foot")):
                toes = foot.xmat.reshape(3, 3)[:, 0]
                heading = np.arctan2(toes[1], toes[0]) + side
                arm = centre - foot.xpos
                point = arm[:2] + moves * velocity[:2] * np.sqrt(arm[2] / 9.81)
                numbers.append((point[0] * np.cos(heading) + point[1] * np.sin(heading)) / 0.05)
    return numbers


def test_capture_point_and_centre_of_mass_are_those_of_mujoco(robot: Robot, mj_model: mujoco.MjModel) -> None:
    states = [random_state(robot, mj_model, seed) for seed in range(30)]
    found = balance.features(robot, jnp.asarray([flat for _, flat in states]).reshape(5, 6, -1)).reshape(30, balance.SIZE)
    wanted = np.array([expected(data) for data, _ in states])
    assert abs(wanted).max() > 5 and (abs(wanted) < 5).mean() > 0.7  # what is far away is cut off
    np.testing.assert_allclose(found, np.clip(wanted, -5, 5), atol=0.02)  # 1 mm


def test_a_robot_that_lies_or_stands_on_its_head_has_finite_numbers(robot: Robot) -> None:
    for gravity in ([0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]):
        flat = jnp.zeros(observation.SIZE).at[PARTS["gravity"]].set(jnp.array(gravity))
        flat = flat.at[PARTS["joint_velocities"]].set(1e3)
        assert jnp.isfinite(balance.features(robot, flat)).all()


@pytest.mark.parametrize(("symmetric", "swings", "sees"), [(False, 0, 0), (False, 1, 0), (True, 0, 0), (True, 1, 1)])
def test_the_critic_alone_sees_it(robot: Robot, mj_model: mujoco.MjModel, symmetric: bool, swings: int, sees: int) -> None:
    """Weights that pass on nothing but the first of the new inputs, the left foot's, show what the critic was given.

    A symmetric one is shown the mirror image, whose left foot is the right one, where the right foot swings.
    """
    network = dataclasses.replace(
        curriculum.load("smoke").network, critic=(4,), activation="relu", symmetric=symmetric, critic_sees_balance=True
    )
    made = networks.make(
        network, observation.SIZE, 12, the_robot=robot, preprocess_observations_fn=running_statistics.normalize
    )
    plain = networks.make(dataclasses.replace(network, critic_sees_balance=False), observation.SIZE, 12)
    actor, critic = (part.init(jax.random.PRNGKey(0)) for part in (made.policy_network, made.value_network))
    assert jax.tree.map(jnp.shape, actor) == jax.tree.map(jnp.shape, plain.policy_network.init(jax.random.PRNGKey(0)))
    assert critic["params"]["hidden_0"]["kernel"].shape == (observation.SIZE + balance.SIZE, 4)

    critic = jax.tree.map(jnp.zeros_like, critic)
    critic["params"]["hidden_0"]["kernel"] = critic["params"]["hidden_0"]["kernel"].at[observation.SIZE, :2].set([1.0, -1.0])
    critic["params"]["hidden_1"]["kernel"] = critic["params"]["hidden_1"]["kernel"].at[:2, 0].set([1.0, -1.0])
    _, flat = random_state(robot, mj_model, 3)
    flat[PARTS["timer"]][swings] = 0.3
    blank = running_statistics.init_state(jnp.zeros(observation.SIZE))
    value = made.value_network.apply(blank, critic, jnp.asarray(flat))
    assert value == pytest.approx(float(balance.features(robot, jnp.asarray(flat))[sees]), abs=1e-5) and abs(value) > 0.1
