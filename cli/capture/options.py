"""Times and sizes as people write them, for the options of ``locatk capture``."""

from __future__ import annotations

import re
from typing import Any

import click

_SECONDS = {"": 1.0, "ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
_BYTES = {"b": 1, "kb": 10**3, "mb": 10**6, "gb": 10**9, "tb": 10**12}
_BYTES |= {"kib": 2**10, "mib": 2**20, "gib": 2**30, "tib": 2**40}
_NUMBER = re.compile(r"(\d+(?:\.\d*)?|\.\d+)\s*([a-zA-Z]*)")


LARGEST = 1e18

SHORTEST_S, SMALLEST = 1.0, 100_000
"""Of a part of a recording."""


class _Quantity(click.ParamType[float]):
    """A positive number and its unit."""

    def __init__(self, name: str, units: dict[str, Any], example: str) -> None:
        self.name, self._units, self._example = name, units, example

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        if isinstance(value, int | float):
            return value
        found = _NUMBER.fullmatch(value.strip())
        factor = self._units.get(found[2].lower()) if found else None
        if found is None or factor is None or not 0 < float(found[1]) * factor < LARGEST:
            self.fail(f"{value!r} is no {self.name}; write it as {self._example}", param, ctx)
        number: float = float(found[1]) * factor
        return number


DURATION = _Quantity("time", _SECONDS, "90, 90s, 5min or 2h")
"""Seconds as a float."""

SIZE = _Quantity("size", _BYTES, "500MB, 2GB or 64MiB")
"""Bytes as a float."""


class Pace(click.ParamType[tuple[str, float]]):
    """A time or a size: ("time", seconds) or ("size", bytes)."""

    name = "time or size"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, float]:
        if isinstance(value, tuple):
            return value
        unit = re.sub(r"[\d.\s]", "", value).lower()
        kind, quantity, least = (
            ("size", SIZE, SMALLEST) if unit in _BYTES else ("time", DURATION, SHORTEST_S)
        )
        number = quantity.convert(value, param, ctx)
        if number < least:
            self.fail(f"{value!r} is too little; at least 1s or 100kB", param, ctx)
        return kind, number


PACE = Pace()


def _names(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[str, ...]:
    names = tuple(name.strip() for name in value.split(",")) if value else ()
    if not all(names) or len(set(names)) < len(names):
        raise click.BadParameter("expected names with commas between, each once.")
    return names


names_option = click.option(
    "--columns",
    metavar="A,B,...",
    callback=_names,
    help="lines: names of the values of a line, in their order.",
)
