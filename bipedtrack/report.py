"""What an evaluation found as one HTML file: style and figures within, no script, nothing from any other address.

`page` is the table of contents. It takes what `evaluate.run` returns; whatever is missing there is left out, or said to be
missing.
"""

from __future__ import annotations

import html
import shlex
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from bipedtrack import charts, metrics, verdicts
from bipedtrack.record import ENGINES, Run, engines_of, get, labels_of, mean_of, number, percent, runs_of
from bipedtrack.robot import LEGS
from bipedtrack.verdicts import (
    BALANCE,
    FIGURES,
    LASTING_SHARE,
    LEAST_SHARE,
    OBSTACLES,
    PARITY,
    POSITION,
    QUANTITIES,
    SIMULATORS,
    TRAJECTORIES,
    PaperFigure,
    Parity,
)


def page(record: dict[str, Any]) -> str:
    """The whole report as HTML."""
    found, title = verdicts.verdicts(record), _escape(", ".join(labels_of(record).values())) or "no policy"
    sections = (
        _glance(record, found),
        _tables(record),
        _intervals(record),
        _levels(record),
        _paper(record, found),
        _simulators(record, found),
        _robustness(record),
        _origins(record),
    )
    policy = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n<link rel="icon" href="data:,">\n'
        f"<title>bipedtrack evaluation: {title}</title>\n<style>{_CSS}</style>\n</head>\n<body>\n"
        f"<header>\n<h1>Tracking of trunk and ankles: {title}</h1>\n{_header(record)}\n</header>\n"
        "<main>\n" + "\n".join(sections) + "\n</main>\n</body>\n</html>\n"
    )


def _escape(text: Any) -> str:
    return html.escape(str(text), quote=True)


# Header, verdicts at a glance, origins


def _header(record: dict[str, Any]) -> str:
    """What was evaluated, how, and where to find it."""
    options = get(record, "options") or {}
    facts = {
        "Policies": _escape(", ".join(labels_of(record).values())) or "none",
        "Tasks": len(get(record, "tasks") or {}),
        **{f"{name.capitalize()} of each task": _escape(options.get(name, "–")) for name in ("episodes", "seconds")},
        "Seed": _escape(options.get("seed", "–")),
        "Simulators": "; ".join(ENGINES[engine] for engine in engines_of(record)) or "none",
    }
    listed = "".join(f"<div><dt>{name}</dt><dd>{value}</dd></div>" for name, value in facts.items())
    links = {
        **{"glance": "At a glance", "tables": "Every figure", "intervals": "Side by side"},
        **{"levels": "From easy to hard", "paper": "Against the paper"},
        **{"simulators": "Two simulators", "robustness": "Robustness", "origins": "Ranges, options, versions, provenance"},
    }
    menu = "".join(f'<a href="#{anchor}">{name}</a>' for anchor, name in links.items())
    return (
        f'<dl class="facts">{listed}</dl>\n{_command(options)}<nav aria-label="Contents">{menu}</nav>\n'
        f"<details><summary>How each figure is defined</summary>{_DEFINITIONS}</details>"
    )


def _command(options: dict[str, Any]) -> str:
    """The command line that evaluates the same again."""
    if not options.get("policies"):
        return ""
    words = ["python", "-m", "bipedtrack.evaluate", *options["policies"]]
    for name, value in options.items():
        flag = name.replace("_", "-")
        if name in ("feedforward", "robustness"):  # flags, on and off by default
            words += [] if value == (name == "feedforward") else [f"--{flag}" if value else f"--no-{flag}"]
        elif name not in ("policies", "out") and value not in (None, [], ()):
            words += [f"--{flag}", *(map(str, value) if isinstance(value, list | tuple) else (str(value),))]
    return f"<p>Made by <code>{_escape(shlex.join(words))}</code></p>\n"


def _glance(record: dict[str, Any], found: list[dict[str, Any]]) -> str:
    """How many claims each policy meets."""
    columns = {f"figure {f.number}": f'<a href="#figure-{f.number}">figure {f.number}</a>' for f in FIGURES}
    columns[SIMULATORS] = f'<a href="#simulators">{SIMULATORS}</a>'
    rows = []
    for policy, label in labels_of(record).items():
        cells = [_count([v["met"] for v in found if (v["policy"], v["about"]) == (policy, about)]) for about in columns]
        rows.append(f'<tr><th scope="row">{_escape(label)}</th>{"".join(cells)}</tr>')
    table = _table("Claims met, of those that were measured", _head("Policy", *columns.values()), rows)
    return _section("glance", "At a glance", table)


