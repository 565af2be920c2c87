"""The plan of a floor, to a scale that fits the page, over several pages where it is large."""

from __future__ import annotations

import math
from dataclasses import dataclass

from locatk.core.drawing import (
    CAPITAL_HEIGHT_EM,
    MM_PER_POINT,
    Circle,
    Group,
    Line,
    Mark,
    Point,
    Polygon,
    Text,
    arrow,
    text_width,
)
from locatk.core.landmarks.drawing.landmark import draw_symbol, north_mark
from locatk.core.landmarks.drawing.legend import LEGEND_MM, legend
from locatk.core.landmarks.drawing.page import SMALL, TEXT, Frame, Leaf, line_mm
from locatk.core.landmarks.map.floor import HOLE, Cell, FloorMap
from locatk.core.units import mm_text

SMALLEST_MM, LARGEST_MM = 6.5, 45.0
"""Sides of a cell on the paper before its scale is rounded."""

_STEPS = (1, 1.25, 1.5, 2, 2.5, 3, 3.5, 4, 4.5, 5, 6, 7, 7.5, 8, 9)
_AXIS_MM = 7.0
_WORDS_MM = 20.0
"""Side of a cell above which it bears its numbers and place."""

_KEY = (
    "Bars point to their north poles; filled: N (counter-clockwise), hollow: S. In the middle "
    "the code as in the map's file. Crossed: no landmark. Thick: wall. Circle: the map's origin."
)

Block = tuple[int, int, int, int]
"""First row, first column, and the row and column after the last."""


def nice_scale(least: float) -> float:
    """The n of the next scale 1 : n that is a round number."""
    power = 10.0 ** math.floor(math.log10(least) + 1e-9)
    fits = [step * power for step in (*_STEPS, 10) if step * power >= least * (1 - 1e-9)]
    return round(fits[0], 6)


@dataclass(frozen=True)
class _Layout:
    """How a floor is cut over pages."""

    frame: Frame
    blocks: tuple[Block, ...]
    across: int
    scale: float


def plan_leaves(floor: FloorMap, title: str, paper_mm: Point, margin_mm: float) -> list[Leaf]:
    """Pages of the plan: one with its legend, or a key to the pages and a page a block.

    Raises
    ------
    InputError
        See :func:`locatk.core.landmarks.drawing.page.check_margin`.
    """
    ways = [_layout(floor, title, size, margin_mm) for size in (paper_mm, paper_mm[::-1])]
    best = min(ways, key=lambda way: (len(way.blocks), way.scale))
    drawn = _Drawn(floor, 1e3 * floor.pitch_m / best.scale)
    frame = best.frame
    left, bottom, right, top = frame.box
    key = Group("legend", tuple(legend(floor, best.scale, (left, bottom), right - left)))
    upper = (left, bottom + LEGEND_MM, right, top)
    if len(best.blocks) == 1:
        return [Leaf(frame, (key, Group("plan", tuple(drawn.block(best.blocks[0], upper)))))]
    leaves = [Leaf(frame, (key, Group("key", tuple(_key_map(floor, best, upper)))))]
    for number, block in enumerate(best.blocks):
        words = (
            f"{block_name(number, best.across)}: rows {block[0]} to {block[2] - 1}, columns "
            f"{block[1]} to {block[3] - 1}. Scale 1 : {best.scale:g}. {_KEY}",
        )
        page = Frame(frame.size, margin_mm, frame.title, words)
        leaves.append(Leaf(page, (Group("plan", tuple(drawn.block(block, page.box))),)))
    return leaves


def block_name(number: int, across: int) -> str:
    """Of a part of a plan or of a tile: ``c1r1`` is the upper left one."""
    return f"c{number % across + 1}r{number // across + 1}"


def _layout(floor: FloorMap, title: str, size: Point, margin: float) -> _Layout:
    rows, columns = floor.shape
    name = f"{title}: floor plan"
    count = len(floor.cells())
    words = (
        f"{_count(rows, 'row')} x {_count(columns, 'column')}, {_count(count, 'landmark')}, "
        f"pitch {mm_text(floor.pitch_m)} mm, alphabet {floor.alphabet}, "
        f"window {floor.window}. {_KEY}",
    )
    frame = Frame(size, margin, name, words)
    left, bottom, right, top = frame.box
    label = _labels_mm(floor)
    room = (right - left - label[0], top - bottom - label[1])
    one = (room[0], room[1] - LEGEND_MM)
    cell = min(one[0] / columns, one[1] / rows, LARGEST_MM)
    across = down = 1
    if cell < SMALLEST_MM:
        across = math.ceil(columns / max(1, int(room[0] / SMALLEST_MM)))
        down = math.ceil(rows / max(1, int(room[1] / SMALLEST_MM)))
        # The key has a page of its own, so one block here is two pages.
        columns, rows = math.ceil(columns / across), math.ceil(rows / down)
        across, down = math.ceil(floor.shape[1] / columns), math.ceil(floor.shape[0] / rows)
        cell = min(room[0] / columns, room[1] / rows, LARGEST_MM)
    blocks = []
    for upper in range(down):
        first = max(0, floor.shape[0] - (upper + 1) * rows)
        last = floor.shape[0] - upper * rows
        for column in range(across):
            end = min(floor.shape[1], (column + 1) * columns)
            blocks.append((first, column * columns, last, end))
    return _Layout(frame, tuple(blocks), across, nice_scale(1e3 * floor.pitch_m / cell))


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'s' * (number != 1)}"


