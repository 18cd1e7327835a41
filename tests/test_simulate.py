"""The commands that simulate, with a robot of one's own."""

import dataclasses
import json
import shutil
import subprocess
import sys
from pathlib import Path

import mujoco
import pytest

from bipedtrack import config, footsteps, policy, robot

ROOT = Path(__file__).resolve().parent.parent


def test_another_robot_is_simulated_and_evaluated_as_itself(tmp_path: Path) -> None:
    # a checkout with one robot, a heavier one of another name
    for name in ("bipedtrack", "curricula"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__", "*.md"))
    (tmp_path / "models" / "heavy").mkdir(parents=True)
    source = robot.mjcf_path("ranger_max")
    mjcf, trunk = source.read_text(), 'size="0.15 0.15 0.075" mass="20"'
    assert trunk in mjcf
    (tmp_path / "models/heavy/heavy.xml").write_text(mjcf.replace(trunk, trunk.replace("20", "23")))
    shutil.copy(source.with_suffix(".toml"), tmp_path / "models/heavy/heavy.toml")
    heavy = robot.from_model(
        "heavy",
        mujoco.MjModel.from_xml_path(str(tmp_path / "models/heavy/heavy.xml")),
        config.load(robot.Description, source.with_suffix(".toml")),
    )
    assert heavy.masses[0] == 23
    best = policy.load(ROOT / "models/policies/best.npz")
    policy.save(dataclasses.replace(best, robot=heavy), tmp_path / "heavy.npz")
    (tmp_path / "walk.csv").write_text(",".join(footsteps.COLUMNS) + "\nleft,0.1\nright,0.2\nleft,0.2\n")

    def run(*arguments: str) -> str:
        command = [sys.executable, "-m", *arguments]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert "no fall" in run("bipedtrack.simulate", "heavy.npz", "walk.csv")
    run("bipedtrack.teleop", "heavy.npz", "--seconds", "0.2", "--port", "0")
    run("bipedtrack.evaluate", "heavy.npz", "--script", "walk.csv", "--engine", "converged")
    found = json.loads((tmp_path / "evaluation/metrics.json").read_text())["tasks"]["walk"]["policies"]["heavy.npz"]
    assert found["converged"]["summary"]["survival"]["falls"] == 0

    (tmp_path / "models/heavy/heavy.xml").write_text("<mujoco>\n<worldbody>\n<body/>\n</mujoco>")
    with pytest.raises(AssertionError, match="heavy.npz: .*heavy.xml: is no MJCF that MuJoCo compiles: XML") as refusal:
        run("bipedtrack.simulate", "heavy.npz", "walk.csv")
    assert "Traceback" not in str(refusal.value)
