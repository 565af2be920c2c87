"""Text of the commands: lines of 80 columns, sections of options, suggestions for typos."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner, Result

from locatk.cli import console
from locatk.cli.app import app

Run = Callable[..., Result]


def run(*args: object) -> Result:
    return CliRunner().invoke(app, [str(arg) for arg in args], prog_name="locatk")


def too_wide(text: str) -> list[str]:
    return [line for line in text.splitlines() if len(line) > console.TEXT_COLUMNS]


DRIVE = "t_s,x_mm,y_mm,heading_deg,front_mt,left_mt,rear_mt,right_mt\n" + "".join(
    f"{0.01 * row:.2f},{row},0,0,0.1,0.2,0.1,0.3\n" for row in range(20)
)
"""Recording of a robot over landmarks."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A working folder with one short session of each system, so that paths are short."""
    path, before = tmp_path_factory.mktemp("text"), Path.cwd()
    os.chdir(path)
    try:
        assert run("map", "design", "4x4", "-o", "map.toml").exit_code == 0
        assert run("tag", "design", "--id", 77, "-o", "tag.toml").exit_code == 0
        for system, options in (
            ("lighthouse", ("--duration", 3, "--robots", 2)),
            ("dots", ("--frames", 3)),
            ("polaris", ()),
            ("landmarks", ("map.toml", "--landmarks", 3)),
        ):
            simulated = run("simulate", system, "-o", f"{system}.mcap", *options)
            assert simulated.exit_code == 0, simulated.stderr
            solved = run("solve", f"{system}.mcap", "-o", "solved.mcap")
            assert solved.exit_code in (0, 3), solved.stderr
            Path("solved.mcap").rename(f"{system}-solved.mcap")
            assert too_wide(simulated.stdout + solved.stdout) == []
        design = Path("map.toml").read_text()
        row = re.search(r'\n +("[0-9a-f]{4}"),', design)
        assert row is not None
        Path("double.toml").write_text(re.sub(r'"[0-9a-f]{4}"', row[1], design))
        Path("drive.csv").write_text(DRIVE)
        for name in ("frame1.png", "frame2.png"):
            cv2.imwrite(name, np.full((60, 80), 200, np.uint8))
        Path("broken.png").write_bytes(Path("frame1.png").read_bytes()[:40])
        Path("x").mkdir()
        Path("empty.toml").touch()
        Path("picture.mcap").write_bytes(Path("frame1.png").read_bytes())
        yield path
    finally:
        os.chdir(before)


SYSTEMS = ("lighthouse", "dots", "polaris", "landmarks")


@pytest.mark.slow
@pytest.mark.parametrize(
    "command",
    [
        *(f"info {system}.mcap -v" for system in SYSTEMS),
        *(f"info {system}-solved.mcap" for system in SYSTEMS),
        *(f"eval {system}-solved.mcap --truth {system}.mcap" for system in SYSTEMS),
        *(f"eval {system}-solved.mcap --truth {system}.mcap --full" for system in SYSTEMS),
        *(f"export {system}-solved.mcap --format tum -o poses-{system}" for system in SYSTEMS),
        "info map.toml",
        "calibrate scene lighthouse.mcap -o scene.toml --overwrite",
        "calibrate camera dots.mcap -o camera.toml --overwrite",
        "calibrate tag polaris.mcap polaris.mcap -o built-tag.toml --overwrite",
        "calibrate map landmarks.mcap -o built.toml --overwrite",
        "report dots-solved.mcap -o dots.html --overwrite",
        "decode polaris.mcap -o decoded.mcap --overwrite",
        "recover polaris.mcap -o recovered.mcap --overwrite",
        "map check map.toml",
        "map design 7x7 --alphabet 6 -o small.toml",
        "map export map.toml -o map.csv --overwrite",
        "tag encode 262143",
        "print tag tag.toml --id 77 -o tag.pdf --overwrite",
        "print pattern -o sheet.pdf --overwrite",
        "print testsheet -o test.pdf --overwrite",
        "print landmarks map.toml -o pack.pdf --overwrite",
        "print landmarks map.toml -o floor.pdf --floor --paper A1 --overwrite",
        "capture --list",
        "tag design -o tags.toml --count 20 --min-distance 2 --bom parts.csv --overwrite",
        "tag design -o mini.toml --order 2 --magnets 3 --clearance 4 --overwrite",
        "tag check tag.toml",
        "tag check tag.toml --sensors 3 --speed 3",
        "tag decode 0,0:0 1,1:45 0,2:0 1,2:90 2,2:0",
        "map design 5x5 --alphabet compass -o compass.toml --overwrite",
        "map design --landmark",
        "map check map.toml double.toml",
        "map import map.csv -o imported.toml --overwrite",
        "simulate landmarks map.toml --landmarks 14 --rate 50 --stop 0 -o new.mcap --overwrite",
        "import landmark-csv drive.csv --map map.toml -o imported.mcap --overwrite",
        "import images frame1.png frame2.png broken.png -o imported.mcap --overwrite",
    ],
)
def test_results_fit_80_columns(folder: Path, command: str) -> None:
    result = run(*command.split())
    assert result.exit_code != 2, result.stderr
    assert "internal error" not in result.stderr
    assert too_wide(result.stdout) == []


