"""A run directory survives kills and a full disk."""

import errno
import json
import os
import random
import re
import signal
import subprocess
import time

import numpy as np
import pytest
from array_files import run_python, same

from bipedtrack import checkpoint
from bipedtrack.checkpoint import CheckpointError, RunError
from bipedtrack.run_directory import RunDirectory


def numbers(index):
    return {"w": np.full(1000, index, np.float32)}


@pytest.fixture
def run(tmp_path):
    run = RunDirectory.create(tmp_path / "deep" / "run", {"seed": 3})
    yield run
    run.close()


def files(run):
    return sorted(str(file.relative_to(run.path)) for file in run.path.rglob("*") if file.is_file())


def test_the_newest_three_checkpoints_are_kept(run):
    assert run.latest() is None
    for index in range(6):
        assert run.save_checkpoint(index, numbers(index), {"steps": 10 * index}).is_file()
        newest, arrays, meta = run.latest()
        assert newest == index and same(arrays, numbers(index)) and meta == {"steps": 10 * index}
        kept = [f"checkpoints/{i:04d}.npz" for i in range(max(0, index - 2), index + 1)]
        assert files(run) == [*kept, "lock", "run.json"]
    assert run.warnings == []


def test_a_run_that_began_with_a_checkpoint_has_it_until_its_own_first_one(tmp_path):
    origin = {"provenance": {"steps": 5}}
    run = RunDirectory.create(tmp_path / "tuned", {}, checkpoint.Checkpoint(7, numbers(7), origin))
    found = run.latest()
    assert found.call == -1 and same(found.arrays, numbers(7)) and found.provenance == {"steps": 5}
    assert files(run) == ["lock", "run.json", "start.npz"]
    run.save_checkpoint(0, numbers(0), {})
    assert run.latest().call == 0 and run.latest().provenance == {}
    run.close()
    (run.path / "checkpoints" / "0000.npz").unlink()
    damaged = run.path / "start.npz"
    damaged.write_bytes(damaged.read_bytes()[:-1])
    with pytest.raises(CheckpointError, match="start.npz: is cut off"):  # never silently from nothing
        run.latest()


def test_a_run_from_nothing_does_not_begin_with_what_another_one_left(tmp_path):
    class Unwritable:
        pass

    with pytest.raises(TypeError):  # after start.npz, before run.json
        RunDirectory.create(tmp_path / "run", {"x": Unwritable()}, checkpoint.Checkpoint(7, numbers(7), {}))
    run = RunDirectory.create(tmp_path / "run", {})
    assert run.latest() is None and files(run) == ["lock", "run.json"]
    run.close()


def test_a_file_of_the_users_stays(tmp_path):
    (tmp_path / "start.npz").write_bytes(b"mine")
    with pytest.raises(RunError, match="holds start.npz without a run.json; use another directory"):
        RunDirectory.create(tmp_path, {})
    assert (tmp_path / "start.npz").read_bytes() == b"mine"


def test_checkpoints_are_ordered_as_numbers(run):
    for index in (9998, 9999, 10000, 10001):
        run.save_checkpoint(index, numbers(index), {})
    assert run.latest()[0] == 10001
    assert files(run)[:3] == ["checkpoints/10000.npz", "checkpoints/10001.npz", "checkpoints/9999.npz"]


def test_damaged_checkpoints_are_skipped_and_told(run):
    for index in range(3):
        run.save_checkpoint(index, numbers(index), {})
    damaged = run.path / "checkpoints" / "0002.npz"
    damaged.write_bytes(damaged.read_bytes()[:-1])
    index, arrays, _ = run.latest()
    assert index == 1 and same(arrays, numbers(1))
    assert len(run.warnings) == 1 and str(damaged) in run.warnings[0]

    (run.path / "checkpoints" / "0000.npz").rename(damaged)
    assert run.latest()[0] == 1
    assert run.warnings == [f"skipped {damaged}: is number 0, renamed; wanted 2"]

    (run.path / "checkpoints" / "0001.npz").write_bytes(b"")
    with pytest.raises(CheckpointError, match="no checkpoint is intact"):
        run.latest()


