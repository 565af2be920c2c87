"""First half of the published algorithm: from a frame to a grid and soft bits.

Sections II-B.1 to II-B.4 of Hostettler et al. (see
:mod:`~locatk.core.dots.published.localization`), whose equation and figure numbers are used here.
Vectors are in px, x right and y down.

Correction of the text
    Section II-B.3 refines the origin and the lengths of the grid, but not its direction. The
    medians of Fig. 5 are off by 0.4 degrees in the median and by up to 1.4 degrees, which
    displaces a dot ten pitches away by more than its offset of 1/6 pitch: of the 2,420 frames of
    the paper's study (section IV, simulated) the text as written reads 83.6 %, where the paper
    reports 99.17 %. :func:`refine_grid` therefore fits origin and both axes by least squares to
    the dots, up to five times, after the refinement of the text; then all 2,420 frames are read.

All gaps and misprints are listed in docs/dots.md, section "The published method".
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from locatk.core.dots.camera import Camera
from locatk.core.dots.sheet import DOT_OFFSET_PITCHES

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

MIN_BLOB_AREA_PX = 4
"""Smaller blobs are dropped [px]. The paper gives no number; its predecessor
(cellulo-localization, commit 894f0d0) has 6, which loses dots of a quarter of the paper's pitch."""

MAX_CLUSTERING_ITERATIONS = 10
"""Iterations of the k-means (Fig. 5)."""

MIN_PITCH_PX = 2.0
"""Smallest pitch of a grid [px]: two dots closer than that are one blob."""

MIN_SINE_OF_AXES = 0.5
"""Least sine of the angle from u to v; below it both axes have nearly the same direction."""

MAX_REFINEMENT_ROUNDS = 5
"""Affine fits of the grid. One is sufficient on most frames; the grid coordinates of the dots
have not changed after the second on any frame of the paper's study."""


@dataclass(frozen=True)
class AffineGrid:
    """Grid over a frame: the position with grid coordinates g is ``origin + g[0] u + g[1] v``.

    Attributes
    ----------
    origin, u, v : (2,) ndarray
        [px]. The axis v is clockwise of u, as y is of x.
    """

    origin: Array
    u: Array
    v: Array

    @property
    def is_plausible(self) -> bool:
        """Whether the axes are long enough and have two directions."""
        cross = self.u[0] * self.v[1] - self.u[1] * self.v[0]
        lengths = np.hypot(*self.u), np.hypot(*self.v)
        return bool(
            min(lengths) >= MIN_PITCH_PX and cross >= MIN_SINE_OF_AXES * lengths[0] * lengths[1]
        )

    def coordinates(self, points: Array) -> Array:
        """Return grid coordinates of points (n, 2), as if u and v were perpendicular (Eq. 3)."""
        basis = np.stack([self.u / (self.u @ self.u), self.v / (self.v @ self.v)], axis=1)
        result: Array = (points - self.origin) @ basis
        return result

    def points(self, coordinates: Array) -> Array:
        """Return points in px of grid coordinates (..., 2)."""
        result: Array = self.origin + coordinates @ np.stack([self.u, self.v])
        return result


def detect_blobs(image: NDArray[np.uint8], camera: Camera | None) -> Array:
    """Return the undistorted centroids (n, 2) of all dark blobs, from the top down (II-B.1).

    The global threshold is Otsu's; the paper does not give its own. Pixels that touch at a
    corner are connected.
    """
    _, dark = cv2.threshold(image, 0, 1, cv2.THRESH_BINARY_INV | cv2.THRESH_OTSU)
    _, _, stats, centroids = cv2.connectedComponentsWithStats(dark, connectivity=8)
    is_large = stats[1:, cv2.CC_STAT_AREA] >= MIN_BLOB_AREA_PX
    points: Array = centroids[1:][is_large]
    points = points[np.argsort(points[:, 1], kind="stable")]
    return points if camera is None else camera.undistort(points)


