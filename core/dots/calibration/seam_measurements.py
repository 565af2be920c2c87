"""Relative poses of neighbouring sheets, each from one frame that shows both.

The dots of all sheets in a frame are fitted together: one homography from the paper of the first
sheet to the frame, and a rotation and a shift of each other sheet on that paper (the frame sees one
plane). Since the pitch of all sheets is the same, neither the height nor the tilt of the camera
have to be known; its lens does.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.camera import Camera
from locatk.core.dots.localization.separation import SheetView
from locatk.core.dots.sheet import DOT_OFFSET_PITCHES, Manifest, Sheet
from locatk.core.errors import DegenerateError, InputError
from locatk.core.geometry import apply_homography, fit_homography, umeyama
from locatk.core.least_squares import DenseEquations, Indices, minimize
from locatk.core.robust import robust_sigma

Array = NDArray[np.float64]

MIN_VIEW_DOTS = 12
"""Least number of dots of each sheet in a measurement: four times those that determine a rigid
motion, with which one bad dot is recognised."""

SYSTEMATIC_SIGMA_PITCHES = 2e-3
"""Standard deviation of the error that all frames of a seam have in common, per axis; 1 um at 0.508
mm. Where a paper lies on another one, it is 0.1 mm nearer to the camera, which displaces its dots
by 1.7 um per degree of mean tilt. Dots next to a gap without dots are displaced as well: errors of
rendered seams are 0.1 to 1 um."""

HOMOGRAPHY_PARAMETERS = 8

BIWEIGHT_SIGMAS = 4.685
"""Distance in standard deviations from which a dot has no weight: Tukey's biweight with 95 %
efficiency for normal errors."""

REWEIGHTED_FITS = 4
"""Number of fits, each with the weights from the previous one."""

MAX_SCATTER_PITCHES = 0.05
"""Largest standard deviation of dots about their fit; beyond it the frame is not that of a plane
(a fold, a step), or motion has blurred it."""


@dataclass(frozen=True)
class SeamMeasurement:
    """Poses of the other sheets of a frame on the paper of its first one.

    Attributes
    ----------
    recording, frame : int
        Index of the recording, and of the frame in it.
    numbers : tuple of int
        Sheets; poses are on the paper of the first.
    points_mm : (k, 2) ndarray
        A point on the paper of each of the k other sheets, in the middle of its visible dots.
    poses : (k, 3) ndarray
        Position of that point on the paper of the first sheet in mm, and heading of the other paper
        in rad.
    covariance : (3 k, 3 k) ndarray
        Of the poses.
    nodes : tuple of (m, 2) int ndarray
        Grid positions of the dots of each sheet, without those that several sheets predict.
    """

    recording: int
    frame: int
    numbers: tuple[int, ...]
    points_mm: Array
    poses: Array
    covariance: Array
    nodes: tuple[NDArray[np.int64], ...]


def measure_seam(
    views: list[SheetView],
    manifest: Manifest,
    camera: Camera,
    recording: int = 0,
    frame: int = 0,
) -> SeamMeasurement | None:
    """Measure the relative poses of the sheets in a frame.

    None if fewer than two sheets have :data:`MIN_VIEW_DOTS`, if these are collinear, or if the dots
    do not fit.
    """
    if len(views) < 2:
        return None
    views = without_ambiguous_dots(views)
    views = [view for view in views if len(view.pixels) >= MIN_VIEW_DOTS]
    if len(views) < 2:
        return None
    try:
        fit = _SeamFit.of(views, manifest, camera)
    except DegenerateError:
        return None
    covariance, scatter = fit.refine()
    slope = fit.parameters[[0, 1, 3, 4]].reshape(2, 2)
    pitch = manifest.pitch_mm * math.sqrt(abs(float(np.linalg.det(slope))))
    if scatter > MAX_SCATTER_PITCHES * pitch or not np.isfinite(covariance).all():
        return None
    poses = fit.parameters[HOMOGRAPHY_PARAMETERS:].reshape(-1, 3)[:, [1, 2, 0]].copy()
    poses[:, :2] += fit.middles[0]
    order = HOMOGRAPHY_PARAMETERS + (3 * np.arange(len(poses))[:, None] + [1, 2, 0]).ravel()
    return SeamMeasurement(
        recording,
        frame,
        tuple(view.number for view in views),
        fit.middles[1:],
        poses,
        covariance[np.ix_(order, order)],
        tuple(np.rint(view.grid).astype(np.int64) for view in views),
    )


def without_ambiguous_dots(views: list[SheetView]) -> list[SheetView]:
    """Leave out dots that several sheets predict: those of the overlap of almost aligned tiles."""
    pixels = np.concatenate([view.pixels for view in views])
    _, index, count = np.unique(pixels, axis=0, return_inverse=True, return_counts=True)
    is_unique = (count == 1)[index.ravel()]
    ends = np.cumsum([len(view.pixels) for view in views])[:-1]
    return [
        replace(view, pixels=view.pixels[kept], grid=view.grid[kept])
        for view, kept in zip(views, np.split(is_unique, ends), strict=True)
    ]


def printed_positions(number: int, grid: Array, manifest: Manifest) -> Array:
    """Return the positions (n, 2) in mm on the paper of dots at grid coordinates (n, 2).

    The offsets of dots are those of the manifest, not those of decoded frames.
    """
    node = np.rint(grid)
    offset = (grid - node) * (manifest.offset_mm / manifest.pitch_mm / DOT_OFFSET_PITCHES)
    return manifest.to_paper(number, node + offset)


@dataclass
class _SeamFit:
    """Fit of one frame. Lengths are in mm on the paper and in half diagonals in the frame.

    Parameters are those of the homography (8, by rows; the ninth is 1), and rotation [rad] and
    position (two) of each other sheet.

    Attributes
    ----------
    observed : (n, 2) ndarray
        Dots in the frame, without distortion, from the middle of the frame.
    paper : (n, 2) ndarray
        Dots on their paper, from the middle of the dots of their sheet.
    sheet : (n,) int ndarray
        Index of the sheet of each dot.
    middles : (k, 2) ndarray
        Middle of the dots of each sheet on its paper.
    parameters : (8 + 3 (k - 1),) ndarray
    """

    observed: Array
    paper: Array
    sheet: NDArray[np.int64]
    middles: Array
    parameters: Array

    @classmethod
    def of(cls, views: list[SheetView], manifest: Manifest, camera: Camera) -> _SeamFit:
        """Return the initial guess of the fit of some views.

        Raises
        ------
        DegenerateError
            The dots of the first sheet are collinear.
        """
        half_diagonal = math.hypot(*camera.size) / 2
        pixels = np.concatenate([view.pixels for view in views])
        observed = (camera.undistort(pixels) - camera.centre_px) / half_diagonal
        sheet = np.repeat(np.arange(len(views)), [len(view.pixels) for view in views])
        positions = [printed_positions(view.number, view.grid, manifest) for view in views]
        middles = np.array([position.mean(axis=0) for position in positions])
        paper = np.concatenate(positions) - middles[sheet]
        first = sheet == 0
        homography = fit_homography(paper[first], observed[first])
        parameters = [homography.ravel()[:8] / homography[2, 2]]
        inverse = np.linalg.inv(homography)
        for other in range(1, len(views)):
            rows = sheet == other
            plane = apply_homography(inverse, observed[rows])
            rigid = umeyama(paper[rows], plane, with_scale=False)
            angle = math.atan2(rigid.rotation[1, 0], rigid.rotation[0, 0])
            parameters.append(np.array([angle, *rigid.translation]))
        return cls(observed, paper, sheet, middles, np.concatenate(parameters))

    def refine(self) -> tuple[Array, float]:
        """Fit the parameters; return their covariance and the scatter of a dot."""
        observed, paper, sheet = self.observed, self.paper, self.sheet
        weights = np.ones(len(sheet))
        freedom = 2 * len(sheet) - len(self.parameters)
        for _ in range(REWEIGHTED_FITS):
            problem = _SeamProblem(observed, paper, sheet, weights)
            minimum = minimize(problem, self.parameters, damping=1e-6, min_gain=1e-9)
            self.parameters = minimum.state
            residual = minimum.equations.residual.reshape(-1, 2)
            sigma = robust_sigma(residual) * math.sqrt(2 * len(sheet) / max(freedom, 1))
            ratio = np.linalg.norm(residual, axis=1) / (math.sqrt(2) * BIWEIGHT_SIGMAS * sigma)
            weights = np.clip(1 - ratio**2, 0, None) ** 2
        information = minimum.equations.hessian[0] / sigma**2
        try:
            return np.linalg.inv(information), sigma
        except np.linalg.LinAlgError:
            return np.full_like(information, np.nan), sigma


def _predict(parameters: Array, paper: Array, sheet: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return positions (n, 2) of dots in the frame, and their derivatives (n, 2, p)."""
    n = len(paper)
    others = parameters[HOMOGRAPHY_PARAMETERS:].reshape(-1, 3)
    angle, x, y = np.concatenate([np.zeros((1, 3)), others])[sheet].T
    c, s = np.cos(angle), np.sin(angle)
    rotated = np.stack([c * paper[:, 0] - s * paper[:, 1], s * paper[:, 0] + c * paper[:, 1]], 1)
    plane = rotated + np.stack([x, y], axis=1)
    rows = np.append(parameters[:HOMOGRAPHY_PARAMETERS], 1.0).reshape(3, 3)
    homogeneous = np.column_stack([plane, np.ones(n)])
    projected = homogeneous @ rows.T
    depth = projected[:, 2]
    position = projected[:, :2] / depth[:, None]
    jacobian = np.zeros((n, 2, len(parameters)))
    jacobian[:, 0, 0:3] = jacobian[:, 1, 3:6] = homogeneous / depth[:, None]
    jacobian[:, :, 6:8] = -position[:, :, None] * plane[:, None] / depth[:, None, None]
    by_plane = (rows[:2, :2] - position[:, :, None] * rows[2, :2]) / depth[:, None, None]
    dot = np.flatnonzero(sheet > 0)
    column = HOMOGRAPHY_PARAMETERS + 3 * (sheet[dot] - 1)
    by_angle = np.stack([-rotated[dot, 1], rotated[dot, 0]], axis=1)
    jacobian[dot, :, column] = (by_plane[dot] @ by_angle[..., None])[..., 0]
    for axis in (0, 1):
        jacobian[dot, :, column + 1 + axis] = by_plane[dot, :, axis]
    return position, jacobian


