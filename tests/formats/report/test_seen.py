"""What was seen and rejected, in reports: every reason of core has a sentence."""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
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
from locatk.formats.report import detection_tables as seen_text
from locatk.formats.report import detections as seen
from locatk.formats.report import rejection_reasons as seen_reasons

ROOT = Path(__file__).resolve().parents[3]

ARGUMENTS = {
    "reject": 0,
    "_add_rejected": 1,
    "keep": 1,
    "select_stations": 2,
    "_refusal": 2,
    "_answer": 2,
    "TagObservation": 3,
}
"""Calls in core that give a reason, and which of their arguments it is."""

NAMES = {"refused", "rejected", "reason", "why"}
"""What variables, fields and keys are called that hold one."""

RETURNING = {"_fit_reason", "_missing_reason", "_misplaced"}
"""Functions that answer with one."""


def reasons(system: str) -> set[str]:
    """Every reason that the sources of a system can give."""
    found: set[str] = set()
    for path in sorted((ROOT / "core" / system).rglob("*.py")):
        # Demodulation counts bursts, which are no observations of a solution.
        is_of_solver = path.parent.name not in ("demodulation", "simulation")
        if is_of_solver and path.name not in ("study.py", "camera_views.py"):
            tree = ast.parse(path.read_text())
            constants = {
                target.id: node.value.value
                for node in tree.body
                if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant)
                for target in node.targets
                if isinstance(target, ast.Name)
            }
            for value in _given(tree):
                found |= _texts(value, constants)
    return {text for text in found if re.fullmatch(r"[a-z]+(_[a-z]+)*", text)}


