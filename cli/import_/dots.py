"""Import of camera frames of a dot sheet: images and videos."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from locatk.cli import console, options
from locatk.cli.command import combine, section

VIDEO = ("sheet", "camera")
IMAGES = (*VIDEO, "rate")
"""Options of the formats, by the names of their arguments."""

dots_options = combine(
    section(
        "For images and video",
        options.input_option(
            "--sheet", metavar="MANIFEST", help="Manifest of the sheet in the frames (sheet.toml)."
        ),
        options.input_option(
            "--camera", metavar="FILE", help="Camera that took the frames (camera.toml)."
        ),
    ),
    section(
        "For images and polaris-csv",
        click.option(
            "--rate",
            type=click.FloatRange(min=1e-3, max=1e6),
            metavar="HZ",
            help="Frames or samples per second. Required for polaris-csv, whose stamps are not "
            "times (published runs: 40).  [default: 30 for images]",
        ),
    ),
)


def import_images(
    reader: Any, paths: tuple[Path, ...], output: Path, given: dict[str, Any], overwrite: bool
) -> tuple[dict[str, Any], str | None]:
    """Import image files; returns the results for ``--json`` and a summary of the losses."""
    from locatk.formats.importers.images import find_images

    files = find_images(paths)
    options.guard_output(output, overwrite=overwrite, inputs=files)
    rate = {"rate_hz": given["rate"]} if "rate" in given else {}
    return _import_frames(
        lambda camera: reader(files, camera=camera, **rate), output, given, overwrite
    )


def import_video(
    reader: Any, paths: tuple[Path, ...], output: Path, given: dict[str, Any], overwrite: bool
) -> tuple[dict[str, Any], str | None]:
    """Import a video; returns as :func:`import_images`."""
    return _import_frames(lambda camera: reader(paths[0], camera=camera), output, given, overwrite)


def _import_frames(
    open_frames: Any, output: Path, given: dict[str, Any], overwrite: bool
) -> tuple[dict[str, Any], str | None]:
    from locatk.formats.artifacts import sheets
    from locatk.formats.importers.images import DEVICE
    from locatk.formats.sessions import frames

    manifest = sheets.read_manifest(given["sheet"]) if "sheet" in given else None
    camera = sheets.read_camera(given["camera"]) if "camera" in given else None
    source = open_frames(camera)
    with console.progress(source, "Importing") as shots:
        counts = frames.write_shots(
            output,
            {DEVICE: shots},
            manifest=manifest,
            camera=camera,
            facts=source.facts,
            warnings=source.warnings,
            overwrite=overwrite,
        )
    console.say(f"{counts[DEVICE]} frames of {DEVICE}")
    if manifest is None:
        console.say("No --sheet: `locatk solve` will need its manifest as --artifact")
    results = {
        "frames": counts[DEVICE],
        "devices": [DEVICE],
        "left_out": source.left_out,
        "warnings": source.warnings,
    }
    return results, source.lost
