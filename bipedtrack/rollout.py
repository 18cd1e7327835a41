"""Jitted rollouts of an environment and a policy over many robots, each until it falls or time is up."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import brax.envs
import jax
import jax.numpy as jnp
import numpy as np

from bipedtrack import sampling
from bipedtrack.env import TrackingEnv
from bipedtrack.rotations import Array
from bipedtrack.tasks import ERRORS


class Outcome(NamedTuple):
    """What came of n episodes."""

    survived: np.ndarray  # (n,) bool: still up when time was up
    seconds: np.ndarray  # (n,) until the fall, or the whole time
    errors: dict[str, np.ndarray]  # of ERRORS: (n,) means until the fall, the step in which it comes included


class _Tally(NamedTuple):
    """Running sums of one robot's episode."""

    alive: Array  # () 1 until the fall
    steps: Array  # () policy steps until the fall, that of the fall included
    errors: dict[str, Array]


def outcomes(
    env: TrackingEnv, act: Callable[[Array], Array], given: sampling.Distribution, seconds: float, seed: int
) -> Outcome:
    """Rolls out one episode for each robot.

    Args:
      env: the environment; its own distribution is not used.
      act: network output (12,) for an observation (101,), jittable; zeros are inverse kinematics alone.
      given: what each robot's episode is drawn from, with a leading axis of n.
      seconds: the time limit.
      seed: of the episodes.
    """
    count = given.hold_share.shape[0]
    length = round(seconds / env.config.policy_period)
    chunk = min(50, length)

    def start(key: Array, one: sampling.Distribution) -> tuple[brax.envs.State, _Tally]:
        zero = jnp.float32(0)
        return env.begin(key, one), _Tally(jnp.float32(1), zero, dict.fromkeys(ERRORS, zero))

    def step(state: brax.envs.State, tally: _Tally, number: Array) -> tuple[brax.envs.State, _Tally]:
        state = env.step(state, act(state.obs))
        alive = tally.alive * (number < length)
        errors = {name: tally.errors[name] + alive * state.metrics[name] for name in ERRORS}
        fallen = jnp.where(number < length, state.done, 0.0)
        return state, _Tally(tally.alive * (1 - fallen), tally.steps + alive, errors)

    @jax.jit
    def advance(carry: tuple[brax.envs.State, _Tally], first: Array) -> tuple[brax.envs.State, _Tally]:
        def body(carry: tuple[brax.envs.State, _Tally], number: Array):  # type: ignore[no-untyped-def]
            return jax.vmap(step, in_axes=(0, 0, None))(*carry, number), None

        return jax.lax.scan(body, carry, first + jnp.arange(chunk))[0]

    carry = jax.jit(jax.vmap(start))(jax.random.split(jax.random.PRNGKey(seed), count), given)
    for first in range(0, length, chunk):
        carry = advance(carry, jnp.int32(first))
        if not carry[1].alive.any():
            break
    tally = jax.tree.map(np.asarray, carry[1])
    steps = np.maximum(tally.steps, 1)
    return Outcome(
        survived=tally.alive > 0,
        seconds=tally.steps * env.config.policy_period,
        errors={name: tally.errors[name] / steps for name in ERRORS},
    )
