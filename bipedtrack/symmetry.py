"""Left and right exchanged: what a robot's mirror image sees and does, and which of the two a symmetric policy is shown.

A robot that is its own mirror image should act as its mirror image would. A policy whose network is only ever shown the left
foot in the air does so by construction, and has half as much to learn. Joints come in the order of robot.Robot, the axes of
both legs alike.
"""

from __future__ import annotations

import numpy as np

from bipedtrack import observation
from bipedtrack.observation import Observation
from bipedtrack.robot import Robot
from bipedtrack.rotations import Array, namespace

_POINT, _TURN = (1, -1, 1), (-1, 1, -1)  # a vector, and what turns: a rotation vector, an angular velocity
_LEG = (-1, -1, 1, 1, 1, -1)  # hip yaw, roll, pitch, knee, ankle pitch, roll
HIP_PITCH = (2, 8)  # left and right among the joints

_SIGNS = Observation(
    *(_POINT, _TURN, 2 * _POINT, (-1, -1)),
    *(_POINT, _TURN, 2 * _POINT, (-1, -1)),
    *(_POINT, _TURN, 2 * _POINT, (-1, -1)),
    *((1, 1), _POINT, _POINT, _TURN),
    *(2 * _LEG, 2 * _LEG, 2 * _LEG, 2 * _LEG),
)
_BY_LEG = {"timer", "joint_positions", "joint_velocities", "feedforward", "last_feedback"} | {
    name for name in Observation._fields if "ankle" in name
}
# by how much more than rounding the right foot must lead: s later on the ground, and half ranges of hip pitch
LATER, AHEAD = 1e-6, 0.02


def _order() -> list[int]:
    """Which number of an observation becomes which of its mirror image."""
    order: list[int] = []
    for name, part in observation.layout().items():
        numbers = list(range(part.start, part.stop))
        half = len(numbers) // 2
        order += numbers[half:] + numbers[:half] if name in _BY_LEG else numbers
    return order


_ORDER, _SIGN = np.array(_order()), np.concatenate([np.array(part, np.float32) for part in _SIGNS])
_LEGS, _LEGS_SIGN = np.roll(np.arange(12), 6), np.array(2 * _LEG, np.float32)
_TIMER, _FEEDFORWARD = observation.layout()["timer"], observation.layout()["feedforward"]


def mirrored_observation(flat: Array) -> Array:
    """What the mirror image observes, (..., 101), where the robot observes `flat`, (..., 101)."""
    return flat[..., _ORDER] * namespace(flat).asarray(_SIGN, dtype=flat.dtype)


def mirrored_joints(joints: Array) -> Array:
    """The mirror image's joint angles, rates or feedback, (..., 12)."""
    return swapped(joints) * namespace(joints).asarray(_LEGS_SIGN, dtype=joints.dtype)


def swapped(joints: Array) -> Array:
    """Numbers of each joint, (..., 12), with the legs exchanged and no sign changed."""
    return joints[..., _LEGS]


def right_leads(flat: Array) -> Array:
    """Whether the right foot is in the air or, of feet that both stand, is to be ahead, (..., 1) bool.

    Both follow from the command alone, so no noise of a measurement lets it flicker.
    """
    left_time, right_time = flat[..., _TIMER][..., :1], flat[..., _TIMER][..., 1:]
    left_hip, right_hip = (flat[..., _FEEDFORWARD][..., hip : hip + 1] for hip in HIP_PITCH)
    behind = right_hip - left_hip  # a hip's pitch is the less the farther its foot is ahead
    later = right_time - left_time
    return (later > LATER) | ((later >= -LATER) & (behind < -AHEAD))


def canonical(flat: Array) -> tuple[Array, Array]:
    """The observation (..., 101), or its mirror image where the right foot leads, and whether that is so, (..., 1) bool."""
    right = right_leads(flat)
    return namespace(flat).where(right, mirrored_observation(flat), flat), right


def restored(feedback: Array, right: Array) -> Array:
    """The robot's feedback (..., 12) where `feedback` answers what `canonical` gave."""
    return namespace(feedback).where(right, mirrored_joints(feedback), feedback)


def is_symmetric(robot: Robot) -> bool:
    """Whether the robot is its own mirror image: hips, joint ranges, gains and limits."""
    by_joint = (robot.feedback_ratio, robot.kp, robot.kd, robot.torque_limit, robot.joint_half_range)
    same = all(np.allclose(values, swapped(values)) for values in by_joint)
    middles = np.allclose(robot.joint_middle, mirrored_joints(robot.joint_middle))
    return same and middles and np.allclose(robot.hips, robot.hips[::-1] * _POINT)
