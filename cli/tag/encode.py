"""``locatk tag encode``: the magnets of an id."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from locatk.cli import console, options
from locatk.cli.command import Command
from locatk.cli.tag.options import code_options, tag_option, tags_of

if TYPE_CHECKING:
    from locatk.core.polaris.tag import TagLayout, Tags


@click.command(cls=Command)
@click.argument("tag_id", metavar="ID", type=int)
@tag_option
@code_options
@options.as_json
@options.verbosity
def command(
    tag_id: int,
    tag: Path | None,
    order: int,
    magnets: int,
    orientations: int,
    codec: str,
    as_json: bool,
) -> None:
    """Show the positions and orientations of the magnets of tag ID.

    Orientations are clockwise from the tag's x axis, which points up in the drawing. In the
    drawing, `.` is a cell without a magnet and `-` the corner that is always empty.

    \b
    Examples:
      locatk tag encode 1234 --tag tag.toml
      locatk tag encode 262143 --codec polaris-released
    """
    from locatk.core.polaris import codec as codecs
    from locatk.core.polaris.tag import cell_positions, symbol_angles

    tags = tags_of(tag, order, magnets, orientations, codec)
    layout = codecs.layout_of(tags, tag_id)
    positions = cell_positions(tags, layout.cells).tolist()
    angles = symbol_angles(tags, layout.symbols).tolist()
    degrees = [symbol * 360 / tags.orientations for symbol in layout.symbols]
    capacity = codecs.capacity(tags)
    meaning = tags.meanings.get(tag_id)
    shown_meaning = "" if meaning is None else f": {meaning}"
    console.result(f"Tag {tag_id} of {capacity}, codec {tags.codec}{shown_meaning}\n")
    console.result(_drawing(tags, layout, degrees) + "\n")
    rows = [
        (f"{cell[0]},{cell[1]}", symbol, f"{angle:g}", f"{x * 1e3:g}", f"{y * 1e3:g}")
        for cell, symbol, angle, (x, y) in zip(
            layout.cells, layout.symbols, degrees, positions, strict=True
        )
    ]
    console.result(console.table(("cell", "symbol", "degrees", "x mm", "y mm"), rows))
    if tags.ids is not None and tag_id not in tags.ids:
        console.warn(f"{tag_id} is not in the family of {tag}.")
    if as_json:
        console.emit_json(
            {
                "version": 1,
                "id": tag_id,
                "capacity": capacity,
                "codec": tags.codec,
                "magnets": [
                    {
                        "cell": cell,
                        "symbol": symbol,
                        "orientation_deg": orientation_deg,
                        "x_m": x,
                        "y_m": y,
                        "angle_rad": angle_rad,
                    }
                    for cell, symbol, orientation_deg, (x, y), angle_rad in zip(
                        layout.cells, layout.symbols, degrees, positions, angles, strict=True
                    )
                ],
                "meaning": meaning,
            }
        )


def _drawing(tags: Tags, layout: TagLayout, degrees: list[float]) -> str:
    """Draw the grid in letters, with x up and v1 at the lower left."""
    from locatk.core.polaris.tag import vertices

    empty_corner = vertices(tags.order)[3]
    orientations = dict(zip(layout.cells, degrees, strict=True))

    def cell_text(column: int, row: int) -> str:
        if (column, row) in orientations:
            return f"{orientations[column, row]:g}"
        return "-" if (column, row) == empty_corner else "."

    columns = range(tags.order)
    rows = [
        (f"row {row}", *(cell_text(column, row) for column in columns))
        for row in reversed(range(tags.order))
    ]
    rows.append(("column", *map(str, columns)))
    label_width = max(len(row[0]) for row in rows)
    cell_width = 3 + max(len(text) for row in rows for text in row[1:])
    return "\n".join(
        row[0].ljust(label_width) + "".join(text.rjust(cell_width) for text in row[1:])
        for row in rows
    )
