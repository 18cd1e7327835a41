"""The tasks of the evaluation: the same plans for every policy, from fixed seeds and Table II's full ranges.

Random tasks draw from `sampling.Ranges` with the named range narrowed to one direction; stairs go through a fixed grid of
risers and treads; scripts are the footstep files in `curricula/footsteps/`.
"""

from __future__ import annotations

import dataclasses
import functools
import pathlib
import zlib
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bipedtrack import config, footsteps, plans, robot, sampling, scripts, terrain

RISERS = (0.05, 0.08, 0.11, 0.14, 0.17)  # m
TREADS = (0.25, 0.30, 0.35)  # m
HOLD_AFTER = (1, 8)  # task steps before a hold
LONG_HOLD = 60.0  # s


class Level(NamedTuple):
    """The episodes of one difficulty."""

    label: str
    episodes: np.ndarray  # (k,) indices


class Batch(NamedTuple):
    """The episodes of one task."""

    plan: plans.Plan  # leading axis: episodes
    sizes: tuple[tuple[float, float, float], ...]  # of the plan's boxes: length, width, height, m
    ranges: str  # what the episodes are drawn from, in words
    levels: tuple[Level, ...] = ()  # the episodes from easy to hard


@dataclasses.dataclass(frozen=True)
class _Random:
    """A task drawn from one kind."""

    kind: str
    narrowed: dict[str, tuple[float, float, float]] = dataclasses.field(default_factory=dict)
    down_share: float = 0.5
    break_share: float = 0.0  # share of the episodes that pause or close up every few task steps


_UNIFORM = {"swing_ease": (0.0, 0.0, 0.0)}  # Bezier curves as the paper may have run through them
_FORWARD = {"walk_step": (0.03, 0.03, 0.25)}
_BASIC = {
    "stand": _Random("stand"),
    "squat": _Random("squat"),
    "walk-forward": _Random("walk", _FORWARD),
    "walk-backward": _Random("walk", {"walk_step": (-0.15, -0.03, -0.03)}),
    "sidle-left": _Random("sidle", {"sidle_step": (0.02, 0.02, 0.12)}),
    "sidle-right": _Random("sidle", {"sidle_step": (-0.12, -0.02, -0.02)}),
    "turn-left": _Random("turn", {"turn_yaw": (0.05, 0.05, 0.35)}),
    "turn-right": _Random("turn", {"turn_yaw": (-0.35, -0.05, -0.05)}),
    "stairs-up": _Random("stairs", down_share=0.0),
    "stairs-down": _Random("stairs", down_share=1.0),
    "wander": _Random("wander"),
}
_VARIANTS = {
    "walk-forward-uniform": _Random("walk", _FORWARD | _UNIFORM),
    "stairs-up-uniform": _Random("stairs", _UNIFORM, down_share=0.0),
    "walk-breaks": _Random("walk", break_share=1.0),
    "stairs-breaks": _Random("stairs", break_share=1.0),
}
_RANDOM = _BASIC | _VARIANTS
BEYOND = ("one-legged-stance", "hop", "long-jump", "kick", "crouch-walk", "cross-step", "sway", "stepping-stones")
"""Scripts of kinds that Table II does not have."""
SCRIPTS = ("obstacles", "composite", *BEYOND)
MOVING = tuple(name for name in _BASIC if name != "stand")
HOLDS = tuple(f"hold-{name}" for name in MOVING)
LONG_HOLDS = tuple(f"hold-60s-{name}" for name in MOVING)
TASKS = (*_RANDOM, *HOLDS, *LONG_HOLDS, *SCRIPTS)


def batch(name: str, ranges: sampling.Ranges, the_robot: robot.Robot, episodes: int, seconds: float, seed: int) -> Batch:
    """The episodes of a task of TASKS.

    Args:
      name: of TASKS.
      ranges: Table II's, as the curriculum has them.
      the_robot: whose control period and ankle height the plans need.
      episodes: how many; a script is the same every time.
      seconds: how long they last.
      seed: with the task's name, decides the episodes.
    """
    if name in SCRIPTS:
        return script_batch(footsteps.load(scripts.ready()[name], the_robot, ranges.usual_sway), episodes)
    hold, what = name.startswith("hold-"), _what(name)
    steps = int(np.ceil(seconds / min(ranges.period[0], ranges.squat_period[0]))) + 1
    key = jax.random.fold_in(jax.random.PRNGKey(seed), zlib.crc32(name.encode()))
    given = [_distribution(ranges, what, hold, i) for i in range(episodes)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *given)
    plan = jax.tree.map(np.asarray, _lay_out(the_robot.name, steps)(jax.random.split(key, episodes), stacked))
    narrowed = ", ".join(f"{k} {list(v)}" for k, v in what.narrowed.items()) or "full ranges"
    if what.kind == "stairs":
        narrowed = f"risers {list(RISERS)} m x treads {list(TREADS)} m, feet lifted over edges"
    words = f"{what.kind}: {narrowed}" + (f"; hold after {HOLD_AFTER[0]}-{HOLD_AFTER[1]} task steps" if hold else "")
    words += "; swings run through uniformly" if "swing_ease" in what.narrowed else ""
    words += "; the trunk sways" if ranges.sway[2] > 0 else ""
    words += "; a pause or the feet together every few task steps" if what.break_share else ""
    levels = _grid(episodes) if what.kind == "stairs" else _thirds(what.kind, plan)
    return Batch(plan, (terrain.STAIR_BOX,) * terrain.STAIR_BOXES, words, levels)


