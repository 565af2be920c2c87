"""First places: where, under which turn and of which code a landmark may lie, on a grid."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.kernels import kernels
from locatk.core.landmarks import field as bars
from locatk.core.landmarks.detection.trace import Trace
from locatk.core.landmarks.landmark import CODES, Geometry, signs

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Grid:
    """How finely places are searched.

    Attributes
    ----------
    step_m : float
        Between neighbouring centres.
    turns : int
        In a quarter turn.
    """

    step_m: float = 7e-3
    turns: int = 10

    def headings(self) -> Array:
        """(turns,) headings from -45 degrees on."""
        return np.asarray(-math.pi / 4 + math.pi / 2 / self.turns * np.arange(self.turns))


COARSE = Grid()

FINE = Grid(4e-3, 15)

REACH_M = 0.11
"""Of a landmark's field, as far as the scan looks."""

TABLE_STEP_M = 1e-3

FARTHEST_M = 0.062
"""From a place of strong field to the landmark's centre."""

LARGEST_M = 0.5
"""Strong fields farther apart are of no one landmark."""

STRONG = 0.45
"""Field of a place near a landmark, in units of the threshold."""

SLACK = 0.25
"""By which share of the strongest field near a sample the grid's coarseness may be off."""

BESIDE = 0.12
"""The same of the strongest field of any sensor: one that runs along a valley tells of
nothing, but a node beside the valley would have it feel much."""

NEAR_M = 8e-3

FLOOR_T = 3e-4

GAINS = (0.6, 1.15)

APART_M = 0.012

APART_RAD = math.radians(16)


WHOLE = signs(np.arange(CODES))
"""(16, 4) strengths of the bars of faultless landmarks."""

ONE_MISSING = np.unique(np.concatenate([WHOLE * (np.arange(4) != bar) for bar in range(4)]), axis=0)
"""(32, 4) strengths where one bar is missing."""


def candidates(
    trace: Trace, geometry: Geometry, laid: Array, most: int, grid: Grid = COARSE
) -> tuple[Array, NDArray[np.intp]]:
    """The likeliest places of the landmark under a trace.

    Parameters
    ----------
    trace : Trace
        Best thinned: each sample costs.
    geometry : Geometry
    laid : (L, 4) ndarray
        Strengths of the bars that may be there: :data:`WHOLE`, :data:`ONE_MISSING`.
    most : int
        Number of candidates.
    grid : Grid, optional

    Returns
    -------
    (K, 3) ndarray, (K,) ndarray
        x, y, heading in the trace's frame and the row of ``laid``; the best first, no two
        alike. Empty where no field is strong.
    """
    place = trace.places()
    seen = ~np.isnan(trace.value_t)
    strong = seen & (np.abs(np.where(seen, trace.value_t, 0)) > STRONG * geometry.threshold_t)
    if not strong.any():
        return np.empty((0, 3)), np.empty(0, np.intp)
    if np.ptp(place[strong], axis=0).max() > LARGEST_M:
        return np.empty((0, 3)), np.empty(0, np.intp)
    centres = _centres(place[strong], grid.step_m)
    slack = _slack(trace)
    turns = grid.headings()
    cost = scan(place[seen], trace.value_t[seen], slack[seen], centres, turns, geometry, laid)
    return _distinct(cost, centres, turns, most)


def scan(
    points: Array,
    values: Array,
    slack: Array,
    centres: Array,
    turns: Array,
    geometry: Geometry,
    laid: Array,
) -> Array:
    """Cost (turns, centres, L) of all that may be laid at each place: weighted squares left.

    One normal matrix of the four bars serves all ``laid`` (L, 4); a common gain is free
    within :data:`GAINS`. ``slack`` is how far each value may be off.
    """
    weight = 1 / slack**2
    table = _table(geometry)
    if kernels is None:
        return scan_numpy(points, values, weight, centres, turns, table, laid)
    cost = np.empty((len(turns), len(centres), len(laid)))
    kernels.scan_landmarks(
        np.ascontiguousarray(points),
        np.ascontiguousarray(values),
        weight,
        len(values),
        np.ascontiguousarray(centres),
        len(centres),
        turns,
        len(turns),
        table,
        len(table),
        TABLE_STEP_M,
        *GAINS,
        laid,
        len(laid),
        cost,
    )
    return cost


