"""Which places take part in a bundle adjustment, and which are held out to verify it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Indices = NDArray[np.int64]

HELD_OUT = 5
"""Every fifth place is held out."""

LEAST_HELD_OUT_FROM = 200
"""Fewer places are all needed to solve the scene; nothing is held out of them."""


def spread_evenly(seen: NDArray[np.bool_], usable: Indices, most: int) -> Indices:
    """At most so many of the usable places, spread over all ways in which they were seen.

    Places that link two groups of stations can be few among many: of each set of stations
    that saw places together as many are taken, as long as it has them.

    Parameters
    ----------
    seen : (m, s) bool ndarray
        Which station saw which place.
    usable : (k,) int ndarray
        Ascending.
    most : int

    Returns
    -------
    (n,) int ndarray
        Ascending, n <= most but for at least one of each set.
    """
    if len(usable) <= most:
        return usable
    group = _groups(seen, usable)
    size = np.bincount(group)
    # The small sets in full, what is left to the larger ones.
    left, share = most, np.zeros(len(size), np.int64)
    for done, k in enumerate(np.argsort(size, kind="stable")):
        share[k] = max(1, min(size[k], left // (len(size) - done)))
        left -= share[k]
    order = np.argsort(group, kind="stable")
    first = np.cumsum(size) - size
    chosen = [
        order[first[k] + np.unique(np.linspace(0, size[k] - 1, share[k]).astype(int))]
        for k in range(len(size))
    ]
    return usable[np.sort(np.concatenate(chosen))]


def split_held_out(seen: NDArray[np.bool_], usable: Indices) -> tuple[Indices, Indices]:
    """Split usable places into those to solve with and every fifth to verify with.

    Counted within each set of stations that saw places together, so that each is verified.
    Nothing is held out of less than :data:`LEAST_HELD_OUT_FROM`. Parameters as for
    :func:`spread_evenly`.
    """
    held = np.zeros(len(usable), bool)
    if len(usable) >= LEAST_HELD_OUT_FROM:
        group = _groups(seen, usable)
        order = np.argsort(group, kind="stable")
        first = np.r_[True, np.diff(group[order]) != 0]
        start = np.flatnonzero(first)[np.cumsum(first) - 1]
        number = np.empty(len(usable), np.int64)
        number[order] = np.arange(len(usable)) - start
        held = number % HELD_OUT == HELD_OUT - 1
    return usable[~held], usable[held]


def _groups(seen: NDArray[np.bool_], usable: Indices) -> Indices:
    """A number from 0 for the set of stations that saw each usable place."""
    code = seen[usable] @ (1 << np.arange(seen.shape[1], dtype=np.int64))
    return np.asarray(np.unique(code, return_inverse=True)[1], np.int64).reshape(-1)
