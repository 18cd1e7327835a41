"""Footstep scripts: their commands worked by hand, their defaults, and what any text and any file become."""

import itertools
import math
import re
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from walks import HEADER, RANGER, STAIRS, WALK, line_numbers, parse, problems

from bipedtrack import footsteps, kinematics, nodes, planner, robot, rotations
from bipedtrack.footsteps import ScriptError


def turned(target: np.ndarray, real: np.ndarray) -> float:
    """The angle, rad, between two orientations."""
    turn = rotations.multiply(rotations.conjugate(real), target)
    return float(np.linalg.norm(rotations.to_rotation_vector(turn)))


def balanced(end: nodes.Nodes) -> np.ndarray:
    """Where the trunk must be, (3,) m, for MuJoCo's centre of mass to stand over the middle of the same feet."""
    model = robot.build_model("ranger_max")
    data = mujoco.MjData(model)
    middle = end.ankle_positions.mean(axis=0)
    found = np.array([*middle[:2], end.trunk_position[2]])
    for _ in range(30):
        place = end._replace(trunk_position=found)
        joints = kinematics.inverse(RANGER, *nodes.ankles_in_trunk_frame(place))
        data.qpos[:] = np.concatenate([found, end.trunk_orientation, joints])
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        found = found + [*(middle[:2] - data.subtree_com[0][:2]), 0]
    assert -0.08 < found[0] - middle[0] < -0.03  # bent knees reach forward
    return found


def test_commands_of_a_script_worked_by_hand() -> None:
    script = parse(WALK, header="")
    assert script.lines == (3, 5, 6, 7)
    assert [step.period for step in script.steps] == pytest.approx([0.5, 0.6, 1.0, 0.25])
    assert footsteps.duration(script) == pytest.approx(2.35)
    assert all(part.dtype == np.float64 for step in script.steps for part in (*step.start, *step.end, *step[2:]))
    every = list(footsteps.commands(script, 0.005))
    assert len(every) == 470

    # the middle of the first step: the middle control point is half way, the curve is at its top, 0.06 m up;
    # the trunk, which goes from over (0, 0) to over the middle of 0.2 and 0, is half way there
    first, second = balanced(script.steps[0].start), balanced(script.steps[0].end)
    assert second[0] - first[0] == pytest.approx(0.1, abs=0.01) and [first[2], second[2]] == [0.75, 0.75]
    middle = every[50]
    np.testing.assert_allclose(middle.target.ankle_positions, [[0.1, 0.1, 0.1], [0, -0.1, 0.04]], atol=1e-12)
    np.testing.assert_allclose(middle.target.trunk_position, (first + second) / 2, atol=1e-3)
    np.testing.assert_allclose(middle.rates.trunk_velocity, (second - first) / 0.5, atol=4e-3)
    np.testing.assert_allclose(middle.timer, [0.25, 0], atol=1e-12)
    np.testing.assert_allclose(middle.end.ankle_positions, [[0.2, 0.1, 0.04], [0, -0.1, 0.04]], atol=1e-12)
    np.testing.assert_allclose(middle.end.trunk_position, second, atol=1e-3)

    # a third of the second step, 0.2 s of 0.6 s (0.602 s rounded): the yaw has come by 3/9 - 2/27 of its way
    third = every[100 + 40]
    assert third.target.ankle_yaws == pytest.approx([0, 0.2 * 7 / 27])
    np.testing.assert_allclose(third.target.trunk_position, second * 2 / 3 + np.array([0.32, 0.01, 0.7]) / 3, atol=1e-3)
    np.testing.assert_allclose(third.timer, [0, 0.4], atol=1e-12)
    np.testing.assert_allclose(every[160].target.ankle_positions[1, 2], 0.04 + 0.08, atol=1e-12)  # default lift

    # the bow begins where the second step ended and ends on defaults but for the given height and pitch
    start, end = every[220].target, script.steps[2].end
    np.testing.assert_allclose(start.trunk_position, [0.32, 0.01, 0.7], atol=1e-12)
    assert turned(start.trunk_orientation, rotations.from_euler(0.0, 0.1, 0.1)) < 1e-12
    np.testing.assert_allclose(end.trunk_position, balanced(end), atol=1e-3)
    assert end.trunk_position[2] == 0.68
    assert turned(end.trunk_orientation, rotations.from_euler(0.0, 0.15, 0.1)) < 1e-12
    np.testing.assert_array_equal(end.ankle_positions, script.steps[1].end.ankle_positions)
    assert not every[300].timer.any()
    way = end.trunk_position - [0.32, 0.01, 0.7]
    assert np.linalg.norm(every[300].rates.trunk_velocity) == pytest.approx(np.linalg.norm(way))

    # the hold: every target stays where the bow has put it
    for command in every[420:]:
        for held, left in zip(command.target, end, strict=True):
            np.testing.assert_allclose(held, left, rtol=0, atol=1e-15)
        assert max(np.abs(rate).max() for rate in command.rates) < 1e-12


