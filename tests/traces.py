"""What the tests of traces share: robots that stand on their targets, for a test to move; figures; MuJoCo's own nodes."""

import math
from typing import Any

import mujoco
import numpy as np

from bipedtrack import metrics
from bipedtrack.nodes import Nodes
from bipedtrack.robot import Robot
from bipedtrack.trace import Trace

DT = 0.005  # s
WEIGHT = 400.0  # N, so that a foot stands from more than 20 N on


def standing(episodes: int = 1, n: int = 100) -> Trace:
    """Robots that stand on their target for n control steps; the command neither swings a foot nor rests."""
    feet = np.array([[0, 0.1, 0.04], [0, -0.1, 0.04]])

    def nodes() -> Nodes:
        ones = np.ones((episodes, n))
        return Nodes(
            trunk_position=ones[..., None] * [0, 0, 0.75],
            trunk_orientation=ones[..., None] * [1, 0, 0, 0],
            ankle_positions=ones[..., None, None] * feet,
            ankle_yaws=np.zeros((episodes, n, 2)),
        )

    target = nodes()
    joints = np.zeros((episodes, n, 12))
    return Trace(
        time=np.arange(n) * DT,
        qpos=np.concatenate([target.trunk_position, target.trunk_orientation, joints], axis=-1),
        qvel=np.zeros((episodes, n, 18)),
        target=target,
        measured=nodes(),
        timer=np.zeros((episodes, n, 2)),
        still=np.zeros((episodes, n), bool),
        feedback=joints.copy(),
        joint_targets=joints.copy(),
        torques=joints.copy(),
        foot_forces=np.full((episodes, n, 2), WEIGHT / 2),
        alive=np.ones((episodes, n), bool),
    )


def swing(trace: Trace, liftoff: int, touchdown: int, foot: int = 0, episode: int = 0) -> None:
    """Plans a swing of a foot from one entry to another, in place; the foot bears nothing meanwhile."""
    trace.timer[episode, liftoff:touchdown, foot] = np.arange(touchdown - liftoff, 0, -1) * DT
    trace.foot_forces[episode, liftoff:touchdown, foot] = 0


def summary(trace: Trace, robot: Robot, **options: Any) -> dict[str, Any]:
    return metrics.summarise(trace, robot, WEIGHT, **options)


def by_mujoco(model: mujoco.MjModel, states: np.ndarray) -> Nodes:
    """The nodes at qpos (n, 19) by MuJoCo's own kinematics."""
    data, found = mujoco.MjData(model), []
    feet = [data.body(name) for name in ("left_foot", "right_foot")]
    for qpos in states:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        yaws = [math.atan2(foot.xmat[3], foot.xmat[0]) for foot in feet]
        trunk = data.body("trunk")
        found.append((trunk.xpos.copy(), trunk.xquat.copy(), [foot.xpos.copy() for foot in feet], yaws))
    return Nodes(*map(np.array, zip(*found, strict=True)))
