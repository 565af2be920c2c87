"""Floor at true size: on one sheet, on strips of a roll, or divided over tiles of paper."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from locatk.core.drawing import Box, Line, Mark, Point, Text
from locatk.core.drawing.pages import TEXT_POINTS, check_margin, printable, size_text
from locatk.core.drawing.placement import Obstacles
from locatk.core.drawing.tiles import Tile, TileGrid, divide_area
from locatk.core.errors import InputError
from locatk.core.landmarks.drawing.landmark import (
    check_buildable,
    code_digit,
    draw_hole,
    draw_landmark,
    drawing_half_side,
    north_mark,
)
from locatk.core.landmarks.map.floor import HOLE_CODE, Cell, FloorMap
from locatk.core.paper_sizes import Paper
from locatk.core.units import mm_text

MAX_TILES = 500
"""Largest number of pages of a floor; more of them are hardly joined by hand."""

EDGE_GAP_MM = 1.5
"""Distance of labels from the border of a cell, on which a wall may be drawn."""

WALL_LABEL_FRACTIONS = (0.5, 0.4, 0.6, 0.3, 0.7, 0.2, 0.8, 0.1, 0.9)
"""Positions along a wall at which its label is tried; it is left out if none is free."""

MIN_MARGIN_MM = 7.0
"""Smallest margin that holds rulers, joining marks and texts."""


@dataclass(frozen=True)
class FloorPage:
    """Page of a floor at true size.

    Attributes
    ----------
    size_mm : (width, height)
    tile : Tile
        Part of the floor on this page. The corner is in the frame of the map, in mm.
    marks : tuple of Mark
        They extend beyond the box of the tile and are clipped there.
    notes : tuple of str
        Texts for the margin, the most important first.
    """

    size_mm: Point
    tile: Tile
    marks: tuple[Mark, ...]
    notes: tuple[str, ...]


def draw_floor(
    floor: FloorMap, paper: Paper, *, margin_mm: float = 10.0, overlap_mm: float = 10.0
) -> list[FloorPage]:
    """Draw the whole floor at true size, row by row from the upper left tile.

    Raises
    ------
    InputError
        The floor cannot be built (:func:`.landmark.check_buildable`), the margin or the overlap
        is too large or too small, or there would be more than :data:`MAX_TILES` tiles.
    """
    check_buildable(floor)
    check_margin((min(paper.size_mm),) * 2, margin_mm)
    if margin_mm < MIN_MARGIN_MM:
        raise InputError(
            f"a margin of {margin_mm:g} mm has no space for rulers and joining marks",
            hint=f"Use at least {MIN_MARGIN_MM:g} mm",
        )
    extent = floor_extent(floor)
    grid = divide_area(extent, paper, margin_mm, overlap_mm)
    if grid.tile_count > MAX_TILES:
        size = (round(extent[2] - extent[0]), round(extent[3] - extent[1]))
        raise InputError(
            f"a floor of {size_text(size)} at true size takes {grid.tile_count} pages of "
            f"{paper.name}; at most {MAX_TILES} are possible",
            hint="Use a larger paper, as in --paper roll:914mm, or the templates",
        )
    pages = []
    for tile in grid.tiles():
        area = _draw_area(floor, tile.corner_mm, tile.box)
        notes = _margin_notes(floor, grid, tile)
        pages.append(FloorPage(grid.page_mm, tile, (*area, *tile.seam_marks(area)), notes))
    return pages


def floor_extent(floor: FloorMap) -> Box:
    """Return left, bottom, right and top of the drawing at true size, in mm in the map frame."""
    rows, columns = floor.shape
    (x0, y0), (x1, y1) = floor.position((0, 0)), floor.position((rows - 1, columns - 1))
    border = min(drawing_half_side(floor.geometry), 0.5e3 * floor.pitch_m)
    border = max(border, 0.25e3 * floor.pitch_m)
    return 1e3 * x0 - border, 1e3 * y0 - border, 1e3 * x1 + border, 1e3 * y1 + border


def _margin_notes(floor: FloorMap, grid: TileGrid, tile: Tile) -> tuple[str, ...]:
    is_divided = grid.tile_count > 1
    columns, rows = grid.count
    name = f"{tile.name} of {columns} x {rows}" if is_divided else printable(floor.name) or "floor"
    ranges = (
        f"{axis} {mm_text(1e-3 * low)} to {mm_text(1e-3 * (low + side))} mm"
        for axis, low, side in zip("xy", tile.corner_mm, grid.tile_mm, strict=True)
    )
    cutting = ("Cut along the dashed seams and join the marks",) if is_divided else ()
    return (name, "Print at 100 %", "map +y is up", *cutting, *ranges)


def _draw_area(floor: FloorMap, corner: Point, box: Box) -> list[Mark]:
    """Draw everything that extends into a box with its lower left corner at ``corner``."""
    left, bottom, right, top = floor_extent(floor)
    dx, dy = box[0] - corner[0], box[1] - corner[1]
    rows, columns = floor.shape
    marks: list[Mark] = []
    for row in range(rows):
        y = 1e3 * floor.position((row, 0))[1] + dy
        if box[1] <= y <= box[3]:
            marks.append(Line((left + dx, y), (right + dx, y), 0.08))
    for column in range(columns):
        x = 1e3 * floor.position((0, column))[0] + dx
        if box[0] <= x <= box[2]:
            marks.append(Line((x, bottom + dy), (x, top + dy), 0.08))
    for cell in _cells_in_area(floor, corner, box):
        x, y = floor.position(cell)
        marks += _draw_cell(floor, cell, (1e3 * x + dx, 1e3 * y + dy))
    walls = _draw_walls(floor, (dx, dy), box)
    obstacles = Obstacles([*marks, *walls])
    labels = [label for wall in walls for label in obstacles.place(_wall_labels(wall))]
    return [*marks, *walls, *labels]


def _cells_in_area(floor: FloorMap, corner: Point, box: Box) -> list[Cell]:
    """Return the cells, also those without landmark, whose drawing may extend into a box."""
    border, pitch = drawing_half_side(floor.geometry), 1e3 * floor.pitch_m
    ranges = []
    for axis, count in ((1, floor.shape[0]), (0, floor.shape[1])):
        low = corner[axis] - 1e3 * floor.origin_m[axis] - border
        high = low + box[axis + 2] - box[axis] + 2 * border
        first, last = math.ceil(low / pitch), math.floor(high / pitch)
        ranges.append(range(max(0, first), min(count - 1, last) + 1))
    return [(row, column) for row in ranges[0] for column in ranges[1]]


def _draw_cell(floor: FloorMap, cell: Cell, centre: Point) -> list[Mark]:
    x, y = centre
    code = int(floor.codes[cell])
    if code == HOLE_CODE:
        return [*draw_hole(centre, 10.0, 0.2), Text("no landmark", (x + 2, y + 12), TEXT_POINTS)]
    notes = (f"row {cell[0]}", f"column {cell[1]}", f"code {code_digit(code)}")
    return [
        *draw_landmark(floor.geometry, code, centre, notes, 0.5e3 * floor.pitch_m - EDGE_GAP_MM),
        *north_mark((x + 3.0, y + 3.0), 5.0, "+y"),
    ]


def _draw_walls(floor: FloorMap, shift: Point, box: Box) -> list[Line]:
    """Draw the walls near a box as thick lines between their cells."""
    marks: list[Line] = []
    half = 0.5e3 * floor.pitch_m
    for first, second in sorted(floor.walls):
        (x1, y1), (x2, y2) = floor.position(first), floor.position(second)
        x, y = 500 * (x1 + x2) + shift[0], 500 * (y1 + y2) + shift[1]
        if not (box[0] - half <= x <= box[2] + half and box[1] - half <= y <= box[3] + half):
            continue
        u, v = (0.0, half) if first[0] == second[0] else (half, 0.0)
        marks.append(Line((x - u, y - v), (x + u, y + v), 2.0))
    return marks


def _wall_labels(wall: Line) -> Iterator[Text]:
    """Yield the label of a wall at positions at its right or above it, from its middle on."""
    (x0, y0), (x1, y1) = wall.start, wall.end
    for fraction in WALL_LABEL_FRACTIONS:
        x, y = x0 + fraction * (x1 - x0), y0 + fraction * (y1 - y0)
        yield Text("wall", (x + 2.0, y + 2.0), TEXT_POINTS)
