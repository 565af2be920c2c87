"""Tables in any usual dialect: CSV with other separators, comments or decimal commas, and Parquet.

The text has commas, semicolons, tabs or bars, with or without comments (``#``) and a byte order
mark; after semicolons, tabs and bars a decimal comma is accepted. Parquet is read by pyarrow (extra
``parquet``).
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from locatk.core.errors import FormatError
from locatk.formats.files import MAX_FILE_BYTES, read_text
from locatk.formats.tables.arrow import import_pyarrow
from locatk.formats.tables.delimited import Table, read_table

PARQUET_ENDINGS = (".parquet", ".pq")

SEPARATORS = ",;\t|"
"""Characters that separate cells, in the order in which they are preferred."""


def read_any_table(path: Path) -> Table:
    """Read CSV with any usual separator, or Parquet.

    Raises
    ------
    MissingDataError
        The file is missing or not readable, or Parquet is read without pyarrow.
    FormatError
        The file is empty, not a table, or its rows differ in length.
    """
    if path.suffix.lower() in PARQUET_ENDINGS:
        return _read_parquet(path)
    text = read_text(path, MAX_FILE_BYTES).removeprefix("\ufeff")
    lines = text.splitlines()
    first = next((line for line in lines if line.strip() and not line.startswith("#")), "")
    separator = max(SEPARATORS, key=first.count)
    has_comments = any(line.startswith("#") for line in lines)
    if first.count(separator) == 0 or (separator == "," and not has_comments):
        return read_table(path)
    return _read_separated(path, lines, separator)


def _read_separated(path: Path, lines: Sequence[str], separator: str) -> Table:
    """Read text with a separator; comments and empty lines are left out."""
    rows: list[list[str]] = []
    numbers: list[int] = []
    for number, line in enumerate(lines, 1):
        if line.strip() and not line.startswith("#"):
            rows.append(next(csv.reader(io.StringIO(line), delimiter=separator)))
            numbers.append(number)
    header = [name.strip().lower() for name in rows[0]]
    for row, number in zip(rows, numbers, strict=True):
        if len(row) != len(header):
            raise FormatError(
                f"{len(row)} cells in a row, but {len(header)} in the header",
                file=path,
                where=number,
                hint="The file may be cut short: delete or complete the row",
            )
    repeated = [name for name in header if name and header.count(name) > 1]
    if repeated:
        raise FormatError(f"column {repeated[0]!r} occurs twice", file=path, where=numbers[0])
    if len(rows) == 1:
        raise FormatError("a header and no rows", file=path, hint="The recording has no data")
    cells = [[cell.strip() for cell in column] for column in zip(*rows[1:], strict=True)]
    if separator != ",":
        cells = [_with_decimal_points(column) for column in cells]
    return Table(path, dict(zip(header, cells, strict=True)), numbers[1:])


def _with_decimal_points(cells: list[str]) -> list[str]:
    """Replace the decimal comma of a column in which each comma is one."""
    if any("." in cell or cell.count(",") > 1 for cell in cells):
        return cells
    return [cell.replace(",", ".") for cell in cells]


def _read_parquet(path: Path) -> Table:
    arrow, parquet = import_pyarrow()
    try:
        data = parquet.read_table(path)
    except (arrow.ArrowInvalid, OSError) as error:
        raise FormatError("not a Parquet file", file=path, hint=str(error).split(".")[0]) from None
    if not data.num_rows:
        raise FormatError("a table without rows", file=path, hint="The recording has no data")
    columns = {}
    for name, column in zip(data.column_names, data.columns, strict=True):
        if arrow.types.is_timestamp(column.type):
            cells: list[Any] = column.cast(arrow.timestamp("ns")).cast(arrow.int64()).to_pylist()
            columns[f"{name.strip().lower()}_ns"] = [str(cell) for cell in cells]
        else:
            cells = column.to_pylist()
            columns[name.strip().lower()] = ["" if cell is None else str(cell) for cell in cells]
    return Table(path, columns, range(1, data.num_rows + 1))
