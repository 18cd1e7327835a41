"""The reward of eqs (11)-(16), term by term.

Terms and weights are one struct type, so a misspelt weight cannot load. Three readings differ from the print: eqs (13),
(14) use the real-time target (superscript t); the sums of eqs (15), (16) are of absolute values with a negative sign; and
(16) holds where all targets stand still, as the sentence before it says, not where they move.
"""

from __future__ import annotations

from typing import NamedTuple

from bipedtrack import nodes
from bipedtrack.nodes import NodeErrors, NodeRates
from bipedtrack.rotations import Array, namespace


class Terms(NamedTuple):
    """The terms of one policy step before weighting, each a scalar array (), or their weights w, each a float."""

    live: float  # r_live, eq (11): 1 at every step, of which a fall takes away those that would follow
    trunk_position: float  # eq (13), in (0, 1]
    trunk_orientation: float  # eq (13), in (0, 1]
    left_ankle_position: float  # eq (14), in (0, 1]
    left_ankle_yaw: float
    right_ankle_position: float
    right_ankle_yaw: float
    feedback: float  # r_fb, eq (15), in [-1, 0]
    static_velocity: float  # r_staticJV, eq (16), in [-1, 0]; 0 unless every target stands still
    static_acceleration: float  # r_staticJA, eq (16)
    feedback_rate: float  # ours, not the paper's: change of the feedback, in [-1, 0]


WEIGHTS = Terms(
    live=0.5,
    trunk_position=0.2,
    trunk_orientation=0.1,
    left_ankle_position=1.0,
    left_ankle_yaw=0.5,
    right_ankle_position=1.0,
    right_ankle_yaw=0.5,
    feedback=0.1,
    static_velocity=0.1,
    static_acceleration=0.1,
    feedback_rate=0.2,
)  # those of the trunk are 0.2 of the ankles'


class Sharpness(NamedTuple):
    """The factors σ. Those of sums over the 12 joints are per joint; 0.0833 is 1/12, a mean."""

    trunk_position: float = 5.0  # 1/m
    trunk_orientation: float = 3.0  # 1/rad
    ankle_position: float = 10.0  # 1/m
    ankle_yaw: float = 5.0  # 1/rad
    feedback: float = 0.0833  # per unit of feedback, for each joint
    static_velocity: float = 0.02  # per rad/s, for each joint
    static_acceleration: float = 0.0002  # per rad/s^2, for each joint
    feedback_rate: float = 0.0833  # per unit of change, for each joint


class RewardConfig(NamedTuple):
    """What the curriculum sets of the reward."""

    weights: Terms = WEIGHTS
    sharpness: Sharpness = Sharpness()

    def validate(self) -> None:
        """Raises ValueError where a number is negative: errors would be rewarded."""
        for table, numbers in self._asdict().items():
            for name, value in numbers._asdict().items():
                if value < 0:
                    raise ValueError(f"{table}.{name} must not be negative, not {value:g}")


def norm(x: Array) -> Array:
    """Euclidean length along the last axis."""
    xp = namespace(x)
    return xp.sqrt((x * x).sum(axis=-1))


def terms(
    sharpness: Sharpness,
    errors: NodeErrors,
    rates: NodeRates,
    a_fb: Array,
    last_a_fb: Array,
    joint_velocities: Array,
    joint_accelerations: Array,
) -> Terms:
    """The terms from the errors (target ⊖ real, F_B), the target's rates, feedback (12,), rad/s and rad/s^2 (12,).

    The environment gives MuJoCo's qacc, which is before the implicit damping of the joints: about 2.5 times of what the
    velocities then change by (mean over squats).
    """
    xp = namespace(a_fb)

    def penalty(values: Array, sigma: float) -> Array:
        return xp.clip(-(sigma * xp.abs(values)).sum(), -1.0, 0.0)

    ankles = xp.exp(-sharpness.ankle_position * norm(errors.ankle_positions))
    yaws = xp.exp(-sharpness.ankle_yaw * xp.abs(errors.ankle_yaws))
    still = nodes.stationary(rates)
    zero = xp.zeros_like(a_fb[0])
    return Terms(
        live=xp.ones_like(a_fb[0]),
        trunk_position=xp.exp(-sharpness.trunk_position * norm(errors.trunk_position)),
        trunk_orientation=xp.exp(-sharpness.trunk_orientation * norm(errors.trunk_orientation)),
        left_ankle_position=ankles[0],
        left_ankle_yaw=yaws[0],
        right_ankle_position=ankles[1],
        right_ankle_yaw=yaws[1],
        feedback=penalty(a_fb, sharpness.feedback),
        static_velocity=xp.where(still, penalty(joint_velocities, sharpness.static_velocity), zero),
        static_acceleration=xp.where(still, penalty(joint_accelerations, sharpness.static_acceleration), zero),
        feedback_rate=penalty(a_fb - last_a_fb, sharpness.feedback_rate),
    )


def total(weights: Terms, values: Terms) -> Array:
    """The weighted sum of eq (11), ()."""
    return sum(weight * value for weight, value in zip(weights, values, strict=True))
