"""A floor at true size: on one sheet, on strips of a roll, or cut over tiles of paper."""

from __future__ import annotations

import math
from dataclasses import dataclass

from locatk.core.drawing import Line, Mark, Point, Text
from locatk.core.errors import InputError
from locatk.core.landmarks.drawing.landmark import card_mm, check, digit, draw_landmark, north_mark
from locatk.core.landmarks.drawing.page import TEXT, check_margin, printable, size_text
from locatk.core.landmarks.drawing.plan import block_name
from locatk.core.landmarks.map.floor import HOLE, Cell, FloorMap
from locatk.core.paper import Paper
from locatk.core.units import mm_text

MOST_TILES = 500

LONGEST_MM = 5000.0
"""Of a strip of a roll: a PDF page may be 200 inches long (ISO 32000-1 annex C)."""

LEAST_MARGIN_MM = 7.0
"""Rulers, joining marks and words stand in the margin."""

Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class Tile:
    """A page of a floor at true size.

    Attributes
    ----------
    name : str
        ``c1r1`` is the upper left tile.
    size_mm : (width, height)
    box : (left, bottom, right, top)
        Of the drawing on the page; marks reach out of it and are cut there.
    corner_mm : (x, y)
        Of the map's frame, at the box's lower left corner.
    seams : (x, y)
        Where it is cut for its neighbours, in mm from the page's lower left corner: in the
        middle of what both hold.
    marks : tuple of Mark
    words : tuple of str
        For the margin, the most important first.
    """

    name: str
    size_mm: Point
    box: Box
    corner_mm: Point
    seams: tuple[tuple[float, ...], tuple[float, ...]]
    marks: tuple[Mark, ...]
    words: tuple[str, ...]


@dataclass(frozen=True)
class Tiling:
    """How a floor is cut.

    Attributes
    ----------
    size_mm : (width, height)
        Of each page.
    count : (across, down)
    step_mm : (x, y)
        From a tile to its right, and to its upper, neighbour.
    """

    size_mm: Point
    count: tuple[int, int]
    step_mm: Point


def extent_mm(floor: FloorMap) -> Box:
    """Left, bottom, right and top, in the map's frame, of all that is drawn at true size."""
    rows, columns = floor.shape
    (x0, y0), (x1, y1) = floor.place((0, 0)), floor.place((rows - 1, columns - 1))
    out = min(card_mm(floor.geometry), 0.5e3 * floor.pitch_m)
    out = max(out, 0.25e3 * floor.pitch_m)
    return 1e3 * x0 - out, 1e3 * y0 - out, 1e3 * x1 + out, 1e3 * y1 + out


def tiling(floor: FloorMap, on: Paper, margin_mm: float, overlap_mm: float) -> Tiling:
    """The way to lay the paper that takes the fewest pages, then the least paper.

    Raises
    ------
    InputError
        The margin or the overlap leaves nothing, or there would be more than
        :data:`MOST_TILES` tiles.
    """
    left, bottom, right, top = extent_mm(floor)
    wanted = (right - left, top - bottom)
    check_margin((min(on.size_mm),) * 2, margin_mm)
    if margin_mm < LEAST_MARGIN_MM:
        raise InputError(
            f"a margin of {margin_mm:g} mm has no room for rulers and joining marks",
            hint=f"Use at least {LEAST_MARGIN_MM:g} mm",
        )
    ways = [_cut(wanted, size, margin_mm, overlap_mm) for size in (on.size_mm, on.size_mm[::-1])]
    best = min(ways, key=lambda way: (math.prod(way.count), math.prod(way.size_mm)))
    count = math.prod(best.count)
    if count > MOST_TILES:
        raise InputError(
            f"a floor of {size_text((round(wanted[0]), round(wanted[1])))} at true size takes "
            f"{count} pages of {on.name}, and {MOST_TILES} are the most",
            hint="Use a larger paper, as in --paper roll:914mm, or the templates",
        )
    return best


