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
"""The same above which a sensor is not compared with the others."""

MAGNET_QUANTILE, MIN_MAGNET_RATIO = 0.75, 4.0
"""A magnet is near if a reading is further from the median of its sensor than this multiple of that
quantile of the distances. Rotations in a uniform field reach 2 or 3."""

MIN_MAGNET_T = 1.75e-4
"""Least distance of a reading near a magnet from the median of its sensor [T]: more than twice the
strongest field on Earth."""

MIN_TURN_SIGMAS = 10.0
"""Standard deviation of the field along an axis, in those of the noise, from which the array was
turned about the other axes."""

MIN_TURN_FRACTION = 0.2
"""The same as a fraction of the axis with the largest standard deviation."""

MIN_TURN_T = 5e-6
"""The same in tesla: a quarter of the weakest field on Earth."""

MIN_AXIS_FRACTION = 0.05
"""Standard deviation of one axis, relative to that of the same axis of the others, below which it
does not work."""

MIN_CORRELATION = 0.9
"""Mean correlation of the axes of two sensors from which they agree."""

MAX_GAIN_DEVIATION = 0.15
"""Relative deviation of a gain from the median above which it is a fault. Sensors of a type agree
within a few percent; settings differ by 20 % or more (MLX90393 data sheet, table 17)."""

MAGNET_MARGIN_S = 1.0
"""Time before and after a magnet is near during which its field may disturb the comparison [s]."""

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
        it is inverted; empty if unknown.
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
        There are fewer than :data:`MIN_SAMPLES` samples.
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
    is_dead |= missing > MAX_EXCLUDED_FRACTION
    untested: list[str] = []
    if is_dead.all():
        return ArrayCheck(_figures(noise_t, is_dead), tuple(faults), (), float("nan"))
    turned = field_t[is_undisturbed]
    spread_t = np.nanstd(turned[:, ~is_dead], axis=0)
    if not _is_turned(spread_t, noise_t[~is_dead]):
        untested.append("axes and gains: the array was not turned; turn it about all its axes")
        turn = None
    else:
        turn = _compare(turned, is_dead)
        faults += turn.faults
        untested += turn.untested
    order = _order_fault(deviation_t, is_near, missing > MAX_MISSING_FRACTION, is_dead)
    if order is None and count > 1:
        untested.append(
            "order of the sensors: no magnet was held to sensor 1 after the array was turned"
        )
    faults += order or []
    gain = np.ones(count) if turn is None else np.nan_to_num(turn.gain, nan=1.0)
    faults += _noisy_sensors(noise_t / np.maximum(gain, MIN_AXIS_FRACTION)[:, None], ~is_dead)
    figures = _figures(noise_t, is_dead, turn)
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


def _compare(turned_t: Array, is_dead: Mask) -> _Comparison:
    """Compare the sensors of a turned array with the field that most of them agree on."""
    is_complete = np.isfinite(turned_t[:, ~is_dead]).all(axis=(1, 2))
    centred = turned_t[is_complete] - _nanmedian(turned_t[is_complete])
    working = np.flatnonzero(~is_dead)
    agreeing = _largest_agreement(centred, working)
    reference = np.median(centred[:, agreeing], axis=1)
    reference_spread = reference.std(axis=0)
    is_observed = reference_spread > MIN_TURN_FRACTION * reference_spread.max()
    count = turned_t.shape[1]
    gain, offset = np.full(count, np.nan), np.full(count, np.nan)
    axes: list[tuple[int, ...]] = [()] * count
    faults, untested = [], []
    matrices = {int(i): _linear_map(centred[:, i], reference, is_observed) for i in working}
    permutations = {i: _signed_permutation(matrix) for i, matrix in matrices.items()}
    axis_gains = {i: _axis_gains(matrices[i], permutations[i]) for i in matrices}
    median_gain = np.nanmedian(list(axis_gains.values()))
    rms = np.sqrt(np.mean(np.sum(reference**2, axis=1)))
    disturbances = []
    for i, matrix in matrices.items():
        gains = axis_gains[i] / median_gain
        gain[i] = np.nanmedian(gains)
        axes[i] = permutations[i]
        faults += _axis_faults(i, matrix, permutations[i], gains, is_observed)
        residual = centred[:, i] - reference @ matrix.T
        disturbances.append(np.sqrt(np.mean(np.sum(residual**2, axis=1))) / rms)
    if len(working) == 2 and len(agreeing) == 1:
        untested.append("which of the two sensors is right: compare them with a third one")
    if np.median(disturbances) > MAX_DISTURBANCE:
        message = (
            f"their fields differ by {100 * np.median(disturbances):.0f} % while the array is "
            "turned: move away from iron and magnets"
        )
        faults.append(SensorFault(None, "disturbed", message))
    magnitude = float("nan")
    if is_observed.all():
        centre, magnitude = _fit_sphere(reference)
        offset[working] = [
            np.linalg.norm(_nanmedian(turned_t[is_complete])[i] + matrices[int(i)] @ centre)
            for i in working
        ]
        faults += _field_fault(magnitude)
    else:
        names = " and ".join("xyz"[axis] for axis in np.flatnonzero(~is_observed))
        untested.append(
            f"gain and sign along {names}, and the units: the field hardly changed along {names}; "
            "turn the array about all its axes"
        )
    untested.append("errors that all sensors share, such as an axis that is inverted in all")
    return _Comparison(gain, offset, axes, magnitude, faults, untested)


