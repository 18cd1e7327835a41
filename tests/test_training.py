"""Brax's parameters as named arrays and back, the exported policy against brax's own actor, the seeds of the calls."""

import dataclasses
import pathlib
from typing import Any

import brax.envs
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import networks as ppo_networks
from brax.training.agents.ppo import train as ppo
from jax.experimental.compilation_cache import compilation_cache

from bipedtrack import checkpoint, curriculum, policy, training
from bipedtrack.checkpoint import CheckpointError

ACTIVATIONS = ("swish", "tanh", "relu")


def plan(**network: Any) -> curriculum.Curriculum:
    smoke = curriculum.load("smoke")
    sizes = {"actor": (24, 8), "critic": (12,)} | network
    return dataclasses.replace(smoke, network=dataclasses.replace(smoke.network, **sizes))


def parameters(config: curriculum.Curriculum, seed: int = 0) -> tuple[Any, ppo_networks.PPONetworks]:
    """Brax's parameters with a normaliser that has seen data and an actor of random biases, and brax's networks."""
    made = training.make_networks(config.network, 101, 12, preprocess_observations_fn=running_statistics.normalize)
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
    arrays = training.to_arrays(params)
    assert all(isinstance(array, np.ndarray) for array in arrays.values())
    assert len(arrays) == len(jax.tree.leaves(params))
    shuffled = {name: arrays[name] for name in sorted(arrays, reverse=True)}
    back = training.from_arrays(config, shuffled)
    assert same(back, params)
    assert not same(back, parameters(config, seed=1)[0])
    # what brax puts at a place in the tree has that place's name
    assert (arrays["0/mean"] == params[0].mean).all() and (arrays["0/std"] == params[0].std).all()
    kernel = params[1]["params"]["MLP_0"]["hidden_1"]["kernel"]
    assert (arrays["1/params/MLP_0/hidden_1/kernel"] == kernel).all() and kernel.shape == (24, 8)


def test_arrays_that_do_not_fit_the_networks_are_refused_in_one_line_that_names_them() -> None:
    config = plan()
    arrays = training.to_arrays(parameters(config)[0])
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
            training.from_arrays(config, wrong)
        line = str(caught.value)
        assert message in line and "\n" not in line and ("foreign" in message or bias in line)


@pytest.mark.parametrize("other", [{"actor": (24, 9)}, {"actor": (24,)}, {"critic": (13,)}, {"critic": (12, 12)}])
def test_a_checkpoint_of_other_networks_is_refused(other: dict[str, Any]) -> None:
    arrays = training.to_arrays(parameters(plan())[0])
    with pytest.raises(CheckpointError, match="does not fit the curriculum's networks"):
        training.from_arrays(plan(**other), arrays)


# The exported policy


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_the_exported_policy_acts_as_brax_does_without_noise(activation: str) -> None:
    config = plan(activation=activation)
    params, made = parameters(config)
    act = ppo_networks.make_inference_fn(made)(params, deterministic=True)
    observations = np.random.default_rng(2).normal(scale=4, size=(200, 101)).astype(np.float32)
    by_brax, _ = act(jnp.asarray(observations), jax.random.PRNGKey(0))
    exported = training.to_policy(config, training.to_arrays(params), {})
    ours = policy.apply(exported.network, exported.activation, observations)
    assert ours.shape == (200, 12) and ours.dtype == np.float32 and np.std(ours) > 0.1
    np.testing.assert_allclose(ours, by_brax, atol=2e-5)
    wanted = np.clip(config.control.feedback_scale * np.asarray(by_brax), -1, 1)
    np.testing.assert_allclose(exported.feedback(observations), wanted, atol=1e-5)


