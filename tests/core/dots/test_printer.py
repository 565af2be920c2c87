"""The printer's test sheet: what a spoilt print of it says of the printer."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pypdfium2
import pytest
from numpy.typing import NDArray

from locatk.core.dots.calibration.printed_fields import FieldScore
from locatk.core.dots.calibration.printer import PrinterReport, calibrate, find_sheet, recommend
from locatk.core.dots.drawing.test_sheet import PrinterSheet, marker_dictionary, printer_sheet
from locatk.core.errors import DegenerateError, InputError
from locatk.formats.printing.pattern import render_test_sheet

Ink = NDArray[np.uint8]
SCAN_DPI = 450.0

LIGHT = np.clip(0.85 - 0.82 * np.arange(256) / 255, 0, 1)
GREY = np.rint(255 * (1.055 * LIGHT ** (1 / 2.4) - 0.055)).astype(np.uint8)
"""Grey value, as sRGB has it, of each share of ink."""


def printed(sheet: PrinterSheet) -> Ink:
    """A perfect print, by a renderer that is not ours: 255 where there is ink."""
    page = pypdfium2.PdfDocument(render_test_sheet(sheet))[0]
    picture = page.render(scale=sheet.dpi / 72).to_numpy()[..., 0]
    return np.where(picture < 128, np.uint8(255), np.uint8(0))


@pytest.fixture(scope="module")
def coarse() -> Ink:
    """Of 300 dpi: dots of one to three pixels at five pitches."""
    return printed(printer_sheet("A4", 300))


@pytest.fixture(scope="module")
def fine() -> Ink:
    """Of 600 dpi: dots of one to five pixels at six pitches."""
    return printed(printer_sheet("Letter", 600, "libdots"))


def picture(
    ink: Ink, to_picture: NDArray[np.float64], size: tuple[int, int], blur_px: float = 0.8
) -> NDArray[np.uint8]:
    """What a scanner or a camera makes of a print: optics in light, noise, grey values in sRGB.

    ``to_picture`` maps pixels of the printer to those of the picture.
    """
    observed = cv2.warpPerspective(ink, to_picture, size, flags=cv2.INTER_LINEAR)
    grey = GREY[cv2.GaussianBlur(observed, (0, 0), blur_px)]
    patch = np.random.default_rng(1).integers(0, 13, (701, 703), np.uint8)
    times = (size[1] // 701 + 1, size[0] // 703 + 1)
    noise = np.tile(patch, times)[: size[1], : size[0]]
    return cv2.subtract(cv2.add(grey, noise), 6)


def scan(
    ink: Ink,
    dpi: int,
    scale: tuple[float, float] = (1.0, 1.0),
    turn_deg: float = 0.0,
    scan_dpi: float = SCAN_DPI,
) -> NDArray[np.uint8]:
    """A flat scan of a print that came out ``scale`` times as large."""
    angle = np.radians(turn_deg)
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    linear = rotation @ np.diag(scale) * scan_dpi / dpi
    corners = np.array([[0, 0], ink.shape[::-1], [ink.shape[1], 0], [0, ink.shape[0]]]) @ linear.T
    low, high = corners.min(axis=0) - 40.3, corners.max(axis=0) + 40
    to_picture = np.eye(3)
    to_picture[:2] = np.c_[linear, -low]
    width, height = (high - low).astype(int)
    return picture(ink, to_picture, (int(width), int(height)))


@pytest.fixture(scope="module")
def flat(coarse: Ink) -> NDArray[np.uint8]:
    """A scan at the true size; tests that spoil it take a copy."""
    image = scan(coarse, 300)
    image.flags.writeable = False
    return image


def by_name(report: PrinterReport) -> dict[str, FieldScore]:
    return {field.name: field for field in report.fields}


def losing(ink: Ink, share_by_area: dict[int, float]) -> Ink:
    """The print without a share of the dots of so many pixels."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(ink, connectivity=4)
    dice = np.random.default_rng(2).random(len(stats))
    share = [share_by_area.get(int(area), 0.0) for area in stats[:, cv2.CC_STAT_AREA]]
    gone = dice < share
    return np.where(gone[labels], np.uint8(0), ink)


