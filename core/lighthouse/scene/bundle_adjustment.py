"""Robust bundle adjustment of base stations and points.

The unknowns are the pose of each station, the position of each point (a photodiode at one time)
and, for stations without a factory calibration, the tilts and phases of both light planes. The
residuals are the rotor angles that the state predicts minus the observed ones, under a Cauchy
loss. :mod:`locatk.core.least_squares` eliminates the points; a step then costs one solve of ten
unknowns per station.

The data do not determine the frame, nor the scale unless points are known. These directions (the
gauge) are constrained to the initial guess, and the covariance is zero along them: it holds in
that frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import rotation_exp, skew
from locatk.core.least_squares import Indices, SchurEquations, SchurStep, cauchy_loss, minimize
from locatk.core.lighthouse.calibration import (
    GENERIC_CALIBRATION,
    PHASE,
    PHASE_TILT_SIGMA_RAD,
    TILT,
    Calibration,
    predict_with_gradient,
)
from locatk.core.lighthouse.noise import UNREACHABLE_RESIDUAL_SIGMAS

Array = NDArray[np.float64]

STATION_PARAMETERS = 10
"""Unknowns of a station: position, rotation vector in the frame, two tilts, two phases."""

POSITION, ROTATION, CALIBRATION = slice(0, 3), slice(3, 6), slice(6, 10)
"""Columns of these unknowns."""

LOSS_SCALE_RAD = 3e-3
"""Residual at which the weight of an angle is one half: beyond what a generic calibration leaves
unmodelled (1 mrad), and far below reflections and demodulation errors."""

MAX_INDEPENDENT_POINTS = 100
"""Maximum number of points that carry independent information: the errors of the model are common
to points, and the accuracy of a scene saturates at about so many (Alvarado-Marin et al. 2024,
Fig. 12). With more, tilts and phases would absorb errors that have other causes."""

INNER_ITERATIONS_AFTER = 10
"""Iterations after which the points take a step of their own as well, which doubles the work and
carries the adjustment through the curved valleys of a narrow field of view."""


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
        Positions of the photodiodes, one per epoch, in the same unit.
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
    state : BundleState
    residuals : (m, s, 2) ndarray
        Predicted minus observed angle in radians; ``nan`` if not observed.
    weights : (m, s, 2) ndarray
        Robust weights, 0 to 1.
    station_covariance : (s, 10, 10) ndarray
        Covariance of each station's unknowns, in the frame of the gauge.
    iterations : int
    cost : float
        Half the robust sum of squares at the minimum.
    """

    state: BundleState
    residuals: Array
    weights: Array
    station_covariance: Array
    iterations: int
    cost: float


def adjust_bundle(
    angles: Array,
    state: BundleState,
    *,
    sigma_rad: float,
    planar: bool = False,
    fixed_points: bool = False,
    calibrate: bool = True,
    independent_points: int = MAX_INDEPENDENT_POINTS,
    loss_scale_rad: float = LOSS_SCALE_RAD,
    max_iterations: int = 50,
) -> BundleAdjustment:
    """Refine stations and points so that they predict the observed angles.

    Parameters
    ----------
    angles : (m, s, 2) ndarray
        Observed rotor angles in radians; ``nan`` if a station was not observed.
    state : BundleState
        Initial guess.
    sigma_rad : float
        Standard deviation of an angle in radians.
    planar : bool
        Keep the z coordinate of all points.
    fixed_points : bool
        Points are known (markers): only the stations are estimated.
    calibrate : bool
        Estimate tilts and phases of the stations without a factory calibration, with their
        spread over units as prior. A factory calibration is never changed.
    independent_points : int
        Number of points that carry independent information, at most.
    loss_scale_rad : float
        Residual in radians at which the weight of an angle is one half.
    max_iterations : int
        Maximum number of iterations.
    """
    observed = np.isfinite(angles)
    sigma_rad = sigma_rad * float(np.sqrt(max(1.0, len(angles) / independent_points)))
    calibrated = [calibrate and c.is_generic for c in state.calibrations]
    problem = _PointBundle(
        angles=np.where(observed, angles, 0.0),
        observed=observed,
        sigma_rad=sigma_rad,
        loss_scale=loss_scale_rad / sigma_rad,
        free=free_parameters(calibrated),
        dims=0 if fixed_points else 2 if planar else 3,
    )
    minimum = minimize(
        problem,
        state,
        damping=1e-3,
        max_iterations=max_iterations,
        inner_iterations_after=None if fixed_points else INNER_ITERATIONS_AFTER,
    )
    equations: SchurEquations = minimum.equations
    return BundleAdjustment(
        minimum.state,
        np.where(observed, equations.residual * sigma_rad, np.nan),
        np.where(observed, equations.weight, np.nan),
        station_blocks(equations.covariance(), len(state.positions)),
        int(minimum.iterations[0]),
        float(equations.cost[0]),
    )


