"""Test sheet of a printer: fields of every dot size at every pitch, on the printer's pixels.

Only its paper shows whether a printer keeps a dot of one or two pixels, smears it or removes it in
the halftone, so this sheet prints them all. Each field is an area of the pattern of its own, far
from those of other sheets, so that its symbols identify it. Markers in the corners allow a photo to
be rectified; their numbers identify the sheet, so that a picture of it needs no other file.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.codec import SECTION_LENGTH, codec, sequences
from locatk.core.dots.drawing.layout import BASE_DPI, DPIS, Raster, SheetLayout, snap
from locatk.core.dots.sheet import MM_PER_INCH
from locatk.core.errors import InputError
from locatk.core.paper_sizes import PAPER_SIZES_MM

SIZES = ("A4", "Letter")
"""Papers that have a test sheet."""

PITCH_UNITS_PER_INCH = 1200
"""Unit of the pitches per inch."""

FIELD_PITCHES_1200TH_INCH = (14, 16, 20, 24, 28, 32)
"""Pitches in 1/1200 in: 0.296, 0.339, 0.423, 0.508, 0.593 and 0.677 mm."""

DOT_WIDTHS_PX = {300: (1, 2, 3), 600: (1, 2, 3, 4, 5), 1200: (1, 2, 3, 4, 5, 6, 8)}
"""Widths of dots in pixels, by dpi."""

MAX_DOT_PITCHES = 0.45
"""Largest width of a dot [pitches]; larger dots hide their displacement."""

FIELD_MM = 20.0
"""Side of a field [mm]."""

FIELD_STEP_POSITIONS = 128
"""Grid positions from the origin of a field to that of the next; no field is as wide."""

FIRST_FIELD_ORIGIN = SECTION_LENGTH // 1_000_000 * 1_000_000
"""Grid coordinate, x and y, of the first field's origin. Other sheets are allocated from 0 on."""

MARKER_MODULE_PX = 24
"""Side of a module of a marker, in pixels of 1/300 in."""

MARKER_SIDE_MODULES = 7
"""Modules of a marker: five of code and its border."""

EDGE_MM, LEFT_MM, TOP_MM = 10.0, 30.0, 32.0
"""Least distance of anything from an edge of the paper, and distances of the fields from its left
and its top. The fields are as far from the bottom as from the top, and from the right edge by the
first distance."""

MARKERS_PER_SHEET = 4
"""Markers of a sheet, one per corner."""


@dataclass(frozen=True)
class PrinterField:
    """Field of a test sheet.

    Attributes
    ----------
    name : str
        Its column as a letter and its row as a number, as printed: ``"B4"``.
    layout : SheetLayout
        Its position, and the size of its dots.
    origin : (x, y)
        Grid coordinates of its upper left dot; section 0,0.
    """

    name: str
    layout: SheetLayout
    origin: tuple[int, int]

    @property
    def dot_mm(self) -> float:
        """Width of a dot."""
        return self.layout.raster.mm(self.layout.raster.dot)

    @property
    def pitch_mm(self) -> float:
        """Distance of two grid positions."""
        return self.layout.raster.mm(self.layout.raster.pitch)


@dataclass(frozen=True)
class CornerMarker:
    """Marker in a corner: a square of black and white modules.

    Attributes
    ----------
    number : int
        In ArUco's dictionary of 100 markers of 5 x 5.
    at : (x, y)
        Its upper left corner, in the printer's pixels from that of the page.
    module : int
        Side of a module in those pixels.
    """

    number: int
    at: tuple[int, int]
    module: int

    @property
    def points(self) -> NDArray[np.float64]:
        """Corners (4, 2) in pixels, clockwise from the upper left one."""
        side = MARKER_SIDE_MODULES * self.module
        return np.array(self.at) + side * np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])

    def modules(self) -> NDArray[np.bool_]:
        """Return which modules (7, 7) are black, from the top down."""
        image = cv2.aruco.generateImageMarker(marker_dictionary(), self.number, MARKER_SIDE_MODULES)
        result: NDArray[np.bool_] = image == 0
        return result


