"""Landmark maps as the table of places that vehicle controllers import.

The columns are those of the transponder list of Goetting's navigation controllers (manual of
the HG G-73650): ``No;Code;X mm;Y mm;Attr1;Attr2;Attr3;Attr4``. What they hold here:

- ``No`` counts the landmarks row by row from 0, ``Code`` is how one is laid, 0 to 15
  (:mod:`locatk.core.landmarks.landmark`);
- ``X mm`` and ``Y mm`` are its place in the map's frame, as built where that is known;
- ``Attr1`` is its heading as built, in 1/100 degree, 0 where it is laid as designed (the
  controller reads a heading there for start transponders only);
- ``Attr2`` and ``Attr3`` are 0, and so is ``Attr4``: none is a start transponder.

The alphabet, the window, the walls and the bars are not in it.
"""

from __future__ import annotations

import csv
import io
import math
import os

from locatk.core.errors import FormatError, error_context
from locatk.core.landmarks.landmark import CODE_COUNT
from locatk.core.landmarks.map.floor import FloorMap, as_built_poses
from locatk.core.landmarks.map.grid_fit import MAX_OFFSET_M, floor_from_poses
from locatk.core.units import metres, mm_text

HEADER = ("No", "Code", "X mm", "Y mm", "Attr1", "Attr2", "Attr3", "Attr4")

FARTHEST_MM = 1e7
"""No floor is larger than 10 km: what is above is in another unit."""

FINEST_MM = 4
"""Decimals of a place: 0.1 um."""


def dumps_csv(floor: FloorMap) -> str:
    """The table of a map; the same map gives the same text."""
    lines = [";".join(HEADER)]
    poses = as_built_poses(floor).tolist()
    for number, (cell, (x, y, heading)) in enumerate(zip(floor.cells(), poses, strict=True)):
        turn = round(100 * math.degrees(heading))
        code = int(floor.codes[cell])
        lines.append(
            f"{number};{code};{mm_text(x, FINEST_MM)};{mm_text(y, FINEST_MM)};{turn};0;0;0"
        )
    return "\n".join(lines) + "\n"


def loads_csv(
    text: str,
    *,
    file: str | os.PathLike[str],
    pitch_m: float | None = None,
    tolerance_m: float = MAX_OFFSET_M,
) -> FloorMap:
    """The map of a table; pitch and cells are found from the places.

    Columns are told by the header where there is one, else by their order; further ones are
    passed over, and attributes may be missing. Decimals may have a comma.

    Parameters
    ----------
    text : str
    file : path
        Named in errors.
    pitch_m, tolerance_m
        See :func:`locatk.core.landmarks.map.grid_fit.fit_grid`.

    Raises
    ------
    FormatError
        It is no such table: the line and the column are named.
    InputError
        The places lie on no grid, or one is off it: its line is named.
    """
    codes: list[int] = []
    poses: list[tuple[float, float, float]] = []
    names: list[str] = []
    where = {name: index for index, name in enumerate(HEADER)}
    rows = csv.reader(io.StringIO(text.removeprefix("\ufeff")), delimiter=";")
    try:
        for row in rows:
            cells = [cell.strip() for cell in row]
            if not any(cells):
                continue
            if not codes and not _is_number(cells[0]):
                where = _header(cells, file, rows.line_num)
                continue
            line = _Line(cells, where, file, rows.line_num)
            codes.append(line.whole("Code", 0, CODE_COUNT - 1))
            start = line.number("Attr4", 0) == 1  # its heading is that of vehicles
            turn = 0.0 if start else line.number("Attr1", 18_000)
            x, y = (line.number(name, FARTHEST_MM) for name in ("X mm", "Y mm"))
            poses.append((metres(x), metres(y), math.radians(turn / 100)))
            names.append(f"line {rows.line_num}")
    except csv.Error as error:
        raise FormatError(str(error), file=file, where=rows.line_num) from None
    if not codes:
        raise FormatError(
            "no landmarks", file=file, hint=f"Expected lines as in {';'.join(HEADER[:4])}"
        )
    with error_context(file):
        return floor_from_poses(codes, poses, names, pitch_m=pitch_m, tolerance_m=tolerance_m)


class _Line:
    """One landmark's fields, by the names of the columns."""

    def __init__(
        self,
        cells: list[str],
        where: dict[str, int],
        file: str | os.PathLike[str],
        number: int,
    ) -> None:
        self._cells, self._where, self._file, self._number = cells, where, file, number

    def number(self, name: str, largest: float) -> float:
        """A number of at most ``largest`` either way; 0 for an attribute that is not there."""
        index = self._where.get(name, len(self._cells))
        text = self._cells[index].replace(",", ".") if index < len(self._cells) else ""
        if not text and name.startswith("Attr"):
            return 0.0
        value = float(text) if _is_number(text) else math.nan
        if name == "Attr4":
            return value
        if not abs(value) <= largest:
            raise self._error(f"{text!r} under {name!r}, expected a number up to {largest:g}")
        return value

    def whole(self, name: str, low: int, high: int) -> int:
        """A whole number."""
        index = self._where[name]
        text = self._cells[index] if index < len(self._cells) else ""
        whole = text.isascii() and text.isdigit() and len(text) < 10
        if not (whole and low <= int(text) <= high):
            raise self._error(
                f"{text!r} under {name!r}, expected a whole number from {low} to {high}: how the "
                "landmark is laid"
            )
        return int(text)

    def _error(self, message: str) -> FormatError:
        return FormatError(message, file=self._file, where=self._number)


def _header(cells: list[str], file: str | os.PathLike[str], line: int) -> dict[str, int]:
    """Columns by their names, in any case, with or without the unit."""
    bare = [cell.lower().translate(str.maketrans("", "", "[]()")) for cell in cells]
    plain = {cell.removesuffix("mm").strip(): number for number, cell in enumerate(bare)}
    found = {
        name: plain[key]
        for name in HEADER
        if (key := name.lower().removesuffix("mm").strip()) in plain
    }
    missing = [name for name in ("Code", "X mm", "Y mm") if name not in found]
    if missing:
        raise FormatError(
            f"no column {missing[0]!r}",
            file=file,
            where=line,
            hint=f"Expected columns separated by semicolons: {';'.join(HEADER)}",
        )
    return found


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text.replace(",", ".")))
    except ValueError:
        return False
