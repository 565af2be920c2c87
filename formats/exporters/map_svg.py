"""Landmark maps as SVG at true size, in layers.

Width and height are in mm and the user unit is 1 mm, which is true size for Inkscape and plotters.
The x axis of the map points right, y up. Layers of Inkscape: the landmarks of each pattern, their
centres, labels, walls. A bar is drawn as its outline, an arrow from its south to its north pole,
and the letters of the poles. Positions are as built if that is known; the bars are those of the
design.
"""

from __future__ import annotations

import math
from xml.etree import ElementTree as Xml

import numpy as np
from numpy.typing import NDArray

from locatk.core.drawing import Line, Point, Polygon
from locatk.core.landmarks.drawing.landmark import bar_outlines, pole_arrow, pole_letters
from locatk.core.landmarks.landmark import CODE_COUNT, PATTERN_OF, PATTERNS, Geometry, name
from locatk.core.landmarks.map.floor import FloorMap, as_built_poses

NAMESPACE = "http://www.w3.org/2000/svg"
INKSCAPE = "http://www.inkscape.org/namespaces/inkscape"

LINE_WIDTH_MM = 0.25
WALL_WIDTH_MM = 4
MAX_LABEL_HEIGHT_MM = 8.0

_FONT = "Helvetica, Arial, 'Liberation Sans', sans-serif"


def dumps_svg(floor: FloorMap) -> bytes:
    """Return the SVG of a map; the same map gives the same bytes."""
    drawing = _MapDrawing(floor)
    width, height = (_number(side) for side in drawing.size_mm)
    root = Xml.Element(
        "svg",
        {
            "xmlns": NAMESPACE,
            "xmlns:inkscape": INKSCAPE,
            "width": f"{width}mm",
            "height": f"{height}mm",
            "viewBox": f"0 0 {width} {height}",
        },
    )
    Xml.SubElement(root, "title").text = f"Landmarks {floor.name}".strip()
    group = Xml.SubElement(
        root,
        "g",
        {
            "fill": "none",
            "stroke": "black",
            "stroke-width": _number(LINE_WIDTH_MM),
            "font-family": _FONT,
            "text-anchor": "middle",
        },
    )
    drawing.draw(group)
    Xml.indent(root)
    data: bytes = Xml.tostring(root, encoding="utf-8", xml_declaration=True)
    return data + b"\n"


class _LandmarkShape:
    """Outlines, arrows and letters of the landmark of one code, as slices of its points."""

    def __init__(self, geometry: Geometry, code: int) -> None:
        self.outlines: list[slice] = []
        self.shafts: list[slice] = []
        self.heads: list[slice] = []
        self.letters: list[tuple[str, int]] = []
        points: list[NDArray[np.float64]] = []

        def add(part: object) -> slice:
            points.append(np.asarray(part, float).reshape(-1, 2))
            stop = sum(map(len, points))
            return slice(stop - len(points[-1]), stop)

        for bar in bar_outlines(geometry, code):
            self.outlines.append(add(bar.corners))
            for mark in pole_arrow(geometry, bar):
                if isinstance(mark, Line):
                    self.shafts.append(add((mark.start, mark.end)))
                elif isinstance(mark, Polygon):
                    self.heads.append(add(mark.corners))
            for letter, position in pole_letters(bar):
                self.letters.append((letter, add(position).start))
        self.points = np.concatenate(points)


