"""`python -m bipedtrack.train`: trains a tracking controller, from a curriculum to an exported policy."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import logging
import os
import pathlib
import shlex
import signal
import sys
import traceback
from typing import Any, Literal, NoReturn

import tyro

from bipedtrack import (
    __version__,
    checkpoint,
    compilation,
    config,
    control,
    curriculum,
    distributed,
    policy,
    robot,
    symmetry,
    versions,
)
from bipedtrack.curriculum import Curriculum
from bipedtrack.distributed import ALONE, Process
from bipedtrack.messages import Refusal, fail, quiet_imports
from bipedtrack.run_directory import RunDirectory

EVALUATION_SEED = 20240  # of the episodes in the table at the end: the same for every policy
EVALUATION_DIFFICULTY = 0.5
_ROBOTS_A_CORE = 200  # fewer do not pay for a device of their own


@dataclasses.dataclass(frozen=True)
class Train:
    """Trains a tracking controller: all stages of a curriculum, then a table and an exported policy."""

    curriculum: str = "quick"
    """A curriculum in curricula/ by its name, or a TOML file."""
    out: pathlib.Path | None = None
    """The run directory; runs/<curriculum>-<seed> when not given."""
    seed: int = 0
    """Everything random follows from it."""
    start: pathlib.Path | None = None
    """A checkpoint (or a run directory: its newest one) whose network a new run begins with, instead of a random one."""
    resume: bool = False
    """Goes on with the run in the run directory, with its own curriculum and seed."""
    device: Literal["cpu", "gpu", "auto"] = "auto"
    """Where to train; never falls back silently. auto: the best that JAX finds."""
    devices: int = 0
    """How many local devices share the robots. 0: all accelerators, or on the CPU one for each core that has work enough."""
    distributed: bool = False
    """Trains together with the other processes of this job of SLURM, Kubernetes or Open MPI."""
    coordinator: str = ""
    """HOST:PORT where the first of several processes listens; every one of them is told the same."""
    processes: int = 1
    """How many processes train together."""
    process: int = 0
    """Which of them this one is, from 0; the first one alone reads and writes the run directory."""


def main() -> None:
    """The command line. Exit status 0 when trained, 2 for bad input, 130 when interrupted (resumable)."""
    options = tyro.cli(Train, prog="python -m bipedtrack.train")
    try:
        versions.require()
        process = distributed.join(options.coordinator, options.processes, options.process, options.distributed)
    except Refusal as error:
        fail(str(error))
    if process.count == 1:
        _run_or_fail(options, process)
    else:
        _run_among_others(options, process)


def _run_or_fail(options: Train, process: Process) -> None:
    """Trains, or says in one line on stderr what was wrong and exits with status 2; 130 where it was interrupted."""
    try:
        run(options, process)
    except Refusal as error:
        fail(str(error))
    except KeyboardInterrupt:
        print(f"\nbipedtrack: interrupted; --resume goes on, from what is in {_folder(options)}", file=sys.stderr)
        sys.exit(130)


def _run_among_others(options: Train, process: Process) -> NoReturn:
    """Trains and leaves without the goodbyes of `jax.distributed`, which would wait for processes that wait or are lost."""
    from jax.errors import JaxRuntimeError

    try:
        _run_or_fail(options, process)
        status = 0
    except SystemExit as left:
        status = left.code if isinstance(left.code, int) else 1
    except JaxRuntimeError as error:
        reason = (str(error) or "no reason given").splitlines()[0]
        print(
            f"bipedtrack: {process}: the training cannot go on without the others ({reason}); what is saved goes on with "
            "--resume in all processes",
            file=sys.stderr,
        )
        status = 1
    except BaseException:
        traceback.print_exc()
        status = 1
    distributed.leave(status)


class DeviceError(Refusal, RuntimeError):
    """The wanted device is not there; the message is one line."""


def use_devices(device: str, count: int, ppo: curriculum.PpoConfig, process: Process = ALONE) -> tuple[int, str]:
    """Makes JAX use local devices; returns how many of each process share the robots, and their description.

    device: cpu, gpu or auto; count: as `Train.devices`. A CPU counts as one device for each of its cores that gets a few
    hundred robots: XLA runs much of a step on one thread, so that two devices on two cores are faster than one on both.
    Raises DeviceError where they are missing, ConfigError where the robots cannot be shared out evenly.
    """
    import jax

    logging.getLogger("jax._src.xla_bridge").setLevel(logging.CRITICAL)
    if device != "auto":
        jax.config.update("jax_platforms", {"cpu": "cpu", "gpu": "cuda"}[device])
    jax.config.update("jax_num_cpu_devices", count or _cores_with_work(ppo, process.count))
    try:
        found = jax.local_devices()
    except (RuntimeError, AssertionError) as error:  # an assertion where JAX has no build for the platform at all
        reason = (str(error) or "no such back end").splitlines()[0]
        raise DeviceError(
            f"--device {device}: JAX finds no such device ({reason}); use --device cpu, or "
            "`pip install '.[cuda]'` on a machine with an NVIDIA GPU"
        ) from None
    count = count or len(found)
    if count > len(found):
        raise DeviceError(f"--devices {count}: there are {len(found)} of kind {found[0].device_kind}")
    if count < len(found) and process.count > 1:
        raise DeviceError(f"--devices {count}: each of several processes uses all of its devices, here {len(found)}")
    if not ppo.shares_out(count * process.count):
        processes = f" of {process.count} processes" if process.count > 1 else ""
        raise config.ConfigError(
            f"--devices {count}{processes}: num_envs ({ppo.num_envs}) must be a multiple of all devices times "
            f"num_minibatches ({ppo.num_minibatches})"
        )
    processes = f" in each of {process.count} processes" if process.count > 1 else ""
    return count, f"{count} x {found[0].device_kind}{processes}"


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1  # macOS has none


def _cores_with_work(ppo: curriculum.PpoConfig, processes: int) -> int:
    """The greatest number of cores that share the robots evenly with at least _ROBOTS_A_CORE each; at least 1."""
    most = min(cores(), ppo.num_envs // processes // _ROBOTS_A_CORE)
    return next((count for count in range(most, 1, -1) if ppo.shares_out(count * processes)), 1)


def run(options: Train, process: Process) -> None:
    """Trains, exports and shows the table; or trains along, where the process is not the first one."""
    if process.count == 1:  # JAX keeps the first process's programs alone; the others would compile while it waits in vain
        compilation.use_cache()
    job = Job(**distributed.from_first("job", lambda: dataclasses.asdict(_job(options)), process))
    plan = job.plan
    devices, description = use_devices(options.device, job.devices, plan.ppo, process)
    distributed.require_same("devices", devices, process)
    job = dataclasses.replace(job, devices=devices)
    with contextlib.ExitStack() as stack:
        opened: list[RunDirectory] = []

        def open_directory() -> None:
            opened.append(_directory(options, job, process))
            stack.callback(opened[0].close)

        distributed.from_first("run directory", open_directory, process)
        if process.first:
            _train(opened[0], job, description, process)
        else:
            _train_along(job, process)


@dataclasses.dataclass(frozen=True)
class Job:
    """What all processes need to know of a training."""

    curriculum: dict[str, Any]
    seed: int
    devices: int  # of each process

    @property
    def plan(self) -> Curriculum:
        """The curriculum."""
        return config.from_dict(Curriculum, self.curriculum, "the first process")


def _job(options: Train) -> Job:
    """The training to begin or to go on with, with as many devices as are wished for."""
    if not 0 <= options.seed < 2**63:
        raise config.ConfigError(f"--seed {options.seed}: must lie in [0, 2^63)")
    if options.devices < 0:
        raise config.ConfigError(f"--devices {options.devices}: must not be negative")
    if options.resume:
        if options.start is not None:
            raise config.ConfigError("--resume goes on from the run's own checkpoints; leave out --start")
        with contextlib.closing(RunDirectory.open(_folder(options))) as directory:
            plan, seed, devices = curriculum.of_run(directory)
        _check(plan)
        return Job(config.to_dict(plan), seed, options.devices or devices)
    plan = curriculum.load(options.curriculum)
    _check(plan)
    return Job(config.to_dict(plan), options.seed, options.devices)


def _check(plan: Curriculum) -> None:
    """Raises ConfigError where the robot or the scripts do not fit the curriculum, rather than in its last hour."""
    the_robot = robot.load(plan.robot)
    try:
        control.substeps(plan.policy_period, the_robot.timestep)
    except ValueError as error:
        raise config.ConfigError(str(error)) from None
    if plan.network.symmetric and not symmetry.is_symmetric(the_robot):
        raise config.ConfigError(f"network.symmetric: robot {plan.robot!r} is not its own mirror image; wanted false")
    for stage in plan.stages:
        curriculum.scripts_of(plan, stage, the_robot)


def _folder(options: Train) -> pathlib.Path:
    return options.out or pathlib.Path("runs") / f"{pathlib.Path(options.curriculum).stem}-{options.seed}"


def _directory(options: Train, job: Job, process: Process) -> RunDirectory:
    """The run directory, created where the run is a new one."""
    if options.resume:
        return RunDirectory.open(_folder(options))
    settings = dataclasses.asdict(job) | _circumstances(process)
    start = None if options.start is None else _start(options.start, job.plan)
    return RunDirectory.create(_folder(options), settings, start)


def _start(path: pathlib.Path, plan: Curriculum) -> checkpoint.Checkpoint:
    """The checkpoint to begin with. Raises CheckpointError where it is none or does not fit the curriculum's networks."""
    with quiet_imports():
        from bipedtrack import networks

    found = RunDirectory(path).latest() if path.is_dir() else checkpoint.load_checkpoint(path)
    if found is None:
        raise checkpoint.CheckpointError(f"--start {path}: has no checkpoint; wanted one, or a run with a finished PPO call")
    try:
        networks.from_arrays(plan, found.arrays)
    except checkpoint.CheckpointError as error:
        raise checkpoint.CheckpointError(f"--start {path}: {error}") from None
    network = plan.network
    for name, wanted in {"robot": plan.robot, "activation": network.activation, "symmetric": network.symmetric}.items():
        trained = found.provenance.get(name, wanted)  # older checkpoints do not say
        if trained != wanted:
            raise checkpoint.CheckpointError(
                f"--start {path}: was trained with {name} = {json.dumps(trained)}; the curriculum has {json.dumps(wanted)}"
            )
    return found


