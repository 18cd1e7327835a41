"""The table at the end of a training: rows that a policy of known behaviour must give."""

import dataclasses
import io

import numpy as np
import pytest
import rich.console

from bipedtrack import control, curriculum, evaluation, observation, policy, robot, sampling
from bipedtrack.evaluation import Row

EPISODES, SECONDS = 3, 0.74  # 37 policy steps: too short for inverse kinematics to fall


def plan() -> curriculum.Curriculum:
    """A curriculum of standing, walking and stairs, in whose last stage everything holds at once."""
    smoke = curriculum.load("smoke")
    flat = sampling.Shares(stand=1, squat=0, walk=1, sidle=0, turn=0, stairs=0)
    stages = (
        dataclasses.replace(smoke.stages[0], shares=flat),
        dataclasses.replace(smoke.stages[2], shares=flat._replace(stand=0, stairs=2), hold_after=(0, 0)),
    )
    settings = control.ControlConfig(level_feet=True)
    return dataclasses.replace(smoke, stages=stages, control=settings, episode_seconds=SECONDS)


def tripping() -> policy.Policy:
    """A policy that tips over whoever has a foot in the air and gives no feedback to the others."""
    weight = np.zeros((101, 12), np.float32)
    weight[observation.layout()["timer"], 4::6] = 200.0  # ankle pitch
    weight[observation.layout()["timer"], 2::6] = 200.0  # hip pitch
    network = policy.Network(np.zeros(101, np.float32), np.ones(101, np.float32), (weight,), (np.zeros(12, np.float32),))
    return policy.Policy(network, "swish", control.ControlConfig(level_feet=True), 0.02, robot.load(), {})


@pytest.fixture(scope="module")
def rows(unoptimised: None) -> dict[str, list[Row]]:
    policies = {"inverse kinematics": None, "trained": tripping()}
    return {name: evaluation.by_kind(plan(), which, 0.5, EPISODES, seed=1) for name, which in policies.items()}


def test_there_is_a_row_for_every_kind_of_any_stage_and_for_hold(rows: dict[str, list[Row]]) -> None:
    for table in rows.values():
        assert [row.kind for row in table] == ["stand", "walk", "stairs", "hold"]
        assert all(row.episodes == EPISODES for row in table)


def test_a_policy_that_trips_swinging_robots_fails_in_their_rows_alone(rows: dict[str, list[Row]]) -> None:
    assert [row.survival for row in rows["inverse kinematics"]] == [1, 1, 1, 1]
    stand, walk, stairs, hold = rows["trained"]
    assert (stand.survival, walk.survival, hold.survival) == (1, 0, 1)
    assert stand.seconds == hold.seconds == pytest.approx(SECONDS) and 0.4 < walk.seconds < SECONDS - 0.01
    for before, after in zip(rows["inverse kinematics"][1:3], (walk, stairs), strict=True):
        assert after.trunk_error_deg > 1.2 * before.trunk_error_deg


def test_the_same_seed_gives_every_policy_the_same_episodes(rows: dict[str, list[Row]]) -> None:
    for place in (0, 3):  # where the policy gives no feedback
        alone, trained = (dataclasses.astuple(table[place]) for table in rows.values())
        assert alone[0] == trained[0]
        np.testing.assert_allclose(alone[1:], trained[1:], rtol=0.01, atol=0.005)
        assert min(alone[4:]) > 0


def test_level_ground_counts_every_kind_but_stairs_and_hold_the_same() -> None:
    table = [
        Row("stand", 4, 1.0, 10.0, 2.0, 1.0, 4.0, 3.0),
        Row("walk", 4, 0.25, 4.0, 6.0, 2.0, 8.0, 5.0),
        Row("stairs", 4, 0.0, 1.0, 100.0, 100.0, 100.0, 100.0),
        Row("hold", 4, 0.0, 1.0, 100.0, 100.0, 100.0, 100.0),
    ]
    assert evaluation.level_ground(table) == Row("level ground", 8, 0.625, 7.0, 4.0, 1.5, 6.0, 4.0)


def test_the_printed_table_sets_both_controllers_side_by_side() -> None:
    tables = {
        "inverse kinematics": [Row("walk", 4, 0.25, 1.5, 6.25, 2.0, 8.0, 5.0)],
        "trained": [Row("walk", 4, 0.75, 9.5, 3.25, 1.0, 4.0, 2.5)],
    }
    out = io.StringIO()
    rich.console.Console(file=out, width=120).print(evaluation.comparison(plan(), 0.5, tables))
    lines = out.getvalue().splitlines()
    assert "4 episodes of 0.74 s each, difficulty 0.5" in lines[0]
    alone, trained = (next(line for line in lines if name in line) for name in ("inverse", "trained"))
    for text in ("walk", "25 %", "1.5 s", "6.2 cm", "2.0 deg", "8.0 cm", "5.0 deg"):
        assert text in alone
    for text in ("walk", "75 %", "9.5 s", "3.2 cm", "1.0 deg", "4.0 cm", "2.5 deg"):
        assert text in trained


def test_stairs_alone_are_no_level_ground(rows: dict[str, list[Row]]) -> None:
    assert evaluation.level_ground(rows["trained"][2:]) is None
    flat = evaluation.level_ground(rows["trained"])
    assert flat is not None and flat.survival == 0.5 and flat.episodes == 2 * EPISODES
