"""What the tests of pictures and films share: a walk without physics, and where a picture has which colour."""

from collections.abc import Callable
from typing import Any

import numpy as np

from bipedtrack import footsteps, kinematics
from bipedtrack import robot as robots
from bipedtrack.nodes import Nodes, ankles_in_trunk_frame
from bipedtrack.planner import Command
from bipedtrack.trace import Trace

SIZE = (240, 180)
SCRIPT = "\n".join([",".join(footsteps.COLUMNS), "left,0.15,,,0.3,0.4", "right,0.30,,,,0.4", "both,,,,,0.2"])
Rendered = Callable[..., Any]


def walk() -> Trace:
    """One second of walking on target: two steps and a stop."""
    robot = robots.load()
    script = footsteps.parse(SCRIPT, robot, "walk")
    commands = list(footsteps.commands(script, robot.timestep))
    qpos = np.array([posture(robot, command) for command in commands])
    joints = np.zeros((len(qpos), 12))
    return Trace(
        time=np.arange(len(qpos)) * robot.timestep,
        qpos=qpos,
        qvel=np.zeros((len(qpos), 18)),
        target=stacked([command.target for command in commands]),
        measured=stacked([kinematics.measure(robot, q) for q in qpos]),
        timer=np.array([command.timer for command in commands]),
        still=np.zeros(len(qpos), bool),
        feedback=joints,
        joint_targets=joints,
        torques=joints,
        foot_forces=np.zeros((len(qpos), 2)),
        alive=np.ones(len(qpos), bool),
    )


def posture(robot: robots.Robot, command: Command) -> np.ndarray:
    joints = kinematics.inverse(robot, *ankles_in_trunk_frame(command.target))
    return np.concatenate([command.target.trunk_position, command.target.trunk_orientation, joints])


def stacked(each: list[Nodes]) -> Nodes:
    return Nodes(*(np.array(part) for part in zip(*each, strict=True)))


def moved(nodes: Nodes, by: tuple[float, float, float]) -> Nodes:
    return nodes._replace(trunk_position=nodes.trunk_position + by, ankle_positions=nodes.ankle_positions + by)


def green(picture: np.ndarray) -> np.ndarray:
    """Where a picture (height, width, 3) has the colour of targets, (height, width) bool."""
    red, green, blue = np.moveaxis(picture.astype(int), -1, 0)
    return (green > 160) & (red < green - 90) & (blue < green - 90)


def yellow(picture: np.ndarray) -> np.ndarray:
    """Where it has the colour of measured nodes; the prints' orange has less green."""
    red, green, blue = np.moveaxis(picture.astype(int), -1, 0)
    return (np.minimum(red, green) > 170) & (blue < green - 90)


def differences(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The largest difference of the three channels, for each pixel."""
    return np.abs(a.astype(int) - b).max(axis=-1)
