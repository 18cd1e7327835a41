"""Recordings in MJX and MuJoCo C against a clock, kinematics, forces and a control loop of their own, and each other."""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from traces import by_mujoco

from bipedtrack import (
    control,
    env,
    kinematics,
    metrics,
    observation,
    paths,
    planner,
    plans,
    policy,
    recording,
    rewards,
    sampling,
    terrain,
)
from bipedtrack import robot as robots
from bipedtrack.disturbances import Hooks
from bipedtrack.nodes import Nodes, ankles_in_trunk_frame
from bipedtrack.trace import Trace

DT, SECONDS = 0.005, 2.0  # s
TICKS = 400
PERIOD = 0.02  # s, of the policy
STAND, WALK = range(6), range(6, 12)
STAIRS, HURRIED = 12, 13
KINDS = (*["stand"] * 6, *["walk"] * 6, "stairs", "walk")
TASK_STEPS = 6
SIZES = (terrain.STAIR_BOX,) * terrain.STAIR_BOXES
ROLL = math.radians(50)  # of a trunk that cannot be held up
pytestmark = pytest.mark.usefixtures("unoptimised")


@pytest.fixture(scope="module")
def first() -> policy.Policy:
    """The policy that ships."""
    return policy.load(paths.data_dir("models") / "policies" / "best.npz", robots.load())


@pytest.fixture(scope="module")
def plan(robot: robots.Robot) -> plans.Plan:
    """An episode of each of KINDS. The last hurries: its task steps of 0.15 s are over before the recording is."""

    def given(kind: str) -> sampling.Distribution:
        shares = sampling.Shares(**{name: float(name == kind) for name in sampling.KINDS})
        ranges = sampling.Ranges()._replace(walk_step=(0.03, 0.03, 0.25))
        return sampling.distribution(ranges, shares, 0.0 if kind == "stairs" else 1.0, 0.0, (0, 0), down_share=1.0)

    drawn = jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(given, KINDS))
    lay_out = jax.jit(jax.vmap(lambda key, one: plans.random_plan(key, one, robot, TASK_STEPS)))
    found = jax.tree.map(np.array, lay_out(jax.random.split(jax.random.PRNGKey(7), len(KINDS)), drawn))
    found.steps.period[HURRIED] = 0.15
    return found


def the_env(the_policy: policy.Policy, plan: plans.Plan, kind: Any, sizes: Any) -> env.TrackingEnv:
    settings = env.EnvConfig(rewards.RewardConfig(), the_policy.settings, PERIOD)
    return kind(the_policy.robot, settings, episode(plan, 0), plans.PLANNED, sizes, touch=True)


def episode(plan: plans.Plan, index: Any) -> plans.Plan:
    """One episode of a plan of many, or several."""
    return jax.tree.map(lambda leaf: leaf[index], plan)


class Recorders(NamedTuple):
    """Of the policy that ships."""

    mjx: Any
    mujoco: Any
    compiled: list[str]  # one entry for each time that the network was traced


@pytest.fixture(scope="module")
def recorders(first: policy.Policy, plan: plans.Plan) -> Recorders:
    compiled = []

    def act(seen: jax.Array) -> jax.Array:
        compiled.append("network")
        return first.output(seen)

    controls = recording.Controls(first.robot, first.settings, PERIOD, act)
    mjx = recording.mjx_recorder(the_env(first, plan, env.TrackingEnv, SIZES), act)
    return Recorders(mjx, recording.mujoco_recorder(controls), compiled)


@pytest.fixture(scope="module")
def in_mjx(recorders: Recorders, plan: plans.Plan) -> Trace:
    return recorders.mjx(plan, SECONDS)


class InC(NamedTuple):
    trace: Trace
    motor_forces: np.ndarray  # (episodes, n, 12) N m, what MuJoCo applied over each control step but the last


@pytest.fixture(scope="module")
def in_c(recorders: Recorders, plan: plans.Plan) -> InC:
    forces = []

    def look(tick: int, datas: Any, targets: np.ndarray) -> np.ndarray:
        forces.append([data.actuator_force.copy() for data in datas])
        return targets

    trace = recorders.mujoco(plan, SIZES, SECONDS, hooks=Hooks(before_step=look))
    return InC(trace, np.array(forces[1:]).swapaxes(0, 1))


