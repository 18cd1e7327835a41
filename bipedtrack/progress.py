"""What a training shows while it runs: a live display, JSON lines and TensorBoard events, all with the same figures."""

from __future__ import annotations

import contextlib
import os
import pathlib
import time
from types import TracebackType

import rich.console
import rich.live
import rich.table
import rich.text
from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event
from tensorboardX.summary import scalar

from bipedtrack import checkpoint
from bipedtrack.curriculum import Call, Curriculum

_LINE_EVERY = 20.0  # s between lines where the output is no terminal


class Progress:
    """Shows a training's progress; a context manager, for the live display must end with the training.

    `progress.jsonl` gets one line an update of the figures, `tensorboard/` the same as scalars over policy steps.
    """

    def __init__(self, folder: pathlib.Path, curriculum: Curriculum, calls: tuple[Call, ...], done_steps: int):
        """done_steps: policy steps of the calls that an earlier run has finished."""
        self._folder = folder
        self._calls = calls
        self._total = sum(call.steps for call in calls)
        self._policy_period = curriculum.policy_period
        self._done = done_steps  # before the present call
        self._console = rich.console.Console()
        self._live = rich.live.Live(console=self._console, auto_refresh=False, transient=False)
        self._events = _Events(folder / "tensorboard")
        self._spoke = 0.0
        self._rate = 0.0  # policy steps/s, smoothed
        self._last = (time.monotonic(), 0)
        self._began: float | None = None  # when the present call was announced, until its first update
        self._first = (0.0, 0)  # s from there to the first update of a call, and its policy steps

    def __enter__(self) -> Progress:
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._console.is_terminal:
            self._live.stop()
        self._events.close()

    def say(self, text: str) -> None:
        """Prints a line beside the live display."""
        self._console.print(text, highlight=False, markup=False, soft_wrap=True)

    def compiling(self, call: Call, what: str) -> None:
        """Announces that a call's program is being compiled, which takes a while and shows nothing else."""
        now = time.monotonic()
        self._last, self._began = (now, 0), self._began or now
        self._show(call, 0, {}, f"compiling {what}")

    def update(self, call: Call, steps: int, figures: dict[str, float]) -> None:
        """Shows and records figures after `steps` policy steps of a call."""
        now = time.monotonic()
        seconds, advanced = now - self._last[0], steps - self._last[1]
        if self._last[1] > 0 and seconds > 0:
            rate = advanced / seconds
            self._rate = rate if self._rate == 0 else 0.8 * self._rate + 0.2 * rate
        if self._began is not None:
            self._first, self._began = (now - self._began, steps), None
        self._last = (now, steps)
        step = self._done + steps
        record = {"stage": call.stage.name, "lesson": call.lesson.name, "call": call.index, "steps": step}
        record |= {"time": round(time.time(), 1), "steps_per_second": round(self._rate, 1), **figures}
        checkpoint.append_jsonl(self._folder / "progress.jsonl", record)
        problem = self._events.add(step, figures)
        if problem:
            self.say(f"warning: {problem}; goes on without")
        self._show(call, steps, figures, "training")

    def finished(self, call: Call) -> None:
        """Counts a finished call."""
        self._done += call.steps

    def _minutes_left(self, call: Call, step: int) -> float:
        """Of the steps that are left at the present speed, and of beginning the calls that are left as the last one did."""
        seconds, steps = self._first
        to_begin = max(0.0, seconds - steps / self._rate)
        calls_left = len(self._calls) - 1 - call.index
        return (max(self._total - step, 0) / self._rate + calls_left * to_begin) / 60

    def _show(self, call: Call, steps: int, figures: dict[str, float], doing: str) -> None:
        step = self._done + steps
        left = f"{self._minutes_left(call, step):.0f} min left" if self._rate else ""
        shown = {
            "stage": f"{call.stage.name}, {call.lesson.name} (call {call.index + 1} of {len(self._calls)})",
            "doing": doing,
            "steps": f"{step / 1e6:.2f} of {self._total / 1e6:.2f} M",
            "speed": f"{self._rate:.0f} steps/s {left}" if self._rate else "",
        }
        if figures:
            shown |= {
                "episode": f"{figures['episode_seconds']:.1f} s, {100 * figures['falls']:.0f} % fall",
                "ankles": f"{figures['ankle_error_cm']:.1f} cm, {figures['ankle_yaw_error_deg']:.1f} deg",
                "trunk": f"{figures['trunk_error_cm']:.1f} cm, {figures['trunk_error_deg']:.1f} deg",
                "reward": f"{figures['reward_per_step']:.2f} a step",
            }
        if self._console.is_terminal:
            table = rich.table.Table.grid(padding=(0, 2))
            for name, text in shown.items():
                table.add_row(rich.text.Text(name, "bold"), rich.text.Text(text))
            self._live.update(table, refresh=True)
        elif doing != "training" or time.monotonic() - self._spoke > _LINE_EVERY:
            self._spoke = time.monotonic()
            self.say(" | ".join(text.strip() for text in shown.values() if text.strip()))


class _Events:
    """Scalars for TensorBoard, written at once. What cannot be written ends no training: then nothing more is."""

    def __init__(self, folder: pathlib.Path):
        self._folder = folder
        self._writer: EventsWriter | None = None
        self._given_up = False

    def add(self, step: int, figures: dict[str, float]) -> str:
        """Writes figures at a policy step; why that was not possible, once, or nothing."""
        if self._given_up:
            return ""
        try:
            if self._writer is None:
                self._folder.mkdir(parents=True, exist_ok=True)
                # named by the second and the process: a run that is gone on with begins another file
                self._writer = EventsWriter(str(self._folder / "events"), f".{os.getpid()}")
            for name, value in figures.items():
                self._writer.write_event(Event(wall_time=time.time(), step=step, summary=scalar(name, value)))
            self._writer.flush()
        except OSError as error:
            self._given_up = True
            return f"{self._folder}: cannot be written ({error.strerror or error})"
        return ""

    def close(self) -> None:
        """Ends the file."""
        if self._writer is not None:
            with contextlib.suppress(OSError):  # what is not written by now has been warned of
                self._writer.close()


class Aside:
    """What is shown of a training by a process that only shares its work: single lines."""

    def say(self, text: str) -> None:
        """Prints a line."""
        print(text, flush=True)

    def compiling(self, call: Call, what: str) -> None:
        """Announces that a call's program is being compiled."""
        self.say(f"{call.stage.name}, {call.lesson.name}: compiling {what}")

    def update(self, call: Call, steps: int, figures: dict[str, float]) -> None:
        """Shows nothing."""

    def finished(self, call: Call) -> None:
        """Shows nothing."""
