"""A footstep script in MuJoCo C: the numpy controller drives the robot of the MJCF, without jax.

python -m bipedtrack.simulate policy.npz walk.csv
"""

from __future__ import annotations

import dataclasses
import pathlib
from typing import Annotated, Any

import numpy as np
import tyro

from bipedtrack import falls, footsteps, kinematics, metrics, nodes, planner, policy, robot, trace
from bipedtrack.messages import Refusal, fail


def model_and_data(script: footsteps.Script, name: str) -> tuple[Any, Any]:
    """MuJoCo's model and data of a robot at the script's start, with the script's boxes in place."""
    import mujoco

    model = robot.build_model(name, [box.size for box in script.boxes], touch=True)
    # C resets itself silently on a state that is not finite; a fall must stay a fall
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    data = mujoco.MjData(model)
    data.qpos[:] = footsteps.initial_qpos(robot.load(name))
    for i, box in enumerate(script.boxes):
        data.mocap_pos[i], data.mocap_quat[i] = box.position, box.orientation
    mujoco.mj_forward(model, data)
    return model, data


def record(controller: policy.Controller, script: footsteps.Script, seconds: float | None = None) -> trace.Trace:
    """Walks the script, holds its end until `seconds` are over if they are given, and records every control step.

    The trace has no axis of robots. It ends with a fall (`falls`).
    """
    model, data = model_and_data(script, controller.policy.robot.name)
    controller.reset(data.qpos)
    rows: list[list[Any]] = []
    for command in footsteps.commands(script, model.opt.timestep, seconds):
        rows.append(control_step(controller, model, data, command))
        if not rows[-1][-1]:
            break
    return to_trace(rows)


def control_step(controller: policy.Controller, model: Any, data: Any, command: planner.Command) -> list[Any]:
    """Carries out a command for 0.005 s and gives what a trace keeps of it, by the order of its fields.

    The last one is whether the robot was up. With a state that is not finite the joint targets stay as they were.
    """
    import mujoco

    state = [data.time, data.qpos.copy(), data.qvel.copy()]
    measured = kinematics.measure(controller.policy.robot, state[1])
    alive = bool(falls.finite(data.qpos, data.qvel) & ~falls.fell(command.target, measured))
    if np.isfinite(data.qpos).all() and np.isfinite(data.qvel).all():
        data.ctrl[:] = controller.step(data.qpos, data.qvel, command)
    mujoco.mj_step(model, data)
    answer = [controller.last_feedback, data.ctrl.copy(), data.actuator_force.copy(), data.sensordata.copy()]
    return [*state, command.target, measured, command.timer, nodes.stationary(command.rates), *answer, alive]


def to_trace(rows: list[list[Any]]) -> trace.Trace:
    """The trace of control steps, at least one."""
    return trace.Trace(*(_stack(column) for column in zip(*rows, strict=True)))


def _stack(column: tuple[Any, ...]) -> Any:
    if isinstance(column[0], nodes.Nodes):
        return nodes.Nodes(*(np.array(part) for part in zip(*column, strict=True)))
    return np.array(column)


def summary(recorded: trace.Trace) -> str:
    """One line: how long, whether it fell, and the mean errors until then."""
    errors = {name: np.nanmean(values) for name, values in metrics.errors(recorded).items()}
    ankles, yaws = (np.mean([errors[f"{leg}_ankle_{what}"] for leg in robot.LEGS]) for what in ("position_cm", "yaw_deg"))
    return (
        f"{recorded.time[-1]:.1f} s, {'no fall' if recorded.alive[-1] else 'fell'}; mean error: "
        f"ankles {ankles:.1f} cm and {yaws:.1f} deg, trunk {errors['trunk_position_cm']:.1f} cm"
    )


@dataclasses.dataclass(frozen=True)
class Simulate:
    """Drives the robot through a footstep script in MuJoCo C and prints how well it tracked."""

    policy: Annotated[pathlib.Path, tyro.conf.Positional]
    """A policy file or a run directory."""
    script: Annotated[pathlib.Path, tyro.conf.Positional]
    """A footstep script, CSV."""
    seconds: float | None = None
    """How long; the script's end is held. Default: as long as the script takes."""
    feedback: bool = True
    """--no-feedback: inverse kinematics alone."""


def main() -> None:
    """The command line. Exit status 0, also after a fall; 2 for bad input."""
    options = tyro.cli(Simulate, prog="python -m bipedtrack.simulate")
    try:
        if options.seconds is not None and not 0.1 <= options.seconds < 1e5:
            raise Refusal(f"--seconds {options.seconds}: must be at least 0.1 and less than 100000")
        driven = policy.load_for_simulation(options.policy)
        script = footsteps.load(options.script, driven.robot, driven.sway)
        controller = policy.Controller(driven, options.feedback)
        recorded = record(controller, script, options.seconds)
        print(summary(recorded))
    except (Refusal, OSError) as error:
        fail(str(error))


if __name__ == "__main__":
    main()
