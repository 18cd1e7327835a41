"""Stages and lessons as brax PPO calls, one after another: the only module that knows brax's argument names.

A call is a pure function of (parameters, call, run's seed). A run that was killed repeats its unfinished call and ends in
bitwise the same parameters on the same machine; what a call costs to repeat is set by the curriculum (`parts`).
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
import pathlib
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import brax.envs
import jax
import jax.numpy as jnp
import numpy as np
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import losses, networks
from brax.training.agents.ppo import train as ppo
from flax import linen

from bipedtrack import (
    __version__,
    autoreset,
    curriculum,
    distributed,
    env,
    observation,
    plans,
    policy,
    robot,
    sampling,
    symmetry,
    tasks,
    versions,
)
from bipedtrack.checkpoint import Checkpoint, CheckpointError
from bipedtrack.distributed import ALONE, Process
from bipedtrack.progress import Aside, Progress
from bipedtrack.run_directory import RunDirectory

_UPDATES_PER_EPOCH = 8  # updates between two looks at whether somebody wants the training to stop
_ACTIVATIONS = {"swish": linen.swish, "tanh": linen.tanh, "relu": linen.relu}
assert set(_ACTIVATIONS) == set(policy.ACTIVATIONS)

Params = Any  # brax's (normaliser state, policy parameters, value parameters)


class Stopped(Exception):
    """Somebody asked the training to stop; everything up to the last finished call is saved."""


def make_env(config: curriculum.Curriculum, stage: curriculum.Stage, lesson: curriculum.Lesson) -> env.TrackingEnv:
    """The environment of a stage's lesson; only a stage with stairs has boxes."""
    given = sampling.distribution(
        stage.ranges or config.ranges,
        stage.shares,
        lesson.difficulty,
        stage.hold_share,
        stage.hold_after,
        mix_share=stage.mix_share,
        push_share=lesson.push_share,
        break_share=stage.break_share,
    )
    rewards = stage.rewards or config.rewards
    settings = env.EnvConfig(rewards, config.control, config.policy_period, stairs=stage.shares.stairs > 0)
    the_robot, source = robot.load(config.robot), tasks.RANDOM
    if stage.scripts:
        library = plans.library(curriculum.scripts_of(stage, the_robot))
        source = plans.with_scripts(source, library, stage.script_share)
    return env.TrackingEnv(the_robot, settings, given, source)


def train(
    config: curriculum.Curriculum,
    run: RunDirectory | None,
    seed: int,
    devices: int,
    progress: Progress | Aside,
    wants_to_stop: Callable[[], bool],
    process: Process = ALONE,
) -> Params:
    """Runs the calls that are not yet finished, saving after each, and returns the last parameters.

    Where several processes train together the first one alone has a run directory, and all begin with its checkpoint.
    Raises Stopped within a few updates after `wants_to_stop` turned true, RunError when a checkpoint cannot be written, and
    DistributedError where the processes do not agree.
    """
    found = run.latest() if run else None
    params = None if found is None else from_arrays(config, found.arrays)
    last = distributed.from_first("last call", lambda: None if found is None else found.call, process)
    if last is not None:
        blank = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), _template(config))
        params = distributed.share_arrays(blank if params is None else params, process)
    origin = None if found is None else origin_of(found)
    for call in curriculum.calls(config)[0 if last is None else last + 1 :]:
        params = _run_call(config, call, seed, devices, params, progress, wants_to_stop)
        arrays = to_arrays(params)
        if process.count > 1:
            distributed.require_agreement(arrays, process)
            progress.say(f"{process}, call {call.index + 1}: parameters {distributed.digest(arrays)}")
        if run:
            run.save_checkpoint(call.index, arrays, {"provenance": provenance(config, seed, call.index + 1, origin)})
        progress.finished(call)
        # what JAX remembers of a call serves no other one and is hundreds of megabytes; the next part of a lesson finds its
        # program in the cache on disk
        jax.clear_caches()
    distributed.part(process)
    return params


