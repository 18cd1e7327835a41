"""What never changes about a robot: link lengths, joint order, limits, gains, and its MuJoCo model.

A robot is a folder `models/<name>/` with `<name>.xml` (MJCF; its position actuators are the PD controllers) and
`<name>.toml` (what an MJCF does not say). The MJCF names its joints `<leg>_<joint>`, by LEGS and JOINTS, the contact
spheres of the feet `<leg>_sole_*`, and the bodies `trunk`, which is free and whose frame is F_B, and `<leg>_foot`. Thigh,
shank and foot hang straight below one another, alike in both legs, on joints with AXES and ranges; their servos have kp, kv
and forcerange. Nothing is written twice: lengths, ranges and gains come from the compiled model, so this module needs
MuJoCo, but only inside the functions that load.
"""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from bipedtrack import config, paths
from bipedtrack.messages import Refusal

LEGS = ("left", "right")
JOINTS = ("hip_yaw", "hip_roll", "hip_pitch", "knee", "ankle_pitch", "ankle_roll")  # of a leg, from hip to foot
AXES = {"hip_yaw": (0, 0, 1), "hip_roll": (1, 0, 0), "hip_pitch": (0, 1, 0)}  # of the joints, in F_B of a standing robot
AXES |= {"knee": (0, 1, 0), "ankle_pitch": (0, 1, 0), "ankle_roll": (1, 0, 0)}


@dataclasses.dataclass(frozen=True)
class Robot:
    """Constants of one robot; joints are in the order of the actuators, left leg first, from hip to foot."""

    name: str
    joint_names: tuple[str, ...]
    hips: np.ndarray  # (2, 3) left and right hip in the trunk frame F_B, m
    thigh: float  # hip to knee, m
    shank: float  # knee to ankle, m
    ankle_height: float  # ankle above the sole, m
    sole: np.ndarray  # (2,) length and width of the sole, m
    leg_length: np.ndarray  # (2,) least and greatest distance from hip to ankle that commands may use, m
    joint_low: np.ndarray  # (12,) rad
    joint_high: np.ndarray  # (12,) rad
    feedback_ratio: np.ndarray  # (12,) k_b of eq (6), in half joint ranges
    kp: np.ndarray  # (12,) N m / rad
    kd: np.ndarray  # (12,) N m s / rad
    torque_limit: np.ndarray  # (12,) N m
    masses: np.ndarray  # (4,) trunk, thigh, shank, foot, kg; both legs weigh the same
    centres: np.ndarray  # (3,) centres of mass of thigh, shank and foot, m below hip, knee and ankle
    timestep: float  # control period, s

    @property
    def joint_middle(self) -> np.ndarray:
        """(12,) rad: the joint angle that eq (5) maps to 0."""
        return (self.joint_low + self.joint_high) / 2

    @property
    def joint_half_range(self) -> np.ndarray:
        """(12,) rad: what eq (5) maps to 1 above the middle."""
        return (self.joint_high - self.joint_low) / 2

    def cast(self, dtype: Any) -> Robot:
        """The same robot with its arrays in another floating-point type."""
        arrays: dict[str, Any] = {k: v.astype(dtype) for k, v in vars(self).items() if isinstance(v, np.ndarray)}
        return dataclasses.replace(self, **arrays)


@dataclasses.dataclass(frozen=True)
class Description:
    """The robot's TOML file: what the MJCF does not say."""

    feedback_ratio: float
    leg_length: tuple[float, float]

    def __post_init__(self) -> None:
        if not 0 < self.leg_length[0] < self.leg_length[1]:
            raise ValueError(f"leg_length must be two growing positive lengths, not {list(self.leg_length)}")
        if not 0 <= self.feedback_ratio <= 2:
            raise ValueError(f"feedback_ratio must lie in [0, 2], not {self.feedback_ratio}")


class RobotError(Refusal, ValueError):
    """A robot that cannot be had, in one line that says which are there or what its model lacks."""


