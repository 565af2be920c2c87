"""Maps as pictures of ROS, SVG and DXF: true places, true sizes, the same bytes."""

from __future__ import annotations

import io
import math
import os
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path
from xml.etree import ElementTree as Xml

import ezdxf
import numpy as np
import pytest

from locatk.core.errors import InputError
from locatk.core.landmarks.field import landmark_field
from locatk.core.landmarks.landmark import PATTERNS, signs
from locatk.core.landmarks.map.floor import HOLE_CODE, AsBuiltLandmark, FloorMap
from locatk.formats.artifacts.maps import write_map
from locatk.formats.exporters.floors import drawing_svg, map_ros
from locatk.formats.exporters.floors.drawing_dxf import dumps_dxf
from locatk.formats.exporters.floors.map_drawing import draw_map

NONE = np.full(7, np.nan)

FLOOR = FloorMap(
    np.array([[0b0111, 0b1100, 0b1111], [0b0101, HOLE_CODE, 0b0000]]),
    pitch_m=0.2,
    origin_m=(1.0, -3.0),
    walls=frozenset({((0, 0), (0, 1)), ((0, 2), (1, 2))}),
    name="Hall <3>",
)

TURN = math.radians(30)
BUILT = FloorMap(
    np.array([[0b0111, 0b0001]]),
    built={(0, 1): AsBuiltLandmark(0.004, -0.003, TURN, signs(0b0001), NONE)},
)

# ---- ROS


def pixel(picture: np.ndarray, floor: FloorMap, x: float, y: float, size: float) -> int:
    """Grey level at a place, by what map_server says of origin and rows."""
    text = map_ros.dumps_yaml(floor, "m.pgm", size)
    left, bottom = map(float, re.search(r"origin: \[(.*?), (.*?),", text).groups())
    column, row = math.floor((x - left) / size), math.floor((y - bottom) / size)
    return int(picture[len(picture) - 1 - row, column])


def test_pixels_agree_with_the_field_of_the_landmarks() -> None:
    size = 0.005
    picture = map_ros.draw_grid(FLOOR, size)
    assert picture.shape == (80, 120)
    rng = np.random.default_rng(0)
    for cell in FLOOR.cells():
        x, y = FLOOR.position(cell)
        # In the middle of pixels, which lie on whole 5 mm.
        offsets = (rng.integers(-16, 16, (40, 2)) + 0.5) * size
        field = landmark_field(FLOOR.geometry, int(FLOOR.codes[cell]), offsets)
        inside = np.abs(field) >= FLOOR.geometry.threshold_t
        levels = [pixel(picture, FLOOR, x + dx, y + dy, size) for dx, dy in offsets]
        np.testing.assert_array_equal(np.array(levels) == map_ros.TERRITORY, inside)
        assert inside.any()
        assert not inside.all()
    x, y = FLOOR.position((1, 1))
    hole = {pixel(picture, FLOOR, x + d, y + e, size) for d in (-0.09, 0, 0.09) for e in (-0.09, 0)}
    assert hole == {map_ros.UNKNOWN}
    assert pixel(picture, FLOOR, *FLOOR.position((0, 0)), size) == map_ros.FREE


def test_walls_are_between_their_cells() -> None:
    picture = map_ros.draw_grid(FLOOR, 0.01)
    black = picture == map_ros.OCCUPIED
    assert black.any()
    for (row, column), (other, _) in FLOOR.walls:
        x, y = FLOOR.position((row, column))
        ahead = (0.0, 0.1) if other > row else (0.1, 0.0)
        for part in (-0.09, 0.0, 0.09):
            along = (part, 0.0) if other > row else (0.0, part)
            at = (x + ahead[0] + along[0] + 1e-6, y + ahead[1] + along[1] + 1e-6)
            assert pixel(picture, FLOOR, *at, 0.01) == map_ros.OCCUPIED
    assert pixel(picture, FLOOR, 1.1 + 1e-6, -2.7, 0.01) != map_ros.OCCUPIED


def test_grey_levels_have_the_meaning_of_map_server() -> None:
    """wiki.ros.org/map_server: p = (255 - level) / 255, free below, occupied above."""
    text = map_ros.dumps_yaml(FLOOR, 'a "b".pgm')
    values = dict(line.split(": ", 1) for line in text.splitlines())
    assert values["image"] == '"a \\"b\\".pgm"'
    assert values["negate"] == "0"
    assert (values["resolution"], values["origin"]) == ("0.01", "[0.9, -3.1, 0.0]")
    free, occupied = float(values["free_thresh"]), float(values["occupied_thresh"])
    chance = {level: (255 - level) / 255 for level in (254, 230, 205, 0)}
    assert chance[map_ros.FREE] < free > chance[map_ros.TERRITORY]
    assert free < chance[map_ros.UNKNOWN] < occupied < chance[map_ros.OCCUPIED]


