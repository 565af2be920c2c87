"""Reading TOML strictly and writing it deterministically, for all artifacts.

Numbers are read as decimals, so that a length in mm becomes one in metres by moving
the point: ``0.1`` m is written as ``100.0`` mm and comes back as the same float, and so do
radians that are written in degrees.
"""

from __future__ import annotations

import difflib
import math
import os
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from decimal import Context, Decimal, DecimalException
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import ArtifactError
from locatk.formats.files import read_bytes

_REQUIRED: Any = object()
_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")

_EXACT = Context(prec=50)
_DEGREE = _EXACT.divide(Decimal("3.14159265358979323846264338327950288419716939937511"), 180)


def read(path: str | os.PathLike[str]) -> Table:
    """Parse the file at ``path``.

    Raises
    ------
    MissingDataError
        There is no such file.
    InputError
        It cannot be read.
    ArtifactError
        It is not TOML; see :func:`loads`.
    """
    return loads(read_bytes(path), path)


def check_format(table: Table, name: str, version: int) -> None:
    """Refuse an artifact that is not of the format ``name``, or newer than ``version``.

    Reads the three keys with which every artifact begins: ``format``,
    ``format_version`` and ``tool_version``.
    """
    if table.text("format") != name:
        raise table.error("format", f"expected {name!r}")
    if table.integer("format_version", 1, 10**6) > version:
        raise table.error(
            "format_version", f"newer than {version}, which this locatk knows", "Update locatk"
        )
    table.text("tool_version", None)


def loads(text: str | bytes, file: str | os.PathLike[str]) -> Table:
    """Parse ``text``; ``file`` is what errors call it.

    Raises
    ------
    ArtifactError
        It is not TOML; ``where`` is the line.
    """
    try:
        decoded = text.decode("utf-8") if isinstance(text, bytes) else text
    except UnicodeDecodeError as error:
        where = error.object[: error.start].count(b"\n") + 1
        raise ArtifactError(
            "not UTF-8 text", file=file, where=where, hint="give a TOML artifact, not a recording"
        ) from None
    try:
        data = tomllib.loads(decoded.removeprefix("\ufeff"), parse_float=_decimal)
    except (ValueError, DecimalException, RecursionError) as error:
        message = str(error)
        found = re.search(r" \(at (?:line (\d+), column \d+|end of document)\)$", message)
        line = found[1] or decoded.count("\n") + 1 if found else None
        message = message[: found.start()] if found else message
        raise ArtifactError(
            f"not valid TOML ({message[:1].lower()}{message[1:]})", file=file, where=line
        ) from None
    return Table(data, file, "")


def _decimal(text: str) -> Decimal:
    try:
        return Decimal(text)
    except DecimalException:  # an exponent of twenty digits
        return Decimal("inf")


