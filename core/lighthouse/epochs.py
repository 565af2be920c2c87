"""Grouping of sweeps into epochs: one time, one photodiode, all stations.

An epoch holds at most one sweep of each light plane of each station, received within about one
rotation. Stations are not synchronised, so that the sweeps of an epoch are up to a rotation
apart; counts of a moving photodiode are therefore interpolated to the mean time of the epoch.

Sources that report the plane of a sweep (``Sweeps.sweep``) are believed. Otherwise two
consecutive sweeps of a station are recognised as the first and second plane of one rotation by
their times and by their counts, which differ by about a third of a rotation. A sweep without
such a partner is rejected (``plane_unknown``).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.kernels import kernels
from locatk.core.lighthouse.channels import CHANNELS, period_counts
from locatk.core.lighthouse.light_planes import counts_to_angles
from locatk.core.lighthouse.recording import UNKNOWN, Sweeps

MAX_PAIR_DELAY_NS = 10_500_000
"""Longest time from the first to the second plane of one rotation [ns]: half of the slowest
rotation (19.98 ms on channel 1) and a margin. At the height of the station it is a third of a
rotation, and the first plane of the next rotation follows after two thirds."""

MIN_PLANE_DELAY_TURNS = 0.125
MAX_PLANE_DELAY_TURNS = 0.55
"""Difference of the counts of both planes of one rotation [rotations]. It is 1/3 at the height of
the station. Elevation changes it because the planes are tilted by 60 degrees to each other: the
limits correspond to 47 degrees below and above the station, by Eq. 1 of
:mod:`~locatk.core.lighthouse.calibration`."""

MAX_EPOCH_NS = 30_000_000
"""Longest time from the start of an epoch to its last pair [ns]. A device reports the last pair of
each station, and these are up to one rotation (20 ms) apart."""

MAX_SILENCE_NS = 20_000_000
"""Longest time between two pairs of an epoch [ns], the slowest rotation rounded up. A longer
silence means that the report of the device is complete."""

MAX_RATE_INTERVAL_S = 0.5
"""Longest time between two counts of a plane from which its rate of change is estimated [s]. Over
longer times the motion of a robot is not linear."""

SWEEPS_PER_BLOCK = 1 << 18
"""Number of sweeps that are grouped at a time, photodiode by photodiode. It bounds the memory, and
the arrays fit the cache of a processor."""

SPIKE_RAD = np.deg2rad(2.0)
"""Smallest change of a rotor angle for a single epoch that is a demodulation error [rad]: such
errors exceed 2 degrees (paper IV.A)."""

MAX_SPIKE_INTERVAL_NS = 1_000_000_000
"""Longest time from the sweep before to the sweep after a spike [ns]. Over longer times a robot
can move by as much, so that its neighbours do not contradict a sweep."""


@dataclass(frozen=True)
class Epochs:
    """Counts by epoch and station.

    Attributes
    ----------
    devices : tuple of str
        Names that ``device`` indexes: of devices, or ``device/sensor`` for devices with several
        photodiodes.
    time_ns : (m,) int64 ndarray
        Mean time of the sweeps of each epoch.
    device : (m,) int ndarray
        Index of ``devices``.
    channels : (s,) int ndarray
        Channels of the stations, ascending.
    counts : (m, s, 2) ndarray
        LFSR indices of both sweeps; ``nan`` for sweeps that were not received or rejected.
    labelled : bool
        True if every sweep has a polynomial, which identifies its station. Otherwise a report
        may have mixed stations up.
    rejected : dict of str to int
        Number of rejected sweeps by reason.
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

    def take(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> Epochs:
        """Return the epochs of ``rows``, a mask or indices."""
        return replace(
            self,
            time_ns=self.time_ns[rows],
            device=self.device[rows],
            counts=self.counts[rows],
        )


def group_epochs(sweeps: Sweeps) -> Epochs:
    """Group sweeps into epochs.

    Parameters
    ----------
    sweeps : Sweeps
        In any order.

    Returns
    -------
    Epochs
        Sorted by photodiode, then by time. Every sweep of ``sweeps`` is either in ``counts`` or
        counted in ``rejected``, as ``unknown_channel``, ``count_above_period``,
        ``repeated_in_rotation``, ``plane_unknown`` or ``spike``.

    Notes
    -----
    Counts are interpolated linearly to the time of their epoch, so that all stations observe a
    moving robot at one time.
    """
    rejected: dict[str, int] = {}
    valid = _select_valid(sweeps, rejected)
    photodiode, names = _photodiodes(sweeps)
    channels = np.unique(sweeps.channel[valid])
    start_ns = sweeps.time_ns[valid].min(initial=np.iinfo(np.int64).max)
    blocks = [
        _group_block(sweeps, rows, photodiode[rows], channels, start_ns, rejected)
        for rows in _sorted_blocks(photodiode, sweeps, valid)
    ]
    mean_ns, device, counts, is_labelled = (list(parts) for parts in zip(*blocks, strict=True))
    epochs = Epochs(
        tuple(names),
        start_ns + np.concatenate(mean_ns),
        np.concatenate(device),
        channels.astype(np.int64),
        np.concatenate(counts),
        all(is_labelled) and len(valid) > 0,
        rejected,
    )
    _reject_spikes(epochs)
    return epochs


def _group_block(
    sweeps: Sweeps,
    rows: NDArray[np.int64],
    photodiode: NDArray[np.int64],
    channels: NDArray[np.int32],
    start_ns: np.int64,
    rejected: dict[str, int],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64], bool]:
    """Group the sweeps ``rows`` of some photodiodes, sorted as by :func:`_sorted_blocks`.

    Returns
    -------
    mean_ns, device : (m,) ndarray
        Mean times since ``start_ns``, and photodiodes, of the epochs.
    counts : (m, s, 2) ndarray
    is_labelled : bool
    """
    time_ns, channel = sweeps.time_ns[rows], sweeps.channel[rows]
    count, reported_plane = sweeps.count[rows], sweeps.sweep[rows]
    is_labelled = bool(np.all(sweeps.polynomial[rows] != UNKNOWN))
    unique = _differs_from_previous(photodiode, channel, time_ns, count, reported_plane)
    _add_rejected(rejected, "repeated_in_rotation", np.count_nonzero(~unique))
    photodiode, time_ns, channel = photodiode[unique], time_ns[unique], channel[unique]
    count, reported_plane = count[unique], reported_plane[unique]
    pair, plane = _pair_planes(photodiode, channel, time_ns, count, reported_plane)
    _add_rejected(rejected, "plane_unknown", np.count_nonzero(plane == UNKNOWN))

    station = np.searchsorted(channels, channel)
    epoch = _split_epochs(photodiode, time_ns, station, plane, pair)
    # Flat index into `counts`; if a plane occurs twice in an epoch, its first sweep is used.
    slot = (epoch * len(channels) + station) * 2 + plane
    has_plane = np.flatnonzero(plane != UNKNOWN)
    m = int(epoch.max()) + 1 if len(epoch) else 0
    shape = (m, len(channels), 2)
    first_sweep = np.full(m * len(channels) * 2, -1)
    first_sweep[slot[has_plane[::-1]]] = has_plane[::-1]
    used = first_sweep[first_sweep >= 0]
    _add_rejected(rejected, "repeated_in_rotation", len(has_plane) - len(used))

    counts = np.full(shape, np.nan)
    counts.ravel()[slot[used]] = count[used]
    epoch_photodiode = np.zeros(m, np.int64)
    epoch_photodiode[epoch] = photodiode
    mean_ns, offset_s = _mean_times(epoch, time_ns, start_ns, m)
    if np.any(offset_s):
        offsets_s = np.full(shape, np.nan)
        offsets_s.ravel()[slot[used]] = offset_s[used]
        _interpolate_to_mean_time(counts, offsets_s, mean_ns, epoch_photodiode)
    return mean_ns, epoch_photodiode, counts, is_labelled


