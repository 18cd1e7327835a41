"""Sections of a report that hold our figures: every one of every task, policies side by side, and from easy to hard."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

from bipedtrack import charts, markup, metrics
from bipedtrack.markup import escape, section, task_rows
from bipedtrack.record import ENGINES, Run, engines_of, get, number, runs_of
from bipedtrack.robot import LEGS
from bipedtrack.verdicts import QUANTITIES


class Column(NamedTuple):
    """Where in a summary a figure lies, by a dotted path, and how it is written."""

    heading: str
    path: str
    digits: int = 2
    scale: float = 1.0
    interval: tuple[str, str] | None = None  # paths of its bounds


class Sheet(NamedTuple):
    """A table with a row for each task and policy; its columns by their common heading."""

    title: str
    groups: dict[str, list[Column]]


_HEADINGS = {"mean": "mean", "median": "median", "p5": "5 %", "p95": "95 %", "min": "min", "max": "max"}


def _spread(path: str, which: str = "mean median p95 max", digits: int = 2, scale: float = 1.0) -> list[Column]:
    """Statistics of one figure."""
    return [Column(_HEADINGS[name], f"{path}.{name}", digits, scale) for name in which.split()]


def _share(heading: str, path: str, digits: int = 1) -> list[Column]:
    return [Column(heading, path, digits, 100)]


def _interval(name: str) -> list[Column]:
    path = f"errors.{name}.episode"
    return [Column("mean [95 % interval]", f"{path}_mean", interval=(f"{path}_low", f"{path}_high"))]


SURVIVAL = Column("% [95 % interval]", "survival.share", 1, 100, ("survival.share_low", "survival.share_high"))
REST = Sheet(
    f"Rest: while the command stands still, from {metrics.SETTLE:g} s after it came to",
    {
        "Observed": [Column("episodes", "rest.episodes", 0), Column("seconds", "rest.seconds", 0)],
        "Joint speed RMS, rad/s": _spread("rest.joint_speed_rms_rad_per_s", "mean p95 max", 3),
        "Trunk sway RMS, cm": _spread("rest.trunk_sway_rms_cm", "mean p95"),
        "Sway peak to peak, cm": _spread("rest.trunk_sway_peak_to_peak_cm", "mean p95"),
        "Trunk turn RMS, deg": _spread("rest.trunk_turn_rms_deg", "mean p95"),
        "Foot motion, cm": _spread("rest.foot_motion_cm", "mean p95 max"),
        "A foot moved": _share("% of episodes", "rest.foot_moved_share"),
    },
)
SHEETS = (
    Sheet(
        "Survival, and position errors of the nodes in cm",
        {
            "Without a fall": [SURVIVAL],
            "Time to fall, s": [
                Column("mean of falls", "survival.time_to_fall_mean_s"),
                Column("median of all", "survival.time_to_fall_median_s"),
            ],
            **{f"{leg.capitalize()} ankle": _spread(f"errors.{leg}_ankle_position_cm") for leg in LEGS},
            "Trunk": _spread("errors.trunk_position_cm"),
        },
    ),
    Sheet(
        "Orientation errors of the nodes in deg",
        {
            **{f"{leg.capitalize()} ankle, yaw": _spread(f"errors.{leg}_ankle_yaw_deg") for leg in LEGS},
            "Trunk, whole rotation": _spread("errors.trunk_orientation_deg"),
        },
    ),
    Sheet(
        "Footholds: errors at planned touchdowns",
        {
            "Touchdowns": [Column("planned", "touchdown.planned", 0), *_share("missed, %", "touchdown.missed_share")],
            "In the plane, cm": _spread("touchdown.foothold_cm"),
            "Height, cm (+ too high)": _spread("touchdown.height_cm", "p5 mean p95"),
            "Yaw, deg": _spread("touchdown.yaw_deg", "mean p95 max"),
            "Time, ms (+ late)": _spread("touchdown.time_s", "p5 mean p95", 0, 1000),
        },
    ),
    Sheet(
        "Footholds: the same errors, divided by the length of the step",
        {
            "Step length, cm": _spread("touchdown.step_length_cm", "mean max", 1),
            "In the plane, % of step": _spread("touchdown.foothold_per_step", digits=1, scale=100),
            "Height, % of step": _spread("touchdown.height_per_step", digits=1, scale=100),
            "Yaw, deg for each m": _spread("touchdown.yaw_deg_per_m", digits=1),
        },
    ),
    Sheet(
        "Clearance of the soles over the edges of stairs and obstacles",
        {
            "Swings": [Column("past an edge", "clearance.swings", 0)],
            "Height over the edge, cm": _spread("clearance.edge_cm", "min p5 median mean"),
            "Below the edge": _share("% of those", "clearance.below_edge_share"),
            "Against a side": _share("% of all swings", "clearance.side_contact_share"),
        },
    ),
    REST,
    Sheet(
        "Effort",
        {
            "Torque RMS": [Column("N m", "effort.torque_rms_nm")],
            "Saturated": _share("% of torques", "effort.saturation_share", 2),
            "Feedback |a_fb|": [Column("mean", "effort.feedback_mean", 3), Column("max", "effort.feedback_max", 3)],
            "Mechanical power": [Column("W", "effort.power_w", 1)],
        },
    ),
)
_INTERVALS = Sheet(
    "Means of episodes, and the 95 % interval of that mean",
    {
        "Without a fall": [SURVIVAL],
        **{f"{leg.capitalize()} ankle, cm": _interval(f"{leg}_ankle_position_cm") for leg in LEGS},
        **{f"{leg.capitalize()} ankle, deg": _interval(f"{leg}_ankle_yaw_deg") for leg in LEGS},
        "Trunk, cm": _interval("trunk_position_cm"),
        "Trunk, deg": _interval("trunk_orientation_deg"),
    },
)
_LEVELS = {
    "Without a fall": [SURVIVAL],
    **{f"{leg.capitalize()} ankle, cm": _spread(f"errors.{leg}_ankle_position_cm", "mean p95") for leg in LEGS},
    **{f"{leg.capitalize()} ankle, deg": _spread(f"errors.{leg}_ankle_yaw_deg", "mean p95") for leg in LEGS},
    "Trunk, cm": _spread("errors.trunk_position_cm", "mean"),
}
_COUNTS = {"rest.episodes", "rest.seconds", "touchdown.planned", "clearance.swings"}  # which alone make no row


def tables(record: dict[str, Any]) -> str:
    """Every figure of every task and policy, the first simulator's unfolded."""
    parts = []
    for i, engine in enumerate(engines_of(record)):
        found = "".join(sheet(one, runs_of(record, engine)) for one in SHEETS)
        parts.append(f"<details{'' if i else ' open'}><summary>In {ENGINES[engine]}</summary>{found}</details>")
    return section("tables", "Every figure of every task", "".join(parts) or "<p>No task was evaluated.</p>")


