"""Pages of a printed pack: the frame around the content, flowing text, and tables.

The parts of a pack produce :class:`UnnumberedPage` objects; :func:`number_pages` adds the page
numbers when the whole pack is known.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from locatk.core.drawing.marks import (
    LINE_SPACING_EM,
    MIN_TEXT_POINTS,
    RULER_DEPTH_MM,
    Box,
    Group,
    Line,
    Mark,
    Page,
    Point,
    Text,
    capital_height,
    line_height,
    page_rulers,
    paragraph,
    rectangle,
    wrap,
)
from locatk.core.errors import InputError
from locatk.core.paper_sizes import PAPER_SIZES_MM

TITLE_POINTS = 10.0
"""Font size of titles."""

TEXT_POINTS = MIN_TEXT_POINTS
"""Font size of notes, tables, and labels within a drawing."""

FLOW_TEXT_POINTS = 9.0
"""Font size of flowing text, which is read at arm's length while working."""

FRAME_CLEARANCE_MM = 2.0
"""Distance of the content from the rulers and from the text above it."""

PAGE_NUMBER_WIDTH_MM = 30.0
"""Width that is reserved for the page number."""

MIN_CONTENT_MM = 20.0
"""Smallest side of a page that the margins may leave; rulers and their numbers need most of it."""

MAX_TEXT_PAPER_MM2 = 1.001 * PAPER_SIZES_MM["A3"][0] * PAPER_SIZES_MM["A3"][1]
"""Largest area of a paper on which text is still printed."""

GROUP_ROWS = 5
"""Number of rows of a table between two thin lines."""

GROUP_GAP_LINES = 0.4
"""Additional space between two groups of rows, which contains the thin line, in lines."""

DESCENDER_LINES = 0.25
"""Space for descenders below a row of a table, in lines."""

TICK_BOX_INDENT_MM = 8.0
"""Indentation of a paragraph with a box to tick."""


@dataclass(frozen=True)
class PageFrame:
    """Paper with a title and notes, rulers at the lower and left edge, and a page number.

    Attributes
    ----------
    size_mm : (width, height)
    margin_mm : float
        Width of the border that stays empty.
    title : str
    notes : tuple of str
        Paragraphs below the title.
    title_points : float
        Font size of the title.
    spacing_em : float
        Line height of title and notes, as a fraction of the font size.
    has_rulers : bool
        Whether the page has rulers, which pages at true size need.
    """

    size_mm: Point
    margin_mm: float
    title: str
    notes: tuple[str, ...] = ()
    title_points: float = TITLE_POINTS
    spacing_em: float = LINE_SPACING_EM
    has_rulers: bool = True

    @property
    def content_box(self) -> Box:
        """Left, bottom, right and top of the area for the content."""
        edge = self.margin_mm
        if self.has_rulers:
            edge += RULER_DEPTH_MM + FRAME_CLEARANCE_MM
        width, height = self.size_mm
        header = self._title_height + len(self._note_lines) * self._line(TEXT_POINTS)
        top = height - self.margin_mm - header - FRAME_CLEARANCE_MM
        return edge, edge, width - self.margin_mm, top

    def draw(self, number: int, count: int) -> Group:
        """Draw everything around the content of page ``number`` of ``count``."""
        left, right = self.margin_mm, self.size_mm[0] - self.margin_mm
        first_baseline = self.size_mm[1] - self.margin_mm - capital_height(self.title_points)
        top = first_baseline + self._line(self.title_points)
        notes_top = top - self._title_height
        return Group(
            "page",
            (
                *(page_rulers(self.size_mm, self.margin_mm) if self.has_rulers else ()),
                *self._paragraph(self._title_lines, (left, top), self.title_points, bold=True),
                Text(f"page {number} of {count}", (right, first_baseline), TEXT_POINTS, "end"),
                *self._paragraph(self._note_lines, (left, notes_top), TEXT_POINTS),
            ),
        )

    @property
    def _title_lines(self) -> list[str]:
        width = self.size_mm[0] - 2 * self.margin_mm - PAGE_NUMBER_WIDTH_MM
        return wrap(self.title, self.title_points, width)

    @property
    def _title_height(self) -> float:
        return len(self._title_lines) * self._line(self.title_points)

    @property
    def _note_lines(self) -> list[str]:
        width = self.size_mm[0] - 2 * self.margin_mm
        return [line for note in self.notes for line in wrap(note, TEXT_POINTS, width)]

    def _line(self, points: float) -> float:
        return line_height(points, self.spacing_em)

    def _paragraph(
        self, lines: Sequence[str], corner: Point, points: float, *, bold: bool = False
    ) -> list[Text]:
        return paragraph(lines, corner, points, spacing_em=self.spacing_em, bold=bold)


