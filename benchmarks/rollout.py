"""How fast robots are simulated: MuJoCo C, MJX alone, and the whole environment with policy and auto-reset.

python benchmarks/rollout.py --robots 64 512 2048

All rates are physics steps of 0.005 s per second, with the MJCF's own solver. `ratio` is to MuJoCo C on all cores for
MJX, and to MJX alone with as many robots for the environment, both measured in the same run.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import measure
import mujoco
import mujoco.rollout
import numpy as np
import tyro

from bipedtrack import autoreset, curriculum, policy, robot, terrain, training
from bipedtrack.env import TrackingEnv

POLICY = "models/policies/first.npz"
SECONDS = 0.5  # simulated before anything is timed, so that feet are on the ground and robots differ


@dataclasses.dataclass(frozen=True)
class Rollout:
    """Rates of MuJoCo C, MJX and the environment over the number of robots."""

    robots: tuple[int, ...] = (64, 256, 512, 640, 1024, 2048, 4096, 8192)
    """Numbers of robots."""
    steps: int = 200
    """Physics steps of each robot that are timed at once."""
    policy: str = POLICY
    """The policy that acts; its observations keep the robots at a usual task."""
    stairs: bool = True
    """Also the environment with stairs."""


def mujoco_c(model: Any, threads: int, robots: int, steps: int) -> float:
    """Physics steps per second of MuJoCo C on robots that stand under constant joint targets."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    state = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    states = np.tile(state, (robots, 1))
    targets = np.tile(data.ctrl, (robots, steps, 1)) + _wobble(robots, steps, model.nu)
    datas = [mujoco.MjData(model) for _ in range(threads)]
    with mujoco.rollout.Rollout(nthread=threads if threads > 1 else 0) as pool:
        seconds = measure.seconds_of(lambda: pool.rollout(model, datas, states, targets)[0])
    return robots * steps / seconds


def _wobble(robots: int, steps: int, joints: int) -> np.ndarray:
    """Joint targets' deviations, rad: slow, small and different for each robot."""
    phase = np.random.default_rng(0).uniform(0, 2 * np.pi, (robots, 1, joints))
    return 0.05 * np.sin(2 * np.pi * 1.5 * 0.005 * np.arange(steps)[None, :, None] + phase)


def mjx_alone(the_env: TrackingEnv, robots: int, steps: int) -> tuple[float, float]:
    """Physics steps per second of MJX on the same robots and targets, and the seconds of compiling."""
    state = jax.jit(jax.vmap(the_env.reset))(jax.random.split(jax.random.PRNGKey(0), robots))
    physics = state.pipeline_state
    targets = physics.qpos[None, :, 7:] + jnp.asarray(_wobble(robots, steps, 12).swapaxes(0, 1), jnp.float32)

    def run(physics: Any, targets: Any) -> Any:
        step = lambda carry, ctrl: (jax.vmap(the_env.simulate)(carry, ctrl), None)  # noqa: E731
        return jax.lax.scan(step, physics, targets)[0]

    made, compiling = measure.compiled(run, physics, targets)
    return robots * steps / measure.seconds_of(lambda: made(physics, targets)), compiling


def environment(the_env: TrackingEnv, driven: policy.Policy, robots: int, steps: int) -> tuple[float, float, float]:
    """Physics steps per second of planner, kinematics, network, MJX, rewards and auto-reset; compile s; bytes a robot."""
    wrapped = autoreset.AutoReset(the_env, 500)
    state = jax.jit(wrapped.reset)(jax.random.split(jax.random.PRNGKey(0), robots))

    def run(state: Any, length: int) -> Any:
        def step(state: Any, _: None) -> tuple[Any, None]:
            return wrapped.step(state, policy.apply(driven.network, driven.activation, state.obs)), None

        return jax.lax.scan(step, state, length=length)[0]

    length = max(1, steps // the_env.substeps)
    made, compiling = measure.compiled(lambda state: run(state, length), state)
    for _ in range(max(1, round(SECONDS / (length * the_env.substeps * the_env.robot.timestep)))):
        state = made(state)
    carried = sum(leaf.nbytes for leaf in jax.tree.leaves(state)) / robots
    return robots * length * the_env.substeps / measure.seconds_of(lambda: made(state)), compiling, carried


def main(options: Rollout) -> None:
    """Prints a line for every case."""
    driven = policy.load(options.policy, robot.load())
    plan = curriculum.load("quick")
    plan = dataclasses.replace(plan, control=driven.settings, policy_period=driven.policy_period)
    flat, stairs = plan.stages[0], plan.stages[1]
    common = {"benchmark": "rollout", **measure.machine()}
    model = robot.build_model(driven.robot.name)
    rates = {}
    for threads in dict.fromkeys((1, os.cpu_count() or 1)):
        rates[threads] = mujoco_c(model, threads, 256, options.steps)
        measure.line(**common, case="MuJoCo C", threads=threads, robots=256, rate=rates[threads])
    limit = max(rates.values())
    grounds: Sequence[tuple[str, Any]] = [("flat", flat), *([("stairs", stairs)] if options.stairs else [])]
    for name, stage in grounds:
        the_env = training.make_env(plan, stage, 0.5)
        boxes = terrain.STAIR_BOXES if stage.shares.stairs else 0
        for robots in options.robots:
            sizes = {"ground": name, "boxes": boxes, "robots": robots, "steps": options.steps}
            alone, compiling = mjx_alone(the_env, robots, options.steps)
            measure.line(**common, case="MJX", **sizes, compile_s=compiling, rate=alone, ratio=alone / limit)
            whole, compiling, carried = environment(the_env, driven, robots, options.steps)
            found = {"compile_s": compiling, "rate": whole, "ratio": whole / alone, "bytes_a_robot": carried}
            measure.line(**common, case="environment", **sizes, **found)


if __name__ == "__main__":
    main(tyro.cli(Rollout))
