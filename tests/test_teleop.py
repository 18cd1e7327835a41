"""The robot in MuJoCo C driven over real sockets: by valid streams, by nonsense, by floods and by nobody."""

import json
import os
import pathlib
import re
import socket
import subprocess
import sys
from collections.abc import Iterable, Iterator

import malformed
import numpy as np
import pytest

from bipedtrack import footsteps, kinematics, packets, policy, teleop
from bipedtrack.packets import Packet
from bipedtrack.planner import Command
from bipedtrack.robot import Robot
from bipedtrack.teleop import Teleoperation

TOP = pathlib.Path(__file__).resolve().parent.parent
POLICY = TOP / "models" / "policies" / "best.npz"
DT = 0.005
STANDS = np.array([-0.05, 0, 0.75])  # m, the trunk: bent knees carry the centre of mass ahead of it


@pytest.fixture(scope="module")
def controller() -> policy.Controller:
    return policy.Controller.load(POLICY)


@pytest.fixture
def driven(controller: policy.Controller) -> Iterator[Teleoperation]:
    """The robot at its start, not in real time."""
    with teleop.listen("127.0.0.1", 0) as source:
        yield Teleoperation(controller, source, teleop.LEVEL_GROUND)


@pytest.fixture
def send(driven: Teleoperation) -> Iterator[socket.socket]:
    yield from connected(driven)


@pytest.fixture
def other(driven: Teleoperation) -> Iterator[socket.socket]:
    """Another sender."""
    yield from connected(driven)


def connected(driven: Teleoperation) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.connect(driven.address)
        sender.settimeout(5)
        yield sender


def standing(sequence: int, height: float = 0.75, **more: object) -> bytes:
    target = malformed.NODES | {"trunk_position": [*STANDS[:2], height]}
    return json.dumps(malformed.message(sequence, target=target, **more)).encode()


def ticks(driven: Teleoperation, seconds: float) -> list[list]:
    return [driven.tick() for _ in range(round(seconds / DT))]


def trunk(driven: Teleoperation) -> np.ndarray:
    return driven.data.qpos[:3]


@pytest.fixture
def walk(robot: Robot) -> footsteps.Script:
    """The script to stream."""
    return footsteps.load(TOP / "curricula" / "footsteps" / "walk.csv", robot)


# Streams


def stream(driven: Teleoperation, send: socket.socket, commands: Iterable[Command], every: int, form: str) -> None:
    """Sends the targets, or everything, of one in `every` commands while the robot is driven."""
    for tick, command in enumerate(commands):
        if tick % every == 0:
            packet = Packet(tick, tick * DT, command.target)
            if form == "everything":
                packet = packet._replace(rates=command.rates, end=command.end, timer=command.timer)
            send.send(packets.encode(packet))
        driven.tick()


@pytest.mark.parametrize(("rate", "form"), [(50, "target"), (100, "target"), (50, "everything"), (100, "everything")])
def test_a_streamed_walk_walks_its_distance(
    driven: Teleoperation, send: socket.socket, robot: Robot, walk: footsteps.Script, rate: int, form: str
) -> None:
    stream(driven, send, footsteps.commands(walk, DT), round(1 / (rate * DT)), form)
    ticks(driven, 1)
    assert driven.falls == 0 and not driven.receiver.refused.total()
    np.testing.assert_allclose(trunk(driven), STANDS + [0.5, 0, 0], atol=0.05)
    feet = kinematics.measure(robot, driven.data.qpos).ankle_positions
    np.testing.assert_allclose(feet, [[0.5, 0.1, 0.04], [0.5, -0.1, 0.04]], atol=0.03)


