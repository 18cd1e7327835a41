"""Strict loading: what is right round-trips, what is wrong is one line with the place and the remedy."""

import dataclasses
import json
import os
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bipedtrack.config import ConfigError, from_dict, load, to_dict


class Reward(NamedTuple):
    ankle: float
    alive: float = 0.5

    def validate(self) -> None:
        if self.ankle < 0:
            raise ValueError(f"ankle is {self.ankle}; wanted at least 0")


@dataclass(frozen=True)
class Lesson:
    difficulty: float
    steps: int
    kinds: tuple[Literal["stand", "walk", "turn"], ...] = ("stand",)
    step: tuple[float, float] = (-0.1, 0.2)

    def __post_init__(self) -> None:
        if self.step[0] > self.step[1]:
            raise ValueError(f"step is {list(self.step)}; wanted [low, high]")


@dataclass(frozen=True)
class Stage:
    name: str
    lessons: tuple[Lesson, ...]
    reward: Reward = Reward(1.0)


@dataclass(frozen=True)
class Curriculum:
    seed: int
    stages: tuple[Stage, ...]
    filtered: bool = True
    note: str | None = None
    layers: tuple[int, ...] = field(default_factory=lambda: (512, 512, 512))


GOOD = """
seed = 3
[[stages]]
name = "level"
reward = { ankle = 2 }
[[stages.lessons]]
difficulty = 1
steps = 1_000
kinds = ["walk", "turn"]
step = [-0.15, 0.25]
[[stages.lessons]]
difficulty = 0.5
steps = 10
[[stages]]
name = "stairs"
lessons = []
"""

EXPECTED = Curriculum(
    seed=3,
    stages=(
        Stage(
            name="level",
            lessons=(Lesson(1.0, 1000, ("walk", "turn"), (-0.15, 0.25)), Lesson(0.5, 10)),
            reward=Reward(ankle=2.0, alive=0.5),
        ),
        Stage(name="stairs", lessons=()),
    ),
)


def message(tmp_path, text, cls=Curriculum):
    """The one line that loading `text` fails with, without the name of the file."""
    path = tmp_path / "c.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ConfigError) as info:
        load(cls, path)
    line = str(info.value)
    assert line.isprintable() and line.startswith(f"{path}: ")
    return line.removeprefix(f"{path}: ")


def test_loads_nested_tables_into_their_classes(tmp_path):
    path = tmp_path / "c.toml"
    for encoding in ("utf-8", "utf-8-sig"):
        path.write_text(GOOD, encoding)
        config = load(Curriculum, path)
        assert config == EXPECTED
        assert type(config.stages[0].reward) is Reward
        assert type(config.stages[0].lessons[0].difficulty) is float  # written as an integer


