"""The command line end to end: every stage and export, a killed run, a second one, signals, and every refusal.

The programs are compiled with less effort than usual: the same for all runs, whose results are compared bit by bit.
"""

import contextlib
import json
import os
import pathlib
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import pytest

import bipedtrack
from bipedtrack import checkpoint, policy
from bipedtrack.run_directory import RunDirectory

ROOT = pathlib.Path(bipedtrack.__file__).parents[1]
ENVIRONMENT = os.environ | {
    "PYTHONPATH": str(ROOT),
    "XLA_FLAGS": "--xla_backend_optimization_level=0",
    "COLUMNS": "200",
}
ENVIRONMENT.pop("TF_CPP_MIN_LOG_LEVEL", None)  # jax has set it here
PATIENCE = 600  # s that anything may take on a busy machine


def start(module: str, *arguments: object, cwd: pathlib.Path, out: Any = subprocess.PIPE) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", f"bipedtrack.{module}", *map(str, arguments)]
    return subprocess.Popen(command, stdout=out, stderr=out, text=True, env=ENVIRONMENT, cwd=cwd)


@contextlib.contextmanager
def running(*arguments: object, cwd: pathlib.Path, out: Any = subprocess.PIPE) -> Iterator[subprocess.Popen[str]]:
    """A training that does not outlive the block."""
    process = start("train", *arguments, cwd=cwd, out=out)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def finished(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    try:
        out, error = process.communicate(timeout=PATIENCE)
    finally:
        process.kill()
    return process.returncode, out or "", error or ""


def train(*arguments: object, cwd: pathlib.Path) -> tuple[int, str, str]:
    """Exit status, stdout and stderr."""
    return finished(start("train", *arguments, cwd=cwd))


def wait_for(process: subprocess.Popen[str], text: str) -> str:
    """What the process prints until a line has the text."""
    printed = ""
    assert process.stdout is not None
    for line in process.stdout:
        printed += line
        if text in line:
            return printed
    pytest.fail(f"{text!r} never came: {printed}{process.communicate()[1]}")


def refused(*arguments: object, cwd: pathlib.Path) -> str:
    """The one line with which a command line is refused, with exit status 2 and nothing else said."""
    status, out, error = train(*arguments, cwd=cwd)
    assert (status, out, error.count("\n")) == (2, "", 1), out + error
    assert error.startswith("bipedtrack: ") and "Traceback" not in error
    return error


class Runs(NamedTuple):
    whole: pathlib.Path  # a run that nobody disturbed
    whole_out: str
    broken: pathlib.Path  # the same run, killed in its second call, then stopped there, then resumed to its end
    second_process: tuple[int, str, str]  # what a second process in the directory said meanwhile
    checkpoints_when_killed: list[str]
    stopped: tuple[int, str, str]
    checkpoints_when_stopped: list[str]
    resumed: tuple[int, str, str]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Runs:
    folder = tmp_path_factory.mktemp("runs")
    # a curriculum from a file, not by its name
    smoke = (ROOT / "curricula" / "smoke.toml").read_text()
    # 9 updates of 32 steps in the last call, for which brax makes two epochs of 5
    tiny = smoke.replace('"hold", steps = 192', '"hold", steps = 270')
    # and less noise than the network's 0.7 from the first lesson on
    (folder / "tiny.toml").write_text(
        tiny.replace('"half difficulty", steps = 192', '"half difficulty", noise = 0.6, steps = 192')
    )
    begin, again = ("--curriculum", "tiny.toml", "--seed", 3), ("--resume", "--out", "broken", "--device", "cpu")
    with (
        open(folder / "whole.out", "w+") as output,
        running(*begin, "--out", "whole", "--device", "cpu", cwd=folder, out=output) as whole,
    ):
        disturbed = broken_run(folder / "broken", begin, again)
        whole.wait(PATIENCE)
        output.seek(0)
        said = output.read()
    assert whole.returncode == 0, said
    return Runs(folder / "whole", said, folder / "broken", *disturbed)


def broken_run(broken: pathlib.Path, begin: tuple[object, ...], again: tuple[object, ...]) -> tuple[Any, ...]:
    """The latter fields of Runs."""
    folder, checkpoints = broken.parent, broken / "checkpoints"
    with running(*begin, "--out", "broken", "--device", "cpu", cwd=folder) as first:
        until = time.monotonic() + PATIENCE
        while not (checkpoints / "0000.npz").exists():
            assert first.poll() is None and time.monotonic() < until
            time.sleep(0.05)
        second_process = train(*again, cwd=folder)
        first.send_signal(signal.SIGKILL)
        first.wait()
    when_killed = sorted(path.name for path in checkpoints.glob("*.npz"))

    with running(*again, cwd=folder) as resumed:
        printed = wait_for(resumed, "(call 2 of 3)")
        resumed.send_signal(signal.SIGINT)
        status, out, error = finished(resumed)
    when_stopped = sorted(path.name for path in checkpoints.glob("*.npz"))
    return second_process, when_killed, (status, printed + out, error), when_stopped, train(*again, cwd=folder)


# A training


@pytest.mark.slow
def test_smoke_runs_every_stage_checkpoint_and_export(runs: Runs) -> None:
    for call, stage in enumerate(("level ground, half difficulty", "stairs, low risers", "static balance, hold"), start=1):
        assert f"{stage} (call {call} of 3)" in runs.whole_out
    names = sorted(path.name for path in (runs.whole / "checkpoints").iterdir())
    assert names == ["0000.npz", "0001.npz", "0002.npz"]
    trained = policy.load(runs.whole / "policy.npz")
    assert (trained.provenance["curriculum"], trained.provenance["seed"], trained.provenance["steps"]) == ("smoke", 3, 704)
    assert runs.whole_out.splitlines()[-1] == "policy: whole/policy.npz"


@pytest.mark.slow
def test_every_call_learns(runs: Runs) -> None:
    arrays = [checkpoint.load_arrays(runs.whole / "checkpoints" / f"{i:04d}.npz", "checkpoint")[0] for i in range(3)]
    for before, after in zip(arrays, arrays[1:], strict=False):
        assert before.keys() == after.keys()
        for name in ("1/params/MLP_0/hidden_0/kernel", "2/params/hidden_0/kernel", "0/mean"):
            assert not np.array_equal(before[name], after[name])
    assert [int(a["0/count/lo"]) for a in arrays] == [192, 384, 704]
    assert all(np.isfinite(array).all() for array in arrays[-1].values())


@pytest.mark.slow
def test_the_run_directory_says_what_was_trained_and_how_it_went(runs: Runs) -> None:
    settings = json.loads((runs.whole / "run.json").read_text())
    assert settings["seed"] == 3 and settings["curriculum"]["name"] == "smoke"
    assert settings["curriculum"]["ppo"]["discount"] == 0.98 and settings["versions"]["brax"] == "0.14.2"
    rows = [json.loads(line) for line in (runs.whole / "progress.jsonl").read_text().splitlines()]
    assert [row["call"] for row in rows] == [0, 1, 2, 2]
    assert [row["steps"] for row in rows] == [192, 384, 544, 704]
    for row in rows:
        assert 0.02 <= row["episode_seconds"] <= 0.4 + 1e-6 and 0 <= row["falls"] <= 1 and row["nonfinite"] == 0
        assert (
            0 < row["live"] <= 1
            and row["reward_per_step"] > 0
            and row["policy_dist_mean_std"] == pytest.approx(0.6, abs=0.05)
        )
    assert list((runs.whole / "tensorboard").glob("events.out.tfevents.*"))


@pytest.mark.slow
def test_export_writes_the_policy_of_the_last_checkpoint(runs: Runs, tmp_path: pathlib.Path) -> None:
    status, out, error = finished(start("export", runs.whole, "--out", "exported.npz", cwd=tmp_path))
    assert (status, error) == (0, "") and out.splitlines()[-1] == "exported.npz"
    assert (tmp_path / "exported.npz").read_bytes() == (runs.whole / "policy.npz").read_bytes()


# A training that is disturbed


@pytest.mark.slow
def test_a_second_process_in_the_directory_is_refused(runs: Runs) -> None:
    status, out, error = runs.second_process
    assert (status, out, error.count("\n")) == (2, "", 1)
    assert "broken: is in use by process" in error


@pytest.mark.slow
def test_sigint_during_a_call_leaves_with_130_and_says_how_to_go_on(runs: Runs) -> None:
    status, out, error = runs.stopped
    assert status == 130 and "Traceback" not in out + error
    assert "1 calls are done" in out
    assert "stopped; 1 of 3 calls are saved. Go on with:" in out
    assert out.splitlines()[-1].strip() == "python -m bipedtrack.train --resume --out broken"
    assert runs.checkpoints_when_killed == runs.checkpoints_when_stopped == ["0000.npz"]


@pytest.mark.slow
def test_a_killed_and_resumed_run_ends_in_bitwise_the_same_parameters(runs: Runs) -> None:
    status, out, error = runs.resumed
    assert status == 0 and not error, out + error
    for name in ("0000.npz", "0001.npz", "0002.npz"):
        whole, broken = (
            checkpoint.load_arrays(run / "checkpoints" / name, "checkpoint")[0] for run in (runs.whole, runs.broken)
        )
        assert {k: v.tobytes() for k, v in whole.items()} == {k: v.tobytes() for k, v in broken.items()}
    assert (runs.whole / "policy.npz").read_bytes() == (runs.broken / "policy.npz").read_bytes()


# A training that begins with another one's network


@pytest.mark.slow
def test_a_run_that_starts_from_another_begins_with_its_parameters_and_says_so(runs: Runs) -> None:
    folder, first = runs.whole.parent, runs.whole / "checkpoints" / "0002.npz"
    one = "[[stages]]".join((folder / "tiny.toml").read_text().split("[[stages]]")[:2])
    assert "evaluation_episodes = 0" in one
    (folder / "one.toml").write_text(one.replace("evaluation_episodes = 0", "evaluation_episodes = 1"))
    with running("--curriculum", "one.toml", "--out", "tuned", "--device", "cpu", "--start", first, cwd=folder) as tuned:
        printed = wait_for(tuned, "(call 1 of 1)")
        tuned.send_signal(signal.SIGINT)
        status, out, error = finished(tuned)
    assert status == 130 and "begins with" in printed and "stopped; 0 of 1 calls are saved" in out, printed + out + error
    began, source = RunDirectory(folder / "tuned").latest(), checkpoint.load_checkpoint(first)
    assert began.call == -1 and began.arrays.keys() == source.arrays.keys()
    assert all(np.array_equal(began.arrays[name], source.arrays[name]) for name in source.arrays)

    settings = json.loads((folder / "tuned" / "run.json").read_text())
    settings["versions"]["jax"] = "0.9.1"
    (folder / "tuned" / "run.json").write_text(json.dumps(settings))
    status, out, error = train("--resume", "--out", "tuned", "--device", "cpu", cwd=folder)
    assert (status, error) == (0, ""), out + error
    assert "warning: the run began with jax 0.9.1, and goes on with 0.9.2\n" in out
    table = json.loads((folder / "tuned" / "table.json").read_text())
    for name in ("IK alone", "trained"):
        assert [row["kind"] for row in table[name]] == ["stand", "squat", "walk", "sidle", "turn"]
        assert f"level ground, {name}: " in out and all(0 < row["seconds"] <= 0.4 + 1e-6 for row in table[name])
    trained = policy.load(folder / "tuned" / "policy.npz")
    assert trained.provenance["origin"]["steps"] == 704 and trained.provenance["origin"]["seed"] == 3
    newest = RunDirectory(folder / "tuned").latest()
    assert int(newest.arrays["0/count/lo"]) == 704 + 192  # the normaliser has seen both runs


@pytest.mark.slow
def test_what_cannot_be_started_from_is_refused_and_leaves_nothing_behind(runs: Runs, tmp_path: pathlib.Path) -> None:
    smoke = (ROOT / "curricula" / "smoke.toml").read_text()
    (tmp_path / "wider.toml").write_text(smoke.replace("critic = [16]", "critic = [17]"))
    (tmp_path / "mirrored.toml").write_text(smoke.replace("[network]", "[network]\nsymmetric = true"))
    (tmp_path / "relu.toml").write_text(smoke.replace('"swish"', '"relu"'))
    first, policy_file = runs.whole / "checkpoints" / "0002.npz", runs.whole / "policy.npz"
    for arguments, wanted in {
        ("--start", "missing.npz"): "missing.npz: cannot be read",
        ("--start", policy_file): "is a policy file; wanted a checkpoint file",
        ("--start", tmp_path): "has no checkpoint; wanted one",
        ("--start", first, "--curriculum", "wider.toml"): "does not fit the curriculum's networks: 2/params/hidden_0/bias",
        ("--start", first, "--curriculum", "mirrored.toml"): "was trained with symmetric = false; the curriculum has true",
        ("--start", first, "--curriculum", "relu.toml"): 'was trained with activation = "swish"; the curriculum has "relu"',
        ("--start", first, "--resume"): "leave out --start",
    }.items():
        assert wanted in refused("--curriculum", "smoke", "--out", "run", "--device", "cpu", *arguments, cwd=tmp_path)
        assert not (tmp_path / "run").exists()


# Refusals


@pytest.mark.slow
def test_an_existing_run_is_not_overwritten(runs: Runs) -> None:
    line = refused("--curriculum", "smoke", "--out", runs.whole, cwd=runs.whole.parent)
    assert "already holds a run; go on with --resume" in line
    assert policy.load(runs.whole / "policy.npz").provenance["seed"] == 3


def test_a_missing_gpu_is_refused_and_leaves_nothing_behind(tmp_path: pathlib.Path) -> None:
    line = refused("--curriculum", "smoke", "--out", "run", "--device", "gpu", cwd=tmp_path)
    assert "--device gpu" in line and "--device cpu" in line and ".[cuda]" in line
    assert not list(tmp_path.iterdir())


REFUSALS = {  # the arguments and a part of the line
    ("--curriculum", "smok"): "no curriculum named 'smok' in curricula/; there are: ",
    ("--curriculum", "smok.toml"): "smok.toml: cannot be read",
    ("--curriculum", "robot.toml"): "no robot named 'ranger_mx' in models/; there are: ranger_max",
    ("--curriculum", "period.toml"): "policy_period 0.012 s is no multiple of 0.005 s",
    ("--curriculum", "slow.toml"): "policy_period 0.1 s is too long; wanted at most 0.08 s",
    ("--curriculum", "script.toml"): "stage 'level ground': nowhere.csv: cannot be read",
    ("--curriculum", "smoke", "--seed", "-1"): "--seed -1: must lie in [0, 2^63)",
    ("--curriculum", "smoke", "--seed", "9223372036854775808"): "--seed 9223372036854775808: must lie in [0, 2^63)",
    ("--curriculum", "smoke", "--out", "robot.toml"): "robot.toml: cannot be created",
    ("--resume",): "holds no run to resume (no run.json); start one without --resume",
    ("--resume", "--out", "damaged"): "run.json: is damaged",
}


@pytest.mark.parametrize(("arguments", "wanted"), REFUSALS.items())
def test_what_cannot_be_trained_is_refused_in_one_line(
    tmp_path: pathlib.Path, arguments: tuple[str, ...], wanted: str
) -> None:
    smoke = (ROOT / "curricula" / "smoke.toml").read_text()
    (tmp_path / "robot.toml").write_text(smoke.replace('"ranger_max"', '"ranger_mx"'))
    (tmp_path / "period.toml").write_text(smoke.replace("policy_period = 0.02 ", "policy_period = 0.012 "))
    (tmp_path / "slow.toml").write_text(smoke.replace("policy_period = 0.02 ", "policy_period = 0.1 "))
    scripts = 'scripts = ["nowhere.csv"]\nscript_share = 0.5\nlessons'
    (tmp_path / "script.toml").write_text(smoke.replace("lessons", scripts, 1))
    (tmp_path / "damaged").mkdir()
    (tmp_path / "damaged" / "run.json").write_text('{"seed": 1}')
    out = () if "--out" in arguments else ("--out", "run")
    assert wanted in refused(*arguments, *out, "--device", "cpu", cwd=tmp_path)
    assert not (tmp_path / "run" / "run.json").exists()
