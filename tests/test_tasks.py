"""The task steps of Table II as they are drawn with the default curriculum's ranges."""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bipedtrack import control, env, kinematics, nodes, rotations, sampling, tasks, terrain
from bipedtrack import robot as robots
from bipedtrack.curriculum import Curriculum
from bipedtrack.robot import Robot
from bipedtrack.sampling import Shares

UPRIGHT = ("walk", "sidle", "turn", "stairs")  # the trunk stays level
STEPPING = (*UPRIGHT, "wander")
ALL_KINDS = pytest.mark.parametrize("kind", sampling.KINDS)
STEPPING_KINDS = pytest.mark.parametrize("kind", STEPPING)
UPRIGHT_KINDS = pytest.mark.parametrize("kind", UPRIGHT)


def heading(orientation: np.ndarray) -> np.ndarray:
    """The yaw (...,) of quaternions (..., 4)."""
    w, x, y, z = np.moveaxis(orientation, -1, 0)
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


@ALL_KINDS
def test_everything_drawn_is_finite_and_of_its_kind(episodes: Callable, kind: str) -> None:
    drawn = episodes(kind)
    assert (drawn.task.motion.kind == sampling.KINDS.index(kind)).all()
    for part in jax.tree.leaves((drawn.task, drawn.step, drawn.command)):
        assert np.isfinite(part).all()
    for place in (drawn.step.start, drawn.step.end, drawn.command.target):
        assert np.linalg.norm(place.trunk_orientation, axis=-1) == pytest.approx(1, abs=1e-5)


@ALL_KINDS
@pytest.mark.parametrize("hold_after", [None, (1, 4)])
def test_targets_are_continuous_from_step_to_step(episodes: Callable, kind: str, hold_after: tuple | None) -> None:
    target = episodes(kind, 1.0, hold_after).command.target
    for name, part in target._asdict().items():
        last, first = part[:, :-1, -1], part[:, 1:, 0]
        if name == "ankle_yaws":
            last, first = np.exp(1j * last), np.exp(1j * first)
        assert np.abs(last - first).max() < 2e-5, name


@STEPPING_KINDS
def test_targets_move_no_faster_than_legs_can(episodes: Callable, kind: str) -> None:
    """Between two instants of a step no target jumps: 0.8 m of the highest stair stride within 0.4 s."""
    drawn = episodes(kind)
    speed = np.linalg.norm(np.diff(drawn.command.target.ankle_positions, axis=2), axis=-1)
    speed /= np.diff(drawn.time, axis=2)[..., None]
    assert speed.max() < 6


@ALL_KINDS
def test_ankles_keep_their_distance(episodes: Callable, kind: str) -> None:
    ankles = episodes(kind).command.target.ankle_positions[..., :2]
    assert np.linalg.norm(ankles[..., 0, :] - ankles[..., 1, :], axis=-1).min() >= 0.1


@ALL_KINDS
def test_at_most_one_foot_swings_and_the_other_stays(episodes: Callable, kind: str) -> None:
    step = episodes(kind).step
    assert set(np.unique(step.swing)) <= {0.0, 1.0}
    assert (step.swing.sum(axis=-1) == (kind in STEPPING)).all()
    stays = step.swing == 0
    assert (step.start.ankle_positions[stays] == step.end.ankle_positions[stays]).all()
    assert (step.start.ankle_yaws[stays] == step.end.ankle_yaws[stays]).all()
    assert (step.lift[stays] == 0).all()
    assert np.ptp(step.ankle_points[stays], axis=1).max(initial=0) < 1e-6
    if kind in STEPPING:  # left and right in turn
        assert (step.swing[:, 1:] == step.swing[:, :-1, ::-1]).all()


@ALL_KINDS
def test_timer_is_the_time_to_touch_down_of_the_swing_foot(episodes: Callable, kind: str) -> None:
    drawn = episodes(kind)
    left = drawn.step.period[..., None] - drawn.time
    assert drawn.command.timer == pytest.approx(left[..., None] * drawn.step.swing[:, :, None], abs=1e-6)


@STEPPING_KINDS
def test_periods_are_multiples_of_the_control_period_from_400_to_700_ms(episodes: Callable, kind: str) -> None:
    period = episodes(kind).step.period.astype(np.float64)
    assert 0.4 - 1e-6 <= period.min() < 0.42
    assert 0.68 < period.max() <= 0.7 + 1e-6
    assert period / 0.005 == pytest.approx(np.round(period / 0.005), abs=1e-4)


