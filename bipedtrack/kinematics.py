"""Closed-form kinematics of both legs (eqs 1, 2, 4) and the projection of targets into their workspace.

A leg is hip yaw (z), roll (x), pitch (y), knee (y), ankle pitch (y), ankle roll (x); the three hip axes meet in one
point, the two ankle axes in another. Seen from the foot, the hip lies at r = (x, y, z): its distance gives the knee, its
direction the ankle, and with a horizontal foot (eq 1) hip yaw, roll and pitch are ψ, -(ankle roll) and -(knee + ankle
pitch). Everything is in the trunk frame F_B, axis 0 is (left, right), the namespace follows the arguments.
"""

from __future__ import annotations

import math

from bipedtrack import rotations
from bipedtrack.nodes import Nodes, ankles_in_trunk_frame
from bipedtrack.robot import Robot
from bipedtrack.rotations import Array, namespace

_FAR = 1e3  # m: a target beyond is brought here along its line to the hip, so that its square stays finite
_BLEND = 0.01  # m: this close to the hip, where "away from it" has no direction, targets bend towards straight down


def _hip_from_foot(robot: Robot, ankles: Array, yaws: Array) -> tuple[Array, Array, Array]:
    """The hips (x, y, z), each (2,) in m, from the ankles, in frames turned by the feet's yaw."""
    xp = namespace(ankles)
    offset = xp.asarray(robot.hips, dtype=ankles.dtype) - ankles
    offset = offset / xp.maximum(xp.max(xp.abs(offset), axis=-1, keepdims=True) / _FAR, xp.ones_like(offset))
    cosine, sine = xp.cos(yaws), xp.sin(yaws)
    x, y = offset[:, 0], offset[:, 1]
    return cosine * x + sine * y, cosine * y - sine * x, offset[:, 2]


def _knee(robot: Robot, length: Array) -> tuple[Array, Array]:
    """Knee angle (rad) and the hip's angle in the shank's x-z plane (rad) of legs of the given lengths (m)."""
    xp = namespace(length)
    a, b = robot.thigh, robot.shank
    cosine = xp.clip((length * length - (a * a + b * b)) / (2 * a * b), -1.0, 1.0)
    sine = xp.sqrt(1 - cosine * cosine)
    return xp.atan2(sine, cosine), -xp.atan2(a * sine, b + a * cosine)


def project(robot: Robot, ankles: Array, yaws: Array) -> tuple[Array, Array]:
    """The nearby reachable targets with horizontal feet: ankles (2, 3) in m, yaws (2,) in rad, in F_B.

    Yaw is clamped to the hip's range. Then the ankle moves into the wedge of the roll joints, then along its line to the
    hip into the allowed leg length, then, at that length, within the pitch of hip and ankle. A reachable target stays, and
    the map is continuous everywhere, also at the inner limit: within 1 cm of the hip, where the line has no direction, it
    turns smoothly towards straight down. The result is the nearest reachable point where roll and leg length bind; where a
    pitch limit binds it is the nearest at that leg length, for the nearest of all would jump.
    The result is finite for every finite target.
    """
    xp = namespace(ankles)
    low, high = (xp.asarray(v, dtype=ankles.dtype).reshape(2, 6) for v in (robot.joint_low, robot.joint_high))
    yaws = xp.clip(yaws, low[:, 0], high[:, 0])
    x, y, z = _hip_from_foot(robot, ankles, yaws)

    # ankle roll (and with it -hip roll) is the hip's angle about the foot's x axis
    roll = xp.clip(xp.atan2(y, z), xp.maximum(low[:, 5], -high[:, 1]), xp.minimum(high[:, 5], -low[:, 1]))
    sine, cosine = xp.sin(roll), xp.cos(roll)
    zero = xp.zeros_like(z)
    height = xp.maximum(y * sine + z * cosine, zero)
    roll = xp.atan2(height * sine, height * cosine + xp.maximum(_BLEND - height, zero))

    length = xp.sqrt(x * x + height * height)
    tilt = xp.atan2(x, height + xp.maximum(_BLEND - length, zero))
    length = xp.clip(length, float(robot.leg_length[0]), float(robot.leg_length[1]))

    knee, hip_angle = _knee(robot, length)
    lowest = xp.maximum(hip_angle - high[:, 4], hip_angle + knee + low[:, 2])
    highest = xp.minimum(hip_angle - low[:, 4], hip_angle + knee + high[:, 2])
    tilt = xp.clip(tilt, lowest, highest)

    x, height = length * xp.sin(tilt), length * xp.cos(tilt)
    y, z = height * xp.sin(roll), height * xp.cos(roll)
    cosine, sine = xp.cos(yaws), xp.sin(yaws)
    back = xp.stack([cosine * x - sine * y, sine * x + cosine * y, z], axis=-1)
    return xp.asarray(robot.hips, dtype=ankles.dtype) - back, yaws


