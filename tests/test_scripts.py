"""Footstep scripts that lie ready, and drives written down as one."""

import numpy as np
import pytest

from bipedtrack import footsteps, nodes, sampling, scripts
from bipedtrack import robot as robots


def test_a_script_written_down_reads_back_the_same(robot: robots.Robot) -> None:
    for name, path in scripts.ready().items():
        script = footsteps.load(path, robot)
        again = footsteps.parse(scripts.text(robot, script.steps, script.boxes), robot, name)
        assert again.boxes == script.boxes
        assert footsteps.duration(again) == pytest.approx(footsteps.duration(script))
        for time in np.arange(0, footsteps.duration(script), 0.13):
            targets = [footsteps.command_at(each, float(time)).target for each in (script, again)]
            assert max(np.abs(part).max() for part in nodes.difference(*targets)) < 1e-4


def test_every_kind_and_both_courses_lie_ready() -> None:
    assert {*sampling.KINDS, "obstacles"} <= set(scripts.ready())
