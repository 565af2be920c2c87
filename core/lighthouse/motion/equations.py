"""Normal equations of paths and common parameters.

The states of the paths form a chain, so that their part of the matrix is block-tridiagonal. The
common parameters couple to all states (an arrow) and are solved by a Schur complement. The same
factorization gives the covariance of each state, with the part that the common parameters add.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from locatk.core.block_tridiagonal import BlockTridiagonal
from locatk.core.kernels import kernels
from locatk.core.lighthouse.motion.inertial import InertialFactors
from locatk.core.lighthouse.motion.parameters import CommonParameters
from locatk.core.lighthouse.motion.path import Path, lever_jacobian, prior_information

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
Mask = NDArray[np.bool_]

WEAK_RATE_SIGMA = np.repeat([30.0, 100.0], 3)
"""Standard deviations of velocity [m/s] and angular velocity [rad/s] before any sweep."""


MAX_STEP = 30.0
"""Standard deviation of a step of a pose in m and rad: it keeps the states determined at which all
sweeps are rejected."""

FLOOR_SIGMA_M = 1e-5
"""Standard deviation of the height over a floor: it is a known plane."""


@dataclass(frozen=True)
class PathSweeps:
    """Sweeps on paths, in the order of their knots.

    Attributes
    ----------
    knot : (n,) int ndarray
        Ascending; each sweep is between this knot and the next one.
    weights : (n, 4) ndarray
        Weights of the states at both knots (:meth:`~locatk.core.lighthouse.motion.path.Path.\
hermite_weights`).
    station, plane, photodiode : (n,) int ndarray
    angle : (n,) ndarray
        Observed rotor angle in radians.
    """

    knot: IntArray
    weights: Array
    station: IntArray
    plane: IntArray
    photodiode: IntArray
    angle: Array

    def __len__(self) -> int:
        return len(self.knot)


@dataclass(frozen=True)
class Residuals:
    """Residuals of sweeps with their derivatives.

    Attributes
    ----------
    residual : (n,) ndarray
        Predicted minus observed angle in radians; ``nan`` if no light plane meets the photodiode.
    by_pose : (n, pose size) ndarray
        Derivative by the pose of the device at the time of the sweep.
    by_common, column : (n, m) ndarray
        Derivatives by the common parameters that the sweep depends on, and their indices.
    """

    residual: Array
    by_pose: Array
    by_common: Array
    column: IntArray


def linearize(sweeps: PathSweeps, path: Path, common: CommonParameters) -> Residuals:
    """Predict all sweeps; return residuals and derivatives."""
    position, rotation = path.poses(sweeps.knot, sweeps.weights)
    if rotation is None:
        angle, by_pose, by_common, column = common.predict(sweeps.station, sweeps.plane, position)
        return Residuals(angle - sweeps.angle, by_pose, by_common, column)
    lever = common.levers[sweeps.photodiode]
    diode = position + (rotation @ lever[:, :, None])[..., 0]
    angle, by_position, by_station, column = common.predict(sweeps.station, sweeps.plane, diode)
    bias = common.bias_columns(sweeps.station, sweeps.plane, sweeps.photodiode)
    by_lever = (by_position[:, None] @ rotation)[:, 0]
    return Residuals(
        angle + common.value[bias] - sweeps.angle,
        lever_jacobian(by_position, rotation, lever),
        np.concatenate([by_station, by_lever, np.ones((len(sweeps), 1))], axis=1),
        np.concatenate([column, common.lever_columns(sweeps.photodiode), bias[:, None]], axis=1),
    )


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations at a state, with unit variance after weighting.

    Attributes
    ----------
    states : BlockTridiagonal
        Factorized block of the states.
    gradient : (k, d) ndarray
        By the states.
    coupling : (k, d, m) ndarray
        Between states and common parameters.
    common : (m, m) ndarray
    common_gradient : (m,) ndarray
    gauge : (m, g) ndarray
        Directions of the common parameters that are not estimated.
    """

    states: BlockTridiagonal
    gradient: Array
    coupling: Array
    common: Array
    common_gradient: Array
    gauge: Array

    def step(self) -> tuple[Array, Array]:
        """Return the change of the states (k, d) and of the common parameters (m,)."""
        half = self._half_solved_coupling()
        own = self.states.half_solve(self.gradient).ravel()
        change = -self._common_covariance(half) @ (self.common_gradient - half.T @ own)
        return -self.states.solve(self.gradient + self.coupling @ change), change

    def states_step(self) -> Array:
        """Return the change of the states (k, d) while the common parameters are held."""
        return -self.states.solve(self.gradient)

    def covariances(self) -> tuple[Array, Array]:
        """Return the covariance (m, m) of the common parameters and the states' response to them.

        The response (k, d, m) is the change of the states per change of the common parameters.
        """
        covariance = self._common_covariance(self._half_solved_coupling())
        return covariance, -self.states.solve(self.coupling)

    def _half_solved_coupling(self) -> Array:
        return self.states.half_solve(self.coupling).reshape(-1, self.coupling.shape[2])

    def _common_covariance(self, half: Array) -> Array:
        reduced = self.common - half.T @ half
        basis = _complement(self.gauge)
        inner = basis.T @ reduced @ basis
        # Scaled to unit diagonal: metres, radians and curvatures differ by many orders.
        scale = 1.0 / np.sqrt(np.maximum(np.diagonal(inner), 1e-300))
        inverse = np.linalg.inv(inner * scale[:, None] * scale)
        inverse = (inverse + inverse.T) / 2 * scale[:, None] * scale
        return np.asarray(basis @ inverse @ basis.T)


