"""Brax's PPO as it is while we call it: how often it compiles, what it reports and descends, whether its program is kept."""

import functools
import pathlib
from typing import Any

import brax.envs
import jax
import jax.numpy as jnp
import pytest
from brax.training.acme import running_statistics
from brax.training.agents.ppo import train as ppo
from jax.experimental.compilation_cache import compilation_cache

from bipedtrack import networks
from bipedtrack.adapted_brax import adapted_brax
from bipedtrack.curriculum import NetworkConfig


def train(**arguments: Any) -> None:
    """Two robots of brax's own, whose episodes last four steps."""
    fast = brax.envs.get_environment("fast")
    ppo.train(environment=fast, run_evals=False, episode_length=4, num_envs=2, batch_size=2, num_minibatches=1, **arguments)


def test_brax_compiles_its_epoch_once_and_not_twice(caplog: pytest.LogCaptureFixture) -> None:
    def compilations(epochs: int) -> int:
        caplog.clear()
        with jax.log_compiles():
            train(num_timesteps=4 * epochs, num_evals=epochs + 1, unroll_length=2)
        return sum("Finished XLA compilation of jit(_fun)" in record.getMessage() for record in caplog.records)

    once = compilations(1)
    assert once >= 1
    with adapted_brax():
        assert compilations(3) == once
    assert compilations(3) == once + 1  # or brax no longer needs our help


def test_an_epoch_reports_the_episodes_that_ended_in_it_and_can_be_kept_on_disk(tmp_path: pathlib.Path) -> None:
    reported: list[dict[str, Any]] = []
    names = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    before = {name: getattr(jax.config, name) for name in names}
    compilation_cache.reset_cache()
    try:
        for name, value in zip(names, (str(tmp_path), 0.0), strict=True):
            jax.config.update(name, value)
        with adapted_brax():
            report = lambda steps, metrics: reported.append(metrics)  # noqa: E731
            train(num_timesteps=48, num_evals=2, unroll_length=6, progress_fn=report)
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
        compilation_cache.reset_cache()
    (metrics,) = reported
    # 48 steps of two robots, every fourth of which ends an episode
    assert metrics["training/episodes"] == pytest.approx(1 / 4)
    assert metrics["training/episode/length"] / metrics["training/episodes"] == pytest.approx(4)
    assert list(tmp_path.glob("jit__fun-*"))


def test_a_term_more_in_the_loss_is_descended() -> None:
    """Its weight drowns all else: after some updates the mean actions have gone where it wants them."""
    network = NetworkConfig(actor=(8,), critic=(8,))
    seen = []

    def term(observations: jax.Array, actions: jax.Array) -> jax.Array:
        seen.append((observations.shape, actions.shape))
        return -1e3 * actions.mean()

    def mean_action(params: Any) -> float:
        normalizer, actor, _ = params
        made = networks.make(network, 2, 1, preprocess_observations_fn=running_statistics.normalize)
        return float(made.policy_network.apply(normalizer, actor, jnp.zeros(2))[0][0])

    at: list[float] = []
    with adapted_brax(term):
        train(
            num_timesteps=48,
            num_evals=2,
            unroll_length=6,
            normalize_observations=True,
            learning_rate=0.1,
            network_factory=functools.partial(networks.make, network),
            policy_params_fn=lambda steps, make_policy, params: at.append(mean_action(params)),
        )
    assert set(seen) == {((2, 6, 2), (2, 6, 1))} and at[-1] > at[0] + 0.2
