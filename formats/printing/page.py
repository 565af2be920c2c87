"""PDF pages at true size, and the rulers, marks and captions in their margin.

The margin keeps a distance of :data:`CLEARANCE_MM` from the pattern. Lengths are in mm from the
page's lower left corner; only this module converts them to reportlab's points.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import IO

import numpy as np
from reportlab.lib.colors import CMYKColorSep
from reportlab.lib.units import mm
from reportlab.pdfbase import pdfdoc
from reportlab.pdfgen.canvas import Canvas

from locatk.core import drawing
from locatk.core.dots.drawing.layout import BASE_DPI, SheetLayout
from locatk.core.dots.sheet import MM_PER_INCH
from locatk.core.errors import InputError
from locatk.formats.output import tool_version

BLACK = CMYKColorSep(0, 0, 0, 1, spotName="Black")
"""Ink of all drawings: the process ink, and plain black on devices without it.

``0 0 0 1 k`` is 87.5 % grey on grey and 1-bit devices of Ghostscript, which convert it by a profile
and halftone it; ``0 g`` removes the other inks below it. See :func:`black_ink`.
"""

MAX_PAGE_MM = 5080.0
"""Longest side that PDF viewers must support: 200 inches (ISO 32000-1 annex C)."""

POINTS_PER_INCH = 72

PAGE_STEP_POINTS = 1e-4
"""Resolution of the size of a page; single precision has 1e-3 points for the largest pages."""

MIN_LINE_WIDTH_MM = 0.13
"""Smallest width of a printed line: more than the diagonal of a pixel of 300 dpi (0.1197 mm).

