"""Sheets of dots, and the printer's test sheet, as PDF.

The dots are a Type 3 font of four glyphs, and each row is a string. Of the methods compared this
gives the smallest files (2.2 bits a dot), and each dot is exactly on the printer's pixels, whereas
renderers resample images. A pattern is an XObject in pixels of the printer, so that all its numbers
are integers.
"""

from __future__ import annotations

import io
import zlib
from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray
from reportlab.pdfbase import pdfdoc
from reportlab.pdfgen.canvas import Canvas

from locatk.core.dots.codec import DOT_DIRECTIONS, SYMBOL_LETTERS
from locatk.core.dots.drawing.layout import Raster, SheetLayout, pixels
from locatk.core.dots.drawing.test_sheet import (
    MARKER_SIDE_MODULES,
    CornerMarker,
    PrinterField,
    PrinterSheet,
)
from locatk.core.dots.drawing.tiles import seams
from locatk.core.dots.sheet import Manifest
from locatk.formats.printing import page
from locatk.formats.printing.rasters import symbols

MAX_STRING_BYTES = 32_000
"""Letters in one string; PDF readers must support 32767 (ISO 32000-1 annex C)."""

CAPTION_POINTS = 6.0
LINE_SPACING_MM = 3.4
"""Captions of the test sheet."""

_CODES = np.frombuffer(SYMBOL_LETTERS.encode(), np.uint8)


def render(
    manifest: Manifest,
    *,
    marks: bool = True,
    crop: bool = False,
    done: Callable[[], object] = lambda: None,
) -> bytes:
    """Render a PDF with one page a sheet of a manifest, in its order.

    Parameters
    ----------
    manifest : Manifest
    marks, crop : bool
        See :func:`locatk.formats.printing.page.draw_margin`. Too narrow margins remain empty.
    done : callable
        Called after each of :func:`locatk.formats.printing.rasters.count_bands`.

    Raises
    ------
    InputError
        A page is longer than a PDF may be, or the manifest's dots are not on pixels.
    """
    stream = io.BytesIO()
    canvas = page.open_document(stream, f"locatk {manifest.sheets[0].id}")
    for number, sheet in enumerate(manifest.sheets):
        layout = pixels(manifest, number)
        page.start_page(canvas, sheet.page_mm)
        draw_dots(canvas, f"pattern{number}", layout, symbols(manifest, number, done))
        box = page.Box.of(layout)
        if page.fits_margin(box, sheet.page_mm):
            x, y = seams(manifest, number)
            upwards = [sheet.page_mm[1] - seam for seam in y]
            page.draw_margin(
                canvas, box, _captions(manifest, number), (x, upwards), marks=marks, crop=crop
            )
        canvas.showPage()
    canvas.save()
    return stream.getvalue()


def sheets_without_margin(manifest: Manifest) -> list[str]:
    """Return the ids of the sheets with too narrow margins for rulers, marks and captions."""
    return [
        sheet.id
        for number, sheet in enumerate(manifest.sheets)
        if not page.fits_margin(page.Box.of(pixels(manifest, number)), sheet.page_mm)
    ]


def draw_dots(
    canvas: Canvas, name: str, layout: SheetLayout, rows: Iterable[NDArray[np.uint8]]
) -> None:
    """Draw a pattern on the current page.

    Parameters
    ----------
    canvas : reportlab Canvas
    name : str
        Unique name of the drawing in this document.
    layout : SheetLayout
        Layout of a page of the canvas' size.
    rows : iterable of (rows, columns) uint8 ndarray
        Bands of rows from the top down, together of the layout's size.
    """
    raster, height = layout.raster, layout.page[1]
    x, y = layout.first[0], height - layout.first[1] - raster.dot
    packer = zlib.compressobj(6, zlib.DEFLATED, 15, 9, zlib.Z_FILTERED)
    # The operator `'` moves to the next line first, so the text starts one line above.
    head = f"/O gs 0 0 0 1 k BT /D 1 Tf {raster.pitch} TL 1 0 0 1 {x} {y + raster.pitch} Tm\n"
    parts = [packer.compress(head.encode())]
    parts += [packer.compress(_strings(band)) for band in rows]
    parts += [packer.compress(b"ET"), packer.flush()]
    left, top, right, bottom = layout.box
    point = 72 / raster.dpi
    form = pdfdoc.PDFStream(
        _dictionary(
            Type="/XObject",
            Subtype="/Form",
            Matrix=f"[{point:g} 0 0 {point:g} 0 0]",
            BBox=f"[{left} {height - bottom} {right} {height - top}]",
            Resources=_dictionary(
                Font=_dictionary(D=_font(canvas, raster)),
                ExtGState=_dictionary(O="<< /OP true /op true /OPM 1 >>"),
            ),
            Filter="/FlateDecode",
        ),
        b"".join(parts),
    )
    canvas._doc.addForm(name, form)
    canvas.doForm(name)


def _strings(symbols: NDArray[np.uint8]) -> bytes:
    """Return text operators that show these rows, each on a line of its own."""
    rows, columns = symbols.shape
    blocks = []
    for start in range(0, columns, MAX_STRING_BYTES):
        letters = _CODES[symbols[:, start : start + MAX_STRING_BYTES]]
        for text in (b"(", b")'\n" if start == 0 else b")Tj\n"):
            blocks.append(np.tile(np.frombuffer(text, np.uint8), (rows, 1)))
        blocks.insert(-1, letters)
    return np.concatenate(blocks, axis=1).tobytes()


