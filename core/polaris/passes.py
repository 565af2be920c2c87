"""Where in a recording the array passed over magnets, and how noisy its samples are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.polaris.array import Samples

Array = NDArray[np.float64]

LAGS = (1, 2, 4, 8, 16)
"""Samples over which a change of the field is looked for: for fast robots and slow ones."""

ACTIVE = 8.0
"""A sample is active where the bar's field changes by so much more than noise does, in
standard deviations of the sum of squares over the bar."""

LEAST_NOISE_T = 2e-8
"""What a bar without noise and without a known quantum is taken to have."""

FEWEST = 20
"""Samples from which a sensor's noise can be told."""

_QUANTILE, _NORMAL = 0.3, 0.38532
"""A quantile of the absolute value of a normal distribution: low, so that passes over
magnets may fill most of a recording."""


@dataclass(frozen=True)
class Pass:
    """Samples ``first`` to ``stop - 1``, in which magnets were near."""

    first: int
    stop: int


def noise(samples: Samples) -> Array:
    """Standard deviation (N, 3) of the noise of each sensor and axis, in tesla.

    From second differences, most of which a smooth field hardly changes; as stated by the
    array where there are too few samples.
    """
    stated = np.broadcast_to(samples.array.noise_t, (len(samples.array), 3))
    least = np.maximum(samples.array.quantum_t / 4, LEAST_NOISE_T)
    bend = np.abs(np.diff(samples.field_t, n=2, axis=0))
    usable = np.isfinite(bend).sum(axis=0)
    found = np.array(stated)
    if len(bend) >= FEWEST:
        ordered = np.sort(np.where(np.isfinite(bend), bend, np.inf), axis=0)
        rank = (_QUANTILE * usable).astype(int)
        value = np.take_along_axis(ordered, rank[None], axis=0)[0] / _NORMAL / np.sqrt(6)
        found = np.where(usable >= FEWEST, value, stated)
    # A sensor that gave nothing is taken for one like the others.
    known = np.isfinite(found)
    for axis in range(3):
        usual = np.median(found[known[:, axis], axis]) if known[:, axis].any() else 0.0
        found[~known[:, axis], axis] = usual
    return np.maximum(found, least)


def activity(samples: Samples, noise_t: Array) -> Array:
    """How much the field along the bar changes around each sample (n,), in standard
    deviations of what noise makes of it.

    A field that all sensors share (the Earth's, while the robot turns) does not count.
    """
    n = len(samples)
    scaled = samples.field_t / noise_t
    there = np.isfinite(scaled)
    scaled = np.nan_to_num(scaled)
    freedom = 3 * len(samples.array)
    if len(samples.array) > 2:
        number = np.maximum(there.sum(axis=1, keepdims=True), 1)
        scaled = np.where(there, scaled - scaled.sum(axis=1, keepdims=True) / number, 0.0)
        freedom -= 3
    best = np.zeros(n)
    for lag in LAGS:
        if lag >= n:
            break
        change = ((scaled[lag:] - scaled[:-lag]) ** 2).sum(axis=(1, 2)) / 2
        z = (change - freedom) / np.sqrt(2 * freedom)
        start = lag // 2
        best[start : start + n - lag] = np.maximum(best[start : start + n - lag], z)
    return best


def find(samples: Samples, noise_t: Array) -> list[Pass]:
    """Passes of a recording, in order of time; none where nothing has changed."""
    active = activity(samples, noise_t) > ACTIVE
    at = np.flatnonzero(active)
    if len(at) == 0:
        return []
    found: list[Pass] = []
    for group in np.split(at, np.flatnonzero(np.diff(at) > max(LAGS)) + 1):
        first, stop = int(group[0]), int(group[-1]) + 1
        pad = max(10, (stop - first) // 6)
        first, stop = max(0, first - pad), min(len(samples), stop + pad)
        if found and first <= found[-1].stop:
            found[-1] = Pass(found[-1].first, stop)
        else:
            found.append(Pass(first, stop))
    return found
