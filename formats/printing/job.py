"""Print job of dot sheets: draw them in a format, and write them with manifest and ledger."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO

from locatk.core.dots.design.ledger import Area
from locatk.core.dots.drawing.layout import Raster, SheetLayout, lay_out
from locatk.core.dots.drawing.tiles import SheetTiling, tiling
from locatk.core.dots.sheet import Manifest
from locatk.core.errors import InputError
from locatk.core.paper_sizes import paper_size
from locatk.formats.artifacts.ledger import Ledger
from locatk.formats.artifacts.sheets import dumps_manifest
from locatk.formats.extras import requires_extra
from locatk.formats.output import atomic_write
from locatk.formats.printing import rasters

Writer = Callable[[IO[bytes]], object]


@dataclass(frozen=True)
class DrawnSheets:
    """Sheets that can be written.

    Attributes
    ----------
    writers : sequence of callable
        One for each file; it writes the content to a stream.
    losses : tuple of str
        Parts of a document below the dots that could not be kept or recoloured.
    warning : str or None
        Property of that document that makes the dots hard to read.
    """

    writers: Sequence[Writer]
    losses: tuple[str, ...] = ()
    warning: str | None = None


def paper_layouts(
    paper: str,
    margin_mm: float,
    raster: Raster,
    *,
    landscape: bool | None,
    count: int,
    tiles: tuple[int, int] | None,
    overlap_mm: float,
) -> Sequence[SheetLayout | SheetTiling]:
    """Return the layouts of ``count`` equal sheets, or of one floor of (columns, rows) tiles.

    Raises
    ------
    InputError
        The paper is unknown or too small for dots.
    """
    _, size_mm = paper_size(paper, landscape=landscape)
    layout = lay_out(size_mm, margin_mm, raster)
    return [layout] * count if tiles is None else [tiling(layout, tiles, overlap_mm)]


def page_layouts(
    document: Path, margin_mm: float, raster: Raster
) -> Sequence[SheetLayout | SheetTiling]:
    """Return the layouts of sheets that are printed over the pages of a PDF.

    Raises
    ------
    FormatError, MissingDataError
        See :func:`locatk.formats.printing.overlay.page_sizes`.
    InputError
        A page is too small for dots.
    LocatkError
        pikepdf is not installed.
    """
    with requires_extra("pdf", "an overlay", file=document):
        from locatk.formats.printing.overlay import page_sizes

    layouts = []
    for number, size in enumerate(page_sizes(document), 1):
        try:
            layouts.append(lay_out(size, margin_mm, raster))
        except InputError as error:
            raise InputError(
                error.message, file=document, where=f"page {number}", hint=error.hint
            ) from None
    return layouts


def count_steps(manifest: Manifest, document: Path | None = None) -> int:
    """Return how often :func:`draw` and its writers call ``done``."""
    return rasters.count_bands(manifest) + (len(manifest.sheets) if document else 0)


def draw(
    manifest: Manifest,
    format_name: str,
    *,
    marks: bool = True,
    crop: bool = False,
    document: Path | None = None,
    strip_black: bool = False,
    done: Callable[[], object] = lambda: None,
) -> DrawnSheets:
    """Draw sheets as ``"pdf"``, one file with a page a sheet, or as one file for each.

    Parameters
    ----------
    manifest : Manifest
    format_name : str
        ``"pdf"`` or one of :data:`locatk.formats.printing.rasters.WRITERS`.
    marks, crop : bool
        Of PDFs; see :func:`locatk.formats.printing.pattern.render`.
    document : path, optional
        PDF below the dots, a page a sheet.
    strip_black : bool
        Replace its black ink by the other three inks.
    done : callable
        Called :func:`steps` times in all.

    Raises
    ------
    InputError
        The sheets cannot be drawn in this format.
    FormatError, MissingDataError
        The document cannot be read.
    LocatkError
        There is a document, but pikepdf is not installed.
    """
    if format_name != "pdf":
        write = rasters.WRITERS[format_name]
        numbers = range(len(manifest.sheets))
        return DrawnSheets(
            [partial(write, manifest=manifest, number=n, done=done) for n in numbers]
        )
    from locatk.formats.printing.pattern import render  # imports reportlab, only for PDF

    data = render(manifest, marks=marks, crop=crop, done=done)
    if document is None:
        return DrawnSheets([lambda stream: stream.write(data)])
    with requires_extra("pdf", "an overlay", file=document):
        from locatk.formats.printing.overlay import overlay

    def page_done(number: int, count: int) -> None:
        done()

    merged = overlay(document, data, strip_black=strip_black, progress=page_done)
    losses = []
    if merged.left_black:
        kept = ", ".join(f"{count} {kind}" for kind, count in merged.left_black.items())
        losses.append(f"{document} keeps black in {kept}")
    if merged.dropped:
        losses.append(f"{document} has comments that cannot be drawn: {merged.dropped} left out")
    warning = None
    if merged.black_pages:
        count = f"{merged.black_pages} of {merged.pages} pages"
        warning = (
            f"{document} has black or grey on {count}, which hides the dots from cameras. "
            "Hint: Print it in the other inks with --strip-black"
        )
    return DrawnSheets([lambda stream: stream.write(merged.data)], tuple(losses), warning)


def publish(
    outputs: Sequence[tuple[Path, Writer]],
    manifest_path: Path,
    manifest: Manifest,
    ledger: Ledger,
    areas: Sequence[Area],
    *,
    overwrite: bool = False,
) -> None:
    """Write sheets, their manifest and their areas.

    All files are written completely before the first one appears, in the order ledger, manifest,
    sheets. Each sheet on disk therefore has its area in the ledger and its manifest; after an
    interruption the ledger may contain an area that no sheet uses.

    Parameters
    ----------
    outputs : sequence of (path, callable)
        Files of sheets; the callable writes the content to a stream.
    manifest_path : path
    manifest : Manifest
    ledger : Ledger
    areas : sequence of Area
        Areas to add to the ledger.
    overwrite : bool

    Raises
    ------
    OutputExistsError, MissingDataError, LocatkError
        See :func:`locatk.formats.output.atomic_write`; at most the ledger is then written.
    """
    text = dumps_manifest(manifest).encode()
    with contextlib.ExitStack() as stack:
        # The stack closes files in reverse order: the one opened last appears first.
        for path, write in reversed(outputs):
            stream = stack.enter_context(atomic_write(path, overwrite=overwrite))
            write(stream)
            stream.flush()
        stream = stack.enter_context(atomic_write(manifest_path, overwrite=overwrite))
        stream.write(text)
        stream.flush()
        ledger.add(areas)
