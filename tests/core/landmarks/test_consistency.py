"""Displaced landmarks and wrong maps: simulated, and reported."""

from __future__ import annotations

import math

import numpy as np
import pytest

from locatk.core.landmarks.detection.hypotheses import Hypothesis, VisitHypotheses
from locatk.core.landmarks.localization import consistency
from locatk.core.landmarks.localization.cell_filter import CellEstimate, IdentifiedVisit
from locatk.core.landmarks.localization.robust_smoothing import DisplacedLandmark, WheelSlip
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.landmarks.preprocessing import VisitSegment
from locatk.core.landmarks.simulation.session import (
    Faults,
    SimulatedSession,
    SimulationOptions,
    simulate,
)
from locatk.core.landmarks.solver import solve
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory

CODES = np.random.default_rng(11).integers(0, 16, (12, 12))

FLOOR = FloorMap(CODES)

CELLS = ((2, 2), (2, 3), (2, 4), (2, 5), (3, 5), (4, 5), (4, 4), (4, 3))


def drive(**options: object) -> SimulatedSession:
    given = {"strategy": "path", "cells": ((2, 2), (2, 5), (4, 5), (4, 3)), "rate_hz": 30.0}
    return simulate(FLOOR, SimulationOptions(**given | {"seed": 1} | options))  # type: ignore[arg-type]


def solved(one: SimulatedSession, floor: FloorMap = FLOOR) -> Solution:
    return solve(one.samples, floor, odometry=one.odometry)


@pytest.mark.slow
def test_displaced_landmark_is_reported() -> None:
    one = drive(faults=Faults(displaced=(((3, 5), (0.012, 0.0)),)))
    result = solved(one)
    messages = [each.message for each in result.warnings if each.code == "landmark_displaced"]
    assert len(messages) == 1
    assert "landmark at 3,5 is displaced" in messages[0]


@pytest.mark.slow
@pytest.mark.parametrize(("wrong", "accepted"), [(1, True), (3, False)])
def test_contradicted_map_is_rejected(wrong: int, accepted: bool) -> None:
    codes = CODES.copy()
    for cell in CELLS[1::2][:wrong]:
        codes[cell] = (codes[cell] + 5) % 16
    result = solved(drive(), FloorMap(codes))
    assert bool(result.trajectories) == accepted
    assert ("map_contradicted" in [each.code for each in result.warnings]) != accepted
    known = [one for one in result.detections if one.cell is not None]
    assert bool(known) == accepted
    (facts,) = result.facts.robots.values()
    assert all(one.cell_probability <= facts.map_probability for one in known)


# ---- guards


def visits_of(misread: int, unexplained: int, correct: int) -> list[IdentifiedVisit]:
    """Return visits of the cell (2, 2) that agree with the map or not."""
    code = int(FLOOR.codes[2, 2])
    visits = []
    for refused, codes in (
        ("not_explained", [code] * unexplained),
        ("", [code] * correct + [(code + 1) % 16] * misread),
    ):
        for read in codes:
            one = Hypothesis(read, 1.0, np.zeros(3), np.eye(3), np.ones(4), np.ones(4))
            hypotheses = VisitHypotheses("robot", 0, 0, 5, np.zeros(3), (one,), refused=refused)
            misread_probability = float(read != code)
            estimate = CellEstimate((2, 2), 0, 0, 1.0, 1.0, misread_probability=misread_probability)
            segment = VisitSegment(0, 5, np.arange(5), None, np.zeros(3))  # type: ignore[arg-type]
            visits.append(IdentifiedVisit(segment, hypotheses, None if refused else estimate))
    return visits


@pytest.mark.parametrize(
    ("misread", "unexplained", "correct", "contradicted"),
    [(1, 0, 0, False), (2, 0, 4, False), (2, 0, 3, True), (1, 1, 3, True), (0, 2, 0, True)],
)
def test_contradictions_are_counted(
    misread: int, unexplained: int, correct: int, contradicted: bool
) -> None:
    visits = visits_of(misread, unexplained, correct)
    on_map = [visit for visit in visits if visit.estimate is not None]
    assert consistency.is_map_contradicted(visits, on_map, 1.0) == contradicted


def used_visit(start_s: int, refused: str = "", probability: float = 1.0) -> IdentifiedVisit:
    """Return a visit of one second, with a cell of the given probability if it is not refused."""
    time_ns = np.array([start_s, start_s + 1], np.int64) * 10**9
    segment = VisitSegment(0, 2, time_ns, None, np.zeros(3))  # type: ignore[arg-type]
    hypotheses = VisitHypotheses("robot", 0, 0, 5, np.zeros(3), (), refused=refused)
    estimate = CellEstimate((2, 2), 0, 0, probability, probability)
    return IdentifiedVisit(segment, hypotheses, None if refused else estimate)


@pytest.mark.parametrize(
    ("unused", "first_s", "last_s"),
    [
        ([], 0, 20),
        ([used_visit(1, "not_explained")], 5, 20),
        ([used_visit(15, probability=0.3)], 0, 11),
        ([used_visit(1, "not_explained"), used_visit(15, probability=0.3)], 5, 11),
        ([used_visit(1, "too_weak"), used_visit(7, "not_explained")], 0, 20),
    ],
)
def test_dead_reckoning_ends_where_landmarks_contradict_it(
    unused: list[IdentifiedVisit], first_s: int, last_s: int
) -> None:
    time_ns = np.arange(21, dtype=np.int64) * 10**9
    path = Trajectory.from_positions("robot", "map", time_ns, np.zeros((21, 3)))
    used = [used_visit(5), used_visit(10)]
    contradicting = [one for one in unused if consistency.contradicts_odometry(one)]
    kept, warnings = consistency.without_contradicted_ends(path, used, contradicting)
    assert (kept.time_ns[[0, -1]] == np.array([first_s, last_s]) * 10**9).all()
    assert len(warnings) == (first_s > 0) + (last_s < 20)
    assert all(each.code == "odometry_contradicted" for each in warnings)


def test_causes_that_cannot_be_distinguished_are_named_without_sizes() -> None:
    slip = WheelSlip(1_000_000_000, 2_500_000_000, 0.0093, math.radians(2))
    displaced = DisplacedLandmark((0, 2), 0.0, 0.0)
    alone = consistency.warn_of_cause(slip)
    assert alone.message == "a wheel slipped between 1.000 and 2.500 s by 9.3 mm and 2 deg"
    both = consistency.warn_of_cause(slip, displaced)
    assert both.code == alone.code == "wheel_slip"
    assert both.message == (
        "a wheel slipped between 1.000 and 2.500 s, or the landmark at 0,2 is displaced; the "
        "recording does not show which"
    )
