"""The typed configuration of a training: stages of lessons, and all numbers they share.

A curriculum is a TOML file in `curricula/`; loading is strict (see `config`). Stages and lessons become one brax PPO call
after another: `calls` spells them out.
"""

from __future__ import annotations

import dataclasses
import math
import pathlib
from typing import Any, Literal

from bipedtrack import checkpoint, config, footsteps, paths, scripts, terrain
from bipedtrack.control import ControlConfig
from bipedtrack.rewards import RewardConfig
from bipedtrack.robot import Robot
from bipedtrack.run_directory import RunDirectory
from bipedtrack.sampling import Ranges, Shares

_UPDATES_PER_EPOCH = 8  # of brax, between two looks at whether somebody wants the training to stop


@dataclasses.dataclass(frozen=True)
class NetworkConfig:
    """The actor and the critic: multi-layer perceptrons on the normalised observation."""

    actor: tuple[int, ...] = (512, 512, 512)  # hidden layers
    critic: tuple[int, ...] = (128, 128)
    activation: Literal["swish", "tanh", "relu"] = "swish"
    initial_noise: float = 0.7  # standard deviation of the Gaussian over the network's output
    normalizer_floor: float = 0.0025  # added to the variance of every observation: a deviation of at least 0.05
    symmetric: bool = False  # shown the mirror image where the right foot leads: half as much to learn (`symmetry`)
    critic_sees_balance: bool = False  # also where the centre of mass is going, seen from the feet (`balance`)

    def __post_init__(self) -> None:
        if min(self.actor, default=0) < 1 or min(self.critic, default=0) < 1:
            raise ValueError("actor and critic need at least one hidden layer each, of at least one unit")
        if not self.initial_noise > 0 or not self.normalizer_floor >= 0:
            raise ValueError("initial_noise must be positive and normalizer_floor not negative")


@dataclasses.dataclass(frozen=True)
class PpoConfig:
    """What every PPO call shares. An update gathers num_envs x unroll_length steps (ML-Agents: buffer_size)."""

    num_envs: int = 640
    unroll_length: int = 32  # policy steps
    num_minibatches: int = 10  # per epoch; ML-Agents' batch_size is num_envs x unroll_length / num_minibatches
    num_epochs: int = 3
    discount: float = 0.98
    gae_lambda: float = 0.95
    max_grad_norm: float = 1.0
    reward_scaling: float = 0.05

    def __post_init__(self) -> None:
        if min(self.num_envs, self.unroll_length, self.num_minibatches, self.num_epochs) < 1:
            raise ValueError("num_envs, unroll_length, num_minibatches and num_epochs must be at least 1")
        if not (0 < self.discount <= 1 and 0 <= self.gae_lambda <= 1):
            raise ValueError("discount must lie in (0, 1] and gae_lambda in [0, 1]")
        if not (self.max_grad_norm > 0 and self.reward_scaling > 0):
            raise ValueError("max_grad_norm and reward_scaling must be positive")
        if self.num_envs % self.num_minibatches:
            raise ValueError(
                f"num_envs ({self.num_envs}) must be a multiple of num_minibatches ({self.num_minibatches}): "
                "a minibatch is made of whole unrolls"
            )

    @property
    def steps_per_update(self) -> int:
        """Policy steps that one update of the network learns from."""
        return self.num_envs * self.unroll_length

    def shares_out(self, devices: int) -> bool:
        """Whether every device gets as many robots as any other, and whole unrolls in each of its minibatches."""
        return self.num_envs % (devices * self.num_minibatches) == 0


@dataclasses.dataclass(frozen=True)
class Lesson:
    """A part of a stage with one difficulty."""

    name: str
    steps: int  # policy steps, over all environments; each part is rounded up (Call.steps)
    difficulty: float  # 0 the mildest, 1 the full ranges
    parts: int = 1  # PPO calls that share the steps; a killed run repeats at most one
    push_share: float = 0.0  # share of the episodes with pushes
    noise: float | None = None  # standard deviation that exploration begins the lesson with; else it goes on as it was

    def __post_init__(self) -> None:
        if not 1 <= self.parts <= self.steps:
            raise ValueError("steps and parts must be at least 1, and every part needs a step")
        if not 0 <= self.difficulty <= 1:
            raise ValueError(f"difficulty must lie in [0, 1], not {self.difficulty}")
        if not 0 <= self.push_share <= 1:
            raise ValueError(f"push_share must lie in [0, 1], not {self.push_share}")
        if self.noise is not None and not self.noise > 0:
            raise ValueError(f"noise must be positive, not {self.noise}")


