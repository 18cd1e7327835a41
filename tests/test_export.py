"""Export: the policy of a run's newest checkpoint in one file, or one line that says why not, and no half-written file."""

import contextlib
import dataclasses
import importlib.metadata
import json
import os
import pathlib
import resource
import subprocess
import sys

import jax
import numpy as np
import onnxruntime
import pytest

import bipedtrack
from bipedtrack import config, curriculum, export, networks, observation, policy, robot, training, versions
from bipedtrack.run_directory import RunDirectory

ROOT = pathlib.Path(bipedtrack.__file__).parents[1]
PLAN = curriculum.load("smoke")
SEED = 11


def random_arrays(plan, seed):
    """A checkpoint's arrays for a curriculum: brax's parameters, all random and positive."""
    rng = np.random.default_rng(seed)

    def random(leaf):
        return rng.uniform(0.1, 1, leaf.shape).astype(leaf.dtype)

    return networks.to_arrays(jax.tree.map(random, networks.template(plan)))


def make_run(path, finished_calls=2, plan=PLAN):
    """A run directory as training leaves it after some calls."""
    settings = {
        "curriculum": config.to_dict(plan),
        "seed": SEED,
        "versions": {row.name: row.found for row in versions.check()},
    }
    run = RunDirectory.create(path, settings)
    for index in range(finished_calls):
        run.save_checkpoint(index, random_arrays(plan, index), {"provenance": training.provenance(plan, SEED, index + 1)})
    run.close()
    return path