def _train_along(job: Job, process: Process) -> None:
    """Trains as one of several processes, without a run directory."""
    with quiet_imports():
        from bipedtrack import training
    from bipedtrack.progress import Aside

    training.train(job.plan, None, job.seed, job.devices, Aside(), lambda: False, process)


def _circumstances(process: Process) -> dict[str, Any]:
    """What besides curriculum, seed and number of devices decides the last bits of a training; devices must be chosen."""
    import jax

    kind = jax.local_devices()[0].device_kind
    found = {"bipedtrack": __version__, **{row.name: row.found for row in versions.check()}}
    return {"device": kind, "processes": process.count, "versions": found}


def _changes(began: dict[str, Any], job: Job, process: Process) -> list[str]:
    """What is not as the run began with it, in words; the parameters will be others than without the change."""
    now = {"devices": job.devices, **_circumstances(process)}
    began = {"devices": 1, **began}  # as `curriculum.of_run` has it
    found = [(name, began.get(name, now[name]), now[name]) for name in ("device", "devices", "processes")]
    before = began.get("versions", now["versions"])
    found += [(name, before.get(name, version), version) for name, version in now["versions"].items()]
    return [f"the run began with {name} {old}, and goes on with {new}" for name, old, new in found if old != new]


def _train(directory: RunDirectory, job: Job, description: str, process: Process) -> None:
    import rich.console

    with quiet_imports():
        from bipedtrack import training
    from bipedtrack.progress import Progress

    stop = _stop_on_signals()
    plan, seed = job.plan, job.seed
    calls = curriculum.calls(plan)
    found = directory.latest()
    finished = 0 if found is None else found.call + 1
    done = f"{finished} calls are done" if finished else "begins with another run's network"
    with Progress(directory.path, plan, calls, sum(call.steps for call in calls[:finished])) as progress:
        for warning in [*directory.warnings, *_changes(directory.settings, job, process)]:
            progress.say(f"warning: {warning}")
        progress.say(
            f"{plan.name}, seed {seed}, on {description}: {len(plan.stages)} stages, {len(calls)} PPO calls, "
            f"{sum(call.steps for call in calls) / 1e6:.1f} M policy steps, in {directory.path}"
            + ("" if found is None else f"; {done}")
        )
        try:
            training.train(plan, directory, seed, job.devices, progress, stop, process)
        except training.Stopped:
            saved = directory.latest()
            progress.say(
                f"stopped; {0 if saved is None else saved.call + 1} of {len(calls)} calls are saved. Go on with:\n"
                f"  python -m bipedtrack.train --resume --out {shlex.quote(str(directory.path))}"
                + (f", in all {process.count} processes as before" if process.count > 1 else "")
            )
            sys.exit(130)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    path = directory.path / "policy.npz"
    trained = training.newest_policy(directory)
    policy.save(trained, path)
    console = rich.console.Console()
    if plan.evaluation_episodes:
        _show_table(directory, plan, trained, console)
    console.print(f"policy: {path}", highlight=False, markup=False, soft_wrap=True)


