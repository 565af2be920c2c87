"""Sweeps of one rigid device: planes told apart, angles, and windows of time around moments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.channels import CHANNELS, TICK_HZ, period_counts, period_ticks
from locatk.core.lighthouse.devices.pose_fit import SweepObservations
from locatk.core.lighthouse.epochs import MIN_PLANE_DELAY_TURNS
from locatk.core.lighthouse.light_planes import ROTOR_ZERO_RAD
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.recording import UNKNOWN, Sweeps

FIRST_ALONE = 0.40
SECOND_ALONE = 0.60
"""Parts of a rotation before and after which a sweep can only be of the first, or only of the
second plane, within 70 degrees of straight ahead."""

MOST_SWEEPS = 512
"""Sweeps used of one moment; of more, every second or third: two rotations of four stations
with 22 photodiodes each have 352."""


@dataclass(frozen=True)
class DeviceSweeps:
    """Sweeps of one device, by time.

    Attributes
    ----------
    row : (n,) int ndarray
        Where each is in the :class:`~locatk.core.lighthouse.recording.Sweeps` it comes from.
    time_ns : (n,) int64 ndarray
        Ascending.
    sensor, station, plane : (n,) int ndarray
        ``station`` is a column of the stations of a recording.
    angle : (n,) ndarray
        Rotor angle in radians.
    """

    row: NDArray[np.int64]
    time_ns: NDArray[np.int64]
    sensor: NDArray[np.int64]
    station: NDArray[np.int64]
    plane: NDArray[np.int64]
    angle: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.time_ns)

    def take(self, chosen: NDArray[np.int64] | NDArray[np.bool_]) -> DeviceSweeps:
        """The chosen sweeps."""
        return DeviceSweeps(*(getattr(self, f.name)[chosen] for f in fields(self)))


def select_device_sweeps(
    sweeps: Sweeps, device: int, receiver: Receiver, channels: Sequence[int]
) -> tuple[DeviceSweeps, dict[str, int]]:
    """Usable sweeps of one device, and how many are left out under which reason.

    Parameters
    ----------
    sweeps : Sweeps
    device : int
        Its index in ``sweeps.devices``.
    receiver : Receiver
    channels : sequence of int
        Of the stations; sweeps of others are left out.
    """
    rejected: dict[str, int] = {}
    mine = np.flatnonzero(sweeps.device == device)

    def keep(good: NDArray[np.bool_], reason: str) -> None:
        nonlocal mine
        if not np.all(good):
            rejected[reason] = int(np.count_nonzero(~good))
            mine = mine[good]

    keep(np.isin(sweeps.channel[mine], CHANNELS), "unknown_channel")
    sensor = sweeps.sensor[mine]
    placed = np.append(np.isfinite(receiver.position_m).all(axis=1), False)
    keep(placed[np.where((sensor >= 0) & (sensor < len(receiver)), sensor, -1)], "sensor_unknown")
    keep(np.isin(sweeps.channel[mine], list(channels)), "station_not_in_scene")
    counts = sweeps.count[mine]
    with np.errstate(invalid="ignore"):
        inside = (counts >= 0) & (counts < period_counts(sweeps.channel[mine]))
    keep(inside, "count_above_period")
    mine = mine[np.argsort(sweeps.time_ns[mine], kind="stable")]
    plane = assign_planes(sweeps.time_ns[mine], sweeps.channel[mine], sweeps.count[mine])
    plane = np.where(sweeps.sweep[mine] == UNKNOWN, plane, sweeps.sweep[mine])
    known = (plane == 0) | (plane == 1)
    plane = plane[known]
    keep(known, "plane_unknown")
    channel = sweeps.channel[mine]
    turn = sweeps.count[mine] / period_counts(channel)
    columns = np.zeros(CHANNELS.stop, np.int64)
    columns[list(channels)] = np.arange(len(channels))
    return DeviceSweeps(
        mine,
        sweeps.time_ns[mine],
        sweeps.sensor[mine].astype(np.int64),
        columns[channel],
        plane.astype(np.int64),
        2 * np.pi * turn + ROTOR_ZERO_RAD[plane],
    ), rejected


def assign_planes(
    time_ns: NDArray[np.int64], channel: NDArray[np.int32], count: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Which plane each sweep of a device was: 0, 1 or -1 where nothing tells.

    In one rotation of a station the photodiodes of a device are met by the first plane
    close together, and by the second about a third of a turn later. Where only one of the
    two was received, its place in the rotation tells, unless it is in the middle.
    """
    turn = count / period_counts(channel)
    period_ns = period_ticks(channel) * (1e9 / TICK_HZ)
    since = time_ns - (time_ns[0] if len(time_ns) else 0)
    zero = since - turn * period_ns
    order = np.lexsort((zero, channel))
    apart = np.diff(zero[order]) > 0.5 * period_ns[order][1:]
    fresh = np.r_[True, apart | (np.diff(channel[order]) != 0)][: len(order)]
    rotation = np.empty(len(order), np.int64)
    rotation[order] = np.cumsum(fresh) - 1

    plane = np.where(turn < FIRST_ALONE, 0, np.where(turn > SECOND_ALONE, 1, UNKNOWN))
    order = np.lexsort((turn, rotation))
    step = np.diff(turn[order])
    step[np.diff(rotation[order]) != 0] = 0.0
    # The widest gap of each rotation, where it is wide enough to part two planes.
    widest = np.zeros(np.count_nonzero(fresh))
    np.maximum.at(widest, rotation[order][1:], step)
    gap = np.flatnonzero((step > MIN_PLANE_DELAY_TURNS) & (step == widest[rotation[order][1:]]))
    limit = np.full(len(widest), np.nan)
    limit[rotation[order][gap]] = turn[order][gap] + step[gap] / 2
    split = limit[rotation]
    return np.where(np.isnan(split), plane, (turn > split).astype(np.int64))


