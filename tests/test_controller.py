"""The numpy controller acts as in training: against the environment, MuJoCo C, and itself."""

import dataclasses
import functools
import os
import pathlib
import subprocess
import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from policies import ROBOT, make_policy, random_network, small_policy

import bipedtrack
from bipedtrack import control, curriculum, footsteps, planner, policy, robot, sampling
from bipedtrack.control import ControlConfig
from bipedtrack.env import EnvConfig, TrackingEnv
from bipedtrack.policy import Controller, Network

ROOT = pathlib.Path(bipedtrack.__file__).parents[1]
HEADER = ",".join(footsteps.COLUMNS)
WALK = f"{HEADER}\nleft,0.1,0.1\nright,0.2,-0.1\nleft,0.3,0.1\n"
# the physics compiles in half the time, and its steps are few
QUICK_COMPILE = {"xla_backend_optimization_level": 0}

# The controller against the environment


def make_env(policy_period, settings):
    """The environment with jitted begin and step; kinds and difficulty are arguments of begin."""
    env = TrackingEnv(ROBOT, EnvConfig(curriculum.Curriculum.rewards, settings, policy_period), given={})
    compiled = functools.partial(jax.jit, compiler_options=QUICK_COMPILE)
    return env, compiled(env.begin), compiled(env.step)


def drawn(kind, hold=False, ranges=None, difficulty=1.0):
    shares = sampling.Shares(**{name: float(name == kind) for name in sampling.KINDS})
    return sampling.distribution(ranges or sampling.Ranges(), shares, difficulty, float(hold), (1, 1))


@pytest.fixture(scope="module")
def env_200_hz():
    """Policy and control at one rate, and every option of the control law other than by default."""
    return make_env(0.005, ControlConfig(0.25, 0.3, True, True, gravity_feedforward=True, integral=2.0))


@pytest.fixture(scope="module")
def env_50_hz():
    """The feedback is held over four control steps."""
    return make_env(0.02, ControlConfig())


CASES = [(kind, False) for kind in sampling.KINDS] + [("walk", True)]


@pytest.mark.parametrize(("kind", "hold"), CASES)
def test_at_200_hz_the_controller_sees_and_asks_what_the_environment_does(env_200_hz, kind, hold):
    env, begin, step = env_200_hz
    seconds = 1.0 if kind in ("stand", "squat") else 0.75
    boundaries = follow(env, begin(jax.random.PRNGKey(4), drawn(kind, hold)), step, seconds)
    assert boundaries >= (kind not in ("stand", "squat"))


@pytest.mark.parametrize(("kind", "hold"), CASES)
def test_at_50_hz_the_controller_holds_its_feedback_as_the_environment_does(env_50_hz, kind, hold):
    env, begin, step = env_50_hz
    follow(env, begin(jax.random.PRNGKey(6), drawn(kind, hold)), step, 1.0)


def follow(env, state, step, seconds):
    """Runs the environment with a random network and shows the numpy controller its states: observations and targets agree.

    Returns how many task steps ended. Between two policy steps the controller is shown a state it must not look at.
    """
    network = random_network(8, output=2.0)
    act = jax.jit(functools.partial(policy.apply, network, "swish"))
    controller = Controller(make_policy(network, env.config.policy_period, env.config.control))
    controller.reset(np.asarray(state.pipeline_state.qpos))
    robot32 = ROBOT.cast(np.float32)
    # the velocity feedforward multiplies what float32 rounds by kd / (kp x 0.005 s) = 10: measured 1.4e-5
    tolerance = 5e-5 if env.config.control.velocity_feedforward else 1e-5
    boundaries, largest_feedback = 0, 0.0
    for _ in range(round(seconds / env.config.policy_period)):
        before = jax.tree.map(np.asarray, state)
        physics, episode = before.pipeline_state, before.info["episode"]
        now = command_of(episode.step, episode.tick)
        seen = controller.observe(physics.qpos, physics.qvel, now)
        assert seen.dtype == np.float32
        np.testing.assert_allclose(seen, before.obs, rtol=1e-6, atol=1e-5)

        state = step(state, act(state.obs))
        after = jax.tree.map(np.asarray, state.info["episode"])
        boundaries += int(after.index != episode.index)
        targets = controller.step(physics.qpos, physics.qvel, now)
        for held in range(1, env.substeps):
            tick = int(episode.tick) + held
            over = tick - round(float(episode.step.period) / ROBOT.timestep)
            command = command_of(episode.step, tick) if over < 0 else command_of(after.step, over)
            targets = controller.step(np.full(19, 0.5), np.full(18, 99.0), command)
        largest_feedback = max(largest_feedback, np.abs(after.feedback).max())
        if env.substeps == 1:
            a_ff = after.control.feedforward
            seen = (now, physics.qpos, physics.qvel)
            wanted, _ = control.respond(robot32, env.config.control, episode.control, a_ff, after.feedback, *seen)
        else:
            assert not env.config.control.velocity_feedforward
            wanted = control.denormalize(robot32, after.control.filtered)
        assert targets.dtype == np.float32
        np.testing.assert_allclose(targets, wanted, rtol=0, atol=tolerance)
    assert largest_feedback > 0.2  # there was something to compare
    return boundaries


