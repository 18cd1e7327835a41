"""The page on which a drive is steered and watched: panels, keys and handles of a viser server."""

from __future__ import annotations

import asyncio
import functools
import pathlib
import threading
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np
import viser
import viser.uplot

from bipedtrack import footholds, footsteps, policy, scripts, steering
from bipedtrack.drive import Drive, Mode, View
from bipedtrack.realtime import SPEEDS, VIEW_SECONDS, RealTime, Sample
from bipedtrack.scene import Scene
from bipedtrack.steering import LIMITS, Steering

T = TypeVar("T")

_SLIDERS = {
    "step_length": ("step length, m", 0.01),
    "sidle_length": ("sidle length, m", 0.01),
    "turn_angle": ("turn per step, rad", 0.01),
    "period": ("period, s", 0.05),
    "lift": ("lift, m", 0.01),
    "trunk_height": ("trunk height, m", 0.01),
    "trunk_roll": ("trunk roll, rad", 0.01),
    "trunk_pitch": ("trunk pitch, rad", 0.01),
    "trunk_yaw": ("trunk yaw, rad", 0.01),
    "trunk_ahead": ("trunk ahead, m", 0.005),
    "trunk_aside": ("trunk aside, m", 0.005),
}
_PLOTS = (
    ("ankle error", ("cm", "deg"), ("ankle_cm", "ankle_deg")),
    ("trunk error", ("cm", "deg"), ("trunk_cm", "trunk_deg")),
    ("feedback, root mean square of 12 in [-1, 1]", ("a_fb",), ("feedback",)),
)
_COLORS = ("#2972d9", "#f2731a")
_KEYS = """
**Keys** (click into the picture first): **I** forward, **K** backward, **J** turn left, **L** turn right, **U** sidle left,
**O** sidle right, **space** stop and hold, **B** push, **P** pause, **N** single step, **G** stand up, **R** reset.
W A S D, the arrows and the mouse move the camera.

**Drag** the arrows and the square at a foot to place it, those at the trunk to move it: red is out of reach.
"""


def in_loop(server: viser.ViserServer, change: Callable[[], T]) -> T:
    """What `change` returns, called in the thread of the server's event loop; not to be asked for from there.

    All that sends something to viewers belongs there: viser tells its writers by an asyncio event, which is for one thread
    alone. Set from another one it may be lost, and that viewer's page stands still for good.
    """

    async def run() -> T:
        return change()

    return asyncio.run_coroutine_threadsafe(run(), server.get_event_loop()).result()


