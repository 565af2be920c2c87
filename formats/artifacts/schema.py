"""Declared TOML artifacts: one schema for validation, error messages and documentation.

An :class:`Artifact` is a table of keys (:class:`Key`: name, kind, meaning, default) and two
conversions, from a dataclass of :mod:`locatk.core` to values by key and back. Values are in SI: the
key ``spacing_mm`` has the value ``spacing_m`` (:attr:`Key.attribute`), so that most conversions are
the constructor of the dataclass. The tables of docs/formats.md are made of the schema by
``python .ci/artifact_tables.py``.

A validation library was not adopted. Measured with ``map.toml`` on CPython 3.11 (imports in
milliseconds; ``tomllib`` takes 13, and ``locatk --help`` may take 200):

============  ======  ==========================================================================
library       import  report of ``pich_mm`` instead of ``pitch_mm``
============  ======  ==========================================================================
pydantic 2.14    111  four lines: ``map.pitch_mm Field required``, ``map.pich_mm Extra inputs are
                      not permitted``, and two links
msgspec 0.22      27  ``Object contains unknown field `pich_mm` - at `$.map```
this module        -  ``FILE:map: missing key 'pitch_mm'. Hint: Is 'pich_mm' meant to be
                      pitch_mm?``
============  ======  ==========================================================================

pydantic accepts ``true`` as a number; msgspec accepts ``inf`` within a range, and has no ranges of
decimals, which exact units need. Both report neither the file nor the unit, so that every message
would have to be written anew, and the checks between keys would remain.
"""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import ArtifactError
from locatk.formats.artifacts import toml
from locatk.formats.artifacts.kinds import (
    ANY_NUMBER,
    MIN_KEY_SIMILARITY,
    NO_UNIT,
    UNITS,
    Integer,
    InvalidValueError,
    Kind,
    ListOf,
    Number,
    Text,
    Unit,
    nearest_key_hint,
    parse_key,
    type_name,
    unit_ending,
)
from locatk.formats.output import atomic_write, tool_version

T = TypeVar("T")
"""Dataclass of an artifact."""

Values = dict[str, Any]
"""Values of a table by :attr:`Key.attribute`."""

REQUIRED: Any = object()
"""Default of a key that must be present."""

MAX_FORMAT_VERSION = 10**6


# ---- kinds that need numpy or the TOML writer, which the module ``kinds`` must not import


@dataclass(frozen=True)
class Array:
    """Numbers in nested lists, as a float64 ndarray.

    Attributes
    ----------
    shape : tuple of int or None
        None as the first length: any number of rows from 1 to ``max_rows``.
    item : Number
    max_rows : int
    """

    shape: tuple[int | None, ...]
    item: Number = ANY_NUMBER
    max_rows: int = 0

    @property
    def expected(self) -> str:
        first = f"1 to {self.max_rows}" if self.shape[0] is None else str(self.shape[0])
        lengths = " rows of ".join([first, *map(str, self.shape[1:])])
        return f"a list of {lengths} {self.item.plural}"

    @property
    def plural(self) -> str:
        return self.expected.replace("a list", "lists", 1)

    def parse(self, value: Any, unit: Unit = NO_UNIT) -> NDArray[np.float64]:
        length = self.shape[0]
        is_valid = isinstance(value, list) and (
            1 <= len(value) <= self.max_rows if length is None else len(value) == length
        )
        if not is_valid:
            symbol = f" in {unit.symbol}" if unit.symbol else ""
            raise InvalidValueError(f"expected {self.expected}{symbol}")
        item = self.item if len(self.shape) == 1 else Array(self.shape[1:], self.item)
        rows = [parse_key(f"[{number}]", item, row, unit) for number, row in enumerate(value)]
        return np.array(rows, np.float64)

    def to_toml(self, value: Any, unit: Unit = NO_UNIT) -> Any:
        return _nested_lists(np.asarray(value, float).tolist(), unit)


def _nested_lists(value: Any, unit: Unit) -> Any:
    if isinstance(value, list):
        return [_nested_lists(item, unit) for item in value]
    return unit.from_si(value)


@dataclass(frozen=True)
class LinesOf(ListOf):
    """List of items of one kind, written with one item a line."""

    def to_toml(self, value: Any, unit: Unit = NO_UNIT) -> Any:
        return toml.Lines(super().to_toml(value, unit))


