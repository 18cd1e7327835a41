"""Outcomes of whole episodes against a plain loop over the environment's steps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bipedtrack import control, observation, rewards, robot, rollout, sampling
from bipedtrack.env import EnvConfig, TrackingEnv

pytestmark = pytest.mark.usefixtures("unoptimised")
KINDS = ("stand", "walk", "stand", "turn", "sidle", "stand")
PERIOD, SECONDS, SEED = 0.02, 1.1, 5  # 55 policy steps: more than one chunk of a rollout, and not whole chunks
ANKLE_PITCH = np.eye(12)[4] + np.eye(12)[10]


def act(flat_observation: jax.Array) -> jax.Array:
    """Tips over whoever has a foot in the air, and leaves the others to inverse kinematics."""
    swings = flat_observation[observation.layout()["timer"]].sum() > 0
    return jnp.where(swings, -5.0, 0.0) * jnp.asarray(ANKLE_PITCH, jnp.float32)


def batch() -> sampling.Distribution:
    def of(kind: str) -> sampling.Distribution:
        shares = sampling.Shares(**{name: float(name == kind) for name in sampling.KINDS})
        return sampling.distribution(sampling.Ranges(), shares, 0.5, 0.0, (0, 0))

    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(of, KINDS))


@pytest.fixture(scope="module")
def env(unoptimised: None) -> TrackingEnv:
    given = jax.tree.map(lambda leaf: leaf[0], batch())
    return TrackingEnv(
        robot.load(), EnvConfig(rewards.RewardConfig(), control.ControlConfig(level_feet=True), PERIOD), given
    )


@pytest.fixture(scope="module")
def outcome(env: TrackingEnv) -> rollout.Outcome:
    return rollout.outcomes(env, act, batch(), SECONDS, SEED)


@pytest.fixture(scope="module")
def by_loop(env: TrackingEnv) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Whether a robot has fallen at each step, and its errors by name, (steps, robots) each."""
    step = jax.jit(jax.vmap(env.step))
    begin = jax.jit(jax.vmap(env.begin))
    states = [begin(jax.random.split(jax.random.PRNGKey(SEED), len(KINDS)), batch())]
    for _ in range(55):
        states.append(step(states[-1], jnp.stack([act(one) for one in states[-1].obs])))
    errors = {name: np.array([state.metrics[name] for state in states[1:]], float) for name in rollout.ERRORS}
    return np.array([state.done for state in states[1:]]) > 0, errors


def steps_until_fall(done: np.ndarray) -> list[int]:
    return [next((t + 1 for t in range(55) if done[t, i]), 55) for i in range(len(KINDS))]


def test_robots_that_fall_last_until_their_fall_and_the_others_the_whole_time(outcome, by_loop) -> None:
    done, _ = by_loop
    steps = np.array(steps_until_fall(done))
    assert [count < 50 for count in steps] == [kind != "stand" for kind in KINDS]  # there are both
    np.testing.assert_array_equal(outcome.survived, steps == 55)
    np.testing.assert_allclose(outcome.seconds[outcome.survived], SECONDS, atol=1e-5)
    # a fall enlarges rounding, so it may come one step earlier or later
    np.testing.assert_allclose(outcome.seconds, steps * PERIOD, atol=1.01 * PERIOD)


def test_errors_are_means_over_the_steps_until_the_fall(outcome, by_loop) -> None:
    done, errors = by_loop
    steps = steps_until_fall(done)
    assert set(outcome.errors) == set(rollout.ERRORS)
    for name, values in errors.items():
        wanted = np.array([values[:count, i].mean() for i, count in enumerate(steps)])
        np.testing.assert_allclose(outcome.errors[name], wanted, rtol=0.05, atol=0.005)
        after_the_fall_too = values.mean(axis=0)
        fell = np.array(steps) < 55
        assert (np.abs(after_the_fall_too / wanted - 1)[fell] > 0.2).all()
