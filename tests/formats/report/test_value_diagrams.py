"""Diagrams of values over time: reference lines, outliers and thinning."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

pytest.importorskip("plotly")

from locatk.formats.plots.series import Series
from locatk.formats.report.value_diagrams import ValueRow, value_panel


def test_a_reference_line_and_triangles_of_outliers_are_drawn() -> None:
    value = np.ones(200)
    value[100] = 50.0
    series = {"red": Series(10**9 * np.arange(200), value)}
    row = ValueRow("NEES", series, {})
    panel = value_panel("NEES", "", [row], {"red": "#000000"}, 0, as_marks=True, reference=1.0)
    (line,) = panel.figure.layout.shapes
    assert (line.y0, line.y1) == (1.0, 1.0)
    (triangle,) = (trace for trace in panel.figure.data if trace.yaxis == "y2")
    assert_allclose(triangle.customdata, [50.0])
    assert "1 of 200 values lie beyond this scale" in panel.note


def test_a_row_without_values_is_empty() -> None:
    row = ValueRow("x [mm]", {"red": Series(np.arange(0), np.empty(0))}, {})
    assert len(row.magnitudes()) == 0
    assert row.limit(None) == 1.0
    panel = value_panel("Error by axis", "", [row], {}, 0)
    assert not panel.figure.data
    assert not panel.note


def test_thinned_values_contain_the_outliers() -> None:
    value = np.ones(20_000)
    value[12_345] = -7.0
    series = {"red": Series(10**9 * np.arange(20_000), value)}
    row = ValueRow("x [mm]", series, {})
    panel = value_panel("Error by axis", "", [row], {"red": "#000000"}, 0, signed=True)
    assert np.nanmin(panel.figure.data[0].y) == -7.0
    assert "of 20\u202f000 values" in panel.note


def test_bounds_beyond_a_scale_are_marked_in_their_row() -> None:
    """The trace fills its row, and open triangles at both limits stand for the bounds."""
    time_ns = 10**9 * np.arange(200)
    errors = Series(time_ns, np.linspace(-1, 1, 200))
    large = np.full(200, 2.0)
    large[100:110] = 50.0
    rows = [
        ValueRow("x [mm]", {"red": errors}, {"red": Series(time_ns, np.full(200, 2.0))}),
        ValueRow("y [mm]", {"red": errors}, {"red": Series(time_ns, large)}),
    ]
    panel = value_panel("Error by axis", "", rows, {"red": "#000000"}, 0, signed=True)
    assert "10 of 400 bounds lie beyond these scales (open triangles)" in panel.note
    layout = panel.figure.layout
    assert layout.yaxis.range == pytest.approx((-2.1, 2.1))
    assert 2 < layout.yaxis2.range[1] < 4
    upper, lower = (trace for trace in panel.figure.data if trace.yaxis == "y4")
    assert (layout.yaxis4.overlaying, layout.yaxis4.anchor) == ("y2", "x2")
    assert {trace.xaxis for trace in (upper, lower)} == {"x2"}
    assert_allclose(upper.customdata, 50.0)
    assert_allclose(lower.customdata, -50.0)
    assert min(upper.y) > 0.9
    assert max(lower.y) < 0.1
    assert all(100 <= x < 110 for x in upper.x)
    assert not [trace for trace in panel.figure.data if trace.yaxis == "y3"]
    # The whole bound is in the figure: double-click shows it.
    assert max(np.nanmax(trace.y) for trace in panel.figure.data if trace.yaxis == "y2") == 50.0


def test_outliers_of_lines_are_marked_at_their_side() -> None:
    value = np.ones(200)
    value[[20, 70]] = -30.0, 40.0
    row = ValueRow("x [mm]", {"red": Series(10**9 * np.arange(200), value)}, {})
    panel = value_panel("Error by axis", "", [row], {"red": "#000000"}, 0, signed=True)
    assert "2 of 200 values lie beyond this scale (triangles)" in panel.note
    (triangles,) = (trace for trace in panel.figure.data if trace.yaxis == "y2")
    assert list(triangles.marker.symbol) == ["triangle-down", "triangle-up"]
    assert_allclose(triangles.customdata, [-30.0, 40.0])
