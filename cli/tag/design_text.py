"""Text and JSON of the evaluation of a design by ``locatk tag design`` and ``tag check``."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from locatk.cli import console, failures
from locatk.cli.materials_text import materials_text
from locatk.core.units import length_text

if TYPE_CHECKING:
    from locatk.core.polaris.design.accuracy_bound import AccuracyBound
    from locatk.core.polaris.design.environment import Environment
    from locatk.core.polaris.design.planning import DesignReport
    from locatk.core.polaris.design.search import DesignSearch, TagDesign
    from locatk.core.polaris.tag import Tags

MAX_ID_LIST_CHARACTERS = 36
"""Longest list of the ids of a family."""


def report_evaluation(
    report: DesignReport, warnings: list[str], more: dict[str, Any], as_json: bool
) -> None:
    """Print the evaluation, its notes and warnings, and finish with their exit status.

    ``more`` are further keys of the JSON object.
    """
    console.result(text(report))
    for note in report.notes:
        console.say(note)
    if as_json:
        console.emit_json({"version": 1, **more, **entry(report), "warnings": warnings})
    failures.finish_with_warnings(warnings)


def text(report: DesignReport) -> str:
    """Format the evaluation of a design in 80 columns."""
    return "\n\n".join(
        (
            _head(report),
            console.table(("planned", "", "limit", "by"), _limits(report)),
            console.table(
                ("one pass, at best", "along", "across", "angle"),
                (
                    _accuracy("magnet, speed known", report.known_speed, False),
                    _accuracy("magnet, each step free", report.free_speed, False),
                    _accuracy("tag, speed known", report.known_speed, True),
                    _accuracy("tag, each step free", report.free_speed, True),
                    _accuracy("magnet, as placed", report.placed, False),
                    _accuracy("tag, as placed", report.placed, True),
                ),
            ),
            "As placed: with errors of the magnets in the tag of "
            f"{length_text(report.build_m)} and {math.degrees(report.placement_rad):.2g} deg; the\n"
            "others are bounds by noise and environment.",
            materials_text(report.materials),
        )
    )


def entry(report: DesignReport) -> dict[str, Any]:
    """Return the evaluation for ``--json``, in SI units as each key says (docs/commands.md)."""
    result = asdict(report)
    tags = result.pop("tags")
    del tags["built"], tags["site"], tags["notes"]
    use = result.pop("use")
    warnings, notes, _ = (result.pop(key) for key in ("warnings", "notes", "materials"))
    from locatk.formats.exporters.bill_of_materials import bill_rows, total_entry

    return {
        "tag": tags,
        "use": use,
        "plan": result,
        "materials": bill_rows(report.materials),
        "materials_total": total_entry(report.materials),
        "warnings": warnings,
        "notes": notes,
    }


def search_text(found: DesignSearch) -> str:
    """Format the designs that a search found in 80 columns."""
    closest = (found.closest,) if found.closest is not None else ()
    designs = found.designs or closest
    if not designs:
        return "No design was found."
    head = ("magnets", "grid", "orient.", "spacing", "clearance", "side", "position", "heading")
    rows = [
        (
            f"{design.tags.magnets} of {design.tags.magnet.diameter_m * 1e3:g} x "
            f"{design.tags.magnet.height_m * 1e3:g} {design.tags.magnet.grade}".strip(),
            f"{design.tags.order} x {design.tags.order}",
            str(design.tags.orientations),
            length_text(design.tags.spacing_m),
            length_text(design.tags.clearance_m),
            length_text(design.side_m),
            length_text(design.position_p95_m, 2),
            f"{math.degrees(design.heading_p95_rad):.2g} deg",
        )
        for design in designs
    ]
    title = "Designs, the first is written" if found.designs else "Nearest design, not written"
    return f"{title} (errors of a pass, 95 %):\n{console.table(head, rows)}"


def search_entry(found: DesignSearch) -> dict[str, Any]:
    """Return the designs that a search found for ``--json``."""

    def one(design: TagDesign) -> dict[str, Any]:
        tags = design.tags
        return {
            "order": tags.order,
            "magnets": tags.magnets,
            "orientations": tags.orientations,
            "spacing_m": tags.spacing_m,
            "clearance_m": tags.clearance_m,
            "magnet": asdict(tags.magnet),
            "side_m": design.side_m,
            "position_p95_m": design.position_p95_m,
            "heading_p95_rad": design.heading_p95_rad,
        }

    return {
        "designs": [one(design) for design in found.designs],
        "closest": None if found.closest is None else one(found.closest),
        "reason": found.reason or None,
    }


def members(tags: Tags) -> str:
    """Describe the ids of a family in a few words."""
    if tags.ids is None:
        return "every id may occur"
    count = "1 id: " if len(tags.ids) == 1 else f"{len(tags.ids)} ids: "
    return count + textwrap.shorten(
        ", ".join(map(str, tags.ids)), MAX_ID_LIST_CHARACTERS, placeholder=" ..."
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
            f"{magnet.moment * 1e3:.3g} mA m2, {length_text(tags.clearance_m)} below the sensors",
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
            f"max {_ut(report.range_t - MAX_EARTH_FIELD_T)}",
            "range, Earth added",
        ),
        ("field midway of sensors", _ut(report.between_t), "", ""),
        ("noise x, y, z", f"{noise} uT", "", report.noise_from),
        *_environment(use.environment),
        (
            "signal to noise, both",
            f"{report.signal_to_noise:.0f}, {report.between_to_noise:.0f}",
            f"min {MIN_SIGNAL_TO_NOISE:g}",
            "midway",
        ),
        (
            "spacing of the magnets",
            length_text(tags.spacing_m),
            f"min {length_text(report.compact_spacing_m)}",
            f"0.8 of {length_text(report.min_spacing_m)}",
        ),
        ("error without neighbours", neighbour_errors, "", "worst of `paper`"),
        (
            "sampling rate",
            f"{report.rate_hz:.1f} Hz",
            f"max {report.max_rate_hz:.1f} Hz",
            f"{use.settings.conversion_s * 1e3:.2f} ms each",
        ),
        ("speed", f"{use.speed_mps:g} m/s", f"max {report.max_speed_mps:.2g} m/s", "samples"),
        (
            "samples over a magnet",
            f"{report.samples:.1f}",
            f"min {MIN_SAMPLES_PER_FIELD:g}",
            f"{length_text(report.step_m)} of {length_text(report.half_across_m)}",
        ),
        (
            "orientations",
            str(tags.orientations),
            f"max {report.max_orientations}",
            f"{math.degrees(report.placement_rad):.2g} deg RMS error",
        ),
        ("tags that are misread", _percent(report.misread), "", "over half a step"),
        (
            "width, and at 45 deg",
            f"{length_text(report.tag_m)}, {length_text(report.diagonal_m)}",
            f"max {length_text(report.array_m)}",
            f"array, {length_text(report.play_m)} free",
        ),
    ]


def _environment(environment: Environment) -> Iterator[tuple[str, str, str, str]]:
    """Yield the row of an environment with varying fields."""
    if environment.field_t > 0:
        extent = (
            "all sensors" if environment.is_common else f"in {length_text(environment.length_m)}"
        )
        yield "environment", _ut(environment.field_t), extent, environment.name


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
