"""Plan of a floor, to a scale that fits the page; large floors are divided over several pages."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from locatk.core.drawing import (
    MIN_TEXT_POINTS,
    MM_PER_POINT,
    Box,
    Circle,
    Group,
    Line,
    Mark,
    Point,
    Text,
    capital_height,
    line_height,
    rectangle,
    text_width,
)
from locatk.core.drawing.pages import TEXT_POINTS, PageFrame, UnnumberedPage
from locatk.core.drawing.placement import Obstacles
from locatk.core.drawing.scale import axes, round_scale
from locatk.core.drawing.tiles import tile_name
from locatk.core.errors import InputError
from locatk.core.landmarks.drawing.landmark import draw_hole, draw_symbol, north_mark
from locatk.core.landmarks.drawing.legend import draw_legend, legend_height
from locatk.core.landmarks.map.floor import HOLE_CODE, Cell, FloorMap
from locatk.core.units import mm_text

MIN_CELL_MM = 6.5
"""Side of a cell on the paper below which a plan is divided over several pages."""

MAX_CELL_MM = 45.0
"""Largest side of a cell on the paper; larger symbols show nothing more."""

MIN_LABELLED_CELL_MM = 20.0
"""Side of a cell on the paper above which it contains its row, column and position if they fit."""

CELL_TEXT_INSET_MM = 1.2
"""Distance of the texts of a cell from its borders."""

NUMBER_GAP_MM = 1.2
"""Distance of the number of a row or column from the cells, and of its position from the number."""

AXIS_SPACE_MM = 7.0
"""Space for the arrows of the axes at the left of and below the numbers."""

_KEY = (
    "Bars point to their north poles. Filled bars are N (counter-clockwise), hollow bars are S. "
    "The number in the middle is the code in the map's file. Crossed cells have no landmark, "
    "thick lines are walls, and the circle is the origin of the map."
)


@dataclass(frozen=True)
class CellBlock:
    """Rectangle of cells; the ends are the row and the column after the last."""

    first_row: int
    first_column: int
    end_row: int
    end_column: int

    @property
    def rows(self) -> range:
        return range(self.first_row, self.end_row)

    @property
    def columns(self) -> range:
        return range(self.first_column, self.end_column)

    def __contains__(self, cell: Cell) -> bool:
        return cell[0] in self.rows and cell[1] in self.columns


@dataclass(frozen=True)
class _PlanLayout:
    """Division of a plan over pages of one orientation.

    Attributes
    ----------
    frame : PageFrame
    blocks : tuple of CellBlock
    blocks_across : int
    scale : float
        The n of 1 : n.
    has_overview : bool
        The legend has a page of its own, with an overview of the blocks.
    """

    frame: PageFrame
    blocks: tuple[CellBlock, ...]
    blocks_across: int
    scale: float
    has_overview: bool

    @property
    def page_count(self) -> int:
        return len(self.blocks) + self.has_overview


def draw_plan(
    floor: FloorMap, title: str, paper_mm: Point, margin_mm: float
) -> list[UnnumberedPage]:
    """Draw the plan on one page with its legend, or on an overview and one page for each block.

    The orientation of the paper is the one with the fewest pages, then the largest scale.

    Raises
    ------
    InputError
        The paper is too small.
    """
    possible = (_lay_out_plan(floor, title, size, margin_mm) for size in (paper_mm, paper_mm[::-1]))
    layouts = [layout for layout in possible if layout is not None]
    if not layouts:
        width, height = paper_mm
        raise InputError(
            f"a page of {width:g} x {height:g} mm is too small for the plan of the floor",
            hint="Use a larger paper",
        )
    layout = min(layouts, key=lambda item: (item.page_count, item.scale))
    frame = layout.frame
    cell_mm = 1e3 * floor.pitch_m / layout.scale
    left, bottom, right, top = frame.content_box
    legend = Group("legend", tuple(draw_legend(floor, layout.scale, (left, bottom), right - left)))
    above_legend = (left, bottom + legend_height(right - left), right, top)
    if not layout.has_overview:
        plan = _BlockDrawing.in_box(floor, cell_mm, layout.blocks[0], above_legend)
        return [UnnumberedPage(frame, (legend, Group("plan", tuple(plan.marks()))))]
    overview = Group("key", tuple(_draw_overview(floor, layout, above_legend)))
    pages = [UnnumberedPage(frame, (legend, overview))]
    for number, block in enumerate(layout.blocks):
        notes = (
            f"{tile_name(number, layout.blocks_across)}: rows {block.first_row} to "
            f"{block.end_row - 1}, columns {block.first_column} to {block.end_column - 1}. "
            f"Scale 1 : {layout.scale:g}. {_KEY}",
        )
        block_frame = PageFrame(frame.size_mm, margin_mm, frame.title, notes)
        plan = _BlockDrawing.in_box(floor, cell_mm, block, block_frame.content_box)
        pages.append(UnnumberedPage(block_frame, (Group("plan", tuple(plan.marks())),)))
    return pages


def _lay_out_plan(
    floor: FloorMap, title: str, size_mm: Point, margin_mm: float
) -> _PlanLayout | None:
    """Divide the plan over pages; return None if they have no space for legend and cells."""
    rows, columns = floor.shape
    notes = (
        f"{_count(rows, 'row')} x {_count(columns, 'column')}, "
        f"{_count(len(floor.cells()), 'landmark')}, "
        f"pitch {mm_text(floor.pitch_m)} mm, alphabet {floor.alphabet}, "
        f"window {floor.window}. {_KEY}",
    )
    frame = PageFrame(size_mm, margin_mm, f"{title}: floor plan", notes)
    left, bottom, right, top = frame.content_box
    label_width, label_height = _label_space(floor)
    width, height = right - left - label_width, top - bottom - label_height
    height_above_legend = height - legend_height(right - left)
    if min(width, height_above_legend) <= 0:
        return None
    cell_mm = min(width / columns, height_above_legend / rows, MAX_CELL_MM)
    across = down = 1
    has_overview = cell_mm < MIN_CELL_MM
    if has_overview:
        # The legend is on the page of the overview, so the blocks have the whole height.
        across = math.ceil(columns / max(1, int(width / MIN_CELL_MM)))
        down = math.ceil(rows / max(1, int(height / MIN_CELL_MM)))
        columns, rows = math.ceil(columns / across), math.ceil(rows / down)
        across, down = math.ceil(floor.shape[1] / columns), math.ceil(floor.shape[0] / rows)
        cell_mm = min(width / columns, height / rows, MAX_CELL_MM)
    blocks = [
        CellBlock(
            first_row=max(0, floor.shape[0] - (row + 1) * rows),
            first_column=column * columns,
            end_row=floor.shape[0] - row * rows,
            end_column=min(floor.shape[1], (column + 1) * columns),
        )
        for row in range(down)
        for column in range(across)
    ]
    scale = round_scale(1e3 * floor.pitch_m / cell_mm)
    return _PlanLayout(frame, tuple(blocks), across, scale, has_overview)


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'s' * (number != 1)}"


def _label_space(floor: FloorMap) -> Point:
    """Return the space in mm for numbers and axes at the left of and below the cells."""
    numbers = 2 * NUMBER_GAP_MM + 1.0
    row_space, column_space = (_number_width(floor, axis) for axis in (0, 1))
    longest = _longest_position(floor)
    return (
        AXIS_SPACE_MM + longest + row_space + numbers,
        AXIS_SPACE_MM + longest + column_space + numbers,
    )


def _longest_position(floor: FloorMap) -> float:
    """Return the width in mm of the longest position of a row or column."""
    rows, columns = floor.shape
    corners = (*floor.position((0, 0)), *floor.position((rows - 1, columns - 1)))
    return max(text_width(mm_text(value), TEXT_POINTS) for value in corners)


def _number_width(floor: FloorMap, axis: int) -> float:
    """Return the width in mm of the largest number of a row (axis 0) or column (1)."""
    return text_width(str(floor.shape[axis] - 1), TEXT_POINTS)


@dataclass(frozen=True)
class _BlockDrawing:
    """Plan of a block of cells on a page.

    ``origin`` is the lower left corner of cell (0, 0) on the page, which may be outside of it.
    """

    floor: FloorMap
    cell_mm: float
    block: CellBlock
    origin: Point

    @classmethod
    def in_box(cls, floor: FloorMap, cell_mm: float, block: CellBlock, box: Box) -> _BlockDrawing:
        """Centre a block with its labels in a box, at the upper edge."""
        label_width, label_height = _label_space(floor)
        width, height = len(block.columns) * cell_mm, len(block.rows) * cell_mm
        left = max(box[0] + label_width, (box[0] + box[2] - width + label_width) / 2)
        bottom = max(box[1] + label_height, box[3] - height)
        origin = (left - block.first_column * cell_mm, bottom - block.first_row * cell_mm)
        return cls(floor, cell_mm, block, origin)

    def marks(self) -> list[Mark]:
        cells = [(row, column) for row in self.block.rows for column in self.block.columns]
        content = [mark for cell in cells for mark in self._cell(cell)]
        return [
            *self._grid(),
            *self._numbers(),
            *self._axes(),
            *content,
            *self._walls(),
            *self._map_origin(content),
        ]

    def _point(self, row: float, column: float) -> Point:
        """Return the point on the page of a cell's lower left corner, or in between."""
        return self.origin[0] + column * self.cell_mm, self.origin[1] + row * self.cell_mm

    def _centre(self, cell: Cell) -> Point:
        return self._point(cell[0] + 0.5, cell[1] + 0.5)

    def _grid(self) -> list[Mark]:
        """Draw the borders of the cells, thicker at the border of the floor."""
        rows, columns = self.floor.shape
        left, bottom = self._point(self.block.first_row, self.block.first_column)
        right, top = self._point(self.block.end_row, self.block.end_column)
        marks: list[Mark] = []
        for column in (*self.block.columns, self.block.end_column):
            x, _ = self._point(0, column)
            marks.append(Line((x, bottom), (x, top), 0.3 if column in (0, columns) else 0.06))
        for row in (*self.block.rows, self.block.end_row):
            _, y = self._point(row, 0)
            marks.append(Line((left, y), (right, y), 0.3 if row in (0, rows) else 0.06))
        return marks

    def _numbers(self) -> list[Mark]:
        """Write the numbers of rows and columns with their positions in mm."""
        left, bottom = self._point(self.block.first_row, self.block.first_column)
        capital = capital_height(TEXT_POINTS)
        marks: list[Mark] = []
        for row in self.block.rows:
            y = self._centre((row, 0))[1] - capital / 2
            position = mm_text(self.floor.position((row, 0))[1])
            x = left - NUMBER_GAP_MM
            marks.append(Text(str(row), (x, y), TEXT_POINTS, "end", bold=True))
            x -= _number_width(self.floor, 0) + NUMBER_GAP_MM
            marks.append(Text(position, (x, y), TEXT_POINTS, "end"))
        column_width = _number_width(self.floor, 1)
        is_upright = max(_longest_position(self.floor), column_width) + 1.0 > self.cell_mm
        for column in self.block.columns:
            x, _ = self._centre((0, column))
            y = bottom - NUMBER_GAP_MM
            number, position = str(column), mm_text(self.floor.position((0, column))[0])
            if is_upright:
                for text, is_bold in ((number, True), (position, False)):
                    corner = (x + capital / 2, y)
                    marks.append(Text(text, corner, TEXT_POINTS, "end", bold=is_bold, angle_deg=90))
                    y -= column_width + NUMBER_GAP_MM
            else:
                y -= capital
                marks.append(Text(number, (x, y), TEXT_POINTS, "middle", bold=True))
                below = (x, y - NUMBER_GAP_MM - capital)
                marks.append(Text(position, below, TEXT_POINTS, "middle"))
        return marks

    def _axes(self) -> list[Mark]:
        left, bottom = self._point(self.block.first_row, self.block.first_column)
        _, top = self._point(self.block.end_row, self.block.end_column)
        label_width, label_height = _label_space(self.floor)
        x, y = left - label_width + 3.0, bottom - label_height + 2.0
        length = min(25.0, max(10.0, top - bottom))
        # On a low floor the long label would extend into the page's title.
        label = "+y, rows, mm" if top - y > length + 25.0 else "+y"
        return axes((x, y), length, "+x, columns, mm", label)

    def _cell(self, cell: Cell) -> list[Mark]:
        centre, half = self._centre(cell), 0.5 * self.cell_mm
        code = int(self.floor.codes[cell])
        if code == HOLE_CODE:
            return draw_hole(centre, half, 0.1)
        if not self.has_cell_texts:
            return draw_symbol(code, centre, 1.2 * self.cell_mm)
        left = centre[0] - half + CELL_TEXT_INSET_MM
        top = centre[1] + half - CELL_TEXT_INSET_MM - capital_height(TEXT_POINTS)
        name, position = self._cell_texts(cell)
        return [
            *draw_symbol(code, centre, self.cell_mm),
            Text(name, (left, top), TEXT_POINTS),
            Text(position, (left, centre[1] - half + CELL_TEXT_INSET_MM), TEXT_POINTS),
        ]

    def _cell_texts(self, cell: Cell) -> tuple[str, str]:
        position = ", ".join(mm_text(value) for value in self.floor.position(cell))
        return f"row {cell[0]}, col {cell[1]}", position

    @cached_property
    def has_cell_texts(self) -> bool:
        """Whether the cells have space for their row, column and position."""
        rows, columns = self.floor.shape
        corners = itertools.product((0, rows - 1), (0, columns - 1))
        texts = [text for cell in corners for text in self._cell_texts(cell)]
        longest = max(text_width(text, TEXT_POINTS) for text in texts)
        space = self.cell_mm - 2 * CELL_TEXT_INSET_MM
        return self.cell_mm > MIN_LABELLED_CELL_MM and longest <= space

    def _walls(self) -> list[Mark]:
        marks: list[Mark] = []
        for first, second in sorted(self.floor.walls):
            if first not in self.block and second not in self.block:
                continue
            (x1, y1), (x2, y2) = self._centre(first), self._centre(second)
            x, y = (x1 + x2) / 2, (y1 + y2) / 2
            u, v = (x2 - x1) / 2, (y2 - y1) / 2
            marks.append(Line((x - v, y - u), (x + v, y + u), min(1.2, 0.1 * self.cell_mm)))
        return marks

    def _map_origin(self, content: Sequence[Mark]) -> list[Mark]:
        """Draw a circle at the origin of the map if it is on this page; texts interrupt it."""
        column, row = (-value / self.floor.pitch_m for value in self.floor.origin_m)
        block = self.block
        is_on_page = (
            block.first_row - 0.5 <= row < block.end_row - 0.5
            and block.first_column - 0.5 <= column < block.end_column - 0.5
        )
        if not is_on_page:
            return []
        relative_radius = 0.33 if self.has_cell_texts else 0.42
        centre = self._point(row + 0.5, column + 0.5)
        circle = Circle(centre, relative_radius * self.cell_mm, 0.2)
        return [*Obstacles(mark for mark in content if isinstance(mark, Text)).interrupt(circle)]


