"""Frames that show several sheets: which dots belong to which sheet.

Two papers of a floor are never glued with an error below a fraction of a pitch. A frame across
their seam shows two lattices. Here, one sheet is decoded first, if necessary in one half of the
frame. Its dots define a homography. The other dots, rectified by it, form the lattice of the
neighbour: same pitch, unknown rotation and shift. If the position of the neighbour on the floor is
roughly known, its positions within some centimetres are compared with the soft bits of these dots,
for which about 20 dots are enough; otherwise the rest of the frame is decoded like a frame of its
own.

Tiles that overlap have the same dots there. Dots that several sheets have do not tell which of them
is seen; if there are no others, no sheet is reported.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import expit

from locatk.core.dots.camera import Camera
from locatk.core.dots.codec import DOT_DIRECTIONS, Codec
from locatk.core.dots.detection.blobs import detect_dots_halved
from locatk.core.dots.detection.lattice import (
    DotLattices,
    nearest_symbol_offset,
    project_lattices,
)
from locatk.core.dots.identification.decoding import MIN_CONFIDENCE
from locatk.core.dots.identification.soft_bits import soft_bits, window_half_width
from locatk.core.dots.localization.frames import (
    DotCorrespondences,
    dot_correspondences,
    localize_frames,
)
from locatk.core.dots.sheet import DOT_OFFSET_PITCHES, Manifest, Sheet
from locatk.core.geometry import apply_homography, rotation_matrix_2d, umeyama
from locatk.core.robust import robust_sigma

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

MIN_SHEET_DOTS = 20
"""Least number of dots by which a sheet counts as visible. Dots of another sheet agree with a
lattice by chance in 4 % of the cases (the square of twice the gate), seven in a frame of 180."""

MIN_EXCLUSIVE_DOTS = 7
"""Least number of dots of a view that no other sheet has. A dot at random has the right symbol in a
quarter of the cases: odds of 16,000, as :data:`MIN_LOG_ODDS` requires."""

NEIGHBOURS = 8
"""Number of nearest dots that decide to which sheet the surroundings of a dot belong."""

MIN_OWN_NEIGHBOURS = 2
"""Least number of these that agree with the sheet of a dot. Of a dot that agrees by chance it is
less in 96 % of the cases (binomial, 4 % each); at the straight end of a sheet it is half of them.
"""

MATCH_GATE_PITCHES = 0.1
"""Largest distance of a dot from its predicted position on a sheet, per axis."""

CONSENSUS_GATE_PITCHES = 0.04
"""Largest distance of a dot from the homography of its sheet when the sheets are not yet separated.
A lattice that is fitted to two sheets bends over a step of 0.4 pitches between them with residuals
of 0.1; within this gate only the dots of one sheet agree."""

HALF_PLANES = 8
"""Number of directions of the halves of a frame that are decoded."""

MAX_POSITION_ERROR_MM = 20.0
"""Largest error of the relative position of two sheets at their seam."""

MAX_HEADING_ERROR_RAD = math.radians(5)
"""Largest error of their relative heading."""

MAX_SHEETS = 4
"""Maximum number of sheets in a frame: four meet at a corner."""

ANGLE_STEP_RAD = math.radians(0.25)
"""Step of the search for the heading of a lattice; 12 pitches away it moves a dot by 1/19 pitch."""

MIN_LOG_ODDS = math.log(1e4)
"""Least log odds of a position against all other ones nearby, and against random dots."""

DETECTED_PITCH_PX = 11.0
"""Pitch [px] near which a frame is halved before dots are detected, if its own is larger: that of
the camera of Hostettler et al. (188 x 120 px of 0.046 mm)."""

ERASED_RADIUS_PITCHES = 0.3
"""Radius in which a dot is erased; two dots are 2/3 of a pitch apart or more."""

NO_SYMBOL = 4
"""Stands for the symbol of a position without a dot."""

MAX_EXTENT_PITCHES = 400
"""Side of the area about the median dot in which dots are compared with symbols; a frame with so
many dots is larger than any that is decoded. Lenses and tilt may map a speck anywhere."""

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
    misread_pixels : (k, 2) ndarray
        Further dots in the midst of these, whose symbols are not those of the sheet.
    confidence : float
        Lower bound of the probability that the position on the sheet is right.
    """

    number: int
    pixels: Array
    grid: Array
    misread_pixels: Array = field(default_factory=lambda: np.zeros((0, 2)))
    confidence: float = MIN_CONFIDENCE


