"""CSV tables as columns, strictly: a cell that is not what it should be is an error that
names file, line and column."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import FormatError, InputError, MissingDataError

TIME = re.compile(
    r"((?:19[7-9]\d|2[01]\d\d)-\d\d-\d\d)[T ](\d\d:\d\d:\d\d(?:\.\d{1,9})?)(?:Z|\+00:?00)?",
    re.ASCII,
)
"""ISO 8601 in UTC, said or not; the years that int64 nanoseconds hold well."""


@dataclass(frozen=True)
class Table:
    """Cells of a CSV file as text.

    Attributes
    ----------
    file : Path
    columns : dict of str to list of str
        By header, in lower case, without surrounding blanks; all of one length.
    lines : list of int
        Line of each row in the file, from 1, for error messages.
    """

    file: Path
    columns: dict[str, list[str]]
    lines: list[int]

    def __len__(self) -> int:
        return len(self.lines)

    def fail(self, row: int, message: str, hint: str) -> NoReturn:
        """Raise :class:`InputError` about one row."""
        raise InputError(message, file=self.file, where=self.lines[row], hint=hint)

    def require(self, *names: str) -> None:
        """Raise :class:`FormatError` unless all columns ``names`` are there."""
        missing = [name for name in names if name not in self.columns]
        if missing:
            raise FormatError(
                f"missing column {', '.join(map(repr, missing))}",
                file=self.file,
                where=1,
                hint=f"the header has {', '.join(filter(None, self.columns)) or 'no names'}",
            )

    def floats(
        self, name: str, low: float = -math.inf, high: float = math.inf
    ) -> NDArray[np.float64]:
        """Column as finite numbers from ``low`` to ``high``; (n,) float64."""
        cells = self.columns[name]
        try:
            values = np.fromiter(map(float, cells), np.float64, len(cells))
        except ValueError:
            row = _first_failing(float, cells)
            what = (
                f"{cells[row][:40]!r} instead of a number" if cells[row].strip() else "empty cell"
            )
            self.fail(row, f"{what} in column {name!r}", "correct or delete the row")
        with np.errstate(invalid="ignore"):
            bad = ~(np.isfinite(values) & (values >= low) & (values <= high))
        if bad.any():
            row = int(np.argmax(bad))
            if not np.isfinite(values[row]):
                expected = "a finite number"
            elif values[row] < low:
                expected = f"{low:g} or more"
            else:
                expected = f"{high:g} or less"
            self.fail(
                row,
                f"{cells[row][:40]} in column {name!r} should be {expected}",
                "correct or delete the row",
            )
        return values

    def integers(self, name: str, low: int, high: int) -> NDArray[np.int64]:
        """Column as whole numbers from ``low`` to ``high``; (n,) int64."""
        values = self.floats(name, low, high)
        bad = values != np.floor(values)
        if bad.any():
            row = int(np.argmax(bad))
            self.fail(
                row,
                f"{self.columns[name][row][:40]} in column {name!r} should be a whole number",
                "correct or delete the row",
            )
        return values.astype(np.int64)

    def times_ns(self, name: str = "timestamp") -> NDArray[np.int64]:
        """Column of UTC times as nanoseconds since the epoch, exactly; (n,) int64."""
        cells = self.columns[name]
        matches = list(map(TIME.fullmatch, map(str.strip, cells)))
        try:
            iso = [f"{match[1]}T{match[2]}" for match in matches if match]
            if len(iso) == len(cells):
                return np.array(iso, "datetime64[ns]").astype(np.int64)
        except ValueError:  # a 30th of February
            pass
        row = _first_failing(parse_time_ns, cells)
        self.fail(
            row,
            f"{cells[row][:40]!r} in column {name!r} is not a time in UTC",
            "write it as 2023-07-24T17:11:36.074800Z",
        )


def parse_time_ns(text: str) -> int:
    """Nanoseconds since the epoch of one UTC time in ISO 8601.

    Raises
    ------
    ValueError
        It is none.
    """
    match = TIME.fullmatch(text.strip())
    if not match:
        raise ValueError(f"{text!r} is not a time in UTC")
    return int(np.datetime64(f"{match[1]}T{match[2]}", "ns").astype(np.int64))


def _first_failing(convert: Callable[[str], object], cells: list[str]) -> int:
    """Index of the first cell that ``convert`` refuses with ValueError."""
    for row, cell in enumerate(cells):
        try:
            convert(cell)
        except ValueError:
            return row
    raise AssertionError("no cell fails")


def read_text(path: Path) -> str:
    """Whole file as UTF-8 text.

    Raises
    ------
    MissingDataError
        It is not there, or not readable.
    FormatError
        It is not UTF-8.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise MissingDataError(
            f"cannot read: {error.strerror or error}", file=path, hint="check the path"
        ) from error
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FormatError(
            "bytes that are not UTF-8 text",
            file=path,
            where=data.count(b"\n", 0, error.start) + 1,
            hint="export the table as UTF-8 CSV",
        ) from error


def read_table(path: Path) -> Table:
    """Read a CSV file with a header line; blank lines are passed over.

    Raises
    ------
    MissingDataError
        There is no such file.
    FormatError
        No UTF-8, empty, broken quoting, a column named twice, rows of another length.
    """
    text = read_text(path)
    # The CSV dialect knows no NUL, and zeros at the end are what a crash leaves of a file.
    if "\0" in text:
        raise FormatError(
            "zero bytes in a text file",
            file=path,
            where=text.count("\n", 0, text.index("\0")) + 1,
            hint="the file is damaged or no CSV",
        )
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    rows: list[list[str]] = []
    lines: list[int] = []
    try:
        for row in reader:
            if row:
                rows.append(row)
                lines.append(reader.line_num)
    except csv.Error as error:
        raise FormatError(
            f"broken CSV ({error})", file=path, where=reader.line_num, hint="check the quotes"
        ) from error
    if not rows:
        raise FormatError("empty file", file=path, hint="the recording has no data")
    header = [name.strip().lower() for name in rows[0]]
    twice = {name for name in header if name and header.count(name) > 1}
    if twice:
        raise FormatError(
            f"column {min(twice)!r} occurs twice", file=path, where=lines[0], hint="rename one"
        )
    for row, line in zip(rows, lines, strict=True):
        if len(row) != len(header):
            raise FormatError(
                f"{len(row)} cells in a row, where the header has {len(header)}",
                file=path,
                where=line,
                hint="the file may be cut short: delete or complete the row",
            )
    if len(rows) == 1:
        raise FormatError(
            "a header and no rows", file=path, where=lines[0], hint="the recording has no data"
        )
    columns = dict(zip(header, map(list, zip(*rows[1:], strict=True)), strict=True))
    return Table(Path(path), columns, lines[1:])
