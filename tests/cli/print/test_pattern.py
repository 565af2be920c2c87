"""`locatk print pattern` as a user runs it."""

from __future__ import annotations

import contextlib
import json
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from locatk.cli import options
from locatk.core.dots.codec import sequences
from locatk.core.dots.drawing.layout import DPIS
from locatk.formats.artifacts.ledger import LEDGER_FILE, open_ledger
from locatk.formats.artifacts.sheets import read_manifest
from locatk.formats.printing.rasters import WRITERS


def page_sizes(path: Path) -> list[tuple[float, float]]:
    """In mm, by another reader than ours."""
    import pypdfium2

    return [
        (page.get_width() * 25.4 / 72, page.get_height() * 25.4 / 72)
        for page in pypdfium2.PdfDocument(str(path))
    ]


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.slow
def test_a_sheet_its_manifest_and_the_ledger(locatk, tmp_path: Path) -> None:
    out = tmp_path / "sheet.pdf"
    result = locatk("print", "pattern", "-o", out)
    assert result.exit_code == 0, result.stderr
    assert names(tmp_path) == [LEDGER_FILE, "sheet.pdf", "sheet.toml"]
    assert "A4-0001" in result.stdout
    assert "374 x 545" in result.stdout
    assert "100 %" in result.stderr
    assert page_sizes(out) == [pytest.approx((210, 297), abs=0.05)]
    made = read_manifest(tmp_path / "sheet.toml")
    assert (made.codec, made.dpi, made.pitch_mm, made.scale) == ("anoto", 300, 0.508, (1, 1))
    with open_ledger(tmp_path / LEDGER_FILE) as book:
        (area,) = book.areas
    assert (area.id, area.origin, area.size) == ("A4-0001", (0, 0), (374, 545))


def test_json_is_all_that_is_printed(locatk, tmp_path: Path) -> None:
    out = tmp_path / "sheet.pdf"
    result = locatk(
        "print", "pattern", "-o", out, "--json", "--size", "a5", "--landscape", "--dpi", "600",
        "--codec", "libdots", "--origin", "1330,7200", "--section", "24,32", "--id", "hall",
        "--count", "2",
    )  # fmt: skip
    assert result.exit_code == 0, result.stderr
    answer: dict[str, Any] = json.loads(result.stdout)
    assert answer["version"] == 1
    assert answer["outputs"] == [str(out)]
    assert answer["manifest"] == str(tmp_path / "sheet.toml")
    assert answer["ledger"] == str(tmp_path / LEDGER_FILE)
    assert (answer["codec"], answer["dpi"], answer["pitch_mm"]) == ("libdots", 600, 0.508)
    first, second = answer["sheets"]
    assert (first["id"], second["id"]) == ("hall-1", "hall-2")
    assert first["origin"] == [1330, 7200]
    assert first["section"] == second["section"] == [24, 32]
    assert second["origin"][0] >= 1330 + first["size"][0]
    assert first["page_mm"] == pytest.approx([210, 148], abs=0.05)
    assert len(page_sizes(out)) == 2
    # What is said is what the manifest holds.
    made = read_manifest(tmp_path / "sheet.toml")
    for said, sheet in zip(answer["sheets"], made.sheets, strict=True):
        for key in ("origin", "size", "section", "page_mm", "first_mm"):
            assert tuple(said[key]) == getattr(sheet, key)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("size", "width", "height"),
    [
        ("A5", 148, 210),
        ("A3", 297, 420),
        ("A1", 594, 841),
        ("Letter", 215.9, 279.4),
        ("tabloid", 279.4, 431.8),
        ("300x4000mm", 300, 4000),
    ],
)
def test_papers(locatk, tmp_path: Path, size: str, width: float, height: float) -> None:
    out = tmp_path / "sheet.pdf"
    # Wide pitches: this is about papers.
    assert locatk("print", "pattern", "-o", out, "--size", size, "--pitch", 3).exit_code == 0
    assert page_sizes(out) == [pytest.approx((width, height), abs=0.05)]
    more = ["--size", size, "--pitch", 3, "--overwrite", "--landscape"]
    assert locatk("print", "pattern", "-o", out, *more).exit_code == 0
    assert page_sizes(out) == [pytest.approx((height, width), abs=0.05)]


def test_same_input_same_bytes(locatk, tmp_path: Path) -> None:
    files = []
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        out = tmp_path / folder / "sheet.pdf"
        assert locatk("print", "pattern", "-o", out, "--size", "A5", "--count", 2).exit_code == 0
        files.append([(tmp_path / folder / n).read_bytes() for n in names(tmp_path / folder)])
    assert len(files[0]) == 3
    assert files[0] == files[1]


