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
