"""``locatk import``: recordings of other tools as sessions, a command for each format."""

from __future__ import annotations

import difflib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from locatk.cli import console, failures, options
from locatk.cli.command import SECTIONS, Command, Group, combine
from locatk.cli.import_ import dots, landmarks, lighthouse, polaris, table

MAX_PRINTED_WARNINGS = 10
"""Most warnings on stderr; ``--json`` and the log of a camera session contain all of them."""

Results = tuple[dict[str, Any], str | None]
"""Results for ``--json``, and a summary of the losses, if any."""


@dataclass(frozen=True)
class Format:
    """Foreign format.

    Attributes
    ----------
    system : str
        Heading under which the help lists it.
    summary : str
        One line for the list of formats.
    reader : str
        Module and name of the function that reads it.
    run : callable
        Imports with that reader: ``run(reader, paths, output, given, overwrite)``, in which
        ``given`` are the options that were given, by the names of their arguments.
    description : str
        Content of the files, for the help of the command.
    examples : tuple of str
        Arguments after ``locatk import``; long ones continue on a second line.
    options : tuple of str
        Options that the format has.
    required : tuple of str
        Those of them that it needs.
    takes_one_path : bool
    """

    system: str
    summary: str
    reader: str
    run: Callable[[Any, tuple[Path, ...], Path, dict[str, Any], bool], Results]
    description: str
    examples: tuple[str, ...]
    options: tuple[str, ...] = ()
    required: tuple[str, ...] = ()
    takes_one_path: bool = False


IMPORTERS = "locatk.formats.importers."

LIGHTHOUSE, DOTS = "Lighthouse base stations", "Micro-dot sheets"
POLARIS, LANDMARKS = "Magnetic tags (polaris)", "Landmarks"
TABLES = "Base stations, magnetic tags or landmarks"

SCENE_FORMAT = "crazyflie-config"
"""Format whose output is a scene instead of a session."""

