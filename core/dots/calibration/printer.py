"""How well a printer prints dots, told from a scan or a photo of its test sheet.

The sheet (:mod:`~locatk.core.dots.drawing.test_sheet`) is found by its corner markers, and each
of its
fields is cut out upright. As it is known what every field ought to say, no decoder is in
between: each place is asked at which of its four spots there is most ink.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.calibration.printed_fields import FieldScore, score_field
from locatk.core.dots.drawing.test_sheet import (
    CORNERS,
    PrinterSheet,
    dictionary,
    printer_sheet,
    sheet_of_marker,
)
from locatk.core.dots.sheet import MM_PER_INCH, Manifest
from locatk.core.errors import DegenerateError, InputError

Floats = NDArray[np.float64]

SEARCH_PX = 2400
"""Longer side of the picture in which markers are searched."""

FEWEST_MARKERS = 3

FLAT_MM = 0.5
"""Largest rms by which a sheet on a scanner is out of shape."""

PLAUSIBLE = 0.03
"""By how much a printer's scale can differ from 1 before the stated dpi must be wrong."""

READS = 0.9
"""Share of right symbols without which a field cannot be recommended."""

TIED = 0.002
"""Shares of wrong symbols that differ by less are the same: a speck of dust in a field."""

ENOUGH = 0.7
"""Of the largest margin: with so much of it, the usual pitch is worth more."""

USUAL_MM = Manifest.pitch_mm
"""The pitch for which the paper's camera, and each default of locatk, is made."""


