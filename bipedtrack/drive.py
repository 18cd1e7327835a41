"""A robot under somebody's hands in MuJoCo C: steered, led by the foot, sent through scripts, pushed, stood up again.

It knows no page and no clock; whoever has one calls `advance` every control step. Needs numpy and MuJoCo alone.
"""

from __future__ import annotations

import dataclasses
import enum
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bipedtrack import (
    control,
    falls,
    footholds,
    footsteps,
    kinematics,
    nodes,
    planner,
    policy,
    rotations,
    scripts,
    simulate,
    steering,
)
from bipedtrack.footholds import Foothold
from bipedtrack.footsteps import Box, Script
from bipedtrack.nodes import NodeErrors, Nodes
from bipedtrack.planner import TaskStep
from bipedtrack.robot import LEGS
from bipedtrack.steering import Planned, Steering, Wishes

_LYING = 0.2  # m, height of a trunk that has come to lie
PUSH_SECONDS = 0.1
PUSH_LIMIT = 200.0  # N s
_STILL = {"ahead": 0.0, "aside": 0.0, "turn": 0.0}
_FARTHEST_PRINTS = 12  # footholds of a script that are shown ahead


class Mode(enum.Enum):
    """Where the next task step comes from."""

    STEER = "steering"
    SCRIPT = "script"
    FALLEN = "fallen"


class View(NamedTuple):
    """One instant of a drive for those who watch it: copies, which nothing changes later."""

    time: float  # s since the start
    qpos: np.ndarray  # (19,)
    target: Nodes
    measured: Nodes
    errors: NodeErrors  # target ⊖ measured
    feedback: np.ndarray  # (12,) a_fb in [-1, 1]
    mode: Mode
    note: str
    steering: Steering
    boxes: tuple[Box, ...]
    prints: tuple[Foothold, ...]  # the foothold under way and those that follow
    next_foot: Foothold  # what `place` would move
    step: TaskStep  # under way


# What follows among these boxes a task step that ended here, with these wishes?
_Question = tuple[tuple[Box, ...], Nodes, Wishes]