def _count(met: list[bool | None]) -> str:
    """A cell: how many are met."""
    measured = [one for one in met if one is not None]
    kind = "unknown" if not measured else "met" if all(measured) else "missed"
    words = f"{_MARKS[kind]} {sum(measured)} of {len(measured)}" if measured else "–"
    return f'<td class="{kind}">{words}</td>'


_MARKS = {"met": "✓", "missed": "✗", "unknown": "?"}
_WORDS = {"met": "met", "missed": "not met", "unknown": "not measured"}


def _badge(met: bool | None) -> str:
    kind = "unknown" if met is None else "met" if met else "missed"
    return f'<span class="badge {kind}">{_MARKS[kind]} {_WORDS[kind]}</span>'


def _origins(record: dict[str, Any]) -> str:
    """What the tasks are drawn from, the options, the versions and where the policies come from."""
    ranges = [
        f'<tr><th scope="row">{_escape(task)}</th><td class="words">{_escape(get(entry, "ranges") or "–")}</td>'
        f"<td>{number(get(entry, 'seconds'), 1)}</td></tr>"
        for task, entry in (get(record, "tasks") or {}).items()
    ]
    table = _table("What the episodes are drawn from", _head("Task", "Ranges", "Seconds"), ranges, "left")
    versions, options = (_tree(get(record, name) or {}) for name in ("versions", "options"))
    provenance = [
        f"<details><summary>{_escape(name)}</summary>{_tree(origin) if origin else '<p>Nothing was trained.</p>'}</details>"
        for name, origin in (get(record, "policies") or {}).items()
    ]
    lists = f'<div class="pair"><div><h3>Versions</h3>{versions}</div><div><h3>Options</h3>{options}</div></div>'
    policies = f"<h3>Provenance of the policies</h3>{''.join(provenance) or '<p>Not recorded.</p>'}"
    return _section("origins", "Ranges, options, versions, provenance", table + lists + policies)


def _tree(value: Any) -> str:
    """Nested dicts as nested lists of names and values."""
    if not isinstance(value, dict):
        words = ", ".join(map(str, value)) if isinstance(value, list | tuple) else value
        return "not set" if words in (None, "") else _escape(words)
    items = "".join(f"<li><b>{_escape(key)}</b>: {_tree(part)}</li>" for key, part in value.items())
    return f"<ul>{items}</ul>" if items else "none"


def _section(anchor: str, title: str, content: str) -> str:
    return f'<section id="{anchor}">\n<h2>{_escape(title)}</h2>\n{content}\n</section>'


# Tables


class _Column(NamedTuple):
    """Where in a summary a figure lies, by a dotted path, and how it is written."""

    heading: str
    path: str
    digits: int = 2
    scale: float = 1.0
    interval: tuple[str, str] | None = None  # paths of its bounds


class _Sheet(NamedTuple):
    """A table with a row for each task and policy; its columns by their common heading."""

    title: str
    groups: dict[str, list[_Column]]


_HEADINGS = {"mean": "mean", "median": "median", "p5": "5 %", "p95": "95 %", "min": "min", "max": "max"}


def _spread(path: str, which: str = "mean median p95 max", digits: int = 2, scale: float = 1.0) -> list[_Column]:
    """Statistics of one figure."""
    return [_Column(_HEADINGS[name], f"{path}.{name}", digits, scale) for name in which.split()]


def _share(heading: str, path: str, digits: int = 1) -> list[_Column]:
    return [_Column(heading, path, digits, 100)]


def _interval(name: str) -> list[_Column]:
    path = f"errors.{name}.episode"
    return [_Column("mean [95 % interval]", f"{path}_mean", interval=(f"{path}_low", f"{path}_high"))]


