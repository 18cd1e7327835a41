"""The shipped curricula, Table III by hand, the calls that a curriculum becomes, and every refusal with its place."""

import dataclasses
import itertools
import pathlib

import pytest

from bipedtrack import config, curriculum, paths
from bipedtrack.control import ControlConfig
from bipedtrack.curriculum import Curriculum, calls, control_of, load
from bipedtrack.rewards import RewardConfig, Sharpness, Terms
from bipedtrack.robot import Robot
from bipedtrack.sampling import Ranges

MINIMAL = """name = "mine"

[[stages]]
name = "ground"
shares = { stand = 1, squat = 0, walk = 2, sidle = 0, turn = 0, stairs = 0 }
learning_rate = [4e-4, 1e-4]
entropy_cost = [0.01, 0.0]
clipping_epsilon = [0.2, 0.1]
lessons = [
  { name = "short", steps = 103, difficulty = 0.25, parts = 4 },
  { name = "long", steps = 97, difficulty = 1.0, parts = 2 },
]

[[stages]]
name = "hold"
shares = { stand = 1, squat = 1, walk = 1, sidle = 1, turn = 1, stairs = 1 }
learning_rate = [1e-4, 1e-4]
entropy_cost = [0.001, 0.001]
clipping_epsilon = [0.1, 0.1]
hold_share = 0.5
lessons = [{ name = "all", steps = 50, difficulty = 1.0 }]
"""


def loaded(folder: pathlib.Path, text: str) -> Curriculum:
    path = folder / "mine.toml"
    path.write_text(text)
    return load(str(path))


# The curricula that ship


@pytest.mark.parametrize("name", ["best", "quick", "smoke", "paper"])
def test_a_shipped_curriculum_loads_by_name_and_by_path_and_has_the_papers_stages(name: str) -> None:
    plan = load(name)
    assert plan == load(str(paths.data_dir("curricula") / f"{name}.toml"))
    assert plan.name == name
    first, second, third, *more = plan.stages
    assert bool(more) == (name == "best")
    assert first.shares.stairs == 0 and first.hold_share == 0
    assert second.shares.stairs > 0 and second.hold_share == 0
    assert third.hold_share > 0
    assert config.from_dict(Curriculum, config.to_dict(plan), "again") == plan


def test_the_default_reward_leaves_no_shipped_curriculum_without_its_terms() -> None:
    for name in ("best", "quick", "smoke", "paper"):
        weights = load(name).rewards.weights
        assert min(weights) >= 0 and weights.left_ankle_position == weights.right_ankle_position > 0
    assert load("paper").rewards.weights.feedback_rate == 0  # not one of the paper's terms


def test_paper_is_table_iii() -> None:
    plan = load("paper")
    ppo = plan.ppo
    assert ppo.steps_per_update == 20480  # buffer size
    assert ppo.num_envs * ppo.unroll_length // ppo.num_minibatches == 2048  # batch size
    assert ppo.num_epochs == 3 and ppo.gae_lambda == 0.95 and ppo.discount == 0.995
    assert plan.network.actor == (512, 512, 512) and plan.network.critic == (128, 128)
    assert plan.policy_period == 0.005 and plan.episode_length == 2000
    assert [stage.learning_rate for stage in plan.stages] == [(3e-4, 0), (2e-4, 0), (1e-4, 0)]
    assert [stage.entropy_cost[0] for stage in plan.stages] == [0.02, 0.015, 0.007]  # beta
    assert [stage.clipping_epsilon[0] for stage in plan.stages] == [0.2, 0.15, 0.07]  # epsilon
    assert sum(stage.steps for stage in plan.stages) == 300_000_000


def test_paper_follows_the_falling_lines_of_its_stages() -> None:
    made = calls(load("paper"))
    assert all(0 <= call.steps - call.lesson.steps / call.lesson.parts < 0.05 * call.steps for call in made)
    # stage 1: 150 M steps in lessons of 10 M, so the first call's middle is 5 M and its last one's 145 M
    first, last = made[0], [call for call in made if call.stage.name == "level ground"][-1]
    assert first.learning_rate == pytest.approx(3e-4 * 145 / 150) and last.learning_rate == pytest.approx(3e-4 * 5 / 150)
    assert first.entropy_cost == pytest.approx(0.02 * 145 / 150)
    assert last.clipping_epsilon == pytest.approx(0.2 - 0.1 * 145 / 150)
    for one, other in itertools.pairwise(made):
        if one.stage is other.stage and one.lesson is not other.lesson:
            assert other.learning_rate < one.learning_rate and other.entropy_cost < one.entropy_cost
            assert other.clipping_epsilon <= one.clipping_epsilon
            assert other.lesson.difficulty >= one.lesson.difficulty


# Calls


