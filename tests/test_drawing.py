"""Lines and marks lie where their axes say, in px; ticks are round, and gaps stay gaps."""

import pytest
from reports import Reader, numbers

from bipedtrack import drawing

AXES = drawing.Axes(158, 144, (0.0, 10.0), (-1.0, 1.0))  # an area of 100 x 100 px


@pytest.mark.parametrize(
    ("low", "high", "most", "texts"),
    [
        (0, 10, 5, ["0", "2", "4", "6", "8", "10"]),
        (0, 7, 5, ["0", "2", "4", "6"]),
        (-0.2, 0.2, 5, ["-0.2", "-0.1", "0.0", "0.1", "0.2"]),
        (0, 0.1, 8, ["0.00", "0.02", "0.04", "0.06", "0.08", "0.10"]),
        (0, 104, 5, ["0", "50", "100"]),
    ],
)
def test_ticks_are_round(low: float, high: float, most: int, texts: list[str]) -> None:
    ticks = drawing.ticks(low, high, most)
    assert [text for _, text in ticks] == texts
    assert [value for value, _ in ticks] == pytest.approx([float(text) for text in texts])


def test_axes_put_their_ranges_on_the_area() -> None:
    assert (AXES.x(0), AXES.x(10)) == (AXES.left, AXES.width - AXES.right) == (46, 146)
    assert (AXES.y(1), AXES.y(-1)) == (drawing.TOP, AXES.bottom) == (8, 108)


def test_a_curve_is_broken_where_a_point_is_missing() -> None:
    drawn = drawing.curve(AXES, [0, 5, None, 10, 10], [1, 0, 0, None, -1], "kind")
    assert '<path class="kind" d="M0.0 0.0L50.0 50.0M100.0 100.0"/>' in drawn
    assert drawn.startswith('<svg x="46" y="8" width="100" height="100">')  # which cuts off what lies beyond


def test_an_outline_is_closed() -> None:
    assert 'd="M0.0 100.0L100.0 100.0L100.0 0.0Z"' in drawing.polygon(AXES, [(0, -1), (10, -1), (10, 1)])


def test_the_ground_is_as_high_as_its_share() -> None:
    assert 'd="M0.0 100.0L0.0 0.0L100.0 75.0L100.0 100.0Z"' in drawing.ground(AXES, [0, 5, 10], [1.0, None, 0.25])
    assert drawing.ground(AXES, [0, 10], [None, None]) == ""


def test_dashed_lines_cross_the_area() -> None:
    assert 'd="M46 33.0H146"' in drawing.level(AXES, 0.5, "half")
    assert 'd="M71.0 8V108"' in drawing.upright(AXES, 2.5)


def test_a_whisker_ends_where_the_axis_does() -> None:
    assert Reader(drawing.whisker(AXES, 0, 20, 2.0, 1.0, 3.0)).named("path", "bar")[0]["d"] == "M56.0 20.0H76.0"
    beyond = Reader(drawing.whisker(AXES, 0, 20, 42.0, 5.0, 80.0))
    assert numbers(beyond.named("path", "mark")[0]["transform"] or "") == [146.0, 20.0]
    assert beyond.named("path", "bar")[0]["d"] == "M96.0 20.0H146.0"
    assert beyond.text == ["42"]
    assert Reader(drawing.whisker(AXES, 0, 20, 2.0, None, 3.0)).named("path", "bar") == []
    assert drawing.whisker(AXES, 0, 20, None, None, None) == ""


def test_marks_are_told_apart() -> None:
    marks = {drawing.mark(i, 0, 0) for i in range(30)}
    assert len(marks) == 30


@pytest.mark.parametrize(("x", "y"), [((0.0, 1.0), (0.0, 1.0)), ((0.0, 100.0), (2.0, 3.0))])
def test_to_scale_a_unit_is_a_unit_and_both_ranges_are_in_sight(x: tuple[float, float], y: tuple[float, float]) -> None:
    axes = drawing.to_scale(960, 340, x, y)
    assert axes.x(1) - axes.x(0) == pytest.approx(axes.y(0) - axes.y(1), abs=0.6)  # heights are whole px
    assert axes.y(y[0]) - axes.y(y[1]) <= 340.5
    assert axes.left <= axes.x(x[0]) + 1e-9 and axes.x(x[1]) - 1e-9 <= axes.width - axes.right
    assert axes.x(x[0]) - axes.left == pytest.approx(axes.width - axes.right - axes.x(x[1]))  # in the middle


def test_a_range_has_a_margin_and_a_least_width() -> None:
    assert drawing.range_around([0.0, 100.0], 1.0) == pytest.approx((-4.0, 104.0))
    assert drawing.range_around([3.0, 3.0], 0.4) == pytest.approx((2.8, 3.2))


def test_words_cannot_become_markup() -> None:
    evil = '<b>&"'
    drawn = drawing.svg(AXES, [drawing.grid(AXES, evil, evil), drawing.level(AXES, 0, evil)], evil)
    assert "<b>" not in drawn
    assert Reader(drawn).text.count(evil) == 3


def test_without_a_name_there_is_no_vertical_axis() -> None:
    assert Reader(drawing.grid(AXES, "x", "")).named("text", "end") == []
    assert len(Reader(drawing.grid(AXES, "x", "y")).named("text", "end")) == 5
