"""Quality of one field of a printed test sheet: its dots, compared with those that it should have.

A field is rectified into an image of its own (:class:`FieldImage`), and an affine lattice is fitted
to its dots (:class:`FieldLattice`). The symbols are known, so that no decoder is necessary: the dot
of a position is at the spot, of four, with most ink.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from locatk.core.dots.codec import DOT_DIRECTIONS
from locatk.core.dots.drawing.test_sheet import PrinterField, PrinterSheet
from locatk.core.robust import SIGMA_PER_MEDIAN_ABSOLUTE

Array = NDArray[np.float64]

MIN_SCAN_PITCH_PX = 4.8
"""Pitch in the picture [px] below which it does not resolve the dots."""

MAX_SHIFT_POSITIONS = 6
"""Largest error of the markers, in grid positions."""

MIN_AGREEING_FRACTION = 0.6
"""Fraction of right symbols from which a field is identified; by chance a quarter agree."""

MIN_AGREEING_DOTS = 40
"""Number of right symbols from which a field is identified."""

MIN_RELATIVE_INK = 0.3
"""Least ink of a dot, relative to that of a usual dot of its field."""

MIN_INK_SIGMAS = 5.0
"""Least ink of a dot in standard deviations of the bare paper."""

MIN_INK = 0.01
"""Least ink of a dot [parts of full black]."""

USUAL_INK_QUANTILE = 0.9
"""Quantile of the ink at all positions that is that of a usual dot."""

MARGIN_QUANTILE = 0.01
"""Quantile of the positions at which the margin of a field is taken."""

MIN_IMAGE_PITCH_PX, MAX_IMAGE_PITCH_PX = 8.0, 32.0
"""Range of the pitch in the rectified image of a field [px]."""

BORDER_PITCHES = 2.0
"""Width of the border around the positions in the rectified image [pitches]."""

INK_SIGMA_PITCHES = 0.08
"""Standard deviation of the average of ink at a spot [pitches]; a dot of a sixth of the pitch is
about as large."""

CENTROID_RADIUS_PITCHES = 0.2
"""Half side of the square in which the centroid of a dot's ink is computed [pitches]."""

DOT_RADIUS_PITCHES = 1 / 3
"""Half side of the square that contains all ink of a dot and none of another [pitches]."""

MAX_MEASURED_DOTS = 1200
"""Maximum number of dots that are measured individually."""

PAPER_BLOCK_POSITIONS = 8
"""Side of the blocks in which the brightness of the bare paper is estimated [positions]."""

PAPER_QUANTILE = 0.7
"""Quantile of the brightness of a block that is bare paper: most of a block is bare."""

MIN_BLACK_CONTRAST = 0.01
"""Least difference of light from paper to black, so that ink stays finite on dark paper."""

REMAP_WIDTH_PX = 1024
"""Width of the images passed to OpenCV's remap, whose height is limited to 32767."""


@dataclass(frozen=True)
class FieldScore:
    """Print quality of a field.

    Attributes
    ----------
    name : str
    dot_px, pitch_px : int
        In pixels of the printer.
    dot_mm, pitch_mm : float
    dots : int
        Nominal number of dots.
    scan_px : float
        Pitch in pixels of the picture.
    judged : bool
        Whether the picture resolves the dots.
    read : bool
        Whether the field was identified by its symbols.
    found : float
        Fraction of the positions that have a dot.
    right : float
        Fraction of the positions whose dot has the right symbol.
    wrong_bits : int
        Wrong bits of the dots, two bits per dot.
    margin : float
        Ink at the right spot minus the most ink at the other three, in parts of full black; at the
        worst hundredth of the positions.
    scatter : float
        Rms distance of the dots from their nominal spots, per axis, in pitches; nan if the field
        was not identified.
    gain : float
        Ink of a dot over that of its nominal area; nan if the field was not identified.
    centre_mm, centre_px : (x, y)
        Middle of the field, in mm from the page's upper left corner, and in the picture as its dots
        indicate.
    """

    name: str
    dot_px: int
    pitch_px: int
    dot_mm: float
    pitch_mm: float
    dots: int
    scan_px: float
    judged: bool
    read: bool
    found: float
    right: float
    wrong_bits: int
    margin: float
    scatter: float
    gain: float
    centre_mm: tuple[float, float]
    centre_px: tuple[float, float]


