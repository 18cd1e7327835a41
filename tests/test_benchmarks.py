"""Benchmarks refuse in one line what they cannot measure; what they print is in the README."""

import pathlib
import subprocess
import sys

import pytest

import bipedtrack

ROOT = pathlib.Path(bipedtrack.__file__).parents[1]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("rollout --policy nobody.npz", "nobody.npz: cannot be read"),
        ("rollout --robots 64 0", "--robots 0: must be at least 1"),
        ("rollout --robots 3 --devices 2", "2 devices: the robots cannot be shared out evenly"),
        ("rollout --steps 0", "--steps 0: must be at least 1"),
        ("learner --curriculum nope", "nope"),
        ("learner --updates 0", "--updates 0: must be at least 1"),
        ("training --curriculum smoke --stage 9", "--stage 9: smoke has the stages 0 to "),
        ("training --devices -1", "--devices -1: must not be negative"),
    ],
)
def test_what_cannot_be_measured_is_refused_in_one_line(arguments: str, words: str) -> None:
    name, *options = arguments.split()
    command = [sys.executable, f"benchmarks/{name}.py", *options]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=120)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1), done.stderr
    assert done.stderr.startswith("bipedtrack: ") and words in done.stderr
