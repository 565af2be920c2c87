"""Hall sensors under a robot, and their samples."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

NAMES = ("front", "left", "rear", "right")


def circle(radius_m: float = 0.025) -> Array:
    """Return positions (4, 2) of front, left, rear and right sensor on a circle, in metres."""
    return radius_m * np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])


@dataclass(frozen=True)
class HallSensors:
    """Hall sensors under a robot that measure the vertical field: the artifact ``halls.toml``.

    The robot's frame: x forward, y left, z up; the origin is the midpoint of its wheels, about
    which it rotates. Fields that point up are positive.

    Attributes
    ----------
    names : tuple of str
        In the order of the columns of :attr:`HallSamples.field_t`.
    position_m : (N, 2) ndarray
        In the robot's frame.
    noise_t : float
        Standard deviation of a sample in tesla; ``nan`` if unknown.
    range_t : float
        Largest field that a sensor can report, in tesla; ``inf`` if unknown.
    sensor : str
        Part number and settings, for people.
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
    """Samples of the hall sensors of one robot.

    Attributes
    ----------
    device : str
    sensors : HallSensors
    time_ns : (n,) int64 ndarray
        Strictly ascending.
    field_t : (n, N) ndarray
        Tesla; ``nan`` if a sensor reported nothing. A value at the end of the sensors' range is
        saturated: the field is at least as large.
    """

    device: str
    sensors: HallSensors
    time_ns: NDArray[np.int64]
    field_t: Array

    def __post_init__(self) -> None:
        expected = (len(self.time_ns), len(self.sensors))
        if self.field_t.shape != expected:
            raise ValueError(f"field_t has shape {self.field_t.shape}, not {expected}")

    def __len__(self) -> int:
        return len(self.time_ns)

    def __repr__(self) -> str:
        return f"<HallSamples of {self.device!r}: {len(self)}>"
