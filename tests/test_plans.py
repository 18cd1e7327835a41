"""Plans against the functions they are made of, walked through one control step at a time."""

import functools
import itertools
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from walks import HEADER

from bipedtrack import footsteps, planner, plans, rotations, sampling, tasks, terrain
from bipedtrack.nodes import Nodes
from bipedtrack.planner import Command, TaskStep
from bipedtrack.plans import PLANNED, Plan, library, mirrored, script_plan, step_numbers, with_scripts
from bipedtrack.robot import Robot

STEPS = 7
# kind, share of the stairs that go down, number of task steps before a hold
CASES = {
    **{kind: (kind, 0.0, None) for kind in sampling.KINDS},
    "stairs down": ("stairs", 1.0, None),
    "walk and hold": ("walk", 0.0, 3),
    "stairs and hold": ("stairs", 0.0, 4),
}
ALL_CASES = pytest.mark.parametrize("case", CASES)

BOXES = """# box 0.9 0.05 0 0.3 0.4 0.6 0.02
# box -0.8 0.4 0.1 0 0.3 0.2 0.5
"""
SCRIPT = """left,0.2,0.1,0,0,0.5,0.06
right,0.4,-0.1,0,0.2,0.602,,0.32,0.01,0.7,0,0.1,0.1
both,,,,,0.4
left,0.5,0.1,,0.3,0.45
"""
BOW = "both,,,,,1,,,,0.68,,0.15,0.2\n"


class Laid(NamedTuple):
    """Random plans and what they should be, with the leading axis of CASES."""

    plan: Plan
    first: Nodes
    steps: TaskStep
    boxes: np.ndarray


def at(tree: Any, index: Any) -> Any:
    return jax.tree.map(lambda leaf: leaf[index], tree)


@pytest.fixture(scope="module")
def laid(robot: Robot, unoptimised: None) -> Laid:
    """A random plan of each case, and its steps one by one: a key for the beginning and then one for each task step."""

    def distribution(kind: str, down: float, hold: int | None) -> sampling.Distribution:
        shares = sampling.Shares(**{name: float(name == kind) for name in sampling.KINDS})
        after = (hold or 1, hold or 8)
        ranges = sampling.Ranges()._replace(sway=(1.0, 1.0, 1.0))
        return sampling.distribution(ranges, shares, 1.0, float(hold is not None), after, down)

    given = jax.tree.map(lambda *leaves: np.stack(leaves), *(distribution(*case) for case in CASES.values()))
    keys = jax.random.split(jax.random.PRNGKey(3), len(CASES))
    draw = jax.jit(jax.vmap(lambda key, given: plans.random_plan(key, given, robot, STEPS)))
    plan = jax.tree.map(np.asarray, draw(keys, given))

    begin = jax.jit(jax.vmap(lambda key, given: tasks.begin(key, given, robot)))

    @jax.jit
    @functools.partial(jax.vmap, in_axes=(0, 0, 0, None, 0))
    def following(key: Any, given: Any, task: Any, index: Any, start: Any) -> Any:
        step = tasks.next_step(key, given, task, index, start, robot)
        return step, tasks.stair_window(given, task, index)

    for_steps, for_begin = jax.vmap(jax.random.split, out_axes=1)(keys)
    step_keys = jax.vmap(lambda key: jax.random.split(key, STEPS), out_axes=1)(for_steps)
    task, start = begin(for_begin, given)
    found, first = [], start
    for index in range(STEPS):
        step, boxes = following(step_keys[index], given, task, np.int32(index), start)
        found.append((step, boxes))
        start = step.end
    steps, boxes = jax.tree.map(lambda *leaves: np.stack(leaves, axis=1), *found)
    return Laid(plan, jax.tree.map(np.asarray, first), steps, boxes)


@ALL_CASES
def test_a_random_plan_is_begin_and_then_next_step_again_and_again(laid: Laid, case: str) -> None:
    plan, first, steps, boxes = at(laid, list(CASES).index(case))
    for expected, found in zip(jax.tree.leaves(first), jax.tree.leaves(at(plan.steps.start, 0)), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-6)
    for name in TaskStep._fields:
        pairs = zip(jax.tree.leaves(getattr(steps, name)), jax.tree.leaves(getattr(plan.steps, name)), strict=True)
        for expected, found in pairs:
            assert found.shape == expected.shape and len(found) == STEPS
            np.testing.assert_allclose(found, expected, atol=1e-5, err_msg=name)
    np.testing.assert_allclose(plan.boxes, boxes, atol=1e-5)


