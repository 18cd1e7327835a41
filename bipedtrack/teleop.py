"""Teleoperation: whoever sends node targets over UDP drives the robot, in MuJoCo C at real time, without jax.

python -m bipedtrack.teleop [policy.npz]

What a packet holds: `packets`; what becomes of it: `follower`. The first sender whose packet is followed is the only one
until it is silent and the robot goes back to standing. A packet with `reply` is answered, also where its target is refused,
by one JSON object a control step at the most:

    bipedtrack  1, the version
    time        s since the start of the simulation
    state       following, returning to standing, or standing
    sequence    of the packet that is answered
    accepted    number of packets followed so far
    refused     number of the others by reason (packets.REASONS)
    falls       after each the robot is put on its feet again where its targets were
    target      where the targets are: a sender begins with these
    measured    where the nodes are
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import json
import pathlib
import socket
import sys
import time
from typing import Annotated, Any

import numpy as np
import tyro

from bipedtrack import addresses, checkpoint, follower, footsteps, kinematics, packets, paths, policy, simulate, trace
from bipedtrack.messages import Refusal, fail
from bipedtrack.nodes import Nodes, ankles_in_trunk_frame

PORT = 47200
_READ = 64  # datagrams read in a control step: what is beyond waits in the socket's buffer or is lost
_DECODED = 4  # datagrams decoded in a control step: the newest
_BACKLOG = 0.1  # s behind real time that are caught up
LEVEL_GROUND = footsteps.Script("level ground", (), (), ())


class Receiver:
    """Packets from a socket to a follower, with bounded work in every control step, and the count of them."""

    def __init__(self, source: socket.socket, target: follower.Follower):
        """source: a bound UDP socket."""
        source.setblocking(False)
        self.follower = target
        self.accepted = 0
        self.refused: collections.Counter[str] = collections.Counter()
        self.silent = 0  # control steps since the last packet that was followed
        self._socket = source
        self._sender: Any = None

    def poll(self) -> tuple[packets.Packet, Any] | None:
        """Hands on what has arrived; the last packet that wants a reply, and its sender. Raises nothing."""
        self.silent += 1
        if self.follower.state != "following":
            self._sender = None
        newest: collections.deque[tuple[bytes, Any]] = collections.deque(maxlen=_DECODED)
        for _ in range(_READ):
            try:
                datagram, sender = self._socket.recvfrom(packets.LARGEST_DATAGRAM + 1)
            except OSError:  # nothing more, or an error that an earlier reply has met
                break
            if self._sender not in (None, sender):
                self.refused["source"] += 1
                continue
            if len(newest) == _DECODED:
                self.refused["flood"] += 1
            newest.append((datagram, sender))
        asked = None
        for datagram, sender in newest:
            try:
                packet = packets.decode(datagram)
                asked = (packet, sender) if packet.reply else asked
                if self._sender not in (None, sender):
                    raise packets.Refused("source", "another sender is being followed")
                self.follower.accept(packet)
            except packets.Refused as refusal:
                self.refused[refusal.reason] += 1
            else:
                self._sender, self.silent, self.accepted = sender, 0, self.accepted + 1
        return asked

    def answer(self, sender: Any, status: dict[str, Any]) -> None:
        """Sends a status; a sender that cannot be reached goes without."""
        with contextlib.suppress(OSError):
            self._socket.sendto(json.dumps(status).encode(), sender)


class Teleoperation:
    """The robot in MuJoCo C, driven by what a receiver hands on."""

    def __init__(
        self, controller: policy.Controller, source: socket.socket, script: footsteps.Script, hold: float = follower.HOLD
    ):
        """script: whose boxes stand on the ground; hold: s of silence after which the robot goes back to standing."""
        self.controller, self.robot = controller, controller.policy.robot
        self.model, self.data = simulate.model_and_data(script, controller.policy.robot.name)
        start = footsteps.initial_nodes(self.robot)
        self.address = source.getsockname()
        self.receiver = Receiver(source, follower.Follower(self.robot, start, script.boxes, hold))
        self.falls = 0
        controller.reset(self.data.qpos)

    def tick(self) -> list[Any]:
        """One control step of 0.005 s; what a trace keeps of it. After a fall the robot stands up again."""
        asked = self.receiver.poll()
        row = simulate.control_step(self.controller, self.model, self.data, self.receiver.follower.advance())
        if asked is not None:
            packet, sender = asked
            self.receiver.answer(sender, self.status(packet.sequence, row[4]))
        if not row[-1]:
            self.falls += 1
            self._stand_up()
        return row

    def status(self, sequence: int, measured: Nodes) -> dict[str, Any]:
        """What a reply says."""
        target = self.receiver.follower.target
        return {
            "bipedtrack": packets.VERSION,
            "time": round(self.data.time, 3),
            "state": self.receiver.follower.state,
            "sequence": sequence,
            "accepted": self.receiver.accepted,
            "refused": dict(self.receiver.refused),
            "falls": self.falls,
            "target": {name: array.tolist() for name, array in target._asdict().items()},
            "measured": {name: array.tolist() for name, array in measured._asdict().items()},
        }

    def line(self, followed: int, realtime: float) -> str:
        """The status line after a second in which so many packets were followed, at a share of real time."""
        receiver = self.receiver
        age = f"last {receiver.silent * self.robot.timestep:.2f} s ago" if receiver.accepted else "none yet"
        refused = ", ".join(f"{count} {reason}" for reason, count in receiver.refused.most_common()) or "none"
        return (
            f"{self.data.time:6.1f} s  {receiver.follower.state:<9}  {followed} packets/s, {age}; refused: {refused}; "
            f"falls: {self.falls}; {realtime:.2f} of real time"
        )

    def run(self, seconds: float | None, rows: list[list[Any]] | None) -> None:
        """Runs at real time, for ever or for some seconds, and prints a status line every second.

        rows: where to put what a trace keeps, until the first fall.
        """
        timestep, per_second = self.robot.timestep, round(1 / self.robot.timestep)
        due = second = time.perf_counter()
        accepted = ticks = 0
        while seconds is None or ticks * timestep < seconds:
            row = self.tick()
            if rows is not None and (not rows or rows[-1][-1]):
                rows.append(row)
            ticks, due = ticks + 1, due + timestep
            ahead = due - time.perf_counter()
            if ahead > 0:
                time.sleep(ahead)
            elif ahead < -_BACKLOG:
                due -= ahead
            if ticks % per_second == 0:
                now = time.perf_counter()
                print(self.line(self.receiver.accepted - accepted, 1 / (now - second)), flush=True)
                accepted, second = self.receiver.accepted, now

    def _stand_up(self) -> None:
        """Puts the robot on its feet where its targets were; the clock goes on."""
        import mujoco

        start = self.receiver.follower.restart()
        joints = kinematics.inverse(self.robot, *ankles_in_trunk_frame(start))
        self.data.qpos[:] = np.concatenate([start.trunk_position, start.trunk_orientation, joints])
        for speeds in (self.data.qvel, self.data.qacc_warmstart, self.data.ctrl):
            speeds[:] = 0
        mujoco.mj_forward(self.model, self.data)
        self.controller.reset(self.data.qpos)


def listen(host: str, port: int) -> socket.socket:
    """A UDP socket bound to an address, after a warning where that is not this computer's own. Raises Refusal."""
    address = addresses.resolve(host, port, socket.SOCK_DGRAM)[0]
    if not address.is_loopback:
        print(
            f"bipedtrack: warning: any computer that reaches {host} can steer the robot; nothing is signed", file=sys.stderr
        )
    try:
        return address.bind()
    except OSError as error:
        raise Refusal(f"cannot listen on {host} port {port}: {error.strerror or error}") from None


