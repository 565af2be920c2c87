"""From a frame to a grid and soft bits, the published way (papers/dots.txt II-B.1 to 4).

Equation and figure numbers are the paper's. Where it leaves a choice open, or misprints a
sign, the choice made here is said. Vectors are in px, x right and y down.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.camera import Camera
from locatk.core.dots.sheet import OFFSET

Array = NDArray[np.float64]
Index = NDArray[np.intp]

SMALLEST_BLOB_PX = 4
"""Blobs of fewer pixels are dropped. The paper gives no number; its predecessor has 6, which
loses dots of a quarter of the paper's pitch."""

ITERATIONS = 10
"""Of the k-means (Fig. 5)."""

SHORTEST_PX = 2.0
"""No grid is finer: two dots would be one blob."""

FLATTEST = 0.5
"""Sine of the angle between u and v below which they are no two directions."""


@dataclass(frozen=True)
class Grid:
    """A square grid laid over a frame: place g lies at ``origin + g[0] u + g[1] v``.

    Attributes
    ----------
    origin, u, v : (2,) ndarray
        px; u points to the right of v's down, as x and y do.
    """

    origin: Array
    u: Array
    v: Array

    def coordinates(self, points: Array) -> Array:
        """Eq. 3: (n, 2) px to grid units, as if u and v were at right angles."""
        basis = np.stack([self.u / (self.u @ self.u), self.v / (self.v @ self.v)], axis=1)
        result: Array = (points - self.origin) @ basis
        return result

    def points(self, places: Array) -> Array:
        """(..., 2) grid units to px."""
        result: Array = self.origin + places @ np.stack([self.u, self.v])
        return result


def lay_grid(points: Array, centre: Array) -> tuple[Grid, Index, Array] | None:
    """II-B.2 and 3: a grid over dots (n, 2), their grid coordinates and their offsets from it.

    None where there is none to be found.
    """
    edges = symmetric_edges(points)
    if not len(edges):
        return None
    directions = cluster_edges(points[edges[:, 1]] - points[edges[:, 0]])
    origin = intact_origin(points, edges, centre)
    if directions is None or origin is None:
        return None
    u, v = directions
    across = u[0] * v[1] - u[1] * v[0]
    lengths = np.hypot(*u), np.hypot(*v)
    if min(lengths) < SHORTEST_PX or across < FLATTEST * lengths[0] * lengths[1]:
        return None
    return refine(Grid(origin, u, v), points)


def find_dots(image: NDArray[np.uint8], camera: Camera | None) -> Array:
    """II-B.1: centres of mass (n, 2) of all dark blobs, undistorted, from the top down.

    The global threshold is Otsu's; the paper does not say how it comes to its own. A blob
    is connected over corners too.
    """
    import cv2

    _, dark = cv2.threshold(image, 0, 1, cv2.THRESH_BINARY_INV | cv2.THRESH_OTSU)
    _, _, stats, centres = cv2.connectedComponentsWithStats(dark, connectivity=8)
    kept = stats[1:, cv2.CC_STAT_AREA] >= SMALLEST_BLOB_PX
    points: Array = centres[1:][kept]
    points = points[np.argsort(points[:, 1], kind="stable")]
    return points if camera is None else camera.undistort(points)


def symmetric_edges(points: Array) -> Index:
    """II-B.2: pairs (m, 2), first above second, of dots each among the other's nearest four."""
    from scipy.spatial import cKDTree

    n = len(points)
    _, near = cKDTree(points).query(points, k=5)
    pairs = np.stack([np.repeat(np.arange(n), 5), near.ravel()], axis=1)
    keys, times = np.unique(np.sort(pairs, axis=1) @ [n, 1], return_counts=True)
    edges = np.stack(np.divmod(keys[times == 2], n), axis=1)
    return edges


