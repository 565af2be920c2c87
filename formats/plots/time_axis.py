"""Time as pictures and pages show it: where their axes begin, and how a moment is said."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from locatk.core.solution import Solution
    from locatk.formats.sessions.reader import Session

SLACK_NS = 5_000_000_000
"""Poses may be stamped a little before or after the messages they are made of."""


def span(solution: Solution) -> tuple[int, int] | None:
    """Times of the first and the last pose in ns; None where there is no pose."""
    ends = [(int(t.time_ns[0]), int(t.time_ns[-1])) for t in solution.trajectories if len(t)]
    return (min(a for a, _ in ends), max(b for _, b in ends)) if ends else None


def of_one_time(session: Session, solution: Solution) -> bool:
    """Whether poses are of the time of a recording, as far as both tell theirs."""
    poses = span(solution)
    if poses is None or session.start_ns is None or session.end_ns is None:
        return True
    first, last = poses
    return last >= session.start_ns - SLACK_NS and first <= session.end_ns + SLACK_NS


def origin_ns(session: Session | None, solution: Solution) -> int:
    """Where all time axes of a solution begin: with its recording where that is at hand, else
    with the first pose."""
    if session is not None and session.start_ns is not None and of_one_time(session, solution):
        return session.start_ns
    poses = span(solution)
    return 0 if poses is None else poses[0]


def when(time_ns: int) -> str:
    """A time for people, in UTC; with milliseconds where there are some."""
    try:
        moment = datetime.fromtimestamp(0, UTC) + timedelta(microseconds=time_ns // 1000)
    except OverflowError:
        return f"{time_ns} ns"
    milliseconds = f".{moment.microsecond // 1000:03d}".removesuffix(".000")
    return f"{moment:%Y-%m-%d %H:%M:%S}{milliseconds} UTC"
