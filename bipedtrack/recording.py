"""Traces of many planned episodes at 200 Hz, in MJX and in MuJoCo C, with the same plans and the same controller."""

from __future__ import annotations

import copy
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bipedtrack import control, env, falls, kinematics, observation, planner, plans, robot
from bipedtrack.disturbances import UNDISTURBED, Hooks
from bipedtrack.nodes import Nodes, stationary
from bipedtrack.rotations import Array
from bipedtrack.trace import Trace

Act = Callable[[Array], Array]  # the network's output (12,) for an observation (101,), in jax.numpy
_CHUNK = 50  # policy steps between two looks at whether anybody is still up


class _Sample(NamedTuple):
    """A Trace's entries of one instant, but for those that follow from them."""

    qpos: Array
    qvel: Array
    target: Nodes
    timer: Array
    still: Array
    feedback: Array
    joint_targets: Array
    foot_forces: Array
    alive: Array


class FirstCommandEnv(env.TrackingEnv):
    """A planned environment without feedforward: it stays at the episode's first command."""

    def feedforward_nodes(self, episode: env.Episode, command: planner.Command) -> Nodes:
        """Where the episode began."""
        return jax.tree.map(lambda leaf: leaf[0], episode.given.steps.start)


def mjx_recorder(the_env: env.TrackingEnv, act: Act) -> Callable[[plans.Plan, float], Trace]:
    """A function (batch of plans with leading axis e, seconds) -> trace in MJX, which compiles once for all batches.

    `the_env` needs plans.PLANNED as its source, the batches' boxes, and touch sensors.
    """

    def policy_step(carry: tuple[Any, Array], _: None) -> tuple[tuple[Any, Array], _Sample]:
        state, alive = carry
        a_fb = control.feedback(the_env.config.control, act(state.obs))
        episode, following = the_env.look_ahead(state.info["episode"])

        def control_step(carry: Any, _: None) -> tuple[Any, _Sample]:
            (physics, episode), alive = carry
            command = the_env.command(episode)
            alive = alive & _up(physics.qpos, physics.qvel)
            moved, answer = the_env.control_step(physics, episode, following, a_fb)
            sample = _Sample(
                physics.qpos, physics.qvel, command.target, command.timer, stationary(command.rates), a_fb,
                answer.joint_targets, moved[0].sensors, alive,
            )  # fmt: skip
            return (moved, alive), sample

        start = ((state.pipeline_state, episode), alive)
        ((physics, episode), alive), samples = jax.lax.scan(control_step, start, length=the_env.substeps)
        episode = episode._replace(feedback=a_fb)
        obs = the_env.observe(physics, episode, the_env.command(episode))
        return (state.replace(pipeline_state=physics, obs=obs, info={"episode": episode}), alive), samples

    @jax.jit
    def advance(carry: tuple[Any, Array]) -> tuple[tuple[Any, Array], _Sample]:
        one = lambda state, alive: jax.lax.scan(policy_step, (state, alive), length=_CHUNK)  # noqa: E731
        return jax.vmap(one)(*carry)

    begin = jax.jit(jax.vmap(the_env.begin))
    measure = _measure(the_env.robot)

    def record(batch: plans.Plan, seconds: float) -> Trace:
        robots, ticks = batch.boxes.shape[0], round(seconds / the_env.robot.timestep)
        state = begin(jax.random.split(jax.random.PRNGKey(0), robots), batch)
        carry = (state, jnp.ones(robots, bool))
        chunks = []
        for _ in range(-(-ticks // (_CHUNK * the_env.substeps))):
            carry, samples = advance(carry)
            chunks.append(jax.tree.map(lambda a: np.asarray(a).reshape(robots, -1, *a.shape[3:]), samples))
            if not np.asarray(carry[1]).any():
                break
        samples = jax.tree.map(lambda *parts: _of_length(np.concatenate(parts, axis=1), ticks), *chunks)
        return _complete(the_env.robot, samples, measure)

    return record


class _Memory(NamedTuple):
    """What the controller remembers of one robot."""

    control: control.ControlState
    feedback: Array


class Controls(NamedTuple):
    """The controller of a policy, for recording in C."""

    robot: robot.Robot
    settings: control.ControlConfig
    policy_period: float  # s
    act: Act
    feedforward: bool = True  # False: it stays at the first command's


def mujoco_recorder(controls: Controls) -> Callable[..., Trace]:
    """A function (batch, sizes, seconds, ...) -> trace in MuJoCo C, stepped on all cores; it compiles once for each shape.

    The control law is the controller's own functions mapped over the robots; `policy.Controller` runs the same lines.
    Arguments of the function:

    - batch: plans with leading axis e, numpy or jax arrays.
    - sizes: of the plans' boxes, m.
    - seconds: how long.
    - converged: solve contacts to convergence.
    - hooks: what may go otherwise.
    """
    import mujoco

    the_robot = controls.robot
    hold = control.substeps(controls.policy_period, the_robot.timestep)

    @jax.jit
    @jax.vmap
    def answer(plan: plans.Plan, number: Array, tick: Array, memory: _Memory, qpos: Array, qvel: Array, think: Array) -> Any:
        command = planner.command(jax.tree.map(lambda a: a[number], plan.steps), tick * the_robot.timestep)
        wanted = command.target if controls.feedforward else jax.tree.map(lambda a: a[0], plan.steps.start)
        a_ff = control.feedforward(the_robot, controls.settings, wanted)
        real = kinematics.measure(the_robot, qpos)
        seen = observation.flatten(observation.observe(command, real, qpos, qvel, a_ff, memory.feedback))
        fresh = control.feedback(controls.settings, controls.act(seen))
        a_fb = jnp.where(think, fresh, memory.feedback)
        targets, state = control.respond(the_robot, controls.settings, memory.control, a_ff, a_fb, command, qpos, qvel)
        return targets, _Memory(state, a_fb), command.target, command.timer, stationary(command.rates)

    start = jax.jit(jax.vmap(lambda plan: _start(the_robot, controls.settings, plan)))
    measure = _measure(the_robot)

    def record(
        batch: plans.Plan,
        sizes: Sequence[Sequence[float]],
        seconds: float,
        converged: bool = False,
        hooks: Hooks = UNDISTURBED,
    ) -> Trace:
        robots, ticks = batch.boxes.shape[0], round(seconds / the_robot.timestep)
        batch = jax.tree.map(np.asarray, batch)
        models = _models(robot.build_model(the_robot.name, sizes, converged, touch=True), robots, hooks)
        datas = [mujoco.MjData(model) for model in models]
        numbers = [
            plans.step_numbers(jax.tree.map(lambda a, i=i: a[i], batch), the_robot.timestep, ticks) for i in range(robots)
        ]
        index, within = (np.array(column) for column in zip(*numbers, strict=True))
        qpos, memory = start(batch)
        for data, first in zip(datas, np.asarray(qpos, np.float64), strict=True):
            data.qpos[:] = first
        alive = np.ones(robots, bool)
        samples = []

        def simulate(members: range) -> None:
            for i in members:
                if alive[i]:
                    mujoco.mj_step(models[i], datas[i])

        workers = os.cpu_count() or 1
        shares = [range(w, robots, workers) for w in range(workers)]
        on_device = jax.device_put(batch)
        with ThreadPoolExecutor(workers) as pool:
            for tick in range(ticks):
                for i in np.flatnonzero((index[:, tick] != index[:, tick - 1]) | (tick == 0)):
                    poses = batch.boxes[i, index[i, tick]]
                    datas[i].mocap_pos[:], datas[i].mocap_quat[:] = poses[:, :3], poses[:, 3:]
                qpos, qvel = np.array([d.qpos for d in datas]), np.array([d.qvel for d in datas])
                alive = alive & _up(qpos, qvel)
                seen = (qpos, qvel) if hooks.observed is None else hooks.observed(tick, qpos, qvel)
                told = [np.where(alive[:, None], part, 0.0).astype(np.float32) for part in seen]
                think = np.full(robots, tick % hold == 0)
                targets, memory, target, timer, still = answer(
                    on_device, index[:, tick], within[:, tick], memory, *told, think
                )
                wanted = np.asarray(targets, np.float64)
                if hooks.before_step is not None:
                    wanted = hooks.before_step(tick, datas, wanted)
                for data, ctrl in zip(datas, wanted, strict=True):
                    data.ctrl[:] = ctrl
                list(pool.map(simulate, shares))
                forces = np.array([d.sensordata for d in datas])
                target, timer, still, feedback = jax.tree.map(np.asarray, (target, timer, still, memory.feedback))
                samples.append(_Sample(qpos, qvel, target, timer, still, feedback, wanted, forces, alive))
                if not alive.any():
                    break
        stacked = jax.tree.map(lambda *parts: _of_length(np.stack(parts, axis=1), ticks), *samples)
        return _complete(the_robot, stacked, measure)

    return record


def _models(model: Any, robots: int, hooks: Hooks) -> list[Any]:
    """The model of each robot: one for all, or one of its own for each."""
    import mujoco

    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    if hooks.model_of is None:
        return [model] * robots
    models = [hooks.model_of(copy.copy(model), i) for i in range(robots)]
    for changed in models:
        mujoco.mj_setConst(changed, mujoco.MjData(changed))  # what MuJoCo derives from masses
    return models


def _start(the_robot: robot.Robot, settings: control.ControlConfig, plan: plans.Plan) -> tuple[Array, _Memory]:
    """A robot, qpos (19,), on the plan's first command, soles level, and a controller that asks for that."""
    qpos, memory = env.standing(the_robot, settings, jax.tree.map(lambda a: a[0], plan.steps.start))
    return qpos, _Memory(memory, jnp.zeros(len(the_robot.joint_names)))


def _of_length(entries: np.ndarray, ticks: int) -> np.ndarray:
    """Entries (e, n, ...) cut to n = ticks, or filled up with the last one: what follows when everybody has fallen."""
    missing = ticks - entries.shape[1]
    return entries[:, :ticks] if missing <= 0 else np.concatenate([entries, entries[:, -1:].repeat(missing, axis=1)], axis=1)


def _up(qpos: Array, qvel: Array) -> Array:
    """(...) bool: what can be seen of `falls` without the targets, so that a robot that lies is not simulated on."""
    return falls.finite(qpos, qvel) & falls.upright(qpos[..., 3:7])


def _measure(the_robot: robot.Robot) -> Callable[[Array, Nodes], tuple[Nodes, Array]]:
    """The nodes of a robot at qpos (e, n, 19) and whether it is falling, with these targets, compiled."""

    def at_one(qpos: Array, target: Nodes) -> tuple[Nodes, Array]:
        measured = kinematics.measure(the_robot, qpos)
        return measured, falls.fell(target, measured)

    return jax.jit(jax.vmap(jax.vmap(at_one)))


def _complete(the_robot: robot.Robot, samples: _Sample, measure: Callable[[Array, Nodes], tuple[Nodes, Array]]) -> Trace:
    """The trace of samples (e, n, ...): with measured nodes, torques (of undisturbed motors) and time."""
    measured, fell = jax.tree.map(np.asarray, measure(samples.qpos, samples.target))
    wanted = the_robot.kp * (samples.joint_targets - samples.qpos[..., 7:]) - the_robot.kd * samples.qvel[..., 6:]
    return Trace(
        time=np.arange(samples.qpos.shape[1]) * the_robot.timestep,
        qpos=samples.qpos,
        qvel=samples.qvel,
        target=samples.target,
        measured=measured,
        timer=samples.timer,
        still=samples.still,
        feedback=samples.feedback,
        joint_targets=samples.joint_targets,
        torques=np.clip(wanted, -the_robot.torque_limit, the_robot.torque_limit),
        foot_forces=samples.foot_forces,
        alive=samples.alive & ~np.logical_or.accumulate(fell, axis=1),
    )