class Table:
    """A table that is read key by key; each method checks what it takes.

    Each raises ArtifactError with the file, the key's path and what was expected.
    """

    def __init__(self, data: dict[str, Any], file: str | os.PathLike[str], path: str) -> None:
        self._data = data
        self._file = file
        self._path = path
        self._known: set[str] = set()

    def __contains__(self, key: str) -> bool:
        return key in self._data

    def __iter__(self) -> Iterator[str]:
        """Keys that are there, in the order of the file."""
        return iter(self._data)

    def error(self, key: str, message: str, hint: str | None = None) -> ArtifactError:
        """The error to raise about ``key`` (``""`` for the table itself)."""
        where = self._path if not key else f"{self._path}.{key}" if self._path else key
        return ArtifactError(message, file=self._file, where=where or None, hint=hint)

    def end(self) -> None:
        """Refuse keys that nobody has asked for."""
        for key in self._data:
            if key not in self._known:
                near = difflib.get_close_matches(key, self._known, 1, 0.6)
                hint = (
                    f"Did you mean {near[0]}?"
                    if near
                    else "Known keys: " + ", ".join(sorted(self._known))
                )
                raise self.error(key, f"unknown key {key!r}", hint)

    def text(self, key: str, default: Any = _REQUIRED, choices: Sequence[str] | None = None) -> Any:
        """A string, of ``choices`` if given."""
        value = self._get(key, default)
        if value is default:
            return value
        if not isinstance(value, str):
            raise self.error(key, f"expected a string, not {_kind(value)}")
        if choices is not None and value not in choices:
            raise self.error(key, f"{value!r} is not one of {', '.join(choices)}")
        return value

    def texts(self, key: str, default: Any = _REQUIRED) -> Any:
        """A list of strings, as a tuple."""
        value = self._get(key, default)
        if value is default:
            return value
        if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
            raise self.error(key, "expected a list of strings")
        return tuple(value)

    def flag(self, key: str, default: Any = _REQUIRED) -> Any:
        """True or false."""
        value = self._get(key, default)
        if value is not default and not isinstance(value, bool):
            raise self.error(key, f"expected true or false, not {_kind(value)}")
        return value

    def integer(self, key: str, low: int, high: int, default: Any = _REQUIRED) -> Any:
        """A whole number from ``low`` to ``high``."""
        value = self._get(key, default)
        if value is default:
            return value
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise self.error(key, f"expected a whole number from {low} to {high}")
        return value

    def number(self, key: str, default: Any = _REQUIRED, *, shift: int = 0) -> Any:
        """A finite number as float, times 10 to the power of ``shift`` (-3: mm to m)."""
        value = self._get(key, default)
        return value if value is default else self._float(key, value, shift, False)

    def array(
        self, key: str, shape: tuple[int, ...], *, shift: int = 0, nan: bool = False
    ) -> NDArray[np.float64]:
        """Numbers in nested lists of exactly ``shape``; ``nan`` allows not-a-number."""
        value = self._get(key, _REQUIRED)
        flat = list(self._flat(key, value, shape))
        numbers = [self._float(key, item, shift, nan) for item in flat]
        return np.array(numbers, np.float64).reshape(shape)

    def angle(self, key: str, default: Any = _REQUIRED) -> Any:
        """A finite number of degrees as a float in radians."""
        value = self._get(key, default)
        return value if value is default else self._radians(key, value)

    def angles(self, key: str, count: int) -> NDArray[np.float64]:
        """A list of ``count`` numbers of degrees, in radians."""
        flat = self._flat(key, self._get(key, _REQUIRED), (count,))
        return np.array([self._radians(key, item) for item in flat])

    def raw(self, key: str, default: Any = _REQUIRED) -> Any:
        """The value as it is, for the caller to check."""
        return self._get(key, default)

    def table(self, key: str, default: Any = _REQUIRED) -> Any:
        """A table."""
        value = self._get(key, default)
        if value is default:
            return value
        if not isinstance(value, dict):
            raise self.error(key, f"expected a table, not {_kind(value)}")
        return Table(value, self._file, self._below(key))

    def tables(self, key: str) -> list[Table]:
        """A list of tables, empty where the key is missing."""
        value = self._get(key, [])
        if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
            raise self.error(key, f"expected tables: write them under [[{self._below(key)}]]")
        path = self._below(key)
        return [Table(item, self._file, f"{path}[{n}]") for n, item in enumerate(value)]

    def _below(self, key: str) -> str:
        return f"{self._path}.{key}" if self._path else key

    def _get(self, key: str, default: Any) -> Any:
        self._known.add(key)
        value = self._data.get(key, default)
        if value is _REQUIRED:
            unknown = [name for name in self._data if name not in self._known]
            near = difflib.get_close_matches(key, unknown, 1, 0.6)
            hint = f"Is {near[0]!r} meant to be {key}?" if near else None
            raise self.error(key, f"missing key {key!r}", hint)
        return value

    def _float(self, key: str, value: Any, shift: int, nan: bool) -> float:
        if isinstance(value, bool) or not isinstance(value, int | Decimal):
            raise self.error(key, f"expected a number, not {_kind(value)}")
        try:
            number = float(Decimal(value).scaleb(shift))
        except (DecimalException, OverflowError):
            number = math.inf
        if math.isinf(number) or (math.isnan(number) and not nan):
            raise self.error(key, "expected a finite number")
        return number

    def _radians(self, key: str, value: Any) -> float:
        self._float(key, value, 0, False)
        return _radians(Decimal(value))

    def _flat(self, key: str, value: Any, shape: tuple[int, ...]) -> Iterator[Any]:
        if not shape:
            yield value
            return
        if not isinstance(value, list) or len(value) != shape[0]:
            wanted = " rows of ".join(str(n) for n in shape)
            raise self.error(key, f"expected a list of {wanted} numbers")
        for item in value:
            yield from self._flat(key, item, shape[1:])