def test_saving_below_damaged_checkpoints_keeps_what_was_saved(run):
    for index in (7, 8, 9):
        (run.path / "checkpoints" / f"{index:04d}.npz").write_bytes(b"damaged")
    run.save_checkpoint(0, numbers(0), {})
    assert run.latest()[0] == 0 and len(run.warnings) == 3


def test_a_failing_write_leaves_the_old_checkpoints_unpruned(run, monkeypatch):
    for index in range(3):
        run.save_checkpoint(index, numbers(index), {})
    before = files(run)

    def fail(*_):
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    for call in ("fsync", "replace"):
        with monkeypatch.context() as patch:
            patch.setattr(checkpoint.os, call, fail)
            with pytest.raises(RunError, match="0003.npz: cannot be written: Input/output error"):
                run.save_checkpoint(3, numbers(3), {})
        assert files(run) == before


def test_a_run_is_neither_started_twice_nor_resumed_from_nothing(run, tmp_path):
    with pytest.raises(RunError, match="holds no run to resume .* without --resume") as info:
        RunDirectory.open(tmp_path / "none")
    assert not (tmp_path / "none").exists()
    (tmp_path / "empty").mkdir()
    with pytest.raises(RunError, match="holds no run to resume"):
        RunDirectory.open(tmp_path / "empty")
    assert not list((tmp_path / "empty").iterdir())

    run.save_checkpoint(4, numbers(4), {})
    run.close()
    with pytest.raises(RunError, match="already holds a run; go on with --resume") as info:
        RunDirectory.create(run.path, {"seed": 4})
    assert len(str(info.value).splitlines()) == 1
    resumed = RunDirectory.open(run.path)  # the refusal did not keep the lock
    assert resumed.settings == {"seed": 3} and resumed.latest()[0] == 4
    resumed.close()

    (run.path / "run.json").unlink()
    with pytest.raises(RunError, match="holds checkpoints without a run.json"):
        RunDirectory.create(run.path, {})


def test_a_path_that_cannot_be_a_run_is_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file", tmp_path / "file" / "run"):
        with pytest.raises(RunError, match="cannot be created"):
            RunDirectory.create(path, {})
        with pytest.raises(RunError, match="holds no run to resume"):
            RunDirectory.open(path)


def test_settings_that_are_damaged_are_one_line(run):
    for content in (b"{", b"\xff", b"[" * 100_000):
        (run.path / "run.json").write_bytes(content)
        with pytest.raises(RunError, match="run.json: is damaged"):
            _ = run.settings


def test_reading_takes_no_lock_and_cannot_write(run):
    run.save_checkpoint(0, numbers(0), {})
    reader = RunDirectory(run.path)
    assert reader.latest()[0] == 0 and reader.settings == {"seed": 3}
    with pytest.raises(RunError, match="is not locked"):
        reader.save_checkpoint(1, numbers(1), {})


def test_the_lock_lasts_until_its_holder_is_killed(tmp_path):
    code = """
import sys, time
from bipedtrack.run_directory import RunDirectory
RunDirectory.create(sys.argv[1], {})  # nothing refers to it, and it is held all the same
print("locked", flush=True)
time.sleep(60)
"""
    path = tmp_path / "run"
    holder = run_python(code, path)
    assert holder.stdout.readline() == "locked\n"
    expected = f"^{re.escape(str(path))}: is in use by process {holder.pid}; [^\n]*$"
    for enter in (RunDirectory.open, lambda path: RunDirectory.create(path, {})):
        for _ in range(2):  # a refusal neither takes nor breaks the lock
            with pytest.raises(RunError, match=expected):
                enter(path)
    holder.send_signal(signal.SIGKILL)
    holder.communicate()
    RunDirectory.open(path).close()


