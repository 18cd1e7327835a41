"""Stages and lessons as brax PPO calls, one after another; only `ppo_arguments` knows the names of what brax is told.

A call is a pure function of (parameters, call, run's seed), the numbers of processes and devices, and of the robot's files
and the footstep scripts, which a run names and does not keep. A run that was killed repeats its unfinished call and ends in
bitwise the same parameters on the same machine; what a call costs to repeat is set by the curriculum (`parts`).
"""

from __future__ import annotations

import dataclasses
import functools
import math
import time
from collections.abc import Callable
from typing import Any

import brax.envs
import jax
import numpy as np
from brax.training.agents.ppo import train as ppo

from bipedtrack import (
    __version__,
    autoreset,
    curriculum,
    distributed,
    env,
    feedback_error,
    networks,
    plans,
    policy,
    robot,
    sampling,
    tasks,
    versions,
)
from bipedtrack.adapted_brax import Term, adapted_brax
from bipedtrack.checkpoint import Checkpoint, CheckpointError
from bipedtrack.distributed import ALONE, Process
from bipedtrack.messages import Refusal
from bipedtrack.networks import Params
from bipedtrack.progress import Aside, Progress
from bipedtrack.run_directory import RunDirectory

_LOOK_BACK = 1.0  # s before a fall from which, or from up to twice as much before, it is tried again


class Stopped(Exception):
    """Somebody asked the training to stop; everything up to the last finished call is saved."""


class DivergedError(Refusal, RuntimeError):
    """A call has come to parameters that are not finite; the message is one line."""


def make_env(config: curriculum.Curriculum, stage: curriculum.Stage, lesson: curriculum.Lesson) -> env.TrackingEnv:
    """The environment of a stage's lesson; only a stage with stairs has boxes."""
    given = sampling.distribution(
        curriculum.ranges_of(config, stage),
        stage.shares,
        lesson.difficulty,
        stage.hold_share,
        stage.hold_after,
        mix_share=stage.mix_share,
        push_share=lesson.push_share,
        break_share=stage.break_share,
    )
    rewards = stage.rewards or config.rewards
    settings = env.EnvConfig(
        rewards, curriculum.control_of(config, stage), config.policy_period, stairs=stage.shares.stairs > 0
    )
    the_robot, source = robot.load(config.robot), tasks.RANDOM
    if stage.scripts:
        library = plans.library(curriculum.scripts_of(config, stage, the_robot))
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
    Raises Stopped within a few updates after `wants_to_stop` turned true, RunError when a checkpoint cannot be written,
    DivergedError where parameters are not finite any more, and DistributedError where the processes do not agree.
    """
    found = run.latest() if run else None
    params = None if found is None else networks.from_arrays(config, found.arrays)
    last = distributed.from_first("last call", lambda: None if found is None else found.call, process)
    if last is not None:
        blank = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), networks.template(config))
        params = distributed.share_arrays(blank if params is None else params, process)
    origin = None if found is None else origin_of(found)
    for call in curriculum.calls(config)[0 if last is None else last + 1 :]:
        if wants_to_stop():
            raise Stopped
        params = _run_call(config, call, seed, devices, params, progress, wants_to_stop)
        arrays = networks.to_arrays(params)
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
    if wants_to_stop():  # in the last call, which is saved
        raise Stopped
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
    """One `ppo.train` from the given parameters."""
    the_env = make_env(config, call.stage, call.lesson)
    if call.noise is not None:
        config = dataclasses.replace(config, network=dataclasses.replace(config.network, initial_noise=call.noise))
        params = None if params is None else networks.with_noise(params, call.noise)

    def report(steps: int, metrics: dict[str, Any]) -> None:
        progress.update(call, steps, _figures(metrics, config.policy_period))

    def look(steps: int, make_policy: Any, params: Any) -> None:
        if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(params)):
            raise DivergedError(
                f"stage {call.stage.name!r}, lesson {call.lesson.name!r}: the training diverged, parameters are not finite; "
                "begin a new run with a lower learning_rate, with --start where an earlier call of this one was saved"
            )
        if steps < call.steps and wants_to_stop():  # else the call is finished, and about to be saved
            raise Stopped

    look_back = round(_LOOK_BACK / config.policy_period)
    progress.compiling(call, f"the environment and the learner for {config.ppo.num_envs} robots")
    with adapted_brax(_term(the_env.robot, call.stage.feedback_error)):
        _, params, _ = ppo.train(
            environment=autoreset.AutoReset(the_env, config.episode_length, call.stage.retries, look_back),
            num_timesteps=call.steps,
            num_evals=call.epochs + 1,
            seed=call_seed(seed, call.index),
            max_devices_per_host=devices,
            restore_params=params,
            progress_fn=report,
            policy_params_fn=look,
            **ppo_arguments(config, call),
        )
    return params


def _term(the_robot: robot.Robot, weight: float) -> Term | None:
    """What a stage adds to PPO's loss."""
    return (lambda *batch: weight * feedback_error.loss(the_robot, *batch)) if weight else None


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
        "network_factory": functools.partial(networks.make, network, the_robot=robot.load(config.robot)),
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


def newest_policy(run: RunDirectory) -> policy.Policy:
    """The policy of a run's newest intact checkpoint.

    Raises RunError, ConfigError or CheckpointError where the run or its checkpoint cannot be read.
    """
    config, _, _ = curriculum.of_run(run)
    found = run.latest()
    if found is None:
        raise CheckpointError(f"{run.path}: has no checkpoint yet; its first PPO call is not finished")
    return networks.to_policy(config, found.arrays, found.provenance, found.call)


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
        "robot": config.robot,
        "activation": config.network.activation,
        "symmetric": config.network.symmetric,
        "bipedtrack": __version__,
        "versions": {row.name: row.found for row in versions.check()},
    }
    return found if origin is None else {**found, "origin": origin}