def of_foot(values: np.ndarray, foot: np.ndarray) -> np.ndarray:
    """One foot's values (episode, task step, ...) of both feet's (episode, task step, 2, ...)."""
    return np.take_along_axis(values, foot.reshape(*foot.shape, *[1] * (values.ndim - 2)), axis=2)[:, :, 0]


def moved(drawn: Any) -> np.ndarray:
    """Where the swing foot lands (episode, task step, 3), from 0.2 m beside the other one, in its frame: m, m, rad."""
    end, swing = drawn.step.end, drawn.step.swing.argmax(axis=-1)
    x, y, _ = np.moveaxis(of_foot(end.ankle_positions, swing) - of_foot(end.ankle_positions, 1 - swing), -1, 0)
    yaw = of_foot(end.ankle_yaws, 1 - swing)
    side = np.where(swing == 0, 0.2, -0.2)
    turn = of_foot(end.ankle_yaws, swing) - yaw
    return np.stack([np.cos(yaw) * x + np.sin(yaw) * y, np.cos(yaw) * y - np.sin(yaw) * x - side, turn], axis=-1)


@pytest.mark.parametrize(("kind", "part", "furthest"), [("walk", 0, (-0.18, 0.3)), ("sidle", 1, (-0.288, 0.288))])
def test_walking_and_sidling_go_straight_both_ways(episodes: Callable, kind: str, part: int, furthest: tuple) -> None:
    drawn = episodes(kind)
    steps = moved(drawn)
    others = [i for i in range(3) if i != part]
    assert np.abs(steps[..., others]).max() < 1e-5
    assert furthest[0] - 1e-5 < steps[..., part].min() < 0.8 * furthest[0]
    assert 0.8 * furthest[1] < steps[..., part].max() < furthest[1] + 1e-5
    # an episode keeps its direction, and the trunk goes along
    way = drawn.step.end.trunk_position[:, -1, part] - drawn.step.start.trunk_position[:, 0, part]
    direction = np.sign(steps[:, 0, part])
    assert (np.sign(way) == direction).all()
    assert 0.25 < (direction > 0).mean() < 0.75
    assert (steps[..., part] * direction[:, None] > -1e-5).all()


@pytest.mark.parametrize("kind", ["walk", "stairs", "wander"])
def test_breaks_pause_or_bring_the_feet_together(episodes: Callable, kind: str) -> None:
    drawn = episodes(kind, 1.0, None, 1.0)
    places = moved(drawn)
    for i, (every, pauses) in enumerate(zip(drawn.task.break_every, drawn.task.pauses, strict=True)):
        step = jax.tree.map(lambda leaf, i=i: leaf[i], drawn.step)
        breaks = np.arange(1, len(step.period) + 1) % every == 0
        moves = step.swing.sum(axis=-1) == 1
        assert 2 <= every <= 6 and (moves == ~(breaks & pauses)).all()
        still = [(a == b).reshape(len(a), -1).all(axis=1) for a, b in zip(step.start, step.end, strict=True)]
        assert (np.all(still, axis=0) == ~moves).all() and step.period[~moves] == pytest.approx(1.0)
        feet = step.swing.argmax(axis=-1)[moves]
        assert (feet[1:] != feet[:-1]).all()  # left and right in turn, also after a pause
        if not pauses:
            heights = step.end.ankle_positions[..., 2]
            assert np.ptp(heights[breaks], axis=1).max() < 1e-5 and np.abs(places[i, breaks, :2]).max() < 0.04
    assert 0.2 < drawn.task.pauses.mean() < 0.8


def test_on_stairs_with_breaks_both_feet_stand_on_treads(episodes: Callable, robot: Robot) -> None:
    """A foot stands where the boxes of the present task step have their top: tread number is height by riser."""
    drawn = episodes("stairs", 1.0, None, 1.0)
    stairs, step = drawn.task.stairs, drawn.step
    for i, index in np.ndindex(*step.period.shape):
        task = jax.tree.map(lambda leaf, i=i: leaf[i], drawn.task)
        boxes = np.asarray(tasks.stair_window(None, task, index))
        for place in (step.start, step.end):
            for x, _, z in place.ankle_positions[i, index]:
                level = round(float((z - robot.ankle_height - stairs.height[i]) / stairs.rise[i]))
                if level < 1 and stairs.rise[i] > 0:
                    continue  # on the ground
                tops = boxes[:, 2] + 0.5 * terrain.STAIR_BOX[2]
                under = (np.abs(boxes[:, 0] - x) < terrain.STAIR_BOX[0] / 2 - 0.05) & (np.abs(tops - z + 0.04) < 1e-4)
                assert under.any(), (i, index)
        if i == 20:
            break