@dataclasses.dataclass(frozen=True)
class Stage:
    """A stage of the curriculum: the kinds it draws from, and PPO parameters that fall linearly along it."""

    name: str
    shares: Shares
    learning_rate: tuple[float, float]  # at its start and its end
    entropy_cost: tuple[float, float]  # beta
    clipping_epsilon: tuple[float, float]  # epsilon
    lessons: tuple[Lesson, ...]
    hold_share: float = 0.0  # share of the episodes that stop after some task steps and hold
    hold_after: tuple[int, int] = (1, 8)  # least and greatest number of task steps before a hold
    mix_share: float = 0.0  # share of the episodes on level ground that change their kind every few task steps
    break_share: float = 0.0  # share of the stepping episodes that pause or close up every few task steps
    scripts: tuple[str, ...] = ()  # footstep scripts that episodes follow too: names in curricula/footsteps, or files
    script_share: float = 0.0  # share of the episodes that follow one of them
    retries: int = 0  # how many times an episode that ends in a fall begins again from a second or two before it
    feedback_error: float = 0.0  # weight of feedback-error learning in the loss (`feedback_error.loss`)
    rewards: RewardConfig | None = None  # where they are others than the curriculum's; in TOML: what differs is enough
    ranges: Ranges | None = None  # the same; evaluations keep to the curriculum's
    control: ControlConfig | None = None  # the same; a policy keeps to that of the stage it comes from

    def __post_init__(self) -> None:
        if not self.lessons:
            raise ValueError(f"stage {self.name!r} has no lessons")
        if min(*self.learning_rate, *self.entropy_cost, *self.clipping_epsilon, self.feedback_error) < 0:
            raise ValueError("learning_rate, entropy_cost, clipping_epsilon and feedback_error must not be negative")
        for name in ("hold_share", "mix_share", "break_share", "script_share"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must lie in [0, 1], not {getattr(self, name)}")
        if self.retries < 0:
            raise ValueError(f"retries must not be negative, not {self.retries}")
        if not 0 <= self.hold_after[0] <= self.hold_after[1]:
            raise ValueError(f"hold_after must be two growing numbers of task steps, not {list(self.hold_after)}")
        if bool(self.scripts) != (self.script_share > 0):
            raise ValueError("scripts and script_share need each other")

    @property
    def steps(self) -> int:
        """Policy steps of all lessons."""
        return sum(lesson.steps for lesson in self.lessons)


@dataclasses.dataclass(frozen=True)
class Curriculum:
    """A whole training."""

    name: str
    stages: tuple[Stage, ...]
    robot: str = "ranger_max"
    policy_period: float = 0.02  # s, for which a feedback is held
    episode_seconds: float = 10.0
    evaluation_episodes: int = 48  # for each line of the table at the end of a training; 0: no table
    ranges: Ranges = Ranges()
    rewards: RewardConfig = RewardConfig()
    control: ControlConfig = ControlConfig()
    network: NetworkConfig = NetworkConfig()
    ppo: PpoConfig = PpoConfig()

    def __post_init__(self) -> None:
        if not self.stages:
            raise ValueError("a curriculum needs at least one stage")
        if self.evaluation_episodes < 0:
            raise ValueError("evaluation_episodes must not be negative")
        if not 0 < self.policy_period <= self.episode_seconds:
            raise ValueError("policy_period must be positive and no longer than episode_seconds")
        for stage in self.stages:
            # the table at the end draws from the curriculum's own ranges
            shortest = min(ranges_of(self, stage).period[0], self.ranges.period[0])
            most = terrain.TREADS_DOWN * shortest
            if stage.shares.stairs > 0 and self.episode_seconds > most:
                raise ValueError(
                    f"episode_seconds ({self.episode_seconds:g}) must be at most {most:g} in stage {stage.name!r}: "
                    f"a staircase down has {terrain.TREADS_DOWN} treads"
                )

    @property
    def episode_length(self) -> int:
        """Policy steps until the time limit."""
        return round(self.episode_seconds / self.policy_period)


@dataclasses.dataclass(frozen=True)
class Call:
    """One PPO call: the smallest unit that a resumed run repeats."""

    index: int  # among all calls
    stage: Stage
    lesson: Lesson
    steps: int  # policy steps: its share of the lesson's, rounded up to whole epochs of whole updates as brax does it
    epochs: int  # after each of which brax reports
    learning_rate: float
    entropy_cost: float
    clipping_epsilon: float
    noise: float | None  # Lesson.noise, in the first part alone


def calls(curriculum: Curriculum) -> tuple[Call, ...]:
    """The PPO calls of a curriculum in order, with the values of its stage's falling lines at the middle of its lesson.

    They are constants of the compiled program, so that the parts of a lesson share one.
    """
    found: list[Call] = []
    for stage in curriculum.stages:
        done = 0
        for lesson in stage.lessons:
            along = (done + lesson.steps / 2) / stage.steps
            rate, entropy, epsilon = (
                start + along * (end - start)
                for start, end in (stage.learning_rate, stage.entropy_cost, stage.clipping_epsilon)
            )
            for part in range(lesson.parts):
                steps = lesson.steps // lesson.parts + (part < lesson.steps % lesson.parts)
                updates = math.ceil(steps / curriculum.ppo.steps_per_update)
                epochs = math.ceil(updates / _UPDATES_PER_EPOCH)
                steps = epochs * math.ceil(updates / epochs) * curriculum.ppo.steps_per_update
                noise = lesson.noise if part == 0 else None
                found.append(Call(len(found), stage, lesson, steps, epochs, rate, entropy, epsilon, noise))
            done += lesson.steps
    return tuple(found)


def control_of(curriculum: Curriculum, stage: Stage) -> ControlConfig:
    """The control law of a stage: its own, or the curriculum's."""
    return stage.control or curriculum.control


def ranges_of(curriculum: Curriculum, stage: Stage) -> Ranges:
    """The ranges of a stage: its own, or the curriculum's."""
    return stage.ranges or curriculum.ranges


def scripts_of(curriculum: Curriculum, stage: Stage, robot: Robot) -> list[footsteps.Script]:
    """The footstep scripts of a stage; their trunk sways as its mildest task steps do.

    Raises config.ConfigError where one is missing, wrong or not on level ground.
    """
    ready, found = scripts.ready(), []
    sway = ranges_of(curriculum, stage).usual_sway
    for name in stage.scripts:
        if name not in ready and not name.endswith(".csv"):
            raise config.ConfigError(f"stage {stage.name!r}: no script named {name!r}; there are: {', '.join(ready)}")
        try:
            found.append(footsteps.load(ready.get(name, pathlib.Path(name)), robot, sway))
        except footsteps.ScriptError as error:
            raise config.ConfigError(f"stage {stage.name!r}: {str(error).splitlines()[0]}") from None
        if found[-1].boxes:
            raise config.ConfigError(f"stage {stage.name!r}: script {name!r} has boxes; wanted one on level ground")
    return found


def load(name_or_path: str) -> Curriculum:
    """A curriculum from a TOML file, or by its name from `curricula/`. Raises config.ConfigError in one line."""
    path = pathlib.Path(name_or_path)
    if not path.suffix and not path.is_file():
        folder = paths.data_dir("curricula")
        path = folder / f"{name_or_path}.toml"
        if not path.is_file():
            known = ", ".join(sorted(p.stem for p in folder.glob("*.toml")))
            raise config.ConfigError(f"no curriculum named {name_or_path!r} in curricula/; there are: {known}")
    return config.load(Curriculum, path, _inherited)


def _inherited(data: dict[str, Any]) -> dict[str, Any]:
    """A curriculum's tables with each stage's `control`, `rewards` and `ranges` over the curriculum's own.

    The weights of rewards have no defaults of their own, for terms have none: those of RewardConfig are filled in.
    """
    stages = data.get("stages")
    if not isinstance(stages, list) or not all(isinstance(stage, dict) for stage in stages):
        return data  # config says what is wrong with it
    common: dict[str, Any] = {name: data[name] for name in ("control", "ranges") if name in data}
    common["rewards"] = _over(config.to_dict(RewardConfig()), data.get("rewards", {}))
    own = [{name: _over(common[name], stage[name]) for name in common if name in stage} for stage in stages]
    return data | common | {"stages": [stage | tables for stage, tables in zip(stages, own, strict=True)]}


def _over(common: Any, own: Any) -> Any:
    """`own` over `common`, table by table."""
    if not (isinstance(common, dict) and isinstance(own, dict)):
        return own
    return common | {name: _over(common.get(name), value) for name, value in own.items()}


def of_run(run: RunDirectory) -> tuple[Curriculum, int, int]:
    """The curriculum, the seed and the number of devices that a run was started with.

    Raises RunError or ConfigError where they are damaged.
    """
    settings, file = run.settings, run.path / "run.json"
    if not isinstance(settings, dict) or not isinstance(settings.get("curriculum"), dict):
        raise checkpoint.RunError(f"{file}: is damaged: it has no curriculum; start a new run")
    seed, devices = settings.get("seed"), settings.get("devices", 1)  # before it was written, there was one
    if not isinstance(seed, int) or not isinstance(devices, int):
        name = "devices" if isinstance(seed, int) else "seed"
        raise checkpoint.RunError(f"{file}: is damaged: it has no {name}; start a new run")
    return config.from_dict(Curriculum, settings["curriculum"], str(file)), seed, devices