def _labels_mm(floor: FloorMap) -> Point:
    """Room at the left of and below the cells, for numbers, places and the axes."""
    rows, columns = floor.shape
    (x0, y0), (x1, y1) = floor.place((0, 0)), floor.place((rows - 1, columns - 1))
    longest = max(text_width(mm_text(value), SMALL) for value in (x0, y0, x1, y1))
    return (_AXIS_MM + longest + 6.0, _AXIS_MM + longest + 5.0)


@dataclass(frozen=True)
class _Drawn:
    """A floor whose cells have this side on the paper."""

    floor: FloorMap
    cell: float

    def block(self, block: Block, box: tuple[float, float, float, float]) -> list[Mark]:
        """Cells of a block with their numbers and places, in the middle of a box."""
        label = _labels_mm(self.floor)
        width, height = (block[3] - block[1]) * self.cell, (block[2] - block[0]) * self.cell
        left = max(box[0] + label[0], (box[0] + box[2] - width + label[0]) / 2)
        bottom = max(box[1] + label[1], box[3] - height)
        # Where cell (0, 0) would have its lower left corner.
        zero = (left - block[1] * self.cell, bottom - block[0] * self.cell)
        marks = [*self._grid(block, zero), *self._labels(block, zero)]
        for row in range(block[0], block[2]):
            for column in range(block[1], block[3]):
                marks += self._cell((row, column), zero)
        return [*marks, *self._walls(block, zero), *self._origin(block, zero)]

    def _middle(self, cell: Cell, zero: Point) -> Point:
        return zero[0] + (cell[1] + 0.5) * self.cell, zero[1] + (cell[0] + 0.5) * self.cell

    def _cell(self, cell: Cell, zero: Point) -> list[Mark]:
        middle, half = self._middle(cell, zero), 0.5 * self.cell
        x, y = middle
        code = int(self.floor.codes[cell])
        if code == HOLE:
            return [
                Line((x - half, y - half), (x + half, y + half), 0.1),
                Line((x - half, y + half), (x + half, y - half), 0.1),
            ]
        if self.cell <= _WORDS_MM:
            return draw_symbol(code, middle, 1.2 * self.cell)
        marks = draw_symbol(code, middle, self.cell)
        place = ", ".join(mm_text(value) for value in self.floor.place(cell))
        points = SMALL * min(1.4, self.cell / 25)
        left, top = x - half + 1.2, y + half - line_mm(points) - 0.2
        return [
            *marks,
            Text(f"row {cell[0]}, column {cell[1]}", (left, top), points),
            Text(place, (left, y - half + 1.2), points),
        ]

    def _grid(self, block: Block, zero: Point) -> list[Mark]:
        """Borders of cells, and of the floor, thicker where the floor ends."""
        rows, columns = self.floor.shape
        left, right = zero[0] + block[1] * self.cell, zero[0] + block[3] * self.cell
        bottom, top = zero[1] + block[0] * self.cell, zero[1] + block[2] * self.cell
        marks: list[Mark] = []
        for column in range(block[1], block[3] + 1):
            x = zero[0] + column * self.cell
            marks.append(Line((x, bottom), (x, top), 0.3 if column in (0, columns) else 0.06))
        for row in range(block[0], block[2] + 1):
            y = zero[1] + row * self.cell
            marks.append(Line((left, y), (right, y), 0.3 if row in (0, rows) else 0.06))
        return marks

    def _labels(self, block: Block, zero: Point) -> list[Mark]:
        """Numbers of rows and columns, their places in mm, and the axes' arrows."""
        left, bottom = zero[0] + block[1] * self.cell, zero[1] + block[0] * self.cell
        top = zero[1] + block[2] * self.cell
        capital = CAPITAL_HEIGHT_EM * SMALL * MM_PER_POINT
        marks: list[Mark] = []
        turned = _labels_mm(self.floor)[1] - _AXIS_MM - 4.0 > self.cell
        for row in range(block[0], block[2]):
            y = zero[1] + (row + 0.5) * self.cell - capital / 2
            place = mm_text(self.floor.place((row, 0))[1])
            marks.append(Text(str(row), (left - 1.2, y), SMALL + 1, "end", bold=True))
            marks.append(Text(place, (left - 5.5, y), SMALL, "end"))
        for column in range(block[1], block[3]):
            x = zero[0] + (column + 0.5) * self.cell
            place = mm_text(self.floor.place((0, column))[0])
            at = bottom - 1.2 - 1.2 * capital
            marks.append(Text(str(column), (x, at), SMALL + 1, "middle", bold=True))
            if turned:
                spot = (x + capital / 2, at - 1.2)
                marks.append(Text(place, spot, SMALL, "end", angle_deg=90))
            else:
                marks.append(Text(place, (x, at - 1.0 - capital), SMALL, "middle"))
        out = _labels_mm(self.floor)
        x, y = left - out[0] + 3.0, bottom - out[1] + 2.0
        length = min(25.0, max(10.0, top - bottom))
        # On a low floor the words would reach into the page's title.
        word = "+y, rows, mm" if top - y > length + 25.0 else "+y"
        return [
            *marks,
            *arrow((x, y), (x + length, y), 2.5, 0.3),
            Text("+x, columns, mm", (x + length + 1.0, y - 0.8), TEXT),
            *arrow((x, y), (x, y + length), 2.5, 0.3),
            Text(word, (x + 0.8, y + length + 1.0), TEXT, angle_deg=90),
        ]

    def _walls(self, block: Block, zero: Point) -> list[Mark]:
        marks: list[Mark] = []
        for one, other in sorted(self.floor.walls):
            if not any(_within(cell, block) for cell in (one, other)):
                continue
            a, b = self._middle(one, zero), self._middle(other, zero)
            middle = ((a[0] + b[0]) / 2, (a[1] + b[1]) / 2)
            u, v = (b[0] - a[0]) / 2, (b[1] - a[1]) / 2
            start, end = (middle[0] - v, middle[1] - u), (middle[0] + v, middle[1] + u)
            marks.append(Line(start, end, min(1.2, 0.1 * self.cell)))
        return marks

    def _origin(self, block: Block, zero: Point) -> list[Mark]:
        x0, y0 = self.floor.origin_m
        pitch = self.floor.pitch_m
        row, column = -y0 / pitch, -x0 / pitch
        if not (
            block[0] - 0.5 <= row < block[2] - 0.5 and block[1] - 0.5 <= column < block[3] - 0.5
        ):
            return []
        x, y = zero[0] + (column + 0.5) * self.cell, zero[1] + (row + 0.5) * self.cell
        radius = (0.33 if self.cell > _WORDS_MM else 0.42) * self.cell
        return [Circle((x, y), radius, 0.2)]


