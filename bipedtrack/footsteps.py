"""Footstep scripts: a CSV file of task steps, checked line by line, that yields the commands of eq (3).

The first line that is neither blank nor a comment is the header; its columns may stand in any order:

    foot,x,y,z,yaw,period,lift,trunk_x,trunk_y,trunk_z,trunk_roll,trunk_pitch,trunk_yaw

Every further line is one task step; metres, radians and seconds, in the world frame. Cells at the end of a
line may be left out. The robot starts standing with its feet at (0, ±0.1, 0), facing x, its trunk at the
defaults. What the cells mean and what empty ones do:

    foot                     left or right, the foot that steps; left up or right up, the foot that is held in the air;
                             jump: both feet leave the ground at once; or both: no foot moves
    x, y, yaw                of the point under the ankle when the foot is flat; empty: where the foot stands;
                             of a jump, of the point midway between the feet
    z                        of the same point; empty: the top of the highest box at (x, y), else 0
    period                   at least 0.1 s; empty: 0.55 s; rounded to a multiple of the control period
    lift                     above the higher end of the swing; 0 slides the foot straight; empty: 0.08 m
    trunk_x, trunk_y         at the end of the step; empty: the centre of mass is midway between the feet that stand
    trunk_z                  absolute, as all; empty: 0.75 m above the mean height of the footholds
    trunk_roll, trunk_pitch  orientation is Rz(yaw) Ry(pitch) Rx(roll); empty: 0, level
    trunk_yaw                empty: the mean of the feet's yaws

With `both`, x, y, z, yaw and lift stay empty and the period is how long the trunk takes. A foot that is up needs its z, and
the other one can not step until it is down again. A line with nothing but `both` and perhaps a period holds: every target
stays where it is. So does everything after the last line. A yaw counts modulo a whole turn; feet and trunk turn the shorter
way.

Lines that begin with # are comments, but `# box x y z yaw length width height` puts a box on the ground,
wherever in the file it stands: (x, y, z) is the middle of its bottom face, so its top is at z + height.
"""

from __future__ import annotations

import io
import itertools
import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bipedtrack import feasibility, kinematics, planner, rotations, rows, statics
from bipedtrack.messages import Refusal
from bipedtrack.nodes import Nodes, ankles_in_trunk_frame
from bipedtrack.planner import Command, TaskStep
from bipedtrack.robot import LEGS, Robot
from bipedtrack.terrain import Box, ground, standing_feet

COLUMNS = rows.COLUMNS
PERIOD = 0.55  # s
LIFT = 0.08  # m
TRUNK_HEIGHT = 0.75  # m above the mean of the footholds
FEET_Y = (0.1, -0.1)  # m, left and right at the start
_ALONG = np.array([0.05, 0.5, 0.95])  # inner control points of the fourth-order swing curves, share of the way
EASE = 0.25  # planner.TaskStep.ease
SWAY = 0.0  # of a trunk, as a share of statics.pendulum; 0: it moves uniformly, as the paper's
_HEIGHTS = np.ones(3)  # and as multiples of the height that lifts a foot by `lift`


class ScriptError(Refusal, ValueError):
    """A script that cannot be walked: for each problem one line with its place and what would be right."""


class Script(NamedTuple):
    """Task steps that the robot can walk, each from where the last one ends, and the boxes on the ground."""

    name: str
    steps: tuple[TaskStep, ...]  # at least one; float64
    boxes: tuple[Box, ...]
    lines: tuple[int, ...]  # where in the file each step stands, from 1


def load(path: str | Path, robot: Robot, sway: float = SWAY) -> Script:
    """The script of a CSV file; `sway` as in `parse`.

    Raises ScriptError, also where the file cannot be read or is not UTF-8.
    """
    try:
        text = Path(path).read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise ScriptError(f"{path}: cannot be read ({error.strerror or error}); wanted a CSV file") from None
    except UnicodeDecodeError as error:
        line = error.object.count(b"\n", 0, error.start) + 1
        byte = error.object[error.start]
        raise ScriptError(f"{path}:{line}: byte 0x{byte:02x} is not UTF-8; save the file as UTF-8") from None
    return parse(text, robot, str(path), sway)


