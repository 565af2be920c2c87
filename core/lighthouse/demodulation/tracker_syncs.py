"""Estimate the phase of a rotor over time from the syncs that a tracker decoded.

A sync (line ``Y`` of a libsurvive recording) is the time at which a rotor was at its zero. The
tracker's hardware computes it from the bits of a sweep. It is accurate to some ticks, and sometimes
late, missing or wrong. libsurvive subtracts the latest one from the timecode of a sweep and divides
by the latest interval (``survive_process_gen2.c``).

Here a line through all syncs decides which are inliers. Rotors do not rotate uniformly: their
control loop lets them wander by 10 to 20 ticks (0.1 mrad) within a few rotations. The zeros are
therefore not replaced by the line. They are smoothed over five rotations, and the phase of a sweep
is interpolated between the zeros before and after it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.demodulation.ootx import MISSING_BIT

Array = NDArray[np.float64]

MAX_PERIOD_DEVIATION_PPM = 300.0
"""Largest deviation of a rotation from nominal: resonators of station and tracker."""

MAX_SYNC_LAG = 3
"""The period is measured from a sync to each of this many next ones."""

MAX_LAG_ROTATIONS = 5
"""Longer intervals between syncs do not contribute to the period."""

PHASE_WINDOW_ROTATIONS = 500
"""Rotations over which the phase is estimated as a constant."""

PHASE_HISTOGRAM_BINS = 64
"""Number of bins of the histogram of phases."""

MAX_PHASE_OFFSET_TICKS = 400.0
"""A sync farther from the phase of its window is an outlier, in ticks of 48 MHz."""

MIN_SYNCS = 4
"""Number of inliers that a rotor needs."""

MAX_JUMP_TICKS = 100.0
"""A sync farther from the median of its neighbours is an outlier, in ticks of 48 MHz."""

SMOOTHING_WEIGHTS = np.array([-3.0, 12.0, 17.0, 12.0, -3.0]) / 35.0
"""Weights of a parabola through five rotations, at its middle (Savitzky and Golay, 1964)."""

MAX_SYNC_DISTANCE_ROTATIONS = 50
"""The phase of a rotor is known for at most this long after a sync, or before the next."""

MAX_BIT_GAP_ROTATIONS = 600
"""Longer gaps are shortened to this number of missing slow bits, which is longer than a frame of
factory data."""


@dataclass(frozen=True)
class TrackerRotor:
    """Rotor of one station, in ticks of one tracker's counter.

    Attributes
    ----------
    period_tick : float
        Mean duration of a rotation.
    zero_tick : (n,) float64 ndarray
        Times at which the rotor was at its zero, ascending.
    rotation : (n,) int64 ndarray
        Rotation number of each zero.
    slow_bit : (n,) int8 ndarray
        Slow bit of each rotation; -1 if two syncs differ.
    rejected : int
        Number of syncs that are outliers.
    """

    period_tick: float
    zero_tick: Array
    rotation: NDArray[np.int64]
    slow_bit: NDArray[np.int8]
    rejected: int

    def phase_and_bit(self, tick: Array) -> tuple[Array, NDArray[np.int64]]:
        """Return the phase (0 to 1 rotation) and the slow bit at each of ``tick`` (n,).

        The phase is ``nan`` if no sync is near. The bit is -1 then, and in rotations without
        sync.
        """
        zero, rotation = self.zero_tick, self.rotation
        preceding = np.searchsorted(zero, tick, "right") - 1
        interval = np.clip(preceding, 0, len(zero) - 2)
        period = (zero[interval + 1] - zero[interval]) / (
            rotation[interval + 1] - rotation[interval]
        )
        is_outside = (preceding < 0) | (preceding >= len(zero) - 1)
        nearest = np.clip(preceding, 0, len(zero) - 1)
        phase = (tick - zero[nearest]) / np.where(is_outside, self.period_tick, period)
        distance = np.minimum(
            np.abs(tick - zero[nearest]),
            np.abs(zero[np.minimum(nearest + 1, len(zero) - 1)] - tick),
        )
        is_known = distance < MAX_SYNC_DISTANCE_ROTATIONS * self.period_tick
        whole = np.floor(phase)
        bit = np.where(is_known & (whole == 0), self.slow_bit[nearest], MISSING_BIT)
        return np.where(is_known, phase - whole, np.nan), bit.astype(np.int64)

    def slow_bits(self) -> NDArray[np.int8]:
        """Return the slow bits, one per rotation, -1 if it is missing; long gaps are shortened."""
        step = np.minimum(np.diff(self.rotation, prepend=self.rotation[:1]), MAX_BIT_GAP_ROTATIONS)
        position = np.cumsum(step)
        bits = np.full(int(position[-1]) + 1, MISSING_BIT, np.int8)
        bits[position] = self.slow_bit
        return bits


def fit_rotor(tick: Array, bit: NDArray[np.int32], nominal_tick: float) -> TrackerRotor | None:
    """Fit the rotor that most syncs of one channel agree on.

    Parameters
    ----------
    tick : (n,) float64 ndarray
        Unwrapped ticks of the syncs, in any order.
    bit : (n,) int ndarray
        Slow bit of each, 0 or 1.
    nominal_tick : float
        Nominal duration of a rotation of the channel, in ticks.

    Returns
    -------
    TrackerRotor or None
        None if fewer than four syncs agree.
    """
    order = np.argsort(tick, kind="stable")
    base = float(tick[order[0]]) if len(tick) else 0.0
    time, bit = tick[order] - base, bit[order]
    period = _estimate_period(time, nominal_tick)
    if period is None:
        return None
    rotation, offset = _number_rotations(time, period)
    is_inlier = np.abs(offset) * period < MAX_PHASE_OFFSET_TICKS
    if np.count_nonzero(is_inlier) < MIN_SYNCS:
        return None
    is_inlier &= _is_near_median(time - rotation * period, is_inlier)
    kept = np.flatnonzero(is_inlier)
    kept, bit = _merge_rotations(kept, rotation, bit)
    is_later = np.diff(np.maximum.accumulate(time[kept]), prepend=-1.0) > 0
    kept = kept[is_later]
    if len(kept) < MIN_SYNCS:
        return None
    rotation = rotation[kept]
    line = np.polyfit(rotation, time[kept], 1)
    wander = _smooth_wander(time[kept] - np.polyval(line, rotation), rotation)
    zero = base + np.polyval(line, rotation) + wander
    rejected = len(tick) - int(np.count_nonzero(is_inlier))
    return TrackerRotor(float(line[0]), zero, rotation, bit[kept].astype(np.int8), rejected)


def _estimate_period(time: Array, nominal_tick: float) -> float | None:
    """Return the mean duration of a rotation from nearby syncs; None if there are too few."""
    # Intervals to later syncs are included, because a sync of a second rotor, or a wrong one, may
    # be in between.
    interval = np.concatenate([time[lag:] - time[:-lag] for lag in range(1, MAX_SYNC_LAG + 1)])
    rotations = np.rint(interval / nominal_tick)
    is_near = (rotations >= 1) & (rotations <= MAX_LAG_ROTATIONS)
    period = interval[is_near] / rotations[is_near]
    period = period[np.abs(period / nominal_tick - 1) < MAX_PERIOD_DEVIATION_PPM * 1e-6]
    if len(period) < MIN_SYNCS - 1:
        return None
    return float(np.mean(period[np.abs(period - np.median(period)) < MAX_JUMP_TICKS]))


def _number_rotations(time: Array, period: float) -> tuple[NDArray[np.int64], Array]:
    """Return the rotation number of each sync, and its offset from the phase of its window."""
    rotations = time / period
    window = (rotations // PHASE_WINDOW_ROTATIONS).astype(np.int64)
    starts = np.flatnonzero(np.diff(window, prepend=-1))
    phases = np.array([_dominant_phase(part % 1.0) for part in np.split(rotations, starts[1:])])
    size = np.diff(np.append(starts, len(time)))
    # Windows with a few wrong syncs have no reliable phase. It is interpolated between windows
    # with many syncs.
    is_full = size >= min(max(MIN_SYNCS, int(np.median(size)) // 4), size.max())
    number = window[starts].astype(float)
    smooth = np.interp(number, number[is_full], np.unwrap(phases[is_full], period=1.0))
    phase = np.repeat(smooth, size)
    rotation = np.rint(rotations - phase)
    return rotation.astype(np.int64), rotations - phase - rotation


def _dominant_phase(phase: Array) -> float:
    """Return the phase (0 to 1) around which most syncs are."""
    bins = PHASE_HISTOGRAM_BINS
    histogram = np.bincount((phase * bins).astype(np.int64) % bins, minlength=bins)
    centre = (np.argmax(histogram + np.roll(histogram, -1)) + 1) / bins
    offset = (phase - centre + 0.5) % 1.0 - 0.5
    return float(centre + np.median(offset[np.abs(offset) <= 1.01 / bins]))


def _is_near_median(residual: Array, is_inlier: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return a mask of the inliers that are near the median of the five around them."""
    kept = np.flatnonzero(is_inlier)
    padded = np.pad(residual[kept], 2, mode="edge")
    median = np.median(np.lib.stride_tricks.sliding_window_view(padded, 5), axis=1)
    is_near = np.zeros(len(residual), bool)
    is_near[kept] = np.abs(residual[kept] - median) < MAX_JUMP_TICKS
    return is_near


def _merge_rotations(
    kept: NDArray[np.int64], rotation: NDArray[np.int64], bit: NDArray[np.int32]
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Keep one sync per rotation; if two of a rotation have different bits, the bit is missing."""
    first, inverse = np.unique(rotation[kept], return_index=True, return_inverse=True)[1:]
    conflicting = np.unique(kept[first][inverse[bit[kept] != bit[kept[first]][inverse]]])
    bit = bit.copy()
    bit[conflicting] = MISSING_BIT
    return kept[first], bit


def _smooth_wander(wander: Array, rotation: NDArray[np.int64]) -> Array:
    """Smooth the wander of rotations whose two predecessors and two successors are present."""
    if len(wander) < len(SMOOTHING_WEIGHTS):
        return wander
    smooth = wander.copy()
    has_neighbours = rotation[4:] - rotation[:-4] == 4
    smooth[2:-2][has_neighbours] = np.convolve(wander, SMOOTHING_WEIGHTS, "valid")[has_neighbours]
    return smooth