def _largest_agreement(centred: Array, working: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the sensors that agree with the one that agrees with most."""
    scaled = centred[:, working]
    norm = np.sqrt(np.einsum("tia,tia->i", scaled, scaled))
    correlation = np.einsum("tia,tja->ij", scaled, scaled) / np.maximum(
        norm[:, None] * norm, np.finfo(float).tiny
    )
    agrees = correlation > MIN_CORRELATION
    best = int(np.argmax(agrees.sum(axis=1)))
    return np.asarray(working[agrees[best] | (np.arange(len(working)) == best)])


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
    """Return the axis (1, 2, 3) that each row measures, negative if inverted."""
    size = np.abs(matrix)
    best = max(
        itertools.permutations(range(3)),
        # Rows without a signal keep their own axis.
        key=lambda order: (
            round(float(size[range(3), order].sum() / size.max()), 2),
            order == (0, 1, 2),
        ),
    )
    return tuple(
        -(axis + 1) if matrix[row, axis] < 0 else axis + 1 for row, axis in enumerate(best)
    )


def _axis_gains(matrix: Array, permutation: tuple[int, ...]) -> Array:
    """Return the gain (3,) of each axis of a sensor; ``nan`` for those that were not observed."""
    columns = [abs(axis) - 1 for axis in permutation]
    is_observed = np.asarray(matrix.any(axis=0))
    gains = np.linalg.norm(matrix, axis=1)
    return np.where(is_observed[columns], gains, np.nan)


def _axis_faults(
    sensor: int,
    matrix: Array,
    permutation: tuple[int, ...],
    gains: Array,
    is_observed: Mask,
) -> list[SensorFault]:
    """Return the faults of a sensor's axes and gains."""
    faults = []
    is_weak = gains < MIN_AXIS_FRACTION
    for axis in np.flatnonzero(is_weak):
        message = f"its {'xyz'[axis]} axis does not change with the field"
        faults.append(SensorFault(sensor, "axis_dead", message))
    if is_weak.any():
        return faults
    if permutation != (1, 2, 3):
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
    order = [abs(axis) - 1 for axis in permutation]
    inverted = ["xyz"[row] for row, axis in enumerate(permutation) if axis < 0]
    if order == [0, 1, 2]:
        plural = len(inverted) > 1
        names = " and ".join(filter(None, [", ".join(inverted[:-1]), inverted[-1]]))
        return "axis_inverted", f"{names} {'are' if plural else 'is'} inverted"
    measured = ", ".join(("-" if axis < 0 else "") + "xyz"[abs(axis) - 1] for axis in permutation)
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


def _order_fault(
    deviation_t: Array, is_near: Mask, is_incomplete: Mask, is_dead: Mask
) -> list[SensorFault] | None:
    """Return a fault if the first sensor to which a magnet was held is not sensor 0.

    None if no magnet was held to the array, or sensor 0 is dead.
    """
    indices = np.flatnonzero(is_near)
    if len(indices) < 2 or is_dead[0] or len(is_dead) < 2:
        return None
    gaps = np.flatnonzero(np.diff(indices) > len(is_near) // 20)
    first = indices[: gaps[0] + 1] if len(gaps) else indices
    # A sensor that is complete otherwise lacks its readings near the magnet if it is saturated.
    saturated = np.where(is_incomplete, 0.0, np.inf)
    field = np.where(np.isfinite(deviation_t[first]), deviation_t[first], saturated)
    field[:, is_dead] = 0.0
    nearest = int(np.argmax(field.max(axis=0)))
    if nearest == 0:
        return []
    reversed_order = " The order is reversed." if nearest == len(is_dead) - 1 else ""
    message = (
        f"a magnet was held to sensor 1, but sensor {nearest + 1} was nearest.{reversed_order}"
    )
    return [SensorFault(None, "order", message)]


def _figures(
    noise_t: Array, is_dead: Mask, turn: _Comparison | None = None
) -> tuple[MagnetometerFigures, ...]:
    """Return the figures of all sensors."""
    unknown = float("nan")
    return tuple(
        MagnetometerFigures(
            unknown if turn is None else float(turn.gain[i]),
            unknown if turn is None else float(turn.offset_t[i]),
            unknown if is_dead[i] else float(noise_t[i].max()),
            () if turn is None else turn.axes[i],
        )
        for i in range(len(noise_t))
    )