def rotor_angles(epochs: Epochs) -> NDArray[np.float64]:
    """Return the rotor angles (m, s, 2) of epochs in radians."""
    angles = np.empty_like(epochs.counts)
    for i, channel in enumerate(epochs.channels):
        angles[:, i] = counts_to_angles(epochs.counts[:, i], int(channel))
    return angles


def _select_valid(sweeps: Sweeps, rejected: dict[str, int]) -> NDArray[np.int64]:
    """Return the indices of sweeps with a known channel and a count within one rotation."""
    valid = [np.zeros(0, np.int64)]
    for start in range(0, len(sweeps), SWEEPS_PER_BLOCK):
        block = slice(start, start + SWEEPS_PER_BLOCK)
        channel, count = sweeps.channel[block], sweeps.count[block]
        is_known = np.isin(channel, CHANNELS)
        _add_rejected(rejected, "unknown_channel", np.count_nonzero(~is_known))
        period = period_counts(np.where(is_known, channel, 1))
        with np.errstate(invalid="ignore"):
            is_in_rotation = (count >= 0) & (count < period)
        _add_rejected(rejected, "count_above_period", np.count_nonzero(is_known & ~is_in_rotation))
        valid.append(start + np.flatnonzero(is_known & is_in_rotation))
    return np.concatenate(valid)