def score_field(
    image: NDArray[np.uint8],
    to_image: Array,
    sheet: PrinterSheet,
    field: PrinterField,
    black: float,
) -> FieldScore:
    """Measure the print quality of one field.

    Parameters
    ----------
    image : (height, width) uint8 ndarray
    to_image : (3, 3) ndarray
        From mm on the page (from its upper left corner to the right and down) to px.
    sheet : PrinterSheet
    field : PrinterField
    black : float
        Grey value of full black in the image.
    """
    field_image = FieldImage.rectify(image, to_image, sheet, field)
    expected = sheet.symbols(field)
    if field_image.scan_pitch_px < MIN_SCAN_PITCH_PX:
        return _score(field, field_image, judged=False)
    ink = field_image.ink(black)
    lattice = FieldLattice(field_image, ink)
    spots, empty = lattice.ink_at_spots()
    present = _has_dot(spots, empty)
    shift = _find_shift(spots.argmax(axis=2), present, expected)
    if shift is None:
        return _score(field, field_image, found=float(present.mean()))
    lattice.move(shift)
    # Twice, because the first lattice follows from the mean of the dots only.
    for _ in range(2):
        spots, empty = lattice.ink_at_spots()
        present = _has_dot(spots, empty)
        symbols = spots.argmax(axis=2)
        right = present & (symbols == expected)
        if right.sum() < MIN_AGREEING_DOTS:
            return _score(field, field_image, found=float(present.mean()))
        residual = lattice.refine(ink, symbols, right, float(np.median(empty)))
    expected_spot = expected[..., None].astype(int)
    ink_of_expected = np.take_along_axis(spots, expected_spot, axis=2)[..., 0]
    others = spots.copy()
    np.put_along_axis(others, expected_spot, -np.inf, axis=2)
    margin = ink_of_expected - others.max(axis=2)
    wrong_bits = np.bitwise_count((symbols.astype(np.uint8) ^ expected)[present]).sum()
    return _score(
        field,
        field_image,
        read=float(right.sum()) >= MIN_AGREEING_FRACTION * max(1, int(present.sum())),
        found=float(present.mean()),
        right=float(right.mean()),
        wrong_bits=int(wrong_bits),
        margin=float(np.quantile(margin, MARGIN_QUANTILE)),
        scatter=float(np.sqrt((residual**2).mean())),
        gain=lattice.dot_gain(ink, symbols, right, field.dot_mm / field.pitch_mm),
        centre=lattice.centre(),
    )


def _score(
    field: PrinterField,
    field_image: FieldImage,
    *,
    judged: bool = True,
    read: bool = False,
    found: float = 0.0,
    right: float = 0.0,
    wrong_bits: int = 0,
    margin: float = 0.0,
    scatter: float = float("nan"),
    gain: float = float("nan"),
    centre: Array | None = None,
) -> FieldScore:
    """Return a score; ``centre`` is in the rectified image."""
    raster, (columns, rows) = field.layout.raster, field.layout.size
    centre_px = field_image.to_picture(field_image.middle if centre is None else centre)
    centre_mm = field_image.to_page(field_image.middle)
    return FieldScore(
        name=field.name,
        dot_px=raster.dot,
        pitch_px=raster.pitch,
        dot_mm=field.dot_mm,
        pitch_mm=field.pitch_mm,
        dots=columns * rows,
        scan_px=field_image.scan_pitch_px,
        judged=judged,
        read=read,
        found=found,
        right=right,
        wrong_bits=wrong_bits,
        margin=margin,
        scatter=scatter,
        gain=gain,
        centre_mm=(float(centre_mm[0]), float(centre_mm[1])),
        centre_px=(float(centre_px[0]), float(centre_px[1])),
    )


def _has_dot(spots: Array, empty: Array) -> NDArray[np.bool_]:
    """Return which positions (rows, columns) have a dot, darker than bare paper ever is."""
    bare = float(np.median(empty))
    noise = SIGMA_PER_MEDIAN_ABSOLUTE * float(np.median(np.abs(empty - bare)))
    ink = spots.max(axis=2) - bare
    usual = float(np.quantile(ink, USUAL_INK_QUANTILE))
    return ink > max(MIN_INK_SIGMAS * noise, MIN_RELATIVE_INK * usual, MIN_INK)


