"""What no sensor can have measured is taken out before anything is estimated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.polaris.array import Samples
from locatk.core.solution import SolverWarning

Array = NDArray[np.float64]

STUCK = 25
"""Samples in a row that are the same in all three axes: no noisy sensor repeats itself so."""

SPIKE = 10.0
"""A sample is a spike that is so many standard deviations of the noise away from its
neighbours, beyond what those differ by themselves."""

BESIDE = 2
"""Neighbours on each side."""


def cleaned(samples: Samples, noise_t: Array) -> tuple[Samples, tuple[SolverWarning, ...]]:
    """The samples without what was stuck, spiked or not finite, and what was left out.

    A sensor that repeats the same triple is stuck (a bus that hangs); a value far from
    those before and after it comes of a misframed message. Neither is rare (facts: the
    published bar has no sync word), and one of them outweighs a whole pass.
    """
    field = np.where(np.isfinite(samples.field_t), samples.field_t, np.nan)
    warnings = []
    stuck = _stuck(field)
    for sensor in np.flatnonzero(stuck.any(axis=0)):
        share = 100 * stuck[:, sensor].mean()
        message = f"sensor {sensor + 1} was stuck ({share:.0f} % of the time)"
        warnings.append(SolverWarning("sensor_stuck", message).about(samples.device))
    field = np.where(stuck[..., None], np.nan, field)
    spikes = _spikes(field, noise_t)
    if spikes.any():
        message = f"{int(spikes.sum())} values were spikes"
        warnings.append(SolverWarning("spikes", message).about(samples.device))
        field = np.where(spikes, np.nan, field)
    return replace(samples, field_t=field), tuple(warnings)


def _stuck(field: Array) -> NDArray[np.bool_]:
    """Where (n, N) a sensor repeats itself while others do not."""
    n, sensors, _ = field.shape
    stuck = np.zeros((n, sensors), bool)
    if n <= STUCK:
        return stuck
    same = np.all(np.diff(field, axis=0) == 0, axis=2)
    # Runs of STUCK - 1 equal steps, and all samples that belong to one.
    counts = np.cumsum(np.vstack([np.zeros((1, sensors), int), same]), axis=0)
    whole = counts[STUCK - 1 :] - counts[: -(STUCK - 1)] == STUCK - 1
    for sensor in np.flatnonzero(whole.any(axis=0)):
        for first in np.flatnonzero(whole[:, sensor]):
            stuck[first : first + STUCK, sensor] = True
    still = np.isfinite(field).all(axis=2)
    return stuck & ~np.all(stuck | ~still, axis=1, keepdims=True)


def _spikes(field: Array, noise_t: Array) -> NDArray[np.bool_]:
    """Values (n, N, 3) that are far from all their neighbours in time."""
    n = len(field)
    if n < 2 * BESIDE + 1:
        return np.zeros(field.shape, bool)
    padded = np.pad(field, ((BESIDE, BESIDE), (0, 0), (0, 0)), mode="reflect")
    beside = [
        padded[BESIDE + shift : BESIDE + shift + n] for shift in range(-BESIDE, BESIDE + 1) if shift
    ]
    high, low = np.fmax.reduce(beside), np.fmin.reduce(beside)
    away = np.fmax(field - high, low - field)
    with np.errstate(invalid="ignore"):
        return np.asarray(away > SPIKE * noise_t + (high - low))
