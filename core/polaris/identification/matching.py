"""Matching of detected magnets with the grid of a tag, and the pose of the tag.

Each pair of magnets is matched with every pair of cells at a similar distance; the transform of
the pair assigns the other magnets to their nearest cells. The assignments with the most magnets
are kept, and their transforms are estimated by least squares over all their magnets. If the path
of the array was estimated from the field alone, its scale is an unknown as well: the known spacing
of the tag determines it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import umeyama, wrap_angle
from locatk.core.least_squares import DenseEquations, Indices, minimize
from locatk.core.polaris.magnets import DetectedMagnets
from locatk.core.polaris.tag import Cell, Tags, cell_positions, vertices

Array = NDArray[np.float64]

MAX_CELL_DISTANCE_SPACINGS = 0.3
"""Distance of a magnet from its cell up to which it is assigned, in spacings; the grid is not
fitted yet."""

GOOD_MISFIT_SPACINGS, MAX_MISFIT_SPACINGS = 0.05, 0.1
"""Rms distance of the magnets from their cells, in spacings: the limit that is tried first, and
the final one."""

MISFIT_RESOLUTION_M = 1e-9
"""Difference of misfits below which placements are equivalent [m]: rotations of a symmetric pattern
differ by rounding only."""

ESTIMATED_PATH_LENGTH_TOLERANCE, KNOWN_PATH_LENGTH_TOLERANCE = 0.15, 0.05
"""Relative tolerance of distances if the path was estimated from the field alone, and if it was
known."""

HAND_BUILT_SIGMA_M = 4e-4
"""Standard deviation of the position of a magnet that was set by hand [m]."""

AS_BUILT_SIGMA_M = 1e-4
"""The same if the magnets of the tag were measured as built [m]."""

SCALE_SIGMA = 0.03
"""Standard deviation of the scale of a path that was estimated from the field alone: the spacing of
the tag gives 0.985 to 1.043 on 57 recordings of the authors of the paper (docs/polaris.md)."""

FIXED_SCALE_SIGMA = 1e-6
"""The same if the path was known: the scale is fixed at 1."""

UNKNOWN_POSITION_SIGMA_M = 1e-3
"""Standard deviation of all positions if the method of detection has no covariance [m]."""

MAX_ITERATIONS, MIN_STEP = 20, 1e-12
"""Iterations of the fit of a grid, and the norm of a step (m, rad) that ends it."""


@dataclass(frozen=True)
class TagMatch:
    """Assignment of detected magnets to the cells of a tag, with the pose of the tag.

    Attributes
    ----------
    magnets : tuple of int
        Indices of the detected magnets, in the order of ``cells``.
    cells : tuple of (column, row)
        Row by row from v1.
    x_m, y_m, heading_rad : float
        Pose of the tag in the array's frame.
    covariance : (3, 3) ndarray
        Of the pose.
    scale, scale_sigma : float
        True over estimated length along the track, and its standard deviation.
    misfit_m : float
        Rms distance of the magnets from their cells.
    """

    magnets: tuple[int, ...]
    cells: tuple[Cell, ...]
    x_m: float
    y_m: float
    heading_rad: float
    covariance: Array
    scale: float
    scale_sigma: float
    misfit_m: float


def match_tags(
    detected: DetectedMagnets, tags: Tags, used: frozenset[int] = frozenset()
) -> list[TagMatch]:
    """Match the magnets with the grid of a tag; the matches of least misfit come first.

    All matches have as many magnets as a tag, or else as many as possible. Those that include the
    three vertices are preferred, if there are any.

    Parameters
    ----------
    detected : DetectedMagnets
    tags : Tags
    used : frozenset of int
        Indices of magnets that belong to other tags.
    """
    unused = np.array([k for k in range(len(detected)) if k not in used], int)
    if len(unused) < 2:
        return []
    tolerance = KNOWN_PATH_LENGTH_TOLERANCE
    if detected.is_path_estimated:
        tolerance = ESTIMATED_PATH_LENGTH_TOLERANCE
    assignments = [
        (tuple(int(unused[k]) for k, _ in pairs), tuple(cell for _, cell in pairs))
        for pairs in _candidate_assignments(detected.position_m[unused], tags, tolerance)
    ]
    counts = sorted({len(cells) for _, cells in assignments}, reverse=True)
    by_count = {
        count: _fit_grids(detected, tags, [a for a in assignments if len(a[1]) == count])
        for count in counts
    }
    vertex_cells = set(vertices(tags.order)[:3])
    limits = (GOOD_MISFIT_SPACINGS, MAX_MISFIT_SPACINGS)
    # A complete tag is preferred: more magnets on cells may be those of two tags.
    attempts = [(tags.magnets, limit) for limit in limits]
    attempts += [(count, limit) for count in counts for limit in limits if count > 2]
    attempts += [(2, MAX_MISFIT_SPACINGS)]
    for count, limit in attempts:
        matches = [m for m in by_count.get(count, []) if m.misfit_m < limit * tags.spacing_m]
        if matches:
            with_vertices = [match for match in matches if vertex_cells <= set(match.cells)]
            return sorted(with_vertices or matches, key=_rounded_misfit)
    return []


def _rounded_misfit(match: TagMatch) -> float:
    """Return the misfit as a sort key: equivalent placements keep the order of enumeration."""
    return round(match.misfit_m / MISFIT_RESOLUTION_M)


def refit_match(
    detected: DetectedMagnets,
    tags: Tags,
    match: TagMatch,
    positions_m: Array | None,
) -> TagMatch:
    """Fit a match again, to positions (M, 2) of the magnets as built; None for the cells."""
    (refitted,) = _fit_grids(detected, tags, [(match.magnets, match.cells)], positions_m)
    return refitted


def measure_spacing(detected: DetectedMagnets, tags: Tags, match: TagMatch) -> tuple[float, float]:
    """Measure the spacing of a matched tag relative to its design, across the track.

    The spacing of the sensors is the ruler. Along the track, the scale of the path is one.

    Returns
    -------
    spacing, sigma : float
        Relative to the design, and its standard deviation from the misfit of the magnets.
    """
    cells = cell_positions(tags, match.cells)
    cos, sin = np.cos(match.heading_rad), np.sin(match.heading_rad)
    rotated = cells @ np.array([[cos, sin], [-sin, cos]])
    magnets = detected.position_m[list(match.magnets)]
    if detected.is_path_estimated:
        magnets = magnets * [match.scale, 1.0]
    # Unknowns: x, y, a small rotation, and the scales along and across the track.
    m = len(magnets)
    design = np.zeros((m, 2, 5))
    design[:, 0, 0] = design[:, 1, 1] = 1.0
    design[:, 0, 2], design[:, 1, 2] = -rotated[:, 1], rotated[:, 0]
    design[:, 0, 3], design[:, 1, 4] = rotated[:, 0], rotated[:, 1]
    residual = (magnets - rotated - [match.x_m, match.y_m]).ravel()
    matrix = design.reshape(2 * m, 5)
    if 2 * m <= matrix.shape[1]:
        return 1.0, np.inf
    solution, *_ = np.linalg.lstsq(matrix, residual, rcond=None)
    left = residual - matrix @ solution
    variance = max(left @ left / (2 * m - 5), HAND_BUILT_SIGMA_M**2)
    covariance = variance * np.linalg.pinv(matrix.T @ matrix)
    return 1.0 + float(solution[4]), float(np.sqrt(covariance[4, 4]))


def apply_scale(detected: DetectedMagnets, match: TagMatch) -> DetectedMagnets:
    """Rescale lengths along the track by the scale of a match, if the path was estimated.

    The covariance then has the uncertainty of that scale.
    """
    if not detected.is_path_estimated:
        return detected
    m = len(detected)
    position = detected.position_m * [match.scale, 1.0]
    stretch = np.ones(3 * m)
    stretch[0::3] = match.scale
    covariance = detected.covariance * stretch[:, None] * stretch
    # Derivative of x, y, angle by the scale; its old variance is replaced by the new one.
    by_scale = np.zeros(3 * m)
    by_scale[0::3] = position[:, 0]
    scale_information = by_scale @ np.linalg.solve(covariance, by_scale)
    if scale_information > 0:
        change = match.scale_sigma**2 - 1 / scale_information
        covariance = covariance + change * np.outer(by_scale, by_scale)
    return replace(
        detected,
        position_m=position,
        path_m=detected.path_m * match.scale,
        covariance=covariance,
        is_path_estimated=False,
    )


Assignment = tuple[tuple[int, Cell], ...]
"""Pairs of a magnet's index and its cell, row by row from v1."""


