"""Frames that show several sheets: which dots belong to which sheet.

Two papers of a floor are not glued to a fraction of a dot. A frame across their seam shows two
lattices, so that it is rejected, or that the dots of the smaller part pull the pose of the larger
one. Here, one sheet is decoded first, if need be in one half of the frame. Its dots define a
homography. The other dots, rectified by it, form the lattice of the neighbour: same pitch, unknown
rotation and shift. If the place of the neighbour on the floor is roughly known, its positions
within some centimetres are compared with the symbols of these dots, for which about 20 dots are
enough; otherwise the rest of the frame is decoded like a frame of its own.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from locatk.core.dots.camera import Camera
from locatk.core.dots.codec import DOT_DIRECTIONS, Codec
from locatk.core.dots.detection.blobs import detect_dots
from locatk.core.dots.detection.lattice import MIN_SIGMA_PITCHES, nearest_symbol_offset
from locatk.core.dots.frames import Frames
from locatk.core.dots.identification.decoding import MIN_CONFIDENCE
from locatk.core.dots.localization.frames import (
    LOW_CONFIDENCE,
    NO_CODE,
    NO_GRID,
    DotCorrespondences,
    LocalizedFrames,
    dot_correspondences,
    localize_frames,
    unlocalized_frames,
)
from locatk.core.dots.sheet import DOT_OFFSET_PITCHES, Manifest, Sheet
from locatk.core.least_squares import DenseEquations, Indices, minimize
from locatk.core.robust import robust_sigma

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

MIN_SHEET_DOTS = 20
"""Least number of dots by which a sheet counts as visible. Dots of another sheet agree with a
lattice by chance in 4 % of the cases (the square of twice the gate), seven in a frame of 180."""

MATCH_GATE_PITCHES = 0.1
"""Largest distance of a dot from its predicted position on a sheet, per axis."""

CONSENSUS_GATE_PITCHES = 0.04
"""Largest distance of a dot from the homography of its sheet when the sheets are not yet separated.
A lattice that is fitted to two sheets bends over a step of 0.4 pitches between them with residuals
of 0.1; within this gate only the dots of one sheet agree."""

HALF_PLANES = 8
"""Number of directions of the halves of a frame that are decoded."""

MAX_PLACE_ERROR_MM = 20.0
"""Largest error of the relative position of two placed sheets at their seam."""

MAX_PLACE_ERROR_RAD = math.radians(5)
"""Largest error of their relative heading."""

MAX_SHEETS = 4
"""Maximum number of sheets in a frame; that is where their corners meet."""

ANGLE_STEP_RAD = math.radians(0.25)
"""Step of the search for the heading of a lattice; 12 pitches away it moves a dot by 1/19 pitch."""

SYMBOL_SIGMA_PITCHES = 0.05
"""Standard deviation of a rectified dot about its symbol, before its lattice is refined."""

OUTLIER_LIKELIHOOD = 0.018
"""Likelihood of a dot at a random position, relative to the peak; as for the soft bits of frames
(:mod:`~locatk.core.dots.identification.soft_bits`)."""

MIN_LOG_ODDS = math.log(1e4)
"""Least log odds of a position against all other ones nearby, and against random dots."""

DETECTED_PITCH_PX = 11.0
"""Pitch to which a frame is shrunk before dots are detected; that of the paper's camera."""

DOT_GATE_SIGMAS = 4.0
"""Distance from its fit, per axis and in robust standard deviations, from which a dot is not used
for a pose. A dot of another sheet is within the gate of a symbol in 4 % of the cases."""

LENS_PRIOR_SIGMA = 0.15
"""Prior standard deviation of the distortion of an unknown lens at the corner of the frame, as for
lattices (:mod:`~locatk.core.dots.detection.lattice`)."""

KNOWN_LENS_SIGMA = 1e-9
"""The same of a known lens, whose distortion has been removed."""

REFITS = 4
"""Number of fits of a pose, each with the dots within the gate of the previous one."""

ERASED_RADIUS_PITCHES = 0.3
"""Radius in which a dot is erased; two dots are 2/3 of a pitch apart or more."""

NO_SYMBOL = 4
"""Stands for the symbol of a position without a dot."""