class _MapDrawing:
    """Drawing of a map; its lower left corner is half a pitch before cell (0, 0)."""

    def __init__(self, floor: FloorMap) -> None:
        self.floor = floor
        self.pitch = 1e3 * floor.pitch_m
        rows, columns = floor.shape
        self.size_mm = (self.pitch * columns, self.pitch * rows)
        corner = 1e3 * np.array(floor.origin_m) - self.pitch / 2
        poses = as_built_poses(floor)
        self.positions_mm = 1e3 * poses[:, :2] - corner
        self.headings = poses[:, 2].tolist()
        self.shapes = [_LandmarkShape(floor.geometry, code) for code in range(CODE_COUNT)]

    def draw(self, parent: Xml.Element) -> None:
        """Add the layers to an element."""
        self._walls(_layer(parent, "walls"))
        layers = {pattern: _layer(parent, pattern) for pattern in PATTERNS}
        centres, labels = _layer(parent, "centres"), _layer(parent, "labels")
        size = min(MAX_LABEL_HEIGHT_MM, self.pitch / 12)
        below = 1e3 * (self.floor.geometry.radius_m + self.floor.geometry.bar_width_m / 2)
        for cell, position_mm, heading in zip(
            self.floor.cells(), self.positions_mm, self.headings, strict=True
        ):
            code = int(self.floor.codes[cell])
            layer = layers[PATTERNS[PATTERN_OF[code] - 1]]
            self._landmark(layer, f"r{cell[0]}c{cell[1]}", code, position_mm, heading)
            x, y = self._on_page(position_mm)
            cross = f"M{_number(x - 3)} {_number(y)}h6M{_number(x)} {_number(y - 3)}v6"
            Xml.SubElement(centres, "path", d=cross)
            words = f"{cell[0]},{cell[1]} {name(code)}"
            under = min(below + 1.3 * size, self.pitch / 2 - 0.3 * size)
            _text(labels, words, (x, y + under), size)

    def _on_page(self, point: NDArray[np.float64]) -> Point:
        """Convert a position to the page, whose y axis points down."""
        return float(point[0]), self.size_mm[1] - float(point[1])

    def _landmark(
        self,
        layer: Xml.Element,
        ident: str,
        code: int,
        position_mm: NDArray[np.float64],
        heading: float,
    ) -> None:
        group = Xml.SubElement(layer, "g", id=ident)
        shape = self.shapes[code]
        c, s = math.cos(heading), math.sin(heading)
        moved = shape.points @ np.array([[c, s], [-s, c]]) + position_mm
        moved[:, 1] = self.size_mm[1] - moved[:, 1]
        x, y = ([_number(value) for value in axis] for axis in moved.T.tolist())

        def path(parts: list[slice], end: str) -> str:
            pairs = (map(" ".join, zip(x[part], y[part], strict=True)) for part in parts)
            return "".join("M" + "L".join(pair) + end for pair in pairs)

        Xml.SubElement(group, "path", d=path(shape.outlines, "z"))
        Xml.SubElement(group, "path", d=path(shape.shafts, ""))
        Xml.SubElement(group, "path", d=path(shape.heads, "z"), fill="black", stroke="none")
        size = 0.55e3 * self.floor.geometry.bar_width_m
        for letter, index in shape.letters:
            _text(group, letter, (moved[index, 0], moved[index, 1] + 0.36 * size), size)

    def _walls(self, layer: Xml.Element) -> None:
        for (row, column), (other_row, _) in sorted(self.floor.walls):
            right, top = (column + 1) * self.pitch, self.size_mm[1] - (row + 1) * self.pitch
            along = f"h-{_number(self.pitch)}" if other_row > row else f"v{_number(self.pitch)}"
            wall = {
                "d": f"M{_number(right)} {_number(top)}{along}",
                "stroke-width": str(WALL_WIDTH_MM),
            }
            Xml.SubElement(layer, "path", wall)


def _layer(parent: Xml.Element, title: str) -> Xml.Element:
    return Xml.SubElement(
        parent, "g", {"id": title, "inkscape:groupmode": "layer", "inkscape:label": title}
    )


def _text(parent: Xml.Element, text: str, position: Point, size: float) -> None:
    style = {"x": _number(position[0]), "y": _number(position[1]), "font-size": _number(size)}
    Xml.SubElement(parent, "text", {**style, "fill": "black", "stroke": "none"}).text = text


def _number(value: float) -> str:
    """Format a length in mm to 0.1 um, without trailing zeros."""
    text = f"{value:.4f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text
