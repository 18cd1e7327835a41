"""The trained policy: the actor as a function, the file it travels in, and the controller that runs anywhere numpy runs.

A policy file holds all that was chosen of what acts between a command and the joint targets (network, normaliser, robot,
settings of the control law, observation layout), so an exported policy does not act otherwise than in training because
something was left behind; the law itself is this package's code.
"""

from __future__ import annotations

import dataclasses
import math
import pathlib
from typing import Any, NamedTuple

import numpy as np

from bipedtrack import checkpoint, config, control, kinematics, observation, symmetry
from bipedtrack import robot as robots
from bipedtrack.control import ControlConfig
from bipedtrack.messages import Refusal
from bipedtrack.planner import Command
from bipedtrack.robot import Robot
from bipedtrack.rotations import Array, namespace

KIND = "policy"
ACTIVATIONS = ("swish", "tanh", "relu")


class PolicyError(Refusal, ValueError):
    """A policy that does not fit this robot or this version; the message is one line."""


class Network(NamedTuple):
    """The actor's arrays: normaliser and dense layers, input to output."""

    mean: Array  # (101,)
    std: Array  # (101,)
    weights: tuple[Array, ...]  # (inputs, outputs) each
    biases: tuple[Array, ...]  # (outputs,) each


def apply(network: Network, activation: str, flat_observation: Array) -> Array:
    """The network's output (..., 12), the mean of the action distribution, for observations (..., 101)."""
    xp = namespace(flat_observation)
    hidden = (flat_observation - network.mean) / network.std
    last = len(network.weights) - 1
    for i, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        hidden = hidden @ weight + bias
        if i < last:
            if activation == "swish":
                hidden = (0.5 * hidden) * (1 + xp.tanh(0.5 * hidden))
            elif activation == "tanh":
                hidden = xp.tanh(hidden)
            else:
                hidden = xp.maximum(hidden, xp.zeros_like(hidden))
    return hidden


@dataclasses.dataclass(frozen=True)
class Policy:
    """What a policy file holds."""

    network: Network
    activation: str
    settings: ControlConfig
    policy_period: float  # s
    robot: Robot
    provenance: dict[str, Any]  # where it comes from: curriculum, seed, steps, versions
    symmetric: bool = False  # the network is shown the mirror image where the right foot leads (`symmetry`)
    sway: float = 0.0  # of the trunks that it learned to carry, as a share of statics.pendulum, for whoever plans for it

    def output(self, flat_observation: Array) -> Array:
        """The mean of the action distribution (..., 12) for observations (..., 101)."""
        if not self.symmetric:
            return apply(self.network, self.activation, flat_observation)
        shown, right = symmetry.canonical(flat_observation)
        return symmetry.restored(apply(self.network, self.activation, shown), right)

    def feedback(self, flat_observation: Array) -> Array:
        """a_fb (..., 12) in [-1, 1] for observations (..., 101), without exploration noise."""
        return control.feedback(self.settings, self.output(flat_observation))


def save(policy: Policy, path: str | pathlib.Path) -> None:
    """Writes a policy file, atomically. Raises checkpoint.RunError when it cannot be written."""
    arrays = {"normalizer/mean": policy.network.mean, "normalizer/std": policy.network.std}
    for i, (weight, bias) in enumerate(zip(policy.network.weights, policy.network.biases, strict=True)):
        arrays |= {f"actor/{i}/weight": weight, f"actor/{i}/bias": bias}
    robot_fields = vars(policy.robot)
    arrays |= {f"robot/{k}": v for k, v in robot_fields.items() if isinstance(v, np.ndarray)}
    meta = {
        "observation": {"layout": observation.WIDTHS._asdict(), "hash": observation.layout_hash()},
        "activation": policy.activation,
        "control": config.to_dict(policy.settings),
        "policy_period": policy.policy_period,
        "symmetric": policy.symmetric,
        "sway": policy.sway,
        "robot": {k: v for k, v in robot_fields.items() if not isinstance(v, np.ndarray)},
        "provenance": policy.provenance,
    }
    checkpoint.save_arrays(path, arrays, meta, KIND)