@ALL_CASES
def test_a_task_step_of_a_random_plan_starts_where_the_last_one_ended(laid: Laid, case: str) -> None:
    steps = at(laid.plan.steps, list(CASES).index(case))
    for name in Nodes._fields:
        end, start = getattr(steps.end, name), getattr(steps.start, name)
        assert (start[1:] == end[:-1]).all(), name
    moves = np.array([any((a[i] != b[i]).any() for a, b in zip(steps.start, steps.end, strict=True)) for i in range(STEPS)])
    kind, _, hold = CASES[case]
    expected = np.zeros(STEPS, bool) if kind == "stand" else np.arange(STEPS) < (STEPS if hold is None else hold)
    assert (moves == expected).all()


def test_random_plans_of_two_keys_and_two_task_steps_differ(laid: Laid) -> None:
    walking = [list(CASES).index(case) for case in ("walk", "sidle", "turn", "stairs", "stairs down")]
    lifts = laid.plan.steps.lift[walking].sum(axis=-1)
    assert len(np.unique(lifts)) == lifts.size == 5 * STEPS


def ground(boxes: np.ndarray, x: float, y: float) -> float:
    """The height, m, of the highest of the stairs' boxes (3, 7) that lies under a point, or of the floor."""
    length, width, height = terrain.STAIR_BOX
    assert (boxes[:, 3:] == [1, 0, 0, 0]).all()
    under = (abs(boxes[:, 0] - x) <= length / 2) & (abs(boxes[:, 1] - y) <= width / 2)
    return max([0.0, *(boxes[under, 2] + height / 2)])


@pytest.mark.parametrize(("case", "rises"), [("stairs", True), ("stairs down", False), ("stairs and hold", True)])
def test_boxes_lie_under_both_feet_before_and_after_every_step_on_stairs(
    laid: Laid, robot: Robot, case: str, rises: bool
) -> None:
    plan = at(laid.plan, list(CASES).index(case))
    corners = list(itertools.product((-0.07, 0.07), (-0.05, 0.05)))
    for number in range(STEPS):
        step = at(plan.steps, number)
        for ankles in (step.start.ankle_positions, step.end.ankle_positions):
            for (x, y, z), (dx, dy) in itertools.product(ankles, corners):
                top = ground(plan.boxes[number], x + dx, y + dy)
                assert top == pytest.approx(z - robot.ankle_height, abs=1e-5), number
    heights = plan.steps.end.ankle_positions[..., 2].max(axis=1)
    assert (heights[-1] > heights[0]) == rises


@pytest.mark.parametrize("case", ["stand", "squat", "walk", "sidle", "turn", "walk and hold"])
def test_boxes_are_out_of_the_way_on_level_ground(laid: Laid, case: str) -> None:
    boxes = at(laid.plan.boxes, list(CASES).index(case))
    assert boxes.shape == (STEPS, 3, 7)
    assert (boxes[..., 2] + terrain.STAIR_BOX[2] / 2 < -1).all()


def command(plan: Plan, number: int, tick: int) -> Command:
    return planner.command(at(plan.steps, number), np.float64(tick * 0.005))


@pytest.mark.parametrize("last_line", ["", BOW])
def test_a_script_plan_gives_the_scripts_commands_and_then_holds(robot: Robot, last_line: str) -> None:
    script = footsteps.parse(HEADER + BOXES + SCRIPT + last_line, robot, "a.csv")
    plan = script_plan(script)
    seconds = footsteps.duration(script) + 2.0
    expected = list(footsteps.commands(script, 0.005, seconds))
    numbers, within = step_numbers(plan, 0.005, len(expected))
    assert numbers[-1] == len(script.steps)
    for tick, (number, since) in enumerate(zip(numbers, within, strict=True)):
        found = command(plan, number, since)
        for part, known in zip(jax.tree.leaves(found), jax.tree.leaves(expected[tick]), strict=True):
            np.testing.assert_allclose(part, known, atol=1e-9, err_msg=str(tick))


