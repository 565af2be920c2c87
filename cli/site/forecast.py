"""Options, text and JSON of the forecast of a route over a site."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console
from locatk.cli.command import section
from locatk.cli.route_options import LengthAndAngle, accuracy_text, drift_option, slip_option
from locatk.core.units import length_text

if TYPE_CHECKING:
    from locatk.core.polaris.design.routes import SiteForecast, SpacingPlan

LIMITS = {
    "position": "error of the position",
    "heading": "error of the heading",
    "play": "lateral error at which the array misses a tag",
    "maximum": "largest spacing that is planned",
    "field": "field of the magnets",
    "length": "length of the straight parts of the route",
    "count": "number of tags of a site",
}
"""Descriptions of the limits of a spacing."""


laying_option = click.option(
    "--laying",
    type=LengthAndAngle(),
    metavar="MM[,DEG]",
    help="Error of tags on the floor along x and y, and of their headings (standard "
    "deviation).  [default: as surveyed, otherwise 1.5 mm, and 1 mm at each end of an edge]",
)

odometry_options = section(
    "Odometry and tags on the floor", drift_option, slip_option, laying_option
)


def laying_of(laying: tuple[float, float | None] | None, tags: Any) -> tuple[float, float] | None:
    """Return the standard deviations of tags on the floor; None for the default."""
    from locatk.core.polaris.design.routes import laying_sigma

    if laying is None:
        return None
    position_m, heading_rad = laying
    return position_m, laying_sigma(tags)[1] if heading_rad is None else heading_rad


def forecast_text(forecast: SiteForecast) -> str:
    """Format a forecast in 80 columns."""
    rows = [
        ("routes", f"{_count(len(forecast.routes), 'route')}, {forecast.length_m:.4g} m"),
        (
            "tags passed",
            f"{forecast.tags}; longest stretch without a tag {forecast.longest_gap_m:.3g} m",
        ),
        ("pose known", f"on {100 * forecast.covered_fraction:.3g} % of the length"),
    ]
    if math.isfinite(forecast.position_p95_m):
        x_mm, y_mm = (1e3 * forecast.worst_m).tolist()
        rows += [
            (
                "error on the route",
                f"{accuracy_text(forecast.position_p95_m, forecast.heading_p95_rad)} (95 %, live)",
            ),
            (
                "error at a tag",
                f"{accuracy_text(forecast.fix_position_p95_m, forecast.fix_heading_p95_rad)} "
                "(95 %, one pass)",
            ),
            (
                "worst place",
                f"x {x_mm:.0f}, y {y_mm:.0f} mm: {length_text(forecast.worst_position_p95_m)} "
                "(95 %)",
            ),
        ]
    return console.labelled(rows)


def forecast_entry(forecast: SiteForecast) -> dict[str, Any]:
    """Return a forecast for ``--json``."""
    return {
        "length_m": forecast.length_m,
        "tags": forecast.tags,
        "position_p95_m": forecast.position_p95_m,
        "heading_p95_rad": forecast.heading_p95_rad,
        "fix_position_p95_m": forecast.fix_position_p95_m,
        "fix_heading_p95_rad": forecast.fix_heading_p95_rad,
        "covered_fraction": forecast.covered_fraction,
        "longest_gap_m": forecast.longest_gap_m,
        "worst_m": forecast.worst_m,
        "worst_position_p95_m": forecast.worst_position_p95_m,
        "routes": [
            {
                "name": each.route.name,
                "length_m": each.route.length_m,
                "passes": [
                    {
                        "id": one.tag_id,
                        "distance_m": one.distance_m,
                        "offset_m": one.offset_m,
                        "heading_rad": one.heading_rad,
                        "play_m": one.play_m,
                    }
                    for one in each.passes
                ],
            }
            for each in forecast.routes
        ],
        "warnings": list(forecast.warnings),
    }


def plan_text(plan: SpacingPlan) -> str:
    """Format the plan of a spacing in 80 columns."""
    from locatk.core.polaris.design.site import MAX_SITE_TAGS

    limit = LIMITS[plan.limited_by]
    rows = [
        ("spacing", f"{length_text(plan.spacing_m)}; a larger one is limited by the {limit}"),
    ]
    if plan.limited_by == "field":
        rows = [("spacing", "none: no pass over a tag is detected")]
    elif plan.limited_by == "count":
        rows = [("spacing", f"none: it takes more than {MAX_SITE_TAGS} tags")]
    elif not plan.is_feasible:
        rows = [("spacing", f"{length_text(plan.spacing_m)}, the smallest for separate passes")]
    return console.labelled(rows)


def plan_warnings(plan: SpacingPlan, wanted: tuple[float, float]) -> list[str]:
    """Return what is possible, and what would have to change, if the wanted accuracy is not."""
    if plan.is_feasible:
        return []
    wish = accuracy_text(*wanted)
    reasons = {
        "field": "no pass over a tag is detected",
        "length": "no tag is passed straight",
        "count": "it needs too many tags",
    }
    if plan.limited_by in reasons:
        return [f"{wish} is impossible: {reasons[plan.limited_by]}", *plan.remedies]
    if not math.isfinite(plan.position_p95_m):
        return [f"{wish} is impossible: no tag passes wholly below the array", *plan.remedies]
    possible = accuracy_text(plan.position_p95_m, plan.heading_p95_rad)
    return [
        f"{wish} (95 %) is impossible on this route: tags {length_text(plan.spacing_m)} apart give "
        f"{possible}",
        *plan.remedies,
    ]


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" + "s" * (number != 1)
