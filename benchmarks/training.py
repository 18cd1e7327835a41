"""How fast a lesson is trained from end to end, and where the time goes; beside a humanoid of brax's own.

python benchmarks/training.py --curriculum paper

`rate` is policy steps per second. The split is by difference: physics alone, the whole environment, with the network, and
brax's `ppo.train`, each measured in the same run on the same number of robots; all in microseconds of the machine for each
policy step. The peer is brax's `humanoid` on MJX under the same PPO arguments, its own physics and network sizes as here.
"""

from __future__ import annotations

import dataclasses

import measure
import rollout

from bipedtrack import autoreset, curriculum, policy, training
from bipedtrack.messages import Refusal, quiet_imports

with quiet_imports():
    import brax.envs
    import brax.envs.wrappers.training


@dataclasses.dataclass(frozen=True)
class Training:
    """Training steps per second of the first lesson of a curriculum."""

    curriculum: str = "paper"
    """`paper` is Table III."""
    stage: int = 0
    """Of the curriculum; 0 is level ground."""
    updates: int = 8
    """That are timed at once."""
    policy: str = "models/policies/best.npz"
    """The policy that acts where the environment is measured without learning."""
    peer: bool = True
    """Also brax's humanoid."""
    devices: int = 0
    """Devices that the CPU counts as; 0: one for each core, or fewer that share the robots evenly."""


def main(options: Training) -> None:
    """Prints a line for the lesson, and one for the peer. Raises Refusal for options that cannot be."""
    measure.require_positive(updates=options.updates)
    config = curriculum.load(options.curriculum)
    if not 0 <= options.stage < len(config.stages):
        raise Refusal(f"--stage {options.stage}: {options.curriculum} has the stages 0 to {len(config.stages) - 1}")
    devices = measure.use_devices(options.devices, config.ppo.shares_out)
    stage = config.stages[options.stage]
    call = next(call for call in curriculum.calls(config) if call.stage is stage)
    the_env = training.make_env(config, stage, call.lesson)
    robots, steps = config.ppo.num_envs, config.ppo.unroll_length * the_env.substeps

    driven = policy.load_for_simulation(options.policy)
    physics = rollout.mjx_alone(the_env, robots, steps, devices).rate / the_env.substeps
    environment = rollout.environment(the_env, None, robots, steps, devices).rate / the_env.substeps
    with_policy = rollout.environment(the_env, driven, robots, steps, devices).rate / the_env.substeps
    wrapped = autoreset.AutoReset(the_env, config.episode_length)
    whole, compiling = training.speed(config, call, wrapped, options.updates)
    parts = {
        "physics_us": 1e6 / physics,
        "rest_of_environment_us": 1e6 / environment - 1e6 / physics,
        "policy_us": 1e6 / with_policy - 1e6 / environment,
        "learner_us": 1e6 / whole - 1e6 / with_policy,
    }
    case = {"benchmark": "training", "robots": robots}
    measure.line(**case, case=f"{config.name}, {stage.name}", rate=whole, compile_s=compiling, **parts)
    if options.peer:
        humanoid = brax.envs.get_environment("humanoid", backend="mjx")
        peer = brax.envs.wrappers.training.wrap(humanoid, episode_length=1000, action_repeat=1)
        rate, compiling = training.speed(config, call, peer, options.updates)
        measure.line(**case, case="brax humanoid, MJX", rate=rate, compile_s=compiling, ratio=whole / rate)


if __name__ == "__main__":
    measure.run(main, Training)