@pytest.mark.parametrize("last_line", ["", BOW])
def test_the_end_of_a_script_plan_stands_where_the_last_line_ends(robot: Robot, last_line: str) -> None:
    script = footsteps.parse(HEADER + SCRIPT + last_line, robot, "a.csv")
    plan = script_plan(script)
    where = [[0.5, 0.1, 0.04], [0.4, -0.1, 0.04]]  # as the lines say, an ankle 0.04 m above its sole
    for tick in (0, 1, 40, 79):
        found = command(plan, len(script.steps), tick)
        np.testing.assert_allclose(found.target.ankle_positions, where, atol=1e-12)
        np.testing.assert_allclose(found.target.ankle_yaws, [0.3, 0.2], atol=1e-12)
        np.testing.assert_array_equal(found.target.trunk_position, script.steps[-1].end.trunk_position)
        # bent knees carry the centre of mass ahead of the trunk
        np.testing.assert_allclose(found.target.trunk_position, [0.39, 0, 0.68 if last_line else 0.75], atol=0.02)
        assert max(np.abs(part).max() for part in found.rates) < 1e-12
        assert (found.timer == 0).all()


def test_boxes_of_a_script_plan_worked_by_hand(robot: Robot) -> None:
    plan = script_plan(footsteps.parse(HEADER + BOXES + SCRIPT, robot, "a.csv"))
    turned = [0.9, 0.05, 0.01, np.cos(0.15), 0, 0, np.sin(0.15)]
    straight = [-0.8, 0.4, 0.35, 1, 0, 0, 0]
    assert plan.boxes == pytest.approx(np.array([[turned, straight]] * 5))  # four lines and the hold
    assert script_plan(footsteps.parse(HEADER + SCRIPT, robot, "a.csv")).boxes.shape == (5, 0, 7)


def of_periods(periods: np.ndarray) -> Plan:
    """A plan of which only the periods are known."""
    nowhere: Any = None
    return Plan(TaskStep(nowhere, nowhere, periods, *[nowhere] * 7), np.zeros((len(periods), 0, 7)))


@given(
    st.lists(st.tuples(st.integers(1, 30), st.floats(-0.4, 0.4)), min_size=1, max_size=5),
    st.sampled_from([0.005, 0.002, 1 / 240]),
    st.integers(1, 250),
    st.sampled_from([np.float32, np.float64]),
)
def test_step_numbers_are_those_of_a_clock_that_ticks(lengths: list, timestep: float, count: int, precision: type) -> None:
    """Periods need not be multiples of the control period; after the end the last task step begins anew, and again."""
    periods = np.array([(whole + part) * timestep for whole, part in lengths], precision)
    expected, number, tick = [], 0, 0
    for _ in range(count):
        expected.append((number, tick))
        tick += 1
        if tick == lengths[number][0]:
            number, tick = min(number + 1, len(lengths) - 1), 0
    found = step_numbers(of_periods(periods), timestep, count)
    assert list(zip(*found, strict=True)) == expected


def test_step_numbers_worked_by_hand() -> None:
    # 3, 2 and 2 control steps: 0.0098 s are nearer to two of 0.005 s than to one
    number, tick = step_numbers(of_periods(np.array([0.015, 0.0098, 0.01])), 0.005, 12)
    assert number.tolist() == [0, 0, 0, 1, 1, 2, 2, 2, 2, 2, 2, 2]
    assert tick.tolist() == [0, 1, 2, 0, 1, 0, 1, 0, 1, 0, 1, 0]


def test_an_environment_is_given_the_plan_and_after_its_end_the_last_step(robot: Robot) -> None:
    plan = script_plan(footsteps.parse(HEADER + BOXES + SCRIPT, robot, "a.csv"))
    plan = plan._replace(boxes=plan.boxes + np.arange(5)[:, None, None])  # so that they tell the task steps apart
    plan = jax.tree.map(jax.numpy.asarray, plan)
    task, first = PLANNED.begin(jax.random.PRNGKey(0), plan, robot)
    np.testing.assert_allclose(first.ankle_positions, [[0, 0.1, 0.04], [0, -0.1, 0.04]], atol=1e-6)
    np.testing.assert_allclose(first.trunk_position, footsteps.initial_nodes(robot).trunk_position, atol=1e-6)

    @jax.jit
    def following(index: Any) -> Any:
        key = jax.random.PRNGKey(0)
        step = PLANNED.next_step(key, plan, task, index, first, robot)
        return step, PLANNED.boxes(plan, task, index)

    for index, number in [(0, 0), (1, 1), (3, 3), (4, 4), (5, 4), (1000, 4)]:
        step, boxes = following(index)
        for part, known in zip(jax.tree.leaves(step), jax.tree.leaves(plan.steps), strict=True):
            assert (part == known[number]).all()
        assert (boxes == plan.boxes[number]).all()


