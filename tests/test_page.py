"""The page, its handles and what is on it, without a browser and in one."""

import io
import math
import re
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import chromium
import numpy as np
import pytest
from chromium import Chromium, Tab, wait_until
from PIL import Image
from ports import free_port

from bipedtrack import footsteps, play, rotations
from bipedtrack import robot as robots
from bipedtrack.drive import Drive, Mode
from bipedtrack.realtime import HISTORY_SECONDS
from bipedtrack.steering import Steering

pytest.importorskip("viser")
from viser.infra._async_message_buffer import AsyncMessageBuffer  # noqa: E402
from viser.infra._messages import Message  # noqa: E402

from bipedtrack.page import Page, in_loop  # noqa: E402
from bipedtrack.scene import OUT_OF_REACH_COLOR, color_of, shape_of  # noqa: E402


@pytest.fixture(scope="module")
def port() -> int:
    return free_port()


@pytest.fixture(scope="module")
def page(port: int) -> Iterator[Page]:
    with play.serve(play.Play(port=port)) as page:
        yield page


@pytest.fixture(autouse=True)
def start(request: pytest.FixtureRequest) -> None:
    """Every test of the page begins with a robot that stands at the start."""
    if "page" in request.fixturenames:
        page = request.getfixturevalue("page")
        page.clock.ask(at_rest)


def at_rest(drive: Drive) -> None:
    drive.reset(())
    drive.steer(**Steering()._asdict())


def x_of(page: Page) -> float:
    return float(page.clock.view.qpos[0])


# Without a browser


def test_the_clock_runs_at_real_time_without_a_viewer(page: Page) -> None:
    began, at = time.perf_counter(), page.clock.ask(lambda drive: drive.view().time)
    time.sleep(2.0)
    passed = page.clock.ask(lambda drive: drive.view().time) - at
    # never faster; slower only where other programs take the processor
    assert 0.1 < passed < 1.1 * (time.perf_counter() - began)


def test_a_foothold_out_of_reach_turns_red_and_the_robot_goes_to_the_nearest(page: Page) -> None:
    handle = page.scene.foot
    foot = page.clock.view.next_foot.foot
    page._drag("foot", page._place_foot, page._reaches_foot, "start", 1)
    handle.position = np.array([0.2, 0.12 if foot == 0 else -0.12, 0.0])
    page._drag("foot", page._place_foot, page._reaches_foot, "update", 1)
    assert tuple(page.scene._foot_plate.color) != OUT_OF_REACH_COLOR
    handle.position = np.array([3.0, 0.1 if foot == 0 else -0.1, 0.0])
    page._drag("foot", page._place_foot, page._reaches_foot, "update", 1)
    assert tuple(page.scene._foot_plate.color) == OUT_OF_REACH_COLOR
    page._drag("foot", page._place_foot, page._reaches_foot, "end", 1)
    wait_until(lambda: page.clock.view.measured.ankle_positions[foot, 0] > 0.3)
    assert page.clock.view.mode is Mode.STEER


def test_the_trunk_follows_its_handle(page: Page) -> None:
    page._drag("trunk", page._place_trunk, page._reaches_trunk, "start", 1)
    page.scene.trunk.position = np.array([0.0, 0.0, 0.68])
    page._drag("trunk", page._place_trunk, page._reaches_trunk, "end", 1)
    assert page.clock.ask(lambda drive: drive.steering.trunk_height) == pytest.approx(0.68, abs=0.005)
    wait_until(lambda: page.clock.view.qpos[2] < 0.71)


def test_whoever_leaves_lets_go_of_what_is_in_that_hand_alone(page: Page) -> None:
    page._drag("foot", page._place_foot, page._reaches_foot, "start", 1)
    page._drag("trunk", page._place_trunk, page._reaches_trunk, "start", 2)
    page._let_go(3)
    assert page.scene.held == {"foot": 1, "trunk": 2}
    page._let_go(1)
    assert page.scene.held == {"trunk": 2}
    page._let_go(2)
    assert not page.scene.held


def test_pause_slow_motion_and_single_steps(page: Page) -> None:
    def seconds() -> float:
        return float(page.clock.ask(lambda drive: drive.data.time))

    page._toggle_pause()
    at = seconds()
    time.sleep(0.1)
    assert seconds() <= at + 0.006  # the step that was under way
    at = seconds()
    page._single_step()
    assert seconds() == pytest.approx(at + 0.005)
    page.clock.speed = 0.25
    page._toggle_pause()
    at = seconds()
    time.sleep(1.0)
    assert 0.0 < seconds() - at < 0.5
    for typed, kept in ((0.0, 0.1), (-3.0, 0.1), (7.0, 1.0)):  # on the way to another number
        page.clock.speed = typed
        assert page.clock.speed == kept
    at = seconds()
    time.sleep(0.2)
    assert seconds() > at