def test_calls_share_the_steps_of_their_lessons(tmp_path: pathlib.Path) -> None:
    # updates of 2 steps: 26 and 25 steps are 13 updates, in two epochs of 7; 49 and 50 are 25, in four of 7
    made = calls(loaded(tmp_path, MINIMAL + "[ppo]\nnum_envs = 2\nunroll_length = 1\nnum_minibatches = 1\n"))
    assert [call.index for call in made] == list(range(7))
    assert [call.lesson.name for call in made] == ["short"] * 4 + ["long"] * 2 + ["all"]
    assert [call.stage.name for call in made] == ["ground"] * 6 + ["hold"]
    assert [call.steps for call in made] == [28, 28, 28, 28, 56, 48, 56]
    assert [call.epochs for call in made] == [2, 2, 2, 2, 4, 3, 4]


def test_a_lesson_may_begin_with_another_noise_in_its_first_part_alone(tmp_path: pathlib.Path) -> None:
    made = calls(loaded(tmp_path, MINIMAL.replace('name = "long",', 'name = "long", noise = 0.2,')))
    assert [call.noise for call in made] == [None] * 4 + [0.2] + [None] * 2
    with pytest.raises(config.ConfigError, match="noise must be positive, not 0"):
        loaded(tmp_path, MINIMAL.replace('name = "long",', 'name = "long", noise = 0,'))


def test_a_lesson_takes_the_value_of_its_middle_on_the_falling_line_of_its_stage(tmp_path: pathlib.Path) -> None:
    made = calls(loaded(tmp_path, MINIMAL))
    # 200 steps in the first stage, 103 of them in its first lesson
    for call, middle in zip(made, [51.5] * 4 + [151.5] * 2, strict=False):
        assert call.learning_rate == pytest.approx(4e-4 - 3e-4 * middle / 200)
        assert call.entropy_cost == pytest.approx(0.01 - 0.01 * middle / 200)
        assert call.clipping_epsilon == pytest.approx(0.2 - 0.1 * middle / 200)
    assert (made[6].learning_rate, made[6].entropy_cost, made[6].clipping_epsilon) == (1e-4, 0.001, 0.1)


def test_a_stage_sets_only_what_differs_from_the_curriculum(tmp_path: pathlib.Path) -> None:
    common = "[ranges]\nperiod = [0.35, 0.5, 0.9]\nlift = [0.05, 0.06, 0.07]\n[rewards.sharpness]\nankle_yaw = 7\n"
    weights = "[rewards.weights]\n" + "".join(f"{term} = 0.25\n" for term in Terms._fields)
    common += "[control]\nfilter = 0.3\n"
    own = "[stages.ranges]\nlift = [0.01, 0.02, 0.03]\n[stages.rewards.weights]\nlive = 2\n[stages.control]\nintegral = 1\n"
    plan = loaded(tmp_path, MINIMAL.replace("[[stages]]", common + weights + "[[stages]]", 1) + own)
    first, second = plan.stages
    assert first.ranges is None and first.rewards is None and first.control is None
    assert control_of(plan, first) == ControlConfig(filter=0.3)
    assert control_of(plan, second) == ControlConfig(filter=0.3, integral=1.0)
    assert second.ranges == Ranges(period=(0.35, 0.5, 0.9), lift=(0.01, 0.02, 0.03))
    assert second.rewards == RewardConfig(Terms(*([0.25] * len(Terms._fields)))._replace(live=2.0), Sharpness(ankle_yaw=7.0))


def test_episode_length_counts_policy_steps(tmp_path: pathlib.Path) -> None:
    assert loaded(tmp_path, "policy_period = 0.02\nepisode_seconds = 10\n" + MINIMAL).episode_length == 500
    assert loaded(tmp_path, "policy_period = 0.005\nepisode_seconds = 0.7\n" + MINIMAL).episode_length == 140


# Refusals


def refused(folder: pathlib.Path, text: str) -> str:
    """The one line, without the file's name, by which a curriculum is refused."""
    with pytest.raises(config.ConfigError) as caught:
        loaded(folder, text)
    line = str(caught.value)
    start = f"{folder / 'mine.toml'}: "
    assert line.startswith(start) and "\n" not in line
    return line.removeprefix(start)


