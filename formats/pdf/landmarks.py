"""Installation packs of landmark floors, and floors at true size, as a PDF."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from reportlab.lib.units import mm
from reportlab.pdfgen.canvas import Canvas

from locatk.core.drawing import Page
from locatk.core.landmarks.drawing.true_size import Tile
from locatk.formats.pdf import page
from locatk.formats.pdf.drawings import bind, sheets


def render(
    pages: Sequence[Page], title: str, *, done: Callable[[], object] = lambda: None
) -> bytes:
    """A PDF of drawings at true size; see :func:`.drawings.bind`."""
    return bind(sheets(pages), title, done=done)


def render_floor(
    tiles: Sequence[Tile], title: str, *, done: Callable[[], object] = lambda: None
) -> bytes:
    """A PDF of a floor at true size, a page a tile, with rulers and joining marks; see
    :func:`.drawings.bind`."""
    return bind([(tile.size_mm, partial(_draw_tile, tile)) for tile in tiles], title, done=done)


def _draw_tile(tile: Tile, canvas: Canvas) -> None:
    box = page.Box(*tile.box)
    _draw_within(canvas, tile, box)
    seams = (list(tile.seams[0]), list(tile.seams[1]))
    page.furnish(canvas, box, tile.words, seams, marks=True, crop=False)


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
