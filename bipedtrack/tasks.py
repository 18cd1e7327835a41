"""The task steps of Table II drawn at random: what an episode asks for, and each of its task steps in turn.

`wander` is ours: every foothold anywhere within reach, and another posture with every step.

Random numbers are jax's; the namespace is jax.numpy.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from bipedtrack import kinematics, nodes, planner, rotations, statics, terrain
from bipedtrack.footholds import FOOT_DISTANCE
from bipedtrack.nodes import Nodes
from bipedtrack.planner import TaskStep
from bipedtrack.robot import Robot
from bipedtrack.rotations import Array
from bipedtrack.sampling import SIDLE, SQUAT, STAIRS, WALK, WANDER, Distribution, sample, within

MIX_STEPS = 4  # task steps of one kind in an episode of many; even, for a sidle is made of pairs, but for breaks
ERRORS = ("ankle_error_cm", "ankle_yaw_error_deg", "trunk_error_cm", "trunk_error_deg")  # of `tracking_errors`
_BREAKS = (2.0, 7.0)  # task steps from one break to the next, and one more than the most
_CLEARANCE = 0.02  # m between a sole and the edge of a tread that it is led over
_MARGIN = 0.015  # m before its toe and behind its heel, of which 1 cm is the contact spheres'


class Motion(NamedTuple):
    """What task steps of one kind have in common."""

    kind: Array  # () index in KINDS
    advance: Array  # (3,) x m, y m, yaw rad by which the place of the feet moves on, per task step
    first: Array  # () foot that swings at even task steps, 0 left, 1 right
    period: Array  # () s
    lift: Array  # () m
    trunk_height: Array  # () m
    sway: Array  # () in [0, 1], planner.TaskStep.pendulum as a share of statics.pendulum; 0: the paper's uniform trunk


class Task(NamedTuple):
    """What an episode keeps from its first to its last task step."""

    motion: Motion
    stairs: terrain.Stairs
    hold_after: Array  # () number of task steps after which every target stays where it is
    mixes: Array  # () bool: another motion every MIX_STEPS task steps
    key: Array  # of those motions
    break_every: Array  # () number of task steps of which the last one is a break
    pauses: Array  # () bool: in a break nothing moves; else the swing foot comes beside the other one
    push: Array  # () N s, the greatest impulse of a push


class _Posture(NamedTuple):
    """How the trunk is held over the feet."""

    centre: Array  # (2,) m, the centre of mass ahead of and to the left of the feet's middle
    height: Array  # () m, the trunk above the mean of the soles
    roll: Array  # () rad
    pitch: Array  # () rad
    yaw: Array  # () rad, from the mean of the feet's


def _drawn_posture(draw: dict[str, Array]) -> _Posture:
    centre = jnp.stack([draw["posture_x"], draw["posture_y"]])
    return _Posture(centre, draw["posture_height"], draw["posture_roll"], draw["posture_pitch"], draw["posture_yaw"])


def _upright(height: Array) -> _Posture:
    zero = jnp.float32(0)
    return _Posture(jnp.zeros(2), height, zero, zero, zero)


def _over_feet(posture: _Posture, ankles: Array, yaws: Array, robot: Robot) -> Nodes:
    """Nodes with the trunk held so over ankles (2, 3), m, with yaws (2,), that its centre of mass stands where it should."""
    yaw = yaws.mean()
    middle = ankles.mean(axis=0)
    c, s = jnp.cos(yaw), jnp.sin(yaw)
    centre = middle[:2] + jnp.array([[c, -s], [s, c]]) @ posture.centre
    height = middle[2:] + posture.height - robot.ankle_height
    orientation = rotations.from_euler(posture.roll, posture.pitch, yaw + posture.yaw)
    nodes = Nodes(jnp.concatenate([centre, height]), orientation, ankles, yaws)
    return jax.lax.fori_loop(0, 3, lambda _, nodes: kinematics.balanced(robot, nodes, centre), nodes)


_POSTURE = ("posture_x", "posture_y", "posture_height", "posture_roll", "posture_pitch", "posture_yaw")


def _motion(key: Array, given: Distribution, level: bool) -> tuple[Motion, dict[str, Array]]:
    """Task steps of a kind drawn by its share, of those on level ground or of all, and what else was drawn for them."""
    key_kind, key_motion = jax.random.split(key)
    u: Array = jax.random.uniform(key_kind, (2,))
    reach = given.shares[STAIRS - 1] if level else 1.0
    kind = jnp.minimum(jnp.searchsorted(given.shares, reach * u[0], side="right"), STAIRS - 1 if level else STAIRS)
    draw = sample(
        key_motion,
        ("period", "walk_step", "sidle_step", "turn_yaw", "turn_radius", "stair_riser", "stair_tread", "lift")
        + ("trunk_height", "stair_trunk_height", "foot_x", "foot_distance", "foot_yaw", "sway"),
        given.ranges,
    )
    turn, radius = draw["turn_yaw"], draw["turn_radius"]
    arc = jnp.stack([radius * jnp.sin(jnp.abs(turn)), jnp.sign(turn) * radius * (1 - jnp.cos(turn)), turn])
    zero = jnp.float32(0)
    advances = jnp.stack(
        [
            jnp.zeros(3),
            jnp.zeros(3),
            jnp.stack([draw["walk_step"], zero, zero]),
            # the leading foot opens by twice the step, the other one closes up
            jnp.stack([zero, 2 * draw["sidle_step"], zero]),
            arc,
            jnp.zeros(3),  # every step of a wanderer has its own
            jnp.stack([draw["stair_tread"], zero, zero]),
        ]
    )
    # the leading foot of a sidle is the one on the side it goes to
    first = jnp.where(kind == SIDLE, (draw["sidle_step"] < 0).astype(jnp.int32), (u[1] < 0.5).astype(jnp.int32))
    height = jnp.where(kind == STAIRS, draw["stair_trunk_height"], draw["trunk_height"])
    sway = jnp.clip(draw["sway"], 0.0, 1.0)
    return Motion(kind, advances[kind], first, draw["period"], draw["lift"], height, sway), draw


def begin(key: Array, given: Distribution, robot: Robot) -> tuple[Task, Nodes]:
    """A new episode's task and the nodes it starts from."""
    key_motion, key_task, key_posture, key_mix = jax.random.split(key, 4)
    motion, draw = _motion(key_motion, given, level=False)
    u: Array = jax.random.uniform(key_task, (5,))
    still, on_stairs, ranges = motion.kind <= SQUAT, motion.kind == STAIRS, given.ranges
    down = u[0] < given.down_share
    rise = jnp.where(on_stairs, jnp.where(down, -draw["stair_riser"], draw["stair_riser"]), 0.0)
    stairs = terrain.Stairs(rise, draw["stair_tread"], jnp.where(on_stairs & down, -terrain.TREADS_DOWN * rise, 0.0))
    hold_after = jnp.floor(within(u[2], given.hold_after + jnp.array([0.0, 1.0])))
    v: Array = jax.random.uniform(jax.random.fold_in(key_task, 1), (3,))
    breaks = (v[0] < given.break_share) & ~still
    task = Task(
        motion=motion,
        stairs=stairs,
        hold_after=jnp.where(u[1] < given.hold_share, hold_after, 1e6).astype(jnp.int32),
        mixes=(u[3] < given.mix_share) & ~on_stairs,
        key=key_mix,
        break_every=jnp.where(breaks, jnp.floor(within(v[1], jnp.array(_BREAKS))), 1e6).astype(jnp.int32),
        pauses=v[2] < 0.5,
        push=jnp.where(u[4] < given.push_share, jnp.where(on_stairs, ranges["stair_push"], ranges["push"])[1], 0.0),
    )

    distance = jnp.where(still, draw["foot_distance"], FOOT_DISTANCE)
    ahead = jnp.where(still, draw["foot_x"], 0.0)
    side = jnp.array([0.5, -0.5])
    ankles = jnp.stack([side * ahead, side * distance, jnp.full(2, robot.ankle_height + stairs.height)], axis=-1)
    yaws = jnp.where(still, draw["foot_yaw"] * 2 * side, jnp.zeros(2))
    posture = _drawn_posture(sample(key_posture, _POSTURE, given.ranges))
    posture = jax.tree.map(functools.partial(jnp.where, still), posture, _upright(motion.trunk_height))
    return task, _over_feet(posture, ankles, yaws, robot)