def _run_call(
    config: curriculum.Curriculum,
    call: curriculum.Call,
    seed: int,
    devices: int,
    params: Params | None,
    progress: Progress | Aside,
    wants_to_stop: Callable[[], bool],
) -> Params:
    """One `ppo.train` from the given parameters. Steps are rounded up to whole epochs of whole updates."""
    ppo_config = config.ppo
    updates = math.ceil(call.steps / ppo_config.steps_per_update)
    epochs = math.ceil(updates / _UPDATES_PER_EPOCH)
    the_env = make_env(config, call.stage, call.lesson)
    if params is not None and call.noise is not None:
        params = _with_noise(params, call.noise)

    def report(steps: int, metrics: dict[str, Any]) -> None:
        progress.update(call, steps, _figures(metrics, config.policy_period))

    def look(steps: int, make_policy: Any, params: Any) -> None:
        if wants_to_stop():
            raise Stopped

    progress.compiling(call, f"the environment and the learner for {ppo_config.num_envs} robots")
    with adapted_brax():
        _, params, _ = ppo.train(
            environment=autoreset.AutoReset(the_env, config.episode_length),
            num_timesteps=updates * ppo_config.steps_per_update,
            num_evals=epochs + 1,
            seed=call_seed(seed, call.index),
            max_devices_per_host=devices,
            restore_params=params,
            progress_fn=report,
            policy_params_fn=look,
            **ppo_arguments(config, call),
        )
    return params


def _with_noise(params: Params, noise: float) -> Params:
    """The parameters with another standard deviation of the actions, the same for all of them."""
    normalizer, actor, critic = params
    deviation = jax.tree.map(lambda log: jax.numpy.full_like(log, math.log(noise)), actor["params"]["std_logparam"])
    return normalizer, {**actor, "params": {**actor["params"], "std_logparam": deviation}}, critic


def ppo_arguments(config: curriculum.Curriculum, call: curriculum.Call) -> dict[str, Any]:
    """What brax's `ppo.train` is told beside the environment, how long and from where: the only place with its names."""
    ppo_config, network = config.ppo, config.network
    return {
        "wrap_env": False,
        # never evaluated, yet brax compiles its reset: the cheapest one there is
        "eval_env": brax.envs.get_environment("fast"),
        "run_evals": False,
        "episode_length": config.episode_length,
        "num_envs": ppo_config.num_envs,
        "unroll_length": ppo_config.unroll_length,
        "batch_size": ppo_config.num_envs // ppo_config.num_minibatches,
        "num_minibatches": ppo_config.num_minibatches,
        "num_updates_per_batch": ppo_config.num_epochs,
        "learning_rate": call.learning_rate,
        "entropy_cost": call.entropy_cost,
        "clipping_epsilon": call.clipping_epsilon,
        "discounting": ppo_config.discount,
        "gae_lambda": ppo_config.gae_lambda,
        "max_grad_norm": ppo_config.max_grad_norm,
        "reward_scaling": ppo_config.reward_scaling,
        "normalize_observations": True,
        "normalize_observations_std_eps": network.normalizer_floor,
        "network_factory": functools.partial(make_networks, network),
    }


def speed(config: curriculum.Curriculum, call: curriculum.Call, batch: brax.envs.Env, updates: int) -> tuple[float, float]:
    """Policy steps per second of a PPO call on a batch of environments, on all devices, and the seconds before the first.

    Three times `updates` updates are run, as three of brax's epochs; the faster of the last two counts.
    """
    times = [time.perf_counter()]
    with adapted_brax():
        ppo.train(
            environment=batch,
            num_timesteps=3 * updates * config.ppo.steps_per_update,
            num_evals=4,
            seed=0,
            policy_params_fn=lambda *_: times.append(time.perf_counter()),
            **ppo_arguments(config, call),
        )
    _, *later = np.diff(times[-4:])
    fastest = min(later)
    return updates * config.ppo.steps_per_update / fastest, times[-3] - times[0] - fastest


