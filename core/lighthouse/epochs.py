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
from locatk.core.lighthouse.sweeps import UNKNOWN, Sweeps

WINDOW_NS = 20_000_000
"""Length of an epoch: about one rotation."""

QUIET_NS = 8_000_000
"""A silence this long ends an epoch early: the report of a device is over."""

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


def group(sweeps: Sweeps) -> Epochs:
    """Collect sweeps into epochs.

    Sweeps of one epoch that were received at different times are moved to its middle
    along the line through their neighbours in time, so that a moving robot is seen by
    all stations at one moment.
    """
    rejected: dict[str, int] = {}
    usable = _usable(sweeps, rejected)
    key, names = _photodiodes(sweeps)
    order = usable[np.lexsort((sweeps.time_ns[usable], key[usable]))]
    key, time = key[order], sweeps.time_ns[order]
    epoch = _cut(key, time)

    channel, count = sweeps.channel[order], sweeps.count[order]
    # Within an epoch and a station by count: the first plane comes first.
    inner = np.lexsort((count, channel, epoch))
    epoch, channel, count, time = epoch[inner], channel[inner], count[inner], time[inner]
    stated = sweeps.sweep[order][inner]
    start = np.r_[True, (np.diff(epoch) != 0) | (np.diff(channel) != 0)]
    pair = np.cumsum(start) - 1
    size = np.bincount(pair)[pair] if len(pair) else pair
    rank = np.arange(len(pair)) - np.flatnonzero(start)[pair]
    plane = np.where(stated == UNKNOWN, np.where(size == 2, rank, UNKNOWN), stated)
    _note(rejected, "plane_unknown", np.count_nonzero(plane == UNKNOWN))

    channels = np.unique(channel)
    column = np.searchsorted(channels, channel)
    kept = plane != UNKNOWN
    slot = (epoch * len(channels) + column) * 2 + plane
    _, first = np.unique(np.where(kept, slot, -1), return_index=True)
    first = first[kept[first]]
    _note(rejected, "repeated_in_rotation", np.count_nonzero(kept) - len(first))

    m = int(epoch[-1]) + 1 if len(epoch) else 0
    shape = (m, len(channels), 2)
    counts = np.full(shape, np.nan)
    counts.ravel()[slot[first]] = count[first]
    epoch_key = np.zeros(m, np.int64)
    epoch_key[epoch] = key[inner]
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


def _cut(key: NDArray[np.int64], time: NDArray[np.int64]) -> NDArray[np.int64]:
    """Epoch number of each sweep, given sweeps sorted by photodiode and time."""
    if not len(time):
        return np.zeros(0, np.int64)
    starts = np.r_[True, (np.diff(time) > QUIET_NS) | (np.diff(key) != 0)]
    report = np.cumsum(starts) - 1
    part = (time - time[starts][report]) // WINDOW_NS
    fresh = starts | np.r_[True, np.diff(part) != 0]
    return np.cumsum(fresh) - 1


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
        if len(seen) < 3:
            continue
        value = counts[(seen, *column)]
        when = seconds[seen] + lag[(seen, *column)]
        before, after = np.r_[0, : len(seen) - 1], np.r_[1 : len(seen), len(seen) - 1]
        span = when[after] - when[before]
        near = (key[seen[after]] == key[seen[before]]) & (span > 0) & (span < 0.5)
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
