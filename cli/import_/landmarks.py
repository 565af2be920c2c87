"""Import of hall sensors and odometry of a robot over landmarks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from locatk.cli import console, options
from locatk.cli.command import section
from locatk.cli.table_options import parse_columns, parse_words

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
"""Options of landmark-csv, by the names of their arguments."""

MEDIAN = "median"

COLUMN_KEYS = ("t", "x", "y", "heading")
"""Keys of columns besides those of the sensors."""


def _parse_numbers(
    ctx: click.Context, param: click.Parameter, value: str | None
) -> tuple[float, ...] | None:
    """Return numbers separated by commas; a click callback."""
    if value is None:
        return None
    try:
        return tuple(map(float, value.split(",")))
    except ValueError:
        raise click.BadParameter(f"{value!r} is not numbers, as in 2.5 or 2.5,2.49.") from None


def _parse_numbers_or_median(
    ctx: click.Context, param: click.Parameter, value: str | None
) -> tuple[float, ...] | str | None:
    """Return numbers separated by commas, or ``median``; a click callback."""
    return value if value == MEDIAN else _parse_numbers(ctx, param, value)


landmark_options = section(
    "For landmark-csv",
    click.option(
        "--columns",
        metavar="KEY=NAME,...",
        callback=parse_columns,
        help="Headers of t, x, y, heading and of the sensors front, left, rear, right (or those of "
        "--halls), if they differ from these names; for table of any key.",
    ),
    click.option(
        "--units",
        metavar="UNIT,...",
        callback=parse_words,
        help="Units of columns without a unit in their names: one of s, ms, us, ns; of m, cm, mm; "
        "of rad, deg; of t, mt, ut, nt, gauss, v, mv; for table also of m/s2, g, mg; of rad/s, "
        "deg/s; of 6mhz, 24mhz, 48mhz (ticks).",
    ),
    click.option(
        "--circle",
        type=options.PositiveNumber(1e-9, 1000),
        metavar="MM",
        help="Radius of the circle of sensors.  [default: that of --map]",
    ),
    options.input_option(
        "--halls",
        help="Names and positions of the sensors (halls.toml), if they are not four on a circle.",
    ),
    options.input_option("--map", metavar="FILE", help="Map of the floor (map.toml)."),
    click.option(
        "--volts-per-tesla",
        metavar="V",
        callback=_parse_numbers,
        help="Sensitivity of all sensors, or of each separated by commas; negative if a field that "
        "points up lowers the voltage (10 mV/mT: 10).",
    ),
    click.option(
        "--zero-volts",
        metavar="V",
        callback=_parse_numbers_or_median,
        help="Voltage without a field, of all sensors or of each; `median` takes the median of "
        "each sensor.",
    ),
    click.option(
        "--downward",
        is_flag=True,
        default=None,
        help="Readings are positive if the field points down.",
    ),
    click.option(
        "--start",
        metavar="TIME",
        help="Time of the first row, in UTC (2026-01-31T12:00:00Z).  [default: as in the rows]",
    ),
)


def import_samples(
    reader: Any,
    paths: tuple[Path, ...],
    output: Path,
    given: dict[str, Any],
    overwrite: bool,
    imu: Sequence[Any] = (),
) -> tuple[dict[str, Any], str | None]:
    """Import samples; returns the results for ``--json`` and a summary of the losses.

    ``imu`` are samples of inertial sensors to write along with them.
    """
    from locatk.formats.artifacts import maps
    from locatk.formats.sessions import field_samples

    volts = _volts(given.get("volts_per_tesla"), given.get("zero_volts"))
    start_ns = parse_start(given.get("start"))
    floor = maps.read_map(given["map"]) if "map" in given else None
    sensors = _sensors(given.get("circle"), given.get("halls"), floor)
    with console.working("Reading"):
        imported = reader(
            paths[0],
            sensors=sensors,
            columns=given.get("columns"),
            units=given.get("units", ()),
            volts=volts,
            downward="downward" in given,
            start_ns=start_ns,
        )
        field_samples.write_halls(
            output,
            [imported.samples],
            floor=floor,
            odometry=[imported.odometry],
            imu=imu,
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
    results = {
        "samples": len(samples),
        "sensors": len(samples.sensors),
        "devices": [samples.device],
        "odometry_poses": len(imported.odometry),
        "left_out": imported.left_out,
        "left_out_poses": imported.left_out_poses,
        "warnings": imported.warnings,
    }
    return results, imported.lost


def _volts(per_tesla: tuple[float, ...] | None, zero: tuple[float, ...] | str | None) -> Any:
    """Return the conversion of voltages; None if readings are fields."""
    if per_tesla is None and zero is None:
        return None
    if per_tesla is None or zero is None:
        missing = "--volts-per-tesla" if per_tesla is None else "--zero-volts"
        raise click.UsageError(f"Voltages need {missing} too.")
    from locatk.formats.importers.landmark_csv import Volts

    return Volts(per_tesla, None if isinstance(zero, str) else zero)


def parse_start(text: str | None) -> int | None:
    """Return the time of ``--start`` in nanoseconds since the epoch."""
    if text is None:
        return None
    from locatk.formats.tables.timestamps import parse_iso_time

    try:
        return parse_iso_time(text)
    except ValueError:
        raise click.UsageError(
            f"--start {text!r} is not a time in UTC, as in 2026-01-31T12:00:00Z."
        ) from None


def _sensors(circle_mm: float | None, file: Path | None, floor: Any) -> Any:
    """Return the positions of the sensors as given by --circle, --halls or --map."""
    from locatk.core.landmarks.halls import HallSensors, circle
    from locatk.formats.artifacts import maps

    if circle_mm is not None and file is not None:
        raise click.UsageError("Give --circle or --halls, not both.")
    if file is not None:
        return maps.read_halls(file)
    if circle_mm is not None:
        return HallSensors(position_m=circle(circle_mm / 1000))
    if floor is not None:
        return HallSensors(position_m=circle(floor.geometry.circle_m))
    raise click.UsageError("A recording of hall sensors needs --circle, --halls or --map.")