def command_of(step, tick):
    return planner.command(step, np.float32(tick * ROBOT.timestep))


# MuJoCo C against MJX


@pytest.fixture(scope="module")
def walk():
    """Three steps forward, one after the other."""
    return footsteps.parse(WALK, ROBOT, "walk")


def test_in_mujoco_c_a_script_is_walked_as_in_mjx(env_50_hz, walk):
    # the environment draws the script's steps when its ranges leave it no choice
    env, begin, step = env_50_hz
    no_choice = drawn("walk", ranges=sampling.Ranges()._replace(walk_step=(0.1, 0.1, 0.1)), difficulty=0.0)
    starts = (begin(jax.random.PRNGKey(seed), no_choice) for seed in range(20))
    start = next(start for start in starts if start.info["episode"].task.motion.first == 0)  # the left foot steps first
    commands = list(footsteps.commands(walk, ROBOT.timestep, 1.0))
    worst = np.array([apart(env, start, step, commands, random_network(seed, output=0.5)) for seed in range(5)])
    # Measured: a median of 2e-6, and 3e-4 to 7e-4 in one walk of fourteen, where a corner of a sole grazes the ground and
    # only one of the two simulations takes that for a contact.
    assert np.median(worst) < 5e-5 and worst.max() < 5e-3


def apart(env, state, step, commands, network):
    """How far qpos in MJX and in MuJoCo C get apart at most over the commands: both loops closed, each by its controller."""
    act = jax.jit(functools.partial(policy.apply, network, "swish"))
    controller = Controller(make_policy(network, env.config.policy_period, env.config.control))
    model = robot.build_model(ROBOT.name)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    data = mujoco.MjData(model)
    data.qpos[:] = footsteps.initial_qpos(ROBOT)
    np.testing.assert_allclose(state.pipeline_state.qpos, data.qpos, atol=1e-5)
    controller.reset(data.qpos)
    # soles that only just touch the ground are in contact or not by the last digit: press them in by a millimetre
    data.qpos[2] -= 0.001
    sunk = state.pipeline_state._replace(qpos=jnp.asarray(data.qpos, jnp.float32))
    state = state.replace(pipeline_state=sunk, obs=jnp.asarray(controller.observe(data.qpos, data.qvel, commands[0])))
    stood, deviations = data.qpos.copy(), []
    for first in range(0, len(commands), env.substeps):
        episode = jax.tree.map(np.asarray, state.info["episode"])
        same = zip(jax.tree.leaves(commands[first]), jax.tree.leaves(command_of(episode.step, episode.tick)), strict=True)
        for ours, theirs in same:
            np.testing.assert_allclose(ours, theirs, atol=2e-6)
        state = step(state, act(state.obs))
        for command in commands[first : first + env.substeps]:
            data.ctrl[:] = controller.step(data.qpos, data.qvel, command)
            mujoco.mj_step(model, data)
        deviations.append(np.abs(state.pipeline_state.qpos - data.qpos).max())
    assert np.abs(data.qpos - stood).max() > 0.1 and state.info["episode"].index == 1  # it stepped
    assert not any(warning.number for warning in data.warning)
    return max(deviations)


