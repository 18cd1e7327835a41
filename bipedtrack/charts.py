"""Charts of what a record holds, and their keys: errors over time, paths, policies beside each other, disturbances."""

from __future__ import annotations

import html
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from bipedtrack import drawing, terrain
from bipedtrack.record import Run, get, greatest_of, labels_of, mean_of, number, percent, runs_of
from bipedtrack.robot import LEGS
from bipedtrack.verdicts import LEAST_SHARE, Quantity

_NODES = ("trunk", *LEGS)
NODE_KEY = (
    drawing.key("line trunk", "trunk")
    + drawing.key("line left", "left ankle")
    + drawing.key("line right", "right ankle")
    + drawing.key("line limit", "the paper's bound")
    + drawing.key("ground", "share of robots still up (full height: all)")
)
PATH_KEY = (
    drawing.key("line target", "target (green)")
    + drawing.key("line actual", "actual (yellow)")
    + "The right ankle is dashed; from the side the trunk is uppermost, from above it is between the ankles. The side view "
    "has a scale of its own for heights."
)


# Errors over time


def errors_over_time(course: dict[str, Any], quantity: Quantity, task: str, width: int) -> str:
    """The errors of the three nodes over time, with the paper's bound, before the share of robots that are up."""
    time, curves = course["time_s"], [course.get(name) or [] for name in quantity.errors]
    peak = greatest_of(value for curve in curves for value in curve) or 0.0
    top = _top([peak], quantity.limit)
    axes = drawing.Axes(width, 220, (0, max(time[-1], 1e-3)), (0, top))
    parts = [drawing.ground(axes, time, course.get("alive_share") or []), drawing.grid(axes, "Time, s", quantity.label)]
    parts += [drawing.curve(axes, time, curve, node) for node, curve in zip(_NODES, curves, strict=True)]
    parts.append(_bound(axes, quantity))
    means = ", ".join(f"{node} {number(mean_of(curve))}" for node, curve in zip(_NODES, curves, strict=True))
    words = f"{quantity.label}, over {time[-1]:.0f} s of {task}; means over that time: {means}"
    if peak > top:
        parts.append(
            f'<text class="halo" x="{axes.left + 4}" y="{drawing.TOP + 11}">up to {peak:.0f} {quantity.unit}</text>'
        )
        words += f"; cut off at {top:g}, the highest is {peak:.0f}"
    return drawing.svg(axes, parts, words)


def _bound(axes: drawing.Axes, quantity: Quantity) -> str:
    """The paper's bound, with its number."""
    return drawing.level(axes, quantity.limit, f"{quantity.limit:g} {quantity.unit}")


def _top(values: Iterable[float | None], limit: float) -> float:
    """The upper end of an axis of errors: the limit is in sight, and so is all that lies below six times it."""
    return min(max(1.05 * (greatest_of(values) or 0), 1.4 * limit), 6 * limit)


# Paths


def views(run: Run) -> list[str]:
    """Where the nodes should go and went, from the side and from above; empty if that was not recorded."""
    paths = {side: get(run.result, "path", side) or {} for side in ("target", "measured")}
    points = [point for nodes in paths.values() for line in nodes.values() for point in line]
    if not points:
        return []
    boxes = [box for box in run.boxes if box[2] + box[5] / 2 > 0]
    across = [v for box in boxes for _, v in _outline(box, None) if abs(v) < 0.6]
    x, y, z = (drawing.range_around([point[i] for point in points], least) for i, least in enumerate((0.4, 0.4, 0.2)))
    y = drawing.range_around([*y, *across], 0.4)
    targets = [point for line in paths["target"].values() for point in line] or points
    along = max((0, 1), key=lambda i: max(point[i] for point in targets) - min(point[i] for point in targets))
    side = drawing.Axes(960, 270, (x, y)[along], (min(z[0], 0.0), z[1]))
    return [
        _view(side, paths, boxes, (along, 2), f"Side view of {run.task}, {run.policy}"),
        _view(drawing.to_scale(960, 340, x, y), paths, boxes, (0, 1), f"Top view of {run.task}, {run.policy}"),
    ]


def _view(axes: drawing.Axes, paths: dict[str, Any], boxes: list[list[float]], plane: tuple[int, int], title: str) -> str:
    """Two coordinates of the nodes: boxes, targets, and above them what was measured."""
    i, j = plane
    outlines = dict.fromkeys(drawing.polygon(axes, _outline(box, i if j == 2 else None)) for box in boxes)
    parts = [*outlines, drawing.grid(axes, f"{title.split(' of ')[0]}: {'xyz'[i]}, m", f"{'xyz'[j]}, m")]
    for side, kind in (("target", "target"), ("measured", "casing"), ("measured", "actual")):
        for node, points in paths[side].items():
            parts.append(drawing.curve(axes, [p[i] for p in points], [p[j] for p in points], f"{kind} {node}"))
    return drawing.svg(axes, parts, f"{title}, {'xyz'[i]} and {'xyz'[j]} in m: {_ends(paths) or 'no end'}")


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
    flat = [(u, v) for u, v in terrain.rectangle(np.array([x, y]), yaw, length, width).tolist()]
    if along is None:
        return flat
    places, bottom, top = [corner[along] for corner in flat], max(z - height / 2, 0.0), z + height / 2
    return [(min(places), bottom), (min(places), top), (max(places), top), (max(places), bottom)]