def mjcf_path(name: str) -> pathlib.Path:
    """The path of a robot's MJCF. Raises RobotError when there is no such robot."""
    folder = paths.data_dir("models")
    known = {path.stem: path for path in sorted(folder.glob("*/*.xml")) if path.stem == path.parent.name}
    if name not in known:
        raise RobotError(f"no robot named {name!r} in models/; there are: {', '.join(known)}")
    return known[name]


def load(name: str = "ranger_max") -> Robot:
    """The constants of a robot, in float64. Raises RobotError or config.ConfigError in one line."""
    import mujoco

    path = mjcf_path(name)
    description = config.load(Description, path.with_suffix(".toml"))
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise RobotError(f"{path}: is no MJCF that MuJoCo compiles: {' '.join(str(error).split())}") from None
    return from_model(name, model, description)


def from_model(name: str, model: Any, description: Description) -> Robot:
    """The constants read from a compiled MuJoCo model. Raises RobotError where it is no robot of two such legs."""
    joint_names = tuple(f"{leg}_{joint}" for leg in LEGS for joint in JOINTS)
    actuated = tuple(model.joint(int(i)).name for i in model.actuator_trnid[:, 0])
    ordered = tuple(model.joint(i).name for i in range(1, model.njnt))
    if actuated != joint_names or ordered != joint_names:
        raise RobotError(f"{name}: joints and actuators must be {', '.join(joint_names)}, in this order")
    bodies = {model.body(i).name for i in range(model.nbody)}
    for body in ("trunk", *(f"{leg}_foot" for leg in LEGS)):
        if body not in bodies:
            raise RobotError(f"{name}: no body is named {body}")
    joints = [model.joint(n) for n in joint_names]
    low, high = np.array([j.range for j in joints]).T

    def links(leg: str) -> list[Any]:
        """Thigh, shank and foot, the bodies that carry those joints."""
        return [model.body(int(model.joint(f"{leg}_{joint}").bodyid[0])) for joint in ("hip_yaw", "knee", "ankle_pitch")]

    left, right = map(links, LEGS)
    _check_joints(name, model, joints)
    _check_legs(name, model, left, right)
    thigh, shank = float(-left[1].pos[2]), float(-left[2].pos[2])
    if description.leg_length[1] > thigh + shank:
        raise RobotError(f"{name}: leg_length {list(description.leg_length)}: a leg is {thigh + shank:g} m long at most")
    soles = [g for g in map(model.geom, range(model.ngeom)) if g.name.startswith(f"{LEGS[0]}_sole")]
    if not soles:
        raise RobotError(f"{name}: no geom is named {LEGS[0]}_sole_*, which touch the ground")
    corners = np.array([g.pos for g in soles])
    return Robot(
        name=name,
        joint_names=joint_names,
        hips=np.array([left[0].pos, right[0].pos]),
        thigh=thigh,
        shank=shank,
        ankle_height=float(soles[0].size[0] - corners[0, 2]),
        sole=2 * np.abs(corners[:, :2]).max(axis=0),
        leg_length=np.array(description.leg_length),
        joint_low=low,
        joint_high=high,
        feedback_ratio=np.full(len(joint_names), description.feedback_ratio),
        kp=model.actuator_gainprm[:, 0].copy(),
        kd=-model.actuator_biasprm[:, 2],
        torque_limit=model.actuator_forcerange[:, 1].copy(),
        masses=np.array([model.body("trunk").mass[0], *(link.mass[0] for link in left)]),
        centres=np.array([-link.ipos[2] for link in left]),
        timestep=float(model.opt.timestep),
    )


