"""Array files are what was written or refused; a run directory survives kills and a full disk."""

import errno
import hashlib
import io
import json
import os
import pathlib
import random
import re
import signal
import subprocess
import sys
import time
import tracemalloc
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import bipedtrack.checkpoint as checkpoint
from bipedtrack.checkpoint import (
    CheckpointError,
    RunDirectory,
    RunError,
    append_jsonl,
    load_arrays,
    save_arrays,
    write_json,
)

ARRAYS = {"actor/0/kernel": np.arange(12, dtype=np.float32).reshape(3, 4), "count": np.array(7, np.int64)}
META = {"robot": "biped", "joints": ["hip", "knee"]}
ROOT = pathlib.Path(checkpoint.__file__).parents[1]


def same(left, right):
    """Equal names in equal order, shapes, dtypes and bytes: NaN equals NaN, -0 differs from 0."""
    assert list(left) == list(right)
    for name in left:
        assert (left[name].shape, left[name].dtype) == (right[name].shape, right[name].dtype)
        assert left[name].tobytes() == right[name].tobytes()
    return True


def refused(path, pattern=None, kind="policy"):
    """The one line with which loading `path` is refused; any other exception fails the test."""
    with pytest.raises(CheckpointError, match=pattern) as info:
        load_arrays(path, kind)
    line = str(info.value)
    assert line.startswith(f"{path}: ") and len(line.splitlines()) == 1
    return line


def sealed(body):
    """A zip without comment, given the checksum that the format wants."""
    body = body[:-2] + b"\x40\x00"
    return body + hashlib.sha256(body).hexdigest().encode()


def forged(path, members, manifest=None, **options):
    """A file with a right checksum, whatever its members (name -> bytes of the .npy)."""
    default = {"format": "bipedtrack", "version": 1, "kind": "policy", "arrays": [], "meta": {}}
    encoded = np.frombuffer(json.dumps(default | (manifest or {})).encode(), np.uint8)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", **options) as archive:
        for name, data in [("__manifest__", npy(encoded)), *members]:
            archive.writestr(f"{name}.npy", data)
    path.write_bytes(sealed(buffer.getvalue()))
    return path


def npy(array, version=(1, 0), **options):
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, array, version, **options)
    return buffer.getvalue()


def entry(name, array, **changes):
    digest = hashlib.sha256(array.tobytes()).hexdigest()
    return {"name": name, "shape": list(array.shape), "dtype": array.dtype.str, "sha256": digest} | changes


@pytest.fixture
def policy(tmp_path):
    save_arrays(tmp_path / "policy.npz", ARRAYS, META, "policy")
    return tmp_path / "policy.npz"


def run_python(code, *arguments, **options):
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        **options,
    )


# Array files

names = st.from_regex(r"[A-Za-z0-9_.\-/]{1,20}", fullmatch=True).filter(lambda name: name != "__manifest__")
dtypes = st.one_of(
    hnp.boolean_dtypes(),
    hnp.integer_dtypes(),
    hnp.unsigned_integer_dtypes(),
    hnp.floating_dtypes(),
    hnp.complex_number_dtypes(),
)
shapes = hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4)
json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=5,
)


@settings(max_examples=60)
@given(
    arrays=st.dictionaries(names, hnp.arrays(dtypes, shapes), max_size=4),
    meta=st.dictionaries(st.text(), json_values, max_size=3),
)
def test_arrays_and_meta_come_back_as_they_were(tmp_path_factory, arrays, meta):
    path = tmp_path_factory.mktemp("round") / "a.npz"
    save_arrays(path, arrays, meta, "policy")
    loaded, loaded_meta = load_arrays(path, "policy")
    assert same(loaded, arrays) and loaded_meta == meta
    assert all(array.flags.writeable for array in loaded.values())
    assert [file.name for file in path.parent.iterdir()] == ["a.npz"]


