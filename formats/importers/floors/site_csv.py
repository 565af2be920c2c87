"""Points for tags from a table: a survey of a site, or the waypoints of a route.

The table is CSV with a header. Columns ``x`` and ``y`` are required, ``heading``, ``id`` and
``meaning`` are optional. Units are part of the names, as in ``x_mm`` or ``heading [deg]``, or given
by the user (:mod:`locatk.formats.tables.quantities`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from locatk.core.errors import InputError, error_context
from locatk.core.polaris.design.site import SitePoint
from locatk.core.polaris.tag import MAX_MEANING_CHARACTERS
from locatk.core.printable import text_of_spreadsheet
from locatk.core.routes import Route
from locatk.formats.tables.delimited import Table
from locatk.formats.tables.dialects import read_any_table
from locatk.formats.tables.quantities import find_columns, split_unit, units_by_quantity

QUANTITIES = {"x": ("length",), "y": ("length",), "heading": ("angle",)}
"""Keys of the columns with a unit, and their quantities."""

TEXT_KEYS = ("id", "meaning")
"""Keys of the columns without a unit."""

MAX_COORDINATE_M = 1e4
"""10 km, larger than any floor: larger numbers are in another unit."""

MAX_ID_DIGITS = 1000
"""Longest id; longer ones are no ids of any code."""


def read_route(
    path: Path, columns: Mapping[str, str] | None = None, units: Sequence[str] = ()
) -> Route:
    """Read the waypoints of a route, whose name is that of the file.

    The parameters and errors are those of :func:`read_site_points` and
    :class:`~locatk.core.routes.Route`.
    """
    points, _ = read_site_points(path, columns, units)
    with error_context(path):
        return Route(np.array([[point.x_m, point.y_m] for point in points]), path.stem)


def read_site_points(
    path: Path, columns: Mapping[str, str] | None = None, units: Sequence[str] = ()
) -> tuple[list[SitePoint], bool]:
    """Read the points of a table.

    Parameters
    ----------
    path : path
    columns : mapping of str to str, optional
        Headers of the keys ``x``, ``y``, ``heading``, ``id`` and ``meaning``, if they have other
        names.
    units : sequence of str
        At most one unit of each quantity, for columns without a unit in their names.

    Returns
    -------
    points : list of SitePoint
        In the order of the table. An empty cell of ``id`` or ``meaning`` is none, one of
        ``heading`` is 0.
    has_heading : bool
        Whether the table has a column of headings.

    Raises
    ------
    MissingDataError, FormatError, InputError
        See :func:`~locatk.formats.tables.dialects.read_any_table` and
        :func:`~locatk.formats.tables.quantities.find_columns`; a cell is not a number or an id, or
        a meaning is too long.
    """
    headers = dict(columns or {})
    unknown = [key for key in headers if key not in (*QUANTITIES, *TEXT_KEYS)]
    if unknown:
        keys = ", ".join((*QUANTITIES, *TEXT_KEYS))
        raise InputError(f"unknown column key {unknown[0]!r}", hint=f"Keys are {keys}")
    given_units = units_by_quantity(units)
    table = read_any_table(path)
    has_heading = "heading" in headers or any(
        split_unit(name)[0] == "heading" for name in table.columns
    )
    wanted = {key: item for key, item in QUANTITIES.items() if has_heading or key != "heading"}
    found = find_columns(
        table, wanted, {key: headers[key] for key in wanted if key in headers}, given_units
    )
    values = {key: column.in_si() for key, column in found.items()}
    for key in ("x", "y"):
        is_wrong = ~(np.abs(values[key]) <= MAX_COORDINATE_M)
        if is_wrong.any():
            table.fail(
                int(np.argmax(is_wrong)),
                f"column {found[key].name!r} is empty or above {MAX_COORDINATE_M:g} m",
                "Check the unit of the column",
            )
    heading = np.nan_to_num(values["heading"]) if has_heading else np.zeros(len(table))
    ids = _texts(table, "id", headers)
    meanings = _texts(table, "meaning", headers)
    points = [
        SitePoint(
            float(values["x"][row]),
            float(values["y"][row]),
            float(heading[row]),
            _parse_id(table, row, ids[row]),
            _check_meaning(table, row, meanings[row]),
            f"line {table.lines[row]}",
        )
        for row in range(len(table))
    ]
    return points, has_heading


def _texts(table: Table, key: str, headers: Mapping[str, str]) -> Sequence[str]:
    """Return the cells of an optional column without a unit; empty if there is none."""
    name = headers[key].strip().lower() if key in headers else key
    if key in headers:
        table.require(name)
    elif name not in table.columns:
        return [""] * len(table)
    return [text_of_spreadsheet(cell.strip()) for cell in table.columns[name]]


def _parse_id(table: Table, row: int, cell: str) -> int | None:
    if not cell:
        return None
    if not (cell.isascii() and cell.isdigit() and len(cell) <= MAX_ID_DIGITS):
        table.fail(row, f"{cell[:40]!r} is not an id", "Give a whole number from 0, or no id")
    return int(cell)


def _check_meaning(table: Table, row: int, cell: str) -> str:
    if len(cell) > MAX_MEANING_CHARACTERS or not cell.isprintable():
        table.fail(
            row,
            f"the meaning is not one line of at most {MAX_MEANING_CHARACTERS} characters",
            "Shorten it",
        )
    return cell
