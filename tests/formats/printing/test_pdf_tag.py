"""Placement templates of tags, measured on the rastered page with a ruler of their own.

Where a magnet must lie is computed here from the paper's words (v1 lower left with forward
up, orientations clockwise from up), not from the drawing's code.
"""

from __future__ import annotations

import io
import math
import random
from collections.abc import Callable
from dataclasses import replace
from itertools import combinations
from typing import Any
from xml.etree import ElementTree as Xml

import cv2
import numpy as np
import pikepdf
import pypdfium2
import pytest
from numpy.typing import NDArray

from locatk.core.drawing import Group, Line, Mark, Page, Text
from locatk.core.errors import InputError
from locatk.core.polaris.drawing.cards import draw_tag_cards
from locatk.core.polaris.tag import AsBuiltTag, Magnet, TagLayout, Tags, free_cells
from locatk.formats.printing.drawings import render_pages, render_svg

DPI = 300
A4, LETTER = (210.0, 297.0), (215.9, 279.4)
SVG = {"s": "http://www.w3.org/2000/svg"}

FULL = Tags()
MINI = Tags(magnets=3, spacing_m=0.008, magnet=Magnet(1e-3, 0.5e-3), clearance_m=0.005)
DENSE = Tags(order=5, magnets=13, orientations=20, spacing_m=0.016)
EVEN = Tags(order=4, magnets=8, orientations=16, spacing_m=0.03, magnet=Magnet(3e-3, 1e-3))

Places = NDArray[np.float64]


def some_layout(tags: Tags, seed: int) -> TagLayout:
    draw = random.Random(seed)
    last = tags.order - 1
    cells = [(0, 0), (0, last), (last, last)]
    cells += draw.sample(free_cells(tags.order), tags.magnets - 3)
    cells.sort(key=lambda cell: (cell[1], cell[0]))
    return TagLayout(tuple(cells), tuple(draw.randrange(tags.orientations) for _ in cells))


def some(tags: Tags, count: int) -> list[tuple[int, TagLayout]]:
    return [(1000 + seed, some_layout(tags, seed)) for seed in range(count)]


def expected(
    tags: Tags, layout: TagLayout, origin: tuple[float, float], mirror: bool = False
) -> tuple[Places, Places]:
    """Places on the page in mm, and angles clockwise from up in degrees."""
    cell = np.array(layout.cells, float) - (tags.order - 1) / 2
    angle = np.array(layout.symbols) * 360.0 / tags.orientations
    side = -1.0 if mirror else 1.0
    return np.array(origin) + cell * [side * 1e3 * tags.spacing_m, 1e3 * tags.spacing_m], (
        side * angle
    ) % 360


def only(pages: tuple[Page, ...], *, words: bool) -> tuple[Page, ...]:
    """The pages with nothing but words, or without words and without the grid's dashes."""

    def chosen(mark: Mark) -> bool:
        if isinstance(mark, Text):
            return words
        return not words and not (isinstance(mark, Line) and mark.dash_mm is not None)

    return tuple(
        replace(
            page,
            groups=tuple(
                Group(group.name, tuple(filter(chosen, group.marks))) for group in page.groups
            ),
        )
        for page in pages
    )


def ink(pages: tuple[Page, ...], number: int = 0, dpi: float = DPI) -> Places:
    """How dark each pixel is, 0 to 1, row 0 at the top."""
    sheet = pypdfium2.PdfDocument(render_pages(pages, "test"))[number]
    grey = sheet.render(scale=dpi / 72, grayscale=True).to_numpy().squeeze()
    return (255.0 - grey) / 255


def find_circles(dark: Places, diameter_mm: float, dpi: float = DPI) -> Places:
    """Middles, in mm from the lower left corner, of circles of this diameter: dark rings
    between light ones."""
    px = dpi / 25.4
    radius = diameter_mm / 2 * px
    half = math.ceil(radius) + 5
    y, x = np.mgrid[-half : half + 1, -half : half + 1]
    off = np.hypot(x, y) - radius
    ring, beside = np.clip(1.2 - np.abs(off), 0, 1), np.abs(np.abs(off) - 3.5) < 1
    kernel = ring / ring.sum() - beside / beside.sum()
    found = cv2.filter2D(np.clip(2 * dark, 0, 1).astype(np.float32), -1, kernel)
    peaks = (found > 0.5) & (found == cv2.dilate(found, np.ones((2 * half + 1,) * 2)))
    middles = []
    for row, column in np.argwhere(peaks):
        near = np.clip(found[row - 1 : row + 2, column - 1 : column + 2], 0, None) ** 4
        dy, dx = (np.average(axis, weights=near) for axis in np.mgrid[-1:2, -1:2])
        middles.append(((column + dx + 0.5) / px, (dark.shape[0] - row - dy - 0.5) / px))
    return np.array(middles)


