"""Columns of a table that somebody else has named, in units that somebody else has chosen.

Which column is what, and in which unit, is what the user says or what the header's names
say: ``x_mm``, ``heading [deg]``. What neither tells is not guessed.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import FormatError, InputError
from locatk.formats.tables.csv_table import TIME, Table

UNITS = {
    "time": {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0},
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "angle": {"rad": 1.0, "deg": math.pi / 180},
    "field": {"t": 1.0, "mt": 1e-3, "ut": 1e-6, "gauss": 1e-4, "v": 1.0, "mv": 1e-3},
}
"""By quantity: the units, and what one is in SI (times: in ns)."""

TIMES = ("t", "time", "timestamp")
"""What a column of times is called where nobody has named it."""


@dataclass(frozen=True)
class Column:
    """A column that was found, and its unit: "" for times that are dates."""

    table: Table
    name: str
    unit: str

    def numbers(self) -> NDArray[np.float64]:
        """As numbers in SI (times: in ns), ``nan`` where a cell is empty."""
        cells = self.table.columns[self.name]
        empty = np.array([cell.strip().lower() in ("", "nan") for cell in cells])
        texts = ["0" if gone else cell for gone, cell in zip(empty, cells, strict=True)]
        filled = Table(self.table.file, {self.name: texts}, self.table.lines)
        factor = next(of[self.unit] for of in UNITS.values() if self.unit in of)
        return np.where(empty, np.nan, factor * filled.floats(self.name))


def by_quantity(units: Sequence[str]) -> dict[str, str]:
    """Units that were given, by quantity.

    Raises
    ------
    InputError
        One is not known, or there are two of one quantity.
    """
    given: dict[str, str] = {}
    for unit in units:
        quantity = next((name for name, of in UNITS.items() if unit in of), None)
        if quantity is None:
            every = ", ".join(unit for of in UNITS.values() for unit in of)
            raise InputError(f"no unit {unit!r}", hint=f"Known are {every}")
        if given.setdefault(quantity, unit) != unit:
            raise InputError(
                f"two units of {quantity}, {given[quantity]} and {unit}",
                hint="Where columns differ, name them with their units, as in x_mm",
            )
    return given


def find(
    table: Table,
    quantities: Mapping[str, str],
    named: Mapping[str, str],
    given: Mapping[str, str],
) -> dict[str, Column]:
    """Column of each key, with its unit.

    Parameters
    ----------
    table : Table
    quantities : mapping of str to str
        By key, the quantity in :data:`UNITS`.
    named : mapping of str to str
        Headers of keys; a key that is not there has a column of its own name, with or
        without a unit behind it.
    given : mapping of str to str
        Unit of each quantity, for columns whose names tell none.

    Raises
    ------
    FormatError
        A column is missing, could be two or is two, or its unit is not known or said twice.
    InputError
        A key that is named is not in ``quantities``.
    """
    strangers = [key for key in named if key not in quantities]
    if strangers:
        raise InputError(
            f"nothing is called {strangers[0]!r}", hint=f"Columns are {', '.join(quantities)}"
        )
    found: dict[str, Column] = {}
    for key, quantity in quantities.items():
        name = _named(table, key, quantity, named)
        other = next((k for k, column in found.items() if column.name == name), None)
        if other is not None:
            raise FormatError(
                f"column {name!r} is both {other} and {key}",
                file=table.file,
                where=1,
                hint="Name another column for one of them",
            )
        found[key] = Column(table, name, _unit(table, quantity, name, given))
    return found


def _named(table: Table, key: str, quantity: str, named: Mapping[str, str]) -> str:
    """Header of one key."""
    if key in named:
        name = named[key].strip().lower()
        table.require(name)
        return name
    aliases = TIMES if quantity == "time" else (key.lower(),)
    found = [
        name
        for name in table.columns
        if name in aliases or any(_bare(name, unit) in aliases for unit in UNITS[quantity])
    ]
    if len(found) != 1:
        there = ", ".join(filter(None, table.columns)) or "no names"
        many = f"{len(found)} columns that may be {key}: {', '.join(found)}"
        raise FormatError(
            many if found else f"no column for {key}",
            file=table.file,
            where=1,
            hint=f"Say which it is with --columns {key}=NAME; the header has {there}",
        )
    return found[0]


def _bare(name: str, unit: str) -> str | None:
    """The header without its unit, None where it does not end in that."""
    match = re.fullmatch(rf"(.+?)(?:_{unit}| ?\[{unit}\]| ?\({unit}\))", name)
    return match[1] if match else None


def _unit(table: Table, quantity: str, name: str, given: Mapping[str, str]) -> str:
    """Unit of a column, by its name or as it was given."""
    if quantity == "time" and TIME.fullmatch(table.columns[name][0].strip()):
        return ""
    said = next((unit for unit in UNITS[quantity] if _bare(name, unit)), None)
    unit = given.get(quantity)
    if said and unit and said != unit:
        raise FormatError(
            f"column {name!r} is in {said} by its name, and was said to be in {unit}",
            file=table.file,
            where=1,
            hint=f"Leave {unit} out of --units, or rename the column",
        )
    if not (said or unit):
        raise FormatError(
            f"no unit of column {name!r}",
            file=table.file,
            where=1,
            hint=f"Say it with --units: one of {', '.join(UNITS[quantity])}",
        )
    return said or unit or ""
