"""What a chart shows lies where the axes say, in px, and is said in words too."""

from typing import Any

import numpy as np
import pytest
from reports import Reader, numbers

from bipedtrack import charts, drawing, verdicts
from bipedtrack.record import Run


def test_an_error_on_the_bound_lies_on_its_line() -> None:
    course = {"time_s": [0.0, 5.0, 10.0], "alive_share": [1.0, 1.0, 0.5], "left_ankle_position_cm": [5.0, None, 5.0]}
    course |= {"trunk_position_cm": [100.0, 100.0, 0.0]}
    drawn = charts.errors_over_time(course, verdicts.POSITION, "walk", 460)
    page = Reader(drawn)
    limit = numbers(page.named("path", "limit")[0]["d"] or "")[1]
    left = page.named("path", "left")[0]["d"] or ""
    assert left.count("M") == 2  # broken where a figure is missing
    assert numbers(left)[1] + drawing.TOP == pytest.approx(limit, abs=0.06)
    assert numbers(left)[3] + drawing.TOP == pytest.approx(limit, abs=0.06)
    axes = drawing.Axes(460, 220, (0, 10), (0, 30))
    assert limit == pytest.approx(axes.y(5.0), abs=0.06)  # higher ones are cut off at 30, and said to be
    assert "up to 100 cm" in page.text
    assert "left 5.00" in drawn and "highest is 100" in drawn
    # all are up to the middle, half of them at the end
    assert numbers(page.named("path", "up")[0]["d"] or "")[3:8:2] == [0.0, 0.0, pytest.approx((axes.bottom - 8) / 2)]


def test_seen_from_above_a_metre_is_a_metre() -> None:
    path = {"target": {"left": [[0, 0, 0], [1, 0, 0], [1, 0.5, 0]]}, "measured": {"left": [[0, 0, 0], [1, 0, 0.2]]}}
    box = [0.5, 0.1, 0.15, 0.2, 0.1, 0.3, np.pi / 2]
    sunk = [0.2, 0.1, -0.5, 0.2, 0.1, 0.3, 0.0]
    run = Run("walk", "ik", "ik", "mjx", {"summary": {}, "path": path}, [box, sunk])
    page = Reader("".join(charts.views(run)))
    side, top = (numbers(names["d"] or "") for names in page.named("path", "target"))
    assert top[2] - top[0] == pytest.approx(2 * (top[3] - top[5]), abs=0.5)
    assert side[1] == side[3] == side[5]
    assert side[2] - side[0] == pytest.approx((960 - 46 - 12) / 1.08, abs=0.5)  # the way fills the side view
    side, top = (numbers(names["d"] or "") for names in page.named("path", "box"))
    metre = (max(top[1::2]) - min(top[1::2])) / 0.2
    assert max(top[::2]) - min(top[::2]) == pytest.approx(0.1 * metre, abs=0.5)  # turned by a quarter


def test_without_points_there_is_no_view() -> None:
    run = Run("walk", "ik", "ik", "mjx", {"summary": {}, "path": {"target": {"left": []}, "measured": {}}}, [])
    assert charts.views(run) == []


def summary(share: float, cm: float | None) -> dict[str, Any]:
    """Episodes without a fall, and the mean of both ankles' errors with an interval 2 cm wide."""
    ends = {"episode_low": None, "episode_high": None} if cm is None else {"episode_low": cm - 1, "episode_high": cm + 1}
    errors = dict.fromkeys(("left_ankle_position_cm", "right_ankle_position_cm"), {"episode_mean": cm, **ends})
    return {"survival": {"share": share, "share_low": share / 2, "share_high": 1.0}, "errors": errors}


def record(*summaries: dict[str, Any]) -> dict[str, Any]:
    """Policies 0, 1, ... that have walked."""
    results = {str(i): {"mjx": {"summary": one}} for i, one in enumerate(summaries)}
    return {"tasks": {"walk": {"policies": results}}}


def test_estimates_are_those_of_the_summary() -> None:
    assert charts.lasting(summary(0.5, 3.0)) == (50.0, 25.0, 100.0)
    assert charts.ankles(verdicts.POSITION)(summary(0.5, 3.0)) == (3.0, 2.0, 4.0)
    assert charts.ankles(verdicts.POSITION)(summary(0.5, None)) == (None, None, None)
    assert charts.ankles(verdicts.POSITION)(summary(0.49, 3.0)) == (None, None, None)  # more than half of them fall


def test_policies_stand_below_each_other_on_one_axis() -> None:
    found = record(summary(1.0, 2.5), summary(1.0, 5.0), summary(1.0, 100.0), summary(1.0, None))
    drawn = Reader(charts.forest(found, "Error", charts.ankles(verdicts.POSITION), 5.0))
    places = [numbers(names["transform"] or "") for names in drawn.named("path", "mark")]
    limit = numbers(drawn.named("path", "limit")[0]["d"] or "")[0]
    assert len(places) == 3  # the last has no figure
    assert places[1][0] == limit
    assert places[0][0] - 122 == pytest.approx((limit - 122) / 2, abs=0.06)
    assert places[2][0] == 360 - 34 and "100" in drawn.text  # at the end of the axis, and said to be beyond
    assert [y for _, y in places] == [places[0][1] + 13 * i for i in range(3)]


def test_a_curve_over_levels_stops_where_its_axis_does() -> None:
    rows = ((0.0, 1.0, 5.0), (10.0, 1.0, 500.0), (20.0, 0.02, 3.0))  # who falls at once is not off for long
    levels = [{"level": level, **summary(share, cm)} for level, share, cm in rows]
    drawn = Reader(
        charts.ladder({0: {"levels": levels}}, "push", "Error, cm", charts.ankles(verdicts.POSITION), verdicts.POSITION)
    )
    (place,) = (numbers(names["transform"] or "") for names in drawn.named("path", "mark"))
    assert place[1] == numbers(drawn.named("path", "limit")[0]["d"] or "")[1]
    (label,) = (names["aria-label"] for tag, names in drawn.tags if "aria-label" in names)
    assert label == "Error, cm, over push: 0: 5.00; 10: 500.00; 20: –"


def test_the_key_has_the_mark_of_each_policy_by_its_label() -> None:
    text = charts.policy_key(record(summary(1.0, 1.0), summary(1.0, 1.0)) | {"policies": {"<u>": {}}})
    drawn = Reader(text)
    assert [words.strip() for words in drawn.text if words.strip()] == ["<u>", "0", "1"]
    assert [names["class"] for names in drawn.named("path", "mark")] == ["p0 mark", "p1 mark", "p2 mark"]