def test_the_lock_holds_within_one_process_too(run):
    with pytest.raises(RunError, match=f"in use by process {os.getpid()};"):
        RunDirectory.open(run.path)


def test_a_child_program_does_not_inherit_the_lock(run):
    child = subprocess.Popen(["sleep", "60"], close_fds=False)
    run.close()
    RunDirectory.open(run.path).close()
    child.kill()
    child.wait()


def test_a_full_disk_keeps_the_last_good_checkpoint(tmp_path):
    """A limit on the size of files stops a write in its middle, as a full disk does."""
    code = """
import resource, sys
import numpy as np
from bipedtrack.checkpoint import RunError, append_jsonl
from bipedtrack.run_directory import RunDirectory
run = RunDirectory.create(sys.argv[1], {})
run.save_checkpoint(0, {"w": np.zeros(1000)}, {})
for i in range(300): append_jsonl(run.path / "progress.jsonl", {"filling": "x" * 300})
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
def attempt(action):
    try: action()
    except RunError as error: print(error)
attempt(lambda: run.save_checkpoint(1, {"w": np.zeros(100_000)}, {}))
attempt(lambda: append_jsonl(run.path / "progress.jsonl", {"filling": "y" * 30_000}))
print((run.path / "progress.jsonl").read_bytes()[-4:])
append_jsonl(run.path / "progress.jsonl", {"last": 1})
"""
    path = tmp_path / "run"
    lines = run_python(code, path).communicate()[0].splitlines()
    assert len(lines) == 3
    assert lines[0] == f"{path}/checkpoints/0001.npz: cannot be written: File too large"
    assert lines[1] == f"{path}/progress.jsonl: cannot be written: no space for the whole line"
    assert lines[2] == repr(b'x"}\n')
    run = RunDirectory(path)
    assert files(run) == ["checkpoints/0000.npz", "lock", "progress.jsonl", "run.json"]
    assert run.latest()[0] == 0 and run.warnings == []
    progress = (path / "progress.jsonl").read_text().splitlines()
    assert [json.loads(line) for line in progress] == [{"filling": "x" * 300}] * 300 + [{"last": 1}]


def test_a_run_killed_while_it_writes_always_resumes(tmp_path):
    """SIGKILL at any moment: what was said to be saved is there, whole, and nothing damaged lies about."""
    code = """
import sys
import numpy as np
from bipedtrack.run_directory import RunDirectory
run = RunDirectory.open(sys.argv[1])
index = run.latest()[0]
print(index, len(run.warnings), flush=True)
while True:
    index += 1
    run.save_checkpoint(index, {"w": np.full(300_000, index, np.float32)}, {"index": index})
    print(index, flush=True)
"""
    path = tmp_path / "run"
    run = RunDirectory.create(path, {})
    run.save_checkpoint(0, {"w": np.zeros(300_000, np.float32)}, {"index": 0})
    run.close()
    draw = random.Random(3)
    saved, interrupted = 0, 0
    for attempt in range(12):
        process = run_python(code, path)
        resumed, warnings = map(int, process.stdout.readline().split())
        assert resumed >= saved and warnings == 0
        time.sleep(draw.uniform(0.0, 0.05))
        deadline = time.monotonic() + 2
        while attempt % 2 and time.monotonic() < deadline and not any(path.rglob("*.unfinished")):
            pass
        process.kill()
        said = process.communicate()[0].splitlines()
        saved = int(said[-1]) if said else resumed
        interrupted += any(path.rglob("*.unfinished"))

        run = RunDirectory.open(path)
        index, arrays, meta = run.latest()
        assert saved <= index <= saved + 1 and run.warnings == []
        assert meta == {"index": index} and same(arrays, {"w": np.full(300_000, index, np.float32)})
        assert not any(path.rglob("*.unfinished")) and len(files(run)) <= 2 + 4
        run.close()
    assert saved > 0 and interrupted > 0