def _complement(directions: Array) -> Array:
    """Return an orthonormal basis (m, m - g) of what is orthogonal to directions (m, g)."""
    count, size = directions.shape
    if not size:
        return np.eye(count)
    full = np.linalg.qr(np.concatenate([directions, np.eye(count)], axis=1))[0]
    return np.asarray(full[:, size:count])


def assemble(
    sweeps: PathSweeps,
    residuals: Residuals,
    weight: Array,
    path: Path,
    power: Array,
    common: CommonParameters,
    *,
    with_common: bool,
    floor_z: float | None = None,
    inertial: InertialFactors | None = None,
) -> NormalEquations:
    """Return the normal equations.

    Parameters
    ----------
    sweeps : PathSweeps
    residuals : Residuals
    weight : (n,) ndarray
        Inverse variance of each sweep, 0 for rejected ones.
    path : Path
    power : (k - 1, 2) ndarray
        Power of the noise that drives the acceleration: of the position in m^2/s^3, and of the
        rotation in rad^2/s^3.
    common : CommonParameters
    with_common : bool
        False if the common parameters are held: their parts are empty.
    floor_z : float, optional
        Height of all poses.
    inertial : InertialFactors, optional
    """
    k, n = len(path), path.pose_size
    d = 2 * n
    diagonal, above, gradient = prior_equations(path, power)
    if floor_z is not None:
        diagonal[:, 2, 2] += FLOOR_SIGMA_M**-2
        gradient[:, 2] += (path.position[:, 2] - floor_z) * FLOOR_SIGMA_M**-2
    is_used = (weight > 0) & np.isfinite(residuals.residual)
    root = np.sqrt(np.where(is_used, weight, 0.0))
    residual = np.where(is_used, residuals.residual, 0.0) * root
    by_pose = np.where(is_used[:, None], residuals.by_pose, 0.0) * root[:, None]
    jacobian = (sweeps.weights[:, :, None] * by_pose[:, None, :]).reshape(-1, 2 * d)
    index = interval_rows(sweeps.knot, k - 1)
    blocks = np.concatenate([jacobian, np.zeros((1, 2 * d))])[index]
    square = blocks.mT @ blocks
    diagonal[:-1] += square[:, :d, :d]
    diagonal[1:] += square[:, d:, d:]
    above += square[:, :d, d:]
    push = (np.append(residual, 0.0)[index][:, None] @ blocks)[:, 0]
    gradient[:-1] += push[:, :d]
    gradient[1:] += push[:, d:]
    if inertial is not None:
        inertial.add_to_states(path, common, diagonal, above, gradient)
    states = BlockTridiagonal(diagonal, above)
    count = len(common.value)
    if not with_common:
        empty = np.zeros(0)
        return NormalEquations(
            states, gradient, np.zeros((k, d, 0)), np.zeros((0, 0)), empty, np.zeros((0, 0))
        )
    by_common = np.where(is_used[:, None], residuals.by_common, 0.0) * root[:, None]
    coupling, information = couple(sweeps.knot, jacobian, residuals.column, by_common, k, count)
    information += common.information
    push = (by_common * residual[:, None]).ravel()
    common_gradient = common.information @ common.value
    common_gradient += np.bincount(residuals.column.ravel(), push, count)
    if inertial is not None:
        inertial.add_to_common(path, common, coupling, information, common_gradient)
    return NormalEquations(states, gradient, coupling, information, common_gradient, common.gauge)


