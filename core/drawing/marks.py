"""Marks of a line drawing, in mm, independent of the output as PDF or SVG.

A point is (x, y) from the lower left corner of the page, x to the right and y up; angles are in
degrees, counter-clockwise. Everything is drawn in black.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

Point: TypeAlias = tuple[float, float]

Box: TypeAlias = tuple[float, float, float, float]
"""Left, bottom, right and top edge of a rectangle."""

MM_PER_POINT = 25.4 / 72

LINE_WIDTH_MM = 0.15
"""Default width of a line."""

CAPITAL_HEIGHT_EM = 0.72
"""Height of capitals and digits of Helvetica, as a fraction of the font size."""

MAX_LETTER_WIDTH_EM = 0.6
"""Mean width of the letters of a text, as a fraction of the font size, that few texts exceed in any
sans-serif font."""

LINE_SPACING_EM = 1.3
"""Distance between the baselines of two lines of text, as a fraction of the font size."""

MIN_TEXT_POINTS = 7.0
"""Smallest font size of printed texts, which is legible at arm's length."""

RULER_FONT_POINTS = MIN_TEXT_POINTS
"""Font size of the numbers of a ruler."""

RULER_BASELINE_MM = 2.6
"""Distance of the baseline of a ruler's numbers from its edge."""

RULER_DEPTH_MM = RULER_BASELINE_MM + CAPITAL_HEIGHT_EM * RULER_FONT_POINTS * MM_PER_POINT
"""Extent of a ruler, including its numbers, from its edge."""

CUT_MARK_MM = 3.0
"""Distance of the outer end of a cut mark from the corner."""

CUT_MARK_GAP_MM = 1.0
"""Distance of the inner end of a cut mark from the corner."""

TRUE_SIZE_INSTRUCTION = "Print at 100 %, without scaling, and measure the rulers."
"""Instruction on pages at true size."""

MAX_RULER_LENGTH_MM = 100
"""Length of the rulers of a page that is large enough."""


@dataclass(frozen=True)
class Line:
    """Straight line; ``dash_mm`` is the length of its dashes and of the gaps between them."""

    start: Point
    end: Point
    width_mm: float = LINE_WIDTH_MM
    dash_mm: float | None = None


@dataclass(frozen=True)
class Circle:
    """Circle; its line is centred on ``radius_mm``."""

    centre: Point
    radius_mm: float
    width_mm: float = LINE_WIDTH_MM


@dataclass(frozen=True)
class Polygon:
    """Closed outline, or a filled shape."""

    corners: tuple[Point, ...]
    filled: bool = False
    width_mm: float = LINE_WIDTH_MM


@dataclass(frozen=True)
class Text:
    """Line of text; ``position`` is on its baseline, at the ``anchor``."""

    text: str
    position: Point
    points: float
    anchor: Literal["start", "middle", "end"] = "start"
    bold: bool = False
    angle_deg: float = 0.0


Mark: TypeAlias = Line | Circle | Polygon | Text


@dataclass(frozen=True)
class Group:
    """Related marks under a name that is unique on the page."""

    name: str
    marks: tuple[Mark, ...]


@dataclass(frozen=True)
class Page:
    """Drawing on a paper of ``size_mm`` (width, height)."""

    size_mm: Point
    groups: tuple[Group, ...]


def ruler(start: Point, length_mm: int, *, upright: bool = False) -> tuple[Mark, ...]:
    """Draw a ruler with a tick every mm, a longer one every 5 mm and a number every 10 mm.

    It runs from ``start`` to the right with its ticks below, or up with its ticks to the left; it
    is :data:`RULER_DEPTH_MM` deep.
    """

    def point(along_mm: float, depth_mm: float) -> Point:
        if upright:
            return start[0] - depth_mm, start[1] + along_mm
        return start[0] + along_mm, start[1] - depth_mm

    # The letters of upright text are to the left of its baseline, those of other text above it.
    baseline = RULER_BASELINE_MM if upright else RULER_DEPTH_MM
    angle = 90.0 if upright else 0.0
    marks: list[Mark] = [Line(point(0, 0), point(length_mm, 0))]
    for tick in range(length_mm + 1):
        marks.append(Line(point(tick, 0), point(tick, _tick_length(tick))))
        if tick % 10 == 0:
            position = point(tick, baseline)
            marks.append(Text(str(tick), position, RULER_FONT_POINTS, "middle", angle_deg=angle))
    unit_offset = text_width(str(length_mm), RULER_FONT_POINTS) / 2 + 0.8
    position = point(length_mm + unit_offset, baseline)
    marks.append(Text("mm", position, RULER_FONT_POINTS, angle_deg=angle))
    return tuple(marks)