_SURVIVAL = _Column("% [95 % interval]", "survival.share", 1, 100, ("survival.share_low", "survival.share_high"))
_REST = _Sheet(
    f"Rest: while the command stands still, from {metrics.SETTLE:g} s after it came to",
    {
        "Observed": [_Column("episodes", "rest.episodes", 0), _Column("seconds", "rest.seconds", 0)],
        "Joint speed RMS, rad/s": _spread("rest.joint_speed_rms_rad_per_s", "mean p95 max", 3),
        "Trunk sway RMS, cm": _spread("rest.trunk_sway_rms_cm", "mean p95"),
        "Sway peak to peak, cm": _spread("rest.trunk_sway_peak_to_peak_cm", "mean p95"),
        "Trunk turn RMS, deg": _spread("rest.trunk_turn_rms_deg", "mean p95"),
        "Foot motion, cm": _spread("rest.foot_motion_cm", "mean p95 max"),
        "A foot moved": _share("% of episodes", "rest.foot_moved_share"),
    },
)
SHEETS = (
    _Sheet(
        "Survival, and position errors of the nodes in cm",
        {
            "Without a fall": [_SURVIVAL],
            "Time to fall, s": [
                _Column("mean of falls", "survival.time_to_fall_mean_s"),
                _Column("median of all", "survival.time_to_fall_median_s"),
            ],
            **{f"{leg.capitalize()} ankle": _spread(f"errors.{leg}_ankle_position_cm") for leg in LEGS},
            "Trunk": _spread("errors.trunk_position_cm"),
        },
    ),
    _Sheet(
        "Orientation errors of the nodes in deg",
        {
            **{f"{leg.capitalize()} ankle, yaw": _spread(f"errors.{leg}_ankle_yaw_deg") for leg in LEGS},
            "Trunk, whole rotation": _spread("errors.trunk_orientation_deg"),
        },
    ),
    _Sheet(
        "Footholds: errors at planned touchdowns",
        {
            "Touchdowns": [_Column("planned", "touchdown.planned", 0), *_share("missed, %", "touchdown.missed_share")],
            "In the plane, cm": _spread("touchdown.foothold_cm"),
            "Height, cm (+ too high)": _spread("touchdown.height_cm", "p5 mean p95"),
            "Yaw, deg": _spread("touchdown.yaw_deg", "mean p95 max"),
            "Time, ms (+ late)": _spread("touchdown.time_s", "p5 mean p95", 0, 1000),
        },
    ),
    _Sheet(
        "Footholds: the same errors, divided by the length of the step",
        {
            "Step length, cm": _spread("touchdown.step_length_cm", "mean max", 1),
            "In the plane, % of step": _spread("touchdown.foothold_per_step", digits=1, scale=100),
            "Height, % of step": _spread("touchdown.height_per_step", digits=1, scale=100),
            "Yaw, deg for each m": _spread("touchdown.yaw_deg_per_m", digits=1),
        },
    ),
    _Sheet(
        "Clearance of the soles over the edges of stairs and obstacles",
        {
            "Swings": [_Column("past an edge", "clearance.swings", 0)],
            "Height over the edge, cm": _spread("clearance.edge_cm", "min p5 median mean"),
            "Below the edge": _share("% of those", "clearance.below_edge_share"),
            "Against a side": _share("% of all swings", "clearance.side_contact_share"),
        },
    ),
    _REST,
    _Sheet(
        "Effort",
        {
            "Torque RMS": [_Column("N m", "effort.torque_rms_nm")],
            "Saturated": _share("% of torques", "effort.saturation_share", 2),
            "Feedback |a_fb|": [_Column("mean", "effort.feedback_mean", 3), _Column("max", "effort.feedback_max", 3)],
            "Mechanical power": [_Column("W", "effort.power_w", 1)],
        },
    ),
)
_INTERVALS = _Sheet(
    "Means of episodes, and the 95 % interval of that mean",
    {
        "Without a fall": [_SURVIVAL],
        **{f"{leg.capitalize()} ankle, cm": _interval(f"{leg}_ankle_position_cm") for leg in LEGS},
        **{f"{leg.capitalize()} ankle, deg": _interval(f"{leg}_ankle_yaw_deg") for leg in LEGS},
        "Trunk, cm": _interval("trunk_position_cm"),
        "Trunk, deg": _interval("trunk_orientation_deg"),
    },
)
_LEVELS = {
    "Without a fall": [_SURVIVAL],
    **{f"{leg.capitalize()} ankle, cm": _spread(f"errors.{leg}_ankle_position_cm", "mean p95") for leg in LEGS},
    **{f"{leg.capitalize()} ankle, deg": _spread(f"errors.{leg}_ankle_yaw_deg", "mean p95") for leg in LEGS},
    "Trunk, cm": _spread("errors.trunk_position_cm", "mean"),
}
_COUNTS = {"rest.episodes", "rest.seconds", "touchdown.planned", "clearance.swings"}  # which alone make no row