def _kind(value: Any) -> str:
    if isinstance(value, bool):
        return "true or false"
    for kinds, name in (
        (str, "a string"),
        (int | Decimal, "a number"),
        (list, "a list"),
        (dict, "a table"),
    ):
        if isinstance(value, kinds):
            return name
    return "a date or time"


@dataclass(frozen=True)
class Inline:
    """A table to be written on one line, as in ``{ a = 1 }``."""

    items: Mapping[str, Any]


@dataclass(frozen=True)
class Shifted:
    """Numbers to be written times 10 to the power of ``shift`` (3: m to mm), exactly."""

    value: float | NDArray[np.float64]
    shift: int


@dataclass(frozen=True)
class Degrees:
    """Angles in radians to be written in degrees, exactly."""

    value: float | NDArray[np.float64]


def dumps(table: Mapping[str, Any]) -> str:
    """TOML text of nested mappings.

    A list of mappings becomes an array of tables; a value under the key ``"#"`` a
    comment; None is left out. Floats are written so that they are read back unchanged.
    """
    lines: list[str] = []
    _emit(table, "", lines)
    return "\n".join(lines).strip() + "\n"


def _emit(table: Mapping[str, Any], path: str, lines: list[str]) -> None:
    below: list[tuple[str, str, Mapping[str, Any]]] = []
    for key, value in table.items():
        name = f"{path}.{_key(key)}" if path else _key(key)
        if value is None:
            continue
        if key == "#":
            lines.append(f"# {value}")
        elif isinstance(value, Mapping):
            below.append((f"[{name}]", name, value))
        elif isinstance(value, list) and value and isinstance(value[0], Mapping):
            below += [(f"[[{name}]]", name, item) for item in value]
        else:
            lines.append(f"{_key(key)} = {_value(value)}")
    for header, name, item in below:
        lines += ["", header]
        _emit(item, name, lines)


def _key(key: str) -> str:
    return key if _BARE_KEY.fullmatch(key) else _string(key)


def _value(value: Any) -> str:
    if isinstance(value, Inline):
        inside = ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items.items())
        return f"{{ {inside} }}"
    if isinstance(value, Shifted):
        numbers = np.asarray(value.value)
        if numbers.ndim == 2:
            return _rows(_shifted(row, value.shift) for row in numbers.tolist())
        return _shifted(numbers.tolist(), value.shift)
    if isinstance(value, Degrees):
        if isinstance(value.value, np.ndarray):
            return "[" + ", ".join(_plain(_degrees(x)) for x in value.value.tolist()) + "]"
        return _plain(_degrees(value.value))
    if isinstance(value, np.ndarray):
        return _value(value.tolist())
    if isinstance(value, list | tuple):
        if value and isinstance(value[0], list | tuple):  # a matrix: one row a line
            return _rows(map(_value, value))
        return "[" + ", ".join(_value(item) for item in value) + "]"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return _shifted(value, 0)
    return _string(str(value))


def _shifted(value: Any, shift: int) -> str:
    if isinstance(value, list):
        return "[" + ", ".join(_shifted(item, shift) for item in value) + "]"
    if not math.isfinite(value):  # nan, inf, -inf: the same words in TOML
        return repr(float(value))
    return _plain(Decimal(repr(float(value))).scaleb(shift))


def _plain(number: Decimal) -> str:
    if not -12 < number.adjusted() < 17:
        return f"{number:E}" if number else "-0.0" if number.is_signed() else "0.0"
    text = f"{number:f}"
    return text if "." in text else f"{text}.0"


def _rows(texts: Iterable[str]) -> str:
    return "[\n" + "".join(f"  {text},\n" for text in texts) + "]"


def _radians(degrees: Decimal) -> float:
    return float(_EXACT.multiply(degrees, _DEGREE))


def _degrees(radians: float) -> Decimal:
    """The shortest number of degrees that :func:`_radians` takes to ``radians``."""
    exact = _EXACT.divide(Decimal(radians), _DEGREE)
    shorter = (Context(prec=n).create_decimal(exact) for n in range(1, _EXACT.prec))
    return next((short for short in shorter if _radians(short) == radians), exact)


def _string(text: str) -> str:
    escapes = {"\\": "\\\\", '"': '\\"', "\n": "\\n", "\r": "\\r", "\t": "\\t"}
    out = []
    for character in text:
        if character in escapes:
            out.append(escapes[character])
        elif ord(character) < 32 or ord(character) == 127:
            out.append(f"\\u{ord(character):04x}")
        else:
            out.append(character)
    return '"' + "".join(out) + '"'
