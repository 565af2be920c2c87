"""`locatk room design` and `locatk room check` as a user runs them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from locatk.cli import console
from locatk.core.lighthouse.design import mounts, placement, report
from locatk.formats.artifacts.scene import read_scene


@pytest.fixture(scope="module", autouse=True)
def _short_search() -> Iterator[None]:
    """Compare few candidates: the search has tests of its own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mounts, "WALL_POSITIONS", 8)
        patch.setattr(mounts, "CEILING_POSITIONS", 4)
        patch.setattr(placement, "SEARCH_POINTS", 80)
        patch.setattr(placement, "REFINEMENT_POINTS", 200)
        patch.setattr(placement, "SEARCH_BUDGET", 1)
        patch.setattr(placement, "MAX_EVALUATIONS_PER_STAGE", 4)
        patch.setattr(report, "REPORT_POINTS", 500)
        patch.setattr(report, "COMPARED_ADDITIONS", 4)
        yield


@pytest.fixture
def designed(locatk, tmp_path: Path) -> Path:
    path = tmp_path / "room.toml"
    result = locatk("room", "design", "5x4x2.8", "--stations", 2, "--floor", 50, "-o", path)
    assert result.exit_code == 0, result.stderr
    return path


def test_a_design_is_a_scene_that_check_judges_alike(locatk, designed: Path) -> None:
    scene = read_scene(designed)
    assert scene.frame_source == "design"
    assert scene.planar
    assert scene.floor_z == 0.05
    assert scene.room is not None
    assert scene.room.outline_m.max() == 5.0
    designed_again = json.loads(
        locatk("room", "design", designed, "--stations", 2, "-o", designed.with_name("again.toml"),
               "--json").stdout
    )  # fmt: skip
    checked = json.loads(locatk("room", "check", designed, "--json").stdout)
    assert checked["version"] == designed_again["version"] == 1
    # The same room gives the same stations and figures.
    assert checked["stations"][0]["position_m"] == designed_again["stations"][0]["position_m"]
    assert checked["report"]["p95_sigma_m"] == pytest.approx(
        designed_again["report"]["p95_sigma_m"]
    )
    assert designed_again["materials"][0]["part"] == "base station"
    assert designed_again["materials"][0]["sum"] == 400.0
    assert designed_again["materials_total"]["currency"] == "USD"


def test_json_is_valid_where_figures_are_infinite(locatk, tmp_path: Path) -> None:
    path = tmp_path / "room.toml"
    result = locatk(
        "room", "design", "5x4x2.8", "--stations", 1, "--volume", "0-1500", "-o", path, "--json"
    )
    assert result.exit_code == 3
    entry = json.loads(result.stdout, parse_constant=lambda name: pytest.fail(name))
    assert entry["report"]["p95_sigma_m"] is None
    assert entry["warnings"]
    assert path.exists()


def test_wishes_that_cannot_be_fulfilled_are_answered(locatk, tmp_path: Path) -> None:
    path = tmp_path / "room.toml"
    result = locatk("room", "design", "5x4x2.8", "--stations", 2, "--accuracy", 0.01, "-o", path)
    assert result.exit_code == 3
    assert "0.01 mm are not reached with 2 stations" in result.stderr
    checked = locatk("room", "check", path, "--accuracy", 0.01)
    assert checked.exit_code == 3
    assert "not reached" in checked.stderr


def test_text_names_places_and_fits_the_terminal(locatk, designed: Path) -> None:
    result = locatk("room", "check", designed, "--device", "deck")
    for text in ("covered", "worst places", "best addition", "heading", "channel"):
        assert text in result.stdout
    assert max(map(len, result.stdout.splitlines())) <= console.TEXT_COLUMNS


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        (["10"], 2, "in metres as in 10x8x3"),
        (["10x8"], 2, "no height"),
        (["10x8x3", "--height", "3000"], 2, "repeats the height"),
        (["10x8x3000"], 1, "metres"),
        (["10x-8x3"], 2, "in metres"),
        (["nix.toml"], 1, "no such file"),
        (["nix.dxf"], 2, "no ceiling"),
        (["nix.svg", "--height", "3000"], 1, "nix.svg"),
        (["4x4x3", "--layer", "WALLS"], 2, "drawing"),
        (["4x4x3", "--floor", "10", "--volume", "0-9"], 2, "one of them"),
        (["4x4x3", "--volume", "0-4000"], 1, "photodiodes from 0 to 4 m"),
        (["4x4x3", "--volume", "9"], 2, "Z1-Z2"),
        (["4x4x3", "--obstacle", "1,2,3"], 2, "X,Y:LxWxH"),
        (["4x4x3", "--obstacle", "0,0:1x0x5"], 1, "same position"),
        (["4x4x3", "--area", "9000,0:100x100"], 1, "x 0 to 4000, y 0 to 4000 mm"),
        (["4x4x3", "--area", "1000,0:4000x1000"], 1, "--area is outside the room"),
        (["4x4x3", "--area", "1,1:2x2"], 1, "sizes are in mm"),
        (["4x4x3", "--volume", "0-1.5"], 1, "Heights are in mm"),
        (["4x4x3", "--obstacle", "5000,0:100x100x9"], 1, "--obstacle is outside the room"),
        (["4x4x3", "--tripod", "5000,0,2000"], 1, "--tripod is outside the room"),
        (["4x4x3", "--tripod", "1000,1000,20000"], 1, "below the ceiling"),
        (["4x4x3", "--mount", "roof"], 2, "roof"),
        (["4x4x3", "--mount", "tripod"], 1, "positions of tripods"),
        (["4x4x3", "--robot-size", "60x80"], 2, "--robots"),
        (["4x4x3", "--stations", "17"], 2, "1<=x<=16"),
        (["4x4x3", "--field-of-view", "150x130"], 1, "field of view"),
    ],
)
def test_bad_input_is_one_line(
    locatk, tmp_path: Path, arguments: list[str], status: int, message: str
) -> None:
    result = locatk("room", "design", *arguments, "-o", tmp_path / "room.toml")
    assert result.exit_code == status, result.stderr
    assert message in result.stderr
    assert "Traceback" not in result.stderr
    assert not (tmp_path / "room.toml").exists()


