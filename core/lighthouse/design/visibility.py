"""Visibility of base stations in a room: field of view, range, walls, obstacles and robots.

All tests are for s stations and p points at once and return arrays (s, p). Light travels along the
segment between both. Reflections are not modelled: a receiver rejects them as outliers.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.room import RobotSize, Room
from locatk.core.polygons import is_inside

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

FIELD_OF_VIEW_RAD = (float(np.radians(150.0)), float(np.radians(110.0)))
"""Horizontal and vertical field of view of a station [rad]. HTC states 150 x 110 degrees for the
SteamVR Base Station 2.0, Valve 160 x 115 degrees for the same station. The smaller one is planned
with: at the edges the beam is weak (lighthouse paper, II.B: "at a high angle of incidence")."""

MAX_RANGE_M = 7.0
"""Largest distance at which a station is received [m]: HTC states 7 m from station to device, and
10 x 10 m for four stations."""

MEASURED_RANGE_M = 5.0
"""Largest distance for which reception was published [m]. The paper decodes reliably at 5 m (II.B);
all 103 bursts of Bitcraze's recording at 4 m are decoded, and few of that at 6.2 m
(bitcraze/lighthouse-fpga, test_data/about_4m.csv and about_6.2m.csv). Between this and
:data:`MAX_RANGE_M`, the statement of the manufacturer is all that is known."""

SURFACE_TOLERANCE_M = 1e-6
"""Stations and photodiodes this close to a wall or a face of an obstacle are not inside it [m]."""

MAX_TESTS = 1_000_000
"""Number of edges that are compared with rays at once: some arrays of 8 MB."""

_OWN_DISC = np.sqrt(3.0) / 2.0 + np.pi / 3.0
"""Mean length, in radii of a robot, of the strip around a ray that lies within two radii of its
start: the mean of sqrt(4 - y^2) for y from -1 to 1."""


def in_field_of_view(
    position_m: Array,
    rotation: Array,
    points_m: Array,
    field_of_view_rad: tuple[float, float] = FIELD_OF_VIEW_RAD,
    max_range_m: float = MAX_RANGE_M,
) -> BoolArray:
    """Return True for the points (p, 3) that are within the beam and the range of stations.

    Parameters
    ----------
    position_m : (s, 3) ndarray
    rotation : (s, 3, 3) ndarray
        From station (x forward, y left, z up) to room.
    points_m : (p, 3) ndarray
    field_of_view_rad : (horizontal, vertical)
    max_range_m : float
    """
    offset = points_m[None] - position_m[:, None]
    local = np.einsum("spi,sij->spj", offset, rotation)
    across = np.hypot(local[..., 0], local[..., 1])
    is_inside = np.abs(np.arctan2(local[..., 1], local[..., 0])) <= field_of_view_rad[0] / 2
    is_inside &= np.abs(np.arctan2(local[..., 2], across)) <= field_of_view_rad[1] / 2
    return np.asarray(is_inside & (np.linalg.norm(local, axis=-1) <= max_range_m))


def has_line_of_sight(room: Room, position_m: Array, points_m: Array) -> BoolArray:
    """Return True if neither walls nor obstacles are between stations (s, 3) and points (p, 3)."""
    is_clear = np.ones((len(position_m), len(points_m)), bool)
    corners = max(len(outline) for outline in (room.outline_m, *_obstacle_outlines(room)))
    chunk = max(1, MAX_TESTS // (corners * max(1, len(points_m))))
    is_convex = _is_convex(room.outline_m)
    for first in range(0, len(position_m), chunk):
        part = slice(first, first + chunk)
        stations = position_m[part]
        if not is_convex:
            is_clear[part] &= ~_crosses_edges(
                room.outline_m, stations[:, None, :2], points_m[None, :, :2]
            )
        for obstacle in room.obstacles:
            is_clear[part] &= ~_passes_prism(
                obstacle.outline_m, obstacle.low_m, obstacle.high_m, stations, points_m
            )
    return is_clear


def faces(position_m: Array, points_m: Array) -> BoolArray:
    """Return True (s, p) if stations (s, 3) are above photodiodes (p, 3) that point upwards.

    Light that arrives almost horizontally counts as received, as from stations on the walls of a
    large floor.
    """
    return np.asarray(position_m[:, None, 2] > points_m[None, :, 2])


def blocked_fraction(
    robots: RobotSize | None, area_m2: float, position_m: Array, points_m: Array
) -> Array:
    """Return the fraction (s, p) of time that another robot is between a station and a point.

    Parameters
    ----------
    robots : RobotSize or None
        Vertical cylinders. One carries the photodiode in its centre; the others are anywhere in
        the working area with equal probability, but not within it.
    area_m2 : float
        Working area.
    position_m : (s, 3) ndarray
    points_m : (p, 3) ndarray

    Notes
    -----
    A robot blocks the ray if its centre is within a radius R of the part of the ray that is below
    its height. In plan this part has the length L, and the strip around it, without the disc of
    radius 2 R that the own robot keeps free, has the area ``2 R (L - 1.913 R) + pi R^2 / 2``. The
    number of centres in it is binomial.
    """
    shape = (len(position_m), len(points_m))
    if robots is None or robots.count < 2:
        return np.zeros(shape)
    offset = position_m[:, None] - points_m[None]
    across = np.hypot(offset[..., 0], offset[..., 1])
    above = robots.height_m - points_m[None, :, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        fraction = np.where(offset[..., 2] > above, above / offset[..., 2], 1.0)
    length = across * np.clip(np.where(above > 0, fraction, 0.0), 0.0, 1.0)
    radius = robots.radius_m
    strip = 2 * radius * (length - _OWN_DISC * radius) + 0.5 * np.pi * radius**2
    strip = np.where(length > radius, np.maximum(strip, 0.0), 0.0)
    free_m2 = max(area_m2 - 4 * np.pi * radius**2, 4 * np.pi * radius**2)
    blocked = 1.0 - (1.0 - np.minimum(strip / free_m2, 1.0)) ** (robots.count - 1)
    return np.asarray(blocked)


def in_obstacle(room: Room, points_m: Array) -> BoolArray:
    """Return True for the points (p, 3) inside an obstacle."""
    inside = np.zeros(len(points_m), bool)
    for obstacle in room.obstacles:
        is_level = (points_m[:, 2] >= obstacle.low_m) & (points_m[:, 2] <= obstacle.high_m)
        inside |= is_level & is_inside(obstacle.outline_m, points_m[:, :2])
    return inside


def _obstacle_outlines(room: Room) -> tuple[Array, ...]:
    return tuple(obstacle.outline_m for obstacle in room.obstacles)


def _is_convex(outline_m: Array) -> bool:
    edge = np.roll(outline_m, -1, axis=0) - outline_m
    following = np.roll(edge, -1, axis=0)
    cross = edge[:, 0] * following[:, 1] - edge[:, 1] * following[:, 0]
    return bool(np.all(cross >= -1e-9))


def _edge_crossings(outline_m: Array, start: Array, end: Array) -> Array:
    """Return where segments (..., 2) cross the edges of a polygon, as fractions (..., n).

    They are infinite for edges that are not crossed.
    """
    a, b = outline_m, np.roll(outline_m, -1, axis=0)
    edge = b - a
    along = (end - start)[..., None, :]
    offset = a - start[..., None, :]
    cross = along[..., 0] * edge[:, 1] - along[..., 1] * edge[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        on_segment = (offset[..., 0] * edge[:, 1] - offset[..., 1] * edge[:, 0]) / cross
        on_edge = (offset[..., 0] * along[..., 1] - offset[..., 1] * along[..., 0]) / cross
    is_hit = (cross != 0) & (on_edge >= 0) & (on_edge <= 1) & (on_segment > 0) & (on_segment < 1)
    return np.where(is_hit, on_segment, np.inf)


def _crosses_edges(outline_m: Array, start: Array, end: Array) -> BoolArray:
    """Return True for segments from (s, 1, 2) to (1, p, 2) that leave a polygon between their ends.

    The ends may be on walls.
    """
    start, end = np.broadcast_arrays(start, end)
    fraction = _edge_crossings(outline_m, start, end)
    length = np.linalg.norm(end - start, axis=-1)[..., None]
    is_hit = np.isfinite(fraction)
    nearest = np.where(is_hit, np.minimum(fraction, 1.0 - fraction), 0.0)
    return np.asarray(np.any(nearest * length > SURFACE_TOLERANCE_M, axis=-1))


def _passes_prism(
    outline_m: Array, low_m: float, high_m: float, position_m: Array, points_m: Array
) -> BoolArray:
    """Return True for the segments from stations to points that pass through a vertical prism."""
    start, end = np.broadcast_arrays(position_m[:, None], points_m[None])
    along = end - start
    # The part of the segment between the heights of both faces, a little inside.
    low, high = low_m + SURFACE_TOLERANCE_M, high_m - SURFACE_TOLERANCE_M
    with np.errstate(divide="ignore", invalid="ignore"):
        to_low, to_high = ((z - start[..., 2]) / along[..., 2] for z in (low, high))
    is_flat = along[..., 2] == 0
    is_level = (start[..., 2] > low) & (start[..., 2] < high)
    first = np.where(is_flat, np.where(is_level, 0.0, 2.0), np.minimum(to_low, to_high))
    last = np.where(is_flat, np.where(is_level, 1.0, -1.0), np.maximum(to_low, to_high))
    first, last = np.maximum(first, 0.0), np.minimum(last, 1.0)
    meets = np.asarray(first < last)
    if not np.any(meets):
        return meets
    part_start = start[meets][:, :2] + first[meets][:, None] * along[meets][:, :2]
    part_end = start[meets][:, :2] + last[meets][:, None] * along[meets][:, :2]
    middle = 0.5 * (part_start + part_end)
    is_hit = is_inside(outline_m, middle)
    is_hit |= np.any(np.isfinite(_edge_crossings(outline_m, part_start, part_end)), axis=-1)
    meets[meets] = is_hit
    return meets
