"""Datagrams that no sender in its right mind sends, for tests of teleoperation."""

import json
import struct
from collections.abc import Iterator

import numpy as np

WRONG = [None, True, "0.75", "", [], {}, [[]], {"x": 1}, float("nan"), float("inf"), -float("inf"), 1e300, -1e300, 10**400]
NODES = {
    "trunk_position": [0.0, 0.0, 0.75],
    "trunk_orientation": [1.0, 0.0, 0.0, 0.0],
    "ankle_positions": [[0.0, 0.1, 0.04], [0.0, -0.1, 0.04]],
    "ankle_yaws": [0.0, 0.0],
}
NUMBERS = [0, 0, 0.75, 1, 0, 0, 0, 0, 0.1, 0.04, 0, -0.1, 0.04, 0, 0]


def message(sequence: int = 1, **changed: object) -> dict:
    """A JSON message that asks for standing, with some keys changed."""
    return {"bipedtrack": 1, "sequence": sequence, "time": sequence / 50, "target": NODES} | changed


def packed(sequence: int = 1, time: float = 0.02, numbers: tuple | list = (), flags: int = 0, version: int = 1) -> bytes:
    """A packed message, by the README's table; numbers that are left out are zero."""
    numbers = [*numbers, *[0.0] * (46 - len(numbers))]
    return struct.pack("<4sHHQd46f", b"BPTK", version, flags, sequence, time, *numbers)


def messages(count: int, seed: int = 0) -> Iterator[bytes]:
    """Malformed messages of every kind in turn; their sequence numbers are far ahead, so order alone excuses none."""
    rng = np.random.default_rng(seed)
    for i in range(count):
        yield KINDS[i % len(KINDS)](rng)


def _ahead(rng: np.random.Generator) -> int:
    return int(rng.integers(10**6, 10**9))


def _noise(rng: np.random.Generator) -> bytes:
    return rng.bytes(int(rng.integers(0, 600)))


def _noise_after_magic(rng: np.random.Generator) -> bytes:
    return struct.pack("<4sHHQd", b"BPTK", 1, int(rng.integers(0, 8)), _ahead(rng), 0.0) + rng.bytes(184)


def _cut_packed(rng: np.random.Generator) -> bytes:
    return packed(_ahead(rng), 0, NUMBERS)[: int(rng.integers(0, 208))]


def _cut_json(rng: np.random.Generator) -> bytes:
    whole = json.dumps(message(_ahead(rng))).encode()
    return whole[: int(rng.integers(0, len(whole)))]


def _changed_bytes(rng: np.random.Generator) -> bytes:
    whole = bytearray(json.dumps(message(_ahead(rng))).encode())
    for at in rng.integers(0, len(whole), 3):
        whole[at] = int(rng.integers(128, 256))
    return bytes(whole)


def _wrong_value(rng: np.random.Generator) -> bytes:
    """Anything at any place of the JSON message."""
    changed = json.loads(json.dumps(message(_ahead(rng), rates=None, end=NODES, timer=[0.0, 0.1])))
    inside, key = changed, str(rng.choice(["bipedtrack", "sequence", "time", "target", "end", "timer"]))
    while isinstance(inside[key], dict | list) and rng.random() < 0.8:
        inside = inside[key]
        key = str(rng.choice(list(inside))) if isinstance(inside, dict) else int(rng.integers(len(inside)))
    inside[key] = WRONG[int(rng.integers(len(WRONG)))] if key != "end" else 7
    return json.dumps(changed).encode()


def _wrong_number(rng: np.random.Generator) -> bytes:
    numbers = list(NUMBERS)
    numbers[int(rng.integers(len(numbers)))] = float(rng.choice([np.nan, np.inf, -np.inf, 3e38, 1e7, -1e7]))
    return packed(_ahead(rng), 0, numbers)


def _wrong_version(rng: np.random.Generator) -> bytes:
    version = int(rng.integers(2, 2**16))
    return (
        packed(_ahead(rng), 0, NUMBERS, version=version)
        if rng.random() < 0.5
        else json.dumps(message(bipedtrack=version)).encode()
    )


def _deep(rng: np.random.Generator) -> bytes:
    depth = int(rng.integers(1, 4000))
    return (b"[" * depth) if rng.random() < 0.5 else b'{"bipedtrack":1,"sequence":' + b"[" * depth + b"]" * depth + b"}"


def _digits(rng: np.random.Generator) -> bytes:
    number = b"9" * int(rng.integers(20, 9000))
    return b'{"bipedtrack":1,"sequence":1,"target":0,"time":' + number + b"}" if rng.random() < 0.5 else number


def _long(rng: np.random.Generator) -> bytes:
    return rng.bytes(int(rng.integers(4097, 20000)))


def _far_away(rng: np.random.Generator) -> bytes:
    """A whole and finite target, metres away."""
    numbers = np.array(NUMBERS, float)
    numbers[:3] += rng.choice([-1, 1]) * rng.uniform(1, 900, 3)
    return packed(_ahead(rng), 0, list(numbers))


def _old(rng: np.random.Generator) -> bytes:
    """What has been sent before, or never: the numbers of these streams begin at 1000."""
    return packed(int(rng.integers(0, 1000)), 0, NUMBERS)


KINDS = [_noise, _noise_after_magic, _cut_packed, _cut_json, _changed_bytes, _wrong_value, _wrong_number, _wrong_version]
KINDS += [_deep, _digits, _long, _far_away, _old]
