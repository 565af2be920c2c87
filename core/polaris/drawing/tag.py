"""Drawing of a tag at true size, for placing its magnets by hand.

The x axis of the tag (forward) points up on the paper. A magnet covers its outline, so the
marks for aligning it extend beyond it: a line through its centre along the moment, with an arrow at
the north end, and a short line across.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from locatk.core.drawing import (
    Circle,
    Line,
    Mark,
    Point,
    Polygon,
    Text,
    arrow,
    capital_height,
    cross,
)
from locatk.core.polaris.tag import Cell, TagLayout, Tags, cell_positions, vertices

AXIS_ARROW_MM = 4.0
"""Space for the arrows of the axes, above and at the left of the magnets."""

AXIS_TICK_MM = 1.5
"""Space for the ticks of the axes, below and at the right of the magnets."""

AXIS_LABEL_POINTS = 5.0
"""Font size of the names of the axes."""

MIN_LABEL_POINTS = 3.2
"""Smallest font size of the labels of the magnets, which is still legible."""

MAX_LABEL_POINTS = 5.0
"""Largest font size of the labels of the magnets."""

MAX_ARROW_MM = 10.0
"""Largest distance of the tip of an arrow from the centre of its magnet."""


def tag_half_side(tags: Tags) -> float:
    """Return half of the side of the square around the drawing of the magnets, in mm."""
    letter = 1.5 * capital_height(_label_points(tags))
    half_grid = 0.5e3 * (tags.order - 1) * tags.spacing_m
    return half_grid + _arrow_length(tags) + letter + 0.5


def _label_points(tags: Tags) -> float:
    """Return the font size of the labels between the magnets."""
    return min(MAX_LABEL_POINTS, max(MIN_LABEL_POINTS, 0.35e3 * tags.spacing_m))


def _arrow_length(tags: Tags) -> float:
    """Return the distance of the tip of an arrow from the centre of its magnet, in mm.

    The tip is well outside the disc, but two arrows that point at each other do not touch.
    """
    length = min(MAX_ARROW_MM, 0.36e3 * tags.spacing_m)
    return max(length, 0.5e3 * tags.magnet.diameter_m + 1.0)


def draw_tag(
    tags: Tags, layout: TagLayout, origin: Point, *, mirror: bool = False
) -> tuple[Mark, ...]:
    """Draw grid, axes, magnets and empty cells of a tag as designed, not as built.

    Parameters
    ----------
    tags : Tags
    layout : TagLayout
        Cells and orientations of the tag's id.
    origin : (x, y)
        Origin of the tag on the page, in mm. The drawing extends :func:`tag_half_side` to all
        sides, and the axes further by :data:`AXIS_ARROW_MM` (above and at the left) and
        :data:`AXIS_TICK_MM` (below and at the right).
    mirror : bool
        Draw the tag as seen from below.
    """
    return tuple(_TagDrawing(tags, layout, origin, mirror).marks())


@dataclass(frozen=True)
class _TagDrawing:
    """Tag on a page. Its points are (right, up) from the origin in mm, seen from above."""

    tags: Tags
    layout: TagLayout
    origin: Point
    mirror: bool

    def _on_page(self, right: float, up: float) -> Point:
        side = -right if self.mirror else right
        return self.origin[0] + side, self.origin[1] + up

    def _cell_centre(self, cell: Cell) -> Point:
        forward, left = cell_positions(self.tags, (cell,))[0].tolist()
        return -1e3 * left, 1e3 * forward

    def marks(self) -> list[Mark]:
        marks = [*self._grid(), *self._axes()]
        for cell, symbol in zip(self.layout.cells, self.layout.symbols, strict=True):
            marks += self._magnet(cell, symbol)
        indices, filled = range(self.tags.order), set(self.layout.cells)
        for cell in [(column, row) for row in indices for column in indices]:
            if cell not in filled:
                marks += self._empty_cell(cell)
        return marks

    def _grid(self) -> list[Mark]:
        half = 0.5e3 * (self.tags.order - 1) * self.tags.spacing_m
        marks: list[Mark] = []
        for index in range(self.tags.order):
            offset, _ = self._cell_centre((index, 0))
            for start, end in (
                ((offset, -half), (offset, half)),
                ((-half, offset), (half, offset)),
            ):
                marks.append(Line(self._on_page(*start), self._on_page(*end), 0.08, dash_mm=0.6))
        return marks

    def _axes(self) -> list[Mark]:
        """Draw arrows along x and y outside, opposite ticks, and a diamond at the origin."""
        half = tag_half_side(self.tags)
        corner = 0.5e3 * self.tags.magnet.diameter_m + 1.0
        diamond = [(corner, 0.0), (0.0, corner), (-corner, 0.0), (0.0, -corner)]
        tip = half + AXIS_ARROW_MM - 0.5
        x_baseline = (tip + half) / 2 - 0.5 * capital_height(AXIS_LABEL_POINTS)
        x_label = (self.origin[0] + 1.2, self.origin[1] + x_baseline)
        y_label = self._on_page(-half - 1.0, 0.7)
        return [
            Polygon(tuple(self._on_page(*point) for point in diamond), width_mm=0.1),
            *self._arrow((0.0, half), (0.0, tip), 1.4, 0.2),
            *self._arrow((-half, 0.0), (-tip, 0.0), 1.4, 0.2),
            Line(self._on_page(0, -half), self._on_page(0, -half - AXIS_TICK_MM), 0.2),
            Line(self._on_page(half, 0), self._on_page(half + AXIS_TICK_MM, 0), 0.2),
            Text("x forward", x_label, AXIS_LABEL_POINTS),
            Text("y", y_label, AXIS_LABEL_POINTS, "middle"),
        ]

    def _arrow(
        self, start: Point, tip: Point, head_mm: float, width_mm: float
    ) -> list[Line | Polygon]:
        return arrow(self._on_page(*start), self._on_page(*tip), head_mm, width_mm)

    def _magnet(self, cell: Cell, symbol: int) -> list[Mark]:
        """Draw the outline, the lines along and across the moment, the letter N and the angle."""
        x, y = self._cell_centre(cell)
        clockwise_deg = 360 * symbol / self.tags.orientations
        u, v = math.sin(math.radians(clockwise_deg)), math.cos(math.radians(clockwise_deg))
        radius = 0.5e3 * self.tags.magnet.diameter_m
        length, points = _arrow_length(self.tags), _label_points(self.tags)
        tail, head = 0.6 * length, min(2.0, 0.3 * length)
        across = radius + min(1.5, 0.2 * length)
        letter = capital_height(points)
        letter_distance = length + 0.25 + 0.6 * letter
        north_x, north_y = self._on_page(x + letter_distance * u, y + letter_distance * v)
        shaft = (x - tail * u, y - tail * v), (x + length * u, y + length * v)
        return [
            Circle(self._on_page(x, y), radius, 0.1),
            *self._arrow(*shaft, head, 0.15),
            Line(
                self._on_page(x + across * v, y - across * u),
                self._on_page(x - across * v, y + across * u),
                0.15,
            ),
            Text("N", (north_x, north_y - letter / 2), points, "middle", bold=True),
            self._angle_label(f"{round(clockwise_deg, 2):g}\u00b0", (x, y), across, (u, v)),
        ]

    def _angle_label(self, text: str, centre: Point, clearance: float, north: Point) -> Text:
        """Write the angle at the right of a magnet, above or below, away from the arrow's line."""
        points = _label_points(self.tags)
        side = -1.0 if self.mirror else 1.0
        is_above = side * north[0] * north[1] < 0
        distance = 0.8 * clearance + 0.3
        x, y = self._on_page(*centre)
        rise = distance if is_above else -distance - capital_height(points)
        return Text(text, (x + distance, y + rise), points)

    def _empty_cell(self, cell: Cell) -> list[Mark]:
        x, y = self._cell_centre(cell)
        arm = min(1.0, 0.06e3 * self.tags.spacing_m)
        marks = cross(self._on_page(x, y), arm)
        if cell == vertices(self.tags.order)[3]:
            points = _label_points(self.tags)
            position = self._on_page(x, y - arm - 0.4 - capital_height(points))
            marks.append(Text("v4 empty", position, points, "middle"))
        return marks