MAX_PLANE_PITCHES = 400
"""Side of the area in which dots are compared with symbols; a frame with so many dots is larger
than any that is decoded."""

DRAWING_BITS = 4
"""Fractional bits of the positions of erased dots."""


@dataclass(frozen=True)
class SheetView:
    """Dots of one sheet in a frame.

    Attributes
    ----------
    number : int
        Of the sheet in the manifest.
    pixels : (m, 2) ndarray
        In the frame, with distortion.
    grid : (m, 2) ndarray
        Grid coordinates of the dots themselves, with their offsets.
    """

    number: int
    pixels: Array
    grid: Array


def separate_sheets(
    image: Image, manifest: Manifest, code: Codec, camera: Camera | None = None
) -> list[SheetView]:
    """Return the dots of each sheet that a frame (h, w) shows, most dots first.

    Empty if no sheet is decoded. A dot that is printed on several sheets (the overlap of tiles) is
    one of each that predicts it.
    """
    first = _first_view(image, manifest, code, camera)
    frame = None if first is None else _rectify(image, first, manifest, code, camera)
    if frame is None:
        return []
    views: list[SheetView] = []
    placement: _Placement | None = frame.first_placement
    while placement is not None and len(views) < MAX_SHEETS:
        view = frame.take(placement)
        if len(view.pixels) < MIN_SHEET_DOTS:
            break
        views.append(view)
        visible = {each.number for each in views}
        placement = None
        if frame.rest.sum() >= MIN_SHEET_DOTS:
            placement = frame.match_neighbour(visible) or frame.decode_rest(image, visible)
    return sorted(views, key=lambda view: -len(view.pixels))


def relocalize_at_seams(
    frames: Frames,
    localized: LocalizedFrames,
    numbers: NDArray[np.intp],
    manifest: Manifest,
    code: Codec,
    camera: Camera | None = None,
) -> None:
    """Localize frames that show several sheets by the dots of one of them, in place.

    Parameters
    ----------
    frames : Frames
    localized : LocalizedFrames
        Of these frames.
    numbers : (n,) intp ndarray
        Sheet of each frame, -1 if it has none. A frame may be about as far from the middle of one
        sheet as from that of the next; the sheet is the one to which most of its dots belong.
    manifest, code, camera
    """
    for index in np.flatnonzero(may_show_seam(localized, numbers, manifest)).tolist():
        image = frames.images[index]
        views = separate_sheets(image, manifest, code, camera)
        if len(views) > 1 or (views and views[0].number != numbers[index]):
            localized.replace(index, localize_view(views[0], image.shape, manifest, camera))
            numbers[index] = views[0].number


def localize_view(
    view: SheetView, shape: tuple[int, ...], manifest: Manifest, camera: Camera | None = None
) -> LocalizedFrames:
    """Return the pose of a frame (h, w) on the grid of one of its sheets."""
    height, width = shape[:2]
    half_diagonal = math.hypot(width, height) / 2
    if camera is None:
        points = view.pixels - [(width - 1) / 2, (height - 1) / 2]
    else:
        points = camera.undistort(view.pixels) - camera.centre_px
    points = points / half_diagonal
    start = np.rint(view.grid.mean(axis=0))
    grid = view.grid - start
    parameters, covariance, dots = _fit_view(points, grid, has_lens=camera is None)
    # Central differences; the pose is smooth on the scale of its errors.
    steps = np.sqrt(np.diag(covariance)) + np.finfo(float).tiny
    jacobian = np.stack(
        [
            (_pose_of(parameters + row) - _pose_of(parameters - row)) / (2 * step)
            for row, step in zip(np.diag(steps), steps, strict=True)
        ],
        axis=1,
    )
    pose = _pose_of(parameters)
    result = unlocalized_frames(1, "")
    result.grid[0] = start + pose[:2]
    result.section[0] = manifest.sheets[view.number].section
    result.heading[0] = pose[2]
    result.covariance[0] = jacobian @ covariance @ jacobian.T
    result.dots[0] = dots
    # The frame was decoded with this confidence or more.
    result.confidence[0] = MIN_CONFIDENCE
    return result


