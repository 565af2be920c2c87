"""map.toml and halls.toml: exact round trips, and strict checks of edited maps."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.landmarks.halls import HallSensors, circle
from locatk.core.landmarks.landmark import Geometry, name
from locatk.core.landmarks.map.floor import ALPHABETS, HOLE_CODE, WINDOWS, AsBuiltLandmark, FloorMap
from locatk.formats.artifacts import maps
from locatk.formats.artifacts.maps import (
    COMPASS_CODES,
    dumps_halls,
    dumps_map,
    loads_halls,
    loads_map,
)

# ---- round trips

above = st.floats(1e-6, 1e3)


@st.composite
def geometries(draw: st.DrawFn) -> Geometry:
    """Geometries whose bars do not overlap."""
    length, width = draw(above), draw(above)
    return Geometry(
        length,
        width,
        draw(above),
        draw(st.floats(1e-3, 2)),
        (length + width) / 2 * draw(st.floats(1, 3)) + 1e-9,
        draw(above),
        draw(above),
        draw(above),
    )


@st.composite
def grids(draw: st.DrawFn, letters: list[int]) -> np.ndarray:
    """Codes with holes; at least one landmark."""
    rows, columns = draw(st.integers(1, 5)), draw(st.integers(1, 5))
    cells = st.sampled_from([HOLE_CODE, *letters])
    values = draw(st.lists(cells, min_size=rows * columns, max_size=rows * columns))
    values[draw(st.integers(0, len(values) - 1))] = draw(st.sampled_from(letters))
    return np.array(values, np.int64).reshape(rows, columns)


@st.composite
def builts(draw: st.DrawFn, pitch: float) -> AsBuiltLandmark:
    """Landmarks as built."""
    near = st.floats(-pitch / 2, pitch / 2)
    sigma = st.floats(0, 10) | st.just(math.nan)
    return AsBuiltLandmark(
        draw(near),
        draw(near),
        draw(st.floats(-math.pi, math.pi)),
        np.array(draw(st.lists(st.floats(-3, 3), min_size=4, max_size=4))),
        np.array(draw(st.lists(sigma, min_size=7, max_size=7))),
        draw(st.integers(0, 99)),
        tuple(draw(st.lists(st.sampled_from(["flipped:2", "weak:0", "displaced"]), max_size=2))),
    )


@st.composite
def floors(draw: st.DrawFn) -> FloorMap:
    """Any map."""
    geometry = draw(geometries())
    pitch = (2 * geometry.radius_m + geometry.bar_width_m) * draw(st.floats(1, 3)) + 1e-9
    alphabet = draw(st.sampled_from(ALPHABETS))
    codes = draw(grids(sorted(COMPASS_CODES) if alphabet == "compass" else list(range(16))))
    everywhere = [(r, c) for r in range(codes.shape[0]) for c in range(codes.shape[1])]
    pairs = [((r, c), (r + dr, c + dc)) for r, c in everywhere for dr, dc in ((0, 1), (1, 0))]
    pairs = [pair for pair in pairs if pair[1] in everywhere]
    laid = [cell for cell in everywhere if codes[cell] != HOLE_CODE]
    far = st.floats(-1e4, 1e4)
    return FloorMap(
        codes,
        pitch,
        alphabet,
        draw(st.sampled_from(WINDOWS)),
        draw(st.integers(0, 8)),
        geometry,
        (draw(far), draw(far)),
        draw(st.frozensets(st.sampled_from(pairs), max_size=4)) if pairs else frozenset(),
        dict(
            sorted(draw(st.dictionaries(st.sampled_from(laid), builts(pitch), max_size=2)).items())
        ),
        draw(st.text(max_size=20)),
        draw(st.none() | st.integers(0, 2**63 - 1)),
        tuple(draw(st.lists(st.text(max_size=20), max_size=2))),
    )


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(floors())
def test_every_map_comes_back_to_the_last_bit(floor: FloorMap) -> None:
    text = dumps_map(floor)
    read = loads_map(text)
    with np.printoptions(floatmode="unique", precision=None):
        # tells -0.0 from 0.0; a set has no order
        assert repr(read).replace(repr(read.walls), "") == repr(floor).replace(
            repr(floor.walls), ""
        )
    assert read.walls == floor.walls
    assert dumps_map(read) == text


@st.composite
def sensors(draw: st.DrawFn) -> HallSensors:
    names = draw(st.lists(st.text(min_size=1, max_size=8), min_size=1, max_size=6, unique=True))
    finite = st.floats(-1e3, 1e3)
    places = st.lists(
        st.tuples(finite, finite), min_size=len(names), max_size=len(names), unique=True
    )
    return HallSensors(
        tuple(names),
        np.array(draw(places)),
        draw(above | st.just(math.nan)),
        draw(above | st.just(math.inf)),
        draw(st.text(max_size=20)),
    )


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(sensors())
def test_all_halls_come_back_to_the_last_bit(halls: HallSensors) -> None:
    text = dumps_halls(halls)
    read = loads_halls(text)
    with np.printoptions(floatmode="unique", precision=None):
        assert repr(read) == repr(halls)
    assert dumps_halls(read) == text


def test_published_maps_keep_their_rows(data: Path) -> None:
    """The published files hold the same digits, the first line at y = 0."""
    found = sorted((data / "landmarks").glob("or16_*.txt"))
    assert found
    for path in found:
        lines = path.read_text().split()[-int(re.search(r"(\d+)x", path.name)[1]) :]
        codes = np.array([[int(digit, 16) for digit in line] for line in lines])
        text = dumps_map(FloorMap(codes))
        assert re.findall(r'^  "([0-9a-f]+)",$', text, re.M) == lines
        np.testing.assert_array_equal(loads_map(text).codes, codes)


# ---- edited files

MAP = """\
format = "locatk-landmark-map"
format_version = 1