def _tick_length(tick: int) -> float:
    return 2.2 if tick % 10 == 0 else 1.5 if tick % 5 == 0 else 0.9


def cut_marks(left: float, bottom: float, right: float, top: float) -> tuple[Line, ...]:
    """Draw lines that point to the corners of a rectangle to be cut out.

    They end :data:`CUT_MARK_MM` from the corners.
    """
    marks = []
    for x, sign in ((left, -1), (right, 1)):
        inner, outer = x + sign * CUT_MARK_GAP_MM, x + sign * CUT_MARK_MM
        marks += [Line((inner, y), (outer, y)) for y in (bottom, top)]
    for y, sign in ((bottom, -1), (top, 1)):
        inner, outer = y + sign * CUT_MARK_GAP_MM, y + sign * CUT_MARK_MM
        marks += [Line((x, inner), (x, outer)) for x in (left, right)]
    return tuple(marks)


def arrow(start: Point, tip: Point, head_mm: float, width_mm: float = 0.2) -> list[Line | Polygon]:
    """Draw a line with a filled arrow head of length ``head_mm``."""
    length = math.dist(start, tip)
    u, v = (tip[0] - start[0]) / length, (tip[1] - start[1]) / length
    base = (tip[0] - head_mm * u, tip[1] - head_mm * v)
    half_width = 0.35 * head_mm
    left = (base[0] - half_width * v, base[1] + half_width * u)
    right = (base[0] + half_width * v, base[1] - half_width * u)
    return [Line(start, base, width_mm), Polygon((tip, left, right), filled=True)]


def cross(centre: Point, arm_mm: float, width_mm: float = LINE_WIDTH_MM) -> list[Mark]:
    """Draw a horizontal and a vertical line through a point, ``arm_mm`` to each side."""
    x, y = centre
    return [
        Line((x - arm_mm, y), (x + arm_mm, y), width_mm),
        Line((x, y - arm_mm), (x, y + arm_mm), width_mm),
    ]


def shifted(mark: Mark, dx: float, dy: float) -> Mark:
    """Return a mark at another position."""

    def moved(point: Point) -> Point:
        return point[0] + dx, point[1] + dy

    if isinstance(mark, Line):
        return replace(mark, start=moved(mark.start), end=moved(mark.end))
    if isinstance(mark, Circle):
        return replace(mark, centre=moved(mark.centre))
    if isinstance(mark, Polygon):
        return replace(mark, corners=tuple(map(moved, mark.corners)))
    return replace(mark, position=moved(mark.position))


def rectangle(box: Box, width_mm: float = LINE_WIDTH_MM) -> Polygon:
    """Outline a rectangle with sides along the page."""
    left, bottom, right, top = box
    return Polygon(((left, bottom), (right, bottom), (right, top), (left, top)), width_mm=width_mm)


def page_rulers(size: Point, margin: float) -> list[Mark]:
    """Draw rulers along the lower and the left edge of a page, as long as it permits."""
    corner = margin + RULER_DEPTH_MM
    marks: list[Mark] = []
    for side, upright in ((size[0], False), (size[1], True)):
        # The last 8 mm are for the number at the end and the unit after it.
        length = min(MAX_RULER_LENGTH_MM, int(side - margin - corner - 8) // 10 * 10)
        if length > 0:
            start = (corner, corner + 2) if upright else (corner + 2, corner)
            marks += ruler(start, length, upright=upright)
    return marks


def capital_height(points: float) -> float:
    """Return the height in mm of capitals and digits of a font size."""
    return CAPITAL_HEIGHT_EM * points * MM_PER_POINT


def line_height(points: float, spacing_em: float = LINE_SPACING_EM) -> float:
    """Return the distance in mm between the baselines of two lines of text."""
    return spacing_em * points * MM_PER_POINT


def paragraph(
    lines: Sequence[str],
    corner: Point,
    points: float,
    *,
    spacing_em: float = LINE_SPACING_EM,
    bold: bool = False,
) -> list[Text]:
    """Draw lines of text one below the other.

    The first baseline is one line height below ``corner``, the upper left corner.
    """
    step = line_height(points, spacing_em)
    return [
        Text(line, (corner[0], corner[1] - number * step), points, bold=bold)
        for number, line in enumerate(lines, 1)
    ]


def text_width(text: str, points: float) -> float:
    """Return the width in mm that a line of text hardly exceeds in any sans-serif font."""
    return MAX_LETTER_WIDTH_EM * points * MM_PER_POINT * len(text)


def wrap(text: str, points: float, width_mm: float) -> list[str]:
    """Wrap text to lines of at most ``width_mm``; words that are longer are broken anywhere."""
    max_letters = max(1, int(width_mm / text_width("x", points)))
    return textwrap.wrap(text, max_letters, break_on_hyphens=False)
