"""Kinds of values in TOML files: types, ranges, units and their descriptions.

Artifacts (:mod:`locatk.formats.artifacts.schema`) and settings of the simulators
(:mod:`locatk.formats.settings.setting`) declare their keys with these kinds. A kind validates a
value as the TOML parser returns it (``parse``) or as text of the command line (``parse_text``),
converts it to the types of TOML (``to_toml``), and describes itself for error messages and
documentation (``expected``, ``plural``).

The ending of a key is its unit (:data:`UNITS`). Values stay in the units of the file unless a unit
is passed. A unit converts between the decimal digits of the file and SI without rounding twice: 0.1
m are written as ``100.0`` mm and read as the same float, and so are radians that are written in
degrees.

This module imports the standard library only, so that commands that use it start fast.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from decimal import Context, Decimal, DecimalException
from pathlib import Path
from typing import Any, Protocol

_EXACT = Context(prec=50)
_DEGREE = _EXACT.divide(Decimal("3.14159265358979323846264338327950288419716939937511"), 180)

MIN_KEY_SIMILARITY = 0.6
"""Least similarity of two keys for a suggestion (:func:`difflib.get_close_matches`)."""


class InvalidValueError(ValueError):
    """Value that differs from what its key declares.

    Attributes
    ----------
    message : str
        The problem, without a full stop.
    key : str
        Path from the parsed value to the invalid one, as in ``"sheets[2].origin"``; empty for the
        parsed value itself.
    hint : str or None
        The remedy; ``{key}`` in it stands for the path from the root of the file.
    """

    def __init__(self, message: str, key: str = "", hint: str | None = None) -> None:
        super().__init__(message)
        self.message, self.key, self.hint = message, key, hint

    def below(self, key: str) -> InvalidValueError:
        """Return the error with a path that begins with ``key``."""
        separator = "" if not self.key or self.key.startswith("[") else "."
        return InvalidValueError(self.message, f"{key}{separator}{self.key}", self.hint)


# ---- units


@dataclass(frozen=True)
class Unit:
    """Unit of the numbers of a key.

    Attributes
    ----------
    symbol : str
    factor : Decimal
        From this unit to the one in SI, to 50 digits.
    si_ending : str
        Ending of the name of a value in SI, as in ``"_m"``; empty if the value is not converted.
    """

    symbol: str = ""
    factor: Decimal = Decimal(1)
    si_ending: str = ""

    def to_si(self, number: int | Decimal) -> float:
        """Convert digits of the file to a float in SI; infinite if it is too large."""
        try:
            return float(_EXACT.multiply(Decimal(number), self.factor))
        except (DecimalException, OverflowError):
            return math.inf

    def from_si(self, value: float) -> float | Decimal:
        """Return the digits of the file that :meth:`to_si` converts to ``value``."""
        value = float(value)
        if self.factor == 1 or not math.isfinite(value):
            return value
        if self.factor.as_tuple().digits == (1,):  # the decimal point moves
            return _EXACT.divide(Decimal(repr(value)), self.factor)
        exact = _EXACT.divide(Decimal(value), self.factor)
        shorter = (Context(prec=digits).create_decimal(exact) for digits in range(1, _EXACT.prec))
        return next((number for number in shorter if self.to_si(number) == value), exact)


UNITS = {
    "_mm": Unit("mm", Decimal("1e-3"), "_m"),
    "_um": Unit("um", Decimal("1e-6"), "_m"),
    "_t": Unit("T"),
    "_mt": Unit("mT", Decimal("1e-3"), "_t"),
    "_ut": Unit("uT", Decimal("1e-6"), "_t"),
    "_deg": Unit("deg", _DEGREE, "_rad"),
    "_deg_per_m": Unit("deg/m", _DEGREE, "_rad_per_m"),
    "_dps": Unit("deg/s", _DEGREE, "_rps"),
    "_dps2": Unit("deg/s2", _DEGREE, "_rps2"),
    "_mps": Unit("m/s"),
    "_mps2": Unit("m/s2"),
    "_s": Unit("s"),
    "_ms": Unit("ms", Decimal("1e-3"), "_s"),
    "_hz": Unit("Hz"),
    "_px": Unit("px"),
    "_per_m": Unit("1/m"),
    "_grey": Unit("grey values"),
    "_percent": Unit("percent"),
    "_pitches": Unit("pitches"),
    "_udeg": Unit("microdegrees"),
    "_mw": Unit("mW", Decimal("1e-3"), "_w"),
    "_wh": Unit("Wh"),
    "_fraction": Unit("fraction"),
}
"""Endings of keys and their units. Percentages and microdegrees are converted by their users."""

NO_UNIT = Unit()


def unit_ending(key: str) -> str:
    """Return the longest ending of a key that is a unit; empty if there is none."""
    return max((ending for ending in UNITS if key.endswith(ending)), key=len, default="")


# ---- kinds


class Kind(Protocol):
    """Type and range of a value."""

    @property
    def expected(self) -> str:
        """Description of one valid value, with its article: "a number above 0"."""

    @property
    def plural(self) -> str:
        """Description of several values: "numbers above 0"."""

    def parse(self, value: Any, unit: Unit = NO_UNIT) -> Any:
        """Validate a value as the TOML parser returns it, and convert numbers to SI.

        Raises
        ------
        InvalidValueError
        """

    def to_toml(self, value: Any, unit: Unit = NO_UNIT) -> Any:
        """Return a value in the types of TOML; inverse of :meth:`parse`."""


class TextKind(Kind, Protocol):
    """Type and range of a value that an option of the command line can set."""

    def parse_text(self, text: str) -> Any:
        """Validate and convert a value of the command line.

        Raises
        ------
        ValueError
        """


def type_name(value: Any) -> str:
    """Describe the type of a TOML value."""
    if isinstance(value, bool):
        return "true or false"
    names = ((str, "a string"), (int | Decimal | float, "a number"), (list, "a list"))
    for types, name in (*names, (dict, "a table")):
        if isinstance(value, types):
            return name
    return "a date or time"


def nearest_key_hint(key: str, known: Iterable[str]) -> str:
    """Return the hint for an unknown key: the nearest known one, or all of them."""
    names = sorted(known)
    near = difflib.get_close_matches(key, names, 1, MIN_KEY_SIMILARITY)
    return f"Did you mean {near[0]}?" if near else f"Known keys: {', '.join(names)}"


MAX_MAGNITUDE = 1e12
"""Largest number in an artifact, in the unit of its key: a million kilometres in millimetres. The
squares of much larger ones overflow."""

MIN_POSITIVE = 1 / MAX_MAGNITUDE
"""Smallest number of a range that begins above 0; the reciprocals of much smaller ones overflow."""

MAX_VARIANCE = MAX_MAGNITUDE**2
"""Largest element of a covariance."""


@dataclass(frozen=True)
class Number:
    """Finite number within a range, which may exclude its ends; nan only if it is allowed."""

    low: float = -math.inf
    high: float = math.inf
    is_low_excluded: bool = False
    is_high_excluded: bool = False
    is_nan_allowed: bool = False
    hint: str | None = None
    max_magnitude: float = MAX_MAGNITUDE

    @property
    def expected(self) -> str:
        return f"a number{self._range}"

    @property
    def plural(self) -> str:
        return f"numbers{self._range}"

    @property
    def _range(self) -> str:
        if math.isinf(self.low) and math.isinf(self.high):
            return ""
        if math.isinf(self.high):
            return f" above {self.low:g}" if self.is_low_excluded else f" of at least {self.low:g}"
        end = f"below {self.high:g}" if self.is_high_excluded else f"{self.high:g}"
        if self.is_low_excluded:
            return f" above {self.low:g}, at most {end}"
        return f" from {self.low:g} to {end}"

    def parse(self, value: Any, unit: Unit = NO_UNIT) -> float:
        symbol = f" in {unit.symbol}" if unit.symbol else ""
        if isinstance(value, bool) or not isinstance(value, int | float | Decimal):
            raise InvalidValueError(f"expected {self.expected}{symbol}, not {type_name(value)}")
        digits = Decimal(repr(value)) if isinstance(value, float) else value
        number = NO_UNIT.to_si(digits)
        if math.isnan(number) and self.is_nan_allowed:
            return number
        if not math.isfinite(number):
            raise InvalidValueError(f"expected a finite number{self._range}{symbol}", "", self.hint)
        if abs(number) > self.max_magnitude:
            raise InvalidValueError(
                f"expected a number of at most {self.max_magnitude:g} in magnitude{symbol}"
            )
        if self.is_low_excluded and 0 < number - self.low < MIN_POSITIVE:
            raise InvalidValueError(
                f"expected a number that exceeds {self.low:g} by {MIN_POSITIVE:g} or more{symbol}"
            )
        is_above = number > self.low if self.is_low_excluded else number >= self.low
        is_below = number < self.high if self.is_high_excluded else number <= self.high
        if not (is_above and is_below):
            raise InvalidValueError(f"expected {self.expected}{symbol}", "", self.hint)
        return number if unit.factor == 1 else unit.to_si(digits)

    def parse_text(self, text: str) -> float:
        return self.parse(float(text))

    def to_toml(self, value: Any, unit: Unit = NO_UNIT) -> Any:
        return unit.from_si(value)


@dataclass(frozen=True)
class Integer:
    """Whole number from ``low`` to ``high`` (None: any)."""

    low: int = 0
    high: int | None = None

    @property
    def expected(self) -> str:
        return f"a whole number{self._range}"

    @property
    def plural(self) -> str:
        return f"whole numbers{self._range}"

    @property
    def _range(self) -> str:
        if self.high is None:
            return f" of at least {self.low}"
        return f" from {self.low} to {self.high}"

    def parse(self, value: Any, unit: Unit = NO_UNIT) -> int:
        if (
            isinstance(value, bool)
            or not isinstance(value, int)
            or value < self.low
            or (self.high is not None and value > self.high)
        ):
            raise InvalidValueError(f"expected {self.expected}")
        return value

    def parse_text(self, text: str) -> int:
        return self.parse(int(text))

    def to_toml(self, value: Any, unit: Unit = NO_UNIT) -> Any:
        return int(value)


@dataclass(frozen=True)
class Boolean:
    """True or false."""

    expected = "true or false"
    plural = "values true or false"

    def parse(self, value: Any, unit: Unit = NO_UNIT) -> bool:
        if not isinstance(value, bool):
            raise InvalidValueError(f"expected true or false, not {type_name(value)}")
        return value

    def to_toml(self, value: Any, unit: Unit = NO_UNIT) -> Any:
        return bool(value)


@dataclass(frozen=True)
class Text:
    """String, one of ``choices`` unless these are empty.

    With ``max_length``, it is one line of at most so many printable characters.
    """

    choices: tuple[str, ...] = ()
    is_blank_allowed: bool = True
    hint: str | None = None
    max_length: int | None = None

    @property
    def expected(self) -> str:
        if self.choices:
            return " or ".join(f'"{choice}"' for choice in self.choices)
        blank = "" if self.is_blank_allowed else " that is not blank"
        return f"a string{self._length}{blank}"

    @property
    def plural(self) -> str:
        length = self._length
        return (
            f"strings{length}" if self.is_blank_allowed else f"strings{length} that are not blank"
        )

    @property
    def _length(self) -> str:
        return "" if self.max_length is None else f" of at most {self.max_length} characters"

    def parse(self, value: Any, unit: Unit = NO_UNIT) -> str:
        if not isinstance(value, str):
            raise InvalidValueError(f"expected a string, not {type_name(value)}")
        if self.choices and value not in self.choices:
            choices = ", ".join(self.choices)
            raise InvalidValueError(
                f"{value!r} is not one of {choices}"
                if len(self.choices) > 1
                else f"expected {choices!r}, not {value!r}",
                "",
                self.hint,
            )
        if not (self.is_blank_allowed or value.strip()):
            raise InvalidValueError(f"expected {self.expected}")
        if self.max_length is not None:
            if len(value) > self.max_length:
                raise InvalidValueError(f"expected {self.expected}, not {len(value)}")
            if not value.isprintable():
                raise InvalidValueError("expected one line of printable characters")
        return value

    def parse_text(self, text: str) -> str:
        return self.parse(text)

    def to_toml(self, value: Any, unit: Unit = NO_UNIT) -> Any:
        return str(value)


@dataclass(frozen=True)
class FilePath:
    """Name of a file, relative to the folder of the TOML file, or one of ``names``."""

    names: tuple[str, ...] = ()

    expected = "the name of a file"
    plural = "names of files"

    def parse(self, value: Any, unit: Unit = NO_UNIT) -> str:
        if not isinstance(value, str) or not value:
            raise InvalidValueError(f"expected {self.expected}")
        return value

    def resolve(self, value: str, folder: Path) -> str:
        """Return the path of a file that is named in a TOML file of ``folder``."""
        return value if value in self.names else str(folder / value)

    def to_toml(self, value: Any, unit: Unit = NO_UNIT) -> Any:
        return str(value)


@dataclass(frozen=True)
class Row:
    """List of a fixed number of items of one kind; on the command line as in ``2,3``."""

    item: TextKind
    count: int

    @property
    def expected(self) -> str:
        return f"a list of {self.count} {self.item.plural}"

    @property
    def plural(self) -> str:
        return f"lists of {self.count} {self.item.plural}"

    def parse(self, value: Any, unit: Unit = NO_UNIT) -> tuple[Any, ...]:
        try:
            if isinstance(value, list) and len(value) == self.count:
                return tuple(self.item.parse(item, unit) for item in value)
        except InvalidValueError:
            pass  # the description of the whole list is clearer than that of one item
        raise InvalidValueError(f"expected {self.expected}")

    def parse_text(self, text: str) -> tuple[Any, ...]:
        parts = text.split(",")
        if len(parts) != self.count:
            raise ValueError(f"expected {self.count} values with a comma between them")
        return tuple(map(self.item.parse_text, parts))

    def to_toml(self, value: Any, unit: Unit = NO_UNIT) -> Any:
        return [self.item.to_toml(item, unit) for item in value]


@dataclass(frozen=True)
class Record:
    """Inline table with exactly these keys, as a tuple; on the command line as in ``2,3:0``.

    Values stay in the units of the file.
    """

    fields: Mapping[str, TextKind]

    @property
    def expected(self) -> str:
        return f"a table with the keys {', '.join(self.fields)}"

    @property
    def plural(self) -> str:
        return f"tables with the keys {', '.join(self.fields)}"

    def parse(self, value: Any, unit: Unit = NO_UNIT) -> tuple[Any, ...]:
        if not isinstance(value, dict):
            raise InvalidValueError(f"expected {self.expected}")
        for key in value:
            if key not in self.fields:
                hint = nearest_key_hint(key, self.fields)
                raise InvalidValueError(f"unknown key {key!r}", hint=hint)
        for key in self.fields:
            if key not in value:
                raise InvalidValueError(f"missing key {key!r}")
        return tuple(parse_key(key, kind, value[key]) for key, kind in self.fields.items())

    def parse_text(self, text: str) -> tuple[Any, ...]:
        parts = text.split(":")
        if len(parts) != len(self.fields):
            raise ValueError(f"expected {len(self.fields)} values with a colon between them")
        kinds = self.fields.values()
        return tuple(kind.parse_text(part) for kind, part in zip(kinds, parts, strict=True))

    def to_toml(self, value: Any, unit: Unit = NO_UNIT) -> Any:
        items = zip(self.fields.items(), value, strict=True)
        return {key: kind.to_toml(item) for (key, kind), item in items}


def parse_key(key: str, kind: Kind, value: Any, unit: Unit = NO_UNIT) -> Any:
    """Parse the value of a key; an error names the key."""
    try:
        return kind.parse(value, unit)
    except InvalidValueError as error:
        raise error.below(key) from None


@dataclass(frozen=True)
class ListOf:
    """List of items of one kind; on the command line a repeated option."""

    item: Kind
    min_count: int = 0
    max_count: int | None = None

    @property
    def expected(self) -> str:
        count = ""
        if self.max_count is not None:
            count = f"{self.min_count} to {self.max_count} "
        elif self.min_count:
            count = "one or more " if self.min_count == 1 else f"at least {self.min_count} "
        return f"a list of {count}{self.item.plural}"

    @property
    def plural(self) -> str:
        return f"lists of {self.item.plural}"

    def parse(self, value: Any, unit: Unit = NO_UNIT) -> tuple[Any, ...]:
        if not isinstance(value, list):
            raise InvalidValueError(f"expected {self.expected}, not {type_name(value)}")
        max_count = len(value) if self.max_count is None else self.max_count
        if not self.min_count <= len(value) <= max_count:
            raise InvalidValueError(f"expected {self.expected}, not {len(value)}")
        return tuple(
            parse_key(f"[{number}]", self.item, item, unit) for number, item in enumerate(value)
        )

    def to_toml(self, value: Any, unit: Unit = NO_UNIT) -> Any:
        return [self.item.to_toml(item, unit) for item in value]


ANY_NUMBER = Number()
POSITIVE = Number(0.0, is_low_excluded=True)
NOT_NEGATIVE = Number(0.0)
FRACTION = Number(0.0, 1.0)
FRACTION_BELOW_1 = Number(0.0, 1.0, is_high_excluded=True)
CELL = Row(Integer(), 2)
"""Row and column of a cell of a map."""

MAX_REMANENCE_T = 2.0
"""Above the remanence of any magnet: larger numbers are in another unit."""

REMANENCE = Number(
    0.0,
    MAX_REMANENCE_T,
    is_low_excluded=True,
    hint="10,000 gauss are 1 tesla; N52 has 1.45",
)
