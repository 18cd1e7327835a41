"""The evaluation's tasks: what their plans ask of the feet, against Table II's numbers and the scripts' own lines."""

import csv
import functools
import itertools
import math
import pathlib
import re
from collections.abc import Callable

import jax
import numpy as np
import pytest

from bipedtrack import planner, plans, sampling, scripts, suite
from bipedtrack.robot import Robot
from bipedtrack.suite import Batch, Level

EPISODES = 18  # once through the stairs' grid of 15, and on
SEED = 7
# All plans are of one shape, long enough for the longest task: eight squats of up to 1.5 s and then a hold of 60 s.
LONGEST = 72.0  # s
NAMES = ("stand", "squat", "walk-forward", "walk-backward", "sidle-left", "sidle-right", "turn-left", "turn-right")
BASE = (*NAMES, "stairs-up", "stairs-down")
HOLDS = tuple(f"hold-{how}{name}" for how in ("", "60s-") for name in BASE[1:])
DRAWN = pytest.mark.parametrize("name", [*BASE, *HOLDS])
Draw = Callable[..., Batch]


@pytest.fixture(scope="module")
def draw(robot: Robot, unoptimised: None) -> Draw:
    """Draws a task's batch: draw(name, episodes=18, seconds=72, seed=7, **ranges)."""

    def draw(name: str, episodes: int = EPISODES, seconds: float = LONGEST, seed: int = SEED, **ranges: tuple) -> Batch:
        return suite.batch(name, sampling.Ranges()._replace(**ranges), robot, episodes, seconds, seed)

    return draw


@pytest.fixture(scope="module")
def drawn(draw: Draw) -> Draw:
    """Batches of 18 episodes, drawn once."""
    return functools.cache(draw)


def feet(plan: plans.Plan) -> np.ndarray:
    """The foot that swings in each task step (episode, step), -1 where none does."""
    swing = plan.steps.swing
    assert set(np.unique(swing)) <= {0.0, 1.0} and swing.sum(axis=-1).max() <= 1
    return np.where(swing.any(axis=-1), swing.argmax(axis=-1), -1)


def ways(plan: plans.Plan) -> list[list[tuple[float, float, float, float]]]:
    """How the swing foot of every task step of every episode lands (ahead m, left m, up m, turned rad) off 0.2 m beside the
    other one, in the other one's frame."""
    swinging, end = feet(plan), plan.steps.end
    found = []
    for episode, step in itertools.product(*map(range, swinging.shape)):
        foot = swinging[episode, step]
        if foot < 0:
            continue
        ankles, yaws = end.ankle_positions[episode, step], end.ankle_yaws[episode, step]
        dx, dy, dz = (ankles[foot] - ankles[1 - foot]).tolist()
        yaw = float(yaws[1 - foot])
        along = math.cos(yaw) * dx + math.sin(yaw) * dy
        aside = math.cos(yaw) * dy - math.sin(yaw) * dx
        beside = 0.2 if foot == 0 else -0.2
        found.append((along, aside - beside, dz, float(yaws[foot]) - yaw))
    return found


def moving(plan: plans.Plan) -> np.ndarray:
    """Whether any node goes anywhere or turns in each task step (episode, step)."""
    pairs = zip(plan.steps.start, plan.steps.end, strict=True)
    return np.any([(a != b).reshape(*a.shape[:2], -1).any(axis=-1) for a, b in pairs], axis=0) | (feet(plan) >= 0)


# Breaks and footholds anywhere


@pytest.mark.parametrize(("name", "usual"), [("walk-breaks", "walk-forward"), ("stairs-breaks", "stairs-up")])
def test_breaks_pause_or_close_up_between_steps(drawn: Draw, name: str, usual: str) -> None:
    batch = drawn(name)
    rests = feet(batch.plan)[:, :16] < 0  # task steps of the first seconds
    assert not (feet(drawn(usual).plan)[:, :16] < 0).any()
    paused = rests.any(axis=1)
    assert 0.2 < paused.mean() < 0.9  # the others bring their feet together
    assert "pause" in batch.ranges
    for episode in np.flatnonzero(paused):  # and they go on after it
        assert not rests[episode, np.flatnonzero(rests[episode])[0] :].all()


