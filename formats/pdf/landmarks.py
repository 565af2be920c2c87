"""Installation packs of landmark floors, and floors at true size, as a PDF."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence

from reportlab.lib.units import mm
from reportlab.pdfgen.canvas import Canvas

from locatk.core.drawing import Page
from locatk.core.landmarks.pack_floor import Tile
from locatk.formats.pdf import page

_HINT = "Use a smaller paper"


def render(
    pages: Sequence[Page], title: str, *, done: Callable[[], object] = lambda: None
) -> bytes:
    """A PDF of drawings at true size, which viewers print at 100 %.

    The same drawings give the same bytes. ``done`` is called after each page.

    Raises
    ------
    InputError
        A page is longer than a PDF may be.
    """
    stream = io.BytesIO()
    canvas = page.open_document(stream, title)
    for drawn in pages:
        page.start_page(canvas, drawn.size_mm, hint=_HINT)
        for group in drawn.groups:
            page.draw(canvas, group.marks)
        canvas.showPage()
        done()
    canvas.save()
    return stream.getvalue()


def render_floor(
    tiles: Sequence[Tile], title: str, *, done: Callable[[], object] = lambda: None
) -> bytes:
    """A PDF of a floor at true size, a page a tile, with rulers and joining marks.

    Raises
    ------
    InputError
        A page is longer than a PDF may be.
    """
    stream = io.BytesIO()
    canvas = page.open_document(stream, title)
    for tile in tiles:
        page.start_page(canvas, tile.size_mm, hint=_HINT)
        box = page.Box(*tile.box)
        _draw_within(canvas, tile, box)
        seams = (list(tile.seams[0]), list(tile.seams[1]))
        page.furnish(canvas, box, tile.words, seams, marks=True, crop=False)
        canvas.showPage()
        done()
    canvas.save()
    return stream.getvalue()


def _draw_within(canvas: Canvas, tile: Tile, box: page.Box) -> None:
    """The marks of a tile, and nothing of them beyond its box."""
    canvas.saveState()
    path = canvas.beginPath()
    path.rect(
        box.left * mm, box.bottom * mm, (box.right - box.left) * mm, (box.top - box.bottom) * mm
    )
    canvas.clipPath(path, stroke=0, fill=0)
    page.draw(canvas, tile.marks)
    canvas.restoreState()
