"""Progress of `locatk solve` while one long session is solved."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest

from locatk.cli import console
from locatk.core import progress
from locatk.formats import pipeline


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What is written to a terminal; the progress is shown every millisecond."""
    written: list[str] = []
    monkeypatch.setattr(console, "_shows_progress", lambda: True)
    monkeypatch.setattr(console, "PROGRESS_INTERVAL_S", 1e-3)
    monkeypatch.setattr(console, "control", written.append)
    return written


def _wait_for(text: str, written: list[str]) -> None:
    until = time.monotonic() + 10
    while text not in "".join(written):
        assert time.monotonic() < until, written
        time.sleep(1e-3)


def test_a_terminal_shows_elapsed_time_and_progress(terminal: list[str]) -> None:
    with console.working("Solving") as add:
        _wait_for(" s", terminal)
        add("frames", 30, 120)
        _wait_for(" s, 25 % of 120 frames", terminal)
        add("frames", 120, 120)
        terminal.clear()
        _wait_for(" s\r", terminal)
    count = len(terminal)
    assert terminal[-1].endswith("\x1b[K")  # The line is erased,
    time.sleep(0.01)
    assert len(terminal) == count  # and nothing follows.


def test_the_line_is_erased_after_an_error(terminal: list[str]) -> None:
    with pytest.raises(ZeroDivisionError), console.working("Solving"):
        _ = 1 / 0
    assert terminal[-1].endswith("\x1b[K")


@pytest.mark.slow
@pytest.mark.parametrize(("system", "items"), [("dots", "frames"), ("polaris", "passes")])
def test_solvers_report_their_progress(
    locatk: Any, tmp_path: Path, system: str, items: str
) -> None:
    locatk("simulate", system, "-o", tmp_path / "run.mcap")
    reports: list[tuple[str, int, int]] = []
    with progress.observed(lambda *report: reports.append(report)):
        pipeline.solve_file(tmp_path / "run.mcap", tmp_path / "out.mcap")
    assert {name for name, _, _ in reports} == {items}
    done = [number for _, number, _ in reports]
    assert done == sorted(done)
    assert reports[-1][1] == reports[-1][2] > 0


@pytest.mark.slow
def test_nothing_is_shown_without_a_terminal(locatk: Any, tmp_path: Path) -> None:
    locatk("simulate", "polaris", "-o", tmp_path / "run.mcap")
    result = locatk("solve", tmp_path / "run.mcap", "-o", tmp_path / "out.mcap")
    assert "Solving" not in result.stderr