def find_north(dark: Places, middle: Places, reach: tuple[float, float], dpi: float = DPI) -> float:
    """Degrees clockwise from up in which an arrow points, by its ink between two radii."""
    px = dpi / 25.4
    degrees = np.arange(0, 360, 0.5)
    radius = np.arange(*reach, 0.5 / px)[:, None]
    x = (middle[0] + radius * np.sin(np.radians(degrees))) * px - 0.5
    y = dark.shape[0] - (middle[1] + radius * np.cos(np.radians(degrees))) * px - 0.5
    rays = cv2.remap(
        dark.astype(np.float32), x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR
    ).mean(axis=0)
    best = int(rays.argmax())
    near = np.arange(best - 16, best + 17)
    off = np.average((near - best) * 0.5, weights=rays[near % len(rays)] ** 2)
    return float((degrees[best] + off) % 360)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tags", "paper", "mirror", "reach", "dpi"),
    [
        (FULL, A4, False, (4.0, 9.5), 300),
        (FULL, LETTER, True, (4.0, 9.5), 300),
        (MINI, (110.0, 100.0), False, (1.3, 2.8), 600),
        (DENSE, LETTER, False, (2.5, 5.6), 300),
        (EVEN, A4, False, (4.0, 9.5), 300),
    ],
)
def test_magnets_lie_and_point_where_the_id_says(
    tags: Tags, paper: tuple[float, float], mirror: bool, reach: tuple[float, float], dpi: int
) -> None:
    wanted = some(tags, 2)
    made = draw_tag_cards(tags, wanted, paper, mirror=mirror)
    assert [(item.tag_id, item.page) for item in made.tags] == [(1000, 0), (1001, 0)]
    # Some letters are rings of 1 mm, too.
    dark = ink(only(made.pages, words=False), dpi=dpi)
    found = find_circles(dark, 1e3 * tags.magnet.diameter_m, dpi)
    truth = [
        expected(tags, layout, item.origin_mm, mirror)
        for (_, layout), item in zip(wanted, made.tags, strict=True)
    ]
    places, angles = (np.concatenate(part) for part in zip(*truth, strict=True))
    assert len(found) == len(places)
    distance = np.linalg.norm(found[:, None] - places, axis=2)
    assert sorted(distance.argmin(axis=1)) == list(range(len(places)))
    assert distance.min(axis=1).max() < 0.1
    for middle, which in zip(found, distance.argmin(axis=1), strict=True):
        off = (find_north(dark, middle, reach, dpi) - angles[which] + 180) % 360 - 180
        assert abs(off) < 0.5, f"magnet {which} points {off:.1f} degrees wrong"


@pytest.mark.slow
@pytest.mark.parametrize("paper", [A4, LETTER])
def test_rulers_are_100_mm(paper: tuple[float, float]) -> None:
    made = draw_tag_cards(MINI, some(MINI, 1), paper)
    dark = ink(made.pages, dpi=600) > 0.5
    px = 600 / 25.4
    below, beside = dark[-round(16 * px) :], dark[:, : round(15.9 * px)].T[::-1]
    for strip in (below, beside):
        runs = []
        for number, line in enumerate(strip):
            edges = np.flatnonzero(np.diff(np.r_[0, line.astype(np.int8), 0])).reshape(-1, 2)
            runs += [(b - a, a, number) for a, b in edges]
        length, first, row = max(runs)
        assert length / px == pytest.approx(100, abs=0.2)
        ticks = np.diff(np.r_[0, strip[row + 12, first - 9 : first + length + 9].astype(np.int8)])
        assert (ticks == 1).sum() == 101
        np.testing.assert_allclose(np.diff(np.flatnonzero(ticks == 1)), px, atol=1.01)


