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
