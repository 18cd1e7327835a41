"""The numpy controller acts as in training: against JAX, brax, the environment and MuJoCo C; damaged files are refused."""

import dataclasses
import functools
import json
import os
import pathlib
import subprocess
import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import networks
from hypothesis import given, settings
from hypothesis import strategies as st

import bipedtrack
from bipedtrack import checkpoint, control, curriculum, footsteps, observation, planner, policy, robot, sampling, training
from bipedtrack.control import ControlConfig
from bipedtrack.env import EnvConfig, TrackingEnv
from bipedtrack.policy import Controller, Network, Policy, PolicyError

ROOT = pathlib.Path(bipedtrack.__file__).parents[1]
ROBOT = robot.load()
JOINTS = len(ROBOT.joint_names)
HEADER = ",".join(footsteps.COLUMNS)
WALK = f"{HEADER}\nleft,0.1,0.1\nright,0.2,-0.1\nleft,0.3,0.1\n"
# the physics compiles in half the time, and its steps are few
QUICK_COMPILE = {"xla_backend_optimization_level": 0}


def random_network(seed, hidden=(32, 32), output=1.0):
    """A network with no zeros in it, whose outputs are of the order of `output`."""
    rng = np.random.default_rng(seed)
    sizes = (observation.SIZE, *hidden, JOINTS)
    gains = [1.0] * len(hidden) + [output]
    layers = list(zip(sizes, sizes[1:], gains, strict=False))
    return Network(
        mean=rng.normal(size=observation.SIZE).astype(np.float32),
        std=rng.uniform(0.05, 2, observation.SIZE).astype(np.float32),
        weights=tuple((g * rng.normal(size=(n, m)) / np.sqrt(n)).astype(np.float32) for n, m, g in layers),
        biases=tuple((0.1 * g * rng.normal(size=m)).astype(np.float32) for _, m, g in layers),
    )


def make_policy(network, policy_period=0.02, settings=None):
    return Policy(network, "swish", settings or ControlConfig(), policy_period, ROBOT, {"curriculum": "none", "seed": 3})


def observations():
    """10,000 observations, (10000, 101): zeros, tiny and denormal, ordinary, large, and one large number among zeros."""
    rng = np.random.default_rng(0)
    scales = np.resize([0, 1e-40, 1e-20, 1e-3, 0.1, 1, 1, 1, 10, 1e3], 9000)
    rows = scales[:, None] * rng.normal(size=(9000, observation.SIZE))
    single = np.zeros((1000, observation.SIZE))
    single[np.arange(1000), np.arange(1000) % observation.SIZE] = np.resize([1e3, -1e3, 1e-20], 1000)
    return np.concatenate([rows, single]).astype(np.float32)


OBSERVATIONS = observations()


def assert_close(found, wanted):
    """Outputs (10000, 12) for OBSERVATIONS are equal to 1e-5, as far as the 7 digits of float32 allow.

    Where outputs are beyond 1, of the largest; and of a hundredth of the largest observation, for tanh hides large numbers.
    """
    assert found.dtype == np.float32 and np.isfinite(found).all()
    size = np.maximum(np.abs(wanted).max(axis=-1), np.abs(OBSERVATIONS).max(axis=-1) / 100)
    assert (np.abs(found - wanted).max(axis=-1) / np.maximum(size, 1)).max() < 1e-5


# The network


@pytest.mark.parametrize("activation", policy.ACTIVATIONS)
def test_the_network_in_numpy_equals_the_network_in_jax(activation):
    network = random_network(1, (512, 512, 512))
    wanted = jax.jit(functools.partial(policy.apply, network, activation))(OBSERVATIONS)
    with np.errstate(over="raise", invalid="raise", divide="raise"):
        found = policy.apply(network, activation, OBSERVATIONS)
    assert_close(found, np.asarray(wanted))
    np.testing.assert_allclose(policy.apply(network, activation, OBSERVATIONS[7]), found[7], atol=1e-5)


@pytest.mark.parametrize("activation", policy.ACTIVATIONS)
def test_the_exported_network_equals_braxs_own(activation):
    network = curriculum.NetworkConfig(actor=(64, 48), critic=(8,), activation=activation)
    plan = dataclasses.replace(curriculum.load("smoke"), network=network)
    made = training.make_networks(network, observation.SIZE, JOINTS, preprocess_observations_fn=running_statistics.normalize)
    params = random_parameters(made, network)
    act = networks.make_inference_fn(made)(params, deterministic=True)
    wanted = np.asarray(jax.jit(act)(OBSERVATIONS, jax.random.PRNGKey(0))[0])
    exported = training.to_policy(plan, training.to_arrays(params), {})
    assert_close(policy.apply(exported.network, exported.activation, OBSERVATIONS), wanted)
    # as the environment takes brax's actions
    scale = plan.control.feedback_scale
    feedback = exported.feedback(OBSERVATIONS)
    ordinary = (np.abs(wanted).max(axis=-1) < 10) & (np.abs(OBSERVATIONS).max(axis=-1) < 100)
    assert ordinary.sum() > 5000 and (np.abs(feedback) < 1).mean() > 0.3
    np.testing.assert_allclose(feedback[ordinary], np.clip(scale * wanted[ordinary], -1, 1), atol=1e-5)
    assert np.abs(feedback).max() <= 1


