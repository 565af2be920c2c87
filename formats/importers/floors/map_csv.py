"""Landmark maps from the transponder list of vehicle controllers (CSV).

The columns are those of Goetting's navigation controllers (manual of the HG G-73650):
``No;Code;X mm;Y mm;Attr1;Attr2;Attr3;Attr4``. A row is a landmark:

- ``No`` counts the landmarks row by row from 0; ``Code`` is the code of the landmark, 0 to 15
  (:mod:`locatk.core.landmarks.landmark`);
- ``X mm`` and ``Y mm`` are its position in the frame of the map, as built if that is known;
- ``Attr1`` is its heading as built in 1/100 degree, 0 as designed (the controller reads a heading
  there for start transponders only);
- ``Attr2``, ``Attr3`` and ``Attr4`` are 0: there is no start transponder;
- ``Landmark``, which may follow, is the letters of the bars, as in ``NNSN``. ``Code`` is then any
  number, for controllers that look up positions by it
  (:func:`locatk.formats.exporters.floors.map_csv.landmark_number`).

The table does not contain the alphabet, the window, the walls and the bars. It is written by
:mod:`locatk.formats.exporters.floors.map_csv`.
"""

from __future__ import annotations

import csv
import io
import math
import os

from locatk.core.errors import FormatError, error_context
from locatk.core.landmarks.landmark import CODE_COUNT, code_of
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.landmarks.map.grid_fit import MAX_OFFSET_M, floor_from_poses
from locatk.core.units import metres
from locatk.formats.tables.numbers import parse_number

HEADER = ("No", "Code", "X mm", "Y mm", "Attr1", "Attr2", "Attr3", "Attr4")

LETTERS_COLUMN = "Landmark"

MAX_COORDINATE_MM = 1e7
"""10 km, larger than any floor: larger numbers are in another unit."""

MAX_HEADING_CENTIDEGREES = 18_000


def loads_csv(
    text: str,
    *,
    file: str | os.PathLike[str],
    pitch_m: float | None = None,
    tolerance_m: float = MAX_OFFSET_M,
    warnings: list[str] | None = None,
) -> FloorMap:
    """Parse a table; pitch and cells are estimated from the positions.

    Columns are identified by the header; without one, by their order. Other columns are ignored,
    and attributes may be missing. Decimals may have a comma.

    Parameters
    ----------
    text : str
    file : path
        Name in errors.
    pitch_m, tolerance_m
        See :func:`locatk.core.landmarks.map.grid_fit.fit_grid`.
    warnings : list of str, optional
        A warning about landmarks without a heading is appended.

    Raises
    ------
    FormatError
        It is not such a table, a number of ``No`` repeats, or a row is shorter than the first; the
        error names the line and the column.
    InputError
        The positions are not on a grid; the error names the line of a deviating one.
    """
    codes: list[int] = []
    poses: list[tuple[float, float, float]] = []
    names: list[str] = []
    columns = {name: index for index, name in enumerate(HEADER)}
    width, line_of_number, without_heading = 0, dict[str, int](), list[int]()
    rows = csv.reader(io.StringIO(text.removeprefix("\ufeff")), delimiter=";")
    try:
        for row in rows:
            cells = [cell.strip() for cell in row]
            if not any(cells):
                continue
            if not codes and not _is_number(cells[0]):
                columns, width = _header(cells, file, rows.line_num), len(cells)
                continue
            line = _Line(cells, columns, file, rows.line_num)
            width = width or len(cells)
            if len(cells) < width:
                raise line.error(f"{len(cells)} cells in a row of {width}")
            number = line.text("No")
            first_line = line_of_number.setdefault(number, rows.line_num)
            if number and first_line != rows.line_num:
                raise line.error(f"No {number} is also in line {first_line}")
            codes.append(line.code())
            if not line.text("Attr1"):
                without_heading.append(rows.line_num)
            # The heading of a start transponder is that of the vehicles.
            is_start = line.number("Attr4", 0) == 1
            heading = 0.0 if is_start else line.number("Attr1", MAX_HEADING_CENTIDEGREES)
            x, y = (line.number(name, MAX_COORDINATE_MM) for name in ("X mm", "Y mm"))
            poses.append((metres(x), metres(y), math.radians(heading / 100)))
            names.append(f"line {rows.line_num}")
    except csv.Error as error:
        raise FormatError(str(error), file=file, where=rows.line_num) from None
    if not codes:
        raise FormatError(
            "no landmarks", file=file, hint=f"Give lines as in {';'.join(HEADER[:4])}"
        )
    if without_heading and warnings is not None:
        warnings.append(
            f"{file}:{without_heading[0]}: {len(without_heading)} of {len(codes)} landmarks have "
            "no heading (Attr1): imported as designed"
        )
    with error_context(file):
        return floor_from_poses(codes, poses, names, pitch_m=pitch_m, tolerance_m=tolerance_m)