def _cut(wanted: Point, size: Point, margin: float, overlap: float) -> Tiling:
    sides, counts, steps = [], [], []
    for need, side in zip(wanted, size, strict=True):
        room = min(side, LONGEST_MM) - 2 * margin
        if not 0 <= overlap <= room / 2:
            raise InputError(
                f"an overlap of {overlap:g} mm is more than half of a tile's {room:.0f} mm",
                hint="Use a smaller overlap",
            )
        count = 1 if need <= room else math.ceil((need - overlap) / (room - overlap) - 1e-9)
        if math.isinf(side):
            room = math.ceil((need + (count - 1) * overlap) / count)
        sides.append(room + 2 * margin)
        counts.append(count)
        steps.append(room - overlap)
    return Tiling((sides[0], sides[1]), (counts[0], counts[1]), (steps[0], steps[1]))


def floor_tiles(
    floor: FloorMap, on: Paper, *, margin_mm: float = 10.0, overlap_mm: float = 10.0
) -> list[Tile]:
    """The whole floor at true size, row by row from the upper left tile.

    Raises
    ------
    InputError
        See :func:`tiling` and :func:`locatk.core.landmarks.drawing.landmark.check`.
    """
    check(floor)
    cut = tiling(floor, on, margin_mm, overlap_mm)
    left, bottom, right, top = extent_mm(floor)
    across, down = cut.count
    room = (cut.size_mm[0] - 2 * margin_mm, cut.size_mm[1] - 2 * margin_mm)
    # The floor in the middle of the papers' sum.
    start = [
        low - ((count - 1) * step + side - (high - low)) / 2
        for low, high, count, step, side in zip(
            (left, bottom), (right, top), cut.count, cut.step_mm, room, strict=True
        )
    ]
    tiles = []
    for number in range(across * down):
        row, column = divmod(number, across)
        place = (column, down - 1 - row)
        corner = tuple(
            low + at * step for low, at, step in zip(start, place, cut.step_mm, strict=True)
        )
        seams = tuple(
            tuple(
                margin_mm + edge
                for edge, there in (
                    (overlap_mm / 2, at > 0),
                    (side - overlap_mm / 2, at < count - 1),
                )
                if there
            )
            for at, count, side in zip(place, cut.count, room, strict=True)
        )
        box = (margin_mm, margin_mm, margin_mm + room[0], margin_mm + room[1])
        tiles.append(
            Tile(
                block_name(number, across),
                cut.size_mm,
                box,
                (corner[0], corner[1]),
                (seams[0], seams[1]),
                (
                    *_marks(floor, (corner[0], corner[1]), box),
                    *_seam_marks(number, cut.count, box, overlap_mm),
                ),
                _words(floor, block_name(number, across), (across, down), corner, room),
            )
        )
    return tiles


def _words(
    floor: FloorMap,
    name: str,
    count: tuple[int, int],
    corner: tuple[float, ...],
    room: Point,
) -> tuple[str, ...]:
    tiles = count[0] * count[1]
    low, high = (
        [1e-3 * (a + b) for a, b in zip(corner, room, strict=True)] for room in ((0, 0), room)
    )
    return (
        f"{name} of {count[0]} x {count[1]}" if tiles > 1 else printable(floor.name) or "floor",
        "Print at 100 %",
        "map +y is up",
        *(["Cut along the dashed seams and join the marks"] if tiles > 1 else []),
        f"x {mm_text(low[0])} to {mm_text(high[0])} mm",
        f"y {mm_text(low[1])} to {mm_text(high[1])} mm",
    )


