"""``locatk tag decode``: the id of a tag from its magnets."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, failures, options
from locatk.cli.command import Command
from locatk.cli.tag.options import code_options, tag_option, tags_of

if TYPE_CHECKING:
    from locatk.core.polaris.tag import Cell


class OrientedCell(click.ParamType):
    """Cell and orientation of a magnet, as in ``0,2:45``."""

    name = "C,R:DEG"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[Cell, float]:
        """Parse the text; fail with the expected form."""
        try:
            cell, _, orientation = str(value).partition(":")
            column, row = (int(index) for index in cell.split(","))
            number = float(orientation)
        except ValueError:
            self.fail(f"{value!r} is not column,row:orientation as in 0,2:45.", param, ctx)
        if not math.isfinite(number):
            self.fail(f"{orientation!r} is not an orientation.", param, ctx)
        return (column, row), number


@click.command(cls=Command)
@click.argument("cells", metavar="C,R:DEG...", type=OrientedCell(), nargs=-1, required=True)
@tag_option
@click.option(
    "--symbols", is_flag=True, help="Read orientations as symbols (0, 1, ...) instead of degrees."
)
@code_options
@options.as_json
@options.verbosity
def command(
    cells: tuple[tuple[Cell, float], ...],
    tag: Path | None,
    order: int,
    magnets: int,
    orientations: int,
    codec: str,
    symbols: bool,
    as_json: bool,
) -> None:
    """Decode the id of a tag from its magnets, each as COLUMN,ROW:ORIENTATION.

    Orientations are measured in degrees clockwise from the tag's x axis. The margin in the output
    is the distance to the second-best id minus the distance to the best one, in orientation steps.
    The exit status is 3 if no id is certain.

    \b
    Examples:
      locatk tag decode 0,0:0 1,1:45 0,2:0 1,2:90 2,2:0
      locatk tag decode 0,0:3 1,1:41 0,2:-5 1,2:90 2,2:2 --tag tag.toml
      locatk tag decode 0,0:1 0,2:2 2,2:7 --symbols --order 3 --magnets 3
    """
    from locatk.core.polaris.identification.decoding import decode_tag

    tags = tags_of(tag, order, magnets, orientations, codec)
    step = 1.0 if symbols else 360 / tags.orientations
    decoded = decode_tag(
        tags, [cell for cell, _ in cells], [orientation / step for _, orientation in cells]
    )
    meaning = None if decoded.tag_id is None else tags.meanings.get(decoded.tag_id)
    if as_json:
        console.emit_json(
            {
                "version": 1,
                "id": decoded.tag_id,
                "margin": decoded.margin,
                "corrected": decoded.corrected,
                "erased": decoded.erased,
                "symbols": decoded.symbols,
                "refused": decoded.refused,
                "meaning": meaning,
            }
        )
    if decoded.tag_id is None:
        reason = decoded.refused.replace("_", " ")
        raise failures.Incomplete(f"no id: {reason}, margin {decoded.margin:.2f} steps")
    console.result(str(decoded.tag_id))
    if meaning is not None:
        console.say(f"Meaning: {meaning}")
    console.say(
        f"Margin {decoded.margin:.2f} steps, {decoded.corrected} corrected, "
        f"{decoded.erased} erased."
    )
