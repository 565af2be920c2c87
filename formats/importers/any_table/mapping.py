"""File that names the columns of tables of one kind, their units and their clock.

::

    clock = "us, 32 bit"
    units = ["ut"]

    [columns]
    t = "Zeit"
    b0x = "Mag1 X"
    b0y = "Mag1 Y"
    b0z = "Mag1 Z"

All keys are optional. ``locatk import table`` prints the recognised columns in this form.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from locatk.core.errors import ArtifactError, InputError
from locatk.core.landmarks.halls import NAMES as HALL_NAMES
from locatk.formats.artifacts import toml
from locatk.formats.artifacts.kinds import nearest_key_hint, type_name
from locatk.formats.importers.any_table.columns import ColumnGuess, check_key
from locatk.formats.tables.clocks import Clock, parse_clock
from locatk.formats.tables.quantities import canonical_unit, units_by_quantity

KEYS = ("clock", "units", "columns")


@dataclass(frozen=True)
class TableMapping:
    """Columns of a table as the user named them.

    Attributes
    ----------
    columns : dict of str to str
        Headers of keys (:mod:`.columns`).
    units : tuple of str
        At most one unit of each quantity, for columns without a unit in their names.
    clock : Clock or None
        Declared clock of the times.
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    units: tuple[str, ...] = ()
    clock: Clock | None = None

    def merge(self, other: TableMapping) -> TableMapping:
        """Return this mapping with the keys, units and clock of ``other`` instead of its own."""
        units = {**units_by_quantity(self.units), **units_by_quantity(other.units)}
        headers = {name.strip().lower() for name in other.columns.values()}
        columns = {
            key: name for key, name in self.columns.items() if name.strip().lower() not in headers
        }
        return TableMapping(
            {**columns, **other.columns}, tuple(units.values()), other.clock or self.clock
        )


def read_mapping(path: Path, halls: Iterable[str] = HALL_NAMES) -> TableMapping:
    """Read a mapping; ``halls`` are names of hall sensors.

    Raises
    ------
    MissingDataError, InputError
        The file is missing or not readable.
    ArtifactError
        It is not TOML, or has an unknown key or a wrong value.
    """
    document = toml.read(path)
    for key in document:
        if key not in KEYS:
            raise ArtifactError(
                f"unknown key {key!r}", file=path, where=key, hint=_unknown_key_hint(key, halls)
            )
    columns = document.get("columns", {})
    if not isinstance(columns, dict):
        raise _wrong_type(path, "columns", "a table", columns)
    for key, name in columns.items():
        if not isinstance(name, str) or not name.strip():
            raise _wrong_type(path, f"columns.{key}", "the header of a column", name)
    units = document.get("units", [])
    units = [units] if isinstance(units, str) else units
    if not isinstance(units, list) or not all(isinstance(unit, str) for unit in units):
        raise _wrong_type(path, "units", 'a list of units, as in ["ms", "ut"]', units)
    clock = document.get("clock")
    if clock is not None and not isinstance(clock, str):
        raise _wrong_type(path, "clock", 'a clock, as in "us, 32 bit"', clock)
    try:
        where = "columns"
        for key in columns:
            check_key(key, halls)
        where = "units"
        units_by_quantity(units)
        where = "clock"
        parsed = None if clock is None else parse_clock(clock)
    except InputError as error:
        raise ArtifactError(error.message, file=path, where=where, hint=error.hint) from None
    return TableMapping(columns, tuple(map(canonical_unit, units)), parsed)


def dumps_mapping(guess: ColumnGuess, mapping: TableMapping) -> str:
    """Return the text of a file that names all columns that are used, with their units."""
    units = {**guess.units, **units_by_quantity(mapping.units)}
    return toml.dumps(
        {
            "clock": None if mapping.clock is None else mapping.clock.text,
            "units": list(units.values()) or None,
            "columns": guess.headers,
        }
    )


def _unknown_key_hint(key: str, halls: Iterable[str]) -> str:
    """Return the hint for an unknown key at the top, which may be that of a column."""
    try:
        check_key(key, halls)
    except InputError:
        return nearest_key_hint(key, KEYS)
    return f"Write {key} below the line [columns]"


def _wrong_type(path: Path, key: str, expected: str, value: Any) -> ArtifactError:
    is_blank = isinstance(value, str) and not value.strip()
    return ArtifactError(
        f"expected {expected}, not {'a blank string' if is_blank else type_name(value)}",
        file=path,
        where=key,
    )
