"""`locatk print testsheet` and `locatk calibrate printer`, from paper to scale."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pikepdf
import pypdfium2
import pytest
from click.testing import CliRunner, Result
from numpy.typing import NDArray
from PIL import Image

from locatk.cli.calibrate.printer import command as printer
from locatk.core.dots.codec import DOT_DIRECTIONS, codec
from locatk.core.dots.drawing.test_sheet import printer_sheet
from locatk.core.dots.sheet import Manifest, Sheet
from locatk.formats.artifacts import sheets

SCAN_DPI = 450


def raster(path: Path, dpi: int) -> NDArray[np.uint8]:
    picture: NDArray[np.uint8] = pypdfium2.PdfDocument(path)[0].render(scale=dpi / 72).to_numpy()
    return picture[..., 0]


@pytest.fixture(scope="module")
def paper(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from locatk.cli.app import app

    path = tmp_path_factory.mktemp("print") / "test.pdf"
    arguments = ["print", "testsheet", "-o", str(path), "--dpi", "300"]
    result = CliRunner().invoke(app, arguments, prog_name="locatk")
    assert result.exit_code == 0, result.stderr
    return path


@pytest.fixture(scope="module")
def scan(paper: Path) -> Path:
    """A scan of a printer that prints 100.2 mm across and 99.7 mm down for 100."""
    ink = 255 - raster(paper, 300)
    zoom = SCAN_DPI / 300
    matrix = np.array([[1.002 * zoom, 0, 11.4], [0, 0.997 * zoom, 7.7]])
    seen = cv2.warpAffine(ink, matrix, (3760, 5300), flags=cv2.INTER_LINEAR)
    image = (245 - 0.9 * cv2.GaussianBlur(seen, (0, 0), 0.8)).astype(np.uint8)
    path = paper.with_name("scan.png")
    Image.fromarray(image).save(path, dpi=(SCAN_DPI, SCAN_DPI), compress_level=1)
    return path


def calibrate(*args: object) -> Result:
    return CliRunner().invoke(printer, [str(arg) for arg in args], prog_name="printer")


@pytest.mark.slow
def test_dots_are_whole_pixels_with_the_requested_sizes(locatk, tmp_path: Path) -> None:
    path = tmp_path / "test.pdf"
    result = locatk("print", "testsheet", "-o", path, "--size", "letter", "--dpi", 600, "--json")
    assert result.exit_code == 0, result.stderr
    answer = json.loads(result.stdout)
    assert (answer["version"], answer["paper"], answer["dpi"]) == (1, "Letter", 600)
    page = raster(path, 600)
    fields = printer_sheet("Letter", 600).fields
    assert [field.name for field in fields] == [field["name"] for field in answer["fields"]]
    for field, told in zip(fields, answer["fields"], strict=True):
        n, pitch = told["dot_px"], told["pitch_px"]
        offset = max(1, round(pitch / 6))
        columns, rows = told["size"]
        symbols = codec("anoto").symbols(tuple(told["origin"]), (columns, rows))
        left, top, right, bottom = field.layout.box
        expected = np.zeros((bottom - top, right - left), bool)
        for row in range(rows):
            for column in range(columns):
                x, y = np.array([column, row]) * pitch + offset
                x, y = (x, y) + offset * DOT_DIRECTIONS[symbols[row, column]]
                expected[y : y + n, x : x + n] = True
        seen = page[top:bottom, left:right]
        assert (seen[expected] < 5).all(), field.name
        assert (seen[~expected] > 250).all(), field.name


def test_the_sheet_is_always_the_same_and_black_alone(
    locatk, paper: Path, assert_one_ink: Callable[[Any], None], tmp_path: Path
) -> None:
    again = tmp_path / "again.pdf"
    assert locatk("print", "testsheet", "-o", again, "--dpi", "300").exit_code == 0
    assert again.read_bytes() == paper.read_bytes()
    refused = locatk("print", "testsheet", "-o", again, "--dpi", "600")
    assert refused.exit_code == 1
    assert "--overwrite" in refused.stderr
    assert again.read_bytes() == paper.read_bytes()
    with pikepdf.open(paper) as pdf:
        assert pdf.Root.ViewerPreferences.PrintScaling == "/None"
        forms = list(pdf.pages[0].Resources.XObject.values())
        assert len(forms) == len(printer_sheet("A4", 300).fields) + 4
        for holder in (pdf.pages[0], *forms):
            assert_one_ink(holder)


@pytest.mark.slow
def test_a_scan_gives_dot_size_and_scale(scan: Path, tmp_path: Path) -> None:
    out = tmp_path / "printer.toml"
    upright = Manifest((Sheet("a", (0, 0), (9, 9), (0, 0), (210.0, 297.0), (10.0, 10.0)),))
    across = Manifest((Sheet("b", (0, 0), (9, 9), (0, 0), (297.0, 210.0), (10.0, 10.0)),))
    files = [tmp_path / "upright.toml", tmp_path / "across.toml"]
    for path, manifest in zip(files, (upright, across), strict=True):
        sheets.write_manifest(path, manifest)
    asked = [scan, "-o", out, "--manifest", files[0], "--manifest", files[1]]
    before = files[0].read_bytes()
    refused = calibrate(*asked)
    assert refused.exception is not None
    assert files[0].read_bytes() == before
    result = calibrate(*asked, "--overwrite", "--json")
    assert result.exit_code == 0, result.output
    answer = json.loads(result.stdout)
    assert answer["version"] == 1
    assert answer["scale_x"] == pytest.approx(1.002, abs=1e-4)
    assert answer["scale_y"] == pytest.approx(0.997, abs=1e-4)
    assert answer["recommended"] in {field["name"] for field in answer["fields"]}
    written = tomllib.loads(out.read_text())
    assert written["format"] == "locatk-printer"
    assert written["printer"]["field"] == answer["recommended"]
    assert written["printer"]["scale_x"] == pytest.approx(answer["scale_x"], abs=1e-6)
    x, y = written["printer"]["scale_x"], written["printer"]["scale_y"]
    assert sheets.read_manifest(files[0]).scale == (x, y)
    assert sheets.read_manifest(files[1]).scale == (y, x)


@pytest.mark.slow
def test_measured_rulers_count_and_words_are_for_people(scan: Path) -> None:
    result = calibrate(scan, "--measured-x", 100.3, "--measured-y", 99.5)
    assert result.exit_code == 0, result.output
    assert "x 1.00300, y 0.99500" in result.stdout
    assert result.stdout.count("<- best") == 1
    rows = [line.split() for line in result.stdout.splitlines()]
    assert len([row for row in rows if len(row) > 4 and row[4] == "%"]) == 11


@pytest.mark.slow
def test_contradictory_options_are_refused(scan: Path, tmp_path: Path) -> None:
    assert calibrate(scan, "--measured-x", 100).exit_code == 2
    assert (
        calibrate(scan, "--measured-x", 100, "--measured-y", 100, "--scan-dpi", 600).exit_code == 2
    )
    wrong = calibrate(scan, "--scan-dpi", 600)
    assert "times its size" in str(wrong.exception)
    out = tmp_path / "scan.png"
    out.write_bytes(b"\x89PNG\r\n\x1a\nnot one")
    assert str(calibrate(out).exception).startswith(f"{out}: not an image")
    empty = tmp_path / "empty.png"
    Image.new("L", (500, 700), 255).save(empty)
    result = calibrate(empty)
    assert "markers" in str(result.exception)
    assert str(empty) in str(result.exception)
