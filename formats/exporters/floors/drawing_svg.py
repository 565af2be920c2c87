"""Drawings of a floor as SVG at true size, in layers.

Width and height are in mm and the user unit is 1 mm, which is true size for Inkscape and plotters.
The x axis of the floor points right, y up. Layers of Inkscape: walls, the groups of the shapes,
their centres, labels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from xml.etree import ElementTree as Xml

import numpy as np
from numpy.typing import NDArray

from locatk.core.drawing import CAPITAL_HEIGHT_EM, Circle, Line, Point
from locatk.formats.exporters.floors.floor_drawing import FloorDrawing, Placement, Shape

NAMESPACE = "http://www.w3.org/2000/svg"
INKSCAPE = "http://www.inkscape.org/namespaces/inkscape"

LINE_WIDTH_MM = 0.25
WALL_WIDTH_MM = 4

_FONT = "Helvetica, Arial, 'Liberation Sans', sans-serif"


def dumps_svg(drawing: FloorDrawing) -> bytes:
    """Return the SVG of a drawing; the same drawing gives the same bytes."""
    left, bottom, right, top = drawing.box_mm
    width, height = _number(right - left), _number(top - bottom)
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
    Xml.SubElement(root, "title").text = drawing.title
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
    _Canvas(drawing).draw(group)
    Xml.indent(root)
    data: bytes = Xml.tostring(root, encoding="utf-8", xml_declaration=True)
    return data + b"\n"


class _ShapePoints:
    """Outlines, lines, filled shapes, circles and letters of a shape, as slices of its points."""

    def __init__(self, shape: Shape) -> None:
        self.outlines: list[slice] = []
        self.lines: list[slice] = []
        self.filled: list[slice] = []
        self.circles: list[tuple[float, int]] = []
        self.letters: list[tuple[str, int]] = []
        points: list[NDArray[np.float64]] = []

        def add(part: object) -> slice:
            points.append(np.asarray(part, float).reshape(-1, 2))
            stop = sum(map(len, points))
            return slice(stop - len(points[-1]), stop)

        for mark in (mark for _, marks in shape.parts for mark in marks):
            if isinstance(mark, Line):
                self.lines.append(add((mark.start, mark.end)))
            elif isinstance(mark, Circle):
                self.circles.append((mark.radius_mm, add(mark.centre).start))
            else:
                (self.filled if mark.filled else self.outlines).append(add(mark.corners))
        for letter in shape.letters:
            self.letters.append((letter.text, add(letter.centre).start))
        self.points = np.concatenate(points)


class _Canvas:
    """Conversion of a drawing to elements of SVG, whose y axis points down."""

    def __init__(self, drawing: FloorDrawing) -> None:
        self.drawing = drawing
        self.left, self.top = drawing.box_mm[0], drawing.box_mm[3]
        shapes = {item.shape.name: item.shape for item in drawing.placements}
        self.shapes = {name: _ShapePoints(shape) for name, shape in shapes.items()}

    def draw(self, parent: Xml.Element) -> None:
        """Add the layers to an element."""
        drawing = self.drawing
        walls = _layer(parent, "walls") if drawing.walls else parent
        for wall in drawing.walls:
            path = "M" + "L".join(self._pair(end) for end in (wall.start, wall.end))
            Xml.SubElement(walls, "path", {"d": path, "stroke-width": str(WALL_WIDTH_MM)})
        layers = {group: _layer(parent, group) for group in drawing.groups}
        centres, labels = _layer(parent, "centres"), _layer(parent, "labels")
        for placement in drawing.placements:
            self._placement(layers[placement.shape.group], placement)
            x, y = self._on_page(placement.position_mm)
            cross = f"M{_number(x - 3)} {_number(y)}h6M{_number(x)} {_number(y - 3)}v6"
            Xml.SubElement(centres, "path", d=cross)
            baseline = y + drawing.label_distance_mm + drawing.label_height_mm
            _text(labels, placement.label, (x, baseline), drawing.label_height_mm)

    def _on_page(self, point: Point) -> Point:
        return point[0] - self.left, self.top - point[1]

    def _pair(self, point: Point) -> str:
        return " ".join(map(_number, self._on_page(point)))

    def _placement(self, layer: Xml.Element, placement: Placement) -> None:
        group = Xml.SubElement(layer, "g", id=placement.name)
        shape = self.shapes[placement.shape.name]
        c, s = math.cos(placement.heading_rad), math.sin(placement.heading_rad)
        moved = shape.points @ np.array([[c, s], [-s, c]]) + placement.position_mm
        moved = (moved - [self.left, self.top]) * [1.0, -1.0]
        x, y = ([_number(value) for value in axis] for axis in moved.T.tolist())

        def path(parts: Sequence[slice], end: str, **style: str) -> None:
            if parts:
                pairs = (map(" ".join, zip(x[part], y[part], strict=True)) for part in parts)
                text = "".join("M" + "L".join(pair) + end for pair in pairs)
                Xml.SubElement(group, "path", {"d": text, **style})

        path(shape.outlines, "z")
        path(shape.lines, "")
        path(shape.filled, "z", fill="black", stroke="none")
        for radius_mm, index in shape.circles:
            circle = {"cx": x[index], "cy": y[index], "r": _number(radius_mm)}
            Xml.SubElement(group, "circle", circle)
        height = placement.shape.letter_height_mm
        for letter, index in shape.letters:
            _text(group, letter, (moved[index, 0], moved[index, 1] + height / 2), height)


def _layer(parent: Xml.Element, title: str) -> Xml.Element:
    return Xml.SubElement(
        parent, "g", {"id": title, "inkscape:groupmode": "layer", "inkscape:label": title}
    )


def _text(parent: Xml.Element, text: str, baseline: Point, height: float) -> None:
    """Add a text whose capitals have this height."""
    style = {
        "x": _number(baseline[0]),
        "y": _number(baseline[1]),
        "font-size": _number(height / CAPITAL_HEIGHT_EM),
    }
    Xml.SubElement(parent, "text", {**style, "fill": "black", "stroke": "none"}).text = text


def _number(value: float) -> str:
    """Format a length in mm to 0.1 um, without trailing zeros."""
    text = f"{value:.4f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text
