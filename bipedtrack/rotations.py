"""Rotations of one body: unit quaternions (w, x, y, z), rotation vectors and yaw angles.

Every function takes and returns arrays of one namespace (numpy or jax.numpy, taken from its first argument) and no
batch axes beyond those named. Angles are in radians.
"""

from __future__ import annotations

from typing import Any

import numpy as np

Array = Any  # a numpy or a jax array


def namespace(x: Array) -> Any:
    """The array namespace of x: jax.numpy for a jax array or tracer, numpy for anything numpy made."""
    return x.__array_namespace__() if hasattr(x, "__array_namespace__") else np


def multiply(a: Array, b: Array) -> Array:
    """The Hamilton product a ⊗ b, shape (4,): first the rotation b, then a."""
    w, x, y, z = a[0], a[1], a[2], a[3]
    p, q, r, s = b[0], b[1], b[2], b[3]
    return namespace(a).stack(
        [
            w * p - x * q - y * r - z * s,
            w * q + x * p + y * s - z * r,
            w * r - x * s + y * p + z * q,
            w * s + x * r - y * q + z * p,
        ]
    )


def conjugate(q: Array) -> Array:
    """The inverse of a unit quaternion, shape (4,)."""
    return namespace(q).stack([q[0], -q[1], -q[2], -q[3]])


def to_matrix(q: Array) -> Array:
    """The matrix of a unit quaternion, shape (3, 3): `matrix @ v_b` is v_w, and `v_w @ matrix` is v_b."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    xx, yy, zz = x * x, y * y, z * z
    xy, xz, yz, wx, wy, wz = x * y, x * z, y * z, w * x, w * y, w * z
    xp = namespace(q)
    return xp.stack(
        [
            1 - 2 * (yy + zz), 2 * (xy - wz), 2 * (xz + wy),
            2 * (xy + wz), 1 - 2 * (xx + zz), 2 * (yz - wx),
            2 * (xz - wy), 2 * (yz + wx), 1 - 2 * (xx + yy),
        ]
    ).reshape(3, 3)  # fmt: skip


def from_rotation_vector(v: Array) -> Array:
    """The unit quaternion, shape (4,), of a rotation by |v| about v, shape (3,)."""
    xp = namespace(v)
    square = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    small = square < 1e-8
    angle = xp.sqrt(xp.where(small, xp.ones_like(square), square))
    # sin(a/2)/a, by its series where a division would lose the digits
    scale = xp.where(small, 0.5 - square / 48, xp.sin(angle / 2) / angle)
    real = xp.where(small, 1 - square / 8, xp.cos(angle / 2))
    return xp.stack([real, scale * v[0], scale * v[1], scale * v[2]])


def to_rotation_vector(q: Array) -> Array:
    """The shortest rotation vector, shape (3,) with a length of at most π, of a unit quaternion."""
    xp = namespace(q)
    w = xp.abs(q[0])
    sign = xp.where(q[0] < 0, -xp.ones_like(w), xp.ones_like(w))
    square = q[1] * q[1] + q[2] * q[2] + q[3] * q[3]
    small = square < 1e-8
    sine = xp.sqrt(xp.where(small, xp.ones_like(square), square))
    scale = xp.where(small, 2 + square / 3, 2 * xp.atan2(sine, w) / sine)
    return (sign * scale) * q[1:4]


def from_yaw(yaw: Array) -> Array:
    """The quaternion, shape (4,), of a turn by the scalar yaw about the vertical."""
    xp = namespace(yaw)
    zero = xp.zeros_like(yaw)
    return xp.stack([xp.cos(yaw / 2), zero, zero, xp.sin(yaw / 2)])


def from_euler(roll: Array, pitch: Array, yaw: Array) -> Array:
    """The quaternion, shape (4,), of Rz(yaw) Ry(pitch) Rx(roll), each a scalar."""
    xp = namespace(roll)
    cr, sr, cp, sp = xp.cos(roll / 2), xp.sin(roll / 2), xp.cos(pitch / 2), xp.sin(pitch / 2)
    cy, sy = xp.cos(yaw / 2), xp.sin(yaw / 2)
    return xp.stack(
        [
            cy * cp * cr + sy * sp * sr,
            cy * cp * sr - sy * sp * cr,
            cy * sp * cr + sy * cp * sr,
            sy * cp * cr - cy * sp * sr,
        ]
    )


def to_euler(q: Array) -> tuple[Array, Array, Array]:
    """Roll, pitch and yaw, rad, of a quaternion (4,): the inverse of `from_euler` for pitches within ±π/2."""
    xp = namespace(q)
    turn = to_matrix(q)
    pitch = -xp.asin(xp.clip(turn[2, 0], -1.0, 1.0))
    return xp.atan2(turn[2, 1], turn[2, 2]), pitch, xp.atan2(turn[1, 0], turn[0, 0])


def wrap(angle: Array) -> Array:
    """The same angles in (-π, π], any shape."""
    xp = namespace(angle)
    return angle - 2 * np.pi * xp.ceil((angle - np.pi) / (2 * np.pi))
