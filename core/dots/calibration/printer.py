"""Calibration of a printer from a scan or a photo of its test sheet.

The sheet (:mod:`~locatk.core.dots.drawing.test_sheet`) is detected by its corner markers, the print
quality of each of its fields is measured (:mod:`~.printed_fields`), and the printer's scale follows
from the positions of markers and fields.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.calibration.printed_fields import FieldScore, score_field
from locatk.core.dots.drawing.test_sheet import (
    MARKER_SIDE_MODULES,
    MARKERS_PER_SHEET,
    PrinterSheet,
    marker_dictionary,
    printer_sheet,
    sheet_of_marker,
)
from locatk.core.dots.sheet import MM_PER_INCH, Manifest
from locatk.core.errors import DegenerateError, InputError

Array = NDArray[np.float64]

MAX_SEARCH_SIDE_PX = 2400
"""Longer side of the picture in which markers are searched [px]; larger ones are reduced."""

MIN_MARKERS = 3
"""Least number of corner markers that must be visible."""

MAX_SCANNED_BEND_MM = 0.5
"""Largest rms deformation of a sheet on a scanner [mm]; a picture with more is no scan."""

MAX_SCALE_ERROR = 0.03
"""Largest plausible difference of a printer's scale from 1; with more, the stated dpi is wrong."""

MIN_RIGHT_FRACTION = 0.9
"""Least fraction of right symbols of a recommended field."""

EQUAL_RIGHT_FRACTION = 0.002
"""Fractions of right symbols that differ by less are equal: a speck of dust in a field."""

SUFFICIENT_MARGIN_RATIO = 0.7
"""Fraction of the largest margin from which the usual pitch is preferred to more margin."""

USUAL_PITCH_MM = Manifest.pitch_mm
"""Pitch for which the paper's camera and the defaults of locatk are designed [mm]."""

MAX_PITCH_ERROR_MM = 0.01
"""Largest difference of a requested pitch from that of a field [mm]."""


@dataclass(frozen=True)
class PrinterReport:
    """Calibration of a printer by its test sheet.

    Attributes
    ----------
    sheet : PrinterSheet
    fields : tuple of FieldScore
        In the order of the sheet's fields.
    recommended : FieldScore or None
        See :func:`recommend`.
    scale : (x, y) or None
        Printed over nominal length along the paper's width and height; None if the picture's
        resolution is unknown.
    bend_mm : float
        Rms distance of markers and fields from an affine sheet: uneven feed of the printer (or of
        the scanner), or a paper that is not flat.
    doubt : str or None
        Reason why :attr:`scale` is wrong: the picture is a photo, or its resolution is not the
        stated one.
    """

    sheet: PrinterSheet
    fields: tuple[FieldScore, ...]
    recommended: FieldScore | None
    scale: tuple[float, float] | None
    bend_mm: float
    doubt: str | None


