"""Where a robot's centre of mass is going, as seen from its feet, for the critic of PPO. Not in the paper.

Whether a robot can still be stopped is decided within a centimetre or two of its soles' edges. Where it is follows from an
observation, but from thirty of its numbers at once, more finely than a small network resolves them (notebook 48).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from bipedtrack import kinematics, observation
from bipedtrack.robot import Robot
from bipedtrack.statics import GRAVITY

SIZE = 8
_UNIT = 0.05  # m
_FARTHEST = 5.0  # units: the robot falls anyway
_LOWEST = 0.3  # m from ankle to centre of mass: lower, it lies


def features(robot: Robot, observations: jax.Array) -> jax.Array:
    """Capture point and centre of mass in the frames of both feet, (..., 8) of 5 cm, of observations (..., 101).

    In turn: capture point ahead of the left and of the right ankle, to the left of either; the same of the centre of mass.
    The capture point of a linear inverted pendulum is com + v sqrt(height / g) (Pratt, Carff, Drakunov and Goswami,
    Humanoids 2006): where a robot must step, or have its soles, to come to rest. A foot's frame is level, x to its toes.
    """
    flat = observations.reshape(-1, observations.shape[-1])
    return jax.vmap(lambda seen: _features(robot, seen))(flat).reshape(*observations.shape[:-1], SIZE)


def _features(robot: Robot, seen: jax.Array) -> jax.Array:
    parts = {name: seen[part] for name, part in observation.layout().items()}
    joints, up = parts["joint_positions"], -parts["gravity"]
    centre, relative = jax.jvp(lambda q: kinematics.centre_of_mass(robot, q), (joints,), (parts["joint_velocities"],))
    velocity = parts["trunk_velocity"] + jnp.cross(parts["trunk_angular_velocity"], centre) + relative

    ankles, toes = kinematics.forward(robot, joints)
    ahead = toes - (toes @ up)[:, None] * up
    ahead /= jnp.maximum(jnp.linalg.norm(ahead, axis=-1, keepdims=True), 0.1)  # toes straight down have no heading
    left = jnp.cross(up, ahead)

    centre = centre - ankles
    height = jnp.maximum(centre @ up, _LOWEST)[:, None]
    capture = centre + velocity * jnp.sqrt(height / GRAVITY)
    numbers = [(point * axis).sum(axis=-1) for point in (capture, centre) for axis in (ahead, left)]
    return jnp.clip(jnp.concatenate(numbers) / _UNIT, -_FARTHEST, _FARTHEST)