def _tables(record: dict[str, Any]) -> str:
    """Every figure of every task and policy, the first simulator's unfolded."""
    parts = []
    for i, engine in enumerate(engines_of(record)):
        sheets = "".join(_sheet(sheet, runs_of(record, engine)) for sheet in SHEETS)
        parts.append(f"<details{'' if i else ' open'}><summary>In {ENGINES[engine]}</summary>{sheets}</details>")
    return _section("tables", "Every figure of every task", "".join(parts) or "<p>No task was evaluated.</p>")


def _sheet(sheet: _Sheet, runs: list[Run]) -> str:
    """A table of those runs that have a figure for it."""
    columns = [column for group in sheet.groups.values() for column in group]
    telling = [column.path.split(".") for column in columns if column.path not in _COUNTS]
    kept = [run for run in runs if any(get(run.summary, *path) is not None for path in telling)]
    lines = [(run.task, run.label, [f"<td>{_cell(run.summary, column)}</td>" for column in columns]) for run in kept]
    groups = {heading: len(group) for heading, group in sheet.groups.items()}
    return _table(sheet.title, _two_heads(groups, [column.heading for column in columns]), _lines(lines))


def _cell(summary: dict[str, Any], column: _Column) -> str:
    """A figure, with its interval in brackets if it has one."""
    paths = (column.path, *(column.interval or ()))
    values = [get(summary, *path.split(".")) for path in paths]
    words = [number(None if value is None else column.scale * value, column.digits) for value in values]
    return words[0] if column.interval is None else f"{words[0]} <small>[{words[1]}, {words[2]}]</small>"


def _table(title: str, head: str, rows: Sequence[str], kind: str = "") -> str:
    """A table that scrolls by itself where it is wider than the page; empty without rows."""
    if not rows:
        return ""
    return (
        f'<div class="scroll" role="region" tabindex="0" aria-label="{_escape(title)}"><table class="{kind}"><caption>'
        f"{_escape(title)}</caption><thead>{head}</thead><tbody>{''.join(rows)}</tbody></table></div>\n"
    )


def _head(*headings: str) -> str:
    return "<tr>" + "".join(f'<th scope="col">{heading}</th>' for heading in headings) + "</tr>"


def _two_heads(groups: dict[str, int], headings: Sequence[str], last: str = "") -> str:
    """Headings of groups by their number of columns, above those of the columns."""
    wide = "".join(f'<th scope="colgroup" colspan="{count}">{_escape(name)}</th>' for name, count in groups.items())
    ends = ('<th scope="col" rowspan="2">Task</th><th scope="col" rowspan="2">Policy</th>', "")
    end = f'<th scope="col" rowspan="2">{last}</th>' if last else ""
    return f"<tr>{ends[0]}{wide}{end}</tr>{_head(*headings)}"


def _lines(lines: Iterable[tuple[str, str, Sequence[str]]]) -> list[str]:
    """Rows of a task, a policy's label and further cells, with a rule above each task."""
    rows, before = [], None
    for task, label, cells in lines:
        first, before = ("" if task == before else ' class="first"'), task
        names = f'<th scope="row">{_escape(task)}</th><td class="name">{_escape(label)}</td>'
        rows.append(f"<tr{first}>{names}{''.join(cells)}</tr>")
    return rows


# Policies side by side


def _intervals(record: dict[str, Any]) -> str:
    """Policies beside each other, with intervals."""
    runs = runs_of(record)
    if not runs:
        return _section("intervals", "Policies side by side", "<p>No task was evaluated.</p>")
    panels = [charts.forest(record, "Episodes without a fall, %", charts.lasting, None)]
    panels += [charts.forest(record, f"Ankle {q.name} error, {q.unit}", charts.ankles(q), q.limit) for q in QUANTITIES]
    caption = (
        f"{charts.policy_key(record)} Mean and 95 % interval; errors are the mean of both ankles. The dashed line is the "
        f"paper's bound; what lies beyond the axis stands at its end with its number. {_engine_words(runs)}"
    )
    return _section("intervals", "Policies side by side", _figure("triple", panels, caption) + _sheet(_INTERVALS, runs))


def _engine_words(runs: Iterable[Run]) -> str:
    return f"Simulated in {' or '.join(ENGINES[name] for name in dict.fromkeys(run.engine for run in runs))}."


