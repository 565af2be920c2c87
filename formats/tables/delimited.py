"""Delimited text as a table of columns, read strictly.

:func:`read_table` reads CSV with a header, :func:`read_number_rows` rows of numbers without one
(TUM, KITTI). A cell that its column does not allow is an error that names file, line and column.

Blocks of plain numbers are parsed at once (:func:`parse_numbers`), all other text cell by cell,
which finds the line of an error. Both give the same, correctly rounded numbers.

Seconds for 1e6 rows of TUM (158 MB, 17 digits) and of a Saleae export (16 MB, 3 columns) on one
core; the check of :func:`parse_numbers` adds 0.55 s and 0.06 s:

===============  ======  =======
parser           TUM     Saleae
===============  ======  =======
pyarrow.csv       0.7     0.07
pandas            0.9     0.12
numpy.loadtxt     3.9     0.87
numpy.fromstring  5.3     0.90
float() a cell    6.6     1.2
===============  ======  =======

pyarrow therefore parses large blocks if it is installed (extra ``parquet``), otherwise numpy does.
"""

from __future__ import annotations

import csv
import functools
import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import FormatError, InputError
from locatk.formats.files import MAX_FILE_BYTES, read_text
from locatk.formats.tables.numbers import parse_number
from locatk.formats.tables.timestamps import (
    parse_decimal_time,
    parse_decimal_times,
    parse_digits,
    parse_iso_time,
    parse_iso_times,
)

Array = NDArray[np.float64]

PLAIN_CHARACTERS = b"0123456789+-.eE\n"
"""Characters of a block of plain numbers, besides the separator."""

MIN_ARROW_BYTES = 2 << 20
"""Smallest block for pyarrow: loadtxt takes as long for it as the import of pyarrow (0.13 s)."""

MAX_COLUMNS = 1000
"""Most columns of a table."""

MAX_CELLS = 20_000_000
"""Most cells of a table, and one for each row, in up to 3 GB. A million poses have 17 million."""

MAX_QUOTED_CHARACTERS = 40
"""Longest part of a cell in an error message."""

CORRECT_ROW_HINT = "Correct or delete the row"


