"""Two processes on 127.0.0.1 that train one policy, lose one of them, and go on; and what is refused."""

import hashlib
import os
import pathlib
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from ports import free_port

import bipedtrack
from bipedtrack import checkpoint, distributed, train
from bipedtrack.distributed import ALONE, DistributedError, Process

ROOT = pathlib.Path(bipedtrack.__file__).parents[1]
ENVIRONMENT = os.environ | {"PYTHONPATH": str(ROOT), "XLA_FLAGS": "--xla_backend_optimization_level=0", "COLUMNS": "200"}
PATIENCE = 600  # s that anything may take on a busy machine


def start(folder: pathlib.Path, index: int, port: int, *arguments: str) -> subprocess.Popen[str]:
    """A process of two, in a folder of its own."""
    (folder / str(index)).mkdir(exist_ok=True)
    command = [sys.executable, "-m", "bipedtrack.train", "--out", "run", "--device", "cpu", *arguments]
    command += ["--coordinator", f"127.0.0.1:{port}", "--processes", "2", "--process", str(index)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, text=True, env=ENVIRONMENT, cwd=folder / str(index), **pipes)  # type: ignore[call-overload,no-any-return]


def test_two_processes_agree_to_the_bit_and_go_on_after_one_was_lost(tmp_path: pathlib.Path) -> None:
    smoke = (ROOT / "curricula" / "smoke.toml").read_text()
    stages = smoke.split("[[stages]]")
    one = "[[stages]]".join(stages[:2]).replace("steps = 192,", "steps = 384, parts = 2,")
    (tmp_path / "tiny.toml").write_text(one)

    first, second = (start(tmp_path, i, port, "--curriculum", "../tiny.toml") for port in [free_port()] for i in (0, 1))
    until = time.monotonic() + PATIENCE
    saved = tmp_path / "0" / "run" / "checkpoints" / "0000.npz"
    while not saved.exists():
        assert first.poll() is None and second.poll() is None and time.monotonic() < until
        time.sleep(0.1)
    second.send_signal(signal.SIGKILL)
    _, error = first.communicate(timeout=PATIENCE)
    assert first.returncode != 0
    assert "another task died" in error or "cannot go on without the others" in error
    said = [second.communicate()[0]]

    both = [start(tmp_path, i, port, "--resume") for port in [free_port()] for i in (0, 1)]
    for process in both:
        out, error = process.communicate(timeout=PATIENCE)
        assert process.returncode == 0, out + error
        said.append(out)
    assert "1 calls are done" in said[1] and "call 1:" not in said[1]
    for call, text in ((0, said[0]), (1, said[2])):  # what the second process had, against what the first one wrote
        arrays, _ = checkpoint.load_arrays(tmp_path / "0" / "run" / "checkpoints" / f"{call:04d}.npz", "checkpoint")
        parts = (name.encode() + b"\0" + arrays[name].tobytes() for name in sorted(arrays))
        assert f"process 1 of 2, call {call + 1}: parameters {hashlib.sha256(b''.join(parts)).hexdigest()}" in text
    assert (tmp_path / "0" / "run" / "policy.npz").exists() and not any((tmp_path / "1").iterdir())


def test_when_the_first_process_refuses_so_do_the_others(tmp_path: pathlib.Path) -> None:
    both = [start(tmp_path, i, port, "--curriculum", "nowhere") for port in [free_port()] for i in (0, 1)]
    (_, first), (_, second) = (process.communicate(timeout=PATIENCE) for process in both)
    assert [process.returncode for process in both] == [2, 2]
    assert "no curriculum named 'nowhere'" in first and "process 1 of 2: the first process refused" in second
    assert first.count("\n") == second.count("\n") == 1


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity") or train.cores() < 2, reason="one core is always one device")
def test_processes_with_different_numbers_of_devices_are_refused(tmp_path: pathlib.Path) -> None:
    smoke = (ROOT / "curricula" / "smoke.toml").read_text()
    (tmp_path / "wide.toml").write_text(smoke.replace("num_envs = 8", "num_envs = 800"))
    first, second = (start(tmp_path, i, port, "--curriculum", "../wide.toml") for port in [free_port()] for i in (0, 1))
    os.sched_setaffinity(second.pid, {min(os.sched_getaffinity(0))})  # long before it has imported what looks at them
    _, error = second.communicate(timeout=PATIENCE)
    first.kill()
    first.communicate()
    assert second.returncode == 2, error
    assert error == "bipedtrack: process 1 of 2: has 1 devices, the first one 2; wanted --devices 1\n"


@pytest.mark.parametrize(
    ("coordinator", "processes", "process", "detect", "words"),
    [
        ("", 2, 0, False, "need --coordinator HOST:PORT"),
        ("127.0.0.1", 2, 0, False, "--coordinator 127.0.0.1: wanted HOST:PORT"),
        ("127.0.0.1:0", 2, 0, False, "wanted HOST:PORT"),
        ("127.0.0.1:1234", 1, 0, False, "--processes 1: wanted the number of processes"),
        ("127.0.0.1:1234", 2, 2, False, "--process 2: wanted 0 to 1"),
        ("127.0.0.1:1234", 2, 0, True, "not both"),
        ("", 4, 1, True, "--processes and --process need --coordinator HOST:PORT"),
    ],
)
def test_what_cannot_be_is_refused(coordinator: str, processes: int, process: int, detect: bool, words: str) -> None:
    with pytest.raises(DistributedError, match=words):
        distributed.join(coordinator, processes, process, detect)


def test_without_a_job_it_says_what_it_looked_for(tmp_path: pathlib.Path) -> None:
    command = [sys.executable, "-m", "bipedtrack.train", "--distributed"]
    done = subprocess.run(command, capture_output=True, text=True, env=ENVIRONMENT, cwd=tmp_path, check=False)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "SLURM, Kubernetes and Open MPI" in done.stderr
    assert not any(tmp_path.iterdir())


def test_a_process_alone_needs_nobody() -> None:
    assert distributed.join("", 1, 0, False) == ALONE and ALONE.first and not Process(1, 2).first
    assert distributed.from_first("anything", lambda: {"a": 1}, ALONE) == {"a": 1}
    arrays = {"b": np.arange(3.0), "a": np.float32(1)}
    assert distributed.share_arrays(arrays, ALONE) is arrays


def test_a_digest_knows_every_bit_and_every_name() -> None:
    arrays = {"a": np.zeros(2), "b": np.ones(2)}
    assert distributed.digest(arrays) == distributed.digest(dict(reversed(arrays.items())))
    others = [{"a": np.zeros(2), "b": np.array([1, np.nextafter(1, 2)])}, {"a": np.zeros(2), "c": np.ones(2)}]
    assert len({distributed.digest(each) for each in (arrays, *others)}) == 3
