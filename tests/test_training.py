"""The calls of a training: their environments, seeds, figures and provenance."""

import dataclasses
import pathlib
from typing import Any

import jax
import numpy as np
import pytest

from bipedtrack import checkpoint, control, curriculum, networks, training
from bipedtrack.progress import Aside
from bipedtrack.run_directory import RunDirectory


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
    config = curriculum.load("smoke")
    own = config.ranges._replace(stair_riser=(0.1, 0.1, 0.17))
    stages = [dataclasses.replace(config.stages[1], ranges=ranges) for ranges in (None, own)]
    lesson = dataclasses.replace(config.stages[1].lessons[0], difficulty=1.0)
    drawn = [training.make_env(config, stage, lesson).given.ranges for stage in stages]
    assert [ranges["stair_riser"].tolist() for ranges in drawn] == [pytest.approx([0.02, 0.17]), pytest.approx([0.1, 0.17])]
    assert drawn[0]["stair_tread"].tolist() == drawn[1]["stair_tread"].tolist()


def test_everything_that_a_stage_says_reaches_its_environment() -> None:
    config = curriculum.load("smoke")
    own = control.ControlConfig(filter=0.7, level_feet=True)
    stage = dataclasses.replace(
        config.stages[0],
        **{"hold_share": 0.11, "hold_after": (2, 5), "mix_share": 0.12, "break_share": 0.13},
        **{"scripts": ("hop", "kick"), "script_share": 0.4, "control": own},
    )
    lesson = dataclasses.replace(stage.lessons[0], push_share=0.14)
    env = training.make_env(config, stage, lesson)
    shares = [float(getattr(env.given, name)) for name in ("hold_share", "mix_share", "break_share", "push_share")]
    assert shares == pytest.approx([0.11, 0.12, 0.13, 0.14]) and env.given.hold_after.tolist() == [2, 5]
    assert env.config.control == own != config.control
    keys = jax.random.split(jax.random.PRNGKey(0), 400)
    scripted = jax.vmap(lambda key: env.source.begin(key, env.given, env.robot)[0].scripted)(keys)
    assert 0.3 < float(scripted.mean()) < 0.5


@pytest.mark.filterwarnings("ignore:jax.device_put_replicated")
@pytest.mark.parametrize(("behind", "saved"), [(0, True), (32, False)])
def test_a_stop_in_the_last_epoch_of_a_call_keeps_the_call(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch, behind: int, saved: bool
) -> None:
    config, asked = curriculum.load("smoke"), []
    params = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), networks.template(config))

    def ppo(num_timesteps: int, policy_params_fn: Any, **_: Any) -> Any:
        policy_params_fn(0, None, params)
        asked.append("Ctrl-C")
        policy_params_fn(num_timesteps - behind, None, params)
        return None, params, None

    monkeypatch.setattr(training.ppo, "train", ppo)
    run = RunDirectory.create(tmp_path / "run", {})
    with pytest.raises(training.Stopped):
        training.train(config, run, 0, 1, Aside(), lambda: bool(asked))
    found = run.latest()
    assert (found is not None) == saved and asked == ["Ctrl-C"]
    run.close()


@pytest.mark.filterwarnings("ignore:jax.device_put_replicated")
def test_parameters_that_are_not_finite_end_the_training(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = curriculum.load("smoke")
    params = jax.tree.map(
        lambda leaf: np.full(leaf.shape, np.inf if leaf.dtype == np.float32 else 0, leaf.dtype), networks.template(config)
    )
    monkeypatch.setattr(training.ppo, "train", lambda policy_params_fn, **_: policy_params_fn(32, None, params))
    with pytest.raises(training.DivergedError, match="lesson 'half difficulty': the training diverged"):
        training.train(config, None, 0, 1, Aside(), lambda: False)
