"""The robot of Table I, on the compiled model: masses, lengths, inertias, joints, gains, contacts, solver."""

import math
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest

from bipedtrack import config
from bipedtrack import robot as robots
from bipedtrack.robot import LEGS, Description, Robot, RobotError

# per leg, hip to foot: axis, range in deg, kp, kd, torque limit
JOINTS = {
    "hip_yaw": ((0, 0, 1), (-45, 45), 500, 25, 150),
    "hip_roll": ((1, 0, 0), (-30, 30), 1000, 50, 300),
    "hip_pitch": ((0, 1, 0), (-100, 40), 1000, 50, 300),
    "knee": ((0, 1, 0), (0, 140), 1000, 50, 300),
    "ankle_pitch": ((0, 1, 0), (-75, 45), 300, 15, 120),
    "ankle_roll": ((1, 0, 0), (-30, 30), 200, 10, 80),
}
JOINT_NAMES = tuple(f"{leg}_{joint}" for leg in LEGS for joint in JOINTS)


def box_inertia(mass: float, x: float, y: float, z: float) -> list[float]:
    """Moments about x, y, z of a solid box with these sides."""
    return [mass / 12 * (b * b + c * c) for b, c in ((y, z), (x, z), (x, y))]


def capsule_inertia(mass: float, radius: float, length: float) -> list[float]:
    """Moments about x, y, z of a solid capsule along z, `length` being that of its cylinder."""
    cylinder, ball = math.pi * radius**2 * length, 4 / 3 * math.pi * radius**3
    m_c, m_b = mass * cylinder / (cylinder + ball), mass * ball / (cylinder + ball)
    along = m_c * radius**2 / 2 + m_b * 2 / 5 * radius**2
    across = m_c * (length**2 / 12 + radius**2 / 4)
    # half a ball: about its own centre of mass 3/8 r from the flat side, then moved out
    half = 2 / 5 * radius**2 - (3 / 8 * radius) ** 2
    across += m_b * (half + (length / 2 + 3 / 8 * radius) ** 2)
    return [across, across, along]


