"""Diagrams of reports: thinning of poses, signals and marks; choice of detailed detections."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

pytest.importorskip("plotly")

from locatk.formats.plots.series import Series
from locatk.formats.report import diagrams
from locatk.formats.report.diagrams import (
    Event,
    Signals,
    ValueRow,
    allot_points,
    detail_panels,
    draw_values,
    thin,
)


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


@pytest.mark.slow
@given(st.lists(st.integers(0, 10_000), max_size=50))
def test_points_are_allotted_to_devices(counts: list[int]) -> None:
    shares = allot_points(counts, 3000)
    assert len(shares) == len(counts)
    assert sum(shares) <= max(3000 + 20 * len(counts), sum(counts) if sum(counts) <= 3000 else 0)


def test_peaks_of_a_long_signal_are_drawn() -> None:
    rng = np.random.default_rng(1)
    value = rng.normal(size=123_457)
    value[[7, 60_001, 123_456]] = 50, -40, 30
    value[1000:5000] = np.nan
    time = np.arange(len(value)) * 0.01
    x, y = diagrams.envelope(time, value)
    assert len(x) <= 2.1 * diagrams.SIGNAL_COLUMNS
    assert {50.0, -40.0, 30.0} <= set(y.tolist())
    assert np.all(np.diff(x) >= 0)
    kept = np.isfinite(y)
    assert_array_equal(value[np.round(x[kept] / 0.01).astype(int)], y[kept])
    assert not np.any(kept & (x > 12) & (x < 48))  # nothing is drawn over what is missing


def test_a_short_signal_stays_as_it_is_and_breaks_at_gaps() -> None:
    time = np.r_[np.arange(10) * 0.1, 5 + np.arange(10) * 0.1]
    x, y = diagrams.envelope(time, np.ones(20))
    assert len(x) == 21
    assert np.isnan(y[10])
    assert_allclose(x[[9, 10, 11]], [0.9, 5, 5])
    for n in range(3):
        assert len(diagrams.envelope(np.arange(float(n)), np.arange(float(n)))[0]) == n


def test_marks_that_cover_each_other_are_drawn_once() -> None:
    time = np.linspace(0, 100, 50_000)
    value = np.sin(time)
    value[25_000] = 30.0
    kept = diagrams.thin_marks(time, value)
    assert len(kept) <= diagrams.MAX_MARKS
    assert 25_000 in kept
    assert_array_equal(diagrams.thin_marks(time[:10], value[:10]), np.arange(10))
    noise = np.random.default_rng(0).normal(size=50_000)
    assert 500 < len(diagrams.thin_marks(time, noise)) <= diagrams.MAX_MARKS
    assert len(diagrams.thin_marks(np.zeros(9000), np.zeros(9000))) == 1


def test_details_show_refused_the_least_certain_and_the_most_certain_detections() -> None:
    refused = ["", "", "a", "a", "b", "", ""]
    sure = [0.9, 0.2, 0.0, 0.0, 0.0, 0.5, 0.99]
    assert diagrams.select_details(refused, sure, 4) == [1, 2, 4, 6]
    assert diagrams.select_details(refused, sure, 20) == [0, 1, 2, 4, 5, 6]
    assert diagrams.select_details([], [], 3) == []
    assert diagrams.select_details(["a", "b", "c", "d"], [0.0] * 4, 3) == [0]
    assert diagrams.select_details(["", ""], [np.nan, 1.0], 1) == [1]


def test_a_reference_line_and_triangles_of_outliers_are_drawn() -> None:
    value = np.ones(200)
    value[100] = 50.0
    series = {"red": Series(10**9 * np.arange(200), value)}
    row = ValueRow("NEES", series, {})
    figure, note = draw_values([row], {"red": "#000000"}, 0, as_marks=True, reference=1.0)
    (line,) = figure.layout.shapes
    assert (line.y0, line.y1) == (1.0, 1.0)
    (triangle,) = (trace for trace in figure.data if trace.yaxis == "y2")
    assert_allclose(triangle.customdata, [50.0])
    assert "1 of 200 values lie beyond this scale" in note


def test_a_row_without_values_is_empty() -> None:
    row = ValueRow("x [mm]", {"red": Series(np.arange(0), np.empty(0))}, {})
    assert len(row.magnitudes()) == 0
    assert row.limit(None) == 1.0
    figure, note = draw_values([row], {}, 0)
    assert not figure.data
    assert not note


def test_thinned_values_contain_the_outliers() -> None:
    value = np.ones(20_000)
    value[12_345] = -7.0
    series = {"red": Series(10**9 * np.arange(20_000), value)}
    row = ValueRow("x [mm]", series, {})
    figure, note = draw_values([row], {"red": "#000000"}, 0, signed=True)
    assert np.nanmin(figure.data[0].y) == -7.0
    assert "of 20\u202f000 values" in note


def test_only_events_with_samples_are_drawn_in_detail() -> None:
    time_s = np.arange(0, 10, 0.1)
    signals = Signals(time_s, np.ones((100, 1, 1)), ["s"], ["#000000"], ("field",), "%{y}")
    events = [Event(start, start + 1, "", ("a", "b")) for start in (2.0, 30.0, 5.0)]
    options = {"noun": "visits", "limit": 3, "row_height_px": 100}
    margins = [(0.5, 0.5)] * 3
    (panel,) = detail_panels("Visits", "", signals, events, [1.0] * 3, margins, **options)
    assert panel.note.startswith("All 2 visits are drawn.")
    assert_allclose([trace.x[0] for trace in panel.figure.data], [1.5, 4.5])
    assert detail_panels("Visits", "", signals, events[1:2], [1.0], margins[:1], **options) == []
