"""Text files of one row of numbers a line, blanks between: TUM and KITTI.

A regular file is read at once, in C; any other word by word, which finds the line of an
error. Both give the same numbers.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import FormatError, InputError
from locatk.formats.tables.csv_table import Table, read_text

Array = NDArray[np.float64]

OF_NUMBERS = b"0123456789+-.eE \n"
"""What a regular file consists of."""

SIMPLE_TIME = re.compile(r"(-?)(\d{1,10})(?:\.(\d{1,9}))?", re.ASCII)


@dataclass(frozen=True)
class Rows:
    """What a file of numbers holds.

    Attributes
    ----------
    file : Path
    values : (n, c) ndarray
        All finite.
    words : sequence of str
        The first word of each row, as it stands there.
    lines : sequence of int
        Line of each row, from 1.
    """

    file: Path
    values: Array
    words: Sequence[str]
    lines: Sequence[int]

    def __len__(self) -> int:
        return len(self.lines)


def read_rows(path: Path, names: Sequence[str], hint: str) -> Rows:
    """Rows of as many numbers as there are ``names``, of which the first may be a time.

    Lines that start with ``#`` and blank lines are passed over.

    Raises
    ------
    MissingDataError, FormatError
        No such file; no text, no rows, rows of another length.
    InputError
        A word that is no finite number (but for the first, which is the caller's).
    """
    text = read_text(path)
    return _regular(path, text, len(names)) or _any(path, text, names, hint)


def _regular(path: Path, text: str, columns: int) -> Rows | None:
    """Of a file without surprises: comments at its head only, single blanks, numbers."""
    text = text.replace("\r\n", "\n") if "\r" in text else text
    head = 0
    while text.startswith("#"):
        head += 1
        text = text.partition("\n")[2]
    text = text if text.endswith("\n") else text + "\n"
    data = text.encode()
    if data.translate(None, OF_NUMBERS):
        return None
    characters = np.frombuffer(data, np.uint8)
    blanks = np.flatnonzero(characters <= ord(" "))
    if blanks.size % columns or np.any(np.diff(blanks, prepend=-1) < 2):
        return None
    ends = blanks.reshape(-1, columns)  # of words
    breaks = characters[ends] == ord("\n")
    if breaks[:, :-1].any() or not breaks[:, -1].all():
        return None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # it warns where it stops at what is no number
            values = np.fromstring(text, sep=" ")
    except (ValueError, DeprecationWarning):
        return None
    # Words such as 1-2 or 1.2.3 count as several numbers there.
    if values.size != ends.size or not np.isfinite(values).all():
        return None
    starts = np.concatenate([[0], ends[:-1, -1] + 1]).tolist()
    words = [text[start:end] for start, end in zip(starts, ends[:, 0].tolist(), strict=True)]
    numbers = range(head + 1, head + 1 + len(words))
    return Rows(Path(path), values.reshape(ends.shape), words, numbers)


def _any(path: Path, text: str, names: Sequence[str], hint: str) -> Rows:
    cells, lines = [], []
    for number, line in enumerate(text.split("\n"), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) != len(names):
            raise FormatError(
                f"{len(words)} word{'s' * (len(words) > 1)} in a line of "
                f"{_COUNTS.get(len(names), len(names))} numbers",
                file=path,
                where=number,
                hint=hint,
            )
        cells.append(words)
        lines.append(number)
    if not lines:
        raise FormatError("no poses", file=path, hint=hint)
    columns = dict(zip(names, map(list, zip(*cells, strict=True)), strict=True))
    table = Table(Path(path), columns, lines)
    stamped = names[0] == "time_s"
    values = np.zeros((len(lines), len(names)))
    for k in range(1 if stamped else 0, len(names)):
        values[:, k] = table.floats(names[k])
    return Rows(Path(path), values, columns[names[0]], lines)


_COUNTS = {8: "eight", 12: "twelve"}


# ---- stamps


def format_time(time_ns: int) -> str:
    """Epoch seconds with nine decimals, exactly."""
    sign = "-" if time_ns < 0 else ""
    seconds, rest = divmod(abs(int(time_ns)), 1_000_000_000)
    return f"{sign}{seconds}.{rest:09d}"


def parse_time(text: str) -> int:
    """Nanoseconds since the epoch from decimal epoch seconds, exactly.

    Digits beyond the ninth decimal are rounded; an exponent is allowed.

    Raises
    ------
    ValueError
        No finite number, or beyond the range of int64.
    """
    match = SIMPLE_TIME.fullmatch(text)
    if match:
        time_ns = int(match[2]) * 1_000_000_000 + int((match[3] or "").ljust(9, "0"))
        time_ns = -time_ns if match[1] else time_ns
    else:
        try:
            exact = Decimal(text.strip())
            if not exact.is_finite() or exact.adjusted() > 12:
                raise ValueError(f"{text!r} is no time")
            time_ns = int(exact.scaleb(9).to_integral_value())
        except InvalidOperation:
            raise ValueError(f"{text!r} is no time") from None
    if not -(2**63) <= time_ns < 2**63:
        raise ValueError(f"{text!r} is beyond the range of time stamps")
    return time_ns


def parse_times(words: Sequence[str], fail: Callable[[int], InputError]) -> NDArray[np.int64]:
    """Stamps (n,) of words, exactly; raises ``fail(i)`` for the first that is none."""
    found = _aligned_times(words)
    if found is not None:
        return found
    times = np.empty(len(words), np.int64)
    for i, word in enumerate(words):
        try:
            times[i] = parse_time(word)
        except ValueError:
            raise fail(i) from None
    return times


def _aligned_times(words: Sequence[str]) -> NDArray[np.int64] | None:
    """Of words such as ``1690218696.0748``, all with the point at the same place.

    None where they are not: :func:`parse_time` reads what this does not.
    """
    try:
        cells = np.array(words, "S")
    except UnicodeEncodeError:
        return None
    width = cells.dtype.itemsize
    if not len(cells) or width > 20:
        return None
    digits = cells.view(np.uint8).reshape(len(cells), width)
    point = cells[0].find(b".")
    if not 1 <= point <= 10 or point + 1 >= width or width - point > 10:
        return None
    # Beyond 9.2e18 ns, int64 would run over.
    if point == 10 and np.any(digits[:, 0] >= ord("9")):
        return None
    # Words that are shorter end with zero bytes, which count as zeros.
    value = np.zeros(len(cells), np.int64)
    for place in range(width):
        column = digits[:, place]
        if place == point:
            if np.any(column != ord(".")):
                return None
            continue
        digit = column.astype(np.int64) - ord("0")
        if place > point:
            digit[column == 0] = 0
        if np.any((digit < 0) | (digit > 9)):
            return None
        value = value * 10 + digit
    return value * 10 ** (9 - (width - point - 1))
