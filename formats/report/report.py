"""Reports: one HTML file of one or several solutions, that opens anywhere, offline."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import replace

from locatk.core.errors import LocatkError
from locatk.core.solution import Solution
from locatk.formats.output import atomic_write, check_output, tool_version
from locatk.formats.plots.ground import ground_of
from locatk.formats.plots.time_axis import of_one_time, origin_ns, span, when
from locatk.formats.plots.units import length, thousands
from locatk.formats.report import detections as seen
from locatk.formats.report import evaluation as judgement
from locatk.formats.report import page, run_facts, signals
from locatk.formats.report.figures_map import map_panels
from locatk.formats.report.panel import Panel
from locatk.formats.report.subject import Subject

GIVE_SESSION = "--session FILE gives it."


def write_report(
    path: str | os.PathLike[str], subjects: Sequence[Subject], *, overwrite: bool = False
) -> None:
    """Write a report; the same subjects give the same bytes.

    Parameters
    ----------
    path : path
        The output, an HTML file that needs nothing else.
    subjects : sequence of Subject
        In this order; see :func:`locatk.formats.report.subjects.load`.
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    OutputExistsError, MissingDataError
        See :func:`locatk.formats.output.atomic_write`.
    """
    check_output(path, overwrite=overwrite)
    written = render(subjects).encode()
    with atomic_write(path, overwrite=overwrite) as stream:
        stream.write(written)


def render(subjects: Sequence[Subject]) -> str:
    """The page as text."""
    one = len(subjects) == 1
    title = subjects[0].name if one else f"{len(subjects)} solutions"
    body = [
        "<header>",
        page.paragraph("locatk report", "brand"),
        f"<h1>{page.text(title)}</h1>",
        *([] if one else [overview(subjects)]),
        "</header>",
        "<main>",
    ]
    for k, subject in enumerate(subjects, start=1):
        body.append(f'<article class="subject" id="s{k}">')
        if not one:
            body.append(f"<h2>{page.text(subject.name)}</h2>")
        body += _article(subject, f"s{k}")
        body.append("</article>")
    body.append("</main>")
    body.append(
        f"<footer>Made by locatk {page.text(tool_version())}. Drag to zoom, double-click to see "
        "all, click a name in a legend to hide it. This file holds all it needs.</footer>"
    )
    return page.document(f"{title} - locatk report", body)


def _article(subject: Subject, ident: str) -> Iterator[str]:
    """What the page says of one subject."""
    yield page.paragraph(_what(subject), "sub")
    yield page.paragraph(judgement.verdict(subject), "verdict")
    yield page.tiles(judgement.key_figures(subject))
    yield page.notes(
        "What the poses stand on", [each.message for each in subject.solution.warnings]
    )
    for k, panel in enumerate(panels(subject), start=1):
        yield page.panel(panel, f"{ident}-{k}")
    line = subject.facts.get("command")
    if line:
        inner = ["<h3>The command that made it</h3>", page.command(line, f"{ident}-line")]
        yield page.section(inner, f"{ident}-command")


def panels(subject: Subject) -> list[Panel]:
    """All panels of a subject, in their order."""
    found = _maps(subject)
    found += judgement.error_panels(subject)
    found += judgement.sigma_panels(subject)
    found += seen.panels(subject.solution)
    found += _signals(subject)
    return found + run_facts.run_panels(subject)


def _signals(subject: Subject) -> list[Panel]:
    """What was recorded, or why it is not shown."""
    source = subject.facts.get("source", "")
    if subject.session is None:
        missing = f"The session {source} is not beside" if source else "No session is named in"
        return [
            Panel("Signals", f"{missing} the solution: its signals are not shown. {GIVE_SESSION}")
        ]
    if not of_one_time(subject.session, subject.solution):
        other = "The session is of another time than the poses: its signals are not shown."
        return [Panel("Signals", f"{other} It begins {when(subject.session.start_ns or 0)}.")]
    try:
        return signals.panels(subject.session, subject.solution)
    except LocatkError as error:
        # The report is of the solution, which is whole.
        return [Panel("Signals", f"The session cannot be shown: {error}. {error.hint or ''}")]


def _maps(subject: Subject) -> list[Panel]:
    """A map for each frame in which there are poses: places in two frames share no map."""
    solution = subject.solution
    start = origin_ns(subject.session, solution)
    frames = list(dict.fromkeys(t.frame for t in solution.trajectories))
    if len(frames) < 2:
        ground = ground_of(solution, subject.truth, subject.evaluation)
        return map_panels(solution, ground, start)
    found = []
    for frame in frames:
        part = _in_frame(solution, frame)
        names = {t.device for t in part.trajectories}
        truth = [t for t in subject.truth if t.device in names]
        ground = ground_of(part, truth, subject.evaluation)
        found += map_panels(part, ground, start, f"Path in {frame}")
    return found


def _in_frame(solution: Solution, frame: str) -> Solution:
    return replace(
        solution, trajectories=tuple(t for t in solution.trajectories if t.frame == frame)
    )


def _what(subject: Subject) -> str:
    """A line on what was solved."""
    solution = subject.solution
    parts = [f"{solution.system} by {solution.method}"]
    source = subject.facts.get("source")
    if source:
        parts[0] += f", from {source}"
    times = span(solution)
    if times is not None:
        parts.append(f"{(times[1] - times[0]) * 1e-9:.1f} s of poses")
    start = origin_ns(subject.session, solution)
    if start:
        of_session = subject.session is not None and subject.session.start_ns == start
        what = "the start of the recording" if of_session else "the first pose"
        parts.append(f"time 0 is {what}, {when(start)}")
    return " \u00b7 ".join(parts)


def overview(subjects: Sequence[Subject]) -> str:
    """A table of all subjects, each a link to its part of the page."""
    head = "".join(f"<th>{name}</th>" for name in ("solution", "system", "method"))
    head += "".join(
        f'<th class="number">{name}</th>' for name in ("poses", "APE median", "APE p95", "rejected")
    )
    rows = []
    for k, subject in enumerate(subjects, start=1):
        solution, evaluation = subject.solution, subject.evaluation
        unit = judgement.unscaled(subject)
        errors = (
            ("-", "-")
            if evaluation is None
            else tuple(
                length(value, unscaled=unit) for value in (evaluation.median, evaluation.p95)
            )
        )
        rejected = sum(solution.rejected.values())
        numbers = (thousands(solution.poses), *errors, thousands(rejected))
        rows.append(
            f'<tr><td><a href="#s{k}">{page.text(subject.name)}</a></td>'
            f"<td>{page.text(solution.system)}</td><td>{page.text(solution.method)}</td>"
            + "".join(f'<td class="number">{page.text(number)}</td>' for number in numbers)
            + "</tr>"
        )
    return (
        f'<nav class="table"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></nav>"
    )
