"""Reports: one HTML file on one or several solutions, which needs no network."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence

from locatk.formats.output import atomic_write, check_output, tool_version
from locatk.formats.plots.series import origin_ns, overlap_in_time, pose_span_ns
from locatk.formats.plots.units import format_time
from locatk.formats.report import page
from locatk.formats.report.detections import detection_panel
from locatk.formats.report.evaluation import (
    covariance_panels,
    error_panels,
    key_figures,
    summarize,
)
from locatk.formats.report.overview import overview
from locatk.formats.report.panels import Panel
from locatk.formats.report.rejections import rejection_panel
from locatk.formats.report.run import run_panels
from locatk.formats.report.signals import SIGNALS_TITLE, signal_panels
from locatk.formats.report.subject import Subject
from locatk.formats.report.trajectory_map import map_panels, split_frames


def write_report(
    path: str | os.PathLike[str], subjects: Sequence[Subject], *, overwrite: bool = False
) -> None:
    """Write a report; the same subjects result in the same bytes.

    Parameters
    ----------
    path : path
        The output, an HTML file.
    subjects : sequence of Subject
        In the order of the page; see :func:`locatk.formats.report.subject.load_subject`.
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    OutputExistsError, MissingDataError
        See :func:`locatk.formats.output.atomic_write`.
    """
    check_output(path, overwrite=overwrite)
    content = render_report(subjects).encode()
    with atomic_write(path, overwrite=overwrite) as stream:
        stream.write(content)


def render_report(subjects: Sequence[Subject]) -> str:
    """Return the page as text."""
    is_single = len(subjects) == 1
    title = subjects[0].name if is_single else f"{len(subjects)} solutions"
    body = [
        "<header>",
        page.paragraph("locatk report", "brand"),
        f"<h1>{page.text(title)}</h1>",
        "" if is_single else overview(subjects),
        "</header>",
        "<main>",
    ]
    for k, subject in enumerate(subjects, start=1):
        body.append(f'<article class="subject" id="s{k}">')
        if not is_single:
            body.append(f"<h2>{page.text(subject.name)}</h2>")
            body.append('<p class="back"><a href="#overview">All solutions</a></p>')
        body += _article(subject, f"s{k}")
        body.append("</article>")
    body.append("</main>")
    body.append(
        f"<footer>Made by locatk {page.text(tool_version())}. Drag to zoom, double-click to show "
        "everything, click a name in a legend to hide it. This file is complete.</footer>"
    )
    return page.document(f"{title} - locatk report", body)


def _article(subject: Subject, ident: str) -> Iterator[str]:
    """Yield the parts of the page on one subject."""
    yield page.paragraph(_describe_run(subject), "sub")
    yield page.paragraph(summarize(subject), "verdict")
    yield page.tiles(key_figures(subject))
    yield page.notes("Warnings", [each.message for each in subject.solution.warnings])
    for k, panel in enumerate(report_panels(subject), start=1):
        yield page.panel(panel, f"{ident}-{k}")
    command = subject.facts.get("command")
    if command:
        inner = ["<h3>Command</h3>", page.command(command, f"{ident}-line")]
        yield page.section(inner, f"{ident}-command")


def report_panels(subject: Subject) -> list[Panel]:
    """Return all panels of a subject in their order."""
    return [
        *_map_panels(subject),
        *error_panels(subject),
        *covariance_panels(subject),
        detection_panel(subject.solution),
        rejection_panel(subject.solution),
        *_signal_panels(subject),
        *run_panels(subject),
    ]


def _map_panels(subject: Subject) -> list[Panel]:
    """Return a map for each frame with poses; positions in two frames cannot share a map."""
    start_ns = origin_ns(subject.session, subject.solution)
    frames = split_frames(subject.solution, subject.truth, subject.evaluation)
    panels = []
    for frame, solution, ground in frames:
        title = "Trajectory" if len(frames) == 1 else f"Trajectory in {frame}"
        panels += map_panels(solution, ground, start_ns, title)
    return panels


def _signal_panels(subject: Subject) -> list[Panel]:
    """Return the signals of the recording, or why they are not shown."""
    session = subject.session
    if session is None:
        source = subject.facts.get("source")
        problem = (
            f"The session {source} is not in the folder of the solution"
            if source
            else "The solution does not name its session"
        )
        note = f"{problem}: its signals are not shown. --session FILE adds them."
        return [Panel(SIGNALS_TITLE, note)]
    if not overlap_in_time(session, subject.solution):
        return [
            Panel(
                SIGNALS_TITLE,
                "The session is from another time than the poses: its signals are not shown. It "
                f"begins {format_time(session.start_ns or 0)}.",
            )
        ]
    return signal_panels(session, subject.solution)


def _describe_run(subject: Subject) -> str:
    """Return a line on system, method, source and time."""
    solution = subject.solution
    source = subject.facts.get("source")
    parts = [f"{solution.system} by {solution.method}" + (f", from {source}" if source else "")]
    span_ns = pose_span_ns(solution)
    if span_ns is not None:
        parts.append(f"{(span_ns[1] - span_ns[0]) * 1e-9:.1f} s of poses")
    start_ns = origin_ns(subject.session, solution)
    if start_ns:
        is_session = subject.session is not None and subject.session.start_ns == start_ns
        origin = "the start of the recording" if is_session else "the first pose"
        parts.append(f"time 0 is {origin}, {format_time(start_ns)}")
    return " \u00b7 ".join(parts)
