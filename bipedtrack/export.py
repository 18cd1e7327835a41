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
    out: pathlib.Path | None = None
    """The file to write. Default: policy.npz, or none beside --onnx."""
    onnx: pathlib.Path | None = None
    """An ONNX graph from observation to feedback, to write here (needs `pip install '.[onnx]'`)."""


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
            if options.out is not None:
                raise policy.PolicyError(f"--out {options.out}: {options.run} is a policy file already; wanted --onnx alone")
            written = policy.load(options.run)
        else:
            out = options.out or (pathlib.Path("policy.npz") if options.onnx is None else None)
            written = export(options.run, out)
            if out is not None:
                print(out)
        if options.onnx is not None:
            onnx_export.save(written, options.onnx)
            print(options.onnx)
    except Refusal as error:
        fail(str(error))


def export(run: pathlib.Path, out: pathlib.Path | None) -> policy.Policy:
    """The policy of the run's newest intact checkpoint, written to `out` where there is one.

    Raises checkpoint.RunError or checkpoint.CheckpointError where the run or its checkpoint cannot be read.
    """
    with quiet_imports():
        from bipedtrack import training

    directory = RunDirectory(run)
    newest = training.newest_policy(directory)
    if out is not None:
        policy.save(newest, out)
    for warning in directory.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    return newest


if __name__ == "__main__":
    main()