# The controller

STAND = footsteps.initial_qpos(ROBOT)
STILL = np.zeros(18)


def states(count):
    """Measured states near a stand."""
    rng = np.random.default_rng(1)
    return STAND + 0.02 * rng.normal(size=(count, 19)), rng.normal(size=(count, 18))


def run(controller, commands):
    """The joint targets (n, 12) for given commands and random states."""
    targets = np.array([controller.step(*given) for given in zip(*states(len(commands)), commands, strict=True)])
    assert targets.dtype == np.float32  # whatever goes in is float64
    return targets


@pytest.fixture(scope="module")
def original():
    return small_policy()


@pytest.fixture(scope="module")
def commands(walk):
    return list(footsteps.commands(walk, ROBOT.timestep, 0.4))


def test_a_step_before_reset_raises(original, commands):
    with pytest.raises(RuntimeError, match="reset"):
        Controller(original).step(STAND, STILL, commands[0])


@pytest.mark.parametrize("size", [0, 7, 12, 18, 20, 26])
def test_a_reset_with_another_number_of_joints_raises(original, size):
    with pytest.raises(ValueError, match=f"qpos must have 19 numbers, not {size}"):
        Controller(original).reset(np.resize(STAND, size))


@pytest.mark.parametrize(
    ("qpos", "qvel"),
    [(18, 18), (19, 17), (20, 18), (26, 18), (19, 19)],
)
def test_a_step_with_states_of_another_size_raises(original, commands, qpos, qvel):
    controller = Controller(original)
    controller.reset(STAND)
    with pytest.raises(ValueError):
        controller.step(np.resize(STAND, qpos), np.resize(STILL, qvel), commands[0])


def test_a_reset_that_is_not_finite_raises(original):
    with pytest.raises(ValueError, match="qpos is not finite"):
        Controller(original).reset(np.where(np.arange(19) == 9, np.nan, STAND))


def test_what_is_not_finite_raises_and_is_forgotten(original, commands):
    """A state or a command with a nan; afterwards the controller goes on as if it had not been asked."""
    disturbed, alone = Controller(original), Controller(original)
    for controller in (disturbed, alone):
        controller.reset(STAND)
        controller.step(STAND, STILL, commands[0])
    bad = np.array([np.nan, 0.0, 0.7])
    target = commands[1].target._replace(trunk_position=bad)
    for qpos, qvel, command, named in (
        (np.where(np.arange(19) == 9, np.nan, STAND), STILL, commands[1], "qpos"),
        (STAND, np.where(np.arange(18) == 9, np.inf, STILL), commands[1], "qvel"),
        (STAND, STILL, commands[1]._replace(target=target), "command"),
    ):
        with pytest.raises(ValueError, match=f"{named} is not finite"):
            disturbed.step(qpos, qvel, command)
    for command in commands[1:5]:
        np.testing.assert_array_equal(disturbed.step(STAND, STILL, command), alone.step(STAND, STILL, command))


def test_reset_makes_a_run_reproducible(original, commands):
    controller = Controller(original)
    controller.reset(STAND)
    first = run(controller, commands[:31])
    assert not np.array_equal(run(controller, commands[:31]), first)  # it went on from its memory
    controller.reset(STAND)
    np.testing.assert_array_equal(run(controller, commands[:31]), first)


def test_two_controllers_of_one_policy_do_not_disturb_each_other(original, commands):
    one, other = Controller(original), Controller(original)
    one.reset(STAND)
    alone = run(one, commands[:10])
    one.reset(STAND)
    other.reset(STAND + 0.1)
    both = []
    for qpos, qvel, command in zip(*states(10), commands[:10], strict=True):
        both.append(one.step(qpos, qvel, command))
        other.step(qpos, -qvel, command)[:] = 0  # nor does who writes into the result
    np.testing.assert_array_equal(both, alone)