@pytest.fixture(params=["mjx", "mujoco"])
def recorded(request: pytest.FixtureRequest) -> Trace:
    """The plan with the policy that ships, in each engine."""
    return request.getfixturevalue("in_mjx") if request.param == "mjx" else request.getfixturevalue("in_c").trace


def clock(plan: plans.Plan, index: int) -> list[tuple[int, float]]:
    """The task step and the time into it, s, at every control step of an episode; the last step comes again and again."""
    found: list[tuple[int, float]] = []
    number = 0
    while len(found) < TICKS:
        found += [(number, tick * DT) for tick in range(round(float(plan.steps.period[index, number]) / DT))]
        number = min(number + 1, TASK_STEPS - 1)
    return found[:TICKS]


def commands(plan: plans.Plan, index: int, later: float = 0.0) -> list[planner.Command]:
    """The command at every control step of an episode, or a bit later but in the same task step, in float64."""
    steps = [jax.tree.map(lambda a, n=n: np.float64(a[index, n]), plan.steps) for n in range(TASK_STEPS)]
    return [planner.command(steps[number], np.float64(time + later)) for number, time in clock(plan, index)]


def stacked(each: list[Any]) -> Any:
    return jax.tree.map(lambda *leaves: np.array(leaves), *each)


@pytest.fixture(scope="module")
def wanted(plan: plans.Plan) -> list[planner.Command]:
    """The commands of each episode, (TICKS, ...)."""
    return [stacked(commands(plan, i)) for i in range(len(KINDS))]


def angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.abs(np.angle(np.exp(1j * (a - b))))


# Targets and states of the same instant


def test_an_episode_starts_on_its_first_command(
    recorded: Trace, wanted: list[planner.Command], mj_model: mujoco.MjModel
) -> None:
    real = by_mujoco(mj_model, recorded.qpos[:, 0])
    begin = stacked([jax.tree.map(lambda a: a[0], command.target) for command in wanted])
    np.testing.assert_allclose(real.ankle_positions, begin.ankle_positions, atol=1e-5)
    np.testing.assert_allclose(real.trunk_position, begin.trunk_position, atol=1e-5)
    turned = angle(real.ankle_yaws, begin.ankle_yaws).max(axis=1)
    assert turned[len(STAND) :].max() < 1e-5 and turned.max() < 0.05  # soles levelled under a tilted trunk turn a little
    assert (recorded.qvel[:, 0] == 0).all() and recorded.alive[:, 0].all()
    errors = metrics.errors(recorded)
    for leg in robots.LEGS:
        assert errors[f"{leg}_ankle_position_cm"][:, 0].max() < 1e-3
        assert errors[f"{leg}_ankle_yaw_deg"][len(STAND) :, 0].max() < 1e-3


def test_targets_are_the_plans_commands_at_every_instant(
    recorded: Trace, plan: plans.Plan, wanted: list[planner.Command]
) -> None:
    for i, command in enumerate(wanted):
        target, found = command.target, Nodes(*(part[i] for part in recorded.target))
        np.testing.assert_allclose(found.trunk_position, target.trunk_position, atol=2e-6)
        np.testing.assert_allclose(found.trunk_orientation, target.trunk_orientation, atol=2e-6)
        np.testing.assert_allclose(found.ankle_positions, target.ankle_positions, atol=2e-6)
        assert angle(found.ankle_yaws, target.ankle_yaws).max() < 2e-6
        np.testing.assert_allclose(recorded.timer[i], command.timer, atol=1e-6)
        # there are boundaries between task steps, at which the timer starts anew
        steps = {number for number, _ in clock(plan, i)}
        assert len(steps) == TASK_STEPS if i == HURRIED else len(steps) > 1
        assert i in STAND or (np.diff(recorded.timer[i].max(axis=1)) > 0.1).sum() >= 2
    np.testing.assert_allclose(recorded.time, np.arange(TICKS) * DT, atol=1e-9)