def calibrate(
    image: NDArray[np.uint8],
    scan_dpi: tuple[float, float] | None = None,
    *,
    pitch_mm: float | None = None,
) -> PrinterReport:
    """Measure the print quality of each field of a test sheet, and the printer's scale.

    Parameters
    ----------
    image : (height, width) uint8 ndarray
        Grey values, with the sheet in any direction and perspective.
    scan_dpi : (x, y), optional
        Pixels per inch, if the image is a scan.
    pitch_mm : float, optional
        Recommend a field of this pitch only.

    Raises
    ------
    DegenerateError
        There is no test sheet, or none of its fields can be identified.
    InputError
        There are two sheets, or no field has the requested pitch.
    """
    sheet, corners_mm, corners_px = find_sheet(image)
    to_image = _fit_homography(corners_mm, corners_px)
    black = _grey_of_black(image, sheet, to_image)
    fields = [score_field(image, to_image, sheet, field, black) for field in sheet.fields]
    identified = [field for field in fields if field.read]
    if not identified:
        raise DegenerateError(
            f"none of the {len(fields)} fields of the test sheet can be read",
            hint="Scan the whole sheet sharply, with 600 dpi or more",
        )
    points_mm = np.vstack([corners_mm, [field.centre_mm for field in identified]])
    points_px = np.vstack([corners_px, [field.centre_px for field in identified]])
    scale, bend_mm = _fit_scale(points_mm, points_px, scan_dpi)
    doubt = None
    if scan_dpi and bend_mm > MAX_SCANNED_BEND_MM:
        doubt = f"the sheet is {bend_mm:.1f} mm out of shape, so the picture is no scan"
    elif scan_dpi and max(abs(s - 1) for s in scale) > MAX_SCALE_ERROR:
        doubt = "at {:.6g} x {:.6g} dpi".format(*scan_dpi)
        doubt += " the sheet would be {:.3f} x {:.3f} times its size".format(*scale)
    recommended = recommend(fields, pitch_mm)
    return PrinterReport(
        sheet, tuple(fields), recommended, scale if scan_dpi else None, bend_mm, doubt
    )


def recommend(fields: Sequence[FieldScore], pitch_mm: float | None = None) -> FieldScore | None:
    """Return the field with the best dot size and pitch.

    Candidates are the fields with the fewest wrong or missing symbols (within
    :data:`EQUAL_RIGHT_FRACTION`) whose margin is at least :data:`SUFFICIENT_MARGIN_RATIO` of the
    largest. Of these the pitch nearest to :data:`USUAL_PITCH_MM` is chosen, and at this pitch the
    dot with the largest margin. Returns None if even the best field has less than
    :data:`MIN_RIGHT_FRACTION` right.

    Raises
    ------
    InputError
        No field has that pitch.
    """
    if pitch_mm is not None:
        pitches = sorted({field.pitch_mm for field in fields})
        nearest = min(pitches, key=lambda p: abs(p - pitch_mm))
        if abs(nearest - pitch_mm) > MAX_PITCH_ERROR_MM:
            raise InputError(
                f"no field has a pitch of {pitch_mm:g} mm",
                hint=f"Use one of {', '.join(f'{p:.3f}' for p in pitches)}",
            )
        fields = [field for field in fields if field.pitch_mm == nearest]
    candidates = [field for field in fields if field.read and field.right >= MIN_RIGHT_FRACTION]
    if not candidates:
        return None
    best = max(field.right for field in candidates)
    candidates = [field for field in candidates if field.right >= best - EQUAL_RIGHT_FRACTION]
    margin = max(field.margin for field in candidates)
    # A fraction of a negative margin would be larger than the margin itself.
    sufficient = min(SUFFICIENT_MARGIN_RATIO * margin, margin)
    candidates = [field for field in candidates if field.margin >= sufficient]
    return min(candidates, key=lambda f: (round(abs(f.pitch_mm - USUAL_PITCH_MM), 6), -f.margin))


