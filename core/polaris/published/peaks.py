"""Peaks of the field's magnitude, sensor by sensor: where the array passes a magnet.

Polaris section 6.2.1: peaks of the amplitude, held against its first derivative so that
drift and noise are no magnets. The released code has thresholds that were found by hand for
each sensor; here they follow from the noise of the samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.polaris.array import Samples

Array = NDArray[np.float64]

FEWEST = 9
"""Samples by which the quiet start is judged: its shortest length."""

QUIET = 6.0
"""The start is quiet while no axis strays farther than this, in standard deviations."""

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
        Of the magnets: less the background.
    amplitude_t : (n, N) ndarray
        Its magnitude, smoothed.
    kernel : (k,) ndarray
        That smooths.
    noise_t : (N,) ndarray
        Standard deviation of a sample, rms over the axes.
    """

    field_t: Array
    amplitude_t: Array
    kernel: Array
    noise_t: Array

    def less(self, field_t: Array) -> Signals:
        """The same with a field (n, N, 3) taken away."""
        field = self.field_t - field_t
        # The vector itself must not be smoothed: above a magnet it turns within millimetres.
        amplitude = _smoothed(np.linalg.norm(field, axis=-1), self.kernel)
        return replace(self, field_t=field, amplitude_t=amplitude)

    def part(self, first: int, stop: int) -> Signals:
        """Samples ``first`` to ``stop - 1``."""
        rows = slice(first, stop)
        return replace(self, field_t=self.field_t[rows], amplitude_t=self.amplitude_t[rows])


@dataclass(frozen=True)
class Peak:
    """One sensor's amplitude at its largest.

    Attributes
    ----------
    sensor : int
    at : float
        The sample, with its fraction: where the first derivative crosses zero.
    amplitude_t : float
    """

    sensor: int
    at: float
    amplitude_t: float


def signals(samples: Samples, width: float) -> Signals:
    """A recording less the field of its quiet start, the amplitude smoothed by a Gaussian of
    standard deviation ``width`` in samples.

    Lost samples are put on the line between their neighbours.

    Raises
    ------
    InputError
        The recording is too short.
    """
    if len(samples) < 2 * FEWEST:
        raise InputError(f"{len(samples)} samples are too few to find magnets in")
    field = _filled(samples.field_t)
    # Second differences: magnets are smooth from sample to sample, noise is not.
    second = np.abs(np.diff(field, 2, axis=0))
    noise = 1.4826 * np.median(second, axis=0) / np.sqrt(6.0)
    raw = Signals(
        field_t=field,
        amplitude_t=field[..., 0],
        kernel=_gaussian(width),
        noise_t=np.sqrt(np.mean(noise**2, axis=-1)),
    )
    return raw.less(field[: _quiet(field, noise)].mean(axis=0))


def find_peaks(signal: Signals, reach: float) -> list[Peak]:
    """Peaks of all sensors, strongest first.

    A magnet counts where it is nearest: a peak at which a neighbouring sensor measures more
    is left out. ``reach`` is how far before and behind a peak its slopes are looked for, in
    samples.
    """
    amplitude = signal.amplitude_t
    slope = np.gradient(amplitude, axis=0)
    tall = HEIGHT * np.linalg.norm(signal.kernel) * signal.noise_t
    steep = STEEPNESS * np.linalg.norm(np.gradient(np.pad(signal.kernel, 2))) * signal.noise_t
    beside = np.pad(amplitude, ((0, 0), (1, 1)))
    top = (amplitude >= tall) & (amplitude >= beside[:, :-2]) & (amplitude >= beside[:, 2:])
    top[1:] &= amplitude[1:] >= amplitude[:-1]
    top[:-1] &= amplitude[:-1] > amplitude[1:]
    top[0] = top[-1] = False
    span = max(int(np.ceil(reach)), 1)
    found = []
    for k, sensor in np.argwhere(top):
        rise = slope[max(k - span, 0) : k + 1, sensor].max()
        fall = slope[k : k + span + 1, sensor].min()
        if rise >= steep[sensor] and fall <= -steep[sensor]:
            found.append(_peak(amplitude, int(k), int(sensor)))
    return sorted(found, key=lambda peak: -peak.amplitude_t)


