"""The report of hand-made figures: every one has its place, verdicts turn at their bounds, gaps and odd names do no harm."""

import copy
import html
import html.parser
import json
import re
import shlex
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tyro

from bipedtrack import evaluate, metrics, report
from bipedtrack.metrics import Boxes
from bipedtrack.nodes import Nodes
from bipedtrack.robot import Robot
from bipedtrack.trace import Trace

DT = 0.005  # s
WEIGHT = 400.0  # N
MOVES = [task for figure in report.ERROR_FIGURES for task in figure.tasks]
TASKS = ("stand", *MOVES, "hold-squat", "hold-walk-forward", "obstacles", "composite")


def steps(episodes: int = 4, n: int = 600) -> Trace:
    """Robots that walk along x at 0.2 m/s: feet (0.03, 0.02) m beside their targets, the last one falls at the end."""
    feet = np.array([[0, 0.1, 0.04], [0, -0.1, 0.04]])
    ones, time = np.ones((episodes, n)), np.arange(n) * DT
    moved = ones[..., None] * np.where(time < 1.5, 0.2 * time, 0.3)[None, :, None] * np.array([1.0, 0, 0])

    def nodes(off: float, turned: float) -> Nodes:
        return Nodes(
            trunk_position=moved + [0, 2 * off, 0.75],
            trunk_orientation=ones[..., None] * [1, 0, 0, 0],
            ankle_positions=moved[..., None, :] + feet + np.array([[0, off, 0], [0, off * 2 / 3, 0]]),
            ankle_yaws=np.full((episodes, n, 2), np.radians(turned)),
        )

    joints = np.zeros((episodes, n, 12))
    still = np.broadcast_to(time >= 1.5, (episodes, n)).copy()
    timer, forces = np.zeros((episodes, n, 2)), np.full((episodes, n, 2), WEIGHT / 2)
    timer[:, 100:200, 0], forces[:, 100:205, 0] = np.arange(100, 0, -1) * DT, 0
    alive = np.ones((episodes, n), bool)
    alive[-1, -50:] = False
    measured = nodes(0.03, 2.0)
    qpos = np.concatenate([measured.trunk_position, measured.trunk_orientation, joints], axis=-1)
    speeds = np.full((episodes, n, 18), 0.1)
    return Trace(time, qpos, speeds, nodes(0, 0), measured, timer, still, joints, joints, joints + 1, forces, alive)


def result(trace: Trace, robot: Robot) -> dict[str, Any]:
    """What an evaluation keeps of a trace."""
    episodes = len(trace.alive)
    # a bar 1 cm high, through which the toes slide
    place = [0.15 + robot.sole[0] / 2, 0.1, 0.005]
    bar = np.tile(place, (episodes, 1, 1)), np.tile([0.01, 0.5, 0.005], (episodes, 1, 1))
    boxes = Boxes(*bar, np.zeros((episodes, 1)))
    course = {name: values[::10].round(4).tolist() for name, values in metrics.time_course(trace).items()}
    path: dict[str, Any] = {"time_s": course["time_s"]}
    for side, state in (("target", trace.target), ("measured", trace.measured)):
        nodes = {
            "trunk": state.trunk_position[0],
            "left": state.ankle_positions[0, :, 0],
            "right": state.ankle_positions[0, :, 1],
        }
        path[side] = {node: points[::10].round(4).tolist() for node, points in nodes.items()}
    return {"summary": metrics.summarise(trace, robot, WEIGHT, boxes), "course": course, "path": path}


@pytest.fixture(scope="module")
def whole(robot: Robot) -> dict[str, Any]:
    """A record of two policies on three engines, with robustness."""
    one = result(steps(), robot)
    options = {
        "policies": ["runs/best/policy.npz", "ik"],
        "tasks": list(TASKS),
        "script": None,
        "episodes": 4,
        "seconds": 3.0,
    }
    options |= {
        "engine": "both",
        "seed": 2024,
        "out": "evaluation",
        "robustness": True,
        "feedback_ratio": None,
        "filter": 0.1,
    }
    options |= {"velocity_feedforward": None, "feedforward": True}
    results = {name: dict.fromkeys(report.ENGINES, one) for name in options["policies"]}
    levels = [{"level": v, "survival": one["summary"]["survival"], "errors": one["summary"]["errors"]} for v in (0.0, 17.5)]
    ladder = {"unit": "N s", "levels": levels, "episodes": 4, "task": "walk-forward"}
    return {
        "options": options,
        "versions": {"mujoco": "3.17.0", "jax": "0.9.2"},
        "policies": {"runs/best/policy.npz": {"curriculum": "paper", "seed": 3}, "ik": {}},
        "tasks": {task: {"ranges": f"ranges of {task}", "seconds": 3.0, "policies": results} for task in TASKS},
        "robustness": {"ik": {"push": ladder}},
    }


