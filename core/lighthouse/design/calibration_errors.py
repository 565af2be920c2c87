"""Errors of the light planes of a station, by direction, that a solved scene does not contain.

The scene of a recording absorbs those deviations of a station's planes from its calibration that
look like a rotation of the station, a tilt of its planes or a phase. The rest is largest at the
edges of the beam. It is computed here over the whole beam of one station; a scene in which it
is seen in few directions absorbs more, see
:mod:`~locatk.core.lighthouse.design.solved_accuracy`.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.calibration import GENERIC_CALIBRATION, PHASE, TILT, predict_sweeps
from locatk.core.lighthouse.design.solved_accuracy import (
    CALIBRATION_PARAMETERS,
    calibration_spread,
)
from locatk.core.lighthouse.design.visibility import FIELD_OF_VIEW_RAD

Array = NDArray[np.float64]

STEP_RAD = float(np.radians(3.0))
"""Step of the table of directions."""

HALF_WIDTH_RAD, HALF_HEIGHT_RAD = (0.5 * angle for angle in FIELD_OF_VIEW_RAD)


def calibration_sigma(local: Array, has_factory_data: bool = False) -> Array:
    """Return the standard deviations (..., 2) of the angles of both planes [rad].

    Parameters
    ----------
    local : (..., 3) ndarray
        Directions or points in the axes of a station. Outside of
        :data:`~locatk.core.lighthouse.design.visibility.FIELD_OF_VIEW_RAD`, the values at its edge
        are returned.
    has_factory_data : bool
        The solver has the factory calibration of the station, otherwise the generic one.
    """
    table = _table(has_factory_data)
    azimuth = np.arctan2(local[..., 1], local[..., 0])
    elevation = np.arctan2(local[..., 2], np.hypot(local[..., 0], local[..., 1]))
    row, column = (
        np.clip(np.rint((angle + half) / STEP_RAD), 0, size - 1).astype(int)
        for angle, half, size in (
            (azimuth, HALF_WIDTH_RAD, table.shape[0]),
            (elevation, HALF_HEIGHT_RAD, table.shape[1]),
        )
    )
    return np.asarray(table[row, column])


@lru_cache(maxsize=2)
def _table(has_factory_data: bool) -> Array:
    """Return the standard deviations (a, e, 2) at the directions of a grid."""
    azimuth = np.arange(-HALF_WIDTH_RAD, HALF_WIDTH_RAD + 1e-9, STEP_RAD)
    elevation = np.arange(-HALF_HEIGHT_RAD, HALF_HEIGHT_RAD + 1e-9, STEP_RAD)
    a, e = (grid.ravel() for grid in np.meshgrid(azimuth, elevation, indexing="ij"))
    direction = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=1)
    errors = np.zeros((len(a), 2, CALIBRATION_PARAMETERS))
    absorbed = np.zeros((len(a), 2, 6))  # rotation vector, tilts, phase of the second plane
    for plane in (0, 1):
        _, gradient, parameters = predict_sweeps(
            direction, np.full(len(a), plane), GENERIC_CALIBRATION
        )
        errors[:, plane, 7 * plane : 7 * plane + 7] = parameters
        absorbed[:, plane, :3] = np.cross(gradient, direction)
        if not has_factory_data:
            absorbed[:, plane, 3 + plane] = parameters[:, TILT]
            if plane == 1:
                absorbed[:, plane, 5] = parameters[:, PHASE]
    rows, columns = absorbed.reshape(-1, 6), errors.reshape(-1, CALIBRATION_PARAMETERS)
    rest = columns - rows @ np.linalg.lstsq(rows, columns, rcond=None)[0]
    variance = np.einsum("ni,ij,nj->n", rest, calibration_spread(has_factory_data), rest)
    return np.sqrt(variance).reshape(len(azimuth), len(elevation), 2)