def test_a_wanderer_steps_anywhere_within_reach_in_any_posture(episodes: Callable) -> None:
    drawn = episodes("wander")
    steps, outwards = moved(drawn), np.where(drawn.step.swing.argmax(axis=-1) == 0, 1, -1)
    x, y, yaw = steps[..., 0], steps[..., 1] * outwards, steps[..., 2]
    around = 0.1 * math.sin(0.25)  # by which turning about the place beside the other foot moves the ankle
    for found, low, high in ((x, -0.10, 0.25), (y, -0.02, 0.15), (yaw, -0.25, 0.25)):
        slack = 1e-5 if found is yaw else around
        assert low - slack < found.min() < 0.6 * low and 0.8 * high < found.max() < high + slack
    assert np.hypot(np.maximum(x, 0) / 0.25, np.maximum(y, 0) / 0.15).max() < 1.2  # the ellipse, and the turn
    height = drawn.step.end.trunk_position[..., 2]
    assert height.min() < 0.67 and height.max() > 0.77 and np.ptp(height, axis=1).min() > 0.01
    attitudes = np.array([rotations.to_euler(q) for q in drawn.step.end.trunk_orientation.reshape(-1, 4)])
    assert np.abs(attitudes[:, :2]).max(axis=0) == pytest.approx([0.075, 0.075], abs=0.005)


def test_a_sidle_opens_to_its_side_and_closes(episodes: Callable) -> None:
    drawn = episodes("sidle")
    sideways = moved(drawn)[..., 1]
    assert np.abs(sideways[:, 1::2]).max() < 1e-5  # the second foot comes to stand 0.2 m beside the first
    leading_left = drawn.step.swing[:, 0, 0] == 1
    assert (leading_left == (sideways[:, 0] > 0)).all()


def test_turns_go_both_ways_about_centres_at_a_random_radius(episodes: Callable, curriculum: Curriculum) -> None:
    drawn = episodes("turn")
    forward, left, turn = np.moveaxis(moved(drawn), -1, 0)
    assert 0.25 < (turn[:, 0] > 0).mean() < 0.75
    assert (np.sign(turn) == np.sign(turn[:, :1])).all()
    assert 0.3 < np.abs(turn).max() < 1.2 * 0.35 + 1e-5
    # how the middle between the feet moves on: the swing foot's side has turned about it
    side = np.where(drawn.step.swing[..., 0] == 1, 0.1, -0.1)
    x, y = forward + side * np.sin(turn), left + side * (1 - np.cos(turn))
    sharp = np.abs(turn) > 0.05  # else the radius is lost in rounding
    assert (x[sharp] > -1e-5).all()
    assert (y[sharp] * np.sign(turn[sharp]) > -1e-5).all()
    # the chord of an arc is 2 r sin(turn / 2); the variation from step to step scales chord and turn alike
    radius = np.hypot(x, y) / (2 * np.sin(np.maximum(np.abs(turn), 0.05) / 2))
    lowest, _, highest = curriculum.ranges.turn_radius
    assert lowest - 1e-3 < radius[sharp].min() < lowest + 0.1 * (highest - lowest)
    assert highest - 0.1 * (highest - lowest) < radius[sharp].max() < 1.01 * highest
    always_sharp = sharp.all(axis=1)
    assert always_sharp.sum() > 100
    assert np.ptp(radius[always_sharp], axis=1).max() < 0.01


