"""Check of a magnetometer array before its first recording, from a recording made by hand.

The array is turned in the Earth's field, which is the same at all its sensors. Each sensor
:math:`i` then measures the field :math:`u` that most of the others agree on as

.. math:: b_i = M_i u + c_i

with an offset :math:`c_i`. A correct sensor has :math:`M_i = I`. The signed permutation that is
closest to :math:`M_i` tells exchanged and inverted axes, and the size of its elements the gain.
Afterwards a magnet is held to the first sensor, which tells whether the order of the sensors is
right.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.polaris.array import Samples
from locatk.core.polaris.preprocessing import estimate_noise
from locatk.core.sensor_check import SensorCheck, SensorFault, by_sensor

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MIN_SAMPLES = 50
"""Least number of samples of a check."""

MAX_MISSING_FRACTION = 0.05
"""Fraction of missing or saturated readings above which a sensor has a fault."""

MAX_EXCLUDED_FRACTION = 0.5
"""Fraction of missing or saturated readings above which a sensor is not compared with others."""

MAGNET_QUANTILE, MIN_MAGNET_RATIO = 0.75, 4.0
"""A magnet is near if a reading is further from the median of its sensor than this multiple of that
quantile of the distances. Rotations in a uniform field reach 2 or 3."""

MIN_MAGNET_T = 1.75e-4
"""Least distance of a reading near a magnet from the median of its sensor [T]: more than twice the
strongest field on Earth."""

MIN_TURN_SIGMAS, MIN_TURN_T = 10.0, 5e-6
"""Least standard deviation of the field along the axis that changes most, in standard deviations of
the noise and in tesla (a quarter of the weakest field on Earth), of an array that was turned."""

MIN_TURN_FRACTION = 0.2
"""Standard deviation of the field along an axis, relative to that of the axis that changes most,
below which the gain along it is unknown."""

MIN_AXIS_GAIN = 0.05
"""Gain of an axis, relative to the median of all, below which it does not work."""

MIN_CORRELATION = 0.9
"""Mean correlation of the axes of two sensors from which they agree."""

MAX_GAIN_DEVIATION = 0.15
"""Relative deviation of a gain from the median above which it is a fault. Sensors of a type agree
within a few percent; settings differ by 20 % or more (MLX90393 data sheet, table 17)."""

MAGNET_MARGIN_S = 1.0
"""Time before and after a magnet is near during which its field may disturb the comparison [s]."""

MAX_MAGNET_PAUSE_S = 0.5
"""Longest time between two samples near a magnet that belong to the same approach [s]."""

MAX_TILT_RAD = np.deg2rad(10.0)
"""Rotation of a sensor, beyond exchanged axes, above which it is a fault: chips are soldered to a
few degrees."""

MAX_NOISE_RATIO = 3.0
"""Noise of a sensor relative to the median above which it is a fault."""

EARTH_FIELD_T = (22e-6, 67e-6)
"""Smallest and largest field at the Earth's surface [T] (IGRF-13, doi:10.1186/s40623-020-01288-x).
"""

MAX_FIELD_DEVIATION = 0.3
"""Relative distance from that range which is still plausible: iron nearby, tolerances."""

MAX_DISTURBANCE = 0.2
"""Difference of the sensors' fields, relative to the turning field, above which the place is
disturbed by iron or magnets."""


@dataclass(frozen=True)
class MagnetometerFigures:
    """Figures of one magnetometer.

    Attributes
    ----------
    gain : float
        Relative to the median of all sensors; ``nan`` if the array was not turned.
    offset_t : float
        Magnitude of the offset [T]; ``nan`` if it is unknown.
    noise_t : float
        Largest standard deviation of the noise of its axes [T].
    axes : tuple of int
        Axis of the array (1, 2, 3 for x, y, z) that each axis of the sensor measures, negative if
        it is inverted, 0 if unknown; empty if none is known.
    """

    gain: float
    offset_t: float
    noise_t: float
    axes: tuple[int, ...]


@dataclass(frozen=True)
class ArrayCheck(SensorCheck[MagnetometerFigures]):
    """Result of the check of an array.

    Attributes
    ----------
    field_t : float
        Magnitude of the turning field [T]; ``nan`` if unknown.
    """

    field_t: float


def check_array(samples: Samples) -> ArrayCheck:
    """Check a recording of an array that was turned by hand.

    Parameters
    ----------
    samples : Samples
        The positions of the array's sensors are not used.

    Raises
    ------
    InputError
        There are fewer than :data:`MIN_SAMPLES` samples, in total or without a magnet nearby.
    """
    field_t = samples.field_t
    n, count, _ = field_t.shape
    if n < MIN_SAMPLES:
        raise InputError(
            f"{n} samples of {samples.device}; the check needs at least {MIN_SAMPLES}",
            hint="Record for longer, and turn the array",
        )
    noise_t = estimate_noise(samples)
    faults = _dead_sensors(field_t)
    is_dead = np.zeros(count, bool)
    is_dead[[fault.sensor for fault in faults if fault.sensor is not None]] = True
    deviation_t, is_near, is_undisturbed = _magnet_samples(samples)
    if np.count_nonzero(is_undisturbed) < MIN_SAMPLES:
        raise InputError(
            f"a magnet or iron moves near {samples.device} during nearly the whole recording",
            hint="Turn the array away from magnets for most of the time",
        )
    # A magnet may saturate the sensor to which it is held.
    missing = 1 - np.isfinite(field_t[is_undisturbed]).all(axis=2).mean(axis=0)
    faults += _missing_readings(missing, ~is_dead)
    is_excluded = is_dead | (missing > MAX_EXCLUDED_FRACTION)
    untested: list[str] = []
    if is_excluded.all():
        untested.append("axes, gains and order: no sensor has enough readings")
        figures = _figures(noise_t, is_excluded)
        return ArrayCheck(figures, by_sensor(faults), tuple(untested), float("nan"))
    turned = field_t[is_undisturbed]
    turned = turned[np.isfinite(turned[:, ~is_excluded]).all(axis=(1, 2))]
    turn = None
    if len(turned) < MIN_SAMPLES:
        untested.append("axes and gains: too few samples have the readings of all sensors")
    elif not _is_turned(turned[:, ~is_excluded].std(axis=0), noise_t[~is_excluded]):
        untested.append("axes and gains: the array was not turned; turn it about all its axes")
    else:
        turn = _compare(turned, is_excluded)
        faults += turn.faults
        untested += turn.untested
    approach = _first_approach(samples.time_ns, is_near)
    if count > 1 and is_excluded[0]:
        untested.append("order of the sensors: sensor 1 has no readings")
    elif count > 1 and not len(approach):
        untested.append(
            "order of the sensors: no magnet was held to sensor 1 after the array was turned"
        )
    elif count > 1:
        is_incomplete = missing > MAX_MISSING_FRACTION
        faults += _order_faults(deviation_t[approach], is_incomplete, is_excluded)
    gain = np.ones(count) if turn is None else np.nan_to_num(turn.gain, nan=1.0)
    faults += _noisy_sensors(noise_t / np.maximum(gain, MIN_AXIS_GAIN)[:, None], ~is_excluded)
    figures = _figures(noise_t, is_excluded, turn)
    field = float("nan") if turn is None else turn.magnitude_t
    return ArrayCheck(figures, by_sensor(faults), tuple(untested), field)


@dataclass(frozen=True)
class _Comparison:
    """Comparison of the sensors of a turned array.

    Attributes
    ----------
    gain, offset_t : (N,) ndarray
    axes : list of tuple of int
    magnitude_t : float
    faults : list of SensorFault
    untested : list of str
    """

    gain: Array
    offset_t: Array
    axes: list[tuple[int, ...]]
    magnitude_t: float
    faults: list[SensorFault]
    untested: list[str]


def _dead_sensors(field_t: Array) -> list[SensorFault]:
    """Return the sensors without readings, or with the same in all samples."""
    faults = []
    for sensor in range(field_t.shape[1]):
        readings = field_t[:, sensor]
        valid = readings[np.isfinite(readings).all(axis=1)]
        if not len(valid):
            faults.append(SensorFault(sensor, "no_readings", "no readings: check its wiring"))
        elif (valid == valid[0]).all():
            faults.append(SensorFault(sensor, "constant", "all its readings are the same"))
    return faults


def _missing_readings(fraction: Array, is_working: Mask) -> list[SensorFault]:
    """Return the sensors of which a large fraction (N,) of readings is missing or saturated."""
    return [
        SensorFault(
            int(sensor),
            "readings_missing",
            f"{100 * fraction[sensor]:.0f} % of its readings are missing or saturated",
        )
        for sensor in np.flatnonzero((fraction > MAX_MISSING_FRACTION) & is_working)
    ]


def _noisy_sensors(noise_t: Array, is_working: Mask) -> list[SensorFault]:
    """Return the sensors whose noise (N, 3), by their gain, is much larger than that of others."""
    if is_working.sum() < 3:
        return []
    ratio = (noise_t / np.median(noise_t[is_working], axis=0)).max(axis=1)
    return [
        SensorFault(int(sensor), "noisy", f"{ratio[sensor]:.1f} times the noise of the others")
        for sensor in np.flatnonzero((ratio > MAX_NOISE_RATIO) & is_working)
    ]


def _magnet_samples(samples: Samples) -> tuple[Array, Mask, Mask]:
    """Find the samples near a magnet.

    Returns
    -------
    deviation_t : (n, N) ndarray
        Distance of the readings from the median of their sensor [T].
    is_near, is_undisturbed : (n,) bool ndarray
        A magnet is near; no magnet is near for :data:`MAGNET_MARGIN_S` before and after.
    """
    field_t = samples.field_t
    with np.errstate(invalid="ignore"):
        deviation_t = np.linalg.norm(field_t - _nanmedian(field_t)[None], axis=2)
        is_absent = np.isnan(deviation_t).all(axis=0)
        usual_t = np.nanquantile(np.where(is_absent, 0.0, deviation_t), MAGNET_QUANTILE, axis=0)
        limit_t = np.maximum(MIN_MAGNET_RATIO * usual_t, MIN_MAGNET_T)
        is_near = np.asarray((deviation_t > limit_t).any(axis=1))
    near_ns = samples.time_ns[is_near]
    margin_ns = round(MAGNET_MARGIN_S * 1e9)
    first = np.searchsorted(near_ns, samples.time_ns - margin_ns)
    last = np.searchsorted(near_ns, samples.time_ns + margin_ns, side="right")
    return deviation_t, is_near, first == last


def _nanmedian(values: Array) -> Array:
    """Return the median over the first axis, and 0 if there is no finite value."""
    is_absent = np.isnan(values).all(axis=0)
    return np.asarray(np.nanmedian(np.where(is_absent, 0.0, values), axis=0))


def _is_turned(spread_t: Array, noise_t: Array) -> bool:
    """Return whether the field changed by more than noise, and as the Earth's field may."""
    typical = np.median(spread_t, axis=0)
    return bool(typical.max() > max(MIN_TURN_SIGMAS * np.median(noise_t), MIN_TURN_T))


