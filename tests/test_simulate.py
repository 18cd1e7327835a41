"""The commands that simulate, with a robot of one's own."""

import dataclasses
import json
import shutil
import subprocess
import sys
from pathlib import Path

import mujoco
import pytest

from bipedtrack import config, footsteps, policy, robot, simulate

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
    found = json.loads((tmp_path / "evaluation/metrics.json").read_text())["tasks"]["script-walk"]["policies"]["heavy.npz"]
    assert found["converged"]["summary"]["survival"]["falls"] == 0

    (tmp_path / "models/heavy/heavy.xml").write_text("<mujoco>\n<worldbody>\n<body/>\n</mujoco>")
    with pytest.raises(AssertionError, match="heavy.npz: .*heavy.xml: is no MJCF that MuJoCo compiles: XML") as refusal:
        run("bipedtrack.simulate", "heavy.npz", "walk.csv")
    assert "Traceback" not in str(refusal.value)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["missing.npz", "walk.csv"], "missing.npz: cannot be read"),
        ([str(ROOT / "models/policies/best.npz"), "missing.csv"], "missing.csv: cannot be read"),
        ([str(ROOT / "models/policies/best.npz"), "wrong.csv"], "wrong.csv:2: foot is 'middle'"),
        ([str(ROOT / "models/policies/best.npz"), "walk.csv", "--seconds", "0"], "--seconds 0.0: must be at least 0.1"),
        ([str(ROOT / "models/policies/best.npz"), "walk.csv", "--seconds", "nan"], "--seconds nan: must be at least 0.1"),
    ],
)
def test_bad_input_is_one_line_and_status_2(
    arguments: list[str], named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    header = ",".join(footsteps.COLUMNS)
    (tmp_path / "walk.csv").write_text(f"{header}\nleft,0.1\n")
    (tmp_path / "wrong.csv").write_text(f"{header}\nmiddle,0.1\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["simulate", *arguments])
    with pytest.raises(SystemExit) as left:
        simulate.main()
    said = capsys.readouterr().err
    assert left.value.code == 2 and said.count("\n") == 1 and said.startswith("bipedtrack: ") and named in said


def test_inverse_kinematics_alone_falls_and_the_script_may_last_longer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    steps = "\n".join(f"{foot},{0.2 * i:.1f}" for i, foot in enumerate(("left", "right") * 4, 1))
    (tmp_path / "walk.csv").write_text(f"{','.join(footsteps.COLUMNS)}\n{steps}\n")
    arguments = ["simulate", str(ROOT / "models/policies/best.npz"), str(tmp_path / "walk.csv")]
    said = []
    for options in (["--no-feedback"], ["--seconds", "1.5"], ["--seconds", "6"]):
        monkeypatch.setattr(sys, "argv", [*arguments, *options])
        simulate.main()
        said.append(capsys.readouterr().out)
    assert "fell" in said[0] and said[1].startswith("1.5 s, no fall") and said[2].startswith("6.0 s, no fall")