def load(path: str | pathlib.Path, robot: Robot | None = None) -> Policy:
    """A policy from its file, every byte and every name checked.

    Args:
      path: the file, or a run directory, which stands for its policy.npz.
      robot: the robot it is going to drive; a policy of another one is refused.

    Raises:
      checkpoint.CheckpointError: the file is missing, cut off, changed or no policy.
      PolicyError: the file is intact but of another observation layout, robot or shape.
    """
    path = pathlib.Path(path)
    path = path / "policy.npz" if path.is_dir() else path
    arrays, meta = checkpoint.load_arrays(path, KIND)
    try:
        policy = _assembled(arrays, meta)
        _check(policy)
        if robot is not None:
            _check_robot(policy.robot, robot)
    except PolicyError as error:
        raise PolicyError(f"{path}: {error}") from None
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise PolicyError(f"{path}: is no complete policy ({type(error).__name__}: {error})") from None
    return policy


def load_for_simulation(path: str | pathlib.Path) -> Policy:
    """As `load`; the robot of that name in models/ must be the one that the policy was trained on. Needs MuJoCo."""
    policy = load(path)
    try:
        _check_robot(policy.robot, robots.load(policy.robot.name))
    except (PolicyError, robots.RobotError) as error:
        raise PolicyError(f"{path}: {error}") from None
    return policy


def _assembled(arrays: dict[str, np.ndarray], meta: dict[str, Any]) -> Policy:
    """The policy of a file's arrays and meta. Raises PolicyError, or whatever meets a part that is not as it should be."""
    if meta["observation"]["hash"] != observation.layout_hash():
        raise PolicyError("was trained on another observation layout; train or export it with this version")
    robot_meta = dict(meta["robot"]) | {k[6:]: v for k, v in arrays.items() if k.startswith("robot/")}
    robot_meta["joint_names"] = tuple(robot_meta["joint_names"])
    layers = len({name.split("/")[1] for name in arrays if name.startswith("actor/")})
    known = {"normalizer/mean", "normalizer/std", *(f"robot/{name}" for name in ROBOT_SHAPES)}
    known |= {f"actor/{i}/{part}" for i in range(layers) for part in ("weight", "bias")}
    for missing in sorted(known - set(arrays)):
        raise PolicyError(f"lacks the array {missing}")
    for stray in sorted(set(arrays) - known):
        raise PolicyError(f"holds an array {stray}, which no policy has")
    return Policy(
        network=Network(
            mean=arrays["normalizer/mean"],
            std=arrays["normalizer/std"],
            weights=tuple(arrays[f"actor/{i}/weight"] for i in range(layers)),
            biases=tuple(arrays[f"actor/{i}/bias"] for i in range(layers)),
        ),
        activation=meta["activation"],
        settings=config.from_dict(ControlConfig, meta["control"], "control"),
        policy_period=float(meta["policy_period"]),
        robot=Robot(**robot_meta),
        provenance=meta["provenance"],
        symmetric=meta.get("symmetric", False),  # files from before there was a choice
        sway=meta.get("sway", 0.0),
    )


ROBOT_SHAPES = {
    "hips": (2, 3),
    "sole": (2,),
    "leg_length": (2,),
    "masses": (4,),
    "centres": (3,),
    **dict.fromkeys(("joint_low", "joint_high", "feedback_ratio", "kp", "kd", "torque_limit"), (12,)),
}
"""The arrays of a Robot and their shapes."""


