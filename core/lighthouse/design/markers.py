"""Points on the floor of a room that are marked and measured, so that they fix frame and scale."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.room import Room
from locatk.core.lighthouse.scene import Marker

Array = NDArray[np.float64]

MARKERS = 4
"""Number of markers: one more than a frame needs, so that a wrong one is found."""

WALL_DISTANCE_M = 0.3
"""Smallest distance of a marker from walls and obstacles [m], so that a device can rest on it."""

ROUNDING_M = 0.05
"""Coordinates of markers are multiples of this length [m], for a tape measure."""


def propose_markers(room: Room, points_m: Array) -> tuple[Marker, ...]:
    """Return markers far from each other at points that are covered.

    Parameters
    ----------
    room : Room
    points_m : (p, 3) ndarray
        Points of photodiodes that stations locate.

    Returns
    -------
    tuple of Marker
        At the lowest height of the photodiodes; fewer than :data:`MARKERS` if there is no space.
    """
    low_m = room.photodiode_z_m[0]
    lowest = points_m[points_m[:, 2] <= points_m[:, 2].min(initial=np.inf) + 1e-9, :2]
    positions = np.unique(np.round(lowest / ROUNDING_M) * ROUNDING_M, axis=0)
    outlines = [room.outline_m, room.working_outline_m, *(o.outline_m for o in room.obstacles)]
    for outline in outlines:
        positions = positions[_distance_m(outline, positions) >= WALL_DISTANCE_M]
    if not len(positions):
        return ()
    # The first is the farthest from the middle; each further one the farthest from the others.
    gap = np.linalg.norm(positions - positions.mean(axis=0), axis=1)
    chosen: list[int] = []
    while len(chosen) < min(MARKERS, len(positions)):
        chosen.append(int(np.argmax(gap)))
        distance = np.linalg.norm(positions - positions[chosen[-1]], axis=1)
        gap = distance if len(chosen) == 1 else np.minimum(gap, distance)
    return tuple(
        Marker(f"marker-{number}", np.append(np.round(positions[index], 3), low_m))
        for number, index in enumerate(chosen, 1)
    )


def _distance_m(outline: Array, points: Array) -> Array:
    """Return the distances (p,) of points (p, 2) from the edges of a polygon (n, 2)."""
    start = outline[:, None]
    edge = np.roll(outline, -1, axis=0)[:, None] - start
    fraction = np.sum((points - start) * edge, axis=-1) / np.sum(edge * edge, axis=-1)
    foot = start + np.clip(fraction, 0.0, 1.0)[..., None] * edge
    return np.asarray(np.linalg.norm(points - foot, axis=-1).min(axis=0, initial=np.inf))
