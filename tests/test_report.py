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

from bipedtrack import evaluate, report

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


# At a glance


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
