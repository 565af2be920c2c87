"""Installation packs, measured on the rastered page.

Where a bar must lie is computed here from the facts' words (bar k at 90 k degrees, tangential,
N counter-clockwise), not from the drawing's code.
"""

from __future__ import annotations

import io
import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pikepdf
import pypdfium2
import pytest
from numpy.typing import NDArray

from locatk.core.drawing import Line, Page, Text
from locatk.core.drawing.tiles import Tile
from locatk.core.errors import InputError
from locatk.core.landmarks.drawing.pack import PACK_PARTS, draw_installation_pack
from locatk.core.landmarks.drawing.true_size import draw_floor
from locatk.core.landmarks.landmark import Geometry
from locatk.core.landmarks.map.floor import HOLE_CODE, FloorMap
from locatk.core.paper_sizes import parse_paper
from locatk.formats.printing.drawings import render_floor, render_pages

DPI = 300
PX = DPI / 25.4
A4, A3, LETTER = (210.0, 297.0), (297.0, 420.0), (215.9, 279.4)

Places = NDArray[np.float64]

SMALL = Geometry(bar_length_m=0.02, bar_width_m=0.005, radius_m=0.02)


def some_floor(rows: int, columns: int, **more: Any) -> FloorMap:
    codes = np.random.default_rng(7).integers(0, 16, (rows, columns))
    return replace(FloorMap(codes, name="hall 3"), **more)


HALL = some_floor(
    5,
    4,
    pitch_m=0.18,
    origin_m=(-0.4, 1.0),
    walls=frozenset({((0, 0), (0, 1)), ((2, 2), (3, 2))}),
)
HALL.codes[1, 2] = HOLE_CODE


def ink(data: bytes, number: int = 0, dpi: float = DPI) -> Places:
    """How dark each pixel is, 0 to 1, row 0 at the top."""
    sheet = pypdfium2.PdfDocument(data)[number]
    grey = sheet.render(scale=dpi / 72, grayscale=True).to_numpy().squeeze()
    return (255.0 - grey) / 255


def at(dark: Places, x: Places, y: Places) -> Places:
    """Ink at places in mm from the lower left corner."""
    return dark[
        np.floor(dark.shape[0] - np.asarray(y) * PX).astype(int),
        np.floor(np.asarray(x) * PX).astype(int),
    ]


def edge(dark: Places, place: Places, across: Places) -> float:
    """How far in mm, along ``across``, a line lies from where it should; nan if there is none."""
    off = np.arange(-1.2, 1.2, 0.02)
    found = at(dark, place[0] + off * across[0], place[1] + off * across[1])
    found = np.where(found > 0.3, found, 0)
    return float(np.average(off, weights=found)) if found.any() else math.nan


def bars(geometry: Geometry, code: int) -> list[tuple[Places, Places, Places, bool]]:
    """Middle, outward and north direction of each bar, and whether it is N."""
    found = []
    for k in range(4):
        turn = math.radians(90 * k)
        out = np.array([math.cos(turn), math.sin(turn)])
        around = np.array([-math.sin(turn), math.cos(turn)])
        is_n = bool(code >> k & 1)
        found.append((1e3 * geometry.radius_m * out, out, around if is_n else -around, is_n))
    return found


def measure(
    dark: Places, geometry: Geometry, code: int, centre: tuple[float, float]
) -> list[float]:
    """Errors in mm of the outlines of a landmark at ``centre``, that must lie as ``code``."""
    length, width = 1e3 * geometry.bar_length_m, 1e3 * geometry.bar_width_m
    errors = []
    for middle, out, north, _ in bars(geometry, code):
        place = np.add(centre, middle)
        for side, share in itertools.product((-1, 1), (-0.25, 0.25)):
            # Off the middle, where crosses are.
            errors.append(edge(dark, place + side * width / 2 * out + share * length * north, out))
            ends = place + side * length / 2 * north + share * 1.3 * width * out
            errors.append(edge(dark, ends, north))
        # The arrow within has its head, which is wider than its line, at the north.
        heads = []
        for side in (1, -1):
            along = np.arange(0.05, 0.3, 0.01)[:, None, None] * length * side * north
            off = np.arange(-0.15, 0.15, 0.01)[None, :, None] * width * out
            spot = place + along + off
            heads.append(at(dark, spot[..., 0], spot[..., 1]).sum())
        assert heads[0] > 1.3 * heads[1], "the arrow points the other way"
    return errors


