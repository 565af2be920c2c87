"""What a robot reads: the landmarks of each window of a floor, under each heading."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.landmark import CODE_COUNT, PATTERN_OF, PATTERNS, code_of, rotated
from locatk.core.landmarks.map.floor import HOLE, STEPS, FloorMap

Integers = NDArray[np.int64]
Bools = NDArray[np.bool_]

PATHS: dict[str, tuple[tuple[int, int], ...]] = {
    "L": ((0, 0), (1, 0), (1, 1)),
    "I2": ((0, 0), (1, 0)),
    "I3": ((0, 0), (1, 0), (2, 0)),
    "2x2": ((0, 0), (1, 0), (1, 1), (0, 1)),
    "3x3": ((0, 0), (1, 0), (2, 0), (2, 1), (1, 1), (0, 1), (0, 2), (1, 2), (2, 2)),
}
"""Cells of each window in order of visit: steps ahead and to the left of the first."""

ALPHABET_CODES: dict[str, tuple[int, ...]] = {
    "6": tuple(code_of(letters) for letters in PATTERNS),
    "16": tuple(range(CODE_COUNT)),
    "compass": tuple(code_of(letters) for letters in ("NNNS", "SSSN", "NNSS")),
}
"""Codes with which a map of each alphabet is laid. The three of ``compass`` look different
under each heading: one landmark tells it."""


@dataclass(frozen=True, eq=False)
class Readings:
    """What the windows of a floor read, one row a window and heading.

    Attributes
    ----------
    letters : (n, k) int64 ndarray
        As the robot reads them: the paper's pattern number, 1 to 6, with the alphabet
        ``"6"``; else the code in the robot's frame, 0 to 15. The frame is the robot's at
        the first landmark, also for those that it reads after a turn of its path.
    cells : (n, k, 2) int64 ndarray
        Row and column of each landmark in order of visit.
    heading : (n,) int64 ndarray
        Quarter turns from the map's x, at the first landmark.
    """

    letters: Integers
    cells: Integers
    heading: Integers

    def __len__(self) -> int:
        return len(self.heading)


def readings(floor: FloorMap) -> Readings:
    """All readings of a floor's windows, by first cell and heading.

    A window that would leave the floor, cross a wall or visit a hole is none.
    """
    cells, heading = placements(floor.codes != HOLE, ways(floor), floor.window)
    codes = floor.codes[cells[..., 0], cells[..., 1]]
    return Readings(as_read(codes, heading[:, None], floor.alphabet), cells, heading)


def as_read(codes: Integers, heading: Integers, alphabet: str) -> Integers:
    """Letters that a robot with a heading of quarter turns reads; both broadcast."""
    if alphabet == "6":
        return PATTERN_OF[codes + 0 * heading]
    return rotated(codes, -heading)


def ways(floor: FloorMap) -> Bools:
    """(rows, columns, 4) :meth:`.FloorMap.open` of each cell and heading; none leads from
    a hole."""
    there = floor.codes != HOLE
    rows, columns = floor.shape
    around = np.zeros((rows + 2, columns + 2), bool)
    around[1:-1, 1:-1] = there
    free = np.zeros((rows, columns, 4), bool)
    for heading, (down, right) in enumerate(STEPS):
        beyond = around[1 + down : 1 + down + rows, 1 + right : 1 + right + columns]
        free[..., heading] = there & beyond
    for one, other in floor.walls:
        for cell, next_cell in ((one, other), (other, one)):
            step = (next_cell[0] - cell[0], next_cell[1] - cell[1])
            if step in STEPS and 0 <= cell[0] < rows and 0 <= cell[1] < columns:
                free[cell][STEPS.index(step)] = False
    return free


def path(window: str, heading: int) -> Integers:
    """(k, 2) rows and columns of a window's cells from its first, under a heading."""
    ahead, left = np.array(STEPS[heading % 4]), np.array(STEPS[(heading + 1) % 4])
    steps = np.array(PATHS[window])
    return np.asarray(steps[:, :1] * ahead + steps[:, 1:] * left)


def placements(there: Bools, free: Bools, window: str) -> tuple[Integers, Integers]:
    """Cells (n, k, 2) and headings (n,) of the windows that fit on a floor.

    ``there`` (rows, columns) says which cells bear a landmark, ``free`` is :func:`ways`.
    """
    rows, columns = there.shape
    fits = np.empty((rows, columns, 4), bool)
    paths = np.stack([path(window, heading) for heading in range(4)])
    for heading in range(4):
        fit = there.copy()
        for (row, column), step in zip(
            paths[heading], np.diff(paths[heading], axis=0), strict=False
        ):
            way = free[..., STEPS.index((int(step[0]), int(step[1])))]
            fit &= _moved(way, row, column)
        fits[..., heading] = fit
    found = np.argwhere(fits)
    return found[:, None, :2] + paths[found[:, 2]], found[:, 2]


def _moved(grid: Bools, row: int, column: int) -> Bools:
    """The grid as seen from cells that lie ``(-row, -column)`` from it; False outside."""
    out = np.zeros_like(grid)
    rows, columns = grid.shape
    if abs(row) < rows and abs(column) < columns:
        out[max(0, -row) : rows - max(0, row), max(0, -column) : columns - max(0, column)] = grid[
            max(0, row) : rows - max(0, -row), max(0, column) : columns - max(0, -column)
        ]
    return out


def encoded(letters: Integers) -> Integers:
    """(n,) one number a reading (n, k) of letters 0 to 15."""
    return np.asarray(letters @ (CODE_COUNT ** np.arange(letters.shape[1])), np.int64)
