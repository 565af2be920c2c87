"""``locatk calibrate map``: landmarks of a floor as built, from recordings of robots."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, options
from locatk.cli.calibrate import recordings
from locatk.cli.command import Command, section
from locatk.core.errors import InputError

if TYPE_CHECKING:
    from locatk.core.landmarks.calibration.floor import CalibrationDrive, FloorCalibrationReport
    from locatk.core.landmarks.calibration.landmarks import CalibratedLandmark
    from locatk.core.landmarks.map.floor import FloorMap

MAX_LANDMARKS = 40
"""Number of landmarks listed as text; of more, only those with a flag are listed."""


@click.command("map", cls=Command, short_help="Fit the landmarks of a map as built.")
@options.sessions
@options.output("Map to write (.toml), with the landmarks as built.", endings=(".toml",))
@options.overwrite
@section("Input", options.artifact)
@options.as_json
@options.verbosity
def command(
    sessions: tuple[Path, ...],
    output: Path,
    artifact: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Fit position, heading and bar strengths of the landmarks that robots visited in SESSIONS.

    All recordings are solved together. Visit each landmark several times in different
    directions, and visit some landmarks in several recordings. Bars are flagged if they are
    flipped, weak or missing, and landmarks if they are displaced (by 5 mm) or rotated (by 3
    degrees). `locatk solve --artifact` uses the landmarks as built. The map is that of
    --artifact, or of the first session.

    Recordings determine the positions of landmarks relative to each other only. The position of the
    map follows from the majority of the landmarks, which are assumed to be as designed. The typical
    bar has strength 1.

    Flags are results, not failures. The exit status is 3 if a recording or a visit was not
    used, because it was not localised on the map or contradicts the others.

    \b
    Examples:
      locatk calibrate map run.mcap -o built.toml
      locatk calibrate map day/*.mcap --artifact map.toml -o built.toml --json
      locatk solve later.mcap -o solved.mcap --artifact built.toml
    """
    from locatk.core.landmarks.calibration.floor import calibrate
    from locatk.formats.artifacts import maps

    inputs = [*sessions, *([artifact] if artifact else [])]
    options.guard_output(output, overwrite=overwrite, inputs=inputs)
    floor = maps.read_map(artifact) if artifact else _attached(sessions[0])
    drives, left_out = _drives(sessions, floor, artifact is None)
    with console.working("Solving"):
        report = calibrate(floor, drives, left_out)
    maps.write_map(output, report.floor, overwrite=overwrite)
    recordings.print_result(_text(output, report), report.notes, report.left_out)
    if as_json:
        console.emit_json(_entry(sessions, output, report))
    recordings.check_all_used(
        report.left_out, "recording or visit was", "recordings or visits were"
    )


def _attached(path: Path) -> FloorMap:
    from locatk.formats.sessions import observations
    from locatk.formats.sessions.reader import Session

    floor = observations.read_map(Session.open(path))
    if floor is None:
        raise InputError(
            "the session has no map", file=path, hint="Give it with --artifact map.toml"
        )
    return floor


def _drives(
    sessions: tuple[Path, ...], floor: FloorMap, is_checked: bool
) -> tuple[list[CalibrationDrive], dict[str, str]]:
    """Read the robots of all sessions; return them, and why others cannot be used, by name.

    With ``is_checked``, each session must have the design of ``floor``.
    """
    from locatk.core.landmarks.calibration import floor as calibrate
    from locatk.formats.sessions import observations
    from locatk.formats.sessions.reader import Session

    drives: list[CalibrationDrive] = []
    left_out: dict[str, str] = {}
    measurements = recordings.Measurements()
    with recordings.iterate(sessions, "Reading") as bar:
        for path in bar:
            with recordings.skipping_unusable(path, left_out, alone=len(sessions) == 1):
                session = Session.open(path)
                if is_checked:
                    _check_same(floor, _attached(path), path)
                odometry = {track.device: track for track in observations.read_odometry(session)}
                samples = observations.read_halls(session)
                for each in samples:
                    measurements.add(str(path), each.time_ns, each.field_t)
                    name = str(path) if len(samples) == 1 else f"{path}: {each.device}"
                    drive = calibrate.read_drive(name, each, odometry.get(each.device), floor)
                    if isinstance(drive, str):
                        left_out[name] = drive
                    else:
                        drives.append(drive)
    return drives, left_out