class Page:
    """One page for any number of viewers; what one of them changes all see."""

    def __init__(self, server: viser.ViserServer, clock: RealTime, policies: Mapping[str, pathlib.Path]):
        """Fills the server's page.

        Args:
          server: of viser, already listening.
          clock: the drive's.
          policies: those to choose from by name; the first one drives.
        """
        self._server, self.clock, self._policies = server, clock, dict(policies)
        self._robot = clock.ask(lambda drive: drive.robot)
        self.scene = Scene(server, self._robot)
        self._stopped = threading.Event()
        server.initial_camera.position = (-1.3, -1.7, 1.2)
        server.initial_camera.look_at = (0.3, -0.2, 0.45)
        server.gui.set_panel_label("bipedtrack")
        self._status = server.gui.add_markdown("")
        self._note = server.gui.add_markdown("")
        tabs = server.gui.add_tab_group()
        with tabs.add_tab("Drive"):
            self._sliders = self._add_steering()
        with tabs.add_tab("Scripts"):
            self._add_scripts()
        with tabs.add_tab("Watch"):
            self._add_watching()
        self._add_keys()
        self._add_handles()
        server.on_client_disconnect(lambda client: self._let_go(client.client_id))

    def run(self) -> None:
        """Draws until `stop`, 30 times a second, the plots and texts 5 times, while somebody looks on."""
        beat = 0
        while not self._stopped.wait(VIEW_SECONDS):
            if self._server.get_clients():
                in_loop(self._server, functools.partial(self._draw, beat))
                beat += 1

    def _draw(self, beat: int) -> None:
        view = self.clock.view
        with self._server.atomic():
            self.scene.show(view, self._follow.value)
        if beat % 3 == 0:
            self.scene.show_traces()
        if beat % 6 == 0:
            self._show_text(view)
            self._show_plots()

    def stop(self) -> None:
        """Ends `run`."""
        self._stopped.set()

    # Asking the drive

    def _ask(self, request: Callable[[Drive], Any]) -> Any:
        """What the drive answers, or None where it refuses; why stands on the page then."""
        try:
            return self.clock.ask(request)
        except (ValueError, RuntimeError, OSError) as error:  # TimeoutError is an OSError without words
            self._say(str(error) or "the drive does not answer", wrong=True)
            return None

    def _say(self, words: str, wrong: bool = False) -> None:
        """A sentence in every viewer's corner."""

        def tell() -> None:
            for client in self._server.get_clients().values():
                client.add_notification(
                    "not done" if wrong else "done", words, color="red" if wrong else None, auto_close_seconds=10
                )

        in_loop(self._server, tell)

    def _set(self, handle: Any, name: str, value: Any) -> None:
        """A new value for an element of the page."""
        in_loop(self._server, lambda: setattr(handle, name, value))

    def _steer(self, **wishes: float) -> None:
        self._ask(lambda drive: drive.steer(**wishes))

    def _button(self, label: str, request: Callable[[], Any], hint: str | None = None) -> viser.GuiButtonHandle:
        button = self._server.gui.add_button(label, hint=hint)
        button.on_click(lambda _: request())
        return button

    # Panels

    def _moves(self) -> dict[str, tuple[str, Callable[[], Any]]]:
        """Name, key and request of all that moves the feet."""
        still = {"ahead": 0.0, "aside": 0.0, "turn": 0.0}

        def go(**way: float) -> Callable[[], None]:
            return lambda: self._steer(**(still | way))

        return {
            "forward": ("I", go(ahead=1.0)),
            "backward": ("K", go(ahead=-1.0)),
            "turn left": ("J", go(turn=1.0)),
            "turn right": ("L", go(turn=-1.0)),
            "sidle left": ("U", go(aside=1.0)),
            "sidle right": ("O", go(aside=-1.0)),
            "stop and hold": ("space", lambda: self._ask(Drive.stop)),
        }

    def _add_steering(self) -> dict[str, Any]:
        """Buttons and sliders that steer, and what happens after a fall."""
        gui, moves = self._server.gui, self._moves()
        for names in (("forward", "backward"), ("turn left", "turn right"), ("sidle left", "sidle right")):
            group = gui.add_button_group("", names)
            group.on_click(lambda event: moves[str(event.target.value)][1]())
        self._button("stop and hold", moves["stop and hold"][1])
        self._stand_up = self._button("stand up at the last foothold", lambda: self._ask(Drive.stand_up), "after a fall")
        self._button("reset", lambda: self._ask(Drive.reset), "back to the start")
        ground = gui.add_dropdown("ground", ("level", "stairs", "obstacles"))
        ground.on_update(lambda event: self._lay_out(str(event.target.value)))
        gui.add_markdown(_KEYS)
        sliders: dict[str, Any] = {}
        with gui.add_folder("the next task step"):
            for name, (label, grain) in _SLIDERS.items():
                low, high = LIMITS[name]
                sliders[name] = gui.add_slider(label, low, high, grain, getattr(Steering(), name))
                sliders[name].on_update(functools.partial(self._slid, name))
        return sliders

    def _slid(self, name: str, event: Any) -> None:
        if event.client is not None:  # somebody's hand, not `_show_text`
            self._steer(**{name: float(event.target.value)})

    def _lay_out(self, name: str) -> None:
        """Another ground: the boxes of a ready script, and the robot at the start."""
        boxes = () if name == "level" else footsteps.load(scripts.ready()[name], self._robot).boxes
        self._ask(lambda drive: drive.reset(boxes))

    def _add_scripts(self) -> None:
        """Load, edit, run, loop, save; a drive as a script."""
        gui, ready = self._server.gui, scripts.ready()
        chosen = gui.add_dropdown("ready", tuple(ready), initial_value="walk")
        self._text: Any = gui.add_text("script", ready["walk"].read_text(encoding="utf-8"), multiline=True)
        self._loop = gui.add_checkbox("loop", False)
        self._button("run", self._run_script)
        self._button("stop and hold ", lambda: self._ask(Drive.stop))
        gui.add_button("save").on_click(self._save)
        gui.add_button("the drive so far as a script").on_click(lambda _: self._write_down())
        upload = gui.add_upload_button("load a file", mime_type=".csv,text/csv,text/plain")
        # not as Markdown: what a script's cells hold would run in every viewer's browser
        self._problems: Any = gui.add_text("what is wrong", "", multiline=True, disabled=True, visible=False)

        @chosen.on_update
        def _(event: Any) -> None:
            self._set(self._text, "value", ready[event.target.value].read_text(encoding="utf-8"))

        @upload.on_upload
        def _(event: Any) -> None:
            self._set(self._text, "value", event.target.value.content.decode("utf-8-sig", errors="replace"))

    def _run_script(self) -> None:
        try:
            script = footsteps.parse(self._text.value, self._robot, "script", steering.FULL_SWAY)
        except footsteps.ScriptError as error:
            self._set(self._problems, "value", str(error))
            self._set(self._problems, "visible", True)
            return
        self._set(self._problems, "visible", False)
        self._ask(lambda drive: drive.run(script, self._loop.value))

    def _write_down(self) -> None:
        """The drive's text into the editor."""
        written = self._ask(Drive.as_script)
        if written is not None:
            self._set(self._text, "value", written)

    def _save(self, event: Any) -> None:
        """The editor's text as a file, to the one who asked."""
        if event.client is not None:
            file = "script.csv", self._text.value.encode()
            in_loop(self._server, lambda: event.client.send_file_download(*file, save_immediately=True))

    def _add_watching(self) -> None:
        """Plots, push, time, policy."""
        gui = self._server.gui
        self._plots = [self._add_plot(*plot) for plot in _PLOTS]
        with gui.add_folder("push"):
            self._impulse = gui.add_slider("impulse, N s", 0.0, 100.0, 1.0, 10.0)
            self._direction = gui.add_slider("direction, deg (0 forward, 90 left)", -180.0, 180.0, 15.0, 90.0)
            self._button("push", self._push)
        with gui.add_folder("time"):
            self._pause: Any = gui.add_checkbox("pause", False)
            self._pause.on_update(lambda event: setattr(self.clock, "paused", bool(event.target.value)))
            speed = gui.add_slider("speed", *SPEEDS, 0.1, 1.0, hint="below 1: slow motion")
            speed.on_update(lambda event: setattr(self.clock, "speed", float(event.target.value)))
            self._button("single step, 5 ms", self._single_step)
            self._follow = gui.add_checkbox("the camera follows", True)
        with gui.add_folder("policy"):
            chosen = gui.add_dropdown("policy", tuple(self._policies))
            chosen.on_update(lambda event: self._use(str(event.target.value)))
            feedback = gui.add_checkbox("feedback", True, hint="off: inverse kinematics alone")
            feedback.on_update(lambda event: self._ask(lambda drive: setattr(drive, "feedback", bool(event.target.value))))

    def _add_plot(self, title: str, labels: tuple[str, ...], names: tuple[str, ...]) -> tuple[Any, tuple[str, ...]]:
        series = [viser.uplot.Series(label="s")]
        series += [
            viser.uplot.Series(label=label, stroke=color, width=1.5) for label, color in zip(labels, _COLORS, strict=False)
        ]
        empty = (np.zeros(1), *(np.zeros(1) for _ in names))
        scales = {"x": viser.uplot.Scale(time=False, auto=True), "y": viser.uplot.Scale(auto=True)}
        return self._server.gui.add_uplot(empty, tuple(series), title=title, scales=scales, height=150), names

    def _push(self) -> None:
        impulse, direction = float(self._impulse.value), float(self._direction.value)
        self._ask(lambda drive: drive.push(impulse, direction))

    def _toggle_pause(self) -> None:
        self.clock.paused = not self.clock.paused
        self._set(self._pause, "value", self.clock.paused)

    def _single_step(self) -> None:
        self._set(self._pause, "value", True)
        self.clock.single_step()

    def _use(self, name: str) -> None:
        """Another policy, loaded before the drive is asked to take it."""
        try:
            loaded = policy.load(self._policies[name], self._robot)
        except (ValueError, RuntimeError, OSError) as error:
            self._say(str(error), wrong=True)
            return
        self._ask(lambda drive: drive.use(policy.Controller(loaded, drive.feedback)))

    # Keys and handles

    def _add_keys(self) -> None:
        keys = dict(self._moves())
        keys |= {
            "push": ("B", self._push),
            "pause": ("P", self._toggle_pause),
            "single step": ("N", self._single_step),
            "stand up": ("G", lambda: self._ask(Drive.stand_up)),
            "reset": ("R", lambda: self._ask(Drive.reset)),
        }
        for label, (key, request) in keys.items():
            command = self._server.gui.add_command(label, hotkey=key)  # type: ignore[arg-type]
            command.on_trigger(lambda _, request=request: request())  # type: ignore[misc]

    def _add_handles(self) -> None:
        foot, trunk = ("foot", self._place_foot, self._reaches_foot), ("trunk", self._place_trunk, self._reaches_trunk)
        self.scene.foot.on_update(lambda event: self._drag(*foot, event.phase, event.client_id))
        self.scene.trunk.on_update(lambda event: self._drag(*trunk, event.phase, event.client_id))

    def _let_go(self, viewer: int) -> None:
        """What a viewer who leaves holds is free again."""
        for handle in [name for name, holder in self.scene.held.items() if holder == viewer]:
            self.scene.held.pop(handle, None)

    def _drag(
        self, handle: str, place: Callable[[], None], reaches: Callable[[], bool], phase: str, viewer: int | None
    ) -> None:
        """The robot waits while a viewer holds a handle, and follows when it is let go."""
        if phase == "start":
            self.scene.held[handle] = viewer
            self._ask(Drive.lead)
        elif phase == "end":
            try:
                place()
            finally:
                self.scene.held.pop(handle, None)
        elif handle in self.scene.held:
            within_reach = reaches()
            in_loop(self._server, lambda: self.scene.mark(handle, within_reach))

    # What is within reach is searched in the viewer's own thread, for it takes long: the drive goes on meanwhile.

    def _wanted_foothold(self, view: View) -> footholds.Foothold:
        return self.scene.foothold(view.next_foot.foot)

    def _reaches_foot(self) -> bool:
        view = self.clock.view
        return not steering.problems(self._robot, view.boxes, view.step.end, self._wanted_foothold(view), view.steering)

    def _place_foot(self) -> None:
        view = self.clock.view
        wanted = self._wanted_foothold(view)
        planned = steering.place(self._robot, view.boxes, view.step.end, wanted, view.steering)
        possible = planned.step.swing.any()
        if possible:
            self._ask(lambda drive: drive.place(footholds.end_of(planned.step, wanted.foot)))
        if planned.note:
            self._say(planned.note, wrong=not possible)

    def _wanted_trunk(self, view: View) -> Steering:
        return steering.trunk_at(self._robot, view.step.end, self.scene.trunk.position, self.scene.trunk.wxyz, view.steering)

    def _reaches_trunk(self) -> bool:
        wanted = self._wanted_trunk(self.clock.view)
        return steering.clamped(wanted) == wanted

    def _place_trunk(self) -> None:
        view = self.clock.view
        within, note = steering.lean(self._robot, view.boxes, view.step.end, self._wanted_trunk(view))
        if within is not None:
            self._steer(**{name: value for name, value in within._asdict().items() if name.startswith("trunk")})
        if note:
            self._say(note, wrong=within is None)

    # What is shown

    def _show_text(self, view: View) -> None:
        pace = self.clock.pace
        factor = "paused" if self.clock.paused else f"{pace.factor:.2f} x real time"
        self._status.content = (
            f"**{view.mode.value}** at {view.time:.1f} s, {factor}; "
            f"a control step takes {pace.step_ms:.1f} ms, 99 %: {pace.step_p99_ms:.1f} ms"
        )
        fallen = view.mode is Mode.FALLEN
        if self._stand_up.disabled is fallen:
            self._stand_up.disabled = not fallen
        # never without words, or all that stands below would move away from under the mouse
        note = view.note or ("walking" if view.steering.moves or view.prints else "holding")
        note = f"**{note}**" if fallen else note
        if self._note.content != note:
            self._note.content = note
        for name, slider in self._sliders.items():
            value = getattr(view.steering, name)
            if abs(slider.value - value) > 1e-6:
                slider.value = value

    def _show_plots(self) -> None:
        history: list[Sample] = list(self.clock.history)[::2]
        times = np.array([sample.time for sample in history])
        for reset in np.flatnonzero(np.diff(times) < 0)[-1:] + 1:  # only what came after it
            history, times = history[reset:], times[reset:]
        for plot, names in self._plots:
            if len(times):
                plot.data = (times, *(np.array([getattr(sample, name) for sample in history]) for name in names))
