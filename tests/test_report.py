"""The report of hand-made figures: every one has its place, gaps and odd names do no harm."""

import copy
import html
import json
import re
import shlex
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
import reports
import tyro
from reports import MOVES, Reader, drop, put, summaries

from bipedtrack import evaluate, report, verdicts
from bipedtrack.robot import Robot


@pytest.fixture(scope="module")
def whole(robot: Robot) -> dict[str, Any]:
    """A record of two policies on three engines, with robustness."""
    return reports.make(robot)


@pytest.fixture
def record(whole: dict[str, Any]) -> dict[str, Any]:
    """The same for a test to change."""
    return reports.copied(whole)


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


def test_the_episodes_of_each_difficulty_stand_in_their_row(whole: dict[str, Any]) -> None:
    page = Reader(report.page(whole))
    for policy in ("best", "ik"):
        rows = page.rows("The same episodes, by their difficulty", "walk-forward", policy)
        assert [row[2:4] for row in rows] == [["0 cm a step", "2"], ["1 cm a step", "2"]]
        # of two robots one falls; the left ankle is 3 cm off, the right one 2 cm
        assert [(row[4].split()[0], row[5], row[7]) for row in rows] == [("50.0", "3.00", "2.00")] * 2


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


def test_every_verdict_stands_in_a_table_with_its_badge(record: dict[str, Any]) -> None:
    put(summaries(record, "hold-walk-forward")["mjx"], "rest.foot_moved_share", None)
    found = [verdict for verdict in verdicts.verdicts(record) if verdict["about"] != verdicts.SIMULATORS]
    badges = {True: "✓ met", False: "✗ not met", None: "? not measured"}
    assert {verdict["met"] for verdict in found} == set(badges)
    labels = {"runs/best/policy.npz": "best", "ik": "ik"}
    rows = [row for row in Reader(report.page(record)).rows("Verdicts") if row[0] != "Task"]
    assert rows == [[v["task"], labels[v["policy"]], v["claim"], v["figure"], v["bound"], badges[v["met"]]] for v in found]


def test_at_a_glance_the_met_are_counted_for_each_figure_and_policy(record: dict[str, Any]) -> None:
    put(summaries(record, "walk-forward")["mjx"], "survival.share", 1.0)
    put(summaries(record, "walk-forward")["mjx"], "touchdown.foothold_per_step.mean", 0.0)
    table = Reader(report.page(record))
    best, ik = (table.rows("Claims met", name)[0] for name in ("best", "ik"))
    column = table.rows("Claims met", "Policy")[0].index("figure 6")
    assert (best[column], ik[column]) == ("✗ 2 of 3", "✓ 3 of 3")


# Missing parts


@pytest.mark.parametrize("what", reports.PARTS)
def test_a_missing_part_breaks_nothing(record: dict[str, Any], what: str) -> None:
    drop(record, what)
    page = Reader(report.page(record))
    assert {f"figure-{n}" for n in range(5, 14)} <= set(page.ids)
    assert {link.removeprefix("#") for link in page.links} <= set(page.ids)
    text = " ".join(page.text)
    assert not re.search(r"\b(nan|None|inf)\b", text)
    if what == "walk-forward":
        assert "Not evaluated: needs stairs-down." in text
        assert "Not evaluated: needs obstacles." in text
    if what == "robustness":
        assert "Not evaluated; --robustness adds it." in text


def test_a_record_of_nothing_is_a_page() -> None:
    assert "No task was evaluated." in " ".join(Reader(report.page({})).text)


def test_one_engine_alone_is_not_compared(record: dict[str, Any]) -> None:
    drop(record, "mjx")
    page = Reader(report.page(record))
    assert page.rows("MJX beside C", "stand", "ik")[0][2:6] == ["–", "25.0", "–", "25.0"]
    assert page.rows("MJX beside C", "stand", "ik")[0][-1].strip() == "? not measured"
    drop(record, "converged")
    assert "Only one simulator was evaluated" in " ".join(Reader(report.page(record)).text)


def test_numbers_that_are_not_finite_count_as_missing(record: dict[str, Any]) -> None:
    put(summaries(record, "composite")["mjx"], "effort.power_w", float("nan"))
    assert Reader(report.page(record)).rows("Effort", "composite", "ik")[0][-1] == "–"


# Text


def test_names_cannot_become_markup(record: dict[str, Any]) -> None:
    evil = "<script>alert('1')<script>&\"quoted\""  # without a slash, so that it is its own short name
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