def parse(text: str, robot: Robot, name: str, sway: float = SWAY) -> Script:
    """The script that the text of a CSV file describes; `name` stands before the line numbers of problems.

    `sway` says how much the trunk sways over the stance foot: 0 not at all, 1 as a linear inverted pendulum.
    Raises ScriptError with all problems. Whether a foothold can be reached and stood on is asked only where
    feet, trunk and boxes are known: not after a cell that could not be read, until the feet are placed anew.
    """
    problems: rows.Problems = defaultdict(list)
    lines = {i: line.strip() for i, line in enumerate(io.StringIO(text, newline=None), 1) if line.strip()}
    boxes = rows.read_boxes(lines, problems)
    boxes_known = not problems
    now = initial_nodes(robot)
    for foot, leg in enumerate(LEGS):
        for line in feasibility.boxes_around(robot, boxes, now, foot):
            place = f"x = 0 m, y = {FEET_Y[foot]:g} m"
            problems[line].append(f"the box stands where the {leg} foot starts, {place}; wanted it elsewhere")

    written = rows.read_rows(lines, problems)
    steps, within_reach = [], True
    for row in written:
        step = task_step(robot, boxes.values(), now, row.feet, row.values, sway)
        if boxes_known and _known(step.end):
            problems[row.line] += feasibility.foothold_problems(robot, boxes, step, row.up)
            problems[row.line] += feasibility.swing_problems(robot, boxes, step) if _known(step.start) else []
            problems[row.line] += feasibility.support_problems(robot, boxes, step)
            if step.end is not step.start:
                # the way begins out of reach where the line before ended there
                out_of_reach = feasibility.reach_problems(robot, step, within_reach and _known(step.start))
                problems[row.line] += out_of_reach
                within_reach = not out_of_reach
        steps.append(step)
        now = step.end

    messages = [f"{name}:{n}: {m}" if n else f"{name}: {m}" for n in sorted(problems) for m in problems[n]]
    if messages:
        raise ScriptError("\n".join(messages))
    return Script(name, tuple(steps), tuple(boxes.values()), tuple(row.line for row in written))


def initial_nodes(robot: Robot) -> Nodes:
    """Where every script starts: feet side by side on the ground, facing x, the centre of mass between them; float64."""
    upright = Nodes(
        trunk_position=np.array([0.0, 0.0, TRUNK_HEIGHT]),
        trunk_orientation=np.array([1.0, 0.0, 0.0, 0.0]),
        ankle_positions=np.array([[0.0, y, robot.ankle_height] for y in FEET_Y]),
        ankle_yaws=np.zeros(2),
    )
    return balanced(robot, upright, np.zeros(2))


def initial_qpos(robot: Robot) -> np.ndarray:
    """The robot in its initial nodes, (19,) float64: trunk position m, trunk quaternion, joint angles rad."""
    start = initial_nodes(robot)
    joints = kinematics.inverse(robot, *ankles_in_trunk_frame(start))
    return np.concatenate([start.trunk_position, start.trunk_orientation, joints])


def duration(script: Script) -> float:
    """How long the script takes, s."""
    return math.fsum(step.period for step in script.steps)


def command_at(script: Script, time: float) -> Command:
    """The command at a time in s: before 0 the first one, from the script's end on its end, held."""
    start = 0.0
    for step in script.steps:
        # a step ends where the next one begins, whatever the last digit of the sum
        if time < start + step.period - 1e-9:
            return planner.command(step, np.float64(max(time - start, 0.0)))
        start += step.period
    return planner.command(script.steps[-1], script.steps[-1].period)


def commands(script: Script, timestep: float, seconds: float | None = None) -> Iterator[Command]:
    """The command of every control step of `timestep` s, over the script or over the given time in s.

    Each task step lasts a whole number of control steps and begins at its time 0; the last one's end is held.
    """
    counts = [round(step.period / timestep) for step in script.steps]

    def endless() -> Iterator[Command]:
        for step, count in zip(script.steps, counts, strict=True):
            for tick in range(count):
                yield planner.command(step, np.float64(tick * timestep))
        yield from itertools.repeat(planner.command(script.steps[-1], script.steps[-1].period))

    return itertools.islice(endless(), sum(counts) if seconds is None else round(seconds / timestep))


