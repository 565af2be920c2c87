"""The printer's test sheet as a PDF."""

from __future__ import annotations

import io

from reportlab.pdfgen.canvas import Canvas

from locatk.core.dots.drawing.test_sheet import (
    MARKER_SIDE_MODULES,
    CornerMarker,
    PrinterField,
    PrinterSheet,
)
from locatk.formats.printing import page
from locatk.formats.printing.pattern import draw_dots

CAPTION_POINTS = 6.0
LINE_MM = 3.4


def render(sheet: PrinterSheet) -> bytes:
    """A page with the fields, their captions, the markers and rulers of 100 mm.

    The same sheet gives the same bytes.
    """
    stream = io.BytesIO()
    canvas = page.open_document(stream, f"locatk test sheet {sheet.paper} {sheet.dpi} dpi")
    width, height = (sheet.mm(side) for side in sheet.page)
    page.start_page(canvas, (width, height))
    for corner in sheet.corners:
        _draw_marker(canvas, sheet, corner)
    for field in sheet.fields:
        draw_dots(canvas, f"field-{field.name}", field.layout, [sheet.symbols(field)])
        _caption(canvas, sheet, field)
    _words(canvas, sheet)
    clear = sheet.mm(sheet.corners[0].points[2, 0]) + 4
    middle = (height - page.RULER_MM) / 2
    page.ruler(canvas, (clear - 6, middle), upright=True)
    page.ruler(canvas, ((width - page.RULER_MM) / 2, clear - 6))
    canvas.showPage()
    canvas.save()
    return stream.getvalue()


def _draw_marker(canvas: Canvas, sheet: PrinterSheet, corner: CornerMarker) -> None:
    """Black modules, each row's neighbours in one rectangle, on the printer's pixels."""
    canvas.saveState()
    point = 72 / sheet.dpi
    canvas.scale(point, point)
    left, top = corner.at
    side, bottom = corner.module, sheet.page[1]
    path = canvas.beginPath()
    for row, black in enumerate(corner.modules()):
        starts = [k for k in range(MARKER_SIDE_MODULES) if black[k] and not (k and black[k - 1])]
        for start in starts:
            end = start
            while end < MARKER_SIDE_MODULES and black[end]:
                end += 1
            y = bottom - top - (row + 1) * side
            path.rect(left + start * side, y, (end - start) * side, side)
    canvas.drawPath(path, stroke=0, fill=1)
    canvas.restoreState()


def _caption(canvas: Canvas, sheet: PrinterSheet, field: PrinterField) -> None:
    """Name, dot and pitch below a field."""
    left, _, _, bottom = field.layout.box
    x, y = sheet.mm(left), sheet.mm(sheet.page[1] - bottom) - LINE_MM
    raster = field.layout.raster
    wide = page.text(canvas, (x, y), field.name, CAPTION_POINTS, bold=True)
    dot = f"dot {1000 * field.dot_mm:.0f} \u00b5m = {raster.dot} px"
    page.text(canvas, (x + wide + 1, y), dot, CAPTION_POINTS)
    pitch = f"pitch {field.pitch_mm:.3f} mm = {raster.pitch} px"
    page.text(canvas, (x, y - 0.75 * LINE_MM), pitch, CAPTION_POINTS)


def _words(canvas: Canvas, sheet: PrinterSheet) -> None:
    """What to do with the sheet, between the upper markers."""
    x = sheet.mm(sheet.corners[0].points[1, 0]) + 6
    y = sheet.mm(sheet.page[1] - sheet.corners[0].at[1]) - LINE_MM
    title = f"locatk test sheet, {sheet.paper}, {sheet.dpi} dpi, {sheet.codec}"
    page.text(canvas, (x, y), title, 10.0, bold=True)
    for line in (
        "Print at 100 %, no scaling, best quality, black only; no toner or ink saving.",
        "Scan the whole sheet in grey with 1200 dpi (600 at least), not sharpened, as PNG; then",
        "locatk calibrate printer SCAN.png -o printer.toml",
    ):
        y -= LINE_MM
        page.text(canvas, (x, y), line, 8.0)