@dataclass(frozen=True)
class SweepWindows:
    """Moments of a device, each with the sweeps around it.

    Attributes
    ----------
    time_ns : (m,) int64 ndarray
        Ascending: the mean time of the sweeps, where pose and rates are least entangled.
    sweep : (m, n) int ndarray
        Rows of :class:`DeviceSweeps`; -1 pads.
    """

    time_ns: NDArray[np.int64]
    sweep: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.time_ns)


def make_windows(mine: DeviceSweeps, every_ns: int, reach_ns: int) -> SweepWindows:
    """A moment every ``every_ns`` wherever there are sweeps, with those up to ``reach_ns``
    before and after it."""
    if len(mine) == 0:
        return SweepWindows(np.zeros(0, np.int64), np.zeros((0, 0), np.int64))
    since = mine.time_ns - mine.time_ns[0]
    stretch, start = np.unique(since // every_ns, return_index=True)
    # The middle of a stretch, or near its first sweep where it is longer than the reach.
    first_in = since[start]
    middle = stretch * every_ns + every_ns // 2
    centre = np.clip(middle, first_in - reach_ns, first_in + reach_ns)
    first = np.searchsorted(since, centre - reach_ns)
    last = np.searchsorted(since, centre + reach_ns, side="right")
    number = last - first
    step = np.maximum(1, -(-number // MOST_SWEEPS))
    column = np.arange(int(np.max(-(-number // step), initial=0)))
    sweep = first[:, None] + column * step[:, None]
    sweep[sweep >= last[:, None]] = -1
    held = sweep >= 0
    total = np.sum(np.where(held, since[sweep], 0.0), axis=1)
    mean = np.rint(total / np.count_nonzero(held, axis=1)).astype(np.int64)
    # Beside a pause two windows may hold the same sweeps.
    fresh = np.r_[True, np.diff(np.maximum.accumulate(mean)) > 0]
    return SweepWindows(mine.time_ns[0] + mean[fresh], sweep[fresh])


def gather_observations(
    mine: DeviceSweeps, around: SweepWindows, receiver: Receiver, moments: NDArray[np.int64]
) -> SweepObservations:
    """The sweeps of the chosen moments."""
    sweep = around.sweep[moments]
    wide = int(np.max(np.count_nonzero(sweep >= 0, axis=1), initial=0))
    sweep = sweep[:, :wide]
    since = mine.time_ns[sweep] - around.time_ns[moments][:, None]
    return SweepObservations(
        receiver.position_m[mine.sensor[sweep]],
        mine.station[sweep],
        mine.plane[sweep],
        mine.angle[sweep],
        np.where(sweep >= 0, since * 1e-9, 0.0),
        sweep >= 0,
    )
