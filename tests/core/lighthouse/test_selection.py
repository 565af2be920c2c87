"""Which places solve a scene and which verify it."""

from __future__ import annotations

import numpy as np

from locatk.core.lighthouse.scene.selection import (
    LEAST_HELD_OUT_FROM,
    split_held_out,
    spread_evenly,
)

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


def test_what_is_few_is_taken_whole() -> None:
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
    taken, held = split_held_out(ALL, np.arange(LEAST_HELD_OUT_FROM - 1))
    assert len(taken) == LEAST_HELD_OUT_FROM - 1
    assert len(held) == 0
