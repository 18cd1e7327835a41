"""What may go otherwise than in the model: pushes, payload, friction, motors, delay, noise and masses, for recordings in C.

Each kind is a ladder of levels; a level is the hooks of a `recording.mujoco_recorder`. Episode i of a level is disturbed the
same way for every policy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

PUSH_AT, PUSH_SECONDS = 3.0, 0.1  # s
DIRECTIONS = 8
NOISE = {"joint angles": 0.01, "trunk tilt": 0.01, "trunk velocity": 0.05, "angular velocity": 0.1, "joint velocities": 0.2}
"""Standard deviations at level 1: rad, rad, m/s, rad/s, rad/s."""


class Hooks(NamedTuple):
    """Where a `recording.mujoco_recorder` lets its e robots be disturbed."""

    # (model, episode) -> the model of that episode, for changed masses, friction or motors
    model_of: Callable[[Any, int], Any] | None = None
    # (tick, datas, joint targets (e, 12)) -> joint targets, for pushes and delays
    before_step: Callable[[int, Sequence[Any], np.ndarray], np.ndarray] | None = None
    # (tick, qpos, qvel) -> what the controller is told of them, for noise
    observed: Callable[[int, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]] | None = None


UNDISTURBED = Hooks()


class Ladder(NamedTuple):
    """A kind of disturbance and its levels."""

    unit: str
    levels: tuple[float, ...]
    hooks: Callable[[float, float], Hooks]  # (level, timestep in s)


def push(impulse: float, timestep: float) -> Hooks:
    """A push of an impulse, N s, on the trunk's centre; episode i gets direction i of DIRECTIONS, seen from above."""
    first, last = round(PUSH_AT / timestep), round((PUSH_AT + PUSH_SECONDS) / timestep)

    def before_step(tick: int, datas: Sequence[Any], targets: np.ndarray) -> np.ndarray:
        if tick in (first, last):
            for i, data in enumerate(datas):
                angle = 2 * np.pi * (i % DIRECTIONS) / DIRECTIONS
                force = impulse / PUSH_SECONDS if tick == first else 0.0
                data.body("trunk").xfrc_applied[:2] = force * np.array([np.cos(angle), np.sin(angle)])
        return targets

    return Hooks(before_step=before_step)


def payload(mass: float, timestep: float) -> Hooks:
    """A mass, kg, about the trunk's centre, spread like the trunk's own."""

    def model_of(model: Any, episode: int) -> Any:
        trunk = model.body("trunk")
        trunk.inertia[:] *= 1 + mass / trunk.mass[0]
        trunk.mass[0] += mass
        return model

    return Hooks(model_of=model_of)


def friction(coefficient: float, timestep: float) -> Hooks:
    """Another sliding friction between soles and ground (1 in the model)."""

    def model_of(model: Any, episode: int) -> Any:
        model.geom_friction[:, 0] = coefficient
        return model

    return Hooks(model_of=model_of)


def motors(strength: float, timestep: float) -> Hooks:
    """Gains and torque limits of every joint times a factor."""

    def model_of(model: Any, episode: int) -> Any:
        model.actuator_gainprm[:, 0] *= strength
        model.actuator_biasprm[:, 1:3] *= strength
        model.actuator_forcerange[:] *= strength
        return model

    return Hooks(model_of=model_of)


def delay(steps: float, timestep: float) -> Hooks:
    """Joint targets reach the motors a number of control steps late."""
    waiting: list[np.ndarray] = []

    def before_step(tick: int, datas: Sequence[Any], targets: np.ndarray) -> np.ndarray:
        if tick == 0:
            waiting[:] = [targets] * int(steps)
        waiting.append(targets)
        return waiting.pop(0)

    return Hooks(before_step=before_step)


def noise(level: float, timestep: float) -> Hooks:
    """White noise on what the controller measures, NOISE times the level."""
    rng = np.random.default_rng(0)

    def observed(tick: int, qpos: np.ndarray, qvel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        def gauss(columns: int, name: str) -> np.ndarray:
            return level * NOISE[name] * rng.standard_normal((len(qpos), columns))

        qpos, qvel = qpos.copy(), qvel.copy()
        qpos[:, 4:7] += gauss(3, "trunk tilt") / 2  # half the angle, to first order
        qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=-1, keepdims=True)
        qpos[:, 7:] += gauss(qpos.shape[1] - 7, "joint angles")
        qvel[:, :3] += gauss(3, "trunk velocity")
        qvel[:, 3:6] += gauss(3, "angular velocity")
        qvel[:, 6:] += gauss(qvel.shape[1] - 6, "joint velocities")
        return qpos, qvel

    return Hooks(observed=observed)


def masses(spread: float, timestep: float) -> Hooks:
    """Every link's mass and inertia times its own random factor in [1 - spread, 1 + spread]."""

    def model_of(model: Any, episode: int) -> Any:
        factors = 1 + spread * np.random.default_rng(episode).uniform(-1, 1, model.nbody)
        model.body_mass[:] *= factors
        model.body_inertia[:] *= factors[:, None]
        return model

    return Hooks(model_of=model_of)


LADDERS = {
    "push": Ladder("N s", (0.0, 10.0, 20.0, 30.0, 40.0, 60.0), push),
    "payload": Ladder("kg", (0.0, 2.0, 5.0, 10.0), payload),
    "friction": Ladder("", (0.3, 0.5, 0.8, 1.0, 1.2), friction),
    "motor strength": Ladder("x", (0.7, 0.85, 1.0, 1.15), motors),
    "delay": Ladder("control steps", (0.0, 1.0, 2.0), delay),
    "observation noise": Ladder("x", (0.0, 0.5, 1.0, 2.0), noise),
    "link masses": Ladder("+-", (0.0, 0.05, 0.1), masses),
}