@dataclass(frozen=True)
class UnnumberedPage:
    """Page of a pack before the number of pages is known."""

    frame: PageFrame
    groups: tuple[Group, ...]


def number_pages(pages: Sequence[UnnumberedPage]) -> tuple[Page, ...]:
    """Draw the frames of all pages of a pack, with page numbers."""
    return tuple(
        Page(page.frame.size_mm, (page.frame.draw(number, len(pages)), *page.groups))
        for number, page in enumerate(pages, 1)
    )


def check_margin(paper_mm: Point, margin_mm: float, min_content_mm: float = MIN_CONTENT_MM) -> None:
    """Check that margins leave more than ``min_content_mm`` of a paper.

    Raises
    ------
    InputError
        The margin is negative or too large.
    """
    if not 0 <= margin_mm < (min(paper_mm) - min_content_mm) / 2:
        raise InputError(
            f"a margin of {margin_mm:g} mm leaves too little of a paper of {size_text(paper_mm)}",
            hint="Use a smaller margin or a larger paper",
        )


def text_paper(paper_mm: Point) -> Point:
    """Return the paper for the pages of text of a pack: A4 if that of its drawings is above A3."""
    is_large = paper_mm[0] * paper_mm[1] > MAX_TEXT_PAPER_MM2
    return PAPER_SIZES_MM["A4"] if is_large else paper_mm


def size_text(size_mm: Point, decimals: int | None = None) -> str:
    """Format width and height, as in ``"210 x 297 mm"``."""
    width, height = size_mm if decimals is None else (round(side, decimals) for side in size_mm)
    return f"{width:g} x {height:g} mm"


def larger_paper_text(paper_mm: Point, needed_mm: Point, available_mm: Point) -> str:
    """Format a paper on which ``needed_mm`` fits, as the command line names it: ``"142x196mm"``.

    Parameters
    ----------
    paper_mm : (width, height)
        Paper that is too small.
    needed_mm, available_mm : (width, height)
        Space that is needed, and the space that the paper leaves for it.
    """
    sides = (
        math.ceil(side + max(0.0, needed - available))
        for side, needed, available in zip(paper_mm, needed_mm, available_mm, strict=True)
    )
    return "x".join(map(str, sides)) + "mm"


def printable(text: str) -> str:
    """Replace the characters that the built-in fonts of PDF lack (all outside CP1252) by "?"."""
    return text.encode("cp1252", "replace").decode("cp1252")


class TextFlow:
    """Paragraphs and table rows from the top of a page down, continued on further pages."""

    def __init__(self, frame: PageFrame) -> None:
        self.frame = frame
        self._pages: list[list[Mark]] = [[]]
        self._y = frame.content_box[3]

    def add_space(self, height_mm: float) -> None:
        """Leave a vertical gap."""
        self._y -= height_mm

    def add_paragraph(
        self,
        text: str,
        *,
        points: float = FLOW_TEXT_POINTS,
        bold: bool = False,
        has_tick_box: bool = False,
    ) -> None:
        """Add wrapped text, optionally with a box to tick at its left."""
        left, _, right, _ = self.frame.content_box
        indent = TICK_BOX_INDENT_MM if has_tick_box else 0.0
        lines = wrap(text, points, right - left - indent)
        step = line_height(points)
        marks = self._marks_with_space(len(lines) * step)
        if has_tick_box:
            bottom, side = self._y - step, 0.75 * step
            marks.append(rectangle((left, bottom, left + side, bottom + side), 0.2))
        marks += paragraph(lines, (left + indent, self._y), points, bold=bold)
        self._y -= len(lines) * step

    def add_row(
        self, cells: Sequence[str], widths_mm: Sequence[float], *, bold: bool = False
    ) -> None:
        """Add a row of a table.

        The columns have these widths; the last column takes the rest of the page and its text is
        wrapped.
        """
        left, _, right, _ = self.frame.content_box
        step = line_height(FLOW_TEXT_POINTS)
        lines = wrap(cells[-1], FLOW_TEXT_POINTS, right - left - sum(widths_mm)) or [""]
        marks = self._marks_with_space(len(lines) * step)
        x = left
        for text, width in zip(cells[:-1], widths_mm, strict=True):
            marks += paragraph([text], (x, self._y), FLOW_TEXT_POINTS, bold=bold)
            x += width
        marks += paragraph(lines, (x, self._y), FLOW_TEXT_POINTS, bold=bold)
        self._y -= len(lines) * step + 0.3 * step
        marks.append(Line((left, self._y), (right, self._y), 0.2 if bold else 0.05))
        self._y -= 0.1 * step

    def pages(self) -> list[UnnumberedPage]:
        """Return the pages written so far."""
        return [
            UnnumberedPage(self.frame, (Group("words", tuple(marks)),)) for marks in self._pages
        ]

    def _marks_with_space(self, height_mm: float) -> list[Mark]:
        """Return the marks of the current page, or of a new one if the height does not fit."""
        _, bottom, _, top = self.frame.content_box
        if self._y - height_mm < bottom:
            self._pages.append([])
            self._y = top
        return self._pages[-1]


