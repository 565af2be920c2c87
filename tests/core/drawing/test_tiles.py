"""Division of large drawings over papers and rolls."""

from __future__ import annotations

import itertools
import math

import pytest

from locatk.core.drawing import Line, Text
from locatk.core.drawing.tiles import MAX_PAGE_MM, divide_area, tile_name
from locatk.core.errors import InputError
from locatk.core.paper_sizes import Paper, parse_paper

EXTENT = (-100.0, 50.0, 900.0, 650.0)


@pytest.mark.parametrize("overlap", [0.0, 10.0, 60.0])
@pytest.mark.parametrize("paper", ["A4", "A3", "Letter", "roll:297mm", "A0"])
def test_tiles_cover_the_drawing_and_are_cut_at_common_seams(paper: str, overlap: float) -> None:
    grid = divide_area(EXTENT, parse_paper(paper), 10.0, overlap)
    tiles = grid.tiles()
    assert len(tiles) == grid.tile_count == math.prod(grid.count)
    for axis in (0, 1):
        side = grid.tile_mm[axis]
        corners = sorted({round(tile.corner_mm[axis], 9) for tile in tiles})
        assert len(corners) == grid.count[axis]
        assert corners[0] <= EXTENT[axis]
        assert corners[-1] + side >= EXTENT[axis + 2]
        # The drawing is centred, and neighbours share the overlap.
        border = (EXTENT[axis] - corners[0], corners[-1] + side - EXTENT[axis + 2])
        assert border[0] == pytest.approx(border[1], abs=1e-6)
        for low, high in itertools.pairwise(corners):
            assert low + side - high == pytest.approx(overlap, abs=1e-6)
        cuts = {
            round(seam - tile.box[axis] + tile.corner_mm[axis], 6)
            for tile in tiles
            for seam in tile.seams[axis]
        }
        expected = [low + overlap / 2 for low in corners[1:]]
        assert sorted(cuts) == pytest.approx(expected, abs=1e-5)


def test_tiles_are_named_by_column_and_row_from_the_upper_left() -> None:
    grid = divide_area(EXTENT, parse_paper("A3"), 10.0, 10.0)
    tiles = grid.tiles()
    assert tiles[0].name == tile_name(0, grid.count[0]) == "c1r1"
    assert tiles[-1].name == f"c{grid.count[0]}r{grid.count[1]}"
    assert tiles[0].corner_mm[0] < tiles[1].corner_mm[0]
    assert tiles[0].corner_mm[1] > tiles[-1].corner_mm[1]


def test_seam_marks_name_the_neighbour_beyond_each_cut() -> None:
    grid = divide_area(EXTENT, parse_paper("A3"), 10.0, 10.0)
    columns, rows = grid.count
    tiles = {tile.name: tile for tile in grid.tiles()}
    for row, column in itertools.product(range(rows), range(columns)):
        tile = tiles[f"c{column + 1}r{row + 1}"]
        marks = tile.seam_marks()
        names = {mark.text for mark in marks if isinstance(mark, Text)}
        neighbours = ((row, column - 1), (row, column + 1), (row - 1, column), (row + 1, column))
        assert names == {
            f"joins c{c + 1}r{r + 1}" for r, c in neighbours if 0 <= r < rows and 0 <= c < columns
        }
        left, bottom, right, top = tile.box
        half = len(marks) // 2
        for line, label in zip(marks[:half], marks[half:], strict=True):
            assert isinstance(line, Line)
            assert isinstance(label, Text)
            # The label is within the tile, on the inner side of the cut.
            x, y = label.position
            is_upright = line.start[0] == line.end[0]
            cut = line.start[0] if is_upright else line.start[1]
            assert cut in (tile.seams[0] if is_upright else tile.seams[1])
            centre = (left + right) / 2 if is_upright else (bottom + top) / 2
            offset = (x if is_upright else y) - cut
            assert offset * (centre - cut) > 0
            neighbour = tiles[label.text.removeprefix("joins ")]
            axis = 0 if is_upright else 1
            direction = neighbour.corner_mm[axis] - tile.corner_mm[axis]
            assert direction * (cut - centre) > 0


def test_the_orientation_with_the_fewest_pages_is_taken() -> None:
    grid = divide_area((0.0, 0.0, 260.0, 180.0), parse_paper("A4"), 10.0, 10.0)
    assert (grid.count, grid.page_mm) == ((1, 1), (297.0, 210.0))
    tall = divide_area((0.0, 0.0, 180.0, 260.0), parse_paper("A4"), 10.0, 10.0)
    assert (tall.count, tall.page_mm) == ((1, 1), (210.0, 297.0))


def test_a_roll_is_cut_to_length() -> None:
    grid = divide_area((0.0, 0.0, 800.0, 3000.5), parse_paper("roll:914mm"), 10.0, 10.0)
    assert (grid.count, grid.page_mm) == ((1, 1), (914.0, 3021.0))
    long = divide_area((0.0, 0.0, 800.0, 12_000.0), parse_paper("roll:914mm"), 10.0, 10.0)
    assert long.count == (1, 3)
    assert max(long.page_mm) <= MAX_PAGE_MM


def test_a_large_sheet_is_not_cut_to_length() -> None:
    grid = divide_area((0.0, 0.0, 100.0, 100.0), Paper("A4", (210.0, 297.0)), 10.0, 10.0)
    assert sorted(grid.page_mm) == [210.0, 297.0]


@pytest.mark.parametrize("overlap", [-1.0, 96.0, math.nan])
def test_overlaps_beyond_half_a_tile_are_rejected(overlap: float) -> None:
    divide_area(EXTENT, parse_paper("A4"), 10.0, 95.0)
    with pytest.raises(InputError, match="overlap"):
        divide_area(EXTENT, parse_paper("A4"), 10.0, overlap)


def test_margins_wider_than_the_paper_are_rejected() -> None:
    with pytest.raises(InputError, match="leave nothing"):
        divide_area(EXTENT, parse_paper("A4"), 110.0, 0.0)
    with pytest.raises(InputError, match="below 0"):
        divide_area(EXTENT, parse_paper("A4"), 10.0, -1.0)
