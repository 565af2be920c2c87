"""Valleys of a spin over magpylib's bars, and what they tell."""

from __future__ import annotations

import functools
import math

import magpylib
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from locatk.core.landmarks.landmark import Geometry, name, pattern, rotated, signs
from locatk.core.landmarks.published.second_step import (
    SpinReading,
    Valleys,
    circle_profile,
    find_valleys,
    recognise,
)

GEOMETRY = Geometry()
RADIUS = GEOMETRY.circle_m
HEADINGS = np.radians(np.arange(0, 362, 2))


@functools.cache
def magpylibs(code: int) -> magpylib.Collection:
    bars = magpylib.Collection()
    for k, sign in enumerate(signs(code)):
        bar = magpylib.magnet.Cuboid(
            polarization=(0, sign * GEOMETRY.remanence_t, 0),
            dimension=(GEOMETRY.bar_width_m, GEOMETRY.bar_length_m, GEOMETRY.bar_height_m),
            position=(GEOMETRY.radius_m, 0, -GEOMETRY.bar_height_m / 2),
        )
        bar.rotate_from_angax(90 * k, "z", anchor=0)
        bars.add(bar)
    return bars


def simulate_spin(
    code: int, x: float, y: float, rotation: float = 0.0, seed: int = 1
) -> SpinReading | None:
    """A spin of four sensors at (x, y) of a landmark; the answer is in a frame about the
    robot that is turned by ``turn`` from the landmark's."""
    bearing = HEADINGS[:, None] + np.radians([0, 90, 180, 270])
    circle = RADIUS * np.stack([np.cos(bearing), np.sin(bearing)], -1)
    points = np.concatenate(
        [circle + [x, y], np.full((*bearing.shape, 1), GEOMETRY.sensor_height_m)], -1
    )
    field = magpylibs(code).getB(points.reshape(-1, 3))[:, 2].reshape(bearing.shape)
    field = field + np.random.default_rng(seed).normal(0, 0.15e-3, field.shape)
    cos, sin = math.cos(rotation), math.sin(rotation)
    own = circle @ np.array([[cos, -sin], [sin, cos]])
    around = circle_profile(own, field, np.zeros(2))
    return recognise(find_valleys(around, 0.2 * GEOMETRY.threshold_t), RADIUS)


@pytest.mark.parametrize("code", range(16))
def test_each_code_is_read_under_any_heading(code: int) -> None:
    rng = np.random.default_rng(code)
    for _ in range(3):
        # 8 mm is where the paper's way still holds
        off, where, rotation = rng.uniform(0, 0.008), *rng.uniform(-math.pi, math.pi, 2)
        x, y = off * math.cos(where), off * math.sin(where)
        result = simulate_spin(code, x, y, rotation)
        assert result is not None
        cos, sin = math.cos(rotation), math.sin(rotation)
        position = np.array([[cos, -sin], [sin, cos]]) @ result.centre_m
        assert np.hypot(*(position + [x, y])) < (0.0045 if pattern(code)[0:3] != "NSN" else 0.0003)
        for heading in (0.0, 1.0, -2.5):
            read, frame = result.in_frame_of(heading)
            # The frame's heading here is the landmark's, which is -turn, and quarter turns.
            quarters = (frame + rotation) / (math.pi / 2)
            assert abs(quarters - round(quarters)) < math.radians(2) / (math.pi / 2)
            assert abs(math.remainder(heading - frame, math.tau)) <= math.pi / 4 + 1e-9
            assert read == rotated(code, -round(quarters)), name(read)


@pytest.mark.parametrize(
    ("code", "bias_mm"), [(0b0101, 0.0), (0b0011, 0.0), (0b1111, 0.0), (0b0111, 2.6), (0b1000, 2.6)]
)
def test_lines_cross_at_the_centre_but_for_landmarks_2_and_3(code: int, bias_mm: float) -> None:
    result = simulate_spin(code, 0.0, 0.0)
    assert result is not None
    assert abs(np.hypot(*result.centre_m) * 1e3 - bias_mm) < 0.2


def test_far_off_no_centre_is_believed() -> None:
    for code in (0b0111, 0b0011, 0b1111):
        for where in np.radians(np.arange(0, 360, 60)):
            result = simulate_spin(code, 0.02 * math.cos(where), 0.02 * math.sin(where))
            assert result is None or np.hypot(*result.centre_m) <= 0.01


@given(st.integers(1, 6), st.floats(0, math.tau), st.floats(0.6, 10))
def test_valleys_of_a_wave(waves: int, phase: float, size: float) -> None:
    angle = np.radians(np.arange(360))
    result = find_valleys(size * np.sin(waves * angle - phase), 0.5)
    assert len(result.angle_rad) == 2 * waves
    assert (result.rising != np.roll(result.rising, 1)).all()
    off = waves * result.angle_rad[result.rising] - phase
    assert np.abs(np.angle(np.exp(1j * off))).max() < 0.01


def test_small_ripples_are_no_valleys() -> None:
    angle = np.radians(np.arange(360))
    ripple = 0.4 * np.sin(60 * angle)
    assert len(find_valleys(5 * np.sin(angle - 0.3) + ripple, 0.5).angle_rad) == 2
    assert len(find_valleys(ripple, 0.5).angle_rad) == 0
    assert len(find_valleys(3 + ripple, 0.5).angle_rad) == 0


def test_a_partly_observed_circle() -> None:
    angle = np.radians(np.arange(0, 300.0, 3))[:, None]
    position = np.stack([np.cos(angle), np.sin(angle)], -1)
    assert np.isnan(circle_profile(position, np.ones((100, 1)), np.zeros(2))).all()
    angle = np.radians(np.arange(0, 360.0, 6))[:, None]
    position = np.stack([np.cos(angle), np.sin(angle)], -1)
    field = np.sin(angle)
    field[3] = np.nan
    assert np.allclose(
        circle_profile(position, field, np.zeros(2)), np.sin(np.radians(np.arange(360))), atol=0.02
    )


@pytest.mark.parametrize(
    "degrees",
    [
        [0, 60, 120, 180, 240, 300],  # no two large gaps
        [0, 45, 90, 135, 180, 225],  # one large gap
        [10, 190],
        [0, 30, 60, 90],  # no perpendicular lines
    ],
)
def test_valleys_that_fit_no_landmark(degrees: list[float]) -> None:
    angle = np.radians(degrees)
    observed = Valleys(angle, np.arange(len(angle)) % 2 == 0, np.ones(len(angle)))
    assert recognise(observed, RADIUS) is None
