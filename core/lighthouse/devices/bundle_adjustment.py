"""Joint adjustment of base stations and of the poses of rigid devices.

The counterpart of :mod:`locatk.core.lighthouse.scene.bundle_adjustment` with devices of known
shape in place of points: they determine the scale. Poses and velocities of the epochs are
eliminated (:class:`locatk.core.least_squares.SchurEquations`). The first station fixes the frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.least_squares import Indices, SchurEquations, SchurStep, cauchy_loss, minimize
from locatk.core.lighthouse.calibration import predict_with_gradient
from locatk.core.lighthouse.devices.pose_fit import (
    RATE,
    RATE_SIGMA,
    DeviceStates,
    SweepObservations,
    photodiode_positions,
)
from locatk.core.lighthouse.noise import UNREACHABLE_RESIDUAL_SIGMAS
from locatk.core.lighthouse.scene.bundle_adjustment import (
    STATION_PARAMETERS,
    BundleState,
    add_calibration_prior,
    free_parameters,
    retract_stations,
    station_blocks,
    station_jacobian,
)
from locatk.core.lighthouse.scene.model import StationArrays

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DeviceAdjustment:
    """Result of :func:`adjust_devices`.

    Attributes
    ----------
    stations : StationArrays
    poses : DeviceStates
    residual : (m, n) ndarray
        Predicted minus observed angle in radians; ``nan`` if not observed.
    covariance : (s, 6, 6) ndarray
        Covariance of position and rotation of each station in the frame of the first station,
        for which it is zero.
    iterations : int
    """

    stations: StationArrays
    poses: DeviceStates
    residual: Array
    covariance: Array
    iterations: int


def adjust_devices(
    observations: SweepObservations,
    stations: StationArrays,
    poses: DeviceStates,
    *,
    sigma_rad: float,
    loss_scale_rad: float,
    epoch_weight: Array,
    calibrate: NDArray[np.bool_],
    max_iterations: int = 40,
) -> DeviceAdjustment:
    """Refine stations and device states so that they predict the observed angles.

    Parameters
    ----------
    observations : SweepObservations
    stations : StationArrays
        Initial guess; the first station does not move.
    poses : DeviceStates
        Initial guess.
    sigma_rad : float
        Standard deviation of an angle in radians.
    loss_scale_rad : float
        Residual in radians at which the weight of a sweep is one half (Cauchy loss).
    epoch_weight : (m,) ndarray
        Weight of each epoch, 0 to 1: epochs at one position repeat each other's errors.
    calibrate : (s,) bool ndarray
        Stations of which tilts and phases are estimated, with their spread over units as prior.
    max_iterations : int
        Maximum number of iterations.
    """
    free = free_parameters(calibrate)
    free[0, :6] = False
    problem = _DeviceBundle(observations, sigma_rad, loss_scale_rad / sigma_rad, epoch_weight, free)
    minimum = minimize(
        problem, _BundledDevices(stations, poses), damping=1e-4, max_iterations=max_iterations
    )
    equations: SchurEquations = minimum.equations
    blocks = station_blocks(equations.covariance(), len(calibrate))
    return DeviceAdjustment(
        minimum.state.stations,
        minimum.state.poses,
        np.where(observations.is_observed, equations.residual * sigma_rad, np.nan),
        blocks[:, :6, :6],
        int(minimum.iterations[0]),
    )


@dataclass(frozen=True)
class _BundledDevices:
    """Stations and device states: the unknowns of the adjustment."""

    stations: StationArrays
    poses: DeviceStates


@dataclass(frozen=True)
class _DeviceBundle:
    """Bundle adjustment as a problem for :func:`~locatk.core.least_squares.minimize`.

    ``loss_scale`` is in standard deviations; ``free`` (s, 10) are the unknowns of the stations
    that are estimated.
    """

    observations: SweepObservations
    sigma_rad: float
    loss_scale: float
    epoch_weight: Array
    free: NDArray[np.bool_]

    def linearize(self, state: _BundledDevices, _: Indices) -> SchurEquations:
        observations, weights = self.observations, self.epoch_weight
        residual, by_pose, by_station = self._residuals(state)
        observed = observations.is_observed
        unreachable = observed & ~np.isfinite(residual)
        residual = np.where(unreachable, UNREACHABLE_RESIDUAL_SIGMAS, np.nan_to_num(residual))
        loss, weight = cauchy_loss(residual, self.loss_scale)
        weight = np.where(observed & ~unreachable, weights[:, None] * weight, 0.0)
        root = np.sqrt(weight)[..., None]
        by_pose, by_station = np.nan_to_num(by_pose) * root, np.nan_to_num(by_station) * root
        weighted = residual[..., None] * root

        transposed = np.swapaxes(by_pose, -1, -2)
        block_hessian, block_gradient = transposed @ by_pose, (transposed @ weighted)[..., 0]
        rate_index = range(RATE.start, RATE.stop)
        block_hessian[:, rate_index, rate_index] += weights[:, None] * RATE_SIGMA**-2
        block_gradient[:, RATE] += weights[:, None] * state.poses.rate / RATE_SIGMA**2
        epoch_cost = np.sum(loss, axis=1, where=observed)
        epoch_cost = epoch_cost + 0.5 * np.sum((state.poses.rate / RATE_SIGMA) ** 2, axis=1)

        m, s, n = len(observations), len(self.free), STATION_PARAMETERS
        hessian, gradient = np.zeros((s, n, s, n)), np.zeros((s, n))
        coupling = np.zeros((m, s, n, by_pose.shape[-1]))
        cost = float(weights @ epoch_cost)
        cost += add_calibration_prior(hessian, gradient, state.stations[2], self.free)
        for i in range(s):
            of_station = observations.station == i
            own = by_station[of_station]
            hessian[i, :, i, :] += own.T @ own
            gradient[i] += own.T @ weighted[of_station][:, 0]
            padded = by_station * of_station[..., None]
            coupling[:, i] = np.swapaxes(padded, -1, -2) @ by_pose
        return SchurEquations(
            np.array([cost]),
            hessian.reshape(s * n, s * n),
            gradient.ravel(),
            block_hessian,
            block_gradient,
            coupling.reshape(m, s * n, -1),
            self.free.ravel(),
            np.zeros((s * n, 0)),
            np.where(observed, residual, np.nan),
            weight,
        )

    def _residuals(self, state: _BundledDevices) -> tuple[Array, Array, Array]:
        """Return the residuals and their derivatives, in standard deviations.

        Returns
        -------
        residual : (m, n) ndarray
        by_pose : (m, n, 12) ndarray
            Derivatives by pose and rates of the device.
        by_station : (m, n, 10) ndarray
            Derivatives by the unknowns of the station.
        """
        observations = self.observations
        positions, rotations, calibrations = state.stations
        lever_arm, position = photodiode_positions(observations, state.poses)
        shape = observations.angle.shape
        residual, by_position = np.full(shape, np.nan), np.zeros((*shape, 3))
        by_station = np.zeros((*shape, STATION_PARAMETERS))
        for i, calibration in enumerate(calibrations):
            of_station = observations.is_observed & (observations.station == i)
            offset = position[of_station] - positions[i]
            angles, gradient, by_tilt = predict_with_gradient(offset @ rotations[i], calibration)
            rows, plane = np.arange(len(offset)), observations.plane[of_station]
            residual[of_station] = angles[rows, plane] - observations.angle[of_station]
            by_position[of_station] = gradient[rows, plane] @ rotations[i].T
            by_station[of_station] = station_jacobian(
                by_position[of_station], offset, by_tilt[rows, plane], plane
            )
        by_pose = np.concatenate([by_position, np.cross(lever_arm, by_position)], axis=-1)
        by_pose = np.concatenate(
            [by_pose, by_pose * observations.time_offset_s[..., None]], axis=-1
        )
        return residual / self.sigma_rad, by_pose / self.sigma_rad, by_station / self.sigma_rad

    def retract(self, state: _BundledDevices, step: SchurStep) -> _BundledDevices:
        stations = BundleState(*state.stations, np.zeros((0, 3)))
        change = step.shared.reshape(-1, STATION_PARAMETERS)
        return replace(
            state,
            stations=retract_stations(stations, change),
            poses=state.poses.stepped(step.blocks),
        )
