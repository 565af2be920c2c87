"""Bar magnets of a floor of landmarks, as drawn in figures and viewers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.map.floor import Cell, FloorMap, as_built_landmark

Array = NDArray[np.float64]

MAX_LANDMARKS = 2500
"""Number of landmarks up to which a floor is drawn completely; drawing 10,000 bars takes about a
second. Of a larger floor only the landmarks near the trajectories are drawn."""

MAX_CELLS_FROM_PATH = 3
"""Distance [cells] from a trajectory up to which the landmarks of a large floor are drawn."""

MIN_BAR_STRENGTH = 0.3
"""Strength of a bar, relative to the nominal one, below which it is drawn as weak or missing."""


def cells_near(floor: FloorMap, positions_m: Sequence[Array]) -> list[Cell]:
    """Return the cells with a landmark, of a large floor only those near trajectories.

    ``positions_m`` are the positions (n, 2 or more) of each trajectory, in the frame of the map.
    """
    cells = floor.cells()
    if len(cells) <= MAX_LANDMARKS:
        return cells
    points = [each[:, :2] for each in positions_m]
    position = np.concatenate(points) if points else np.zeros((0, 2))
    position = position[np.isfinite(position).all(axis=1)]
    column, row = np.round((position - floor.origin_m) / floor.pitch_m).astype(int).T
    visited = set(zip(row.tolist(), column.tolist(), strict=True))
    offsets = range(-MAX_CELLS_FROM_PATH, MAX_CELLS_FROM_PATH + 1)
    near = {(r + dr, c + dc) for r, c in visited for dr in offsets for dc in offsets}
    return [cell for cell in cells if cell in near]


def bars_on_floor(floor: FloorMap, cell: Cell) -> tuple[Array, Array, Array]:
    """Return the four bars of a cell, as built if that is known.

    Returns
    -------
    centre_m : (4, 2) ndarray
        In the frame of the map.
    heading_rad : (4,) ndarray
        Direction of magnetisation.
    strength : (4,) ndarray
        Relative to the nominal one; positive for an N bar, 0 for a missing one.
    """
    pose, strength = as_built_landmark(floor, cell)
    bearing = pose[2] + np.arange(4) * np.pi / 2
    radial = np.column_stack([np.cos(bearing), np.sin(bearing)])
    centre = pose[:2] + floor.geometry.radius_m * radial
    return centre, bearing + np.where(strength < 0, -np.pi / 2, np.pi / 2), strength
