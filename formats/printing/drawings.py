"""Drawings at true size as the pages of a PDF."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Sequence
from functools import partial

from reportlab.lib.units import mm
from reportlab.pdfgen.canvas import Canvas

from locatk.core.drawing import Page, Point
from locatk.core.landmarks.drawing.true_size import FloorPage
from locatk.formats.printing import page

SMALLER_PAPER_HINT = "Use a smaller paper"
"""Remedy for a page that is longer than a PDF may be."""


def render_pages(
    pages: Sequence[Page],
    title: str,
    *,
    hint: str = SMALLER_PAPER_HINT,
    done: Callable[[], object] = lambda: None,
) -> bytes:
    """Render drawings as a PDF that viewers print at 100 %.

    The same pages give the same bytes. ``done`` is called after each page.

    Raises
    ------
    InputError
        A page is longer than a PDF may be; ``hint`` is the remedy.
    """
    drawers = [(drawing.size_mm, partial(_draw_page, drawing)) for drawing in pages]
    return _render(drawers, title, hint, done)


def render_floor(
    pages: Sequence[FloorPage], title: str, *, done: Callable[[], object] = lambda: None
) -> bytes:
    """Render a floor at true size as a PDF, one page a tile, with rulers and joining marks.

    See :func:`render_pages`.
    """
    drawers = [(floor_page.size_mm, partial(_draw_tile, floor_page)) for floor_page in pages]
    return _render(drawers, title, SMALLER_PAPER_HINT, done)


def _render(
    drawers: Iterable[tuple[Point, Callable[[Canvas], None]]],
    title: str,
    hint: str,
    done: Callable[[], object],
) -> bytes:
    """Render pages, each given by its size and by the function that draws it."""
    stream = io.BytesIO()
    canvas = page.open_document(stream, title)
    for size_mm, draw in drawers:
        page.start_page(canvas, size_mm, hint=hint)
        draw(canvas)
        canvas.showPage()
        done()
    canvas.save()
    return stream.getvalue()


def _draw_page(drawing: Page, canvas: Canvas) -> None:
    for group in drawing.groups:
        page.draw(canvas, group.marks)


def _draw_tile(floor_page: FloorPage, canvas: Canvas) -> None:
    """Draw the marks of a tile, clipped to its box, and the margin around it."""
    left, bottom, right, top = floor_page.tile.box
    canvas.saveState()
    path = canvas.beginPath()
    path.rect(left * mm, bottom * mm, (right - left) * mm, (top - bottom) * mm)
    canvas.clipPath(path, stroke=0, fill=0)
    page.draw(canvas, floor_page.marks)
    canvas.restoreState()
    box = page.Box(left, bottom, right, top)
    page.furnish(canvas, box, floor_page.notes, floor_page.tile.seams, marks=True, crop=False)
