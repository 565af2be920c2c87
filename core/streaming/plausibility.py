"""Limits of measurements beyond which a message was damaged on its way.

A sum over such a value, of distances or of squares, would lose all later ones to rounding.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MAX_COORDINATE_M = 1e8
"""Largest coordinate of odometry [m]. Those of UTM are up to 1e7; doubles resolve 1.5e-8 m here."""

MAX_FIELD_T = 10.0
"""Largest magnetic field [T]: beyond the ranges of all hall sensors, and ten times the field at the
surface of a magnet."""

MAX_SPECIFIC_FORCE_M_S2, MAX_ANGULAR_RATE_RAD_S = 4000.0, 100.0
"""Largest readings of an IMU: twice the widest range of MEMS accelerometers (200 g, ADXL372), and
above that of gyroscopes (4000 degrees per second, 70 rad/s, ICM-42686)."""


def is_plausible_odometry(odometry: Trajectory) -> Mask:
    """Return which poses (n,) have a position in the plane and an orientation."""
    values = np.hstack([odometry.position[:, :2], odometry.quaternion])
    # False for nan.
    return np.asarray((np.abs(values) < MAX_COORDINATE_M).all(axis=1))


def plausible_fields(field_t: Array) -> Array:
    """Return magnetic fields of any shape with ``nan`` in the place of impossible ones."""
    is_plausible = np.abs(field_t) < MAX_FIELD_T
    return field_t if is_plausible.all() else np.where(is_plausible, field_t, np.nan)
