"""The controllable nodes (trunk, left ankle, right ankle), their rates and the difference ⊖ between two of them.

Section III-B of the paper. Positions are in the world frame (suffix `_w` where it matters), Z up; the frame F_B is that
of the trunk. Axis 0 of length 2 is (left, right).
"""

from __future__ import annotations

from typing import NamedTuple

from bipedtrack import rotations
from bipedtrack.rotations import Array, namespace


class Nodes(NamedTuple):
    """Where the three nodes are: I^s, I^t or the measured state, in the world frame."""

    trunk_position: Array  # (3,) P_T, m
    trunk_orientation: Array  # (4,) R_T, unit quaternion w x y z
    ankle_positions: Array  # (2, 3) P_L and P_R, m
    ankle_yaws: Array  # (2,) ψ_L and ψ_R, rad


class NodeRates(NamedTuple):
    """Time derivatives of Nodes, in the world frame."""

    trunk_velocity: Array  # (3,) m/s
    trunk_angular_velocity: Array  # (3,) rad/s
    ankle_velocities: Array  # (2, 3) m/s
    ankle_yaw_rates: Array  # (2,) rad/s


class NodeErrors(NamedTuple):
    """Target ⊖ real, in F_B of the real state: 14 numbers."""

    trunk_position: Array  # (3,) m
    trunk_orientation: Array  # (3,) rotation vector, rad
    ankle_positions: Array  # (2, 3) m
    ankle_yaws: Array  # (2,) rad, in (-π, π]


def difference(target: Nodes, real: Nodes) -> NodeErrors:
    """target ⊖ real (eqs 8, 13, 14): vectors and a rotation vector in the real F_B, wrapped yaw angles."""
    to_b = rotations.to_matrix(real.trunk_orientation)
    turn = rotations.multiply(rotations.conjugate(real.trunk_orientation), target.trunk_orientation)
    return NodeErrors(
        trunk_position=(target.trunk_position - real.trunk_position) @ to_b,
        trunk_orientation=rotations.to_rotation_vector(turn),
        ankle_positions=(target.ankle_positions - real.ankle_positions) @ to_b,
        ankle_yaws=rotations.wrap(target.ankle_yaws - real.ankle_yaws),
    )


def rates_in_trunk_frame(rates: NodeRates, trunk_orientation: Array) -> NodeRates:
    """The same rates with their vectors turned from the world frame into the given trunk's frame F_B."""
    to_b = rotations.to_matrix(trunk_orientation)
    return NodeRates(
        rates.trunk_velocity @ to_b,
        rates.trunk_angular_velocity @ to_b,
        rates.ankle_velocities @ to_b,
        rates.ankle_yaw_rates,
    )


def ankles_in_trunk_frame(nodes: Nodes) -> tuple[Array, Array]:
    """Ankle positions (2, 3) in m and yaw angles (2,) in rad, in F_B of the same nodes: the inputs of eq (2).

    A yaw in F_B is the direction of the foot's heading after projection on the trunk's transverse plane.
    """
    xp = namespace(nodes.trunk_position)
    to_b = rotations.to_matrix(nodes.trunk_orientation)
    positions = (nodes.ankle_positions - nodes.trunk_position) @ to_b
    cosine, sine = xp.cos(nodes.ankle_yaws), xp.sin(nodes.ankle_yaws)
    x = cosine * to_b[0, 0] + sine * to_b[1, 0]
    y = cosine * to_b[0, 1] + sine * to_b[1, 1]
    return positions, xp.atan2(y, x)


def stationary(rates: NodeRates) -> Array:
    """() bool: whether the target velocities of all three nodes are zero, but for the rounding of float32."""
    xp = namespace(rates.trunk_velocity)
    return xp.all(xp.abs(xp.concat([part.reshape(-1) for part in rates])) < 1e-5)
