"""The ONNX graph against the numpy policy, and what travels with it."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest

from bipedtrack import checkpoint, observation, onnx_export, symmetry
from bipedtrack import policy as policies
from bipedtrack.control import ControlConfig
from bipedtrack.robot import Robot


def random_policy(robot: Robot, activation: str = "swish", layers: tuple[int, ...] = (64, 48)) -> policies.Policy:
    """A policy with random numbers everywhere, and a different one in every setting."""
    rng = np.random.default_rng(7)
    sizes = (observation.SIZE, *layers, 12)
    network = policies.Network(
        mean=rng.normal(size=sizes[0]).astype(np.float32),
        std=rng.uniform(0.05, 3, sizes[0]).astype(np.float32),
        weights=tuple(
            (rng.normal(size=pair) / np.sqrt(pair[0])).astype(np.float32) for pair in zip(sizes, sizes[1:], strict=False)
        ),
        biases=tuple(rng.normal(size=n).astype(np.float32) for n in sizes[1:]),
    )
    settings = ControlConfig(filter=0.35, feedback_scale=0.45, level_feet=True)
    return policies.Policy(network, activation, settings, 0.02, robot, {"seed": 3, "steps": np.int64(4)})


def observations(network: policies.Network) -> np.ndarray:
    """(10000, 101): ordinary ones, up to ten times as far from the mean, each single component at 100 deviations, and
    absurd ones, at which all feedback is at its limits."""
    rng = np.random.default_rng(8)
    ordinary = rng.normal(size=(8000, observation.SIZE))
    large = rng.normal(size=(1794, observation.SIZE)) * rng.uniform(1, 10, (1794, 1))
    single = 100 * np.concatenate([np.eye(observation.SIZE), -np.eye(observation.SIZE)])
    normalized = np.concatenate([ordinary, large, single, np.zeros((1, observation.SIZE))])
    absurd = np.array([[0.0], [1e6], [-1e6]]) + np.zeros(observation.SIZE)
    return np.concatenate([network.mean + network.std * normalized, absurd]).astype(np.float32)


def run(model: onnx.ModelProto, batch: np.ndarray) -> np.ndarray:
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    (feedback,) = session.run(["feedback"], {"observation": batch})
    return feedback


def test_a_symmetric_policys_graph_looks_at_the_mirror_image_where_the_policy_does(robot: Robot) -> None:
    policy = dataclasses.replace(random_policy(robot), symmetric=True)
    batch = observations(policy.network)
    batch[::3, observation.layout()["timer"]] = 0.0  # both feet stand
    right = symmetry.right_leads(batch)[:, 0]
    assert all(0.05 < part.mean() < 0.95 for part in (right[::3], right[1::3]))
    feedback = run(onnx_export.to_onnx(policy), batch)
    np.testing.assert_allclose(feedback, policy.feedback(batch), atol=1e-5)
    assert np.abs(feedback - random_policy(robot).feedback(batch)).max() > 0.1


@pytest.mark.parametrize("activation", policies.ACTIVATIONS)
def test_onnxruntime_and_numpy_give_the_same_feedback(robot: Robot, activation: str) -> None:
    policy = random_policy(robot, activation)
    batch = observations(policy.network)
    feedback = run(onnx_export.to_onnx(policy), batch)
    expected = policy.feedback(batch)
    assert batch.shape == (10_000, observation.SIZE)
    assert feedback.dtype == np.float32 and feedback.shape == (10_000, 12)
    # the ordinary ones lie within the clip, extremes on both of its ends
    assert np.abs(expected[:8000]).mean() < 0.9 and expected.min() == -1 and expected.max() == 1
    np.testing.assert_allclose(feedback, expected, rtol=0, atol=1e-5)


def test_the_batch_is_of_any_size_and_one_layer_is_enough(robot: Robot) -> None:
    policy = random_policy(robot, layers=())
    model = onnx_export.to_onnx(policy)
    for size in (1, 3):
        batch = observations(policy.network)[:size]
        np.testing.assert_allclose(run(model, batch), policy.feedback(batch), rtol=0, atol=1e-5)


def test_input_and_output_are_declared(robot: Robot) -> None:
    session = onnxruntime.InferenceSession(onnx_export.to_onnx(random_policy(robot)).SerializeToString())
    (given,), (result,) = session.get_inputs(), session.get_outputs()
    assert (given.name, given.shape, given.type) == ("observation", ["N", 101], "tensor(float)")
    assert (result.name, result.shape, result.type) == ("feedback", ["N", 12], "tensor(float)")


def test_metadata_say_all_that_a_controller_around_the_graph_needs(robot: Robot) -> None:
    policy = random_policy(robot)
    session = onnxruntime.InferenceSession(onnx_export.to_onnx(policy).SerializeToString())
    found = {key: json.loads(value) for key, value in session.get_modelmeta().custom_metadata_map.items()}
    assert list(found["observation_layout"].items()) == list(observation.WIDTHS._asdict().items())
    assert found["observation_hash"] == observation.layout_hash()
    assert found["policy_period"] == 0.02 and found["sway"] == policy.sway
    assert found["filter"] == 0.35 and found["feedback_scale"] == 0.45
    assert found["level_feet"] is True and found["velocity_feedforward"] is False
    assert found["provenance"] == {"seed": 3, "steps": 4}
    # the robot can be had back to the last bit
    fields = {name: found.pop("robot" if name == "name" else name) for name in vars(robot)}
    for name, value in vars(robot).items():
        assert np.array_equal(np.asarray(fields[name]), np.asarray(value)), name


def test_a_saved_file_is_the_graph_and_replaces_what_stood_there(robot: Robot, tmp_path: Path) -> None:
    path = tmp_path / "policy.onnx"
    path.write_text("old")
    onnx_export.save(random_policy(robot), path)
    assert onnx.load(path) == onnx_export.to_onnx(random_policy(robot))
    assert list(tmp_path.iterdir()) == [path]


def test_a_place_that_cannot_be_written_is_named(robot: Robot, tmp_path: Path) -> None:
    for path in (tmp_path / "missing" / "policy.onnx", tmp_path):
        with pytest.raises(checkpoint.RunError, match="cannot be written") as caught:
            onnx_export.save(random_policy(robot), path)
        assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == [] and list(tmp_path.parent.glob("*.unfinished")) == []


def test_without_onnx_the_extra_is_named() -> None:
    program = """
import sys
sys.modules["onnx"] = None
from bipedtrack import onnx_export
try:
    onnx_export.to_onnx(None)
except onnx_export.OnnxError as error:
    print(error)
"""
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert found.stdout == "the package onnx is not installed; wanted `pip install '.[onnx]'` in its clone\n", found.stderr