def test_a_pause_leaves_the_plots_alone(page: Page) -> None:
    page._toggle_pause()
    before = [sample.time for sample in page.clock.history]
    time.sleep(0.3)  # nine views
    assert [sample.time for sample in page.clock.history][:-1] in (before, before[:-1])
    page._toggle_pause()


def test_what_is_wrong_with_a_script_is_text_and_no_markup(page: Page) -> None:
    header = ",".join(footsteps.COLUMNS)
    page._text.value = f"{header}\n<script src=//x.yz></script>,0.1\n![](/a.png),0.1\n"
    page._run_script()
    assert page._problems.visible and page._problems.value.count("wanted left, right") == 2
    assert type(page._problems).__name__ == "GuiTextHandle"
    page._text.value = f"{header}\nleft,0.1\n"
    page._run_script()
    assert not page._problems.visible
    wait_until(lambda: page.clock.view.mode is Mode.SCRIPT)


def test_what_the_drive_refuses_reaches_the_one_who_asked(page: Page) -> None:
    with pytest.raises(ValueError, match="wanted 0 to"):
        page.clock.ask(lambda drive: drive.push(1e9))
    page._ask(lambda drive: drive.push(1e9))  # the page says so and goes on
    assert page.clock.ask(lambda drive: drive.mode) is Mode.STEER


def test_shapes_are_those_of_the_mjcf(mj_model: object) -> None:
    model = robots.build_model("ranger_max")
    trunk = model.geom("trunk").id
    assert np.allclose(shape_of(model, trunk).bounds, [[-0.15, -0.15, -0.075], [0.15, 0.15, 0.075]])
    thigh = model.geom("left_thigh").id
    assert np.allclose(shape_of(model, thigh).extents, [0.11, 0.11, 0.51], atol=0.005)
    assert color_of(model, model.geom("left_foot").id) == (41, 115, 191)  # 0.16 0.45 0.75
    with pytest.raises(ValueError, match="PLANE"):
        shape_of(model, model.geom("floor").id)


# In a browser

browser_tests = pytest.mark.skipif(chromium.PROGRAM is None, reason="no Chromium on the PATH")


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chromium]:
    with Chromium(tmp_path_factory.mktemp("chromium")) as browser:
        yield browser


@pytest.fixture(scope="module")
def tab(browser: Chromium, page: Page, port: int) -> Tab:
    tab = browser.open(f"http://127.0.0.1:{port}")
    wait_until(lambda: "real time" in tab.text)
    return tab


