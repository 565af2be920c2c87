"""What the commands of ``locatk simulate`` share: kinds of numbers, and units."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import click

ANY = click.FLOAT
ABOVE_0 = click.FloatRange(min=0, min_open=True)
FROM_0 = click.FloatRange(min=0)
SHARE = click.FloatRange(0, 1)

UNITS = {
    "_mm": ("_m", 1e-3),
    "_mt": ("_t", 1e-3),
    "_ut": ("_t", 1e-6),
    "_deg": ("_rad", math.pi / 180),
    "_deg_per_m": ("_rad_per_m", math.pi / 180),
    "_dps": ("_rps", math.pi / 180),
    "_dps2": ("_rps2", math.pi / 180),
}
"""From units of the command line to those of the simulations."""


def in_si(given: Mapping[str, Any]) -> dict[str, Any]:
    """The options that were given, in the units of the simulations; their names bear them."""
    said: dict[str, Any] = {}
    for name, value in given.items():
        if value in (None, ()):
            continue
        for unit, (si, factor) in UNITS.items():
            if name.endswith(unit):
                name, value = name.removesuffix(unit) + si, value * factor
        said[name] = value
    return said
