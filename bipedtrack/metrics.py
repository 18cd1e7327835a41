"""Traces of many episodes to figures: tracking, touchdowns, clearance over edges, survival, rest and effort.

`summarise` is the table of contents; plain numpy. A trace has the leading axes (episodes, n) here, and whatever it holds
from a fall on is never looked at. Left and right are those of `robot.LEGS`.
"""

from __future__ import annotations

import math
import statistics
from typing import Any, NamedTuple

import numpy as np

from bipedtrack import rotations, swings
from bipedtrack.nodes import Nodes
from bipedtrack.robot import Robot
from bipedtrack.trace import Trace

CONTACT_SHARE = 0.05  # of the body weight: a foot that bears more stands
SETTLE = 1.0  # s after which a command that stands still is a rest
SATURATION = 0.98  # share of its limit from which a torque counts as saturated
FOOT_MOVED_CM = 1.0  # by which a foot at rest may be off the place where it stood
_Z = statistics.NormalDist().inv_cdf(0.975)  # of a 95 % interval
_ANGLES = np.radians(np.arange(0, 180, 15))
_DIRECTIONS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)])  # (2, 12), along which a horizontal extent is taken

ERRORS = (
    *("trunk_position_cm", "left_ankle_position_cm", "right_ankle_position_cm"),
    *("trunk_orientation_deg", "left_ankle_yaw_deg", "right_ankle_yaw_deg"),
)
Statistics = dict[str, float | None]


class Motion(NamedTuple):
    """How much a robot moves in one rest."""

    joint_speed_rms_rad_per_s: float  # over all joints
    trunk_sway_rms_cm: float  # distance from the mean place, in the plane
    trunk_sway_peak_to_peak_cm: float  # in the plane, along the direction in which it is greatest
    trunk_turn_rms_deg: float  # angle from the mean orientation
    trunk_turn_peak_to_peak_deg: float  # about the trunk's axis about which it is greatest
    foot_motion_cm: float  # largest distance of a foot from where it stood at the start


def summarise(
    trace: Trace,
    robot: Robot,
    weight: float,
    boxes: swings.Boxes | None = None,
    contact_share: float = CONTACT_SHARE,
    settle: float = SETTLE,
) -> dict[str, Any]:
    """All figures of the episodes of one task: plain dicts and floats, None where there is no sample.

    Statistics are {mean, rms, median, p5, p95, min, max}.

    - episodes, seconds: how many and how long the trace is.
    - errors: by `ERRORS` statistics over all entries before falls, pooled; and episode_mean, the mean over the means of
      the episodes, with its 95 % interval episode_low, episode_high (Student's t; None below three episodes).
    - touchdown: planned (how many; a foot that is to stay in the air has none), undecided (not detected, the trace ends too
      soon; left out of missed_share), missed_share; statistics step_length_cm, foothold_cm (in the plane), height_cm
      (positive: too high), yaw_deg, time_s (negative: early), and for steps of more than 2 cm foothold_per_step,
      height_per_step (absolute), yaw_deg_per_m.
    - clearance (None without boxes), see `swings.clearances`: swings (that pass an edge), statistics edge_cm,
      below_edge_share of them; side_contact_share of all swings.
    - survival: share without a fall, its 95 % interval share_low, share_high (Wilson), falls, time_to_fall_mean_s of the
      fallen, time_to_fall_median_s of all (None: no more than half fell).
    - rest: episodes with one, windows, seconds of them; statistics over windows of the fields of `Motion`;
      foot_moved_share of those episodes in which a foot moves by more than 1 cm.
    - effort: torque_rms_nm, saturation_share of all torques, feedback_mean and feedback_max of |a_fb|, power_w.

    Args:
      trace: leading axes (episodes, n).
      robot: the constants of the robot.
      weight: its body weight, N.
      boxes: stairs and obstacles, for the clearance, and for where feet are to land.
      contact_share: of the body weight, above which a foot counts as standing.
      settle: s to leave out of each rest.

    Raises:
      ValueError: a trace without an axis of episodes or two entries, not alive at first, or again after a fall, or not
        finite before it.
    """
    return {
        **outline(trace),
        "seconds": float(len(trace.time) * trace.timestep),
        "touchdown": _summarise_touchdowns(trace, contact_share * weight, robot, boxes),
        "clearance": None if boxes is None else _summarise_clearances(trace, robot, boxes),
        "rest": rest(trace, settle),
        "effort": effort(trace, robot.torque_limit),
    }


def outline(trace: Trace) -> dict[str, Any]:
    """What `summarise` says of episodes, errors and survival. Raises ValueError as it does."""
    _check(trace)
    return {
        "episodes": len(trace.alive),
        "errors": {name: _statistics(v.ravel()) | _interval(np.nanmean(v, axis=1)) for name, v in errors(trace).items()},
        "survival": survival(trace),
    }