def test_stairs_go_up_and_down_one_tread_a_step(episodes: Callable, curriculum: Curriculum) -> None:
    drawn = episodes("stairs")
    rise, tread = drawn.task.stairs.rise, drawn.task.stairs.tread
    assert 0.4 < (rise > 0).mean() < 0.6
    for value, name in ((np.abs(rise), "stair_riser"), (tread, "stair_tread")):
        lowest, _, highest = getattr(curriculum.ranges, name)
        assert lowest - 1e-6 <= value.min() < lowest + 0.1 * (highest - lowest)
        assert highest - 0.1 * (highest - lowest) < value.max() <= highest + 1e-6
    assert moved(drawn) == pytest.approx(np.broadcast_to((tread[:, None] * [1, 0, 0])[:, None], (300, 12, 3)), abs=1e-5)
    swing = drawn.step.swing[..., None] * (drawn.step.end.ankle_positions - drawn.step.start.ankle_positions)
    heights = swing.sum(axis=2)[..., 2]
    assert heights[:, 0] == pytest.approx(rise, abs=1e-5)  # from beside the other foot
    assert heights[:, 1:] == pytest.approx(np.repeat(2 * rise[:, None], 11, axis=1), abs=1e-5)
    # the longest episode goes down 25 treads of 0.4 s
    assert (drawn.step.start.ankle_positions[:, 0, :, 2] - 0.04)[rise < 0] == pytest.approx(
        np.repeat(-30 * rise[rise < 0, None], 2, axis=1), rel=1e-5
    )


@UPRIGHT_KINDS
def test_trunk_stays_level_and_the_centre_of_mass_over_the_feet_at_the_episodes_height(
    episodes: Callable, curriculum: Curriculum, kind: str, centres_of_mass: Callable
) -> None:
    drawn = episodes(kind)
    end = drawn.step.end
    over = end.trunk_position - end.ankle_positions.mean(axis=2)
    height = over[..., 2] + 0.04
    lowest, _, highest = curriculum.ranges.stair_trunk_height if kind == "stairs" else curriculum.ranges.trunk_height
    offsets, _ = centres_of_mass(end)
    assert np.quantile(np.abs(offsets), 0.99) < 1e-3  # some of the longest strides bend no knee any more
    assert np.ptp(height, axis=1).max() < 2e-5
    assert lowest - 1e-5 < height.min() < lowest + 0.01
    assert highest - 0.01 < height.max() < highest + 1e-5
    assert np.abs(end.trunk_orientation[..., 1:3]).max() < 1e-6
    yaw = end.ankle_yaws.mean(axis=-1)
    assert np.exp(1j * heading(end.trunk_orientation)) == pytest.approx(np.exp(1j * yaw), abs=1e-5)


@ALL_KINDS
def test_the_trunk_sways_over_the_stance_foot_and_back(episodes: Callable, kind: str) -> None:
    """By 0.1 m (1 - 1 / cosh(w T / 2)), 2-6 cm, from between feet 0.2 m apart; without a swing foot it moves uniformly."""
    drawn = episodes(kind, sway=1.0)
    step, trunk = drawn.step, drawn.command.target.trunk_position[..., :2]
    straight = trunk[:, :, :1] + (drawn.time / step.period[..., None])[..., None] * (trunk[:, :, -1:] - trunk[:, :, :1])
    if kind not in STEPPING:
        assert trunk == pytest.approx(straight, abs=1e-5)
        return
    stance = of_foot(step.end.ankle_positions, 1 - step.swing.argmax(axis=-1))[..., :2]
    other = of_foot(step.end.ankle_positions, step.swing.argmax(axis=-1))[..., :2]
    across = of_foot(step.end.ankle_yaws, 1 - step.swing.argmax(axis=-1))
    across = np.stack([-np.sin(across), np.cos(across)], axis=-1)  # to the left of the stance foot
    across *= np.sign(((stance - other) * across).sum(axis=-1, keepdims=True))
    sway = ((trunk - straight) * across[:, :, None]).sum(axis=-1)
    if kind in ("walk", "stairs"):
        expected = 0.1 - 0.1 / np.cosh(step.pendulum * step.period / 2)
        assert sway.max(axis=2) == pytest.approx(expected, abs=2e-3)
    assert np.quantile(sway.max(axis=2), 0.05) > 0.01
    assert sway.max() < 0.12


def test_some_sway_and_some_do_not(curriculum: Curriculum, draw: Callable) -> None:
    """Of [-0.5, 2.5] a sixth lies below 0 and half above 1."""
    ranges = curriculum.ranges._replace(sway=(-0.5, 1.0, 2.5))
    sway = draw(sampling.distribution(ranges, Shares(1, 1, 1, 1, 1, 1), 1.0, 0.0, (1, 8))).motion.sway
    assert [(sway == 0).mean(), (sway == 1).mean()] == pytest.approx([1 / 6, 1 / 2], abs=4 * math.sqrt(0.25 / 2000))
    assert (sway >= 0).all() and (sway <= 1).all()


