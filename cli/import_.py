"""``locatk import``: recordings of other tools become sessions."""

from __future__ import annotations

from pathlib import Path

import click

from locatk.cli import console, options

FORMATS = {
    "dotbot-lh2": "locatk.formats.importers.dotbot:read_dotbot",
}
"""Name of a foreign format to the function that reads it."""


@click.command("import", short_help="Turn recordings of other tools into a session.")
@click.argument("format_name", metavar="FORMAT", type=click.Choice(list(FORMATS)))
@options.input_argument("paths", many=True)
@options.output("Session to write (.mcap).")
@options.input_option(
    "--truth",
    many=True,
    metavar="PATH",
    help="Reference to store beside the data: pixel tracks from Blender. Repeatable. Grid "
    "columns in the data itself are taken unasked.",
)
@options.input_option(
    "--calibration",
    metavar="PATH",
    help="Camera or marker calibration (calibration.json), where it is not beside the truth.",
)
@options.overwrite
@options.as_json
@options.verbosity
def command(
    format_name: str,
    paths: tuple[Path, ...],
    output: Path,
    truth: tuple[Path, ...],
    calibration: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Read PATHS, recorded by another tool in FORMAT, into one session.

    FORMAT is `dotbot-lh2`: LFSR counts of Lighthouse V2 as published by DotBots (CSV).

    \b
    Examples:
      locatk import dotbot-lh2 data_all.csv -o grid.mcap
      locatk import dotbot-lh2 1_lh2.csv --truth 1_blender.csv -o run.mcap
      locatk import dotbot-lh2 data.csv --truth 1_blender.csv --truth 2_blender.csv -o two.mcap
    """
    from locatk.formats import observations

    options.guard_output(output, overwrite=overwrite, inputs=[*paths, *truth])
    read = options.load(FORMATS[format_name])
    with console.working("Reading"):
        # A recording named as its own reference means its own columns, which are read anyway.
        references = [path for path in truth if not any(path.samefile(other) for other in paths)]
        imported = read(list(paths), references, calibration=calibration)
        observations.write_session(
            output,
            system="lighthouse",
            sweeps=imported.sweeps,
            scene=imported.scene,
            truth=imported.truth,
            facts=imported.facts,
            overwrite=overwrite,
        )
    for warning in imported.warnings:
        console.warn(warning)

    sweeps = imported.sweeps
    truth_poses = sum(len(trajectory) for trajectory in imported.truth)
    if as_json:
        console.emit_json(
            {
                "version": 1,
                "output": output,
                "format": format_name,
                "sweeps": len(sweeps),
                "devices": list(sweeps.devices),
                "truth_poses": truth_poses,
                "warnings": imported.warnings,
            }
        )
    else:
        devices = ", ".join(sweeps.devices)
        console.say(
            f"{len(sweeps)} sweeps of {len(sweeps.devices)} device(s) ({devices}), "
            f"{truth_poses} truth poses"
        )
        console.result(f"Wrote {output}")