def _check(policy: Policy) -> None:
    """Raises PolicyError where shapes, types or values do not fit together."""
    network, robot = policy.network, policy.robot
    layers = zip(network.weights, network.biases, strict=True)
    sizes = [observation.SIZE, *(w.shape[1] if w.ndim == 2 else b.size for w, b in layers)]
    wanted: dict[str, tuple[np.ndarray, tuple[int, ...]]] = {
        "normalizer/mean": (network.mean, (observation.SIZE,)),
        "normalizer/std": (network.std, (observation.SIZE,)),
        **{f"actor/{i}/weight": (w, (sizes[i], sizes[i + 1])) for i, w in enumerate(network.weights)},
        **{f"actor/{i}/bias": (b, (sizes[i + 1],)) for i, b in enumerate(network.biases)},
        **{f"robot/{name}": (getattr(robot, name), shape) for name, shape in ROBOT_SHAPES.items()},
    }
    for name, (array, shape) in wanted.items():
        if array.shape != shape:
            raise PolicyError(f"array {name} has shape {list(array.shape)}; wanted {list(shape)}")
        kinds = (np.float32, np.float64) if name.startswith("robot/") else (np.float32,)
        if array.dtype not in kinds or not np.isfinite(array).all():
            raise PolicyError(f"array {name} is {array.dtype} or not finite; wanted finite {kinds[-1].__name__} numbers")
    if not isinstance(robot.name, str) or not all(isinstance(name, str) for name in robot.joint_names):
        raise PolicyError("the names of the robot and its joints must be text")
    if not isinstance(policy.provenance, dict):
        raise PolicyError(f"provenance must be a table, not {policy.provenance!r}")
    if len(robot.joint_names) != 12 or not network.weights or sizes[-1] != 12:
        raise PolicyError(f"the network gives {sizes[-1]} numbers; wanted one for each of {len(robot.joint_names)} joints")
    if policy.activation not in ACTIVATIONS:
        raise PolicyError(f"activation {policy.activation!r} is unknown; wanted one of {', '.join(ACTIVATIONS)}")
    if not isinstance(policy.symmetric, bool):
        raise PolicyError(f"symmetric must be true or false, not {policy.symmetric!r}")
    if not (isinstance(policy.sway, float) and 0 <= policy.sway <= 1):
        raise PolicyError(f"sway must lie in [0, 1], not {policy.sway!r}")
    if policy.symmetric and not symmetry.is_symmetric(robot):
        raise PolicyError("the policy is symmetric, but its robot is not its own mirror image")
    if not (network.std > 0).all():
        raise PolicyError("the normaliser's standard deviations must be positive")
    for name in ("thigh", "shank", "ankle_height", "timestep"):
        value = getattr(robot, name)
        if not (isinstance(value, float) and 0 < value < math.inf):
            raise PolicyError(f"the robot's {name} must be a positive number, not {value!r}")
    for name in ("kp", "kd", "torque_limit", "masses", "leg_length"):
        if not (getattr(robot, name) > 0).all():
            raise PolicyError(f"the robot's {name} must be positive")
    if not robot.leg_length[0] < robot.leg_length[1]:
        raise PolicyError("the robot's leg_length must be the least and the greatest")
    if not (robot.joint_low < robot.joint_high).all():
        raise PolicyError("the robot's joint_low must lie below joint_high")
    try:
        control.substeps(policy.policy_period, robot.timestep)
    except ValueError as error:
        raise PolicyError(str(error)) from None


def _check_robot(trained: Robot, wanted: Robot) -> None:
    """Raises PolicyError where the policy was trained on another robot than the wanted one."""
    for name, value in vars(wanted).items():
        if name != "name" and not np.array_equal(np.asarray(getattr(trained, name)), np.asarray(value)):
            raise PolicyError(
                f"was trained on robot {trained.name!r} with another {name} than {wanted.name!r} has; "
                "train a policy for this robot"
            )


def _as_float32(tree: Any) -> Any:
    """The same struct of structs with its arrays in float32."""
    if isinstance(tree, tuple):
        return type(tree)(*(_as_float32(part) for part in tree))
    return np.asarray(tree, np.float32)


def _is_finite(tree: Any) -> bool:
    """Whether all numbers of a struct of structs are finite."""
    return all(map(_is_finite, tree)) if isinstance(tree, tuple) else bool(np.isfinite(tree).all())


