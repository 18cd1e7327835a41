"""`python -m bipedtrack.export RUN --out policy.npz`: the policy of a run's last checkpoint as one file for numpy.

`--onnx policy.onnx` writes it as an ONNX graph as well, or a policy file as one.
"""

from __future__ import annotations

import dataclasses
import pathlib
import sys
from typing import Annotated

import tyro

from bipedtrack import onnx_export, policy, versions
from bipedtrack.messages import Refusal, fail, quiet_imports
from bipedtrack.run_directory import RunDirectory


@dataclasses.dataclass(frozen=True)
class Export:
    """Writes the policy of a run's newest checkpoint, with all that it needs to run in numpy."""

    run: Annotated[pathlib.Path, tyro.conf.Positional]
    """The run directory; or a policy file, for --onnx."""
    out: pathlib.Path = pathlib.Path("policy.npz")
    """The file to write."""
    onnx: pathlib.Path | None = None
    """Also an ONNX graph from observation to feedback, to write here (needs `pip install '.[onnx]'`)."""


def main() -> None:
    """The command line. Exit status 0 when written, 2 for bad input."""
    options = tyro.cli(Export, prog="python -m bipedtrack.export")
    try:
        versions.require()
        if options.onnx is not None:
            onnx_export.require_onnx()
        if options.run.is_file():
            if options.onnx is None:
                raise policy.PolicyError(f"{options.run}: is a file; wanted a run directory, or --onnx with a policy file")
            written = policy.load(options.run)
        else:
            written = export(options.run, options.out)
            print(options.out)
        if options.onnx is not None:
            onnx_export.save(written, options.onnx)
            print(options.onnx)
    except Refusal as error:
        fail(str(error))


def export(run: pathlib.Path, out: pathlib.Path) -> policy.Policy:
    """Writes the policy of the run's newest intact checkpoint and returns it.

    Raises checkpoint.RunError or checkpoint.CheckpointError where the run or its checkpoint cannot be read.
    """
    with quiet_imports():
        from bipedtrack import training

    directory = RunDirectory(run)
    newest = training.save_policy(directory, out)
    for warning in directory.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    return newest


if __name__ == "__main__":
    main()