def _levels(record: dict[str, Any]) -> str:
    """The episodes of each task by their difficulty."""
    runs, columns, lines = runs_of(record), [column for group in _LEVELS.values() for column in group], []
    for run in runs:
        for level in get(run.result, "levels") or ():
            names = [f'<td class="name">{_escape(level["label"])}</td>', f"<td>{number(get(level, 'episodes'), 0)}</td>"]
            lines.append((run.task, run.label, [*names, *(f"<td>{_cell(level, column)}</td>" for column in columns)]))
    groups = {"Difficulty": 2, **{heading: len(group) for heading, group in _LEVELS.items()}}
    head = _two_heads(groups, ["level", "episodes", *(column.heading for column in columns)])
    words = (
        "<p>Stairs by riser and tread; other tasks in three parts of as many episodes, by how far a foot moves or turns in "
        f"a task step. {_engine_words(runs)}</p>"
    )
    table = _table("The same episodes, by their difficulty", head, _lines(lines))
    return _section("levels", "From easy to hard", words + table if table else "<p>Not evaluated.</p>")


# Against the paper


def _paper(record: dict[str, Any], found: list[dict[str, Any]]) -> str:
    """Our counterpart of each of the paper's figures 5 to 13, and the tasks that it has no figure of."""
    runs = runs_of(record)
    parts = [
        "<p>The paper records each task for 10 s. It claims an average error of both ankles within 5 cm and 5 deg, that the "
        "robot achieves every task, maintains its posture and avoids obstacles; it gives no success rate. Here, "
        f"{100 * LASTING_SHARE:g} % of the episodes must do what it claims, and an error counts only where at least "
        f"{100 * LEAST_SHARE:g} % of them last to the end. {_engine_words(runs) if runs else ''}</p>"
    ]
    labels = labels_of(record)
    for figure in FIGURES:
        ours = [run for run in runs if run.task in figure.tasks or (run.holds and figure is BALANCE)]
        lines = [verdict for verdict in found if verdict["about"] == f"figure {figure.number}"]
        drawn = _drawn(figure, ours) or f"<p>Not evaluated: needs {_escape(', '.join(figure.tasks))}.</p>"
        title = f"<h3>Figure {figure.number}: {_escape(figure.title)}</h3>"
        parts.append(f'<section id="figure-{figure.number}">\n{title}\n{_verdict_table(lines, labels)}{drawn}\n</section>')
    known = {task for figure in FIGURES for task in figure.tasks}
    further = "".join(_courses(run) + _trajectory(run) for run in runs if run.task not in known and not run.holds)
    beyond = f"\n{_section('further', 'Tasks beyond the paper', further)}" if further else ""
    return _section("paper", "Against the paper", "\n".join(parts)) + beyond


def _drawn(figure: PaperFigure, runs: list[Run]) -> str:
    """What is drawn for a figure of the paper."""
    if figure is BALANCE:
        return _sheet(_REST, runs) + "".join(_courses_of(runs, policy) for policy in dict.fromkeys(r.policy for r in runs))
    courses = "" if figure is TRAJECTORIES else "".join(map(_courses, runs))
    return courses + ("".join(map(_trajectory, runs)) if figure in (TRAJECTORIES, OBSTACLES) else "")


def _verdict_table(found: Sequence[dict[str, Any]], labels: dict[str, str]) -> str:
    rows = []
    for verdict in found:
        words = "".join(f'<td class="words">{_escape(verdict[name])}</td>' for name in ("claim", "figure"))
        cells = [words, f"<td>{verdict['bound']}</td>", f"<td>{_badge(verdict['met'])}</td>"]
        rows.append((verdict["task"], labels[verdict["policy"]], cells))
    head = _head("Task", "Policy", "The paper's claim", "Our figure", "Met if", "Verdict")
    return _table("Verdicts", head, _lines(rows), "left")


def _figure(kind: str, panels: Iterable[str], caption: str) -> str:
    parts = "".join(f"<div>{panel}</div>" for panel in panels)
    return f'<figure><div class="{kind}">{parts}</div><figcaption>{caption}</figcaption></figure>\n'


def _courses(run: Run) -> str:
    """Position and orientation errors over time; empty if they were not recorded."""
    course = get(run.result, "course") or {}
    if not course.get("time_s"):
        return ""
    caption = (
        f"{_title(run)}. {charts.NODE_KEY} Means over the robots that are still up; {number(percent(run.lasting), 1)} % of "
        f"{number(get(run.summary, 'episodes'), 0)} are at the end."
    )
    return _figure("pair", (charts.errors_over_time(course, quantity, run.task, 460) for quantity in QUANTITIES), caption)