@pytest.mark.slow
@pytest.mark.parametrize(
    ("floor", "size", "code"),
    [
        (HALL, A4, None),
        (HALL, LETTER, 3),
        (replace(HALL, geometry=SMALL), A3, None),
        (replace(HALL, pitch_m=1.5), A3, 9),
    ],
)
def test_templates_have_their_bars_at_true_size(
    floor: FloorMap, size: tuple[float, float], code: int | None
) -> None:
    if code is not None:
        floor = replace(floor, codes=np.full((2, 2), code))
    made = draw_installation_pack(floor, size, parts=("templates",))
    laid = {int(value) for value in floor.codes.ravel()} - {HOLE_CODE}
    assert [item.code for item in made.templates] == sorted(laid)
    data = render_pages(made.pages, "t")
    for item in made.templates[:: 1 if code is not None else 3]:
        dark = ink(data, item.page)
        errors = measure(dark, floor.geometry, item.code, item.centre_mm)
        assert np.abs(errors).max() < 0.1
        assert item.cells == int((floor.codes == item.code).sum())


def test_templates_end_half_way_to_the_next_cell_where_there_is_room() -> None:
    for size, side in ((A3, 180.0), (A4, None)):
        made = draw_installation_pack(HALL, size, parts=("templates",))
        assert made.templates[0].side_mm == side or side is None
        x, y = made.templates[0].centre_mm
        half = made.templates[0].side_mm / 2
        marks = made.pages[0].groups[1].marks
        cuts = {
            (round(place[0] - x, 3), round(place[1] - y, 3))
            for mark in marks
            if isinstance(mark, Line)
            for place in (mark.start, mark.end)
        }
        assert {(half + 1, half), (-half, -half - 1), (half, 0), (0, half)} <= cuts


def words(data: bytes, number: int = 0) -> list[tuple[str, float, float, float]]:
    """Each letter with the middle of its box, and its height, in mm."""
    page = pypdfium2.PdfDocument(data)[number].get_textpage()
    text = page.get_text_range()
    found = []
    for index, letter in enumerate(text):
        left, bottom, right, top = (edge * 25.4 / 72 for edge in page.get_charbox(index))
        found.append((letter, (left + right) / 2, (bottom + top) / 2, top - bottom))
    return found


def text_of(data: bytes, number: int) -> str:
    page = pypdfium2.PdfDocument(data)[number].get_textpage()
    return " ".join(page.get_text_range().split())


@pytest.mark.parametrize("code", [0b0111, 0b1001, 0b0000])
def test_poles_are_lettered(code: int) -> None:
    floor = replace(HALL, codes=np.array([[code]]), walls=frozenset())
    made = draw_installation_pack(floor, A4, parts=("templates",))
    (item,) = made.templates
    data = render_pages(made.pages, "t")
    letters = [(c, x, y) for c, x, y, height in words(data, item.page) if height > 3.5]
    assert len(letters) == 8
    for middle, _, north, _ in bars(floor.geometry, code):
        for sign, pole in ((1, "N"), (-1, "S")):
            spot = np.add(item.centre_mm, middle) + sign * 11.5 * north
            near = min(letters, key=lambda letter: math.dist(letter[1:], spot))
            assert near[0] == pole
            assert math.dist(near[1:], spot) < 1.0
    said = text_of(data, item.page)
    for bar in range(4):
        assert f"bar {bar}: {'N (ccw)' if code >> bar & 1 else 'S (cw)'}" in said
    assert f"Code {code:x} = " in said
    assert "1 cell" in said
    assert "map +y" in said


def longest_runs(strip: NDArray[np.bool_]) -> tuple[int, int, int]:
    """Length, first pixel and row of the longest line."""
    runs = []
    for number, line in enumerate(strip):
        ends = np.flatnonzero(np.diff(np.r_[0, line.astype(np.int8), 0])).reshape(-1, 2)
        runs += [(b - a, a, number) for a, b in ends]
    return max(runs)


def check_rulers(data: bytes, number: int) -> None:
    dark = ink(data, number, dpi=600) > 0.5
    px = 600 / 25.4
    below = dark[-round(15.5 * px) : -round(4 * px), : round(125 * px)]
    beside = dark[-round(125 * px) :, round(4 * px) : round(15.5 * px)].T[::-1]
    for strip in (below, beside):
        length, first, row = longest_runs(strip)
        assert length / px == pytest.approx(100, abs=0.2)
        ticks = np.diff(np.r_[0, strip[row + 12, first - 9 : first + length + 9].astype(np.int8)])
        assert (ticks == 1).sum() == 101


