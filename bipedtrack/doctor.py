"""`python -m bipedtrack.doctor`: this machine's versions, devices, rendering, physics; status 1 for a fault.

The physics check steps our robot ten times in MuJoCo C (float64) and in MJX (float32), from the same state
and with the same joint targets. Rendering may be absent: only videos need it.
"""

import argparse
import os
import subprocess
import sys
import textwrap
from collections.abc import Callable
from typing import TYPE_CHECKING

from bipedtrack import __version__, versions
from bipedtrack.messages import quiet_imports

# Whatever may be missing or broken is imported by the check that needs it.
if TYPE_CHECKING:
    import mujoco

STEPS = 10
# Largest difference allowed in any qpos [m, rad] or qvel [m/s, rad/s]. Measured: 1e-7 and 5e-6.
TOLERANCE = 1e-4
# Amplitude [rad] by which the joint targets leave the standing posture, so that every joint moves.
OFFSET = 0.02
RENDERING_TIMEOUT_S = 30.0

_FRAME = """
import mujoco
model = mujoco.MjModel.from_xml_string(
    '<mujoco><worldbody><light pos="0 0 3"/><geom type="plane" size="1 1 .1"/></worldbody></mujoco>'
)
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 64, 64) as renderer:
    renderer.update_scene(data)
    frame = renderer.render()
assert frame.shape == (64, 64, 3) and frame.any(), "the frame is black"
"""


def main() -> int:
    """Prints the report; 0 if all is well, 1 if something is broken."""
    argparse.ArgumentParser(prog="python -m bipedtrack.doctor", description=__doc__).parse_args()
    checks: dict[str, Callable[[], bool]] = {
        "versions": report_versions,
        "devices": report_devices,
        "rendering": report_rendering,
        "physics": report_physics,
    }
    broken = []
    for name, check in checks.items():
        print(f"\n{name}", flush=True)
        try:
            healthy = check()
        except Exception as error:  # a doctor reports what it finds, whatever it is
            healthy = False
            print(f"  {type(error).__name__}: {error}")
        if not healthy:
            broken.append(name)
    print(f"\nbroken: {', '.join(broken)}" if broken else "\nall is well")
    return 1 if broken else 0


def report_versions() -> bool:
    """True if every package of the stack runs in its tested range."""
    rows = versions.check()
    print(f"  {'bipedtrack':<12}{__version__}")
    print("  " + versions.table(rows).replace("\n", "\n  "))
    try:
        versions.require()
    except versions.VersionError as error:
        print(f"  {error}")
    return all(row.ok for row in rows)


def report_devices() -> bool:
    """True if JAX finds a device; prints each with its kind, the default first."""
    import jax

    for device in jax.devices():
        print(f"  {device.platform}:{device.id}  {device.device_kind}")
    return True


def report_rendering() -> bool:
    """Always True, since only videos need it; prints whether each back end rendered a frame, or why not."""
    for name, complaint in rendering_complaints(("egl", "osmesa", "glfw")).items():
        print(f"  MUJOCO_GL={name:<8}{complaint or 'ok'}")
    return True


def rendering_complaints(names: tuple[str, ...]) -> dict[str, str]:
    """For each value of MUJOCO_GL why it cannot render a 64 x 64 frame; "" if it can.

    Each has a process of its own, because MuJoCo binds one back end per process and a missing driver may
    crash or hang it.
    """
    processes = {
        name: subprocess.Popen(
            [sys.executable, "-c", _FRAME],
            env=os.environ | {"MUJOCO_GL": name},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        for name in names
    }
    complaints = {}
    for name, process in processes.items():
        try:
            errors = process.communicate(timeout=RENDERING_TIMEOUT_S)[1].strip().splitlines()
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            complaints[name] = f"no frame after {RENDERING_TIMEOUT_S:.0f} s"
            continue
        failure = errors[-1] if errors else f"the process ended with status {process.returncode}"
        complaints[name] = textwrap.shorten(failure, 90) if process.returncode else ""
    return complaints


def report_physics() -> bool:
    """True if MJX agrees with MuJoCo C within `TOLERANCE` after `STEPS` steps of our robot."""
    import mujoco

    from bipedtrack import robot

    print(f"  compiling {STEPS} steps of MJX (some ten seconds on two cores)", flush=True)
    model = mujoco.MjModel.from_xml_path(str(robot.mjcf_path("ranger_max")))
    position, velocity = physics_difference(model, model.key("stand").id)
    print(f"  MJX against MuJoCo C after {STEPS} steps: qpos {position:.1e}, qvel {velocity:.1e}")
    print(f"  at most {TOLERANCE:.0e} is allowed")
    return position < TOLERANCE and velocity < TOLERANCE


def physics_difference(model: "mujoco.MjModel", keyframe: int) -> tuple[float, float]:
    """Largest differences of qpos [m, rad] and qvel [m/s, rad/s] between MJX and C after `STEPS` steps.

    Both start at the keyframe; its targets are moved by a fixed pattern of at most `OFFSET` rad.
    """
    import jax
    import mujoco
    import numpy as np

    with quiet_imports():
        from mujoco import mjx

    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, keyframe)
    data.ctrl += OFFSET * np.sin(1.0 + np.arange(model.nu))

    model_x = mjx.put_model(model)
    start = mjx.put_data(model, data)
    end = jax.jit(lambda d: jax.lax.fori_loop(0, STEPS, lambda _, d: mjx.step(model_x, d), d))(start)

    mujoco.mj_step(model, data, STEPS)
    return (
        float(np.abs(np.asarray(end.qpos) - data.qpos).max()),
        float(np.abs(np.asarray(end.qvel) - data.qvel).max()),
    )


if __name__ == "__main__":
    sys.exit(main())
