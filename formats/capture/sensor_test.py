"""Check of the sensors in a recording that a user made for it (``locatk capture --test``)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from locatk.core.errors import InputError, LocatkError
from locatk.core.landmarks.halls import HallSensors
from locatk.core.landmarks.halls_check import check_halls
from locatk.core.lighthouse.receiver_check import check_receiver, count_photodiodes
from locatk.core.polaris.array import SensorArray
from locatk.core.polaris.array_check import check_array
from locatk.core.sensor_check import SensorCheck
from locatk.formats.sessions.field_samples import (
    HALLS,
    MAGNETOMETERS,
    read_halls,
    read_magnetometers,
)
from locatk.formats.sessions.observations import (
    SWEEP_TOPIC_PREFIX,
    read_receivers,
    read_sweeps,
)
from locatk.formats.sessions.reader import Session

INSTRUCTIONS = {
    "polaris": "Magnetometers: turn them slowly about all axes for 20 s, away from iron; then hold "
    "a magnet to sensor 1.",
    "landmarks": "Hall sensors: wait 3 s, then move a magnet, north side up, closely below one "
    "after the other: {halls}.",
    "lighthouse": "Photodiodes: hold the device still in the light of a base station.",
}
"""What a user does with the sensors of each system."""

DEVICE_SYSTEM = {
    "polaris-array": "polaris",
    "magx-array": "polaris",
    "lighthouse-deck": "lighthouse",
    "dotbot-gateway": "lighthouse",
}
"""Systems of the devices that have sensors of one system only."""

DURATION_S = 30.0
"""Default duration of the recording [s]."""


@dataclass(frozen=True)
class DeviceTest:
    """Result for the sensors of one device.

    Attributes
    ----------
    device, system : str
    names : tuple of str
        Of the sensors.
    check : SensorCheck
    """

    device: str
    system: str
    names: tuple[str, ...]
    check: SensorCheck[Any]


def instructions(device: str) -> list[str]:
    """Return what the user does while the sensors of a device are recorded.

    A device that may have sensors of any system, or is unknown, has the instructions of all.
    """
    system = DEVICE_SYSTEM.get(device)
    halls = ", ".join(HallSensors().names)
    return [
        text.format(halls=halls) for name, text in INSTRUCTIONS.items() if system in (None, name)
    ]


def check_recording(path: str | Path) -> list[DeviceTest]:
    """Check the sensors of all devices of a session.

    A device that cannot be checked, for example for lack of samples, is untested, unless it is the
    only one.

    Raises
    ------
    LocatkError
        The session cannot be read, or no device can be checked.
    InputError
        It has no magnetometers, hall sensors or photodiodes.
    """
    session = Session.open(path)
    tests: list[DeviceTest] = []
    failed: list[LocatkError] = []
    for device, system, names, check in _checks(session):
        try:
            tests.append(DeviceTest(device, system, names, check()))
        except LocatkError as error:
            failed.append(error)
            untested = f"all of it: {error.message}"
            tests.append(DeviceTest(device, system, (), SensorCheck((), (), (untested,))))
    if not tests:
        raise InputError(
            "no magnetometers, hall sensors or photodiodes were decoded",
            file=session.path,
            hint="Check --device; for lines, name the values by --columns",
        )
    if len(failed) == len(tests):
        raise failed[0]
    return tests


def _checks(
    session: Session,
) -> Iterator[tuple[str, str, tuple[str, ...], Callable[[], SensorCheck[Any]]]]:
    """Yield device, system, names of the sensors, and the check of each device."""
    if MAGNETOMETERS.topics(session):
        for samples in read_magnetometers(session, fallback=_unknown_array):
            names = _numbered(len(samples.array))
            yield samples.device, "polaris", names, partial(check_array, samples)
    if HALLS.topics(session):
        for readings in read_halls(session, fallback=_assumed_halls):
            names = readings.sensors.names
            yield readings.device, "landmarks", names, partial(check_halls, readings)
    if session.topics(SWEEP_TOPIC_PREFIX):
        sweeps, receivers = read_sweeps(session), read_receivers(session)
        for number, device in enumerate(sweeps.devices):
            receiver = receivers.get(device)
            count = count_photodiodes(sweeps, number, receiver)
            names = tuple(f"photodiode {sensor}" for sensor in range(count))
            check = partial(check_receiver, sweeps, number, receiver)
            yield device, "lighthouse", names, check


def _unknown_array(sensors: int) -> SensorArray:
    return SensorArray(np.full((sensors, 3), np.nan))


def _assumed_halls(sensors: int) -> HallSensors:
    """Return the usual four sensors, or sensors at unknown positions."""
    usual = HallSensors()
    if sensors == len(usual):
        return usual
    return HallSensors(_numbered(sensors), np.full((sensors, 2), np.nan))


def _numbered(sensors: int) -> tuple[str, ...]:
    return tuple(f"sensor {number + 1}" for number in range(sensors))
