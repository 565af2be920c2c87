"""Division of a large drawing at true size over papers or strips of a roll.

Neighbouring tiles overlap and are cut along a seam in the middle of the overlap.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from locatk.core.drawing.marks import Box, Line, Mark, Point, Text
from locatk.core.drawing.pages import TEXT_POINTS
from locatk.core.drawing.placement import Obstacles, interrupt
from locatk.core.errors import InputError
from locatk.core.paper_sizes import Paper

SEAM_DASH_MM = 5.0
"""Length of the dashes of a cut."""

SEAM_LABEL_STEP_MM = 2.0
"""Step of the positions along a cut at which its label is tried."""

MAX_PAGE_MM = 5000.0
"""Largest side of a page cut from a roll; a PDF page may be 200 inches (ISO 32000-1, annex C)."""


@dataclass(frozen=True)
class Tile:
    """Part of a large drawing that is printed on one page.

    Attributes
    ----------
    name : str
        ``c1r1`` is the upper left tile.
    box : (left, bottom, right, top)
        Area of the drawing, in mm from the lower left corner of the page.
    corner_mm : (x, y)
        Lower left corner of the box, in the frame of the drawing.
    seams : (x, y)
        Coordinates of the cuts to neighbouring tiles, in mm from the lower left corner of the page.
    neighbours : (x, y)
        Names of the tiles beyond these cuts.
    """

    name: str
    box: Box
    corner_mm: Point
    seams: tuple[tuple[float, ...], tuple[float, ...]]
    neighbours: tuple[tuple[str, ...], tuple[str, ...]]

    def seam_marks(self, drawing: Sequence[Mark] = ()) -> list[Mark]:
        """Draw dashed lines along the cuts, with the names of the tiles beyond them.

        The lines leave the texts of the ``drawing`` free, and the names avoid its lines and texts.
        """
        texts = [mark for mark in drawing if isinstance(mark, Text)]
        left, bottom, right, top = self.box
        lines = [Line((x, bottom), (x, top), 0.1, SEAM_DASH_MM) for x in self.seams[0]]
        lines += [Line((left, y), (right, y), 0.1, SEAM_DASH_MM) for y in self.seams[1]]
        obstacles = Obstacles([*drawing, *lines], self.box)
        labels: list[Text] = []
        for axis, (seams, names) in enumerate(zip(self.seams, self.neighbours, strict=True)):
            for seam, name in zip(seams, names, strict=True):
                labels += obstacles.place(self._seam_labels(f"joins {name}", axis, seam))
        return [*(part for line in lines for part in interrupt(line, texts)), *labels]

    def _seam_labels(self, text: str, axis: int, seam: float) -> Iterator[Text]:
        """Yield a text along a cut, inside of it, from its middle to its ends."""
        low, high = self.box[1 - axis], self.box[3 - axis]
        is_first = seam < (self.box[axis] + self.box[axis + 2]) / 2
        steps = int((high - low) / 2 / SEAM_LABEL_STEP_MM)
        for step in sorted(range(-steps, steps + 1), key=abs):
            along = (low + high) / 2 + step * SEAM_LABEL_STEP_MM
            if axis == 0:
                # Upright text extends to the left of its baseline.
                position = (seam + (3.0 if is_first else -1.0), along)
                yield Text(text, position, TEXT_POINTS, "middle", angle_deg=90)
            else:
                position = (along, seam + (1.0 if is_first else -3.0))
                yield Text(text, position, TEXT_POINTS, "middle")


@dataclass(frozen=True)
class TileGrid:
    """Division of a rectangle over equal pages.

    Attributes
    ----------
    extent_mm : (left, bottom, right, top)
        Rectangle that is divided, in the frame of the drawing.
    page_mm : (width, height)
    count : (columns, rows)
    margin_mm : float
        Border of each page without drawing.
    overlap_mm : float
        Width of the drawing that neighbouring tiles share.
    """

    extent_mm: Box
    page_mm: Point
    count: tuple[int, int]
    margin_mm: float
    overlap_mm: float

    @property
    def tile_count(self) -> int:
        return math.prod(self.count)

    @property
    def tile_mm(self) -> Point:
        """Width and height of the drawing on each page."""
        return self.page_mm[0] - 2 * self.margin_mm, self.page_mm[1] - 2 * self.margin_mm

    def tiles(self) -> list[Tile]:
        """Return the tiles, row by row from the upper left one; the drawing is in their centre."""
        return [self._tile(index) for index in range(self.tile_count)]

    def _tile(self, index: int) -> Tile:
        row, column = divmod(index, self.count[0])
        low, high = self.extent_mm[:2], self.extent_mm[2:]
        corner, seams = [], []
        for axis, number in enumerate((column, self.count[1] - 1 - row)):
            side, last = self.tile_mm[axis], self.count[axis] - 1
            step = side - self.overlap_mm
            start = low[axis] - (last * step + side - (high[axis] - low[axis])) / 2
            corner.append(start + number * step)
            before = [self.margin_mm + self.overlap_mm / 2] if number > 0 else []
            after = [self.margin_mm + side - self.overlap_mm / 2] if number < last else []
            seams.append((*before, *after))
        box = (
            self.margin_mm,
            self.margin_mm,
            self.margin_mm + self.tile_mm[0],
            self.margin_mm + self.tile_mm[1],
        )
        return Tile(
            tile_name(index, self.count[0]),
            box,
            (corner[0], corner[1]),
            (seams[0], seams[1]),
            self._neighbours(index),
        )

    def _neighbours(self, index: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return the names of the tiles beyond the cuts of a tile, in their order."""
        columns, rows = self.count
        row, column = divmod(index, columns)
        across = [index + step for step in (-1, 1) if 0 <= column + step < columns]
        upwards = [index - step * columns for step in (-1, 1) if 0 <= row - step < rows]
        names = [
            tuple(tile_name(other, columns) for other in others) for others in (across, upwards)
        ]
        return names[0], names[1]


