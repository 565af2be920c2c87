"""Figures of printed sheets in the rasterisers of printers, viewers and browsers."""

from __future__ import annotations

import io
import math
import os
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from locatk.core.dots.codec import SECTION_LENGTH
from locatk.core.dots.drawing.layout import DPIS, SheetLayout, lay_out, manifest, pixels, snap
from locatk.core.dots.drawing.tiles import SheetTiling, tiling
from locatk.core.dots.sheet import Manifest, Sheet
from locatk.core.errors import LocatkError
from locatk.core.paper_sizes import paper_size
from locatk.formats.benchmarks.dots.rasterisers import RASTERISERS, Grey
from locatk.formats.benchmarks.figures import Figure
from locatk.formats.extras import requires_extra
from locatk.formats.printing import pattern, rasters

STUDY_VARIABLE = "LOCATK_PRINT_STUDY"
"""Environment variable that selects all sheets instead of a few; they take 15 to 30 minutes."""

QUICK_SHEETS = (("A4", 300), ("A5", 600), ("60x80mm", 1200), ("A0", 300))
"""Papers and dpi without this variable."""

STUDY_PAPERS = ("A5", "A4", "A3", "A2", "A1", "A0", "60x4000mm")

MAX_PAGE_PIXELS = 200_000_000
"""Largest page that all rasterisers can draw in memory; A0 has more from 600 dpi on."""

TIMED_SHEET = "A0 300 dpi"
"""Sheet on which rasterisers are timed."""

SLOW_RASTERISERS = ("Ghostscript tiffsep", "pdf.js")
"""Rasterisers that need 10 s and more for this sheet, and get it only in the study."""

DARK_GREY = 128
"""Grey value below which a pixel counts as black."""

