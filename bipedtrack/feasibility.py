"""What keeps a robot from making a task step, in words: footholds, boxes in the way, and targets out of reach."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from bipedtrack import kinematics, planner
from bipedtrack.nodes import Nodes, ankles_in_trunk_frame
from bipedtrack.planner import TaskStep
from bipedtrack.robot import LEGS, Robot
from bipedtrack.terrain import TOLERANCE, Box, ground, overlap, rectangle, standing_feet

_ON_THE_WAY = np.arange(1, 8) / 8  # shares of a step's period at which its targets must be within reach
_SWUNG = np.arange(1, 16) / 16  # shares at which a foot must be clear of boxes
Boxes = Mapping[int, Box]  # by the lines that name them


def foothold_problems(robot: Robot, boxes: Boxes, step: TaskStep, up: bool = False) -> list[str]:
    """What keeps the feet that swing from standing where the step ends, or from being held in the air there."""
    judge = _air_problems if up else _ground_problems
    return [problem for foot in _swinging(step) for problem in judge(robot, boxes, step.end, foot)]


def _swinging(step: TaskStep) -> list[int]:
    return [int(foot) for foot in np.flatnonzero(step.swing)]


def _ground_problems(robot: Robot, boxes: Boxes, nodes: Nodes, foot: int) -> list[str]:
    """What keeps a foot from standing where it is: the other foot, a box, or no ground under its sole."""
    problems = []
    soles = [_sole(robot, nodes, i) for i in range(len(LEGS))]
    size = f"{robot.sole[0]:g} m x {robot.sole[1]:g} m"
    subject = f"the {LEGS[foot]} foot"
    depth = overlap(*soles)
    if depth > TOLERANCE:
        other = f"the {LEGS[1 - foot]} foot"
        problems.append(f"{subject} overlaps {other} by {_cm(depth)}; wanted the soles of {size} apart")
    z = nodes.ankle_positions[foot, 2] - robot.ankle_height
    inside = boxes_around(robot, boxes, nodes, foot)
    gaps = [z - ground(boxes.values(), x, y, z + TOLERANCE) for x, y in soles[foot]]
    if inside:
        for line in inside:
            right = f"wanted it on top, z = {boxes[line].top:g} m, or beside it"
            problems.append(f"{subject} stands inside the box of line {line}; {right}")
    elif z < -TOLERANCE:
        problems.append(f"{subject} stands {_cm(-z)} under the ground; wanted z = 0 m or more")
    elif max(gaps) > TOLERANCE:
        count = sum(gap > TOLERANCE for gap in gaps)
        problems.append(
            f"{subject} stands in the air: under {count} of its sole's 4 corners the ground is up to "
            f"{_cm(max(gaps))} below z = {z:g} m; wanted the whole sole of {size} on ground of one height"
        )
    return problems


def _air_problems(robot: Robot, boxes: Boxes, nodes: Nodes, foot: int) -> list[str]:
    """What keeps a foot from being held in the air where it is: the ground, or a box."""
    x, y, z = nodes.ankle_positions[foot] - np.array([0.0, 0.0, robot.ankle_height])
    inside = boxes_around(robot, boxes, nodes, foot)
    if inside:
        return [f"the {LEGS[foot]} foot is inside the box of line {line}; wanted it above, or beside it" for line in inside]
    top = ground(boxes.values(), x, y)
    if z > top + TOLERANCE:
        return []
    return [f"the {LEGS[foot]} foot is not up, z = {z:g} m over ground at {top:g} m; wanted it higher, or without `up`"]


def swing_problems(robot: Robot, boxes: Boxes, step: TaskStep) -> list[str]:
    """The boxes that a foot would pass through on its way; those that it begins or ends in are told elsewhere."""
    problems = []
    for foot in _swinging(step):
        near = _near_swing(robot, boxes, step, foot)
        if not near:
            continue
        known = {line for place in (step.start, step.end) for line in boxes_around(robot, near, place, foot)}
        deepest: dict[int, tuple[float, float]] = {}  # by line: how far under the top, m, and when, s
        for time in step.period * _SWUNG:
            on_the_way = planner.command(step, time).target
            for line in boxes_around(robot, near, on_the_way, foot):
                depth = near[line].top - (on_the_way.ankle_positions[foot, 2] - robot.ankle_height)
                deepest[line] = max(deepest.get(line, (0.0, 0.0)), (depth, time))
        problems += [
            f"the {LEGS[foot]} foot passes through the box of line {line}, {_cm(depth)} under its top {time:.2f} s into the "
            "step; wanted another lift, or a way around it"
            for line, (depth, time) in deepest.items()
            if line not in known
        ]
    return problems


def _near_swing(robot: Robot, boxes: Boxes, step: TaskStep, foot: int) -> Boxes:
    """The boxes that a foot might meet: no curve leaves the hull of its control points."""
    low, high = step.ankle_points[foot].min(axis=0), step.ankle_points[foot].max(axis=0)
    reach = np.hypot(*robot.sole) / 2
    return {
        line: box
        for line, box in boxes.items()
        if box.z < high[2]
        and box.top > low[2] - robot.ankle_height + TOLERANCE
        and (box.corners.min(axis=0) < high[:2] + reach).all()
        and (box.corners.max(axis=0) > low[:2] - reach).all()
    }


def support_problems(robot: Robot, boxes: Boxes, step: TaskStep) -> list[str]:
    """Whether a foot steps while the other one is in the air."""
    stands = standing_feet(robot, boxes.values(), step.start.ankle_positions)
    stepping = _swinging(step)
    if len(stepping) != 1 or 1 - stepping[0] in stands:
        return []
    return [f"the {LEGS[1 - stepping[0]]} foot is in the air; wanted it down before the other one steps"]


def reach_problems(robot: Robot, step: TaskStep, on_the_way: bool) -> list[str]:
    """How far the step's end, and perhaps its targets before, are out of each leg's reach: the end, or else the worst."""
    targets = [("at the end of the step", step.end)]
    for time in step.period * _ON_THE_WAY if on_the_way else ():
        targets.append((f"{time:.2f} s into the step", planner.command(step, time).target))
    distances, turns, lengths = (np.zeros((len(targets), len(LEGS))) for _ in range(3))
    for i, (_, target) in enumerate(targets):
        ankles, yaws = ankles_in_trunk_frame(target)
        nearest, nearest_yaws = kinematics.project(robot, ankles, yaws)
        distances[i] = np.linalg.norm(nearest - ankles, axis=-1)
        turns[i] = np.abs(nearest_yaws - yaws)
        lengths[i] = np.linalg.norm(ankles - robot.hips, axis=-1)
    low, high = (bounds.reshape(2, -1)[:, 0] for bounds in (robot.joint_low, robot.joint_high))
    least, most = robot.leg_length
    problems = []
    for foot, leg in enumerate(LEGS):
        far, turned = (0 if amounts[0] > TOLERANCE else amounts.argmax() for amounts in (distances[:, foot], turns[:, foot]))
        if distances[far, foot] > TOLERANCE:
            problems.append(
                f"the {leg} foot is {_cm(distances[far, foot])} out of reach {targets[far][0]}, "
                f"its ankle {lengths[far, foot]:.3f} m from the hip; wanted {least:g} m to {most:g} m "
                "and every joint within its range"
            )
        if turns[turned, foot] > TOLERANCE:
            problems.append(
                f"the {leg} foot is turned {_deg(turns[turned, foot])} too far {targets[turned][0]}; "
                f"wanted {_deg(low[foot])} to {_deg(high[foot])} from the trunk's yaw"
            )
    return problems


def boxes_around(robot: Robot, boxes: Boxes, nodes: Nodes, foot: int) -> list[int]:
    """The lines of the boxes that take up the place of a foot, between its sole and its ankle."""
    ankle = nodes.ankle_positions[foot, 2]
    sole = ankle - robot.ankle_height
    return [
        line
        for line, box in boxes.items()
        if box.z < ankle and box.top > sole + TOLERANCE and overlap(_sole(robot, nodes, foot), box.corners) > TOLERANCE
    ]


def _sole(robot: Robot, nodes: Nodes, foot: int) -> np.ndarray:
    """The corners of a flat foot's sole seen from above, (4, 2) m."""
    return rectangle(nodes.ankle_positions[foot, :2], nodes.ankle_yaws[foot], robot.sole[0], robot.sole[1])


def _cm(length: float) -> str:
    return f"{100 * length:.1f} cm"


def _deg(angle: float) -> str:
    return f"{math.degrees(angle):.1f} deg"