@dataclass(frozen=True)
class _PointBundle:
    """Bundle adjustment as a problem for :func:`~locatk.core.least_squares.minimize`.

    Attributes
    ----------
    angles, observed : (m, s, 2) ndarray
    sigma_rad : float
    loss_scale : float
        In standard deviations.
    free : (s, 10) bool ndarray
        Unknowns of the stations that are estimated.
    dims : int
        Coordinates of each point that are estimated: 0, 2 (x and y) or 3.
    """

    angles: Array
    observed: NDArray[np.bool_]
    sigma_rad: float
    loss_scale: float
    free: NDArray[np.bool_]
    dims: int

    def linearize(self, state: BundleState, _: Indices) -> SchurEquations:
        m, s = self.angles.shape[:2]
        n, dims = STATION_PARAMETERS, self.dims
        hessian, gradient = np.zeros((s, n, s, n)), np.zeros((s, n))
        points = m if dims else 0
        block_hessian, block_gradient = np.zeros((points, dims, dims)), np.zeros((points, dims))
        coupling = np.zeros((points, s, n, dims))
        residuals, weights = np.zeros((m, s, 2)), np.zeros((m, s, 2))
        cost = add_calibration_prior(hessian, gradient, state.calibrations, self.free)
        for i, calibration in enumerate(state.calibrations):
            offset = state.points - state.positions[i]
            predicted, by_local, by_tilt = predict_with_gradient(
                offset @ state.rotations[i], calibration
            )
            by_point = by_local @ state.rotations[i].T
            residual = (predicted - self.angles[:, i]) / self.sigma_rad
            reachable = np.isfinite(residual)
            residual = np.where(reachable, residual, UNREACHABLE_RESIDUAL_SIGMAS)
            loss, weight = cauchy_loss(residual, self.loss_scale)
            weight = np.where(self.observed[:, i], weight, 0.0)
            cost += float(np.sum(loss, where=self.observed[:, i]))
            root = np.sqrt(weight)
            scale = np.where(reachable, root, 0.0)[..., None] / self.sigma_rad
            jacobian = station_jacobian(by_point, offset[:, None], by_tilt, np.arange(2))
            jacobian = np.nan_to_num(jacobian) * scale
            weighted = residual * root
            flat = jacobian.reshape(-1, n)
            hessian[i, :, i, :] += flat.T @ flat
            gradient[i] += flat.T @ weighted.ravel()
            if dims:
                by_free = np.nan_to_num(by_point[..., :dims]) * scale
                transposed = by_free.transpose(0, 2, 1)
                block_hessian += transposed @ by_free
                block_gradient += (transposed @ weighted[..., None])[..., 0]
                coupling[:, i] = jacobian.transpose(0, 2, 1) @ by_free
            residuals[:, i], weights[:, i] = np.where(self.observed[:, i], residual, 0.0), weight
        return SchurEquations(
            np.array([cost]),
            hessian.reshape(s * n, s * n),
            gradient.ravel(),
            block_hessian,
            block_gradient,
            coupling.reshape(points, s * n, dims),
            self.free.ravel(),
            _gauge_directions(state.positions, dims),
            residuals,
            weights,
        )

    def retract(self, state: BundleState, step: SchurStep) -> BundleState:
        change = step.shared.reshape(-1, STATION_PARAMETERS)
        moved = BundleState(*retract_stations(state, change), state.points)
        return self.retract_blocks(moved, step.blocks) if self.dims else moved

    def retract_blocks(self, state: BundleState, step: Array) -> BundleState:
        points = state.points.copy()
        points[:, : self.dims] += step
        return replace(state, points=points)


def _gauge_directions(positions: Array, dims: int) -> Array:
    """Return orthonormal directions (s * 10, g) of the unknowns that no angle depends on.

    They are translation, rotation and scale of everything; in a plane (``dims`` 2) translation in
    x and y, rotation about z, and scale. There are none (g = 0) if the points are known.
    """
    unknowns = len(positions) * STATION_PARAMETERS
    if not dims:
        return np.zeros((unknowns, 0))
    axes = np.eye(3)
    translation, rotation = axes[:dims], axes[{2: [2], 3: [0, 1, 2]}[dims]]
    count = len(translation) + len(rotation) + 1
    motions = np.zeros((count, len(positions), STATION_PARAMETERS))
    motions[: len(translation), :, POSITION] = translation[:, None]
    rotations = motions[len(translation) : -1]
    rotations[..., POSITION] = positions @ -skew(rotation)  # the axis times the position
    rotations[..., ROTATION] = rotation[:, None]
    motions[-1, :, POSITION] = positions
    return np.linalg.qr(motions.reshape(-1, unknowns).T)[0]


