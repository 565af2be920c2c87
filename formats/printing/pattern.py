"""Sheets of dots, and the printer's test sheet, as PDF.

The dots are image masks, a bit per pixel of the printer, in bands of rows. Each mask ends
:data:`MASK_INSET_PX` inside its pixels. Of 17 representations that were compared (such as glyphs,
rectangles, dashed lines, patterns and forms), it is the only one from which pdfium, MuPDF,
Ghostscript, poppler and cairo all rasterise every dot on exactly its own pixels: Ghostscript
accumulates rounded advances of glyphs, poppler needs minutes for as many glyphs, and edges that are
exactly on those of pixels fall to either side, depending on the last bit of a scale.
"""

from __future__ import annotations

import io
import zlib
from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray
from reportlab.pdfbase import pdfdoc
from reportlab.pdfgen.canvas import Canvas

from locatk.core.dots.drawing.layout import SheetLayout, pixels
from locatk.core.dots.drawing.test_sheet import (
    CornerMarker,
    PrinterField,
    PrinterSheet,
)
from locatk.core.dots.drawing.tiles import seams
from locatk.core.dots.sheet import Manifest
from locatk.formats.printing import page
from locatk.formats.printing.rasters import ink_bands, symbols

MASK_INSET_PX = 0.1
"""Distance of the edges of an image mask from those of its pixels, into them [px].

Measured at 300, 600 and 1200 dpi: with 0.02 to 0.15 px, all rasterisers show exactly these pixels.
Without it, pdfium and MuPDF cover a pixel more and stretch the image over it; with 0.25 px, the
``cups`` device of Ghostscript moves dots. 0.1 px tolerates a page that is 0.08 px off.
"""

LINE_SPACING_MM = 3.4
"""Distance of the lines of text of the test sheet."""


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
    left, top, _, _ = layout.box
    _draw_ink(canvas, name, layout.raster.dpi, layout.page, (left, top), ink_bands(layout, rows))


def _draw_ink(
    canvas: Canvas,
    name: str,
    dpi: int,
    page_px: tuple[int, int],
    corner_px: tuple[int, int],
    bands: Iterable[NDArray[np.uint8]],
) -> None:
    """Draw black pixels of the printer, as an image mask for each band of them.

    ``corner_px`` is the upper left pixel on a page of ``page_px`` (x, y). The ``bands`` of (height,
    width) follow each other from the top down, with 1 for ink; the rest is as in :func:`draw_dots`.
    """
    document, masks = canvas._doc, {}
    lines = ["/Overprint gs /Ink cs 1 scn"]
    (left, top), below = corner_px, corner_px[1]
    for number, ink in enumerate(bands):
        height, width = ink.shape
        below += height
        mask = pdfdoc.PDFStream(
            _dictionary(
                Type="/XObject",
                Subtype="/Image",
                ImageMask="true",
                BitsPerComponent=1,
                Width=width,
                Height=height,
                Filter="/FlateDecode",
            ),
            zlib.compress(np.packbits(1 - ink, axis=1).tobytes(), 6),
        )
        masks[f"M{number}"] = document.Reference(mask)
        x, y = left + MASK_INSET_PX, page_px[1] - below + MASK_INSET_PX
        size = (width - 2 * MASK_INSET_PX, height - 2 * MASK_INSET_PX)
        lines.append(f"q {size[0]:.1f} 0 0 {size[1]:.1f} {x:.1f} {y:.1f} cm /M{number} Do Q")
    point = 72 / dpi
    bottom, right = page_px[1] - below, left + width
    # A pixel larger than the masks: some rasterisers clip at a box a pixel too early.
    box = (left - 1, bottom - 1, right + 1, page_px[1] - top + 1)
    form = pdfdoc.PDFStream(
        _dictionary(
            Type="/XObject",
            Subtype="/Form",
            Matrix=f"[{point:g} 0 0 {point:g} 0 0]",
            BBox="[{} {} {} {}]".format(*box),
            Resources=_dictionary(
                XObject=_dictionary(**masks),
                ColorSpace=_dictionary(Ink=page.black_ink(canvas)),
                ExtGState=_dictionary(Overprint="<< /OP true /op true /OPM 1 >>"),
            ),
        ),
        "\n".join(lines),
        [],
    )
    document.addForm(name, form)
    canvas.doForm(name)


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
    """Draw the black modules on the printer's pixels."""
    module = np.ones((corner.module, corner.module), np.uint8)
    ink = np.kron(corner.modules().astype(np.uint8), module)
    _draw_ink(canvas, f"marker-{corner.number}", sheet.dpi, sheet.page, corner.at, [ink])


def _caption(canvas: Canvas, sheet: PrinterSheet, field: PrinterField) -> None:
    """Write name, dot and pitch below a field, in lines that are narrower than its column."""
    left, _, _, bottom = field.layout.box
    x, y = sheet.mm(left), sheet.mm(sheet.page[1] - bottom) - LINE_SPACING_MM
    raster = field.layout.raster
    width = page.text(canvas, (x, y), field.name, page.CAPTION_POINTS, bold=True)
    dot = f"dot {1000 * field.dot_mm:.0f} \u00b5m"
    page.text(canvas, (x + width + 1, y), dot, page.CAPTION_POINTS)
    pitch = f"pitch {1000 * field.pitch_mm:.0f} \u00b5m"
    pixels = f"{raster.dot} px in {raster.pitch} px"
    for number, line in enumerate((pitch, pixels), 1):
        page.text(canvas, (x, y - number * 0.85 * LINE_SPACING_MM), line, page.CAPTION_POINTS)


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
