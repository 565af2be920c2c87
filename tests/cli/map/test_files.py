"""`locatk map export` and `map import` as a user runs them."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import click
import ezdxf
import numpy as np
import pytest

from locatk.cli.app import app
from locatk.core.landmarks.landmark import Geometry, signs
from locatk.core.landmarks.map.floor import (
    ALPHABETS,
    HOLE_CODE,
    WINDOWS,
    AsBuiltLandmark,
    FloorMap,
    as_built_poses,
)
from locatk.formats.artifacts.maps import dumps_map, read_map, write_map

FLOOR = FloorMap(
    np.array([[7, 1, HOLE_CODE], [0, 15, 9]]),
    window="I2",
    detect=1,
    geometry=Geometry(bar_length_m=0.025),
    walls=frozenset({((0, 0), (1, 0))}),
    built={(1, 2): AsBuiltLandmark(0.002, 0.0, 0.0, signs(9), np.full(7, np.nan))},
    name="hall",
)


@pytest.fixture
def map_file(tmp_path: Path) -> Path:
    path = tmp_path / "map.toml"
    write_map(path, FLOOR)
    return path


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize(
    ("file", "format_name", "head"),
    [
        ("m.csv", "csv", b"No;Code;X mm"),
        ("m.json", "lif", b'{\n "metaInformation"'),
        ("m.yaml", "ros", b'image: "m.pgm"'),
        ("m.svg", "svg", b"<?xml"),
        ("m.dxf", "dxf", b"  0\nSECTION"),
    ],
)
def test_every_format(
    locatk, map_file: Path, tmp_path: Path, file: str, format_name: str, head: bytes
) -> None:
    out = tmp_path / file
    result = locatk("map", "export", map_file, "-o", out, "--json")
    assert result.exit_code == 0, result.stderr
    answer = json.loads(result.stdout)
    more = [str(tmp_path / "m.pgm")] if format_name == "ros" else []
    assert answer == {
        "version": 1,
        "input": str(map_file),
        "format": format_name,
        "outputs": [str(out), *more],
        "landmarks": 5,
        "as_built": 1,
    }
    assert out.read_bytes().startswith(head)
    assert len(names(tmp_path)) == 2 + len(more)
    plain = tmp_path / "plain"
    asked = locatk("map", "export", map_file, "-o", plain, "--format", format_name)
    assert asked.exit_code == 0, asked.stderr
    assert asked.stdout.startswith(f"Wrote {plain}")
    assert asked.stderr == "1 of them at their positions as built.\n"
    assert plain.read_bytes().replace(b"plain", b"m") == out.read_bytes()
    again = locatk("map", "export", map_file, "-o", out)
    assert again.exit_code == 1
    assert "exists" in again.stderr
    assert "--overwrite" in again.stderr


def test_an_existing_image_is_not_overwritten(locatk, map_file: Path, tmp_path: Path) -> None:
    (tmp_path / "floor.pgm").write_text("mine")
    result = locatk("map", "export", map_file, "-o", tmp_path / "floor.yaml")
    assert result.exit_code == 1
    assert "floor.pgm" in result.stderr
    assert names(tmp_path) == ["floor.pgm", "map.toml"]
    wrong = locatk("map", "export", map_file, "-o", tmp_path / "x.pgm", "--format", "ros")
    assert wrong.exit_code == 2
    coarse = locatk("map", "export", map_file, "-o", tmp_path / "x.yaml", "--resolution", 60)
    assert coarse.exit_code == 1
    assert "too coarse" in coarse.stderr
    assert names(tmp_path) == ["floor.pgm", "map.toml"]


def test_a_layout_is_stamped_by_its_map(
    locatk, map_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("SOURCE_DATE_EPOCH", raising=False)
    os.utime(map_file, (0, 1_700_000_000))
    for seconds, wanted in (
        (None, "2023-11-14T22:13:20.00Z"),
        ("86400", "1970-01-02T00:00:00.00Z"),
    ):
        if seconds:
            monkeypatch.setenv("SOURCE_DATE_EPOCH", seconds)
        out = tmp_path / "layout.json"
        assert locatk("map", "export", map_file, "-o", out, "--overwrite").exit_code == 0
        assert json.loads(out.read_text())["metaInformation"]["exportTimestamp"] == wanted


@pytest.mark.parametrize("file", ["m.csv", "m.json"])
def test_export_and_import_give_the_same_map(
    locatk, map_file: Path, tmp_path: Path, file: str
) -> None:
    there, back = tmp_path / file, tmp_path / "back.toml"
    assert locatk("map", "export", map_file, "-o", there).exit_code == 0
    result = locatk("map", "import", there, "-o", back, "--like", map_file, "--pitch", 200)
    assert result.exit_code == 0, result.stderr
    assert "5 landmarks in 2 rows and 3 columns of 200 mm" in result.stdout
    assert "of them deviate from their cells" in result.stderr
    found = read_map(back)
    np.testing.assert_array_equal(found.codes, FLOOR.codes)
    assert (found.window, found.detect, found.geometry) == ("I2", 1, FLOOR.geometry)
    assert found.walls == (FLOOR.walls if file.endswith("json") else frozenset())


@pytest.mark.parametrize(
    ("file", "option"), [("m.csv", ["--unique-codes"]), ("m.json", ["--lif-version", "2.0.0"])]
)
def test_variants_of_a_format_are_imported_without_options(
    locatk, map_file: Path, tmp_path: Path, file: str, option: list[str]
) -> None:
    variant, plain, back = tmp_path / file, tmp_path / f"plain-{file}", tmp_path / "back.toml"
    assert locatk("map", "export", map_file, "-o", plain).exit_code == 0
    assert locatk("map", "export", map_file, "-o", variant, *option).exit_code == 0
    assert variant.read_bytes() != plain.read_bytes()
    result = locatk("map", "import", variant, "-o", back, "--pitch", 200)
    assert result.exit_code == 0, result.stderr
    np.testing.assert_array_equal(read_map(back).codes, FLOOR.codes)
    # The option is not ignored by a format that has no such variant.
    other = locatk("map", "export", map_file, "-o", tmp_path / "m.svg", *option)
    assert other.exit_code == 2
    assert option[0] in other.stderr
    assert not (tmp_path / "m.svg").exists()


def test_json_of_an_import(locatk, tmp_path: Path) -> None:
    table, out = tmp_path / "t.csv", tmp_path / "m.toml"
    table.write_text("0;7;0;0\n1;1;150;0\n2;7;0;150\n3;8;151;150\n")
    result = locatk("map", "import", table, "-o", out, "--alphabet", "compass", "--json")
    assert result.exit_code == 1  # 1 is no letter of it
    assert "is not of the alphabet compass" in result.stderr
    assert not out.exists()
    result = locatk("map", "import", table, "-o", out, "--pitch", 150, "--window", "2x2", "--json")
    assert result.exit_code == 0, result.stderr
    answer = json.loads(result.stdout)
    assert answer["pitch_m"] == 0.15
    assert (answer["rows"], answer["columns"], answer["landmarks"]) == (2, 2, 4)
    assert answer["largest_offset_m"] == pytest.approx(1e-3)
    (warning,) = answer["warnings"]
    assert f"{table}:1: 4 of 4 landmarks have no heading" in warning
    assert warning in result.stderr
    assert read_map(out).window == "2x2"


def test_bad_files_end_with_one_line(locatk, map_file: Path, tmp_path: Path) -> None:
    table = tmp_path / "t.csv"
    for text, words in (
        (b"0;7;0;0\n1;1;150;0\n2;2;315;0\n", "off the grid"),
        (b"0;7;0;0\n1;77;150;0\n", "t.csv:2"),
        (b"0;7;0;0\n1;1;30;0\n", "pitch"),
        (b"0;7;0;0\n1;1;50;0\n", "expected at least 60"),
        (b"\xff\xfe", "not UTF-8"),
    ):
        table.write_bytes(text)
        pitch = ["--pitch", 150] if b"315" in text else []
        result = locatk("map", "import", table, "-o", tmp_path / "x.toml", *pitch)
        assert result.exit_code == 1, text
        assert words in result.stderr
        assert str(table) in result.stderr
        assert not (tmp_path / "x.toml").exists()
    assert locatk("map", "import", map_file, "-o", tmp_path / "x.toml").exit_code == 2
    assert locatk("map", "export", map_file, "-o", tmp_path / "x.txt").exit_code == 2
    assert "no.toml" in locatk("map", "export", tmp_path / "no.toml", "-o", "x.csv").stderr
    broken = tmp_path / "broken.toml"
    broken.write_text(dumps_map(FLOOR).replace('"71."', '"7x."'))
    result = locatk("map", "export", broken, "-o", tmp_path / "x.csv")
    assert result.exit_code == 1
    assert "broken.toml:map.rows[0]" in result.stderr


def test_options_are_those_of_the_core(locatk) -> None:
    """The command knows the choices without importing numpy."""
    from locatk.cli.map import import_ as map_import

    assert map_import.ALPHABETS == ALPHABETS
    assert map_import.WINDOWS == WINDOWS


def test_the_group_loads_its_commands() -> None:
    from locatk.cli.map import COMMANDS

    context = click.Context(app, **app.context_settings)
    group = app.get_command(context, "map")
    assert isinstance(group, click.Group)
    for name in ("export", "import"):
        loaded = group.get_command(context, name)
        assert loaded is not None
        assert loaded.callback is not None
        assert loaded.callback.__module__ == COMMANDS[name][0]
    assert group.get_command(context, "none") is None


@pytest.mark.slow
def test_a_large_floor(locatk, tmp_path: Path) -> None:
    codes = np.random.default_rng(1).integers(0, 16, (20, 20))
    write_map(tmp_path / "map.toml", replace(FLOOR, codes=codes, walls=frozenset(), built={}))
    for file in ("m.csv", "m.dxf"):
        assert locatk("map", "export", tmp_path / "map.toml", "-o", tmp_path / file).exit_code == 0
    back = tmp_path / "back.toml"
    assert locatk("map", "import", tmp_path / "m.csv", "-o", back).exit_code == 0
    np.testing.assert_array_equal(read_map(back).codes, codes)
    document = ezdxf.readfile(tmp_path / "m.dxf")
    assert len(document.modelspace().query("INSERT")) == 400


def test_import_of_a_drawing(locatk, map_file: Path, tmp_path: Path) -> None:
    plan, back = tmp_path / "plan.dxf", tmp_path / "back.toml"
    assert locatk("map", "export", map_file, "-o", plan).exit_code == 0
    result = locatk("map", "import", plan, "-o", back, "--like", map_file, "--pitch", 200)
    assert result.exit_code == 0, result.stderr
    assert f"Lengths in {plan} are in mm." in result.stderr
    found = read_map(back)
    np.testing.assert_array_equal(found.codes, FLOOR.codes)
    np.testing.assert_allclose(as_built_poses(found), as_built_poses(FLOOR), atol=1e-6)
    assert found.walls == frozenset()
    # The labels of the export, at the centres.
    layers = ("--layer", "CENTRES", "--layer", "LABELS")
    args = ("-o", back, "--overwrite", "--pitch", 200)
    assert locatk("map", "import", plan, *args, *layers).exit_code == 0
    np.testing.assert_array_equal(read_map(back).codes, FLOOR.codes)
    for more, status, words in (
        (("--layer", "CENTRES"), 1, "a landmark without the letters of its bars"),
        (("--layer", "NONE"), 1, "nothing is on layer 'NONE'"),
        (("--units", "yd"), 2, "yd"),
    ):
        refused = locatk("map", "import", plan, *args, *more)
        assert refused.exit_code == status
        assert words in refused.stderr
    table = tmp_path / "m.csv"
    table.write_text("0;7;0;0\n1;1;200;0\n")
    for option in ("--layer", "--units"):
        refused = locatk("map", "import", table, *args, option, "m")
        assert refused.exit_code == 2
        assert "is of --format dxf, not of csv" in refused.stderr


def test_import_of_a_drawing_by_another_program(locatk, tmp_path: Path) -> None:
    """Blocks in inches, with an attribute, and one as built 2 mm off its cell."""
    document = ezdxf.new("R2000")
    document.header["$INSUNITS"] = 1
    document.blocks.new("LM").add_attdef("LANDMARK", (0, 0))
    for x, y, letters in ((0, 0, "NNNS"), (200, 0, "nsns"), (0, 200, "SSSS"), (202, 200, "NNNN")):
        place = (x / 25.4, y / 25.4)
        insert = document.modelspace().add_blockref("LM", place, {"layer": "Magnets"})
        insert.add_auto_attribs({"LANDMARK": letters})
    plan, back = tmp_path / "plan.dxf", tmp_path / "back.toml"
    document.saveas(plan)
    result = locatk("map", "import", plan, "-o", back, "--layer", "magnets", "--pitch", 200)
    assert result.exit_code == 0, result.stderr
    found = read_map(back)
    np.testing.assert_array_equal(found.codes, [[0b0111, 0b0101], [0, 15]])
    np.testing.assert_allclose(as_built_poses(found)[3], [0.202, 0.2, 0], atol=1e-6)
