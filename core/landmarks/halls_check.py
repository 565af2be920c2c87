"""Check of hall sensors before their first recording, from a recording made by hand.

A magnet, north side up, is moved below one sensor after the other, in the order of their names.
Each sensor must respond, the field must point up, and the strongest readings must come in that
order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.landmarks.halls import HallSamples
from locatk.core.landmarks.preprocessing import MAX_OFFSET_T, MIN_NOISE_T
from locatk.core.robust import robust_sigma
from locatk.core.sensor_check import SensorCheck, SensorFault, by_sensor

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MIN_SAMPLES = 50
"""Least number of samples of a check."""

MAX_MISSING_FRACTION = 0.05
"""Fraction of missing readings above which a sensor has a fault."""

MIN_RESPONSE_T, MIN_RESPONSE_SIGMAS = 5e-4, 10.0
"""Change of the field from which a sensor responds to a magnet [T], and the same in standard
deviations of its noise; the larger of the two applies."""

MIN_RESPONSE_FRACTION = 0.25
"""Response relative to the median of the others below which it is weak. The distance of a magnet
that is moved by hand changes it by less."""

PEAK_FRACTION = 0.9
"""Readings above this fraction of the largest one belong to the peak: saturated ones are equal."""

MAX_NOISE_RATIO = 3.0
"""Noise of a sensor relative to the median above which it is a fault."""


@dataclass(frozen=True)
class HallFigures:
    """Figures of one hall sensor.

    Attributes
    ----------
    zero_t : float
        Reading without a magnet [T].
    noise_t : float
        Standard deviation of a reading, at least
        :data:`~locatk.core.landmarks.preprocessing.MIN_NOISE_T` [T].
    response_t : float
        Strongest change of the reading while the magnet passes, with its sign [T].
    response_s : float
        Middle of the time in which the change is first near its strongest, since the first
        sample [s].
    """

    zero_t: float
    noise_t: float
    response_t: float
    response_s: float


def check_halls(samples: HallSamples) -> SensorCheck[HallFigures]:
    """Check a recording in which a magnet was moved below one sensor after the other.

    Parameters
    ----------
    samples : HallSamples
        Only the names of the sensors are used, not their positions.

    Raises
    ------
    InputError
        There are fewer than :data:`MIN_SAMPLES` samples.
    """
    if len(samples) < MIN_SAMPLES:
        raise InputError(
            f"{len(samples)} samples of {samples.device}; the check needs at least {MIN_SAMPLES}",
            hint="Record for longer, and move a magnet below the sensors",
        )
    names = samples.sensors.names
    figures = tuple(
        _measure(samples.time_ns, samples.field_t[:, sensor]) for sensor in range(len(names))
    )
    faults = []
    is_dead = np.zeros(len(names), bool)
    for sensor in range(len(names)):
        fault = _dead_sensor(sensor, samples.field_t[:, sensor])
        if fault is not None:
            faults.append(fault)
            is_dead[sensor] = fault.code != "readings_missing"
    faults += _level_faults(figures, is_dead)
    responds = np.array([_responds(each) for each in figures]) & ~is_dead
    untested = []
    if responds.any():
        faults += _response_faults(figures, responds, is_dead)
        faults += _order_faults(figures, responds, names)
    elif not is_dead.all():
        untested.append(
            "order, sign and gain: move a magnet, north side up, below each sensor in turn"
        )
    return SensorCheck(figures, by_sensor(faults), tuple(untested))


def _measure(time_ns: NDArray[np.int64], field_t: Array) -> HallFigures:
    """Return the figures of a sensor from its readings (n,)."""
    is_valid = np.isfinite(field_t)
    if not is_valid.any():
        unknown = float("nan")
        return HallFigures(unknown, unknown, unknown, unknown)
    valid = field_t[is_valid]
    zero = float(np.median(valid))
    # The difference of two readings has twice the variance of one.
    noise = max(robust_sigma(np.diff(valid)) / np.sqrt(2), MIN_NOISE_T)
    change = np.where(is_valid, field_t - zero, 0.0)
    is_peak = np.abs(change) >= PEAK_FRACTION * np.abs(change).max()
    # The magnet may pass again on its way back.
    first = int(np.argmax(is_peak))
    last = first + int(np.argmin(np.append(is_peak[first:], False)))
    strongest = int(np.argmax(np.abs(change)))
    elapsed_s = (time_ns - time_ns[0]) * 1e-9
    return HallFigures(
        zero, noise, float(change[strongest]), float(np.median(elapsed_s[first:last]))
    )


def _dead_sensor(sensor: int, field_t: Array) -> SensorFault | None:
    """Return the fault of a sensor of which readings (n,) are missing or never change."""
    valid = field_t[np.isfinite(field_t)]
    if not len(valid):
        return SensorFault(sensor, "no_readings", "no readings: check its wiring")
    if (valid == valid[0]).all():
        return SensorFault(sensor, "constant", "all its readings are the same")
    missing = 1 - len(valid) / len(field_t)
    if missing > MAX_MISSING_FRACTION:
        message = f"{100 * missing:.0f} % of its readings are missing"
        return SensorFault(sensor, "readings_missing", message)
    return None


def _responds(figures: HallFigures) -> bool:
    return abs(figures.response_t) > max(MIN_RESPONSE_T, MIN_RESPONSE_SIGMAS * figures.noise_t)


def _level_faults(figures: tuple[HallFigures, ...], is_dead: Mask) -> list[SensorFault]:
    """Return the sensors with a wrong zero level or too much noise."""
    faults = []
    noise_t = np.array([each.noise_t for each in figures])
    working = np.flatnonzero(~is_dead)
    for sensor in working:
        zero_t = figures[sensor].zero_t
        if abs(zero_t) > MAX_OFFSET_T:
            message = f"reads {1e3 * zero_t:.2f} mT without a magnet: correct its zero level"
            faults.append(SensorFault(int(sensor), "zero_level", message))
        ratio = noise_t[sensor] / np.median(noise_t[working])
        if len(working) > 2 and ratio > MAX_NOISE_RATIO:
            message = f"{ratio:.1f} times the noise of the others"
            faults.append(SensorFault(int(sensor), "noisy", message))
    return faults


def _response_faults(
    figures: tuple[HallFigures, ...], responds: Mask, is_dead: Mask
) -> list[SensorFault]:
    """Return the sensors with a missing, weak or inverted response."""
    faults = []
    response_t = np.array([each.response_t for each in figures])
    typical_t = np.median(np.abs(response_t[responds]))
    is_inverted = response_t < 0
    are_most_inverted = 2 * np.count_nonzero(is_inverted & responds) > np.count_nonzero(responds)
    for sensor in np.flatnonzero(~is_dead):
        fraction = abs(response_t[sensor]) / typical_t
        if not responds[sensor]:
            faults.append(SensorFault(int(sensor), "no_response", "does not respond to the magnet"))
            continue
        if fraction < MIN_RESPONSE_FRACTION:
            message = f"{fraction:.2f} times the response of the others: check its gain"
            faults.append(SensorFault(int(sensor), "weak", message))
        if is_inverted[sensor] != are_most_inverted:
            message = "inverted: its response has another sign than that of most others"
            faults.append(SensorFault(int(sensor), "inverted", message))
    if are_most_inverted:
        message = (
            "the field points down in most of them: the north side of the magnet was down, or they "
            "are inverted"
        )
        faults.append(SensorFault(None, "inverted", message))
    return faults


def _order_faults(
    figures: tuple[HallFigures, ...], responds: Mask, names: tuple[str, ...]
) -> list[SensorFault]:
    """Return a fault if the sensors respond in another order than that of their names."""
    sensors = np.flatnonzero(responds)
    order = sensors[np.argsort([figures[sensor].response_s for sensor in sensors])]
    if (order == sensors).all():
        return []
    sequence = ", ".join(names[sensor] for sensor in order)
    message = f"the magnet passed them in the order {sequence}"
    moved = [names[sensor] for sensor in sensors[order != sensors]]
    if len(moved) == 2:
        message += f": {moved[0]} and {moved[1]} are exchanged"
    return [SensorFault(None, "order", message)]
