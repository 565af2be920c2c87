"""Reports of ``locatk solve``, as JSON and as text."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from locatk.cli import console

if TYPE_CHECKING:
    from locatk.formats.pipeline import SolveReport

SYSTEMS_WITH_FACTS = ("landmarks", "polaris")
"""Systems whose ``facts`` are part of ``--json``."""

MAX_LANDMARKS = 40
"""Number of landmarks listed as text; ``--json`` lists all."""


def json_entry(report: SolveReport) -> dict[str, Any]:
    """Return the object of one session in ``--json`` (docs/formats.md)."""
    from locatk.core.solution import to_json

    return {
        "session": report.session,
        "system": report.system,
        "method": report.method,
        "output": report.output,
        "poses": report.poses,
        "rejected": report.rejected,
        "solve_s": report.solve_s,
        "detections": to_json(report.detections),
        **({"facts": to_json(report.facts) or {}} if report.system in SYSTEMS_WITH_FACTS else {}),
    }


def text(report: SolveReport) -> str:
    """Format a summary line, the detections, a table of devices, and the rejected observations."""
    rejected = ", ".join(
        f"{count} {reason.replace('_', ' ')}" for reason, count in report.rejected.items()
    )
    parts = [
        summary(report),
        _detection_table(report),
        _device_table(report),
        _heading_correction_line(report),
        console.wrapped(f"rejected: {rejected or 'nothing'}"),
    ]
    return "\n".join(part for part in parts if part)


def summary(report: SolveReport) -> str:
    """Format one line on a session."""
    duration = "solved before" if report.solve_s is None else f"{report.solve_s:.3g} s"
    return (
        f"{report.session} -> {report.output}: {report.poses} poses, {report.system} by "
        f"{report.method}, {duration}"
    )


def batch_notes(reports: Sequence[SolveReport]) -> list[str]:
    """Return the warnings of several sessions, each kind once with the number of sessions."""
    by_code: dict[str, list[tuple[str, str]]] = {}
    for report in reports:
        name = Path(report.session).name
        for code, message in {w.code: w.message for w in report.warnings}.items():
            by_code.setdefault(code, []).append((name, message))
    lines = []
    for found in by_code.values():
        name, message = found[0]
        count = f"{len(found)} of {len(reports)} sessions, as " if len(found) > 1 else ""
        lines.append(f"{count}{name}: {message}")
    return lines


def problem_table(problems: Sequence[tuple[str, str]]) -> str:
    """Format the sessions (session, problem) that were not solved, or in part."""
    return console.table(("session", "problem"), problems)


def notes(report: SolveReport) -> list[str]:
    """Return the warnings of the solver, which are printed on stderr even with ``--json``."""
    return [f"{Path(report.session).name}: {warning.message}" for warning in report.warnings]


def _device_table(report: SolveReport) -> str:
    """Format number of poses and median standard deviations of each device, `-` if unknown.

    The probability of the least probable pose follows if the system estimates it.
    """
    from locatk.core.natural_order import natural_key

    if not report.devices:
        return ""
    # The positions of a scene without scale are not in metres.
    unit = "mm" if report.is_metric else "1e-3"
    factors = (1e3, 1e3, 1e3, 180 / math.pi)
    has_probability = any(not math.isnan(device.min_probability) for device in report.devices)
    header = (
        "device",
        "poses",
        *(f"sigma {axis} [{unit}]" for axis in "xyz"),
        "sigma heading [deg]",
        *(["probability [%]"] if has_probability else []),
    )
    rows = [
        (
            device.device,
            device.poses,
            # Of Lighthouse these are millimetres, of dots a thousandth of that.
            *(
                "-" if math.isnan(sigma) else f"{factor * sigma:#.3g}"
                for sigma, factor in zip(device.median_sigma, factors, strict=True)
            ),
            *([_format_probability(device.min_probability)] if has_probability else []),
        )
        for device in sorted(report.devices, key=lambda device: natural_key(device.device))
    ]
    return console.table(header, rows)


def _format_probability(probability: float) -> str:
    # Imported when it is needed, because it takes 0.1 s.
    from locatk.formats.report.detections import format_probability

    return format_probability(probability)


def _heading_correction_line(report: SolveReport) -> str:
    """Summarize the rotations that would have led from each tag straight to the next.

    Empty without two tags of a site in a row.
    """
    if report.system != "polaris" or report.facts is None:
        return ""
    corrections = report.facts.heading_corrections
    if not corrections:
        return ""
    sizes_deg = [abs(math.degrees(each.rotation_rad)) for each in corrections]
    largest = corrections[sizes_deg.index(max(sizes_deg))]
    return console.wrapped(
        f"heading corrections: {len(corrections)}, mean size "
        f"{math.fsum(sizes_deg) / len(sizes_deg):.2f} deg, largest "
        f"{math.degrees(largest.rotation_rad):+.2f} deg from tag {largest.from_tag} to tag "
        f"{largest.to_tag}"
    )


def _detection_table(report: SolveReport) -> str:
    """Format the detected tags or landmarks; empty for the other systems."""
    if report.system not in ("polaris", "landmarks") or not report.detections:
        return ""
    from locatk.formats.report.detections import landmark_table, tag_table

    if report.system == "polaris":
        detected = tag_table(report.detections, compact=True)
    else:
        detected = landmark_table(report.detections, MAX_LANDMARKS, compact=True)
    table = console.table(detected.header, detected.rows)
    more = f"\n... and {detected.omitted} more: see --json" if detected.omitted else ""
    return f"{table}{more}"
