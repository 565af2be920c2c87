"""A pass, made ready for the fit: samples in groups, on a clock, with what is known before.

Samples between which the field has not changed are one measurement: a robot that drives
slowly or stands still gives no more samples than the field needs. Of a robot that stood
still the clock may stop as well.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.polaris.array import Samples
from locatk.core.polaris.detection.field_model import thickness
from locatk.core.polaris.detection.window import Priors, Window
from locatk.core.polaris.passes import Pass
from locatk.core.polaris.tag import Tags

Array = NDArray[np.float64]

HEIGHTS_M = (0.005, 0.0075, 0.011, 0.016)
"""Tried where no tag tells the clearance."""

MOMENT_AM2 = 1.5e-3
"""Expected where no tag tells the magnet."""

FEW = 120
"""A pass of no more samples is taken as it is."""

MOST_GROUPS = 320

CHANGED = 3.5
"""The field has changed when its squared difference, summed over the bar, exceeds what
noise makes of it by so many standard deviations."""

STANDING = 12
"""Samples in one group from which on the array may have stood still."""

APART = 0.5
"""Least distance of two magnets, in spacings; where that is unknown, in heights."""


@dataclass(frozen=True)
class Task:
    """A pass, ready to be fitted.

    Attributes
    ----------
    window : Window
        One entry a group of samples.
    scaled : (G, 3 N) ndarray
        Fields in units of a sample's noise, on a straight background through the ends.
    priors : tuple of Priors
        One for each height to try.
    first : int
        Number in the recording of the pass's first sample.
    times : (G,) ndarray
        Of the groups, in samples since ``first``.
    samples : int
        Of the pass.
    path_m : (samples,) ndarray or None
        How far the array has moved at each of them, where that is known.
    apart_m : float
        Least distance of two magnets.
    most : int
        Magnets and other sources that there can be.
    """

    window: Window
    scaled: Array
    priors: tuple[Priors, ...]
    first: int
    times: Array
    samples: int
    path_m: Array | None
    apart_m: float
    most: int


def prepare(
    samples: Samples,
    part: Pass,
    noise_t: Array,
    tags: Tags | None,
    path_m: Array | None = None,
) -> Task:
    """The samples of a pass as the fit takes them.

    Parameters
    ----------
    noise_t : (N, 3) ndarray
        Of one sample.
    path_m : (n,) ndarray, optional
        How far the array had moved at each sample of the recording.
    """
    at = slice(part.first, part.stop)
    field = samples.field_t[at]
    usual_ns = period_ns(samples)
    frames = (samples.time_ns[at] - samples.time_ns[part.first]) / usual_ns
    starts = _groups(np.nan_to_num(field / noise_t).reshape(len(field), -1))
    counts = np.diff(np.append(starts, len(field)))
    # Sums and numbers of what is there: a group lacks a sensor where all its samples do.
    there = np.isfinite(field)
    number = np.add.reduceat(there, starts, axis=0, dtype=float)
    with np.errstate(invalid="ignore"):
        means = np.add.reduceat(np.where(there, field, 0.0), starts, axis=0) / number

    def mean(values: Array) -> Array:
        return np.asarray(np.add.reduceat(values, starts) / counts)

    delay = samples.array.delay_s
    middle, half = (delay.max() + delay.min()) / 2, np.ptp(delay) / 2
    magnet = None if tags is None else tags.magnet
    window = Window(
        field_t=means,
        sensors_m=samples.array.position_m,
        noise_t=noise_t,
        frames=mean(frames),
        counts=counts,
        order=(delay - middle) / half if half > 0 else np.zeros(3),
        path_m=None if path_m is None else mean(path_m[at]),
        thickness_m2=thickness(magnet),
    )
    heights = HEIGHTS_M if tags is None else (tags.clearance_m,)
    priors = tuple(
        Priors(
            height_m=(height, 0.3 * height),
            skew=(half * 1e9 / usual_ns, 0.3),
            moment_am2=MOMENT_AM2 if magnet is None else magnet.moment,
        )
        for height in heights
    )
    return Task(
        window,
        _level(means / noise_t),
        priors,
        part.first,
        mean(np.arange(len(field), dtype=float)),
        len(field),
        None if path_m is None else path_m[at],
        APART * (heights[0] if tags is None else tags.spacing_m),
        12 if tags is None else 2 * tags.magnets + 4,
    )


def period_ns(samples: Samples) -> float:
    """Usual time from one sample to the next; the mean where a host stamped many at once."""
    usual = float(np.median(np.diff(samples.time_ns)))
    mean = float(samples.time_ns[-1] - samples.time_ns[0]) / (len(samples) - 1)
    return usual if usual > 0.2 * mean else mean


def _groups(scaled: Array) -> NDArray[np.intp]:
    """First samples of groups in which the field has not changed; ``scaled`` (n, C) is in
    units of the noise."""
    n, channels = scaled.shape
    if n <= FEW:
        return np.arange(n)
    limit = channels + CHANGED * np.sqrt(2 * channels)
    while True:
        starts = [0]
        for k in range(1, n):
            change = scaled[k] - scaled[starts[-1]]
            if change @ change / 2 > limit:
                starts.append(k)
        if len(starts) <= MOST_GROUPS:
            return np.array(starts)
        limit *= 1.5


def _level(scaled: Array) -> Array:
    """Samples (n, 3 N) without the straight line through both ends; 0 where there is none."""
    n = len(scaled)
    flat = np.nan_to_num(scaled.reshape(n, -1))
    ends = max(1, min(8, n // 10))
    left, right = np.median(flat[:ends], axis=0), np.median(flat[-ends:], axis=0)
    share = np.linspace(0, 1, n)[:, None]
    return np.where(
        np.isfinite(scaled.reshape(n, -1)), flat - (1 - share) * left - share * right, 0
    )


def clocks(task: Task) -> Iterator[Task]:
    """The task as it is, and where the array may have stood still, or samples are missing
    for long, with the clock stopped meanwhile."""
    yield task
    window = task.window
    if window.path_m is not None:
        return
    standing = window.counts >= STANDING
    standing[[0, -1]] = False
    waited = np.where(standing, window.counts - 1.0, 0.0)
    silent = np.diff(window.frames) - (window.counts[1:] + window.counts[:-1]) / 2
    silent = np.where(silent > STANDING, silent, 0.0)
    if standing.any() or silent.any():
        stopped = np.cumsum(waited) - waited / 2 + np.append(0.0, np.cumsum(silent))
        yield replace(task, window=replace(window, frames=window.frames - stopped))