def time_course(trace: Trace) -> dict[str, np.ndarray]:
    """Over time, (n,) each: time_s, alive_share, and by the names of `errors` the mean over the robots not yet fallen.

    A mean is nan from where on all have fallen. Raises ValueError as `summarise` does.
    """
    _check(trace)
    count = trace.alive.sum(axis=0)
    course = {"time_s": np.asarray(trace.time, float), "alive_share": trace.alive.mean(axis=0)}
    for name, values in errors(trace).items():
        course[name] = np.where(count > 0, np.nansum(values, axis=0) / np.maximum(count, 1), np.nan)
    return course


def errors(trace: Trace) -> dict[str, np.ndarray]:
    """How far each node is off the target of the same instant: (..., n) in the unit of each name, nan after a fall."""
    target, real = (Nodes(*(part[trace.alive].astype(float) for part in side)) for side in (trace.target, trace.measured))
    trunk, ankles = target.trunk_position - real.trunk_position, target.ankle_positions - real.ankle_positions
    distances = np.linalg.norm(np.concatenate([trunk[:, None], ankles], axis=1), axis=-1)
    turn = np.linalg.norm(_turn(real.trunk_orientation, target.trunk_orientation), axis=-1)
    yaws = np.abs(rotations.wrap(target.ankle_yaws - real.ankle_yaws))
    found = np.full((*trace.alive.shape, len(ERRORS)), np.nan)
    found[trace.alive] = np.column_stack([100 * distances, np.degrees(turn), np.degrees(yaws)])
    return dict(zip(ERRORS, np.moveaxis(found, -1, 0), strict=True))


def survival(trace: Trace) -> Statistics:
    """The share of episodes without a fall and the time to a fall; the keys stand in `summarise`."""
    alive = trace.alive.astype(bool)
    fell = ~alive[:, -1]
    seconds = np.where(fell, trace.time[alive.argmin(axis=1)] - trace.time[0], np.inf)
    median = float(np.median(seconds))
    low, high = wilson(int((~fell).sum()), len(fell))
    return {
        "share": float((~fell).mean()),
        "share_low": low,
        "share_high": high,
        "falls": int(fell.sum()),
        "time_to_fall_mean_s": float(seconds[fell].mean()) if fell.any() else None,
        "time_to_fall_median_s": median if math.isfinite(median) else None,
    }


def wilson(successes: int, total: int) -> tuple[float, float]:
    """The 95 % interval of a share by Wilson's score, of at least one trial."""
    share, spread = successes / total, _Z * _Z / total
    middle, half = share + spread / 2, math.sqrt(spread * share * (1 - share) + spread * spread / 4)
    return max(0.0, (middle - half) / (1 + spread)), min(1.0, (middle + half) / (1 + spread))


def rests(trace: Trace, settle: float) -> list[tuple[int, slice]]:
    """Episode and entries of every rest: from `settle` s after the command came to stand still, up to a fall."""
    still = np.pad(trace.still & trace.alive, ((0, 0), (1, 1))).astype(np.int8)
    change = np.diff(still, axis=1)
    skip = round(settle / trace.timestep)
    begun, ended = np.argwhere(change == 1), np.argwhere(change == -1)
    runs = zip(begun[:, 0].tolist(), begun[:, 1].tolist(), ended[:, 1].tolist(), strict=True)
    return [(episode, slice(start + skip, end)) for episode, start, end in runs if end - start - skip >= 2]


def rest(trace: Trace, settle: float) -> dict[str, Any]:
    """How still the robots stand where they shall; the keys stand in `summarise`."""
    windows = rests(trace, settle)
    motions = [_motion(trace, *window) for window in windows]
    rested = {episode for episode, _ in windows}
    moved = {episode for (episode, _), found in zip(windows, motions, strict=True) if found.foot_motion_cm > FOOT_MOVED_CM}
    return {
        "episodes": len(rested),
        "windows": len(windows),
        "seconds": sum(window.stop - window.start for _, window in windows) * trace.timestep,
        **{name: _statistics(np.array([getattr(found, name) for found in motions])) for name in Motion._fields},
        "foot_moved_share": len(moved) / len(rested) if rested else None,
    }


def effort(trace: Trace, limit: np.ndarray) -> Statistics:
    """What the motors do before falls, with torque limits (12,) in N m; the keys stand in `summarise`."""
    torques = trace.torques[trace.alive].astype(float)
    feedback = np.abs(trace.feedback[trace.alive])
    power = np.abs(torques * trace.qvel[trace.alive][:, 6:]).sum(axis=-1)
    return {
        "torque_rms_nm": _rms(torques),
        "saturation_share": float((np.abs(torques) >= SATURATION * limit).mean()),
        "feedback_mean": float(feedback.mean(dtype=float)),
        "feedback_max": float(feedback.max()),
        "power_w": float(power.mean()),
    }