def test_every_change_of_a_key_is_noticed(tmp_path):
    """Misspelling any one key of the good file, in any of its places, fails and names that key."""
    keys = ["seed", "stages", "name", "reward", "ankle", "lessons", "difficulty", "steps", "kinds", "step"]
    for key in keys:
        wrong = f"{key[:2]}x{key[2:]}"
        text = message(tmp_path, GOOD.replace(f"{key} =", f"{wrong} =").replace(f"{key}]", f"{wrong}]"))
        assert wrong in text and "unknown key; did you mean" in text and repr(key) in text


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (
            "difficulty = 0.5",
            "dificulty = 0.5",
            "stages[0].lessons[1].dificulty: unknown key; did you mean 'difficulty'?",
        ),
        ("difficulty = 0.5", "DIFICULTY = 0.5", "did you mean 'difficulty'?"),
        (
            "difficulty = 0.5",
            "gamma = 0.5",
            "stages[0].lessons[1].gamma: unknown key; wanted difficulty, steps, kinds, step",
        ),
        ("ankle = 2", '"a\\nb" = 2', "stages[0].reward.'a\\nb': unknown key; wanted ankle, alive"),
        ("seed = 3", "", "missing key without a default; wanted seed (an integer)"),
        (
            "steps = 10\n",
            "",
            "stages[0].lessons[1]: missing key without a default; wanted steps (an integer)",
        ),
        (
            "difficulty = 0.5\nsteps = 10\n",
            "",
            "missing keys without a default; wanted difficulty (a finite number), steps (an integer)",
        ),
        ("seed = 3", "seed = 3.0", "seed: 3.0 (float) does not fit; wanted an integer"),
        ("seed = 3", "seed = true", "seed: True (boolean) does not fit; wanted an integer"),
        ("seed = 3", 'seed = "3"', "seed: '3' (string) does not fit; wanted an integer"),
        ("seed = 3", "seed = 2024-01-01", "seed: datetime.date(2024, 1, 1) (date) does not fit"),
        ("seed = 3", f"seed = {2**63}", "seed: an integer of 64 bits does not fit"),
        ("difficulty = 0.5", f"difficulty = 0x{'f' * 5000}", "an integer of 20000 bits does not fit"),
        ("difficulty = 0.5", "difficulty = true", "lessons[1].difficulty: True (boolean) does not fit"),
        ("difficulty = 0.5", "difficulty = nan", "nan (float) does not fit; wanted a finite number"),
        ("difficulty = 0.5", "difficulty = -inf", "-inf (float) does not fit; wanted a finite number"),
        ("seed = 3", "seed = 3\nfiltered = 1", "filtered: 1 (integer) does not fit; wanted true or false"),
        ('name = "level"', "name = 5", "stages[0].name: 5 (integer) does not fit; wanted a string"),
        (
            '"walk", "turn"',
            '"walk", "trun"',
            "stages[0].lessons[0].kinds[1]: 'trun' (string) is not allowed; did you mean 'turn'?",
        ),
        ('"walk", "turn"', '"fly"', "kinds[0]: 'fly' (string) is not allowed; wanted one of 'stand', 'walk'"),
        (
            "[-0.15, 0.25]",
            "[0.25]",
            "step: [0.25] (list) has the length 1; wanted a list of 2 (a finite number, a finite number)",
        ),
        ("[-0.15, 0.25]", "0.25", "step: 0.25 (float) does not fit; wanted a list of 2"),
        ("[-0.15, 0.25]", '[-0.15, "x"]', "step[1]: 'x' (string) does not fit; wanted a finite number"),
        ("[-0.15, 0.25]", "[0.25, -0.15]", "stages[0].lessons[0]: step is [0.25, -0.15]; wanted [low, high]"),
        ("ankle = 2", "ankle = -2", "stages[0].reward: ankle is -2.0; wanted at least 0"),
        ("{ ankle = 2 }", "2", "stages[0].reward: 2 (integer) does not fit; wanted a table of ankle, alive"),
        ("lessons = []", "lessons = [1]", "stages[1].lessons[0]: 1 (integer) does not fit; wanted a table"),
        ("lessons = []", "lessons = {}", "stages[1].lessons: {} (table) does not fit; wanted a list"),
        ("seed = 3", "seed = 3 3", "is not valid TOML: "),
        ("seed = 3", "\nseed = 3 3", "(at line 3, column"),
        ("lessons = []", "lessons = [", "at line 17, the end of the file"),
        ("lessons = []", f"lessons = {'[' * 5000}", "is not valid TOML"),
        ("seed = 3", f"seed = {'9' * 5000}", "is not valid TOML"),
        ("seed = 3", "seed = 3\nseed = 3", "is not valid TOML"),
    ],
)
def test_says_what_is_wrong_where_and_what_would_be_right(tmp_path, old, new, expected):
    assert GOOD.count(old) == 1
    assert expected in message(tmp_path, GOOD.replace(old, new))


def test_files_that_cannot_be_read_are_one_line(tmp_path):
    assert message(tmp_path, b"a = 1\n# \xff") == "line 2 is not UTF-8 (byte 0xff); save it as UTF-8"
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    for path in (tmp_path / "none.toml", tmp_path, tmp_path / "c.toml" / "x", loop):
        with pytest.raises(ConfigError, match="cannot be read .*; wanted a TOML file") as info:
            load(Curriculum, path)
        assert str(path) in str(info.value) and "\n" not in str(info.value)


