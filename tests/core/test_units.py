"""Lengths in mm: moved by the point, not multiplied."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from locatk.core.units import metres, mm_text


@given(st.integers(-(10**9), 10**9))
def test_tenths_of_a_mm_are_read_back(tenths: int) -> None:
    value = metres(tenths / 10)
    assert value == tenths / 10_000
    assert float(mm_text(value)) == tenths / 10


@pytest.mark.parametrize(
    ("value", "decimals", "text"),
    [
        (0.2, 1, "200"),
        (0.0, 1, "0"),
        (-0.00001, 1, "0"),
        (-0.0005, 1, "-0.5"),
        (0.0123456, 4, "12.3456"),
        (0.0123456, 1, "12.3"),
        (1.0, 4, "1000"),
    ],
)
def test_text_has_no_zeros_that_say_nothing(value: float, decimals: int, text: str) -> None:
    assert mm_text(value, decimals) == text
