"""The first step: circles, the hull, and where each rule holds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import Delaunay

from locatk.core.errors import DegenerateError
from locatk.core.landmarks.landmark import Geometry
from locatk.core.landmarks.published.first_step import (
    RADII,
    circle_centres,
    first_centre,
    in_hull,
    radii,
    silent_distance,
)

NOWHERE = np.full((1, 2), np.nan)
NO_WAY = np.full((1, 3, 2, 2), np.nan)


def chord(aside: float, radius: float) -> list[list[float]]:
    """Where a line along x meets a circle around the origin."""
    half = float(np.sqrt(radius**2 - aside**2))
    return [[-half, aside], [half, aside]]


@given(st.integers(2, 5), st.integers(0, 2**32 - 1))
def test_circles_go_through_two_points(count: int, seed: int) -> None:
    points = np.random.default_rng(seed).uniform(-0.05, 0.05, (count, 2))
    centres = circle_centres(points)
    assert centres.shape == (2 * count * (count - 1), 2)
    centres = centres[np.isfinite(centres[:, 0])]
    distance = np.linalg.norm(centres[:, None] - points, axis=-1)
    off = np.abs(distance[..., None] - np.array(RADII)).min(axis=-1)
    assert (np.sort(off, axis=1)[:, 1] < 1e-9).all()
    # two circles a radius for each pair that is near enough
    apart = np.linalg.norm(points[:, None] - points, axis=-1)[np.triu_indices(count, 1)]
    assert len(centres) == sum(2 * int((apart < 2 * r).sum()) for r in RADII)


@given(st.integers(3, 7), st.integers(0, 2**32 - 1))
def test_the_hull_is_scipys(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, places = rng.uniform(-1, 1, (count, 2)), rng.uniform(-1, 1, (50, 2))
    expected = Delaunay(points).find_simplex(places) >= 0
    padded = np.concatenate([points, np.full((2, 2), np.nan)])
    assert (in_hull(points, places) == expected).all()
    assert (in_hull(padded, places) == expected).all()


def test_two_points_have_no_hull() -> None:
    assert not in_hull(np.array([[-1.0, 0], [1, 0]]), np.zeros((1, 2))).any()


def test_distance_from_ways_is_that_from_their_points() -> None:
    rng = np.random.default_rng(4)
    ways = rng.uniform(-1, 1, (2, 4, 2))
    ways[1, 2:] = np.nan
    places = rng.uniform(-1, 1, (30, 2))
    share = np.linspace(0, 1, 4001)[:, None]
    joined = [a + share * (b - a) for a, b in zip(ways[0, :-1], ways[0, 1:], strict=True)]
    joined.append(ways[1, 0] + share * (ways[1, 1] - ways[1, 0]))
    every = np.concatenate(joined)
    expected = np.linalg.norm(places[:, None] - every, axis=-1).min(axis=1)
    assert np.allclose(silent_distance(ways, places), expected, atol=1e-5)
    assert np.isinf(silent_distance(np.full((1, 3, 2), np.nan), places)).all()


@pytest.mark.parametrize("rule", ["literal", "corrected"])
def test_one_line_tells_the_centre_of_a_circle(rule: str) -> None:
    # The right sensor's line is 30 mm left of the centre; the others run farther left.
    points = np.array([chord(0.03, 0.05)])
    silent = NO_WAY.copy()
    silent[0, 0], silent[0, 1] = [[-0.2, 0.055], [0.2, 0.055]], [[-0.2, 0.08], [0.2, 0.08]]
    robot = np.array([[0.0, 0.055]])
    centre = first_centre(points, silent, robot, (0.05, 0.05), rule)  # type: ignore[arg-type]
    assert np.allclose(centre, 0, atol=1e-12)


def test_two_lines_on_one_side_need_the_corrected_rule() -> None:
    # Robot 35 mm beside the centre: lines at 10 and 35 mm hit, that at 60 mm does not.
    points = np.array([chord(0.010, 0.05) + chord(0.035, 0.05)])
    silent = NO_WAY.copy()
    silent[0, 0] = [[-0.2, 0.060], [0.2, 0.060]]
    robot = np.array([[0.0, 0.035]])
    assert not in_hull(points[0], np.zeros((1, 2)))
    literal = first_centre(points, silent, robot, (0.05, 0.05), "literal")
    corrected = first_centre(points, silent, robot, (0.05, 0.05), "corrected")
    assert not np.hypot(*literal[0]) < 0.010
    assert np.hypot(*corrected[0]) < 0.005


def test_all_lines_hit() -> None:
    points = np.array([chord(-0.025, 0.05) + chord(0, 0.05) + chord(0.025, 0.05)])
    centre = first_centre(points, NO_WAY, NOWHERE, (0.05, 0.05))
    assert np.allclose(centre, 0, atol=1e-12)


@pytest.mark.parametrize("count", [0, 1])
def test_too_few_entries(count: int) -> None:
    points = np.zeros((1, count, 2))
    assert np.isnan(first_centre(points, NO_WAY, NOWHERE)).all()
    assert np.isnan(first_centre(points, np.empty((1, 0, 0, 2)), NOWHERE)).all()


def test_radii_of_the_default_bars_are_the_papers() -> None:
    r1, r2 = radii(Geometry())
    assert abs(r1 - 0.045) < 0.001
    assert abs(r2 - 0.054) < 0.001


def test_a_threshold_that_no_field_reaches() -> None:
    with pytest.raises(DegenerateError, match="no field of 900 mT"):
        radii(replace(Geometry(), threshold_t=0.9))