def random_parameters(made, network):
    """Brax's parameters with no zeros in them; the normaliser has seen observations, some of which never change."""
    rng = np.random.default_rng(5)
    seen = rng.normal(size=(500, observation.SIZE)) * rng.uniform(0, 2, observation.SIZE)
    seen[:, :10] = 0.5
    empty = running_statistics.init_state(
        specs.Array((observation.SIZE,), np.dtype("float32")), std_eps=network.normalizer_floor
    )
    normalizer = jax.jit(running_statistics.update)(jax.tree.map(jnp.asarray, empty), seen.astype(np.float32))

    def random(leaf):
        return jnp.asarray(rng.normal(size=leaf.shape) / np.sqrt(leaf.shape[0]), jnp.float32)

    shapes = (jax.eval_shape(part.init, jax.random.PRNGKey(0)) for part in (made.policy_network, made.value_network))
    return normalizer, *(jax.tree.map(random, part) for part in shapes)


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
    return make_env(0.005, ControlConfig(filter=0.25, level_feet=True, velocity_feedforward=True))


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
            wanted, _ = control.joint_targets(robot32, env.config.control, episode.control, a_ff, after.feedback)
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


# Files


@pytest.fixture(scope="module")
def original():
    return make_policy(random_network(2, (8, 6)), settings=ControlConfig(filter=0.3, velocity_feedforward=True))


@pytest.fixture(scope="module")
def content(original, tmp_path_factory):
    """The bytes of its file."""
    path = tmp_path_factory.mktemp("policy") / "policy.npz"
    policy.save(original, path)
    return path.read_bytes()


@pytest.fixture(scope="module")
def scratch(tmp_path_factory):
    """A path for a file that examples write over and over."""
    return tmp_path_factory.mktemp("scratch") / "policy.npz"


def refused(path, pattern=None, **options):
    """The one line with which loading `path` is refused; any other exception fails the test."""
    with pytest.raises((checkpoint.CheckpointError, PolicyError), match=pattern) as info:
        policy.load(path, **options)
    line = str(info.value)
    assert line.startswith(f"{path}: ") and len(line.splitlines()) == 1 and len(line) > len(f"{path}: ") + 10
    return line


def test_a_policy_comes_back_from_its_file_bit_for_bit(original, content, scratch):
    scratch.write_bytes(content)
    loaded = policy.load(scratch, robot=ROBOT)
    for found, wanted in zip(jax.tree.leaves(loaded.network), jax.tree.leaves(original.network), strict=True):
        assert found.dtype == wanted.dtype and found.tobytes() == wanted.tobytes()
    for name, wanted in vars(ROBOT).items():
        found = getattr(loaded.robot, name)
        assert type(found) is type(wanted) and np.array_equal(found, wanted)
    for name in ("activation", "settings", "policy_period", "provenance"):
        assert getattr(loaded, name) == getattr(original, name)
    policy.save(loaded, scratch)
    assert scratch.read_bytes() == content


def test_a_policy_file_holds_only_plain_arrays_that_numpy_reads_without_pickle(content, scratch):
    scratch.write_bytes(content)
    with np.load(scratch, allow_pickle=False) as arrays:
        names = set(arrays.files)
        assert all(arrays[name].dtype.kind in "fiu" for name in names)
        manifest = json.loads(arrays["__manifest__"].tobytes())
    assert {"normalizer/mean", "normalizer/std", "actor/2/weight", "actor/2/bias", "robot/kp"} < names
    meta = manifest["meta"]
    assert meta["observation"]["layout"] == observation.WIDTHS._asdict()
    assert meta["robot"]["joint_names"] == list(ROBOT.joint_names)
    assert meta["control"]["filter"] == 0.3 and meta["policy_period"] == 0.02


def test_a_policy_file_cut_off_anywhere_is_refused(content, scratch):
    lengths = {*range(0, len(content), 61), *range(65), *range(len(content) - 130, len(content))}
    for length in sorted(lengths):
        scratch.write_bytes(content[:length])
        refused(scratch)


