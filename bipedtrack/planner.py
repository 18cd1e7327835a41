"""The trajectory planner: a task step and a time give the command of eq (3).

Ankles follow Bezier curves of any order (the paper's are of fourth order) or trigonometric ones; the trunk moves at
uniform velocity and angular velocity; rates are analytic. Section III-C of the paper. A task step is data: whatever
writes its control points plans the motion.

A Bezier curve that is run through uniformly leaves the ground at up to 4 m/s, which no foot at rest can follow; `ease`
lets it gather speed first. The paper says nothing of it; 0 is uniform.

A trunk that moves uniformly midway between two feet of which one alone carries it is what no robot can do: it would have
to be pushed from where nothing stands. `pendulum` lets it sway across the stance foot as its weight makes it do (Kajita et
al., "The 3D linear inverted pendulum mode", IROS 2001). Along the foot, which is longer than wide, it stays uniform: as a
pendulum it would end a step faster than that, and could not stop there. Not in the paper; 0 is uniform.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from bipedtrack import rotations
from bipedtrack.nodes import NodeRates, Nodes
from bipedtrack.rotations import Array, namespace

_LONG_AGO = 60.0  # time constants: nothing of a pendulum's start is left
_SAMPLES = 33  # points of a curve that are held against edges


SHORTEST = 0.1  # s, of a task step: policies answer sooner (control.LONGEST_HOLD), and MJX looks ahead to one step


class TaskStep(NamedTuple):
    """One foot's movement from leaving the ground to returning to it, or a movement of the trunk alone."""

    start: Nodes  # at time 0
    end: Nodes  # I^s, at time `period`
    period: Array  # () s
    swing: Array  # (2,) 1 where the foot is in the air, else 0
    ankle_points: Array  # (2, n + 1, 3) Bezier control points in the world, m; constant for a stance foot
    lift: Array  # (2,) m, height of a trigonometric curve above its chord
    trigonometric: Array  # () 1: ankles follow trigonometric curves, 0: Bezier curves
    ease: Array  # () share of the period in which Bezier curves gather speed from rest, and brake to rest; below 0.5
    pivot: Array  # (2,) m, where the trunk would balance on the stance foot
    pendulum: Array  # () 1/s, sqrt(g / height) of a trunk that sways across the stance foot; 0: it moves uniformly


class Command(NamedTuple):
    """The control input I of eq (3) at one instant, and the derivative I_v^t of eq (8), in the world frame."""

    end: Nodes  # I^s
    target: Nodes  # I^t
    rates: NodeRates  # dI^t/dt
    timer: Array  # (2,) T: s until the swing foot touches the ground, 0 for a stance foot


def bezier(points: Array, s: Array) -> tuple[Array, Array]:
    """The point and the derivative by s, each (..., 3), of Bezier curves (..., n + 1, 3) at s in [0, 1] (de Casteljau)."""
    order = points.shape[-2] - 1
    for _ in range(order - 1):
        points = points[..., :-1, :] + s * (points[..., 1:, :] - points[..., :-1, :])
    chord = points[..., 1, :] - points[..., 0, :]
    return points[..., 0, :] + s * chord, order * chord


def trigonometric(start: Array, end: Array, lift: Array, s: Array) -> tuple[Array, Array]:
    """The point and the derivative by s, each (2, 3), of cycloid-like curves from start to end, (2, 3), lifted by (2,) m.

    Speed is zero at both ends.
    """
    xp = namespace(start)
    angle = 2 * math.pi * s
    along, along_rate = s - xp.sin(angle) / (2 * math.pi), 1 - xp.cos(angle)
    up = xp.stack([xp.zeros_like(lift), xp.zeros_like(lift), lift], axis=-1)
    point = start + along * (end - start) + (0.5 - 0.5 * xp.cos(angle)) * up
    return point, along_rate * (end - start) + (math.pi * xp.sin(angle)) * up


def eased(share: Array, ease: Array) -> tuple[Array, Array]:
    """How far along a curve is at a share of the time, both in [0, 1], and the derivative; () each.

    The speed rises evenly from zero during the first `ease` of the time, () in [0, 0.5), and falls evenly to zero during
    the last; with 0 it is uniform.
    """
    xp = namespace(share)
    top = 1 / (1 - ease)
    from_end = xp.minimum(share, 1 - share)
    ramp = xp.maximum(ease, xp.full_like(ease, 1e-6))
    speed = top * xp.minimum(from_end / ramp, xp.ones_like(share))
    way = xp.where(from_end < ease, 0.5 * speed * from_end, top * (from_end - 0.5 * ease))
    return xp.where(share < 0.5, way, 1 - way), xp.where(ease > 0, speed, xp.ones_like(share))


def swayed(step: TaskStep, time: Array) -> tuple[Array, Array]:
    """Where a trunk is that falls away from the pivot as a linear inverted pendulum, (2,) m, and its velocity, (2,) m/s.

    At the start at time 0 and at the end at time T: (x(0) sinh(w (T - t)) + x(T) sinh(w t)) / sinh(w T) from the pivot,
    w the pendulum's frequency. time: () s within the period.
    """
    xp = namespace(step.period)
    period = step.period
    w = xp.where(step.pendulum > 0, step.pendulum, xp.ones_like(step.pendulum))

    def decayed(seconds: Array) -> Array:
        return xp.exp(-xp.minimum(w * seconds, xp.full_like(period, _LONG_AGO)))

    def share(gone: Array) -> tuple[Array, Array]:
        """sinh(w (T - gone)) / sinh(w T), which no long period lets overflow, and how fast it falls."""
        near, far, whole = decayed(gone), decayed(2 * period - gone), 1 - decayed(2 * period)
        return (near - far) / whole, w * (near + far) / whole

    of_start, loss = share(time)
    of_end, gain = share(period - time)
    start, end = (nodes.trunk_position[:2] - step.pivot for nodes in (step.start, step.end))
    return step.pivot + of_start * start + of_end * end, gain * end - loss * start


