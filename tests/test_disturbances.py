"""Disturbances on MuJoCo's own models: what each does, against Newton's, Coulomb's and the motors' laws."""

import copy
import itertools
import math
from typing import Any

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bipedtrack import robot as robots
from bipedtrack.disturbances import LADDERS, Hooks
from bipedtrack.robot import Robot

DT = 0.005  # s
TO_TRUNK = slice(3, 7)  # the quaternion's columns of qpos
# the level of each ladder that leaves everything as it is
NOTHING = {
    "push": 0.0,
    "payload": 0.0,
    "friction": 1.0,
    "motor strength": 1.0,
    "delay": 0.0,
    "observation noise": 0.0,
    "link masses": 0.0,
}


def changed(hooks: Hooks, model: mujoco.MjModel, episode: int = 0) -> mujoco.MjModel:
    """A copy of the model as the hooks want it, with what MuJoCo derives from it brought up to date."""
    assert hooks.model_of is not None
    model = hooks.model_of(copy.copy(model), episode)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def standing(model: mujoco.MjModel) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    return data


# Ladders


def test_every_ladder_grows_and_has_a_level_that_changes_nothing() -> None:
    assert set(LADDERS) == set(NOTHING)
    for name, ladder in LADDERS.items():
        assert list(ladder.levels) == sorted(set(ladder.levels)), name
        assert NOTHING[name] in ladder.levels, name


def run(model: mujoco.MjModel, hooks: Hooks) -> np.ndarray:
    """What three robots do, (ticks, 3, 37), whose joint targets wander and follow what is observed of them."""
    models = [model if hooks.model_of is None else changed(hooks, model, i) for i in range(3)]
    datas = [standing(one) for one in models]
    random, found = np.random.default_rng(1), []
    for tick in (*range(30), *range(600, 630)):
        qpos, qvel = np.array([data.qpos for data in datas]), np.array([data.qvel for data in datas])
        found.append(np.concatenate([qpos, qvel], axis=1))
        told, told_rates = (qpos, qvel) if hooks.observed is None else hooks.observed(tick, qpos, qvel)
        targets = model.key_ctrl[0] + random.uniform(-0.05, 0.05, (3, 12))
        targets -= 0.1 * (told[:, 7:] - model.key_ctrl[0]) + 0.01 * told_rates[:, 6:]
        if hooks.before_step is not None:
            targets = hooks.before_step(tick, datas, targets)
        for one, data, target in zip(models, datas, targets, strict=True):
            data.ctrl[:] = target
            mujoco.mj_step(one, data)
    return np.array(found)


@pytest.mark.parametrize("name", LADDERS)
def test_robots_move_as_ever_at_the_level_that_changes_nothing_and_otherwise_at_all_others(
    name: str, mj_model: mujoco.MjModel
) -> None:
    undisturbed = run(mj_model, Hooks())
    for level in LADDERS[name].levels:
        off = np.abs(run(mj_model, LADDERS[name].hooks(level, DT)) - undisturbed).max(axis=(0, 2))
        if level == NOTHING[name]:
            assert off.max() < 1e-9
        else:
            assert off.min() > 1e-6, level


@pytest.mark.parametrize("name", LADDERS)
def test_a_disturbance_is_the_same_every_time(name: str, mj_model: mujoco.MjModel) -> None:
    level = LADDERS[name].levels[-1]
    first, second = (run(mj_model, LADDERS[name].hooks(level, DT)) for _ in range(2))
    assert (first == second).all()


# Pushes


@pytest.fixture(scope="module")
def weightless(mj_model: mujoco.MjModel) -> mujoco.MjModel:
    """The robot where nothing pulls at it, so that its momentum is what pushes have given it."""
    model = copy.copy(mj_model)
    model.opt.gravity[:] = 0
    return model


