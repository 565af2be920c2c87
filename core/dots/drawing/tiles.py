"""Floors that are larger than a paper: tiles that continue one area of the pattern."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from locatk.core.dots.codec import check_window
from locatk.core.dots.drawing.layout import Layout
from locatk.core.dots.sheet import Manifest, Sheet
from locatk.core.errors import InputError
from locatk.core.paper import MAX_PAPER_MM

MOST = 1000
"""Tiles of a floor."""


@dataclass(frozen=True)
class Tiling:
    """A floor that is cut over several papers of one layout.

    Attributes
    ----------
    layout : Layout
        Of each paper.
    count : (columns, rows)
        Of papers.
    overlap : (x, y)
        Places that two neighbours both hold.
    """

    layout: Layout
    count: tuple[int, int]
    overlap: tuple[int, int]

    @property
    def step(self) -> tuple[int, int]:
        """Places from a paper to its right, and to its lower, neighbour."""
        (columns, rows), (x, y) = self.layout.size, self.overlap
        return columns - x, rows - y

    @property
    def size(self) -> tuple[int, int]:
        """Columns and rows of the whole floor."""
        (across, down), (columns, rows) = self.count, self.step
        return (across - 1) * columns + self.layout.size[0], (down - 1) * rows + self.layout.size[1]

    def sheets(
        self, name: str, origin: tuple[int, int], section: tuple[int, int] = (0, 0)
    ) -> tuple[Sheet, ...]:
        """The papers, row by row from the upper left one; ``name-c1r1`` is the first.

        The floor's frame is that of its lower left paper, whose position is (0, 0).

        Raises
        ------
        InputError
            No section holds the floor whole.
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


def tiling(layout: Layout, count: tuple[int, int], overlap_mm: float) -> Tiling:
    """Cut a floor over ``count`` papers across and down, which share ``overlap_mm``.

    The overlap becomes a whole number of pitches, at least what is asked.

    Raises
    ------
    InputError
        There are no papers, or they would share most of what they hold.
    """
    if min(count) < 1 or count[0] * count[1] > MOST:
        raise InputError(
            f"{count[0]} x {count[1]} tiles", hint=f"A floor has at least 1 and at most {MOST}"
        )
    r = layout.raster
    if not 0 <= overlap_mm <= MAX_PAPER_MM:
        raise InputError(f"an overlap of {overlap_mm:g} mm")
    places = math.ceil(overlap_mm / r.mm(r.pitch) - 1e-6)
    if places > min(layout.size) // 2:
        raise InputError(
            f"an overlap of {overlap_mm:g} mm is more than half of a tile's "
            f"{r.mm(min(layout.size) * r.pitch):.0f} mm",
            hint="Use a smaller overlap",
        )
    return Tiling(layout, count, (places, places))


def seams(manifest: Manifest, number: int) -> tuple[list[float], list[float]]:
    """Where a tile is cut for its neighbours: in the middle of what both hold.

    Returns
    -------
    (x, y) : lists of float
        In mm from the paper's upper left corner to the right and down; empty lists for
        a sheet that is no tile.
    """
    here = manifest.sheets[number]
    if here.position_mm is None:
        return [], []
    found: tuple[list[float], list[float]] = ([], [])
    places = [sheet.position_mm for sheet in manifest.sheets if sheet.position_mm is not None]
    for axis in (0, 1):
        reach = (here.size[axis] - 1) * manifest.pitch_mm
        # Down is against the floor's y.
        sign = 1 if axis == 0 else -1
        steps = sorted({round(sign * (p[axis] - here.position_mm[axis]), 6) for p in places})
        nearest = steps.index(0.0)
        # From this tile's first place to the last that its neighbour holds, or the reverse.
        found[axis].extend(
            here.first_mm[axis] + (step + reach) / 2
            for step in steps[max(0, nearest - 1) : nearest + 2]
            if step
        )
    return found
