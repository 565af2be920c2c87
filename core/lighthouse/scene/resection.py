"""Where a station stands that saw points of known place."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.geometry import fit_homography as plane_homography
from locatk.core.geometry import fit_plane
from locatk.core.lighthouse.scene.two_view import GATE, fit_homography, homography_residuals
from locatk.core.robust import consensus

Array = NDArray[np.float64]
Pose = tuple[Array, Array]
"""Position (3,) and rotation (3, 3), station to frame."""


def resect_on_plane(points: Array, rays: Array) -> Pose:
    """Pose of a station from points of the plane z = 0.

    Parameters
    ----------
    points : (n, 2) ndarray
        Known places, n >= 4, not on one line; wrong ones are outvoted where n > 4.
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
    The homography from the plane to the rays has the translation and the first two columns
    of the inverse rotation as its columns (Zhang 2000, section 2.2).
    """
    require_plane_map(points, rays)
    known = np.c_[np.ones(len(points)), points]
    if len(points) > 4:
        h, agreed = consensus(
            fit_homography, homography_residuals, known, rays, sample=4, gate=GATE
        )
        known = known[agreed] if np.count_nonzero(agreed) >= 4 else known
    else:
        h = fit_homography(known, rays)
    h = h / np.mean(np.linalg.norm(h[:, 1:], axis=0))
    if np.mean(h[0] @ known.T) < 0:
        h = -h
    across = h[:, 1:]
    rotation = _nearest_rotation(np.c_[across, np.cross(across[:, 0], across[:, 1])])
    return -rotation.T @ h[:, 0], rotation.T


def resect_in_space(points: Array, rays: Array) -> list[Pose]:
    """Likely poses of a station from points in space.

    Parameters
    ----------
    points : (n, 3) ndarray
        Known places, n >= 6; wrong ones are outvoted.
    rays : (n, 3) ndarray

    Returns
    -------
    list of (position, rotation)
        As :func:`resect_on_plane`: by the direct linear transform (Hartley and Zisserman,
        algorithm 7.1), which needs points off one plane, and by the plane through the
        points, which wants them on one. Refining tells which it was.

    Raises
    ------
    DegenerateError
        Too few points, or all on a line.
    """
    _require_spread(points, 6, 2, "places that are not on one line")
    middle, size = points.mean(axis=0), points.std()
    known = np.c_[np.ones(len(points)), (points - middle) / size]
    p, agreed = consensus(
        _fit_projection, homography_residuals, known, rays, sample=6, gate=GATE, trials=200
    )
    poses = []
    spin = np.cbrt(np.linalg.det(p[:, 1:]))
    if spin != 0:
        p = p / spin
        rotation = _nearest_rotation(p[:, 1:])
        scale = np.mean(np.linalg.svd(p[:, 1:])[1])
        poses.append((middle - size * rotation.T @ p[:, 0] / scale, rotation.T))
    voters = agreed if np.count_nonzero(agreed) >= 6 else np.ones(len(points), bool)
    centre, normal = fit_plane(points[voters])
    across = np.linalg.svd(normal[None])[2]
    axes = np.stack([across[1], np.cross(normal, across[1]), normal], axis=1)
    position, turned = resect_on_plane(((points - centre) @ axes)[:, :2], rays)
    poses.append((centre + axes @ position, axes @ turned))
    return poses


def require_plane_map(points: Array, rays: Array) -> None:
    """Refuse floor points (n, 2) and rays (n, 3) that do not determine a homography.

    Raises
    ------
    DegenerateError
        Fewer than four, three of four on a line, or all in one place.
    """
    hint = "give four or more markers on the floor, no three of four on one line"
    try:
        h = plane_homography(_unit(points), _unit(rays[:, 1:] / rays[:, :1]))
    except DegenerateError as error:
        raise DegenerateError(str(error), hint=hint) from None
    sizes = np.linalg.svd(h, compute_uv=False)
    if sizes[2] < 1e-4 * sizes[0]:
        raise DegenerateError("too many of the markers lie on one line", hint=hint)


def _unit(points: Array) -> Array:
    """Points (n, 2) about their middle, in units of their spread."""
    spread = points.std() if len(points) else 0.0
    return (points - points.mean(axis=0)) / spread if spread > 0 else points


def _fit_projection(known: Array, rays: Array) -> Array:
    """Projections (..., 3, 4) with rays ~ P known, by direct linear transform."""
    zero = np.zeros_like(known)
    rows = np.concatenate(
        [
            np.concatenate([-rays[..., 1:2] * known, rays[..., 0:1] * known, zero], axis=-1),
            np.concatenate([-rays[..., 2:3] * known, zero, rays[..., 0:1] * known], axis=-1),
        ],
        axis=-2,
    )
    null = np.linalg.eigh(np.swapaxes(rows, -1, -2) @ rows)[1][..., 0]
    return null.reshape(*rows.shape[:-2], 3, 4)


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
    if sizes[rank - 1] <= 1e-3 * sizes[0]:
        raise DegenerateError("the known points do not span the space", hint=f"give {what}")