@dataclass(frozen=True)
class PrinterSheet:
    """Test sheet; see :func:`printer_sheet`.

    Attributes
    ----------
    paper : str
    dpi : int
    codec : str
    page : (width, height)
        In the printer's pixels.
    fields : tuple of PrinterField
        Row by row.
    corners : tuple of CornerMarker
        Upper left, upper right, lower right, lower left.
    """

    paper: str
    dpi: int
    codec: str
    page: tuple[int, int]
    fields: tuple[PrinterField, ...]
    corners: tuple[CornerMarker, ...]

    def mm(self, pixels: float) -> float:
        """Return the length in mm of a number of pixels."""
        return pixels * MM_PER_INCH / self.dpi

    def symbols(self, field: PrinterField) -> NDArray[np.uint8]:
        """Return the symbols (rows, columns) of a field."""
        return codec(self.codec).symbols(field.origin, field.layout.size)


def marker_dictionary():  # type: ignore[no-untyped-def]  # OpenCV has no types
    """Return the ArUco dictionary of the markers."""
    return cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)


def printer_sheet(paper: str, dpi: int, codec_name: str = "anoto") -> PrinterSheet:
    """Return the test sheet for a paper, a printer and a codec; it is always the same.

    Raises
    ------
    InputError
        There is no test sheet of that paper, dpi or codec.
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
    module = MARKER_MODULE_PX * step
    edge = pixels(EDGE_MM)
    inner = edge + MARKER_SIDE_MODULES * module
    marker_corners = (
        (edge, edge),
        (width - inner, edge),
        (width - inner, height - inner),
        (edge, height - inner),
    )
    first = MARKERS_PER_SHEET * _variants().index((paper, dpi, codec_name))
    corners = tuple(CornerMarker(first + n, at, module) for n, at in enumerate(marker_corners))
    unit = PITCH_UNITS_PER_INCH
    pitches = [p * dpi // unit for p in FIELD_PITCHES_1200TH_INCH if p * dpi % unit == 0]
    dots = DOT_WIDTHS_PX[dpi]
    left, top = pixels(LEFT_MM), pixels(TOP_MM)
    column_step = (width - edge - left) // len(dots)
    row_step = (height - 2 * top) // len(pitches)
    fields = []
    for row, pitch in enumerate(pitches):
        for column, dot in enumerate(dots):
            if dot > MAX_DOT_PITCHES * pitch:
                continue
            raster = _raster(pitch, dot, dpi)
            corner = (left + column * column_step, top + row * row_step)
            # Snapped like the first position of every sheet, and behind the offset of a dot.
            start = tuple(-(-(c + raster.offset) // step) * step for c in corner)
            count = (pixels(FIELD_MM) - 2 * raster.offset - dot) // pitch + 1
            layout = SheetLayout(raster, page, (start[0], start[1]), (count, count))
            origin = (
                FIRST_FIELD_ORIGIN + column * FIELD_STEP_POSITIONS,
                FIRST_FIELD_ORIGIN + row * FIELD_STEP_POSITIONS,
            )
            fields.append(PrinterField(f"{chr(ord('A') + column)}{row + 1}", layout, origin))
    return PrinterSheet(paper, dpi, codec_name, page, tuple(fields), corners)


def sheet_of_marker(number: int) -> tuple[str, int, str] | None:
    """Return paper, dpi and codec of the test sheet with this marker; None if there is none."""
    variants = _variants()
    is_known = 0 <= number < MARKERS_PER_SHEET * len(variants)
    return variants[number // MARKERS_PER_SHEET] if is_known else None


def _variants() -> list[tuple[str, int, str]]:
    """Return paper, dpi and codec of all test sheets, in the order of their markers."""
    return [
        (paper, dpi, name) for paper in SIZES for dpi in DPIS for name in sequences.FOURTH_DIGITS
    ]


def _raster(pitch: int, dot: int, dpi: int) -> Raster:
    """Return the raster of a pitch and a dot in the printer's pixels."""
    pixel = MM_PER_INCH / dpi
    return snap(pitch * pixel, dot * pixel, dpi)