def inverse(robot: Robot, ankles: Array, yaws: Array) -> Array:
    """Joint angles (12,), rad, that put reachable ankles (2, 3), m, and yaws (2,), rad, in F_B: `ikine` of eq (2).

    The feet are parallel to the trunk's transverse plane (eq 1). Targets out of reach are for `project` first; here their
    knee is only clamped.
    """
    xp = namespace(ankles)
    x, y, z = _hip_from_foot(robot, ankles, yaws)
    height = xp.sqrt(y * y + z * z)
    knee, hip_angle = _knee(robot, xp.sqrt(x * x + height * height))
    ankle_pitch = hip_angle - xp.atan2(x, height)
    ankle_roll = xp.atan2(y, z)
    joints = xp.stack([yaws, -ankle_roll, -(knee + ankle_pitch), knee, ankle_pitch, ankle_roll], axis=-1)
    return joints.reshape(12)


def centre_of_mass(robot: Robot, joints: Array) -> Array:
    """The centre of mass of the whole robot, (3,) m in F_B, of joint angles (12,), rad."""
    xp = namespace(joints)
    q = joints.reshape(2, 6)
    shank, foot = q[:, 2] + q[:, 3], q[:, 2] + q[:, 3] + q[:, 4]
    trunk_mass, *masses = (float(mass) for mass in robot.masses)
    lengths = robot.thigh, robot.shank, 0.0
    x, z, at_x, at_z = (xp.zeros_like(shank) for _ in range(4))
    for pitch, mass, centre, length in zip((q[:, 2], shank, foot), masses, robot.centres, lengths, strict=True):
        sine, cosine = xp.sin(pitch), xp.cos(pitch)
        x, z = x + mass * (at_x - float(centre) * sine), z + mass * (at_z - float(centre) * cosine)
        at_x, at_z = at_x - length * sine, at_z - length * cosine
    legs = sum(masses) * xp.asarray(robot.hips, dtype=joints.dtype) + turn_hips(q, x, xp.zeros_like(x), z)
    return legs.sum(axis=0) / (trunk_mass + 2 * sum(masses))


def centre_of_mass_at(robot: Robot, nodes: Nodes) -> Array:
    """The centre of mass of a robot on its nodes, or as near as it can reach, (3,) m in the world frame."""
    joints = inverse(robot, *project(robot, *ankles_in_trunk_frame(nodes)))
    return nodes.trunk_position + centre_of_mass(robot, joints) @ rotations.to_matrix(nodes.trunk_orientation).T


def balanced(robot: Robot, nodes: Nodes, centre: Array) -> Nodes:
    """The nodes with the trunk moved level so that the robot's centre of mass stands nearer to `centre`, (2,) m.

    Bent knees carry it up to 8 cm ahead of the trunk. The legs follow the trunk by half, so every application leaves a few
    percent of the distance.
    """
    xp = namespace(centre)
    mass = centre_of_mass_at(robot, nodes)
    move = xp.concat([1.3 * (centre - mass[:2]), xp.zeros_like(centre[:1])])
    return nodes._replace(trunk_position=nodes.trunk_position + move)


def turn_hips(q: Array, x: Array, y: Array, z: Array) -> Array:
    """Rz(hip yaw) Rx(hip roll) applied to (x, y, z) of both legs, (2, 3); q (2, 6) rad, x, y and z (2,)."""
    xp = namespace(q)
    s0, c0, s1, c1 = xp.sin(q[:, 0]), xp.cos(q[:, 0]), xp.sin(q[:, 1]), xp.cos(q[:, 1])
    y, z = c1 * y - s1 * z, s1 * y + c1 * z
    return xp.stack([c0 * x - s0 * y, s0 * x + c0 * y, z], axis=-1)


