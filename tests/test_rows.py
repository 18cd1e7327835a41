"""Every way in which a line of a footstep script can be written wrongly, and what may be left out or added."""

import numpy as np
import pytest
from walks import HEADER, check_named, parse, problems

# What is wrong, the line it stands on, and words that must name it and what would be right. Line 1 is the header.
WRONG = {
    "unknown foot": ("lfet,0.1", 2, "foot is 'lfet'; wanted left, right, left up, right up, jump or both"),
    "no foot": (",0.1", 2, "foot is ''; wanted left, right, left up, right up, jump or both"),
    "not a number": ("left,0,1.2.3", 2, "y is '1.2.3'; wanted a finite number of m"),
    "not a number of radians": ("left,0,0.1,0,ten", 2, "yaw is 'ten'; wanted a finite number of rad"),
    "not finite": ("left,nan", 2, "x is 'nan'; wanted a finite number of m"),
    "infinite": ("left,,,,,inf", 2, "period is 'inf'; wanted a finite number of s"),
    "too large": ("left,1e300", 2, "x is '1e300'; wanted a finite number of m, at most 1000000 m"),
    "no period": ("left\nleft,,,,,0", 3, "period is 0 s; wanted at least 0.1 s"),
    "shorter than a policy knows": ("left,,,,,0.095", 2, "period is 0.095 s; wanted at least 0.1 s"),
    "negative period": ("left,,,,,-0.5", 2, "period is -0.5 s; wanted at least 0.1 s"),
    "negative lift": ("left,,,,,,-0.1", 2, "lift is -0.1 m; wanted at least 0 m"),
    "a cell too many": ("left,,,,,,,,,,,,,0", 2, "has 14 cells; wanted at most 13"),
    "both with a foothold": ("both,0.2", 2, "x is '0.2', but no foot moves; wanted it empty"),
    "both with a lift": ("both,,,,,,0.1", 2, "lift is '0.1', but no foot moves; wanted it empty"),
    "no step": ("# nothing", 1, "no step follows the header; wanted a line for each step"),
    "box without a number": ("left\n# box 1 2 3 0 1 1", 3, "6 numbers; wanted `# box x y z yaw length width height`"),
    "box of words": ("left\n# box 1 2 3 0 1 wide 1", 3, "box width is 'wide'; wanted a finite number of m"),
    "box without a size": ("left\n# box 1 2 3 0 1 0 1", 3, "box width is 0 m; wanted at least 0.001 m"),
    "box of negative size": ("# box 1 2 3 0 1 1 -1\nleft", 2, "box height is -1 m; wanted at least 0.001 m"),
}  # fmt: skip


@pytest.mark.parametrize("rows, line, words", WRONG.values(), ids=WRONG.keys())
def test_what_is_wrong_is_named_with_its_line(rows: str, line: int, words: str) -> None:
    check_named(rows, line, words)


def test_columns_in_any_order_quotes_padding_and_comments() -> None:
    text = 'trunk_yaw,"trunk_pitch",trunk_roll,trunk_z,trunk_y,trunk_x,lift,period,yaw,z,y,x,foot,,\r\n'
    text += '#left,9\r\n,,,,,,,0.4,,0,0.1, 0.2 ,"left",,\r\n,,,,,,,,,,,,\r\n  # boxes: none\r\n'
    script = parse(text, header="")
    assert script.lines == (3,)
    np.testing.assert_allclose(script.steps[0].end.ankle_positions[0], [0.2, 0.1, 0.04])
    assert script.boxes == ()


def test_headers() -> None:
    start = "walk.csv:1: "
    lines = problems(HEADER.replace("trunk_z", "trunkz") + "left")
    assert lines[0] == f"{start}unknown column 'trunkz'; did you mean 'trunk_z'?"
    assert lines[1] == f"{start}the header lacks trunk_z; wanted {HEADER.strip()}"
    assert problems(HEADER.replace(",yaw", "") + "left") == [f"{start}the header lacks yaw; wanted {HEADER.strip()}"]
    assert problems(HEADER.replace("\n", ",lift\n") + "left") == [
        f"{start}column 'lift' stands in the header 2 times; wanted it once"
    ]
    assert problems("left,0.2,0.1\nright,0.2") == [f"{start}is not the header; wanted {HEADER.strip()}"]
    assert problems("\n \n# a comment\n") == [
        f"walk.csv: is empty; wanted the header {HEADER.strip()} and a line for each step"
    ]
    assert problems("") == problems("\n")