@pytest.mark.slow
def test_a_good_print_is_read_and_its_scale_measured(fine: Ink) -> None:
    image = scan(fine, 600, scale=(1.003, 0.996), turn_deg=1.3, scan_dpi=600)
    report = calibrate(image, (600, 600))
    assert (report.sheet.paper, report.sheet.dpi, report.sheet.codec) == ("Letter", 600, "libdots")
    assert report.doubt is None
    assert report.scale == pytest.approx((1.003, 0.996), abs=1e-4)
    for field in report.fields:
        assert field.read
        if field.dot_px > 1:
            assert (field.found, field.right, field.wrong_bits) == (1, 1, 0)
            assert field.scatter < 0.01
            assert field.gain == pytest.approx(1, abs=0.2)
    best = report.recommended
    assert best is not None
    assert best.pitch_mm == pytest.approx(0.508)
    assert best.margin == max(f.margin for f in report.fields if f.pitch_mm == best.pitch_mm)


@pytest.mark.slow
def test_a_sheet_may_be_scanned_sideways(coarse: Ink) -> None:
    report = calibrate(scan(coarse, 300, (1.003, 0.996), 90), (SCAN_DPI, SCAN_DPI))
    assert report.scale == pytest.approx((1.003, 0.996), abs=2e-4)
    assert all(field.right == 1 for field in report.fields)


@pytest.mark.slow
def test_lost_dots_cost_their_field_also_in_a_photo(coarse: Ink) -> None:
    with_faults = losing(coarse, {1: 0.3, 4: 0.05})
    height, width = coarse.shape
    here = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    there = np.array([[310, 190], [4020, 330], [3890, 5200], [120, 5390]], np.float32)
    image = picture(with_faults, cv2.getPerspectiveTransform(here, there), (4200, 5600))
    shade = np.linspace(0.7, 1, image.shape[1], dtype=np.float32)
    report = calibrate((image * shade).astype(np.uint8))
    assert report.scale is None
    for field in report.fields:
        assert field.read
        lost = {1: 0.3, 2: 0.05, 3: 0.0}[field.dot_px]
        assert field.found == pytest.approx(1 - lost, abs=0.05)
        assert field.right == pytest.approx(1 - lost, abs=0.05)
    assert report.recommended is not None
    assert report.recommended.dot_px == 3


@pytest.mark.slow
def test_dots_that_grow_are_measured_and_smaller_ones_recommended(
    coarse: Ink, flat: NDArray[np.uint8]
) -> None:
    grown = cv2.dilate(coarse, np.ones((2, 2), np.uint8))
    plain, fat = (
        calibrate(image, (SCAN_DPI, SCAN_DPI), pitch_mm=0.508) for image in (flat, scan(grown, 300))
    )
    assert plain.recommended is not None
    assert fat.recommended is not None
    assert fat.recommended.dot_px < plain.recommended.dot_px
    for field in fat.fields:
        if field.dot_px + 1 < 0.45 * field.pitch_px:
            grew = (field.dot_px + 1) ** 2 / field.dot_px**2
            assert field.gain == pytest.approx(grew, rel=0.1)
            assert by_name(plain)[field.name].gain == pytest.approx(1, abs=0.15)


@pytest.mark.slow
def test_a_field_is_identified_by_its_code(flat: NDArray[np.uint8]) -> None:
    image = flat.copy()
    sheet = printer_sheet("A4", 300)
    with_faults = next(field for field in sheet.fields if field.name == "B4")
    # The picture of the page starts 40 px before it: see scan().
    left, top, right, bottom = (
        round(edge * SCAN_DPI / 300 + 40.3) for edge in with_faults.layout.box
    )
    part = image[top:bottom, left:right]
    image[top:bottom, left:right] = part[::-1, ::-1]
    report = calibrate(image, (SCAN_DPI, SCAN_DPI))
    assert [field.name for field in report.fields if not field.read] == ["B4"]
    assert by_name(report)["B4"].right == 0


@pytest.mark.slow
def test_a_too_coarse_picture_gives_no_result_for_the_printer(coarse: Ink) -> None:
    report = calibrate(scan(coarse, 300, scan_dpi=300), (300, 300))
    for field in report.fields:
        assert field.judged == (field.pitch_px >= 5)
        assert field.read == field.judged
    assert report.recommended is not None