def _present(given: Distribution, task: Task, index: Array) -> Motion:
    """The motion of task step `index`."""
    another, _ = _motion(jax.random.fold_in(task.key, index // MIX_STEPS), given, level=True)
    mixes = task.mixes & (index >= MIX_STEPS)
    return jax.tree.map(lambda new, old: jnp.where(mixes, new, old), another, task.motion)


def _advances(task: Task, index: Array) -> Array:
    """How many of the task steps before number `index` were no breaks."""
    return index - index // task.break_every


def _swings(task: Task, motion: Motion, index: Array) -> Array:
    """The foot that swings in task step `index`, 0 left, 1 right: in turn, also after a pause."""
    return (jnp.where(task.pauses, _advances(task, index), index) + motion.first) % 2


def _foothold(motion: Motion, rise: Array, closes: Array, swing: Array, advance: Array, start: Nodes) -> tuple[Array, Array]:
    """The end positions (2, 3) and yaws (2,) of both ankles: the swing foot beside the stance foot, moved on.

    Where it closes the place of the feet stays where the stance foot is.
    """
    stance = 1 - swing
    side = jnp.array([0.5, -0.5]) * FOOT_DISTANCE
    position, yaw = start.ankle_positions[stance], start.ankle_yaws[stance]
    advance = jnp.where(closes, 0.0, advance)
    new_yaw = yaw + advance[2]
    c, s = jnp.cos(yaw), jnp.sin(yaw)
    c2, s2 = jnp.cos(new_yaw), jnp.sin(new_yaw)
    # stance foot -> middle of the place -> moved on -> swing foot
    x = s * side[stance] + c * advance[0] - s * advance[1] - s2 * side[swing]
    y = -c * side[stance] + s * advance[0] + c * advance[1] + c2 * side[swing]
    foothold = position + jnp.stack([x, y, jnp.where(closes, 0.0, rise)])
    mine = jnp.arange(2) == swing
    return (
        jnp.where(mine[:, None], foothold, start.ankle_positions),
        jnp.where(mine, new_yaw, start.ankle_yaws),
    )


def _anywhere(key: Array, given: Distribution, outwards: Array) -> Array:
    """The advance (3,) to a foothold within an ellipse of what can be reached; outwards: 1 for the left foot, else -1.

    What is drawn beyond the ellipse comes onto it, a fifth of all: the farthest footholds are the hardest.
    """
    draw = sample(key, ("wander_x", "wander_y", "wander_yaw"), given.ranges)

    def share(name: str) -> Array:
        """Of the way to the end of the range."""
        low, high = given.ranges[name]
        end = jnp.where(draw[name] < 0, low, high)
        return draw[name] / jnp.where(end == 0, 1.0, end)

    beyond = jnp.maximum(jnp.hypot(share("wander_x"), share("wander_y")), 1.0)
    return jnp.stack([draw["wander_x"] / beyond, outwards * draw["wander_y"] / beyond, draw["wander_yaw"]])


def next_step(key: Array, given: Distribution, task: Task, index: Array, start: Nodes, robot: Robot) -> TaskStep:
    """Task step number `index` of an episode, from where the last one ended; of a whole number of control periods."""
    key_step, key_curve, key_posture = jax.random.split(key, 3)
    motion = _present(given, task, index)
    hold = index >= task.hold_after
    breaks = index % task.break_every == task.break_every - 1
    squats = (motion.kind == SQUAT) & ~hold
    steps = (motion.kind >= WALK) & ~hold & ~(breaks & task.pauses)

    vary = jax.random.uniform(key_step, (3,))
    vary = within(vary, given.ranges["step_variation"])
    bounds = given.ranges["period"]
    period = jnp.where(steps, jnp.clip(motion.period * vary[0], bounds[0], bounds[1]), 1.0)
    advance = jnp.where(motion.kind == STAIRS, motion.advance, motion.advance * vary[2])
    wanders = motion.kind == WANDER
    swings = _swings(task, motion, index)
    outwards = 1.0 - 2.0 * swings
    advance = jnp.where(wanders, _anywhere(jax.random.fold_in(key_posture, 1), given, outwards), advance)

    # a sidle's second foot closes up
    closes = breaks | ((motion.kind == SIDLE) & (swings != motion.first))
    footholds, headings = _foothold(motion, task.stairs.rise, closes, swings, advance, start)
    ankles = jnp.where(steps, footholds, start.ankle_positions)
    yaws = jnp.where(steps, headings, start.ankle_yaws)
    draw = sample(key_posture, (*_POSTURE, "squat_period", "trigonometric", "swing_ease"), given.ranges)
    period = jnp.where(squats, draw["squat_period"], period)
    drawn, upright = _drawn_posture(draw), _upright(motion.trunk_height)
    share = jnp.where(squats, 1.0, 0.5 * wanders)  # a wanderer goes half of the way that one who stands may go
    posture = jax.tree.map(lambda there, here: here + share * (there - here), drawn, upright)
    moves = functools.partial(jnp.where, squats | steps)
    end = jax.tree.map(moves, _over_feet(posture, ankles, yaws, robot), start)
    swing = jnp.where(steps, (jnp.arange(2) == swings).astype(jnp.float32), 0.0)
    pivot, frequency = statics.pendulum(robot, end, 1 - swings)
    u = jax.random.uniform(key_curve, (2, 3))
    along = jnp.array([0.05, 0.5, 0.95]) + within(u[0], given.ranges["curve_along"])
    curve = {"along": along, "height": within(u[1], given.ranges["curve_height"])}
    lift = swing * motion.lift * vary[1]
    edges = terrain.stair_edges(task.stairs, start.ankle_positions, ankles) + jnp.array([0.0, _CLEARANCE])
    reach = 0.5 * robot.sole[0] + _MARGIN
    over = planner.lift_over(start.ankle_positions, ankles, lift, **curve, edges=edges, reach=reach)
    lift = jnp.where(motion.kind == STAIRS, over, lift)
    points = planner.swing_points(start.ankle_positions, ankles, lift, **curve)
    return TaskStep(
        start=start,
        end=end,
        period=jnp.round(period / robot.timestep) * robot.timestep,
        swing=swing,
        ankle_points=points,
        lift=lift,
        # a trigonometric curve rises above its chord, which passes through the tread between two others
        trigonometric=((draw["trigonometric"] > 0) & (motion.kind != STAIRS)).astype(jnp.float32),
        ease=draw["swing_ease"],
        pivot=pivot,
        pendulum=motion.sway * swing.max() * frequency,
    )


def stair_window(given: Distribution, task: Task, index: Array) -> Array:
    """Poses (3, 7) of the boxes around the tread of the stance foot during task step `index`: position m, quaternion."""
    return terrain.upright(terrain.stair_boxes(task.stairs, _advances(task, jnp.minimum(index, task.hold_after))))


class Source(NamedTuple):
    """Where an environment's task steps come from: four pure functions of whatever data an episode is given."""

    begin: Callable[..., tuple[Any, Nodes]]  # (key, given, robot) -> task, first nodes
    next_step: Callable[..., TaskStep]  # (key, given, task, index, start, robot)
    boxes: Callable[..., Array]  # (given, task, index) -> (number of boxes, 7) poses
    push: Callable[..., Array]  # (given, task) -> () N s, the greatest impulse of a push


RANDOM = Source(begin, next_step, stair_window, lambda given, task: task.push)


def tracking_errors(errors: nodes.NodeErrors) -> dict[str, Array]:
    """Mean ankle and trunk errors as people quote them: cm and deg."""
    degree = 180 / jnp.pi
    return {
        "ankle_error_cm": 100 * jnp.linalg.norm(errors.ankle_positions, axis=-1).mean(),
        "ankle_yaw_error_deg": degree * jnp.abs(errors.ankle_yaws).mean(),
        "trunk_error_cm": 100 * jnp.linalg.norm(errors.trunk_position),
        "trunk_error_deg": degree * jnp.linalg.norm(errors.trunk_orientation),
    }