def test_the_exported_policy_carries_what_surrounds_the_network() -> None:
    config = plan()
    exported = training.to_policy(config, training.to_arrays(parameters(config)[0]), {"seed": 3})
    assert exported.settings == config.control and exported.policy_period == config.policy_period
    assert exported.robot.name == config.robot and exported.provenance == {"seed": 3}
    assert exported.activation == config.network.activation
    assert [weight.shape for weight in exported.network.weights] == [(101, 24), (24, 8), (8, 12)]


def test_the_actor_begins_with_the_noise_of_the_curriculum_and_an_unbounded_gaussian() -> None:
    config = plan(initial_noise=0.4)
    made = training.make_networks(config.network, 101, 12)
    params = made.policy_network.init(jax.random.PRNGKey(0))
    distribution = made.parametric_action_distribution
    logits = made.policy_network.apply(None, params, jnp.zeros((2000, 101)))
    samples = distribution.postprocess(distribution.sample_no_postprocessing(logits, jax.random.PRNGKey(1)))
    assert np.std(samples - distribution.mode(logits)) == pytest.approx(0.4, rel=0.03)
    assert np.abs(samples).max() > 1.2  # a tanh would have kept it below 1


# Calls


def test_brax_compiles_its_epoch_once_and_not_twice(caplog: pytest.LogCaptureFixture) -> None:
    def compilations(epochs: int) -> int:
        caplog.clear()
        with jax.log_compiles():
            ppo.train(
                environment=brax.envs.get_environment("fast"),
                num_timesteps=4 * epochs,
                num_evals=epochs + 1,
                run_evals=False,
                episode_length=4,
                num_envs=2,
                unroll_length=2,
                batch_size=2,
                num_minibatches=1,
            )
        return sum("Finished XLA compilation of jit(_fun)" in record.getMessage() for record in caplog.records)

    once = compilations(1)
    assert once >= 1
    with training.adapted_brax():
        assert compilations(3) == once
    assert compilations(3) == once + 1  # or brax no longer needs our help


def test_an_epoch_reports_the_episodes_that_ended_in_it_and_can_be_kept_on_disk(tmp_path: pathlib.Path) -> None:
    reported: list[dict[str, Any]] = []
    names = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    before = {name: getattr(jax.config, name) for name in names}
    compilation_cache.reset_cache()
    try:
        for name, value in zip(names, (str(tmp_path), 0.0), strict=True):
            jax.config.update(name, value)
        with training.adapted_brax():
            ppo.train(
                environment=brax.envs.get_environment("fast"),
                num_timesteps=48,
                num_evals=2,
                run_evals=False,
                episode_length=4,
                num_envs=2,
                unroll_length=6,
                batch_size=2,
                num_minibatches=1,
                progress_fn=lambda steps, metrics: reported.append(metrics),
            )
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
        compilation_cache.reset_cache()
    (metrics,) = reported
    # 48 steps of two robots, every fourth of which ends an episode
    assert metrics["training/episodes"] == pytest.approx(1 / 4)
    assert metrics["training/episode/length"] / metrics["training/episodes"] == pytest.approx(4)
    assert list(tmp_path.glob("jit__fun-*"))


def test_figures_are_means_over_the_episodes_that_ended() -> None:
    # two of four steps ended an episode: one of 3 steps that fell, one of 5; brax gives means over all steps
    sums = {"length": 3 + 5, "fell": 1 + 0, "nonfinite": 0, "sum_reward": 6 + 10, "ankle_error_cm_per_step": 2 + 4}
    learner = dict.fromkeys(("kl_mean", "policy_dist_mean_std", "policy_loss", "v_loss", "entropy_loss"), 0.5)
    metrics = {"episodes": 2 / 4, **{f"episode/{name}": value / 4 for name, value in sums.items()}, **learner}
    found = training._figures({f"training/{name}": np.float32(value) for name, value in metrics.items()}, 0.02)
    assert found["episode_seconds"] == pytest.approx(4 * 0.02)
    assert (found["falls"], found["nonfinite"], found["ankle_error_cm"]) == pytest.approx((0.5, 0, 3))
    assert found["reward_per_step"] == pytest.approx(2) and found["kl_mean"] == 0.5
    nobody = training._figures({f"training/{name}": np.float32(0) for name in metrics}, 0.02)
    assert np.isnan(nobody["falls"]) and nobody["kl_mean"] == 0


