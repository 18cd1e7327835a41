"""Verdicts turn at their bounds, say why, and judge nothing that was not measured."""

import json
from typing import Any

import pytest
import reports
from reports import MOVES, drop, put, summaries

from bipedtrack import verdicts


def verdict(record: dict[str, Any], about: str, claim: str, policy: str = "ik") -> dict[str, Any]:
    """The only verdict about a figure of a policy whose claim begins so; of the last task if there are several."""
    found = [v for v in verdicts.verdicts(record) if v["about"] == about and v["policy"] == policy]
    return [v for v in found if v["claim"].startswith(claim)][-1]


BOUNDS = (
    ("figure 5", "average ankle position", "stairs-down", "errors.left_ankle_position_cm.mean", 5.0, 5.01),
    ("figure 6", "average ankle position", "walk-forward", "errors.right_ankle_position_cm.mean", 5.0, 5.01),
    ("figure 7", "average ankle orientation", "walk-backward", "errors.left_ankle_yaw_deg.mean", 5.0, 5.01),
    ("figure 8", "average ankle orientation", "sidle-right", "errors.right_ankle_yaw_deg.mean", 5.0, 5.01),
    ("figure 9", "achieves", "turn-right", "survival.share", 0.95, 0.949),
    ("figure 10", "average ankle position", "stairs-up", "survival.share", 0.5, 0.49),
    ("figure 12", "maintains its posture: no fall", "hold-walk-forward", "survival.share", 0.95, 0.949),
    ("figure 12", "maintains its posture: feet", "hold-walk-forward", "rest.foot_moved_share", 0.05, 0.051),
    ("figure 12", "maintains its posture: feet", "hold-walk-forward", "errors.left_ankle_position_cm.mean", 5.0, 5.01),
    ("figure 12", "maintains its posture: feet", "hold-walk-forward", "survival.share", 0.5, 0.49),
    ("figure 13", "average ankle position", "obstacles", "errors.left_ankle_position_cm.mean", 5.0, 5.01),
    ("figure 13", "avoids obstacles", "obstacles", "clearance.side_contact_share", 0.0, 0.001),
    ("figure 13", "avoids obstacles", "obstacles", "clearance.swings", 1, 0),
)


@pytest.mark.parametrize(("about", "claim", "task", "path", "good", "bad"), BOUNDS)
def test_a_verdict_turns_at_its_bound(
    record: dict[str, Any], about: str, claim: str, task: str, path: str, good: float, bad: float
) -> None:
    drop(record, task)
    other = verdict(record, about, claim, "runs/best/policy.npz")
    for value, met in ((good, True), (bad, False)):
        for known, figure in (("side_contact_share", 0.0), ("swings", 3)):
            put(summaries(record, task)["mjx"], f"clearance.{known}", figure)
        put(summaries(record, task)["mjx"], path, value)
        found = verdict(record, about, claim)
        assert found["met"] is met, found
        assert found["task"] == task
    assert verdict(record, about, claim, "runs/best/policy.npz") == other


@pytest.mark.parametrize(
    ("claim", "path", "good", "bad"),
    [
        ("fall rates", "survival.share", 0.77, 0.771),
        ("fall rates", "survival.share", 0.73, 0.729),
        ("ankle position", "errors.left_ankle_position_cm.mean", 3.5, 3.51),
        ("ankle position", "errors.right_ankle_position_cm.mean", 1.5, 1.49),
        ("ankle orientation", "errors.right_ankle_yaw_deg.mean", 2.5, 2.51),
    ],
)
def test_simulators_may_differ_by_so_much(record: dict[str, Any], claim: str, path: str, good: float, bad: float) -> None:
    assert summaries(record, "composite")["mjx"]["survival"]["share"] == 0.75
    for value, met in ((good, True), (bad, False)):
        put(summaries(record, "composite")["mujoco"], path, value)
        found = verdict(record, "two simulators", claim)
        assert (found["task"], found["met"]) == ("composite", met), found
    put(summaries(record, "composite")["mujoco"], path, None)
    assert verdict(record, "two simulators", claim)["met"] is (None if "fall" in claim else True)