def is_blue(picture: bytes) -> np.ndarray:
    """Which pixels left of the panel have the colour of the left leg."""
    pixels = np.asarray(Image.open(io.BytesIO(picture)).convert("RGB"), int)
    red, green, blue = np.moveaxis(pixels[:, : pixels.shape[1] // 2], -1, 0)
    return (blue > red + 60) & (blue > green + 20)


@browser_tests
def test_the_canvas_shows_the_robot(tab: Tab) -> None:
    wait_until(lambda: is_blue(tab.picture()).sum() > 100)


@browser_tests
def test_a_key_makes_it_walk_and_another_one_stops_it(tab: Tab, page: Page) -> None:
    tab.press("i")
    wait_until(lambda: x_of(page) > 0.3)
    tab.press(" ")
    wait_until(lambda: not (page.clock.view.steering.moves or page.clock.view.prints))
    stopped = page.clock.view.time  # of the simulation, which is slower than the clock on a busy machine
    wait_until(lambda: page.clock.view.time > stopped + 1.5)
    at = x_of(page)
    wait_until(lambda: page.clock.view.time > stopped + 2.0)
    assert x_of(page) == pytest.approx(at, abs=0.02)


@browser_tests
def test_a_button_makes_it_walk(tab: Tab, page: Page) -> None:
    tab.click("backward")
    wait_until(lambda: x_of(page) < -0.2)
    tab.click("stop and hold")
    wait_until(lambda: not page.clock.view.steering.moves)


@browser_tests
def test_it_climbs_a_stair_and_stops_there(tab: Tab, page: Page) -> None:
    """What the README tells a new user to do."""
    tab.click("level")
    tab.click("stairs")
    wait_until(lambda: page.clock.view.boxes)
    tab.click_at((200.0, 300.0))  # into the picture
    tab.press("i")
    wait_until(lambda: page.clock.view.measured.ankle_positions[:, 2].max() > 0.13)
    tab.press(" ")
    wait_until(lambda: not (page.clock.view.steering.moves or page.clock.view.prints))
    began = page.clock.view.time
    while page.clock.view.time < began + 5.0:
        heights = page.clock.view.measured.ankle_positions[:, 2]
        assert heights[0] == pytest.approx(heights[1], abs=0.01)
        assert heights.min() > 0.13
        time.sleep(0.1)
    assert page.clock.view.mode is Mode.STEER
    tab.click("stairs")
    tab.click("level")
    wait_until(lambda: not page.clock.view.boxes)


@browser_tests
def test_a_number_typed_beside_a_slider_is_steered(tab: Tab, page: Page) -> None:
    tab.click("0.75")  # m, trunk height
    tab.write("0.68")
    wait_until(lambda: page.clock.view.steering.trunk_height == pytest.approx(0.68))
    wait_until(lambda: page.clock.view.qpos[2] < 0.71)


@browser_tests
def test_after_a_fall_it_says_so_and_stands_up_again(tab: Tab, page: Page) -> None:
    tab.click("Watch")
    tab.click("feedback")
    wait_until(lambda: not page.clock.ask(lambda drive: drive.feedback))
    tab.click("Drive")
    tab.click("forward")
    wait_until(lambda: "stand up again at the last foothold, or reset" in tab.text)
    tab.click("Watch")
    tab.click("feedback")
    wait_until(lambda: page.clock.ask(lambda drive: drive.feedback))
    tab.click("Drive")
    tab.click("stand up at the last foothold")
    wait_until(lambda: page.clock.view.mode is Mode.STEER)
    wait_until(lambda: page.clock.view.qpos[2] > 0.7)


@browser_tests
def test_a_push_moves_it(tab: Tab, page: Page) -> None:
    tab.click("Watch")
    wait_until(lambda: "impulse" in tab.text)
    wait_until(lambda: page.clock.view.time > 3.0)  # the robot has come to rest
    before = page.clock.view.time, page.clock.history[-1].trunk_cm
    tab.click("push")
    # a push is over sooner than a busy browser answers the click
    pushed = lambda: [sample.trunk_cm for sample in list(page.clock.history) if sample.time > before[0]]  # noqa: E731
    wait_until(lambda: max(pushed(), default=0.0) > before[1] + 1.0)


@browser_tests
def test_viewers_are_sent_to_from_one_thread_alone(tab: Tab, page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise viser now and then forgets to wake a viewer's writer, whose page stands still for good."""
    push, threads, kinds = AsyncMessageBuffer.push, set(), set()

    def noted(self: AsyncMessageBuffer, message: Message) -> None:
        threads.add(threading.get_ident())
        kinds.add(type(message).__name__)
        push(self, message)

    monkeypatch.setattr(AsyncMessageBuffer, "push", noted)
    page._toggle_pause()
    page._single_step()
    page._toggle_pause()
    page._say("a sentence")
    page._write_down()
    page._drag("foot", page._place_foot, page._reaches_foot, "start", 1)
    page._drag("foot", page._place_foot, page._reaches_foot, "update", 1)
    page._drag("foot", page._place_foot, page._reaches_foot, "end", 1)
    tab.click("Watch")
    time.sleep(1.0)
    assert len(kinds) >= 4  # there was something to send
    assert threads == {in_loop(page._server, threading.get_ident)}
    tab.click("Drive")


@browser_tests
def test_another_policy_takes_over_while_it_walks(tab: Tab, page: Page) -> None:
    first = page.clock.ask(lambda drive: drive.controller.policy)
    tab.click("Watch")
    page._steer(ahead=1.0)
    wait_until(lambda: x_of(page) > 0.3)
    for choice, other in (("best", "versatile"), ("versatile", "best")):
        before = page.clock.ask(lambda drive: drive.controller.policy)
        tab.click(choice)
        tab.click(other)
        wait_until(lambda before=before: page.clock.ask(lambda drive: drive.controller.policy) is not before)
        at = x_of(page)
        wait_until(lambda at=at: x_of(page) > at + 0.3)
        assert page.clock.view.mode is Mode.STEER
    again = page.clock.ask(lambda drive: drive.controller.policy)
    assert again.provenance == first.provenance
    tab.click("Drive")


def is_red(picture: bytes, x: float, y: float) -> bool:
    """Whether the pixel there has the colour of what is out of reach."""
    red, green, blue = Image.open(io.BytesIO(picture)).convert("RGB").getpixel((round(x), round(y)))
    return red > 1.5 * max(green, blue)


def pixels(page: Page, points: np.ndarray) -> list[tuple[float, float]]:
    """Where points (n, 3) of the drive's world, m, are seen: through the camera that the page tells of."""
    (client,) = page._server.get_clients().values()
    camera = client.camera
    from_camera = rotations.to_matrix(camera.wxyz)  # x to the right, y down, z ahead
    x, y, z = ((points + page.scene._world.position - camera.position) @ from_camera).T
    height, width = camera.image_height, camera.image_width
    share = height / 2 / math.tan(camera.fov / 2)
    return list(zip(width / 2 + share * x / z, height / 2 + share * y / z, strict=True))


def drag(tab: Tab, page: Page, at: np.ndarray, by: np.ndarray, release: bool = True) -> tuple[float, float]:
    """Drags what is at a point of the drive's world, (3,) m, along a vector; the pixel where the mouse ends."""
    way = pixels(page, at + np.linspace(0, 1, 12)[:, None] * by)
    tab.drag(way, release)
    return way[-1]


@pytest.fixture
def wide(tab: Tab, page: Page) -> Iterator[Tab]:
    """A window in which the panel leaves the handles free, once the robot is seen at the start."""
    wait_until(lambda: is_blue(tab.picture()).sum() > 100)
    tab.call("Emulation.setDeviceMetricsOverride", width=900, height=500, deviceScaleFactor=1, mobile=False)
    (client,) = page._server.get_clients().values()
    wait_until(lambda: (client.camera.image_width, client.camera.image_height) == (900, 500))
    wait_until(lambda: np.allclose(page.scene.foot.position[:2], [0.0, 0.1]))
    tab.draw()
    yield tab
    tab.release((1.0, 1.0))  # a test that failed in the middle of a drag spoils no other
    tab.call("Emulation.clearDeviceMetricsOverride")


GRIP = np.array([0.053, 0.053, 0.0])  # m from a handle: the little square between two of its arrows


@browser_tests
def test_a_foothold_is_dragged_with_the_mouse(wide: Tab, page: Page) -> None:
    assert page.clock.view.next_foot.foot == 0
    drag(wide, page, page.scene.foot.position + GRIP, np.array([0.15, 0.0, 0.0]))
    wait_until(lambda: page.clock.view.next_foot.foot == 1)
    wait_until(lambda: not page.clock.view.prints)
    assert page.clock.view.measured.ankle_positions[0, :2] == pytest.approx([0.15, 0.1], abs=0.03)
    assert "moved" not in wide.text


@browser_tests
def test_a_foothold_dragged_out_of_reach_turns_red_and_is_moved(wide: Tab, page: Page) -> None:
    end = drag(wide, page, page.scene.foot.position + GRIP, np.array([0.1, 0.7, 0.0]), release=False)
    wait_until(lambda: tuple(page.scene._foot_plate.color) == OUT_OF_REACH_COLOR)
    # the mouse may still be on its way: the plate's heel, where none of the arrows lies, is looked for where it is now
    heel = lambda: pixels(page, page.scene.foot.position[None] - [0.06, 0.0, 0.0])[0]  # noqa: E731
    wait_until(lambda: is_red(wide.picture(), *heel()))
    wide.release(end)
    wait_until(lambda: "the left foothold was moved by" in wide.text)
    wait_until(lambda: page.clock.view.next_foot.foot == 1)
    wait_until(lambda: not page.clock.view.prints)
    x, y, _ = page.clock.view.measured.ankle_positions[0]
    assert 0.2 < math.dist((x, y), (0.0, 0.1)) < 0.36  # as far as steps go, and to that side
    assert y > 0.3
    assert page.clock.view.mode is Mode.STEER


@browser_tests
def test_planned_footprints_are_seen_ahead_of_the_robot(wide: Tab, page: Page) -> None:
    feet = ((0.1, 0.3), (0.35, -0.1))  # where neither leg hides them
    lines = [f"{leg},{x},{y}" for leg, (x, y) in zip(("left", "right"), feet, strict=True)]
    script = footsteps.parse("\n".join([",".join(footsteps.COLUMNS), "both", *lines]), robots.load(), "here")

    def seen() -> list[bool]:
        """For each foothold, whether it has the hue of its foot's print: blue or orange."""
        picture = Image.open(io.BytesIO(wide.picture())).convert("RGB")
        places = pixels(page, np.array([[x, y, 0.0] for x, y in feet]))
        left, right = (picture.getpixel((round(x), round(y))) for x, y in places)
        return [left[2] > 1.5 * left[0], right[0] > 1.5 * right[2]]

    assert not any(seen())
    page.clock.ask(lambda drive: drive.run(script))
    page._toggle_pause()
    try:
        wait_until(lambda: all(seen()))
        assert len(page.clock.view.prints) == 2
    finally:
        page._toggle_pause()


@browser_tests
def test_the_trunk_is_dragged_with_the_mouse(wide: Tab, page: Page) -> None:
    drag(wide, page, page.scene.trunk.position + [0.0, 0.0, 0.15], np.array([0.0, 0.0, -0.06]))
    wait_until(lambda: page.clock.view.qpos[2] < 0.71)
    assert page.clock.view.steering.trunk_height == pytest.approx(0.69, abs=0.01)


def write(tab: Tab, page: Page, text: str) -> None:
    """Replaces what stands in the editor."""
    chosen = "(e => { if (e) { e.focus(); e.select(); return true } })(document.querySelector('textarea'))"
    wait_until(lambda: tab.evaluate(chosen))
    tab.call("Input.insertText", text=text)
    wait_until(lambda: page._text.value == text)


@browser_tests
def test_a_bad_script_shows_its_error_and_a_good_one_runs_to_its_end(tab: Tab, page: Page) -> None:
    tab.click("Scripts")
    write(tab, page, "foot,x\nleft,far")
    tab.click("run")
    wait_until(lambda: "script:1: the header lacks" in tab.fields)
    assert page.clock.view.mode is Mode.STEER
    write(tab, page, f"{','.join(footsteps.COLUMNS)}\nleft,0.1\nright,0.2\nleft,0.2")
    tab.click("run")
    wait_until(lambda: "the script is over" in tab.text)
    assert x_of(page) == pytest.approx(0.15, abs=0.05)
    assert "script:1" not in tab.fields


@browser_tests
def test_a_script_comes_from_a_file_and_a_drive_goes_into_one(
    tab: Tab, browser: Chromium, page: Page, tmp_path: Path
) -> None:
    mine = tmp_path / "mine.csv"
    text = f"{','.join(footsteps.COLUMNS)}\nleft,0.1\nright,0.1\n"
    mine.write_text(text, encoding="utf-8-sig")  # as spreadsheets write it
    tab.click("Scripts")
    tab.give(mine)
    wait_until(lambda: page._text.value == text)
    tab.click("run")
    wait_until(lambda: "the script is over" in tab.text)
    tab.click("the drive so far as a script")
    wait_until(lambda: page._text.value != text)
    tab.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
    tab.click("save")
    saved = tmp_path / "script.csv"
    wait_until(lambda: saved.is_file() and saved.read_text() == page._text.value)
    assert len(footsteps.load(saved, robots.load()).steps) >= 2


@browser_tests
def test_two_viewers_see_the_same_and_one_that_leaves_changes_nothing(
    tab: Tab, browser: Chromium, page: Page, port: int
) -> None:
    other = browser.open(f"http://127.0.0.1:{port}")
    wait_until(lambda: "real time" in other.text)
    wait_until(lambda: len(page._server.get_clients()) == 2)
    other.press("k")
    wait_until(lambda: x_of(page) < -0.1)
    other.call("Page.close")
    other.close()
    wait_until(lambda: len(page._server.get_clients()) == 1)
    at = x_of(page)
    wait_until(lambda: x_of(page) < at - 0.1)
    tab.press(" ")
    wait_until(lambda: not page.clock.view.steering.moves)


@browser_tests
def test_nothing_failed_and_nothing_came_from_outside(tab: Tab, port: int) -> None:
    """Comes last: it looks back on all requests of the page."""
    own = re.compile(rf"(http|ws)://127\.0\.0\.1:{port}(/|$)|data:|blob:http://127\.0\.0\.1:{port}/")
    assert tab.text
    assert len(tab.requests) >= 2
    assert [url[:100] for url in tab.requests.values() if not own.match(url)] == []
    assert tab.failed == []
    assert tab.errors == []


@browser_tests
def test_control_steps_are_short_under_a_busy_page(tab: Tab, page: Page, capsys: pytest.CaptureFixture[str]) -> None:
    tab.click("Watch")
    page._steer(ahead=1.0)
    time.sleep(HISTORY_SECONDS)
    pace = page.clock.pace
    with capsys.disabled():
        print(
            f"\ncontrol step: {pace.step_ms:.2f} ms, 99 %: {pace.step_p99_ms:.2f} ms, of work {pace.work_p99_ms:.2f} ms, "
            f"late by {pace.late_p99_ms:.2f} ms; {pace.factor:.2f} x real time"
        )
    # the browser draws in software and other programs run: only the work can be held to the 5 ms of an idle machine
    assert pace.work_p99_ms < 5.0
