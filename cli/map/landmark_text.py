"""Text and JSON of the analysis of one landmark, by ``locatk map design --landmark``."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from locatk.cli import console
from locatk.cli.route_options import accuracy_text
from locatk.core.units import length_text

if TYPE_CHECKING:
    from collections.abc import Sequence

    from locatk.core.landmarks.design.analysis import (
        LandmarkAnalysis,
        PatternAnalysis,
        ToleranceEffect,
    )
    from locatk.core.landmarks.design.bar_search import BarOption
    from locatk.core.landmarks.landmark import Geometry


ANGLES_WIDTH_CHARACTERS = 63
"""Width of eight angles, to which all are padded so that they are aligned to the left."""


def text(analysis: LandmarkAnalysis, pitch_m: float) -> str:
    """Format the analysis in 80 columns."""
    return "\n\n".join(
        (
            head(analysis.geometry),
            "Valleys on the circle of the sensors, counter-clockwise from x:\n"
            + console.table(
                ("no", "bars", "count", "at degrees, + if the field rises there"),
                (_valleys(pattern) for pattern in analysis.patterns),
            ),
            "Mountains between them, territory, error of the centre by the paper's crossing:\n"
            + console.table(
                ("bars", "mountains mT", "r1 mm", "r2 mm", "gulfs deg", "centre off mm"),
                (_territory(pattern) for pattern in analysis.patterns),
            ),
            "Field along the bars: slope in mT/mm, distance of its zero from the middle of\n"
            "the bar in mm, largest error of that line within a quarter of the bar in mm:\n"
            + console.table(
                ("bars", *(f"bar {k} at {90 * k}" for k in range(4))),
                ((pattern.letters, *_lines(pattern)) for pattern in analysis.patterns),
            ),
            console.table(("required", "", "reason"), _needed(analysis, pitch_m)),
            "Effect of a deviation on landmark 3, NNNS:\n"
            + console.table(
                ("", "r1 mm", "r2 mm", "centre off mm", "largest field mT"),
                (
                    (
                        row.deviation,
                        _number(1e3 * row.r1_m, 1),
                        _number(1e3 * row.r2_m, 1),
                        _number(1e3 * row.bias_m, 2),
                        _number(1e3 * row.largest_t, 1),
                    )
                    for row in analysis.tolerances
                ),
            ),
        )
    )


def entry(analysis: LandmarkAnalysis, pitch_m: float) -> dict[str, Any]:
    """Return the analysis for ``--json`` in SI units (docs/formats.md)."""
    from locatk.core.landmarks.design.territory import max_neighbour_field

    one, all_eight = max_neighbour_field(analysis.geometry, pitch_m)
    hall = analysis.hall_class
    return {
        "geometry": asdict(analysis.geometry),
        "patterns": [
            {
                **_pattern_fields(pattern),
                "valleys": len(pattern.valleys_rad),
                "collapsed": pattern.is_collapsed,
                "skew_rad": pattern.skew_rad,
            }
            for pattern in analysis.patterns
        ],
        "sensor_heights_m": analysis.heights_m,
        "pitch_m": pitch_m,
        "contour_pitch_m": analysis.contour_pitch_m,
        "field_pitch_m": analysis.field_pitch_m,
        "neighbour_t": one,
        "all_neighbours_t": all_eight,
        "neighbour_limit_t": analysis.neighbour_t,
        "largest_t": analysis.largest_t,
        "hall_range_t": analysis.range_t,
        "hall_class": hall and {"mv_per_mt": hall[0], "range_t": hall[1]},
        "tolerances": [_tolerance(row) for row in analysis.tolerances],
    }


def _pattern_fields(pattern: PatternAnalysis) -> dict[str, Any]:
    """Return the fields of a pattern by their documented keys (docs/formats.md)."""
    keys = {"is_rising": "rising", "peaks_t": "mountains_t"}
    return {keys.get(name, name): value for name, value in asdict(pattern).items()}


def _tolerance(effect: ToleranceEffect) -> dict[str, Any]:
    """Return the entry of one deviation for ``--json``."""
    return {
        "what": effect.deviation,
        "r1_m": effect.r1_m,
        "r2_m": effect.r2_m,
        "bias_m": effect.bias_m,
        "largest_t": effect.largest_t,
    }


def head(geometry: Geometry) -> str:
    """Describe the landmark in two lines."""
    g = geometry
    return console.labelled(
        (
            ("Landmark", f"four bars of {bar(g)}, {_mm(g.radius_m)} from the middle"),
            (
                "Sensors",
                f"{_mm(g.sensor_height_m)} above the bars, on a circle of {_mm(g.circle_m)}, "
                f"threshold {1e3 * g.threshold_t:.4g} mT",
            ),
        )
    )


def bar(geometry: Geometry) -> str:
    """Describe one bar."""
    g = geometry
    return (
        f"{1e3 * g.bar_length_m:g} x {1e3 * g.bar_width_m:g} x {_mm(g.bar_height_m)}, "
        f"{g.remanence_t:g} T"
    )


def _valleys(pattern: PatternAnalysis) -> tuple[object, ...]:
    count = str(len(pattern.valleys_rad)) + (
        f", not {pattern.expected}" if pattern.is_collapsed else ""
    )
    angles = (
        f"{_clean(math.degrees(angle), 2):>6}{'+' if up else '-'}"
        for angle, up in zip(pattern.valleys_rad.tolist(), pattern.is_rising.tolist(), strict=True)
    )
    return pattern.number, pattern.letters, count, " ".join(angles).ljust(ANGLES_WIDTH_CHARACTERS)


def _territory(pattern: PatternAnalysis) -> tuple[str, ...]:
    sizes = abs(pattern.peaks_t)
    heights = sorted({f"{1e3 * size:.1f}" for size in sizes.tolist()}, key=float)
    gulfs = sorted(
        {f"{math.degrees(g):.0f}" for g in pattern.gulfs_rad.tolist() if g == g}, key=int
    )
    return (
        pattern.letters,
        _span(heights),
        _number(1e3 * pattern.r1_m, 1),
        _number(1e3 * pattern.r2_m, 1),
        _span(gulfs),
        _number(1e3 * math.hypot(*pattern.bias_m.tolist()), 2),
    )


def _lines(pattern: PatternAnalysis) -> list[str]:
    return [
        "none"
        if zero != zero
        else f"{slope:5.2f} {_clean(1e3 * zero, 1):>4} {1e3 * off:5.2f}".rjust(16)
        for slope, zero, off in zip(
            pattern.slope_t_per_m.tolist(),
            pattern.zero_m.tolist(),
            pattern.departure_m.tolist(),
            strict=True,
        )
    ]


def _needed(analysis: LandmarkAnalysis, pitch_m: float) -> list[tuple[str, str, str]]:
    from locatk.core.landmarks.design.territory import max_neighbour_field

    low, high = analysis.heights_m
    one, all_eight = (
        1e6 * float(field) for field in max_neighbour_field(analysis.geometry, pitch_m)
    )
    hall = analysis.hall_class
    return [
        (
            "height of the sensors",
            "none" if high != high else f"{1e3 * low:.1f} to {1e3 * high:.1f} mm",
            "4, 6, 6, 6, 8, 8 valleys",
        ),
        (
            "pitch",
            f"at least {_number(1e3 * analysis.contour_pitch_m, 0)} mm",
            "2 x (r2 + circle): no overlap",
        ),
        (
            "pitch",
            f"at least {_number(1e3 * analysis.field_pitch_m, 0)} mm",
            f"a neighbour adds {1e6 * analysis.neighbour_t:.0f} uT",
        ),
        (
            "neighbours' field",
            f"{one:.1f} uT",
            f"at {_mm(pitch_m)}; all eight up to {all_eight:.0f} uT",
        ),
        (
            "range of the hall sensors",
            f"+-{1e3 * analysis.range_t:.1f} mT",
            f"max field {1e3 * analysis.largest_t:.1f} mT, 25 % headroom",
        ),
        (
            "sensitivity",
            f"{hall[0]:g} mV/mT" if hall else "none",
            f"as TI DRV5055 at 5 V, +-{1e3 * hall[1]:g} mT" if hall else "the field is too strong",
        ),
    ]


def _span(values: list[str]) -> str:
    return "-" if not values else values[0] if len(values) == 1 else f"{values[0]}-{values[-1]}"


def _number(value: float, digits: int) -> str:
    return _clean(value, digits) if math.isfinite(value) else "-"


def _clean(value: float, digits: int) -> str:
    """Format a number without the sign of a rounded zero."""
    return f"{round(value, digits) + 0.0:.{digits}f}"


def _mm(metres: float) -> str:
    return length_text(metres, 4)


def search_table(options: Sequence[BarOption]) -> str:
    """Return the bars that were tried, and the heights that suffice, in 80 columns."""
    table = console.table(
        ("bar mm", "heights mm", "error mm", "deg", "at mm", "pitch from mm", "hall range mT", ""),
        (
            (
                _size(option.analysis.geometry),
                ", ".join(f"{1e3 * height_m:g}" for height_m in option.heights_m) or "-",
                _number(1e3 * option.forecast.position_p95_m, 1),
                _number(math.degrees(option.forecast.heading_p95_rad), 2),
                f"{1e3 * option.analysis.geometry.sensor_height_m:g}",
                _number(1e3 * option.analysis.min_pitch_m, 0),
                _number(1e3 * option.analysis.range_t, 0),
                option.reason,
            )
            for option in options
        ),
    )
    return (
        f"{table}\n\nErrors: not exceeded with 95 %, by locatk live on straight drives anywhere, "
        "at\nthe best height. Buy bars that are magnetised along their length."
    )


def search_warnings(
    options: Sequence[BarOption], pitch_m: float, wanted: tuple[float, float | None]
) -> list[str]:
    """Return what is possible, and what would have to change, if no bars suffice."""
    if any(option.is_feasible for option in options):
        return []
    separate = [option for option in options if option.analysis.min_pitch_m <= pitch_m]
    if not separate:
        smallest_m = min(option.analysis.min_pitch_m for option in options)
        return [
            f"no bars have separate territories at a pitch of {length_text(pitch_m)}; the smallest "
            f"pitch is {length_text(smallest_m)}"
        ]
    best = min(separate, key=lambda option: option.forecast.position_p95_m)
    best_errors = best.forecast.position_p95_m, best.forecast.heading_p95_rad
    return [
        f"{accuracy_text(*wanted)} (95 %) is impossible at a pitch of {length_text(pitch_m)}: the "
        f"best bars, {_size(best.analysis.geometry)}, give {accuracy_text(*best_errors)}; make "
        "the pitch smaller, calibrate the odometry, or measure the landmarks (locatk calibrate map)"
    ]


def search_entry(option: BarOption) -> dict[str, Any]:
    """Return bars that were tried for ``--json``."""
    return {
        "geometry": asdict(option.analysis.geometry),
        "heights_m": option.heights_m,
        "min_pitch_m": option.analysis.min_pitch_m,
        "range_t": option.analysis.range_t,
        "forecast": asdict(option.forecast),
        "reason": option.reason,
    }


def _size(geometry: Geometry) -> str:
    sides = (geometry.bar_length_m, geometry.bar_width_m, geometry.bar_height_m)
    return "x".join(f"{1e3 * side:g}" for side in sides)