def test_who_stands_where_it_shall_walk_achieves_nothing(record: dict[str, Any]) -> None:
    for share, met in ((0.5, True), (0.51, False)):
        put(summaries(record, "walk-forward")["mjx"], "survival.share", 1.0)
        put(summaries(record, "walk-forward")["mjx"], "touchdown.foothold_per_step.mean", share)
        found = verdict(record, "figure 6", "achieves")
        assert found["met"] is met
    assert found["figure"] == "100.0 % of episodes, but feet land 51 % of a step off their footholds"


def test_over_all_tasks_counts_the_mean_of_the_tasks(record: dict[str, Any]) -> None:
    put(summaries(record, "stairs-up")["mjx"], "errors.left_ankle_position_cm.mean", 3.0 + 2.0 * len(MOVES))
    found = verdict(record, "figure 11", "average ankle position")
    assert found["value"] == pytest.approx(5.0)
    assert (found["met"], found["task"]) == (True, f"mean of {len(MOVES)} tasks")
    put(summaries(record, "stairs-down")["mjx"], "errors.left_ankle_position_cm.mean", 3.1)
    assert verdict(record, "figure 11", "average ankle position")["met"] is False


def test_over_all_tasks_is_not_measured_by_some_of_them(record: dict[str, Any]) -> None:
    assert verdict(record, "figure 11", "average ankle position")["met"] is not None
    del record["tasks"]["stairs-up"]
    found = verdict(record, "figure 11", "average ankle position")
    assert (found["met"], found["figure"], found["task"]) == (None, "not measured", f"mean of {len(MOVES) - 1} tasks")


def test_who_falls_before_the_rest_keeps_no_foot_in_its_place(record: dict[str, Any]) -> None:
    held = summaries(record, "hold-walk-forward")["mjx"]
    put(held, "survival.share", 1.0)
    put(held, "rest.foot_moved_share", 0.02)
    for rested, value in ((256, 98.0), (128, 49.0), (0, 0.0)):
        put(held, "episodes", 256)
        put(held, "rest.episodes", rested)
        found = verdict(record, "figure 12", "maintains its posture: feet")
        assert found["value"] == pytest.approx(value) and found["met"] is (value >= 95)


def test_figures_give_the_worse_ankle_and_both(whole: dict[str, Any]) -> None:
    found = verdict(whole, "figure 6", "average ankle position")
    assert found["value"] == pytest.approx(3.0)
    assert found["figure"] == "3.00 cm (left 3.00, right 2.00)"
    assert (found["bound"], found["limit"], found["unit"], found["engine"]) == ("at most 5 cm", 5.0, "cm", "mjx")


def test_verdicts_are_plain_json(whole: dict[str, Any]) -> None:
    found = verdicts.verdicts(whole)
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert {v["about"] for v in found} == {*(f"figure {n}" for n in range(5, 14)), "two simulators"}


def test_without_a_figure_nothing_is_judged(record: dict[str, Any]) -> None:
    put(summaries(record, "hold-walk-forward")["mjx"], "rest.foot_moved_share", None)
    found = verdict(record, "figure 12", "maintains its posture: feet")
    assert (found["met"], found["figure"]) == (None, "not measured")


@pytest.mark.parametrize("what", reports.PARTS)
def test_without_a_part_verdicts_stay_plain_json(record: dict[str, Any], what: str) -> None:
    drop(record, what)
    found = verdicts.verdicts(record)
    assert json.loads(json.dumps(found, allow_nan=False)) == found


def test_a_record_of_nothing_has_no_verdicts() -> None:
    assert verdicts.verdicts({}) == []


def test_one_engine_alone_is_judged_but_not_about_simulators(record: dict[str, Any]) -> None:
    drop(record, "mjx")
    assert "two simulators" not in {v["about"] for v in verdicts.verdicts(record)}
    assert verdict(record, "figure 6", "achieves")["engine"] == "mujoco"