@pytest.mark.parametrize("name", ["solve", "sovle", "evla", "calibarte", "simulat"])
def test_a_typo_of_a_command_gets_a_suggestion(name: str) -> None:
    result = run(name, "run.mcap")
    meant = {"sovle": "solve", "evla": "eval", "calibarte": "calibrate", "simulat": "simulate"}
    if name in meant:
        assert result.exit_code == 2
        assert f"No such command {name!r}. Did you mean {meant[name]!r}" in result.stderr
        assert result.stderr.count("\n") == 1
    else:
        assert "Did you mean" not in result.stderr


@pytest.mark.parametrize(
    "args", [("calibrate", "printr"), ("simulate", "polris"), ("map", "chek"), ("print", "patern")]
)
def test_a_typo_of_a_subcommand_gets_a_suggestion(args: tuple[str, str]) -> None:
    result = run(*args)
    assert result.exit_code == 2
    assert "Did you mean" in result.stderr


def test_a_name_like_no_other_gets_no_suggestion() -> None:
    result = run("xyzzy")
    assert result.stderr == "Error: No such command 'xyzzy'. Hint: See `locatk --help`.\n"


def test_options_of_a_command_are_in_sections() -> None:
    text = run("solve", "--help").stdout
    titles = [line for line in text.splitlines() if line.endswith(":") and line[0] != " "]
    assert titles == ["Options:", "Input:", "Output:", "Batch:", "General:"]
    general = text[text.index("General:") :]
    assert all(option in general for option in ("--json", "--quiet", "--verbose", "--help"))