@pytest.mark.slow
@pytest.mark.parametrize("part", PACK_PARTS)
def test_rulers_are_100_mm(part: str) -> None:
    check_rulers(render_pages(draw_installation_pack(HALL, A4, parts=(part,)).pages, "t"), 0)


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(2, 2), (24, 24), (3, 28)])
def test_the_plan_shows_each_code_in_its_place(shape: tuple[int, int]) -> None:
    floor = some_floor(*shape)
    pages = draw_installation_pack(floor, A4, parts=("plan",)).pages
    (plan,) = [group for page in pages for group in page.groups if group.name == "plan"]
    scale = float(next(m.text for m in all_words(pages) if m.text.startswith("Scale"))[10:])
    cell = 200 / scale
    data = render_pages(pages, "t")
    height = max(mark.points for mark in plan.marks if isinstance(mark, Text) and mark.bold)
    low = 0.85 * height * 0.5 * 25.4 / 72
    digits = [found for found in words(data) if found[3] > low and found[0] in "0123456789abcdef"]
    # The plan is the largest lattice of big digits; titles are not on it.
    xs = np.array([found[1:3] for found in digits])
    marks = [
        m
        for m in plan.marks
        if isinstance(m, Text) and m.points == height and m.bold and m.anchor == "middle"
    ]
    assert len(marks) == floor.codes.size
    first = np.array(marks[0].position) + [0, 0.36 * height * 25.4 / 72]
    for (row, column), code in np.ndenumerate(floor.codes):
        spot = first + cell * np.array([column, row])
        near = int(np.argmin(np.hypot(*(xs - spot).T)))
        assert math.dist(xs[near], spot) < 0.25 * cell
        assert digits[near][0] == f"{code:x}"


def all_words(pages: tuple[Page, ...]) -> list[Text]:
    return [
        mark
        for page in pages
        for group in page.groups
        for mark in group.marks
        if isinstance(mark, Text)
    ]


@pytest.mark.slow
def test_large_plans_are_cut_into_pages_that_hold_each_cell_once() -> None:
    floor = some_floor(70, 61)
    pages = draw_installation_pack(floor, A4, parts=("plan",)).pages
    assert len(pages) > 3
    seen = sum(
        isinstance(mark, Text) and mark.bold and len(mark.text) == 1 and mark.anchor == "middle"
        for page in pages
        for group in page.groups
        if group.name == "plan"
        for mark in group.marks
    )
    assert seen == floor.codes.size
    said = text_of(render_pages(pages[:1], "t"), 0)
    assert "c1r1" in said
    corner = text_of(render_pages(pages[1:2], "t"), 0)
    assert "rows" in corner
    assert "to 69" in corner, "the first is the upper left one"
    assert "13800" in corner


def test_holes_walls_and_axes_are_on_the_plan() -> None:
    pages = draw_installation_pack(HALL, A4, parts=("plan",)).pages
    plan = next(group for group in pages[0].groups if group.name == "plan")
    thick = [m for m in plan.marks if isinstance(m, Line) and m.width_mm > 0.8]
    assert len(thick) == 2
    level = [m for m in thick if abs(m.start[1] - m.end[1]) < 1e-9]
    upright = [m for m in thick if abs(m.start[0] - m.end[0]) < 1e-9]
    assert len(level) == len(upright) == 1, "one wall to the right of a cell, one above"
    slanted = [
        m
        for m in plan.marks
        if isinstance(m, Line)
        and abs(abs(m.start[0] - m.end[0]) - abs(m.start[1] - m.end[1])) < 1e-6
    ]
    assert len(slanted) == 2, "a hole is crossed"
    said = text_of(render_pages(pages, "t"), 0)
    for part in (
        "map +y",
        "+x",
        "+y",
        "-400",
        "1720",
        "Window L",
        "5 rows x 4 columns",
        "19 landmarks",
    ):
        assert part in said


FLOORS = [
    (HALL, "A4", 10.0),
    (HALL, "A3", 80.0),
    (replace(HALL, geometry=SMALL, pitch_m=0.1), "A2", 10.0),
    (HALL, "roll:500mm", 10.0),
]


