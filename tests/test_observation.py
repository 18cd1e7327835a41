"""The observation of eq (8): its layout, its parts built another way, and what it must not depend on."""

import math
from collections import namedtuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from bipedtrack import kinematics, observation
from bipedtrack.nodes import NodeRates, Nodes
from bipedtrack.observation import Observation
from bipedtrack.planner import Command
from bipedtrack.robot import Robot

SEEDS = st.integers(0, 2**32 - 1).map(np.random.default_rng)

# eq (8), by its symbols
PARTS = {
    "I_error^s": ["end_trunk_position", "end_trunk_orientation", "end_ankle_positions", "end_ankle_yaws"],
    "I_error^t": ["target_trunk_position", "target_trunk_orientation", "target_ankle_positions", "target_ankle_yaws"],
    "I_v^t": [
        "trunk_velocity_target",
        "trunk_angular_velocity_target",
        "ankle_velocity_targets",
        "ankle_yaw_rate_targets",
    ],
    "T": ["timer"],
    "O_state": ["gravity", "trunk_velocity", "trunk_angular_velocity", "joint_positions", "joint_velocities"],
    "a_ff": ["feedforward"],
    "a_fb(t-1)": ["last_feedback"],
}
WIDTHS = {"I_error^s": 14, "I_error^t": 14, "I_v^t": 14, "T": 2, "O_state": 33, "a_ff": 12, "a_fb(t-1)": 12}


def quaternion(rotation: Rotation) -> np.ndarray:
    return rotation.as_quat(scalar_first=True)


def random_case(random: np.random.Generator, robot: Robot) -> dict:
    """A command, a state of the robot, a feedforward and a feedback."""

    def nodes() -> Nodes:
        return Nodes(
            trunk_position=random.uniform(-1, 1, 3),
            trunk_orientation=quaternion(Rotation.random(rng=random)),
            ankle_positions=random.uniform(-1, 1, (2, 3)),
            ankle_yaws=random.uniform(-3, 3, 2),
        )

    rates = NodeRates(*(random.normal(size=shape) for shape in (3, 3, (2, 3), 2)))
    orientation = quaternion(Rotation.random(rng=random))
    joints = random.uniform(robot.joint_low, robot.joint_high)
    return {
        "command": Command(nodes(), nodes(), rates, random.uniform(0, 0.7, 2)),
        "qpos": np.concatenate([random.uniform(-1, 1, 3), orientation, joints]),
        "qvel": random.normal(size=18),
        "a_ff": random.uniform(-1, 1, 12),
        "last_feedback": random.uniform(-1, 1, 12),
    }


def observe(robot: Robot, case: dict) -> np.ndarray:
    return observation.flatten(observation.observe(real=kinematics.measure(robot, case["qpos"]), **case))


def test_there_are_101_numbers_in_the_order_of_eq_8() -> None:
    assert observation.SIZE == 101
    layout = observation.layout()
    assert list(layout) == [name for names in PARTS.values() for name in names] == list(Observation._fields)
    at = 0
    for part, names in PARTS.items():
        start = at
        for name in names:
            assert layout[name].start == at
            at = layout[name].stop
        assert at - start == WIDTHS[part]
    assert at == 101


@given(random=SEEDS)
def test_parts_are_what_scipy_and_mujoco_make_of_the_state(
    robot: Robot, mj_model: mujoco.MjModel, random: np.random.Generator
) -> None:
    case = random_case(random, robot)
    flat = observe(robot, case)
    assert flat.shape == (101,)
    part = {name: flat[where] for name, where in observation.layout().items()}

    data = mujoco.MjData(mj_model)
    data.qpos[:], data.qvel[:] = case["qpos"], case["qvel"]
    mujoco.mj_forward(mj_model, data)
    trunk = mj_model.body("trunk").id
    to_b = Rotation.from_matrix(data.xmat[trunk].reshape(3, 3)).inv()
    ankles = np.array([data.body(f"{leg}_foot").xpos for leg in ("left", "right")])
    yaws = [math.atan2(*data.body(f"{leg}_foot").xmat[[3, 0]]) for leg in ("left", "right")]
    velocity = np.zeros(6)
    mujoco.mj_objectVelocity(mj_model, data, mujoco.mjtObj.mjOBJ_XBODY, trunk, velocity, 1)

    for prefix, wanted in (("end", case["command"].end), ("target", case["command"].target)):
        turn = to_b * Rotation.from_quat(wanted.trunk_orientation, scalar_first=True)
        expected = {
            "trunk_position": to_b.apply(wanted.trunk_position - data.xpos[trunk]),
            "trunk_orientation": turn.as_rotvec(),
            "ankle_positions": to_b.apply(wanted.ankle_positions - ankles).ravel(),
            "ankle_yaws": np.angle(np.exp(1j * (wanted.ankle_yaws - yaws))),
        }
        for name, value in expected.items():
            assert part[f"{prefix}_{name}"] == pytest.approx(value, abs=1e-7)
    rates = case["command"].rates
    expected = {
        "trunk_velocity_target": to_b.apply(rates.trunk_velocity),
        "trunk_angular_velocity_target": to_b.apply(rates.trunk_angular_velocity),
        "ankle_velocity_targets": to_b.apply(rates.ankle_velocities).ravel(),
        "ankle_yaw_rate_targets": rates.ankle_yaw_rates,
        "timer": case["command"].timer,
        "gravity": to_b.apply(mj_model.opt.gravity / np.linalg.norm(mj_model.opt.gravity)),
        "trunk_velocity": velocity[3:],
        "trunk_angular_velocity": velocity[:3],
        "joint_positions": case["qpos"][7:],
        "joint_velocities": case["qvel"][6:],
        "feedforward": case["a_ff"],
        "last_feedback": case["last_feedback"],
    }
    for name, value in expected.items():
        assert part[name] == pytest.approx(value, abs=1e-9)


