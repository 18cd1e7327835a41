"""Films of the robot at a task or on its way through a footstep script, made of `pictures`.

python -m bipedtrack.video policy.npz --script walk.csv --out walk.mp4
python -m bipedtrack.video policy.npz --task stairs-up --out stairs.mp4

Everything is rendered without a screen. The suffix decides: .mp4 (H.264) and .gif are films, .png is a strip of pictures.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import os
import pathlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from typing import Annotated, Any

import numpy as np
import tyro

from bipedtrack import checkpoint, doctor, footsteps, policy, robot, simulate
from bipedtrack.messages import Refusal, fail
from bipedtrack.pictures import COLORS, render
from bipedtrack.trace import Trace

SUFFIXES = (".mp4", ".gif", ".png")


class VideoError(Refusal, RuntimeError):
    """A film that cannot be made or written; the message is one line."""


def choose_backend() -> str:
    """Sets MUJOCO_GL to a back end that renders on this machine and returns it; call it before anything imports mujoco.

    A MUJOCO_GL that is set is kept. Otherwise it becomes egl or osmesa, or glfw where there is a display; on systems other
    than Linux MuJoCo knows but one. Each is tried in a process of its own, which takes about a second.

    Raises:
      VideoError: none of them renders, or mujoco is imported already, so that the choice would come too late.
    """
    if "mujoco" in sys.modules:
        raise VideoError("mujoco is imported already; wanted the back end chosen before, or MUJOCO_GL in the environment")
    asked = os.environ.get("MUJOCO_GL")
    names: list[str] = [asked or ""]
    if not asked and sys.platform == "linux":
        names = ["egl", "osmesa", *(["glfw"] if os.environ.get("DISPLAY") else [])]
    complaints: dict[str, str] = {}
    for name in names:
        complaints |= doctor.rendering_complaints((name,))
        if not complaints[name]:
            os.environ["MUJOCO_GL"] = name
            return name
    reasons = "; ".join(f"MUJOCO_GL={name}: {complaint}" for name, complaint in complaints.items())
    right = "another MUJOCO_GL, or none" if asked else "EGL or OSMesa, for example the package libegl1 or libosmesa6"
    raise VideoError(f"nothing renders here ({reasons}); wanted {right}")


def film(
    model: Any,
    the_robot: robot.Robot,
    recorded: Trace,
    path: str | pathlib.Path,
    boxes: np.ndarray | None = None,
    size: tuple[int, int] = (640, 480),
    fps: int = 30,
    pictures: int = 6,
) -> int:
    """Renders the trace of one robot, until it falls, to a file, whole or not at all; returns the number of pictures.

    Args:
      model, the_robot, recorded, boxes, size: as for `pictures.render`.
      path: ends in .mp4, .gif (both play in real time) or .png (a strip of upright pictures of this height).
      fps: pictures a second of a film.
      pictures: how many, evenly spaced, of a strip.

    Raises:
      VideoError: another suffix, a place that cannot be written, odd sizes for .mp4, a trace without a state.
    """
    path = pathlib.Path(path)
    require_writable(path, size)
    recorded, boxes = _until_fall(recorded, boxes)
    last = len(recorded.time) - 1
    if last < 1:
        raise VideoError(f"{path}: the robot has fallen before the first picture; wanted a longer trace")
    if path.suffix == ".png":
        ticks = np.linspace(0, last, pictures).round().astype(int)
        size = (round(0.625 * size[1]), size[1])
    else:
        count = int(last * recorded.timestep * fps + 1e-6) + 1
        ticks = (np.arange(count) / (fps * recorded.timestep)).round().astype(int)
    frames = render(model, the_robot, recorded, ticks, boxes, size)
    with _whole_file(path) as unfinished:
        if path.suffix == ".mp4":
            _write_mp4(unfinished, frames, size, fps)
        elif path.suffix == ".gif":
            _write_gif(unfinished, frames, len(ticks), fps)
        else:
            _write_strip(unfinished, frames)
    return len(ticks)


def _until_fall(recorded: Trace, boxes: np.ndarray | None) -> tuple[Trace, np.ndarray | None]:
    """The trace and the boxes without what follows a fall."""
    count = len(recorded.time) if recorded.alive.all() else int(np.argmin(recorded.alive))
    return recorded.until(count), boxes[:count] if boxes is not None and np.ndim(boxes) == 3 else boxes


def require_writable(path: pathlib.Path, size: tuple[int, int] = (640, 480)) -> None:
    """Raises VideoError as `film` does for its path and size, before there is anything to film; changes nothing."""
    if path.suffix not in SUFFIXES:
        raise VideoError(f"{path}: the suffix {path.suffix!r} is unknown; wanted one of {', '.join(SUFFIXES)}")
    if path.suffix == ".mp4":
        _ffmpeg()
        if any(side % 2 for side in size):
            raise VideoError(f"{path}: {size[0]} x {size[1]} pixels do not fit; wanted an even width and height for .mp4")
    try:
        checkpoint.require_writable(path)
    except checkpoint.RunError as error:
        raise VideoError(str(error)) from None


@contextlib.contextmanager
def _whole_file(path: pathlib.Path) -> Iterator[pathlib.Path]:
    """A place beside `path` whose file is moved there at the end, or removed after an error. Raises VideoError."""
    unfinished = path.absolute().with_name(f"{path.name}.{os.getpid()}{checkpoint.UNFINISHED}")
    try:
        yield unfinished
        os.replace(unfinished, path)
    except OSError as error:
        raise VideoError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        with contextlib.suppress(OSError):
            unfinished.unlink(missing_ok=True)


def _ffmpeg() -> str:
    """The path of an ffmpeg program."""
    try:
        import imageio_ffmpeg  # type: ignore[import-untyped]

        return str(imageio_ffmpeg.get_ffmpeg_exe())
    except (ImportError, RuntimeError):
        raise VideoError("no ffmpeg for .mp4; wanted `pip install imageio-ffmpeg`, or a .gif") from None


def _write_mp4(path: pathlib.Path, frames: Iterator[np.ndarray], size: tuple[int, int], fps: int) -> None:
    """H.264 that every player and browser shows."""
    command = [_ffmpeg(), "-loglevel", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24"]
    command += ["-s", f"{size[0]}x{size[1]}", "-r", str(fps), "-i", "-", "-an", "-c:v", "libx264", "-preset", "veryfast"]
    command += ["-crf", "20", "-pix_fmt", "yuv420p", "-movflags", "+faststart", "-f", "mp4", str(path)]
    with tempfile.TemporaryFile() as complaints:
        with contextlib.suppress(BrokenPipeError):  # ffmpeg gave up; why stands in its complaints
            with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=complaints) as process:
                for frame in frames:
                    process.stdin.write(frame.tobytes())  # type: ignore[union-attr]
        if process.returncode:
            complaints.seek(0)
            lines = complaints.read().decode(errors="replace").strip().splitlines() or ["no reason given"]
            raise OSError(f"ffmpeg ended with status {process.returncode}: {lines[-1]}")


def _write_gif(path: pathlib.Path, frames: Iterator[np.ndarray], count: int, fps: int) -> None:
    """A GIF that repeats; it counts hundredths of a second, so the delays vary to keep real time."""
    from PIL import Image

    first = next(frames)
    # one palette for all, from the first picture and what it may lack
    bands = [np.full((8, *first.shape[1:]), 255 * np.array(color[:3])) for color in COLORS]
    palette = Image.fromarray(np.concatenate([first, *bands]).astype(np.uint8)).quantize()
    images = (
        Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
        for frame in itertools.chain([first], frames)
    )
    ends = [10 * round(100 * (i + 1) / fps) for i in range(count)]
    delays = [end - start for start, end in zip([0, *ends], ends, strict=False)]
    next(images).save(path, "GIF", save_all=True, append_images=images, duration=delays, loop=0)


def _write_strip(path: pathlib.Path, frames: Iterator[np.ndarray]) -> None:
    """The pictures side by side."""
    from PIL import Image

    Image.fromarray(np.concatenate(list(frames), axis=1)).save(path, "PNG")


@dataclasses.dataclass(frozen=True)
class Video:
    """Films the robot in MuJoCo C at a task of the evaluation or on its way through a footstep script, without a screen."""

    policy: Annotated[pathlib.Path, tyro.conf.Positional]
    """A policy file or a run directory."""
    out: pathlib.Path
    """The file to write: .mp4, .gif, or .png for a strip of six pictures."""
    task: str | None = None
    """A task of the evaluation, such as walk-forward."""
    episode: int = 0
    """Which of the task's episodes; the evaluation has the same ones."""
    script: pathlib.Path | None = None
    """A footstep script, CSV, instead of a task."""
    seconds: float | None = None
    """How long; a script's end is held. Default: as long as the script takes, or the task's 10 s."""
    feedback: bool = True
    """--no-feedback: inverse kinematics alone."""
    size: tuple[int, int] = (640, 480)
    """Width and height in pixels."""
    fps: int = 30
    """Pictures a second."""


