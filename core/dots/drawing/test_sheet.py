"""The printer's test sheet: fields of every dot size at every pitch, on the printer's pixels.

Whether a printer keeps a dot of one or two pixels, smears it or halftones it away is known
only from its paper (facts/dots.md 4), so this sheet prints them all. Each field is an area
of the pattern of its own, far from those that sheets are given: what is read there proves
which field it is. Markers in the corners let a photo be rectified; their numbers say which
sheet it is, so that a picture of it needs no other file.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.codec import SECTION_LENGTH, codec, sequences
from locatk.core.dots.drawing.layout import BASE_DPI, DPIS, Layout, Raster, snap
from locatk.core.dots.sheet import MM_PER_INCH
from locatk.core.errors import InputError
from locatk.core.paper import PAPER_SIZES_MM

SIZES = ("A4", "Letter")
"""Papers for which there is a test sheet."""

PITCHES = (14, 16, 20, 24, 28, 32)
"""Pitches in 1/1200 in: 0.296, 0.339, 0.423, 0.508, 0.593 and 0.677 mm."""

DOTS = {300: (1, 2, 3), 600: (1, 2, 3, 4, 5), 1200: (1, 2, 3, 4, 5, 6, 8)}
"""Widths of dots in pixels, by dpi."""

LARGEST_DOT = 0.45
"""In pitches; larger dots hide their place."""

FIELD_MM = 20.0
"""Side of a field."""

STEP = 128
"""Places from a field's origin to the next; no field is as wide."""

ORIGIN = SECTION_LENGTH // 1_000_000 * 1_000_000
"""Origin of the first field, in x and y. Sheets are given areas from 0 on."""

MARKER_MODULE = 24
"""Pixels of 1/300 in a module of a marker."""

MARKER_SIDE = 7
"""Modules of a marker: five of code and its border."""

EDGE_MM, LEFT_MM, TOP_MM = 10.0, 30.0, 32.0
"""Nothing lies nearer than the first to an edge; the fields lie right and below of the
others, and as far from the opposite edges (the right one: as far as the first)."""

CORNERS = 4


@dataclass(frozen=True)
class Field:
    """One field of a test sheet.

    Attributes
    ----------
    name : str
        Its column as a letter and its row as a number, as printed: ``"B4"``.
    layout : Layout
        Where it lies, and the size of its dots.
    origin : (x, y)
        Grid coordinates of its upper left dot; section 0,0.
    """

    name: str
    layout: Layout
    origin: tuple[int, int]

    @property
    def dot_mm(self) -> float:
        return self.layout.raster.mm(self.layout.raster.dot)

    @property
    def pitch_mm(self) -> float:
        return self.layout.raster.mm(self.layout.raster.pitch)


@dataclass(frozen=True)
class Corner:
    """A marker: a square of black and white modules.

    Attributes
    ----------
    number : int
        Of ArUco's dictionary of 100 markers of 5 x 5.
    at : (x, y)
        Of its upper left corner, in the printer's pixels from the page's upper left one.
    module : int
        Side of a module in those pixels.
    """

    number: int
    at: tuple[int, int]
    module: int

    @property
    def points(self) -> NDArray[np.float64]:
        """(4, 2) corners in pixels, clockwise from the upper left one."""
        side = MARKER_SIDE * self.module
        return np.array(self.at) + side * np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])

    def modules(self) -> NDArray[np.bool_]:
        """(7, 7) which modules are black, from the top down."""
        import cv2

        picture = cv2.aruco.generateImageMarker(dictionary(), self.number, MARKER_SIDE)
        result: NDArray[np.bool_] = picture == 0
        return result


@dataclass(frozen=True)
class PrinterSheet:
    """A test sheet; see :func:`printer_sheet`.

    Attributes
    ----------
    paper : str
    dpi : int
    codec : str
    page : (width, height)
        In the printer's pixels.
    fields : tuple of Field
        Row by row.
    corners : tuple of Corner
        Upper left, upper right, lower right, lower left.
    """

    paper: str
    dpi: int
    codec: str
    page: tuple[int, int]
    fields: tuple[Field, ...]
    corners: tuple[Corner, ...]

    def mm(self, pixels: float) -> float:
        """Length in mm of so many pixels."""
        return pixels * MM_PER_INCH / self.dpi

    def symbols(self, field: Field) -> NDArray[np.uint8]:
        """(rows, columns) symbols of a field."""
        return codec(self.codec).symbols(field.origin, field.layout.size)


def dictionary():  # type: ignore[no-untyped-def]  # OpenCV has no types
    """The markers' dictionary."""
    import cv2

    return cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)


def printer_sheet(paper: str, dpi: int, codec_name: str = "anoto") -> PrinterSheet:
    """The test sheet for a paper, a printer and a codec; always the same.

    Raises
    ------
    InputError
        There is none of that paper, dpi or codec.
    """
    if paper not in SIZES:
        raise InputError(f"no test sheet of {paper!r}", hint=f"Use {' or '.join(SIZES)}")
    if dpi not in DPIS:
        raise InputError(f"{dpi} dpi", hint=f"Use one of {', '.join(map(str, DPIS))}")
    codec(codec_name)
    step = dpi // BASE_DPI

    def pixels(length_mm: float) -> int:
        return round(length_mm * BASE_DPI / MM_PER_INCH) * step

    width, height = (pixels(side) for side in PAPER_SIZES_MM[paper])
    page = (width, height)
    module = MARKER_MODULE * step
    edge, far = pixels(EDGE_MM), pixels(EDGE_MM) + MARKER_SIDE * module
    places = (
        (edge, edge),
        (width - far, edge),
        (width - far, height - far),
        (edge, height - far),
    )
    first = CORNERS * _variants().index((paper, dpi, codec_name))
    corners = tuple(Corner(first + n, at, module) for n, at in enumerate(places))
    pitches = [p * dpi // 1200 for p in PITCHES if p * dpi % 1200 == 0]
    dots = DOTS[dpi]
    left, top = pixels(LEFT_MM), pixels(TOP_MM)
    across = (width - edge - left) // len(dots)
    down = (height - 2 * top) // len(pitches)
    fields = []
    for row, pitch in enumerate(pitches):
        for column, dot in enumerate(dots):
            if dot > LARGEST_DOT * pitch:
                continue
            raster = _raster(pitch, dot, dpi)
            corner = (left + column * across, top + row * down)
            # Snapped like every sheet's first place, with the offset left free before it.
            start = tuple(-(-(c + raster.offset) // step) * step for c in corner)
            count = (pixels(FIELD_MM) - 2 * raster.offset - dot) // pitch + 1
            layout = Layout(raster, page, (start[0], start[1]), (count, count))
            origin = (ORIGIN + column * STEP, ORIGIN + row * STEP)
            fields.append(Field(f"{chr(ord('A') + column)}{row + 1}", layout, origin))
    return PrinterSheet(paper, dpi, codec_name, page, tuple(fields), corners)


def sheet_of_marker(number: int) -> tuple[str, int, str] | None:
    """Paper, dpi and codec of the test sheet that has this marker; None where none has."""
    variants = _variants()
    return variants[number // CORNERS] if 0 <= number < CORNERS * len(variants) else None


def _variants() -> list[tuple[str, int, str]]:
    return [(paper, dpi, name) for paper in SIZES for dpi in DPIS for name in sequences.FOURTH]


def _raster(pitch: int, dot: int, dpi: int) -> Raster:
    pixel = MM_PER_INCH / dpi
    return snap(pitch * pixel, dot * pixel, dpi)
