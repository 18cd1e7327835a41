"""`python -m bipedtrack.evaluate POLICY`: tracking error of every step, for any policy, on two simulators."""

from __future__ import annotations

import dataclasses
import pathlib
import signal
import sys
import time
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro

from bipedtrack import (
    checkpoint,
    config,
    control,
    disturbances,
    footsteps,
    metrics,
    policy,
    robot,
    sampling,
    scripts,
    statics,
    terrain,
    trace,
    versions,
)
from bipedtrack.disturbances import LADDERS, UNDISTURBED, Hooks
from bipedtrack.messages import Refusal, fail, quiet_imports
from bipedtrack.record import labels_of
from bipedtrack.swings import Boxes

if TYPE_CHECKING:
    from bipedtrack import suite

SEED = 2024
ENGINES = ("mjx", "mujoco", "converged")
_AFTER_PUSH = 3.0  # s in which a robot that was pushed falls, if it does
_TRACES = 2  # episodes of each task whose traces are written


@dataclasses.dataclass(frozen=True)
class Evaluate:
    """Evaluates policies on the tasks of the suite or on a footstep script: table, metrics.json, report.html, traces."""

    policies: Annotated[tuple[str, ...], tyro.conf.Positional]
    """Policy files or run directories; `ik`: inverse kinematics, filter and PD of ranger_max alone (a policy without its
    network is `--feedback-ratio 0`); `zero`: joint targets stay where they were at first."""
    tasks: tuple[str, ...] = ()
    """Tasks of the suite; all when not given."""
    script: pathlib.Path | None = None
    """A footstep script instead of the tasks."""
    episodes: int = 256
    """Of each random task; a script is the same every time and run once."""
    seconds: float = 10.0
    """Of each episode, or at least of the hold at its end (the sooner it begins the longer it is); long holds last 60 s or
    more, scripts as long as they take."""
    engine: Literal["mjx", "mujoco", "converged", "both"] = "both"
    """mujoco is MuJoCo C, with the MJCF's solver and, as a further column, a converged one; converged is that alone."""
    sway: float | None = None
    """How much the commanded trunk sways over the stance foot: 0: it moves uniformly, 1: as a linear inverted pendulum.
    Default: as the policies learned it; 0 for `ik` and `zero` alone."""
    seed: int = SEED
    """Decides the episodes, together with the task's name."""
    out: pathlib.Path = pathlib.Path("evaluation")
    """Where metrics.json, report.html and traces/ go."""
    robustness: bool = False
    """Also walking forward with pushes, payload, friction, motors, delay, noise and masses: at most 64 episodes a level, in
    MuJoCo C with the MJCF's solver."""
    feedback_ratio: float | None = None
    """Another k_b for every joint."""
    filter: float | None = None
    """Another filter coefficient of eq (7)."""
    velocity_feedforward: bool | None = None
    """With or without (kd/kp) dq/dt."""
    gravity_feedforward: bool | None = None
    """With or without the static torques of the commanded posture, over kp."""
    integral: float | None = None
    """Another gain of the joints' integral at rest, 1/s; 0: none."""
    feedforward: bool = True
    """--no-feedforward: the feedforward stays at the first command's; an integral aims at the present one still."""


@dataclasses.dataclass(frozen=True)
class Subject:
    """Something to evaluate."""

    name: str
    robot: robot.Robot
    settings: control.ControlConfig
    policy_period: float  # s
    actor: policy.Policy | None  # None: no feedback
    feedforward: bool

    @property
    def provenance(self) -> dict[str, Any]:
        """Where the policy comes from; empty where there is none."""
        return {} if self.actor is None else self.actor.provenance

    def act(self, observation: Any) -> Any:
        """The network's output, (12,), for an observation, (101,)."""
        if self.actor is None:
            return 0 * observation[:12]
        return self.actor.output(observation)


def subject(name: str, options: Evaluate) -> Subject:
    """What a policy argument names, with the options' ablations. Raises in one line where there is no such policy."""
    if name in ("ik", "zero"):
        the_robot, settings, period = robot.load(), control.ControlConfig(level_feet=True), 0.02
        actor = None
    else:
        actor = policy.load_for_simulation(name)
        the_robot, settings, period = actor.robot, actor.settings, actor.policy_period
    asked = {name: getattr(options, name) for name in ("filter", "velocity_feedforward", "gravity_feedforward", "integral")}
    try:
        settings = dataclasses.replace(settings, **{name: value for name, value in asked.items() if value is not None})
    except ValueError as error:
        raise config.ConfigError(str(error)) from None
    if options.feedback_ratio is not None:
        ratio = np.full_like(the_robot.feedback_ratio, options.feedback_ratio)
        the_robot = dataclasses.replace(the_robot, feedback_ratio=ratio)
    feedforward = options.feedforward and name != "zero"
    return Subject(name, the_robot, settings, period, actor, feedforward)


