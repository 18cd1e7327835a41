"""The wire format against bytes made by hand, and against everything else that can be sent."""

import json
import math
from typing import Any

import malformed
import numpy as np
import pytest

from bipedtrack import footsteps, packets
from bipedtrack.nodes import NodeRates, Nodes
from bipedtrack.packets import Packet, Refused, decode, encode
from bipedtrack.robot import Robot

RATES = {
    "trunk_velocity": [0.1, 0.2, 0.3],
    "trunk_angular_velocity": [0.4, 0.5, 0.6],
    "ankle_velocities": [[1.0, 1.1, 1.2], [1.3, 1.4, 1.5]],
    "ankle_yaw_rates": [1.6, 1.7],
}


def upright(robot: Robot) -> Nodes:
    """What malformed.NODES and malformed.NUMBERS say."""
    return footsteps.initial_nodes(robot)._replace(trunk_position=np.array([0.0, 0.0, 0.75]))


def same(found: Any, wanted: Any) -> bool:
    """Whether two packets hold the same, to the digits of float32."""
    if isinstance(wanted, tuple):
        return type(found) is type(wanted) and all(map(same, found, wanted))
    return np.allclose(found, wanted, atol=1e-6) if isinstance(wanted, np.ndarray) else found == wanted


def reason(datagram: bytes) -> str:
    with pytest.raises(Refused) as refusal:
        decode(datagram)
    assert refusal.value.reason in packets.REASONS and "\n" not in str(refusal.value)
    return refusal.value.reason


def test_packed_and_json_by_hand_say_the_same(robot: Robot) -> None:
    rates = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 1.0, 1.1, 1.2, 1.3, 1.4, 1.5, 1.6, 1.7]
    by_bytes = decode(malformed.packed(7, 0.5, [*malformed.NUMBERS, *rates, *malformed.NUMBERS, 0.0, 0.25], flags=7))
    text = malformed.message(7, time=0.5, rates=RATES, end=malformed.NODES, timer=[0, 0.25], reply=True)
    by_json = decode(json.dumps(text).encode())
    start = upright(robot)
    arrays = NodeRates(*(np.array(part) for part in RATES.values()))
    wanted = Packet(7, 0.5, start, arrays, start, np.array([0.0, 0.25]), True)
    assert same(by_bytes, wanted) and same(by_json, wanted)
    assert same(decode(encode(wanted)), wanted)


def test_what_is_optional_may_be_left_out() -> None:
    for datagram in (malformed.packed(3, 1.5, malformed.NUMBERS), json.dumps(malformed.message(3)).encode()):
        packet = decode(datagram)
        assert packet.sequence == 3 and packet.rates is packet.end is packet.timer is None and packet.reply is False


def test_packed_numbers_that_no_flag_names_are_not_read() -> None:
    assert decode(malformed.packed(1, 0, [*malformed.NUMBERS, *[math.nan] * 31])).rates is None


def test_encoding_gives_the_bytes_of_the_table(robot: Robot) -> None:
    assert encode(Packet(9, 2.5, upright(robot))) == malformed.packed(9, 2.5, malformed.NUMBERS)
    assert packets.PACKED_SIZE == 208


def test_a_quaternion_is_normalised() -> None:
    slightly = malformed.NODES | {"trunk_orientation": [1.05, 0.0, 0.0, 0.105]}
    orientation = decode(json.dumps(malformed.message(target=slightly)).encode()).target.trunk_orientation
    np.testing.assert_allclose(orientation, np.array([1, 0, 0, 0.1]) / math.hypot(1, 0.1))


def changed(part: str, value: object) -> bytes:
    return json.dumps(malformed.message(target=malformed.NODES | {part: value})).encode()


def with_keys(**keys: object) -> bytes:
    return json.dumps(malformed.message(**keys)).encode()


