"""Panels of a report, its tables and pictures, and the text in them."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from plotly.graph_objects import Figure

from locatk.core.printable import escape_controls


@dataclass(frozen=True)
class Table:
    """Table of formatted cells.

    Attributes
    ----------
    header : tuple of str
        Empty strings if the table has no header.
    rows : sequence of sequences of str
    omitted : int
        Number of rows that were left out at the end.
    """

    header: tuple[str, ...]
    rows: Sequence[Sequence[str]]
    omitted: int = 0


@dataclass(frozen=True)
class Picture:
    """Image (PNG) with a caption."""

    png: bytes
    caption: str


@dataclass(frozen=True)
class Panel:
    """Part of a report under its own heading.

    Attributes
    ----------
    title : str
    note : str
        One or several sentences of plain text below the heading.
    figure : plotly Figure or None
    table : Table or None
    pictures : tuple of Picture
        In rows, below the figure.
    """

    title: str
    note: str = ""
    figure: Figure | None = None
    table: Table | None = None
    pictures: tuple[Picture, ...] = ()


def join_sentences(*sentences: str) -> str:
    """Return one paragraph of the sentences that are not empty."""
    return " ".join(filter(None, sentences))


def join_names(names: Sequence[str], limit: int = 5) -> str:
    """Return at most ``limit`` names separated by commas, and the number of the others."""
    omitted = len(names) - limit
    return ", ".join(names[:limit]) + (f" and {omitted} more" if omitted > 0 else "")


def escape(text: object) -> str:
    """Escape text for plotly, which interprets names of devices as HTML."""
    return html.escape(escape_controls(str(text), keep="\n"), quote=False)


def reason_text(reason: str | None) -> str:
    """Return a reason code of a solver in words."""
    return (reason or "").replace("_", " ")


def format_value(value: float | None, scale: float, spec: str) -> str:
    """Format ``scale * value``; "-" if the value is unknown."""
    if value is None or not math.isfinite(value):
        return "-"
    return format(value * scale, spec)


def as_float(value: Any) -> float:
    """Return a number of a detection; ``nan`` if it is unknown."""
    return math.nan if value is None else float(value)