@pytest.fixture
def record(whole: dict[str, Any]) -> dict[str, Any]:
    """The same for a test to change; nothing in it is shared."""
    return json.loads(json.dumps(whole))  # a deep copy would keep what is shared within


class Reader(html.parser.HTMLParser):
    """Ids, links, tables and the tree of a page; fails where tags do not match."""

    EMPTY = ("meta", "link")

    def __init__(self, text: str):
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.tables: list[tuple[str, list[list[str]]]] = []  # caption and rows
        self.text: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        names = dict(attrs)
        self.tags.append((tag, names))
        self.ids += [names["id"] or ""] if "id" in names else []
        self.links += [names["href"] or ""] if tag == "a" else []
        if tag == "table":
            self.tables.append(("", []))
        if tag == "tr":
            self.tables[-1][1].append([])
        if tag in ("td", "th"):
            self.tables[-1][1][-1].append("")
        if tag not in self.EMPTY:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)
        if "caption" in self.open:
            self.tables[-1] = (self.tables[-1][0] + data, self.tables[-1][1])
        elif {"td", "th"} & set(self.open):
            self.tables[-1][1][-1][-1] += data

    def rows(self, caption: str, *names: str) -> list[list[str]]:
        """The rows of the tables of that caption that begin with these cells."""
        tables = [rows for title, rows in self.tables if title.startswith(caption)]
        assert tables, caption
        return [row for rows in tables for row in rows if row[: len(names)] == list(names)]

    def named(self, tag: str, kind: str) -> list[dict[str, str | None]]:
        """The attributes of the tags of that class."""
        return [names for found, names in self.tags if found == tag and kind in (names.get("class") or "").split()]


def summaries(record: dict[str, Any], task: str, policy: str = "ik") -> dict[str, Any]:
    return {engine: one["summary"] for engine, one in record["tasks"][task]["policies"][policy].items()}


def verdict(record: dict[str, Any], about: str, claim: str, policy: str = "ik") -> dict[str, Any]:
    """The only verdict about a figure of a policy whose claim begins so; of the last task if there are several."""
    found = [v for v in report.verdicts(record) if v["about"] == about and v["policy"] == policy]
    return [v for v in found if v["claim"].startswith(claim)][-1]


# What is there


def test_every_section_is_there_and_every_link_leads_to_one(whole: dict[str, Any]) -> None:
    page = Reader(report.page(whole))
    assert len(page.ids) == len(set(page.ids))
    assert {"glance", "tables", "intervals", "paper", "simulators", "robustness", "origins", "further"} <= set(page.ids)
    assert {f"figure-{n}" for n in range(5, 14)} <= set(page.ids)
    assert {link.removeprefix("#") for link in page.links} <= set(page.ids)
    text = " ".join(page.text)
    for said in (
        "best, ik",
        "2024",
        "3.17.0",
        "ranges of stairs-down",
        "curriculum",
        "MuJoCo C, converged solver",
        "--filter 0.1",
    ):
        assert said in text, said


