"""Array files are what was written or refused."""

import hashlib
import io
import json
import os
import random
import tracemalloc
import zipfile

import numpy as np
import pytest
from array_files import run_python, same
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from bipedtrack.checkpoint import (
    CheckpointError,
    RunError,
    append_jsonl,
    load_arrays,
    require_writable,
    save_arrays,
    write_json,
    write_text,
)

ARRAYS = {"actor/0/kernel": np.arange(12, dtype=np.float32).reshape(3, 4), "count": np.array(7, np.int64)}
META = {"robot": "biped", "joints": ["hip", "knee"]}


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


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no device that is always full")
def test_a_disk_without_any_space(tmp_path):
    (tmp_path / "progress.jsonl").symlink_to("/dev/full")
    with pytest.raises(RunError, match="progress.jsonl: cannot be written: No space left on device"):
        append_jsonl(tmp_path / "progress.jsonl", {})


def test_a_device_or_a_pipe_is_no_file_to_write(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for place in (tmp_path / "pipe", "/dev/null"):
        with pytest.raises(RunError, match="cannot be written: it is a device or a pipe; wanted the name of a file"):
            write_text(place, "text")
        with pytest.raises(RunError, match="it is a device or a pipe"):
            require_writable(place)
    assert (tmp_path / "pipe").is_fifo() and not os.path.isfile("/dev/null")


def test_a_link_stays_one_and_leads_to_the_new_text(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "link").symlink_to("folder/file")
    for text in ("new", "newer"):
        write_text(tmp_path / "link", text)
        assert (tmp_path / "link").is_symlink() and (tmp_path / "folder" / "file").read_text() == text


@pytest.mark.parametrize("name", [".", "folder", "folder/"])
def test_a_folder_is_no_file_to_write(tmp_path, monkeypatch, name):
    (tmp_path / "folder").mkdir()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RunError, match="cannot be written: it is a folder; wanted the name of a file"):
        write_text(name, "text")
    assert [path.name for path in tmp_path.rglob("*")] == ["folder"]