@pytest.mark.slow
def test_each_sheet_has_an_area_of_its_own(locatk, tmp_path: Path) -> None:
    held = np.zeros((2000, 6000), int)
    for n, more in enumerate(([], ["--landscape"], ["--count", 3], ["--tiles", "2x2"])):
        out = tmp_path / f"{n}.txt"
        result = locatk("print", "pattern", "-o", out, "--size", "A5", *more)
        assert result.exit_code == 0, result.stderr
        floor = np.zeros_like(held)
        for sheet in read_manifest(tmp_path / f"{n}.toml").sheets:
            (x, y), (columns, rows) = sheet.origin, sheet.size
            assert x + columns <= held.shape[1]
            assert y + rows <= held.shape[0]
            floor[y : y + rows, x : x + columns] = 1
        held += floor
    assert held.max() == 1


def test_overlap_is_refused_unless_forced(locatk, tmp_path: Path) -> None:
    first, second = tmp_path / "first.pdf", tmp_path / "second.pdf"
    size = ["--size", "A5"]
    assert locatk("print", "pattern", "-o", first, *size, "--origin", "100,100").exit_code == 0
    before = (tmp_path / LEDGER_FILE).read_bytes()
    result = locatk("print", "pattern", "-o", second, *size, "--origin", "350,470")
    assert result.exit_code == 1
    assert "A5-0001" in result.stderr
    assert "--force" in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert (tmp_path / LEDGER_FILE).read_bytes() == before
    assert not second.exists()
    forced = locatk("print", "pattern", "-o", second, *size, "--origin", "350,470", "--force")
    assert forced.exit_code == 0, forced.stderr
    # In another ledger the area is free; the same ledger may be anywhere.
    third = tmp_path / "third.pdf"
    other = ["--ledger", tmp_path / "other.toml"]
    assert locatk("print", "pattern", "-o", third, *size, "--origin", "0,0", *other).exit_code == 0
    assert (tmp_path / "other.toml").exists()


