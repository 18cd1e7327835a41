"""What a training shows: JSON lines and TensorBoard events of the same figures, lines or a live table of them."""

import json
import pathlib
import re
import struct
import time

import pytest
from tensorboardX.proto import event_pb2

from bipedtrack import curriculum, progress
from bipedtrack.progress import Progress

PLAN = curriculum.load("smoke")  # three calls of 192 policy steps
CALLS = curriculum.calls(PLAN)
FIGURES = {
    "episode_seconds": 4.25,
    "falls": 0.375,
    "ankle_error_cm": 5.5,
    "ankle_yaw_error_deg": 2.25,
    "trunk_error_cm": 7.75,
    "trunk_error_deg": 3.5,
    "reward_per_step": 2.625,
    "kl_mean": 0.0125,
}


class Clock:
    """A clock that goes on when it is told to."""

    now = 1000.0

    def monotonic(self) -> float:
        return self.now

    def time(self) -> float:
        return 1e9 + self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    found = Clock()
    monkeypatch.setattr(progress, "time", found)
    return found


def events(folder: pathlib.Path) -> dict[tuple[str, int], float]:
    """The scalars of TensorBoard's event files by name and step: records of length, checksum, event, checksum."""
    scalars = {}
    for path in sorted(folder.glob("events.out.tfevents.*")):
        content, at = path.read_bytes(), 0
        while at < len(content):
            (length,) = struct.unpack_from("<Q", content, at)
            event = event_pb2.Event.FromString(content[at + 12 : at + 12 + length])
            for value in event.summary.value:
                scalars[value.tag, event.step] = value.simple_value
            at += length + 16
    return scalars


def lines(folder: pathlib.Path) -> list[dict[str, float]]:
    return [json.loads(line) for line in (folder / "progress.jsonl").read_text().splitlines()]


def test_json_lines_and_tensorboard_hold_the_same_figures(tmp_path: pathlib.Path) -> None:
    with Progress(tmp_path, PLAN, CALLS, 0) as shown:
        shown.compiling(CALLS[0], "a program")
        shown.update(CALLS[0], 20, FIGURES)
        shown.update(CALLS[0], 64, {name: 2 * value for name, value in FIGURES.items()})
        shown.finished(CALLS[0])
        shown.update(CALLS[1], 10, {name: 3 * value for name, value in FIGURES.items()})
    rows = lines(tmp_path)
    assert [row["steps"] for row in rows] == [20, 64, 202]
    assert [(row["stage"], row["lesson"], row["call"]) for row in rows] == [
        ("level ground", "half difficulty", 0),
        ("level ground", "half difficulty", 0),
        ("stairs", "low risers", 1),
    ]
    assert [{name: row[name] for name in FIGURES} for row in rows] == [
        {name: factor * value for name, value in FIGURES.items()} for factor in (1, 2, 3)
    ]
    assert all(abs(row["time"] - time.time()) < 60 for row in rows)
    scalars = events(tmp_path / "tensorboard")
    in_lines = {(name, row["steps"]): row[name] for row in rows for name in FIGURES}
    assert {key: scalars[key] for key in in_lines} == pytest.approx(in_lines, rel=1e-6)
    assert {step for _, step in scalars} == {20, 64, 202}


def test_a_resumed_training_counts_on_from_the_finished_calls(tmp_path: pathlib.Path) -> None:
    with Progress(tmp_path, PLAN, CALLS, 0) as shown:
        shown.update(CALLS[0], 64, FIGURES)
    time.sleep(1.1)  # event files are named by the second
    with Progress(tmp_path, PLAN, CALLS, 64) as shown:
        shown.update(CALLS[1], 30, FIGURES)
    assert [row["steps"] for row in lines(tmp_path)] == [64, 94]
    assert {step for _, step in events(tmp_path / "tensorboard")} == {64, 94}


def test_figures_that_are_not_finite_do_not_spoil_the_lines(tmp_path: pathlib.Path) -> None:
    with Progress(tmp_path, PLAN, CALLS, 0) as shown:
        shown.update(CALLS[0], 20, FIGURES | {"kl_mean": float("nan"), "falls": float("inf")})
    assert lines(tmp_path)[0]["kl_mean"] is None and lines(tmp_path)[0]["falls"] is None


