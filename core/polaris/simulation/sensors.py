"""Simulated bar of MLX90393: offsets, drift, noise, quantization, saturation, losses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.polaris.array import SensorArray
from locatk.core.polaris.simulation.options import RandomSource
from locatk.core.simulation import quantize, random_stream

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class SensorFaults:
    """Errors and faults of the sensors, except their noise.

    Attributes
    ----------
    offset_t : float
        Standard deviation of the offset of a sensor (hard iron) by axis.
    drift_t : float
        Standard deviation of the drift of an axis in a second, a random walk.
    dead, stuck : tuple of int
        Sensors that give nothing, and that repeat their first sample.
    clipped : bool
        True if a reading beyond the range is the end of the range instead of ``nan``.
    """

    offset_t: float = 0.0
    drift_t: float = 0.0
    dead: tuple[int, ...] = ()
    stuck: tuple[int, ...] = ()
    clipped: bool = False


def measure(
    field_t: Array, array: SensorArray, rate_hz: float, faults: SensorFaults, seed: int
) -> tuple[Array, int]:
    """Return the readings (n, N, 3) of a field (n, N, 3), and the number of saturated ones.

    Both are in the axes of the array, in tesla. Readings of dead and of saturated sensors are
    ``nan``.
    """
    offsets = random_stream(seed, RandomSource.OFFSETS)
    drifts = random_stream(seed, RandomSource.DRIFT)
    noises = random_stream(seed, RandomSource.NOISE)
    readings = field_t + offsets.normal(0.0, faults.offset_t, field_t.shape[1:])
    step_t = faults.drift_t / np.sqrt(rate_hz)
    readings += np.cumsum(drifts.normal(0.0, step_t, field_t.shape), axis=0)
    readings += noises.normal(size=field_t.shape) * array.noise_t
    readings = quantize(readings, array.quantum_t)
    is_saturated = np.abs(readings) > array.range_t
    limits = np.clip(readings, -array.range_t, array.range_t) if faults.clipped else np.nan
    readings = np.where(is_saturated, limits, readings)
    readings[:, list(faults.stuck)] = readings[:1, list(faults.stuck)]
    readings[:, list(faults.dead)] = np.nan
    return readings, int(np.count_nonzero(is_saturated))


def received_frames(count: int, lost_fraction: float, seed: int) -> Mask:
    """Return a mask (n,) of the frames that arrive.

    Exactly the rounded fraction is lost, at random; the first and the last frame always arrive.
    """
    is_received = np.ones(count, bool)
    inner = np.arange(1, count - 1)
    lost = min(round(lost_fraction * count), len(inner))
    rng = random_stream(seed, RandomSource.LOSSES)
    is_received[rng.choice(inner, lost, replace=False)] = False
    return is_received


def motor_field(
    throttle: Array, position_m: Array, strength_t: float, gradient_per_m: float, seed: int
) -> Array:
    """Return the field (..., N, 3) in tesla of motors and their wires, in the axes of the array.

    Its direction is random. It grows by the fraction ``gradient_per_m`` per metre towards one end
    of the array, and is proportional to the throttle (...).
    """
    rng = random_stream(seed, RandomSource.MOTORS)
    direction = rng.normal(size=3)
    direction *= strength_t / np.linalg.norm(direction)
    end = rng.choice([-1.0, 1.0])
    growth = 1 + end * gradient_per_m * position_m[:, 1]
    return np.asarray(throttle)[..., None, None] * growth[:, None] * direction
