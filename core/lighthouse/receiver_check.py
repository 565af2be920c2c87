"""Check of the photodiodes of a device before its first recording.

The device is held still in the light of a base station. Each photodiode must receive about as many
sweeps as the others, and the angles must fit the positions of the photodiodes in their order.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.calibration import GENERIC_CALIBRATION, ideal_angles
from locatk.core.lighthouse.devices.device_sweeps import (
    DeviceSweeps,
    make_windows,
    mean_angles,
    received_channels,
    rotation_limits_ns,
    select_device_sweeps,
)
from locatk.core.lighthouse.devices.pnp import candidate_poses, is_lit_from_behind
from locatk.core.lighthouse.light_planes import rays
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.sensor_check import SensorCheck, SensorFault, by_sensor

Array = NDArray[np.float64]

MIN_SWEEPS_FRACTION = 0.25
"""Sweeps of a photodiode relative to the best one below which it receives too few."""

MIN_PARALLEL_COSINE = 0.9
"""Cosine between normals of photodiodes from which they face in the same direction."""

MAX_WINDOWS = 20
"""Largest number of rotations of each station at which the order of the photodiodes is tested."""

MAX_COMPARED_WINDOWS = 8
"""Largest number of rotations for which other orders are tried: photodiodes have many pairs."""

MIN_WINDOWS = 5
"""Least number of rotations for a result."""

MIN_MISFIT = 4e-4
"""Residual in tangents of angles above which the order may be wrong. The recorded tracker of
libsurvive-extras-data has 4e-5, and 7e-4 or more with exchanged photodiodes."""

MAX_MISFIT_RATIO = 0.4
"""Residual of another order, relative to that of the given one, from which it is the right one."""


@dataclass(frozen=True)
class PhotodiodeFigures:
    """Figures of one photodiode: number of sweeps received, and channels of the stations."""

    sweeps: int
    channels: tuple[int, ...]


def count_photodiodes(sweeps: Sweeps, device: int, receiver: Receiver | None) -> int:
    """Return the number of photodiodes of a device, by its receiver and its sweeps."""
    received = int(sweeps.sensor[sweeps.device == device].max(initial=0)) + 1
    return received if receiver is None else max(len(receiver), received)


def check_receiver(
    sweeps: Sweeps, device: int, receiver: Receiver | None
) -> SensorCheck[PhotodiodeFigures]:
    """Check the photodiodes of one device of a recording.

    Parameters
    ----------
    sweeps : Sweeps
    device : int
        Index in ``sweeps.devices``.
    receiver : Receiver, optional
        Positions of its photodiodes. None: their number is that of the highest one received.

    Raises
    ------
    DegenerateError
        A receiver is given, and no sweep of the device has a valid channel.
    """
    own = sweeps.take(sweeps.device == device)
    count = count_photodiodes(sweeps, device, receiver)
    numbers = np.bincount(own.sensor[own.sensor >= 0], minlength=count)
    figures = tuple(
        PhotodiodeFigures(
            int(numbers[sensor]),
            tuple(int(c) for c in np.unique(own.channel[own.sensor == sensor])),
        )
        for sensor in range(count)
    )
    faults, untested = _light_faults(numbers, receiver)
    if receiver is None:
        untested.append("photodiodes without light, and their order: attach receiver.toml")
    else:
        if count > len(receiver):
            message = f"sweeps of {count} photodiodes, but the receiver has {len(receiver)}"
            faults.append(SensorFault(None, "unknown_photodiodes", message))
        order = _order_faults(sweeps, device, receiver)
        if order is None:
            untested.append(
                "order of the photodiodes: hold the device still in the light of a station, so "
                "that at least four of them receive it"
            )
        faults += order or []
    return SensorCheck(figures, by_sensor(faults), tuple(untested))


def _light_faults(
    numbers: NDArray[np.int64], receiver: Receiver | None
) -> tuple[list[SensorFault], list[str]]:
    """Return the photodiodes without sweeps or with far fewer (k,) than the best one.

    If they face in different directions, nothing is wrong with those that receive less; the second
    result then names those without sweeps.
    """
    normal = None if receiver is None else receiver.normal
    is_parallel = normal is None or bool(np.all(normal @ normal[0] > MIN_PARALLEL_COSINE))
    if not is_parallel:
        dark = ", ".join(str(sensor) for sensor in np.flatnonzero(numbers == 0))
        text = f"photodiodes without light ({dark}): turn them to a station"
        return [], [text] if dark else []
    faults = []
    for sensor, number in enumerate(numbers.tolist()):
        fraction = number / max(int(numbers.max()), 1)
        if number == 0:
            faults.append(SensorFault(sensor, "no_sweeps", "receives no light"))
        elif fraction < MIN_SWEEPS_FRACTION:
            message = f"receives {100 * fraction:.0f} % of the sweeps of the best one"
            faults.append(SensorFault(sensor, "few_sweeps", message))
    return faults, []


def _order_faults(sweeps: Sweeps, device: int, receiver: Receiver) -> list[SensorFault] | None:
    """Return a fault if two exchanged photodiodes explain the angles much better.

    None if too few rotations have four photodiodes with both planes.
    """
    channels = received_channels(sweeps, [sweeps.devices[device]])
    selected, _ = select_device_sweeps(sweeps, device, receiver, channels)
    angles = _rotations(selected, channels, len(receiver))
    if len(angles) < MIN_WINDOWS:
        return None
    given = _misfits(angles, receiver, np.arange(len(receiver)))
    if np.median(given) < MIN_MISFIT:
        return []
    misfitting = np.flatnonzero(given > MIN_MISFIT)
    step = -(-len(misfitting) // MAX_COMPARED_WINDOWS)
    compared = misfitting[::step]
    misfit = {}
    for first, second in itertools.combinations(range(len(receiver)), 2):
        order = np.arange(len(receiver))
        order[[first, second]] = second, first
        exchanged = _misfits([angles[window] for window in compared], receiver, order)
        misfit[first, second] = float(np.median(exchanged))
    best = min(misfit, key=lambda pair: misfit[pair])
    if misfit[best] < MAX_MISFIT_RATIO * np.median(given[compared]):
        message = f"photodiodes {best[0]} and {best[1]} are exchanged"
    else:
        message = "the angles do not fit the positions of the photodiodes: compare receiver.toml"
    return [SensorFault(None, "order", message)]


def _rotations(sweeps: DeviceSweeps, channels: list[int], sensors: int) -> list[Array]:
    """Return the angles (k, 2) of rotations in which at least four photodiodes have both planes."""
    angles = []
    interval_ns = rotation_limits_ns(channels)[1]
    for station in range(len(channels)):
        own = sweeps.take(sweeps.station == station)
        windows = make_windows(own, interval_ns, interval_ns // 2)
        step = -(-len(windows) // MAX_WINDOWS) or 1
        for rows in windows.sweep[::step]:
            mean = mean_angles(own.take(rows[rows >= 0]), sensors)
            if np.isfinite(mean).all(axis=1).sum() >= 4:
                angles.append(mean)
    return angles


def _misfits(angles: list[Array], receiver: Receiver, order: NDArray[np.int64]) -> Array:
    """Return the residual of each rotation, in tangents, for an order of photodiodes.

    It is infinite if no pose explains a rotation.
    """
    residuals = []
    for observed in angles:
        permuted = observed[order]
        ray = rays(ideal_angles(permuted, GENERIC_CALIBRATION), GENERIC_CALIBRATION.tilts)
        best = np.inf
        for position, rotation in candidate_poses(
            permuted, receiver, GENERIC_CALIBRATION, minimal_sets=False
        ):
            point = position + receiver.position_m @ rotation.T
            if receiver.normal is not None:
                is_dark = is_lit_from_behind(point, receiver.normal @ rotation.T)
                if np.any(is_dark & np.isfinite(permuted).all(axis=1)):
                    continue
            difference = point[:, 1:] / point[:, :1] - ray[:, 1:] / ray[:, :1]
            best = min(best, float(np.sqrt(np.nanmean(difference**2))))
        residuals.append(best)
    return np.array(residuals)
