"""Simulated inertial measurement unit of a quadrotor."""

from __future__ import annotations

import numpy as np

from locatk.core.geometry import (
    quaternion_inverse,
    quaternion_multiply,
    quaternion_rotate,
    rotation_vector_from_quaternion,
)
from locatk.core.inertial import STANDARD_GRAVITY_M_S2, InertialSamples
from locatk.core.lighthouse.simulation.paths import STEP_S, FlownPath
from locatk.core.simulation import stamps_ns

RATE_BIAS_RADPS, RATE_NOISE_RADPS = 0.01, 0.003
"""Standard deviations of the bias of a gyroscope along an axis, and of its noise [rad/s]. The
BMI088 of a Crazyflie 2.1 has biases up to 0.017 and a noise of 0.0024 at 100 Hz (data sheet)."""

FORCE_BIAS_MPS2, FORCE_NOISE_MPS2, VIBRATION_MPS2 = 0.1, 0.03, 0.3
"""Standard deviations of the bias of an accelerometer along an axis, of its noise, and of the
vibration of running rotors [m/s^2] (BMI088: biases up to 0.2, a noise of 0.02 at 100 Hz)."""


def measure_inertia(
    rng: np.random.Generator, device: str, path: FlownPath, duration_s: float, rate_hz: float
) -> InertialSamples:
    """Return the samples of an inertial measurement unit on a flight."""
    time_s = np.arange(int(duration_s * rate_hz)) / rate_hz
    shape = (len(time_s), 3)
    orientation = quaternion_inverse(path.quaternion(time_s))
    force = path.acceleration(time_s) + [0.0, 0.0, STANDARD_GRAVITY_M_S2]
    before, after = path.quaternion(time_s - STEP_S), path.quaternion(time_s + STEP_S)
    turn = quaternion_multiply(quaternion_inverse(before), after)
    is_flying = (time_s > path.flying_s[0]) & (time_s < path.flying_s[1])
    noise_mps2 = np.where(is_flying, np.hypot(FORCE_NOISE_MPS2, VIBRATION_MPS2), FORCE_NOISE_MPS2)
    acceleration = (
        quaternion_rotate(orientation, force)
        + rng.normal(0.0, FORCE_BIAS_MPS2, 3)
        + noise_mps2[:, None] * rng.normal(size=shape)
    )
    rate = (
        rotation_vector_from_quaternion(turn) / (2 * STEP_S)
        + rng.normal(0.0, RATE_BIAS_RADPS, 3)
        + rng.normal(0.0, RATE_NOISE_RADPS, shape)
    )
    return InertialSamples(device, stamps_ns(time_s), acceleration, rate)
