"""Films of a trace made by hand: what is in the pictures, what is in the files, and how bad input is refused.

A process renders with one back end for all its life, so pictures come from a process of their own (`rendered`).
"""

import concurrent.futures
import dataclasses
import multiprocessing
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from bipedtrack import control, doctor, evaluate, footsteps, kinematics, observation, policy, suite, tasks, video
from bipedtrack import robot as robots
from bipedtrack.nodes import Nodes, ankles_in_trunk_frame
from bipedtrack.planner import Command
from bipedtrack.trace import Trace

ROOT = Path(__file__).resolve().parent.parent
SIZE = (240, 180)
SCRIPT = "\n".join([",".join(footsteps.COLUMNS), "left,0.15,,,0.3,0.4", "right,0.30,,,,0.4", "both,,,,,0.2"])


# A robot that follows its script exactly, without physics


def walk() -> Trace:
    """One second of walking on target: two steps and a stop."""
    robot = robots.load()
    script = footsteps.parse(SCRIPT, robot, "walk")
    commands = list(footsteps.commands(script, robot.timestep))
    qpos = np.array([posture(robot, command) for command in commands])
    joints = np.zeros((len(qpos), 12))
    return Trace(
        time=np.arange(len(qpos)) * robot.timestep,
        qpos=qpos,
        qvel=np.zeros((len(qpos), 18)),
        target=stacked([command.target for command in commands]),
        measured=stacked([kinematics.measure(robot, q) for q in qpos]),
        timer=np.array([command.timer for command in commands]),
        still=np.zeros(len(qpos), bool),
        feedback=joints,
        joint_targets=joints,
        torques=joints,
        foot_forces=np.zeros((len(qpos), 2)),
        alive=np.ones(len(qpos), bool),
    )


def posture(robot: robots.Robot, command: Command) -> np.ndarray:
    joints = kinematics.inverse(robot, *ankles_in_trunk_frame(command.target))
    return np.concatenate([command.target.trunk_position, command.target.trunk_orientation, joints])


def stacked(each: list[Nodes]) -> Nodes:
    return Nodes(*(np.array(part) for part in zip(*each, strict=True)))


def moved(nodes: Nodes, by: tuple[float, float, float]) -> Nodes:
    return nodes._replace(trunk_position=nodes.trunk_position + by, ankle_positions=nodes.ankle_positions + by)


def without_traces(recorded: Trace) -> Trace:
    """The same with all nodes far below the ground."""
    return recorded._replace(target=moved(recorded.target, (0, 0, -50)), measured=moved(recorded.measured, (0, 0, -50)))


# The process that renders

Rendered = Callable[..., Any]


@pytest.fixture(scope="module")
def rendered() -> Iterator[Rendered]:
    """Calls a function of this module where mujoco renders; skips where no back end does."""
    spawn = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(1, mp_context=spawn) as process:
        try:
            assert process.submit(video.choose_backend).result() in ("egl", "osmesa", "glfw", os.environ.get("MUJOCO_GL"))
        except video.VideoError as error:
            pytest.skip(str(error))
        yield lambda function, *arguments: process.submit(function, *arguments).result()


def write_films(folder: Path) -> None:
    model, robot, recorded = robots.build_model("ranger_max"), robots.load(), walk()
    recorded = recorded._replace(measured=moved(recorded.measured, (0, 0, 0.1)))  # both traces are seen
    counts = [video.film(model, robot, recorded, folder / f"walk{suffix}", size=SIZE) for suffix in video.SUFFIXES]
    assert counts == [30, 30, 6]


