"""Accuracy of positions in a scene that is solved from a recording in the room.

A solved scene is wrong because the light planes of its stations differ from the calibration that is
assumed. The solver moves the stations so that the angles agree as well as possible. What this does
not explain displaces positions, smoothly over the room. This module predicts the displacement by
linear propagation through the steps of the solver.

At a point p, the angles of the stations in view differ from their prediction by ::

    y = G dx + U du + C c

with the displacement dx of the photodiode, the changes du of the stations' unknowns (pose, tilts,
phase) and the deviations c of their calibrations. The bundle adjustment eliminates each point,
``N = 1 - G (G^T G)^-1 G^T``, and minimises ``|N (C c - U du)|^2`` over all points together with the
priors of tilts and phases, so that ::

    du = A^-1 sum U^T N C c = L c,        A = sum U^T N U + prior.

Then the point is displaced by ``dx = J c`` with ``J = (G^T G)^-1 G^T (C - U L)``. Translation,
rotation and scale of everything are no errors of the scene but of its frame, and are removed from J
(S-transformation, Baarda 1973). The covariance is ``J Gamma J^T``, with the covariance Gamma of c
over units, plus that of the noise.

The light planes are those of the solver (:mod:`locatk.core.lighthouse.calibration`), the unknowns,
priors and weights those of its bundle adjustment
(:mod:`locatk.core.lighthouse.scene.bundle_adjustment`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.calibration import (
    FACTORY_LINEAR_PARAMETERS,
    GENERIC_CALIBRATION,
    MODEL_SIGMA_RAD,
    PHASE,
    PHASE_TILT_SIGMA_RAD,
    TILT,
    predict_sweeps,
)
from locatk.core.lighthouse.design.accuracy import (
    MIN_CONDITION,
    AngleErrors,
    PositionAccuracy,
    predict_positions,
)
from locatk.core.lighthouse.motion.frames import common_motions
from locatk.core.lighthouse.motion.parameters import FACTORY_SIGMA
from locatk.core.lighthouse.scene.bundle_adjustment import MAX_INDEPENDENT_POINTS

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

UNKNOWNS, CALIBRATION_PARAMETERS = 9, 14
"""Unknowns of a station in the bundle adjustment: position, rotation vector, both tilts and the
phase of the second plane; and parameters of the calibration of both planes."""

SCENE_POINTS = 300
"""Number of points from which the scene is solved in the prediction."""

MIN_EIGENVALUE_RATIO = 1e-10
"""Smallest eigenvalue of the normal equations of a scene, relative to the largest one, of a
direction that the recording determines: others are those of the frame."""


@dataclass(frozen=True)
class _Rows:
    """Derivatives of the angles of a station at p points, both planes.

    Attributes
    ----------
    by_point : (p, 2, d) ndarray
    by_station : (p, 2, 9) ndarray
    by_calibration : (p, 2, 14) ndarray
    """

    by_point: Array
    by_station: Array
    by_calibration: Array


def predict_solved_positions(
    position_m: Array,
    rotation: Array,
    points_m: Array,
    is_seen: BoolArray,
    *,
    is_planar: bool,
    errors: AngleErrors | None = None,
    has_factory_data: Sequence[bool] | None = None,
) -> PositionAccuracy:
    """Predict the accuracy of one photodiode at each point in a solved scene.

    The result is relative to the frame: translation, rotation and scale have no errors.

    Parameters
    ----------
    position_m, rotation : (s, 3) and (s, 3, 3) ndarray
        Poses of the stations.
    points_m : (p, 3) ndarray
        They are where the devices move while the scene is recorded.
    is_seen : (s, p) ndarray
    is_planar : bool
        The height of the photodiode is known.
    errors : AngleErrors, optional
        Its noise is used.
    has_factory_data : sequence of bool, optional
        Stations whose factory calibration is known. The solver keeps it, and units differ from it
        by :data:`~locatk.core.lighthouse.motion.parameters.FACTORY_SIGMA`. The others have the
        spread of units around the generic calibration; the default is none.
    """
    errors = AngleErrors() if errors is None else errors
    only_noise = predict_positions(
        position_m,
        rotation,
        points_m,
        is_seen,
        is_planar=is_planar,
        errors=AngleErrors(errors.noise_rad, 0.0),
    )
    is_known = [False] * len(position_m) if has_factory_data is None else list(has_factory_data)
    dims = 2 if is_planar else 3
    rows = [
        _station_rows(position_m[i], rotation[i], points_m, is_seen[i], dims, is_known[i])
        for i in range(len(position_m))
    ]
    to_point, is_determined = _position_gain(rows)
    is_determined &= np.isfinite(only_noise.noise_sigma_m)
    if not np.any(is_determined):
        return only_noise
    chosen = np.flatnonzero(is_determined)
    chosen = chosen[np.linspace(0, len(chosen) - 1, min(len(chosen), SCENE_POINTS)).astype(int)]
    gain = _scene_gain(rows, to_point, chosen, is_known)
    jacobian = _displacement(rows, to_point, gain)
    motions = _frame_motions(points_m, is_determined, is_planar)
    frame = motions[is_determined].reshape(-1, motions.shape[-1])
    own = jacobian[is_determined].reshape(len(frame), -1)
    jacobian -= motions @ np.linalg.lstsq(frame, own, rcond=None)[0]
    covariance = np.zeros((len(points_m), dims, dims))
    for i, is_factory in enumerate(is_known):
        part = jacobian[..., i * CALIBRATION_PARAMETERS : (i + 1) * CALIBRATION_PARAMETERS]
        covariance += part @ calibration_spread(is_factory) @ part.mT
    infinite = ~is_determined[:, None, None]
    total = np.where(infinite, np.inf, only_noise.noise_covariance + covariance)
    return PositionAccuracy(only_noise.noise_covariance, total, only_noise.dilution)


def calibration_spread(has_factory_data: bool) -> Array:
    """Return the covariance (14, 14) of a unit's planes from the calibration that is assumed.

    Its parameters are :data:`~locatk.core.lighthouse.calibration.LINEAR_PARAMETERS` of the first
    and of the second plane.
    """
    if has_factory_data:
        variance = np.tile(FACTORY_SIGMA**2, (2, 1))
        variance[0, PHASE] = 0.0  # By definition: it is the axis of the station.
        return np.diag(variance.ravel())
    units = FACTORY_LINEAR_PARAMETERS.reshape(-1, CALIBRATION_PARAMETERS)
    return np.asarray(np.cov(units.T))


def _station_rows(
    position: Array,
    rotation: Array,
    points: Array,
    is_seen: BoolArray,
    dims: int,
    has_factory_data: bool,
) -> _Rows:
    """Return the derivatives at the points that a station sees; zero at the others."""
    p = len(points)
    offset = points - position
    rows = _Rows(
        np.zeros((p, 2, dims)), np.zeros((p, 2, UNKNOWNS)), np.zeros((p, 2, CALIBRATION_PARAMETERS))
    )
    for plane in (0, 1):
        _, by_local, by_parameters = predict_sweeps(
            offset @ rotation, np.full(p, plane), GENERIC_CALIBRATION
        )
        is_valid = (is_seen & np.isfinite(by_local).all(axis=1))[:, None]
        gradient = np.where(is_valid, by_local @ rotation.T, 0.0)
        by_parameters = np.where(is_valid, by_parameters, 0.0)
        rows.by_point[:, plane] = gradient[:, :dims]
        rows.by_station[:, plane, :3] = -gradient
        rows.by_station[:, plane, 3:6] = np.cross(gradient, offset)
        if not has_factory_data:
            rows.by_station[:, plane, 6 + plane] = by_parameters[:, TILT]
            if plane == 1:
                rows.by_station[:, plane, 8] = by_parameters[:, PHASE]
        columns = slice(7 * plane, 7 * plane + 7)
        rows.by_calibration[:, plane, columns] = by_parameters
    return rows


def _position_gain(rows: Sequence[_Rows]) -> tuple[Array, BoolArray]:
    """Return ``(G^T G)^-1 G^T`` (p, d, 2 s), and where it exists."""
    gradient = np.concatenate([r.by_point for r in rows], axis=1)
    information = gradient.mT @ gradient
    values = np.linalg.eigvalsh(information)
    is_determined = values[:, 0] > MIN_CONDITION * values[:, -1]
    safe = np.where(is_determined[:, None, None], information, np.eye(information.shape[-1]))
    gain = np.linalg.solve(safe, gradient.mT)
    return np.where(is_determined[:, None, None], gain, 0.0), np.asarray(is_determined)


def _scene_gain(
    rows: Sequence[_Rows], to_point: Array, chosen: NDArray[np.int64], is_known: Sequence[bool]
) -> Array:
    """Return the change L (9 s, 14 s) of the stations' unknowns by deviations of calibrations."""
    s = len(rows)
    projection = np.tile(np.eye(2 * s), (len(chosen), 1, 1))
    if s > 1:
        # Points of a single station are known: they are markers, without which it is not solved.
        gradient = np.concatenate([r.by_point[chosen] for r in rows], axis=1)
        projection -= gradient @ to_point[chosen]
    weight = MAX_INDEPENDENT_POINTS / (len(chosen) * MODEL_SIGMA_RAD**2)
    normal = np.zeros((s, UNKNOWNS, s, UNKNOWNS))
    coupling = np.zeros((s, UNKNOWNS, s, CALIBRATION_PARAMETERS))
    for i, own in enumerate(rows):
        for j, other in enumerate(rows):
            part = projection[:, 2 * i : 2 * i + 2, 2 * j : 2 * j + 2]
            weighted = weight * own.by_station[chosen].mT @ part
            normal[i, :, j] = np.sum(weighted @ other.by_station[chosen], axis=0)
            coupling[i, :, j] = np.sum(weighted @ other.by_calibration[chosen], axis=0)
        if not is_known[i]:
            sigma = np.append(PHASE_TILT_SIGMA_RAD[:, 1], PHASE_TILT_SIGMA_RAD[1, 0])
            normal[i, range(6, 9), i, range(6, 9)] += sigma**-2.0
    matrix = normal.reshape(s * UNKNOWNS, -1)
    scale = np.sqrt(np.maximum(np.diagonal(matrix), 1e-12))
    inverse = np.linalg.pinv(
        matrix / np.outer(scale, scale), rcond=MIN_EIGENVALUE_RATIO, hermitian=True
    )
    return np.asarray(
        (inverse @ (coupling.reshape(len(matrix), -1) / scale[:, None])) / scale[:, None]
    )


def _displacement(rows: Sequence[_Rows], to_point: Array, scene_gain: Array) -> Array:
    """Return the displacements J (p, d, 14 s) of points by deviations of calibrations."""
    p, dims = to_point.shape[:2]
    result = np.zeros((p, dims, len(rows) * CALIBRATION_PARAMETERS))
    for i, own in enumerate(rows):
        gain = to_point[:, :, 2 * i : 2 * i + 2]
        result[..., i * CALIBRATION_PARAMETERS : (i + 1) * CALIBRATION_PARAMETERS] += (
            gain @ own.by_calibration
        )
        result -= (gain @ own.by_station) @ scene_gain[i * UNKNOWNS : (i + 1) * UNKNOWNS]
    return result


def _frame_motions(points: Array, is_determined: BoolArray, is_planar: bool) -> Array:
    """Return the motions (p, d, g) of points by a change of their frame and scale."""
    motions = common_motions(points - points[is_determined].mean(axis=0))
    return motions[:, :2][:, :, [0, 1, 5, 6]] if is_planar else motions