@settings(max_examples=150)
@given(data=st.data())
def test_a_policy_file_with_one_bit_flipped_is_refused(content, scratch, data):
    position = data.draw(st.integers(0, len(content) - 1))
    flipped = bytearray(content)
    flipped[position] ^= 1 << data.draw(st.integers(0, 7))
    scratch.write_bytes(flipped)
    refused(scratch)


def test_what_is_no_policy_file_is_refused(tmp_path, content):
    path = tmp_path / "policy.npz"
    assert "No such file" in refused(path)
    other = tmp_path / "other.npz"
    np.savez(other, weight=np.ones(3))
    refused(other)
    arrays, meta = saved(content, other)
    checkpoint.save_arrays(other, arrays, {"index": 3, "meta": meta}, "checkpoint")
    assert "is a checkpoint file; wanted a policy file" in refused(other)


def test_a_run_directory_stands_for_its_policy(tmp_path, content):
    with pytest.raises(checkpoint.CheckpointError, match=rf"^{tmp_path}/policy.npz: cannot be read"):
        policy.load(tmp_path)
    (tmp_path / "policy.npz").write_bytes(content)
    by_folder, by_file = policy.load(tmp_path), policy.load(tmp_path / "policy.npz")
    assert by_folder.network.weights[0].tobytes() == by_file.network.weights[0].tobytes()


def saved(content, path):
    """Arrays and meta of a policy file, to be changed and saved with a right checksum."""
    path.write_bytes(content)
    return checkpoint.load_arrays(path, policy.KIND)


def change(name, function):
    """A change to one array."""
    return lambda arrays, meta: arrays.update({name: function(arrays[name])})


def rename(old, new):
    return lambda arrays, meta: arrays.update({new: arrays.pop(old)})


def put(value, *keys):
    """A change to one value of the meta dict."""

    def apply(arrays, meta):
        functools.reduce(lambda place, key: place[key], keys[:-1], meta)[keys[-1]] = value

    return apply


