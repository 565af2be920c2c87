"""Thinning of poses, lines and marks, so that a page stays small and extremes remain visible."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.formats.plots.units import format_count

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

MAX_POSES = 3000
"""Number of poses of all devices together that one figure shows."""

MIN_POSES_PER_DEVICE = 20
"""Number of poses that each device shows, however many others there are."""

SIGNAL_COLUMNS = 1000
"""A signal is drawn as its least and largest value in each of so many columns."""

MAX_MARKS = 2000
"""Number of marks of one kind in a figure; each is an element of the page."""

GAP_INTERVALS = 10.0
"""Factor of the usual interval of samples from which a line is interrupted."""


def thin(n: int, limit: int, peaks: Array | None = None) -> Indices:
    """Return the ascending indices of at most ``limit`` of ``n`` points.

    They are evenly spaced. If ``peaks`` (n,) are given, half of the points are those with the
    greatest value in their neighbourhood, so that outliers remain.
    """
    if n <= limit:
        return np.arange(n)
    if peaks is None:
        return np.unique(np.linspace(0, n - 1, limit).round().astype(np.int64))
    buckets = max(1, (limit - 1) // 2)
    edges = np.linspace(0, n, buckets + 1).astype(np.int64)
    bucket = np.searchsorted(edges, np.arange(n), side="right")
    order = np.lexsort((np.nan_to_num(peaks, nan=-np.inf), bucket))
    greatest = order[np.flatnonzero(np.diff(bucket[order], append=bucket.max() + 1))]
    return np.unique(np.concatenate([edges[:-1], greatest, [n - 1]]))


def allot_points(counts: Sequence[int], limit: int = MAX_POSES) -> list[int]:
    """Return how many points each device may show: all, or in proportion to its poses."""
    total = sum(counts)
    if total <= limit:
        return list(counts)
    return [max(MIN_POSES_PER_DEVICE, limit * count // total) for count in counts]


def thinning_note(shown: int, total: int, noun: str = "poses") -> str:
    """Return a sentence on how many poses are drawn; empty if all are."""
    if shown >= total:
        return ""
    return f"Drawn are {format_count(shown)} of {format_count(total, noun)}, including outliers."


def envelope(time_s: Array, value: NDArray[Any]) -> tuple[Array, NDArray[Any]]:
    """Return the extremes of a signal (n,) in each of :data:`SIGNAL_COLUMNS` equal parts.

    A short signal is returned unchanged. ``nan`` is inserted where samples are missing.
    """
    n = len(time_s)
    if n <= 2:
        return time_s, np.asarray(value)
    interval = float(np.median(np.diff(time_s)))
    if n > 2 * SIGNAL_COLUMNS:
        length = math.ceil(n / SIGNAL_COLUMNS)
        padded = np.full(math.ceil(n / length) * length, np.nan)
        padded[:n] = value
        parts = padded.reshape(-1, length)
        start = np.arange(len(parts)) * length
        low = np.where(np.isnan(parts), np.inf, parts).argmin(axis=1) + start
        high = np.where(np.isnan(parts), -np.inf, parts).argmax(axis=1) + start
        kept = np.sort(np.column_stack([low, high]), axis=1).ravel()
        interval = max(interval, (time_s[-1] - time_s[0]) / SIGNAL_COLUMNS / 5)
        time_s, value = time_s[kept], np.asarray(value)[kept]
    gaps = np.flatnonzero(np.diff(time_s) > GAP_INTERVALS * interval) + 1
    return np.insert(time_s, gaps, time_s[gaps]), np.insert(value, gaps, np.nan)


def column_maxima(time_s: Array, value: NDArray[Any]) -> tuple[Array, NDArray[Any]]:
    """Return the largest values of signals (n, k) in at most :data:`SIGNAL_COLUMNS` equal parts.

    Parts of ``nan`` are inserted where samples are missing, which a heatmap would fill.
    """
    starts = np.arange(0, len(time_s), math.ceil(len(time_s) / SIGNAL_COLUMNS))
    time_s, largest = time_s[starts], np.fmax.reduceat(value, starts, axis=0)
    if len(time_s) < 3:
        return time_s, largest
    step = float(np.median(np.diff(time_s)))
    gaps = np.flatnonzero(np.diff(time_s) > GAP_INTERVALS * step) + 1
    edges = np.column_stack([time_s[gaps - 1] + step, time_s[gaps] - step]).ravel()
    index = np.repeat(gaps, 2)
    return np.insert(time_s, index, edges), np.insert(largest, index, np.nan, axis=0)


def thin_marks(x: Array, y: Array) -> Indices:
    """Return the indices of at most :data:`MAX_MARKS` marks that do not cover each other."""
    n = len(x)
    if n <= MAX_MARKS:
        return np.arange(n)
    columns, rows = SIGNAL_COLUMNS, 200
    while True:
        cell = _bin_index(x, columns) * rows + _bin_index(y, rows)
        _, kept = np.unique(cell, return_index=True)
        if len(kept) <= MAX_MARKS or columns * rows < MAX_MARKS:
            return np.sort(kept)[:MAX_MARKS]
        columns, rows = columns * 3 // 4, max(rows * 3 // 4, 20)


def _bin_index(value: Array, bins: int) -> Indices:
    low, high = float(np.min(value)), float(np.max(value))
    return np.minimum((value - low) / ((high - low) or 1.0) * bins, bins - 1).astype(np.int64)
