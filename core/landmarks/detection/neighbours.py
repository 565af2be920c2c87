"""What the other landmarks of the map, as they were built, add to a visit, taken off."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks import field as bars
from locatk.core.landmarks.detection.trace import Trace, compose, sensor_places
from locatk.core.landmarks.map.floor import HOLE, Cell, FloorMap, as_built_landmark

Array = NDArray[np.float64]

REACH_M = 0.3
"""Distance from which on a landmark's field is not felt (facts/landmarks.md 2.3)."""


def without(trace: Trace, pose: Array, wrong: Array, cell: Cell, floor: FloorMap) -> Trace:
    """The trace of a visit to ``cell`` less the fields of all other landmarks of the map.

    Parameters
    ----------
    trace : Trace
    pose : (3,) ndarray
        Robot at the trace's reference, in the map's frame.
    wrong : (m,) ndarray
        Of the trace's corrections.
    cell : (row, column)
    floor : FloorMap
    """
    way = compose(pose, trace.pose + trace.correction @ wrong)
    place = sensor_places(way, trace.lever_m)
    value = trace.value_t.copy()
    span = int(np.ceil(REACH_M / floor.pitch_m))
    rows, columns = floor.shape
    for row in range(max(0, cell[0] - span), min(rows, cell[0] + span + 1)):
        for column in range(max(0, cell[1] - span), min(columns, cell[1] + span + 1)):
            if (row, column) == cell or floor.codes[row, column] == HOLE:
                continue
            mark, strength = as_built_landmark(floor, (row, column))
            away = place - mark[:2]
            near = np.hypot(away[..., 0], away[..., 1]) < REACH_M
            if near.any():
                local = away[near] @ _turn(mark[2])
                value[near] -= bars.basis(floor.geometry, local) @ strength
    return replace(trace, value_t=value)


def _turn(heading: float) -> Array:
    """(2, 2): rows of places times it are as seen under a heading."""
    cos, sin = math.cos(heading), math.sin(heading)
    return np.array([[cos, -sin], [sin, cos]])
