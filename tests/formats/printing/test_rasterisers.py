"""Printed pages in the rasterisers of printers, viewers and browsers.

They share nothing with the code that draws. Dots are compared with the sheet's PNG, which
test_pdf_pattern.py reads by the manifest; lines and circles with their nominal positions.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pikepdf
import pytest
from numpy.typing import NDArray

from locatk.core.dots.drawing.layout import lay_out, manifest, pixels, snap
from locatk.core.dots.drawing.test_sheet import printer_sheet
from locatk.core.dots.drawing.tiles import tiling
from locatk.core.dots.sheet import Manifest
from locatk.core.drawing import Circle, Line, Page
from locatk.core.landmarks.drawing.pack import draw_installation_pack
from locatk.core.landmarks.drawing.true_size import draw_floor
from locatk.core.landmarks.map.floor import HOLE_CODE, FloorMap
from locatk.core.paper_sizes import paper_size, parse_paper
from locatk.core.polaris.drawing.cards import draw_tag_cards
from locatk.core.polaris.tag import TagLayout, Tags, free_cells
from locatk.formats.benchmarks.dots.rasterised_sheets import overlaid_sheets
from locatk.formats.benchmarks.dots.rasterisers import RASTERISERS, Rasteriser, rasterise_inks
from locatk.formats.printing import overlay, pattern, rasters
from locatk.formats.printing.drawings import render_floor, render_pages
from locatk.formats.printing.page import CLEARANCE_MM

SLOW = ("pdf.js", "Ghostscript tiffsep")

Grey = NDArray[np.uint8]
Places = NDArray[np.float64]


@pytest.fixture(
    params=[
        pytest.param(item, id=item.name, marks=[pytest.mark.slow] if item.name in SLOW else [])
        for item in RASTERISERS
    ]
)
def rasteriser(request: pytest.FixtureRequest) -> Rasteriser:
    item: Rasteriser = request.param
    reason = item.missing()
    if reason:
        pytest.skip(reason)
    return item


def pages_of(rasteriser: Rasteriser, data: bytes, dpi: int, folder: Path) -> list[Grey]:
    path = folder / "in.pdf"
    path.write_bytes(data)
    (folder / "pages").mkdir()
    return list(rasteriser.rasterise(path, dpi, folder / "pages"))


def sheet(size: str, dpi: int, margin: float = 10.0, pitch: float = 0.508) -> Manifest:
    layout = lay_out(paper_size(size)[1], margin, snap(pitch, None, dpi))
    return manifest(layout.raster, layout.sheets("sheet-1", (184_022_430, 7200), (24, 32)), "anoto")


def png(made: Manifest, number: int = 0) -> Grey:
    stream = io.BytesIO()
    rasters.write_png(stream, made, number)
    found: Grey = cv2.imdecode(np.frombuffer(stream.getvalue(), np.uint8), cv2.IMREAD_GRAYSCALE)
    return found


def assert_dots_are_exact(page: Grey, made: Manifest, number: int = 0) -> None:
    """Each dot is black on exactly its own pixels, and nothing else is in the pattern."""
    expected = png(made, number)
    assert page.shape == expected.shape
    left, top, right, bottom = pixels(made, number).box
    near = int(
        (CLEARANCE_MM - 0.1) / 25.4 * made.dpi
    )  # marks keep this distance, but for their width
    rows = slice(max(0, top - near), bottom + near)
    area = (rows, slice(max(0, left - near), right + near))
    ink, wanted = page[area] < 128, expected[area] < 128
    assert wanted.any()
    assert ((wanted & ~ink).sum(), (ink & ~wanted).sum()) == (0, 0)


@pytest.mark.slow
def test_every_dot_is_on_its_pixels(rasteriser: Rasteriser, tmp_path: Path) -> None:
    """With the last dots at the edges of the mask, where some rasterisers clip."""
    if rasteriser.name in SLOW:
        pytest.skip("only with all kinds of pages, because it is slow")
    made = sheet("74x105mm", 300)
    (page,) = pages_of(rasteriser, pattern.render(made), 300, tmp_path)
    assert_dots_are_exact(page, made)


@pytest.mark.slow
@pytest.mark.parametrize(("dpi", "pitch"), [(600, 0.55), (1200, 0.508)])
def test_other_printers(rasteriser: Rasteriser, tmp_path: Path, dpi: int, pitch: float) -> None:
    """Dots of several pixels; 13 px of 1/600 in are no whole number of 1/300 in."""
    if rasteriser.name in SLOW:
        pytest.skip("only in `locatk bench dots`, because it is slow")
    made = sheet("40x40mm", dpi, pitch=pitch)
    (page,) = pages_of(rasteriser, pattern.render(made), dpi, tmp_path)
    assert_dots_are_exact(page, made)


@pytest.mark.slow
def test_all_kinds_of_pages(rasteriser: Rasteriser, tmp_path: Path) -> None:
    """Several bands up to the edge of the paper, tiles, overlays, and templates of magnets."""
    layout = lay_out((60, 80), 10, snap(0.508, None, 300))
    tiles = tiling(layout, (2, 1), 10).sheets("floor-1", (5000, 6000))
    over = overlaid_sheets(300)
    over.write(tmp_path / "over.pdf")
    large = sheet("A5", 300, margin=0.0)
    assert rasters.count_bands(large) > 1
    drawings = [tag_card(), landmark_template()]
    floor = manifest(layout.raster, tiles, "libdots")
    merged = pikepdf.Pdf.new()
    for data in (
        pattern.render(large, marks=False),
        pattern.render(floor, marks=False),
        (tmp_path / "over.pdf").read_bytes(),
        render_pages(drawings, "t"),
    ):
        merged.pages.extend(pikepdf.open(io.BytesIO(data)).pages)
    stream = io.BytesIO()
    merged.save(stream)
    pages = pages_of(rasteriser, stream.getvalue(), 300, tmp_path)
    made = [(large, 0), (floor, 0), (floor, 1), *((over.manifest, n) for n in range(4))]
    assert len(pages) == len(made) + len(drawings)
    for page, (printed, number) in zip(pages, made, strict=False):
        assert_dots_are_exact(page, printed, number)
    for page, drawing in zip(pages[len(made) :], drawings, strict=True):
        assert assert_drawn(page, drawing, 300) > 100


@pytest.mark.slow
def test_a_ruler_of_a_long_roll_is_not_among_its_dots(tmp_path: Path) -> None:
    """pdfium moves lines beyond 32,000 px to there."""
    if reason := RASTERISERS[0].missing():
        pytest.skip(reason)
    made = sheet("50x2900mm", 300)
    (page,) = pages_of(RASTERISERS[0], pattern.render(made), 300, tmp_path)
    assert page.shape[0] > 32_000
    assert_dots_are_exact(page, made)


@pytest.mark.slow
def test_over_colour_dots_are_black_ink_alone(tmp_path: Path) -> None:
    """On separations: the other inks continue below the dots, and black text leaves the plate."""
    if all(item.missing() for item in RASTERISERS if item.name == "Ghostscript tiffsep"):
        pytest.skip("gs is not installed")
    made = sheet("60x80mm", 300)
    pdf = pikepdf.Pdf.new()
    below = pdf.add_blank_page(page_size=(60 / 25.4 * 72, 80 / 25.4 * 72))
    below.Contents = pdf.make_stream(b"0.4 0 0 0 k 0 0 999 999 re f 0 g 40 40 60 60 re f")
    pdf.save(tmp_path / "document.pdf")
    for strip in (True, False):
        stamp = pattern.render(made, marks=False)
        data = overlay.overlay(tmp_path / "document.pdf", stamp, strip_black=strip).data
        (tmp_path / "in.pdf").write_bytes(data)
        folder = tmp_path / str(strip)
        folder.mkdir()
        (plates,) = rasterise_inks(tmp_path / "in.pdf", 300, folder)
        ink = png(made) < 128
        assert (plates["Black"][ink] == 0).all()
        assert bool((plates["Black"][~ink] == 255).all()) == strip
        # Nothing of the dots is visible in cyan: it is the same under them and beside them.
        row, column = np.argwhere(ink)[5]
        assert plates["Cyan"][row, column] == plates["Cyan"][row, column + 1]
        assert 100 < plates["Cyan"][row, column] < 200


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Ghostscript pbmraw", "MuPDF, no anti-aliasing"])
def test_test_sheet(name: str, tmp_path: Path) -> None:
    """Its fields are the PNG of an ordinary sheet at their place, and its markers are squares."""
    (rasteriser,) = (item for item in RASTERISERS if item.name == name)
    if reason := rasteriser.missing():
        pytest.skip(reason)
    made = printer_sheet("A4", 300)
    (page,) = pages_of(rasteriser, pattern.render_test_sheet(made), 300, tmp_path)
    assert page.shape == made.page[::-1]
    for field in made.fields:
        layout = field.layout
        part = layout.sheets("field", field.origin)
        left, top, right, bottom = layout.box
        wanted = png(manifest(layout.raster, part, made.codec))[top:bottom, left:right] < 128
        np.testing.assert_array_equal(page[top:bottom, left:right] < 128, wanted)
    for corner in made.corners:
        x, y = corner.at
        modules = corner.modules()
        side = len(modules) * corner.module
        wanted = np.kron(modules, np.ones((corner.module,) * 2, bool)).astype(bool)
        np.testing.assert_array_equal(page[y : y + side, x : x + side] < 128, wanted)


# ---- lines


def profile(ink: Places, place: Places, across: Places, half_px: float = 4.0) -> Places:
    """Ink (n, m) along ``across`` (n, 2), from -half_px to half_px of each place (n, 2) in px."""
    steps = np.arange(-half_px, half_px + 0.01, 0.25)
    spots = place[:, None] + steps[:, None] * across[:, None]
    return ink[
        np.clip(np.floor(spots[..., 1]).astype(int), 0, ink.shape[0] - 1),
        np.clip(np.floor(spots[..., 0]).astype(int), 0, ink.shape[1] - 1),
    ]


def some_layout(tags: Tags) -> TagLayout:
    last = tags.order - 1
    cells = [(0, 0), (0, last), (last, last), *free_cells(tags.order)[: tags.magnets - 3]]
    cells.sort(key=lambda cell: (cell[1], cell[0]))
    return TagLayout(tuple(cells), tuple(k % tags.orientations for k in range(len(cells))))


def assert_drawn(page: Grey, drawing: Page, dpi: int) -> int:
    """All long lines and circles are there, whole, and in the right places; return how many."""
    ink = (255.0 - page) / 255
    px = dpi / 25.4
    count = 0

    def to_px(points: Places) -> Places:
        return np.column_stack([points[:, 0] * px, page.shape[0] - points[:, 1] * px])

    for mark in (mark for group in drawing.groups for mark in group.marks):
        if isinstance(mark, Line) and mark.dash_mm is None:
            start, end = np.array(mark.start), np.array(mark.end)
            if (length := math.dist(start, end)) < 0.5:
                continue
            # Up to two pixels from the ends, which rasterisers round.
            inset = 2 / px / length
            points = start + np.linspace(inset, 1 - inset, max(8, int(length)))[:, None] * (
                end - start
            )
            normal = np.array([start[1] - end[1], start[0] - end[0]]) / length
            across = np.tile(normal, (len(points), 1))
        elif isinstance(mark, Circle):
            angle = np.linspace(0, 2 * np.pi, 90)
            out = np.column_stack([np.cos(angle), np.sin(angle)])
            points, across = np.array(mark.centre) + mark.radius_mm * out, out * [1, -1]
        else:
            continue
        found = profile(ink, to_px(points), across)
        steps = np.linspace(-4, 4, found.shape[1])
        # Unbroken: wherever a line is, there is ink within a pixel and a half.
        near = found[:, np.abs(steps) <= 1.5].max(axis=1)
        assert near.min() > 0.3, mark
        dark = np.where((found > 0.3) & (np.abs(steps) <= 2.5), found, 0)
        off = (dark * steps).sum(axis=1) / dark.sum(axis=1) / px
        assert abs(np.median(off)) < 0.1, mark
        count += 1
    return count


def tag_card() -> Page:
    tags = Tags()
    return draw_tag_cards(tags, [(7, some_layout(tags))], (148, 210)).pages[0]


def landmark_template() -> Page:
    floor = FloorMap(np.full((2, 2), 5), name="hall")
    return draw_installation_pack(floor, (148, 210), parts=("templates",)).pages[0]


@pytest.mark.parametrize("draw", [tag_card, landmark_template])
def test_templates_are_whole_and_at_true_size(draw: Callable[[], Page], tmp_path: Path) -> None:
    """Outlines, arrows and each tick of the rulers, in black and white at 300 dpi."""
    (rasteriser,) = (item for item in RASTERISERS if item.name == "Ghostscript pbmraw")
    if reason := rasteriser.missing():
        pytest.skip(reason)
    (page,) = pages_of(rasteriser, render_pages([draw()], "t"), 300, tmp_path)
    assert assert_drawn(page, draw(), 300) > 100


@pytest.mark.slow
def test_no_line_is_thinner_than_a_pixel_is_wide() -> None:
    """At 300 dpi, in any direction: 1.41 px. Also on a plan of small cells."""
    small = FloorMap(np.arange(36).reshape(6, 6) % 16, name="hall")
    small.codes[5, 5] = HOLE_CODE
    walled = replace(small, walls=frozenset({((0, 0), (0, 1))}))
    tags = Tags()
    drawings = [
        *draw_tag_cards(tags, [(7, some_layout(tags))], (210, 297)).pages,
        *draw_installation_pack(walled, (210, 297), parts=("plan", "templates")).pages,
    ]
    floor = draw_floor(small, parse_paper("A3"))
    widths = []
    for data in (render_pages(drawings, "t"), render_floor(floor, "t")):
        with pikepdf.open(io.BytesIO(data)) as pdf:
            for page in pdf.pages:
                for operands, operator in pikepdf.parse_content_stream(page):
                    if str(operator) == "w":
                        widths.append(float(operands[0]) / 72 * 300)
    assert min(widths) >= math.sqrt(2)