def _check_joints(name: str, model: Any, joints: list[Any]) -> None:
    """Raises RobotError where a joint is none of a leg's, or its servo is none of a PD controller with limits."""
    for i, joint in enumerate(joints):
        axis = AXES[joint.name.split("_", 1)[1]]
        if not (np.allclose(joint.axis, axis) and np.allclose(joint.pos, 0) and joint.qpos0[0] == 0):
            raise RobotError(f"{name}: {joint.name} must turn about {list(axis)} at its body's origin, from 0 on (no ref)")
        if not (model.jnt_limited[joint.id] and joint.range[0] < joint.range[1]):
            raise RobotError(f"{name}: {joint.name} has no range")
        kp, kd, limit = model.actuator_gainprm[i, 0], -model.actuator_biasprm[i, 2], model.actuator_forcerange[i, 1]
        servo = model.actuator_biasprm[i, 1] == -kp and model.actuator_gear[i, 0] == 1 and model.actuator_forcelimited[i]
        if not (servo and kp > 0 and kd > 0 and limit > 0):
            raise RobotError(
                f"{name}: the actuator of {joint.name} must be a position servo with kp, kv and forcerange, gear 1"
            )


def _check_legs(name: str, model: Any, left: list[Any], right: list[Any]) -> None:
    """Raises RobotError where a leg is not thigh, shank and foot straight below one another, or the legs are not alike."""
    trunk = model.body("trunk").id
    for leg, links in zip(LEGS, (left, right), strict=True):
        carriers = [links[0]] * 3 + [links[1]] + [links[2]] * 2
        for joint, link in zip(JOINTS, carriers, strict=True):
            if model.joint(f"{leg}_{joint}").bodyid[0] != link.id:
                raise RobotError(f"{name}: {leg}_{joint} must be a joint of body {link.name}")
        for link, parent, what in zip(links, (trunk, links[0].id, links[1].id), ("thigh", "shank", "foot"), strict=True):
            if link.parentid[0] != parent or not np.allclose(link.quat, [1, 0, 0, 0]):
                raise RobotError(f"{name}: the {leg} {what} must hang, without a turn, on the link above it")
            if what != "thigh" and not (np.allclose(link.pos[:2], 0) and link.pos[2] < 0):
                at = link.pos.tolist()
                raise RobotError(f"{name}: the {leg} {what} must be straight below the joint above it, not at {at}")
    for one, other, what in zip(left, right, ("thighs", "shanks", "feet"), strict=True):
        alike = (one.pos[[0, 2]], one.mass, one.ipos[[0, 2]]), (other.pos[[0, 2]], other.mass, other.ipos[[0, 2]])
        if not all(map(np.allclose, *alike)):
            raise RobotError(f"{name}: both {what} must hang and weigh the same")


def build_model(name: str, boxes: Sequence[Sequence[float]] = (), converged: bool = False, touch: bool = False) -> Any:
    """The compiled MuJoCo model of a robot with movable boxes for stairs and obstacles.

    Args:
      name: the robot.
      boxes: (length, width, height) of each box, m; box i is the mocap body i, parked far below the ground.
      converged: solve every contact problem to convergence instead of the few iterations of the MJCF.
      touch: add a sensor for the normal force, N, on each foot, left first.
    """
    import mujoco

    spec = mujoco.MjSpec.from_file(str(mjcf_path(name)))
    for i, size in enumerate(boxes):
        body = spec.worldbody.add_body(name=f"box_{i}", mocap=True, pos=[0, 0, -10.0 - i])
        body.add_geom(
            name=f"box_{i}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[0.5 * s for s in size],
            conaffinity=1,
            contype=0,
            friction=[1, 0.005, 0.0001],
            rgba=[0.62, 0.60, 0.56, 1],
        )
    if boxes:
        # MJX would solve for every sphere against every box; of 16 contacts, the deepest, two are left for each sphere
        spec.add_numeric(name="max_contact_points", data=[16], size=1)
    if touch:
        for leg in LEGS:
            zone = f"{leg}_foot_zone"
            spec.body(f"{leg}_foot").add_site(name=zone, type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.2, 0, 0], group=5)
            spec.add_sensor(
                name=f"{leg}_touch",
                type=mujoco.mjtSensor.mjSENS_TOUCH,
                objtype=mujoco.mjtObj.mjOBJ_SITE,
                objname=zone,
            )
    if converged:
        spec.option.iterations, spec.option.ls_iterations = 100, 50
    return spec.compile()
