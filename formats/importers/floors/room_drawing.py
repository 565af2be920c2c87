"""Outline and obstacles of a room from a floor plan, DXF or SVG.

The outline is a closed polyline: in DXF the largest one of a layer or of the drawing, in SVG the
largest closed shape (``polygon``, ``rect``, ``path`` with straight lines, and a ``polyline`` whose
ends meet). In DXF, the closed polylines of another layer are obstacles; in SVG, all other closed
shapes inside the outline are.

An SVG has its unit from ``width`` and ``viewBox`` (as Inkscape writes them); y is mirrored, because
it points down. Styles, groups' visibility and text are ignored; transforms must be translations,
scales, rotations or matrices.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import FormatError, InputError
from locatk.core.polygons import checked_outline, signed_area
from locatk.formats.files import read_bytes
from locatk.formats.importers.floors.dxf import UNIT_M, DxfReader

Array = NDArray[np.float64]

MAX_SVG_BYTES = 16 << 20
"""Largest SVG [bytes]."""

MAX_COORDINATE_M = 1e6
"""Largest coordinate of a drawing [m]; larger ones are mistakes."""

MAX_SHAPES = 1000
"""Largest number of closed shapes."""

CLOSING_TOLERANCE = 1e-6
"""Distance of the ends of a closed line, relative to its size."""

PX_PER_INCH = 96.0
"""Pixels per inch of CSS (W3C, CSS Values and Units Module Level 3, section 6.2)."""

SVG_UNITS_M = {
    **{name: UNIT_M[name] for name in ("mm", "cm", "in")},
    "px": 0.0254 / PX_PER_INCH,
    "": 0.0254 / PX_PER_INCH,
    "pt": 0.0254 / 72,
    "pc": 0.0254 / 6,
    "q": 0.25e-3,
}
"""Lengths of the units of SVG in metres."""

_NUMBER = r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?"
_LENGTH = re.compile(rf"\s*({_NUMBER})\s*([a-zA-Z%]*)\s*")
_TOKEN = re.compile(rf"[a-zA-Z]|{_NUMBER}")
_FUNCTION = re.compile(r"(\w+)\s*\(([^)]*)\)")


@dataclass(frozen=True)
class DrawnRoom:
    """Outlines of a floor plan.

    Attributes
    ----------
    outline_m : (n, 2) ndarray
    obstacles_m : tuple of (k, 2) ndarray
    """

    outline_m: Array
    obstacles_m: tuple[Array, ...]


@np.errstate(over="ignore", invalid="ignore")
def read_dxf_room(
    path: Path,
    layer: str | None = None,
    obstacle_layer: str | None = None,
    unit: str | None = None,
    scale: float = 1.0,
) -> DrawnRoom:
    """Read the outline of a room from a DXF drawing.

    Parameters
    ----------
    path : path
    layer : str, optional
        Layer of the outline; by default, the largest closed polyline of the drawing is the outline.
    obstacle_layer : str, optional
        Layer of obstacles.
    unit : str, optional
        Unit of the drawing, which takes precedence over that of the file.
    scale : float
        The n of a drawing at the scale 1 : n.

    Raises
    ------
    FormatError
        It is not DXF, a layer is missing, the unit is unknown, or no polyline is closed.
    """
    reader = DxfReader(path)
    factor = scale * reader.unit_m(unit)
    outlines, open_handles = reader.closed_outlines([layer] if layer else None)
    if not outlines:
        where = f"layer {layer}" if layer else "the drawing"
        if open_handles:
            raise reader.error(
                f"no polyline of {where} is closed",
                open_handles[0],
                "Close the outline in the CAD program: PEDIT, option Close",
            )
        raise reader.error(
            f"no polyline is on {where}", hint="Draw the walls as one closed polyline"
        )
    if layer and open_handles:
        raise reader.error(
            f"a polyline of layer {layer} is open",
            open_handles[0],
            "Close it, or move it to another layer",
        )
    obstacles: list[tuple[str, Array]] = []
    if obstacle_layer:
        obstacles, open_handles = reader.closed_outlines([obstacle_layer])
        if open_handles:
            raise reader.error(
                f"a polyline of layer {obstacle_layer} is open",
                open_handles[0],
                "Close it: an obstacle is a closed outline",
            )
    handle, outline = max(outlines, key=lambda item: abs(signed_area(item[1])))
    checked = [
        _checked(factor * corners, path, f"handle {name}")
        for name, corners in [(handle, outline), *obstacles]
    ]
    return DrawnRoom(checked[0], tuple(checked[1:]))


@np.errstate(over="ignore", invalid="ignore")  # numbers that are not finite are refused
def read_svg_room(path: Path, unit: str | None = None, scale: float = 1.0) -> DrawnRoom:
    """Read the outline of a room and its obstacles from an SVG drawing.

    Parameters
    ----------
    path : path
    unit : str, optional
        Unit of the coordinates of the drawing, one of
        :data:`~locatk.formats.importers.floors.dxf.UNIT_M`, which takes precedence over that of the
        file.
    scale : float
        The n of a drawing at the scale 1 : n.

    Raises
    ------
    FormatError
        It is not SVG, has no unit, has an open outline or one with curves, or entities.
    """
    reader = _SvgReader(path)
    shapes = reader.shapes
    if not shapes:
        raise FormatError(
            "an outline that is open" if reader.open_shape else "no closed outline",
            file=path,
            where=reader.open_shape,
            hint="Draw the walls as one closed polygon, rectangle or path",
        )
    factor = scale * (reader.unit_m() if unit is None else UNIT_M[unit])
    drawn_m = [factor * np.array([1.0, -1.0]) * corners for _, corners in shapes]
    for (where, _), corners in zip(shapes, drawn_m, strict=True):
        if not np.all(np.abs(corners) <= MAX_COORDINATE_M):
            raise FormatError(
                f"a coordinate beyond {1e-3 * MAX_COORDINATE_M:g} km",
                file=path,
                where=where,
                hint="Check the unit and the scale",
            )
    largest = int(np.argmax([abs(signed_area(corners)) for corners in drawn_m]))
    # The lower left corner of the outline is the origin: that of an SVG is the upper left one.
    origin = drawn_m[largest].min(axis=0)
    outlines = [
        _checked(np.round(corners - origin, 9), path, where)
        for (where, _), corners in zip(shapes, drawn_m, strict=True)
    ]
    outline = outlines.pop(largest)
    inside = [each for each in outlines if _is_within(each, outline)]
    return DrawnRoom(outline, tuple(inside))


def _is_within(inner: Array, outer: Array) -> bool:
    low, high = outer.min(axis=0), outer.max(axis=0)
    return bool(np.all(inner >= low - 1e-6) and np.all(inner <= high + 1e-6))


def _checked(corners_m: Array, path: Path, where: str) -> Array:
    try:
        return checked_outline(corners_m)
    except InputError as error:
        raise FormatError(error.message, file=path, where=where, hint=error.hint) from None


class _SvgReader:
    """Closed shapes of an SVG in its user units, y down; errors name file and line."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.shapes: list[tuple[str, Array]] = []
        self.open_shape: str | None = None
        self._root: dict[str, str] | None = None
        self._transforms = [np.eye(3)]
        self._hidden = 0
        self._parser = expat.ParserCreate(namespace_separator=" ")
        self._parser.StartElementHandler = self._start
        self._parser.EndElementHandler = self._end
        # Entities could name other files, or grow without limit.
        self._parser.EntityDeclHandler = self._refuse_entity
        try:
            self._parser.Parse(read_bytes(path, MAX_SVG_BYTES), True)
        except expat.ExpatError as error:
            raise FormatError(
                f"not SVG ({expat.errors.messages[error.code]})", file=path, where=error.lineno
            ) from None
        if self._root is None:
            raise FormatError("not SVG", file=path, hint="Save the drawing as plain SVG")

    def unit_m(self) -> float:
        """Return the length of a user unit in metres."""
        assert self._root is not None  # by the constructor
        width = _LENGTH.fullmatch(self._root.get("width", ""))
        unit = "" if width is None else width[2].lower()
        box = [float(text) for text in re.findall(_NUMBER, self._root.get("viewBox", ""))]
        if width is None or unit not in SVG_UNITS_M or unit in ("", "px"):
            raise FormatError(
                "the drawing has no unit of length",
                file=self._path,
                hint="Set width and viewBox in mm, or name the unit of its numbers: --units mm",
            )
        length_m = float(width[1]) * SVG_UNITS_M[unit]
        if len(box) == 4:
            if not box[2] > 0:
                raise FormatError("a viewBox without width", file=self._path)
            return length_m / box[2]
        return SVG_UNITS_M["px"]

    def _refuse_entity(self, name: str, *_: Any) -> None:
        raise self._error(f"an XML entity, {name!r}", "Save the drawing as plain SVG")

    def _error(self, message: str, hint: str | None = None) -> FormatError:
        return FormatError(
            message, file=self._path, where=self._parser.CurrentLineNumber, hint=hint
        )

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        tag = name.rsplit(" ", 1)[-1]
        if self._root is None:
            if tag != "svg":
                raise FormatError("not SVG", file=self._path, hint="Save the drawing as plain SVG")
            self._root = attributes
        self._hidden += tag in ("defs", "clipPath", "mask", "marker", "pattern", "symbol")
        matrix = self._transforms[-1]
        if "transform" in attributes:
            matrix = matrix @ self._transform(attributes["transform"])
        self._transforms.append(matrix)
        if self._hidden:
            return
        for corners, is_closed in self._outlines(tag, attributes):
            where = str(self._parser.CurrentLineNumber)
            size = float(np.ptp(corners, axis=0).max()) if len(corners) else 0.0
            if len(corners) < 3 or not size > 0:
                continue
            gap = float(np.linalg.norm(corners[0] - corners[-1]))
            if not is_closed and gap > CLOSING_TOLERANCE * size:
                self.open_shape = self.open_shape or where
                continue
            moved = corners @ matrix[:2, :2].T + matrix[:2, 2]
            self.shapes.append((where, moved))
            if len(self.shapes) > MAX_SHAPES:
                raise self._error(
                    f"more than {MAX_SHAPES} closed shapes", "Delete all but walls and obstacles"
                )

    def _end(self, name: str) -> None:
        self._transforms.pop()
        self._hidden -= name.rsplit(" ", 1)[-1] in (
            "defs",
            "clipPath",
            "mask",
            "marker",
            "pattern",
            "symbol",
        )

    def _outlines(self, tag: str, attributes: dict[str, str]) -> Iterator[tuple[Array, bool]]:
        """Yield the corners of an element, and whether it is closed."""
        if tag in ("polygon", "polyline"):
            numbers = self._numbers(attributes.get("points", ""))
            if len(numbers) % 2:
                raise self._error("points with an odd number of coordinates")
            yield np.array(numbers).reshape(-1, 2), tag == "polygon"
        elif tag == "rect":
            x, y, width, height = (
                self._number(attributes.get(key, "0")) for key in ("x", "y", "width", "height")
            )
            corners = [(x, y), (x + width, y), (x + width, y + height), (x, y + height)]
            yield np.array(corners), True
        elif tag == "path":
            yield from self._path_outlines(attributes.get("d", ""))

    def _path_outlines(self, text: str) -> Iterator[tuple[Array, bool]]:
        """Yield the corners of the parts of a path of straight lines."""
        tokens = _TOKEN.findall(text)
        position, start = np.zeros(2), np.zeros(2)
        corners: list[Array] = []
        command, index = "", 0
        while index < len(tokens):
            if tokens[index].isalpha():
                command = tokens[index]
                index += 1
            kind = command.upper()
            if kind == "Z":
                yield np.array(corners).reshape(-1, 2), True
                corners, position = [], start
                command = ""
                continue
            count = {"M": 2, "L": 2, "H": 1, "V": 1}.get(kind)
            if count is None:
                raise self._error(
                    f"a path with {command or 'numbers without a command'}",
                    "Convert curves to straight lines: only M, L, H, V and Z are read",
                )
            values = tokens[index : index + count]
            if len(values) < count or any(value.isalpha() for value in values):
                raise self._error(f"a path in which {command} has too few numbers")
            index += count
            base = position if command.islower() else np.zeros(2)
            step = np.array([self._number(value) for value in values])
            if kind == "H":
                position = np.array([base[0] + step[0], position[1]])
            elif kind == "V":
                position = np.array([position[0], base[1] + step[0]])
            else:
                position = base + step
            if kind == "M":
                if corners:
                    yield np.array(corners), False
                corners, start = [], position
                # Further pairs of numbers are lines (SVG 2, section 9.3.3).
                command = "l" if command == "m" else "L"
            elif not corners:
                corners = [start]
            corners.append(position)
        if corners:
            yield np.array(corners).reshape(-1, 2), False

    def _transform(self, text: str) -> Array:
        matrix = np.eye(3)
        for name, arguments in _FUNCTION.findall(text):
            v = self._numbers(arguments)
            own = np.eye(3)
            if name == "matrix" and len(v) == 6:
                own[:2] = np.array(v).reshape(3, 2).T
            elif name == "translate" and len(v) in (1, 2):
                own[:2, 2] = v[0], v[1] if len(v) == 2 else 0.0
            elif name == "scale" and len(v) in (1, 2):
                own[0, 0], own[1, 1] = v[0], v[-1]
            elif name == "rotate" and len(v) in (1, 3):
                c, s = math.cos(math.radians(v[0])), math.sin(math.radians(v[0]))
                centre = np.array(v[1:] or [0.0, 0.0])
                own[:2, :2] = [[c, -s], [s, c]]
                own[:2, 2] = centre - own[:2, :2] @ centre
            else:
                raise self._error(
                    f"the transform {name}", "Apply the transforms in the drawing program"
                )
            matrix = matrix @ own
        return matrix

    def _numbers(self, text: str) -> list[float]:
        return [self._number(each) for each in re.findall(_NUMBER, text)]

    def _number(self, text: str) -> float:
        match = _LENGTH.fullmatch(text)
        if match is None or match[2] not in ("", "px"):
            raise self._error(f"{text[:40]!r} is not a number", "Write numbers without units")
        number = float(match[1])
        if not abs(number) < 1e9:
            raise self._error(f"{text[:40]!r} is too large")
        return number