def _compare(turned_t: Array, is_excluded: Mask) -> _Comparison:
    """Compare the sensors of a turned array with the field that most of them agree on.

    The samples (n, N, 3) are complete, except for excluded sensors. Two sensors that agree are not
    averaged, which would halve their difference.
    """
    medians = _nanmedian(turned_t)
    centred = turned_t - medians
    working = np.flatnonzero(~is_excluded)
    best, agreeing = _largest_agreement(centred, working)
    is_averaged = len(agreeing) > 2
    reference = np.median(centred[:, agreeing], axis=1) if is_averaged else centred[:, best]
    reference_spread = reference.std(axis=0)
    is_observed = reference_spread > MIN_TURN_FRACTION * reference_spread.max()
    count = turned_t.shape[1]
    gain, offset = np.full(count, np.nan), np.full(count, np.nan)
    axes: list[tuple[int, ...]] = [()] * count
    faults, untested = [], []
    matrices = {int(i): _linear_map(centred[:, i], reference, is_observed) for i in working}
    permutations = {i: _signed_permutation(matrix) for i, matrix in matrices.items()}
    axis_gains = {i: _axis_gains(matrix, is_observed) for i, matrix in matrices.items()}
    # The median of two gains is in the middle of them.
    median_gain = np.nanmedian(list(axis_gains.values())) if len(working) > 2 else 1.0
    rms = np.sqrt(np.mean(np.sum(reference**2, axis=1)))
    disturbances = []
    for i, matrix in matrices.items():
        gains = axis_gains[i] / median_gain
        gain[i] = np.nanmedian(gains)
        axes[i] = permutations[i]
        faults += _axis_faults(i, matrix, permutations[i], gains, is_observed)
        residual = centred[:, i] - reference @ matrix.T
        disturbances.append(np.sqrt(np.mean(np.sum(residual**2, axis=1))) / rms)
    is_majority = 2 * len(agreeing) > len(working) and len(working) != 2
    if faults and len(working) > 1 and not is_majority:
        untested.append(
            "which sensors are right: they were compared with "
            f"sensor {best + 1}, and no more than half of them agree"
        )
    if np.median(disturbances) > MAX_DISTURBANCE:
        message = (
            f"their fields differ by {100 * np.median(disturbances):.0f} % while the array is "
            "turned: move away from iron and magnets"
        )
        faults.append(SensorFault(None, "disturbed", message))
    magnitude = float("nan")
    if is_observed.all():
        centre, magnitude = _fit_sphere(reference)
        offset[working] = [np.linalg.norm(medians[i] + matrices[int(i)] @ centre) for i in working]
        faults += _field_fault(magnitude)
    else:
        names = " and ".join("xyz"[axis] for axis in np.flatnonzero(~is_observed))
        untested.append(
            f"gain and sign along {names}, and the units: the field hardly changed along {names}; "
            "turn the array about all its axes"
        )
    untested.append("errors that all sensors share, such as an axis that is inverted in all")
    return _Comparison(gain, offset, axes, magnitude, faults, untested)


