"""Import of magnetometers, hall sensors and odometry from any table."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from locatk.cli import console, options
from locatk.cli.command import section
from locatk.cli.import_ import landmarks

OPTIONS = ("columns", "units", "spacing", "array", "tag", *landmarks.OPTIONS[2:])
"""Options of the format, by the names of their arguments."""

table_options = section(
    "For table",
    options.input_option("--array", help="Positions of the magnetometers (array.toml)."),
)


def import_table(
    reader: Any, paths: tuple[Path, ...], output: Path, given: dict[str, Any], overwrite: bool
) -> tuple[dict[str, Any], str | None]:
    """Import a table; returns the results for ``--json`` and a summary of the losses.

    Raises
    ------
    click.UsageError
        The table has neither magnetometers nor hall sensors, or both.
    """
    from locatk.formats.importers.any_table import guess_columns

    path = paths[0]
    options.must_exist([path])
    with console.working("Reading"):
        table = reader(path)
        units = given.get("units", ())
        guess = guess_columns(table, given.get("columns") or {}, units)
    console.say(f"Columns: {guess.options()}")
    if guess.ignored:
        console.say(f"Not used: {', '.join(guess.ignored)}")
    if bool(guess.magnetometers) == guess.has_halls:
        found = "both magnetometers and" if guess.has_halls else "neither magnetometers nor"
        raise click.UsageError(
            f"{path} has {found} hall sensors. Name those to import: --columns "
            "t=NAME,b0x=NAME,b0y=NAME,b0z=NAME for magnetometers, t=NAME,x=NAME,y=NAME,"
            "heading=NAME,front=NAME,left=NAME,rear=NAME,right=NAME for hall sensors."
        )
    if guess.has_halls:
        from locatk.formats.importers.landmark_csv import read_landmarks

        keys = (*landmarks.COLUMN_KEYS, *_hall_names(given))
        columns = {key: header for key, header in guess.headers.items() if key in keys}
        named = {**given, "columns": columns, "units": (*guess.units.values(), *units)}
        return landmarks.import_samples(
            lambda _, **more: read_landmarks(table, **more), paths, output, named, overwrite
        )
    return _import_magnetometers(table, guess, given, output, overwrite=overwrite)


def _hall_names(given: dict[str, Any]) -> tuple[str, ...]:
    from locatk.core.landmarks.halls import NAMES
    from locatk.formats.artifacts import maps

    return maps.read_halls(given["halls"]).names if "halls" in given else NAMES


def _import_magnetometers(
    table: Any, guess: Any, given: dict[str, Any], output: Path, *, overwrite: bool
) -> tuple[dict[str, Any], str | None]:
    """Import magnetometers, and odometry if there is any."""
    from locatk.formats.artifacts import tags
    from locatk.formats.importers.any_table import read_magnetometers
    from locatk.formats.sessions import field_samples

    tag = tags.read_tags(given["tag"]) if "tag" in given else None
    imported, odometry = read_magnetometers(
        table,
        guess,
        array=tags.ARRAY.read(given["array"]) if "array" in given else None,
        spacing_m=given["spacing"] / 1000 if "spacing" in given else None,
        units=given.get("units", ()),
        start_ns=landmarks.parse_start(given.get("start")),
    )
    field_samples.write_magnetometers(
        output,
        [imported.samples],
        tags=tag,
        odometry=[] if odometry is None else [odometry],
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
        "columns": guess.headers,
        "samples": len(samples),
        "sensors": len(samples.array),
        "devices": [samples.device],
        "odometry_poses": poses,
        "left_out": imported.left_out,
        "warnings": imported.warnings,
    }
    return results, imported.lost
