"""Text and JSON of a checked site."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from locatk.cli import console, failures
from locatk.cli.site.forecast import forecast_entry, forecast_text

if TYPE_CHECKING:
    from locatk.core.polaris.design.routes import SiteForecast
    from locatk.core.polaris.design.site import SiteReport
    from locatk.core.polaris.tag import Tags

MAX_FINDINGS = 20
"""Number of findings that are printed; ``--json`` has all."""


def report_check(
    report: SiteReport,
    more: dict[str, Any],
    as_json: bool,
    *,
    forecast: SiteForecast | None = None,
    warnings: Sequence[str] = (),
) -> None:
    """Print the check of a site, and finish with exit status 3 if there are findings.

    ``more`` are further keys of the JSON object, ``forecast`` is that of a route, and ``warnings``
    come before the findings.
    """
    text = _text(report)
    if forecast is not None:
        text += "\n\n" + forecast_text(forecast)
        more = {**more, "forecast": forecast_entry(forecast)}
        warnings = [*warnings, *forecast.warnings]
    console.result(text)
    if as_json:
        console.emit_json({"version": 1, **more, **entry(report)})
    messages = [finding.message for finding in report.findings]
    omitted = len(messages) - MAX_FINDINGS
    if omitted > 0:
        messages = [*messages[:MAX_FINDINGS], f"{omitted} more findings: see --json"]
    failures.finish_with_warnings([*warnings, *messages])


def _text(report: SiteReport) -> str:
    low, high = 1e3 * report.low_m, 1e3 * report.high_m
    lines = [
        ("tags", str(report.tags)),
        (
            "magnets within",
            f"x {low[0]:.6g} to {high[0]:.6g} mm, y {low[1]:.6g} to {high[1]:.6g} mm",
        ),
    ]
    if report.nearest_ids:
        first, second = report.nearest_ids
        lines.append(
            ("nearest tags", f"{first} and {second}, {1e3 * report.nearest_m:.6g} mm apart")
        )
    if report.separation_m == report.separation_m:
        shared = report.shared_passes
        pairs = "all tags" if not shared else f"all but {shared} pair" + "s" * (shared > 1)
        lines.append(("separate passes", f"from {1e3 * report.separation_m:.6g} mm on: {pairs}"))
    return console.labelled(lines)


def entry(report: SiteReport) -> dict[str, Any]:
    """Return the check for ``--json`` (docs/formats.md)."""
    return {
        "tags": report.tags,
        "low_m": report.low_m,
        "high_m": report.high_m,
        "nearest_m": report.nearest_m,
        "nearest_ids": report.nearest_ids,
        "separation_m": report.separation_m,
        "shared_passes": report.shared_passes,
        "findings": [
            {"code": finding.code, "ids": finding.ids, "message": finding.message}
            for finding in report.findings
        ],
    }


def written_text(output: Path, tags: Tags) -> str:
    """Return the line about a site that was written."""
    ids = ", ".join(str(tag_id) for tag_id in list(tags.site)[:4])
    more = ", ..." if len(tags.site) > 4 else ""
    count = len(tags.site)
    return f"Wrote {output}: {count} tag{'s' * (count != 1)}, ids {ids}{more}"


def site_entry(tags: Tags, ids: Sequence[int] | None = None) -> list[dict[str, Any]]:
    """Return the tags of a site for ``--json``."""
    return [
        {
            "id": tag_id,
            "x_m": tags.site[tag_id].x_m,
            "y_m": tags.site[tag_id].y_m,
            "heading_rad": tags.site[tag_id].heading_rad,
            "meaning": tags.meanings.get(tag_id),
        }
        for tag_id in (tags.site if ids is None else ids)
    ]
