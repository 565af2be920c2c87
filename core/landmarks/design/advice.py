"""What will not work with a landmark of some bars, and what to do about it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

from locatk.core.landmarks.design.territory import neighbour_field

if TYPE_CHECKING:
    from locatk.core.landmarks.design.analysis import Analysis

SKEW_RAD = math.radians(15)
"""Distance of a valley from the paper's multiples of 45 degrees that its rule lets pass."""

EARTH_T = 65e-6
"""The strongest field of the Earth on its surface."""


def warnings(analysis: Analysis) -> Iterator[str]:
    """What will not work, with numbers and what to do."""
    geometry = analysis.geometry
    low, high = analysis.heights_m
    remedy = (
        "no height of the sensors is right for this circle; take shorter bars"
        if math.isnan(high)
        else f"keep the sensors {_between(low, high)} above the bars, or take shorter bars"
    )
    groups: dict[tuple[int, int], list[str]] = {}
    for shape in analysis.shapes:
        if shape.collapsed:
            key = (len(shape.valleys_rad), shape.expected)
            groups.setdefault(key, []).append(shape.letters)
    for (found, expected), letters in groups.items():
        yield (
            f"the valleys of {_listed(letters)} collapse to {found} and not {expected}, so that "
            f"the method `paper` takes them for another pattern; {remedy}"
        )
    skew = max(shape.skew_rad for shape in analysis.shapes)
    if not groups and skew > SKEW_RAD:
        yield (
            f"valleys are up to {math.degrees(skew):.0f} degrees from where the paper has them, "
            f"and {math.degrees(SKEW_RAD):.0f} is what its rule lets pass; {remedy}"
        )
    if math.isnan(analysis.r1_m) or math.isnan(analysis.r2_m):
        yield (
            f"the field does not come to the threshold of {1e3 * geometry.threshold_t:.3g} mT on "
            "all sides of a landmark, or goes beyond ten times its radius; take another threshold"
        )
    elif analysis.r1_m < geometry.circle_m:
        yield (
            f"the territory is smaller than the circle of the sensors: {_mm(analysis.r1_m)} "
            f"against {_mm(geometry.circle_m)}; take a lower threshold or a smaller circle"
        )
    if geometry.threshold_t < 2 * EARTH_T:
        yield (
            f"the threshold of {1e6 * geometry.threshold_t:.3g} uT is no more than the Earth's "
            f"field, {1e6 * EARTH_T:.0f} uT, and a landmark's neighbours; take a higher one"
        )
    if analysis.hall_class is None:
        yield (
            f"no common hall sensor tells {1e3 * analysis.range_t:.0f} mT; "
            "take sensors farther from the bars or weaker bars"
        )


def pitch_warnings(analysis: Analysis, pitch_m: float) -> Iterator[str]:
    """What will not work with landmarks at a pitch."""
    geometry = analysis.geometry
    if pitch_m < analysis.contour_pitch_m:
        yield (
            f"territories run into each other at a pitch of {_mm(pitch_m)}: a sensor of the "
            "robot is in the next one before the last has left this one; take at least "
            f"{_mm(_up(analysis.contour_pitch_m))}, or a higher threshold"
        )
    one, all_eight = (float(field) for field in neighbour_field(geometry, pitch_m))
    if one > analysis.neighbour_t * (1 + 1e-9):
        least = (
            "take weaker bars"
            if math.isnan(analysis.field_pitch_m)
            else f"take at least {_mm(_up(analysis.field_pitch_m))}"
        )
        yield (
            f"a neighbour at a pitch of {_mm(pitch_m)} adds up to {1e6 * one:.0f} uT at the "
            f"sensors, all eight up to {1e6 * all_eight:.0f} uT, and "
            f"{1e6 * analysis.neighbour_t:.0f} uT of one is what was let pass; {least}"
        )


def _up(metres: float) -> float:
    """To the next whole mm."""
    return math.ceil(1e3 * metres - 1e-6) / 1e3


def _between(low: float, high: float) -> str:
    top = math.floor(1e4 * high) / 10
    return f"at most {top:g} mm" if low == 0 else f"{1e3 * low:.1f} to {top:g} mm"


def _listed(words: list[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.4g} mm"
