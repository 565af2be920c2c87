"""Windows of a floor: sequences of neighbouring landmarks that a robot reads.

A window is a path over some cells; it can begin at any cell with any of four headings. A map is
unique if no two of its windows read the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.landmark import CODE_COUNT, PATTERN_OF, PATTERNS, code_of, rotated
from locatk.core.landmarks.map.floor import HOLE_CODE, STEPS, FloorMap

Integers = NDArray[np.int64]
Bools = NDArray[np.bool_]

WINDOW_PATHS: dict[str, tuple[tuple[int, int], ...]] = {
    "L": ((0, 0), (1, 0), (1, 1)),
    "I2": ((0, 0), (1, 0)),
    "I3": ((0, 0), (1, 0), (2, 0)),
    "2x2": ((0, 0), (1, 0), (1, 1), (0, 1)),
    "3x3": ((0, 0), (1, 0), (2, 0), (2, 1), (1, 1), (0, 1), (0, 2), (1, 2), (2, 2)),
}
"""Cells of each window in the order of the visit: steps (ahead, left) from the first cell."""

ALPHABET_CODES: dict[str, tuple[int, ...]] = {
    "6": tuple(code_of(letters) for letters in PATTERNS),
    "16": tuple(range(CODE_COUNT)),
    "compass": tuple(code_of(letters) for letters in ("NNNS", "SSSN", "NNSS")),
}
"""Codes of the landmarks of each alphabet.

The three patterns of ``compass`` read differently at every heading, and none like another one at
another heading, so that one landmark gives the heading.
"""


@dataclass(frozen=True, eq=False)
class WindowReadings:
    """Letters that a robot reads in the windows of a floor, one row per window and heading.

    Attributes
    ----------
    letters : (n, k) int64 ndarray
        The paper's pattern number, 1 to 6, with the alphabet ``"6"``; otherwise the code, 0 to 15,
        in the frame of the robot at the first landmark, also after it has turned.
    cells : (n, k, 2) int64 ndarray
        Row and column of each landmark in the order of the visit.
    heading : (n,) int64 ndarray
        Heading at the first landmark, in quarter turns from the map's x.
    """

    letters: Integers
    cells: Integers
    heading: Integers

    def __len__(self) -> int:
        return len(self.heading)


def window_readings(floor: FloorMap) -> WindowReadings:
    """Return the readings of all windows of a floor, in the order of first cell and heading.

    Windows that would leave the floor, cross a wall or visit a hole are left out.
    """
    cells, heading = place_windows(floor.codes != HOLE_CODE, passable_steps(floor), floor.window)
    codes = floor.codes[cells[..., 0], cells[..., 1]]
    return WindowReadings(letters_as_read(codes, heading[:, None], floor.alphabet), cells, heading)


def letters_as_read(codes: Integers, heading: Integers, alphabet: str) -> Integers:
    """Return the letters that a robot reads of ``codes`` at a heading in quarter turns.

    Codes and headings broadcast.
    """
    if alphabet == "6":
        return PATTERN_OF[np.broadcast_arrays(codes, heading)[0]]
    return rotated(codes, -heading)


def passable_steps(floor: FloorMap) -> Bools:
    """Return :meth:`.FloorMap.is_passable` (rows, columns, 4) of each cell and heading.

    No step leads out of a hole.
    """
    has_landmark = floor.codes != HOLE_CODE
    rows, columns = floor.shape
    padded = np.zeros((rows + 2, columns + 2), bool)
    padded[1:-1, 1:-1] = has_landmark
    passable = np.zeros((rows, columns, 4), bool)
    for heading, (row_step, column_step) in enumerate(STEPS):
        has_next = padded[
            1 + row_step : 1 + row_step + rows, 1 + column_step : 1 + column_step + columns
        ]
        passable[..., heading] = has_landmark & has_next
    for first, second in floor.walls:
        for cell, next_cell in ((first, second), (second, first)):
            step = (next_cell[0] - cell[0], next_cell[1] - cell[1])
            if step in STEPS and 0 <= cell[0] < rows and 0 <= cell[1] < columns:
                passable[cell][STEPS.index(step)] = False
    return passable


def window_path(window: str, heading: int) -> Integers:
    """Return rows and columns (k, 2) of a window's cells relative to its first, at a heading."""
    ahead, left = np.array(STEPS[heading % 4]), np.array(STEPS[(heading + 1) % 4])
    steps = np.array(WINDOW_PATHS[window])
    return np.asarray(steps[:, :1] * ahead + steps[:, 1:] * left)


def place_windows(has_landmark: Bools, passable: Bools, window: str) -> tuple[Integers, Integers]:
    """Return the cells (n, k, 2) and headings (n,) of all windows that fit on a floor.

    Parameters
    ----------
    has_landmark : (rows, columns) bool ndarray
    passable : (rows, columns, 4) bool ndarray
        See :func:`passable_steps`.
    window : str
    """
    rows, columns = has_landmark.shape
    fits = np.empty((rows, columns, 4), bool)
    paths = np.stack([window_path(window, heading) for heading in range(4)])
    for heading in range(4):
        fits_heading = has_landmark.copy()
        for (row, column), step in zip(
            paths[heading], np.diff(paths[heading], axis=0), strict=False
        ):
            step_passable = passable[..., STEPS.index((int(step[0]), int(step[1])))]
            fits_heading &= _shift(step_passable, row, column)
        fits[..., heading] = fits_heading
    starts = np.argwhere(fits)
    return starts[:, None, :2] + paths[starts[:, 2]], starts[:, 2]


def _shift(grid: Bools, row: int, column: int) -> Bools:
    """Return the grid with the value of (r + row, c + column) at (r, c), False outside."""
    shifted = np.zeros_like(grid)
    rows, columns = grid.shape
    if abs(row) < rows and abs(column) < columns:
        target = (
            slice(max(0, -row), rows - max(0, row)),
            slice(max(0, -column), columns - max(0, column)),
        )
        source = (
            slice(max(0, row), rows - max(0, -row)),
            slice(max(0, column), columns - max(0, -column)),
        )
        shifted[target] = grid[source]
    return shifted


def encode_readings(letters: Integers) -> Integers:
    """Return one number (n,) per reading (n, k) of letters 0 to 15."""
    return np.asarray(letters @ (CODE_COUNT ** np.arange(letters.shape[1])), np.int64)