def test_between_policy_steps_only_the_command_counts(commands):
    controller = Controller(make_policy(random_network(2), policy_period=0.02))
    qpos, qvel = states(8)

    def targets(changed_state=None, changed_command=None):
        """The targets of 8 steps of which one sees another state, and one another command."""
        controller.reset(STAND)
        found = []
        for i in range(8):
            velocity = qvel[i] + 5 if i == changed_state else qvel[i]
            found.append(controller.step(qpos[i], velocity, commands[60] if i == changed_command else commands[i]))
        return np.array(found)

    usual = targets()
    for i in (1, 2, 3, 5, 6, 7):
        np.testing.assert_array_equal(targets(changed_state=i), usual)
        assert np.abs(targets(changed_command=i)[i] - usual[i]).max() > 1e-3
    for i in (0, 4):
        assert np.abs(targets(changed_state=i)[i] - usual[i]).max() > 1e-3


def test_without_feedback_it_acts_as_with_a_network_of_zeros(original, commands):
    zeros = Network(*jax.tree.map(np.zeros_like, original.network))._replace(std=original.network.std)
    silent = Controller(dataclasses.replace(original, network=zeros))
    without, full = Controller(original, feedback=False), Controller(original)
    assert not without.uses_feedback and full.uses_feedback
    for controller in (silent, without, full):
        controller.reset(STAND)
    wanted = run(silent, commands)
    np.testing.assert_array_equal(run(without, commands), wanted)
    assert np.abs(run(full, commands) - wanted).max() > 1e-2


def test_targets_stay_within_the_joints_ranges_whatever_the_network_says(commands):
    wild = random_network(3, output=1e4)
    controller = Controller(make_policy(wild, policy_period=0.005))
    controller.reset(STAND)
    targets = run(controller, commands)
    assert (targets >= ROBOT.joint_low - 1e-6).all() and (targets <= ROBOT.joint_high + 1e-6).all()
    assert np.ptp(targets, axis=0).max() > 0.2


TIMING = """
import sys, time
before = set(sys.modules)

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("jax", "jaxlib", "flax", "brax", "optax", "mujoco", "scipy", "tyro", "rich"):
            raise ModuleNotFoundError(name)

sys.meta_path.insert(0, Absent())
from bipedtrack import footsteps
from bipedtrack.policy import Controller
import numpy as np

controller = Controller.load(sys.argv[1])
script = footsteps.parse(sys.argv[2], controller.robot, "walk")
commands = list(footsteps.commands(script, controller.robot.timestep))
start = footsteps.initial_qpos(controller.policy.robot)
states = [(start + 0.02 * np.sin(i * np.arange(1, 20)), np.cos(i * np.arange(18))) for i in range(50)]
controller.reset(start)
milliseconds = []
for i in range(4000):
    (qpos, qvel), command = states[i % len(states)], commands[i % len(commands)]
    begin = time.thread_time_ns()
    controller.step(qpos, qvel, command)
    milliseconds.append((time.thread_time_ns() - begin) / 1e6)
# other programs' use of the caches is not ours: the best of forty stretches
print(min(np.quantile(stretch, 0.99) for stretch in np.split(np.array(milliseconds), 40)))
imported = {name.partition(".")[0] for name in set(sys.modules) - before}
print(*sorted(imported - set(sys.stdlib_module_names) - {"bipedtrack"}))
"""


def test_a_step_takes_under_a_millisecond_and_needs_numpy_alone(tmp_path):
    path = tmp_path / "policy.npz"
    policy.save(make_policy(random_network(1, (512, 512, 512)), policy_period=0.005), path)
    one_thread = {f"{library}_NUM_THREADS": "1" for library in ("OPENBLAS", "OMP", "MKL")}
    result = subprocess.run(
        [sys.executable, "-c", TIMING, str(path), WALK],
        env={**os.environ, **one_thread, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert result.returncode == 0, result.stderr
    percentile, imported = result.stdout.splitlines()
    assert imported == "numpy"
    assert float(percentile) < 1
