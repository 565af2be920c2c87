"""Exact conversion between lengths in metres and their decimal form in mm."""

from __future__ import annotations

from decimal import Decimal


def metres(millimetres: float) -> float:
    """Convert mm to metres by shifting the decimal point.

    Unlike a multiplication, this lets 39.7 mm return from a file as 39.7 mm.
    """
    return float(Decimal(repr(millimetres)).scaleb(-3))


def length_text(value_m: float, digits: int = 3) -> str:
    """Format a length in metres as mm with ``digits`` significant digits and the unit.

    Examples
    --------
    >>> length_text(0.01234), length_text(0.2, 4), length_text(1.5496)
    ('12.3 mm', '200 mm', '1550 mm')
    """
    return f"{float(f'{1e3 * value_m:.{digits}g}'):g} mm"


def mm_text(value_m: float, decimals: int = 1) -> str:
    """Format a length in metres as mm with at most ``decimals`` decimals and no trailing zeros.

    Examples
    --------
    >>> mm_text(0.2), mm_text(-0.00001), mm_text(0.0123456, 4)
    ('200', '0', '12.3456')
    """
    text = f"{1e3 * value_m:.{decimals}f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text