def test_a_command_stands_still_where_its_targets_do(recorded: Trace, plan: plans.Plan) -> None:
    for i in (STAND[0], WALK[0], HURRIED):
        now, soon = (stacked(commands(plan, i, later)).target for later in (0, 1e-4))
        ways = [np.abs(a - b).reshape(TICKS, -1).max(axis=1) for a, b in zip(now, soon, strict=True)]
        np.testing.assert_array_equal(recorded.still[i], np.max(ways, axis=0) < 1e-9)
        assert recorded.still[i].all() == (i in STAND)


def test_measured_nodes_are_those_of_the_recorded_state(recorded: Trace, mj_model: mujoco.MjModel) -> None:
    for i in range(len(KINDS)):
        at = np.flatnonzero(recorded.alive[i])[::20]
        real, found = by_mujoco(mj_model, recorded.qpos[i, at]), Nodes(*(part[i, at] for part in recorded.measured))
        np.testing.assert_allclose(found.trunk_position, real.trunk_position, atol=1e-5)
        np.testing.assert_allclose(found.trunk_orientation, real.trunk_orientation, atol=1e-5)
        np.testing.assert_allclose(found.ankle_positions, real.ankle_positions, atol=1e-5)
        assert angle(found.ankle_yaws, real.ankle_yaws).max() < 1e-5


def test_a_frame_of_misalignment_shows(wanted: list[planner.Command], robot: robots.Robot, mj_model: mujoco.MjModel) -> None:
    # a robot that follows its commands exactly, without physics
    command = jax.tree.map(lambda a: a[:60], wanted[WALK[0]])
    each = [jax.tree.map(lambda a, t=t: a[t], command.target) for t in range(60)]
    joints = [kinematics.inverse(robot, *ankles_in_trunk_frame(one)) for one in each]
    qpos = np.array([[*one.trunk_position, *one.trunk_orientation, *q] for one, q in zip(each, joints, strict=True)])
    twelve = np.zeros((1, 60, 12))
    nodes = [Nodes(*(part[None] for part in state)) for state in (command.target, by_mujoco(mj_model, qpos))]
    still, up = np.zeros((1, 60), bool), np.ones((1, 60), bool)
    states = qpos[None], np.zeros((1, 60, 18))
    exact = Trace(np.arange(60) * DT, *states, *nodes, command.timer[None], still, *[twelve] * 3, twelve[..., :2], up)
    assert max(values.max() for values in metrics.errors(exact).values()) < 1e-3

    part = lambda nodes, of: Nodes(*(array[:, of] for array in nodes))  # noqa: E731
    shifted = exact.episode(0)
    shifted = jax.tree.map(lambda a: a[None, :-1], shifted)._replace(time=exact.time[:-1])
    shifted = shifted._replace(target=part(exact.target, slice(None, -1)), measured=part(exact.measured, slice(1, None)))
    found = metrics.errors(shifted)
    way = np.linalg.norm(np.diff(command.target.ankle_positions, axis=0), axis=-1)  # (59, 2) m in a control step
    for foot, leg in enumerate(robots.LEGS):
        np.testing.assert_allclose(found[f"{leg}_ankle_position_cm"][0], 100 * way[:, foot], atol=1e-3)
    swinging = int(np.argmax(command.timer[0]))
    assert 100 * way[:, swinging].mean() > 0.2 and way[:, 1 - swinging].max() < 1e-9


# The two engines and the product's controller


def test_mjx_and_mujoco_c_agree(in_mjx: Trace, in_c: InC) -> None:
    compared = np.array([*STAND, *WALK])
    mjx, c = (trace.episode(compared) for trace in (in_mjx, in_c.trace))
    apart = np.abs(mjx.qpos - c.qpos).max(axis=-1)
    # measured: 8e-5 at most, median 4e-6; 2e-3 where rounding decides which sole touches at the first instant
    assert np.median(apart[:, :61].max(axis=1)) < 5e-5 and np.isfinite(apart).all()
    moved = np.abs(c.qpos[:, 60] - c.qpos[:, 0]).max(axis=1)
    assert np.median(moved) > 0.05
    assert abs(mjx.alive[:, -1].mean() - c.alive[:, -1].mean()) <= 0.02
    for name in metrics.ERRORS:
        if "ankle" in name:
            a, b = (np.nanmean(metrics.errors(one)[name]) for one in (mjx, c))
            assert abs(a - b) < 0.5 and b > 0.1, name  # cm or deg


