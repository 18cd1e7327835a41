"""A drive at real time in a thread of its own: 200 control steps a second, whoever watches or asks for something.

A second thread plans the next task step while the present one is under way.
"""

from __future__ import annotations

import concurrent.futures
import queue
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import numpy as np

from bipedtrack.drive import Drive, View

VIEW_SECONDS = 1 / 30  # between two views
HISTORY_SECONDS = 10.0
_LATE = 0.25  # s behind the clock from which the lost time is given up
_SWITCH = 0.0002  # s after which Python lets another thread run, so that page and planning delay no control step for long
SPEEDS = (0.1, 1.0)  # simulated seconds per second, least and most
_PLAN_SECONDS = 0.01  # between two looks whether there is something to plan

Answer = TypeVar("Answer")


class Sample(NamedTuple):
    """What the plots show of one instant."""

    time: float  # s
    ankle_cm: float
    ankle_deg: float
    trunk_cm: float
    trunk_deg: float
    feedback: float  # root mean square of a_fb


class Pace(NamedTuple):
    """How well the clock is kept."""

    factor: float  # simulated seconds per second, over the last one
    step_ms: float  # median duration of a control step over the last 10 s
    step_p99_ms: float  # its 99th percentile
    work_p99_ms: float  # the same of the processor's time alone: what other programs take is not in it
    late_p99_ms: float  # 99th percentile of how late control steps began


class RealTime:
    """Runs a drive. All that touches it goes through `ask`, between two control steps."""

    def __init__(self, drive: Drive):
        """A clock that waits for `start`."""
        self._drive = drive
        self._requests: queue.SimpleQueue[tuple[Callable[[Drive], Any], concurrent.futures.Future[Any]]] = (
            queue.SimpleQueue()
        )
        self._stopped = threading.Event()
        loops = {"control": self._run, "planning": self._plan}
        self._threads = [threading.Thread(target=loop, name=name, daemon=True) for name, loop in loops.items()]
        steps = round(HISTORY_SECONDS / drive.timestep)
        self._durations: deque[float] = deque(maxlen=steps)
        self._works: deque[float] = deque(maxlen=steps)
        self._delays: deque[float] = deque(maxlen=steps)
        self._marks: deque[tuple[float, float]] = deque(maxlen=round(1 / VIEW_SECONDS))  # clock s, simulated s
        self.history: deque[Sample] = deque(maxlen=round(HISTORY_SECONDS / VIEW_SECONDS))
        self.view: View = drive.view()
        self.paused = False
        self._speed = SPEEDS[1]

    def start(self) -> None:
        """Lets the time run."""
        sys.setswitchinterval(_SWITCH)
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """Ends the threads."""
        self._stopped.set()
        for thread in self._threads:
            thread.join(timeout=5)

    def ask(self, request: Callable[[Drive], Answer], timeout: float = 10.0) -> Answer:
        """What the request returns; it has the drive for itself between two control steps. Raises what it raises."""
        answer: concurrent.futures.Future[Answer] = concurrent.futures.Future()
        self._requests.put((request, answer))
        return answer.result(timeout)

    def single_step(self) -> None:
        """One control step, and then a pause."""
        self.paused = True
        self.ask(lambda drive: drive.advance())

    @property
    def speed(self) -> float:
        """Simulated seconds per second that are wanted."""
        return self._speed

    @speed.setter
    def speed(self, wanted: float) -> None:
        self._speed = min(max(SPEEDS[0], wanted), SPEEDS[1])  # a number that is being typed may be any, or none

    @property
    def pace(self) -> Pace:
        """How well the clock has been kept lately."""
        marks, durations, delays = list(self._marks), list(self._durations), list(self._delays)
        elapsed = marks[-1][0] - marks[0][0] if len(marks) > 1 else 0.0
        factor = (marks[-1][1] - marks[0][1]) / elapsed if elapsed > 0 and not self.paused else 0.0
        ms = [1e3 * float(np.percentile(durations or [0.0], share)) for share in (50, 99)]
        return Pace(factor, *ms, *(1e3 * float(np.percentile(taken or [0.0], 99)) for taken in (list(self._works), delays)))

    def _run(self) -> None:
        due = next_view = time.perf_counter()
        while not self._stopped.is_set():
            asked = self._answer_requests()
            now = time.perf_counter()
            if self.paused:
                due = now
                self._marks.clear()
                time.sleep(0.005)
            else:
                self._delays.append(max(0.0, now - due))
                work = time.thread_time()
                self._drive.advance()
                self._works.append(time.thread_time() - work)
                done = time.perf_counter()
                self._durations.append(done - now)
                due += self._drive.timestep / self.speed
                if done - due > _LATE:
                    due = done
                time.sleep(max(0.0, due - done))
            if asked or now >= next_view:
                next_view = max(next_view + VIEW_SECONDS, now)
                self._look(now)

    def _plan(self) -> None:
        """Keeps the next task step ready: planning it takes longer than a control step may."""
        while not self._stopped.wait(_PLAN_SECONDS):
            self._drive.plan_ahead()

    def _answer_requests(self) -> bool:
        """Whether there was any."""
        asked = False
        while True:
            try:
                request, answer = self._requests.get_nowait()
            except queue.Empty:
                return asked
            asked = True
            try:
                answer.set_result(request(self._drive))
            except Exception as error:  # the one who asked gets it
                answer.set_exception(error)

    def _look(self, now: float) -> None:
        self.view = view = self._drive.view()
        if not self.paused:
            self._marks.append((now, view.time))
        if self.history and self.history[-1].time == view.time:
            return  # while paused what was there before stays in sight
        errors = view.errors
        self.history.append(
            Sample(
                time=view.time,
                ankle_cm=100 * float(np.linalg.norm(errors.ankle_positions, axis=-1).mean()),
                ankle_deg=float(np.degrees(np.abs(errors.ankle_yaws).mean())),
                trunk_cm=100 * float(np.linalg.norm(errors.trunk_position)),
                trunk_deg=float(np.degrees(np.linalg.norm(errors.trunk_orientation))),
                feedback=float(np.sqrt(np.mean(np.square(view.feedback)))),
            )
        )
