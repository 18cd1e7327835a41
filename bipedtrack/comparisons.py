"""Sections of a report that compare: with the paper, one simulator with the other, and with disturbances of each kind."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from bipedtrack import charts, markup, sheets, verdicts
from bipedtrack.markup import badge, escape, section, task_rows
from bipedtrack.record import ENGINES, Run, get, labels_of, number, percent, runs_of
from bipedtrack.verdicts import BALANCE, FIGURES, OBSTACLES, PARITY, POSITION, QUANTITIES, TRAJECTORIES, PaperFigure

# Against the paper


def paper(record: dict[str, Any], found: list[dict[str, Any]]) -> str:
    """Our counterpart of each of the paper's figures 5 to 13, and the tasks that it has no figure of."""
    runs = runs_of(record)
    parts = [
        "<p>The paper records each task for 10 s. It claims an average error of both ankles within 5 cm and 5 deg, that the "
        "robot achieves every task, maintains its posture and avoids obstacles; it gives no success rate. Here, "
        f"{100 * verdicts.LASTING_SHARE:g} % of the episodes must do what it claims, and an error counts only where at "
        f"least {100 * verdicts.LEAST_SHARE:g} % of them last to the end. {sheets.engine_words(runs) if runs else ''}</p>"
    ]
    labels = labels_of(record)
    for figure in FIGURES:
        ours = [run for run in runs if run.task in figure.tasks or (run.holds and figure is BALANCE)]
        lines = [verdict for verdict in found if verdict["about"] == f"figure {figure.number}"]
        drawn = _drawn(figure, ours) or f"<p>Not evaluated: needs {escape(', '.join(figure.tasks))}.</p>"
        title = f"<h3>Figure {figure.number}: {escape(figure.title)}</h3>"
        parts.append(f'<section id="figure-{figure.number}">\n{title}\n{_verdict_table(lines, labels)}{drawn}\n</section>')
    known = {task for figure in FIGURES for task in figure.tasks}
    further = "".join(_courses(run) + _trajectory(run) for run in runs if run.task not in known and not run.holds)
    beyond = f"\n{section('further', 'Tasks beyond the paper', further)}" if further else ""
    return section("paper", "Against the paper", "\n".join(parts)) + beyond


def _drawn(figure: PaperFigure, runs: list[Run]) -> str:
    """What is drawn for a figure of the paper."""
    if figure is BALANCE:
        policies = dict.fromkeys(run.policy for run in runs)
        return sheets.sheet(sheets.REST, runs) + "".join(_courses_of(runs, policy) for policy in policies)
    courses = "" if figure is TRAJECTORIES else "".join(map(_courses, runs))
    return courses + ("".join(map(_trajectory, runs)) if figure in (TRAJECTORIES, OBSTACLES) else "")


def _verdict_table(found: Sequence[dict[str, Any]], labels: dict[str, str]) -> str:
    rows = []
    for verdict in found:
        words = "".join(f'<td class="words">{escape(verdict[name])}</td>' for name in ("claim", "figure"))
        cells = [words, f"<td>{verdict['bound']}</td>", f"<td>{badge(verdict['met'])}</td>"]
        rows.append((verdict["task"], labels[verdict["policy"]], cells))
    head = markup.head("Task", "Policy", "The paper's claim", "Our figure", "Met if", "Verdict")
    return markup.table("Verdicts", head, task_rows(rows), "left")


def _courses(run: Run) -> str:
    """Position and orientation errors over time; empty if they were not recorded."""
    course = get(run.result, "course") or {}
    if not course.get("time_s"):
        return ""
    caption = (
        f"{_title(run)}. {charts.NODE_KEY} Means over the robots that are still up; {number(percent(run.lasting), 1)} % of "
        f"{number(get(run.summary, 'episodes'), 0)} are at the end."
    )
    panels = (charts.errors_over_time(course, quantity, run.task, 460) for quantity in QUANTITIES)
    return markup.figure("pair", panels, caption)


def _courses_of(runs: list[Run], policy: str) -> str:
    """The position errors of several tasks over time, of one policy."""
    kept = [run for run in runs if run.policy == policy and get(run.result, "course", "time_s")]
    panels = (
        f"<h4>{escape(run.task)}</h4>{charts.errors_over_time(run.result['course'], POSITION, run.task, 360)}"
        for run in kept
    )
    caption = f"<b>{escape(kept[0].label)}</b>, before and after the command stops. {charts.NODE_KEY}" if kept else ""
    return markup.figure("triple", panels, caption) if kept else ""


