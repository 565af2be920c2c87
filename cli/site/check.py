"""``locatk site check``: distances, bounds and meanings of the tags of a site."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from locatk.cli import console, options
from locatk.cli.command import Command, section
from locatk.cli.route_options import odometry_noise
from locatk.cli.site.forecast import laying_of, odometry_options
from locatk.cli.site.site_text import report_check
from locatk.cli.table_options import site_table_options
from locatk.cli.tag.options import reading_conditions, reading_options
from locatk.core.units import metres


class Bounds(click.ParamType):
    """Rectangle in mm, as in ``0,0,6000,4000``."""

    name = "X0,Y0,X1,Y1"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, float, float, float]:
        """Parse the text; fail with the expected form."""
        if isinstance(value, tuple):
            return value
        try:
            x0, y0, x1, y1 = (float(part) for part in str(value).split(","))
        except ValueError:
            self.fail(f"{value!r} is not x0,y0,x1,y1 in mm as in 0,0,6000,4000.", param, ctx)
        if not (x0 < x1 and y0 < y1):
            self.fail(f"{value!r} is not a rectangle: x0 < x1 and y0 < y1.", param, ctx)
        return x0, y0, x1, y1


@click.command(cls=Command)
@options.input_argument("site")
@section(
    "Floor",
    click.option(
        "--bounds",
        type=Bounds(),
        metavar="X0,Y0,X1,Y1",
        help="Rectangle in mm in which all magnets must be.",
    ),
    options.input_option(
        "--route",
        "routes",
        many=True,
        help="Table (.csv) of waypoints of a robot: also forecast its accuracy. Repeatable.",
    ),
)
@odometry_options
@site_table_options
@reading_options
@options.as_json
@options.verbosity
def command(
    site: Path,
    bounds: tuple[float, float, float, float] | None,
    routes: tuple[Path, ...],
    drift: float | None,
    slip: float | None,
    laying: tuple[float, float | None] | None,
    columns: dict[str, str] | None,
    units: tuple[str, ...] | None,
    as_json: bool,
    **conditions: Any,
) -> None:
    """Check the tags on SITE (a tag file with positions).

    Ids of a site are unique, or the file is refused. Reported are tags that overlap, three or more
    tags in a row that are too near to each other to be separate passes (by magnets, height, noise
    and speed), tags out of bounds, and meanings of ids that are not on the site. The exit status is
    3 if there are findings.

    With --route, the accuracy of a robot along the route is forecast: from passes over the tags,
    and odometry in between. A tag counts if all its magnets pass below the array.

    \b
    Examples:
      locatk site check site.toml
      locatk site check site.toml --bounds 0,0,6000,4000
      locatk site check site.toml --sensors 5 --speed 0.4 --json
      locatk site check site.toml --route aisle.csv --drift 1 --slip 0.5
    """
    from locatk.core.errors import error_context
    from locatk.core.polaris.design.routes import forecast_routes
    from locatk.core.polaris.design.site import check_site
    from locatk.formats.artifacts.tags import read_tags
    from locatk.formats.importers.floors.site_csv import read_route

    if not routes and any(each is not None for each in (drift, slip, laying, columns, units)):
        raise click.UsageError(
            "--drift, --slip, --laying, --columns and --units are for a forecast: add --route."
        )
    tags = read_tags(site)
    use = reading_conditions(**conditions)
    bounds_m = None if bounds is None else tuple(metres(value) for value in bounds)
    with console.working("Checking"), error_context(site):
        report = check_site(tags, use, bounds_m)  # type: ignore[arg-type]
    forecast = None
    if routes:
        paths = [read_route(path, columns, units or ()) for path in routes]
        with console.working("Forecasting"), error_context(site):
            forecast = forecast_routes(
                tags, paths, use, odometry_noise(drift, slip), laying=laying_of(laying, tags)
            )
    report_check(report, {"input": site}, as_json, forecast=forecast)
