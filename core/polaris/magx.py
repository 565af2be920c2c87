"""Published arrays of MagX (Chen et al., MobiCom 2021, doi:10.1145/3447993.3483260).

The release (github.com/dychen24/magx, ``Codes/optimization/config.py``) has seven layouts of eight
MLX90393, in the order in which the firmware sends the readings and in the axes of the parts.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.polaris.array import SensorArray
from locatk.core.polaris.mlx90393 import Settings, published_bar

Array = NDArray[np.float64]


def _corners(side: float, depth: float) -> Array:
    """Return four corners on each of two planes [mm]."""
    corners = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]]) * side
    return np.vstack([np.column_stack([corners, np.full(4, z)]) for z in (-depth, depth)])


def _boards(side: float) -> Array:
    """Return the corners of a lower board and the middles of the edges of an upper one [mm]."""
    signs = [[1, -1, -1], [-1, -1, -1], [1, 1, -1], [-1, 1, -1]]
    signs += [[0, -1, 1], [-1, 0, 1], [1, 0, 1], [0, 1, 1]]
    return np.array(signs) * [side, side, 16.3]


LAYOUTS_MM: dict[str, Array] = {
    "magx-large": _boards(49.0),
    "magx-medium": _boards(40.0),
    "magx-small": _boards(30.0),
    # The order on the boards differs from that of the cubes.
    "magx-stacked": _corners(49.0, 16.3)[[1, 3, 0, 2, 5, 7, 4, 6]],
    "magx-flat": 48.9
    * np.array([[x, y, 0.0] for x in (1.0, 0.0, -1.0) for y in (1.0, 0.0, -1.0) if x or y]),
    "magx-cube": _corners(48.9, 49.0),
    "magx-flat-cube": _corners(48.9, 16.0),
}
"""Positions (8, 3) of the sensors in millimetres, along X (right), Y (back) and Z (down) of the
parts."""


def published_array(name: str) -> SensorArray:
    """Return a published array, with the settings of the release (OSR 3, filter 5).

    Raises
    ------
    InputError
        There is no layout of this name.
    """
    if name not in LAYOUTS_MM:
        raise InputError(f"no array {name!r}", hint=f"Known: {', '.join(LAYOUTS_MM)}")
    # Axes of the array from those of the part: x = -Y, y = -X, z = -Z.
    position_m = 0.0 - 1e-3 * LAYOUTS_MM[name][:, [1, 0, 2]]
    return replace(published_bar(1, settings=Settings(filt=5)), position_m=position_m)