def group_box(group: Xml.Element) -> tuple[float, float, float, float]:
    """Left, top, right, bottom of what a group of an SVG draws; text by its anchor."""
    x, y = [], []
    for mark in group:
        if mark.tag.endswith("circle"):
            cx, cy, r = (float(mark.attrib[key]) for key in ("cx", "cy", "r"))
            x += [cx - r, cx + r]
            y += [cy - r, cy + r]
        elif mark.tag.endswith("polygon"):
            points = np.array([p.split(",") for p in mark.attrib["points"].split()], float)
            x += list(points[:, 0])
            y += list(points[:, 1])
        else:
            x += [float(value) for key, value in mark.attrib.items() if key in ("x", "x1", "x2")]
            y += [float(value) for key, value in mark.attrib.items() if key in ("y", "y1", "y2")]
    return min(x), min(y), max(x), max(y)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tags", "count", "paper", "mirror"),
    [
        (MINI, 30, A4, False),
        (MINI, 30, LETTER, True),
        (FULL, 3, A4, True),
        (DENSE, 5, (297.0, 420.0), False),
    ],
)
def test_tags_share_pages_without_touching(
    tags: Tags, count: int, paper: tuple[float, float], mirror: bool
) -> None:
    made = draw_tag_cards(tags, some(tags, count), paper, mirror=mirror)
    seen = []
    for number, page in enumerate(made.pages):
        dark = ink(made.pages, number, dpi=100)
        edge = round(10 / 25.4 * 100) - 2
        inside = np.zeros_like(dark, bool)
        inside[edge:-edge, edge:-edge] = True
        assert dark[~inside].max() == 0, "the margin is not empty"
        root = Xml.fromstring(render_svg(page, "test"))
        groups = root.findall("s:g/s:g", SVG)
        assert groups[0].attrib["id"] == "page"
        ruler = group_box(groups[0])
        boxes = [group_box(group) for group in groups[1:]]
        seen += [group.attrib["id"] for group in groups[1:]]
        for one, other in combinations(boxes, 2):
            # Cut marks of neighbours, 3 mm each, share the 5 mm between two cards.
            apart = max(one[0] - other[2], other[0] - one[2], one[1] - other[3], other[1] - one[3])
            assert apart >= -1.001
        for left, top, right, bottom in boxes:
            assert left >= 14
            assert bottom <= page.size_mm[1] - 14
            assert right <= page.size_mm[0] - 10
            assert top >= ruler[1]
    assert seen == [f"tag-{1000 + number}" for number in range(count)]
    assert len(made.pages) < count


@pytest.mark.slow
@pytest.mark.parametrize("tags", [FULL, MINI, DENSE, EVEN])
@pytest.mark.parametrize("mirror", [False, True])
def test_words_are_not_drawn_over(tags: Tags, mirror: bool) -> None:
    """But by the thin dashes of the grid."""
    turns = [
        (symbol, TagLayout(some_layout(tags, 7).cells, (symbol,) * tags.magnets))
        for symbol in range(tags.orientations)
    ]
    (page,) = draw_tag_cards(tags, turns, (600.0, 600.0), mirror=mirror).pages

    words, rest = only((page,), words=True), only((page,), words=False)
    dark_words = ink(words, dpi=150)
    both = np.minimum(dark_words, ink(rest, dpi=150))
    assert dark_words.max() > 0.9
    assert both.max() < 0.3


@pytest.mark.slow
def test_svg_is_what_the_pdf_shows_in_mm() -> None:
    made = draw_tag_cards(FULL, some(FULL, 2), A4)
    data = render_svg(made.pages[0], "two tags")
    root = Xml.fromstring(data)
    assert (root.attrib["width"], root.attrib["height"]) == ("210mm", "297mm")
    assert root.attrib["viewBox"] == "0 0 210 297"
    circles = root.findall(".//s:circle", SVG)
    assert {circle.attrib["r"] for circle in circles} == {"1"}
    places = np.array([[float(c.attrib["cx"]), 297 - float(c.attrib["cy"])] for c in circles])
    found = find_circles(ink(made.pages), 2.0)
    assert len(found) == len(places) == 10
    distance = np.linalg.norm(found[:, None] - places, axis=2)
    assert distance.min(axis=0).max() < 0.1
    # Lines of exactly 100 mm: the edges of the two rulers, and nothing else.
    lines = [
        [float(line.attrib[key]) for key in ("x1", "y1", "x2", "y2")]
        for line in root.findall(".//s:line", SVG)
    ]
    long = [line for line in lines if math.hypot(line[2] - line[0], line[3] - line[1]) > 90]
    assert len(long) == 2
    for x1, y1, x2, y2 in long:
        assert math.hypot(x2 - x1, y2 - y1) == pytest.approx(100, abs=1e-3)
    # Text is text, and the same text.
    texts = [item.text or "" for item in root.findall(".//s:text", SVG)]
    shown = pypdfium2.PdfDocument(render_pages(made.pages, ""))[0].get_textpage()
    assert sorted("".join(texts).replace(" ", "")) == sorted(
        "".join(shown.get_text_bounded().split())
    )
    title = root.find("s:title", SVG)
    assert title is not None
    assert title.text == "two tags"


