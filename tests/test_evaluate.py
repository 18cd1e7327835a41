"""The command line end to end: what it prints and writes against the traces it leaves, ablations, and every refusal."""

import dataclasses
import json
import math
import os
import pathlib
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib import metadata
from typing import Any, NamedTuple

import mujoco
import numpy as np
import pytest
import tyro
from policies import small_policy
from traces import by_mujoco

import bipedtrack
from bipedtrack import disturbances, evaluate, footsteps, kinematics, metrics, policy, sampling, statics, suite, trace
from bipedtrack import robot as robots
from bipedtrack.nodes import Nodes, ankles_in_trunk_frame

ROOT = pathlib.Path(bipedtrack.__file__).parents[1]
FIRST = ROOT / "models" / "policies" / "best.npz"
WALK = ROOT / "curricula" / "footsteps" / "walk.csv"
ENVIRONMENT = os.environ | {
    "PYTHONPATH": str(ROOT),
    "XLA_FLAGS": "--xla_backend_optimization_level=0",
    "JAX_PLATFORMS": "cpu",
}
PATIENCE = 900  # s that anything may take on a busy machine
pytestmark = pytest.mark.usefixtures("unoptimised")
ENGINES = ("mjx", "mujoco", "converged")
SECONDS, TICKS = 0.65, 130  # no whole number of policy periods
SHORT = "\n".join([",".join(footsteps.COLUMNS), "left,0.1,,,0.1,0.3", "both,,,,,0.1"])  # 0.4 s


class Run(NamedTuple):
    """A finished evaluation."""

    status: int
    printed: list[str]
    errors: str
    out: pathlib.Path

    @property
    def record(self) -> dict[str, Any]:
        """metrics.json, which may hold no number that JSON does not have."""
        return json.loads((self.out / "metrics.json").read_text(), parse_constant=pytest.fail)

    def summary(self, task: str, name: str, engine: str) -> dict[str, Any]:
        return self.record["tasks"][task]["policies"][name][engine]["summary"]

    @property
    def traces(self) -> dict[str, dict[str, np.ndarray]]:
        return {path.stem: dict(np.load(path)) for path in sorted((self.out / "traces").iterdir())}


class Runs(NamedTuple):
    first: Run  # two episodes of walk-forward with the policy that ships, in all engines
    zero: Run  # the same without anything that acts
    script: Run  # two policies of the same file name on a footstep script, in C


RANDOM = ("--tasks", "walk-forward", "--episodes", "2", "--seconds", str(SECONDS))
COMMANDS = Runs(
    (str(FIRST), *RANDOM),
    ("zero", *RANDOM, "--sway", str(policy.load(FIRST).sway)),
    (str(FIRST), "silent/best.npz", "--script", str(WALK), "--engine", "mujoco"),
)


@pytest.fixture(scope="module", autouse=True)
def started(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[pathlib.Path, subprocess.Popen[str]]]:
    """The evaluations that `runs` waits for, by where they write; meanwhile the tests that need none of them run."""
    folder = tmp_path_factory.mktemp("evaluate")
    shipped = policy.load(FIRST)
    network = shipped.network._replace(weights=tuple(0 * w for w in shipped.network.weights))
    silent = dataclasses.replace(shipped, network=network._replace(biases=tuple(0 * b for b in network.biases)))
    (folder / "silent").mkdir()
    policy.save(dataclasses.replace(silent, provenance={"curriculum": "none"}), folder / "silent" / "best.npz")
    options: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "env": ENVIRONMENT}
    processes = {}
    for out, arguments in COMMANDS._asdict().items():
        command = [sys.executable, "-m", "bipedtrack.evaluate", *arguments, "--out", out]
        processes[folder / out] = subprocess.Popen(command, cwd=folder, **options)
    yield processes
    for process in processes.values():
        process.kill()
        process.communicate()


@pytest.fixture(scope="module")
def runs(started: dict[pathlib.Path, subprocess.Popen[str]]) -> Runs:
    finished = []
    for out, process in started.items():
        said, errors = process.communicate(timeout=PATIENCE)
        finished.append(Run(process.returncode, said.splitlines(), errors, out))
    return Runs(*finished)


