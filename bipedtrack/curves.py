"""`python -m bipedtrack.curves RUN ...`: the learning curves of training runs side by side, as one SVG."""

from __future__ import annotations

import dataclasses
import html
import json
import math
import pathlib
from typing import Annotated, Any

import numpy as np
import tyro

from bipedtrack import checkpoint, drawing, markup
from bipedtrack.messages import Refusal, fail

PANELS = {  # by the names of progress.jsonl: the axis' name and the factor to its unit
    "falls": ("Episodes that fall, %", 100.0),
    "trunk_error_cm": ("Trunk error, cm", 1.0),
    "ankle_error_cm": ("Ankle position error, cm", 1.0),
    "ankle_yaw_error_deg": ("Ankle yaw error, deg", 1.0),
}
_WIDTH, _HEIGHT, _KEY = 460, 220, 22  # px of a panel, and of the line of keys above them


@dataclasses.dataclass(frozen=True)
class Curves:
    """Draws what runs recorded while they trained, with exploration noise, over their policy steps."""

    runs: Annotated[tuple[pathlib.Path, ...], tyro.conf.Positional]
    """Run directories."""
    out: pathlib.Path = pathlib.Path("curves.svg")
    """The file to write."""
    smooth: int = 9
    """How many records are averaged around each one."""


def main() -> None:
    """The command line. Exit status 0 when written, 2 for bad input."""
    options = tyro.cli(Curves, prog="python -m bipedtrack.curves")
    try:
        if not options.runs:
            raise Refusal("name at least one run directory")
        if options.smooth < 1:
            raise Refusal(f"--smooth {options.smooth}: must be at least 1")
        curves = {str(run): read(run, options.smooth) for run in options.runs}
        checkpoint.write_text(options.out, picture(curves))
        print(options.out)
    except Refusal as error:
        fail(str(error))


def read(run: pathlib.Path, smooth: int = 1) -> dict[str, np.ndarray]:
    """A run's `steps` and the figures of PANELS, (n,) each; of what was trained twice after a stop, the latter.

    Every figure is the mean over `smooth` records around each one, less at the ends; nan where no episode ended.
    Raises Refusal where there is no progress.jsonl with records.
    """
    file = run / "progress.jsonl"
    try:
        whole, _, _ = file.read_text(encoding="utf-8").rpartition("\n")  # after a power cut the last line may be cut off
        records = [json.loads(line) for line in whole.splitlines()]
        rows = [[float(r["steps"]), *(float("nan" if r[name] is None else r[name]) for name in PANELS)] for r in records]
        if not all(0 <= row[0] < math.inf for row in rows) or any(math.inf in map(abs, row) for row in rows):
            raise ValueError("steps or figures are no numbers")
    except OSError as error:
        raise Refusal(f"{file}: cannot be read ({error.strerror or error}); wanted a run directory") from None
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise Refusal(f"{file}: is damaged ({type(error).__name__}: {error}); wanted the records of a training") from None
    if not rows:
        raise Refusal(f"{file}: has no record yet; wait for the first epochs of the training")
    kept: list[list[float]] = []
    for row in rows:
        while kept and kept[-1][0] >= row[0]:
            kept.pop()
        kept.append(row)
    columns = np.array(kept).T
    return {"steps": columns[0], **{n: _smoothed(v, smooth) for n, v in zip(PANELS, columns[1:], strict=True)}}


def _smoothed(values: np.ndarray, count: int) -> np.ndarray:
    """Means over up to `count` known values around each one, the same number on both sides."""
    reach = np.minimum(np.minimum(np.arange(len(values)), np.arange(len(values))[::-1]), (count - 1) // 2)
    around = [values[i - r : i + r + 1] for i, r in enumerate(reach)]
    return np.array([part[~np.isnan(part)].mean() if not np.isnan(part).all() else np.nan for part in around])


def picture(curves: dict[str, dict[str, np.ndarray]]) -> str:
    """An SVG file of one panel for each of PANELS with a curve for each run, by its name."""
    longest = max(1.0, *(run["steps"][-1] for run in curves.values())) / 1e6
    size = f"0 0 {2 * _WIDTH} {_KEY + 2 * _HEIGHT}"
    parts = [f"<style>{markup.CSS}</style>", f'<rect width="{2 * _WIDTH}" height="{_KEY + 2 * _HEIGHT}" fill="#fff"/>']
    for i, name in enumerate(curves):
        x = 46 + i * (2 * _WIDTH - 60) // len(curves)
        parts.append(drawing.mark(i, x, 12) + f'<text x="{x + 9}" y="16">{html.escape(name)}</text>')
    for i, name in enumerate(PANELS):
        at = f"translate({i % 2 * _WIDTH} {_KEY + i // 2 * _HEIGHT})"
        parts.append(f'<g transform="{at}">{_panel(curves, name, longest)}</g>')
    words = "; ".join(f"{name}: {_ends(run)}" for name, run in curves.items())
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{size}" role="img" aria-label="{html.escape(words)}">'
        f"{''.join(parts)}</svg>\n"
    )


def _panel(curves: dict[str, dict[str, np.ndarray]], name: str, longest: float) -> str:
    label, factor = PANELS[name]
    top = 1.05 * max(factor * np.nanmax(run[name], initial=0.0) for run in curves.values()) or 1.0
    axes = drawing.Axes(_WIDTH, _HEIGHT, (0, longest), (0, top))
    parts = [drawing.grid(axes, "Policy steps, millions", label)]
    for i, run in enumerate(curves.values()):
        values: list[Any] = [None if np.isnan(v) else factor * v for v in run[name]]
        parts.append(drawing.curve(axes, list(run["steps"] / 1e6), values, f"{drawing.colour(i)} course"))
    return "".join(parts)


def _ends(run: dict[str, np.ndarray]) -> str:
    figures = ", ".join(f"{label} {factor * run[name][-1]:.1f}" for name, (label, factor) in PANELS.items())
    return f"after {run['steps'][-1] / 1e6:.1f} M steps {figures}"


if __name__ == "__main__":
    main()