def fit_grid(points: Array, centre: Array) -> tuple[AffineGrid, Indices, Array] | None:
    """Fit a grid to dots (II-B.2 and II-B.3).

    Parameters
    ----------
    points : (n, 2) ndarray
        Dots [px].
    centre : (2,) ndarray
        Centre of the camera [px], near which the origin is chosen.

    Returns
    -------
    (AffineGrid, (n, 2) int ndarray, (n, 2) ndarray) or None
        The grid, the grid coordinates of the dots and their offsets from them; None if the dots
        form no grid.
    """
    edges = symmetric_edges(points)
    if not len(edges):
        return None
    axes = cluster_edges(points[edges[:, 1]] - points[edges[:, 0]])
    origin = intact_origin(points, edges, centre)
    if axes is None or origin is None:
        return None
    grid = AffineGrid(origin, *axes)
    return refine_grid(grid, points) if grid.is_plausible else None


def symmetric_edges(points: Array) -> Indices:
    """Return pairs (m, 2) of dots that are each among the other's nearest four (II-B.2).

    The first dot of a pair is the upper one.
    """
    n = len(points)
    _, nearest = cKDTree(points).query(points, k=5)
    pairs = np.stack([np.repeat(np.arange(n), 5), nearest.ravel()], axis=1)
    keys, counts = np.unique(np.sort(pairs, axis=1) @ [n, 1], return_counts=True)
    edges = np.stack(np.divmod(keys[counts == 2], n), axis=1)
    return edges


