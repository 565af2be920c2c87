"""Accuracy along a route, against simulated drives and the live filter."""

from __future__ import annotations

import math

import numpy as np
import pytest

from locatk.core.error_quantiles import error_quantile
from locatk.core.errors import InputError
from locatk.core.routes import Route, RouteFix, predict_accuracy
from locatk.core.streaming.planar_filter import OdometryNoise, PlanarFilter

FIX = np.diag([1e-3, 2e-3, 0.01]) ** 2
L_ROUTE = Route(np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 2.0]]))


def drive(rng: np.random.Generator, noise: OdometryNoise, fix_error: np.ndarray) -> np.ndarray:
    """Return the error (x, y, heading) in the vehicle's axes after L_ROUTE, by dead reckoning.

    The vehicle follows the route exactly; the odometry measures it with errors.
    """
    scale, turn = rng.normal(0, noise.scale), rng.normal(0, noise.rotation_scale)
    drift = rng.normal(0, noise.drift_rad_per_m)
    x, y, heading = -fix_error
    step = 0.01
    for number, length in enumerate(L_ROUTE.segment_m):
        if number:
            heading += math.pi / 2 * (1 - turn) + rng.normal(
                0, noise.rotation_rad * math.sqrt(math.pi / 2)
            )
        for _ in range(round(length / step)):
            sigma = math.sqrt(step)
            heading += -drift * step + rng.normal(0, noise.heading_rad * sigma)
            along = step * (1 - scale) + rng.normal(0, noise.distance_m * sigma)
            across = rng.normal(0, noise.distance_m * sigma)
            x += math.cos(heading) * along - math.sin(heading) * across
            y += math.sin(heading) * along + math.cos(heading) * across
    dx, dy = 3.0 - x, 2.0 - y
    # The last heading of the route is along y: forward is y, left is -x.
    return np.array([dy, -dx, math.pi / 2 - heading])


def test_covariance_of_dead_reckoning_is_that_of_simulated_drives() -> None:
    # Of a better odometry than the default, whose errors are not small after 5 m.
    noise = OdometryNoise(drift_rad_per_m=0.01, slip_m=0.0, slip_rad=0.0)
    rng = np.random.default_rng(1)
    errors = np.array(
        [drive(rng, noise, rng.multivariate_normal(np.zeros(3), FIX)) for _ in range(600)]
    )
    predicted = predict_accuracy(L_ROUTE, [RouteFix(0.0, FIX)], noise).covariance[-1]
    measured = errors.T @ errors / len(errors)
    whitened = np.linalg.inv(np.linalg.cholesky(predicted))
    np.testing.assert_allclose(whitened @ measured @ whitened.T, np.eye(3), atol=0.25)


def test_straight_route_is_that_of_the_live_filter() -> None:
    live = PlanarFilter()
    state, covariance = live.unknown_state()
    fix = np.concatenate([[0.0, 0.0, 0.0], FIX.ravel(), [3.0, 0.0]])
    state, covariance = live.update(state, covariance, fix, 0.0)
    for _ in range(200):
        motion = np.array([0.01, 0.0, 0.0, np.nan])
        state, covariance = live.propagate(state, covariance, motion, 0.01 / 0.3)
    route = Route(np.array([[0.0, 0.0], [2.0, 0.0]]))
    predicted = predict_accuracy(route, [RouteFix(0.0, FIX)]).covariance[-1]
    np.testing.assert_allclose(predicted, covariance[:3, :3], rtol=2e-3, atol=1e-9)


@pytest.mark.parametrize("is_smoothed", [False, True])
def test_covariances_do_not_depend_on_the_step(is_smoothed: bool) -> None:
    fixes = [RouteFix(0.5, FIX), RouteFix(4.0, FIX)]
    coarse, fine = (
        predict_accuracy(L_ROUTE, fixes, step_m=step, is_smoothed=is_smoothed)
        for step in (0.5, 0.02)
    )
    for distance in (1.0, 3.0, 3.5, 5.0):
        pair = [
            accuracy.covariance[np.isclose(accuracy.distance_m, distance)][-1]
            for accuracy in (coarse, fine)
        ]
        np.testing.assert_allclose(pair[0], pair[1], rtol=1e-5, atol=1e-12)