@pytest.mark.parametrize("cut", [1.45, 1.68, 2.0, 2.22, 2.6])
@pytest.mark.parametrize("form", ["target", "everything"])
def test_a_walk_whose_packets_stop_comes_to_stand(
    driven: Teleoperation, send: socket.socket, robot: Robot, walk: footsteps.Script, cut: float, form: str
) -> None:
    stream(driven, send, footsteps.commands(walk, DT, cut), 4, form)
    ticks(driven, 3)
    assert driven.falls == 0 and driven.receiver.follower.state == "standing"
    np.testing.assert_allclose(kinematics.measure(robot, driven.data.qpos).ankle_positions[:, 2], 0.04, atol=0.01)
    assert np.abs(driven.data.qvel[:6]).max() < 0.3


def test_late_doubled_and_shuffled_packets_do_no_harm(
    driven: Teleoperation, send: socket.socket, walk: footsteps.Script
) -> None:
    rng, late = np.random.default_rng(0), {}
    for tick, command in enumerate(footsteps.commands(walk, DT)):
        if tick % 4 == 0:
            for _ in range(rng.integers(0, 3)):  # a third is lost, a third comes twice
                late.setdefault(tick + rng.integers(0, 10), []).append(
                    packets.encode(Packet(tick, tick * DT, command.target))
                )
        for datagram in late.pop(tick, []):
            send.send(datagram)
        driven.tick()
    ticks(driven, 1)
    assert driven.falls == 0 and driven.receiver.refused["order"] > 50
    np.testing.assert_allclose(trunk(driven), STANDS + [0.5, 0, 0], atol=0.06)


# Nonsense


def test_ten_thousand_malformed_messages_do_not_disturb_a_squat(
    driven: Teleoperation, send: socket.socket, robot: Robot
) -> None:
    """They come from the very socket that the good ones come from, four in every control step."""
    nonsense, rng = malformed.messages(10_000), np.random.default_rng(0)
    heights, targets = [], []
    for tick in range(2500):
        asked = 0.70 + 0.05 * np.cos(2 * np.pi * tick * DT / 3)
        datagrams = [next(nonsense) for _ in range(4)]
        if tick % 4 == 0:
            datagrams.insert(rng.integers(5) if tick else 0, standing(1000 + tick, asked))
        for datagram in datagrams:
            send.send(datagram)
        row = driven.tick()
        heights.append((asked, row[4].trunk_position[2]))
        targets.append(row[3].trunk_position)
    assert driven.falls == 0
    assert next(nonsense, None) is None
    assert np.isfinite(driven.data.qpos).all()
    assert np.linalg.norm(np.diff(targets, axis=0), axis=-1).max() < 1.001 * DT * packets.FASTEST.trunk_velocity
    asked, found = np.array(heights[250:]).T
    assert np.abs(found - asked).max() < 0.05
    assert driven.receiver.accepted > 450
    assert driven.receiver.refused.total() + driven.receiver.accepted == 10_625
    assert min(driven.receiver.refused[reason] for reason in ("size", "format", "version", "field", "number", "range")) > 50


def test_ten_thousand_malformed_messages_leave_the_robot_standing(
    driven: Teleoperation, send: socket.socket, robot: Robot
) -> None:
    for i, datagram in enumerate(malformed.messages(10_000, seed=1)):
        if KINDS_THAT_NOBODY_FOLLOWS[i % len(malformed.KINDS)]:
            send.send(datagram)
        if i % 8 == 0:
            driven.tick()
    ticks(driven, 1)
    assert driven.receiver.accepted == driven.falls == 0
    assert driven.receiver.follower.state == "standing"
    np.testing.assert_allclose(trunk(driven), STANDS, atol=0.05)


KINDS_THAT_NOBODY_FOLLOWS = [kind.__name__ != "_old" for kind in malformed.KINDS]  # old ones are a beginning for who stands


# Floods


