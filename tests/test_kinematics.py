"""Leg kinematics against MuJoCo's, and the workspace projection against brute force."""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from bipedtrack import kinematics
from bipedtrack.kinematics import project
from bipedtrack.robot import Robot

PRECISIONS = st.sampled_from([np.float32, np.float64])
TOLERANCE = {np.float32: 1e-4, np.float64: 1e-6}
SEEDS = st.integers(0, 2**32 - 1).map(np.random.default_rng)
FEET = ("left_foot", "right_foot")


def posed(model: mujoco.MjModel, joints: np.ndarray, trunk: tuple | None = None) -> mujoco.MjData:
    """MuJoCo's forward kinematics, trunk = (position, quaternion), by default at the world's origin."""
    data = mujoco.MjData(model)
    data.qpos[:3], data.qpos[3:7] = trunk or ([0, 0, 0], [1, 0, 0, 0])
    data.qpos[7:] = joints
    mujoco.mj_kinematics(model, data)
    return data


def feet(data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
    """Positions (2, 3) of the ankles and matrices (2, 3, 3) of the feet."""
    return tuple(np.array([getattr(data.body(f), x) for f in FEET]) for x in ("xpos", "xmat"))


def ankle_offset(length: Any, tilt: Any, roll: Any, yaw: Any) -> np.ndarray:
    """Hip to ankle (..., 3) of a leg that hangs down, swung about y, then x, then z: how a leg moves."""
    x, y, z = -length * np.sin(tilt), length * np.cos(tilt) * np.sin(roll), -length * np.cos(tilt) * np.cos(roll)
    return np.stack([np.cos(yaw) * x - np.sin(yaw) * y, np.sin(yaw) * x + np.cos(yaw) * y, z], axis=-1)


def pitch_limits(robot: Robot, length: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The tilts (rad, hip ahead of the ankle) that hip and ankle pitch allow a level foot at these leg lengths.

    By the law of cosines in the triangle hip, knee, ankle.
    """
    a, b = robot.thigh, robot.shank
    at_hip = np.arccos((a * a + length**2 - b * b) / (2 * a * length))
    at_ankle = np.arccos((b * b + length**2 - a * a) / (2 * b * length))
    low, high = robot.joint_low, robot.joint_high
    # the thigh points `at_hip` ahead of the line to the ankle, the shank `at_ankle` behind it
    # hip pitch = tilt - at_hip, ankle pitch = -at_ankle - tilt
    return (
        np.maximum(low[2] + at_hip, -at_ankle - high[4]),
        np.minimum(high[2] + at_hip, -at_ankle - low[4]),
    )


@st.composite
def targets(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray]:
    """Ankles (2, 3) about the hips, mostly within a leg's reach, and yaws."""
    ankles = [
        [draw(st.floats(-0.5, 0.5)), 0.1 * side + draw(st.floats(-0.4, 0.4)), -0.075 - draw(st.floats(0.2, 0.8))]
        for side in (1, -1)
    ]
    return np.array(ankles), np.array(draw(st.tuples(*[st.floats(-1, 1)] * 2)))


def test_standing_by_the_law_of_cosines(robot: Robot) -> None:
    length = 0.75 - 0.075 - 0.04
    knee = math.pi - math.acos((0.4**2 + 0.35**2 - length**2) / (2 * 0.4 * 0.35))
    ankle = -math.asin(0.4 * math.sin(knee) / length)
    joints = kinematics.inverse(robot, np.array([[0, 0.1, 0.04 - 0.75], [0, -0.1, 0.04 - 0.75]]), np.zeros(2))
    assert joints == pytest.approx([0, 0, -knee - ankle, knee, ankle, 0] * 2)


def test_standing_is_the_models_keyframe(robot: Robot, mj_model: mujoco.MjModel) -> None:
    ankles = np.array([[0, 0.1, 0.04 - 0.75], [0, -0.1, 0.04 - 0.75]])
    stand = mj_model.key("stand")
    assert kinematics.inverse(robot, ankles, np.zeros(2)) == pytest.approx(stand.qpos[7:], abs=1e-6)
    assert stand.ctrl == pytest.approx(stand.qpos[7:])


@given(targets(), PRECISIONS)
def test_inverse_puts_level_feet_where_mujoco_finds_them(
    robot: Robot, mj_model: mujoco.MjModel, target: tuple, dtype: Any
) -> None:
    ankles, yaws = project(robot.cast(dtype), *(part.astype(dtype) for part in target))
    joints = kinematics.inverse(robot.cast(dtype), ankles, yaws)
    assert joints.dtype == dtype
    tolerance = TOLERANCE[dtype]
    assert (joints >= robot.joint_low - tolerance).all()
    assert (joints <= robot.joint_high + tolerance).all()
    found, matrices = feet(posed(mj_model, joints))
    assert found == pytest.approx(ankles, abs=tolerance)
    # eq (1): the foot's z axis is parallel to the trunk's
    assert matrices.reshape(2, 3, 3)[:, 2] == pytest.approx(np.array([[0, 0, 1]] * 2), abs=tolerance)
    assert np.arctan2(matrices[:, 3], matrices[:, 0]) == pytest.approx(yaws, abs=tolerance)


@given(st.floats(0.36, 0.73), st.floats(0.02, 0.98), st.floats(-0.5, 0.5), st.floats(-0.78, 0.78), st.booleans(), PRECISIONS)
def test_every_pose_within_the_limits_is_reached_unprojected(
    robot: Robot,
    mj_model: mujoco.MjModel,
    length: float,
    share: float,
    roll: float,
    yaw: float,
    mirrored: bool,
    dtype: Any,
) -> None:
    lowest, highest = pitch_limits(robot, np.array(length))
    tilt = lowest + share * (highest - lowest)
    other = 0.1  # the other leg stands nearly straight
    offsets = np.stack([ankle_offset(length, tilt, roll, yaw), ankle_offset(0.7, 0, other, -other)])
    if mirrored:
        offsets = offsets[::-1]
    ankles, yaws = robot.hips + offsets, np.array([yaw, -other])[:: -1 if mirrored else 1]
    ankles, yaws = ankles.astype(dtype), yaws.astype(dtype)
    kept = project(robot.cast(dtype), ankles, yaws)
    tolerance = {np.float32: 2e-6, np.float64: 1e-13}[dtype]
    assert kept[0] == pytest.approx(ankles, abs=tolerance)
    assert kept[1] == pytest.approx(yaws, abs=tolerance)
    assert kinematics.reachable(robot.cast(dtype), ankles, yaws)
    found, _ = feet(posed(mj_model, kinematics.inverse(robot.cast(dtype), ankles, yaws)))
    assert found == pytest.approx(ankles, abs=TOLERANCE[dtype])


@given(SEEDS, PRECISIONS)
def test_forward_agrees_with_mujoco(robot: Robot, mj_model: mujoco.MjModel, random: np.random.Generator, dtype: Any) -> None:
    joints = random.uniform(robot.joint_low, robot.joint_high).astype(dtype)
    ankles, headings = kinematics.forward(robot.cast(dtype), joints)
    assert ankles.dtype == headings.dtype == dtype
    found, matrices = feet(posed(mj_model, joints))
    # an ankle roll leaves the foot's x axis where it is
    assert ankles == pytest.approx(found, abs=TOLERANCE[dtype] / 10)
    assert headings == pytest.approx(matrices.reshape(2, 3, 3)[:, :, 0], abs=TOLERANCE[dtype] / 10)


@given(SEEDS)
def test_centre_of_mass_agrees_with_mujoco(robot: Robot, mj_model: mujoco.MjModel, random: np.random.Generator) -> None:
    joints = random.uniform(robot.joint_low, robot.joint_high)

    def off(joints: np.ndarray) -> np.ndarray:
        data = posed(mj_model, joints)
        mujoco.mj_comPos(mj_model, data)
        return kinematics.centre_of_mass(robot, joints) - (data.subtree_com[0] - data.body("trunk").xpos)

    assert np.abs(off(joints)).max() < 1e-3  # ankle roll is left out: it moves a foot's mass by at most 1.4 cm
    joints[[5, 11]] = 0
    assert off(joints) == pytest.approx(np.zeros(3), abs=1e-9)


@given(SEEDS, PRECISIONS)
def test_measured_nodes_agree_with_mujoco(
    robot: Robot, mj_model: mujoco.MjModel, random: np.random.Generator, dtype: Any
) -> None:
    joints = random.uniform(robot.joint_low, robot.joint_high)
    trunk = random.uniform(-3, 3, 3), Rotation.random(rng=random).as_quat(scalar_first=True)
    qpos = np.concatenate([*trunk, joints]).astype(dtype)
    measured = kinematics.measure(robot.cast(dtype), qpos)
    found, matrices = feet(posed(mj_model, joints, trunk))
    assert measured.trunk_position == pytest.approx(trunk[0], abs=TOLERANCE[dtype])
    assert measured.trunk_orientation == pytest.approx(trunk[1], abs=TOLERANCE[dtype])
    assert measured.ankle_positions == pytest.approx(found, abs=TOLERANCE[dtype] / 10)
    on_ground = matrices[:, [0, 3]]
    lengths = np.hypot(*on_ground.T)
    expected = np.stack([np.cos(measured.ankle_yaws), np.sin(measured.ankle_yaws)], axis=-1) * lengths[:, None]
    assert expected == pytest.approx(on_ground, abs=TOLERANCE[dtype] / 10)


@given(targets(), st.tuples(*[st.floats(-0.25, 0.25)] * 3))
def test_level_feet_have_vertical_soles_the_same_ankles_and_the_same_headings(
    robot: Robot, mj_model: mujoco.MjModel, target: tuple, turn: tuple
) -> None:
    rotation = Rotation.from_rotvec(turn)
    quaternion = rotation.as_quat(scalar_first=True)
    tilted = kinematics.inverse(robot, *project(robot, *target))
    joints = kinematics.level_feet(robot, tilted, quaternion)
    before, _ = feet(posed(mj_model, tilted, ([0, 0, 0], quaternion)))
    after, matrices = feet(posed(mj_model, joints, ([0, 0, 0], quaternion)))
    assert (joints >= robot.joint_low - 1e-12).all()
    assert (joints <= robot.joint_high + 1e-12).all()
    for foot, leg in ((0, slice(0, 6)), (1, slice(6, 12))):
        if ((joints[leg] <= robot.joint_low[leg]) | (joints[leg] >= robot.joint_high[leg])).any():
            continue
        assert after[foot] == pytest.approx(before[foot], abs=1e-9)
        assert matrices[foot, [2, 5, 8]] == pytest.approx([0, 0, 1], abs=1e-9)
        # the foot's x axis, projected on the trunk's transverse plane, points to the yaw in F_B that was asked for
        seen = rotation.inv().apply(matrices[foot, [0, 3, 6]])
        assert np.arctan2(seen[1], seen[0]) == pytest.approx(tilted[leg][0], abs=1e-9)


@given(targets(), st.floats(-3, 3))
def test_level_feet_change_nothing_under_a_level_trunk(robot: Robot, target: tuple, yaw: float) -> None:
    joints = kinematics.inverse(robot, *project(robot, *target))
    level = Rotation.from_euler("z", yaw).as_quat(scalar_first=True)
    assert kinematics.level_feet(robot, joints, level) == pytest.approx(joints, abs=1e-12)


def finite_targets(dtype: Any) -> st.SearchStrategy:
    """Any finite numbers, the largest and the smallest among them."""
    largest = float(np.finfo(dtype).max)
    number = st.floats(-largest, largest, width=np.dtype(dtype).itemsize * 8)
    extreme = st.sampled_from([largest, -largest, 0.0, -0.0, float(np.finfo(dtype).tiny), 1e20, 0.1, -0.075])
    return st.lists(number | extreme, min_size=8, max_size=8).map(
        lambda v: (np.array(v[:6], dtype).reshape(2, 3), np.array(v[6:], dtype))
    )


def assert_within_the_workspace(robot: Robot, ankles: np.ndarray, yaws: np.ndarray, joints: np.ndarray) -> None:
    single = ankles.dtype == np.float32
    assert np.isfinite(ankles).all() and np.isfinite(yaws).all() and np.isfinite(joints).all()
    assert (joints >= robot.joint_low - (1e-4 if single else 1e-9)).all()
    assert (joints <= robot.joint_high + (1e-4 if single else 1e-9)).all()
    length = np.linalg.norm(robot.hips - ankles, axis=-1)
    assert (length >= robot.leg_length[0] - 1e-6).all() and (length <= robot.leg_length[1] + 1e-6).all()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@given(data=st.data())
def test_any_finite_target_has_a_finite_projection_in_numpy(robot: Robot, dtype: Any, data: st.DataObject) -> None:
    target = data.draw(finite_targets(dtype))
    ankles, yaws = project(robot.cast(dtype), *target)
    joints = kinematics.inverse(robot.cast(dtype), ankles, yaws)
    assert ankles.dtype == yaws.dtype == joints.dtype == dtype
    assert_within_the_workspace(robot, ankles, yaws, joints)
    # yaw moves to the nearest of the hip's range, whatever the position
    assert yaws == pytest.approx(np.clip(target[1], -math.pi / 4, math.pi / 4))


@pytest.fixture(scope="module", params=[np.float32, np.float64], ids=["float32", "float64"])
def compiled(request: pytest.FixtureRequest, robot: Robot) -> Callable[[Any, Any], tuple]:
    """project and inverse for batches, compiled by jax: ankles, yaws, joints."""
    double = request.param == np.float64
    own = robot.cast(request.param)

    def one(ankles: Any, yaws: Any) -> tuple:
        ankles, yaws = project(own, ankles, yaws)
        return ankles, yaws, kinematics.inverse(own, ankles, yaws)

    batched = jax.jit(jax.vmap(one))

    def run(ankles: np.ndarray, yaws: np.ndarray) -> tuple:
        with jax.enable_x64(double):
            found = batched(jnp.asarray(ankles, request.param), jnp.asarray(yaws, request.param))
            assert {part.dtype for part in found} == {np.dtype(request.param)}
            return tuple(np.asarray(part) for part in found)

    return run


def test_jax_projects_any_finite_target_as_numpy_does(robot: Robot, compiled: Callable) -> None:
    dtype = compiled(np.zeros((1, 2, 3)), np.zeros((1, 2)))[0].dtype.type
    random = np.random.default_rng(1)
    largest = np.finfo(dtype).max
    count = 3000
    exponents = random.uniform(math.log10(np.finfo(dtype).tiny), math.log10(largest), (count, 1, 1))
    numbers = random.uniform(-1, 1, (count, 2, 4)) * 10**exponents
    numbers[::7] = random.choice([0.0, 0.1, -0.075, 1.0, largest, -largest], numbers[::7].shape)
    numbers[1::7] = random.normal(size=numbers[1::7].shape)  # within reach or nearly so
    ankles, yaws = numbers[..., :3].astype(dtype), numbers[..., 3].astype(dtype)
    found = compiled(ankles, yaws)
    assert_within_the_workspace(robot, *(found[0].reshape(-1, 2, 3), found[1].reshape(-1, 2), found[2]))
    near = slice(1, None, 7)
    in_numpy = [project(robot.cast(dtype), *target) for target in zip(ankles[near], yaws[near], strict=True)]
    tolerance = {np.float32: 1e-4, np.float64: 1e-12}[dtype]
    assert found[0][near] == pytest.approx(np.stack([a for a, _ in in_numpy]), abs=tolerance)
    assert found[1][near] == pytest.approx(np.stack([y for _, y in in_numpy]), abs=tolerance)


@given(targets(), st.floats(0, 2))
def test_projecting_twice_is_projecting_once(robot: Robot, target: tuple, stretch: float) -> None:
    ankles = robot.hips + stretch * (target[0] - robot.hips)
    once = project(robot, ankles, target[1])
    twice = project(robot, *once)
    assert twice[0] == pytest.approx(once[0], abs=1e-9)
    assert (twice[1] == once[1]).all()


def steps_across(kind: str, random: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Hip-to-ankle vectors (count, 2, 3) and displacements of 1e-7 m where the projection might jump."""
    away = random.normal(size=(count, 2, 3))
    away /= np.linalg.norm(away, axis=-1, keepdims=True)
    displacement = 1e-7 * np.roll(away, 1, axis=0)
    sizes = {"reach": (0.2, 1.0), "inner limit": (0.3499, 0.3501), "outer limit": (0.7399, 0.7401)}
    sizes |= {"hip": (0, 0.03), "at the hip": (0, 1e-6), "far": (1, 1e4)}
    if kind in sizes:
        offset = away * random.uniform(*sizes[kind], (count, 2, 1))
        if kind.endswith("limit"):  # straight through the sphere
            displacement = 1e-7 * away
            offset = away * (0.35 if kind.startswith("inner") else 0.74) - displacement / 2
    else:  # from one side of the plane x = 0 or y = 0 to the other, above the hip
        side = {"left to right above the hip": 1, "back to front above the hip": 0}[kind]
        offset = np.abs(away) * random.uniform(0, 1, (count, 2, 1))
        displacement = np.zeros_like(offset)
        displacement[..., side] = 1e-7
        offset[..., side] = -0.5e-7
    return offset, displacement


@pytest.mark.parametrize(
    "kind",
    ["reach", "inner limit", "outer limit", "hip", "at the hip", "far"]
    + ["left to right above the hip", "back to front above the hip"],
)
@pytest.mark.parametrize("compiled", [np.float64], indirect=True, ids=["float64"])
def test_projection_is_continuous(robot: Robot, compiled: Callable, kind: str) -> None:
    random = np.random.default_rng(2)
    offset, displacement = steps_across(kind, random, 20000)
    yaws = random.uniform(-1, 1, offset.shape[:2])
    before, *_ = compiled(robot.hips + offset, yaws)
    after, *_ = compiled(robot.hips + offset + displacement, yaws)
    gain = np.linalg.norm(after - before, axis=-1) / 1e-7
    # within 1 cm of the hip the whole workspace is passed through; elsewhere nothing moves much faster than its target
    assert gain.max() < 200


@pytest.mark.parametrize("compiled", [np.float64], indirect=True, ids=["float64"])
def test_projection_is_continuous_in_yaw(robot: Robot, compiled: Callable) -> None:
    random = np.random.default_rng(3)
    offset = random.normal(size=(20000, 2, 3))
    yaws = random.uniform(-1, 1, (20000, 2))
    yaws[::2] = math.pi / 4 - 0.5e-7
    before = compiled(robot.hips + offset, yaws)
    after = compiled(robot.hips + offset, yaws + 1e-7)
    assert np.abs(after[0] - before[0]).max() < 1e-5
    assert np.abs(after[1] - before[1]).max() < 1.1e-7


def distances(targets: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The least distance from each of the targets (n, 3) to its own points (n, m, 3)."""
    return np.linalg.norm(points - targets[:, None], axis=-1).min(axis=1)


def parts(offset: np.ndarray, yaw: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Leg length, tilt and roll of hip-to-ankle vectors (..., 3): the inverse of ankle_offset."""
    x = np.cos(yaw) * offset[..., 0] + np.sin(yaw) * offset[..., 1]
    y = np.cos(yaw) * offset[..., 1] - np.sin(yaw) * offset[..., 0]
    return (
        np.linalg.norm(offset, axis=-1),
        np.arctan2(-x, np.hypot(y, offset[..., 2])),
        np.arctan2(y, -offset[..., 2]),
    )


@pytest.mark.parametrize("compiled", [np.float64], indirect=True, ids=["float64"])
def test_no_reachable_point_is_nearer_than_the_projection(robot: Robot, compiled: Callable) -> None:
    """Where roll and leg length bind; where a pitch limit binds, none of the same leg length is nearer."""
    random = np.random.default_rng(4)
    count, tries = 2000, 1000
    offset = random.normal(size=(count, 2, 3)) * random.choice([0.2, 0.5, 1.0], (count, 1, 1))
    offset[..., 2] = -np.abs(offset[..., 2]) - 0.02  # below the hip, outside the smooth turn about it
    yaws = random.uniform(-0.78, 0.78, (count, 2))
    ankles, _, joints = compiled(robot.hips + offset, yaws)
    # one leg is enough: the other is its mirror image
    offset, yaw, joints = offset[:, 0], yaws[:, 0], joints[:, :6]
    found = ankles[:, 0] - robot.hips[0]
    pitches = joints[:, [2, 4]]
    low, high = robot.joint_low[[2, 4]], robot.joint_high[[2, 4]]
    bound = ((pitches < low + 1e-9) | (pitches > high - 1e-9)).any(axis=-1)
    length, tilt, roll = parts(found, yaw)
    assert ankle_offset(length, tilt, roll, yaw) == pytest.approx(found, abs=1e-12)
    moved = np.linalg.norm(found - offset, axis=-1)
    assert 300 < bound.sum() < 1500 and (moved < 1e-9).sum() > 50 and (~bound & (moved > 1e-3)).sum() > 300

    # other reachable points: half of them anywhere, half close to the projection
    scale = np.where(np.arange(tries) < tries // 2, 1.0, 10.0 ** random.uniform(-5, -1, tries))
    u = random.uniform(-1, 1, (3, count, tries)) * scale
    lengths = np.clip(length[:, None] + u[0] * 0.4, *robot.leg_length)
    lengths = np.where(bound[:, None], length[:, None], lengths)
    lowest, highest = pitch_limits(robot, lengths)
    tilts = np.clip(tilt[:, None] + u[1] * 2, lowest, highest)
    rolls = np.clip(roll[:, None] + u[2], -math.pi / 6, math.pi / 6)
    others = ankle_offset(lengths, tilts, rolls, yaw[:, None])
    assert (distances(offset, others) >= moved - 1e-9).all()


def test_projection_worked_by_hand(robot: Robot) -> None:
    down = np.array([0.0, 0, -1])
    outside = robot.hips + np.stack([3 * down, 0.2 * down])
    ankles, yaws = project(robot, outside, np.array([2.0, -2.0]))
    assert ankles == pytest.approx(robot.hips + np.stack([0.74 * down, 0.35 * down]))
    assert yaws == pytest.approx(np.array([math.pi / 4, -math.pi / 4]))
    # at 60 deg to the side, 0.6 m away: the nearest point of a leg rolled by 30 deg is 0.6 cos 30 deg along it
    sideways = 0.6 * np.array([0, math.sin(math.pi / 3), -math.cos(math.pi / 3)])
    expected = 0.6 * math.cos(math.pi / 6) * np.array([0, 0.5, -math.cos(math.pi / 6)])
    ankles, _ = project(robot, robot.hips + [sideways, sideways * [1, -1, 1]], np.zeros(2))
    assert ankles == pytest.approx(robot.hips + [expected, expected * [1, -1, 1]])


def test_at_the_hip_itself_the_leg_hangs_straight_down(robot: Robot) -> None:
    ankles, _ = project(robot, robot.hips.copy(), np.zeros(2))
    assert ankles == pytest.approx(robot.hips - [0, 0, 0.35])


@pytest.mark.parametrize(
    ("move", "turn", "expected"),
    [(0, 0, True), (5e-4, 0, True), (5e-3, 0, False), (0, 5e-4, True), (0, 0.01, False), (math.nan, 0, False)],
)
def test_reachable_means_that_the_projection_leaves_it(robot: Robot, move: float, turn: float, expected: bool) -> None:
    ankles = robot.hips - np.array([[0, 0, 0.74 + move], [0, 0, 0.6]])
    assert kinematics.reachable(robot, ankles, np.array([0, math.pi / 4 + turn])) is expected