def divide_area(extent_mm: Box, paper: Paper, margin_mm: float, overlap_mm: float) -> TileGrid:
    """Divide a rectangle over papers, in the orientation with the fewest pages and least paper.

    Raises
    ------
    InputError
        The overlap is negative or more than half of a tile.
    """
    grids = [
        _divide(extent_mm, page_mm, margin_mm, overlap_mm)
        for page_mm in (paper.size_mm, paper.size_mm[::-1])
    ]
    return min(grids, key=lambda grid: (grid.tile_count, math.prod(grid.page_mm)))


def _divide(extent_mm: Box, page_mm: Point, margin_mm: float, overlap_mm: float) -> TileGrid:
    """Divide a rectangle over pages of one orientation; an infinite side is that of a roll."""
    left, bottom, right, top = extent_mm
    sides, counts = [], []
    for length, page_side in zip((right - left, top - bottom), page_mm, strict=True):
        tile_side = min(page_side, MAX_PAGE_MM) - 2 * margin_mm
        if not overlap_mm >= 0:  # nan too
            raise InputError(f"an overlap of {overlap_mm:g} mm is below 0")
        if tile_side <= 0:
            raise InputError(
                f"margins of {margin_mm:g} mm leave nothing of a page of {page_side:g} mm",
                hint="Use smaller margins",
            )
        if overlap_mm > tile_side / 2:
            raise InputError(
                f"an overlap of {overlap_mm:g} mm is more than half of a tile's {tile_side:.0f} mm",
                hint="Use a smaller overlap",
            )
        count = 1
        if length > tile_side:
            count = math.ceil((length - overlap_mm) / (tile_side - overlap_mm) - 1e-9)
        if math.isinf(page_side):
            # A roll is cut to length, in strips of equal whole millimetres.
            tile_side = math.ceil((length + (count - 1) * overlap_mm) / count)
        sides.append(tile_side + 2 * margin_mm)
        counts.append(count)
    return TileGrid(extent_mm, (sides[0], sides[1]), (counts[0], counts[1]), margin_mm, overlap_mm)


def tile_name(index: int, columns: int) -> str:
    """Return the name of a part of a drawing by column and row: ``c1r1`` is the upper left one."""
    return f"c{index % columns + 1}r{index // columns + 1}"
