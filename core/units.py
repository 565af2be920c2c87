"""Lengths as people write them, in mm, exactly."""

from __future__ import annotations

from decimal import Decimal


def metres(millimetres: float) -> float:
    """The point is moved, so that 39.7 mm come back as 39.7 mm from a file."""
    return float(Decimal(repr(millimetres)).scaleb(-3))


def mm_text(value_m: float, decimals: int = 1) -> str:
    """A length or coordinate in mm, to 1 decimal or more, without zeros that say nothing.

    Examples
    --------
    >>> mm_text(0.2), mm_text(-0.00001), mm_text(0.0123456, 4)
    ('200', '0', '12.3456')
    """
    text = f"{1e3 * value_m:.{decimals}f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text