def test_the_known_figures_of_a_trace_stand_in_its_row(whole: dict[str, Any]) -> None:
    page = Reader(report.page(whole))
    for engine in range(3):
        row = page.rows("Survival", "walk-forward", "ik")[engine]
        assert row[2].startswith("75.0 [30.1, 95.4]")
        assert row[3:5] == ["2.75", "–"]
        assert row[5:] == ["3.00"] * 4 + ["2.00"] * 4 + ["6.00"] * 4
        assert page.rows("Orientation", "walk-forward", "ik")[engine][2:] == ["2.00"] * 8 + ["0.00"] * 4
        # four footholds, felt 5 control steps late
        row = page.rows("Footholds: errors", "walk-forward", "ik")[engine]
        assert row[2:] == ["4", "0.0"] + ["3.00"] * 4 + ["0.00"] * 3 + ["2.00"] * 3 + ["25"] * 3
        row = page.rows("Footholds: the same", "walk-forward", "ik")[engine]
        assert row[2:] == ["10.0"] * 2 + ["30.0"] * 4 + ["0.0"] * 4 + ["20.0"] * 4
        # every toe is 1 cm below the edge
        assert page.rows("Clearance", "walk-forward", "ik")[engine][2:] == ["4"] + ["-1.00"] * 4 + ["100.0"] * 2
        row = page.rows("Effort", "walk-forward", "ik")[engine]
        assert row[2:] == ["1.00", "0.00", "0.000", "0.000", "1.2"]
    row = page.rows("Rest", "hold-squat", "ik")[0]
    assert row[2:7] == ["4", "2", "0.100", "0.100", "0.100"]
    assert row[-1] == "0.0"


PLACES = (
    ("Survival", 3, "survival.time_to_fall_mean_s", 1.25, "1.25"),
    ("Survival", 4, "survival.time_to_fall_median_s", 2.5, "2.50"),
    ("Survival", 6, "errors.left_ankle_position_cm.median", 7.125, "7.12"),
    ("Survival", 12, "errors.right_ankle_position_cm.max", 71.5, "71.50"),
    ("Survival", 15, "errors.trunk_position_cm.p95", 43.5, "43.50"),
    ("Orientation", 4, "errors.left_ankle_yaw_deg.p95", 8.5, "8.50"),
    ("Orientation", 13, "errors.trunk_orientation_deg.max", 61.5, "61.50"),
    ("Footholds: errors", 3, "touchdown.missed_share", 0.125, "12.5"),
    ("Footholds: errors", 8, "touchdown.height_cm.p5", -1.5, "-1.50"),
    ("Footholds: errors", 15, "touchdown.time_s.mean", -0.0125, "-12"),
    ("Footholds: the same", 4, "touchdown.foothold_per_step.mean", 0.123, "12.3"),
    ("Footholds: the same", 8, "touchdown.height_per_step.mean", 0.045, "4.5"),
    ("Footholds: the same", 12, "touchdown.yaw_deg_per_m.mean", 31.5, "31.5"),
    ("Clearance", 2, "clearance.swings", 17, "17"),
    ("Clearance", 3, "clearance.edge_cm.min", -0.25, "-0.25"),
    ("Clearance", 7, "clearance.below_edge_share", 0.0625, "6.2"),
    ("Clearance", 8, "clearance.side_contact_share", 0.5, "50.0"),
    ("Rest", 4, "rest.joint_speed_rms_rad_per_s.mean", 0.0625, "0.062"),
    ("Rest", 7, "rest.trunk_sway_rms_cm.mean", 0.375, "0.38"),
    ("Rest", 13, "rest.foot_motion_cm.mean", 0.875, "0.88"),
    ("Rest", 16, "rest.foot_moved_share", 0.25, "25.0"),
    ("Effort", 3, "effort.saturation_share", 0.0125, "1.25"),
    ("Effort", 4, "effort.feedback_mean", 0.125, "0.125"),
    ("Effort", 6, "effort.power_w", 111.25, "111.2"),
    ("Means of episodes", 3, "errors.left_ankle_position_cm.episode_mean", 4.5, "4.50 [3.00, 3.00]"),
    ("Means of episodes", 8, "errors.trunk_orientation_deg.episode_high", 9.25, "0.00 [0.00, 9.25]"),
)


@pytest.mark.parametrize(("caption", "column", "path", "value", "written"), PLACES)
def test_a_figure_stands_in_its_own_column_alone(
    record: dict[str, Any], caption: str, column: int, path: str, value: float, written: str
) -> None:
    drop(record, "composite")
    before = Reader(report.page(record)).rows(caption, "composite", "ik")[0]
    at = summaries(record, "composite")["mjx"]
    *parents, last = path.split(".")
    for key in parents:
        at = at[key]
    at[last] = value
    after = Reader(report.page(record)).rows(caption, "composite", "ik")[0]
    assert after[column] == written
    assert [i for i, (x, y) in enumerate(zip(before, after, strict=True)) if x != y] == [column]


