"""What an evaluation found as one HTML file: style and figures within, no script, nothing from any other address.

`page` is the table of contents. It takes what `evaluate.run` returns, or metrics.json holds; whatever is missing there is
left out, or said to be missing. `verdicts` sets our figures beside the paper's claims, and the simulators beside each other.
"""

from __future__ import annotations

import html
import math
import pathlib
import shlex
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

from bipedtrack import metrics
from bipedtrack.robot import LEGS

LASTING_SHARE = 0.95  # of the episodes must do what the paper claims without a number
LEAST_SHARE = 0.5  # of the episodes must last, or their error is none "over 10 s"
FARTHEST = 0.5  # of a step: feet that land farther off their footholds on average do not walk as they should
PARITY = (2.0, 5.0, 0.5)  # by which simulators may differ: percentage points of falls, mm and deg of ankle error
ENGINES = {"mjx": "MJX", "mujoco": "MuJoCo C", "converged": "MuJoCo C, converged solver"}
SIMULATORS = "two simulators"
_NODES = ("trunk", *LEGS)


class Quantity(NamedTuple):
    """An error that the paper bounds for the ankles."""

    name: str
    errors: tuple[str, ...]  # of trunk, left and right ankle, in metrics.ERRORS
    limit: float  # the paper's bound on the average
    unit: str

    @property
    def claim(self) -> str:
        """The paper's."""
        return f"average ankle {self.name} error within {self.limit:g} {self.unit}"

    @property
    def label(self) -> str:
        """Of an axis."""
        return f"{self.name.capitalize()} error, {self.unit}"

    def of_ankles(self, summary: Any, statistic: str = "mean") -> list[float | None]:
        """A statistic of left and right ankle."""
        return [_get(summary, "errors", name, statistic) for name in self.errors[1:]]


class PaperFigure(NamedTuple):
    """A figure of the paper and the tasks that answer it."""

    number: int
    title: str
    tasks: tuple[str, ...]


POSITION = Quantity("position", metrics.ERRORS[:3], 5.0, "cm")
ORIENTATION = Quantity("orientation", metrics.ERRORS[3:], 5.0, "deg")
QUANTITIES = (POSITION, ORIENTATION)
ERROR_FIGURES = (
    PaperFigure(5, "Walking down stairs", ("stairs-down",)),
    PaperFigure(6, "Walking forward", ("walk-forward",)),
    PaperFigure(7, "Walking backward", ("walk-backward",)),
    PaperFigure(8, "Sidle", ("sidle-left", "sidle-right")),
    PaperFigure(9, "Turn", ("turn-left", "turn-right")),
    PaperFigure(10, "Walking up stairs", ("stairs-up",)),
)
_MOVES = tuple(task for figure in ERROR_FIGURES for task in figure.tasks)
TRAJECTORIES = PaperFigure(11, "Trajectories in different tasks", _MOVES)
BALANCE = PaperFigure(12, "Static balance, when the command stops after some task steps", ("hold-…",))
OBSTACLES = PaperFigure(13, "Obstacle avoidance", ("obstacles",))
FIGURES = (*ERROR_FIGURES, TRAJECTORIES, BALANCE, OBSTACLES)