def cluster_edges(edges: Array) -> tuple[Array, Array] | None:
    """Estimate u and v from edges (m, 2) by k-means with two clusters and their mirrors (Fig. 5).

    The clusters start at the edge of median length, at its perpendicular, and opposite to both;
    the paper leaves that open. Returns None if a cluster is empty. The coordinates' medians are
    taken separately, as in the paper; on a rotated grid they are biased (see the module's note).
    """
    median_edge = edges[np.argsort(np.hypot(*edges.T))[len(edges) // 2]]
    means = median_edge @ np.array([[[1, 0], [0, 1]], [[0, 1], [-1, 0]]])
    for _ in range(MAX_CLUSTERING_ITERATIONS):
        clusters = _mirrored_clusters(edges, means)
        if not all(map(len, clusters)):
            return None
        new = np.stack([cluster.mean(axis=0) for cluster in clusters])
        if np.array_equal(new, means):
            break
        means = new
    first, second = _mirrored_clusters(edges, means)
    if not len(first) or not len(second):
        return None
    return np.median(first, axis=0), np.median(second, axis=0)


def _mirrored_clusters(edges: Array, means: Array) -> tuple[Array, Array]:
    """Return the edges nearest to each mean or to its mirror; the latter are negated."""
    projection = edges @ means.T
    # |edge - mean|^2 without |edge|^2, which is the same for both clusters.
    distance = (means * means).sum(axis=1) - 2 * np.abs(projection)
    aligned = edges[:, None] * np.where(projection < 0, -1.0, 1.0)[:, :, None]
    is_first = distance[:, 0] <= distance[:, 1]
    return aligned[is_first, 0], aligned[~is_first, 1]


def intact_origin(points: Array, edges: Indices, centre: Array) -> Array | None:
    """Return the mean of five dots of the intact neighbourhood nearest to ``centre`` (II-B.2).

    The five are the middle of 3 x 3 dots and its four neighbours. A neighbourhood is intact if
    exactly four more dots are connected to two of these. The paper's weights are not
    published; equal ones scatter least. Returns None if there is no such neighbourhood.
    """
    n = len(points)
    directed = np.concatenate([edges, edges[:, ::-1]])
    order = np.lexsort((directed[:, 1], directed[:, 0]))
    start = np.searchsorted(directed[order, 0], np.arange(n + 1))
    neighbours = directed[order, 1]
    degree = np.diff(start)
    for dot in np.argsort(((points - centre) ** 2).sum(axis=1)):
        if degree[dot] != 4:
            continue
        sides = neighbours[start[dot] : start[dot + 1]]
        around = np.concatenate([neighbours[start[s] : start[s + 1]] for s in sides])
        others, counts = np.unique(around[around != dot], return_counts=True)
        corners = others[counts == 2]
        if len(corners) == 4 and not np.isin(corners, sides).any():
            result: Array = points[[dot, *sides]].mean(axis=0)
            return result
    return None


def refine_grid(grid: AffineGrid, points: Array) -> tuple[AffineGrid, Indices, Array] | None:
    """Refine origin, lengths (II-B.3) and directions of a grid.

    Eq. 6 as printed needs offsets g - c; with c - g of Eq. 5 the median is added. The distance of
    two neighbours is taken along their axis. The refinement of the directions is not in the paper
    (see the module's note).

    Returns
    -------
    (AffineGrid, (n, 2) int ndarray, (n, 2) ndarray) or None
        As :func:`fit_grid`; None if the refined grid is not plausible.
    """
    coordinates = grid.coordinates(points)
    nodes = _nearest_nodes(coordinates)
    origin = grid.points(np.median(coordinates - nodes, axis=0))
    lengths = [_median_spacing(coordinates, nodes, axis) for axis in (0, 1)]
    grid = AffineGrid(origin, grid.u * lengths[0], grid.v * lengths[1])
    nodes = _nearest_nodes(grid.coordinates(points))
    for _ in range(MAX_REFINEMENT_ROUNDS):
        design = np.c_[np.ones(len(nodes)), nodes]
        fitted, _, rank, _ = np.linalg.lstsq(design, points, rcond=None)
        grid = AffineGrid(*fitted)
        if rank < 3 or not grid.is_plausible:
            return None
        before, nodes = nodes, _nearest_nodes(grid.coordinates(points))
        if np.array_equal(nodes, before):
            break
    return grid, nodes, grid.coordinates(points) - nodes


def _nearest_nodes(coordinates: Array) -> Indices:
    """Round grid coordinates to the nodes of the grid (Eq. 4)."""
    return np.rint(coordinates).astype(np.intp)


def _median_spacing(coordinates: Array, nodes: Indices, axis: int) -> float:
    """Return the median distance along ``axis`` of dots at adjacent nodes, in units of the grid."""
    low = nodes.min(axis=0)
    stride = int(nodes[:, 1 - axis].max() - low[1 - axis]) + 1
    keys = (nodes[:, axis] - low[axis]) * stride + nodes[:, 1 - axis] - low[1 - axis]
    keys, first = np.unique(keys, return_index=True)
    next_index = np.searchsorted(keys, keys + stride)
    next_index[next_index == len(keys)] = 0
    has_next = keys[next_index] == keys + stride
    if not has_next.any():
        return 1.0
    distance = coordinates[first[next_index[has_next]], axis] - coordinates[first[has_next], axis]
    return float(np.median(distance))


def quasi_probability(projected: Array) -> Array:
    """Return the quasi-probability -1..1 of projected offsets in grid units (Eq. 9)."""
    ratio = projected / DOT_OFFSET_PITCHES
    result: Array = np.where(ratio**2 < 3, 1.5 * ratio - 0.5 * ratio**3, 0.0)
    return result


def soft_bits(nodes: Indices, offsets: Array) -> Array:
    """Return quasi-probabilities (2, rows, columns) of column and row bits (Eq. 7 to 9, Fig. 8).

    They are positive for a bit of 1, negative for 0, and zero without a dot. The first are the
    paper's P(y) and the second its P(x): it exchanges the names (docs/dots.md). Of several dots at
    a node the likeliest one counts.
    """
    low = nodes.min(axis=0)
    columns, rows = nodes.max(axis=0) - low + 1
    du, dv = offsets.T
    values = np.stack([quasi_probability(dv - du), quasi_probability(dv + du)])
    likelihood = np.abs(values.prod(axis=0))
    order = np.argsort(likelihood, kind="stable")[np.count_nonzero(likelihood == 0) :]
    bits = np.zeros((2, rows, columns))
    # The last value assigned to a node remains, which is the likeliest.
    bits[:, nodes[order, 1] - low[1], nodes[order, 0] - low[0]] = values[:, order]
    return bits
