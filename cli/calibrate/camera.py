"""``locatk calibrate camera``: focal length, centre and lens from frames of the pattern."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, failures, options
from locatk.cli.command import Command, section
from locatk.core.errors import InputError, LocatkError

if TYPE_CHECKING:
    from locatk.core.dots.calibration.camera import CameraReport
    from locatk.core.dots.frames import Frames
    from locatk.core.dots.sheet import Manifest
    from locatk.formats.sessions.reader import Session


@click.command(
    "camera", cls=Command, short_help="Fit focal length, centre and distortion of a camera."
)
@options.input_argument("session")
@options.output("Camera to write (.toml).", endings=(".toml",))
@options.overwrite
@section(
    "Input",
    options.artifact,
    click.option("--device", metavar="NAME", help="Camera to use, if the session has several."),
    click.option(
        "--focal-px",
        type=options.POSITIVE,
        metavar="PX",
        help="Known focal length.  [default: estimated from the frames]",
    ),
)
@options.as_json
@options.verbosity
def command(
    session: Path,
    output: Path,
    artifact: Path | None,
    device: str | None,
    focal_px: float | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Fit the camera of SESSION to the dots in its frames.

    Centre and distortion are estimated from any frames of the pattern: at least 5, better
    50, at different positions and headings on the sheet. The focal length requires tilted
    frames, some of them by 5 degrees or more. Poses on the sheet do not depend on it: if it
    cannot be estimated, a typical one is written, and the exit status is 3 unless --focal-px
    was given.

    Use the camera with `locatk solve --camera`, or import later sessions with `locatk import
    --camera`.

    \b
    Examples:
      locatk calibrate camera run.mcap -o camera.toml
      locatk calibrate camera run.mcap -o camera.toml --focal-px 350
      locatk calibrate camera run.mcap -o camera.toml --device left --json
      locatk solve run.mcap -o solved.mcap --camera camera.toml
    """
    from locatk.core.dots.calibration.camera import CalibrateOptions, calibrate
    from locatk.formats.artifacts import sheets
    from locatk.formats.sessions import observations
    from locatk.formats.sessions.reader import Session

    inputs = [session, *([artifact] if artifact else [])]
    options.guard_output(output, overwrite=overwrite, inputs=inputs)
    opened = Session.open(session)
    frames = _frames(opened, device)
    manifest = sheets.read_manifest(artifact) if artifact else _manifest(opened)
    known = CalibrateOptions(focal_px, observations.read_camera(opened))
    with console.working("Calibrating"):
        try:
            report = calibrate(frames, manifest, known)
        except LocatkError as error:
            if error.file is None:  # Solvers work on arrays and do not know the file.
                error.file = str(session)
            raise
    sheets.write_camera(output, report.camera, overwrite=overwrite)
    console.result(_text(session, output, report))
    for note in report.notes:
        console.say(f"{session.name}: {note}")
    if as_json:
        console.emit_json(_entry(session, output, frames.device, report))
    if report.focal_from == "usual":
        raise failures.Incomplete(
            "the focal length cannot be estimated: give it with --focal-px, or add frames that are "
            "tilted by 5 degrees or more"
        )


def _frames(session: Session, device: str | None) -> Frames:
    from locatk.formats.sessions import observations

    found = {frames.device: frames for frames in observations.read_frames(session)}
    if device is None and len(found) > 1:
        raise InputError(
            f"several cameras: {', '.join(found)}",
            file=session.path,
            hint="Name one of them with --device",
        )
    if device is not None and device not in found:
        raise InputError(
            f"no camera {device!r}", file=session.path, hint=f"It has {', '.join(found)}"
        )
    return found[device or next(iter(found))]


def _manifest(session: Session) -> Manifest:
    from locatk.formats.sessions import observations

    manifest = observations.read_manifest(session)
    if manifest is None:
        raise InputError(
            "the session has no manifest of the sheet",
            file=session.path,
            hint="Import the frames with --sheet, or give the manifest as --artifact",
        )
    return manifest


FOCAL_SOURCES = {"given": "--focal-px", "camera": "the session's camera", "usual": "typical value"}
"""Origin of a focal length that was not estimated from the frames."""


def _text(session: Path, output: Path, report: CameraReport) -> str:
    """Format the camera as a table, and the residuals of the dots."""
    found = report.camera
    rows = [("focal length", f"{found.focal_px:.2f} px", _known(report.sigma_focal_px),
             FOCAL_SOURCES.get(report.focal_from, report.focal_from))]  # fmt: skip
    for axis, at, sigma in zip("xy", found.centre_px, report.sigma_centre_px, strict=True):
        rows.append((f"centre {axis}", f"{at:.3f} px", _known(sigma), report.centre_from))
    rows.append(("radial", f"{found.radial:.5f}", _known(report.sigma_radial), "frames"))
    lines = [
        f"{session} -> {output}: {report.used} of {report.seen} frames, {report.dots} dots",
        console.table(("camera", "value", "sigma", "source"), rows),
        f"residual of the dots: {report.rms_before_px:.3g} px (rms) without distortion, "
        f"{report.rms_px:.3g} px with it",
        f"distortion of the corners: {100 * report.distortion:.2g} %",
    ]
    if math.isfinite(report.largest_tilt_rad):
        lines.append(f"largest tilt: {math.degrees(report.largest_tilt_rad):.1f} deg")
    skipped = ", ".join(f"{n} {reason.replace('_', ' ')}" for reason, n in report.skipped.items())
    lines.append(f"skipped: {skipped or 'nothing'}")
    return "\n".join(lines)


def _known(sigma: float) -> str:
    return f"{sigma:.2g}" if math.isfinite(sigma) else "-"


def _entry(session: Path, output: Path, device: str, report: CameraReport) -> dict[str, Any]:
    """Return the object of ``--json`` (docs/formats.md)."""
    found = report.camera
    return {
        "version": 1,
        "session": session,
        "output": output,
        "device": device,
        "frames": {
            "seen": report.seen,
            "located": report.located,
            "used": report.used,
            "skipped": report.skipped,
        },
        "dots": report.dots,
        "camera": {
            "size_px": found.size,
            "focal_px": found.focal_px,
            "centre_px": found.centre_px,
            "radial": found.radial,
            "radial_per_px2": found.radial_px,
        },
        "sigma": {
            "focal_px": report.sigma_focal_px,
            "centre_px": report.sigma_centre_px,
            "radial": report.sigma_radial,
            "radial_per_px2": report.sigma_radial_px,
        },
        "focal_from": report.focal_from,
        "centre_from": report.centre_from,
        "rms_before_px": report.rms_before_px,
        "rms_px": report.rms_px,
        "largest_tilt_rad": report.largest_tilt_rad,
        "sheet_aspect": report.aspect,
        "sigma_sheet_aspect": report.sigma_aspect,
        "notes": report.notes,
    }