@contextlib.contextmanager
def adapted_brax() -> Iterator[None]:
    """Brax's `ppo.train` with an epoch that compiles once and that JAX can keep on disk (brax 0.14.2, jax 0.9.2).

    - `jax.device_put_replicated`, which brax calls for the first training state, differs from `jax.pmap`, whose output all
      later ones are, in nothing but the name of the mesh's axis; that name is part of what JAX compares, and the epoch
      would compile twice.
    - Brax reports episodes by a callback into Python, and a program with one cannot be kept. Here the loss reports them.
    - Where several processes train, what `jax.pmap` returns clings to the others' devices, and brax's mean of it fails.
    """
    original = jax.device_put_replicated, losses.compute_ppo_loss, jax.pmap
    jax.device_put_replicated, losses.compute_ppo_loss = _replicate, _loss_and_episodes(losses.compute_ppo_loss)
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


def make_networks(network: curriculum.NetworkConfig, *args: Any, **kwargs: Any) -> networks.PPONetworks:
    """Brax's actor and critic, as a `network_factory`: Gaussian actions whose deviation is learned, not squashed."""
    made = networks.make_ppo_networks(
        *args,
        **kwargs,
        policy_hidden_layer_sizes=network.actor,
        value_hidden_layer_sizes=network.critic,
        activation=_ACTIVATIONS[network.activation],
        distribution_type="normal",
        noise_std_type="log",
        init_noise_std=network.initial_noise,
    )
    return _symmetric(made) if network.symmetric else made


def _symmetric(made: networks.PPONetworks) -> networks.PPONetworks:
    """The networks shown the mirror image where the right foot leads, their actions mirrored back."""

    def act(normalizer: Any, params: Any, flat: jax.Array) -> tuple[jax.Array, jax.Array]:
        shown, right = symmetry.canonical(flat)
        mean, deviation = made.policy_network.apply(normalizer, params, shown)
        return symmetry.restored(mean, right), jnp.where(right, symmetry.swapped(deviation), deviation)

    def value(normalizer: Any, params: Any, flat: jax.Array) -> jax.Array:
        return made.value_network.apply(normalizer, params, symmetry.canonical(flat)[0])

    return dataclasses.replace(
        made,
        policy_network=dataclasses.replace(made.policy_network, apply=act),
        value_network=dataclasses.replace(made.value_network, apply=value),
    )


def call_seed(seed: int, index: int) -> int:
    """The seed of a call, from the run's seed and the call's index; in [0, 2^31)."""
    return int(np.random.SeedSequence([seed, index]).generate_state(1)[0] >> 1)


def _figures(metrics: dict[str, Any], policy_period: float) -> dict[str, float]:
    """What people want to see of an epoch's metrics: means over the episodes that ended in it, nan where none did."""
    found = {name.removeprefix("training/"): float(value) for name, value in metrics.items()}
    ended = found["episodes"] or math.nan
    episodes = {name.removeprefix("episode/"): v / ended for name, v in found.items() if name.startswith("episode/")}
    steps = episodes["length"]
    learner = ("kl_mean", "policy_dist_mean_std", "policy_loss", "v_loss", "entropy_loss")
    return {
        "episode_seconds": steps * policy_period,
        "falls": episodes["fell"],
        "nonfinite": episodes["nonfinite"],
        "reward_per_step": episodes["sum_reward"] / steps,
        **{name.removesuffix("_per_step"): v for name, v in episodes.items() if name.endswith("_per_step")},
        **{name: found[name] for name in learner},
    }


def _template(config: curriculum.Curriculum) -> Params:
    """Shapes and types of the parameters, without computing any."""

    def build() -> Params:
        made = make_networks(config.network, observation.SIZE, len(robot.load(config.robot).joint_names))
        key = jax.random.PRNGKey(0)
        normalizer = running_statistics.init_state(
            specs.Array((observation.SIZE,), np.dtype("float32")), std_eps=config.network.normalizer_floor
        )
        return normalizer, made.policy_network.init(key), made.value_network.init(key)

    return jax.eval_shape(build)


