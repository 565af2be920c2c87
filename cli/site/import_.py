"""``locatk site import``: positions of tags from a survey or a layout of another tool."""

from __future__ import annotations

import math
from pathlib import Path

import click

from locatk.cli import console, drawing_options, options
from locatk.cli.command import Command, section
from locatk.cli.options import number
from locatk.cli.site.site_text import site_entry, written_text
from locatk.cli.table_options import site_table_options

ENDINGS = {"csv": (".csv",), "lif": (".json", ".lif"), "dxf": (".dxf",)}
DEFAULT_LAYER = "TAGS"


@click.command(cls=Command)
@options.input_argument("source")
@click.option(
    "--format",
    "format_name",
    type=click.Choice(tuple(ENDINGS)),
    help="Format of SOURCE.  [default: by the ending of SOURCE: .csv, .json (LIF), .dxf]",
)
@options.input_option("--tag", required=True, help="Design of the tags (tag.toml).")
@options.output("Site to write (.toml).", endings=(".toml",))
@section(
    "Positions",
    number(
        "--heading",
        default=0.0,
        type=click.FloatRange(-360, 360),
        metavar="DEG",
        help="Heading of all tags if SOURCE has none.",
    ),
)
@section(
    "Ids",
    number(
        "--min-distance",
        default=1,
        type=click.IntRange(min=1),
        metavar="D",
        help="Minimum distance of two ids, if neither SOURCE nor the tags have ids.",
    ),
)
@section(
    "Drawings",
    drawing_options.layer(DEFAULT_LAYER, "tags"),
)
@site_table_options
@options.overwrite
@options.as_json
@options.verbosity
def command(
    source: Path,
    format_name: str | None,
    tag: Path,
    output: Path,
    heading: float,
    min_distance: int,
    layers: tuple[str, ...],
    columns: dict[str, str] | None,
    units: tuple[str, ...] | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Write a site with the tags in SOURCE: a table, a LIF layout or a DXF drawing.

    A table (CSV) has columns x and y and, optionally, heading, id and meaning, with units in their
    names (x_mm, heading_deg) or given by --units. In a layout of VDMA's Layout Interchange Format,
    each node is a tag; its name is the id if all names are whole numbers, otherwise the meaning.

    In a drawing (DXF), each block insert, closed outline or point on --layer is a tag, and the
    rotation of an insert is its heading. Its id is the attribute ID of the block, or a text next to
    it (`12`, `12 dock`, `tag 12`), or the number of its block (TAG_12). The unit is that of the
    drawing ($INSUNITS); --units overrides it (mm, cm, dm, m, in, ft).

    Tags without an id get the next ones of the family. Check the site afterwards with `locatk site
    check`.

    \b
    Examples:
      locatk site import survey.csv --tag tag.toml -o site.toml
      locatk site import total-station.csv --tag tag.toml -o site.toml \\
          --columns x=east,y=north,id=point --units m
      locatk site import layout.json --format lif --tag tag.toml -o site.toml
      locatk site import plan.dxf --tag tag.toml -o site.toml
      locatk site import plan.dxf --tag tag.toml -o site.toml \\
          --layer MARKERS --layer NUMBERS --units m
    """
    from dataclasses import replace

    from locatk.core.errors import error_context
    from locatk.core.polaris.design.site import place_tags
    from locatk.formats.artifacts.tags import read_tags, write_tags

    format_name = options.choose_format(source, format_name, ENDINGS)
    if (format_name != "csv" and columns) or (format_name == "lif" and units):
        raise click.UsageError("--columns and --units are of --format csv, --units also of dxf.")
    drawing_options.check_layers(layers, format_name)
    if format_name == "dxf" and units and (len(units) > 1 or units[0] not in drawing_options.UNITS):
        known = ", ".join(drawing_options.UNITS)
        raise click.UsageError(f"--units of a drawing is one of {known}.")
    options.guard_output(output, overwrite=overwrite, inputs=[source, tag])
    tags = read_tags(tag)
    if format_name == "csv":
        from locatk.formats.importers.floors.site_csv import read_site_points

        points, has_heading = read_site_points(source, columns, units or ())
    elif format_name == "dxf":
        from locatk.formats.importers.floors.site_dxf import read_site_drawing

        with console.working("Reading"):
            drawing = read_site_drawing(source, layers or (DEFAULT_LAYER,), (units or (None,))[0])
        points, has_heading = list(drawing.points), drawing.has_heading
        drawing_options.report(source, drawing.unit, drawing.ignored)
    else:
        from locatk.formats.files import read_text
        from locatk.formats.importers.floors.site_lif import loads_site_points

        points, has_heading = loads_site_points(read_text(source), file=source)
    if not has_heading:
        points = [replace(point, heading_rad=math.radians(heading)) for point in points]
        console.say(f"{source} has no headings: all tags have {heading:g} deg.")
    assigned = sum(point.tag_id is None for point in points)
    with error_context(source):
        site = place_tags(tags, points, min_distance)
    write_tags(output, site, overwrite=overwrite)
    console.result(written_text(output, site))
    if assigned:
        console.say(f"{assigned} of them had no id in {source}, and got one of the family.")
    if as_json:
        console.emit_json(
            {
                "version": 1,
                "input": source,
                "output": output,
                "assigned_ids": assigned,
                "site": site_entry(site),
            }
        )
