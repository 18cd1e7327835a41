"""The observation of eq (8): 101 numbers whose order is the field order of one struct."""

from __future__ import annotations

import hashlib
from typing import NamedTuple

from bipedtrack import nodes, rotations
from bipedtrack.nodes import Nodes
from bipedtrack.planner import Command
from bipedtrack.rotations import Array, namespace


class Observation(NamedTuple):
    """O_t of eq (8). Vectors are in F_B, the measured trunk frame; flattening keeps this order."""

    end_trunk_position: Array  # (3,) I_error^s: end of the task step ⊖ real, m
    end_trunk_orientation: Array  # (3,) rotation vector, rad
    end_ankle_positions: Array  # (2, 3) m
    end_ankle_yaws: Array  # (2,) rad
    target_trunk_position: Array  # (3,) I_error^t: real-time target ⊖ real, m
    target_trunk_orientation: Array  # (3,) rad
    target_ankle_positions: Array  # (2, 3) m
    target_ankle_yaws: Array  # (2,) rad
    trunk_velocity_target: Array  # (3,) I_v^t, m/s
    trunk_angular_velocity_target: Array  # (3,) rad/s
    ankle_velocity_targets: Array  # (2, 3) m/s
    ankle_yaw_rate_targets: Array  # (2,) rad/s
    timer: Array  # (2,) T, s
    gravity: Array  # (3,) g, unit vector
    trunk_velocity: Array  # (3,) v_T, m/s
    trunk_angular_velocity: Array  # (3,) w_T, rad/s
    joint_positions: Array  # (12,) J_P, rad
    joint_velocities: Array  # (12,) J_V, rad/s
    feedforward: Array  # (12,) a_ff
    last_feedback: Array  # (12,) a_fb(t-1)


WIDTHS = Observation(3, 3, 6, 2, 3, 3, 6, 2, 3, 3, 6, 2, 2, 3, 3, 3, 12, 12, 12, 12)
SIZE = sum(WIDTHS)


def layout() -> dict[str, slice]:
    """Where each part of the observation lies in the flat vector."""
    slices, at = {}, 0
    for name, width in WIDTHS._asdict().items():
        slices[name] = slice(at, at + width)
        at += width
    return slices


def layout_hash() -> str:
    """A digest of names, order and widths: a policy trained on another layout must not run on this one."""
    return hashlib.sha256(",".join(f"{k}:{w}" for k, w in WIDTHS._asdict().items()).encode()).hexdigest()[:16]


def observe(command: Command, real: Nodes, qpos: Array, qvel: Array, a_ff: Array, last_feedback: Array) -> Observation:
    """The observation from the command, the measured nodes and MuJoCo's state, (19,) and (18,).

    MuJoCo gives the trunk's linear velocity in the world frame and its angular velocity in F_B.
    """
    to_b = rotations.to_matrix(real.trunk_orientation)
    end, target = nodes.difference(command.end, real), nodes.difference(command.target, real)
    rates = nodes.rates_in_trunk_frame(command.rates, real.trunk_orientation)
    return Observation(
        *end,
        *target,
        *rates,
        timer=command.timer,
        gravity=-to_b[2],
        trunk_velocity=qvel[:3] @ to_b,
        trunk_angular_velocity=qvel[3:6],
        joint_positions=qpos[7:19],
        joint_velocities=qvel[6:18],
        feedforward=a_ff,
        last_feedback=last_feedback,
    )


def flatten(observation: Observation) -> Array:
    """The flat observation, (101,)."""
    xp = namespace(observation.timer)
    return xp.concat([part.reshape(-1) for part in observation])