def momentum(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Of all links together, (3,) N s."""
    mujoco.mj_comVel(model, data)
    mujoco.mj_subtreeVel(model, data)
    return model.body_mass.sum() * data.subtree_linvel[0]


def test_a_push_gives_the_robot_its_impulse_in_eight_directions(weightless: mujoco.MjModel) -> None:
    hooks = LADDERS["push"].hooks(30.0, DT)
    assert hooks.before_step is not None
    datas = [standing(weightless) for _ in range(10)]
    for data in datas:
        data.qpos[2] = 5.0  # away from the ground
    targets = np.tile(weightless.key_ctrl[0], (10, 1))
    for tick in range(590, 640):
        assert hooks.before_step(tick, datas, targets) is targets
        if tick in (600, 620):
            before = [momentum(weightless, data) for data in datas]
            expected = 0.0 if tick == 600 else 30.0
            assert np.linalg.norm(before, axis=-1) == pytest.approx(expected, rel=5e-3, abs=1e-9)
        for data, target in zip(datas, targets, strict=True):
            data.ctrl[:] = target
            mujoco.mj_step(weightless, data)
    for episode, data in enumerate(datas):
        # forward, then every 45 deg to the left, and again from the ninth on
        angle = math.radians(45 * (episode % 8))
        expected = 30 * np.array([math.cos(angle), math.sin(angle), 0])
        np.testing.assert_allclose(momentum(weightless, data), expected, atol=0.15)


@pytest.mark.parametrize("timestep", [0.005, 0.002, 0.01])
def test_a_push_is_a_force_on_the_trunk_alone_from_3_s_to_3_1_s(timestep: float, mj_model: mujoco.MjModel) -> None:
    hooks = LADDERS["push"].hooks(20.0, timestep)
    assert hooks.before_step is not None
    data = mujoco.MjData(mj_model)
    trunk = mj_model.body("trunk").id
    pushed, impulse = [], np.zeros((mj_model.nbody, 6))
    for tick in range(round(5 / timestep)):
        hooks.before_step(tick, [data], np.zeros((1, 12)))
        impulse += data.xfrc_applied * timestep
        if data.xfrc_applied.any():
            pushed.append(tick * timestep)
    expected = np.zeros((mj_model.nbody, 6))
    expected[trunk, 0] = 20.0
    np.testing.assert_allclose(impulse, expected, atol=1e-9)
    assert pushed[0] == pytest.approx(3.0) and pushed[-1] == pytest.approx(3.1 - timestep)
    # MuJoCo applies it at the body's centre of mass, which is the middle of the trunk
    np.testing.assert_allclose(mj_model.body_ipos[trunk], 0, atol=1e-12)


# Models


def test_a_payload_weighs_its_mass_and_lies_at_the_trunks_centre(mj_model: mujoco.MjModel) -> None:
    before = standing(mj_model)
    loaded = changed(LADDERS["payload"].hooks(5.0, DT), mj_model)
    after = standing(loaded)
    # at rest the bias force of the trunk's height is the weight, and its moments say where the mass is
    weight = np.array([0, 0, 5.0 * 9.81, 0, 0, 0])
    np.testing.assert_allclose(after.qfrc_bias[:6] - before.qfrc_bias[:6], weight, atol=1e-9)
    np.testing.assert_allclose(after.qfrc_bias[6:], before.qfrc_bias[6:], atol=1e-9)
    # the trunk, a box of 0.3 m x 0.3 m x 0.15 m, becomes a heavier box of the same size: 25 kg instead of 20 kg
    expected = 25 / 12 * np.array([0.3**2 + 0.15**2, 0.3**2 + 0.15**2, 0.3**2 + 0.3**2])
    np.testing.assert_allclose(np.sort(loaded.body("trunk").inertia), np.sort(expected), rtol=1e-9)
    others = np.arange(loaded.nbody) != loaded.body("trunk").id
    assert (loaded.body_mass[others] == mj_model.body_mass[others]).all()
    assert (loaded.body_inertia[others] == mj_model.body_inertia[others]).all()


@pytest.mark.parametrize("coefficient", LADDERS["friction"].levels)
def test_a_sliding_sole_is_held_back_by_its_friction_times_its_load(coefficient: float) -> None:
    # on the ground, and on a tread of 0.1 m
    for boxes, height in (([], 0.0), ([(2.0, 2.0, 0.4)], 0.1)):
        model = changed(LADDERS["friction"].hooks(coefficient, DT), robots.build_model("ranger_max", boxes, converged=True))
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, 0)
        data.qpos[2] += height - 1e-3
        data.qvel[0] = 3.0  # far too fast to be stopped at once
        data.mocap_pos[:] = [0, 0, height - 0.2]
        mujoco.mj_forward(model, data)
        total = np.zeros(3)
        assert data.ncon == 8
        for i in range(data.ncon):
            force = np.zeros(6)
            mujoco.mj_contactForce(model, data, i, force)
            total += data.contact[i].frame.reshape(3, 3).T @ force[:3]
            assert data.contact[i].friction[2:] == pytest.approx([0.005, 0.0001, 0.0001])
        # which of the two bodies the force is on, and so its sign, is MuJoCo's choice
        assert abs(total[2]) > 100
        assert abs(total[0] / total[2]) == pytest.approx(coefficient, rel=1e-3)


@pytest.mark.parametrize("strength", LADDERS["motor strength"].levels)
def test_motors_scale_torques_and_their_limits(strength: float, mj_model: mujoco.MjModel, robot: Robot) -> None:
    model = changed(LADDERS["motor strength"].hooks(strength, DT), mj_model)
    random = np.random.default_rng(2)
    data = standing(model)
    saturated = []
    for spread in (0.02, 0.02, 1.0, 1.0):
        joints = model.key_qpos[0, 7:] + random.uniform(-0.02, 0.02, 12)
        rates = random.uniform(-1, 1, 12)
        targets = np.clip(joints + random.uniform(-spread, spread, 12), robot.joint_low, robot.joint_high)
        data.qpos[7:], data.qvel[6:], data.ctrl[:] = joints, rates, targets
        mujoco.mj_forward(model, data)
        wanted = strength * (robot.kp * (targets - joints) - robot.kd * rates)
        limit = strength * robot.torque_limit
        np.testing.assert_allclose(data.qfrc_actuator[6:], np.clip(wanted, -limit, limit), atol=1e-9)
        saturated.append((abs(wanted) > limit).mean())
    assert min(saturated) < 0.2 < 0.5 < max(saturated)


def test_masses_are_off_by_up_to_the_spread_by_link_and_by_episode(mj_model: mujoco.MjModel) -> None:
    hooks = LADDERS["link masses"].hooks(0.1, DT)
    links = mj_model.body_mass > 0
    assert links.sum() == 7
    models = [changed(hooks, mj_model, episode) for episode in range(60)]
    factors = np.array([model.body_mass[links] / mj_model.body_mass[links] for model in models])
    assert 0.9 <= factors.min() < 0.905 and 1.095 < factors.max() <= 1.1
    # uniform: the mean of 420 is 1 within four of its standard deviations, and so is the deviation
    assert factors.mean() == pytest.approx(1, abs=4 * 0.1 / math.sqrt(3 * 420))
    assert factors.std() == pytest.approx(0.1 / math.sqrt(3), rel=0.1)
    assert len(np.unique(factors.round(12))) == factors.size
    for model, row in zip(models, factors, strict=True):
        np.testing.assert_allclose(model.body_inertia[links], mj_model.body_inertia[links] * row[:, None], rtol=1e-12)
        np.testing.assert_allclose(model.body_subtreemass[0], mj_model.body_mass[links] @ row, rtol=1e-12)
    # a wider spread is the same masses further off
    narrow = changed(LADDERS["link masses"].hooks(0.05, DT), mj_model, 7).body_mass[links] / mj_model.body_mass[links]
    np.testing.assert_allclose(2 * (narrow - 1), factors[7] - 1, atol=1e-12)


# Delays


@pytest.mark.parametrize(
    ("steps", "expected"),
    [(0.0, [0, 1, 2, 3, 4, 5]), (1.0, [0, 0, 1, 2, 3, 4]), (2.0, [0, 0, 0, 1, 2, 3])],
)
def test_delayed_targets_are_those_of_steps_before(steps: float, expected: list[int]) -> None:
    hooks = LADDERS["delay"].hooks(steps, DT)
    assert hooks.before_step is not None
    for start in (0, 100):  # the second recording knows nothing of the first
        asked = [np.full((2, 12), start + tick) + [[0], [50]] for tick in range(6)]
        found = [hooks.before_step(tick, [], targets.copy()) for tick, targets in enumerate(asked)]
        np.testing.assert_array_equal(found, [asked[tick] for tick in expected])


# Noise


def observe(level: float, qpos: np.ndarray, qvel: np.ndarray, ticks: int) -> list[tuple[np.ndarray, np.ndarray]]:
    hooks = LADDERS["observation noise"].hooks(level, DT)
    assert hooks.observed is not None
    return [hooks.observed(tick, qpos, qvel) for tick in range(ticks)]


@pytest.fixture(scope="module")
def states() -> tuple[np.ndarray, np.ndarray]:
    """Many robots, qpos (4000, 19) and qvel (4000, 18), that head anywhere with level trunks."""
    random = np.random.default_rng(3)
    qpos, qvel = random.uniform(-1, 1, (4000, 19)), random.uniform(-1, 1, (4000, 18))
    qpos[:, TO_TRUNK] = Rotation.from_euler("z", random.uniform(-3, 3, (4000, 1))).as_quat(scalar_first=True)
    return qpos, qvel


@pytest.mark.parametrize("level", [0.5, 1.0, 2.0])
def test_noise_has_its_standard_deviations(level: float, states: tuple) -> None:
    qpos, qvel = states
    for found, found_rates in observe(level, qpos, qvel, 2):
        true, seen = (Rotation.from_quat(part[:, TO_TRUNK], scalar_first=True) for part in (qpos, found))
        tilt = (seen * true.inv()).as_rotvec()[:, :2]
        groups = [
            (tilt, 0.01),  # rad
            (found[:, 7:] - qpos[:, 7:], 0.01),  # rad
            (found_rates[:, :3] - qvel[:, :3], 0.05),  # m/s
            (found_rates[:, 3:6] - qvel[:, 3:6], 0.1),  # rad/s
            (found_rates[:, 6:] - qvel[:, 6:], 0.2),  # rad/s
        ]
        for off, deviation in groups:
            # 4000 numbers give a deviation within 5 %, more than four of its own deviations of 1 / sqrt(8000)
            assert off.std(axis=0) == pytest.approx(level * deviation, rel=0.05)
            assert np.abs(off.mean(axis=0)).max() < 5 * level * deviation / math.sqrt(4000)
        together = np.concatenate([off for off, _ in groups], axis=1)
        assert np.abs(np.corrcoef(together.T) - np.eye(together.shape[1])).max() < 0.08
        assert np.linalg.norm(found[:, TO_TRUNK], axis=1) == pytest.approx(1, abs=1e-12)
        assert (found[:, :3] == qpos[:, :3]).all()


def test_noise_is_white_and_the_same_for_the_next_policy(states: tuple) -> None:
    qpos, qvel = states
    first, second = observe(1.0, qpos, qvel, 3), observe(1.0, qpos, qvel, 3)
    for (a, a_rates), (b, b_rates) in zip(first, second, strict=True):
        assert (a == b).all() and (a_rates == b_rates).all()
    for (a, a_rates), (b, b_rates) in itertools.combinations(first, 2):
        for now, then, true in ((a[:, 7:], b[:, 7:], qpos[:, 7:]), (a_rates, b_rates, qvel)):
            related = [np.corrcoef(x, y)[0, 1] for x, y in zip((now - true).T, (then - true).T, strict=True)]
            assert np.abs(related).max() < 0.08


def test_noise_is_only_on_what_is_told(states: tuple) -> None:
    qpos, qvel = (part.copy() for part in states)
    observe(2.0, qpos, qvel, 2)
    before: Any = states
    assert (qpos == before[0]).all() and (qvel == before[1]).all()
    for found, found_rates in observe(0.0, qpos, qvel, 2):
        np.testing.assert_allclose(found, qpos, atol=1e-14)
        assert (found_rates == qvel).all()
