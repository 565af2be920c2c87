"""Sweeps that belong together: one moment, one photodiode, all stations.

A moment (an epoch) collects the sweeps of a photodiode within one rotation. Which plane a
sweep was is told by its counts where the source does not say: the second plane always
follows the first by about a third of a turn, so that the smaller count is the first.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.channels import CHANNELS, period_counts
from locatk.core.lighthouse.light_planes import counts_to_angles
from locatk.core.lighthouse.recording import UNKNOWN, Sweeps

PAIR_NS = 10_500_000
"""The second plane of a rotation follows the first within this time; the first of the next
rotation comes later than that after the second. (Half a rotation, and a little.)"""

MIN_PLANE_DELAY_TURNS = 0.125
MAX_PLANE_DELAY_TURNS = 0.55
"""By how much of a turn the second plane can follow the first: a third, less or more by
what the elevation of the photodiode makes of two planes that are tilted apart."""

WINDOW_NS = 30_000_000
"""Longest epoch: a report holds the last pair of each station, up to a rotation apart."""

QUIET_NS = 20_000_000
"""A longer silence than a rotation ends an epoch: the report of a device is over."""

SPIKE = np.deg2rad(2.0)
"""Demodulation errors move an angle by more than this for one step (paper IV.A)."""


@dataclass(frozen=True)
class Epochs:
    """Counts by moment and station.

    Attributes
    ----------
    devices : tuple of str
        Names to which ``device`` points: of devices, or ``device/sensor`` where a device
        has several photodiodes.
    time_ns : (m,) int64 ndarray
    device : (m,) int ndarray
    channels : (s,) int ndarray
        Of the stations, ascending.
    counts : (m, s, 2) ndarray
        LFSR indices of both sweeps; ``nan`` where not seen.
    labelled : bool
        Whether polynomials say which station sent a sweep; otherwise a report may have
        mixed them up.
    rejected : dict of str to int
        Reason to number of sweeps left out.
    """

    devices: tuple[str, ...]
    time_ns: NDArray[np.int64]
    device: NDArray[np.int64]
    channels: NDArray[np.int64]
    counts: NDArray[np.float64]
    labelled: bool
    rejected: dict[str, int] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.time_ns)

    def take(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> Epochs:
        """The chosen moments only."""
        return replace(
            self,
            time_ns=self.time_ns[chosen],
            device=self.device[chosen],
            counts=self.counts[chosen],
        )


def group_epochs(sweeps: Sweeps) -> Epochs:
    """Collect sweeps into epochs.

    Sweeps of one epoch that were received at different times are moved to its middle
    along the line through their neighbours in time, so that a moving robot is seen by
    all stations at one moment.
    """
    rejected: dict[str, int] = {}
    usable = _usable(sweeps, rejected)
    key, names = _photodiodes(sweeps)
    order = usable[
        np.lexsort(
            (sweeps.count[usable], sweeps.time_ns[usable], sweeps.channel[usable], key[usable])
        )
    ]
    key, time, channel = key[order], sweeps.time_ns[order], sweeps.channel[order]
    count, stated = sweeps.count[order], sweeps.sweep[order]
    fresh = _not_repeated(key, channel, time, count, stated)
    _note(rejected, "repeated_in_rotation", np.count_nonzero(~fresh))
    key, time, channel = key[fresh], time[fresh], channel[fresh]
    count, stated = count[fresh], stated[fresh]
    pair, plane = _pair(key, channel, time, count, stated)
    _note(rejected, "plane_unknown", np.count_nonzero(plane == UNKNOWN))

    channels = np.unique(channel)
    column = np.searchsorted(channels, channel)
    epoch = _cut(key, time, column, plane, pair)
    slot = (epoch * len(channels) + column) * 2 + plane
    kept = plane != UNKNOWN
    _, first = np.unique(np.where(kept, slot, -1), return_index=True)
    first = first[kept[first]]
    _note(rejected, "repeated_in_rotation", np.count_nonzero(kept) - len(first))

    m = int(epoch.max()) + 1 if len(epoch) else 0
    shape = (m, len(channels), 2)
    counts = np.full(shape, np.nan)
    counts.ravel()[slot[first]] = count[first]
    epoch_key = np.zeros(m, np.int64)
    epoch_key[epoch] = key
    base, middle, offset = _middle_times(epoch, time, m)
    if np.any(offset):
        lag = np.full(shape, np.nan)
        lag.ravel()[slot[first]] = offset[first]
        _move_to_middle(counts, lag, middle, epoch_key)
    epochs = Epochs(
        tuple(names),
        base + middle,
        epoch_key,
        channels.astype(np.int64),
        counts,
        bool(np.all(sweeps.polynomial[order] != UNKNOWN)) and len(order) > 0,
        rejected,
    )
    _drop_spikes(epochs)
    return epochs


def _usable(sweeps: Sweeps, rejected: dict[str, int]) -> NDArray[np.int64]:
    """Indices of sweeps with a known channel and a count that a rotation can hold."""
    known = np.isin(sweeps.channel, CHANNELS)
    _note(rejected, "unknown_channel", np.count_nonzero(~known))
    period = period_counts(np.where(known, sweeps.channel, 1))
    with np.errstate(invalid="ignore"):
        inside = (sweeps.count >= 0) & (sweeps.count < period)
    _note(rejected, "count_above_period", np.count_nonzero(known & ~inside))
    return np.flatnonzero(known & inside)


def _photodiodes(sweeps: Sweeps) -> tuple[NDArray[np.int64], list[str]]:
    """A number for each photodiode, and the names behind the numbers."""
    if not np.any(sweeps.sensor):
        return sweeps.device.astype(np.int64), list(sweeps.devices)
    sensors = int(sweeps.sensor.max()) + 1
    present, key = np.unique(
        sweeps.device.astype(np.int64) * sensors + sweeps.sensor, return_inverse=True
    )
    return key, [f"{sweeps.devices[k // sensors]}/{k % sensors}" for k in present]


def _not_repeated(*columns: NDArray[np.generic]) -> NDArray[np.bool_]:
    """Which of the sorted sweeps differ in any column from the one before."""
    changed = np.zeros(max(len(columns[0]) - 1, 0), bool)
    for column in columns:
        changed |= column[1:] != column[:-1]
    return np.r_[True, changed][: len(columns[0])]


def _pair(
    key: NDArray[np.int64],
    channel: NDArray[np.int32],
    time: NDArray[np.int64],
    count: NDArray[np.float64],
    stated: NDArray[np.int32],
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pair number and plane (0, 1, or -1 where nobody can tell) of each sweep.

    Sweeps are sorted by photodiode, station, time and count, so that a pair is a sweep and
    the next one.
    """
    n = len(time)
    if n == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    same = (np.diff(key) == 0) & (np.diff(channel) == 0)
    close = same & (np.diff(time) <= PAIR_NS)
    told = stated != UNKNOWN
    turn = np.diff(count) / period_counts(channel[1:])
    apart = (turn > MIN_PLANE_DELAY_TURNS) & (turn < MAX_PLANE_DELAY_TURNS)
    in_order = np.where(
        told[:-1] & told[1:], stated[:-1] < stated[1:], ~(told[:-1] | told[1:]) & apart
    )
    linked = np.r_[close & in_order, False]
    # In a chain of links every other one is a pair.
    head = np.r_[True, ~linked[:-1]]
    place = np.arange(n) - np.flatnonzero(head)[np.cumsum(head) - 1]
    starts = linked & (place % 2 == 0)
    follows = np.r_[False, starts[:-1]]
    plane = np.where(told, stated, np.where(starts, 0, np.where(follows, 1, UNKNOWN)))
    # Three sweeps under one stamp: any two could be the pair.
    crowd = np.r_[False, same[:-1] & same[1:] & (time[2:] == time[:-2]), False] if n > 2 else None
    if crowd is not None and np.any(crowd):
        crowd[:-1] |= crowd[1:]
        crowd[1:] |= crowd[:-1]
        plane = np.where(crowd & ~told, UNKNOWN, plane)
    return np.cumsum(~follows) - 1, plane.astype(np.int64)


