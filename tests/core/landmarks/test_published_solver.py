"""Published method on whole recordings: poses on the map, warnings and errors."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import pytest

from locatk.core.errors import InputError
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.landmarks.simulation.session import (
    NONE,
    SimulatedSession,
    SimulationOptions,
    simulate,
)
from locatk.core.landmarks.solver import SolveOptions, solve
from locatk.core.solution import Solution

PAPER = SolveOptions(method="paper")


@pytest.fixture(scope="module")
def published(data: Path) -> FloorMap:
    lines = (data / "landmarks" / "or16_L_24x24.txt").read_text().splitlines()[1:]
    return FloorMap(np.array([[int(letter, 16) for letter in line] for line in lines if line]))


@functools.cache
def session(codes: bytes, seed: int) -> SimulatedSession:
    floor = FloorMap(np.frombuffer(codes, np.int64).reshape(24, 24))
    return simulate(floor, SimulationOptions(seed=seed, errors=NONE, rate_hz=100))


def solved(
    floor: FloorMap, seed: int, reported: FloorMap | None
) -> tuple[SimulatedSession, Solution]:
    one = session(np.ascontiguousarray(floor.codes).tobytes(), seed)
    return one, solve(one.samples, reported, PAPER, odometry=one.odometry)


@pytest.mark.slow
def test_an_l_is_a_place_or_a_note(published: FloorMap) -> None:
    located = 0
    for seed in range(3):
        one, result = solved(published, seed, published)
        assert result.method == "paper"
        if not result.trajectories:
            assert "not_localised" in [each.code for each in result.warnings]
            continue
        located += 1
        reported, truth = result.trajectories[0], one.truth[0]
        start = truth.time_ns[0]
        at = [
            np.interp(reported.time_ns - start, truth.time_ns - start, c) for c in truth.position.T
        ]
        away = np.hypot(*(reported.position - np.column_stack(at))[:, :2].T)
        assert away.max() < 0.03
        assert np.median(away) < 0.01
        cells = {event.cell for event in one.events}
        told_cells = {s.cell for s in result.detections if s.cell}
        assert len(told_cells & cells) >= 3
        np.testing.assert_array_equal(reported.time_ns, one.odometry[0].time_ns)
        assert np.isnan(reported.covariance).all()
    assert located >= 2


def test_without_a_map_there_is_a_note_and_no_place(published: FloorMap) -> None:
    _, result = solved(published, 0, None)
    assert not result.trajectories
    assert all(observed.cell is None for observed in result.detections)
    assert "no_map" in [each.code for each in result.warnings]


def test_no_odometry_is_an_error(published: FloorMap) -> None:
    one, _ = solved(published, 0, None)
    with pytest.raises(InputError, match="no odometry of robot"):
        solve(one.samples, published, PAPER)


@pytest.mark.slow
def test_a_map_without_these_three_is_reported(published: FloorMap) -> None:
    other = FloorMap(np.zeros((24, 24), np.int64))
    _, result = solved(published, 1, other)
    assert not result.trajectories
    assert not result.facts.robots["robot"].localised
    assert "not_localised" in [each.code for each in result.warnings]
