"""What the tests of footstep scripts share: two scripts, the workspace that their numbers are worked out for, a parser."""

import dataclasses

import numpy as np
import pytest

from bipedtrack import footsteps, robot
from bipedtrack.footsteps import Script, ScriptError

HEADER = "foot,x,y,z,yaw,period,lift,trunk_x,trunk_y,trunk_z,trunk_roll,trunk_pitch,trunk_yaw\n"
WALK = """# a short walk and a bow
foot,x,y,z,yaw,period,lift,trunk_x,trunk_y,trunk_z,trunk_roll,trunk_pitch,trunk_yaw
left,0.2,0.1,0,0,0.5,0.06

right,0.4,-0.1,0,0.2,0.602,,0.32,0.01,0.7,0,0.1,0.1
both,,,,,1,,,,0.68,,0.15
both,,,,,0.25
"""
STAIRS = """# box 0.8 0 0 0 0.8 1 0.1
# box 0.95 0 0.1 0 0.5 1 0.1,,,,,,
foot,x,y,z,yaw,period,lift,trunk_x,trunk_y,trunk_z,trunk_roll,trunk_pitch,trunk_yaw
left,0.25,0.1
right,0.5,-0.1
left,0.8,0.1
right,0.85,-0.1,0.2
left,0.95
"""
# the workspace that the numbers are worked out for
RANGER = dataclasses.replace(
    robot.load(),
    leg_length=np.array([0.35, 0.74]),
    joint_low=np.radians([-45, -30, -100, 0, -75, -30] * 2),
    joint_high=np.radians([45, 30, 40, 140, 45, 30] * 2),
)


def parse(rows: str, header: str = HEADER) -> Script:
    return footsteps.parse(header + rows, RANGER, "walk.csv")


def problems(text: str) -> list[str]:
    with pytest.raises(ScriptError) as caught:
        footsteps.parse(text, RANGER, "walk.csv")
    return str(caught.value).split("\n")


def line_numbers(found: list[str]) -> list[int]:
    return [int(p.split(":")[1]) for p in found]


def check_named(rows: str, line: int, words: str) -> None:
    """Every problem of the rows stands on that line, and one of them says these words."""
    found = problems(HEADER + rows)
    assert any(words in p for p in found), found
    assert all(p.startswith(f"walk.csv:{line}: ") for p in found), found
