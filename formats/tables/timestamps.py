"""Time stamps in text: epoch seconds and ISO 8601, to and from integer nanoseconds.

Digits are converted exactly. A float64 resolves the epoch seconds of today to 240 ns only.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from decimal import Decimal, InvalidOperation

import numpy as np
from numpy.typing import NDArray

from locatk.formats.tables.numbers import plain_number

Times = NDArray[np.int64]

NANOSECONDS = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}
"""Nanoseconds in each unit of time."""

UNDATED_START_NS = 1_000_000_000
"""Time of the first row or frame of a recording without a clock.

One second after 1970 is not mistaken for a date; some viewers take zero for no time.
"""

MAX_DIGITS = 19
"""Digits of a time stamp that uint64 always holds."""

_PLAIN_SECONDS = re.compile(r"(-?)(\d{1,10})(?:\.(\d{1,9}))?", re.ASCII)

_ISO_TIME = re.compile(
    r"((?:19[7-9]\d|2[01]\d\d)-\d\d-\d\d)[T ](\d\d:\d\d:\d\d(?:[.,]\d{1,9})?)\d*"
    r"(?:Z|([+-])(\d\d)(?::?(\d\d))?)?",
    re.ASCII,
)
"""ISO 8601 of the years that int64 nanoseconds hold, with a decimal point or comma; digits after
the ninth decimal are cut."""


# ---- decimal numbers


def format_epoch_seconds(time_ns: int) -> str:
    """Format nanoseconds since the epoch as seconds with nine decimals, exactly."""
    sign = "-" if time_ns < 0 else ""
    seconds, rest = divmod(abs(int(time_ns)), 1_000_000_000)
    return f"{sign}{seconds}.{rest:09d}"


def parse_decimal_time(text: str, unit: str = "s") -> int:
    """Return the nanoseconds of a decimal number of ``unit``, rounded to the nearest.

    Raises
    ------
    ValueError
        ``text`` is not a finite number, or is outside of int64.
    """
    match = _PLAIN_SECONDS.fullmatch(text) if unit == "s" else None
    if match:
        time_ns = int(match[2]) * 1_000_000_000 + int((match[3] or "").ljust(9, "0"))
        time_ns = -time_ns if match[1] else time_ns
    else:
        try:
            number = Decimal(plain_number(text).strip())
            if not number.is_finite() or number.adjusted() > MAX_DIGITS:
                raise ValueError(f"{text!r} is not a time")
            time_ns = int((number * NANOSECONDS[unit]).to_integral_value())
        except (InvalidOperation, ValueError):
            raise ValueError(f"{text!r} is not a time") from None
    if not -(2**63) <= time_ns < 2**63:
        raise ValueError(f"{text!r} is outside of the range of time stamps")
    return time_ns


def parse_decimal_times(cells: Sequence[str]) -> Times:
    """Return the nanoseconds (n,) of decimal seconds.

    Raises
    ------
    ValueError
        As :func:`parse_decimal_time`.
    """
    times = None
    try:
        texts = np.array(cells, "S")
    except UnicodeEncodeError:
        texts = None  # parse_decimal_time refuses it
    if "\0" in "".join(cells):  # numpy drops zeros at the end of a text
        texts = None
    if texts is not None and texts.size and 0 < texts.itemsize <= MAX_DIGITS + 2:
        times = parse_digits(texts.view(np.uint8).reshape(len(texts), -1))
    if times is None:
        times = np.fromiter(map(parse_decimal_time, cells), np.int64, len(cells))
    return times


def parse_digits(characters: NDArray[np.uint8]) -> Times | None:
    """Return the nanoseconds of plain decimal seconds such as ``1690218696.0748``.

    Parameters
    ----------
    characters : (n, w) uint8 ndarray
        ASCII codes, one stamp a row, filled up with zeros at the end.

    Returns
    -------
    (n,) int64 ndarray or None
        None if any stamp is not of this form; :func:`parse_decimal_time` reads the others.
    """
    n = len(characters)
    value = np.zeros(n, np.uint64)
    digits = np.zeros(n, np.int64)
    decimals = np.zeros(n, np.int64)
    after_point, after_end = np.zeros(n, bool), np.zeros(n, bool)
    for column in np.ascontiguousarray(characters.T):
        is_digit = (column >= ord("0")) & (column <= ord("9"))
        is_point, is_fill = column == ord("."), column == 0
        if np.any(is_point & after_point) or np.any(after_end & ~is_fill):
            return None
        if not np.all(is_digit | is_point | is_fill):
            return None
        value = np.where(is_digit, value * np.uint64(10) + (column - ord("0")), value)
        digits += is_digit
        decimals += is_digit & after_point
        after_point |= is_point
        after_end |= is_fill
    whole_digits = digits - decimals
    if digits.max() > MAX_DIGITS or whole_digits.min() < 1 or whole_digits.max() > 10:
        return None
    if decimals.max() > 9 or np.any(after_point & (decimals == 0)):
        return None
    scale = 10 ** np.arange(10, dtype=np.uint64)[::-1]
    # Ten digits and nine decimals are below 1e19, which uint64 holds and int64 may not.
    time_ns = value * scale[decimals]
    return None if np.any(time_ns >= 1 << 63) else time_ns.astype(np.int64)


# ---- ISO 8601


def is_iso_time(text: str) -> bool:
    """Return whether a cell has the form of an ISO 8601 time."""
    return _ISO_TIME.fullmatch(text.strip()) is not None


def parse_iso_time(text: str, *, utc_only: bool = True) -> int:
    """Return the nanoseconds since the epoch of an ISO 8601 time.

    Parameters
    ----------
    text : str
        A time without a zone is in UTC.
    utc_only : bool
        Refuse zones other than UTC.

    Raises
    ------
    ValueError
        ``text`` is not such a time.
    """
    return int(parse_iso_times([text], utc_only=utc_only)[0])


def parse_iso_times(cells: Sequence[str], *, utc_only: bool = True) -> Times:
    """Return the nanoseconds since the epoch (n,) of ISO 8601 times; see :func:`parse_iso_time`.

    Raises
    ------
    ValueError
        A cell is not such a time. The message does not name the cell.
    """
    matches = [match for cell in cells if (match := _ISO_TIME.fullmatch(cell.strip()))]
    if len(matches) < len(cells):
        raise ValueError("not a time in ISO 8601")
    texts = [f"{match[1]}T{match[2].replace(',', '.')}" for match in matches]
    local = np.array(texts, "datetime64[ns]")
    offset_minutes = {zone: _offset_minutes(*zone) for zone in {m.group(3, 4, 5) for m in matches}}
    if utc_only and any(offset_minutes.values()):
        raise ValueError("a time zone other than UTC")
    if not any(offset_minutes.values()):
        return local.astype(np.int64)
    minutes = np.array([offset_minutes[match.group(3, 4, 5)] for match in matches], np.int64)
    return local.astype(np.int64) - minutes * 60_000_000_000


def _offset_minutes(sign: str | None, hours: str, minutes: str | None) -> int:
    return 0 if sign is None else int(f"{sign}1") * (60 * int(hours) + int(minutes or 0))
