"""Every figure of a report stands in its own column, under its heading, as it should be written."""

from typing import Any

import pytest
from reports import Reader, drop, put, summaries

from bipedtrack import report, sheets


def test_the_known_figures_of_a_trace_stand_in_its_row(whole: dict[str, Any]) -> None:
    page = Reader(report.page(whole))
    for engine in range(3):
        row = page.rows("Survival", "walk-forward", "ik")[engine]
        assert row[2].startswith("75.0 [30.1, 95.4]")
        assert row[3:5] == ["2.75", "–"]
        assert row[5:] == ["3.00"] * 4 + ["2.00"] * 4 + ["6.00"] * 4
        assert page.rows("Orientation", "walk-forward", "ik")[engine][2:] == ["2.00"] * 8 + ["0.00"] * 4
        # four footholds, felt 5 control steps late
        row = page.rows("Footholds: errors", "walk-forward", "ik")[engine]
        assert row[2:] == ["4", "0.0"] + ["3.00"] * 4 + ["0.00"] * 3 + ["2.00"] * 3 + ["25"] * 3
        row = page.rows("Footholds: the same", "walk-forward", "ik")[engine]
        assert row[2:] == ["10.0"] * 2 + ["30.0"] * 4 + ["0.0"] * 4 + ["20.0"] * 4
        # every toe is 1 cm below the edge
        assert page.rows("Clearance", "walk-forward", "ik")[engine][2:] == ["4"] + ["-1.00"] * 4 + ["100.0"] * 2
        row = page.rows("Effort", "walk-forward", "ik")[engine]
        assert row[2:] == ["1.00", "0.00", "0.000", "0.000", "1.2"]
    row = page.rows("Rest", "hold-squat", "ik")[0]
    assert row[2:7] == ["4", "2", "0.100", "0.100", "0.100"]
    assert row[-1] == "0.0"


PLACES = (
    ("Survival", 3, "survival.time_to_fall_mean_s", 1.25, "1.25"),
    ("Survival", 4, "survival.time_to_fall_median_s", 2.5, "2.50"),
    ("Survival", 6, "errors.left_ankle_position_cm.median", 7.125, "7.12"),
    ("Survival", 12, "errors.right_ankle_position_cm.max", 71.5, "71.50"),
    ("Survival", 15, "errors.trunk_position_cm.p95", 43.5, "43.50"),
    ("Orientation", 4, "errors.left_ankle_yaw_deg.p95", 8.5, "8.50"),
    ("Orientation", 13, "errors.trunk_orientation_deg.max", 61.5, "61.50"),
    ("Footholds: errors", 3, "touchdown.missed_share", 0.125, "12.5"),
    ("Footholds: errors", 8, "touchdown.height_cm.p5", -1.5, "-1.50"),
    ("Footholds: errors", 15, "touchdown.time_s.mean", -0.0125, "-12"),
    ("Footholds: the same", 4, "touchdown.foothold_per_step.mean", 0.123, "12.3"),
    ("Footholds: the same", 8, "touchdown.height_per_step.mean", 0.045, "4.5"),
    ("Footholds: the same", 12, "touchdown.yaw_deg_per_m.mean", 31.5, "31.5"),
    ("Clearance", 2, "clearance.swings", 17, "17"),
    ("Clearance", 3, "clearance.edge_cm.min", -0.25, "-0.25"),
    ("Clearance", 7, "clearance.below_edge_share", 0.0625, "6.2"),
    ("Clearance", 8, "clearance.side_contact_share", 0.5, "50.0"),
    ("Rest", 4, "rest.joint_speed_rms_rad_per_s.mean", 0.0625, "0.062"),
    ("Rest", 7, "rest.trunk_sway_rms_cm.mean", 0.375, "0.38"),
    ("Rest", 13, "rest.foot_motion_cm.mean", 0.875, "0.88"),
    ("Rest", 16, "rest.foot_moved_share", 0.25, "25.0"),
    ("Effort", 3, "effort.saturation_share", 0.0125, "1.25"),
    ("Effort", 4, "effort.feedback_mean", 0.125, "0.125"),
    ("Effort", 6, "effort.power_w", 111.25, "111.2"),
    ("Means of episodes", 3, "errors.left_ankle_position_cm.episode_mean", 4.5, "4.50 [3.00, 3.00]"),
    ("Means of episodes", 8, "errors.trunk_orientation_deg.episode_high", 9.25, "0.00 [0.00, 9.25]"),
)


@pytest.mark.parametrize(("caption", "column", "path", "value", "written"), PLACES)
def test_a_figure_stands_in_its_own_column_alone(
    record: dict[str, Any], caption: str, column: int, path: str, value: float, written: str
) -> None:
    drop(record, "composite")
    before = Reader(report.page(record)).rows(caption, "composite", "ik")[0]
    at = summaries(record, "composite")["mjx"]
    *parents, last = path.split(".")
    for key in parents:
        at = at[key]
    at[last] = value
    after = Reader(report.page(record)).rows(caption, "composite", "ik")[0]
    assert after[column] == written
    assert [i for i, (x, y) in enumerate(zip(before, after, strict=True)) if x != y] == [column]


def test_columns_stand_under_their_headings(whole: dict[str, Any]) -> None:
    for caption, rows in Reader(report.page(whole)).tables:
        head = [row for row in rows if row[0] in ("Task", "Policy", "Disturbance")]
        assert len(head) == 1, caption
    for sheet in sheets.SHEETS:
        for heading, columns in sheet.groups.items():
            parts = {column.path.rsplit(".", 1)[0] for column in columns}
            assert len(parts) == 1, heading
    nodes = {"left": "Left ankle", "right": "Right ankle", "trunk": "Trunk"}
    for sheet in sheets.SHEETS[:2]:
        for heading, columns in sheet.groups.items():
            if columns[0].path.startswith("errors."):
                assert heading.startswith(nodes[columns[0].path.removeprefix("errors.").split("_")[0]])


def test_the_episodes_of_each_difficulty_stand_in_their_row(whole: dict[str, Any]) -> None:
    page = Reader(report.page(whole))
    for policy in ("best", "ik"):
        rows = page.rows("The same episodes, by their difficulty", "walk-forward", policy)
        assert [row[2:4] for row in rows] == [["0 cm a step", "2"], ["1 cm a step", "2"]]
        # of two robots one falls; the left ankle is 3 cm off, the right one 2 cm
        assert [(row[4].split()[0], row[5], row[7]) for row in rows] == [("50.0", "3.00", "2.00")] * 2


def test_numbers_that_are_not_finite_count_as_missing(record: dict[str, Any]) -> None:
    put(summaries(record, "composite")["mjx"], "effort.power_w", float("nan"))
    assert Reader(report.page(record)).rows("Effort", "composite", "ik")[0][-1] == "–"