def test_without_a_terminal_lines_name_stage_steps_speed_and_time_left(
    tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, clock: Clock
) -> None:
    monkeypatch.setattr(progress, "_LINE_EVERY", -1.0)
    with Progress(tmp_path, PLAN, CALLS, 64) as shown:
        shown.compiling(CALLS[1], "the learner")
        shown.update(CALLS[1], 10, FIGURES)
        clock.now += 0.4
        shown.update(CALLS[1], 30, FIGURES)
        shown.say("a warning of [stairs] and [/stairs]")
    compiling, first, second, warning = capsys.readouterr().out.splitlines()
    for line in (compiling, first, second):
        assert "stairs, low risers (call 2 of 3)" in line
    assert "compiling the learner" in compiling and "training" in second
    assert warning == "a warning of [stairs] and [/stairs]" and "\x1b" not in second
    for text in ("4.2 s, 38 % fall", "5.5 cm, 2.2 deg", "7.8 cm, 3.5 deg", "2.62 a step"):
        assert text in second
    assert "steps/s" not in first  # one point is no rate
    speed = float(re.search(r"(\d+) steps/s", second)[1])
    assert speed == 20 / 0.4
    assert re.search(r"\d+ min left", second)
    assert lines(tmp_path)[1]["steps_per_second"] == 20 / 0.4
    assert "0.00 of 0.00 M" in second


QUICK = curriculum.load("quick")
QUICK_CALLS = curriculum.calls(QUICK)
QUICK_STEPS = sum(call.steps for call in QUICK_CALLS)


def minutes_left(line: str) -> float:
    return float(re.search(r"(\d+) min left", line)[1])


def test_time_left_is_the_rest_of_all_calls_at_the_present_speed(
    tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, clock: Clock
) -> None:
    monkeypatch.setattr(progress, "_LINE_EVERY", -1.0)
    with Progress(tmp_path, QUICK, QUICK_CALLS, 0) as shown:
        shown.update(QUICK_CALLS[0], 1000, FIGURES)
        clock.now += 0.3
        shown.update(QUICK_CALLS[0], 2000, FIGURES)
    second = capsys.readouterr().out.splitlines()[1]
    assert minutes_left(second) == round((QUICK_STEPS - 2000) / (1000 / 0.3) / 60)
    assert f"of {QUICK_STEPS / 1e6:.2f} M" in second


def test_time_left_counts_what_the_calls_that_are_left_need_to_begin(
    tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, clock: Clock
) -> None:
    monkeypatch.setattr(progress, "_LINE_EVERY", -1.0)
    first = QUICK_CALLS[0]
    with Progress(tmp_path, QUICK, QUICK_CALLS, 0) as shown:
        for what, seconds in (("the environment", 10.0), ("the learner", 30.0)):
            shown.compiling(first, what)
            clock.now += seconds
        shown.update(first, 1000, FIGURES)
        clock.now += 0.5
        shown.update(first, 2000, FIGURES)
    # 2000 steps/s; of 40 s the first 1000 steps took half a second
    minutes = ((QUICK_STEPS - 2000) / 2000 + (len(QUICK_CALLS) - 1) * 39.5) / 60
    assert minutes_left(capsys.readouterr().out.splitlines()[-1]) == round(minutes)


def test_a_training_goes_on_where_tensorboard_has_no_place(
    tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "tensorboard").write_text("a file")
    with Progress(tmp_path, PLAN, CALLS, 0) as shown:
        for steps in (20, 40, 60):
            shown.update(CALLS[0], steps, FIGURES)
    assert len(lines(tmp_path)) == 3
    assert capsys.readouterr().out.count("tensorboard: cannot be written (File exists); goes on without") == 1


def test_a_training_goes_on_where_the_disk_becomes_full(
    tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with Progress(tmp_path, PLAN, CALLS, 0) as shown:
        shown.update(CALLS[0], 20, FIGURES)
        recorder = shown._events._writer._py_recordio_writer  # type: ignore[union-attr]
        recorder._writer = open("/dev/full", "wb")
        for steps in (40, 60):
            shown.update(CALLS[0], steps, FIGURES)
    assert len(lines(tmp_path)) == 3
    assert capsys.readouterr().out.count("No space left on device); goes on without") == 1


def test_lines_come_no_oftener_than_they_should(tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]) -> None:
    with Progress(tmp_path, PLAN, CALLS, 0) as shown:
        shown.compiling(CALLS[0], "the learner")
        for steps in range(1, 20):
            shown.update(CALLS[0], steps, FIGURES)
    assert len(capsys.readouterr().out.splitlines()) == 1
    assert len(lines(tmp_path)) == 19


def test_in_a_terminal_a_table_is_kept_up_to_date(
    tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")  # as a terminal
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "100")
    with Progress(tmp_path, PLAN, CALLS, 0) as shown:
        shown.compiling(CALLS[0], "the learner")
        shown.update(CALLS[0], 20, FIGURES)
        shown.say("beside the table")
    out = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", capsys.readouterr().out)
    for text in (
        "compiling the learner",
        "level ground, half difficulty (call 1 of 3)",
        "5.5 cm, 2.2 deg",
        "beside the table",
    ):
        assert text in out
    assert "|" not in out
