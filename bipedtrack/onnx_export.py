"""The policy as one ONNX graph from observation to feedback, with what a controller around it must know as metadata.

Inverse kinematics, mixing, filter and PD are not in the graph: they need the command, not the observation (`control`).
"""

from __future__ import annotations

import importlib
import json
import pathlib
from typing import TYPE_CHECKING, Any

import numpy as np

from bipedtrack import __version__, checkpoint, config, observation, symmetry
from bipedtrack.messages import Refusal
from bipedtrack.policy import Policy

if TYPE_CHECKING:
    import onnx

# Old enough for the runtimes found on robots; the graph needs nothing newer than Clip with inputs (opset 11).
OPSET, IR_VERSION = 17, 8


class OnnxError(Refusal, RuntimeError):
    """The onnx package is missing; the message is one line that says how to get it."""


def to_onnx(policy: Policy) -> onnx.ModelProto:
    """The graph of `Policy.feedback`: input `observation` (N, 101) float32, output `feedback` (N, 12) float32 in [-1, 1].

    Normaliser, network, feedback scale and clip are inside; `metadata` is attached. Raises OnnxError.
    """
    require_onnx()
    from onnx import TensorProto, checker, helper, numpy_helper

    nodes: list[onnx.NodeProto] = []
    constants: list[onnx.TensorProto] = []

    def constant(name: str, value: Any) -> str:
        constants.append(numpy_helper.from_array(np.asarray(value, np.float32), name))
        return name

    def apply(operator: str, *inputs: str, output: str = "") -> str:
        output = output or f"{operator.lower()}_{len(nodes)}"
        nodes.append(helper.make_node(operator, inputs, [output], name=output))
        return output

    def difference(of: str, left: int, right: int) -> str:
        """The second of two numbers of a part of the observation less the first, (N, 1)."""
        column = np.zeros((observation.SIZE, 1))
        start = observation.layout()[of].start
        column[start + left], column[start + right] = -1, 1
        return apply("MatMul", "observation", constant(f"difference/{of}", column))

    def right_leads() -> str:
        """symmetry.right_leads."""
        later, earlier = difference("timer", 0, 1), constant("earlier", -symmetry.LATER)
        ahead = apply("Less", difference("feedforward", *symmetry.HIP_PITCH), constant("ahead", -symmetry.AHEAD))
        both = apply("And", apply("GreaterOrEqual", later, earlier), ahead)
        return apply("Or", apply("Greater", later, constant("later", symmetry.LATER)), both)

    def where_right(mirrored: str, otherwise: str, output: str = "") -> str:
        return apply("Where", right, mirrored, otherwise, output=output)

    network, shown, right = policy.network, "observation", ""
    if policy.symmetric:
        image = constant("mirror", symmetry.mirrored_observation(np.eye(observation.SIZE)))
        right = right_leads()
        shown = where_right(apply("MatMul", shown, image), shown)
    hidden = apply("Sub", shown, constant("normalizer/mean", network.mean))
    hidden = apply("Div", hidden, constant("normalizer/std", network.std))
    for i, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        if i > 0 and policy.activation == "swish":
            hidden = apply("Mul", hidden, apply("Sigmoid", hidden))
        elif i > 0:
            hidden = apply({"tanh": "Tanh", "relu": "Relu"}[policy.activation], hidden)
        hidden = apply("Gemm", hidden, constant(f"actor/{i}/weight", weight), constant(f"actor/{i}/bias", bias))
    hidden = apply("Mul", hidden, constant("feedback_scale", policy.settings.feedback_scale))
    clipped = apply("Clip", hidden, constant("low", -1.0), constant("high", 1.0), output="" if right else "feedback")
    if right:
        image = constant("mirror_joints", symmetry.mirrored_joints(np.eye(len(policy.robot.joint_names))))
        where_right(apply("MatMul", clipped, image), clipped, output="feedback")

    def batch(name: str, width: int, doc: str) -> onnx.ValueInfoProto:
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, ["N", width], doc)

    graph = helper.make_graph(
        nodes,
        "policy",
        [batch("observation", observation.SIZE, "O_t of eq (8), SI units; its parts in metadata `observation_layout`")],
        [batch("feedback", len(policy.robot.joint_names), "a_fb of eq (6) in [-1, 1], in the order of `joint_names`")],
        constants,
    )
    model = helper.make_model(
        graph,
        producer_name="bipedtrack",
        producer_version=__version__,
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        doc_string="Feedback of a trunk and ankle tracking controller. Metadata are JSON, in SI units.",
    )
    helper.set_model_props(model, metadata(policy))
    checker.check_model(model, full_check=True)
    return model


def metadata(policy: Policy) -> dict[str, str]:
    """What a controller around the graph must know, each value JSON.

    Besides `observation_layout` (parts and widths, in order), `observation_hash`, `policy_period` (s), `activation` and
    `provenance`: every field of robot.Robot (`joint_names`, `feedback_ratio` k_b, `joint_low`, `kp` ..., its name as
    `robot`) and of control.ControlConfig (`filter`, `feedback_scale` ...), in their units.
    """
    robot = dict(vars(policy.robot))
    values = {
        "observation_layout": observation.WIDTHS._asdict(),
        "observation_hash": observation.layout_hash(),
        "activation": policy.activation,
        "policy_period": policy.policy_period,
        "sway": policy.sway,
        "robot": robot.pop("name"),
        **robot,
        **config.to_dict(policy.settings),
        "provenance": policy.provenance,
    }
    return {name: json.dumps(value, default=lambda array: array.tolist()) for name, value in values.items()}


def save(policy: Policy, path: str | pathlib.Path) -> None:
    """Writes the graph, whole or not at all. Raises OnnxError, and checkpoint.RunError where it cannot be written."""
    checkpoint.write_bytes(path, to_onnx(policy).SerializeToString(deterministic=True))


def require_onnx() -> None:
    """Raises OnnxError where the package onnx is missing."""
    try:
        importlib.import_module("onnx")
    except ImportError:
        raise OnnxError("the package onnx is not installed; wanted `pip install '.[onnx]'` in its clone") from None
