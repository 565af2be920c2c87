"""Papers, pixels of the printer, and floors of tiles."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from locatk.core.dots.codec import codec
from locatk.core.dots.drawing.layout import (
    DPIS,
    Raster,
    SheetLayout,
    lay_out,
    manifest,
    pixels,
    snap,
    snapped,
)
from locatk.core.dots.drawing.tiles import seams, tiling
from locatk.core.errors import InputError

PAGES = st.tuples(st.floats(60, 3000), st.floats(60, 3000))


def test_usual_pattern_on_the_usual_printers() -> None:
    """A pitch of 0.508 mm is 6, 12 and 24 px; offset and dot are a sixth of that."""
    assert snap(0.508, None, 300) == Raster(300, 6, 1, 1)
    assert snap(0.508, None, 600) == Raster(600, 12, 2, 2)
    assert snap(0.508, None, 1200) == Raster(1200, 24, 4, 4)
    assert snap(0.508, None, 300).mm(6) == 0.508


def test_snapped_pitch_and_dot_are_reported() -> None:
    raster = snap(0.3, 0.06, 600)
    assert raster == Raster(600, 7, 1, 1)
    assert snapped(raster, 0.3, 0.06) == [
        "pitch 0.3 mm becomes 0.2963 mm, 7 px at 600 dpi",
        "dot 0.06 mm becomes 0.04233 mm, 1 px at 600 dpi",
    ]
    assert snapped(snap(0.508, None, 600), 0.508, None) == []
    generated = manifest(raster, lay_out((100, 100), 10, raster).sheets("a", (0, 0)), "anoto")
    # What is written down is what is printed, not what was asked.
    assert generated.pitch_mm == pytest.approx(7 * 25.4 / 600, abs=1e-12)
    assert generated.offset_mm == generated.dot_mm == pytest.approx(25.4 / 600, abs=1e-12)


@pytest.mark.parametrize(
    ("pitch", "dot", "dpi"),
    [
        (0.508, 0.34, 300),  # 4 of 6 px
        (0.2, None, 300),  # 2 px
        (0.0, None, 300),
        (-0.5, None, 300),
        (math.nan, None, 300),
        (math.inf, None, 300),
        (0.508, 0.0, 300),
        (0.508, math.nan, 600),
        (0.508, None, 720),
    ],
)
def test_patterns_that_cannot_be_printed_are_refused(
    pitch: float, dot: float | None, dpi: int
) -> None:
    with pytest.raises(InputError):
        snap(pitch, dot, dpi)


@given(
    page=PAGES,
    margin=st.floats(0, 20),
    dpi=st.sampled_from(DPIS),
    pitch=st.floats(0.35, 1.2),
)
def test_dots_fill_the_page_inside_its_margin(
    page: tuple[float, float], margin: float, dpi: int, pitch: float
) -> None:
    raster = snap(pitch, None, dpi)
    layout = lay_out(page, margin, raster)
    left, top, right, bottom = layout.box
    for low, high, side, asked, first in zip(
        (left, top), (right, bottom), layout.page, page, layout.first, strict=True
    ):
        # The page and the first place are on 1/300 in.
        assert side % raster.step == first % raster.step == 0
        assert abs(side / dpi * 25.4 - asked) <= 25.4 / 600 + 1e-9
        # The page itself may be half a pixel smaller than asked.
        least = margin * dpi / 25.4 - 1e-3
        assert low >= least
        assert side - high >= least
        # No further dot fits, and both margins are the same to 1/300 in.
        assert low + side - high < 2 * math.ceil(margin * 300 / 25.4) * raster.step + (
            raster.pitch + raster.step
        )
        assert abs(low - (side - high)) <= 3 * raster.step


@given(page=PAGES, dpi=st.sampled_from(DPIS), pitch=st.floats(0.35, 1.2))
def test_a_manifest_gives_the_pixels(page: tuple[float, float], dpi: int, pitch: float) -> None:
    layout = lay_out(page, 10, snap(pitch, None, dpi))
    generated = manifest(layout.raster, layout.sheets("a", (5, 6), (7, 8)), "anoto")
    assert pixels(generated, 0) == layout
    assert generated.sheets[0].section == (7, 8)


def test_position_is_the_centre_of_a_covering_dot() -> None:
    layout = lay_out((210, 297), 10, snap(0.508, None, 600))
    generated = manifest(layout.raster, layout.sheets("a", (0, 0)), "anoto")
    # Two pixels from an even edge: the middle is at the edge between them.
    assert generated.sheets[0].first_mm[0] == pytest.approx((layout.first[0] + 1) * 25.4 / 600)
    x, y = generated.to_metres(0, (0, 0))
    assert x == pytest.approx((layout.first[0] + 1) * 0.0254 / 600)
    assert y == pytest.approx((layout.page[1] - layout.first[1] - 1) * 0.0254 / 600)


def test_foreign_manifests_are_not_drawn() -> None:
    layout = lay_out((210, 297), 10, snap(0.508, None, 300))
    generated = manifest(layout.raster, layout.sheets("a", (0, 0)), "anoto")
    for wrong in (
        replace(generated, pitch_mm=0.5),
        replace(generated, dpi=720),
        replace(generated, sheets=(replace(generated.sheets[0], page_mm=(210.0, 297.0)),)),
        replace(generated, sheets=(replace(generated.sheets[0], first_mm=(10.0, 10.0)),)),
    ):
        with pytest.raises(InputError):
            pixels(wrong, 0)


@pytest.mark.parametrize(
    ("page", "margin"),
    [
        ((210, 297), 105),
        ((210, 297), 148),
        ((20, 297), 8.5),
        ((210, 297), -1),
        ((210, 297), math.nan),
        ((math.nan, 297), 5),
        ((0, 297), 0),
    ],
)
def test_margins_larger_than_the_page_are_refused(page: tuple[float, float], margin: float) -> None:
    with pytest.raises(InputError):
        lay_out(page, margin, snap(0.508, None, 300))


def test_origins_are_checked() -> None:
    layout = lay_out((210, 297), 10, snap(0.508, None, 300))
    for origin in ((410_815_348 - 100, 0), (0, 410_815_348), (-1, 0)):
        with pytest.raises(InputError):
            layout.sheets("a", origin)
    with pytest.raises(InputError):
        layout.sheets("a", (0, 0), (63, 0))
    with pytest.raises(InputError):
        tiling(layout, (3, 1), 10).sheets("a", (410_815_348 - 400, 0))


def floor(count: tuple[int, int] = (3, 2), overlap: float = 15) -> SheetLayout:
    return lay_out((148, 210), 10, snap(0.508, None, 600))


def test_tiles_continue_one_area() -> None:
    layout = floor()
    tiles = tiling(layout, (3, 2), 15)
    generated = manifest(layout.raster, tiles.sheets("f", (1000, 2000), (1, 2)), "anoto")
    assert [sheet.id for sheet in generated.sheets] == [
        "f-c1r1", "f-c2r1", "f-c3r1", "f-c1r2", "f-c2r2", "f-c3r2",
    ]  # fmt: skip
    # 15 mm are 29.5 pitches: 30 columns and rows are on both neighbours.
    columns, rows = layout.size
    assert generated.sheets[1].origin == (1000 + columns - 30, 2000)
    assert generated.sheets[3].origin == (1000, 2000 + rows - 30)
    assert tiles.size == (3 * columns - 60, 2 * rows - 30)
    # The lower left paper is the floor's origin.
    assert generated.sheets[3].position_mm == (0.0, 0.0)
    assert all(generated.frame(number) == "floor" for number in range(6))
    # A place is at one point of the floor, whichever tile holds it.
    whole = codec("anoto").symbols((1000, 2000), tiles.size, (1, 2))
    held = np.zeros(whole.shape, int)
    at = np.full((*whole.shape, 2), np.nan)
    for number, sheet in enumerate(generated.sheets):
        x, y = (sheet.origin[0] - 1000, sheet.origin[1] - 2000)
        grid = np.stack(np.meshgrid(*map(np.arange, sheet.size)), axis=-1) + sheet.origin
        metres = generated.to_metres(number, grid)
        part = np.s_[y : y + rows, x : x + columns]
        known = ~np.isnan(at[part][..., 0])
        np.testing.assert_allclose(metres[known], at[part][known], atol=1e-9)
        at[part] = metres
        held[part] += 1
    assert held.min() == 1
    assert held.max() == 4
    steps = np.diff(at[..., 0], axis=1), np.diff(at[..., 1], axis=0)
    np.testing.assert_allclose(steps[0], 0.508e-3, atol=1e-9)
    np.testing.assert_allclose(steps[1], -0.508e-3, atol=1e-9)


@pytest.mark.parametrize("overlap", [0.0, 15.0])
def test_neighbouring_sheets_share_their_cut(overlap: float) -> None:
    layout = floor()
    generated = manifest(
        layout.raster, tiling(layout, (3, 2), overlap).sheets("f", (0, 0)), "anoto"
    )
    cuts: tuple[set[float], set[float]] = (set(), set())
    for number, sheet in enumerate(generated.sheets):
        x, y = seams(generated, number)
        column, row = number % 3, number // 3
        assert len(x) == (1 if column in (0, 2) else 2)
        assert len(y) == 1
        assert sheet.position_mm is not None
        cuts[0].update(round(at + sheet.position_mm[0], 6) for at in x)
        cuts[1].update(round(sheet.page_mm[1] - at + sheet.position_mm[1], 6) for at in y)
        # Cut there, each tile keeps half of what it shares.
        reach = sheet.first_mm[1] + (sheet.size[1] - 1) * 0.508
        held = round(overlap / 0.508 + 0.49) - 1
        inside = reach - y[0] if row == 0 else y[0] - sheet.first_mm[1]
        assert inside == pytest.approx(held * 0.508 / 2, abs=1e-6)
    assert [len(result) for result in cuts] == [2, 1]


def test_single_sheets_have_no_seams() -> None:
    layout = floor()
    generated = manifest(layout.raster, layout.sheets("a", (0, 0)), "anoto")
    assert seams(generated, 0) == ([], [])


@pytest.mark.parametrize(
    ("count", "overlap"), [((0, 1), 10.0), ((2, 2), 70.0), ((2, 2), -1.0), ((2, 2), math.nan),
                           ((1000, 2), 0.0)]
)  # fmt: skip
def test_impossible_tiles_are_refused(count: tuple[int, int], overlap: float) -> None:
    with pytest.raises(InputError):
        tiling(floor(), count, overlap)