SHEET_ORIGIN = (SECTION_LENGTH // 2, SECTION_LENGTH // 4)


@dataclass(frozen=True)
class PrintedSheets:
    """Sheets in one PDF.

    Attributes
    ----------
    name : str
    manifest : Manifest
    document : bytes or None
        PDF below the dots.
    """

    name: str
    manifest: Manifest
    document: bytes | None = None

    def write(self, path: Path) -> None:
        """Write the PDF, as ``locatk print pattern`` does."""
        path.write_bytes(pattern.render(self.manifest))
        if self.document is not None:
            from locatk.formats.printing import overlay

            below = path.with_suffix(".below")
            below.write_bytes(self.document)
            path.write_bytes(overlay.overlay(below, path.read_bytes(), strip_black=True).data)


def one_sheet(paper: str, dpi: int) -> PrintedSheets:
    """Return one sheet with the defaults of ``locatk print pattern``, but for the resolution."""
    return _printed(f"{paper} {dpi} dpi", [_lay_out(paper_size(paper)[1], dpi)], dpi)


def tiled_sheets(dpi: int) -> PrintedSheets:
    """Return a floor of 2 x 2 tiles."""
    floor = tiling(_lay_out((148, 105), dpi), (2, 2), 15)
    return _printed(f"2x2 tiles {dpi} dpi", [floor], dpi)


def overlaid_sheets(dpi: int) -> PrintedSheets:
    """Return sheets over a document whose pages are rotated, cropped, and not whole pixels."""
    import pikepdf

    from locatk.formats.printing import overlay

    pdf = pikepdf.Pdf.new()
    for crop, rotation, unit in (
        ((0, 0, 419.53, 297.64), 0, 1),
        ((31.7, 55.123, 331.77, 480.9), 90, 1),
        ((-20.2, -7, 280.05, 300), 180, 1),
        ((3, 4, 150.33, 210.21), 270, 2),
    ):
        sheet = pdf.add_blank_page(page_size=(500, 500)).obj
        sheet.MediaBox = pikepdf.Array([-100, -100, 500, 500])
        sheet.CropBox = pikepdf.Array(crop)
        sheet.Rotate = rotation
        sheet.UserUnit = unit
    stream = io.BytesIO()
    pdf.save(stream)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "document.pdf"
        path.write_bytes(stream.getvalue())
        sizes = overlay.page_sizes(path)
    made = _printed(f"overlay {dpi} dpi", [_lay_out(size, dpi) for size in sizes], dpi)
    return replace(made, document=stream.getvalue())


def _lay_out(size_mm: tuple[float, float], dpi: int) -> SheetLayout:
    return lay_out(size_mm, 10.0, snap(0.508, None, dpi))


def _printed(name: str, layouts: Iterable[SheetLayout | SheetTiling], dpi: int) -> PrintedSheets:
    sheets: list[Sheet] = []
    x, y = SHEET_ORIGIN
    for number, item in enumerate(layouts):
        sheets += item.sheets(f"sheet-{number}", (x, y))
        x += item.size[0]
    return PrintedSheets(name, manifest(snap(0.508, None, dpi), sheets, "anoto"))


def is_study() -> bool:
    """Return True if all sheets are measured."""
    return bool(os.environ.get(STUDY_VARIABLE))


def printed_sheets() -> Iterator[PrintedSheets]:
    """Yield the sheets of the benchmark: a few, or all with :data:`STUDY_VARIABLE`."""
    names = [(paper, dpi) for dpi in DPIS for paper in STUDY_PAPERS] if is_study() else QUICK_SHEETS
    for paper, dpi in names:
        sheets = one_sheet(paper, dpi)
        if math.prod(pixels(sheets.manifest, 0).page) <= MAX_PAGE_PIXELS:
            yield sheets
    for dpi in DPIS if is_study() else DPIS[:1]:
        yield tiled_sheets(dpi)
        yield overlaid_sheets(dpi)


def rasteriser_figures() -> list[Figure]:
    """Rasterise sheets in all rasterisers, and count the dots that are on their pixels."""
    try:
        with requires_extra("pdf", "an overlay"):
            import pikepdf  # noqa: F401
    except LocatkError as error:
        return [row for item in RASTERISERS for row in _figures(item.name, {}, None, error)]
    usable = [rasteriser for rasteriser in RASTERISERS if not rasteriser.missing()]
    reasons: dict[str, object] = {item.name: item.missing() for item in RASTERISERS}
    percents: dict[str, dict[str, float]] = {item.name: {} for item in RASTERISERS}
    seconds: dict[str, float] = {}
    for sheets in printed_sheets():
        expected = [expected_page(sheets.manifest, n) for n in range(len(sheets.manifest.sheets))]
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "sheets.pdf"
            sheets.write(path)
            for rasteriser in usable:
                name = rasteriser.name
                is_large = max(expected[0].shape) > (rasteriser.max_side_px or math.inf)
                is_slow = sheets.name == TIMED_SHEET and name in SLOW_RASTERISERS
                if is_large or (is_slow and not is_study()):
                    continue
                (own_folder := Path(folder) / name).mkdir()
                begin = time.perf_counter()
                try:
                    pages = list(rasteriser.rasterise(path, sheets.manifest.dpi, own_folder))
                except (LocatkError, OSError) as error:
                    percents[name][f"{sheets.name}, {error}"] = 0.0
                    continue
                if sheets.name == TIMED_SHEET:
                    seconds[name] = time.perf_counter() - begin
                percents[name][sheets.name] = exact_percent(sheets.manifest, expected, pages)
    rows = []
    for name, values in percents.items():
        rows += _figures(name, values, seconds.get(name), reasons[name])
    return rows


def _figures(
    name: str, percents: dict[str, float], seconds: float | None, reason: object
) -> list[Figure]:
    """Return the figures of a rasteriser: the lowest of the percentages, and the duration."""
    exact = Figure(f"{name}: dots on their pixels", None, "%", "", 100.0, "higher")
    how = "once, with the start of the program"
    duration = Figure(f"{name}: {TIMED_SHEET} rasterised", seconds, "s", how)
    if reason:
        return [exact.missing(reason), duration.missing(reason)]
    lowest = min(percents, key=lambda sheet: percents[sheet])
    how = f"dots that are black on exactly their pixels, lowest of {len(percents)} sheets: {lowest}"
    exact = replace(exact, value=percents[lowest], how=how)
    return [exact, duration if seconds else duration.missing(f"set {STUDY_VARIABLE}=1")]


def expected_page(manifest: Manifest, number: int) -> Grey:
    """Return the page of a sheet as its PBM."""
    stream = io.BytesIO()
    rasters.write_pbm(stream, manifest, number)
    image = cv2.imdecode(np.frombuffer(stream.getbuffer(), np.uint8), cv2.IMREAD_GRAYSCALE)
    return np.asarray(image, np.uint8)


def exact_percent(manifest: Manifest, expected: Sequence[Grey], pages: Sequence[Grey]) -> float:
    """Return the percentage of dots whose cell of a pitch is exactly as expected.

    A missing page, or one of another size, has none.
    """
    exact = 0
    for number, (image, page) in enumerate(zip(expected, pages, strict=False)):
        if page.shape != image.shape:
            continue
        layout = pixels(manifest, number)
        (left, top, right, bottom), pitch = layout.box, layout.raster.pitch
        area = (slice(top, bottom), slice(left, right))
        is_wrong = (page[area] < DARK_GREY) != (image[area] < DARK_GREY)
        columns, rows = layout.size
        # The box is smaller than the cells of its dots by the gap to further dots.
        gaps = ((0, rows * pitch - (bottom - top)), (0, columns * pitch - (right - left)))
        cells = np.pad(is_wrong, gaps).reshape(rows, pitch, columns, pitch)
        exact += int((~cells.any(axis=(1, 3))).sum())
    return 100 * exact / sum(math.prod(sheet.size) for sheet in manifest.sheets)
