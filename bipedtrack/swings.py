"""What becomes of planned swings: where and when feet touch down, and how they clear the edges of boxes.

A trace has the leading axes (episodes, n) here, as in `metrics`. Left and right are those of `robot.LEGS`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bipedtrack import rotations
from bipedtrack.robot import Robot
from bipedtrack.trace import Trace

LEAST_STEP = 0.02  # m: no error is divided by a shorter step
IN_THE_AIR = 0.02  # m above what lies under it, from which a foot is meant to stay up
SIDE_REACH = 0.012  # m: a sole touches with spheres of 0.01 m at its corners, so this near to a side they lie against it
SIDE_DEPTH = 0.005  # m below the edge from which it is the side that is touched, not the top


class Boxes(NamedTuple):
    """The boxes of each episode, upright and where they stay; those with their top at 0 or below count as not there."""

    centres: np.ndarray  # (episodes, b, 3) m
    half_sizes: np.ndarray  # (episodes, b, 3) m
    yaws: np.ndarray  # (episodes, b) rad


class Swings(NamedTuple):
    """The k planned swings that came to their planned end before any fall, as indices into a trace."""

    episode: np.ndarray  # (k,)
    foot: np.ndarray  # (k,) 0 left, 1 right
    liftoff: np.ndarray  # (k,) first entry with a timer; its target is where the foot stood
    touchdown: np.ndarray  # (k,) entry after the last one with a timer; its target is the foothold


def completed(trace: Trace) -> Swings:
    """The planned swings, by the timer: one ends where a foot's timer reaches 0 or starts anew."""
    starts, ends = starts_and_ends(trace.timer)
    n = len(trace.time)
    begun = np.maximum.accumulate(np.where(starts, np.arange(n)[:, None], 0), axis=1)
    episode, touchdown, foot = np.nonzero(ends & trace.alive[..., None])
    return Swings(episode, foot, begun[episode, touchdown - 1, foot], touchdown)


def detect(trace: Trace, planned: Swings, threshold: float) -> tuple[np.ndarray, np.ndarray]:
    """The measured touchdown of each planned swing, (k,) index or -1, and whether there was time to see it, (k,) bool.

    It is the first entry with more than `threshold` N on the foot after one with no more during the planned swing. It is
    sought from the middle of the swing, so that a toe that drags at lift-off is none, until half a swing's time after the
    planned touchdown: the middle of a following step as long as this one. A foot that comes down before the middle of its
    swing and stays there counts from that middle. A foot that is never unloaded touches nothing down.
    """
    n = len(trace.time)
    half = (planned.touchdown - planned.liftoff) // 2
    last = planned.touchdown + half
    width = int((last - planned.liftoff).max(initial=0)) + 1
    index = planned.liftoff[:, None] + np.arange(width)
    episode, foot, inside = planned.episode[:, None], planned.foot[:, None], np.minimum(index, n - 1)
    known = (index <= np.minimum(last, n - 1)[:, None]) & trace.alive[episode, inside]
    loaded = known & (trace.foot_forces[episode, inside, foot] > threshold)
    unloaded = known & ~loaded & (index < planned.touchdown[:, None])
    hit = loaded & np.logical_or.accumulate(unloaded, axis=1) & (index >= (planned.liftoff + half)[:, None])
    found = np.where(hit.any(axis=1), planned.liftoff + hit.argmax(axis=1), -1)
    return found, (found >= 0) | (last < n) | ~trace.alive[planned.episode, -1]


def landing(trace: Trace, robot: Robot, boxes: Boxes | None) -> Swings:
    """The `completed` swings that are to end on the ground or on a box: a foot may also be meant to stay in the air."""
    planned = completed(trace)
    soles = trace.target.ankle_positions[planned.episode, planned.touchdown, planned.foot] - [0, 0, robot.ankle_height]
    above = soles[:, 2].astype(float)
    for i in range(0 if boxes is None else boxes.yaws.shape[1]):
        of_box = (part[planned.episode, i] for part in boxes or ())
        outside, height = _beside(soles[:, None], *of_box)
        under = (outside[:, 0] <= 0) & (height[:, 0] > -IN_THE_AIR)
        above = np.where(under, np.minimum(above, height[:, 0]), above)
    return Swings(*(part[above < IN_THE_AIR] for part in planned))


