"""``locatk calibrate sheet``: sheets of a floor as built, and the errors of their print."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, failures, options
from locatk.cli.calibrate import recordings
from locatk.cli.command import Command, section
from locatk.core.errors import InputError, LocatkError

if TYPE_CHECKING:
    import numpy as np

    from locatk.core.dots.calibration.floor import FloorRecording, FloorReport
    from locatk.core.dots.calibration.floor_frame import BuiltSheet
    from locatk.core.dots.camera import Camera
    from locatk.core.dots.frames import Frames
    from locatk.core.dots.sheet import Manifest
    from locatk.core.trajectory import Trajectory

MAX_SHEETS = 60
"""Number of sheets listed as text; --json lists all."""


@click.command("sheet", cls=Command, short_help="Fit tiles and sheets of a floor as built.")
@options.sessions
@options.output("Manifest to write (.toml), with the sheets as built.", endings=(".toml",))
@options.overwrite
@section(
    "Input",
    options.input_option(
        "--artifact",
        "--manifest",
        "artifact",
        help="Manifest of the sheets (.toml) to use instead of the first session's.",
    ),
    options.input_option(
        "--camera",
        help="Camera (.toml) of all sessions.  [default: that of each session, or estimated from "
        "its frames]",
    ),
    options.input_option(
        "--truth",
        many=True,
        help="Poses of the camera from another system: a session with truth, or a TUM or CSV file. "
        "Give one file for all sessions, or one for each in the same order, each in a frame of its "
        "own.",
    ),
    click.option(
        "--offset",
        type=float,
        default=0.0,
        show_default=True,
        metavar="SECONDS",
        help="Time to add to the stamps of the frames to get those of the truth.",
    ),
)
@options.as_json
@options.verbosity
def command(
    sessions: tuple[Path, ...],
    output: Path,
    artifact: Path | None,
    camera: Path | None,
    truth: tuple[Path, ...],
    offset: float,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Fit position and heading of the sheets of a floor from frames that cross their seams.

    The floor consists of tiles (`locatk print pattern --tiles`), or of sheets that were glued
    next to each other (`--count`), whose positions need not be known. Move the camera slowly
    across each seam, at 5 places or more that are far from each other. `locatk solve
    --artifact` then uses the sheets as built: all poses are in one frame, that of the first
    sheet (of tiles, the one at the origin), and their covariance contains that of the sheets.

    Frames alone determine neither the scale of the print nor its errors inside of a sheet.
    With --truth (motion capture, a stage), both are estimated, as a smooth map for each
    sheet, if the poses support it. The truth may be in any frame with z up, and of any point
    of the body that carries the camera.

    The exit status is 3 if a sheet has no position, if frames were rejected because they
    contradict the others, or if a session was not used.

    \b
    Examples:
      locatk calibrate sheet run.mcap -o floor-built.toml
      locatk calibrate sheet day/*.mcap --artifact floor.toml -o floor-built.toml
      locatk calibrate sheet run.mcap --truth mocap.tum -o floor-built.toml --json
      locatk solve later.mcap -o solved.mcap --artifact floor-built.toml
    """
    from locatk.formats.artifacts import sheets

    inputs = [*sessions, *(path for path in (artifact, camera) if path), *truth]
    options.guard_output(output, overwrite=overwrite, inputs=inputs)
    if len(truth) > 1 and len(truth) != len(sessions):
        raise click.BadParameter(
            f"{len(truth)} files for {len(sessions)} sessions.", param_hint="--truth"
        )
    manifest = sheets.read_manifest(artifact) if artifact else _attached(sessions[0])
    common_camera = sheets.read_camera(camera) if camera else None
    floor_recordings, left_out = _read_recordings(
        sessions,
        manifest,
        common_camera,
        truth,
        offset,
        must_have_manifest=artifact is None,
    )
    report = _calibrate(sessions[0], manifest, floor_recordings)
    sheets.write_manifest(output, report.manifest, overwrite=overwrite)
    recordings.print_result(_text(output, report), report.notes, left_out)
    if as_json:
        console.emit_json(_entry(sessions, output, report, left_out))
    recordings.check_all_used(left_out, "recording was", "recordings were")
    _check_complete(report)


def _calibrate(
    path: Path, manifest: Manifest, floor_recordings: list[FloorRecording]
) -> FloorReport:
    """Calibrate with a progress bar; ``path`` is the file that errors name."""
    from locatk.core.dots.calibration.floor import calibrate_floor

    if not floor_recordings:
        raise InputError("no session can be used", hint="The messages above name the reasons")
    # Each frame is localized, and examined for seams.
    steps = 2 * sum(len(each.frames) for each in floor_recordings)
    with console.steps(steps, "Calibrating") as advance:
        try:
            return calibrate_floor(floor_recordings, manifest, advance)
        except LocatkError as error:
            # Solvers work on arrays and do not know the file.
            error.file = error.file or str(path)
            raise