@pytest.mark.parametrize("index", [STAND[0], WALK[0], STAIRS])
def test_recording_in_c_is_the_products_controller_in_a_loop(
    in_c: InC, plan: plans.Plan, first: policy.Policy, index: int
) -> None:
    model = robots.build_model("ranger_max", SIZES)
    data, controller = mujoco.MjData(model), policy.Controller(first)
    data.qpos[:] = in_c.trace.qpos[index, 0]
    controller.reset(data.qpos)
    states, targets, feedbacks = [], [], []
    for (number, _), command in zip(clock(plan, index), commands(plan, index), strict=False):
        data.mocap_pos[:], data.mocap_quat[:] = np.split(plan.boxes[index, number], [3], axis=1)
        states.append(data.qpos.copy())
        targets.append(controller.step(data.qpos, data.qvel, command))
        feedbacks.append(controller.last_feedback)
        data.ctrl[:] = targets[-1]
        mujoco.mj_step(model, data)
    # velocity feedforward multiplies the rounding of joint angles by (kd/kp) / 0.005 s = 10; measured: 1.2e-5
    for found, wanted in ((in_c.trace.joint_targets, targets), (in_c.trace.feedback, feedbacks)):
        np.testing.assert_allclose(found[index, :60], wanted[:60], atol=5e-5)
    np.testing.assert_allclose(in_c.trace.qpos[index, :60], states[:60], atol=1e-5)
    # measured: 2e-7; the robot on stairs meanwhile walks on boxes that have moved
    np.testing.assert_allclose(in_c.trace.qpos[index], states, atol=1e-3)
    assert np.ptp(feedbacks, axis=0).max() > 0.05


def test_robots_stand_on_the_boxes_of_the_plan(recorded: Trace, plan: plans.Plan, robot: robots.Robot) -> None:
    top = plan.steps.start.ankle_positions[STAIRS, 0, :, 2]
    assert (top > 0.1 + robot.ankle_height).all()
    np.testing.assert_allclose(recorded.measured.ankle_positions[STAIRS, :40, :, 2].min(axis=0), top, atol=0.02)


# Falls


def fallen_by_hand(trace: Trace) -> np.ndarray:
    """Where a robot is tilted by 60 deg, 0.35 m below its target or has an ankle 0.5 m off, (e, n)."""
    tilted = 1 - 2 * (trace.qpos[..., 4] ** 2 + trace.qpos[..., 5] ** 2) <= 0.5
    sunk = trace.target.trunk_position[..., 2] - trace.qpos[..., 2] >= 0.35
    off = trace.target.ankle_positions - trace.measured.ankle_positions
    return tilted | sunk | (np.sqrt((off**2).sum(axis=-1)) >= 0.5).any(axis=-1)


def test_when_all_have_fallen_the_trace_keeps_its_length(
    recorders: Recorders, recorded: Trace, plan: plans.Plan, robot: robots.Robot, request: pytest.FixtureRequest
) -> None:
    engine = request.node.callspec.params["recorded"]
    rolled = jax.tree.map(np.copy, plan)
    for nodes in (rolled.steps.start, rolled.steps.end):
        nodes.trunk_orientation[:] = [math.cos(ROLL / 2), math.sin(ROLL / 2), 0, 0]
    compiled, ticks = len(recorders.compiled), []

    def count(tick: int, datas: Any, targets: np.ndarray) -> np.ndarray:
        ticks.append(tick)
        return targets

    mjx = engine == "mjx"
    fallen = (
        recorders.mjx(rolled, SECONDS) if mjx else recorders.mujoco(rolled, SIZES, SECONDS, hooks=Hooks(before_step=count))
    )
    assert len(recorders.compiled) == compiled  # for the first plan, but not anew
    # MJX looks every second, C at every step
    stopped = 200 if mjx else len(ticks)
    assert mjx or stopped == fallen.alive.sum(axis=1).max() + 1
    assert fallen.time.shape == (TICKS,)
    assert all(leaf.shape[:2] == (len(KINDS), TICKS) for leaf in jax.tree.leaves(tuple(fallen[1:])))
    assert fallen.alive[:, 0].all() and not fallen.alive[:, stopped:].any() and 2 < stopped <= 200
    assert (np.diff(fallen.alive.astype(int), axis=1) <= 0).all()
    assert (fallen.qpos[:, stopped:] == fallen.qpos[:, stopped - 1 : stopped]).all()  # nothing is simulated any more
    bad = fallen_by_hand(fallen)
    first_bad = fallen.alive.sum(axis=1)
    assert not bad[fallen.alive].any() and bad[np.arange(len(KINDS)), first_bad].all()
    summary = metrics.summarise(fallen, robot, 400.0)
    assert summary["survival"]["falls"] == len(KINDS) and summary["seconds"] == pytest.approx(SECONDS)