@dataclass(frozen=True)
class _SeamProblem:
    """Fit of a frame as a problem for :func:`~locatk.core.least_squares.minimize`."""

    observed: Array
    paper: Array
    sheet: NDArray[np.int64]
    weights: Array

    def linearize(self, state: Array, problems: Indices) -> DenseEquations:
        predicted, jacobian = _predict(state, self.paper, self.sheet)
        residual = (predicted - self.observed).ravel()
        root = np.sqrt(np.repeat(self.weights, 2))
        weighted = root * residual
        return DenseEquations.from_weighted(
            residual[None],
            weighted[None],
            (root[:, None] * jacobian.reshape(len(residual), -1))[None],
            np.array([0.5 * weighted @ weighted]),
        )

    def retract(self, state: Array, step: Array) -> Array:
        return np.asarray(state + step[0])


def add_systematic_errors(
    seams: Sequence[SeamMeasurement], pitch_mm: float
) -> list[SeamMeasurement]:
    """Return measurements whose mean over a seam is no better than its systematic errors are."""
    count = Counter(frozenset((seam.numbers[0], other)) for seam in seams for other in seam.numbers)
    result = []
    for seam in seams:
        frames = np.array([count[frozenset((seam.numbers[0], n))] for n in seam.numbers[1:]])
        variance = frames * (SYSTEMATIC_SIGMA_PITCHES * pitch_mm) ** 2
        spread = np.diag(np.column_stack([variance, variance, np.zeros(len(frames))]).ravel())
        result.append(replace(seam, covariance=seam.covariance + spread))
    return result


