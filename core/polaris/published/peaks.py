"""Peaks of the field's magnitude, sensor by sensor: the samples at which it passes a magnet.

Polaris section 6.2.1: peaks of the amplitude, checked against its first derivative to reject
drift and noise. The released code has thresholds that were adjusted by hand for each sensor;
here they follow from the noise of the samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.polaris.array import Samples

Array = NDArray[np.float64]

MIN_QUIET_SAMPLES = 9
"""Least number of samples at the start of a recording, or between magnets, that give a background:
the mean of nine has a third of a sample's noise."""

MAX_QUIET_SIGMAS = 6.0
"""Largest deviation of an axis within the quiet start, in standard deviations of its noise;
beyond what a few thousand samples of Gaussian noise contain."""

MIN_PEAK_SIGMAS = 10.0
"""Least amplitude of a peak, in standard deviations of the amplitude."""

MIN_SLOPE_SIGMAS = 5.0
"""Least slope before and behind a peak, in standard deviations of the slope."""

NOISE_FROM_MEDIAN = 1.4826
"""Standard deviation of Gaussian noise over the median of its absolute values."""


@dataclass(frozen=True)
class Signals:
    """Field of the magnets, and its smoothed amplitude.

    Attributes
    ----------
    field_t : (n, N, 3) ndarray
        Without the background.
    amplitude_t : (n, N) ndarray
        Its magnitude, smoothed.
    kernel : (k,) ndarray
        Weights of the smoothing.
    noise_t : (N,) ndarray
        Standard deviation of a sample, rms over the axes.
    """

    field_t: Array
    amplitude_t: Array
    kernel: Array
    noise_t: Array

    def subtract(self, field_t: Array) -> Signals:
        """Return the signals without a field (n, N, 3)."""
        field = self.field_t - field_t
        # The vector itself must not be smoothed: above a magnet it rotates within millimetres.
        amplitude = _smooth(np.linalg.norm(field, axis=-1), self.kernel)
        return replace(self, field_t=field, amplitude_t=amplitude)

    def between(self, first: int, stop: int) -> Signals:
        """Return samples ``first`` to ``stop - 1``."""
        rows = slice(first, stop)
        return replace(self, field_t=self.field_t[rows], amplitude_t=self.amplitude_t[rows])


@dataclass(frozen=True)
class Peak:
    """Maximum of one sensor's amplitude.

    Attributes
    ----------
    sensor : int
    sample : float
        With its fraction: the zero crossing of the first derivative.
    amplitude_t : float
    """

    sensor: int
    sample: float
    amplitude_t: float


def measure_signals(samples: Samples, width_samples: float) -> Signals:
    """Return a recording without the field of its quiet start.

    The amplitude is smoothed by a Gaussian of standard deviation ``width_samples``. Lost
    samples are interpolated linearly.

    Raises
    ------
    InputError
        The recording is too short.
    """
    if len(samples) < 2 * MIN_QUIET_SAMPLES:
        raise InputError(f"{len(samples)} samples are too few to find magnets in")
    field = _interpolate_lost(samples.field_t)
    # Second differences: the field of a magnet is smooth from sample to sample, noise is not. Their
    # variance is 1 + 4 + 1 times that of a sample; interpolated samples have none.
    measured = np.abs(np.diff(samples.field_t, 2, axis=0))
    interpolated = np.abs(np.diff(field, 2, axis=0))
    second = np.where(np.isnan(measured).all(axis=0), interpolated, measured)
    noise = NOISE_FROM_MEDIAN * np.nanmedian(second, axis=0) / np.sqrt(6.0)
    raw = Signals(
        field_t=field,
        amplitude_t=field[..., 0],
        kernel=_gaussian(width_samples),
        noise_t=np.sqrt(np.mean(noise**2, axis=-1)),
    )
    return raw.subtract(field[: _count_quiet(field, noise)].mean(axis=0))


def find_peaks(signal: Signals, slope_range_samples: float) -> list[Peak]:
    """Find the peaks of all sensors, strongest first.

    A magnet is detected by its nearest sensor: a peak at which a neighbouring sensor measures
    more is left out. Slopes are searched up to ``slope_range_samples`` before and behind a
    peak.
    """
    amplitude = signal.amplitude_t
    slope = np.gradient(amplitude, axis=0)
    min_height = MIN_PEAK_SIGMAS * np.linalg.norm(signal.kernel) * signal.noise_t
    slope_kernel = np.gradient(np.pad(signal.kernel, 2))
    min_slope = MIN_SLOPE_SIGMAS * np.linalg.norm(slope_kernel) * signal.noise_t
    neighbours = np.pad(amplitude, ((0, 0), (1, 1)))
    is_peak = amplitude >= min_height
    is_peak &= (amplitude >= neighbours[:, :-2]) & (amplitude >= neighbours[:, 2:])
    is_peak[1:] &= amplitude[1:] >= amplitude[:-1]
    is_peak[:-1] &= amplitude[:-1] > amplitude[1:]
    is_peak[0] = is_peak[-1] = False
    span = max(int(np.ceil(slope_range_samples)), 1)
    peaks = []
    for k, sensor in np.argwhere(is_peak):
        rise = slope[max(k - span, 0) : k + 1, sensor].max()
        fall = slope[k : k + span + 1, sensor].min()
        if rise >= min_slope[sensor] and fall <= -min_slope[sensor]:
            peaks.append(_interpolate_peak(amplitude, int(k), int(sensor)))
    return sorted(peaks, key=lambda peak: -peak.amplitude_t)


