"""Provisional poses: what the commands say of a solution whose poses may be of another position."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from locatk.cli.solve import text as solve_text
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.landmarks.results import LandmarkFacts, RobotFacts
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory
from locatk.formats.pipeline.outcome import summarize
from locatk.formats.sessions.solutions import write_solution

TIME_NS = 1_700_000_000_000_000_000 + 10**8 * np.arange(50)


def solution(probability: float | None) -> Solution:
    track = Trajectory.from_positions(
        "robot", "map", TIME_NS, np.zeros((50, 3)), np.tile(1e-6 * np.eye(3), (50, 1, 1))
    )
    if probability is not None:
        track = replace(track, probability=np.linspace(probability, 1.0, 50))
    provisional = probability is not None and probability < 0.999
    facts = RobotFacts(
        localised=True, provisional=provisional, probability=probability, landmarks_seen=3
    )
    codes = np.zeros((4, 4), int)
    return Solution(
        "landmarks", "field", (track,), artifact=FloorMap(codes),
        facts=LandmarkFacts({"robot": facts}),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("probability", "shown"), [(0.97, "97.0"), (0.9999, ">99.9"), (None, None)]
)
def test_text_and_json_of_solve(probability: float | None, shown: str | None) -> None:
    report = summarize("drive.mcap", "solved.mcap", solution(probability))
    table = [line.split() for line in solve_text.text(report).splitlines()]
    (row,) = (cells for cells in table if cells and cells[0] == "robot")
    assert (row[-1] == shown) if shown else (row[-1] == "-")
    assert ("probability [%]" in solve_text.text(report)) == (shown is not None)
    entry = json.loads(json.dumps(solve_text.json_entry(report)))
    is_provisional = probability == 0.97
    assert entry["facts"]["robots"]["robot"]["provisional"] == is_provisional
    losses = {loss.code: loss.message for loss in report.losses}
    assert ("provisional" in losses) == is_provisional
    assert "0.97" in losses.get("provisional", "0.97")


@pytest.mark.slow
@pytest.mark.parametrize("probability", [0.97, 0.9995, None])
def test_info_and_report(locatk, tmp_path: Path, probability: float | None) -> None:
    path, page = tmp_path / "solved.mcap", tmp_path / "report.html"
    write_solution(path, solution(probability), source="drive.mcap")
    info = locatk("info", path)
    assert info.exit_code == 0
    assert ("provisional: robot" in " ".join(info.stdout.split())) == (probability == 0.97)
    assert locatk("report", path, "-o", page).exit_code in (0, 3)
    said = "The poses of robot are provisional: the least certain one is right with a probability"
    text = page.read_text()
    assert (f"{said} of 97.0 %." in text) == (probability == 0.97)
