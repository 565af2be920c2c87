"""Lengths and counts as pictures and pages say them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Unit:
    """A unit of length: its name, and how many of it a metre is."""

    name: str
    per_metre: float


UNSCALED = Unit("1/1000 unit", 1e3)


def unit_for(size_m: float, *, unscaled: bool = False) -> Unit:
    """The unit in which a length of this size is said."""
    if unscaled:
        return UNSCALED
    if not size_m > 0 or 1e-5 <= size_m < 1:
        return Unit("mm", 1e3)
    return Unit("\u00b5m", 1e6) if size_m < 1e-5 else Unit("m", 1.0)


def length(metres: float, *, unscaled: bool = False) -> str:
    """A length in the unit that suits it, to three digits."""
    if unscaled:
        return f"{digits(metres)} unit"
    unit = unit_for(abs(metres))
    return f"{digits(metres * unit.per_metre)} {unit.name}"


def digits(value: float) -> str:
    """A number to three digits, never with an exponent between 0.001 and a million."""
    if not np.isfinite(value):
        return "-"
    if abs(value) >= 999.5:
        return f"{value:.0f}" if abs(value) < 1e6 else f"{value:.3g}"
    return f"{value:#.3g}".removesuffix(".") if abs(value) >= 1e-3 else f"{value:.3g}"


def thousands(count: int) -> str:
    """A count with narrow spaces where it is long."""
    return f"{count:,}".replace(",", "\u202f")
