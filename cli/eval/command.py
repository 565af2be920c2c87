"""``locatk eval``: errors of poses with respect to the truth."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import click

from locatk.cli import console, options
from locatk.cli.command import Command, section
from locatk.core.errors import InputError

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
@options.input_argument("estimate")
@options.input_option(
    "--truth",
    required=True,
    help="Session with truth, another solution, or a TUM, KITTI or CSV file.",
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
    is_flag=True,
    help="Compare the poses that the device estimated itself, such as a Crazyflie; ESTIMATE is a "
    "session.",
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
)
@options.as_json
@options.verbosity
def command(
    estimate: Path,
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
    onboard: bool,
    as_json: bool,
) -> None:
    """Compare the poses of ESTIMATE with a reference, for each device.

    ESTIMATE is a solution (.mcap), a TUM, KITTI or CSV file, or a session with truth. The
    absolute pose error (APE) is the difference between a pose and the truth, the relative pose
    error (RPE) the error of the motion from one pose to the next; both have a part in
    millimetres or metres and one in degrees. Coverage is the fraction of the time of the truth
    with a pose. --full adds drift, the consistency of the covariances with the errors, and the
    other statistics.

    \b
    Examples:
      locatk eval solved.mcap --truth run.mcap
      locatk eval solved.mcap --truth run.mcap --full
      locatk eval solved.mcap --truth grid.mcap --align sim3 --json
      locatk eval solved.mcap --truth camera.tum --offset auto
      locatk eval flight.mcap --onboard --truth solved.mcap --align se3
      locatk eval slam.tum --truth mocap.tum --align se3 --delta 1m
      locatk eval solved.mcap --truth mocap.csv --pair 785b=red --pair dffa=blue
    """
    from locatk.cli.eval import text as eval_text
    from locatk.core.evaluation import Delta, EvaluationOptions, evaluate, pair_devices
    from locatk.formats.importers import trajectories as files

    rpe_delta = Delta.parse(delta)
    estimated = files.open_file(estimate, role="onboard" if onboard else "estimate")
    true = files.open_file(truth, role="truth")
    files.check_kinds(estimated, true)
    if not estimated.solved:
        if estimate.samefile(truth):
            raise InputError(
                "no solved poses", file=estimate, hint="Solve it first: `locatk solve`"
            )
        console.warn(f"{estimate} has no solved poses: its truth is used as the estimate")
    true_names = parse_pairs(names)
    pairs, unpaired = pair_devices(estimated.trajectories, true.trajectories, true_names)
    if not pairs:
        estimated_devices, true_devices = (
            ", ".join(each.device for each in side.trajectories) for side in (estimated, true)
        )
        raise InputError(
            f"none of its devices is in {truth}",
            file=estimate,
            hint=f"Name the pairs by --pair NAME=NAME: one of {estimated_devices}, and one of "
            f"{true_devices}",
        )
    # TUM and KITTI files do not name their device.
    has_names = not {estimated.kind, true.kind} & set(files.EVO_KINDS)
    for track, reference in pairs:
        device = track.device
        if has_names and reference.device != device and device not in true_names:
            console.say(f"{device} is compared with {reference.device}, the only other device")
        if align == "none" and track.frame and reference.frame and track.frame != reference.frame:
            console.warn(
                f"the poses of {device} are in the frame {track.frame!r}, its truth in "
                f"{reference.frame!r}: unless they are the same, errors need --align"
            )
    if unpaired:
        console.warn(f"no truth for {', '.join(unpaired)}")
    if match == "auto":
        is_evo = estimated.kind in files.EVO_KINDS and true.kind in files.EVO_KINDS
        match = "nearest" if is_evo else "interpolate"
    evaluation = evaluate(
        pairs,
        EvaluationOptions(
            align=align,
            offset_s=offset,  # type: ignore[arg-type]
            match=match,
            max_diff_s=max_diff,
            # Rows of KITTI are stamped by the second.
            max_gap_s=max(1.0, max_gap) if estimated.kind == "kitti" else max_gap,
            delta=rpe_delta,
            all_pairs=all_pairs,
        ),
    )
    if evaluation.time_offset.coarse_method == "first stamps":
        console.warn(
            "the motions differ too much to estimate the time offset: the first stamps were matched"
        )
    if evaluation.time_offset.alternatives:
        console.warn("the motion is periodic and fits several time offsets: give --offset")
    if as_json:
        facts = {"version": 1, "estimate": estimate, "truth": truth, **evaluation.as_dict()}
        console.emit_json(facts)
    else:
        console.result(eval_text.text(evaluation, full=full))


def parse_pairs(names: tuple[str, ...]) -> dict[str, str]:
    """Return names in the estimate and names in the truth, from `NAME=NAME`."""
    pairs = [name.partition("=") for name in names]
    for name, (estimated, _, true) in zip(names, pairs, strict=True):
        if not estimated or not true:
            raise click.BadParameter(f"{name!r} is not NAME=NAME.", param_hint="--pair")
    return {estimated: true for estimated, _, true in pairs}
