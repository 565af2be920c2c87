"""Pose from four voltages, over magpylib's bars."""

from __future__ import annotations

import math

import magpylib
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from locatk.core.errors import DegenerateError
from locatk.core.landmarks.halls import circle
from locatk.core.landmarks.landmark import Geometry, signs
from locatk.core.landmarks.published.pose_compensation import (
    LandingCurve,
    compensate_pose,
    landing_curve,
    rotation_to_bars,
)

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
        linear = compensate_pose(GEOMETRY, code, circle(), field)
        assert np.hypot(*(linear[:2] - [x, y])) < 0.0004
        assert abs(linear[2] - heading) < math.radians(0.4)
        exact = compensate_pose(GEOMETRY, code, circle(), field, steps=5)
        assert np.allclose(exact, [x, y, heading], atol=1e-9)


def test_three_sensors_are_enough_and_two_are_not() -> None:
    field = voltages(0b0111, 0.002, -0.001, 0.03)
    field[2] = np.nan
    result = compensate_pose(GEOMETRY, 0b0111, circle(), field, steps=5)
    assert np.allclose(result, [0.002, -0.001, 0.03], atol=1e-9)
    field[0] = np.nan
    with pytest.raises(DegenerateError, match="2 sensors"):
        compensate_pose(GEOMETRY, 0b0111, circle(), field)


def test_coincident_sensors_give_no_pose() -> None:
    lever = np.repeat(circle()[:1], 4, axis=0)
    with pytest.raises(DegenerateError, match="do not determine a pose"):
        compensate_pose(GEOMETRY, 0b0111, lever, np.zeros(4))


@given(st.floats(-20, 20), st.floats(-math.pi, math.pi))
def test_the_rotation_to_the_bars_is_the_smallest(heading: float, first: float) -> None:
    bars = first + np.radians([0, 90, 180, 270])
    rotation = rotation_to_bars(heading, bars)
    assert abs(rotation) <= math.pi / 4 + 1e-9
    assert np.isclose(np.cos(4 * (heading + rotation - first)), 1.0)


# ---- landing curve


@given(
    st.floats(-0.02, 0.02),
    st.floats(-0.02, 0.02),
    st.floats(-0.5, 0.5),
    st.floats(0.15, 0.3),
    st.floats(-math.pi, math.pi),
)
def test_two_equal_arcs_lead_to_the_goal(
    x: float, y: float, heading: float, pitch: float, frame: float
) -> None:
    assume(math.hypot(y, heading) > 1e-3)
    cos, sin = math.cos(frame), math.sin(frame)
    start = np.array([cos * x - sin * y, sin * x + cos * y, heading + frame])
    goal = np.array([cos * pitch, sin * pitch, frame])
    curve = landing_curve(start, goal)
    # Driven by Euler's small steps, not by the curve's own formula.
    steps = 2000
    bend = np.repeat([math.copysign(1 / curve.radius_m, arc) for arc in curve.arc_rad], steps)
    size = np.repeat([abs(arc) * curve.radius_m / steps for arc in curve.arc_rad], steps)
    rotated = start[2] + np.concatenate([[0], np.cumsum(bend * size)])
    middle = (rotated[1:] + rotated[:-1]) / 2
    end = start[:2] + [np.sum(size * np.cos(middle)), np.sum(size * np.sin(middle))]
    assert np.allclose(end, goal[:2], atol=1e-6)
    assert abs(math.remainder(rotated[-1] - goal[2], math.tau)) < 1e-6
    assert curve.arc_rad[0] * curve.arc_rad[1] <= 0
    poses = curve.poses(start, [0.0, curve.length_m / 2, curve.length_m])
    assert np.allclose(poses[0], start)
    assert np.allclose(poses[2, :2], goal[:2], atol=1e-9)
    # no detour: an error this small needs hardly more than the straight way
    assert curve.length_m < 1.3 * np.hypot(*(goal - start)[:2])


def test_without_errors_the_path_is_straight() -> None:
    curve = landing_curve((0, 0, 0), (0.2, 0, 0))
    assert curve == LandingCurve(math.inf, (0.0, 0.0), 0.2)
    assert np.allclose(curve.poses((0, 0, 0), [0.1]), [[0.1, 0, 0]])
    small = landing_curve((0, 1e-4, 0), (0.2, 0, 0))
    # R = D^2 / (4 e) to first order
    assert math.isclose(small.radius_m, 0.04 / 4e-4, rel_tol=1e-4)
    assert small.arc_rad[0] < 0 < small.arc_rad[1]


def test_no_curve() -> None:
    with pytest.raises(DegenerateError, match="two positions"):
        landing_curve((0, 0, 0), (0, 0, 1))
    with pytest.raises(DegenerateError, match="behind"):
        landing_curve((0, 0, 0), (-0.2, 0, 0))