def _check_same(floor: FloorMap, other: FloorMap, path: Path) -> None:
    import numpy as np

    is_same = np.array_equal(floor.codes, other.codes) and floor.geometry == other.geometry
    if not is_same or (floor.pitch_m, floor.origin_m) != (other.pitch_m, other.origin_m):
        raise InputError(
            "the map differs from that of the first session",
            file=path,
            hint="Calibrate sessions of one floor, or give its map with --artifact",
        )


def _letters(landmark: CalibratedLandmark) -> str:
    """Return the poles of the bars as built, `-` for a missing bar."""
    from locatk.core.landmarks.map.floor import MISSING_BAR_STRENGTH

    return "".join(
        "-" if abs(value) < MISSING_BAR_STRENGTH else "N" if value > 0 else "S"
        for value in landmark.built.strength.tolist()
    )


def _text(output: Path, report: FloorCalibrationReport) -> str:
    """Format a table of landmarks, and list those without a result."""
    fitted = [landmark for landmark in report.landmarks if not landmark.refused]
    flagged = [landmark for landmark in fitted if landmark.built.flags]
    listed = fitted if len(fitted) <= MAX_LANDMARKS else flagged
    rows = [
        (
            f"{landmark.cell[0]},{landmark.cell[1]}",
            landmark.built.visits,
            f"{1e3 * landmark.built.x_m:+.2f}",
            f"{1e3 * landmark.built.y_m:+.2f}",
            f"{1e3 * math.hypot(*landmark.built.sigma[:2]):.2f}",
            f"{math.degrees(landmark.built.heading_rad):+.2f}",
            _letters(landmark),
            " ".join(f"{abs(value):.2f}" for value in landmark.built.strength),
            " ".join(landmark.built.flags),
        )
        for landmark in listed
    ]
    header = (
        *("cell", "visits", "dx", "dy", "sigma [mm]", "angle [deg]"),
        *("bars", "strength", "flags"),
    )
    lines = [
        f"{len(fitted)} landmarks as built against their design, {len(flagged)} flagged"
        + (":" if listed else ""),
        *([console.table(header, rows)] if rows else []),
    ]
    if len(listed) < len(fitted):
        lines.append(f"{len(fitted) - len(listed)} more without a flag: see --json")
    lines += [
        f"visited, but not fitted: {landmark.cell[0]},{landmark.cell[1]}, {landmark.refused}"
        for landmark in report.landmarks
        if landmark.refused
    ]
    if report.unvisited:
        cells = [f"{row},{column}" for row, column in report.unvisited]
        more = f" and {len(cells) - MAX_LANDMARKS} more" if len(cells) > MAX_LANDMARKS else ""
        unvisited = f"never visited: {' '.join(cells[:MAX_LANDMARKS])}{more}"
        lines.append(console.wrapped(unvisited))
    return "\n".join([*lines, f"Wrote {output}"])


def _entry(
    sessions: tuple[Path, ...], output: Path, report: FloorCalibrationReport
) -> dict[str, Any]:
    """Return the object of ``--json`` (docs/formats.md)."""
    landmarks = [
        {
            "cell": landmark.cell,
            "visits": landmark.built.visits,
            "x_m": landmark.built.x_m,
            "y_m": landmark.built.y_m,
            "heading_rad": landmark.built.heading_rad,
            "strength": landmark.built.strength,
            "sigma_x_m": landmark.built.sigma[0],
            "sigma_y_m": landmark.built.sigma[1],
            "sigma_heading_rad": landmark.built.sigma[2],
            "sigma_strength": landmark.built.sigma[3:],
            "laid": _letters(landmark),
            "flags": landmark.built.flags,
            "refused": landmark.refused,
        }
        for landmark in report.landmarks
    ]
    return {
        "version": 1,
        "sessions": sessions,
        "output": output,
        "landmarks": landmarks,
        "unvisited": report.unvisited,
        "typical_strength": report.strength,
        "sigma_typical_strength": report.strength_sigma,
        "misfit_sigma": report.residual_sigma,
        "left_out": report.left_out,
        "notes": report.notes,
    }
