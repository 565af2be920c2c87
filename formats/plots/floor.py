"""The floor of landmarks under a solution: bars, walls, and where landmarks were seen."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import Similarity
from locatk.core.landmarks.drawing.floor_bars import (
    MIN_DRAWN_STRENGTH,
    bars_on_floor,
    cells_near,
)
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

NORTH_COLOR, SOUTH_COLOR, WEAK_COLOR, WALL_COLOR = "#C0392B", "#8FA8C8", "#999999", "#595959"
SEEN_COLOR, REFUSED_COLOR = "#009E73", "#7F3C8D"

MOST_NAMED = 40
"""So many landmarks in the picture get their row and column, at most."""

LATE_NS = 1_000_000_000
"""A sighting without a place of its own is drawn on the path, where that is no farther away."""


@dataclass(frozen=True)
class Floor:
    """Landmarks on the map; all (..., 3) in metres.

    Attributes
    ----------
    north, south, weak : (M, 4, 3) ndarray
        Corners of the halves of bars, and of whole bars that are weak or missing.
    walls : (W, 2, 3) ndarray
        Their ends.
    centres : (L, 3) ndarray
    names : tuple of str
        Row and column of each.
    met : (L,) bool ndarray
        Which were seen.
    seen, refused : (K, 3) ndarray
        Where the robots were when they saw a landmark, and what was refused of that.
    reach_m : float
        From a landmark's centre to the far side of its bars.
    """

    north: Array
    south: Array
    weak: Array
    walls: Array
    centres: Array
    names: tuple[str, ...]
    met: NDArray[np.bool_]
    seen: Array
    refused: Array
    reach_m: float

    def moved(self, to: Similarity) -> Floor:
        """The same in another frame."""

        def there(points: Array) -> Array:
            return to.apply(points.reshape(-1, 3)).reshape(points.shape)

        return Floor(
            there(self.north),
            there(self.south),
            there(self.weak),
            there(self.walls),
            there(self.centres),
            self.names,
            self.met,
            there(self.seen),
            there(self.refused),
            self.reach_m * to.scale,
        )


def floor_of(solution: Solution) -> Floor | None:
    """The floor on which the poses of a solution stand, None where there is none."""
    floor = solution.artifact
    if not isinstance(floor, FloorMap):
        return None
    cells = cells_near(floor, [t.position for t in solution.trajectories])
    met = {found.cell for found in solution.detections if found.cell is not None}
    north, south, weak = _bars(floor, cells)
    seen, refused = _sightings(solution, floor)
    return Floor(
        north,
        south,
        weak,
        _walls(floor),
        _flat([floor.position(cell) for cell in cells]),
        tuple(f"{row},{column}" for row, column in cells),
        np.array([cell in met for cell in cells], bool),
        seen,
        refused,
        floor.geometry.radius_m + floor.geometry.bar_width_m / 2,
    )


def _bars(floor: FloorMap, cells: Sequence[tuple[int, int]]) -> tuple[Array, Array, Array]:
    """Corners of the north and the south halves of bars, and of weak ones."""
    if not cells:
        return (np.zeros((0, 4, 3)),) * 3
    laid = [bars_on_floor(floor, cell) for cell in cells]
    middle = np.concatenate([bars[0] for bars in laid])
    heading = np.concatenate([bars[1] for bars in laid])
    strong = np.abs(np.concatenate([bars[2] for bars in laid])) >= MIN_DRAWN_STRENGTH
    way = np.column_stack([np.cos(heading), np.sin(heading)])
    long = way * floor.geometry.bar_length_m / 2
    wide = way[:, ::-1] * [-1, 1] * floor.geometry.bar_width_m / 2

    def corners(start: Array, stop: Array, which: NDArray[np.bool_]) -> Array:
        ring = np.stack([start - wide, stop - wide, stop + wide, start + wide], axis=1)
        return _flat(ring[which])

    return (
        corners(middle, middle + long, strong),
        corners(middle - long, middle, strong),
        corners(middle - long, middle + long, ~strong),
    )


def _walls(floor: FloorMap) -> Array:
    """Ends of a line between the two cells of each wall, across the way from one to the other."""
    ends = []
    for one, other in sorted(floor.walls):
        a, b = np.array(floor.position(one)), np.array(floor.position(other))
        across = (b - a)[::-1] * [-1, 1] / 2
        ends.append([(a + b) / 2 - across, (a + b) / 2 + across])
    return _flat(np.array(ends).reshape(-1, 2, 2))


def _sightings(solution: Solution, floor: FloorMap) -> tuple[Array, Array]:
    """Places of the robots at their sightings: used ones, and refused ones."""
    paths = {t.device: t for t in solution.trajectories if len(t)}
    used: list[Array] = []
    refused: list[Array] = []
    for found in solution.detections:
        place = _on_path(paths.get(found.device), found.time_s)
        if place is None and found.cell is not None and found.x_m is not None:
            x, y = floor.position(found.cell)
            place = np.array([x + found.x_m, y + found.y_m])
        if place is not None:
            (refused if found.refused else used).append(place)
    return _flat(used), _flat(refused)


def _on_path(path: Trajectory | None, time_s: float) -> Array | None:
    if path is None or not math.isfinite(time_s):
        return None
    time_ns = round(1e9 * time_s)
    nearest = int(np.argmin(np.abs(path.time_ns - time_ns)))
    late = abs(int(path.time_ns[nearest]) - time_ns) > LATE_NS
    return None if late else path.position[nearest, :2]


def _flat(points: Any) -> Array:
    """(..., 2) as (..., 3), on the ground."""
    flat = np.asarray(points, float)
    flat = flat.reshape(*flat.shape[:-1], 2) if flat.size else flat.reshape(-1, 2)
    return np.concatenate([flat, np.zeros((*flat.shape[:-1], 1))], axis=-1)


def solid(floor: Floor) -> list[Array]:
    """What of the floor the view must hold: the landmarks that were seen, else all."""
    shown = floor.centres[floor.met] if floor.met.any() else floor.centres
    return [shown - floor.reach_m, shown + floor.reach_m]
