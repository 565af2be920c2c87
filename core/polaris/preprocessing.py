"""Preprocessing of samples: implausible values are removed, the noise is estimated, passes found.

A *pass* is a range of samples in which the field along the bar changes by more than noise and
more than a field that all sensors share: the array moves over magnets.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.magnetics import dipole_field
from locatk.core.polaris.array import Samples
from locatk.core.solution import SolverWarning
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

MIN_SAMPLES = 20
"""Least number of samples of a recording; a tag needs as many."""

MIN_STUCK_SAMPLES = 25
"""Number of equal samples in a row, in all three axes, from which a sensor counts as stuck: the
noise of a working sensor is several counts (:data:`~locatk.core.polaris.mlx90393.QUANTUM_UT`)."""

SPIKE_SIGMAS = 10.0
"""Distance from all neighbours in time, beyond the difference of these, from which a value is a
spike, in standard deviations of the noise. The protocol of the published array has no sync word,
so that misframed messages occur."""

SPIKE_NEIGHBOURS = 2
"""Number of neighbours of a value on each side with which it is compared."""

CHANGE_LAGS_SAMPLES = (1, 2, 4, 8, 16)
"""Lags over which changes of the field are tested: short ones for fast robots, long ones for slow
ones."""

MIN_CHANGE_SIGMAS = 8.0
"""Change of the bar's field from which a sample belongs to a pass, in standard deviations of the
sum of squares that noise alone gives."""

MIN_PASS_MARGIN_SAMPLES = 10
"""Least margin of a pass, before its first change and after its last one."""

PASS_TO_MARGIN_RATIO = 6
"""Duration of a pass relative to its margins, whose samples determine the background."""

MIN_MOTION_M = 1e-3
"""Distance that an array must have moved in a pass, if its path is known [m]: a tenth of the usual
height over the magnets, so that their field has hardly changed."""

SINGULAR_VALUE_MARGIN = 5.0
"""Distance above ``sqrt(n) + sqrt(channels)`` from which a singular value is not that of noise.
Noise reaches it with a probability below exp(-12) (Davidson and Szarek, Handbook of the Geometry of
Banach Spaces 1 (2001), Theorem II.13)."""

MIN_RANK_RATIO = 3.0
"""Ratio of the largest singular value to that limit from which the second one of a moving array
would be seen: it is a third of the first or more over a dipole whose field is measured by at least
two sensors."""

SIGNAL_COMPONENTS = 3
"""Number of singular values that hold most of the signal of a pass: one per axis of the field."""

MIN_TAG_FIELD_FRACTION = 0.2
"""Change of the bar's field in a pass over a tag, relative to that of one magnet by its design. The
weakest magnets of the published recordings (1.0 instead of 1.8 mA m^2, 11.8 instead of 10 mm above)
reach 0.34."""

MIN_NOISE_T = 2e-8
"""Lower limit of the noise [T]; a quarter of the quantum if that is larger."""

MIN_NOISE_SAMPLES = 20
"""Number of second differences from which the noise of a sensor is estimated."""

NOISE_QUANTILE, NORMAL_QUANTILE = 0.3, 0.38532
"""Quantile of the absolute second differences from which the noise is estimated, and its value for
a standard normal distribution. It is a low one, so that passes over magnets may fill most of a
recording."""


@dataclass(frozen=True)
class PassRange:
    """Range of the samples of one pass: ``first`` to ``stop - 1``."""

    first: int
    stop: int


@dataclass(frozen=True)
class PreprocessedSamples:
    """Samples without implausible values.

    Attributes
    ----------
    samples : Samples
    noise_t : (N, 3) ndarray
        Standard deviation of the noise of each sensor and axis [T].
    warnings : tuple of SolverWarning
        Values that were removed or are missing.
    """

    samples: Samples
    noise_t: Array
    warnings: tuple[SolverWarning, ...]


def preprocess(samples: Samples, *, is_running: bool = False) -> PreprocessedSamples:
    """Remove stuck, spiked and non-finite values, and estimate the noise of the rest.

    A sensor that repeats the same triple is stuck (its bus hangs); a value far from those before
    and after it is a spike (a misframed message). One of them can outweigh a whole pass.

    Parameters
    ----------
    samples : Samples
    is_running : bool
        True if samples follow that are not known yet: the last ones are not called spikes, because
        a field that begins to change looks like one.

    Raises
    ------
    InputError
        There are too few samples, no sensor has a value, or time stamps do not ascend.
    """
    _check(samples)
    samples = replace(samples, time_ns=_separate_equal_times(samples.time_ns))
    warnings = []
    field = np.where(np.isfinite(samples.field_t), samples.field_t, np.nan)
    is_stuck = _stuck_samples(field)
    for sensor in np.flatnonzero(is_stuck.any(axis=0)):
        percentage = 100 * is_stuck[:, sensor].mean()
        message = f"sensor {sensor + 1} was stuck ({percentage:.0f} % of the time)"
        warnings.append(SolverWarning("sensor_stuck", message).about(samples.device))
    # The noise is estimated without stuck samples, which have none.
    field = np.where(is_stuck[..., None], np.nan, field)
    is_spike = _spikes(field, estimate_noise(replace(samples, field_t=field)))
    if is_running:
        is_spike[-SPIKE_NEIGHBOURS:] = False
    if is_spike.any():
        message = f"{int(is_spike.sum())} values were spikes"
        warnings.append(SolverWarning("spikes", message).about(samples.device))
    field = np.where(is_spike, np.nan, field)
    missing = np.isnan(field).any(axis=2).mean()
    if missing > 0:
        message = f"{100 * missing:.2g} % of the sensors' samples missing"
        warnings.append(SolverWarning("samples_missing", message).about(samples.device))
    cleaned = replace(samples, field_t=field)
    return PreprocessedSamples(cleaned, estimate_noise(cleaned), tuple(warnings))


def valid_odometry(odometry: Trajectory) -> tuple[Trajectory | None, tuple[SolverWarning, ...]]:
    """Return the valid poses of odometry in order of time, and a warning if there are others.

    Poses are invalid if they are not finite numbers, or have the time stamp of another pose. Less
    than two valid ones are no odometry.
    """
    is_finite = np.isfinite(np.hstack([odometry.position[:, :2], odometry.quaternion])).all(axis=1)
    finite = odometry.select(np.asarray(is_finite))
    _, first = np.unique(finite.time_ns, return_index=True)
    valid = finite.select(first)
    if len(valid) == len(odometry) >= 2:
        return valid, ()
    message = (
        f"{len(odometry) - len(valid)} of {len(odometry)} poses of the odometry are not finite "
        "numbers or have the time of another one; left out"
    )
    if len(valid) < 2:
        message = f"the odometry has {len(valid)} valid poses and is not used"
    warning = SolverWarning("odometry_invalid", message).about(odometry.device)
    return (valid if len(valid) >= 2 else None), (warning,)


def _check(samples: Samples) -> None:
    """Raise an error if samples cannot hold a tag."""
    if len(samples) < MIN_SAMPLES:
        raise InputError(
            f"{len(samples)} samples of {samples.device}; a tag needs at least {MIN_SAMPLES}",
            hint="Record from before the tag to after it",
        )
    if not np.isfinite(samples.field_t).any():
        raise InputError(
            f"no sensor of {samples.device} gave a sample", hint="Check wiring and range"
        )
    if np.any(np.diff(samples.time_ns) < 0) or samples.time_ns[0] == samples.time_ns[-1]:
        raise InputError(
            f"the time stamps of {samples.device} do not ascend", hint="Check the recording"
        )


def _separate_equal_times(time_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return strictly ascending times (n,): a host may stamp several samples at once.

    Equal times become those of samples at a constant rate from one stamp to the next; each stamp
    remains the mean of its samples, as far as the stamps beside it allow.
    """
    stamps, first, counts = np.unique(time_ns, return_index=True, return_counts=True)
    if len(stamps) == len(time_ns):
        return time_ns
    middle = first + (counts - 1) / 2
    # Before the first stamp and after the last one, times continue at the rate beside them.
    middle = np.concatenate([[2 * middle[0] - middle[1]], middle, [2 * middle[-1] - middle[-2]]])
    offset = stamps - stamps[0]
    offset = np.concatenate([[-offset[1]], offset, [2 * offset[-1] - offset[-2]]])
    index = np.arange(len(time_ns))
    separated = stamps[0] + np.rint(np.interp(index, middle, offset)).astype(np.int64)
    return np.asarray(np.maximum.accumulate(separated - index) + index)


