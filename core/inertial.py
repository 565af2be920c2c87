"""Samples of an inertial measurement unit (IMU): accelerometer and gyroscope of one device."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

STANDARD_GRAVITY_M_S2 = 9.80665
"""Standard acceleration of gravity [m/s^2], the unit g of accelerometers (CGPM 1901)."""


@dataclass(frozen=True)
class InertialSamples:
    """Samples of the accelerometer and the gyroscope of one device.

    The axes are those of the device: x forward, y left, z up. A sensor that was not sampled at a
    time is ``nan`` there.

    Attributes
    ----------
    device : str
    time_ns : (n,) int64 ndarray
        Nanoseconds since the epoch, strictly ascending.
    acceleration : (n, 3) ndarray
        Specific force in m/s^2: +9.81 along z if the device is level and at rest.
    angular_rate : (n, 3) ndarray
        In rad/s, about the axes of the device.
    """

    device: str
    time_ns: NDArray[np.int64]
    acceleration: NDArray[np.float64]
    angular_rate: NDArray[np.float64]

    def __post_init__(self) -> None:
        expected = (len(self.time_ns), 3)
        for name in ("acceleration", "angular_rate"):
            if getattr(self, name).shape != expected:
                raise ValueError(f"{name} has shape {getattr(self, name).shape}, not {expected}")

    def __len__(self) -> int:
        return len(self.time_ns)

    def __repr__(self) -> str:
        return f"<InertialSamples of {self.device!r}: {len(self)}>"