def _find_shift(
    symbols: NDArray[np.intp], present: NDArray[np.bool_], expected: NDArray[np.uint8]
) -> NDArray[np.intp] | None:
    """Return the shift (columns, rows) of the true first position; None for another area."""
    rows, columns = expected.shape
    most_agreeing, best_shift = 0, None
    for down in range(-MAX_SHIFT_POSITIONS, MAX_SHIFT_POSITIONS + 1):
        for right in range(-MAX_SHIFT_POSITIONS, MAX_SHIFT_POSITIONS + 1):
            observed_part = _overlap(down, rows), _overlap(right, columns)
            expected_part = _overlap(-down, rows), _overlap(-right, columns)
            exists = present[observed_part]
            agrees = symbols[observed_part] == expected[expected_part]
            agreeing = int((exists & agrees).sum())
            required = max(MIN_AGREEING_DOTS, MIN_AGREEING_FRACTION * int(exists.sum()))
            if agreeing > most_agreeing and agreeing >= required:
                most_agreeing, best_shift = agreeing, np.array([right, down], np.intp)
    return best_shift


def _overlap(shift: int, count: int) -> slice:
    """Return the part of ``count`` positions that remains inside after a shift."""
    return slice(max(0, shift), count + min(0, shift))


# ---- rectified image


@dataclass(frozen=True)
class FieldImage:
    """Rectified image of a field: position (i, j) is nominally at ``(border + (i, j)) * pitch`` px.

    Attributes
    ----------
    light : (height, width) ndarray
        Linear light, 0..1.
    pitch_px : float
        Pitch in this image.
    scan_pitch_px : float
        Pitch in the picture from which it was cut.
    size : (columns, rows)
        Of positions.
    page_to_picture : (3, 3) ndarray
        From mm on the page to px of the picture.
    first_mm : (2,) ndarray
        First position on the page.
    pitch_mm : float
    offset : float
        Nominal offset of a dot in pitches.
    """

    light: Array
    pitch_px: float
    scan_pitch_px: float
    size: tuple[int, int]
    page_to_picture: Array
    first_mm: Array
    pitch_mm: float
    offset: float

    @classmethod
    def rectify(
        cls,
        image: NDArray[np.uint8],
        to_image: Array,
        sheet: PrinterSheet,
        field: PrinterField,
    ) -> FieldImage:
        """Cut ``field`` out of a picture, to which ``to_image`` maps mm of the page."""
        raster = field.layout.raster
        pitch = field.pitch_mm
        first = sheet.mm(1) * (np.array(field.layout.first) + raster.dot / 2)
        # The printer's pixels are counted by their edges and those of a picture by their centres;
        # the homography of the markers' corners includes the difference.
        middle = first + pitch * (np.array(field.layout.size) - 1) / 2
        cell = middle + pitch * np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
        cell_px = cv2.perspectiveTransform(cell[None], to_image)[0].astype(np.float32)
        scan_pitch = float(np.sqrt(cv2.contourArea(cell_px)))
        pitch_px = float(np.clip(round(scan_pitch), MIN_IMAGE_PITCH_PX, MAX_IMAGE_PITCH_PX))
        to_page = np.array(
            [
                [pitch / pitch_px, 0, first[0] - BORDER_PITCHES * pitch],
                [0, pitch / pitch_px, first[1] - BORDER_PITCHES * pitch],
                [0, 0, 1],
            ]
        )
        columns, rows = field.layout.size
        width, height = (
            int((count - 1 + 2 * BORDER_PITCHES) * pitch_px) + 1 for count in (columns, rows)
        )
        part, to_part = _crop(image, to_image @ to_page, width, height)
        light = cv2.warpPerspective(
            # Interpolation averages light, which grey values are not proportional to.
            light_of_grey(np.arange(256)).astype(np.float32)[part],
            to_part @ to_image @ to_page,
            (width, height),
            flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
        offset = raster.offset / raster.pitch
        size = (columns, rows)
        return cls(light, pitch_px, scan_pitch, size, to_image, first, pitch, offset)

    @property
    def middle(self) -> Array:
        """Middle of the field (2,) in px."""
        return self.pitch_px * (BORDER_PITCHES + (np.array(self.size) - 1) / 2)

    def to_page(self, point: Array) -> Array:
        """Return a point (2,) of this image in mm on the page."""
        return self.first_mm + self.pitch_mm * (point / self.pitch_px - BORDER_PITCHES)

    def to_picture(self, point: Array) -> Array:
        """Return a point (2,) of this image in px of the picture."""
        x, y, w = self.page_to_picture @ np.append(self.to_page(point), 1)
        return np.array([x / w, y / w])

    def ink(self, black: float) -> Array:
        """Return the ink at each pixel: 0 on bare paper, 1 at the grey value ``black``."""
        height, width = self.light.shape
        down, across = (
            max(1, round(n / (PAPER_BLOCK_POSITIONS * self.pitch_px))) for n in (height, width)
        )
        levels = np.array(
            [
                [
                    np.quantile(block, PAPER_QUANTILE)
                    for block in np.array_split(strip, across, axis=1)
                ]
                for strip in np.array_split(self.light, down, axis=0)
            ]
        )
        paper = cv2.resize(levels, (width, height), interpolation=cv2.INTER_LINEAR)
        contrast = np.maximum(paper - light_of_grey(black), MIN_BLACK_CONTRAST)
        result: Array = (paper - self.light) / contrast
        return result


def _crop(
    image: NDArray[np.uint8], to_image: Array, width: int, height: int
) -> tuple[NDArray[np.uint8], Array]:
    """Return the part of a picture that a rectified image needs, and the map to its pixels."""
    box = np.array([[[0.0, 0], [width, 0], [width, height], [0, height]]])
    corners = cv2.perspectiveTransform(box, to_image)[0]
    limit = np.array(image.shape[::-1]) - 1
    left, top = np.clip(np.floor(corners.min(axis=0)).astype(int) - 4, 0, limit)
    right, bottom = np.clip(np.ceil(corners.max(axis=0)).astype(int) + 4, 0, limit)
    to_part = np.array([[1.0, 0, -left], [0, 1, -top], [0, 0, 1]])
    return image[top : bottom + 1, left : right + 1], to_part


def light_of_grey(values: ArrayLike) -> Array:
    """Return the linear light 0..1 of grey values, which scanners and cameras encode as sRGB.

    IEC 61966-2-1.
    """
    v = np.asarray(values, float) / 255
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)