def test_every_call_of_every_run_has_a_seed_of_its_own() -> None:
    seeds = {training.call_seed(seed, index) for seed in range(60) for index in range(60)}
    assert len(seeds) == 3600 and all(0 <= seed < 2**31 for seed in seeds)
    assert training.call_seed(1, 2) == training.call_seed(1, 2)
    big = training.call_seed(2**40, 0)
    assert 0 <= big < 2**31 and big != training.call_seed(0, 0)


def test_only_a_stage_with_stairs_pays_for_boxes() -> None:
    config = curriculum.load("smoke")
    envs = [training.make_env(config, stage, stage.lessons[0]) for stage in config.stages]
    assert [env.mj_model.nmocap for env in envs] == [0, 3, 3]
    assert [float(env.given.hold_share) for env in envs] == pytest.approx([0, 0, 0.6])
    harder = training.make_env(config, config.stages[0], dataclasses.replace(config.stages[0].lessons[0], difficulty=1.0))
    step = config.ranges.walk_step
    np.testing.assert_allclose(envs[0].given.ranges["walk_step"], [0.5 * step[0], 0.5 * step[2]], atol=1e-7)
    np.testing.assert_allclose(harder.given.ranges["walk_step"], [step[0], step[2]], atol=1e-7)


def test_another_noise_changes_the_spread_of_the_actions_alone() -> None:
    config = plan()
    params, made = parameters(config)
    quiet = training._with_noise(params, 0.2)
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


def test_a_stage_with_rewards_of_its_own_uses_them() -> None:
    config = curriculum.load("smoke")
    own = config.rewards._replace(sharpness=config.rewards.sharpness._replace(trunk_position=77.0))
    stages = [dataclasses.replace(config.stages[0], rewards=rewards) for rewards in (None, own)]
    envs = [training.make_env(config, stage, stage.lessons[0]) for stage in stages]
    assert [env.config.rewards for env in envs] == [config.rewards, own]


def test_provenance_counts_the_steps_of_the_finished_calls() -> None:
    config = curriculum.load("smoke")
    found = training.provenance(config, 7, 2)
    assert (found["curriculum"], found["seed"], found["steps"]) == ("smoke", 7, 384)
    assert found["versions"]["brax"] == "0.14.2" and set(found["versions"]) >= {"jax", "mujoco", "numpy"}
    assert "origin" not in found


def test_provenance_tells_what_a_run_began_with_to_its_last_call() -> None:
    config, arrays = curriculum.load("smoke"), {"w": np.zeros(3, np.float32)}
    first = training.provenance(config, 7, 3)
    begun = training.origin_of(checkpoint.Checkpoint(-1, arrays, {"provenance": first}))
    assert begun is not None and begun["steps"] == 576 and len(begun["parameters"]) == 64
    later = checkpoint.Checkpoint(0, arrays, {"provenance": training.provenance(config, 8, 1, begun)})
    assert training.origin_of(later) == begun


def test_a_stage_with_ranges_of_its_own_draws_from_them() -> None:
    config = plan()
    own = config.ranges._replace(stair_riser=(0.1, 0.1, 0.17))
    stages = [dataclasses.replace(config.stages[1], ranges=ranges) for ranges in (None, own)]
    lesson = dataclasses.replace(config.stages[1].lessons[0], difficulty=1.0)
    drawn = [training.make_env(config, stage, lesson).given.ranges for stage in stages]
    assert [ranges["stair_riser"].tolist() for ranges in drawn] == [pytest.approx([0.02, 0.17]), pytest.approx([0.1, 0.17])]
    assert drawn[0]["stair_tread"].tolist() == drawn[1]["stair_tread"].tolist()
