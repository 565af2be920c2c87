"""Where a station stands that saw points of known place."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.lighthouse.twoview import fit_homography

Array = NDArray[np.float64]


def resect_on_plane(points: Array, rays: Array) -> tuple[Array, Array]:
    """Pose of a station from points of the plane z = 0.

    Parameters
    ----------
    points : (n, 2) ndarray
        Known places, n >= 4, no three of four on a line.
    rays : (n, 3) ndarray
        Directions in which the station saw them.

    Returns
    -------
    position : (3,) ndarray
        Of the station, in the unit of ``points``.
    rotation : (3, 3) ndarray
        Station to plane frame.

    Raises
    ------
    DegenerateError
        Fewer than four points, or all on a line.

    Notes
    -----
    The homography from the plane to the rays has the first two columns of the inverse
    rotation and the translation as its columns (Zhang 2000, section 2.2).
    """
    _require_spread(points, 4, 2, "markers on the floor, not on one line")
    h = fit_homography(np.c_[np.ones(len(points)), points], rays)
    h = h / np.mean(np.linalg.norm(h[:, 1:], axis=0))
    if np.mean(h[0] @ np.c_[np.ones(len(points)), points].T) < 0:
        h = -h
    across = h[:, 1:]
    rotation = _nearest_rotation(np.c_[across, np.cross(across[:, 0], across[:, 1])])
    return -rotation.T @ h[:, 0], rotation.T


def resect_in_space(points: Array, rays: Array) -> tuple[Array, Array]:
    """Pose of a station from points in space, n >= 6 and not on one plane.

    Parameters and result as for :func:`resect_on_plane`, with (n, 3) ``points``. Direct
    linear transform of the projection (Hartley and Zisserman, algorithm 7.1).
    """
    _require_spread(points, 6, 3, "points, not on one plane")
    middle, size = points.mean(axis=0), points.std()
    known = np.c_[np.ones(len(points)), (points - middle) / size]
    zero = np.zeros_like(known)
    rows = np.concatenate(
        [
            np.concatenate([-rays[:, 1:2] * known, rays[:, 0:1] * known, zero], axis=1),
            np.concatenate([-rays[:, 2:3] * known, zero, rays[:, 0:1] * known], axis=1),
        ]
    )
    p = np.linalg.eigh(rows.T @ rows)[1][:, 0].reshape(3, 4)
    p = p / np.cbrt(np.linalg.det(p[:, 1:]))
    rotation = _nearest_rotation(p[:, 1:])
    scale = np.mean(np.linalg.svd(p[:, 1:])[1])
    return middle - size * rotation.T @ p[:, 0] / scale, rotation.T


def _nearest_rotation(matrix: Array) -> Array:
    u, _, vt = np.linalg.svd(matrix)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt


def _require_spread(points: Array, number: int, rank: int, what: str) -> None:
    if len(points) < number:
        raise DegenerateError(
            f"{len(points)} known points do not fix a station",
            hint=f"give at least {number} {what}",
        )
    sizes = np.linalg.svd(points - points.mean(axis=0))[1]
    if sizes[rank - 1] < 1e-3 * sizes[0]:
        raise DegenerateError("the known points do not span the space", hint=f"give {what}")
