"""Which of a station's two planes a sweep was, told by the phase of its rotor.

Both planes pass once a rotation, the second about a third of a turn after the first. Where both
were received the earlier is the first. A single one is the plane whose neighbours in time were
at the same phase.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.epochs import MAX_PLANE_DELAY_TURNS, MIN_PLANE_DELAY_TURNS
from locatk.core.lighthouse.recording import UNKNOWN

Array = NDArray[np.float64]

NEAR_TURN = 0.03
"""A sweep this close to a plane's last and next ones is of that plane: 11 degrees in half a
second."""

NEAR_ROTATIONS = 25


def planes_of(rotation: NDArray[np.int64], place: Array) -> NDArray[np.int32]:
    """Plane of each sweep of one station on one photodiode.

    Parameters
    ----------
    rotation : (n,) int64 ndarray
        Ascending; the sweeps of a rotation ascend in ``place``.
    place : (n,) ndarray
        Phase of the rotor, 0 to below 1.

    Returns
    -------
    (n,) int32 ndarray
        0, 1, or -1 where nothing tells: a single sweep without neighbours, a third one.
    """
    n = len(rotation)
    plane = np.full(n, UNKNOWN, np.int32)
    if n == 0:
        return plane
    fresh = np.r_[True, np.diff(rotation) != 0]
    group = np.cumsum(fresh) - 1
    size = np.bincount(group)
    head = np.flatnonzero(fresh)
    two = head[size == 2]
    apart = place[two + 1] - place[two] if len(two) else np.zeros(0)
    pair = two[(apart > MIN_PLANE_DELAY_TURNS) & (apart < MAX_PLANE_DELAY_TURNS)]
    plane[pair], plane[pair + 1] = 0, 1
    paired = np.zeros(n, bool)
    paired[pair] = paired[pair + 1] = True
    if len(pair):
        single = np.flatnonzero(~paired)
        plane[single] = _by_neighbours(single, rotation, place, pair)
    # A plane passes once a rotation: of two that claim it neither is believed.
    both = np.r_[False, (np.diff(rotation) == 0) & (np.diff(plane) == 0) & (plane[1:] >= 0)]
    both[:-1] |= both[1:]
    plane[both & ~paired] = UNKNOWN
    return plane


def _by_neighbours(
    rows: NDArray[np.int64], rotation: NDArray[np.int64], place: Array, pair: NDArray[np.int64]
) -> NDArray[np.int64]:
    """The plane (n,) whose nearest pairs were at the phase of each of some sweeps (n,)."""
    at = np.searchsorted(pair, rows)
    distance = np.ones((2, len(rows)))
    for beside in (pair[np.maximum(at - 1, 0)], pair[np.minimum(at, len(pair) - 1)]):
        near = np.abs(rotation[beside] - rotation[rows]) <= NEAR_ROTATIONS
        for number in (0, 1):
            off = np.where(near, np.abs(place[beside + number] - place[rows]), 1.0)
            distance[number] = np.minimum(distance[number], off)
    closest, other = np.min(distance, axis=0), np.max(distance, axis=0)
    return np.where((closest < NEAR_TURN) & (other > NEAR_TURN), np.argmin(distance, 0), UNKNOWN)
