"""Where JAX keeps compiled programs from one start to the next."""

from __future__ import annotations

import hashlib
import os
import pathlib
import platform

from bipedtrack import versions

_SHORTEST = 1.0  # s of compiling that are worth a file
# XLA calls every kept program dangerous, for lack of CPU features that it made up itself (+prefer-no-gather); jax reads this
# when it is imported
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")


def use_cache() -> pathlib.Path | None:
    """Makes JAX keep its programs in the user's cache, by version and CPU; returns the folder, None where that fails.

    A program compiled for another CPU may not run here, one of another version is of no use. JAX_COMPILATION_CACHE_DIR is
    left to decide where it is set. The folder is its owner's alone (mode 0700), for what lies in it is executed.
    """
    import jax

    if os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        return pathlib.Path(os.environ["JAX_COMPILATION_CACHE_DIR"])
    try:
        root = pathlib.Path(os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache")
        folder = root / "bipedtrack" / f"programs-{_machine()}"
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        state = folder.stat()
        if state.st_uid != os.getuid():
            return None
        folder.chmod(0o700)
    except (OSError, RuntimeError):
        return None  # a full or read-only disk, or a user without a home: everything works without, only slower
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _SHORTEST)
    return folder


def _machine() -> str:
    """A digest of what compiled programs depend on: the versions of JAX and the CPU's instruction sets."""
    try:
        lines = pathlib.Path("/proc/cpuinfo").read_text().splitlines()
        cpu = "".join(sorted({line for line in lines if line.startswith(("flags", "Features", "model name"))}))
    except OSError:
        cpu = platform.processor()
    found = [f"{row.name} {row.found}" for row in versions.check() if row.name in ("jax", "jaxlib")]
    return hashlib.sha256("\n".join([*found, platform.machine(), cpu]).encode()).hexdigest()[:16]