def test_labels_say_what_it_is() -> None:
    tags = replace(FULL, codec="polaris-released")
    layout = TagLayout(((0, 0), (1, 0), (1, 1), (0, 2), (2, 2)), (0, 1, 2, 3, 7))
    made = draw_tag_cards(tags, [(262143, layout)], A4)
    page = pypdfium2.PdfDocument(render_pages(made.pages, "t"))[0]
    words = page.get_textpage().get_text_bounded()
    for part in (
        "id 262143", "polaris-released", "K=3", "M=5", "P=8", "d=40 mm", "D2 x 0.5 mm N52",
        "clearance 10 mm", "x forward", "v4 empty", "Print at 100 %", "page 1 of 1",
    ):  # fmt: skip
        assert part in words, part
    assert [words.count(f"{angle}\u00b0") for angle in (45, 90, 135, 315)] == [1, 1, 1, 1]
    assert "MIRRORED" not in words
    below = draw_tag_cards(tags, [(262143, layout)], A4, mirror=True)
    page = pypdfium2.PdfDocument(render_pages(below.pages, "t"))[0]
    assert "MIRRORED" in page.get_textpage().get_text_bounded()


def test_long_ids_are_written_whole_within_their_card() -> None:
    number = 3**300
    made = draw_tag_cards(MINI, [(number, some_layout(MINI, 1)), (5, some_layout(MINI, 2))], A4)
    _, group, other = made.pages[0].groups
    texts = [mark for mark in group.marks if isinstance(mark, Text) and mark.bold]
    digits = "".join(mark.text for mark in texts if mark.text != "N")
    assert digits.replace(" ", "") == f"id{number}"
    page = pypdfium2.PdfDocument(render_pages(made.pages, "t"))[0].get_textpage()
    boxes = [page.get_charbox(at) for at in range(page.count_chars())]
    cut = max(mark.end[0] for mark in group.marks if isinstance(mark, Line)) - 3.0
    rims = (cut, min(mark.start[0] for mark in other.marks if isinstance(mark, Line)))
    top = made.pages[0].size_mm[1] - 25
    for left, bottom, right, _ in boxes:
        # The ruler at the lower edge is longer than a card.
        if 20 < bottom * 25.4 / 72 < top and left * 25.4 / 72 < rims[0]:
            assert right * 25.4 / 72 <= rims[0]


def test_tags_are_drawn_as_designed_and_always_the_same() -> None:
    wanted = some(FULL, 3)
    built = AsBuiltTag(np.full((5, 2), 3e-3), np.full(5, 0.2), 4)
    again = replace(FULL, built={1000: built})
    first, second = (draw_tag_cards(tags, wanted, A4).pages for tags in (FULL, again))
    assert render_pages(first, "t") == render_pages(second, "t")
    assert render_svg(first[1], "t") == render_svg(second[1], "t")


def test_one_ink_and_no_scaling(assert_one_ink: Callable[[Any], None]) -> None:
    made = draw_tag_cards(FULL, some(FULL, 1), A4)
    with pikepdf.open(io.BytesIO(render_pages(made.pages, "t"))) as pdf:
        assert pdf.Root.ViewerPreferences.PrintScaling == "/None"
        for sheet in pdf.pages:
            assert_one_ink(sheet)


def test_paper_is_turned_where_that_saves_pages() -> None:
    wide = Tags(spacing_m=0.06)
    (page,) = draw_tag_cards(wide, some(wide, 1), A4).pages
    assert page.size_mm == A4
    (page,) = draw_tag_cards(DENSE, some(DENSE, 1), (160.0, 150.0)).pages
    assert page.size_mm == (160.0, 150.0)
    (page,) = draw_tag_cards(DENSE, some(DENSE, 2), (150.0, 225.0)).pages
    assert page.size_mm == (225.0, 150.0)
    (page,) = draw_tag_cards(DENSE, some(DENSE, 2), (225.0, 150.0)).pages
    assert page.size_mm == (225.0, 150.0)


@pytest.mark.slow
def test_what_cannot_be_drawn_is_refused() -> None:
    large = Tags(order=5, magnets=8)
    wanted = some(large, 1)
    with pytest.raises(InputError, match="larger than the paper") as refused:
        draw_tag_cards(large, wanted, (180.0, 180.0))
    # The paper of the hint is enough, and hardly more.
    hint = refused.value.hint or ""
    width, height = map(float, hint.split("--size ")[1].removesuffix("mm").split("x"))
    assert len(draw_tag_cards(large, wanted, (width, height)).pages) == 1
    for less in ((width, height - 5), (width - 5, height)):
        with pytest.raises(InputError):
            draw_tag_cards(large, wanted, less)
    with pytest.raises(InputError, match="margin"):
        draw_tag_cards(FULL, some(FULL, 1), A4, margin_mm=105)
    with pytest.raises(InputError, match="no tag"):
        draw_tag_cards(FULL, [], A4)
    with pytest.raises(InputError, match="pages"):
        draw_tag_cards(FULL, some(FULL, 1) * 401, A4)
    with pytest.raises(InputError, match="5080") as refused:
        render_pages(draw_tag_cards(FULL, some(FULL, 1), (200.0, 6000.0)).pages, "t", hint="cut it")
    assert refused.value.hint == "cut it"