def test_wandering_goes_anywhere_in_its_ellipse(drawn: Draw) -> None:
    ahead, aside, up, turned = np.array(ways(drawn("wander").plan)).T
    outwards = np.abs(aside)
    ranges = sampling.Ranges()
    # a foot turns about the middle between the feet, which moves it by up to 0.1 sin(0.25) m
    assert ranges.wander_x[0] - 0.025 <= ahead.min() < -0.05 and 0.15 < ahead.max() <= ranges.wander_x[2] + 0.025
    assert 0.08 < outwards.max() <= ranges.wander_y[2] + 0.004 and np.abs(up).max() < 1e-5
    assert 0.15 < np.abs(turned).max() <= ranges.wander_yaw[2] + 1e-4


# Names


def test_every_task_has_a_name_of_its_own() -> None:
    assert len(suite.TASKS) == len(set(suite.TASKS))
    more = {
        "wander",
        "walk-breaks",
        "stairs-breaks",
        "walk-forward-uniform",
        "stairs-up-uniform",
        "hold-wander",
        "hold-60s-wander",
    }
    assert set(suite.TASKS) == {*BASE, *HOLDS, *suite.BEYOND, *more, "obstacles", "composite"}


def test_an_episode_lasts_as_long_as_asked_and_a_hold_that_long_after_eight_steps() -> None:
    ranges = sampling.Ranges()
    for name in BASE:
        assert suite.duration(name, ranges, 10.0) == 10.0
        assert suite.duration(name, ranges, 3.5) == 3.5
    for name in BASE[1:]:
        # eight task steps of at most 0.7 s, or 1.5 s for a squat
        steps = 12.0 if name == "squat" else 5.6
        assert suite.duration(f"hold-{name}", ranges, 10.0) == pytest.approx(steps + 10)
        assert suite.duration(f"hold-{name}", ranges, 2.0) == pytest.approx(steps + 2)
        assert suite.duration(f"hold-60s-{name}", ranges, 10.0) == pytest.approx(steps + 60)
    slow = ranges._replace(period=(0.4, 0.5, 1.0), squat_period=(1.0, 2.0, 3.0))
    assert suite.duration("hold-sidle-left", slow, 10.0) == pytest.approx(18)
    assert suite.duration("hold-60s-squat", slow, 10.0) == pytest.approx(84)


# Seeds


def same(a: plans.Plan, b: plans.Plan) -> bool:
    """Whether two plans are the same but for rounding."""
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(x.shape == y.shape and np.abs(x - y).max() < 1e-4 for x, y in pairs)


def test_a_seed_gives_the_same_episodes_again_and_another_one_others(draw: Draw, drawn: Draw) -> None:
    first = drawn("walk-forward")
    again = draw("walk-forward")
    assert all((a == b).all() for a, b in zip(jax.tree.leaves(first.plan), jax.tree.leaves(again.plan), strict=True))
    assert again.sizes == first.sizes and again.ranges == first.ranges
    assert [level.label for level in again.levels] == [level.label for level in first.levels]
    other = draw("walk-forward", seed=SEED + 1)
    lifts, others = (batch.plan.steps.lift.sum(axis=-1) for batch in (first, other))
    assert (np.abs(lifts - others) > 1e-6).mean() > 0.99


def test_episodes_do_not_depend_on_how_many_there_are(draw: Draw, drawn: Draw) -> None:
    few, many = draw("stairs-down", episodes=3), drawn("stairs-down")
    assert same(few.plan, jax.tree.map(lambda leaf: leaf[:3], many.plan))
    assert [(level.label, level.episodes.tolist()) for level in few.levels] == [
        ("riser 0.05 m, tread 0.25 m", [0]),
        ("riser 0.08 m, tread 0.25 m", [1]),
        ("riser 0.11 m, tread 0.25 m", [2]),
    ]


