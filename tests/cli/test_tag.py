"""`locatk tag` as a user runs it."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from locatk.core.polaris import codec
from locatk.core.polaris.codec import families
from locatk.core.polaris.tag import AsBuiltTag, PlanarPose, Tags
from locatk.formats.artifacts.tags import read_tags, write_tags


def design(locatk, path: Path, *options: object):
    return locatk("tag", "design", "-o", path, *options)


@pytest.fixture
def tag(locatk, tmp_path: Path) -> Path:
    path = tmp_path / "tag.toml"
    assert design(locatk, path).exit_code == 0
    return path


def test_the_default_is_the_papers_tag(locatk, tmp_path: Path) -> None:
    path = tmp_path / "tag.toml"
    result = design(locatk, path)
    assert result.exit_code == 0, result.stderr
    assert read_tags(path) == Tags()
    assert "39.7 mm" in result.stdout
    assert "179 uT" in result.stdout
    assert "18.3 bits" in result.stdout
    assert all(len(line) <= 80 for line in result.stdout.splitlines()[1:])


@pytest.mark.parametrize("name", ["--clearance", "--diameter", "--spacing", "--noise", "--speed"])
@pytest.mark.parametrize("value", ["1e300", "1e-300"])
def test_absurd_numbers_are_refused(locatk, tmp_path: Path, name: str, value: str) -> None:
    result = design(locatk, tmp_path / "tag.toml", name, value)
    assert result.exit_code == 2
    assert f"Invalid value for '{name}'" in result.stderr
    assert "is not from" in result.stderr
    assert not list(tmp_path.iterdir())


def test_a_field_that_is_too_weak_to_be_measured(locatk, tmp_path: Path) -> None:
    result = design(locatk, tmp_path / "tag.toml", "--clearance", 1e5)
    assert result.exit_code == 3
    assert "the field is too weak" in result.stderr


def test_the_default_spacing_follows_the_clearance(locatk, tmp_path: Path) -> None:
    path = tmp_path / "mini.toml"
    result = design(
        locatk, path, "--order", 2, "--magnets", 3, "--diameter", 1, "--clearance", 4,
        "--sensors", 3, "--sensor-spacing", 8, "--filt", 5, "--rate", 17, "--speed", 0.005,
    )  # fmt: skip
    assert result.exit_code == 0, result.stderr
    made = read_tags(path)
    assert (made.order, made.magnets, made.spacing_m) == (2, 3, 0.016)
    assert "never measured" in result.stderr


def test_lengths_come_back_as_given(locatk, tmp_path: Path) -> None:
    path = tmp_path / "tag.toml"
    result = design(
        locatk, path, "--spacing", 39.7, "--clearance", 9.3, "--diameter", 2.1, "--grade", "N42",
        "--remanence", 1.2,
    )  # fmt: skip
    assert result.exit_code == 0, result.stderr
    text = path.read_text()
    for line in ("spacing_mm = 39.7", "clearance_mm = 9.3", "diameter_mm = 2.1"):
        assert line in text.splitlines()
    made = read_tags(path).magnet
    assert (made.grade, made.remanence_t) == ("N42", 1.2)


@pytest.mark.slow
def test_a_family_and_its_bill(locatk, tmp_path: Path) -> None:
    path, bom = tmp_path / "tag.toml", tmp_path / "parts.csv"
    result = design(locatk, path, "--count", 20, "--min-distance", 3, "--bom", bom)
    assert result.exit_code == 0, result.stderr
    made = read_tags(path)
    assert made.ids is not None
    assert len(set(made.ids)) == 20
    assert families.smallest_distance(made, made.ids) >= 3
    with bom.open(newline="") as stream:
        rows = {row["part"]: row for row in csv.DictReader(stream)}
    assert rows["disc magnet"]["count"] == "100"
    assert rows["disc magnet"]["unit_price"] == "0.015"
    assert (rows["disc magnet"]["sum"], rows["disc magnet"]["currency"]) == ("1.5", "USD")
    assert rows["glue"]["unit_price"] == ""
    assert rows["total"]["sum"] == "19.5"
    assert rows["total"]["detail"].endswith("no price of substrate, glue, microcontroller")
    # The same command gives the same file, byte for byte.
    again = tmp_path / "again.toml"
    design(locatk, again, "--count", 20, "--min-distance", 3)
    assert again.read_bytes() == path.read_bytes()
    result = locatk("tag", "check", path)
    assert result.exit_code == 0
    assert "Smallest distance in the family" in result.stdout


def test_tags_that_overlap_on_a_site_are_reported(locatk, tag: Path) -> None:
    site = {5: PlanarPose(0.0, 0.0, 0.0), 77: PlanarPose(0.06, 0.0, 0.0)}
    write_tags(tag, replace(Tags(), site=site), overwrite=True)
    result = locatk("tag", "check", tag)
    assert result.exit_code == 3
    assert "5 and 77" in " ".join(result.stderr.split())
    far = {**site, 77: PlanarPose(0.12, 0.0, 0.0)}
    write_tags(tag, replace(Tags(), site=far), overwrite=True)
    assert locatk("tag", "check", tag).exit_code == 0


def test_search_writes_the_best_design(locatk, tmp_path: Path) -> None:
    path = tmp_path / "found.toml"
    options = ("--search", "--count", 20, "--accuracy", "1,1", "--diameter", 2)
    result = design(locatk, path, *options, "--json")
    assert result.exit_code == 0, result.stderr
    found = json.loads(result.stdout)["search"]["designs"]
    assert [each["magnet"]["diameter_m"] for each in found] == [0.002]
    tags = read_tags(path)
    assert len(tags.ids or ()) == 20
    assert (tags.order, tags.magnets) == (found[0]["order"], found[0]["magnets"])
    text = design(locatk, path, *options, "--order", 4, "--overwrite").stdout
    assert "Designs, the first is written" in text
    assert read_tags(path).order == 4
    nothing = design(locatk, tmp_path / "no.toml", "--search", "--count", 9, "--accuracy", 0.01)
    assert nothing.exit_code == 3
    assert "the nearest reaches" in nothing.stderr
    assert not (tmp_path / "no.toml").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--search",), "--search needs --count"),
        (("--accuracy", 1), "are for --search"),
        (("--search", "--count", 3, "--max-clearance", 5), "Give the smaller one first"),
    ],
)
def test_wrong_use_of_search(locatk, tmp_path: Path, options: tuple, words: str) -> None:
    result = design(locatk, tmp_path / "tag.toml", *options)
    assert result.exit_code in (1, 2)
    assert words in result.stderr


def test_environments_are_shown(locatk, tag: Path) -> None:
    quiet = locatk("tag", "check", tag).stdout
    iron = locatk("tag", "check", tag, "--environment", "reinforced")
    assert iron.exit_code == 0
    assert "environment" not in quiet.split("planned")[1].split("one pass")[0]
    assert "reinforced" in iron.stdout
    assert all(len(line) <= 80 for line in iron.stdout.splitlines())
    strong = locatk("tag", "check", tag, "--environment", "30")
    assert strong.exit_code == 3
    assert "the field is too weak" in strong.stderr


def test_named_ids(locatk, tmp_path: Path) -> None:
    path = tmp_path / "tag.toml"
    assert design(locatk, path, "--id", 5, "--id", 1234).exit_code == 0
    assert read_tags(path).ids == (5, 1234)


def test_designs_that_violate_limits_are_written_with_warnings(locatk, tmp_path: Path) -> None:
    path = tmp_path / "tag.toml"
    result = design(locatk, path, "--rate", 100, "--orientations", 16)
    assert result.exit_code == 3
    assert read_tags(path).orientations == 16
    assert "Warning: 16 orientations are too many" in result.stderr
    assert result.stderr.splitlines()[-1].startswith("Incomplete: 100 Hz is too fast")
    assert result.stderr.count("100 Hz is too fast") == 1


def test_stdout_is_one_json_object(locatk, tmp_path: Path) -> None:
    result = design(locatk, tmp_path / "tag.toml", "--rate", 100, "--count", 3, "--json")
    assert result.exit_code == 3
    told = json.loads(result.stdout)
    assert told["version"] == 1
    assert told["tag"]["spacing_m"] == 0.04
    assert len(told["tag"]["ids"]) == 3
    assert told["plan"]["rate_hz"] == pytest.approx(61.2, abs=0.1)
    assert told["plan"]["known_speed"]["angle_rad"] < told["plan"]["free_speed"]["angle_rad"]
    assert told["materials"][0]["count"] == 15
    assert told["materials_total"]["amount"] == pytest.approx(15 * 0.015 + 9 * 2)
    assert told["materials_total"]["parts_without_price"] == [
        "substrate", "glue", "microcontroller",
    ]  # fmt: skip
    assert len(told["warnings"]) == 1
    checked = json.loads(locatk("tag", "check", tmp_path / "tag.toml", "--json").stdout)
    assert checked["tag"] == told["tag"]
    assert checked["warnings"] == []
    assert checked["smallest_distance"] >= 1


def test_outputs_are_not_overwritten_without_the_option(locatk, tmp_path: Path, tag: Path) -> None:
    before = tag.read_bytes()
    for options in ([], ["--bom", tmp_path / "parts.csv"]):
        result = design(locatk, tag, "--spacing", 50, *options)
        assert result.exit_code == 1
        assert "exists" in result.stderr
    bom = tmp_path / "parts.csv"
    bom.write_text("mine")
    result = design(locatk, tmp_path / "other.toml", "--bom", bom)
    assert result.exit_code == 1
    assert not (tmp_path / "other.toml").exists()
    assert (tag.read_bytes(), bom.read_text()) == (before, "mine")
    assert design(locatk, tag, "--spacing", 50, "--overwrite").exit_code == 0
    assert read_tags(tag).spacing_m == 0.05
    same = design(locatk, tmp_path / "x", "--bom", tmp_path / "x")
    assert "one file" in same.stderr


@pytest.mark.parametrize(
    ("options", "status", "said"),
    [
        (["--id", 5, "--count", 3], 2, "--count"),
        (["--min-distance", 3], 2, "--min-distance"),
        (["--id", 5, "--id", 5], 1, "twice"),
        (["--id", 5, "--id", 6, "--min-distance", 3], 1, "distance"),
        (["--id", 400_000], 1, "327679"),
        (["--count", 400_000], 1, "327680"),
        (["--magnets", 9], 1, "9 magnets"),
        (["--order", 1], 2, "order"),
        (["--osr", 0, "--filt", 1], 1, "does not convert"),
        (["--gain", 8], 1, "gain"),
        (["--diameter", "nan"], 2, "diameter"),
        (["--diameter", 3, "--spacing", 2], 1, "do not fit"),
        (["--remanence", 14_500], 1, "remanence"),
        (["--clearance", 0], 2, "clearance"),
        (["--clearance", "inf"], 2, "clearance"),
        (["--noise", "nan"], 2, "noise"),
        (["--spacing", -3], 2, "spacing"),
        (["--sensors", 0], 1, "no bar"),
        (["--speed", 0], 2, "speed"),
        (["--codec", "polaris-released", "--orientations", 16], 1, "polaris-released|orientations"),
    ],
    ids=str,
)
def test_impossible_designs_are_refused(
    locatk, tmp_path: Path, options: list[object], status: int, said: str
) -> None:
    result = design(locatk, tmp_path / "tag.toml", *options)
    assert result.exit_code == status, result.stderr
    assert any(part in result.stderr for part in said.split("|"))
    assert len(result.stderr.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_check_warns_of_a_family_with_small_distances(locatk, tmp_path: Path) -> None:
    path = tmp_path / "tag.toml"
    write_tags(path, Tags(ids=(0, 1, 5000), min_distance=3))
    result = locatk("tag", "check", path)
    assert result.exit_code == 3
    assert "Incomplete: ids 0 and 1 have a distance of 1, not 3" in result.stderr
    write_tags(path, Tags(ids=(0,)), overwrite=True)
    assert locatk("tag", "check", path).exit_code == 0


def test_check_uses_the_calibrated_orientations(locatk, tmp_path: Path) -> None:
    path = tmp_path / "tag.toml"
    off = AsBuiltTag(np.zeros((5, 2)), np.full(5, np.radians(2.0)), 3)
    write_tags(path, Tags(orientations=16, built={0: off}))
    assert locatk("tag", "check", path).exit_code == 0
    assert locatk("tag", "check", path, "--placement-error", 6).exit_code == 3


def test_check_refuses_other_files(locatk, tmp_path: Path) -> None:
    path = tmp_path / "tag.toml"
    path.write_text("format = 'locatk-tag'\nformat_version = 1\n")
    result = locatk("tag", "check", path)
    assert result.exit_code == 1
    assert "codec" in result.stderr
    assert locatk("tag", "check", tmp_path / "none.toml").exit_code == 1


def test_encode_and_decode_are_inverse(locatk, tmp_path: Path) -> None:
    for number in (0, 1234, 327_679):
        told = json.loads(locatk("tag", "encode", number, "--json").stdout)
        assert told["id"] == number
        layout = codec.layout_of(Tags(), number)
        assert [tuple(m["cell"]) for m in told["magnets"]] == list(layout.cells)
        at = [f"{m['cell'][0]},{m['cell'][1]}:{m['orientation_deg']}" for m in told["magnets"]]
        back = locatk("tag", "decode", *reversed(at))
        assert back.exit_code == 0, back.stderr
        assert back.stdout.strip() == str(number)
        symbols = [f"{m['cell'][0]},{m['cell'][1]}:{m['symbol']}" for m in told["magnets"]]
        assert locatk("tag", "decode", "--symbols", *symbols).stdout.strip() == str(number)


def test_meanings_of_ids_are_shown(locatk, tag: Path) -> None:
    write_tags(tag, replace(Tags(), meanings={1234: "stop"}), overwrite=True)
    encoded = locatk("tag", "encode", 1234, "--tag", tag)
    assert encoded.stdout.splitlines()[0] == "Tag 1234 of 327680, codec mosk: stop"
    magnets = json.loads(locatk("tag", "encode", 1234, "--tag", tag, "--json").stdout)
    assert magnets["meaning"] == "stop"
    cells = [f"{m['cell'][0]},{m['cell'][1]}:{m['orientation_deg']}" for m in magnets["magnets"]]
    decoded = locatk("tag", "decode", *cells, "--tag", tag)
    assert decoded.stdout.strip() == "1234"
    assert "Meaning: stop" in decoded.stderr
    assert (
        json.loads(locatk("tag", "decode", *cells, "--tag", tag, "--json").stdout)["meaning"]
        == "stop"
    )
    other = json.loads(locatk("tag", "encode", 5, "--tag", tag, "--json").stdout)
    assert other["meaning"] is None


def test_encode_draws_the_tag(locatk) -> None:
    """x is up and v1 at the lower left, as the tag's frame has it."""
    result = locatk("tag", "encode", 1234)
    lines = [line.split() for line in result.stdout.splitlines()]
    rows = {line[1]: line[2:] for line in lines if line[:1] == ["row"]}
    layout = codec.layout_of(Tags(), 1234)
    for (column, row), symbol in zip(layout.cells, layout.symbols, strict=True):
        assert rows[str(row)][column] == f"{45 * symbol}"
    assert rows["0"][2] == "-"
    assert sum(cell == "." for row in rows.values() for cell in row) == 3
    assert next(iter(rows)) == "2"


