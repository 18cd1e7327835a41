"""Episodes laid out beforehand: the same task steps for every policy and every simulator.

Task steps do not depend on what the robot does, so an episode of random ones, a footstep script and a staircase are all a
`Plan`: arrays that MJX indexes under jit and numpy walks through.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bipedtrack import footsteps, robot, sampling, tasks, terrain
from bipedtrack.nodes import Nodes
from bipedtrack.planner import TaskStep
from bipedtrack.rotations import Array

_PACES = (0.85, 1.2)  # least and greatest factor on the periods of a script that is trained with


class Plan(NamedTuple):
    """Task steps one after another; the last one is repeated for ever, so it should hold."""

    steps: TaskStep  # each array with a leading axis of s task steps
    boxes: Array  # (s, number of boxes, 7) position m and quaternion of every box during each task step


def random_plan(key: Array, given: sampling.Distribution, the_robot: robot.Robot, steps: int) -> Plan:
    """An episode of `steps` task steps drawn at random, with the boxes of its stairs; for `jit` and `vmap`."""
    key, key_begin = jax.random.split(key)
    task, start = tasks.begin(key_begin, given, the_robot)

    def one(start: Nodes, numbered: tuple[Array, Array]) -> tuple[Nodes, tuple[TaskStep, Array]]:
        index, key = numbered
        step = tasks.next_step(key, given, task, index, start, the_robot)
        return step.end, (step, tasks.stair_window(given, task, index))

    _, (laid_out, boxes) = jax.lax.scan(one, start, (jnp.arange(steps), jax.random.split(key, steps)))
    return Plan(laid_out, boxes)


def script_plan(script: footsteps.Script) -> Plan:
    """A footstep script as a plan, its end held; numpy."""
    last = script.steps[-1]
    hold = last._replace(
        start=last.end,
        swing=np.zeros(2),
        lift=np.zeros(2),
        ankle_points=np.repeat(last.end.ankle_positions[:, None], last.ankle_points.shape[1], axis=1),
        pendulum=np.float64(0),
    )
    boxes = np.array([np.concatenate([box.position, box.orientation]) for box in script.boxes]).reshape(-1, 7)
    steps = jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *script.steps, hold)
    return Plan(steps, np.tile(boxes, (len(script.steps) + 1, 1, 1)))


def _begin(key: Array, plan: Plan, the_robot: robot.Robot) -> tuple[tuple[()], Nodes]:
    return (), jax.tree.map(lambda leaf: leaf[0], plan.steps.start)


def _next_step(key: Array, plan: Plan, task: tuple[()], index: Array, start: Nodes, the_robot: robot.Robot) -> TaskStep:
    return jax.tree.map(lambda leaf: leaf[_number(plan, index)], plan.steps)


def _boxes(plan: Plan, task: tuple[()], index: Array) -> Array:
    return plan.boxes[_number(plan, index)]


def _number(plan: Plan, index: Array) -> Array:
    return jnp.minimum(index, plan.boxes.shape[0] - 1)


PLANNED = tasks.Source(_begin, _next_step, _boxes, lambda plan, task: jnp.float32(0))


class ScriptedTask(NamedTuple):
    """What an episode keeps that is either drawn at random or one of a library's."""

    random: tasks.Task
    scripted: Array  # () bool
    number: Array  # () of the plan in the library
    pace: Array  # () factor on its periods


def library(scripts: Sequence[footsteps.Script]) -> Plan:
    """The plans of scripts and of their mirror images, (2 n, s, ...), the shorter ones filled up with holds; numpy.

    The boxes are those of a staircase, out of the way; the scripts' own are left out.
    """
    both = [plan for script in scripts for plan in (script_plan(script), mirrored(script_plan(script)))]
    longest = max(len(plan.steps.period) for plan in both)

    def filled(plan: Plan) -> Plan:
        missing = longest - len(plan.steps.period)
        steps = jax.tree.map(lambda leaf: np.concatenate([leaf, np.repeat(leaf[-1:], missing, axis=0)]), plan.steps)
        return Plan(steps, np.tile(terrain.parked(), (longest, 1, 1)))

    return jax.tree.map(lambda *leaves: np.stack(leaves).astype(np.float32), *map(filled, both))


def mirrored(plan: Plan) -> Plan:
    """The plan with left and right exchanged; numpy. Its boxes stay where they are."""

    def nodes(place: Nodes) -> Nodes:
        return Nodes(
            trunk_position=place.trunk_position * [1, -1, 1],
            trunk_orientation=place.trunk_orientation * [1, -1, 1, -1],
            ankle_positions=place.ankle_positions[..., ::-1, :] * [1, -1, 1],
            ankle_yaws=-place.ankle_yaws[..., ::-1],
        )

    steps = plan.steps
    return plan._replace(
        steps=steps._replace(
            start=nodes(steps.start),
            end=nodes(steps.end),
            swing=steps.swing[..., ::-1],
            lift=steps.lift[..., ::-1],
            ankle_points=steps.ankle_points[..., ::-1, :, :] * [1, -1, 1],
            pivot=steps.pivot * [1, -1],
        )
    )


def with_scripts(source: tasks.Source, plans: Plan, share: float) -> tasks.Source:
    """A source of which a share of the episodes follows a library's plans, each at a pace of its own, and then holds."""
    count, length = plans.boxes.shape[:2]

    def begin(key: Array, given: Any, the_robot: robot.Robot) -> tuple[ScriptedTask, Nodes]:
        key, key_script = jax.random.split(key)
        u = jax.random.uniform(key_script, (3,))
        drawn, start = source.begin(key, given, the_robot)
        number = jnp.minimum((count * u[1]).astype(jnp.int32), count - 1)
        task = ScriptedTask(drawn, u[0] < share, number, _PACES[0] + u[2] * (_PACES[1] - _PACES[0]))
        return task, _either(task, jax.tree.map(lambda leaf: leaf[number, 0], on_device.steps.start), start)

    def next_step(
        key: Array, given: Any, task: ScriptedTask, index: Array, start: Nodes, the_robot: robot.Robot
    ) -> TaskStep:
        step = jax.tree.map(lambda leaf: leaf[task.number, jnp.minimum(index, length - 1)], on_device.steps)
        period = jnp.round(task.pace * step.period / the_robot.timestep) * the_robot.timestep
        drawn = source.next_step(key, given, task.random, index, start, the_robot)
        return _either(task, step._replace(period=period), drawn)

    def boxes(given: Any, task: ScriptedTask, index: Array) -> Array:
        return jnp.where(task.scripted, on_device.boxes[task.number, 0], source.boxes(given, task.random, index))

    on_device = jax.tree.map(jnp.asarray, plans)
    return tasks.Source(begin, next_step, boxes, lambda given, task: source.push(given, task.random))


def _either(task: ScriptedTask, scripted: Any, drawn: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(task.scripted, a, b), scripted, drawn)


def step_numbers(plan: Any, timestep: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The task step, (count,), and the control step within it, (count,), at each of `count` control steps; numpy."""
    lengths = np.round(np.asarray(plan.steps.period) / timestep).astype(int)
    starts = np.concatenate([[0], np.cumsum(lengths)])
    ticks = np.arange(count)
    index = np.searchsorted(starts, ticks, side="right") - 1
    last = len(lengths) - 1
    within = np.where(index > last, (ticks - starts[last]) % lengths[last], ticks - starts[np.minimum(index, last)])
    return np.minimum(index, last), within