def _trajectory(run: Run) -> str:
    """Where the nodes should go and went; empty if that was not recorded."""
    views = charts.views(run)
    caption = f"{_title(run)}, first episode, until the robot falls if it does. {charts.PATH_KEY}"
    return markup.figure("wide", views, caption) if views else ""


def _title(run: Run) -> str:
    return f"<b>{escape(run.task)}, {escape(run.label)}</b>"


# Two simulators and robustness


def simulators(record: dict[str, Any]) -> str:
    """MJX beside MuJoCo C, and C with a converged solver."""
    rows = verdicts.parities(record)
    if not rows:
        return section("simulators", "Two simulators", "<p>Only one simulator was evaluated; --engine both runs both.</p>")
    words = (
        "<p>The same episodes in MJX and in MuJoCo C with the solver of the model; beside them, C with its solver run until "
        f"it converges. Met: fall rates at most {PARITY[0]:g} percentage points apart, ankle errors at most {PARITY[1]:g} "
        f"mm and {PARITY[2]:g} deg. Errors are means of both ankles; apart is the difference of the one that differs "
        "more.</p>"
    )
    groups = {"Falls, %": "points", "Ankle position error, cm": "mm", "Ankle orientation error, deg": "deg"}
    headings = [name for unit in groups.values() for name in ("MJX", "C", f"apart, {unit}", "C converged")]
    head = markup.two_heads(dict.fromkeys(groups, 4), headings, "Verdict")
    table = markup.table("MJX beside C", head, task_rows(map(_parity_line, rows)))
    return section("simulators", "Two simulators", words + table)


def _parity_line(row: verdicts.Parity) -> tuple[str, str, list[str]]:
    cells = []
    for values, apart, digits in zip(row.values, row.apart, (1, 2, 2), strict=True):
        mjx, c, converged = (number(values.get(engine), digits) for engine in ENGINES)
        cells.append(f"<td>{mjx}</td><td>{c}</td><td><b>{number(apart, digits)}</b></td><td>{converged}</td>")
    judged = [verdict["met"] for verdict in verdicts.parity_verdicts(row)]
    missed = [name for name, met in zip(("falls", "position", "orientation"), judged, strict=False) if met is False]
    met = False if missed else None if not judged or None in judged else True
    return row.run.task, row.run.label, [*cells, f'<td class="name">{badge(met)} <small>{", ".join(missed)}</small></td>']


def robustness(record: dict[str, Any]) -> str:
    """Survival and ankle error over the levels of each disturbance."""
    found: dict[str, Any] = get(record, "robustness") or {}
    kinds = list(dict.fromkeys(kind for by_kind in found.values() for kind in by_kind))
    if not kinds:
        return section("robustness", "Robustness", "<p>Not evaluated; --robustness adds it.</p>")
    order, parts = list(labels_of(record)), []
    for kind in kinds:
        ladders = {order.index(policy): by_kind[kind] for policy, by_kind in found.items() if by_kind.get(kind)}
        one: Any = next(iter(ladders.values()), None)
        label = " in ".join(filter(None, (kind, get(one, "unit"))))
        panels = [charts.ladder(ladders, label, "Without a fall, %", charts.lasting, None)]
        panels.append(charts.ladder(ladders, label, "Ankle position error, cm", charts.ankles(POSITION), POSITION))
        episodes = f"{escape(get(one, 'task') or '–')}, {number(get(one, 'episodes'), 0)} episodes at each level"
        caption = f"<b>{escape(kind)}</b>: {episodes}, MuJoCo C. {charts.policy_key(record)}"
        parts.append(markup.figure("pair", panels, caption))
    numbers = f"<details><summary>The numbers behind the curves</summary>{_ladder_table(record, kinds)}</details>"
    return section("robustness", "Robustness", f"<p>{charts.LEAST}</p>{''.join(parts)}{numbers}")


def _ladder_table(record: dict[str, Any], kinds: list[str]) -> str:
    labels, lines = labels_of(record), []
    for kind in kinds:
        for policy, by_kind in record["robustness"].items():
            for row in get(by_kind, kind, "levels") or []:
                level = f"{row['level']:g} {get(by_kind, kind, 'unit') or ''}"
                errors = [number(charts.ankles(quantity)(row)[0]) for quantity in QUANTITIES]
                cells = [f"<td>{cell}</td>" for cell in (escape(level), sheets.cell(row, sheets.SURVIVAL), *errors)]
                lines.append((kind, labels[policy], cells))
    figures = ("Without a fall, % [95 % interval]", "Ankle position error, cm", "Ankle orientation error, deg")
    head = markup.head("Disturbance", "Policy", "Level", *figures)
    return markup.table("Survival, and mean errors of both ankles", head, task_rows(lines))
