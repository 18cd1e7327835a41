"""The environment against MuJoCo C and sums by hand: physics, clock, reward, falls, and a robot that blows up."""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bipedtrack import control, nodes, observation, planner, rewards, sampling
from bipedtrack import robot as robots
from bipedtrack.env import EnvConfig, TrackingEnv

QUICK_COMPILE = {"xla_backend_optimization_level": 0}  # these programs run a few times only
KINDS = ("stand", "stand", "squat", "walk", "walk", "sidle", "turn", "turn")
ROBOTS = len(KINDS)
PERIOD = 0.02  # s, of the policy: four control steps
CONTROL = control.ControlConfig(level_feet=True)
WEIGHTS = rewards.Terms(*(0.1 * i for i in range(1, 12)))  # all different
SIGMA = rewards.Sharpness()


class Compiled(NamedTuple):
    env: TrackingEnv
    begin: Any  # keys and distributions of ROBOTS robots -> states
    step: Any
    traces: list[str]  # one entry for each time a function was compiled


def distribution(kind: str, difficulty: float = 0.5, hold: bool = False) -> sampling.Distribution:
    shares = sampling.Shares(**{name: float(name == kind) for name in sampling.KINDS})
    return sampling.distribution(sampling.Ranges(), shares, difficulty, float(hold), (0, 0))


def stacked(kinds: tuple[str, ...], **options: Any) -> sampling.Distribution:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *(distribution(kind, **options) for kind in kinds))


def compiled(stairs: bool) -> Compiled:
    config = EnvConfig(rewards.RewardConfig(WEIGHTS), CONTROL, PERIOD, stairs)
    env = TrackingEnv(robots.load(), config, distribution("stairs" if stairs else "stand"))
    traces: list[str] = []

    def counted(function: Any) -> Any:
        def traced(*arguments: Any) -> Any:
            traces.append(function.__name__)
            return function(*arguments)

        return jax.jit(jax.vmap(traced), compiler_options=QUICK_COMPILE)

    return Compiled(env, counted(env.begin), counted(env.step), traces)


@pytest.fixture(scope="module")
def flat() -> Compiled:
    return compiled(stairs=False)


@pytest.fixture(scope="module")
def on_stairs() -> Compiled:
    return compiled(stairs=True)


def keys(seed: int) -> jax.Array:
    return jax.random.split(jax.random.PRNGKey(seed), ROBOTS)


def noise(seed: int, steps: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(steps, ROBOTS, 12)).astype(np.float32)


@pytest.fixture(scope="module")
def mixed(flat: Compiled) -> list[Any]:
    """States of ROBOTS robots of all kinds on level ground, the first and after each of six noisy policy steps."""
    states = [flat.begin(keys(0), stacked(KINDS))]
    for action in noise(0, 6):
        states.append(flat.step(states[-1], jnp.asarray(action)))
    return states


def one(tree: Any, i: int) -> Any:
    """Robot i of a batch in float64."""
    return jax.tree.map(lambda leaf: np.asarray(leaf, float)[i], tree)


