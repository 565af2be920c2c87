"""Calculations of the papers, by the bench."""

from __future__ import annotations

from pathlib import Path

import pytest

from locatk.formats.benchmarks.plan import papers
from locatk.formats.benchmarks.plan.papers import figures


@pytest.mark.slow
def test_papers_agree_except_where_the_docs_correct_them() -> None:
    measured = figures(Path())
    *calculated, agreement = measured
    assert agreement.met, [
        (figure.name, figure.value, figure.peer_value)
        for figure in calculated
        if "explains" not in figure.how
    ]
    assert all(figure.peer and figure.value is not None for figure in calculated)
    assert len({figure.name for figure in measured}) == len(measured)
    by_name = {figure.name: figure for figure in calculated}
    # By hand: 0.046 mm and 1/7684 s; Table II; Eq. 1 with 10 placements of two of five magnets.
    assert by_name["calculated: dots, speed of one pixel of blur"].value == pytest.approx(
        0.046 * 7684, rel=1e-9
    )
    assert by_name["calculated: polaris, K = 3, M = 4, P = 8"].value == 5 * 8**4
    assert by_name["calculated: lighthouse, angle of one count"].value == pytest.approx(
        360e6 / (959000 / 8)
    )


def test_a_calculation_that_differs_is_not_counted() -> None:
    calculations = papers._Calculations()
    calculations.add("one", 4.4, 4.0, "", "sum", "paper")
    calculations.add("two", 4.6, 4.0, "", "sum", "paper")
    calculations.add("three", 9.0, 4.0, "", "sum", "paper", digits=None)
    assert (calculations.agreeing, calculations.expected) == (1, 2)
    assert [figure.peer_value for figure in calculations.figures] == [4.0, 4.0, 4.0]
