"""Tables of results as files: CSV, JSON, Parquet and LaTeX."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from locatk.core.errors import InputError
from locatk.core.printable import spreadsheet_text
from locatk.formats.output import atomic_write
from locatk.formats.tables.arrow import import_pyarrow

ENDINGS = (".csv", ".json", ".parquet", ".tex")

LATEX_DIGITS = 4
"""Significant digits of numbers in LaTeX."""

LATEX_CHARACTERS = {c: f"\\{c}" for c in "&%$#_{}"} | {
    "\\": "\\textbackslash{}",
    "~": "\\textasciitilde{}",
    "^": "\\textasciicircum{}",
}

Row = Mapping[str, Any]


def write_table(
    path: Path, columns: Sequence[str], rows: Sequence[Row], *, overwrite: bool = False
) -> None:
    """Write rows of texts and numbers; the ending of ``path`` is one of :data:`ENDINGS`.

    Values that are None or not finite are empty cells, in JSON ``null``.

    Raises
    ------
    InputError
        The ending is another one.
    LocatkError
        Parquet is asked for, and pyarrow is not installed.
    OutputExistsError
        ``path`` exists and ``overwrite`` is false.
    """
    ending = path.suffix.lower()
    if ending not in ENDINGS:
        raise InputError(
            f"{path.name!r} is not the name of a table",
            hint=f"End its name with one of {', '.join(ENDINGS)}",
        )
    cells = [{name: _known(row.get(name)) for name in columns} for row in rows]
    content = {".csv": _csv, ".json": _json, ".parquet": _parquet, ".tex": _latex}[ending]
    data = content(columns, cells)
    with atomic_write(path, overwrite=overwrite) as stream:
        stream.write(data)


def _known(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _csv(columns: Sequence[str], rows: Sequence[Row]) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for row in rows:
        writer.writerow(
            "" if value is None else spreadsheet_text(value) if isinstance(value, str) else value
            for value in row.values()
        )
    return text.getvalue().encode()


def _json(columns: Sequence[str], rows: Sequence[Row]) -> bytes:
    return (json.dumps(list(rows), indent=1, ensure_ascii=False) + "\n").encode()


def _parquet(columns: Sequence[str], rows: Sequence[Row]) -> bytes:
    arrow, parquet = import_pyarrow()
    table = arrow.table({name: [row[name] for row in rows] for name in columns})
    sink = arrow.BufferOutputStream()
    parquet.write_table(table, sink)
    return bytes(sink.getvalue())


def _latex(columns: Sequence[str], rows: Sequence[Row]) -> bytes:
    """Return a tabular for the package booktabs, numbers right-aligned."""
    numeric = [
        any(row[name] is not None for row in rows)
        and all(row[name] is None or not isinstance(row[name], str) for row in rows)
        for name in columns
    ]
    lines = [
        "\\begin{tabular}{" + "".join("r" if is_number else "l" for is_number in numeric) + "}",
        "\\toprule",
        " & ".join(map(_escape, columns)) + " \\\\",
        "\\midrule",
        *(" & ".join(map(_latex_cell, row.values())) + " \\\\" for row in rows),
        "\\bottomrule",
        "\\end{tabular}",
    ]
    return ("\n".join(lines) + "\n").encode()


def _latex_cell(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.{LATEX_DIGITS}g}" if isinstance(value, float) else _escape(str(value))


def _escape(text: str) -> str:
    return "".join(LATEX_CHARACTERS.get(character, character) for character in text)