def _stuck_samples(field: Array) -> NDArray[np.bool_]:
    """Return a mask (n, N) of the samples that a sensor repeats while others do not."""
    n, sensors, _ = field.shape
    is_stuck = np.zeros((n, sensors), bool)
    if n <= MIN_STUCK_SAMPLES:
        return is_stuck
    is_repeated = np.all(np.diff(field, axis=0) == 0, axis=2)
    # Runs of equal steps, one fewer than samples, and all samples of such a run.
    repeats = np.cumsum(np.vstack([np.zeros((1, sensors), int), is_repeated]), axis=0)
    steps = MIN_STUCK_SAMPLES - 1
    is_run = repeats[steps:] - repeats[:-steps] == steps
    for first, sensor in np.argwhere(is_run):
        is_stuck[first : first + MIN_STUCK_SAMPLES, sensor] = True
    # An array of which all sensors repeat themselves has no noise (a simulated one).
    is_missing = ~np.isfinite(field).all(axis=2)
    return is_stuck & ~np.all(is_stuck | is_missing, axis=1, keepdims=True)


def _spikes(field: Array, noise_t: Array) -> NDArray[np.bool_]:
    """Return a mask (n, N, 3) of the values that are far from all their neighbours in time."""
    n, width = len(field), SPIKE_NEIGHBOURS
    if n < 2 * width + 1:
        return np.zeros(field.shape, bool)
    padded = np.pad(field, ((width, width), (0, 0), (0, 0)), mode="reflect")
    neighbours = [padded[width + lag : width + lag + n] for lag in range(-width, width + 1) if lag]
    high, low = np.fmax.reduce(neighbours), np.fmin.reduce(neighbours)
    distance = np.fmax(field - high, low - field)
    with np.errstate(invalid="ignore"):
        return np.asarray(distance > SPIKE_SIGMAS * noise_t + (high - low))