def intervals(record: dict[str, Any]) -> str:
    """Policies beside each other, with intervals."""
    runs = runs_of(record)
    if not runs:
        return section("intervals", "Policies side by side", "<p>No task was evaluated.</p>")
    panels = [charts.forest(record, "Episodes without a fall, %", charts.lasting, None)]
    panels += [charts.forest(record, f"Ankle {q.name} error, {q.unit}", charts.ankles(q), q.limit) for q in QUANTITIES]
    caption = (
        f"{charts.policy_key(record)} Mean and 95 % interval; errors are the mean of both ankles. The dashed line is the "
        f"paper's bound; what lies beyond the axis stands at its end with its number. {charts.LEAST} {engine_words(runs)}"
    )
    content = markup.figure("triple", panels, caption) + sheet(_INTERVALS, runs)
    return section("intervals", "Policies side by side", content)


def levels(record: dict[str, Any]) -> str:
    """The episodes of each task by their difficulty."""
    runs, columns, lines = runs_of(record), [column for group in _LEVELS.values() for column in group], []
    for run in runs:
        for level in get(run.result, "levels") or ():
            names = [f'<td class="name">{escape(level["label"])}</td>', f"<td>{number(get(level, 'episodes'), 0)}</td>"]
            lines.append((run.task, run.label, [*names, *(f"<td>{cell(level, column)}</td>" for column in columns)]))
    groups = {"Difficulty": 2, **{heading: len(group) for heading, group in _LEVELS.items()}}
    head = markup.two_heads(groups, ["level", "episodes", *(column.heading for column in columns)])
    words = (
        "<p>Stairs by riser and tread; other tasks in three parts of as many episodes, by how far a foot moves or turns in "
        f"a task step. {engine_words(runs)}</p>"
    )
    table = markup.table("The same episodes, by their difficulty", head, task_rows(lines))
    return section("levels", "From easy to hard", words + table if table else "<p>Not evaluated.</p>")


def sheet(one: Sheet, runs: list[Run]) -> str:
    """A table of those runs that have a figure for it."""
    columns = [column for group in one.groups.values() for column in group]
    telling = [column.path.split(".") for column in columns if column.path not in _COUNTS]
    kept = [run for run in runs if any(get(run.summary, *path) is not None for path in telling)]
    lines = [(run.task, run.label, [f"<td>{cell(run.summary, column)}</td>" for column in columns]) for run in kept]
    groups = {heading: len(group) for heading, group in one.groups.items()}
    head = markup.two_heads(groups, [column.heading for column in columns])
    return markup.table(one.title, head, task_rows(lines))


def cell(summary: dict[str, Any], column: Column) -> str:
    """A figure, with its interval in brackets if it has one."""
    paths = (column.path, *(column.interval or ()))
    values = [get(summary, *path.split(".")) for path in paths]
    words = [number(None if value is None else column.scale * value, column.digits) for value in values]
    return words[0] if column.interval is None else f"{words[0]} <small>[{words[1]}, {words[2]}]</small>"


def engine_words(runs: Iterable[Run]) -> str:
    return f"Simulated in {' or '.join(ENGINES[name] for name in dict.fromkeys(run.engine for run in runs))}."
