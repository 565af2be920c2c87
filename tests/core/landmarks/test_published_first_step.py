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
    PAPER_RADII_M,
    bar_radii,
    circle_centres,
    distance_to_paths,
    estimate_centre,
    find_entries,
    is_in_hull,
    threshold_crossings,
    vote_centre,
)
from locatk.core.landmarks.published.study import study

NO_POSITION = np.full((1, 2), np.nan)
NO_PATHS = np.full((1, 3, 2, 2), np.nan)


NO_PATH = np.full((1, 1, 2, 2), np.nan)


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
    off = np.abs(distance[..., None] - np.array(PAPER_RADII_M)).min(axis=-1)
    assert (np.sort(off, axis=1)[:, 1] < 1e-9).all()
    # two circles a radius for each pair that is near enough
    apart = np.linalg.norm(points[:, None] - points, axis=-1)[np.triu_indices(count, 1)]
    assert len(centres) == sum(2 * int((apart < 2 * r).sum()) for r in PAPER_RADII_M)


@given(st.integers(3, 7), st.integers(0, 2**32 - 1))
def test_the_hull_is_scipys(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, positions = rng.uniform(-1, 1, (count, 2)), rng.uniform(-1, 1, (50, 2))
    expected = Delaunay(points).find_simplex(positions) >= 0
    padded = np.concatenate([points, np.full((2, 2), np.nan)])
    assert (is_in_hull(points, positions) == expected).all()
    assert (is_in_hull(padded, positions) == expected).all()


def test_two_points_have_no_hull() -> None:
    assert not is_in_hull(np.array([[-1.0, 0], [1, 0]]), np.zeros((1, 2))).any()


def test_distance_from_segments_equals_that_from_their_points() -> None:
    rng = np.random.default_rng(4)
    ways = rng.uniform(-1, 1, (2, 4, 2))
    ways[1, 2:] = np.nan
    positions = rng.uniform(-1, 1, (30, 2))
    fraction = np.linspace(0, 1, 4001)[:, None]
    joined = [a + fraction * (b - a) for a, b in zip(ways[0, :-1], ways[0, 1:], strict=True)]
    joined.append(ways[1, 0] + fraction * (ways[1, 1] - ways[1, 0]))
    every = np.concatenate(joined)
    expected = np.linalg.norm(positions[:, None] - every, axis=-1).min(axis=1)
    assert np.allclose(distance_to_paths(ways, positions), expected, atol=1e-5)
    assert np.isinf(distance_to_paths(np.full((1, 3, 2), np.nan), positions)).all()


@pytest.mark.parametrize("rule", ["literal", "corrected"])
def test_one_line_gives_the_centre_of_a_circle(rule: str) -> None:
    # The right sensor's line is 30 mm left of the centre; the others run farther left.
    points = np.array([chord(0.03, 0.05)])
    silent = NO_PATHS.copy()
    silent[0, 0], silent[0, 1] = [[-0.2, 0.055], [0.2, 0.055]], [[-0.2, 0.08], [0.2, 0.08]]
    robot = np.array([[0.0, 0.055]])
    centre = estimate_centre(points, silent, robot, (0.05, 0.05), rule)  # type: ignore[arg-type]
    assert np.allclose(centre, 0, atol=1e-12)


def test_two_lines_on_one_side_need_the_corrected_rule() -> None:
    # Robot 35 mm beside the centre: lines at 10 and 35 mm hit, that at 60 mm does not.
    points = np.array([chord(0.010, 0.05) + chord(0.035, 0.05)])
    silent = NO_PATHS.copy()
    silent[0, 0] = [[-0.2, 0.060], [0.2, 0.060]]
    robot = np.array([[0.0, 0.035]])
    assert not is_in_hull(points[0], np.zeros((1, 2)))
    literal = estimate_centre(points, silent, robot, (0.05, 0.05), "literal")
    corrected = estimate_centre(points, silent, robot, (0.05, 0.05), "corrected")
    assert not np.hypot(*literal[0]) < 0.010
    assert np.hypot(*corrected[0]) < 0.005


def test_all_lines_hit() -> None:
    points = np.array([chord(-0.025, 0.05) + chord(0, 0.05) + chord(0.025, 0.05)])
    centre = estimate_centre(points, NO_PATHS, NO_POSITION, (0.05, 0.05))
    assert np.allclose(centre, 0, atol=1e-12)


@pytest.mark.parametrize("count", [0, 1])
def test_too_few_entries(count: int) -> None:
    points = np.zeros((1, count, 2))
    assert np.isnan(estimate_centre(points, NO_PATHS, NO_POSITION)).all()
    assert np.isnan(estimate_centre(points, np.empty((1, 0, 0, 2)), NO_POSITION)).all()


def test_radii_of_the_default_bars_are_the_papers() -> None:
    r1, r2 = bar_radii(Geometry())
    assert abs(r1 - 0.045) < 0.001
    assert abs(r2 - 0.054) < 0.001


def test_a_threshold_that_no_field_reaches() -> None:
    with pytest.raises(DegenerateError, match="no field of 900 mT"):
        bar_radii(replace(Geometry(), threshold_t=0.9))


# ---- entries


def straight(count: int, aside: float) -> np.ndarray:
    """Ways (count, 1, 2) of one sensor, 10 mm a sample along x."""
    return np.stack([np.arange(count) * 0.01, np.full(count, aside)], -1)[:, None]


@pytest.mark.slow
@given(
    st.lists(st.sampled_from([-9.0, -7.0, -2.0, 0.0, 1.0, 4.0, 6.0, 8.0]), min_size=2, max_size=30)
)
def test_crossings_are_interpolated_at_the_threshold(values: list) -> None:
    value = np.array(values)
    position = straight(len(value), 0.0)[:, 0]
    point, rising = threshold_crossings(position, value, 5.0)
    size = np.interp(point[:, 0], position[:, 0], np.abs(value))
    assert np.allclose(size, 5.0, atol=1e-9)
    assert (rising[1:] != rising[:-1]).all()
    assert len(point) == np.sum((np.abs(value[1:]) >= 5) != (np.abs(value[:-1]) >= 5))


def test_missing_samples_are_passed_over() -> None:
    position = straight(5, 0.0)[:, 0]
    point, rising = threshold_crossings(position, np.array([0.0, np.nan, 4.0, np.nan, 0.0]), 1.0)
    assert np.allclose(point, [[0.005, 0.0], [0.035, 0.0]])
    assert rising.tolist() == [True, False]


def test_of_several_crossings_the_outermost_count() -> None:
    value = np.array([0, 4, 0, -4, 0, 0, 4, 0.0])
    observed = find_entries(straight(8, 0.0), value[:, None], 2.0)
    assert np.allclose(observed.point_m, [[0.005, 0], [0.065, 0]])
    assert observed.silent_m.shape[0] == 0
    assert np.allclose(observed.robot_m, [(0.01 + 0.03 + 0.06) / 3, 0.0])


def test_a_pass_that_begins_inside_has_no_entry_there() -> None:
    observed = find_entries(straight(4, 0.0), np.array([[4.0], [4.0], [0.0], [0.0]]), 2.0)
    assert np.allclose(observed.point_m, [[0.015, 0.0]])


def test_a_pass_that_ends_inside_has_no_exit() -> None:
    field = np.array([0.0, 4.0, 0.0, 0.0, 4.0, 4.0])
    observed = find_entries(straight(6, 0.0), field[:, None], 2.0)
    assert np.allclose(observed.point_m, [[0.005, 0.0]])


def test_front_and_rear_give_one_entry_and_silent_sensors_their_way() -> None:
    field = np.array([0, 4, 4, 0, 0, 0.0])
    dead = np.full(6, np.nan)
    position = np.concatenate(
        [straight(6, 0.0), straight(6, 0.0) - [0.02, 0], straight(6, 0.025), straight(6, 0.05)],
        axis=1,
    )
    values = np.column_stack([field, np.roll(field, 2), 0 * field, dead])
    observed = find_entries(position, values, 2.0)
    assert np.allclose(observed.point_m, [[0.005, 0], [0.025, 0]])
    # the dead sensor was not silent: it would have told nothing anyway
    assert observed.silent_m.shape[0] == 1
    path = observed.silent_m[0]
    assert np.allclose(path[~np.isnan(path[:, 0])], position[:, 2])


def test_no_crossing() -> None:
    observed = find_entries(straight(4, 0.0), np.zeros((4, 1)), 2.0)
    assert observed.point_m.shape == (0, 2)
    assert np.isnan(observed.robot_m).all()


# ---- voting


def test_points_of_one_circle_give_its_centre() -> None:
    angle = np.array([0.1, 1.3, 2.2, 4.0, 5.5])
    points = 0.045 * np.stack([np.cos(angle), np.sin(angle)], -1)[None] + [0.3, -0.2]
    centre = vote_centre(points, NO_PATH, (0.045, 0.054))
    # Other circles through two of them that agree within 3 mm are averaged in.
    assert np.hypot(*(centre[0] - [0.3, -0.2])) < 0.002


def test_a_silent_sensor_takes_one_of_two_sides() -> None:
    points = np.array([[[-0.04, 0.03], [0.04, 0.03]]])
    silent = np.array([[[[-0.1, 0.055], [0.1, 0.055]]]])
    assert np.allclose(vote_centre(points, silent, (0.05, 0.05)), 0, atol=1e-9)
    assert np.allclose(vote_centre(points, NO_PATH, (0.05, 0.05)), [0, 0.03], atol=1e-9)


def test_without_circles_there_is_no_centre() -> None:
    assert np.isnan(vote_centre(np.zeros((1, 1, 2)), NO_PATH)).all()
    assert np.isnan(vote_centre(np.array([[[0, 0], [0.2, 0]]]), NO_PATH)).all()


@pytest.mark.slow
def test_voting_beats_the_papers_rules_on_half_discs() -> None:
    # mean 6.18 against 6.94 mm, SD 2.38 against 3.09
    voted, rescaled = (study(3, method=m).figures() for m in ("voting", "corrected"))
    assert abs(voted["mean_mm"] - 6.18) < 0.3
    assert voted["mean_mm"] < rescaled["mean_mm"]
    assert voted["sd_mm"] < rescaled["sd_mm"]
