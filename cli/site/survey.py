"""``locatk site survey``: positions of tags from drives with odometry over them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, options
from locatk.cli.calibrate import recordings
from locatk.cli.calibrate.tag import attached_tags, check_same_design
from locatk.cli.command import Command, section

if TYPE_CHECKING:
    from locatk.core.polaris.survey import SurveyDrive, SurveyReport
    from locatk.core.polaris.tag import Tags

MAX_TAGS = 60
"""Number of tags that are listed; ``--json`` lists all."""

MAX_REASONS = 20
"""Number of passes and drives that were not used of which the reasons are printed."""


@click.command(cls=Command)
@options.sessions
@options.output("Site to write (.toml).", endings=(".toml",))
@section(
    "Frame",
    click.option(
        "--fix",
        "fixed_ids",
        type=click.IntRange(0),
        multiple=True,
        metavar="ID",
        help="Tag that keeps its position of the given tags; a single one without a position is at "
        "the origin. Repeatable.  [default: the first tag of the first session]",
    ),
    click.option(
        "--fix-start",
        is_flag=True,
        help="Let the origin be the array at the start of the first session, with x forward.",
    ),
)
@section("Input", options.artifact)
@options.overwrite
@options.as_json
@options.verbosity
def command(
    sessions: tuple[Path, ...],
    output: Path,
    fixed_ids: tuple[int, ...],
    fix_start: bool,
    artifact: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Estimate positions and headings of the tags that robots passed in SESSIONS.

    The sessions need odometry. All passes and the odometry between them are fitted together by
    least squares; a tag that is passed again closes a loop. Drive over the tags in several orders
    and directions, in three sessions or more: a session that contradicts the others, because of a
    wrong id or of odometry that slipped, is then excluded and named. The tags are those of
    --artifact, or of the first session.

    Odometry measures positions relative to each other only, so that one tag is fixed, or the start.
    With two fixed tags (`--fix`), the scale of the odometry is estimated; otherwise its uncertainty
    (2 %) is part of the standard deviations.

    The exit status is 3 if a session or a pass was not used.

    \b
    Examples:
      locatk site survey drive1.mcap drive2.mcap drive3.mcap -o site.toml
      locatk site survey day/*.mcap --artifact tag.toml -o site.toml --fix 202517
      locatk site survey *.mcap --artifact old.toml --fix 7 --fix 12 -o new.toml
    """
    from locatk.core.polaris.survey import survey
    from locatk.formats.artifacts import tags as files

    if fix_start and fixed_ids:
        raise click.UsageError("--fix and --fix-start both define the frame: give one of them.")
    inputs = [*sessions, *([artifact] if artifact else [])]
    options.guard_output(output, overwrite=overwrite, inputs=inputs)
    tags = files.read_tags(artifact) if artifact else attached_tags(sessions[0])
    drives, left_out = _read_drives(sessions, tags, artifact is None)
    with console.working("Fitting"):
        report = survey(tags, drives, left_out, fixed_ids=fixed_ids, fix_start=fix_start)
    files.write_tags(output, report.tags, overwrite=overwrite)
    shown = dict(list(report.left_out.items())[:MAX_REASONS])
    recordings.print_result(_text(output, report), report.notes, shown)
    if len(shown) < len(report.left_out):
        console.warn(f"{len(report.left_out) - len(shown)} more were not used: see --json")
    if as_json:
        console.emit_json(_entry(sessions, output, report))
    recordings.check_all_used(report.left_out, "session or pass was", "sessions or passes were")


def _read_drives(
    sessions: tuple[Path, ...], tags: Tags, is_checked: bool
) -> tuple[list[SurveyDrive], dict[str, str]]:
    """Solve all sessions; return their drives, and why sessions and passes are not used.

    With ``is_checked``, each session must have the design of ``tags``.
    """
    from locatk.core import polaris
    from locatk.core.polaris.preprocessing import valid_odometry
    from locatk.core.polaris.survey import read_drive
    from locatk.formats.sessions import observations
    from locatk.formats.sessions.reader import Session

    drives: list[SurveyDrive] = []
    left_out: dict[str, str] = {}
    measurements = recordings.Measurements()
    with recordings.iterate(sessions, "Solving") as bar:
        for path in bar:
            with recordings.skipping_unusable(path, left_out, alone=len(sessions) == 1):
                session = Session.open(path)
                if is_checked:
                    check_same_design(tags, attached_tags(path), path)
                samples = observations.read_magnetometers(session)
                for each in samples:
                    measurements.add(str(path), each.time_ns, each.field_t)
                odometry = observations.read_odometry(session)
                solution = polaris.solve(samples, tags, odometry=odometry)
                valid = {track.device: valid_odometry(track)[0] for track in odometry}
                for each in samples:
                    name = str(path) if len(samples) == 1 else f"{path}: {each.device}"
                    detections = [d for d in solution.detections if d.device == each.device]
                    drive, reasons = read_drive(name, detections, valid.get(each.device))
                    left_out |= reasons
                    if drive is not None:
                        drives.append(drive)
    return drives, left_out


def _text(output: Path, report: SurveyReport) -> str:
    """Format a table of tags, and the odometry."""
    rows = []
    for each in report.surveyed[:MAX_TAGS]:
        sigma = each.covariance.diagonal() ** 0.5
        values = (1e3 * each.pose.x_m, 1e3 * each.pose.y_m, math.degrees(each.pose.heading_rad))
        sigmas = (1e3 * sigma[0], 1e3 * sigma[1], math.degrees(sigma[2]))
        cells = [
            f"{value:.2f}" if each.is_fixed else f"{value:.2f} \u00b1 {deviation:.2g}"
            for value, deviation in zip(values, sigmas, strict=True)
        ]
        rows.append(
            (
                each.tag_id,
                *cells,
                each.passes,
                each.drives,
                "fixed" if each.is_fixed else report.tags.meanings.get(each.tag_id, ""),
            )
        )
    header = ("tag", "x [mm]", "y [mm]", "heading [deg]", "passes", "drives", "")
    lines = [console.table(header, rows)]
    if len(report.surveyed) > MAX_TAGS:
        lines.append(f"... and {len(report.surveyed) - MAX_TAGS} more: see --json")
    lines.append(console.wrapped(f"frame: {report.gauge}"))
    for device, scale in report.scale.items():
        sigma_percent = 100 * report.scale_sigma[device]
        lines.append(
            console.wrapped(
                f"odometry of {device}: {100 * abs(scale):.2f} \u00b1 {sigma_percent:.2f} % too "
                f"{'long' if scale > 0 else 'short'}, random errors {report.odometry_ratio:.2g} "
                "times the usual ones"
            )
        )
    return "\n".join([*lines, f"Wrote {output}"])


def _entry(sessions: tuple[Path, ...], output: Path, report: SurveyReport) -> dict[str, Any]:
    """Return the object of ``--json`` (docs/formats.md)."""
    return {
        "version": 1,
        "sessions": sessions,
        "output": output,
        "frame": report.gauge,
        "drives": report.drives,
        "redundancy": report.redundancy,
        "odometry_ratio": report.odometry_ratio,
        "scale": report.scale,
        "sigma_scale": report.scale_sigma,
        "tags": [
            {
                "id": each.tag_id,
                "x_m": each.pose.x_m,
                "y_m": each.pose.y_m,
                "heading_rad": each.pose.heading_rad,
                "covariance": each.covariance,
                "passes": each.passes,
                "drives": each.drives,
                "fixed": each.is_fixed,
            }
            for each in report.surveyed
        ],
        "left_out": report.left_out,
        "notes": report.notes,
    }