@dataclass(frozen=True)
class Table:
    """Columns of a text file.

    Attributes
    ----------
    file : Path
    columns : dict of str to list of str
        Cells by header, all columns of the same length. Headers of CSV are in lower case and
        without surrounding blanks.
    lines : sequence of int
        Line of each row in the file, from 1, for error messages.
    numbers : dict of str to (n,) float64 ndarray
        Columns that were parsed with the whole file; finite.
    times_ns : dict of str to (n,) int64 ndarray
        Exact times of those of them that contain epoch seconds.
    """

    file: Path
    columns: Mapping[str, Sequence[str]]
    lines: Sequence[int]
    numbers: Mapping[str, Array] = field(default_factory=dict)
    times_ns: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.lines)

    def fail(self, row: int, problem: str, hint: str) -> NoReturn:
        """Raise :class:`InputError` about a row."""
        raise InputError(problem, file=self.file, where=self.lines[row], hint=hint)

    def require(self, *names: str) -> None:
        """Raise :class:`FormatError` unless the table has all columns ``names``."""
        missing = [repr(name) for name in names if name not in self.columns]
        if missing:
            raise FormatError(
                f"column{'s' * (len(missing) > 1)} {', '.join(missing)} "
                f"{'are' if len(missing) > 1 else 'is'} missing",
                file=self.file,
                where=1,
                hint=f"The header has {', '.join(filter(None, self.columns)) or 'no names'}",
            )

    def floats(
        self,
        name: str,
        low: float = -math.inf,
        high: float = math.inf,
        *,
        allow_missing: bool = False,
    ) -> Array:
        """Return a column (n,) of finite numbers from ``low`` to ``high``.

        Parameters
        ----------
        allow_missing : bool
            Return ``nan`` for cells that are empty or ``nan`` instead of an error.

        Raises
        ------
        InputError
            A cell is not such a number.
        """
        missing = np.zeros(len(self), bool)
        if name in self.numbers:
            values = self.numbers[name]
        else:
            cells = self.columns[name]
            if allow_missing:
                missing = np.array([cell.strip().lower() in ("", "nan") for cell in cells], bool)
                cells = ["nan" if gone else cell for gone, cell in zip(missing, cells, strict=True)]
            try:
                values = np.fromiter(map(parse_number, cells), np.float64, len(cells))
            except ValueError:
                row = _first_failing(parse_number, cells)
                cell = cells[row]
                problem = f"{_quoted(cell)} instead of a number" if cell.strip() else "empty cell"
                self.fail(row, f"{problem} in column {name!r}", CORRECT_ROW_HINT)
        with np.errstate(invalid="ignore"):
            is_wrong = ~(np.isfinite(values) & (values >= low) & (values <= high)) & ~missing
        if is_wrong.any():
            row = int(np.argmax(is_wrong))
            if not np.isfinite(values[row]):
                expected = "a finite number"
            elif values[row] < low:
                expected = f"{low:.9g} or more"
            else:
                expected = f"{high:.9g} or less"
            self._fail_cell(row, name, expected)
        return values

    def integers(self, name: str, low: int, high: int) -> NDArray[np.int64]:
        """Return a column (n,) of whole numbers from ``low`` to ``high``; raises as `floats`."""
        values = self.floats(name, low, high)
        is_wrong = values != np.floor(values)
        if is_wrong.any():
            self._fail_cell(int(np.argmax(is_wrong)), name, "a whole number")
        return values.astype(np.int64)

    def iso_times_ns(self, name: str, *, utc_only: bool = True) -> NDArray[np.int64]:
        """Return a column of ISO 8601 times as (n,) nanoseconds since the epoch.

        Parameters
        ----------
        name : str
        utc_only : bool
            Refuse zones other than UTC. A time without a zone is in UTC.

        Raises
        ------
        InputError
            A cell is not such a time.
        """
        cells = self.columns[name]
        try:
            return parse_iso_times(cells, utc_only=utc_only)
        except ValueError:
            row = _first_failing(functools.partial(parse_iso_time, utc_only=utc_only), cells)
        self.fail(
            row,
            f"{_quoted(cells[row])} in column {name!r} is not a time"
            f"{' in UTC' if utc_only else ' with its date'}",
            "Write it as 2023-07-24T17:11:36.074800Z",
        )

    def epoch_times_ns(self, name: str) -> NDArray[np.int64]:
        """Return a column of decimal epoch seconds as (n,) nanoseconds.

        Raises
        ------
        InputError
            A cell is not a finite number, or is outside of the range of int64.
        """
        if name in self.times_ns:
            return self.times_ns[name]
        cells = self.columns[name]
        try:
            return parse_decimal_times(cells)
        except ValueError:
            row = _first_failing(parse_decimal_time, cells)
        self.fail(
            row,
            f"{_quoted(cells[row])} is not a time in epoch seconds",
            "Write it as 1690218696.074800000",
        )

    def _fail_cell(self, row: int, name: str, expected: str) -> NoReturn:
        cells = self.numbers[name] if name in self.numbers else self.columns[name]
        cell = str(cells[row]).strip()[:MAX_QUOTED_CHARACTERS]
        self.fail(row, f"{cell} in column {name!r} should be {expected}", CORRECT_ROW_HINT)


def _quoted(cell: str) -> str:
    return repr(cell[:MAX_QUOTED_CHARACTERS])


def _first_failing(convert: Callable[[str], object], cells: Sequence[str]) -> int:
    """Return the index of the first cell for which ``convert`` raises ValueError."""
    for row, cell in enumerate(cells):
        try:
            convert(cell)
        except ValueError:
            return row
    raise AssertionError("no cell fails")


# ---- files