[map]
alphabet = "16"
window = "L"
pitch_mm = 200
rows = [
  "0f.",
  "3C7",
]
walls = [[[0, 1], [0, 0]]]
"""
LANDMARK = """
[landmark]
bar_length_mm = 30
bar_width_mm = 10
bar_height_mm = 5
remanence_t = 1.2
radius_mm = 25
sensor_height_mm = 12
circle_mm = 25
threshold_mt = 3.3
"""
BUILT = """
[[built]]
cell = [1, 2]
x_mm = 1.5
y_mm = -0.25
heading_deg = 1.8
strength = [1, 0.9, -1.1, 0]
"""


def test_a_map_by_hand() -> None:
    floor = loads_map("\ufeff" + MAP + LANDMARK + BUILT)
    np.testing.assert_array_equal(floor.codes, [[0, 15, HOLE_CODE], [3, 12, 7]])
    assert [name(code) for code in floor.codes[1]] == ["NNSS", "SSNN", "NNNS"]
    assert floor.position((1, 0)) == (0.0, 0.2)  # the first string has the least y
    assert floor.geometry == Geometry()
    assert floor.walls == {((0, 0), (0, 1))}
    assert not floor.is_passable((0, 0), 0)
    assert floor.is_passable((0, 0), 1)
    assert (floor.detect, floor.seed, floor.origin_m) == (0, None, (0.0, 0.0))
    built = floor.built[1, 2]
    assert (built.x_m, built.y_m, built.heading_rad) == (1.5e-3, -0.25e-3, math.pi / 100)
    np.testing.assert_array_equal(built.strength, [1, 0.9, -1.1, 0])
    assert np.isnan(built.sigma).all()
    assert (built.visits, built.flags) == (0, ())


def test_the_file_explains_the_order_of_rows() -> None:
    text = dumps_map(loads_map(MAP + LANDMARK))
    comment = " ".join(line[2:] for line in text.splitlines() if line.startswith("# "))
    assert "The FIRST row has the least y" in comment
    assert text.index(comment[:30]) < text.index('rows = [\n  "0f.",\n  "3c7",\n]')


def test_bars_may_touch() -> None:
    touching = LANDMARK.replace("length_mm = 30", "length_mm = 40")
    assert loads_map(MAP + touching).geometry.bar_length_m == 0.04
    assert loads_map(MAP.replace("200", "60") + touching).pitch_m == 0.06


@pytest.mark.parametrize(
    ("text", "where", "words"),
    [
        ("", None, "missing key 'format'"),
        (MAP.replace("landmark-map", "tag") + LANDMARK, "format", "expected 'locatk-landmark-map'"),
        (MAP.replace("version = 1", "version = 2") + LANDMARK, "format_version", "newer"),
        (MAP, None, "missing key 'landmark'"),
        (LANDMARK, None, "missing key 'format'"),
        (MAP.replace('"16"', "16") + LANDMARK, "map.alphabet", "expected a string"),
        (MAP.replace('"16"', '"8"') + LANDMARK, "map.alphabet", "not one of 6, 16, compass"),
        (MAP.replace('"L"', '"2x3"') + LANDMARK, "map.window", "not one of L, I2"),
        (MAP.replace("pitch_mm = 200", "pitch = 200") + LANDMARK, "map", "missing key 'pitch_mm'"),
        (MAP.replace("200", "0") + LANDMARK, "map.pitch_mm", "above 0"),
        (MAP.replace("200", "59.9") + LANDMARK, "map.pitch_mm", "overlap, expected at least 60"),
        (MAP.replace('"0f."', '"0g."') + LANDMARK, "map.rows[0]", "'g' in column 1"),
        (MAP.replace('"0f."', '"0f"') + LANDMARK, "map.rows[1]", "expected 2 letters"),
        (MAP.replace('"3C7"', '"3C "') + LANDMARK, "map.rows[1]", "' ' in column 2"),
        (MAP.replace('"3C7"', "3") + LANDMARK, "map.rows[1]", "a string, not a number"),
        (MAP.replace('"0f.",\n  "3C7",', "") + LANDMARK, "map.rows", "empty map"),
        (MAP.replace("0f.", "").replace("3C7", "") + LANDMARK, "map.rows", "empty map"),
        (MAP.replace("0f.", "...").replace("3C7", "...") + LANDMARK, "map.rows", "no cell"),
        (MAP.replace('"16"', '"compass"') + LANDMARK, "map.rows[0]", "7 (NNNS), 8 (SSSN)"),
        (MAP.replace("[0, 1]", "[0, 2]") + LANDMARK, "map.walls[0]", "[0, 0] and [0, 2] are not"),
        (MAP.replace("[0, 1]", "[1, 1]") + LANDMARK, "map.walls[0]", "not neighbours"),
        (MAP.replace("[0, 1]", "[0, 0]") + LANDMARK, "map.walls[0]", "not neighbours"),
        (MAP.replace("[0, 1]", "[2, 1]") + LANDMARK, "map.walls[0]", "last one is [1, 2]"),
        (
            MAP.replace("[0, 1]", "[0, -1]") + LANDMARK,
            "map.walls[0]",
            "whole numbers of at least 0",
        ),
        (MAP.replace("[0, 1]", "[0, 1.0]") + LANDMARK, "map.walls[0]", "lists of 2 whole numbers"),
        (MAP.replace("[0, 1], ", "") + LANDMARK, "map.walls[0]", "a list of 2 lists of 2"),
        (MAP.replace("[[[0, 1], [0, 0]]]", "true") + LANDMARK, "map.walls", "expected a list"),
        (MAP + "detect = -1" + LANDMARK, "map.detect", "whole number from 0"),
        (MAP + "seed = 1.5" + LANDMARK, "map.seed", "whole number"),
        (MAP + "window_ = 1" + LANDMARK, "map", "unknown key 'window_'"),
        (MAP + LANDMARK.replace("1.2", "1200"), "landmark.remanence_t", "above 0, at most 2 in T"),
        (MAP + LANDMARK.replace("= 30", "= 41"), "landmark.radius_mm", "at least 25.5"),
        (MAP + LANDMARK.replace("= 30", "= -1"), "landmark.bar_length_mm", "above 0"),
        (MAP + LANDMARK.replace("= 3.3", "= inf"), "landmark.threshold_mt", "finite"),
        (MAP + LANDMARK + "hight_mm = 1", "landmark", "unknown key 'hight_mm'"),
        (MAP + LANDMARK + BUILT + BUILT, "built[1].cell", "twice"),
        (MAP + LANDMARK + BUILT.replace("[1, 2]", "[0, 2]"), "built[0].cell", "no landmark"),
        (
            MAP + LANDMARK + BUILT.replace("[1, 2]", "[2, 2]"),
            "built[0].cell",
            "not a cell of the map",
        ),
        (
            MAP + LANDMARK + BUILT.replace("[1, 2]", "3"),
            "built[0].cell",
            "a list of 2 whole numbers",
        ),
        (MAP + LANDMARK + BUILT.replace("1.5", "101"), "built[0].x_mm", "another cell"),
        (MAP + LANDMARK + BUILT.replace("-0.25", "-101"), "built[0].y_mm", "another cell"),
        (MAP + LANDMARK + BUILT.replace("1.8", "181"), "built[0].heading_deg", "-180 to 180"),
        (MAP + LANDMARK + BUILT.replace("0.9, ", ""), "built[0].strength", "list of 4"),
        (MAP + LANDMARK + BUILT.replace("0.9", "nan"), "built[0].strength[1]", "finite"),
        (MAP + LANDMARK + BUILT + "sigma_y_mm = -1", "built[0].sigma_y_mm", "of at least 0 in mm"),
        (
            MAP + LANDMARK + BUILT + "sigma_strength = [1, 1, -1, 1]",
            "built[0].sigma_strength[2]",
            "of at least 0",
        ),
        (MAP + LANDMARK + BUILT + "flags = 1", "built[0].flags", "list of strings"),
    ],
)
def test_errors_name_key_and_expected_value(
    refused: Callable[..., None], text: str, where: str | None, words: str
) -> None:
    refused(maps.MAP, text, where, words)


HALLS = """\
format = "locatk-hall-sensors"
format_version = 1
names = ["front", "left", "rear", "right"]
position_mm = [[25, 0], [0, 25], [-25, 0], [0, -25]]
"""


def test_halls_by_hand() -> None:
    halls = loads_halls(HALLS)
    np.testing.assert_array_equal(halls.position_m, circle(0.025))
    assert math.isnan(halls.noise_t)
    assert math.isinf(halls.range_t)
    known = loads_halls(HALLS + 'noise_ut = 150\nrange_mt = 30\nsensor = "DRV5053"\n')
    assert (known.noise_t, known.range_t, known.sensor) == (150e-6, 0.03, "DRV5053")


@pytest.mark.parametrize(
    ("text", "where", "words"),
    [
        (HALLS.replace("hall-sensors", "halls"), "format", "expected"),
        (HALLS.replace('"front", ', ""), "position_mm", "list of 3 rows of 2"),
        (HALLS.replace('"front", "left", "rear", "right"', ""), "names", "1 to 1000 strings"),
        (HALLS.replace('"front"', '""'), "names", "one a sensor"),
        (HALLS.replace('"front"', '"left"'), "names", "one name"),
        (HALLS.replace("[0, 25]", "[25, 0]"), "position_mm", "position of sensor 'front'"),
        (HALLS.replace("[0, 25]", "[0, 25, 0]"), "position_mm[1]", "list of 2 numbers in mm"),
        (HALLS + "noise_ut = 0", "noise_ut", "above 0"),
        (HALLS + "range_mt = -1", "range_mt", "above 0"),
        (HALLS + "range_t = 1", None, "unknown key 'range_t'"),
    ],
)
def test_errors_of_halls_name_key_and_expected_value(
    refused: Callable[..., None], text: str, where: str | None, words: str
) -> None:
    refused(maps.HALLS, text, where, words)
