"""Poses and velocities of rigid devices from the angles of their photodiodes, in batches.

Each sweep measures one angle of one photodiode at its own time. A tracker that moves at 0.5 m/s
moves 10 mm during a rotation, so that the sweeps of a rotation do not share one pose. The unknowns
of an epoch are therefore the pose of the device and its velocity and angular velocity, which are
taken as constant within the epoch. The residuals are predicted minus observed rotor angles, under
a Cauchy loss; :func:`locatk.core.least_squares.minimize` solves all epochs of a batch together.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import rotation_exp
from locatk.core.least_squares import DenseEquations, Indices, cauchy_loss, minimize
from locatk.core.lighthouse.calibration import predict_angles, predict_with_gradient
from locatk.core.lighthouse.noise import UNREACHABLE_RESIDUAL_SIGMAS
from locatk.core.lighthouse.scene.model import StationArrays

Array = NDArray[np.float64]

RATE_SIGMA = np.repeat([2.0, 10.0], 3)
"""Standard deviations of the prior on velocity [m/s] and angular velocity [rad/s], as
of a device on a drone or in a hand. They keep a velocity near zero that the sweeps do not
determine."""

MAX_ROTATION_STEP_RAD = 0.7
"""Largest rotation of one step: the angles are far from linear in larger ones, which could flip a
device."""

MIN_STEP = 1e-8
"""Norm of a step (m, rad, m/s, rad/s) below which a pose has converged."""

RATE = slice(6, 12)
"""Range of velocity and angular velocity in the twelve unknowns; before them are translation and
rotation vector."""


@dataclass(frozen=True)
class SweepObservations:
    """Sweeps by epoch: (m, n) each, padded to the same number.

    Attributes
    ----------
    sensor_position : (m, n, 3) ndarray
        Position of the photodiode in the device's axes, in metres.
    station, plane : (m, n) int ndarray
        Column of the station, and number of its light plane.
    angle : (m, n) ndarray
        Observed rotor angle in radians.
    time_offset_s : (m, n) ndarray
        Time of the sweep minus the time of the epoch, in seconds.
    is_observed : (m, n) bool ndarray
        False for the padding.
    """

    sensor_position: Array
    station: NDArray[np.int64]
    plane: NDArray[np.int64]
    angle: Array
    time_offset_s: Array
    is_observed: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.angle)

    def take(self, epochs: Indices | NDArray[np.bool_]) -> SweepObservations:
        """Return the observations of the chosen epochs."""
        return SweepObservations(*(getattr(self, f.name)[epochs] for f in fields(self)))

    def trimmed(self) -> SweepObservations:
        """The same with as little padding as possible, at the ends of the rows."""
        order = np.argsort(~self.is_observed, axis=1, kind="stable")
        order = order[:, : int(np.max(np.count_nonzero(self.is_observed, axis=1), initial=0))]
        row = np.arange(len(self))[:, None]
        return SweepObservations(*(getattr(self, f.name)[row, order] for f in fields(self)))


@dataclass(frozen=True)
class DeviceStates:
    """Poses of devices, device to frame, with their rates of change.

    Attributes
    ----------
    position : (m, 3) ndarray
        Metres.
    rotation : (m, 3, 3) ndarray
    rate : (m, 6) ndarray
        Velocity in m/s and angular velocity in rad/s, in the frame's axes.
    """

    position: Array
    rotation: Array
    rate: Array

    @classmethod
    def at_rest(cls, position: Array, rotation: Array) -> DeviceStates:
        """Return the states of devices at rest, at poses (m, 3), (m, 3, 3)."""
        return cls(position, rotation, np.zeros((len(position), 6)))

    def __len__(self) -> int:
        return len(self.position)

    def take(self, epochs: Indices | NDArray[np.bool_]) -> DeviceStates:
        """Return a copy of the chosen states."""
        return DeviceStates(self.position[epochs], self.rotation[epochs], self.rate[epochs])

    def put(self, epochs: Indices | NDArray[np.bool_], other: DeviceStates) -> None:
        """Overwrite the chosen states."""
        for f in fields(self):
            getattr(self, f.name)[epochs] = getattr(other, f.name)

    def later(self, seconds: Array) -> DeviceStates:
        """Return the states after (m,) seconds at constant rates."""
        return DeviceStates(
            self.position + self.rate[:, :3] * seconds[:, None],
            rotation_exp(self.rate[:, 3:] * seconds[:, None]) @ self.rotation,
            self.rate.copy(),
        )

    def stepped(self, change: Array) -> DeviceStates:
        """Return the states after a change (m, 12): translation, rotation in the frame, rates."""
        return DeviceStates(
            self.position + change[:, 0:3],
            rotation_exp(change[:, 3:6]) @ self.rotation,
            self.rate + change[:, RATE],
        )


@dataclass(frozen=True)
class PoseFit:
    """Result of :func:`fit_poses`.

    Attributes
    ----------
    poses : DeviceStates
    residual : (m, n) ndarray
        Predicted minus observed angle in radians; ``nan`` if not observed.
    information : (m, 12, 12) ndarray
        Inverse covariance of pose and rates, for angles of the given standard deviation.
    cost : (m,) ndarray
        Half the robust sum of squares.
    """

    poses: DeviceStates
    residual: Array
    information: Array
    cost: Array


def fit_poses(
    observations: SweepObservations,
    stations: StationArrays,
    start: DeviceStates,
    *,
    sigma_rad: float,
    loss_scale_rad: float | Array,
    max_iterations: int = 30,
    tolerance: float = 1e-4,
    cutoff_rad: float = np.inf,
) -> PoseFit:
    """Fit the state of a device at each epoch to the angles of its sweeps.

    Parameters
    ----------
    observations : SweepObservations
    stations : StationArrays
    start : DeviceStates
        Initial guess.
    sigma_rad : float
        Standard deviation of an angle in radians.
    loss_scale_rad : float or (m,) ndarray
        Residual in radians at which the weight of a sweep is one half (Cauchy loss).
    max_iterations : int
        Maximum number of iterations.
    tolerance : float
        A pose has converged when a step lowers its cost by less than this fraction. The next
        step would gain about the square of it.
    cutoff_rad : float
        Residual in radians beyond which a sweep has no weight at all: a hundred sweeps of a
        displaced station bias a pose, however small the weight of each. The initial guess must
        be better than this.
    """
    width = np.broadcast_to(np.asarray(loss_scale_rad) / sigma_rad, len(observations))[:, None]
    problem = _PoseProblem(observations, stations, sigma_rad, width, cutoff_rad / sigma_rad)
    minimum = minimize(
        problem,
        start,
        len(observations),
        damping=1e-4,
        max_iterations=max_iterations,
        min_gain=tolerance,
        min_step=MIN_STEP,
    )
    equations: DenseEquations = minimum.equations
    residual = np.where(observations.is_observed, equations.residual * sigma_rad, np.nan)
    return PoseFit(minimum.state, residual, equations.hessian, equations.cost)


@dataclass(frozen=True)
class _PoseProblem:
    """Fit of poses as a problem for :func:`~locatk.core.least_squares.minimize`.

    ``loss_scale`` (m, 1) and ``cutoff`` are in standard deviations.
    """

    observations: SweepObservations
    stations: StationArrays
    sigma_rad: float
    loss_scale: Array
    cutoff: float

    def linearize(self, state: DeviceStates, epochs: Indices) -> DenseEquations:
        are_all_running = len(epochs) == len(self.observations)
        observations = self.observations if are_all_running else self.observations.take(epochs)
        residual, by_pose = linearize(observations, self.stations, state)
        observed = observations.is_observed
        unreachable = observed & ~np.isfinite(residual)
        residual = np.nan_to_num(residual) / self.sigma_rad
        residual[unreachable] = UNREACHABLE_RESIDUAL_SIGMAS
        loss, weight = cauchy_loss(residual, self.loss_scale[epochs], self.cutoff)
        root = np.where(observed & ~unreachable, np.sqrt(weight), 0.0)
        cost = np.sum(loss, axis=1, where=observed)
        by_pose = np.nan_to_num(by_pose) * (root / self.sigma_rad)[..., None]
        weighted = residual * root
        by_rate = by_pose * observations.time_offset_s[..., None]
        jacobian = np.concatenate([by_pose, by_rate], axis=-1)
        equations = DenseEquations.from_weighted(residual, weighted, jacobian, cost)
        equations.add_prior(RATE, state.rate, RATE_SIGMA)
        return equations

    def retract(self, state: DeviceStates, step: Array) -> DeviceStates:
        angle = np.linalg.norm(step[:, 3:6], axis=1, keepdims=True)
        return state.stepped(
            step * np.minimum(1.0, MAX_ROTATION_STEP_RAD / np.maximum(angle, 1e-12))
        )


def angle_residuals(
    observations: SweepObservations, stations: StationArrays, poses: DeviceStates
) -> Array:
    """Return predicted minus observed angles (m, n) in radians.

    They are ``nan`` if not observed, or if no light plane meets the photodiode.
    """
    _, position = photodiode_positions(observations, poses)
    residual = np.full(observations.angle.shape, np.nan)
    for i, calibration in enumerate(stations[2]):
        of_station = observations.is_observed & (observations.station == i)
        local = (position[of_station] - stations[0][i]) @ stations[1][i]
        angles = predict_angles(local, calibration)
        plane = observations.plane[of_station]
        residual[of_station] = angles[np.arange(len(local)), plane] - observations.angle[of_station]
    return residual


def linearize(
    observations: SweepObservations, stations: StationArrays, poses: DeviceStates
) -> tuple[Array, Array]:
    """Return residuals and their derivatives by the pose of the device.

    Returns
    -------
    residual : (m, n) ndarray
        Predicted minus observed angle in radians; ``nan`` if no light plane meets the photodiode.
    by_pose : (m, n, 6) ndarray
        Derivative by translation and rotation of the device at the time of each sweep. They
        approximate those at the epoch: a device rotates little within a rotation of the station,
        and the derivatives only have to point downhill.
    """
    lever_arm, position = photodiode_positions(observations, poses)
    residual = np.full(observations.angle.shape, np.nan)
    by_position = np.full((*observations.angle.shape, 3), np.nan)
    for i, calibration in enumerate(stations[2]):
        of_station = observations.is_observed & (observations.station == i)
        if not np.any(of_station):
            continue
        rotation = stations[1][i]
        local = (position[of_station] - stations[0][i]) @ rotation
        angles, gradient, _ = predict_with_gradient(local, calibration)
        rows, plane = np.arange(len(local)), observations.plane[of_station]
        residual[of_station] = angles[rows, plane] - observations.angle[of_station]
        by_position[of_station] = gradient[rows, plane] @ rotation.T
    by_rotation = np.cross(lever_arm, by_position)
    return residual, np.concatenate([by_position, by_rotation], axis=-1)


def photodiode_positions(
    observations: SweepObservations, poses: DeviceStates
) -> tuple[Array, Array]:
    """Return the photodiodes at the times of their sweeps.

    Returns
    -------
    lever_arm, position : (m, n, 3) ndarray
        From the device to the photodiode, and in the frame; both in the frame's axes.
    """
    lever_arm = observations.sensor_position @ np.swapaxes(poses.rotation, -1, -2)
    elapsed_s = observations.time_offset_s[..., None]
    if np.any(poses.rate):
        lever_arm = _rotate(lever_arm, poses.rate[:, None, 3:] * elapsed_s)
    return lever_arm, poses.position[:, None] + poses.rate[:, None, :3] * elapsed_s + lever_arm


def _rotate(vectors: Array, rotation_vectors: Array) -> Array:
    """Rotate vectors (..., 3) by rotation vectors: Rodrigues' formula without matrices."""
    angle = np.sqrt(np.einsum("...i,...i->...", rotation_vectors, rotation_vectors))[..., None]
    cross = np.cross(rotation_vectors, vectors)
    versine = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    return vectors + np.sinc(angle / np.pi) * cross + versine * np.cross(rotation_vectors, cross)