def _pose_of(parameters: Array) -> Array:
    """Return x, y and heading on the grid at the centre of the camera, by a homography to it."""
    rows = np.append(parameters[:8], 1.0).reshape(3, 3)
    x, y, scale = np.linalg.solve(rows, [0.0, 0.0, 1.0])
    x, y = x / scale, y / scale
    depth = rows[2] @ [x, y, 1.0]
    right = np.linalg.solve(rows[:2, :2] / depth, [1.0, 0.0])
    return np.array([x, y, math.atan2(-right[1], right[0])])


def _fit_view(points: Array, grid: Array, *, has_lens: bool) -> tuple[Array, Array, int]:
    """Fit the homography from the grid to the frame, and the distortion of an unknown lens.

    Returns
    -------
    parameters : (9,) ndarray
        Homography by rows, without the last element, which is 1; k of the division model.
    covariance : (9, 9) ndarray
    dots : int
        Number of dots within the gate.
    """
    homography, _ = cv2.findHomography(points, grid, cv2.RANSAC, CONSENSUS_GATE_PITCHES)
    inverse = np.linalg.inv(homography)
    state = np.append(inverse.ravel()[:8] / inverse[2, 2], 0.0)
    used = np.ones(len(grid), np.bool_)
    pitch = math.sqrt(abs(float(np.linalg.det(state[[0, 1, 3, 4]].reshape(2, 2)))))
    least = MIN_SIGMA_PITCHES * pitch
    sigma = least
    for _ in range(REFITS):
        problem = _ViewProblem(points[used], grid[used], sigma, has_lens)
        minimum = minimize(problem, state, damping=1e-6, min_gain=1e-9)
        state = minimum.state
        residual = _ViewProblem(points, grid, 1.0, has_lens).residual(state)
        sigma = max(robust_sigma(residual), least)
        used = np.asarray((np.abs(residual) < DOT_GATE_SIGMAS * sigma).all(axis=1))
    final = _ViewProblem(points[used], grid[used], sigma, has_lens).linearize(
        state, np.zeros(1, np.int64)
    )
    information = final.hessian[0]
    return state, np.linalg.inv(information), int(used.sum())


@dataclass(frozen=True)
class _ViewProblem:
    """Fit of a view as a problem for :func:`~locatk.core.least_squares.minimize`.

    The distortion is zero up to its prior if the lens is known.
    """

    points: Array
    grid: Array
    sigma: float
    has_lens: bool

    def residual(self, state: Array) -> Array:
        """Return predicted minus observed positions (n, 2) without distortion."""
        rows = np.append(state[:8], 1.0).reshape(3, 3)
        projected = np.column_stack([self.grid, np.ones(len(self.grid))]) @ rows.T
        squared = (self.points**2).sum(axis=1, keepdims=True)
        return np.asarray(
            projected[:, :2] / projected[:, 2:] - self.points / (1 + state[8] * squared)
        )

    def linearize(self, state: Array, problems: Indices) -> DenseEquations:
        rows = np.append(state[:8], 1.0).reshape(3, 3)
        homogeneous = np.column_stack([self.grid, np.ones(len(self.grid))])
        projected = homogeneous @ rows.T
        depth = projected[:, 2:]
        position = projected[:, :2] / depth
        jacobian = np.zeros((len(self.grid), 2, 9))
        jacobian[:, 0, 0:3] = jacobian[:, 1, 3:6] = homogeneous / depth
        jacobian[:, :, 6:8] = -position[:, :, None] * (self.grid / depth)[:, None]
        squared = (self.points**2).sum(axis=1, keepdims=True)
        jacobian[:, :, 8] = self.points * squared / (1 + state[8] * squared) ** 2
        residual = self.residual(state).ravel()[None] / self.sigma
        equations = DenseEquations.from_weighted(
            residual,
            residual,
            jacobian.reshape(1, -1, 9) / self.sigma,
            0.5 * (residual**2).sum(axis=1),
        )
        lens_sigma = LENS_PRIOR_SIGMA if self.has_lens else KNOWN_LENS_SIGMA
        equations.add_prior(slice(8, 9), state[None, 8:], np.array([lens_sigma]))
        return equations

    def retract(self, state: Array, step: Array) -> Array:
        return np.asarray(state + step[0])