def test_a_trunk_sways_across_the_stance_foot_where_it_is_asked_to() -> None:
    """Half way through the first step; along it, and where it alone moves, as everywhere without sway, it is uniform."""
    straight, swaying = (footsteps.parse(WALK, RANGER, "walk.csv", sway) for sway in (0.0, 1.0))
    step = swaying.steps[0]
    middle = planner.command(step, np.float64(0.25))
    assert middle.target.trunk_position[1] == pytest.approx(-0.1 + 0.1 / math.cosh(step.pendulum * 0.25), abs=1e-3)
    assert middle.rates.trunk_velocity[1] == pytest.approx(0, abs=6e-3)
    other = planner.command(straight.steps[0], np.float64(0.25))
    np.testing.assert_allclose(middle.target.trunk_position[::2], other.target.trunk_position[::2])
    np.testing.assert_allclose(middle.rates.trunk_velocity[::2], other.rates.trunk_velocity[::2])
    assert [step.pendulum > 0 for step in swaying.steps] == [True, True, False, False]
    assert [step.pendulum for step in straight.steps] == [0] * 4


def test_defaults() -> None:
    step, again, turn, bare, hold = parse("left\nright,0.1\nleft,,,,0.4\nboth,,,,,,,0.06\nboth").steps
    # stepping on the spot
    np.testing.assert_array_equal(step.end.ankle_positions, [[0, 0.1, 0.04], [0, -0.1, 0.04]])
    np.testing.assert_allclose(step.end.trunk_position, balanced(step.end), atol=1e-3)
    assert step.end.trunk_position[2] == 0.75
    np.testing.assert_array_equal(step.end.trunk_orientation, [1, 0, 0, 0])
    np.testing.assert_array_equal(step.swing, [1, 0])
    np.testing.assert_array_equal(step.lift, [0.08, 0])
    assert [s.period for s in (step, bare, hold)] == pytest.approx([0.55] * 3)
    # y and yaw stay, the centre of mass is midway, the trunk's yaw the mean
    np.testing.assert_allclose(again.end.ankle_positions[1], [0.1, -0.1, 0.04])
    np.testing.assert_allclose(again.end.trunk_position, balanced(again.end), atol=1e-3)
    assert turn.end.ankle_yaws == pytest.approx([0.4, 0])
    assert turned(turn.end.trunk_orientation, rotations.from_yaw(np.float64(0.2))) < 1e-12
    # one cell of the trunk moves it and leaves the rest to the defaults
    np.testing.assert_allclose(bare.end.trunk_position, [0.06, balanced(bare.end)[1], 0.75], atol=1e-3)
    assert not bare.swing.any()
    assert hold.end is bare.end
    # on the spot is where the foot is, not where it was
    np.testing.assert_allclose(parse("left,0.1,0.12\nleft").steps[1].end.ankle_positions[0], [0.1, 0.12, 0.04])


def test_a_hold_keeps_a_posture_that_is_not_the_default() -> None:
    leaning = parse("left,0.2,,,,,,0.12,0.02,0.7,0.05,0.1,0.1\nboth,,,,,0.1").steps
    for kept, left in zip(leaning[1].end, leaning[0].end, strict=True):
        np.testing.assert_array_equal(kept, left)
    np.testing.assert_array_equal(leaning[1].end.trunk_position, [0.12, 0.02, 0.7])


def test_yaw_counts_modulo_a_whole_turn_and_goes_the_shorter_way() -> None:
    yaws = [f"{side},{x},{y},0,{yaw}" for yaw in np.linspace(0.4, 6.8, 17) for side, x, y in (
        ("left", -0.1 * math.sin(yaw), 0.1 * math.cos(yaw)), ("right", 0.1 * math.sin(yaw), -0.1 * math.cos(yaw)),
    )]  # fmt: skip
    end = parse("\n".join(yaws)).steps[-1].end
    assert end.ankle_yaws == pytest.approx([6.8, 6.8])
    assert turned(end.trunk_orientation, rotations.from_yaw(np.float64(6.8))) < 1e-9
    trunk = parse(f"both,,,,,,,,,,,,{2 * math.pi + 0.1}").steps[0].end.trunk_orientation
    np.testing.assert_allclose(trunk, [math.cos(0.05), 0, 0, math.sin(0.05)])  # and not minus this
    step = parse(f"left,,,,{2 * math.pi + 0.3}").steps[0]
    assert step.end.ankle_yaws[0] == pytest.approx(0.3)
    assert turned(step.end.trunk_orientation, rotations.from_yaw(np.float64(0.15))) < 1e-9