def standing(model: mujoco.MjModel, height: float = 0.0) -> mujoco.MjData:
    """The keyframe's stand with its soles at `height`, m."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("stand").id)
    data.qpos[2] += height
    return data


def touching(model: mujoco.MjModel, data: mujoco.MjData) -> list[tuple[str, str]]:
    return [(model.geom(int(c.geom[0])).name, model.geom(int(c.geom[1])).name) for c in data.contact[: data.ncon]]


def test_masses_are_those_of_table_one(mj_model: mujoco.MjModel) -> None:
    masses = {mj_model.body(i).name: float(mj_model.body(i).mass[0]) for i in range(1, mj_model.nbody)}
    per_leg = {"thigh": 6.4, "shank": 2.0, "foot": 1.0}
    legs = {f"{leg}_{part}": mass for leg in LEGS for part, mass in per_leg.items()}
    assert masses == pytest.approx({"trunk": 20.0} | legs)
    assert sum(masses.values()) == pytest.approx(38.8)


@pytest.mark.parametrize(
    ("body", "moments", "centre"),
    [
        ("trunk", box_inertia(20, 0.3, 0.3, 0.15), (0, 0, 0)),
        ("left_thigh", capsule_inertia(6.4, 0.055, 0.4), (0, 0, -0.2)),
        ("right_shank", capsule_inertia(2, 0.042, 0.35), (0, 0, -0.175)),
        ("left_foot", box_inertia(1, 0.16, 0.10, 0.024), (0, 0, -0.028)),
    ],
)
def test_inertias_are_those_of_the_solid_shapes(
    mj_model: mujoco.MjModel, body: str, moments: list[float], centre: tuple
) -> None:
    compiled = mj_model.body(body)
    # back from the principal axes to those of the body; a visual geom with mass would show here
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, compiled.iquat)
    axes = axes.reshape(3, 3)
    assert axes @ np.diag(compiled.inertia) @ axes.T == pytest.approx(np.diag(moments), rel=1e-6, abs=1e-9)
    assert compiled.ipos == pytest.approx(np.array(centre), abs=1e-9)


def test_trunk_is_a_box_of_30_by_30_by_15_cm(mj_model: mujoco.MjModel) -> None:
    trunk = mj_model.geom("trunk")
    assert trunk.type == mujoco.mjtGeom.mjGEOM_BOX
    assert 2 * trunk.size == pytest.approx([0.3, 0.3, 0.15])


def test_legs_hang_straight_down_with_the_lengths_of_table_one(mj_model: mujoco.MjModel) -> None:
    data = mujoco.MjData(mj_model)
    data.qpos[:] = 0
    data.qpos[3] = 1
    mujoco.mj_kinematics(mj_model, data)
    for leg, side in zip(LEGS, (1, -1), strict=True):
        hip = np.array([0, 0.1 * side, -0.075])
        joint = mj_model.joint(f"{leg}_ankle_roll").id
        assert data.body(f"{leg}_thigh").xpos == pytest.approx(hip)
        assert data.body(f"{leg}_shank").xpos == pytest.approx(hip - [0, 0, 0.4])
        assert data.body(f"{leg}_foot").xpos == pytest.approx(hip - [0, 0, 0.75])
        assert data.xanchor[joint] == pytest.approx(hip - [0, 0, 0.75])  # both ankle axes meet in the foot's origin


def test_soles_touch_the_floor_in_four_corners_4_cm_below_the_ankle(mj_model: mujoco.MjModel) -> None:
    data = standing(mj_model, height=-1e-5)
    mujoco.mj_forward(mj_model, data)
    assert data.ncon == 8
    for leg in LEGS:
        foot = data.body(f"{leg}_foot")
        points = [
            foot.xmat.reshape(3, 3).T @ (c.pos - foot.xpos)
            for c, names in zip(data.contact, touching(mj_model, data), strict=True)
            if any(name.startswith(f"{leg}_sole") for name in names)
        ]
        corners = [(x, y, -0.04) for x in (-0.08, 0.08) for y in (-0.05, 0.05)]
        assert sorted(map(tuple, np.round(points, 3) + 0.0)) == corners


def test_joints_are_those_that_the_inverse_kinematics_solves(mj_model: mujoco.MjModel) -> None:
    assert tuple(mj_model.joint(i).name for i in range(1, mj_model.njnt)) == JOINT_NAMES
    assert tuple(mj_model.joint(int(i)).name for i in mj_model.actuator_trnid[:, 0]) == JOINT_NAMES
    assert mj_model.joint(0).type == mujoco.mjtJoint.mjJNT_FREE
    for name in JOINT_NAMES:
        axis, degrees, *_ = JOINTS[name.split("_", 1)[1]]
        joint = mj_model.joint(name)
        assert tuple(joint.axis) == axis
        assert joint.range == pytest.approx(np.radians(degrees))
        assert mj_model.jnt_limited[joint.id]
        assert mj_model.dof_armature[joint.dofadr[0]] == 0.05
        assert mj_model.dof_damping[joint.dofadr[0]] == 0  # damping is the PD's alone


def test_actuators_are_the_pd_controllers_with_torque_limits(mj_model: mujoco.MjModel) -> None:
    random = np.random.default_rng(0)
    data = mujoco.MjData(mj_model)
    _, _, kp, kd, limit = (
        np.array(column, np.float64) if i > 1 else None
        for i, column in enumerate(zip(*list(JOINTS.values()) * 2, strict=True))
    )
    for size in (0.02, 0.1, 3.0):
        data.qpos[7:] = random.uniform(mj_model.jnt_range[1:, 0], mj_model.jnt_range[1:, 1])
        data.qvel[6:] = size * random.normal(size=12)
        targets = data.qpos[7:] + size * random.normal(size=12)
        data.ctrl[:] = np.clip(targets, mj_model.jnt_range[1:, 0], mj_model.jnt_range[1:, 1])
        mujoco.mj_forward(mj_model, data)
        torque = kp * (data.ctrl - data.qpos[7:]) - kd * data.qvel[6:]
        assert data.qfrc_actuator[6:] == pytest.approx(np.clip(torque, -limit, limit))
    assert (np.abs(torque) > limit).any()  # the last torques have met their limits


def test_targets_outside_a_joints_range_are_clamped_to_it(mj_model: mujoco.MjModel) -> None:
    assert mj_model.actuator_ctrlrange == pytest.approx(mj_model.jnt_range[1:])
    assert mj_model.actuator_ctrllimited.all()


def test_control_period_is_5_ms(mj_model: mujoco.MjModel) -> None:
    assert mj_model.opt.timestep == 0.005


def test_only_soles_leg_shapes_and_the_floor_can_touch_anything(mj_model: mujoco.MjModel) -> None:
    geoms = [mj_model.geom(i) for i in range(mj_model.ngeom)]
    soles = {f"{leg}_sole_{i}" for leg in LEGS for i in range(4)}
    assert {g.name for g in geoms if g.contype[0]} == soles
    assert {g.name for g in geoms if g.conaffinity[0]} == {"floor"}
    pairs = {
        tuple(sorted(mj_model.geom(int(i)).name for i in pair))
        for pair in zip(mj_model.pair_geom1, mj_model.pair_geom2, strict=True)
    }
    assert pairs == {(f"left_{a}_shape", f"right_{b}_shape") for a in ("shank", "foot") for b in ("shank", "foot")}


# in the air, with the legs rolled inwards by 10 deg each they cross
INWARDS = {"left_hip_roll": -10, "right_hip_roll": 10}


@pytest.mark.parametrize(
    ("degrees", "expected"),
    [
        ({}, set()),
        (INWARDS, {("shank", "shank"), ("foot", "foot"), ("shank", "foot"), ("foot", "shank")}),
        (INWARDS | {"left_hip_pitch": 20, "right_hip_pitch": -20}, set()),  # one leg passes before the other
        (INWARDS | {"left_hip_pitch": -25, "left_knee": 60}, {("foot", "shank")}),
        (INWARDS | {"right_hip_pitch": -25, "right_knee": 60}, {("shank", "foot")}),
    ],
)
def test_legs_that_cross_touch_each_other(mj_model: mujoco.MjModel, degrees: dict, expected: set) -> None:
    data = mujoco.MjData(mj_model)
    data.qpos[2] = 2
    for name, angle in degrees.items():
        data.joint(name).qpos[0] = math.radians(angle)
    mujoco.mj_forward(mj_model, data)
    found = {tuple(name.split("_")[1] for name in names) for names in touching(mj_model, data)}
    assert found >= expected
    assert bool(found) == bool(expected)


def test_legs_cannot_be_driven_through_one_another(mj_model: mujoco.MjModel) -> None:
    data = mujoco.MjData(mj_model)
    data.qpos[2] = 5
    data.ctrl[[1, 7]] = math.radians(-25), math.radians(25)
    nearest = math.inf
    for _ in range(100):
        mujoco.mj_step(mj_model, data)
        nearest = min(nearest, data.body("left_foot").xpos[1] - data.body("right_foot").xpos[1])
    # the feet's shapes are 0.1 m wide and give way a little; without contact the left foot ends on the right
    assert 0.03 < nearest < 0.1


@pytest.mark.parametrize("box", [None, 0.3])
def test_feet_stand_on_the_floor_and_on_boxes(box: float | None) -> None:
    model = robots.build_model("ranger_max", [] if box is None else [(1.0, 0.8, 0.2), (0.5, 0.5, 0.5)])
    data = standing(model, box or 0.0)
    if box is not None:
        data.mocap_pos[0] = 0, 0, box - 0.1  # its upper side at the height of the soles
    ground = "floor" if box is None else "box_0"
    for _ in range(20):  # 0.1 s: with nothing to stand on the robot would have fallen 5 cm
        mujoco.mj_step(model, data)
        assert {name for names in touching(model, data) for name in names if "sole" not in name} <= {ground}
    assert len(touching(model, data)) == 8
    feet = [data.body(f"{leg}_foot").xpos[2] for leg in LEGS]
    assert feet == pytest.approx([0.04 + (box or 0.0)] * 2, abs=2e-3)


def test_boxes_wait_below_the_ground_and_have_the_given_sides() -> None:
    sides = [(1.0, 0.8, 0.2), (0.5, 0.4, 0.3)]
    model = robots.build_model("ranger_max", sides)
    assert model.nmocap == 2
    for i, side in enumerate(sides):
        assert 2 * model.geom(f"box_{i}").size == pytest.approx(side)
        assert model.body(f"box_{i}").mocapid[0] == i
        assert model.body(f"box_{i}").pos[2] < -5


def test_four_solver_iterations_converge_and_one_does_not(mj_model: mujoco.MjModel) -> None:
    assert mj_model.opt.iterations == 4
    one = robots.build_model("ranger_max")
    one.opt.iterations = 1
    converged = robots.build_model("ranger_max", converged=True)
    assert converged.opt.iterations >= 50

    def after_300_ms(model: mujoco.MjModel, seed: int) -> np.ndarray:
        random = np.random.default_rng(seed)
        data = standing(model)
        data.qpos[7:] += 0.02 * random.normal(size=12)
        data.qvel[:] = 0.1 * random.normal(size=18)
        for _ in range(60):
            mujoco.mj_step(model, data)
        return data.qpos

    off = np.array(
        [
            [np.abs(after_300_ms(model, seed) - after_300_ms(converged, seed)).max() for seed in range(8)]
            for model in (mj_model, one)
        ]
    )
    assert off[0].max() < 1e-3
    assert off[1].min() > 1e-2


def test_constants_of_the_robot(robot: Robot) -> None:
    assert robot.name == "ranger_max"
    assert robot.joint_names == JOINT_NAMES
    assert robot.hips == pytest.approx(np.array([[0, 0.1, -0.075], [0, -0.1, -0.075]]))
    assert (robot.thigh, robot.shank, robot.ankle_height) == pytest.approx((0.4, 0.35, 0.04))
    assert robot.sole == pytest.approx([0.16, 0.10])
    assert robot.leg_length == pytest.approx([0.35, 0.74])
    low, high = np.radians([row[1] for row in JOINTS.values()] * 2).T
    assert robot.joint_low == pytest.approx(low)
    assert robot.joint_high == pytest.approx(high)
    assert robot.joint_middle == pytest.approx((low + high) / 2)
    assert robot.joint_half_range == pytest.approx((high - low) / 2)
    for found, column in ((robot.kp, 2), (robot.kd, 3), (robot.torque_limit, 4)):
        assert found == pytest.approx([row[column] for row in JOINTS.values()] * 2)
    assert robot.feedback_ratio == pytest.approx([0.3] * 12)
    assert robot.masses == pytest.approx([20, 6.4, 2, 1])
    assert robot.centres == pytest.approx([0.2, 0.175, 0.028])
    assert robot.timestep == 0.005


def test_cast_changes_the_precision_and_nothing_else(robot: Robot) -> None:
    single = robot.cast(np.float32)
    for name, value in vars(robot).items():
        found = getattr(single, name)
        if isinstance(value, np.ndarray):
            assert found.dtype == np.float32
            assert found == pytest.approx(value, rel=1e-7)
        else:
            assert found == value
    assert robot.hips.dtype == np.float64


def test_an_unknown_robot_is_named_with_those_there_are() -> None:
    with pytest.raises(RobotError, match=r"no robot named 'ranger_mini' in models/; there are: .*ranger_max"):
        robots.load("ranger_mini")


def first_two_actuators_change_places(spec: mujoco.MjSpec) -> None:
    spec.actuators[0].target, spec.actuators[1].target = "left_hip_roll", "left_hip_yaw"


def the_legs_change_places(spec: mujoco.MjSpec) -> None:
    for joint in spec.joints:
        for leg, other in (("left", "right"), ("right", "left")):
            if joint.name.startswith(leg):
                joint.name = "new_" + joint.name.replace(leg, other)
                break
    for joint in spec.joints:
        joint.name = joint.name.removeprefix("new_")


def a_joint_has_another_name(spec: mujoco.MjSpec) -> None:
    spec.joint("left_knee").name = spec.actuator("left_knee").target = "left_tibia"


def a_foot_has_another_name(spec: mujoco.MjSpec) -> None:
    spec.body("right_foot").name = "right_shoe"


def a_shank_is_short(spec: mujoco.MjSpec) -> None:
    for leg in LEGS:
        spec.body(f"{leg}_foot").pos = [0, 0, -0.3]


def a_knee_bends_backwards(spec: mujoco.MjSpec) -> None:
    spec.joint("left_knee").axis = [0, -1, 0]


def a_knee_has_no_range(spec: mujoco.MjSpec) -> None:
    spec.joint("right_knee").limited = mujoco.mjtLimited.mjLIMITED_FALSE
    spec.joint("right_knee").range = [0, 0]
    spec.actuator("right_knee").ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE
    spec.actuator("right_knee").inheritrange = 0


def a_knee_is_driven_by_a_motor(spec: mujoco.MjSpec) -> None:
    spec.actuator("left_knee").set_to_motor()


def a_knee_has_any_torque(spec: mujoco.MjSpec) -> None:
    spec.actuator("left_knee").forcelimited = mujoco.mjtLimited.mjLIMITED_FALSE
    spec.actuator("left_knee").forcerange = [0, 0]


def a_shank_stands_forward(spec: mujoco.MjSpec) -> None:
    spec.joint("left_knee").parent.pos = [0.03, 0, -0.4]


def a_knee_is_geared(spec: mujoco.MjSpec) -> None:
    spec.actuator("left_knee").gear[0] = 2


def a_knee_is_zero_where_it_is_bent(spec: mujoco.MjSpec) -> None:
    spec.joint("left_knee").ref = math.radians(20)


def an_ankle_rolls_below_its_pitch(spec: mujoco.MjSpec) -> None:
    foot = spec.body("left_foot")
    spec.delete(spec.joint("left_ankle_roll"))
    sole = foot.add_body(name="left_sole", pos=[0.02, 0, -0.03], mass=0.1, inertia=[1e-4, 1e-4, 1e-4])
    sole.add_joint(name="left_ankle_roll", axis=[1, 0, 0], range=[-0.5, 0.5])


def a_thigh_is_heavy(spec: mujoco.MjSpec) -> None:
    for geom in spec.joint("right_hip_pitch").parent.geoms:
        geom.mass *= 1.5


def the_soles_are_missing(spec: mujoco.MjSpec) -> None:
    for geom in spec.geoms:
        geom.name = geom.name.replace("sole", "base")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (first_two_actuators_change_places, "joints and actuators must be left_hip_yaw, left_hip_roll,.* in this order"),
        (the_legs_change_places, "joints and actuators must be left_hip_yaw, .* in this order"),
        (a_joint_has_another_name, "joints and actuators must be .*left_knee"),
        (a_foot_has_another_name, "no body is named right_foot"),
        (a_shank_is_short, r"leg_length \[0.35, 0.74\]: a leg is 0.7 m long at most"),
        (the_soles_are_missing, "no geom is named left_sole"),
        (a_knee_bends_backwards, r"left_knee must turn about \[0, 1, 0\] at its body's origin"),
        (a_knee_is_zero_where_it_is_bent, "left_knee must turn about .* from 0 on"),
        (a_knee_is_geared, "the actuator of left_knee must be a position servo .* gear 1"),
        (an_ankle_rolls_below_its_pitch, "left_ankle_roll must be a joint of body left_foot"),
        (a_knee_has_no_range, "right_knee has no range"),
        (a_knee_is_driven_by_a_motor, "the actuator of left_knee must be a position servo"),
        (a_knee_has_any_torque, "the actuator of left_knee must be a position servo"),
        (a_shank_stands_forward, r"the left shank must be straight below the joint above it, not at \[0.03, 0.0, -0.4\]"),
        (a_thigh_is_heavy, "both thighs must hang and weigh the same"),
    ],
)
def test_a_model_that_does_not_fit_is_refused(change: Callable[[mujoco.MjSpec], None], message: str) -> None:
    path = robots.mjcf_path("ranger_max")
    description = config.load(Description, path.with_suffix(".toml"))
    spec = mujoco.MjSpec.from_file(str(path))
    robots.from_model("intact", spec.compile(), description)
    change(spec)
    with pytest.raises(RobotError, match=f"broken: {message}"):
        robots.from_model("broken", spec.compile(), description)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("leg_length = [0.74, 0.35]", "leg_length"),
        ("leg_length = [0.0, 0.35]", "leg_length"),
        ("feedback_ratio = -0.1", "feedback_ratio"),
    ],
)
def test_a_description_that_makes_no_sense_is_refused(line: str, message: str, tmp_path: Path) -> None:
    key = line.split(" ")[0]
    lines = robots.mjcf_path("ranger_max").with_suffix(".toml").read_text().splitlines()
    file = tmp_path / "robot.toml"
    file.write_text("\n".join([line if old.startswith(key) else old for old in lines]))
    with pytest.raises(config.ConfigError, match=message):
        config.load(Description, file)
