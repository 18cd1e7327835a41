"""A policy as a network in numpy and as a file: against JAX and brax; damaged files are refused."""

import dataclasses
import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import networks as ppo_networks
from hypothesis import given, settings
from hypothesis import strategies as st
from policies import JOINTS, ROBOT, random_network, small_policy

from bipedtrack import checkpoint, curriculum, networks, observation, policy
from bipedtrack.policy import Controller, PolicyError


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


@pytest.mark.parametrize(("activation", "symmetric"), [*((name, False) for name in policy.ACTIVATIONS), ("swish", True)])
def test_the_exported_network_equals_braxs_own(activation, symmetric):
    network = curriculum.NetworkConfig(actor=(64, 48), critic=(8,), activation=activation, symmetric=symmetric)
    plan = dataclasses.replace(curriculum.load("smoke"), network=network)
    made = networks.make(network, observation.SIZE, JOINTS, preprocess_observations_fn=running_statistics.normalize)
    params = random_parameters(made, network)
    act = ppo_networks.make_inference_fn(made)(params, deterministic=True)
    wanted = np.asarray(jax.jit(act)(OBSERVATIONS, jax.random.PRNGKey(0))[0])
    exported = networks.to_policy(plan, networks.to_arrays(params), {})
    assert_close(exported.output(OBSERVATIONS), wanted)
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


# Files


@pytest.fixture(scope="module")
def original():
    return small_policy()


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
    for name in ("activation", "settings", "policy_period", "provenance", "symmetric", "sway"):
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
    "symmetric by a word": (put("yes", "symmetric"), "symmetric must be true or false, not 'yes'"),
    "sway beyond a pendulum's": (put(1.5, "sway"), "sway must lie in .0, 1., not 1.5"),
    "sway by a word": (put("yes", "sway"), "sway must lie in .0, 1., not 'yes'"),
    "symmetric on unequal legs": (change("robot/kp", poke(123.0)), "its robot is not its own mirror image"),
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
    "robot's name a list": put(["ranger_max"], "robot", "name"),
    "robot's name a number": put(7, "robot", "name"),
    "joints by numbers": put(list(range(12)), "robot", "joint_names"),
    "provenance a word": put("mine", "provenance"),
    "no stiffness": change("robot/kp", lambda kp: 0 * kp),
    "no damping": change("robot/kd", lambda kd: 0 * kd),
    "no torque": change("robot/torque_limit", lambda limit: -limit),
    "no weight": change("robot/masses", lambda masses: 0 * masses),
    "legs shorter than none": change("robot/leg_length", lambda length: length - 1),
    "legs the wrong way": change("robot/leg_length", lambda length: length[::-1].copy()),
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


@pytest.mark.parametrize("name", ["stranger", "../models/ranger_max", ""])
def test_a_policy_of_a_robot_that_is_not_there_is_not_simulated(original, tmp_path, name):
    path = tmp_path / "policy.npz"
    policy.save(dataclasses.replace(original, robot=dataclasses.replace(ROBOT, name=name)), path)
    with pytest.raises(PolicyError) as error:
        policy.load_for_simulation(path)
    assert str(error.value) == f"{path}: no robot named {name!r} in models/; there are: ranger_max"


def test_a_policy_of_a_robot_that_has_changed_is_not_simulated(original, tmp_path):
    path = tmp_path / "policy.npz"
    policy.save(original, path)
    assert policy.load_for_simulation(path).robot.name == "ranger_max"
    policy.save(dataclasses.replace(original, robot=dataclasses.replace(ROBOT, kp=2 * ROBOT.kp)), path)
    with pytest.raises(PolicyError, match="another kp than 'ranger_max' has"):
        policy.load_for_simulation(path)


def test_a_robot_is_the_same_under_another_name(content, scratch):
    scratch.write_bytes(content)
    policy.load(scratch, robot=dataclasses.replace(ROBOT, name="copy"))


def test_a_policy_that_cannot_be_written_leaves_nothing_behind(original, tmp_path):
    with pytest.raises(checkpoint.RunError, match="cannot be written"):
        policy.save(original, tmp_path / "missing" / "policy.npz")
    assert not list(tmp_path.iterdir())