@pytest.mark.parametrize(
    ("datagram", "wanted"),
    [
        (b"", "format"),
        (b"\xff\xfe", "format"),
        (b"[]", "format"),
        (b"{}", "format"),
        (b"[" * 4000, "format"),
        (b"9" * 4000, "format"),
        (b"9" * 5000, "size"),
        (malformed.packed()[:-1], "size"),
        (malformed.packed() + b"\0", "size"),
        (b"BPTK", "size"),
        (malformed.packed(version=2), "version"),
        (with_keys(bipedtrack=2), "version"),
        (with_keys(bipedtrack=True), "version"),
        (with_keys(bipedtrack="1"), "version"),
        (malformed.packed(numbers=malformed.NUMBERS, flags=8), "field"),
        (with_keys(colour="red"), "field"),
        (b'{"bipedtrack": 1, "sequence": 1, "time": 0}', "field"),
        (with_keys(sequence=1.0), "field"),
        (with_keys(sequence=True), "field"),
        (with_keys(reply=1), "field"),
        (with_keys(time="now"), "field"),
        (with_keys(time=True), "field"),
        (with_keys(target=[0]), "field"),
        (with_keys(end=malformed.NODES), "field"),
        (with_keys(timer=[0, 0]), "field"),
        (with_keys(rates={"trunk_velocity": [0, 0, 0]}), "field"),
        (changed("trunk_position", [0, 0]), "field"),
        (changed("trunk_position", [0, 0, True]), "field"),
        (changed("ankle_positions", [0.1] * 6), "field"),
        (changed("trunk_position", [0, 0, math.nan]), "number"),
        (changed("trunk_position", [0, 0, 1e300]), "number"),
        (changed("trunk_position", [0, 0, 10**400]), "number"),
        (with_keys(time=math.inf), "number"),
        (malformed.packed(time=math.nan, numbers=malformed.NUMBERS), "number"),
        (malformed.packed(numbers=[math.inf]), "number"),
        (with_keys(sequence=-1), "range"),
        (with_keys(sequence=2**53 + 1, time=0), "range"),
        (with_keys(sequence=10**300, time=0), "range"),
        (changed("trunk_position", [0, 0, 1001]), "range"),
        (changed("ankle_yaws", [0, -101]), "range"),
        (changed("trunk_orientation", [0, 0, 0, 0]), "range"),
        (changed("trunk_orientation", [2, 0, 0, 0]), "range"),
        (changed("trunk_orientation", [0.9, 0.43, 0, 0]), "range"),
        (with_keys(end=malformed.NODES, timer=[-0.1, 0]), "range"),
        (with_keys(end=malformed.NODES, timer=[0, 2.1]), "range"),
        (with_keys(rates=RATES | {"trunk_velocity": [0.8, 0.8, 0]}), "range"),
        (with_keys(rates=RATES | {"ankle_yaw_rates": [0, -5.1]}), "range"),
    ],
)
def test_what_cannot_be_followed_is_refused_for_its_reason(datagram: bytes, wanted: str) -> None:
    assert reason(datagram) == wanted


@pytest.mark.filterwarnings("error")
def test_ten_thousand_malformed_messages_raise_nothing_else() -> None:
    seen = set()
    for datagram in malformed.messages(10_000):
        try:
            packet = decode(datagram)
        except Refused as refusal:
            seen.add(refusal.reason)
        else:
            assert all(np.isfinite(part).all() and np.abs(part).max() <= 1000 for part in packet.target)
            assert math.isclose(np.linalg.norm(packet.target.trunk_orientation), 1)
    assert seen == {"size", "format", "version", "field", "number", "range"}


def test_flipped_bits_give_a_packet_within_the_limits_or_a_refusal(robot: Robot) -> None:
    whole = encode(Packet(9, 2.5, footsteps.initial_nodes(robot), end=footsteps.initial_nodes(robot), timer=np.zeros(2)))
    for bit in range(8 * len(whole)):
        flipped = bytearray(whole)
        flipped[bit // 8] ^= 1 << bit % 8
        try:
            packet = decode(bytes(flipped))
        except Refused:
            continue
        for nodes in (packet.target, packet.end or packet.target):
            assert isinstance(nodes, Nodes) and all(np.abs(part).max() <= 1000 for part in nodes)