@pytest.mark.parametrize("engine", ["mjx", "mujoco"])
def test_a_robot_whose_target_leaves_it_has_fallen_though_it_is_upright(
    recorders: Recorders, plan: plans.Plan, engine: str
) -> None:
    moved = jax.tree.map(np.copy, plan)
    moved.steps.end.trunk_position[:, 0, 2] += 1.0  # higher than its legs are long
    found = recorders.mjx(moved, SECONDS) if engine == "mjx" else recorders.mujoco(moved, SIZES, SECONDS)
    for i in STAND:
        standing, bad = found.alive[i].sum(), fallen_by_hand(found.episode(i))
        assert 2 < standing < TICKS and not found.alive[i, standing:].any()
        assert not bad[:standing].any() and bad[standing]
        assert 1 - 2 * (found.qpos[i, standing, 4] ** 2 + found.qpos[i, standing, 5] ** 2) > 0.8


# Without feedforward


def test_without_feedforward_joint_targets_stay(first: policy.Policy, plan: plans.Plan) -> None:
    some = episode(plan, np.array([WALK[0], WALK[1]]))
    controls = recording.Controls(first.robot, first.settings, PERIOD, lambda seen: 0 * seen[:12], feedforward=False)
    found = recording.mujoco_recorder(controls)(some, SIZES, 0.3)
    joints = found.qpos[:, :1, 7:]
    np.testing.assert_allclose(found.joint_targets, joints.repeat(60, 1), atol=1e-5)
    assert np.ptp(found.target.ankle_positions, axis=1).max() > 0.1 and (found.feedback == 0).all()


def test_without_feedforward_joint_targets_stay_in_mjx_too(first: policy.Policy, plan: plans.Plan) -> None:
    # the physics stands still here, so that it need not be compiled; `evaluate zero` runs it all
    one = the_env(first, plan, recording.FirstCommandEnv, ())

    @jax.jit
    def targets(given: plans.Plan) -> tuple[Any, jax.Array]:
        state = one.begin(jax.random.PRNGKey(0), given)

        def tick(memory: Any, _: None) -> Any:
            (_, memory), answer = one.control_step(state.pipeline_state, memory, one.look_ahead(memory)[1], jnp.zeros(12))
            return memory, (one.command(memory).target.ankle_positions, answer.joint_targets)

        return state.pipeline_state.qpos[7:], jax.lax.scan(tick, state.info["episode"], length=60)[1]

    walk = episode(plan, WALK[0])
    joints, (ankles, found) = targets(walk._replace(boxes=walk.boxes[:, :0]))
    np.testing.assert_allclose(found, np.tile(joints, (60, 1)), atol=1e-5)
    assert np.ptp(ankles, axis=0).max() > 0.1


# Forces


def test_torques_are_those_that_mujoco_applied(in_c: InC, robot: robots.Robot) -> None:
    found, alive = in_c.trace.torques[:, :-1], in_c.trace.alive[:, :-1]
    np.testing.assert_allclose(found[alive], in_c.motor_forces[alive], atol=1e-6)
    assert np.abs(found[alive]).max() > 50 and (np.abs(found) <= robot.torque_limit).all()


def test_torques_in_mjx_are_those_of_mujoco_at_the_same_state(in_mjx: Trace, mj_model: mujoco.MjModel) -> None:
    data = mujoco.MjData(mj_model)
    for i, t in [(i, t) for i in (*STAND, *WALK) for t in range(0, TICKS, 37) if in_mjx.alive[i, t]]:
        data.qpos[:], data.qvel[:], data.ctrl[:] = (a[i, t] for a in (in_mjx.qpos, in_mjx.qvel, in_mjx.joint_targets))
        mujoco.mj_forward(mj_model, data)
        np.testing.assert_allclose(in_mjx.torques[i, t], data.actuator_force, atol=1e-2)