def _largest_agreement(centred: Array, working: NDArray[np.int64]) -> tuple[int, NDArray[np.int64]]:
    """Return the sensor that agrees with most others, and all that agree with it."""
    scaled = centred[:, working]
    norm = np.sqrt(np.einsum("tia,tia->i", scaled, scaled))
    correlation = np.einsum("tia,tja->ij", scaled, scaled) / np.maximum(
        norm[:, None] * norm, np.finfo(float).tiny
    )
    agrees = correlation > MIN_CORRELATION
    best = int(np.argmax(agrees.sum(axis=1)))
    return int(working[best]), np.asarray(working[agrees[best]])


def _linear_map(centred: Array, reference: Array, is_observed: Mask) -> Array:
    """Return the matrix (3, 3) that converts the reference (n, 3) to the readings (n, 3).

    Columns of axes that were not observed are zero.
    """
    matrix = np.zeros((3, 3))
    columns = reference[:, is_observed] - reference[:, is_observed].mean(axis=0)
    solution, *_ = np.linalg.lstsq(columns, centred - centred.mean(axis=0), rcond=None)
    matrix[:, is_observed] = solution.T
    return matrix


def _signed_permutation(matrix: Array) -> tuple[int, ...]:
    """Return the axis (1, 2, 3) that each row measures, negative if inverted, 0 if unknown."""
    size = np.abs(matrix)
    size[size < MIN_AXIS_GAIN * size.max()] = 0.0
    best = max(
        itertools.permutations(range(3)),
        # Rows without a signal keep their own axis.
        key=lambda order: (float(size[range(3), order].sum()), order == (0, 1, 2)),
    )
    return tuple(
        int(np.sign(matrix[row, axis])) * (axis + 1) if size[row, axis] else 0
        for row, axis in enumerate(best)
    )


