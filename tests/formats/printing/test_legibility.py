"""Texts of printed packs: large enough, and touched by no line and no other text.

Texts and strokes are those that pdfium finds in the PDF, not those of the drawing's model.
"""

from __future__ import annotations

import ctypes
import io
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pypdfium2
import pypdfium2.raw as pdfium
import pytest
from numpy.typing import NDArray
from reportlab.pdfgen.canvas import Canvas

from locatk.core.dots.drawing.layout import lay_out, manifest, snap
from locatk.core.dots.drawing.test_sheet import printer_sheet
from locatk.core.dots.drawing.tiles import tiling
from locatk.core.drawing.sensor_layout import draw_sensor_layout
from locatk.core.landmarks.drawing.pack import PACK_PARTS, draw_installation_pack
from locatk.core.landmarks.drawing.true_size import draw_floor
from locatk.core.landmarks.landmark import Geometry
from locatk.core.landmarks.map.floor import HOLE_CODE, FloorMap
from locatk.core.paper_sizes import PAPER_SIZES_MM, paper_size, parse_paper
from locatk.core.polaris.codec import layout_of
from locatk.core.polaris.codec.families import generate_family
from locatk.core.polaris.drawing.cards import draw_tag_cards
from locatk.core.polaris.drawing.plan import draw_site_plan
from locatk.core.polaris.tag import Magnet, PlanarPose, Tags
from locatk.formats.printing import pattern
from locatk.formats.printing.drawings import render_floor, render_pages

MIN_POINTS = 7.0
"""Smallest legible print; a newspaper's small advertisements have 6 to 7 points."""

CLEARANCE_MM = 0.1
"""Distance at which a line and a letter do not merge in toner: a pixel of 300 dpi is 0.085 mm."""

PAPERS = ("A4", "Letter", "A3")

SMALL_BARS = Geometry(bar_length_m=0.01, bar_width_m=0.003, radius_m=0.009)


MM_PER_POINT = 25.4 / 72

TOUCH_MM = 0.02
"""Overlap that is due to rounding in the PDF."""

CURVE_CHORDS = 8
"""Chords that stand for one Bezier curve."""

Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class PrintedText:
    """One text object: its size, and the box around the ink of its letters, in mm."""

    text: str
    points: float
    box: Box


@dataclass(frozen=True)
class PageInk:
    """Texts and strokes of a page; a stroke is x0, y0, x1, y1 and half its width, in mm."""

    texts: tuple[PrintedText, ...]
    strokes: NDArray[np.float64]


def page_inks(data: bytes) -> Iterator[PageInk]:
    """Yield the ink of each page of a PDF."""
    document = pypdfium2.PdfDocument(data)
    for page in document:
        text_page = page.get_textpage()
        strokes = [np.zeros((0, 5))]
        for item in page.get_objects(filter=(pdfium.FPDF_PAGEOBJ_PATH,)):
            edges = np.array(list(_strokes(item))).reshape(-1, 5) * MM_PER_POINT
            strokes.append(_clipped(edges, _clip(item.raw)))
        yield PageInk(tuple(_texts(text_page)), np.concatenate(strokes))


def _clip(item: object) -> Box:
    """Return the box to which an object is clipped, in mm."""
    box = (-math.inf, -math.inf, math.inf, math.inf)
    clip = pdfium.FPDFPageObj_GetClipPath(item)
    for path in range(max(0, pdfium.FPDFClipPath_CountPaths(clip))):
        corners = []
        for index in range(pdfium.FPDFClipPath_CountPathSegments(clip, path)):
            x, y = ctypes.c_float(), ctypes.c_float()
            segment = pdfium.FPDFClipPath_GetPathSegment(clip, path, index)
            pdfium.FPDFPathSegment_GetPoint(segment, x, y)
            corners.append((x.value * MM_PER_POINT, y.value * MM_PER_POINT))
        (left, bottom), (right, top) = np.min(corners, axis=0), np.max(corners, axis=0)
        box = _common((left, bottom, right, top), box)
    return box


def _common(first: Box, second: Box) -> Box:
    """Return the common area of two boxes."""
    low = [max(pair) for pair in zip(first[:2], second[:2], strict=True)]
    high = [min(pair) for pair in zip(first[2:], second[2:], strict=True)]
    return low[0], low[1], high[0], high[1]


