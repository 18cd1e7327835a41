"""The one wrapper between the environment and brax's PPO: a batch of robots whose episodes start wholly new.

When an episode ends at step t, the state keeps its terminal observation; the *next* step ignores the action and begins a
new episode (new task, task step, robot, filter; or, with `retries`, the old one from before its fall), with reward 0 and
`truncation` 1. With brax's `compute_gae` this is
exact: at a time limit the value of step t bootstraps from the terminal observation, which is the observation of
step t + 1; at a fall it does not (done = 1); and
the step that begins the new episode has no value error and, before brax centres the advantages, no advantage.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import brax.envs
import jax
import jax.numpy as jnp

from bipedtrack.env import TrackingEnv
from bipedtrack.rotations import Array

EVENTS = ("fell", "nonfinite")  # metrics that happen at most once in an episode


class Moment(NamedTuple):
    """All that an episode can go on from."""

    physics: Any
    episode: Any  # without what it was drawn from, which does not change
    obs: Array
    clock: Array  # () policy steps towards the time limit


def _moment(state: brax.envs.State, clock: Array) -> Moment:
    return Moment(state.pipeline_state, state.info["episode"]._replace(given=None), state.obs, clock)


def _choose(condition: Array, new: Any, old: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


def _sum_name(metric: str) -> str:
    """The name of a metric's sum over an episode: brax divides those named `*_per_step` by the length."""
    return metric if metric in EVENTS else f"{metric}_per_step"


class AutoReset(brax.envs.Wrapper):
    """A batch of TrackingEnvs for brax's ppo.train, with the info that it reads.

    info: `truncation` (1 on the step that begins a new episode), `episode_done` (1 on the last step of an episode, however
    it ended), `episode_metrics` (sums over the episode so far), `clock` (policy steps towards the time limit).

    The first episodes end at any time up to the limit: robots that all began at once would all reach it at once, for ever,
    and every update would see nothing but beginnings, or nothing but ends.

    Falls become rare, and what can be learned from one lies in the seconds before it. With `retries` a robot that fell goes
    back to a while before, with the same commands and pushes to come, up to so many times from one beginning; each try
    counts as an episode. info then also has `moments`, the older and the newer one that are kept, and `tries`.
    """

    env: TrackingEnv

    def __init__(self, env: TrackingEnv, episode_length: int, retries: int = 0, look_back: int = 50):
        """episode_length: policy steps until the time limit.

        look_back: a retry begins so many policy steps before the fall, or up to twice as many; never before the episode.
        """
        super().__init__(env)
        self.episode_length = episode_length
        self.retries = retries
        self.look_back = look_back

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
        if self.retries:
            now = _moment(state, clock)
            info |= {"moments": (now, now), "tries": jnp.int32(0)}
        return state.replace(info={**state.info, **info})

    def _again(self, state: brax.envs.State) -> brax.envs.State:
        """The older moment of the episode that `state` ended."""
        older, _ = state.info["moments"]
        episode = older.episode._replace(given=state.info["episode"].given)
        before = state.replace(
            pipeline_state=older.physics,
            obs=older.obs,
            reward=jnp.zeros_like(state.reward),
            done=jnp.zeros_like(state.done),
            metrics=jax.tree.map(jnp.zeros_like, state.metrics),
            info={**state.info, "episode": episode},
        )
        before = self._with_info(before, older.clock, truncation=1.0)
        return before.replace(info={**before.info, "tries": state.info["tries"] + 1})

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
        if self.retries:
            older, newer = state.info["moments"]
            info["moments"] = _choose(clock % self.look_back == 0, (newer, _moment(moved, clock)), (older, newer))
        moved = moved.replace(info={**moved.info, **info})
        fresh = self._with_info(self.env.begin(episode.key, episode.given), jnp.int32(0), truncation=1.0)
        if self.retries:
            retried = (state.done > 0) & (state.info["tries"] < self.retries)
            fresh = _choose(retried, self._again(state), fresh)
        return _choose(state.info["episode_done"] > 0, fresh, moved)
