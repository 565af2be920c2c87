"""The sensor array, and what it has measured."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SensorArray:
    """A bar of triaxial magnetometers, and how they measure.

    Its frame: x forward (the direction of travel), y left, z up; the origin is the middle
    of the sensors. Vectors "by axis" are of the array's axes x, y, z.

    Attributes
    ----------
    position_m : (N, 3) ndarray
        Of the sensors, in the array's frame.
    noise_t : (3,) ndarray
        Standard deviation of a sample by axis, in tesla; ``nan`` where unknown.
    delay_s : (3,) ndarray
        When each axis is converted, from the sample's time on: the MLX90393 converts its
        X, Y and Z one after the other.
    quantum_t : (3,) ndarray
        Tesla of a count by axis, 0 where unknown.
    range_t : (3,) ndarray
        Largest field that can be told, by axis; ``inf`` where unknown.
    sensor : str
        Its name and settings, for people.
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
    """Positions (count, 3) of a straight bar across the direction of travel; sensor 0 is
    the rightmost."""
    position = np.zeros((count, 3))
    position[:, 1] = (np.arange(count) - (count - 1) / 2) * spacing_m
    return position


@dataclass(frozen=True)
class Samples:
    """What one array measured, sample by sample.

    Attributes
    ----------
    device : str
    array : SensorArray
    time_ns : (n,) int64 ndarray
        Strictly ascending.
    field_t : (n, N, 3) ndarray
        Tesla in the array's axes; ``nan`` where a sensor gave nothing or was saturated.
    """

    device: str
    array: SensorArray
    time_ns: NDArray[np.int64]
    field_t: Array

    def __post_init__(self) -> None:
        wanted = (len(self.time_ns), len(self.array), 3)
        if self.field_t.shape != wanted:
            raise ValueError(f"field_t has shape {self.field_t.shape}, not {wanted}")

    def __len__(self) -> int:
        return len(self.time_ns)
