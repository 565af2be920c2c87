"""YAML documents of numbers, texts, lists and mappings, by PyYAML (extra ``yaml``).

Values are built from PyYAML's events: its loaders take the last of two equal keys, follow anchors
to exponential size, and recurse as deep as the text.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from decimal import Decimal, DecimalException
from typing import Any

import yaml

from locatk.core.errors import ArtifactError

MAX_DEPTH = 8
"""Nested lists and mappings; a Crazyflie's configuration has five levels."""

_SAFE_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_NUMBER = re.compile(r"[-+]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?")
_NO_NUMBER = re.compile(r"[-+]?\.(?:inf|nan)", re.IGNORECASE)
_STANDARD_TAG = re.compile("!|tag:yaml.org,2002:(?:str|int|float|map|seq)")


class _RefusedError(Exception):
    """Part of a document that is not read: the event with which it begins, and the reason."""

    def __init__(self, event: yaml.Event, reason: str) -> None:
        self.line = event.start_mark.line + 1 if event.start_mark else None
        super().__init__(reason)


def parse_yaml(text: str, *, file: str | os.PathLike[str], hint: str) -> Any:
    """Parse the only document of a text, with numbers as int and Decimal; None if it is empty.

    Anchors, tags and repeated keys are refused. Other scalars than numbers are strings.

    Raises
    ------
    ArtifactError
        The text is not such a document; the error names ``file`` and the line.
    """
    try:
        return _tree(text)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        reason = f"not valid YAML ({getattr(error, 'problem', None) or 'damaged text'})"
        line = mark.line + 1 if mark else None
    except _RefusedError as error:
        reason, line = str(error), error.line
    raise ArtifactError(reason, file=file, where=line, hint=hint)


def _tree(text: str) -> Any:
    root = None
    events = yaml.parse(text, Loader=_SAFE_LOADER)
    for event in events:
        if isinstance(event, yaml.NodeEvent):
            if root is not None:
                raise _RefusedError(event, "more than one YAML document")
            root = _node(event, events, 0)
    return root


def _node(event: yaml.Event, events: Iterator[yaml.Event], depth: int) -> Any:
    """Build the value that begins with an event, and consume its events."""
    if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
        raise _RefusedError(event, "YAML anchors and aliases are not read")
    tag = getattr(event, "tag", None)
    if tag is not None and not _STANDARD_TAG.fullmatch(tag):
        raise _RefusedError(event, f"YAML tag {tag[:60]!r} is not read")
    if isinstance(event, yaml.ScalarEvent):
        return _scalar(event)
    if depth == MAX_DEPTH:
        raise _RefusedError(event, "lists and mappings are nested too deep")
    if isinstance(event, yaml.SequenceStartEvent):
        items = []
        while not isinstance(event := next(events), yaml.SequenceEndEvent):
            items.append(_node(event, events, depth + 1))
        return items
    values: dict[str, Any] = {}
    while not isinstance(event := next(events), yaml.MappingEndEvent):
        if not isinstance(event, yaml.ScalarEvent):
            raise _RefusedError(event, "a key that is not a name or number")
        key = event.value
        if key in values:
            raise _RefusedError(event, f"key {key[:60]!r} occurs twice")
        values[key] = _node(next(events), events, depth + 1)
    return values


def _scalar(event: yaml.ScalarEvent) -> Any:
    text = event.value
    if event.style or not (_NUMBER.fullmatch(text) or _NO_NUMBER.fullmatch(text)):
        return text
    if text.isdigit() and len(text) < 20:
        return int(text)
    try:
        return Decimal(text)
    except DecimalException:  # .inf, .nan, an exponent of twenty digits
        return Decimal("nan")
