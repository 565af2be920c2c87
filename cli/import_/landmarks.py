"""What `locatk import landmark-csv` is told on the command line, and what it does."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from locatk.cli import console, options

if TYPE_CHECKING:
    from locatk.core.landmarks.halls import HallSensors
    from locatk.core.landmarks.map.floor import FloorMap

F = TypeVar("F", bound=Callable[..., Any])

OPTIONS = (
    "columns",
    "units",
    "circle",
    "halls",
    "map",
    "volts_per_tesla",
    "zero_volts",
    "downward",
    "start",
)
"""By the names of their arguments."""

MEDIAN = "median"


def _named(ctx: click.Context, param: click.Parameter, value: str | None) -> dict[str, str] | None:
    """Callback: ``t=time,x=odom_x`` as a dictionary."""
    if value is None:
        return None
    named: dict[str, str] = {}
    for pair in value.split(","):
        key, equals, name = (part.strip() for part in pair.partition("="))
        if not (key and equals and name):
            raise click.BadParameter(f"{pair!r} is not KEY=NAME.")
        if key in named:
            raise click.BadParameter(f"{key} is there twice.")
        named[key] = name
    return named


def _words(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[str, ...] | None:
    """Callback: ``s,mm,deg`` as a tuple."""
    return value if value is None else tuple(word.strip().lower() for word in value.split(","))


def _numbers(
    ctx: click.Context, param: click.Parameter, value: str | None
) -> tuple[float, ...] | None:
    """Callback: numbers between commas."""
    if value is None:
        return None
    try:
        return tuple(map(float, value.split(",")))
    except ValueError:
        raise click.BadParameter(f"{value!r} is not numbers, as in 2.5 or 2.5,2.49.") from None


def _zeros(
    ctx: click.Context, param: click.Parameter, value: str | None
) -> tuple[float, ...] | str | None:
    """Callback: the same, or ``median``."""
    return value if value == MEDIAN else _numbers(ctx, param, value)


def landmark_options(command: F) -> F:
    """The options of the format ``landmark-csv``."""
    for option in reversed(
        (
            click.option(
                "--columns",
                metavar="KEY=NAME,...",
                callback=_named,
                help="landmark-csv: headers of t, x, y, heading and of the sensors front, left, "
                "rear, right (or those of --halls), where these are not their names.",
            ),
            click.option(
                "--units",
                metavar="UNIT,...",
                callback=_words,
                help="landmark-csv: of the columns whose names tell none: one of s, ms, us, ns; "
                "of m, cm, mm; of rad, deg; of t, mt, ut, gauss, v, mv.",
            ),
            click.option(
                "--circle",
                type=click.FloatRange(min=0, min_open=True, max=1000),
                metavar="MM",
                help="landmark-csv: radius of the circle of sensors. [default: that of --map]",
            ),
            options.input_option(
                "--halls",
                metavar="FILE",
                help="landmark-csv: the sensors' names and places (halls.toml), where they are "
                "not four on a circle.",
            ),
            options.input_option(
                "--map", metavar="FILE", help="landmark-csv: the floor's map (map.toml)."
            ),
            click.option(
                "--volts-per-tesla",
                metavar="V",
                callback=_numbers,
                help="landmark-csv: of the sensors, or of each, with commas between; negative "
                "where a field that points up lowers the voltage (10 mV/mT: 10).",
            ),
            click.option(
                "--zero-volts",
                metavar="V",
                callback=_zeros,
                help="landmark-csv: without a field, of the sensors or of each; `median` takes "
                "the median of each sensor.",
            ),
            click.option(
                "--downward",
                is_flag=True,
                default=None,
                help="landmark-csv: readings are positive where the field points down.",
            ),
            click.option(
                "--start",
                metavar="TIME",
                help="landmark-csv: of the first row, in UTC (2026-01-31T12:00:00Z). [default: "
                "as the rows say]",
            ),
        )
    ):
        command = option(command)
    return command


def import_samples(
    read: Any, path: Path, output: Path, given: dict[str, Any], overwrite: bool
) -> tuple[dict[str, Any], str | None]:
    """Import samples of hall sensors; returns what ``--json`` says of them, and what was lost.

    ``given`` holds :data:`OPTIONS`.
    """
    from locatk.formats.artifacts import maps
    from locatk.formats.sessions import halls

    volts = _volts(given["volts_per_tesla"], given["zero_volts"])
    start_ns = _start(given["start"])
    floor = None if given["map"] is None else maps.read_map(given["map"])
    sensors = _sensors(given["circle"], given["halls"], floor)
    with console.working("Reading"):
        imported = read(
            path,
            sensors=sensors,
            columns=given["columns"],
            units=given["units"] or (),
            volts=volts,
            downward=bool(given["downward"]),
            start_ns=start_ns,
        )
        halls.write_session(
            output,
            [imported.samples],
            floor=floor,
            odometry=[imported.odometry],
            facts=imported.facts,
            warnings=imported.warnings,
            overwrite=overwrite,
        )
    samples = imported.samples
    console.say(
        f"{len(samples)} samples of {len(samples.sensors)} sensors, {len(imported.odometry)} "
        "poses of odometry"
    )
    if floor is None:
        console.say("No --map: `locatk solve` will need it as --artifact")
    answer = {
        "samples": len(samples),
        "sensors": len(samples.sensors),
        "devices": [samples.device],
        "odometry_poses": len(imported.odometry),
        "left_out": imported.left_out,
        "warnings": imported.warnings,
    }
    return answer, imported.lost


def _volts(per_tesla: tuple[float, ...] | None, zero: Any) -> Any:
    if per_tesla is None and zero is None:
        return None
    if per_tesla is None or zero is None:
        missing = "--volts-per-tesla" if per_tesla is None else "--zero-volts"
        raise click.UsageError(f"Voltages need {missing} too.")
    from locatk.formats.importers.landmark_csv import Volts

    return Volts(per_tesla, None if zero == MEDIAN else zero)


def _start(text: str | None) -> int | None:
    if text is None:
        return None
    from locatk.formats.tables.timestamps import parse_iso_time

    try:
        return parse_iso_time(text)
    except ValueError:
        raise click.UsageError(
            f"--start {text!r} is not a time in UTC, as in 2026-01-31T12:00:00Z."
        ) from None


def _sensors(circle: float | None, file: Path | None, floor: FloorMap | None) -> HallSensors:
    """Where the sensors sit, by what was said of them."""
    from locatk.core.landmarks.halls import HallSensors
    from locatk.core.landmarks.halls import circle as on_circle
    from locatk.formats.artifacts import maps

    if circle is not None and file is not None:
        raise click.UsageError("Give --circle or --halls, not both.")
    if file is not None:
        return maps.read_halls(file)
    if circle is not None:
        return HallSensors(position_m=on_circle(circle / 1000))
    if floor is not None:
        return HallSensors(position_m=on_circle(floor.geometry.circle_m))
    raise click.UsageError("The format landmark-csv needs --circle, --halls or --map.")