def main() -> None:
    """The command line. Exit status 0, also after a fall; 2 for bad input or where nothing renders."""
    options = tyro.cli(Video, prog="python -m bipedtrack.video")
    began = time.monotonic()
    try:
        _check(options)
        require_writable(options.out, options.size)
        choose_backend()
        driven = policy.load_for_simulation(options.policy)
        recorded, boxes, sizes = _record_script(options, driven) if options.script else _record_task(options, driven)
        print(simulate.summary(recorded))
        model = robot.build_model(driven.robot.name, sizes)
        count = film(model, driven.robot, recorded, options.out, boxes, options.size, options.fps)
    except (Refusal, OSError) as error:
        fail(str(error))
    print(f"{options.out}: {count} pictures in {time.monotonic() - began:.0f} s")


_Recorded = tuple[Trace, np.ndarray, Sequence[Sequence[float]]]  # the trace, the poses of its boxes and their sizes


def _record_script(options: Video, driven: policy.Policy) -> _Recorded:
    assert options.script is not None
    script = footsteps.load(options.script, driven.robot, driven.sway)
    recorded = simulate.record(policy.Controller(driven, options.feedback), script, options.seconds)
    boxes = np.array([[*box.position, *box.orientation] for box in script.boxes]).reshape(-1, 7)
    return recorded, boxes, [box.size for box in script.boxes]


