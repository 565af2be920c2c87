"""``locatk array design``: positions and noise of a robot's magnetometers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

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

if TYPE_CHECKING:
    from locatk.core.polaris.array import SensorArray

BOARDS = (
    "polaris-9",
    "polaris-3",
    "magx-large",
    "magx-medium",
    "magx-small",
    "magx-stacked",
    "magx-flat",
    "magx-cube",
    "magx-flat-cube",
)


@click.group(short_help="Describe the magnetometers under a robot.")
def command() -> None:
    """Describe the magnetometers under a robot, for `locatk capture` and `locatk import`.

    \b
    Examples:
      locatk array design --board polaris-9 -o array.toml
      locatk array design --grid 2x8 --pitch 15 -o array.toml --drawing array.pdf
    """


class Registers(click.ParamType):
    """Register settings of the MLX90393, as in ``gain=7,filt=5``, or ``default``."""

    name = "SETTINGS"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> dict[str, int]:
        """Parse the text; fail with the expected form."""
        if isinstance(value, dict):
            return value
        settings: dict[str, int] = {}
        for part in () if value == "default" else str(value).split(","):
            key, _, number = part.strip().partition("=")
            if key not in ("gain", "resolution", "osr", "filt") or not number.isdecimal():
                self.fail(f"{value!r} is not `default` or as in gain=7,osr=3,filt=5.", param, ctx)
            settings[key] = int(number)
        return settings


@command.command(cls=Command, short_help="Write an array of magnetometers.")
@options.output("Array to write (.toml).", endings=(".toml",))
@section(
    "Positions",
    click.option(
        "--board",
        type=click.Choice(BOARDS),
        metavar="NAME",
        help="A published board. Bars of Polaris: polaris-9 (9 sensors every 20 mm), polaris-3 (3 "
        "every 8 mm). Arrays of MagX, 8 sensors: magx-large, magx-medium, magx-small (two boards "
        "of 98, 80, 60 mm), magx-stacked, magx-flat, magx-cube, magx-flat-cube.",
    ),
    grid_option,
    pitch_option,
    *positions_options,
)
@section(
    "Magnetometers",
    click.option(
        "--mlx90393",
        type=Registers(),
        metavar="SETTINGS",
        help="Magnetometers are MLX90393, mounted as on the authors' bars (X right, Y back), with "
        "these settings: `default`, or as in gain=7,resolution=0,osr=3,filt=5.",
    ),
    click.option(
        "--noise",
        type=options.POSITIVE,
        metavar="UT",
        help="Standard deviation of a sample.  [default: of the MLX90393 as measured, or unknown]",
    ),
    click.option(
        "--range",
        "range_ut",
        type=options.POSITIVE,
        metavar="UT",
        help="Largest measurable field.  [default: of the MLX90393, or unknown]",
    ),
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
    mlx90393: dict[str, int] | None,
    noise: float | None,
    range_ut: float | None,
    drawing: Path | None,
    size: str,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Write the positions of magnetometers, and what is known about them, as an array.

    The frame of the array: x is forward, y left, z up. Lay the drawing on the hardware to check the
    order and the spacing of the sensors.

    \b
    Examples:
      locatk array design --board polaris-9 -o array.toml
      locatk array design --grid 1x16 --pitch 12.5 --mlx90393 filt=5 -o array.toml
      locatk array design --positions board.csv -o array.toml --drawing array.pdf
    """
    import numpy as np

    from locatk.formats.artifacts.tags import ARRAY

    choose_one(board=board, grid=grid, positions=positions)
    check_pitch(grid, pitch)
    if board is not None and mlx90393 is not None:
        raise click.UsageError("--board contains the settings; omit --mlx90393.")
    if board is not None:
        array = _board(board)
    elif grid is not None and pitch is not None:
        array = _with_positions(mlx90393, grid_positions(grid, pitch))
    else:
        assert positions is not None
        array = _with_positions(mlx90393, read_positions(positions, units).position_m)
    if noise is not None:
        array = replace(array, noise_t=np.full(3, noise * 1e-6))
    if range_ut is not None:
        array = replace(array, range_t=np.full(3, range_ut * 1e-6))
    write_layout(
        ARRAY,
        array,
        output,
        labels=numbered(len(array)),
        position_m=array.position_m,
        title=f"Array of {len(array)} magnetometers",
        drawing=drawing,
        size=size,
        overwrite=overwrite,
        as_json=as_json,
        positions=positions,
    )


def _board(name: str) -> SensorArray:
    from locatk.core.polaris.magx import published_array
    from locatk.core.polaris.mlx90393 import Settings, published_bar

    if name.startswith("magx-"):
        return published_array(name)
    return {"polaris-9": published_bar(), "polaris-3": published_bar(3, 0.008, Settings(filt=5))}[
        name
    ]


def _with_positions(registers: dict[str, int] | None, position_m: Any) -> SensorArray:
    from locatk.core.polaris.array import SensorArray
    from locatk.core.polaris.mlx90393 import Settings, published_bar

    if registers is None:
        return SensorArray(position_m)
    return replace(published_bar(1, settings=Settings(**registers)), position_m=position_m)
