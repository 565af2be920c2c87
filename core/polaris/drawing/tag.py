"""Drawing of a tag at true size, for placing its magnets by hand.

The x axis of the tag (forward) points up on the paper. A magnet covers its outline, so the
marks for aligning it extend beyond it: a line through its centre along the moment, with an arrow at
the north end, and a short line across.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from locatk.core.drawing import (
    MIN_TEXT_POINTS,
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
from locatk.core.drawing.placement import Obstacles, interrupt
from locatk.core.polaris.tag import Cell, TagLayout, Tags, cell_positions, vertices

DEGREE = "\u00b0"
"""Last character of the angle of a magnet."""

AXIS_ARROW_MM = 4.0
"""Space for the arrows of the axes, above and at the left of the magnets."""

AXIS_TICK_MM = 1.5
"""Space for the ticks of the axes, below and at the right of the magnets."""

LABEL_POINTS = MIN_TEXT_POINTS
"""Font size of the labels of magnets and axes."""

MAX_ARROW_MM = 10.0
"""Largest distance of the tip of an arrow from the centre of its magnet."""

LETTER_DISTANCE_MM = 0.4 + 0.85 * capital_height(LABEL_POINTS)
"""Distance of the centre of the letter N from the tip of its arrow."""

LETTER_SPACE_MM = LETTER_DISTANCE_MM + 0.6 * capital_height(LABEL_POINTS)
"""Space for the letter N beyond the tip of its arrow."""

MAX_LABEL_DISTANCE_MM = 4.5
"""Largest distance of the angle from its magnet, across and along."""

LABEL_STEP_MM = 0.5
"""Step of the distances at which an angle is tried."""


ANCHORS: tuple[Literal["start", "middle", "end"], ...] = ("middle", "end", "start")
"""Alignments of a text with its point, as they are tried."""


def tag_half_side(tags: Tags) -> float:
    """Return half of the side of the square around the drawing of the magnets, in mm."""
    half_grid = 0.5e3 * (tags.order - 1) * tags.spacing_m
    return half_grid + _arrow_length(tags) + LETTER_SPACE_MM + 0.5


def _arrow_length(tags: Tags) -> float:
    """Return the distance of the tip of an arrow from the centre of its magnet, in mm.

    The tip is well outside the disc, but two arrows that point at each other do not touch, nor do
    their letters unless the magnets are very close.
    """
    spacing_mm = 1e3 * tags.spacing_m
    length = min(MAX_ARROW_MM, 0.36 * spacing_mm, 0.5 * spacing_mm - LETTER_SPACE_MM - 0.3)
    return max(length, 0.5e3 * tags.magnet.diameter_m + 1.0)


def draw_tag(tags: Tags, layout: TagLayout, *, mirror: bool = False) -> tuple[Mark, ...]:
    """Draw grid, axes, magnets and empty cells of a tag as designed, not as built.

    The origin of the tag is at (0, 0). The drawing extends :func:`tag_half_side` to all sides, and
    the axes further by :data:`AXIS_ARROW_MM` (above and at the left) and :data:`AXIS_TICK_MM`
    (below and at the right). Labels that find no space between the lines are left out
    (:func:`has_all_angles`).

    Parameters
    ----------
    tags : Tags
    layout : TagLayout
        Cells and orientations of the tag's id.
    mirror : bool
        Draw the tag as seen from below.
    """
    return tuple(_TagDrawing(tags, layout, mirror).marks())


def has_all_angles(tags: Tags, marks: Sequence[Mark]) -> bool:
    """Return True if a drawing of :func:`draw_tag` contains the angle of each magnet."""
    angles = [mark for mark in marks if isinstance(mark, Text) and mark.text.endswith(DEGREE)]
    return len(angles) == tags.magnets


def angle_text(tags: Tags, symbol: int) -> str:
    """Format the angle of a magnet, in degrees clockwise from the x axis of the tag."""
    return f"{round(360 * symbol / tags.orientations, 2):g}{DEGREE}"


@dataclass(frozen=True)
class _TagDrawing:
    """Tag on a page. Its points are (right, up) from the origin in mm, seen from above."""

    tags: Tags
    layout: TagLayout
    mirror: bool

    def _on_page(self, right: float, up: float) -> Point:
        return -right if self.mirror else right, up

    def _cell_centre(self, cell: Cell) -> Point:
        forward, left = cell_positions(self.tags, (cell,))[0].tolist()
        return -1e3 * left, 1e3 * forward

    def marks(self) -> list[Mark]:
        magnets = list(zip(self.layout.cells, self.layout.symbols, strict=True))
        marks = self._axes()
        for cell, symbol in magnets:
            marks += self._magnet(cell, symbol)
        indices, filled = range(self.tags.order), set(self.layout.cells)
        for cell in [(column, row) for row in indices for column in indices]:
            if cell not in filled:
                marks += cross(self._on_page(*self._cell_centre(cell)), self._cross_arm)
        # Letters interrupt the lines of the grid, and the other labels avoid them.
        half = tag_half_side(self.tags)
        obstacles = Obstacles(marks, (-half, -half, half, half))
        letters = [text for item in magnets for text in obstacles.place([self._letter(*item)])]
        grid = [part for line in self._grid() for part in interrupt(line, letters)]
        obstacles.add(grid)
        angles = [text for item in magnets for text in obstacles.place(self._angle_labels(*item))]
        empty = vertices(self.tags.order)[3]
        note = obstacles.place(self._empty_labels(empty)) if empty not in filled else []
        return [*grid, *marks, *letters, *angles, *note]

    @property
    def _cross_arm(self) -> float:
        return min(1.0, 0.06e3 * self.tags.spacing_m)

    def _grid(self) -> list[Line]:
        half = 0.5e3 * (self.tags.order - 1) * self.tags.spacing_m
        marks: list[Line] = []
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
        x_baseline = (tip + half) / 2 - 0.5 * capital_height(LABEL_POINTS)
        y_label = self._on_page(-half - 1.0, 1.2)
        return [
            Polygon(tuple(self._on_page(*point) for point in diamond), width_mm=0.1),
            *self._arrow((0.0, half), (0.0, tip), 1.4, 0.2),
            *self._arrow((-half, 0.0), (-tip, 0.0), 1.4, 0.2),
            Line(self._on_page(0, -half), self._on_page(0, -half - AXIS_TICK_MM), 0.2),
            Line(self._on_page(half, 0), self._on_page(half + AXIS_TICK_MM, 0), 0.2),
            Text("x forward", (1.2, x_baseline), LABEL_POINTS),
            Text("y", y_label, LABEL_POINTS, "middle"),
        ]

    def _arrow(
        self, start: Point, tip: Point, head_mm: float, width_mm: float
    ) -> list[Line | Polygon]:
        return arrow(self._on_page(*start), self._on_page(*tip), head_mm, width_mm)

    def _magnet(self, cell: Cell, symbol: int) -> list[Mark]:
        """Draw the outline, and the lines along and across the moment."""
        x, y = self._cell_centre(cell)
        u, v = self._moment(symbol)
        radius = 0.5e3 * self.tags.magnet.diameter_m
        length = _arrow_length(self.tags)
        tail, head = 0.6 * length, min(2.0, 0.3 * length)
        across = radius + min(1.5, 0.2 * length)
        shaft = (x - tail * u, y - tail * v), (x + length * u, y + length * v)
        return [
            Circle(self._on_page(x, y), radius, 0.1),
            *self._arrow(*shaft, head, 0.15),
            Line(
                self._on_page(x + across * v, y - across * u),
                self._on_page(x - across * v, y + across * u),
                0.15,
            ),
        ]

    def _moment(self, symbol: int) -> Point:
        """Return the direction of a magnet's moment, right and up."""
        clockwise = math.tau * symbol / self.tags.orientations
        return math.sin(clockwise), math.cos(clockwise)

    def _letter(self, cell: Cell, symbol: int) -> Text:
        """Return the letter N beyond the tip of an arrow."""
        (x, y), (u, v) = self._cell_centre(cell), self._moment(symbol)
        distance = _arrow_length(self.tags) + LETTER_DISTANCE_MM
        north_x, north_y = self._on_page(x + distance * u, y + distance * v)
        baseline = north_y - capital_height(LABEL_POINTS) / 2
        return Text("N", (north_x, baseline), LABEL_POINTS, "middle", bold=True)

    def _angle_labels(self, cell: Cell, symbol: int) -> Iterator[Text]:
        """Yield the angle of a magnet at its right and left, above and below, nearest first."""
        x, y = self._on_page(*self._cell_centre(cell))
        text, height = angle_text(self.tags, symbol), capital_height(LABEL_POINTS)
        steps = [LABEL_STEP_MM * n for n in range(1, round(MAX_LABEL_DISTANCE_MM / LABEL_STEP_MM))]
        for dx, dy in sorted(itertools.product(steps, steps), key=lambda step: math.hypot(*step)):
            for rise in (-dy - height, dy):
                yield Text(text, (x + dx, y + rise), LABEL_POINTS)
                yield Text(text, (x - dx, y + rise), LABEL_POINTS, "end")

    def _empty_labels(self, cell: Cell) -> Iterator[Text]:
        """Yield the label of the corner that is always empty, below and above it."""
        x, y = self._on_page(*self._cell_centre(cell))
        for gap in (0.8, 1.6, 2.4):
            gap += self._cross_arm
            for rise in (-gap - capital_height(LABEL_POINTS), gap):
                for anchor in ANCHORS:
                    yield Text("v4 empty", (x, y + rise), LABEL_POINTS, anchor)
