"""Names of table columns: the quantity that each contains, and its unit.

A name is a quantity with its unit behind it, in capitals or not: ``x_mm``, ``x [mm]``, ``x(mm)``.
A table of :class:`ColumnKind` declares the columns that a reader knows; :func:`match_column`
compares one name with it, :func:`find_columns` finds all columns that a reader needs.
A unit that neither the name nor the user states is an error: it is never guessed.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import FormatError, InputError
from locatk.core.inertial import STANDARD_GRAVITY_M_S2
from locatk.formats.tables.delimited import Table
from locatk.formats.tables.timestamps import is_iso_time

UNITS: Mapping[str, Mapping[str, float]] = {
    "time": {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0},
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "angle": {"rad": 1.0, "deg": math.pi / 180},
    "field": {"t": 1.0, "mt": 1e-3, "ut": 1e-6, "nt": 1e-9, "gauss": 1e-4},
    "voltage": {"v": 1.0, "mv": 1e-3},
    "temperature": {"c": 1.0, "celsius": 1.0},
    "acceleration": {
        "m/s2": 1.0,
        "g": STANDARD_GRAVITY_M_S2,
        "mg": STANDARD_GRAVITY_M_S2 / 1000,
    },
    "angular rate": {"rad/s": 1.0, "deg/s": math.pi / 180},
    "ticks": {"6mhz": 1 / 6e6, "24mhz": 1 / 24e6, "48mhz": 1 / 48e6},
}
"""Units of each quantity, and their factors to SI (times to nanoseconds; degrees Celsius stay).