def test_an_empty_height_is_that_of_the_ground() -> None:
    script = parse(STAIRS, header="")
    heights = [step.end.ankle_positions[:, 2] - RANGER.ankle_height for step in script.steps]
    np.testing.assert_allclose(heights, [[0, 0], [0, 0.1], [0.2, 0.1], [0.2, 0.2], [0.2, 0.2]], atol=1e-12)
    trunk = [step.end.trunk_position[2] for step in script.steps]
    np.testing.assert_allclose(trunk, [0.75, 0.8, 0.9, 0.95, 0.95])
    # the swing rises over the higher end
    top = max(c.target.ankle_positions[1, 2] for c in itertools.islice(footsteps.commands(script, 0.005), 110, 220))
    assert top == pytest.approx(0.04 + 0.1 + 0.08, abs=0.01)


def test_the_start_is_a_stand() -> None:
    qpos = footsteps.initial_qpos(RANGER)
    for real, wanted in zip(kinematics.measure(RANGER, qpos), footsteps.initial_nodes(RANGER), strict=True):
        np.testing.assert_allclose(real, wanted, atol=1e-9)
    first = footsteps.command_at(parse("left,0.1"), 0.0)
    for target, wanted in zip(first.target, footsteps.initial_nodes(RANGER), strict=True):
        np.testing.assert_array_equal(target, wanted)


@pytest.mark.parametrize("text", [WALK, STAIRS])
def test_inverse_kinematics_puts_the_feet_on_the_scripted_footholds(text: str) -> None:
    script = parse(text, header="")
    model = robot.build_model("ranger_max")
    data = mujoco.MjData(model)
    for step in script.steps:
        end = footsteps.planner.command(step, step.period).target
        # the target reaches the end of the step, and is in reach as it is
        ankles, yaws = nodes.ankles_in_trunk_frame(end)
        assert kinematics.reachable(RANGER, ankles, yaws, 1e-9)
        joints = kinematics.inverse(RANGER, ankles, yaws)
        data.qpos[:] = np.concatenate([end.trunk_position, end.trunk_orientation, joints])
        mujoco.mj_kinematics(model, data)
        feet = np.array([data.xpos[model.body(f"{leg}_foot").id] for leg in robot.LEGS])
        np.testing.assert_allclose(feet, step.end.ankle_positions, rtol=0, atol=1e-6)
        if abs(step.end.trunk_orientation[1:3]).max() < 1e-9:  # feet are level where the trunk is (eq 1)
            heading = np.array([data.xmat[model.body(f"{leg}_foot").id].reshape(3, 3)[:, 0] for leg in robot.LEGS])
            wanted = [[math.cos(yaw), math.sin(yaw), 0] for yaw in step.end.ankle_yaws]
            np.testing.assert_allclose(heading, wanted, rtol=0, atol=1e-6)


@pytest.mark.parametrize("text", [WALK, STAIRS])
def test_targets_go_on_smoothly_from_step_to_step(text: str) -> None:
    script = parse(text, header="")
    targets = [c.target for c in footsteps.commands(script, 0.005, footsteps.duration(script) + 0.1)]
    assert len(targets) == round(footsteps.duration(script) / 0.005) + 20
    # 0.55 m in 0.5 s, at most five times the mean speed at the ends of a fourth-order curve
    limits = {
        "trunk_position": 0.005,
        "trunk_orientation": 0.005,
        "ankle_positions": 0.03,
        "ankle_yaws": 0.005,
    }
    for name, limit in limits.items():
        path = np.array([getattr(target, name) for target in targets])
        assert np.abs(np.diff(path, axis=0)).max() < limit, name
    for before, after in itertools.pairwise(script.steps):
        assert after.start is before.end
    for end, target in zip(script.steps[-1].end, targets[-1], strict=True):
        np.testing.assert_allclose(target, end, atol=1e-12)


