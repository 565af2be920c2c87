"""``locatk tag``: design magnetic tags, check them, and tell what their ids mean."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, failures, options
from locatk.cli.tag.design import check, design
from locatk.cli.tag.shared_options import design_of, design_options

if TYPE_CHECKING:
    from locatk.core.polaris.tag import Cell, TagLayout, Tags


class MagnetAt(click.ParamType):
    """A magnet's cell and orientation, as in ``0,2:45``."""

    name = "C,R:DEG"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[Cell, float]:
        try:
            cell, _, orientation = str(value).partition(":")
            column, row = (int(index) for index in cell.split(","))
            number = float(orientation)
        except ValueError:
            self.fail(f"{value!r} is not column,row:orientation as in 0,2:45.", param, ctx)
        if not math.isfinite(number):
            self.fail(f"{orientation!r} is no orientation.", param, ctx)
        return (column, row), number


@click.group(short_help="Design magnetic tags, check them, encode and decode ids.")
def command() -> None:
    """Design tags of disc magnets, check them, and tell what their ids mean.

    \b
    Examples:
      locatk tag design -o tag.toml
      locatk tag check tag.toml
      locatk tag encode 1234 --tag tag.toml
      locatk tag decode 0,0:0 1,1:45 0,2:0 1,2:90 2,2:0
    """


command.add_command(design)
command.add_command(check)


@command.command(short_help="The magnets of an id.")
@click.argument("number", metavar="ID", type=int)
@options.input_option("--tag", help="Tags whose design it is; else as the options say.")
@design_options
@options.as_json
@options.verbosity
def encode(
    number: int,
    tag: Path | None,
    order: int,
    magnets: int,
    orientations: int,
    codec: str,
    as_json: bool,
) -> None:
    """Show where the magnets of tag ID lie and how they are turned.

    Orientations are clockwise from the tag's x, which is up in the drawing. `.` is a cell
    without a magnet, `-` the corner that stays empty.

    \b
    Examples:
      locatk tag encode 1234 --tag tag.toml
      locatk tag encode 262143 --codec polaris-released
    """
    from locatk.core.polaris import codec as codecs
    from locatk.core.polaris.tag import cell_positions, symbol_angles

    tags = design_of(tag, order, magnets, orientations, codec)
    layout = codecs.layout_of(tags, number)
    place, angle = cell_positions(tags, layout.cells), symbol_angles(tags, layout.symbols)
    degrees = [symbol * 360 / tags.orientations for symbol in layout.symbols]
    console.result(f"Tag {number} of {codecs.capacity(tags)}, codec {tags.codec}\n")
    console.result(_drawing(tags, layout, degrees) + "\n")
    rows = [
        (f"{cell[0]},{cell[1]}", symbol, f"{turn:g}", f"{x * 1e3:g}", f"{y * 1e3:g}")
        for cell, symbol, turn, (x, y) in zip(
            layout.cells, layout.symbols, degrees, place.tolist(), strict=True
        )
    ]
    console.result(console.table(("cell", "symbol", "degrees", "x mm", "y mm"), rows))
    if tags.ids is not None and number not in tags.ids:
        console.warn(f"{number} is not in the family of {tag}.")
    if as_json:
        console.emit_json(
            {
                "version": 1,
                "id": number,
                "capacity": codecs.capacity(tags),
                "codec": tags.codec,
                "magnets": [
                    {
                        "cell": cell,
                        "symbol": symbol,
                        "orientation_deg": turn,
                        "x_m": xy[0],
                        "y_m": xy[1],
                        "angle_rad": at,
                    }
                    for cell, symbol, turn, xy, at in zip(
                        layout.cells, layout.symbols, degrees, place, angle, strict=True
                    )
                ],
            }
        )


@command.command(short_help="The id of magnets.")
@click.argument("magnets_at", metavar="C,R:DEG...", type=MagnetAt(), nargs=-1, required=True)
@options.input_option("--tag", help="Tags whose design it is; else as the options say.")
@design_options
@click.option("--symbols", is_flag=True, help="What follows a cell is a symbol, not degrees.")
@options.as_json
@options.verbosity
def decode(
    magnets_at: tuple[tuple[Cell, float], ...],
    tag: Path | None,
    order: int,
    magnets: int,
    orientations: int,
    codec: str,
    symbols: bool,
    as_json: bool,
) -> None:
    """Tell the id of a tag from its magnets, each as COLUMN,ROW:ORIENTATION.

    Orientations are in degrees clockwise from the tag's x, as measured. The margin is how
    much closer the id is than the next one, in steps of orientation. The exit status is 3
    where no id is told.

    \b
    Examples:
      locatk tag decode 0,0:0 1,1:45 0,2:0 1,2:90 2,2:0
      locatk tag decode 0,0:3 1,1:41 0,2:-5 1,2:90 2,2:2 --tag tag.toml
      locatk tag decode 0,0:1 0,2:2 2,2:7 --symbols --order 3 --magnets 3
    """
    from locatk.core.polaris.identification.decoding import decode_tag

    tags = design_of(tag, order, magnets, orientations, codec)
    step = 1.0 if symbols else 360 / tags.orientations
    found = decode_tag(
        tags, [cell for cell, _ in magnets_at], [turn / step for _, turn in magnets_at]
    )
    if as_json:
        console.emit_json(
            {
                "version": 1,
                "id": found.tag_id,
                "margin": found.margin,
                "corrected": found.corrected,
                "erased": found.erased,
                "symbols": found.symbols,
                "refused": found.refused,
            }
        )
    if found.tag_id is None:
        reason = found.refused.replace("_", " ")
        raise failures.Incomplete(f"no id: {reason}, margin {found.margin:.2f} steps")
    console.result(str(found.tag_id))
    console.say(
        f"Margin {found.margin:.2f} steps, {found.corrected} corrected, {found.erased} erased."
    )


def _drawing(tags: Tags, layout: TagLayout, degrees: list[float]) -> str:
    """The grid with x up, v1 at the lower left."""
    from locatk.core.polaris.tag import vertices

    empty = vertices(tags.order)[3]
    held = dict(zip(layout.cells, degrees, strict=True))

    def cell(column: int, row: int) -> str:
        if (column, row) in held:
            return f"{held[column, row]:g}"
        return "-" if (column, row) == empty else "."

    rows = [
        (f"row {row}", *(cell(column, row) for column in range(tags.order)))
        for row in reversed(range(tags.order))
    ]
    rows.append(("column", *(str(column) for column in range(tags.order))))
    first, width = max(len(row[0]) for row in rows), max(len(t) for row in rows for t in row[1:])
    return "\n".join(
        row[0].ljust(first) + "".join(text.rjust(width + 3) for text in row[1:]) for row in rows
    )