def separate_sheets(
    image: Image, manifest: Manifest, code: Codec, camera: Camera | None = None
) -> list[SheetView]:
    """Return the dots of each sheet that a frame (h, w) shows, most dots first.

    Empty if no sheet is decoded. A dot that is printed on several sheets (the overlap of tiles) is
    one of each that predicts it; without other dots, it is not known of which one, and there is no
    view.
    """
    first = _first_view(image, manifest, code, camera)
    frame = None if first is None else _rectify(image, first, manifest, code, camera)
    if frame is None:
        return []
    views: list[SheetView] = []
    pose: _SheetPose | None = _SheetPose(frame.reference, np.eye(2), frame.origin, MIN_CONFIDENCE)
    while pose is not None and len(views) < MAX_SHEETS:
        view = frame.claim_dots(pose)
        if len(view.pixels) < MIN_SHEET_DOTS:
            break
        views.append(view)
        visible = {each.number for each in views}
        pose = None
        if frame.is_unassigned.sum() >= MIN_SHEET_DOTS:
            pose = frame.match_neighbour(visible) or frame.decode_rest(image, visible)
    # The first one was the reference of the others, even if it is not known whose dots these are.
    views = _without_ambiguous_views(views, manifest)
    return sorted(views, key=lambda view: -len(view.pixels))


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
    """Return the dots of the sheet to which a lattice belongs; None if it belongs to none.

    Dots that are printed on a single sheet decide, all dots only between equal numbers of these.
    """
    grid = dots.origin + dots.grid
    is_member = manifest.contains(grid, dots.section)
    exclusive = (is_member & (is_member.sum(axis=0) == 1)).sum(axis=1)
    total = is_member.sum(axis=1)
    number = int(np.argmax(exclusive + total / (1 + len(grid))))
    if total[number] < MIN_SHEET_DOTS:
        return None
    is_own = is_member[number]
    return SheetView(number, dots.pixels[is_own], grid[is_own])


def _without_ambiguous_views(views: list[SheetView], manifest: Manifest) -> list[SheetView]:
    """Leave out views whose dots may be those of another sheet.

    A sheet that the frame shows elsewhere is no alternative: a lattice displaced from its own is
    that of another sheet.
    """
    is_member = [manifest.contains(v.grid, manifest.sheets[v.number].section) for v in views]
    certain: set[int] = set()
    for _ in views:
        for view, member in zip(views, is_member, strict=True):
            others = np.delete(member, [*(certain | {view.number})], axis=0)
            if (~others.any(axis=0)).sum() >= MIN_EXCLUSIVE_DOTS:
                certain.add(view.number)
    return [view for view in views if view.number in certain]


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


def _detect(image: Image, pitch_px: float) -> Array:
    """Return the positions (n, 2) in px of all dots of a frame, which is shrunk if large."""
    level = max(0, round(math.log2(pitch_px / DETECTED_PITCH_PX)))
    dots = detect_dots_halved(image[None], level)
    return dots.xy[0, dots.valid[0]].astype(np.float64)


def _pitch_px(grid: Array, pixels: Array) -> float:
    """Return the mean distance of neighbouring grid positions in the frame."""
    offset = grid - grid.mean(axis=0)
    slope = np.linalg.lstsq(offset, pixels - pixels.mean(axis=0))[0]
    return math.sqrt(abs(float(np.linalg.det(slope))))


# ---- its neighbours