@dataclass(frozen=True)
class Key:
    """Key of a table.

    Attributes
    ----------
    name : str
        Key in the file; its ending is the unit (:data:`locatk.formats.artifacts.kinds.UNITS`).
    kind : Kind or Table or Variant
        Type and range.
    meaning : str
        For the documentation, without unit and default.
    default : value
        Value in SI if the key is missing.
    default_text : str
        Description of a default that is not written as such in the file, as in "unknown".
    comment : str
        Written above the key.
    is_si : bool
        Numbers are converted to SI; otherwise they stay in the unit of the file.
    value_name : str
        Name of the value if it is not that of the key with the ending of the SI unit.
    """

    name: str
    kind: Kind
    meaning: str = ""
    default: Any = REQUIRED
    default_text: str = ""
    comment: str = ""
    is_si: bool = True
    value_name: str = ""
    unit: Unit = field(init=False, repr=False, compare=False)
    attribute: str = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        ending = unit_ending(self.name)
        unit = UNITS.get(ending, NO_UNIT)
        if not self.is_si:
            unit = Unit(unit.symbol)
        name = self.name.removesuffix(ending) + unit.si_ending if unit.si_ending else self.name
        object.__setattr__(self, "unit", unit)
        object.__setattr__(self, "attribute", self.value_name or name)


@dataclass(frozen=True)
class Table:
    """Table with declared keys; other keys are refused.

    Attributes
    ----------
    keys : tuple of Key
        In the order of the file.
    convert : callable, optional
        From the values by attribute to the parsed value. It raises InvalidValueError for values
        that contradict each other, with the path of the key below this table.
    to_values : callable, optional
        Inverse of ``convert``: values by attribute. A value under ``"#"`` is a comment.
    is_inline : bool
        Written on one line.
    is_open : bool
        Other keys are ignored (:func:`unknown_keys` lists them).
    """

    keys: tuple[Key, ...]
    convert: Callable[[Values], Any] | None = None
    to_values: Callable[[Any], Mapping[str, Any]] | None = None
    is_inline: bool = False
    is_open: bool = False

    expected = "a table"
    plural = "tables"

    def parse(self, value: Any, unit: Unit = NO_UNIT) -> Any:
        if not isinstance(value, dict):
            raise InvalidValueError(f"expected a table, not {type_name(value)}")
        values = {key.attribute: self._parse_key(key, value) for key in self.keys}
        if not self.is_open:
            names = {key.name for key in self.keys}
            for name in value:
                if name not in names:
                    raise InvalidValueError(
                        f"unknown key {name!r}", hint=nearest_key_hint(name, names)
                    )
        return values if self.convert is None else self.convert(values)

    def _parse_key(self, key: Key, table: Mapping[str, Any]) -> Any:
        if key.name in table:
            return parse_key(key.name, key.kind, table[key.name], key.unit)
        if key.default is not REQUIRED:
            return key.default
        names = {known.name for known in self.keys}
        unknown = [name for name in table if name not in names]
        near = difflib.get_close_matches(key.name, unknown, 1, MIN_KEY_SIMILARITY)
        hint = None
        if isinstance(key.kind, Tables):
            hint = _TABLES_HINT.replace("{key}", f"{{key}}.{key.name}")
        elif isinstance(key.kind, Text):
            hint = key.kind.hint
        if near:
            hint = f"Is {near[0]!r} meant to be {key.name}?"
        raise InvalidValueError(f"missing key {key.name!r}", hint=hint)

    def to_toml(self, value: Any, unit: Unit = NO_UNIT) -> Any:
        values = value if self.to_values is None else self.to_values(value)
        table: dict[str, Any] = {"#": values.get("#")}
        for key in self.keys:
            item = values[key.attribute] if key.default is REQUIRED else values.get(key.attribute)
            if item is None or (_is_empty(item) and _is_empty(key.default)):
                continue
            if key.comment:
                table[f"# {key.name}"] = key.comment
            table[key.name] = key.kind.to_toml(item, key.unit)
        return toml.Inline({k: table[k] for k in table if k != "#"}) if self.is_inline else table


def _is_empty(value: Any) -> bool:
    return isinstance(value, str | tuple | list | Mapping | frozenset) and not value


