"""Sweeps of one rigid device: plane assignment, rotor angles, and windows around epochs.

A rigid device carries several photodiodes at known positions (:class:`Receiver`). One rotation of
a base station yields up to two sweeps of each photodiode, spread over some 20 ms. A pose is
estimated from the sweeps of a window of time; its time is the epoch of the window.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

from locatk.core.errors import DegenerateError
from locatk.core.lighthouse.channels import CHANNELS, TICK_HZ, period_counts, period_ticks
from locatk.core.lighthouse.devices.pose_fit import SweepObservations
from locatk.core.lighthouse.light_planes import ROTOR_ZERO_RAD
from locatk.core.lighthouse.plane_labels import assign_planes
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.recording import NANOSECONDS_PER_S, UNKNOWN, Sweeps

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
Mask = NDArray[np.bool_]

MAX_SWEEPS_PER_WINDOW = 512
"""Maximum number of sweeps used of one window; of more, every second or third is used. Two
rotations of four stations over 22 photodiodes each yield 352."""

ROTATIONS_PER_WINDOW = 2.0
"""Observations of one photodiode by one light plane in a window: one for each rotation before and
after the epoch."""

MIN_SWEEPS = 8
"""Minimum number of sweeps for a pose: two more than its six unknowns, so that they check it."""

MIN_SENSORS = 3
"""Minimum number of different photodiodes for a pose; two leave a rotation about their line."""


@dataclass(frozen=True)
class DeviceSweeps:
    """Sweeps of one device in ascending time.

    Attributes
    ----------
    time_ns : (n,) int64 ndarray
    sensor : (n,) int ndarray
        Index of the photodiode in the receiver.
    station : (n,) int ndarray
        Index of the base station in the sequence of channels they were selected with.
    plane : (n,) int ndarray
        0 or 1.
    angle : (n,) ndarray
        Rotor angle in radians.
    """

    time_ns: IntArray
    sensor: IntArray
    station: IntArray
    plane: IntArray
    angle: Array

    def __len__(self) -> int:
        return len(self.time_ns)

    def take(self, rows: IntArray | Mask) -> DeviceSweeps:
        """Return the selected sweeps."""
        return DeviceSweeps(*(getattr(self, f.name)[rows] for f in fields(self)))


def received_channels(sweeps: Sweeps, devices: Iterable[str]) -> list[int]:
    """Return the channels of the stations that named devices received, ascending.

    Raises
    ------
    DegenerateError
        None of the devices has a sweep with a valid channel.
    """
    names = list(devices)
    numbers = [k for k, name in enumerate(sweeps.devices) if name in names]
    is_selected = np.isin(sweeps.device, numbers)
    channels = [int(c) for c in np.unique(sweeps.channel[is_selected]) if c in CHANNELS]
    if not channels:
        raise DegenerateError(
            "no device with known photodiodes has a usable sweep",
            hint="receivers are given for "
            + (", ".join(names) or "no device")
            + "; the recording contains "
            + (", ".join(sweeps.devices) or "none"),
        )
    return channels


def select_device_sweeps(
    sweeps: Sweeps, device: int, receiver: Receiver, channels: Sequence[int]
) -> tuple[DeviceSweeps, dict[str, int]]:
    """Select the usable sweeps of one device.

    Parameters
    ----------
    sweeps : Sweeps
    device : int
        Index in ``sweeps.devices``.
    receiver : Receiver
    channels : sequence of int
        Channels of the stations; sweeps of other stations are rejected.

    Returns
    -------
    selected : DeviceSweeps
    rejected : dict of str to int
        Number of rejected sweeps by reason.
    """
    rejected: dict[str, int] = {}
    rows = np.flatnonzero(sweeps.device == device)

    def keep(is_usable: Mask, reason: str) -> None:
        nonlocal rows
        if not np.all(is_usable):
            rejected[reason] = int(np.count_nonzero(~is_usable))
            rows = rows[is_usable]

    keep(np.isin(sweeps.channel[rows], CHANNELS), "unknown_channel")
    sensor = sweeps.sensor[rows]
    # The appended False is the entry of all sensor numbers outside the receiver.
    has_position = np.append(np.isfinite(receiver.position_m).all(axis=1), False)
    is_in_receiver = (sensor >= 0) & (sensor < len(receiver))
    keep(has_position[np.where(is_in_receiver, sensor, -1)], "sensor_unknown")
    keep(np.isin(sweeps.channel[rows], list(channels)), "station_not_in_scene")
    counts = sweeps.count[rows]
    with np.errstate(invalid="ignore"):
        is_in_period = (counts >= 0) & (counts < period_counts(sweeps.channel[rows]))
    keep(is_in_period, "count_above_period")
    rows = rows[np.argsort(sweeps.time_ns[rows], kind="stable")]
    plane = assign_planes(sweeps.time_ns[rows], sweeps.channel[rows], sweeps.count[rows])
    plane = np.where(sweeps.sweep[rows] == UNKNOWN, plane, sweeps.sweep[rows])
    is_assigned = (plane == 0) | (plane == 1)
    plane = plane[is_assigned]
    keep(is_assigned, "plane_unknown")

    channel = sweeps.channel[rows]
    station_of_channel = np.zeros(CHANNELS.stop, np.int64)
    station_of_channel[list(channels)] = np.arange(len(channels))
    rotor_turns = sweeps.count[rows] / period_counts(channel)
    selected = DeviceSweeps(
        sweeps.time_ns[rows],
        sweeps.sensor[rows].astype(np.int64),
        station_of_channel[channel],
        plane.astype(np.int64),
        2 * np.pi * rotor_turns + ROTOR_ZERO_RAD[plane],
    )
    return selected, rejected


def mean_angles(sweeps: DeviceSweeps, sensors: int) -> Array:
    """Return the mean rotor angle (sensors, 2) of each photodiode and plane of one station.

    Angles are in radians, ``nan`` for planes without a sweep.
    """
    total, number = np.zeros((sensors, 2)), np.zeros((sensors, 2))
    np.add.at(total, (sweeps.sensor, sweeps.plane), sweeps.angle)
    np.add.at(number, (sweeps.sensor, sweeps.plane), 1)
    with np.errstate(invalid="ignore"):
        return np.asarray(total / number)


# ---- windows


@dataclass(frozen=True)
class SweepWindows:
    """Epochs of a device, each with the sweeps around it.

    Attributes
    ----------
    time_ns : (m,) int64 ndarray
        Time of each epoch, ascending: the mean time of its sweeps, at which pose and rates are
        least correlated.
    sweep : (m, n) int ndarray
        Rows of :class:`DeviceSweeps`; rows end with -1 as padding.
    """

    time_ns: IntArray
    sweep: IntArray

    def __len__(self) -> int:
        return len(self.time_ns)


def rotation_limits_ns(channels: ArrayLike) -> tuple[int, int]:
    """Return the shortest and the longest rotation of stations on ``channels`` [ns]."""
    periods_ns = period_ticks(channels) * NANOSECONDS_PER_S / TICK_HZ
    return int(np.min(periods_ns)), int(np.max(periods_ns))


def make_windows(sweeps: DeviceSweeps, interval_ns: int, half_width_ns: int) -> SweepWindows:
    """Make a window in every interval of ``interval_ns`` that contains sweeps.

    A window contains the sweeps up to ``half_width_ns`` before and after its centre.
    """
    if len(sweeps) == 0:
        return SweepWindows(np.zeros(0, np.int64), np.zeros((0, 0), np.int64))
    elapsed_ns = sweeps.time_ns - sweeps.time_ns[0]
    interval, first_sweep = np.unique(elapsed_ns // interval_ns, return_index=True)
    # The centre is that of the interval, moved to its first sweep if this is out of range.
    first_ns = elapsed_ns[first_sweep]
    middle_ns = interval * interval_ns + interval_ns // 2
    centre_ns = np.clip(middle_ns, first_ns - half_width_ns, first_ns + half_width_ns)
    start = np.searchsorted(elapsed_ns, centre_ns - half_width_ns)
    stop = np.searchsorted(elapsed_ns, centre_ns + half_width_ns, side="right")
    number = stop - start
    stride = np.maximum(1, -(-number // MAX_SWEEPS_PER_WINDOW))
    column = np.arange(int(np.max(-(-number // stride), initial=0)))
    sweep = start[:, None] + column * stride[:, None]
    sweep[sweep >= stop[:, None]] = -1
    is_sweep = sweep >= 0
    total_ns = np.sum(np.where(is_sweep, elapsed_ns[sweep], 0.0), axis=1)
    mean_ns = np.rint(total_ns / np.count_nonzero(is_sweep, axis=1)).astype(np.int64)
    # At a pause of the recording two windows may contain the same sweeps.
    is_distinct = np.r_[True, np.diff(np.maximum.accumulate(mean_ns)) > 0]
    return SweepWindows(sweeps.time_ns[0] + mean_ns[is_distinct], sweep[is_distinct])


def has_enough_sweeps(sweeps: DeviceSweeps, window_sweeps: IntArray) -> Mask:
    """Return for each window whether its sweeps (m, n) can determine a pose."""
    is_sweep = window_sweeps >= 0
    sensor = np.where(is_sweep, sweeps.sensor[window_sweeps] if len(sweeps) else 0, -1)
    sensors = np.count_nonzero(np.diff(np.sort(sensor, axis=1), axis=1, prepend=-1), axis=1)
    number = np.count_nonzero(is_sweep, axis=1)
    return np.asarray((number >= MIN_SWEEPS) & (sensors >= MIN_SENSORS))


def gather_observations(
    sweeps: DeviceSweeps, windows: SweepWindows, receiver: Receiver, epochs: IntArray
) -> SweepObservations:
    """Gather the sweeps of the selected windows in padded arrays for the pose fit."""
    sweep = windows.sweep[epochs]
    is_sweep = sweep >= 0
    width = int(np.max(np.count_nonzero(is_sweep, axis=1), initial=0))
    sweep, is_sweep = sweep[:, :width], is_sweep[:, :width]
    offset_ns = sweeps.time_ns[sweep] - windows.time_ns[epochs][:, None]
    return SweepObservations(
        receiver.position_m[sweeps.sensor[sweep]],
        sweeps.station[sweep],
        sweeps.plane[sweep],
        sweeps.angle[sweep],
        np.where(is_sweep, offset_ns * 1e-9, 0.0),
        is_sweep,
    )
