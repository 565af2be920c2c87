"""Subjects of a report, from files: the solution, its session, and the truth."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Literal

from locatk.core.errors import FormatError, InputError, LocatkError
from locatk.core.evaluation import Evaluation, EvaluationOptions, evaluate, pair_devices
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory
from locatk.formats.importers import trajectories as trajectory_files
from locatk.formats.plots.ground import has_no_scale, known
from locatk.formats.plots.time_axis import of_one_time
from locatk.formats.report.subject import Subject
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.solutions import read_solution
from locatk.formats.sessions.trajectories import read_truth


def load(
    path: str | os.PathLike[str],
    *,
    session: str | os.PathLike[str] | None = None,
    truth: str | os.PathLike[str] | None = None,
    align: str = "none",
    offset_s: float | Literal["auto"] = 0.0,
) -> Subject:
    """Read a solution and all that is at hand to judge it.

    Parameters
    ----------
    path : path
        The solution.
    session : path, optional
        The recording that was solved; by default the one beside the solution that bears the
        name which the solution says, where there is one.
    truth : path, optional
        Reference poses in any format that `locatk eval` reads; by default the session's.
    align : str
        One of :data:`locatk.core.evaluation.ALIGNMENTS`.
    offset_s : float or "auto"
        Added to the stamps of the solution, see :class:`locatk.core.evaluation.EvaluationOptions`.

    Raises
    ------
    MissingDataError, FormatError
        ``path`` is no solution, ``session`` no session, or ``truth`` holds none.
    InputError
        ``session`` is of another system.
    DegenerateError
        The poses do not determine the alignment or the offset.
    """
    solution = _by_name(read_solution(path))
    facts = Session.open(path).facts
    recording = _beside(Path(path), facts, solution)
    if session is not None:
        recording = Session.open(session, damaged_ok=True)
        if recording.facts.get("kind") == "solution":
            raise FormatError(
                "a solution, not a session", file=session, hint="Give the recording it was made of"
            )
        system = recording.facts.get("system", solution.system)
        if system != solution.system:
            raise InputError(
                f"a session of {system}, but the solution is of {solution.system}",
                file=session,
                hint="Give the recording that was solved",
            )
    if truth is not None:
        true = tuple(trajectory_files.read(Path(truth), role="truth"))
    else:
        true = () if recording is None else _truth_of(recording)
    evaluation = _evaluate(solution, true, align, offset_s)
    return Subject(Path(path).name, solution, facts, recording, true, evaluation)


def _by_name(solution: Solution) -> Solution:
    """The same with its devices in the order of their names, ``robot-2`` before ``robot-10``."""

    def parts(t: Trajectory) -> list[tuple[bool, int, str]]:
        found = re.findall(r"([0-9]+)|([^0-9]+)", t.device)
        return [(not digits, int(digits or 0), words) for digits, words in found]

    return replace(solution, trajectories=tuple(sorted(solution.trajectories, key=parts)))


def _beside(path: Path, facts: dict[str, str], solution: Solution) -> Session | None:
    """The session that the solution names, in the same folder; None where there is no such.

    A file of that name from another time is another recording.
    """
    source = facts.get("source", "")
    if not source or Path(source).name != source:
        return None
    there = path.parent / source
    try:
        if not there.is_file() or there.samefile(path):
            return None
        session = Session.open(there, damaged_ok=True)
    except (LocatkError, OSError):
        return None
    if session.facts.get("kind") == "solution":
        return None
    return session if of_one_time(session, solution) else None


def _truth_of(session: Session) -> tuple[Trajectory, ...]:
    """The session's truth, none where it cannot be read: the report is of the solution."""
    try:
        return tuple(read_truth(session))
    except LocatkError:
        return ()


def _evaluate(
    solution: Solution,
    truth: tuple[Trajectory, ...],
    align: str,
    offset_s: float | Literal["auto"],
) -> Evaluation | None:
    """None where no pose has truth, or lengths cannot be compared."""
    solved = [t for t in map(known, solution.trajectories) if len(t)]
    if has_no_scale(solution) and not align.startswith("sim"):
        return None
    pairs, _ = pair_devices(solved, [t for t in map(known, truth) if len(t)])
    if not pairs:
        return None
    try:
        return evaluate(pairs, EvaluationOptions(align=align, offset_s=offset_s))
    except InputError:
        if align == "none" and offset_s == 0.0:
            return None
        raise