def test_numpy_alone_reads_the_arrays_and_equal_content_gives_equal_bytes(policy, tmp_path):
    with np.load(policy, allow_pickle=False) as archive:
        assert same({name: archive[name] for name in ARRAYS}, ARRAYS)
    save_arrays(tmp_path / "again.npz", ARRAYS, META, "policy")
    assert (tmp_path / "again.npz").read_bytes() == policy.read_bytes()


def test_values_that_are_not_contiguous_or_not_numpy(tmp_path):
    matrix = np.arange(6.0).reshape(2, 3)
    save_arrays(tmp_path / "a.npz", {"t": matrix.T, "s": matrix[:, ::2], "n": 2.5}, {"x": np.float32(0.5)}, "policy")
    arrays, meta = load_arrays(tmp_path / "a.npz", "policy")
    np.testing.assert_array_equal(arrays["t"], [[0, 3], [1, 4], [2, 5]])
    np.testing.assert_array_equal(arrays["s"], [[0, 2], [3, 5]])
    assert arrays["n"].shape == () and arrays["n"] == 2.5 and meta == {"x": 0.5}


@pytest.mark.parametrize(
    "arrays",
    [{"a": np.array([None])}, {"a": np.array(["x"])}, {"a b": np.zeros(1)}, {"": np.zeros(1)}]
    + [
        {"__manifest__": np.zeros(1)},
        {"a\n": np.zeros(1)},
        {"é": np.zeros(1)},
        {"a": np.zeros(1, [("x", "f4")])},
    ],
)
def test_what_could_not_be_loaded_is_not_saved(tmp_path, arrays):
    with pytest.raises(ValueError, match="wanted"):
        save_arrays(tmp_path / "a.npz", arrays, {}, "policy")
    assert not list(tmp_path.iterdir())


def test_a_file_cut_off_anywhere_is_refused(policy, tmp_path):
    content = policy.read_bytes()
    cut = tmp_path / "cut.npz"
    for length in [*range(0, len(content), 5), *range(len(content) - 90, len(content))]:
        cut.write_bytes(content[:length])
        refused(cut)
    cut.write_bytes(content + b"\0")
    refused(cut)