def _given(tree: ast.AST) -> Iterator[ast.AST]:
    """Expressions that may be a reason."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            if name in ARGUMENTS and len(node.args) > ARGUMENTS[name]:
                yield node.args[ARGUMENTS[name]]
            yield from (each.value for each in node.keywords if each.arg in NAMES)
        elif isinstance(node, ast.Assign):
            targets = [
                each
                for target in node.targets
                for each in (target.elts if isinstance(target, ast.Tuple) else [target])
            ]
            if any(_holds(target) for target in targets):
                yield node.value
            yield from (
                target.slice
                for target in targets
                if isinstance(target, ast.Subscript) and _holds(target.value)
            )
        elif isinstance(node, ast.AugAssign) and _holds(node.target):
            assert isinstance(node.target, ast.Subscript)
            yield node.target.slice
        elif isinstance(node, ast.FunctionDef) and node.name in RETURNING:
            yield from (each.value for each in ast.walk(node) if isinstance(each, ast.Return))


def _holds(target: ast.AST) -> bool:
    if isinstance(target, ast.Subscript):
        key = target.slice
        named = isinstance(key, ast.Constant) and key.value in NAMES
        return named or _holds(target.value)
    return getattr(target, "attr", getattr(target, "id", None)) in NAMES


def _texts(value: ast.AST | None, constants: dict[str, Any]) -> set[str]:
    """Texts that an expression may be."""
    if isinstance(value, ast.Constant):
        return {value.value} if isinstance(value.value, str) else set()
    if isinstance(value, ast.Name):
        known = constants.get(value.id)
        return {known} if isinstance(known, str) else set()
    if isinstance(value, ast.IfExp):
        return _texts(value.body, constants) | _texts(value.orelse, constants)
    if isinstance(value, ast.Dict):
        return set().union(*(_texts(key, constants) for key in value.keys))
    if isinstance(value, ast.Tuple):
        return set().union(*(_texts(each, constants) for each in value.elts))
    return set()


@pytest.mark.slow
@pytest.mark.parametrize("system", list(seen_reasons.SYSTEMS))
def test_every_reason_of_core_has_a_sentence_and_no_other_has(system: str) -> None:
    given, known = reasons(system), set(seen_reasons.SYSTEMS[system]())
    assert len(given) > 5
    assert given - known == set()
    assert known - given == set()


@pytest.mark.parametrize("system", list(seen_reasons.SYSTEMS))
def test_sentences_are_sentences(system: str) -> None:
    for reason, told in seen_reasons.SYSTEMS[system]().items():
        assert told.sentence[0].isupper(), reason
        assert told.sentence.endswith("."), reason
        assert "  " not in told.sentence
        assert "nan" not in told.sentence
        assert told.unit in ("sweeps", "moments", "frames", "passes", "visits")


@pytest.mark.parametrize("system", list(seen_reasons.SYSTEMS))
def test_reasons_are_those_of_the_docs(system: str) -> None:
    docs = (ROOT / "docs" / f"{system}.md").read_text()
    published = {"no_dots", "no_window", "no_orientation"}  # of --method paper
    for reason in set(seen_reasons.SYSTEMS[system]()) - published:
        assert f"`{reason}`" in docs, reason


# ---- panels


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


def test_shares_are_of_what_a_reason_is_counted_in() -> None:
    stations, rejected = seen.panels(LIGHTHOUSE)
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


def test_nothing_seen_and_nothing_rejected_are_said() -> None:
    for system in (*seen_reasons.SYSTEMS, "sonar"):
        saw, rejected = seen.panels(Solution(system, "x", ()))
        assert saw.note
        assert rejected.note == "Nothing was rejected."
        assert rejected.figure is None


def test_reasons_of_other_systems_are_shown_without_a_sentence() -> None:
    solution = Solution("sonar", "ping", (path("boat", 2),), {"too_wet": 3, "<b>dry</b>": 1})
    _, rejected = seen.panels(solution)
    assert rejected.table is not None
    assert [row[0] for row in rejected.table.rows] == ["too wet", "<b>dry</b>"]
    assert {row[3] for row in rejected.table.rows} == {""}
    assert rejected.note == "Rejected: 4 observations."
    assert rejected.figure is not None
    assert "<b>" not in rejected.figure.to_json()
    odd = replace(LIGHTHOUSE, rejected={"of_tomorrow": 2})
    assert seen.panels(odd)[1].table.rows == [("of tomorrow", "2", "-", "")]  # type: ignore[union-attr]


def test_frames_are_counted_by_what_became_of_them() -> None:
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
    saw, rejected = seen.panels(solution)
    assert saw.table is not None
    assert saw.table.rows == [
        ("decoded", "8", "80.0", "104", "4", "100.00"),
        ("rejected", "2", "20.0", "108", "8", "-"),
    ]
    assert saw.figure is not None
    counted = sum(np.sum(each.y) for each in saw.figure.data if each.xaxis == "x2")
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
    saw, rejected = seen.panels(Solution("polaris", "joint", (), {"magnets_missing": 1}, found))
    assert "99 of 100 passes" in saw.note
    assert f"The first {seen.MOST_ROWS} are listed" in saw.note
    assert saw.table is not None
    assert len(saw.table.rows) == seen.MOST_ROWS
    assert saw.table.rows[0][:3] == ("-", "-", "5")
    assert saw.table.rows[0][-1] == "magnets missing"
    assert saw.table.rows[1][3:6] == ("12.30", "-", "5.73 ± 0.057")
    assert saw.figure is not None
    assert rejected.table is not None
    assert rejected.table.rows[0][2] == "1 % of 100 passes"
    few, _ = seen.panels(Solution("polaris", "joint", (), {}, (tag(),)))
    assert few.figure is None


def test_a_refused_visit_of_the_solver_is_listed() -> None:
    told = describe_visit(
        VisitHypotheses("robot", 10**18, 0, 9, np.zeros(3), (), refused="too_weak"), None, None
    )
    saw, rejected = seen.panels(Solution("landmarks", "field", (), {"too_weak": 1}, (told,)))
    assert saw.table is not None
    assert saw.table.rows[0][:4] == ("01:46:40.000", "-", "-", "0.0")
    assert saw.table.rows[0][-1] == "too weak"
    assert "1 visit to landmarks" in saw.note
    assert rejected.table is not None
    assert rejected.table.rows[0][2] == "100 % of 1 visit"


def test_detections_of_unknown_systems_are_counted() -> None:
    detections = (GenericRecord({"a": 1}), GenericRecord({"sweeps": "x", "rejected": []}))
    saw, rejected = seen.panels(Solution("sonar", "x", (), {"spike": 1}, detections))
    assert saw.note == "2 detections of sonar."
    assert rejected.note


def test_words_of_tables() -> None:
    assert seen_text.sure(0.99996) == ">99.9"
    assert seen_text.sure(1.0) == "100"
    assert seen_text.sure(None) == seen_text.sure(float("nan")) == "-"
    assert seen_text.cell(None) == ""
    assert seen_text.cell([3, 11]) == "3,11"
    assert seen_text.clock(1e300) == "1e+300 s"
    two = seen_text.tags([tag(), tag(device="other")], 1)
    assert two.header[0] == "array"
    assert two.more == 1


def test_a_bar_has_its_reason_above_it_and_one_reason_no_figure() -> None:
    counts = {"spike": 7, "moment_jumps": 1200, "plane_unknown": 3}
    panel = seen.panels(Solution("lighthouse", "bundle", (), counts))[1]
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
    (only,) = seen.panels(Solution("lighthouse", "bundle", (), {"spike": 7}))[1:]
    assert only.figure is None
    assert only.table.rows[0][:2] == ("spike", "7")