def _candidate_assignments(
    magnets_m: Array, tags: Tags, length_tolerance: float
) -> dict[Assignment, None]:
    """Enumerate assignments of magnets (n, 2) to cells that agree with one rigid transform.

    Each pair of magnets is matched with every pair of cells of similar distance (relative
    tolerance ``length_tolerance``); the transform of the pair then assigns the other magnets.
    """
    order, spacing = tags.order, tags.spacing_m
    empty_column, empty_row = vertices(order)[3]
    cells = [(column, row) for row in range(order) for column in range(order)]
    cells.remove((empty_column, empty_row))
    cells_m = cell_positions(tags, tuple(cells))
    cell_offsets = cells_m[None, :] - cells_m[:, None]
    cell_distances = np.linalg.norm(cell_offsets, axis=2)
    tolerance = length_tolerance * cell_distances + MAX_CELL_DISTANCE_SPACINGS * spacing / 2
    assignments: dict[Assignment, None] = {}
    for i in range(len(magnets_m)):
        for j in range(i):
            offset = magnets_m[j] - magnets_m[i]
            difference = np.abs(cell_distances - np.linalg.norm(offset))
            first, second = np.nonzero((difference < tolerance) & (cell_distances > 0))
            if len(first) == 0:
                continue
            pair_offset = cell_offsets[first, second]
            rotation = np.arctan2(offset[1], offset[0])
            rotation = rotation - np.arctan2(pair_offset[:, 1], pair_offset[:, 0])
            # Transform into the tag's frame; the midpoint of the magnets maps to that of the cells.
            cos, sin = np.cos(rotation)[:, None], np.sin(rotation)[:, None]
            centred = magnets_m - (magnets_m[i] + magnets_m[j]) / 2
            midpoint = (cells_m[first] + cells_m[second]) / 2
            x = cos * centred[:, 0] + sin * centred[:, 1] + midpoint[:, :1]
            y = cos * centred[:, 1] - sin * centred[:, 0] + midpoint[:, 1:]
            half = (order - 1) / 2
            row, column = x / spacing + half, half - y / spacing
            nearest_row, nearest_column = np.rint(row), np.rint(column)
            distance = np.hypot(row - nearest_row, column - nearest_column)
            is_on_cell = distance < MAX_CELL_DISTANCE_SPACINGS
            is_on_cell &= (nearest_row >= 0) & (nearest_row < order)
            is_on_cell &= (nearest_column >= 0) & (nearest_column < order)
            is_on_cell &= (nearest_column != empty_column) | (nearest_row != empty_row)
            count = np.minimum(is_on_cell.sum(axis=1), tags.magnets)
            for k in np.flatnonzero(count >= max(2, count.max() - 1)):
                pairs = [
                    (int(m), (int(nearest_column[k, m]), int(nearest_row[k, m])))
                    for m in np.flatnonzero(is_on_cell[k])
                ]
                if len({cell for _, cell in pairs}) == len(pairs):
                    assignments[tuple(sorted(pairs, key=lambda pair: pair[1][::-1]))] = None
    return assignments