def nodes(arrays: dict[str, np.ndarray], side: str) -> Nodes:
    return Nodes(*(arrays[f"{side}_{field}"].astype(float) for field in Nodes._fields))


def errors(target: Nodes, real: Nodes) -> dict[str, np.ndarray]:
    """By the names of the summary: (n,) each."""
    turns = []
    for a, b in zip(target.trunk_orientation, real.trunk_orientation, strict=True):
        turn = np.zeros(3)
        mujoco.mju_subQuat(turn, a / np.linalg.norm(a), b / np.linalg.norm(b))
        turns.append(math.degrees(np.linalg.norm(turn)))
    found = {"trunk_orientation_deg": np.array(turns)}
    found["trunk_position_cm"] = 100 * np.linalg.norm(target.trunk_position - real.trunk_position, axis=-1)
    for i, leg in enumerate(("left", "right")):
        gap = target.ankle_positions[:, i] - real.ankle_positions[:, i]
        found[f"{leg}_ankle_position_cm"] = 100 * np.sqrt((gap**2).sum(axis=-1))
        yaws = target.ankle_yaws[:, i] - real.ankle_yaws[:, i]
        found[f"{leg}_ankle_yaw_deg"] = np.degrees(np.abs(np.angle(np.exp(1j * yaws))))
    return found


# Robustness


