"""Initial guesses: grid search for position, heading and code of the landmark below a trace.

The field is linear in the strengths of the four bars. At each node of a grid of positions and
headings, one normal matrix (4, 4) therefore gives the residuals of all codes.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.kernels import kernels
from locatk.core.landmarks.detection.trace import Trace
from locatk.core.landmarks.field import basis
from locatk.core.landmarks.landmark import CODE_COUNT, HALF_PI_RAD, Geometry, signs

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ScanGrid:
    """Resolution of the grid.

    Attributes
    ----------
    step_m : float
        Between neighbouring positions.
    headings_per_quarter : int
        Number of headings in a quarter turn. The other quarters are covered by the codes.
    """

    step_m: float = 7e-3
    headings_per_quarter: int = 10

    def headings(self) -> Array:
        """Return the headings in radians, from -45 degrees on."""
        step = HALF_PI_RAD / self.headings_per_quarter
        return np.asarray(-HALF_PI_RAD / 2 + step * np.arange(self.headings_per_quarter))


COARSE_GRID = ScanGrid()
"""Grid of the first search; its field errors are allowed for by :data:`GRID_ERROR_FRACTION`."""

FINE_GRID = ScanGrid(4e-3, 15)
"""Grid of a second search, if no result of the first explains the trace."""

TABLE_HALF_WIDTH_M = 0.11
"""Distance from the centre up to which a landmark's field is tabulated."""

TABLE_STEP_M = 1e-3
"""Step of that table; fields are interpolated linearly."""

MAX_CENTRE_DISTANCE_M = 0.062
"""Largest distance from a position of strong field to the landmark's centre. The territory of the
default geometry ends at 54 mm (radius r2 of the paper, section 3.1)."""

MAX_STRONG_FIELD_EXTENT_M = 0.5
"""Extent of positions of strong field above which they cannot be of one landmark."""

MIN_STRONG_FIELD_THRESHOLDS = 0.45
"""Field of a position near a landmark, in thresholds of the territory."""

GRID_ERROR_FRACTION = 0.25
"""Error of a predicted field by the coarseness of the grid, relative to the strongest field of the
same sensor in the neighbourhood."""

OTHER_SENSOR_ERROR_FRACTION = 0.12
"""The same relative to the strongest field of any sensor: a sensor that moves along a valley of the
field measures nothing, but at a node off the valley it would measure a strong field."""

MIN_NEIGHBOURHOOD_M = 8e-3
"""Minimum half length of the neighbourhood, along the path."""

MIN_FIELD_ERROR_T = 3e-4
"""Error of a predicted field that is assumed at least: offset and noise."""

GAIN_RANGE = (0.6, 1.15)
"""Range of a common gain. It is estimated, because heights and remanences differ."""

MIN_CANDIDATE_DISTANCE_M = 0.012
MIN_CANDIDATE_ROTATION_RAD = math.radians(16)
"""Differences of position and heading below which two candidates of one code are neighbours: both
converge to one minimum."""

SORTED_NODES_PER_CANDIDATE = 60
"""Number of best nodes among which each candidate is selected."""

INTACT_STRENGTHS = signs(np.arange(CODE_COUNT))
"""(16, 4) strengths of the bars of faultless landmarks."""

ONE_MISSING_STRENGTHS = np.unique(
    np.concatenate([INTACT_STRENGTHS * (np.arange(4) != bar) for bar in range(4)]), axis=0
)
"""(32, 4) strengths of landmarks of which one bar is missing."""