def _read_text(path: Path) -> str:
    """Read a text without zero bytes, which a crash can leave at the end of a file."""
    text = read_text(path, MAX_FILE_BYTES)
    if "\0" in text:
        raise FormatError(
            "zero bytes in a text file",
            file=path,
            where=text.count("\n", 0, text.index("\0")) + 1,
            hint="The file is damaged or of another kind",
        )
    return text


def read_table(path: Path) -> Table:
    """Read a CSV file with a header; blank lines are ignored.

    Raises
    ------
    MissingDataError
        The file is missing or not readable.
    FormatError
        The file is not UTF-8 or empty, its quotes are broken, two columns have the same name, or
        rows differ in length.
    """
    text = _read_text(path)
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    rows: list[list[str]] = []
    lines: list[int] = []
    cells = 0
    try:
        for row in reader:
            if row:
                cells += len(row) + 1
                if cells > MAX_CELLS:
                    raise FormatError(
                        f"more than {MAX_CELLS:,} cells",
                        file=path,
                        where=reader.line_num,
                        hint="Split the recording",
                    )
                rows.append(row)
                lines.append(reader.line_num)
    except csv.Error as error:
        raise FormatError(
            f"broken CSV ({error})", file=path, where=reader.line_num, hint="Check the quotes"
        ) from error
    if not rows:
        raise FormatError("empty file", file=path, hint="The recording has no data")
    header = [name.strip().lower() for name in rows[0]]
    if len(header) > MAX_COLUMNS:
        raise FormatError(
            f"{len(header)} columns, more than {MAX_COLUMNS}",
            file=path,
            where=lines[0],
            hint="The file is damaged or of another kind",
        )
    repeated = {name for name in header if name and header.count(name) > 1}
    if repeated:
        raise FormatError(
            f"column {min(repeated)!r} occurs twice", file=path, where=lines[0], hint="Rename one"
        )
    for row, line in zip(rows, lines, strict=True):
        if len(row) != len(header):
            raise FormatError(
                f"{len(row)} cells in a row, but {len(header)} in the header",
                file=path,
                where=line,
                hint="The file may be cut short: delete or complete the row",
            )
    if len(rows) == 1:
        raise FormatError(
            "a header and no rows", file=path, where=lines[0], hint="The recording has no data"
        )
    columns = dict(zip(header, map(list, zip(*rows[1:], strict=True)), strict=True))
    return Table(Path(path), columns, lines[1:])


def read_number_rows(
    path: Path, names: Sequence[str], *, hint: str, time_column: str = ""
) -> Table:
    """Read rows of numbers separated by blanks, one for each of ``names``.

    Lines that start with ``#`` and blank lines are ignored.

    Parameters
    ----------
    path : path
    names : sequence of str
        Names of the columns, which the file does not contain.
    hint : str
        Description of a row, for error messages.
    time_column : str
        Column that :meth:`Table.epoch_times_ns` reads; it has to be the first.

    Raises
    ------
    MissingDataError, FormatError
        The file is missing, is not text, has no rows, or has rows of another length.
    """
    text = _read_text(path)
    table = _plain_rows(path, text, names, time_column)
    return table or _rows_by_word(path, text, names, hint)


def _plain_rows(path: Path, text: str, names: Sequence[str], time_column: str) -> Table | None:
    """Return the rows of a file of plain numbers with comments at its head only."""
    text = text.replace("\r\n", "\n") if "\r" in text else text
    comments = 0
    while text.startswith("#"):
        comments += 1
        text = text.partition("\n")[2]
    block = text.encode()
    parsed = parse_numbers(block, len(names), " ")
    if parsed is None or not np.isfinite(parsed.values).all():
        return None
    numbers = dict(zip(names, parsed.values.T, strict=True))
    times_ns: dict[str, NDArray[np.int64]] = {}
    if time_column:
        times = parse_digits(parsed.characters(block, 0))
        if times is None:
            return None
        times_ns[time_column] = times
    lines = range(comments + 1, comments + 1 + len(parsed.values))
    return Table(Path(path), {}, lines, numbers, times_ns)


