"""Whole recordings: right places, and nothing wrong without a word."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.landmarks.halls import HallSamples, HallSensors, circle
from locatk.core.landmarks.landmark import pattern
from locatk.core.landmarks.map.floor import HOLE, FloorMap
from locatk.core.landmarks.simulation.session import (
    Aims,
    Errors,
    Faults,
    SimulatedSession,
    SimulationOptions,
    simulate,
)
from locatk.core.landmarks.solver import SolveOptions, solve
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

CODES = np.random.default_rng(11).integers(0, 16, (12, 12))

FLOOR = FloorMap(CODES)

WAY = ((2, 2), (2, 5), (4, 5), (4, 3))

CELLS = [(2, 2), (2, 3), (2, 4), (2, 5), (3, 5), (4, 5), (4, 4), (4, 3)]


def drive(floor: FloorMap = FLOOR, **options: object) -> SimulatedSession:
    given = {
        "strategy": "path",
        "cells": WAY,
        "rate_hz": 30.0,
        "stop_s": 0.2,
        "seed": 1,
        "aims": Aims(),
    } | options
    return simulate(floor, SimulationOptions(**given))  # type: ignore[arg-type]


@functools.cache
def session() -> SimulatedSession:
    return drive()


def warning_codes(solution: Solution) -> list[str]:
    return [warning.code for warning in solution.warnings]


def solved(
    one: SimulatedSession, floor: FloorMap | None = FLOOR, **change: Callable[[Array], Array]
) -> Solution:
    samples, own = one.samples[0], one.odometry[0]
    if "field" in change:
        samples = replace(samples, field_t=change["field"](samples.field_t.copy()))
    if "place" in change:
        own = replace(own, position=change["place"](own.position.copy()))
    return solve([samples], floor, odometry=[own])


def farthest(one: SimulatedSession, found: Solution) -> float:
    """Largest distance of a pose to the truth, in metres."""
    told: Trajectory = found.trajectories[0]
    truth, start = one.truth[0], one.truth[0].time_ns[0]
    true = [np.interp(told.time_ns - start, truth.time_ns - start, c) for c in truth.position.T]
    return float(np.hypot(*(told.position - np.column_stack(true))[:, :2].T).max())


@pytest.mark.slow
def test_a_session_without_faults() -> None:
    found = solved(session())
    assert [seen.cell for seen in found.detections] == CELLS
    for seen in found.detections:
        assert seen.code == CODES[seen.cell]
        assert seen.pattern == pattern(seen.code)
        assert seen.refused == ""
    assert farthest(session(), found) < 3e-3
    assert found.warnings == ()
    assert found.rejected == {}
    told = found.facts.robots["robot"]
    assert told.localised
    assert told.landmarks_to_localise in (3, 4, 5)
    assert told.probability > 0.9999


@pytest.mark.slow
def test_the_least_pitch() -> None:
    floor = FloorMap(CODES, pitch_m=0.16)
    one = drive(floor)
    found = solved(one, floor)
    assert [seen.cell for seen in found.detections] == CELLS
    assert farthest(one, found) < 3e-3


@pytest.mark.slow
def test_places_of_detections_are_beside_their_landmarks() -> None:
    one = session()
    truth = one.truth[0]
    for seen in solved(one).detections:
        at = np.argmin(np.abs(truth.time_ns * 1e-9 - seen.time_s))
        away = truth.position[at, :2] - FLOOR.place(seen.cell)
        assert seen.x_m == pytest.approx(away[0], abs=4e-3)
        assert seen.y_m == pytest.approx(away[1], abs=4e-3)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_another_map_is_not_believed(seed: int) -> None:
    other = FloorMap(np.random.default_rng(100 + seed).integers(0, 16, (12, 12)))
    found = solved(session(), other)
    assert not found.trajectories
    assert "not_localised" in warning_codes(found)


def test_without_a_map_landmarks_are_told() -> None:
    found = solved(session(), None)
    assert not found.trajectories
    assert len(found.detections) == len(CELLS)
    assert {pattern(CODES[c]) for c in CELLS} == {s.pattern for s in found.detections}
    assert "no_map" in warning_codes(found)


def test_part_of_a_floor_as_the_map() -> None:
    """Poses beyond it are odometry's, and as unsure."""
    part = FloorMap(CODES[:, :5])
    found = solved(session(), part)
    for seen in found.detections:
        if seen.cell is not None:
            assert seen.cell[1] < 5
    assert any(seen.refused for seen in found.detections)
    if found.trajectories:
        assert farthest(session(), found) < 4 * found.trajectories[0].sigma[:, :2].max()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"place": lambda p: 1000 * p}, "odometry"),
        ({"field": lambda f: np.nan * f}, "no hall sensor"),
    ],
)
def test_recordings_that_cannot_be_are_errors(
    change: dict[str, Callable[[Array], Array]], words: str
) -> None:
    with pytest.raises(InputError, match=words):
        solved(session(), **change)


@functools.cache
def spinning() -> SimulatedSession:
    """The paper's strategy, which turns on each landmark."""
    return drive(strategy="paper", cells=(), seed=5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("order", "words"),
    [
        ([2, 3, 0, 1], "rear, right, front, left"),
        ([0, 3, 2, 1], "front, right, rear, left"),
    ],
)
def test_the_right_order_of_sensors_is_named(order: list[int], words: str) -> None:
    with pytest.raises(InputError, match=f"are {words}"):
        solved(spinning(), field=lambda f: f[:, order])


