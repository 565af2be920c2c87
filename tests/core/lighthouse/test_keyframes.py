"""Keyframes: averaged standstills, their selection and the ones held out."""

from __future__ import annotations

import numpy as np

from locatk.core.lighthouse.scene.keyframes import (
    STANDSTILL_ANGLE_RAD,
    average_standstills,
    split_held_out,
    spread_evenly,
)


def standing(places: np.ndarray, each: int, noise: float = 1e-4) -> np.ndarray:
    rng = np.random.default_rng(0)
    angles = np.repeat(places, each, axis=0)
    return angles + rng.normal(0, noise, angles.shape)


def test_each_standstill_is_a_place() -> None:
    where = np.random.default_rng(1).uniform(-0.5, 0.5, (6, 2, 2))
    places, run = average_standstills(standing(where, 50), np.zeros(300, np.int64))
    np.testing.assert_array_equal(run, np.repeat(range(6), 50))
    # The mean of fifty is sharper than one: 1e-4 / sqrt(50), four standard deviations.
    np.testing.assert_allclose(places, where, atol=6e-5)


def test_driving_gathers_nothing() -> None:
    angles = np.linspace(0, 0.5, 200)[:, None, None] * np.ones((1, 2, 2))
    places, run = average_standstills(angles, np.zeros(200, np.int64))
    np.testing.assert_array_equal(run, range(200))
    np.testing.assert_array_equal(places, angles)


def test_creeping_is_not_standing() -> None:
    # Each step is below the threshold, the whole far above it.
    angles = (np.arange(200) * STANDSTILL_ANGLE_RAD / 2)[:, None, None] * np.ones((1, 2, 2))
    places, run = average_standstills(angles, np.zeros(200, np.int64))
    assert len(places) > 50
    assert np.max(np.bincount(run)) * STANDSTILL_ANGLE_RAD / 2 < 4 * STANDSTILL_ANGLE_RAD


def test_devices_have_separate_positions() -> None:
    angles = np.zeros((10, 2, 2))
    places, run = average_standstills(angles, np.repeat([0, 1], 5))
    assert len(places) == 2
    np.testing.assert_array_equal(run, np.repeat([0, 1], 5))


def test_unobserved_planes_are_not_averaged() -> None:
    angles = np.zeros((10, 2, 2))
    angles[5:, 1] = np.nan
    places, run = average_standstills(angles, np.zeros(10, np.int64))
    np.testing.assert_array_equal(run, np.repeat([0, 1], 5))
    assert np.isfinite(places[0]).all()
    assert np.isnan(places[1, 1]).all()
    assert np.isfinite(places[1, 0]).all()


def test_nothing_is_nothing() -> None:
    places, run = average_standstills(np.zeros((0, 2, 2)), np.zeros(0, np.int64))
    assert len(places) == 0
    assert len(run) == 0


# ---- selection


ALL = np.ones((1000, 2), bool)


def test_one_kind_of_sight_is_thinned_evenly() -> None:
    chosen = spread_evenly(ALL, np.arange(1000), 100)
    assert len(chosen) == 100
    assert chosen[0] == 0
    assert chosen[-1] == 999
    assert set(np.diff(chosen)) <= {10, 11}


def test_few_places_that_link_stations_are_kept_among_many() -> None:
    seen = np.zeros((1000, 3), bool)
    seen[:, :2] = True
    seen[400:407] = [False, True, True]
    chosen = spread_evenly(seen, np.arange(1000), 100)
    assert len(chosen) == 100
    assert set(range(400, 407)) <= set(chosen.tolist())


def test_few_positions_are_all_taken() -> None:
    rows = np.array([3, 5, 900])
    np.testing.assert_array_equal(spread_evenly(ALL, rows, 3), rows)
    assert len(spread_evenly(ALL, rows[:0], 3)) == 0


def test_every_fifth_of_each_kind_is_held_out() -> None:
    seen = np.zeros((1000, 3), bool)
    seen[:, :2] = True
    seen[::10] = [False, True, True]
    taken, held = split_held_out(seen, np.arange(1000))
    assert len(held) == 200
    assert np.count_nonzero(held % 10 == 0) == 20
    np.testing.assert_array_equal(np.sort(np.r_[taken, held]), np.arange(1000))


def test_nothing_is_held_out_of_few() -> None:
    taken, held = split_held_out(ALL, np.arange(199))
    assert (len(taken), len(held)) == (199, 0)
    taken, held = split_held_out(ALL, np.arange(200))
    assert (len(taken), len(held)) == (160, 40)