FORMATS = {
    "dotbot-lh2": Format(
        LIGHTHOUSE,
        "LFSR counts of Lighthouse V2 as published by DotBots (CSV).",
        IMPORTERS + "dotbot.recording:read_dotbot",
        lighthouse.import_sweeps,
        "LFSR counts of Lighthouse V2 as published by DotBots (CSV). Several files are one "
        "session.",
        (
            "dotbot-lh2 data_all.csv -o grid.mcap",
            "dotbot-lh2 1_lh2.csv --truth 1_blender.csv -o run.mcap",
            "dotbot-lh2 data.csv --truth a.csv --truth b.csv -o run.mcap",
        ),
        lighthouse.DOTBOT,
    ),
    "dotbot-log": Format(
        LIGHTHOUSE,
        "LFSR counts and raw bits from logs of a DotBot gateway.",
        IMPORTERS + "dotbot.log:read_dotbot_log",
        lighthouse.import_sweeps,
        "LFSR counts of Lighthouse V2, and raw bits, from logs of a DotBot gateway.",
        ("dotbot-log pydotbot.log -o drive.mcap",),
    ),
    "saleae": Format(
        LIGHTHOUSE,
        "Infrared light on a logic analyser (.sal, .csv, .bin).",
        IMPORTERS + "saleae.recording:read_saleae",
        lighthouse.import_sweeps,
        "Infrared light: data lines of photodiodes on a logic analyser, as a capture of Logic 2 "
        "(.sal) or exported edges (.csv, .bin). Decodes sweeps, rotor periods and calibrations.",
        (
            "saleae capture.sal -o light.mcap",
            "saleae take1.csv --channel 2 --device wand -o light.mcap",
        ),
        lighthouse.SALEAE,
        takes_one_path=True,
    ),
    "libsurvive": Format(
        LIGHTHOUSE,
        "Recordings of libsurvive (.rec, .rec.gz), Lighthouse V2.",
        IMPORTERS + "libsurvive.recording:read_libsurvive",
        lighthouse.import_sweeps,
        "Recordings of libsurvive (.rec, .rec.gz), Lighthouse V2.",
        ("libsurvive run.rec.gz --stations -o run.mcap",),
        lighthouse.LIBSURVIVE,
    ),
    "crazyflie-usd": Format(
        LIGHTHOUSE,
        "A Crazyflie's log from its micro SD card (log00).",
        IMPORTERS + "crazyflie_usd.recording:read_crazyflie_usd",
        lighthouse.import_sweeps,
        "A Crazyflie's log from its micro SD card (log00): sweeps of the Lighthouse deck, IMU, and "
        "the Crazyflie's own estimate.",
        ("crazyflie-usd log00 --config lighthouse.yaml -o flight.mcap",),
        lighthouse.CRAZYFLIE_USD,
        takes_one_path=True,
    ),
    "crazyflie-csv": Format(
        LIGHTHOUSE,
        "Log variables of a Crazyflie, of cfclient or cflib (CSV).",
        IMPORTERS + "crazyflie_csv:read_crazyflie_csv",
        lighthouse.import_sweeps,
        "Log variables of a Crazyflie, of cfclient (one file a block) or of programs with cflib: "
        "IMU, the Crazyflie's own estimate, and sampled angles of stations, as far as they are "
        "logged.",
        ("crazyflie-csv Log_IMU.csv Log_state.csv -o flight.mcap",),
        lighthouse.CRAZYFLIE,
    ),
    SCENE_FORMAT: Format(
        LIGHTHOUSE,
        "Stations of a Crazyflie (YAML), as a scene.",
        IMPORTERS + "crazyflie:read_config",
        lighthouse.import_scene,
        "Stations of a Crazyflie (YAML): poses and calibrations. The output is a scene "
        "(scene.toml) instead of a session. Needs locatk[yaml].",
        ("crazyflie-config lighthouse.yaml -o scene.toml",),
        takes_one_path=True,
    ),
    "images": Format(
        DOTS,
        "Camera frames of a dot sheet: files, folders or patterns.",
        IMPORTERS + "images:ImageFiles",
        dots.import_images,
        "Camera frames of a dot sheet: files, folders or patterns, in the order of the file names "
        "(frame2 before frame10).",
        (
            "images frames/ --sheet sheet.toml --rate 46.6 -o run.mcap",
            "images '*.png' --sheet a4.toml --camera cam.toml -o run.mcap",
        ),
        dots.IMAGES,
    ),
    "video": Format(
        DOTS,
        "Frames of one video file, with its times.",
        IMPORTERS + "video:Video",
        dots.import_video,
        "Frames of one video file of a dot sheet, with its times.",
        ("video run.mp4 --sheet sheet.toml -o run.mcap",),
        dots.VIDEO,
        takes_one_path=True,
    ),
    "polaris-csv": Format(
        POLARIS,
        "Samples of a bar of magnetometers, as published (CSV).",
        IMPORTERS + "polaris_csv:read_polaris",
        polaris.import_samples,
        "Samples of a bar of magnetometers over magnetic tags, as published with Polaris: one row "
        'a sample, a column "Sensor 1" (the rightmost) and so on, with cells "(x, y, z)" in '
        "microtesla. The time is the row divided by --rate.",
        ("polaris-csv RawData_1.csv --rate 40 --spacing 20 -o run.mcap",),
        polaris.OPTIONS,
        polaris.REQUIRED,
        takes_one_path=True,
    ),
    "landmark-csv": Format(
        LANDMARKS,
        "Hall sensors and odometry of a robot (CSV).",
        IMPORTERS + "landmark_csv:read_landmarks",
        landmarks.import_samples,
        "Hall sensors and odometry of a robot over landmarks: one row a sample, with columns t, x, "
        "y, heading, front, left, rear, right. Units are part of the names (x_mm) or given by "
        "--units.",
        (
            "landmark-csv run.csv --map map.toml -o run.mcap",
            "landmark-csv log.csv -o run.mcap --circle 25 \\\n"
            "          --columns t=time,x=x,y=y,heading=yaw,front=h1,left=h2,rear=h3,right=h4 \\\n"
            "          --units ms,m,rad,v --volts-per-tesla 13 --zero-volts median",
        ),
        landmarks.OPTIONS,
        takes_one_path=True,
    ),
    "table": Format(
        TABLES,
        "Sweeps, magnetometers, hall sensors, odometry, IMUs in any table.",
        "locatk.formats.tables.dialects:read_any_table",
        table.import_table,
        "Sweeps of base stations, magnetometers or hall sensors, with an IMU and odometry, in any "
        "table: CSV with commas, semicolons or tabs, or Parquet. Columns are recognised by usual "
        "names, as in lfsr_count, mag0_x [uT], Bx1 (mT), hall_front_mt, odom_x_m, accel_x (g); "
        "--columns names others by keys: t, date, device; channel (from 1), station (from 0), "
        "sensor, sweep, count, offset, alpha, angle, or count0_ch4_s2; b0x, b0y, b0z, b1x, ...; "
        "front, left, rear, right; x, y, heading; ax, ay, az, gx, gy, gz. What was recognised is "
        "printed in the form of a file for --mapping. Units are part of the names or given by "
        "--units; times since 1970 and in ISO 8601 need none.",
        (
            "table sweeps.csv --units us,24mhz --receiver deck -o run.mcap",
            "table log.csv --spacing 20 --tag tag.toml -o run.mcap",
            "table log.tsv --columns b0x=u,b0y=v,b0z=w --units ut -o a.mcap",
            'table log.csv --mapping lab.toml --clock "ms, 24 bit" \\\n          -o b.mcap',
            "table robot.parquet --map map.toml -o run.mcap",
        ),
        table.OPTIONS,
        takes_one_path=True,
    ),
}