def test_the_clock_counts_whole_control_steps() -> None:
    script = parse("left,0.1,,,,0.41\nright,0.1,,,,0.4175\nboth,,,,,0.3")
    ticks = [82, 84, 60]  # 0.4175 s is half way between 83 and 84 control steps
    assert [round(step.period / 0.005) for step in script.steps] == ticks
    assert all(step.period == round(step.period / 0.005) * 0.005 for step in script.steps)
    every = list(footsteps.commands(script, 0.005))
    assert len(every) == sum(ticks)
    timers = np.array([command.timer for command in every])
    np.testing.assert_allclose(timers[:82, 0], 0.005 * np.arange(82, 0, -1), atol=1e-12)
    np.testing.assert_allclose(timers[82:166, 1], 0.005 * np.arange(84, 0, -1), atol=1e-12)
    assert not timers[:82, 1].any() and not timers[82:, 0].any() and not timers[166:].any()

    # the same by time, before the start and after the end too
    for tick, command in enumerate(every):
        at = footsteps.command_at(script, tick * 0.005)
        for a, b in zip((*at.target, *at.rates, at.timer), (*command.target, *command.rates, command.timer), strict=True):
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-9)
    assert footsteps.command_at(script, -1.0).timer[0] == pytest.approx(0.41)
    for late in (
        footsteps.command_at(script, 1e9),
        *itertools.islice(footsteps.commands(script, 0.005, 5.0), 226, 1000),
    ):
        np.testing.assert_allclose(late.target.ankle_positions, script.steps[-1].end.ankle_positions, atol=1e-15)
        assert not any(rate.any() for rate in late.rates) and not late.timer.any()
    assert len(list(footsteps.commands(script, 0.005, 0.1))) == 20
    assert len(list(footsteps.commands(script, 0.005, 5.0))) == 1000


def test_all_problems_are_listed_by_line() -> None:
    rows = "lfet\nleft,0.1,one\nright,x,,,,-1,-1\nleft,0.1,0.1\nright,0.1,-0.1\nleft,2\nboth\nright,0.2,,0.1\n"
    assert line_numbers(problems(HEADER + rows)) == [2, 3, 4, 4, 4, 7, 7, 9, 9]
    # with a box unread the ground is unknown, and nobody says where it is not
    assert line_numbers(problems(HEADER + rows + "# box 1")) == [2, 3, 4, 4, 4, 10]


def test_nothing_is_said_of_places_that_depend_on_an_unread_cell() -> None:
    on_a_box = "# box 0.4 0.1 0 0 0.4 0.2 0.1\n" + HEADER
    assert line_numbers(problems(on_a_box + "left,x,0.1,0.1\nright,0.3,-0.1")) == [3]
    assert line_numbers(problems(HEADER + "lfet,0.3,0.1\nright,0.6,-0.1\nright,0.8,-0.1")) == [2]
    # but of places that are known again
    assert line_numbers(problems(HEADER + "left,x\nleft,0.1,0.1,0.05\nright,1,-0.1")) == [2, 3, 4, 4]


def test_files(tmp_path: Path) -> None:
    path = tmp_path / "walk.csv"
    path.write_bytes(b"\xef\xbb\xbf" + WALK.encode())
    assert footsteps.load(path, RANGER).name == str(path)
    path.write_bytes(WALK.encode() + b"# b\xfcrste\n")
    with pytest.raises(ScriptError, match=r"walk\.csv:8: byte 0xfc is not UTF-8; save the file as UTF-8$"):
        footsteps.load(path, RANGER)
    with pytest.raises(ScriptError, match=r"none\.csv: cannot be read \(No such file or directory\); wanted a CSV file$"):
        footsteps.load(tmp_path / "none.csv", RANGER)
    with pytest.raises(ScriptError, match="cannot be read"):
        footsteps.load(tmp_path, RANGER)
    path.write_text(HEADER + "lfet")
    with pytest.raises(ScriptError, match=rf"^{re.escape(str(path))}:2: foot is"):
        footsteps.load(path, RANGER)


NUMBERS = st.one_of(st.just(""), st.floats(-0.6, 0.6).map(str), st.floats().map(str), st.text(max_size=5))
MILD = st.one_of(st.just(""), st.floats(-0.3, 0.5).map(lambda x: f"{x:.3f}"))
ROWS = st.one_of(
    st.tuples(st.sampled_from(["left", "right", "both", "", "x"]), st.lists(NUMBERS, max_size=13)),
    st.tuples(st.sampled_from(["left", "right"]), st.lists(MILD, max_size=3)),
).map(lambda row: ",".join((row[0], *row[1])))
BOXES = st.lists(st.one_of(MILD, NUMBERS), min_size=6, max_size=8).map(lambda words: "# box " + " ".join(words))


