"""Policies for tests to play with: random networks of any size on the robot of Table I."""

import dataclasses

import numpy as np

from bipedtrack import observation, robot
from bipedtrack.control import ControlConfig
from bipedtrack.policy import Network, Policy

ROBOT = robot.load()
JOINTS = len(ROBOT.joint_names)


def random_network(seed, hidden=(32, 32), output=1.0):
    """A network with no zeros in it, whose outputs are of the order of `output`."""
    rng = np.random.default_rng(seed)
    sizes = (observation.SIZE, *hidden, JOINTS)
    gains = [1.0] * len(hidden) + [output]
    layers = list(zip(sizes, sizes[1:], gains, strict=False))
    return Network(
        mean=rng.normal(size=observation.SIZE).astype(np.float32),
        std=rng.uniform(0.05, 2, observation.SIZE).astype(np.float32),
        weights=tuple((g * rng.normal(size=(n, m)) / np.sqrt(n)).astype(np.float32) for n, m, g in layers),
        biases=tuple((0.1 * g * rng.normal(size=m)).astype(np.float32) for _, m, g in layers),
    )


def make_policy(network, policy_period=0.02, settings=None):
    return Policy(network, "swish", settings or ControlConfig(), policy_period, ROBOT, {"curriculum": "none", "seed": 3})


def small_policy():
    """A policy whose every number differs from the defaults."""
    made = make_policy(random_network(2, (8, 6)), settings=ControlConfig(filter=0.3, velocity_feedforward=True))
    return dataclasses.replace(made, symmetric=True, sway=0.25)
