"""From a stream of packets to the command of every control step, smoothly, whatever arrives and whatever does not.

How streamed targets become the command of eq (3):

- **I^t** goes from where it is straight to the newest packet's target and gets there when the next packet is due: the time
  between the last two packets by the sender's clock, and one control step more, so that a packet may be one control step
  late without a halt. With rates in the packet it goes to where the target will be by then. The trunk turns about a fixed
  axis. No node is ever faster than `packets.FASTEST`; what cannot be reached in time is reached later.
- **dI^t/dt** is the derivative of just that motion: zero once the target is reached.
- **I^s and T** are the packet's end and timer, the timer running down. Without them they are guessed: the step ends with the
  nodes where the packet wants them but a lifted foot straight down on the ground under it, 0.55 s after it was lifted, or
  sooner if it comes down fast enough.
- When the next packet is late, I^t stays at the last one's target; or, if that gave an end and a timer that still runs, it
  goes on to that end as one task step of the planner.
- After `hold` seconds without a packet that can be followed, and not before such a step has ended, the command is a task
  step to standing: both feet down on the ground under them, the trunk upright between them at standing height. Then the
  robot stands until there are packets again.

Targets out of a leg's reach move to `kinematics.project`'s answer; where that moves both feet the same way, the trunk moves
instead.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bipedtrack import footsteps, kinematics, planner, rotations, terrain
from bipedtrack.nodes import NodeRates, Nodes, ankles_in_trunk_frame
from bipedtrack.packets import FASTEST, Packet, Refused, require_upright, speed
from bipedtrack.planner import Command, TaskStep
from bipedtrack.robot import Robot

HOLD = 0.3  # s without packets after which the robot is brought to standing
_LONGEST_INTERVAL = 0.5  # s between packets that targets are stretched over
_FARTHEST_JUMP = NodeRates(0.3, 0.6, 0.4, 0.8)  # m, rad, m, rad from where the targets are
_FARTHEST_PROJECTION = 0.1  # m that an ankle may be out of reach
_LIFTED = 0.005  # m above the ground: a foot that is higher is in the air
_SWING = 0.55  # s from lifting a foot to its landing, as far as is known
_SHORTEST_SWING = 0.05  # s that a foot in the air has still to go, at the least
_CALM = NodeRates(0.25, 0.6, 0.3, 0.8)  # m/s, rad/s, m/s, rad/s on the way to standing
_SHORTEST_WAY = 0.4  # s
_RISE = 0.3  # m/s: a step that ends without packets bends up by so much times the time that is left to it


class _Followed(NamedTuple):
    """The packet that is followed, made reachable."""

    packet: Packet
    goal: Nodes  # where the targets are when the next packet is due
    due: int  # control step, counted from the packet's arrival, at which they are


class Follower:
    """Packets in, whenever they come; a command out every control step.

    >>> follower = Follower(robot, start)
    >>> follower.accept(packet)
    >>> command = follower.advance()
    """

    def __init__(self, robot: Robot, start: Nodes, boxes: Sequence[terrain.Box] = (), hold: float = HOLD):
        """Stands at `start`; boxes: what stands on the ground; hold: s without packets until it goes back to standing."""
        self.robot = robot
        self.boxes = tuple(boxes)
        self._hold = max(1, round(hold / robot.timestep))
        self._target = start
        self._followed: _Followed | None = None
        self._step: TaskStep | None = self._to_standing()  # without packets
        self._age = self._time = 0  # control steps since the last packet that was followed, and into the step
        self._lifted = np.zeros(2)  # s since each foot left the ground

    @property
    def target(self) -> Nodes:
        """Where the targets are."""
        return self._target

    @property
    def state(self) -> str:
        """What it is doing: `following` packets, `returning` to standing, or `standing`."""
        if self._followed is not None or self._step is None:
            return "following"
        return "standing" if self._time * self.robot.timestep >= self._step.period else "returning"

    def accept(self, packet: Packet) -> None:
        """Follows a packet from the next control step on. Raises Refused, and then nothing has changed.

        While packets are being followed their sequence numbers must grow; after `hold` seconds of silence any number is a
        new beginning.
        """
        interval = self.robot.timestep
        if self._followed is not None:
            last = self._followed.packet
            if packet.sequence <= last.sequence:
                raise Refused("order", f"sequence {packet.sequence} after {last.sequence}")
            interval = min(max(packet.time - last.time, interval), _LONGEST_INTERVAL)
        due = round(interval / self.robot.timestep) + 1
        goal = packet.target if packet.rates is None else _moved(packet.target, packet.rates, due * self.robot.timestep)
        self._check_jump("target", packet.target)
        require_upright(goal, "with its rates the trunk would be")
        goal = self._reachable(goal)
        if packet.end is not None:
            self._check_jump("end", packet.end, 3.0)
            packet = packet._replace(end=self._reachable(packet.end))
        self._followed, self._step, self._age = _Followed(packet, goal, due), None, 0

    def advance(self) -> Command:
        """The command of this control step; the next call gives the next one's."""
        timestep, now = self.robot.timestep, self._target
        self._choose_step()
        height = now.ankle_positions[:, 2] - self._footing(now)
        self._lifted = np.where(height > _LIFTED, self._lifted + timestep, 0.0)
        if self._step is not None:
            self._time += 1
            end, goal, _, timer = planner.command(self._step, np.float64(self._time * timestep))
            seconds = timestep
        elif self._followed is not None:
            goal, seconds = self._followed.goal, max(self._followed.due - self._age, 1) * timestep
            end, timer = self._end_and_timer(self._followed, height)
        rates = _rates_towards(now, goal, seconds)
        self._target = _moved(now, rates, timestep)
        self._age += 1
        return Command(end, now, rates, timer)

    def restart(self) -> Nodes:
        """Forgets all packets and stands, at once, where it would have come to stand."""
        self._target = self._to_standing().end
        self._followed, self._step, self._time = None, self._to_standing(), 0
        return self._target

    def _choose_step(self) -> None:
        """Begins a task step where packets stay away: to the end that the last one gave, then to standing."""
        if self._followed is None:
            return
        packet, step = self._followed.packet, self._step
        finished = step is None or self._time * self.robot.timestep >= step.period
        if self._age >= self._hold and finished:
            self._followed, self._step, self._time = None, self._to_standing(), 0
        elif packet.end is not None and packet.timer is not None and step is None and self._age > self._followed.due:
            remaining = packet.timer - self._age * self.robot.timestep
            if remaining.max() > 0:
                self._step, self._time = self._to_end(packet.end, remaining), 0

    def _end_and_timer(self, followed: _Followed, height: np.ndarray) -> tuple[Nodes, np.ndarray]:
        """I^s and T of the packet that is followed; what it does not say is guessed. height: (2,) m, of the feet."""
        packet, now = followed.packet, self._target
        if packet.end is not None and packet.timer is not None:
            return packet.end, np.maximum(packet.timer - self._age * self.robot.timestep, 0.0)
        down = followed.goal.ankle_positions.copy()
        down[:, 2] = self._footing(followed.goal)
        falling = np.maximum((now.ankle_positions - followed.goal.ankle_positions)[:, 2], 1e-4)
        ticks = max(followed.due - self._age, 1)
        swing = np.maximum(_SWING - self._lifted, _SHORTEST_SWING)
        landing = np.minimum(swing, height / falling * ticks * self.robot.timestep)
        return followed.goal._replace(ankle_positions=down), np.where(height > _LIFTED, landing, 0.0)

    def _footing(self, nodes: Nodes) -> np.ndarray:
        """The heights (2,), m, of ankles whose feet stand on the ground under them."""
        return np.array([terrain.ground(self.boxes, x, y) for x, y, _ in nodes.ankle_positions]) + self.robot.ankle_height

    def _check_jump(self, name: str, nodes: Nodes, factor: float = 1.0) -> None:
        """Raises Refused where nodes are too far from where the targets are."""
        way = _rates_towards(self._target, nodes, 1.0, limited=False)
        for node, distance, most in zip(Nodes._fields, way, _FARTHEST_JUMP, strict=True):
            if speed(distance).max() > factor * most:
                raise Refused("jump", f"{name}.{node} is more than {factor * most:g} from where the target is")

    def _reachable(self, nodes: Nodes, most: float = _FARTHEST_PROJECTION) -> Nodes:
        """The nodes with feet not under the ground and legs that reach. Raises Refused where an ankle moves by more, m."""
        nodes = nodes._replace(ankle_positions=self._on_the_ground(nodes))
        to_w = rotations.to_matrix(nodes.trunk_orientation)
        wanted, wanted_yaws = ankles_in_trunk_frame(nodes)
        nearest, yaws = kinematics.project(self.robot, wanted, wanted_yaws)
        shift = (nearest - wanted) @ to_w.T
        # what moves both feet alike is the trunk's to move
        common = np.clip(0.0, shift.min(axis=0), shift.max(axis=0))
        shift = shift - common
        if np.linalg.norm(shift, axis=-1).max() > most:
            raise Refused("reach", f"an ankle is more than {most:g} m out of reach")
        nodes = Nodes(
            trunk_position=nodes.trunk_position - common,
            trunk_orientation=nodes.trunk_orientation,
            ankle_positions=nodes.ankle_positions + shift,
            ankle_yaws=nodes.ankle_yaws + rotations.wrap(yaws - wanted_yaws),
        )
        return nodes._replace(ankle_positions=self._on_the_ground(nodes))

    def _on_the_ground(self, nodes: Nodes) -> np.ndarray:
        """The ankles (2, 3), m, none so low that its foot would be under the ground."""
        return np.column_stack([nodes.ankle_positions[:, :2], np.maximum(nodes.ankle_positions[:, 2], self._footing(nodes))])

    def _to_end(self, end: Nodes, remaining: np.ndarray) -> TaskStep:
        """The rest of a task step to the end that a packet gave, whose feet land after (2,) remaining s."""
        start = self._target.ankle_positions
        above = end.ankle_positions.copy()
        above[:, 2] = np.maximum(above[:, 2], start[:, 2]) + _RISE * np.maximum(remaining, 0.0)
        return self._step_to(end, float(remaining.max()), remaining > 0, [start, above, end.ankle_positions])

    def _to_standing(self) -> TaskStep:
        """The task step from where the targets are to standing, at rest at both ends."""
        start = self._target
        ankles = start.ankle_positions.copy()
        ankles[:, 2] = self._footing(start)
        yaw = start.ankle_yaws[0] + rotations.wrap(start.ankle_yaws[1] - start.ankle_yaws[0]) / 2
        trunk = ankles.mean(axis=0) + np.array([0.0, 0.0, footsteps.TRUNK_HEIGHT - self.robot.ankle_height])
        upright = footsteps.balanced(self.robot, Nodes(trunk, rotations.from_yaw(yaw), ankles, start.ankle_yaws), trunk[:2])
        end = self._reachable(upright, math.inf)
        way = _rates_towards(start, end, 1.0, limited=False)
        seconds = max(_SHORTEST_WAY, *(float(speed(part).max() / calm) for part, calm in zip(way, _CALM, strict=True)))
        lifted = start.ankle_positions[:, 2] - ankles[:, 2] > _LIFTED
        return self._step_to(end, seconds, lifted, [start.ankle_positions, start.ankle_positions, ankles, ankles])

    def _step_to(self, end: Nodes, seconds: float, swing: np.ndarray, ankle_points: list[np.ndarray]) -> TaskStep:
        """The task step from where the targets are; ankle_points: (2, 3) each."""
        return TaskStep(
            start=self._target,
            end=end,
            period=np.float64(math.ceil(seconds / self.robot.timestep) * self.robot.timestep),
            swing=swing.astype(float),
            ankle_points=np.stack(ankle_points, axis=1),
            lift=np.zeros(2),
            trigonometric=np.float64(0),
            ease=np.float64(0),
            pivot=np.zeros(2),
            pendulum=np.float64(0),
        )


