"""A footstep script in MuJoCo C: the numpy controller drives the robot of the MJCF, without jax.

python -m bipedtrack.simulate policy.npz walk.csv --picture walk.png
"""

from __future__ import annotations

import dataclasses
import pathlib
from typing import Annotated, Any, NamedTuple

import numpy as np
import tyro

from bipedtrack import footsteps, kinematics, nodes, policy, robot
from bipedtrack.messages import fail


class Trace(NamedTuple):
    """What happened, an entry a control step; the errors compare command and robot at the same instant."""

    time: np.ndarray  # (n,) s
    qpos: np.ndarray  # (n, 19)
    ankle_error: np.ndarray  # (n, 2) m, left and right
    yaw_error: np.ndarray  # (n, 2) rad
    trunk_error: np.ndarray  # (n,) m
    fell: bool  # tilted by more than 60 deg or not finite, where the trace then ends


def model_and_data(script: footsteps.Script, name: str = "ranger_max") -> tuple[Any, Any]:
    """MuJoCo's model and data of a robot at the script's start, with the script's boxes in place."""
    import mujoco

    model = robot.build_model(name, [box.size for box in script.boxes])
    # C resets itself silently on a state that is not finite; a fall must stay a fall
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    data = mujoco.MjData(model)
    data.qpos[:] = footsteps.initial_qpos(robot.load(name))
    for i, box in enumerate(script.boxes):
        data.mocap_pos[i], data.mocap_quat[i] = box.position, box.orientation
    mujoco.mj_forward(model, data)
    return model, data


def run(controller: policy.Controller, script: footsteps.Script, seconds: float | None = None) -> Trace:
    """Walks the script, and holds its end until `seconds` are over if they are given."""
    import mujoco

    model, data = model_and_data(script)
    controller.reset(data.qpos)
    rows: list[tuple[float, np.ndarray, np.ndarray, np.ndarray, float]] = []
    fell = False
    for command in footsteps.commands(script, model.opt.timestep, seconds):
        errors = nodes.difference(command.target, kinematics.measure(controller.policy.robot, data.qpos))
        ankles, trunk = np.linalg.norm(errors.ankle_positions, axis=-1), float(np.linalg.norm(errors.trunk_position))
        rows.append((data.time, data.qpos.copy(), ankles, np.abs(errors.ankle_yaws), trunk))
        data.ctrl[:] = controller.step(data.qpos, data.qvel, command)
        mujoco.mj_step(model, data)
        upright = data.qpos[3] ** 2 - data.qpos[4] ** 2 - data.qpos[5] ** 2 + data.qpos[6] ** 2
        if not upright > 0.5:  # cos 60 deg; false for nan
            fell = True
            break
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    return Trace(columns[0], columns[1], columns[2], columns[3], columns[4], fell)


def picture(trace: Trace, script: footsteps.Script, path: pathlib.Path, frames: int = 6, height: int = 360) -> None:
    """Writes a strip of `frames` evenly spaced pictures of a trace as PNG. Raises RuntimeError without OpenGL."""
    import mujoco
    from PIL import Image

    model, data = model_and_data(script)
    width = round(0.62 * height)
    camera = mujoco.MjvCamera()
    camera.distance, camera.azimuth, camera.elevation = 2.1, 128, -14
    options = mujoco.MjvOption()
    options.geomgroup[3] = 0  # shapes that only collide
    pictures = []
    with mujoco.Renderer(model, height, width) as renderer:
        for i in np.linspace(0, len(trace.time) - 1, frames).astype(int):
            data.qpos[:] = trace.qpos[i]
            mujoco.mj_forward(model, data)
            camera.lookat[:] = [data.qpos[0], data.qpos[1], data.qpos[2] - 0.24]
            renderer.update_scene(data, camera, options)
            pictures.append(renderer.render())
    Image.fromarray(np.concatenate(pictures, axis=1)).save(path)


def summary(trace: Trace, skip: float = 0.0) -> str:
    """One line: how long, whether it fell, and the mean errors after the first `skip` seconds."""
    late = trace.time >= min(skip, trace.time[-1])
    return (
        f"{trace.time[-1]:.1f} s, {'fell' if trace.fell else 'no fall'}; mean error: "
        f"ankles {100 * trace.ankle_error[late].mean():.1f} cm and {np.degrees(trace.yaw_error[late].mean()):.1f} deg, "
        f"trunk {100 * trace.trunk_error[late].mean():.1f} cm"
    )


@dataclasses.dataclass(frozen=True)
class Simulate:
    """Drives the robot through a footstep script in MuJoCo C and prints how well it tracked."""

    policy: Annotated[pathlib.Path, tyro.conf.Positional]
    """A policy file."""
    script: Annotated[pathlib.Path, tyro.conf.Positional]
    """A footstep script, CSV."""
    seconds: float | None = None
    """How long; the script's end is held. Default: as long as the script takes."""
    feedback: bool = True
    """--no-feedback: inverse kinematics alone."""
    picture: pathlib.Path | None = None
    """A PNG to write: a strip of pictures (needs OpenGL, for example MUJOCO_GL=egl)."""


def main() -> None:
    """The command line. Exit status 0, also after a fall; 2 for bad input."""
    options = tyro.cli(Simulate, prog="python -m bipedtrack.simulate")
    try:
        if options.seconds is not None and not 0 < options.seconds < 1e5:
            raise ValueError(f"--seconds {options.seconds}: must be positive and less than 100000")
        the_robot = robot.load()
        controller = policy.Controller(policy.load(options.policy, the_robot), options.feedback)
        script = footsteps.load(options.script, the_robot)
        trace = run(controller, script, options.seconds)
        print(summary(trace))
        if options.picture is not None:
            picture(trace, script, options.picture)
            print(options.picture)
    except (ValueError, RuntimeError, OSError) as error:
        fail(str(error))
    # every refusal of ours is a ValueError or RuntimeError: CheckpointError, PolicyError, ScriptError, RobotError


if __name__ == "__main__":
    main()
