"""Times, sizes and column names as values of options of ``locatk capture``."""

from __future__ import annotations

import math
import re
from typing import Any

import click

_SECONDS = {"": 1.0, "ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
_BYTES = {"b": 1, "kb": 10**3, "mb": 10**6, "gb": 10**9, "tb": 10**12}
_BYTES |= {"kib": 2**10, "mib": 2**20, "gib": 2**30, "tib": 2**40}
_NUMBER = re.compile(r"(\d+(?:\.\d*)?|\.\d+)\s*([a-zA-Z]*)")

MAX_QUANTITY = 1e18
"""Limit of a time in seconds, or a size in bytes."""

MIN_PART_S, MIN_PART_BYTES = 1.0, 100_000
"""Smallest part of a recording."""


class _Quantity(click.ParamType[float]):
    """Positive number with a unit, or 0 if that is possible."""

    def __init__(
        self, name: str, units: dict[str, Any], example: str, *, can_be_zero: bool = False
    ) -> None:
        self.name, self._units, self._example = name, units, example
        self._can_be_zero = can_be_zero

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        if isinstance(value, int | float):
            return value
        match = _NUMBER.fullmatch(value.strip())
        factor = self._units.get(match[2].lower()) if match else None
        if match and not match[2] and float(match[1]) == 0:
            factor = 1.0  # Zero needs no unit.
        number = math.nan if match is None or factor is None else float(match[1]) * factor
        if not 0 <= number < MAX_QUANTITY or (number == 0 and not self._can_be_zero):
            self.fail(f"{value!r} is not a {self.name}; examples: {self._example}", param, ctx)
        return number


DURATION = _Quantity("time", _SECONDS, "90, 90s, 5min or 2h")
"""Converts to seconds as a float."""

SIZE = _Quantity("size", _BYTES, "500MB, 2GB or 64MiB")
"""Converts to bytes as a float."""

SIZE_OR_ZERO = _Quantity("size", _BYTES, "0, 500MB, 2GB or 64MiB", can_be_zero=True)
"""Converts to bytes as a float, which may be 0."""


class RotationType(click.ParamType[tuple[str, float]]):
    """Time or size."""

    name = "time or size"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, float]:
        if isinstance(value, tuple):
            return value
        unit = re.sub(r"[\d.\s]", "", value).lower()
        kind, quantity, minimum = (
            ("size", SIZE, MIN_PART_BYTES) if unit in _BYTES else ("time", DURATION, MIN_PART_S)
        )
        number = quantity.convert(value, param, ctx)
        if number < minimum:
            self.fail(f"{value!r} is too small; the minimum is 1s or 100kB", param, ctx)
        return kind, number


ROTATION = RotationType()
"""Converts to ("time", seconds) or ("size", bytes)."""


def _names(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[str, ...]:
    names = tuple(name.strip() for name in value.split(",")) if value else ()
    if not all(names) or len(set(names)) < len(names):
        raise click.BadParameter("expected distinct names, separated by commas.")
    return names


columns_option = click.option(
    "--columns",
    metavar="A,B,...",
    callback=_names,
    help="--device lines: names of the values in a line, in order.",
)
