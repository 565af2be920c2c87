"""Landmarks as they really lie, where ``locatk calibrate map`` has told it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.estimate import GONE
from locatk.core.landmarks.floor import HOLE, Cell, FloorMap
from locatk.core.landmarks.landmark import signs

Array = NDArray[np.float64]


def laid_codes(floor: FloorMap) -> NDArray[np.int64]:
    """Codes (rows, columns) that a robot reads: as designed, but for bars that lie otherwise.

    Of a bar that is missing nobody can tell how it lies: its bit stays the design's.
    """
    codes = floor.codes.copy()
    for cell, built in floor.built.items():
        if codes[cell] == HOLE:
            continue
        designed = signs(codes[cell])
        there = np.abs(built.strength) >= GONE  # False where it is nan
        north = np.where(there, built.strength, designed) > 0
        codes[cell] = int(north @ (1 << np.arange(4)))
    return codes


def laid_mark(floor: FloorMap, cell: Cell) -> tuple[Array, Array]:
    """Pose (3,) in the map's frame and signed strengths (4,) of a landmark as far as known."""
    pose = np.array([*floor.place(cell), 0.0])
    strength = signs(floor.codes[cell])
    built = floor.built.get(cell)
    if built is not None:
        pose = pose + [built.x_m, built.y_m, built.heading_rad]
        strength = np.where(np.isfinite(built.strength), built.strength, strength)
    return pose, strength
