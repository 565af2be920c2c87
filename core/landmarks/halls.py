"""The robot's hall sensors, and what they have measured."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

NAMES = ("front", "left", "rear", "right")


def circle(radius_m: float = 0.025) -> Array:
    """Positions (4, 2) of front, left, rear and right on a circle, in the robot's frame."""
    return radius_m * np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])


@dataclass(frozen=True)
class HallSensors:
    """Hall sensors under a robot that measure the upright field: the artifact ``halls.toml``.

    The robot's frame: x forward, y left, z up; the origin is the middle of its wheels,
    about which it turns. What is positive is a field that points up.

    Attributes
    ----------
    names : tuple of str
        In the order of the columns of :attr:`HallSamples.field_t`.
    position_m : (N, 2) ndarray
        In the robot's frame.
    noise_t : float
        Standard deviation of a sample in tesla; ``nan`` where unknown.
    range_t : float
        Largest field that can be told; ``inf`` where unknown.
    sensor : str
        Its name and settings, for people.
    """

    names: tuple[str, ...] = NAMES
    position_m: Array = field(default_factory=circle)
    noise_t: float = float("nan")
    range_t: float = float("inf")
    sensor: str = ""

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True)
class HallSamples:
    """What the hall sensors of one robot measured, sample by sample.

    Attributes
    ----------
    device : str
    sensors : HallSensors
    time_ns : (n,) int64 ndarray
        Strictly ascending.
    field_t : (n, N) ndarray
        Tesla; ``nan`` where a sensor gave nothing. At and beyond the sensors' range a
        value is saturated and says only that the field is as large.
    """

    device: str
    sensors: HallSensors
    time_ns: NDArray[np.int64]
    field_t: Array

    def __post_init__(self) -> None:
        wanted = (len(self.time_ns), len(self.sensors))
        if self.field_t.shape != wanted:
            raise ValueError(f"field_t has shape {self.field_t.shape}, not {wanted}")

    def __len__(self) -> int:
        return len(self.time_ns)