def _cut(
    key: NDArray[np.int64],
    time: NDArray[np.int64],
    column: NDArray[np.int64],
    plane: NDArray[np.int64],
    pair: NDArray[np.int64],
) -> NDArray[np.int64]:
    """Epoch number of each sweep; a pair is never cut in two.

    An epoch ends with a silence, when it grows too long, or when a plane comes again.
    """
    if not len(time):
        return np.zeros(0, np.int64)
    first = np.flatnonzero(np.r_[True, np.diff(pair) != 0])
    base = time.min()
    since = (time - base).astype(np.float64)
    middle = np.add.reduceat(since, first) / np.diff(np.r_[first, len(time)])
    bits = np.where(plane == UNKNOWN, 0, np.left_shift(1, np.maximum(column * 2 + plane, 0)))
    mask = np.bitwise_or.reduceat(bits, first)
    order = np.lexsort((middle, key[first]))
    middle, mask, owner = middle[order], mask[order], key[first][order]
    fresh = np.r_[True, (np.diff(middle) > QUIET_NS) | (np.diff(owner) != 0)]
    number = np.empty(len(order), np.int64)
    epoch, seen, begun = -1, 0, 0.0
    # Where an epoch ends depends on where it began: this one loop cannot be vectorised.
    labels = []
    for new, at, planes in zip(fresh.tolist(), middle.tolist(), mask.tolist(), strict=True):
        if new or seen & planes or at - begun > WINDOW_NS:
            epoch, seen, begun = epoch + 1, 0, at
        seen |= planes
        labels.append(epoch)
    number[order] = labels
    return number[pair]


