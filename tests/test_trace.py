"""Traces: written and read back with numpy alone, and measured nodes against MuJoCo's own kinematics."""

import itertools
import pathlib
from typing import Any

import mujoco
import numpy as np
import pytest

from bipedtrack import kinematics, trace
from bipedtrack.nodes import Nodes
from bipedtrack.robot import LEGS, Robot
from bipedtrack.trace import Trace

ROBOTS, ENTRIES = 3, 8
NODES = ("trunk_position", "trunk_orientation", "ankle_positions", "ankle_yaws")
PLAIN = ("time", "qpos", "qvel", "timer", "still", "feedback", "joint_targets", "torques", "foot_forces", "alive")


def stack(parts: list[Nodes]) -> Nodes:
    return Nodes(*(np.array(column).reshape(ROBOTS, ENTRIES, *column[0].shape) for column in zip(*parts, strict=True)))


@pytest.fixture(scope="module")
def recorded(robot: Robot) -> Trace:
    """Robots with any joint angles and trunks anywhere, measured; every number differs from every other."""
    random = np.random.default_rng(5)
    axes = (ROBOTS, ENTRIES)

    def poses() -> np.ndarray:
        position, turn = random.uniform(-2, 2, (*axes, 3)), random.normal(size=(*axes, 4))
        joints = random.uniform(robot.joint_low, robot.joint_high, (*axes, 12))
        return np.concatenate([position, turn / np.linalg.norm(turn, axis=-1, keepdims=True), joints], axis=-1)

    def nodes(qpos: np.ndarray) -> Nodes:
        return stack([kinematics.measure(robot, one) for one in qpos.reshape(-1, 19)])

    qpos = poses()
    return Trace(
        time=np.arange(ENTRIES) * 0.005,
        qpos=qpos,
        qvel=random.normal(size=(*axes, 18)),
        target=nodes(poses()),
        measured=nodes(qpos),
        timer=random.uniform(size=(*axes, 2)).astype(np.float32),
        still=random.uniform(size=axes) < 0.5,
        feedback=random.uniform(-1, 1, (*axes, 12)),
        joint_targets=random.normal(size=(*axes, 12)),
        torques=random.normal(size=(*axes, 12)),
        foot_forces=random.normal(size=(*axes, 2)),
        alive=np.arange(ENTRIES) < np.array([[8], [5], [1]]),
    )


def read(path: pathlib.Path) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as arrays:
        return dict(arrays)


def test_a_saved_trace_is_read_by_numpy_under_the_names_of_its_fields(recorded: Trace, tmp_path: pathlib.Path) -> None:
    path = tmp_path / "0-first.model-mjx-walk-forward-0.npz"
    trace.save(recorded, path)
    assert list(tmp_path.iterdir()) == [path]
    arrays = read(path)
    expected = {name: getattr(recorded, name) for name in PLAIN}
    for side, name in itertools.product(("target", "measured"), NODES):
        expected[f"{side}_{name}"] = getattr(getattr(recorded, side), name)
    assert set(arrays) == set(expected)
    for name, array in expected.items():
        assert arrays[name].dtype == array.dtype, name
        np.testing.assert_array_equal(arrays[name], array, err_msg=name)


def test_nothing_that_needs_pickle_is_saved(recorded: Trace, tmp_path: pathlib.Path) -> None:
    nothing: Any = None
    with pytest.raises(ValueError, match="allow_pickle"):
        trace.save(recorded._replace(torques=nothing), tmp_path / "a.npz")


def test_saved_nodes_are_those_that_mujoco_finds_at_the_saved_qpos(
    recorded: Trace, mj_model: mujoco.MjModel, tmp_path: pathlib.Path
) -> None:
    trace.save(recorded.episode(1), tmp_path / "a.npz")
    arrays = read(tmp_path / "a.npz")
    assert arrays["qpos"].shape == (ENTRIES, 19)
    data = mujoco.MjData(mj_model)
    for entry, qpos in enumerate(arrays["qpos"]):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(mj_model, data)
        np.testing.assert_allclose(arrays["measured_trunk_position"][entry], data.body("trunk").xpos, atol=1e-9)
        np.testing.assert_allclose(arrays["measured_trunk_orientation"][entry], data.body("trunk").xquat, atol=1e-9)
        for foot, leg in enumerate(LEGS):
            body = data.body(f"{leg}_foot")
            heading = body.xmat.reshape(3, 3)[:, 0]
            np.testing.assert_allclose(arrays["measured_ankle_positions"][entry, foot], body.xpos, atol=1e-9)
            yaw = arrays["measured_ankle_yaws"][entry, foot]
            flat = heading[:2] / np.linalg.norm(heading[:2])
            np.testing.assert_allclose([np.cos(yaw), np.sin(yaw)], flat, atol=1e-9)


def test_an_episode_is_one_robots_trace(recorded: Trace) -> None:
    for index in (0, 2, -1):
        one = recorded.episode(index)
        assert isinstance(one, Trace)
        np.testing.assert_array_equal(one.time, np.arange(ENTRIES) * 0.005)
        assert one.alive.sum() == [8, 5, 1][index]
        assert one.qpos.shape == (ENTRIES, 19) and one.still.shape == (ENTRIES,)
        assert [part.shape[1:] for part in one.target] == [(3,), (4,), (2, 3), (2,)]
        # nothing of another robot: its nodes are those of its own joint angles
        np.testing.assert_array_equal(one.measured.trunk_position, recorded.qpos[index, :, :3])
        np.testing.assert_array_equal(one.target.ankle_yaws, recorded.target.ankle_yaws[index])
        for name in PLAIN[1:]:
            np.testing.assert_array_equal(getattr(one, name), getattr(recorded, name)[index], err_msg=name)


def test_episodes_at_indices_keep_their_order_and_their_axis(recorded: Trace) -> None:
    some = recorded.episode(np.array([2, 0, 2, 1]))
    assert some.alive.sum(axis=1).tolist() == [1, 8, 1, 5]
    np.testing.assert_array_equal(some.time, recorded.time)
    assert some.timestep == recorded.timestep == pytest.approx(0.005)
    for place, index in enumerate((2, 0, 2, 1)):
        for name in PLAIN[1:]:
            np.testing.assert_array_equal(getattr(some, name)[place], getattr(recorded, name)[index], err_msg=name)
        for side, name in itertools.product(("target", "measured"), NODES):
            found, known = getattr(getattr(some, side), name), getattr(getattr(recorded, side), name)
            assert found.shape == (4, *known.shape[1:])
            np.testing.assert_array_equal(found[place], known[index], err_msg=f"{side} {name}")
    single = recorded.episode(np.array([1]))
    assert single.qpos.shape == (1, ENTRIES, 19) and single.measured.ankle_positions.shape == (1, ENTRIES, 2, 3)