LOSSES = """
    Files that are damaged or not images, and samples that are missing or saturated, are excluded
    and reported. The rest is written, and the exit status is 3. The same applies to a truncated
    recording, and to stations that cannot be distinguished.
"""


def _parameters(decorator: Callable[[Any], Any]) -> dict[str, click.Parameter]:
    """Return the parameters that a decorator adds, by name and in the order of the help."""

    def function() -> None: ...

    decorated = decorator(function)
    return {parameter.name: parameter for parameter in reversed(decorated.__click_params__)}


FORMAT_OPTIONS = _parameters(
    combine(
        lighthouse.lighthouse_options,
        dots.dots_options,
        polaris.polaris_options,
        landmarks.landmark_options,
        table.table_options,
    )
)
"""Options of all formats, by the names of their arguments."""


class FormatCommand(Command):
    """Command of one format; an option of another format is named as such."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments.

        Raises
        ------
        click.UsageError
            An option belongs to another format.
        """
        try:
            return super().parse_args(ctx, args)
        except click.NoSuchOption as error:
            if any(error.option_name in each.opts for each in FORMAT_OPTIONS.values()):
                raise click.UsageError(
                    f"{error.option_name} means nothing to the format {self.name}.", ctx
                ) from None
            raise


def _format_command(name: str, chosen: Format) -> FormatCommand:
    """Return the command that imports one format."""
    is_scene = name == SCENE_FORMAT
    decorators = combine(
        click.argument(
            "paths",
            metavar="PATH" + "..." * (not chosen.takes_one_path),
            type=options.PATH,
            nargs=-1,
            required=True,
        ),
        options.output("Scene to write (.toml)." if is_scene else "Session to write (.mcap)."),
    )
    general = combine(options.overwrite, options.as_json, options.verbosity)
    own = [FORMAT_OPTIONS[key] for key in FORMAT_OPTIONS if key in chosen.options]

    def run(
        paths: tuple[Path, ...], output: Path, overwrite: bool, as_json: bool, **given: Any
    ) -> None:
        _import(name, chosen, paths, output, given, overwrite=overwrite, as_json=as_json)

    setattr(run, SECTIONS, dict.fromkeys((option.name for option in own), "Recording"))
    examples = "".join(f"\n      locatk import {example}" for example in chosen.examples)
    return FormatCommand(
        name,
        callback=run,
        params=[*_parameters(decorators).values(), *own, *_parameters(general).values()],
        help=f"{chosen.description}\n{LOSSES}\n    \b\n    Examples:{examples}",
        short_help=chosen.summary,
    )


