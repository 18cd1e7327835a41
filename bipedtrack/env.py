"""The environment: a tracking robot as a pure-functional brax Env over MJX.

Written for one robot; training maps it over thousands. `TrackingEnv.step` is the table of contents.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import brax.envs
import jax
import jax.numpy as jnp
from mujoco import mjx

from bipedtrack import (
    control,
    falls,
    kinematics,
    nodes,
    observation,
    planner,
    rewards,
    robot,
    tasks,
    terrain,
)
from bipedtrack.rotations import Array

_PUSH_SECONDS = 0.1  # s that a push lasts
_PUSH_EVERY = 2.0  # s between the pushes of one episode, on average


@dataclasses.dataclass(frozen=True)
class EnvConfig:
    """What an environment is built from besides the robot; everything else is data (sampling.Distribution)."""

    rewards: rewards.RewardConfig
    control: control.ControlConfig
    policy_period: float = 0.02  # s for which a feedback is held; the rest of the control law runs every 0.005 s
    stairs: bool = False  # with the boxes of a staircase (slower)


class Physics(NamedTuple):
    """All that MJX needs to go on: mjx.Data is rebuilt from it inside the step."""

    qpos: Array  # (19,)
    qvel: Array  # (18,)
    warmstart: Array  # (18,) qacc from which the solver starts
    boxes: Array  # (number of boxes, 7) position m and quaternion
    sensors: Array  # what the model's sensors read in the last step; none in training


_TOUCH = 5e-6  # m, several times the rounding of float32 at the heights and distances of an episode


class Episode(NamedTuple):
    """What one robot's episode remembers beside its physics."""

    key: Array  # random key of what comes next
    given: Any  # what the source draws from: sampling.Distribution or plans.Plan
    task: Any  # what the source remembers of the episode
    step: planner.TaskStep
    index: Array  # () number of the task step
    tick: Array  # () control steps into it
    control: control.ControlState
    feedback: Array  # (12,) a_fb(t-1)
    push: Array  # (3,) N, force on the trunk's centre, in the world frame
    push_left: Array  # () policy steps for which it still lasts


class Answer(NamedTuple):
    """What one control step did besides moving the robot on."""

    joint_targets: Array  # (12,) rad
    qacc: Array  # (18,) accelerations as MuJoCo's solver has them, before the implicit integrator damps them


def standing(
    the_robot: robot.Robot, settings: control.ControlConfig, start: nodes.Nodes
) -> tuple[Array, control.ControlState]:
    """A robot, qpos (19,), with its nodes at `start` by inverse kinematics and its soles level, and its controller.

    It stands lower by _TOUCH, m: of soles at exactly the ground's height rounding would decide which of them touch.
    """
    level = control.feedforward(the_robot, dataclasses.replace(settings, level_feet=True), start)
    joints = control.denormalize(the_robot, jnp.clip(level, -1.0, 1.0))
    memory = control.initial(level, control.feedforward(the_robot, settings, start))
    position = start.trunk_position - jnp.array([0.0, 0.0, _TOUCH])
    return jnp.concatenate([position, start.trunk_orientation, joints]), memory


