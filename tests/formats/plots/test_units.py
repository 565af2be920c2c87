"""Text of numbers, lengths, counts and times in figures."""

from __future__ import annotations

import pytest

from locatk.formats.plots.units import (
    abbreviate,
    format_count,
    format_length,
    format_number,
    format_time,
    select_unit,
)

S = 1_000_000_000


@pytest.mark.parametrize(
    ("value", "text"),
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
def test_numbers_have_three_digits(value: float, text: str) -> None:
    assert format_number(value) == text


@pytest.mark.parametrize(
    ("metres", "text"),
    [(2e-7, "0.200 \u00b5m"), (5e-5, "0.0500 mm"), (0.0123, "12.3 mm"), (2.5, "2.50 m")],
)
def test_lengths_have_units_that_suit_them(metres: float, text: str) -> None:
    assert format_length(metres) == text
    assert format_length(metres, unscaled=True).endswith(" unit")
    assert select_unit(metres, unscaled=True).name == "1/1000 unit"


@pytest.mark.parametrize(
    ("time_ns", "text"),
    [
        (1_767_225_600 * S, "2026-01-01 00:00:00 UTC"),
        (1_767_225_600 * S + 27_999_999, "2026-01-01 00:00:00.027 UTC"),
        (-S, "1969-12-31 23:59:59 UTC"),
        (2**63 - 1, "2262-04-11 23:47:16.854 UTC"),
        (-(10**22), "-10000000000000000000000 ns"),
    ],
)
def test_times_are_in_utc(time_ns: int, text: str) -> None:
    assert format_time(time_ns) == text


def test_counts_have_nouns_and_narrow_spaces() -> None:
    assert format_count(12_345) == "12\u202f345"
    assert format_count(1, "passes") == "1 pass"
    assert format_count(1, "poses") == "1 pose"
    assert format_count(0, "visits") == "0 visits"


def test_long_names_are_abbreviated() -> None:
    assert abbreviate("robot-1") == "robot-1"
    assert len(abbreviate("robot-with-a-very-long-name-17")) == 18
