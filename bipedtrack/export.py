"""`python -m bipedtrack.export RUN --out policy.npz`: the policy of a run's last checkpoint as one file for numpy."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import pathlib
import sys
from typing import Annotated

import tyro

from bipedtrack import checkpoint, config, curriculum, robot, versions
from bipedtrack.messages import fail


@dataclasses.dataclass(frozen=True)
class Export:
    """Writes the policy of a run's newest checkpoint, with all that it needs to run in numpy."""

    run: Annotated[pathlib.Path, tyro.conf.Positional]
    """The run directory."""
    out: pathlib.Path = pathlib.Path("policy.npz")
    """The file to write."""


def main() -> None:
    """The command line. Exit status 0 when written, 2 for bad input."""
    options = tyro.cli(Export, prog="python -m bipedtrack.export")
    try:
        versions.require()
        export(options.run, options.out)
    except (
        versions.VersionError,
        config.ConfigError,
        robot.RobotError,
        checkpoint.RunError,
        checkpoint.CheckpointError,
    ) as error:
        fail(str(error))
    print(options.out)


def export(run: pathlib.Path, out: pathlib.Path) -> None:
    """Writes the policy of the run's newest intact checkpoint.

    Raises checkpoint.RunError or checkpoint.CheckpointError where the run or its checkpoint cannot be read.
    """
    directory = checkpoint.RunDirectory(run)
    plan, seed = curriculum.of_run(directory)
    found = directory.latest()
    for warning in directory.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    if found is None:
        raise checkpoint.CheckpointError(f"{run}: has no checkpoint yet; its first PPO call is not finished")
    with contextlib.redirect_stdout(io.StringIO()):  # mjx prints that its optional warp is missing
        from bipedtrack import policy, training

    index, arrays, _ = found
    policy.save(training.to_policy(plan, arrays, training.provenance(plan, seed, index + 1)), out)


if __name__ == "__main__":
    main()
