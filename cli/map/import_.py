"""``locatk map import``: a map from the positions of landmarks in a file of another tool."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

from locatk.cli import console, drawing_options, options
from locatk.cli.command import Command, section
from locatk.cli.map.export import ENDINGS

FORMATS = ("csv", "lif", "dxf")
DEFAULT_LAYER = "BARS"
ALPHABETS = ("6", "16", "compass")
WINDOWS = ("L", "I2", "I3", "2x2", "3x3")


@click.command(cls=Command)
@options.input_argument("source")
@click.option(
    "--format",
    "format_name",
    type=click.Choice(FORMATS),
    help="Format of SOURCE.  [default: by the ending of SOURCE: .csv, .json (LIF), .dxf]",
)
@options.output("Map to write (.toml).", endings=(".toml",))
@section(
    "Grid",
    click.option(
        "--pitch",
        "pitch_mm",
        type=options.POSITIVE,
        metavar="MM",
        help="Distance between neighbouring cells.  [default: the largest that fits the positions]",
    ),
    click.option(
        "--tolerance",
        "tolerance_mm",
        type=options.POSITIVE,
        default=10.0,
        show_default=True,
        metavar="MM",
        help="Maximum deviation of a landmark from its cell along x or y.",
    ),
)
@section(
    "Drawings",
    drawing_options.layer(DEFAULT_LAYER, "landmarks"),
    click.option(
        "--units",
        "unit",
        type=click.Choice(drawing_options.UNITS),
        help="--format dxf: unit of the drawing.  [default: that of the file, $INSUNITS]",
    ),
)
@section(
    "Properties that SOURCE does not contain",
    options.input_option("--like", help="Map with the same alphabet, window and bars."),
    click.option(
        "--alphabet",
        type=click.Choice(ALPHABETS),
        help="Alphabet, as in `locatk map design`.  [default: that of --like, otherwise 16]",
    ),
    click.option(
        "--window",
        type=click.Choice(WINDOWS),
        help="Window, as in `locatk map design`.  [default: that of --like, otherwise L]",
    ),
)
@options.overwrite
@options.as_json
@options.verbosity
def command(
    source: Path,
    format_name: str | None,
    output: Path,
    pitch_mm: float | None,
    tolerance_mm: float,
    layers: tuple[str, ...],
    unit: str | None,
    like: Path | None,
    alphabet: str | None,
    window: str | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Write a map of the landmarks in SOURCE: a table of `locatk map export`, LIF, or DXF.

    Pitch, rows and columns are estimated from the positions. If a landmark deviates from its cell,
    its position is imported as built; a deviation beyond the tolerance is an error. Such files do
    not contain alphabet, window and bars: give them as options. Check the map afterwards with
    `locatk map check`.

    In a drawing (DXF), each block insert, closed outline or point on --layer is a landmark. The
    letters of its bars are the attribute LANDMARK, a text next to it, or the end of the name of its
    block (LANDMARK_NNSN). Walls are not read.

    \b
    Examples:
      locatk map import map.csv -o map.toml
      locatk map import survey.csv -o map.toml --pitch 200 --like design.toml
      locatk map import layout.json --format lif -o map.toml --alphabet 6
      locatk map import plan.dxf -o map.toml --like design.toml
    """
    from locatk.core.units import metres
    from locatk.formats.artifacts.maps import dumps_map, loads_map, read_map, write_map
    from locatk.formats.files import read_text

    if format_name is None:
        known = {name: ENDINGS[name] for name in FORMATS}
        format_name = options.choose_format(source, None, known)
    drawing_options.check_layers(layers, format_name)
    if unit is not None and format_name != "dxf":
        raise click.UsageError(f"--units is of --format dxf, not of {format_name}.")
    inputs = [source] if like is None else [source, like]
    options.guard_output(output, overwrite=overwrite, inputs=inputs)
    pitch = None if pitch_mm is None else metres(pitch_mm)
    tolerance, warnings = metres(tolerance_mm), list[str]()
    if format_name == "csv":
        from locatk.formats.importers.floors.map_csv import loads_csv

        text = read_text(source)
        floor = loads_csv(
            text, file=source, pitch_m=pitch, tolerance_m=tolerance, warnings=warnings
        )
    elif format_name == "dxf":
        from locatk.formats.importers.floors.map_dxf import read_map_drawing

        floor, content = read_map_drawing(
            source, layers or (DEFAULT_LAYER,), unit, pitch_m=pitch, tolerance_m=tolerance
        )
        drawing_options.report(source, content.unit, content.ignored)
    else:
        from locatk.formats.importers.floors.map_lif import loads_lif

        floor = loads_lif(read_text(source), file=source, pitch_m=pitch, tolerance_m=tolerance)
    if like is not None:
        design = read_map(like)
        floor = replace(
            floor,
            alphabet=design.alphabet,
            window=design.window,
            detect=design.detect,
            geometry=design.geometry,
        )
    floor = replace(floor, alphabet=alphabet or floor.alphabet, window=window or floor.window)
    loads_map(dumps_map(floor), file=source)  # the checks of maps that people write
    write_map(output, floor, overwrite=overwrite)

    for warning in warnings:
        console.warn(warning)
    rows, columns = floor.shape
    count = len(floor.cells())
    offsets_m = [max(abs(built.x_m), abs(built.y_m)) for built in floor.built.values()]
    max_offset_m = max(offsets_m, default=0.0)
    console.result(
        f"Wrote {output}: {count} landmarks in {rows} rows and {columns} columns of "
        f"{1e3 * floor.pitch_m:.6g} mm"
    )
    if offsets_m:
        console.say(
            f"{len(offsets_m)} of them deviate from their cells, by at most "
            f"{1e3 * max_offset_m:.3g} mm."
        )
    if as_json:
        console.emit_json(
            {
                "version": 1,
                "input": source,
                "output": output,
                "rows": rows,
                "columns": columns,
                "landmarks": count,
                "pitch_m": floor.pitch_m,
                "origin_m": floor.origin_m,
                "walls": len(floor.walls),
                "as_built": len(offsets_m),
                "largest_offset_m": max_offset_m,
                "warnings": warnings,
            }
        )
