"""Times of rows: declared counters that wrap, jumps that are refused, dates and zones."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from locatk.core.errors import FormatError, InputError
from locatk.formats.tables.clocks import Clock, check_unit, parse_clock, read_times
from locatk.formats.tables.delimited import Table
from locatk.formats.tables.quantities import Column

NANOSECONDS = {"s": 10**9, "ms": 10**6, "us": 1000, "ns": 1}


def column(cells: list[str], unit: str = "us", **others: list[str]) -> Column:
    lines = range(2, 2 + len(cells))
    return Column(Table(Path("log.csv"), {"t": cells, **others}, lines), "t", unit)


@pytest.mark.parametrize(
    ("text", "unit", "period_ns", "count_range"),
    [
        ("us, 32 bit", "us", 1000, 2**32),
        ("ms,24bits", "ms", 10**6, 2**24),
        ("MS, 24-bit", "ms", 10**6, 2**24),
        ("\u00b5s", "us", 1000, None),
        ("24 MHz, 24 bit", "ticks", Fraction(125, 3), 2**24),
        ("32.768kHz,32 bit", "ticks", Fraction(10**9, 32768), 2**32),
        ("s, 32 bit of us", "s", 10**9, Fraction(2**32, 10**6)),
        ("ms, 32 bit of 48 MHz", "ms", 10**6, Fraction(2**32, 48000)),
    ],
)
def test_declarations(
    text: str, unit: str, period_ns: Fraction, count_range: Fraction | None
) -> None:
    clock = parse_clock(text)
    assert (clock.unit, clock.period_ns, clock.range) == (unit, period_ns, count_range)


@pytest.mark.parametrize(
    "text", ["", "32 bit", "us 32", "us, 7 bit", "us, 65 bit", "0 MHz", "min", "us, 32 bit of mm"]
)
def test_what_is_not_a_clock_is_refused(text: str) -> None:
    with pytest.raises(InputError) as error:
        parse_clock(text)
    assert error.value.hint


@given(
    bits=st.sampled_from([8, 16, 24, 31, 32]),
    unit=st.sampled_from(["us", "ns", "24 MHz", "32768 Hz"]),
    start=st.integers(0, 2**50),
    steps=st.lists(st.floats(0.001, 0.49), min_size=1, max_size=12),
)
def test_a_counter_is_continued_over_any_wraps(
    bits: int, unit: str, start: int, steps: list[float]
) -> None:
    """Steps below half of the range are recovered exactly, up to the rounding of nanoseconds."""
    size = 1 << bits
    true = start % size + np.cumsum([0, *(max(1, int(step * size)) for step in steps)])
    clock = parse_clock(f"{unit}, {bits} bit")
    time_ns, text = read_times(column([str(n % size) for n in true.tolist()]), None, clock=clock)
    assert time_ns.tolist() == [round(n * clock.period_ns) for n in true.tolist()]
    assert "continued over wraps" in text


@given(
    st.lists(st.integers(0, 15_000_000), min_size=12, max_size=30),
    st.lists(st.sampled_from([0, 1]), min_size=30, max_size=30),
)
def test_rows_of_devices_may_be_late(delays_ns: list[int], devices: list[int]) -> None:
    """Rows that are late by less than the limit keep their times, also around a wrap.

    The first delays are those of the rows before the wrap, 30 ms after the first row.
    """
    size = 1 << 24
    sent = np.arange(len(delays_ns)) * 5_000_000 + size * 1000 - 30_000_000
    time_ns = sent - np.array(delays_ns)
    cells = [str(int(t) // 1000 % size) for t in time_ns]
    groups = np.array(devices[: len(cells)], np.int64)
    read, _ = read_times(
        column(cells),
        None,
        clock=parse_clock("us, 24 bit"),
        groups=groups,
        max_delay_ns=20_000_000,
    )
    for group in np.unique(groups):
        own = groups == group
        expected = time_ns[own] // 1000 * 1000
        np.testing.assert_array_equal(np.diff(read[own]), np.diff(expected))


def test_a_late_row_from_before_a_wrap_stays_before_it() -> None:
    size = 1 << 24
    cells = [size - 9000, 1000, size - 4000, 6000]
    time_ns, _ = read_times(
        column(list(map(str, cells))),
        None,
        clock=parse_clock("us, 24 bit"),
        max_delay_ns=20_000_000,
    )
    assert (time_ns - time_ns[0]).tolist() == [0, 10_000_000, 5_000_000, 15_000_000]


@pytest.mark.parametrize(
    ("unit", "cells", "suggestion"),
    [
        ("us", [2**32 - 3000, 2**32 - 2000, 2**32 - 1000, 500], "us, 32 bit"),
        ("ms", [2**24 - 30, 2**24 - 20, 2**24 - 10, 0], "ms, 24 bit"),
        ("us", [65_000, 65_200, 65_400, 90], "us, 16 bit"),
        ("s", ["4294.947", "4294.957", "4294.967", "0.01"], "s, 32 bit of us"),
        ("ms", ["4294947.2", "4294957.2", "4294967.2", "10.1"], "ms, 32 bit of us"),
    ],
)
def test_a_wrap_that_was_not_declared_is_refused_and_suggested(
    unit: str, cells: list[int | str], suggestion: str
) -> None:
    texts = list(map(str, cells))
    with pytest.raises(InputError, match=r"log\.csv:5: the time goes backwards by ") as error:
        read_times(column(texts, unit), None)
    assert f'--clock "{suggestion}"' in (error.value.hint or "")
    time_ns, _ = read_times(column(texts, unit), None, clock=parse_clock(suggestion))
    assert (np.diff(time_ns) > 0).all()
    assert time_ns[-1] - time_ns[-2] < 11 * np.median(np.diff(time_ns))


def test_a_restart_is_not_taken_for_a_wrap() -> None:
    """2^23 is far from 3.9 million, so that only the general remedy is named."""
    with pytest.raises(InputError, match=r"log\.csv:4: the time goes backwards") as error:
        read_times(column(["3900000", "3901000", "500"]), None)
    assert "restarted" in (error.value.hint or "")


@pytest.mark.parametrize(
    ("cells", "problem"),
    [
        (["1", "300"], r"log\.csv:3: a count of 300 does not fit into the clock 'us, 8 bit'"),
        (["200", "180"], r"log\.csv:3: the time goes backwards by less than half of the range"),
        (["200", "200"], r"log\.csv:3: the time is that of the previous row"),
        (["200", "x"], r"log\.csv:3: 'x' instead of a number"),
    ],
)
def test_counts_that_do_not_fit_are_refused(cells: list[str], problem: str) -> None:
    with pytest.raises(InputError, match=problem):
        read_times(column(cells), None, clock=parse_clock("us, 8 bit"))


def test_a_clock_that_contradicts_name_or_unit_is_refused() -> None:
    table = Table(Path("log.csv"), {"time_ms": ["1"], "t": ["1"]}, [2])
    clock = parse_clock("us, 32 bit")
    with pytest.raises(FormatError, match="in ms by its name, but in us by its clock"):
        check_unit(table, "time_ms", clock, {})
    with pytest.raises(FormatError, match="in ms by --units"):
        check_unit(table, "t", clock, {"time": "ms"})
    check_unit(table, "t", clock, {"time": "us"})


@given(
    st.integers(946_684_800 * 10**9, 4_000_000_000 * 10**9),
    st.sampled_from(sorted(NANOSECONDS)),
    st.integers(0, 9),
)
def test_epochs_in_every_unit_are_exact(start_ns: int, unit: str, decimals: int) -> None:
    digits = min(decimals, len(str(NANOSECONDS[unit])) - 1)
    step = NANOSECONDS[unit] // 10**digits
    times = [start_ns // step * step + k * step for k in range(3)]
    cells = [
        f"{t // NANOSECONDS[unit]}"
        + (f".{t % NANOSECONDS[unit] // step:0{digits}d}" if digits else "")
        for t in times
    ]
    time_ns, text = read_times(column(cells, unit), None)
    assert time_ns.tolist() == times
    assert text == f"{unit} since 1970"


@pytest.mark.parametrize(
    ("cells", "dates"),
    [
        (["2026-01-31T12:00:00,25Z", "2026-01-31T12:00:01,5Z"], None),
        (["2026-01-31 14:00:00.25+02", "2026-01-31 14:00:01.5+02"], None),
        (["2026-01-31T07:30:00.25-04:30", "2026-01-31T07:30:01.5-04:30"], None),
        (["12:00:00.25", "12:00:01.5"], ["2026-01-31", "2026-01-31"]),
        (["12:00:00,25", "12:00:01,5"], ["2026/1/31", "20260131"]),
        (["13:00:00,25+01:00", "12:00:01.5Z"], ["2026.01.31", "2026-01-31"]),
    ],
)
def test_dates_in_every_form(cells: list[str], dates: list[str] | None) -> None:
    own = {} if dates is None else {"date": dates}
    time_ns, _ = read_times(column(cells, "", **own), None, dates="date" if dates else None)
    assert time_ns.tolist() == [1769860800_250000000, 1769860801_500000000]


@pytest.mark.parametrize(
    ("date", "time"),
    [("31.01.2026", "12:00:00"), ("2026-02-30", "12:00:00"), ("2026-01-31", "25:00:00"), ("", "")],
)
def test_dates_that_are_not_clear_are_refused(date: str, time: str) -> None:
    with pytest.raises(InputError, match=r"log\.csv:2: .* (a date|a date and a time)"):
        read_times(column([time], "", date=[date]), None, dates="date")


def test_the_first_row_may_be_dated() -> None:
    clock = Clock("us", "us", Fraction(1000))
    time_ns, _ = read_times(column(["-5", "10"]), 10**9, clock=clock)
    assert time_ns.tolist() == [10**9, 10**9 + 15_000]
    time_ns, text = read_times(column(["-5", "10"]), None)
    assert time_ns.tolist() == [0, 15_000]
    assert "negative" in text