def _within(cell: Cell, block: Block) -> bool:
    return block[0] <= cell[0] < block[2] and block[1] <= cell[1] < block[3]


def _key_map(
    floor: FloorMap, layout: _Layout, box: tuple[float, float, float, float]
) -> list[Mark]:
    """The whole floor in small, with the names of the pages."""
    rows, columns = floor.shape
    cell = min((box[2] - box[0] - 10) / columns, (box[3] - box[1] - 10) / rows)
    left = (box[0] + box[2] - cell * columns) / 2
    bottom = box[3] - 5 - cell * rows
    marks: list[Mark] = []
    holes = [(r, c) for r in range(rows) for c in range(columns) if floor.codes[r, c] == HOLE]
    for row, column in holes:
        x, y = left + column * cell, bottom + row * cell
        # One thin diagonal only, as names of pages may lie over it.
        marks.append(Line((x, y), (x + cell, y + cell), 0.05))
    for one, other in sorted(floor.walls):
        x, y = left + max(one[1], other[1]) * cell, bottom + max(one[0], other[0]) * cell
        end = (x, y + cell) if one[0] == other[0] else (x + cell, y)
        marks.append(Line((x, y), end, 0.8))
    for number, block in enumerate(layout.blocks):
        x, y = left + block[1] * cell, bottom + block[0] * cell
        width, height = (block[3] - block[1]) * cell, (block[2] - block[0]) * cell
        corners = ((x, y), (x + width, y), (x + width, y + height), (x, y + height))
        marks.append(Polygon(corners, width_mm=0.25))
        name = block_name(number, layout.across)
        points = min(14.0, 0.5 * height / MM_PER_POINT, 0.8 * width / text_width(name, 1.0))
        middle = (x + width / 2, y + height / 2)
        marks.append(Text(name, middle, points, "middle", bold=True))
        cells = f"rows {block[0]}-{block[2] - 1}, columns {block[1]}-{block[3] - 1}"
        small = min(TEXT, 0.9 * width / text_width(cells, 1.0))
        below = (middle[0], middle[1] - 1.3 * line_mm(small))
        marks.append(Text(cells, below, small, "middle"))
    return [*marks, *north_mark((left - 5.0, bottom), 8.0, "")]
