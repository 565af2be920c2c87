"""Legend of a floor's plan: how a landmark is read, what a robot sees, the scale."""

from __future__ import annotations

import itertools
import math

from locatk.core.drawing import (
    CAPITAL_HEIGHT_EM,
    MM_PER_POINT,
    Circle,
    Line,
    Mark,
    Point,
    Polygon,
    Text,
    arrow,
)
from locatk.core.landmarks.drawing.landmark import draw_symbol, north_mark
from locatk.core.landmarks.drawing.page import TEXT, line_mm
from locatk.core.landmarks.landmark import PATTERNS, code_of, name
from locatk.core.landmarks.map.floor import Cell, FloorMap

LEGEND_MM = 44.0
"""Height."""

_SMALL = 6.0

WINDOW_CELLS: dict[str, tuple[Cell, ...]] = {
    "L": ((0, 0), (0, 1), (1, 1)),
    "I2": ((0, 0), (0, 1)),
    "I3": ((0, 0), (0, 1), (0, 2)),
    "2x2": ((0, 0), (0, 1), (1, 1), (1, 0)),
    "3x3": ((0, 0), (0, 1), (0, 2), (1, 2), (1, 1), (1, 0), (2, 0), (2, 1), (2, 2)),
}
"""(row, column) of the cells that a robot visits, in their order, when it comes along +x."""

SAMPLE = code_of("NNNS")


def legend(floor: FloorMap, scale: float, corner: Point, width: float) -> list[Mark]:
    """Signs and words in a strip of this width and :data:`LEGEND_MM`, from its lower left."""
    left, bottom = corner
    top = bottom + LEGEND_MM - 4.0
    marks: list[Mark] = [Line((left, top + 1.5), (left + width, top + 1.5), 0.2)]
    marks += _bars((left, top))
    marks += _window(floor.window, (left + 0.36 * width, top))
    marks += _signs(floor, (left + 0.66 * width, top), scale)
    return marks


def _head(text: str, at: Point) -> Text:
    return Text(text, (at[0], at[1] - line_mm(TEXT)), TEXT, bold=True)


def _bars(at: Point) -> list[Mark]:
    """A landmark with the numbers of its bars and the way around."""
    side = 26.0
    x, y = at[0] + 18.0, at[1] - line_mm(TEXT) - 18.5
    marks = [_head(f"A landmark: {name(SAMPLE)}", at), *draw_symbol(SAMPLE, (x, y), side)]
    capital = CAPITAL_HEIGHT_EM * _SMALL * MM_PER_POINT
    out = 0.43 * side
    for bar in range(4):
        u, v = (round(f(math.radians(90 * bar))) for f in (math.cos, math.sin))
        text = f"{bar}: {name(SAMPLE)[bar]}"
        place = (x + out * u, y + out * v - capital / 2)
        marks.append(Text(text, place, _SMALL, "middle", bold=True))
    # The way around: a quarter of a circle between bars 0 and 1.
    radius = 0.52 * side
    angles = [math.radians(25 + 10 * step) for step in range(5)]
    points = [(x + radius * math.cos(a), y + radius * math.sin(a)) for a in angles]
    marks += [Line(a, b, 0.25) for a, b in itertools.pairwise(points[:-1])]
    marks += arrow(points[-2], points[-1], 2.0, 0.25)
    lines = (
        "Bars are counted and read",
        "counter-clockwise, from bar 0",
        "at +x; N: magnetised so, too.",
    )
    for index, text in enumerate(lines):
        marks.append(Text(text, (at[0] + 34.0, at[1] - (index + 2) * line_mm(_SMALL) - 2), _SMALL))
    return marks


def _window(window: str, at: Point) -> list[Mark]:
    """The cells after which a robot knows where it is."""
    cells = WINDOW_CELLS[window]
    rows = 1 + max(row for row, _ in cells)
    side = min(9.0, 27.0 / rows)
    x, y = at[0], at[1] - line_mm(TEXT) - 3.0 - rows * side
    middles = [(x + (c + 0.5) * side, y + (r + 0.5) * side) for r, c in cells]
    marks: list[Mark] = [_head(f"Window {window}", at)]
    capital = CAPITAL_HEIGHT_EM * TEXT * MM_PER_POINT
    for number, (a, b) in enumerate(middles, 1):
        half = side / 2
        corners = ((a - half, b - half), (a + half, b - half), (a + half, b + half))
        marks.append(Polygon((*corners, (a - half, b + half)), width_mm=0.15))
        low = (a - half + 0.8, b + half - 0.8 - capital)
        marks.append(Text(str(number), low, TEXT - 1))
    for start, end in itertools.pairwise(middles):
        marks += arrow(start, end, 1.8, 0.3)
    marks.append(Circle(middles[0], 0.7, 0.3))
    lines = (
        "A robot that has read these in their",
        "order, from any side, knows its place",
        "(locatk map check proves it).",
    )
    for index, text in enumerate(lines):
        down = y - (index + 1) * line_mm(_SMALL) - 0.8
        marks.append(Text(text, (at[0], down), _SMALL))
    return marks


def _signs(floor: FloorMap, at: Point, scale: float) -> list[Mark]:
    """North mark, scale and what the patterns are called."""
    x, y = at
    marks: list[Mark] = [
        _head(f"Scale 1 : {scale:g}", at),
        *north_mark((x + 2.0, y - line_mm(TEXT) - 14.0), 11.0),
    ]
    metre = 10.0 ** math.floor(math.log10(40.0 * scale / 1e3) + 1e-9)
    for factor in (5, 2, 1):
        length = 1e3 * metre * factor / scale
        if length <= 42.0:
            break
    low = y - line_mm(TEXT) - 20.0
    marks += [
        Line((x, low), (x + length, low), 0.3),
        Line((x, low - 1), (x, low + 1), 0.3),
        Line((x + length, low - 1), (x + length, low + 1), 0.3),
        Text(f"{metre * factor:g} m", (x + length + 1.2, low - 0.8), TEXT),
    ]
    patterns = ", ".join(f"{n} {letters}" for n, letters in enumerate(PATTERNS, 1))
    for index, text in enumerate(("Patterns:", patterns[:23], patterns[24:])):
        marks.append(Text(text, (x, low - 4.5 - index * line_mm(_SMALL)), _SMALL))
    return marks
