"""A page at true size, and what stands in its margin: rulers, marks, words.

Nothing in the margin comes nearer to the pattern than :data:`CLEARANCE_MM`. Lengths are in
mm from the page's lower left corner, as on the sheet itself; reportlab's points stay in
here.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import IO

import numpy as np
from reportlab.lib.colors import CMYKColor
from reportlab.lib.units import mm
from reportlab.pdfgen.canvas import Canvas

from locatk.core import drawing
from locatk.core.dots.drawing.layout import SheetLayout
from locatk.core.errors import InputError
from locatk.formats.output import tool_version

BLACK = CMYKColor(0, 0, 0, 1)
"""The one ink of all that is drawn: K alone, never grey, which printers
halftone."""

LARGEST_MM = 5080.0
"""200 inches; no PDF viewer need show a longer page (ISO 32000-1 annex C)."""

CLEARANCE_MM = 1.0
STRIP_MM = 5.0
"""The margin's furniture lies within a strip of this depth around the pattern."""

NEEDED_MM = CLEARANCE_MM + STRIP_MM + 1.0
"""Margin below which there is no room for it."""

RULER_MM = 100

_CORNER_MM = 6.0
_MARK_MM = 4.0
_FONT, _BOLD = "Helvetica", "Helvetica-Bold"
_SMALL, _LARGE = 5.0, 7.0


@dataclass(frozen=True)
class Box:
    """A rectangle on the page, in mm."""

    left: float
    bottom: float
    right: float
    top: float

    @classmethod
    def of(cls, layout: SheetLayout) -> Box:
        """All that the dots of a layout can cover."""
        left, top, right, bottom = (layout.raster.mm(edge) for edge in layout.box)
        height = layout.raster.mm(layout.page[1])
        return cls(left, height - bottom, right, height - top)


def open_document(stream: IO[bytes], title: str) -> Canvas:
    """A document that viewers print at 100 %.

    It holds no time and no random number: the same drawing gives the same bytes.
    """
    canvas = Canvas(stream, pageCompression=1, invariant=1, pdfVersion=(1, 6))
    canvas.setTitle(title)
    canvas.setAuthor("locatk")
    canvas.setSubject("Print at 100 %, no scaling")
    canvas.setCreator(f"locatk {tool_version()}")
    canvas.setViewerPreference("PrintScaling", "None")
    return canvas


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
        No viewer need show a page as long as that; ``hint`` says what to do.
    """
    if max(size_mm) > LARGEST_MM:
        raise InputError(
            f"a PDF page of {size_mm[0]:g} x {size_mm[1]:g} mm is longer than "
            f"{LARGEST_MM:g} mm, which is the most",
            hint=hint,
        )
    canvas.setPageSize(tuple(_points(side) for side in size_mm))
    canvas.setFillColor(BLACK)
    canvas.setStrokeColor(BLACK)
    canvas.setLineWidth(drawing.LINE_WIDTH_MM * mm)


def _points(side_mm: float) -> float:
    """Points of a side in the seven digits that reportlab writes, a trifle too small.

    Some rasterisers round the pixels of a page up: 595.2 points, or even 792, are then a
    pixel more than 2480 or 3300 of 1/300 in, over which the page is stretched, because
    32 bits, or 300/72, hold a little too much.
    """
    side = round(side_mm * mm, 6)
    unit = 10.0 ** (math.floor(math.log10(side)) - 6)
    steps = round(side / unit)
    while float(np.float32(steps * unit)) >= side:
        steps -= 1
    return steps * unit


def ruler(
    canvas: Canvas, start: tuple[float, float], length: int = RULER_MM, *, upright: bool = False
) -> None:
    """Draw :func:`locatk.core.drawing.ruler`."""
    draw(canvas, drawing.ruler(start, length, upright=upright))


def draw(canvas: Canvas, marks: Iterable[drawing.Mark]) -> None:
    """Draw marks on the page that was begun."""
    for mark in marks:
        canvas.saveState()
        if isinstance(mark, drawing.Text):
            _write(canvas, mark)
        else:
            canvas.setLineWidth(mark.width_mm * mm)
            _stroke(canvas, mark)
        canvas.restoreState()


def _write(canvas: Canvas, words: drawing.Text) -> None:
    canvas.translate(words.position[0] * mm, words.position[1] * mm)
    canvas.rotate(words.angle_deg)
    font = _BOLD if words.bold else _FONT
    canvas.setFont(font, words.points)
    share = {"start": 0.0, "middle": 0.5, "end": 1.0}[words.anchor]
    width = canvas.stringWidth(words.text, font, words.points)
    canvas.drawString(-share * width, 0, words.text)


def _stroke(canvas: Canvas, mark: drawing.Line | drawing.Circle | drawing.Polygon) -> None:
    if isinstance(mark, drawing.Circle):
        canvas.circle(*(value * mm for value in (*mark.centre, mark.radius_mm)))
    elif isinstance(mark, drawing.Line):
        if mark.dash_mm is not None:
            canvas.setDash([mark.dash_mm * mm])
        _lines(canvas, [(*mark.start, *mark.end)])
    else:
        path = canvas.beginPath()
        path.moveTo(*(value * mm for value in mark.corners[0]))
        for corner in mark.corners[1:]:
            path.lineTo(*(value * mm for value in corner))
        path.close()
        canvas.drawPath(path, stroke=int(not mark.filled), fill=int(mark.filled))


def _lines(canvas: Canvas, lines: Sequence[tuple[float, float, float, float]]) -> None:
    canvas.lines([tuple(value * mm for value in line) for line in lines])


def text(
    canvas: Canvas, at: tuple[float, float], words: str, size: float, *, bold: bool = False
) -> float:
    """Write from ``at`` to the right, in points; returns the width in mm."""
    font = _BOLD if bold else _FONT
    canvas.setFont(font, size)
    canvas.drawString(at[0] * mm, at[1] * mm, words)
    width: float = canvas.stringWidth(words, font, size) / mm
    return width


def registration_mark(canvas: Canvas, x: float, y: float) -> None:
    """A cross in a circle around a point at which two tiles meet."""
    arm = _MARK_MM / 2
    _lines(canvas, [(x - arm, y, x + arm, y), (x, y - arm, x, y + arm)])
    canvas.circle(x * mm, y * mm, 0.6 * arm * mm)


def crop_marks(canvas: Canvas, box: Box) -> None:
    """Where to cut for a sheet without margin; the page's TrimBox says the same."""
    near, far = CLEARANCE_MM + 0.5, CLEARANCE_MM + STRIP_MM
    lines = []
    for x, out in ((box.left, -1), (box.right, 1)):
        lines += [(x + out * near, y, x + out * far, y) for y in (box.bottom, box.top)]
    for y, out in ((box.bottom, -1), (box.top, 1)):
        lines += [(x, y + out * near, x, y + out * far) for x in (box.left, box.right)]
    _lines(canvas, lines)
    canvas.setTrimBox([edge * mm for edge in (box.left, box.bottom, box.right, box.top)])


