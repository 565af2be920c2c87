"""Drawings of landmarks, against the field of the bars and the words of the facts."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from reportlab.pdfbase.pdfmetrics import stringWidth

from locatk.core.drawing import Circle, Line, Mark, Polygon, Text
from locatk.core.drawing.scale import round_scale
from locatk.core.errors import InputError
from locatk.core.landmarks.drawing.landmark import (
    bar_outlines,
    bars_half_side,
    check_buildable,
    draw_landmark,
    draw_symbol,
    drawing_half_side,
)
from locatk.core.landmarks.drawing.legend import draw_legend, legend_height
from locatk.core.landmarks.drawing.templates import cells_by_code, cells_text
from locatk.core.landmarks.field import landmark_field
from locatk.core.landmarks.landmark import CODE_COUNT, Geometry, name, rotated
from locatk.core.landmarks.map.floor import HOLE_CODE, FloorMap

OTHER = Geometry(bar_length_m=0.02, bar_width_m=0.004, radius_m=0.0315, sensor_height_m=0.01)


@pytest.mark.parametrize("geometry", [Geometry(), OTHER])
@pytest.mark.parametrize("code", range(CODE_COUNT))
def test_arrows_point_to_the_poles_at_which_the_field_emerges(
    geometry: Geometry, code: int
) -> None:
    for number, bar in enumerate(bar_outlines(geometry, code)):
        assert bar.letter == name(code)[number]
        # Close over a pole face of this bar its own field is the largest.
        poles = 1e-3 * np.array([bar.south, bar.north])
        at_south, at_north = landmark_field(geometry, code, poles, 5e-4)
        assert at_north > 0.05 > -0.05 > at_south


@pytest.mark.parametrize("geometry", [Geometry(), OTHER])
def test_outlines_are_the_bars(geometry: Geometry) -> None:
    length, width, radius = (
        1e3 * side for side in (geometry.bar_length_m, geometry.bar_width_m, geometry.radius_m)
    )
    for number, bar in enumerate(bar_outlines(geometry, 0b0110)):
        corners, south, north = bar.corners, bar.south, bar.north
        sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
        assert sorted(sides) == pytest.approx([width, width, length, length])
        direction = math.radians(90 * number)
        centre = (radius * math.cos(direction), radius * math.sin(direction))
        assert corners.mean(axis=0) == pytest.approx(centre, abs=1e-9)
        assert np.mean([south, north], axis=0) == pytest.approx(centre, abs=1e-9)
        assert math.dist(south, north) == pytest.approx(length)
        # Tangential: across the line from the landmark's centre.
        assert np.dot(np.subtract(north, south), centre) == pytest.approx(0, abs=1e-9)
        x, y = (corners - np.roll(corners, 1, axis=0)).T
        assert (x * np.roll(y, -1) - y * np.roll(x, -1) > 0).all(), "counter-clockwise"


@pytest.mark.parametrize("quarters", range(4))
def test_a_rotated_landmark_is_the_rotated_drawing(quarters: int) -> None:
    rotation = np.linalg.matrix_power(np.array([[0.0, -1.0], [1.0, 0.0]]), quarters)
    for code in range(CODE_COUNT):
        first = bar_outlines(Geometry(), code)
        second = bar_outlines(Geometry(), int(rotated(code, quarters)))
        for number, bar in enumerate(first):
            other = second[(number + quarters) % 4]
            assert other.letter == bar.letter
            np.testing.assert_allclose(other.corners, bar.corners @ rotation.T, atol=1e-9)
            np.testing.assert_allclose(other.south, rotation @ bar.south, atol=1e-9)
            np.testing.assert_allclose(other.north, rotation @ bar.north, atol=1e-9)


def positions(mark: Mark) -> list[tuple[float, float]]:
    if isinstance(mark, Line):
        return [mark.start, mark.end]
    if isinstance(mark, Polygon):
        return list(mark.corners)
    if isinstance(mark, Circle):
        x, y = mark.centre
        return [(x - mark.radius_mm, y - mark.radius_mm), (x + mark.radius_mm, y + mark.radius_mm)]
    return [mark.position]


@pytest.mark.parametrize("geometry", [Geometry(), OTHER])
def test_a_drawing_stays_within_its_half_side(geometry: Geometry) -> None:
    marks = draw_landmark(geometry, 0b1001, (500.0, 300.0), ("code 9", "NSSN"))
    away = np.array([position for mark in marks for position in positions(mark)]) - [500, 300]
    assert bars_half_side(geometry) < np.abs(away).max() <= drawing_half_side(geometry)


@pytest.mark.parametrize("code", range(CODE_COUNT))
def test_symbols_point_to_north_and_are_filled_if_counter_clockwise(code: int) -> None:
    marks = draw_symbol(code, (10.0, 20.0), 8.0)
    bars = [mark for mark in marks if isinstance(mark, Polygon)]
    words = [mark.text for mark in marks if isinstance(mark, Text)]
    assert words == [f"{code:x}"]
    for number, (bar, letter) in enumerate(zip(bars, name(code), strict=True)):
        assert bar.filled == (letter == "N")
        corners = np.array(bar.corners) - [10, 20]
        turn = math.radians(90 * number)
        outward = np.array([math.cos(turn), math.sin(turn)])
        across = corners @ outward
        assert across.min() > 1.0, "on its own side of the landmark"
        # The tip is the one corner on the bar's middle line.
        tip = int(np.argmin(np.abs(across - (across.min() + across.max()) / 2)))
        along = corners @ [-outward[1], outward[0]]
        assert along[tip] == (along.max() if letter == "N" else along.min())


def floor(codes: list[list[int]], **more: object) -> FloorMap:
    return replace(FloorMap(np.array(codes)), **more)  # type: ignore[arg-type]


def test_floors_that_cannot_be_built_are_rejected() -> None:
    good = floor([[1, 2], [3, HOLE_CODE]], pitch_m=0.06)
    check_buildable(good)
    with pytest.raises(InputError, match="overlap at a pitch of 59 mm"):
        check_buildable(replace(good, pitch_m=0.059))
    with pytest.raises(InputError, match="overlap at the landmark's corners"):
        check_buildable(replace(good, pitch_m=0.2, geometry=Geometry(bar_length_m=0.041)))
    with pytest.raises(InputError, match="no landmark"):
        check_buildable(floor([[HOLE_CODE]]))


def test_cells_are_listed_in_short() -> None:
    floor_map = floor([[3, 5, 3], [5, HOLE_CODE, 5]])
    cells = cells_by_code(floor_map)
    assert list(cells) == [3, 5]
    assert cells_text(cells[3]) == "row 0: 0, 2"
    assert cells_text(cells[5]) == "row 0: 1; row 1: 0, 2"
    assert sum(map(len, cells.values())) == len(floor_map.cells())


@pytest.mark.parametrize("least", [0.5, 1.0, 4.49, 7.1, 9.2, 26.1, 100.0, 2001.0])
def test_scales_are_round_and_enough(least: float) -> None:
    scale = round_scale(least)
    assert least <= scale <= 1.3 * least
    assert len(f"{scale:g}".replace(".", "").strip("0")) <= 3


def text_box(text: Text) -> np.ndarray:
    """Left, bottom, right and top in the font of the PDF, from its own metrics."""
    font = "Helvetica-Bold" if text.bold else "Helvetica"
    width = stringWidth(text.text, font, text.points) * 25.4 / 72
    left = text.position[0] - {"start": 0, "middle": 0.5, "end": 1}[text.anchor] * width
    height = 0.72 * text.points * 25.4 / 72
    return np.array([left, text.position[1], left + width, text.position[1] + height])


@pytest.mark.parametrize("width", [79.0, 111.0, 122.0, 184.0, 270.0, 900.0])
@pytest.mark.parametrize("window", ["L", "3x3"])
def test_nothing_overlaps_in_a_legend(width: float, window: str) -> None:
    """On paper from A6 on; the smallest one was drawn for A4, and overlapped on A5."""
    scale = 12.5
    marks = draw_legend(floor([[1, 2], [3, 5]], window=window), scale, (7.0, 9.0), width)
    texts = [mark for mark in marks if isinstance(mark, Text)]
    boxes = np.array([text_box(mark) for mark in texts])
    assert boxes.min(axis=0)[:2] == pytest.approx([7, 10], abs=1.5)
    assert boxes[:, 2].max() <= 7 + width
    assert boxes[:, 3].max() <= 9 + legend_height(width)
    for mark, box in zip(texts, boxes, strict=True):
        touched = (boxes[:, :2] < box[2:]).all(axis=1) & (boxes[:, 2:] > box[:2]).all(axis=1)
        assert [texts[n] for n in np.flatnonzero(touched)] == [mark]
    # No drawing reaches into the explanations, which are the lines that are not bold.
    for text, box in zip(texts, boxes, strict=True):
        if text.bold or len(text.text) < 6:
            continue
        for mark in marks:
            if not isinstance(mark, Text):
                corners = np.array(positions(mark))
                is_apart = (corners.max(axis=0) < box[:2]) | (corners.min(axis=0) > box[2:])
                assert is_apart.any(), (text, mark)


def test_no_legend_fits_on_a_strip() -> None:
    assert legend_height(70.0) == math.inf
