"""The doctor: its verdict on this machine, and that it notices what is wrong."""

import subprocess
import sys

import mujoco
import pytest

from bipedtrack import doctor, versions

PENDULUM = mujoco.MjModel.from_xml_string("""
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body pos="0 0 1">
      <joint name="hinge" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.03"/>
    </body>
  </worldbody>
  <actuator><position joint="hinge" kp="20" kv="1"/></actuator>
  <keyframe><key name="stand" qpos="0.1" ctrl="0.1"/></keyframe>
</mujoco>
""")


def test_doctor_finds_nothing_broken_here() -> None:
    report = subprocess.run([sys.executable, "-m", "bipedtrack.doctor"], capture_output=True, text=True, timeout=300)
    assert report.returncode == 0, report.stdout + report.stderr
    assert report.stdout.splitlines()[-1] == "all is well"
    for part in ("jaxlib", "cpu:0", "MUJOCO_GL=egl", "compiling", "MJX against MuJoCo C"):
        assert part in report.stdout


def test_ten_steps_move_the_model_and_agree_with_c() -> None:
    position, velocity = doctor.physics_difference(PENDULUM, 0)
    assert 0.0 < position < 1e-6  # not the very same numbers: the C side computes in float64
    assert 0.0 < velocity < 1e-5


def test_physics_beyond_the_tolerance_is_broken(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(doctor, "physics_difference", lambda model, keyframe: (0.0, 2e-4))
    assert not doctor.report_physics()
    assert "2.0e-04" in capsys.readouterr().out


def test_unusable_back_end_says_why() -> None:
    assert "nonsense" in doctor.rendering_complaints(("nonsense",))["nonsense"]


def test_hanging_back_end_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_FRAME", "import time; time.sleep(60)")
    monkeypatch.setattr(doctor, "RENDERING_TIMEOUT_S", 0.5)
    assert "no frame" in doctor.rendering_complaints(("egl",))["egl"]


def test_status_is_one_when_a_check_fails_or_raises(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def unusable() -> bool:
        raise OSError("no driver")

    monkeypatch.setattr(sys, "argv", ["doctor"])
    monkeypatch.setattr(versions, "check", lambda: [versions.Row("jax", "0.9.2", "0.10.2", ok=False)])
    monkeypatch.setattr(doctor, "report_devices", unusable)
    monkeypatch.setattr(doctor, "report_rendering", lambda: True)
    monkeypatch.setattr(doctor, "report_physics", lambda: True)
    assert doctor.main() == 1
    report = capsys.readouterr().out
    assert "broken: versions, devices" in report
    assert "device_put_replicated" in report
    assert "OSError: no driver" in report
