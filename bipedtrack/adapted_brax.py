"""What brax's PPO does otherwise while we call it (brax 0.14.2, jax 0.9.2)."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import numpy as np
from brax.training.agents.ppo import losses
from brax.training.agents.ppo import train as ppo

Term = Callable[[jax.Array, jax.Array], jax.Array]  # observations and mean actions, (robots, steps, ...), to a loss ()


@contextlib.contextmanager
def adapted_brax(term: Term | None = None) -> Iterator[None]:
    """Brax's `ppo.train` with an epoch that compiles once and that JAX can keep on disk, and a term more in its loss.

    - `jax.device_put_replicated`, which brax calls for the first training state, differs from `jax.pmap`, whose output all
      later ones are, in nothing but the name of the mesh's axis; that name is part of what JAX compares, and the epoch
      would compile twice.
    - Brax reports episodes by a callback into Python, and a program with one cannot be kept. Here the loss reports them.
    - Where several processes train, what `jax.pmap` returns clings to the others' devices, and brax's mean of it fails.
    """
    original = jax.device_put_replicated, losses.compute_ppo_loss, jax.pmap
    compute_loss = losses.compute_ppo_loss if term is None else _with_term(losses.compute_ppo_loss, term)
    jax.device_put_replicated, losses.compute_ppo_loss = _replicate, _loss_and_episodes(compute_loss)
    if jax.process_count() > 1:
        jax.pmap = _local(jax.pmap)
    try:
        yield
    finally:
        jax.device_put_replicated, losses.compute_ppo_loss, jax.pmap = original


def _replicate(x: Any, devices: Sequence[Any]) -> Any:
    axis = ppo._PMAP_AXIS_NAME
    sharding = jax.sharding.NamedSharding(jax.sharding.Mesh(np.array(devices), (axis,)), jax.sharding.PartitionSpec(axis))
    return jax.tree.map(lambda leaf: jax.device_put(jax.numpy.stack([leaf] * len(devices)), sharding), x)


def _local(pmap: Callable[..., Any]) -> Callable[..., Any]:
    """`jax.pmap` whose outputs hold nothing but this process's part."""

    def own(array: jax.Array) -> jax.Array:
        parts = [shard.data for shard in array.addressable_shards]
        return jax.make_array_from_single_device_arrays(array.shape, array.sharding, parts)

    def mapped(*args: Any, **kwargs: Any) -> Callable[..., Any]:
        function = pmap(*args, **kwargs)
        return lambda *inputs: jax.tree.map(own, function(*inputs))

    return mapped


def _with_term(compute_loss: Callable[..., Any], term: Term) -> Callable[..., Any]:
    """The loss and a term of the mean actions, which are those that brax computes for its own loss: once is enough."""

    def loss(params: Any, normalizer_params: Any, data: Any, rng: Any, *, ppo_network: Any, **settings: Any) -> Any:
        seen = []

        def apply(*inputs: Any) -> Any:
            seen.append(ppo_network.policy_network.apply(*inputs))
            return seen[-1]

        policy_network = dataclasses.replace(ppo_network.policy_network, apply=apply)
        watched = dataclasses.replace(ppo_network, policy_network=policy_network)
        total, metrics = compute_loss(params, normalizer_params, data, rng, ppo_network=watched, **settings)
        ((means, _),) = seen
        return total + term(data.observation, means.swapaxes(0, 1)), metrics  # brax has time first

    return loss


def _loss_and_episodes(compute_loss: Callable[..., Any]) -> Callable[..., Any]:
    """The loss, whose metrics also hold, for each step of the data, how many episodes ended and the sums of their figures.

    Brax averages them over an epoch, so their ratios are means over all episodes that ended in it.
    """

    def loss(params: Any, normalizer_params: Any, data: Any, rng: Any, **settings: Any) -> Any:
        total, metrics = compute_loss(params, normalizer_params, data, rng, **settings)
        extras = data.extras["state_extras"]
        ended, figures = extras["episode_done"], extras["episode_metrics"]
        per_episode = {
            name: value / jax.numpy.maximum(figures["length"], 1) if name.endswith("_per_step") else value
            for name, value in figures.items()
        }
        episodes = {f"episode/{name}": (ended * value).mean() for name, value in per_episode.items()}
        return total, {**metrics, **episodes, "episodes": ended.mean()}

    return loss