def _axis_gains(matrix: Array, is_observed: Mask) -> Array:
    """Return the gain (3,) of each axis of a sensor; ``nan`` for those that were not observed."""
    gains = np.linalg.norm(matrix, axis=1)
    if is_observed.all():
        return np.asarray(gains)
    # The axes without a signal may be those that were not observed.
    return np.where(gains < MIN_AXIS_GAIN * gains.max(), np.nan, gains)


def _axis_faults(
    sensor: int,
    matrix: Array,
    permutation: tuple[int, ...],
    gains: Array,
    is_observed: Mask,
) -> list[SensorFault]:
    """Return the faults of a sensor's axes and gains."""
    faults = []
    is_weak = gains < MIN_AXIS_GAIN
    for axis in np.flatnonzero(is_weak):
        message = f"its {'xyz'[axis]} axis does not change with the field"
        faults.append(SensorFault(sensor, "axis_dead", message))
    if is_weak.any():
        return faults
    if any(axis not in (0, row + 1) for row, axis in enumerate(permutation)):
        faults.append(SensorFault(sensor, *_axes_phrase(permutation)))
    elif is_observed.all():
        tilt = _tilt(matrix)
        if tilt > MAX_TILT_RAD:
            message = f"rotated by {np.rad2deg(tilt):.0f} degrees against the others"
            faults.append(SensorFault(sensor, "rotated", message))
    wrong = np.abs(gains - 1) > MAX_GAIN_DEVIATION
    if not wrong.any():
        return faults
    typical = np.nanmedian(gains)
    if (
        wrong[np.isfinite(gains)].all()
        and np.nanmax(np.abs(gains / typical - 1)) < MAX_GAIN_DEVIATION
    ):
        message = f"{typical:.2f} times the gain of the others"
        faults.append(SensorFault(sensor, "gain", message))
    else:
        for axis in np.flatnonzero(wrong):
            message = f"its {'xyz'[axis]} axis has {gains[axis]:.2f} times the gain of the others"
            faults.append(SensorFault(sensor, "gain", message))
    return faults


