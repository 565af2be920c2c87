"""Settings of a simulation: keys, types and ranges, units, flags.

A kind of value is parsed from TOML (``parse``) and, if the setting has a flag, from the command
line (``parse_text``); both raise ValueError with a description of the valid values. Values stay in
the units of the file.

This module imports the standard library only, so that commands that use it start fast.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any, Protocol

NO_DEFAULT: Any = object()
"""Marks a setting whose default is that of an attribute of the simulator's options."""

UNITS = {
    "_mm": ("mm", 1e-3),
    "_um": ("um", 1e-6),
    "_mt": ("mT", 1e-3),
    "_ut": ("uT", 1e-6),
    "_deg": ("deg", math.pi / 180),
    "_deg_per_m": ("deg/m", math.pi / 180),
    "_dps": ("deg/s", math.pi / 180),
    "_dps2": ("deg/s2", math.pi / 180),
    "_mps": ("m/s", 1.0),
    "_mps2": ("m/s2", 1.0),
    "_s": ("s", 1.0),
    "_hz": ("Hz", 1.0),
    "_px": ("px", 1.0),
    "_per_m": ("1/m", 1.0),
    "_grey": ("grey values", 1.0),
    "_percent": ("percent", 1.0),
    "_pitches": ("pitches", 1.0),
    "_udeg": ("microdegrees", 1.0),
    "_fraction": ("fraction", 1.0),
}
"""Endings of keys: the unit's symbol and the factor to the unit of the simulators."""


class Kind(Protocol):
    """Type and range of a setting."""

    def parse(self, value: Any) -> Any:
        """Validate and convert a value as the TOML parser returns it."""

    def parse_text(self, text: str) -> Any:
        """Validate and convert a value of the command line."""

    def to_toml(self, value: Any) -> Any:
        """Return a value in the types of TOML."""


@dataclass(frozen=True)
class Number:
    """Finite number within a range, which may exclude its ends."""

    low: float = -math.inf
    high: float = math.inf
    is_low_excluded: bool = False
    is_high_excluded: bool = False

    @property
    def expected(self) -> str:
        """Description of the valid numbers."""
        if math.isinf(self.low) and math.isinf(self.high):
            return "a number"
        if math.isinf(self.high):
            return f"a number above {self.low:g}" if self.is_low_excluded else (
                f"a number of at least {self.low:g}"
            )  # fmt: skip
        end = f"below {self.high:g}" if self.is_high_excluded else f"{self.high:g}"
        return f"a number from {self.low:g} to {end}"

    def parse(self, value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float | Decimal):
            raise ValueError(f"expected {self.expected}")
        number = float(value)
        is_above = number > self.low if self.is_low_excluded else number >= self.low
        is_below = number < self.high if self.is_high_excluded else number <= self.high
        if not (math.isfinite(number) and is_above and is_below):
            raise ValueError(f"expected {self.expected}")
        return number

    def parse_text(self, text: str) -> float:
        return self.parse(float(text))

    def to_toml(self, value: Any) -> Any:
        return float(value)


@dataclass(frozen=True)
class Integer:
    """Whole number from ``low`` to ``high`` (None: any)."""

    low: int = 0
    high: int | None = None

    @property
    def expected(self) -> str:
        """Description of the valid numbers."""
        if self.high is None:
            return f"a whole number of at least {self.low}"
        return f"a whole number from {self.low} to {self.high}"

    def parse(self, value: Any) -> int:
        if (
            isinstance(value, bool)
            or not isinstance(value, int)
            or value < self.low
            or (self.high is not None and value > self.high)
        ):
            raise ValueError(f"expected {self.expected}")
        return value

    def parse_text(self, text: str) -> int:
        return self.parse(int(text))

    def to_toml(self, value: Any) -> Any:
        return int(value)


@dataclass(frozen=True)
class Boolean:
    """True or false."""

    def parse(self, value: Any) -> bool:
        if not isinstance(value, bool):
            raise ValueError("expected true or false")
        return value

    def parse_text(self, text: str) -> bool:
        return self.parse({"true": True, "false": False}.get(text))

    def to_toml(self, value: Any) -> Any:
        return bool(value)


@dataclass(frozen=True)
class Text:
    """A string, of ``choices`` unless these are empty."""

    choices: tuple[str, ...] = ()

    def parse(self, value: Any) -> str:
        if not isinstance(value, str):
            raise ValueError("expected a string")
        if self.choices and value not in self.choices:
            raise ValueError(f"{value!r} is not one of {', '.join(self.choices)}")
        return value

    def parse_text(self, text: str) -> str:
        return self.parse(text)

    def to_toml(self, value: Any) -> Any:
        return str(value)


@dataclass(frozen=True)
class FilePath:
    """Name of a file, relative to the folder of the TOML file, or one of ``names``."""

    names: tuple[str, ...] = ()

    def parse(self, value: Any) -> str:
        if not isinstance(value, str) or not value:
            raise ValueError("expected the name of a file")
        return value

    def parse_text(self, text: str) -> str:
        return self.parse(text)

    def resolve(self, value: str, folder: Path) -> str:
        """Return the path of a file that is named in a TOML file of ``folder``."""
        return value if value in self.names else str(folder / value)

    def to_toml(self, value: Any) -> Any:
        return str(value)