@STEPPING_KINDS
def test_feet_are_lifted_by_4_to_15_cm_give_or_take_their_variation(episodes: Callable, kind: str) -> None:
    drawn = episodes(kind)
    lift = drawn.step.lift.sum(axis=-1)
    assert 0.8 * 0.04 - 1e-6 < lift.min() < 0.05
    assert 0.14 < lift.max() < 1.2 * 0.15 + 1e-6
    ends = np.maximum(drawn.step.start.ankle_positions, drawn.step.end.ankle_positions)[..., 2]
    rises = (drawn.command.target.ankle_positions[..., 2].max(axis=2) - ends).max(axis=-1)
    # the control points' heights vary by a fifth; a curve up or down stairs leans to its higher end
    assert (rises > (0.6 if kind == "stairs" else 0.8) * lift).all()
    assert (rises < 1.2 * lift).all()


@STEPPING_KINDS
def test_curves_are_of_both_sorts_but_for_stairs(episodes: Callable, kind: str) -> None:
    trigonometric = episodes(kind).step.trigonometric
    if kind == "stairs":
        assert (trigonometric == 0).all()
    else:
        assert set(np.unique(trigonometric)) == {0.0, 1.0}
        assert 0.15 < trigonometric.mean() < 0.3  # the range -1..0.3 is above zero for 23 %


def posture(place: nodes.Nodes) -> dict[str, np.ndarray]:
    """What Table II draws of a stand: the trunk against the feet, and the feet against each other."""
    ankles, yaws = place.ankle_positions, place.ankle_yaws
    yaw = yaws.mean(axis=-1)
    offset = place.trunk_position - ankles.mean(axis=-2)
    w, x, y, z = np.moveaxis(place.trunk_orientation, -1, 0)
    return {
        "posture_x": np.cos(yaw) * offset[..., 0] + np.sin(yaw) * offset[..., 1],
        "posture_y": np.cos(yaw) * offset[..., 1] - np.sin(yaw) * offset[..., 0],
        "posture_height": offset[..., 2] + 0.04,
        "posture_roll": np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        "posture_pitch": np.arcsin(2 * (w * y - x * z)),
        "posture_yaw": heading(place.trunk_orientation) - yaw,
        "foot_x": ankles[..., 0, 0] - ankles[..., 1, 0],
        "foot_distance": ankles[..., 0, 1] - ankles[..., 1, 1],
        "foot_yaw": (yaws[..., 0] - yaws[..., 1]) / 2,
    }


@pytest.fixture(scope="module")
def centres_of_mass(robot: Robot) -> Callable[[nodes.Nodes], tuple[np.ndarray, np.ndarray]]:
    """The centre of mass ahead of and left of the feet's middle, and its distance from the edge of the soles, by MuJoCo, m.

    Of robots (n, ...) that stand with their nodes at the given ones by inverse kinematics.
    """
    model = robots.build_model(robot.name)
    data = mujoco.MjData(model)
    standing = jax.jit(jax.vmap(lambda place: env.standing(robot, control.ControlConfig(level_feet=True), place)[0]))
    directions = np.stack([f(np.linspace(0, 2 * np.pi, 360)) for f in (np.cos, np.sin)], axis=-1)

    def one(qpos: np.ndarray, ankles: np.ndarray, yaw: float) -> tuple[np.ndarray, float]:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        centre = data.subtree_com[0][:2]
        corners = np.array([data.geom(f"{leg}_sole_{i}").xpos[:2] for leg in robots.LEGS for i in range(4)])
        turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
        return turn @ (centre - ankles.mean(axis=0)[:2]), ((corners @ directions.T).max(0) - directions @ centre).min()

    def of(places: nodes.Nodes) -> tuple[np.ndarray, np.ndarray]:
        flat = nodes.Nodes(*(part.reshape(-1, *part.shape[2:]) for part in places))
        found = [one(*row) for row in zip(standing(flat), flat.ankle_positions, flat.ankle_yaws.mean(-1), strict=True)]
        offsets, margins = zip(*found, strict=True)
        return np.array(offsets), np.array(margins)

    return of