@pytest.mark.slow
def test_a_wrong_resolution_is_noticed(flat: NDArray[np.uint8]) -> None:
    doubt = calibrate(flat, (1.1 * SCAN_DPI, 1.1 * SCAN_DPI)).doubt
    assert doubt is not None
    assert "times its size" in doubt
    # Squeezed towards its lower edge, as a photo is.
    height, width = flat.shape
    here = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    there = here + np.array([[0, 0], [0, 0], [-60, 0], [60, 0]], np.float32)
    tilted = cv2.warpPerspective(flat, cv2.getPerspectiveTransform(here, there), (width, height))
    doubt = calibrate(tilted, (SCAN_DPI, SCAN_DPI)).doubt
    assert doubt is not None
    assert "no scan" in doubt


@pytest.mark.slow
def test_pictures_without_a_readable_sheet_are_refused(flat: NDArray[np.uint8]) -> None:
    noise = np.random.default_rng(3).integers(0, 256, (900, 700), np.uint8)
    for image in (noise, np.full((900, 700), 255, np.uint8)):
        with pytest.raises(DegenerateError, match="markers"):
            calibrate(image)
    bare = flat.copy()
    bare[480:-480, 480:] = 240  # only the markers are left
    with pytest.raises(DegenerateError, match="none of the 11 fields"):
        calibrate(bare)
    small = cv2.resize(flat, None, fx=0.3, fy=0.3, interpolation=cv2.INTER_AREA)
    with pytest.raises(InputError, match="two test sheets"):
        calibrate(np.hstack([small, small]))
    with pytest.raises(DegenerateError, match="fields"):
        calibrate(small)


def score(name: str, **changes: float) -> FieldScore:
    field = FieldScore(
        name, 2, 12, 0.085, 0.508, 900, 12, True, True, 1, 1, 0, 0.5, 0.01, 1, (0, 0), (0, 0)
    )  # fmt: skip
    return replace(field, **changes)


def test_the_recommended_settings() -> None:
    usual, dense, wide = score("u"), score("d", pitch_mm=0.339), score("w", pitch_mm=0.677)
    assert recommend([dense, usual, wide]) is usual
    # Wrong symbols count before all; a speck of dust does not.
    assert recommend([replace(usual, right=0.99), wide]) is wide
    speck = replace(usual, right=0.999)
    assert recommend([speck, wide]) is speck
    # A margin that is much smaller is worth another pitch.
    assert recommend([replace(usual, margin=0.2), wide]) is wide
    fat = score("f", margin=0.55)
    assert recommend([usual, fat, wide]) is fat
    assert recommend([usual, dense], pitch_mm=0.34) is dense
    assert recommend([replace(usual, right=0.5)]) is None
    assert recommend([replace(usual, read=False)]) is None
    with pytest.raises(InputError, match="no field has a pitch"):
        recommend([usual], pitch_mm=0.6)


def test_no_two_fields_share_a_position() -> None:
    for dpi in (300, 600, 1200):
        sheet = printer_sheet("A4", dpi)
        assert len(sheet.fields) >= 10
        taken: set[tuple[int, int]] = set()
        for field in sheet.fields:
            (columns, rows), (x, y) = field.layout.size, field.origin
            assert min(columns, rows) >= 16
            positions = {(x + i, y + j) for i in range(columns) for j in range(rows)}
            assert not taken & positions
            taken |= positions
            left, top, right, bottom = field.layout.box
            assert 0 < left < right < sheet.page[0]
            assert 0 < top < bottom < sheet.page[1]
    with pytest.raises(InputError):
        printer_sheet("A3", 600)
    with pytest.raises(InputError):
        printer_sheet("A4", 450)
    with pytest.raises(InputError):
        printer_sheet("A4", 600, "morse")


@pytest.mark.parametrize(("numbers", "refused"), [((0, 5), True), ((0, 0), True), ((0, 1), False)])
def test_markers_of_two_sheets_are_refused(numbers: tuple[int, int], refused: bool) -> None:
    image = np.full((200, 400), 255, np.uint8)
    for number, x in zip(numbers, (40, 240), strict=True):
        image[50:150, x : x + 100] = cv2.aruco.generateImageMarker(marker_dictionary(), number, 100)
    if refused:
        with pytest.raises(InputError, match="two test sheets"):
            find_sheet(image)
    else:
        with pytest.raises(DegenerateError, match="2 of the 4 corner markers"):
            find_sheet(image)
