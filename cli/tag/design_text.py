"""Text and JSON of the evaluation of a design by ``locatk tag design`` and ``tag check``."""

from __future__ import annotations

import math
import textwrap
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from locatk.cli import console
from locatk.core.units import length_text

if TYPE_CHECKING:
    from locatk.core.polaris.design.accuracy_bound import AccuracyBound
    from locatk.core.polaris.design.planning import DesignReport
    from locatk.core.polaris.tag import Tags

ID_LIST_LETTERS = 60
"""Width of the list of the ids of a family, in letters."""


def text(report: DesignReport) -> str:
    """Format the evaluation of a design in 100 columns."""
    return "\n\n".join(
        (
            _head(report),
            console.table(("planned", "", "limit", "from"), _limits(report)),
            console.table(
                ("one pass, at best", "along", "across", "angle"),
                (
                    _accuracy("magnet, speed known", report.known_speed, False),
                    _accuracy("magnet, each step free", report.free_speed, False),
                    _accuracy("tag, speed known", report.known_speed, True),
                    _accuracy("tag, each step free", report.free_speed, True),
                ),
            ),
            console.table(
                ("material", "count", "", "USD each"),
                (
                    (item.part, item.count, item.detail, item.price_usd and f"< {item.price_usd:g}")
                    for item in report.materials
                ),
            ),
            "Accuracies are what noise alone permits: the published recordings come within 2 times "
            "of it\nin angle, 10 times in place. Prices: Polaris, sections 7.1 and 7.2.",
        )
    )


def entry(report: DesignReport) -> dict[str, Any]:
    """Return the evaluation for ``--json``, in SI units as each key says (docs/commands.md)."""
    result = asdict(report)
    tags = result.pop("tags")
    del tags["built"], tags["site"], tags["notes"]
    use = result.pop("use")
    warnings, notes, materials = (result.pop(key) for key in ("warnings", "notes", "materials"))
    return {
        "tag": tags,
        "use": use,
        "plan": result,
        "materials": materials,
        "warnings": warnings,
        "notes": notes,
    }


def members(tags: Tags) -> str:
    """Describe the ids of a family in a few words."""
    if tags.ids is None:
        return "any id may occur"
    count = "1 id: " if len(tags.ids) == 1 else f"{len(tags.ids)} ids: "
    return count + textwrap.shorten(
        ", ".join(map(str, tags.ids)), ID_LIST_LETTERS, placeholder=" ..."
    )


def _head(report: DesignReport) -> str:
    tags, use, magnet = report.tags, report.use, report.tags.magnet
    strength = " ".join(filter(None, (magnet.grade, f"({magnet.remanence_t:g} T)")))
    rows = (
        (
            "Tag",
            f"{tags.order} x {tags.order} grid of {length_text(tags.spacing_m)}, "
            f"{tags.magnets} magnets, {tags.orientations} orientations, codec {tags.codec}",
        ),
        (
            "Ids",
            f"{_short(report.capacity)} ({math.log2(report.capacity):.1f} bits); {members(tags)}",
        ),
        (
            "Magnet",
            f"{magnet.diameter_m * 1e3:g} x {length_text(magnet.height_m)} {strength}, "
            f"{magnet.moment * 1e3:.3g} mA m2, its middle {length_text(tags.clearance_m)} below "
            "the sensors",
        ),
        (
            "Array",
            f"{use.sensors} sensors {length_text(use.sensor_spacing_m)} apart, {use.settings}",
        ),
    )
    return console.labelled(rows)


def _limits(report: DesignReport) -> list[tuple[str, str, str, str]]:
    """Return name, value, limit and origin of the limit of each figure."""
    from locatk.core.polaris.design.planning import (
        MAX_EARTH_FIELD_T,
        MIN_SAMPLES_PER_FIELD,
        MIN_SIGNAL_TO_NOISE,
    )

    tags, use = report.tags, report.use
    noise = ", ".join(f"{value * 1e6:.3g}" for value in report.noise_t)
    neighbour_errors = (
        "peaks merge"
        if math.isnan(report.neighbour_angle_rad)
        else f"{math.degrees(report.neighbour_angle_rad):.1f} deg, "
        f"{length_text(report.neighbour_shift_m)}"
    )
    return [
        (
            "field above a magnet",
            _ut(report.peak_t),
            f"at most {_ut(report.range_t - MAX_EARTH_FIELD_T)}",
            "range less the Earth's field",
        ),
        ("field midway between sensors", _ut(report.between_t), "", ""),
        ("noise x, y, z", f"{noise} uT", "", report.noise_from),
        (
            "signal to noise, above, midway",
            f"{report.signal_to_noise:.0f}, {report.between_to_noise:.0f}",
            f"at least {MIN_SIGNAL_TO_NOISE:g}",
            "midway",
        ),
        (
            "spacing of the magnets",
            length_text(tags.spacing_m),
            f"at least {length_text(report.compact_spacing_m)}",
            f"`paper`: 0.8 of {length_text(report.min_spacing_m)}",
        ),
        ("error if neighbours are ignored", neighbour_errors, "", "at worst; `joint` does not"),
        (
            "sampling rate",
            f"{report.rate_hz:.1f} Hz",
            f"at most {report.max_rate_hz:.1f} Hz",
            f"{use.settings.conversion_s * 1e3:.2f} ms a conversion",
        ),
        ("speed", f"{use.speed_mps:g} m/s", f"at most {report.max_speed_mps:.2g} m/s", "samples"),
        (
            "samples over a magnet's field",
            f"{report.samples:.1f}",
            f"at least {MIN_SAMPLES_PER_FIELD:g}",
            f"{length_text(report.step_m)} each, over {length_text(report.half_across_m)}",
        ),
        (
            "orientations",
            str(tags.orientations),
            f"at most {report.max_orientations}",
            f"laid to {math.degrees(report.placement_rad):.2g} deg rms",
        ),
        ("tags with a misread magnet", _percent(report.misread), "", "more than half a step off"),
        (
            "width of the tag, at 45 deg",
            f"{length_text(report.tag_m)}, {length_text(report.diagonal_m)}",
            f"at most {length_text(report.array_m)}",
            f"array; play {length_text(report.play_m)} a side",
        ),
    ]


def _accuracy(name: str, bound: AccuracyBound, pose: bool) -> tuple[str, ...]:
    along, across, angle = (
        (bound.pose_x_m, bound.pose_y_m, bound.pose_heading_rad)
        if pose
        else (bound.x_m, bound.y_m, bound.angle_rad)
    )
    if math.isnan(along):
        return name, "-", "-", "-"
    return name, f"{along * 1e3:.4f} mm", f"{across * 1e3:.4f} mm", f"{math.degrees(angle):.3f} deg"


def _short(number: int) -> str:
    return str(number) if number < 10**15 else f"about 10^{math.log10(number):.0f}"


def _percent(part: float) -> str:
    return f"{part:.0%}".replace("%", " %") if part > 0.1 else f"{part * 100:.2g} %"


def _ut(tesla: float) -> str:
    return f"{tesla * 1e6:.4g} uT" if tesla >= 1e-3 else f"{tesla * 1e6:.3g} uT"