@pytest.mark.parametrize("kind", ["stand", "squat"])
def test_postures_fill_their_ranges(
    episodes: Callable, curriculum: Curriculum, kind: str, centres_of_mass: Callable
) -> None:
    places = episodes(kind).step.start
    offsets, margins = centres_of_mass(places)
    assert margins.min() > 0.03  # nobody can stand with the centre of mass beyond the soles
    drawn = posture(places) | {"posture_x": offsets[:, 0], "posture_y": offsets[:, 1]}
    for name, found in drawn.items():
        lowest, _, highest = getattr(curriculum.ranges, name)
        margin = 0.05 * (highest - lowest)
        # these two are met by a few iterations, with feet parallel to the trunk; level ones carry the legs elsewhere
        rounding = 2e-3 if name in ("posture_x", "posture_y") else 1e-5
        assert lowest - rounding < found.min() < lowest + margin, name
        assert highest - margin < found.max() < highest + rounding, name


def test_a_stand_stands_still(episodes: Callable) -> None:
    drawn = episodes("stand")
    for part in drawn.command.target:
        assert np.abs(part - part[:, :1, :1]).max() < 1e-6
    for part in drawn.command.rates:
        assert np.abs(part).max() < 1e-5


def test_a_squat_moves_and_turns_the_trunk_over_feet_that_stay(episodes: Callable) -> None:
    drawn = episodes("squat")
    target = drawn.command.target
    for part in (target.ankle_positions, target.ankle_yaws):
        assert np.abs(part - part[:, :1, :1]).max() < 1e-6
    start, end = posture(drawn.step.start), posture(drawn.step.end)
    for name in ("posture_x", "posture_y", "posture_height", "posture_roll", "posture_pitch", "posture_yaw"):
        assert np.abs(end[name] - start[name]).mean() > 0.01, name


@ALL_KINDS
def test_difficulty_zero_is_the_mildest(
    episodes: Callable, curriculum: Curriculum, kind: str, centres_of_mass: Callable
) -> None:
    drawn = episodes(kind, 0.0)
    mild = {name: row[1] for name, row in curriculum.ranges._asdict().items()}
    if kind in STEPPING:
        assert drawn.step.period == pytest.approx(mild["period"], abs=1e-5)
        assert drawn.step.lift.sum(axis=-1) == pytest.approx(mild["lift"], abs=1e-6)
        assert (drawn.step.trigonometric == 0).all()
        advance = {"walk": mild["walk_step"], "sidle": 0.0, "turn": 0.0, "wander": 0.0, "stairs": mild["stair_tread"]}[kind]
        steps = moved(drawn)
        assert steps == pytest.approx(np.broadcast_to([advance, 0, 0], steps.shape), abs=1e-5)
        height = posture(drawn.step.start)["posture_height"]
        assert height == pytest.approx(mild["stair_trunk_height" if kind == "stairs" else "trunk_height"], abs=1e-5)
        riser = mild["stair_riser"] if kind == "stairs" else 0.0
        assert np.abs(drawn.task.stairs.rise) == pytest.approx(riser, abs=1e-6)
    else:
        offsets, _ = centres_of_mass(drawn.step.start)
        drawn_posture = posture(drawn.step.start) | {"posture_x": offsets[:, 0], "posture_y": offsets[:, 1]}
        for name, found in drawn_posture.items():
            rounding = 1e-3 if name in ("posture_x", "posture_y") else 1e-5
            assert found == pytest.approx(mild[name], abs=rounding), name


@ALL_KINDS
@pytest.mark.parametrize("hold_after", [(0, 0), (1, 4)])
def test_a_hold_leaves_every_target_where_it_is(episodes: Callable, kind: str, hold_after: tuple) -> None:
    drawn = episodes(kind, 1.0, hold_after)
    after = drawn.task.hold_after
    assert set(np.unique(after)) == set(range(hold_after[0], hold_after[1] + 1))
    holding = np.arange(12) >= after[:, None]
    assert (drawn.step.swing[holding] == 0).all()
    assert (drawn.command.timer[holding] == 0).all()
    for part in drawn.command.rates:
        assert np.abs(part[holding]).max() < 1e-5  # the rounding of an orientation's difference from itself
    first = np.arange(300), np.minimum(after, 11)
    for name, part in drawn.command.target._asdict().items():
        stays = part[first][:, 0][:, None, None]
        off = np.abs(part - np.broadcast_to(stays, part.shape))[holding]
        assert off.max() < 1e-5, name
        begun = getattr(drawn.step.start, name)[first]
        assert part[first][:, 0] == pytest.approx(begun, abs=1e-6), name
    # up to then it has moved
    if kind != "stand" and hold_after[0] > 0:
        assert (drawn.command.rates.trunk_velocity[~holding] != 0).any(axis=-1)[:, 0].mean() > 0.99


