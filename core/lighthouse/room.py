"""Room in which base stations are mounted: outline, obstacles, mounts, and where photodiodes are.

The frame has its z axis up and z = 0 on the floor; lengths are in metres.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.polygons import MAX_LENGTH_M, checked_outline

Array = NDArray[np.float64]

MOUNTS = ("wall", "ceiling", "tripod")
"""Kinds of places at which a station can be mounted."""

MOUNTING_POSITION_SIGMA_M = 0.02
"""Standard deviation of each coordinate of a station that was mounted by hand at a designed
position [m]: a tape measure along a wall that is not straight, and a rotor whose centre is not
marked on the housing. An assumption; a station that was solved is known to millimetres."""

MOUNTING_ROTATION_SIGMA_RAD = float(np.radians(1.5))
"""Standard deviation of each angle of a station that was mounted by hand with a protractor or with
the level of a phone [rad]. An assumption: their scales have steps of 1 degree."""

MIN_HEIGHT_M = 1e-3
"""Smallest height of a room or of an obstacle [m]."""

MAX_ROBOTS = 10_000


@dataclass(frozen=True)
class Obstacle:
    """Vertical prism that light does not pass.

    Attributes
    ----------
    outline_m : (n, 2) ndarray
        Corners, counter-clockwise.
    low_m, high_m : float
        Heights of its lower and upper face.
    name : str
    """

    outline_m: Array
    low_m: float
    high_m: float
    name: str = ""

    def __post_init__(self) -> None:
        """Check the numbers; raise InputError if they describe no prism."""
        object.__setattr__(self, "outline_m", checked_outline(self.outline_m))
        if not self.high_m - self.low_m >= MIN_HEIGHT_M:
            raise InputError("the upper face of an obstacle is not above its lower face")


@dataclass(frozen=True)
class RobotSize:
    """Robots that hide each other's photodiodes: vertical cylinders on the floor.

    Attributes
    ----------
    count : int
        Number of robots in the working area, the one that is localized included.
    radius_m, height_m : float
    """

    count: int = 1
    radius_m: float = 0.1
    height_m: float = 0.1

    def __post_init__(self) -> None:
        """Check the numbers; raise InputError if they are out of range."""
        if not 1 <= self.count <= MAX_ROBOTS:
            raise InputError(f"{self.count} robots", hint=f"Give 1 to {MAX_ROBOTS}")
        if not (0 < self.radius_m <= MAX_LENGTH_M and 0 < self.height_m <= MAX_LENGTH_M):
            raise InputError("radius and height of a robot must be above 0")


@dataclass(frozen=True)
class Room:
    """Room with its working volume and the places for stations.

    Attributes
    ----------
    outline_m : (n, 2) ndarray
        Corners of the walls; they are stored counter-clockwise.
    height_m : float
        Height of the ceiling.
    photodiode_z_m : (low, high)
        Heights of the photodiodes; equal if all devices move on one plane.
    area_m : (k, 2) ndarray or None
        Outline of the working area; None if it is the whole room.
    obstacles : tuple of Obstacle
    mounts : tuple of str
        Kinds of mounting places, of :data:`MOUNTS`.
    tripods_m : (t, 3) ndarray
        Positions of stations on tripods, with their heights.
    robots : RobotSize or None
        None if robots hide nothing from each other.

    Raises
    ------
    InputError
        An outline crosses itself or has no area, or a number is out of range.
    """

    outline_m: Array
    height_m: float
    photodiode_z_m: tuple[float, float] = (0.0, 0.0)
    area_m: Array | None = None
    obstacles: tuple[Obstacle, ...] = ()
    mounts: tuple[str, ...] = ("wall", "ceiling")
    tripods_m: Array = field(default_factory=lambda: np.zeros((0, 3)))
    robots: RobotSize | None = None

    def __post_init__(self) -> None:
        """Check the numbers, and store outlines counter-clockwise."""
        object.__setattr__(self, "outline_m", checked_outline(self.outline_m))
        if self.area_m is not None:
            object.__setattr__(self, "area_m", checked_outline(self.area_m))
        object.__setattr__(self, "tripods_m", np.asarray(self.tripods_m, float).reshape(-1, 3))
        low, high = self.photodiode_z_m
        if not MIN_HEIGHT_M <= self.height_m <= MAX_LENGTH_M:
            raise InputError(f"a room of {self.height_m:g} m height", hint="Give it in metres")
        if not 0 <= low <= high < self.height_m:
            raise InputError(
                f"photodiodes from {low:g} to {high:g} m in a room of {self.height_m:g} m",
                hint="Give heights from the floor to below the ceiling, the lower one first",
            )
        unknown = [mount for mount in self.mounts if mount not in MOUNTS]
        if unknown or not self.mounts:
            raise InputError(
                f"no kind of mount {unknown[0]!r}" if unknown else "no mounts",
                hint=f"Kinds of mounts: {', '.join(MOUNTS)}",
            )
        if "tripod" in self.mounts and not len(self.tripods_m):
            raise InputError(
                "no positions of tripods", hint="Give them, or omit this kind of mount"
            )
        if not np.all(np.abs(self.tripods_m) <= MAX_LENGTH_M):
            raise InputError("the position of a tripod is not finite, or not in metres")

    @property
    def is_planar(self) -> bool:
        """True if all photodiodes are at one height."""
        return self.photodiode_z_m[0] == self.photodiode_z_m[1]

    @property
    def working_outline_m(self) -> Array:
        """Outline (k, 2) of the working area."""
        return self.outline_m if self.area_m is None else self.area_m


def hand_mounting_covariance() -> Array:
    """Return the covariance (6, 6) of position and rotation of a station mounted by hand."""
    sigma = np.repeat([MOUNTING_POSITION_SIGMA_M, MOUNTING_ROTATION_SIGMA_RAD], 3)
    return np.diag(sigma**2)
