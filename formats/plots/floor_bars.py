"""Where the bars of a floor lie, for what is drawn of it on a screen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.map.floor import Cell, FloorMap, as_built_landmark

Array = NDArray[np.float64]

MOST_LANDMARKS = 2500
"""Of a larger floor only those near the paths are drawn."""

NEAR_PITCHES = 3.0
"""How near, in pitches of the floor."""

WEAK = 0.3
"""A bar that was found to have a lesser strength is drawn as missing."""


def cells_near(floor: FloorMap, paths: Sequence[Array]) -> list[Cell]:
    """Cells with a landmark, where they are too many only those near ``paths``."""
    cells = floor.cells()
    if len(cells) <= MOST_LANDMARKS:
        return cells
    place = np.concatenate([path[:, :2] for path in paths]) if paths else np.zeros((0, 2))
    place = place[np.isfinite(place).all(axis=1)]
    column, row = np.round((place - floor.origin_m) / floor.pitch_m).T
    met = set(zip(row.tolist(), column.tolist(), strict=True))
    reach = np.arange(-NEAR_PITCHES, NEAR_PITCHES + 1)
    near = {(r + dr, c + dc) for r, c in met for dr in reach for dc in reach}
    return [cell for cell in cells if cell in near]


def bars_on_floor(floor: FloorMap, cell: Cell) -> tuple[Array, Array, Array]:
    """The four bars of a cell, as built where that is known.

    Returns
    -------
    (4, 2), (4,), (4,) ndarray
        Their middles in the map's frame, in metres; the directions in which they are
        magnetised; their strengths, positive where N, 0 where missing.
    """
    pose, strength = as_built_landmark(floor, cell)
    at = pose[2] + np.arange(4) * np.pi / 2
    middles = pose[:2] + floor.geometry.radius_m * np.column_stack([np.cos(at), np.sin(at)])
    return middles, at + np.where(strength < 0, -np.pi / 2, np.pi / 2), strength
