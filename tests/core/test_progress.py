"""Progress of computations, as their observer receives it."""

from __future__ import annotations

import threading

from locatk.core import progress


def test_each_element_is_reported_when_it_is_done() -> None:
    reports: list[tuple[str, int, int]] = []
    with progress.observed(lambda *report: reports.append(report)):
        elements = [(element, len(reports)) for element in progress.track("abc", "letters")]
    assert elements == [("a", 1), ("b", 2), ("c", 3)]
    assert reports == [("letters", done, 3) for done in range(4)]


def test_without_an_observer_nothing_is_reported() -> None:
    reports: list[tuple[str, int, int]] = []
    with progress.observed(lambda *report: reports.append(report)):
        other = threading.Thread(target=progress.report, args=("letters", 1, 2))
        other.start()
        other.join()
    progress.report("letters", 1, 2)
    assert list(progress.track([1, 2], "numbers")) == [1, 2]
    assert not reports
