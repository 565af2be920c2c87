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

from locatk.core.geometry import (
    matrix_from_quaternion,
    quaternion_multiply,
    rotation_exp,
    rotation_vector_from_quaternion,
    skew,
)
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
        rotation = matrix_from_quaternion(state[QUATERNION])
        step = rate * duration_s
        # The mean orientation within the step turns the force into the frame.
        mean_rotation = rotation @ rotation_exp(step / 2)
        acceleration = mean_rotation @ force + GRAVITY
        state = state.copy()
        state[POSITION] += state[VELOCITY] * duration_s + acceleration * (duration_s**2 / 2)
        state[VELOCITY] += acceleration * duration_s
        quaternion = quaternion_multiply(state[QUATERNION], _quaternion(step))
        state[QUATERNION] = quaternion / math.sqrt(quaternion @ quaternion)
        transition = _IDENTITY.copy()
        transition[0:3, 3:6] = np.eye(3) * duration_s
        by_rotation = -mean_rotation @ skew(force) * duration_s
        transition[3:6, 6:9], transition[3:6, 9:12] = by_rotation, -mean_rotation * duration_s
        transition[0:3, 6:12] = transition[3:6, 6:12] * (duration_s / 2)
        transition[6:9, 6:9] = rotation_exp(-step)
        transition[6:9, 12:15] = -np.eye(3) * duration_s
        covariance = transition @ covariance @ transition.T
        force_variance = noise.force_density**2 * duration_s
        variance = np.repeat(
            [
                force_variance * duration_s**2 / 3,
                force_variance,
                noise.rate_density**2 * duration_s,
                noise.force_bias_walk**2 * duration_s,
                noise.rate_bias_walk**2 * duration_s,
            ],
            3,
        )
        covariance[range(15), range(15)] += variance
        coupling = force_variance * duration_s / 2
        covariance[range(3), range(3, 6)] += coupling
        covariance[range(3, 6), range(3)] += coupling
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
        known = np.flatnonzero(np.isfinite(np.diagonal(fix_covariance)))
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
        to_device = matrix_from_quaternion(state[QUATERNION]).T
        pose = np.r_[0:3, 6:9]
        axes = np.eye(6)
        axes[3:, 3:] = to_device
        started[pose[:, None], pose] = axes @ fix_covariance @ axes.T
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
        rotation = matrix_from_quaternion(state[QUATERNION])
        conjugate = state[QUATERNION] * [-1.0, -1.0, -1.0, 1.0]
        deviation = quaternion_multiply(fix[FIX_QUATERNION], conjugate)
        residual = np.r_[
            fix[FIX_POSITION] - state[POSITION], rotation_vector_from_quaternion(deviation)
        ]
        rows = np.zeros((6, 15))
        rows[:3, :3], rows[3:, 6:9] = np.eye(3), rotation
        if len(known) < 6:
            rows, residual = rows[known], residual[known]
            fix_covariance = fix_covariance[np.ix_(known, known)]
        cross = covariance @ rows.T
        innovation = rows @ cross + fix_covariance
        gain = np.linalg.solve(innovation, cross.T).T
        if residual @ np.linalg.solve(innovation, residual) > CHI2_999[len(known)]:
            return None
        correction = gain @ residual
        keep = _IDENTITY - gain @ rows
        covariance = keep @ covariance @ keep.T + gain @ fix_covariance @ gain.T
        reset = _IDENTITY.copy()
        reset[6:9, 6:9] -= skew(correction[6:9] / 2)
        covariance = reset @ covariance @ reset.T
        state[:6] += correction[:6]
        quaternion = quaternion_multiply(state[QUATERNION], _quaternion(correction[6:9]))
        state[QUATERNION] = quaternion / math.sqrt(quaternion @ quaternion)
        state[10:16] += correction[9:]
        return _accepted(state, fix), (covariance + covariance.T) / 2


def pose_covariance(state: Array, covariance: Array) -> Array:
    """Return the covariance (6, 6) of position and rotation vector in the axes of the frame."""
    axes = np.eye(6)
    axes[3:, 3:] = matrix_from_quaternion(state[QUATERNION])
    pose = np.r_[0:3, 6:9]
    return np.asarray(axes @ covariance[np.ix_(pose, pose)] @ axes.T)


def _quaternion(rotation_vector: Array) -> Array:
    """Return the quaternion (x, y, z, w) of a rotation vector."""
    angle = math.sqrt(rotation_vector @ rotation_vector)
    factor = 0.5 if angle < 1e-9 else math.sin(angle / 2) / angle
    return np.append(rotation_vector * factor, math.cos(angle / 2))


def _accepted(state: Array, fix: Array) -> Array:
    """Count a fix that was used, in place."""
    state[ACCEPTED] += 1
    state[REFUSED_IN_A_ROW] = 0
    state[IS_PROVISIONAL] = fix[FIX_IS_PROVISIONAL]
    return state
