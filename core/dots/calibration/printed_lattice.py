"""A field of a printed test sheet, cut out of a picture, and the lattice of its dots."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from locatk.core.dots.codec import DOT_DIRECTIONS
from locatk.core.dots.drawing.test_sheet import Field, PrinterSheet

Floats = NDArray[np.float64]

FINEST, COARSEST = 32.0, 8.0
"""Pixels a pitch in the cut-out, at most and at least."""

RIM = 2.0
"""Pitches around the places that are cut out, too."""

BLUR = 0.08
"""Standard deviation, in pitches, over which ink is averaged at a spot. A dot of a sixth of
the pitch is as large."""

WINDOW = 0.2
"""Reach, in pitches, within which the middle of a dot's ink is taken."""

REACH = 1 / 3
"""Reach within which all of a dot's ink is, and none of another's."""

MOST = 1200
"""Dots that are measured one by one."""


@dataclass(frozen=True)
class Cut:
    """A field cut out upright: place (i, j) ought to be at ``(RIM + (i, j)) * zoom`` px.

    ``native`` is the pitch in px of the picture, ``offset`` that of a dot in pitches.
    """

    pixels: Floats
    zoom: float
    native: float
    size: tuple[int, int]
    page_to_picture: Floats
    first_mm: Floats
    pitch_mm: float
    offset: float

    @classmethod
    def of(
        cls, image: NDArray[np.uint8], to_image: Floats, sheet: PrinterSheet, field: Field
    ) -> Cut:
        """Cut ``field`` out of a picture, to which ``to_image`` maps mm of the page."""
        import cv2

        raster = field.layout.raster
        pitch = field.pitch_mm
        first = sheet.mm(1) * (np.array(field.layout.first) + raster.dot / 2)
        # The printer's pixels have edges, those of a picture centres at whole numbers; the
        # homography of the markers' corners bridges the two.
        middle = first + pitch * (np.array(field.layout.size) - 1) / 2
        square = middle + pitch * np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
        seen = cv2.perspectiveTransform(square[None], to_image)[0].astype(np.float32)
        native = float(np.sqrt(cv2.contourArea(seen)))
        zoom = float(np.clip(round(native), COARSEST, FINEST))
        to_page = np.array(
            [
                [pitch / zoom, 0, first[0] - RIM * pitch],
                [0, pitch / zoom, first[1] - RIM * pitch],
                [0, 0, 1],
            ]
        )
        columns, rows = field.layout.size
        width, height = (int((n - 1 + 2 * RIM) * zoom) + 1 for n in (columns, rows))
        part, corner = _part(image, to_image @ to_page, width, height)
        pixels = cv2.warpPerspective(
            # Light adds up, grey values do not.
            from_srgb(np.arange(256)).astype(np.float32)[part],
            corner @ to_image @ to_page,
            (width, height),
            flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
        offset = raster.offset / raster.pitch
        size = (columns, rows)
        return cls(pixels, zoom, native, size, to_image, first, pitch, offset)

    @property
    def middle(self) -> Floats:
        """Of the field, in pixels of the cut-out."""
        return self.zoom * (RIM + (np.array(self.size) - 1) / 2)

    def to_page(self, at: Floats) -> Floats:
        """A point of the cut-out in mm on the page."""
        return self.first_mm + self.pitch_mm * (at / self.zoom - RIM)

    def to_picture(self, at: Floats) -> Floats:
        """A point of the cut-out in the picture."""
        x, y, w = self.page_to_picture @ np.append(self.to_page(at), 1)
        return np.array([x / w, y / w])

    def ink(self, black: float) -> Floats:
        """Share of ink at each pixel: 0 on bare paper, 1 where black is full."""
        import cv2

        height, width = self.pixels.shape
        # Most of a block of 8 x 8 places is bare.
        down, across = (max(1, round(n / (8 * self.zoom))) for n in (height, width))
        levels = np.array(
            [
                [np.quantile(part, 0.7) for part in np.array_split(strip, across, axis=1)]
                for strip in np.array_split(self.pixels, down, axis=0)
            ]
        )
        paper = cv2.resize(levels, (width, height), interpolation=cv2.INTER_LINEAR)
        result: Floats = (paper - self.pixels) / np.maximum(paper - from_srgb(black), 0.01)
        return result


def _part(
    image: NDArray[np.uint8], to_image: Floats, width: int, height: int
) -> tuple[NDArray[np.uint8], Floats]:
    """The part of the picture that a cut-out needs, and how its pixels are counted."""
    import cv2

    box = np.array([[[0.0, 0], [width, 0], [width, height], [0, height]]])
    seen = cv2.perspectiveTransform(box, to_image)[0]
    limit = np.array(image.shape[::-1]) - 1
    left, top = np.clip(np.floor(seen.min(axis=0)).astype(int) - 4, 0, limit)
    right, bottom = np.clip(np.ceil(seen.max(axis=0)).astype(int) + 4, 0, limit)
    corner = np.array([[1.0, 0, -left], [0, 1, -top], [0, 0, 1]])
    return image[top : bottom + 1, left : right + 1], corner


def from_srgb(values: ArrayLike) -> Floats:
    """Light, 0..1, of grey values: scanners and cameras store them as sRGB has it."""
    v = np.asarray(values, float) / 255
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)


