"""Robust bundle adjustment over stations, points and, where observable, tilt and phase.

Levenberg-Marquardt on the observed rotor angles. The points are eliminated one by one
(Schur complement), so that a step costs a few matrix products over all points and one
solve of at most ten unknowns a station. What the data cannot fix (the frame, and the scale
where nothing measures it) is held by penalising just those directions; there the
covariance is zero by convention, as it is inside that frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import rotation_exp
from locatk.core.lighthouse.calibration import (
    GENERIC_CALIBRATION,
    PHASE,
    PHASE_TILT_SIGMA_RAD,
    TILT,
    Calibration,
    predict_with_gradient,
)
from locatk.core.robust import descend

Array = NDArray[np.float64]

STATION_UNKNOWNS = 10
"""Position, rotation vector, two tilts, two phases."""

SLOW = 10
"""Steps after which an adjustment counts as slow, and its points take a step of their own
after each: that is twice the work, but gets it through the valleys of narrow fields."""


@dataclass(frozen=True)
class BundleState:
    """Stations and points in one frame: the unknowns of the adjustment.

    Attributes
    ----------
    positions : (s, 3) ndarray
        Of the stations, in any unit of length.
    rotations : (s, 3, 3) ndarray
        Station to frame.
    calibrations : tuple of Calibration
    points : (m, 3) ndarray
        Of the photodiodes, one a moment; same unit.
    """

    positions: Array
    rotations: Array
    calibrations: tuple[Calibration, ...]
    points: Array


@dataclass(frozen=True)
class BundleAdjustment:
    """Result of :func:`adjust_bundle`.

    Attributes
    ----------
    rig : BundleState
    residuals : (m, s, 2) ndarray
        Predicted minus observed angle, in radians; ``nan`` where nothing was seen.
    weights : (m, s, 2) ndarray
        Robust weight of each, 0 to 1.
    station_covariance : (s, 10, 10) ndarray
        Of each station's unknowns, in the frame that was held.
    iterations : int
    cost : float
        Half the robust sum of squares at the end.
    """

    rig: BundleState
    residuals: Array
    weights: Array
    station_covariance: Array
    iterations: int
    cost: float


def adjust_bundle(
    angles: Array,
    rig: BundleState,
    *,
    sigma: float,
    planar: bool = False,
    fixed_points: bool = False,
    calibrate: bool = True,
    independent: int = 100,
    soft: float = 3e-3,
    iterations: int = 50,
) -> BundleAdjustment:
    """Refine a rig so that it predicts the observed angles.

    Parameters
    ----------
    angles : (m, s, 2) ndarray
        Observed rotor angles, ``nan`` where a station was not seen.
    rig : BundleState
        Where to start.
    sigma : float
        Standard deviation of an angle, in radians.
    planar : bool
        Keep the z of all points as it is.
    fixed_points : bool
        Points are known (markers): only the stations move.
    calibrate : bool
        Also estimate tilt and phase of the stations whose calibration is generic, with
        its spread over units as prior. Factory calibration is never touched.
    independent : int
        Moments share the error of the model: they inform as this many independent ones,
        at most (the paper's Fig. 12 saturates there), or tilt and phase would be bent to
        explain what they do not cause.
    soft : float
        Residual at which the Cauchy loss turns soft, in radians.
    iterations : int
        At most so many steps.

    Returns
    -------
    BundleAdjustment
    """
    seen = np.isfinite(angles)
    observed = np.where(seen, angles, 0.0)
    sigma = sigma * np.sqrt(max(1.0, len(angles) / independent))
    loss_width = soft / sigma
    free = np.array([calibrate and c.source in ("generic", "estimated") for c in rig.calibrations])
    prior = _Prior.of(rig, free)
    dims = 0 if fixed_points else (2 if planar else 3)

    def linearised(rig: BundleState) -> _System:
        return _linearise(observed, seen, rig, sigma, loss_width, prior, dims)

    def attempt(
        rig: BundleState, system: _System, damping: float, step: int
    ) -> tuple[BundleState, _System]:
        trial = _step(system, rig, damping, planar, dims)
        found = linearised(trial)
        if dims and step > SLOW:
            # Along a curved valley the points fall behind: let them find their own best place.
            trial = replace(trial, points=_settled(found, trial.points, dims))
            found = linearised(trial)
        return trial, found

    rig, system, steps = descend(rig, linearised(rig), attempt, damping=1e-3, iterations=iterations)
    reduced, _, _ = _reduce(system, 0.0, dims)
    # Held directions and frozen calibrations carry no information of their own.
    loose = np.eye(len(reduced))
    if dims:
        basis = _gauge(rig, planar)
        loose -= basis @ basis.T
    covariance = loose @ np.linalg.pinv(loose @ reduced @ loose, hermitian=True) @ loose
    s = len(rig.positions)
    blocks = covariance.reshape(s, STATION_UNKNOWNS, s, STATION_UNKNOWNS)
    return BundleAdjustment(
        rig,
        np.where(seen, system.residuals * sigma, np.nan),
        np.where(seen, system.weights, np.nan),
        np.stack([blocks[i, :, i, :] for i in range(s)]),
        steps,
        system.cost,
    )


@dataclass(frozen=True)
class _Prior:
    """Where tilts and phases are expected, and how firmly: (s, 4) each."""

    mean: Array
    information: Array

    @classmethod
    def of(cls, rig: BundleState, free: NDArray[np.bool_]) -> _Prior:
        own = np.stack([calibration_parameters(c) for c in rig.calibrations])
        mean = np.where(free[:, None], calibration_parameters(GENERIC_CALIBRATION), own)
        spread = np.concatenate([PHASE_TILT_SIGMA_RAD[:, 1], PHASE_TILT_SIGMA_RAD[:, 0]])
        information = np.full(mean.shape, np.inf)
        # What is the same in every unit (the first phase is zero) is not estimated.
        loose = free[:, None] & (spread > 0)
        information[loose] = np.broadcast_to(
            1.0 / np.where(spread > 0, spread, 1.0) ** 2, mean.shape
        )[loose]
        return cls(mean, information)


def calibration_parameters(calibration: Calibration) -> Array:
    """(4,) both tilts and both phases, which an adjustment may estimate, in radians."""
    return np.concatenate([calibration.sweeps[:, TILT], calibration.sweeps[:, PHASE]])


@dataclass(frozen=True)
class _System:
    """Normal equations before the points are eliminated."""

    stations: Array  # (s, 10, 10)
    stations_rhs: Array  # (s, 10)
    points: Array  # (m, d, d)
    points_rhs: Array  # (m, d)
    mixed: Array  # (m, s * 10, d)
    residuals: Array  # (m, s, 2) in sigmas
    weights: Array
    cost: float


def _linearise(
    observed: Array,
    seen: NDArray[np.bool_],
    rig: BundleState,
    sigma: float,
    loss_width: float,
    prior: _Prior,
    dims: int,
) -> _System:
    m, s = observed.shape[:2]
    n = STATION_UNKNOWNS
    stations = np.zeros((s, n, n))
    stations_rhs = np.zeros((s, n))
    points = np.zeros((m, dims, dims))
    points_rhs = np.zeros((m, dims))
    mixed = np.zeros((m, s * n, dims))
    residuals = np.zeros((m, s, 2))
    weights = np.zeros((m, s, 2))
    cost = 0.0
    for i in range(s):
        rotation = rig.rotations[i]
        offset = rig.points - rig.positions[i]
        predicted, by_local, by_tilt = predict_with_gradient(offset @ rotation, rig.calibrations[i])
        residual = np.where(seen[:, i], predicted - observed[:, i], 0.0) / sigma
        # A point outside the cone of a sweep cannot have been seen by it.
        residual = np.where(np.isfinite(residual), residual, 1e3)
        ratio = (residual / loss_width) ** 2
        weight = np.where(seen[:, i], 1.0 / (1.0 + ratio), 0.0)
        cost += 0.5 * loss_width**2 * float(np.sum(np.log1p(ratio)))
        root = np.where(np.isfinite(predicted), np.sqrt(weight), 0.0) / sigma

        by_point = by_local @ rotation.T
        jacobian = np.zeros((m, 2, n))
        jacobian[..., 0:3] = -by_point
        jacobian[..., 3:6] = np.cross(by_point, offset[:, None, :])
        jacobian[:, 0, 6] = by_tilt[:, 0]
        jacobian[:, 1, 7] = by_tilt[:, 1]
        jacobian[:, 0, 8] = jacobian[:, 1, 9] = -1.0
        jacobian = np.nan_to_num(jacobian) * root[..., None]
        pulled = residual * np.sqrt(weight)

        flat = jacobian.reshape(-1, n)
        stations[i] = flat.T @ flat
        stations_rhs[i] = flat.T @ pulled.ravel()
        deviation = calibration_parameters(rig.calibrations[i]) - prior.mean[i]
        held = np.isinf(prior.information[i])
        information = np.where(held, 0.0, prior.information[i])
        stations[i][range(6, 10), range(6, 10)] += information
        stations_rhs[i][6:] += information * deviation
        cost += 0.5 * float(np.sum(information * deviation**2))
        frozen = 6 + np.flatnonzero(held)
        flat[:, frozen] = 0.0
        stations[i][frozen, :] = stations[i][:, frozen] = 0.0
        stations_rhs[i][frozen] = 0.0
        if dims:
            by_free = np.nan_to_num(by_point[..., :dims]) * root[..., None]
            transposed = by_free.transpose(0, 2, 1)
            points += transposed @ by_free
            points_rhs += (transposed @ pulled[..., None])[..., 0]
            mixed[:, i * n : (i + 1) * n] = flat.reshape(m, 2, n).transpose(0, 2, 1) @ by_free
        residuals[:, i], weights[:, i] = residual, weight
    return _System(stations, stations_rhs, points, points_rhs, mixed, residuals, weights, cost)


def _reduce(system: _System, damping: float, dims: int) -> tuple[Array, Array, Array]:
    """Reduced station matrix and right side, and the inverses of the points' blocks."""
    s, n = system.stations_rhs.shape
    full = np.zeros((s * n, s * n))
    for i in range(s):
        full[i * n : (i + 1) * n, i * n : (i + 1) * n] = system.stations[i]
    rhs = system.stations_rhs.ravel().copy()
    full[np.diag_indices(s * n)] *= 1.0 + damping
    if not dims:
        return full, rhs, np.zeros((0, 0, 0), np.float64)
    blocks = system.points.copy()
    diagonal = np.einsum("mii->mi", blocks)
    diagonal *= 1.0 + damping
    # A point seen by too few planes has no place: leave it where it is.
    diagonal += 1e-12 * diagonal.max() + 1e-300
    inverses = np.linalg.inv(blocks).astype(np.float64, copy=False)
    eliminated = system.mixed @ inverses
    columns = eliminated.transpose(1, 0, 2).reshape(s * n, -1)
    full -= columns @ system.mixed.transpose(1, 0, 2).reshape(s * n, -1).T
    rhs -= columns @ system.points_rhs.ravel()
    return full, rhs, inverses


def _hold_gauge(matrix: Array, rig: BundleState, planar: bool, dims: int) -> Array:
    """Add a penalty on moving, turning and scaling the whole rig."""
    if not dims:
        return matrix
    basis = _gauge(rig, planar)
    return matrix + np.max(np.diag(matrix)) * basis @ basis.T


def _gauge(rig: BundleState, planar: bool) -> Array:
    """(s * 10, g) orthonormal directions of the unknowns that no angle depends on."""
    s = len(rig.positions)
    motions = []
    for axis in range(2 if planar else 3):
        shift = np.zeros((s, STATION_UNKNOWNS))
        shift[:, axis] = 1.0
        motions.append(shift)
    for axis in (2,) if planar else range(3):
        turn = np.zeros((s, STATION_UNKNOWNS))
        unit = np.eye(3)[axis]
        turn[:, 0:3] = np.cross(unit, rig.positions)
        turn[:, 3:6] = unit
        motions.append(turn)
    growth = np.zeros((s, STATION_UNKNOWNS))
    growth[:, 0:3] = rig.positions
    motions.append(growth)
    return np.linalg.qr(np.stack([g.ravel() for g in motions], axis=1))[0]


def _settled(system: _System, points: Array, dims: int) -> Array:
    """Points after a step of their own, the stations held."""
    blocks = system.points.copy()
    diagonal = np.einsum("mii->mi", blocks)
    diagonal += 1e-9 * np.max(diagonal, initial=0.0) + 1e-300
    moved = points.copy()
    moved[:, :dims] -= np.linalg.solve(blocks, system.points_rhs[..., None])[..., 0]
    return moved


def _step(
    system: _System, rig: BundleState, damping: float, planar: bool, dims: int
) -> BundleState:
    reduced, rhs, inverses = _reduce(system, damping, dims)
    frozen = ~np.any(reduced, axis=1)
    reduced = _hold_gauge(reduced, rig, planar, dims)
    delta = -np.linalg.lstsq(reduced, rhs, rcond=1e-14)[0]
    delta[frozen] = 0.0
    change = delta.reshape(len(rig.positions), STATION_UNKNOWNS)
    points = rig.points
    if dims:
        back = system.points_rhs + np.einsum("mkd,k->md", system.mixed, delta)
        points = points.copy()
        points[:, :dims] -= (inverses @ back[..., None])[..., 0]
    return BundleState(
        rig.positions + change[:, 0:3],
        rotation_exp(change[:, 3:6]) @ rig.rotations,
        tuple(with_parameters(c, d) for c, d in zip(rig.calibrations, change[:, 6:], strict=True)),
        points,
    )


def with_parameters(calibration: Calibration, change: Array) -> Calibration:
    """A calibration with its :func:`calibration_parameters` changed by so much."""
    if not np.any(change):
        return calibration
    sweeps = calibration.sweeps.copy()
    sweeps[:, TILT] += change[0:2]
    sweeps[:, PHASE] += change[2:4]
    return replace(calibration, sweeps=sweeps, source="estimated")
