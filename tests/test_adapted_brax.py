"""Brax's PPO as it is while we call it: how often it compiles, what it reports, whether its program is kept."""

import pathlib
from typing import Any

import brax.envs
import jax
import pytest
from brax.training.agents.ppo import train as ppo
from jax.experimental.compilation_cache import compilation_cache

from bipedtrack.adapted_brax import adapted_brax


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