def _record_task(options: Video, driven: policy.Policy) -> _Recorded:
    """An episode just as the evaluation has it."""
    import jax

    from bipedtrack import evaluate, plans, suite

    if options.task not in suite.TASKS:
        raise Refusal(f"--task {options.task}: no such task; there are: {', '.join(suite.TASKS)}")
    asked = evaluate.Evaluate(
        policies=(str(options.policy),),
        episodes=options.episode + 1,
        seconds=options.seconds or evaluate.Evaluate.seconds,
        sway=driven.sway,
        feedback_ratio=None if options.feedback else 0.0,
    )
    batch, seconds = evaluate.batch_of(options.task, asked, driven.robot)
    batch = batch._replace(plan=jax.tree.map(lambda leaf: leaf[-1:], batch.plan))
    engines = evaluate.Engines(evaluate.subject(asked.policies[0], asked), "mujoco")
    recorded = engines.record("mujoco", batch, seconds).episode(0)
    plan = jax.tree.map(lambda leaf: leaf[0], batch.plan)
    numbers, _ = plans.step_numbers(plan, recorded.timestep, len(recorded.time))
    return recorded, plan.boxes[numbers], batch.sizes


def _check(options: Video) -> None:
    """Raises Refusal for options that make no film."""
    if (options.task is None) == (options.script is None):
        raise Refusal("name what to film: either --task or --script")
    if not 0 <= options.episode < 10_000:
        raise Refusal(f"--episode {options.episode}: must be from 0 to 9999")
    if options.seconds is not None and not 0.1 <= options.seconds < 1e5:
        raise Refusal(f"--seconds {options.seconds}: must be at least 0.1 and less than 100000")
    if not all(16 <= side <= 4096 for side in options.size):
        raise Refusal(f"--size {options.size[0]} {options.size[1]}: both must be from 16 to 4096 pixels")
    if not 1 <= options.fps <= 100:
        raise Refusal(f"--fps {options.fps}: must be from 1 to 100")


if __name__ == "__main__":
    main()
