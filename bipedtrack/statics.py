"""How the robot's weight bears on it: what its joints carry when it stands still, and how it falls off one foot.

Torques are by virtual work, in closed form: a joint's is what lifting costs, d(potential energy)/dq, less what the ground
pays, F dz/dq of the point where it pushes; the trunk is held in thought, for the forces of the feet hold it. Everything is
level: axes and arms are turned from the trunk frame F_B into one whose z axis is the vertical. The namespace follows the
arguments; axis 0 is (left, right).
"""

from __future__ import annotations

from bipedtrack import kinematics, rotations
from bipedtrack.nodes import Nodes
from bipedtrack.robot import Robot
from bipedtrack.rotations import Array, namespace

GRAVITY = 9.81  # m/s^2
_LOWEST = 0.1  # m: no centre of mass is lower over the feet, but of what cannot be


def pendulum(robot: Robot, nodes: Nodes, foot: Array) -> tuple[Array, Array]:
    """Where the trunk balances on one foot, (2,) m, and its frequency there as a linear inverted pendulum, () 1/s.

    The centre of mass balances over the ankle, the middle of the foot, and the trunk is as far from it as in `nodes`.

    Args:
      robot: its constants.
      nodes: a posture.
      foot: () the index of the stance foot.
    """
    xp = namespace(nodes.trunk_position)
    mass = kinematics.centre_of_mass_at(robot, nodes)
    height = mass[2] - nodes.ankle_positions[:, 2].mean() + robot.ankle_height
    frequency = xp.sqrt(GRAVITY / xp.maximum(height, xp.full_like(height, _LOWEST)))
    return nodes.ankle_positions[foot, :2] + nodes.trunk_position[:2] - mass[:2], frequency


def load(robot: Robot, joints: Array, trunk_orientation: Array, stands: Array) -> Array:
    """The torques (12,), N m, with which the motors hold the robot up.

    Two feet share the weight as its centre of mass lies between them, and push where it is in balance; one foot alone pushes
    under its ankle, for a robot that steps is never in balance.

    Args:
      robot: its constants.
      joints: (12,) rad.
      trunk_orientation: (4,) unit quaternion w x y z, F_B in the world.
      stands: (2,) bool: which feet carry; with none of them the legs hang.
    """
    xp = namespace(joints)
    q = joints.reshape(2, 6)
    to_level = rotations.to_matrix(trunk_orientation).T
    zero, one = xp.zeros_like(q[:, 0]), xp.ones_like(q[:, 0])
    shank, foot = q[:, 2] + q[:, 3], q[:, 2] + q[:, 3] + q[:, 4]

    def level(x: Array, y: Array, z: Array) -> Array:
        """Vectors (2, 3) of the frames that hip yaw and hip roll have turned."""
        return kinematics.turn_hips(q, x, y, z) @ to_level

    def down(thigh: float, shin: float) -> Array:
        """From the hips along the leg: m of the thigh and of the shank."""
        x = -thigh * xp.sin(q[:, 2]) - shin * xp.sin(shank)
        return level(x, zero, -thigh * xp.cos(q[:, 2]) - shin * xp.cos(shank))

    yaw = xp.stack([zero, zero, one], axis=-1) @ to_level
    roll = xp.stack([xp.cos(q[:, 0]), xp.sin(q[:, 0]), zero], axis=-1) @ to_level
    pitch = level(zero, one, zero)
    foot_roll = level(xp.cos(foot), zero, -xp.sin(foot))

    trunk_mass, *masses = (float(mass) for mass in robot.masses)
    in_thigh, in_shank, in_foot = (float(centre) for centre in robot.centres)
    hip, knee, ankle = down(0.0, 0.0), down(robot.thigh, 0.0), down(robot.thigh, robot.shank)
    sole = in_foot * xp.cos(q[:, 5])
    links = [
        down(in_thigh, 0.0),
        down(robot.thigh, in_shank),
        ankle + level(-sole * xp.sin(foot), in_foot * xp.sin(q[:, 5]), -sole * xp.cos(foot)),
    ]
    hips = xp.asarray(robot.hips, dtype=joints.dtype) @ to_level
    mass = trunk_mass + 2 * sum(masses)
    centre = sum(m * (hips + at) for m, at in zip(masses, links, strict=True)).sum(axis=0) / mass

    feet = (hips + ankle)[:, :2]
    line = feet[0] - feet[1]
    share = xp.clip((centre[:2] - feet[1]) @ line / xp.maximum(line @ line, xp.full_like(line[0], 1e-4)), 0.0, 1.0)
    beside = centre[:2] - (share * feet[0] + (1 - share) * feet[1])  # of the line between the ankles
    both = xp.all(stands)
    force = GRAVITY * mass * xp.where(both, xp.stack([share, 1 - share]), xp.where(stands, one, zero))
    pressure = ankle + xp.concat([xp.where(both, beside, xp.zeros_like(beside)), zero[:1]])

    def torque(axis: Array, origin: Array, first: int) -> Array:
        """Of the joints with these axes and origins, which move the links from the first one on: (2,)."""

        def rise(point: Array) -> Array:
            """dz/dq of a point."""
            arm = point - origin
            return axis[:, 0] * arm[:, 1] - axis[:, 1] * arm[:, 0]

        lifted = sum(GRAVITY * m * rise(at) for m, at in zip(masses[first:], links[first:], strict=True))
        return lifted - force * rise(pressure)

    torques = [torque(axis, hip, 0) for axis in (yaw, roll, pitch)]
    torques += [torque(pitch, knee, 1), torque(pitch, ankle, 2), torque(foot_roll, ankle, 2)]
    return xp.stack(torques, axis=-1).reshape(12)