@pytest.fixture(scope="module")
def draw(curriculum: Curriculum, robot: Robot) -> Callable[[sampling.Distribution], tasks.Task]:
    """2000 tasks of a distribution."""
    begin = jax.jit(jax.vmap(lambda key, given: tasks.begin(key, given, robot)[0], (0, None)))
    keys = jax.random.split(jax.random.PRNGKey(0), 2000)
    return lambda given: jax.tree.map(np.asarray, begin(keys, given))


def test_kinds_are_drawn_by_their_shares(curriculum: Curriculum, draw: Callable) -> None:
    for shares in (Shares(1, 1, 2, 2, 2, 0), Shares(0, 3, 0, 1, 0, 4, wander=2)):
        task = draw(sampling.distribution(curriculum.ranges, shares, 1.0, 0.0, (1, 8)))
        expected = np.array([getattr(shares, kind) for kind in sampling.KINDS]) / sum(shares)
        found = np.bincount(task.motion.kind, minlength=len(sampling.KINDS)) / 2000
        assert (found[expected == 0] == 0).all()
        # four standard deviations of a share drawn 2000 times
        assert found == pytest.approx(expected, abs=4 * math.sqrt(0.25 / 2000))


def test_episodes_hold_by_their_share_after_any_of_the_numbers_of_steps(curriculum: Curriculum, draw: Callable) -> None:
    given = sampling.distribution(curriculum.ranges, Shares(1, 1, 2, 2, 2, 2), 1.0, 0.6, (2, 6))
    after = draw(given).hold_after
    holds = after < 1000
    assert holds.mean() == pytest.approx(0.6, abs=0.045)
    counts = np.bincount(after[holds], minlength=7)
    assert (counts[:2] == 0).all() and len(counts) == 7
    assert counts[2:] / holds.sum() == pytest.approx([0.2] * 5, abs=0.06)
    never = draw(given._replace(hold_share=np.float32(0)))
    assert never.hold_after.min() > 1000


@pytest.mark.parametrize("down_share", [0.0, 0.25, 1.0])
def test_stairs_go_down_by_their_share(curriculum: Curriculum, draw: Callable, down_share: float) -> None:
    task = draw(sampling.distribution(curriculum.ranges, Shares(0, 0, 0, 0, 0, 1), 1.0, 0.0, (1, 8), down_share))
    assert (task.stairs.rise < 0).mean() == pytest.approx(down_share, abs=0.04 if 0 < down_share < 1 else 0)


def test_tasks_of_two_keys_differ(curriculum: Curriculum, draw: Callable) -> None:
    task = draw(sampling.distribution(curriculum.ranges, Shares(0, 0, 1, 0, 0, 0), 1.0, 0.0, (1, 8)))
    for part in (task.motion.period, task.motion.lift, task.motion.trunk_height, task.motion.advance[:, 0]):
        assert len(np.unique(part)) > 1900


def test_what_is_drawn_is_independent_of_each_other(curriculum: Curriculum, draw: Callable) -> None:
    task = draw(sampling.distribution(curriculum.ranges, Shares(1, 1, 1, 1, 1, 0), 1.0, 0.5, (1, 8)))
    holds = task.hold_after < 1000
    related = np.corrcoef([*(getattr(task.motion, n) for n in ("kind", "first", "period", "lift", "trunk_height")), holds])
    assert np.abs(related - np.eye(6)).max() < 0.12


def test_pushes_come_to_their_share_of_the_episodes_and_grow_with_difficulty(curriculum: Curriculum, draw: Callable) -> None:
    ranges = curriculum.ranges._replace(stair_push=(0.0, 0.0, 8.0))
    for difficulty, greatest, on_stairs in ((1.0, 30.0, 8.0), (0.5, 15.0, 4.0)):
        shares = Shares(1, 1, 2, 2, 2, 2)
        task = draw(sampling.distribution(ranges, shares, difficulty, 0.0, (1, 8), push_share=0.3))
        stairs = task.motion.kind == sampling.STAIRS
        assert set(np.unique(task.push[~stairs])) == {0.0, greatest}
        assert set(np.unique(task.push[stairs])) == {0.0, on_stairs}
        assert (task.push > 0).mean() == pytest.approx(0.3, abs=0.04)