def test_a_flood_neither_starves_the_loop_nor_the_sender_who_is_followed(
    driven: Teleoperation, send: socket.socket, other: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoded, decode = [], packets.decode
    monkeypatch.setattr(packets, "decode", lambda datagram: decoded.append(1) or decode(datagram))
    send.send(standing(0))
    driven.tick()
    for i in range(1, 400):
        decoded.clear()
        for j in range(60):
            other.send(standing(10**6 + 60 * i + j, 0.6))
        if i % 4 == 0:
            send.send(standing(i, 0.70))
        driven.tick()
        assert len(decoded) <= 4
    assert driven.receiver.accepted == 100 and driven.falls == 0
    assert driven.receiver.refused["source"] == 399 * 60
    assert trunk(driven)[2] == pytest.approx(0.70, abs=0.04)


def test_of_a_flood_from_one_sender_the_newest_packets_count(driven: Teleoperation, send: socket.socket) -> None:
    for i in range(50):
        send.send(standing(i, 0.75 - 0.001 * i))
    ticks(driven, 0.1)
    assert driven.receiver.accepted == 4 and driven.receiver.refused == {"flood": 46}
    assert driven.receiver.follower.target.trunk_position[2] == pytest.approx(0.75 - 0.049)


def test_a_control_step_reads_a_bounded_number_of_datagrams(driven: Teleoperation, send: socket.socket) -> None:
    for _ in range(150):
        send.send(b"x")
    counts = []
    for _ in range(4):
        before = driven.receiver.refused.total()
        driven.tick()
        counts.append(driven.receiver.refused.total() - before)
    assert counts == [64, 64, 22, 0]


# Senders


def test_one_sender_at_a_time_until_it_is_silent(driven: Teleoperation, send: socket.socket, other: socket.socket) -> None:
    send.send(standing(1))
    driven.tick()
    other.send(standing(2, 0.7))
    driven.tick()
    assert driven.receiver.refused == {"source": 1}
    ticks(driven, 0.4)
    other.send(standing(2, 0.7))
    ticks(driven, 0.1)
    assert driven.receiver.accepted == 2
    assert driven.receiver.follower.target.trunk_position[2] == pytest.approx(0.7)


def test_a_reply_says_what_became_of_the_packets_also_of_a_refused_one(driven: Teleoperation, send: socket.socket) -> None:
    for datagram in (b"{", standing(1), standing(3, 0.7), standing(2), standing(9, 0.2, reply=True)):
        send.send(datagram)
        driven.tick()
    status = json.loads(send.recv(4096))
    assert status["sequence"] == 9 and status["accepted"] == 2 and status["falls"] == 0 and status["state"] == "following"
    assert status["refused"] == {"format": 1, "order": 1, "jump": 1}
    # a sender begins with these
    assert 0.7 < status["target"]["trunk_position"][2] < 0.75
    send.send(json.dumps(malformed.message(10, target=status["target"])).encode())
    driven.tick()
    assert driven.receiver.accepted == 3
    assert status["measured"].keys() == status["target"].keys()


def test_after_a_fall_the_robot_stands_up_where_its_targets_were(driven: Teleoperation, send: socket.socket) -> None:
    send.send(packets.encode(Packet(1, 0.0, footsteps.initial_nodes(driven.robot))))
    driven.tick()
    driven.data.qpos[:7] = 3, 0, 0.3, 0, 1, 0, 0
    rows = ticks(driven, 2)
    assert not rows[0][-1] and all(row[-1] for row in rows[1:])
    assert driven.falls == 1
    np.testing.assert_allclose(trunk(driven), STANDS, atol=0.03)


def test_a_state_that_is_not_finite_is_a_fall(
    driven: Teleoperation, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # where MuJoCo writes its log
    driven.data.qvel[0] = np.nan
    ticks(driven, 1)
    assert driven.falls == 1
    np.testing.assert_allclose(trunk(driven), STANDS, atol=0.03)


# The command line


def run(*arguments: str, cwd: pathlib.Path = TOP) -> subprocess.CompletedProcess[str]:
    program = "import sys; sys.modules.update(jax=None, brax=None, flax=None); from bipedtrack.teleop import main; main()"
    place = {**os.environ, "PYTHONPATH": str(TOP)}
    command = [sys.executable, "-c", program, *arguments]
    return subprocess.run(command, cwd=cwd, env=place, capture_output=True, text=True, timeout=120)


def test_the_command_line_runs_records_and_ends_by_itself_without_jax(tmp_path: pathlib.Path) -> None:
    done = run("--port", "0", "--seconds", "2", "--record", str(tmp_path / "trace.npz"))
    assert done.returncode == 0 and done.stderr == "", done.stderr
    lines = done.stdout.splitlines()
    assert re.fullmatch(r"listening on 127\.0\.0\.1 port \d+", lines[0])
    assert all("standing" in line and "refused: none; falls: 0" in line for line in lines[1:3])
    assert lines[3:] == [str(tmp_path / "trace.npz")]
    with np.load(tmp_path / "trace.npz", allow_pickle=False) as trace:
        assert trace["qpos"].shape == (400, 19) and trace["alive"].all() and trace["still"].all()


def test_an_address_that_others_reach_is_warned_of() -> None:
    done = run("--host", "0.0.0.0", "--port", "0", "--seconds", "0.1")
    assert done.returncode == 0
    assert done.stderr.count("\n") == 1 and "warning" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["missing.npz"], "missing.npz"),
        (["--seconds", "0"], "--seconds"),
        (["--seconds", "nan"], "--seconds"),
        (["--hold", "0"], "--hold"),
        (["--port", "70000"], "--port"),
        (["--host", "999.0.0.1"], "999.0.0.1"),
        (["--host", "127.0.0..1"], "127.0.0..1"),
        (["--host", "192.0.2.1"], "192.0.2.1"),
        (["--record", "trace.npz"], "--seconds"),
        (["--record", "nowhere/trace.npz", "--seconds", "1"], "nowhere"),
        (["--record", "folder.npz", "--seconds", "1"], "folder.npz: cannot be written: it is a folder"),
        (["--ground", "missing.csv"], "missing.csv"),
    ],
)
def test_bad_input_is_one_line_and_status_2(
    arguments: list[str],
    named: str,
    tmp_path: pathlib.Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.npz").mkdir()
    monkeypatch.setattr(sys, "argv", ["teleop", *arguments])
    with pytest.raises(SystemExit) as left:
        teleop.main()
    said = [line for line in capsys.readouterr().err.splitlines() if "warning" not in line]
    assert left.value.code == 2 and len(said) == 1 and said[0].startswith("bipedtrack: ") and named in said[0]


def test_the_client_of_the_readme_makes_the_robot_squat(tmp_path: pathlib.Path) -> None:
    readme = (TOP / "README.md").read_text(encoding="utf-8")
    (client,) = (block for block in re.findall(r"```python\n(.*?)```", readme, re.DOTALL) if "socket" in block)
    assert len(client.splitlines()) <= 20
    arguments = ["--seconds", "10", "--port", "0", "--record", str(tmp_path / "trace.npz")]
    server = subprocess.Popen(
        [sys.executable, "-m", "bipedtrack.teleop", *arguments], cwd=TOP, stdout=subprocess.PIPE, text=True
    )
    with server:
        assert server.stdout is not None
        port = server.stdout.readline().removeprefix("listening on 127.0.0.1 port ").strip()
        assert client.count("47200") == 1 and int(port) > 0
        client = client.replace("47200", port)
        # isolated: the standard library alone
        done = subprocess.run([sys.executable, "-I", "-S", "-c", client], capture_output=True, text=True, timeout=30)
        assert "standing" in server.stdout.read()
    assert done.returncode == 0 and ", falls: 0 trunk at" in done.stdout, done.stderr
    assert server.returncode == 0
    with np.load(tmp_path / "trace.npz", allow_pickle=False) as trace:
        _, y, z = trace["qpos"][:, :3].T
        assert trace["alive"].all()
        assert z.min() < 0.67 and np.ptp(y) > 0.02
