"""``locatk import``: recordings of other tools as sessions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from locatk.cli import console, failures, options
from locatk.cli.command import Command
from locatk.cli.import_ import dots, landmarks, lighthouse, polaris

MAX_PRINTED_WARNINGS = 10
"""Most warnings on stderr; ``--json`` and the log of a camera session contain all of them."""

Results = tuple[dict[str, Any], str | None]
"""Results for ``--json``, and a summary of the losses, if any."""


@dataclass(frozen=True)
class Format:
    """Foreign format.

    Attributes
    ----------
    reader : str
        Module and name of the function that reads it.
    run : callable
        Imports with that reader: ``run(reader, paths, output, given, overwrite)``, in which
        ``given`` are the options that were given, by the names of their arguments.
    options : tuple of str
        Options that the format has.
    takes_one_path : bool
    """

    reader: str
    run: Callable[[Any, tuple[Path, ...], Path, dict[str, Any], bool], Results]
    options: tuple[str, ...] = ()
    takes_one_path: bool = False


IMPORTERS = "locatk.formats.importers."

FORMATS = {
    "dotbot-lh2": Format(
        IMPORTERS + "dotbot.recording:read_dotbot", lighthouse.import_sweeps, lighthouse.DOTBOT
    ),
    "saleae": Format(
        IMPORTERS + "saleae.recording:read_saleae",
        lighthouse.import_sweeps,
        lighthouse.SALEAE,
        takes_one_path=True,
    ),
    "libsurvive": Format(
        IMPORTERS + "libsurvive.recording:read_libsurvive",
        lighthouse.import_sweeps,
        lighthouse.LIBSURVIVE,
    ),
    "dotbot-log": Format(IMPORTERS + "dotbot.log:read_dotbot_log", lighthouse.import_sweeps),
    "crazyflie-config": Format(
        IMPORTERS + "crazyflie:read_config",
        lighthouse.import_scene,
        takes_one_path=True,
    ),
    "crazyflie-usd": Format(
        IMPORTERS + "crazyflie_usd.recording:read_crazyflie_usd",
        lighthouse.import_sweeps,
        lighthouse.CRAZYFLIE_USD,
        takes_one_path=True,
    ),
    "crazyflie-csv": Format(
        IMPORTERS + "crazyflie_csv:read_crazyflie_csv",
        lighthouse.import_sweeps,
        lighthouse.CRAZYFLIE,
    ),
    "images": Format(IMPORTERS + "images:ImageFiles", dots.import_images, dots.IMAGES),
    "video": Format(IMPORTERS + "video:Video", dots.import_video, dots.VIDEO, takes_one_path=True),
    "polaris-csv": Format(
        IMPORTERS + "polaris_csv:read_polaris",
        polaris.import_samples,
        polaris.OPTIONS,
        takes_one_path=True,
    ),
    "landmark-csv": Format(
        IMPORTERS + "landmark_csv:read_landmarks",
        landmarks.import_samples,
        landmarks.OPTIONS,
        takes_one_path=True,
    ),
}


@click.command("import", cls=Command, short_help="Import recordings of other tools as a session.")
@click.argument("format_name", metavar="FORMAT", type=click.Choice(list(FORMATS)))
@click.argument("paths", type=options.PATH, nargs=-1, required=True)
@options.output("Session to write (.mcap), or for crazyflie-config the scene (.toml).")
@lighthouse.lighthouse_options
@dots.dots_options
@polaris.polaris_options
@landmarks.landmark_options
@options.overwrite
@options.as_json
@options.verbosity
def command(
    format_name: str,
    paths: tuple[Path, ...],
    output: Path,
    overwrite: bool,
    as_json: bool,
    **format_options: Any,
) -> None:
    """Import PATHS, recorded by another tool in FORMAT, as one session.

    \b
    FORMAT is one of
      dotbot-lh2    LFSR counts of Lighthouse V2 as published by DotBots (CSV)
      dotbot-log    the same, and raw bits, from logs of a DotBot gateway
      saleae        infrared light: data lines of photodiodes on a logic analyser,
                    as a capture of Logic 2 (.sal) or exported edges (.csv, .bin);
                    decodes sweeps, rotor periods and calibrations
      libsurvive    recordings of libsurvive (.rec, .rec.gz), Lighthouse V2
      crazyflie-config
                    stations of a Crazyflie (YAML): poses and calibrations; the
                    output is a scene (scene.toml) instead of a session
      crazyflie-usd a Crazyflie's log from its micro SD card (log00): sweeps of
                    the Lighthouse deck, IMU, and the Crazyflie's own estimate
      crazyflie-csv log variables of a Crazyflie, of cfclient (one file a block)
                    or of programs with cflib: IMU, the Crazyflie's own estimate,
                    and sampled angles of stations, as far as they are logged
      images        camera frames of a dot sheet: files, folders or patterns, in
                    the order of the file names (frame2 before frame10)
      video         frames of one video file, with its times
      polaris-csv   samples of a bar of magnetometers over magnetic tags, as
                    published with Polaris: one row a sample, a column
                    "Sensor 1" (the rightmost) and so on, with cells "(x, y, z)"
                    in microtesla; the time is the row divided by --rate
      landmark-csv  hall sensors and odometry of a robot over landmarks: one row
                    a sample, with columns t, x, y, heading, front, left, rear,
                    right; units are part of the names (x_mm) or given by --units

    Files that are damaged or not images, and samples that are missing or saturated, are excluded
    and reported. The rest is written, and the exit status is 3. The same applies to a truncated
    recording, and to stations that cannot be distinguished.

    \b
    Examples:
      locatk import dotbot-lh2 data_all.csv -o grid.mcap
      locatk import dotbot-lh2 1_lh2.csv --truth 1_blender.csv -o run.mcap
      locatk import dotbot-lh2 data.csv --truth a.csv --truth b.csv -o run.mcap
      locatk import saleae capture.sal -o light.mcap
      locatk import saleae take1.csv --channel 2 --device wand -o light.mcap
      locatk import libsurvive run.rec.gz --stations -o run.mcap
      locatk import dotbot-log pydotbot.log -o drive.mcap
      locatk import crazyflie-config lighthouse.yaml -o scene.toml
      locatk import crazyflie-usd log00 --config lighthouse.yaml -o flight.mcap
      locatk import crazyflie-csv Log_IMU.csv Log_state.csv -o flight.mcap
      locatk import images frames/ --sheet sheet.toml --rate 46.6 -o run.mcap
      locatk import images '*.png' --sheet a4.toml --camera cam.toml -o run.mcap
      locatk import video run.mp4 --sheet sheet.toml -o run.mcap
      locatk import polaris-csv RawData_1.csv --rate 40 --spacing 20 -o run.mcap
      locatk import landmark-csv run.csv --map map.toml -o run.mcap
      locatk import landmark-csv log.csv -o run.mcap --circle 25 \\
          --columns t=time,x=x,y=y,heading=yaw,front=h1,left=h2,rear=h3,right=h4 \\
          --units ms,m,rad,v --volts-per-tesla 13 --zero-volts median
    """
    chosen = FORMATS[format_name]
    given = {name: value for name, value in format_options.items() if value not in (None, ())}
    for name in given:
        if name not in chosen.options:
            raise click.UsageError(
                f"--{name.replace('_', '-')} means nothing to the format {format_name}."
            )
    if chosen.takes_one_path and len(paths) > 1:
        raise click.UsageError(f"The format {format_name} takes one PATH.")
    if format_name != "images":  # patterns such as run/*.png are not names of files
        options.must_exist(paths)
    input_files = [value for value in given.values() if isinstance(value, Path)]
    options.guard_output(
        output, overwrite=overwrite, inputs=[*paths, *given.get("truth", ()), *input_files]
    )
    options.check_ending(output, (".toml",) if format_name == "crazyflie-config" else (".mcap",))
    results, lost = chosen.run(options.load(chosen.reader), paths, output, given, overwrite)
    warnings = results["warnings"]
    for warning in warnings[:MAX_PRINTED_WARNINGS]:
        console.warn(warning)
    if len(warnings) > MAX_PRINTED_WARNINGS:
        console.warn(f"... and {len(warnings) - MAX_PRINTED_WARNINGS} more")
    if as_json:
        console.emit_json({"version": 1, "output": output, "format": format_name, **results})
    else:
        console.result(f"Wrote {output}")
    if lost is not None:
        raise failures.Incomplete(lost)