def _marks(floor: FloorMap, corner: Point, box: Box) -> list[Mark]:
    """All that reaches into the box."""
    left, bottom, right, top = extent_mm(floor)
    shift = (box[0] - corner[0], box[1] - corner[1])
    rows, columns = floor.shape
    marks: list[Mark] = []
    for row in range(rows):
        y = 1e3 * floor.place((row, 0))[1] + shift[1]
        if box[1] <= y <= box[3]:
            marks.append(Line((left + shift[0], y), (right + shift[0], y), 0.08))
    for column in range(columns):
        x = 1e3 * floor.place((0, column))[0] + shift[0]
        if box[0] <= x <= box[2]:
            marks.append(Line((x, bottom + shift[1]), (x, top + shift[1]), 0.08))
    for cell in _cells_within(floor, corner, box):
        x, y = (1e3 * a + b for a, b in zip(floor.place(cell), shift, strict=True))
        code = int(floor.codes[cell])
        if code == HOLE:
            marks += [
                Line((x - 10, y - 10), (x + 10, y + 10), 0.2),
                Line((x - 10, y + 10), (x + 10, y - 10), 0.2),
                Text("no landmark", (x + 2, y + 12), TEXT),
            ]
        else:
            words = (f"row {cell[0]}", f"column {cell[1]}", f"code {digit(code)}")
            marks += draw_landmark(floor.geometry, code, (x, y), words)
            marks += north_mark((x + 3.0, y + 3.0), 5.0, "+y")
    marks += _walls(floor, shift, box)
    return marks


def _seam_marks(number: int, count: tuple[int, int], box: Box, overlap: float) -> list[Mark]:
    """Dashed lines to cut along, with the names of the tiles beyond them."""
    row, column = divmod(number, count[0])
    left, bottom, right, top = box
    inner = overlap / 2
    middle = ((left + right) / 2, (bottom + top) / 2)
    marks: list[Mark] = []
    for there, other, at in (
        (column > 0, number - 1, left + inner),
        (column < count[0] - 1, number + 1, right - inner),
    ):
        if there:
            # Text that reads upwards grows to the left of their line.
            shift = -1.0 if at > middle[0] else 3.0
            text = f"joins {block_name(other, count[0])}"
            marks.append(Line((at, bottom), (at, top), 0.1, dash_mm=5.0))
            marks.append(Text(text, (at + shift, middle[1]), TEXT, "middle", angle_deg=90))
    for there, other, at in (
        (row < count[1] - 1, number + count[0], bottom + inner),
        (row > 0, number - count[0], top - inner),
    ):
        if there:
            shift = 1.0 if at < middle[1] else -3.0
            text = f"joins {block_name(other, count[0])}"
            marks.append(Line((left, at), (right, at), 0.1, dash_mm=5.0))
            marks.append(Text(text, (middle[0], at + shift), TEXT, "middle"))
    return marks


def _cells_within(floor: FloorMap, corner: Point, box: Box) -> list[Cell]:
    """Cells, also without landmark, whose drawing may reach into the box."""
    reach, pitch = card_mm(floor.geometry), 1e3 * floor.pitch_m
    ranges = []
    for axis, count in ((1, floor.shape[0]), (0, floor.shape[1])):
        low = corner[axis] - 1e3 * floor.origin_m[axis] - reach
        high = low + box[axis + 2] - box[axis] + 2 * reach
        first, last = math.ceil(low / pitch), math.floor(high / pitch)
        ranges.append(range(max(0, first), min(count - 1, last) + 1))
    return [(row, column) for row in ranges[0] for column in ranges[1]]


def _walls(floor: FloorMap, shift: Point, box: Box) -> list[Mark]:
    marks: list[Mark] = []
    half = 0.5e3 * floor.pitch_m
    for one, other in sorted(floor.walls):
        (ax, ay), (bx, by) = floor.place(one), floor.place(other)
        x, y = 500 * (ax + bx) + shift[0], 500 * (ay + by) + shift[1]
        if not (box[0] - half <= x <= box[2] + half and box[1] - half <= y <= box[3] + half):
            continue
        u, v = (0.0, half) if one[0] == other[0] else (half, 0.0)
        marks.append(Line((x - u, y - v), (x + u, y + v), 2.0))
        marks.append(Text("wall", (x + 2.0, y + 2.0), TEXT))
    return marks
