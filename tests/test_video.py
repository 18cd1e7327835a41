"""Films of a trace made by hand: what is in the files, and how bad input is refused."""

import os
import subprocess
import sys
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from filmed import SCRIPT, SIZE, Rendered, differences, green, moved, walk, yellow
from PIL import Image

from bipedtrack import control, doctor, evaluate, observation, policy, sampling, suite, video
from bipedtrack import robot as robots

ROOT = Path(__file__).resolve().parent.parent


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
    batch = suite.batch("stairs-up", sampling.Ranges(), robots.load(), 5, 0.2, evaluate.SEED)
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
    with pytest.raises(video.VideoError, match="it is a folder"):
        video.require_writable(tmp_path / "walk.gif")