def _check_complete(report: FloorReport) -> None:
    """Raise Incomplete if a sheet has no position, or frames were rejected."""
    losses = []
    if report.unplaced:
        losses.append(f"without a position: {', '.join(report.unplaced)}")
    if report.rejected:
        losses.append(f"rejected: {_frames_text(report.rejected)}")
    if losses:
        raise failures.Incomplete("; ".join(losses))


def _frames_text(rejected: int) -> str:
    if rejected == 1:
        return "1 frame that contradicts the others"
    return f"{rejected} frames that contradict the others"


def _attached(path: Path) -> Manifest:
    from locatk.formats.sessions import observations
    from locatk.formats.sessions.reader import Session

    manifest = observations.read_manifest(Session.open(path))
    if manifest is None:
        raise InputError(
            "the session has no manifest of the sheets",
            file=path,
            hint="Give it with --artifact floor.toml",
        )
    return manifest


def _read_recordings(
    sessions: tuple[Path, ...],
    manifest: Manifest,
    common_camera: Camera | None,
    truth: tuple[Path, ...],
    offset: float,
    *,
    must_have_manifest: bool,
) -> tuple[list[FloorRecording], dict[str, str]]:
    """Read the cameras of all sessions; return them, and why others cannot be used, by name.

    With ``must_have_manifest``, each session must have the sheets of ``manifest``.
    """
    from locatk.core.dots.calibration.floor import FloorRecording
    from locatk.formats.sessions import observations
    from locatk.formats.sessions.reader import Session

    floor_recordings: list[FloorRecording] = []
    tracks = [_tracks(path) for path in truth]
    left_out: dict[str, str] = {}
    measurements = recordings.Measurements()
    for index, path in enumerate(sessions):
        with recordings.skipping_unusable(path, left_out, alone=len(sessions) == 1):
            session = Session.open(path)
            if must_have_manifest and _attached(path) != manifest:
                raise InputError(
                    "the manifest differs from that of the first session",
                    file=path,
                    hint="Calibrate sessions of one floor, or give its manifest with --artifact",
                )
            camera = common_camera or observations.read_camera(session)
            cameras = observations.read_frames(session)
            for frames in cameras:
                # If the times and the first frames are equal, the others are, too.
                measurements.add(str(path), frames.time_ns, *_first_image(frames))
                name = str(path) if len(cameras) == 1 else f"{path}: {frames.device}"
                trajectory = None
                if truth:
                    file = min(index, len(truth) - 1)
                    trajectory = _track_of(frames.device, tracks[file], truth[file])
                floor_recordings.append(FloorRecording(name, frames, camera, trajectory, offset))
    return floor_recordings, left_out


def _first_image(frames: Frames) -> list[np.ndarray]:
    """Return the first image; nothing if it is damaged, because such frames are left out later."""
    try:
        return [frames.images[0]]
    except InputError:
        return []


def _tracks(path: Path) -> list[Trajectory]:
    from locatk.formats.importers.poses import trajectories

    return trajectories.read(path, role="truth")


def _track_of(device: str, tracks: list[Trajectory], path: Path) -> Trajectory:
    """Return the truth of a device: the one of its name, or the only one."""
    named = [track for track in tracks if track.device == device]
    if len(named or tracks) != 1:
        raise InputError(
            f"no truth of {device!r} among {', '.join(track.device for track in tracks)}",
            file=path,
            hint="Give a file with one trajectory, or with a trajectory of this name",
        )
    return (named or tracks)[0]


def _text(output: Path, report: FloorReport) -> str:
    """Format a table of the sheets, and how well the observations agree."""
    header = ("sheet", "x [mm]", "y", "[deg]", "dx", "dy", "[deg]", "sigma", "[deg]", "frames")
    rows = [_row(sheet, report.datum) for sheet in report.sheets[:MAX_SHEETS]]
    lines = [
        f"{len(report.sheets)} sheets from {report.seam_frames} frames with a seam, of "
        f"{report.frames}:",
        console.table(header, rows),
    ]
    if len(report.sheets) > MAX_SHEETS:
        lines.append(f"{len(report.sheets) - MAX_SHEETS} more: see --json")
    if report.seams:
        worst = max(report.seams, key=lambda seam: seam.rms_mm)
        lines.append(
            f"seams: {len(report.seams)}; largest residual {1e3 * worst.rms_mm:.1f} um rms, "
            f"between {worst.sheets[0]} and {worst.sheets[1]}"
        )
    if report.truth_frames:
        lines.append(f"truth: {report.truth_frames} poses, {_scale_text(report)}")
        mapped = sum(sheet.distortion is not None for sheet in report.sheets)
        lines.append(
            f"print: error of held-out poses {report.rms_rigid_mm:.3f} mm rms without maps"
            + (f", {report.rms_mm:.3f} mm with maps of {mapped} sheets" if mapped else
               "; the poses do not support maps")
        )  # fmt: skip
    if report.rejected:
        lines.append(f"rejected: {_frames_text(report.rejected)}")
    if report.unplaced:
        lines.append(console.wrapped(f"without a position: {', '.join(report.unplaced)}"))
    return "\n".join([*lines, f"Wrote {output}"])


