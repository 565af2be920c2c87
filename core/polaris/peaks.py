"""Peaks of the field's magnitude, sensor by sensor: where a magnet passes beneath.

Polaris section 6.2.1: peaks of the amplitude, held against its first derivative, so that
drift and noise are no magnets. The released code has thresholds that were found by hand for
each sensor; here they follow from the noise of the samples.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.polaris.array import Samples

Array = NDArray[np.float64]

FEWEST = 8
"""Samples of the quiet start at least."""

QUIET = 6.0
"""The start is quiet as long as no axis strays by more than this, in standard deviations."""

HEIGHT = 10.0
"""Least amplitude of a peak, in standard deviations of the amplitude."""

STEEPNESS = 5.0
"""Least slope before and behind a peak, in standard deviations of the slope."""


@dataclass(frozen=True)
class Signals:
    """What the peaks are looked for in.

    Attributes
    ----------
    field_t : (n, N, 3) ndarray
        Smoothed, less the field of the quiet start; ``nan`` for a sensor that is dead.
    amplitude_t : (n, N) ndarray
        Its magnitude.
    noise_t : (N,) ndarray
        Standard deviation of the amplitude.
    gain : (2,) ndarray
        Of the smoothing and of the slope after it: what white noise is multiplied with.
    """

    field_t: Array
    amplitude_t: Array
    noise_t: Array
    slope_noise_t: Array


@dataclass(frozen=True)
class Peak:
    """One sensor's field as a magnet passes.

    Attributes
    ----------
    sensor : int
    at : float
        The sample, with its fraction: where the slope of the amplitude crosses zero.
    amplitude_t : float
    """

    sensor: int
    at: float
    amplitude_t: float


def signals(samples: Samples, width: float) -> Signals:
    """Smooth a recording and take away the field of its quiet start.

    ``width`` is the standard deviation of the Gaussian that smooths, in samples.

    Raises
    ------
    InputError
        The recording is empty or all of it is missing.
    """
    field = _filled(samples.field_t)
    if len(field) < 2 * FEWEST or not np.isfinite(field).any():
        raise InputError(f"{len(field)} samples are too few to find magnets in")
    noise = _noise(field)
    kernel = _gaussian(width)
    field = field - field[: _quiet(field, noise)].mean(axis=0)
    # The amplitude takes on what the axes have in the field's direction: their rms at most.
    overall = np.sqrt(np.mean(noise**2, axis=-1))
    return Signals(
        field_t=field,
        amplitude_t=np.apply_along_axis(_smoothed, 0, np.linalg.norm(field, axis=-1), kernel),
        noise_t=overall * np.linalg.norm(kernel),
        slope_noise_t=overall * np.linalg.norm(np.convolve(kernel, [0.5, 0.0, -0.5])),
    )


def find_peaks(signal: Signals, reach: float) -> list[Peak]:
    """Peaks of all sensors, strongest first.

    A magnet counts where it is nearest: a peak at which a neighbouring sensor measures more
    is not kept. ``reach`` is how far before and behind a peak its slopes are looked for, in
    samples.
    """
    amplitude = signal.amplitude_t
    found = []
    slope = np.gradient(amplitude, axis=0)
    span = max(int(np.ceil(reach)), 1)
    beside = np.pad(np.nan_to_num(amplitude), ((0, 0), (1, 1)))
    nearest = (amplitude >= beside[:, :-2]) & (amplitude >= beside[:, 2:])
    for sensor in range(amplitude.shape[1]):
        own, steep = slope[:, sensor], STEEPNESS * signal.slope_noise_t[sensor]
        for k in np.flatnonzero((own[:-1] > 0) & (own[1:] <= 0)):
            at = k + own[k] / (own[k] - own[k + 1])
            here = round(at)
            tall = amplitude[here, sensor] >= HEIGHT * signal.noise_t[sensor]
            rises = own[max(k - span, 0) : k + 1].max() >= steep
            falls = own[k + 1 : k + 2 + span].min() <= -steep
            if tall and rises and falls and nearest[here, sensor]:
                found.append(Peak(sensor, float(at), float(amplitude[here, sensor])))
    return sorted(found, key=lambda peak: -peak.amplitude_t)


def _filled(field: Array) -> Array:
    """Single lost samples replaced on the line between their neighbours; sensors with more
    than half of them lost are ``nan`` throughout."""
    filled = np.array(field, float)
    index = np.arange(len(field))
    for sensor in range(field.shape[1]):
        good = np.isfinite(field[:, sensor]).all(axis=-1)
        if 2 * good.sum() <= len(field):
            filled[:, sensor] = np.nan
        elif not good.all():
            for axis in range(3):
                filled[:, sensor, axis] = np.interp(index, index[good], field[good, sensor, axis])
    return filled


def _noise(field: Array) -> Array:
    """Standard deviation (N, 3) of a sample, from second differences: magnets are smooth
    from sample to sample, noise is not. The median is not moved by what is not smooth."""
    second = np.diff(field, 2, axis=0)
    return np.asarray(1.4826 * np.median(np.abs(second), axis=0) / np.sqrt(6.0))


def _gaussian(width: float) -> Array:
    half = max(int(np.ceil(3 * width)), 1)
    kernel = np.exp(-0.5 * (np.arange(-half, half + 1) / max(width, 1e-3)) ** 2)
    return kernel / kernel.sum()


def _smoothed(series: Array, kernel: Array) -> Array:
    half = len(kernel) // 2
    return np.convolve(np.pad(series, half, mode="edge"), kernel, mode="valid")


def _quiet(field: Array, noise: Array) -> int:
    """Samples of the start in which no sensor sees a magnet; the half before it began."""
    start = field[:FEWEST].mean(axis=0)
    block = np.apply_along_axis(_smoothed, 0, field - start, np.full(FEWEST | 1, 1 / (FEWEST | 1)))
    limit = QUIET * noise * np.sqrt(2 / FEWEST)
    stirred = (np.abs(block) > limit).any(axis=(1, 2))
    quiet = int(stirred.argmax()) if stirred.any() else len(field)
    return max(quiet // 2, FEWEST)