def _named_leaves(params: Params) -> tuple[dict[str, Any], Any]:
    """The leaves by their path, and the tree's structure."""
    leaves, structure = jax.tree_util.tree_flatten_with_path(params)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}, structure


def to_arrays(params: Params) -> dict[str, np.ndarray]:
    """Brax's parameters as named arrays for a checkpoint."""
    return {name: np.asarray(leaf) for name, leaf in _named_leaves(params)[0].items()}


def from_arrays(config: curriculum.Curriculum, arrays: dict[str, np.ndarray]) -> Params:
    """Brax's parameters from a checkpoint's arrays. Raises CheckpointError where they do not fit the curriculum."""
    wanted, structure = _named_leaves(_template(config))
    if set(wanted) != set(arrays):
        odd = sorted(set(wanted) ^ set(arrays))[0]
        raise CheckpointError(f"checkpoint does not fit the curriculum's networks: {odd} is on one side only")
    for name, leaf in wanted.items():
        if arrays[name].shape != leaf.shape or arrays[name].dtype != leaf.dtype:
            raise CheckpointError(
                f"checkpoint does not fit the curriculum's networks: {name} is {arrays[name].dtype}"
                f"{list(arrays[name].shape)}, wanted {leaf.dtype}{list(leaf.shape)}"
            )
    return jax.tree_util.tree_unflatten(structure, [jax.numpy.asarray(arrays[name]) for name in wanted])


def to_policy(config: curriculum.Curriculum, arrays: dict[str, np.ndarray], provenance: dict[str, Any]) -> policy.Policy:
    """The exported policy of a checkpoint's arrays: the actor's mean, its normaliser and all that surrounds them."""
    normalizer, actor, _ = from_arrays(config, arrays)
    layers = actor["params"]["MLP_0"]
    dense = [layers[f"hidden_{i}"] for i in range(len(config.network.actor))] + [actor["params"]["Dense_0"]]
    return policy.Policy(
        network=policy.Network(
            mean=np.asarray(normalizer.mean),
            std=np.asarray(normalizer.std),
            weights=tuple(np.asarray(layer["kernel"]) for layer in dense),
            biases=tuple(np.asarray(layer["bias"]) for layer in dense),
        ),
        activation=config.network.activation,
        settings=config.control,
        policy_period=config.policy_period,
        robot=robot.load(config.robot),
        provenance=provenance,
        symmetric=config.network.symmetric,
    )


def save_policy(run: RunDirectory, path: str | pathlib.Path) -> policy.Policy:
    """Writes the policy of a run's newest intact checkpoint to `path` and returns it.

    Raises RunError, ConfigError or CheckpointError where the run or its checkpoint cannot be read.
    """
    config, _, _ = curriculum.of_run(run)
    found = run.latest()
    if found is None:
        raise CheckpointError(f"{run.path}: has no checkpoint yet; its first PPO call is not finished")
    newest = to_policy(config, found.arrays, found.provenance)
    policy.save(newest, path)
    return newest


def origin_of(found: Checkpoint) -> dict[str, Any] | None:
    """Where the parameters that the run of a checkpoint began with come from; None: from nothing but its seed."""
    if found.call >= 0:
        return found.provenance.get("origin")
    return {**found.provenance, "parameters": distributed.digest(found.arrays)}


def provenance(
    config: curriculum.Curriculum, seed: int, finished_calls: int, origin: dict[str, Any] | None = None
) -> dict[str, Any]:
    """Where a policy comes from: curriculum, seed, steps, versions, and what it began with if that was not nothing."""
    found = {
        "curriculum": config.name,
        "seed": seed,
        "steps": sum(call.steps for call in curriculum.calls(config)[:finished_calls]),
        "symmetric": config.network.symmetric,
        "bipedtrack": __version__,
        "versions": {row.name: row.found for row in versions.check()},
    }
    return found if origin is None else {**found, "origin": origin}
