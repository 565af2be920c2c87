"""``locatk eval``: poses against the truth."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, options
from locatk.core.errors import InputError

if TYPE_CHECKING:
    from locatk.core.trajectory import Trajectory

ALIGNMENTS = ("none", "se2", "se3", "sim2", "sim3")
"""As in :mod:`locatk.core.association`, which imports numpy (a test holds the two equal)."""


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
        if math.isfinite(seconds):
            return seconds
        self.fail(f"{value!r} is neither a number of seconds nor `auto`.", param, ctx)


@click.command(short_help="Compare poses with the truth.")
@options.input_argument("estimate")
@options.input_option(
    "--truth", required=True, metavar="FILE", help="Session with truth, or a TUM or CSV file."
)
@click.option(
    "--align",
    type=click.Choice(ALIGNMENTS),
    default="none",
    show_default=True,
    help="Fitted from estimate to truth on the scored poses, for all devices together.",
)
@click.option(
    "--offset",
    type=Offset(),
    default=0.0,
    show_default=True,
    metavar="SECONDS|auto",
    help="Added to the stamps of the estimate; `auto` estimates it on a part that is not scored.",
)
@options.as_json
@options.verbosity
def command(estimate: Path, truth: Path, align: str, offset: float | str, as_json: bool) -> None:
    """Compare the poses of ESTIMATE with a reference, device by device.

    ESTIMATE is a solution (.mcap), or a TUM or CSV file. Errors are distances: their
    mean (MAE), root mean square (RMSE), standard deviation (SD) and so on.

    \b
    Examples:
      locatk eval solved.mcap --truth run.mcap
      locatk eval solved.mcap --truth grid.mcap --align sim3 --json
      locatk eval solved.mcap --truth camera.tum --offset auto
    """
    from locatk.core import metrics

    pairs, alone = pair(read(estimate), read(truth, truth=True))
    if not pairs:
        raise InputError(
            f"no device of the estimate is in {truth}",
            file=estimate,
            hint="Compare what `locatk info` says of both",
        )
    if alone:
        console.warn(f"no truth for {', '.join(alone)}")
    facts = metrics.evaluate_all(pairs, align=align, offset_s=offset).as_dict()  # type: ignore[arg-type]
    if as_json:
        console.emit_json({"version": 1, "estimate": estimate, "truth": truth, **facts})
    else:
        console.result(text(facts))


def read(path: Path, *, truth: bool = False) -> list[Trajectory]:
    """Trajectories of a solution, of a session's truth, or of a TUM or CSV file.

    As ``truth``, another solution serves too.
    """
    from locatk.formats import trajectories
    from locatk.formats.session import Session
    from locatk.formats.solutions import read_trajectories

    kind = path.suffix.lower()
    if kind == ".csv":
        return trajectories.read_csv(path)
    if kind in (".tum", ".txt"):
        return [trajectories.read_tum(path)]
    solved = not truth or Session.open(path).facts.get("kind") == "solution"
    return read_trajectories(path, "solution" if solved else "truth")


def pair(
    estimates: list[Trajectory], truths: list[Trajectory]
) -> tuple[list[tuple[Trajectory, Trajectory]], list[str]]:
    """Estimate and truth of each device, and the devices that have no truth.

    By name; where there is just one of each, their names need not agree.
    """
    if len(estimates) == len(truths) == 1:
        return [(estimates[0], truths[0])], []
    by_name = {trajectory.device: trajectory for trajectory in truths}
    pairs = [(mine, by_name[mine.device]) for mine in estimates if mine.device in by_name]
    return pairs, [mine.device for mine in estimates if mine.device not in by_name]


STATISTICS = ("mae", "rmse", "sd", "median", "p95", "max")


def text(facts: dict[str, Any]) -> str:
    """The evaluation for people; lengths in mm."""
    rows = [("all", facts)] if len(facts["devices"]) > 1 else []
    rows += list(facts["devices"].items())
    table = console.table(
        ("device", "poses", *(f"{name.upper()} [mm]" for name in STATISTICS)),
        [
            (
                name,
                row["n"],
                *(_millimetres(row[f"{s}_m"]) if row["n"] else "-" for s in STATISTICS),
            )
            for name, row in rows
        ],
    )
    left_out = ", ".join(f"{count} {why}" for why, count in facts["unscored"].items() if count)
    return "\n".join(
        [
            table,
            f"alignment: {facts['align']}, fitted on {facts['align_fitted_on']}"
            + (f" (scale {facts['scale']:.6f})" if facts["align"].startswith("sim") else ""),
            f"time offset: {facts['offset_s']:.4f} s ({facts['offset_source']})",
            f"not scored: {left_out or 'nothing'}",
        ]
    )


def _millimetres(metres: float) -> str:
    """Three decimals; three digits below a tenth of a millimetre."""
    value = 1e3 * metres
    return f"{value:.3f}" if value >= 0.1 or value == 0 else f"{value:.3g}"