def _font(canvas: Canvas, raster: Raster) -> pdfdoc.PDFObjectReference:
    """Return the font of a raster in this document, which is added at the first call.

    The origin of a glyph is the lower left pixel of a dot exactly on the grid point.
    """
    document = canvas._doc
    name = f"dots-{raster.pitch}-{raster.offset}-{raster.dot}"
    if name not in document.idToObject:
        low, high = -raster.offset, raster.offset + raster.dot
        first, last = min(_CODES), max(_CODES)
        glyphs = {}
        n = raster.dot
        for letter, (right, down) in zip(SYMBOL_LETTERS, DOT_DIRECTIONS.tolist(), strict=True):
            x, y = right * raster.offset, -down * raster.offset
            draw = f"{raster.pitch} 0 {x} {y} {x + n} {y + n} d1 {x} {y} {n} {n} re f"
            glyphs[letter] = document.Reference(pdfdoc.PDFStream(None, draw.encode(), []))
        codes = " ".join(f"{ord(letter)} /{letter}" for letter in sorted(SYMBOL_LETTERS))
        widths = [raster.pitch if code in _CODES else 0 for code in range(first, last + 1)]
        font = _dictionary(
            Type="/Font",
            Subtype="/Type3",
            FontBBox=f"[{low} {low} {high} {high}]",
            FontMatrix="[1 0 0 1 0 0]",
            CharProcs=_dictionary(**glyphs),
            Encoding=f"<< /Type /Encoding /Differences [{codes}] >>",
            FirstChar=int(first),
            LastChar=int(last),
            Widths=pdfdoc.PDFArrayCompact(widths),
            Resources="<< >>",
        )
        document.Reference(font, name)
    return pdfdoc.PDFObjectReference(name)


def _dictionary(**entries: object) -> pdfdoc.PDFDictionary:
    return pdfdoc.PDFDictionary(entries)


def _captions(manifest: Manifest, number: int) -> list[str]:
    """Return the captions of a sheet in the order of importance."""
    sheet = manifest.sheets[number]
    (x, y), (u, v), (columns, rows) = sheet.origin, sheet.section, sheet.size
    return [
        sheet.id,
        "Print at 100 %",
        *(["Cut through the marks"] if sheet.position_mm is not None else []),
        f"pitch {manifest.pitch_mm:.4g} mm",
        f"{manifest.dpi} dpi",
        f"dot {manifest.dot_mm:.3g} mm",
        f"{manifest.codec} {x},{y} section {u},{v}",
        f"{columns} x {rows} dots",
    ]


# ---- test sheet


def render_test_sheet(sheet: PrinterSheet) -> bytes:
    """Render a page with the fields, their captions, the markers and rulers of 100 mm.

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
    _instructions(canvas, sheet)
    inner_mm = sheet.mm(sheet.corners[0].points[2, 0]) + 4
    middle = (height - page.RULER_MM) / 2
    page.ruler(canvas, (inner_mm - 6, middle), upright=True)
    page.ruler(canvas, ((width - page.RULER_MM) / 2, inner_mm - 6))
    canvas.showPage()
    canvas.save()
    return stream.getvalue()


def _draw_marker(canvas: Canvas, sheet: PrinterSheet, corner: CornerMarker) -> None:
    """Draw the black modules on the printer's pixels, adjacent ones of a row as one rectangle."""
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
    """Write name, dot and pitch below a field."""
    left, _, _, bottom = field.layout.box
    x, y = sheet.mm(left), sheet.mm(sheet.page[1] - bottom) - LINE_SPACING_MM
    raster = field.layout.raster
    width = page.text(canvas, (x, y), field.name, CAPTION_POINTS, bold=True)
    dot = f"dot {1000 * field.dot_mm:.0f} \u00b5m = {raster.dot} px"
    page.text(canvas, (x + width + 1, y), dot, CAPTION_POINTS)
    pitch = f"pitch {field.pitch_mm:.3f} mm = {raster.pitch} px"
    page.text(canvas, (x, y - 0.75 * LINE_SPACING_MM), pitch, CAPTION_POINTS)


def _instructions(canvas: Canvas, sheet: PrinterSheet) -> None:
    """Write the instructions between the upper markers."""
    x = sheet.mm(sheet.corners[0].points[1, 0]) + 6
    y = sheet.mm(sheet.page[1] - sheet.corners[0].at[1]) - LINE_SPACING_MM
    title = f"locatk test sheet, {sheet.paper}, {sheet.dpi} dpi, {sheet.codec}"
    page.text(canvas, (x, y), title, 10.0, bold=True)
    for line in (
        "Print at 100 %, no scaling, best quality, black only; no toner or ink saving.",
        "Scan the whole sheet in grey with 1200 dpi (600 at least), not sharpened, as PNG; then",
        "locatk calibrate printer SCAN.png -o printer.toml",
    ):
        y -= LINE_SPACING_MM
        page.text(canvas, (x, y), line, 8.0)
