"""``locatk receiver design``: photodiodes of a Lighthouse device."""

from __future__ import annotations

from pathlib import Path

import click

from locatk.cli import options
from locatk.cli.command import Command, section
from locatk.cli.sensors.layout import (
    check_pitch,
    choose_one,
    drawing_options,
    grid_option,
    grid_positions,
    numbered,
    pitch_option,
    positions_options,
    read_positions,
    write_layout,
)

BOARDS = ("deck", "bolt")


@click.group(short_help="Describe the photodiodes of a Lighthouse device.")
def command() -> None:
    """Describe the photodiodes of a Lighthouse device, for `locatk capture` and `locatk import`.

    \b
    Examples:
      locatk receiver design --board deck -o receiver.toml
      locatk receiver design --grid 2x2 --pitch 30 -o receiver.toml --drawing receiver.pdf
    """


@command.command(cls=Command, short_help="Write a layout of photodiodes.")
@options.output("Receiver to write (.toml).", endings=(".toml",))
@section(
    "Positions",
    click.option(
        "--board",
        type=click.Choice(BOARDS),
        help="Bitcraze's Lighthouse deck, also on a Crazyflie Bolt.",
    ),
    grid_option,
    pitch_option,
    *positions_options,
)
@section(
    "Photodiodes",
    click.option("--name", default="", metavar="TEXT", help="Kind of the device, for people."),
)
@drawing_options
@options.overwrite
@options.as_json
@options.verbosity
def design(
    output: Path,
    board: str | None,
    grid: tuple[int, int] | None,
    pitch: float | None,
    positions: Path | None,
    units: tuple[str, ...] | None,
    name: str,
    drawing: Path | None,
    size: str,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Write the positions and directions of photodiodes.

    The frame of the device: x is forward, y left, z up. Photodiodes of a grid face upwards. A table
    has the columns x, y and z, and nx, ny, nz for the directions, in the order of the samples.

    \b
    Examples:
      locatk receiver design --board deck -o receiver.toml
      locatk receiver design --grid 2x2 --pitch 30 --name tag -o receiver.toml
      locatk receiver design --positions board.csv -o pod.toml --drawing pod.pdf
    """
    from dataclasses import replace

    import numpy as np

    from locatk.core.lighthouse.receiver import RECEIVERS, Receiver
    from locatk.formats.artifacts.receiver import RECEIVER

    choose_one(board=board, grid=grid, positions=positions)
    check_pitch(grid, pitch)
    if board is not None:
        receiver = RECEIVERS[board]
    elif grid is not None and pitch is not None:
        position_m = grid_positions(grid, pitch)
        receiver = Receiver(position_m, np.tile([0.0, 0.0, 1.0], (len(position_m), 1)))
    else:
        assert positions is not None
        table = read_positions(positions, units)
        receiver = Receiver(table.position_m, table.normal)
    if name:
        receiver = replace(receiver, name=name)
    write_layout(
        RECEIVER,
        receiver,
        output,
        labels=numbered(len(receiver)),
        position_m=receiver.position_m,
        title=f"{len(receiver)} photodiodes",
        drawing=drawing,
        size=size,
        overwrite=overwrite,
        as_json=as_json,
        positions=positions,
    )
