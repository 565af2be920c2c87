"""Import of sweeps, magnetometers, hall sensors, odometry and IMUs from any table."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from locatk.cli import console, options
from locatk.cli.command import section
from locatk.cli.import_ import landmarks, lighthouse

OPTIONS = (
    "mapping",
    "columns",
    "units",
    "clock",
    "receiver",
    "spacing",
    "array",
    "tag",
    *landmarks.OPTIONS[2:],
)
"""Options of the format, by the names of their arguments."""

DEVICE = "device"
"""Name of a device with sweeps or an IMU, if the table has no column of names."""

table_options = section(
    "For table",
    options.input_option(
        "--mapping",
        help="Columns, units and clock of tables of this kind (TOML), in the form in which they "
        "are printed. --columns, --units and --clock override it.",
    ),
    click.option(
        "--clock",
        metavar="CLOCK",
        help='Unit of the times, and width of a counter that wraps: "us, 32 bit", "24 MHz, 24 '
        'bit", or "s, 32 bit of us" if microseconds were converted.',
    ),
    options.input_option("--array", help="Positions of the magnetometers (array.toml)."),
)


def import_table(
    reader: Any, paths: tuple[Path, ...], output: Path, given: dict[str, Any], overwrite: bool
) -> tuple[dict[str, Any], str | None]:
    """Import a table; returns the results for ``--json`` and a summary of the losses.

    Raises
    ------
    click.UsageError
        The table has observations of no system, or of several.
    """
    from locatk.formats.importers.any_table.columns import guess_columns
    from locatk.formats.importers.any_table.inertial import read_imu
    from locatk.formats.importers.any_table.mapping import dumps_mapping

    path = paths[0]
    options.must_exist([path])
    halls = _hall_names(given)
    mapping = _mapping(given, halls)
    with console.working("Reading"):
        table = reader(path)
        guess = guess_columns(
            table, mapping.columns, mapping.units, halls=halls, clock=mapping.clock
        )
    console.say(f"Recognised (as a file for --mapping):\n{dumps_mapping(guess, mapping)}")
    if guess.ignored:
        console.say(f"Not used: {', '.join(guess.ignored)}")
    system = _system(path, guess)
    # Rows of the table, as all readers take them.
    rows: dict[str, Any] = {
        "units": mapping.units,
        "clock": mapping.clock,
        "start_ns": landmarks.parse_start(given.get("start")),
    }
    device = {"polaris": "bar", "landmarks": "robot"}.get(system, DEVICE)
    imu, doubts = read_imu(table, guess, device=device, **rows) if guess.has_imu else ([], [])
    if system == "lighthouse":
        results, lost = _import_sweeps(
            table, guess, rows, imu, doubts, paths, output, given, overwrite=overwrite
        )
    elif system == "landmarks":
        results, lost = _import_halls(
            table, guess, rows, imu, paths, output, given, overwrite=overwrite
        )
        results["warnings"] += doubts
    else:
        results, lost = _import_magnetometers(
            table, guess, rows, imu, output, given, overwrite=overwrite
        )
        results["warnings"] += doubts
    if imu and system != "lighthouse":
        console.say(f"{sum(map(len, imu))} samples of the IMU, which {system} does not use")
    return {**results, "columns": guess.headers, "imu_samples": sum(map(len, imu))}, lost


def _mapping(given: dict[str, Any], halls: tuple[str, ...]) -> Any:
    """Return the mapping of --mapping, with the options that override it."""
    from locatk.formats.importers.any_table.mapping import TableMapping, read_mapping
    from locatk.formats.tables.clocks import parse_clock

    clock = parse_clock(given["clock"]) if "clock" in given else None
    stated = TableMapping(given.get("columns") or {}, tuple(given.get("units", ())), clock)
    mapping = read_mapping(given["mapping"], halls) if "mapping" in given else TableMapping()
    return mapping.merge(stated)


def _system(path: Path, guess: Any) -> str:
    """Return the system of the observations; a table with an IMU alone is of lighthouse."""
    found = {
        "sweeps of base stations": bool(guess.measurements),
        "magnetometers": bool(guess.magnetometers),
        "hall sensors": guess.has_halls,
    }
    names = [name for name, is_found in found.items() if is_found]
    if len(names) > 1 or not (names or guess.has_imu):
        problem = (
            f"has {' and '.join(names)}" if names else f"has none of {', '.join(found)} and an IMU"
        )
        raise click.UsageError(
            f"{path} {problem}. Name those to import: --columns "
            "t=NAME,channel=NAME,sensor=NAME,sweep=NAME,count=NAME for sweeps, "
            "t=NAME,b0x=NAME,b0y=NAME,b0z=NAME for magnetometers, t=NAME,x=NAME,y=NAME,"
            "heading=NAME,front=NAME,left=NAME,rear=NAME,right=NAME for hall sensors."
        )
    if guess.magnetometers:
        return "polaris"
    return "landmarks" if guess.has_halls else "lighthouse"


def _hall_names(given: dict[str, Any]) -> tuple[str, ...]:
    from locatk.core.landmarks.halls import NAMES
    from locatk.formats.artifacts import maps

    return maps.read_halls(given["halls"]).names if "halls" in given else NAMES


def _import_sweeps(
    table: Any,
    guess: Any,
    rows: dict[str, Any],
    imu: list[Any],
    doubts: list[str],
    paths: tuple[Path, ...],
    output: Path,
    given: dict[str, Any],
    *,
    overwrite: bool,
) -> tuple[dict[str, Any], str | None]:
    """Import sweeps of base stations, or an IMU alone."""
    from locatk.formats.importers.any_table.sweeps import read_sweeps
    from locatk.formats.importers.crazyflie_usd.recording import read_mounted_receiver

    receiver = read_mounted_receiver(given["receiver"], ()) if "receiver" in given else None
    imported = read_sweeps(
        table, guess, device=DEVICE, receiver=receiver, imu=imu, warnings=doubts, **rows
    )
    results = lighthouse.import_sweeps(lambda _: imported, paths, output, {}, overwrite)
    if receiver is None and imported.sweeps.sensor.any():
        console.say("No --receiver: `locatk solve` will estimate a position of each photodiode")
    return results


def _import_halls(
    table: Any,
    guess: Any,
    rows: dict[str, Any],
    imu: list[Any],
    paths: tuple[Path, ...],
    output: Path,
    given: dict[str, Any],
    *,
    overwrite: bool,
) -> tuple[dict[str, Any], str | None]:
    """Import hall sensors and odometry."""
    from locatk.formats.importers.any_table.columns import read_row_times
    from locatk.formats.importers.landmark_csv import read_landmarks

    times = read_row_times(table, guess, **rows)
    keys = ("x", "y", "heading", *guess.halls)
    columns = {key: header for key, header in guess.headers.items() if key in keys}
    return landmarks.import_samples(
        lambda _, **more: read_landmarks(table, **more, times=times),
        paths,
        output,
        {**given, "columns": columns, "units": rows["units"]},
        overwrite,
        imu,
    )


def _import_magnetometers(
    table: Any,
    guess: Any,
    rows: dict[str, Any],
    imu: list[Any],
    output: Path,
    given: dict[str, Any],
    *,
    overwrite: bool,
) -> tuple[dict[str, Any], str | None]:
    """Import magnetometers, and odometry if there is any."""
    from locatk.formats.artifacts import tags
    from locatk.formats.importers.any_table.magnetometers import read_magnetometers
    from locatk.formats.sessions import field_samples

    tag = tags.read_tags(given["tag"]) if "tag" in given else None
    imported, odometry = read_magnetometers(
        table,
        guess,
        array=tags.ARRAY.read(given["array"]) if "array" in given else None,
        spacing_m=given["spacing"] / 1000 if "spacing" in given else None,
        **rows,
    )
    field_samples.write_magnetometers(
        output,
        [imported.samples],
        tags=tag,
        odometry=[] if odometry is None else [odometry],
        imu=imu,
        facts=imported.facts,
        warnings=imported.warnings,
        overwrite=overwrite,
    )
    samples = imported.samples
    poses = 0 if odometry is None else len(odometry)
    console.say(
        f"{len(samples)} samples of {len(samples.array)} magnetometers, {poses} poses of odometry"
    )
    if tag is None:
        console.say("No --tag: `locatk solve` will need it as --artifact")
    results = {
        "samples": len(samples),
        "sensors": len(samples.array),
        "devices": [samples.device],
        "odometry_poses": poses,
        "left_out": imported.left_out,
        "warnings": imported.warnings,
    }
    return results, imported.lost