def test_pgm_is_read_by_pillow() -> None:
    from PIL import Image

    picture = map_ros.draw_grid(FLOOR)
    read = np.asarray(Image.open(io.BytesIO(map_ros.dumps_pgm(picture))))
    np.testing.assert_array_equal(read, picture)


def test_territories_are_as_built() -> None:
    size = 0.002
    picture = map_ros.draw_grid(BUILT, size)
    designed = map_ros.draw_grid(FloorMap(BUILT.codes), size)
    ours = np.argwhere(picture[:, 100:] == map_ros.TERRITORY).mean(0)
    theirs = np.argwhere(designed[:, 100:] == map_ros.TERRITORY).mean(0)
    np.testing.assert_array_equal(picture[:, :100], designed[:, :100])
    # Turned about its centre, which is 4 mm to the right and 3 mm down: rows grow downwards.
    middle = np.array([49.5, 49.5])
    (down, right), c, s = theirs - middle, math.cos(TURN), math.sin(TURN)
    wanted = [c * down - s * right + 1.5, c * right + s * down + 2.0]
    np.testing.assert_allclose(ours - middle, wanted, atol=0.15)
    missing = FloorMap(
        BUILT.codes,
        built={(0, 1): AsBuiltLandmark(0, 0, 0, np.zeros(4), NONE)},
    )
    assert not (map_ros.draw_grid(missing, size)[:, 100:] == map_ros.TERRITORY).any()


def test_odd_pitches_and_wrong_resolutions() -> None:
    odd = FloorMap(np.array([[5, HOLE_CODE]]), pitch_m=0.1234)
    picture = map_ros.draw_grid(odd, 0.01)
    assert picture.shape == (13, 25)
    assert (picture[0] == map_ros.UNKNOWN).all()  # beyond the map
    assert (picture[1:, 13:] == map_ros.UNKNOWN).all()
    with pytest.raises(InputError, match="too coarse"):
        map_ros.draw_grid(odd, 0.05)
    with pytest.raises(InputError, match="pixels, more than"):
        map_ros.draw_grid(odd, 1e-6)


# ---- SVG


def subpaths(d: str) -> list[np.ndarray]:
    """Points of each part of a path."""
    return [
        np.array([[float(value) for value in pair.split()] for pair in part.rstrip("z").split("L")])
        for part in d.split("M")[1:]
    ]


def groups(svg: bytes) -> dict[str, Xml.Element]:
    root = Xml.fromstring(svg)
    return {
        group.attrib["id"]: group
        for group in root.iter(f"{{{drawing_svg.NAMESPACE}}}g")
        if group.get("id")
    }


def test_svg_has_true_size_and_layers() -> None:
    svg = drawing_svg.dumps_svg(draw_map(FLOOR))
    assert svg == drawing_svg.dumps_svg(draw_map(FLOOR))
    root = Xml.fromstring(svg)
    assert (root.get("width"), root.get("height")) == ("600mm", "400mm")
    assert root.get("viewBox") == "0 0 600 400"
    assert root.findtext("{*}title") == "Landmarks Hall <3>"
    found = groups(svg)
    label = f"{{{drawing_svg.INKSCAPE}}}label"
    assert {g.get(label) for g in found.values() if g.get(label)} == {
        *PATTERNS,
        "walls",
        "centres",
        "labels",
    }
    where = {pattern: [g.get("id") for g in found[pattern]] for pattern in PATTERNS}
    assert where == {
        "NSNS": ["r1c0"],
        "SSSN": [],
        "NNNS": ["r0c0"],
        "NNSS": ["r0c1"],
        "NNNN": ["r0c2"],
        "SSSS": ["r1c2"],
    }
    assert next(text.text for text in found["labels"]) == "0,0 NNNS"
    assert len(found["walls"]) == 2