def find_candidates(
    trace: Trace,
    geometry: Geometry,
    strengths: Array,
    max_candidates: int,
    grid: ScanGrid = COARSE_GRID,
) -> tuple[Array, NDArray[np.intp]]:
    """Find the most likely poses and strengths of the landmark below a trace.

    Parameters
    ----------
    trace : Trace
        Thinned: the time is in proportion to the number of samples.
    geometry : Geometry
    strengths : (L, 4) ndarray
        Admitted strengths of the bars: :data:`INTACT_STRENGTHS`, :data:`ONE_MISSING_STRENGTHS`.
    max_candidates : int
    grid : ScanGrid, optional

    Returns
    -------
    pose : (K, 3) ndarray
        x, y, heading in the frame of the trace; the best first, without neighbours of one code.
        Empty if no field is strong, or if strong fields extend too far for one landmark.
    which : (K,) ndarray
        Row of ``strengths``.
    """
    position = trace.sensor_positions()
    is_measured = ~np.isnan(trace.field_t)
    magnitude = np.abs(np.where(is_measured, trace.field_t, 0))
    is_strong = is_measured & (magnitude > MIN_STRONG_FIELD_THRESHOLDS * geometry.threshold_t)
    if not is_strong.any() or np.ptp(position[is_strong], axis=0).max() > MAX_STRONG_FIELD_EXTENT_M:
        return np.empty((0, 3)), np.empty(0, np.intp)
    centres = _grid_centres(position[is_strong], grid.step_m)
    sigma = _field_errors(trace)
    headings = grid.headings()
    cost = scan_costs(
        position[is_measured],
        trace.field_t[is_measured],
        sigma[is_measured],
        centres,
        headings,
        geometry,
        strengths,
    )
    return _separate_minima(cost, centres, headings, max_candidates)


def scan_costs(
    points: Array,
    field_t: Array,
    sigma_t: Array,
    centres: Array,
    headings: Array,
    geometry: Geometry,
    strengths: Array,
) -> Array:
    """Evaluate the weighted sum of squared residuals at all nodes of a grid.

    Parameters
    ----------
    points, field_t, sigma_t : (n, 2), (n,), (n,) ndarray
        Measured fields and standard deviations.
    centres, headings : (M, 2), (H,) ndarray
        Nodes.
    geometry : Geometry
    strengths : (L, 4) ndarray

    Returns
    -------
    (H, M, L) ndarray
        A common gain within :data:`GAIN_RANGE` is estimated for each.
    """
    weight = 1 / sigma_t**2
    table = _field_table(geometry)
    if kernels is None:
        return scan_costs_numpy(points, field_t, weight, centres, headings, table, strengths)
    cost = np.empty((len(headings), len(centres), len(strengths)))
    kernels.scan_landmarks(
        np.ascontiguousarray(points),
        np.ascontiguousarray(field_t),
        weight,
        len(field_t),
        np.ascontiguousarray(centres),
        len(centres),
        headings,
        len(headings),
        table,
        len(table),
        TABLE_STEP_M,
        *GAIN_RANGE,
        strengths,
        len(strengths),
        cost,
    )
    return cost


def scan_costs_numpy(
    points: Array,
    field_t: Array,
    weight: Array,
    centres: Array,
    headings: Array,
    table: NDArray[np.float32],
    strengths: Array,
) -> Array:
    """Evaluate :func:`scan_costs`; numpy twin of the compiled loop."""
    last = len(table) - 1
    cost = np.empty((len(headings), len(centres), len(strengths)))
    power = (weight * field_t**2).sum()
    for number, heading in enumerate(headings):
        x, y = np.moveaxis(points - centres[:, None], -1, 0)
        c, s = math.cos(heading), math.sin(heading)
        u, v = (c * x + s * y) / TABLE_STEP_M, (c * y - s * x) / TABLE_STEP_M
        i, j = u + last / 2, v + last / 2
        is_inside = (i >= 0) & (j >= 0) & (i < last) & (j < last)
        i, j = np.where(is_inside, i, 0), np.where(is_inside, j, 0)
        a, b = i.astype(int), j.astype(int)
        di, dj = (i - a)[..., None], (j - b)[..., None]
        bar_field = is_inside[..., None] * (
            (1 - di) * ((1 - dj) * table[a, b] + dj * table[a, b + 1])
            + di * ((1 - dj) * table[a + 1, b] + dj * table[a + 1, b + 1])
        )
        right = np.einsum("mnk,n->mk", bar_field, weight * field_t)
        normal = np.einsum("mnk,mnl,n->mkl", bar_field, bar_field, weight, optimize=True)
        product = right @ strengths.T
        square = np.einsum("ck,mkl,cl->mc", strengths, normal, strengths)
        gain = np.clip(product / np.maximum(square, 1e-300), *GAIN_RANGE)
        cost[number] = power - 2 * gain * product + gain * gain * square
    return cost