class Engines:
    """The recorders of one subject, each compiled once."""

    def __init__(self, who: Subject, engine: str):
        """engine: as Evaluate.engine."""
        with quiet_imports():
            from bipedtrack import recording

        self._who = who
        self.names = {"both": ENGINES, "mujoco": ("mujoco", "converged")}.get(engine, (engine,))
        controls = recording.Controls(who.robot, who.settings, who.policy_period, who.act, who.feedforward)
        self._mujoco = recording.mujoco_recorder(controls)
        self._mjx: dict[Any, Any] = {}

    def record(self, name: str, batch: suite.Batch, seconds: float, hooks: Hooks = UNDISTURBED) -> trace.Trace:
        """The trace of a batch in one engine."""
        if name != "mjx":
            return self._mujoco(batch.plan, batch.sizes, seconds, name == "converged", hooks)
        if batch.sizes not in self._mjx:
            self._mjx[batch.sizes] = self._compile(batch)
        return self._mjx[batch.sizes](batch.plan, seconds)

    def _compile(self, batch: suite.Batch) -> Any:
        import jax

        from bipedtrack import env, plans, recording, rewards

        settings = env.EnvConfig(rewards.RewardConfig(), self._who.settings, self._who.policy_period)
        first = jax.tree.map(lambda leaf: leaf[0], batch.plan)
        of_kind = env.TrackingEnv if self._who.feedforward else recording.FirstCommandEnv
        the_env = of_kind(self._who.robot, settings, first, plans.PLANNED, batch.sizes, touch=True)
        return recording.mjx_recorder(the_env, self._who.act)


def boxes_of(batch: suite.Batch) -> Boxes | None:
    """The boxes of a batch for the clearance; None where nothing stands on the ground."""
    if not batch.sizes:
        return None
    # a window of three treads holds every tread once if looked at every third task step
    stairs = len({tuple(pose) for pose in np.asarray(batch.plan.boxes[0]).reshape(-1, 7)}) > len(batch.sizes)
    poses = np.asarray(batch.plan.boxes)[:, 1::3] if stairs else np.asarray(batch.plan.boxes)[:, :1]
    count = poses.shape[1]
    poses = poses.reshape(len(poses), -1, 7)
    if (poses[..., 2] < terrain.PARKED / 2).all():
        return None  # the task has level ground; its boxes wait below
    half = np.broadcast_to(np.tile(np.array(batch.sizes) / 2, (count, 1)), (len(poses), poses.shape[1], 3))
    return Boxes(poses[..., :3], half, 2 * np.arctan2(poses[..., 6], poses[..., 3]))


def run(options: Evaluate) -> dict[str, Any]:
    """Evaluates everything asked for and returns what metrics.json and the curves of the report hold.

    Both are written to `out` after every task, so that whoever stops it keeps what is done.
    """
    who = [subject(name, options) for name in options.policies]
    options = dataclasses.replace(options, sway=_sway(who, options))
    wanted = _tasks(options, who[0].robot)
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "traces").mkdir(exist_ok=True)
    record: dict[str, Any] = {
        "options": {k: str(v) if isinstance(v, pathlib.Path) else v for k, v in dataclasses.asdict(options).items()},
        "versions": {row.name: row.found for row in versions.check()},
        "policies": {one.name: one.provenance for one in who},
        "tasks": {},
    }
    labels = labels_of(record)
    for number, one in enumerate(who):
        engines = Engines(one, options.engine)
        weight = float(statics.GRAVITY * robot.build_model(one.robot.name).body_mass.sum())
        stem = f"{number}-{pathlib.Path(one.name).stem}"  # two policies may have the same file name
        for name in wanted:
            batch, seconds = batch_of(name, options, one.robot)
            boxes = boxes_of(batch)
            entry = record["tasks"].setdefault(name, {"ranges": batch.ranges, "seconds": seconds, "policies": {}})
            entry["boxes"] = [] if boxes is None else _boxes_of_first(boxes)
            results = entry["policies"].setdefault(one.name, {})
            for engine in engines.names:
                began = time.monotonic()
                recorded = engines.record(engine, batch, seconds)
                summary = metrics.summarise(recorded, one.robot, weight, boxes)
                course = metrics.time_course(recorded)
                results[engine] = {"summary": _rounded(summary), "course": {k: _thin(v) for k, v in course.items()}}
                results[engine]["path"] = _path(recorded.episode(0))
                results[engine]["levels"] = [_level(level, recorded) for level in batch.levels]
                kept = _TRACES if engine != "converged" or len(engines.names) == 1 else 0
                results[engine]["traces"] = []
                for episode in range(min(kept, len(recorded.alive))):
                    file = f"{stem}-{engine}-{name}-{episode}.npz"
                    trace.save(recorded.episode(episode), options.out / "traces" / file)
                    results[engine]["traces"].append(file)
                print(f"{line(labels[one.name], name, engine, summary)}  ({time.monotonic() - began:.0f} s)", flush=True)
            _write(record, options.out)
        if options.robustness:
            found = _robustness(engines, one, options, weight, labels[one.name])
            record.setdefault("robustness", {})[one.name] = found
            _write(record, options.out)
    return record