def page(record: dict[str, Any]) -> str:
    """The whole report as HTML."""
    found, title = verdicts(record), ", ".join(_labels(record).values()) or "no policy"
    sections = (
        _glance(record, found),
        _tables(record),
        _intervals(record),
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


# Verdicts


def verdicts(record: dict[str, Any]) -> list[dict[str, Any]]:
    """Every claim beside our figure: plain dicts, which JSON can hold.

    Keys: about ("figure 5" of the paper, or "two simulators"), task, policy, engine; claim, figure (ours) and bound, in
    words; value and limit, in unit; met, or None where nothing was measured. An error is that of the ankle with the greater
    mean. It is not met where fewer than half of the episodes last: then nothing was tracked for as long as the paper says.
    """
    runs, lines = _runs(record), []
    for figure in ERROR_FIGURES:
        for run in runs:
            lines += _tracking(figure, run) if run.task in figure.tasks else []
    for policy in _labels(record):
        lines += _over_all([run for run in runs if run.policy == policy and run.task in _MOVES])
    for run in runs:
        lines += _balance(run) if run.holds else []
    for run in runs:
        lines += _avoidance(run) if run.task in OBSTACLES.tasks else []
    return lines + [line for row in _parities(record) for line in _parity_verdicts(row)]


class _Run(NamedTuple):
    """What one engine made of a task with a policy."""

    task: str
    policy: str
    label: str  # of the policy, as HTML
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
        return _get(self.summary, "survival", "share")

    @property
    def title(self) -> str:
        """As HTML."""
        return f"<b>{_escape(self.task)}, {self.label}</b>"


class _Claim(NamedTuple):
    """A bound on one of our figures that stands for something the paper says."""

    words: str
    limit: float
    unit: str
    at_least: bool = False


_UP = _Claim("achieves the task, without a fall", 100 * LASTING_SHARE, "% of episodes", at_least=True)
_KEEPS_UP = _UP._replace(words="maintains its posture: no fall")
_KEEPS_FEET = _UP._replace(words=f"maintains its posture: feet stay within {metrics.FOOT_MOVED_CM:g} cm")
_AVOIDS = _Claim("avoids obstacles: no sole comes against the side of one", 0.0, "% of swings")
_ALIKE = (
    _Claim(f"fall rates of MJX and C within {PARITY[0]:g} percentage points", PARITY[0], "percentage points"),
    _Claim(f"ankle position errors of MJX and C within {PARITY[1]:g} mm", PARITY[1], "mm"),
    _Claim(f"ankle orientation errors of MJX and C within {PARITY[2]:g} deg", PARITY[2], "deg"),
)


def _verdict(
    figure: PaperFigure, run: _Run, claim: _Claim, value: float | None, but: str = "", detail: str = ""
) -> dict[str, Any]:
    """A line about a figure of the paper; `but`: why it is not met all the same, `detail`: more of our figure."""
    return _judge({"about": f"figure {figure.number}", **_names(run)}, claim, value, but, detail)


def _names(run: _Run) -> dict[str, str]:
    return {"task": run.task, "policy": run.policy, "engine": run.engine}


def _judge(subject: dict[str, str], claim: _Claim, value: float | None, but: str = "", detail: str = "") -> dict[str, Any]:
    words, met = "not measured", None
    if value is not None:
        within = value >= claim.limit - 1e-9 if claim.at_least else value <= claim.limit + 1e-9
        met = within and not but
        words = f"{value:.{1 if '%' in claim.unit else 2}f} {claim.unit}"
        words += (f" ({detail})" if detail else "") + (f", but {but}" if but else "")
    return {
        **subject,
        **{
            "claim": claim.words,
            "figure": words,
            "bound": f"at {'least' if claim.at_least else 'most'} {claim.limit:g} {claim.unit}",
        },
        **{"value": value, "limit": claim.limit, "unit": claim.unit, "met": met},
    }


def _tracking(figure: PaperFigure, run: _Run) -> list[dict[str, Any]]:
    """Whether a task is tracked as the paper's are: both ankles, and nobody falls."""
    lines = []
    for quantity in QUANTITIES:
        means = quantity.of_ankles(run.summary)
        detail = ", ".join(f"{leg} {_number(mean)}" for leg, mean in zip(LEGS, means, strict=True))
        claim = _Claim(quantity.claim, quantity.limit, quantity.unit)
        lines.append(_verdict(figure, run, claim, _greatest(means), _too_short(run.lasting), detail))
    return [*lines, _verdict(figure, run, _UP, _percent(run.lasting), _off_footholds(run))]


def _off_footholds(run: _Run) -> str:
    """Why a task is not achieved although nobody falls: the feet do not go where they should."""
    share = _get(run.summary, "touchdown", "foothold_per_step", "mean")
    return "" if share is None or share <= FARTHEST else f"feet land {100 * share:.0f} % of a step off their footholds"


def _over_all(runs: list[_Run]) -> list[dict[str, Any]]:
    """The paper's summary of its figures: the mean over the tasks of figures 5 to 10, for the runs of one policy."""
    lines = []
    for quantity in QUANTITIES if runs else ():
        legs = zip(*(quantity.of_ankles(run.summary) for run in runs), strict=True)
        claim = _Claim(f"{quantity.claim}, over all tasks", quantity.limit, quantity.unit)
        subject = runs[0]._replace(task=f"mean of {len(runs)} tasks")
        but = _too_short(_mean(run.lasting for run in runs))
        lines.append(_verdict(TRAJECTORIES, subject, claim, _greatest(map(_mean, legs)), but))
    return lines


def _balance(run: _Run) -> list[dict[str, Any]]:
    """Whether the posture is kept after a task: nobody falls, the feet stay where they are, and are where they should."""
    moved, error = _get(run.summary, "rest", "foot_moved_share"), _greatest(POSITION.of_ankles(run.summary))
    but = _too_short(run.lasting)
    if error is not None and error > POSITION.limit:
        but = but or f"the ankles are {error:.1f} cm off their targets on average"
    stayed = None if moved is None else 100 * (1 - moved)
    return [_verdict(BALANCE, run, _KEEPS_UP, _percent(run.lasting)), _verdict(BALANCE, run, _KEEPS_FEET, stayed, but)]


def _avoidance(run: _Run) -> list[dict[str, Any]]:
    """Whether the obstacle course is walked as planned, and no foot comes against an obstacle."""
    touched, but = _percent(_get(run.summary, "clearance", "side_contact_share")), _too_short(run.lasting)
    if not _get(run.summary, "clearance", "swings"):
        but = but or "no foot passed the edge of an obstacle"
    return [*_tracking(OBSTACLES, run), _verdict(OBSTACLES, run, _AVOIDS, touched, but)]


class _Parity(NamedTuple):
    """A task with a policy on the simulators: falls in %, errors of both ankles in cm and in deg."""

    run: _Run
    values: list[dict[str, float | None]]  # of the three, by engine
    apart: list[float | None]  # MJX and C: percentage points, mm, deg; of the ankle that differs more
    both: bool  # MJX and C


def _parities(record: dict[str, Any]) -> list[_Parity]:
    """The tasks that more than one engine has run."""
    by_engine = {engine: {run[:2]: run for run in _runs(record, engine)} for engine in ENGINES}
    rows = []
    for run in _runs(record):
        of = {engine: runs[run[:2]].summary for engine, runs in by_engine.items() if run[:2] in runs}
        if len(of) < 2:
            continue
        lasting = {engine: _percent(_get(summary, "survival", "share")) for engine, summary in of.items()}
        values: list[dict[str, float | None]] = [{k: None if v is None else 100 - v for k, v in lasting.items()}]
        apart = [_difference(lasting.get("mjx"), lasting.get("mujoco"))]
        for quantity, scale in zip(QUANTITIES, (10, 1), strict=True):
            values.append({engine: _mean(quantity.of_ankles(summary)) for engine, summary in of.items()})
            legs = zip(quantity.of_ankles(of.get("mjx")), quantity.of_ankles(of.get("mujoco")), strict=True)
            greatest = _greatest(_difference(*pair) for pair in legs)
            apart.append(None if greatest is None else scale * greatest)
        rows.append(_Parity(run, values, apart, "mjx" in of and "mujoco" in of))
    return rows


def _parity_verdicts(row: _Parity) -> list[dict[str, Any]]:
    """Falls, position and orientation, where both simulators ran."""
    subject = {"about": SIMULATORS, **_names(row.run), "engine": "mjx, mujoco"}
    return [_judge(subject, claim, value) for claim, value in zip(_ALIKE, row.apart, strict=True) if row.both]


def _too_short(share: float | None) -> str:
    """Why an error says little, if too few episodes last."""
    return "" if share is None or share >= LEAST_SHARE else f"only {100 * share:.0f} % of episodes last to the end"


# Reading the record


def _get(tree: Any, *path: str) -> Any:
    """What lies at a path, None where anything on the way is missing, or for a number that is not finite."""
    for key in path:
        tree = tree.get(key) if isinstance(tree, dict) else None
    return None if isinstance(tree, float) and not math.isfinite(tree) else tree


def _runs(record: dict[str, Any], engine: str | None = None) -> list[_Run]:
    """What an engine has run; without one, each task in the first of ENGINES that has."""
    labels, runs = _labels(record), []
    for task, policy, results in _results(record):
        for name in [engine] if engine else ENGINES:
            if _get(results, name, "summary"):
                boxes = _get(record, "tasks", task, "boxes") or []
                runs.append(_Run(task, policy, labels[policy], name, results[name], boxes))
                break
    return runs


def _results(record: dict[str, Any]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    for task in _get(record, "tasks") or {}:
        for policy, results in (_get(record, "tasks", task, "policies") or {}).items():
            yield task, policy, results


def _engines(record: dict[str, Any]) -> list[str]:
    return [engine for engine in ENGINES if _runs(record, engine)]


def _labels(record: dict[str, Any]) -> dict[str, str]:
    """Short names of the policies, as HTML, in the order of evaluation; whole paths where short ones would be the same."""
    evaluated = [policy for _, policy, _ in _results(record)]
    short = {}
    for name in [*(_get(record, "policies") or {}), *evaluated, *(_get(record, "robustness") or {})]:
        path = pathlib.PurePath(name)
        short[name] = (path.parent.name if path.name == "policy.npz" else path.name.removesuffix(".npz")) or name
    taken = list(short.values())
    return {name: _escape(label if taken.count(label) == 1 else name) for name, label in short.items()}


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def _greatest(values: Iterable[float | None]) -> float | None:
    return max((value for value in values if value is not None), default=None)


def _difference(one: float | None, other: float | None) -> float | None:
    return None if one is None or other is None else abs(one - other)


def _percent(share: float | None) -> float | None:
    return None if share is None else 100 * share


def _number(value: Any, digits: int = 2) -> str:
    """A number as text, a dash where there is none."""
    known = isinstance(value, int | float) and math.isfinite(value)
    return f"{value:.{digits}f}" if known else "–"


def _escape(text: Any) -> str:
    return html.escape(str(text), quote=True)


# Header, verdicts at a glance, origins


def _header(record: dict[str, Any]) -> str:
    """What was evaluated, how, and where to find it."""
    options = _get(record, "options") or {}
    facts = {
        "Policies": ", ".join(_labels(record).values()) or "none",
        "Tasks": len(_get(record, "tasks") or {}),
        **{f"{name.capitalize()} of each task": _escape(options.get(name, "–")) for name in ("episodes", "seconds")},
        "Seed": _escape(options.get("seed", "–")),
        "Simulators": "; ".join(ENGINES[engine] for engine in _engines(record)) or "none",
    }
    listed = "".join(f"<div><dt>{name}</dt><dd>{value}</dd></div>" for name, value in facts.items())
    links = {
        **{"glance": "At a glance", "tables": "Every figure", "intervals": "Side by side", "paper": "Against the paper"},
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
    for policy, label in _labels(record).items():
        cells = [_count([v["met"] for v in found if (v["policy"], v["about"]) == (policy, about)]) for about in columns]
        rows.append(f'<tr><th scope="row">{label}</th>{"".join(cells)}</tr>')
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
        f'<tr><th scope="row">{_escape(task)}</th><td class="words">{_escape(_get(entry, "ranges") or "–")}</td>'
        f"<td>{_number(_get(entry, 'seconds'), 1)}</td></tr>"
        for task, entry in (_get(record, "tasks") or {}).items()
    ]
    table = _table("What the episodes are drawn from", _head("Task", "Ranges", "Seconds"), ranges, "left")
    versions, options = (_tree(_get(record, name) or {}) for name in ("versions", "options"))
    provenance = [
        f"<details><summary>{_escape(name)}</summary>{_tree(origin) if origin else '<p>Nothing was trained.</p>'}</details>"
        for name, origin in (_get(record, "policies") or {}).items()
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
_COUNTS = {"rest.episodes", "rest.seconds", "touchdown.planned", "clearance.swings"}  # which alone make no row


def _tables(record: dict[str, Any]) -> str:
    """Every figure of every task and policy, the first simulator's unfolded."""
    parts = []
    for i, engine in enumerate(_engines(record)):
        sheets = "".join(_sheet(sheet, _runs(record, engine)) for sheet in SHEETS)
        parts.append(f"<details{'' if i else ' open'}><summary>In {ENGINES[engine]}</summary>{sheets}</details>")
    return _section("tables", "Every figure of every task", "".join(parts) or "<p>No task was evaluated.</p>")


def _sheet(sheet: _Sheet, runs: list[_Run]) -> str:
    """A table of those runs that have a figure for it."""
    columns = [column for group in sheet.groups.values() for column in group]
    telling = [column.path.split(".") for column in columns if column.path not in _COUNTS]
    kept = [run for run in runs if any(_get(run.summary, *path) is not None for path in telling)]
    lines = [(run, [f"<td>{_cell(run.summary, column)}</td>" for column in columns]) for run in kept]
    groups = {heading: len(group) for heading, group in sheet.groups.items()}
    return _table(sheet.title, _two_heads(groups, [column.heading for column in columns]), _lines(lines))


def _cell(summary: dict[str, Any], column: _Column) -> str:
    """A figure, with its interval in brackets if it has one."""
    paths = (column.path, *(column.interval or ()))
    values = [_get(summary, *path.split(".")) for path in paths]
    words = [_number(None if value is None else column.scale * value, column.digits) for value in values]
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


def _lines(lines: Iterable[tuple[_Run, Sequence[str]]]) -> list[str]:
    """Rows that begin with task and policy, a rule above each task."""
    rows, before = [], None
    for run, cells in lines:
        first, before = ("" if run.task == before else ' class="first"'), run.task
        names = f'<th scope="row">{_escape(run.task)}</th><td class="name">{run.label}</td>'
        rows.append(f"<tr{first}>{names}{''.join(cells)}</tr>")
    return rows


# Policies side by side

_Estimate = tuple[float | None, float | None, float | None]  # mean and the ends of its interval
_Estimator = Callable[[dict[str, Any]], _Estimate]  # of a summary


def _lasting(summary: dict[str, Any]) -> _Estimate:
    """Episodes without a fall, %."""
    share, low, high = (_percent(_get(summary, "survival", name)) for name in ("share", "share_low", "share_high"))
    return share, low, high


def _ankles(quantity: Quantity) -> _Estimator:
    """The mean over both ankles, their intervals averaged: never narrower than the interval of that mean."""

    def estimate(summary: dict[str, Any]) -> _Estimate:
        names = "episode_mean", "episode_low", "episode_high"
        mean, low, high = (_mean(quantity.of_ankles(summary, name)) for name in names)
        return mean, low, high

    return estimate


def _intervals(record: dict[str, Any]) -> str:
    """Policies beside each other, with intervals."""
    runs = _runs(record)
    if not runs:
        return _section("intervals", "Policies side by side", "<p>No task was evaluated.</p>")
    charts = [_forest(record, "Episodes without a fall, %", _lasting, None)]
    charts += [_forest(record, f"Ankle {q.name} error, {q.unit}", _ankles(q), q.limit) for q in QUANTITIES]
    caption = (
        f"{_policy_key(record)} Mean and 95 % interval; errors are the mean of both ankles. The dashed line is the paper's "
        f"bound; what lies beyond the axis stands at its end with its number. {_engine_words(runs)}"
    )
    return _section("intervals", "Policies side by side", _figure("triple", charts, caption) + _sheet(_INTERVALS, runs))


def _engine_words(runs: Iterable[_Run]) -> str:
    return f"Simulated in {' or '.join(ENGINES[name] for name in dict.fromkeys(run.engine for run in runs))}."


def _forest(record: dict[str, Any], title: str, estimate: _Estimator, limit: float | None) -> str:
    """A line for each task and policy: a mark at the mean and a bar over its interval."""
    order = list(_labels(record))
    rows = [(run, *estimate(run.summary)) for run in _runs(record)]
    top = 100.0 if limit is None else _top([value for _, *values in rows for value in values], limit)
    tasks = len({run.task for run, *_ in rows})
    axes = _Axes(360, _TOP + _BOTTOM + 13 * len(rows) + 8 * tasks, (0, top), (0, 1), left=122, right=34)
    parts, y, before = [_grid(axes, title, "")], float(_TOP), None
    for run, mean, low, high in rows:
        if run.task != before:
            y, before = y + 8, run.task
            parts.append(f'<text class="end" x="{axes.left - 6}" y="{y + 10:.0f}">{_escape(run.task)}</text>')
        y += 13
        parts.append(_whisker(axes, order.index(run.policy), y - 7, mean, low, high))
    if limit is not None:
        parts.append(f'<path class="limit" d="M{axes.x(limit):.1f} {_TOP}V{axes.bottom}"/>')
    return _svg(axes, parts, f"{title}: mean and interval for each task and policy; the table below has the numbers")


def _whisker(axes: _Axes, index: int, y: float, mean: float | None, low: float | None, high: float | None) -> str:
    """A policy's mark with its bar; beyond the axis, at its end and with the number."""
    if mean is None:
        return ""
    end, bar, beyond = axes.x_range[1], "", ""
    if low is not None and high is not None:
        left, right = (axes.x(min(max(value, 0), end)) for value in (low, high))
        bar = f'<path class="p{index % 6} bar" d="M{left:.1f} {y:.1f}H{right:.1f}"/>'
    if mean > end:
        beyond = f'<text x="{axes.x(end) + 6:.1f}" y="{y + 4:.1f}">{mean:.0f}</text>'
    return bar + _mark(index, axes.x(min(mean, end)), y) + beyond


_SHAPES = ("M-4 0a4 4 0 1 0 8 0a4 4 0 1 0 -8 0", "M-4 -4H4V4H-4Z", "M0 -5L5 4H-5Z", "M0 -5L5 0L0 5L-5 0Z", "M0 5L5 -4H-5Z")


def _mark(index: int, x: float, y: float) -> str:
    """A policy's mark, told apart by shape and colour."""
    return f'<path class="p{index % 6} mark" transform="translate({x:.1f} {y:.1f})" d="{_SHAPES[index % len(_SHAPES)]}"/>'


def _policy_key(record: dict[str, Any]) -> str:
    """Which mark is which policy."""
    sample = '<span class="key"><svg class="sample" viewBox="-6 -6 12 12" aria-hidden="true">{}</svg> {}</span>'
    return " ".join(sample.format(_mark(i, 0, 0), label) for i, label in enumerate(_labels(record).values()))


# Against the paper


def _paper(record: dict[str, Any], found: list[dict[str, Any]]) -> str:
    """Our counterpart of each of the paper's figures 5 to 13, and the tasks that it has no figure of."""
    runs = _runs(record)
    parts = [
        "<p>The paper records each task for 10 s. It claims an average error of both ankles within 5 cm and 5 deg, that the "
        "robot achieves every task, maintains its posture and avoids obstacles; it gives no success rate. Here, "
        f"{100 * LASTING_SHARE:g} % of the episodes must do what it claims, and an error counts only where at least "
        f"{100 * LEAST_SHARE:g} % of them last to the end. {_engine_words(runs) if runs else ''}</p>"
    ]
    labels = _labels(record)
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


def _drawn(figure: PaperFigure, runs: list[_Run]) -> str:
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
        rows.append((_Run(verdict["task"], verdict["policy"], labels[verdict["policy"]], "", {}, []), cells))
    head = _head("Task", "Policy", "The paper's claim", "Our figure", "Met if", "Verdict")
    return _table("Verdicts", head, _lines(rows), "left")


def _figure(kind: str, panels: Iterable[str], caption: str) -> str:
    parts = "".join(f"<div>{panel}</div>" for panel in panels)
    return f'<figure><div class="{kind}">{parts}</div><figcaption>{caption}</figcaption></figure>\n'


def _courses(run: _Run) -> str:
    """Position and orientation errors over time; empty if they were not recorded."""
    course = _get(run.result, "course") or {}
    if not course.get("time_s"):
        return ""
    caption = (
        f"{run.title}. {_NODE_KEY} Means over the robots that are still up; {_number(_percent(run.lasting), 1)} % of "
        f"{_number(_get(run.summary, 'episodes'), 0)} are at the end."
    )
    return _figure("pair", (_course(course, quantity, run.task, 460) for quantity in QUANTITIES), caption)


def _courses_of(runs: list[_Run], policy: str) -> str:
    """The position errors of several tasks over time, of one policy."""
    kept = [run for run in runs if run.policy == policy and _get(run.result, "course", "time_s")]
    panels = (f"<h4>{_escape(run.task)}</h4>{_course(run.result['course'], POSITION, run.task, 360)}" for run in kept)
    caption = f"<b>{kept[0].label}</b>, before and after the command stops. {_NODE_KEY}" if kept else ""
    return _figure("triple", panels, caption) if kept else ""


def _course(course: dict[str, Any], quantity: Quantity, task: str, width: int) -> str:
    """The errors of the three nodes over time, with the paper's bound, before the share of robots that are up."""
    time, curves = course["time_s"], [course.get(name) or [] for name in quantity.errors]
    peak = _greatest(value for curve in curves for value in curve) or 0.0
    top = _top([peak], quantity.limit)
    axes = _Axes(width, 220, (0, max(time[-1], 1e-3)), (0, top))
    parts = [_area(axes, time, course.get("alive_share") or []), _grid(axes, "Time, s", quantity.label)]
    parts += [_curve(axes, time, curve, node) for node, curve in zip(_NODES, curves, strict=True)]
    parts.append(_bound(axes, quantity))
    means = ", ".join(f"{node} {_number(_mean(curve))}" for node, curve in zip(_NODES, curves, strict=True))
    words = f"{quantity.label}, over {time[-1]:.0f} s of {task}; means over that time: {means}"
    if peak > top:
        parts.append(f'<text class="halo" x="{axes.left + 4}" y="{_TOP + 11}">up to {peak:.0f} {quantity.unit}</text>')
        words += f"; cut off at {top:g}, the highest is {peak:.0f}"
    return _svg(axes, parts, words)


def _bound(axes: _Axes, quantity: Quantity) -> str:
    """The paper's bound as a level line, with its number."""
    y, right = axes.y(quantity.limit), axes.width - axes.right
    words = f'<text class="end halo" x="{right - 3}" y="{y - 4:.1f}">{quantity.limit:g} {quantity.unit}</text>'
    return f'<path class="limit" d="M{axes.left} {y:.1f}H{right}"/>{words}'


def _top(values: Iterable[float | None], limit: float) -> float:
    """The upper end of an axis of errors: the limit is in sight, and so is all that lies below six times it."""
    return min(max(1.05 * (_greatest(values) or 0), 1.4 * limit), 6 * limit)


def _trajectory(run: _Run) -> str:
    """Where the nodes should go and went, from the side and from above; empty if that was not recorded."""
    paths = {side: _get(run.result, "path", side) or {} for side in ("target", "measured")}
    points = [point for nodes in paths.values() for line in nodes.values() for point in line]
    if not points:
        return ""
    boxes = [box for box in run.boxes if box[2] + box[5] / 2 > 0]
    across = [v for box in boxes for _, v in _outline(box, None) if abs(v) < 0.6]
    x, y, z = (_range([point[i] for point in points], least) for i, least in enumerate((0.4, 0.4, 0.2)))
    y = _range([*y, *across], 0.4)
    targets = [point for line in paths["target"].values() for point in line] or points
    along = max((0, 1), key=lambda i: max(point[i] for point in targets) - min(point[i] for point in targets))
    side = _Axes(960, 270, (x, y)[along], (min(z[0], 0.0), z[1]))
    views = [
        _view(side, paths, boxes, (along, 2), f"Side view of {run.task}, {run.policy}"),
        _view(_equal(x, y), paths, boxes, (0, 1), f"Top view of {run.task}, {run.policy}"),
    ]
    return _figure("wide", views, f"{run.title}, first episode, until the robot falls if it does. {_PATH_KEY}")


def _equal(x: tuple[float, float], y: tuple[float, float]) -> _Axes:
    """Axes with the same scale for both ranges; the first is widened where there is room."""
    axes = _Axes(960, 0, x, y)
    inner = axes.width - axes.left - axes.right
    scale = min(inner / (x[1] - x[0]), 340 / (y[1] - y[0]))  # px for each m
    middle, half = (x[0] + x[1]) / 2, inner / scale / 2
    return axes._replace(height=round(_TOP + _BOTTOM + scale * (y[1] - y[0])), x_range=(middle - half, middle + half))


def _view(axes: _Axes, paths: dict[str, Any], boxes: list[list[float]], plane: tuple[int, int], title: str) -> str:
    """Two coordinates of the nodes: boxes, targets, and above them what was measured."""
    i, j = plane
    outlines = dict.fromkeys(_closed(axes, _outline(box, i if j == 2 else None)) for box in boxes)
    parts = [*outlines, _grid(axes, f"{title.split(' of ')[0]}: {'xyz'[i]}, m", f"{'xyz'[j]}, m")]
    for side, kind in (("target", "target"), ("measured", "casing"), ("measured", "actual")):
        for node, points in paths[side].items():
            parts.append(_curve(axes, [p[i] for p in points], [p[j] for p in points], f"{kind} {node}"))
    return _svg(axes, parts, f"{title}, {'xyz'[i]} and {'xyz'[j]} in m: {_ends(paths) or 'no end'}")


def _ends(paths: dict[str, Any]) -> str:
    """Where the nodes end, in words."""
    words = []
    for node in _NODES:
        ends = [(paths[side].get(node) or [[]])[-1] for side in ("measured", "target")]
        real, wanted = (", ".join(f"{value:.2f}" for value in end) for end in ends)
        words += [f"{node} ends at ({real}), its target at ({wanted})"] if real and wanted else []
    return "; ".join(words)


def _outline(box: list[float], along: int | None) -> list[tuple[float, float]]:
    """The corners of a box seen from above; or, above the ground, from the side with axis `along` to the right."""
    x, y, z, length, width, height, yaw = box
    cosine, sine = math.cos(yaw), math.sin(yaw)
    corners = [(s * length / 2, t * width / 2) for s, t in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
    flat = [(x + cosine * u - sine * v, y + sine * u + cosine * v) for u, v in corners]
    if along is None:
        return flat
    places, bottom, top = [corner[along] for corner in flat], max(z - height / 2, 0.0), z + height / 2
    return [(min(places), bottom), (min(places), top), (max(places), top), (max(places), bottom)]


def _range(values: Sequence[float], least: float) -> tuple[float, float]:
    """A range around the values with a margin, at least so wide."""
    low, high = min(values), max(values)
    half = max(1.08 * (high - low), least) / 2
    return (low + high) / 2 - half, (low + high) / 2 + half


# Two simulators and robustness


def _simulators(record: dict[str, Any], found: list[dict[str, Any]]) -> str:
    """MJX beside MuJoCo C, and C with a converged solver."""
    rows = _parities(record)
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


def _parity_line(row: _Parity) -> tuple[_Run, list[str]]:
    cells = []
    for values, apart, digits in zip(row.values, row.apart, (1, 2, 2), strict=True):
        mjx, c, converged = (_number(values.get(engine), digits) for engine in ENGINES)
        cells.append(f"<td>{mjx}</td><td>{c}</td><td><b>{_number(apart, digits)}</b></td><td>{converged}</td>")
    judged = [verdict["met"] for verdict in _parity_verdicts(row)]
    missed = [name for name, met in zip(("falls", "position", "orientation"), judged, strict=False) if met is False]
    met = False if missed else None if not judged or None in judged else True
    return row.run, [*cells, f'<td class="name">{_badge(met)} <small>{", ".join(missed)}</small></td>']


def _robustness(record: dict[str, Any]) -> str:
    """Survival and ankle error over the levels of each disturbance."""
    found: dict[str, Any] = _get(record, "robustness") or {}
    kinds = list(dict.fromkeys(kind for by_kind in found.values() for kind in by_kind))
    if not kinds:
        return _section("robustness", "Robustness", "<p>Not evaluated; --robustness adds it.</p>")
    order, parts = list(_labels(record)), []
    for kind in kinds:
        ladders = {order.index(policy): by_kind[kind] for policy, by_kind in found.items() if by_kind.get(kind)}
        one: Any = next(iter(ladders.values()), None)
        label = " in ".join(filter(None, (kind, _get(one, "unit"))))
        panels = [_ladder(ladders, label, "Without a fall, %", _lasting, None)]
        panels.append(_ladder(ladders, label, "Ankle position error, cm", _ankles(POSITION), POSITION))
        episodes = f"{_escape(_get(one, 'task') or '–')}, {_number(_get(one, 'episodes'), 0)} episodes at each level"
        parts.append(_figure("pair", panels, f"<b>{_escape(kind)}</b>: {episodes}, MuJoCo C. {_policy_key(record)}"))
    numbers = f"<details><summary>The numbers behind the curves</summary>{_ladder_table(record, kinds)}</details>"
    return _section("robustness", "Robustness", "".join(parts) + numbers)


def _ladder(ladders: dict[int, Any], x_label: str, y_label: str, estimate: _Estimator, bound: Quantity | None) -> str:
    """One figure over the levels of a disturbance, a curve for each policy by its index."""
    rows = [(i, row["level"], *estimate(row)) for i, ladder in ladders.items() for row in _get(ladder, "levels") or []]
    top = 104.0 if bound is None else _top([value for _, _, *values in rows for value in values], bound.limit)
    axes = _Axes(460, 220, _range([row[1] for row in rows] or [0.0], 0.1), (0, top))
    parts = [_grid(axes, x_label, y_label)]
    for i in ladders:
        own = [row for row in rows if row[0] == i]
        parts.append(_curve(axes, [row[1] for row in own], [row[2] for row in own], f"p{i % 6} course"))
    for i, level, mean, low, high in rows:
        if mean is not None and mean <= top:
            ends = [axes.y(min(max(value, 0), top)) for value in (low, high) if value is not None]
            parts += (
                [f'<path class="p{i % 6} bar" d="M{axes.x(level):.1f} {ends[0]:.1f}V{ends[1]:.1f}"/>'] if ends[1:] else []
            )
            parts.append(_mark(i, axes.x(level), axes.y(mean)))
    if bound is not None:
        parts.append(_bound(axes, bound))
    return _svg(axes, parts, f"{y_label}, over {x_label}: {'; '.join(f'{row[1]:g}: {_number(row[2])}' for row in rows)}")


def _ladder_table(record: dict[str, Any], kinds: list[str]) -> str:
    labels, lines = _labels(record), []
    for kind in kinds:
        for policy, by_kind in record["robustness"].items():
            for row in _get(by_kind, kind, "levels") or []:
                level = f"{row['level']:g} {_get(by_kind, kind, 'unit') or ''}"
                errors = [_number(_mean(quantity.of_ankles(row))) for quantity in QUANTITIES]
                cells = [f"<td>{cell}</td>" for cell in (_escape(level), _cell(row, _SURVIVAL), *errors)]
                lines.append((_Run(kind, policy, labels[policy], "", {}, []), cells))
    figures = ("Without a fall, % [95 % interval]", "Ankle position error, cm", "Ankle orientation error, deg")
    head = _head("Disturbance", "Policy", "Level", *figures)
    return _table("Survival, and mean errors of both ankles", head, _lines(lines))


# Drawing

_TOP, _BOTTOM = 8, 36  # px above and below the area of a plot


class _Axes(NamedTuple):
    """A plot of width x height px over two ranges."""

    width: int
    height: int
    x_range: tuple[float, float]
    y_range: tuple[float, float]
    left: int = 46
    right: int = 12

    @property
    def bottom(self) -> int:
        """Of the area, px from the top."""
        return self.height - _BOTTOM

    def x(self, value: float) -> float:
        """px from the left."""
        low, high = self.x_range
        return self.left + (value - low) / (high - low) * (self.width - self.left - self.right)

    def y(self, value: float) -> float:
        """px from the top."""
        low, high = self.y_range
        return self.bottom - (value - low) / (high - low) * (self.bottom - _TOP)


def _svg(axes: _Axes, parts: Iterable[str], words: str) -> str:
    """A plot, and what it shows in words for those who cannot see it."""
    size = f'viewBox="0 0 {axes.width} {axes.height}"'
    return f'<svg {size} role="img" aria-label="{_escape(words)}">{"".join(parts)}</svg>'


def _grid(axes: _Axes, x_label: str, y_label: str) -> str:
    """Lines at round values with their numbers, and names of the axes; without a name, no vertical axis."""
    right, parts = axes.width - axes.right, []
    for value, text in _ticks(*axes.x_range, 8):
        parts.append(f'<path class="grid" d="M{axes.x(value):.1f} {_TOP}V{axes.bottom}"/>')
        parts.append(f'<text class="middle" x="{axes.x(value):.1f}" y="{axes.bottom + 14}">{text}</text>')
    for value, text in _ticks(*axes.y_range, 5) if y_label else ():
        parts.append(f'<path class="grid" d="M{axes.left} {axes.y(value):.1f}H{right}"/>')
        parts.append(f'<text class="end" x="{axes.left - 5}" y="{axes.y(value) + 4:.1f}">{text}</text>')
    turned = f'transform="translate(12 {(_TOP + axes.bottom) / 2:.0f}) rotate(-90)"'
    parts.append(f'<path class="frame" d="M{axes.left} {_TOP}V{axes.bottom}H{right}"/>')
    parts.append(f'<text class="middle" x="{(axes.left + right) / 2:.0f}" y="{axes.height - 5}">{_escape(x_label)}</text>')
    parts.append(f'<text class="middle" {turned}>{_escape(y_label)}</text>')
    return "".join(parts)


def _ticks(low: float, high: float, most: int) -> list[tuple[float, str]]:
    """Round values in a range, at most about so many, and their text."""
    least = (high - low) / most
    power = 10.0 ** math.floor(math.log10(least))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= 0.999 * least)
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [(i * step, f"{i * step:.{digits}f}") for i in range(first, last + 1)]


def _clipped(axes: _Axes, kind: str, steps: str) -> str:
    """A path in px from the upper left corner of the plot's area, cut off at its borders."""
    size = f'width="{axes.width - axes.left - axes.right}" height="{axes.bottom - _TOP}"'
    return f'<svg x="{axes.left}" y="{_TOP}" {size}><path class="{kind}" d="{steps}"/></svg>'


def _inside(axes: _Axes, x: float, y: float) -> str:
    """A point in px from the upper left corner of the plot's area."""
    return f"{axes.x(x) - axes.left:.1f} {axes.y(y) - _TOP:.1f}"


def _curve(axes: _Axes, xs: Sequence[float | None], ys: Sequence[float | None], kind: str) -> str:
    """A line through the points, broken where one is missing."""
    steps, joined = [], False
    for x, y in zip(xs, ys, strict=False):
        if x is None or y is None:
            joined = False
            continue
        steps.append(f"{'L' if joined else 'M'}{_inside(axes, x, y)}")
        joined = True
    return _clipped(axes, kind, "".join(steps))


def _closed(axes: _Axes, corners: Sequence[tuple[float, float]], kind: str = "box") -> str:
    """A filled outline."""
    return _clipped(axes, kind, f"M{'L'.join(_inside(axes, *corner) for corner in corners)}Z")


def _area(axes: _Axes, xs: Sequence[float], shares: Sequence[float | None]) -> str:
    """A ground as high as a share of the plot's height."""
    low, high = axes.y_range
    line = [(x, low + share * (high - low)) for x, share in zip(xs, shares, strict=False) if share is not None]
    return _closed(axes, [(line[0][0], low), *line, (line[-1][0], low)], "up") if line else ""


def _key(kind: str, words: str) -> str:
    return f'<span class="key"><span class="{kind}"></span> {words}</span> '


_NODE_KEY = (
    _key("line trunk", "trunk")
    + _key("line left", "left ankle")
    + _key("line right", "right ankle")
    + _key("line limit", "the paper's bound")
    + _key("ground", "share of robots still up (full height: all)")
)
_PATH_KEY = (
    _key("line target", "target (green)")
    + _key("line actual", "actual (yellow)")
    + "The right ankle is dashed; from the side the trunk is uppermost, from above it is between the ankles. The side view "
    "has a scale of its own for heights."
)

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
