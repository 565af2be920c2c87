"""Placement templates at true size: one for each way in which a landmark is laid."""

from __future__ import annotations

import math
from dataclasses import dataclass

from locatk.core.drawing import (
    CAPITAL_HEIGHT_EM,
    CUT_MARK_MM,
    MM_PER_POINT,
    TRUE_SIZE,
    Group,
    Line,
    Mark,
    Point,
    Polygon,
    Text,
    cut_marks,
    text_width,
    wrap,
)
from locatk.core.errors import InputError
from locatk.core.landmarks.drawing.landmark import card_mm, digit, draw_landmark, north_mark
from locatk.core.landmarks.drawing.page import (
    SMALL,
    TEXT,
    TITLE,
    Frame,
    Leaf,
    line_mm,
    size_text,
)
from locatk.core.landmarks.landmark import PATTERN_OF, name
from locatk.core.landmarks.map.floor import Cell, FloorMap
from locatk.core.units import mm_text

LARGEST_MM = 100.0
"""From a template's centre to its edge; a longer line turns a landmark no more exactly."""

LIST_LINES = 6
"""For the cells of a template, where the paper has no room for more."""

_GAP_MM = 2 * CUT_MARK_MM + 2.0
_NORTH_MM = 11.0

WORDS = (
    f"{TRUE_SIZE} Outlines: the bars; cut them out, or drill by the crosses. "
    "Arrow: to the bar's north pole, magnetised along it. "
    "A bar is N where that is counter-clockwise (ccw) around the landmark, else S.",
    "Lay the centre cross on the cell, the marks at the edges on the lines to its neighbours, "
    "and the arrow along the map's +y. Never turn a template.",
)


@dataclass(frozen=True)
class PlacedTemplate:
    """Which template lies where.

    Attributes
    ----------
    code : int
    cells : int
        How many it is for.
    page : int
        Of the templates' pages, counted from 0.
    centre_mm : (x, y)
        Of the landmark, from the page's lower left corner.
    side_mm : float
        Of the square that is cut out around it.
    """

    code: int
    cells: int
    page: int
    centre_mm: Point
    side_mm: float


def template_leaves(
    floor: FloorMap, title: str, paper_mm: Point, margin_mm: float, paper_name: str
) -> tuple[list[Leaf], list[PlacedTemplate]]:
    """Pages with a template for each code that occurs, in their order, to be cut out.

    As many as fit share a page; each says how many cells it is for and which.

    Raises
    ------
    InputError
        A template is larger than the paper.
    """
    cells = cells_by_code(floor)
    least = card_mm(floor.geometry)
    # A template that ends half way to the next cell meets its neighbour's edge.
    wanted = max(least + _NORTH_MM, min(LARGEST_MM, 0.5e3 * floor.pitch_m))
    frames = [
        Frame(size, margin_mm, f"{title}: placement templates, 1 : 1", WORDS)
        for size in (paper_mm, paper_mm[::-1])
    ]
    roomy = [(frame, half) for frame in frames if (half := min(wanted, _most(frame))) >= least]
    if not roomy:
        box = frames[0].box
        lost = (paper_mm[0] - (box[2] - box[0]), paper_mm[1] - (box[3] - box[1]))
        enough = [math.ceil(2 * least + 2 * CUT_MARK_MM + side) for side in lost]
        enough[1] = math.ceil(enough[1] + _head_mm() + _list_mm(2))
        raise InputError(
            f"a template needs {2 * least:.0f} x {2 * least:.0f} mm and words beside it, more than "
            f"paper {paper_name} of {size_text(paper_mm)} has room for",
            hint=f"Use a larger paper, as in --paper {enough[0]}x{enough[1]}mm",
        )
    # The larger template first, then the fewer pages, then the paper as it is.
    frame, half = min(roomy, key=lambda way: (-way[1], -math.prod(_grid(*way))))
    across, down = _grid(frame, half)
    left, bottom, right, top = frame.box
    height = (top - bottom) / down
    cards = [_Card(floor, code, found, half) for code, found in cells.items()]
    leaves: list[Leaf] = []
    placed = []
    for start in range(0, len(cards), across * down):
        groups = []
        for index, card in enumerate(cards[start : start + across * down]):
            row, column = divmod(index, across)
            above = (left + (right - left) * (column + 0.5) / across, top - row * height)
            groups.append(card.group(above, height))
            centre = card.centre(above)
            placed.append(PlacedTemplate(card.code, len(card.cells), len(leaves), centre, 2 * half))
        leaves.append(Leaf(frame, tuple(groups)))
    return leaves, placed


def _most(frame: Frame) -> float:
    """Half of the side of the largest template that a page holds with its words."""
    left, bottom, right, top = frame.box
    room = (right - left, top - bottom - _head_mm() - _list_mm(2))
    return math.floor(min(room) - 2 * CUT_MARK_MM) / 2


