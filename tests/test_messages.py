"""What a command line says on stderr."""

import pytest

from bipedtrack.messages import fail


def test_every_line_stands_under_the_programs_name(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        fail("walk.csv:2: no foot\nwalk.csv:3: no ground")
    assert left.value.code == 2
    assert capsys.readouterr().err == "bipedtrack: walk.csv:2: no foot\nbipedtrack: walk.csv:3: no ground\n"
