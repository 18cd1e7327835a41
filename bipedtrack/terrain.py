"""The ground: stairs as a window of a few boxes that moves along with the robot, and boxes anywhere for scripts.

A staircase of any length costs three boxes: the treads that the feet stand on, come from and go to. Boxes are longer than
a tread and reach under the next higher one, so one size serves every staircase.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bipedtrack.rotations import Array, namespace

STAIR_BOX = (1.2, 2.0, 0.4)  # length, width, height of a tread's box, m
STAIR_BOXES = 3
PARKED = -10.0  # m, where a box that is not needed waits


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


def parked() -> Array:
    """Poses (3, 7) of the boxes where there are no stairs; numpy."""
    return upright(np.array([[0.0, 0.0, PARKED - i] for i in range(STAIR_BOXES)]))


def upright(centres: Array) -> Array:
    """Poses (n, 7), position m and quaternion, of boxes that stand at centres (n, 3), m, without a turn."""
    xp = namespace(centres)
    turns = xp.asarray([[1.0, 0.0, 0.0, 0.0]] * centres.shape[0], dtype=centres.dtype)
    return xp.concat([centres, turns], axis=-1)