def test_kinds_change_within_an_episode_and_a_foot_may_swing_twice(curriculum: Curriculum, robot: Robot) -> None:
    given = sampling.distribution(curriculum.ranges, Shares(1, 1, 2, 2, 2, 2), 1.0, 0.0, (1, 8), mix_share=0.5)
    count, steps = 200, 24

    def one(key: Any) -> tuple:
        key_begin, key_steps = jax.random.split(key)
        task, start = tasks.begin(key_begin, given, robot)

        def following(start: Any, indexed_key: Any) -> tuple:
            step = tasks.next_step(indexed_key[1], given, task, indexed_key[0], start, robot)
            return step.end, (step.swing, step.start, step.end)

        return task, jax.lax.scan(following, start, (jnp.arange(steps), jax.random.split(key_steps, steps)))[1]

    task, (swing, start, end) = jax.tree.map(
        np.asarray, jax.jit(jax.vmap(one))(jax.random.split(jax.random.PRNGKey(3), count))
    )
    stairs = task.motion.kind == sampling.STAIRS
    assert not task.mixes[stairs].any()
    assert task.mixes[~stairs].mean() == pytest.approx(0.5, abs=0.15)
    moved = np.abs(end.ankle_positions - start.ankle_positions).max(axis=-1) > 1e-3
    # which foot swings, 0, 1, or 2: none
    foot = np.where(swing.any(axis=-1), swing.argmax(axis=-1), 2)
    twice = ((foot[:, 1:] == foot[:, :-1]) & (foot[:, 1:] < 2)).any(axis=1)
    rests_and_steps = (foot == 2).any(axis=1) & (foot < 2).any(axis=1)
    assert not twice[~task.mixes].any() and not rests_and_steps[~task.mixes].any()
    assert twice[task.mixes].mean() > 0.6 and rests_and_steps[task.mixes].mean() > 0.7
    # within four task steps feet alternate, and only feet that swing move
    runs = foot[task.mixes].reshape(-1, steps // tasks.MIX_STEPS, tasks.MIX_STEPS)
    assert ((runs[..., 1:] != runs[..., :-1]) | (runs[..., 1:] == 2)).all()
    assert not moved[swing == 0].any()


@pytest.fixture(scope="module")
def out_of_reach(robot: Robot) -> Callable[[Any], np.ndarray]:
    """By how much (episode, task step, instant) the projection moves an ankle of the targets, m."""

    def one(target: nodes.Nodes) -> Any:
        ankles, yaws = nodes.ankles_in_trunk_frame(target)
        return kinematics.project(robot, ankles, yaws)[0] - ankles

    batched = jax.jit(jax.vmap(jax.vmap(jax.vmap(one))))
    return lambda drawn: np.linalg.norm(np.asarray(batched(drawn.command.target)), axis=-1).max(axis=-1)


@pytest.mark.parametrize(
    ("kind", "difficulty", "most"),
    [(kind, 1.0, 0.01) for kind in ("stand", "squat", "walk", "sidle", "turn")] + [("stairs", 0.5, 0.01)],
)
def test_most_commands_are_within_reach(
    episodes: Callable, out_of_reach: Callable, kind: str, difficulty: float, most: float
) -> None:
    off = out_of_reach(episodes(kind, difficulty))
    assert (off > 1e-3).mean() < most


def test_one_command_in_twenty_of_the_steepest_stairs_is_out_of_reach(episodes: Callable, out_of_reach: Callable) -> None:
    off = out_of_reach(episodes("stairs", 1.0))
    assert 0.01 < (off > 1e-3).mean() < 0.06
    assert off.max() < 0.1


def test_tracking_errors_are_in_cm_and_degrees() -> None:
    errors = nodes.NodeErrors(
        trunk_position=np.array([0.03, 0, 0.04]),
        trunk_orientation=np.array([0, math.radians(6), math.radians(8)]),
        ankle_positions=np.array([[0.01, 0, 0], [0, 0.02, 0.02]]),
        ankle_yaws=np.radians([-2.0, 6.0]),
    )
    found = tasks.tracking_errors(errors)
    expected = {
        "ankle_error_cm": (1 + math.sqrt(8)) / 2,
        "ankle_yaw_error_deg": 4,
        "trunk_error_cm": 5,
        "trunk_error_deg": 10,
    }
    assert {name: float(value) for name, value in found.items()} == pytest.approx(expected, rel=1e-5)