def peak_near(signal: Signals, peak: Peak, reach: float) -> Peak:
    """The peak of the same sensor within ``reach`` samples; where the amplitude has none
    there, ``peak`` at the amplitude that it now has."""
    amplitude = signal.amplitude_t
    here, span = round(peak.at), max(int(reach), 1)
    first = max(here - span, 0)
    k = first + int(amplitude[first : here + span + 1, peak.sensor].argmax())
    inside = max(first, 1) <= k <= min(here + span, len(amplitude) - 2)
    before, top, after = amplitude[k - 1 : k + 2, peak.sensor] if inside else (0.0, 0.0, 0.0)
    if before <= top > after:
        return _peak(amplitude, k, peak.sensor)
    return replace(peak, amplitude_t=float(amplitude[here, peak.sensor]))


def ground(signal: Signals, peaks: Sequence[Peak], clear: float, over: float) -> Array:
    """Field (n, N, 3) that is there between magnets.

    The mean of what lies within ``over`` samples and farther than ``clear`` samples from
    every peak; on the line between such ground where there is none, and zero where there is
    none at all. The quiet start alone does not do: motors and the turning Earth field move
    the background by some microtesla on the way to a tag.
    """
    index = np.arange(len(signal.field_t))
    free = np.ones(len(index), bool)
    for peak in peaks:
        free &= np.abs(index - peak.at) > clear
    if free.sum() < FEWEST:
        return np.zeros_like(signal.field_t)
    sums = np.zeros((len(index) + 1, *signal.field_t.shape[1:]))
    np.cumsum(np.where(free[:, None, None], signal.field_t, 0.0), axis=0, out=sums[1:])
    counts = np.concatenate([[0], np.cumsum(free)])
    span = max(int(over), FEWEST // 2)
    first, stop = np.maximum(index - span, 0), np.minimum(index + span + 1, len(index))
    number = counts[stop] - counts[first]
    mean = (sums[stop] - sums[first]) / np.maximum(number, 1)[:, None, None]
    known = np.flatnonzero(free & (number >= min(span, FEWEST // 2)))
    right = np.searchsorted(known, index).clip(1, max(len(known) - 1, 1))
    left, right = known[right - 1], known[np.minimum(right, len(known) - 1)]
    share = ((index - left) / np.maximum(right - left, 1)).clip(0, 1)[:, None, None]
    return np.asarray(mean[left] * (1 - share) + mean[right] * share)


def _peak(amplitude: Array, k: int, sensor: int) -> Peak:
    before, top, after = amplitude[k - 1 : k + 2, sensor]
    at = k + (after - before) / (2 * (2 * top - before - after))
    return Peak(sensor, float(at), float(top))


def _filled(field: Array) -> Array:
    filled = np.array(field, float)
    index = np.arange(len(field))
    for sensor in range(field.shape[1]):
        good = np.isfinite(field[:, sensor]).all(axis=-1)
        if not good.all():
            for axis in range(3):
                filled[:, sensor, axis] = np.interp(index, index[good], field[good, sensor, axis])
    return filled


def _gaussian(width: float) -> Array:
    half = int(np.ceil(3 * width))
    kernel = np.exp(-0.5 * (np.arange(-half, half + 1) / width) ** 2)
    return np.asarray(kernel / kernel.sum())


def _smoothed(series: Array, kernel: Array) -> Array:
    """Series (n, ...) convolved along the first axis, the ends held."""
    half = len(kernel) // 2
    padded = np.pad(series, [(half, half), *[(0, 0)] * (series.ndim - 1)], mode="edge")
    return np.asarray(sum(w * padded[k : k + len(series)] for k, w in enumerate(kernel)))


def _quiet(field: Array, noise: Array) -> int:
    """Samples of the start over which no sensor sees a magnet: the first half of those,
    because the field rises before it is noticed."""
    block = _smoothed(field - field[:FEWEST].mean(axis=0), np.full(FEWEST, 1 / FEWEST))
    stirred = (np.abs(block) > QUIET * noise * np.sqrt(2 / FEWEST)).any(axis=(1, 2))
    quiet = int(stirred.argmax()) if stirred.any() else len(field)
    return max(quiet // 2, FEWEST)