def _courses_of(runs: list[Run], policy: str) -> str:
    """The position errors of several tasks over time, of one policy."""
    kept = [run for run in runs if run.policy == policy and get(run.result, "course", "time_s")]
    panels = (
        f"<h4>{_escape(run.task)}</h4>{charts.errors_over_time(run.result['course'], POSITION, run.task, 360)}"
        for run in kept
    )
    caption = f"<b>{_escape(kept[0].label)}</b>, before and after the command stops. {charts.NODE_KEY}" if kept else ""
    return _figure("triple", panels, caption) if kept else ""


def _trajectory(run: Run) -> str:
    """Where the nodes should go and went; empty if that was not recorded."""
    views = charts.views(run)
    caption = f"{_title(run)}, first episode, until the robot falls if it does. {charts.PATH_KEY}"
    return _figure("wide", views, caption) if views else ""


def _title(run: Run) -> str:
    return f"<b>{_escape(run.task)}, {_escape(run.label)}</b>"


# Two simulators and robustness


def _simulators(record: dict[str, Any], found: list[dict[str, Any]]) -> str:
    """MJX beside MuJoCo C, and C with a converged solver."""
    rows = verdicts.parities(record)
    if not rows:
        return _section("simulators", "Two simulators", "<p>Only one simulator was evaluated; --engine both runs both.</p>")
    words = (
        "<p>The same episodes in MJX and in MuJoCo C with the solver of the model; beside them, C with its solver run until "
        f"it converges. Met: fall rates at most {PARITY[0]:g} percentage points apart, ankle errors at most {PARITY[1]:g} "
        f"mm and {PARITY[2]:g} deg. Errors are means of both ankles; apart is the difference of the one that differs more."
    )
    groups = {"Falls, %": "points", "Ankle position error, cm": "mm", "Ankle orientation error, deg": "deg"}
    headings = [name for unit in groups.values() for name in ("MJX", "C", f"apart, {unit}", "C converged")]
    head = _two_heads(dict.fromkeys(groups, 4), headings, "Verdict")
    return _section(
        "simulators", "Two simulators", f"{words}</p>" + _table("MJX beside C", head, _lines(map(_parity_line, rows)))
    )


def _parity_line(row: Parity) -> tuple[str, str, list[str]]:
    cells = []
    for values, apart, digits in zip(row.values, row.apart, (1, 2, 2), strict=True):
        mjx, c, converged = (number(values.get(engine), digits) for engine in ENGINES)
        cells.append(f"<td>{mjx}</td><td>{c}</td><td><b>{number(apart, digits)}</b></td><td>{converged}</td>")
    judged = [verdict["met"] for verdict in verdicts.parity_verdicts(row)]
    missed = [name for name, met in zip(("falls", "position", "orientation"), judged, strict=False) if met is False]
    met = False if missed else None if not judged or None in judged else True
    return row.run.task, row.run.label, [*cells, f'<td class="name">{_badge(met)} <small>{", ".join(missed)}</small></td>']


def _robustness(record: dict[str, Any]) -> str:
    """Survival and ankle error over the levels of each disturbance."""
    found: dict[str, Any] = get(record, "robustness") or {}
    kinds = list(dict.fromkeys(kind for by_kind in found.values() for kind in by_kind))
    if not kinds:
        return _section("robustness", "Robustness", "<p>Not evaluated; --robustness adds it.</p>")
    order, parts = list(labels_of(record)), []
    for kind in kinds:
        ladders = {order.index(policy): by_kind[kind] for policy, by_kind in found.items() if by_kind.get(kind)}
        one: Any = next(iter(ladders.values()), None)
        label = " in ".join(filter(None, (kind, get(one, "unit"))))
        panels = [charts.ladder(ladders, label, "Without a fall, %", charts.lasting, None)]
        panels.append(charts.ladder(ladders, label, "Ankle position error, cm", charts.ankles(POSITION), POSITION))
        episodes = f"{_escape(get(one, 'task') or '–')}, {number(get(one, 'episodes'), 0)} episodes at each level"
        parts.append(_figure("pair", panels, f"<b>{_escape(kind)}</b>: {episodes}, MuJoCo C. {charts.policy_key(record)}"))
    numbers = f"<details><summary>The numbers behind the curves</summary>{_ladder_table(record, kinds)}</details>"
    return _section("robustness", "Robustness", "".join(parts) + numbers)


