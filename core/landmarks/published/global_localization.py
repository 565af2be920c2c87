"""Global localization by exact comparison with the map (section 4.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.detection.hypotheses import VisitHypotheses
from locatk.core.landmarks.landmark import PATTERN_OF, rotated
from locatk.core.landmarks.map.floor import HOLE_CODE, Cell, FloorMap, neighbour

Array = NDArray[np.float64]

L_ROTATIONS = (0, 1)
"""Quarter turns before each of the two steps of an L: ahead, then to the left."""

QUARTER_TURN_RAD = math.pi / 2

MAX_STEP_ERROR_FRACTION = 0.25
"""Largest error of a step to a neighbour by odometry, in units of the pitch and of a quarter turn:
half of the error at which the next cell would be as near."""


@dataclass(frozen=True)
class MapMatches:
    """Positions on the map at which a sequence of landmarks can have been read.

    Attributes
    ----------
    positions : tuple of (cell, heading)
        Of the robot at the last landmark; the heading on arrival in quarter turns from the map's
        x axis.
    """

    positions: tuple[tuple[Cell, int], ...]

    @property
    def status(self) -> str:
        """``"found"``, ``"ambiguous"`` or ``"none"``."""
        if len(self.positions) > 1:
            return "ambiguous"
        return "found" if self.positions else "none"


def landmark_sequence(
    visits: Sequence[VisitHypotheses], pitch_m: float
) -> tuple[tuple[int, ...], tuple[int, ...]] | None:
    """Return codes and rotations of successive landmarks, as :func:`match_map` needs them.

    Parameters
    ----------
    visits : sequence of VisitHypotheses
        Each with a hypothesis; the best one counts.
    pitch_m : float
        Between neighbouring cells.

    Returns
    -------
    codes, rotations : tuple of int
        None if by odometry two successive landmarks are not one cell apart: one between them was
        not detected.
    """
    centres, frames = [], []
    for visit in visits:
        x, y, heading = visit.best.pose
        frame = float(visit.odometry[2] - heading)
        cos, sin = math.cos(frame), math.sin(frame)
        centres.append(visit.odometry[:2] - [cos * x - sin * y, sin * x + cos * y])
        frames.append(frame)
    # All in the frame of the first landmark, in quarter turns.
    quarters = [round((frame - frames[0]) / QUARTER_TURN_RAD) for frame in frames]
    steps = []
    for k in range(len(centres) - 1):
        step = centres[k + 1] - centres[k]
        if abs(np.hypot(*step) - pitch_m) > MAX_STEP_ERROR_FRACTION * pitch_m:
            return None
        # Each step is measured in the frame of its start, from which odometry has not drifted yet.
        ahead = (math.atan2(step[1], step[0]) - frames[k]) / QUARTER_TURN_RAD
        if abs(ahead - round(ahead)) > MAX_STEP_ERROR_FRACTION:
            return None
        steps.append(quarters[k] + round(ahead))
    headings = [*steps[:1], *steps] or [0]
    codes = tuple(
        int(rotated(visit.best.code, q - heading))
        for visit, q, heading in zip(visits, quarters, headings, strict=True)
    )
    rotations = tuple((b - a + 1) % 4 - 1 for a, b in pairwise(headings))
    # The heading at a landmark is that on arrival; at the first one, that on departure.
    return codes, rotations


def match_map(
    floor: FloorMap, codes: Sequence[int], rotations: Sequence[int] = L_ROTATIONS
) -> MapMatches:
    """Find all positions on the map at which a sequence of landmarks can have been read.

    Parameters
    ----------
    floor : FloorMap
        With the alphabet "6" only patterns are compared, as in the paper; otherwise codes.
    codes : sequence of int
        As read in the robot's frame, one landmark after the other, with the heading on arrival,
        and at the first one with the heading on departure before any rotation.
    rotations : sequence of int
        Quarter turns to the left before each step of one cell; one fewer than the codes.

    Raises
    ------
    ValueError
        The numbers of codes and rotations do not agree.
    """
    if len(rotations) != len(codes) - 1:
        raise ValueError(
            f"{len(codes)} codes need {len(codes) - 1} rotations, not {len(rotations)}"
        )
    positions = []
    for start in floor.cells():
        for q in range(4):
            cell, heading = start, q
            matches = _matches_cell(floor, cell, heading, codes[0])
            for code, rotation in zip(codes[1:], rotations, strict=True):
                heading = (heading + rotation) % 4
                matches = matches and floor.is_passable(cell, heading)
                if not matches:
                    break
                cell = neighbour(cell, heading)
                matches = _matches_cell(floor, cell, heading, code)
            if matches:
                positions.append((cell, heading))
    return MapMatches(tuple(positions))


def _matches_cell(floor: FloorMap, cell: Cell, heading: int, code: int) -> bool:
    installed = int(floor.codes[cell])
    if installed == HOLE_CODE:
        return False
    if floor.alphabet == "6":
        return bool(PATTERN_OF[installed] == PATTERN_OF[code])
    return int(rotated(installed, -heading)) == code