def test_a_multi_line_complaint_of_a_class_becomes_one_line():
    @dataclass(frozen=True)
    class Talkative:
        def __post_init__(self) -> None:
            raise ValueError("one\n  two")

    with pytest.raises(ConfigError, match="^here: one two$"):
        from_dict(Talkative, {}, "here")


def test_classes_that_toml_cannot_describe_are_the_programmers_error():
    @dataclass(frozen=True)
    class Mapped:
        a: dict[str, int]

    @dataclass(frozen=True)
    class Unwritable:
        a: int | None = 3

    for cls in (Mapped, Unwritable):
        with pytest.raises(TypeError):
            from_dict(cls, {"a": 1}, "here")


def test_an_optional_field_without_default_may_be_left_out():
    @dataclass(frozen=True)
    class Ranged:
        a: tuple[int, int] | None
        b: None | int = None

    assert from_dict(Ranged, {}, "") == Ranged(None)
    assert from_dict(Ranged, {"a": [1, 2], "b": 3}, "") == Ranged((1, 2), 3)
    assert to_dict(Ranged(None)) == {}


def test_what_a_class_computes_is_no_key():
    @dataclass(frozen=True)
    class Computed:
        a: int
        b: int = field(default=0, init=False)

    assert from_dict(Computed, {"a": 1}, "") == Computed(1) and to_dict(Computed(1)) == {"a": 1}
    with pytest.raises(ConfigError, match="here: b: unknown key; wanted a$"):
        from_dict(Computed, {"a": 1, "b": 1}, "here")


def test_a_literal_takes_values_of_its_own_type():
    @dataclass(frozen=True)
    class Chosen:
        order: Literal[1, 4]

    assert from_dict(Chosen, {"order": 4}, "") == Chosen(4)
    for value in (True, 1.0, "1", [1]):
        with pytest.raises(ConfigError, match="order: .* is not allowed; wanted one of 1, 4"):
            from_dict(Chosen, {"order": value}, "here")


numbers = st.floats(allow_nan=False, allow_infinity=False)
integers = st.integers(-(2**63), 2**63 - 1)
ranges = st.tuples(numbers, numbers).map(lambda pair: tuple(sorted(pair)))
kinds = st.lists(st.sampled_from(["stand", "walk", "turn"])).map(tuple)
lessons = st.builds(Lesson, numbers, integers, kinds, ranges)
rewards = st.builds(Reward, st.floats(0, 1e300), numbers)
stages = st.builds(Stage, st.text(), st.lists(lessons, max_size=3).map(tuple), rewards)
curricula = st.builds(
    Curriculum,
    integers,
    st.lists(stages, max_size=3).map(tuple),
    st.booleans(),
    st.none() | st.text(),
    st.lists(integers, max_size=3).map(tuple),
)


@given(curricula)
def test_a_config_survives_dict_and_json(config):
    data = to_dict(config)
    assert from_dict(Curriculum, data, "") == config
    assert from_dict(Curriculum, json.loads(json.dumps(data)), "") == config


def test_to_dict_spells_out_every_default():
    data = to_dict(EXPECTED)
    assert data["stages"][1] == {"name": "stairs", "lessons": [], "reward": {"ankle": 1.0, "alive": 0.5}}
    assert set(data) == {f.name for f in dataclasses.fields(Curriculum)} - {"note"}


anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.sampled_from(["seed", "stages", "name", "x"]), inner),
)


@given(anything)
def test_whatever_the_data_it_loads_or_is_a_config_error_of_one_line(data):
    try:
        config = from_dict(Curriculum, data, "here")
    except ConfigError as error:
        assert len(str(error).splitlines()) == 1
    else:
        assert isinstance(config, Curriculum)


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may read everything")
def test_a_file_without_permission_is_one_line(tmp_path):
    path = tmp_path / "c.toml"
    path.write_text(GOOD)
    path.chmod(0)
    with pytest.raises(ConfigError, match="Permission denied"):
        load(Curriculum, path)
