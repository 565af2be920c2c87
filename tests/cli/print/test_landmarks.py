"""`locatk print landmarks`, as a user runs it."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pypdfium2
import pytest

from locatk.core.landmarks.landmark import name
from locatk.core.landmarks.map.floor import HOLE_CODE, FloorMap
from locatk.formats.artifacts.maps import write_map

CODES = np.array([[0, 3, 7], [7, HOLE_CODE, 15], [9, 9, 7]])


@pytest.fixture
def map_file(tmp_path: Path) -> Path:
    path = tmp_path / "map.toml"
    write_map(path, FloorMap(CODES, name="hall"))
    return path


def words(path: Path, page: int) -> str:
    text = pypdfium2.PdfDocument(str(path))[page - 1].get_textpage().get_text_range()
    return " ".join(text.split())


@pytest.mark.parametrize("size", ["60x60mm", "45x45mm"])
def test_a_paper_too_small_for_the_plan_is_refused(
    locatk, map_file: Path, tmp_path: Path, size: str
) -> None:
    result = locatk("print", "landmarks", map_file, "-o", tmp_path / "pack.pdf", "--size", size)
    assert result.exit_code == 1
    assert "is too small for the plan of the floor" in result.stderr
    assert not (tmp_path / "pack.pdf").exists()


def test_a_pack(locatk, map_file: Path, tmp_path: Path) -> None:
    out, parts = tmp_path / "pack.pdf", tmp_path / "parts.csv"
    result = locatk(
        "print", "landmarks", map_file, "-o", out, "--bom", parts, "--spares", 25, "--json"
    )
    assert result.exit_code == 0, result.stderr
    assert "100 %" in result.stderr
    answer = json.loads(result.stdout)
    assert answer["version"] == 1
    assert (answer["output"], answer["bom"]) == (str(out), str(parts))
    assert answer["landmarks"] == 8
    assert answer["page_mm"] == [210, 297]
    assert answer["pages"] == len(pypdfium2.PdfDocument(str(out)))
    assert list(answer["parts"]) == ["plan", "templates", "materials", "checklist", "list"]
    assert answer["parts"]["list"][1] == answer["pages"]
    counts = {item["bars"]: (item["code"], item["cells"]) for item in answer["templates"]}
    assert counts == {
        "SSSS": ("0", 1), "NNSS": ("3", 1), "NNNS": ("7", 3), "NSSN": ("9", 2), "NNNN": ("f", 1),
    }  # fmt: skip
    for item in answer["templates"]:
        said = words(out, item["page"])
        assert f"Code {item['code']} = {item['bars']}" in said
    sevens = next(item for item in answer["templates"] if item["code"] == "7")
    assert "row 0: 2; row 1: 0; row 2: 2" in words(out, sevens["page"])
    with parts.open() as stream:
        rows = {row["part"]: int(row["count"]) for row in csv.DictReader(stream) if row["count"]}
    assert (rows["bar magnet"], rows["bar magnet, spare"]) == (32, 8)
    assert {item["part"]: item["count"] for item in answer["materials"]} == rows
    listed = words(out, answer["parts"]["list"][0])
    assert f"2 1 200 400 9 {name(9)}" in listed


def test_templates_alone(locatk, map_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "templates.pdf"
    result = locatk("print", "landmarks", map_file, "-o", out, "--templates", "--paper", "A3")
    assert result.exit_code == 0, result.stderr
    first, *rest = result.stdout.splitlines()
    assert first.startswith(f"Wrote {out}: ")
    assert "8 landmarks, 34 bars with spares" in rest
    assert any("templates" in line for line in rest)
    assert not any("plan" in line for line in rest)
    assert "floor plan" not in words(out, 1)


def test_the_floor_at_true_size(locatk, map_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "floor.pdf"
    asked = ["--floor", "--paper", "roll:600mm", "--json"]
    result = locatk("print", "landmarks", map_file, "-o", out, *asked)
    assert result.exit_code == 0, result.stderr
    answer = json.loads(result.stdout)
    assert answer["pages"] == 1
    (tile,) = answer["tiles"]
    assert (tile["id"], tile["page"]) == ("c1r1", 1)
    assert 600 in answer["page_mm"]
    page = pypdfium2.PdfDocument(str(out))[0]
    size = [side * 25.4 / 72 for side in page.get_size()]
    assert size == pytest.approx(answer["page_mm"], abs=0.05)
    left, bottom, right, top = tile["box_mm"]
    assert tile["x_mm"] < -30
    assert tile["x_mm"] + right - left > 430
    assert tile["y_mm"] < -30
    assert tile["y_mm"] + top - bottom > 430
    result = locatk("print", "landmarks", map_file, "-o", tmp_path / "a4.pdf", "--floor", "--json")
    answer = json.loads(result.stdout)
    assert answer["pages"] > 1
    assert answer["tiles"][0]["y_mm"] > answer["tiles"][-1]["y_mm"], "the first is the upper left"


def test_same_map_same_bytes(locatk, map_file: Path, tmp_path: Path) -> None:
    for more in ([], ["--floor"]):
        made = []
        for number in range(2):
            out = tmp_path / f"{len(more)}-{number}.pdf"
            assert locatk("print", "landmarks", map_file, "-o", out, *more).exit_code == 0
            made.append(out.read_bytes())
        assert made[0] == made[1]


@pytest.mark.parametrize(
    ("more", "status", "said"),
    [
        (["--templates", "--floor"], 2, "leave one out"),
        (["--overlap", 20], 2, "--floor"),
        (["--paper", "roll:914mm"], 2, "--floor"),
        (["--floor", "--paper", "roll:wide"], 1, "roll:914mm"),
        (["--paper", "A17"], 1, "A17"),
        (["--size", "A5"], 0, "148 x 210"),
        (["--paper", "105x105mm"], 1, "105 x 105 mm is too small"),
        (["--paper", "115x140mm"], 1, "which paper 115x140"),
        (["--floor", "--margin", 2], 1, "joining marks"),
        (["--spares", -1], 2, "--spares"),
        (["--bom", "parts.txt"], 2, "end it in .csv"),
    ],
)
def test_wrong_arguments_are_reported(
    locatk, map_file: Path, tmp_path: Path, more: list[object], status: int, said: str
) -> None:
    out = tmp_path / "a.pdf"
    result = locatk("print", "landmarks", map_file, "-o", out, *more)
    assert result.exit_code == status, result.stderr
    assert said in result.stdout + result.stderr
    assert out.exists() == (status == 0)
    assert "Traceback" not in result.stderr


@pytest.mark.parametrize(
    ("command", "ending"), [("landmarks", ".svg"), ("landmarks", ".png"), ("testsheet", ".tiff")]
)
def test_only_pdf_is_written(
    locatk, map_file: Path, tmp_path: Path, command: str, ending: str
) -> None:
    source = [map_file] if command == "landmarks" else []
    before = sorted(tmp_path.iterdir())
    result = locatk("print", command, *source, "-o", tmp_path / f"a{ending}")
    assert result.exit_code == 2
    assert "end it in .pdf" in result.stderr
    assert sorted(tmp_path.iterdir()) == before


def test_nothing_is_replaced_unasked(locatk, map_file: Path, tmp_path: Path) -> None:
    out, parts = tmp_path / "a.pdf", tmp_path / "parts.csv"
    parts.write_text("mine")
    refused = locatk("print", "landmarks", map_file, "-o", out, "--bom", parts)
    assert refused.exit_code == 1
    assert "--overwrite" in refused.stderr
    assert not out.exists()
    assert parts.read_text() == "mine"
    done = locatk("print", "landmarks", map_file, "-o", out, "--bom", parts, "--overwrite")
    assert done.exit_code == 0, done.stderr
    before = map_file.read_bytes()
    itself = locatk("print", "landmarks", map_file, "-o", map_file, "--overwrite")
    assert itself.exit_code == 2
    assert map_file.read_bytes() == before
    # Nor under another name of it.
    (tmp_path / "link.pdf").symlink_to(map_file)
    itself = locatk("print", "landmarks", map_file, "-o", tmp_path / "link.pdf", "--overwrite")
    assert itself.exit_code == 1
    assert "one of the inputs" in itself.stderr
    assert map_file.read_bytes() == before


def test_maps_that_cannot_be_built_are_named(locatk, tmp_path: Path) -> None:
    missing = locatk("print", "landmarks", tmp_path / "none.toml", "-o", tmp_path / "a.pdf")
    assert missing.exit_code == 1
    assert "none.toml" in missing.stderr
    tight = tmp_path / "tight.toml"
    write_map(tight, FloorMap(CODES, pitch_m=0.05))
    result = locatk("print", "landmarks", tight, "-o", tmp_path / "a.pdf")
    assert result.exit_code == 1
    assert str(tight) in result.stderr
    assert "overlap" in result.stderr
    broken = tmp_path / "broken.toml"
    broken.write_text('format = "locatk-landmark-map"\nformat_version = 1\nrows = ["0z"]\n')
    result = locatk("print", "landmarks", broken, "-o", tmp_path / "a.pdf")
    assert result.exit_code == 1
    assert str(broken) in result.stderr
    assert not (tmp_path / "a.pdf").exists()


def test_prices_are_in_the_pack_and_errors_are_one_line(
    locatk, map_file: Path, tmp_path: Path
) -> None:
    template = locatk("print", "landmarks", "--print-prices")
    assert template.exit_code == 0
    prices, out = tmp_path / "prices.toml", tmp_path / "pack.pdf"
    keys = 'price = 0.4\ncurrency = "EUR"\ndate = "2026-11"\nsource = "shop"\n'
    bars = '[[parts]]\npart = "bar magnet"\n'
    # A bill has one currency.
    glue = '[[parts]]\npart = "adhesive"\n'
    mixed = template.stdout.replace(bars, bars + keys)
    prices.write_text(mixed.replace(glue, glue + keys.replace("EUR", "USD")))
    words_of = ("print", "landmarks", map_file, "-o", out, "--prices", prices)
    refused = locatk(*words_of)
    assert refused.exit_code == 1
    assert len(refused.stderr.strip().split("Hint:")) == 2
    assert not out.exists()
    prices.write_text(template.stdout.replace(bars, bars + keys).replace("USD", "EUR"))
    result = locatk(*words_of, "--json")
    assert result.exit_code == 0, result.stderr
    answer = json.loads(result.stdout)
    bar = answer["materials"][0]
    assert bar["sum"] == pytest.approx(0.4 * bar["count"])
    assert answer["materials_total"]["currency"] == "EUR"
    assert "compass" in answer["materials_total"]["parts_without_price"]
    page = words(out, answer["parts"]["materials"][0])
    assert f"Total {answer['materials_total']['amount']:.2f} EUR, incomplete: no price of" in page
    assert "shop, 2026-11" in page
