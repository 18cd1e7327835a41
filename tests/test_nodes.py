"""Nodes: their difference and their change of frame against scipy's rotations."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from bipedtrack import nodes
from bipedtrack.nodes import NodeRates, Nodes


def random_nodes(random: np.random.Generator, dtype: Any = np.float64) -> Nodes:
    q = random.normal(size=4)
    return Nodes(
        trunk_position=random.uniform(-3, 3, 3).astype(dtype),
        trunk_orientation=(q / np.linalg.norm(q)).astype(dtype),
        ankle_positions=random.uniform(-3, 3, (2, 3)).astype(dtype),
        ankle_yaws=random.uniform(-6, 6, 2).astype(dtype),
    )


def rotation(of: Nodes) -> Rotation:
    return Rotation.from_quat(of.trunk_orientation, scalar_first=True)


SEEDS = st.integers(0, 2**32 - 1).map(np.random.default_rng)


@given(SEEDS)
def test_difference_of_nodes_with_themselves_is_zero(random: np.random.Generator) -> None:
    same = random_nodes(random)
    for part in nodes.difference(same, same):
        assert part == pytest.approx(0, abs=1e-15)


@given(SEEDS)
def test_difference_points_from_real_to_target_in_the_real_trunk_frame(random: np.random.Generator) -> None:
    target, real = random_nodes(random), random_nodes(random)
    to_b = rotation(real).inv()
    errors = nodes.difference(target, real)
    assert errors.trunk_position == pytest.approx(to_b.apply(target.trunk_position - real.trunk_position))
    assert errors.ankle_positions == pytest.approx(to_b.apply(target.ankle_positions - real.ankle_positions))
    # turning on by the error, about the real trunk's own axes, leads to the target
    reached = rotation(real) * Rotation.from_rotvec(errors.trunk_orientation)
    assert (rotation(target).inv() * reached).magnitude() == pytest.approx(0, abs=1e-9)
    assert np.linalg.norm(errors.trunk_orientation) <= np.pi + 1e-12
    assert errors.ankle_yaws == pytest.approx(np.angle(np.exp(1j * (target.ankle_yaws - real.ankle_yaws))))


def test_difference_worked_by_hand() -> None:
    quarter = np.sqrt(0.5)
    real = Nodes(
        trunk_position=np.array([1.0, 2, 3]),
        trunk_orientation=np.array([quarter, 0, 0, quarter]),  # the robot looks along the world's y
        ankle_positions=np.array([[1.0, 2, 0], [1, 2, 0]]),
        ankle_yaws=np.array([3.0, -3.0]),
    )
    target = Nodes(
        trunk_position=np.array([1.0, 2.5, 3]),  # half a metre ahead
        trunk_orientation=np.array([1.0, 0, 0, 0]),  # a quarter turn to the right
        ankle_positions=np.array([[0.0, 2, 0], [1, 2, 1]]),  # a metre to the left; a metre up
        ankle_yaws=np.array([-3.0, -2.0]),
    )
    errors = nodes.difference(target, real)
    assert errors.trunk_position == pytest.approx(np.array([0.5, 0, 0]))
    assert errors.trunk_orientation == pytest.approx(np.array([0, 0, -np.pi / 2]))
    assert errors.ankle_positions == pytest.approx(np.array([[0, 1, 0], [0, 0, 1]]), abs=1e-12)
    assert errors.ankle_yaws == pytest.approx(np.array([2 * np.pi - 6, 1.0]))


@given(SEEDS)
def test_rates_keep_their_length_and_turn_into_the_trunk_frame(random: np.random.Generator) -> None:
    real = random_nodes(random)
    rates = NodeRates(*(random.normal(size=shape) for shape in (3, 3, (2, 3), 2)))
    turned = nodes.rates_in_trunk_frame(rates, real.trunk_orientation)
    to_b = rotation(real).inv()
    for in_world, in_trunk in zip(rates[:3], turned[:3], strict=True):
        assert in_trunk == pytest.approx(to_b.apply(in_world))
    assert (turned.ankle_yaw_rates == rates.ankle_yaw_rates).all()


@given(SEEDS)
def test_ankles_in_the_trunk_frame_are_where_scipy_puts_them(random: np.random.Generator) -> None:
    given_nodes = random_nodes(random)
    positions, yaws = nodes.ankles_in_trunk_frame(given_nodes)
    to_b = rotation(given_nodes).inv()
    relative = given_nodes.ankle_positions - given_nodes.trunk_position
    assert positions == pytest.approx(to_b.apply(relative))
    heading = to_b.apply([[np.cos(yaw), np.sin(yaw), 0] for yaw in given_nodes.ankle_yaws])
    assert yaws == pytest.approx(np.arctan2(heading[:, 1], heading[:, 0]), abs=1e-9)


@given(st.floats(-3, 3), st.floats(-1.5, 1.5))
def test_yaw_in_a_level_trunk_frame_is_the_angle_between_foot_and_trunk(trunk: float, foot: float) -> None:
    level = Nodes(
        trunk_position=np.zeros(3),
        trunk_orientation=Rotation.from_euler("z", trunk).as_quat(scalar_first=True),
        ankle_positions=np.zeros((2, 3)),
        ankle_yaws=np.array([trunk + foot, trunk - foot]),
    )
    assert nodes.ankles_in_trunk_frame(level)[1] == pytest.approx(np.array([foot, -foot]), abs=1e-12)


def test_float32_stays_float32() -> None:
    random = np.random.default_rng(0)
    target, real = random_nodes(random, np.float32), random_nodes(random, np.float32)
    assert {part.dtype for part in nodes.difference(target, real)} == {np.dtype(np.float32)}
    assert {part.dtype for part in nodes.ankles_in_trunk_frame(real)} == {np.dtype(np.float32)}
