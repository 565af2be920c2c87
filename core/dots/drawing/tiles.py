"""Floors larger than a paper: tiles that continue one area of the pattern."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from locatk.core.dots.codec import check_window
from locatk.core.dots.drawing.layout import SheetLayout
from locatk.core.dots.sheet import Manifest, Sheet
from locatk.core.errors import InputError
from locatk.core.paper_sizes import MAX_PAPER_MM

MAX_TILES = 1000
"""Maximum number of tiles of a floor."""


@dataclass(frozen=True)
class SheetTiling:
    """Floor that is divided into several papers of one layout.

    Attributes
    ----------
    layout : SheetLayout
        Of each paper.
    count : (columns, rows)
        Of papers.
    overlap : (x, y)
        Positions that are printed on both of two neighbours.
    """

    layout: SheetLayout
    count: tuple[int, int]
    overlap: tuple[int, int]

    @property
    def step(self) -> tuple[int, int]:
        """Positions from a paper to its right, and to its lower, neighbour."""
        (columns, rows), (x, y) = self.layout.size, self.overlap
        return columns - x, rows - y

    @property
    def size(self) -> tuple[int, int]:
        """Columns and rows of the pattern on the whole floor."""
        (across, down), (columns, rows) = self.count, self.step
        last = self.layout.size
        return (across - 1) * columns + last[0], (down - 1) * rows + last[1]

    def sheets(
        self, name: str, origin: tuple[int, int], section: tuple[int, int] = (0, 0)
    ) -> tuple[Sheet, ...]:
        """Return the papers, row by row from the upper left one; ``name-c1r1`` is the first.

        The floor's frame is that of its lower left paper, whose position is (0, 0).

        Raises
        ------
        InputError
            No section contains the whole floor.
        """
        check_window(origin, self.size, section)
        (across, down), (columns, rows), r = self.count, self.step, self.layout.raster
        tiles = []
        for row in range(down):
            for column in range(across):
                corner = (origin[0] + column * columns, origin[1] + row * rows)
                (tile,) = self.layout.sheets(f"{name}-c{column + 1}r{row + 1}", corner, section)
                x = r.mm(column * columns * r.pitch)
                y = r.mm((down - 1 - row) * rows * r.pitch)
                tiles.append(replace(tile, position_mm=(x, y)))
        return tuple(tiles)


def tiling(layout: SheetLayout, count: tuple[int, int], overlap_mm: float) -> SheetTiling:
    """Divide a floor into ``count`` papers across and down that overlap by ``overlap_mm``.

    The overlap is rounded up to a whole number of pitches.

    Raises
    ------
    InputError
        There are no papers or too many, or they would overlap by more than a half.
    """
    if min(count) < 1 or count[0] * count[1] > MAX_TILES:
        raise InputError(
            f"{count[0]} x {count[1]} tiles", hint=f"A floor has at least 1 and at most {MAX_TILES}"
        )
    r = layout.raster
    if not 0 <= overlap_mm <= MAX_PAPER_MM:
        raise InputError(f"an overlap of {overlap_mm:g} mm")
    overlap = math.ceil(overlap_mm / r.mm(r.pitch) - 1e-6)
    if overlap > min(layout.size) // 2:
        raise InputError(
            f"an overlap of {overlap_mm:g} mm is more than half of a tile's "
            f"{r.mm(min(layout.size) * r.pitch):.0f} mm",
            hint="Use a smaller overlap",
        )
    return SheetTiling(layout, count, (overlap, overlap))


def seams(manifest: Manifest, number: int) -> tuple[list[float], list[float]]:
    """Return the cuts of a tile towards its neighbours, in the middle of the overlap.

    Returns
    -------
    (x, y) : lists of float
        In mm from the paper's upper left corner to the right and down; empty for a sheet that is no
        tile.
    """
    tile = manifest.sheets[number]
    if tile.position_mm is None:
        return [], []
    cuts: tuple[list[float], list[float]] = ([], [])
    positions = [sheet.position_mm for sheet in manifest.sheets if sheet.position_mm is not None]
    for axis in (0, 1):
        length = (tile.size[axis] - 1) * manifest.pitch_mm
        # The paper's y is downwards, the floor's upwards.
        sign = 1 if axis == 0 else -1
        steps = sorted({round(sign * (p[axis] - tile.position_mm[axis]), 6) for p in positions})
        index = steps.index(0.0)
        # From this tile's first position to the last of its neighbour, or the reverse.
        cuts[axis].extend(
            tile.first_mm[axis] + (step + length) / 2
            for step in steps[max(0, index - 1) : index + 2]
            if step
        )
    return cuts
