"""What hall sensors and wheels make of the truth: noise, gains, saturation, drift, slip."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.halls import HallSensors
from locatk.core.landmarks.simulation.options import Errors, Faults

Array = NDArray[np.float64]

TRACK_M = 0.1
"""Between the wheels of the robot."""

SLIP_M = 0.03
"""Way over which a wheel that slips turns too far."""


def gains(sensors: int, errors: Errors, rng: np.random.Generator) -> tuple[Array, Array]:
    """Gains and offsets in tesla (sensors,) of the sensors of one robot."""
    return 1 + rng.normal(0.0, errors.gain, sensors), rng.normal(0.0, errors.offset_t, sensors)


def measure(
    field_t: Array, sensors: HallSensors, errors: Errors, faults: Faults, seed: int
) -> tuple[Array, int]:
    """Readings (n, N) of upright fields (n, N), and how many of them are saturated.

    Each matter has random numbers of its own: more noise leaves the gains as they are.
    """
    gain, offset = gains(len(sensors), errors, np.random.default_rng([seed, 10]))
    noise = np.random.default_rng([seed, 11]).normal(0.0, errors.noise_t, field_t.shape)
    still = np.isin(sensors.names, faults.stuck)
    read = gain * (field_t + errors.earth_t) + offset + noise
    read[:, still] = offset[still]
    read, saturated = digitise(read, sensors.range_t, errors.quantum_t)
    order = list(range(len(sensors)))
    for one, other in faults.swapped:
        a, b = sensors.names.index(one), sensors.names.index(other)
        order[a], order[b] = order[b], order[a]
    read = read[:, order]
    read[:, np.isin(sensors.names, faults.dead)] = np.nan
    return read, saturated


def digitise(read: Array, range_t: float, quantum_t: float) -> tuple[Array, int]:
    """Readings in steps of ``quantum_t`` within the range, and how many were beyond it."""
    if quantum_t > 0:
        read = np.rint(read / quantum_t) * quantum_t
    return np.clip(read, -range_t, range_t), int(np.count_nonzero(np.abs(read) >= range_t))


def odometry_biases(errors: Errors, rng: np.random.Generator) -> Array:
    """Draw the constant errors (3,) of the odometry of one session.

    These are the relative errors of distances, the rotation [rad/m] that is reported on a
    straight line, and the relative error of rotations.
    """
    return rng.normal(size=3) * [
        errors.odometry_scale,
        errors.odometry_drift_rad_per_m,
        errors.odometry_turn,
    ]


def odometry(poses: Array, errors: Errors, rng: np.random.Generator) -> tuple[Array, list[int]]:
    """Poses (n, 3) as the wheels tell them, from (0, 0, 0), and where they slipped.

    Parameters
    ----------
    poses : (n, 3) ndarray
        True x, y and heading (without jumps of a turn), near enough to each other for a
        step to be an arc.
    errors : Errors
    rng : Generator

    Returns
    -------
    (n, 3) ndarray, and the numbers of the poses at which a wheel began to slip.

    Notes
    -----
    Errors are those of Borenstein and Feng (IEEE Trans. Robotics and Automation 12, 869,
    1996): the mean diameter of the wheels (scale), their difference (drift along the way)
    and the track (turns), the same for the whole session; and, beside them, noise of each
    wheel and slip.
    """
    step = np.diff(poses, axis=0)
    half = poses[:-1, 2] + step[:, 2] / 2
    chord = step[:, 0] * np.cos(half) + step[:, 1] * np.sin(half)
    way = chord / np.sinc(step[:, 2] / 2 / np.pi)
    wheels = way[:, None] + step[:, 2:] * [-TRACK_M / 2, TRACK_M / 2]
    scale, drift, turn = odometry_biases(errors, rng)
    told = wheels + errors.wheel_noise_m * np.sqrt(np.abs(wheels)) * rng.normal(size=wheels.shape)
    slips: list[int] = []
    travelled = np.cumsum(np.abs(wheels).mean(axis=1))
    if errors.slips_per_m > 0 and len(travelled):
        count = rng.poisson(errors.slips_per_m * travelled[-1])
        for start in np.sort(rng.uniform(0, travelled[-1], count)):
            wheel = int(rng.integers(2))
            within = (travelled >= start) & (travelled < start + SLIP_M)
            told[within, wheel] += wheels[within, wheel] * errors.slip_m / SLIP_M
            slips.append(int(np.argmax(within)))
    ahead = told.mean(axis=1)
    turned = (told[:, 1] - told[:, 0]) / TRACK_M * (1 + turn) + drift * ahead
    heading = np.r_[0.0, np.cumsum(turned)]
    along = (1 + scale) * ahead * np.sinc(turned / 2 / np.pi)
    middle = heading[:-1] + turned / 2
    return (
        np.column_stack(
            [
                np.r_[0.0, np.cumsum(along * np.cos(middle))],
                np.r_[0.0, np.cumsum(along * np.sin(middle))],
                heading,
            ]
        ),
        slips,
    )
