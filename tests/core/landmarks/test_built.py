"""Landmarks as built: what localization and the fields of neighbours make of them."""

from __future__ import annotations

import numpy as np
import pytest

from locatk.core.landmarks.detection.hypotheses import Hypothesis, VisitHypotheses
from locatk.core.landmarks.detection.trace import OdometryDrift, Trace, sensor_positions
from locatk.core.landmarks.halls import circle
from locatk.core.landmarks.landmark import code_of, rotated, signs
from locatk.core.landmarks.localization.cell_filter import identify_cells
from locatk.core.landmarks.localization.smoothing import subtract_neighbours
from locatk.core.landmarks.map.floor import (
    HOLE_CODE,
    AsBuiltLandmark,
    FloorMap,
    as_built_codes,
    as_built_landmark,
)
from locatk.core.landmarks.simulation.floor import floor_field, install_landmarks
from locatk.core.landmarks.simulation.options import NONE, Faults

CODES = np.array([[13, 5, 4, 12], [3, 7, 2, 15], [1, 11, HOLE_CODE, 8]])


def built(
    strength: object, x_m: float = 0.0, y_m: float = 0.0, rotation: float = 0.0
) -> AsBuiltLandmark:
    return AsBuiltLandmark(x_m, y_m, rotation, np.array(strength, float), np.full(7, np.nan))


def test_codes_default_to_the_design() -> None:
    assert np.array_equal(as_built_codes(FloorMap(CODES)), CODES)
    sound = {(1, 1): built(0.97 * signs(7)), (0, 1): built([np.nan] * 4)}
    assert np.array_equal(as_built_codes(FloorMap(CODES, built=sound)), CODES)


def test_flipped_bars_change_codes_and_missing_ones_do_not() -> None:
    one = {(0, 0): built([-1.0, 0.02, 1.0, -0.1])}  # designed NSNN
    assert as_built_codes(FloorMap(CODES, built=one))[0, 0] == code_of("SSNN")
    assert CODES[0, 0] == 13


def test_marks_show_position_and_pattern_as_built() -> None:
    floor = FloorMap(CODES, built={(1, 2): built([np.nan, 0.5, 0.0, -1.1], 2e-3, -1e-3, 0.02)})
    pose, strength = as_built_landmark(floor, (1, 2))
    assert pose == pytest.approx([0.402, 0.199, 0.02])
    assert strength == pytest.approx([signs(2)[0], 0.5, 0.0, -1.1])
    pose, strength = as_built_landmark(floor, (0, 1))
    assert pose == pytest.approx([0.2, 0, 0])
    assert np.array_equal(strength, signs(5))


def test_fields_of_neighbours_are_those_of_their_bars_as_built() -> None:
    """magpylib's field of all landmarks but one is taken off, at a small pitch."""
    known = {
        (0, 1): built([1.1, 0.9, -1.0, 0.0], 4e-3, -3e-3, 0.1),
        (1, 0): built([-1, -1, 0.7, 1], -5e-3, 0.0, -0.2),
    }
    floor = FloorMap(CODES[:2, :2], pitch_m=0.12, built=known)
    installed = install_landmarks(floor, NONE, Faults(), 0)
    others = [mark for cell, mark in installed.items() if cell != (0, 0)]
    pose = np.column_stack([np.linspace(-0.02, 0.05, 15), np.full(15, 0.01), np.full(15, 0.3)])
    local = pose.copy()
    position = sensor_positions(pose, circle())
    height = np.full((*position.shape[:2], 1), floor.geometry.sensor_height_m)
    value = floor_field(floor.geometry, others, np.concatenate([position, height], axis=-1))
    trace = Trace(local, np.zeros((15, 3, 1)), value, circle(), np.ones(15), 0)
    left = subtract_neighbours(trace, np.zeros(3), np.zeros(1), (0, 0), floor).field_t
    assert np.abs(value).max() > 1e-3
    assert np.abs(left).max() < 2e-6
    wrong = FloorMap(CODES[:2, :2], pitch_m=0.12)
    left = subtract_neighbours(trace, np.zeros(3), np.zeros(1), (0, 0), wrong).field_t
    assert np.abs(left).max() > 1e-4


def test_a_flipped_bar_that_is_known_does_not_count_against_a_place() -> None:
    flip = {(0, 1): built([1, -1, -1, -1])}  # designed NSNS
    tour = [((0, 0), 13), ((0, 1), code_of("NSSS")), ((0, 2), 4)]
    sightings = [
        VisitHypotheses(
            "robot", n, n, n + 1, np.array([0.2 * n, 0.0, 0.0]),
            (Hypothesis(int(rotated(code, 0)), 1.0, np.zeros(3), 1e-6 * np.eye(3),
                        signs(code), np.full(4, 0.02)),),
        )
        for n, (_, code) in enumerate(tour)
    ]  # fmt: skip
    sure = {}
    for floor in (FloorMap(CODES), FloorMap(CODES, built=flip)):
        reported = identify_cells(sightings, floor, misread=0.01, drift=OdometryDrift()).estimates
        sure[bool(floor.built)] = reported[-1].probability
        if floor.built:
            assert [one.cell for one in reported] == [cell for cell, _ in tour]
            assert all(one.quarters == 0 for one in reported)
    assert sure[True] > 0.99
    assert sure[True] > sure[False] + 1e-4
