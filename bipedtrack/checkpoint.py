"""Verified array files, and other files that are written whole or not at all.

An array file (a checkpoint, a policy) is an uncompressed `.npz` that numpy can read, with two additions. Its
entry `__manifest__` is JSON: format, version, kind, a `meta` dict, and each array's name, shape, dtype and
sha256. Its last 64 bytes, the comment of the zip, are the sha256 of everything before them. So a file is read
only if it is byte for byte what was written. Nothing in it is executed, and nothing expands beyond its size.

Only numpy and the standard library: policies load through this module on machines without JAX.
"""

import contextlib
import errno
import hashlib
import io
import json
import math
import os
import re
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bipedtrack.messages import Refusal

FORMAT = "bipedtrack"
FORMAT_VERSION = 1
UNFINISHED = ".unfinished"  # suffix of files being written

_MANIFEST = "__manifest__"
_SEAL_BYTES = 64  # a sha256 in hexadecimal
_DTYPE_KINDS = "biufc"  # booleans and numbers: never objects, which would be pickle


class CheckpointError(Refusal, ValueError):
    """An array file that is damaged, foreign or of another kind; the message is one line."""


class RunError(Refusal, RuntimeError):
    """A run directory that cannot be used, or a file that cannot be written; the message is one line."""


# Array files


def save_arrays(path: str | Path, arrays: Mapping[str, Any], meta: dict[str, Any], kind: str) -> None:
    """Writes `arrays` and the JSON-able `meta` to `path`, atomically; equal content gives equal bytes.

    `kind` says what the file is ("policy"); `load_arrays` asks for it. Names are of ASCII letters, digits and
    `_ - . /`; dtypes are booleans and numbers. Raises ValueError for others, and RunError if the file cannot
    be written (a full disk): what stood at `path` is then untouched.
    """
    contents: dict[str, np.ndarray] = {}
    for name, value in arrays.items():
        array = contents[name] = np.asarray(value, order="C")
        if not re.fullmatch(r"[\w.\-/]+", name, re.ASCII) or name == _MANIFEST:
            raise ValueError(f"{name!r} cannot name an array; wanted ASCII letters, digits and _ - . /")
        if array.dtype.kind not in _DTYPE_KINDS:
            raise ValueError(f"array {name} has dtype {array.dtype}; wanted booleans or numbers")
    manifest = {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "kind": kind,
        "arrays": [{"name": name, **_fingerprint(array)} for name, array in contents.items()],
        "meta": meta,
    }
    encoded = np.frombuffer(json.dumps(manifest, default=_plain).encode(), np.uint8)
    write_bytes(path, _pack({_MANIFEST: encoded, **contents}))