@dataclass(frozen=True)
class _SheetPose:
    """Rigid transform from the plane of a frame to the grid of a sheet: ``p @ axes.T + shift``."""

    number: int
    axes: Array
    shift: Array
    confidence: float

    def to_grid(self, plane: Array) -> Array:
        return np.asarray(plane @ self.axes.T + self.shift)


@dataclass
class _RectifiedFrame:
    """All dots of a frame, rectified to the lattice of the sheet that was decoded first.

    Attributes
    ----------
    pixels : (n, 2) ndarray
        With distortion.
    plane : (n, 2) ndarray
        In pitches on the reference sheet from the grid position ``origin``, y down.
    is_unassigned : (n,) bool ndarray
        Dots that belong to no sheet yet.
    pitch_px : float
    reference : int
        Number of the sheet that was decoded first.
    origin : (2,) ndarray
    manifest, code, camera
    """

    pixels: Array
    plane: Array
    is_unassigned: NDArray[np.bool_]
    pitch_px: float
    reference: int
    origin: Array
    manifest: Manifest
    code: Codec
    camera: Camera | None

    def claim_dots(self, pose: _SheetPose) -> SheetView:
        """Return all dots of a sheet and mark them as assigned."""
        dot, is_own = _printed_dots(pose.to_grid(self.plane), pose.number, self.manifest, self.code)
        neighbours = _count_neighbours(self.pixels, is_own)
        is_own &= neighbours >= MIN_OWN_NEIGHBOURS
        is_misread = self.is_unassigned & ~is_own & (neighbours > NEIGHBOURS / 2)
        self.is_unassigned &= ~is_own
        return SheetView(
            pose.number,
            self.pixels[is_own],
            dot[is_own],
            self.pixels[is_misread],
            pose.confidence,
        )

    def match_neighbour(self, visible: set[int]) -> _SheetPose | None:
        """Find the position of the unassigned dots on a sheet whose position is roughly known.

        Their bits are compared with all positions of the other sheets that are within
        :data:`MAX_POSITION_ERROR_MM`. All of these and random dots are the alternatives, also the
        same dots on another sheet that overlaps.
        """
        sheets = self.manifest.sheets
        if sheets[self.reference].position_mm is None:
            return None
        points = self.plane[self.is_unassigned]
        middle = points.mean(axis=0)
        candidates: list[tuple[int, Array, Array]] = []
        scores: list[Array] = []
        for number, sheet in enumerate(sheets):
            if sheet.position_mm is None or number in visible:
                continue
            nominal, right = self._nominal_positions(number, middle + [[0, 0], [1, 0]])
            margin = 2 * MAX_POSITION_ERROR_MM / self.manifest.pitch_mm
            beyond = np.maximum(sheet.origin - nominal, nominal - sheet.origin - sheet.size)
            if (beyond > margin).any():
                continue
            axes, offset = _fit_lattice(points - middle, right - nominal)
            log_odds, low = self._score_shifts(
                number, (points - middle) @ axes.T + offset, np.rint(nominal).astype(np.int64)
            )
            candidates.append((number, axes, offset + low - middle @ axes.T))
            scores.append(log_odds)
        if not candidates:
            return None
        stacked = np.stack(scores)
        best = int(stacked.argmax())
        # A priori, random dots are as likely as all positions together.
        rivals = np.logaddexp(
            np.logaddexp.reduce(np.delete(stacked.ravel(), best)), math.log(stacked.size)
        )
        lead = float(stacked.flat[best] - rivals)
        if lead < MIN_LOG_ODDS:
            return None
        candidate, row, column = np.unravel_index(best, stacked.shape)
        number, axes, shift = candidates[int(candidate)]
        return _SheetPose(number, axes, shift + [column, row], float(expit(lead)))

    def _nominal_positions(self, number: int, plane: Array) -> Array:
        """Return the grid positions on another sheet at points of the plane, by the manifest."""
        return self.manifest.to_grid(
            number, self.manifest.to_metres(self.reference, plane + self.origin)
        )

    def _score_shifts(
        self, number: int, points: Array, nominal: NDArray[np.int64]
    ) -> tuple[Array, NDArray[np.int64]]:
        """Return the log odds (rows, columns) of the shifts of a lattice, and the first shift."""
        lattice = lattice_of(np.eye(3), points, lens=False)
        half = window_half_width(lattice)
        column_bits, row_bits = (bits[0].astype(np.float64) for bits in soft_bits(lattice, half))
        row, column = np.nonzero((column_bits != 0) | (row_bits != 0))
        bits = np.stack([column_bits[row, column], row_bits[row, column]])
        # Relative to bits at random, which are zero and one with equal probability.
        zero, one = math.log(2) - np.logaddexp(0, [bits, -bits])
        gain = np.array([zero[0] + zero[1], one[0] + zero[1], zero[0] + one[1], one[0] + one[1]])
        # A dot beyond the end of the sheet is as unlikely as one of another symbol.
        gain = np.vstack([gain, gain.min(axis=0)])
        radius = math.ceil(MAX_POSITION_ERROR_MM / self.manifest.pitch_mm)
        low = nominal - radius
        symbols = padded_symbols(
            self.code, self.manifest.sheets[number], low - half, 2 * (radius + half)
        )
        count = 2 * radius + 1
        log_odds = np.zeros((count, count))
        for k, (x, y) in enumerate(zip(column, row, strict=True)):
            log_odds += gain[symbols[y : y + count, x : x + count], k]
        return log_odds, low

    def decode_rest(self, image: Image, visible: set[int]) -> _SheetPose | None:
        """Decode the unassigned dots like a frame of their own."""
        erased = _erase(image, self.pixels[~self.is_unassigned], self.pitch_px)
        view = _decode(erased, self.manifest, self.code, self.camera)
        if view is None or view.number in visible:
            return None
        nearest, is_near = _nearest(self.pixels, view.pixels, MATCH_GATE_PITCHES * self.pitch_px)
        if is_near.sum() < MIN_SHEET_DOTS:
            return None
        rigid = umeyama(self.plane[is_near], view.grid[nearest[is_near]], with_scale=False)
        return _SheetPose(view.number, rigid.rotation, rigid.translation, view.confidence)


