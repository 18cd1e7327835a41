"""From a command and a feedback to joint targets: feedforward, mixing, clamp and filter (eqs 4-7), and what a PD lacks."""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

from bipedtrack import kinematics, rotations, statics
from bipedtrack.nodes import Nodes, ankles_in_trunk_frame, stationary
from bipedtrack.planner import Command
from bipedtrack.robot import Robot
from bipedtrack.rotations import Array, namespace

LONGEST_HOLD = 0.08  # s for which a policy may hold a feedback: shorter than any task step (planner.SHORTEST) at any pace
INTEGRAL_LIMIT = 0.15  # of the integral, in half ranges of the joints: some three times what standing needs
INTEGRAL_SPEED = 0.3  # rad/s: while any joint is faster the integral waits, and `anchor` measures the feet anew
INTEGRAL_FADES = 0.2  # s: with this time constant while the command moves


def substeps(policy_period: float, timestep: float) -> int:
    """Control steps of `timestep` s that a feedback is held for `policy_period` s.

    Raises ValueError where that is no whole number, or longer than LONGEST_HOLD.
    """
    ratio = policy_period / timestep
    if not (math.isfinite(ratio) and round(ratio) >= 1 and math.isclose(ratio, round(ratio), rel_tol=1e-6)):
        raise ValueError(f"policy_period {policy_period:g} s is no multiple of {timestep:g} s")
    if policy_period > LONGEST_HOLD:
        raise ValueError(f"policy_period {policy_period:g} s is too long; wanted at most {LONGEST_HOLD:g} s")
    return round(ratio)


@dataclasses.dataclass(frozen=True)
class ControlConfig:
    """Parameters of the control law."""

    filter: float = 0.4  # α_filter of eq (7), per control step of 0.005 s
    feedback_scale: float = 0.2  # feedback = clip(scale x network output, -1, 1)
    level_feet: bool = False  # feedforward keeps the soles level in the world (eq 1: parallel to the trunk)
    velocity_feedforward: bool = False  # adds (kd/kp) dq/dt, which cancels the PD's damping of the wanted motion
    gravity_feedforward: bool = False  # adds the posture's torques over kp (`statics.load`); a foot with T = 0 is down
    integral: float = 0.0  # 1/s: adds that times the integral of what the joints lack at rest (`integrate`)

    def __post_init__(self) -> None:
        if not 0 < self.filter <= 1:
            raise ValueError(f"filter must lie in (0, 1], not {self.filter}")
        if not self.feedback_scale > 0:
            raise ValueError(f"feedback_scale must be positive, not {self.feedback_scale}")
        if not 0 <= self.integral < math.inf:
            raise ValueError(f"integral must be finite and not negative, not {self.integral}")


class ControlState(NamedTuple):
    """What the control law remembers from one control step to the next."""

    filtered: Array  # (12,) u_{t-1} of eq (7), in [-1, 1]
    feedforward: Array  # (12,) a_ff of the last control step
    integral: Array  # (12,) of what the joints lack at rest, times its gain, in half ranges
    beside: Array  # (2, 4) m and rad: how far off their targets the feet came to rest (`anchor`)


def feedforward(robot: Robot, settings: ControlConfig, target: Nodes) -> Array:
    """a_ff (12,): the joint angles of the real-time target by inverse kinematics, normalised (eqs 4, 5).

    F_B is the *target* trunk frame: with the measured one the stance leg's target would be where the leg already is, and
    the PD would have nothing to push against. A target out of the workspace is projected first.
    """
    joints = kinematics.inverse(robot, *kinematics.project(robot, *ankles_in_trunk_frame(target)))
    if settings.level_feet:
        joints = kinematics.level_feet(robot, joints, target.trunk_orientation)
    return normalize(robot, joints)


def normalize(robot: Robot, joints: Array) -> Array:
    """Joint angles (12,), rad, as shares of the joints' half ranges from their middles: [-1, 1] (eq 5)."""
    xp = namespace(joints)
    middle, half = (xp.asarray(v, dtype=joints.dtype) for v in (robot.joint_middle, robot.joint_half_range))
    return (joints - middle) / half


def denormalize(robot: Robot, action: Array) -> Array:
    """Joint angles (12,), rad, of control signals in [-1, 1]."""
    xp = namespace(action)
    middle, half = (xp.asarray(v, dtype=action.dtype) for v in (robot.joint_middle, robot.joint_half_range))
    return middle + half * action


def feedback(settings: ControlConfig, output: Array) -> Array:
    """a_fb (..., 12) in [-1, 1] of the network's output (..., 12), its mean or with noise (eqs 9, 10)."""
    return namespace(output).clip(settings.feedback_scale * output, -1.0, 1.0)


def initial(standing: Array, a_ff: Array | None = None) -> ControlState:
    """The state of a controller that has long been asking for the joint angles `standing`, (12,) normalised.

    a_ff: the feedforward of the first command, (12,), where it is another; the velocity feedforward begins at zero.
    """
    xp = namespace(standing)
    return ControlState(
        xp.clip(standing, -1.0, 1.0),
        standing if a_ff is None else a_ff,
        xp.zeros_like(standing),
        xp.zeros((2, 4), dtype=standing.dtype),
    )