def test_columns_stand_under_their_headings(whole: dict[str, Any]) -> None:
    for caption, rows in Reader(report.page(whole)).tables:
        head = [row for row in rows if row[0] in ("Task", "Policy", "Disturbance")]
        assert len(head) == 1, caption
    for sheet in report.SHEETS:
        for heading, columns in sheet.groups.items():
            parts = {column.path.rsplit(".", 1)[0] for column in columns}
            assert len(parts) == 1, heading
    nodes = {"left": "Left ankle", "right": "Right ankle", "trunk": "Trunk"}
    for sheet in report.SHEETS[:2]:
        for heading, columns in sheet.groups.items():
            if columns[0].path.startswith("errors."):
                assert heading.startswith(nodes[columns[0].path.removeprefix("errors.").split("_")[0]])


def test_two_simulators_stand_beside_each_other(record: dict[str, Any]) -> None:
    for engine, (share, cm, deg) in {"mjx": (0.9, 1.0, 1.0), "mujoco": (0.87, 1.2, 1.4), "converged": (0.8, 3, 4)}.items():
        summary = summaries(record, "stand")[engine]
        summary["survival"]["share"] = share
        summary["errors"]["left_ankle_position_cm"]["mean"] = summary["errors"]["right_ankle_position_cm"]["mean"] = cm
        summary["errors"]["left_ankle_yaw_deg"]["mean"], summary["errors"]["right_ankle_yaw_deg"]["mean"] = deg, 1.0
    row = Reader(report.page(record)).rows("MJX beside C", "stand", "ik")[0]
    assert row[2:6] == ["10.0", "13.0", "3.0", "20.0"]
    assert row[6:10] == ["1.00", "1.20", "2.00", "3.00"]
    assert row[10:14] == ["1.00", "1.20", "0.40", "2.50"]
    assert row[14].split() == ["✗", "not", "met", "falls"]


def test_robustness_has_its_curves_and_numbers(whole: dict[str, Any]) -> None:
    page = Reader(report.page(whole))
    row = page.rows("Survival, and mean errors of both", "push", "ik")[1]
    assert row[2:] == ["17.5 N s", "75.0 [30.1, 95.4]", "2.50", "2.00"]
    labels = [names["aria-label"] or "" for tag, names in page.tags if tag == "svg" and "aria-label" in names]
    assert any(label.startswith("Without a fall, %, over push in N s: 0: 75.00; 17.5: 75.00") for label in labels)
    assert any(label.startswith("Ankle position error, cm, over push in N s: 0: 2.50; 17.5: 2.50") for label in labels)


def test_every_drawing_says_what_it_shows_and_every_table_what_its_columns_are(whole: dict[str, Any]) -> None:
    text = report.page(whole)
    page = Reader(text)
    for tag, names in page.tags:
        if tag == "svg" and "x" not in names:  # those with x lie within another
            assert names.get("aria-hidden") or (names.get("role") == "img" and names["aria-label"])
        if tag == "th":
            assert names.get("scope") in ("col", "colgroup", "row")
    assert '<html lang="en">' in text
    assert text.count("<figure>") >= len(MOVES) * 4
    # green targets below yellow measurements, three nodes each
    assert len(page.named("path", "target")) == len(page.named("path", "actual")) == 3 * 2 * 2 * (len(MOVES) + 3)


# Verdicts


def put(summary: dict[str, Any], path: str, value: float | None) -> None:
    *parents, last = path.split(".")
    for key in parents:
        summary = summary[key]
    summary[last] = value


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
        badge = "✓ met" if met else "✗ not met"
        rows = Reader(report.page(record)).rows("Verdicts", task, "ik")
        assert [row[-1] for row in rows if row[2].startswith(claim)] == [badge]
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