def test_the_published_tags(locatk) -> None:
    """The published runs of the default tag read 262143: all orientations 0."""
    told = json.loads(
        locatk("tag", "encode", 262_143, "--codec", "polaris-released", "--json").stdout
    )
    assert told["capacity"] == 262_144
    assert all(magnet["orientation_deg"] == 0 for magnet in told["magnets"])
    # Their layout in mm to the right and forward: (0,0), (40,40), (80,40), (0,80), (80,80).
    places = {
        (round(80 - 2e3 * m["y_m"]) // 2, round(80 + 2e3 * m["x_m"]) // 2) for m in told["magnets"]
    }
    assert places == {(0, 0), (40, 40), (80, 40), (0, 80), (80, 80)}


def test_decode_with_errors(locatk, tmp_path: Path) -> None:
    path = tmp_path / "tag.toml"
    design(locatk, path, "--count", 20, "--min-distance", 4)
    made = read_tags(path)
    assert made.ids is not None
    number = made.ids[7]
    layout = codec.layout_of(made, number)
    degrees = [45.0 * symbol + 7 for symbol in layout.symbols]
    degrees[2] += 33  # one step off
    at = [f"{c},{r}:{turn}" for (c, r), turn in zip(layout.cells, degrees, strict=True)]
    result = locatk("tag", "decode", *at, "--tag", path)
    assert result.exit_code == 0, result.stderr
    assert result.stdout.strip() == str(number)
    assert "1 corrected" in result.stderr
    told = json.loads(locatk("tag", "decode", *at, "--tag", path, "--json").stdout)
    assert (told["id"], told["corrected"], told["refused"]) == (number, 1, "")


def test_decode_refuses_to_guess(locatk) -> None:
    tie = ["0,0:0", "1,1:22.5", "0,2:0", "1,2:90", "2,2:0"]
    result = locatk("tag", "decode", *tie)
    assert result.exit_code == 3
    assert result.stdout == ""
    assert "tie" in result.stderr
    told = json.loads(locatk("tag", "decode", *tie, "--json").stdout)
    assert (told["id"], told["refused"]) == (None, "tie")


@pytest.mark.parametrize("magnet", ["a", "0,0", "0:0", "0,0:x", "0,0:nan", "0,0,0:1"])
def test_decode_requires_magnets(locatk, magnet: str) -> None:
    result = locatk("tag", "decode", magnet)
    assert result.exit_code == 2
    assert "Error" in result.stderr


def test_options_of_the_design_and_a_file_exclude_each_other(locatk, tag: Path) -> None:
    assert locatk("tag", "encode", 5, "--tag", tag).exit_code == 0
    result = locatk("tag", "encode", 5, "--tag", tag, "--order", 4)
    assert result.exit_code == 2
    assert "--order" in result.stderr


def test_encode_warns_of_ids_outside_of_the_family(locatk, tmp_path: Path) -> None:
    path = tmp_path / "tag.toml"
    design(locatk, path, "--id", 5)
    assert "not in the family" in locatk("tag", "encode", 6, "--tag", path).stderr
    assert "not in the family" not in locatk("tag", "encode", 5, "--tag", path).stderr
