"""``locatk map export``: a map for vehicle controllers, master controls, ROS and CAD."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING

import click

from locatk.cli import console, options
from locatk.cli.command import Command

if TYPE_CHECKING:
    from locatk.core.landmarks.map.floor import FloorMap

ENDINGS = {
    "csv": (".csv",),
    "lif": (".json", ".lif"),
    "ros": (".yaml", ".yml"),
    "svg": (".svg",),
    "dxf": (".dxf",),
}
LIF_VERSIONS = ("1.0.0", "2.0.0")


@click.command(cls=Command)
@options.input_argument("map_file")
@click.option(
    "--format",
    "format_name",
    type=click.Choice(tuple(ENDINGS)),
    help="Format of the output; dxf needs locatk[dxf].  [default: by the ending of the output: "
    ".csv, .json (LIF), .yaml (ROS), .svg, .dxf]",
)
@options.output("File to write; `ros` also writes an image with the ending .pgm.")
@click.option(
    "--resolution",
    "resolution_mm",
    type=options.POSITIVE,
    default=10.0,
    show_default=True,
    metavar="MM",
    help="--format ros: side of a pixel.",
)
@click.option(
    "--lif-version",
    type=click.Choice(LIF_VERSIONS),
    help="--format lif: version of the format; 2.0.0 (September 2026) is not compatible with 1.0.0."
    "  [default: 1.0.0]",
)
@click.option(
    "--unique-codes",
    is_flag=True,
    help="--format csv: give each landmark a code of its own, for controllers that look up "
    "positions by code.  [default: the code of its bars, 0 to 15, which repeats]",
)
@options.overwrite
@options.as_json
@options.verbosity
def command(
    map_file: Path,
    format_name: str | None,
    output: Path,
    resolution_mm: float,
    lif_version: str | None,
    unique_codes: bool,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Write the landmarks of MAP_FILE for other tools.

    `csv` is the table No;Code;X mm;Y mm;Attr1;..;Attr4 of vehicle controllers (Goetting), `lif` the
    Layout Interchange Format of VDMA for master controls, `ros` the YAML and PGM of
    map_server, `svg` and `dxf` a drawing of the floor at true size, in layers. If the map contains
    positions as built, these are written.

    \b
    Examples:
      locatk map export map.toml -o map.csv
      locatk map export map.toml -o transponders.csv --unique-codes
      locatk map export map.toml --format lif -o layout.json
      locatk map export map.toml --format lif --lif-version 2.0.0 -o layout.json
      locatk map export map.toml --format ros -o floor.yaml --resolution 5
      locatk map export map.toml -o floor.dxf
    """
    from locatk.formats.artifacts.maps import read_map
    from locatk.formats.output import atomic_write

    format_name = options.choose_format(output, format_name, ENDINGS)
    if lif_version is not None and format_name != "lif":
        raise click.UsageError(f"--lif-version is of --format lif, not of {format_name}.")
    if unique_codes and format_name != "csv":
        raise click.UsageError(f"--unique-codes is of --format csv, not of {format_name}.")
    files = [output, output.with_suffix(".pgm")] if format_name == "ros" else [output]
    for path in files:
        options.guard_output(path, overwrite=overwrite, inputs=[map_file])
    floor = read_map(map_file)
    with console.working("Drawing"):
        if format_name == "csv":
            from locatk.formats.exporters.floors.map_csv import dumps_csv

            contents = [dumps_csv(floor, unique_codes).encode()]
        elif format_name == "lif":
            from locatk.formats.exporters.floors.layout_lif import stamp_of
            from locatk.formats.exporters.floors.map_lif import dumps_lif

            version = lif_version or LIF_VERSIONS[0]
            contents = [dumps_lif(floor, stamp_of(map_file), version).encode()]
        else:
            contents = _draw(floor, format_name, files, resolution_mm)
    with contextlib.ExitStack() as stack:
        for path, data in zip(files, contents, strict=True):
            stack.enter_context(atomic_write(path, overwrite=overwrite)).write(data)
    count = len(floor.cells())
    console.result(f"Wrote {' and '.join(map(str, files))}: {count} landmarks")
    if floor.built:
        console.say(f"{len(floor.built)} of them at their positions as built.")
    if as_json:
        console.emit_json(
            {
                "version": 1,
                "input": map_file,
                "format": format_name,
                "outputs": files,
                "landmarks": count,
                "as_built": len(floor.built),
            }
        )


def _draw(
    floor: FloorMap, format_name: str, files: list[Path], resolution_mm: float
) -> list[bytes]:
    """Return the content of each file of a drawing."""
    if format_name == "svg":
        from locatk.formats.exporters.floors.drawing_svg import dumps_svg
        from locatk.formats.exporters.floors.map_drawing import draw_map

        return [dumps_svg(draw_map(floor))]
    if format_name == "dxf":
        from locatk.formats.exporters.floors.drawing_dxf import dumps_dxf
        from locatk.formats.exporters.floors.map_drawing import draw_map

        return [dumps_dxf(draw_map(floor)).encode()]
    from locatk.formats.exporters.floors import map_ros

    pixel = resolution_mm / 1e3
    picture = map_ros.dumps_pgm(map_ros.draw_grid(floor, pixel))
    return [map_ros.dumps_yaml(floor, files[1].name, pixel).encode(), picture]