def test_outputs_are_not_overwritten(locatk, designed: Path, tmp_path: Path) -> None:
    for option in ("-o", "--maps", "--sheet"):
        existing = tmp_path / {"-o": "a.toml", "--maps": "a.png", "--sheet": "a.pdf"}[option]
        existing.write_text("mine")
        more = [] if option == "-o" else ["-o", tmp_path / "new.toml"]
        result = locatk("room", "design", "5x4x2.8", option, existing, *more)
        assert result.exit_code == 1
        assert existing.read_text() == "mine"
    assert locatk("room", "design", designed, "-o", designed, "--overwrite").exit_code == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--sheet", "s.pdf", "--paper", "A9"], "no paper 'A9'"),
        (["--sheet", "s.pdf", "--paper", "10x10mm"], "too little"),
        (["--sheet", "s.pdf", "--maps", "s.pdf"], "the same file"),
    ],
)
def test_nothing_is_written_before_all_outputs_are_possible(
    locatk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    result = locatk("room", "design", "3x3x2.5", "--stations", 1, "-o", "r.toml", *arguments)
    assert result.exit_code in (1, 2)
    assert message in result.stderr
    assert not list(tmp_path.iterdir())


def test_prices_are_not_overwritten(locatk, tmp_path: Path) -> None:
    prices = tmp_path / "prices.toml"
    prices.write_text(locatk("room", "design", "--print-prices").stdout)
    text = prices.read_text()
    arguments = "--stations", 1, "--prices", prices, "-o", prices, "--overwrite"
    result = locatk("room", "design", "3x3x2.5", *arguments)
    assert result.exit_code == 1
    assert "one of the inputs" in result.stderr
    assert prices.read_text() == text


def test_check_takes_a_room_for_a_scene_without_one(locatk, designed: Path) -> None:
    bare = designed.with_name("bare.toml")
    bare.write_text(designed.read_text().split("[room]")[0])
    assert "--room" in locatk("room", "check", bare).stdout
    larger = json.loads(
        locatk("room", "check", bare, "--room", "20x4x2.8", "--floor", 50, "--json").stdout
    )
    own = json.loads(locatk("room", "check", designed, "--json").stdout)
    assert larger["report"]["covered_fraction"] < own["report"]["covered_fraction"]
    assert locatk("room", "check", designed, "--height", 3000).exit_code == 2


@pytest.mark.slow
@pytest.mark.parametrize("ending", ["png", "svg", "pdf"])
def test_maps_and_sheet_are_written_the_same_twice(locatk, tmp_path: Path, ending: str) -> None:
    written = []
    for name in ("first", "second"):
        folder = tmp_path / name
        folder.mkdir()
        maps, sheet = folder / f"room.{ending}", folder / "sheet.pdf"
        result = locatk(
            "room", "design", "5x4x2.8", "--stations", 2, "--volume", "0-1200", "--obstacle",
            "1000,1000:500x500x1000", "-o", folder / "room.toml", "--maps", maps, "--sheet",
            sheet,
        )  # fmt: skip
        assert result.exit_code in (0, 3), result.stderr
        written.append((maps.read_bytes(), sheet.read_bytes()))
    assert written[0] == written[1]
    assert written[0][0][:4] in (b"\x89PNG", b"<?xm", b"%PDF")


def test_a_floor_plan_is_a_room(locatk, tmp_path: Path) -> None:
    plan = tmp_path / "plan.svg"
    plan.write_text(
        '<svg xmlns="http://www.w3.org/2000/svg" width="50mm" viewBox="0 0 50 40">'
        '<rect width="50" height="40"/><rect x="10" y="10" width="5" height="5"/></svg>'
    )
    path = tmp_path / "room.toml"
    result = locatk(
        "room", "design", plan, "--scale", 100, "--height", 2800, "--obstacle-height", 900,
        "--stations", 2, "-o", path,
    )  # fmt: skip
    assert result.exit_code in (0, 3), result.stderr
    room = read_scene(path).room
    assert room is not None
    assert room.outline_m.max(axis=0).tolist() == [5.0, 4.0]
    assert room.obstacles[0].high_m == 0.9


def test_the_bill_has_the_prices_that_are_given(locatk, tmp_path: Path) -> None:
    prices, bill = tmp_path / "prices.toml", tmp_path / "parts.csv"
    prices.write_text(
        locatk("room", "design", "--print-prices").stdout.replace("price = 200.0", "price = 150.0")
    )
    result = locatk(
        "room", "design", "5x4x2.8", "--stations", 2, "--floor", 50, "--robots", 3, "--prices",
        prices, "--bom", bill, "-o", tmp_path / "room.toml",
    )  # fmt: skip
    assert result.exit_code == 0, result.stderr
    rows = [line.split(",") for line in bill.read_text().splitlines()]
    assert rows[1][:2] == ["base station", "2"]
    assert "300.0" in rows[1]
    assert ["photodiode", "3"] in [row[:2] for row in rows]
    assert "Total 310.50 USD" in result.stdout
