"""The way to the next landmark (section 4.1) and the place on the map (section 4.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from locatk.core.errors import DegenerateError
from locatk.core.landmarks.detection.hypotheses import VisitHypotheses
from locatk.core.landmarks.landmark import PATTERN_OF, rotated
from locatk.core.landmarks.map.floor import HOLE, Cell, FloorMap, neighbour

Array = NDArray[np.float64]

L_TURNS = (0, 1)
"""Quarter turns before each of the two steps of an L: ahead, then to the left."""

QUARTER = math.pi / 2

ASTRAY = 0.25
"""Of the pitch and of a quarter turn: what a step to the next landmark may be off."""

STRAIGHT = 1e7
"""Radius over distance from which on two arcs are a straight line to rounding."""


@dataclass(frozen=True)
class Landing:
    """Two arcs of one radius that turn to opposite sides.

    Attributes
    ----------
    radius_m : float
        ``inf`` where the way is straight.
    arc_rad : (float, float)
        Turn on each arc, positive to the left; 0 where the way is straight.
    length_m : float
    """

    radius_m: float
    arc_rad: tuple[float, float]
    length_m: float

    def poses(self, start: ArrayLike, way_m: ArrayLike) -> Array:
        """Poses (n, 3) after ``way_m`` (n,) along the curve, which began at ``start``."""
        way = np.clip(np.atleast_1d(np.asarray(way_m, float)), 0, self.length_m)
        x, y, heading = np.asarray(start, float)
        if math.isinf(self.radius_m):
            ahead = way[:, None] * [math.cos(heading), math.sin(heading), 0.0]
            return np.asarray([x, y, heading] + ahead)
        first = abs(self.arc_rad[0]) * self.radius_m
        pose = _along(np.array([[x, y, heading]]), np.minimum(way, first), self._bend(0))
        return _along(pose, np.maximum(way - first, 0), self._bend(1))

    def _bend(self, arc: int) -> float:
        return math.copysign(1 / self.radius_m, self.arc_rad[arc])


def _along(pose: Array, way: Array, bend: float) -> Array:
    """Poses (n, 3) after ways (n,) on a circle of curvature ``bend`` from poses (n or 1, 3)."""
    turn = way * bend
    half = pose[:, 2] + turn / 2
    chord = way * np.sinc(turn / 2 / np.pi)
    return np.column_stack(
        [pose[:, 0] + chord * np.cos(half), pose[:, 1] + chord * np.sin(half), pose[:, 2] + turn]
    )


def landing(start: ArrayLike, goal: ArrayLike) -> Landing:
    """The landing curve: from a pose beside the track to one on it, by two equal arcs.

    Parameters
    ----------
    start, goal : (3,) array_like
        x, y, heading. With the pose error of section 4.1 as the start in the frame of the
        present landmark, the goal is ``(pitch, 0, 0)``.

    Returns
    -------
    Landing
        The shorter of the curves that turn left or right first.

    Raises
    ------
    DegenerateError
        Start and goal are one place, or the goal lies straight behind.

    Notes
    -----
    The paper names it (section 4.1, after its [32]) without equations. The centres of the
    arcs lie one radius R to opposite sides of start and goal, and 2 R from each other:
    ``(|u|^2 - 4) R^2 + 2 d.u R + |d|^2 = 0`` with d from goal to start and u the sum of
    both normals, which has one positive solution for either side of the first turn.
    """
    start, goal = np.asarray(start, float), np.asarray(goal, float)
    d = start[:2] - goal[:2]
    square = float(d @ d)
    if square == 0:
        raise DegenerateError("a landing curve needs two places")
    normals = [np.array([-math.sin(a), math.cos(a)]) for a in (start[2], goal[2])]
    found = []
    for side in (1.0, -1.0):
        u = side * (normals[0] + normals[1])
        a, b = float(u @ u) - 4.0, 2.0 * float(d @ u)
        root = math.sqrt(max(b * b - 4 * a * square, 0.0))
        # Of the two forms of the positive solution the one without cancellation.
        below = root - b if b <= 0 else -4 * a * square / (root + b)
        if below * STRAIGHT <= 2 * math.sqrt(square):
            continue
        radius = 2 * square / below
        one = start[:2] + side * radius * normals[0]
        other = goal[:2] - side * radius * normals[1]
        middle = (one + other) / 2
        arcs = (
            side * _sweep(start[:2] - one, middle - one, side),
            -side * _sweep(middle - other, goal[:2] - other, -side),
        )
        length = radius * (abs(arcs[0]) + abs(arcs[1]))
        found.append(Landing(radius, arcs, length))
    if not found:
        if d @ [math.cos(start[2]), math.sin(start[2])] > 0:
            raise DegenerateError("the goal lies straight behind: no landing curve leads there")
        return Landing(math.inf, (0.0, 0.0), math.sqrt(square))
    return min(found, key=lambda curve: curve.length_m)


def _sweep(before: Array, after: Array, side: float) -> float:
    """Angle within 0 .. 2 pi from one direction to another, to the left for side 1."""
    turn = math.atan2(before[0] * after[1] - before[1] * after[0], float(before @ after)) * side
    # A turn of nothing may come out a rounding below it.
    return turn % math.tau if turn < -1e-9 else max(turn, 0.0)


def sequence(
    sightings: Sequence[VisitHypotheses], pitch_m: float
) -> tuple[tuple[int, ...], tuple[int, ...]] | None:
    """Codes and turns of landmarks that were visited one after the other, for :func:`locate`.

    Parameters
    ----------
    sightings : sequence of Sighting
        Each with a hypothesis; the best counts.
    pitch_m : float
        Between neighbouring cells.

    Returns
    -------
    codes, turns : tuple of int
        None where by odometry two of them in a row are not one cell apart: then one was
        not seen between them.
    """
    places, frames = [], []
    for seen in sightings:
        x, y, turn = seen.best.pose
        frame = float(seen.odometry[2] - turn)
        cos, sin = math.cos(frame), math.sin(frame)
        places.append(seen.odometry[:2] - [cos * x - sin * y, sin * x + cos * y])
        frames.append(frame)
    # All in the frame of the first landmark, in quarter turns.
    quarters = [round((frame - frames[0]) / QUARTER) for frame in frames]
    steps = []
    for k in range(len(places) - 1):
        way = places[k + 1] - places[k]
        if abs(np.hypot(*way) - pitch_m) > ASTRAY * pitch_m:
            return None
        # Each step is seen in the frame of where it began, which odometry has not yet left.
        ahead = (math.atan2(way[1], way[0]) - frames[k]) / QUARTER
        if abs(ahead - round(ahead)) > ASTRAY:
            return None
        steps.append(quarters[k] + round(ahead))
    headings = [*steps[:1], *steps] or [0]
    codes = tuple(
        int(rotated(seen.best.code, q - heading))
        for seen, q, heading in zip(sightings, quarters, headings, strict=True)
    )
    turns = tuple((b - a + 1) % 4 - 1 for a, b in pairwise(headings))
    # The heading at a landmark is that of arrival; at the first one that of leaving.
    return codes, turns


@dataclass(frozen=True)
class Located:
    """Where on the map a sequence of landmarks can have been read.

    Attributes
    ----------
    places : tuple of (cell, heading)
        Of the robot at the last landmark, the heading in quarter turns from the map's x,
        as it drove there.
    """

    places: tuple[tuple[Cell, int], ...]

    @property
    def status(self) -> str:
        """``"found"``, ``"ambiguous"`` or ``"none"``."""
        return ("none", "found")[len(self.places)] if len(self.places) < 2 else "ambiguous"


def locate(floor: FloorMap, codes: Sequence[int], turns: Sequence[int] = L_TURNS) -> Located:
    """Global localization by exact comparison with the map (section 4.2).

    Parameters
    ----------
    floor : FloorMap
        With the alphabet "6" only patterns are compared, as in the paper; else codes.
    codes : sequence of int
        As read in the robot's frame, one landmark after the other; under the heading with
        which the robot arrived, and at the first with which it left before any turn.
    turns : sequence of int
        Quarter turns to the left that the robot made before each step of one cell; one
        fewer than the codes.

    Raises
    ------
    ValueError
        Codes and turns do not go together.
    """
    if len(turns) != len(codes) - 1:
        raise ValueError(f"{len(codes)} codes need {len(codes) - 1} turns, not {len(turns)}")
    places = []
    for start in floor.cells():
        for q in range(4):
            cell, heading = start, q
            fits = _reads(floor, cell, heading, codes[0])
            for code, turn in zip(codes[1:], turns, strict=True):
                heading = (heading + turn) % 4
                fits = fits and floor.open(cell, heading)
                if not fits:
                    break
                cell = neighbour(cell, heading)
                fits = _reads(floor, cell, heading, code)
            if fits:
                places.append((cell, heading))
    return Located(tuple(places))


def _reads(floor: FloorMap, cell: Cell, heading: int, code: int) -> bool:
    laid = int(floor.codes[cell])
    if laid == HOLE:
        return False
    if floor.alphabet == "6":
        return bool(PATTERN_OF[laid] == PATTERN_OF[code])
    return int(rotated(laid, -heading)) == code
