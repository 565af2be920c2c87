"""Raw signals of a recording with what was seen in them, whichever the system is."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module

from locatk.core.errors import LocatkError
from locatk.core.solution import Solution
from locatk.formats.report.panel import Panel
from locatk.formats.sessions.reader import Session

MODULES = {
    system: f"locatk.formats.report.signals_{system}"
    for system in ("lighthouse", "dots", "polaris", "landmarks")
}

TITLE = "Raw signals"


def panels(session: Session, solution: Solution) -> list[Panel]:
    """Raw signals of ``session`` with the detections of ``solution`` marked.

    Parameters
    ----------
    session : Session
        The recording; damaged, empty, or of something else than what was solved, it gives a
        panel that says so.
    solution : Solution
        What was made of it.

    Returns
    -------
    list of Panel
        One at least. Figures hold traces that browsers draw as SVG, no WebGL.
    """
    module = MODULES.get(solution.system)
    if module is None:
        return [Panel(TITLE, f"Signals of the system {solution.system!r} cannot be drawn.")]
    draw: Callable[[Session, Solution], list[Panel]] = import_module(module).panels
    try:
        found = draw(session, solution)
    except LocatkError as error:
        return [Panel(TITLE, f"The recording cannot be drawn: {error.message}.")]
    if found:
        return found
    recorded = session.facts.get("system")
    what = f"it is one of {recorded}" if recorded not in (None, solution.system) else "it has none"
    return [Panel(TITLE, f"No signals of {solution.system} in the recording: {what}.")]
