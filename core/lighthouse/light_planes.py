"""From LFSR counts to rotor angles, light planes, rays and image points.

Axes of a station: x forward, y left, z up. A rotor angle is 0 where the plane looks
straight ahead. Sweep 0 is the first of a rotation; its plane is tilted by +30 degrees
less the factory tilt, the second by -30 degrees.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.channels import period_counts

PLANE_TILT = np.array([np.pi / 6, -np.pi / 6])
"""Nominal tilt of the two light planes about the forward axis, in radians."""

ROTOR_ZERO = np.array([-np.pi + np.pi / 3, -np.pi - np.pi / 3])
"""Rotor angle of each sweep at count 0, in radians."""


def counts_to_angles(
    counts: NDArray[np.float64], channel: NDArray[np.int32] | int
) -> NDArray[np.float64]:
    """Rotor angles of pairs of sweeps.

    Parameters
    ----------
    counts : (..., 2) ndarray
        LFSR indices of the first and second sweep; ``nan`` stays ``nan``.
    channel : int or (...) ndarray
        1 to 16.

    Returns
    -------
    (..., 2) ndarray
        Radians, 0 straight ahead.

    Notes
    -----
    Crazyflie documentation, kalman_measurement_model.md; the paper's alpha of Eq. 1 is
    this angle without the offset of the plane.
    """
    turn = np.asarray(counts) / np.asarray(period_counts(channel))[..., None]
    return 2 * np.pi * turn + ROTOR_ZERO


def angles_to_counts(
    angles: NDArray[np.float64], channel: NDArray[np.int32] | int
) -> NDArray[np.float64]:
    """LFSR indices at which planes have rotor ``angles`` (..., 2); inverse of
    :func:`counts_to_angles`."""
    turn = (np.asarray(angles) - ROTOR_ZERO) / (2 * np.pi)
    return turn * np.asarray(period_counts(channel))[..., None]


def plane_normals(
    angles: NDArray[np.float64], tilts: NDArray[np.float64] = PLANE_TILT
) -> NDArray[np.float64]:
    """Normals of light planes through the station.

    Parameters
    ----------
    angles : (..., 2) ndarray
        Rotor angles of ideal planes, in radians.
    tilts : (..., 2) ndarray
        Tilt of each plane, in radians: nominal plus factory tilt.

    Returns
    -------
    (..., 2, 3) ndarray
        Not of unit length: the product with a point (x, y, z) is its horizontal
        distance from the plane.

    Notes
    -----
    A point on the plane has sin(azimuth - angle) = tan(tilt) z / hypot(x, y), which is
    linear in (x, y, z) after multiplication by hypot(x, y).
    """
    angles, tilts = np.broadcast_arrays(angles, tilts)
    return np.stack([-np.sin(angles), np.cos(angles), -np.tan(tilts)], axis=-1)


def rays(
    angles: NDArray[np.float64], tilts: NDArray[np.float64] = PLANE_TILT
) -> NDArray[np.float64]:
    """Directions in which both planes of a pair meet: (..., 3), x forward and positive.

    Parameters as for :func:`plane_normals`. The ray is (1, y, z), the point of the
    station's image plane one unit ahead.
    """
    # The product of both normals, written out: this is where large recordings spend time.
    first, second = angles[..., 0], angles[..., 1]
    lean = np.broadcast_to(np.tan(tilts), np.shape(angles))
    cos_first, cos_second = np.cos(first), np.cos(second)
    sin_first, sin_second = np.sin(first), np.sin(second)
    forward = lean[..., 0] * cos_second - lean[..., 1] * cos_first
    ray = np.empty((*np.shape(first), 3))
    ray[..., 0] = forward
    ray[..., 1] = lean[..., 0] * sin_second - lean[..., 1] * sin_first
    ray[..., 2] = cos_first * sin_second - sin_first * cos_second
    return ray / forward[..., None]


def paper_image_points(
    counts: NDArray[np.float64], channel: NDArray[np.int32] | int
) -> NDArray[np.float64]:
    """Image points (..., 2) of the paper, for ideal stations.

    Eq. 1 and 3 with one factor 1/cos(theta) instead of the paper's two: as written,
    Eq. 3 multiplies by it once more although tan(phi) of Eq. 1 has it already. That is
    what the authors' released analysis computes; their firmware has none (facts 1.6).
    x is right, y up, at distance 1 ahead.
    """
    turn = np.asarray(counts) / np.asarray(period_counts(channel))[..., None]
    first, second = np.moveaxis(2 * np.pi * turn, -1, 0)
    theta = (first + second) / 2
    phi_term = np.sin((second - first) / 2 - np.pi / 3) / np.tan(np.pi / 6)
    return np.stack([-np.tan(theta), -phi_term / np.cos(theta)], axis=-1)
