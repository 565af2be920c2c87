"""Options that the commands of ``locatk tag`` share, and what they mean."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import click
from click.core import ParameterSource

from locatk.cli.command import combine
from locatk.cli.options import number
from locatk.core.units import metres

if TYPE_CHECKING:
    from locatk.core.polaris.design.planning import ReadingConditions
    from locatk.core.polaris.tag import Tags

CODECS = ("mosk", "redundant", "polaris-released")


design_options = combine(
    number(
        "--order",
        default=3,
        type=click.IntRange(2, 100),
        metavar="K",
        help="Cells along a side of the grid.",
    ),
    number(
        "--magnets",
        default=5,
        type=click.IntRange(3),
        metavar="M",
        help="Three of them on corners.",
    ),
    number(
        "--orientations", default=8, type=click.IntRange(2, 360), metavar="P", help="Of a magnet."
    ),
    click.option("--codec", type=click.Choice(CODECS), default=CODECS[0], show_default=True),
)

use_options = combine(
    number("--sensors", default=9, metavar="N", help="Magnetometers of the array."),
    number("--sensor-spacing", default=20.0, metavar="MM", help="Between two of them."),
    number("--osr", default=3, metavar="0-3", help="Oversampling of the MLX90393."),
    number("--filt", default=3, metavar="0-7", help="Its digital filter."),
    number("--gain", default=7, metavar="0-7", help="Its GAIN_SEL; 7 is the most sensitive."),
    number("--resolution", default=0, metavar="0-3", help="Its RES_XYZ; 0 is the finest."),
    click.option(
        "--noise",
        type=float,
        metavar="UT",
        help="Standard deviation of a sample in microtesla.  [default: as measured]",
    ),
    click.option(
        "--rate",
        type=float,
        metavar="HZ",
        help="Samples a second.  [default: as many as the magnetometer gives]",
    ),
    number("--speed", default=0.1, metavar="M/S", help="Of the robot."),
    click.option(
        "--placement-error",
        type=float,
        metavar="DEG",
        help="Rms error of the magnets' orientations.  [default: as calibrated, else 6, the "
        "published tags']",
    ),
)


def design_of(path: Path | None, order: int, magnets: int, orientations: int, codec: str) -> Tags:
    """The tags of a file, else those of the options; not both."""
    from locatk.core.polaris.tag import Tags
    from locatk.formats.artifacts.tags import read_tags

    if path is not None:
        context = click.get_current_context()
        for name in ("order", "magnets", "orientations", "codec"):
            if context.get_parameter_source(name) is ParameterSource.COMMANDLINE:
                raise click.UsageError(f"--tag has the tags' {name}; leave --{name} out.")
        return read_tags(path)
    return Tags(order=order, magnets=magnets, orientations=orientations, codec=codec)


def use_of(
    sensors: int,
    sensor_spacing: float,
    osr: int,
    filt: int,
    gain: int,
    resolution: int,
    noise: float | None,
    rate: float | None,
    speed: float,
    placement_error: float | None,
) -> ReadingConditions:
    """How tags are to be read, after :data:`use_options`."""
    from locatk.core.polaris.design.planning import ReadingConditions
    from locatk.core.polaris.mlx90393 import Settings

    return ReadingConditions(
        sensors=sensors,
        sensor_spacing_m=metres(sensor_spacing),
        settings=Settings(gain, resolution, osr, filt),
        noise_t=None if noise is None else noise / 1e6,
        rate_hz=rate,
        speed_mps=speed,
        placement_rad=None if placement_error is None else math.radians(placement_error),
    )
