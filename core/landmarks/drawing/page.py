"""What the pages of an installation pack have in common: words above, rulers, a number."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from locatk.core.drawing import (
    CAPITAL_HEIGHT_EM,
    MM_PER_POINT,
    RULER_DEPTH_MM,
    Group,
    Line,
    Mark,
    Page,
    Point,
    Text,
    page_rulers,
    wrap,
)
from locatk.core.errors import InputError

TITLE, TEXT, SMALL = 10.0, 7.0, 5.0
"""Sizes of text in points."""

LEADING = 1.3
"""From line to line in sizes of the font."""

_NUMBER_MM = 34.0
"""Room for the number of a page."""


def line_mm(points: float) -> float:
    """From line to line."""
    return LEADING * points * MM_PER_POINT


@dataclass(frozen=True)
class Frame:
    """A paper with a title and lines of text above, rulers below and at the left."""

    size: Point
    margin: float
    title: str
    words: tuple[str, ...] = ()

    @property
    def box(self) -> tuple[float, float, float, float]:
        """Left, bottom, right and top of what is free."""
        edge = self.margin + RULER_DEPTH_MM + 2.0
        top = self.size[1] - self.margin - self._head_mm
        return edge, edge, self.size[0] - self.margin, top

    @property
    def _head_mm(self) -> float:
        return line_mm(TITLE) + len(self._lines) * line_mm(TEXT) + 2.0

    @property
    def _lines(self) -> list[str]:
        width = self.size[0] - 2 * self.margin
        return [line for text in self.words for line in wrap(text, TEXT, width)]

    def furniture(self, number: int, count: int) -> Group:
        """Everything around the box on page ``number`` of ``count``."""
        width, height = self.size
        marks = page_rulers(self.size, self.margin)
        top = height - self.margin - CAPITAL_HEIGHT_EM * TITLE * MM_PER_POINT
        title = wrap(self.title, TITLE, width - 2 * self.margin - _NUMBER_MM)[0]
        marks.append(Text(title, (self.margin, top), TITLE, bold=True))
        page = f"page {number} of {count}"
        marks.append(Text(page, (width - self.margin, top), TEXT, "end"))
        for index, text in enumerate(self._lines, 1):
            marks.append(Text(text, (self.margin, top - index * line_mm(TEXT)), TEXT))
        return Group("page", tuple(marks))


@dataclass(frozen=True)
class Leaf:
    """A page without its number."""

    frame: Frame
    groups: tuple[Group, ...]


def bind(leaves: Sequence[Leaf]) -> tuple[Page, ...]:
    """Pages with their numbers."""
    return tuple(
        Page(
            leaf.frame.size,
            (leaf.frame.furniture(number, len(leaves)), *leaf.groups),
        )
        for number, leaf in enumerate(leaves, 1)
    )


def check_margin(paper_mm: Point, margin_mm: float) -> None:
    """Refuse margins that leave nothing.

    Raises
    ------
    InputError
    """
    if not 0 <= margin_mm < min(paper_mm) / 2 - 10:
        raise InputError(f"a margin of {margin_mm:g} mm on {size_text(paper_mm)}")


def size_text(size_mm: Point) -> str:
    """Width and height for people."""
    return f"{size_mm[0]:g} x {size_mm[1]:g} mm"


def printable(text: str) -> str:
    """What the letters of a PDF's own fonts can show of a text."""
    return text.encode("cp1252", "replace").decode("cp1252")


@dataclass(frozen=True)
class Column:
    """Of a table: its head, its width, and on which side its words stand."""

    head: str
    width_mm: float
    right: bool = False


def table(
    rows: Sequence[Sequence[str]],
    columns: Sequence[Column],
    frame: Frame,
    *,
    points: float = TEXT,
    gap_mm: float = 8.0,
) -> list[Leaf]:
    """Rows under heads, in as many columns of the page, and pages, as they need."""
    left, bottom, right, top = frame.box
    width = sum(column.width_mm for column in columns)
    blocks = max(1, int((right - left + gap_mm) // (width + gap_mm)))
    step = line_mm(points)
    lines = max(1, int((top - bottom) / step - 1.5))
    leaves = []
    for start in range(0, max(1, len(rows)), blocks * lines):
        marks: list[Mark] = []
        for block in range(blocks):
            some = rows[start + block * lines : start + min(blocks, block + 1) * lines]
            if some:
                at = (left + block * (width + gap_mm), top)
                marks += _block(some, columns, at, points)
        leaves.append(Leaf(frame, (Group("table", tuple(marks)),)))
    return leaves


def _block(
    rows: Sequence[Sequence[str]], columns: Sequence[Column], at: Point, points: float
) -> list[Mark]:
    step = line_mm(points)
    width = sum(column.width_mm for column in columns)
    y = at[1] - 1.5 * step
    marks: list[Mark] = [Line((at[0], y + 0.35 * step), (at[0] + width, y + 0.35 * step), 0.2)]
    # The heads stand above the line, and a thin line after each fifth row leads the eye.
    for index, row in enumerate([[column.head for column in columns], *rows]):
        x = at[0]
        base = y + 0.35 * step + 0.35 * step if index == 0 else y - (index - 0.45) * step
        for text, column in zip(row, columns, strict=True):
            place = (x + column.width_mm - 1.0, base) if column.right else (x, base)
            anchor: Literal["start", "end"] = "end" if column.right else "start"
            marks.append(Text(text, place, points, anchor, bold=index == 0))
            x += column.width_mm
        if index and index % 5 == 0 and index < len(rows):
            rule = base - 0.3 * step
            marks.append(Line((at[0], rule), (at[0] + width, rule), 0.05))
    return marks