def touchdowns(trace: Trace, threshold: float, robot: Robot, boxes: Boxes | None = None) -> dict[str, np.ndarray]:
    """What came of k planned touchdowns, (k,) each, with the ground felt from a normal force of more than `threshold` N.

    Errors are those at the planned instant, whether the foot was down or not. Keys as in `metrics.summarise` and
    step_length_cm, in the plane between the targets at lift-off and touchdown; values per step length are nan for steps of
    2 cm and less, time_s is nan where nothing was detected; missed is 1 or 0, and nan where the trace ends too soon to say.
    """
    planned = landing(trace, robot, boxes)
    measured, decided = detect(trace, planned, threshold)
    at = planned.episode, planned.touchdown, planned.foot
    target, real = trace.target.ankle_positions[at].astype(float), trace.measured.ankle_positions[at].astype(float)
    start = trace.target.ankle_positions[planned.episode, planned.liftoff, planned.foot]
    foothold, height = np.linalg.norm((real - target)[:, :2], axis=-1), (real - target)[:, 2]
    yaw = np.degrees(np.abs(rotations.wrap(trace.measured.ankle_yaws[at] - trace.target.ankle_yaws[at])))
    length = np.linalg.norm((target - start)[:, :2], axis=-1)
    divisor = np.where(length > LEAST_STEP, length, np.nan)
    return {
        "step_length_cm": 100 * length,
        "foothold_cm": 100 * foothold,
        "height_cm": 100 * height,
        "yaw_deg": yaw,
        "foothold_per_step": foothold / divisor,
        "height_per_step": np.abs(height) / divisor,
        "yaw_deg_per_m": yaw / divisor,
        "time_s": np.where(measured >= 0, trace.time[measured] - trace.time[planned.touchdown], np.nan),
        "missed": np.where(decided, measured < 0, np.nan),
    }


def clearances(trace: Trace, robot: Robot, boxes: Boxes) -> tuple[np.ndarray, np.ndarray]:
    """For each planned swing, also one that a fall cuts short, how it cleared the boxes: (k,) m and (k,) bool.

    The first is the least height of a corner of the sole above the top of a box at the moment when that corner passes over
    the upper edge of the box, in or out, interpolated between entries; nan where it passes none. The second says whether a
    corner came against the side of a box, 12 mm or nearer and 5 mm or more below its edge: a foot that is stopped there
    passes no edge and has no clearance. The corners follow the foot with its pitch and roll, by the joint angles; what
    lies between them is not looked at, for it touches nothing in the simulation either.
    """
    starts, _ = starts_and_ends(trace.timer)
    # in the order of episode, foot, time, so that a swing's entries follow one another
    number = np.cumsum(starts.swapaxes(1, 2)).reshape(len(starts), 2, -1) - 1
    episode, foot, index = np.nonzero((trace.timer > 0).swapaxes(1, 2) & trace.alive[:, None, :])
    number = number[episode, foot, index]
    kept, number = np.unique(number, return_inverse=True)
    corners = sole_corners(robot, trace.qpos[episode, index], trace.measured.ankle_positions[episode, index, foot], foot)
    same = (number[1:] == number[:-1])[:, None]
    least, against = np.full(len(kept), np.inf), np.zeros(len(kept), bool)
    for i in range(boxes.yaws.shape[1]):
        centre, half = boxes.centres[episode, i], boxes.half_sizes[episode, i]
        outside, above = _beside(corners, centre, half, boxes.yaws[episode, i])
        there = (centre[:, 2] + half[:, 2] > 0)[:, None]
        passes = same & there[1:] & ((outside[1:] > 0) != (outside[:-1] > 0))
        share = outside[:-1][passes] / (outside[:-1] - outside[1:])[passes]
        height = above[:-1][passes] + share * (above[1:] - above[:-1])[passes]
        np.minimum.at(least, number[1:][np.nonzero(passes)[0]], height)
        beside = (above <= -SIDE_DEPTH) & (np.abs(outside) <= SIDE_REACH)
        against[number[beside.any(axis=-1)]] = True
    return np.where(np.isinf(least), np.nan, least), against


def sole_corners(robot: Robot, qpos: np.ndarray, ankles: np.ndarray, foot: np.ndarray) -> np.ndarray:
    """The corners (k, 4, 3), m, in the world, of the soles of feet (k,) of robots at qpos (k, 19) with ankles (k, 3), m."""
    states = qpos.T.astype(float)
    yaw, roll, *pitches, ankle_roll = states[7:].reshape(2, 6, -1)[foot, :, np.arange(len(foot))].T
    level = np.zeros_like(yaw)
    hip, rest = rotations.from_euler(roll, level, yaw), rotations.from_euler(ankle_roll, sum(pitches), level)
    orientation = rotations.multiply(rotations.multiply(states[3:7], hip), rest)[..., None]
    length, width = robot.sole / 2
    corners = np.array([[0, x, y, -robot.ankle_height] for x in (length, -length) for y in (width, -width)]).T[:, None]
    turned = rotations.multiply(rotations.multiply(orientation, corners), rotations.conjugate(orientation))
    return ankles[:, None] + np.moveaxis(turned[1:], 0, -1)


def starts_and_ends(timer: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where swings start and end, each (episodes, n, 2) bool; the timer only falls during a swing."""
    before = np.concatenate([np.zeros_like(timer[:, :1]), timer[:, :-1]], axis=1)
    starts = timer > before
    return starts, (before > 0) & (starts | ~(timer > 0))


def _beside(points: np.ndarray, centre: np.ndarray, half: np.ndarray, yaw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far points (k, p, 3) lie outside the outline of box k, negative within, and above its top: (k, p) m each."""
    x, y, z = np.moveaxis(points - centre[:, None], -1, 0)
    cosine, sine = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    along, across = np.abs(cosine * x + sine * y), np.abs(cosine * y - sine * x)
    return np.maximum(along - half[:, :1], across - half[:, 1:2]), z - half[:, 2:]