A thinner line has gaps without anti-aliasing, since it passes between the centres of pixels.
"""

CLEARANCE_MM = 1.0
STRIP_MM = 5.0
"""Depth of the strip around the pattern that contains rulers, marks and captions."""

MIN_MARGIN_MM = CLEARANCE_MM + STRIP_MM + 1.0
"""Smallest margin for this strip."""

RULER_MM = 100

CORNER_MM = 6.0
"""Length of an edge, from each corner, without rulers and captions."""

MARK_MM = 4.0
"""Size of a registration mark."""

FONT, BOLD_FONT = "Helvetica", "Helvetica-Bold"
CAPTION_POINTS = drawing.MIN_TEXT_POINTS


@dataclass(frozen=True)
class Box:
    """Rectangle on the page, in mm."""

    left: float
    bottom: float
    right: float
    top: float

    @classmethod
    def of(cls, layout: SheetLayout) -> Box:
        """Return the area that the dots of a layout can cover."""
        left, top, right, bottom = (layout.raster.mm(edge) for edge in layout.box)
        height = layout.raster.mm(layout.page[1])
        return cls(left, height - bottom, right, height - top)


def open_document(stream: IO[bytes], title: str) -> Canvas:
    """Open a document that viewers print at 100 %.

    It contains neither a time nor random numbers: the same drawing gives the same bytes.
    """
    canvas = Canvas(stream, pageCompression=1, invariant=1, pdfVersion=(1, 6))
    canvas.setTitle(title)
    canvas.setAuthor("locatk")
    canvas.setSubject("Print at 100 %, no scaling")
    canvas.setCreator(f"locatk {tool_version()}")
    canvas.setViewerPreference("PrintScaling", "None")
    _define_black(canvas)
    return canvas


def _define_black(canvas: Canvas) -> None:
    """Define the colour space of :data:`BLACK`; the one of reportlab is converted to CMYK."""
    to_grey = {"FunctionType": 2, "Domain": "[0 1]", "C0": "[1]", "C1": "[0]", "N": 1}
    space = (
        *map(pdfdoc.PDFName, ("Separation", BLACK.spotName, "DeviceGray")),
        pdfdoc.PDFDictionary(to_grey),
    )
    canvas._doc.Reference(pdfdoc.PDFArrayCompact(space), BLACK.spotName)


def black_ink(canvas: Canvas) -> pdfdoc.PDFObjectReference:
    """Return the colour space of :data:`BLACK` in this document."""
    return pdfdoc.PDFObjectReference(BLACK.spotName)


def start_page(
    canvas: Canvas,
    size_mm: tuple[float, float],
    *,
    hint: str = "Cut the floor over several papers with --tiles, or use --format png",
) -> None:
    """Begin a page of this size; `canvas.showPage()` ends it.

    Raises
    ------
    InputError
        The page is longer than a PDF may be; ``hint`` is the remedy.
    """
    if max(size_mm) > MAX_PAGE_MM:
        raise InputError(
            f"a PDF page of {size_mm[0]:g} x {size_mm[1]:g} mm is longer than the limit of "
            f"{MAX_PAGE_MM:g} mm",
            hint=hint,
        )
    canvas.setPageSize(tuple(_points(side) for side in size_mm))
    canvas.setFillColor(BLACK)
    canvas.setStrokeColor(BLACK)


def _points(side_mm: float) -> str:
    """Return the points of a side in whole 1/300 in, as digits that reportlab writes unchanged.

    They are a trifle less, since some rasterizers round the number of pixels of a page up. With
    single precision, or a scale of 300/72, 595.2 or 84.96 points (or even 792) become one pixel
    more than 2480 (354, 3300) of 1/300 in, and the page is stretched over them. A page in seven
    digits, as reportlab writes numbers, would end up to 0.01 points too early, which is 0.17 px at
    1200 dpi.
    """
    side = round(round(side_mm * BASE_DPI / MM_PER_INCH) * POINTS_PER_INCH / BASE_DPI, 6)
    steps = math.ceil(side / PAGE_STEP_POINTS) - 1
    while float(np.float32(steps * PAGE_STEP_POINTS)) >= side:
        steps -= 1
    return f"{steps * PAGE_STEP_POINTS:.4f}"


def ruler(
    canvas: Canvas, start: tuple[float, float], length: int = RULER_MM, *, upright: bool = False
) -> None:
    """Draw :func:`locatk.core.drawing.ruler`."""
    draw(canvas, drawing.ruler(start, length, upright=upright))


def draw(canvas: Canvas, marks: Iterable[drawing.Mark]) -> None:
    """Draw marks on the current page."""
    for mark in marks:
        canvas.saveState()
        if isinstance(mark, drawing.Text):
            _write(canvas, mark)
        else:
            _stroke(canvas, mark, max(mark.width_mm, MIN_LINE_WIDTH_MM))
        canvas.restoreState()


def _write(canvas: Canvas, label: drawing.Text) -> None:
    canvas.translate(label.position[0] * mm, label.position[1] * mm)
    canvas.rotate(label.angle_deg)
    font = BOLD_FONT if label.bold else FONT
    canvas.setFont(font, label.points)
    anchor = {"start": 0.0, "middle": 0.5, "end": 1.0}[label.anchor]
    width = canvas.stringWidth(label.text, font, label.points)
    canvas.drawString(-anchor * width, 0, label.text)


def _stroke(
    canvas: Canvas, mark: drawing.Line | drawing.Circle | drawing.Polygon, width_mm: float
) -> None:
    canvas.setLineWidth(width_mm * mm)
    if isinstance(mark, drawing.Circle):
        canvas.circle(*(value * mm for value in (*mark.centre, mark.radius_mm)))
    elif isinstance(mark, drawing.Line):
        if mark.dash_mm is None:
            _lines(canvas, [(*mark.start, *mark.end)], width_mm)
        else:
            canvas.setDash([mark.dash_mm * mm])
            canvas.line(*(value * mm for value in (*mark.start, *mark.end)))
    else:
        path = canvas.beginPath()
        path.moveTo(*(value * mm for value in mark.corners[0]))
        for corner in mark.corners[1:]:
            path.lineTo(*(value * mm for value in corner))
        path.close()
        canvas.drawPath(path, stroke=int(not mark.filled), fill=int(mark.filled))


def _lines(
    canvas: Canvas,
    lines: Sequence[tuple[float, float, float, float]],
    width_mm: float = drawing.LINE_WIDTH_MM,
) -> None:
    """Draw straight lines, those along an edge of the page as filled rectangles.

    pdfium moves lines beyond 32,000 px (2.7 m at 300 dpi, 0.7 m at 1200 dpi) to that pixel, which
    is among the dots, but not rectangles.
    """
    canvas.setLineWidth(width_mm * mm)
    for x1, y1, x2, y2 in lines:
        if x1 == x2 or y1 == y2:
            half = width_mm / 2
            (left, right), (bottom, top) = sorted((x1, x2)), sorted((y1, y2))
            if x1 == x2:
                left, right = left - half, right + half
            else:
                bottom, top = bottom - half, top + half
            corners = (left, bottom, right - left, top - bottom)
            canvas.rect(*(value * mm for value in corners), stroke=0, fill=1)
        else:
            canvas.line(*(value * mm for value in (x1, y1, x2, y2)))


def text(
    canvas: Canvas, start: tuple[float, float], words: str, points: float, *, bold: bool = False
) -> float:
    """Write a line of text from ``start`` to the right; return its width in mm."""
    font = BOLD_FONT if bold else FONT
    canvas.setFont(font, points)
    canvas.drawString(start[0] * mm, start[1] * mm, words)
    width: float = canvas.stringWidth(words, font, points) / mm
    return width


def registration_mark(canvas: Canvas, x: float, y: float) -> None:
    """Draw a cross in a circle around a point at which two tiles meet."""
    arm = MARK_MM / 2
    _lines(canvas, [(x - arm, y, x + arm, y), (x, y - arm, x, y + arm)])
    canvas.circle(x * mm, y * mm, 0.6 * arm * mm)


def crop_marks(canvas: Canvas, box: Box) -> None:
    """Draw marks for cutting the margin off, and set the page's TrimBox to the same box."""
    inner, outer = CLEARANCE_MM + 0.5, CLEARANCE_MM + STRIP_MM
    lines = []
    for x, side in ((box.left, -1), (box.right, 1)):
        lines += [(x + side * inner, y, x + side * outer, y) for y in (box.bottom, box.top)]
    for y, side in ((box.bottom, -1), (box.top, 1)):
        lines += [(x, y + side * inner, x, y + side * outer) for x in (box.left, box.right)]
    _lines(canvas, lines)
    canvas.setTrimBox([edge * mm for edge in (box.left, box.bottom, box.right, box.top)])


