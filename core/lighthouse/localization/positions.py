"""Positions of photodiodes in a known scene, in closed form and for all epochs at once.

Each sweep states that its photodiode is on a light plane of a station. The position is the
weighted least-squares intersection of these planes. Each plane is weighted by the inverse of
its lever arm, so that the sum of squared angles is minimised and not of distances. A few
linear solves are enough, and no initial guess is needed.

A single station over a floor whose scene has a floor homography uses that instead
(:func:`estimate_floor_positions`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.kernels import kernels
from locatk.core.lighthouse.calibration import Calibration, ideal_angles
from locatk.core.lighthouse.light_planes import plane_normals

Array = NDArray[np.float64]

EPOCHS_PER_BLOCK = 4096
"""Number of epochs solved at a time. The arrays of a block fit the cache of a processor, which
makes the solver three times as fast (measured on a million sweeps of two stations)."""


@dataclass(frozen=True)
class PositionEstimates:
    """Positions of m epochs with their information and residuals.

    Attributes
    ----------
    position : (m, 3) ndarray
        ``nan`` if the planes do not determine a point in front of the stations.
    information : (m, 3, 3) ndarray
        Inverse covariance for angles of unit variance; ``nan`` if the planes intersect in no
        single point.
    residual : (m, s, 2) ndarray
        Angle in radians between each plane and the position; ``nan`` without a sweep.
    redundancy : (m,) int ndarray
        Number of planes beyond the unknowns. With 0 nothing checks the position.
    """

    position: Array
    information: Array
    residual: Array
    redundancy: NDArray[np.int64]

    @property
    def max_residual(self) -> Array:
        """(m,) largest absolute residual in radians; 0 without redundancy."""
        return np.max(np.nan_to_num(np.abs(self.residual)), axis=(1, 2), initial=0.0)

    def covariance(self, sigma: float, planar: bool) -> Array:
        """Return the (m, 3, 3) covariances for angles of standard deviation ``sigma`` in radians.

        On a known plane (``planar``) the variance of the height is 0.
        """
        dims = 2 if planar else 3
        full = np.zeros((len(self.position), 3, 3))
        is_solved = np.isfinite(self.position[:, 0])
        full[~is_solved] = np.nan
        block = np.linalg.inv(self.information[is_solved][:, :dims, :dims]) * sigma**2
        padded = np.zeros((len(block), 3, 3))
        padded[:, :dims, :dims] = block
        full[is_solved] = padded
        return full

    def replaced(
        self, rows: NDArray[np.int64], other: PositionEstimates, chosen: NDArray[np.bool_]
    ) -> PositionEstimates:
        """Return a copy with the ``chosen`` estimates of ``other`` in ``rows``."""
        changed = {}
        for name in ("position", "information", "residual", "redundancy"):
            changed[name] = getattr(self, name).copy()
            changed[name][rows] = getattr(other, name)[chosen]
        return PositionEstimates(**changed)


def estimate_positions(
    angles: Array,
    positions: Array,
    rotations: Array,
    calibrations: tuple[Calibration, ...],
    *,
    floor_z: float | None = None,
    passes: int = 3,
) -> PositionEstimates:
    """Estimate the positions of photodiodes from the rotor angles that they received.

    Parameters
    ----------
    angles : (m, s, 2) ndarray
        Observed rotor angles in radians, ``nan`` without a sweep.
    positions : (s, 3) ndarray
        Positions of the stations.
    rotations : (s, 3, 3) ndarray
        Rotations from station to scene.
    calibrations : tuple of Calibration
        One per station.
    floor_z : float, optional
        Height of all photodiodes, if they move on a plane.
    passes : int
        Number of linear solves. The first weights all planes alike, each further one uses the
        lever arms at the positions of the previous one.

    Returns
    -------
    PositionEstimates
        In the unit of ``positions``.
    """
    return intersect_planes(
        correct_angles(angles, calibrations),
        positions,
        rotations,
        calibrations,
        floor_z=floor_z,
        passes=passes,
    )


def correct_angles(angles: Array, calibrations: tuple[Calibration, ...]) -> Array:
    """Correct angles (m, s, 2) to those of ideal planes, station by station.

    See :func:`~locatk.core.lighthouse.calibration.ideal_angles`.
    """
    ideal = np.empty_like(angles)
    for start in range(0, len(angles), EPOCHS_PER_BLOCK):
        block = slice(start, start + EPOCHS_PER_BLOCK)
        for i, calibration in enumerate(calibrations):
            ideal[block, i] = ideal_angles(angles[block, i], calibration)
    return ideal


def intersect_planes(
    ideal: Array,
    positions: Array,
    rotations: Array,
    calibrations: tuple[Calibration, ...],
    *,
    floor_z: float | None = None,
    passes: int = 3,
) -> PositionEstimates:
    """Estimate positions as :func:`estimate_positions`, from corrected angles.

    Parameters
    ----------
    ideal : (m, s, 2) ndarray
        From :func:`correct_angles`, with the same calibrations.
    positions, rotations, calibrations, floor_z, passes
        See :func:`estimate_positions`.
    """
    m, s = ideal.shape[:2]
    tilt_tangents = np.array([np.tan(c.tilts) for c in calibrations]).reshape(s, 2)
    estimates = PositionEstimates(
        np.empty((m, 3)), np.empty((m, 3, 3)), np.empty((m, s, 2)), np.empty(m, np.int64)
    )
    if kernels is not None:
        kernels.light_positions(
            np.ascontiguousarray(ideal, np.float64),
            m,
            s,
            np.concatenate([positions, rotations.reshape(s, 9), tilt_tangents], axis=1),
            np.nan if floor_z is None else floor_z,
            passes,
            estimates.position,
            estimates.information,
            estimates.residual,
            estimates.redundancy,
        )
        return estimates
    for start in range(0, m, EPOCHS_PER_BLOCK):
        block = slice(start, start + EPOCHS_PER_BLOCK)
        (
            estimates.position[block],
            estimates.information[block],
            estimates.residual[block],
            estimates.redundancy[block],
        ) = intersect_planes_numpy(
            ideal[block], positions, rotations, tilt_tangents, floor_z, passes
        )
    return estimates


def intersect_planes_numpy(
    ideal: Array,
    positions: Array,
    rotations: Array,
    tilt_tangents: Array,
    floor_z: float | None,
    passes: int,
) -> tuple[Array, Array, Array, NDArray[np.int64]]:
    """Intersect planes without the compiled kernel, given the tangents (s, 2) of their tilts.

    Returns the four arrays of :class:`PositionEstimates`.
    """
    m, s = ideal.shape[:2]
    dims = 3 if floor_z is None else 2
    normals = np.empty((m, s, 2, 3))
    for i in range(s):
        normals[:, i] = plane_normals(ideal[:, i], np.arctan(tilt_tangents[i])) @ rotations[i].T
    is_observed = np.isfinite(normals[..., 0])
    normals[~is_observed] = 0.0
    offsets = np.einsum("msij,sj->msi", normals, positions)
    up = rotations[:, :, 2]

    redundancy = np.count_nonzero(is_observed, axis=(1, 2)) - dims
    position = np.zeros((m, 3))
    if floor_z is not None:
        position[:, 2] = floor_z
        target = offsets - normals[..., 2] * floor_z
    else:
        target = offsets
    rows = normals[..., :dims].reshape(m, 2 * s, dims)
    lever_arm = np.ones((m, s, 2))
    for _ in range(passes):
        weighted = rows / lever_arm.reshape(m, 2 * s, 1)
        information = weighted.transpose(0, 2, 1) @ weighted
        right = weighted.transpose(0, 2, 1) @ (target / lever_arm).reshape(m, 2 * s, 1)
        position[:, :dims] = _solve_symmetric(information, right[..., 0])
        # The angle between plane and position is their distance, divided by the lever arm on
        # which the plane rotates.
        offset = position[:, None, :] - positions
        height = np.einsum("msj,sj->ms", offset, up)
        radius_squared = np.sum(offset**2, axis=-1) - height**2
        lever_squared = radius_squared[..., None] - (tilt_tangents * height[..., None]) ** 2
        lever_arm = np.sqrt(
            np.maximum(lever_squared, 1e-12 * np.maximum(radius_squared[..., None], 1e-30))
        )
    depth = np.einsum("msj,sj->ms", offset, rotations[:, :, 0])
    residual = (np.einsum("msij,mj->msi", normals, position) - offsets) / lever_arm
    residual[~is_observed] = np.nan
    # The planes of a station also intersect behind it, where it sends no light.
    is_behind = np.any((depth <= 0) & is_observed.any(axis=2), axis=1)
    is_unsolved = (redundancy < 0) | is_behind | ~np.isfinite(position).all(axis=1)
    full = np.zeros((m, 3, 3))
    full[:, :dims, :dims] = information
    full[np.isnan(position[:, 0])] = np.nan
    position[is_unsolved] = np.nan
    return position, full, residual, redundancy


def _solve_symmetric(matrix: Array, right: Array) -> Array:
    """Solve m symmetric systems of 2 or 3 unknowns by cofactors.

    Returns (m, d) solutions, ``nan`` if a matrix is singular to rounding.
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
        solution = np.einsum("mij,mj->mi", cofactors, right) / determinant[:, None]
    solution[np.abs(determinant) <= 1e-12 * size**d] = np.nan
    return solution