# ---- cuts


def crop_overlaps(manifest: Manifest, seams: Iterable[SeamMeasurement]) -> Manifest:
    """Return the manifest in which overlapping tiles end where one covers the other.

    Dots in the overlap of two tiles are printed on both, so that a frame of them alone does not
    reveal its tile. The frames across the seam show on which side of it each tile is visible.
    Without them, the cut is in the middle.
    """
    visible: dict[int, list[NDArray[np.int64]]] = {}
    for seam in seams:
        for number, nodes in zip(seam.numbers, seam.nodes, strict=True):
            visible.setdefault(number, []).append(nodes)
    seen = {number: np.concatenate(parts) for number, parts in visible.items()}
    sheets = list(manifest.sheets)
    for first, second in itertools.permutations(range(len(sheets)), 2):
        for axis in (0, 1):
            overlap = _overlap(manifest.sheets[first], manifest.sheets[second], axis)
            if overlap is not None:
                low, high = overlap
                counts = [_counts(seen.get(number), axis, low, high) for number in (first, second)]
                cut = int(low[axis]) + _best_cut(*counts)
                sheets[first] = _crop(sheets[first], axis, end=cut, pitch_mm=manifest.pitch_mm)
                sheets[second] = _crop(sheets[second], axis, start=cut, pitch_mm=manifest.pitch_mm)
    return replace(manifest, sheets=tuple(sheets))