@pytest.mark.slow
@pytest.mark.parametrize(("floor", "name", "overlap"), FLOORS)
def test_the_floor_at_true_size_is_whole(floor: FloorMap, name: str, overlap: float) -> None:
    pages = draw_floor(floor, parse_paper(name), overlap_mm=overlap)
    tiles = [page.tile for page in pages]
    data = render_floor(pages, "t")
    assert len(pypdfium2.PdfDocument(data)) == len(tiles)
    whole = set()
    for number in range(0, len(tiles), max(1, len(tiles) // 4)):
        check_tile(floor, tiles[number], ink(data, number))
    for tile in tiles:
        whole |= held(floor, tile)
    if overlap > 64 or len(tiles) == 1:
        assert whole == set(floor.cells())
    # Each point of the floor is on a tile, and neighbours cut at the same place.
    for axis in (0, 1):
        edges = sorted(
            {
                (
                    round(tile.corner_mm[axis], 6),
                    round(tile.corner_mm[axis] + span(tile, axis), 6),
                )
                for tile in tiles
            }
        )
        for one, two in itertools.pairwise(edges):
            assert one[1] - two[0] == pytest.approx(overlap, abs=1e-6)
        cuts = sorted(
            round(seam - tile.box[axis] + tile.corner_mm[axis], 6)
            for tile in tiles
            for seam in tile.seams[axis]
        )
        assert len(set(cuts)) == len(edges) - 1
        place = [1e3 * floor.position(cell)[axis] for cell in floor.cells()]
        assert edges[0][0] + 30 <= min(place)
        assert max(place) <= edges[-1][1] - 30


def span(tile: Tile, axis: int) -> float:
    return tile.box[axis + 2] - tile.box[axis]


def held(floor: FloorMap, tile: Tile) -> set[tuple[int, int]]:
    """Cells whose bars are all within a tile."""
    out = 1e3 * (floor.geometry.radius_m + floor.geometry.bar_width_m / 2) + 1.5
    return {
        cell
        for cell in floor.cells()
        if all(
            tile.corner_mm[axis] + out <= 1e3 * floor.position(cell)[axis]
            and 1e3 * floor.position(cell)[axis] <= tile.corner_mm[axis] + span(tile, axis) - out
            for axis in (0, 1)
        )
    }


def check_tile(floor: FloorMap, tile: Tile, dark: Places) -> None:
    for cell in sorted(held(floor, tile))[:4]:
        centre = [
            1e3 * floor.position(cell)[axis] - tile.corner_mm[axis] + tile.box[axis]
            for axis in (0, 1)
        ]
        errors = measure(dark, floor.geometry, int(floor.codes[cell]), (centre[0], centre[1]))
        assert np.abs(errors).max() < 0.1
    for x in tile.seams[0]:
        for y in (tile.box[1] - 3.5, tile.box[3] + 3.5):
            assert at(dark, np.array([x]), np.array([y]))[0] > 0.3, "no joining mark"
    edge_px = round(2 * PX)
    assert dark[:edge_px].max() == 0
    assert dark[:, -edge_px:].max() == 0


@pytest.mark.slow
def test_floors_have_rulers() -> None:
    tiles = draw_floor(HALL, parse_paper("A3"))
    dark = ink(render_floor(tiles[:1], "t"), dpi=600) > 0.5
    px = 600 / 25.4
    length, _, _ = longest_runs(dark[-round(9.5 * px) : -round(3 * px), : round(140 * px)])
    assert length / px == pytest.approx(100, abs=0.2)


def test_a_roll_is_as_long_as_it_needs_to_be() -> None:
    (tile,) = draw_floor(HALL, parse_paper("roll:914mm"))
    # 4 x 5 cells of 180 mm and what is drawn around them; the roll may lie either way.
    assert 914.0 in tile.size_mm
    assert 540 + 110 < min(tile.size_mm) < 914
    long = some_floor(60, 2)
    strips = draw_floor(long, parse_paper("roll:914mm"))
    assert len(strips) == 3
    assert max(max(strip.size_mm) for strip in strips) <= 5080


@pytest.mark.parametrize("text", ["roll", "roll:", "roll:0mm", "roll:wide", "roll:99999mm", "A17"])
def test_papers_that_are_none(text: str) -> None:
    with pytest.raises(InputError, match="paper"):
        parse_paper(text)


def test_tables_say_what_the_map_says() -> None:
    made = draw_installation_pack(HALL, A4)
    data = render_pages(made.pages, "t")
    assert tuple(made.parts) == PACK_PARTS
    assert made.parts["list"][1] == len(made.pages)
    listed = text_of(data, made.parts["list"][0])
    for row, column in HALL.cells():
        code = int(HALL.codes[row, column])
        bits = "".join("N" if code >> bar & 1 else "S" for bar in range(4))
        x, y = -400 + 180 * column, 1000 + 180 * row
        assert f"{row} {column} {x} {y} {code:x} {bits}" in listed
    assert listed.count("[ ]") == 19
    bill = text_of(data, made.parts["materials"][0])
    assert "bar magnet 76 - - 30 x 10 x 5 mm NdFeB" in bill
    assert "spare 4 " in bill
    checks = text_of(data, made.parts["checklist"][0])
    for part in ("compass", "100 mm of a bar", "locatk map check", "locatk calibrate map", "SOUTH"):
        assert part in checks
    assert f"{math.hypot(540, 720):.0f} mm each" in checks


@pytest.mark.slow
def test_the_list_of_a_large_floor_is_whole() -> None:
    floor = some_floor(30, 31)
    made = draw_installation_pack(floor, A4, parts=("list",))
    assert len(made.pages) > 3
    data = render_pages(made.pages, "t")
    said = [text_of(data, number) for number in range(len(made.pages))]
    assert sum(text.count("[ ]") for text in said) == 930


def largest_text_overlap(pages: tuple[Page, ...], thin: float) -> float:
    """The most ink of words on that of lines which are not thinner than ``thin``."""

    def only(keep: Callable[[Any], bool]) -> Places:
        kept = tuple(
            replace(
                page,
                groups=tuple(
                    replace(group, marks=tuple(filter(keep, group.marks))) for group in page.groups
                ),
            )
            for page in pages
        )
        return ink(render_pages(kept, "t"), dpi=150)

    letters = only(lambda mark: isinstance(mark, Text))
    rest = only(
        lambda mark: (
            not isinstance(mark, Text)
            and getattr(mark, "dash_mm", None) is None
            and mark.width_mm > thin
        )
    )
    assert letters.max() > 0.9
    return float(np.minimum(letters, rest).max())


@pytest.mark.slow
@pytest.mark.parametrize("part", PACK_PARTS)
@pytest.mark.parametrize("size", [A4, A3])
def test_words_are_not_drawn_over(part: str, size: tuple[float, float]) -> None:
    for origin in ((-0.4, 1.0), (-0.18, -0.36)):
        pages = draw_installation_pack(replace(HALL, origin_m=origin), size, parts=(part,)).pages
        assert largest_text_overlap(pages[:1], 0.07) < 0.3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shape", "part"),
    [
        *(((rows, columns), "plan") for rows, columns in ((1, 1), (1, 30), (30, 1))),
        *(((20, 20), part) for part in PACK_PARTS),
        ((60, 60), "plan"),
    ],
)
def test_pages_keep_their_margins(shape: tuple[int, int], part: str) -> None:
    floor = some_floor(*shape, origin_m=(-12.3456, 0.1))
    data = render_pages(draw_installation_pack(floor, A4, parts=(part,)).pages[:2], "t")
    for number in range(len(pypdfium2.PdfDocument(data))):
        dark = ink(data, number, dpi=75)
        rim = math.floor(10 / 25.4 * 75) - 1
        inside = np.zeros_like(dark, bool)
        inside[rim:-rim, rim:-rim] = True
        assert dark[~inside].max() == 0, "the margin is not empty"
        assert dark.max() > 0.3


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(InputError, match="paper A6 ") as caught:
        draw_installation_pack(HALL, (105.0, 148.0), paper_name="A6", parts=("templates",))
    assert caught.value.hint is not None
    wide, high = caught.value.hint.split()[-1].removesuffix("mm").split("x")
    assert draw_installation_pack(HALL, (float(wide), float(high)), parts=("templates",)).templates
    with pytest.raises(InputError, match="margin"):
        draw_installation_pack(HALL, A4, margin_mm=100)
    with pytest.raises(InputError, match="pages of A4"):
        draw_floor(some_floor(40, 40), parse_paper("A4"))
    with pytest.raises(InputError, match="overlap"):
        draw_floor(HALL, parse_paper("A4"), overlap_mm=150)
    with pytest.raises(InputError, match="joining marks"):
        draw_floor(HALL, parse_paper("A4"), margin_mm=3)
    with pytest.raises(InputError, match="overlap at a pitch"):
        draw_floor(replace(HALL, pitch_m=0.03), parse_paper("A4"))


@pytest.mark.slow
def test_same_input_same_bytes_in_one_ink(assert_one_ink: Callable[[Any], None]) -> None:
    floor = replace(HALL, name="Лаборатория (1)")
    first, second = (render_pages(draw_installation_pack(floor, A4).pages, "t") for _ in range(2))
    assert first == second
    tiles = [draw_floor(floor, parse_paper("A3")) for _ in range(2)]
    assert render_floor(tiles[0], "t") == render_floor(tiles[1], "t")
    for data in (first, render_floor(tiles[0], "t")):
        with pikepdf.open(io.BytesIO(data)) as pdf:
            assert pdf.Root.ViewerPreferences.PrintScaling == "/None"
            for sheet in pdf.pages:
                assert_one_ink(sheet)
