"""TOML text: parsing with exact decimals, and deterministic writing.

``tomllib`` parses; floats become :class:`decimal.Decimal`, so that units are converted without an
intermediate rounding (:class:`locatk.formats.artifacts.kinds.Unit`). The standard library has no
writer. tomlkit 0.15 would keep the comments of a file that is edited in place, but locatk writes
whole artifacts only, from dataclasses, and it parses a map of 100 kB in 0.50 s instead of the
0.03 s of ``tomllib``.
"""

from __future__ import annotations

import math
import os
import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from decimal import Decimal, DecimalException
from typing import Any

from locatk.core.errors import ArtifactError
from locatk.formats.files import MAX_TEXT_BYTES, read_bytes

MAX_KEY_PARTS = 16
"""Most parts of a dotted key, of which no file of locatk needs more than four.

The time that ``tomllib`` takes grows with their square.
"""

_KEY_PART = r"""(?:[A-Za-z0-9_-]++|"[^"\n]*+"|'[^'\n]*+')"""
_DOTTED_KEY = re.compile(rf"{_KEY_PART}(?:[ \t]*+\.[ \t]*+{_KEY_PART})*+")

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")


def read(path: str | os.PathLike[str]) -> dict[str, Any]:
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
    return loads(read_bytes(path, MAX_TEXT_BYTES), path)


def loads(text: str | bytes, file: str | os.PathLike[str]) -> dict[str, Any]:
    """Parse TOML text, with floats as decimals; errors name ``file``.

    Raises
    ------
    ArtifactError
        It is not TOML; ``where`` is the line.
    """
    try:
        decoded = text.decode("utf-8") if isinstance(text, bytes) else text
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise ArtifactError(
            "not UTF-8 text", file=file, where=line, hint="Give a TOML artifact, not a recording"
        ) from None
    if _longest_key(decoded) > MAX_KEY_PARTS:
        raise ArtifactError(
            f"not valid TOML (a key of more than {MAX_KEY_PARTS} parts)",
            file=file,
            hint="Check that it is the right file",
        )
    try:
        return tomllib.loads(decoded.removeprefix("\ufeff"), parse_float=_parse_decimal)
    except (ValueError, DecimalException, RecursionError) as error:
        message = str(error)
        position = re.search(r" \(at (?:line (\d+), column \d+|end of document)\)$", message)
        where = position[1] or decoded.count("\n") + 1 if position else None
        message = message[: position.start()] if position else message
        raise ArtifactError(
            f"not valid TOML ({message[:1].lower()}{message[1:]})", file=file, where=where
        ) from None


def _longest_key(text: str) -> int:
    """Return the number of parts of the longest dotted key, in linear time."""
    keys = (match[0] for match in _DOTTED_KEY.finditer(text))
    long_keys = (key for key in keys if key.count(".") >= MAX_KEY_PARTS)
    return max((len(re.findall(_KEY_PART, key)) for key in long_keys), default=1)


def _parse_decimal(text: str) -> Decimal:
    try:
        return Decimal(text)
    except DecimalException:  # an exponent of twenty digits
        return Decimal("inf")


@dataclass(frozen=True)
class Inline:
    """Table to be written on one line, as in ``{ a = 1 }``."""

    items: Mapping[str, Any]


@dataclass(frozen=True)
class Lines:
    """List to be written with one item a line."""

    items: list[Any]


def dumps(table: Mapping[str, Any]) -> str:
    """Return the TOML text of nested mappings.

    A list of mappings becomes an array of tables, a list of lists a row a line. The value of a key
    that begins with ``#`` becomes a comment; None is left out. Floats are written with the fewest
    digits that are read as the same float.
    """
    lines: list[str] = []
    _append_table(table, "", lines)
    return "\n".join(lines).strip() + "\n"


def _append_table(table: Mapping[str, Any], path: str, lines: list[str]) -> None:
    nested: list[tuple[str, str, Mapping[str, Any]]] = []
    for key, value in table.items():
        name = f"{path}.{_key(key)}" if path else _key(key)
        if value is None:
            continue
        if key.startswith("#"):
            lines.extend(f"# {line}" for line in value.splitlines())
        elif isinstance(value, Mapping):
            nested.append((f"[{name}]", name, value))
        elif isinstance(value, list) and value and isinstance(value[0], Mapping):
            nested += [(f"[[{name}]]", name, item) for item in value]
        else:
            lines.append(f"{_key(key)} = {_value(value)}")
    for header, name, item in nested:
        lines += ["", header]
        _append_table(item, name, lines)


def _key(key: str) -> str:
    return key if _BARE_KEY.fullmatch(key) else _string(key)


def _value(value: Any) -> str:
    if isinstance(value, Inline):
        items = ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items.items())
        return f"{{ {items} }}"
    if isinstance(value, Lines):
        return _lines(map(_item, value.items))
    if isinstance(value, list):
        if value and isinstance(value[0], list):
            return _lines(map(_item, value))
        return _item(value)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, Decimal):
        return _decimal(value)
    if isinstance(value, float):
        # nan, inf and -inf are the same words in TOML.
        return _decimal(Decimal(repr(value))) if math.isfinite(value) else repr(value)
    return _string(str(value))


def _item(value: Any) -> str:
    """Format an item of a list, on one line."""
    if isinstance(value, list):
        return f"[{', '.join(map(_item, value))}]"
    return _value(value)


def _lines(texts: Iterable[str]) -> str:
    return "[\n" + "".join(f"  {text},\n" for text in texts) + "]"


def _decimal(number: Decimal) -> str:
    if not -12 < number.adjusted() < 17:
        return f"{number:E}" if number else "-0.0" if number.is_signed() else "0.0"
    text = f"{number:f}"
    return text if "." in text else f"{text}.0"


def _string(text: str) -> str:
    escapes = {"\\": "\\\\", '"': '\\"', "\n": "\\n", "\r": "\\r", "\t": "\\t"}
    characters = []
    for character in text:
        if character in escapes:
            characters.append(escapes[character])
        elif ord(character) < 32 or ord(character) == 127:
            characters.append(f"\\u{ord(character):04x}")
        else:
            characters.append(character)
    return '"' + "".join(characters) + '"'
