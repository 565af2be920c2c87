"""Detections and rejected observations of each system in reports and on the command line."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("plotly")

from locatk.core.dots.results import DotFacts, FrameOutcome
from locatk.core.landmarks.detection.hypotheses import VisitHypotheses
from locatk.core.landmarks.localization.consistency import describe_visit
from locatk.core.lighthouse.results import StationDetection
from locatk.core.polaris.results import MagnetDetection, TagDetection
from locatk.core.solution import GenericRecord, Solution
from locatk.core.trajectory import Trajectory
from locatk.formats.report import detections, rejections
from locatk.formats.report.panels import Panel


def panels(solution: Solution) -> tuple[Panel, Panel]:
    """The panels of detections and of rejected observations."""
    return detections.detection_panel(solution), rejections.rejection_panel(solution)


def path(device: str, poses: int) -> Trajectory:
    return Trajectory.from_positions(
        device, "floor", np.arange(poses) * 10**9, np.zeros((poses, 3))
    )


def station(channel: int, **more: Any) -> StationDetection:
    known: dict[str, Any] = {"id": None, "period_ticks": 959000, "calibration": "generic"}
    return StationDetection(channel - 1, channel, sweeps=90, rejected=6, **(known | more))


LIGHTHOUSE = Solution(
    "lighthouse",
    "bundle",
    (path("robot", 40),),
    {"spike": 8, "moment_inconsistent": 3, "station_contradicts_others": 5, "plane_unknown": 0},
    (station(1), station(2, residual_rad=1.5e-4, id="0a0b0c0d")),
)


def test_fractions_are_of_all_sweeps_or_moments() -> None:
    stations, rejected = panels(LIGHTHOUSE)
    assert stations.table is not None
    assert stations.table.rows[1] == (*("2", "0a0b0c0d", "959000", "generic", "90", "6", "0.150"),)
    assert rejected.table is not None
    rows = {row[0]: row for row in rejected.table.rows}
    assert set(rows) == {"spike", "moment inconsistent", "station contradicts others"}
    assert rows["spike"][1:3] == ("8", "4 % of 200 sweeps")  # 8 of 8 + 2 * (90 + 6)
    assert rows["moment inconsistent"][1:3] == ("3", "6.98 % of 43 moments")
    assert rows["station contradicts others"][2] == "11.6 % of 43 moments"
    assert "2 degrees" in rows["spike"][3]
    assert "10 mrad" in rows["moment inconsistent"][3]
    assert rejected.figure is not None
    bars = json.loads(rejected.figure.to_json())["data"]
    assert {each["name"] for each in bars} == {"sweeps", "moments"}
    assert sorted(n for each in bars for n in each["x"]) == [3, 5, 8]


def test_panels_without_detections_and_rejections_have_a_note() -> None:
    for system in (*rejections.REASONS, "sonar"):
        detected, rejected = panels(Solution(system, "x", ()))
        assert detected.note
        assert rejected.note == "Nothing was rejected."
        assert rejected.figure is None


def test_reasons_of_other_systems_are_shown_without_a_sentence() -> None:
    solution = Solution("sonar", "ping", (path("boat", 2),), {"too_wet": 3, "<b>dry</b>": 1})
    _, rejected = panels(solution)
    assert rejected.table is not None
    assert [row[0] for row in rejected.table.rows] == ["too wet", "<b>dry</b>"]
    assert {row[3] for row in rejected.table.rows} == {""}
    assert rejected.note == "Rejected: 4 observations."
    assert rejected.figure is not None
    assert "<b>" not in rejected.figure.to_json()
    odd = replace(LIGHTHOUSE, rejected={"of_tomorrow": 2})
    assert panels(odd)[1].table.rows == [("of tomorrow", "2", "-", "")]  # type: ignore[union-attr]


def test_frames_are_counted_by_outcome() -> None:
    frames = tuple(
        FrameOutcome(
            time_s=k * 0.1,
            frame=str(k),
            dots=100 + k,
            corrected_bits=k,
            confidence=1.0 if k < 8 else float("nan"),
            rejected=None if k < 8 else "no_grid",
        )
        for k in range(10)
    )
    solution = Solution(
        "dots",
        "lattice",
        (path("camera", 8),),
        {"no_grid": 2},
        frames[:8],
        facts=DotFacts(frames),
    )
    detected, rejected = panels(solution)
    assert detected.table is not None
    assert detected.table.rows == [
        ("decoded", "8", "80.0", "104", "4", "100.00"),
        ("rejected", "2", "20.0", "108", "8", "-"),
    ]
    assert detected.figure is not None
    counted = sum(np.sum(each.y) for each in detected.figure.data if each.xaxis == "x2")
    assert counted == 10
    assert rejected.table is not None
    assert rejected.table.rows[0][2] == "20 % of 10 frames"


TAG = TagDetection(
    time_s=1.0,
    device="bar",
    tag_id=7,
    margin=0.9,
    refused=None,
    x_m=0.0123,
    y_m=None,
    heading_rad=0.1,
    sigma_x_m=float("nan"),
    sigma_y_m=1e-4,
    sigma_heading_rad=1e-3,
    array_pose=None,
    magnets=(MagnetDetection(0.0, 0.0, 0.0, None, None, 1e-4, 1e-4, 1e-2, 1e-3),) * 5,
    residual_sigma=1.0,
    height_m=0.01,
    speed_mps=0.1,
    scale=1.0,
    corrected=0,
    erased=0,
    other_sources=0,
)


def tag(**more: Any) -> TagDetection:
    return replace(TAG, **more)


def test_many_tags_are_listed_in_part() -> None:
    found = (tag(tag_id=None, refused="magnets_missing", margin=None), *(tag() for _ in range(99)))
    detected, rejected = panels(Solution("polaris", "joint", (), {"magnets_missing": 1}, found))
    assert "99 of 100 passes" in detected.note
    assert f"The first {detections.MAX_LISTED} are listed" in detected.note
    assert detected.table is not None
    assert len(detected.table.rows) == detections.MAX_LISTED
    assert detected.table.rows[0][:3] == ("-", "-", "5")
    assert detected.table.rows[0][-1] == "magnets missing"
    assert detected.table.rows[1][3:6] == ("12.30", "-", "5.73 ± 0.057")
    assert detected.figure is not None
    assert rejected.table is not None
    assert rejected.table.rows[0][2] == "1 % of 100 passes"
    few, _ = panels(Solution("polaris", "joint", (), {}, (tag(),)))
    assert few.figure is None


def test_a_refused_visit_of_the_solver_is_listed() -> None:
    told = describe_visit(
        VisitHypotheses("robot", 10**18, 0, 9, np.zeros(3), (), refused="too_weak"), None, None
    )
    detected, rejected = panels(Solution("landmarks", "field", (), {"too_weak": 1}, (told,)))
    assert detected.table is not None
    assert detected.table.rows[0][:4] == ("01:46:40.000", "-", "-", "0.0")
    assert detected.table.rows[0][-1] == "too weak"
    assert "1 visit to landmarks" in detected.note
    assert rejected.table is not None
    assert rejected.table.rows[0][2] == "100 % of 1 visit"


def test_detections_of_unknown_systems_are_counted() -> None:
    records = (GenericRecord({"a": 1}), GenericRecord({"sweeps": "x", "rejected": []}))
    detected, rejected = panels(Solution("sonar", "x", (), {"spike": 1}, records))
    assert detected.note == "2 detections of sonar."
    assert rejected.note


def test_formats_of_tables() -> None:
    assert detections.format_probability(0.99996) == ">99.9"
    assert detections.format_probability(1.0) == "100"
    assert detections.format_probability(None) == detections.format_probability(float("nan")) == "-"
    assert detections.format_cell(None) == ""
    assert detections.format_cell([3, 11]) == "3,11"
    assert detections.format_clock(1e300) == "1e+300 s"
    meant = detections.tag_table([tag(), tag(meaning="stop")])
    assert meant.header[-1] == "meaning"
    assert [row[-1] for row in meant.rows] == ["", "stop"]
    two = detections.tag_table([tag(), tag(device="other")], 1)
    assert two.header[0] == "array"
    assert two.omitted == 1


def test_a_bar_has_its_reason_above_it_and_one_reason_no_figure() -> None:
    counts = {"spike": 7, "moment_jumps": 1200, "plane_unknown": 3}
    panel = panels(Solution("lighthouse", "bundle", (), counts))[1]
    assert panel.figure is not None
    names = {each.text: each.y for each in panel.figure.layout.annotations}
    assert set(names) == {"spike", "moment jumps", "plane unknown"}
    bars = {y: x for bar in panel.figure.data for x, y in zip(bar.x, bar.y, strict=True)}
    assert {name: bars[y] for name, y in names.items()} == {
        "spike": 7,
        "moment jumps": 1200,
        "plane unknown": 3,
    }
    assert "1\u202f200" in panel.note
    assert panel.figure.layout.xaxis.range[1] > 1200
    (only,) = panels(Solution("lighthouse", "bundle", (), {"spike": 7}))[1:]
    assert only.figure is None
    assert only.table.rows[0][:2] == ("spike", "7")
