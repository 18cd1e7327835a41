"""Feedback-error learning: a joint that stands off its feedforward says which feedback would put it there. Not in the paper.

After Kawato, Furukawa and Suzuki, "A hierarchical neural-network model for control and learning of voluntary movement",
Biological Cybernetics 57 (1987): what a feedback controller has to do teaches the feedforward one. Here the errors that PD
controllers are left with while the robot stands or squats slowly teach the network beside PPO. PPO itself is slow to remove
an error that is the same for seconds: exploration is white noise, which filter, PD and the body's weight even out, and an
update moves the mean action by less than its deviation.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from bipedtrack import control, observation, rewards
from bipedtrack.robot import Robot

LARGEST = 0.02  # of an error that is followed, in half ranges of the joint: what is greater, balance may ask for
SLOW = 0.1  # m/s, on average over an unroll, which the trunk is told to move at most, and by which its velocity may be off


def loss(robot: Robot, observations: jax.Array, actions: jax.Array) -> jax.Array:
    """A term () of the learner's loss: descending it moves the mean actions by the errors of the joints.

    It counts unrolls in which both feet are to stand from the first step to the last and the trunk moves slowly and as it
    should: standing, squatting, holding still. (In a fast squat the error may be what keeps the centre of mass over the
    soles: notebook 47.) The error of a joint is its feedforward less its angle, averaged over the unroll: what a single
    step adds to it is noise, or balance.

    Args:
      robot: whose joints they are.
      observations: (robots, steps, 101) unrolls.
      actions: (robots, steps, 12) the network's mean outputs for them.
    """
    parts = {name: observations[..., part] for name, part in observation.layout().items()}
    error = (parts["feedforward"] - control.normalize(robot, parts["joint_positions"])).mean(axis=1, keepdims=True)
    stands = (parts["timer"] <= 0).all(axis=(1, 2))
    wanted, missing = parts["trunk_velocity_target"], parts["trunk_velocity"] - parts["trunk_velocity_target"]
    slow = (rewards.norm(wanted).mean(axis=1) < SLOW) & (rewards.norm(missing).mean(axis=1) < SLOW)
    signal = jnp.where((stands & slow)[:, None, None], jnp.clip(error, -LARGEST, LARGEST), 0.0)
    return -(jax.lax.stop_gradient(signal) * actions).sum(axis=-1).mean()
