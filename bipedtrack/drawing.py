"""Plots as SVG: axes and their grid, lines, outlines and marks. The page that shows them has the style of each class."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

TOP, BOTTOM = 8, 36  # px above and below the area of a plot
COLOURS = 6  # of marks, then they begin again
_SHAPES = ("M-4 0a4 4 0 1 0 8 0a4 4 0 1 0 -8 0", "M-4 -4H4V4H-4Z", "M0 -5L5 4H-5Z", "M0 -5L5 0L0 5L-5 0Z", "M0 5L5 -4H-5Z")


class Axes(NamedTuple):
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
        return self.height - BOTTOM

    def x(self, value: float) -> float:
        """px from the left."""
        low, high = self.x_range
        return self.left + (value - low) / (high - low) * (self.width - self.left - self.right)

    def y(self, value: float) -> float:
        """px from the top."""
        low, high = self.y_range
        return self.bottom - (value - low) / (high - low) * (self.bottom - TOP)


def to_scale(width: int, most: int, x: tuple[float, float], y: tuple[float, float]) -> Axes:
    """Axes with one scale for both ranges, their area at most so many px high; x is widened where there is room."""
    axes = Axes(width, 0, x, y)
    inner = axes.width - axes.left - axes.right
    scale = min(inner / (x[1] - x[0]), most / (y[1] - y[0]))  # px for each unit
    middle, half = (x[0] + x[1]) / 2, inner / scale / 2
    return axes._replace(height=round(TOP + BOTTOM + scale * (y[1] - y[0])), x_range=(middle - half, middle + half))


def range_around(values: Sequence[float], least: float) -> tuple[float, float]:
    """A range around the values with a margin, at least so wide."""
    low, high = min(values), max(values)
    half = max(1.08 * (high - low), least) / 2
    return (low + high) / 2 - half, (low + high) / 2 + half


def svg(axes: Axes, parts: Iterable[str], words: str) -> str:
    """A plot, and what it shows in words for those who cannot see it."""
    size = f'viewBox="0 0 {axes.width} {axes.height}"'
    return f'<svg {size} role="img" aria-label="{html.escape(words)}">{"".join(parts)}</svg>'


def grid(axes: Axes, x_label: str, y_label: str) -> str:
    """Lines at round values with their numbers, and names of the axes; without a name, no vertical axis."""
    right, parts = axes.width - axes.right, []
    for value, text in ticks(*axes.x_range, 8):
        parts.append(f'<path class="grid" d="M{axes.x(value):.1f} {TOP}V{axes.bottom}"/>')
        parts.append(f'<text class="middle" x="{axes.x(value):.1f}" y="{axes.bottom + 14}">{text}</text>')
    for value, text in ticks(*axes.y_range, 5) if y_label else ():
        parts.append(f'<path class="grid" d="M{axes.left} {axes.y(value):.1f}H{right}"/>')
        parts.append(f'<text class="end" x="{axes.left - 5}" y="{axes.y(value) + 4:.1f}">{text}</text>')
    turned = f'transform="translate(12 {(TOP + axes.bottom) / 2:.0f}) rotate(-90)"'
    parts.append(f'<path class="frame" d="M{axes.left} {TOP}V{axes.bottom}H{right}"/>')
    parts.append(
        f'<text class="middle" x="{(axes.left + right) / 2:.0f}" y="{axes.height - 5}">{html.escape(x_label)}</text>'
    )
    parts.append(f'<text class="middle" {turned}>{html.escape(y_label)}</text>')
    return "".join(parts)


def ticks(low: float, high: float, most: int) -> list[tuple[float, str]]:
    """Round values in a range, at most about so many, and their text."""
    least = (high - low) / most
    power = 10.0 ** math.floor(math.log10(least))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= 0.999 * least)
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [(i * step, f"{i * step:.{digits}f}") for i in range(first, last + 1)]


def _clipped(axes: Axes, kind: str, steps: str) -> str:
    """A path in px from the upper left corner of the plot's area, cut off at its borders."""
    size = f'width="{axes.width - axes.left - axes.right}" height="{axes.bottom - TOP}"'
    return f'<svg x="{axes.left}" y="{TOP}" {size}><path class="{kind}" d="{steps}"/></svg>'


def _inside(axes: Axes, x: float, y: float) -> str:
    """A point in px from the upper left corner of the plot's area."""
    return f"{axes.x(x) - axes.left:.1f} {axes.y(y) - TOP:.1f}"


def curve(axes: Axes, xs: Sequence[float | None], ys: Sequence[float | None], kind: str) -> str:
    """A line through the points, broken where one is missing."""
    steps, joined = [], False
    for x, y in zip(xs, ys, strict=False):
        if x is None or y is None:
            joined = False
            continue
        steps.append(f"{'L' if joined else 'M'}{_inside(axes, x, y)}")
        joined = True
    return _clipped(axes, kind, "".join(steps))


def polygon(axes: Axes, corners: Sequence[tuple[float, float]], kind: str = "box") -> str:
    """A filled outline."""
    return _clipped(axes, kind, f"M{'L'.join(_inside(axes, *corner) for corner in corners)}Z")


def ground(axes: Axes, xs: Sequence[float], shares: Sequence[float | None]) -> str:
    """A ground as high as a share of the plot's height."""
    low, high = axes.y_range
    line = [(x, low + share * (high - low)) for x, share in zip(xs, shares, strict=False) if share is not None]
    return polygon(axes, [(line[0][0], low), *line, (line[-1][0], low)], "up") if line else ""


def level(axes: Axes, value: float, words: str) -> str:
    """A dashed line across the area, named at its right end."""
    y, right = axes.y(value), axes.width - axes.right
    name = f'<text class="end halo" x="{right - 3}" y="{y - 4:.1f}">{html.escape(words)}</text>'
    return f'<path class="limit" d="M{axes.left} {y:.1f}H{right}"/>{name}'


def upright(axes: Axes, value: float) -> str:
    """A dashed line from the lower to the upper edge of the area."""
    return f'<path class="limit" d="M{axes.x(value):.1f} {TOP}V{axes.bottom}"/>'


def colour(index: int) -> str:
    """The class that colours a mark and what belongs to it."""
    return f"p{index % COLOURS}"


def mark(index: int, x: float, y: float) -> str:
    """A mark, told apart from others by shape and colour."""
    return f'<path class="{colour(index)} mark" transform="translate({x:.1f} {y:.1f})" d="{_SHAPES[index % len(_SHAPES)]}"/>'


def whisker(axes: Axes, index: int, y: float, mean: float | None, low: float | None, high: float | None) -> str:
    """A mark at a mean with a bar over its interval; beyond the axis, at its end and with the number."""
    if mean is None:
        return ""
    end, bar, beyond = axes.x_range[1], "", ""
    if low is not None and high is not None:
        left, right = (axes.x(min(max(value, 0), end)) for value in (low, high))
        bar = f'<path class="{colour(index)} bar" d="M{left:.1f} {y:.1f}H{right:.1f}"/>'
    if mean > end:
        beyond = f'<text x="{axes.x(end) + 6:.1f}" y="{y + 4:.1f}">{mean:.0f}</text>'
    return bar + mark(index, axes.x(min(mean, end)), y) + beyond


def key(kind: str, words: str) -> str:
    """A sample of a class and what it stands for, in HTML."""
    return f'<span class="key"><span class="{kind}"></span> {words}</span> '
