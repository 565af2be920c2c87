"""Keyframes: averaged standstills of photodiodes, and their selection for bundle adjustment.

A robot at a standstill repeats its measurement. Its epochs inform a scene as one keyframe whose
angles are averaged, not as many: the scene becomes more accurate and is solved faster. Of the
keyframes some take part in the bundle adjustment and others are held out to verify the scene.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

STANDSTILL_ANGLE_RAD = 6e-4
"""Largest change of a rotor angle between epochs of a photodiode at a standstill: eleven LFSR
steps, or five standard deviations of an angle in the published recordings of the DotBot; 1 mm at
2 m."""

MIN_RAY_SEPARATION_RAD = 1e-3
"""Smallest difference (as a tangent) between the rays of two distinct positions: 2 mm at 2 m."""

MIN_LINE_WIDTH_RATIO = 0.01
"""Rays whose extent across their main direction is a smaller fraction of that along it are on one
line, which does not determine a scene."""

HELD_OUT_INTERVAL = 5
"""One keyframe of this many is held out."""

MIN_KEYFRAMES_FOR_HOLD_OUT = 200
"""Nothing is held out of fewer keyframes: all of them are needed to estimate the scene."""


def average_standstills(
    angles: Array, device: NDArray[np.int64]
) -> tuple[Array, NDArray[np.int64]]:
    """Average runs of consecutive epochs with equal angles into keyframes.

    Parameters
    ----------
    angles : (m, s, 2) ndarray
        Rotor angles in radians, ordered by device and time; ``nan`` without a sweep.
    device : (m,) int ndarray

    Returns
    -------
    keyframes : (k, s, 2) ndarray
        Mean angles of each run; k <= m.
    run : (m,) int ndarray
        Index of the keyframe of each epoch.
    """
    m = len(angles)
    if m == 0:
        return angles, np.zeros(0, np.int64)
    flat = angles.reshape(m, -1)
    is_observed = np.isfinite(flat)
    step = np.abs(np.diff(flat, axis=0))
    moved = np.any(np.nan_to_num(step) > STANDSTILL_ANGLE_RAD, axis=1)
    moved |= np.any(is_observed[1:] != is_observed[:-1], axis=1)
    run = np.cumsum(np.r_[0, moved | (np.diff(device) != 0)])
    # A slow drift links epochs whose angles differ by far more than a step: split such runs.
    first = np.flatnonzero(np.r_[True, np.diff(run) != 0])
    spread = np.maximum.reduceat(flat, first) - np.minimum.reduceat(flat, first)
    is_drifting = np.any(np.nan_to_num(spread) > 2 * STANDSTILL_ANGLE_RAD, axis=1)
    run = np.cumsum(np.r_[0, (np.diff(run) != 0) | is_drifting[run[1:]]])
    first = np.flatnonzero(np.r_[True, np.diff(run) != 0])
    size = np.bincount(run)[:, None]
    keyframes = np.add.reduceat(flat, first) / size
    return keyframes.reshape(-1, *angles.shape[1:]), run


def require_distinct_positions(a: Array, b: Array, number: int) -> None:
    """Raise an error if two stations cannot be estimated from these rays.

    Parameters
    ----------
    a, b : (n, 3) ndarray
        Rays (1, y, z) from two stations to the same photodiodes.
    number : int
        Required number of distinct positions.

    Raises
    ------
    DegenerateError
        The photodiodes were at a standstill, at too few positions, or all on one line.
    """
    image = np.c_[a[:, 1:], b[:, 1:]]
    if len(image) == 0 or np.max(np.ptp(image, axis=0)) < 3 * MIN_RAY_SEPARATION_RAD:
        raise DegenerateError(
            "the photodiodes stood still: one position does not determine a scene",
            hint="drive around while recording",
        )
    count = _count_distinct(image, number)
    if count < number:
        raise DegenerateError(
            f"{count} positions shared by two stations do not determine a scene",
            hint=f"record at least {number} positions, better 20",
        )
    for view in (image[:, :2], image[:, 2:]):
        spread = np.linalg.svd(view - view.mean(axis=0), compute_uv=False) / np.sqrt(len(view))
        if spread[1] < max(MIN_RAY_SEPARATION_RAD, MIN_LINE_WIDTH_RATIO * spread[0]):
            raise DegenerateError(
                "all positions are on one line, which does not determine a scene",
                hint="drive a curve while recording",
            )


def _count_distinct(image: Array, limit: int) -> int:
    """Count the points (n, 4) that differ by :data:`MIN_RAY_SEPARATION_RAD`, up to ``limit``."""
    remaining, count = image, 0
    while len(remaining) and count < limit:
        count += 1
        distance = np.max(np.abs(remaining - remaining[0]), axis=1)
        remaining = remaining[distance > MIN_RAY_SEPARATION_RAD]
    return count


def spread_evenly(is_observed: NDArray[np.bool_], usable: Indices, limit: int) -> Indices:
    """Select keyframes evenly from each set of stations that shares keyframes.

    The keyframes that link two groups of stations can be few among many. Of each set of stations
    with common keyframes the same number is therefore taken, as far as the set has so many.

    Parameters
    ----------
    is_observed : (m, s) bool ndarray
        True if a station was received in a keyframe.
    usable : (k,) int ndarray
        Indices of the keyframes to select from, ascending.
    limit : int
        Largest number of selected keyframes; exceeded only to take one of each set.

    Returns
    -------
    (n,) int ndarray
        Ascending.
    """
    if len(usable) <= limit:
        return usable
    group = _station_sets(is_observed, usable)
    size = np.bincount(group)
    # Take small sets completely and divide the remainder among the larger ones.
    remaining, quota = limit, np.zeros(len(size), np.int64)
    for done, k in enumerate(np.argsort(size, kind="stable")):
        quota[k] = max(1, min(size[k], remaining // (len(size) - done)))
        remaining -= quota[k]
    order = np.argsort(group, kind="stable")
    first = np.cumsum(size) - size
    chosen = [
        order[first[k] + np.unique(np.linspace(0, size[k] - 1, quota[k]).astype(int))]
        for k in range(len(size))
    ]
    return usable[np.sort(np.concatenate(chosen))]


def split_held_out(is_observed: NDArray[np.bool_], usable: Indices) -> tuple[Indices, Indices]:
    """Split keyframes into those for the estimation and those held out for verification.

    One of :data:`HELD_OUT_INTERVAL` is held out of each set of stations that shares keyframes, so
    that each set is verified; none if there are fewer than :data:`MIN_KEYFRAMES_FOR_HOLD_OUT`.
    Parameters as for :func:`spread_evenly`.

    Returns
    -------
    used, held_out : int ndarray
    """
    is_held_out = np.zeros(len(usable), bool)
    if len(usable) >= MIN_KEYFRAMES_FOR_HOLD_OUT:
        group = _station_sets(is_observed, usable)
        order = np.argsort(group, kind="stable")
        is_first = np.r_[True, np.diff(group[order]) != 0]
        start = np.flatnonzero(is_first)[np.cumsum(is_first) - 1]
        rank = np.empty(len(usable), np.int64)
        rank[order] = np.arange(len(usable)) - start
        is_held_out = rank % HELD_OUT_INTERVAL == HELD_OUT_INTERVAL - 1
    return usable[~is_held_out], usable[is_held_out]


def _station_sets(is_observed: NDArray[np.bool_], usable: Indices) -> Indices:
    """Number the set of stations of each usable keyframe, from 0."""
    code = is_observed[usable] @ (1 << np.arange(is_observed.shape[1], dtype=np.int64))
    return np.asarray(np.unique(code, return_inverse=True)[1], np.int64).reshape(-1)
