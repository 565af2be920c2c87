"""``locatk site design``: tags on a grid, at points, or along a route."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, failures, options
from locatk.cli.command import Command, section
from locatk.cli.map.options import Size
from locatk.cli.options import number
from locatk.cli.route_options import LengthAndAngle, odometry_noise
from locatk.cli.site.forecast import (
    laying_of,
    odometry_options,
    plan_text,
    plan_warnings,
)
from locatk.cli.site.site_text import report_check, site_entry, written_text
from locatk.cli.table_options import site_table_options
from locatk.cli.tag.options import reading_conditions, reading_options
from locatk.core.units import metres

if TYPE_CHECKING:
    from locatk.core.polaris.design.site import SitePoint
    from locatk.core.polaris.tag import Tags


class Position(click.ParamType):
    """Position in mm, as in ``500,-200``."""

    name = "X,Y"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, float]:
        """Parse the text; fail with the expected form."""
        if isinstance(value, tuple):
            return value
        try:
            x, y = (float(part) for part in str(value).split(","))
        except ValueError:
            self.fail(f"{value!r} is not x,y in mm as in 500,-200.", param, ctx)
        if not (abs(x) <= MAX_COORDINATE_MM and abs(y) <= MAX_COORDINATE_MM):
            self.fail(f"{value!r} is not within 10 km.", param, ctx)
        return x, y


MAX_COORDINATE_MM = 1e7


@click.command(cls=Command)
@options.input_argument("tag")
@options.output("Site to write (.toml).", endings=(".toml",))
@section(
    "Positions",
    click.option(
        "--grid", type=Size(), metavar="ROWSxCOLS", help="Grid, with rows along x, from --origin."
    ),
    options.input_option("--points", help="Table (.csv) of positions: one tag each."),
    options.input_option(
        "--route",
        help="Table (.csv) of waypoints. With --spacing, a tag at each, and between them so that "
        "no distance is above it; with --accuracy, as many as are needed.",
    ),
    click.option(
        "--spacing",
        type=options.PositiveNumber(1, 1e6),
        metavar="MM",
        help="Distance between neighbouring tags of --grid; largest one of --route.",
    ),
    click.option(
        "--accuracy",
        type=LengthAndAngle(),
        metavar="MM[,DEG]",
        help="Error of position (and heading) along --route that must not be exceeded with 95 %, "
        "instead of --spacing.",
    ),
    click.option(
        "--origin",
        default="0,0",
        type=Position(),
        show_default=True,
        metavar="X,Y",
        help="Position of the first tag of --grid in mm.",
    ),
    number(
        "--heading",
        default=0.0,
        type=click.FloatRange(-360, 360),
        metavar="DEG",
        help="Heading of the tags of --grid, and of --points without a heading.",
    ),
)
@section(
    "Ids",
    number(
        "--min-distance",
        default=1,
        type=click.IntRange(min=1),
        metavar="D",
        help="Minimum distance of two ids, in orientation steps, if TAG has no family.",
    ),
)
@odometry_options
@site_table_options
@reading_options
@options.overwrite
@options.as_json
@options.verbosity
def command(
    tag: Path,
    output: Path,
    grid: tuple[int, int] | None,
    points: Path | None,
    route: Path | None,
    spacing: float | None,
    accuracy: tuple[float, float | None] | None,
    origin: tuple[float, float],
    heading: float,
    min_distance: int,
    drift: float | None,
    slip: float | None,
    laying: tuple[float, float | None] | None,
    columns: dict[str, str] | None,
    units: tuple[str, ...] | None,
    overwrite: bool,
    as_json: bool,
    **conditions: Any,
) -> None:
    """Place tags of TAG (tag.toml) on a floor, and write the site to OUTPUT.

    Each tag has an id of its own: that of the table, or the next one of the family of TAG. If TAG
    has no family, one is generated. The site is then checked as by `locatk site check`; with
    findings it is written nevertheless, and the exit status is 3.

    With --accuracy, the tags along a route are as far apart as errors of odometry, tags and
    measurement allow. If the accuracy is impossible, the site has tags at the smallest distance,
    the output names what would have to change, and the exit status is 3.

    A table has columns x and y and, optionally, heading, id and meaning, with units in their names
    (x_mm, heading_deg) or given by --units.

    \b
    Examples:
      locatk site design tag.toml --grid 3x4 --spacing 1000 -o site.toml
      locatk site design tag.toml --points stations.csv --units m,deg -o site.toml
      locatk site design tag.toml --route aisle.csv --spacing 800 -o site.toml
      locatk site design tag.toml --route aisle.csv --accuracy 20,2 -o site.toml
    """
    from locatk.core.errors import error_context
    from locatk.core.polaris.codec import capacity
    from locatk.core.polaris.design.routes import forecast_routes, plan_route
    from locatk.core.polaris.design.site import check_site, place_tags
    from locatk.formats.artifacts.tags import read_tags, write_tags
    from locatk.formats.importers.floors.site_csv import read_route, read_site_points

    sources = [each for each in (grid, points, route) if each is not None]
    if len(sources) != 1:
        raise click.UsageError("Give one of --grid, --points and --route.")
    if points is None and spacing is None and accuracy is None:
        raise click.UsageError(
            "--grid and --route need --spacing. --route may have --accuracy instead."
        )
    if accuracy is not None and (route is None or spacing is not None):
        raise click.UsageError("--accuracy is for --route, instead of --spacing.")
    if accuracy is None and any(each is not None for each in (drift, slip, laying)):
        raise click.UsageError("--drift, --slip and --laying are for --accuracy.")
    if points is not None and spacing is not None:
        raise click.UsageError("--spacing is for --grid and --route, not for --points.")
    if grid is not None and (columns or units):
        raise click.UsageError("--columns and --units are for --points and --route.")
    table = points or route
    inputs = [tag] if table is None else [tag, table]
    options.guard_output(output, overwrite=overwrite, inputs=inputs)
    tags = read_tags(tag)
    use = reading_conditions(**conditions)
    table_options = columns, units or ()
    noise, laid = odometry_noise(drift, slip), laying_of(laying, tags)
    if accuracy is None or route is None:
        plan, warnings = None, list[str]()
        placed_at = _points(tags, grid, points, route, spacing, origin, heading, *table_options)
    else:
        waypoints, _ = read_site_points(route, *table_options)
        wanted = accuracy[0], accuracy[1] or math.inf
        with console.working("Planning"), error_context(route):
            placed_at, plan = plan_route(tags, waypoints, use, noise, *wanted, laying=laid)
        warnings = plan_warnings(plan, wanted)
        ids = capacity(tags) if tags.ids is None else len(tags.ids)
        if len(placed_at) > ids:
            needed = len(placed_at)
            warnings.insert(
                0,
                f"{needed} tags are needed, but there are {ids} ids: design more (`locatk tag "
                f"design --search --count {needed}`), or take a lower accuracy",
            )
            placed_at = []
        if not placed_at:
            console.result(plan_text(plan))
            if as_json:
                console.emit_json({"version": 1, "output": None, "spacing": asdict(plan)})
            failures.finish_with_warnings(warnings)
    with error_context(table or tag):
        site = place_tags(tags, placed_at, min_distance)
    forecast = None
    with console.working("Checking"):
        report = check_site(site, use)
        if plan is not None and route is not None:
            path = read_route(route, *table_options)
            forecast = forecast_routes(site, [path], use, noise, laying=laid)
    write_tags(output, site, overwrite=overwrite)
    more: dict[str, Any] = {"output": output, "site": site_entry(site)}
    console.result(written_text(output, site) + "\n")
    if plan is not None:
        more["spacing"] = asdict(plan)
        console.result(plan_text(plan) + "\n")
    report_check(report, more, as_json, forecast=forecast, warnings=warnings)


def _points(
    tags: Tags,
    grid: tuple[int, int] | None,
    points: Path | None,
    route: Path | None,
    spacing: float | None,
    origin: tuple[float, float],
    heading: float,
    columns: dict[str, str] | None,
    units: tuple[str, ...],
) -> list[SitePoint]:
    """Return the points for tags."""
    from locatk.core.errors import error_context
    from locatk.core.polaris.design.site import grid_points, route_points
    from locatk.formats.importers.floors.site_csv import read_site_points

    if grid is not None and spacing is not None:
        x, y = origin
        return grid_points(*grid, metres(spacing), (metres(x), metres(y)), math.radians(heading))
    if points is not None:
        found, has_heading = read_site_points(points, columns, units)
        if has_heading:
            return found
        return [replace(point, heading_rad=math.radians(heading)) for point in found]
    if route is None or spacing is None:
        raise AssertionError("no source of points")
    waypoints, _ = read_site_points(route, columns, units)
    with error_context(route):
        found, left_out = route_points(waypoints, metres(spacing), tags.order * tags.spacing_m)
    if left_out:
        points_text = "1 point" if left_out == 1 else f"{left_out} points"
        console.say(f"{points_text} at which the route passes a tag again: left out.")
    return found
