"""``locatk import``: recordings of other tools become sessions."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from locatk.cli import console, failures, options
from locatk.cli.import_ import lighthouse
from locatk.cli.import_.landmarks import OPTIONS, import_samples, landmark_options

MOST_WARNINGS = 10
"""So many are said on stderr; ``--json`` and the log of a camera session hold them all."""


@dataclass(frozen=True)
class Format:
    """A foreign format: who reads it, and the options that mean something to it."""

    reader: str
    system: str
    options: tuple[str, ...]


FORMATS = {
    "dotbot-lh2": Format(
        "locatk.formats.importers.dotbot.recording:read_dotbot", "lighthouse", lighthouse.DOTBOT
    ),
    "saleae": Format(
        "locatk.formats.importers.saleae.recording:read_saleae", "lighthouse", lighthouse.SALEAE
    ),
    "libsurvive": Format(
        "locatk.formats.importers.libsurvive.recording:read_libsurvive",
        "lighthouse",
        lighthouse.LIBSURVIVE,
    ),
    "dotbot-log": Format("locatk.formats.importers.dotbot.log:read_dotbot_log", "lighthouse", ()),
    "crazyflie-config": Format("locatk.formats.exporters.crazyflie:read_config", "scene", ()),
    "images": Format(
        "locatk.formats.importers.images:ImageFiles", "dots", ("sheet", "camera", "rate")
    ),
    "video": Format("locatk.formats.importers.video:Video", "dots", ("sheet", "camera")),
    "polaris-csv": Format(
        "locatk.formats.importers.polaris_csv:read_polaris", "polaris", ("rate", "spacing", "tag")
    ),
    "landmark-csv": Format(
        "locatk.formats.importers.landmark_csv:read_landmarks", "landmarks", OPTIONS
    ),
}
"""Name of a foreign format to what is known of it."""

ONE_PATH = ("saleae", "crazyflie-config", "video", "polaris-csv", "landmark-csv")


@click.command("import", short_help="Turn recordings of other tools into a session.")
@click.argument("format_name", metavar="FORMAT", type=click.Choice(list(FORMATS)))
@click.argument("paths", type=options.PATH, nargs=-1, required=True)
@options.output("Session to write (.mcap); of crazyflie-config the scene (.toml).")
@lighthouse.lighthouse_options
@options.input_option(
    "--sheet",
    metavar="MANIFEST",
    help="images, video: manifest of the sheet in the frames (sheet.toml).",
)
@options.input_option(
    "--camera", metavar="FILE", help="images, video: the camera that took them (camera.toml)."
)
@click.option(
    "--rate",
    type=click.FloatRange(min=1e-3, max=1e6),
    metavar="HZ",
    help="images: frames a second. [default: 30]  polaris-csv: samples a second, which its "
    "stamps do not tell; required (published runs: 40).",
)
@click.option(
    "--spacing",
    type=click.FloatRange(min=0, min_open=True, max=1000),
    metavar="MM",
    help="polaris-csv: between neighbouring sensors; required (published runs: 20).",
)
@options.input_option(
    "--tag",
    metavar="FILE",
    help="polaris-csv: the tags that were passed (tag.toml). [default: the published design]",
)
@landmark_options
@options.overwrite
@options.as_json
@options.verbosity
def command(
    format_name: str,
    paths: tuple[Path, ...],
    output: Path,
    sheet: Path | None,
    camera: Path | None,
    rate: float | None,
    spacing: float | None,
    tag: Path | None,
    overwrite: bool,
    as_json: bool,
    **more: Any,
) -> None:
    """Read PATHS, recorded by another tool in FORMAT, into one session.

    \b
    FORMAT is one of
      dotbot-lh2    LFSR counts of Lighthouse V2 as published by DotBots (CSV)
      dotbot-log    the same, and raw bits, from log lines of a DotBot gateway
      saleae        the infrared light itself: data lines of photodiodes on a logic
                    analyser, as a capture of Logic 2 (.sal) or exported edges
                    (.csv, .bin); finds sweeps, rotor periods and calibrations
      libsurvive    recordings of libsurvive (.rec, .rec.gz), Lighthouse V2
      crazyflie-config
                    stations of a Crazyflie (YAML): poses and calibrations; the
                    output is no session but a scene (scene.toml)
      images        camera frames of a dot sheet: files, folders or patterns, in
                    the order of the file names (frame2 before frame10)
      video         the same from one video file, whose times are kept
      polaris-csv   samples of a bar of magnetometers over magnetic tags, as
                    published with Polaris: one row a sample, a column
                    "Sensor 1" (the rightmost) and so on, with cells "(x, y, z)"
                    in microtesla; row over --rate is the time
      landmark-csv  hall sensors and odometry of a robot over landmarks: one row
                    a sample, with columns t, x, y, heading, front, left, rear,
                    right; units are in their names (x_mm) or said with --units

    Files that are no image or are damaged, and samples that are no number or saturated, are
    left out and named; the exit status is 3 then, and the rest is written all the same. So it
    is with the end of a recording that is cut off, and with stations that cannot be told apart.

    \b
    Examples:
      locatk import dotbot-lh2 data_all.csv -o grid.mcap
      locatk import dotbot-lh2 1_lh2.csv --truth 1_blender.csv -o run.mcap
      locatk import dotbot-lh2 data.csv --truth 1_blender.csv --truth 2_blender.csv -o two.mcap
      locatk import saleae capture.sal -o light.mcap
      locatk import saleae take1.csv --channel 2 --device wand -o light.mcap
      locatk import libsurvive run.rec.gz --stations -o run.mcap
      locatk import dotbot-log pydotbot.log -o drive.mcap
      locatk import crazyflie-config lighthouse.yaml -o scene.toml
      locatk import images frames/ --sheet sheet.toml --rate 46.6 -o run.mcap
      locatk import images 'run/*.png' --sheet sheet.toml --camera camera.toml -o run.mcap
      locatk import video run.mp4 --sheet sheet.toml -o run.mcap
      locatk import polaris-csv RawData_1.csv --rate 40 --spacing 20 -o run.mcap
      locatk import landmark-csv drive.csv --units s,mm,deg,mt --map map.toml -o drive.mcap
      locatk import landmark-csv log.csv -o drive.mcap --circle 25 --units ms,m,rad,v \\
          --columns t=time,x=odom_x,y=odom_y,heading=yaw,front=h1,left=h2,rear=h3,right=h4 \\
          --volts-per-tesla 13 --zero-volts median
    """
    chosen = FORMATS[format_name]
    given = {
        "sheet": sheet,
        "camera": camera,
        "rate": rate,
        "spacing": spacing,
        "tag": tag,
        **more,
    }
    given = {name: value for name, value in given.items() if value not in (None, ())}
    for name in given:
        if name not in chosen.options:
            raise click.UsageError(
                f"--{name.replace('_', '-')} means nothing to the format {format_name}."
            )
    if format_name in ONE_PATH and len(paths) > 1:
        raise click.UsageError(f"The format {format_name} takes one PATH.")
    if format_name != "images":  # whose patterns are not there by that name
        options.must_exist(paths)
    named = [value for value in given.values() if isinstance(value, Path)]
    aside = [*given.get("truth", ()), *named]
    options.guard_output(output, overwrite=overwrite, inputs=[*paths, *aside])
    read = options.load(chosen.reader)
    if chosen.system == "dots":
        answer, lost = _frames(format_name, read, paths, output, sheet, camera, rate, overwrite)
    elif chosen.system == "polaris":
        answer, lost = _samples(read, paths[0], output, rate, spacing, tag, overwrite)
    elif chosen.system == "landmarks":
        answer, lost = import_samples(read, paths[0], output, more, overwrite)
    elif chosen.system == "scene":
        answer, lost = lighthouse.import_scene(read, paths[0], output, overwrite)
    else:
        answer, lost = lighthouse.import_sweeps(read, paths, output, given, overwrite)
    for warning in answer["warnings"][:MOST_WARNINGS]:
        console.warn(warning)
    if len(answer["warnings"]) > MOST_WARNINGS:
        console.warn(f"... and {len(answer['warnings']) - MOST_WARNINGS} more")
    if as_json:
        console.emit_json({"version": 1, "output": output, "format": format_name, **answer})
    else:
        console.result(f"Wrote {output}")
    if lost is not None:
        raise failures.Incomplete(lost)


def _frames(
    format_name: str,
    read: Any,
    paths: tuple[Path, ...],
    output: Path,
    sheet: Path | None,
    camera: Path | None,
    rate: float | None,
    overwrite: bool,
) -> tuple[dict[str, Any], str | None]:
    """Import camera frames; returns what ``--json`` says of them, and what was lost."""
    from locatk.formats.artifacts import sheets
    from locatk.formats.importers.images import DEVICE, find_images
    from locatk.formats.sessions import frames

    manifest = None if sheet is None else sheets.read_manifest(sheet)
    lens = None if camera is None else sheets.read_camera(camera)
    more = {} if rate is None else {"rate_hz": rate}
    if format_name == "images":
        found = find_images(paths)
        options.guard_output(output, overwrite=overwrite, inputs=found)
        source = read(found, camera=lens, **more)
    else:
        source = read(paths[0], camera=lens)
    with console.progress(source, "Importing") as bar:
        counts = frames.write_shots(
            output,
            {DEVICE: bar},
            manifest=manifest,
            camera=lens,
            facts=source.facts,
            warnings=source.warnings,
            overwrite=overwrite,
        )
    count = counts[DEVICE]
    console.say(f"{count} frames of {DEVICE}")
    if manifest is None:
        console.say("No --sheet: `locatk solve` will need its manifest as --artifact")
    answer = {
        "frames": count,
        "devices": [DEVICE],
        "left_out": source.left_out,
        "warnings": source.warnings,
    }
    return answer, source.lost


def _samples(
    read: Any,
    path: Path,
    output: Path,
    rate: float | None,
    spacing: float | None,
    tag: Path | None,
    overwrite: bool,
) -> tuple[dict[str, Any], str | None]:
    """Import samples of an array; returns what ``--json`` says of them, and what was lost."""
    from locatk.formats.artifacts import tags
    from locatk.formats.importers.polaris_csv import PUBLISHED_TAGS
    from locatk.formats.sessions import magnetometers as arrays

    if rate is None or spacing is None:
        name = "--rate" if rate is None else "--spacing"
        raise click.UsageError(f"The format polaris-csv needs {name}.")
    known = PUBLISHED_TAGS if tag is None else tags.read_tags(tag)
    with console.working("Reading"):
        imported = read(path, rate_hz=rate, spacing_m=spacing / 1000)
        arrays.write_session(
            output,
            [imported.samples],
            tags=known,
            facts=imported.facts,
            warnings=imported.warnings,
            overwrite=overwrite,
        )
    samples = imported.samples
    console.say(f"{len(samples)} samples of {len(samples.array)} sensors")
    if tag is None:
        console.say("No --tag: the session holds the design of the published tags")
    answer = {
        "samples": len(samples),
        "sensors": len(samples.array),
        "devices": [samples.device],
        "left_out": imported.left_out,
        "warnings": imported.warnings,
    }
    return answer, imported.lost