def _ladder_table(record: dict[str, Any], kinds: list[str]) -> str:
    labels, lines = labels_of(record), []
    for kind in kinds:
        for policy, by_kind in record["robustness"].items():
            for row in get(by_kind, kind, "levels") or []:
                level = f"{row['level']:g} {get(by_kind, kind, 'unit') or ''}"
                errors = [number(mean_of(quantity.of_ankles(row))) for quantity in QUANTITIES]
                cells = [f"<td>{cell}</td>" for cell in (_escape(level), _cell(row, _SURVIVAL), *errors)]
                lines.append((kind, labels[policy], cells))
    figures = ("Without a fall, % [95 % interval]", "Ankle position error, cm", "Ankle orientation error, deg")
    head = _head("Disturbance", "Policy", "Level", *figures)
    return _table("Survival, and mean errors of both ankles", head, _lines(lines))


# Definitions and style

_DEFINITIONS = f"""<ul>
<li><b>Error</b>: distance of a node from its real-time target of the same instant, at each control step before a fall, in
cm; yaw of the ankles and whole rotation of the trunk, in deg. Mean, median, 95th percentile (95 %) and maximum are over all
steps of all episodes; over time, the mean over the robots that have not fallen.</li>
<li><b>Without a fall</b>: share of episodes that last to the end, with Wilson's 95 % interval. Time to fall: mean of those
that fall; median of all, if half of them fall.</li>
<li><b>Interval of an error</b>: of the mean over the means of the episodes, by Student's t.</li>
<li><b>Footholds</b>: the ankle against its foothold at the planned instant, whether the foot is down or not. The time is
when the ground first bears more than {100 * metrics.CONTACT_SHARE:g} % of the weight, from the middle of the swing to half
a swing after its planned end; else the touchdown is missed. No error is divided by a step of
{100 * metrics.LEAST_STEP:g} cm or less.</li>
<li><b>Clearance</b>: least height of a corner of the sole over the edge of a tread or obstacle as it passes that edge. A
swing is against a side if a corner comes within {1000 * metrics.SIDE_REACH:g} mm of it,
{1000 * metrics.SIDE_DEPTH:g} mm or more below its edge.</li>
<li><b>Rest</b>: from {metrics.SETTLE:g} s after the command came to stand still. Joint speed RMS is over all joints, sway of
the trunk in the plane about its mean; a foot has moved if it was more than {metrics.FOOT_MOVED_CM:g} cm off where it
stood.</li>
<li><b>Effort</b>: torques as applied, saturated from {100 * metrics.SATURATION:g} % of the limit; power is the sum of
|torque times joint speed|.</li>
</ul>"""

