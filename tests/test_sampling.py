"""Ranges and what is drawn from them."""

import jax
import numpy as np
import pytest

from bipedtrack import sampling
from bipedtrack.curriculum import Curriculum
from bipedtrack.sampling import Shares


def test_difficulty_scales_ranges_between_the_mildest_value_and_the_full_range(curriculum: Curriculum) -> None:
    given = sampling.distribution(curriculum.ranges, Shares(1, 1, 2, 2, 2, 0), 0.25, 0.0, (1, 8))
    for name, (lowest, mildest, highest) in curriculum.ranges._asdict().items():
        expected = [0.25 * lowest + 0.75 * mildest, 0.25 * highest + 0.75 * mildest]
        assert np.asarray(given.ranges[name]) == pytest.approx(expected, abs=1e-6), name


@pytest.mark.parametrize(
    ("name", "value"), [("walk_step", (0.0, -0.1, 0.2)), ("lift", (0.2, 0.1, 0.1)), ("period", (0.0, 0.5, 0.7))]
)
def test_ranges_that_make_no_sense_are_refused(curriculum: Curriculum, name: str, value: tuple) -> None:
    curriculum.ranges.validate()
    with pytest.raises(ValueError, match=name):
        curriculum.ranges._replace(**{name: value}).validate()


def test_the_usual_sway_is_the_mildest_within_what_a_pendulum_does(curriculum: Curriculum) -> None:
    for mildest, usual in ((-0.5, 0.0), (0.4, 0.4), (1, 1.0), (1.5, 1.0)):
        found = curriculum.ranges._replace(sway=(-1.0, mildest, 2.0)).usual_sway
        assert found == usual and isinstance(found, float)


@pytest.mark.parametrize("shares", [Shares(0, 0, 0, 0, 0, 0), Shares(1, 1, -1, 0, 0, 0)])
def test_shares_that_draw_nothing_are_refused(shares: Shares) -> None:
    with pytest.raises(ValueError, match="shares"):
        shares.validate()


def test_numbers_are_drawn_evenly_and_each_by_itself() -> None:
    ranges = {"first": np.array([2.0, 3.0]), "second": np.array([-1.0, -1.0]), "third": np.array([0.0, 8.0])}
    draw = jax.vmap(lambda key: sampling.sample(key, ("third", "second", "first"), ranges))
    found = draw(jax.random.split(jax.random.PRNGKey(0), 4000))
    assert set(found) == {"first", "second", "third"} and (found["second"] == -1).all()
    shares = np.stack([found["first"] - 2, found["third"] / 8])
    quantiles = np.quantile(shares, [0, 0.25, 0.5, 0.75, 1], axis=1)
    assert quantiles == pytest.approx(np.array([[0, 0.25, 0.5, 0.75, 1]] * 2).T, abs=0.03)
    assert abs(np.corrcoef(shares)[0, 1]) < 0.06
