"""Standstills of devices, found from their sweeps without a scene.

A device that rests repeats its rotor angles. Markers and points on the floor are visited by
standing on them for a few seconds, so that neither a clock nor a list of times is needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.epochs import Epochs, group_epochs, rotor_angles
from locatk.core.lighthouse.recording import NANOSECONDS_PER_S, Sweeps
from locatk.core.lighthouse.scene.keyframes import STANDSTILL_ANGLE_RAD

Array = NDArray[np.float64]

MIN_WINDOW_S = 0.25
"""Shortest time over which angles are averaged [s]: about twelve rotations."""

EPOCHS_PER_WINDOW = 5
"""Number of epochs of a window of devices that report rarely: the median outvotes two of them."""

MIN_EPOCHS_PER_WINDOW = 3
"""Fewest epochs from which the angle of a window is used: their median outvotes one wrong sweep."""

MIN_STANDSTILL_S = 1.5
"""Shortest standstill [s]. Robots that turn or brake rest for less."""

MAX_SPREAD_SIGMAS = 8.0
"""Largest spread of the angles of a rest, in standard deviations of the angle of a window, added to
:data:`~locatk.core.lighthouse.scene.keyframes.STANDSTILL_ANGLE_RAD`: the range of the medians of a
minute of Gaussian noise is 7 of them."""

MAX_STANDSTILL_ANGLE_RAD = 4e-3
"""Largest spread of the angles of a rest, however noisy they are [rad]: 8 mm at 2 m."""

MAX_MOVING_FRACTION = 0.25
"""Fraction of the light planes whose angles may change at rest: one station of several may be
received by reflection at times. Of one station both planes must be constant."""

ANCHOR_WINDOWS = 8
"""Windows at the beginning of a rest whose median angles stand for it. More would cost time."""

MAX_WRONG_WINDOWS = 2
"""Largest number of windows with other angles within a rest, for example when a person passes."""


@dataclass(frozen=True)
class Standstill:
    """Time during which a device rested.

    Attributes
    ----------
    device : str
    start_ns, end_ns : int
        Unix times in nanoseconds, within the rest.
    channels : tuple of int
        Stations that it received.
    """

    device: str
    start_ns: int
    end_ns: int
    channels: tuple[int, ...] = ()

    @property
    def duration_s(self) -> float:
        """Duration in seconds."""
        return (self.end_ns - self.start_ns) / NANOSECONDS_PER_S


def find_standstills(
    sweeps: Sweeps, *, min_duration_s: float = MIN_STANDSTILL_S
) -> list[Standstill]:
    """Find the standstills of all devices, in the order of time.

    Parameters
    ----------
    sweeps : Sweeps
    min_duration_s : float
        Shorter ones are left out, to one window (:data:`MIN_WINDOW_S`).

    Returns
    -------
    list of Standstill
        Gaps without light do not split a standstill.
    """
    epochs = group_epochs(sweeps)
    angles = rotor_angles(epochs).reshape(len(epochs), 2 * len(epochs.channels))
    standstills: list[Standstill] = []
    for device in sweeps.devices:
        own = [device] if device in epochs.devices else []
        names = own or [name for name in epochs.devices if _parse_device(name) == device]
        photodiodes = [epochs.devices.index(name) for name in names]
        if photodiodes:
            standstills += _find_device_standstills(
                device, epochs, angles, photodiodes, min_duration_s
            )
    return sorted(standstills, key=lambda each: each.start_ns)


def _parse_device(photodiode: str) -> str:
    """Return the device in the name of a photodiode, as in ``device/0``."""
    device, separator, number = photodiode.rpartition("/")
    return device if separator and number.isdigit() else photodiode


def _find_device_standstills(
    device: str,
    epochs: Epochs,
    angles: Array,
    photodiodes: Sequence[int],
    min_duration_s: float,
) -> list[Standstill]:
    """Find the standstills of one device, in the order of time."""
    rows = np.flatnonzero(np.isin(epochs.device, photodiodes))
    if len(rows) == 0:
        return []
    interval_ns = np.diff(epochs.time_ns[rows])[np.diff(epochs.device[rows]) == 0]
    epoch_ns = float(np.median(interval_ns)) if len(interval_ns) else 0.0
    window_ns = round(max(MIN_WINDOW_S * NANOSECONDS_PER_S, EPOCHS_PER_WINDOW * epoch_ns))
    first_ns = int(epochs.time_ns[rows].min())
    window = (epochs.time_ns[rows] - first_ns) // window_ns
    windows, medians = _compute_window_medians(
        window, epochs.device[rows], angles[rows], photodiodes
    )
    if len(windows) == 0:
        return []
    max_spread_rad = _compute_max_spread(window, epochs.device[rows], angles[rows])
    standstills = []
    rests = _split_rests(medians, max_spread_rad)
    for first, last in _join_rests(medians, rests, max_spread_rad):
        # Up to half of the first and the last window may be of the motion.
        start_ns = first_ns + int(windows[first]) * window_ns + window_ns // 2
        end_ns = first_ns + int(windows[last]) * window_ns + window_ns // 2
        if end_ns - start_ns + window_ns < min_duration_s * NANOSECONDS_PER_S:
            continue
        is_received = np.isfinite(medians[first : last + 1]).any(axis=0)
        by_station = is_received.reshape(len(photodiodes), len(epochs.channels), 2).any(axis=(0, 2))
        channels = tuple(int(c) for c in epochs.channels[by_station])
        standstills.append(Standstill(device, start_ns, end_ns, channels))
    return standstills


def _compute_window_medians(
    window: NDArray[np.int64], device: NDArray[np.int64], angles: Array, photodiodes: Sequence[int]
) -> tuple[NDArray[np.int64], Array]:
    """Return the windows with data, ascending, and the median angles (w, photodiodes x planes)."""
    windows, row = np.unique(window, return_inverse=True)
    planes = angles.shape[1]
    medians = np.full((len(windows), len(photodiodes) * planes), np.nan)
    for number, photodiode in enumerate(photodiodes):
        own = np.flatnonzero(device == photodiode)
        own = own[np.argsort(row[own], kind="stable")]
        starts: list[int] = np.flatnonzero(np.diff(row[own], prepend=-1)).tolist()
        for start, end in zip(starts, [*starts[1:], len(own)], strict=True):
            block = angles[own[start:end]]
            is_known = np.count_nonzero(np.isfinite(block), axis=0) >= MIN_EPOCHS_PER_WINDOW
            columns = number * planes + np.flatnonzero(is_known)
            medians[row[own[start]], columns] = np.nanmedian(block[:, is_known], axis=0)
    # Windows at the edge of a pause have too few epochs, and must not divide a rest.
    is_received = np.count_nonzero(np.isfinite(medians), axis=1) >= 2
    return windows[is_received], medians[is_received]


def _compute_max_spread(
    window: NDArray[np.int64], device: NDArray[np.int64], angles: Array
) -> float:
    """Return the largest spread of the medians of a rest, from the noise of the angles.

    The rows are sorted by photodiode, then by time.
    """
    is_neighbour = (np.diff(window) == 0) & (np.diff(device) == 0)
    steps = np.abs(np.diff(angles, axis=0)[is_neighbour])
    steps = steps[np.isfinite(steps)]
    if len(steps) == 0:
        return STANDSTILL_ANGLE_RAD
    # The lower quartile of the steps is of rests if the device rests for a quarter of the time;
    # that of Gaussian steps is 0.45 standard deviations of an angle.
    sigma_rad = float(np.quantile(steps, 0.25)) / 0.4506
    epochs_per_window = max(
        MIN_EPOCHS_PER_WINDOW, len(window) / len(np.unique(np.c_[window, device], axis=0))
    )
    spread_rad = STANDSTILL_ANGLE_RAD + MAX_SPREAD_SIGMAS * sigma_rad / np.sqrt(epochs_per_window)
    return float(min(spread_rad, MAX_STANDSTILL_ANGLE_RAD))


def _split_rests(medians: Array, max_spread_rad: float) -> list[tuple[int, int]]:
    """Return the first and last rows of runs of windows with constant angles.

    The angles are compared with those of the beginning of their run, so that slow motion is not
    taken for rest. Windows without data do not end a run.
    """
    rests: list[tuple[int, int]] = []
    start, anchor = 0, medians[0]
    for row in range(1, len(medians) + 1):
        if row < len(medians):
            deviation = np.abs(medians[row] - anchor)
            if _is_still(deviation[np.isfinite(deviation)], 0.5 * max_spread_rad):
                if row - start < ANCHOR_WINDOWS:
                    anchor = _compute_column_medians(medians[start : row + 1])
                continue
        if row - 1 > start:
            rests.append((start, row - 1))
        if row < len(medians):
            start, anchor = row, medians[row]
    return rests


def _is_still(deviation: Array, max_deviation_rad: float) -> bool:
    """Return whether the angles of enough light planes deviate by little."""
    if len(deviation) < 2:
        return False
    moving = np.count_nonzero(deviation > max_deviation_rad)
    return bool(moving <= MAX_MOVING_FRACTION * len(deviation))


def _join_rests(
    medians: Array, rests: list[tuple[int, int]], max_spread_rad: float
) -> list[tuple[int, int]]:
    """Join rests at one position that a few wrong windows divide."""
    joined: list[tuple[int, int]] = []
    for first, last in rests:
        if joined and 0 < first - joined[-1][1] - 1 <= MAX_WRONG_WINDOWS:
            before = _compute_column_medians(medians[joined[-1][0] : joined[-1][1] + 1])
            change = np.abs(_compute_column_medians(medians[first : last + 1]) - before)
            if _is_still(change[np.isfinite(change)], 0.5 * max_spread_rad):
                joined[-1] = (joined[-1][0], last)
                continue
        joined.append((first, last))
    return joined


def _compute_column_medians(medians: Array) -> Array:
    """Return the median of each column, ``nan`` if it has no value."""
    result = np.full(medians.shape[1], np.nan)
    is_known = np.isfinite(medians).any(axis=0)
    result[is_known] = np.nanmedian(medians[:, is_known], axis=0)
    return result