def test_a_flipped_bit_anywhere_is_refused(policy, tmp_path):
    content = policy.read_bytes()
    flipped = tmp_path / "flipped.npz"
    for bit in random.Random(1).sample(range(8 * len(content)), 800):
        damaged = bytearray(content)
        damaged[bit // 8] ^= 1 << bit % 8
        flipped.write_bytes(damaged)
        refused(flipped)


def test_behind_a_right_checksum_a_flipped_bit_never_gives_another_value(policy, tmp_path):
    """The inner checks stand on their own: a flip is refused, or hits what the zip does not need (a date)."""
    body = policy.read_bytes()[:-64]
    flipped = tmp_path / "flipped.npz"
    outcomes = []
    for bit in random.Random(2).sample(range(8 * (len(body) - 2)), 1500):
        damaged = bytearray(body)
        damaged[bit // 8] ^= 1 << bit % 8
        flipped.write_bytes(bytes(damaged) + hashlib.sha256(damaged).hexdigest().encode())
        try:
            arrays, meta = load_arrays(flipped, "policy")
        except CheckpointError as error:
            assert str(error).startswith(str(flipped)) and len(str(error).splitlines()) == 1
            outcomes.append(False)
        else:
            assert same(arrays, ARRAYS) and meta == META
            outcomes.append(True)
    assert 0.5 < outcomes.count(False) / len(outcomes) < 1


def test_foreign_files_are_refused(tmp_path):
    path = tmp_path / "a.npz"
    for content in (
        b"",
        b"x",
        b"\0" * 1000,
        b"a" * 64,
        hashlib.sha256(b"").hexdigest().encode(),
        sealed(b"a" * 500),
    ):
        path.write_bytes(content)
        refused(path)
    np.savez(path, **ARRAYS)
    refused(path, "not written by bipedtrack .*; wanted an intact policy file")
    path.write_bytes(sealed(path.read_bytes()))
    refused(path, "is no policy file written by bipedtrack .*__manifest__")
    refused(tmp_path, "cannot be read .*; wanted a policy file")
    refused(tmp_path / "none.npz", "No such file or directory.*; wanted a policy file")


def test_another_kind_version_or_program_is_refused(policy, tmp_path):
    refused(policy, "is a policy file; wanted a checkpoint file", kind="checkpoint")
    path = tmp_path / "a.npz"
    assert load_arrays(forged(path, []), "policy") == ({}, {})
    refused(forged(path, [], {"version": 2}), "has format version 2, this bipedtrack reads 1")
    refused(forged(path, [], {"format": "else"}), "is not a bipedtrack file")
    refused(forged(path, [], {"kind": "a\nb"}), "is a a b file; wanted a policy file")
    for wrong in ({"meta": 3}, {"arrays": 3}, {"arrays": [3]}, {"arrays": [{}]}, {"arrays": None}):
        refused(forged(path, [], wrong))


X = np.arange(3, dtype=np.float32)
SQUARE = np.arange(4, dtype=np.float32).reshape(2, 2)


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize(
    ("arrays", "members", "expected"),
    [
        ([entry("x", X)], [], "has the entries .* its manifest wants"),
        ([], [("x", npy(X))], "has the entries .* its manifest wants"),
        ([entry("x", X)], [("y", npy(X))], "has the entries .* its manifest wants"),
        ([entry("x", X), entry("x", X)], [("x", npy(X))], "has the entries .* its manifest wants"),
        (
            [entry("x", X, shape=[3, 1])],
            [("x", npy(X))],
            r"array x has shape \[3\]; its manifest wants \[3, 1\]",
        ),
        ([entry("x", X, dtype="<i4")], [("x", npy(X))], "array x has dtype <f4; its manifest wants <i4"),
        ([entry("x", X)], [("x", npy(X + 1))], "array x has sha256 .*; its manifest wants"),
        ([entry("x", X)] * 2, [("x", npy(X))] * 2, "has the entries .* its manifest wants"),
        ([entry("x", X)], [("x", npy(X)[:-1])], "array x has 11 bytes; its header wants 12"),
        ([entry("x", X)], [("x", npy(X) + b"\0")], "array x has 13 bytes; its header wants 12"),
        ([entry("x", X)], [("x", b"")], "is no policy file"),
        ([entry("x", X)], [("x", npy(X, (2, 0)))], "array x has another npy format; wanted 1.0"),
        ([entry("x", SQUARE)], [("x", npy(SQUARE.T))], "array x has dtype .*; wanted .* in C order"),
    ],
)
def test_a_file_that_disagrees_with_its_manifest_is_refused(tmp_path, arrays, members, expected):
    refused(forged(tmp_path / "a.npz", members, {"arrays": arrays}), expected)
    good = forged(tmp_path / "good.npz", [("x", npy(X))], {"arrays": [entry("x", X)]})
    assert same(load_arrays(good, "policy")[0], {"x": X})


def test_a_pickle_is_never_opened(tmp_path):
    class Trap:
        def __reduce__(self):
            return (open, (str(tmp_path / "sprung"), "w"))

    trap = np.array([Trap()], object)
    data = npy(trap, allow_pickle=True)
    arrays = [{"name": "x", "shape": [1], "dtype": "|O", "sha256": hashlib.sha256(data[128:]).hexdigest()}]
    refused(forged(tmp_path / "a.npz", [("x", data)], {"arrays": arrays}), "array x has dtype object")
    assert not (tmp_path / "sprung").exists()


def bomb_of_zeros(path):
    """100 kB that expand to 100 MB."""
    zeros = np.zeros(25_000_000, np.float32)
    return forged(path, [("x", npy(zeros))], {"arrays": [entry("x", zeros)]}, compression=zipfile.ZIP_DEFLATED)


def bomb_that_lies(path):
    """The same, declared as 12 bytes."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("__manifest__.npy", bytes(100_000_000))
        archive.filelist[0].file_size = 12
    path.write_bytes(sealed(buffer.getvalue()))
    return path


def bomb_of_a_header(path):
    """An array of 4 TB by its header, 12 bytes by what follows it."""
    shape = [10**12]
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f4", "fortran_order": False, "shape": tuple(shape)})
    data = header.getvalue() + bytes(12)
    return forged(path, [("x", data)], {"arrays": [entry("x", X, shape=shape)]})


def bomb_of_overlaps(path):
    """Thousands of names for the same megabyte."""
    data = npy(np.zeros(250_000, np.float32))
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("x.npy", data)
        archive.filelist *= 2000
    path.write_bytes(sealed(buffer.getvalue()))
    return path


@pytest.mark.parametrize("bomb", [bomb_of_zeros, bomb_that_lies, bomb_of_a_header, bomb_of_overlaps])
def test_a_bomb_is_refused_without_allocating(tmp_path, bomb):
    path = bomb(tmp_path / "bomb.npz")
    tracemalloc.start()
    refused(path, "expands to|its header wants")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 5e6


def test_policies_load_without_jax_and_without_fcntl(policy):
    code = """
import sys
sys.modules.update(dict.fromkeys(("jax", "brax", "flax", "mujoco", "fcntl")))  # importing them raises
from bipedtrack.checkpoint import load_arrays
print(sorted(load_arrays(sys.argv[1], "policy")[0]))
"""
    assert run_python(code, policy).communicate()[0] == f"{sorted(ARRAYS)}\n"


# Text files


def test_jsonl_drops_a_line_that_was_cut_off(tmp_path):
    path = tmp_path / "progress.jsonl"
    append_jsonl(path, {"a": 1})
    append_jsonl(path, {"b": np.float32(0.5), "c": np.arange(2), "d": float("nan"), "e": [np.float64("-inf")]})
    whole = path.read_text()
    assert whole == '{"a": 1}\n{"b": 0.5, "c": [0, 1], "d": null, "e": [null]}\n'
    last = '{"text": "line\\nbreak"}\n'
    append_jsonl(path, {"text": "line\nbreak"})
    assert path.read_text() == whole + last
    for length in range(len(last) + 1):
        path.write_text(whole + last[:length])
        append_jsonl(path, {"f": 2})
        kept = last if length == len(last) else ""
        assert path.read_text() == whole + kept + '{"f": 2}\n'
    path.write_text("never a whole line")
    append_jsonl(path, {"f": 2})
    assert path.read_text() == '{"f": 2}\n'


def test_json_is_strict_and_replaces_the_file(tmp_path):
    path = tmp_path / "a.json"
    write_json(path, {"a": np.float32(1.5), "b": (1, float("inf")), "c": "é"})
    assert json.loads(path.read_text(), parse_constant=pytest.fail) == {"a": 1.5, "b": [1, None], "c": "é"}
    write_json(path, [])
    assert json.loads(path.read_text()) == []
    with pytest.raises(TypeError):
        write_json(path, {"a": object()})
    assert [file.name for file in tmp_path.iterdir()] == ["a.json"] and json.loads(path.read_text()) == []


# The run directory


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
    with pytest.raises(RunError, match="holds checkpoints without their run.json"):
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
from bipedtrack.checkpoint import RunDirectory
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
from bipedtrack.checkpoint import RunDirectory, RunError, append_jsonl
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


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no device that is always full")
def test_a_disk_without_any_space(tmp_path):
    (tmp_path / "progress.jsonl").symlink_to("/dev/full")
    with pytest.raises(RunError, match="progress.jsonl: cannot be written: No space left on device"):
        append_jsonl(tmp_path / "progress.jsonl", {})


def test_a_run_killed_while_it_writes_always_resumes(tmp_path):
    """SIGKILL at any moment: what was said to be saved is there, whole, and nothing damaged lies about."""
    code = """
import sys
import numpy as np
from bipedtrack.checkpoint import RunDirectory
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
