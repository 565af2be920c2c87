"""Positions of the bars of a floor, for pictures of it on a screen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.map.floor import Cell, FloorMap, as_built_landmark

Array = NDArray[np.float64]

MAX_DRAWN_LANDMARKS = 2500
"""If a floor has more landmarks, only those near the paths are drawn."""

DRAWN_MARGIN_CELLS = 3
"""Distance from a path, in cells along rows and columns, within which they are drawn."""

MIN_DRAWN_STRENGTH = 0.3
"""Bars of lower measured strength (1 is nominal) are drawn as missing."""


def cells_near(floor: FloorMap, paths: Sequence[Array]) -> list[Cell]:
    """Return the cells with a landmark; if there are too many, only those near ``paths``.

    Parameters
    ----------
    floor : FloorMap
    paths : sequence of (n, 2) or (n, 3) ndarray
        Positions in metres in the map's frame; rows that are not finite are ignored.
    """
    cells = floor.cells()
    if len(cells) <= MAX_DRAWN_LANDMARKS:
        return cells
    positions = np.concatenate([path[:, :2] for path in paths]) if paths else np.zeros((0, 2))
    positions = positions[np.isfinite(positions).all(axis=1)]
    column, row = np.round((positions - floor.origin_m) / floor.pitch_m).T
    visited = set(zip(row.tolist(), column.tolist(), strict=True))
    margin = range(-DRAWN_MARGIN_CELLS, DRAWN_MARGIN_CELLS + 1)
    near = {(r + dr, c + dc) for r, c in visited for dr in margin for dc in margin}
    return [cell for cell in cells if cell in near]


def bars_on_floor(floor: FloorMap, cell: Cell) -> tuple[Array, Array, Array]:
    """Return the four bars of a cell, as built if that is known.

    Returns
    -------
    (4, 2), (4,), (4,) ndarray
        Centres in metres in the map's frame; directions of magnetization [rad]; strengths,
        positive for N, negative for S, 0 for missing bars.
    """
    pose, strength = as_built_landmark(floor, cell)
    angle = pose[2] + np.arange(4) * np.pi / 2
    offsets = np.column_stack([np.cos(angle), np.sin(angle)])
    centres = pose[:2] + floor.geometry.radius_m * offsets
    return centres, angle + np.where(strength < 0, -np.pi / 2, np.pi / 2), strength
