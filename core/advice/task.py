"""Task of a localization system: area, robots, accuracy wanted, surroundings and limits."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.polygons import checked_outline, rectangle, signed_area
from locatk.core.routes import Route

Array = NDArray[np.float64]

INFRARED = ("none", "windows", "sun")
"""Infrared light in the room: lamps only; daylight through windows; direct sun on the robots."""

IRON = ("none", "reinforced", "plates")
"""Iron in the floor: none within half a metre; reinforced concrete; steel plates or rails."""

FLOOR_WORK = ("print", "glue", "mill")
"""What may be done to the floor: covered with printed sheets, tags glued on, pockets milled."""

MIN_SIDE_M, MAX_SIDE_M = 0.1, 1000.0
"""Shortest and longest side of an area; others are in another unit."""

MAX_ACCURACY_M = 10.0
"""Coarsest accuracy that can be wanted; coarser ones are in another unit."""


@dataclass(frozen=True, eq=False)
class Task:
    """Requirements of a localization system.

    Attributes
    ----------
    size_m : (float, float)
        Sides of the area, if it is a rectangle.
    outline_m : (n, 2) ndarray or None
        Corners of the area, if it is not.
    height_m : float
        Height of the ceiling, or up to which stations can be mounted on walls or tripods.
    may_use_ceiling : bool
        True if stations may be mounted on the ceiling and high on the walls; False: on tripods.
    is_outdoor : bool
    infrared, iron : str
        See :data:`INFRARED` and :data:`IRON`.
    has_motors : bool
        True if strong motors or other machines are within half a metre of the robots' sensors.
    floor_work : frozenset of str
        Some of :data:`FLOOR_WORK`; empty if the floor must not be touched.
    routes : tuple of Route
        Routes of the robots; empty if they drive anywhere.
    robots : int
    speed_mps : float
    is_flying : bool
        True for robots in space, up to 1 m below :attr:`height_m`.
    diameter_m : float
        Size of a robot; robots hide stations from each other.
    clearance_m : float
        Height of the sensors below a robot above the floor.
    has_odometry : bool
    battery_wh : float or None
        Energy of a robot's battery.
    position_m : float
        Position error wanted in 95 % of the time.
    heading_rad : float or None
        Heading error wanted in 95 % of the time; None if the heading is not needed.
    rate_hz : float
        Poses per second wanted.
    latency_s : float or None
        Largest age of a pose.
    power_w : float or None
        Power of a robot for its localization.
    budget : float or None
        For infrastructure and sensors of all robots, in :attr:`currency`.
    currency : str
        Code of ISO 4217.
    hours : float or None
        Working time that is available for the installation.

    Raises
    ------
    InputError
        A value is impossible; the hint names the unit.
    """

    size_m: tuple[float, float] = (5.0, 5.0)
    outline_m: Array | None = None
    height_m: float = 2.5
    may_use_ceiling: bool = True
    is_outdoor: bool = False
    infrared: str = "none"
    iron: str = "none"
    has_motors: bool = False
    floor_work: frozenset[str] = frozenset({"print", "glue"})
    routes: tuple[Route, ...] = field(default=(), compare=False)
    robots: int = 1
    speed_mps: float = 0.3
    is_flying: bool = False
    diameter_m: float = 0.15
    clearance_m: float = 0.01
    has_odometry: bool = True
    battery_wh: float | None = None
    position_m: float = 0.01
    heading_rad: float | None = None
    rate_hz: float = 10.0
    latency_s: float | None = None
    power_w: float | None = None
    budget: float | None = None
    currency: str = "USD"
    hours: float | None = None

    def __post_init__(self) -> None:
        for side in self.size_m:
            _require(side, "a side of the area", "m", 1.0, MIN_SIDE_M, MAX_SIDE_M)
        _require(self.height_m, "the height", "m", 1.0, MIN_SIDE_M, 100.0)
        _require(self.position_m, "the position error wanted", "mm", 1e-3, 0.0, MAX_ACCURACY_M)
        _require(self.speed_mps, "the speed", "m/s", 1.0, 0.0, 100.0)
        _require(self.rate_hz, "the rate", "Hz", 1.0, 0.0, 1e4)
        _require(self.diameter_m, "the diameter of a robot", "mm", 1e-3, 0.0, 10.0)
        _require(self.clearance_m, "the clearance", "mm", 1e-3, 0.0, 1.0)
        for value, name, unit, scale, most in (
            (self.heading_rad, "the heading error wanted", "deg", math.pi / 180, math.pi),
            (self.latency_s, "the latency", "ms", 1e-3, 1e4),
            (self.power_w, "the power", "mW", 1e-3, 1e4),
            (self.budget, "the budget", self.currency, 1.0, 1e12),
            (self.hours, "the working time", "h", 1.0, 1e9),
            (self.battery_wh, "the energy of the battery", "Wh", 1.0, 1e6),
        ):
            if value is not None:
                _require(value, name, unit, scale, 0.0, most)
        if self.robots < 1:
            raise InputError("no robots", hint="Give 1 or more")
        if not (len(self.currency) == 3 and self.currency.isupper()):
            raise InputError(
                f"no currency {self.currency!r}", hint="Give its code, as in USD or EUR (ISO 4217)"
            )
        for word, choices, name in (
            (self.infrared, INFRARED, "infrared"),
            (self.iron, IRON, "iron"),
            *((work, FLOOR_WORK, "floor") for work in self.floor_work),
        ):
            if word not in choices:
                raise InputError(f"{name} {word!r}", hint=f"One of {', '.join(choices)}")
        if self.outline_m is not None:
            object.__setattr__(self, "outline_m", checked_outline(self.outline_m))

    @property
    def corners_m(self) -> Array:
        """(n, 2) corners of the area, counter-clockwise."""
        return rectangle(*self.size_m) if self.outline_m is None else self.outline_m

    @property
    def area_m2(self) -> float:
        """Size of the area."""
        return signed_area(self.corners_m)


def _require(value: float, name: str, unit: str, scale: float, least: float, most: float) -> None:
    """Raise InputError for a value out of its range, in the unit of users."""
    if not (least <= value <= most and value > 0 and math.isfinite(value)):
        low = f"from {least / scale:g}" if least else "above 0"
        raise InputError(
            f"{name} is {value / scale:g} {unit}",
            hint=f"Give a value {low} and at most {most / scale:g} {unit}",
        )