def test_figures_give_the_worse_ankle_and_both(whole: dict[str, Any]) -> None:
    found = verdict(whole, "figure 6", "average ankle position")
    assert found["value"] == pytest.approx(3.0)
    assert found["figure"] == "3.00 cm (left 3.00, right 2.00)"
    assert (found["bound"], found["limit"], found["unit"], found["engine"]) == ("at most 5 cm", 5.0, "cm", "mjx")


def test_verdicts_are_plain_json(whole: dict[str, Any]) -> None:
    found = report.verdicts(whole)
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert {v["about"] for v in found} == {*(f"figure {n}" for n in range(5, 14)), "two simulators"}


def test_without_a_figure_nothing_is_judged(record: dict[str, Any]) -> None:
    put(summaries(record, "hold-walk-forward")["mjx"], "rest.foot_moved_share", None)
    found = verdict(record, "figure 12", "maintains its posture: feet")
    assert (found["met"], found["figure"]) == (None, "not measured")
    assert "? not measured" in " ".join(Reader(report.page(record)).text)


# Missing parts


def emptied(tree: Any) -> Any:
    """The same with every number None."""
    if isinstance(tree, dict):
        return {key: emptied(value) for key, value in tree.items()}
    return None if isinstance(tree, int | float) else tree


def each(record: dict[str, Any]) -> list[dict[str, Any]]:
    """What every engine found for every task and policy."""
    policies = [results for entry in record["tasks"].values() for results in entry["policies"].values()]
    return [one for results in policies for one in results.values()]


def drop(record: dict[str, Any], what: str) -> None:
    """Takes a part away."""
    if what in record:
        del record[what]
    elif what in ("mjx", "mujoco", "converged"):
        for entry in record["tasks"].values():
            for results in entry["policies"].values():
                del results[what]
    elif what in ("course", "path"):
        for one in each(record):
            del one[what]
    elif what == "one policy":
        for task in MOVES[2:]:
            del record["tasks"][task]["policies"]["ik"]
    elif what == "numbers":
        for one in each(record):
            one["summary"] = emptied(one["summary"])
            one["course"] = {name: [None] * len(v) if name != "time_s" else v for name, v in one["course"].items()}
    elif what == "clearance":
        for one in each(record):
            one["summary"]["clearance"] = None
    elif what == "points":
        for one in each(record):
            one["path"]["target"] = {}
            one["path"]["measured"] = {"left": [[0, 0, 0]]}
    else:
        record["tasks"] = {name: entry for name, entry in record["tasks"].items() if name == what}


@pytest.mark.parametrize(
    "what",
    [
        *("options", "versions", "policies", "tasks", "robustness", "mjx", "mujoco", "converged", "course", "path"),
        *("numbers", "clearance", "points", "walk-forward", "hold-squat", "composite", "none of the tasks", "one policy"),
    ],
)
def test_a_missing_part_breaks_nothing(record: dict[str, Any], what: str) -> None:
    drop(record, what)
    page = Reader(report.page(record))
    assert {f"figure-{n}" for n in range(5, 14)} <= set(page.ids)
    assert {link.removeprefix("#") for link in page.links} <= set(page.ids)
    text = " ".join(page.text)
    assert not re.search(r"\b(nan|None|inf)\b", text)
    json.dumps(report.verdicts(record), allow_nan=False)
    if what == "walk-forward":
        assert "Not evaluated: needs stairs-down." in text
        assert "Not evaluated: needs obstacles." in text
    if what == "robustness":
        assert "Not evaluated; --robustness adds it." in text


def test_a_record_of_nothing_is_a_page() -> None:
    assert "No task was evaluated." in " ".join(Reader(report.page({})).text)
    assert report.verdicts({}) == []


def test_one_engine_alone_has_no_verdict_about_simulators(record: dict[str, Any]) -> None:
    drop(record, "mjx")
    page = Reader(report.page(record))
    assert page.rows("MJX beside C", "stand", "ik")[0][2:6] == ["–", "25.0", "–", "25.0"]
    assert page.rows("MJX beside C", "stand", "ik")[0][-1].strip() == "? not measured"
    assert "two simulators" not in {v["about"] for v in report.verdicts(record)}
    assert verdict(record, "figure 6", "achieves")["engine"] == "mujoco"
    drop(record, "converged")
    assert "Only one simulator was evaluated" in " ".join(Reader(report.page(record)).text)