def _texts(text_page: pypdfium2.PdfTextPage) -> Iterator[PrintedText]:
    """Yield the text objects with their letters."""

    def owner(index: int) -> int:
        found = pdfium.FPDFText_GetTextObject(text_page, index)
        return ctypes.addressof(found.contents) if found else 0

    for key, indices in itertools.groupby(range(text_page.count_chars()), owner):
        letters = list(indices)
        text = "".join(chr(pdfium.FPDFText_GetUnicode(text_page, i)) for i in letters)
        inked = [i for i, letter in zip(letters, text, strict=True) if not letter.isspace()]
        if not key or not inked:
            continue
        boxes = np.array([text_page.get_charbox(i) for i in inked]) * MM_PER_POINT
        left, bottom = boxes[:, :2].min(axis=0).tolist()
        right, top = boxes[:, 2:].max(axis=0).tolist()
        matrix = pdfium.FS_MATRIX()
        assert pdfium.FPDFText_GetMatrix(text_page, inked[0], matrix)
        scale = math.sqrt(abs(matrix.a * matrix.d - matrix.b * matrix.c))
        points = pdfium.FPDFText_GetFontSize(text_page, inked[0]) * scale
        item = pdfium.FPDFText_GetTextObject(text_page, inked[0])
        box = _common((left, bottom, right, top), _clip(item))
        if box[0] < box[2] and box[1] < box[3]:
            yield PrintedText(text.strip(), points, box)


def _strokes(item: pypdfium2.PdfObject) -> Iterator[tuple[float, ...]]:
    """Yield the edges of a path in points, with half the width of its line."""
    a, b, c, d, e, f = item.get_matrix().get()
    fill, stroked = ctypes.c_int(), ctypes.c_int()
    pdfium.FPDFPath_GetDrawMode(item, fill, stroked)
    width = ctypes.c_float()
    pdfium.FPDFPageObj_GetStrokeWidth(item, width)
    half = width.value / 2 * math.sqrt(abs(a * d - b * c)) if stroked.value else 0.0
    start = here = (0.0, 0.0)
    curve: list[tuple[float, float]] = []
    for index in range(pdfium.FPDFPath_CountSegments(item)):
        segment = pdfium.FPDFPath_GetPathSegment(item, index)
        x, y = ctypes.c_float(), ctypes.c_float()
        pdfium.FPDFPathSegment_GetPoint(segment, x, y)
        point = (a * x.value + c * y.value + e, b * x.value + d * y.value + f)
        kind = pdfium.FPDFPathSegment_GetType(segment)
        if kind == pdfium.FPDF_SEGMENT_MOVETO:
            start = here = point
            continue
        if kind == pdfium.FPDF_SEGMENT_BEZIERTO:
            curve.append(point)
            if len(curve) < 3:
                continue
            chords = _chords(here, *curve)
            curve = []
        else:
            chords = [point]
        for end in chords:
            yield (*here, *end, half)
            here = end
        if pdfium.FPDFPathSegment_GetClose(segment):
            yield (*here, *start, half)
            here = start


def _chords(*corners: tuple[float, float]) -> list[tuple[float, float]]:
    """Return the ends of the chords of a cubic Bezier curve."""
    p = np.array(corners)
    t = np.linspace(0, 1, CURVE_CHORDS + 1)[1:, None]
    curve = (1 - t) ** 3 * p[0] + 3 * t * (1 - t) ** 2 * p[1] + 3 * t**2 * (1 - t) * p[2]
    return [(float(x), float(y)) for x, y in curve + t**3 * p[3]]


def crossed_texts(ink: PageInk, clearance_mm: float = -TOUCH_MM) -> list[str]:
    """Return the texts to which a stroke is nearer than this distance."""
    return [
        text.text
        for text in ink.texts
        if _entered(ink.strokes, text.box, ink.strokes[:, 4] + clearance_mm)[0].any()
    ]


def _clipped(strokes: NDArray[np.float64], box: Box) -> NDArray[np.float64]:
    """Return the parts of strokes in a box."""
    is_inside, low, high = _entered(strokes, box, np.zeros(len(strokes)))
    start, step = strokes[:, :2], strokes[:, 2:4] - strokes[:, :2]
    parts = [start + low[:, None] * step, start + high[:, None] * step, strokes[:, 4:]]
    return np.concatenate(parts, axis=1)[is_inside]


def _entered(
    strokes: NDArray[np.float64], box: Box, grow: NDArray[np.float64]
) -> tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]:
    """Return which strokes enter a box that is grown, and between which fractions of them."""
    low, high = np.zeros(len(strokes)), np.ones(len(strokes))
    is_inside = np.ones(len(strokes), bool)
    for axis in (0, 1):
        start, step = strokes[:, axis], strokes[:, axis + 2] - strokes[:, axis]
        lower, upper = box[axis] - grow, box[axis + 2] + grow
        is_parallel = np.abs(step) < 1e-9
        is_inside &= ~is_parallel | ((start > lower) & (start < upper))
        safe = np.where(is_parallel, 1.0, step)
        first, last = (lower - start) / safe, (upper - start) / safe
        low = np.maximum(low, np.where(is_parallel, 0.0, np.minimum(first, last)))
        high = np.minimum(high, np.where(is_parallel, 1.0, np.maximum(first, last)))
    return is_inside & (low < high), low, high