def measured(model: mujoco.MjModel, qpos: np.ndarray) -> nodes.Nodes:
    """The nodes of qpos by MuJoCo's own kinematics."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    feet = [data.body(name) for name in ("left_foot", "right_foot")]
    return nodes.Nodes(
        data.body("trunk").xpos.copy(),
        data.body("trunk").xquat.copy(),
        np.array([foot.xpos for foot in feet]),
        np.array([math.atan2(foot.xmat[3], foot.xmat[0]) for foot in feet]),
    )


def apart(target: nodes.Nodes, real: nodes.Nodes) -> tuple[float, float, np.ndarray, np.ndarray]:
    """Trunk distance m and angle rad, ankle distances (2,) m and yaws (2,) rad."""
    turn = np.zeros(3)
    mujoco.mju_subQuat(turn, target.trunk_orientation / np.linalg.norm(target.trunk_orientation), real.trunk_orientation)
    yaws = np.angle(np.exp(1j * (target.ankle_yaws - real.ankle_yaws)))
    return (
        float(np.linalg.norm(target.trunk_position - real.trunk_position)),
        float(np.linalg.norm(turn)),
        np.linalg.norm(target.ankle_positions - real.ankle_positions, axis=1),
        np.abs(yaws),
    )


# Observation, metrics and reward


def test_observation_has_101_numbers_and_an_action_12(flat: Compiled, mixed: list[Any]) -> None:
    assert (flat.env.observation_size, flat.env.action_size) == (101, 12)
    assert [state.obs.shape for state in mixed] == [(ROBOTS, 101)] * 7
    assert all(np.isfinite(state.obs).all() for state in mixed)


def test_metrics_hold_every_reward_term_from_the_first_state_on(mixed: list[Any]) -> None:
    terms = {"live", "trunk_position", "trunk_orientation", "feedback", "feedback_rate"}
    terms |= {f"{leg}_ankle_{what}" for leg in ("left", "right") for what in ("position", "yaw")}
    terms |= {"static_velocity", "static_acceleration"}
    errors = {"ankle_error_cm", "ankle_yaw_error_deg", "trunk_error_cm", "trunk_error_deg"}
    for state in mixed:
        assert set(state.metrics) == terms | errors | {"fell", "nonfinite"}


def test_reward_is_the_weighted_sum_of_the_terms(mixed: list[Any]) -> None:
    for state in mixed[1:]:
        by_hand = sum(np.asarray(state.metrics[name], float) * w for name, w in WEIGHTS._asdict().items())
        np.testing.assert_allclose(state.reward, by_hand, atol=1e-5)


def test_reward_terms_and_errors_compare_the_command_and_the_robot_of_the_same_instant(
    mixed: list[Any], mj_model: mujoco.MjModel
) -> None:
    actions, steps = noise(0, 6).astype(float), mixed[0].info["episode"].step
    checked = 0
    for k, state in enumerate(mixed[1:], start=1):
        for i, kind in enumerate(KINDS):
            metrics, qvel = one(state.metrics, i), one(state.pipeline_state.qvel, i)
            qacc = one(state.pipeline_state.warmstart, i)  # of the last control step
            real = measured(mj_model, one(state.pipeline_state.qpos, i))
            # nobody's first task step is over: the clock stands at k policy periods
            early, now, late = (planner.command(one(steps, i), (k + d) * PERIOD) for d in (-1, 0, 1))
            trunk, tilt, ankles, yaws = apart(now.target, real)
            a_fb, last = np.clip(0.2 * actions[k - 1, i], -1, 1), np.clip(0.2 * actions[max(k - 2, 0), i], -1, 1)
            still = kind == "stand"
            wanted = {
                "live": 1.0,
                "trunk_position": math.exp(-SIGMA.trunk_position * trunk),
                "trunk_orientation": math.exp(-SIGMA.trunk_orientation * tilt),
                "left_ankle_position": math.exp(-SIGMA.ankle_position * ankles[0]),
                "right_ankle_position": math.exp(-SIGMA.ankle_position * ankles[1]),
                "left_ankle_yaw": math.exp(-SIGMA.ankle_yaw * yaws[0]),
                "right_ankle_yaw": math.exp(-SIGMA.ankle_yaw * yaws[1]),
                "feedback": -SIGMA.feedback * np.abs(a_fb).sum(),
                "feedback_rate": -SIGMA.feedback_rate * np.abs(a_fb - (last if k > 1 else 0)).sum(),
                "static_velocity": max(-1.0, -SIGMA.static_velocity * np.abs(qvel[6:]).sum()) if still else 0.0,
                "static_acceleration": max(-1.0, -SIGMA.static_acceleration * np.abs(qacc[6:]).sum()) if still else 0.0,
                "ankle_error_cm": 100 * ankles.mean(),
                "ankle_yaw_error_deg": math.degrees(yaws.mean()),
                "trunk_error_cm": 100 * trunk,
                "trunk_error_deg": math.degrees(tilt),
                "fell": 0.0,
                "nonfinite": 0.0,
            }
            found = {name: metrics[name] for name in wanted}
            assert found == pytest.approx(wanted, abs=2e-4, rel=1e-4), (k, kind)
            assert -1 < metrics["static_acceleration"] < 0 or not still
            for other in (early, late):  # the swing foot moves by centimetres in a policy period
                if kind in ("walk", "sidle", "turn") and k > 2:
                    checked += abs(100 * apart(other.target, real)[2].mean() - metrics["ankle_error_cm"]) > 0.05
    assert checked > 30


def test_observed_errors_are_those_of_the_same_instant_in_the_trunk_frame(
    mixed: list[Any], mj_model: mujoco.MjModel
) -> None:
    slices, steps = observation.layout(), mixed[0].info["episode"].step
    actions = noise(0, 6).astype(float)
    for k in (0, 6):
        for i in range(ROBOTS):
            obs, qpos = one(mixed[k].obs, i), one(mixed[k].pipeline_state.qpos, i)
            real, wanted = measured(mj_model, qpos), planner.command(one(steps, i), k * PERIOD)
            rotation = np.zeros(9)
            mujoco.mju_quat2Mat(rotation, qpos[3:7])
            to_b = rotation.reshape(3, 3).T
            for name, goal in (("target", wanted.target), ("end", wanted.end)):
                gap = (goal.ankle_positions - real.ankle_positions) @ to_b.T
                np.testing.assert_allclose(obs[slices[f"{name}_ankle_positions"]], gap.ravel(), atol=2e-6)
                gap = to_b @ (goal.trunk_position - real.trunk_position)
                np.testing.assert_allclose(obs[slices[f"{name}_trunk_position"]], gap, atol=2e-6)
            np.testing.assert_allclose(obs[slices["timer"]], wanted.timer, atol=1e-6)
            np.testing.assert_allclose(obs[slices["joint_positions"]], qpos[7:], atol=0)
            last = np.clip(0.2 * actions[k - 1, i], -1, 1) if k else np.zeros(12)
            np.testing.assert_allclose(obs[slices["last_feedback"]], last, atol=1e-6)


def test_a_robot_that_stands_on_its_target_has_no_errors(mixed: list[Any]) -> None:
    slices, first = observation.layout(), np.asarray(mixed[0].obs)
    level = [i for i, kind in enumerate(KINDS) if kind not in ("stand", "squat")]
    for part in ("trunk_position", "trunk_orientation", "ankle_positions"):
        assert np.abs(first[:, slices[f"target_{part}"]]).max() < 7e-6  # it starts 5 um deep in the ground
    # levelling the soles under a tilted trunk turns them a little
    assert np.abs(first[:, slices["target_ankle_yaws"]]).max() < 0.01
    assert np.abs(first[level, slices["target_ankle_yaws"]]).max() < 2e-6
    assert np.abs(first[level, slices["end_ankle_positions"]]).max(axis=1).min() > 1e-3


def test_one_program_serves_every_kind_and_difficulty(flat: Compiled, mixed: list[Any]) -> None:
    hard = flat.begin(keys(5), stacked(("squat",) * ROBOTS, difficulty=1.0))
    easy = flat.begin(keys(5), stacked(("walk",) * ROBOTS, difficulty=0.0))
    flat.step(hard, jnp.zeros((ROBOTS, 12)))
    assert flat.traces == ["begin", "step"]
    tasks_of = [state.info["episode"].task for state in (hard, easy)]
    assert np.ptp(tasks_of[0].motion.period) > 0.05 and np.ptp(tasks_of[1].motion.period) == 0


# Physics


def physics_of_c(state: Any, actions: np.ndarray, i: int, model: mujoco.MjModel, robot: robots.Robot) -> list[np.ndarray]:
    """qpos after each policy step of robot i by MuJoCo C in float64, its targets standing still."""
    data = mujoco.MjData(model)
    data.qpos[:] = one(state.pipeline_state.qpos, i)
    for box, pose in enumerate(one(state.pipeline_state.boxes, i)):
        data.mocap_pos[box], data.mocap_quat[box] = pose[:3], pose[3:]
    middle, half = (robot.joint_low + robot.joint_high) / 2, (robot.joint_high - robot.joint_low) / 2
    feedforward = (data.qpos[7:] - middle) / half
    filtered, found = feedforward.copy(), []
    for action in actions[:, i].astype(float):
        for _ in range(4):
            mixed = feedforward + robot.feedback_ratio * np.clip(0.2 * action, -1, 1)
            filtered = np.clip(0.4 * mixed + 0.6 * filtered, -1, 1)
            data.ctrl[:] = middle + half * filtered
            mujoco.mj_step(model, data)
        found.append(data.qpos.copy())
    return found


@pytest.mark.parametrize("ground", ["flat", "on_stairs"])
def test_physics_is_that_of_mujoco_c(ground: str, robot: robots.Robot, request: pytest.FixtureRequest) -> None:
    env, begin, step, _ = request.getfixturevalue(ground)
    kinds, actions = ("stand" if ground == "flat" else "stairs",) * ROBOTS, noise(1, 5)
    state = begin(keys(1), stacked(kinds, hold=True))
    # soles pressed in by 0.1 mm: where they just touch, rounding decides whether there is a contact at all
    pressed = state.pipeline_state.qpos.at[:, 2].add(-1e-4)
    state = state.replace(pipeline_state=state.pipeline_state._replace(qpos=pressed))
    states = [state]
    for action in actions:
        states.append(step(states[-1], jnp.asarray(action)))
    worst = []
    for i in range(ROBOTS):
        by_c = physics_of_c(state, actions, i, env.mj_model, robot)
        found = [one(later.pipeline_state.qpos, i) for later in states[1:]]
        assert np.abs(found[-1] - found[0]).max() > 0.01  # it moves
        worst.append(max(np.abs(a - b).max() for a, b in zip(found, by_c, strict=True)))
    # measured medians: 5e-7 and 3e-6; up to 1e-3 where a contact comes or goes, which rounding shifts by a step
    assert np.median(worst) < {"flat": 1e-5, "on_stairs": 5e-5}[ground] and max(worst) < 5e-3, worst


def test_a_policy_period_that_is_no_multiple_of_the_control_period_is_refused(robot: robots.Robot) -> None:
    for period in (0.012, 0.0049, 0.001, 0.0):
        with pytest.raises(ValueError, match=f"policy_period {period:g} s is no multiple of 0.005 s"):
            TrackingEnv(robot, EnvConfig(rewards.RewardConfig(), CONTROL, period), distribution("stand"))


def test_robots_stand_on_the_boxes_of_their_stairs(on_stairs: Compiled, robot: robots.Robot) -> None:
    state = on_stairs.begin(keys(2), stacked(("stairs",) * ROBOTS, hold=True))
    stairs = state.info["episode"].task.stairs
    top, down = np.asarray(stairs.height, float), np.asarray(stairs.rise) < 0
    assert down.any() and (~down).any() and top[down].min() > 0.5 and (top[~down] == 0).all()
    height = np.asarray(state.pipeline_state.qpos)[:, 2]
    for _ in range(15):  # 0.3 s, in which a falling robot drops by 0.44 m
        state = on_stairs.step(state, jnp.zeros((ROBOTS, 12)))
        assert not np.asarray(state.done).any()
    later = np.asarray(state.pipeline_state.qpos)[:, 2]
    np.testing.assert_allclose(later, height, atol=0.02)
    for i in range(ROBOTS):
        ankles = measured(on_stairs.env.mj_model, one(state.pipeline_state.qpos, i)).ankle_positions[:, 2]
        np.testing.assert_allclose(ankles, top[i] + robot.ankle_height, atol=0.012)


# Pushes


def test_pushes_come_every_two_seconds_and_last_a_tenth_of_one(flat: Compiled) -> None:
    ranges, steps = sampling.Ranges(push=(15.0, 15.0, 15.0)), 4000
    shares = sampling.Shares(**{name: float(name == "walk") for name in sampling.KINDS})
    given = sampling.distribution(ranges, shares, 0.5, 0.0, (0, 0), push_share=1.0)
    began = flat.begin(keys(0), jax.tree.map(lambda leaf: jnp.stack([leaf] * ROBOTS), given)).info["episode"]

    def pushed(episode: Any) -> Any:
        return jax.lax.scan(lambda e, _: (flat.env._pushed(e),) * 2, episode, length=steps)[1]

    episodes = jax.jit(jax.vmap(pushed))(began)
    force, left = np.asarray(episodes.push, float), np.asarray(episodes.push_left)
    acts = np.linalg.norm(force, axis=-1) > 0
    first = acts & (left == 4)  # of five policy steps
    count = int(first.sum())
    # each policy step without a push begins one in a hundred times: ROBOTS * steps / 105 = 305, give or take 17
    assert 240 < count < 370
    assert (force[..., 2] == 0).all()
    impulses = 0.1 * force[first]  # N s
    sizes = np.linalg.norm(impulses, axis=-1)
    assert sizes.max() <= 15 + 1e-4 and sizes.mean() == pytest.approx(7.5, abs=1.0) and sizes.min() < 1.0
    assert np.abs((impulses / sizes[:, None]).mean(axis=0)).max() < 0.2  # all directions
    for robot, step in np.argwhere(first[:, :-5]):
        assert (force[robot, step : step + 5] == force[robot, step]).all()
    assert acts.sum() <= 5 * count + 5 * ROBOTS and (left[acts] <= 4).all()


def test_a_push_moves_the_whole_robot_by_its_impulse(flat: Compiled, mixed: list[Any], mj_model: mujoco.MjModel) -> None:
    state, push = mixed[0], jnp.array([60.0, -80.0, 0.0])
    physics = state.pipeline_state
    aloft = state.replace(pipeline_state=physics._replace(qpos=physics.qpos.at[:, 2].add(1.0)))  # nothing else pushes
    episode = aloft.info["episode"]
    forces = jnp.tile(push, (ROBOTS, 1))
    shoved = aloft.replace(info={"episode": episode._replace(push=forces, push_left=episode.push_left + 3)})
    after = [flat.step(which, jnp.zeros((ROBOTS, 12))).pipeline_state for which in (aloft, shoved)]
    for i in range(ROBOTS):
        momenta = []
        for moved in after:
            data = mujoco.MjData(mj_model)
            data.qpos[:], data.qvel[:] = one(moved.qpos, i), one(moved.qvel, i)
            mujoco.mj_forward(mj_model, data)
            mujoco.mj_subtreeVel(mj_model, data)
            momenta.append(mj_model.body_subtreemass[0] * data.subtree_linvel[0])
        np.testing.assert_allclose(momenta[1] - momenta[0], np.asarray(push) * PERIOD, atol=0.02)  # N s


# The end of an episode


def test_a_fall_ends_the_episode_of_that_robot_alone(flat: Compiled, mixed: list[Any]) -> None:
    physics = mixed[0].pipeline_state
    tilted = jnp.array([math.cos(math.radians(35)), math.sin(math.radians(35)), 0, 0])
    qpos = physics.qpos.at[3, 3:7].set(tilted).at[5, 2].add(-0.8).at[3, 2].add(1.0)
    after = flat.step(mixed[0].replace(pipeline_state=physics._replace(qpos=qpos)), jnp.zeros((ROBOTS, 12)))
    np.testing.assert_array_equal(after.done, [0, 0, 0, 1, 0, 1, 0, 0])
    np.testing.assert_array_equal(after.metrics["fell"], after.done)
    assert not np.asarray(after.metrics["nonfinite"]).any()


def others(state: Any, poisoned: int) -> list[bytes]:
    keep = [i for i in range(ROBOTS) if i != poisoned]
    return [np.asarray(leaf)[keep].tobytes() for leaf in jax.tree.leaves(state)]


@pytest.mark.parametrize("velocity", [np.nan, np.inf, 3e38, 1e20, 1e8])
def test_a_robot_that_is_not_finite_ends_its_episode_and_leaves_all_others_bit_unchanged(
    flat: Compiled, mixed: list[Any], velocity: float
) -> None:
    poisoned, action = 4, jnp.asarray(noise(3, 1)[0])
    healthy = flat.step(mixed[2], action)
    physics = mixed[2].pipeline_state
    physics = physics._replace(qvel=physics.qvel.at[poisoned, 9].set(velocity))
    sick = flat.step(mixed[2].replace(pipeline_state=physics), action)
    np.testing.assert_array_equal(sick.done, np.eye(ROBOTS)[poisoned])
    np.testing.assert_array_equal(sick.metrics["nonfinite"], np.eye(ROBOTS)[poisoned])
    np.testing.assert_array_equal(sick.metrics["fell"], np.eye(ROBOTS)[poisoned])  # one rule of falls
    assert np.isfinite(sick.reward).all()
    assert others(sick, poisoned) == others(healthy, poisoned)
    assert others(flat.step(sick, action), poisoned) == others(flat.step(healthy, action), poisoned)
    if np.isfinite(velocity):  # the last finite state is observed
        assert np.isfinite(sick.obs).all() and all(np.isfinite(m).all() for m in sick.metrics.values())