def test_numbers_that_are_not_finite_count_as_missing(record: dict[str, Any]) -> None:
    put(summaries(record, "composite")["mjx"], "effort.power_w", float("nan"))
    assert Reader(report.page(record)).rows("Effort", "composite", "ik")[0][-1] == "–"


# Text


def test_names_cannot_become_markup(record: dict[str, Any]) -> None:
    evil = "<script>alert('1')</script>&\"quoted\""
    text = json.dumps(record).replace('"ik"', json.dumps(evil)).replace("walk-forward", "<i>task</i>")
    record = json.loads(text)
    record["policies"][evil] = {evil: {evil: evil}}
    record["versions"][evil] = evil
    record["options"]["script"] = evil
    record["tasks"]["<i>task</i>"]["ranges"] = evil
    record["robustness"][evil]["<b>push</b>"] = record["robustness"][evil].pop("push")
    page = report.page(record)
    assert "<script" not in page and "<i>" not in page and "<b>push" not in page
    assert page.count(html.escape(evil)) > 20
    Reader(page)
    assert evil in " ".join(Reader(page).text)


def test_policies_are_named_shortly_where_that_tells_them_apart(record: dict[str, Any]) -> None:
    assert "best, ik" in " ".join(Reader(report.page(record)).text)
    record = json.loads(json.dumps(record).replace('"ik"', '"other/best/policy.npz"'))
    text = " ".join(Reader(report.page(record)).text)
    assert "runs/best/policy.npz, other/best/policy.npz" in text


def test_nothing_comes_from_outside(whole: dict[str, Any]) -> None:
    page = report.page(whole)
    for banned in (
        "http://",
        "https://",
        "//",
        "src=",
        "url(",
        "@import",
        "<script",
        "<iframe",
        "<object",
        "<base",
        "onload",
    ):
        assert banned not in page.replace("</", "<"), banned
    assert re.findall(r'href="(?!#)[^"]*"', page) == ['href="data:,"']


def test_metrics_json_gives_the_same_page(whole: dict[str, Any]) -> None:
    assert report.page(json.loads(json.dumps(whole))) == report.page(whole)
    kept = copy.deepcopy(whole)
    report.page(whole)
    assert whole == kept


@pytest.mark.parametrize(
    "options",
    [
        evaluate.Evaluate(("ik",)),
        evaluate.Evaluate(
            ("a b.npz", "zero"), tasks=("stand", "squat"), engine="mujoco", feedforward=False, robustness=True
        ),
        evaluate.Evaluate(("ik",), script=Path("my walk.csv"), feedback_ratio=0.0, filter=0.2, velocity_feedforward=False),
    ],
)
def test_the_command_evaluates_the_same_again(options: evaluate.Evaluate) -> None:
    written = {k: str(v) if isinstance(v, Path) else v for k, v in vars(options).items()}
    page = Reader(report.page({"options": json.loads(json.dumps(written))}))
    command = next(text for text in page.text if text.startswith("python -m bipedtrack.evaluate"))
    assert tyro.cli(evaluate.Evaluate, args=shlex.split(command)[3:]) == options


# Drawing


def numbers(steps: str) -> list[float]:
    return [float(number) for number in re.findall(r"-?\d+\.?\d*", steps)]


def test_an_error_on_the_bound_lies_on_its_line() -> None:
    course = {"time_s": [0.0, 5.0, 10.0], "alive_share": [1.0, 1.0, 0.5], "left_ankle_position_cm": [5.0, None, 5.0]}
    course |= {"trunk_position_cm": [100.0, 100.0, 0.0]}
    drawn = report._course(course, report.POSITION, "walk", 460)
    page = Reader(drawn)
    limit = numbers(page.named("path", "limit")[0]["d"] or "")[1]
    left = page.named("path", "left")[0]["d"] or ""
    assert left.count("M") == 2  # broken where a figure is missing
    assert numbers(left)[1] + report._TOP == pytest.approx(limit, abs=0.06)
    assert numbers(left)[3] + report._TOP == pytest.approx(limit, abs=0.06)
    axes = report._Axes(460, 220, (0, 10), (0, 30))
    assert limit == pytest.approx(axes.y(5.0), abs=0.06)  # higher ones are cut off at 30, and said to be
    assert "up to 100 cm" in page.text
    assert "left 5.00" in drawn and "highest is 100" in drawn
    # all are up to the middle, half of them at the end
    assert numbers(page.named("path", "up")[0]["d"] or "")[3:8:2] == [0.0, 0.0, pytest.approx((axes.bottom - 8) / 2)]


