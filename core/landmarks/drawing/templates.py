"""Placement templates at true size: one card for each code that occurs on a floor."""

from __future__ import annotations

import math
from dataclasses import dataclass

from locatk.core.drawing import (
    CUT_MARK_MM,
    TRUE_SIZE_INSTRUCTION,
    Group,
    Line,
    Mark,
    Point,
    Polygon,
    Text,
    capital_height,
    cut_marks,
    line_height,
    paragraph,
    text_width,
    wrap,
)
from locatk.core.drawing.cards import CardGrid, cards_along
from locatk.core.drawing.pages import (
    TEXT_POINTS,
    TITLE_POINTS,
    PageFrame,
    UnnumberedPage,
    larger_paper_text,
    size_text,
)
from locatk.core.errors import InputError
from locatk.core.landmarks.drawing.landmark import (
    code_digit,
    draw_landmark,
    drawing_half_side,
    north_mark,
)
from locatk.core.landmarks.landmark import PATTERN_OF, name
from locatk.core.landmarks.map.floor import Cell, FloorMap
from locatk.core.units import mm_text

MAX_HALF_SIDE_MM = 100.0
"""Largest distance of an edge from the centre: longer lines do not align a landmark any better."""

CELL_LIST_LINES = 6
"""Lines of text that are reserved for the cells of a template when several share a page."""

MIN_CELL_LIST_LINES = 2
"""Lines of text that are reserved for the cells of a template that has a page of its own."""

CARD_GAP_MM = 2.0
"""Distance of the cut marks of neighbouring templates."""

NORTH_MARK_MM = 11.0
"""Height of the north mark in a corner of the template."""

NOTES = (
    f"{TRUE_SIZE_INSTRUCTION} Outlines: the bars; cut them out, or drill by the crosses. "
    "Arrow: to the bar's north pole, magnetised along it. "
    "A bar is N where that is counter-clockwise (ccw) around the landmark, else S.",
    "Lay the centre cross on the cell, the marks at the edges on the lines to its neighbours, "
    "and the arrow along the map's +y. Never turn a template.",
)


@dataclass(frozen=True)
class PlacedTemplate:
    """Position of a template in a pack.

    Attributes
    ----------
    code : int
    cells : int
        Number of cells with this code.
    page : int
        Page, counted from 0.
    centre_mm : (x, y)
        Centre of the landmark, from the lower left corner of the page.
    side_mm : float
        Side of the square that is cut out.
    """

    code: int
    cells: int
    page: int
    centre_mm: Point
    side_mm: float


def draw_templates(
    floor: FloorMap, title: str, paper_mm: Point, margin_mm: float, paper_name: str
) -> tuple[list[UnnumberedPage], list[PlacedTemplate]]:
    """Draw a template for each code that occurs, in ascending order of the codes.

    As many templates as possible share a page. The orientation of the paper is the one with the
    larger templates; if these are equal, the one with more templates on a page.

    Raises
    ------
    InputError
        A template is larger than the paper.
    """
    frames = [
        PageFrame(size_mm, margin_mm, f"{title}: placement templates, 1 : 1", NOTES)
        for size_mm in (paper_mm, paper_mm[::-1])
    ]
    min_half = drawing_half_side(floor.geometry)
    # Templates that end half way to the next cell touch each other when they are laid out.
    best_half = max(min_half + NORTH_MARK_MM, min(MAX_HALF_SIDE_MM, 0.5e3 * floor.pitch_m))
    halves = [min(best_half, _max_half_side(frame)) for frame in frames]
    choices = [
        (half, _template_grid(frame, half), frame)
        for frame, half in zip(frames, halves, strict=True)
        if half >= min_half
    ]
    if not choices:
        raise _too_small(frames[0], min_half, paper_name)
    half, grid, frame = max(choices, key=lambda choice: (choice[0], choice[1].cards_per_page))
    templates = [
        _Template(floor, code, cells, half) for code, cells in cells_by_code(floor).items()
    ]
    width, height = grid.card_mm
    groups: list[list[Group]] = [[] for _ in range(grid.page_count(len(templates)))]
    placed = []
    for template, slot in zip(templates, grid.slots(len(templates)), strict=True):
        top = (slot.corner_mm[0] + width / 2, slot.corner_mm[1])
        groups[slot.page].append(template.draw(top, height))
        centre = template.centre(top)
        placed.append(
            PlacedTemplate(template.code, len(template.cells), slot.page, centre, 2 * half)
        )
    return [UnnumberedPage(frame, tuple(page)) for page in groups], placed


