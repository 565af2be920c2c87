"""``locatk demo``: simulate, solve, evaluate and report, for each system."""

from __future__ import annotations

import shlex
import time
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import click

from locatk.cli import console, options
from locatk.cli.command import Command, section

SYSTEMS = ("lighthouse", "dots", "polaris", "landmarks")

REPORT = "report.html"


@click.command(cls=Command, short_help="Simulate, solve and evaluate, without hardware.")
@click.argument("systems", nargs=-1, metavar="[SYSTEM]...", type=click.Choice(SYSTEMS))
@options.output(
    f"Report to write (.html).  [default: {REPORT}, in the folder of --keep if given]",
    required=False,
    endings=(".html",),
)
@options.overwrite
@section(
    "Output",
    click.option(
        "--keep",
        type=options.PATH,
        metavar="FOLDER",
        help="Keep sessions, solutions, pictures and the sheets to print in this folder.",
    ),
    options.open_page,
)
@section(
    "Advanced",
    click.option(
        "--seed",
        type=click.IntRange(0),
        metavar="N",
        default=1,
        show_default=True,
        help="Seed of all random numbers.",
    ),
)
@options.as_json
@options.verbosity
def command(
    systems: tuple[str, ...],
    output: Path | None,
    keep: Path | None,
    open_page: bool,
    seed: int,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Simulate a session of each SYSTEM, solve it, compare it with the truth, and write a report.

    \b
    lighthouse  two robots under two stations at unknown positions
    dots        a camera over a printed A4 sheet with missing dots and dust
    polaris     magnetometers over three hand-made tags, among iron debris
    landmarks   a robot with four hall sensors over landmarks, one bar missing

    No hardware and no network are needed.

    \b
    Examples:
      locatk demo
      locatk demo dots -o dots.html
      locatk demo --open
      locatk demo --keep demo
      locatk demo --seed 7 --json
    """
    from locatk.formats.report.report import write_report

    chosen = [name for name in SYSTEMS if name in systems or not systems]
    report = output or (keep or Path()) / REPORT
    if keep is None:
        options.guard_output(report, overwrite=overwrite)
    else:
        outputs = [report, *(path for name in chosen for path, _ in kept(keep, name))]
        options.prepare_folder(keep, outputs, overwrite=overwrite, option="--keep")

    start = time.perf_counter()
    folder: AbstractContextManager[str | Path] = (
        TemporaryDirectory(prefix="locatk-demo-") if keep is None else nullcontext(keep)
    )
    with folder as root:
        results = [
            run_system(Path(root), name, seed, keep is not None, overwrite) for name in chosen
        ]
        with console.working("Reporting"):
            write_report(report, [subject for _, subject in results], overwrite=overwrite)
    rows = [row for row, _ in results]
    took_s = time.perf_counter() - start

    files = [] if keep is None else [item for name in chosen for item in kept(keep, name)]
    if as_json:
        console.emit_json(
            {
                "version": 1,
                "systems": rows,
                "report": report,
                "files": [{"path": path, "next": words} for path, words in files],
                "took_s": took_s,
            }
        )
        if open_page:
            console.open_page(report)
        return
    console.result(table(rows))
    console.say("error: mean distance from the truth, without alignment")
    hint = "" if open_page else ": open it in a browser"
    console.result(f"Wrote {report} in {took_s:.0f} s{hint}")
    if open_page:
        console.open_page(report)
    if files:
        width = max(len(str(path)) for path, _ in files)
        for path, words in files:
            console.result(f"{path!s:<{width}}  {words}")


def table(rows: list[dict[str, Any]]) -> str:
    """Format a row for each system."""

    def mm(metres: float | None) -> str:
        return "-" if metres is None else f"{1e3 * metres:.2g}"

    return console.table(
        ("system", "poses", "error [mm]", "published algorithm [mm]", "time [s]"),
        [
            (
                row["system"],
                row["poses"],
                mm(row["mae_m"]),
                mm(row["paper_mae_m"]),
                f"{row['solve_s']:.2f}",
            )
            for row in rows
        ],
    )


def kept(folder: Path, system: str) -> list[tuple[Path, str]]:
    """Return the files of a system that ``--keep`` leaves, each with a command to try next."""
    from locatk.cli.demo.sessions import PRINTED

    session, solution = folder / f"{system}.mcap", folder / f"{system}-solved.mcap"
    tries = [
        (session, f"locatk info {_quoted(session)}"),
        (solution, f"locatk eval {_quoted(solution)} --truth {_quoted(session)}"),
        (folder / f"{system}.png", f"locatk report {_quoted(solution)} -o {system}.svg"),
    ]
    if system in PRINTED:
        tries.append((folder / PRINTED[system], "print it at 100 %, without fitting to the page"))
    return tries


def _quoted(path: Path) -> str:
    return shlex.quote(str(path))


def run_system(
    folder: Path, system: str, seed: int, is_kept: bool, overwrite: bool
) -> tuple[dict[str, Any], Any]:
    """Simulate, solve and evaluate one system; return its row of the table, and its report."""
    from locatk.cli.demo.sessions import MAKERS, PRINTED, SPEED_MPS
    from locatk.core.evaluation import evaluate, pair_devices
    from locatk.formats.pipeline import SolveRequest, solve_session
    from locatk.formats.pipeline.provenance import command_line, source_facts
    from locatk.formats.plots.series import origin_ns
    from locatk.formats.report.subject import load_subject
    from locatk.formats.sessions import solutions

    session, solution = folder / f"{system}.mcap", folder / f"{system}-solved.mcap"
    with console.working(f"Simulating {system}"):
        truths, draw_sheet = MAKERS[system](folder, seed, overwrite)
    with console.working(f"Solving {system}"):
        solved = solve_session(session, SolveRequest())
        speed = SPEED_MPS if system == "polaris" else None
        paper = solve_session(session, SolveRequest(method="paper", speed=speed))
        facts = {**source_facts(session), "command": command_line(session.name, SolveRequest())}
        solutions.write_solution(
            solution, solved.solution, source=session, facts=facts, overwrite=overwrite
        )
    subject = load_subject(solution, session=session)
    if is_kept:
        from locatk.formats.output import atomic_write
        from locatk.formats.plots.picture import write_picture

        with console.working(f"Drawing {system}"):
            if draw_sheet is not None:
                with atomic_write(folder / PRINTED[system], overwrite=overwrite) as stream:
                    stream.write(draw_sheet())
            write_picture(
                folder / f"{system}.png",
                solved.solution,
                truth=truths,
                start_ns=origin_ns(subject.session, solved.solution),
                overwrite=overwrite,
            )
    pairs, _ = pair_devices([t for t in paper.solution.trajectories if len(t)], truths)
    row = {
        "system": system,
        "poses": solved.solution.poses,
        "mae_m": None if subject.evaluation is None else subject.evaluation.mae,
        "paper_mae_m": evaluate(pairs).mae if pairs else None,
        "solve_s": solved.solve_s,
    }
    return row, subject
