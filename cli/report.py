"""``locatk report``: one HTML page on solutions, and pictures of them."""

from __future__ import annotations

import itertools
from collections import Counter
from dataclasses import replace
from pathlib import Path

import click

from locatk.cli import console, options
from locatk.cli.command import Command, section
from locatk.cli.eval.command import align_option, offset_option
from locatk.core.printable import file_name_part

PAGE_SUFFIXES = (".html", ".htm")
PICTURE_SUFFIXES = (".png", ".pdf", ".svg")


@click.command(cls=Command, short_help="Write an HTML page about solutions.")
@click.argument("names", metavar="SOLUTIONS...", type=options.PATH, nargs=-1, required=True)
@options.output("Page (.html), or a picture only (.png, .pdf, .svg).")
@options.overwrite
@section(
    "Session and truth",
    options.input_option(
        "--session",
        "sessions",
        many=True,
        help="Session that was solved. Repeatable.  "
        "[default: the one that the solution names, in the same folder]",
    ),
    options.input_option(
        "--truth",
        metavar="FILE[#NAME]|FOLDER",
        callback=options.existing_poses,
        help="Reference poses: a session, a solution, or a file that `locatk eval` reads. In a "
        "folder, the file with the name of the session.  "
        "[default: those of the session]",
    ),
    align_option,
    offset_option,
)
@section(
    "Output",
    click.option("--png", is_flag=True, help="Also write a picture of each solution: report.png."),
    click.option("--pdf", is_flag=True, help="Also write a picture as PDF."),
    click.option("--svg", is_flag=True, help="Also write a picture as SVG."),
    options.open_page,
)
@options.as_json
@options.verbosity
def command(
    names: tuple[Path, ...],
    output: Path,
    sessions: tuple[Path, ...],
    truth: Path | None,
    align: str,
    offset: float | str,
    png: bool,
    pdf: bool,
    svg: bool,
    open_page: bool,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Show the quality of SOLUTIONS on one HTML page.

    The page is one file that opens in any browser without a network connection. It contains a map
    of the trajectories over the artifact, errors if there is truth, rejected observations with
    reasons, covariances, the recorded signals, and properties of the run. A folder stands for its
    solutions; a page on several begins with a table and small maps of all. The page is light or
    dark as the browser prefers; paper and pictures are light.

    \b
    Examples:
      locatk report solved.mcap -o report.html
      locatk report solved.mcap -o report.html --open
      locatk report solved.mcap -o report.html --truth camera.tum --align se3
      locatk report solved.mcap -o report.html --session /data/run.mcap --pdf
      locatk report bundle.mcap paper.mcap -o both.html --png
      locatk report solved/ -o all.html --truth recordings/
      locatk report solved.mcap -o figure.svg
    """
    from locatk.formats.evaluation import find_estimates, find_truth
    from locatk.formats.files import split_selection

    solutions = tuple(find_estimates(names)[0])
    options.must_exist(solutions)
    flags = zip(PICTURE_SUFFIXES, (png, pdf, svg), strict=True)
    page, pictures = plan_outputs(solutions, output, [suffix for suffix, on in flags if on])
    inputs = [*solutions, *sessions, *([] if truth is None else [split_selection(truth)[0]])]
    for path in [*([] if page is None else [page]), *(p for row in pictures for p in row)]:
        options.guard_output(path, overwrite=overwrite, inputs=inputs)
    session_of = _match_sessions(solutions, sessions)

    from locatk.formats.report.evaluation import why_not_evaluated
    from locatk.formats.report.subject import load_subject

    with console.working("Reading"):
        subjects = [
            load_subject(
                path,
                session=session,
                truth=None if truth is None else find_truth(path, truth),
                align=align,
                offset_s=offset,  # type: ignore[arg-type]
            )
            for path, session in zip(solutions, session_of, strict=True)
        ]
    count = Counter(subject.name for subject in subjects)
    subjects = [
        replace(subject, name=str(path)) if count[subject.name] > 1 else subject
        for subject, path in zip(subjects, solutions, strict=True)
    ]
    for subject in subjects:
        if subject.truth and subject.evaluation is None:
            console.warn(f"{subject.name}: {why_not_evaluated(subject)}")

    written = []
    with console.working("Drawing"):
        if page is not None:
            from locatk.formats.report.report import write_report

            write_report(page, subjects, overwrite=overwrite)
            written.append(page)
        for subject, row in zip(subjects, pictures, strict=True):
            for path in row:
                # matplotlib, which takes 0.5 s to import, is needed for pictures only.
                from locatk.formats.plots.picture import write_picture
                from locatk.formats.plots.series import origin_ns

                write_picture(
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
    if open_page:
        console.open_page(written[0])


def plan_outputs(
    solutions: tuple[Path, ...], output: Path, picture_suffixes: list[str]
) -> tuple[Path | None, list[list[Path]]]:
    """Return the page, None if only pictures are wanted, and the pictures of each solution."""
    suffix = output.suffix.lower()
    if suffix not in PAGE_SUFFIXES + PICTURE_SUFFIXES:
        names = ", ".join((PAGE_SUFFIXES[0], *PICTURE_SUFFIXES))
        raise click.UsageError(
            f"{output.name!r} is not the name of a page or a picture. Use one of {names}."
        )
    if suffix in PICTURE_SUFFIXES:
        page = None
        suffixes = list(dict.fromkeys([suffix, *picture_suffixes]))
    else:
        page = output
        suffixes = picture_suffixes
    if len(solutions) == 1:
        pictures = [
            output if not page and each == suffix else output.with_suffix(each) for each in suffixes
        ]
        return page, [pictures]
    return page, [
        [output.with_name(f"{output.stem}-{name}{each}") for each in suffixes]
        for name in _unique_names(solutions)
    ]


def _unique_names(paths: tuple[Path, ...]) -> list[str]:
    """Return the part of a file name for each path: its stem, numbered if an earlier one is equal.

    Names that differ only in case are equal, as on the file systems of macOS and Windows.
    """
    names: dict[str, str] = {}
    for path in paths:
        stem = file_name_part(path.stem)
        numbered = (f"{stem}-{number}" for number in itertools.count(2))
        candidates = itertools.chain([stem], numbered)
        name = next(name for name in candidates if name.casefold() not in names)
        names[name.casefold()] = name
    return list(names.values())


def _match_sessions(solutions: tuple[Path, ...], sessions: tuple[Path, ...]) -> list[Path | None]:
    """Return the session given for each solution: the only one, else that with its name."""
    if not sessions:
        return [None] * len(solutions)
    if len(solutions) == len(sessions) == 1:
        return [sessions[0]]
    from locatk.formats.sessions.reader import Session

    by_name = {path.name: path for path in sessions}
    if len(by_name) < len(sessions):
        raise click.UsageError("Two of the given sessions have the same name.")
    matched = [by_name.get(Session.open(path).facts.get("source", "")) for path in solutions]
    for path in sessions:
        if path not in matched:
            raise click.UsageError(f"No solution is from the session {path.name}.")
    return matched
