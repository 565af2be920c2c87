"""One tag drawn at true size, so that its magnets can be laid on the drawing by hand.

Forward, the tag's x, is up on the paper. A magnet covers its outline, so what it is aligned
by lies outside: a line through its middle along its moment, with an arrow at the north end,
and a short one across.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

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
from locatk.core.polaris.tag import Cell, TagLayout, Tags, cell_positions, vertices

AXIS_MM, TICK_MM = 4.0, 1.5
"""What the axes take beside the magnets: above and at the left, below and at the right."""

_AXIS_POINTS = 5.0


def field_mm(tags: Tags) -> float:
    """From a tag's origin to where the drawing of its magnets ends, on all four sides."""
    letter = 1.5 * CAPITAL_HEIGHT_EM * _points(tags) * MM_PER_POINT
    return 0.5e3 * (tags.order - 1) * tags.spacing_m + _reach_mm(tags) + letter + 0.5


def _points(tags: Tags) -> float:
    """Size of what is written between the magnets."""
    return min(5.0, max(3.2, 0.35e3 * tags.spacing_m))


def _reach_mm(tags: Tags) -> float:
    """From a magnet's middle to the tip of its arrow: well outside the disc, but two
    arrows that point at each other do not meet."""
    return max(min(10.0, 0.36e3 * tags.spacing_m), 0.5e3 * tags.magnet.diameter_m + 1.0)


def draw_tag(
    tags: Tags, layout: TagLayout, origin: Point, *, mirror: bool = False
) -> tuple[Mark, ...]:
    """Grid, axes, magnets and empty cells of a tag as designed, not as built.

    Parameters
    ----------
    tags : Tags
    layout : Layout
        What the tag's id means.
    origin : (x, y)
        Where the tag's origin lies on the page, in mm. The drawing reaches
        :func:`field_mm` to all sides of it, and the axes as far again as
        :data:`AXIS_MM` above and at the left, :data:`TICK_MM` below and at the right.
    mirror : bool
        As seen from below.
    """
    return tuple(_Drawn(tags, layout, origin, mirror).marks())


@dataclass(frozen=True)
class _Drawn:
    """A tag on the page. Points are (right, up) from its origin in mm, seen from above."""

    tags: Tags
    layout: TagLayout
    origin: Point
    mirror: bool

    def _at(self, right: float, up: float) -> Point:
        """A point's place on the page."""
        side = -right if self.mirror else right
        return self.origin[0] + side, self.origin[1] + up

    def _cell(self, cell: Cell) -> Point:
        """Where a cell is."""
        forward, left = cell_positions(self.tags, (cell,))[0].tolist()
        return -1e3 * left, 1e3 * forward

    def marks(self) -> list[Mark]:
        marks = [*self._grid(), *self._axes()]
        for cell, symbol in zip(self.layout.cells, self.layout.symbols, strict=True):
            marks += self._magnet(cell, symbol)
        order, filled = range(self.tags.order), set(self.layout.cells)
        for cell in [(column, row) for row in order for column in order]:
            if cell not in filled:
                marks += self._empty(cell)
        return marks

    def _grid(self) -> list[Mark]:
        half = 0.5e3 * (self.tags.order - 1) * self.tags.spacing_m
        marks: list[Mark] = []
        for number in range(self.tags.order):
            at, _ = self._cell((number, 0))
            for a, b in (((at, -half), (at, half)), ((-half, at), (half, at))):
                marks.append(Line(self._at(*a), self._at(*b), 0.08, dash_mm=0.6))
        return marks

    def _axes(self) -> list[Mark]:
        """Arrows outside along x and y, ticks opposite to them, a diamond at the origin."""
        field = field_mm(self.tags)
        size = 0.5e3 * self.tags.magnet.diameter_m + 1.0
        diamond = [(size, 0.0), (0.0, size), (-size, 0.0), (0.0, -size)]
        end = field + AXIS_MM - 0.5
        text = (end + field) / 2 - 0.5 * CAPITAL_HEIGHT_EM * _AXIS_POINTS * MM_PER_POINT
        y = self._at(-field - 1.0, 0.7)
        return [
            Polygon(tuple(self._at(*corner) for corner in diamond), width_mm=0.1),
            *self._arrow((0.0, field), (0.0, end), 1.4, 0.2),
            *self._arrow((-field, 0.0), (-end, 0.0), 1.4, 0.2),
            Line(self._at(0, -field), self._at(0, -field - TICK_MM), 0.2),
            Line(self._at(field, 0), self._at(field + TICK_MM, 0), 0.2),
            Text("x forward", (self.origin[0] + 1.2, self.origin[1] + text), _AXIS_POINTS),
            Text("y", y, _AXIS_POINTS, "middle"),
        ]

    def _arrow(self, start: Point, tip: Point, head: float, width: float) -> list[Mark]:
        return arrow(self._at(*start), self._at(*tip), head, width)

    def _magnet(self, cell: Cell, symbol: int) -> list[Mark]:
        """Outline, line along the moment, line across, N, and the angle."""
        x, y = self._cell(cell)
        clockwise = 360 * symbol / self.tags.orientations
        u, v = math.sin(math.radians(clockwise)), math.cos(math.radians(clockwise))
        radius = 0.5e3 * self.tags.magnet.diameter_m
        reach, points = _reach_mm(self.tags), _points(self.tags)
        tail, head, across = 0.6 * reach, min(2.0, 0.3 * reach), radius + min(1.5, 0.2 * reach)
        letter = CAPITAL_HEIGHT_EM * points * MM_PER_POINT
        out = reach + 0.25 + 0.6 * letter
        north = self._at(x + out * u, y + out * v)
        return [
            Circle(self._at(x, y), radius, 0.1),
            *self._arrow((x - tail * u, y - tail * v), (x + reach * u, y + reach * v), head, 0.15),
            Line(
                self._at(x + across * v, y - across * u),
                self._at(x - across * v, y + across * u),
                0.15,
            ),
            Text("N", (north[0], north[1] - letter / 2), points, "middle", bold=True),
            self._label(f"{round(clockwise, 2):g}\u00b0", (x, y), across, (u, v)),
        ]

    def _label(self, text: str, middle: Point, clear: float, north: Point) -> Text:
        """At the right of a magnet, above or below, where the arrow's line is farther."""
        points = _points(self.tags)
        side = -1.0 if self.mirror else 1.0
        above = side * north[0] * north[1] < 0
        away = 0.8 * clear + 0.3
        x, y = self._at(*middle)
        drop = away if above else -away - CAPITAL_HEIGHT_EM * points * MM_PER_POINT
        return Text(text, (x + away, y + drop), points)

    def _empty(self, cell: Cell) -> list[Mark]:
        x, y = self._cell(cell)
        arm = min(1.0, 0.06e3 * self.tags.spacing_m)
        marks: list[Mark] = [
            Line(self._at(x - arm, y), self._at(x + arm, y)),
            Line(self._at(x, y - arm), self._at(x, y + arm)),
        ]
        if cell == vertices(self.tags.order)[3]:
            points = _points(self.tags)
            at = self._at(x, y - arm - 0.4 - CAPITAL_HEIGHT_EM * points * MM_PER_POINT)
            marks.append(Text("v4 empty", at, points, "middle"))
        return marks
