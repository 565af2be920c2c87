"""Line drawings as the pages of a PDF, at true size."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Sequence
from functools import partial

from reportlab.pdfgen.canvas import Canvas

from locatk.core.drawing import Page, Point
from locatk.formats.pdf import page

Sheet = tuple[Point, Callable[[Canvas], object]]
"""Size of a page in mm, and what draws on it."""


def bind(
    sheets: Iterable[Sheet],
    title: str,
    *,
    hint: str = "Use a smaller paper",
    done: Callable[[], object] = lambda: None,
) -> bytes:
    """A PDF of these pages, which viewers print at 100 %.

    The same pages give the same bytes. ``done`` is called after each.

    Raises
    ------
    InputError
        A page is longer than a PDF may be; ``hint`` says what to do.
    """
    stream = io.BytesIO()
    canvas = page.open_document(stream, title)
    for size_mm, draw in sheets:
        page.start_page(canvas, size_mm, hint=hint)
        draw(canvas)
        canvas.showPage()
        done()
    canvas.save()
    return stream.getvalue()


def sheets(pages: Sequence[Page]) -> list[Sheet]:
    """Drawings for :func:`bind`."""
    return [(drawn.size_mm, partial(_draw, drawn)) for drawn in pages]


def _draw(drawn: Page, canvas: Canvas) -> None:
    for group in drawn.groups:
        page.draw(canvas, group.marks)
