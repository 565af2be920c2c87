"""Legend of a floor plan: reading of a landmark, window of a robot, scale."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

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
)
from locatk.core.drawing.pages import TEXT_POINTS
from locatk.core.landmarks.drawing.landmark import draw_symbol, north_mark
from locatk.core.landmarks.landmark import PATTERNS, code_of, name
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.landmarks.map.windows import WINDOW_PATHS

LEGEND_HEIGHT_MM = 44.0
"""Height of the strip with the legend."""

LEGEND_POINTS = 6.0
"""Font size of the explanations."""

MAX_SCALE_BAR_MM = 42.0
"""Largest length of the scale bar."""

SAMPLE_CODE = code_of("NNNS")
"""Code of the landmark that the legend explains."""


def draw_legend(floor: FloorMap, scale: float, corner: Point, width: float) -> list[Mark]:
    """Draw the legend in a strip of this width and :data:`LEGEND_HEIGHT_MM`.

    ``corner`` is the lower left corner of the strip.
    """
    left, bottom = corner
    top = bottom + LEGEND_HEIGHT_MM - 4.0
    return [
        Line((left, top + 1.5), (left + width, top + 1.5), 0.2),
        *_explain_landmark((left, top)),
        *_explain_window(floor.window, (left + 0.36 * width, top)),
        *_explain_scale(scale, (left + 0.66 * width, top)),
    ]


def _heading(text: str, corner: Point) -> list[Text]:
    return paragraph([text], corner, TEXT_POINTS, bold=True)


def _notes(lines: Sequence[str], corner: Point) -> list[Text]:
    return paragraph(lines, corner, LEGEND_POINTS)


def _explain_landmark(corner: Point) -> list[Mark]:
    """Draw a landmark with the numbers of its bars and their order."""
    side = 26.0
    x, y = corner[0] + 18.0, corner[1] - line_height(TEXT_POINTS) - 18.5
    marks: list[Mark] = [
        *_heading(f"A landmark: {name(SAMPLE_CODE)}", corner),
        *draw_symbol(SAMPLE_CODE, (x, y), side),
    ]
    distance, capital = 0.43 * side, capital_height(LEGEND_POINTS)
    for bar, letter in enumerate(name(SAMPLE_CODE)):
        u, v = (round(f(math.radians(90 * bar))) for f in (math.cos, math.sin))
        position = (x + distance * u, y + distance * v - capital / 2)
        marks.append(Text(f"{bar}: {letter}", position, LEGEND_POINTS, "middle", bold=True))
    # The order of the bars: an arc with an arrow from bar 0 to bar 1.
    radius = 0.52 * side
    angles = [math.radians(25 + 10 * step) for step in range(5)]
    points = [(x + radius * math.cos(a), y + radius * math.sin(a)) for a in angles]
    marks += [Line(a, b, 0.25) for a, b in itertools.pairwise(points[:-1])]
    marks += arrow(points[-2], points[-1], 2.0, 0.25)
    lines = (
        "Bars are numbered and read",
        "counter-clockwise, from bar 0",
        "at +x. N: magnetised",
        "counter-clockwise, too.",
    )
    below_heading = corner[1] - line_height(LEGEND_POINTS) - 2
    return [*marks, *_notes(lines, (corner[0] + 34.0, below_heading))]


def _explain_window(window: str, corner: Point) -> list[Mark]:
    """Draw the cells of a window as a robot visits them that drives along +x."""
    cells = [(row, column) for column, row in WINDOW_PATHS[window]]
    rows = 1 + max(row for row, _ in cells)
    side = min(9.0, 27.0 / rows)
    half = side / 2
    left, bottom = corner[0], corner[1] - line_height(TEXT_POINTS) - 3.0 - rows * side
    centres = [(left + (c + 0.5) * side, bottom + (r + 0.5) * side) for r, c in cells]
    marks: list[Mark] = [*_heading(f"Window {window}", corner)]
    for number, (x, y) in enumerate(centres, 1):
        marks.append(rectangle((x - half, y - half, x + half, y + half)))
        position = (x - half + 0.8, y + half - 0.8 - capital_height(TEXT_POINTS))
        marks.append(Text(str(number), position, TEXT_POINTS - 1))
    for start, end in itertools.pairwise(centres):
        marks += arrow(start, end, 1.8, 0.3)
    marks.append(Circle(centres[0], 0.7, 0.3))
    lines = (
        "A robot that reads these cells",
        "in order, from any side, knows its",
        "position (locatk map check proves it).",
    )
    return [*marks, *_notes(lines, (corner[0], bottom - 0.8))]


def _explain_scale(scale: float, corner: Point) -> list[Mark]:
    """Draw the north mark, a scale bar and the numbers of the patterns."""
    x, y = corner
    marks: list[Mark] = [
        *_heading(f"Scale 1 : {scale:g}", corner),
        *north_mark((x + 2.0, y - line_height(TEXT_POINTS) - 14.0), 11.0),
    ]
    length_m = _scale_bar_length(scale)
    length, bar_y = 1e3 * length_m / scale, y - line_height(TEXT_POINTS) - 20.0
    marks += [
        Line((x, bar_y), (x + length, bar_y), 0.3),
        Line((x, bar_y - 1), (x, bar_y + 1), 0.3),
        Line((x + length, bar_y - 1), (x + length, bar_y + 1), 0.3),
        Text(f"{length_m:g} m", (x + length + 1.2, bar_y - 0.8), TEXT_POINTS),
    ]
    patterns = ", ".join(f"{n} {letters}" for n, letters in enumerate(PATTERNS, 1))
    lines = ("Patterns:", patterns[:23], patterns[24:])
    return [*marks, *_notes(lines, (x, bar_y - 4.5 + line_height(LEGEND_POINTS)))]


def _scale_bar_length(scale: float) -> float:
    """Return the longest of 1, 2 or 5 times a power of ten in metres that fits on the page."""
    power_m = 10.0 ** math.floor(math.log10(40.0 * scale / 1e3) + 1e-9)
    for factor in (5, 2):
        if 1e3 * power_m * factor / scale <= MAX_SCALE_BAR_MM:
            return power_m * factor
    return power_m