def test_the_ground_bears_the_weight_of_those_who_stand(recorded: Trace, mj_model: mujoco.MjModel) -> None:
    weight = 9.81 * mj_model.body_mass.sum()
    standing = [i for i in STAND if recorded.alive[i].all()]
    assert len(standing) >= 3
    borne = recorded.foot_forces[standing, 200:].sum(axis=-1).mean(axis=1)
    np.testing.assert_allclose(borne, weight, rtol=0.05)


def test_a_foot_in_the_air_bears_nothing(recorded: Trace, mj_model: mujoco.MjModel) -> None:
    weight = 9.81 * mj_model.body_mass.sum()
    heights = recorded.measured.ankle_positions[list(WALK), ..., 2]
    up = (heights > 0.06) & recorded.alive[list(WALK), :, None] & (heights[..., ::-1] < 0.05)
    forces = recorded.foot_forces[list(WALK)]
    assert (up.sum(axis=(0, 1)) > 50).all()  # both feet swing
    # a toe may still touch, but the other foot bears the robot
    assert (forces[up] == 0).mean() > 0.9 and forces[..., ::-1][up].mean() > 0.5 * weight


# Hooks


def test_hooks_act(first: policy.Policy, plan: plans.Plan) -> None:
    some = episode(plan, np.array(STAND[:3]))
    joints = observation.layout()["joint_positions"]
    controls = recording.Controls(first.robot, control.ControlConfig(level_feet=True), PERIOD, lambda seen: seen[joints])
    models: list[Any] = []
    ticks: list[tuple[str, int]] = []
    forces, returned, told = [], [], []

    def model_of(model: Any, i: int) -> Any:
        models.append(model)
        assert i == len(models) - 1
        if i == 1:
            model.body("trunk").mass[0] += 20
        return model

    def before_step(tick: int, datas: Any, targets: np.ndarray) -> np.ndarray:
        ticks.append(("before_step", tick))
        forces.append([data.actuator_force.copy() for data in datas])
        targets = targets.copy()
        targets[2, 3] += 0.5 if tick >= 30 else 0.0
        returned.append(targets)
        return targets

    def observed(tick: int, qpos: np.ndarray, qvel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        ticks.append(("observed", tick))
        told.append((qpos.copy(), qvel.copy()))
        qpos = qpos.copy()
        qpos[:, 7:] = 0.01 * tick
        return qpos, qvel

    hooks = Hooks(model_of, before_step, observed)
    found = recording.mujoco_recorder(controls)(some, SIZES, 0.2, converged=True, hooks=hooks)
    assert ticks == [(name, tick) for tick in range(40) for name in ("observed", "before_step")]
    # each episode has its own model, of which MuJoCo has derived what follows from the masses
    assert len({id(model) for model in models}) == 3
    total = [model.body_mass.sum() for model in models]
    np.testing.assert_allclose(np.subtract(total, total[0]), [0, 20, 0], atol=1e-9)
    np.testing.assert_allclose([model.body_subtreemass[0] for model in models], total)
    assert {model.opt.iterations for model in models} == {100}
    borne = found.foot_forces[:, 10:30].sum(axis=-1).mean(axis=1)
    assert 100 < borne[1] - borne[0] < 300
    # what is recorded is the true state, but the network was told another one, every fourth control step
    np.testing.assert_array_equal(found.qpos.swapaxes(0, 1), [qpos for qpos, _ in told])
    np.testing.assert_array_equal(found.qvel.swapaxes(0, 1), [qvel for _, qvel in told])
    wanted = 0.2 * 0.01 * (np.arange(40) // 4 * 4)
    np.testing.assert_allclose(found.feedback, wanted[None, :, None] * np.ones((3, 40, 12)), atol=1e-6)
    # what the hook returned is what the motors got
    np.testing.assert_array_equal(found.joint_targets.swapaxes(0, 1), returned)
    np.testing.assert_allclose(found.torques[:, :-1].swapaxes(0, 1), forces[1:], atol=1e-6)
    assert found.torques[2, 30, 3] == 300