def forward(robot: Robot, joints: Array) -> tuple[Array, Array]:
    """Ankle positions (2, 3), m, and the feet's x axes (2, 3), in F_B, of joint angles (12,), rad."""
    xp = namespace(joints)
    q = joints.reshape(2, 6)
    pitch = q[:, 2] + q[:, 3]
    x = -robot.thigh * xp.sin(q[:, 2]) - robot.shank * xp.sin(pitch)
    z = -robot.thigh * xp.cos(q[:, 2]) - robot.shank * xp.cos(pitch)
    pitch = pitch + q[:, 4]
    headings = turn_hips(q, xp.cos(pitch), xp.zeros_like(pitch), -xp.sin(pitch))
    return xp.asarray(robot.hips, dtype=joints.dtype) + turn_hips(q, x, xp.zeros_like(x), z), headings


def level_feet(robot: Robot, joints: Array, trunk_orientation: Array) -> Array:
    """The joint angles (12,), rad, of the same ankles and headings with soles that are level in the world, not in F_B.

    Where the trunk is level this changes nothing; where it is tilted, eq (1) would tilt the feet with it. It is `inverse`
    in the foot's frame, which is now level in the world; the hip's axes turn the thigh as that asks for. A heading is that
    of the foot's x axis on the ground. Angles are clamped to the joints' ranges.
    """
    xp = namespace(joints)
    to_w = rotations.to_matrix(trunk_orientation)
    q, (ankles, _) = joints.reshape(2, 6), forward(robot, joints)
    # the direction on the ground whose projection on the trunk's transverse plane is the hip's yaw
    along, across = xp.cos(q[:, 0]), xp.sin(q[:, 0])
    cosine, sine = to_w[1, 1] * along - to_w[1, 0] * across, to_w[0, 0] * across - to_w[0, 1] * along
    length = xp.sqrt(cosine * cosine + sine * sine)
    cosine, sine = cosine / length, sine / length

    x, y, z = ((xp.asarray(robot.hips, dtype=joints.dtype) - ankles) @ to_w.T).T
    x, y = cosine * x + sine * y, cosine * y - sine * x
    height, knee = xp.sqrt(y * y + z * z), q[:, 3]
    pitch = -xp.atan2(robot.thigh * xp.sin(knee), robot.shank + robot.thigh * xp.cos(knee)) - xp.atan2(x, height)
    s_roll, c_roll = y / height, z / height
    s_pitch, c_pitch = xp.sin(knee + pitch), xp.cos(knee + pitch)

    def in_trunk(x: Array, y: Array, z: Array) -> Array:
        """A vector of each thigh's frame, the hip's roll and pitch undone, in F_B: (3, 2)."""
        x, z = c_pitch * x - s_pitch * z, s_pitch * x + c_pitch * z  # Ry(-(knee + pitch))
        y, z = c_roll * y + s_roll * z, c_roll * z - s_roll * y  # Rx(-roll)
        return (xp.stack([cosine * x - sine * y, sine * x + cosine * y, z], axis=-1) @ to_w).T

    zero, one = xp.zeros_like(knee), xp.ones_like(knee)
    ahead, left, up = in_trunk(one, zero, zero), in_trunk(zero, one, zero), in_trunk(zero, zero, one)
    hips = xp.atan2(-left[0], left[1]), xp.asin(xp.clip(left[2], -1.0, 1.0)), xp.atan2(-ahead[2], up[2])
    found = xp.stack([*hips, knee, pitch, xp.atan2(y, z)], axis=-1).reshape(12)
    return xp.clip(found, *(xp.asarray(v, dtype=joints.dtype) for v in (robot.joint_low, robot.joint_high)))


def measure(robot: Robot, qpos: Array) -> Nodes:
    """The nodes of a robot at qpos (19,): trunk position m, trunk quaternion, joint angles rad, in the world frame.

    An ankle's yaw is the direction of the foot's x axis on the ground.
    """
    xp = namespace(qpos)
    ankles, headings = forward(robot, qpos[7:19])
    to_w = rotations.to_matrix(qpos[3:7]).T
    headings = headings @ to_w
    return Nodes(
        trunk_position=qpos[:3],
        trunk_orientation=qpos[3:7],
        ankle_positions=qpos[:3] + ankles @ to_w,
        ankle_yaws=xp.atan2(headings[:, 1], headings[:, 0]),
    )


def reachable(robot: Robot, ankles: Array, yaws: Array, tolerance: float = 1e-3) -> bool:
    """Whether the projection leaves the targets (2, 3) and (2,) where they are, within a tolerance in m and rad."""
    moved, turned = project(robot, ankles, yaws)
    worst = max(float(abs(moved - ankles).max()), float(abs(turned - yaws).max()))
    return math.isfinite(worst) and worst <= tolerance