def refine_peak(signal: Signals, peak: Peak, range_samples: float) -> Peak:
    """Return the same sensor's peak within ``range_samples``.

    If the amplitude has no maximum there, the peak keeps its position and takes the amplitude
    of its sample.
    """
    amplitude = signal.amplitude_t
    centre, span = round(peak.sample), max(int(range_samples), 1)
    first = max(centre - span, 0)
    k = first + int(amplitude[first : centre + span + 1, peak.sensor].argmax())
    is_inside = max(first, 1) <= k <= min(centre + span, len(amplitude) - 2)
    before, top, after = amplitude[k - 1 : k + 2, peak.sensor] if is_inside else (0.0, 0.0, 0.0)
    if before <= top > after:
        return _interpolate_peak(amplitude, k, peak.sensor)
    return replace(peak, amplitude_t=float(amplitude[centre, peak.sensor]))


def estimate_background(
    signal: Signals, peaks: Sequence[Peak], clear_samples: float, mean_samples: float
) -> Array:
    """Estimate the field (n, N, 3) between magnets.

    The mean of all samples within ``mean_samples`` that are farther than ``clear_samples``
    from every peak; interpolated linearly across stretches without such samples, and zero if
    there are none at all. The quiet start alone does not suffice: motors and the rotation of
    the Earth's field in the array's frame change the background by some microtesla on the
    way to a tag.
    """
    index = np.arange(len(signal.field_t))
    is_clear = np.ones(len(index), bool)
    for peak in peaks:
        is_clear &= np.abs(index - peak.sample) > clear_samples
    if is_clear.sum() < MIN_QUIET_SAMPLES:
        return np.zeros_like(signal.field_t)
    sums = np.zeros((len(index) + 1, *signal.field_t.shape[1:]))
    np.cumsum(np.where(is_clear[:, None, None], signal.field_t, 0.0), axis=0, out=sums[1:])
    counts = np.concatenate([[0], np.cumsum(is_clear)])
    span = max(int(mean_samples), MIN_QUIET_SAMPLES // 2)
    first, stop = np.maximum(index - span, 0), np.minimum(index + span + 1, len(index))
    number = counts[stop] - counts[first]
    mean = (sums[stop] - sums[first]) / np.maximum(number, 1)[:, None, None]
    known = np.flatnonzero(is_clear & (number >= min(span, MIN_QUIET_SAMPLES // 2)))
    if not len(known):
        return np.zeros_like(signal.field_t)
    right = np.searchsorted(known, index).clip(1, max(len(known) - 1, 1))
    left, right = known[right - 1], known[np.minimum(right, len(known) - 1)]
    fraction = ((index - left) / np.maximum(right - left, 1)).clip(0, 1)[:, None, None]
    return np.asarray(mean[left] * (1 - fraction) + mean[right] * fraction)


def _interpolate_peak(amplitude: Array, k: int, sensor: int) -> Peak:
    """Return the vertex of the parabola through sample ``k`` and its neighbours."""
    before, top, after = amplitude[k - 1 : k + 2, sensor]
    sample = k + (after - before) / (2 * (2 * top - before - after))
    return Peak(sensor, float(sample), float(top))


def _interpolate_lost(field: Array) -> Array:
    filled = np.array(field, float)
    index = np.arange(len(field))
    for sensor in range(field.shape[1]):
        valid = np.isfinite(field[:, sensor]).all(axis=-1)
        if not valid.all():
            for axis in range(3):
                filled[:, sensor, axis] = np.interp(index, index[valid], field[valid, sensor, axis])
    return filled


def _gaussian(width_samples: float) -> Array:
    half = int(np.ceil(3 * width_samples))
    kernel = np.exp(-0.5 * (np.arange(-half, half + 1) / width_samples) ** 2)
    return np.asarray(kernel / kernel.sum())


def _smooth(series: Array, kernel: Array) -> Array:
    """Convolve series (n, ...) along the first axis; the ends are continued as constants."""
    half = len(kernel) // 2
    padded = np.pad(series, [(half, half), *[(0, 0)] * (series.ndim - 1)], mode="edge")
    return np.asarray(sum(w * padded[k : k + len(series)] for k, w in enumerate(kernel)))


def _count_quiet(field: Array, noise: Array) -> int:
    """Count the samples of the start during which no sensor measures a magnet.

    Only their first half is used, because the field rises before it is detected.
    """
    block = np.full(MIN_QUIET_SAMPLES, 1 / MIN_QUIET_SAMPLES)
    deviation = np.abs(_smooth(field - field[:MIN_QUIET_SAMPLES].mean(axis=0), block))
    limit = MAX_QUIET_SIGMAS * noise * np.sqrt(2 / MIN_QUIET_SAMPLES)
    is_disturbed = (deviation > limit).any(axis=(1, 2))
    quiet = int(is_disturbed.argmax()) if is_disturbed.any() else len(field)
    return max(quiet // 2, MIN_QUIET_SAMPLES)
