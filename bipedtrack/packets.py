"""The wire format of teleoperation: one datagram says where trunk and ankles are to be, as JSON or as packed floats.

A packet holds, in the world frame and in SI units:

    sequence  grows from packet to packet, 0 to 2**53
    time      s, on the sender's own clock: the time between two packets is what the targets take from one to the other
    target    Nodes: where trunk and ankles are to be now, I^t of eq (3)
    rates     NodeRates, optional: how fast they move
    end       Nodes, optional, only with timer: where they will be when the task step ends, I^s
    timer     (2,) s, optional, only with end: until the left and right foot touch the ground, T; 0 for one that stands
    reply     whether an answer is wanted

As JSON it is an object with these keys and `"bipedtrack": 1`, the version; target, rates and end are objects with the
fields of Nodes and NodeRates as nested lists. Packed it has 208 bytes, little-endian: the magic `BPTK`, the version
(uint16), flags (uint16: 1 for rates, 2 for end and timer, 4 for reply), sequence (uint64), time (float64), then in float32
the 15 numbers of target, the 14 of rates, the 15 of end and the 2 of timer, in the order of their fields. What no flag
names is not read.
"""

from __future__ import annotations

import json
import struct
from typing import Any, NamedTuple, NoReturn

import numpy as np

from bipedtrack import rotations
from bipedtrack.nodes import NodeRates, Nodes

VERSION = 1
MAGIC = b"BPTK"
LARGEST_DATAGRAM = 4096  # bytes
REASONS = ("size", "format", "version", "field", "number", "range", "source", "order", "jump", "reach", "flood")
"""Why packets are refused; the last five are for whoever receives them to judge."""

FASTEST = NodeRates(1.0, 2.0, 4.0, 5.0)
"""The greatest speeds of trunk (m/s), trunk turn (rad/s), ankles (m/s) and ankle yaws (rad/s)."""
_FARTHEST = 1000.0  # m
_MOST_TURNED = 100.0  # rad, an ankle's yaw; it counts modulo a whole turn
_STEEPEST = 0.5  # rad, the trunk's tilt
_LONGEST = 2.0  # s, a timer
_LATEST = 1e12  # s
_LAST = 2**53  # what a float still counts

_NODES = Nodes((3,), (4,), (2, 3), (2,))
_RATES = NodeRates((3,), (3,), (2, 3), (2,))
_TIMER = (2,)
_HEADER = struct.Struct("<4sHHQd")
_NUMBERS = 15 + 14 + 15 + 2
PACKED_SIZE = _HEADER.size + 4 * _NUMBERS
_HAS_RATES, _HAS_END, _REPLY = 1, 2, 4


class Refused(ValueError):
    """A packet that is not followed; `reason` is one of REASONS."""

    def __init__(self, reason: str, message: str):
        super().__init__(message)
        self.reason = reason


class Packet(NamedTuple):
    """One message; arrays in float64."""

    sequence: int
    time: float  # s
    target: Nodes
    rates: NodeRates | None = None
    end: Nodes | None = None
    timer: np.ndarray | None = None  # (2,) s
    reply: bool = False


def decode(datagram: bytes) -> Packet:
    """The packet in a datagram, every field of it checked. Raises Refused, and nothing else, whatever the bytes are."""
    if len(datagram) > LARGEST_DATAGRAM:
        raise Refused("size", f"{len(datagram)} bytes; at most {LARGEST_DATAGRAM} are read")
    if datagram.startswith(MAGIC):
        return _checked(_unpacked(datagram))
    return _checked(_from_json(datagram))


def encode(packet: Packet) -> bytes:
    """The packed form of a packet, 208 bytes."""
    flags = _HAS_RATES * (packet.rates is not None) + _HAS_END * (packet.end is not None) + _REPLY * packet.reply
    parts = (packet.target, packet.rates or _zeros(_RATES), packet.end or _zeros(_NODES))
    timer = np.zeros(_TIMER) if packet.timer is None else packet.timer
    numbers = np.concatenate([np.ravel(array) for array in (*parts[0], *parts[1], *parts[2], timer)])
    return _HEADER.pack(MAGIC, VERSION, flags, packet.sequence, packet.time) + numbers.astype("<f4").tobytes()


def _zeros(shapes: Any) -> Any:
    return type(shapes)(*map(np.zeros, shapes))


def _unpacked(datagram: bytes) -> Packet:
    """The packet in packed floats, its values not yet checked."""
    if len(datagram) != PACKED_SIZE:
        raise Refused("size", f"{len(datagram)} bytes; packed ones have {PACKED_SIZE}")
    _, version, flags, sequence, time = _HEADER.unpack_from(datagram)
    _check_version(version)
    if flags > _HAS_RATES | _HAS_END | _REPLY:
        raise Refused("field", f"unknown flags {flags:#x}")
    with np.errstate(invalid="ignore"):  # a signalling nan
        numbers = np.frombuffer(datagram, "<f4", offset=_HEADER.size).astype(np.float64)
    target, rates, end, timer = np.split(numbers, [15, 29, 44])
    return Packet(
        sequence,
        time,
        _split(_NODES, target),
        _split(_RATES, rates) if flags & _HAS_RATES else None,
        _split(_NODES, end) if flags & _HAS_END else None,
        timer if flags & _HAS_END else None,
        bool(flags & _REPLY),
    )


def _split(shapes: Any, numbers: np.ndarray) -> Any:
    """Consecutive numbers as a struct of arrays with these shapes."""
    sizes = [int(np.prod(shape)) for shape in shapes]
    parts = np.split(numbers, np.cumsum(sizes)[:-1])
    return type(shapes)(*(part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)))