def lattice_of(homography: Array, points: Array, *, lens: bool) -> DotLattices:
    """Return the lattice that a homography (3, 3) maps points (m, 2) to."""
    parameters = np.append((homography / homography[2, 2]).ravel(), 0.0)[None]
    parameters = parameters[:, [0, 1, 2, 3, 4, 5, 6, 7, 9]]
    empty = np.zeros((1, len(points), 2), np.float32)
    valid = np.ones((1, len(points)), np.bool_)
    unscaled = DotLattices(
        parameters, empty, valid, empty, empty, np.zeros(1), np.ones(1, np.bool_), lens
    )
    lattice = project_lattices(unscaled, parameters, points[None])
    offset = lattice.uv - lattice.nodes
    lattice.sigma[:] = robust_sigma(np.asarray(offset - nearest_symbol_offset(offset), float))
    return lattice


def _count_neighbours(pixels: Array, is_own: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return how many of the :data:`NEIGHBOURS` nearest dots of each dot are own ones."""
    count = min(NEIGHBOURS + 1, len(pixels))
    _, nearest = cKDTree(pixels).query(pixels, count)
    # The nearest dot is the dot itself.
    return np.asarray(is_own[nearest.reshape(len(pixels), -1)[:, 1:]].sum(axis=1), np.int64)


def _nearest(
    points: Array, others: Array, radius: float
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the nearest of other points for each point, and whether it is within a radius."""
    distance, index = cKDTree(others).query(points, distance_upper_bound=radius)
    return np.asarray(index, np.int64), np.isfinite(distance)


def _rectify(
    image: Image, view: SheetView, manifest: Manifest, code: Codec, camera: Camera | None
) -> _RectifiedFrame | None:
    """Detect all dots of a frame and rectify them by the known dots of its first sheet."""
    undistort = (lambda pixels: pixels) if camera is None else camera.undistort
    origin = np.rint(view.grid.mean(axis=0))
    flat, grid = undistort(view.pixels), view.grid - origin
    pitch_px = _pitch_px(grid, flat)
    pixels = _detect(image, pitch_px)
    # Twice: the second time with the dots of the other half, if one half was decoded.
    for _ in range(2):
        to_plane, _ = cv2.findHomography(flat, grid, cv2.RANSAC, CONSENSUS_GATE_PITCHES)
        if to_plane is None:
            return None
        plane = apply_homography(to_plane, undistort(pixels))
        dot, is_own = _printed_dots(plane + origin, view.number, manifest, code)
        if is_own.sum() < MIN_SHEET_DOTS:
            return None
        flat, grid = undistort(pixels[is_own]), dot[is_own] - origin
    is_sound = _near_median(plane)
    pixels, plane = pixels[is_sound], plane[is_sound]
    unassigned = np.ones(len(pixels), np.bool_)
    return _RectifiedFrame(
        *(pixels, plane, unassigned, pitch_px, view.number, origin, manifest, code, camera)
    )


def _near_median(positions: Array) -> NDArray[np.bool_]:
    """Return which positions (n, 2) are finite and within the area that is compared."""
    is_finite = np.asarray(np.isfinite(positions).all(axis=1))
    if not is_finite.any():
        return is_finite
    with np.errstate(invalid="ignore"):
        offset = np.abs(positions - np.median(positions[is_finite], axis=0))
    return np.asarray(is_finite & (offset < MAX_EXTENT_PITCHES / 2).all(axis=1))


def _printed_dots(
    grid: Array, number: int, manifest: Manifest, code: Codec
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the printed dots nearest to grid positions (n, 2), and which of them are within the
    gate.

    Positions far from the others are not compared.
    """
    is_own = _near_median(grid)
    dot = np.zeros_like(grid)
    if not is_own.any():
        return dot, is_own
    node = np.rint(grid[is_own]).astype(np.int64)
    low = node.min(axis=0)
    side = int((node.max(axis=0) - low).max()) + 1
    symbols = padded_symbols(code, manifest.sheets[number], low, side)
    column, row = (node - low).T
    symbol = symbols[row, column]
    printed = node + DOT_DIRECTIONS[symbol % NO_SYMBOL] * DOT_OFFSET_PITCHES
    is_near = (np.abs(grid[is_own] - printed) < MATCH_GATE_PITCHES).all(axis=1)
    dot[is_own] = printed
    is_own[is_own] = is_near & (symbol < NO_SYMBOL)
    return dot, is_own


def padded_symbols(
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


def _fit_lattice(points: Array, right: Array) -> tuple[Array, Array]:
    """Return rotation (2, 2) and shift (2,) that move points onto whole positions and symbols.

    ``right`` is the expected image of the x axis.
    """
    expected = math.atan2(right[1], right[0])
    steps = math.ceil(MAX_HEADING_ERROR_RAD / ANGLE_STEP_RAD)
    angles = expected + ANGLE_STEP_RAD * np.arange(-steps, steps + 1)
    rotations = np.array([rotation_matrix_2d(angle) for angle in angles])
    phasor = np.exp(2j * np.pi * (points @ rotations.transpose(0, 2, 1))).mean(axis=1)
    best = int(np.abs(phasor).sum(axis=1).argmax())
    axes = rotations[best]
    shift = -np.angle(phasor[best]) / (2 * np.pi)
    for _ in range(3):
        grid = points @ axes.T + shift
        node = np.rint(grid)
        target = node + nearest_symbol_offset((grid - node).astype(np.float32))
        rigid = umeyama(points, target, with_scale=False)
        axes, shift = rigid.rotation, rigid.translation
    return axes, shift
