"""When a robot counts as fallen: one rule for all that trains, evaluates, records or drives one.

Functions take and return arrays of one namespace, numpy or jax.numpy, with any leading axes.
"""

from __future__ import annotations

import math

from bipedtrack.nodes import Nodes
from bipedtrack.rotations import Array, namespace

TILT = math.radians(60.0)  # of the trunk; the paper's
DEPTH = 0.35  # m, a trunk below its target
LOST_ANKLE = 0.5  # m, an ankle off its target
_LARGEST = 1e3  # m, rad, m/s or rad/s: a state beyond has exploded; one such number would spoil the normaliser for all


def finite(qpos: Array, qvel: Array) -> Array:
    """(...) bool: whether a state, qpos (..., 19) and qvel (..., 18), has not exploded; false for nan, too."""
    return (abs(qpos) < _LARGEST).all(axis=-1) & (abs(qvel) < _LARGEST).all(axis=-1)


def upright(trunk_orientation: Array) -> Array:
    """(...) bool: whether a trunk, unit quaternions (..., 4), is tilted by less than TILT; false for nan, too."""
    x, y = trunk_orientation[..., 1], trunk_orientation[..., 2]
    return 1 - 2 * (x * x + y * y) > math.cos(TILT)


def fell(target: Nodes, measured: Nodes) -> Array:
    """(...) bool: a trunk tilted by TILT or DEPTH below its target, or an ankle LOST_ANKLE off its; true for nan, too."""
    xp = namespace(measured.trunk_position)
    risen = target.trunk_position[..., 2] - measured.trunk_position[..., 2] < DEPTH
    held = xp.linalg.norm(target.ankle_positions - measured.ankle_positions, axis=-1).max(axis=-1) < LOST_ANKLE
    return ~(upright(measured.trunk_orientation) & risen & held)