def test_the_ledger_may_be_named_by_the_environment(
    locatk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LOCATK_LEDGER", str(tmp_path / "mine.toml"))
    (tmp_path / "out").mkdir()
    assert locatk("print", "pattern", "-o", tmp_path / "out" / "a.txt").exit_code == 0
    assert names(tmp_path) == ["mine.toml", "out"]
    assert names(tmp_path / "out") == ["a.toml", "a.txt"]


@pytest.mark.slow
def test_tiles_form_one_floor(locatk, tmp_path: Path) -> None:
    out = tmp_path / "floor.pdf"
    result = locatk("print", "pattern", "-o", out, "--size", "A5", "--tiles", "3x2", "--json")
    assert result.exit_code == 0, result.stderr
    sheets = json.loads(result.stdout)["sheets"]
    assert len(sheets) == len(page_sizes(out)) == 6
    assert sheets[0]["id"] == "A5-0001-c1r1"
    assert sheets[3]["position_mm"] == [0, 0]
    with open_ledger(tmp_path / LEDGER_FILE) as book:
        assert [area.id for area in book.areas] == ["A5-0001"]


def test_snapping_is_reported(locatk, tmp_path: Path) -> None:
    result = locatk("print", "pattern", "-o", tmp_path / "a.pdf", "--pitch", 0.5, "--dot", 0.1)
    assert result.exit_code == 0
    assert "Pitch 0.5 mm becomes 0.508 mm, 6 px at 300 dpi." in result.stderr
    assert "Dot 0.1 mm becomes 0.08467 mm, 1 px at 300 dpi." in result.stderr
    assert read_manifest(tmp_path / "a.toml").pitch_mm == 0.508
    assert "becomes" not in locatk("print", "pattern", "-o", tmp_path / "b.pdf").stderr


def test_png_and_text(locatk, tmp_path: Path) -> None:
    base = ["print", "pattern", "--size", "A5", "--dpi", "600"]
    assert locatk(*base, "-o", tmp_path / "a.png").exit_code == 0
    data = (tmp_path / "a.png").read_bytes()
    assert struct.unpack(">II", data[16:24]) == (2 * 1748, 2 * 2480)
    assert data[24] == 1
    # A file a sheet, named by its id.
    assert locatk(*base, "-o", tmp_path / "b.txt", "--count", 2).exit_code == 0
    assert {"b-A5-0002.txt", "b-A5-0003.txt", "b.toml"} <= set(names(tmp_path))
    made = read_manifest(tmp_path / "b.toml")
    lines = (tmp_path / "b-A5-0003.txt").read_text().splitlines()
    assert (len(lines[0]), len(lines)) == made.sheets[1].size
    assert set("".join(lines)) == set("uldr")


@pytest.mark.parametrize("ending", ["tif", "TIFF", "pbm"])
def test_images_of_the_printers_pixels(locatk, tmp_path: Path, ending: str) -> None:
    base = ["print", "pattern", "--size", "60x80mm", "--origin", "0,0", "--force"]
    for name in ("a.png", f"b.{ending}"):
        assert locatk(*base, "-o", tmp_path / name).exit_code == 0
    images = [
        cv2.imread(str(tmp_path / name), cv2.IMREAD_UNCHANGED) for name in ("a.png", f"b.{ending}")
    ]
    np.testing.assert_array_equal(*images)
    assert {"a.toml", "b.toml"} < set(names(tmp_path))


def document(path: Path, pages: int = 2, **more: Any) -> Path:
    from reportlab.pdfgen.canvas import Canvas

    canvas = Canvas(str(path), pagesize=(420, 595), **more)
    for _ in range(pages):
        canvas.drawString(100, 300, "Hall")
        canvas.showPage()
    canvas.save()
    return path


def test_overlay(locatk, tmp_path: Path) -> None:
    source = document(tmp_path / "drawing.pdf")
    out = tmp_path / "map.pdf"
    result = locatk(
        "print", "pattern", "-o", out, "--overlay", source, "--strip-black", "--json"
    )  # fmt: skip
    assert result.exit_code == 0, result.stderr
    assert page_sizes(out) == [pytest.approx((148.17, 209.9), abs=0.05)] * 2
    first, second = json.loads(result.stdout)["sheets"]
    assert second["origin"][0] >= first["origin"][0] + first["size"][0]
    assert "black" not in result.stderr
    # Black that remains is reported, and nothing else changes.
    plain = locatk("print", "pattern", "-o", tmp_path / "plain.pdf", "--overlay", source, "--json")
    assert plain.exit_code == 0
    assert json.loads(plain.stdout)["outputs"] == [str(tmp_path / "plain.pdf")]
    (warning,) = [line for line in plain.stderr.splitlines() if line.startswith("Warning:")]
    assert "drawing.pdf has black or grey on 2 of 2 pages" in warning
    assert "--strip-black" in warning
    # Never over the document itself.
    same = locatk("print", "pattern", "-o", source, "--overlay", source, "--overwrite")
    assert same.exit_code == 1
    assert "one of the inputs" in same.stderr
    assert source.read_bytes().startswith(b"%PDF")


@pytest.mark.slow
def test_bad_documents(locatk, tmp_path: Path) -> None:
    from reportlab.lib.pdfencrypt import StandardEncryption

    broken = tmp_path / "broken.pdf"
    broken.write_bytes(b"%PDF-1.4\n1 0 obj\n<<")
    locked = document(tmp_path / "locked.pdf", encrypt=StandardEncryption("secret"))
    small = tmp_path / "small.pdf"
    from reportlab.pdfgen.canvas import Canvas

    canvas = Canvas(str(small), pagesize=(595, 842))
    canvas.showPage()
    canvas.setPageSize((50, 50))
    canvas.showPage()
    canvas.save()
    out = tmp_path / "out.pdf"
    for path, words in ((broken, "broken.pdf"), (locked, "encrypted"), (small, "page 2")):
        result = locatk("print", "pattern", "-o", out, "--overlay", path)
        assert result.exit_code == 1
        assert words in result.stderr
        assert len(result.stderr.splitlines()) == 1
        assert not out.exists()
        assert not (tmp_path / LEDGER_FILE).exists()


def test_nothing_is_overwritten_unasked(locatk, tmp_path: Path) -> None:
    out = tmp_path / "sheet.txt"
    run = ["print", "pattern", "-o", out, "--size", "A5"]
    for name in ("sheet.txt", "sheet.toml"):
        (tmp_path / name).write_text("mine")
        result = locatk(*run)
        assert result.exit_code == 1
        assert "--overwrite" in result.stderr
        assert (tmp_path / name).read_text() == "mine"
        assert names(tmp_path) == [name]
        (tmp_path / name).unlink()
    assert locatk(*run).exit_code == 0
    assert locatk(*run, "--overwrite").exit_code == 0
    # The area of the sheet that is gone is not given out again: paper cannot be overwritten.
    assert read_manifest(tmp_path / "sheet.toml").sheets[0].id == "A5-0002"


def test_a_damaged_ledger_stops_everything(locatk, tmp_path: Path) -> None:
    book = tmp_path / LEDGER_FILE
    book.write_text("areas = 3\n")
    result = locatk("print", "pattern", "-o", tmp_path / "a.pdf", "--overwrite", "--force")
    assert result.exit_code == 1
    assert str(book) in result.stderr
    assert book.read_text() == "areas = 3\n"
    assert names(tmp_path) == [LEDGER_FILE]


@pytest.mark.parametrize(
    ("args", "status", "words"),
    [
        (["--size", "A9"], 1, "A9"),
        (["--size", "-5x10mm"], 1, "no paper"),
        (["--size", "30x6000mm"], 1, "5080"),
        (["--margin", "150"], 1, "no room"),
        (["--margin", "-1"], 1, "margin"),
        (["--margin", "nan"], 2, "margin"),
        (["--pitch", "0.1"], 1, "touch"),
        (["--pitch", "inf"], 2, "pitch"),
        (["--dot", "0.4"], 1, "touch"),
        (["--dpi", "720"], 2, "720"),
        (["--origin", "5"], 2, "pair"),
        (["--origin", "5,-5"], 2, "pair"),
        (["--origin", "5,6,7"], 2, "pair"),
        (["--origin", "410815348,0"], 1, "0..410815347"),
        (["--origin", "0,410815000"], 1, "cross the border"),
        (["--origin", "410814500,0", "--count", "3"], 1, "410815376 is not"),
        (["--section", "63,0"], 2, "section"),
        (["--codec", "neo"], 2, "neo"),
        (["--tiles", "0x2"], 2, "below 1"),
        (["--tiles", "2"], 2, "pair"),
        (["--tiles", "2x2", "--overlap", "150"], 1, "overlap"),
        (["--tiles", "2x2", "--count", "2"], 2, "--count"),
        (["--count", "0"], 2, "0"),
        (["--id", "a b"], 1, "a b"),
        (["--id", "floor"], 1, "floor"),
        (["--strip-black"], 2, "--overlay"),
        (["--crop-marks", "-o", "a.png"], 2, "--format pdf"),
        (["--format", "svg"], 2, "svg"),
        (["--format", "png"], 2, "end it in .png"),
        (["-o", "a.tif", "--format", "png"], 2, "end it in .png"),
        (["-o", "a.svg"], 2, "(.pdf, .png, .tiff, .tif, .pbm, .txt)"),
        (["-o", "a.svg", "--format", "pdf"], 2, "end it in .pdf"),
        (["-o", "a.jpg"], 2, "(.pdf, .png, .tiff, .tif, .pbm, .txt)"),
        (["-o", "sheet"], 2, "The ending of 'sheet'"),
        (["-o", "sheet.toml"], 2, "The ending of 'sheet.toml'"),
        (["--overlay", "none.pdf"], 1, "none.pdf"),
        (["--ledger", "none/ledger.toml"], 1, "folder"),
        (["--count", "500", "-o", "a.txt"], 2, "200"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_wrong_arguments(locatk, tmp_path: Path, args: list[str], status: int, words: str) -> None:
    with contextlib.chdir(tmp_path):  # the last -o counts
        result = locatk("print", "pattern", "-o", "a.pdf", *args)
    assert result.exit_code == status, result.output
    assert words in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert result.stdout == ""
    assert names(tmp_path) == []


def test_options_that_contradict_an_overlay(locatk, tmp_path: Path) -> None:
    source = document(tmp_path / "drawing.pdf")
    for more in (["--size", "A4"], ["--landscape"], ["--count", "2"], ["--tiles", "1x2"],
                 ["--format", "png"]):  # fmt: skip
        result = locatk("print", "pattern", "-o", tmp_path / "a.pdf", "--overlay", source, *more)
        assert result.exit_code == 2, more
    assert names(tmp_path) == ["drawing.pdf"]


def test_one_file_for_two_things_is_refused(locatk, tmp_path: Path) -> None:
    for name in ("locatk-ledger.pdf", "locatk-ledger.txt"):
        result = locatk("print", "pattern", "-o", tmp_path / name)
        assert result.exit_code == 1
        assert "one file" in result.stderr
    assert names(tmp_path) == []


def test_a_too_narrow_margin_is_reported(locatk, tmp_path: Path) -> None:
    run = ["print", "pattern", "--size", "A5", "--margin", 5]
    assert "A5-0001" in locatk(*run, "-o", tmp_path / "a.pdf").stderr
    assert "Warning" not in locatk(*run, "-o", tmp_path / "b.pdf", "--no-marks").stderr


def test_choices_are_those_of_core() -> None:
    """Written twice, because commands import nothing heavy."""
    assert set(options.load("locatk.cli.print.pattern:CODECS")) == set(sequences.FOURTH_DIGITS)
    assert set(options.load("locatk.cli.print.pattern:ENDINGS")) == {"pdf", *WRITERS}
    command = options.load("locatk.cli.print.pattern:pattern")
    option = next(p for p in command.params if p.name == "dpi")
    assert [int(choice) for choice in option.type.choices] == list(DPIS)
