"""How fast brax's PPO learns by itself: Table III on an environment that costs nothing, beside the matrix-product limit.

python benchmarks/learner.py

`ratio` is the share of the limit of float32 matrix products, measured in the same run, that the networks' products reach:
forward in the rollout, forward and backward in every epoch of the update.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import brax.envs
import jax
import jax.numpy as jnp
import measure
import tyro
from brax.training.agents.ppo import train as ppo

from bipedtrack import curriculum, observation, training


@dataclasses.dataclass(frozen=True)
class Learner:
    """Samples per second of PPO updates without an environment."""

    curriculum: str = "paper"
    """Whose network and PPO parameters; `paper` is Table III."""
    updates: int = 8
    """That are timed."""


class Constant(brax.envs.Env):
    """Robots, (n,) of them, whose observations are random numbers of the right size and whose steps do nothing."""

    def __init__(self, actions: int):
        """actions: how many numbers an action has."""
        self._actions = actions

    @property
    def observation_size(self) -> int:
        """That of the tracking environment."""
        return observation.SIZE

    @property
    def action_size(self) -> int:
        """As given."""
        return self._actions

    @property
    def backend(self) -> str:
        """None that simulates."""
        return "none"

    def reset(self, rng: Any) -> brax.envs.State:
        """States for keys (n, 2)."""
        zeros = jnp.zeros(rng.shape[0])
        obs = jax.random.normal(rng[0], (rng.shape[0], observation.SIZE))
        return brax.envs.State(None, obs, zeros, zeros, {}, {"truncation": zeros, "episode_done": zeros, "episode_metrics": {}})

    def step(self, state: brax.envs.State, action: Any) -> brax.envs.State:
        """The same state, with a reward that depends on the action, so that there is something to learn."""
        return state.replace(reward=-jnp.square(action).sum(axis=-1))


def products(network: curriculum.NetworkConfig, actions: int, epochs: int) -> float:
    """Floating point operations in matrix products for each sample: one forward pass of the actor, then the epochs."""

    def weights(layers: tuple[int, ...]) -> int:
        return sum(a * b for a, b in zip(layers[:-1], layers[1:], strict=True))

    actor = weights((observation.SIZE, *network.actor, actions))
    critic = weights((observation.SIZE, *network.critic, 1))
    return 2.0 * actor + epochs * 6.0 * (actor + critic)


def samples_per_second(config: curriculum.Curriculum, updates: int) -> tuple[float, float]:
    """Of brax's whole update on the constant environment; and the seconds of compiling."""
    rates: list[float] = []

    def note(steps: int, metrics: dict[str, Any]) -> None:
        if "training/sps" in metrics:
            rates.append(metrics["training/sps"])

    ppo_config = config.ppo
    call = dataclasses.replace(curriculum.calls(config)[0], steps=3 * updates * ppo_config.steps_per_update)
    arguments = training.ppo_arguments(config, call) | {"num_timesteps": call.steps, "num_evals": 4, "progress_fn": note}
    with training.compiled_once():
        ppo.train(environment=Constant(12), seed=0, **arguments)
    per_epoch = updates * ppo_config.steps_per_update
    return max(rates[1:]), per_epoch / rates[0] - per_epoch / max(rates[1:])


def main(options: Learner) -> None:
    """Prints one line."""
    config = curriculum.load(options.curriculum)
    rate, compiling = samples_per_second(config, options.updates)
    limit = measure.matrix_limit()
    needed = products(config.network, 12, config.ppo.num_epochs)
    found = {"rate": rate, "compile_s": compiling, "matrix_limit_gflops": limit / 1e9, "ratio": rate * needed / limit}
    measure.line(benchmark="learner", **measure.machine(), case=options.curriculum, **found)


if __name__ == "__main__":
    main(tyro.cli(Learner))
