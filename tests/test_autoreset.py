"""Episodes begin wholly new, terminal observations are kept, and brax's advantages are those of separate episodes."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.agents.ppo import losses
from brax.training.logger import EpisodeMetricsLogger

from bipedtrack import control, observation, rewards, sampling
from bipedtrack import robot as robots
from bipedtrack.autoreset import AutoReset
from bipedtrack.env import EnvConfig, TrackingEnv

QUICK_COMPILE = {"xla_backend_optimization_level": 0}  # these programs run a few times only
ROBOTS, STEPS, LENGTH = 8, 40, 12
SHARES = sampling.Shares(stand=1, squat=1, walk=1, sidle=1, turn=1, stairs=0)
# (step, robot) before which the robot is tipped over, or explodes; the last step of an episode, and its first, too
TIPPED = ((4, 2), (11, 0), (12, 5), (30, 6), (31, 6), (39, 3))
EXPLODED = ((20, 1),)


class Recording(NamedTuple):
    """STEPS policy steps of ROBOTS robots: numpy arrays with the leading axes (step, robot)."""

    states: list[Any]  # STEPS + 1: before the first step and after each
    step: Any  # the compiled step
    actions: np.ndarray
    rewards: np.ndarray
    done: np.ndarray
    truncation: np.ndarray
    over: np.ndarray  # info episode_done
    metrics: dict[str, np.ndarray]
    sums: dict[str, np.ndarray]  # info episode_metrics


def disturbed(state: Any, step: int) -> Any:
    physics = state.pipeline_state
    for when, who in TIPPED:
        if when == step:
            tipped = jnp.array([np.cos(0.7), np.sin(0.7), 0, 0])  # 80 deg
            physics = physics._replace(qpos=physics.qpos.at[who, 3:7].set(tipped).at[who, 2].add(1.0))
    for when, who in EXPLODED:
        if when == step:
            physics = physics._replace(qvel=physics.qvel.at[who, 8].set(1e20))
    return state.replace(pipeline_state=physics)


@pytest.fixture(scope="module")
def recording() -> Recording:
    config = EnvConfig(rewards.RewardConfig(), control.ControlConfig(level_feet=True))
    given = sampling.distribution(sampling.Ranges(), SHARES, 0.5, 0.0, (0, 0))
    env = AutoReset(TrackingEnv(robots.load(), config, given), LENGTH)
    step = jax.jit(env.step, compiler_options=QUICK_COMPILE)
    actions = np.random.default_rng(0).normal(size=(STEPS, ROBOTS, 12)).astype(np.float32)
    states = [jax.jit(env.reset, compiler_options=QUICK_COMPILE)(jax.random.split(jax.random.PRNGKey(0), ROBOTS))]
    for t, action in enumerate(actions):
        states.append(step(disturbed(states[-1], t), jnp.asarray(action)))
    after = jax.tree.map(lambda *leaves: np.stack(leaves), *states[1:])
    info = after.info
    flags = (after.done, info["truncation"], info["episode_done"])
    return Recording(states, step, actions, after.reward, *flags, after.metrics, info["episode_metrics"])


def starts(recording: Recording) -> np.ndarray:
    """(STEPS, ROBOTS): whether this step begins a new episode, that is whether the one before ended one."""
    return np.concatenate([np.zeros((1, ROBOTS), bool), recording.over[:-1] > 0])


# Ends


def test_an_episode_ends_at_the_time_limit_or_by_a_fall_and_not_otherwise(recording: Recording) -> None:
    age, wanted_over, wanted_done = np.array(recording.states[0].info["clock"]), [], []
    ended = np.zeros(ROBOTS, bool)
    for t in range(STEPS):
        age = np.where(ended, 0, age + 1)
        falls = np.isin(np.arange(ROBOTS), [who for when, who in TIPPED + EXPLODED if when == t]) & ~ended
        ended = (age == LENGTH) | falls
        wanted_over.append(ended)
        wanted_done.append(falls)
    np.testing.assert_array_equal(recording.over, wanted_over)
    np.testing.assert_array_equal(recording.done, wanted_done)
    assert (recording.over > recording.done).sum() >= 2 * ROBOTS  # there are time limits
    assert ((recording.over > 0) & (recording.done > 0)).sum() == 6  # and falls


def test_the_step_after_an_end_begins_anew_with_truncation_and_without_reward(recording: Recording) -> None:
    begins = starts(recording)
    np.testing.assert_array_equal(recording.truncation, begins)
    assert (recording.rewards[begins] == 0).all() and (recording.rewards[~begins] > 0).all()
    assert (recording.done[begins] == 0).all() and (recording.over[begins] == 0).all()


def test_the_terminal_observation_is_kept_until_the_new_episode_begins(recording: Recording) -> None:
    slices = observation.layout()
    ends = np.argwhere(recording.over[:-1] > 0)
    assert len(ends) > 20
    for t, i in ends:
        last, first = recording.states[t + 1], recording.states[t + 2]
        feedback = np.clip(0.2 * recording.actions[t, i], -1, 1)
        np.testing.assert_allclose(last.obs[i, slices["last_feedback"]], feedback, atol=1e-6)
        np.testing.assert_array_equal(last.obs[i, slices["joint_positions"]], last.pipeline_state.qpos[i, 7:])
        np.testing.assert_array_equal(first.obs[i, slices["joint_positions"]], first.pipeline_state.qpos[i, 7:])
        assert not np.array_equal(first.obs[i, slices["joint_positions"]], last.obs[i, slices["joint_positions"]])


def test_a_robot_that_exploded_is_reborn_finite(recording: Recording) -> None:
    ((t, i),) = EXPLODED
    assert recording.metrics["nonfinite"].sum() == recording.metrics["nonfinite"][t, i] == 1
    for state in recording.states[t + 1 :]:
        assert all(np.isfinite(np.asarray(leaf)[i]).all() for leaf in jax.tree.leaves(state))
    assert np.abs(recording.states[t + 2].pipeline_state.qvel[i]).max() == 0


# Beginnings


def test_first_episodes_end_at_any_time_up_to_the_limit() -> None:
    config = EnvConfig(rewards.RewardConfig(), control.ControlConfig(level_feet=True))
    given = sampling.distribution(sampling.Ranges(), SHARES, 0.5, 0.0, (0, 0))
    env = AutoReset(TrackingEnv(robots.load(), config, given), LENGTH)
    reset = jax.jit(env.reset, compiler_options=QUICK_COMPILE)
    clocks = np.asarray(reset(jax.random.split(jax.random.PRNGKey(3), 1200)).info["clock"])
    counts = np.bincount(clocks, minlength=LENGTH)
    assert len(counts) == LENGTH and abs(counts - 100).max() < 45  # uniform: 100 of each, standard deviation 9.6


def test_a_new_episode_has_everything_at_its_start(recording: Recording) -> None:
    slices, robot = observation.layout(), robots.load()
    for t, i in np.argwhere(starts(recording)):
        state = jax.tree.map(lambda leaf, i=i: np.asarray(leaf)[i], recording.states[t + 1])
        episode, physics = state.info["episode"], state.pipeline_state
        assert (episode.index, episode.tick) == (0, 0)
        assert (episode.feedback == 0).all() and (physics.qvel == 0).all() and (physics.warmstart == 0).all()
        joints = (physics.qpos[7:] - robot.joint_middle) / robot.joint_half_range
        np.testing.assert_allclose(episode.control.filtered, joints, atol=1e-6)
        assert (state.obs[slices["last_feedback"]] == 0).all()
        timer = episode.step.period * episode.step.swing
        np.testing.assert_allclose(state.obs[slices["timer"]], timer, atol=1e-6)
        np.testing.assert_allclose(state.obs[slices["target_trunk_position"]], 0, atol=1e-5)
        assert all(value == 0 for value in state.metrics.values())


def test_every_episode_is_another_one(recording: Recording) -> None:
    begun = [(0, i) for i in range(ROBOTS)] + [(t + 1, i) for t, i in np.argwhere(starts(recording))]
    seen: dict[str, set[bytes]] = {"key": set(), "task": set(), "posture": set()}
    kinds = set()
    for t, i in begun:
        state = recording.states[t]
        episode = state.info["episode"]
        seen["key"].add(np.asarray(episode.key)[i].tobytes())
        seen["task"].add(np.asarray(episode.task.motion.period)[i].tobytes())
        seen["posture"].add(np.asarray(episode.step.ankle_points)[i].tobytes())
        kinds.add(int(episode.task.motion.kind[i]))
    assert len(begun) > 25 and {name: len(values) for name, values in seen.items()} == dict.fromkeys(seen, len(begun))
    assert kinds == {sampling.STAND, sampling.SQUAT, sampling.WALK, sampling.SIDLE, sampling.TURN}


def test_the_action_of_a_step_that_begins_an_episode_does_nothing(recording: Recording) -> None:
    t = int(starts(recording).sum(axis=1).argmax())
    begins = np.asarray(starts(recording)[t])
    assert 2 <= begins.sum() < ROBOTS
    other = recording.step(disturbed(recording.states[t], t), jnp.full((ROBOTS, 12), 3.0, jnp.float32))
    for mine, recorded in zip(jax.tree.leaves(other), jax.tree.leaves(recording.states[t + 1]), strict=True):
        np.testing.assert_array_equal(np.asarray(mine)[begins], np.asarray(recorded)[begins])
    assert not np.array_equal(other.obs[~begins], recording.states[t + 1].obs[~begins])


# Retries

LOOK_BACK, RETRIES = 4, 2
FALLS = {(6, 0), (17, 1), (22, 1), (27, 1), (30, 2)}  # (step, robot) before which the robot is tipped over


@pytest.fixture(scope="module")
def retrying() -> list[Any]:
    """34 states of three robots, always with the same action."""
    config = EnvConfig(rewards.RewardConfig(), control.ControlConfig(level_feet=True))
    given = sampling.distribution(sampling.Ranges(), SHARES, 0.5, 0.0, (0, 0))
    env = AutoReset(TrackingEnv(robots.load(), config, given), 1000, RETRIES, LOOK_BACK)
    step = jax.jit(env.step, compiler_options=QUICK_COMPILE)
    states = [jax.jit(env.reset, compiler_options=QUICK_COMPILE)(jax.random.split(jax.random.PRNGKey(4), 3))]
    for t in range(33):
        physics = states[-1].pipeline_state
        for who in (who for when, who in FALLS if when == t):
            physics = physics._replace(qpos=physics.qpos.at[who, 3:7].set(jnp.array([np.cos(0.7), np.sin(0.7), 0, 0])))
        states.append(step(states[-1].replace(pipeline_state=physics), jnp.zeros((3, 12))))
    return [jax.tree.map(np.asarray, state) for state in states]


def going_on(state: Any, who: int) -> list[np.ndarray]:
    """Everything that decides how the episode of one robot goes on."""
    parts = (state.pipeline_state, state.info["episode"], state.info["clock"], state.obs)
    return [leaf[who] for leaf in jax.tree.leaves(parts)]


def same(a: list[np.ndarray], b: list[np.ndarray]) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))


def test_after_a_fall_the_robot_goes_back_and_everything_comes_as_it_came(retrying: list[Any]) -> None:
    for when, who in sorted(FALLS - {(27, 1)}):
        fallen, again = retrying[when + 1], retrying[when + 2]
        assert fallen.done[who] == 1 and again.done[who] == 0 == again.reward[who] and again.info["truncation"][who] == 1
        assert again.info["episode_metrics"]["length"][who] == 0
        back = fallen.info["clock"][who] - again.info["clock"][who]
        assert LOOK_BACK <= back < 2 * LOOK_BACK or when < 2 * LOOK_BACK
        # as it was then, and from there on as it went before, as far as nothing else befell it
        until = min([back, *(w - when - 1 for w, r in FALLS if r == who and w > when), 33 - when - 2])
        for t in range(until):
            assert same(going_on(retrying[when + 2 + t], who), going_on(retrying[when + 1 - back + t], who)), (when, who, t)


def test_after_its_retries_a_new_episode_begins(retrying: list[Any]) -> None:
    tries = [int(state.info["tries"][1]) for state in retrying]
    assert tries == [0] * 19 + [1] * 5 + [2] * 5 + [0] * 5
    new = retrying[29]
    assert new.info["clock"][1] == 0 and new.info["episode"].index[1] == 0 and (new.pipeline_state.qvel[1] == 0).all()
    assert not np.array_equal(new.info["episode"].task.motion.period[1], retrying[28].info["episode"].task.motion.period[1])


# What brax's PPO makes of it


def advantages_by_hand(
    rewards: list[float], values: list[float], last: float, discount: float, lambda_: float
) -> tuple[np.ndarray, np.ndarray]:
    """Value targets and advantages of one episode (or its beginning) whose last state is worth `last`."""
    worth = [*values, last]
    gae, targets, found = 0.0, [], []
    for t in reversed(range(len(rewards))):
        later = targets[-1] if targets else last
        gae = rewards[t] + discount * worth[t + 1] - worth[t] + discount * lambda_ * gae
        found.append(rewards[t] + discount * later - worth[t])
        targets.append(worth[t] + gae)
    return np.array(targets[::-1]), np.array(found[::-1])


def test_brax_advantages_are_those_of_separate_episodes_bootstrapped_from_their_terminal_observations(
    recording: Recording,
) -> None:
    discount, lambda_ = 0.9, 0.8
    direction = np.random.default_rng(1).normal(size=101) / 10
    worth = np.array([2 + np.tanh(np.nan_to_num(np.asarray(s.obs, float)) @ direction) for s in recording.states])
    termination = recording.done * (1 - recording.truncation)  # as brax's loss has it
    arrays = (recording.truncation, termination, recording.rewards, worth[:-1], worth[-1])
    targets, advantages = losses.compute_gae(*(jnp.asarray(a, jnp.float32) for a in arrays), lambda_, discount)

    begins = starts(recording)
    ends_by_time = ends_by_fall = 0
    for i in range(ROBOTS):
        t = 0
        while t < STEPS:
            if begins[t, i]:  # no step of any episode: no target, no advantage
                assert targets[t, i] == pytest.approx(worth[t, i], abs=1e-6) and advantages[t, i] == 0
                t += 1
                continue
            stop = t
            while stop < STEPS - 1 and not recording.over[stop, i]:
                stop += 1
            fell = recording.done[stop, i] > 0
            last = 0.0 if fell else worth[stop + 1, i]  # the state after the episode's last step
            wanted = advantages_by_hand(
                list(recording.rewards[t : stop + 1, i]), list(worth[t : stop + 1, i]), last, discount, lambda_
            )
            np.testing.assert_allclose(targets[t : stop + 1, i], wanted[0], atol=1e-4)
            np.testing.assert_allclose(advantages[t : stop + 1, i], wanted[1], atol=1e-4)
            ends_by_fall += fell
            ends_by_time += not fell and recording.over[stop, i] > 0
            t = stop + 1
    assert ends_by_time > 15 and ends_by_fall == 6


def test_episode_metrics_are_sums_over_the_episode_so_far(recording: Recording) -> None:
    names = {name: name if name in ("fell", "nonfinite") else f"{name}_per_step" for name in recording.metrics}
    assert set(recording.sums) == {"sum_reward", "length", *names.values()}
    begins = starts(recording)
    steps, reward = np.zeros(ROBOTS), np.zeros(ROBOTS)
    sums = {name: np.zeros(ROBOTS) for name in names}
    for t in range(STEPS):
        keep = 1 - begins[t]
        steps, reward = keep * (steps + 1), keep * (reward + recording.rewards[t])
        np.testing.assert_array_equal(recording.sums["length"][t], steps)
        np.testing.assert_allclose(recording.sums["sum_reward"][t], reward, rtol=1e-5)
        for name, summed in names.items():
            sums[name] = keep * (sums[name] + recording.metrics[name][t])
            np.testing.assert_allclose(recording.sums[summed][t], sums[name], rtol=1e-5, atol=1e-5)
    assert recording.sums["length"].max() == LENGTH


def test_brax_logs_means_over_finished_episodes(recording: Recording) -> None:
    logged: dict[str, float] = {}
    logger = EpisodeMetricsLogger(steps_between_logging=1, progress_fn=lambda steps, metrics: logged.update(metrics))
    logger.update_episode_metrics(recording.sums, recording.over, {})

    begins = starts(recording)
    lengths, falls, errors = [], [], []
    for i in range(ROBOTS):
        of_episode: list[float] = []
        for t in range(STEPS):
            of_episode = [] if begins[t, i] else [*of_episode, float(recording.metrics["ankle_error_cm"][t, i])]
            if recording.over[t, i]:
                lengths.append(len(of_episode))
                falls.append(recording.metrics["fell"][t, i])
                errors.append(np.mean(of_episode))
    assert logged["episode/length"] == pytest.approx(np.mean(lengths), rel=1e-5)
    assert logged["episode/fell"] == pytest.approx(np.mean(falls), rel=1e-5) and 0 < logged["episode/fell"] < 1
    assert logged["episode/nonfinite"] == pytest.approx(1 / len(lengths), rel=1e-5)
    assert logged["episode/ankle_error_cm_per_step"] == pytest.approx(np.mean(errors), rel=1e-4)
