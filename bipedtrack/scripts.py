"""Footstep scripts that lie ready, and drives written down as scripts that `footsteps.load` reads back."""

from __future__ import annotations

import pathlib
from collections.abc import Sequence

import numpy as np

from bipedtrack import footsteps, paths, rotations
from bipedtrack.nodes import Nodes
from bipedtrack.planner import TaskStep
from bipedtrack.robot import LEGS, Robot
from bipedtrack.terrain import Box, standing_feet


def ready() -> dict[str, pathlib.Path]:
    """The scripts that come with the package, by name."""
    return {path.stem: path for path in sorted((paths.data_dir("curricula") / "footsteps").glob("*.csv"))}


def text(robot: Robot, steps: Sequence[TaskStep], boxes: Sequence[Box] = ()) -> str:
    """The text of a script with these task steps, which begin at `footsteps.initial_nodes`; holds in a row become one line.

    It keeps all that a script can say: curves with other control points than a script's own are not kept.
    """
    lines = ["# box " + " ".join(map(_number, box)) for box in boxes]
    lines.append(",".join(footsteps.COLUMNS))
    held = 0.0
    for step in steps:
        holds = not step.swing.any() and _same(step.start, step.end)
        if holds:
            held += float(step.period)
            continue
        if held:
            lines.append(_hold(held))
        lines.append(_line(robot, step, boxes))
        held = 0.0
    if held or not steps:
        lines.append(_hold(held or footsteps.PERIOD))
    return "\n".join(lines) + "\n"


def _line(robot: Robot, step: TaskStep, boxes: Sequence[Box]) -> str:
    """One task step that moves something."""
    end, feet = step.end, np.flatnonzero(step.swing)
    cells = ["both", "", "", "", "", _number(step.period), ""]
    if len(feet):
        (x, y, z), yaw = end.ankle_positions[feet].mean(axis=0), end.ankle_yaws[feet].mean()
        place = (x, y, z - robot.ankle_height, rotations.wrap(yaw), step.period, step.lift[feet[0]])
        up = " up" if len(feet) == 1 and feet[0] not in standing_feet(robot, boxes, end.ankle_positions) else ""
        cells = ["jump" if len(feet) == len(LEGS) else LEGS[feet[0]] + up, *map(_number, place)]
    return ",".join([*cells, *map(_number, [*end.trunk_position, *rotations.to_euler(end.trunk_orientation)])])


def _hold(seconds: float) -> str:
    return f"both,,,,,{_number(seconds)}"


def _same(start: Nodes, end: Nodes) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(start, end, strict=True))


def _number(value: float) -> str:
    """A number to six decimals, a micrometre, without needless zeros."""
    return f"{round(float(value), 6) + 0.0:.6f}".rstrip("0").rstrip(".")