def test_seen_from_above_a_metre_is_a_metre() -> None:
    path = {"target": {"left": [[0, 0, 0], [1, 0, 0], [1, 0.5, 0]]}, "measured": {"left": [[0, 0, 0], [1, 0, 0.2]]}}
    box = [0.5, 0.1, 0.15, 0.2, 0.1, 0.3, np.pi / 2]
    sunk = [0.2, 0.1, -0.5, 0.2, 0.1, 0.3, 0.0]
    run = report._Run("walk", "ik", "ik", "mjx", {"summary": {}, "path": path}, [box, sunk])
    page = Reader(report._trajectory(run))
    side, top = (numbers(names["d"] or "") for names in page.named("path", "target"))
    assert top[2] - top[0] == pytest.approx(2 * (top[3] - top[5]), abs=0.5)
    assert side[1] == side[3] == side[5]
    assert side[2] - side[0] == pytest.approx((960 - 46 - 12) / 1.08, abs=0.5)  # the way fills the side view
    side, top = (numbers(names["d"] or "") for names in page.named("path", "box"))
    metre = (max(top[1::2]) - min(top[1::2])) / 0.2
    assert max(top[::2]) - min(top[::2]) == pytest.approx(0.1 * metre, abs=0.5)  # turned by a quarter


@pytest.mark.parametrize(
    ("low", "high", "most", "texts"),
    [
        (0, 10, 5, ["0", "2", "4", "6", "8", "10"]),
        (0, 7, 5, ["0", "2", "4", "6"]),
        (-0.2, 0.2, 5, ["-0.2", "-0.1", "0.0", "0.1", "0.2"]),
        (0, 0.1, 8, ["0.00", "0.02", "0.04", "0.06", "0.08", "0.10"]),
        (0, 104, 5, ["0", "50", "100"]),
    ],
)
def test_ticks_are_round(low: float, high: float, most: int, texts: list[str]) -> None:
    ticks = report._ticks(low, high, most)
    assert [text for _, text in ticks] == texts
    assert [value for value, _ in ticks] == pytest.approx([float(text) for text in texts])


# In a browser

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
PROBE = """<script>
const drawn = [...document.querySelectorAll("figure")].filter(f => [...f.querySelectorAll("svg[role=img]")].every(
  s => s.getBoundingClientRect().width > 0 && s.getBoundingClientRect().height > 0));
document.body.innerHTML = JSON.stringify({
  figures: document.querySelectorAll("figure").length, drawn: drawn.length,
  within: document.querySelectorAll("section[id^=figure-] figure svg").length,
  resources: performance.getEntriesByType("resource").length,
  wide: document.documentElement.scrollWidth, window: window.innerWidth})</script></body>"""


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on the PATH")
@pytest.mark.parametrize("width", [1200, 500])
def test_chromium_draws_every_figure_within_the_window(whole: dict[str, Any], tmp_path: Path, width: int) -> None:
    text = report.page(whole)
    file = tmp_path / "report.html"
    # the page forbids scripts; without that one looks at it from within
    file.write_text(re.sub("<meta http-equiv[^>]*>", "", text).replace("</body>", PROBE), encoding="utf-8")
    flags = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        f"--user-data-dir={tmp_path}/profile",
        f"--window-size={width},900",
    ]
    command = [str(CHROMIUM), *flags, "--dump-dom", file.as_uri()]
    dom = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout
    found = json.loads(re.search(r"<body>(\{.*?\})\s*</body>", dom, re.DOTALL)[1])  # type: ignore[index]
    assert found["figures"] == found["drawn"] == text.count("<figure>")
    assert found["within"] > 100
    assert found["resources"] == 0
    assert found["wide"] <= found["window"] == width
