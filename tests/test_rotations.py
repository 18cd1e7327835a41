"""Rotations against scipy's, in both precisions and for both array libraries."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from bipedtrack import rotations

TOLERANCE = {np.float32: 2e-6, np.float64: 1e-14}
PRECISIONS = st.sampled_from([np.float32, np.float64])
ANGLES = st.floats(-7, 7)


@st.composite
def unit_quaternions(draw: st.DrawFn) -> np.ndarray:
    q = np.array(draw(st.tuples(*[st.floats(-1, 1)] * 4)))
    length = np.linalg.norm(q)
    return q / length if length > 0.1 else np.array([1.0, 0, 0, 0])


@st.composite
def rotation_vectors(draw: st.DrawFn, longest: float = 7.0) -> np.ndarray:
    """Of any length from 1e-12 rad, so that half of them are small angles."""
    axis = draw(unit_quaternions())[1:]
    length = np.linalg.norm(axis)
    axis = axis / length if length > 0.01 else np.array([0, 0.6, -0.8])
    return axis * 10 ** draw(st.floats(-12, math.log10(longest)))


def scipy_rotation(q: Any) -> Rotation:
    return Rotation.from_quat(np.asarray(q, np.float64), scalar_first=True)


def assert_same_rotation(q: Any, expected: Rotation, tolerance: float) -> None:
    """q is a unit quaternion (either sign) of the expected rotation."""
    wanted = expected.as_quat(scalar_first=True)
    off = min(np.abs(q - wanted).max(), np.abs(q + wanted).max())
    assert off < tolerance


@given(unit_quaternions(), unit_quaternions(), PRECISIONS)
def test_product_first_turns_by_its_right_factor(a: np.ndarray, b: np.ndarray, dtype: Any) -> None:
    product = rotations.multiply(a.astype(dtype), b.astype(dtype))
    assert product.dtype == dtype
    assert_same_rotation(product, scipy_rotation(a) * scipy_rotation(b), TOLERANCE[dtype])


@given(unit_quaternions(), PRECISIONS)
def test_conjugate_is_the_inverse(q: np.ndarray, dtype: Any) -> None:
    assert_same_rotation(rotations.conjugate(q.astype(dtype)), scipy_rotation(q).inv(), TOLERANCE[dtype])


@given(unit_quaternions(), st.tuples(*[st.floats(-5, 5)] * 3), PRECISIONS)
def test_matrix_takes_vectors_from_body_to_world_and_back(q: np.ndarray, v: tuple, dtype: Any) -> None:
    matrix = rotations.to_matrix(q.astype(dtype))
    assert matrix.dtype == dtype
    tolerance = 20 * TOLERANCE[dtype]
    assert matrix @ np.array(v) == pytest.approx(scipy_rotation(q).apply(v), abs=tolerance)
    assert np.array(v) @ matrix == pytest.approx(scipy_rotation(q).inv().apply(v), abs=tolerance)


@given(rotation_vectors(), PRECISIONS)
def test_quaternion_of_a_rotation_vector(v: np.ndarray, dtype: Any) -> None:
    q = rotations.from_rotation_vector(v.astype(dtype))
    assert q.dtype == dtype
    assert_same_rotation(q, Rotation.from_rotvec(v), TOLERANCE[dtype])


@given(rotation_vectors(longest=3.1), PRECISIONS)
def test_rotation_vector_of_a_quaternion_of_either_sign(v: np.ndarray, dtype: Any) -> None:
    q = Rotation.from_rotvec(v).as_quat(scalar_first=True).astype(dtype)
    for quaternion in (q, -q):
        found = rotations.to_rotation_vector(quaternion)
        assert found.dtype == dtype
        assert found == pytest.approx(v, abs=4 * TOLERANCE[dtype])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_small_angles_keep_their_digits(dtype: Any) -> None:
    precision = 8 * float(np.finfo(dtype).eps)
    for angle in np.logspace(-12, 0, 500):
        v = angle * np.array([0.48, -0.6, 0.64])
        q = rotations.from_rotation_vector(v.astype(dtype))
        assert q[1:] == pytest.approx(np.sin(angle / 2) * v / angle, rel=precision, abs=0)
        assert q[0] == pytest.approx(np.cos(angle / 2), rel=precision, abs=0)
        assert rotations.to_rotation_vector(q) == pytest.approx(v, rel=precision, abs=0)


@given(unit_quaternions(), PRECISIONS)
def test_rotation_vector_is_the_shortest(q: np.ndarray, dtype: Any) -> None:
    found = rotations.to_rotation_vector(q.astype(dtype))
    assert np.linalg.norm(found) == pytest.approx(scipy_rotation(q).magnitude(), abs=4 * TOLERANCE[dtype])


@pytest.mark.parametrize("q", [(1, 0, 0, 0), (-1, 0, 0, 0)])
def test_rotation_vector_of_no_rotation_is_zero(q: tuple) -> None:
    assert (rotations.to_rotation_vector(np.array(q, np.float64)) == 0).all()


def test_half_a_turn_has_length_pi() -> None:
    for axis in np.eye(3):
        found = rotations.to_rotation_vector(np.array([0, *axis]))
        assert found == pytest.approx(math.pi * axis)


@given(ANGLES, PRECISIONS)
def test_yaw_turns_about_the_vertical(yaw: float, dtype: Any) -> None:
    q = rotations.from_yaw(np.asarray(yaw, dtype))
    assert q.dtype == dtype
    assert_same_rotation(q, Rotation.from_euler("z", yaw), TOLERANCE[dtype])


@given(ANGLES, ANGLES, ANGLES, PRECISIONS)
def test_euler_angles_roll_first_about_fixed_axes(roll: float, pitch: float, yaw: float, dtype: Any) -> None:
    q = rotations.from_euler(*(np.asarray(a, dtype) for a in (roll, pitch, yaw)))
    assert q.dtype == dtype
    assert_same_rotation(q, Rotation.from_euler("xyz", [roll, pitch, yaw]), TOLERANCE[dtype])


@given(st.floats(-1e4, 1e4), PRECISIONS)
def test_wrapped_angle_is_the_same_direction_within_half_a_turn(angle: float, dtype: Any) -> None:
    given_angle = np.array([angle], dtype)
    wrapped = rotations.wrap(given_angle)
    assert wrapped.dtype == dtype
    rounding = 4 * np.spacing(np.abs(given_angle) + dtype(4))
    assert (np.abs(wrapped) <= math.pi + rounding).all()
    off = np.exp(1j * wrapped.astype(np.float64)) - np.exp(1j * given_angle.astype(np.float64))
    assert (np.abs(off) <= rounding + 1e-15).all()


def test_wrap_worked_by_hand() -> None:
    pi = math.pi
    angles = np.array([0.0, 1.0, -1.0, pi, -pi, 3.5, -3.5, 2 * pi, 3 * pi, 7.0])
    expected = [0.0, 1.0, -1.0, pi, pi, 3.5 - 2 * pi, 2 * pi - 3.5, 0.0, pi, 7.0 - 2 * pi]
    assert rotations.wrap(angles) == pytest.approx(np.array(expected))


def test_jax_gives_numpys_numbers() -> None:
    random = np.random.default_rng(0)
    a, b = (q / np.linalg.norm(q, axis=1, keepdims=True) for q in random.normal(size=(2, 200, 4)))
    v = random.normal(size=(200, 3)) * 10 ** random.uniform(-8, 0.3, (200, 1))
    arguments = [x.astype(np.float32) for x in (a, b, v, *random.uniform(-7, 7, (3, 200)))]

    def everything(a: Any, b: Any, v: Any, roll: Any, pitch: Any, yaw: Any) -> tuple:
        return (
            rotations.multiply(a, b),
            rotations.conjugate(a),
            rotations.to_matrix(a),
            rotations.from_rotation_vector(v),
            rotations.to_rotation_vector(a),
            rotations.from_yaw(yaw),
            rotations.from_euler(roll, pitch, yaw),
            rotations.wrap(yaw),
        )

    in_jax = jax.jit(jax.vmap(everything))(*(jnp.asarray(x) for x in arguments))
    in_numpy = zip(*(everything(*row) for row in zip(*arguments, strict=True)), strict=True)
    for left, right in zip(in_jax, in_numpy, strict=True):
        assert left.dtype == jnp.float32
        assert np.asarray(left) == pytest.approx(np.stack(right), abs=2e-6)


def test_euler_angles_and_back() -> None:
    angles = (0.3, -0.4, 2.5)
    orientation = rotations.from_euler(*map(np.float64, angles))
    assert np.allclose(rotations.to_euler(orientation), angles)
