"""Text of lengths, numbers, counts and times in figures and reports."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Unit:
    """Unit of a quantity: its name, and how many of it are one SI unit."""

    name: str
    per_si: float


UNSCALED_UNIT = Unit("1/1000 unit", 1e3)
DEGREES = Unit("\u00b0", 1.0)
"""Of angles that are given in degrees."""


def select_unit(size_m: float, *, unscaled: bool = False) -> Unit:
    """Return the unit in which a length of this size is written."""
    if unscaled:
        return UNSCALED_UNIT
    if not size_m > 0 or 1e-5 <= size_m < 1:
        return Unit("mm", 1e3)
    return Unit("\u00b5m", 1e6) if size_m < 1e-5 else Unit("m", 1.0)


def format_length(length_m: float, *, unscaled: bool = False) -> str:
    """Format a length to three digits in the unit that suits it."""
    if unscaled:
        return f"{format_number(length_m)} unit"
    unit = select_unit(abs(length_m))
    return f"{format_number(length_m * unit.per_si)} {unit.name}"


def format_number(value: float) -> str:
    """Format a number to three digits, without an exponent between 0.001 and a million."""
    if not np.isfinite(value):
        return "-"
    if abs(value) >= 999.5:
        return f"{value:.0f}" if abs(value) < 1e6 else f"{value:.3g}"
    return f"{value:#.3g}".removesuffix(".") if abs(value) >= 1e-3 else f"{value:.3g}"


def format_count(count: int, noun: str = "") -> str:
    """Format a count with narrow spaces between thousands, and a noun given in the plural.

    ``format_count(1, "passes")`` returns ``"1 pass"``.
    """
    number = f"{count:,}".replace(",", "\u202f")
    if not noun:
        return number
    singular = noun[:-2] if noun.endswith("sses") else noun.removesuffix("s")
    return f"{number} {singular if count == 1 else noun}"


def last_bin_note(values: NDArray[np.float64], limit: float) -> str:
    """Return words on values beyond the scale of a histogram, empty without any."""
    beyond = int(np.count_nonzero(values > limit))
    if not beyond:
        return ""
    count = f"{format_count(beyond)} of {format_count(len(values), 'poses')}"
    return f"{count} beyond this scale are in the last bin"


def format_time(time_ns: int) -> str:
    """Format a time in UTC, with milliseconds unless they are zero."""
    try:
        time = datetime.fromtimestamp(0, UTC) + timedelta(microseconds=time_ns // 1000)
    except OverflowError:
        return f"{time_ns} ns"
    milliseconds = f".{time.microsecond // 1000:03d}".removesuffix(".000")
    return f"{time:%Y-%m-%d %H:%M:%S}{milliseconds} UTC"


def abbreviate(name: str) -> str:
    """Shorten the name of a device to the width of a legend."""
    return name if len(name) <= 18 else f"{name[:7]}...{name[-8:]}"