def anchor(
    robot: Robot, state: ControlState, target: Nodes, qpos: Array, velocities: Array, rests: Array
) -> tuple[Nodes, ControlState]:
    """The target with its feet where they came to rest, at first at their footholds, and the state. Not in the paper.

    A foot that rests beside its foothold could only be dragged there, by a robot that leans on it; one that creeps away from
    where it came to rest is brought back.

    Args:
      state: after the last control step.
      target: of this instant.
      qpos: (19,), MuJoCo's.
      velocities: (12,) of the joints, rad/s.
      rests: () bool, whether the command stands still.
    """
    xp = namespace(qpos)
    real = kinematics.measure(robot, qpos)
    turned = rotations.wrap(real.ankle_yaws - target.ankle_yaws)
    here = xp.concat([real.ankle_positions - target.ankle_positions, turned[:, None]], axis=-1)
    beside = xp.where(rests & _is_slow(velocities), state.beside, here)
    moved = target._replace(
        ankle_positions=target.ankle_positions + beside[:, :3], ankle_yaws=target.ankle_yaws + beside[:, 3]
    )
    return moved, state._replace(beside=beside)


def integrate(
    robot: Robot, settings: ControlConfig, state: ControlState, wanted: Array, joints: Array, velocities: Array, rests: Array
) -> ControlState:
    """The state with its integral one control step on. Not in the paper.

    A PD needs an error to carry weight, and the feedback, a function of that error, hardly learns to cancel the last of it:
    the integral does, as in any PID. It waits until the robot has come to rest, for until then errors are motion, not load,
    and fades while the command moves.

    Args:
      state: after the last control step.
      wanted: (12,) joint angles without an error, normalised.
      joints: (12,) measured joint angles, rad.
      velocities: (12,) of the joints, rad/s.
      rests: () bool, whether the command stands still.
    """
    xp = namespace(wanted)
    grown = state.integral + settings.integral * robot.timestep * (wanted - normalize(robot, joints))
    kept = xp.where(_is_slow(velocities), xp.clip(grown, -INTEGRAL_LIMIT, INTEGRAL_LIMIT), state.integral)
    return state._replace(integral=xp.where(rests, kept, state.integral * (1 - robot.timestep / INTEGRAL_FADES)))


def _is_slow(velocities: Array) -> Array:
    """() bool: whether every joint is slower than `INTEGRAL_SPEED`."""
    xp = namespace(velocities)
    return xp.all(xp.abs(velocities) < INTEGRAL_SPEED)


def joint_targets(
    robot: Robot, settings: ControlConfig, state: ControlState, a_ff: Array, a_fb: Array, load: Array | None = None
) -> tuple[Array, ControlState]:
    """Joint targets (12,), rad, for the PD and the next state, from feedforward and feedback (12,) in [-1, 1].

    Eq (6) mixes a_ff + k_b a_fb, to which the integral and, for a `load` (12,) in N m, load / kp are added; eq (7) is read
    as a recursive first-order low pass, u_t = clamp(α a_t + (1 - α) u_{t-1}), for only the recursion bounds the rate of the
    targets.
    """
    xp = namespace(a_ff)
    mixed = a_ff + xp.asarray(robot.feedback_ratio, dtype=a_ff.dtype) * a_fb + state.integral
    if load is not None:
        mixed = mixed + load / xp.asarray(robot.kp * robot.joint_half_range, dtype=a_ff.dtype)
    filtered = xp.clip(settings.filter * mixed + (1 - settings.filter) * state.filtered, -1.0, 1.0)
    targets = denormalize(robot, filtered)
    if settings.velocity_feedforward:
        half, lag = (
            xp.asarray(v, dtype=a_ff.dtype) for v in (robot.joint_half_range, robot.kd / (robot.kp * robot.timestep))
        )
        low, high = (xp.asarray(v, dtype=a_ff.dtype) for v in (robot.joint_low, robot.joint_high))
        targets = xp.clip(targets + lag * half * (a_ff - state.feedforward), low, high)
    return targets, state._replace(filtered=filtered, feedforward=a_ff)


def respond(
    robot: Robot,
    settings: ControlConfig,
    state: ControlState,
    a_ff: Array,
    a_fb: Array,
    command: Command,
    qpos: Array,
    qvel: Array,
) -> tuple[Array, ControlState]:
    """The whole law of a control step: the integral and the load of the commanded posture if asked for, `joint_targets`.

    Args:
      state: after the last control step.
      a_ff, a_fb: (12,) feedforward and feedback in [-1, 1].
      command: of this instant.
      qpos, qvel: (19,) and (18,), MuJoCo's state of the robot.
    """
    if settings.integral:
        rests = stationary(command.rates)
        target, state = anchor(robot, state, command.target, qpos, qvel[6:], rests)
        wanted = feedforward(robot, settings, target)
        state = integrate(robot, settings, state, wanted, qpos[7:], qvel[6:], rests)
    load = None
    if settings.gravity_feedforward:
        posture = denormalize(robot, a_ff)
        load = statics.load(robot, posture, command.target.trunk_orientation, command.timer <= 0)
    return joint_targets(robot, settings, state, a_ff, a_fb, load)