class _Line:
    """Fields of one landmark by the names of their columns."""

    def __init__(
        self,
        cells: list[str],
        columns: dict[str, int],
        file: str | os.PathLike[str],
        number: int,
    ) -> None:
        self._cells, self._columns, self._file, self._number = cells, columns, file, number

    def text(self, name: str) -> str:
        """Return a cell; empty if its column is missing."""
        index = self._columns.get(name, len(self._cells))
        return self._cells[index] if index < len(self._cells) else ""

    def number(self, name: str, max_abs: float) -> float:
        """Return a number of at most ``max_abs`` in size; 0 for a missing attribute."""
        text = self.text(name).replace(",", ".")
        if not text and name.startswith("Attr"):
            return 0.0
        value = parse_number(text) if _is_number(text) else math.nan
        if name == "Attr4":
            return value
        if not abs(value) <= max_abs:
            raise self.error(f"{text!r} under {name!r}, expected a number up to {max_abs:g}")
        return value

    def code(self) -> int:
        """Return the code of the landmark, by its letters if they have a column."""
        name = LETTERS_COLUMN if LETTERS_COLUMN in self._columns else "Code"
        text = self.text(name)
        if name == LETTERS_COLUMN:
            try:
                return code_of(text)
            except ValueError:
                expected = "the letters of the bars of a landmark, as in NNSN"
                raise self.error(f"{text!r} under {name!r}, expected {expected}") from None
        is_whole = text.isascii() and text.isdigit() and len(text) < 10
        if not (is_whole and int(text) < CODE_COUNT):
            raise self.error(
                f"{text!r} under {name!r}, expected a whole number from 0 to {CODE_COUNT - 1}, the "
                f"code of a landmark, or a column {LETTERS_COLUMN!r}"
            )
        return int(text)

    def error(self, message: str) -> FormatError:
        return FormatError(message, file=self._file, where=self._number)


def _header(cells: list[str], file: str | os.PathLike[str], line: int) -> dict[str, int]:
    """Return the columns by name; case and unit are ignored."""
    bare = [cell.lower().translate(str.maketrans("", "", "[]()")) for cell in cells]
    keys = [cell.removesuffix("mm").strip() for cell in bare]
    plain = {key: number for number, key in enumerate(keys)}
    columns = {
        name: plain[key]
        for name in (*HEADER, LETTERS_COLUMN)
        if (key := name.lower().removesuffix("mm").strip()) in plain
    }
    repeated = [name for name, number in columns.items() if keys.count(keys[number]) > 1]
    if repeated:
        raise FormatError(f"column {repeated[0]!r} occurs twice", file=file, where=line)
    missing = [name for name in ("Code", "X mm", "Y mm") if name not in columns]
    if LETTERS_COLUMN in columns and "Code" in missing:
        missing.remove("Code")
    if missing:
        raise FormatError(
            f"no column {missing[0]!r}",
            file=file,
            where=line,
            hint=f"Give columns separated by semicolons: {';'.join(HEADER)}",
        )
    return columns


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(parse_number(text.replace(",", ".")))
    except ValueError:
        return False
