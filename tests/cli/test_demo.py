"""``locatk demo``: what a newcomer runs first."""

from __future__ import annotations

import json
import math
import re
import shlex
from pathlib import Path
from tempfile import gettempdir

import pytest
from click.testing import Result

SYSTEMS = ("lighthouse", "dots", "polaris", "landmarks")


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Result]:
    """The folder of one whole run with --keep, and what it said."""
    from click.testing import CliRunner

    from locatk.cli.app import app

    folder = tmp_path_factory.mktemp("demo") / "kept files"
    return folder, CliRunner().invoke(app, ["demo", "--keep", str(folder), "--json"])


@pytest.mark.slow
def test_every_system_is_better_than_its_published_algorithm(demo) -> None:
    _, result = demo
    assert result.exit_code == 0, result.stderr
    rows = {row["system"]: row for row in json.loads(result.stdout)["systems"]}
    limits = {"lighthouse": 0.005, "dots": 5e-6, "polaris": 2e-3, "landmarks": 3e-3}
    assert tuple(rows) == SYSTEMS
    for system, mae_m in limits.items():
        row = rows[system]
        assert row["poses"] >= 100  # of the dots, all frames
        assert row["mae_m"] < mae_m
        # Where tags or landmarks were not read, the published algorithm has no poses.
        assert row["paper_mae_m"] is not None or system in ("polaris", "landmarks")
        assert row["mae_m"] < (row["paper_mae_m"] or math.inf)


@pytest.mark.slow
def test_keep_retains_the_named_folder(demo) -> None:
    folder, result = demo
    answer = json.loads(result.stdout)
    named = {answer["report"], *(entry["path"] for entry in answer["files"])}
    assert named == {str(path) for path in folder.iterdir()}
    starts = {".png": b"\x89PNG", ".pdf": b"%PDF", ".mcap": b"\x89MCAP", ".html": b"<!doctype html"}
    for path in map(Path, named):
        assert path.read_bytes()[:14].lower().startswith(starts[path.suffix].lower())


@pytest.mark.slow
def test_the_suggested_commands_work(demo, locatk, tmp_path: Path, monkeypatch) -> None:
    _, result = demo
    monkeypatch.chdir(tmp_path)
    commands = [
        shlex.split(entry["next"])[1:]
        for entry in json.loads(result.stdout)["files"]
        if entry["next"].startswith("locatk ")
    ]
    assert len(commands) == 3 * len(SYSTEMS)
    for words in commands:
        done = locatk(*words)
        assert done.exit_code == 0, (words, done.stderr)


@pytest.mark.slow
def test_the_report_covers_all_systems(demo) -> None:
    folder, _ = demo
    text = (folder / "report.html").read_text(encoding="utf-8")
    for system in SYSTEMS:
        assert f"{system}-solved.mcap" in text


@pytest.mark.slow
def test_nothing_is_replaced_unasked(demo, locatk) -> None:
    folder, _ = demo
    before = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    result = locatk("demo", "--keep", folder)
    assert result.exit_code == 1
    assert "--overwrite" in result.stderr
    assert {path: path.stat().st_mtime_ns for path in folder.iterdir()} == before


@pytest.mark.slow
def test_alone_it_leaves_the_report_only(locatk, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    temporary = set(Path(gettempdir()).glob("locatk-demo-*"))
    result = locatk("demo", "polaris")
    assert result.exit_code == 0, result.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]
    assert set(Path(gettempdir()).glob("locatk-demo-*")) == temporary
    header, row, wrote = result.stdout.splitlines()
    assert header.split()[:2] == ["system", "poses"]
    assert row.split()[0] == "polaris"
    assert re.fullmatch(r"Wrote report.html in \d+ s: open it in a browser", wrote)
    assert len(header) <= 80
    # The second run is refused before any work.
    monkeypatch.setattr("locatk.cli.demo.command.run_system", None)
    again = locatk("demo", "polaris")
    assert again.exit_code == 1
    assert "report.html" in again.stderr


def test_a_refusal_leaves_no_folder(locatk, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("locatk.cli.demo.command.run_system", None)
    report = tmp_path / "mine.html"
    report.write_text("mine")
    result = locatk("demo", "--keep", tmp_path / "kept", "-o", report)
    assert result.exit_code == 1
    assert "mine.html" in result.stderr
    assert not (tmp_path / "kept").exists()


def test_a_wrong_name_is_refused(locatk) -> None:
    assert locatk("demo", "magnets").exit_code == 2
