"""The record of an evaluation is read with its gaps: what is missing is None, and nothing fails."""

import math
from typing import Any

import pytest

from bipedtrack import record


def evaluated(*policies: str, engines: tuple[str, ...] = ("mjx",)) -> dict[str, Any]:
    """A record of one task with no figure but the episodes."""
    one = {"summary": {"episodes": 4}}
    return {"tasks": {"walk": {"policies": {policy: dict.fromkeys(engines, one) for policy in policies}}}}


@pytest.mark.parametrize("path", [("a", "b", "c"), ("a", "none", "c"), ("b",), ("a", "nan"), ("a", "inf")])
def test_whatever_is_missing_is_none(path: tuple[str, ...]) -> None:
    tree = {"a": {"b": 1.5, "none": None, "nan": math.nan, "inf": -math.inf}}
    assert record.get(tree, *path) is None
    assert record.get(tree, "a", "b") == 1.5
    assert record.get(None, "a") is None


def test_a_run_is_of_the_first_engine_that_has_one_or_of_the_one_asked_for() -> None:
    found = evaluated("ik", engines=("converged", "mujoco"))
    assert [run.engine for run in record.runs_of(found)] == ["mujoco"]
    assert [run.engine for run in record.runs_of(found, "converged")] == ["converged"]
    assert record.runs_of(found, "mjx") == []
    assert record.engines_of(found) == ["mujoco", "converged"]


def test_boxes_are_those_of_the_task() -> None:
    found = evaluated("ik")
    assert record.runs_of(found)[0].boxes == []
    found["tasks"]["walk"]["boxes"] = [[0.0] * 7]
    assert record.runs_of(found)[0].boxes == [[0.0] * 7]


def test_policies_are_named_shortly_where_that_tells_them_apart() -> None:
    short = record.labels_of(evaluated("runs/mine/policy.npz", "models/best.npz", "ik"))
    assert list(short.values()) == ["mine", "best", "ik"]
    whole = record.labels_of(evaluated("runs/best/policy.npz", "other/best/policy.npz", "policy.npz"))
    assert list(whole.values()) == ["runs/best/policy.npz", "other/best/policy.npz", "policy.npz"]


def test_every_policy_that_is_named_anywhere_has_a_label() -> None:
    found = evaluated("ik") | {"policies": {"zero": {}}, "robustness": {"best.npz": {}}}
    assert record.labels_of(found) == {"zero": "zero", "ik": "ik", "best.npz": "best"}


def test_figures_count_where_they_are_known() -> None:
    assert record.mean_of([1.0, None, 2.0]) == 1.5
    assert record.greatest_of([None, 1.0, 2.0]) == 2.0
    assert record.mean_of([None]) is record.greatest_of([]) is record.percent(None) is None
    assert record.percent(0.25) == 25.0
    assert (record.number(1.25, 1), record.number(3, 0), record.number(None), record.number(math.nan)) == (
        "1.2",
        "3",
        "–",
        "–",
    )
