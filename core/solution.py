"""Result of a solver: trajectories, detections, warnings and the artifact they refer to.

Detections and facts are dataclasses, one type of each per system (``core/<system>/results.py``).
:func:`to_json` and :func:`from_json` convert them to and from the JSON form that is documented in
docs/formats.md. The JSON form follows from the declaration of a field:

- its key is the name of the field, or ``metadata["json"]`` if the stable key is another one;
- a field that is None by default is left out if it is None, unless ``metadata["json_null"]`` is
  true; every other field is always written, None as null;
- nan stands for an unknown number. JSON has no nan: null is read as nan if the field is declared
  as ``float``, and as None if it is declared as ``float | None``.
"""

from __future__ import annotations

import functools
import math
import types
import typing
from collections import Counter
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, replace
from typing import Any, TypeVar

import numpy as np

from locatk.core.trajectory import Trajectory

Record = TypeVar("Record")


@dataclass(frozen=True)
class SolverWarning:
    """An assumption or a doubt that the user of a solution must know.

    Attributes
    ----------
    code : str
        Stable identifier for programs, as in ``"unit_scale"``; ``"unspecified"`` if the file of
        an earlier version has a message only.
    message : str
        One line for people. Its wording may change; never test it.
    """

    code: str
    message: str

    def about(self, subject: str) -> SolverWarning:
        """Return the same warning with the name of a device in front of its message."""
        return replace(self, message=f"{subject}: {self.message}")


@dataclass(frozen=True)
class GenericRecord:
    """Detection or facts of a system that locatk has no type for, in their JSON form.

    Attributes
    ----------
    values : mapping of str to object
    """

    values: Mapping[str, Any]


@dataclass(frozen=True)
class Solution:
    """Result of one solver for one session.

    Attributes
    ----------
    system : str
        ``"lighthouse"``, ``"polaris"``, ``"dots"`` or ``"landmarks"``.
    method : str
        Name of the algorithm, as in ``"bundle"`` or ``"paper"``.
    trajectories : tuple of Trajectory
        One per device, accepted poses only.
    rejected : dict of str to int
        Number of observations that were not used, by reason.
    detections : tuple of dataclass
        Observations of the infrastructure: ``StationDetection``, ``TagDetection``,
        ``DotDetection`` or ``LandmarkDetection``; :class:`GenericRecord` of other systems.
    artifact : object
        The scene, tag, sheet or map that the poses refer to (solved or given).
    warnings : tuple of SolverWarning
        Assumptions and doubts, each once.
    facts : dataclass or None
        Further numbers of the run, for ``--json`` and reports: ``LighthouseFacts``,
        ``PolarisFacts``, ``DotFacts`` or ``LandmarkFacts``; :class:`GenericRecord` of other
        systems.
    """

    system: str
    method: str
    trajectories: tuple[Trajectory, ...]
    rejected: dict[str, int] = field(default_factory=dict)
    detections: tuple[Any, ...] = ()
    artifact: Any = None
    warnings: tuple[SolverWarning, ...] = ()
    facts: Any = None

    @property
    def poses(self) -> int:
        """Number of accepted poses over all devices."""
        return sum(len(t) for t in self.trajectories)

    def __repr__(self) -> str:
        return (
            f"<Solution: {self.system} by {self.method}, {self.poses} poses of "
            f"{len(self.trajectories)} devices, {len(self.warnings)} warnings>"
        )


def add_counts(*tables: Mapping[str, int]) -> dict[str, int]:
    """Add numbers of rejected observations by reason, and drop those that are zero."""
    total: Counter[str] = Counter()
    for table in tables:
        total.update(table)
    return {reason: count for reason, count in total.items() if count}


