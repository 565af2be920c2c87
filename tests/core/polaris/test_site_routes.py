"""Accuracy of a pass, forecasts along routes and spacing of tags, by Monte Carlo and geometry."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.polaris.design.planning import ReadingConditions
from locatk.core.polaris.design.routes import (
    find_tag_passes,
    forecast_routes,
    laying_sigma,
    path_covariance,
    plan_route,
    points_along_route,
    spacing_for_accuracy,
    tag_fix_covariance,
)
from locatk.core.polaris.design.site import MAX_SITE_TAGS, SitePoint, pass_separation
from locatk.core.polaris.tag import AsBuiltTag, PlanarPose, Tags
from locatk.core.routes import Route
from locatk.core.streaming.planar_filter import OdometryNoise

Array = NDArray[np.float64]

PERFECT = OdometryNoise(
    scale=0, rotation_scale=0, drift_rad_per_m=0, distance_m=0, heading_rad=0, rotation_rad=0,
    slip_m=0, slip_rad=0,
)  # fmt: skip

SILENT = ReadingConditions(noise_t=1e-12)
"""Without noise of the sensors."""


def aisle(spacing_m: float, count: int) -> Tags:
    """Tags in a row along x, from the origin."""
    site = {k: PlanarPose(k * spacing_m, 0.0, 0.0) for k in range(count)}
    return Tags(site=site)


# ---- one pass


def test_path_covariance_by_monte_carlo() -> None:
    """Headings with a drift and a random walk, integrated in steps of 1 mm from the middle."""
    rng = np.random.default_rng(5)
    along = np.array([-0.04, -0.02, 0.0, 0.03, 0.05])
    noise = replace(PERFECT, drift_rad_per_m=0.05, heading_rad=0.03, scale=0.02)
    draws, step, steps = 20_000, 1e-3, 50
    drift = noise.drift_rad_per_m * rng.normal(size=(draws, 1))
    scale = noise.scale * rng.normal(size=draws)
    found = np.zeros((draws, len(along), 3))
    for side in (-1, 1):
        walk = noise.heading_rad * math.sqrt(step) * rng.normal(size=(draws, steps))
        heading = np.cumsum(side * drift * step + walk, axis=1)
        heading = np.concatenate([np.zeros((draws, 1)), heading], axis=1)
        across = np.cumsum((heading[:, 1:] + heading[:, :-1]) / 2 * side * step, axis=1)
        for k in np.flatnonzero(side * along > 0):
            row = round(abs(along[k]) / step)
            found[:, k] = np.column_stack([scale * along[k], across[:, row - 1], heading[:, row]])
    expected = path_covariance(along, noise, has_scale=True)
    sigma = np.sqrt(np.diag(expected))
    sigma[sigma == 0] = 1.0
    actual = np.cov(found.reshape(draws, -1).T)
    assert actual / np.outer(sigma, sigma) == pytest.approx(
        expected / np.outer(sigma, sigma), abs=0.04
    )
    without = path_covariance(along, noise, has_scale=False)
    assert without[0::3].max() == 0


def test_fix_covariance_by_monte_carlo() -> None:
    """Grids with displaced magnets on displaced tags, fitted by singular values."""
    tags, laying, build = Tags(), (2e-3, 0.01), 5e-4
    heading, left, draws = math.radians(30), 0.02, 30_000
    expected = tag_fix_covariance(
        tags, SILENT, tag_id=202517, heading_rad=heading, offset_m=left, laying=laying,
        build_m=build, noise=PERFECT,
    )  # fmt: skip
    rng = np.random.default_rng(1)
    # Id 202517 has magnets on v1, v2, v3 and on the cells (0, 1) and (1, 2).
    cells = 0.04 * np.array([[-1, 1], [0, 1], [1, 1], [1, 0], [1, -1]])
    turn = np.array(
        [[math.cos(heading), -math.sin(heading)], [math.sin(heading), math.cos(heading)]]
    )
    # The site has the axes of the tag as designed; its error moves the tag, not the array.
    tag_error = rng.normal(size=(draws, 3)) * [laying[0], laying[0], laying[1]]
    magnets = cells @ turn.T + [0.0, left] + build * rng.normal(size=(draws, 5, 2))
    centre, mean = magnets.mean(axis=1), cells.mean(axis=0)
    cross = np.einsum("nki,kj->nij", magnets - centre[:, None], cells - mean)
    angle = np.arctan2(cross[:, 1, 0] - cross[:, 0, 1], cross[:, 0, 0] + cross[:, 1, 1])
    rotation = np.exp(1j * angle)
    tag = (centre @ [1, 1j]) - rotation * (mean @ [1, 1j])
    # Pose of the array in the tag's frame as measured and as it is, then in the array's axes.
    measured = -tag / rotation
    is_laid = np.exp(-1j * tag_error[:, 2])
    true = -1j * left * np.exp(-1j * heading)
    array_site = measured
    true_site = (true / is_laid) + tag_error[:, :2] @ [1, 1j]
    error = (array_site - true_site) * np.exp(1j * heading)
    heading_error = -angle - (tag_error[:, 2] - heading)
    found = np.cov(np.column_stack([error.real, error.imag, heading_error]).T)
    sigma = np.sqrt(np.diag(expected))
    assert found / np.outer(sigma, sigma) == pytest.approx(
        expected / np.outer(sigma, sigma), abs=0.05
    )


def test_what_is_known_of_a_tag_is_used() -> None:
    built = AsBuiltTag(np.zeros((5, 2)), np.zeros(5), 3)
    sigma = {202517: (1e-4, 1e-4, 1e-3)}
    site = {202517: PlanarPose(0, 0, 0), 0: PlanarPose(1, 0, 0)}
    tags = Tags(built={202517: built}, site=site, site_sigma=sigma)
    known = tag_fix_covariance(tags, tag_id=202517)
    other = tag_fix_covariance(tags, tag_id=0)
    assert np.sqrt(np.diag(known)).max() < 1.6e-3
    assert math.sqrt(other[2, 2]) == pytest.approx(laying_sigma(tags)[1], rel=0.1)
    by_field = tag_fix_covariance(tags, tag_id=202517, has_odometry=False)
    assert by_field[0, 0] > known[0, 0]
    one_sensor = ReadingConditions(sensors=1, speed_mps=1e4)
    with pytest.raises(InputError, match="do not determine"):
        tag_fix_covariance(tags, one_sensor)


@pytest.mark.parametrize("tag_rad", [0.0, math.pi / 2, 2.5])
def test_errors_of_a_site_are_along_its_axes(tag_rad: float) -> None:
    """Along x of the site, whatever the heading of the tag; along y, the tag is exact."""
    tags = Tags(site={7: PlanarPose(0, 0, tag_rad)}, site_sigma={7: (0.02, 0.0, 0.0)})
    exact = replace(tags, site_sigma={7: (0.0, 0.0, 0.0)})
    for route_rad in (0.0, math.pi / 2):
        relative = tag_rad - route_rad
        with_errors, without = (
            tag_fix_covariance(each, tag_id=7, heading_rad=relative) for each in (tags, exact)
        )
        forward, left = math.cos(route_rad), -math.sin(route_rad)
        expected = 0.02**2 * np.outer([forward, left], [forward, left])
        assert (with_errors - without)[:2, :2] == pytest.approx(expected, abs=1e-9)


# ---- passes


@settings(max_examples=60, deadline=None)
@given(
    x=st.floats(-0.3, 1.3),
    y=st.floats(-0.15, 0.15),
    angle=st.floats(-math.pi, math.pi),
    direction=st.floats(-math.pi, math.pi),
)
@example(0.05, 0.04, 0.0, 0.5)
def test_a_tag_counts_if_its_corners_pass_below_the_bar(
    x: float, y: float, angle: float, direction: float
) -> None:
    turn = np.exp(1j * direction)
    end = 1.0 * turn
    place = (x + 1j * y) * turn
    tags = Tags(site={7: PlanarPose(place.real, place.imag, angle)})
    route = Route(np.array([[0.0, 0.0], [end.real, end.imag]]))
    corners = place + 0.04 * np.array([1 + 1j, 1 - 1j, -1 + 1j, -1 - 1j]) * np.exp(1j * angle)
    local = corners / turn
    margin = np.concatenate([0.08 - np.abs(local.imag), local.real, 1 - local.real]).min()
    if abs(margin) < 1e-6:
        return
    passes = find_tag_passes(tags, route)
    assert bool(passes) == (margin > 0)
    if passes:
        (one,) = passes
        assert one.distance_m == pytest.approx(x)
        assert one.offset_m == pytest.approx(y)
        assert 0 <= one.play_m <= 0.08 - np.abs(local.imag).max() + 1e-9
        assert math.remainder(one.heading_rad - angle + direction, math.tau) == pytest.approx(
            0, abs=1e-9
        )


def test_turns_over_a_tag_and_ways_back() -> None:
    tags = Tags(site={1: PlanarPose(1, 0, 0)})
    straight = Route(np.array([[0.0, 0], [1, 0], [2, 0]]))
    assert [each.distance_m for each in find_tag_passes(tags, straight)] == [1.0]
    near = Tags(site={1: PlanarPose(1 - 1e-9, 0.01, 0), 2: PlanarPose(1 + 1e-9, -0.01, 0)})
    bend = Route(np.array([[0.0, 0], [1, 0], [2, 0.1]]))
    assert sorted(each.tag_id for each in find_tag_passes(near, bend)) == [1, 2]
    corner = Route(np.array([[0.0, 0], [1, 0], [1, 1]]))
    assert find_tag_passes(tags, corner) == []
    back = Route(np.array([[0.0, 0], [2, 0], [0, 0]]))
    passes = find_tag_passes(tags, back)
    assert [each.distance_m for each in passes] == [1.0, 3.0]
    assert abs(passes[1].heading_rad) == pytest.approx(math.pi)
    assert find_tag_passes(tags, Route(np.array([[1.0, 0], [2, 0]]))) == []


# ---- forecasts


def test_forecast_of_an_aisle() -> None:
    route = Route(np.array([[-0.5, 0.0], [4.5, 0.0]]))
    dense, sparse = (forecast_routes(aisle(s, n), [route]) for s, n in ((0.5, 9), (1.0, 5)))
    assert (dense.tags, sparse.tags) == (9, 5)
    assert dense.longest_gap_m == pytest.approx(0.5)
    assert sparse.longest_gap_m == pytest.approx(1.0)
    assert dense.position_p95_m < sparse.position_p95_m
    assert dense.covered_fraction == pytest.approx(0.9, abs=0.01)
    assert sparse.worst_position_p95_m > sparse.position_p95_m
    # The drift of the odometry is unknown up to the first gap.
    assert sparse.worst_m == pytest.approx([1.0, 0.0], abs=0.06)
    smoothed = forecast_routes(aisle(1.0, 5), [route], is_smoothed=True)
    assert smoothed.position_p95_m < sparse.position_p95_m
    assert smoothed.covered_fraction == 1.0
    both = forecast_routes(aisle(1.0, 5), [route, route])
    assert both.length_m == 10
    assert both.tags == 5
    assert both.position_p95_m == pytest.approx(sparse.position_p95_m)


def test_forecast_warns_of_missed_tags_and_of_none() -> None:
    route = Route(np.array([[-0.5, 0.0], [9.5, 0.0]]), "aisle")
    far = forecast_routes(aisle(3.0, 4), [route])
    assert "may be missed" in far.warnings[0]
    assert far.warnings[0].startswith("on route aisle, ")
    beside = forecast_routes(aisle(1.0, 5), [Route(np.array([[0.0, 0.3], [4.0, 0.3]]))])
    assert "no tag passes wholly" in beside.warnings[0]
    assert beside.tags == 0
    assert beside.covered_fraction == 0
    assert math.isinf(beside.position_p95_m)
    assert np.isnan(beside.worst_m).all()
    with pytest.raises(InputError):
        forecast_routes(aisle(1.0, 2), [])


# ---- spacing


@pytest.mark.slow
@pytest.mark.parametrize(
    ("wanted", "limit"),
    [((0.008, math.inf), "position"), ((math.inf, math.radians(1.35)), "heading")],
)
def test_the_largest_spacing_keeps_the_accuracy(wanted: tuple[float, float], limit: str) -> None:
    tags = Tags()
    plan = spacing_for_accuracy(tags, None, None, *wanted)
    assert plan.is_feasible
    assert plan.limited_by == limit

    def errors(spacing_m: float) -> tuple[float, float]:
        route = Route(np.array([[-0.1, 0.0], [10 * spacing_m + 0.1, 0.0]]))
        forecast = forecast_routes(aisle(spacing_m, 11), [route])
        return forecast.position_p95_m, forecast.heading_p95_rad

    reached, beyond = errors(plan.spacing_m), errors(1.15 * plan.spacing_m)
    assert reached[0] <= 1.02 * wanted[0]
    assert reached[1] <= 1.02 * wanted[1]
    assert beyond[0] > wanted[0] or beyond[1] > wanted[1]


@pytest.mark.slow
def test_the_play_of_the_array_limits_the_spacing() -> None:
    wide, narrow = (
        spacing_for_accuracy(Tags(), ReadingConditions(sensors=n), None, 0.1) for n in (9, 6)
    )
    assert (wide.limited_by, narrow.limited_by) == ("play", "play")
    assert narrow.spacing_m < wide.spacing_m


@pytest.mark.slow
def test_impossible_accuracies_say_what_is_possible() -> None:
    plan = spacing_for_accuracy(Tags(), None, None, 1e-3)
    assert not plan.is_feasible
    assert plan.spacing_m == pass_separation(Tags())
    assert plan.position_p95_m > 1e-3
    assert "locatk site survey" in " ".join(plan.remedies)
    by_odometry = spacing_for_accuracy(Tags(), None, None, 1e-3, laying=(1e-5, 1e-5))
    assert not by_odometry.is_feasible
    assert "odometry" in by_odometry.remedies[0]
    weak = replace(Tags(), clearance_m=0.2)
    assert spacing_for_accuracy(weak, None, None, 0.01).limited_by == "field"
    with pytest.raises(InputError):
        spacing_for_accuracy(Tags(), None, None, 0.0)


# ---- tags along a route

CORNER = [SitePoint(0, 0), SitePoint(3, 0), SitePoint(3, 2), SitePoint(5, 2.2)]


def test_points_along_a_route_are_passed_straight() -> None:
    route, points = points_along_route(Tags(), CORNER, 0.7, 0.25)
    site = {k: PlanarPose(p.x_m, p.y_m, p.heading_rad) for k, p in enumerate(points)}
    passes = find_tag_passes(Tags(site=site), route)
    assert [each.tag_id for each in passes] == list(range(len(points)))
    gaps = np.diff([0.0, *(each.distance_m for each in passes), route.length_m])
    assert gaps.max() <= 0.7 + 1e-9
    assert gaps[1:-1].min() >= 0.25
    assert all(abs(each.heading_rad) < 1e-9 for each in passes)


def test_stations_keep_their_ids_and_tags_are_shared_by_the_way_back() -> None:
    way = [
        SitePoint(0, 0),
        SitePoint(2, 0, tag_id=5, meaning="stop"),
        SitePoint(4, 0),
        SitePoint(0, 0),
    ]
    _, points = points_along_route(Tags(), way, 0.8, 0.25)
    assert [p.tag_id for p in points if p.tag_id is not None] == [5]
    place = np.array([[p.x_m, p.y_m] for p in points])
    distance = np.hypot(*(place[:, None] - place).T) + np.eye(len(place))
    assert distance.min() >= 0.12 - 1e-9
    with pytest.raises(InputError):
        points_along_route(Tags(), [SitePoint(0, 0), SitePoint(0, 0)], 1.0)


def test_a_route_that_needs_too_many_tags_is_impossible_but_no_error() -> None:
    """Each leg of the zigzag takes a tag, although its length would need fewer."""
    zigzag = [SitePoint(0.25 * k, 0.5 * (k % 2)) for k in range(MAX_SITE_TAGS + 3)]
    points, plan = plan_route(Tags(), zigzag, None, None, 0.02)
    assert (points, plan.is_feasible, plan.limited_by) == ([], False, "count")
    assert "divide the route" in plan.remedies[0]


@pytest.mark.slow
def test_a_planned_route_has_the_accuracy() -> None:
    noise = OdometryNoise(rotation_scale=0.1)
    points, plan = plan_route(Tags(), CORNER, None, noise, 0.009)
    assert plan.is_feasible
    site = {k: PlanarPose(p.x_m, p.y_m, p.heading_rad) for k, p in enumerate(points)}
    route = Route(np.array([[p.x_m, p.y_m] for p in CORNER]))
    forecast = forecast_routes(Tags(site=site), [route], None, noise)
    assert forecast.position_p95_m <= 0.009
    assert forecast.position_p95_m == pytest.approx(plan.position_p95_m)
    assert not forecast.warnings
