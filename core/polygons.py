"""Simple polygons in the plane: outlines of rooms and areas."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from locatk.core.errors import InputError

Array = NDArray[np.float64]

MIN_EDGE_M = 1e-3
"""Shortest edge of an outline [m]."""

MAX_LENGTH_M = 1e3
"""Largest coordinate of a polygon [m]: a larger number is in another unit."""

MAX_CORNERS = 1000
"""Largest number of corners of an outline."""


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


def is_inside(outline_m: Array, points_m: Array) -> NDArray[np.bool_]:
    """Return True for the points (..., 2) inside a polygon (n, 2); either value on its edges."""
    x, y = points_m[..., None, 0], points_m[..., None, 1]
    x1, y1 = outline_m.T
    x2, y2 = np.roll(outline_m, -1, axis=0).T
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing_x = x1 + (y - y1) * (x2 - x1) / (y2 - y1)
    is_right = ((y1 > y) != (y2 > y)) & (x < crossing_x)
    return np.asarray(np.count_nonzero(is_right, axis=-1) % 2 == 1)


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
