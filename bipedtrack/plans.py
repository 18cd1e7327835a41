"""Episodes laid out beforehand: the same task steps for every policy and every simulator.

Task steps do not depend on what the robot does, so an episode of random ones, a footstep script and a staircase are all a
`Plan`: arrays that MJX indexes under jit and numpy walks through.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bipedtrack import footsteps, robot, tasks
from bipedtrack.nodes import Nodes
from bipedtrack.planner import TaskStep
from bipedtrack.rotations import Array


class Plan(NamedTuple):
    """Task steps one after another; the last one is repeated for ever, so it should hold."""

    steps: TaskStep  # each array with a leading axis of s task steps
    boxes: Array  # (s, number of boxes, 7) position m and quaternion of every box during each task step


def random_plan(key: Array, given: tasks.Distribution, the_robot: robot.Robot, steps: int) -> Plan:
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


def step_numbers(plan: Any, timestep: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The task step, (count,), and the control step within it, (count,), at each of `count` control steps; numpy."""
    lengths = np.round(np.asarray(plan.steps.period) / timestep).astype(int)
    starts = np.concatenate([[0], np.cumsum(lengths)])
    ticks = np.arange(count)
    index = np.searchsorted(starts, ticks, side="right") - 1
    last = len(lengths) - 1
    within = np.where(index > last, (ticks - starts[last]) % lengths[last], ticks - starts[np.minimum(index, last)])
    return np.minimum(index, last), within
