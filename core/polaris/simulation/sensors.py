"""What a bar of MLX90393 makes of a field: offsets, drift, noise, counts, losses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.polaris.array import SensorArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Faults:
    """What is wrong with the sensors, beyond their noise.

    Attributes
    ----------
    offset_t : float
        Standard deviation of a sensor's offset (hard iron) by axis.
    drift_t : float
        Standard deviation by which each axis of each sensor wanders off in a second, as a
        random walk.
    dead, stuck : tuple of int
        Sensors that give nothing, and that give their first sample for ever.
    clipped : bool
        A field beyond the range reads as the range's end instead of nothing.
    """

    offset_t: float = 0.0
    drift_t: float = 0.0
    dead: tuple[int, ...] = ()
    stuck: tuple[int, ...] = ()
    clipped: bool = False


def measure(
    field_t: Array, array: SensorArray, rate_hz: float, faults: Faults, seed: int
) -> tuple[Array, int]:
    """Readings (n, N, 3) of a field (n, N, 3) in the array's axes, tesla.

    ``nan`` where a sensor is dead or saturated. Returned beside them is how many readings
    were saturated. Each matter has random numbers of its own: more noise leaves the
    offsets as they are.
    """
    offsets, walks, noises = (np.random.default_rng([seed, k]) for k in (10, 11, 12))
    read = field_t + offsets.normal(0.0, faults.offset_t, field_t.shape[1:])
    step_t = faults.drift_t / np.sqrt(rate_hz)
    read += np.cumsum(walks.normal(0.0, step_t, field_t.shape), axis=0)
    read += noises.normal(size=field_t.shape) * array.noise_t
    counted = array.quantum_t > 0
    quantum = array.quantum_t[counted]
    read[..., counted] = np.rint(read[..., counted] / quantum) * quantum
    beyond = np.abs(read) > array.range_t
    ends = np.clip(read, -array.range_t, array.range_t) if faults.clipped else np.nan
    read = np.where(beyond, ends, read)
    read[:, list(faults.stuck)] = read[:1, list(faults.stuck)]
    read[:, list(faults.dead)] = np.nan
    return read, int(np.count_nonzero(beyond))


def received(count: int, share: float, seed: int) -> Mask:
    """Which (n,) of the frames arrive where ``share`` of them is lost.

    Exactly that share, rounded, anywhere; the first and the last always arrive.
    """
    kept = np.ones(count, bool)
    inner = np.arange(1, count - 1)
    lost = min(round(share * count), len(inner))
    kept[np.random.default_rng([seed, 13]).choice(inner, lost, replace=False)] = False
    return kept


def motor_field(
    throttle: Array, position_m: Array, strength_t: float, share_per_m: float, seed: int
) -> Array:
    """Field (..., N, 3) in tesla of motors and their wires, in the array's axes.

    It points any one way. Over the bar it grows by ``share_per_m`` of itself a metre
    towards one end; over time it goes with the throttle (...).
    """
    rng = np.random.default_rng([seed, 14])
    way = rng.normal(size=3)
    way *= strength_t / np.linalg.norm(way)
    towards = rng.choice([-1.0, 1.0])
    grown = 1 + towards * share_per_m * position_m[:, 1]
    return np.asarray(throttle)[..., None, None] * grown[:, None] * way
