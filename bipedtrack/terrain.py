"""The ground: stairs as a window of a few boxes that moves along with the robot, and boxes anywhere for scripts.

A staircase of any length costs three boxes: the treads that the feet stand on, come from and go to. Boxes are longer than
a tread and reach under the next higher one, so one size serves every staircase.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from bipedtrack import rotations
from bipedtrack.robot import Robot
from bipedtrack.rotations import Array, namespace

STAIR_BOX = (1.2, 2.0, 0.4)  # length, width, height of a tread's box, m
STAIR_BOXES = 3
TREADS_DOWN = 30  # a staircase down starts this many treads above the ground
PARKED = -10.0  # m, where a box that is not needed waits
TOLERANCE = 1e-3  # m: what is this close counts as touching or standing


class Stairs(NamedTuple):
    """A straight staircase along x; tread 0 lies under the origin and is the ground when the stairs go up."""

    rise: Array  # () m per tread, negative downwards, 0: no stairs
    tread: Array  # () m
    height: Array  # () m, of tread 0


def stair_boxes(stairs: Stairs, level: Array) -> Array:
    """Centres (3, 3), m, of the boxes of treads level - 1, level and level + 1, `level` being that of the stance foot.

    Tread i is box i modulo 3, so a box moves only when it is needed elsewhere.
    """
    xp = namespace(stairs.rise)
    slots = xp.arange(STAIR_BOXES)
    levels = level - 1 + (slots - (level - 1)) % STAIR_BOXES
    up = stairs.rise > 0
    # going up a tread begins half a tread before its middle and reaches forward; going down it is mirrored
    reach = 0.5 * STAIR_BOX[0] - 0.5 * stairs.tread
    x = levels * stairs.tread + xp.where(up, reach, -reach)
    top = stairs.height + levels * stairs.rise
    there = (stairs.rise != 0) & (levels >= xp.where(up, 1, 0))
    z = xp.where(there, top - 0.5 * STAIR_BOX[2], PARKED - slots)
    return xp.stack([x, xp.zeros_like(x), z], axis=-1)


def stair_edges(stairs: Stairs, start: Array, end: Array) -> Array:
    """The x and z, m, of the first and the last edge, (..., 2, 2), between the middles of two treads, (..., 3) m each.

    Heights are as those of start and end: of ankles, if those are.
    """
    xp = namespace(start)
    half, none = 0.5 * stairs.tread, xp.zeros_like(stairs.rise)
    first = xp.stack([start[..., 0] + half, start[..., 2] + xp.maximum(stairs.rise, none)], axis=-1)
    last = xp.stack([end[..., 0] - half, end[..., 2] + xp.maximum(-stairs.rise, none)], axis=-1)
    return xp.stack([first, last], axis=-2)


def parked() -> Array:
    """Poses (3, 7) of the boxes where there are no stairs; numpy."""
    return upright(np.array([[0.0, 0.0, PARKED - i] for i in range(STAIR_BOXES)]))


def upright(centres: Array) -> Array:
    """Poses (n, 7), position m and quaternion, of boxes that stand at centres (n, 3), m, without a turn."""
    xp = namespace(centres)
    turns = xp.asarray([[1.0, 0.0, 0.0, 0.0]] * centres.shape[0], dtype=centres.dtype)
    return xp.concat([centres, turns], axis=-1)


# Boxes anywhere


class Box(NamedTuple):
    """An obstacle or a tread, upright, in the world frame."""

    x: float  # m, middle of the bottom face
    y: float
    z: float
    yaw: float  # rad
    length: float  # m, along its own x axis
    width: float
    height: float

    @property
    def size(self) -> tuple[float, float, float]:
        """Length, width and height, m: what `robot.build_model` takes."""
        return self.length, self.width, self.height

    @property
    def top(self) -> float:
        """The height of its top face, m."""
        return self.z + self.height

    @property
    def position(self) -> np.ndarray:
        """Its centre, (3,) m: `data.mocap_pos` of its body."""
        return np.array([self.x, self.y, self.z + self.height / 2])

    @property
    def orientation(self) -> np.ndarray:
        """Its unit quaternion, (4,): `data.mocap_quat` of its body."""
        return np.array(rotations.from_yaw(np.float64(self.yaw)))

    @property
    def corners(self) -> np.ndarray:
        """The corners of its faces seen from above, (4, 2) m."""
        return rectangle(np.array([self.x, self.y]), self.yaw, self.length, self.width)


def ground(boxes: Iterable[Box], x: float, y: float, below: float = math.inf) -> float:
    """The height of the ground at (x, y), m: the highest top that is not above `below`, or the floor."""
    return max([0.0] + [box.top for box in boxes if box.top <= below and _covers(box, x, y)])


def standing_feet(robot: Robot, boxes: Iterable[Box], ankles: np.ndarray) -> list[int]:
    """Indices of the feet with ankles (2, 3), m, that stand on the ground or on a box."""
    boxes = tuple(boxes)
    soles = ankles - np.array([0.0, 0.0, robot.ankle_height])
    return [foot for foot, (x, y, z) in enumerate(soles) if z - ground(boxes, x, y, z + TOLERANCE) <= TOLERANCE]


def _covers(box: Box, x: float, y: float) -> bool:
    """Whether the box lies under or over (x, y), its edges included."""
    c, s = math.cos(box.yaw), math.sin(box.yaw)
    along, across = c * (x - box.x) + s * (y - box.y), c * (y - box.y) - s * (x - box.x)
    return abs(along) <= box.length / 2 + TOLERANCE and abs(across) <= box.width / 2 + TOLERANCE


def rectangle(centre: np.ndarray, yaw: float, length: float, width: float) -> np.ndarray:
    """The corners of a rectangle, (4, 2) m, one after another."""
    c, s = math.cos(yaw), math.sin(yaw)
    half = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * [length / 2, width / 2]
    return centre + half @ np.array([[c, s], [-s, c]])


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    """How deep two rectangles, each (4, 2) m, lie in one another, m; negative where they are apart.

    Convex shapes are apart if they are so along the normal of one of their edges.
    """
    edges = np.concatenate([a[1:3] - a[:2], b[1:3] - b[:2]])
    axes = edges / np.linalg.norm(edges, axis=-1, keepdims=True)  # a rectangle's edges are its normals
    along_a, along_b = a @ axes.T, b @ axes.T
    depths = np.minimum(along_a.max(axis=0), along_b.max(axis=0)) - np.maximum(along_a.min(axis=0), along_b.min(axis=0))
    return float(depths.min())
