"""Legend of a floor plan: reading of a landmark, window of a robot, scale."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from functools import partial

from locatk.core.drawing import (
    Circle,
    Line,
    Mark,
    Point,
    Text,
    arrow,
    capital_height,
    line_height,
    paragraph,
    rectangle,
    wrap,
)
from locatk.core.drawing.pages import TEXT_POINTS
from locatk.core.drawing.scale import scale_bar
from locatk.core.landmarks.drawing.landmark import draw_symbol, north_mark
from locatk.core.landmarks.landmark import PATTERNS, code_of, name
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.landmarks.map.windows import WINDOW_PATHS

DRAWING_HEIGHT_MM = 28.0
"""Height of the drawings of the legend, which are above its texts."""

MIN_COLUMN_MM = 24.0
"""Width of the drawings."""

COLUMN_GAP_MM = 3.0
"""Distance between the three columns of the legend."""

EDGE_MM = 4.0
"""Space above the columns, with a line that separates them from the plan."""

LANDMARK_NOTE = (
    "Bars are numbered and read counter-clockwise, from bar 0 at +x. "
    "N: magnetised counter-clockwise, too."
)
WINDOW_NOTE = (
    "A robot that reads these cells in order, from any side, knows its position "
    "(locatk map check proves it)."
)
PATTERNS_NOTE = "Patterns: " + ", ".join(
    f"{n}\u00a0{letters}" for n, letters in enumerate(PATTERNS, 1)
)
"""Texts of the columns; a number stays on the line of its pattern."""

SAMPLE_CODE = code_of("NNNS")
"""Code of the landmark that the legend explains."""


def legend_height(width: float) -> float:
    """Return the height in mm of a legend of a width; infinite if the page is too narrow."""
    column = _column_width(width)
    if column < MIN_COLUMN_MM:
        return math.inf
    notes = (LANDMARK_NOTE, WINDOW_NOTE, PATTERNS_NOTE)
    lines = max(len(wrap(note, TEXT_POINTS, column)) for note in notes)
    texts = line_height(TEXT_POINTS) + (lines + 0.5) * line_height(TEXT_POINTS)
    return EDGE_MM + DRAWING_HEIGHT_MM + texts


def draw_legend(floor: FloorMap, scale: float, corner: Point, width: float) -> list[Mark]:
    """Draw the legend in a strip of this width and its :func:`legend_height`.

    ``corner`` is the lower left corner of the strip.
    """
    left, bottom = corner
    column = _column_width(width)
    top = bottom + legend_height(width) - EDGE_MM
    drawings_top = top - line_height(TEXT_POINTS)
    marks: list[Mark] = [Line((left, top + 1.5), (left + width, top + 1.5), 0.2)]
    columns: tuple[tuple[str, Callable[[Point], list[Mark]], str], ...] = (
        (f"A landmark: {name(SAMPLE_CODE)}", _draw_landmark, LANDMARK_NOTE),
        (f"Window {floor.window}", partial(_draw_window, floor.window), WINDOW_NOTE),
        (f"Scale 1 : {scale:g}", partial(_draw_scale, scale, column), PATTERNS_NOTE),
    )
    for number, (title, draw, note) in enumerate(columns):
        x = left + number * (column + COLUMN_GAP_MM)
        lines = [line.replace("\u00a0", " ") for line in wrap(note, TEXT_POINTS, column)]
        marks += [
            *paragraph([title], (x, top), TEXT_POINTS, bold=True),
            *draw((x, drawings_top)),
            *paragraph(lines, (x, drawings_top - DRAWING_HEIGHT_MM), TEXT_POINTS),
        ]
    return marks


def _column_width(width: float) -> float:
    return (width - 2 * COLUMN_GAP_MM) / 3


def _draw_landmark(corner: Point) -> list[Mark]:
    """Draw a landmark with the numbers of its bars and their order."""
    side = 20.0
    x, y = corner[0] + MIN_COLUMN_MM / 2, corner[1] - DRAWING_HEIGHT_MM / 2
    marks: list[Mark] = [*draw_symbol(SAMPLE_CODE, (x, y), side)]
    distance, capital = 0.43 * side, capital_height(TEXT_POINTS)
    for bar, letter in enumerate(name(SAMPLE_CODE)):
        u, v = (round(f(math.radians(90 * bar))) for f in (math.cos, math.sin))
        position = (x + distance * u, y + distance * v - capital / 2)
        marks.append(Text(f"{bar}: {letter}", position, TEXT_POINTS, "middle", bold=True))
    # The order of the bars: an arc with an arrow from bar 0 to bar 1.
    radius = 0.52 * side
    angles = [math.radians(25 + 10 * step) for step in range(5)]
    points = [(x + radius * math.cos(a), y + radius * math.sin(a)) for a in angles]
    marks += [Line(a, b, 0.25) for a, b in itertools.pairwise(points[:-1])]
    marks += arrow(points[-2], points[-1], 2.0, 0.25)
    return marks


def _draw_window(window: str, corner: Point) -> list[Mark]:
    """Draw the cells of a window as a robot visits them that drives along +x."""
    cells = [(row, column) for column, row in WINDOW_PATHS[window]]
    rows = 1 + max(row for row, _ in cells)
    side = min(9.0, MIN_COLUMN_MM / rows)
    half = side / 2
    left, bottom = corner[0], corner[1] - (DRAWING_HEIGHT_MM + rows * side) / 2
    centres = [(left + (c + 0.5) * side, bottom + (r + 0.5) * side) for r, c in cells]
    marks: list[Mark] = []
    for number, (x, y) in enumerate(centres, 1):
        marks.append(rectangle((x - half, y - half, x + half, y + half)))
        position = (x - half + 0.8, y + half - 0.8 - capital_height(TEXT_POINTS))
        marks.append(Text(str(number), position, TEXT_POINTS))
    for start, end in itertools.pairwise(centres):
        marks += arrow(start, end, 1.8, 0.3)
    marks.append(Circle(centres[0], 0.7, 0.3))
    return marks


def _draw_scale(scale: float, width: float, corner: Point) -> list[Mark]:
    """Draw the north mark and a scale bar."""
    x, y = corner
    return [*north_mark((x + 2.0, y - 14.0), 11.0), *scale_bar((x, y - 20.0), scale, width)]
