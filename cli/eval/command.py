"""``locatk eval``: poses against the truth."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import click

from locatk.cli import console, options
from locatk.core.errors import InputError

ALIGNMENTS = ("none", "se2", "se3", "sim2", "sim3", "yaw", "origin")
"""Copy of :data:`locatk.core.evaluation.ALIGNMENTS`, which imports numpy (a test compares them)."""


class Offset(click.ParamType):
    """Seconds, or `auto`."""

    name = "seconds"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float | str:
        if value == "auto":
            return "auto"
        try:
            seconds = float(value)
        except ValueError:
            seconds = math.nan
        if abs(seconds) < 4e9:
            return seconds
        self.fail(f"{value!r} is neither a number of seconds nor `auto`.", param, ctx)


align_option = click.option(
    "--align",
    type=click.Choice(ALIGNMENTS),
    default="none",
    show_default=True,
    help="Fitted from estimate to truth on the scored poses, for all devices together: in the "
    "plane (se2), in space (se3), with scale (sim2, sim3), about z (yaw), or the first pose laid "
    "on its truth (origin).",
)

offset_option = click.option(
    "--offset",
    type=Offset(),
    default=0.0,
    show_default=True,
    metavar="SECONDS|auto",
    help="Added to the stamps of the estimate; `auto` estimates it on a part that is not scored, "
    "from clocks that may be years apart.",
)


@click.command(short_help="Compare poses with the truth.")
@options.input_argument("estimate")
@options.input_option(
    "--truth",
    required=True,
    metavar="FILE",
    help="Session with truth, another solution, or a TUM, KITTI or CSV file.",
)
@align_option
@offset_option
@click.option(
    "--match",
    type=click.Choice(("auto", "interpolate", "nearest")),
    default="auto",
    show_default=True,
    help="Truth between its neighbours in time, or the nearest as evo takes it; `auto` is "
    "`nearest` for two TUM or KITTI files.",
)
@click.option(
    "--max-diff",
    type=click.FloatRange(0, min_open=True),
    default=0.01,
    show_default=True,
    metavar="SECONDS",
    help="With `nearest`: how far apart in time.",
)
@click.option(
    "--max-gap",
    type=click.FloatRange(0, min_open=True),
    default=0.5,
    show_default=True,
    metavar="SECONDS",
    help="Longest gap in the truth that is interpolated over, and for which coverage counts a "
    "time as known; KITTI has rows instead.",
)
@click.option(
    "--delta",
    default="1f",
    show_default=True,
    metavar="N(f|m|deg|s)",
    help="Distance of the poses of a relative error: poses, metres, degrees or seconds.",
)
@click.option(
    "--pair",
    "names",
    multiple=True,
    metavar="NAME=NAME",
    help="What a device of the estimate is called in the truth; may be given again.",
)
@click.option("--all-pairs", is_flag=True, help="Relative errors from each pose on.")
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
    as_json: bool,
) -> None:
    """Compare the poses of ESTIMATE with a reference, device by device.

    ESTIMATE is a solution (.mcap), a TUM, KITTI or CSV file, or the truth of a session. The
    absolute error (APE) is the distance of a pose from the truth, the relative one (RPE) what is
    wrong in the motion from one pose to the next; both have a part in metres and one in degrees.
    Consistency is whether the covariances of the estimate fit its errors.

    \b
    Examples:
      locatk eval solved.mcap --truth run.mcap
      locatk eval solved.mcap --truth grid.mcap --align sim3 --json
      locatk eval solved.mcap --truth camera.tum --offset auto
      locatk eval slam.tum --truth mocap.tum --align se3 --delta 1m
      locatk eval solved.mcap --truth mocap.csv --pair robot-785b=red --pair robot-dffa=blue
    """
    from locatk.cli.eval import text as eval_text
    from locatk.core.evaluation import Delta, EvaluationOptions, evaluate, pair_devices
    from locatk.formats.importers import trajectories as files

    pose_distance = Delta.parse(delta)
    mine = files.open_file(estimate)
    true = files.open_file(truth, role="truth")
    files.check_kinds(mine, true)
    if not mine.solved:
        if estimate.samefile(truth):
            raise InputError(
                "no solved poses", file=estimate, hint="Solve it first: `locatk solve`"
            )
        console.warn(f"{estimate} holds no solved poses: its truth is taken as the estimate")
    told = called(names)
    pairs, alone = pair_devices(mine.trajectories, true.trajectories, told)
    if not pairs:
        here, there = (
            ", ".join(each.device for each in side.trajectories) for side in (mine, true)
        )
        raise InputError(
            f"no device of the estimate is in {truth}",
            file=estimate,
            hint=f"Say by --pair NAME=NAME which of {here} is which of {there}",
        )
    named = not {mine.kind, true.kind} & set(files.EVO_KINDS)  # these name no device
    for ours, theirs in pairs:
        if named and theirs.device != ours.device and ours.device not in told:
            console.say(f"{ours.device} is compared with {theirs.device}, the only one there")
    if alone:
        console.warn(f"no truth for {', '.join(alone)}")
    as_evo = mine.kind in files.EVO_KINDS and true.kind in files.EVO_KINDS
    if match == "auto":
        match = "nearest" if as_evo else "interpolate"
    evaluation_options = EvaluationOptions(
        align=align,
        offset_s=offset,  # type: ignore[arg-type]
        match=match,
        max_diff_s=max_diff,
        # Rows of KITTI are stamped by the second.
        max_gap_s=max(1.0, max_gap) if mine.kind == "kitti" else max_gap,
        delta=pose_distance,
        all_pairs=all_pairs,
    )
    found = evaluate(pairs, evaluation_options)
    if found.time_offset.coarse_method == "first stamps":
        console.warn("the motions are too unlike to set the clocks by: the first stamps were used")
    if found.time_offset.alternatives:
        console.warn("the drive repeats itself, and the motion fits several offsets: give --offset")
    if as_json:
        facts = {"version": 1, "estimate": estimate, "truth": truth, **found.as_dict()}
        console.emit_json(facts)
    else:
        console.result(eval_text.text(found))


def called(names: tuple[str, ...]) -> dict[str, str]:
    """Names in the estimate to names in the truth, from `NAME=NAME`."""
    pairs = [name.partition("=") for name in names]
    for name, (mine, _, true) in zip(names, pairs, strict=True):
        if not mine or not true:
            raise click.BadParameter(f"{name!r} is not NAME=NAME.", param_hint="--pair")
    return {mine: true for mine, _, true in pairs}