@dataclass(frozen=True)
class Variant:
    """Table whose keys depend on the keys that are present or on their values.

    Attributes
    ----------
    choose : callable
        Return the table for a mapping of raw or of converted values.
    documented : Table
        The most general one, for the documentation.
    """

    choose: Callable[[Mapping[str, Any]], Table]
    documented: Table
    to_values: Callable[[Any], Mapping[str, Any]] | None = None

    expected = "a table"
    plural = "tables"

    def parse(self, value: Any, unit: Unit = NO_UNIT) -> Any:
        table = self.choose(value) if isinstance(value, dict) else self.documented
        return table.parse(value)

    def to_toml(self, value: Any, unit: Unit = NO_UNIT) -> Any:
        values = value if self.to_values is None else self.to_values(value)
        return self.choose(values).to_toml(values)


_TABLES_HINT = "Write each one under [[{key}]]"
_FORMAT_HINT = "This key names the kind of artifact: check that it is the right file"


@dataclass(frozen=True)
class Tables:
    """Array of tables."""

    table: Table | Variant
    min_count: int = 0

    expected = "tables"
    plural = "arrays of tables"

    def parse(self, value: Any, unit: Unit = NO_UNIT) -> tuple[Any, ...]:
        if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
            raise InvalidValueError("expected tables", "", _TABLES_HINT)
        if len(value) < self.min_count:
            raise InvalidValueError(f"expected at least {self.min_count}", "", _TABLES_HINT)
        return tuple(
            parse_key(f"[{number}]", self.table, item) for number, item in enumerate(value)
        )

    def to_toml(self, value: Any, unit: Unit = NO_UNIT) -> Any:
        return [self.table.to_toml(item) for item in value]


def unknown_keys(table: Table, data: Mapping[str, Any], path: str = "") -> Iterator[str]:
    """Yield the paths of the keys that a table does not declare."""
    names = {key.name for key in table.keys}
    for name in data:
        if name not in names:
            yield f"{path}.{name}" if path else name


# ---- checks between values


def refuse_repeated(values: Iterable[Any], table: str, key: str) -> None:
    """Raise InvalidValueError if two tables of an array have the same value of a key."""
    known = set()
    for number, value in enumerate(values):
        if value in known:
            shown = list(value) if isinstance(value, tuple) else value
            raise InvalidValueError(
                f"{shown!r} occurs twice", f"{table}[{number}].{key}", "Keep one of the two"
            )
        known.add(value)


def refuse_equal_positions(
    position: NDArray[np.float64], key: str, names: Sequence[Any] | None = None
) -> None:
    """Raise InvalidValueError if two of the positions (n, d) are equal; ``names`` are of rows."""
    _, first, count = np.unique(position, axis=0, return_index=True, return_counts=True)
    if (count > 1).any():
        index = int(first[count > 1][0])
        name = index if names is None else repr(names[index])
        raise InvalidValueError(f"two sensors at the position of sensor {name}", key)


# ---- artifacts


class AttachmentSource(Protocol):
    """Recording with attached files, as :class:`locatk.formats.sessions.reader.Session`."""

    @property
    def path(self) -> Any: ...

    def attachment(self, name: str) -> bytes | None:
        """Return the content of an attachment, or None."""


