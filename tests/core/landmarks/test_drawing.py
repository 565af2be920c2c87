"""Drawings of landmarks, against the field of the bars and the words of the facts."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from locatk.core.drawing import Circle, Line, Mark, Polygon, Text
from locatk.core.errors import InputError
from locatk.core.landmarks.design.materials import bill, material, patterns
from locatk.core.landmarks.drawing.landmark import (
    bar_outlines,
    card_mm,
    check,
    draw_landmark,
    draw_symbol,
    reach_mm,
)
from locatk.core.landmarks.drawing.plan import nice_scale
from locatk.core.landmarks.drawing.templates import cells_by_code, cells_text
from locatk.core.landmarks.field import landmark_field
from locatk.core.landmarks.landmark import CODE_COUNT, PATTERNS, Geometry, code_of, name, rotated
from locatk.core.landmarks.map.floor import HOLE, FloorMap

OTHER = Geometry(bar_length_m=0.02, bar_width_m=0.004, radius_m=0.0315, sensor_height_m=0.01)


@pytest.mark.parametrize("geometry", [Geometry(), OTHER])
@pytest.mark.parametrize("code", range(CODE_COUNT))
def test_arrows_lead_to_the_poles_at_which_the_field_comes_out(
    geometry: Geometry, code: int
) -> None:
    for bar, (_, south, north, letter) in enumerate(bar_outlines(geometry, code)):
        assert letter == name(code)[bar]
        # Close over a pole face of this bar its own field is the largest.
        poles = 1e-3 * np.array([south, north])
        at_south, at_north = landmark_field(geometry, code, poles, 5e-4)
        assert at_north > 0.05 > -0.05 > at_south


@pytest.mark.parametrize("geometry", [Geometry(), OTHER])
def test_outlines_are_the_bars(geometry: Geometry) -> None:
    length, width, radius = (
        1e3 * side for side in (geometry.bar_length_m, geometry.bar_width_m, geometry.radius_m)
    )
    for bar, (corners, south, north, _) in enumerate(bar_outlines(geometry, 0b0110)):
        sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
        assert sorted(sides) == pytest.approx([width, width, length, length])
        turn = math.radians(90 * bar)
        middle = (radius * math.cos(turn), radius * math.sin(turn))
        assert corners.mean(axis=0) == pytest.approx(middle, abs=1e-9)
        assert np.mean([south, north], axis=0) == pytest.approx(middle, abs=1e-9)
        assert math.dist(south, north) == pytest.approx(length)
        # Tangential: across the line from the landmark's centre.
        assert np.dot(np.subtract(north, south), middle) == pytest.approx(0, abs=1e-9)
        x, y = (corners - np.roll(corners, 1, axis=0)).T
        assert (x * np.roll(y, -1) - y * np.roll(x, -1) > 0).all(), "counter-clockwise"


@pytest.mark.parametrize("quarters", range(4))
def test_a_turned_landmark_is_the_turned_drawing(quarters: int) -> None:
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    turn = np.linalg.matrix_power(turn, quarters)
    for code in range(CODE_COUNT):
        first = bar_outlines(Geometry(), code)
        second = bar_outlines(Geometry(), int(rotated(code, quarters)))
        for bar, (corners, south, north, letter) in enumerate(first):
            other = second[(bar + quarters) % 4]
            assert other[3] == letter
            np.testing.assert_allclose(other[0], corners @ turn.T, atol=1e-9)
            np.testing.assert_allclose(other[1:3], np.array([south, north]) @ turn.T, atol=1e-9)


def places(mark: Mark) -> list[tuple[float, float]]:
    if isinstance(mark, Line):
        return [mark.start, mark.end]
    if isinstance(mark, Polygon):
        return list(mark.corners)
    if isinstance(mark, Circle):
        x, y = mark.centre
        return [(x - mark.radius_mm, y - mark.radius_mm), (x + mark.radius_mm, y + mark.radius_mm)]
    return [mark.position]


@pytest.mark.parametrize("geometry", [Geometry(), OTHER])
def test_a_drawing_stays_within_what_it_says(geometry: Geometry) -> None:
    marks = draw_landmark(geometry, 0b1001, (500.0, 300.0), ("code 9", "NSSN"))
    away = np.array([place for mark in marks for place in places(mark)]) - [500, 300]
    assert reach_mm(geometry) < np.abs(away).max() <= card_mm(geometry)


@pytest.mark.parametrize("code", range(CODE_COUNT))
def test_signs_point_and_are_filled_as_the_bars_lie(code: int) -> None:
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


def test_what_cannot_be_laid_is_refused() -> None:
    good = floor([[1, 2], [3, HOLE]], pitch_m=0.06)
    check(good)
    with pytest.raises(InputError, match="overlap at a pitch of 59 mm"):
        check(replace(good, pitch_m=0.059))
    with pytest.raises(InputError, match="overlap at the landmark's corners"):
        check(replace(good, pitch_m=0.2, geometry=Geometry(bar_length_m=0.041)))
    with pytest.raises(InputError, match="no landmark"):
        check(floor([[HOLE]]))


def test_materials_are_counted() -> None:
    laid = floor([[0, 5, 10, 7], [HOLE, 14, 7, 0]])
    items = {item.part: item for item in bill(laid, spares_percent=10)}
    assert items["bar magnet"].count == 4 * 7
    assert items["bar magnet, spare"].count == 3
    assert "30 x 10 x 5 mm NdFeB N35" in items["bar magnet"].detail
    assert "bar magnet, spare" not in {item.part for item in bill(laid, 0)}
    found = {item.letters: (item.number, item.landmarks, item.codes) for item in patterns(laid)}
    assert found == {
        "NSNS": (1, 2, ((5, 1), (10, 1))),
        "NNNS": (3, 3, ((7, 2), (14, 1))),
        "SSSS": (6, 2, ((0, 2),)),
    }
    with pytest.raises(InputError):
        bill(laid, -1)


@pytest.mark.parametrize(
    ("remanence", "said"),
    [
        (1.2, "NdFeB N35"),
        (1.22, "NdFeB N35 or N38"),
        (1.45, "N52"),
        (0.4, "ferrite"),
        (0.9, "magnet"),
    ],
)
def test_materials_are_named(remanence: float, said: str) -> None:
    assert said in material(remanence)


def test_cells_are_listed_in_short() -> None:
    laid = floor([[3, 5, 3], [5, HOLE, 5]])
    cells = cells_by_code(laid)
    assert list(cells) == [3, 5]
    assert cells_text(cells[3]) == "row 0: 0, 2"
    assert cells_text(cells[5]) == "row 0: 1; row 1: 0, 2"
    assert sum(map(len, cells.values())) == len(laid.cells())


@pytest.mark.parametrize("least", [0.5, 1.0, 4.49, 7.1, 9.2, 26.1, 100.0, 2001.0])
def test_scales_are_round_and_enough(least: float) -> None:
    scale = nice_scale(least)
    assert least <= scale <= 1.3 * least
    assert len(f"{scale:g}".replace(".", "").strip("0")) <= 3


def test_patterns_that_occur_have_the_papers_numbers() -> None:
    laid = floor([[code_of(letters) for letters in PATTERNS]])
    assert [item.letters for item in patterns(laid)] == list(PATTERNS)