@settings(max_examples=150, deadline=None)
@given(st.one_of(st.text(), st.lists(st.one_of(ROWS, BOXES), max_size=5).map(lambda rows: HEADER + "\n".join(rows))))
@example(HEADER + "left,1e6,-1e6,1e6,1e6,1e6,1e6\nboth,,,,,1e6,,1e6,1e6,1e6,1e6,1e6,1e6")
@example(HEADER + "left,\x00\x85\u2028,\ud800")
def test_any_text_is_a_script_or_a_script_error(text: str) -> None:
    with np.errstate(over="raise", divide="raise", invalid="raise"):
        try:
            script = footsteps.parse(text, RANGER, "walk.csv")
        except ScriptError as error:
            assert all(re.match(r"walk\.csv(:\d+)?: .*[;:?]", line) for line in str(error).split("\n"))
            return
        for step in script.steps:
            command = footsteps.planner.command(step, step.period / 2)
            assert all(np.isfinite(part).all() for part in (*command.target, *command.rates, command.timer))
            ankles, yaws = nodes.ankles_in_trunk_frame(command.target)
            assert kinematics.reachable(RANGER, ankles, yaws, 2e-3)


def test_any_bytes_are_a_script_or_a_script_error(tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.mktemp("fuzz") / "walk.csv"

    @settings(max_examples=50, deadline=None)
    @given(st.binary())
    def check(content: bytes) -> None:
        path.write_bytes(content)
        with pytest.raises(ScriptError):
            footsteps.load(path, RANGER)

    check()


def test_footsteps_need_neither_jax_nor_mujoco() -> None:
    code = "import sys; sys.modules.update(jax=None, mujoco=None, brax=None, flax=None); import bipedtrack.footsteps"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


# Feet in the air


def test_a_foot_that_is_up_stays_there_and_the_trunk_stands_over_the_other_one() -> None:
    up, hold, down = parse("left up,0.1,,0.12,,0.6,0\nboth,,,,,2\nleft,0,,,,0.6").steps
    np.testing.assert_allclose(up.end.ankle_positions, [[0.1, 0.1, 0.16], [0, -0.1, 0.04]], atol=1e-12)
    np.testing.assert_array_equal([up.swing, hold.swing, down.swing], [[1, 0], [0, 0], [1, 0]])
    # lifted by 0 it goes straight
    np.testing.assert_allclose(planner.command(up, np.float64(0.3)).target.ankle_positions[0], [0.05, 0.1, 0.1], atol=1e-12)
    assert hold.end is up.end
    data = mujoco.MjData(robot.build_model("ranger_max"))
    joints = kinematics.inverse(RANGER, *nodes.ankles_in_trunk_frame(up.end))
    data.qpos[:] = np.concatenate([up.end.trunk_position, up.end.trunk_orientation, joints])
    mujoco.mj_kinematics(data.model, data)
    mujoco.mj_comPos(data.model, data)
    np.testing.assert_allclose(data.subtree_com[0][:2], [0, -0.1], atol=2e-3)
    np.testing.assert_allclose(down.end.ankle_positions, [[0, 0.1, 0.04], [0, -0.1, 0.04]], atol=1e-12)


def test_a_jump_moves_both_feet_at_once_about_their_middle() -> None:
    jump, spot = parse("jump,0.3,0.05,,0.5,0.3,0.07,,,0.72\njump").steps
    np.testing.assert_array_equal(jump.swing, [1, 1])
    np.testing.assert_array_equal(jump.lift, [0.07, 0.07])
    sine, cosine = 0.1 * math.sin(0.5), 0.1 * math.cos(0.5)
    landing = [[0.3 - sine, 0.05 + cosine, 0.04], [0.3 + sine, 0.05 - cosine, 0.04]]
    np.testing.assert_allclose(jump.end.ankle_positions, landing, atol=1e-12)
    assert jump.end.ankle_yaws == pytest.approx([0.5, 0.5]) and jump.end.trunk_position[2] == 0.72
    flight = planner.command(jump, np.float64(0.15))
    assert flight.target.ankle_positions[:, 2] == pytest.approx([0.11, 0.11]) and flight.timer == pytest.approx([0.15, 0.15])
    np.testing.assert_allclose(spot.end.ankle_positions, landing, atol=1e-12)