def _draw_overview(floor: FloorMap, layout: _PlanLayout, box: Box) -> list[Mark]:
    """Draw the whole floor with the names of the blocks, which have a page each."""
    rows, columns = floor.shape
    cell = min((box[2] - box[0] - 10) / columns, (box[3] - box[1] - 10) / rows)
    left = (box[0] + box[2] - cell * columns) / 2
    bottom = box[3] - 5 - cell * rows
    labels: list[Text] = []
    marks: list[Mark] = []
    for number, block in enumerate(layout.blocks):
        x, y = left + block.first_column * cell, bottom + block.first_row * cell
        box = (x, y, x + len(block.columns) * cell, y + len(block.rows) * cell)
        marks.append(rectangle(box, 0.25))
        labels += _block_labels(block, tile_name(number, layout.blocks_across), box)
    # Holes and walls leave the names of the blocks free.
    obstacles = Obstacles(labels)
    content: list[Line] = []
    holes = [(r, c) for r in range(rows) for c in range(columns) if floor.codes[r, c] == HOLE_CODE]
    for row, column in holes:
        x, y = left + column * cell, bottom + row * cell
        content.append(Line((x, y), (x + cell, y + cell), 0.05))
    for first, second in sorted(floor.walls):
        x, y = left + max(first[1], second[1]) * cell, bottom + max(first[0], second[0]) * cell
        end = (x, y + cell) if first[0] == second[0] else (x + cell, y)
        content.append(Line((x, y), end, 0.8))
    marks += [line for line in content if not obstacles.are_touched_by(line)]
    return [*marks, *labels, *north_mark((left - 5.0, bottom), 8.0, "")]


def _block_labels(block: CellBlock, name: str, box: Box) -> list[Text]:
    """Return the name of a block and its cells, as far as the block has space for them."""
    width, height = box[2] - box[0], box[3] - box[1]
    centre = ((box[0] + box[2]) / 2, (box[1] + box[3]) / 2)
    points = min(14.0, 0.5 * height / MM_PER_POINT, 0.8 * width / text_width(name, 1.0))
    if points < MIN_TEXT_POINTS:
        return []
    labels = [Text(name, centre, points, "middle", bold=True)]
    cells = (
        f"rows {block.first_row}-{block.end_row - 1}, "
        f"columns {block.first_column}-{block.end_column - 1}"
    )
    depth = 1.3 * line_height(TEXT_POINTS)
    if text_width(cells, TEXT_POINTS) < 0.95 * width and depth + 1.0 < height / 2:
        labels.append(Text(cells, (centre[0], centre[1] - depth), TEXT_POINTS, "middle"))
    return labels