def test_episodes_do_not_depend_on_which_other_tasks_there_are(
    draw: Draw, drawn: Draw, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(suite, "TASKS", ("walk-forward",))
    assert same(draw("walk-forward").plan, drawn("walk-forward").plan)


def test_no_two_episodes_and_no_two_tasks_are_drawn_alike(drawn: Draw) -> None:
    stepping = [name for name in (*BASE, *HOLDS) if re.search("walk|sidle|turn|stairs", name)]
    lifts = np.array([drawn(name).plan.steps.lift[:, 0].sum(axis=-1) for name in stepping])
    assert len(np.unique(lifts)) == lifts.size
    trunks = [name for name in (*BASE, *HOLDS) if re.search("stand|squat", name)]
    heights = np.array([drawn(name).plan.steps.start.trunk_position[:, 0, 2] for name in trunks])
    assert len(np.unique(heights)) == heights.size


# What each task draws


@pytest.mark.parametrize(
    ("name", "part", "least", "most"),
    [
        ("walk-forward", 0, 0.03, 0.25),
        ("walk-backward", 0, -0.15, -0.03),
        # one foot opens by twice the step of the trunk, the other closes up
        ("sidle-left", 1, 0.04, 0.24),
        ("sidle-right", 1, -0.24, -0.04),
        ("turn-left", 3, 0.05, 0.35),
        ("turn-right", 3, -0.35, -0.05),
    ],
)
def test_feet_go_the_tasks_own_way_within_its_range(name: str, part: int, least: float, most: float, drawn: Draw) -> None:
    plan = drawn(name).plan
    assert (feet(plan) >= 0).all()
    found = np.array(ways(plan)).reshape(EPISODES, -1, 4)
    mine = found[..., part]
    if "sidle" in name:
        assert np.abs(mine[:, 1::2]).max() < 1e-4
        mine = mine[:, ::2]
    # a step varies by a fifth from the episode's
    towards = 1 if most > 0 else -1
    near, far = sorted((abs(least), abs(most)))
    assert 0.8 * near - 1e-4 < (towards * mine).min() and (towards * mine).max() < 1.2 * far + 1e-4
    assert (towards * mine).min() < near + 0.3 * (far - near) and (towards * mine).max() > far - 0.3 * (far - near)
    others = [i for i in range(4) if i != part and not ("turn" in name and i < 2)]  # a turn's centre may be off the feet
    assert np.abs(found[..., others]).max() < 1e-4
    if "turn" in name:
        # the yaws only ever grow, or shrink, and the trunk turns with the feet
        assert (towards * np.diff(plan.steps.end.ankle_yaws, axis=1) >= 0).all()
        w, _, _, z = np.moveaxis(plan.steps.end.trunk_orientation.astype(np.float64), -1, 0)
        trunk, between = 2 * np.arctan2(z, w), plan.steps.end.ankle_yaws.mean(axis=-1)
        assert np.exp(1j * trunk) == pytest.approx(np.exp(1j * between), abs=1e-4)
    else:
        trunk = plan.steps.end.trunk_position - plan.steps.start.trunk_position
        assert (towards * trunk[..., part].sum(axis=1) > 1).all()


@pytest.mark.parametrize(("name", "way"), [("stairs-up", 1), ("stairs-down", -1)])
def test_stairs_go_one_way_through_the_whole_grid(name: str, way: int, drawn: Draw) -> None:
    batch = drawn(name)
    found = np.array(ways(batch.plan)).reshape(EPISODES, -1, 4)
    grid = list(itertools.product((0.25, 0.30, 0.35), (0.05, 0.08, 0.11, 0.14, 0.17)))
    for episode, steps in enumerate(found):
        tread, riser = grid[episode % 15]
        expected = np.broadcast_to([tread, 0, way * riser, 0], steps.shape)
        np.testing.assert_allclose(steps, expected, atol=1e-4)
    # nobody is sent below the ground within the default of 10 s, 25 task steps of 0.4 s
    starts, ends = (side.ankle_positions[:, :25, :, 2] - 0.04 for side in (batch.plan.steps.start, batch.plan.steps.end))
    assert min(starts.min(), ends.min()) > -1e-4
    assert batch.sizes == ((1.2, 2.0, 0.4),) * 3


@pytest.mark.parametrize("name", BASE[2:])
def test_periods_lifts_and_heights_are_table_iis(name: str, drawn: Draw) -> None:
    steps = drawn(name).plan.steps
    assert 0.4 - 1e-6 < steps.period.min() < 0.45 and 0.65 < steps.period.max() < 0.7 + 1e-6
    lift = steps.lift.sum(axis=-1)
    assert 0.8 * 0.04 - 1e-6 < lift.min() < 0.06 and 0.13 < lift.max() < 1.2 * 0.15 + 1e-6
    height = steps.end.trunk_position[..., 2] - steps.end.ankle_positions[..., 2].mean(axis=-1) + 0.04
    highest = 0.75 if "stairs" in name else 0.79
    assert 0.70 - 1e-4 < height.min() < 0.715 and highest - 0.015 < height.max() < highest + 1e-4


def test_a_stand_does_nothing_in_any_of_many_postures(drawn: Draw) -> None:
    plan = drawn("stand").plan
    assert not moving(plan).any()
    start = plan.steps.start
    assert np.ptp(start.trunk_position[:, 0, 2]) > 0.1
    apart = np.linalg.norm(start.ankle_positions[:, 0, 0, :2] - start.ankle_positions[:, 0, 1, :2], axis=-1)
    assert 0.17 - 1e-6 < apart.min() and apart.max() < math.hypot(0.3, 0.1) + 1e-6 and np.ptp(apart) > 0.05


def test_a_squat_moves_the_trunk_alone_within_table_ii(drawn: Draw) -> None:
    plan = drawn("squat").plan
    assert (feet(plan) == -1).all() and moving(plan).all()
    start, end = plan.steps.start, plan.steps.end
    assert (start.ankle_positions == end.ankle_positions).all() and (start.ankle_yaws == end.ankle_yaws).all()
    height = end.trunk_position[..., 2]
    assert 0.6 - 1e-5 < height.min() < 0.61 and 0.78 < height.max() < 0.79 + 1e-5
    assert 0.5 - 1e-6 < plan.steps.period.min() < 0.52 and 1.48 < plan.steps.period.max() < 1.5 + 1e-6


@DRAWN
def test_boxes_are_there_on_stairs_and_parked_elsewhere(name: str, drawn: Draw) -> None:
    batch = drawn(name)
    assert batch.plan.boxes.shape == (*batch.plan.steps.period.shape, 3, 7) and len(batch.sizes) == 3
    assert (batch.plan.boxes[..., 2] > -5).any() == ("stairs" in name)


def test_a_batch_says_in_words_what_it_is_drawn_from(drawn: Draw) -> None:
    words = {
        "stand": "stand: full ranges",
        "walk-backward": "walk: walk_step [-0.15, -0.03, -0.03]",
        "stairs-up": "stairs: risers [0.05, 0.08, 0.11, 0.14, 0.17] m x treads [0.25, 0.3, 0.35] m, feet lifted over edges",
        "hold-60s-turn-left": "turn: turn_yaw [0.05, 0.05, 0.35]; hold after 1-8 task steps",
    }
    assert {name: drawn(name).ranges for name in words} == words


# How long


@DRAWN
def test_plans_have_task_steps_to_the_end(name: str, drawn: Draw) -> None:
    assert drawn(name).plan.steps.period.astype(np.float64).sum(axis=1).min() > LONGEST - 1e-4


@pytest.mark.parametrize(
    ("name", "shortest", "seconds"),
    [("walk-forward", {"period": (0.4, 0.4, 0.4)}, LONGEST), ("squat", {"squat_period": (0.2, 0.2, 0.2)}, LONGEST / 2)],
)
def test_plans_of_the_shortest_task_steps_have_enough_of_them(name: str, shortest: dict, seconds: float, draw: Draw) -> None:
    periods = draw(name, seconds=seconds, **shortest).plan.steps.period.astype(np.float64)
    assert periods == pytest.approx(next(iter(shortest.values()))[0])
    assert periods.sum(axis=1).min() > seconds - 1e-4


@pytest.mark.parametrize("name", HOLDS)
def test_a_hold_stands_still_for_as_long_as_promised_after_one_to_eight_steps(name: str, drawn: Draw) -> None:
    plan = drawn(name).plan
    goes = moving(plan)
    before = goes.sum(axis=1)
    assert set(before) <= set(range(1, 9)) and len(set(before)) >= 5
    assert (goes == (np.arange(goes.shape[1]) < before[:, None])).all()  # and never again
    began = (plan.steps.period.astype(np.float64) * goes).sum(axis=1)
    lasts = suite.duration(name, sampling.Ranges(), 10.0) - began
    promised = 60 if "60s" in name else 10
    assert lasts.min() >= promised - 1e-4
    # what the robot is told
    for episode in (0, EPISODES - 1):
        one = jax.tree.map(lambda leaf, episode=episode: leaf[episode], plan)
        first = round(began[episode] / 0.005)
        last = first + round(promised / 0.005)
        numbers, ticks = plans.step_numbers(one, 0.005, last)
        commands = [
            planner.command(jax.tree.map(lambda leaf, n=numbers[i]: leaf[n], one.steps), np.float64(0.005 * ticks[i]))
            for i in np.linspace(first, last - 1, 20).astype(int)
        ]
        assert numbers[first] == before[episode] and ticks[first] == 0
        for command in commands:
            for part, known in zip(command.target, commands[0].target, strict=True):
                np.testing.assert_allclose(part, known, atol=1e-5)
            assert max(np.abs(part).max() for part in command.rates) < 1e-5
            assert (command.timer == 0).all()


# Levels


def ranged(label: str) -> tuple[float, float, str]:
    """The numbers and the unit of a label such as "12-18 cm a step"."""
    found = re.fullmatch(r"(\d+)-(\d+) (cm|deg) a step", label)
    assert found, label
    return float(found[1]), float(found[2]), found[3]


def mean_step(plan: plans.Plan, episode: int, turns: bool) -> float:
    """How far, cm, the swing foot of an episode's task steps goes on average, or how far, deg, it turns."""
    found = []
    for step, foot in enumerate(feet(plan)[episode]):
        if foot < 0:
            continue
        a, b = (
            (side.ankle_positions[episode, step, foot].astype(np.float64), float(side.ankle_yaws[episode, step, foot]))
            for side in (plan.steps.start, plan.steps.end)
        )
        found.append(math.degrees(abs(b[1] - a[1])) if turns else 100 * math.dist(a[0], b[0]))
    return math.fsum(found) / len(found)


def all_in_one_level_each(levels: tuple[Level, ...]) -> bool:
    return sorted(np.concatenate([level.episodes for level in levels])) == list(range(EPISODES))


@pytest.mark.parametrize("name", [name for name in (*BASE, *HOLDS) if re.search("walk|sidle|turn", name)])
def test_levels_are_thirds_from_short_steps_to_long_ones(name: str, drawn: Draw) -> None:
    batch = drawn(name)
    assert len(batch.levels) == 3 and all_in_one_level_each(batch.levels)
    assert [len(level.episodes) for level in batch.levels] == [6, 6, 6]
    reached = 0.0
    for level in batch.levels:
        steps = [mean_step(batch.plan, episode, "turn" in name) for episode in level.episodes]
        least, most, unit = ranged(level.label)
        assert unit == ("deg" if "turn" in name else "cm")
        assert abs(least - min(steps)) < 0.51 and abs(most - max(steps)) < 0.51
        assert reached <= min(steps)
        reached = max(steps)


@pytest.mark.parametrize("name", [name for name in (*BASE, *HOLDS) if "stairs" in name])
def test_levels_of_stairs_are_the_grids_cells_from_low_risers_to_high_ones(name: str, drawn: Draw) -> None:
    batch = drawn(name)
    assert len(batch.levels) == 15 and all_in_one_level_each(batch.levels)
    # of the first step, which is one riser up or down from beside the other foot
    start, end, foot = batch.plan.steps.start, batch.plan.steps.end, feet(batch.plan)[:, 0]
    way = np.array([end.ankle_positions[i, 0, foot[i]] - start.ankle_positions[i, 0, foot[i]] for i in range(EPISODES)])
    cells = []
    for level in batch.levels:
        found = re.fullmatch(r"riser (0\.\d\d) m, tread (0\.\d\d) m", level.label)
        assert found, level.label
        cells.append((float(found[1]), float(found[2])))
        mine = way[level.episodes]
        np.testing.assert_allclose(np.abs(mine[:, 2]), cells[-1][0], atol=1e-4)
        np.testing.assert_allclose(mine[:, 0], cells[-1][1], atol=1e-4)
    assert cells == sorted(set(cells))
    assert [len(level.episodes) for level in batch.levels if len(level.episodes) > 1] == [2, 2, 2]


@pytest.mark.parametrize("name", [name for name in (*BASE, *HOLDS) if re.search("stand|squat", name)])
def test_there_are_no_levels_where_no_foot_moves(name: str, drawn: Draw) -> None:
    assert drawn(name).levels == ()


# Scripts


def written(path: pathlib.Path) -> tuple[list[dict[str, str]], list[list[float]]]:
    """A script's lines by column, and its boxes: x, y, z, yaw, length, width, height."""
    lines = path.read_text(encoding="utf-8").splitlines()
    boxes = [[float(word) for word in line.split()[2:]] for line in lines if line.startswith("# box")]
    return list(csv.DictReader(line for line in lines if not line.startswith("#"))), boxes


@pytest.mark.parametrize("name", ["obstacles", "composite"])
def test_a_script_is_the_same_in_every_episode_and_as_it_is_written(name: str, robot: Robot) -> None:
    rows, boxes = written(scripts.ready()[name])
    batch = suite.batch(name, sampling.Ranges(), robot, 3, 10.0, SEED)
    steps = batch.plan.steps
    assert steps.period.shape == (3, len(rows) + 1)  # and at last the end is held
    assert all((leaf == leaf[:1]).all() for leaf in jax.tree.leaves(batch.plan))
    assert not moving(batch.plan)[:, -1].any()
    for number, row in enumerate(rows):
        assert steps.period[0, number] == pytest.approx(float(row["period"] or 0.55))
        assert steps.swing[0, number].tolist() == [row["foot"] == "left", row["foot"] == "right"]
        foot = ("left", "right", "both").index(row["foot"]) % 2
        for axis, column in enumerate(("x", "y")):
            if row[column]:
                assert steps.end.ankle_positions[0, number, foot, axis] == pytest.approx(float(row[column]))
    assert batch.sizes == tuple(tuple(box[4:]) for box in boxes)
    for pose, (x, y, z, yaw, _, _, height) in zip(np.moveaxis(batch.plan.boxes, 2, 0), boxes, strict=True):
        known = [x, y, z + height / 2, math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)]
        np.testing.assert_allclose(pose, np.broadcast_to(known, pose.shape), atol=1e-12)
    assert batch.ranges == f"footstep script {name}.csv" and batch.levels == ()