def couple(
    knot: IntArray, jacobian: Array, column: IntArray, value: Array, knots: int, count: int
) -> tuple[Array, Array]:
    """Sum the products of the derivatives of sweeps.

    Parameters
    ----------
    knot : (n,) int ndarray
        Knot before each sweep.
    jacobian : (n, 2 d) ndarray
        Derivatives by the states at the knot and at the next one.
    column : (n, w) int ndarray
    value : (n, w) ndarray
        Common parameters on which each sweep depends, and its derivatives by them.
    knots, count : int
        Number of knots and of common parameters.

    Returns
    -------
    coupling : (k, d, m) ndarray
        Of states and common parameters.
    information : (m, m) ndarray
        Of the common parameters.
    """
    n, width = value.shape
    d = jacobian.shape[1] // 2
    if kernels is None:
        return couple_numpy(knot, jacobian, column, value, knots, count)
    coupling, information = np.empty((knots, d, count)), np.empty((count, count))
    arrays = (
        np.ascontiguousarray(knot, np.int64),
        np.ascontiguousarray(jacobian),
        np.ascontiguousarray(column, np.int64),
        np.ascontiguousarray(value),
    )
    kernels.couple_sweeps(*arrays, n, knots, d, width, count, coupling, information)
    return coupling, information


def couple_numpy(
    knot: IntArray, jacobian: Array, column: IntArray, value: Array, knots: int, count: int
) -> tuple[Array, Array]:
    """Twin of the kernel of :func:`couple`."""
    n, width = value.shape
    d = jacobian.shape[1] // 2
    rows = np.arange(n + 1)
    shared = csr_array((value.ravel(), column.ravel(), rows * width), (n, count))
    states = (knot * d)[:, None] + np.arange(2 * d)
    own = csr_array((jacobian.ravel(), states.ravel(), rows * 2 * d), (n, knots * d))
    coupling = np.asarray((own.T @ shared).toarray()).reshape(knots, d, count)
    return coupling, np.asarray((shared.T @ shared).toarray())


def prior_equations(path: Path, power: Array) -> tuple[Array, Array, Array]:
    """Return the part of the prior in the equations of the states.

    Returns
    -------
    diagonal, above : (k, d, d) and (k - 1, d, d) ndarray
    gradient : (k, d) ndarray
    """
    k, n = len(path), path.pose_size
    unit = prior_information(path.span_s) * path.is_linked[:, None, None]
    diagonal = np.zeros((k, 2, n, 2, n))
    above = np.zeros((k - 1, 2, n, 2, n))
    # Errors are those of the end in the axes of pose and rate; the start predicts without error.
    error = np.concatenate([np.zeros((k - 1, 2, n)), path.prior_errors()], axis=1)
    gradient = np.zeros((k, 2, n))
    for axis in range(n):
        block = unit / power[:, axis // 3, None, None]
        diagonal[:-1, :, axis, :, axis] += block[:, :2, :2]
        diagonal[1:, :, axis, :, axis] += block[:, 2:, 2:]
        above[:, :, axis, :, axis] += block[:, :2, 2:]
        push = (block @ error[:, :, axis, None])[..., 0]
        gradient[:-1, :, axis] += push[:, :2]
        gradient[1:, :, axis] += push[:, 2:]
        diagonal[:, 0, axis, 0, axis] += MAX_STEP**-2
        weak = WEAK_RATE_SIGMA[axis] ** -2.0
        diagonal[:, 1, axis, 1, axis] += weak
        rate = path.velocity if axis < 3 else path.spin
        assert rate is not None
        gradient[:, 1, axis] += weak * rate[:, axis % 3]
    d = 2 * n
    return diagonal.reshape(k, d, d), above.reshape(k - 1, d, d), gradient.reshape(k, d)


def interval_rows(knot: IntArray, count: int) -> IntArray:
    """Return the rows (count, m) of ascending ``knot`` in each interval, padded with -1."""
    start = np.searchsorted(knot, np.arange(count))
    stop = np.searchsorted(knot, np.arange(count), side="right")
    column = np.arange(int(np.max(stop - start, initial=1)))
    rows = start[:, None] + column
    return np.where(rows < stop[:, None], rows, -1)
