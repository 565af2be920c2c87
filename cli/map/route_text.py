"""Options, text and JSON of the routes that ``locatk map check`` predicts."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, options
from locatk.cli.command import section
from locatk.cli.options import number
from locatk.cli.route_options import (
    LengthAndAngle,
    drift_option,
    odometry_noise,
    slip_option,
)
from locatk.core.units import metres

if TYPE_CHECKING:
    from collections.abc import Sequence

    from locatk.core.landmarks.design.routes import RouteCheck, RouteVisit
    from locatk.core.landmarks.map.floor import FloorMap

PICTURE_ENDINGS = (".png", ".svg", ".pdf")

route_options = section(
    "Routes",
    options.input_option(
        "--route",
        "route_paths",
        many=True,
        help="Table (.csv) of the waypoints of a robot, with columns like x_mm and y_mm: also "
        "predict where it is localised, and how accurately. Repeatable.",
    ),
    click.option(
        "--accuracy",
        type=LengthAndAngle(),
        metavar="MM[,DEG]",
        help="Error of position (and heading) that must not be exceeded on 95 % of a route.",
    ),
    number(
        "--speed",
        default=0.1,
        type=click.FloatRange(0.001, 20),
        metavar="M/S",
        help="Speed of the robot.",
    ),
    drift_option,
    slip_option,
    number(
        "--installation",
        default="1.5,0.7",
        type=LengthAndAngle(),
        metavar="MM[,DEG]",
        help="Errors of the landmarks on the floor along x and y, and of their orientation "
        "(standard deviations); those of landmarks as built are in the map.",
    ),
    number(
        "--iron",
        default=0.0,
        type=click.FloatRange(0, 10),
        metavar="MT",
        help="Standard deviation of the field of iron in the floor.",
    ),
    number(
        "--vehicle",
        default=0.1,
        type=click.FloatRange(0, 50),
        metavar="MT",
        help="Unknown constant field at each sensor: its offset, and the vehicle's motors and "
        "iron.",
    ),
    click.option(
        "--offline",
        is_flag=True,
        help="Predict the accuracy of `locatk solve`, which uses the whole drive, instead of "
        "`locatk live`.",
    ),
    options.output_option(
        "-o",
        "--picture",
        help="Picture of the routes to write (.png, .svg, .pdf).",
        endings=PICTURE_ENDINGS,
    ),
)


@dataclass(frozen=True)
class RouteRequest:
    """Values of :data:`route_options`."""

    route_paths: tuple[Path, ...]
    accuracy: tuple[float, float | None] | None
    speed: float
    drift: float | None
    slip: float | None
    installation: tuple[float, float | None]
    iron: float
    vehicle: float
    offline: bool
    picture: Path | None

    def check(self, floor: FloorMap) -> tuple[RouteCheck, ...]:
        """Predict the routes."""
        from dataclasses import replace

        from locatk.core.landmarks.design.routes import check_routes
        from locatk.core.landmarks.design.visit_accuracy import VisitErrors
        from locatk.formats.importers.floors.site_csv import read_route

        position_m, heading_rad = self.installation
        errors = VisitErrors(
            landmark_position_m=position_m,
            offset_t=metres(self.vehicle),
            disturbance_t=metres(self.iron),
        )
        if heading_rad is not None:
            errors = replace(errors, landmark_heading_rad=heading_rad)
        wanted_m, wanted_rad = self.accuracy or (None, None)
        return check_routes(
            floor,
            [read_route(path) for path in self.route_paths],
            odometry_noise(self.drift, self.slip),
            errors=errors,
            speed_mps=self.speed,
            is_smoothed=self.offline,
            wanted_position_m=wanted_m,
            wanted_heading_rad=wanted_rad,
        )


def route_table(checks: Sequence[RouteCheck]) -> str:
    """Return the table of routes in 80 columns."""
    header = [
        "route",
        "length [m]",
        "read of passed",
        "localised [m]",
        "final [m]",
        "longest gap [m]",
        "error [mm]",
        "error [deg]",
        "known [%]",
    ]
    rows = [
        [
            check.route.name,
            f"{check.route.length_m:.2f}",
            f"{sum(visit.is_read for visit in check.visits)}/{len(check.visits)}",
            _distance(check.localized_m),
            _distance(check.final_m),
            f"{check.longest_without_fix_m:.2f}",
            _number(1e3 * check.position_p95_m),
            _number(math.degrees(check.heading_p95_rad)),
            f"{100 * check.covered_fraction:.0f}",
        ]
        for check in checks
    ]
    return console.table(header, rows)


def route_explanation(*, is_offline: bool) -> str:
    """Return one sentence about the errors of the table."""
    solver = "locatk solve" if is_offline else "locatk live"
    return f"Errors: not exceeded on 95 % of the known part of a route, by {solver}."


def route_entry(check: RouteCheck) -> dict[str, Any]:
    """Return a route for ``--json``."""
    return {
        "name": check.route.name,
        "length_m": check.route.length_m,
        "localizable": check.is_localizable,
        "localized_after_landmarks": check.localized_after,
        "localized_m": check.localized_m,
        "final_after_landmarks": check.final_after,
        "final_m": check.final_m,
        "ambiguous_places": check.ambiguous_places,
        "longest_without_fix_m": check.longest_without_fix_m,
        "longest_from_m": check.longest_m[0],
        "covered_fraction": check.covered_fraction,
        "worst_position_sigma_m": check.position_sigma_m,
        "worst_heading_sigma_rad": check.heading_sigma_rad,
        "position_p95_m": check.position_p95_m,
        "heading_p95_rad": check.heading_p95_rad,
        "visits": [_visit_entry(visit) for visit in check.visits],
        "warnings": list(check.warnings),
        "notes": list(check.notes),
    }


def _visit_entry(visit: RouteVisit) -> dict[str, Any]:
    accuracy = visit.accuracy
    x, y, heading = (float(variance) ** 0.5 for variance in accuracy.covariance.diagonal())
    return {
        "cell": list(visit.cell),
        "distance_m": visit.distance_m,
        "offset_m": visit.offset_m,
        "gives_pose": accuracy.is_usable,
        "is_read": visit.is_read,
        "misread_probability": accuracy.misread_probability,
        "sigma_x_m": x,
        "sigma_y_m": y,
        "sigma_heading_rad": heading,
    }


def _distance(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _number(value: float) -> str:
    return f"{value:.2g}" if math.isfinite(value) else "-"
