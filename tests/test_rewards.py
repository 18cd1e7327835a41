"""The reward of eqs (11)-(16): each term by hand, and what it makes of stepping, standing and holding."""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bipedtrack import nodes, planner, rewards
from bipedtrack.curriculum import Curriculum
from bipedtrack.nodes import NodeErrors, NodeRates
from bipedtrack.rewards import Sharpness, Terms

SHARPNESS = Sharpness(
    trunk_position=5.0,
    trunk_orientation=3.0,
    ankle_position=10.0,
    ankle_yaw=4.0,
    feedback=0.1,
    static_velocity=0.02,
    static_acceleration=0.001,
    feedback_rate=0.05,
)
NO_ERROR = NodeErrors(np.zeros(3), np.zeros(3), np.zeros((2, 3)), np.zeros(2))
NO_RATES = NodeRates(np.zeros(3), np.zeros(3), np.zeros((2, 3)), np.zeros(2))
ZERO, ONES = np.zeros(12), np.ones(12)
TRACKING = Terms._fields[1:7]


def terms(
    errors: NodeErrors = NO_ERROR,
    rates: NodeRates = NO_RATES,
    a_fb: Any = ZERO,
    last_a_fb: Any = ZERO,
    velocities: Any = ZERO,
    accelerations: Any = ZERO,
) -> Terms:
    return rewards.terms(SHARPNESS, errors, rates, a_fb, last_a_fb, velocities, accelerations)


def test_perfect_tracking_without_effort() -> None:
    assert terms() == Terms(1, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0)


def test_tracking_terms_worked_by_hand() -> None:
    errors = NodeErrors(
        trunk_position=np.array([0.03, 0.0, -0.04]),  # 5 cm off
        trunk_orientation=np.array([0.0, 0.2, 0.0]),
        ankle_positions=np.array([[0.02, 0.01, 0.02], [0.0, 0.0, -0.1]]),  # 3 cm and 10 cm
        ankle_yaws=np.array([-0.1, 0.5]),
    )
    found = terms(errors)
    assert found.trunk_position == pytest.approx(math.exp(-0.25))
    assert found.trunk_orientation == pytest.approx(math.exp(-0.6))
    assert found.left_ankle_position == pytest.approx(math.exp(-0.3))
    assert found.right_ankle_position == pytest.approx(math.exp(-1.0))
    assert found.left_ankle_yaw == pytest.approx(math.exp(-0.4))
    assert found.right_ankle_yaw == pytest.approx(math.exp(-2.0))
    assert found._replace(**dict.fromkeys(TRACKING, 1)) == terms()


@given(st.lists(st.floats(-2, 2), min_size=14, max_size=14).map(np.array), st.floats(1.01, 3))
def test_tracking_terms_fall_with_the_error_and_ignore_its_direction(numbers: np.ndarray, factor: float) -> None:
    numbers = np.where(np.abs(numbers) < 1e-3, 1e-3, numbers)

    def of(v: np.ndarray) -> np.ndarray:
        errors = NodeErrors(v[:3], v[3:6], v[6:12].reshape(2, 3), v[12:])
        return np.array([getattr(terms(errors), name) for name in TRACKING])

    assert (of(numbers) > 0).all()
    assert (of(numbers) < 1).all()
    assert (of(factor * numbers) < of(numbers)).all()
    assert of(-numbers) == pytest.approx(of(numbers))


def test_penalties_worked_by_hand() -> None:
    a_fb, last = ZERO.copy(), ZERO.copy()
    a_fb[0], a_fb[5], last[5] = 0.5, -1.0, 0.25
    velocities, accelerations = ZERO.copy(), ZERO.copy()
    velocities[3], velocities[4] = 2.0, -3.0
    accelerations[11] = -400.0
    found = terms(a_fb=a_fb, last_a_fb=last, velocities=velocities, accelerations=accelerations)
    assert found.feedback == pytest.approx(-0.1 * 1.5)
    assert found.feedback_rate == pytest.approx(-0.05 * 1.75)
    assert found.static_velocity == pytest.approx(-0.02 * 5)
    assert found.static_acceleration == pytest.approx(-0.4)
    assert [getattr(found, name) for name in ("live", *TRACKING)] == [1] * 7