@given(random=SEEDS, yaw=st.floats(-7, 7), shift=st.tuples(*[st.floats(-10, 10)] * 3))
def test_observation_does_not_depend_on_place_and_heading_in_the_world(
    robot: Robot, random: np.random.Generator, yaw: float, shift: tuple
) -> None:
    case = random_case(random, robot)
    turn = Rotation.from_euler("z", yaw)

    def moved(nodes: Nodes) -> Nodes:
        return Nodes(
            trunk_position=turn.apply(nodes.trunk_position) + shift,
            trunk_orientation=quaternion(turn * Rotation.from_quat(nodes.trunk_orientation, scalar_first=True)),
            ankle_positions=turn.apply(nodes.ankle_positions) + shift,
            ankle_yaws=nodes.ankle_yaws + yaw,
        )

    command, qpos, qvel = case["command"], case["qpos"], case["qvel"]
    rates = command.rates
    turned_rates = NodeRates(*(turn.apply(v) for v in rates[:3]), rates.ankle_yaw_rates)
    orientation = turn * Rotation.from_quat(qpos[3:7], scalar_first=True)
    elsewhere = case | {
        "command": Command(moved(command.end), moved(command.target), turned_rates, command.timer),
        "qpos": np.concatenate([turn.apply(qpos[:3]) + shift, quaternion(orientation), qpos[7:]]),
        "qvel": np.concatenate([turn.apply(qvel[:3]), qvel[3:]]),  # MuJoCo's angular velocity is in F_B already
    }
    here, there = observe(robot, case), observe(robot, elsewhere)
    angles = [i for name in ("end_ankle_yaws", "target_ankle_yaws") for i in np.arange(101)[observation.layout()[name]]]
    rest = np.setdiff1d(np.arange(101), angles)
    assert there[rest] == pytest.approx(here[rest], abs=1e-6)
    assert np.exp(1j * there[angles]) == pytest.approx(np.exp(1j * here[angles]), abs=1e-6)


def test_hash_changes_with_names_order_and_widths(monkeypatch: pytest.MonkeyPatch) -> None:
    widths = observation.WIDTHS._asdict()
    hashes = [observation.layout_hash(), observation.layout_hash()]
    assert hashes[0] == hashes[1]
    names = list(widths)
    twins = names.index("feedforward"), names.index("last_feedback")  # equally wide
    exchanged = names.copy()
    exchanged[twins[0]], exchanged[twins[1]] = exchanged[twins[1]], exchanged[twins[0]]
    others = [
        widths | {"timer": 3},
        widths | {"timer": widths["gravity"], "gravity": widths["timer"]},
        {name: widths[name] for name in exchanged},
        {name: widths[name] for name in reversed(names)},
    ]
    for other in others:
        monkeypatch.setattr(observation, "WIDTHS", namedtuple("Widths", other)(**other))
        hashes.append(observation.layout_hash())
    assert len(set(hashes[1:])) == 5


def test_jax_gives_numpys_observation_in_float32(robot: Robot) -> None:
    single = robot.cast(np.float32)
    random = np.random.default_rng(0)
    cases = [jax.tree.map(lambda x: np.asarray(x, np.float32), random_case(random, robot)) for _ in range(100)]
    in_jax = jax.jit(jax.vmap(lambda case: observe(single, case)))(jax.tree.map(lambda *x: jnp.stack(x), *cases))
    in_numpy = np.stack([observe(single, case) for case in cases])
    assert in_jax.dtype == in_numpy.dtype == np.float32
    assert np.asarray(in_jax) == pytest.approx(in_numpy, abs=1e-5)