# Policies beside each other

LEAST = f"Errors count only where at least {100 * LEAST_SHARE:g} % of the episodes last to the end."
Estimate = tuple[float | None, float | None, float | None]  # mean and the ends of its interval
Estimator = Callable[[dict[str, Any]], Estimate]  # of a summary


def lasting(summary: dict[str, Any]) -> Estimate:
    """Episodes without a fall, %."""
    share, low, high = (percent(get(summary, "survival", name)) for name in ("share", "share_low", "share_high"))
    return share, low, high


def ankles(quantity: Quantity) -> Estimator:
    """The mean over both ankles, their intervals averaged: never narrower than the interval of that mean.

    None where too few episodes last: an error before a fall says little about what made the robot fall.
    """

    def estimate(summary: dict[str, Any]) -> Estimate:
        if (get(summary, "survival", "share") or 0.0) < LEAST_SHARE:
            return None, None, None
        names = "episode_mean", "episode_low", "episode_high"
        mean, low, high = (mean_of(quantity.of_ankles(summary, name)) for name in names)
        return mean, low, high

    return estimate


def forest(record: dict[str, Any], title: str, estimate: Estimator, limit: float | None) -> str:
    """A line for each task and policy: a mark at the mean and a bar over its interval."""
    order = list(labels_of(record))
    rows = [(run, *estimate(run.summary)) for run in runs_of(record)]
    top = 100.0 if limit is None else _top([value for _, *values in rows for value in values], limit)
    tasks = len({run.task for run, *_ in rows})
    axes = drawing.Axes(360, drawing.TOP + drawing.BOTTOM + 13 * len(rows) + 8 * tasks, (0, top), (0, 1), left=122, right=34)
    parts, y, before = [drawing.grid(axes, title, "")], float(drawing.TOP), None
    for run, mean, low, high in rows:
        if run.task != before:
            y, before = y + 8, run.task
            parts.append(f'<text class="end" x="{axes.left - 6}" y="{y + 10:.0f}">{html.escape(run.task)}</text>')
        y += 13
        parts.append(drawing.whisker(axes, order.index(run.policy), y - 7, mean, low, high))
    if limit is not None:
        parts.append(drawing.upright(axes, limit))
    return drawing.svg(axes, parts, f"{title}: mean and interval for each task and policy; the table below has the numbers")


def policy_key(record: dict[str, Any]) -> str:
    """Which mark is which policy."""
    sample = '<span class="key"><svg class="sample" viewBox="-6 -6 12 12" aria-hidden="true">{}</svg> {}</span>'
    labels = enumerate(labels_of(record).values())
    return " ".join(sample.format(drawing.mark(i, 0, 0), html.escape(label)) for i, label in labels)


# Disturbances


def ladder(ladders: dict[int, Any], x_label: str, y_label: str, estimate: Estimator, bound: Quantity | None) -> str:
    """One figure over the levels of a disturbance, a curve for each policy by its index."""
    rows = [(i, row["level"], *estimate(row)) for i, one in ladders.items() for row in get(one, "levels") or []]
    top = 104.0 if bound is None else _top([value for _, _, *values in rows for value in values], bound.limit)
    axes = drawing.Axes(460, 220, drawing.range_around([row[1] for row in rows] or [0.0], 0.1), (0, top))
    parts = [drawing.grid(axes, x_label, y_label)]
    for i in ladders:
        own = [row for row in rows if row[0] == i]
        parts.append(drawing.curve(axes, [row[1] for row in own], [row[2] for row in own], f"{drawing.colour(i)} course"))
    for i, level, mean, low, high in rows:
        if mean is not None and mean <= top:
            ends = [axes.y(min(max(value, 0), top)) for value in (low, high) if value is not None]
            if len(ends) == 2:
                line = f"M{axes.x(level):.1f} {ends[0]:.1f}V{ends[1]:.1f}"
                parts.append(f'<path class="{drawing.colour(i)} bar" d="{line}"/>')
            parts.append(drawing.mark(i, axes.x(level), axes.y(mean)))
    if bound is not None:
        parts.append(_bound(axes, bound))
    words = "; ".join(f"{level:g}: {number(mean)}" for _, level, mean, *_ in rows)
    return drawing.svg(axes, parts, f"{y_label}, over {x_label}: {words}")
