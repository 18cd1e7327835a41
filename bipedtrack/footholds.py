"""Places for a foot: beside the other one and on from there, on ground of one height, and the nearest that will do."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from bipedtrack import footsteps
from bipedtrack.footsteps import Box
from bipedtrack.nodes import Nodes
from bipedtrack.planner import TaskStep
from bipedtrack.robot import Robot

FOOT_DISTANCE = 0.2  # m between the ankles of feet side by side
GRAIN = 0.01  # m between two looks at the ground
_RISE = 0.2  # m, the highest step up or down that is tried
_REACH = 0.36  # m, the longest step onto a tread
_HALF_TREAD = 0.15  # m from an edge to a foothold on ground that is longer than a tread
_MARGIN = 0.02  # m between a sole and an edge


class Foothold(NamedTuple):
    """A place for a foot."""

    foot: int  # 0 left, 1 right
    x: float  # m, of the point under the ankle
    y: float
    yaw: float  # rad


def beside(start: Nodes, foot: int) -> Foothold:
    """Where the foot stands side by side with the other one."""
    return moved_on(start, foot, np.zeros(3))


def moved_on(start: Nodes, foot: int, advance: np.ndarray) -> Foothold:
    """The foothold beside the other foot, moved on by x m, y m and yaw rad, (3,), as `tasks` has it."""
    stance = 1 - foot
    position, yaw = start.ankle_positions[stance, :2], float(start.ankle_yaws[stance])
    side = np.array([0.5, -0.5]) * FOOT_DISTANCE
    middle = position + turned(yaw, np.array([advance[0], advance[1] - side[stance]]))
    x, y = middle + turned(yaw + advance[2], np.array([0.0, side[foot]]))
    return Foothold(foot, float(x), float(y), yaw + float(advance[2]))


def end_of(step: TaskStep, foot: int) -> Foothold:
    """The foothold at which a foot ends."""
    x, y, _ = step.end.ankle_positions[foot]
    return Foothold(foot, float(x), float(y), float(step.end.ankle_yaws[foot]))


def on_ground(robot: Robot, boxes: Sequence[Box], home: Foothold, wanted: Foothold) -> Foothold:
    """A foothold on the way from home where the whole sole finds ground of one height, near the wanted one.

    Where the way reaches an edge the foot goes to the middle of the next tread, or half a tread beyond the edge; from too
    far away, or before what is too high, it stays half a tread before the edge.
    """
    if not boxes:
        return wanted
    way = np.array([wanted.x - home.x, wanted.y - home.y])
    distance = float(np.hypot(*way))
    direction = way / distance if distance > 1e-6 else np.array([math.cos(home.yaw), math.sin(home.yaw)])
    cosine = abs(float(direction @ [math.cos(wanted.yaw), math.sin(wanted.yaw)]))
    sine = math.sqrt(max(0.0, 1 - cosine * cosine))
    half_length, half_width = robot.sole / 2
    half = half_length * cosine + half_width * sine + _MARGIN
    across = (half_length * sine + half_width * cosine) * np.array([-direction[1], direction[0]])

    def height(s: float) -> float:
        middle = np.array([home.x, home.y]) + s * direction
        return max(footsteps.ground(boxes, *(middle + side * across)) for side in (-1, 0, 1))

    stretches = _stretches(height, -0.3, max(distance, _REACH) + 0.3)
    here = next(i for i, (_, end, _) in enumerate(stretches) if end > 0)
    end, level = stretches[here][1:]
    if distance + half <= end:
        return wanted
    reached = max(0.0, min(distance, end - _HALF_TREAD))
    for first, last, top in stretches[here + 1 :]:
        if abs(top - level) > _RISE:
            break
        if last - first >= 2 * half:
            middle = first + min((last - first) / 2, _HALF_TREAD)
            reached = middle if middle <= _REACH else reached
            break
    return wanted._replace(x=home.x + reached * direction[0], y=home.y + reached * direction[1])


def _stretches(height: Callable[[float], float], first: float, last: float) -> list[tuple[float, float, float]]:
    """Stretches of ground of one height along a way: begin, end and height of each, m."""
    stretches: list[tuple[float, float, float]] = []
    for s in np.arange(first, last, GRAIN):
        top = height(float(s))
        if stretches and abs(stretches[-1][2] - top) < 1e-3:
            stretches[-1] = (stretches[-1][0], float(s) + GRAIN / 2, top)
        else:
            stretches.append((float(s) - GRAIN / 2, float(s) + GRAIN / 2, top))
    return stretches


def nearest(possible: Callable[[np.ndarray], bool], wanted: np.ndarray, home: np.ndarray) -> np.ndarray | None:
    """The possible point nearest to the wanted one, both (2,) m, to about 3 mm of distance; None where home is not possible.

    The way from home ends where the possible ones do; from there every direction that leads nearer is tried.
    """
    best = home + share_of_way(possible, wanted, home) * (wanted - home)
    if not possible(best):
        return None
    turns = np.linspace(0, 2 * math.pi, 12, endpoint=False)
    compass = np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    stride = 0.05
    while stride > 0.003:
        nearer = [p for p in best + stride * compass if math.dist(p, wanted) < math.dist(best, wanted) - 1e-9]
        nearer.sort(key=lambda point: math.dist(point, wanted))
        better = next(filter(possible, nearer), None)
        if better is None:
            stride /= 2
        else:
            best = better
    return best


def share_of_way(possible: Callable[[np.ndarray], bool], wanted: np.ndarray, home: np.ndarray) -> float:
    """The greatest share of the way from home to the wanted point that is possible, to within 1 %."""
    low, high = 0.0, 1.0
    while high - low > 0.01:
        middle = (low + high) / 2
        low, high = (middle, high) if possible(home + middle * (wanted - home)) else (low, middle)
    return low


def turned(yaw: float, vector: np.ndarray) -> np.ndarray:
    """A vector (2,) turned about the vertical."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]])