# Scripts to train with


def test_a_mirrored_plan_asks_for_the_mirror_image(robot: Robot) -> None:
    plan = script_plan(footsteps.parse(HEADER + SCRIPT + BOW, robot, "a.csv", sway=1.0))
    other = mirrored(plan)
    flip = np.array([1.0, -1.0, 1.0])
    for number in range(len(plan.steps.period)):
        for tick in (0, 30, 90):
            one, image = command(plan, number, tick), command(other, number, tick)
            for mine, its in ((one.target, image.target), (one.end, image.end)):
                np.testing.assert_allclose(its.trunk_position, mine.trunk_position * flip, atol=1e-9)
                np.testing.assert_allclose(its.ankle_positions, mine.ankle_positions[::-1] * flip, atol=1e-9)
                np.testing.assert_allclose(its.ankle_yaws, -mine.ankle_yaws[::-1], atol=1e-9)
                turns = [rotations.to_matrix(place.trunk_orientation) for place in (mine, its)]
                np.testing.assert_allclose(turns[1], np.diag(flip) @ turns[0] @ np.diag(flip), atol=1e-9)
            np.testing.assert_allclose(image.rates.ankle_velocities, one.rates.ankle_velocities[::-1] * flip, atol=1e-9)
            np.testing.assert_allclose(image.timer, one.timer[::-1])
    for leaf, twice in zip(jax.tree.leaves(plan.steps), jax.tree.leaves(mirrored(other).steps), strict=True):
        np.testing.assert_array_equal(leaf, twice)


def test_a_share_of_the_episodes_follows_the_scripts_at_a_pace_of_its_own(robot: Robot) -> None:
    short, long = (footsteps.parse(HEADER + text, robot, "a.csv") for text in ("jump,0.1\n", SCRIPT))
    stock = library([short, long])
    assert stock.boxes.shape == (4, 5, 3, 7) and (stock.boxes[..., 2] < -5).all()
    given = sampling.distribution(sampling.Ranges(), sampling.Shares(0, 0, 1, 0, 0, 0), 1.0, 0.0, (1, 8))
    source = with_scripts(tasks.RANDOM, stock, 0.5)

    @jax.jit
    @jax.vmap
    def follow(key: Any) -> Any:
        task, start = source.begin(key, given, robot)

        def one(start: Nodes, index: Any) -> Any:
            step = source.next_step(key, given, task, index, start, robot)
            return step.end, (step, source.boxes(given, task, index))

        return task, start, jax.lax.scan(one, start, np.arange(7))[1]

    task, start, (steps, boxes) = jax.tree.map(np.asarray, follow(jax.random.split(jax.random.PRNGKey(0), 200)))
    assert 0.35 < task.scripted.mean() < 0.65
    assert set(task.number[task.scripted]) == {0, 1, 2, 3} and np.ptp(task.pace) > 0.3
    assert boxes.shape == (200, 7, 3, 7)
    for i in range(200):
        mine = at(steps, i)
        if not task.scripted[i]:
            assert (mine.swing.sum(axis=-1) == 1).all()
            continue
        theirs = at(stock.steps, task.number[i])
        for index in range(7):
            wanted, found = at(theirs, min(index, 4)), at(mine, index)
            np.testing.assert_allclose(found.end.ankle_positions, wanted.end.ankle_positions, atol=1e-6)
            np.testing.assert_allclose(found.start.trunk_position, wanted.start.trunk_position, atol=1e-6)
            assert found.period == pytest.approx(task.pace[i] * wanted.period, abs=0.0026)
        np.testing.assert_allclose(start.ankle_positions[i], [[0, 0.1, 0.04], [0, -0.1, 0.04]], atol=1e-6)
    assert not steps.swing[task.scripted][:, -2:].any()  # in the end it holds
