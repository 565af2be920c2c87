"""``locatk print site``: plan of the tags on a floor for the installer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from locatk.cli import console, options
from locatk.cli.command import Command, section
from locatk.cli.site.design import Position


@click.command(cls=Command, short_help="Draw the plan of a site with its tags.")
@options.input_argument("site_file")
@options.output("PDF to write.", endings=(".pdf",))
@options.overwrite
@options.as_json
@options.verbosity
@section(
    "Content",
    click.option(
        "--datum",
        default="0,0",
        type=Position(),
        show_default=True,
        metavar="X,Y",
        help="Point of the frame of the site in mm from which positions are measured.",
    ),
)
@section(
    "Paper",
    click.option(
        "--paper",
        "--size",
        "paper_name",
        default="A4",
        show_default=True,
        metavar="PAPER",
        help="A0 to A5, Letter, Tabloid, or a size as in 600x900mm or 24x36in.",
    ),
    click.option(
        "--margin",
        "margin_mm",
        type=click.FloatRange(0),
        default=10.0,
        show_default=True,
        metavar="MM",
        help="Empty margin, for printers that cannot print to the edge.",
    ),
)
def site(
    site_file: Path,
    output: Path,
    datum: tuple[float, float],
    paper_name: str,
    margin_mm: float,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Draw the plan of SITE_FILE (a tag file with positions) for the installer.

    The plan shows the floor to scale, with the id, heading and meaning of each tag and the
    distances from the datum in mm at the edges. A table lists the positions, with a box to tick. If
    the labels do not fit on one page, the plan is divided over several ones, after an overview.
    Templates for the magnets of each tag are drawn by `locatk print tag`.

    \b
    Examples:
      locatk print site site.toml -o plan.pdf
      locatk print site site.toml -o plan.pdf --paper A3
      locatk print site site.toml -o plan.pdf --paper Letter --datum=-500,250
    """
    from locatk.core.errors import error_context
    from locatk.core.paper_sizes import paper_size
    from locatk.core.polaris.drawing.plan import draw_site_plan
    from locatk.core.units import metres
    from locatk.formats.artifacts.tags import read_tags
    from locatk.formats.output import atomic_write
    from locatk.formats.printing.drawings import render_pages

    options.guard_output(output, overwrite=overwrite, inputs=[site_file])
    _, paper_mm = paper_size(paper_name)
    tags = read_tags(site_file)
    x, y = datum
    with console.working("Drawing"), error_context(site_file):
        plan = draw_site_plan(
            tags,
            site_file.stem,
            paper_mm,
            margin_mm=margin_mm,
            datum_m=(metres(x), metres(y)),
        )
        data = render_pages(plan.pages, f"locatk site {site_file.stem}")
    with atomic_write(output, overwrite=overwrite) as stream:
        stream.write(data)
    console.result(_text(output, plan))
    console.say("Print at 100 %, without scaling to fit, and measure the scale bar.")
    if as_json:
        pages = len(plan.pages)
        console.emit_json(
            {
                "version": 1,
                "output": output,
                "pages": pages,
                "page_mm": plan.pages[0].size_mm,
                "scale": plan.scale,
                "datum_mm": datum,
                "parts": {"plan": [1, plan.plan_pages], "table": [plan.plan_pages + 1, pages]},
                "tags": [
                    {"id": tag_id, "page": page + 1}
                    for tag_id, page in sorted(plan.page_of.items())
                ],
            }
        )


def _text(output: Path, plan: Any) -> str:
    """Format the summary of the plan."""
    count, pages = len(plan.page_of), len(plan.pages)
    width, height = plan.pages[0].size_mm
    return (
        f"Wrote {output}: {count} tag{'s' * (count != 1)} on {pages} pages of {width:g} x "
        f"{height:g} mm, scale 1 : {plan.scale:g}"
    )
