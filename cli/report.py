"""``locatk report``: solutions as one page to look at and to share."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import click

from locatk.cli import console, options
from locatk.cli.eval.command import align_option, offset_option

PAGES = (".html", ".htm")
PICTURES = (".png", ".pdf", ".svg")


@click.command(short_help="Show solutions on one page that opens anywhere.")
@options.input_argument("solutions", many=True)
@options.output("Page to write (.html), or just a picture (.png, .pdf, .svg).")
@options.input_option(
    "--session",
    "sessions",
    many=True,
    metavar="FILE",
    help="The recording that was solved. [default: the one that the solution names, beside it]",
)
@options.input_option(
    "--truth",
    metavar="FILE",
    help="Reference poses: a session, a solution, TUM, KITTI or CSV. [default: the session's]",
)
@align_option
@offset_option
@click.option("--png", is_flag=True, help="Write pictures beside the page too: report.png.")
@click.option("--pdf", is_flag=True, help="The same as PDF.")
@click.option("--svg", is_flag=True, help="The same as SVG.")
@options.overwrite
@options.as_json
@options.verbosity
def command(
    solutions: tuple[Path, ...],
    output: Path,
    sessions: tuple[Path, ...],
    truth: Path | None,
    align: str,
    offset: float | str,
    png: bool,
    pdf: bool,
    svg: bool,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Show SOLUTIONS on one page: is it good, and what does it stand on?

    The page is one file that opens in any browser without a network: the path over the
    artifact, errors where there is truth, what was rejected and why, covariances, raw
    signals, and the facts of the run. A solution's session is found beside it.

    \b
    Examples:
      locatk report solved.mcap -o report.html
      locatk report solved.mcap -o report.html --truth camera.tum --align se3
      locatk report solved.mcap -o report.html --session /data/run.mcap --pdf
      locatk report bundle.mcap paper.mcap -o both.html --png
      locatk report solved.mcap -o figure.svg
    """
    kinds = [kind for kind, wanted in zip(PICTURES, (png, pdf, svg), strict=True) if wanted]
    page, pictures = plan(solutions, output, kinds)
    inputs = [*solutions, *sessions, *([] if truth is None else [truth])]
    for path in [*([] if page is None else [page]), *(p for row in pictures for p in row)]:
        options.guard_output(path, overwrite=overwrite, inputs=inputs)
    given = _sessions_of(solutions, sessions)

    from locatk.formats.report import subjects

    with console.working("Reading"):
        found = [
            subjects.load(path, session=session, truth=truth, align=align, offset_s=offset)  # type: ignore[arg-type]
            for path, session in zip(solutions, given, strict=True)
        ]
    count = Counter(subject.name for subject in found)
    found = [
        replace(subject, name=str(path)) if count[subject.name] > 1 else subject
        for subject, path in zip(found, solutions, strict=True)
    ]
    for subject in found:
        if subject.truth and subject.evaluation is None:
            from locatk.formats.report.evaluation import why_unjudged

            console.warn(f"{subject.name}: {why_unjudged(subject)}")
    written = []
    with console.working("Drawing"):
        if page is not None:
            from locatk.formats.report.report import write_report

            write_report(page, found, overwrite=overwrite)
            written.append(page)
        for subject, row in zip(found, pictures, strict=True):
            for path in row:
                from locatk.formats.plots.solution import plot_solution
                from locatk.formats.plots.time_axis import origin_ns

                plot_solution(
                    path,
                    subject.solution,
                    truth=subject.truth,
                    evaluation=subject.evaluation,
                    start_ns=origin_ns(subject.session, subject.solution),
                    overwrite=overwrite,
                )
                written.append(path)
    if as_json:
        console.emit_json({"version": 1, "files": [str(path) for path in written]})
    for path in written:
        console.result(f"Wrote {path}")


def plan(
    solutions: tuple[Path, ...], output: Path, kinds: list[str]
) -> tuple[Path | None, list[list[Path]]]:
    """The page, None where only pictures are wanted, and the pictures of each solution."""
    suffix = output.suffix.lower()
    if suffix not in PAGES + PICTURES:
        raise click.UsageError(
            f"{output.name!r} is neither a page nor a picture: end its name with "
            f"{', '.join((PAGES[0], *PICTURES))}."
        )
    page = output if suffix in PAGES else None
    wanted = list(dict.fromkeys(([] if page else [suffix]) + kinds))
    names = [""]
    if len(solutions) > 1:
        count: Counter[str] = Counter()
        names = []
        for path in solutions:
            count[path.stem] += 1
            twin = f"-{count[path.stem]}" if count[path.stem] > 1 else ""
            names.append(f"-{path.stem}{twin}")
    pictures = [
        [
            output
            if not page and not name and kind == suffix
            else output.with_name(f"{output.stem}{name}{kind}")
            for kind in wanted
        ]
        for name in names
    ]
    return page, pictures


def _sessions_of(solutions: tuple[Path, ...], sessions: tuple[Path, ...]) -> list[Path | None]:
    """The session given for each solution: the only one for the only one, else by its name."""
    if not sessions:
        return [None] * len(solutions)
    if len(solutions) == len(sessions) == 1:
        return [sessions[0]]
    from locatk.formats.sessions.reader import Session

    by_name = {path.name: path for path in sessions}
    if len(by_name) < len(sessions):
        raise click.UsageError("Two of the --session have the same name.")
    found = [by_name.get(Session.open(path).facts.get("source", "")) for path in solutions]
    for path in sessions:
        if path not in found:
            raise click.UsageError(f"No solution was made of --session {path.name}.")
    return found