@dataclass(frozen=True)
class TableColumn:
    """Column of a table: its head, its width, and the alignment of its text."""

    head: str
    width_mm: float
    is_right_aligned: bool = False


def table_pages(
    rows: Sequence[Sequence[str]],
    columns: Sequence[TableColumn],
    frame: PageFrame,
    *,
    points: float = TEXT_POINTS,
    gap_mm: float = 8.0,
) -> list[UnnumberedPage]:
    """Set rows in a table, in as many blocks side by side and on as many pages as needed."""
    left, bottom, right, top = frame.content_box
    width = sum(column.width_mm for column in columns)
    blocks_per_page = max(1, int((right - left + gap_mm) // (width + gap_mm)))
    # The head takes 1.5 lines.
    lines = (top - bottom) / line_height(points) - 1.5
    groups, rest = divmod(lines, GROUP_ROWS + GROUP_GAP_LINES)
    rows_per_block = max(1, int(groups) * GROUP_ROWS + min(GROUP_ROWS, int(rest)))
    rows_per_page = blocks_per_page * rows_per_block
    pages = []
    for page_start in range(0, max(1, len(rows)), rows_per_page):
        page_rows = rows[page_start : page_start + rows_per_page]
        marks: list[Mark] = []
        for block, start in enumerate(range(0, len(page_rows), rows_per_block)):
            corner = (left + block * (width + gap_mm), top)
            block_rows = page_rows[start : start + rows_per_block]
            marks += _draw_table_block(block_rows, columns, corner, points)
        pages.append(UnnumberedPage(frame, (Group("table", tuple(marks)),)))
    return pages


def _draw_table_block(
    rows: Sequence[Sequence[str]], columns: Sequence[TableColumn], corner: Point, points: float
) -> list[Mark]:
    """Draw the head and rows of a table from its upper left corner down."""
    step = line_height(points)
    left, right = corner[0], corner[0] + sum(column.width_mm for column in columns)
    head_line = corner[1] - 1.15 * step
    marks: list[Mark] = [Line((left, head_line), (right, head_line), 0.2)]
    for number, row in enumerate([[column.head for column in columns], *rows]):
        gap = (number - 1) // GROUP_ROWS * GROUP_GAP_LINES
        baseline = head_line - (number + gap - 0.1) * step if number else head_line + 0.35 * step
        x = left
        for text, column in zip(row, columns, strict=True):
            position = (x + column.width_mm - 1.0, baseline)
            anchor: Literal["start", "end"] = "end"
            if not column.is_right_aligned:
                position, anchor = (x, baseline), "start"
            marks.append(Text(text, position, points, anchor, bold=number == 0))
            x += column.width_mm
        # A thin line in the gap after each group guides the eye.
        if number and number % GROUP_ROWS == 0 and number < len(rows):
            y = baseline - (DESCENDER_LINES + GROUP_GAP_LINES / 2) * step
            marks.append(Line((left, y), (right, y), 0.05))
    return marks