def _show_table(directory: RunDirectory, plan: curriculum.Curriculum, trained: Any, console: Any) -> None:
    """Evaluates inverse kinematics alone and the trained policy, prints the table and writes table.json.

    Both are told to sway as the policy's file says.
    """
    from bipedtrack import evaluation

    plan = dataclasses.replace(plan, ranges=plan.ranges.swaying(trained.sway))
    difficulty = EVALUATION_DIFFICULTY
    rows: dict[str, list[evaluation.Row]] = {}
    for name, controller in (("IK alone", None), ("trained", trained)):
        console.print(f"evaluating {name} (compiling takes about half a minute)", highlight=False)
        rows[name] = evaluation.by_kind(plan, controller, difficulty, plan.evaluation_episodes, EVALUATION_SEED)
    console.print(evaluation.comparison(plan, difficulty, rows))
    for name in rows:
        flat = evaluation.level_ground(rows[name])
        if flat is not None:
            console.print(
                f"level ground, {name}: {100 * flat.survival:.0f} % without a fall, lasts {flat.seconds:.1f} s, "
                f"ankles {flat.ankle_error_cm:.1f} cm",
                highlight=False,
            )
    record = {name: [dataclasses.asdict(row) for row in table] for name, table in rows.items()}
    checkpoint.write_json(directory.path / "table.json", {"difficulty": difficulty, "seed": EVALUATION_SEED, **record})


def _stop_on_signals() -> Any:
    """A function that tells whether SIGINT or SIGTERM came; a second one of them ends the program at once."""
    asked: list[int] = []

    def ask(number: int, frame: Any) -> None:
        asked.append(number)
        signal.signal(number, signal.SIG_DFL)
        if sys.stdout.isatty():
            print("\x1b[?25h", end="", flush=True)  # the cursor, which the live display hides, should a second one come
        print("\nstopping after the present updates; the last finished call is saved", file=sys.stderr)

    signal.signal(signal.SIGINT, ask)
    signal.signal(signal.SIGTERM, ask)
    return lambda: bool(asked)


if __name__ == "__main__":
    main()
