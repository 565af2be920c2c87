"""Result of a solver: trajectories, detections, warnings and the artifact they refer to.

Detections and facts are dataclasses, one type per system. :func:`to_json` and :func:`from_json`
convert them to and from the JSON form that is documented in docs/formats.md.
"""

from __future__ import annotations

import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
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
        Stable identifier for programs, as in ``"unit_scale"``.
    message : str
        One line for people. Its wording may change; never test it.
    """

    code: str
    message: str


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
    detections : list of dict
        What the system saw, in the JSON form of docs/formats.md.
    artifact : object
        The scene, tag, sheet or map that the poses refer to (solved or given).
    notes : tuple of str
        Each assumption that a reader must know: unit scale, generic calibration, ...
    facts : dict
        Further numbers of the run for ``--json`` and reports.
    warnings : tuple of SolverWarning
        Assumptions and doubts, each once.
    """

    system: str
    method: str
    trajectories: tuple[Trajectory, ...]
    rejected: dict[str, int] = field(default_factory=dict)
    detections: list[Any] = field(default_factory=list)
    artifact: Any = None
    notes: tuple[str, ...] = ()
    facts: Any = field(default_factory=dict)
    warnings: tuple[SolverWarning, ...] = ()

    @property
    def poses(self) -> int:
        """Number of accepted poses over all devices."""
        return sum(len(t) for t in self.trajectories)


def to_json(record: Any) -> Any:
    """Return the JSON form of a dataclass, or of a value in one.

    Fields become keys in their order, named by their metadata ``"json"`` if they have it. A field
    that is None by default is left out if it is None; arrays and tuples become lists.
    """
    if is_dataclass(record) and not isinstance(record, type):
        table = {}
        for item in fields(record):
            value = getattr(record, item.name)
            if value is not None or item.default is not None:
                table[item.metadata.get("json", item.name)] = to_json(value)
        return table
    if isinstance(record, Mapping):
        return {str(key): to_json(value) for key, value in record.items()}
    if isinstance(record, np.ndarray):
        return record.tolist()
    if isinstance(record, np.generic):
        return record.item()
    if isinstance(record, list | tuple):
        return [to_json(value) for value in record]
    return record


def from_json(kind: type[Record], table: Mapping[str, Any]) -> Record:
    """Build a dataclass from its JSON form; inverse of :func:`to_json`.

    Unknown keys are ignored, so that files of later versions stay readable.

    Raises
    ------
    KeyError
        A key without default is missing.
    """
    hints = typing.get_type_hints(kind)
    values = {}
    for item in fields(kind):  # type: ignore[arg-type]
        key = item.metadata.get("json", item.name)
        if key in table:
            values[item.name] = _converted(hints[item.name], table[key])
    try:
        return kind(**values)
    except TypeError as error:
        raise KeyError(str(error)) from None


def _converted(hint: Any, value: Any) -> Any:
    """Value of a JSON table as the type that a field declares."""
    if value is None:
        return None
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        kinds = [each for each in arguments if each is not type(None)]
        return _converted(kinds[0], value) if len(kinds) == 1 else value
    if origin is tuple and isinstance(value, list | tuple):
        if len(arguments) == 2 and arguments[1] is Ellipsis:
            return tuple(_converted(arguments[0], each) for each in value)
        return tuple(_converted(k, v) for k, v in zip(arguments, value, strict=False))
    if origin is dict and isinstance(value, Mapping):
        return {key: _converted(arguments[1], each) for key, each in value.items()}
    if is_dataclass(hint) and isinstance(value, Mapping):
        return from_json(typing.cast(type, hint), value)
    return value