class TrackingEnv(brax.envs.Env):
    """One robot that is told, at every instant, where its nodes should be."""

    def __init__(
        self,
        the_robot: robot.Robot,
        config: EnvConfig,
        given: Any,
        source: tasks.Source = tasks.RANDOM,
        boxes: Sequence[Sequence[float]] | None = None,
        touch: bool = False,
    ):
        """An environment whose episodes come from `source` with the data `given`.

        boxes: (length, width, height) of each box that the source poses, m; by default those of stairs, or none.
        touch: with sensors for the force on each sole.
        Raises ValueError where the policy period is no multiple of the control period.
        """
        self.robot = the_robot
        self.config = config
        self.given = given
        self.source = source
        self.substeps = control.substeps(config.policy_period, the_robot.timestep)
        if boxes is None:
            boxes = [terrain.STAIR_BOX] * terrain.STAIR_BOXES if config.stairs else []
        self.mj_model = robot.build_model(the_robot.name, boxes, touch=touch)
        device = jax.local_devices()[0]  # by default mjx takes the first of all processes
        self.mjx_model = mjx.put_model(self.mj_model, device)
        self._blank = mjx.make_data(self.mj_model, device)

    @property
    def observation_size(self) -> int:
        """101."""
        return observation.SIZE

    @property
    def action_size(self) -> int:
        """One feedback per joint."""
        return len(self.robot.joint_names)

    @property
    def backend(self) -> str:
        """The physics engine."""
        return "mjx"

    def reset(self, rng: Array) -> brax.envs.State:
        """A new episode: task, task step and robot, standing where the first command wants it."""
        return self.begin(rng, self.given)

    def begin(self, key: Array, given: Any) -> brax.envs.State:
        """A new episode drawn from `given`. No forward dynamics: joint angles come from inverse kinematics."""
        key, key_task, key_step = jax.random.split(key, 3)
        task, start = self.source.begin(key_task, given, self.robot)
        index = jnp.int32(0)
        step = self._task_step(key_step, given, task, index, start)
        qpos, memory = standing(self.robot, self.config.control, start)
        physics = Physics(
            qpos=qpos,
            qvel=jnp.zeros(self.mj_model.nv),
            warmstart=jnp.zeros(self.mj_model.nv),
            boxes=self._boxes(given, task, index),
            sensors=jnp.zeros(self.mj_model.nsensordata),
        )
        episode = Episode(
            key=key,
            given=given,
            task=task,
            step=step,
            index=index,
            tick=jnp.int32(0),
            control=memory,
            feedback=jnp.zeros(self.action_size),
            push=jnp.zeros(3),
            push_left=jnp.int32(0),
        )
        zero = jnp.float32(0)
        names = *rewards.Terms._fields, *tasks.ERRORS, "fell", "nonfinite"
        return brax.envs.State(
            pipeline_state=physics,
            obs=self.observe(physics, episode, self.command(episode)),
            reward=zero,
            done=zero,
            metrics=dict.fromkeys(names, zero),
            info={"episode": episode},
        )

    def step(self, state: brax.envs.State, action: Array) -> brax.envs.State:
        """One policy step: the feedback is held while planner, feedforward, filter and PD run at 200 Hz."""
        before, episode = state.pipeline_state, state.info["episode"]
        a_fb = control.feedback(self.config.control, action)
        episode, following = self.look_ahead(self._pushed(episode))
        advance = lambda carry, _: self.control_step(carry[0], carry[1], following, a_fb)  # noqa: E731
        (physics, episode), answer = jax.lax.scan(advance, (before, episode), length=self.substeps)

        finite = falls.finite(physics.qpos, physics.qvel)
        physics = jax.tree.map(lambda new, old: jnp.where(finite, new, old), physics, before)
        command = self.command(episode)
        measured = kinematics.measure(self.robot, physics.qpos)
        errors = nodes.difference(command.target, measured)
        terms = rewards.terms(
            self.config.rewards.sharpness,
            errors,
            command.rates,
            a_fb,
            episode.feedback,
            physics.qvel[6:],
            jnp.where(finite, answer.qacc[-1, 6:], 0.0),
        )
        episode = episode._replace(feedback=a_fb)
        fell = falls.fell(command.target, measured) | ~finite
        return state.replace(
            pipeline_state=physics,
            obs=self.observe(physics, episode, command),
            reward=rewards.total(self.config.rewards.weights, terms),
            done=fell.astype(jnp.float32),
            metrics={
                **terms._asdict(),
                **tasks.tracking_errors(errors),
                "fell": fell.astype(jnp.float32),
                "nonfinite": (~finite).astype(jnp.float32),
            },
            info={**state.info, "episode": episode},
        )

    def look_ahead(self, episode: Episode) -> tuple[Episode, planner.TaskStep]:
        """The task step after the present one, for all control steps of a policy step, which is far shorter than either."""
        key, key_step = jax.random.split(episode.key)
        step = self._task_step(key_step, episode.given, episode.task, episode.index + 1, episode.step.end)
        return episode._replace(key=key), step

    def _pushed(self, episode: Episode) -> Episode:
        """The episode with this policy step's force: none, one that goes on, or a new one in any horizontal direction."""
        key, key_when, key_what = jax.random.split(episode.key, 3)
        period = self.config.policy_period
        begins = jax.random.uniform(key_when) < period / _PUSH_EVERY
        u = jax.random.uniform(key_what, (2,))
        lasts = max(1, round(_PUSH_SECONDS / period))
        size = u[0] * self.source.push(episode.given, episode.task) / (lasts * period)
        force = size * jnp.stack([jnp.cos(2 * jnp.pi * u[1]), jnp.sin(2 * jnp.pi * u[1]), jnp.float32(0)])
        goes_on = episode.push_left > 0
        return episode._replace(
            key=key,
            push=jnp.where(goes_on, episode.push, jnp.where(begins, force, 0.0)),
            push_left=jnp.where(goes_on, episode.push_left - 1, jnp.where(begins, lasts - 1, 0)),
        )

    def control_step(
        self, physics: Physics, episode: Episode, following: planner.TaskStep, a_fb: Array
    ) -> tuple[tuple[Physics, Episode], Answer]:
        """One control step of 0.005 s with a feedback (12,): eqs (4)-(7), physics, clock."""
        command = self.command(episode)
        a_ff = control.feedforward(self.robot, self.config.control, self.feedforward_nodes(episode, command))
        targets, memory = control.respond(
            self.robot, self.config.control, episode.control, a_ff, a_fb, command, physics.qpos, physics.qvel
        )
        physics = self.simulate(physics, targets, episode.push)
        episode = self._tick(episode._replace(control=memory), following)
        boxes = self._boxes(episode.given, episode.task, episode.index)
        return (physics._replace(boxes=boxes), episode), Answer(targets, physics.warmstart)

    def simulate(self, physics: Physics, joint_targets: Array, push: Array) -> Physics:
        """MJX from t to t + 0.005 s with PD controllers at joint targets, (12,) rad, and a force on the trunk, (3,) N."""
        data = self._blank.replace(
            qpos=physics.qpos,
            qvel=physics.qvel,
            qacc_warmstart=physics.warmstart,
            ctrl=joint_targets,
            qfrc_applied=self._blank.qfrc_applied.at[:3].set(push),
        )
        if self.mj_model.nmocap:
            data = data.replace(mocap_pos=physics.boxes[:, :3], mocap_quat=physics.boxes[:, 3:])
        data = mjx.step(self.mjx_model, data)
        return physics._replace(qpos=data.qpos, qvel=data.qvel, warmstart=data.qacc, sensors=data.sensordata)

    def _tick(self, episode: Episode, following: planner.TaskStep) -> Episode:
        """The clock one control step on, into the next task step where this one is over."""
        tick = episode.tick + 1
        over = tick >= jnp.round(episode.step.period / self.robot.timestep)
        choose = lambda new, old: jnp.where(over, new, old)  # noqa: E731
        return episode._replace(
            step=jax.tree.map(choose, following, episode.step),
            index=choose(episode.index + 1, episode.index),
            tick=choose(jnp.int32(0), tick),
        )

    def _task_step(self, key: Array, given: Any, task: Any, index: Array, start: nodes.Nodes) -> planner.TaskStep:
        return self.source.next_step(key, given, task, index, start, self.robot)

    def command(self, episode: Episode) -> planner.Command:
        """The command at this instant."""
        return planner.command(episode.step, episode.tick * self.robot.timestep)

    def feedforward_nodes(self, episode: Episode, command: planner.Command) -> nodes.Nodes:
        """The nodes that inverse kinematics turns into the feedforward: the real-time target."""
        return command.target

    def _boxes(self, given: Any, task: Any, index: Array) -> Array:
        if not self.mj_model.nmocap:
            return jnp.zeros((0, 7))
        return self.source.boxes(given, task, index)

    def observe(self, physics: Physics, episode: Episode, command: planner.Command) -> Array:
        """The flat observation of eq (8), (101,)."""
        a_ff = control.feedforward(self.robot, self.config.control, self.feedforward_nodes(episode, command))
        real = kinematics.measure(self.robot, physics.qpos)
        return observation.flatten(observation.observe(command, real, physics.qpos, physics.qvel, a_ff, episode.feedback))
