"""Pose from four voltages, over magpylib's bars."""

from __future__ import annotations

import math

import magpylib
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from locatk.core.errors import DegenerateError
from locatk.core.landmarks.halls import circle
from locatk.core.landmarks.landmark import Geometry, signs
from locatk.core.landmarks.published.pose import compensate, turn_to_bars

GEOMETRY = Geometry()


def voltages(code: int, x: float, y: float, heading: float) -> np.ndarray:
    cos, sin = math.cos(heading), math.sin(heading)
    points = circle() @ np.array([[cos, sin], [-sin, cos]]) + [x, y]
    points = np.column_stack([points, np.full(4, GEOMETRY.sensor_height_m)])
    total = np.zeros(4)
    for k, sign in enumerate(signs(code)):
        bar = magpylib.magnet.Cuboid(
            polarization=(0, sign * GEOMETRY.remanence_t, 0),
            dimension=(GEOMETRY.bar_width_m, GEOMETRY.bar_length_m, GEOMETRY.bar_height_m),
            position=(GEOMETRY.radius_m, 0, -GEOMETRY.bar_height_m / 2),
        )
        bar.rotate_from_angax(90 * k, "z", anchor=0)
        total += bar.getB(points)[:, 2]
    return total


@pytest.mark.parametrize("code", range(16))
def test_the_linear_way_is_good_near_the_centre_and_newton_exact(code: int) -> None:
    rng = np.random.default_rng(code)
    for _ in range(3):
        x, y = rng.uniform(-0.0025, 0.0025, 2)
        heading = math.radians(rng.uniform(-5, 5))
        field = voltages(code, x, y, heading)
        linear = compensate(GEOMETRY, code, circle(), field)
        assert np.hypot(*(linear[:2] - [x, y])) < 0.0004
        assert abs(linear[2] - heading) < math.radians(0.4)
        exact = compensate(GEOMETRY, code, circle(), field, steps=5)
        assert np.allclose(exact, [x, y, heading], atol=1e-9)


def test_three_sensors_are_enough_and_two_are_not() -> None:
    field = voltages(0b0111, 0.002, -0.001, 0.03)
    field[2] = np.nan
    found = compensate(GEOMETRY, 0b0111, circle(), field, steps=5)
    assert np.allclose(found, [0.002, -0.001, 0.03], atol=1e-9)
    field[0] = np.nan
    with pytest.raises(DegenerateError, match="2 sensors"):
        compensate(GEOMETRY, 0b0111, circle(), field)


def test_sensors_in_one_place_tell_no_pose() -> None:
    lever = np.repeat(circle()[:1], 4, axis=0)
    with pytest.raises(DegenerateError, match="do not tell a pose"):
        compensate(GEOMETRY, 0b0111, lever, np.zeros(4))


@given(st.floats(-20, 20), st.floats(-math.pi, math.pi))
def test_the_turn_to_the_bars_is_the_least(heading: float, first: float) -> None:
    bars = first + np.radians([0, 90, 180, 270])
    turn = turn_to_bars(heading, bars)
    assert abs(turn) <= math.pi / 4 + 1e-9
    assert np.isclose(np.cos(4 * (heading + turn - first)), 1.0)
