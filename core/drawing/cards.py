"""Arrangement of equal cards, to be cut out, on the pages of one frame."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from locatk.core.drawing.marks import Box, Point

ROUNDING_MM = 1e-9
"""Excess of cards over the area that is due to the rounding of floating-point numbers."""


@dataclass(frozen=True)
class CardSlot:
    """Position of one card: its page, counted from 0, and its upper left corner on that page."""

    page: int
    corner_mm: Point


@dataclass(frozen=True)
class CardGrid:
    """Columns and rows of cards within an area of a page.

    Attributes
    ----------
    area_mm : (left, bottom, right, top)
    card_mm : (width, height)
    gap_mm : float
        Distance between neighbouring cards.
    columns, rows : int
    """

    area_mm: Box
    card_mm: Point
    gap_mm: float
    columns: int
    rows: int

    @classmethod
    def densest(cls, area_mm: Box, card_mm: Point, gap_mm: float) -> CardGrid:
        """Return the grid with as many cards as the area holds; possibly none."""
        left, bottom, right, top = area_mm
        columns = cards_along(right - left, card_mm[0], gap_mm)
        rows = cards_along(top - bottom, card_mm[1], gap_mm)
        return cls(area_mm, card_mm, gap_mm, columns, rows)

    @property
    def cards_per_page(self) -> int:
        return self.columns * self.rows

    def page_count(self, cards: int) -> int:
        """Return the number of pages that ``cards`` cards take."""
        return math.ceil(cards / self.cards_per_page)

    def slots(self, cards: int, *, centred: bool = False) -> Iterator[CardSlot]:
        """Yield the positions of cards, row by row from the upper left of each page.

        The grid is centred horizontally in the area. With ``centred``, a page with fewer cards than
        columns has its cards in the centre instead of the first columns.
        """
        left, _, right, top = self.area_mm
        width, height = self.card_mm
        for number in range(cards):
            page, index = divmod(number, self.cards_per_page)
            row, column = divmod(index, self.columns)
            page_cards = min(self.cards_per_page, cards - page * self.cards_per_page)
            columns = min(self.columns, page_cards) if centred else self.columns
            start = (left + right - columns * width - (columns - 1) * self.gap_mm) / 2
            x = start + column * (width + self.gap_mm)
            yield CardSlot(page, (x, top - row * (height + self.gap_mm)))


def cards_along(space_mm: float, side_mm: float, gap_mm: float) -> int:
    """Return how many cards of one side fit into a length, with gaps between them."""
    return max(0, int((space_mm + gap_mm + ROUNDING_MM) // (side_mm + gap_mm)))