def task_step(
    robot: Robot, boxes: Iterable[Box], start: Nodes, feet: Sequence[int], values: Mapping[str, float], sway: float = SWAY
) -> TaskStep:
    """The task step of a line, from where the last one ended, with every default filled in.

    Args:
      robot: its constants.
      boxes: what stands on the ground.
      start: where the last task step ended.
      feet: indices of the feet that step, none where the trunk moves alone, both in a jump.
      values: the line's cells by the names of rows.UNITS, without the empty ones.
      sway: of the trunk, as a share of statics.pendulum, where one foot steps; 0: it moves uniformly.
    """
    given = values.get
    ankles, yaws = start.ankle_positions.copy(), start.ankle_yaws.copy()
    places = _jumped(start, values) if len(feet) == len(LEGS) else dict.fromkeys(feet, values)
    for foot, place in places.items():
        x, y = place.get("x", ankles[foot, 0]), place.get("y", ankles[foot, 1])
        ankles[foot] = x, y, given("z", ground(boxes, x, y)) + robot.ankle_height
        yaws[foot] += rotations.wrap(place.get("yaw", yaws[foot]) - yaws[foot])

    holds = not feet and not any(column.startswith("trunk") for column in values)
    end = start if holds else _over_feet(robot, boxes, start, ankles, yaws, values)
    swing = np.array([float(foot in feet) for foot in range(len(LEGS))])
    lift = swing * given("lift", LIFT)
    pivot, frequency = statics.pendulum(robot, end, int(np.argmin(swing)))
    return TaskStep(
        start=start,
        end=end,
        period=np.float64(round(given("period", PERIOD) / robot.timestep) * robot.timestep),
        swing=swing,
        ankle_points=planner.swing_points(start.ankle_positions, ankles, lift, _ALONG, _HEIGHTS),
        lift=lift,
        trigonometric=np.float64(0),
        ease=np.float64(EASE),
        pivot=pivot,
        pendulum=np.float64(sway * frequency if len(feet) == 1 else 0),
    )


def _jumped(start: Nodes, values: Mapping[str, float]) -> dict[int, dict[str, float]]:
    """Where each foot lands, x, y and yaw, when the point midway between the feet goes where `values` say."""
    x, y, _ = start.ankle_positions.mean(axis=0)
    yaw = float(start.ankle_yaws.mean())
    turn = rotations.wrap(values.get("yaw", yaw) - yaw)
    c, s = math.cos(turn), math.sin(turn)
    middle = np.array([values.get("x", x), values.get("y", y)])
    found = {}
    for foot in range(len(LEGS)):
        landing = middle + np.array([[c, -s], [s, c]]) @ (start.ankle_positions[foot, :2] - [x, y])
        found[foot] = {"x": float(landing[0]), "y": float(landing[1]), "yaw": float(start.ankle_yaws[foot] + turn)}
    return found


def _over_feet(
    robot: Robot, boxes: Iterable[Box], start: Nodes, ankles: np.ndarray, yaws: np.ndarray, values: Mapping[str, float]
) -> Nodes:
    """Nodes with the trunk where `values` say, or else with the centre of mass over the middle of the feet that stand."""
    given = values.get
    x, y, z = ankles[standing_feet(robot, boxes, ankles) or [0, 1]].mean(axis=0)
    z = given("trunk_z", z + TRUNK_HEIGHT - robot.ankle_height)
    angles = given("trunk_roll", 0.0), given("trunk_pitch", 0.0), given("trunk_yaw", yaws.mean())
    orientation = rotations.from_euler(*angles)
    if orientation @ start.trunk_orientation < 0:  # of the two quaternions the one that goes on from the last
        orientation = -orientation
    x, y = balanced(robot, Nodes(np.array([x, y, z]), orientation, ankles, yaws), np.array([x, y])).trunk_position[:2]
    return Nodes(np.array([given("trunk_x", x), given("trunk_y", y), z]), orientation, ankles, yaws)


def balanced(robot: Robot, nodes: Nodes, centre: np.ndarray) -> Nodes:
    """The nodes with the trunk moved level until the centre of mass stands over `centre`, (2,) m."""
    for _ in range(3):
        nodes = kinematics.balanced(robot, nodes, centre)
    return nodes


def problems_of(robot: Robot, boxes: Sequence[Box], step: TaskStep) -> list[str]:
    """What keeps the robot from making a task step, one sentence each; boxes count as lines from 1."""
    by_line = dict(enumerate(boxes, 1))
    found = feasibility.support_problems(robot, by_line, step) + feasibility.foothold_problems(robot, by_line, step)
    found += feasibility.reach_problems(robot, step, on_the_way=True)
    return found or feasibility.swing_problems(robot, by_line, step)


def _known(nodes: Nodes) -> bool:
    """Whether no part of the nodes is nan."""
    return all(bool(np.isfinite(part).all()) for part in nodes)
