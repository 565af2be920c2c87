"""Rulers, cut marks, arrows and text of line drawings."""

from __future__ import annotations

import math

import pytest

from locatk.core.drawing import (
    CUT_MARK_MM,
    RULER_DEPTH_MM,
    Line,
    Polygon,
    Text,
    arrow,
    cross,
    cut_marks,
    line_height,
    page_rulers,
    paragraph,
    rectangle,
    ruler,
    text_width,
    wrap,
)


@pytest.mark.parametrize("upright", [False, True])
def test_a_ruler_has_a_tick_every_mm_and_a_number_every_10_mm(upright: bool) -> None:
    marks = ruler((20.0, 30.0), 40, upright=upright)
    along, across = (1, 0) if upright else (0, 1)
    lines = [mark for mark in marks if isinstance(mark, Line)]
    edge = max(lines, key=lambda line: math.dist(line.start, line.end))
    assert math.dist(edge.start, edge.end) == pytest.approx(40)
    ticks = [line for line in lines if line is not edge]
    start = (20.0, 30.0)[along]
    assert [tick.start[along] - start for tick in ticks] == pytest.approx(range(41))
    lengths = [math.dist(tick.start, tick.end) for tick in ticks]
    assert lengths[0] > lengths[5] > lengths[1] > 0
    texts = [mark for mark in marks if isinstance(mark, Text)]
    assert [text.text for text in texts] == ["0", "10", "20", "30", "40", "mm"]
    for mark, number in zip(texts, range(0, 50, 10), strict=False):
        assert mark.position[along] - start == pytest.approx(number)
    depth = [(20.0, 30.0)[across] - mark.end[across] for mark in ticks]
    assert max(depth) <= RULER_DEPTH_MM


@pytest.mark.parametrize(
    ("size", "lengths"), [((210.0, 297.0), (100, 100)), ((100.0, 60.0), (60, 20))]
)
def test_page_rulers_are_as_long_as_the_page_permits(size, lengths) -> None:
    edges = [
        math.dist(mark.start, mark.end)
        for mark in page_rulers(size, 10.0)
        if isinstance(mark, Line) and math.dist(mark.start, mark.end) > 5
    ]
    assert edges == pytest.approx(lengths)
    assert page_rulers((40.0, 40.0), 10.0) == []


def test_cut_marks_point_to_the_corners_from_outside() -> None:
    marks = cut_marks(10.0, 20.0, 50.0, 80.0)
    assert len(marks) == 8
    for mark in marks:
        corner = min(
            ((x, y) for x in (10.0, 50.0) for y in (20.0, 80.0)),
            key=lambda point: math.dist(point, mark.start),
        )
        assert math.dist(corner, mark.start) == pytest.approx(1.0)
        assert math.dist(corner, mark.end) == pytest.approx(CUT_MARK_MM)
        for point in (mark.start, mark.end):
            assert not (10 <= point[0] <= 50 and 20 <= point[1] <= 80)


def test_an_arrow_ends_at_its_tip() -> None:
    line, head = arrow((0.0, 0.0), (3.0, 4.0), 1.0)
    assert isinstance(line, Line)
    assert isinstance(head, Polygon)
    assert line.end == pytest.approx((2.4, 3.2))
    assert head.corners[0] == (3.0, 4.0)
    assert head.filled


def test_crosses_and_rectangles_are_around_their_points() -> None:
    level, upright = cross((1.0, 2.0), 3.0)
    assert isinstance(level, Line)
    assert isinstance(upright, Line)
    assert (level.start, level.end) == ((-2.0, 2.0), (4.0, 2.0))
    assert (upright.start, upright.end) == ((1.0, -1.0), (1.0, 5.0))
    assert rectangle((1.0, 2.0, 3.0, 4.0)).corners == (
        (1.0, 2.0),
        (3.0, 2.0),
        (3.0, 4.0),
        (1.0, 4.0),
    )


def test_a_paragraph_hangs_from_its_corner() -> None:
    texts = paragraph(["a", "b"], (5.0, 100.0), 7.0, spacing_em=1.5, bold=True)
    step = line_height(7.0, 1.5)
    assert step == pytest.approx(1.5 * 7 * 25.4 / 72)
    assert [text.position for text in texts] == [(5.0, 100.0 - step), (5.0, 100.0 - 2 * step)]
    assert all(text.bold and text.points == 7.0 for text in texts)


def test_wrapped_lines_fit_the_width() -> None:
    lines = wrap("one two three fourteen " + "x" * 60, 7.0, 40.0)
    assert all(text_width(line, 7.0) <= 40.0 for line in lines)
    assert "".join(lines).replace(" ", "") == "onetwothreefourteen" + "x" * 60