_CSS = """
:root{color-scheme:light;--ink:#1c2430;--soft:#5a6675;--rule:#d5dbe3;--pale:#f4f6f9;--trunk:#59626e;--left:#0072b2;
--right:#c2500a;--target:#0a8a3c;--actual:#ffd21f;--casing:#5b4300}
*{box-sizing:border-box}
body{margin:0 auto;padding:16px 20px 48px;max-width:1200px;color:var(--ink);background:#fff;overflow-wrap:break-word;
font:15px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,"Liberation Sans","DejaVu Sans",sans-serif}
h1{font-size:26px;line-height:1.2;margin:8px 0 14px}
h2{font-size:21px;margin:40px 0 10px;padding-top:10px;border-top:2px solid var(--ink)}
h3{font-size:17px;margin:30px 0 8px}h4{font-size:13px;margin:6px 0 2px}ul{padding-left:20px;margin:6px 0}li{margin:3px 0}
a{color:#0b5cad}code{background:var(--pale);padding:2px 5px;border-radius:3px;font-size:13px;overflow-wrap:anywhere}
.facts{display:flex;flex-wrap:wrap;gap:6px 28px;margin:0}.facts dt{font-size:12px;color:var(--soft)}.facts dd{margin:0}
nav{display:flex;flex-wrap:wrap;gap:4px 18px;margin:10px 0;padding:8px 0;border:solid var(--rule);border-width:1px 0}
details{margin:8px 0}summary{cursor:pointer;font-weight:600;padding:4px 0}
.scroll{overflow-x:auto;margin:14px 0 22px}small{color:var(--soft);font-size:11px}
table{border-collapse:collapse;font-size:12.5px;line-height:1.35;font-variant-numeric:tabular-nums;min-width:50%}
caption{text-align:left;font-weight:600;font-size:14px;padding:4px 0 6px}
th,td{padding:3px 7px;text-align:right;white-space:nowrap;border-bottom:1px solid #eaeef2}
thead th{vertical-align:bottom;background:var(--pale);border-bottom:1px solid var(--rule);white-space:normal}
tbody th{font-weight:500}th[scope=colgroup]{text-align:center;border-left:1px solid var(--rule)}
tbody th,.name,table.left td,table.left th,thead th[rowspan]{text-align:left}
td.words{white-space:normal;min-width:200px}td.words:nth-child(3){min-width:290px}
tr.first th,tr.first td{border-top:1px solid #b4bdc8}tbody tr:hover{background:#fafbe8}
.badge{white-space:nowrap;padding:1px 7px;border-radius:9px;font-weight:600;font-size:12px}
.met{color:#0b5a2b;background:#e2f4e8}.missed{color:#93190f;background:#fde8e6}.unknown{color:#4b5563;background:#eceff3}
figure{margin:14px 0 24px}figcaption{font-size:13px;color:#3c4653;margin-top:4px}
.pair,.triple{display:grid;gap:10px 18px;grid-template-columns:repeat(2,minmax(0,1fr));align-items:start}
.triple{grid-template-columns:repeat(3,minmax(0,1fr))}
svg{display:block;width:100%;height:auto}svg svg{overflow:hidden}svg path{fill:none;stroke-linejoin:round}
svg text{font-size:11px;fill:#3c4653}svg .middle{text-anchor:middle}svg .end{text-anchor:end}
svg .halo{stroke:#fff;stroke-width:3px;paint-order:stroke;fill:#111}
.grid{stroke:#d9dfe6;stroke-width:.7}.frame{stroke:#8a95a3}path.limit{stroke:#111;stroke-dasharray:5 4;stroke-width:1.2}
svg .up{fill:#e9eff6}svg .box{fill:#d3ccc0;stroke:#8d8474;stroke-width:.8}
path.trunk{stroke:var(--trunk);stroke-width:1.3;stroke-dasharray:2 3}path.left{stroke:var(--left);stroke-width:1.7}
path.right{stroke:var(--right);stroke-width:1.7;stroke-dasharray:7 3}
path.target{stroke:var(--target);stroke-width:1.9}path.casing{stroke:var(--casing);stroke-width:2.8}
path.actual{stroke:var(--actual);stroke-width:1.6}path.target,path.casing,path.actual{stroke-dasharray:none}
path.target.right,path.casing.right,path.actual.right{stroke-dasharray:6 3}
.p0{stroke:#0072b2;color:#0072b2}.p1{stroke:#c2500a;color:#c2500a}.p2{stroke:#00785a;color:#00785a}
.p3{stroke:#a3457b;color:#a3457b}.p4{stroke:#5f5f00;color:#5f5f00}.p5{stroke:#333;color:#333}
svg .mark{fill:currentColor;stroke:#fff;stroke-width:.8}.bar{stroke-width:2}.course{stroke-width:1.5}
.key{display:inline-block;margin-right:8px;white-space:nowrap}
.sample{display:inline-block;width:12px;height:12px;vertical-align:-1px}
.line{display:inline-block;width:26px;height:0;border-top:2px solid;vertical-align:4px}
.line.trunk{border-top:2px dotted var(--trunk)}.line.left{border-color:var(--left)}
.line.right{border-top:2px dashed var(--right)}.line.limit{border-top:1px dashed #111}
.line.target{border-top:3px solid var(--target)}
.line.actual{height:5px;border:1px solid var(--casing);background:var(--actual);vertical-align:2px}
.ground{display:inline-block;width:22px;height:10px;background:#e9eff6;border:1px solid #b9c7d8}
@media screen and (max-width:760px){body{padding:10px 12px 32px;font-size:16px}
.pair,.triple{grid-template-columns:minmax(0,1fr)}.wide{overflow-x:auto}.wide>div{min-width:760px}
.key{white-space:normal}svg text{font-size:12px}}
@media print{@page{size:A4 landscape;margin:12mm}body{max-width:none;padding:0;font-size:11px}table{font-size:8.5px}
th,td{padding:2px 4px}nav{display:none}figure,tr,.badge{break-inside:avoid}h2,h3,h4,caption{break-after:avoid}
.wide svg[role]{width:75%}.scroll{overflow:visible}
details::details-content{content-visibility:visible;height:auto;display:block}
*{print-color-adjust:exact;-webkit-print-color-adjust:exact}}
"""
