"""Thinning, units and numbers of figures; what covariances expect of errors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2

from locatk.formats.plots.series import expected_error, usual_top
from locatk.formats.plots.units import digits, length, unit_for
from locatk.formats.report.figures import share_of_points, thin


@given(n=st.integers(0, 3000), most=st.integers(20, 500), peak=st.integers(0, 2999))
def test_thinning_keeps_ends_and_peaks(n: int, most: int, peak: int) -> None:
    values = np.zeros(n)
    if peak < n:
        values[peak] = 1.0
    keep = thin(n, most, values)
    assert len(keep) <= max(most, n if n <= most else 0)
    assert np.all(np.diff(keep) > 0)
    if n:
        assert (keep[0], keep[-1]) == (0, n - 1)
    if peak < n:
        assert peak in keep
    even = thin(n, most)
    assert len(even) == min(n, most)


def test_nan_is_no_peak() -> None:
    values = np.full(1000, np.nan)
    values[500] = -3.0
    assert 500 in thin(1000, 50, values)


@given(st.lists(st.integers(0, 10_000), max_size=50))
def test_points_are_shared(counts: list[int]) -> None:
    shares = share_of_points(counts, 3000)
    assert len(shares) == len(counts)
    assert sum(shares) <= max(3000 + 20 * len(counts), sum(counts) if sum(counts) <= 3000 else 0)


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (0.0, "0"),
        (0.5, "0.500"),
        (12.34, "12.3"),
        (123.4, "123"),
        (999.7, "1000"),
        (-0.0123, "-0.0123"),
        (1.5e-5, "1.5e-05"),
        (float("nan"), "-"),
    ],
)
def test_numbers_have_three_digits(value: float, said: str) -> None:
    assert digits(value) == said


@pytest.mark.parametrize(
    ("metres", "said"),
    [(2e-7, "0.200 \u00b5m"), (5e-5, "0.0500 mm"), (0.0123, "12.3 mm"), (2.5, "2.50 m")],
)
def test_lengths_have_units_that_suit_them(metres: float, said: str) -> None:
    assert length(metres) == said
    assert length(metres, unscaled=True).endswith(" unit")
    assert unit_for(metres, unscaled=True).name == "1/1000 unit"


@pytest.mark.parametrize(("axes", "within"), [(1, 0.02), (2, 0.01), (3, 0.01)])
def test_expected_errors_are_quantiles(axes: int, within: float) -> None:
    covariance = np.full((1, 3, 3), np.nan)
    covariance[0, :axes, :axes] = np.eye(axes) * 4.0
    expected = 2 * np.sqrt(chi2.ppf(0.95, axes))
    np.testing.assert_allclose(expected_error(covariance), expected, rtol=within)


def test_expected_errors_of_uneven_axes() -> None:
    rng = np.random.default_rng(1)
    covariance = np.diag([1.0, 0.2, 0.01])[None]
    drawn = np.linalg.norm(rng.multivariate_normal(np.zeros(3), covariance[0], 200_000), axis=1)
    np.testing.assert_allclose(expected_error(covariance), np.percentile(drawn, 95), rtol=0.02)


def test_what_is_not_known_is_not_expected() -> None:
    covariance = np.full((2, 3, 3), np.nan)
    covariance[1] = 0.0
    assert np.isnan(expected_error(covariance)[0])
    assert expected_error(covariance)[1] == 0.0


def test_scales_leave_out_wild_values() -> None:
    values = np.append(np.ones(200), 1e6)
    assert usual_top(values) < 2
    assert usual_top(np.zeros(3)) > 0
    assert usual_top(np.full(3, np.nan)) > 0
