"""A panel: one thing that a report shows, whoever made it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from plotly.graph_objects import Figure


@dataclass(frozen=True)
class Table:
    """Rows under a header; every cell is text as it shall appear."""

    header: tuple[str, ...]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True)
class Picture:
    """An image (PNG) with a line beneath it."""

    png: bytes
    caption: str


@dataclass(frozen=True)
class Panel:
    """A part of a report under a heading of its own.

    Attributes
    ----------
    title : str
    note : str
        A sentence or two beneath the heading, as plain text.
    figure : plotly Figure or None
    table : Table or None
    pictures : tuple of Picture
        In a row, beneath the figure.
    """

    title: str
    note: str = ""
    figure: Figure | None = None
    table: Table | None = None
    pictures: tuple[Picture, ...] = ()
