"""Guards of the registration of stations, each on its own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.geometry import rotation_exp
from locatk.core.lighthouse.calibration import IDEAL_CALIBRATION, MODEL_SIGMA_RAD
from locatk.core.lighthouse.scene.bundle_adjustment import BundleAdjustment, BundleState
from locatk.core.lighthouse.scene.registration import (
    MAX_RELATIVE_SIGMA,
    MIN_CROSSING_ANGLE_RAD,
    StationRegistration,
    consistent_median,
    intersect_lines,
)
from locatk.core.lighthouse.scene.two_view import StationPair, TwoViewFacts

Array = NDArray[np.float64]
PairOf = Callable[[int, int], StationPair | None]


class Triangle:
    """Three ideal stations; 0 and 1 are registered, 2 has common keyframes with single ones only.

    Keyframes are shared by the stations 0 and 1, by 0 and 2, and by 1 and 2, in turn.
    """

    def __init__(self, world: Any) -> None:
        ideal = (world.Plane(tilt=0.0), world.Plane(tilt=0.0))
        self.lamps = [replace(lamp, planes=ideal) for lamp in world.lamps(1, 2, 5)]
        self.points = world.curve(90, flat=False)
        angles = np.stack([lamp.angles(self.points) for lamp in self.lamps], axis=1)
        self.every_angle = angles.copy()
        for k in range(3):
            angles[k::3, k] = np.nan
        local = [(self.points - lamp.position) @ lamp.rotation for lamp in self.lamps]
        rays = np.stack([p / p[:, :1] for p in local], axis=1)
        self.every_ray = rays.copy()
        rays[~np.isfinite(angles[..., 0])] = np.nan
        self.angles, self.rays = angles, rays

    def pair(self, i: int, j: int, *, rotated: float = 0.0, sigma: float = 0.0) -> StationPair:
        """Return the true pair, its second station rotated, with a relative position sigma."""
        positions = np.stack([self.lamps[k].position for k in (i, j)])
        rotations = np.stack([self.lamps[k].rotation for k in (i, j)])
        rotations[1] = rotation_exp(np.array([0.0, 0.0, rotated])) @ rotations[1]
        state = BundleState(positions, rotations, (IDEAL_CALIBRATION,) * 2, np.zeros((0, 3)))
        covariance = np.zeros((2, 10, 10))
        covariance[1, 0, 0] = (sigma * np.linalg.norm(positions[1] - positions[0])) ** 2
        nothing = np.zeros((0, 2, 2))
        adjustment = BundleAdjustment(state, nothing, nothing, covariance, 1, 0.0)
        rows = np.zeros(0, np.int64)
        return StationPair((i, j), adjustment, rows, False, TwoViewFacts(0.0, 1.0))

    def registration(self) -> StationRegistration:
        return StationRegistration(
            self.angles, self.rays, (IDEAL_CALIBRATION,) * 3, self.pair(0, 1), MODEL_SIGMA_RAD
        )

    def pairs(self, *, rotated: float = 0.0, sigma: float = 0.0) -> PairOf:
        """Return the pairs of station 2; that with station 1 has the given faults."""

        def pair_of(i: int, j: int) -> StationPair | None:
            return self.pair(i, j) if i == 0 else self.pair(i, j, rotated=rotated, sigma=sigma)

        return pair_of


@pytest.fixture
def triangle(world: Any) -> Triangle:
    return Triangle(world)


def test_two_pairs_that_agree_place_a_station(triangle: Triangle) -> None:
    registration = triangle.registration()
    assert registration.register_all(triangle.pairs()) == {}
    np.testing.assert_allclose(registration.positions[2], triangle.lamps[2].position, atol=1e-3)
    np.testing.assert_allclose(registration.rotations[2], triangle.lamps[2].rotation, atol=1e-3)


@pytest.mark.parametrize(("rotated_deg", "is_combined"), [(4.0, True), (6.0, False)])
def test_two_pairs_that_disagree_on_the_rotation_are_not_combined(
    triangle: Triangle, rotated_deg: float, is_combined: bool
) -> None:
    """One of two pairs with another rotation is wrong, and so may its direction be."""
    registration = triangle.registration()
    failed = registration.register_all(triangle.pairs(rotated=np.radians(rotated_deg)))
    assert set(failed) == (set() if is_combined else {2})
    assert registration.registered == ([0, 1, 2] if is_combined else [0, 1])


@pytest.mark.parametrize("factor", [0.8, 1.2])
def test_an_inaccurate_pair_is_not_combined(triangle: Triangle, factor: float) -> None:
    registration = triangle.registration()
    failed = registration.register_all(triangle.pairs(sigma=factor * MAX_RELATIVE_SIGMA))
    assert set(failed) == (set() if factor < 1 else {2})


@pytest.mark.parametrize("count", [2, 3])
def test_a_distance_needs_three_keyframes(triangle: Triangle, count: int) -> None:
    """Station 2 has a pair with station 0 only; keyframes of all three give the distance."""
    rows = np.arange(1, 1 + 3 * count, 3)  # so far of the stations 0 and 2
    triangle.angles[rows] = triangle.every_angle[rows]
    triangle.rays[rows] = triangle.every_ray[rows]
    failed = triangle.registration().register_all(
        lambda i, j: triangle.pair(i, j) if i == 0 else None
    )
    assert set(failed) == (set() if count == 3 else {2})
    if failed:
        assert "distance is unknown" in failed[2]


def test_keyframes_of_the_pair_alone_give_no_distance(triangle: Triangle) -> None:
    """Two stations locate a keyframe in any scale if nothing checks its position."""
    rows = np.arange(1, 31, 3)
    triangle.angles[rows] = triangle.every_angle[rows]
    triangle.rays[rows] = triangle.every_ray[rows]
    registration = triangle.registration()
    estimates = registration.estimate_keyframes()
    pair = triangle.pair(0, 2)
    distance = registration._distance(pair, 0, rows, estimates)
    assert distance == pytest.approx(
        np.linalg.norm(triangle.lamps[2].position - triangle.lamps[0].position), rel=1e-3
    )
    unchecked = replace(estimates, redundancy=np.zeros(90, np.int64))
    assert registration._distance(pair, 0, rows, unchecked) is None


def test_distances_that_disagree_give_none() -> None:
    assert consistent_median(np.array([1.0, 1.01, 0.99])) == 1.0
    assert consistent_median(np.array([1.0, 1.05, 0.93, 9.0])) == pytest.approx(1.025)
    assert consistent_median(np.array([1.0, 1.3, 0.7])) is None
    assert consistent_median(np.array([1.0, 1.12, 0.88])) is None
    assert consistent_median(np.array([1.0, 1.08, 0.92])) == 1.0
    assert consistent_median(np.array([1.0, 1.0])) is None


@pytest.mark.parametrize("factor", [0.8, 1.2])
def test_directions_that_are_nearly_parallel_do_not_intersect(factor: float) -> None:
    angle = factor * MIN_CROSSING_ANGLE_RAD
    directions = np.array([[0.0, 1.0, 0.0], [np.sin(-angle), np.cos(angle), 0.0]])
    target = np.array([0.0, 1.0 / np.tan(angle), 0.0])
    point = intersect_lines(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), directions)
    if factor < 1:
        assert point is None
    else:
        np.testing.assert_allclose(point, target, atol=1e-9)


def test_an_intersection_behind_a_station_is_none() -> None:
    origins = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    away = np.array([[0.0, -1.0, 0.0], [-np.sqrt(0.5), np.sqrt(0.5), 0.0]])
    assert intersect_lines(origins, away) is None
    assert intersect_lines(origins, away * [[1, -1, 1], [1, 1, 1]]) is not None


@pytest.mark.parametrize(("size_m", "is_registered"), [(0.02, False), (0.5, True)])
def test_keyframes_in_a_small_region_do_not_register_a_station(
    triangle: Triangle, size_m: float, is_registered: bool
) -> None:
    """Keyframes of all three stations within 2 cm leave the position of the third uncertain."""
    triangle.points = np.array([0.2, 0.1, 0.4]) + size_m * np.random.default_rng(0).uniform(
        -0.5, 0.5, (30, 3)
    )
    angles = np.stack([lamp.angles(triangle.points) for lamp in triangle.lamps], axis=1)
    local = [(triangle.points - lamp.position) @ lamp.rotation for lamp in triangle.lamps]
    triangle.angles = angles
    triangle.rays = np.stack([p / p[:, :1] for p in local], axis=1)
    failed = triangle.registration().register_all(lambda i, j: None)
    assert set(failed) == (set() if is_registered else {2})
