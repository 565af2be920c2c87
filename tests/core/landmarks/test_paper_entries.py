"""Entries into a territory: crossings between samples, and which of them count."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from locatk.core.landmarks.published.entries import crossings, entries


def straight(count: int, aside: float) -> np.ndarray:
    """Ways (count, 1, 2) of one sensor, 10 mm a sample along x."""
    return np.stack([np.arange(count) * 0.01, np.full(count, aside)], -1)[:, None]


@given(
    st.lists(st.sampled_from([-9.0, -7.0, -2.0, 0.0, 1.0, 4.0, 6.0, 8.0]), min_size=2, max_size=30)
)
def test_crossings_lie_where_the_line_between_samples_meets_the_threshold(values: list) -> None:
    value = np.array(values)
    place = straight(len(value), 0.0)[:, 0]
    point, rising = crossings(place, value, 5.0)
    size = np.interp(point[:, 0], place[:, 0], np.abs(value))
    assert np.allclose(size, 5.0, atol=1e-9)
    assert (rising[1:] != rising[:-1]).all()
    assert len(point) == np.sum((np.abs(value[1:]) >= 5) != (np.abs(value[:-1]) >= 5))


def test_missing_samples_are_passed_over() -> None:
    place = straight(5, 0.0)[:, 0]
    point, rising = crossings(place, np.array([0.0, np.nan, 4.0, np.nan, 0.0]), 1.0)
    assert np.allclose(point, [[0.005, 0.0], [0.035, 0.0]])
    assert rising.tolist() == [True, False]


def test_of_several_crossings_the_outermost_count() -> None:
    value = np.array([0, 4, 0, -4, 0, 0, 4, 0.0])
    seen = entries(straight(8, 0.0), value[:, None], 2.0)
    assert np.allclose(seen.point, [[0.005, 0], [0.065, 0]])
    assert seen.silent.shape[0] == 0
    assert np.allclose(seen.robot, [(0.01 + 0.03 + 0.06) / 3, 0.0])


def test_a_pass_that_begins_inside_has_no_entry_there() -> None:
    seen = entries(straight(4, 0.0), np.array([[4.0], [4.0], [0.0], [0.0]]), 2.0)
    assert np.allclose(seen.point, [[0.015, 0.0]])


def test_front_and_rear_give_one_entry_and_silent_sensors_their_way() -> None:
    field = np.array([0, 4, 4, 0, 0, 0.0])
    dead = np.full(6, np.nan)
    place = np.concatenate(
        [straight(6, 0.0), straight(6, 0.0) - [0.02, 0], straight(6, 0.025), straight(6, 0.05)],
        axis=1,
    )
    values = np.column_stack([field, np.roll(field, 2), 0 * field, dead])
    seen = entries(place, values, 2.0)
    assert np.allclose(seen.point, [[0.005, 0], [0.025, 0]])
    # the dead sensor was not silent: it would have told nothing anyway
    assert seen.silent.shape[0] == 1
    way = seen.silent[0]
    assert np.allclose(way[~np.isnan(way[:, 0])], place[:, 2])


def test_nothing_seen() -> None:
    seen = entries(straight(4, 0.0), np.zeros((4, 1)), 2.0)
    assert seen.point.shape == (0, 2)
    assert np.isnan(seen.robot).all()
