"""Brax's parameters as named arrays and back, the exported policy against brax's own actor, the noise."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import networks as ppo_networks

from bipedtrack import curriculum, networks, policy, robot
from bipedtrack.checkpoint import CheckpointError
from bipedtrack.control import ControlConfig

ACTIVATIONS = ("swish", "tanh", "relu")


def plan(**network: Any) -> curriculum.Curriculum:
    smoke = curriculum.load("smoke")
    sizes = {"actor": (24, 8), "critic": (12,)} | network
    return dataclasses.replace(smoke, network=dataclasses.replace(smoke.network, **sizes))


def parameters(config: curriculum.Curriculum, seed: int = 0) -> tuple[Any, ppo_networks.PPONetworks]:
    """Brax's parameters with a normaliser that has seen data and an actor of random biases, and brax's networks."""
    normalize = running_statistics.normalize
    made = networks.make(config.network, 101, 12, the_robot=robot.load(), preprocess_observations_fn=normalize)
    keys = jax.random.split(jax.random.PRNGKey(seed), 4)
    actor = made.policy_network.init(keys[0])
    noise = [jax.random.normal(keys[1], leaf.shape) for leaf in jax.tree.leaves(actor)]
    actor = jax.tree.map(lambda leaf, extra: leaf + 0.1 * extra, actor, jax.tree.unflatten(jax.tree.structure(actor), noise))
    normalizer = running_statistics.init_state(
        specs.Array((101,), jnp.dtype("float32")), std_eps=config.network.normalizer_floor
    )
    seen = 3 * jax.random.normal(keys[2], (50, 101)) + jnp.arange(101) / 50
    params = (running_statistics.update(normalizer, seen), actor, made.value_network.init(keys[3]))
    return jax.tree.map(jnp.asarray, params), made


def same(one: Any, other: Any) -> bool:
    """Equal structures, shapes, types and bits."""
    assert jax.tree.structure(one) == jax.tree.structure(other)
    pairs = [(np.asarray(a), np.asarray(b)) for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)]
    return all((a.shape, a.dtype, a.tobytes()) == (b.shape, b.dtype, b.tobytes()) for a, b in pairs)


# Arrays


def test_parameters_come_back_from_their_arrays_as_they_were() -> None:
    config = plan()
    params, _ = parameters(config)
    arrays = networks.to_arrays(params)
    assert all(isinstance(array, np.ndarray) for array in arrays.values())
    assert len(arrays) == len(jax.tree.leaves(params))
    shuffled = {name: arrays[name] for name in sorted(arrays, reverse=True)}
    back = networks.from_arrays(config, shuffled)
    assert same(back, params)
    assert not same(back, parameters(config, seed=1)[0])
    # what brax puts at a place in the tree has that place's name
    assert (arrays["0/mean"] == params[0].mean).all() and (arrays["0/std"] == params[0].std).all()
    kernel = params[1]["params"]["MLP_0"]["hidden_1"]["kernel"]
    assert (arrays["1/params/MLP_0/hidden_1/kernel"] == kernel).all() and kernel.shape == (24, 8)


def test_the_floor_of_the_normaliser_is_the_curriculums_also_for_another_ones_checkpoint() -> None:
    params, _ = parameters(plan(normalizer_floor=0.5))
    normalizer, *others = networks.from_arrays(plan(normalizer_floor=0.01), networks.to_arrays(params))
    assert same(others, list(params[1:])) and (normalizer.std == params[0].std).all()
    seen = np.zeros((40, 101), np.float32)  # of which nothing varies
    variance = np.asarray(normalizer.summed_variance, float) + np.asarray(normalizer.mean, float) ** 2 * 50 * 40 / 90
    found = running_statistics.update(normalizer, jnp.asarray(seen)).std
    np.testing.assert_allclose(found, np.sqrt(variance / 90 + 0.01), rtol=1e-4)


def test_arrays_that_do_not_fit_the_networks_are_refused_in_one_line_that_names_them() -> None:
    config = plan()
    arrays = networks.to_arrays(parameters(config)[0])
    bias = "1/params/MLP_0/hidden_0/bias"
    without = {name: array for name, array in arrays.items() if name != bias}
    misfits = {
        "is on one side only": without,
        "foreign is on one side only": arrays | {"foreign": np.zeros(1)},
        "is float32[25], wanted float32[24]": arrays | {bias: np.zeros(25, np.float32)},
        "is float64[24], wanted float32[24]": arrays | {bias: np.zeros(24)},
    }
    for message, wrong in misfits.items():
        with pytest.raises(CheckpointError) as caught:
            networks.from_arrays(config, wrong)
        line = str(caught.value)
        assert message in line and "\n" not in line and ("foreign" in message or bias in line)


@pytest.mark.parametrize("other", [{"actor": (24, 9)}, {"actor": (24,)}, {"critic": (13,)}, {"critic": (12, 12)}])
def test_a_checkpoint_of_other_networks_is_refused(other: dict[str, Any]) -> None:
    arrays = networks.to_arrays(parameters(plan())[0])
    with pytest.raises(CheckpointError, match="does not fit the curriculum's networks"):
        networks.from_arrays(plan(**other), arrays)


# The exported policy


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_the_exported_policy_acts_as_brax_does_without_noise(activation: str) -> None:
    config = plan(activation=activation)
    params, made = parameters(config)
    act = ppo_networks.make_inference_fn(made)(params, deterministic=True)
    observations = np.random.default_rng(2).normal(scale=4, size=(200, 101)).astype(np.float32)
    by_brax, _ = act(jnp.asarray(observations), jax.random.PRNGKey(0))
    exported = networks.to_policy(config, networks.to_arrays(params), {})
    ours = policy.apply(exported.network, exported.activation, observations)
    assert ours.shape == (200, 12) and ours.dtype == np.float32 and np.std(ours) > 0.1
    np.testing.assert_allclose(ours, by_brax, atol=2e-5)
    wanted = np.clip(config.control.feedback_scale * np.asarray(by_brax), -1, 1)
    np.testing.assert_allclose(exported.feedback(observations), wanted, atol=1e-5)


def test_the_exported_policy_carries_what_surrounds_the_network() -> None:
    config = plan()
    exported = networks.to_policy(config, networks.to_arrays(parameters(config)[0]), {"seed": 3})
    assert exported.settings == config.control and exported.policy_period == config.policy_period
    assert exported.robot.name == config.robot and exported.provenance == {"seed": 3}
    assert exported.activation == config.network.activation
    assert [weight.shape for weight in exported.network.weights] == [(101, 24), (24, 8), (8, 12)]


def test_the_exported_policy_keeps_to_the_control_law_and_the_sway_of_the_stage_it_comes_from() -> None:
    config, law = plan(), ControlConfig(integral=1.5)
    ranges = (config.ranges._replace(sway=(-1.0, usual, 2.0)) for usual in (-0.5, 1.5))
    config = dataclasses.replace(config, ranges=next(ranges))
    last = dataclasses.replace(config.stages[-1], control=law, ranges=next(ranges))
    config = dataclasses.replace(config, stages=(*config.stages, last))
    arrays = networks.to_arrays(parameters(config)[0])
    calls = curriculum.calls(config)
    policies = [networks.to_policy(config, arrays, {}, call) for call in range(-1, len(calls))]
    laws = [policy.settings for policy in policies]
    assert laws[0] == config.control  # before the first call
    assert laws[1:] == [law if call.stage.control else config.control for call in calls] and laws[-1] == law
    assert [policy.sway for policy in policies] == [0.0] * len(calls) + [1.0]


def test_the_actor_begins_with_the_noise_of_the_curriculum_and_an_unbounded_gaussian() -> None:
    config = plan(initial_noise=0.4)
    made = networks.make(config.network, 101, 12, the_robot=robot.load())
    params = made.policy_network.init(jax.random.PRNGKey(0))
    distribution = made.parametric_action_distribution
    logits = made.policy_network.apply(None, params, jnp.zeros((2000, 101)))
    samples = distribution.postprocess(distribution.sample_no_postprocessing(logits, jax.random.PRNGKey(1)))
    assert np.std(samples - distribution.mode(logits)) == pytest.approx(0.4, rel=0.03)
    assert np.abs(samples).max() > 1.2  # a tanh would have kept it below 1


def test_another_noise_changes_the_spread_of_the_actions_alone() -> None:
    config = plan()
    params, made = parameters(config)
    quiet = networks.with_noise(params, 0.2)
    seen = jax.random.normal(jax.random.PRNGKey(1), (101,))
    samples, means = [], []
    for normalizer, actor, _ in (params, quiet):
        logits = made.policy_network.apply(normalizer, actor, jnp.broadcast_to(seen, (4000, 101)))
        samples.append(made.parametric_action_distribution.sample(logits, jax.random.PRNGKey(2)))
        means.append(made.parametric_action_distribution.mode(logits))
    np.testing.assert_array_equal(*means)
    np.testing.assert_allclose(samples[1].std(axis=0), 0.2, rtol=0.06)
    assert (np.asarray(samples[0]).std(axis=0) > 0.3).all()
    assert same(params[2], quiet[2]) and same(params[0], quiet[0])