def _check(trace: Trace) -> None:
    """Raises ValueError where a trace cannot be summarised."""
    alive = trace.alive
    if alive.ndim != 2 or min(alive.shape[0], alive.shape[1] - 1) < 1:
        raise ValueError(f"a trace must have the axes (episodes, entries), at least 1 and 2, not {alive.shape}")
    if not alive[:, 0].all() or (alive[:, 1:] > alive[:, :-1]).any():
        raise ValueError("a trace must be alive at its first entry and not again after a fall")
    for name, part in trace._asdict().items():
        for array in part if isinstance(part, Nodes) else (part,):
            if name != "time" and not np.isfinite(array[alive]).all():
                raise ValueError(f"{name} is not finite before a fall")


def _summarise_touchdowns(trace: Trace, threshold: float, robot: Robot, boxes: swings.Boxes | None) -> dict[str, Any]:
    found = swings.touchdowns(trace, threshold, robot, boxes)
    missed = found.pop("missed")
    summary: dict[str, Any] = {name: _statistics(values) for name, values in found.items()}
    undecided = int(np.isnan(missed).sum())
    return {"planned": len(missed), "undecided": undecided, "missed_share": _statistics(missed)["mean"], **summary}


def _summarise_clearances(trace: Trace, robot: Robot, boxes: swings.Boxes) -> dict[str, Any]:
    edge, against = swings.clearances(trace, robot, boxes)
    passed = edge[~np.isnan(edge)]
    return {
        "swings": len(passed),
        "edge_cm": _statistics(100 * passed),
        "below_edge_share": _statistics(passed < 0)["mean"],
        "side_contact_share": _statistics(against)["mean"],
    }


def _motion(trace: Trace, episode: int, window: slice) -> Motion:
    real = Nodes(*(part[episode, window].astype(float) for part in trace.measured))
    sway = real.trunk_position[:, :2] - real.trunk_position[:, :2].mean(axis=0)
    turn = np.degrees(_turn(real.trunk_orientation[:1], real.trunk_orientation))
    moved = np.linalg.norm(real.ankle_positions - real.ankle_positions[0], axis=-1)
    return Motion(
        joint_speed_rms_rad_per_s=_rms(trace.qvel[episode, window, 6:]),
        trunk_sway_rms_cm=100 * _rms(np.linalg.norm(sway, axis=-1)),
        trunk_sway_peak_to_peak_cm=100 * float(np.ptp(sway @ _DIRECTIONS, axis=0).max()),
        trunk_turn_rms_deg=_rms(np.linalg.norm(turn - turn.mean(axis=0), axis=-1)),
        trunk_turn_peak_to_peak_deg=float(np.ptp(turn, axis=0).max()),
        foot_motion_cm=100 * float(moved.max()),
    )


def _turn(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """The rotation vectors (k, 3), rad, that turn the quaternions `start` (k, 4) into `end`."""
    # rotations work part by part, so that an axis behind that of the parts does no harm
    between = rotations.multiply(rotations.conjugate(start.T), end.T)
    return np.asarray(rotations.to_rotation_vector(between)).T


def _statistics(values: np.ndarray) -> Statistics:
    """How those values (k,) are spread that are not nan."""
    values = values[~np.isnan(values)].astype(float)
    if not len(values):
        return dict.fromkeys(("mean", "rms", "median", "p5", "p95", "min", "max"))
    shares = zip(("min", "p5", "median", "p95", "max"), np.percentile(values, [0, 5, 50, 95, 100]), strict=True)
    return {"mean": float(values.mean()), "rms": _rms(values), **{name: float(value) for name, value in shares}}


def _interval(means: np.ndarray) -> Statistics:
    """The mean of the means (k,) of episodes and its 95 % interval, within 1 % of Student's t."""
    mean, f = float(means.mean()), len(means) - 1
    if f < 2:
        return {"episode_mean": mean, "episode_low": None, "episode_high": None}
    student = _Z + 2.3723 / f + 2.8225 / f**2 + 2.5558 / f**3 + 1.589 / f**4  # Abramowitz and Stegun 26.7.5
    half = student * float(means.std(ddof=1)) / math.sqrt(len(means))
    return {"episode_mean": mean, "episode_low": mean - half, "episode_high": mean + half}


def _rms(values: np.ndarray) -> float:
    return math.sqrt(np.mean(np.square(values, dtype=float)))