# ---- unknowns of stations, common to all adjustments


def free_parameters(calibrated: Sequence[bool] | NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which unknowns (s, 10) are estimated.

    Tilts and phases are estimated for ``calibrated`` stations only, and the first phase, which is
    zero in every unit, for none.
    """
    free = np.ones((len(calibrated), STATION_PARAMETERS), bool)
    varies = calibration_sigma() > 0
    free[:, CALIBRATION] = np.asarray(calibrated, bool)[:, None] & varies
    return free


def station_jacobian(
    by_position: Array, offset: Array, by_tilt: Array, plane: NDArray[np.int64]
) -> Array:
    """Return the derivatives (..., 10) of rotor angles by the unknowns of their station.

    Parameters
    ----------
    by_position : (..., 3) ndarray
        Derivative of each angle by the position of the photodiode in the frame.
    offset : (..., 3) ndarray
        From the station to the photodiode, in the frame.
    by_tilt : (...) ndarray
        Derivative by the tilt of the plane. (By its phase it is -1.)
    plane : (...) int ndarray
        0 or 1.
    """
    is_plane = np.asarray(plane)[..., None] == np.arange(2)
    jacobian = np.empty((*by_position.shape[:-1], STATION_PARAMETERS))
    jacobian[..., POSITION] = -by_position
    jacobian[..., ROTATION] = np.cross(by_position, offset)
    jacobian[..., 6:8] = np.where(is_plane, by_tilt[..., None], 0.0)
    jacobian[..., 8:10] = np.where(is_plane, -1.0, 0.0)
    return jacobian


def add_calibration_prior(
    hessian: Array,
    gradient: Array,
    calibrations: Sequence[Calibration],
    free: NDArray[np.bool_],
) -> float:
    """Add the spread of tilts and phases over units to normal equations; return its cost.

    ``hessian`` (s, 10, s, 10) and ``gradient`` (s, 10) are changed in place.
    """
    sigma = calibration_sigma()
    mean = calibration_parameters(GENERIC_CALIBRATION)
    cost = 0.0
    for i, calibration in enumerate(calibrations):
        estimated = free[i, CALIBRATION]
        index = np.arange(CALIBRATION.start, CALIBRATION.stop)[estimated]
        deviation = (calibration_parameters(calibration) - mean)[estimated]
        information = sigma[estimated] ** -2.0
        hessian[i, index, i, index] += information
        gradient[i, index] += information * deviation
        cost += 0.5 * float(information @ deviation**2)
    return cost


def retract_stations(
    state: BundleState, change: Array
) -> tuple[Array, Array, tuple[Calibration, ...]]:
    """Return positions, rotations and calibrations after a change (s, 10) of their unknowns."""
    return (
        state.positions + change[:, POSITION],
        rotation_exp(change[:, ROTATION]) @ state.rotations,
        tuple(
            with_parameters(calibration, step)
            for calibration, step in zip(state.calibrations, change[:, CALIBRATION], strict=True)
        ),
    )


def station_blocks(covariance: Array, stations: int) -> Array:
    """Return the diagonal blocks (s, 10, 10) of a covariance (s * 10, s * 10)."""
    n = STATION_PARAMETERS
    blocks = covariance.reshape(stations, n, stations, n)
    return np.stack([blocks[i, :, i, :] for i in range(stations)])


def calibration_parameters(calibration: Calibration) -> Array:
    """Return both tilts and both phases (4,) in radians, which an adjustment may estimate."""
    return np.concatenate([calibration.sweeps[:, TILT], calibration.sweeps[:, PHASE]])


def calibration_sigma() -> Array:
    """Return the standard deviations (4,) of :func:`calibration_parameters` over units."""
    return np.concatenate([PHASE_TILT_SIGMA_RAD[:, 1], PHASE_TILT_SIGMA_RAD[:, 0]])


def with_parameters(calibration: Calibration, change: Array) -> Calibration:
    """Add a change (4,) to the :func:`calibration_parameters` of a calibration."""
    if not np.any(change):
        return calibration
    sweeps = calibration.sweeps.copy()
    sweeps[:, TILT] += change[0:2]
    sweeps[:, PHASE] += change[2:4]
    return replace(calibration, sweeps=sweeps, source="estimated")
