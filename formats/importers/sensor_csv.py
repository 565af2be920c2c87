"""Positions of sensors from a table: one row a sensor, in the order of the samples.

The table is CSV with a header, or Parquet. Columns ``x`` and ``y`` are required; ``z``, ``name``
and the direction ``nx``, ``ny``, ``nz`` are optional. Units are part of the names, as in ``x_mm``,
or given by the user (:mod:`locatk.formats.tables.quantities`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.printable import text_of_spreadsheet
from locatk.formats.tables.delimited import Table
from locatk.formats.tables.dialects import read_any_table
from locatk.formats.tables.quantities import find_columns, split_unit, units_by_quantity

Array = NDArray[np.float64]

NORMAL_COLUMNS = ("nx", "ny", "nz")

MAX_COORDINATE_M = 10.0
"""Larger than any robot: larger numbers are in another unit."""


@dataclass(frozen=True)
class SensorTable:
    """Sensors of a table.

    Attributes
    ----------
    position_m : (n, 3) ndarray
    names : list of str, optional
    normal : (n, 3) ndarray, optional
        Unit vectors along the directions of the table.
    """

    position_m: Array
    names: list[str] | None
    normal: Array | None


def read_sensor_table(path: Path, units: Sequence[str] = ()) -> SensorTable:
    """Read positions, names and directions of sensors.

    Parameters
    ----------
    path : path
    units : sequence of str
        Unit of length, for columns without a unit in their names.

    Raises
    ------
    MissingDataError, FormatError, InputError
        See :func:`~locatk.formats.tables.dialects.read_any_table` and
        :func:`~locatk.formats.tables.quantities.find_columns`; a cell is not a number, a position
        is not within 10 m, a direction has no length, or there is no row.
    """
    table = read_any_table(path)
    if not len(table):
        raise InputError("the table has no sensor", file=path, hint="Write one row a sensor")
    has_z = any(split_unit(name)[0] == "z" for name in table.columns)
    wanted = {axis: ("length",) for axis in ("x", "y", "z") if has_z or axis != "z"}
    found = find_columns(table, wanted, {}, units_by_quantity(units))
    position = np.zeros((len(table), 3))
    for index, (axis, column) in enumerate(found.items()):
        values = column.in_si()
        is_wrong = ~(np.abs(values) <= MAX_COORDINATE_M)
        if is_wrong.any():
            table.fail(
                int(np.argmax(is_wrong)),
                f"{axis} is empty or above {MAX_COORDINATE_M:g} m",
                "Check the unit of the column",
            )
        position[:, index] = values
    return SensorTable(position, _names(table), _normals(table))


def _names(table: Table) -> list[str] | None:
    if "name" not in table.columns:
        return None
    return [text_of_spreadsheet(cell.strip()) for cell in table.columns["name"]]


def _normals(table: Table) -> Array | None:
    """Return the directions, scaled to a length of 1; None without such columns."""
    if not any(name in table.columns for name in NORMAL_COLUMNS):
        return None
    for name in NORMAL_COLUMNS:
        table.require(name)
    normal = np.zeros((len(table), 3))
    for row in range(len(table)):
        cells = [table.columns[name][row] for name in NORMAL_COLUMNS]
        try:
            direction = np.array([float(cell) for cell in cells])
        except ValueError:
            direction = np.zeros(3)
        length = float(np.linalg.norm(direction))
        if not 0 < length < np.inf:
            table.fail(
                row, "nx, ny, nz are not a direction", "Give three numbers that are not all 0"
            )
        normal[row] = direction / length
    return normal