def test_smoothing_equals_the_batch_estimate() -> None:
    # One straight segment without constant errors: position and heading at the middle, given fixes
    # at both ends, from the joint covariance of all three.
    noise = OdometryNoise(scale=0.0, rotation_scale=0.0, drift_rad_per_m=0.0)
    route = Route(np.array([[0.0, 0.0], [2.0, 0.0]]))
    ends = [RouteFix(0.0, FIX), RouteFix(2.0, FIX)]
    smoothed = predict_accuracy(route, ends, noise, is_smoothed=True)
    middle = smoothed.covariance[np.isclose(smoothed.distance_m, 1.0)][0]
    from_start = predict_accuracy(route, ends[:1], noise)
    at_middle = from_start.covariance[np.isclose(from_start.distance_m, 1.0)][0]
    at_end = from_start.covariance[-1]
    motion = np.eye(3)
    motion[1, 2] = 1.0
    cross = at_middle @ motion.T
    expected = at_middle - cross @ np.linalg.inv(at_end + FIX) @ cross.T
    np.testing.assert_allclose(middle, expected, rtol=1e-6, atol=1e-15)
    np.testing.assert_allclose(
        smoothed.covariance[-1],
        at_end - at_end @ np.linalg.inv(at_end + FIX) @ at_end,
        rtol=1e-6,
        atol=1e-15,
    )


def test_pose_is_unknown_before_the_first_fix_unless_smoothed() -> None:
    fixes = [RouteFix(2.0, FIX)]
    live, offline = (
        predict_accuracy(L_ROUTE, fixes, is_smoothed=smoothed) for smoothed in (False, True)
    )
    is_known = np.isfinite(live.heading_sigma_rad)
    assert live.weight_m[is_known].sum() == pytest.approx(3.0)
    assert np.isfinite(offline.heading_sigma_rad).all()
    assert live.longest_without_fix_m == pytest.approx(3.0)
    assert live.quantiles(0.95) == (math.inf, math.inf)
    assert live.quantiles(0.3)[0] < offline.quantiles(0.95)[0] < 1.0


def test_fix_of_the_position_only_updates_a_known_pose() -> None:
    position = np.diag([1e-6, 1e-6, np.inf])
    fixes = [RouteFix(0.0, FIX), RouteFix(2.0, position)]
    accuracy = predict_accuracy(L_ROUTE, fixes)
    after = accuracy.covariance[(accuracy.distance_m == 2.0)][-1]
    before = accuracy.covariance[(accuracy.distance_m == 2.0)][0]
    assert after[1, 1] < 1.1e-6 < before[1, 1]
    assert after[2, 2] < before[2, 2]
    alone = predict_accuracy(L_ROUTE, [RouteFix(0.0, position)])
    assert np.isnan(alone.heading_sigma_rad).all()


def test_position_and_heading_along_a_route() -> None:
    position, heading = L_ROUTE.at(np.array([0.0, 1.0, 3.0, 4.5]))
    np.testing.assert_allclose(position, [[0, 0], [1, 0], [3, 0], [3, 1.5]], atol=1e-12)
    np.testing.assert_allclose(heading, [0, 0, math.pi / 2, math.pi / 2])


@pytest.mark.parametrize(
    ("waypoints", "message"),
    [
        ([[0, 0]], "one waypoint"),
        ([[0, 0], [1, 0], [1, 0]], "2 and 3"),
        ([[0, 0], [np.nan, 1]], "finite"),
    ],
)
def test_bad_routes_are_refused(waypoints: list[list[float]], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Route(np.array(waypoints, float))


@pytest.mark.parametrize("size", [1, 2, 3])
def test_error_quantile_is_that_of_drawn_errors(size: int) -> None:
    rng = np.random.default_rng(size)
    roots = [rng.normal(size=(size, size)), 3 * np.diag([1.0, 1e-3, 0.3][:size])]
    errors = np.concatenate(
        [
            rng.normal(size=(count, size)) @ root.T
            for root, count in zip(roots, (300_000, 100_000), strict=True)
        ]
    )
    measured = np.quantile(np.linalg.norm(errors, axis=1), 0.95)
    predicted = error_quantile([root @ root.T for root in roots], 0.95, [3.0, 1.0])
    assert predicted == pytest.approx(measured, rel=0.01)


def test_error_quantile_of_unknown_errors_is_infinite() -> None:
    assert error_quantile([[[1.0]], [[np.nan]]], 0.95) == math.inf
    assert error_quantile([[[1.0]], [[np.nan]]], 0.4) == pytest.approx(1.282, abs=1e-3)