@pytest.fixture(scope="module")
def films(rendered: Rendered, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the walk as walk.mp4, walk.gif and walk.png."""
    folder = tmp_path_factory.mktemp("films")
    rendered(write_films, folder)
    assert sorted(f.name for f in folder.iterdir()) == ["walk.gif", "walk.mp4", "walk.png"]
    return folder


def pictures(recorded: Trace, ticks: list[int], sizes: list[tuple[float, float, float]], boxes: Any) -> np.ndarray:
    model = robots.build_model("ranger_max", sizes)
    before = model.vis.quality.shadowsize, model.vis.global_.offwidth
    found = np.array(list(video.render(model, robots.load(), recorded, np.array(ticks), boxes, SIZE)))
    assert (model.vis.quality.shadowsize, model.vis.global_.offwidth) == before
    return found


def green(picture: np.ndarray) -> np.ndarray:
    """Where a picture (height, width, 3) has the colour of targets, (height, width) bool."""
    red, green, blue = np.moveaxis(picture.astype(int), -1, 0)
    return (green > 160) & (red < green - 90) & (blue < green - 90)


def yellow(picture: np.ndarray) -> np.ndarray:
    """Where it has the colour of measured nodes; the prints' orange has less green."""
    red, green, blue = np.moveaxis(picture.astype(int), -1, 0)
    return (np.minimum(red, green) > 170) & (blue < green - 90)


def differences(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The largest difference of the three channels, for each pixel."""
    return np.abs(a.astype(int) - b).max(axis=-1)


# Pictures


def test_targets_are_green_and_measured_nodes_yellow(rendered: Rendered) -> None:
    recorded = walk()
    apart = recorded._replace(measured=moved(recorded.measured, (0, 0, 0.25)))
    (plain,) = rendered(pictures, without_traces(recorded), [199], [], None)
    start, both = rendered(pictures, apart, [0, 199], [], None)
    for color in (green, yellow):
        assert color(both).sum() > 20
        assert not color(plain).any() and not color(start).any()  # at the start nothing is behind the robot yet
    rows = [np.nonzero(color(both))[0].mean() for color in (yellow, green)]
    assert rows[0] < rows[1] - 8  # counted downwards


def test_traces_last_two_seconds() -> None:
    n = 1000
    line = Nodes(np.arange(3 * n).reshape(n, 3), np.zeros((n, 4)), np.arange(6 * n).reshape(n, 2, 3), np.zeros((n, 2)))
    early, late, next_one = (video._tail(line, tick, 0.005) for tick in (30, 777, 778))
    np.testing.assert_array_equal(early[:, 0], [[0, 1, 2], [0, 1, 2], [3, 4, 5]])
    np.testing.assert_array_equal(early[:, -1], [[90, 91, 92], [180, 181, 182], [183, 184, 185]])
    assert 377 <= late[0, 0, 0] / 3 < 377 + 7
    # what lies behind stays, while the end moves on
    assert set(late[0, :-1, 0]) < set(next_one[0, :, 0])


def test_the_robot_is_in_the_middle_wherever_it_goes(rendered: Rendered) -> None:
    recorded = without_traces(walk())
    (here,) = rendered(pictures, recorded, [100], [], None)
    (there,) = rendered(pictures, recorded._replace(qpos=recorded.qpos + [7, -3, *17 * [0]]), [100], [], None)
    assert here.shape == (180, 240, 3) and here.dtype == np.uint8
    for picture in (here, there):
        rows, columns = np.nonzero(picture.max(axis=-1) < 75)  # its dark shells; shadows are lighter
        assert len(rows) > 200
        assert abs(columns.mean() - 120) < 15 and abs(rows.mean() - 90) < 25
    # the chequered floor repeats itself, and the shadow comes along
    assert (differences(here, there) > 40).sum() < 50


def test_footholds_are_printed_from_before_the_swing(rendered: Rendered) -> None:
    recorded = walk()  # its right foot begins to swing after 0.4 s
    (with_prints,) = rendered(pictures, recorded, [0], [], None)
    (without,) = rendered(pictures, recorded._replace(timer=np.zeros((200, 2))), [0], [], None)
    changed = with_prints[differences(with_prints, without) > 60].astype(int)
    blue, orange = changed[:, 2] > changed[:, 0] + 60, changed[:, 0] > changed[:, 2] + 60
    assert blue.sum() > 15 and orange.sum() > 15


def test_a_print_needs_ground(rendered: Rendered) -> None:
    """On a tread that is not there, a print would hang in the air."""
    high = walk()._replace(target=moved(walk().target, (0, 0, 0.2)))
    tread, pose = [(2.0, 2.0, 0.2)], np.array([[0.0, 0, 0.1, 1, 0, 0, 0]])
    parked = pose - [0, 0, 10, 0, 0, 0, 0]
    no_timer = high._replace(timer=np.zeros((200, 2)))
    for boxes, wanted in ((pose, True), (parked, False)):
        with_prints, without = (rendered(pictures, each, [0], tread, boxes)[0] for each in (high, no_timer))
        assert (differences(with_prints, without).max() > 60) == wanted


def test_boxes_stand_where_they_are_put_and_may_move(rendered: Rendered) -> None:
    recorded = without_traces(walk())
    poses = np.tile([0.5, 0.5, 0.2, 1.0, 0, 0, 0], (200, 1, 1))
    poses[100:, 0, 2] = -10
    sizes = [(0.4, 0.4, 0.4)]
    there, gone = rendered(pictures, recorded, [99, 100], sizes, poses)
    (stays,) = rendered(pictures, recorded, [100], sizes, poses[0])
    (empty,) = rendered(pictures, recorded, [100], [], None)
    assert differences(gone, empty).max() < 5
    assert (differences(stays, empty) > 30).sum() > 500
    assert differences(there, stays).mean() < 2


def test_boxes_and_traces_of_other_shapes_are_refused(rendered: Rendered) -> None:
    with pytest.raises(ValueError, match=r"boxes have shape \(3, 7\); wanted \(1, 7\) or \(200, 1, 7\)"):
        rendered(pictures, walk(), [0], [(1, 1, 1)], np.zeros((3, 7)))
    with pytest.raises(ValueError, match=r"shape \(2, 200, 19\); wanted \(200, 19\)"):
        rendered(pictures, walk()._replace(qpos=np.zeros((2, 200, 19))), [0], [], None)


def test_the_camera_follows_smoothly() -> None:
    path = np.outer(np.arange(1000), [0.01, 0, 0])
    smooth = video._smoothed(path, 200)
    assert smooth.shape == path.shape
    np.testing.assert_allclose(smooth[100:900], path[100:900] - [0.005, 0, 0], atol=1e-9)
    np.testing.assert_allclose(video._smoothed(np.ones((7, 3)), 200), 1)


# Footholds


def test_each_swing_ends_on_its_foothold(robot: robots.Robot) -> None:
    left, right = video.footholds(walk(), robot.ankle_height)
    assert (left.foot, left.begin, right.foot, right.begin) == (0, 0, 1, pytest.approx(0.4))
    assert (left.touchdown, right.touchdown) == (pytest.approx(0.4), pytest.approx(0.8))
    np.testing.assert_allclose(left.position, [0.15, 0.1, 0], atol=1e-12)
    np.testing.assert_allclose(right.position, [0.30, -0.1, 0], atol=1e-12)
    assert (left.yaw, right.yaw) == (pytest.approx(0.3), 0)


def test_a_foot_that_swings_twice_in_a_row_has_two_footholds_and_an_unfinished_swing_none(robot: robots.Robot) -> None:
    recorded = walk()
    timer = np.zeros((200, 2))
    timer[20:60, 1] = np.arange(40, 0, -1) * 0.005
    timer[60:100, 1] = np.arange(40, 0, -1) * 0.005
    timer[150:, 0] = np.arange(60, 10, -1) * 0.005
    found = video.footholds(recorded._replace(timer=timer), robot.ankle_height)
    assert [(f.foot, round(f.begin / 0.005), round(f.touchdown / 0.005)) for f in found] == [(1, 20, 60), (1, 60, 100)]


# Files


def test_mp4_is_h264_of_thirty_frames_a_second(films: Path) -> None:
    reader = imageio_ffmpeg.read_frames(str(films / "walk.mp4"))
    about = next(reader)
    frames = [np.frombuffer(frame, np.uint8).reshape(180, 240, 3) for frame in reader]
    assert (about["size"], about["fps"], about["duration"]) == (SIZE, 30, 1)
    assert about["codec"] == "h264" and about["pix_fmt"].startswith("yuv420p")
    assert len(frames) == 30
    check_frames(np.array(frames))


def test_gif_plays_in_real_time(films: Path) -> None:
    with Image.open(films / "walk.gif") as gif:
        frames, delays = [], []
        for i in range(gif.n_frames):
            gif.seek(i)
            frames.append(np.array(gif.convert("RGB")))
            delays.append(gif.info["duration"])
    assert len(frames) == 30 and sum(delays) == 1000 and set(delays) == {30, 40}
    check_frames(np.array(frames))


def check_frames(frames: np.ndarray) -> None:
    """The frames of the walk change, and at its end show traces and the robot."""
    for before, after in zip(frames[:-4], frames[1:-3], strict=True):  # in the end the robot stands
        assert (differences(before, after) > 20).sum() > 20
    assert green(frames[-1]).sum() > 5 and yellow(frames[-1]).sum() > 5
    assert (frames[-1].max(axis=-1) < 75).sum() > 200


def test_png_is_a_strip_of_six_upright_pictures(films: Path) -> None:
    with Image.open(films / "walk.png") as image:
        strip = np.array(image)
    assert strip.shape == (180, 6 * 112, 3)
    tiles = np.split(strip, 6, axis=1)
    for before, after in zip(tiles[:-1], tiles[1:], strict=True):
        assert differences(before, after).max() > 60


def film_a_fall(path: Path) -> int:
    recorded = walk()
    recorded.alive[50:] = False
    recorded.qpos[50:] = np.nan
    return video.film(robots.build_model("ranger_max"), robots.load(), recorded, path, size=SIZE)


def test_a_film_ends_with_the_fall(rendered: Rendered, tmp_path: Path) -> None:
    assert rendered(film_a_fall, tmp_path / "fall.gif") == 8
    with Image.open(tmp_path / "fall.gif") as gif:
        assert gif.n_frames == 8


def film_with_wrong_boxes(path: Path) -> None:
    video.film(robots.build_model("ranger_max"), robots.load(), walk(), path, boxes=np.zeros((3, 7)), size=SIZE)


@pytest.mark.parametrize("suffix", video.SUFFIXES)
def test_an_error_leaves_the_old_file_alone(rendered: Rendered, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"walk{suffix}"
    path.write_text("old")
    with pytest.raises(ValueError, match="boxes"):
        rendered(film_with_wrong_boxes, path)
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_why_ffmpeg_gave_up_is_told(tmp_path: Path) -> None:
    frames = (np.zeros((180, 240, 3), np.uint8) for _ in range(300))
    with pytest.raises(OSError, match="ffmpeg ended with status .*No such file"):
        video._write_mp4(tmp_path / "missing" / "x", frames, SIZE, 30)


def test_without_ffmpeg_the_package_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(video.VideoError, match="imageio-ffmpeg"):
        video.require_writable(tmp_path / "walk.mp4")
    video.require_writable(tmp_path / "walk.gif")
    assert list(tmp_path.iterdir()) == []


# Back ends


@pytest.fixture
def no_mujoco(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if mujoco were not imported yet, on Linux without a screen and with MUJOCO_GL unset."""
    monkeypatch.delitem(sys.modules, "mujoco")
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setenv("MUJOCO_GL", "")  # put back afterwards, whatever the test sets


@pytest.mark.usefixtures("no_mujoco")
@pytest.mark.parametrize(
    ("asked", "working", "chosen"),
    [("", "egl osmesa", "egl"), ("", "osmesa", "osmesa"), ("osmesa", "egl osmesa", "osmesa")],
)
def test_the_first_back_end_that_renders_is_chosen(
    monkeypatch: pytest.MonkeyPatch, asked: str, working: str, chosen: str
) -> None:
    monkeypatch.setenv("MUJOCO_GL", asked)
    monkeypatch.setattr(
        doctor, "rendering_complaints", lambda names: {n: "" if n in working.split() else "no" for n in names}
    )
    assert video.choose_backend() == chosen == os.environ["MUJOCO_GL"]


@pytest.mark.usefixtures("no_mujoco")
def test_where_nothing_renders_every_reason_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "rendering_complaints", lambda names: {name: f"no lib{name}" for name in names})
    with pytest.raises(video.VideoError, match="MUJOCO_GL=egl: no libegl; MUJOCO_GL=osmesa: no libosmesa.*wanted EGL"):
        video.choose_backend()


def test_a_choice_that_comes_too_late_is_refused() -> None:
    assert "mujoco" in sys.modules
    with pytest.raises(video.VideoError, match="imported already"):
        video.choose_backend()


def test_importing_the_module_leaves_the_choice_open() -> None:
    program = "import sys, bipedtrack.video; print([m for m in ('mujoco', 'jax', 'PIL') if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", program], capture_output=True, text=True).stdout == "[]\n"


