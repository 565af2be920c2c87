"""Result of the check of a device's sensors before its first recording."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

FiguresT = TypeVar("FiguresT")
"""Class with the figures of one sensor."""


@dataclass(frozen=True)
class SensorFault:
    """Fault of one sensor, or of all sensors of a device.

    Attributes
    ----------
    sensor : int or None
        Index of the sensor, from 0; None if the fault concerns all of them.
    code : str
        Stable identifier, as in ``"axes_exchanged"``.
    message : str
        Fault as a phrase that follows the name of the sensor and a colon.
    """

    sensor: int | None
    code: str
    message: str


@dataclass(frozen=True)
class SensorCheck(Generic[FiguresT]):
    """Result of a check.

    Attributes
    ----------
    sensors : tuple
        Figures of each sensor.
    faults : tuple of SensorFault
        First those that concern all sensors, then by sensor.
    untested : tuple of str
        What the recording does not show, with the remedy.
    """

    sensors: tuple[FiguresT, ...]
    faults: tuple[SensorFault, ...]
    untested: tuple[str, ...]


def by_sensor(faults: list[SensorFault]) -> tuple[SensorFault, ...]:
    """Return faults in the order of a :class:`SensorCheck`."""
    return tuple(sorted(faults, key=lambda fault: -1 if fault.sensor is None else fault.sensor))