@pytest.mark.slow
def test_no_order_of_sensors_leads_astray() -> None:
    """A straight pass cannot tell left from right, nor then a mirrored landmark."""
    message = ""
    try:
        found = solved(session(), field=lambda f: f[:, [0, 3, 2, 1]])
    except InputError as error:
        message = str(error)
    else:
        assert not found.trajectories
        assert found.warnings
    assert not message or "order" in message


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "code", "subject"),
    [
        ({"field": lambda f: -f}, "polarity_exchanged", "robot"),
        ({"field": lambda f: f / 1000}, "no_landmark", "robot"),
        ({"field": lambda f: np.where(np.arange(4) == 1, np.nan, f)}, "sensor_silent", "left"),
        ({"field": lambda f: np.where(np.arange(4) == 1, 1e-3, f)}, "sensor_constant", "left"),
    ],
)
def test_what_is_wrong_is_told(
    change: dict[str, Callable[[Array], Array]], code: str, subject: str
) -> None:
    found = solved(session(), **change)
    (warning,) = [each for each in found.warnings if each.code == code]
    assert subject in warning.message
    if found.trajectories:
        assert farthest(session(), found) < 4e-3


@pytest.mark.slow
def test_late_odometry_is_told() -> None:
    """Where the robot turns: straight on, to be late is to be behind."""
    one = spinning()
    late = replace(one.odometry[0], time_ns=one.odometry[0].time_ns + 50_000_000)
    found = solve(one.samples, FLOOR, odometry=[late])
    assert "field_misfit" in warning_codes(found) or not found.trajectories
    assert found.warnings


def test_no_odometry_is_an_error() -> None:
    with pytest.raises(InputError, match="no odometry of robot"):
        solve(session().samples, FLOOR)


def test_a_landmark_that_the_map_lacks() -> None:
    codes = CODES.copy()
    codes[3, 5] = HOLE
    found = solved(session(), FloorMap(codes))
    assert found.rejected == {"off_map": 1}
    assert farthest(session(), found) < 4e-3


def test_a_landmark_that_the_floor_lacks() -> None:
    codes = CODES.copy()
    codes[2, 4] = HOLE
    one = drive(FloorMap(codes))
    found = solved(one, FLOOR)
    assert [seen.cell for seen in found.detections] == [c for c in CELLS if c != (2, 4)]
    assert farthest(one, found) < 4e-3


@pytest.mark.slow
def test_a_landmark_laid_wrongly_is_told() -> None:
    codes = CODES.copy()
    codes[2, 4] = (codes[2, 4] + 5) % 16
    one = drive(FloorMap(codes))
    found = solved(one, FLOOR)
    assert found.rejected == {}  # it is used, as it was read
    assert sum(seen.refused == "misread" for seen in found.detections) == 1
    assert found.detections[2].refused == "misread"
    assert found.detections[2].code == codes[2, 4]
    assert farthest(one, found) < 4e-3


@pytest.mark.slow
def test_missing_bars_do_not_mislead() -> None:
    one = drive(faults=Faults(missing=(((2, 4), 1), ((4, 5), 0))))
    found = solved(one)
    assert farthest(one, found) < 4e-3
    assert [seen.cell for seen in found.detections] == CELLS


@pytest.mark.slow
@pytest.mark.parametrize("count", [2, 8])
def test_any_number_of_sensors_anywhere(count: int) -> None:
    places = circle(0.03) @ np.array([[0.8, 0.6], [-0.6, 0.8]])
    places = np.vstack([places, [[0, 0.04], [0.02, 0], [-0.04, 0.01], [0, 0]]])[:count]
    names = tuple(f"s{k}" for k in range(count))
    one = drive(sensors=HallSensors(names, places, noise_t=1.5e-4))
    found = solved(one)
    assert farthest(one, found) < 4e-3


def test_gaps_and_missing_values() -> None:
    samples = session().samples[0]
    random = np.random.default_rng(0)
    keep = np.ones(len(samples), bool)
    keep[300:420] = False
    field = np.where(random.random(samples.field_t.shape) < 0.2, np.nan, samples.field_t)
    holed = HallSamples("robot", samples.sensors, samples.time_ns[keep], field[keep])
    found = solve([holed], FLOOR, odometry=session().odometry)
    assert farthest(session(), found) < 5e-3


@pytest.mark.slow
def test_robots_of_one_session_keep_apart() -> None:
    one, other = session(), drive(seed=2, cells=((7, 7), (7, 9), (9, 9), (9, 8)))
    second = replace(other.samples[0], device="b")
    own = replace(other.odometry[0], device="b")
    found = solve([second, one.samples[0]], FLOOR, odometry=[one.odometry[0], own])
    assert [t.device for t in found.trajectories] == ["b", "robot"]
    alone = solved(one).trajectories[0]
    np.testing.assert_allclose(found.trajectories[1].position, alone.position, atol=1e-9)
    assert {seen.device for seen in found.detections} == {"b", "robot"}


def test_too_few_landmarks_are_no_place() -> None:
    one = drive(cells=((2, 2), (2, 3)))
    found = solved(one)
    assert not found.trajectories
    assert "not_localised" in warning_codes(found)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_misread_landmarks_are_never_silent(seed: int) -> None:
    """One in five is laid otherwise than the map says."""
    one = drive(seed=seed, faults=Faults(misread_rate=0.2), errors=Errors())
    found = solved(one)
    if found.trajectories and farthest(one, found) > 0.05:
        assert found.facts.robots["robot"].probability < 0.9999
        assert {"localization_uncertain", "not_localised"} & set(warning_codes(found))


def test_options_out_of_range_are_refused() -> None:
    with pytest.raises(InputError, match="no method"):
        SolveOptions(method="magic")
    with pytest.raises(InputError, match="misread"):
        SolveOptions(misread=0.0)
