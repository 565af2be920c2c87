"""Outlines of rooms from DXF and SVG: units, scale, open outlines, and files of other kinds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from locatk.core.errors import FormatError, InputError
from locatk.formats.importers.floors.room_drawing import read_dxf_room, read_svg_room

SVG = '<svg xmlns="http://www.w3.org/2000/svg" width="100mm" height="80mm" viewBox="0 0 100 80">'


def svg(tmp_path: Path, content: str, head: str = SVG) -> Path:
    path = tmp_path / "room.svg"
    path.write_text(f"{head}{content}</svg>")
    return path


def same_outline(found: np.ndarray, expected: list) -> bool:
    """Compare corners whatever the first one is."""
    return any(
        np.allclose(np.roll(found, k, axis=0), np.array(expected, float), atol=1e-9)
        for k in range(len(found))
    )


@pytest.mark.parametrize(
    "shape",
    [
        '<rect x="10" y="20" width="50" height="40"/>',
        '<polygon points="10,20 60,20 60,60 10,60"/>',
        '<polyline points="10 20 60 20 60 60 10 60 10 20"/>',
        '<path d="M10 20 L60 20 60 60 10 60 Z"/>',
        '<path d="m10,20h50v40h-50z"/>',
        '<path d="M 10 20 H 60 V 60 H 10 V 20"/>',
        '<g transform="translate(10 20)"><rect width="50" height="40"/></g>',
        '<g transform="matrix(2 0 0 2 0 0)"><rect x="5" y="10" width="25" height="20"/></g>',
        '<rect transform="rotate(90)" x="20" y="-60" width="40" height="50"/>',
        '<rect transform="scale(10) translate(1,2)" width="5" height="4"/>',
    ],
)
def test_closed_shapes_of_svg_are_rooms(tmp_path: Path, shape: str) -> None:
    room = read_svg_room(svg(tmp_path, shape), scale=100)
    assert same_outline(room.outline_m, [[0, 0], [5, 0], [5, 4], [0, 4]])
    assert not room.obstacles_m


def test_y_of_svg_points_down_and_inner_shapes_are_obstacles(tmp_path: Path) -> None:
    shapes = (
        '<path d="M0 0H60V20H30V60H0Z"/><rect x="10" y="5" width="10" height="4"/>'
        '<rect x="80" y="70" width="5" height="4"/><defs><rect width="9" height="9"/></defs>'
    )
    room = read_svg_room(svg(tmp_path, shapes), scale=100)
    assert same_outline(room.outline_m, [[0, 0], [3, 0], [3, 4], [6, 4], [6, 6], [0, 6]])
    (obstacle,) = room.obstacles_m
    assert same_outline(obstacle, [[1, 5.1], [2, 5.1], [2, 5.5], [1, 5.5]])


@pytest.mark.parametrize(
    ("head", "unit", "size_m"),
    [
        ('<svg xmlns="http://www.w3.org/2000/svg" width="10cm" viewBox="0 0 50 50">', None, 0.1),
        ('<svg xmlns="http://www.w3.org/2000/svg" width="1in" viewBox="0 0 25.4 9">', None, 0.05),
        ('<svg xmlns="http://www.w3.org/2000/svg" width="50" viewBox="0 0 50 50">', "cm", 0.5),
        ('<svg xmlns="http://www.w3.org/2000/svg">', "m", 50.0),
    ],
)
def test_units_of_svg(tmp_path: Path, head: str, unit: str | None, size_m: float) -> None:
    room = read_svg_room(svg(tmp_path, '<rect width="50" height="50"/>', head), unit)
    assert room.outline_m.max() == pytest.approx(size_m)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('<polyline points="0,0 50,0 50,40 0,40"/>', "open"),
        ('<path d="M0 0H60V20H30V60"/>', "open"),
        ('<path d="M0 0C1 2 3 4 5 6Z"/>', "path with C"),
        ('<path d="10 20 30 40 Z"/>', "without a command"),
        ('<path d="M0 0 L 5 Z"/>', "too few"),
        ('<polygon points="0,0 50,0 50"/>', "odd number"),
        ('<polygon points="0,0 50,40 50,0 0,40"/>', "crosses"),
        ('<rect width="5em" height="4"/>', "not a number"),
        ('<rect width="1e30" height="4"/>', "too large"),
        ('<rect transform="skewX(3)" width="5" height="4"/>', "skewX"),
        ("<text>room</text>", "no closed outline"),
    ],
)
def test_drawings_without_a_room_are_refused_with_the_line(
    tmp_path: Path, content: str, message: str
) -> None:
    with pytest.raises(FormatError, match=message) as caught:
        read_svg_room(svg(tmp_path, content))
    assert "room.svg" in str(caught.value)


def test_files_that_are_no_svg_or_dangerous(tmp_path: Path) -> None:
    path = tmp_path / "room.svg"
    for text, message in (
        ("hello", "not SVG"),
        ("", "not SVG"),
        ("<html/>", "not SVG"),
        (
            '<!DOCTYPE svg [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;&a;">]>'
            '<svg xmlns="http://www.w3.org/2000/svg"><text>&b;</text></svg>',
            "entity",
        ),
        (
            '<!DOCTYPE svg [<!ENTITY x SYSTEM "file:///etc/passwd">]>'
            '<svg xmlns="http://www.w3.org/2000/svg"><text>&x;</text></svg>',
            "entity",
        ),
    ):
        path.write_text(text)
        with pytest.raises(FormatError, match=message):
            read_svg_room(path)


def test_a_drawing_without_a_unit_is_refused(tmp_path: Path) -> None:
    path = svg(tmp_path, '<rect width="50" height="50"/>', '<svg width="50" viewBox="0 0 50 50">')
    with pytest.raises(FormatError, match="no unit"):
        read_svg_room(path)


# ---- DXF

ezdxf = pytest.importorskip("ezdxf")


def dxf(tmp_path: Path, *, insunits: int = 4, closed: bool = True) -> Path:
    document = ezdxf.new()
    document.header["$INSUNITS"] = insunits
    space = document.modelspace()
    walls = [(0, 0), (5000, 0), (5000, 4000), (0, 4000)]
    space.add_lwpolyline(walls, close=closed, dxfattribs={"layer": "WALLS"})
    column = [(1000, 1000), (1500, 1000), (1500, 1500)]
    space.add_lwpolyline(column, close=True, dxfattribs={"layer": "THINGS"})
    space.add_circle((3000, 2000), 200, dxfattribs={"layer": "THINGS"})
    space.add_lwpolyline(column, close=False, dxfattribs={"layer": "CABLES"})
    space.add_text("lab", dxfattribs={"layer": "WALLS"})
    path = tmp_path / "room.dxf"
    document.saveas(path)
    return path


def test_outline_and_obstacles_of_dxf(tmp_path: Path) -> None:
    path = dxf(tmp_path)
    for layer in (None, "walls"):
        room = read_dxf_room(path, layer)
        assert same_outline(room.outline_m, [[0, 0], [5, 0], [5, 4], [0, 4]])
        assert not room.obstacles_m
    column, disc = read_dxf_room(path, "WALLS", "THINGS").obstacles_m
    assert same_outline(column, [[1, 1], [1.5, 1], [1.5, 1.5]])
    assert np.hypot(*(disc - [3.0, 2.0]).T) == pytest.approx(0.2, abs=1e-4)
    assert len(disc) > 8


def test_units_and_scale_of_dxf(tmp_path: Path) -> None:
    path = dxf(tmp_path, insunits=0)
    with pytest.raises(FormatError, match="no unit"):
        read_dxf_room(path)
    assert read_dxf_room(path, unit="mm", scale=2.0).outline_m.max() == pytest.approx(10.0)
    with pytest.raises(InputError, match="beyond"):
        read_dxf_room(path, unit="m")


def test_open_outlines_and_missing_layers_of_dxf(tmp_path: Path) -> None:
    path = dxf(tmp_path, closed=False)
    with pytest.raises(FormatError, match="closed") as caught:
        read_dxf_room(path, "WALLS")
    assert "Close" in (caught.value.hint or "")
    with pytest.raises(FormatError, match="open"):
        read_dxf_room(dxf(tmp_path), "WALLS", "CABLES")
    document = ezdxf.readfile(dxf(tmp_path))
    document.modelspace().add_lwpolyline([(0, 0), (9000, 0)], dxfattribs={"layer": "WALLS"})
    document.saveas(path)
    assert len(read_dxf_room(path).outline_m) == 4  # of all layers, the largest closed one
    with pytest.raises(FormatError, match="open"):
        read_dxf_room(path, "WALLS")
    with pytest.raises(FormatError, match="nothing is on layer"):
        read_dxf_room(path, "ROOMS")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("number", ["1e308", "9e999", "-4e200"])
def test_numbers_beyond_reason_are_refused_without_a_warning(tmp_path: Path, number: str) -> None:
    path = tmp_path / "room.svg"
    path.write_text(
        '<svg xmlns="http://www.w3.org/2000/svg" width="10mm" height="10mm" viewBox="0 0 10 10">'
        f'<path transform="scale(10)" d="M0 0 H{number} V9 H0 Z"/></svg>'
    )
    with pytest.raises(FormatError, match=r"beyond|number|finite"):
        read_svg_room(path)
