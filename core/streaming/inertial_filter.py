"""Error-state filter of a device in space: fixes connected by an inertial measurement unit.

Nominal position, velocity, orientation and biases of accelerometer and gyroscope, with an error of
15 components whose rotation is in the axes of the device (Sola, Quaternion kinematics for the
error-state Kalman filter, arXiv 1711.02508, chapters 5 and 6). The frame of the fixes has its z
axis up; a small tilt of the frame appears as a bias of the accelerometer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from locatk.core.inertial import STANDARD_GRAVITY_M_S2
from locatk.core.streaming.history import CHI2_999

Array = NDArray[np.float64]

# Components of the state vector, and phases, as in planar_filter.
POSITION, VELOCITY, QUATERNION = slice(0, 3), slice(3, 6), slice(6, 10)
FORCE_BIAS, RATE_BIAS = slice(10, 13), slice(13, 16)
PHASE, REFUSED_IN_A_ROW, ACCEPTED, REFUSED, RESETS, IS_PROVISIONAL = range(16, 22)
UNKNOWN, RUNNING = 0, 2

# Components of a fix: position, quaternion, their covariance (36) with nan for unknown components.
FIX_POSITION, FIX_QUATERNION, FIX_COVARIANCE = slice(0, 3), slice(3, 7), slice(7, 43)
FIX_MAX_REFUSALS, FIX_IS_PROVISIONAL = 43, 44

MAX_SILENCE_S = 0.1
"""Time without samples after which velocity and orientation are unknown [s]: an unknown
acceleration of 2 m/s^2 displaces by 1 cm in it."""

GRAVITY = np.array([0.0, 0.0, -STANDARD_GRAVITY_M_S2])

_IDENTITY = np.eye(15)
_DIAGONAL, _COMPONENT = (np.arange(15), np.arange(15)), np.arange(15) // 3
_POSITION_BY_VELOCITY, _VELOCITY_BY_POSITION = (
    (np.arange(3), np.arange(3, 6)),
    (np.arange(3, 6), np.arange(3)),
)
_ROTATION_BY_BIAS = np.arange(6, 9), np.arange(12, 15)
_POSE = np.ix_([0, 1, 2, 6, 7, 8], [0, 1, 2, 6, 7, 8])


@dataclass(frozen=True)
class InertialNoise:
    """Errors of an inertial measurement unit: standard deviations.

    The defaults hold for the BMI088 (data sheet: noise densities of 0.0017 m/s^2 and 0.00024 rad/s
    per root Hz, biases up to 0.2 m/s^2 and 0.017 rad/s) on a vehicle that vibrates.

    Attributes
    ----------
    force_density, rate_density : float
        Noise in m/s^2 and rad/s per root of a hertz, vibration included.
    force_bias, rate_bias : float
        Initial biases in m/s^2 and rad/s; that of the accelerometer includes a tilt of the frame.
    force_bias_walk, rate_bias_walk : float
        Random walk of the biases in a second.
    velocity_m_s : float
        Speed at the first fix.
    """

    force_density: float = 0.03
    rate_density: float = 5e-4
    force_bias: float = 0.2
    rate_bias: float = 0.02
    force_bias_walk: float = 2e-3
    rate_bias_walk: float = 1e-4
    velocity_m_s: float = 1.0


@dataclass(frozen=True)
class InertialFilter:
    """Equations of the filter, see :class:`.history.FilterModel`."""

    noise: InertialNoise = field(default_factory=InertialNoise)
    state_size: int = 22
    error_size: int = 15
    motion_size: int = 6
    fix_size: int = 45

    def unknown_state(self) -> tuple[Array, Array]:
        """Return state and covariance before any fix."""
        state = np.zeros(self.state_size)
        state[QUATERNION] = 0.0, 0.0, 0.0, 1.0
        noise = self.noise
        sigma = np.repeat([0.0, noise.velocity_m_s, 0.0, noise.force_bias, noise.rate_bias], 3)
        return state, np.diag(sigma**2)

    def part(self, motion: Array, fraction: float) -> Array:
        """Return the motion in a fraction of the duration of ``motion`` (6,): the same rates."""
        return motion

    def propagate(
        self, state: Array, covariance: Array, motion: Array, duration_s: float
    ) -> tuple[Array, Array]:
        """Return state and covariance after a time with constant readings.

        ``motion`` is the specific force in m/s^2 and the angular rate in rad/s in the axes of the
        device; if it is nan (the sensors were silent), only the biases stay known.
        """
        if state[PHASE] == UNKNOWN:
            return state, covariance
        if motion[0] != motion[0]:
            return self._forget_motion(state, covariance)
        noise = self.noise
        force, rate = motion[:3] - state[FORCE_BIAS], motion[3:] - state[RATE_BIAS]
        rotation = _rotation_matrix(state[QUATERNION])
        step = rate * duration_s
        # The mean orientation within the step turns the force into the frame.
        mean_rotation = rotation @ _rotation_matrix(_quaternion(step / 2))
        acceleration = mean_rotation @ force + GRAVITY
        state = state.copy()
        state[POSITION] += state[VELOCITY] * duration_s + acceleration * (duration_s**2 / 2)
        state[VELOCITY] += acceleration * duration_s
        quaternion = _product(state[QUATERNION], _quaternion(step))
        state[QUATERNION] = quaternion / math.sqrt(quaternion @ quaternion)
        transition = _IDENTITY.copy()
        by_rotation = mean_rotation @ _skew(force * -duration_s)
        by_bias = mean_rotation * -duration_s
        transition[3:6, 6:9], transition[3:6, 9:12] = by_rotation, by_bias
        half_s = duration_s / 2
        transition[0:3, 6:9], transition[0:3, 9:12] = by_rotation * half_s, by_bias * half_s
        transition[_POSITION_BY_VELOCITY] = duration_s
        transition[6:9, 6:9] = _rotation_matrix(_quaternion(-step))
        transition[_ROTATION_BY_BIAS] = -duration_s
        covariance = transition @ covariance @ transition.T
        force_variance = noise.force_density**2 * duration_s
        covariance[_DIAGONAL] += np.array(
            [
                force_variance * duration_s**2 / 3,
                force_variance,
                noise.rate_density**2 * duration_s,
                noise.force_bias_walk**2 * duration_s,
                noise.rate_bias_walk**2 * duration_s,
            ]
        )[_COMPONENT]
        coupling = force_variance * half_s
        covariance[_POSITION_BY_VELOCITY] += coupling
        covariance[_VELOCITY_BY_POSITION] += coupling
        return state, covariance

    def update(
        self, state: Array, covariance: Array, fix: Array, interpolation_s2: float
    ) -> tuple[Array, Array]:
        """Return state and covariance after a fix of any components.

        ``fix`` is position, quaternion, their covariance (36,) in the axes of the frame with nan
        for unknown components, the number of refusals in a row after which a fix is taken for
        right (0: at once), and whether the fix is provisional. Only a fix of a whole pose starts
        the filter.
        """
        fix_covariance = fix[FIX_COVARIANCE].reshape(6, 6)
        known = np.isfinite(np.diagonal(fix_covariance)).nonzero()[0]
        state = state.copy()
        if state[PHASE] == RUNNING:
            if fix[FIX_MAX_REFUSALS] > 0:
                updated = self._fuse(state, covariance, fix, fix_covariance, known)
                if updated is not None:
                    return updated
                state[REFUSED] += 1
                state[REFUSED_IN_A_ROW] += 1
            is_final = state[REFUSED_IN_A_ROW] >= fix[FIX_MAX_REFUSALS]
            if not (is_final or state[IS_PROVISIONAL]):
                return state, covariance
            state, covariance = self._forget_motion(state, covariance)
            state[RESETS] += 1
        if len(known) < 6:
            return state, covariance
        state[POSITION], state[VELOCITY] = fix[FIX_POSITION], 0.0
        state[QUATERNION] = fix[FIX_QUATERNION]
        state[PHASE] = RUNNING
        started = self.unknown_state()[1]
        started[9:, 9:] = covariance[9:, 9:]
        to_device = _rotation_matrix(state[QUATERNION]).T
        axes = np.eye(6)
        axes[3:, 3:] = to_device
        started[_POSE] = axes @ fix_covariance @ axes.T
        return _accepted(state, fix), started

    def _forget_motion(self, state: Array, covariance: Array) -> tuple[Array, Array]:
        """Return the state before a fix, with the known biases."""
        unknown, unknown_covariance = self.unknown_state()
        unknown[10:16], unknown[PHASE + 1 :] = state[10:16], state[PHASE + 1 :]
        unknown_covariance[9:, 9:] = covariance[9:, 9:]
        return unknown, unknown_covariance

    def _fuse(
        self,
        state: Array,
        covariance: Array,
        fix: Array,
        fix_covariance: Array,
        known: NDArray[np.intp],
    ) -> tuple[Array, Array] | None:
        """Return the update by a fix, or None if it contradicts the state."""
        rotation = _rotation_matrix(state[QUATERNION])
        conjugate = state[QUATERNION] * [-1.0, -1.0, -1.0, 1.0]
        deviation = _product(fix[FIX_QUATERNION], conjugate)
        residual = np.concatenate(
            [fix[FIX_POSITION] - state[POSITION], _rotation_vector(deviation)]
        )
        rows = np.zeros((6, 15))
        rows[:3, :3], rows[3:, 6:9] = np.eye(3), rotation
        if len(known) < 6:
            rows, residual = rows[known], residual[known]
            fix_covariance = fix_covariance[np.ix_(known, known)]
        cross = covariance @ rows.T
        precision = np.linalg.inv(rows @ cross + fix_covariance)
        if residual @ precision @ residual > CHI2_999[len(known)]:
            return None
        gain = cross @ precision
        correction = gain @ residual
        keep = _IDENTITY - gain @ rows
        covariance = keep @ covariance @ keep.T + gain @ fix_covariance @ gain.T
        reset = _IDENTITY.copy()
        reset[6:9, 6:9] -= _skew(correction[6:9] / 2)
        covariance = reset @ covariance @ reset.T
        state[:6] += correction[:6]
        quaternion = _product(state[QUATERNION], _quaternion(correction[6:9]))
        state[QUATERNION] = quaternion / math.sqrt(quaternion @ quaternion)
        state[10:16] += correction[9:]
        return _accepted(state, fix), (covariance + covariance.T) / 2


def pose_covariance(state: Array, covariance: Array) -> Array:
    """Return the covariance (6, 6) of position and rotation vector in the axes of the frame."""
    axes = np.eye(6)
    axes[3:, 3:] = _rotation_matrix(state[QUATERNION])
    return np.asarray(axes @ covariance[_POSE] @ axes.T)


# Rotations of single vectors and quaternions, in less time than core.geometry takes for arrays.


def _quaternion(rotation_vector: Array) -> Array:
    """Return the quaternion (x, y, z, w) of a rotation vector."""
    x, y, z = rotation_vector.tolist()
    angle = math.sqrt(x * x + y * y + z * z)
    factor = 0.5 if angle < 1e-9 else math.sin(angle / 2) / angle
    return np.array([x * factor, y * factor, z * factor, math.cos(angle / 2)])


def _rotation_vector(quaternion: Array) -> Array:
    """Return the rotation vector, at most pi long, of a quaternion."""
    x, y, z, w = quaternion.tolist()
    length = math.sqrt(x * x + y * y + z * z)
    factor = 2.0 if length < 1e-12 else 2 * math.atan2(length, abs(w)) / length
    return np.asarray((-factor if w < 0 else factor) * quaternion[:3])


def _product(first: Array, second: Array) -> Array:
    """Return the Hamilton product of two quaternions."""
    ax, ay, az, aw = first.tolist()
    bx, by, bz, bw = second.tolist()
    return np.array(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ]
    )


def _rotation_matrix(quaternion: Array) -> Array:
    """Return the rotation matrix of a unit quaternion."""
    x, y, z, w = quaternion.tolist()
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def _skew(vector: Array) -> Array:
    """Return the cross-product matrix of a vector."""
    x, y, z = vector.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _accepted(state: Array, fix: Array) -> Array:
    """Count a fix that was used, in place."""
    state[ACCEPTED] += 1
    state[REFUSED_IN_A_ROW] = 0
    state[IS_PROVISIONAL] = fix[FIX_IS_PROVISIONAL]
    return state