def overlapping_texts(ink: PageInk) -> list[tuple[str, str]]:
    """Return the pairs of texts whose boxes overlap."""
    if not ink.texts:
        return []
    boxes = np.array([text.box for text in ink.texts])
    low = np.maximum(boxes[:, None, :2], boxes[None, :, :2])
    high = np.minimum(boxes[:, None, 2:], boxes[None, :, 2:])
    overlaps = (high - low > TOUCH_MM).all(axis=2)
    first, second = np.nonzero(np.triu(overlaps, 1))
    return [
        (ink.texts[a].text, ink.texts[b].text)
        for a, b in zip(first.tolist(), second.tolist(), strict=True)
    ]


def check(data: bytes) -> list[str]:
    """Assert that all pages are legible; return their texts."""
    texts = []
    for number, ink in enumerate(page_inks(data), 1):
        small = [(text.text, text.points) for text in ink.texts if text.points < MIN_POINTS - 1e-3]
        assert not small, f"page {number}"
        assert not crossed_texts(ink, CLEARANCE_MM), f"page {number}"
        assert not overlapping_texts(ink), f"page {number}"
        texts += [text.text for text in ink.texts]
    return texts


def some_floor(rows: int, columns: int, pitch_m: float = 0.2, window: str = "L") -> FloorMap:
    codes = np.random.default_rng(rows).integers(0, 16, (rows, columns))
    codes[rows // 2, columns // 3] = HOLE_CODE
    walls = frozenset({((0, 0), (0, 1)), ((0, 1), (1, 1))})
    floor = FloorMap(codes, name="hall", pitch_m=pitch_m, window=window, walls=walls)
    return replace(floor, origin_m=(-1.5, 0.25))


@pytest.mark.parametrize("angle", [0, 90])
def test_collisions_and_sizes_are_found(angle: int) -> None:
    stream = io.BytesIO()
    canvas = Canvas(stream, pagesize=(300, 300))
    canvas.translate(150, 150)
    canvas.rotate(angle)
    canvas.scale(0.5, 0.5)
    for y, text in ((0, "HALF"), (-100, "FREE"), (-200, "gone")):
        canvas.setFont("Helvetica", 12)
        canvas.drawString(0, y, text)
    canvas.drawString(2, 3, "OVER")
    canvas.line(-20, 4, 60, 4)
    canvas.line(-20, -100 - 2, 60, -100 - 2)
    canvas.circle(10, -195, 3)
    canvas.save()
    (ink,) = page_inks(stream.getvalue())
    assert {text.text: text.points for text in ink.texts} == pytest.approx(
        dict.fromkeys(("HALF", "FREE", "gone", "OVER"), 6.0)
    )
    assert sorted(crossed_texts(ink)) == ["HALF", "OVER", "gone"]
    assert sorted(crossed_texts(ink, 0.5)) == ["FREE", "HALF", "OVER", "gone"]
    assert [set(pair) for pair in overlapping_texts(ink)] == [{"HALF", "OVER"}]


@pytest.mark.slow
@pytest.mark.parametrize("paper", PAPERS)
@pytest.mark.parametrize(
    "floor",
    [
        some_floor(2, 2, pitch_m=0.07),
        some_floor(7, 7),
        some_floor(20, 24, pitch_m=0.25),
        some_floor(30, 35, pitch_m=1.2, window="3x3"),
        replace(some_floor(4, 5, pitch_m=0.05), geometry=SMALL_BARS),
    ],
    ids=lambda floor: "x".join(map(str, floor.shape)),
)
def test_installation_packs_are_legible(floor: FloorMap, paper: str) -> None:
    # The templates and lists of all floors are alike; those of large ones take long to check.
    parts = PACK_PARTS if floor.codes.size < 50 else ("plan", "materials")
    pack = draw_installation_pack(floor, PAPER_SIZES_MM[paper], parts=parts)
    texts = check(render_pages(pack.pages, "test"))
    assert parts != PACK_PARTS or texts.count("[ ]") == len(floor.cells())


@pytest.mark.slow
@pytest.mark.parametrize("paper", ["A4", "Letter", "A3", "A0", "roll:914mm"])
@pytest.mark.parametrize(
    "floor",
    [
        some_floor(3, 4),
        some_floor(3, 4, pitch_m=0.1),
        some_floor(3, 3, pitch_m=0.061),
        replace(some_floor(4, 5, pitch_m=0.05), geometry=SMALL_BARS),
    ],
    ids=("200mm", "100mm", "61mm", "small"),
)
def test_floors_are_legible(floor: FloorMap, paper: str) -> None:
    texts = check(render_floor(draw_floor(floor, parse_paper(paper)), "test"))
    if paper == "A4" and floor.pitch_m == 0.2:
        assert "joins c2r1" in texts


@pytest.mark.slow
@pytest.mark.parametrize(("paper", "mirror"), [*((paper, False) for paper in PAPERS), ("A4", True)])
@pytest.mark.parametrize(
    ("tags", "counts"),
    [
        (Tags(), (1, 3, 50)),
        (Tags(spacing_m=0.012, codec="polaris-released"), (3,)),
        (Tags(order=2, magnets=3, spacing_m=0.016, magnet=Magnet(1e-3, 0.5e-3)), (3,)),
        (Tags(order=5, magnets=13, orientations=20, spacing_m=0.008), (10,)),
        (Tags(magnets=4, spacing_m=0.004, magnet=Magnet(1e-3, 0.5e-3)), (3,)),
    ],
    ids=("40mm", "12mm", "mini", "dense", "tiny"),
)
def test_tags_are_legible(tags: Tags, counts: tuple[int, ...], mirror: bool, paper: str) -> None:
    for count in counts:
        ids = generate_family(tags, count, 1)
        requested = [(tag_id, layout_of(tags, tag_id)) for tag_id in ids]
        drawn = draw_tag_cards(tags, requested, PAPER_SIZES_MM[paper], mirror=mirror)
        texts = check(render_pages(drawn.pages, "test"))
        assert sum(text.startswith("id ") for text in texts) == count
        angles = " ".join(texts).count("\u00b0")
        assert angles >= count * tags.magnets


@pytest.mark.parametrize("paper", PAPERS)
@pytest.mark.parametrize("count", [1, 4, 60])
def test_site_plans_are_legible(count: int, paper: str) -> None:
    ids = generate_family(Tags(), count, 1)
    rng = np.random.default_rng(count)
    site = {
        tag_id: PlanarPose(0.8 * (k % 8), 1.1 * (k // 8), rng.uniform(-np.pi, np.pi))
        for k, tag_id in enumerate(ids)
    }
    meanings = {tag_id: f"station {k}" for k, tag_id in enumerate(ids) if k % 3 == 0}
    tags = replace(Tags(), site=site, meanings=meanings)
    plan = draw_site_plan(tags, "hall", PAPER_SIZES_MM[paper])
    texts = check(render_pages(plan.pages, "test"))
    assert {str(tag_id) for tag_id in ids} <= {word for text in texts for word in text.split()}


@pytest.mark.parametrize("paper", ["A4", "Letter"])
@pytest.mark.parametrize(("rows", "columns", "pitch_mm"), [(1, 9, 20), (1, 16, 5), (6, 8, 3)])
def test_sensor_layouts_are_legible(rows: int, columns: int, pitch_mm: int, paper: str) -> None:
    x, y = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    position_m = 1e-3 * pitch_mm * np.column_stack([x.ravel(), y.ravel()])
    labels = [str(number) for number in range(rows * columns)]
    pages = draw_sensor_layout(labels, position_m, PAPER_SIZES_MM[paper], title="Array")
    assert set(labels) <= set(check(render_pages(pages, "test")))


@pytest.mark.parametrize("paper", ["A4", "Letter"])
@pytest.mark.parametrize("dpi", [300, 600, 1200])
def test_test_sheets_are_legible(paper: str, dpi: int) -> None:
    sheet = printer_sheet(paper, dpi)
    texts = check(pattern.render_test_sheet(sheet))
    assert {field.name for field in sheet.fields} <= set(texts)


@pytest.mark.slow
@pytest.mark.parametrize("paper", PAPERS)
@pytest.mark.parametrize("overlap_mm", [0.0, 12.0])
def test_margins_of_patterns_are_legible(overlap_mm: float, paper: str) -> None:
    layout = lay_out(paper_size(paper)[1], 7.0, snap(0.508, None, 300))
    tiled = tiling(layout, (2, 2), overlap_mm)
    sheets = tiled.sheets("sheet-1", (0, 0))
    texts = check(pattern.render(manifest(layout.raster, sheets, "anoto"), crop=True))
    assert {"x", "y"} <= set(texts)