WRONG_CALLS = [
    "slove run.mcap",
    "simulate lighthous -o x.mcap",
    "solve lighthouse.mcap --artefact map.toml",
    "solve missing.mcap -o x.mcap",
    "solve x -o x.mcap",
    "solve picture.mcap -o x.mcap",
    "solve map.toml -o x.mcap",
    "solve lighthouse.mcap -o nowhere/x.mcap",
    "solve lighthouse.mcap -o lighthouse-solved.mcap",
    "solve lighthouse.mcap -o lighthouse.mcap --overwrite",
    "solve lighthouse.mcap -o x.mcap --artifact lighthouse.mcap",
    "solve lighthouse.mcap -o x.mcap --artifact map.toml",
    "solve lighthouse.mcap -o x.mcap --artifact empty.toml",
    "eval lighthouse-solved.mcap --truth frame1.png",
    "eval x --truth lighthouse.mcap",
    "report lighthouse.mcap -o x.html",
    "report x -o x.html",
    "export lighthouse-solved.mcap --format csv -o x",
    "export map.toml --format crazyflie-config -o x.yaml",
    "info x",
    "info frame1.png",
    "info empty.toml",
    "import saleae frame1.png -o x.mcap",
    "import libsurvive x -o x.mcap",
    "import video x -o x.mcap",
    "import images map.toml -o x.mcap",
    "import images frame1.png --sheet tag.toml -o x.mcap",
    "import landmark-csv frame1.png --circle 25 -o x.mcap",
    "decode lighthouse.mcap -o x.mcap",
    "recover frame1.png -o x.mcap",
    "capture replay:missing.mcap -o x.mcap",
    "capture map.toml -o x.mcap",
    "capture camera:map.toml -o x.mcap",
    "emulate polars",
    "simulate landmarks tag.toml -o x.mcap",
    "simulate landmarks map.toml -o x.mcap --strategy pass --cell 99,99",
    "simulate landmarks map.toml -o x.mcap --strategy path --path frame1.png",
    "simulate dots -o x.mcap --config map.toml",
    "calibrate scene polaris.mcap -o x.toml",
    "calibrate camera lighthouse.mcap -o x.toml",
    "calibrate tag lighthouse.mcap -o x.toml",
    "calibrate map x -o x.toml",
    "calibrate printer frame1.png --manifest map.toml --overwrite",
    "print pattern -o x.pdf --overlay frame1.png",
    "print pattern -o x.pdf --section 70,2",
    "print tag map.toml -o x.pdf",
    "print landmarks tag.toml -o x",
    "print testsheet -o map.toml",
    "tag design -o x.toml --spacing -3",
    "tag check x",
    "tag encode 5 --tag map.toml",
    "map check tag.toml",
    "map import frame1.png --format csv -o x.toml",
    "bench dots --data map.toml",
    "demo dots -o nowhere/x.html",
    "demo dots --keep map.toml",
]


@pytest.mark.slow
@pytest.mark.parametrize("command", WRONG_CALLS)
def test_a_wrong_call_gives_one_line_with_a_hint(folder: Path, command: str) -> None:
    before = sorted(folder.rglob("*"))
    result = run(*command.split())
    assert result.exit_code in (1, 2)
    assert result.stdout == ""
    assert result.stderr.count("\n") == 1
    assert "Hint: " in result.stderr
    assert "internal error" not in result.stderr
    assert sorted(folder.rglob("*")) == before


LONG = "a text of many words " * 6


def test_titles_of_a_wide_table_are_wrapped() -> None:
    header = ("device", *(f"sigma of quantity {number} [mm]" for number in range(5)))
    lines = console.table(header, [("red", *(["1.5"] * 5))]).splitlines()
    assert max(map(len, lines)) <= 80
    assert len(lines) > 2
    assert lines[-1].split() == ["red", *(["1.5"] * 5)]


def test_the_last_text_of_a_wide_table_is_wrapped() -> None:
    text = console.table(("name", "n", "remark"), [("red", 1, LONG), ("blue", 2, "short")])
    assert too_wide(text) == []
    assert " ".join(text.split()).count("many words") == 6
    assert text.splitlines()[-1] == "blue  2  short"


def test_columns_of_a_very_wide_table_continue_below() -> None:
    header = ("name", *(f"column{number}" for number in range(20)))
    text = console.table(header, [("red", *range(100, 120)), ("blue", *range(120, 140))])
    assert too_wide(text) == []
    blocks = text.split("\n\n")
    assert len(blocks) > 1
    assert all(block.split()[0] == "name" for block in blocks)
    values = [word for block in blocks for word in block.splitlines()[1].split()[1:]]
    assert values == [str(number) for number in range(100, 120)]


def test_long_values_of_labels_are_wrapped() -> None:
    text = console.labelled([("size:", "3 MB"), ("note:", LONG)], indent=2)
    assert too_wide(text) == []
    assert text.splitlines()[0] == "  size:  3 MB"
    assert text.splitlines()[2].startswith("         ")


def test_a_path_is_never_broken() -> None:
    path = "/folder" * 20 + "/run.mcap"
    assert path in console.labelled([("file:", path)])
    assert path in console.wrapped(f"wrote {path} and more")
