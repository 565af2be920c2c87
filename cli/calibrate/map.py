"""``locatk calibrate map``: recordings of robots say how a floor was really laid."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, options
from locatk.cli.calibrate import recordings
from locatk.cli.command import Command
from locatk.core.errors import InputError

if TYPE_CHECKING:
    from locatk.core.landmarks.calibration.floor import CalibrationDrive, FloorCalibrationReport
    from locatk.core.landmarks.calibration.landmarks import CalibratedLandmark
    from locatk.core.landmarks.map.floor import FloorMap

MOST_LANDMARKS = 40
"""Of more than these, only flagged landmarks are listed for people."""


@click.command("map", cls=Command, short_help="Fit the landmarks of a floor as built.")
@options.sessions
@options.output("Map to write (.toml), with the landmarks as built.")
@options.artifact
@options.overwrite
@options.as_json
@options.verbosity
def command(
    sessions: tuple[Path, ...],
    output: Path,
    artifact: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Fit centre, heading and bar strengths of each landmark that robots in SESSIONS visited.

    All recordings are solved together, so that each landmark should be visited several times,
    in several directions, and recordings should have landmarks in common. Bars that are
    flipped, weak or missing are flagged, and landmarks that are displaced (by 5 mm) or turned
    (by 3 degrees). `locatk solve --artifact` then counts with how they lie. The map comes from
    --artifact, or from the first session.

    Robots see how landmarks lie to one another, not where the floor lies: most of them are
    taken to lie as designed. So it is with strength: the typical bar has 1.

    Flags are what this command is for, and no failure. The exit status is 3 where a recording
    or a visit was not used: not localised on the map, or in disagreement with the others.

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
    with console.working("Solving all together"):
        report = calibrate(floor, drives, left_out)
    maps.write_map(output, report.floor, overwrite=overwrite)
    recordings.tell(_text(output, report), report.notes, report.left_out)
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
        raise InputError("no map", file=path, hint="Give it with --artifact map.toml")
    return floor


def _drives(
    sessions: tuple[Path, ...], floor: FloorMap, same: bool
) -> tuple[list[CalibrationDrive], dict[str, str]]:
    """The robots of all sessions, and what cannot be used: name to why.

    With ``same``, each session must hold the design of ``floor``.
    """
    from locatk.core.landmarks.calibration import floor as calibrate
    from locatk.formats.sessions import observations
    from locatk.formats.sessions.reader import Session

    drives: list[CalibrationDrive] = []
    left_out: dict[str, str] = {}
    with recordings.walk(sessions, "Reading") as bar:
        for path in bar:
            with recordings.sparing(path, left_out, alone=len(sessions) == 1):
                session = Session.open(path)
                if same:
                    _check_same(floor, _attached(path), path)
                odometry = {track.device: track for track in observations.read_odometry(session)}
                samples = observations.read_halls(session)
                for each in samples:
                    name = str(path) if len(samples) == 1 else f"{path}: {each.device}"
                    drive = calibrate.read_drive(name, each, odometry.get(each.device), floor)
                    if isinstance(drive, str):
                        left_out[name] = drive
                    else:
                        drives.append(drive)
    return drives, left_out


def _check_same(floor: FloorMap, other: FloorMap, path: Path) -> None:
    import numpy as np

    same = np.array_equal(floor.codes, other.codes) and floor.geometry == other.geometry
    if not same or (floor.pitch_m, floor.origin_m) != (other.pitch_m, other.origin_m):
        raise InputError(
            "another map than in the first session",
            file=path,
            hint="Calibrate sessions of one floor, or give its map with --artifact",
        )


def _letters(landmark: CalibratedLandmark) -> str:
    """Its bars as they lie, `-` where there is none."""
    from locatk.core.landmarks.map.floor import MISSING_BAR_STRENGTH

    return "".join(
        "-" if abs(value) < MISSING_BAR_STRENGTH else "N" if value > 0 else "S"
        for value in landmark.built.strength.tolist()
    )


def _text(output: Path, report: FloorCalibrationReport) -> str:
    """The landmarks for people: a table, and what it is to be told of the others."""
    told = [one for one in report.landmarks if not one.refused]
    flagged = [one for one in told if one.built.flags]
    listed = told if len(told) <= MOST_LANDMARKS else flagged
    rows = [
        (
            f"{one.cell[0]},{one.cell[1]}",
            one.built.visits,
            f"{1e3 * one.built.x_m:+.2f}",
            f"{1e3 * one.built.y_m:+.2f}",
            f"{1e3 * math.hypot(*one.built.sigma[:2]):.2f}",
            f"{math.degrees(one.built.heading_rad):+.2f}",
            _letters(one),
            *(f"{abs(value):.2f}" for value in one.built.strength),
            " ".join(one.built.flags),
        )
        for one in listed
    ]
    header = ("landmark", "visits", "dx", "dy", "sigma [mm]", "turn [deg]", "bars",
              *("0", "1", "2", "3"), "flags")  # fmt: skip
    lines = [
        f"{len(told)} landmarks as built against their design, {len(flagged)} flagged"
        + (":" if listed else ""),
        *([console.table(header, rows)] if rows else []),
    ]
    if len(listed) < len(told):
        lines.append(f"{len(told) - len(listed)} more without a flag; --json lists them all")
    lines += [
        f"seen, but not told: {one.cell[0]},{one.cell[1]}, {one.refused}"
        for one in report.landmarks
        if one.refused
    ]
    if report.unvisited:
        cells = [f"{row},{column}" for row, column in report.unvisited]
        more = f" and {len(cells) - MOST_LANDMARKS} more" if len(cells) > MOST_LANDMARKS else ""
        lines.append(f"never visited: {' '.join(cells[:MOST_LANDMARKS])}{more}")
    return "\n".join([*lines, f"Wrote {output}"])


def _entry(
    sessions: tuple[Path, ...], output: Path, report: FloorCalibrationReport
) -> dict[str, Any]:
    """The one object of ``--json``; docs/formats.md."""
    landmarks = [
        {
            "cell": one.cell,
            "visits": one.built.visits,
            "x_m": one.built.x_m,
            "y_m": one.built.y_m,
            "heading_rad": one.built.heading_rad,
            "strength": one.built.strength,
            "sigma_x_m": one.built.sigma[0],
            "sigma_y_m": one.built.sigma[1],
            "sigma_heading_rad": one.built.sigma[2],
            "sigma_strength": one.built.sigma[3:],
            "laid": _letters(one),
            "flags": one.built.flags,
            "refused": one.refused,
        }
        for one in report.landmarks
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