def _max_half_side(frame: PageFrame) -> float:
    """Return half of the side of the largest template that a page holds with its texts."""
    available = _available_mm(frame)
    return math.floor(min(available)) / 2


def _available_mm(frame: PageFrame) -> Point:
    """Return width and height that a page leaves for one template, without its texts."""
    left, bottom, right, top = frame.content_box
    texts = _title_height() + _cell_list_height(MIN_CELL_LIST_LINES)
    return right - left - 2 * CUT_MARK_MM, top - bottom - texts - 2 * CUT_MARK_MM


def _too_small(frame: PageFrame, min_half: float, paper_name: str) -> InputError:
    side = float(math.ceil(2 * min_half))
    paper = larger_paper_text(frame.size_mm, (side, side), _available_mm(frame))
    return InputError(
        f"a template needs {side:.0f} x {side:.0f} mm and space for its texts, which paper "
        f"{paper_name} of {size_text(frame.size_mm)} does not have",
        hint=f"Use a larger paper, as in --paper {paper}",
    )


def _template_grid(frame: PageFrame, half: float) -> CardGrid:
    """Distribute templates evenly over a page; the space that is left lists their cells."""
    left, bottom, right, top = frame.content_box
    side, gap = 2 * half, 2 * CUT_MARK_MM + CARD_GAP_MM
    columns = max(1, cards_along(right - left - 2 * CUT_MARK_MM, side, gap))
    row_height = side + gap + _title_height() + _cell_list_height(CELL_LIST_LINES)
    rows = max(1, cards_along(top - bottom, row_height, 0.0))
    slot_mm = ((right - left) / columns, (top - bottom) / rows)
    return CardGrid(frame.content_box, slot_mm, 0.0, columns, rows)


def cells_by_code(floor: FloorMap) -> dict[int, list[Cell]]:
    """Return the codes that occur, ascending, with the cells of each, row by row."""
    cells: dict[int, list[Cell]] = {}
    for cell in floor.cells():
        cells.setdefault(int(floor.codes[cell]), []).append(cell)
    return dict(sorted(cells.items()))


def cells_text(cells: list[Cell]) -> str:
    """Format cells by row, as in ``row 0: 3, 5; row 2: 4``; the numbers are columns."""
    rows: dict[int, list[str]] = {}
    for row, column in cells:
        rows.setdefault(row, []).append(str(column))
    return "; ".join(f"row {row}: {', '.join(columns)}" for row, columns in rows.items())


def _title_height() -> float:
    return line_height(TITLE_POINTS) + 1.0


def _cell_list_height(lines: int) -> float:
    return (lines + 0.5) * line_height(TEXT_POINTS)