class Controller:
    """The whole controller in numpy: measured state and command in, joint targets out, every 0.005 s.

    >>> controller = Controller.load("policy.npz")
    >>> controller.reset(qpos)
    >>> targets = controller.step(qpos, qvel, command)

    Needs numpy alone. One step takes well under a millisecond with one BLAS thread (OPENBLAS_NUM_THREADS=1).
    """

    def __init__(self, policy: Policy, feedback: bool = True):
        """feedback=False leaves the feedforward alone: inverse kinematics, filter and PD."""
        self.policy = policy
        self.robot = policy.robot.cast(np.float32)
        self.uses_feedback = feedback
        self._hold = control.substeps(policy.policy_period, policy.robot.timestep)
        self._tick = 0
        self._feedback = np.zeros(len(policy.robot.joint_names), np.float32)
        self._standing: np.ndarray | None = None  # normalised joint angles at reset
        self._memory: control.ControlState | None = None  # from the first step on

    @classmethod
    def load(cls, path: str | pathlib.Path, robot: Robot | None = None) -> Controller:
        """The controller of a policy file; raises as `load` does."""
        return cls(load(path, robot))

    @property
    def last_feedback(self) -> np.ndarray:
        """a_fb (12,) of the last step, in [-1, 1]."""
        return self._feedback

    def reset(self, qpos: Array) -> None:
        """Begins anew with a robot that stands at qpos (19,): trunk position, quaternion, joint angles."""
        joints = np.asarray(qpos, np.float32)[7:]
        if joints.shape != self._feedback.shape:
            raise ValueError(f"qpos must have {7 + self._feedback.size} numbers, not {np.size(qpos)}")
        if not np.isfinite(joints).all():
            raise ValueError(f"qpos is not finite: {np.asarray(qpos)}")
        self._standing = control.normalize(self.robot, joints)
        self._memory = None
        self._feedback = np.zeros_like(self._feedback)
        self._tick = 0

    def step(self, qpos: Array, qvel: Array, command: Command) -> np.ndarray:
        """Joint targets (12,), rad, for the PD controllers.

        Args:
          qpos: (19,) trunk position m, quaternion w x y z, joint angles rad.
          qvel: (18,) trunk velocity m/s in the world, angular velocity rad/s in F_B, joint velocities rad/s.
          command: from `planner.command` or `footsteps.command_at`, in the world frame, at this instant.

        Raises:
          RuntimeError: before `reset`.
          ValueError: a state of another size, or a state or command that is not finite; the memory is then as before.
        """
        if self._standing is None:
            raise RuntimeError("call reset(qpos) before the first step")
        for name, state, size in (("qpos", qpos, 7 + self._feedback.size), ("qvel", qvel, 6 + self._feedback.size)):
            if np.shape(state) != (size,):
                raise ValueError(f"{name} must have shape ({size},), not {np.shape(state)}")
            if not np.isfinite(state).all():
                raise ValueError(f"{name} is not finite: {np.asarray(state)}")
        command = _as_float32(command)
        if not _is_finite(command):
            raise ValueError(f"the command is not finite: {command}")
        a_ff = control.feedforward(self.robot, self.policy.settings, command.target)
        if self._memory is None:
            self._memory = control.initial(self._standing, a_ff)
        if self.uses_feedback and self._tick % self._hold == 0:
            self._feedback = self.policy.feedback(self._observe(qpos, qvel, command, a_ff))
        state = np.asarray(qpos, np.float32), np.asarray(qvel, np.float32)
        targets, self._memory = control.respond(
            self.robot, self.policy.settings, self._memory, a_ff, self._feedback, command, *state
        )
        self._tick += 1
        return targets

    def observe(self, qpos: Array, qvel: Array, command: Command) -> np.ndarray:
        """The flat observation of eq (8), (101,) float32."""
        command = _as_float32(command)
        return self._observe(qpos, qvel, command, control.feedforward(self.robot, self.policy.settings, command.target))

    def _observe(self, qpos: Array, qvel: Array, command: Command, a_ff: Array) -> np.ndarray:
        """The same, of a command and its feedforward that are in float32 already."""
        qpos, qvel = np.asarray(qpos, np.float32), np.asarray(qvel, np.float32)
        real = kinematics.measure(self.robot, qpos)
        return observation.flatten(observation.observe(command, real, qpos, qvel, a_ff, self._feedback))