def _row(sheet: BuiltSheet, datum: str) -> tuple[Any, ...]:
    x, y, heading = sheet.pose.tolist()
    dx, dy, rotation = sheet.shift.tolist()
    sigma = ("datum", "")
    if sheet.id != datum:
        sigma_x, sigma_y, sigma_heading = sheet.sigma.tolist()
        position = math.hypot(sigma_x, sigma_y)
        sigma = (f"{position:.4f}", f"{math.degrees(sigma_heading):.5f}")
    return (
        sheet.id,
        f"{x:.2f}",
        f"{y:.2f}",
        f"{math.degrees(heading):.3f}",
        *("-" if math.isnan(value) else f"{value:+.2f}" for value in (dx, dy)),
        "-" if math.isnan(rotation) else f"{math.degrees(rotation):+.3f}",
        *sigma,
        sheet.seam_frames + sheet.truth_frames,
    )


def _scale_text(report: FloorReport) -> str:
    (x, y), (sigma_x, sigma_y) = report.scale, report.sigma_scale
    return f"scale of the print {x:.5f} (sigma {sigma_x:.5f}), {y:.5f} (sigma {sigma_y:.5f})"


def _entry(
    sessions: tuple[Path, ...], output: Path, report: FloorReport, left_out: dict[str, str]
) -> dict[str, Any]:
    """Return the object of ``--json`` (docs/formats.md)."""
    hyperparameters = report.fit.hyperparameters
    has_truth = report.truth_frames > 0
    return {
        "version": 1,
        "sessions": sessions,
        "output": output,
        "datum": report.datum,
        "frames": {
            "seen": report.frames,
            "located": report.localized,
            "with_seam": report.seam_frames,
            "with_truth": report.truth_frames,
            "rejected": report.rejected,
        },
        "sheets": [_sheet_entry(sheet) for sheet in report.sheets],
        "seams": [
            {
                "sheets": seam.sheets,
                "frames": seam.frames,
                "rms_m": seam.rms_mm * 1e-3,
                "rms_rad": seam.rms_rad,
            }
            for seam in report.seams
        ],
        "unplaced": report.unplaced,
        "seam_sigma_factor": hyperparameters.seam if report.seams else None,
        "sigma_truth_m": hyperparameters.position_mm * 1e-3 if has_truth else None,
        "scale": report.scale,
        "sigma_scale": report.sigma_scale,
        "rms_rigid_m": report.rms_rigid_mm * 1e-3,
        "rms_m": report.rms_mm * 1e-3,
        "cameras": {
            name: {
                "focal_px": camera.focal_px,
                "centre_px": camera.centre_px,
                "radial": camera.radial,
            }
            for name, camera in report.cameras.items()
        },
        "left_out": left_out,
        "notes": report.notes,
    }


def _sheet_entry(sheet: BuiltSheet) -> dict[str, Any]:
    x, y, heading = sheet.pose.tolist()
    dx, dy, rotation = sheet.shift.tolist()
    sigma_x, sigma_y, sigma_heading = sheet.sigma.tolist()
    return {
        "id": sheet.id,
        "x_m": x * 1e-3,
        "y_m": y * 1e-3,
        "heading_rad": heading,
        "dx_m": dx * 1e-3,
        "dy_m": dy * 1e-3,
        "dheading_rad": rotation,
        "sigma_x_m": sigma_x * 1e-3,
        "sigma_y_m": sigma_y * 1e-3,
        "sigma_heading_rad": sigma_heading,
        "seam_frames": sheet.seam_frames,
        "truth_frames": sheet.truth_frames,
        "has_map": sheet.distortion is not None,
        "sigma_print_m": [value * 1e-3 for value in sheet.distortion_sigma_mm],
        "sigma_print_rad": sheet.distortion_sigma_rad,
    }