def _rates_towards(start: Nodes, goal: Nodes, seconds: float, limited: bool = True) -> NodeRates:
    """The constant rates that bring nodes to a goal in a time, each limited to FASTEST."""
    turn = rotations.multiply(goal.trunk_orientation, rotations.conjugate(start.trunk_orientation))
    ways = NodeRates(
        goal.trunk_position - start.trunk_position,
        rotations.to_rotation_vector(turn),
        goal.ankle_positions - start.ankle_positions,
        rotations.wrap(goal.ankle_yaws - start.ankle_yaws),
    )
    rates = (way / seconds for way in ways)
    if not limited:
        return NodeRates(*rates)
    return NodeRates(*(rate / np.maximum(speed(rate) / most, 1.0) for rate, most in zip(rates, FASTEST, strict=True)))


def _moved(start: Nodes, rates: NodeRates, seconds: float) -> Nodes:
    """Where the nodes are after a time at constant rates."""
    turn = rotations.from_rotation_vector(seconds * rates.trunk_angular_velocity)
    orientation = rotations.multiply(turn, start.trunk_orientation)
    return Nodes(
        start.trunk_position + seconds * rates.trunk_velocity,
        orientation / np.linalg.norm(orientation),
        start.ankle_positions + seconds * rates.ankle_velocities,
        start.ankle_yaws + seconds * rates.ankle_yaw_rates,
    )