@dataclasses.dataclass(frozen=True)
class Teleop:
    """Drives the robot in MuJoCo C by node targets that come over UDP; ends with Ctrl-C."""

    policy: Annotated[pathlib.Path | None, tyro.conf.Positional] = None
    """A policy file or a run directory. Default: the policy that ships."""
    host: str = "127.0.0.1"
    """The address to listen on; another one than this computer's own lets others steer."""
    port: int = PORT
    """The UDP port; 0: any that is free."""
    seconds: float | None = None
    """How long. Default: until Ctrl-C."""
    hold: float = follower.HOLD
    """Seconds without packets after which the robot goes back to standing."""
    ground: pathlib.Path | None = None
    """A footstep script whose boxes stand on the ground. Default: level ground."""
    record: pathlib.Path | None = None
    """Write a trace here, .npz, until the first fall; needs --seconds."""


def main() -> None:
    """The command line. Exit status 0, also after a fall; 2 for bad input."""
    options = tyro.cli(Teleop, prog="python -m bipedtrack.teleop")
    try:
        if options.seconds is not None and not 0 < options.seconds < 1e5:
            raise Refusal(f"--seconds {options.seconds}: must be positive and less than 100000")
        if not 0.01 <= options.hold <= 60:
            raise Refusal(f"--hold {options.hold}: must lie between 0.01 and 60")
        if not 0 <= options.port < 65536:
            raise Refusal(f"--port {options.port}: must lie between 0 and 65535")
        if options.record is not None and options.seconds is None:
            raise Refusal("--record needs --seconds")
        if options.record is not None and options.record.suffix != ".npz":
            raise Refusal(f"--record {options.record}: wanted a name that ends in .npz")
        if options.record is not None:
            checkpoint.require_writable(options.record)
        file = options.policy or paths.data_dir("models") / "policies" / "best.npz"
        driven = policy.load_for_simulation(file)
        script = footsteps.load(options.ground, driven.robot) if options.ground else LEVEL_GROUND
        rows: list[list[Any]] | None = [] if options.record else None
        with listen(options.host, options.port) as source:
            print("listening on {} port {}".format(*source.getsockname()), flush=True)
            with contextlib.suppress(KeyboardInterrupt):
                Teleoperation(policy.Controller(driven), source, script, options.hold).run(options.seconds, rows)
        if options.record and rows:
            trace.save(simulate.to_trace(rows), options.record)
            print(options.record)
    except (Refusal, OSError) as error:
        fail(str(error))


if __name__ == "__main__":
    main()