def _from_json(datagram: bytes) -> Packet:
    """The packet in JSON, its types and shapes checked, its values not yet."""
    try:
        # RecursionError: nested too deep; ValueError: no JSON, no UTF-8, or a number of thousands of digits
        message = json.loads(datagram.decode(), parse_constant=_not_finite)
    except Refused:
        raise
    except (ValueError, RecursionError):
        raise Refused("format", "neither JSON nor packed floats") from None
    if type(message) is not dict or "bipedtrack" not in message:
        raise Refused("format", 'no JSON object with "bipedtrack"')
    _check_version(message.pop("bipedtrack"))
    stray = set(message) - set(Packet._fields)
    missing = {"sequence", "time", "target"} - set(message)
    if stray or missing:
        raise Refused("field", f"unknown or missing: {', '.join(sorted(stray | missing))[:80]}")
    sequence, reply = message["sequence"], message.get("reply", False)
    if type(sequence) is not int or type(reply) is not bool:
        raise Refused("field", "sequence must be an integer and reply true or false")
    given = message.get
    return Packet(
        sequence,
        float(_array("time", message["time"], ())),
        _struct("target", _NODES, message["target"]),
        None if given("rates") is None else _struct("rates", _RATES, message["rates"]),
        None if given("end") is None else _struct("end", _NODES, message["end"]),
        None if given("timer") is None else _array("timer", message["timer"], _TIMER),
        reply,
    )


def _not_finite(name: str) -> NoReturn:
    raise Refused("number", f"{name} is no number to go to")


def _check_version(version: Any) -> None:
    if type(version) is not int or version != VERSION:
        raise Refused("version", f"another version than {VERSION}")


def _struct(name: str, shapes: Any, value: Any) -> Any:
    """A JSON object as the struct whose fields have these shapes."""
    if type(value) is not dict or set(value) != set(shapes._fields):
        raise Refused("field", f"{name} must have the fields {', '.join(shapes._fields)}")
    parts = {field: _array(f"{name}.{field}", value[field], shape) for field, shape in shapes._asdict().items()}
    return type(shapes)(**parts)


def _array(name: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Nested JSON lists as the array of this shape, float64; a number too large for any field becomes infinite."""
    if shape:
        if type(value) is not list or len(value) != shape[0]:
            raise Refused("field", f"{name} must be nested lists of {shape[0]}")
        return np.array([_array(name, part, shape[1:]) for part in value])
    if type(value) not in (int, float):
        raise Refused("field", f"{name} must be made of numbers")
    return np.array(float(value) if abs(value) <= _LATEST else np.inf)


def _checked(packet: Packet) -> Packet:
    """The same packet with unit quaternions, if all its values are finite and within their ranges."""
    structs = [part for part in (packet.target, packet.rates, packet.end) if part is not None]
    arrays = [packet.time, *(array for struct in structs for array in struct)]
    if (packet.end is None) != (packet.timer is None):
        raise Refused("field", "end and timer belong together")
    if packet.timer is not None:
        arrays.append(packet.timer)
    if not all(np.isfinite(array).all() for array in arrays):
        raise Refused("number", "not all numbers are finite")
    if not (0 <= packet.sequence <= _LAST and abs(packet.time) <= _LATEST):
        raise Refused("range", "sequence or time")
    if packet.timer is not None and not (0 <= packet.timer.min() and packet.timer.max() <= _LONGEST):
        raise Refused("range", f"timer; wanted 0 to {_LONGEST:g} s")
    if packet.rates is not None:
        for name, rate, most in zip(NodeRates._fields, packet.rates, FASTEST, strict=True):
            if speed(rate).max() > most:
                raise Refused("range", f"{name} is faster than {most:g}")
    end = None if packet.end is None else _checked_nodes(packet.end)
    return packet._replace(target=_checked_nodes(packet.target), end=end)


def speed(rate: np.ndarray) -> np.ndarray:
    """The lengths of vectors (..., 3), kept as an axis of one, and the sizes of the two yaw rates (2,)."""
    return np.abs(rate) if rate.shape == (2,) else np.linalg.norm(rate, axis=-1, keepdims=True)


def _checked_nodes(nodes: Nodes) -> Nodes:
    """The same nodes with a unit quaternion, if they are within their ranges."""
    if max(np.abs(nodes.trunk_position).max(), np.abs(nodes.ankle_positions).max()) > _FARTHEST:
        raise Refused("range", f"positions; wanted at most {_FARTHEST:g} m either way")
    if np.abs(nodes.ankle_yaws).max() > _MOST_TURNED:
        raise Refused("range", f"ankle_yaws; wanted at most {_MOST_TURNED:g} rad either way")
    length = np.abs(nodes.trunk_orientation).max()
    length = np.linalg.norm(nodes.trunk_orientation) if length < 2 else length
    if not 0.9 < length < 1.1:
        raise Refused("range", "trunk_orientation is no unit quaternion")
    nodes = nodes._replace(trunk_orientation=nodes.trunk_orientation / length)
    require_upright(nodes, "the trunk is")
    return nodes


def require_upright(nodes: Nodes, subject: str) -> None:
    """Raises Refused where the trunk is tilted too far. subject: of the sentence."""
    if rotations.to_matrix(nodes.trunk_orientation)[2, 2] < np.cos(_STEEPEST):
        raise Refused("range", f"{subject} tilted by more than {_STEEPEST:g} rad")