def scan_numpy(
    points: Array,
    values: Array,
    weight: Array,
    centres: Array,
    turns: Array,
    table: NDArray[np.float32],
    laid: Array,
) -> Array:
    """Twin of the compiled loop."""
    last = len(table) - 1
    cost = np.empty((len(turns), len(centres), len(laid)))
    power = (weight * values**2).sum()
    for number, turn in enumerate(turns):
        x, y = np.moveaxis(points - centres[:, None], -1, 0)
        c, s = math.cos(turn), math.sin(turn)
        u, v = (c * x + s * y) / TABLE_STEP_M, (c * y - s * x) / TABLE_STEP_M
        i, j = u + last / 2, v + last / 2
        inside = (i >= 0) & (j >= 0) & (i < last) & (j < last)
        i, j = np.where(inside, i, 0), np.where(inside, j, 0)
        a, b = i.astype(int), j.astype(int)
        di, dj = (i - a)[..., None], (j - b)[..., None]
        unit = inside[..., None] * (
            (1 - di) * ((1 - dj) * table[a, b] + dj * table[a, b + 1])
            + di * ((1 - dj) * table[a + 1, b] + dj * table[a + 1, b + 1])
        )
        right = np.einsum("mnk,n->mk", unit, weight * values)
        normal = np.einsum("mnk,mnl,n->mkl", unit, unit, weight, optimize=True)
        top = right @ laid.T
        square = np.einsum("ck,mkl,cl->mc", laid, normal, laid)
        gain = np.clip(top / np.maximum(square, 1e-300), *GAINS)
        cost[number] = power - 2 * gain * top + gain * gain * square
    return cost


def _slack(trace: Trace) -> Array:
    """(n, N) how far a field may be off, where the nearest node is a few millimetres away."""
    step = np.hypot(*np.diff(trace.pose[:, :2], axis=0).T)
    turn = np.abs(np.diff(trace.pose[:, 2])) * np.hypot(*trace.lever_m.T).max()
    way = np.concatenate([[0], np.cumsum(step + turn)])
    reach = max(NEAR_M, 1.01 * float(np.median(np.diff(way))))
    near = np.abs(way[:, None] - way) <= reach
    strength = np.abs(np.nan_to_num(trace.value_t))
    most = np.where(near[:, :, None], strength, 0.0).max(axis=1)
    beside = most.max(axis=1, keepdims=True)
    return np.sqrt(FLOOR_T**2 + (SLACK * most) ** 2 + (BESIDE * beside) ** 2)


def _centres(strong: Array, step_m: float) -> Array:
    """Nodes (m, 2) of the grid within reach of places (p, 2) of strong field."""
    low = strong.min(axis=0) - FARTHEST_M
    high = strong.max(axis=0) + FARTHEST_M
    x, y = (np.arange(a, b + step_m, step_m) for a, b in zip(low, high, strict=True))
    nodes = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
    gap = ((nodes[:, None] - strong) ** 2).sum(axis=-1).min(axis=1)
    return nodes[gap < FARTHEST_M**2]


def _distinct(
    cost: Array, centres: Array, turns: Array, most: int
) -> tuple[Array, NDArray[np.intp]]:
    """The best nodes, none of which is a neighbour of a better one that is laid alike."""
    flat = cost.ravel()
    order = np.argpartition(flat, min(60 * most, len(flat) - 1))[: 60 * most]
    order = order[np.argsort(flat[order])]
    turn, node, code = np.unravel_index(order, cost.shape)
    pose = np.column_stack([centres[node], turns[turn]])
    left = np.ones(len(order), bool)
    chosen: list[int] = []
    while left.any() and len(chosen) < most:
        best = int(np.argmax(left))
        chosen.append(best)
        near = np.hypot(*(pose[:, :2] - pose[best, :2]).T) < APART_M
        near &= np.abs(pose[:, 2] - pose[best, 2]) < APART_RAD
        left &= ~(near & (code == code[best]))
    return pose[chosen], code[chosen]


@functools.lru_cache(maxsize=4)
def _table(geometry: Geometry) -> NDArray[np.float32]:
    """Fields of the bars over the landmark's plane, [x, y, bar] from -REACH_M up in even steps."""
    count = round(REACH_M / TABLE_STEP_M)
    line = np.arange(-count, count + 1) * TABLE_STEP_M
    plane = np.stack(np.meshgrid(line, line, indexing="ij"), -1)
    return np.ascontiguousarray(bars.basis(geometry, plane), np.float32)
