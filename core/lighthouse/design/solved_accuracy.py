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

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.calibration import (
    FACTORY_LINEAR_PARAMETERS,
    GENERIC_CALIBRATION,
    MODEL_SIGMA_RAD,
    PHASE,
    PHASE_TILT_SIGMA_RAD,
    TILT,
    predict_with_derivatives,
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
    by_point, by_station, by_calibration = _derivatives(
        position_m, rotation, points_m, is_seen, dims, is_known
    )
    to_point, is_determined = _position_gain(by_point)
    is_determined &= np.isfinite(only_noise.noise_sigma_m)
    if not np.any(is_determined):
        return only_noise
    chosen = np.flatnonzero(is_determined)
    chosen = chosen[np.linspace(0, len(chosen) - 1, min(len(chosen), SCENE_POINTS)).astype(int)]
    projection = np.tile(np.eye(by_point.shape[1]), (len(chosen), 1, 1))
    if len(position_m) > 1:
        # Points of a single station are known: they are markers, without which it is not solved.
        projection -= by_point[chosen] @ to_point[chosen]
    scene_gain = _scene_gain(projection, by_station[chosen], by_calibration[chosen], is_known)
    unexplained = by_calibration.reshape(-1, by_calibration.shape[-1])
    unexplained = unexplained - by_station.reshape(len(unexplained), -1) @ scene_gain
    jacobian = to_point @ unexplained.reshape(by_calibration.shape)
    motions = _frame_motions(points_m, is_determined, is_planar)
    frame = motions[is_determined].reshape(-1, motions.shape[-1])
    own = jacobian[is_determined].reshape(len(frame), -1)
    # Few points in a row do not determine all motions.
    common = np.linalg.lstsq(frame.T @ frame, frame.T @ own, rcond=None)[0]
    rows = jacobian.reshape(-1, len(common[0])) - motions.reshape(-1, len(common)) @ common
    weighted = np.empty_like(rows)
    for i, is_factory in enumerate(is_known):
        columns = slice(i * CALIBRATION_PARAMETERS, (i + 1) * CALIBRATION_PARAMETERS)
        weighted[:, columns] = rows[:, columns] @ calibration_spread(is_factory)
    rows, weighted = rows.reshape(jacobian.shape), weighted.reshape(jacobian.shape)
    covariance = np.einsum("pik,pjk->pij", rows, weighted)
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


def _derivatives(
    position: Array,
    rotation: Array,
    points: Array,
    is_seen: BoolArray,
    dims: int,
    is_known: Sequence[bool],
) -> tuple[Array, Array, Array]:
    """Return the derivatives of all angles (p, 2 s): both planes of one station after another.

    They are by the point (p, 2 s, d), by the unknowns of stations (p, 2 s, 9 s) and by their
    calibrations (p, 2 s, 14 s); zero for planes that do not cross the point.
    """
    s, p = is_seen.shape
    by_point = np.zeros((p, s, 2, dims))
    by_station = np.zeros((p, s, 2, s, UNKNOWNS))
    by_calibration = np.zeros((p, s, 2, s, CALIBRATION_PARAMETERS))
    for i in range(s):
        offset = points - position[i]
        _, by_local, by_parameters = predict_with_derivatives(
            offset @ rotation[i], GENERIC_CALIBRATION
        )
        is_valid = is_seen[i] & np.isfinite(by_local).all(axis=(1, 2))
        gradient = np.where(is_valid[:, None, None], by_local @ rotation[i].T, 0.0)
        by_parameters = np.where(is_valid[:, None, None], by_parameters, 0.0)
        by_point[:, i] = gradient[..., :dims]
        by_station[:, i, :, i, :3] = -gradient
        by_station[:, i, :, i, 3:6] = np.cross(gradient, offset[:, None])
        for plane in (0, 1):
            columns = slice(7 * plane, 7 * plane + 7)
            by_calibration[:, i, plane, i, columns] = by_parameters[:, plane]
            if not is_known[i]:
                by_station[:, i, plane, i, 6 + plane] = by_parameters[:, plane, TILT]
        if not is_known[i]:
            by_station[:, i, 1, i, 8] = by_parameters[:, 1, PHASE]
    return (
        by_point.reshape(p, 2 * s, dims),
        by_station.reshape(p, 2 * s, -1),
        by_calibration.reshape(p, 2 * s, -1),
    )


def _position_gain(by_point: Array) -> tuple[Array, BoolArray]:
    """Return ``(G^T G)^-1 G^T`` (p, d, 2 s), and where it exists."""
    information = by_point.mT @ by_point
    values = np.linalg.eigvalsh(information)
    is_determined = values[:, 0] > MIN_CONDITION * values[:, -1]
    safe = np.where(is_determined[:, None, None], information, np.eye(information.shape[-1]))
    gain = np.linalg.solve(safe, by_point.mT)
    return np.where(is_determined[:, None, None], gain, 0.0), np.asarray(is_determined)


def _scene_gain(
    projection: Array, by_station: Array, by_calibration: Array, is_known: Sequence[bool]
) -> Array:
    """Return the change L (9 s, 14 s) of the stations' unknowns by deviations of calibrations."""
    weight = MAX_INDEPENDENT_POINTS / (len(projection) * MODEL_SIGMA_RAD**2)
    size = by_station.shape[-1]
    projected = (weight * projection @ by_station).reshape(-1, size)
    normal = projected.T @ by_station.reshape(-1, size)
    coupling = projected.T @ by_calibration.reshape(len(projected), -1)
    sigma = np.append(PHASE_TILT_SIGMA_RAD[:, 1], PHASE_TILT_SIGMA_RAD[1, 0])
    for i, is_factory in enumerate(is_known):
        if not is_factory:
            rows = UNKNOWNS * i + np.arange(6, UNKNOWNS)
            normal[rows, rows] += sigma**-2.0
    scale = np.sqrt(np.maximum(np.diagonal(normal), 1e-12))
    inverse = np.linalg.pinv(
        normal / np.outer(scale, scale), rcond=MIN_EIGENVALUE_RATIO, hermitian=True
    )
    return np.asarray(inverse @ (coupling / scale[:, None]) / scale[:, None])


def _frame_motions(points: Array, is_determined: BoolArray, is_planar: bool) -> Array:
    """Return the motions (p, d, g) of points by a change of their frame and scale."""
    motions = common_motions(points - points[is_determined].mean(axis=0))
    return motions[:, :2][:, :, [0, 1, 5, 6]] if is_planar else motions
