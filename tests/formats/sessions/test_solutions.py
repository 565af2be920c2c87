"""solution.json: typed results are written under stable keys and read back, old files too."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from locatk.core.dots.results import DotDetection, DotFacts, FrameOutcome
from locatk.core.errors import FormatError
from locatk.core.landmarks.results import LandmarkDetection, LandmarkFacts, RobotFacts
from locatk.core.lighthouse.results import LighthouseFacts, StationDetection
from locatk.core.polaris.results import (
    HeadingCorrection,
    MagnetDetection,
    PlanarPose,
    PolarisFacts,
    TagDetection,
)
from locatk.core.solution import GenericRecord, Solution, SolverWarning
from locatk.core.trajectory import Trajectory
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.solutions import SOLUTION_FILE, read_solution, write_solution
from locatk.formats.sessions.writer import SessionWriter

STATION = StationDetection(0, 1, None, 959000, "generic", sweeps=9518, rejected=3)
FRAME = FrameOutcome(1.5, "7.png", dots=80, corrected_bits=2, confidence=0.9, rejected=None)
DOT = DotDetection(
    1.5, "7.png", 0.1, 0.2, 0.3, confidence=0.9, corrected_bits=2, dots=80,
    grid_x=10.5, grid_y=20.5, sheet="A4-0001",
)  # fmt: skip
MAGNET = MagnetDetection(0.0, 0.01, 0.5, 3, (0, 2), 1e-4, 1e-4, 1e-2, 1e-3)
TAG = TagDetection(
    time_s=1.5, device="bar", tag_id=7, margin=0.9, refused=None, x_m=0.1, y_m=0.2,
    heading_rad=0.3, sigma_x_m=1e-4, sigma_y_m=1e-4, sigma_heading_rad=1e-3,
    array_pose=PlanarPose(-0.1, -0.2, -0.3), magnets=(MAGNET,), residual_sigma=1.0,
    height_m=0.01, speed_mps=None, scale=1.0, corrected=0, erased=1, other_sources=2,
)  # fmt: skip
VISIT = LandmarkDetection(
    time_s=1.5, device="robot", cell=(2, 3), pattern="NNNS", code=13, probability=0.9,
    x_m=0.0, y_m=0.0, heading_rad=0.1, sigma_x_m=1e-4, sigma_y_m=1e-4, sigma_heading_rad=1e-3,
    strength=(1.0, 1.0, 1.0, -1.0), residual_sigma=1.1, refused="",
)  # fmt: skip
ROBOT = RobotFacts(
    localised=True, probability=0.9, landmarks_seen=3, landmarks_to_localise=None, misfit_sigma=1.0
)
CORRECTION = HeadingCorrection("bar", 2.0, 3, 7, 0.5, 0.01, 2.0)
WARNINGS = (SolverWarning("unit_scale", "unit scale"), SolverWarning("spikes", "7 spikes"))

SOLUTIONS = (
    Solution("lighthouse", "bundle", (), {"spike": 2}, (STATION,), None, WARNINGS,
             LighthouseFacts(planar=True, station_residual_rad={"1": 1e-4})),
    Solution("dots", "lattice", (), {}, (DOT,), None, WARNINGS, DotFacts((FRAME,))),
    Solution("polaris", "joint", (), {}, (TAG,), None, (), PolarisFacts((CORRECTION,))),
    Solution("landmarks", "field", (), {}, (VISIT,), None, WARNINGS,
             LandmarkFacts({"robot": ROBOT})),
    Solution("sonar", "ping", (), {}, (GenericRecord({"depth_m": 3.0}),), None, WARNINGS,
             GenericRecord({"pings": [1, 2]})),
    Solution("sonar", "ping", ()),
)  # fmt: skip


def statement(path: Path) -> dict[str, Any]:
    data = Session.open(path).attachment(SOLUTION_FILE)
    assert data is not None
    table: dict[str, Any] = json.loads(data)
    return table


def rewritten(path: Path, table: dict[str, Any]) -> Path:
    """A file of another tool, or of another version, with this statement."""
    with SessionWriter(path, kind="solution", system=table["system"]) as writer:
        writer.attach(SOLUTION_FILE, json.dumps(table).encode(), "application/json")
    return path


@pytest.mark.parametrize("solution", SOLUTIONS, ids=lambda each: each.system)
def test_typed_results_are_restored(tmp_path: Path, solution: Solution) -> None:
    path = tmp_path / "solved.mcap"
    write_solution(path, solution, source="run.mcap")
    assert read_solution(path) == solution


def test_probabilities_of_poses_are_restored(tmp_path: Path) -> None:
    """Devices of unknown probability have none, as have files of earlier versions."""
    time_ns = 1_700_000_000_000_000_000 + 10**7 * np.arange(300)
    unknown = Trajectory.from_positions("b", "map", time_ns, np.zeros((300, 3)))
    probability = np.linspace(0.95, 1.0, 300)
    probability[150] = np.nan
    known = replace(unknown, device="a", probability=probability)
    certain = replace(unknown, device="c", probability=np.full(300, 0.9995))
    path = tmp_path / "solved.mcap"
    solution = Solution("landmarks", "field", (known, unknown, certain))
    write_solution(path, solution, source="run.mcap")
    back = read_solution(path).trajectories
    np.testing.assert_array_equal(back[0].probability, probability)
    assert back[1].probability is None
    assert [each.is_provisional for each in back] == [True, False, False]
    assert back[0].min_probability == 0.95
    assert np.isnan(back[1].min_probability)
    assert Session.open(path).facts["provisional"] == "a"
    write_solution(path, replace(solution, trajectories=back[1:]), source="x", overwrite=True)
    assert "provisional" not in Session.open(path).facts


def test_keys_are_those_of_the_docs(tmp_path: Path) -> None:
    path = tmp_path / "solved.mcap"
    write_solution(path, SOLUTIONS[2], source="run.mcap")
    table = statement(path)
    assert set(table) == {
        "version", "system", "method", "source", "devices", "rejected",
        "notes", "warnings", "facts", "detections",
    }  # fmt: skip
    (tag,) = table["detections"]
    assert tag["array"] == {"x_m": -0.1, "y_m": -0.2, "heading_rad": -0.3}
    assert tag["speed_mps"] is None
    assert tag["magnets"][0]["cell"] == [0, 2]
    (correction,) = table["facts"]["heading_corrections"]
    assert (correction["from"], correction["to"], correction["turn_rad"]) == (3, 7, 0.5)
    write_solution(path, SOLUTIONS[0], source="run.mcap", overwrite=True)
    table = statement(path)
    assert table["notes"] == ["unit scale", "7 spikes"]
    assert table["warnings"][0] == {"code": "unit_scale", "message": "unit scale"}
    assert table["facts"] == {"planar": True, "station_residual_rad": {"1": 1e-4}}
    assert "residual_rad" not in table["detections"][0]


@pytest.mark.parametrize("solution", SOLUTIONS[:5], ids=lambda each: each.system)
def test_files_of_earlier_versions_have_messages_only(tmp_path: Path, solution: Solution) -> None:
    path = tmp_path / "solved.mcap"
    write_solution(path, solution, source="run.mcap")
    table = statement(path)
    del table["warnings"]
    found = read_solution(rewritten(tmp_path / "old.mcap", table))
    assert found.detections == solution.detections
    assert found.facts == solution.facts
    assert found.warnings == tuple(
        SolverWarning("unspecified", each.message) for each in solution.warnings
    )


@pytest.mark.parametrize("solution", SOLUTIONS[:4], ids=lambda each: each.system)
def test_keys_of_later_versions_are_ignored(tmp_path: Path, solution: Solution) -> None:
    path = tmp_path / "solved.mcap"
    write_solution(path, solution, source="run.mcap")
    table = statement(path)
    table["tomorrow"] = table["facts"]["tomorrow"] = table["detections"][0]["tomorrow"] = [1]
    assert read_solution(rewritten(tmp_path / "later.mcap", table)) == solution


@pytest.mark.parametrize("solution", SOLUTIONS[:4], ids=lambda each: each.system)
def test_detections_of_other_tools_are_one_line(tmp_path: Path, solution: Solution) -> None:
    path = tmp_path / "solved.mcap"
    write_solution(path, solution, source="run.mcap")
    wrong_time = {"device": "bar", "time_s": "noon"}
    for k, odd in enumerate(({}, {"a": 1}, {"sweeps": "x", "rejected": []}, wrong_time, 3, None)):
        table = {**statement(path), "detections": [odd]}
        with pytest.raises(FormatError, match="damaged solution") as caught:
            read_solution(rewritten(tmp_path / f"odd{k}.mcap", table))
        assert caught.value.where == SOLUTION_FILE, odd
        assert "\n" not in str(caught.value), odd


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("warnings", [{"code": "unit_scale"}]),
        ("warnings", ["unit scale"]),
        ("warnings", 3),
        ("facts", {"station_residual_rad": [1]}),
        ("facts", {"planar": "yes"}),
        ("facts", [1]),
        ("detections", 3),
    ],
)
def test_other_damage_is_one_line(tmp_path: Path, key: str, value: object) -> None:
    path = tmp_path / "solved.mcap"
    write_solution(path, SOLUTIONS[0], source="run.mcap")
    table = {**statement(path), key: value}
    with pytest.raises(FormatError, match="damaged solution"):
        read_solution(rewritten(tmp_path / "odd.mcap", table))
