"""How fast brax's PPO learns by itself: Table III on an environment that costs nothing, beside the matrix-product limit.

python benchmarks/learner.py

`ratio` is the share of the limit of float32 matrix products, measured in the same run, that the networks' products reach:
forward in the rollout, forward and backward in every epoch of the update.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import measure

from bipedtrack import curriculum, observation, training
from bipedtrack.messages import quiet_imports

with quiet_imports():
    import brax.envs


@dataclasses.dataclass(frozen=True)
class Learner:
    """Samples per second of PPO updates without an environment."""

    curriculum: str = "paper"
    """Whose network and PPO parameters; `paper` is Table III."""
    updates: int = 8
    """That are timed at once."""
    devices: int = 0
    """Devices that the CPU counts as; 0: one for each core, or fewer that share the robots evenly."""


class Constant(brax.envs.Env):
    """Robots, (n,) of them, whose observations are random numbers of the right size and whose steps do nothing."""

    @property
    def observation_size(self) -> int:
        """That of the tracking environment."""
        return observation.SIZE

    @property
    def action_size(self) -> int:
        """That of the tracking environment."""
        return 12

    @property
    def backend(self) -> str:
        """None that simulates."""
        return "none"

    def reset(self, rng: Any) -> brax.envs.State:
        """States for keys (n, 2)."""
        zeros = jnp.zeros(rng.shape[0])
        obs = jax.random.normal(rng[0], (rng.shape[0], observation.SIZE))
        return brax.envs.State(
            None, obs, zeros, zeros, {}, {"truncation": zeros, "episode_done": zeros, "episode_metrics": {}}
        )

    def step(self, state: brax.envs.State, action: Any) -> brax.envs.State:
        """The same state, with a reward that depends on the action, so that there is something to learn."""
        return state.replace(reward=-jnp.square(action).sum(axis=-1))


def products(network: curriculum.NetworkConfig, epochs: int) -> float:
    """Floating point operations in matrix products for each sample: one forward pass of the actor, then the epochs."""

    def weights(layers: tuple[int, ...]) -> int:
        return sum(a * b for a, b in zip(layers[:-1], layers[1:], strict=True))

    actor = weights((observation.SIZE, *network.actor, 12))
    critic = weights((observation.SIZE, *network.critic, 1))
    return 2.0 * actor + epochs * 6.0 * (actor + critic)


def main(options: Learner) -> None:
    """Prints one line. Raises Refusal for options that cannot be."""
    measure.require_positive(updates=options.updates)
    config = curriculum.load(options.curriculum)
    measure.use_devices(options.devices, config.ppo.shares_out)
    rate, compiling = training.speed(config, curriculum.calls(config)[0], Constant(), options.updates)
    limit = measure.matrix_limit()
    found = {"rate": rate, "compile_s": compiling, "matrix_limit_gflops": limit / 1e9}
    ratio = rate * products(config.network, config.ppo.num_epochs) / limit
    measure.line(benchmark="learner", case=options.curriculum, **found, ratio=ratio)


if __name__ == "__main__":
    measure.run(main, Learner)