def test_svg_bars_are_as_designed() -> None:
    """Bar 0 of NNNS is N: at the right, 25 mm from the centre, north upwards."""
    group = groups(drawing_svg.dumps_svg(draw_map(FLOOR)))["r0c0"]
    outlines, lines, _ = (path.get("d") for path in group.findall("{*}path"))
    centre = np.array([100.0, 300.0])  # half a pitch from the left, the lower row below
    bars = subpaths(outlines)
    middles = [bar.mean(0) - centre for bar in bars]
    np.testing.assert_allclose(middles, [(25, 0), (0, -25), (-25, 0), (0, 25)], atol=1e-4)
    np.testing.assert_allclose([np.ptp(bar, axis=0) for bar in bars[:2]], [(10, 30), (30, 10)])
    arrows = [part[1] - part[0] for part in subpaths(lines)]
    # up, left, down (N: counter-clockwise); the last bar is S: left again. y points down.
    np.testing.assert_array_equal(np.sign(np.round(arrows, 6)), [(0, -1), (-1, 0), (0, 1), (-1, 0)])
    letters = {
        text.text + str(number // 2): (float(text.get("x")), float(text.get("y")))
        for number, text in enumerate(group.findall("{*}text"))
    }
    assert letters["N0"][1] < letters["S0"][1]


def test_svg_is_as_built() -> None:
    group = groups(drawing_svg.dumps_svg(draw_map(BUILT)))["r0c1"]
    bar = subpaths(group.find("{*}path").get("d"))[0].mean(0)
    centre = np.array([300 + 4, 100 + 3])
    wanted = centre + 25 * np.array([math.cos(TURN), -math.sin(TURN)])
    np.testing.assert_allclose(bar, wanted, atol=1e-3)


# ---- DXF


def read(text: str) -> ezdxf.document.Drawing:
    return ezdxf.read(io.StringIO(text))


def test_dxf_is_valid_and_in_mm() -> None:
    document = read(dumps_dxf(draw_map(FLOOR)))
    assert not document.audit().has_errors
    assert document.units == ezdxf.units.MM
    assert {"BARS", "POLES", "CENTRES", "LABELS", "WALLS"} <= {
        layer.dxf.name for layer in document.layers
    }
    space = document.modelspace()
    inserts = {e.dxf.name: tuple(e.dxf.insert)[:2] for e in space.query("INSERT")}
    assert inserts["LANDMARK_NNNS"] == pytest.approx((1000, -3000))
    assert inserts["LANDMARK_SSSS"] == pytest.approx((1400, -2800))
    assert Counter(e.dxf.layer for e in space) == {"BARS": 5, "CENTRES": 5, "LABELS": 5, "WALLS": 2}
    walls = {(tuple(e.dxf.start)[:2], tuple(e.dxf.end)[:2]) for e in space.query("LINE")}
    assert ((1100.0, -3100.0), (1100.0, -2900.0)) in {
        tuple(tuple(round(v, 6) for v in point) for point in wall) for wall in walls
    }


def test_dxf_bars_are_as_built() -> None:
    document = read(dumps_dxf(draw_map(BUILT)))
    (insert,) = document.modelspace().query("INSERT[name=='LANDMARK_NSSS']")
    bars = [e for e in insert.virtual_entities() if e.dxftype() == "LWPOLYLINE"]
    assert {bar.dxf.layer for bar in bars} == {"BARS"}
    corners = np.array([point[:2] for point in bars[0].get_points()])
    wanted = np.array([204, -3]) + 25 * np.array([math.cos(TURN), math.sin(TURN)])
    np.testing.assert_allclose(corners.mean(0), wanted, atol=1e-6)
    sides = np.hypot(*np.diff(corners, axis=0).T)
    np.testing.assert_allclose(sorted(sides[:2]), [10, 30])
    arrow = next(e for e in insert.virtual_entities() if e.dxftype() == "LINE")
    along = np.array(arrow.dxf.end)[:2] - np.array(arrow.dxf.start)[:2]
    turned = math.atan2(along[1], along[0])  # bar 0 is N: north is counter-clockwise
    assert turned == pytest.approx(TURN + math.pi / 2)


@pytest.mark.slow
def test_dxf_is_the_same_in_every_process(tmp_path: Path) -> None:
    """Neither the time nor the order of hashes is in it, and ezdxf is left as it was."""
    assert ezdxf.options.write_fixed_meta_data_for_testing is False
    text = dumps_dxf(draw_map(FLOOR))
    assert ezdxf.options.write_fixed_meta_data_for_testing is False
    write_map(tmp_path / "map.toml", FLOOR)
    code = (
        "import sys; from locatk.formats.exporters.floors.drawing_dxf import dumps_dxf; "
        "from locatk.formats.exporters.floors.map_drawing import draw_map; "
        "from locatk.formats.artifacts.maps import read_map; "
        f"sys.stdout.write(dumps_dxf(draw_map(read_map({str(tmp_path / 'map.toml')!r}))))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONHASHSEED": "7"},
    )
    assert done.stdout == text
