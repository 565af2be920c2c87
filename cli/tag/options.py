"""Options of the commands of ``locatk tag``: the design of tags, and the conditions of reading."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import click
from click.core import ParameterSource

from locatk.cli import options
from locatk.cli.command import combine, section
from locatk.cli.options import number
from locatk.core.units import metres

if TYPE_CHECKING:
    from locatk.core.polaris.design.planning import ReadingConditions
    from locatk.core.polaris.tag import Tags

LENGTH_MM = options.PositiveNumber(1e-3, 1e5)
"""Lengths of tags and arrays: from a micrometre to a hundred metres."""

CODECS = ("mosk", "redundant", "polaris-released")

code_options = section(
    "Code",
    number(
        "--order",
        default=3,
        type=click.IntRange(2, 100),
        metavar="K",
        help="Number of cells along each side of the grid.",
    ),
    number(
        "--magnets",
        default=5,
        type=click.IntRange(3),
        metavar="M",
        help="Number of magnets of a tag; three of them are on corners.",
    ),
    number(
        "--orientations",
        default=8,
        type=click.IntRange(2, 360),
        metavar="P",
        help="Number of orientations that a magnet can have.",
    ),
    click.option(
        "--codec",
        type=click.Choice(CODECS),
        default=CODECS[0],
        show_default=True,
        help="Code of the ids: `mosk` has the most ids, `redundant` corrects errors, "
        "`polaris-released` is the table published with Polaris.",
    ),
)

tag_option = options.input_option(
    "--tag", help="Tags (tag.toml) to use instead of the options under Code."
)

reading_options = combine(
    section(
        "Sensors",
        number("--sensors", default=9, metavar="N", help="Number of magnetometers in the array."),
        number(
            "--sensor-spacing",
            default=20.0,
            type=LENGTH_MM,
            metavar="MM",
            help="Distance between neighbouring magnetometers.",
        ),
        number("--osr", default=3, metavar="0-3", help="Oversampling (OSR) of the MLX90393."),
        number(
            "--filt", default=3, metavar="0-7", help="Digital filter (DIG_FILT) of the MLX90393."
        ),
        number(
            "--gain",
            default=7,
            metavar="0-7",
            help="Analogue gain (GAIN_SEL) of the MLX90393; 7 is the most sensitive.",
        ),
        number(
            "--resolution",
            default=0,
            metavar="0-3",
            help="Resolution (RES_XYZ) of the MLX90393; 0 is the finest.",
        ),
        click.option(
            "--noise",
            type=options.POSITIVE,
            metavar="UT",
            help="Standard deviation of a sample.  [default: as measured on the MLX90393]",
        ),
    ),
    section(
        "Robot",
        click.option(
            "--rate",
            type=options.POSITIVE,
            metavar="HZ",
            help="Sampling rate.  [default: the highest of the magnetometer]",
        ),
        number(
            "--speed", default=0.1, type=options.POSITIVE, metavar="M/S", help="Speed of the robot."
        ),
        click.option(
            "--placement-error",
            type=options.POSITIVE,
            metavar="DEG",
            help="RMS error of the magnets' orientations.  [default: as calibrated, otherwise 6 "
            "as for the published tags]",
        ),
        click.option(
            "--environment",
            default="quiet",
            show_default=True,
            metavar="NAME|UT",
            help="Fields that vary during a pass: quiet, reinforced (floor), motors, or their "
            "standard deviation in uT.",
        ),
    ),
)


def tags_of(path: Path | None, order: int, magnets: int, orientations: int, codec: str) -> Tags:
    """Return the tags of a file, or those of :data:`code_options`; both are a usage error."""
    from locatk.core.polaris.tag import Tags
    from locatk.formats.artifacts.tags import read_tags

    if path is not None:
        context = click.get_current_context()
        for name in ("order", "magnets", "orientations", "codec"):
            if context.get_parameter_source(name) is ParameterSource.COMMANDLINE:
                raise click.UsageError(f"The file of --tag contains the {name}; omit --{name}.")
        return read_tags(path)
    return Tags(order=order, magnets=magnets, orientations=orientations, codec=codec)


def reading_conditions(
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
    environment: str,
) -> ReadingConditions:
    """Return the conditions of reading that :data:`reading_options` describe."""
    from locatk.core.polaris.design.environment import environment_of
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
        environment=environment_of(environment),
    )
