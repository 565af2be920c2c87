"""A print job: sheets drawn in a format, and put on the disk with manifest and ledger."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO

from locatk.core.dots.design.ledger import Area
from locatk.core.dots.drawing.layout import Raster, SheetLayout, lay_out
from locatk.core.dots.sheet import Manifest
from locatk.core.errors import InputError
from locatk.formats.artifacts.ledger import Ledger
from locatk.formats.artifacts.sheets import dumps_manifest
from locatk.formats.output import atomic_write
from locatk.formats.printing import rasters

Writer = Callable[[IO[bytes]], object]


@dataclass(frozen=True)
class Drawn:
    """Sheets that can be written.

    Attributes
    ----------
    writers : sequence of callable
        One a file; each writes its content to the stream that it is given.
    losses : tuple of str
        What of a document under the dots could not be kept or recoloured.
    """

    writers: Sequence[Writer]
    losses: tuple[str, ...] = ()


def page_layouts(document: Path, margin_mm: float, raster: Raster) -> list[SheetLayout]:
    """Layouts of sheets that go over the pages of a PDF.

    Raises
    ------
    FormatError, MissingDataError
        See :func:`locatk.formats.printing.overlay.page_sizes`.
    InputError
        A page has no room for dots.
    """
    from locatk.formats.printing.overlay import page_sizes

    layouts = []
    for number, size in enumerate(page_sizes(document), 1):
        try:
            layouts.append(lay_out(size, margin_mm, raster))
        except InputError as error:
            where = f"page {number}"
            raise InputError(error.message, file=document, where=where, hint=error.hint) from None
    return layouts


def steps(manifest: Manifest, document: Path | None = None) -> int:
    """How often :func:`draw` and its writers call ``done``."""
    return rasters.bands(manifest) + (len(manifest.sheets) if document else 0)


def draw(
    manifest: Manifest,
    format_name: str,
    *,
    marks: bool = True,
    crop: bool = False,
    document: Path | None = None,
    strip_black: bool = False,
    done: Callable[[], object] = lambda: None,
) -> Drawn:
    """Draw sheets as ``"pdf"``, one file with a page a sheet, or ``"png"`` or ``"txt"``.

    Parameters
    ----------
    manifest : Manifest
    format_name : str
    marks, crop : bool
        Of PDFs; see :func:`locatk.formats.printing.pattern.render`.
    document : path, optional
        PDF below the dots, a page a sheet.
    strip_black : bool
        Make its black of the other three inks.
    done : callable
        Called :func:`steps` times in all.

    Raises
    ------
    InputError
        The sheets cannot be drawn so.
    FormatError, MissingDataError
        The document cannot be read.
    """
    if format_name != "pdf":
        write = rasters.write_png if format_name == "png" else rasters.write_text
        numbers = range(len(manifest.sheets))
        return Drawn([partial(write, manifest=manifest, number=n, done=done) for n in numbers])
    from locatk.formats.printing.pattern import render  # reportlab: not for the other formats

    data = render(manifest, marks=marks, crop=crop, done=done)
    if document is None:
        return Drawn([lambda stream: stream.write(data)])
    from locatk.formats.printing.overlay import overlay

    def page_done(number: int, count: int) -> None:
        done()

    made = overlay(document, data, strip_black=strip_black, progress=page_done)
    losses = []
    if made.left_black:
        kept = ", ".join(f"{count} {what}" for what, count in made.left_black.items())
        losses.append(f"{document} keeps black in {kept}")
    if made.dropped:
        losses.append(f"{document} has comments that cannot be drawn: {made.dropped} left out")
    return Drawn([lambda stream: stream.write(made.data)], tuple(losses))


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

    All is written whole before anything appears, and then appears in the order ledger,
    manifest, sheets. So a sheet that is on the disk has its area in the ledger and its
    manifest beside it; what an interrupt can leave behind is an area that no sheet uses.

    Parameters
    ----------
    outputs : sequence of (path, callable)
        Files of sheets; the callable writes the content to the stream it is given.
    manifest_path : path
    manifest : Manifest
    ledger : Ledger
    areas : sequence of Area
        To add to the ledger.
    overwrite : bool

    Raises
    ------
    OutputExistsError, MissingDataError, LocatkError
        See :func:`locatk.formats.output.atomic_write`; then nothing is written but the
        ledger, at most.
    """
    text = dumps_manifest(manifest).encode()
    with contextlib.ExitStack() as stack:
        # A stack unwinds from its end: what is opened last appears first.
        for path, write in reversed(outputs):
            stream = stack.enter_context(atomic_write(path, overwrite=overwrite))
            write(stream)
            stream.flush()
        stream = stack.enter_context(atomic_write(manifest_path, overwrite=overwrite))
        stream.write(text)
        stream.flush()
        ledger.add(areas)