class Lattice:
    """Where the places of a field really lie in its cut-out: an affine map."""

    def __init__(self, cut: Cut, ink: Floats) -> None:
        columns, rows = cut.size
        x, y = np.meshgrid(np.arange(columns), np.arange(rows))
        self._places = np.stack([x, y, np.ones_like(x)], axis=2).reshape(-1, 3).astype(float)
        self._shape = (rows, columns)
        self._spots: Floats = DOT_DIRECTIONS.astype(float) * cut.offset
        self._smooth = _blurred(ink, BLUR * cut.zoom)
        self._map = cut.zoom * np.array([[1.0, 0], [0, 1], [RIM, RIM]])
        self._align(ink)

    def centre(self) -> Floats:
        """Where the middle of the field is, px."""
        result: Floats = self._places.mean(axis=0) @ self._map
        return result

    def move(self, shift: NDArray[np.intp]) -> None:
        """Call the place that is ``shift`` = (columns, rows) further the first."""
        self._map[2] += shift @ self._map[:2]

    def _align(self, ink: Floats) -> None:
        """Shift and stretch the lattice by the phases of the ink in nine parts of the field.

        Dots lie on both sides of their places alike, so the ink's first harmonic at the
        pitch has its crests on the places.
        """
        zoom, (rows, columns) = self._map[0, 0], self._shape
        middles, waves = [], []
        for part_y in np.array_split(np.arange(rows), 3):
            for part_x in np.array_split(np.arange(columns), 3):
                spans, sums = [], []
                for part in (part_x, part_y):
                    low, high = (RIM + part[0] - 0.5) * zoom, (RIM + part[-1] + 0.5) * zoom
                    spans.append(np.arange(round(low), round(high)))
                inside = np.clip(ink[spans[1][0] : spans[1][-1] + 1, spans[0]], 0, None)
                for axis, span in enumerate(spans):
                    wave = np.exp(2j * np.pi * (span / zoom - RIM))
                    sums.append(wave @ inside.sum(axis=axis))
                waves.append(sums)
                middles.append([part_x.mean(), part_y.mean(), 1])
        # Parts differ by little from their sum, whose phase may be anything.
        total = np.sum(waves, axis=0)
        total = np.where(total == 0, 1, total)  # a field without any ink
        phase = (np.angle(total) + np.angle(np.array(waves) / total)) / (2 * np.pi)
        shift, *_ = np.linalg.lstsq(np.array(middles), phase, rcond=None)
        self._map = self._map + shift @ self._map[:2]

    def ink(self) -> tuple[Floats, Floats]:
        """Ink at the four spots of each place, and at the corners between four places.

        Returns
        -------
        spots : (rows, columns, 4) ndarray
            By symbol.
        empty : (rows * columns,) ndarray
            What is where no dot can be.
        """
        at = self._places @ self._map
        spots = _sample(self._smooth, at[:, None] + self._spots @ self._map[:2])
        empty = _sample(self._smooth, at + np.array([0.5, 0.5]) @ self._map[:2])
        return spots.reshape(*self._shape, 4), empty

    def refine(
        self, ink: Floats, symbols: NDArray[np.intp], right: NDArray[np.bool_], bare: float
    ) -> Floats:
        """Fit the lattice to the middles of the right dots.

        Returns
        -------
        (n, 2) ndarray
            How far each of them then lies from its spot, in pitches.
        """
        places, spot = self._some(symbols, right)
        off = np.zeros((len(places), 2))
        around = _around(WINDOW, 11)
        for _ in range(3):
            at = (places @ self._map + (spot + off) @ self._map[:2])[:, None]
            here = np.clip(_sample(ink, at + around @ self._map[:2]) - bare, 1e-9, None)
            off += here @ around / here.sum(axis=1)[:, None]
            # A speck beside a faint dot must not carry it away.
            off = np.clip(off, -WINDOW, WINDOW)
        shift, *_ = np.linalg.lstsq(places, off, rcond=None)
        self._map = self._map + shift @ self._map[:2]
        return off - places @ shift

    def _some(self, symbols: NDArray[np.intp], right: NDArray[np.bool_]) -> tuple[Floats, Floats]:
        """Places and spots of right dots, evenly over the field where there are many."""
        every = np.flatnonzero(right.ravel())
        some = every[:: -(-len(every) // MOST)]
        return self._places[some], self._spots[symbols.ravel()[some]]

    def gain(
        self, ink: Floats, symbols: NDArray[np.intp], right: NDArray[np.bool_], dot: float
    ) -> float:
        """Ink of the right dots over that of a square of ``dot`` pitches; the median."""
        places, spot = self._some(symbols, right)
        at = places @ self._map + spot @ self._map[:2]
        around = _around(REACH, 19)
        amount = _sample(ink, at[:, None] + around @ self._map[:2]).mean(axis=1)
        between = places @ self._map + np.array([0.5, 0.5]) @ self._map[:2]
        bare = float(np.median(_sample(ink, between)))
        return float(np.median(amount - bare)) * (2 * REACH) ** 2 / dot**2


def _around(reach: float, count: int) -> Floats:
    """(count^2, 2) middles of the cells of a grid over a square of twice ``reach``."""
    line = (np.arange(count) - (count - 1) / 2) * (2 * reach / count)
    x, y = np.meshgrid(line, line)
    return np.stack([x, y], axis=2).reshape(-1, 2)


def _blurred(values: Floats, sigma: float) -> Floats:
    import cv2

    result: Floats = cv2.GaussianBlur(values, (0, 0), sigma)
    return result


def _sample(values: Floats, at: Floats) -> Floats:
    """Values (...,) at points (..., 2) px, between pixels linearly."""
    import cv2

    flat = at.reshape(-1, 2).astype(np.float32)
    width = 1024  # of a remapped picture, which may not be higher than 32767
    padded = np.zeros((-(-len(flat) // width) * width, 2), np.float32)
    padded[: len(flat)] = flat
    grid = padded.reshape(-1, width, 2)
    source = values.astype(np.float32)
    taken = cv2.remap(source, grid, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    result: Floats = taken.reshape(-1)[: len(flat)].reshape(at.shape[:-1]).astype(float)
    return result