def _write(record: dict[str, Any], out: pathlib.Path) -> None:
    """metrics.json and report.html, with the verdicts about what has been evaluated so far."""
    from bipedtrack import report, verdicts

    record["verdicts"] = verdicts.verdicts(record)
    checkpoint.write_json(out / "metrics.json", _without_curves(record))
    checkpoint.write_text(out / "report.html", report.page(record))


def _tasks(options: Evaluate, the_robot: robot.Robot) -> tuple[str, ...]:
    """The names of the tasks. Raises ConfigError for an unknown one and footsteps.ScriptError for a bad script."""
    from bipedtrack import suite

    if options.script is not None:
        footsteps.load(options.script, the_robot, _ranges(options).usual_sway)  # refused before anything is written
        return (f"script-{options.script.stem}",)  # as no task of the suite is called, and no hold
    wanted = options.tasks or suite.TASKS
    for name in wanted:
        if name not in suite.TASKS:
            raise config.ConfigError(f"--tasks {name}: no such task; there are: {', '.join(suite.TASKS)}")
        if name not in suite.SCRIPTS:
            suite.duration(name, sampling.Ranges(), options.seconds)
    return wanted


def batch_of(name: str, options: Evaluate, the_robot: robot.Robot) -> tuple[suite.Batch, float]:
    """The episodes of a task, or of the options' script, and how long they last, s."""
    from bipedtrack import suite

    if options.script is not None or name in suite.SCRIPTS:
        path = options.script or scripts.ready()[name]
        script = footsteps.load(path, the_robot, _ranges(options).usual_sway)
        # a script is the same every time: more episodes would tell nothing
        return suite.script_batch(script, 1), footsteps.duration(script)
    seconds = suite.duration(name, sampling.Ranges(), options.seconds)
    return suite.batch(name, _ranges(options), the_robot, options.episodes, seconds, options.seed), seconds


def _sway(who: list[Subject], options: Evaluate) -> float:
    """How much all trunks sway. Raises ConfigError where the policies know different ones and none is asked for."""
    if options.sway is not None:
        return options.sway
    known = {one.actor.sway: one.name for one in who if one.actor is not None}
    if len(known) > 1:
        each = ", ".join(f"{name} with --sway {sway:g}" for sway, name in known.items())
        raise config.ConfigError(f"the policies learned different trunks ({each}); wanted one --sway for all of them")
    return next(iter(known), footsteps.SWAY)


def _ranges(options: Evaluate) -> sampling.Ranges:
    """Table II's, with the trunk that is asked for."""
    return sampling.Ranges() if options.sway is None else sampling.Ranges().swaying(options.sway)


def _level(level: suite.Level, recorded: trace.Trace) -> dict[str, Any]:
    """How the episodes of one difficulty went."""
    outline = metrics.outline(recorded.episode(level.episodes))
    outline["errors"] = {name: {k: of[k] for k in ("mean", "p95")} for name, of in outline["errors"].items()}
    return {"label": level.label, **_rounded(outline)}


def _rounded(tree: Any) -> Any:
    """The same with every float to five digits: more would tell nothing."""
    if isinstance(tree, dict):
        return {key: _rounded(value) for key, value in tree.items()}
    return float(f"{tree:.5g}") if isinstance(tree, float) else tree