def cluster_edges(edges: Array) -> tuple[Array, Array] | None:
    """Fig. 5: u and v from edges (m, 2) by k-means of four clusters, two and their mirrors.

    The clusters begin at the edge of median length, at its perpendicular and opposite to
    both; the paper leaves that open. None where a cluster is empty. The medians of
    either coordinate by itself are off by up to 5 degrees where the grid lies 15 to 30 degrees
    askew in the frame: most of what the published method fails to read, it fails here.
    """
    middle = edges[np.argsort(np.hypot(*edges.T))[len(edges) // 2]]
    means = middle @ np.array([[[1, 0], [0, 1]], [[0, 1], [-1, 0]]])
    for _ in range(ITERATIONS):
        pairs = _pairs_of_clusters(edges, means)
        if not all(map(len, pairs)):
            return None
        new = np.stack([pair.mean(axis=0) for pair in pairs])
        if np.array_equal(new, means):
            break
        means = new
    first, second = _pairs_of_clusters(edges, means)
    if not len(first) or not len(second):
        return None
    return np.median(first, axis=0), np.median(second, axis=0)


def _pairs_of_clusters(edges: Array, means: Array) -> tuple[Array, Array]:
    """Edges nearest to each mean or to its mirror, the latter turned round."""
    along = edges @ means.T
    square = (means * means).sum(axis=1) - 2 * np.abs(along)  # |e|^2 is the same for both
    turned = edges[:, None] * np.where(along < 0, -1.0, 1.0)[:, :, None]
    first = square[:, 0] <= square[:, 1]
    return turned[first, 0], turned[~first, 1]


def intact_origin(points: Array, edges: Index, centre: Array) -> Array | None:
    """II-B.2: mean of the five dots in the middle of the intact 3 x 3 dots nearest to ``centre``.

    Intact: four neighbours, and four more dots each joined to two of these. The paper's
    weights are not published; equal ones scatter least.
    """
    n = len(points)
    both = np.concatenate([edges, edges[:, ::-1]])
    order = np.lexsort((both[:, 1], both[:, 0]))
    start = np.searchsorted(both[order, 0], np.arange(n + 1))
    joined = both[order, 1]
    degree = np.diff(start)
    for dot in np.argsort(((points - centre) ** 2).sum(axis=1)):
        if degree[dot] != 4:
            continue
        sides = joined[start[dot] : start[dot + 1]]
        around = np.concatenate([joined[start[s] : start[s + 1]] for s in sides])
        others, times = np.unique(around[around != dot], return_counts=True)
        if (times == 2).sum() == 4 and not np.isin(others[times == 2], sides).any():
            result: Array = points[[dot, *sides]].mean(axis=0)
            return result
    return None


def refine(grid: Grid, points: Array) -> tuple[Grid, Index, Array]:
    """II-B.3: better origin and lengths; grid coordinates (n, 2) and offsets (n, 2) of the dots.

    Eq. 6 as printed needs offsets g - c; with eq. 5's c - g the median is added. The
    distance of two neighbours is taken along their axis.
    """
    c = grid.coordinates(points)
    g = np.rint(c).astype(np.intp)
    origin = grid.points(np.median(c - g, axis=0))
    lengths = [_spacing(c, g, axis) for axis in (0, 1)]
    better = Grid(origin, grid.u * lengths[0], grid.v * lengths[1])
    c = better.coordinates(points)
    g = np.rint(c).astype(np.intp)
    return better, g, c - g


def _spacing(c: Array, g: Index, axis: int) -> float:
    """Median distance, in units of the grid, of dots whose grid coordinates adjoin."""
    low = g.min(axis=0)
    wide = int(g[:, 1 - axis].max() - low[1 - axis]) + 1
    key = (g[:, axis] - low[axis]) * wide + g[:, 1 - axis] - low[1 - axis]
    key, first = np.unique(key, return_index=True)
    here = np.searchsorted(key, key + wide)
    here[here == len(key)] = 0
    paired = key[here] == key + wide
    if not paired.any():
        return 1.0
    apart = c[first[here[paired]], axis] - c[first[paired], axis]
    return float(np.median(apart))


def likelihood(projected: Array) -> Array:
    """Eq. 9: quasi-probability of a projected offset, in grid units; -1..1."""
    ratio = projected / OFFSET
    result: Array = np.where(ratio**2 < 3, 1.5 * ratio - 0.5 * ratio**3, 0.0)
    return result


def soft_bits(g: Index, offsets: Array) -> Array:
    """Eq. 7 to 9 and Fig. 8: (2, rows, columns) quasi-probabilities of column and row bits.

    Positive for a bit of 1, negative for 0, zero where no dot is. The first are the paper's
    P(y) and the second its P(x), whose names are swapped (facts/dots.md 2.4). Of dots
    with the same grid coordinates the likelier one stays.
    """
    low = g.min(axis=0)
    columns, rows = g.max(axis=0) - low + 1
    du, dv = offsets.T
    values = np.stack([likelihood(dv - du), likelihood(dv + du)])
    product = np.abs(values.prod(axis=0))
    order = np.argsort(product, kind="stable")[np.count_nonzero(product == 0) :]
    bits = np.zeros((2, rows, columns))
    # Of several values for one place the last stays, which is the likeliest.
    bits[:, g[order, 1] - low[1], g[order, 0] - low[0]] = values[:, order]
    return bits