def to_json(record: Any) -> Any:
    """Return the JSON form of a dataclass, or of a value in one.

    Arrays and tuples become lists. Numbers that are not finite are kept; the writer of a file
    replaces them by null.
    """
    if type(record) in _PLAIN_TYPES:
        return record
    if isinstance(record, GenericRecord):
        return to_json(record.values)
    if is_dataclass(record) and not isinstance(record, type):
        table = {}
        for item in _layout(type(record)):
            value = getattr(record, item.name)
            if value is not None or not item.is_optional:
                # There may be a million numbers; a call for each would take most of the time.
                table[item.key] = value if type(value) in _PLAIN_TYPES else to_json(value)
        return table
    if isinstance(record, np.generic | np.ndarray):
        return record.tolist()
    if isinstance(record, list | tuple):
        return [to_json(value) for value in record]
    if isinstance(record, Mapping):
        return {str(key): to_json(value) for key, value in record.items()}
    return record


def from_json(kind: type[Record], table: Mapping[str, Any]) -> Record:
    """Build a dataclass from its JSON form; inverse of :func:`to_json`.

    Unknown keys are ignored, so that files of later versions stay readable.

    Raises
    ------
    KeyError
        A key without default is missing.
    TypeError
        A value is not of the type that its field declares.
    """
    if not isinstance(table, Mapping):
        raise TypeError(f"a {type(table).__name__} is no {kind.__name__}")
    if kind is GenericRecord:
        return typing.cast(Record, GenericRecord(dict(table)))
    values = {}
    for item in _layout(kind):  # type: ignore[arg-type]
        if item.key in table:
            value = table[item.key]
            is_as_declared = type(value) is item.kind
            values[item.name] = value if is_as_declared else _converted(item.kind, value)
        elif not item.has_default:
            raise KeyError(item.key)
    return kind(**values)


_PLAIN_TYPES = frozenset({type(None), bool, int, float, str})
"""Types that are their own JSON form; most values, so that they are looked up first."""


@dataclass(frozen=True)
class _Field:
    """Field of a dataclass as :func:`to_json` and :func:`from_json` see it.

    Attributes
    ----------
    name, key : str
        Name of the attribute, and key of the JSON form.
    kind : type
        As declared.
    has_default : bool
    is_optional : bool
        Left out if it is None.
    """

    name: str
    key: str
    kind: Any
    has_default: bool
    is_optional: bool


@functools.cache
def _layout(kind: Any) -> tuple[_Field, ...]:
    """Return the fields of a dataclass; resolving the types takes longer than building a record."""
    hints = typing.get_type_hints(kind)
    return tuple(
        _Field(
            item.name,
            item.metadata.get("json", item.name),
            hints[item.name],
            item.default is not MISSING or item.default_factory is not MISSING,
            item.default is None and not item.metadata.get("json_null", False),
        )
        for item in fields(kind)
    )


_NUMBERS: dict[Any, tuple[type, ...]] = {
    bool: (bool, np.bool_),
    int: (int, np.integer),
    float: (int, float, np.integer, np.floating),
    str: (str,),
}
"""Types of the values that a field of each scalar type accepts."""


def _converted(kind: Any, value: Any) -> Any:
    """Convert a value of a JSON table to the type that a field declares."""
    if kind in _NUMBERS:
        if value is None and kind is float:
            return math.nan
        is_bool_for_number = kind in (int, float) and isinstance(value, bool)
        if is_bool_for_number or not isinstance(value, _NUMBERS[kind]):
            raise TypeError(f"a {type(value).__name__} is no {kind.__name__}")
        return value
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (types.UnionType, typing.Union):
        if value is None and type(None) in arguments:
            return None
        kinds = [each for each in arguments if each is not type(None)]
        return _converted(kinds[0], value) if len(kinds) == 1 else value
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise TypeError(f"a {type(value).__name__} is no list")
        if len(arguments) == 2 and arguments[1] is Ellipsis:
            return tuple(_converted(arguments[0], each) for each in value)
        if len(value) != len(arguments):
            raise TypeError(f"{len(value)} values where {len(arguments)} are expected")
        return tuple(_converted(k, v) for k, v in zip(arguments, value, strict=True))
    if origin is dict:
        if not isinstance(value, Mapping):
            raise TypeError(f"a {type(value).__name__} is no object")
        return {str(key): _converted(arguments[1], each) for key, each in value.items()}
    if is_dataclass(kind):
        return from_json(typing.cast(type, kind), value)
    return value