def _field_errors(trace: Trace) -> Array:
    """Return the standard deviations (n, N) of fields at the nearest node of the grid."""
    step = np.hypot(*np.diff(trace.pose[:, :2], axis=0).T)
    radius = np.hypot(*trace.sensor_position_m.T).max()
    rotation = np.abs(np.diff(trace.pose[:, 2])) * radius
    distance = np.concatenate([[0], np.cumsum(step + rotation)])
    half_length = max(MIN_NEIGHBOURHOOD_M, 1.01 * float(np.median(np.diff(distance))))
    is_neighbour = np.abs(distance[:, None] - distance) <= half_length
    magnitude = np.abs(np.nan_to_num(trace.field_t))
    strongest = np.where(is_neighbour[:, :, None], magnitude, 0.0).max(axis=1)
    of_any_sensor = strongest.max(axis=1, keepdims=True)
    return np.sqrt(
        MIN_FIELD_ERROR_T**2
        + (GRID_ERROR_FRACTION * strongest) ** 2
        + (OTHER_SENSOR_ERROR_FRACTION * of_any_sensor) ** 2
    )


def _grid_centres(strong: Array, step_m: float) -> Array:
    """Return the nodes (m, 2) near enough to a position (p, 2) of strong field."""
    low = strong.min(axis=0) - MAX_CENTRE_DISTANCE_M
    high = strong.max(axis=0) + MAX_CENTRE_DISTANCE_M
    x, y = (np.arange(a, b + step_m, step_m) for a, b in zip(low, high, strict=True))
    nodes = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
    squared_distance = ((nodes[:, None] - strong) ** 2).sum(axis=-1).min(axis=1)
    return nodes[squared_distance < MAX_CENTRE_DISTANCE_M**2]


def _separate_minima(
    cost: Array, centres: Array, headings: Array, max_candidates: int
) -> tuple[Array, NDArray[np.intp]]:
    """Return the best nodes, without neighbours of a better one of the same strengths."""
    flat = cost.ravel()
    count = SORTED_NODES_PER_CANDIDATE * max_candidates
    order = np.argpartition(flat, min(count, len(flat) - 1))[:count]
    order = order[np.argsort(flat[order])]
    heading, node, which = np.unravel_index(order, cost.shape)
    pose = np.column_stack([centres[node], headings[heading]])
    is_left = np.ones(len(order), bool)
    chosen: list[int] = []
    while is_left.any() and len(chosen) < max_candidates:
        best = int(np.argmax(is_left))
        chosen.append(best)
        is_neighbour = np.hypot(*(pose[:, :2] - pose[best, :2]).T) < MIN_CANDIDATE_DISTANCE_M
        is_neighbour &= np.abs(pose[:, 2] - pose[best, 2]) < MIN_CANDIDATE_ROTATION_RAD
        is_left &= ~(is_neighbour & (which == which[best]))
    return pose[chosen], which[chosen]


@functools.lru_cache(maxsize=4)
def _field_table(geometry: Geometry) -> NDArray[np.float32]:
    """Tabulate the fields of the bars, [x, y, bar], over the plane of the sensors."""
    count = round(TABLE_HALF_WIDTH_M / TABLE_STEP_M)
    line = np.arange(-count, count + 1) * TABLE_STEP_M
    plane = np.stack(np.meshgrid(line, line, indexing="ij"), -1)
    return np.ascontiguousarray(basis(geometry, plane), np.float32)