# ---- least squares


@dataclass(frozen=True)
class _GridStates:
    """Parameters (k, 4) of k transforms: x, y, heading and scale."""

    parameters: Array

    def take(self, problems: Indices | NDArray[np.bool_]) -> _GridStates:
        return _GridStates(self.parameters[problems])

    def put(self, problems: Indices, other: _GridStates) -> None:
        self.parameters[problems] = other.parameters


@dataclass(frozen=True)
class _GridProblem:
    """Fits of k assignments of m magnets, for :func:`~locatk.core.least_squares.minimize`.

    The residuals are the magnets, scaled along the track, minus the transformed cells.

    Attributes
    ----------
    magnets_m, cells_m : (k, m, 2) ndarray
    whitening : (k, 2 m, 2 m) ndarray
        Its product with the residuals has unit covariance.
    scale_sigma : float
    """

    magnets_m: Array
    cells_m: Array
    whitening: Array
    scale_sigma: float

    def linearize(self, state: _GridStates, problems: Indices) -> DenseEquations:
        magnets, cells = self.magnets_m[problems], self.cells_m[problems]
        x, y, heading, scale = (parameter[:, None] for parameter in state.parameters.T)
        cos, sin = np.cos(heading), np.sin(heading)
        rotated_x = cos * cells[..., 0] - sin * cells[..., 1]
        rotated_y = sin * cells[..., 0] + cos * cells[..., 1]
        k, m, _ = magnets.shape
        residual = np.empty((k, m, 2))
        residual[..., 0] = scale * magnets[..., 0] - rotated_x - x
        residual[..., 1] = magnets[..., 1] - rotated_y - y
        jacobian = np.zeros((k, m, 2, 4))
        jacobian[..., 0, 0] = jacobian[..., 1, 1] = -1.0
        jacobian[..., 0, 2], jacobian[..., 1, 2] = rotated_y, -rotated_x
        jacobian[..., 0, 3] = magnets[..., 0]
        whitening = self.whitening[problems]
        flat = residual.reshape(k, 2 * m)
        weighted = (whitening @ flat[..., None])[..., 0]
        cost = 0.5 * np.sum(weighted**2, axis=1)
        equations = DenseEquations.from_weighted(
            flat, weighted, whitening @ jacobian.reshape(k, 2 * m, 4), cost
        )
        equations.add_prior(
            slice(3, 4), state.parameters[:, 3:] - 1.0, np.array([self.scale_sigma])
        )
        return equations

    def retract(self, state: _GridStates, step: Array) -> _GridStates:
        return _GridStates(state.parameters + step)