@pytest.mark.parametrize("sign", [-1, 1])
def test_penalties_do_not_depend_on_signs_and_end_at_minus_one(sign: int) -> None:
    a_fb = sign * ONES
    found = terms(a_fb=a_fb, last_a_fb=-a_fb, velocities=sign * 5 * ONES, accelerations=sign * 1e4 * ONES)
    # 12 x 0.1, 12 x 0.05 x 2, 12 x 0.02 x 5, 12 x 0.001 x 1e4 are all beyond 1
    assert (found.feedback, found.feedback_rate, found.static_velocity, found.static_acceleration) == (-1, -1, -1, -1)


@pytest.mark.parametrize("part", range(4))
def test_static_terms_need_every_target_rate_to_be_zero(part: int) -> None:
    moving = [v.copy() for v in NO_RATES]
    moving[part].flat[-1] = -0.001
    found = terms(rates=NodeRates(*moving), velocities=ONES, accelerations=ONES)
    assert (found.static_velocity, found.static_acceleration) == (0, 0)
    still = terms(velocities=ONES, accelerations=ONES)
    assert (still.static_velocity, still.static_acceleration) == pytest.approx((-0.24, -0.012))


def test_total_is_the_weighted_sum() -> None:
    weights = Terms(*(float(i + 1) for i in range(11)))
    values = Terms(1.0, 0.5, 0.25, 0.0, 1.0, 0.1, 0.2, -0.5, -1.0, 0.0, -0.1)
    assert rewards.total(weights, values) == pytest.approx(
        1 + 2 * 0.5 + 3 * 0.25 + 5 + 6 * 0.1 + 7 * 0.2 - 8 * 0.5 - 9 - 11 * 0.1
    )


def test_weights_of_the_default_curriculum_reward_tracking_and_punish_effort(curriculum: Curriculum) -> None:
    weights = curriculum.rewards.weights
    assert min(weights) >= 0  # the penalties' values are negative already
    # the paper: the trunk's weights are 0.2 times the ankles'
    assert weights.trunk_position == pytest.approx(0.2 * weights.left_ankle_position)
    assert weights.trunk_orientation == pytest.approx(0.2 * weights.left_ankle_yaw)
    assert weights.left_ankle_position == weights.right_ankle_position
    assert weights.left_ankle_yaw == weights.right_ankle_yaw


def over_instants(function: Callable) -> Callable:
    """The function for (episode, task step, instant) at once."""
    return jax.jit(jax.vmap(jax.vmap(jax.vmap(function))))


stationary = over_instants(nodes.stationary)


@pytest.mark.parametrize("kind", ["stand", "squat", "walk", "turn", "stairs"])
def test_static_terms_are_active_during_every_stand_and_hold(episodes: Callable, kind: str) -> None:
    drawn = episodes(kind, 1.0, hold_after=(1, 4))
    assert drawn.command.rates.trunk_velocity.dtype == np.float32
    still = np.asarray(stationary(drawn.command.rates))
    holding = np.arange(still.shape[1]) >= drawn.task.hold_after[:, None]
    assert 0.5 < holding.mean() < 0.95
    if kind == "stand":
        assert still.all()
    else:
        assert still[holding].all()
        assert not still[~holding][:, :-1].any()  # at the last instant the step is over
    # a stand or a hold with a trunk that is tilted, where rounding makes rates that are not quite zero
    if kind in ("stand", "squat"):
        assert np.abs(drawn.command.target.trunk_orientation[..., 1]).max() > 0.05


@pytest.fixture(scope="module")
def scores(curriculum: Curriculum) -> Callable:
    """The reward without penalties of a robot 50 ms late and of one that stays where the step starts."""
    weights, sharpness = curriculum.rewards

    def score(step: planner.TaskStep, time: Any) -> tuple:
        asked, late = planner.command(step, time), planner.command(step, jnp.maximum(time - 0.05, 0)).target
        zero = jnp.zeros(12)
        return tuple(
            rewards.total(
                weights,
                rewards.terms(sharpness, nodes.difference(asked.target, real), asked.rates, zero, zero, zero, zero),
            )
            for real in (late, step.start)
        )

    return jax.jit(jax.vmap(jax.vmap(jax.vmap(score, (None, 0)))))


@pytest.mark.parametrize("difficulty", [0.0, 1.0])
@pytest.mark.parametrize("kind", ["walk", "sidle", "turn", "stairs"])
def test_standing_still_scores_below_stepping_late_when_stepping_is_asked(
    episodes: Callable, scores: Callable, kind: str, difficulty: float
) -> None:
    drawn = episodes(kind, difficulty)
    stepping, standing = (np.asarray(part).mean(axis=2) for part in scores(drawn.step, drawn.time))
    assert (stepping > standing + 0.05).all()