def axes(canvas: Canvas, x: float, y: float, length: float = 2.0) -> None:
    """Draw arrows along the sheet's x and y from a corner, with their names beyond the tips."""
    head = 0.8
    _lines(
        canvas,
        [
            (x, y, x + length, y),
            (x + length - head, y - head / 2, x + length, y),
            (x + length - head, y + head / 2, x + length, y),
            (x, y, x, y + length),
            (x - head / 2, y + length - head, x, y + length),
            (x + head / 2, y + length - head, x, y + length),
        ],
    )
    text(canvas, (x + length + 0.4, y - 0.65), "x", CAPTION_POINTS)
    text(canvas, (x - 1.1, y + length + 0.9), "y", CAPTION_POINTS)


def fits_margin(box: Box, size_mm: tuple[float, float]) -> bool:
    """Return True if the margin around ``box`` is wide enough for rulers, marks and captions."""
    sides = (box.left, box.bottom, size_mm[0] - box.right, size_mm[1] - box.top)
    # The box is in the middle of the page without its margin, except for one pixel.
    return min(sides) > MIN_MARGIN_MM - 0.1


def draw_margin(
    canvas: Canvas,
    box: Box,
    captions: Sequence[str],
    seams: tuple[Sequence[float], Sequence[float]] = ((), ()),
    *,
    marks: bool = True,
    crop: bool = False,
) -> None:
    """Draw the margin of one page around the pattern in ``box``.

    Parameters
    ----------
    captions : sequence of str
        Texts above the pattern in the order of importance. The first one is bold; the last ones
        are omitted if they do not fit.
    seams : (x, y)
        Lines along which tiles are cut, in mm from the left and from the bottom edge, with
        registration marks at both ends.
    marks : bool
        Draw rulers of 100 mm below and at the left (shorter on small pages), the axes, and the
        captions.
    crop : bool
        Draw marks for cutting the margin off.
    """
    middle = CLEARANCE_MM + STRIP_MM / 2
    for x in seams[0]:
        registration_mark(canvas, x, box.bottom - middle)
        registration_mark(canvas, x, box.top + middle)
    for y in seams[1]:
        registration_mark(canvas, box.left - middle, y)
        registration_mark(canvas, box.right + middle, y)
    if crop:
        crop_marks(canvas, box)
    if not marks:
        return
    left, right = _between(box.left, box.right, seams[0])
    bottom, top = _between(box.bottom, box.top, seams[1])
    for length_mm, start, upright in (
        (right - left, (left, box.bottom - CLEARANCE_MM), False),
        (top - bottom, (box.left - CLEARANCE_MM, bottom), True),
    ):
        length = min(RULER_MM, int(length_mm - 5) // 10 * 10)
        if length > 0:
            ruler(canvas, start, length, upright=upright)
    axes(canvas, box.left - CLEARANCE_MM - 4, box.bottom - CLEARANCE_MM - 4)
    x, bold = left, True
    for caption in captions:
        width = canvas.stringWidth(caption, BOLD_FONT if bold else FONT, CAPTION_POINTS) / mm
        if x + width > right:
            break
        text(canvas, (x, box.top + CLEARANCE_MM + 1), caption, CAPTION_POINTS, bold=bold)
        x, bold = x + width + 4, False


def _between(low: float, high: float, seams: Sequence[float]) -> tuple[float, float]:
    """Return the part of an edge between the marks at its ends."""
    middle = (low + high) / 2
    below = [seam + MARK_MM for seam in seams if seam < middle]
    above = [seam - MARK_MM for seam in seams if seam >= middle]
    return max([low + CORNER_MM, *below]), min([high - CORNER_MM, *above])