class Drive:
    """The robot, its controller and the task step under way.

    >>> drive = Drive(controller)
    >>> drive.steer(ahead=1)
    >>> for _ in range(2000):
    ...     drive.advance()
    """

    def __init__(self, controller: policy.Controller, boxes: Sequence[Box] = ()):
        """A robot that stands at the start of every script, among boxes, and holds."""
        self.controller = controller
        self.robot = controller.policy.robot
        self.boxes = tuple(boxes)
        self.mode = Mode.STEER
        self.wishes = Wishes()
        self.note = ""
        self.script: Script | None = None
        self.loop = False
        self._line = 0  # of the script, the next one
        self._built_boxes: tuple[Box, ...] | None = None  # that the model has
        self._answered: tuple[_Question, tuple[Planned, Wishes]] | None = None
        self._build()

    @property
    def steering(self) -> Steering:
        """What is asked for."""
        return self.wishes.steering

    @property
    def timestep(self) -> float:
        """The control period, s."""
        return self.robot.timestep

    # The clock

    def advance(self) -> None:
        """One control step of `timestep` seconds: command, controller, physics, and the next task step where one is over."""
        import mujoco

        step = self.step._replace(pendulum=self._sway * self.step.pendulum)
        command = planner.command(step, np.float64(self._tick * self.timestep))
        self.target = command.target
        if self.mode is not Mode.FALLEN:
            measured = kinematics.measure(self.robot, self.data.qpos)
            if not falls.finite(self.data.qpos, self.data.qvel) or falls.fell(command.target, measured):
                self._fall()
        if self.mode is Mode.FALLEN:
            # nothing but its soles touches the ground, so it must not sink any further; false for nan
            if self.data.qpos[2] > _LYING and np.isfinite(self.data.qvel).all():
                mujoco.mj_step(self.model, self.data)
            return
        self.data.ctrl[:] = self.controller.step(self.data.qpos, self.data.qvel, command)
        self._apply_push()
        mujoco.mj_step(self.model, self.data)
        self._tick += 1
        if self._tick >= round(self.step.period / self.timestep):
            self._begin(self._next())

    def _apply_push(self) -> None:
        if self._push_ticks:
            self._push_ticks -= 1
            self.data.body("trunk").xfrc_applied[:3] = self._push if self._push_ticks else 0.0

    def _begin(self, planned: Planned) -> None:
        """The next task step, from now on."""
        self.step, self._tick = planned.step, 0
        self._sway = self.controller.policy.sway  # as long as the step lasts
        self._add_taken(planned.step)
        if planned.note:
            self.note = planned.note
        swing = np.flatnonzero(planned.step.swing)
        if swing.size:
            self.wishes = self.wishes._replace(foot=1 - int(swing[0]))

    def _add_taken(self, step: TaskStep) -> None:
        """Adds a task step to those taken; a hold after a hold makes that one longer, for a robot may stand for days."""
        if self.taken and step.start is step.end and self.taken[-1].start is self.taken[-1].end:
            step = step._replace(period=self.taken.pop().period + step.period)
        self.taken.append(step)

    def _next(self) -> Planned:
        """What follows the task step that is over."""
        if self.mode is Mode.SCRIPT and self.script is not None:
            if self._line < len(self.script.steps):
                self._line += 1
                return Planned(self.script.steps[self._line - 1])
            if self.loop:
                self.run(self.script, loop=True)
                return Planned(self.taken.pop())
            self._steer_on(f"{self.script.name}: the script is over")
        planned, self.wishes = self._following()
        return planned

    def plan_ahead(self) -> None:
        """Plans what follows the task step under way, so that `advance` need not; another thread may call it.

        Planning takes longer than a control step. What is asked for later makes it void.
        """
        if self.mode is Mode.STEER:
            self._following()

    def _following(self) -> tuple[Planned, Wishes]:
        """The answer to what follows now, the one that was found ahead if there is any."""
        question = self.boxes, self.step.end, self.wishes
        answered = self._answered
        if answered is None or not _same(answered[0], question):
            self._answered = answered = question, steering.following(self.robot, *question)
        return answered[1]

    # What one may ask for

    def steer(self, **wishes: float) -> None:
        """Changes wishes by the names of Steering, from the next task step on; a script under way is left."""
        self._require_standing()
        self.note = ""
        if self.mode is Mode.SCRIPT:
            self._steer_on("steering by hand")
        asked = steering.clamped(self.steering._replace(**wishes))
        self.wishes = self.wishes._replace(
            steering=asked,
            trunk=self.wishes.trunk or any(name.startswith("trunk") for name in wishes),
            placed=None if asked.moves else self.wishes.placed,
        )

    def stop(self) -> None:
        """Feet come together at the next task step; then every target holds."""
        self._require_standing()
        walking = self.wishes.walking or self.mode is Mode.SCRIPT
        self.steer(**_STILL)
        self.wishes = self.wishes._replace(walking=walking)

    def lead(self) -> None:
        """Holds as soon as the foot under way is down, and waits for `place`."""
        self._require_standing()
        self.steer(**_STILL)
        self.wishes = self.wishes._replace(walking=False)

    def place(self, wanted: Foothold) -> str:
        """One step to a foothold, or to the nearest one within reach; returns the sentence that says so, or nothing."""
        self.lead()
        if not all(map(math.isfinite, wanted[1:])):
            raise ValueError(f"foothold {wanted[1:]}: wanted finite numbers")
        planned = steering.place(self.robot, self.boxes, self.step.end, wanted, self.steering)
        if planned.step.swing.any():
            self.wishes = self.wishes._replace(placed=footholds.end_of(planned.step, wanted.foot))
        self.note = planned.note
        return planned.note

    def push(self, impulse: float, direction_deg: float = 0.0) -> None:
        """Pushes the trunk with an impulse, N s, for 0.1 s; 0 deg is forward, 90 deg to the left."""
        if not (math.isfinite(impulse) and 0 <= impulse <= PUSH_LIMIT and math.isfinite(direction_deg)):
            raise ValueError(f"a push of {impulse:g} N s; wanted 0 to {PUSH_LIMIT:g} N s")
        forward = rotations.to_matrix(self.data.qpos[3:7])[:2, 0]
        angle = math.atan2(forward[1], forward[0]) + math.radians(direction_deg)
        self._push = impulse / PUSH_SECONDS * np.array([math.cos(angle), math.sin(angle), 0.0])
        self._push_ticks = 1 + round(PUSH_SECONDS / self.timestep)

    def use(self, controller: policy.Controller) -> None:
        """Another controller from the next control step on; it begins with the joints as they are."""
        controller.reset(self.data.qpos)
        self.controller = controller

    @property
    def feedback(self) -> bool:
        """Whether the policy acts; without it inverse kinematics alone drives."""
        return self.controller.uses_feedback

    @feedback.setter
    def feedback(self, on: bool) -> None:
        if on != self.feedback:
            self.use(policy.Controller(self.controller.policy, on))

    def run(self, script: Script, loop: bool = False) -> None:
        """Starts a script where every script starts, among its own boxes; with loop again and again."""
        self.script, self.loop, self.boxes = script, loop, script.boxes
        self._build()
        self.mode = Mode.SCRIPT
        self.note = f"{script.name}: {len(script.steps)} task steps, {footsteps.duration(script):.1f} s"
        self.taken.clear()
        self._begin(self._next())

    def reset(self, boxes: Sequence[Box] | None = None) -> None:
        """Back to the start, holding; among other boxes if they are given."""
        self.boxes = self.boxes if boxes is None else tuple(boxes)
        self._steer_on("")
        self._build()

    def stand_up(self) -> None:
        """After a fall: the robot stands again where its last finished task step ended, and holds."""
        if self.mode is not Mode.FALLEN:
            return
        start = self.step.start
        last = self.taken.pop()
        if last.period > self.step.period:  # of a hold in several parts the robot fell in the last one
            self.taken.append(last._replace(period=last.period - self.step.period))
        self._steer_on("standing again at the last foothold")
        self._stand(start)

    def as_script(self) -> str:
        """All task steps since the last reset or start of a script as the text of a script, with the boxes."""
        return scripts.text(self.robot, self.taken, self.boxes)

    def view(self) -> View:
        """What there is to see now."""
        end = self.step.end
        measured = kinematics.measure(self.robot, self.data.qpos.copy())
        return View(
            time=float(self.data.time),
            qpos=self.data.qpos.copy(),
            target=self.target,
            measured=measured,
            errors=nodes.difference(self.target, measured),
            feedback=self.controller.last_feedback.copy() if self.feedback else np.zeros(12),
            mode=self.mode,
            note=self.note,
            steering=self.steering,
            boxes=self.boxes,
            prints=self._prints(),
            next_foot=self.wishes.placed or footholds.beside(end, self.wishes.foot),
            step=self.step,
        )

    # How it is done

    def _build(self) -> None:
        """Model and data with the boxes, and the robot at the start at time 0."""
        if self._built_boxes != self.boxes:
            self.model, self.data = simulate.model_and_data(Script("", (), self.boxes, ()), self.robot.name)
            self._built_boxes = self.boxes
        self.data.time = 0.0
        self.taken: list[TaskStep] = []
        self.wishes = self.wishes._replace(foot=0)
        self._stand(footsteps.initial_nodes(self.robot))

    def _stand(self, start: Nodes) -> None:
        """The robot with its nodes at `start`, at rest, holding; its soles are level whatever the trunk."""
        import mujoco

        mocap = self.data.mocap_pos.copy(), self.data.mocap_quat.copy()
        time = self.data.time
        mujoco.mj_resetData(self.model, self.data)
        self.data.time = time
        self.data.mocap_pos[:], self.data.mocap_quat[:] = mocap
        level = dataclasses.replace(self.controller.policy.settings, level_feet=True)
        joints = control.denormalize(self.robot, np.clip(control.feedforward(self.robot, level, start), -1.0, 1.0))
        self.data.qpos[:] = np.concatenate([start.trunk_position, start.trunk_orientation, joints])
        mujoco.mj_forward(self.model, self.data)
        self.controller.reset(self.data.qpos)
        self._push, self._push_ticks = np.zeros(3), 0
        self.wishes = Wishes(self.steering._replace(**_STILL), self.wishes.foot)
        self._line = 0
        self.step = steering.hold(self.robot, start)._replace(end=start)
        self._begin(Planned(self.step))
        self.target = start

    def _fall(self) -> None:
        self.mode = Mode.FALLEN
        self.data.body("trunk").xfrc_applied[:] = 0.0
        self.note = "fallen: stand up again at the last foothold, or reset"

    def _steer_on(self, note: str) -> None:
        """Out of a script or a fall, into steering that holds."""
        self.mode, self.script, self.note = Mode.STEER, None, note
        self.wishes = self.wishes._replace(walking=False)

    def _require_standing(self) -> None:
        if self.mode is Mode.FALLEN:
            raise ValueError("the robot has fallen; stand it up again or reset first")

    def _prints(self) -> tuple[Foothold, ...]:
        """Footholds of the step under way and of a script's next ones."""
        ahead = self.script.steps[self._line : self._line + _FARTHEST_PRINTS] if self.script else ()
        found = []
        for step in (self.step, *ahead):
            for foot in range(len(LEGS)):
                if step.swing[foot]:
                    found.append(footholds.end_of(step, foot))
        return tuple(found)


def _same(asked: _Question, now: _Question) -> bool:
    """Nodes are compared by identity: every task step ends with its own."""
    return asked[1] is now[1] and asked[::2] == now[::2]
