"""``locatk calibrate tag``: passes over a tag say how its magnets really lie."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, options
from locatk.cli.calibrate import recordings
from locatk.cli.command import Command
from locatk.cli.solve.command import speed_option
from locatk.core.errors import InputError

if TYPE_CHECKING:
    from locatk.core.polaris.calibration import TagCalibrationReport, TagPass
    from locatk.core.polaris.tag import Tags


@click.command("tag", cls=Command, short_help="Fit the magnets of tags as built.")
@options.sessions
@options.output("Tags to write (.toml), with the magnets as built.")
@options.artifact
@speed_option
@options.overwrite
@options.as_json
@options.verbosity
def command(
    sessions: tuple[Path, ...],
    output: Path,
    artifact: Path | None,
    speed: float | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Fit places and angles of the magnets to the passes in SESSIONS.

    Each tag that was read in two passes or more gets its magnets as built; ten passes, in
    several directions, are better. Magnets set by hand are off by some degrees, the same in
    every pass: `locatk solve --artifact` then counts with where they are. The tags come from
    --artifact, or from the first session.

    The exit status is 3 where a pass was not used: not read, the only one over its tag, or
    in disagreement with the others.

    \b
    Examples:
      locatk calibrate tag run1.mcap run2.mcap run3.mcap -o built.toml
      locatk calibrate tag runs/*.mcap --artifact tag.toml -o built.toml --speed 0.105
      locatk solve later.mcap -o solved.mcap --artifact built.toml
    """
    from locatk.core.polaris.calibration import calibrate
    from locatk.formats.artifacts import tags as files

    inputs = [*sessions, *([artifact] if artifact else [])]
    options.guard_output(output, overwrite=overwrite, inputs=inputs)
    tags = files.read_tags(artifact) if artifact else _attached(sessions[0])
    passes, left_out = _passes(sessions, tags, speed, artifact is None)
    report = calibrate(tags, passes, left_out)
    files.write_tags(output, report.tags, overwrite=overwrite)
    recordings.tell(_text(output, report), report.notes, report.left_out)
    if as_json:
        console.emit_json(_entry(sessions, output, report))
    recordings.check_all_used(report.left_out, "pass was", "passes were")


def _attached(path: Path) -> Tags:
    from locatk.formats.sessions import observations
    from locatk.formats.sessions.reader import Session

    tags = observations.read_tags(Session.open(path))
    if tags is None:
        raise InputError("no tags", file=path, hint="Give them with --artifact tag.toml")
    return tags


def _passes(
    sessions: tuple[Path, ...], tags: Tags, speed: float | None, same: bool
) -> tuple[list[TagPass], dict[str, str]]:
    """The passes of all sessions, and what is none: name to why.

    With ``same``, each session must hold the design of ``tags``.
    """
    from dataclasses import replace

    from locatk.core import polaris
    from locatk.core.polaris.calibration import tag_pass
    from locatk.formats.sessions import observations
    from locatk.formats.sessions.reader import Session

    # What an earlier calibration says must not come back as if it had been seen.
    design = replace(tags, built={}, site={})
    wanted = polaris.SolveOptions(method="joint", speed_mps=speed)
    passes: list[TagPass] = []
    left_out: dict[str, str] = {}
    with recordings.walk(sessions, "Solving") as bar:
        for path in bar:
            solution = None
            with recordings.sparing(path, left_out, alone=len(sessions) == 1):
                session = Session.open(path)
                if same:
                    _check_same(tags, _attached(path), path)
                samples = observations.read_samples(session)
                odometry = observations.read_odometry(session)
                solution = polaris.solve(samples, design, wanted, odometry=odometry)
            if solution is None:
                continue
            if not solution.detections:
                left_out[str(path)] = "no tag was seen"
            for detection in solution.detections:
                name = f"{path} at {detection.time_s:.3f} s"
                found = tag_pass(design, detection, name)
                if isinstance(found, str):
                    left_out[name] = found
                else:
                    passes.append(found)
    return passes, left_out


def _check_same(tags: Tags, other: Tags, path: Path) -> None:
    design = ("codec", "order", "magnets", "orientations", "spacing_m")
    for name in design:
        if getattr(tags, name) != getattr(other, name):
            raise InputError(
                f"tags of another {name.removesuffix('_m')} than in the first session",
                file=path,
                hint="Calibrate tags of one design, or give theirs with --artifact",
            )


def _text(output: Path, report: TagCalibrationReport) -> str:
    """The magnets for people: a table for each tag."""
    from locatk.core.polaris.codec import layout_of

    lines = []
    for found in report.calibrated:
        cells = layout_of(report.tags, found.tag_id).cells
        rows = [
            (
                f"{column},{row}",
                *(f"{1e3 * x:+.2f}" for x in found.built.offset_m[n]),
                f"{1e3 * found.scatter_m[n]:.2f}",
                f"{math.degrees(found.built.angle_rad[n]):+.2f}",
                f"{math.degrees(found.scatter_rad[n]):.2f}",
                found.passes[n],
            )
            for n, (column, row) in enumerate(cells)
        ]
        header = ("cell", "x", "y", "scatter [mm]", "angle", "scatter [deg]", "passes")
        lines += [
            f"tag {found.tag_id} from {len(found.used)} passes, as built against its design:",
            console.table(header, rows),
        ]
    return "\n".join([*lines, f"Wrote {output}"])


def _entry(
    sessions: tuple[Path, ...], output: Path, report: TagCalibrationReport
) -> dict[str, Any]:
    """The one object of ``--json``; docs/formats.md."""
    from locatk.core.polaris.codec import layout_of

    tags = []
    for found in report.calibrated:
        layout = layout_of(report.tags, found.tag_id)
        magnets = [
            {
                "cell": cell,
                "symbol": symbol,
                "offset_m": found.built.offset_m[n],
                "angle_rad": found.built.angle_rad[n],
                "scatter_m": found.scatter_m[n],
                "scatter_rad": found.scatter_rad[n],
                "passes": found.passes[n],
            }
            for n, (cell, symbol) in enumerate(zip(layout.cells, layout.symbols, strict=True))
        ]
        tags.append(
            {
                "id": found.tag_id,
                "used": found.used,
                "disagree": found.disagree,
                "stretch": found.stretch,
                "sigma_stretch": found.sigma_stretch,
                "magnets": magnets,
            }
        )
    return {
        "version": 1,
        "sessions": sessions,
        "output": output,
        "tags": tags,
        "left_out": report.left_out,
        "notes": report.notes,
    }
