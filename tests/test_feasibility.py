"""Footholds that cannot be stood on, targets out of reach, and what is only just right."""

import pytest
from walks import HEADER, check_named, line_numbers, parse, problems

# What is wrong, the line it stands on, and words that must name it and what would be right. Line 1 is the header.
WRONG = {
    "box around a foot": ("left,0.2\n# box 0 0.1 0 0 0.1 0.1 0.1", 3, "where the left foot starts"),
    # hip 1.4 cm behind the middle, at 0.675 m: sqrt(0.414^2 + 0.635^2) m = 0.758 m to the ankle, allowed are 0.74 m
    "too far": ("left,0.8", 2, "the left foot is 1.8 cm out of reach at the end of the step, its ankle 0.758 m"),
    "trunk too far": ("both,,,,,1,,,,0.9", 2, "the right foot is 4.5 cm out of reach at the end of the step"),
    "swung too high": ("left,,,,,0.4,0.4", 2, "the left foot is 10.9 cm out of reach 0.20 s into the step"),
    "turned too far": ("left,,,,0.9,,,,,,,,0", 2, "turned 6.6 deg too far at the end of the step; wanted -45.0 deg"),
    "on the other foot": ("left,0.1,-0.08", 2, "overlaps the right foot by 6.0 cm"),
    "in the air": ("left,0.1,0.1,0.05", 2, "its sole's 4 corners the ground is up to 5.0 cm below z = 0.05 m"),
    "under the ground": ("left,0.1,0.1,-0.05", 2, "5.0 cm under the ground; wanted z = 0 m"),
    "inside a box": ("# box 0.3 0.1 0 0 0.4 0.2 0.1\nleft,0.2,0.1,0", 3, "box of line 2; wanted it on top, z = 0.1 m"),
    "heel over an edge": ("# box 0.3 0 0 0 0.2 0.4 0.1\nleft,0.25", 3, "in the air: under 2 of its sole's 4 corners"),
    "heel over an edge under a roof": (
        "# box 0.3 0 0 0 0.2 0.4 0.1\n# box 0 0 1 0 2 2 0.1\nleft,0.25,,0.1", 4, "in the air: under 2 of its sole"
    ),
    "toes in a riser": ("# box 0.3 0 0 0 0.2 0.4 0.1\nleft,0.15", 3, "inside the box of line 2"),
    "a pole under the sole": ("# box 0.2 0.1 0 0 0.02 0.02 0.1\nleft,0.2,0.1,0", 3, "inside the box of line 2"),
    "under a low roof": ("# box 0.3 0.1 0.02 0 0.4 0.1 0.1\nleft,0.3,0.1,0", 3, "inside the box of line 2"),
    # the foot is at most 8 cm high
    "through a wall": ("# box 0.2 0.1 0 0 0.04 0.1 0.3\nleft,0.4", 3, "foot passes through the box of line 2, 2"),
    "toes held inside a box": ("# box 0.3 0.1 0 0 0.2 0.4 0.3\nleft up,0.15,0.1,0.05", 3, "inside the box of line 2"),
    "over the edge when turned": ("# box 0.2 0.1 0 0 0.16 0.1 0.05\nleft,0.2,0.1,,0.3", 3, "in the air: under 4"),
}  # fmt: skip


@pytest.mark.parametrize("rows, line, words", WRONG.values(), ids=WRONG.keys())
def test_what_is_wrong_is_named_with_its_line(rows: str, line: int, words: str) -> None:
    check_named(rows, line, words)


@pytest.mark.parametrize(
    "rows",
    [
        # within a hair of what the list above refuses
        "left,0.68",
        "left,,,,,0.4,0.28",
        "left,,,,0.78,,,,,,,,0",
        "left,0,0",  # sole beside sole
        "left,0.1,0.1,0.0009",
        "both,,,,,1,,,,0.85",
        "# box 0.2 0.1 0 0 0.16 0.1 0.05\nleft,0.2,0.1",  # every corner on an edge
        "# box 0.2 0.1 0 0.3 0.16 0.1 0.05\nleft,0.2,0.1,,0.3",
        "left,0,-0.0009",
        "# box 0.28 0.1 0 0 0.16 0.1 0.05\nleft,0.12,0.1,0",  # toes at a riser
        "# box 0.2791 0.1 0 0 0.16 0.1 0.05\nleft,0.12,0.1,0",
        "# box 0.3 0.1 0.5 0 0.4 0.1 0.1\nleft,0.3,0.1,0",  # under a high roof
        "# box 0.15 0.1 0 0 0.1 0.2 0.05\n# box 0.25 0.1 0 0 0.1 0.2 0.05\nleft,0.2",  # over a joint of two boxes
        "# box 0.2 0.1 -0.2 0 0.4 0.1 0.1\nleft,0.2,0.1",  # buried
        "left,,,,,0.1\nboth\nleft,,,,,,0",
        "# box 0.2 0.1 0 0 0.04 0.1 0.07\nleft,0.4",  # over a bar,
    ],
)
def test_what_is_only_just_right_passes(rows: str) -> None:
    assert parse(rows).steps


def test_a_way_back_into_reach_is_no_problem_of_its_line() -> None:
    assert line_numbers(problems(HEADER + "left,0.9\nboth,,,,,9\nleft,0.2\nright,0.2")) == [2, 2]


def test_of_a_step_out_of_reach_the_end_is_named_even_if_it_was_farther_on_the_way() -> None:
    found = problems(HEADER + "left,0.3,0.1,0,0,0.5,0.6,0,0,0.85")
    assert [p for p in found if "left foot is 5.4 cm out of reach at the end of the step" in p], found


@pytest.mark.parametrize(
    ("rows", "line", "words"),
    [
        ("left up,0.1", 2, "z is empty; wanted the height at which the foot is held"),
        ("left up,0.1,,0", 2, "the left foot is not up, z = 0 m over ground at 0 m"),
        ("left up,,,0.1\nright,0.1", 3, "the left foot is in the air; wanted it down before the other one steps"),
        ("left up,,,0.1\nright up,,,0.1", 3, "the left foot is in the air"),
        ("jump,0.3,,0.1", 2, "the left foot stands in the air"),
        ("up,0.1", 2, "wanted left, right, left up, right up, jump or both"),
    ],
)
def test_what_feet_in_the_air_cannot_do(rows: str, line: int, words: str) -> None:
    assert any(f"walk.csv:{line}: " in p and words in p for p in problems(HEADER + rows))
