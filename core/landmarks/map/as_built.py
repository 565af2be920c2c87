"""Landmarks as they really lie, where ``locatk calibrate map`` has told it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.landmark import MIN_BAR_STRENGTH, signs
from locatk.core.landmarks.map.floor import HOLE, Cell, FloorMap

Array = NDArray[np.float64]


def laid_codes(floor: FloorMap) -> NDArray[np.int64]:
    """Codes (rows, columns) that a robot reads: as designed, but for bars that lie otherwise.

    Of a bar that is missing nobody can tell how it lies: its bit stays the design's.
    """
    codes = floor.codes.copy()
    for cell in floor.built:
        codes[cell] = laid_code(floor, cell)
    return codes


def laid_code(floor: FloorMap, cell: Cell) -> int:
    """The same of one cell; a hole also beside the map."""
    rows, columns = floor.shape
    if not (0 <= cell[0] < rows and 0 <= cell[1] < columns) or floor.codes[cell] == HOLE:
        return HOLE
    built = floor.built.get(cell)
    if built is None:
        return int(floor.codes[cell])
    there = np.abs(built.strength) >= MIN_BAR_STRENGTH  # False where it is nan
    north = np.where(there, built.strength, signs(floor.codes[cell])) > 0
    return int(north @ (1 << np.arange(4)))
