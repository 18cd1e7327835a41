"""From what a person asks for to the next task step: steering, and footholds by hand.

A task step is made of the cells of a footstep script's line, so that every drive can be written down as a script.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bipedtrack import footholds, footsteps, kinematics, rotations, terrain
from bipedtrack.footholds import Foothold
from bipedtrack.footsteps import Box
from bipedtrack.nodes import Nodes
from bipedtrack.planner import TaskStep
from bipedtrack.robot import LEGS, Robot

FULL_SWAY = 1.0  # of a drive's task steps; `drive.Drive` lets the trunk do as much of it as the policy knows
HOLD_SECONDS = 0.1  # of a task step that holds: soon enough for the next wish
TRUNK_SECONDS = 1.0  # of a task step that moves the trunk alone
_BACKWARD = 0.15  # m, the longest step backward in training
_CLEARANCE = 0.06  # m by which a foot is lifted over what it crosses
_BOX_SECONDS = 0.65  # at least, of a step that crosses an edge
_HIGH_SWING = 0.4  # m, the longest way of a foot that is lifted higher than LIMITS
_KNOWN = (0.35, 0.24, 0.35)  # m ahead, m outwards and rad from beside the other foot: the farthest foothold in training


class Steering(NamedTuple):
    """What is asked for; it holds from the next task step on."""

    ahead: float = 0.0  # 1 forward, -1 backward
    aside: float = 0.0  # 1 to the left, -1 to the right
    turn: float = 0.0  # 1 to the left, -1 to the right
    step_length: float = 0.15  # m the trunk advances per task step
    sidle_length: float = 0.08  # m to the side per task step
    turn_angle: float = 0.2  # rad per task step
    period: float = footsteps.PERIOD  # s
    lift: float = footsteps.LIFT  # m
    trunk_ahead: float = 0.0  # m, the centre of mass from midway between the feet, towards their mean heading
    trunk_aside: float = 0.0  # m, to the left
    trunk_height: float = footsteps.TRUNK_HEIGHT  # m above the mean of the footholds
    trunk_roll: float = 0.0  # rad
    trunk_pitch: float = 0.0  # rad
    trunk_yaw: float = 0.0  # rad from the feet's mean heading

    @property
    def moves(self) -> bool:
        """Whether feet are asked to step."""
        return any((self.ahead, self.aside, self.turn))


LIMITS = {
    "step_length": (0.02, 0.25),
    "sidle_length": (0.02, 0.12),
    "turn_angle": (0.02, 0.35),
    "period": (0.4, 0.7),
    "lift": (0.04, 0.15),
    "trunk_ahead": (-0.05, 0.05),
    "trunk_aside": (-0.04, 0.04),
    "trunk_height": (0.60, 0.79),
    "trunk_roll": (-0.15, 0.15),
    "trunk_pitch": (-0.15, 0.15),
    "trunk_yaw": (-0.3, 0.3),
}
"""Least and greatest value of each number of Steering: what policies are trained for (sampling.Ranges)."""


class Planned(NamedTuple):
    """A task step and, where it is not quite what was asked for, a sentence that says so."""

    step: TaskStep
    note: str = ""


class Wishes(NamedTuple):
    """All that the next task step depends on, besides the ground and where the last one ended."""

    steering: Steering = Steering()
    foot: int = 0  # whose turn it is, 0 left, 1 right
    walking: bool = False  # feet have stepped on, and have yet to come together
    trunk: bool = False  # the trunk has been asked to go elsewhere
    placed: Foothold | None = None  # the next foothold, by hand


def clamped(asked: Steering) -> Steering:
    """The same wishes within LIMITS; what is not finite becomes the default."""
    values = {}
    for name, value in asked._asdict().items():
        low, high = LIMITS.get(name, (-1.0, 1.0))
        default = Steering._field_defaults[name]
        values[name] = min(max(float(value), low), high) if math.isfinite(value) else default
    return Steering(**values)


def following(robot: Robot, boxes: Sequence[Box], start: Nodes, wishes: Wishes) -> tuple[Planned, Wishes]:
    """The task step after one that ended at `start`, and what is still wished for after it.

    A foot that is in the air, as after `left up` in a script, comes down first, whatever is asked of the other one.
    """
    asked = wishes.steering
    standing = terrain.standing_feet(robot, boxes, start.ankle_positions)
    if len(standing) == 1 and (wishes.placed is None or wishes.placed.foot == standing[0]):
        return walk(robot, boxes, start, 1 - standing[0], asked), wishes._replace(walking=asked.moves)
    if wishes.placed is not None:
        return place(robot, boxes, start, wishes.placed, asked), wishes._replace(placed=None, walking=False)
    if asked.moves:
        foot = wishes.foot if wishes.walking else first_foot(asked, wishes.foot)
        return walk(robot, boxes, start, foot, asked), wishes._replace(walking=True)
    if wishes.walking:
        return walk(robot, boxes, start, wishes.foot, asked), wishes._replace(walking=False)
    if wishes.trunk:
        within, note = lean(robot, boxes, start, asked)
        wishes = wishes._replace(trunk=False)
        if within is None:
            return Planned(hold(robot, start), note), wishes
        moved = trunk_step(robot, start, within)
        if not same_trunk(start, moved.end):
            return Planned(moved, note), wishes._replace(steering=within)
    return Planned(hold(robot, start)), wishes


def first_foot(asked: Steering, otherwise: int) -> int:
    """The foot that begins to walk as asked from a stand: to a side it is the one of that side."""
    side = asked.aside or (0.0 if asked.ahead else asked.turn)
    return otherwise if not side else int(side < 0)


def walk(robot: Robot, boxes: Sequence[Box], start: Nodes, foot: int, asked: Steering) -> Planned:
    """The task step that moves on as asked: the foot goes beside the other one, and on from there.

    On boxes it goes to the middle of the next tread, or over a bar; a step that the robot cannot make is shortened.
    """
    # to a side the leading foot opens by twice the length and the other one closes up
    leads = asked.aside * (0.5 - foot) > 0
    advance = np.array(
        [
            max(asked.ahead * asked.step_length, -_BACKWARD),
            2 * asked.aside * asked.sidle_length if leads else 0.0,
            asked.turn * asked.turn_angle,
        ]
    )
    problems: list[str] = []
    for share in (1.0, 0.75, 0.5, 0.25, 0.0):
        wanted = footholds.on_ground(
            robot, boxes, footholds.beside(start, foot), footholds.moved_on(start, foot, share * advance)
        )
        step = step_to(robot, boxes, start, wanted, asked)
        found = footsteps.problems_of(robot, boxes, step) or _too_long(step, foot)
        if not found:
            return Planned(step, f"a shorter step: {problems[0]}" if problems else "")
        problems += found
    return Planned(hold(robot, start), f"no step is possible: {problems[-1]}")


def _too_long(step: TaskStep, foot: int) -> list[str]:
    """What is wrong with a swing over something high: it must be short."""
    travel = math.dist(step.start.ankle_positions[foot, :2], step.end.ankle_positions[foot, :2])
    if step.lift[foot] <= LIMITS["lift"][1] or travel <= _HIGH_SWING:
        return []
    return [f"a foot lifted by {100 * step.lift[foot]:.0f} cm moves at most {100 * _HIGH_SWING:.0f} cm"]


def step_to(robot: Robot, boxes: Sequence[Box], start: Nodes, to: Foothold, asked: Steering) -> TaskStep:
    """The task step that puts a foot on the ground at a foothold, whether the robot can make it or not."""
    ankles, yaws = start.ankle_positions.copy(), start.ankle_yaws.copy()
    ankles[to.foot] = to.x, to.y, footsteps.ground(boxes, to.x, to.y) + robot.ankle_height
    yaws[to.foot] = to.yaw
    lift, uneven = _lift(robot, boxes, start, to, asked)
    period = max(asked.period, _BOX_SECONDS) if uneven else asked.period
    values = {"x": to.x, "y": to.y, "yaw": to.yaw, "period": period, "lift": lift}
    values |= _trunk(robot, ankles, yaws, asked)
    return footsteps.task_step(robot, boxes, start, (to.foot,), values, FULL_SWAY)


def trunk_step(robot: Robot, start: Nodes, asked: Steering) -> TaskStep:
    """The task step that brings the trunk where it is asked to be over feet that stay."""
    values = {"period": TRUNK_SECONDS, **_trunk(robot, start.ankle_positions, start.ankle_yaws, asked)}
    return footsteps.task_step(robot, (), start, (), values)


def hold(robot: Robot, start: Nodes) -> TaskStep:
    """A short task step in which every target stays."""
    return footsteps.task_step(robot, (), start, (), {"period": HOLD_SECONDS})


def place(robot: Robot, boxes: Sequence[Box], start: Nodes, wanted: Foothold, asked: Steering) -> Planned:
    """The task step to the foothold, or else to the nearest one that the robot can reach and stand on, and a note of it."""

    def at(x: float, y: float) -> TaskStep:
        return step_to(robot, boxes, start, wanted._replace(x=x, y=y), asked)

    found_wrong = problems(robot, boxes, start, wanted, asked)
    if not found_wrong:
        return Planned(at(wanted.x, wanted.y))
    home = footholds.beside(start, wanted.foot)
    turned = home.yaw + min(max(rotations.wrap(wanted.yaw - home.yaw), -_KNOWN[2]), _KNOWN[2])
    wanted = wanted._replace(yaw=float(turned))
    found = footholds.nearest(
        lambda point: not problems(robot, boxes, start, wanted._replace(x=point[0], y=point[1]), asked),
        np.array([wanted.x, wanted.y]),
        np.array([home.x, home.y]),
    )
    if found is None:
        return Planned(hold(robot, start), f"no foothold is within reach: {found_wrong[0]}")
    moved = 100 * math.dist(found, (wanted.x, wanted.y))
    note = f"the {LEGS[wanted.foot]} foothold was moved by {moved:.0f} cm to the nearest one within reach: {found_wrong[0]}"
    return Planned(at(*found), note)


def problems(robot: Robot, boxes: Sequence[Box], start: Nodes, wanted: Foothold, asked: Steering) -> list[str]:
    """What keeps the robot from a foothold, one sentence each: reach, ground, or a step longer than any in training."""
    home = footholds.beside(start, wanted.foot)
    x, y = footholds.turned(-home.yaw, np.array([wanted.x - home.x, wanted.y - home.y]))
    turn = rotations.wrap(wanted.yaw - home.yaw)
    ahead, aside, around = _KNOWN
    found = []
    if math.hypot(x / ahead, y / aside) > 1.001 or abs(turn) > around + 1e-3:
        found.append(
            f"it lies {100 * x:.0f} cm ahead, {100 * abs(y):.0f} cm aside and {math.degrees(turn):.0f} deg from beside the "
            f"other foot; wanted at most {100 * ahead:.0f} cm, {100 * aside:.0f} cm and {math.degrees(around):.0f} deg"
        )
    return found + footsteps.problems_of(robot, boxes, step_to(robot, boxes, start, wanted, asked))


def lean(robot: Robot, boxes: Sequence[Box], start: Nodes, asked: Steering) -> tuple[Steering | None, str]:
    """The wishes with the trunk within reach of both feet, and a note where it had to be brought nearer to its default.

    None where the default is out of reach, too.
    """
    within = clamped(asked)
    names = [name for name in Steering._fields if name.startswith("trunk")]
    wanted, home = (np.array([getattr(wish, name) for name in names]) for wish in (within, Steering()))

    def wish(trunk: np.ndarray) -> Steering:
        return within._replace(**dict(zip(names, map(float, trunk), strict=True)))

    def problems(trunk: np.ndarray) -> list[str]:
        return footsteps.problems_of(robot, boxes, trunk_step(robot, start, wish(trunk)))

    found = problems(wanted)
    if not found:
        note = "the trunk was kept within what the policy knows" if within != asked else ""
        return within, note
    if problems(home):
        return None, f"the trunk stays where it is: {found[0]}"
    share = footholds.share_of_way(lambda trunk: not problems(trunk), wanted, home)
    return wish(home + share * (wanted - home)), f"the trunk was brought back within reach: {found[0]}"


def _trunk(robot: Robot, ankles: np.ndarray, yaws: np.ndarray, asked: Steering) -> dict[str, float]:
    """The trunk's cells of a script's line that ends with ankles (2, 3), m, and yaws (2,), rad."""
    yaw = float(yaws.mean())
    centre = ankles[:, :2].mean(axis=0) + footholds.turned(yaw, np.array([asked.trunk_ahead, asked.trunk_aside]))
    height = float(ankles[:, 2].mean()) - robot.ankle_height + asked.trunk_height
    orientation = rotations.from_euler(asked.trunk_roll, asked.trunk_pitch, yaw + asked.trunk_yaw)
    posture = Nodes(np.array([*centre, height]), orientation, ankles, yaws)
    x, y = footsteps.balanced(robot, posture, centre).trunk_position[:2]
    return {
        "trunk_x": float(x),
        "trunk_y": float(y),
        "trunk_z": height,
        "trunk_roll": asked.trunk_roll,
        "trunk_pitch": asked.trunk_pitch,
        "trunk_yaw": yaw + asked.trunk_yaw,
    }


def _lift(robot: Robot, boxes: Sequence[Box], start: Nodes, to: Foothold, asked: Steering) -> tuple[float, bool]:
    """The lift that clears what lies between where the foot stands and its foothold, m, and whether that is uneven.

    It is looked for under the middle and the corners of the sole, turned as at its foothold.
    """
    if not boxes:
        return asked.lift, False
    x, y, ankle = start.ankle_positions[to.foot]
    way = np.linspace([x, y], [to.x, to.y], 2 + math.ceil(math.dist((x, y), (to.x, to.y)) / (2 * footholds.GRAIN)))
    sole = [np.zeros(2), *terrain.rectangle(np.zeros(2), to.yaw, *robot.sole)]
    heights = [max(footsteps.ground(boxes, *(point + part)) for part in sole) for point in way]
    ends = max(float(ankle) - robot.ankle_height, heights[-1])
    return max(asked.lift, max(heights) - ends + _CLEARANCE), max(heights) - min(heights) > 1e-3


def same_trunk(start: Nodes, end: Nodes) -> bool:
    """Whether the trunk is in the same place, to 1 mm and 1 mrad."""
    apart = np.abs(end.trunk_position - start.trunk_position).max()
    turn = rotations.multiply(rotations.conjugate(start.trunk_orientation), end.trunk_orientation)
    return bool(apart < 1e-3 and np.abs(rotations.to_rotation_vector(turn)).max() < 1e-3)


def trunk_at(robot: Robot, start: Nodes, position: np.ndarray, orientation: np.ndarray, asked: Steering) -> Steering:
    """The wishes with the trunk at a place in the world: position (3,) m and quaternion (4,)."""
    yaw = float(start.ankle_yaws.mean())
    middle = start.ankle_positions.mean(axis=0) - np.array([0.0, 0.0, robot.ankle_height])
    position, orientation = np.asarray(position, float), np.asarray(orientation, float)
    posture = start._replace(trunk_position=position, trunk_orientation=orientation)
    ahead, aside = footholds.turned(-yaw, (kinematics.centre_of_mass_at(robot, posture) - middle)[:2])
    roll, pitch, turned = rotations.to_euler(orientation)
    return asked._replace(
        trunk_ahead=float(ahead),
        trunk_aside=float(aside),
        trunk_height=float(position[2] - middle[2]),
        trunk_roll=float(roll),
        trunk_pitch=float(pitch),
        trunk_yaw=float(rotations.wrap(turned - yaw)),
    )