def _grid(frame: Frame, half: float) -> tuple[int, int]:
    """Templates across and down."""
    left, bottom, right, top = frame.box
    across = int((right - left + 2.0) // (2 * half + _GAP_MM))
    down = int((top - bottom) // (2 * half + _GAP_MM + _head_mm() + _list_mm()))
    return max(1, across), max(1, down)


def cells_by_code(floor: FloorMap) -> dict[int, list[Cell]]:
    """Codes that are laid, ascending, and the cells of each, row by row."""
    found: dict[int, list[Cell]] = {}
    for cell in floor.cells():
        found.setdefault(int(floor.codes[cell]), []).append(cell)
    return dict(sorted(found.items()))


def cells_text(cells: list[Cell]) -> str:
    """Cells in short: ``row 0: 3, 5; row 2: 4``, the numbers being columns."""
    rows: dict[int, list[str]] = {}
    for row, column in cells:
        rows.setdefault(row, []).append(str(column))
    return "; ".join(f"row {row}: {', '.join(columns)}" for row, columns in rows.items())


def _head_mm() -> float:
    return line_mm(TITLE) + 1.0


def _list_mm(lines: int = LIST_LINES) -> float:
    return (lines + 0.5) * line_mm(TEXT)


@dataclass(frozen=True)
class _Card:
    """A square that is cut out, from ``-half`` to ``half`` mm, its title above and its cells
    below."""

    floor: FloorMap
    code: int
    cells: list[Cell]
    half: float

    def centre(self, top: Point) -> Point:
        """Of the landmark, where the middle of the upper edge is at ``top``."""
        return round(top[0], 3), round(top[1] - _head_mm() - CUT_MARK_MM - self.half, 3)

    def group(self, top: Point, height: float) -> Group:
        """With the middle of its upper edge at ``top`` and this much room below."""
        x, y = self.centre(top)
        edges = (x - self.half, y - self.half, x + self.half, y + self.half)
        words = (f"code {digit(self.code)}", name(self.code))
        marks: list[Mark] = [
            Text(self._title(), (edges[0], top[1] - line_mm(TITLE)), TITLE, bold=True),
            *cut_marks(*edges),
            *self._lines((x, y)),
            *draw_landmark(self.floor.geometry, self.code, (x, y), words),
            *self._corners((x, y)),
            *self._list((edges[0], edges[1] - CUT_MARK_MM), top[1] - height),
        ]
        return Group(f"code-{digit(self.code)}", tuple(marks))

    def _title(self) -> str:
        count = len(self.cells)
        number = int(PATTERN_OF[self.code])
        return (
            f"Code {digit(self.code)} = {name(self.code)} (pattern {number}): "
            f"{count} cell{'s' * (count != 1)}"
        )

    def _lines(self, centre: Point) -> list[Mark]:
        """To the neighbours, with marks at the edges, half way and at the next cell."""
        x, y = centre
        half, pitch = self.half, 1e3 * self.floor.pitch_m
        marks: list[Mark] = []
        for u, v in ((1, 0), (0, 1), (-1, 0), (0, -1)):
            tip = (x + half * u, y + half * v)
            marks.append(Line((x, y), tip, 0.1, dash_mm=2.0))
            base = half - 3.0
            corners = (
                tip,
                (x + base * u - v, y + base * v - u),
                (x + base * u + v, y + base * v + u),
            )
            marks.append(Polygon(corners, filled=True))
            for at, arm in ((pitch / 2, 3.0), (pitch, 5.0)):
                if card_mm(self.floor.geometry) < at < half - 1e-6:
                    place = (x + at * u, y + at * v)
                    marks.append(
                        Line(
                            (place[0] - arm * v, place[1] - arm * u),
                            (place[0] + arm * v, place[1] + arm * u),
                            0.2,
                        )
                    )
        return marks

    def _corners(self, centre: Point) -> list[Mark]:
        """North mark and what the edges are, in the corners, which are always free."""
        x, y = centre[0] - self.half + 2.0, centre[1] + self.half - 1.0 - _NORTH_MM
        pitch = mm_text(self.floor.pitch_m)
        ends = (
            f"edge half way to the next cell ({pitch} mm)"
            if abs(self.half - 0.5e3 * self.floor.pitch_m) < 1e-6
            else f"edge {mm_text(1e-3 * self.half)} mm from the centre, next cell {pitch} mm"
        )
        lines = wrap(ends, SMALL, max(self.half - 8.0, text_width("x" * 20, SMALL)))
        marks = north_mark((x + 2.5, y), _NORTH_MM)
        low = centre[1] - self.half + 1.0 + CAPITAL_HEIGHT_EM * SMALL * MM_PER_POINT
        for index, text in enumerate(reversed(lines)):
            up = low + index * line_mm(SMALL)
            marks.append(Text(text, (x, up), SMALL))
        right = (
            centre[0] + self.half - 4.5,
            centre[1] - CAPITAL_HEIGHT_EM * TEXT * MM_PER_POINT - 1.2,
        )
        marks.append(Text("+x", right, TEXT, "end", bold=True))
        return marks

    def _list(self, start: Point, bottom: float) -> list[Mark]:
        """As many lines of cells as there is room for."""
        text = f"For the cells (row: columns) {cells_text(self.cells)}"
        lines = wrap(text, TEXT, 2 * self.half)
        most = max(1, int((start[1] - bottom) / line_mm(TEXT) - 0.3))
        if len(lines) > most:
            lines = [*lines[: most - 1], "... and more: see the marking list"]
        return [
            Text(line, (start[0], start[1] - (index + 1) * line_mm(TEXT)), TEXT)
            for index, line in enumerate(lines)
        ]