def export_by_subprocess(*arguments):
    """The finished process of `python -m bipedtrack.export`, outside of the checkout."""
    return subprocess.run(
        [sys.executable, "-m", "bipedtrack.export", *map(str, arguments)],
        cwd=pathlib.Path(arguments[0]).parent,
        env={**os.environ, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        timeout=120,
    )


@pytest.fixture
def refused(monkeypatch, capsys):
    """Runs the command line in this process; returns its one line on stderr, having checked exit status and line."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["bipedtrack.export", *map(str, arguments)])
        with pytest.raises(SystemExit) as info:
            export.main()
        output = capsys.readouterr()
        assert info.value.code == 2 and output.out == ""
        (line,) = output.err.splitlines()
        assert line.startswith("bipedtrack: ")
        return line

    return run


def flip(path):
    """Damages a file: one bit in its middle."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


# What is exported


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A run of two finished calls, the process that exported it, and its file."""
    folder = tmp_path_factory.mktemp("export")
    run = make_run(folder / "run")
    out = folder / "walker.npz"
    return run, export_by_subprocess(run, "--out", out), out


def test_the_command_writes_the_file_and_says_where_and_nothing_else(exported):
    run, process, out = exported
    assert (process.returncode, process.stderr) == (0, "")
    assert process.stdout == f"{out}\n"
    assert sorted(path.name for path in out.parent.iterdir()) == ["run", "walker.npz"]


def test_the_file_holds_the_newest_checkpoints_actor_and_normaliser(exported):
    loaded = policy.load(exported[2], robot=robot.load())
    newest = random_arrays(PLAN, 1)
    for suffix, name in (("kernel", "weights"), ("bias", "biases")):
        wanted = [newest[f"1/params/MLP_0/hidden_0/{suffix}"], newest[f"1/params/Dense_0/{suffix}"]]
        for found, right in zip(getattr(loaded.network, name), wanted, strict=True):
            np.testing.assert_array_equal(found, right)
    np.testing.assert_array_equal(loaded.network.mean, newest["0/mean"])
    np.testing.assert_array_equal(loaded.network.std, newest["0/std"])


def test_the_file_holds_all_that_acts_between_command_and_joint_targets(exported):
    loaded = policy.load(exported[2])
    assert loaded.activation == PLAN.network.activation
    assert loaded.settings == PLAN.control
    assert loaded.policy_period == PLAN.policy_period
    assert loaded.robot.name == PLAN.robot
    for name, wanted in vars(robot.load(PLAN.robot)).items():
        np.testing.assert_array_equal(getattr(loaded.robot, name), wanted)
    controller = policy.Controller(loaded)
    controller.reset(np.zeros(19))


def test_onnx_is_written_beside_the_policy_and_from_a_policy_file(exported, tmp_path, monkeypatch, capsys):
    run, _, policy_file = exported
    graphs = []
    for source in (run, policy_file):
        graphs.append(tmp_path / f"{source.name}.onnx")
        out = ["--out", str(tmp_path / "again.npz")] if source is run else []
        arguments = [str(source), *out, "--onnx", str(graphs[-1])]
        monkeypatch.setattr(sys, "argv", ["bipedtrack.export", *arguments])
        export.main()
        assert capsys.readouterr().out.splitlines()[-1] == str(graphs[-1])
    assert graphs[0].read_bytes() == graphs[1].read_bytes()
    assert (tmp_path / "again.npz").read_bytes() == policy_file.read_bytes()
    observations = np.random.default_rng(5).normal(scale=0.1, size=(50, observation.SIZE)).astype(np.float32)
    (feedback,) = onnxruntime.InferenceSession(graphs[0]).run(None, {"observation": observations})
    wanted = policy.load(policy_file).feedback(observations)
    assert np.std(wanted) > 0.01
    np.testing.assert_allclose(feedback, wanted, atol=1e-5)


def test_onnx_alone_leaves_other_policies_alone(exported, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "policy.npz").write_text("mine")
    monkeypatch.setattr(sys, "argv", ["bipedtrack.export", str(exported[0]), "--onnx", "policy.onnx"])
    export.main()
    assert capsys.readouterr().out == "policy.onnx\n" and (tmp_path / "policy.npz").read_text() == "mine"


def test_a_policy_file_has_nothing_to_export_but_onnx(exported, refused, tmp_path):
    assert "is a file; wanted a run directory, or --onnx" in refused(exported[2])
    again = refused(exported[2], "--onnx", tmp_path / "policy.onnx", "--out", tmp_path / "again.npz")
    assert "is a policy file already; wanted --onnx alone" in again and not list(tmp_path.iterdir())
    assert "cannot be written" in refused(exported[2], "--onnx", tmp_path / "missing" / "policy.onnx")


def test_the_provenance_names_curriculum_seed_steps_and_versions(exported):
    provenance = policy.load(exported[2]).provenance
    assert provenance["curriculum"] == "smoke" and provenance["seed"] == SEED
    assert provenance["steps"] == 192 + 192  # the two calls that are finished, of three
    assert provenance["bipedtrack"] == bipedtrack.__version__
    for name in ("jax", "brax", "mujoco", "numpy"):
        assert provenance["versions"][name] == importlib.metadata.version(name)


def test_a_curriculums_own_settings_travel_with_the_policy(tmp_path):
    network = dataclasses.replace(PLAN.network, actor=(9, 7, 5), activation="tanh")
    control = dataclasses.replace(PLAN.control, filter=0.7, feedback_scale=0.5, level_feet=True)
    plan = dataclasses.replace(PLAN, name="own", network=network, control=control, policy_period=0.005)
    export.export(make_run(tmp_path / "run", 1, plan), tmp_path / "policy.npz")
    loaded = policy.load(tmp_path / "policy.npz")
    assert [weight.shape for weight in loaded.network.weights] == [(observation.SIZE, 9), (9, 7), (7, 5), (5, 12)]
    assert (loaded.activation, loaded.settings, loaded.policy_period) == ("tanh", control, 0.005)
    assert loaded.provenance["curriculum"] == "own" and loaded.provenance["steps"] == 192


def test_an_export_replaces_an_older_file(tmp_path):
    out = tmp_path / "policy.npz"
    out.write_bytes(b"an older policy")
    export.export(make_run(tmp_path / "run", 1), out)
    policy.load(out)


def test_a_run_that_trains_can_be_exported(tmp_path):
    run = make_run(tmp_path / "run", 1)
    training_process = RunDirectory.open(run)  # holds the lock
    export.export(run, tmp_path / "policy.npz")
    training_process.close()
    policy.load(tmp_path / "policy.npz")


def test_with_the_newest_checkpoint_damaged_the_one_before_is_exported(tmp_path):
    run = make_run(tmp_path / "run", 2)
    flip(run / "checkpoints" / "0001.npz")
    export.export(run, tmp_path / "policy.npz")
    loaded = policy.load(tmp_path / "policy.npz")
    np.testing.assert_array_equal(loaded.network.mean, random_arrays(PLAN, 0)["0/mean"])
    assert loaded.provenance["steps"] == 192


# What is not


def test_no_such_run(refused, tmp_path):
    line = refused(tmp_path / "nowhere", "--out", tmp_path / "policy.npz")
    assert "nowhere" in line and "No such file" in line
    assert not list(tmp_path.iterdir())


def test_a_run_without_a_checkpoint(refused, tmp_path):
    line = refused(make_run(tmp_path / "run", 0), "--out", tmp_path / "policy.npz")
    assert f"{tmp_path / 'run'}: has no checkpoint yet" in line
    assert not (tmp_path / "policy.npz").exists()


@pytest.mark.parametrize("older", [None, b"an older policy"])
def test_a_damaged_checkpoint(refused, tmp_path, older):
    run, out = make_run(tmp_path / "run", 1), tmp_path / "policy.npz"
    if older:
        out.write_bytes(older)
    flip(run / "checkpoints" / "0000.npz")
    assert "0000.npz" in refused(run, "--out", out)
    assert (out.read_bytes() if out.exists() else None) == older


def test_a_checkpoint_of_other_networks(refused, tmp_path):
    run = make_run(tmp_path / "run", 0)
    with contextlib.closing(RunDirectory.open(run)) as directory:
        wider = dataclasses.replace(PLAN, network=dataclasses.replace(PLAN.network, actor=(17,)))
        directory.save_checkpoint(0, random_arrays(wider, 0), {"provenance": training.provenance(wider, SEED, 1)})
    line = refused(run, "--out", tmp_path / "policy.npz")
    assert "does not fit the curriculum's networks" in line
    assert not (tmp_path / "policy.npz").exists()


def damage(**changes):
    """run.json with other keys, None: without that key."""

    def apply(content):
        settings = json.loads(content) | changes
        return json.dumps({key: value for key, value in settings.items() if value is not None})

    return apply


SETTINGS = {
    "cut off": lambda content: content[: len(content) // 2],
    "unknown key": damage(curriculum=config.to_dict(PLAN) | {"polcy_period": 0.02}),
    "unknown robot": damage(curriculum=config.to_dict(PLAN) | {"robot": "nobody"}),
    "curriculum a word": damage(curriculum="smoke"),
    "no curriculum": damage(curriculum=None),
    "no seed": damage(seed=None),
    "devices a word": damage(devices="two"),
    "a list": lambda content: "[]",
}


@pytest.mark.parametrize("name", SETTINGS)
def test_damaged_settings(refused, tmp_path, name):
    run = make_run(tmp_path / "run", 1)
    settings = run / "run.json"
    settings.write_text(SETTINGS[name](settings.read_text()))
    refused(run, "--out", tmp_path / "policy.npz")
    assert not (tmp_path / "policy.npz").exists()


@pytest.mark.parametrize("place", ["missing/policy.npz", "file/policy.npz", "folder"])
def test_a_file_that_cannot_be_written(refused, tmp_path, place):
    run = make_run(tmp_path / "run", 1)
    (tmp_path / "file").write_text("not a folder")
    (tmp_path / "folder").mkdir()
    there = sorted(tmp_path.rglob("*"))
    line = refused(run, "--out", tmp_path / place)
    assert f"{tmp_path / place}: cannot be written" in line
    assert sorted(tmp_path.rglob("*")) == there


@pytest.mark.parametrize("older", [None, b"an older policy"])
def test_a_full_disk_leaves_the_older_file_or_none(refused, tmp_path, older):
    run, out = make_run(tmp_path / "run", 1), tmp_path / "policy.npz"
    if older:
        out.write_bytes(older)
    there = sorted(tmp_path.rglob("*"))
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))  # no file may grow beyond: as full as a disk
    try:
        line = refused(run, "--out", out)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert "cannot be written" in line
    assert sorted(tmp_path.rglob("*")) == there
    assert (out.read_bytes() if out.exists() else None) == older


def test_the_command_itself_refuses_in_one_line_and_with_status_2(tmp_path):
    run = make_run(tmp_path / "run", 1)
    process = export_by_subprocess(run, "--out", tmp_path / "missing" / "policy.npz")
    assert (process.returncode, process.stdout) == (2, "")
    assert len(process.stderr.splitlines()) == 1 and "cannot be written" in process.stderr