def _photodiodes(sweeps: Sweeps) -> tuple[NDArray[np.int64], list[str]]:
    """Return the photodiode of each sweep as an index, and the names of the photodiodes."""
    if not np.any(sweeps.sensor):
        return sweeps.device.astype(np.int64), list(sweeps.devices)
    sensors = int(sweeps.sensor.max()) + 1
    codes, photodiode = np.unique(
        sweeps.device.astype(np.int64) * sensors + sweeps.sensor, return_inverse=True
    )
    return photodiode, [f"{sweeps.devices[k // sensors]}/{k % sensors}" for k in codes]


def _sorted_blocks(
    photodiode: NDArray[np.int64], sweeps: Sweeps, rows: NDArray[np.int64]
) -> Iterator[NDArray[np.int64]]:
    """Yield the indices ``rows`` sorted by photodiode, channel, time and count.

    Each block has all sweeps of some photodiodes; there is at least one, which may be empty.
    """
    source = photodiode[rows] * (max(CHANNELS) + 1) + sweeps.channel[rows]
    if len(source) and source.max() < 1 << 16:
        # Numpy sorts 16 bits in linear time.
        source = source.astype(np.uint16)
    order = rows[np.argsort(source, kind="stable")]
    edges = np.flatnonzero(np.diff(photodiode[order])) + 1
    start = 0
    for stop in [*edges.tolist(), len(order)]:
        if stop - start >= SWEEPS_PER_BLOCK or stop == len(order):
            block = order[start:stop]
            keys = sweeps.count[block], sweeps.time_ns[block], sweeps.channel[block]
            yield block[_sort_within(*keys, photodiode[block])]
            start = stop


def _sort_within(
    count: NDArray[np.float64],
    time_ns: NDArray[np.int64],
    channel: NDArray[np.int32],
    photodiode: NDArray[np.int64],
) -> NDArray[np.int64] | slice:
    """Return the order of sweeps (n,) that are sorted by photodiode and channel.

    Most sources send the sweeps in the order of time, so that they are sorted already.
    """
    elapsed_ns = np.diff(time_ns)
    is_ascending = (elapsed_ns > 0) | (elapsed_ns == 0) & (np.diff(count) >= 0)
    if np.all(is_ascending | (np.diff(channel) != 0) | (np.diff(photodiode) != 0)):
        return slice(None)
    return np.lexsort((count, time_ns, channel, photodiode))


def _differs_from_previous(*columns: NDArray[np.generic]) -> NDArray[np.bool_]:
    """Return a mask of the rows that differ from the row before in any of the sorted columns."""
    differs = np.zeros(max(len(columns[0]) - 1, 0), bool)
    for column in columns:
        differs |= column[1:] != column[:-1]
    return np.r_[True, differs][: len(columns[0])]


