"""Sheets of dots as files, read again by programs that know nothing of how they are made.

PDFs are rasterised by pdfium, which shows what a pixel holds of two colours in between; other
rasterisers are in test_rasterisers.py.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pikepdf
import pypdfium2
import pytest
from numpy.typing import NDArray
from PIL import Image

from locatk.core.dots.codec import codec
from locatk.core.dots.codec.lookup import decode_exact
from locatk.core.dots.drawing.layout import SheetLayout, lay_out, manifest, snap
from locatk.core.dots.drawing.tiles import seams, tiling
from locatk.core.dots.sheet import Manifest
from locatk.core.errors import InputError
from locatk.core.paper_sizes import paper_size
from locatk.formats.printing import page, pattern, rasters

INK = 0
"""A pixel that is wholly covered."""

PAPER = 250
"""Lighter than this is paper: nothing covers even a fiftieth of the pixel."""

Raster = NDArray[np.uint8]


def sheets(
    size: str = "A4",
    dpi: int = 300,
    margin: float = 10.0,
    pitch: float = 0.508,
    origin: tuple[int, int] = (184_022_430, 7200),
    name: str = "anoto",
    section: tuple[int, int] = (24, 32),
) -> Manifest:
    layout = lay_out(paper_size(size)[1], margin, snap(pitch, None, dpi))
    return manifest(layout.raster, layout.sheets("sheet-1", origin, section), name)


def rasterise(
    data: bytes, dpi: int, number: int = 0, box: tuple[int, int, int, int] | None = None
) -> Raster:
    """Grey values of a page, or of ``box`` (left, top, right, bottom in px) of it."""
    document = pypdfium2.PdfDocument(data)
    sheet = document[number]
    width, height = (round(side * dpi / 72) for side in sheet.get_size())
    crop = (0.0, 0.0, 0.0, 0.0)
    if box is not None:
        left, top, right, bottom = box
        # pdfium's binding rounds the crop up to pixels.
        cuts = (left, height - bottom, width - right, top)
        crop = tuple(max(0.0, cut - 0.5) * 72 / dpi for cut in cuts)  # type: ignore[assignment]
    found: Raster = sheet.render(scale=dpi / 72, grayscale=True, crop=crop).to_numpy().squeeze()
    assert found.shape == ((height, width) if box is None else (bottom - top, right - left))
    return found


def read(
    raster: Raster, made: Manifest, number: int, dpi: int, corner: tuple[int, int] = (0, 0)
) -> tuple[Raster, tuple[int, int]]:
    """Symbols that the black pixels of a raster spell, by what the manifest says of them.

    Every dot must be a square of wholly black pixels. Returns the symbols of the largest
    window of places that the raster shows whole, and the grid coordinates of the first.
    """
    sheet = made.sheets[number]
    side = round(made.dot_mm * dpi / 25.4)
    rows, columns = np.nonzero(raster <= INK + 2)
    to_grid = np.array([dpi / 25.4 * made.pitch_mm] * 2)
    # In mm on the paper, as Manifest.to_metres has it but with y down.
    first = np.array(sheet.first_mm) * dpi / 25.4 - corner
    pixel = (np.column_stack([columns, rows]) + 0.5 - first) / to_grid
    place = np.rint(pixel).astype(int)
    low = np.maximum(np.ceil(-first / to_grid + 0.5).astype(int), 0)
    size = np.array(raster.shape[::-1])
    high = np.minimum(np.floor((size - first) / to_grid - 0.5).astype(int) + 1, sheet.size)
    inside = ((place >= low) & (place < high)).all(axis=1)
    place, delta = place[inside], (pixel - place)[inside]
    shape = (high - low)[::-1]
    flat = np.ravel_multi_index(tuple((place - low).T[::-1]), tuple(shape))
    count = np.bincount(flat, minlength=shape.prod())
    assert (count == side * side).all(), "each dot is a square of wholly black pixels"
    mean = np.stack([np.bincount(flat, d, shape.prod()) / count for d in delta.T], axis=-1)
    offset = made.offset_mm / made.pitch_mm
    along = np.abs(mean).max(axis=-1)
    np.testing.assert_allclose(along, offset, atol=1e-6)
    np.testing.assert_allclose(np.abs(mean).min(axis=-1), 0, atol=1e-6)
    # And no larger than that: a square, not a line.
    for d, m in zip(delta.T, mean.T, strict=True):
        assert np.abs(d - m[flat]).max() < side / 2 / to_grid[0] + 1e-6
    x, y = mean.T
    symbols = np.select([y < -along / 2, x < -along / 2, x > along / 2, y > along / 2], range(4))
    found: Raster = symbols.reshape(shape).astype(np.uint8)
    at = low + sheet.origin
    return found, (int(at[0]), int(at[1]))


def assert_windows_decode(
    symbols: Raster, at: tuple[int, int], made: Manifest, section: tuple[int, int], count: int
) -> None:
    """Random windows of 8 x 8 dots are read, and all of them right."""
    random = np.random.default_rng(7)
    x = random.integers(0, symbols.shape[1] - 7, count)
    y = random.integers(0, symbols.shape[0] - 7, count)
    windows = np.stack([symbols[b : b + 8, a : a + 8] for a, b in zip(x, y, strict=True)])
    found = decode_exact(windows, codec(made.codec))
    assert found.ok.all()
    np.testing.assert_array_equal(found.x, at[0] + x)
    np.testing.assert_array_equal(found.y, at[1] + y)
    np.testing.assert_array_equal(found.section, [section] * count)
    assert (found.rotation == 0).all()


def box_px(layout: SheetLayout, times: int = 1) -> tuple[slice, slice]:
    left, top, right, bottom = (edge * times for edge in layout.box)
    return slice(top, bottom), slice(left, right)


@pytest.mark.slow
@pytest.mark.parametrize(("printer", "dpi"), [(300, 600), (600, 600)])
def test_a4_is_exact_to_the_pixel(printer: int, dpi: int) -> None:
    made = sheets(dpi=printer)
    raster = rasterise(pattern.render(made), dpi)
    assert raster.shape == (3508 * dpi // 300, 2480 * dpi // 300)
    if dpi != printer:  # masks are stretched by 2 * 0.1 px, which shows at their edges
        raster = np.where(raster < 128, np.uint8(INK), np.uint8(255))
    symbols, at = read(raster, made, 0, dpi)
    assert symbols.shape == made.sheets[0].size[::-1]
    assert at == made.sheets[0].origin
    # Nothing is grey, and nothing but dots is in the pattern.
    (rows, columns) = box_px(lay_out((210, 297), 10, snap(0.508, None, printer)), dpi // printer)
    values, counts = np.unique(raster[rows, columns], return_counts=True)
    assert ((values == INK) | (values > PAPER)).all()
    assert counts[0] == symbols.size * (dpi // 300) ** 2
    assert_windows_decode(symbols, at, made, (24, 32), 1000)


def corners(layout: SheetLayout, side: int) -> Iterator[tuple[int, int, int, int]]:
    """Boxes at the corners of a page and in its middle."""
    width, height = layout.page
    for x in (0, (width - side) // 2, width - side):
        for y in (0, (height - side) // 2, height - side):
            if (x == (width - side) // 2) == (y == (height - side) // 2):
                yield x, y, x + side, y + side


def test_papers_are_whole_numbers_of_pixels() -> None:
    """Also for a rasteriser that rounds up; 792 * (600 / 72) is more than 6600 in floats."""
    for size in ("A5", "A4", "A3", "A2", "A1", "A0", "Letter", "Tabloid", "914x3000", "30x5080"):
        layout = lay_out(paper_size(size)[1], 10, snap(1.0, None, 300))
        made = manifest(layout.raster, layout.sheets("a", (0, 0)), "anoto")
        small = replace(made, sheets=(replace(made.sheets[0], size=(8, 8)),))
        data = pattern.render(small)
        with pikepdf.open(io.BytesIO(data)) as pdf:
            exact = [float(side) for side in pdf.pages[0].MediaBox[2:]]
        # In double precision, and in the single precision of pdfium.
        for sides in (exact, pypdfium2.PdfDocument(data)[0].get_size()):
            for dpi in (300, 600, 1200):
                found = tuple(math.ceil(side * (dpi / 72)) for side in sides)
                assert found == tuple(side * dpi // 300 for side in layout.page), (size, dpi)


@pytest.mark.slow
def test_a0_is_exact_to_the_pixel() -> None:
    made = sheets("A0")
    data = pattern.render(made)
    assert len(data) <= 2_700_000
    count = 0
    whole = lay_out((841, 1189), 10, snap(0.508, None, 300))
    for box in [*corners(whole, 900)][::2]:  # two opposite corners, and the middle
        raster = rasterise(data, 300, box=box)
        symbols, at = read(raster, made, 0, 300, box[:2])
        assert min(symbols.shape) > 120
        assert_windows_decode(symbols, at, made, (24, 32), 200)
        count += 200
    assert count == 600


def test_other_pitches_and_printers_are_exact() -> None:
    """13 pixels of 1/600 in are no whole number of 1/300 in; 4 x 4 at 1200 dpi."""
    for made in (sheets("A5", 600, pitch=0.55), sheets("A5", 1200), sheets("A5", 300, pitch=0.6)):
        raster = rasterise(pattern.render(made), made.dpi, box=(0, 0, 1500, 1500))
        symbols, at = read(raster, made, 0, made.dpi)
        assert_windows_decode(symbols, at, made, (24, 32), 200)


def test_small_and_as_a_printer_wants_it(assert_one_ink: Callable[[Any], None]) -> None:
    made = sheets()
    data = pattern.render(made)
    assert len(data) <= 155_000
    with pikepdf.open(io.BytesIO(data)) as pdf:
        assert pdf.Root.ViewerPreferences.PrintScaling == "/None"
        assert not pdf.check_pdf_syntax()
        # The page is a whole number of 1/300 in, to what rasterisers round.
        for side, whole in zip(pdf.pages[0].MediaBox[2:], (595.2, 841.92), strict=True):
            assert 0 <= whole - float(side) < 2e-4
        (form,) = pdf.pages[0].Resources.XObject.values()
        (state,) = form.Resources.ExtGState.values()
        assert (state.OP, state.op, state.OPM) == (True, True, 1)
        for mask in form.Resources.XObject.values():
            assert mask.ImageMask
            assert "/Interpolate" not in mask
        assert_one_ink(form)
        assert_one_ink(pdf.pages[0])


@pytest.mark.slow
def test_same_sheet_same_bytes() -> None:
    assert pattern.render(sheets("A5")) == pattern.render(sheets("A5"))
    floor = floor_of_tiles()
    assert pattern.render(floor, crop=True) == pattern.render(floor, crop=True)


def runs(line: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last pixel of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], line, [False]]).astype(np.int8)))
    return [(int(a), int(b) - 1) for a, b in edges.reshape(-1, 2)]


@pytest.mark.slow
def test_rulers_are_100_mm() -> None:
    made = sheets("Letter", dpi=600)
    raster = rasterise(pattern.render(made), 600) < 128
    layout = lay_out((215.9, 279.4), 10, snap(0.508, None, 600))
    left, _, _, bottom = layout.box
    below, beside = raster[bottom:], raster[:, :left].T[::-1]
    for strip in (below, beside):
        # The ruler's edge is the longest line there is; its last ticks are in it.
        length, first = max(
            (b - a, a) for line in strip for a, b in runs(line)
        )  # fmt: skip
        assert (length / 600 * 25.4) == pytest.approx(100, abs=0.2)
        # Ticks of whole mm below it: centres 1 mm apart, from 0 to 100.
        row = next(n for n, line in enumerate(strip) if (first, first + length) in runs(line))
        ticks = [(a + b) / 2 for a, b in runs(strip[row + 12]) if a >= first - 9]
        ticks = [at for at in ticks if at <= first + length + 9]
        assert len(ticks) == 101
        np.testing.assert_allclose(np.diff(ticks), 600 / 25.4, atol=1.01)
        assert (ticks[-1] - ticks[0]) / 600 * 25.4 == pytest.approx(100, abs=0.05)


def words(data: bytes, number: int, made: Manifest) -> str:
    document = pypdfium2.PdfDocument(data)
    height = made.sheets[number].page_mm[1] * 72 / 25.4
    text = document[number].get_textpage().get_text_bounded(bottom=height - 28)
    found: str = text
    return found


@pytest.mark.slow
def test_margin_says_what_it_is() -> None:
    made = sheets()
    text = words(pattern.render(made), 0, made)
    for part in ("sheet-1", "Print at 100 %", "0.508 mm", "300 dpi", "anoto", "184022430,7200"):
        assert part in text
    assert "sheet-1" in words(pattern.render(sheets("A5")), 0, sheets("A5"))
    assert "sheet-1" not in words(pattern.render(made, marks=False), 0, made)


@pytest.mark.slow
def test_narrow_margins_stay_empty() -> None:
    for margin, bare in ((0.0, True), (6.5, True), (7.0, False), (20.0, False)):
        made = sheets("A5", margin=margin)
        layout = lay_out((148, 210), margin, snap(0.508, None, 300))
        raster = rasterise(pattern.render(made, crop=True), 300)
        raster[box_px(layout)] = 255
        assert (raster.min() > PAPER) == bare
        assert pattern.sheets_without_margin(made) == (["sheet-1"] if bare else [])


@pytest.mark.slow
def test_crop_marks_are_at_the_corners_of_the_pattern() -> None:
    made = sheets("A5")
    data = pattern.render(made, marks=False, crop=True)
    layout = lay_out((148, 210), 10, snap(0.508, None, 300))
    raster = rasterise(data, 300) < 128
    left, top, right, bottom = layout.box
    raster[box_px(layout)] = False
    # Lines along all four edges, which end before the dots.
    for at, line in (
        (left, raster[: top - 12].any(axis=0)),
        (right, raster[: top - 12].any(axis=0)),
        (top, raster[:, : left - 12].any(axis=1)),
        (bottom, raster[:, : left - 12].any(axis=1)),
    ):
        assert any(abs((a + b + 1) / 2 - at) <= 1 for a, b in runs(line))
    assert not raster[top - 11 : bottom + 11, left - 11 : right + 11].any()
    with pikepdf.open(io.BytesIO(data)) as pdf:
        trim = [float(edge) * 300 / 72 for edge in pdf.pages[0].TrimBox]
    np.testing.assert_allclose(
        trim, [left, layout.page[1] - bottom, right, layout.page[1] - top], atol=0.01
    )


def floor_of_tiles() -> Manifest:
    layout = lay_out((148, 210), 10, snap(0.508, None, 300))
    tiles = tiling(layout, (2, 2), 15)
    return manifest(layout.raster, tiles.sheets("floor-1", (5000, 6000)), "libdots")


@pytest.mark.slow
def test_tiles_meet_at_their_registration_marks() -> None:
    made = floor_of_tiles()
    data = pattern.render(made, marks=False)
    layout = lay_out((148, 210), 10, snap(0.508, None, 300))
    _, top, right, _ = layout.box
    parts = []
    for number in range(4):
        raster = rasterise(data, 300, number)
        symbols, at = read(raster, made, number, 300)
        assert_windows_decode(symbols, at, made, (0, 0), 100)
        parts.append((symbols, at))
        # A mark stands in the margin above and beside each seam, centred on it.
        x, y = seams(made, number)
        for axis, seam, strip in (
            (0, x[0], raster[: top - 6] < 128),
            (1, y[0], (raster[:, right + 6 :] < 128).T),
        ):
            (columns,) = np.nonzero(strip.any(axis=0))
            assert len(columns), f"no mark at axis {axis}"
            middle = (columns[0] + columns[-1] + 1) / 2
            assert middle == pytest.approx(seam / 25.4 * 300, abs=1)
    # What two tiles share is the same in both.
    (first, (x0, y0)), (second, (x1, y1)) = parts[0], parts[3]
    shared = first[y1 - y0 :, x1 - x0 :]
    assert shared.shape == (30, 30)
    np.testing.assert_array_equal(shared, second[: shared.shape[0], : shared.shape[1]])


@pytest.mark.slow
def test_overlay_of_two_pages(tmp_path: Path) -> None:
    """On a document of the usual A4, which is no whole number of pixels, with black in it."""
    from reportlab.pdfgen.canvas import Canvas

    from locatk.formats.printing.overlay import overlay, page_sizes

    document = tmp_path / "drawing.pdf"
    canvas = Canvas(str(document), pagesize=(595.276, 841.89))
    for number in range(2):
        canvas.setFont("Helvetica-Bold", 60)
        canvas.drawString(90, 600, f"Hall {number + 1}")
        canvas.setFillColorRGB(0.2, 0.5, 0.8)
        canvas.rect(100, 200, 300, 200, fill=1)
        canvas.showPage()
    canvas.save()

    raster = snap(0.508, None, 300)
    layouts = [lay_out(size, 10, raster) for size in page_sizes(document)]
    both = [
        sheet
        for number, layout in enumerate(layouts)
        for sheet in layout.sheets(f"p{number}", (100 + 600 * number, 50))
    ]
    made = manifest(raster, both, "anoto")
    data = overlay(document, pattern.render(made), strip_black=True).data
    for number in range(2):
        page_raster = rasterise(data, 300, number)
        assert page_raster.shape == (3508, 2480)
        symbols, at = read(page_raster, made, number, 300)
        assert at == made.sheets[number].origin
        assert symbols.shape == made.sheets[number].size[::-1]
        assert_windows_decode(symbols, at, made, (0, 0), 1000)


def test_pages_that_no_pdf_holds_are_refused() -> None:
    long = sheets("30x5080")
    assert pypdfium2.PdfDocument(pattern.render(long))[0].get_size()[1] <= 14_400
    with pytest.raises(InputError, match="5080"):
        pattern.render(sheets("30x5081"))


def test_rolls_are_exact_at_their_far_end() -> None:
    made = sheets("60x4000", margin=8)
    layout = lay_out((60, 4000), 8, snap(0.508, None, 300))
    width, height = layout.page
    box = (0, height - 700, width, height)
    raster = rasterise(pattern.render(made), 300, box=box)
    symbols, at = read(raster, made, 0, 300, box[:2])
    assert at[1] + symbols.shape[0] == made.sheets[0].origin[1] + made.sheets[0].size[1]
    assert_windows_decode(symbols, at, made, (24, 32), 200)


def image(made: Manifest, kind: str = "png") -> tuple[bytes, Raster]:
    stream = io.BytesIO()
    rasters.WRITERS[kind](stream, made, 0)
    data = stream.getvalue()
    return data, cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("size", "dpi", "margin"), [("A5", 300, 10.0), ("A5", 600, 0.0), ("60x80", 1200, 0.0)]
)
def test_png_is_the_page(
    size: str, dpi: int, margin: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = sheets(size, dpi, margin)
    data, found = image(made)
    assert found.shape == tuple(
        round(side * dpi / 25.4) for side in made.sheets[0].page_mm[::-1]
    )  # fmt: skip
    assert set(np.unique(found)) == {0, 255}
    symbols, at = read(found, made, 0, dpi)
    assert_windows_decode(symbols, at, made, (24, 32), 1000)
    columns, rows = made.sheets[0].size
    assert (found == 0).sum() == columns * rows * (dpi // 300) ** 2
    # A bit a pixel, and true size: IHDR's depth and colour, pHYs in pixels a metre.
    assert data[24:26] == bytes([1, 0])
    at_size = data.index(b"pHYs") + 4
    assert int.from_bytes(data[at_size : at_size + 4], "big") == round(dpi / 0.0254)
    # In whichever portions it is made.
    monkeypatch.setattr(rasters, "MAX_BAND_PIXELS", 100_000)
    monkeypatch.setattr(rasters, "BAND_ROWS", 50)
    np.testing.assert_array_equal(image(made)[1], found)


@pytest.mark.slow
def test_png_is_what_the_pdf_shows() -> None:
    made = sheets("A5")
    shown = rasterise(pattern.render(made, marks=False), 300)
    np.testing.assert_array_equal(image(made)[1] == 0, shown < 128)


@pytest.mark.parametrize("strip_bytes", [rasters.TIFF_STRIP_BYTES, 5000, 1])
def test_tiff_is_the_png(strip_bytes: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """In one strip, in many of several lines, and in one a line."""
    monkeypatch.setattr(rasters, "TIFF_STRIP_BYTES", strip_bytes)
    made = sheets("60x80", 600, 3.0)
    data, found = image(made, "tiff")
    np.testing.assert_array_equal(found, image(made)[1])
    with Image.open(io.BytesIO(data)) as opened:
        assert opened.mode == "1"
        assert opened.info["dpi"] == (600, 600)  # exactly: a fraction, per inch
        strips = opened.tag_v2[273]
        lines = opened.tag_v2[278]
        assert len(strips) == -(-found.shape[0] // lines)
        np.testing.assert_array_equal(np.asarray(opened), found > 0)


def test_pbm_is_the_png(monkeypatch: pytest.MonkeyPatch) -> None:
    """In several bands, of the exact length."""
    monkeypatch.setattr(rasters, "BAND_ROWS", 50)
    monkeypatch.setattr(rasters, "MAX_BAND_PIXELS", 400_000)
    made = sheets("60x80", 600, 3.0)
    data, found = image(made, "pbm")
    np.testing.assert_array_equal(found, image(made)[1])
    head = "P4\n{} {}\n".format(*found.shape[::-1]).encode()
    assert data.startswith(head)
    assert len(data) == len(head) + -(-found.shape[1] // 8) * found.shape[0]


def test_text_is_a_letter_a_dot() -> None:
    made = sheets("A4")
    stream = io.BytesIO()
    rasters.write_text(stream, made, 0)
    lines = stream.getvalue().decode("ascii").splitlines()
    columns, rows = made.sheets[0].size
    assert len(lines) == rows
    assert {len(line) for line in lines} == {columns}
    expected = codec("anoto").symbols(made.sheets[0].origin, (columns, rows), (24, 32))
    names = np.array(["u", "l", "r", "d"])[expected]
    assert lines == ["".join(row) for row in names]


def test_steps_are_counted() -> None:
    made = sheets("A4")
    two = replace(
        made,
        sheets=(made.sheets[0], replace(made.sheets[0], id="b", origin=(0, 0))),
    )
    calls: list[None] = []
    pattern.render(two, done=lambda: calls.append(None))
    assert len(calls) == rasters.count_bands(two) == 6


@pytest.mark.slow
def test_nothing_in_the_margin_comes_near_the_dots() -> None:
    """At 1200 dpi: 1 mm around the pattern is white whatever the margin holds."""
    layout = lay_out((148, 210), 10, snap(0.508, None, 300))
    tiles = tiling(layout, (2, 2), 15)
    made = manifest(layout.raster, tiles.sheets("floor-1", (5000, 6000)), "anoto")
    raster = rasterise(pattern.render(made, crop=True), 300, 0)
    left, top, right, bottom = layout.box
    near = int(page.CLEARANCE_MM / 25.4 * 300) - 2
    raster[top:bottom, left:right] = 255
    assert raster[top - near : bottom + near, left - near : right + near].min() > PAPER
    assert raster.min() <= INK + 2