def test_robustness_goes_through_the_levels_of_every_disturbance(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ladders = {"push": disturbances.LADDERS["push"]._replace(levels=(0.0, 60.0)), "delay": disturbances.LADDERS["delay"]}
    monkeypatch.setattr(evaluate, "LADDERS", ladders)
    arguments = [str(FIRST), "--tasks", "stand", "--episodes", "2", "--seconds", "6", "--engine", "mujoco", "--robustness"]
    found = evaluate.run(tyro.cli(evaluate.Evaluate, args=[*arguments, "--out", str(tmp_path)]))["robustness"][str(FIRST)]
    assert {name: [row["level"] for row in one["levels"]] for name, one in found.items()} == {
        "push": [0, 60],
        "delay": [0, 1, 2],
    }
    gently, hard = (row["survival"]["share"] for row in found["push"]["levels"])
    assert (gently, hard) == (1, 0)  # 60 N s are 1.5 m/s at once
    assert [row["survival"]["share"] for row in found["delay"]["levels"]] == [1, 1, 1]
    assert all(one["task"] == "walk-forward" and one["episodes"] == 2 for one in found.values())
    printed = capsys.readouterr().out
    assert "push 60 N s: 0 % without a fall" in printed and "delay 2 control steps: 100 % without a fall" in printed


# Refusals


REFUSALS = {  # the arguments and a part of the line
    "ik --tasks fly": "--tasks fly: no such task; there are: stand, squat",
    "nobody.npz": "nobody.npz: cannot be read (No such file or directory)",
    "cut.npz": "cut.npz: ",
    "ik cut.npz": "cut.npz: ",
    "empty": "policy.npz: cannot be read",
    "ik --script nowhere.csv": "nowhere.csv: cannot be read (No such file or directory)",
    "ik --script bad.csv": "bad.csv:3: foot is 'middle'; wanted left, right, left up, right up, jump or both",
    "ik --episodes 0": "--episodes 0: must be at least 1",
    "sways.npz straight.npz": "(sways.npz with --sway 0.5, straight.npz with --sway 0); wanted one --sway for all of them",
    "ik --script bad.csv --tasks stand": "--script and --tasks: wanted one of them",
    "ik --seed -1": "--seed -1: must lie in [0, 2^63)",
    "ik --seed 100000000000000000000": "--seed 100000000000000000000: must lie in [0, 2^63)",
    "ik --sway 1.5": "--sway 1.5: must lie in [0, 1]",
    "ik --seconds 0": "--seconds 0.0: must lie in [0.1, 600]",
    "ik --seconds nan": "--seconds nan: must lie in [0.1, 600]",
    "ik --tasks stand stairs-down --seconds 12.1": "--seconds 12.1: stairs-down: its 30 treads last 12 s",
    "ik --robustness --seconds 5.9": "--seconds 5.9: --robustness needs at least 6, for the pushes",
    "ik --feedback-ratio 3": "--feedback-ratio 3.0: must lie in [0, 2]",
    "ik --filter 0": "filter must lie in (0, 1], not 0.0",
    "ik --out cut.npz": "cut.npz",
    "ik --out cut.npz/inside": "cut.npz/inside",
    "": "name at least one policy",
}


@pytest.mark.parametrize(("arguments", "wanted"), REFUSALS.items())
def test_what_cannot_be_evaluated_is_refused_in_one_line(
    tmp_path: pathlib.Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: str,
    wanted: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    content = FIRST.read_bytes()
    (tmp_path / "cut.npz").write_bytes(content[: len(content) // 2])
    (tmp_path / "bad.csv").write_text("\n".join([*SHORT.splitlines()[:2], "middle,0.1"]))
    for name, sway in (("sways", 0.5), ("straight", 0.0)):
        policy.save(dataclasses.replace(small_policy(), sway=sway), tmp_path / f"{name}.npz")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    # should it not be refused, it shall at least be short
    short = {"--tasks": "stand", "--episodes": "1", "--engine": "mujoco"}
    given = arguments.split()
    short = short if "--script" not in given else {}
    given += [word for option, value in short.items() if option not in given for word in (option, value)]
    monkeypatch.setattr(sys, "argv", ["bipedtrack.evaluate", *given])
    with pytest.raises(SystemExit) as refusal:
        evaluate.main()
    said = capsys.readouterr()
    assert (refusal.value.code, said.out, said.err.count("\n")) == (2, "", 1), said
    assert said.err.startswith("bipedtrack: ") and wanted in said.err
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bad.csv", "cut.npz", "empty", "straight.npz", "sways.npz"]


def test_only_what_stands_on_the_ground_counts_for_the_clearance(robot: robots.Robot) -> None:
    batches = {name: suite.batch(name, sampling.Ranges(), robot, 2, 1.0, 5) for name in ("walk-forward", "stairs-up")}
    assert evaluate.boxes_of(batches["walk-forward"]) is None
    boxes = evaluate.boxes_of(batches["stairs-up"])
    assert boxes is not None and (boxes.centres[..., 2] + boxes.half_sizes[..., 2]).max() > 0.02


def test_who_stops_it_keeps_what_is_done(tmp_path: pathlib.Path) -> None:
    tasks = ("stand", "walk-forward", "sidle-left", "turn-left", "squat")
    arguments = ["ik", "--engine", "converged", "--episodes", "1", "--seconds", "2", "--tasks", *tasks]
    command = [sys.executable, "-m", "bipedtrack.evaluate", *arguments, "--out", str(tmp_path)]
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "env": ENVIRONMENT}
    with subprocess.Popen(command, **pipes) as running:
        said = [running.stdout.readline() for _ in range(2)]  # type: ignore[union-attr]
        running.send_signal(signal.SIGINT)
        _, errors = running.communicate(timeout=PATIENCE)
    assert running.returncode == 130 and errors.count("\n") <= 2 and f"{tmp_path} holds the tasks that are done" in errors
    assert [line.split()[1] for line in said] == list(tasks[:2])
    found = Run(130, said, errors, tmp_path)
    assert 1 <= len(found.record["tasks"]) < len(tasks) and "stand" in found.record["tasks"]
    assert "stand" in (tmp_path / "report.html").read_text()


# Ablations


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    path = tmp_path_factory.mktemp("script") / "short.csv"
    path.write_text(SHORT)
    return path


def test_feedback_ratio_0_is_ik(short: pathlib.Path, tmp_path: pathlib.Path) -> None:
    # the policy has velocity feedforward and an integral, `ik` has neither unless told
    arguments = ["ik", str(FIRST), "--feedback-ratio", "0", "--velocity-feedforward", "True", "--integral", "0.5"]
    arguments += ["--script", str(short), "--engine", "mujoco"]
    found = evaluate.run(tyro.cli(evaluate.Evaluate, args=[*arguments, "--out", str(tmp_path)]))
    ik, ablated = found["tasks"]["script-short"]["policies"].values()
    for engine in ENGINES[1:]:
        # the network says something, but nobody listens
        effort = [one[engine]["summary"]["effort"] for one in (ik, ablated)]
        assert effort[1]["feedback_mean"] > 0.01 > effort[0]["feedback_max"] == 0
        for figures in effort:
            del figures["feedback_mean"], figures["feedback_max"]
        of_each = [{name: part for name, part in one[engine].items() if name != "traces"} for one in (ik, ablated)]
        assert of_each[0] == of_each[1]
    # curves and paths, which the report draws, are every tenth entry of what was recorded
    arrays = dict(np.load(tmp_path / "traces" / "1-best-mujoco-script-short-0.npz"))
    assert arrays["alive"].all() and len(arrays["time"]) == 80
    course, path = (ablated["mujoco"][name] for name in ("course", "path"))
    said = errors(nodes(arrays, "target"), nodes(arrays, "measured"))
    assert set(course) == {"time_s", "alive_share", *said} and course["alive_share"] == [1] * 8
    for name, values in {"time_s": arrays["time"], **said}.items():
        np.testing.assert_allclose(course[name], values[::10], atol=2e-3)
    for side in ("target", "measured"):
        at = nodes(arrays, side)
        points = {"trunk": at.trunk_position, "left": at.ankle_positions[:, 0], "right": at.ankle_positions[:, 1]}
        for name, values in points.items():
            np.testing.assert_allclose(path[side][name], values[::10], atol=1e-4)


@pytest.fixture(scope="module")
def record(short: pathlib.Path) -> Callable[..., trace.Trace]:
    """The trace of the short script in C for the arguments of a command line."""

    def recorded(*arguments: object) -> trace.Trace:
        options = tyro.cli(evaluate.Evaluate, args=[*map(str, arguments), "--engine", "mujoco"])
        who = evaluate.subject(options.policies[0], options)
        batch = suite.script_batch(footsteps.load(short, who.robot))
        return evaluate.Engines(who, options.engine).record("mujoco", batch, 0.4)

    return recorded


@pytest.mark.parametrize(
    ("engine", "names"),
    [
        ("both", ["mjx", "mujoco", "converged"]),
        ("mujoco", ["mujoco", "converged"]),
        ("mjx", ["mjx"]),
        ("converged", ["converged"]),
    ],
)
def test_an_engine_is_run_alone_or_beside_others(engine: str, names: list[str]) -> None:
    options = tyro.cli(evaluate.Evaluate, args=["ik", "--engine", engine])
    assert list(evaluate.Engines(evaluate.subject("ik", options), options.engine).names) == names


def follow(robot: robots.Robot, found: trace.Trace) -> np.ndarray:
    """The joint angles (n, 12) of the targets by inverse kinematics; the trunk is level here."""
    targets = [Nodes(*(part[0, t].astype(float) for part in found.target)) for t in range(len(found.time))]
    return np.array([kinematics.inverse(robot, *ankles_in_trunk_frame(one)) for one in targets])


def test_filter_feedback_ratio_and_feedforward_are_those_asked_for(
    record: Callable[..., trace.Trace], robot: robots.Robot
) -> None:
    found = record(FIRST, "--filter", 1, "--feedback-ratio", 0.1, "--velocity-feedforward", False, "--integral", 0)
    wanted = follow(robot, found) + 0.1 * robot.joint_half_range * found.feedback[0]
    np.testing.assert_allclose(found.joint_targets[0], wanted.clip(robot.joint_low, robot.joint_high), atol=1e-5)
    assert np.abs(found.feedback).max() > 0.01

    stays = record(FIRST, "--filter", 1, "--no-feedforward", "--integral", 0)
    wanted = follow(robot, stays)[:1] + 0.3 * robot.joint_half_range * stays.feedback[0]
    np.testing.assert_allclose(stays.joint_targets[0], wanted.clip(robot.joint_low, robot.joint_high), atol=1e-5)
    assert np.ptp(follow(robot, stays), axis=0).max() > 0.1


def test_velocity_feedforward_is_switched_on(record: Callable[..., trace.Trace], robot: robots.Robot) -> None:
    found = record("ik", "--filter", 1, "--velocity-feedforward", True)
    joints = follow(robot, found)
    speeds = np.diff(joints, axis=0, prepend=joints[:1]) / 0.005
    wanted = joints + robot.kd / robot.kp * speeds
    np.testing.assert_allclose(found.joint_targets[0], wanted.clip(robot.joint_low, robot.joint_high), atol=1e-4)
    assert np.abs(wanted - joints).max() > 0.02


def test_gravity_feedforward_is_switched_on(record: Callable[..., trace.Trace], robot: robots.Robot) -> None:
    found = record("ik", "--filter", 1, "--gravity-feedforward", True)
    joints = follow(robot, found)[0]
    load = statics.load(robot, joints, found.target.trunk_orientation[0, 0], found.timer[0, 0] <= 0)
    np.testing.assert_allclose(found.joint_targets[0, 0], joints + load / robot.kp, atol=1e-4)
    assert np.abs(load / robot.kp).max() > 0.02


def test_the_integral_is_the_one_asked_for() -> None:
    gains = [evaluate.subject("ik", evaluate.Evaluate(("ik",), integral=gain)).settings.integral for gain in (None, 2.0)]
    assert gains == [0.0, 2.0]
    with pytest.raises(ValueError, match="integral must be finite and not negative"):
        evaluate.subject("ik", evaluate.Evaluate(("ik",), integral=-1.0))


def test_a_run_directory_stands_for_its_policy(tmp_path: pathlib.Path) -> None:
    (tmp_path / "policy.npz").write_bytes(FIRST.read_bytes())
    options = evaluate.Evaluate((str(tmp_path),))
    found, wanted = (evaluate.subject(name, options) for name in (str(tmp_path), str(FIRST)))
    assert found.name == str(tmp_path) and found.provenance == wanted.provenance
    seen = np.linspace(-1, 1, 101, dtype=np.float32)
    np.testing.assert_array_equal(found.act(seen), wanted.act(seen))


# What is printed and written


def test_it_ends_with_the_page_and_says_nothing_else(runs: Runs) -> None:
    for run in runs:
        assert (run.status, run.errors) == (0, "")
        assert run.printed[-1] == f"{run.out.name}/report.html"
        names = sorted(path.name for path in run.out.iterdir())
        assert names == ["metrics.json", "report.html", "traces"]


LINE = re.compile(
    r"(\S+) +(\S+) +(\S+) +([\d.]+) % up +ankles +([\d.]+) cm \(95 %: +([\d.]+)\) +([\d.]+) deg"
    r" +trunk +([\d.]+) cm +([\d.]+) deg(?: +foothold +([\d.]+) cm)? +\(\d+ s\)"
)


def test_the_table_has_a_line_for_each_policy_and_engine(runs: Runs) -> None:
    expected = [
        (runs.first, [(str(FIRST), "best", engine) for engine in ENGINES], "walk-forward"),
        (runs.zero, [("zero", "zero", engine) for engine in ENGINES], "walk-forward"),
        (
            runs.script,
            [(name, name, engine) for name in (str(FIRST), "silent/best.npz") for engine in ENGINES[1:]],
            "script-walk",
        ),
    ]
    for run, rows, task in expected:
        assert len(run.printed) == len(rows) + 1
        for line, (name, label, engine) in zip(run.printed, rows, strict=False):
            found = LINE.fullmatch(line)
            assert found, line
            assert found.groups()[:3] == (label, task, engine)  # whole paths where files are called the same
            summary = run.summary(task, name, engine)
            of = summary["errors"]
            ankles, yaws = ([of[f"{leg}_ankle_{what}"] for leg in ("left", "right")] for what in ("position_cm", "yaw_deg"))
            wanted = [
                100 * summary["survival"]["share"],
                sum(one["mean"] for one in ankles) / 2,
                max(one["p95"] for one in ankles),
                sum(one["mean"] for one in yaws) / 2,
                of["trunk_position_cm"]["mean"],
                of["trunk_orientation_deg"]["mean"],
            ]
            assert [float(number) for number in found.groups()[3:9]] == pytest.approx(wanted, abs=0.051)
            foothold = summary["touchdown"]["foothold_cm"]["mean"]
            assert (found[10] is None) == (foothold is None)
            assert foothold is None or float(found[10]) == pytest.approx(foothold, abs=0.051)


def test_metrics_say_what_was_asked_of_whom_and_with_what(runs: Runs) -> None:
    record = runs.first.record
    assert {"options", "versions", "policies", "tasks", "verdicts"} <= set(record)
    options = record["options"]
    wanted = {"policies": [str(FIRST)], "tasks": ["walk-forward"], "episodes": 2, "seconds": SECONDS, "engine": "both"}
    wanted |= {
        "seed": 2024,
        "out": "first",
        "script": None,
        "robustness": False,
        "feedback_ratio": None,
        "feedforward": True,
    }
    assert wanted.items() <= options.items()
    assert options["sway"] == policy.load(FIRST).sway  # as it learned it
    assert set(options) == {field.name for field in dataclasses.fields(evaluate.Evaluate)}
    for package in ("jax", "mujoco", "mujoco-mjx", "numpy"):
        assert record["versions"][package] == metadata.version(package)
    assert record["policies"] == {str(FIRST): policy.load(FIRST).provenance}
    assert runs.script.record["policies"]["silent/best.npz"] == {"curriculum": "none"}
    assert runs.zero.record["policies"] == {"zero": {}}
    assert runs.script.record["options"]["script"] == str(WALK)


def test_metrics_hold_tasks_policies_and_engines(runs: Runs) -> None:
    (task,) = runs.first.record["tasks"].values()
    assert task["seconds"] == SECONDS and "walk_step [0.03, 0.03, 0.25]" in task["ranges"]
    assert set(task["policies"]) == {str(FIRST)} and tuple(task["policies"][str(FIRST)]) == ENGINES
    for run in (runs.first, runs.zero):
        for found in next(iter(run.record["tasks"]["walk-forward"]["policies"].values())).values():
            assert set(found) == {"summary", "levels", "traces"}
            assert found["summary"]["episodes"] == 2 and found["summary"]["seconds"] == pytest.approx(SECONDS)
            # two levels of one episode each
            shares = [level["survival"]["share"] for level in found["levels"]]
            assert len(shares) == 2 and np.mean(shares) == found["summary"]["survival"]["share"]
            assert [level["episodes"] for level in found["levels"]] == [1, 1]
    (script,) = runs.script.record["tasks"].values()
    assert script["seconds"] == pytest.approx(6 * 0.55 + 2.0) and "walk.csv" in script["ranges"]
    for engines in script["policies"].values():
        assert tuple(engines) == ENGINES[1:]
        for found in engines.values():
            assert found["levels"] == [] and found["summary"]["episodes"] == 1
            assert found["summary"]["touchdown"]["planned"] >= 5 or found["summary"]["survival"]["falls"] == 1


def test_verdicts_are_about_what_was_evaluated(runs: Runs) -> None:
    found = runs.first.record["verdicts"]
    assert {line["about"] for line in found} >= {"figure 6", "two simulators"}
    for line in found:
        assert {"about", "task", "policy", "engine", "claim", "figure", "bound", "met"} <= set(line)
        assert line["policy"] == str(FIRST)
    up = [
        line
        for line in found
        if line["about"] == "figure 6" and line["engine"] == "mjx" and "without a fall" in line["claim"]
    ]
    assert [line["value"] for line in up] == [
        100 * runs.first.summary("walk-forward", str(FIRST), "mjx")["survival"]["share"]
    ]


def test_the_page_needs_no_other_address(runs: Runs) -> None:
    for run in runs:
        page = (run.out / "report.html").read_text()
        assert page.startswith("<!DOCTYPE html>") and page.rstrip().endswith("</html>")
        links = re.findall(r"""(?:href|src|srcset|action)\s*=\s*["']?([^"'\s>]*)""", page)
        assert links and all(link.startswith(("#", "data:")) for link in links)
        assert not re.search(r"<script|@import|url\(\s*['\"]?(?!#|data:)", page)
        for task in run.record["tasks"]:
            assert task in page


# Traces


def test_errors_of_the_traces_are_those_of_the_summary(runs: Runs, mj_model: mujoco.MjModel) -> None:
    # the summary is over all episodes, and all have their traces here
    groups = [(runs.first, str(FIRST), "walk-forward", "0-best", engine, (0, 1)) for engine in ENGINES[:2]]
    groups += [(runs.zero, "zero", "walk-forward", "0-zero", engine, (0, 1)) for engine in ENGINES[:2]]
    named = ((str(FIRST), "0-best"), ("silent/best.npz", "1-best"))
    groups += [(runs.script, name, "script-walk", stem, "mujoco", (0,)) for name, stem in named]
    left = {run.out.name: set(run.traces) for run in runs}
    for run in runs:
        (task,) = run.record["tasks"].values()
        named = [file for engines in task["policies"].values() for found in engines.values() for file in found["traces"]]
        assert sorted(named) == sorted(f"{name}.npz" for name in run.traces)
    for run, name, task, stem, engine, episodes in groups:
        pooled = []
        for episode in episodes:
            arrays = run.traces[f"{stem}-{engine}-{task}-{episode}"]
            left[run.out.name].remove(f"{stem}-{engine}-{task}-{episode}")
            alive = arrays["alive"]
            assert len(arrays["time"]) == (TICKS if task == "walk-forward" else 1060)
            np.testing.assert_allclose(arrays["time"], np.arange(len(alive)) * 0.005, atol=1e-9)
            target = Nodes(*(part[alive] for part in nodes(arrays, "target")))
            said = errors(target, Nodes(*(part[alive] for part in nodes(arrays, "measured"))))
            pooled.append(errors(target, by_mujoco(mj_model, arrays["qpos"][alive])))
            for error, values in pooled[-1].items():
                np.testing.assert_allclose(said[error], values, atol=2e-3)
        levels = run.record["tasks"][task]["policies"][name][engine]["levels"]
        for error in metrics.ERRORS:
            means = sorted(level["errors"][error]["mean"] for level in levels)
            assert means == [] or means == pytest.approx(sorted(found[error].mean() for found in pooled), abs=2e-3, rel=1e-4)
            values = np.concatenate([found[error] for found in pooled])
            wanted = {"mean": values.mean(), "rms": np.sqrt((values**2).mean()), "max": values.max()}
            wanted |= {"p95": np.percentile(values, 95)}
            said = run.summary(task, name, engine)["errors"][error]
            assert {key: said[key] for key in wanted} == pytest.approx(wanted, abs=2e-3, rel=1e-4)
    assert left == {run.out.name: set() for run in runs}


def test_engines_agree_and_every_policy_has_the_same_episodes(runs: Runs) -> None:
    first = [runs.first.summary("walk-forward", str(FIRST), engine) for engine in ENGINES[:2]]
    for name in metrics.ERRORS:
        a, b = (summary["errors"][name]["mean"] for summary in first)
        assert abs(a - b) < 0.02 + 0.1 * b and b > 0.05, (name, a, b)  # cm or deg
    for episode in (0, 1):
        targets = [
            nodes(run.traces[f"0-{stem}-{engine}-walk-forward-{episode}"], "target")
            for run, stem in ((runs.first, "best"), (runs.zero, "zero"))
            for engine in ENGINES[:2]
        ]
        for other in targets[1:]:
            for a, b in zip(targets[0], other, strict=True):
                np.testing.assert_allclose(a[:40], b[:40], atol=2e-6)


def test_zero_keeps_its_joint_targets_in_both_engines(runs: Runs) -> None:
    for engine in ENGINES[:2]:
        for episode in (0, 1):
            arrays, acting = (
                run.traces[f"0-{stem}-{engine}-walk-forward-{episode}"]
                for run, stem in ((runs.zero, "zero"), (runs.first, "best"))
            )
            first = arrays["qpos"][0, 7:]
            np.testing.assert_allclose(arrays["joint_targets"], np.tile(first, (TICKS, 1)), atol=1e-5)
            assert (arrays["feedback"] == 0).all()
            assert np.ptp(acting["joint_targets"], axis=0).max() > 0.1 and np.abs(acting["feedback"]).max() > 0.01


def test_policies_of_the_same_file_name_keep_their_own_traces(runs: Runs) -> None:
    one, other = (runs.script.traces[f"{stem}-mujoco-script-walk-0"] for stem in ("0-best", "1-best"))
    assert np.abs(one["feedback"]).max() > 0.05 and (other["feedback"] == 0).all()
    assert np.abs(one["qpos"] - other["qpos"])[:100].max() > 1e-3
