"""Placement templates of tags as a PDF."""

from __future__ import annotations

import io
from collections.abc import Sequence

from locatk.core.drawing import Page
from locatk.formats.pdf import page


def render(pages: Sequence[Page], title: str) -> bytes:
    """A PDF of drawings at true size, which viewers print at 100 %.

    The same drawings give the same bytes.

    Raises
    ------
    InputError
        A page is longer than a PDF may be.
    """
    stream = io.BytesIO()
    canvas = page.open_document(stream, title)
    for drawn in pages:
        page.start_page(canvas, drawn.size_mm, hint="Use a smaller paper, or --format svg")
        for group in drawn.groups:
            page.draw(canvas, group.marks)
        canvas.showPage()
    canvas.save()
    return stream.getvalue()
