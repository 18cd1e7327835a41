"""Learning curves: what is read of a run, and where it is drawn."""

import json
import math
import pathlib
import re
import sys
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from bipedtrack import curves
from bipedtrack.messages import Refusal

FIGURES = {"falls": 0.5, "trunk_error_cm": 4.0, "ankle_error_cm": 2.0, "ankle_yaw_error_deg": 1.0}


def run_of(path: pathlib.Path, *records: dict) -> pathlib.Path:
    path.mkdir()
    lines = [json.dumps({"stage": "ground", **FIGURES, **record}) for record in records]
    (path / "progress.jsonl").write_text("".join(f"{line}\n" for line in lines))
    return path


def test_of_what_was_trained_twice_the_latter_counts(tmp_path: pathlib.Path) -> None:
    steps, falls = [10, 20, 30, 20, 30, 40], [1, 2, 3, 4, 5, 6]
    run = run_of(tmp_path / "run", *({"steps": s, "falls": f} for s, f in zip(steps, falls, strict=True)))
    found = curves.read(run)
    assert found["steps"].tolist() == [10, 20, 30, 40] and found["falls"].tolist() == [1, 4, 5, 6]


def test_a_last_line_that_was_cut_off_is_not_there_yet(tmp_path: pathlib.Path) -> None:
    run = run_of(tmp_path / "run", {"steps": 5}, {"steps": 6})
    with open(run / "progress.jsonl", "a") as file:
        file.write('{"stage": "ground", "fal')
    assert curves.read(run)["steps"].tolist() == [5, 6]


def test_smoothing_takes_the_mean_of_known_values_on_both_sides(tmp_path: pathlib.Path) -> None:
    falls = [1.0, 2.0, None, 6.0, 8.0]
    run = run_of(tmp_path / "run", *({"steps": i + 1, "falls": f} for i, f in enumerate(falls)))
    np.testing.assert_allclose(curves.read(run, 3)["falls"], [1, 1.5, 4, 7, 8])
    np.testing.assert_allclose(curves.read(run)["falls"], [1, 2, np.nan, 6, 8])


def test_curves_are_drawn_where_their_figures_are(tmp_path: pathlib.Path) -> None:
    first = run_of(tmp_path / "first", *({"steps": s, "falls": f} for s, f in ((0, 0.2), (1e6, 0.4), (2e6, 0.0))))
    second = run_of(tmp_path / "second<&", {"steps": 4e6, "falls": 0.1})
    drawn = ElementTree.fromstring(curves.picture({run.name: curves.read(run) for run in (first, second)}))
    text = "".join(drawn.itertext())
    assert all(label in text for label, _ in curves.PANELS.values()) and "second<&" in text
    panel = next(g for g in drawn.iter("{http://www.w3.org/2000/svg}g") if "Episodes that fall" in "".join(g.itertext()))
    (path,) = (p.get("d") for p in panel.iter("{http://www.w3.org/2000/svg}path") if p.get("class") == "p0 course")
    points = np.array([pair.split() for pair in re.split("[ML]", path or "")[1:]], float)
    # 4 M steps over the width, and 1.05 times 40 % over the height of the area, from its upper left corner
    width, height = 460 - 46 - 12, 220 - 8 - 36
    np.testing.assert_allclose(points[:, 0], width * np.array([0, 1, 2]) / 4, atol=0.06)
    np.testing.assert_allclose(points[:, 1], height * (1 - np.array([20, 40, 0]) / 42), atol=0.06)


def test_a_run_that_has_just_begun_is_drawn(tmp_path: pathlib.Path) -> None:
    ElementTree.fromstring(curves.picture({"run": curves.read(run_of(tmp_path / "run", {"steps": 0}))}))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "progress.jsonl: cannot be read"),
        ("", "has no record yet"),
        ('{"steps": 1\n', "is damaged"),
        ('{"steps": 1}\n', "is damaged (KeyError: 'falls')"),
        ("3\n", "is damaged"),
        ("[" * 100_000 + "\n", "is damaged"),
        (json.dumps({"steps": None, **FIGURES}) + "\n", "is damaged (TypeError: "),
        (json.dumps({"steps": -1, **FIGURES}) + "\n", "is damaged (ValueError: steps or figures are no numbers)"),
        (json.dumps({"steps": 1, **FIGURES, "falls": math.inf}) + "\n", "is damaged (ValueError: steps or figures"),
    ],
)
def test_what_is_no_run_is_refused_in_one_line(tmp_path: pathlib.Path, content: str | None, words: str) -> None:
    if content is not None:
        (tmp_path / "progress.jsonl").write_text(content)
    with pytest.raises(Refusal, match=re.escape(words)) as caught:
        curves.read(tmp_path)
    assert "\n" not in str(caught.value)


def test_the_command_writes_the_picture(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run, out = run_of(tmp_path / "run", {"steps": 5}, {"steps": 6}), tmp_path / "curves.svg"
    monkeypatch.setattr(sys, "argv", ["curves", str(run), "--out", str(out)])
    curves.main()
    assert capsys.readouterr().out == f"{out}\n" and ElementTree.parse(out).getroot().tag.endswith("svg")
    for arguments, words in (([], "at least one run"), ([str(run), "--smooth", "0"], "--smooth 0: must be at least 1")):
        monkeypatch.setattr(sys, "argv", ["curves", *arguments])
        with pytest.raises(SystemExit) as left:
            curves.main()
        assert left.value.code == 2 and words in capsys.readouterr().err