def _fit_grids(
    detected: DetectedMagnets,
    tags: Tags,
    assignments: list[tuple[tuple[int, ...], tuple[Cell, ...]]],
    positions_m: Array | None = None,
) -> list[TagMatch]:
    """Fit the transforms of assignments with equal numbers of magnets.

    Parameters
    ----------
    assignments : list of (magnets, cells)
    positions_m : (m, 2) ndarray, optional
        Positions of the magnets of a tag as it was built, instead of its cells.
    """
    magnets = np.array([indices for indices, _ in assignments])
    count, m = magnets.shape
    if positions_m is None:
        build_sigma = HAND_BUILT_SIGMA_M
        cells_m = np.array([cell_positions(tags, cells) for _, cells in assignments])
    else:
        build_sigma, cells_m = AS_BUILT_SIGMA_M, positions_m[None]
    magnets_m = detected.position_m[magnets]
    rows = (3 * magnets[..., None] + np.arange(2)).reshape(count, 2 * m)
    covariance = detected.covariance[rows[:, :, None], rows[:, None, :]]
    if not np.all(np.isfinite(covariance)):
        covariance = np.tile(UNKNOWN_POSITION_SIGMA_M**2 * np.eye(2 * m), (count, 1, 1))
    whitening = np.linalg.inv(np.linalg.cholesky(covariance + build_sigma**2 * np.eye(2 * m)))
    start = np.zeros((count, 4))
    start[:, 3] = 1.0
    for k in range(count):
        rigid = umeyama(cells_m[k], magnets_m[k], with_scale=False)
        start[k, :2] = rigid.translation
        start[k, 2] = np.arctan2(rigid.rotation[1, 0], rigid.rotation[0, 0])
    minimum = minimize(
        _GridProblem(
            magnets_m,
            cells_m,
            whitening,
            SCALE_SIGMA if detected.is_path_estimated else FIXED_SCALE_SIGMA,
        ),
        _GridStates(start),
        count,
        damping=1e-9,
        max_iterations=MAX_ITERATIONS,
        min_gain=0.0,
        min_step=MIN_STEP,
    )
    equations: DenseEquations = minimum.equations
    # A path that is not straight shows in the grid, not in the samples of a pass.
    inflation = np.maximum(1.0, 2 * equations.cost / max(2 * m - 3, 1))
    covariances = np.linalg.inv(equations.hessian) * inflation[:, None, None]
    misfit = np.sqrt((equations.residual**2).sum(axis=1) / m)
    return [
        TagMatch(
            magnets=indices,
            cells=cells,
            x_m=float(x),
            y_m=float(y),
            heading_rad=float(wrap_angle(heading)),
            covariance=covariances[k, :3, :3],
            scale=float(scale),
            scale_sigma=float(np.sqrt(covariances[k, 3, 3])),
            misfit_m=float(misfit[k]),
        )
        for k, ((indices, cells), (x, y, heading, scale)) in enumerate(
            zip(assignments, minimum.state.parameters, strict=True)
        )
    ]
