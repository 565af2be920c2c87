"""Line drawings in mm, before they become a PDF or an SVG.

A point is (x, y) from the page's lower left corner, x to the right and y up; turns are in
degrees, counter-clockwise. Everything is in one ink, black.
"""

from __future__ import annotations

import math
import textwrap
from dataclasses import dataclass
from typing import Literal, TypeAlias

Point: TypeAlias = tuple[float, float]

MM_PER_POINT = 25.4 / 72

LINE_MM = 0.15
"""Width of a line where nothing else is said."""

CAPITAL = 0.72
"""Height of a capital or a digit in sizes of the font (Helvetica)."""

WIDEST = 0.6
"""Width of a letter in sizes of the font that few words exceed, in any sans serif."""

RULER_POINTS = 5.0
RULER_DEPTH_MM = 2.6 + CAPITAL * RULER_POINTS * MM_PER_POINT
"""How far a ruler's numbers reach from its edge."""


@dataclass(frozen=True)
class Line:
    """A straight line; ``dash_mm`` is the length of dashes and of the gaps between them."""

    start: Point
    end: Point
    width_mm: float = LINE_MM
    dash_mm: float | None = None


@dataclass(frozen=True)
class Circle:
    """A circle; its line runs half inside and half outside of ``radius_mm``."""

    centre: Point
    radius_mm: float
    width_mm: float = LINE_MM


@dataclass(frozen=True)
class Polygon:
    """A closed outline, or a black shape."""

    corners: tuple[Point, ...]
    filled: bool = False
    width_mm: float = LINE_MM


@dataclass(frozen=True)
class Words:
    """One line of text; ``at`` is on its baseline, at its start, middle or end."""

    text: str
    at: Point
    points: float
    anchor: Literal["start", "middle", "end"] = "start"
    bold: bool = False
    turn_deg: float = 0.0


Mark: TypeAlias = Line | Circle | Polygon | Words


@dataclass(frozen=True)
class Group:
    """Marks that belong together, under a name that the page has once."""

    name: str
    marks: tuple[Mark, ...]


@dataclass(frozen=True)
class Page:
    """A drawing on a paper of ``size_mm`` (width, height)."""

    size_mm: Point
    groups: tuple[Group, ...]


def ruler(start: Point, length_mm: int, *, upright: bool = False) -> tuple[Mark, ...]:
    """A ruler with a tick each mm, a longer one each 5 mm and a number each 10 mm.

    It runs from ``start`` to the right with its ticks below, or up with its ticks at the
    left; it is :data:`RULER_DEPTH_MM` deep.
    """

    def point(along: float, deep: float) -> Point:
        if upright:
            return start[0] - deep, start[1] + along
        return start[0] + along, start[1] - deep

    # Turned words grow away from their baseline to the left, straight ones upwards.
    baseline = 2.6 if upright else RULER_DEPTH_MM
    turn = 90.0 if upright else 0.0
    marks: list[Mark] = [Line(point(0, 0), point(length_mm, 0))]
    for at in range(length_mm + 1):
        marks.append(Line(point(at, 0), point(at, _tick(at))))
        if at % 10 == 0:
            words = Words(str(at), point(at, baseline), RULER_POINTS, "middle", turn_deg=turn)
            marks.append(words)
    after = text_width(str(length_mm), RULER_POINTS) / 2 + 0.8
    marks.append(Words("mm", point(length_mm + after, baseline), RULER_POINTS, turn_deg=turn))
    return tuple(marks)


def _tick(at: int) -> float:
    return 2.2 if at % 10 == 0 else 1.5 if at % 5 == 0 else 0.9


CUT_MM = 3.0
"""How far cut marks reach."""


def cut_marks(left: float, bottom: float, right: float, top: float) -> tuple[Line, ...]:
    """Lines that lead to the corners of what is to be cut out, up to :data:`CUT_MM` away."""
    near = 1.0
    marks = []
    for x, out in ((left, -1), (right, 1)):
        marks += [Line((x + out * near, y), (x + out * CUT_MM, y)) for y in (bottom, top)]
    for y, out in ((bottom, -1), (top, 1)):
        marks += [Line((x, y + out * near), (x, y + out * CUT_MM)) for x in (left, right)]
    return tuple(marks)


def arrow(start: Point, tip: Point, head_mm: float, width_mm: float = 0.2) -> list[Mark]:
    """A line with a filled head of this length."""
    length = math.dist(start, tip)
    u, v = (tip[0] - start[0]) / length, (tip[1] - start[1]) / length
    back = (tip[0] - head_mm * u, tip[1] - head_mm * v)
    wing = 0.35 * head_mm
    left = (back[0] - wing * v, back[1] + wing * u)
    right = (back[0] + wing * v, back[1] - wing * u)
    return [Line(start, back, width_mm), Polygon((tip, left, right), filled=True)]


TRUE_SIZE = "Print at 100 %, without scaling, and measure the rulers."
"""What a page at true size says."""

RULER_MM = 100


def page_rulers(size: Point, margin: float) -> list[Mark]:
    """Rulers along the lower and the left edge of a page, as far as there is room."""
    corner = margin + RULER_DEPTH_MM
    marks: list[Mark] = []
    for side, upright in ((size[0], False), (size[1], True)):
        # The number at the far end, and "mm" after it, need some room.
        length = min(RULER_MM, int(side - margin - corner - 8) // 10 * 10)
        if length > 0:
            start = (corner, corner + 2) if upright else (corner + 2, corner)
            marks += ruler(start, length, upright=upright)
    return marks


def text_width(text: str, points: float) -> float:
    """Width in mm that a line of text hardly exceeds, whatever sans serif shows it."""
    return WIDEST * points * MM_PER_POINT * len(text)


def wrap(text: str, points: float, width_mm: float) -> list[str]:
    """Lines of at most ``width_mm``; a word that is longer than a line is broken anywhere."""
    most = max(1, int(width_mm / text_width("x", points)))
    return textwrap.wrap(text, most, break_on_hyphens=False)
