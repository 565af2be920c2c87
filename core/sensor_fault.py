"""Fault of a sensor that a check before the first recording found."""

from __future__ import annotations

from dataclasses import dataclass


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