@dataclass(frozen=True)
class _Template:
    """Square of ``2 * half`` mm that is cut out, with a title above and its cells below."""

    floor: FloorMap
    code: int
    cells: list[Cell]
    half: float

    def centre(self, top: Point) -> Point:
        """Return the centre of the landmark if ``top`` is the middle of the upper edge."""
        return round(top[0], 3), round(top[1] - _title_height() - CUT_MARK_MM - self.half, 3)

    def draw(self, top: Point, height: float) -> Group:
        """Draw the template with the middle of its upper edge at ``top`` and this total height."""
        centre = self.centre(top)
        left, bottom = centre[0] - self.half, centre[1] - self.half
        notes = (f"code {code_digit(self.code)}", name(self.code))
        marks: list[Mark] = [
            *paragraph([self._title()], (left, top[1]), TITLE_POINTS, bold=True),
            *cut_marks(left, bottom, centre[0] + self.half, centre[1] + self.half),
            *self._lines_to_neighbours(centre),
            *draw_landmark(self.floor.geometry, self.code, centre, notes),
            *self._corner_notes(centre),
            *self._cell_list((left, bottom - CUT_MARK_MM), top[1] - height),
        ]
        return Group(f"code-{code_digit(self.code)}", tuple(marks))

    def _title(self) -> str:
        count = len(self.cells)
        number = int(PATTERN_OF[self.code])
        return (
            f"Code {code_digit(self.code)} = {name(self.code)} (pattern {number}): "
            f"{count} cell{'s' * (count != 1)}"
        )

    def _lines_to_neighbours(self, centre: Point) -> list[Mark]:
        """Draw dashed lines, with marks at the edges, half way to the next cell and at it."""
        x, y = centre
        half, pitch = self.half, 1e3 * self.floor.pitch_m
        marks: list[Mark] = []
        for u, v in ((1, 0), (0, 1), (-1, 0), (0, -1)):
            tip = (x + half * u, y + half * v)
            marks.append(Line((x, y), tip, 0.1, dash_mm=2.0))
            base_x, base_y = x + (half - 3.0) * u, y + (half - 3.0) * v
            triangle = (tip, (base_x - v, base_y - u), (base_x + v, base_y + u))
            marks.append(Polygon(triangle, filled=True))
            for distance, arm in ((pitch / 2, 3.0), (pitch, 5.0)):
                if drawing_half_side(self.floor.geometry) < distance < half - 1e-6:
                    tick_x, tick_y = x + distance * u, y + distance * v
                    start = (tick_x - arm * v, tick_y - arm * u)
                    end = (tick_x + arm * v, tick_y + arm * u)
                    marks.append(Line(start, end, 0.2))
        return marks

    def _corner_notes(self, centre: Point) -> list[Mark]:
        """Draw north mark and meaning of the edges in the corners, which are always free."""
        x, y = centre[0] - self.half + 2.0, centre[1] + self.half - 1.0 - NORTH_MARK_MM
        marks = north_mark((x + 2.5, y), NORTH_MARK_MM)
        width = max(self.half - 8.0, text_width("x" * 20, TEXT_POINTS))
        lines = wrap(self._edge_note(), TEXT_POINTS, width)
        bottom = centre[1] - self.half + 1.0 + capital_height(TEXT_POINTS)
        top = bottom + len(lines) * line_height(TEXT_POINTS)
        marks += paragraph(lines, (x, top), TEXT_POINTS)
        axis_label = (centre[0] + self.half - 4.5, centre[1] - capital_height(TEXT_POINTS) - 1.2)
        return [*marks, Text("+x", axis_label, TEXT_POINTS, "end", bold=True)]

    def _edge_note(self) -> str:
        pitch = mm_text(self.floor.pitch_m)
        if abs(self.half - 0.5e3 * self.floor.pitch_m) < 1e-6:
            return f"edge half way to the next cell ({pitch} mm)"
        return f"edge {mm_text(1e-3 * self.half)} mm from the centre, next cell {pitch} mm"

    def _cell_list(self, corner: Point, bottom: float) -> list[Text]:
        """List the cells in as many lines as fit between ``corner`` and ``bottom``."""
        text = f"For the cells (row: columns) {cells_text(self.cells)}"
        lines = wrap(text, TEXT_POINTS, 2 * self.half)
        max_lines = max(1, int((corner[1] - bottom) / line_height(TEXT_POINTS) - 0.3))
        if len(lines) > max_lines:
            lines = [*lines[: max_lines - 1], "... and more: see the marking list"]
        return paragraph(lines, corner, TEXT_POINTS)
