"""The lines of a footstep script as they are written: boxes, and rows of cells, each held to its own bounds.

`footsteps` says what they mean. Every function adds what is wrong to the problems it is given.
"""

from __future__ import annotations

import difflib
import math
import reprlib
from collections import Counter, defaultdict
from typing import NamedTuple

from bipedtrack.planner import SHORTEST
from bipedtrack.robot import LEGS
from bipedtrack.terrain import TOLERANCE, Box

UNITS = {
    **{"x": "m", "y": "m", "z": "m", "yaw": "rad", "period": "s", "lift": "m"},
    **{"trunk_x": "m", "trunk_y": "m", "trunk_z": "m"},
    **{"trunk_roll": "rad", "trunk_pitch": "rad", "trunk_yaw": "rad"},
}
COLUMNS = ("foot", *UNITS)
_LARGEST = 1e6  # m, rad or s

Problems = defaultdict[int, list[str]]  # by line; line 0 is the file itself


class Row(NamedTuple):
    """A line of the file.

    Empty cells are left out and what could not be read is nan; where that is `foot`, both feet step to nan.
    """

    line: int
    feet: tuple[int, ...]  # indices of the feet that step
    values: dict[str, float]
    up: bool = False  # the foot is held in the air


def read_boxes(lines: dict[int, str], problems: Problems) -> dict[int, Box]:
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
            if size < TOLERANCE:
                found.append(f"box {field} is {size:g} m; wanted at least {TOLERANCE:g} m")
        if found:
            problems[line] += found
        else:
            boxes[line] = box
    return boxes


def read_rows(lines: dict[int, str], problems: Problems) -> list[Row]:
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
    return [_read_row(line, header, cells, problems[line]) for line, cells in table.items()]


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


def _read_row(line: int, header: list[str], cells: list[str], problems: list[str]) -> Row:
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
    for column, least in (("period", SHORTEST), ("lift", 0.0)):
        value = values.get(column, least)
        if value < least:
            unit = UNITS[column]
            problems.append(f"{column} is {value:g} {unit}; wanted at least {least:g} {unit}")
        if not value >= least:
            del values[column]  # places are judged all the same
    return Row(line, feet, values, foot.endswith(" up"))


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