def load_arrays(path: str | Path, kind: str) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays and the meta dict of a file of this `kind`, every byte verified.

    Raises CheckpointError for a file that is missing, cut off, changed, foreign, of another kind or version.
    """
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        reason = f"cannot be read ({error.strerror or error}); wanted a {kind} file"
        raise CheckpointError(f"{path}: {reason}") from error
    try:
        return _unpack(content, kind)
    except Exception as error:  # on foreign bytes the parsers of zip, npy and JSON raise nearly anything
        reason = f"is no {kind} file written by {FORMAT} ({type(error).__name__}: {error})"
        reason = str(error) if isinstance(error, CheckpointError) else reason
        raise CheckpointError(" ".join(f"{path}: {reason}".split())) from None


def _fingerprint(array: np.ndarray) -> dict[str, Any]:
    digest = hashlib.sha256(array.tobytes()).hexdigest()
    return {"shape": list(array.shape), "dtype": array.dtype.str, "sha256": digest}


def _pack(contents: dict[str, np.ndarray]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, array in contents.items():
            member = io.BytesIO()
            np.lib.format.write_array(member, array, version=(1, 0), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), member.getvalue())
    # A zip ends in the length of its comment (0) and the comment (none): make that the seal's.
    body = buffer.getvalue()[:-2] + _SEAL_BYTES.to_bytes(2, "little")
    return body + _seal(body)


def _seal(body: bytes) -> bytes:
    return hashlib.sha256(body).hexdigest().encode()


def _unpack(content: bytes, kind: str) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    if _seal(content[:-_SEAL_BYTES]) != content[-_SEAL_BYTES:]:
        raise CheckpointError(
            f"is cut off, changed or not written by {FORMAT} (wrong checksum); wanted an intact {kind} file"
        )
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = archive.infolist()
        # Entries that are stored as they are and fit into the file together cannot expand in memory.
        size = sum(member.file_size for member in members)
        if size > len(content) or any(member.compress_type != zipfile.ZIP_STORED for member in members):
            raise CheckpointError(f"has {len(content)} bytes but expands to {size}; wanted no compression")
        manifest = json.loads(_read_member(archive, _MANIFEST).tobytes())
        _check_manifest(manifest, kind)
        wanted = [f"{name}.npy" for name in (_MANIFEST, *(entry["name"] for entry in manifest["arrays"]))]
        found = [member.filename for member in members]
        if found != wanted or len(set(found)) != len(found):
            raise CheckpointError(f"has the entries {found}; its manifest wants {wanted}")
        arrays = {}
        for entry in manifest["arrays"]:
            name = entry.pop("name")
            arrays[name] = _read_member(archive, name)
            for key, value in _fingerprint(arrays[name]).items():
                if entry[key] != value:
                    raise CheckpointError(f"array {name} has {key} {value}; its manifest wants {entry[key]}")
        return arrays, manifest["meta"]


def _check_manifest(manifest: dict[str, Any], kind: str) -> None:
    if manifest["format"] != FORMAT or not isinstance(manifest["meta"], dict):
        raise CheckpointError(f"is not a {FORMAT} file; wanted a {kind} file")
    if manifest["version"] != FORMAT_VERSION:
        raise CheckpointError(
            f"has format version {manifest['version']}, this {FORMAT} reads {FORMAT_VERSION}; "
            f"wanted the {FORMAT} that wrote it"
        )
    if manifest["kind"] != kind:
        raise CheckpointError(f"is a {manifest['kind']} file; wanted a {kind} file")


def _read_member(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    """One array, its header checked against the bytes that are there before anything of its size is made."""
    with archive.open(f"{name}.npy") as member:
        if np.lib.format.read_magic(member) != (1, 0):
            raise CheckpointError(f"array {name} has another npy format; wanted 1.0")
        shape, fortran_order, dtype = np.lib.format.read_array_header_1_0(member)
        data = member.read()
    if dtype.kind not in _DTYPE_KINDS or fortran_order:
        raise CheckpointError(f"array {name} has dtype {dtype}; wanted booleans or numbers in C order")
    size = math.prod(shape) * dtype.itemsize
    if len(data) != size:
        raise CheckpointError(f"array {name} has {len(data)} bytes; its header wants {size}")
    return np.frombuffer(data, dtype).reshape(shape).copy()


# Other files


def write_json(path: str | Path, content: Any) -> None:
    """Writes `content` as JSON, atomically. Numbers that are not finite become null. Raises RunError."""
    write_bytes(path, (_strict_json(content, indent=2) + "\n").encode())


def write_text(path: str | Path, text: str) -> None:
    """Writes a text file in UTF-8, atomically. Raises RunError when it cannot be written."""
    write_bytes(path, text.encode())


def write_bytes(path: str | Path, content: bytes) -> None:
    """Puts `content` at `path`, whole or not at all, even if the power fails. Raises RunError when it cannot be written."""
    path = Path(os.path.realpath(path))  # a link stays one, and leads to the new content
    with os_errors(path, "written"):
        unfinished = _beside(path)
        try:
            with open(unfinished, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            os.replace(unfinished, path)
        except BaseException:
            unfinished.unlink(missing_ok=True)
            raise
        directory = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(directory)  # the new name, too, must be on the disk
        finally:
            os.close(directory)


def require_writable(path: str | Path) -> None:
    """Raises RunError as `write_bytes` does, before there is anything to write; changes nothing."""
    with os_errors(path, "written"):
        trial = _beside(Path(path))
        trial.touch()
        trial.unlink()


def _beside(path: Path) -> Path:
    """Where a file is written before it is moved to its place. Raises OSError where that is a folder, a device or a pipe."""
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, "it is a folder; wanted the name of a file")
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "it is a device or a pipe; wanted the name of a file")
    return path.absolute().with_name(f"{path.name}.{os.getpid()}{UNFINISHED}")


def append_jsonl(path: str | Path, record: Any) -> None:
    """Appends `record` as one line of JSON in one write; a last line that was cut off is dropped first.

    Numbers that are not finite become null. Raises RunError if it cannot be written; then no part of it is.
    """
    line = (_strict_json(record) + "\n").encode()
    with os_errors(path, "written"), open(path, "a+b", buffering=0) as file:
        end = file.seek(0, os.SEEK_END)
        if end and os.pread(file.fileno(), 1, end - 1) != b"\n":
            end = os.pread(file.fileno(), end, 0).rfind(b"\n") + 1
            file.truncate(end)
        if file.write(line) != len(line):  # the disk became full in the middle
            file.truncate(end)
            raise OSError("no space for the whole line")


def _strict_json(content: Any, indent: int | None = None) -> str:
    # Python writes NaN and Infinity, which JSON does not have; they can be replaced on reading them back.
    finite = json.loads(json.dumps(content, default=_plain), parse_constant=lambda _: None)
    return json.dumps(finite, indent=indent)


def _plain(value: Any) -> Any:
    """An array or a scalar of numpy or JAX as lists and numbers."""
    if not hasattr(value, "tolist"):
        raise TypeError(f"a {type(value).__name__} cannot be written as JSON")
    return value.tolist()


@contextlib.contextmanager
def os_errors(path: str | Path, action: str) -> Iterator[None]:
    """Where an OSError becomes a RunError that names the path and what could not be done to it."""
    try:
        yield
    except OSError as error:
        raise RunError(f"{path}: cannot be {action}: {error.strerror or error}") from error


# Checkpoints


class Checkpoint(NamedTuple):
    """The parameters of a training after one of its PPO calls."""

    call: int  # its index; -1: what the run began with
    arrays: dict[str, np.ndarray]
    meta: dict[str, Any]

    @property
    def provenance(self) -> dict[str, Any]:
        """Where the parameters come from: `training.provenance`."""
        return self.meta.get("provenance", {})


def load_checkpoint(path: str | Path) -> Checkpoint:
    """A checkpoint from its file. Raises CheckpointError as `load_arrays` does."""
    arrays, meta = load_arrays(path, "checkpoint")
    return Checkpoint(meta.get("index", -1), arrays, meta.get("meta", {}))
