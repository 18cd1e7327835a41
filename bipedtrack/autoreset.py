"""The one wrapper between the environment and brax's PPO: a batch of robots whose episodes start wholly new.

When an episode ends at step t, the state keeps its terminal observation; the *next* step ignores the action and begins a
new episode (new task, task step, robot, filter), with reward 0 and `truncation` 1. With brax's `compute_gae` this is
exact: at a time limit the value of step t bootstraps from the terminal observation, which is the observation of
step t + 1; at a fall it does not (done = 1); and
the step that begins the new episode has no value error and, before brax centres the advantages, no advantage.
"""

from __future__ import annotations

import brax.envs
import jax
import jax.numpy as jnp

from bipedtrack.env import TrackingEnv
from bipedtrack.rotations import Array

EVENTS = ("fell", "nonfinite")  # metrics that happen at most once in an episode


def _sum_name(metric: str) -> str:
    """The name of a metric's sum over an episode: brax divides those named `*_per_step` by the length."""
    return metric if metric in EVENTS else f"{metric}_per_step"


class AutoReset(brax.envs.Wrapper):
    """A batch of TrackingEnvs for brax's ppo.train, with the info that it reads.

    info: `truncation` (1 on the step that begins a new episode), `episode_done` (1 on the last step of an episode, however
    it ended), `episode_metrics` (sums over the episode so far), `clock` (policy steps towards the time limit).

    The first episodes end at any time up to the limit: robots that all began at once would all reach it at once, for ever,
    and every update would see nothing but beginnings, or nothing but ends.
    """

    env: TrackingEnv

    def __init__(self, env: TrackingEnv, episode_length: int):
        """episode_length: policy steps until the time limit."""
        super().__init__(env)
        self.episode_length = episode_length

    def reset(self, rng: Array) -> brax.envs.State:
        """New episodes for keys (n, 2), their clocks anywhere."""
        return jax.vmap(self._reset)(rng)

    def step(self, state: brax.envs.State, action: Array) -> brax.envs.State:
        """One policy step of every robot, or a new episode for those whose last one is over; action (n, 12)."""
        return jax.vmap(self._step)(state, action)

    def _reset(self, rng: Array) -> brax.envs.State:
        clock = jax.random.randint(jax.random.fold_in(rng, 0), (), 0, self.episode_length)
        return self._with_info(self.env.reset(rng), clock, truncation=0.0)

    def _with_info(self, state: brax.envs.State, clock: Array, truncation: float) -> brax.envs.State:
        """The first state of an episode with its sums at zero."""
        zero = jnp.float32(0)
        sums = {"sum_reward": zero, "length": zero} | {_sum_name(name): zero for name in state.metrics}
        info = {"truncation": jnp.float32(truncation), "episode_done": zero, "episode_metrics": sums, "clock": clock}
        return state.replace(info={**state.info, **info})

    def _step(self, state: brax.envs.State, action: Array) -> brax.envs.State:
        episode = state.info["episode"]
        moved = self.env.step(state, action)
        sums = state.info["episode_metrics"]
        sums = {
            "sum_reward": sums["sum_reward"] + moved.reward,
            "length": sums["length"] + 1,
            **{_sum_name(name): sums[_sum_name(name)] + value for name, value in moved.metrics.items()},
        }
        clock = state.info["clock"] + 1
        late = (clock >= self.episode_length).astype(jnp.float32)
        info = {
            "truncation": jnp.float32(0),
            "episode_done": jnp.maximum(moved.done, late),
            "episode_metrics": sums,
            "clock": clock,
        }
        moved = moved.replace(info={**moved.info, **info})
        fresh = self._with_info(self.env.begin(episode.key, episode.given), jnp.int32(0), truncation=1.0)
        over = state.info["episode_done"] > 0
        return jax.tree.map(lambda new, old: jnp.where(over, new, old), fresh, moved)