def find_sheet(image: NDArray[np.uint8]) -> tuple[PrinterSheet, Array, Array]:
    """Detect the test sheet in a picture by its corner markers.

    Returns
    -------
    sheet : PrinterSheet
    corners_mm : (n, 2) ndarray
        Corners of the detected markers, in mm from the page's upper left corner to the right and
        down.
    corners_px : (n, 2) ndarray
        The same corners in the picture.

    Raises
    ------
    DegenerateError
        There is no test sheet.
    InputError
        There are several.
    """
    factor = max(1.0, max(image.shape) / MAX_SEARCH_SIDE_PX)
    small = image
    if factor > 1:
        small = cv2.resize(image, None, fx=1 / factor, fy=1 / factor, interpolation=cv2.INTER_AREA)
    detector = cv2.aruco.ArucoDetector(marker_dictionary(), cv2.aruco.DetectorParameters())
    squares, numbers, _ = detector.detectMarkers(small)
    by_number: dict[int, Array] = {}
    for square, number in zip(squares, () if numbers is None else np.ravel(numbers), strict=True):
        if sheet_of_marker(int(number)) is None:
            continue
        if int(number) in by_number:
            raise InputError("two test sheets in one picture", hint="Crop it to one sheet")
        # The centre of a pixel of the reduced picture is that of a block of the original.
        by_number[int(number)] = (square.reshape(4, 2) + 0.5) * factor - 0.5
    sheets = {number // MARKERS_PER_SHEET for number in by_number}
    if len(sheets) > 1:
        raise InputError("two test sheets in one picture", hint="Crop it to one sheet")
    if len(by_number) < MIN_MARKERS:
        raise DegenerateError(
            f"{len(by_number)} of the 4 corner markers of a test sheet found",
            hint="Show the whole sheet of `locatk print testsheet`, sharp and evenly lit",
        )
    identity = sheet_of_marker(min(by_number))
    assert identity is not None
    sheet = printer_sheet(*identity)
    markers = [corner for corner in sheet.corners if corner.number in by_number]
    corners_mm = sheet.mm(1) * np.vstack([marker.points for marker in markers])
    corners_px = np.vstack([by_number[marker.number] for marker in markers])
    return sheet, corners_mm, _refine_corners(image, corners_px)


def _refine_corners(image: NDArray[np.uint8], corners_px: Array) -> Array:
    """Refine corners (n, 2) to a fraction of a pixel of the original picture."""
    side = float(np.linalg.norm(corners_px[1] - corners_px[0]))
    window = int(np.clip(side / MARKER_SIDE_MODULES / 2, 2, 40))
    points = corners_px.astype(np.float32).reshape(-1, 1, 2)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 50, 0.005)
    refined = cv2.cornerSubPix(image, points, (window, window), (-1, -1), stop)
    result: Array = refined.reshape(-1, 2).astype(float)
    return result


def _fit_homography(points_mm: Array, points_px: Array) -> Array:
    """Fit the homography (3, 3) from the page to the picture."""
    matrix, _ = cv2.findHomography(points_mm, points_px, 0)
    if matrix is None:
        raise DegenerateError("the markers of the test sheet lie on one line")
    result: Array = matrix
    return result


def _grey_of_black(image: NDArray[np.uint8], sheet: PrinterSheet, to_image: Array) -> float:
    """Return the grey value of full black: the median of the markers' black modules."""
    values = []
    for marker in sheet.corners:
        rows, columns = np.nonzero(marker.modules())
        middles = np.column_stack([columns, rows]) + 0.5
        points_mm = sheet.mm(1) * (np.array(marker.at) + middles * marker.module)
        points_px = cv2.perspectiveTransform(points_mm[None].astype(np.float64), to_image)[0]
        x, y = np.rint(points_px).astype(int).T
        inside = (x >= 0) & (y >= 0) & (x < image.shape[1]) & (y < image.shape[0])
        values.append(image[y[inside], x[inside]])
    return float(np.median(np.concatenate(values)))


def _fit_scale(
    points_mm: Array, points_px: Array, dpi: tuple[float, float] | None
) -> tuple[tuple[float, float], float]:
    """Return the scale along the paper's x and y, and the rms deformation in mm.

    The model is an affine map: the paper may be rotated on the scanner, and feed and scan need not
    be perpendicular. Without dpi the scale is in px per mm; the rms is in true mm in both cases.
    """
    scanned = points_px * (1.0 if dpi is None else MM_PER_INCH / np.array(dpi))
    design = np.c_[points_mm, np.ones(len(points_mm))]
    matrix, *_ = np.linalg.lstsq(design, scanned, rcond=None)
    residual = scanned - design @ matrix
    x, y = np.linalg.norm(matrix[:2], axis=1)
    return (float(x), float(y)), float(np.sqrt((residual**2).sum(axis=1).mean()) * 2 / (x + y))
