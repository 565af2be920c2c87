"""Geometry of the light planes of a base station: LFSR counts, rotor angles, planes and rays.

A base station is at the origin of its own axes: x forward, y left, z up. Its rotor carries
two light planes that rotate about z. Each plane contains the horizontal direction in which
it points and is tilted about that direction, the first (index 0) by +30 degrees and the
second (index 1) by -30 degrees, both nominal. The rotor angle of a plane is the azimuth of
its horizontal direction, 0 straight ahead. Both planes of a rotation that cross a photodiode
determine the ray from the station to it.

Arrays of pairs have a last axis of length 2: first and second plane of one rotation.
:mod:`~locatk.core.lighthouse.calibration` describes how real planes differ from these.

References
----------
Bitcraze, crazyflie-firmware, docs/functional-areas/lighthouse/kalman_measurement_model.md.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.channels import period_counts

PLANE_TILT_RAD = np.array([np.pi / 6, -np.pi / 6])
"""(2,) nominal tilt of the two planes about their horizontal direction
(kalman_measurement_model.md)."""

ROTOR_ZERO_RAD = np.array([-np.pi + np.pi / 3, -np.pi - np.pi / 3])
"""(2,) rotor angle of each plane at count 0: the planes point straight ahead after 120 and 240
degrees of a rotation (kalman_measurement_model.md)."""


def counts_to_angles(
    counts: NDArray[np.float64], channel: NDArray[np.int32] | int
) -> NDArray[np.float64]:
    """Return the rotor angles of pairs of sweeps.

    Parameters
    ----------
    counts : (..., 2) ndarray
        LFSR indices of the first and second sweep; ``nan`` for a sweep that is missing.
    channel : int or (...) ndarray
        1 to 16.

    Returns
    -------
    (..., 2) ndarray
        Rotor angles in radians, 0 straight ahead; ``nan`` for a missing sweep.

    Notes
    -----
    The same formula as in kalman_measurement_model.md. The paper's alpha (Eq. 1) is this angle
    without :data:`ROTOR_ZERO_RAD`.
    """
    revolutions = np.asarray(counts) / np.asarray(period_counts(channel))[..., None]
    return 2 * np.pi * revolutions + ROTOR_ZERO_RAD


def angles_to_counts(
    angles: NDArray[np.float64], channel: NDArray[np.int32] | int
) -> NDArray[np.float64]:
    """Return the LFSR indices (..., 2), not rounded, of rotor ``angles`` (..., 2) in radians.

    This is the inverse of :func:`counts_to_angles`.
    """
    revolutions = (np.asarray(angles) - ROTOR_ZERO_RAD) / (2 * np.pi)
    return revolutions * np.asarray(period_counts(channel))[..., None]


def plane_normals(
    angles: NDArray[np.float64], tilts: NDArray[np.float64] = PLANE_TILT_RAD
) -> NDArray[np.float64]:
    """Return the normals of ideal light planes in the station's axes.

    Parameters
    ----------
    angles : (..., 2) ndarray
        Rotor angles in radians.
    tilts : (..., 2) ndarray
        Tilt of each plane in radians, nominal plus factory tilt.

    Returns
    -------
    (..., 2, 3) ndarray
        Normals, not of unit length: the product with a point (x, y, z) is its horizontal
        distance from the plane.

    Notes
    -----
    A point on the plane satisfies sin(azimuth - angle) = tan(tilt) z / hypot(x, y), which is
    linear in (x, y, z) after multiplication by hypot(x, y).
    """
    angles, tilts = np.broadcast_arrays(angles, tilts)
    return np.stack([-np.sin(angles), np.cos(angles), -np.tan(tilts)], axis=-1)


def rays(
    angles: NDArray[np.float64], tilts: NDArray[np.float64] = PLANE_TILT_RAD
) -> NDArray[np.float64]:
    """Intersect the two ideal planes of each pair.

    Parameters
    ----------
    angles, tilts : (..., 2) ndarray
        See :func:`plane_normals`.

    Returns
    -------
    (..., 3) ndarray
        Directions (1, y, z): the point of the ray in the image plane one unit ahead of the
        station.
    """
    # The cross product of both normals is written out: large recordings spend much of their
    # time here, and np.cross would need both stacks of normals.
    first, second = angles[..., 0], angles[..., 1]
    slopes = np.broadcast_to(np.tan(tilts), np.shape(angles))
    cos_first, cos_second = np.cos(first), np.cos(second)
    sin_first, sin_second = np.sin(first), np.sin(second)
    forward = slopes[..., 0] * cos_second - slopes[..., 1] * cos_first
    ray = np.empty((*np.shape(first), 3))
    ray[..., 0] = forward
    ray[..., 1] = slopes[..., 0] * sin_second - slopes[..., 1] * sin_first
    ray[..., 2] = cos_first * sin_second - sin_first * cos_second
    return ray / forward[..., None]