def refuse_contained_tiles(manifest: Manifest) -> None:
    """Refuse tiles inside of others, which no cut separates.

    Raises
    ------
    InputError
        The pattern of a tile contains that of another one.
    """
    low = np.array([sheet.origin for sheet in manifest.sheets])
    high = low + [sheet.size for sheet in manifest.sheets]
    section = np.array([sheet.section for sheet in manifest.sheets])
    is_tile = np.array([sheet.position_mm is not None for sheet in manifest.sheets])
    for number in np.flatnonzero(is_tile):
        is_around = (low <= low[number]).all(axis=1) & (high >= high[number]).all(axis=1)
        is_around &= is_tile & (section == section[number]).all(axis=1)
        is_around[number] = False
        if is_around.any():
            inner, outer = manifest.sheets[number], manifest.sheets[int(is_around.argmax())]
            raise InputError(
                f"the pattern of tile {inner.id} is inside of that of {outer.id}",
                hint="Tiles overlap at their sides only; remove the one that is not part of the "
                "floor from the manifest",
            )


def _overlap(
    first: Sheet, second: Sheet, axis: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]] | None:
    """Return low and high end of the area on both tiles, if ``second`` continues ``first``.

    ``axis`` is that of x or y along which it does.
    """
    if first.position_mm is None or second.position_mm is None or first.section != second.section:
        return None
    ends = [np.array(sheet.origin) + sheet.size for sheet in (first, second)]
    low, high = np.maximum(first.origin, second.origin), np.minimum(*ends)
    across = 1 - axis
    continues = second.origin[axis] > first.origin[axis] and ends[1][axis] > ends[0][axis]
    if (low >= high).any() or not continues:
        return None
    # Diagonal neighbours share a corner only.
    is_side = high[across] - low[across] > min(first.size[across], second.size[across]) / 2
    return (low, high) if is_side else None


def _counts(
    nodes: NDArray[np.int64] | None,
    axis: int,
    low: NDArray[np.int64],
    high: NDArray[np.int64],
) -> NDArray[np.int64]:
    """Return how many dots of a tile were seen in each line of an overlap."""
    count = int(high[axis] - low[axis])
    if nodes is None:
        return np.zeros(count, np.int64)
    inside = nodes[((nodes >= low) & (nodes < high)).all(axis=1), axis] - low[axis]
    return np.bincount(inside, minlength=count)


def _best_cut(first: NDArray[np.int64], second: NDArray[np.int64]) -> int:
    """Return the line from which on dots belong to the second tile; in doubt the middle."""
    wrong = np.append(0, np.cumsum(second)) + np.append(np.cumsum(first[::-1])[::-1], 0)
    best = np.flatnonzero(wrong == wrong.min())
    return int(best[np.abs(best - len(first) / 2).argmin()])


def _crop(
    sheet: Sheet, axis: int, *, start: int | None = None, end: int | None = None, pitch_mm: float
) -> Sheet:
    """Return a sheet that begins at a line of the grid, or ends before it."""
    origin, size, first_mm = list(sheet.origin), list(sheet.size), list(sheet.first_mm)
    if start is not None and start > origin[axis]:
        first_mm[axis] += (start - origin[axis]) * pitch_mm
        size[axis] -= start - origin[axis]
        origin[axis] = start
    if end is not None:
        size[axis] = min(size[axis], end - origin[axis])
    return replace(
        sheet,
        origin=(origin[0], origin[1]),
        size=(size[0], size[1]),
        first_mm=(first_mm[0], first_mm[1]),
    )
