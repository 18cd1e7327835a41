"""Feedback-error learning: a joint that stands off its feedforward says which feedback would put it there. Not in the paper.

After Kawato, Furukawa and Suzuki, "A hierarchical neural-network model for control and learning of voluntary movement",
Biological Cybernetics 57 (1987): what a feedback controller has to do teaches the feedforward one. Here the errors that PD
controllers are left with, in legs that carry the robot, teach the network beside PPO. PPO itself is slow to remove an error
that is the same for seconds: exploration is white noise, which filter, PD and the body's weight even out, and an update
moves the mean action by less than its deviation.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from bipedtrack import control, observation
from bipedtrack.robot import Robot

LARGEST = 0.02  # of an error that is followed, in half ranges of the joint: what is greater, balance may ask for
_PITCH = np.array([0.0, 0.0, 1.0, 1.0, 1.0, 0.0] * 2, np.float32)  # hip pitch, knee and ankle pitch of both legs


def loss(robot: Robot, observations: jax.Array, actions: jax.Array) -> jax.Array:
    """A term () of the learner's loss: descending it moves the mean actions by the errors of the joints of standing legs.

    The error of a joint is its feedforward less its angle, averaged over those steps of an unroll in which its leg stands:
    what a single step adds to it is noise, or balance. While the robot steps, pitch joints alone count: the sway to the
    sides, to which the others yield, is the gait's own.

    Args:
      robot: whose joints they are.
      observations: (robots, steps, 101) unrolls.
      actions: (robots, steps, 12) the network's mean outputs for them.
    """
    parts = {name: observations[..., part] for name, part in observation.layout().items()}
    legs = (parts["timer"] <= 0).astype(observations.dtype)
    standing = jnp.repeat(legs, 6, axis=-1)
    error = parts["feedforward"] - control.normalize(robot, parts["joint_positions"])
    error = (standing * error).sum(axis=1, keepdims=True) / jnp.maximum(standing.sum(axis=1, keepdims=True), 1.0)
    counts = standing * jnp.where(legs.min(axis=(1, 2), keepdims=True) > 0, 1.0, _PITCH)
    signal = jax.lax.stop_gradient(counts * jnp.clip(error, -LARGEST, LARGEST))
    return -(signal * actions).sum(axis=-1).mean()
