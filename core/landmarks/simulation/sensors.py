"""Simulated hall sensors and wheels: noise, gains, saturation, odometry with drift and slips."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.halls import HallSensors
from locatk.core.landmarks.simulation.options import Errors, Faults, RandomSource
from locatk.core.simulation import quantize, random_stream

Array = NDArray[np.float64]

TRACK_M = 0.1
"""Distance between the wheels of the robot."""

SLIP_DISTANCE_M = 0.03
"""Distance of the robot over which a slipping wheel rotates too far."""


def gains(sensors: int, errors: Errors, rng: np.random.Generator) -> tuple[Array, Array]:
    """Draw the gains and the offsets in tesla (sensors,) of the sensors of one robot."""
    return 1 + rng.normal(0.0, errors.gain, sensors), rng.normal(0.0, errors.offset_t, sensors)


def measure(
    field_t: Array, sensors: HallSensors, errors: Errors, faults: Faults, seed: int
) -> tuple[Array, int]:
    """Return the readings (n, N) of vertical fields (n, N), and the number of saturated ones."""
    gain, offset = gains(len(sensors), errors, random_stream(seed, RandomSource.GAINS))
    noise = random_stream(seed, RandomSource.NOISE).normal(0.0, errors.noise_t, field_t.shape)
    readings = gain * (field_t + errors.earth_t) + offset + noise
    is_stuck = np.isin(sensors.names, faults.stuck)
    readings[:, is_stuck] = offset[is_stuck]
    readings, saturated = digitise(readings, sensors.range_t, errors.quantum_t)
    order = list(range(len(sensors)))
    for first, second in faults.swapped:
        a, b = sensors.names.index(first), sensors.names.index(second)
        order[a], order[b] = order[b], order[a]
    readings = readings[:, order]
    readings[:, np.isin(sensors.names, faults.dead)] = np.nan
    return readings, saturated


def digitise(readings: Array, range_t: float, quantum_t: float) -> tuple[Array, int]:
    """Quantize readings and clip them to the range; return also the number of clipped ones."""
    readings = quantize(readings, quantum_t)
    saturated = int(np.count_nonzero(np.abs(readings) >= range_t))
    return np.clip(readings, -range_t, range_t), saturated


def odometry(poses: Array, errors: Errors, rng: np.random.Generator) -> tuple[Array, list[int]]:
    """Return the poses (n, 3) of the wheel odometry, from (0, 0, 0), and the slips.

    Parameters
    ----------
    poses : (n, 3) ndarray
        True x, y and unwrapped heading, so close to each other that each step is an arc.
    errors : Errors
    rng : Generator

    Returns
    -------
    (n, 3) ndarray, and the indices of the poses at which a wheel began to slip.

    Notes
    -----
    The errors are those of Borenstein and Feng (IEEE Trans. Robotics and Automation 12, 869,
    1996): the mean diameter of the wheels (scale), its difference (drift along the path) and
    the track (rotations), constant for the whole session; and in addition noise and slips of
    each wheel.
    """
    step = np.diff(poses, axis=0)
    half = poses[:-1, 2] + step[:, 2] / 2
    chord = step[:, 0] * np.cos(half) + step[:, 1] * np.sin(half)
    way = chord / np.sinc(step[:, 2] / 2 / np.pi)
    wheels = way[:, None] + step[:, 2:] * [-TRACK_M / 2, TRACK_M / 2]
    scale, drift, turn = rng.normal(size=3) * [
        errors.odometry_scale,
        errors.odometry_drift_rad_per_m,
        errors.odometry_turn,
    ]
    told = wheels + errors.wheel_noise_m * np.sqrt(np.abs(wheels)) * rng.normal(size=wheels.shape)
    slips: list[int] = []
    travelled = np.cumsum(np.abs(wheels).mean(axis=1))
    if errors.slips_per_m > 0 and len(travelled):
        count = rng.poisson(errors.slips_per_m * travelled[-1])
        for start in np.sort(rng.uniform(0, travelled[-1], count)):
            wheel = int(rng.integers(2))
            within = (travelled >= start) & (travelled < start + SLIP_DISTANCE_M)
            told[within, wheel] += wheels[within, wheel] * errors.slip_m / SLIP_DISTANCE_M
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