def axes(canvas: Canvas, x: float, y: float, length: float = 3.5) -> None:
    """Arrows along the sheet's x and y, with their letters, from a corner."""
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
    text(canvas, (x + length - 0.6, y - 1.9), "x", _SMALL)
    text(canvas, (x - 1.6, y + length - 0.9), "y", _SMALL)


def has_room(box: Box, size_mm: tuple[float, float]) -> bool:
    """Whether the margin around ``box`` holds rulers, marks and words."""
    sides = (box.left, box.bottom, size_mm[0] - box.right, size_mm[1] - box.top)
    # The box is in the middle of what the margin leaves, to a pixel.
    return min(sides) > NEEDED_MM - 0.1


def furnish(
    canvas: Canvas,
    box: Box,
    words: Sequence[str],
    seams: tuple[Sequence[float], Sequence[float]] = ((), ()),
    *,
    marks: bool = True,
    crop: bool = False,
) -> None:
    """Draw the margin of one page around the pattern in ``box``.

    Parameters
    ----------
    words : sequence of str
        What is written above the pattern, the most important first: the first in bold,
        and from the last on those left out that do not fit.
    seams : (x, y)
        Tiles: where they are cut for their neighbours, in mm from the left and from the
        bottom edge; registration marks stand at both ends of each.
    marks : bool
        Rulers of 100 mm below and at the left (shorter where the page is), the axes, and
        the words.
    crop : bool
        Marks for cutting the margin off.
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
    for room, start, upright in (
        (right - left, (left, box.bottom - CLEARANCE_MM), False),
        (top - bottom, (box.left - CLEARANCE_MM, bottom), True),
    ):
        length = min(RULER_MM, int(room - 5) // 10 * 10)
        if length > 0:
            ruler(canvas, start, length, upright=upright)
    axes(canvas, box.left - CLEARANCE_MM - 4, box.bottom - CLEARANCE_MM - 4)
    at, bold = left, True
    for item in words:
        width = canvas.stringWidth(item, _BOLD if bold else _FONT, _LARGE) / mm
        if at + width > right:
            break
        text(canvas, (at, box.top + CLEARANCE_MM + 1), item, _LARGE, bold=bold)
        at, bold = at + width + 4, False


def _between(low: float, high: float, seams: Sequence[float]) -> tuple[float, float]:
    """What of an edge is free between the marks at its ends."""
    middle = (low + high) / 2
    below = [at + _MARK_MM for at in seams if at < middle]
    above = [at - _MARK_MM for at in seams if at >= middle]
    return max([low + _CORNER_MM, *below]), min([high - _CORNER_MM, *above])
