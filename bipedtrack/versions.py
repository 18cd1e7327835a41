"""The versions of the stack that bipedtrack is tested with, and a readable error for all others."""

import re
from importlib import metadata
from typing import NamedTuple

from bipedtrack.messages import Refusal


class VersionError(Refusal, RuntimeError):
    """A package is missing or runs in a version outside the tested range; the message is one line."""


class Tested(NamedTuple):
    """One package: the version our figures were made with, and where the range that behaves alike ends."""

    version: str
    """The tested version, also the oldest accepted."""
    below: str
    """The first version that is no longer accepted."""
    reason: str
    """Why the range is what it is."""


_JAX = "jax 0.10 removed device_put_replicated, which brax 0.14.2 needs, and jax 0.10.2 hung on the CPU"
_MUJOCO = "MuJoCo C and MJX must be the same version, and MuJoCo 4 changed how saturated actuators damp"

TESTED = {
    "jax": Tested("0.9.2", "0.10", _JAX),
    "jaxlib": Tested("0.9.2", "0.10", _JAX),
    "mujoco": Tested("3.17.0", "3.17.1", _MUJOCO),
    "mujoco-mjx": Tested("3.17.0", "3.17.1", _MUJOCO),
    "brax": Tested("0.14.2", "0.14.3", "the training calls brax's PPO with the arguments of 0.14.2"),
    "flax": Tested("0.12.6", "0.13", "brax 0.14.2 builds its networks with flax 0.12"),
    "optax": Tested("0.2.8", "0.3", "brax 0.14.2 builds its optimiser with optax 0.2"),
    "numpy": Tested("2.4.6", "3", "the controller is written over the Array API of numpy 2"),
}


class Row(NamedTuple):
    """One line of the version table."""

    name: str
    tested: str
    found: str | None
    """The installed version; None where the package is not installed."""
    ok: bool
    """True if the installed version lies in the tested range."""


def check() -> list[Row]:
    """The table of the stack, tested against installed, in the order of `TESTED`; imports nothing of it."""
    rows = []
    for name, tested in TESTED.items():
        try:
            found = metadata.version(name)
        except metadata.PackageNotFoundError:
            rows.append(Row(name, tested.version, None, ok=False))
            continue
        ok = _numbers(tested.version) <= _numbers(found) < _numbers(tested.below)
        rows.append(Row(name, tested.version, found, ok))
    return rows


def require() -> None:
    """Nothing, if every package runs in its tested range.

    Raises:
        VersionError: names the first package that does not, why that matters and what to do, in one line.
    """
    for row in check():
        if not row.ok:
            version, below, reason = TESTED[row.name]
            found = "is not installed" if row.found is None else f"{row.found} is outside the tested range"
            raise VersionError(
                f"{row.name} {found} (>={version},<{below}): {reason}; "
                f"run `make setup` or `pip install '{row.name}=={version}'`"
            )


def table(rows: list[Row]) -> str:
    """The rows as aligned text, one package a line: name, installed version, "ok" or the tested version."""
    lines = []
    for row in rows:
        verdict = "ok" if row.ok else f"NOT TESTED (tested: {row.tested})"
        lines.append(f"{row.name:<12}{row.found or 'missing':<12}{verdict}")
    return "\n".join(lines)


def _numbers(version: str) -> tuple[int, ...]:
    """The release numbers of a version, without suffixes: "0.9.2.dev1+cuda" -> (0, 9, 2)."""
    release = re.match(r"\d+(\.\d+)*", version)
    return tuple(int(number) for number in release[0].split(".")) if release else ()