def may_show_seam(
    localized: LocalizedFrames, numbers: NDArray[np.intp], manifest: Manifest
) -> NDArray[np.bool_]:
    """Return the frames (n,) that may show several sheets.

    ``numbers`` (n,) is the sheet of each frame, -1 if it has none. A frame may show a seam if the
    end of its sheet is no farther from the middle than the corners of the frame are, or if it was
    rejected with many dots or without a lattice.
    """
    low = np.array([sheet.origin for sheet in manifest.sheets])[numbers]
    high = low + np.array([sheet.size for sheet in manifest.sheets])[numbers] - 1
    to_end = np.minimum(localized.grid - low, high - localized.grid).min(axis=1)
    # The corners are 0.74 times the root of the area away at 188 x 120 px, 0.77 at 16:9.
    is_near = to_end < np.sqrt(localized.dots)
    is_rejected = np.isin(localized.rejected, [NO_CODE, LOW_CONFIDENCE])
    is_rejected &= localized.dots >= 2 * MIN_SHEET_DOTS
    # Two lattices that differ by half a pitch may leave none, and no dots on it to count.
    is_rejected |= localized.rejected == NO_GRID
    return np.asarray(np.where(localized.accepted & (numbers >= 0), is_near, is_rejected))


def _nearest(
    points: Array, others: Array, radius: float
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the nearest of other points for each point, and whether it is within a radius."""
    distance, index = cKDTree(others).query(points, distance_upper_bound=radius)
    return np.asarray(index, np.int64), np.isfinite(distance)


# ---- the first sheet


def _first_view(
    image: Image, manifest: Manifest, code: Codec, camera: Camera | None
) -> SheetView | None:
    """Return the dots of a sheet that is decoded in the frame or in one of its halves."""
    view = _decode(image, manifest, code, camera)
    if view is not None:
        return view
    halves = np.stack(list(_halves(image)))
    localized = localize_frames(halves, code, camera, other_codec_odds=0)
    dots = np.where(localized.accepted, localized.dots, 0)
    return _decode(halves[dots.argmax()], manifest, code, camera) if dots.any() else None


def _decode(
    image: Image, manifest: Manifest, code: Codec, camera: Camera | None
) -> SheetView | None:
    """Return the dots of the sheet to which most dots of the decoded lattice belong."""
    for dots in dot_correspondences(image[None], code, camera, other_codec_odds=0):
        return view_of_sheet(dots, manifest)
    return None


def view_of_sheet(dots: DotCorrespondences, manifest: Manifest) -> SheetView | None:
    """Return the dots of the sheet to which most of the dots of a lattice belong, if any do."""
    grid = dots.origin + dots.grid
    is_member = manifest.contains(grid, dots.section)
    # Dots that are printed on a single sheet decide.
    exclusive = (is_member & (is_member.sum(axis=0) == 1)).sum(axis=1)
    total = is_member.sum(axis=1)
    number = int(np.argmax(exclusive + total / (1 + len(grid))))
    if total[number] < MIN_SHEET_DOTS:
        return None
    own = is_member[number]
    return SheetView(number, dots.pixels[own], grid[own])


def _halves(image: Image) -> Iterator[Image]:
    """Yield the frame with one half blank, in all directions."""
    height, width = image.shape
    y, x = np.indices(image.shape) - np.array([(height - 1) / 2, (width - 1) / 2])[:, None, None]
    paper = _paper_brightness(image, min(image.shape) / 6)
    for angle in np.arange(HALF_PLANES) * (2 * math.pi / HALF_PLANES):
        yield np.where(math.cos(angle) * x + math.sin(angle) * y < 0, paper, image)


def _paper_brightness(image: Image, width_px: float) -> Image:
    """Return the median about each pixel; dots cover much less than half of the paper."""
    width = min(2 * round(width_px / 2) + 1, 2 * (min(image.shape) // 2) - 1)
    return np.asarray(cv2.medianBlur(image, width), np.uint8)


def _erase(image: Image, pixels: Array, pitch_px: float) -> Image:
    """Return the frame with paper painted over some dots."""
    mask = np.zeros(image.shape, np.uint8)
    scale = 1 << DRAWING_BITS
    radius = round(scale * ERASED_RADIUS_PITCHES * pitch_px)
    for x, y in np.rint(scale * pixels).astype(int).tolist():
        cv2.circle(mask, (x, y), radius, 255, -1, cv2.LINE_8, DRAWING_BITS)
    return np.where(mask > 0, _paper_brightness(image, 1.5 * pitch_px), image)


def _detect(image: Image, level: int) -> Array:
    """Return the positions (n, 2) in px of all dots of a frame, halved ``level`` times."""
    height, width = (side >> level << level for side in image.shape)
    size = (width >> level, height >> level)
    small = cv2.resize(image[:height, :width], size, interpolation=cv2.INTER_AREA)
    dots = detect_dots(np.asarray(small, np.uint8)[None])
    found = dots.xy[0, dots.valid[0]].astype(np.float64)
    return np.asarray((found + 0.5) * (1 << level) - 0.5)


def _level(pitch_px: float) -> int:
    return max(0, round(math.log2(pitch_px / DETECTED_PITCH_PX)))


def _pitch_px(grid: Array, pixels: Array) -> float:
    """Return the mean distance of neighbouring grid positions in the frame."""
    offset = grid - grid.mean(axis=0)
    slope = np.linalg.lstsq(offset, pixels - pixels.mean(axis=0))[0]
    return math.sqrt(abs(float(np.linalg.det(slope))))


# ---- its neighbours


@dataclass(frozen=True)
class _Placement:
    """Rigid transform from the plane of a frame to the grid of a sheet: ``p @ axes.T + shift``."""

    number: int
    axes: Array
    shift: Array

    def to_grid(self, plane: Array) -> Array:
        return np.asarray(plane @ self.axes.T + self.shift)


@dataclass
class _RectifiedFrame:
    """All dots of a frame, rectified to the lattice of its first sheet.

    Attributes
    ----------
    pixels : (n, 2) ndarray
        With distortion.
    plane : (n, 2) ndarray
        In pitches on the first sheet from the grid position ``start``, y down.
    rest : (n,) bool ndarray
        Dots that belong to no sheet yet.
    pitch_px : float
    first : int
        Number of the first sheet.
    start : (2,) ndarray
    manifest, code, camera
    """

    pixels: Array
    plane: Array
    rest: NDArray[np.bool_]
    pitch_px: float
    first: int
    start: Array
    manifest: Manifest
    code: Codec
    camera: Camera | None

    @property
    def first_placement(self) -> _Placement:
        """Placement of the first sheet."""
        return _Placement(self.first, np.eye(2), self.start)

    def take(self, placement: _Placement) -> SheetView:
        """Return all dots of a sheet and remove them from the rest."""
        node = placement.to_grid(self.plane)
        dot, is_own = _printed_dots(node, placement.number, self.manifest, self.code)
        self.rest &= ~is_own
        return SheetView(placement.number, self.pixels[is_own], dot[is_own])

    def match_neighbour(self, visible: set[int]) -> _Placement | None:
        """Find the position of the remaining dots on a sheet whose place is roughly known.

        Their symbols are compared with all positions of the placed sheets that are within
        :data:`MAX_PLACE_ERROR_MM`. All of these and random dots are the alternatives.
        """
        sheets = self.manifest.sheets
        if sheets[self.first].position_mm is None:
            return None
        points = self.plane[self.rest]
        middle = points.mean(axis=0)
        best: tuple[float, _Placement] | None = None
        evidence = [np.zeros(1)]
        for number, sheet in enumerate(sheets):
            if sheet.position_mm is None or number in visible:
                continue
            nominal, right = self._nominal_positions(number, middle + [[0, 0], [1, 0]])
            margin = 2 * MAX_PLACE_ERROR_MM / self.manifest.pitch_mm
            beyond = np.maximum(sheet.origin - nominal, nominal - sheet.origin - sheet.size)
            if (beyond > margin).any():
                continue
            axes, offset = _fit_lattice(points - middle, right - nominal)
            log_odds, shift = self._search(number, (points - middle) @ axes.T + offset, nominal)
            evidence.append(log_odds.ravel())
            if best is None or log_odds.max() > best[0]:
                placement = _Placement(number, axes, offset + shift - middle @ axes.T)
                best = float(log_odds.max()), placement
        if best is None:
            return None
        others = np.concatenate(evidence)
        others = others[others < best[0]]
        # A priori, random dots are as likely as all positions together.
        others[0] += math.log(len(others))
        return best[1] if best[0] - np.logaddexp.reduce(others) > MIN_LOG_ODDS else None

    def _nominal_positions(self, number: int, plane: Array) -> Array:
        """Return the grid positions on another sheet at points of the plane, by the manifest."""
        return self.manifest.to_grid(
            number, self.manifest.to_metres(self.first, plane + self.start)
        )

    def _search(self, number: int, points: Array, nominal: Array) -> tuple[Array, Array]:
        """Return the log odds of all shifts of a lattice, and the best shift (2,) in pitches."""
        sheet = self.manifest.sheets[number]
        nodes = np.rint(points).astype(np.int64)
        one, zero = _bit_likelihoods(points - nodes)
        # Relative to bits at random, which are one or zero with equal probability.
        gain = np.log([2 * zero / (one + zero), 2 * one / (one + zero)])
        reach = math.ceil(MAX_PLACE_ERROR_MM / self.manifest.pitch_mm)
        extent = int(np.abs(nodes).max())
        low = np.rint(nominal).astype(np.int64) - reach - extent
        side = 2 * (reach + extent) + 1
        symbols = _padded_symbols(self.code, sheet, low, side)
        shifts = np.arange(2 * reach + 1)
        log_odds = np.zeros((len(shifts), len(shifts)))
        for k, (x, y) in enumerate((nodes + extent).tolist()):
            window = symbols[y : y + len(shifts), x : x + len(shifts)]
            # A dot beyond the edge of the sheet would be a speck.
            table = np.append(
                gain[[0, 1, 0, 1], 0, k] + gain[[0, 0, 1, 1], 1, k], math.log(OUTLIER_LIKELIHOOD)
            )
            log_odds += table[window]
        row, column = np.unravel_index(int(log_odds.argmax()), log_odds.shape)
        return log_odds, low + extent + [column, row]

    def decode_rest(self, image: Image, visible: set[int]) -> _Placement | None:
        """Decode the remaining dots like a frame of their own."""
        erased = _erase(image, self.pixels[~self.rest], self.pitch_px)
        view = _decode(erased, self.manifest, self.code, self.camera)
        if view is None or view.number in visible:
            return None
        nearest, is_near = _nearest(self.pixels, view.pixels, MATCH_GATE_PITCHES * self.pitch_px)
        if is_near.sum() < MIN_SHEET_DOTS:
            return None
        plane, grid = self.plane[is_near], view.grid[nearest[is_near]]
        middle = plane.mean(axis=0)
        axes = _fit_rotation(plane - middle, grid - grid.mean(axis=0))
        return _Placement(view.number, axes, grid.mean(axis=0) - middle @ axes.T)


def _rectify(
    image: Image, view: SheetView, manifest: Manifest, code: Codec, camera: Camera | None
) -> _RectifiedFrame | None:
    """Detect all dots of a frame and rectify them by the known dots of its first sheet."""
    undistort = (lambda pixels: pixels) if camera is None else camera.undistort
    start = np.rint(view.grid.mean(axis=0))
    flat, grid = undistort(view.pixels), view.grid - start
    pitch_px = _pitch_px(grid, flat)
    pixels = _detect(image, _level(pitch_px))
    # Twice: the second time with the dots of the other half, if one half was decoded.
    for _ in range(2):
        inverse, _ = cv2.findHomography(flat, grid, cv2.RANSAC, CONSENSUS_GATE_PITCHES)
        if inverse is None:
            return None
        plane = cv2.perspectiveTransform(undistort(pixels)[:, None], inverse)[:, 0]
        dot, is_own = _printed_dots(plane + start, view.number, manifest, code)
        if is_own.sum() < MIN_SHEET_DOTS:
            return None
        flat, grid = undistort(pixels[is_own]), dot[is_own] - start
    rest = np.ones(len(pixels), np.bool_)
    return _RectifiedFrame(
        *(pixels, np.asarray(plane), rest, pitch_px, view.number, start, manifest, code, camera)
    )


def _printed_dots(
    grid: Array, number: int, manifest: Manifest, code: Codec
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the printed dots nearest to grid positions (n, 2), and which of them are within the
    gate.
    """
    sheet = manifest.sheets[number]
    node = np.rint(grid).astype(np.int64)
    low = node.min(axis=0)
    side = int((node.max(axis=0) - low).max()) + 1
    symbols = _padded_symbols(code, sheet, low, min(side, MAX_PLANE_PITCHES))
    index = np.clip(node - low, 0, len(symbols) - 1)
    symbol = symbols[index[:, 1], index[:, 0]]
    is_printed = (symbol < NO_SYMBOL) & (index == node - low).all(axis=1)
    dot = node + DOT_DIRECTIONS[np.where(is_printed, symbol, 0)] * DOT_OFFSET_PITCHES
    return dot, is_printed & (np.abs(grid - dot) < MATCH_GATE_PITCHES).all(axis=1)


def _padded_symbols(
    code: Codec, sheet: Sheet, low: NDArray[np.int64], side: int
) -> NDArray[np.uint8]:
    """Return the symbols of a square of the grid, :data:`NO_SYMBOL` beyond the sheet."""
    result = np.full((side, side), NO_SYMBOL, np.uint8)
    first = np.maximum(low, sheet.origin)
    last = np.minimum(low + side, np.array(sheet.origin) + sheet.size)
    columns, rows = (int(count) for count in last - first)
    if columns > 0 and rows > 0:
        x, y = (int(offset) for offset in first - low)
        result[y : y + rows, x : x + columns] = code.symbols(
            (int(first[0]), int(first[1])), (columns, rows), sheet.section
        )
    return result


def _bit_likelihoods(offset: Array) -> tuple[Array, Array]:
    """Return the likelihoods (2, n) that column and row bit are one, and that they are zero."""
    projection = np.array([offset[:, 1] - offset[:, 0], offset[:, 1] + offset[:, 0]])
    # The variance of a projection on a diagonal is twice that of an axis.
    one, zero = (
        np.exp(-((projection - sign * DOT_OFFSET_PITCHES) ** 2) / (4 * SYMBOL_SIGMA_PITCHES**2))
        + OUTLIER_LIKELIHOOD
        for sign in (1, -1)
    )
    return one, zero


def _fit_lattice(points: Array, right: Array) -> tuple[Array, Array]:
    """Return rotation (2, 2) and shift (2,) that move points onto whole positions and symbols.

    ``right`` is the expected image of the x axis.
    """
    expected = math.atan2(right[1], right[0])
    steps = math.ceil(MAX_PLACE_ERROR_RAD / ANGLE_STEP_RAD)
    angles = expected + ANGLE_STEP_RAD * np.arange(-steps, steps + 1)
    rotations = np.array([_rotation(angle) for angle in angles])
    phasor = np.exp(2j * np.pi * (points @ rotations.transpose(0, 2, 1))).mean(axis=1)
    best = int(np.abs(phasor).sum(axis=1).argmax())
    axes = rotations[best]
    shift = -np.angle(phasor[best]) / (2 * np.pi)
    for _ in range(3):
        grid = points @ axes.T + shift
        node = np.rint(grid)
        target = node + nearest_symbol_offset((grid - node).astype(np.float32))
        axes = _fit_rotation(points - points.mean(axis=0), target - target.mean(axis=0))
        shift = target.mean(axis=0) - points.mean(axis=0) @ axes.T
    return axes, shift


def _fit_rotation(points: Array, targets: Array) -> Array:
    """Return the rotation (2, 2) by which ``points @ rotation.T`` is nearest to ``targets``."""
    cross = points.T @ targets
    return _rotation(math.atan2(cross[0, 1] - cross[1, 0], cross[0, 0] + cross[1, 1]))


def _rotation(angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s], [s, c]])
