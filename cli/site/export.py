"""``locatk site export``: a site for vehicle controllers, master controls and CAD."""

from __future__ import annotations

from pathlib import Path

import click

from locatk.cli import console, options
from locatk.cli.command import Command
from locatk.cli.map.export import ENDINGS as MAP_ENDINGS
from locatk.cli.map.export import LIF_VERSIONS
from locatk.cli.site.site_text import site_entry

ENDINGS = {name: MAP_ENDINGS[name] for name in ("csv", "lif", "svg", "dxf")}


@click.command(cls=Command)
@options.input_argument("site")
@click.option(
    "--format",
    "format_name",
    type=click.Choice(tuple(ENDINGS)),
    help="Format of the output.  [default: by the ending of the output: .csv, .json "
    "(LIF), .svg, .dxf]",
)
@options.output("File to write.")
@click.option(
    "--lif-version",
    type=click.Choice(LIF_VERSIONS),
    help="--format lif: version of the format; 2.0.0 (September 2026) is not compatible with 1.0.0."
    "  [default: 1.0.0]",
)
@options.overwrite
@options.as_json
@options.verbosity
def command(
    site: Path,
    format_name: str | None,
    output: Path,
    lif_version: str | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Write the tags on SITE (a tag file with positions) for other tools.

    `csv` is a table with the columns id, x_mm, y_mm, heading_deg and meaning, `lif` the Layout
    Interchange Format of VDMA for master controls with a node for each tag, `svg` and `dxf` a
    drawing of the floor at true size, in layers, with outlines, headings, magnets, ids and
    meanings. `locatk site import` reads csv, lif and dxf.

    \b
    Examples:
      locatk site export site.toml -o site.csv
      locatk site export site.toml --format lif -o layout.json
      locatk site export site.toml --format lif --lif-version 2.0.0 -o layout.json
      locatk site export site.toml -o floor.dxf
    """
    from locatk.core.errors import InputError
    from locatk.formats.artifacts.tags import read_tags
    from locatk.formats.output import atomic_write

    format_name = options.choose_format(output, format_name, ENDINGS)
    if lif_version is not None and format_name != "lif":
        raise click.UsageError(f"--lif-version is of --format lif, not of {format_name}.")
    options.guard_output(output, overwrite=overwrite, inputs=[site])
    tags = read_tags(site)
    if not tags.site:
        raise InputError(
            "no tag has a position",
            file=site,
            hint="Add them with [[site]], or by `locatk site import`",
        )
    with console.working("Drawing"):
        if format_name == "csv":
            from locatk.formats.exporters.floors.site_csv import dumps_csv

            data = dumps_csv(tags).encode()
        elif format_name == "lif":
            from locatk.formats.exporters.floors.layout_lif import stamp_of
            from locatk.formats.exporters.floors.site_lif import dumps_lif

            data = dumps_lif(tags, stamp_of(site), lif_version or LIF_VERSIONS[0]).encode()
        elif format_name == "svg":
            from locatk.formats.exporters.floors.drawing_svg import dumps_svg
            from locatk.formats.exporters.floors.site_drawing import draw_site

            data = dumps_svg(draw_site(tags))
        else:
            from locatk.formats.exporters.floors.drawing_dxf import dumps_dxf
            from locatk.formats.exporters.floors.site_drawing import draw_site

            data = dumps_dxf(draw_site(tags)).encode()
    with atomic_write(output, overwrite=overwrite) as stream:
        stream.write(data)
    count = len(tags.site)
    console.result(f"Wrote {output}: {count} tag{'s' * (count != 1)}")
    if as_json:
        console.emit_json(
            {
                "version": 1,
                "input": site,
                "format": format_name,
                "outputs": [output],
                "site": site_entry(tags),
            }
        )