ADDED = [  # what is put in front, and the line it gives
    ("[rewards.weights]\nliv = 1\n", "rewards.weights.liv: unknown key; did you mean 'live'?"),
    ("[rewards.weights]\nlive = -1\n", "rewards: weights.live must not be negative, not -1"),
    ("[rewards.sharpness]\nankle_position = -5\n", "rewards: sharpness.ankle_position must not be negative, not -5"),
    ("[ranges]\nperiod = [0.09, 0.5, 0.7]\n", "ranges: periods must be at least 0.1 s"),
    ("[ranges]\nsquat_period = [0, 1, 1.5]\n", "ranges: periods must be at least 0.1 s"),
    ("[ranges]\nwalk_stp = [0, 0, 0]\n", "ranges.walk_stp: unknown key; did you mean 'walk_step'?"),
    ("[ranges]\nwalk_step = [0, 0]\n", "ranges.walk_step: [0, 0] (list) has the length 2; wanted a list of 3"),
    ("[ranges]\npush = [10, 10, 20]\n", "ranges: push must begin at 0, not 10: impulses are drawn from 0 on"),
    ("[ranges]\nlift = [0.1, 0.05, 0.2]\n", "ranges: lift must be [lowest, mildest, highest], not [0.1, 0.05, 0.2]"),
    (
        "[rewards.sharpness]\nankle_positon = 1\n",
        "rewards.sharpness.ankle_positon: unknown key; did you mean 'ankle_position'?",
    ),
    ("[ppo]\nnum_env = 8\n", "ppo.num_env: unknown key; did you mean 'num_envs'?"),
    ("[ppo]\nnum_envs = 8.0\n", "ppo.num_envs: 8.0 (float) does not fit; wanted an integer"),
    ("[ppo]\nnum_envs = 8\nnum_minibatches = 3\n", "ppo: num_envs (8) must be a multiple of num_minibatches (3)"),
    ("[ppo]\nnum_epochs = 0\n", "ppo: num_envs, unroll_length, num_minibatches and num_epochs must be at least 1"),
    ("[network]\nactor = []\n", "network: actor and critic need at least one hidden layer"),
    ("[network]\nactivation = 'Swish'\n", "network.activation: 'Swish' (string) is not allowed; did you mean 'swish'?"),
    ("[control]\nfilter = 0\n", "control: filter must lie in (0, 1], not 0"),
    ("policy_period = -0.02\n", "policy_period must be positive and no longer than episode_seconds"),
    ("policy_period = 0.02\nepisode_seconds = 0.01\n", "policy_period must be positive and no longer than episode_seconds"),
    (
        "episode_seconds = 12.5\n",
        "episode_seconds (12.5) must be at most 12 in stage 'hold': a staircase down has 30 treads",
    ),
    (
        "episode_seconds = 10\n[ranges]\nperiod = [0.2, 0.3, 0.5]\n",
        "episode_seconds (10) must be at most 6 in stage 'hold': a staircase down has 30 treads",
    ),
    ("evaluation_episodes = -1\n", "evaluation_episodes must not be negative"),
    ("policy_period = nan\n", "policy_period: nan (float) does not fit; wanted a finite number"),
    ("stage = 1\n", "stage: unknown key; did you mean 'stages'?"),
]
CHANGED = [  # what stands there, what shall stand there, and the line it gives
    ("difficulty = 0.25", "difficulty = 1.25", "stages[0].lessons[0]: difficulty must lie in [0, 1], not 1.25"),
    ("difficulty = 0.25", "dificulty = 0.25", "stages[0].lessons[0].dificulty: unknown key; did you mean 'difficulty'?"),
    ("steps = 97, ", "", "stages[0].lessons[1]: missing key without a default; wanted steps (an integer)"),
    ("steps = 97", "steps = 0", "stages[0].lessons[1]: steps and parts must be at least 1"),
    ("parts = 4", "parts = 0", "stages[0].lessons[0]: steps and parts must be at least 1"),
    ("parts = 4", "parts = 4000", "stages[0].lessons[0]: steps and parts must be at least 1, and every part needs a step"),
    ("turn = 0", "turns = 0", "stages[0].shares.turns: unknown key; did you mean 'turn'?"),
    ("stand = 1, squat = 0, walk = 2", "stand = 0, squat = 0, walk = 0", "stages[0].shares: shares must not be negative"),
    ("walk = 2", "walk = -2", "stages[0].shares: shares must not be negative"),
    ("[4e-4, 1e-4]", "4e-4", "stages[0].learning_rate: 0.0004 (float) does not fit; wanted a list of 2"),
    ("[4e-4, 1e-4]", '["4e-4", 0]', "stages[0].learning_rate[0]: '4e-4' (string) does not fit; wanted a finite number"),
    ("hold_share = 0.5", "hold_share = 1.5", "stages[1]: hold_share must lie in [0, 1], not 1.5"),
    (
        "hold_share = 0.5",
        "feedback_error = -1",
        "stages[1]: learning_rate, entropy_cost, clipping_epsilon and feedback_error must",
    ),
    ("hold_share = 0.5", "retries = -1", "stages[1]: retries must not be negative, not -1"),
    (
        "hold_share = 0.5",
        "hold_after = [3, 1]",
        "stages[1]: hold_after must be two growing numbers of task steps, not [3, 1]",
    ),
    ('lessons = [{ name = "all", steps = 50, difficulty = 1.0 }]', "lessons = []", "stages[1]: stage 'hold' has no lessons"),
]