# The command line


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with policy.npz, whose feedback is zero, and walk.csv."""
    folder = tmp_path_factory.mktemp("inputs")
    zeros = policy.Network(
        mean=np.zeros(observation.SIZE, np.float32),
        std=np.ones(observation.SIZE, np.float32),
        weights=(np.zeros((observation.SIZE, 12), np.float32),),
        biases=(np.zeros(12, np.float32),),
    )
    policy.save(policy.Policy(zeros, "swish", control.ControlConfig(), 0.02, robots.load(), {}), folder / "policy.npz")
    (folder / "walk.csv").write_text(SCRIPT)
    return folder


def run(
    inputs: Path, *arguments: str, what: str = "--script walk.csv", backend: str | None = None
) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "bipedtrack.video", "policy.npz", *what.split(), *arguments]
    environment = os.environ | {"PYTHONPATH": str(ROOT)} | ({"MUJOCO_GL": backend} if backend else {})
    return subprocess.run(command, cwd=inputs, env=environment, capture_output=True, text=True, timeout=120)


@pytest.mark.usefixtures("rendered")
def test_command_line_films_a_script(inputs: Path, tmp_path: Path) -> None:
    out = tmp_path / "walk.gif"
    found = run(inputs, "--out", str(out), "--seconds", "0.2", "--size", "64", "48", "--fps", "20", "--no-feedback")
    assert found.returncode == 0, found.stderr
    assert "mean error" in found.stdout and f"{out}: 4 pictures" in found.stdout
    with Image.open(out) as gif:
        assert gif.size == (64, 48) and gif.n_frames == 4


@pytest.mark.usefixtures("rendered")
def test_command_line_films_the_evaluations_own_episode(inputs: Path, tmp_path: Path) -> None:
    out = tmp_path / "stairs.png"
    found = run(inputs, "--out", str(out), "--seconds", "0.2", "--size", "64", "48", what="--task stairs-up --episode 4")
    assert found.returncode == 0 and found.stdout.startswith("0.2 s, no fall; mean error: ankles "), found.stderr
    # the fifth cell of the grid has the highest riser, and the evaluation's trace starts where the film does
    batch = suite.batch("stairs-up", tasks.Ranges(), robots.load(), 5, 0.2, evaluate.SEED)
    assert batch.plan.steps.end.ankle_positions[4, 0, :, 2].max() == pytest.approx(0.04 + 0.17)
    with Image.open(out) as strip:
        assert strip.size == (6 * 30, 48)


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("--task fly", "--task fly: no such task; there are: stand, squat"),
        ("--task stand --script walk.csv", "name what to film: either --task or --script"),
        ("", "name what to film: either --task or --script"),
        ("--task stand --episode -1", "--episode -1: must be from 0 to 9999"),
    ],
)
@pytest.mark.usefixtures("rendered")
def test_what_cannot_be_filmed_is_refused_in_one_line(inputs: Path, what: str, message: str) -> None:
    check_refusal(run(inputs, "--out", "walk.gif", what=what), message)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--out walk.avi", "walk.avi: the suffix '.avi' is unknown; wanted one of .mp4, .gif, .png"),
        ("--out missing/walk.gif", "missing/walk.gif: cannot be written: No such file or directory"),
        ("--out walk.csv/walk.gif", "walk.csv/walk.gif: cannot be written: Not a directory"),
        ("--out walk.mp4 --size 65 48", "walk.mp4: 65 x 48 pixels do not fit"),
        ("--out walk.gif --seconds 0", "--seconds 0.0: must be at least"),
        ("--out walk.gif --seconds nan", "--seconds nan: must be at least"),
        ("--out walk.gif --fps 0", "--fps 0: must be from"),
        ("--out walk.gif --size 8 48", "--size 8 48: both must be from"),
    ],
)
def test_bad_input_is_refused_in_one_line(inputs: Path, arguments: str, message: str) -> None:
    before = sorted(inputs.iterdir())
    found = run(inputs, *arguments.split())
    check_refusal(found, message)
    assert sorted(inputs.iterdir()) == before


def test_a_back_end_that_is_missing_is_told_in_one_line(inputs: Path) -> None:
    found = run(inputs, "--out", "walk.gif", backend="nonsense")
    check_refusal(found, "nothing renders here (MUJOCO_GL=nonsense:")
    assert not (inputs / "walk.gif").exists()


def check_refusal(found: subprocess.CompletedProcess[str], message: str) -> None:
    assert found.returncode == 2 and found.stdout == ""
    assert found.stderr.startswith(f"bipedtrack: {message}")
    assert found.stderr.count("\n") == 1


def test_a_directory_is_no_place_for_a_film(tmp_path: Path) -> None:
    (tmp_path / "walk.gif").mkdir()
    with pytest.raises(video.VideoError, match="is a directory"):
        video.require_writable(tmp_path / "walk.gif")


def test_options_have_the_defaults_of_the_manual() -> None:
    defaults = {field.name: field.default for field in dataclasses.fields(video.Video)}
    assert (defaults["size"], defaults["fps"], defaults["feedback"]) == ((640, 480), 30, True)
