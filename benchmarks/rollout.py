"""How fast robots are simulated: MuJoCo C, MJX alone, and the whole environment with policy and auto-reset.

python benchmarks/rollout.py --robots 64 640 2048

All rates are physics steps of 0.005 s per second, with the MJCF's own solver. `ratio` is to MuJoCo C with one thread or one
for each core, whichever is faster, for MJX on level ground, and to MJX alone with as many robots for the environment, all
measured in the same run. On stairs MJX has no ratio: MuJoCo C runs on level ground alone.
"""

from __future__ import annotations

import dataclasses
import os
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import measure
import mujoco
import mujoco.rollout
import numpy as np

from bipedtrack import autoreset, curriculum, policy, robot, training
from bipedtrack.env import TrackingEnv

_WARM_UP = 0.5  # s simulated before anything is timed, so that feet are on the ground and robots differ


@dataclasses.dataclass(frozen=True)
class Rollout:
    """Rates of MuJoCo C, MJX and the environment over the number of robots."""

    robots: tuple[int, ...] = (64, 256, 640, 1024, 2048, 4096, 8192)
    """Numbers of robots."""
    steps: int = 200
    """Physics steps of each robot that are timed at once."""
    policy: str = "models/policies/best.npz"
    """The policy that acts, so that the robots do what they usually do."""
    stairs: bool = True
    """Also on stairs, which cost three boxes."""
    devices: int = 0
    """Devices that the CPU counts as; 0: one for each core, or fewer that share the robots evenly."""


class Rate(NamedTuple):
    """What was measured of a case."""

    rate: float  # physics steps per second
    compile_s: float
    bytes_a_robot: float  # of the state that is carried from step to step


def wobble(robots: int, steps: int, joints: int) -> np.ndarray:
    """Joint targets' deviations (robots, steps, joints), rad: slow, small and different for each robot."""
    phase = np.random.default_rng(0).uniform(0, 2 * np.pi, (robots, 1, joints))
    return 0.05 * np.sin(2 * np.pi * 1.5 * 0.005 * np.arange(steps)[None, :, None] + phase)


def mujoco_c(model: Any, threads: int, robots: int, steps: int) -> float:
    """Physics steps per second of MuJoCo C on robots that stand under wobbling joint targets."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    state = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    targets = data.ctrl + wobble(robots, steps, model.nu)
    datas = [mujoco.MjData(model) for _ in range(threads)]
    with mujoco.rollout.Rollout(nthread=threads if threads > 1 else 0) as pool:
        seconds = measure.seconds_of(lambda: pool.rollout(model, datas, np.tile(state, (robots, 1)), targets)[0])
    return robots * steps / seconds


def _begun(begin: Any, robots: int, devices: int) -> Any:
    """First states of robots, shared out over the devices."""
    return jax.pmap(begin)(measure.shared_out(jax.random.split(jax.random.PRNGKey(0), robots), devices))


def _bytes(tree: Any, robots: int) -> float:
    return sum(leaf.nbytes for leaf in jax.tree.leaves(tree)) / robots


def mjx_alone(the_env: TrackingEnv, robots: int, steps: int, devices: int) -> Rate:
    """MJX on robots that stand under the same wobbling joint targets."""
    physics = _begun(jax.vmap(the_env.reset), robots, devices).pipeline_state
    deviations = measure.shared_out(jnp.asarray(wobble(robots, steps, 12), jnp.float32), devices).swapaxes(1, 2)
    targets = physics.qpos[:, None, :, 7:] + deviations

    def run(physics: Any, targets: Any) -> Any:
        simulate = jax.vmap(lambda physics, ctrl: the_env.simulate(physics, ctrl, jnp.zeros(3)))
        return jax.lax.scan(lambda carry, ctrl: (simulate(carry, ctrl), None), physics, targets)[0]

    made, compiling = measure.compiled(run, physics, targets)
    return Rate(robots * steps / measure.seconds_of(lambda: made(physics, targets)), compiling, _bytes(physics, robots))


def environment(the_env: TrackingEnv, driven: policy.Policy | None, robots: int, steps: int, devices: int) -> Rate:
    """Planner, kinematics, MJX, rewards and auto-reset, and the network of a policy where one is given."""
    wrapped = autoreset.AutoReset(the_env, 500)
    state = _begun(wrapped.reset, robots, devices)
    length = max(1, steps // the_env.substeps)

    def step(state: Any, _: None) -> tuple[Any, None]:
        if driven is None:
            return wrapped.step(state, jnp.zeros((len(state.obs), 12))), None
        return wrapped.step(state, driven.output(state.obs)), None

    made, compiling = measure.compiled(lambda state: jax.lax.scan(step, state, length=length)[0], state)
    for _ in range(max(1, round(_WARM_UP / (length * the_env.config.policy_period)))):
        state = made(state)
    rate = robots * length * the_env.substeps / measure.seconds_of(lambda: made(state))
    return Rate(rate, compiling, _bytes(state, robots))


def main(options: Rollout) -> None:
    """Prints a line for every case. Raises Refusal for options that cannot be."""
    measure.require_positive(steps=options.steps, robots=min(options.robots, default=0))
    devices = measure.use_devices(options.devices, lambda count: all(robots % count == 0 for robots in options.robots))
    driven = policy.load_for_simulation(options.policy)
    plan = curriculum.load("best")
    plan = dataclasses.replace(plan, control=driven.settings, policy_period=driven.policy_period)
    model = robot.build_model(driven.robot.name)
    limit = 0.0
    for threads in dict.fromkeys((1, os.cpu_count() or 1)):
        rate = mujoco_c(model, threads, 256, options.steps)
        limit = max(limit, rate)
        measure.line(benchmark="rollout", case="MuJoCo C", threads=threads, robots=256, rate=rate)
    grounds = {"flat": plan.stages[0], "stairs": plan.stages[1]}
    for ground in ("flat", "stairs") if options.stairs else ("flat",):
        the_env = training.make_env(plan, grounds[ground], grounds[ground].lessons[0])
        for robots in options.robots:
            case = {"benchmark": "rollout", "ground": ground, "robots": robots, "steps": options.steps}
            alone = mjx_alone(the_env, robots, options.steps, devices)
            beside_c = {"ratio": alone.rate / limit} if ground == "flat" else {}
            measure.line(**case, case="MJX", **alone._asdict(), **beside_c)
            whole = environment(the_env, driven, robots, options.steps, devices)
            measure.line(**case, case="environment", **whole._asdict(), ratio=whole.rate / alone.rate)


if __name__ == "__main__":
    measure.run(main, Rollout)