@dataclass(frozen=True)
class Row:
    """List of a fixed number of items of one kind; on the command line as in ``2,3``."""

    item: Kind
    count: int

    def parse(self, value: Any) -> tuple[Any, ...]:
        if not isinstance(value, list) or len(value) != self.count:
            raise ValueError(f"expected a list of {self.count}")
        return tuple(map(self.item.parse, value))

    def parse_text(self, text: str) -> tuple[Any, ...]:
        parts = text.split(",")
        if len(parts) != self.count:
            raise ValueError(f"expected {self.count} values with a comma between them")
        return tuple(map(self.item.parse_text, parts))

    def to_toml(self, value: Any) -> Any:
        return [self.item.to_toml(item) for item in value]


@dataclass(frozen=True)
class Record:
    """Inline table with exactly these keys, as a tuple; on the command line as in ``2,3:0``."""

    fields: Mapping[str, Kind]

    def parse(self, value: Any) -> tuple[Any, ...]:
        if not isinstance(value, dict):
            raise ValueError(f"expected a table with the keys {', '.join(self.fields)}")
        for key in value:
            if key not in self.fields:
                near = difflib.get_close_matches(key, self.fields, 1, 0.6)
                meant = f"did you mean {near[0]}?" if near else f"expected {', '.join(self.fields)}"
                raise ValueError(f"unknown key {key!r}: {meant}")
        missing = [key for key in self.fields if key not in value]
        if missing:
            raise ValueError(f"missing key {missing[0]!r}")
        return tuple(_parse_field(key, kind, value[key]) for key, kind in self.fields.items())

    def parse_text(self, text: str) -> tuple[Any, ...]:
        parts = text.split(":")
        if len(parts) != len(self.fields):
            raise ValueError(f"expected {len(self.fields)} values with a colon between them")
        kinds = self.fields.values()
        return tuple(kind.parse_text(part) for kind, part in zip(kinds, parts, strict=True))

    def to_toml(self, value: Any) -> Any:
        items = zip(self.fields.items(), value, strict=True)
        return {key: kind.to_toml(item) for (key, kind), item in items}


def _parse_field(key: str, kind: Kind, value: Any) -> Any:
    try:
        return kind.parse(value)
    except ValueError as error:
        raise ValueError(f"{key}: {error}") from None


@dataclass(frozen=True)
class ListOf:
    """List of any number of items of one kind; on the command line a repeated option."""

    item: Kind

    def parse(self, value: Any) -> tuple[Any, ...]:
        if not isinstance(value, list):
            raise ValueError("expected a list")
        return tuple(map(self.item.parse, value))

    def parse_text(self, text: str) -> tuple[Any, ...]:
        return (self.item.parse_text(text),)

    def to_toml(self, value: Any) -> Any:
        return [self.item.to_toml(item) for item in value]


ANY_NUMBER = Number()
POSITIVE = Number(0.0, is_low_excluded=True)
NOT_NEGATIVE = Number(0.0)
FRACTION = Number(0.0, 1.0)
FRACTION_BELOW_1 = Number(0.0, 1.0, is_high_excluded=True)
CELL = Row(Integer(), 2)
"""Row and column of a cell of a map."""


@dataclass(frozen=True)
class Setting:
    """One option of a simulation.

    Attributes
    ----------
    key : str
        Table and key in the file, as in ``"robot.speed_mps"``; its ending is the unit
        (:data:`UNITS`).
    kind : Kind
        Type and range.
    help : str
        Meaning, as a sentence without unit and default.
    field : str
        Attribute of the simulator's options, with dots for nested ones, of which the default is
        taken. Empty for a setting that the module of the system converts.
    flag : str
        Option of the command line, as in ``"--speed"``; empty if there is none.
    former_flag : str
        Option of earlier versions that this key replaces.
    default : value
        Default in units of the file, if it is not that of the attribute ``field``.
    default_text : str
        Description of a default that is not a value, as in "the clearance of the tag".
    example : value
        Shown in the file if there is no default value; in units of the file.
    metavar : str
        Form of the value of the flag, if it is not that of the unit or the kind.
    """

    key: str
    kind: Kind
    help: str
    field: str = ""
    flag: str = ""
    former_flag: str = ""
    default: Any = NO_DEFAULT
    default_text: str = ""
    example: Any = None
    metavar: str = ""

    @property
    def table(self) -> str:
        return self.key.partition(".")[0]

    @property
    def name(self) -> str:
        """Key inside its table."""
        return self.key.partition(".")[2]

    @property
    def title(self) -> str:
        """Name for messages: the flag, or the key with its table."""
        return self.flag.split("/")[0] or f"{self.name} of [{self.table}]"

    @property
    def unit(self) -> str:
        """Symbol of the unit, empty if there is none."""
        return UNITS[self._ending][0] if self._ending else ""

    @property
    def factor(self) -> float:
        """Factor from the unit of the file to that of the simulators."""
        return UNITS[self._ending][1] if self._ending else 1.0

    @property
    def _ending(self) -> str:
        if not isinstance(self.kind, Number):
            return ""
        return max((end for end in UNITS if self.name.endswith(end)), key=len, default="")


@dataclass(frozen=True)
class Requirement:
    """A setting that is valid only with certain values of another one (none: any value)."""

    key: str
    other: str
    values: tuple[Any, ...] = ()