def _across_stance(step: TaskStep) -> Array:
    """The direction in which a trunk sways, (2,): to the left of the stance foot; zero where it does not sway."""
    xp = namespace(step.period)
    heading = ((1 - step.swing) * step.start.ankle_yaws).sum()
    left = xp.stack([-xp.sin(heading), xp.cos(heading)])
    return xp.where(step.pendulum > 0, left, xp.zeros_like(left))


def command(step: TaskStep, time: Array) -> Command:
    """The command at `time` seconds, (), into the step; from the period on its end stands still (rates and T are zero)."""
    xp = namespace(step.period)
    running = xp.where(time < step.period, xp.ones_like(step.period), xp.zeros_like(step.period))
    s = xp.clip(time / step.period, 0.0, 1.0)
    per_second = running / step.period
    start, end = step.start, step.end

    along, along_rate = eased(s, step.ease)
    on_bezier, bezier_rate = bezier(step.ankle_points, along)
    on_sine, sine_rate = trigonometric(start.ankle_positions, end.ankle_positions, step.lift, s)
    ankles = xp.where(step.trigonometric > 0, on_sine, on_bezier)
    ankle_rates = xp.where(step.trigonometric > 0, sine_rate, along_rate * bezier_rate)

    turn = rotations.multiply(rotations.conjugate(start.trunk_orientation), end.trunk_orientation)
    turn = rotations.to_rotation_vector(turn)  # constant axis: the same in both trunk frames
    orientation = rotations.multiply(start.trunk_orientation, rotations.from_rotation_vector(s * turn))
    travel = end.trunk_position - start.trunk_position
    across = _across_stance(step)
    straight, uniform = start.trunk_position[:2] + s * travel[:2], per_second * travel[:2]
    place, velocity = swayed(step, s * step.period)
    place = straight + across * (across @ (place - straight))
    velocity = uniform + across * (across @ (running * velocity - uniform))
    yaw_travel = rotations.wrap(end.ankle_yaws - start.ankle_yaws)

    target = Nodes(
        trunk_position=xp.concat([place, start.trunk_position[2:] + s * travel[2:]]),
        trunk_orientation=orientation,
        ankle_positions=ankles,
        ankle_yaws=start.ankle_yaws + (s * s * (3 - 2 * s)) * yaw_travel,
    )
    rates = NodeRates(
        trunk_velocity=xp.concat([velocity, per_second * travel[2:]]),
        trunk_angular_velocity=rotations.to_matrix(start.trunk_orientation) @ (per_second * turn),
        ankle_velocities=per_second * ankle_rates,
        ankle_yaw_rates=(per_second * 6 * s * (1 - s)) * yaw_travel,
    )
    return Command(end, target, rates, running * (step.period - time) * step.swing)


def swing_points(start: Array, end: Array, lift: Array, along: Array, height: Array) -> Array:
    """Control points (2, n + 1, 3), m, of curves from start to end, (2, 3), that rise `lift`, (2,) m, above the higher end.

    along: (n - 1,) shares of the way to the end of the inner control points; height: (n - 1,) their heights as multiples
    of what lifts a symmetric curve of this order by exactly `lift`.
    """
    xp = namespace(start)
    order = along.shape[0] + 1
    top = xp.maximum(start[:, 2], end[:, 2])
    # the inner points' share of a Bezier curve at s = 1/2 is 1 - 2^(1 - order)
    rise = lift / (1 - 2.0 ** (1 - order))
    way = end - start
    inner_xy = start[:, None, :2] + along[None, :, None] * way[:, None, :2]
    inner_z = top[:, None] + rise[:, None] * height[None, :]
    # a foot that is not lifted keeps its height
    inner_z = xp.where((lift > 0)[:, None], inner_z, (start[:, 2:] + along[None, :] * way[:, 2:]))
    inner = xp.concat([inner_xy, inner_z[..., None]], axis=-1)
    return xp.concat([start[:, None], inner, end[:, None]], axis=1)


def lift_over(start: Array, end: Array, lift: Array, along: Array, height: Array, edges: Array, reach: float) -> Array:
    """`lift`, (2,) m, or as much more as brings the curves of `swing_points` over edges.

    edges: (2, e, 2) x and z, m, of what each foot passes, running across x. No point of a curve that has an edge less than
    `reach` m before or behind it is lower than that edge. The other arguments are those of `swing_points`.
    """
    xp = namespace(start)
    order = along.shape[0] + 1
    # each control point's share of each point of the curve
    shares = np.array([bezier(np.eye(order + 1), s)[0] for s in np.linspace(0.0, 1.0, _SAMPLES)])
    weights = xp.asarray(shares, dtype=start.dtype)
    curve = weights @ swing_points(start, end, lift, along, height)  # (2, samples, 3)
    per_metre = weights @ swing_points(xp.zeros_like(start), xp.zeros_like(end), xp.ones_like(lift), along, height)[..., 2:]
    near = xp.abs(curve[..., :1] - edges[:, None, :, 0]) < reach
    lacking = (edges[:, None, :, 1] - curve[..., 2:]) / xp.maximum(per_metre, xp.full_like(per_metre, 1e-3))
    return lift + xp.max(xp.where(near, lacking, xp.zeros_like(lacking)), axis=(1, 2), initial=0.0)