def estimate_noise(samples: Samples) -> Array:
    """Estimate the standard deviation (N, 3) of the noise of each sensor and axis [T].

    It follows from second differences, most of which a smooth field hardly changes. The noise that
    the array states is returned if there are too few samples.
    """
    stated = np.broadcast_to(samples.array.noise_t, (len(samples.array), 3))
    least = np.maximum(samples.array.quantum_t / 4, MIN_NOISE_T)
    second_difference = np.abs(np.diff(samples.field_t, n=2, axis=0))
    count = np.isfinite(second_difference).sum(axis=0)
    noise = np.array(stated)
    if len(second_difference) >= MIN_NOISE_SAMPLES:
        ascending = np.sort(
            np.where(np.isfinite(second_difference), second_difference, np.inf), axis=0
        )
        rank = (NOISE_QUANTILE * count).astype(int)
        quantile = np.take_along_axis(ascending, rank[None], axis=0)[0]
        # The second difference of white noise has six times its variance.
        noise = np.where(
            count >= MIN_NOISE_SAMPLES, quantile / NORMAL_QUANTILE / np.sqrt(6), stated
        )
    # A sensor whose noise is neither measured nor stated is assumed to be like the others.
    is_known = np.isfinite(noise)
    for axis in range(3):
        known = noise[is_known[:, axis], axis]
        noise[~is_known[:, axis], axis] = np.median(known) if len(known) else 0.0
    return np.maximum(noise, least)