def _rows_by_word(path: Path, text: str, names: Sequence[str], hint: str) -> Table:
    rows, lines = [], []
    for number, line in enumerate(text.split("\n"), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) != len(names):
            raise FormatError(
                f"{len(words)} word{'s' * (len(words) > 1)} in a line of {len(names)} numbers",
                file=path,
                where=number,
                hint=hint,
            )
        rows.append(words)
        lines.append(number)
    if not lines:
        raise FormatError("no poses", file=path, hint=hint)
    columns = dict(zip(names, map(list, zip(*rows, strict=True)), strict=True))
    return Table(Path(path), columns, lines)


# ---- blocks of plain numbers


class NumberBlock(NamedTuple):
    """Numbers of a block of text.

    Attributes
    ----------
    values : (n, c) ndarray
        Infinite where a number overflows.
    start, stop : (n, c) int ndarray
        Bytes of the block at which each cell begins and after which it ends.
    """

    values: Array
    start: NDArray[np.int64]
    stop: NDArray[np.int64]

    def characters(self, block: bytes, column: int) -> NDArray[np.uint8]:
        """Return the text of a column (n, w) as ASCII codes, filled up with zeros."""
        start, stop = self.start[:, column], self.stop[:, column]
        offset = np.arange(int((stop - start).max()))
        index = start[:, None] + offset
        is_inside = index < stop[:, None]
        codes = np.frombuffer(block, np.uint8)
        return np.where(is_inside, codes[np.where(is_inside, index, 0)], 0).astype(np.uint8)


def parse_numbers(block: bytes, columns: int, separator: str) -> NumberBlock | None:
    """Parse lines of plain decimal numbers at once.

    Returns
    -------
    NumberBlock or None
        None if any line does not consist of ``columns`` numbers with one ``separator`` between
        them and nothing else.
    """
    block = block if block.endswith(b"\n") else block + b"\n"
    if block.translate(None, PLAIN_CHARACTERS + separator.encode()):
        return None
    codes = np.frombuffer(block, np.uint8)
    stop = np.flatnonzero((codes == ord(separator)) | (codes == ord("\n")))
    if stop.size % columns:
        return None
    start = np.concatenate([[0], stop[:-1] + 1])
    if np.any(stop == start):
        return None
    is_line_end = (codes[stop] == ord("\n")).reshape(-1, columns)
    if is_line_end[:, :-1].any() or not is_line_end[:, -1].all():
        return None
    values = _parse_with_arrow(block, columns, separator)
    if values is None:
        try:
            values = np.loadtxt(io.BytesIO(block), delimiter=separator, comments=None, ndmin=2)
        except ValueError:  # characters such as 1-2 or 1.2.3
            return None
    return NumberBlock(values, start.reshape(-1, columns), stop.reshape(-1, columns))


def _parse_with_arrow(block: bytes, columns: int, separator: str) -> Array | None:
    """Parse a large, checked block with pyarrow; None if it is not installed or refuses."""
    if len(block) < MIN_ARROW_BYTES:
        return None
    try:
        import pyarrow as pa  # an optional library, and slow to import
        from pyarrow import csv as arrow_csv
    except ImportError:
        return None
    names = [f"f{k}" for k in range(columns)]
    try:
        table = arrow_csv.read_csv(
            pa.BufferReader(block),
            # Threads would not survive the fork of a worker process.
            arrow_csv.ReadOptions(column_names=names, use_threads=False),
            arrow_csv.ParseOptions(delimiter=separator, quote_char=False),
            arrow_csv.ConvertOptions(column_types=dict.fromkeys(names, pa.float64())),
        )
    except pa.ArrowInvalid:  # a leading plus sign, a number that overflows
        return None
    return np.column_stack([column.to_numpy() for column in table.columns])
