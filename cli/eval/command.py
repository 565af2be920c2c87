"""``locatk eval``: errors of poses with respect to the truth."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, options
from locatk.cli.command import Command, section
from locatk.core.errors import LocatkError

if TYPE_CHECKING:
    from locatk.formats.evaluation import EvaluatedFile

ALIGNMENTS = ("none", "se2", "se3", "sim2", "sim3", "yaw", "origin")
"""Copy of :data:`locatk.core.evaluation.ALIGNMENTS`, which imports numpy."""


MAX_OFFSET_S = 4e9
"""Largest time offset [s], 127 years: more than between any two clocks that count from 1970."""


class Offset(click.ParamType):
    """Number of seconds, or `auto`."""

    name = "seconds"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float | str:
        """Return seconds, or "auto"."""
        if value == "auto":
            return "auto"
        try:
            seconds = float(value)
        except ValueError:
            seconds = math.nan
        if abs(seconds) < MAX_OFFSET_S:
            return seconds
        self.fail(f"{value!r} is neither a number of seconds nor `auto`.", param, ctx)


align_option = click.option(
    "--align",
    type=click.Choice(ALIGNMENTS),
    default="none",
    show_default=True,
    help="Transformation of the estimate onto the truth, fitted to all devices together: "
    "in the plane (se2), in space (se3), with scale (sim2, sim3), about z (yaw), or "
    "from the first pose (origin).",
)

offset_option = click.option(
    "--offset",
    type=Offset(),
    default=0.0,
    show_default=True,
    metavar="SECONDS|auto",
    help="Time to add to the stamps of the estimate. `auto` estimates it from a part of "
    "the poses that is then excluded from the statistics; the clocks may be years "
    "apart.",
)


@click.command(cls=Command, short_help="Compare poses with ground truth.")
@click.argument("estimates", metavar="ESTIMATE...", type=options.PATH, nargs=-1, required=True)
@options.input_option(
    "--truth",
    required=True,
    metavar="FILE[#NAME]|FOLDER",
    callback=options.existing_poses,
    help="Session with truth, another solution, TUM, KITTI, CSV, EuRoC, a bag of ROS, MCAP of "
    "Foxglove, a log of a Crazyflie, or an export of Motive, Vicon or Qualisys; #NAME reads one "
    "device or topic only. In a folder, the file with the name of the session.",
)
@click.option(
    "--pair",
    "names",
    multiple=True,
    metavar="NAME=NAME",
    help="Name of a device in the estimate, and its name in the truth. Repeatable.",
)
@click.option(
    "--onboard",
    "role",
    flag_value="onboard",
    help="Compare the poses that the device estimated itself, such as a Crazyflie; ESTIMATE is a "
    "session.",
)
@click.option(
    "--live",
    "role",
    flag_value="live",
    help="Compare the poses of `locatk live`; ESTIMATE is the session that it recorded.",
)
@section("Alignment", align_option, offset_option)
@section(
    "Association",
    click.option(
        "--match",
        type=click.Choice(("auto", "interpolate", "nearest")),
        default="auto",
        show_default=True,
        help="`interpolate` the truth, or take the `nearest` pose in time as evo does; `auto` "
        "is `nearest` for two TUM or KITTI files, otherwise `interpolate`.",
    ),
    click.option(
        "--max-diff",
        type=options.POSITIVE,
        default=0.01,
        show_default=True,
        metavar="SECONDS",
        help="--match nearest: maximum time difference.",
    ),
    click.option(
        "--max-gap",
        type=options.POSITIVE,
        default=0.5,
        show_default=True,
        metavar="SECONDS",
        help="Longest gap in the truth that is interpolated and counted as covered; in rows "
        "for KITTI files.",
    ),
)
@section(
    "Relative error",
    click.option(
        "--delta",
        default="1f",
        show_default=True,
        metavar="N(f|m|deg|s)",
        help="Distance between the two poses of a relative error: poses (f), metres, degrees "
        "or seconds.",
    ),
    click.option(
        "--all-pairs",
        is_flag=True,
        help="Start a relative error at every pose, instead of at the end of the previous one.",
    ),
)
@section(
    "Output",
    click.option("--full", is_flag=True, help="Print all statistics and assumptions."),
    click.option(
        "--table",
        type=options.PATH,
        metavar="FILE",
        help="Write one row for each device of each estimate (.csv, .json, .parquet, .tex).",
    ),
    options.overwrite,
)
@options.as_json
@options.verbosity
def command(
    estimates: tuple[Path, ...],
    truth: Path,
    align: str,
    offset: float | str,
    match: str,
    max_diff: float,
    max_gap: float,
    delta: str,
    names: tuple[str, ...],
    all_pairs: bool,
    full: bool,
    table: Path | None,
    overwrite: bool,
    role: str | None,
    as_json: bool,
) -> None:
    """Compare the poses of ESTIMATE with a reference, for each device.

    ESTIMATE is a solution (.mcap), a session with truth, or any file of --truth. A bag of ROS is a
    folder or a file (.db3, .mcap, .bag) and needs the extra locatk[ros]. Several, also
    folders of solutions and patterns, are each compared with the truth of their session, and
    solutions of the same sessions by several methods or settings with each other. The absolute pose
    error (APE) is the difference between a pose and the truth, the relative pose error (RPE) the
    error of the motion from one pose to the next; both have a part in millimetres or metres and one
    in degrees. Coverage is the fraction of the time of the truth with a pose. --full adds drift,
    the consistency of the covariances with the errors, and the other statistics.

    \b
    Examples:
      locatk eval solved.mcap --truth run.mcap
      locatk eval solved.mcap --truth run.mcap --full
      locatk eval solved/ --truth recordings/ --table errors.csv
      locatk eval bundle/ paper/ --truth recordings/
      locatk eval solved.mcap --truth grid.mcap --align sim3 --json
      locatk eval solved.mcap --truth camera.tum --offset auto
      locatk eval solved.mcap --truth take.csv --align se3 --offset auto
      locatk eval flight.mcap --onboard --truth solved.mcap --align se3
      locatk eval run.mcap --live --truth solved.mcap
      locatk eval slam.tum --truth mocap.tum --align se3 --delta 1m
      locatk eval solved.mcap --truth mocap.csv --pair 785b=red --pair dffa=blue
      locatk eval drive.db3#/odom --truth drive.db3#/tf:map.base_link
    """
    from locatk.cli.eval import text as eval_text
    from locatk.core.evaluation import Delta, EvaluationOptions
    from locatk.formats.evaluation import evaluate_file, find_estimates, find_truth
    from locatk.formats.files import split_selection

    chosen = EvaluationOptions(
        align=align,
        offset_s=offset,  # type: ignore[arg-type]
        max_diff_s=max_diff,
        max_gap_s=max_gap,
        delta=Delta.parse(delta),
        all_pairs=all_pairs,
    )
    true_names = parse_pairs(names)

    def evaluated(file: Path) -> EvaluatedFile:
        return evaluate_file(
            file,
            find_truth(file, truth),
            chosen,
            names=true_names,
            match=match,
            role=role or "estimate",  # type: ignore[arg-type]
        )

    found, is_several = find_estimates(estimates)
    options.must_exist([split_selection(file)[0] for file in found])
    if is_several or table is not None:
        evaluate_several(found, evaluated, table, overwrite=overwrite, as_json=as_json)
        return
    one = evaluated(found[0])
    for note in one.notes:
        console.say(note)
    for warning in one.warnings:
        console.warn(warning)
    if as_json:
        facts = {"version": 1, "estimate": one.estimate, "truth": one.truth}
        console.emit_json({**facts, **one.evaluation.as_dict()})
    else:
        console.result(eval_text.text(one.evaluation, full=full))


def evaluate_several(
    found: Sequence[Path],
    evaluated: Callable[[Path], EvaluatedFile],
    table: Path | None,
    *,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Evaluate files, write the table, and print a row for each.

    Raises
    ------
    LocatkError
        At the end, if a file could not be evaluated; the others are.
    """
    from locatk.cli.eval import text as eval_text
    from locatk.formats.evaluation import COLUMNS, label_runs, summarize_runs
    from locatk.formats.files import split_selection
    from locatk.formats.tables.writing import ENDINGS, write_table

    if table is not None:
        options.check_ending(table, ENDINGS)
        options.guard_output(
            table, overwrite=overwrite, inputs=[split_selection(file)[0] for file in found]
        )
    results, failures = [], []
    with console.progress(found, "Evaluating") as items:
        for file in items:
            try:
                results.append(evaluated(file))
            except LocatkError as error:
                failures.append({"estimate": file, "error": error.message, "hint": error.hint})
    for failure in failures:
        console.warn(f"{failure['estimate']} was not evaluated: {failure['error']}")
    for text in dict.fromkeys(warning for each in results for warning in each.warnings):
        console.warn(text)
    runs = label_runs(results)
    rows = [row for each, run in zip(results, runs, strict=True) for row in each.rows(run)]
    summaries = summarize_runs(results, runs) if results else []
    if table is not None and rows:
        write_table(table, COLUMNS, rows, overwrite=overwrite)
        console.say(f"Wrote {table}: {len(rows)} rows")
    if as_json:
        runs_json = [asdict(summary) for summary in summaries]
        console.emit_json({"version": 1, "rows": rows, "runs": runs_json, "failures": failures})
    elif results:
        console.result(eval_text.several(rows, summaries))
    if failures:
        raise LocatkError(
            f"{len(failures)} of {len(found)} files could not be evaluated",
            hint="The warnings above say why",
        )


def parse_pairs(names: tuple[str, ...]) -> dict[str, str]:
    """Return names in the estimate and names in the truth, from `NAME=NAME`."""
    pairs = [name.partition("=") for name in names]
    for name, (estimated, _, true) in zip(names, pairs, strict=True):
        if not estimated or not true:
            raise click.BadParameter(f"{name!r} is not NAME=NAME.", param_hint="--pair")
    return {estimated: true for estimated, _, true in pairs}
