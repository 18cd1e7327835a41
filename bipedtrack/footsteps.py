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
    period                   empty: 0.55 s; rounded to a multiple of the control period
    lift                     above the higher end of the swing; 0 slides the foot straight; empty: 0.08 m
    trunk_x, trunk_y         at the end of the step; empty: the centre of mass is midway between the feet that stand
    trunk_z                  absolute, as all; empty: 0.75 m above the mean height of the footholds
    trunk_roll, trunk_pitch  orientation is Rz(yaw) Ry(pitch) Rx(roll); empty: 0, level
    trunk_yaw                empty: the mean of the feet's yaws

With `both`, x, y, z, yaw and lift stay empty and the period is how long the trunk takes. A foot that is up needs its z, and
the other one can not step until it is down again. A line with nothing
but `both` and perhaps a period holds: every target stays where it is. So does everything after the last line.
A yaw counts modulo a whole turn; feet and trunk turn the shorter way.

Lines that begin with # are comments, but `# box x y z yaw length width height` puts a box on the ground,
wherever in the file it stands: (x, y, z) is the middle of its bottom face, so its top is at z + height.
"""

from __future__ import annotations

import difflib
import io
import itertools
import math
import reprlib
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bipedtrack import kinematics, planner, rotations
from bipedtrack.messages import Refusal
from bipedtrack.nodes import Nodes, ankles_in_trunk_frame
from bipedtrack.planner import Command, TaskStep
from bipedtrack.robot import LEGS, Robot

UNITS = {
    **{"x": "m", "y": "m", "z": "m", "yaw": "rad", "period": "s", "lift": "m"},
    **{"trunk_x": "m", "trunk_y": "m", "trunk_z": "m"},
    **{"trunk_roll": "rad", "trunk_pitch": "rad", "trunk_yaw": "rad"},
}
COLUMNS = ("foot", *UNITS)
PERIOD = 0.55  # s
LIFT = 0.08  # m
TRUNK_HEIGHT = 0.75  # m above the mean of the footholds
FEET_Y = (0.1, -0.1)  # m, left and right at the start
_ALONG = np.array([0.05, 0.5, 0.95])  # inner control points of the fourth-order swing curves, share of the way
EASE = 0.25  # planner.TaskStep.ease
_HEIGHTS = np.ones(3)  # and as multiples of the height that lifts a foot by `lift`
_TOLERANCE = 1e-3  # m and rad: what is this close counts as touching, standing or within reach
_LARGEST = 1e6  # m, rad or s
_ON_THE_WAY = np.arange(1, 8) / 8  # shares of a step's period at which its targets must be within reach


class ScriptError(Refusal, ValueError):
    """A script that cannot be walked: for each problem one line with its place and what would be right."""


class Box(NamedTuple):
    """An obstacle or a tread, upright, in the world frame."""

    x: float  # m, middle of the bottom face
    y: float
    z: float
    yaw: float  # rad
    length: float  # m, along its own x axis
    width: float
    height: float

    @property
    def size(self) -> tuple[float, float, float]:
        """Length, width and height, m: what `robot.build_model` takes."""
        return self.length, self.width, self.height

    @property
    def top(self) -> float:
        """The height of its top face, m."""
        return self.z + self.height

    @property
    def position(self) -> np.ndarray:
        """Its centre, (3,) m: `data.mocap_pos` of its body."""
        return np.array([self.x, self.y, self.z + self.height / 2])

    @property
    def orientation(self) -> np.ndarray:
        """Its unit quaternion, (4,): `data.mocap_quat` of its body."""
        return np.array(rotations.from_yaw(np.float64(self.yaw)))

    @property
    def corners(self) -> np.ndarray:
        """The corners of its faces seen from above, (4, 2) m."""
        return _rectangle(np.array([self.x, self.y]), self.yaw, self.length, self.width)


class Script(NamedTuple):
    """Task steps that the robot can walk, each from where the last one ends, and the boxes on the ground."""

    name: str
    steps: tuple[TaskStep, ...]  # at least one; float64
    boxes: tuple[Box, ...]
    lines: tuple[int, ...]  # where in the file each step stands, from 1


class _Row(NamedTuple):
    """A line of the file.

    Empty cells are left out and what could not be read is nan; where that is `foot`, both feet step to nan.
    """

    line: int
    feet: tuple[int, ...]  # indices of the feet that step
    values: dict[str, float]
    up: bool = False  # the foot is held in the air


_Problems = defaultdict[int, list[str]]  # by line; line 0 is the file itself


def load(path: str | Path, robot: Robot) -> Script:
    """The script of a CSV file. Raises ScriptError, also where the file cannot be read or is not UTF-8."""
    try:
        text = Path(path).read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise ScriptError(f"{path}: cannot be read ({error.strerror or error}); wanted a CSV file") from None
    except UnicodeDecodeError as error:
        line = error.object.count(b"\n", 0, error.start) + 1
        byte = error.object[error.start]
        raise ScriptError(f"{path}:{line}: byte 0x{byte:02x} is not UTF-8; save the file as UTF-8") from None
    return parse(text, robot, str(path))


def parse(text: str, robot: Robot, name: str) -> Script:
    """The script that the text of a CSV file describes; `name` stands before the line numbers of problems.

    Raises ScriptError with all problems. Whether a foothold can be reached and stood on is asked only where
    feet, trunk and boxes are known: not after a cell that could not be read, until the feet are placed anew.
    """
    problems: _Problems = defaultdict(list)
    lines = {i: line.strip() for i, line in enumerate(io.StringIO(text, newline=None), 1) if line.strip()}
    boxes = _read_boxes(lines, problems)
    boxes_known = not problems
    now = initial_nodes(robot)
    for foot, leg in enumerate(LEGS):
        for line in _boxes_around(robot, boxes, now, foot):
            place = f"x = 0 m, y = {FEET_Y[foot]:g} m"
            problems[line].append(f"the box stands where the {leg} foot starts, {place}; wanted it elsewhere")

    rows = _read_rows(lines, robot.timestep, problems)
    steps, within_reach = [], True
    for row in rows:
        step = task_step(robot, boxes.values(), now, row.feet, row.values)
        if boxes_known and _known(step.end):
            for foot in row.feet:
                judge = _air_problems if row.up else _foothold_problems
                problems[row.line] += judge(robot, boxes, step.end, foot)
            problems[row.line] += _support_problems(robot, boxes, step)
            if step.end is not step.start:
                # the way begins out of reach where the line before ended there
                out_of_reach = _reach_problems(robot, step, within_reach and _known(step.start))
                problems[row.line] += out_of_reach
                within_reach = not out_of_reach
        steps.append(step)
        now = step.end

    messages = [f"{name}:{n}: {m}" if n else f"{name}: {m}" for n in sorted(problems) for m in problems[n]]
    if messages:
        raise ScriptError("\n".join(messages))
    return Script(name, tuple(steps), tuple(boxes.values()), tuple(row.line for row in rows))


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


def _read_boxes(lines: dict[int, str], problems: _Problems) -> dict[int, Box]:
    """The boxes by line."""
    boxes = {}
    for line, text in lines.items():
        # a spreadsheet pads its lines with commas
        words = text.lstrip("#").replace(",", " ").split()
        if not text.startswith("#") or not words or words[0].lower() != "box":
            continue
        if len(words) != 1 + len(Box._fields):
            wanted = " ".join(Box._fields)
            problems[line].append(f"the box has {len(words) - 1} numbers; wanted `# box {wanted}`")
            continue
        found: list[str] = []
        units = ["rad" if field == "yaw" else "m" for field in Box._fields]
        named = zip(words[1:], Box._fields, units, strict=True)
        box = Box(*(_number(word, f"box {field}", unit, found) for word, field, unit in named))
        for field, size in zip(Box._fields[-3:], box.size, strict=True):
            if size < _TOLERANCE:
                found.append(f"box {field} is {size:g} m; wanted at least {_TOLERANCE:g} m")
        if found:
            problems[line] += found
        else:
            boxes[line] = box
    return boxes


def _read_rows(lines: dict[int, str], timestep: float, problems: _Problems) -> list[_Row]:
    """The task steps as written."""
    table = {}
    for line, text in lines.items():
        if text.startswith("#"):
            continue
        cells = [cell.strip(' \t"') for cell in text.split(",")]
        while cells and not cells[-1]:
            cells.pop()
        if cells:
            table[line] = cells
    if not table:
        problems[0].append(f"is empty; wanted the header {','.join(COLUMNS)} and a line for each step")
        return []
    header_line = next(iter(table))
    header = table.pop(header_line)
    wrong = _header_problems(header)
    if wrong:
        problems[header_line] += wrong
        return []
    if not table:
        problems[header_line].append("no step follows the header; wanted a line for each step")
    return [_read_row(line, header, cells, timestep, problems[line]) for line, cells in table.items()]


def _header_problems(header: list[str]) -> list[str]:
    """What is wrong with the names of the columns."""
    if not set(header) & set(COLUMNS):
        return [f"is not the header; wanted {','.join(COLUMNS)}"]
    problems = []
    for column, count in Counter(header).items():
        if column not in COLUMNS:
            near = difflib.get_close_matches(column.lower(), COLUMNS, n=1)
            right = f"did you mean {near[0]!r}?" if near else f"wanted {','.join(COLUMNS)}"
            problems.append(f"unknown column {reprlib.repr(column)}; {right}")
        elif count > 1:
            problems.append(f"column {column!r} stands in the header {count} times; wanted it once")
    missing = [column for column in COLUMNS if column not in header]
    if missing:
        problems.append(f"the header lacks {', '.join(missing)}; wanted {','.join(COLUMNS)}")
    return problems


def _read_row(line: int, header: list[str], cells: list[str], timestep: float, problems: list[str]) -> _Row:
    """One task step as written, with every cell held to its own bounds."""
    if len(cells) > len(header):
        problems.append(f"has {len(cells)} cells; wanted at most {len(header)}, one for each column")
    texts = {column: text for column, text in zip(header, cells, strict=False) if text}
    foot = texts.pop("foot", "")
    values = {column: _number(text, column, UNITS[column], problems) for column, text in texts.items()}
    if foot == "both":
        feet: tuple[int, ...] = ()
        for column in ("x", "y", "z", "yaw", "lift"):
            if column in values:
                problems.append(f"{column} is {reprlib.repr(texts[column])}, but no foot moves; wanted it empty")
    elif foot.removesuffix(" up") in LEGS:
        feet = (LEGS.index(foot.removesuffix(" up")),)
        if foot.endswith(" up") and "z" not in values:
            problems.append("z is empty; wanted the height at which the foot is held, m")
            values["z"] = math.nan
    elif foot == "jump":
        feet = (0, 1)
    else:
        problems.append(f"foot is {reprlib.repr(foot)}; wanted left, right, left up, right up, jump or both")
        feet, values["x"] = (0, 1), math.nan
    for column, least in (("period", timestep), ("lift", 0.0)):
        value = values.get(column, least)
        if value < least:
            unit = UNITS[column]
            problems.append(f"{column} is {value:g} {unit}; wanted at least {least:g} {unit}")
        if not value >= least:
            del values[column]  # places are judged all the same
    return _Row(line, feet, values, foot.endswith(" up"))


def _number(text: str, what: str, unit: str, problems: list[str]) -> float:
    """The number in a cell, nan if there is none."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not abs(value) <= _LARGEST:
        right = f"wanted a finite number of {unit}, at most {_LARGEST:.0f} {unit} either way"
        problems.append(f"{what} is {reprlib.repr(text)}; {right}")
        return math.nan
    return value