def poke(value):
    def apply(array):
        array = array.copy()
        array.flat[array.size // 2] = value
        return array

    return apply


FORGERIES = {
    "weight renamed": (rename("actor/1/weight", "actor/1/kernel"), "actor/1/weight"),
    "layer renamed": (rename("actor/2/bias", "actor/3/bias"), "actor/2/bias"),
    "normaliser renamed": (rename("normalizer/std", "normalizer/deviation"), "normalizer/std"),
    "gains renamed": (rename("robot/kp", "robot/stiffness"), "stiffness|kp"),
    "weight missing": (lambda arrays, meta: arrays.pop("actor/0/weight"), "actor/0/weight"),
    "no layers": (
        lambda arrays, meta: [arrays.pop(name) for name in list(arrays) if name.startswith("actor")],
        "network gives 101 numbers; wanted one for each of 12 joints",
    ),
    "another layout": (put("0123456789abcdef", "observation", "hash"), "another observation layout"),
    "no layout": (lambda arrays, meta: meta.pop("observation"), "observation"),
    "weight transposed": (change("actor/1/weight", np.transpose), r"actor/1/weight has shape \[6, 8\]; wanted \[8, "),
    "weight for 100 inputs": (change("actor/0/weight", lambda w: w[:100]), r"wanted \[101, 8\]"),
    "weight flat": (change("actor/0/weight", np.ravel), "actor/0/weight"),
    "bias short": (change("actor/0/bias", lambda b: b[:7]), "actor/0/bias"),
    "bias a column": (change("actor/2/bias", lambda b: b[:, None]), "actor/2/bias"),
    "mean short": (change("normalizer/mean", lambda m: m[:100]), "normalizer/mean"),
    "deviations a row": (change("normalizer/std", lambda s: s[None]), "normalizer/std"),
    "11 outputs": (
        lambda arrays, meta: arrays.update(
            {"actor/2/weight": arrays["actor/2/weight"][:, :11], "actor/2/bias": arrays["actor/2/bias"][:11]}
        ),
        "network gives 11 numbers",
    ),
    "11 gains": (change("robot/kp", lambda kp: kp[:11]), "robot/kp"),
    "11 joints": (put(list(ROBOT.joint_names[:11]), "robot", "joint_names"), "joint|wanted"),
    "weight nan": (change("actor/1/weight", poke(np.nan)), "finite float32"),
    "bias infinite": (change("actor/1/bias", poke(-np.inf)), "finite float32"),
    "mean nan": (change("normalizer/mean", poke(np.nan)), "finite float32"),
    "deviation infinite": (change("normalizer/std", poke(np.inf)), "finite float32"),
    "deviation zero": (change("normalizer/std", poke(0)), "positive"),
    "deviation negative": (change("normalizer/std", poke(-1)), "positive"),
    "weight double": (change("actor/0/weight", np.float64), "finite float32"),
    "bias half": (change("actor/2/bias", np.float16), "finite float32"),
    "mean integer": (change("normalizer/mean", lambda m: m.astype(np.int32)), "finite float32"),
    "unknown activation": (put("gelu", "activation"), "activation 'gelu' is unknown; wanted one of swish, tanh, relu"),
    "no activation": (lambda arrays, meta: meta.pop("activation"), "activation"),
    "unknown control": (put(1.0, "control", "fliter"), "did you mean 'filter'"),
    "impossible filter": (put(1.5, "control", "filter"), "filter must lie in"),
    "no period": (lambda arrays, meta: meta.pop("policy_period"), "policy_period"),
    "no robot": (lambda arrays, meta: meta.pop("robot"), "robot"),
    "robot a list": (put([1, 2], "robot"), "no complete policy"),
    "no thigh": (lambda arrays, meta: meta["robot"].pop("thigh"), "thigh"),
    "a third leg": (put(1.0, "robot", "tail"), "tail"),
    "no provenance": (lambda arrays, meta: meta.pop("provenance"), "provenance"),
}
GARBAGE = {
    "weight without axes": change("actor/2/weight", lambda w: w.flat[0]),
    "period a word": put("fast", "policy_period"),
    "period nan": put(float("nan"), "policy_period"),
    "period zero": put(0.0, "policy_period"),
    "period no multiple": put(0.0125, "policy_period"),
    "robot's thigh a word": put("long", "robot", "thigh"),
    "robot's control period zero": put(0.0, "robot", "timestep"),
    "gains nan": change("robot/kp", poke(np.nan)),
    "k_b nan": change("robot/feedback_ratio", poke(np.nan)),
    "three hips": change("robot/hips", lambda h: np.concatenate([h, h[:1]])),
    "joint ranges the wrong way": change("robot/joint_low", lambda low: -2 * low + 1),
    "a stray layer": lambda arrays, meta: arrays.update({"actor/3/scale": np.ones(2, np.float32)}),
    "a stray array": lambda arrays, meta: arrays.update({"extra": np.ones(2, np.float32)}),
}


@pytest.mark.parametrize("name", FORGERIES)
def test_an_intact_file_of_another_content_is_refused_in_one_line(content, tmp_path, name):
    forge, pattern = FORGERIES[name]
    path = tmp_path / "policy.npz"
    arrays, meta = saved(content, path)
    forge(arrays, meta)
    checkpoint.save_arrays(path, arrays, meta, policy.KIND)
    refused(path, pattern)


@pytest.mark.parametrize("name", GARBAGE)
def test_an_intact_file_of_garbage_is_refused_in_one_line(content, tmp_path, name):
    path = tmp_path / "policy.npz"
    arrays, meta = saved(content, path)
    GARBAGE[name](arrays, meta)
    checkpoint.save_arrays(path, arrays, meta, policy.KIND)
    refused(path)


FIELDS = [field.name for field in dataclasses.fields(ROBOT) if field.name != "name"]


@pytest.mark.parametrize("field", FIELDS)
def test_a_policy_of_a_robot_that_differs_anywhere_is_refused(content, scratch, field):
    scratch.write_bytes(content)
    value = getattr(ROBOT, field)
    if field == "joint_names":
        changed = value[6:] + value[:6]
    elif isinstance(value, float):
        changed = value * 1.001
    else:
        changed = value.copy()
        changed.flat[-1] *= 1.001
    other = dataclasses.replace(ROBOT, name="stranger", **{field: changed})
    line = refused(scratch, field, robot=other)
    assert "'ranger_max'" in line and "'stranger'" in line
    with pytest.raises(PolicyError):
        Controller.load(scratch, robot=other)


def test_a_robot_is_the_same_under_another_name(content, scratch):
    scratch.write_bytes(content)
    policy.load(scratch, robot=dataclasses.replace(ROBOT, name="copy"))


def test_a_policy_that_cannot_be_written_leaves_nothing_behind(original, tmp_path):
    with pytest.raises(checkpoint.RunError, match="cannot be written"):
        policy.save(original, tmp_path / "missing" / "policy.npz")
    assert not list(tmp_path.iterdir())


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
for i in range(2000):
    (qpos, qvel), command = states[i % len(states)], commands[i % len(commands)]
    begin = time.thread_time_ns()
    controller.step(qpos, qvel, command)
    milliseconds.append((time.thread_time_ns() - begin) / 1e6)
# other programs' use of the caches is not ours: the best of four stretches
print(min(np.quantile(stretch, 0.99) for stretch in np.split(np.array(milliseconds), 4)))
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