Ticks are durations, counted by a clock of this frequency.
"""

UNIT_SPELLINGS = {
    "m/s^2": "m/s2",
    "m/s\u00b2": "m/s2",
    "m/s/s": "m/s2",
    "m_s2": "m/s2",
    "mps2": "m/s2",
    "ms2": "m/s2",
    "rad_s": "rad/s",
    "radps": "rad/s",
    "rads": "rad/s",
    "deg_s": "deg/s",
    "degps": "deg/s",
    "dps": "deg/s",
    "\u00b0/s": "deg/s",
    "\u00b0": "deg",
}
"""Other spellings of units of :data:`UNITS`, in lower case."""

TIME_NAMES = ("t", "time", "timestamp")
"""Names of a column of times."""

_UNIT = r"m_s2|rad_s|deg_s|[a-z0-9/^\u00b0\u00b2]+"
_NAME_WITH_UNIT = re.compile(rf"(.+?)(?:_({_UNIT})| ?\[({_UNIT})\]| ?\(({_UNIT})\))")


class ColumnKind(NamedTuple):
    """Declaration of a kind of column.

    Attributes
    ----------
    field : str
        Name of the kind in the reader.
    pattern : re.Pattern
        Matches the name without its unit, in lower case. Its groups are the key of a column
        among those of its kind: an index, an axis.
    quantities : tuple of str
        Quantities of :data:`UNITS` that the column can contain; none for a plain number.
    factor : float
        Factor to SI of a plain number.
    """

    field: str
    pattern: re.Pattern[str]
    quantities: tuple[str, ...] = ()
    factor: float = 1.0


class ColumnMatch(NamedTuple):
    """Column of a declared kind.

    Attributes
    ----------
    kind : ColumnKind
    key : tuple of str
        Groups of the pattern.
    unit : str
        Empty if the name has none.
    factor : float
        Factor to SI; ``nan`` if a unit is needed and the name has none.
    """

    kind: ColumnKind
    key: tuple[str, ...]
    unit: str
    factor: float


def canonical_unit(text: str) -> str:
    """Return a unit in the spelling of :data:`UNITS`; another text in lower case."""
    plain = text.strip().lower().replace("\u00b5", "u").replace("\u03bc", "u")
    return UNIT_SPELLINGS.get(plain, plain)


def factor_of(unit: str) -> float:
    """Return the factor of a unit of :data:`UNITS` to SI."""
    return next(units[unit] for units in UNITS.values() if unit in units)


def split_unit(name: str) -> tuple[str, str]:
    """Split the name of a column into the name without its unit and the unit, in lower case.

    The unit is empty if the name has no known one.

    Examples
    --------
    >>> split_unit("B0X_uT"), split_unit("heading [deg]"), split_unit("hall_left")
    (('b0x', 'ut'), ('heading', 'deg'), ('hall_left', ''))
    """
    plain = name.strip().lower().replace("\u00b5", "u").replace("\u03bc", "u")
    match = _NAME_WITH_UNIT.fullmatch(plain)
    if match is None:
        return plain, ""
    unit = canonical_unit(match[2] or match[3] or match[4])
    return (match[1], unit) if any(unit in units for units in UNITS.values()) else (plain, "")


def match_column(name: str, kinds: Iterable[ColumnKind]) -> ColumnMatch | None:
    """Return the first kind that a name agrees with; None if there is none."""
    bare, unit = split_unit(name)
    for kind in kinds:
        match = kind.pattern.fullmatch(bare)
        if match is None or (unit and not any(unit in UNITS[q] for q in kind.quantities)):
            continue
        factor = kind.factor if not kind.quantities else factor_of(unit) if unit else math.nan
        return ColumnMatch(kind, match.groups(), unit, factor)
    return None


# ---- columns that a reader needs, with help of the user


@dataclass(frozen=True)
class Column:
    """Column of a table.

    Attributes
    ----------
    table : Table
    name : str
        Its header.
    unit : str
        Empty for times in ISO 8601.
    """

    table: Table
    name: str
    unit: str

    def in_si(self) -> NDArray[np.float64]:
        """Return the numbers (n,) in SI (times [ns]), ``nan`` for empty cells."""
        return factor_of(self.unit) * self.table.floats(self.name, allow_missing=True)


def units_by_quantity(units: Sequence[str]) -> dict[str, str]:
    """Return the given units by quantity.

    Raises
    ------
    InputError
        A unit is unknown, or there are two of one quantity.
    """
    given: dict[str, str] = {}
    for unit in map(canonical_unit, units):
        quantity = next((name for name, known in UNITS.items() if unit in known), None)
        if quantity is None:
            names = ", ".join(name for known in UNITS.values() for name in known)
            raise InputError(f"unknown unit {unit!r}", hint=f"Use one of {names}")
        if given.setdefault(quantity, unit) != unit:
            raise InputError(
                f"two units of {quantity}, {given[quantity]} and {unit}",
                hint="If columns differ, name them with their units, as in x_mm",
            )
    return given


def find_columns(
    table: Table,
    quantities: Mapping[str, tuple[str, ...]],
    headers: Mapping[str, str],
    units: Mapping[str, str],
) -> dict[str, Column]:
    """Find the column of each key.

    Parameters
    ----------
    table : Table
    quantities : mapping of str to tuple of str
        Key to the quantities of :data:`UNITS` that it can have.
    headers : mapping of str to str
        Headers of keys as the user named them. Any other key has a column of its own name, with
        or without a unit; a key of times also one of :data:`TIME_NAMES`.
    units : mapping of str to str
        Unit of each quantity, for columns without a unit in their names.

    Raises
    ------
    FormatError
        A column is missing or ambiguous, or its unit is unknown or contradicts ``units``.
    InputError
        ``headers`` contains a key that is not in ``quantities``.
    """
    unknown = [key for key in headers if key not in quantities]
    if unknown:
        raise InputError(
            f"unknown column key {unknown[0]!r}", hint=f"Keys are {', '.join(quantities)}"
        )
    columns: dict[str, Column] = {}
    for key, allowed in quantities.items():
        if key in headers:
            name = headers[key].strip().lower()
            table.require(name)
        else:
            name = _find_header(table, key, allowed)
        other = next((k for k, column in columns.items() if column.name == name), None)
        if other is not None:
            raise FormatError(
                f"column {name!r} is used for both {other} and {key}",
                file=table.file,
                where=1,
                hint="Name another column for one of them",
            )
        columns[key] = Column(table, name, _unit_of(table, name, allowed, units))
    return columns


def _find_header(table: Table, key: str, allowed: tuple[str, ...]) -> str:
    """Return the only header that agrees with a key."""
    names = TIME_NAMES if "time" in allowed else (key.lower(),)
    # A name that ends like a unit is also one as a whole: a sensor may be called hall_t.
    patterns = re.compile("|".join(map(re.escape, names)))
    kind = ColumnKind(key, patterns, allowed)
    candidates = [name for name in table.columns if name in names or match_column(name, (kind,))]
    if len(candidates) == 1:
        return candidates[0]
    if candidates:
        problem = f"{len(candidates)} columns may be {key}: {', '.join(candidates)}"
    else:
        problem = f"a column for {key} is missing"
    header = ", ".join(filter(None, table.columns)) or "no names"
    raise FormatError(
        problem,
        file=table.file,
        where=1,
        hint=f"Name it with --columns {key}=NAME; the header has {header}",
    )


def _unit_of(table: Table, name: str, allowed: tuple[str, ...], units: Mapping[str, str]) -> str:
    """Return the unit of a column by its name or as given; empty for times in ISO 8601."""
    if "time" in allowed and is_iso_time(table.columns[name][0]):
        return ""
    known = [unit for quantity in allowed for unit in UNITS[quantity]]
    in_name = split_unit(name)[1]
    in_name = in_name if in_name in known else ""
    given = [units[quantity] for quantity in allowed if quantity in units]
    if in_name and given and in_name not in given:
        raise FormatError(
            f"column {name!r} is in {in_name} by its name, but in {given[0]} by --units",
            file=table.file,
            where=1,
            hint=f"Remove {given[0]} from --units, or rename the column",
        )
    if not in_name and len(given) != 1:
        raise FormatError(
            f"the unit of column {name!r} is {'ambiguous' if given else 'missing'}",
            file=table.file,
            where=1,
            hint=f"State one with --units: {', '.join(known)}",
        )
    return in_name or given[0]
