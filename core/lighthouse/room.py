"""Room in which base stations are mounted: outline, obstacles, mounts, and where photodiodes are.

The frame has its z axis up and z = 0 on the floor; lengths are in metres.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from locatk.core.errors import InputError

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

MIN_EDGE_M = 1e-3
"""Shortest edge of an outline [m]."""

MIN_HEIGHT_M = 1e-3
"""Smallest height of a room or of an obstacle [m]."""

MAX_LENGTH_M = 1e3
"""Largest coordinate of a room [m]: a larger number is in another unit."""

MAX_CORNERS = 1000
"""Largest number of corners of an outline."""

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


def rectangle(length_m: float, width_m: float, origin_m: tuple[float, float] = (0.0, 0.0)) -> Array:
    """Return the outline (4, 2) of a rectangle with its lower left corner at ``origin_m``."""
    x, y = origin_m
    corners = [(x, y), (x + length_m, y), (x + length_m, y + width_m), (x, y + width_m)]
    return np.array(corners, float)


def signed_area(outline: Array) -> float:
    """Return the area of a polygon (n, 2), negative if it is clockwise."""
    # Relative to a corner, so that products of large coordinates lose no digits.
    x, y = (outline - outline[0]).T
    return float(0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def checked_outline(outline: ArrayLike) -> Array:
    """Return the corners (n, 2) of a simple polygon counter-clockwise.

    A last corner that repeats the first is removed.

    Raises
    ------
    InputError
        It is not a polygon with an area, crosses itself, or is not in metres.
    """
    corners = np.array(outline, float)
    if corners.ndim != 2 or corners.shape[1] != 2:
        raise InputError("an outline is not a list of x and y")
    if not np.all(np.abs(corners) <= MAX_LENGTH_M):
        raise InputError(f"an outline beyond {MAX_LENGTH_M:g} m", hint="Check the unit")
    if len(corners) > 1 and np.allclose(corners[0], corners[-1], rtol=0, atol=1e-9):
        corners = corners[:-1]
    if not 3 <= len(corners) <= MAX_CORNERS:
        raise InputError(
            f"an outline of {len(corners)} corners", hint=f"Give 3 to {MAX_CORNERS} corners"
        )
    edges = np.roll(corners, -1, axis=0) - corners
    if np.min(np.hypot(*edges.T)) < MIN_EDGE_M:
        raise InputError("two corners of an outline at the same position")
    if _crosses_itself(corners):
        raise InputError(
            "an outline that crosses or touches itself", hint="List the corners along the walls"
        )
    area = signed_area(corners)
    if abs(area) < MIN_EDGE_M**2:
        raise InputError("an outline without area")
    return corners if area > 0 else corners[::-1].copy()


def _crosses_itself(corners: Array) -> bool:
    """Return True if two edges that are no neighbours meet."""
    n = len(corners)
    start, end = corners, np.roll(corners, -1, axis=0)

    def side(a: Array, b: Array, c: Array) -> Array:
        u, v = b - a, c - a
        return np.asarray(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0])

    a, b = start[:, None], end[:, None]
    c, d = start[None], end[None]
    size = float(np.max(np.ptp(corners, axis=0)))
    tolerance = 1e-12 * size**2
    of_c, of_d, of_a, of_b = side(a, b, c), side(a, b, d), side(c, d, a), side(c, d, b)
    # Both ends of one edge are on one side of the other, or all four points are on a line and the
    # bounding boxes are apart.
    is_apart = (np.minimum(of_c, of_d) > tolerance) | (np.maximum(of_c, of_d) < -tolerance)
    is_apart |= (np.minimum(of_a, of_b) > tolerance) | (np.maximum(of_a, of_b) < -tolerance)
    low_1, high_1 = np.minimum(a, b), np.maximum(a, b)
    low_2, high_2 = np.minimum(c, d), np.maximum(c, d)
    is_apart |= np.any((low_1 > high_2) | (low_2 > high_1), axis=-1)
    distance = (np.arange(n)[None] - np.arange(n)[:, None]) % n
    is_neighbour = (distance <= 1) | (distance == n - 1)
    # A neighbour that folds back onto its edge ends on it, where the edge after it begins.
    return bool(np.any(~is_apart & ~is_neighbour))
