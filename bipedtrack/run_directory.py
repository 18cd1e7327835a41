"""The directory of a training run: its settings, its lock and its newest checkpoints.

run.json            the settings of the run, written last when it is created: what has it holds a run
start.npz           the checkpoint that the run began with, if it did not begin from nothing
lock                locked by the process that trains; the system frees it however that process ends
checkpoints/*.npz   the newest three, named by index
"""

import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bipedtrack.checkpoint import (
    UNFINISHED,
    Checkpoint,
    CheckpointError,
    RunError,
    load_checkpoint,
    os_errors,
    save_arrays,
    write_json,
)

KEPT_CHECKPOINTS = 3


class RunDirectory:
    """The directory of one training run.

    `RunDirectory.create` and `RunDirectory.open` lock it, to train in it. `RunDirectory(path)` only reads,
    also while another process trains.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.warnings: list[str] = []  # what `latest` skipped, a line each
        self._lock: int | None = None
        self._settings_file = self.path / "run.json"
        self._checkpoints = self.path / "checkpoints"
        self._start = self.path / "start.npz"

    @classmethod
    def create(cls, path: str | Path, settings: dict[str, Any], start: Checkpoint | None = None) -> "RunDirectory":
        """A new run with these JSON-able `settings` and what it begins with, if that is not nothing.

        Raises RunError if there is a run at `path` already.
        """
        run = cls(path)
        with os_errors(path, "created"):
            run._checkpoints.mkdir(parents=True, exist_ok=True)
        run._acquire()
        try:
            if run._settings_file.exists():
                raise RunError(f"{path}: already holds a run; go on with --resume or use another directory")
            if run._indices() or run._start.exists():
                named = run._start.name if run._start.exists() else "checkpoints"
                raise RunError(f"{path}: holds {named} without a run.json; use another directory")
            try:
                if start is not None:
                    save_arrays(run._start, start.arrays, {"index": -1, "meta": start.meta}, "checkpoint")
                write_json(run._settings_file, settings)
            except BaseException:
                if not run._settings_file.exists():
                    run._start.unlink(missing_ok=True)
                raise
        except BaseException:
            run.close()
            raise
        return run

    @classmethod
    def open(cls, path: str | Path) -> "RunDirectory":
        """The run at `path`, to continue it. Raises RunError if there is none or a process trains in it."""
        run = cls(path)
        with os_errors(path, "opened"):
            if not run._settings_file.exists():
                raise RunError(f"{path}: holds no run to resume (no run.json); start one without --resume")
            run._checkpoints.mkdir(exist_ok=True)
        run._acquire()
        return run

    @property
    def settings(self) -> Any:
        """What `create` wrote to `run.json`. Raises RunError when it cannot be read."""
        with os_errors(self._settings_file, "read"):
            try:
                return json.loads(self._settings_file.read_bytes())
            except (ValueError, RecursionError) as error:
                raise RunError(f"{self._settings_file}: is damaged ({error}); wanted JSON") from error

    def save_checkpoint(self, index: int, arrays: Mapping[str, Any], meta: dict[str, Any]) -> Path:
        """Writes `checkpoints/<index>.npz`, and once it is safely there removes all but the newest three.

        Raises RunError when it cannot be written (a full disk); the checkpoints before it are then untouched.
        """
        if self._lock is None:
            raise RunError(f"{self.path}: is not locked; wanted RunDirectory.create or RunDirectory.open")
        path = self._checkpoint(index)
        save_arrays(path, arrays, {"index": index, "meta": meta}, "checkpoint")
        # Later ones, if any, were skipped as damaged when the run resumed: they count for nothing.
        for old in [i for i in self._indices() if i <= index][:-KEPT_CHECKPOINTS]:
            with os_errors(self._checkpoint(old), "removed"):
                self._checkpoint(old).unlink(missing_ok=True)
        return path

    def latest(self) -> Checkpoint | None:
        """The newest intact checkpoint; before the first what the run began with, or None; see also `warnings`.

        Raises CheckpointError when there are checkpoints but none is intact.
        """
        self.warnings = []
        for index in reversed(self._indices()):
            path = self._checkpoint(index)
            try:
                found = load_checkpoint(path)
                if found.call != index:
                    raise CheckpointError(f"{path}: is number {found.call}, renamed; wanted {index}")
                return found
            except CheckpointError as error:
                self.warnings.append(f"skipped {error}")
        if self.warnings:
            raise CheckpointError(f"{self.path}: no checkpoint is intact; {self.warnings[0]}")
        return load_checkpoint(self._start) if self._start.exists() else None

    def close(self) -> None:
        """Frees the lock, which otherwise lasts as long as the process."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def _checkpoint(self, index: int) -> Path:
        return self._checkpoints / f"{index:04d}.npz"

    def _indices(self) -> list[int]:
        """The indices of the checkpoints that are there, damaged or not, in ascending order."""
        names = [re.fullmatch(r"(\d{4,})\.npz", file.name) for file in self._checkpoints.glob("*.npz")]
        return sorted(int(name[1]) for name in names if name)

    def _acquire(self) -> None:
        """Locks the directory for this process and removes what interrupted writes left behind."""
        import fcntl  # not on Windows, where policies must still load

        with os_errors(self.path / "lock", "locked"):
            self._lock = os.open(self.path / "lock", os.O_RDWR | os.O_CREAT, 0o644)
            try:
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                os.ftruncate(self._lock, 0)
                os.pwrite(self._lock, str(os.getpid()).encode(), 0)
                for folder in (self.path, self._checkpoints):
                    for unfinished in folder.glob(f"*{UNFINISHED}"):
                        unfinished.unlink(missing_ok=True)
            except OSError as error:
                holder = os.pread(self._lock, 20, 0).decode(errors="replace") or "unknown"
                self.close()
                if not isinstance(error, BlockingIOError):
                    raise
                raise RunError(f"{self.path}: is in use by process {holder}; wait for it or use another directory") from None
