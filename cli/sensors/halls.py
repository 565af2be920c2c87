"""``locatk halls design``: positions of a robot's hall sensors."""

from __future__ import annotations

import math
from pathlib import Path

import click

from locatk.cli import options
from locatk.cli.command import Command, section
from locatk.cli.sensors.layout import (
    choose_one,
    drawing_options,
    numbered,
    positions_options,
    read_positions,
    write_layout,
)
from locatk.core.units import metres


@click.group(short_help="Describe the hall sensors under a robot.")
def command() -> None:
    """Describe the hall sensors under a robot, for `locatk capture` and `locatk import`.

    \b
    Examples:
      locatk halls design --circle 25 -o halls.toml
      locatk halls design --circle 25 -o halls.toml --drawing halls.pdf
    """


@command.command(cls=Command, short_help="Write a layout of hall sensors.")
@options.output("Layout to write (.toml).", endings=(".toml",))
@section(
    "Positions",
    click.option(
        "--circle",
        type=options.PositiveNumber(1, 1e4),
        metavar="MM",
        help="Sensors `front`, `left`, `rear` and `right` on a circle of this radius about the "
        "midpoint of the wheels; 25 for the authors' robot.",
    ),
    *positions_options,
)
@section(
    "Sensors",
    click.option(
        "--noise",
        type=options.POSITIVE,
        metavar="UT",
        help="Standard deviation of a sample.  [default: estimated from the samples]",
    ),
    click.option(
        "--range",
        "range_mt",
        type=options.POSITIVE,
        metavar="MT",
        help="Largest measurable field; samples at it are saturated.  [default: unknown]",
    ),
    click.option("--part", default="", metavar="TEXT", help="Part number, for people."),
)
@drawing_options
@options.overwrite
@options.as_json
@options.verbosity
def design(
    output: Path,
    circle: float | None,
    positions: Path | None,
    units: tuple[str, ...] | None,
    noise: float | None,
    range_mt: float | None,
    part: str,
    drawing: Path | None,
    size: str,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Write the positions of hall sensors that measure the vertical field.

    The frame of the robot: x is forward, y left; the origin is the midpoint of the wheels. A table
    has the columns x and y, and names, in the order of the samples.

    \b
    Examples:
      locatk halls design --circle 25 --range 42 -o halls.toml
      locatk halls design --positions board.csv -o halls.toml --drawing halls.pdf
    """
    from locatk.core.landmarks import halls
    from locatk.formats.artifacts.maps import HALLS

    if choose_one(circle=circle, positions=positions) == "circle":
        assert circle is not None
        names, position_m = list(halls.NAMES), halls.circle(metres(circle))
    else:
        assert positions is not None
        table = read_positions(positions, units)
        position_m = table.position_m[:, :2]
        names = table.names or numbered(len(position_m))
    sensors = halls.HallSensors(
        tuple(names),
        position_m,
        math.nan if noise is None else noise * 1e-6,
        math.inf if range_mt is None else range_mt * 1e-3,
        part,
    )
    write_layout(
        HALLS,
        sensors,
        output,
        labels=names,
        position_m=position_m,
        title=f"{len(names)} hall sensors",
        drawing=drawing,
        size=size,
        overwrite=overwrite,
        as_json=as_json,
        positions=positions,
    )
