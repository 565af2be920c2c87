"""``locatk calibrate tag``: magnets of tags as built, from passes over them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, options
from locatk.cli.calibrate import recordings
from locatk.cli.command import Command, section
from locatk.cli.solve.command import speed_option
from locatk.core.errors import InputError

if TYPE_CHECKING:
    from locatk.core.polaris.calibration import TagCalibrationReport, TagPass
    from locatk.core.polaris.tag import Tags


@click.command("tag", cls=Command, short_help="Fit the magnets of tags as built.")
@options.sessions
@options.output("Tags to write (.toml), with the magnets as built.", endings=(".toml",))
@options.overwrite
@section("Input", options.artifact, speed_option)
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
    """Fit positions and angles of the magnets to the passes in SESSIONS.

    A tag needs at least two passes in which it was read; ten passes in different directions are
    better. Magnets that were placed by hand deviate by a few degrees, equally in every pass:
    `locatk solve --artifact` uses the magnets as built. The tags are those of --artifact, or of the
    first session.

    The exit status is 3 if a pass was not used, because the tag was not read, because it is the
    only pass over its tag, or because it contradicts the others.

    \b
    Examples:
      locatk calibrate tag run1.mcap run2.mcap run3.mcap -o built.toml
      locatk calibrate tag *.mcap --artifact tag.toml -o built.toml --speed 0.105
      locatk solve later.mcap -o solved.mcap --artifact built.toml
    """
    from locatk.core.polaris.calibration import calibrate
    from locatk.formats.artifacts import tags as files

    inputs = [*sessions, *([artifact] if artifact else [])]
    options.guard_output(output, overwrite=overwrite, inputs=inputs)
    tags = files.read_tags(artifact) if artifact else attached_tags(sessions[0])
    passes, left_out = _passes(sessions, tags, speed, artifact is None)
    report = calibrate(tags, passes, left_out)
    files.write_tags(output, report.tags, overwrite=overwrite)
    recordings.print_result(_text(output, report), report.notes, report.left_out)
    if as_json:
        console.emit_json(_entry(sessions, output, report))
    recordings.check_all_used(report.left_out, "pass was", "passes were")


def attached_tags(path: Path) -> Tags:
    """Return the tags of a session.

    Raises
    ------
    InputError
        It has none.
    """
    from locatk.formats.sessions import observations
    from locatk.formats.sessions.reader import Session

    tags = observations.read_tags(Session.open(path))
    if tags is None:
        raise InputError(
            "the session has no tags", file=path, hint="Give them with --artifact tag.toml"
        )
    return tags


def _passes(
    sessions: tuple[Path, ...], tags: Tags, speed: float | None, is_checked: bool
) -> tuple[list[TagPass], dict[str, str]]:
    """Read the passes of all sessions; return them, and why others cannot be used, by name.

    With ``is_checked``, each session must have the design of ``tags``.
    """
    from dataclasses import replace

    from locatk.core import polaris
    from locatk.core.polaris.calibration import tag_pass
    from locatk.formats.sessions import observations
    from locatk.formats.sessions.reader import Session

    # The result of an earlier calibration must not enter as if it had been observed.
    design = replace(tags, built={}, site={})
    solve_options = polaris.SolveOptions(method="joint", speed_mps=speed)
    passes: list[TagPass] = []
    left_out: dict[str, str] = {}
    measurements = recordings.Measurements()
    with recordings.iterate(sessions, "Solving") as bar:
        for path in bar:
            solution = None
            with recordings.skipping_unusable(path, left_out, alone=len(sessions) == 1):
                session = Session.open(path)
                if is_checked:
                    check_same_design(tags, attached_tags(path), path)
                samples = observations.read_magnetometers(session)
                for each in samples:
                    measurements.add(str(path), each.time_ns, each.field_t)
                odometry = observations.read_odometry(session)
                solution = polaris.solve(samples, design, solve_options, odometry=odometry)
            if solution is None:
                continue
            if not solution.detections:
                left_out[str(path)] = "no tag was detected"
            for detection in solution.detections:
                name = f"{path} at {detection.time_s:.3f} s"
                result = tag_pass(design, detection, name)
                if isinstance(result, str):
                    left_out[name] = result
                else:
                    passes.append(result)
    return passes, left_out


def check_same_design(tags: Tags, other: Tags, path: Path) -> None:
    """Refuse a session at ``path`` whose tags have another design."""
    design = ("codec", "order", "magnets", "orientations", "spacing_m")
    for name in design:
        if getattr(tags, name) != getattr(other, name):
            raise InputError(
                f"the {name.removesuffix('_m')} of the tags differs from that of the first session",
                file=path,
                hint="Calibrate tags of one design, or give it with --artifact",
            )


def _text(output: Path, report: TagCalibrationReport) -> str:
    """Format a table of magnets for each tag."""
    from locatk.core.polaris.codec import layout_of

    lines = []
    for calibrated in report.calibrated:
        cells = layout_of(report.tags, calibrated.tag_id).cells
        rows = [
            (
                f"{column},{row}",
                *(f"{1e3 * x:+.2f}" for x in calibrated.built.offset_m[n]),
                f"{1e3 * calibrated.scatter_m[n]:.2f}",
                f"{math.degrees(calibrated.built.angle_rad[n]):+.2f}",
                f"{math.degrees(calibrated.scatter_rad[n]):.2f}",
                calibrated.passes[n],
            )
            for n, (column, row) in enumerate(cells)
        ]
        header = ("cell", "x", "y", "scatter [mm]", "angle", "scatter [deg]", "passes")
        lines += [
            f"tag {calibrated.tag_id}, {len(calibrated.used)} passes, difference from its design:",
            console.table(header, rows),
        ]
    return "\n".join([*lines, f"Wrote {output}"])


def _entry(
    sessions: tuple[Path, ...], output: Path, report: TagCalibrationReport
) -> dict[str, Any]:
    """Return the object of ``--json`` (docs/formats.md)."""
    from locatk.core.polaris.codec import layout_of

    tags = []
    for calibrated in report.calibrated:
        layout = layout_of(report.tags, calibrated.tag_id)
        magnets = [
            {
                "cell": cell,
                "symbol": symbol,
                "offset_m": calibrated.built.offset_m[n],
                "angle_rad": calibrated.built.angle_rad[n],
                "scatter_m": calibrated.scatter_m[n],
                "scatter_rad": calibrated.scatter_rad[n],
                "passes": calibrated.passes[n],
            }
            for n, (cell, symbol) in enumerate(zip(layout.cells, layout.symbols, strict=True))
        ]
        tags.append(
            {
                "id": calibrated.tag_id,
                "used": calibrated.used,
                "disagree": calibrated.disagree,
                "stretch": calibrated.stretch,
                "sigma_stretch": calibrated.sigma_stretch,
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
