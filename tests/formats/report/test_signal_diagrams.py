"""Diagrams of signals: choice of detailed detections, and their diagrams."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

pytest.importorskip("plotly")

from locatk.formats.report.signal_diagrams import Event, Signals, detail_panels, select_details


def test_details_show_refused_the_least_certain_and_the_most_certain_detections() -> None:
    refused = ["", "", "a", "a", "b", "", ""]
    sure = [0.9, 0.2, 0.0, 0.0, 0.0, 0.5, 0.99]
    assert select_details(refused, sure, 4) == [1, 2, 4, 6]
    assert select_details(refused, sure, 20) == [0, 1, 2, 4, 5, 6]
    assert select_details([], [], 3) == []
    assert select_details(["a", "b", "c", "d"], [0.0] * 4, 3) == [0]
    assert select_details(["", ""], [np.nan, 1.0], 1) == [1]


def test_only_events_with_samples_are_drawn_in_detail() -> None:
    time_s = np.arange(0, 10, 0.1)
    signals = Signals(time_s, np.ones((100, 1, 1)), ["s"], ["#000000"], ("field",), "%{y}")
    events = [
        Event(start, start + 1, "", ("a", "b"), "", 1.0, (start - 0.5, start + 1.5))
        for start in (2.0, 30.0, 5.0)
    ]
    (panel,) = detail_panels("robot", "visits", "", signals, events, limit=3)
    assert panel.title == "Visits of robot in detail"
    assert panel.note.startswith("All 2 visits are drawn.")
    assert_allclose([trace.x[0] for trace in panel.figure.data], [1.5, 4.5])
    assert detail_panels("robot", "visits", "", signals, events[1:2], limit=3) == []
