"""``locatk site check``: distances, bounds and meanings of the tags of a site."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from locatk.cli import console, options
from locatk.cli.command import Command, section
from locatk.cli.site.site_text import report_check
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
)
@reading_options
@options.as_json
@options.verbosity
def command(
    site: Path, bounds: tuple[float, float, float, float] | None, as_json: bool, **conditions: Any
) -> None:
    """Check the tags on SITE (a tag file with positions).

    Ids of a site are unique, or the file is refused. Reported are tags that overlap, three or more
    tags in a row that are too near to each other to be separate passes (by magnets, height, noise
    and speed), tags out of bounds, and meanings of ids that are not on the site. The exit status is
    3 if there are findings.

    \b
    Examples:
      locatk site check site.toml
      locatk site check site.toml --bounds 0,0,6000,4000
      locatk site check site.toml --sensors 5 --speed 0.4 --json
    """
    from locatk.core.errors import error_context
    from locatk.core.polaris.design.site import check_site
    from locatk.formats.artifacts.tags import read_tags

    tags = read_tags(site)
    bounds_m = None if bounds is None else tuple(metres(value) for value in bounds)
    with console.working("Checking"), error_context(site):
        report = check_site(tags, reading_conditions(**conditions), bounds_m)  # type: ignore[arg-type]
    report_check(report, {"input": site}, as_json)
