"""Array of magnetometers, and its samples."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SensorArray:
    """Bar of triaxial magnetometers.

    Its frame: x forward (the direction of travel), y left, z up; the origin is the middle of the
    sensors. Vectors "by axis" are in the order of the array's axes x, y, z.

    Attributes
    ----------
    position_m : (N, 3) ndarray
        Positions of the sensors in the array's frame.
    noise_t : (3,) ndarray
        Standard deviation of a sample by axis [T]; ``nan`` if unknown.
    delay_s : (3,) ndarray
        Time of conversion of each axis minus the time of the sample [s]: the MLX90393 converts its
        X, Y and Z one after the other.
    quantum_t : (3,) ndarray
        Field per count by axis [T]; 0 if unknown.
    range_t : (3,) ndarray
        Largest measurable field by axis [T]; ``inf`` if unknown.
    sensor : str
        Name and settings of the sensors, for reports.
    """

    position_m: Array
    noise_t: Array = field(default_factory=lambda: np.full(3, np.nan))
    delay_s: Array = field(default_factory=lambda: np.zeros(3))
    quantum_t: Array = field(default_factory=lambda: np.zeros(3))
    range_t: Array = field(default_factory=lambda: np.full(3, np.inf))
    sensor: str = ""

    def __len__(self) -> int:
        return len(self.position_m)


def bar(count: int, spacing_m: float) -> Array:
    """Return the positions (count, 3) of a straight bar across the direction of travel.

    Sensor 0 is the rightmost.
    """
    position = np.zeros((count, 3))
    position[:, 1] = (np.arange(count) - (count - 1) / 2) * spacing_m
    return position


@dataclass(frozen=True)
class Samples:
    """Samples of one array.

    Attributes
    ----------
    device : str
    array : SensorArray
    time_ns : (n,) int64 ndarray
        Strictly ascending.
    field_t : (n, N, 3) ndarray
        Field in the array's axes [T]; ``nan`` if a sensor gave no sample or was saturated.
    """

    device: str
    array: SensorArray
    time_ns: NDArray[np.int64]
    field_t: Array

    def __post_init__(self) -> None:
        expected = (len(self.time_ns), len(self.array), 3)
        if self.field_t.shape != expected:
            raise ValueError(f"field_t has shape {self.field_t.shape}, not {expected}")

    def __len__(self) -> int:
        return len(self.time_ns)

    def __repr__(self) -> str:
        return f"<Samples of {self.device!r}: {len(self)}>"