def _pair_planes(
    photodiode: NDArray[np.int64],
    channel: NDArray[np.int32],
    time_ns: NDArray[np.int64],
    count: NDArray[np.float64],
    reported_plane: NDArray[np.int32],
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Find the sweeps of both planes of one rotation, and the plane of each sweep.

    Parameters
    ----------
    photodiode, channel, time_ns, count, reported_plane : (n,) ndarray
        Sorted by photodiode, channel, time and count, so that a pair is two neighbours.
        ``reported_plane`` is 0, 1 or ``UNKNOWN``.

    Returns
    -------
    pair : (n,) ndarray
        Number of the pair, ascending; a single sweep has a number of its own.
    plane : (n,) ndarray
        0, 1 or ``UNKNOWN``.
    """
    n = len(time_ns)
    if n == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    # Arrays of length n - 1 are about a sweep and the next one.
    same_source = (np.diff(photodiode) == 0) & (np.diff(channel) == 0)
    is_close = same_source & (np.diff(time_ns) <= MAX_PAIR_DELAY_NS)
    reported = reported_plane != UNKNOWN
    delay_turns = np.diff(count) / period_counts(channel[1:])
    delay_fits = (delay_turns > MIN_PLANE_DELAY_TURNS) & (delay_turns < MAX_PLANE_DELAY_TURNS)
    is_in_order = np.where(
        reported[:-1] & reported[1:],
        reported_plane[:-1] < reported_plane[1:],
        ~(reported[:-1] | reported[1:]) & delay_fits,
    )
    links_next = np.r_[is_close & is_in_order, False]
    # Links can form a chain; every other sweep of a chain, from its first, starts a pair.
    starts_chain = np.r_[True, ~links_next[:-1]]
    chain_index = np.arange(n) - np.flatnonzero(starts_chain)[np.cumsum(starts_chain) - 1]
    starts_pair = links_next & (chain_index % 2 == 0)
    ends_pair = np.r_[False, starts_pair[:-1]]
    paired_plane = np.where(starts_pair, 0, np.where(ends_pair, 1, UNKNOWN))
    plane = np.where(reported, reported_plane, paired_plane)
    if n > 2:
        # Of three or more sweeps with one time stamp any two could be the pair.
        is_crowded = np.r_[
            False, same_source[:-1] & same_source[1:] & (time_ns[2:] == time_ns[:-2]), False
        ]
        is_crowded[:-1] |= is_crowded[1:]
        is_crowded[1:] |= is_crowded[:-1]
        plane = np.where(is_crowded & ~reported, UNKNOWN, plane)
    return np.cumsum(~ends_pair) - 1, plane.astype(np.int64)


def _split_epochs(
    photodiode: NDArray[np.int64],
    time_ns: NDArray[np.int64],
    station: NDArray[np.int64],
    plane: NDArray[np.int64],
    pair: NDArray[np.int64],
) -> NDArray[np.int64]:
    """Return the epoch number (n,) of each sweep; a pair is never split.

    A new epoch begins after a silence of :data:`MAX_SILENCE_NS`, after :data:`MAX_EPOCH_NS`, or
    when a plane of a station occurs again.
    """
    if not len(time_ns):
        return np.zeros(0, np.int64)
    pair_start = np.flatnonzero(np.r_[True, np.diff(pair) != 0])
    elapsed_ns = (time_ns - time_ns.min()).astype(np.float64)
    pair_sizes = np.diff(np.r_[pair_start, len(time_ns)])
    pair_ns = np.add.reduceat(elapsed_ns, pair_start) / pair_sizes
    # One bit for each plane of each station.
    plane_bit = np.left_shift(1, np.maximum(station * 2 + plane, 0))
    pair_planes = np.bitwise_or.reduceat(np.where(plane == UNKNOWN, 0, plane_bit), pair_start)
    order = np.lexsort((pair_ns, photodiode[pair_start]))
    pair_ns, pair_planes = pair_ns[order], pair_planes[order]
    pair_photodiode = photodiode[pair_start][order]
    after_silence = np.r_[
        True, (np.diff(pair_ns) > MAX_SILENCE_NS) | (np.diff(pair_photodiode) != 0)
    ]
    pair_epoch = np.empty(len(order), np.int64)
    pair_epoch[order] = _number_epochs(after_silence, pair_ns, pair_planes)
    return pair_epoch[pair]


def _number_epochs(
    after_silence: NDArray[np.bool_], pair_ns: NDArray[np.float64], pair_planes: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return the epoch (n,) of each pair, given its time and the bits of its planes."""
    if kernels is None:
        return number_epochs_python(after_silence, pair_ns, pair_planes)
    epoch = np.empty(len(pair_ns), np.int64)
    kernels.light_epochs(
        after_silence, pair_ns, pair_planes, len(pair_ns), float(MAX_EPOCH_NS), epoch
    )
    return epoch


def number_epochs_python(
    after_silence: NDArray[np.bool_], pair_ns: NDArray[np.float64], pair_planes: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Number epochs without the compiled kernel.

    The end of an epoch depends on its beginning, which cannot be vectorised.
    """
    labels = []
    epoch, epoch_planes, epoch_start_ns = -1, 0, 0.0
    for is_new, now_ns, planes in zip(
        after_silence.tolist(), pair_ns.tolist(), pair_planes.tolist(), strict=True
    ):
        if is_new or epoch_planes & planes or now_ns - epoch_start_ns > MAX_EPOCH_NS:
            epoch, epoch_planes, epoch_start_ns = epoch + 1, 0, now_ns
        epoch_planes |= planes
        labels.append(epoch)
    return np.array(labels, np.int64)


def _mean_times(
    epoch: NDArray[np.int64], time_ns: NDArray[np.int64], start_ns: np.int64, m: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the mean times of epochs, and the times of sweeps relative to them.

    Returns
    -------
    mean_ns : (m,) int64 ndarray
        Mean time of each epoch since ``start_ns``.
    offset_s : (n,) ndarray
        Time of each sweep after the mean of its epoch, in seconds.
    """
    elapsed_ns = (time_ns - start_ns).astype(np.float64)
    total_ns = np.bincount(epoch, elapsed_ns, m)
    mean_ns = np.rint(total_ns / np.bincount(epoch, minlength=m)).astype(np.int64)
    return mean_ns, (elapsed_ns - mean_ns[epoch]) * 1e-9


def _interpolate_to_mean_time(
    counts: NDArray[np.float64],
    offsets_s: NDArray[np.float64],
    mean_ns: NDArray[np.int64],
    photodiode: NDArray[np.int64],
) -> None:
    """Interpolate ``counts`` (m, s, 2) to the mean times of their epochs, overwriting them.

    The rate of change of a count is that between the neighbouring epochs of the same photodiode
    (between one neighbour and itself at the ends), zero if these are not within
    :data:`MAX_RATE_INTERVAL_S`.
    """
    mean_s = mean_ns * 1e-9
    for station, plane in np.ndindex(counts.shape[1:]):
        rows = np.flatnonzero(np.isfinite(counts[:, station, plane]))
        if len(rows) < 2:
            continue
        count, offset_s = counts[rows, station, plane], offsets_s[rows, station, plane]
        time_s = mean_s[rows] + offset_s
        index = np.arange(len(rows))
        is_other = np.diff(photodiode[rows]) != 0
        previous = np.where(np.r_[True, is_other], index, index - 1)
        following = np.where(np.r_[is_other, True], index, index + 1)
        interval_s = time_s[following] - time_s[previous]
        is_usable = (interval_s > 0) & (interval_s < MAX_RATE_INTERVAL_S)
        change = count[following] - count[previous]
        rate = np.where(is_usable, change / np.where(is_usable, interval_s, 1.0), 0.0)
        counts[rows, station, plane] = count - rate * offset_s


def _reject_spikes(epochs: Epochs) -> None:
    """Set single counts to ``nan`` that differ from both neighbours by :data:`SPIKE_RAD`.

    The neighbours must agree with each other, so that motion is not taken for a spike.
    """
    limits = SPIKE_RAD / (2 * np.pi) * period_counts(epochs.channels)
    spikes = 0
    for station, plane in np.ndindex(epochs.counts.shape[1:]):
        rows = np.flatnonzero(np.isfinite(epochs.counts[:, station, plane]))
        count, limit = epochs.counts[rows, station, plane], limits[station]
        previous, current, following = count[:-2], count[1:-1], count[2:]
        same_device = epochs.device[rows[2:]] == epochs.device[rows[:-2]]
        interval_ns = epochs.time_ns[rows[2:]] - epochs.time_ns[rows[:-2]]
        is_spike = (
            same_device
            & (interval_ns < MAX_SPIKE_INTERVAL_NS)
            & (np.abs(current - previous) > limit)
            & (np.abs(current - following) > limit)
            & (np.abs(following - previous) < limit)
        )
        epochs.counts[rows[1:-1][is_spike], station, plane] = np.nan
        spikes += int(np.count_nonzero(is_spike))
    _add_rejected(epochs.rejected, "spike", spikes)


def _add_rejected(rejected: dict[str, int], reason: str, number: int | np.signedinteger) -> None:
    """Add ``number`` sweeps to those rejected for ``reason``, if there are any."""
    if number:
        rejected[reason] = rejected.get(reason, 0) + int(number)
