"""Standstills gathered into places."""

from __future__ import annotations

import numpy as np

from locatk.core.lighthouse.scene.keyframes import STILL, average_standstills


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
    angles = (np.arange(200) * STILL / 2)[:, None, None] * np.ones((1, 2, 2))
    places, run = average_standstills(angles, np.zeros(200, np.int64))
    assert len(places) > 50
    assert np.max(np.bincount(run)) * STILL / 2 < 4 * STILL


def test_devices_do_not_share_a_place() -> None:
    angles = np.zeros((10, 2, 2))
    places, run = average_standstills(angles, np.repeat([0, 1], 5))
    assert len(places) == 2
    np.testing.assert_array_equal(run, np.repeat([0, 1], 5))


def test_what_was_not_seen_is_not_averaged() -> None:
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
