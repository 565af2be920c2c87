"""Visibility of stations, compared with samples along the rays and with thrown robots."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.geometry import rotation_exp
from locatk.core.lighthouse.design.visibility import (
    blocked_fraction,
    faces,
    has_line_of_sight,
    in_field_of_view,
)
from locatk.core.lighthouse.room import Obstacle, RobotSize, Room
from locatk.core.polygons import is_inside, rectangle, signed_area

SAMPLES = 1001


def inside_polygon(point: np.ndarray, outline: np.ndarray) -> np.ndarray:
    """Sum the angles under which the edges are seen: 2 pi inside, 0 outside."""
    a = outline - point[..., None, :]
    b = np.roll(outline, -1, axis=0) - point[..., None, :]
    cross = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    angle = np.arctan2(cross, np.sum(a * b, axis=-1)).sum(axis=-1)
    return np.abs(angle) > np.pi


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6))
def test_line_of_sight_is_that_of_samples_along_the_ray(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(4, 9))
    angle = 2 * np.pi * (np.arange(n) + rng.uniform(-0.3, 0.3, n)) / n
    outline = (rng.uniform(1.5, 5, n) * [np.cos(angle), np.sin(angle)]).T
    obstacles = tuple(
        Obstacle(
            rectangle(*rng.uniform(0.2, 1.0, 2), tuple(rng.uniform(-2, 1, 2))),
            low := rng.uniform(0, 1),
            low + rng.uniform(0.2, 1.5),
        )
        for _ in range(2)
    )
    room = Room(outline, 3.0, obstacles=obstacles)

    def draw(count: int) -> np.ndarray:
        xy = rng.uniform(-4, 4, (400, 2))
        xy = xy[inside_polygon(xy, outline)][:count]
        return np.column_stack([xy, rng.uniform(0, 3, len(xy))])

    stations, points = draw(3), draw(8)
    seen = has_line_of_sight(room, stations, points)
    fraction = np.linspace(0, 1, SAMPLES)[1:-1, None]
    for i, station in enumerate(stations):
        for j, point in enumerate(points):
            ray = station + fraction * (point - station)
            outside = ~inside_polygon(ray[:, :2], outline)
            blocked = outside.sum()
            for each in obstacles:
                in_prism = inside_polygon(ray[:, :2], each.outline_m)
                in_prism &= (ray[:, 2] > each.low_m) & (ray[:, 2] < each.high_m)
                blocked += in_prism.sum()
            if blocked > 4:
                assert not seen[i, j]
            elif blocked == 0 and not seen[i, j]:
                # A passage shorter than the distance of two samples.
                fine = station + rng.uniform(0, 1, (50_000, 1)) * (point - station)
                hidden = ~inside_polygon(fine[:, :2], outline)
                for each in obstacles:
                    in_prism = inside_polygon(fine[:, :2], each.outline_m)
                    hidden |= in_prism & (fine[:, 2] > each.low_m) & (fine[:, 2] < each.high_m)
                assert hidden.any() or blocked > 0


def test_polygons_contain_what_the_angle_sum_says() -> None:
    rng = np.random.default_rng(1)
    outline = np.array([[0, 0], [4, 0], [4, 1], [1, 1], [1, 3], [0, 3]], float)
    points = rng.uniform(-1, 5, (2000, 2))
    assert np.array_equal(is_inside(outline, points), inside_polygon(points, outline))


def test_obstacle_above_the_ray_and_below_it_hide_nothing() -> None:
    station, point = np.array([[0.5, 2.0, 2.0]]), np.array([[3.5, 2.0, 0.0]])
    column = rectangle(0.4, 0.4, (1.8, 1.8))
    for low, high, is_seen in ((0.0, 0.8, True), (1.2, 2.9, True), (0.0, 1.2, False)):
        room = Room(rectangle(4, 4), 3.0, obstacles=(Obstacle(column, low, high),))
        assert has_line_of_sight(room, station, point)[0, 0] == is_seen


def test_field_of_view_and_range_end_where_they_are_stated() -> None:
    rotation = rotation_exp([0.2, -0.4, 1.0])[None]
    position = np.array([[1.0, 2.0, 3.0]])

    def seen(azimuth_deg: float, elevation_deg: float, distance: float) -> bool:
        a, e = np.radians([azimuth_deg, elevation_deg])
        local = distance * np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        point = position + local @ rotation[0].T
        return bool(in_field_of_view(position, rotation, point)[0, 0])

    assert seen(74.9, 0, 5)
    assert seen(-74.9, 54.9, 5)
    assert seen(0, -54.9, 6.99)
    assert not seen(75.1, 0, 5)
    assert not seen(0, 55.1, 5)
    assert not seen(10, 10, 7.01)
    assert not seen(180, 0, 1)


def test_photodiodes_that_face_up_see_stations_above_them() -> None:
    seen = faces(np.array([[0, 0, 1.0]]), np.array([[5.0, 5, 0.9], [5.0, 5, 1.1]]))
    assert seen.tolist() == [[True, False]]


@pytest.mark.parametrize(("photodiode_m", "distance_m"), [(0.05, 2.0), (0.02, 2.4), (0.3, 2.0)])
def test_fraction_of_blocked_rays_is_that_of_thrown_robots(
    photodiode_m: float, distance_m: float
) -> None:
    rng = np.random.default_rng(2)
    robots = RobotSize(10, 0.15, 0.25)
    size = np.array([6.0, 5.0])
    point = np.array([3.0, 2.5, photodiode_m])
    station = point + [distance_m * np.cos(0.7), distance_m * np.sin(0.7), 0.5]
    area = signed_area(rectangle(*size))
    predicted = blocked_fraction(robots, area, station[None], point[None])[0, 0]

    trials = 20_000
    centre = rng.uniform(0, 1, (trials, robots.count - 1, 2)) * size
    while True:
        is_own = np.linalg.norm(centre - point[:2], axis=-1) < 2 * robots.radius_m
        if not is_own.any():
            break
        centre[is_own] = rng.uniform(0, 1, (is_own.sum(), 2)) * size
    along = station - point
    # The part of the ray that is below the robots' height.
    part = np.clip((robots.height_m - photodiode_m) / along[2], 0, 1) * along[:2]
    offset = centre - point[:2]
    fraction = np.clip(offset @ part / max(part @ part, 1e-12), 0, 1)
    distance = np.linalg.norm(offset - fraction[..., None] * part, axis=-1)
    blocked = (distance < robots.radius_m).any(axis=1) & bool(part @ part)
    sigma = np.sqrt(predicted * (1 - predicted) / trials)
    assert blocked.mean() == pytest.approx(predicted, abs=4 * sigma + 1e-12)


def test_a_single_robot_hides_nothing() -> None:
    station, point = np.array([[3.0, 0, 2.0]]), np.array([[0.0, 0, 0]])
    assert blocked_fraction(RobotSize(1), 10.0, station, point)[0, 0] == 0.0
    assert blocked_fraction(RobotSize(9), 10.0, station, point)[0, 0] > 0.0
