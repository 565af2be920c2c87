"""Moments at a standstill, gathered into places.

A robot that stands still repeats itself: its moments inform a scene as one place whose
angles are averaged, not as many places. That makes a scene both sharper and faster to solve.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError

Array = NDArray[np.float64]

STILL = 6e-4
"""Rotor angle by which a standing photodiode may seem to move, in radians: eleven LFSR
steps, five standard deviations of the published scatter; a millimetre at 2 m."""


SAME_PLACE = 1e-3
"""Rays closer than this (as tangents) saw one place: 2 mm at 2 m."""


def average_standstills(
    angles: Array, device: NDArray[np.int64]
) -> tuple[Array, NDArray[np.int64]]:
    """Average runs of consecutive moments that saw the same angles.

    Parameters
    ----------
    angles : (m, s, 2) ndarray
        Rotor angles in radians, ordered by device and time; ``nan`` where not seen.
    device : (m,) int ndarray

    Returns
    -------
    places : (k, s, 2) ndarray
        Mean angles of each run; k <= m.
    run : (m,) int ndarray
        The place of each moment.
    """
    m = len(angles)
    if m == 0:
        return angles, np.zeros(0, np.int64)
    flat = angles.reshape(m, -1)
    seen = np.isfinite(flat)
    step = np.abs(np.diff(flat, axis=0))
    moved = np.any(np.nan_to_num(step) > STILL, axis=1) | np.any(seen[1:] != seen[:-1], axis=1)
    run = np.cumsum(np.r_[0, moved | (np.diff(device) != 0)])
    # A slow drift chains moments that are far apart: such runs are not standstills.
    first = np.flatnonzero(np.r_[True, np.diff(run) != 0])
    spread = np.maximum.reduceat(flat, first) - np.minimum.reduceat(flat, first)
    drifting = np.any(np.nan_to_num(spread) > 2 * STILL, axis=1)
    run = np.cumsum(np.r_[0, (np.diff(run) != 0) | drifting[run[1:]]])
    first = np.flatnonzero(np.r_[True, np.diff(run) != 0])
    size = np.bincount(run)[:, None]
    places = np.add.reduceat(flat, first) / size
    return places.reshape(-1, *angles.shape[1:]), run


def require_distinct_positions(a: Array, b: Array, number: int) -> None:
    """Refuse what cannot determine two stations.

    Parameters
    ----------
    a, b : (n, 3) ndarray
        Rays (1, y, z) in which two stations saw the same photodiodes.
    number : int
        Distinct places that are needed.

    Raises
    ------
    DegenerateError
        The photodiodes stood still, at too few places, or all on one line.
    """
    image = np.c_[a[:, 1:], b[:, 1:]]
    if len(image) == 0 or np.max(np.ptp(image, axis=0)) < 3 * SAME_PLACE:
        raise DegenerateError(
            "the photodiodes stood still: one place does not determine a scene",
            hint="drive around while recording",
        )
    places = _count_places(image, number)
    if places < number:
        raise DegenerateError(
            f"{places} places seen by two stations do not determine a scene",
            hint=f"record at least {number} places, better 20",
        )
    for view in (image[:, :2], image[:, 2:]):
        spread = np.linalg.svd(view - view.mean(axis=0), compute_uv=False) / np.sqrt(len(view))
        if spread[1] < max(SAME_PLACE, 0.01 * spread[0]):
            raise DegenerateError(
                "all places lie on one line, which does not determine a scene",
                hint="drive a curve while recording",
            )


def _count_places(image: Array, enough: int) -> int:
    """How many points (n, 4) differ by more than :data:`SAME_PLACE`, up to ``enough``."""
    left, found = image, 0
    while len(left) and found < enough:
        found += 1
        left = left[np.max(np.abs(left - left[0]), axis=1) > SAME_PLACE]
    return found
