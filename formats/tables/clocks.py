"""Times of the rows of a table: dates, decimal times, and counters that wrap.

A counter of a microcontroller has a limited width: ``micros()`` of an Arduino starts again at 0
after 2^32 microseconds (71.6 minutes). A :class:`Clock` declares unit and width; its counts are
then continued over the wraps. A jump back of any other column is an error, because it may as well
be a restart of the device; the message suggests the width that would explain the jump.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import FormatError, InputError
from locatk.formats.tables.delimited import Table
from locatk.formats.tables.quantities import UNITS, Column, canonical_unit, split_unit
from locatk.formats.tables.timestamps import NANOSECONDS, parse_iso_time

Times = NDArray[np.int64]
Count = int | Fraction
"""Count of a clock in its unit."""

MIN_EPOCH_NS = 946_684_800_000_000_000
"""Times from the year 2000 on belong to a clock that counts from 1970."""

MAX_TIME_NS = 2**62
"""Largest time; differences of two of them fit into int64."""

MAX_BITS = 64
"""Widest counter; one of nanoseconds wraps after 585 years."""

MIN_BITS = 8

MAX_WRAP_STEPS = 10
"""Longest time over a wrap of which a message suggests the width, in usual steps of the rows."""

MAX_DIGITS = 40
"""Decimals of a count that are read."""

MAX_QUOTED_CHARACTERS = 40
"""Longest part of a cell in an error message."""

HERTZ = {"hz": 1, "khz": 10**3, "mhz": 10**6, "ghz": 10**9}

CLOCK_HINT = 'Write it as "us", "us, 32 bit", "24 MHz, 24 bit" or "s, 32 bit of us"'

_UNIT = r"[a-z]+|\d+(?:\.\d+)?\s*[kmg]?hz"
_CLOCK = re.compile(rf"({_UNIT})(?:\s*,\s*(\d{{1,3}})\s*-?\s*bits?(?:\s+of\s+({_UNIT}))?)?")
_RATE = re.compile(r"(\d+(?:\.\d+)?)\s*([kmg]?hz)")

_DATE = re.compile(r"(\d{4})(?:([-/.])(\d\d?)\2(\d\d?)|(\d\d)(\d\d))", re.ASCII)
_TIME_OF_DAY = re.compile(r"(\d\d?)(:\d\d:\d\d.*)", re.ASCII)


# ---- clocks


@dataclass(frozen=True)
class Clock:
    """Unit of a column of times, and the range after which it starts again at 0.

    Attributes
    ----------
    text : str
        As the user declared it.
    unit : str
        A unit of time; ``"ticks"`` if the clock is given by its frequency.
    period_ns : Fraction
        Nanoseconds of a count.
    range : Fraction or None
        Counts after which it starts again at 0; None if it does not.
    """

    text: str
    unit: str
    period_ns: Fraction
    range: Fraction | None = None


def parse_clock(text: str) -> Clock:
    """Return the clock of a declaration.

    Raises
    ------
    InputError
        It is not a unit of time or a frequency, with or without a width.

    Examples
    --------
    >>> parse_clock("us, 32 bit").range, parse_clock("24 MHz, 24 bit").period_ns
    (Fraction(4294967296, 1), Fraction(125, 3))
    """
    plain = canonical_unit(" ".join(text.split()))
    match = _CLOCK.fullmatch(plain)
    period_ns = _period_ns(match[1]) if match else None
    counted_ns = _period_ns(match[3]) if match and match[3] else period_ns
    if match is None or period_ns is None or counted_ns is None:
        raise InputError(f"{text!r} is not a clock", hint=CLOCK_HINT)
    unit = match[1] if match[1] in NANOSECONDS else "ticks"
    if match[2] is None:
        return Clock(text, unit, period_ns)
    bits = int(match[2])
    if not MIN_BITS <= bits <= MAX_BITS:
        raise InputError(
            f"a counter of {bits} bits", hint=f"Give a width of {MIN_BITS} to {MAX_BITS} bits"
        )
    return Clock(text, unit, period_ns, (1 << bits) * counted_ns / period_ns)


def _period_ns(text: str) -> Fraction | None:
    """Return the nanoseconds of a unit of time or of a tick; None if the text is neither."""
    if text in NANOSECONDS:
        return Fraction(NANOSECONDS[text])
    match = _RATE.fullmatch(text)
    rate_hz = Fraction(match[1]) * HERTZ[match[2]] if match else Fraction(0)
    return Fraction(10**9) / rate_hz if rate_hz else None


# ---- times of rows


def read_times(
    column: Column,
    start_ns: int | None,
    *,
    clock: Clock | None = None,
    dates: str | None = None,
    groups: NDArray[np.int64] | None = None,
    max_delay_ns: int | None = None,
) -> tuple[Times, str]:
    """Return the times of the rows in nanoseconds since the epoch, and a text on their clock.

    Parameters
    ----------
    column : Column
        Without a unit, its cells are times in ISO 8601, or times of the day if there are ``dates``.
    start_ns : int or None
        Time of the first row. [default: times are kept; if one is negative, the first becomes 0]
    clock : Clock, optional
        Declared clock, which replaces the unit of ``column``.
    dates : str, optional
        Column with the dates of times of the day.
    groups : (n,) ndarray, optional
        Device of each row. Only the times of each device have to ascend.
    max_delay_ns : int, optional
        Rows may be late by so much, and may have equal times. [default: times strictly ascend]

    Raises
    ------
    InputError
        A cell is not a time, times do not ascend, or a count exceeds the width of the counter.
    """
    table = column.table
    parts = [np.arange(len(table))]
    if groups is not None:
        parts = [np.flatnonzero(groups == group) for group in np.unique(groups)]
    if clock is not None or column.unit:
        clock = clock or Clock(column.unit, column.unit, Fraction(NANOSECONDS[column.unit]))
        counts = _counts(table, column.name, clock)
        continued: list[Count] = [0] * len(counts)
        for rows in parts:
            for row, count in zip(
                rows.tolist(), _continue(table, rows, counts, clock, max_delay_ns), strict=True
            ):
                continued[row] = count
        time_ns = _nanoseconds(continued, clock)
        if start_ns is None and time_ns.min() < 0:
            # Sessions store no negative times.
            time_ns = time_ns - time_ns.min()
            text = "unknown: the first row is at 0 s, which is negative in the file"
        elif time_ns[0] >= MIN_EPOCH_NS:
            text = f"{clock.text} since 1970"
        else:
            text = "unknown: times as in the file"
        if clock.range is not None:
            text += f" ({clock.text}, continued over wraps)"
    elif dates is not None:
        time_ns, text = _dated_times(table, dates, column.name), "dates and times of the file"
    else:
        time_ns = table.iso_times_ns(column.name, utc_only=False)
        text = "dates and times of the file"
    for rows in parts:
        _check_order(table, rows, time_ns, max_delay_ns)
    if start_ns is not None:
        first_ns = time_ns[0] if max_delay_ns is None else time_ns.min()
        time_ns, text = time_ns - first_ns + start_ns, "the first row is at the given time"
    return time_ns, text


def check_unit(table: Table, name: str, clock: Clock, units: Mapping[str, str]) -> None:
    """Raise FormatError if a column is in another unit than its declared clock.

    ``units`` are those that the user stated, by quantity.
    """
    in_name = split_unit(name)[1]
    if in_name in UNITS["time"] and in_name != clock.unit:
        problem, remedy = "by its name", "or rename the column"
    elif (in_name := units.get("time", clock.unit)) != clock.unit:
        problem, remedy = "by --units", f"or remove {in_name} from --units"
    else:
        return
    raise FormatError(
        f"column {name!r} is in {in_name} {problem}, but in {clock.unit} by its clock",
        file=table.file,
        where=1,
        hint=f"Give --clock in {in_name}, {remedy}",
    )


def _counts(table: Table, name: str, clock: Clock) -> list[Count]:
    """Return the cells of a column as exact numbers; a float does not hold epoch nanoseconds."""
    limit = float(MAX_TIME_NS / clock.period_ns)
    table.floats(name, -limit, limit)
    counts: list[Count] = []
    for cell in table.columns[name]:
        if cell.isdigit():
            counts.append(int(cell))
        else:
            number = Decimal(cell.strip())
            is_tiny = not number or number.adjusted() < -MAX_DIGITS
            counts.append(Fraction(0) if is_tiny else Fraction(number))
    return counts


def _nanoseconds(counts: Sequence[Count], clock: Clock) -> Times:
    """Convert counts, rounded to the nearest nanosecond.

    Raises
    ------
    InputError
        A counter wrapped so often that its times overflow.
    """
    scale, divisor = clock.period_ns.numerator, clock.period_ns.denominator
    if divisor == 1 and all(isinstance(count, int) for count in counts):
        times = [count * scale for count in counts]
    else:
        times = [round(count * clock.period_ns) for count in counts]
    if max(times) > MAX_TIME_NS:
        raise InputError(f"the clock {clock.text!r} wraps too often", hint="Check its unit")
    return np.array(times, np.int64)


def _continue(
    table: Table,
    rows: NDArray[np.int64],
    counts: Sequence[Count],
    clock: Clock,
    max_delay_ns: int | None,
) -> list[Count]:
    """Return the counts of some rows, continued over wraps of the counter."""
    indices = rows.tolist()
    own = [counts[row] for row in indices]
    max_delay = int((max_delay_ns or 0) / clock.period_ns)
    if clock.range is None:
        for k in range(1, len(own)):
            if own[k - 1] - own[k] > max_delay:
                _fail_jump(table, indices[k], own, k, clock)
        return own
    size: Count = int(clock.range) if clock.range.denominator == 1 else clock.range
    for k, count in enumerate(own):
        if not 0 <= count < size:
            table.fail(
                indices[k],
                f"a count of {float(count):.12g} does not fit into the clock {clock.text!r}",
                "Check unit and width of the clock",
            )
    wraps: Count = 0
    continued = own[:1]
    for k in range(1, len(own)):
        step = own[k] - own[k - 1]
        if step < 0 and 2 * (step + size) <= size:
            wraps += size
        elif step > 0 and size - step <= max_delay:
            wraps -= size  # a late row from before the wrap
        elif -step > max_delay:
            table.fail(
                indices[k],
                "the time goes backwards by less than half of the range of its clock "
                f"({clock.text})",
                "Sort the rows by time, or split the recording at this row if it paused here",
            )
        continued.append(own[k] + wraps)
    return continued


def _fail_jump(table: Table, row: int, counts: Sequence[Count], k: int, clock: Clock) -> None:
    """Raise InputError about a jump back at ``counts[k]``; suggest the wrap that explains it."""
    suggested = _suggest_clock(counts, k, clock)
    if suggested is None:
        hint = (
            "Sort the rows by time, or split the file if the device was restarted; for a counter "
            'that wraps, declare it with `locatk import table`: --clock "us, 32 bit"'
        )
    else:
        hint = (
            "It looks like a counter that wraps; if so, declare it with `locatk import table`: "
            f'--clock "{suggested}"'
        )
    jump_s = float((counts[k - 1] - counts[k]) * clock.period_ns) * 1e-9
    table.fail(row, f"the time goes backwards by {jump_s:.6g} s", hint)


def _suggest_clock(counts: Sequence[Count], k: int, clock: Clock) -> str | None:
    """Return the clock that explains a jump back at ``counts[k]``; None if no width does.

    The width is the smallest one that the count before the jump needs, in the unit of the column
    or in a finer one, from which a program converted it. The step over the wrap must be usual.
    """
    steps = sorted(b - a for a, b in pairwise(counts[:k]) if b > a)
    if not steps or counts[k] < 0:
        return None
    usual = steps[len(steps) // 2]
    units = [clock.text] if clock.unit == "ticks" else [clock.unit]
    units += [unit for unit, size in NANOSECONDS.items() if size < clock.period_ns]
    for unit in units:
        ratio = Fraction(1) if unit == units[0] else clock.period_ns / NANOSECONDS[unit]
        last = counts[k - 1] * ratio
        bits = int(last).bit_length()
        if bits < MIN_BITS or bits > MAX_BITS:
            continue
        step = counts[k] * ratio + (1 << bits) - last
        if 0 < step <= MAX_WRAP_STEPS * usual * ratio:
            return f"{units[0]}, {bits} bit" + (f" of {unit}" if unit != units[0] else "")
    return None


def _check_order(
    table: Table, rows: NDArray[np.int64], time_ns: Times, max_delay_ns: int | None
) -> None:
    """Raise InputError unless the times of some rows ascend."""
    steps_ns = np.diff(time_ns[rows])
    min_step_ns = 1 if max_delay_ns is None else -max_delay_ns
    if (steps_ns < min_step_ns).any():
        index = int(np.argmax(steps_ns < min_step_ns))
        table.fail(
            int(rows[index + 1]),
            f"the time goes backwards by {-1e-9 * float(steps_ns[index]):.6g} s"
            if steps_ns[index] < 0
            else "the time is that of the previous row",
            "Sort the rows by time, and write times with all of their digits",
        )


# ---- dates and times of the day


def is_time_of_day(text: str) -> bool:
    """Return whether a cell has the form of a time of the day, as in ``9:05:00.25``."""
    return _TIME_OF_DAY.fullmatch(text.strip()) is not None


def _dated_times(table: Table, dates: str, times: str) -> Times:
    """Join dates and times of the day."""
    cells = zip(table.columns[dates], table.columns[times], strict=True)
    joined = []
    for row, (date, time) in enumerate(cells):
        day, clock = _DATE.fullmatch(date.strip()), _TIME_OF_DAY.fullmatch(time.strip())
        if day is None:
            table.fail(
                row,
                f"{date[:MAX_QUOTED_CHARACTERS]!r} in column {dates!r} is not a date",
                "Write year, month and day, as in 2026-01-31",
            )
        month, month_day = (day[3], day[4]) if day[3] else (day[5], day[6])
        try:
            if clock is None:
                raise ValueError(time)
            text = f"{day[1]}-{month:>02}-{month_day:>02}T{clock[1]:>02}{clock[2]}"
            joined.append(parse_iso_time(text, utc_only=False))
        except ValueError:
            cell = f"{date} {time}"[:MAX_QUOTED_CHARACTERS]
            hint = "Write them as 2026-01-31 and 12:00:00.5"
            table.fail(row, f"{cell!r} is not a date and a time", hint)
    return np.array(joined, np.int64)