@pytest.mark.parametrize(("task", "ease"), [("walk-forward", 0.2), ("walk-forward-uniform", 0), ("stairs-up-uniform", 0)])
def test_only_what_says_so_has_swings_that_are_run_through_uniformly(robot: Robot, task: str, ease: float) -> None:
    drawn = suite.batch(task, sampling.Ranges(), robot, 4, 2.0, 0)
    assert (drawn.plan.steps.ease >= ease - 1e-6).all() and (drawn.plan.steps.ease <= ease + 0.1 * (ease > 0) + 1e-6).all()
    assert ("uniformly" in drawn.ranges) == (ease == 0)


@pytest.mark.parametrize("task", ["walk-forward", "hold-stairs-down", "squat"])
def test_trunks_sway_where_it_is_asked_for(robot: Robot, task: str) -> None:
    plain, swaying = (
        suite.batch(task, sampling.Ranges()._replace(sway=(sway,) * 3), robot, 4, 4.0, 0) for sway in (0.0, 1.0)
    )
    steps = swaying.plan.steps
    swings = steps.swing.any(axis=-1)
    assert (plain.plan.steps.pendulum == 0).all()
    assert ((steps.pendulum > 3) == swings).all()  # sqrt(g / 1 m) is 3.1 1/s
    assert [("sways" in batch.ranges) for batch in (plain, swaying)] == [False, True]
    ends = [np.asarray(batch.plan.steps.end.trunk_position) for batch in (plain, swaying)]
    assert (ends[0] == ends[1]).all()
