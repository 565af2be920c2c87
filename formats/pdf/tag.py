"""Placement templates of tags as a PDF."""

from __future__ import annotations

from collections.abc import Sequence

from locatk.core.drawing import Page
from locatk.formats.pdf.drawings import bind, sheets


def render(pages: Sequence[Page], title: str) -> bytes:
    """A PDF of drawings at true size; see :func:`.drawings.bind`."""
    return bind(sheets(pages), title, hint="Use a smaller paper, or --format svg")
