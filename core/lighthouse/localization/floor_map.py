"""One station over a floor with markers: a homography from its rays to the floor.

The paper's III.A. A homography has eight unknowns, a posed station six: the other two
take up what calibration leaves of tilt and phase, which pays where a handful of markers is
all there is. On the published experiment 6, which no figure scores, it takes the mean error
of the posed station from 5.8 to 3.9 mm.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.lighthouse.calibration import Calibration, ideal_angles
from locatk.core.lighthouse.light_planes import plane_normals
from locatk.core.lighthouse.localization.positions import PositionEstimates
from locatk.core.lighthouse.scene.resection import require_plane_map
from locatk.core.lighthouse.scene.two_view import GATE, fit_homography, homography_residuals
from locatk.core.robust import consensus

Array = NDArray[np.float64]


def fit_floor_homography(points: Array, rays: Array) -> Array:
    """Homography (3, 3) from rays (1, y, z) to floor points (1, x, y).

    Parameters
    ----------
    points : (n, 2) ndarray
        Markers on the floor in metres, n >= 4.
    rays : (n, 3) ndarray
        Directions in which the station saw them.

    Raises
    ------
    DegenerateError
        The markers do not determine a homography, or fewer than four of them agree.

    Notes
    -----
    DLT through four; through more, a consensus (RANSAC), refined by least squares of the
    angles with a soft loss.
    """
    require_plane_map(points, rays)
    floor = np.c_[np.ones(len(points)), points]
    if len(points) == 4:
        return _inverse(fit_homography(floor, rays))
    start, agreed = consensus(
        fit_homography, homography_residuals, floor, rays, sample=4, gate=GATE
    )
    if np.count_nonzero(agreed) < 4:
        raise DegenerateError(
            "fewer than four markers agree with each other",
            hint="check the measured positions and the times of the sightings",
        )
    from scipy.optimize import least_squares

    seen = rays[agreed]

    def miss(entries: Array) -> Array:
        moved = floor[agreed] @ np.append(entries, 1.0).reshape(3, 3).T
        return ((moved / moved[:, :1] - seen / seen[:, :1])[:, 1:]).ravel()

    start = start / start[2, 2] if abs(start[2, 2]) > 1e-9 else start
    done = least_squares(miss, start.ravel()[:8], loss="soft_l1", f_scale=1e-3)
    return _inverse(np.append(done.x, 1.0).reshape(3, 3))


def _inverse(h: Array) -> Array:
    inverse: Array = np.linalg.inv(h / np.linalg.norm(h))
    return inverse


def estimate_floor_positions(
    angles: Array, calibration: Calibration, floor_map: Array, floor_z: float
) -> PositionEstimates:
    """Positions on the floor of photodiodes that one station saw.

    Parameters
    ----------
    angles : (m, 1, 2) ndarray
        Rotor angles in radians, ``nan`` where not seen.
    calibration : Calibration
    floor_map : (3, 3) ndarray
        From :func:`fit_floor_homography`.
    floor_z : float
        Height of the floor points, in metres.

    Returns
    -------
    PositionEstimates
        Nothing checks these positions: their freedom is 0 or less.
    """
    plain = ideal_angles(angles[:, 0], calibration)
    normals = plane_normals(plain, calibration.tilts)
    rays = np.cross(normals[:, 0], normals[:, 1])
    # The rotor turns a plane's normal about the vertical.
    turned = np.stack([-np.cos(plain), -np.sin(plain), np.zeros_like(plain)], axis=-1)
    by_angle = np.stack(
        [np.cross(turned[:, 0], normals[:, 1]), np.cross(normals[:, 0], turned[:, 1])], axis=-1
    )
    image = rays @ floor_map.T
    by_angle = floor_map @ by_angle
    place = image[:, 1:] / image[:, :1]
    jacobian = (by_angle[:, 1:] - place[..., None] * by_angle[:, :1]) / image[:, :1, None]

    m = len(angles)
    seen = np.all(np.isfinite(place), axis=1)
    information = np.zeros((m, 3, 3))
    covariance = np.tile(np.eye(2), (m, 1, 1))
    covariance[seen] = jacobian[seen] @ jacobian[seen].transpose(0, 2, 1)
    information[:, :2, :2] = np.linalg.inv(covariance)
    freedom = np.count_nonzero(np.isfinite(angles), axis=(1, 2)) - 2
    position = np.where(seen[:, None], np.c_[place, np.full(m, floor_z)], np.nan)
    return PositionEstimates(
        position, information, np.where(np.isfinite(angles), 0.0, np.nan), freedom
    )
