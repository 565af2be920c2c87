"""Outcomes of recorded sweeps: which are part of an epoch, and which of an epoch with a pose."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.epochs import Epochs, group_epochs
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.solution import Solution

Mask = NDArray[np.bool_]
Times = NDArray[np.int64]

MAX_ROUNDING_NS = 2
"""Difference between the time of an epoch and of its pose; both are means of several times."""


def classify_sweeps(sweeps: Sweeps, solution: Solution) -> tuple[Mask, Mask]:
    """Return masks (n,) of sweeps of one device: is part of an epoch, nearest epoch has a pose."""
    epochs = group_epochs(sweeps)
    is_grouped, has_pose = np.zeros(len(sweeps), bool), np.zeros(len(sweeps), bool)
    poses_ns = {t.device: t.time_ns for t in solution.trajectories}
    is_known = np.isin(sweeps.channel, epochs.channels)
    for index, name in enumerate(epochs.devices):
        rows = np.flatnonzero(epochs.device == index)
        if not len(rows):
            continue
        selected = is_known
        if name != sweeps.devices[0]:
            sensor = int(name.removeprefix(f"{sweeps.devices[0]}/"))
            selected = is_known & (sweeps.sensor == sensor)
        nearest = rows[_nearest(epochs.time_ns[rows], sweeps.time_ns[selected])]
        is_grouped[selected] = _is_in_epoch(epochs, nearest, sweeps, selected)
        poses = poses_ns.get(name, np.zeros(0, np.int64))
        if len(poses):
            epoch_ns = epochs.time_ns[nearest]
            difference_ns = np.abs(poses[_nearest(poses, epoch_ns)] - epoch_ns)
            has_pose[selected] = difference_ns <= MAX_ROUNDING_NS
    return is_grouped, has_pose


def _nearest(ascending_ns: Times, time_ns: Times) -> NDArray[np.int64]:
    """Return the index of the time of ``ascending_ns`` (m,) that is nearest to each time (n,)."""
    return np.searchsorted(ascending_ns[:-1] + np.diff(ascending_ns) // 2, time_ns)


def _is_in_epoch(
    epochs: Epochs, nearest: NDArray[np.int64], sweeps: Sweeps, selected: Mask
) -> Mask:
    """Return which of the selected sweeps are those of their nearest epoch and station.

    They are the sweeps nearest to its counts; the counts of an epoch are interpolated to its time
    and therefore differ from those of its sweeps.
    """
    count = sweeps.count[selected]
    column = np.searchsorted(epochs.channels, sweeps.channel[selected])
    cell = nearest * len(epochs.channels) + column
    is_member = np.zeros(len(count), bool)
    for plane in range(2):
        distance = np.abs(epochs.counts[nearest, column, plane] - count)
        order = np.lexsort((distance, cell))  # nan is sorted to the end.
        first = order[np.diff(cell[order], prepend=-1) != 0]
        is_member[first[np.isfinite(distance[first])]] = True
    return is_member