@functools.cache
def _lay_out(name: str, steps: int) -> Callable[..., plans.Plan]:
    """Plans of so many task steps for the robot of that name, compiled once for all tasks of one length."""
    the_robot = robot.load(name)
    return jax.jit(jax.vmap(lambda key, given: plans.random_plan(key, given, the_robot, steps)))


def duration(name: str, ranges: sampling.Ranges, seconds: float) -> float:
    """How long an episode of a random task lasts, s: a hold lasts that long, or 60 s, after the steps before it.

    Raises config.ConfigError where a staircase down is not long enough.
    """
    if not name.startswith("hold-"):
        most = terrain.TREADS_DOWN * ranges.period[0]
        if _what(name).kind == "stairs" and _what(name).down_share > 0 and seconds > most:
            raise config.ConfigError(f"--seconds {seconds:g}: {name}: its {terrain.TREADS_DOWN} treads last {most:g} s")
        return seconds
    longest = (ranges.squat_period if _what(name).kind == "squat" else ranges.period)[2]
    return HOLD_AFTER[1] * longest + (LONG_HOLD if name in LONG_HOLDS else seconds)


def _what(name: str) -> _Random:
    return _RANDOM[name.removeprefix("hold-").removeprefix("60s-")]


def _grid(episodes: int) -> tuple[Level, ...]:
    """The cells of risers and treads, the lowest riser first."""
    found = []
    for r, riser in enumerate(RISERS):
        for t, tread in enumerate(TREADS):
            mine = np.arange(t * len(RISERS) + r, episodes, len(RISERS) * len(TREADS))
            found.append(Level(f"riser {riser:.2f} m, tread {tread:.2f} m", mine))
    return tuple(level for level in found if len(level.episodes))


def _thirds(kind: str, plan: plans.Plan) -> tuple[Level, ...]:
    """Three levels of as many episodes each, by how far the swing foot goes, or turns; none where no foot moves."""
    swing = plan.steps.swing > 0
    if not swing.any():
        return ()
    start, end = plan.steps.start, plan.steps.end
    if kind == "turn":
        way, unit = np.degrees(np.abs(end.ankle_yaws - start.ankle_yaws)), "deg"
    else:
        way, unit = 100 * np.linalg.norm(end.ankle_positions - start.ankle_positions, axis=-1), "cm"
    mean = (way * swing).sum(axis=(1, 2)) / swing.sum(axis=(1, 2))
    parts = [part for part in np.array_split(np.argsort(mean, kind="stable"), 3) if len(part)]
    return tuple(Level(f"{mean[part[0]]:.0f}-{mean[part[-1]]:.0f} {unit} a step", np.sort(part)) for part in parts)


def script_batch(script: footsteps.Script, episodes: int = 1) -> Batch:
    """A footstep script as a task, `episodes` times the same."""
    one = plans.script_plan(script)
    repeated = jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf)[None], episodes, axis=0), one)
    return Batch(repeated, tuple(box.size for box in script.boxes), f"footstep script {pathlib.Path(script.name).name}")


def _distribution(ranges: sampling.Ranges, what: _Random, hold: bool, episode: int) -> sampling.Distribution:
    """What episode number `episode` is drawn from: stairs go through the grid, all else is the same for every one."""
    narrowed = dict(what.narrowed)
    if what.kind == "stairs":
        riser, tread = RISERS[episode % len(RISERS)], TREADS[episode // len(RISERS) % len(TREADS)]
        narrowed |= {"stair_riser": (riser,) * 3, "stair_tread": (tread,) * 3}
    shares = sampling.Shares(**{kind: float(kind == what.kind) for kind in sampling.KINDS})
    return sampling.distribution(
        ranges._replace(**narrowed),
        shares,
        1.0,
        float(hold),
        HOLD_AFTER,
        down_share=what.down_share,
        break_share=what.break_share,
    )