def _middle_times(
    epoch: NDArray[np.int64], time: NDArray[np.int64], m: int
) -> tuple[np.int64, NDArray[np.int64], NDArray[np.float64]]:
    """A base time, each epoch's mean time since then in ns, and how many seconds each
    sweep is away from that mean."""
    if not m:
        return np.int64(0), np.zeros(0, np.int64), np.zeros(0)
    base = time.min()
    since = (time - base).astype(np.float64)
    total = np.bincount(epoch, since, m)
    middle = np.rint(total / np.bincount(epoch, minlength=m)).astype(np.int64)
    return base, middle, (since - middle[epoch]) * 1e-9


def _move_to_middle(
    counts: NDArray[np.float64],
    lag: NDArray[np.float64],
    middle: NDArray[np.int64],
    key: NDArray[np.int64],
) -> None:
    """Shift counts along their own rate of change to the middle of their epoch."""
    seconds = middle * 1e-9
    for column in np.ndindex(counts.shape[1:]):
        seen = np.flatnonzero(np.isfinite(counts[(slice(None), *column)]))
        if len(seen) < 2:
            continue
        value = counts[(seen, *column)]
        when = seconds[seen] + lag[(seen, *column)]
        # At the ends of a device's path the one neighbour there is must do.
        here = np.arange(len(seen))
        turns = np.diff(key[seen]) != 0
        before = np.where(np.r_[True, turns], here, here - 1)
        after = np.where(np.r_[turns, True], here, here + 1)
        span = when[after] - when[before]
        near = (span > 0) & (span < 0.5)
        rate = np.where(near, (value[after] - value[before]) / np.where(near, span, 1.0), 0.0)
        counts[(seen, *column)] = value - rate * lag[(seen, *column)]


def _drop_spikes(epochs: Epochs) -> None:
    """Remove single angles that leave a smooth run by more than :data:`SPIKE`."""
    limit = SPIKE / (2 * np.pi) * period_counts(epochs.channels)
    dropped = 0
    for station, plane in np.ndindex(epochs.counts.shape[1:]):
        seen = np.flatnonzero(np.isfinite(epochs.counts[:, station, plane]))
        value = epochs.counts[seen, station, plane]
        before, here, after = value[:-2], value[1:-1], value[2:]
        same = (epochs.device[seen[2:]] == epochs.device[seen[:-2]]) & (
            epochs.time_ns[seen[2:]] - epochs.time_ns[seen[:-2]] < 1_000_000_000
        )
        step = limit[station]
        spike = (
            same
            & (np.abs(here - before) > step)
            & (np.abs(here - after) > step)
            & (np.abs(after - before) < step)
        )
        epochs.counts[seen[1:-1][spike], station, plane] = np.nan
        dropped += int(np.count_nonzero(spike))
    _note(epochs.rejected, "spike", dropped)


def _note(rejected: dict[str, int], reason: str, number: int | np.signedinteger) -> None:
    if number:
        rejected[reason] = rejected.get(reason, 0) + int(number)


def angles_of(epochs: Epochs) -> NDArray[np.float64]:
    """Rotor angles (m, s, 2) of epochs, in radians."""
    angles = np.empty_like(epochs.counts)
    for i, channel in enumerate(epochs.channels):
        angles[:, i] = counts_to_angles(epochs.counts[:, i], int(channel))
    return angles