def estimate_floor_positions(
    angles: Array, calibration: Calibration, floor_map: Array, floor_z: float
) -> PositionEstimates:
    """Estimate positions on a floor from one station, by a homography.

    Parameters
    ----------
    angles : (m, 1, 2) ndarray
        Rotor angles in radians, ``nan`` without a sweep.
    calibration : Calibration
        The one with which ``floor_map`` was fitted.
    floor_map : (3, 3) ndarray
        From :func:`~locatk.core.lighthouse.scene.registration.fit_floor_homography`.
    floor_z : float
        Height of the floor points, in metres.

    Returns
    -------
    PositionEstimates
        The redundancy is 0 or less: nothing checks these positions.
    """
    corrected = ideal_angles(angles[:, 0], calibration)
    is_observed = np.isfinite(angles)
    return replace(
        project_on_floor(corrected, calibration, floor_map, floor_z),
        residual=np.where(is_observed, 0.0, np.nan),
        redundancy=np.count_nonzero(is_observed, axis=(1, 2)) - 2,
    )


def project_on_floor(
    corrected: Array, calibration: Calibration, floor_map: Array, floor_z: float
) -> PositionEstimates:
    """Estimate positions as :func:`estimate_floor_positions`, from corrected angles (m, 2)."""
    normals = plane_normals(corrected, calibration.tilts)
    rays = np.cross(normals[:, 0], normals[:, 1])
    # The rotor rotates the normal of a plane about the vertical axis of the station.
    normal_by_angle = np.stack(
        [-np.cos(corrected), -np.sin(corrected), np.zeros_like(corrected)], axis=-1
    )
    ray_by_angle = np.stack(
        [
            np.cross(normal_by_angle[:, 0], normals[:, 1]),
            np.cross(normals[:, 0], normal_by_angle[:, 1]),
        ],
        axis=-1,
    )
    image = rays @ floor_map.T
    image_by_angle = floor_map @ ray_by_angle
    point = image[:, 1:] / image[:, :1]
    jacobian = (image_by_angle[:, 1:] - point[..., None] * image_by_angle[:, :1]) / image[
        :, :1, None
    ]

    m = len(corrected)
    is_solved = np.all(np.isfinite(point), axis=1)
    information = np.zeros((m, 3, 3))
    covariance = np.tile(np.eye(2), (m, 1, 1))
    covariance[is_solved] = jacobian[is_solved] @ jacobian[is_solved].transpose(0, 2, 1)
    information[:, :2, :2] = np.linalg.inv(covariance)
    is_observed = np.isfinite(corrected)
    redundancy = np.count_nonzero(is_observed, axis=1) - 2
    position = np.where(is_solved[:, None], np.c_[point, np.full(m, floor_z)], np.nan)
    return PositionEstimates(
        position, information, np.where(is_observed, 0.0, np.nan)[:, None], redundancy
    )