def task_step(
    robot: Robot, boxes: Iterable[Box], start: Nodes, feet: Sequence[int], values: Mapping[str, float]
) -> TaskStep:
    """The task step of a line, from where the last one ended, with every default filled in.

    Args:
      robot: its constants.
      boxes: what stands on the ground.
      start: where the last task step ended.
      feet: indices of the feet that step, none where the trunk moves alone, both in a jump.
      values: the line's cells by the names of UNITS, without the empty ones.
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
    return TaskStep(
        start=start,
        end=end,
        period=np.float64(round(given("period", PERIOD) / robot.timestep) * robot.timestep),
        swing=swing,
        ankle_points=planner.swing_points(start.ankle_positions, ankles, lift, _ALONG, _HEIGHTS),
        lift=lift,
        trigonometric=np.float64(0),
        ease=np.float64(EASE),
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


def standing_feet(robot: Robot, boxes: Iterable[Box], ankles: np.ndarray) -> list[int]:
    """Indices of the feet with ankles (2, 3), m, that stand on the ground or on a box."""
    boxes = tuple(boxes)
    soles = ankles - np.array([0.0, 0.0, robot.ankle_height])
    return [foot for foot, (x, y, z) in enumerate(soles) if z - ground(boxes, x, y, z + _TOLERANCE) <= _TOLERANCE]


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
    footholds = [_foothold_problems(robot, by_line, step.end, foot) for foot in map(int, np.flatnonzero(step.swing))]
    return [*itertools.chain(*footholds), *_reach_problems(robot, step, True)]


def _known(nodes: Nodes) -> bool:
    """Whether no part of the nodes is nan."""
    return all(bool(np.isfinite(part).all()) for part in nodes)


def _foothold_problems(robot: Robot, boxes: dict[int, Box], nodes: Nodes, foot: int) -> list[str]:
    """What keeps a foot from standing where it is: the other foot, a box, or no ground under its sole."""
    problems = []
    soles = [_sole(robot, nodes, i) for i in range(len(LEGS))]
    size = f"{robot.sole[0]:g} m x {robot.sole[1]:g} m"
    subject = f"the {LEGS[foot]} foot"
    depth = _overlap(*soles)
    if depth > _TOLERANCE:
        other = f"the {LEGS[1 - foot]} foot"
        problems.append(f"{subject} overlaps {other} by {_cm(depth)}; wanted the soles of {size} apart")
    z = nodes.ankle_positions[foot, 2] - robot.ankle_height
    inside = _boxes_around(robot, boxes, nodes, foot)
    gaps = [z - ground(boxes.values(), x, y, z + _TOLERANCE) for x, y in soles[foot]]
    if inside:
        for line in inside:
            right = f"wanted it on top, z = {boxes[line].top:g} m, or beside it"
            problems.append(f"{subject} stands inside the box of line {line}; {right}")
    elif z < -_TOLERANCE:
        problems.append(f"{subject} stands {_cm(-z)} under the ground; wanted z = 0 m or more")
    elif max(gaps) > _TOLERANCE:
        count = sum(gap > _TOLERANCE for gap in gaps)
        problems.append(
            f"{subject} stands in the air: under {count} of its sole's 4 corners the ground is up to "
            f"{_cm(max(gaps))} below z = {z:g} m; wanted the whole sole of {size} on ground of one height"
        )
    return problems


def _air_problems(robot: Robot, boxes: dict[int, Box], nodes: Nodes, foot: int) -> list[str]:
    """What keeps a foot from being held in the air where it is: the ground, or a box."""
    x, y, z = nodes.ankle_positions[foot] - np.array([0.0, 0.0, robot.ankle_height])
    top = ground(boxes.values(), x, y)
    if z > top + _TOLERANCE:
        return []
    return [f"the {LEGS[foot]} foot is not up, z = {z:g} m over ground at {top:g} m; wanted it higher, or without `up`"]


def _support_problems(robot: Robot, boxes: dict[int, Box], step: TaskStep) -> list[str]:
    """Whether a foot steps while the other one is in the air."""
    stands = standing_feet(robot, boxes.values(), step.start.ankle_positions)
    stepping = [int(foot) for foot in np.flatnonzero(step.swing)]
    if len(stepping) != 1 or 1 - stepping[0] in stands:
        return []
    return [f"the {LEGS[1 - stepping[0]]} foot is in the air; wanted it down before the other one steps"]


def _reach_problems(robot: Robot, step: TaskStep, on_the_way: bool) -> list[str]:
    """How far the step's end, and perhaps its targets before, are out of each leg's reach: the end, or else the worst."""
    targets = [("at the end of the step", step.end)]
    for time in step.period * _ON_THE_WAY if on_the_way else ():
        targets.append((f"{time:.2f} s into the step", planner.command(step, time).target))
    distances, turns, lengths = (np.zeros((len(targets), len(LEGS))) for _ in range(3))
    for i, (_, target) in enumerate(targets):
        ankles, yaws = ankles_in_trunk_frame(target)
        nearest, nearest_yaws = kinematics.project(robot, ankles, yaws)
        distances[i] = np.linalg.norm(nearest - ankles, axis=-1)
        turns[i] = np.abs(nearest_yaws - yaws)
        lengths[i] = np.linalg.norm(ankles - robot.hips, axis=-1)
    low, high = (bounds.reshape(2, -1)[:, 0] for bounds in (robot.joint_low, robot.joint_high))
    least, most = robot.leg_length
    problems = []
    for foot, leg in enumerate(LEGS):
        far, turned = (
            0 if amounts[0] > _TOLERANCE else amounts.argmax() for amounts in (distances[:, foot], turns[:, foot])
        )
        if distances[far, foot] > _TOLERANCE:
            problems.append(
                f"the {leg} foot is {_cm(distances[far, foot])} out of reach {targets[far][0]}, "
                f"its ankle {lengths[far, foot]:.3f} m from the hip; wanted {least:g} m to {most:g} m "
                "and every joint within its range"
            )
        if turns[turned, foot] > _TOLERANCE:
            problems.append(
                f"the {leg} foot is turned {_deg(turns[turned, foot])} too far {targets[turned][0]}; "
                f"wanted {_deg(low[foot])} to {_deg(high[foot])} from the trunk's yaw"
            )
    return problems


def _cm(length: float) -> str:
    return f"{100 * length:.1f} cm"


def _deg(angle: float) -> str:
    return f"{math.degrees(angle):.1f} deg"


def ground(boxes: Iterable[Box], x: float, y: float, below: float = math.inf) -> float:
    """The height of the ground at (x, y), m: the highest top that is not above `below`, or the floor."""
    return max([0.0] + [box.top for box in boxes if box.top <= below and _covers(box, x, y)])


def _covers(box: Box, x: float, y: float) -> bool:
    """Whether the box lies under or over (x, y), its edges included."""
    c, s = math.cos(box.yaw), math.sin(box.yaw)
    along, across = c * (x - box.x) + s * (y - box.y), c * (y - box.y) - s * (x - box.x)
    return abs(along) <= box.length / 2 + _TOLERANCE and abs(across) <= box.width / 2 + _TOLERANCE


def _boxes_around(robot: Robot, boxes: dict[int, Box], nodes: Nodes, foot: int) -> list[int]:
    """The lines of the boxes that take up the place of a foot, between its sole and its ankle."""
    ankle = nodes.ankle_positions[foot, 2]
    sole = ankle - robot.ankle_height
    return [
        line
        for line, box in boxes.items()
        if box.z < ankle and box.top > sole + _TOLERANCE and _overlap(_sole(robot, nodes, foot), box.corners) > _TOLERANCE
    ]


def _sole(robot: Robot, nodes: Nodes, foot: int) -> np.ndarray:
    """The corners of a flat foot's sole seen from above, (4, 2) m."""
    return _rectangle(nodes.ankle_positions[foot, :2], nodes.ankle_yaws[foot], robot.sole[0], robot.sole[1])


def _rectangle(centre: np.ndarray, yaw: float, length: float, width: float) -> np.ndarray:
    """The corners of a rectangle, (4, 2) m, one after another."""
    c, s = math.cos(yaw), math.sin(yaw)
    half = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * [length / 2, width / 2]
    return centre + half @ np.array([[c, s], [-s, c]])


def _overlap(a: np.ndarray, b: np.ndarray) -> float:
    """How deep two rectangles, each (4, 2) m, lie in one another, m; negative where they are apart.

    Convex shapes are apart if they are so along the normal of one of their edges.
    """
    edges = np.concatenate([a[1:3] - a[:2], b[1:3] - b[:2]])
    axes = edges / np.linalg.norm(edges, axis=-1, keepdims=True)  # a rectangle's edges are its normals
    along_a, along_b = a @ axes.T, b @ axes.T
    depths = np.minimum(along_a.max(axis=0), along_b.max(axis=0)) - np.maximum(along_a.min(axis=0), along_b.min(axis=0))
    return float(depths.min())
