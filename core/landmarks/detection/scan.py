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

TABLE_HALF_WIDTH_RADII = 4.4
"""Distance from the centre up to which a landmark's field is tabulated, in radii of its bars: the
field there is below 0.01 of the strongest one."""

TABLE_STEP_M = 1e-3
"""Step of that table; fields are interpolated linearly."""

MAX_FIELD_FACTOR = 2.0
"""Field relative to that of the nominal bars up to which a landmark may be the source of a reading:
it allows for sensors that are lower, for gains, and for bars that are stronger."""

MAX_STRONG_FIELD_EXTENT = 3.0
"""Extent of positions of strong field above which they cannot be of one landmark, relative to the
diameter of its own. Several passes by odometry with errors are within it; odometry in wrong units
is not, and neither is a long source of another kind."""

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
        Empty if strong fields extend too far for one landmark.
    which : (K,) ndarray
        Row of ``strengths``.
    """
    position = trace.sensor_positions()
    is_measured = ~np.isnan(trace.field_t)
    strong = position[_is_strong(trace, geometry)]
    limit_t = MIN_STRONG_FIELD_THRESHOLDS * geometry.threshold_t
    max_extent_m = MAX_STRONG_FIELD_EXTENT * 2 * field_range(geometry, limit_t / MAX_FIELD_FACTOR)
    if len(strong) and np.ptp(strong, axis=0).max() > max_extent_m:
        return np.empty((0, 3)), np.empty(0, np.intp)
    centres = _grid_centres(*source_region(trace, geometry), grid.step_m)
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


def has_strong_field(trace: Trace, geometry: Geometry) -> bool:
    """Return whether a field of the trace is strong enough to locate a landmark."""
    return bool(_is_strong(trace, geometry).any())


def source_region(trace: Trace, geometry: Geometry) -> tuple[Array, float]:
    """Return the disc in which the landmark's centre can be: its middle (2,), and its radius.

    The strongest reading can only be of a landmark within the range of a field of that strength.
    """
    magnitude = np.abs(np.nan_to_num(trace.field_t))
    strongest = np.unravel_index(np.argmax(magnitude), magnitude.shape)
    radius_m = field_range(geometry, float(magnitude[strongest]) / MAX_FIELD_FACTOR)
    return trace.sensor_positions()[strongest], radius_m


def field_range(geometry: Geometry, field_t: float) -> float:
    """Return the distance from its centre up to which any landmark has a field of this strength.

    It is at least that of the ends of the bars, and at most half the width of the tabulated field.
    """
    distance_m, strongest_t = _strongest_fields(geometry)
    is_reached = strongest_t >= field_t
    over_bars_m = math.hypot(geometry.radius_m, geometry.bar_length_m / 2)
    return max(over_bars_m, float(distance_m[is_reached].max(initial=0.0)))


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


def _is_strong(trace: Trace, geometry: Geometry) -> NDArray[np.bool_]:
    """Return which readings (n, N) are near a landmark."""
    limit_t = MIN_STRONG_FIELD_THRESHOLDS * geometry.threshold_t
    return np.asarray(np.abs(np.nan_to_num(trace.field_t)) > limit_t)


def _grid_centres(middle: Array, radius_m: float, step_m: float) -> Array:
    """Return the nodes (m, 2) of a grid within a disc."""
    line = np.arange(-radius_m, radius_m + step_m, step_m)
    nodes = np.stack(np.meshgrid(line, line, indexing="ij"), -1).reshape(-1, 2)
    return np.asarray(middle + nodes[np.hypot(*nodes.T) <= radius_m])


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
def _strongest_fields(geometry: Geometry) -> tuple[Array, Array]:
    """Return distances (n,) from the centre, and the strongest field of any landmark at each."""
    count = round(TABLE_HALF_WIDTH_RADII * geometry.radius_m / TABLE_STEP_M)
    distance_m = np.asarray(TABLE_STEP_M * np.arange(count + 1), np.float64)
    angle = np.linspace(0, HALF_PI_RAD, 46)  # A quarter turn exchanges the bars.
    points = distance_m[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    return distance_m, np.asarray(np.abs(basis(geometry, points)).sum(axis=-1).max(axis=1))


@functools.lru_cache(maxsize=4)
def _field_table(geometry: Geometry) -> NDArray[np.float32]:
    """Tabulate the fields of the bars, [x, y, bar], over the plane of the sensors."""
    count = round(TABLE_HALF_WIDTH_RADII * geometry.radius_m / TABLE_STEP_M)
    line = np.arange(-count, count + 1) * TABLE_STEP_M
    plane = np.stack(np.meshgrid(line, line, indexing="ij"), -1)
    return np.ascontiguousarray(basis(geometry, plane), np.float32)
