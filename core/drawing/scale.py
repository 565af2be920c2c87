"""Scales of plans: round scales, scale bars and axes."""

from __future__ import annotations

import itertools
import math

from locatk.core.drawing.marks import Line, Mark, Point, Text, arrow, text_width
from locatk.core.drawing.pages import TEXT_POINTS

SCALE_STEPS = (1, 1.25, 1.5, 2, 2.5, 3, 3.5, 4, 4.5, 5, 6, 7, 7.5, 8, 9, 10)
"""Leading digits of the denominators of scales."""

MAX_SCALE_BAR_MM = 42.0
"""Largest length of a scale bar."""


def round_scale(min_scale: float) -> float:
    """Return the smallest round n for a scale 1 : n that is at least ``min_scale``."""
    power = 10.0 ** math.floor(math.log10(min_scale) + 1e-9)
    scales = (step * power for step in SCALE_STEPS)
    return round(next(scale for scale in scales if scale >= min_scale * (1 - 1e-9)), 6)


def scale_bar(start: Point, scale: float, width_mm: float) -> list[Mark]:
    """Draw a bar of a round length from ``start`` to the right, with its length in metres.

    Parameters
    ----------
    start : (x, y)
        Left end of the bar.
    scale : float
        The n of 1 : n.
    width_mm : float
        Space for the bar and its text.
    """
    x, y = start
    length_m = _scale_bar_length(scale, width_mm)
    length = 1e3 * length_m / scale
    return [
        Line((x, y), (x + length, y), 0.3),
        Line((x, y - 1), (x, y + 1), 0.3),
        Line((x + length, y - 1), (x + length, y + 1), 0.3),
        Text(_bar_text(length_m), (x + length + 1.2, y - 0.8), TEXT_POINTS),
    ]


def _bar_text(length_m: float) -> str:
    return f"{length_m:g} m"


def _scale_bar_length(scale: float, width: float) -> float:
    """Return the longest of 1, 2 or 5 times a power of ten in metres that fits with its text."""
    for power in itertools.count(math.ceil(math.log10(MAX_SCALE_BAR_MM * scale / 1e3)), -1):
        for factor in (5, 2, 1):
            length_m = factor * 10.0**power
            length = 1e3 * length_m / scale
            text = text_width(_bar_text(length_m), TEXT_POINTS)
            if length <= MAX_SCALE_BAR_MM and length + 1.2 + text <= width:
                return length_m
    raise AssertionError("a bar of any length fits")


def axes(corner: Point, length_mm: float, x_label: str, y_label: str) -> list[Mark]:
    """Draw arrows along x (to the right) and y (up) from a corner, with texts at their tips."""
    x, y = corner
    return [
        *arrow(corner, (x + length_mm, y), 2.5, 0.3),
        Text(x_label, (x + length_mm + 1.0, y - 0.8), TEXT_POINTS),
        *arrow(corner, (x, y + length_mm), 2.5, 0.3),
        Text(y_label, (x + 0.8, y + length_mm + 1.0), TEXT_POINTS, angle_deg=90),
    ]