# ---- lattice


class FieldLattice:
    """Affine map from the grid positions of a field to its rectified image."""

    def __init__(self, field_image: FieldImage, ink: Array) -> None:
        columns, rows = field_image.size
        x, y = np.meshgrid(np.arange(columns), np.arange(rows))
        self._positions = np.stack([x, y, np.ones_like(x)], axis=2).reshape(-1, 3).astype(float)
        self._shape = (rows, columns)
        self._spots: Array = DOT_DIRECTIONS.astype(float) * field_image.offset
        self._smooth = cv2.GaussianBlur(ink, (0, 0), INK_SIGMA_PITCHES * field_image.pitch_px)
        self._map = field_image.pitch_px * np.array(
            [[1.0, 0], [0, 1], [BORDER_PITCHES, BORDER_PITCHES]]
        )
        self._align(ink)

    def centre(self) -> Array:
        """Return the middle of the field (2,) in px."""
        result: Array = self._positions.mean(axis=0) @ self._map
        return result

    def move(self, shift: NDArray[np.intp]) -> None:
        """Make the position ``shift`` = (columns, rows) the first."""
        self._map[2] += shift @ self._map[:2]

    def _align(self, ink: Array) -> None:
        """Shift and stretch the lattice by the phases of the ink in nine parts of the field.

        The dots are displaced equally often to both sides of their positions, so that the first
        harmonic of the ink at the pitch has its maxima at the positions.
        """
        pitch_px, (rows, columns) = self._map[0, 0], self._shape
        middles, phasors = [], []
        for part_y in np.array_split(np.arange(rows), 3):
            for part_x in np.array_split(np.arange(columns), 3):
                spans, sums = [], []
                for part in (part_x, part_y):
                    low = (BORDER_PITCHES + part[0] - 0.5) * pitch_px
                    high = (BORDER_PITCHES + part[-1] + 0.5) * pitch_px
                    spans.append(np.arange(round(low), round(high)))
                inside = np.clip(ink[spans[1][0] : spans[1][-1] + 1, spans[0]], 0, None)
                for axis, span in enumerate(spans):
                    wave = np.exp(2j * np.pi * (span / pitch_px - BORDER_PITCHES))
                    sums.append(wave @ inside.sum(axis=axis))
                phasors.append(sums)
                middles.append([part_x.mean(), part_y.mean(), 1])
        # The phases of the parts differ little from that of their sum, which may have any value.
        total = np.sum(phasors, axis=0)
        total = np.where(total == 0, 1, total)  # A field without any ink.
        phase = (np.angle(total) + np.angle(np.array(phasors) / total)) / (2 * np.pi)
        shift, *_ = np.linalg.lstsq(np.array(middles), phase, rcond=None)
        self._map = self._map + shift @ self._map[:2]

    def ink_at_spots(self) -> tuple[Array, Array]:
        """Return the ink at the four spots of each position, and between the positions.

        Returns
        -------
        spots : (rows, columns, 4) ndarray
            By symbol.
        empty : (rows * columns,) ndarray
            At the corners of the cells, where no dot can be.
        """
        points = self._positions @ self._map
        spots = _sample(self._smooth, points[:, None] + self._spots @ self._map[:2])
        empty = _sample(self._smooth, points + np.array([0.5, 0.5]) @ self._map[:2])
        return spots.reshape(*self._shape, 4), empty

    def refine(
        self, ink: Array, symbols: NDArray[np.intp], right: NDArray[np.bool_], bare: float
    ) -> Array:
        """Fit the lattice to the right dots; return their residuals (n, 2) in pitches."""
        positions, spots = self._select_dots(symbols, right)
        offset = np.zeros((len(positions), 2))
        window = _square_grid(CENTROID_RADIUS_PITCHES, 11)
        for _ in range(3):
            centre = (positions @ self._map + (spots + offset) @ self._map[:2])[:, None]
            weight = np.clip(_sample(ink, centre + window @ self._map[:2]) - bare, 1e-9, None)
            offset += weight @ window / weight.sum(axis=1)[:, None]
            # A speck next to a faint dot must not attract it.
            offset = np.clip(offset, -CENTROID_RADIUS_PITCHES, CENTROID_RADIUS_PITCHES)
        shift, *_ = np.linalg.lstsq(positions, offset, rcond=None)
        self._map = self._map + shift @ self._map[:2]
        return offset - positions @ shift

    def dot_gain(
        self, ink: Array, symbols: NDArray[np.intp], right: NDArray[np.bool_], dot_pitches: float
    ) -> float:
        """Return the median ink of the right dots over that of a square of ``dot_pitches``."""
        positions, spots = self._select_dots(symbols, right)
        centre = positions @ self._map + spots @ self._map[:2]
        window = _square_grid(DOT_RADIUS_PITCHES, 19)
        amount = _sample(ink, centre[:, None] + window @ self._map[:2]).mean(axis=1)
        between = positions @ self._map + np.array([0.5, 0.5]) @ self._map[:2]
        bare = float(np.median(_sample(ink, between)))
        return float(np.median(amount - bare)) * (2 * DOT_RADIUS_PITCHES) ** 2 / dot_pitches**2

    def _select_dots(
        self, symbols: NDArray[np.intp], right: NDArray[np.bool_]
    ) -> tuple[Array, Array]:
        """Return positions and spots of right dots; of too many, some evenly over the field."""
        indices = np.flatnonzero(right.ravel())
        selected = indices[:: -(-len(indices) // MAX_MEASURED_DOTS)]
        return self._positions[selected], self._spots[symbols.ravel()[selected]]


def _square_grid(radius: float, count: int) -> Array:
    """Return the centres (count^2, 2) of the cells of a square of half side ``radius``."""
    line = (np.arange(count) - (count - 1) / 2) * (2 * radius / count)
    x, y = np.meshgrid(line, line)
    return np.stack([x, y], axis=2).reshape(-1, 2)


def _sample(values: Array, points: Array) -> Array:
    """Return values (...) of an image at points (..., 2) in px, by linear interpolation."""
    flat = points.reshape(-1, 2).astype(np.float32)
    width = REMAP_WIDTH_PX
    padded = np.zeros((-(-len(flat) // width) * width, 2), np.float32)
    padded[: len(flat)] = flat
    sampled = cv2.remap(
        values.astype(np.float32),
        padded.reshape(-1, width, 2),
        None,
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    result: Array = sampled.reshape(-1)[: len(flat)].reshape(points.shape[:-1]).astype(float)
    return result
