"""``locatk info`` of several files: a line each, and the names of those that cannot be read."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest


@pytest.fixture
def folder(locatk: Any, tmp_path: Path) -> Path:
    """Return a folder with sessions 2 and 10 and their solutions, and a scene."""
    folder = tmp_path / "day"
    folder.mkdir()
    for seed in (2, 10):
        run = folder / f"run-{seed}.mcap"
        options = ("--duration", "3", "--robots", "2", "--seed", str(seed))
        assert locatk("simulate", "lighthouse", *options, "-o", run).exit_code == 0
    solution, scene = folder / "solved.mcap", folder / "scene.toml"
    assert locatk("solve", run, "-o", solution, "--save-scene", scene).exit_code == 0
    return folder


def test_a_folder_is_a_table(locatk: Any, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder.parent)
    result = locatk("info", "day")
    assert result.exit_code == 0, result.stderr
    lines = [line.split() for line in result.stdout.splitlines()]
    assert lines[0] == ["file", "kind", "system", "start", "duration", "poses", "devices"]
    day = ["2026-01-01", "00:00"]
    devices = ["robot-1,", "robot-2"]
    assert lines[1] == ["day/run-2.mcap", "session", "lighthouse", *day, "3.0", "s", *devices]
    assert lines[2][:2] == ["day/run-10.mcap", "session"]
    assert lines[3] == ["day/scene.toml", "scene", "lighthouse"]
    assert lines[4][:2] == ["day/solved.mcap", "solution"]
    assert int(lines[4][-3]) > 30


def test_json_has_the_facts_of_each_file(locatk: Any, folder: Path) -> None:
    names = sorted(folder.glob("run*"))
    result = json.loads(locatk("info", *names, "--json").stdout)
    assert [each["file"] for each in result["files"]] == list(map(str, names))
    assert [each["sweeps"] for each in result["files"]] == [
        json.loads(locatk("info", name, "--json").stdout)["sweeps"] for name in names
    ]
    assert result["failures"] == []


def test_files_that_cannot_be_read_are_named(locatk: Any, folder: Path) -> None:
    empty, run = folder / "empty.mcap", folder / "run-2.mcap"
    empty.touch()
    result = locatk("info", run, empty, folder / "nothing.mcap")
    assert result.exit_code == 1
    assert "run-2.mcap" in result.stdout
    assert "empty.mcap was not described: the file is empty" in result.stderr
    assert "nothing.mcap was not described: No such file" in result.stderr
    assert "2 of 3 files could not be described" in result.stderr
    assert "Traceback" not in result.stderr


def test_damaged_files_are_listed(locatk: Any, folder: Path) -> None:
    run = folder / "run-2.mcap"
    cut = folder / "cut.mcap"
    cut.write_bytes(run.read_bytes()[:-9000])
    result = locatk("info", run, cut)
    assert result.exit_code == 3
    assert "cut.mcap is damaged: the file is cut short" in result.stderr
    assert "1 of 2 files are damaged; `locatk recover` saves the rest" in result.stderr