@pytest.mark.parametrize(("added", "wanted"), ADDED)
def test_a_wrong_setting_is_refused_by_its_place(tmp_path: pathlib.Path, added: str, wanted: str) -> None:
    head, stages = MINIMAL.split("\n\n", 1)
    assert refused(tmp_path, f"{head}\n{added}\n{stages}").startswith(wanted)


@pytest.mark.parametrize(("there", "instead", "wanted"), CHANGED)
def test_a_wrong_stage_is_refused_by_its_place(tmp_path: pathlib.Path, there: str, instead: str, wanted: str) -> None:
    assert MINIMAL.count(there) == 1
    assert refused(tmp_path, MINIMAL.replace(there, instead)).startswith(wanted)


def test_a_misspelt_weight_is_refused(tmp_path: pathlib.Path) -> None:
    weights = "".join(f"{name} = 1\n" for name in load("quick").rewards.weights._fields)
    assert loaded(tmp_path, MINIMAL.replace("\n\n", f"\n[rewards.weights]\n{weights}\n", 1)).rewards.weights.live == 1
    text = weights.replace("left_ankle_yaw", "left_ankel_yaw")
    line = refused(tmp_path, MINIMAL.replace("\n\n", f"\n[rewards.weights]\n{text}\n", 1))
    assert line.startswith("rewards.weights.left_ankel_yaw: unknown key; did you mean 'left_ankle_yaw'?")


def test_a_curriculum_without_stages_is_refused(tmp_path: pathlib.Path) -> None:
    assert refused(tmp_path, 'name = "mine"\nstages = []\n') == "a curriculum needs at least one stage"
    assert refused(tmp_path, 'name = "mine"\n').startswith("missing key without a default; wanted stages")


def test_an_unknown_name_lists_the_curricula_there_are() -> None:
    with pytest.raises(config.ConfigError) as caught:
        load("qick")
    line = str(caught.value)
    assert "'qick'" in line and "\n" not in line
    listed = line.rpartition("there are: ")[2].split(", ")
    assert listed == sorted(path.stem for path in paths.data_dir("curricula").glob("*.toml"))
    assert {"paper", "quick", "smoke"} <= set(listed)


def test_a_missing_file_is_refused_by_its_path(tmp_path: pathlib.Path) -> None:
    with pytest.raises(config.ConfigError, match="gone.toml: cannot be read"):
        curriculum.load(str(tmp_path / "gone.toml"))


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (("hopp",), "stage 'ground': no script named 'hopp'; there are: "),
        (("gone.csv",), "stage 'ground': gone.csv: cannot be read"),
        (("hop", "stairs"), "stage 'ground': script 'stairs' has boxes; wanted one on level ground"),
    ],
)
def test_scripts_that_cannot_be_trained_with_are_refused(
    tmp_path: pathlib.Path, robot: Robot, names: tuple[str, ...], words: str
) -> None:
    plan = loaded(tmp_path, MINIMAL)
    ground, hold = plan.stages
    assert curriculum.scripts_of(plan, hold, robot) == []
    stage = dataclasses.replace(ground, scripts=("hop", "kick"), script_share=0.1)
    assert [len(script.steps) > 5 for script in curriculum.scripts_of(plan, stage, robot)] == [True, True]
    with pytest.raises(config.ConfigError) as caught:
        curriculum.scripts_of(plan, dataclasses.replace(stage, scripts=names), robot)
    assert words in str(caught.value) and "\n" not in str(caught.value)
    with pytest.raises(ValueError, match="need each other"):
        dataclasses.replace(ground, scripts=("hop",))


@pytest.mark.parametrize("name", ["best", "paper", "quick", "smoke"])
def test_scripts_of_the_curricula_that_ship_can_be_trained_with(name: str, robot: Robot) -> None:
    plan = load(name)
    for stage in plan.stages:
        assert len(curriculum.scripts_of(plan, stage, robot)) == len(stage.scripts)


def test_a_stages_scripts_sway_as_its_task_steps(tmp_path: pathlib.Path, robot: Robot) -> None:
    plan = loaded(tmp_path, MINIMAL)
    stage = dataclasses.replace(plan.stages[0], scripts=("kick",), script_share=0.1)
    for sway, sways in (((-1.0, 0.0, 1.0), False), ((0.0, 1.0, 2.5), True)):
        ranges = plan.ranges._replace(sway=sway)
        for one in (dataclasses.replace(stage, ranges=ranges), stage):
            script = curriculum.scripts_of(dataclasses.replace(plan, ranges=ranges), one, robot)[0]
            assert any(step.pendulum > 3 for step in script.steps) == sways
