"""What the tests of array files and of run directories share."""

import os
import pathlib
import subprocess
import sys

from bipedtrack import checkpoint

ROOT = pathlib.Path(checkpoint.__file__).parents[1]


def same(left, right):
    """Equal names in equal order, shapes, dtypes and bytes: NaN equals NaN, -0 differs from 0."""
    assert list(left) == list(right)
    for name in left:
        assert (left[name].shape, left[name].dtype) == (right[name].shape, right[name].dtype)
        assert left[name].tobytes() == right[name].tobytes()
    return True


def run_python(code, *arguments, **options):
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        **options,
    )