def find_passes(samples: Samples, noise_t: Array) -> list[PassRange]:
    """Return the passes over magnets in order of time; none if the field never changes."""
    changing = np.flatnonzero(field_change(samples, noise_t) > MIN_CHANGE_SIGMAS)
    if len(changing) == 0:
        return []
    passes: list[PassRange] = []
    max_gap = max(CHANGE_LAGS_SAMPLES)
    for group in np.split(changing, np.flatnonzero(np.diff(changing) > max_gap) + 1):
        first, stop = int(group[0]), int(group[-1]) + 1
        margin = max(MIN_PASS_MARGIN_SAMPLES, (stop - first) // PASS_TO_MARGIN_RATIO)
        first, stop = max(0, first - margin), min(len(samples), stop + margin)
        if passes and first <= passes[-1].stop:
            passes[-1] = PassRange(passes[-1].first, stop)
        else:
            passes.append(PassRange(first, stop))
    return passes


def field_change(samples: Samples, noise_t: Array) -> Array:
    """Return the change of the bar's field around each sample (n,), in sigmas of pure noise.

    A field that all sensors share (the Earth's, while the robot rotates) does not count, and
    neither does a sensor that lacks one of the two samples.
    """
    n = len(samples)
    scaled = samples.field_t / noise_t
    largest = np.zeros(n)
    for lag in CHANGE_LAGS_SAMPLES:
        if lag >= n:
            break
        difference = scaled[lag:] - scaled[:-lag]
        is_finite = np.isfinite(difference)
        count = is_finite.sum(axis=1)
        difference = np.where(is_finite, difference, 0.0)
        degrees_of_freedom = count.sum(axis=1)
        if len(samples.array) > 2:
            difference = _subtract_shared(difference, is_finite)
            degrees_of_freedom = degrees_of_freedom - (count > 0).sum(axis=1)
        squares = (difference**2).sum(axis=(1, 2)) / 2
        change = (squares - degrees_of_freedom) / np.sqrt(2 * np.maximum(degrees_of_freedom, 1))
        middle = slice(lag // 2, lag // 2 + n - lag)
        largest[middle] = np.maximum(largest[middle], change)
    return largest


def bar_energy(field_t: Array, level_t: Array, noise_t: Array) -> float:
    """Return the sum of squares of one sample (N, 3) relative to a level, in units of the noise.

    A field that all sensors share does not count, and neither does a sensor without a value.
    """
    scaled = ((field_t - level_t) / noise_t)[None]
    is_finite = np.isfinite(scaled)
    scaled = np.where(is_finite, scaled, 0.0)
    if scaled.shape[1] > 2:
        scaled = _subtract_shared(scaled, is_finite)
    return float((scaled**2).sum())


def _subtract_shared(values: Array, is_finite: NDArray[np.bool_]) -> Array:
    """Subtract the mean of all sensors from values (n, N, 3); those that are missing become 0."""
    count = np.maximum(is_finite.sum(axis=1, keepdims=True), 1)
    shared = np.where(is_finite, values, 0.0).sum(axis=1, keepdims=True) / count
    return np.where(is_finite, values - shared, 0.0)


def is_no_pass(
    samples: Samples,
    part: PassRange,
    noise_t: Array,
    path_m: Array | None = None,
    magnet_field_t: float | None = None,
) -> bool:
    """Return whether the field of a pass can have changed without a motion over a tag.

    It can if the known path hardly moves; if all channels change by one function of time, as when
    a motor starts (over a dipole, the three axes differ); or if the change is far smaller than that
    of a tag's magnet, as by drift or by people and iron that move nearby.

    Parameters
    ----------
    samples : Samples
    part : PassRange
    noise_t : (N, 3) ndarray
        Standard deviation of one sample [T].
    path_m : (n,) ndarray, optional
        Distance that the array had moved at each sample of the recording, known in the pass.
    magnet_field_t : float, optional
        Least change of the bar's field by a magnet of the tag (:func:`least_magnet_field`) [T].
    """
    rows = slice(part.first, part.stop)
    if path_m is not None and np.ptp(path_m[rows]) < MIN_MOTION_M:
        return True
    field = samples.field_t[rows]
    is_finite = np.isfinite(field)
    count = np.maximum(is_finite.sum(axis=0), 1)
    level = np.where(is_finite, field, 0.0).sum(axis=0) / count
    deviation = np.where(is_finite, field - level, 0.0)
    if len(samples.array) > 2:
        deviation = _subtract_shared(deviation, is_finite)
    scaled = (deviation / noise_t).reshape(len(field), -1)
    series, size, _ = np.linalg.svd(scaled, full_matrices=False)
    limit = np.sqrt(scaled.shape[0]) + np.sqrt(scaled.shape[1]) + SINGULAR_VALUE_MARGIN
    if size[0] > MIN_RANK_RATIO * limit and np.all(size[1:] < limit):
        return True
    if magnet_field_t is None:
        return False
    # The strongest components hold the signal and little of the noise of all channels.
    signal = (series * size)[:, :SIGNAL_COMPONENTS]
    strongest_t = np.sqrt((signal**2).sum(axis=1).max() * np.mean(noise_t**2))
    return bool(strongest_t < MIN_TAG_FIELD_FRACTION * magnet_field_t)


def least_magnet_field(samples: Samples, moment_am2: float, height_m: float) -> float:
    """Return the least change of the bar's field by a magnet that passes between two sensors [T].

    It is the root of the sum of squares over the bar, without the part that all sensors share.
    """
    sensors = samples.array.position_m
    order = np.argsort(sensors[:, 1])
    middle = (sensors[order[1:]] + sensors[order[:-1]]) / 2 if len(sensors) > 1 else sensors
    offsets = sensors - middle[:, None] + [0.0, 0.0, height_m]
    moments = moment_am2 * np.eye(3)[:2, None, None]
    field = dipole_field(offsets, moments).reshape(-1, len(sensors), 3)
    if len(sensors) > 2:
        field = field - field.mean(axis=1, keepdims=True)
    return float(np.sqrt((field**2).sum(axis=(1, 2)).min()))
