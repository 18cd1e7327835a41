"""Reads the record of an evaluation, or what metrics.json holds of it. What is missing there is None."""

from __future__ import annotations

import math
import pathlib
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

ENGINES = {"mjx": "MJX", "mujoco": "MuJoCo C", "converged": "MuJoCo C, converged solver"}


class Run(NamedTuple):
    """What one engine made of a task with a policy."""

    task: str
    policy: str
    label: str  # of the policy
    engine: str
    result: dict[str, Any]  # summary, course, path
    boxes: list[list[float]]  # of the first episode: x, y, z of the centre, length, width, height in m, yaw in rad

    @property
    def summary(self) -> dict[str, Any]:
        """What metrics.summarise found."""
        return self.result["summary"]

    @property
    def holds(self) -> bool:
        """Whether the command stops after some task steps."""
        return self.task.startswith("hold-")

    @property
    def lasting(self) -> float | None:
        """The share of episodes without a fall."""
        return get(self.summary, "survival", "share")


def get(tree: Any, *path: str) -> Any:
    """What lies at a path, None where anything on the way is missing, or for a number that is not finite."""
    for key in path:
        tree = tree.get(key) if isinstance(tree, dict) else None
    return None if isinstance(tree, float) and not math.isfinite(tree) else tree


def runs_of(record: dict[str, Any], engine: str | None = None) -> list[Run]:
    """What an engine has run; without one, each task in the first of ENGINES that has."""
    labels, runs = labels_of(record), []
    for task, policy, results in _results(record):
        for name in [engine] if engine else ENGINES:
            if get(results, name, "summary"):
                boxes = get(record, "tasks", task, "boxes") or []
                runs.append(Run(task, policy, labels[policy], name, results[name], boxes))
                break
    return runs


def _results(record: dict[str, Any]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Task, policy, and the results by engine."""
    for task in get(record, "tasks") or {}:
        for policy, results in (get(record, "tasks", task, "policies") or {}).items():
            yield task, policy, results


def engines_of(record: dict[str, Any]) -> list[str]:
    """The engines that have run anything."""
    return [engine for engine in ENGINES if runs_of(record, engine)]


def labels_of(record: dict[str, Any]) -> dict[str, str]:
    """Short names of the policies in the order of evaluation; whole paths where short ones would be the same."""
    evaluated = [policy for _, policy, _ in _results(record)]
    short = {}
    for name in [*(get(record, "policies") or {}), *evaluated, *(get(record, "robustness") or {})]:
        path = pathlib.PurePath(name)
        short[name] = (path.parent.name if path.name == "policy.npz" else path.name.removesuffix(".npz")) or name
    taken = list(short.values())
    return {name: label if taken.count(label) == 1 else name for name, label in short.items()}


def mean_of(values: Iterable[float | None]) -> float | None:
    """The mean of the known ones."""
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def greatest_of(values: Iterable[float | None]) -> float | None:
    """The greatest of the known ones."""
    return max((value for value in values if value is not None), default=None)


def percent(share: float | None) -> float | None:
    """A share in %."""
    return None if share is None else 100 * share


def number(value: Any, digits: int = 2) -> str:
    """A number as text, a dash where there is none."""
    known = isinstance(value, int | float) and math.isfinite(value)
    return f"{value:.{digits}f}" if known else "–"