def _axes_phrase(permutation: tuple[int, ...]) -> tuple[str, str]:
    """Return the code and the phrase for exchanged or inverted axes."""
    is_in_order = all(abs(axis) in (0, row + 1) for row, axis in enumerate(permutation))
    inverted = ["xyz"[row] for row, axis in enumerate(permutation) if axis < 0]
    if is_in_order:
        plural = len(inverted) > 1
        names = " and ".join(filter(None, [", ".join(inverted[:-1]), inverted[-1]]))
        return "axis_inverted", f"{names} {'are' if plural else 'is'} inverted"
    measured = ", ".join(("-" if axis < 0 else "") + "?xyz"[abs(axis)] for axis in permutation)
    return "axes_exchanged", f"axes exchanged: its x, y, z measure {measured} of the others"


def _tilt(matrix: Array) -> float:
    """Return the angle of the rotation that is closest to a matrix [rad]."""
    left, _, right = np.linalg.svd(matrix)
    rotation = left @ right
    return float(np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1)))


def _fit_sphere(points: Array) -> tuple[Array, float]:
    """Fit a sphere to points (n, 3) by linear least squares; return its centre and radius."""
    design = np.column_stack([2 * points, np.ones(len(points))])
    scale = np.abs(points).max()
    solution, *_ = np.linalg.lstsq(design / scale, np.sum(points**2, axis=1) / scale, rcond=None)
    centre = solution[:3]
    return centre, float(np.sqrt(max(solution[3] + centre @ centre, 0.0)))


def _field_fault(magnitude_t: float) -> list[SensorFault]:
    """Return a fault if the field that turns cannot be the Earth's."""
    least, largest = EARTH_FIELD_T
    if least * (1 - MAX_FIELD_DEVIATION) < magnitude_t < largest * (1 + MAX_FIELD_DEVIATION):
        return []
    message = (
        f"the field that turns is {1e6 * magnitude_t:.3g} uT; the Earth's is {1e6 * least:.0f} "
        f"to {1e6 * largest:.0f} uT: check the gain and the units"
    )
    return [SensorFault(None, "field_implausible", message)]


def _first_approach(time_ns: NDArray[np.int64], is_near: Mask) -> NDArray[np.int64]:
    """Return the samples of the first approach of a magnet, none if there is no approach."""
    indices = np.flatnonzero(is_near)
    pauses = np.flatnonzero(np.diff(time_ns[indices]) > MAX_MAGNET_PAUSE_S * 1e9)
    first = indices[: pauses[0] + 1] if len(pauses) else indices
    return first if len(first) > 1 else indices[:0]


def _order_faults(deviation_t: Array, is_incomplete: Mask, is_excluded: Mask) -> list[SensorFault]:
    """Return a fault if a magnet was held to another sensor than the first.

    ``deviation_t`` (m, N) are those of the approach of the magnet.
    """
    # A sensor that is complete otherwise lacks its readings near the magnet if it is saturated.
    saturated = np.where(is_incomplete, 0.0, np.inf)
    field = np.where(np.isfinite(deviation_t), deviation_t, saturated)
    field[:, is_excluded] = 0.0
    nearest = int(np.argmax(field.max(axis=0)))
    if nearest == 0:
        return []
    reversal = " (the order may be reversed)" if nearest == len(is_excluded) - 1 else ""
    message = f"the magnet was nearest to sensor {nearest + 1} instead of sensor 1{reversal}"
    return [SensorFault(None, "order", message)]


def _figures(
    noise_t: Array, is_excluded: Mask, turn: _Comparison | None = None
) -> tuple[MagnetometerFigures, ...]:
    """Return the figures of all sensors."""
    unknown = float("nan")
    return tuple(
        MagnetometerFigures(
            unknown if turn is None else float(turn.gain[i]),
            unknown if turn is None else float(turn.offset_t[i]),
            unknown if is_excluded[i] else float(noise_t[i].max()),
            () if turn is None else turn.axes[i],
        )
        for i in range(len(noise_t))
    )