def _every(count: int) -> slice:
    """Which of so many values make a curve of about 200 points: every tenth of 10 s."""
    return slice(None, None, max(10, count // 200))


def _thin(values: np.ndarray) -> list[float | None]:
    """The values of a curve, to four digits."""
    return [None if not np.isfinite(v) else round(float(v), 4) for v in values[_every(len(values))]]


def _boxes_of_first(boxes: Boxes) -> list[list[float]]:
    """The first episode's boxes: x, y, z of the centre, length, width, height, m, and yaw, rad."""
    return np.column_stack([boxes.centres[0], 2 * boxes.half_sizes[0], boxes.yaws[0]]).round(4).tolist()


def _path(recorded: trace.Trace) -> dict[str, Any]:
    """Where the nodes of one episode were meant to be and were, until its fall: x, y, z in m, as curves."""
    up = int(recorded.alive.sum())
    found: dict[str, Any] = {"time_s": _thin(recorded.time[:up])}
    for side, state in (("target", recorded.target), ("measured", recorded.measured)):
        points = {"trunk": state.trunk_position, **{leg: state.ankle_positions[:, i] for i, leg in enumerate(robot.LEGS)}}
        found[side] = {node: np.round(at[:up][_every(up)], 4).tolist() for node, at in points.items()}
    return found


def _robustness(engines: Engines, who: Subject, options: Evaluate, weight: float, label: str) -> dict[str, Any]:
    """Survival and ankle error while walking forward, over the levels of every disturbance."""
    from bipedtrack import suite

    episodes = min(options.episodes, 64)
    batch = suite.batch("walk-forward", _ranges(options), who.robot, episodes, options.seconds, options.seed)
    found: dict[str, Any] = {}
    for name, ladder in LADDERS.items():
        rows = []
        for level in ladder.levels:
            recorded = engines.record("mujoco", batch, options.seconds, ladder.hooks(level, who.robot.timestep))
            summary = metrics.summarise(recorded, who.robot, weight)
            rows.append({"level": level, "survival": summary["survival"], "errors": summary["errors"]})
            print(
                f"{label:<10} {name} {level:g} {ladder.unit}: {100 * summary['survival']['share']:.0f} % without a fall",
                flush=True,
            )
        found[name] = {"unit": ladder.unit, "levels": rows, "episodes": episodes, "task": "walk-forward"}
    return found


def line(who: str, task: str, engine: str, summary: dict[str, Any]) -> str:
    """One line of the table: survival, ankle and trunk errors, foothold error. who: the policy's label."""
    errors, touchdown = summary["errors"], summary["touchdown"]
    ankles = [errors[f"{leg}_ankle_position_cm"]["mean"] for leg in robot.LEGS]
    yaws = [errors[f"{leg}_ankle_yaw_deg"]["mean"] for leg in robot.LEGS]
    worst = max(errors[f"{leg}_ankle_position_cm"]["p95"] for leg in robot.LEGS)
    foothold = touchdown["foothold_cm"]["mean"]
    return (
        f"{who:<10} {task:<20} {engine:<9} {100 * summary['survival']['share']:5.1f} % up"
        f"  ankles {np.mean(ankles):5.2f} cm (95 %: {worst:5.1f}) {np.mean(yaws):5.2f} deg"
        f"  trunk {errors['trunk_position_cm']['mean']:5.1f} cm {errors['trunk_orientation_deg']['mean']:5.1f} deg"
        + (f"  foothold {foothold:4.1f} cm" if foothold is not None else "")
    )


def _without_curves(tree: Any) -> Any:
    """The figures of a record alone: curves stand in the report, and in full in the traces."""
    if not isinstance(tree, dict):
        return tree
    return {key: _without_curves(value) for key, value in tree.items() if key not in ("course", "path")}


def main() -> None:
    """The command line. Exit status 0 when evaluated, 2 for bad input, 130 when interrupted."""
    options = tyro.cli(Evaluate, prog="python -m bipedtrack.evaluate")
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs would ignore Ctrl-C's signal
    try:
        versions.require()
        _check(options)
        run(options)
        print(options.out / "report.html")
    except (Refusal, OSError) as error:
        fail(str(error))
    except KeyboardInterrupt:
        print(f"\nbipedtrack: stopped; {options.out} holds the tasks that are done", file=sys.stderr)
        sys.exit(130)


def _check(options: Evaluate) -> None:
    """Raises ConfigError for options that cannot be."""
    if not options.policies:
        raise config.ConfigError("name at least one policy: a policy.npz, a run directory, ik or zero")
    if options.episodes < 1:
        raise config.ConfigError(f"--episodes {options.episodes}: must be at least 1")
    if options.script is not None and options.tasks:
        raise config.ConfigError("--script and --tasks: wanted one of them, a script takes the place of the tasks")
    if not 0 <= options.seed < 2**63:
        raise config.ConfigError(f"--seed {options.seed}: must lie in [0, 2^63)")
    if options.sway is not None and not 0 <= options.sway <= 1:
        raise config.ConfigError(f"--sway {options.sway}: must lie in [0, 1]")
    if not 0.1 <= options.seconds <= 600:
        raise config.ConfigError(f"--seconds {options.seconds}: must lie in [0.1, 600]")
    least = disturbances.PUSH_AT + _AFTER_PUSH
    if options.robustness and options.seconds < least:
        raise config.ConfigError(f"--seconds {options.seconds}: --robustness needs at least {least:g}, for the pushes")
    if options.feedback_ratio is not None and not 0 <= options.feedback_ratio <= 2:
        raise config.ConfigError(f"--feedback-ratio {options.feedback_ratio}: must lie in [0, 2]")


if __name__ == "__main__":
    main()
