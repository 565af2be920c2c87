"""Positions of photodiodes in a known scene, all moments at once.

Each sweep says that its photodiode lies on a plane through the station. The position is
the weighted least-squares meeting point of those planes, weighted so that what is minimised
are angles, not distances: a few linear solves, no starting value.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.calibration import Calibration, ideal_angles
from locatk.core.lighthouse.light_planes import plane_normals

Array = NDArray[np.float64]

BLOCK = 4096
"""Moments solved at a time: what fits the processor's cache is three times as fast."""


@dataclass(frozen=True)
class PositionEstimates:
    """Positions with what they are worth.

    Attributes
    ----------
    position : (m, 3) ndarray
        ``nan`` where the planes do not meet in one point.
    information : (m, 3, 3) ndarray
        Inverse covariance for angles of unit variance.
    residual : (m, s, 2) ndarray
        Angle by which each plane misses the position, in radians; ``nan`` where unseen.
    freedom : (m,) int ndarray
        Planes beyond those needed: with 0 nothing checks the position.
    """

    position: Array
    information: Array
    residual: Array
    freedom: NDArray[np.int64]

    @property
    def worst(self) -> Array:
        """(m,) largest residual in radians; 0 where nothing checks the position."""
        return np.max(np.nan_to_num(np.abs(self.residual)), axis=(1, 2), initial=0.0)

    def covariance(self, sigma: float, planar: bool) -> Array:
        """(m, 3, 3) covariance for angles of standard deviation ``sigma`` (rad).

        The height of a photodiode on a known plane has none.
        """
        dims = 2 if planar else 3
        full = np.zeros((len(self.position), 3, 3))
        known = np.isfinite(self.position[:, 0])
        full[~known] = np.nan
        block = np.linalg.inv(self.information[known][:, :dims, :dims]) * sigma**2
        widened = np.zeros((len(block), 3, 3))
        widened[:, :dims, :dims] = block
        full[known] = widened
        return full


def estimate_positions(
    angles: Array,
    positions: Array,
    rotations: Array,
    calibrations: tuple[Calibration, ...],
    *,
    floor_z: float | None = None,
    passes: int = 3,
) -> PositionEstimates:
    """Where photodiodes are that saw the given rotor angles.

    Parameters
    ----------
    angles : (m, s, 2) ndarray
        Observed rotor angles in radians, ``nan`` where not seen.
    positions : (s, 3) ndarray
        Of the stations.
    rotations : (s, 3, 3) ndarray
        Station to scene.
    calibrations : tuple of Calibration
    floor_z : float, optional
        Height of all photodiodes, where they move on a plane.
    passes : int
        Linear solves: the first has rough weights, the others those of the positions before.

    Returns
    -------
    PositionEstimates
    """
    blocks = [
        _locate_block(angles[k : k + BLOCK], positions, rotations, calibrations, floor_z, passes)
        for k in range(0, max(len(angles), 1), BLOCK)
    ]
    return PositionEstimates(*(np.concatenate(parts) for parts in zip(*blocks, strict=True)))


def _locate_block(
    angles: Array,
    positions: Array,
    rotations: Array,
    calibrations: tuple[Calibration, ...],
    floor_z: float | None,
    passes: int,
) -> tuple[Array, Array, Array, NDArray[np.int64]]:
    m, s = angles.shape[:2]
    dims = 3 if floor_z is None else 2
    normals = np.empty((m, s, 2, 3))
    tangents = np.empty((s, 2))
    for i, calibration in enumerate(calibrations):
        plain = ideal_angles(angles[:, i], calibration)
        normals[:, i] = plane_normals(plain, calibration.tilts) @ rotations[i].T
        tangents[i] = np.tan(calibration.tilts)
    seen = np.isfinite(normals[..., 0])
    normals[~seen] = 0.0
    offsets = np.einsum("msij,sj->msi", normals, positions)
    up = rotations[:, :, 2]

    freedom = np.count_nonzero(seen, axis=(1, 2)) - dims
    position = np.zeros((m, 3))
    if floor_z is not None:
        position[:, 2] = floor_z
        target = offsets - normals[..., 2] * floor_z
    else:
        target = offsets
    rows = normals[..., :dims].reshape(m, 2 * s, dims)
    reach = np.ones((m, s, 2))
    for _ in range(passes):
        weighted = rows / reach.reshape(m, 2 * s, 1)
        information = weighted.transpose(0, 2, 1) @ weighted
        pulled = weighted.transpose(0, 2, 1) @ (target / reach).reshape(m, 2 * s, 1)
        solved = _solve(information, pulled[..., 0])
        position[:, :dims] = solved
        # Angle missed = distance from the plane over the lever it turns on.
        away = position[:, None, :] - positions
        lift = np.einsum("msj,sj->ms", away, up)
        level = np.sum(away**2, axis=-1) - lift**2
        lever = level[..., None] - (tangents * lift[..., None]) ** 2
        reach = np.sqrt(np.maximum(lever, 1e-12 * np.maximum(level[..., None], 1e-30)))
    ahead = np.einsum("msj,sj->ms", away, rotations[:, :, 0])
    residual = (np.einsum("msij,mj->msi", normals, position) - offsets) / reach
    residual[~seen] = np.nan
    # Behind a station its planes meet as well, but no light goes there.
    behind = np.any((ahead <= 0) & seen.any(axis=2), axis=1)
    lost = (freedom < 0) | behind | ~np.isfinite(position).all(axis=1)
    position[lost] = np.nan
    full = np.zeros((m, 3, 3))
    full[:, :dims, :dims] = information
    return position, full, residual, freedom


def _solve(matrix: Array, right: Array) -> Array:
    """Solutions (m, d) of symmetric systems of 2 or 3 unknowns, by cofactors.

    ``nan`` where a matrix is singular to rounding.
    """
    d = right.shape[1]
    if d == 2:
        a, b, c = matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 1]
        cofactors = np.stack([np.stack([c, -b], -1), np.stack([-b, a], -1)], -2)
    else:
        x, y, z = (matrix[:, i] for i in range(3))
        cofactors = np.stack([np.cross(y, z), np.cross(z, x), np.cross(x, y)], axis=-1)
    determinant = np.einsum("mi,mi->m", matrix[:, 0], cofactors[:, :, 0])
    size = np.einsum("mii->m", matrix)
    with np.errstate(divide="ignore", invalid="ignore"):
        answer = np.einsum("mij,mj->mi", cofactors, right) / determinant[:, None]
    answer[np.abs(determinant) <= 1e-12 * size**d] = np.nan
    return answer
