"""Thinning of poses, signals and marks."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from locatk.formats.report import thinning


@given(n=st.integers(0, 3000), most=st.integers(20, 500), peak=st.integers(0, 2999))
def test_thinning_keeps_ends_and_peaks(n: int, most: int, peak: int) -> None:
    values = np.zeros(n)
    if peak < n:
        values[peak] = 1.0
    keep = thinning.thin(n, most, values)
    assert len(keep) <= max(most, n if n <= most else 0)
    assert np.all(np.diff(keep) > 0)
    if n:
        assert (keep[0], keep[-1]) == (0, n - 1)
    if peak < n:
        assert peak in keep
    even = thinning.thin(n, most)
    assert len(even) == min(n, most)


def test_nan_is_no_peak() -> None:
    values = np.full(1000, np.nan)
    values[500] = -3.0
    assert 500 in thinning.thin(1000, 50, values)


@pytest.mark.slow
@given(st.lists(st.integers(0, 10_000), max_size=50))
def test_points_are_allotted_to_devices(counts: list[int]) -> None:
    shares = thinning.allot_points(counts, 3000)
    assert len(shares) == len(counts)
    assert sum(shares) <= max(3000 + 20 * len(counts), sum(counts) if sum(counts) <= 3000 else 0)


def test_peaks_of_a_long_signal_are_drawn() -> None:
    rng = np.random.default_rng(1)
    value = rng.normal(size=123_457)
    value[[7, 60_001, 123_456]] = 50, -40, 30
    value[1000:5000] = np.nan
    time = np.arange(len(value)) * 0.01
    x, y = thinning.envelope(time, value)
    assert len(x) <= 2.1 * thinning.SIGNAL_COLUMNS
    assert {50.0, -40.0, 30.0} <= set(y.tolist())
    assert np.all(np.diff(x) >= 0)
    kept = np.isfinite(y)
    assert_array_equal(value[np.round(x[kept] / 0.01).astype(int)], y[kept])
    assert not np.any(kept & (x > 12) & (x < 48))  # nothing is drawn over what is missing


def test_a_short_signal_stays_as_it_is_and_breaks_at_gaps() -> None:
    time = np.r_[np.arange(10) * 0.1, 5 + np.arange(10) * 0.1]
    x, y = thinning.envelope(time, np.ones(20))
    assert len(x) == 21
    assert np.isnan(y[10])
    assert_allclose(x[[9, 10, 11]], [0.9, 5, 5])
    for n in range(3):
        assert len(thinning.envelope(np.arange(float(n)), np.arange(float(n)))[0]) == n


def test_marks_that_cover_each_other_are_drawn_once() -> None:
    time = np.linspace(0, 100, 50_000)
    value = np.sin(time)
    value[25_000] = 30.0
    kept = thinning.thin_marks(time, value)
    assert len(kept) <= thinning.MAX_MARKS
    assert 25_000 in kept
    assert_array_equal(thinning.thin_marks(time[:10], value[:10]), np.arange(10))
    noise = np.random.default_rng(0).normal(size=50_000)
    assert 500 < len(thinning.thin_marks(time, noise)) <= thinning.MAX_MARKS
    assert len(thinning.thin_marks(np.zeros(9000), np.zeros(9000))) == 1


def test_columns_of_a_long_signal_contain_its_maxima_and_break_at_gaps() -> None:
    time_s = np.r_[np.arange(3000), 9000 + np.arange(3000)] * 0.01
    value = np.tile(np.arange(6000.0)[:, None], 2)
    value[1234, 1] = 1e6
    x, largest = thinning.column_maxima(time_s, value)
    assert len(x) <= thinning.SIGNAL_COLUMNS + 2
    assert np.nanmax(largest[:, 1]) == 1e6
    assert np.nanmax(largest[:, 0]) == 5999.0
    empty = np.isnan(largest).all(axis=1)
    assert_allclose(x[empty], [30.0, 89.94])  # the edges of the gap
    assert np.all(np.diff(x) > 0)