@dataclass(frozen=True)
class PrinterReport:
    """What a test sheet says of its printer.

    Attributes
    ----------
    sheet : PrinterSheet
    fields : tuple of FieldScore
        In the order of the sheet's fields.
    recommended : FieldScore or None
        See :func:`recommend`.
    scale : (x, y) or None
        Printed over nominal length along the paper's width and height; None where the
        picture's resolution is not known.
    bend_mm : float
        Rms by which markers and fields lie off a straight, evenly stretched sheet: uneven
        feed of the printer (or of the scanner), or a paper that is not flat.
    doubt : str or None
        Why :attr:`scale` cannot be true: the picture is a photo, or its resolution is not
        what is said.
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
    """Score each field of a test sheet and measure the printer's scale.

    Parameters
    ----------
    image : (height, width) uint8 ndarray
        Grey values; the sheet may lie in it in any direction and perspective.
    scan_dpi : (x, y), optional
        Pixels of the image an inch, where a scanner has made it.
    pitch_mm : float, optional
        Recommend a field of this pitch only.

    Raises
    ------
    DegenerateError
        There is no test sheet, or no field of it can be read.
    InputError
        There are two sheets, or no field has the pitch that is asked for.
    """
    sheet, corners, found = find_sheet(image)
    to_image = _homography(corners, found)
    black = _black(image, sheet, to_image)
    fields = [score_field(image, to_image, sheet, field, black) for field in sheet.fields]
    read = [field for field in fields if field.read]
    if not read:
        raise DegenerateError(
            f"none of the {len(fields)} fields of the test sheet can be read",
            hint="Scan the whole sheet sharply, with 600 dpi or more",
        )
    places = np.vstack([corners, [field.centre_mm for field in read]])
    seen = np.vstack([found, [field.centre_px for field in read]])
    scale, bend_mm = _stretch(places, seen, scan_dpi)
    doubt = None
    if scan_dpi and bend_mm > FLAT_MM:
        doubt = f"the sheet is {bend_mm:.1f} mm out of shape, so the picture is no scan"
    elif scan_dpi and max(abs(s - 1) for s in scale) > PLAUSIBLE:
        doubt = "at {:.6g} x {:.6g} dpi".format(*scan_dpi)
        doubt += " the sheet would be {:.3f} x {:.3f} times its size".format(*scale)
    chosen = recommend(fields, pitch_mm)
    return PrinterReport(sheet, tuple(fields), chosen, scale if scan_dpi else None, bend_mm, doubt)


def recommend(fields: Sequence[FieldScore], pitch_mm: float | None = None) -> FieldScore | None:
    """The field to print with.

    Of the fields with the fewest wrong or missing symbols (within :data:`TIED`), those whose
    margin is at least :data:`ENOUGH` of the largest; of these the pitch that is nearest to
    :data:`USUAL_MM`; and at this pitch the dot with the largest margin. None where not even
    the best field reads (:data:`READS`).

    Raises
    ------
    InputError
        No field has that pitch.
    """
    if pitch_mm is not None:
        pitches = sorted({field.pitch_mm for field in fields})
        near = min(pitches, key=lambda p: abs(p - pitch_mm))
        if abs(near - pitch_mm) > 0.01:
            raise InputError(
                f"no field has a pitch of {pitch_mm:g} mm",
                hint=f"Use one of {', '.join(f'{p:.3f}' for p in pitches)}",
            )
        fields = [field for field in fields if field.pitch_mm == near]
    candidates = [field for field in fields if field.read and field.right >= READS]
    if not candidates:
        return None
    best = max(field.right for field in candidates)
    candidates = [field for field in candidates if field.right >= best - TIED]
    margin = max(field.margin for field in candidates)
    # A negative margin is not improved by a factor.
    enough = min(ENOUGH * margin, margin)
    candidates = [field for field in candidates if field.margin >= enough]
    return min(candidates, key=lambda f: (round(abs(f.pitch_mm - USUAL_MM), 6), -f.margin))


def find_sheet(image: NDArray[np.uint8]) -> tuple[PrinterSheet, Floats, Floats]:
    """The test sheet in a picture.

    Returns
    -------
    sheet : PrinterSheet
    corners : (n, 2) ndarray
        Corners of the markers that were found, in mm from the page's upper left corner to
        the right and down.
    found : (n, 2) ndarray
        The same in the picture, px.

    Raises
    ------
    DegenerateError
        There is none.
    InputError
        There are several.
    """
    import cv2

    factor = max(1.0, max(image.shape) / SEARCH_PX)
    small = image
    if factor > 1:
        small = cv2.resize(image, None, fx=1 / factor, fy=1 / factor, interpolation=cv2.INTER_AREA)
    detector = cv2.aruco.ArucoDetector(dictionary(), cv2.aruco.DetectorParameters())
    squares, numbers, _ = detector.detectMarkers(small)
    by_number: dict[int, Floats] = {}
    for square, number in zip(squares, () if numbers is None else np.ravel(numbers), strict=True):
        if sheet_of_marker(int(number)) is None:
            continue
        if int(number) in by_number:
            raise InputError("two test sheets in one picture", hint="Crop it to one sheet")
        # The centre of a pixel of the small picture is that of a block of the large one.
        by_number[int(number)] = (square.reshape(4, 2) + 0.5) * factor - 0.5
    groups = {number // CORNERS for number in by_number}
    if len(groups) > 1:
        raise InputError("two test sheets in one picture", hint="Crop it to one sheet")
    if len(by_number) < FEWEST_MARKERS:
        raise DegenerateError(
            f"{len(by_number)} of the 4 corner markers of a test sheet found",
            hint="Show the whole sheet of `locatk print testsheet`, sharp and evenly lit",
        )
    known = sheet_of_marker(min(by_number))
    assert known is not None
    sheet = printer_sheet(*known)
    marks = [corner for corner in sheet.corners if corner.number in by_number]
    corners = np.vstack([corner.points for corner in marks])
    corners = sheet.mm(1) * corners
    found = np.vstack([by_number[corner.number] for corner in marks])
    return sheet, corners, _refine(image, found)


def _refine(image: NDArray[np.uint8], found: Floats) -> Floats:
    """Corners to a fraction of a pixel of the large picture."""
    import cv2

    side = float(np.linalg.norm(found[1] - found[0]))
    window = int(np.clip(side / 7 / 2, 2, 40))
    points = found.astype(np.float32).reshape(-1, 1, 2)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 50, 0.005)
    refined = cv2.cornerSubPix(image, points, (window, window), (-1, -1), stop)
    result: Floats = refined.reshape(-1, 2).astype(float)
    return result


def _homography(places: Floats, found: Floats) -> Floats:
    import cv2

    matrix, _ = cv2.findHomography(places, found, 0)
    if matrix is None:
        raise DegenerateError("the markers of the test sheet lie on one line")
    result: Floats = matrix
    return result


def _black(image: NDArray[np.uint8], sheet: PrinterSheet, to_image: Floats) -> float:
    """Grey value of full black: the median of the markers' black modules."""
    import cv2

    values = []
    for corner in sheet.corners:
        rows, columns = np.nonzero(corner.modules())
        middle = np.column_stack([columns, rows]) + 0.5
        at = sheet.mm(1) * (np.array(corner.at) + middle * corner.module)
        seen = cv2.perspectiveTransform(at[None].astype(np.float64), to_image)[0]
        x, y = np.rint(seen).astype(int).T
        inside = (x >= 0) & (y >= 0) & (x < image.shape[1]) & (y < image.shape[0])
        values.append(image[y[inside], x[inside]])
    return float(np.median(np.concatenate(values)))


def _stretch(
    places: Floats, seen: Floats, dpi: tuple[float, float] | None
) -> tuple[tuple[float, float], float]:
    """Scale along the paper's x and y, and the rms of what no stretching explains, in mm.

    An affine map: the paper may lie askew on the scanner, and feed and scan need not be at
    right angles. Without dpi the scale is in px a mm; the rms is in true mm all the same.
    """
    scanned = seen * (1.0 if dpi is None else MM_PER_INCH / np.array(dpi))
    design = np.c_[places, np.ones(len(places))]
    matrix, *_ = np.linalg.lstsq(design, scanned, rcond=None)
    off = scanned - design @ matrix
    x, y = np.linalg.norm(matrix[:2], axis=1)
    return (float(x), float(y)), float(np.sqrt((off**2).sum(axis=1).mean()) * 2 / (x + y))