@dataclass(frozen=True)
class Artifact(Generic[T]):
    """Kind of TOML file, with methods that write it, read it, and find it in a recording.

    Attributes
    ----------
    file : str
        Name of the attachment that holds it in a session or a solution, as in ``"tag.toml"``.
    format : str
        Value of its key ``format``.
    table : Table or Variant
        Its keys below the header; parsed and written as the dataclass ``T``.
    version : int
        Newest ``format_version``.
    comment : str
        First line of the file.
    """

    file: str
    format: str
    table: Table | Variant
    version: int = 1
    comment: str = ""

    def dumps(self, value: T) -> str:
        """Return the TOML text; the same value gives the same text."""
        head = {"#": self.comment or None, **header(self.format, self.version)}
        body: dict[str, Any] = self.table.to_toml(value)
        return toml.dumps(head | {key: item for key, item in body.items() if key != "#"})

    def write(self, path: str | os.PathLike[str], value: T, *, overwrite: bool = False) -> None:
        """Write the TOML file.

        Raises
        ------
        OutputExistsError, MissingDataError
            See :func:`locatk.formats.output.atomic_write`.
        """
        with atomic_write(path, overwrite=overwrite) as stream:
            stream.write(self.dumps(value).encode())

    def read(self, path: str | os.PathLike[str]) -> T:
        """Read a file.

        Raises
        ------
        MissingDataError
            There is no such file.
        ArtifactError
            See :meth:`loads`.
        """
        return self._parse(toml.read(path), path)

    def loads(self, text: str | bytes, *, file: str | os.PathLike[str] | None = None) -> T:
        """Parse TOML text; errors name ``file``.

        Raises
        ------
        ArtifactError
            A key is missing, unknown or wrong, or values contradict each other; the error names
            the key and what is expected.
        """
        file = f"<{self._stem}>" if file is None else file
        return self._parse(toml.loads(text, file), file)

    def _parse(self, data: dict[str, Any], file: str | os.PathLike[str]) -> T:
        value: T = parse_document(data, file, self.format, self.version, self.table)
        return value

    def attached(self, session: AttachmentSource) -> T | None:
        """Return the artifact that is attached to a session, or None.

        Raises
        ------
        FormatError, ArtifactError
            The attachment is damaged, or not valid.
        """
        return self._attachment(session, self.file)

    def attached_for(self, session: AttachmentSource, device: str | None = None) -> T | None:
        """Return the artifact that is attached to a session for ``device``, or None.

        It is the attachment :meth:`file_for` the device if there is one, otherwise ``file``.

        Raises
        ------
        FormatError, ArtifactError
            See :meth:`attached`.
        """
        own = None if device is None else self._attachment(session, self.file_for(device))
        return self._attachment(session, self.file) if own is None else own

    def file_for(self, device: str) -> str:
        """Return the name of the attachment that holds the artifact of one device alone."""
        return f"{self._stem}-{device}.toml"

    @property
    def _stem(self) -> str:
        return self.file.removesuffix(".toml")

    def _attachment(self, session: AttachmentSource, name: str) -> T | None:
        data = session.attachment(name)
        return None if data is None else self.loads(data, file=f"{session.path}:{name}")


def header(format_name: str, version: int) -> dict[str, Any]:
    """Return the keys with which every artifact begins."""
    return {"format": format_name, "format_version": version, "tool_version": tool_version()}


def _header_table(*formats: str) -> Table:
    """Return the table of the header of a file of one of these formats (none: of any)."""
    return Table(
        (
            Key("format", Text(formats, hint=_FORMAT_HINT), "kind of the file"),
            Key("format_version", Integer(1, MAX_FORMAT_VERSION), "version of the format"),
            Key("tool_version", Text(), "version of locatk that wrote the file", ""),
        ),
        is_open=True,
    )


HEADER = _header_table()
"""Keys with which every artifact begins."""


def parse_document(
    data: dict[str, Any],
    file: str | os.PathLike[str],
    format_name: str,
    version: int,
    table: Table | Variant,
) -> Any:
    """Check the header of a parsed file, and parse its other keys.

    Raises
    ------
    ArtifactError
        With the file, the path of the key, and what is expected.
    """
    try:
        if _header_table(format_name).parse(data)["format_version"] > version:
            raise InvalidValueError(
                f"newer than {version}, the newest version that this locatk reads",
                "format_version",
                "Update locatk",
            )
        header_names = {key.name for key in HEADER.keys}
        body = {name: item for name, item in data.items() if name not in header_names}
        table = table.choose(body) if isinstance(table, Variant) else table
        for name in unknown_keys(table, body):
            if difflib.get_close_matches(name, header_names, 1, MIN_KEY_SIMILARITY):
                hint = nearest_key_hint(name, header_names)
                raise InvalidValueError(f"unknown key {name!r}", hint=hint)
        return table.parse(body)
    except InvalidValueError as error:
        raise _located(error, file) from None


def read_format(path: str | os.PathLike[str], formats: Sequence[str] = ()) -> str:
    """Return the key ``format`` of a TOML file.

    It is one of ``formats``; if these are empty, any text, and empty if the key is missing.

    Raises
    ------
    MissingDataError
        There is no such file.
    ArtifactError
        It is not TOML, or of another format.
    """
    default = REQUIRED if formats else ""
    table = Table(
        (Key("format", Text(tuple(formats), hint=_FORMAT_HINT), default=default),), is_open=True
    )
    try:
        name: str = table.parse(toml.read(path))["format"]
    except InvalidValueError as error:
        raise _located(error, path) from None
    return name


def _located(error: InvalidValueError, file: str | os.PathLike[str]) -> ArtifactError:
    path = re.sub(r"\[\d+\]", "", error.key)
    hint = error.hint
    if hint is not None:
        hint = hint.replace("{key}.", f"{path}." if path else "").replace("{key}", path)
    return ArtifactError(error.message, file=file, where=error.key or None, hint=hint)