def _find_format(args: list[str]) -> int | None:
    """Return the index of the format among arguments; None without one.

    The value of an option, as in ``-o table``, is not the format.
    """
    options_with_value = {"-o", "--output"}
    for option in FORMAT_OPTIONS.values():
        if isinstance(option, click.Option) and not option.is_flag:
            options_with_value.update(option.opts)
    is_value = False
    for index, word in enumerate(args):
        if word in FORMATS and not is_value:
            return index
        is_value = word in options_with_value
    return None


class ImportGroup(Group):
    """Group of the formats, listed by system."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of the formats, in the order of the table."""
        return list(FORMATS)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        """Return the command of a format; None if there is no such format."""
        return _format_command(name, FORMATS[name]) if name in FORMATS else None

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments; options may precede the format."""
        if args and args[0].startswith("-"):
            index = _find_format(args)
            if index is not None:
                args = [args[index], *args[:index], *args[index + 1 :]]
        return super().parse_args(ctx, args)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Return name, command and remaining arguments, as in click.

        Raises
        ------
        click.UsageError
            There is no such format. A file in its place is not taken for a misspelled format.
        """
        name = args[0]
        if name not in FORMATS and not name.startswith("-") and not ctx.resilient_parsing:
            known = ", ".join(FORMATS)
            if Path(name).exists():
                raise click.UsageError(
                    f"{name!r} is a file or folder, not a format: name its format first, one of "
                    f"{known}.",
                    ctx,
                )
            similar = difflib.get_close_matches(name, FORMATS, n=1)
            hint = f"Did you mean {similar[0]!r}?" if similar else ""
            raise click.UsageError(
                f"No such format {name!r}. {hint or f'Formats are {known}.'}", ctx
            )
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the formats by system."""
        for system in dict.fromkeys(each.system for each in FORMATS.values()):
            with formatter.section(system):
                formatter.write_dl(
                    [
                        (name, each.summary)
                        for name, each in FORMATS.items()
                        if each.system == system
                    ]
                )


@click.group("import", cls=ImportGroup, short_help="Import recordings of other tools as a session.")
def command() -> None:
    """Import files that another tool recorded, as one session.

    Each format is a command with its own options: see `locatk import FORMAT --help`.

    \b
    Examples:
      locatk import saleae capture.sal -o light.mcap
      locatk import libsurvive run.rec.gz --stations -o run.mcap
      locatk import crazyflie-csv Log_IMU.csv Log_state.csv -o flight.mcap
      locatk import images frames/ --sheet sheet.toml --rate 46.6 -o run.mcap
      locatk import polaris-csv RawData_1.csv --rate 40 --spacing 20 -o run.mcap
      locatk import landmark-csv run.csv --map map.toml -o run.mcap
      locatk import table log.csv --mapping lab.toml -o run.mcap
    """


def _import(
    format_name: str,
    chosen: Format,
    paths: tuple[Path, ...],
    output: Path,
    format_options: dict[str, Any],
    *,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Import paths of a format, and print the results."""
    given = {name: value for name, value in format_options.items() if value not in (None, ())}
    if chosen.takes_one_path and len(paths) > 1:
        raise click.UsageError(f"The format {format_name} takes one PATH.")
    for name in chosen.required:
        if name not in given:
            raise click.UsageError(f"The format {format_name} needs --{name}.")
    if format_name != "images":  # patterns such as run/*.png are not names of files
        options.must_exist(paths)
    input_files = [value for value in given.values() if isinstance(value, Path)]
    options.guard_output(
        output, overwrite=overwrite, inputs=[*paths, *given.get("truth", ()), *input_files]
    )
    options.check_ending(output, (".toml",) if format_name == SCENE_FORMAT else (".mcap",))
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
