"""Subject of a report: a solution with its session, truth and evaluation, loaded from files."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from locatk.core.errors import FormatError, InputError, LocatkError
from locatk.core.evaluation import Evaluation, EvaluationOptions, evaluate, pair_devices
from locatk.core.natural_order import natural_key
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory
from locatk.formats.importers.poses import trajectories
from locatk.formats.plots.ground import is_unscaled, with_finite_positions
from locatk.formats.plots.series import overlap_in_time
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.solutions import read_solution
from locatk.formats.sessions.trajectories import read_truth


@dataclass(frozen=True)
class Subject:
    """One solution of a report.

    Attributes
    ----------
    name : str
        Name in the report, as in ``"run-solved.mcap"``.
    solution : Solution
    facts : mapping of str to str
        Metadata record of its file: tool version, command, source.
    session : Session or None
        The recording that was solved, for its signals; None if it is not available.
    truth : tuple of Trajectory
        Reference poses; empty if there are none.
    evaluation : Evaluation or None
        Errors with respect to the truth.
    obstacle : str
        Problem with the truth for which there is no evaluation; empty without any.
    """

    name: str
    solution: Solution
    facts: Mapping[str, str] = field(default_factory=dict)
    session: Session | None = None
    truth: tuple[Trajectory, ...] = ()
    evaluation: Evaluation | None = None
    obstacle: str = ""


def load_subject(
    path: str | os.PathLike[str],
    *,
    session: str | os.PathLike[str] | None = None,
    truth: str | os.PathLike[str] | None = None,
    align: str = "none",
    offset_s: float | Literal["auto"] = 0.0,
) -> Subject:
    """Read a solution, its session and the truth, and evaluate it.

    Parameters
    ----------
    path : path
        The solution.
    session : path, optional
        The recording that was solved; by default the session with the name that the solution
        contains, in the folder of the solution.
    truth : path, optional
        Reference poses in any format that `locatk eval` reads; by default those of the session.
    align : str
        One of :data:`locatk.core.evaluation.ALIGNMENTS`.
    offset_s : float or "auto"
        Added to the stamps of the solution, see :class:`locatk.core.evaluation.EvaluationOptions`.

    Raises
    ------
    MissingDataError, FormatError
        ``path`` is no solution, ``session`` no session, or ``truth`` contains no poses.
    InputError
        ``session`` is of another system.
    DegenerateError
        The poses do not determine the alignment or the offset.
    """
    solution, facts = read_solution(path), Session.open(path).facts
    if session is not None:
        recording: Session | None = _open_session(session, solution)
    else:
        recording = find_session(Path(path), facts, solution)
    return make_subject(
        Path(path).name, solution, facts, recording, truth=truth, align=align, offset_s=offset_s
    )


def make_subject(
    name: str,
    solution: Solution,
    facts: Mapping[str, str],
    recording: Session | None,
    *,
    truth: str | os.PathLike[str] | None = None,
    align: str = "none",
    offset_s: float | Literal["auto"] = 0.0,
) -> Subject:
    """Return the subject of a solution and its recording, evaluated.

    See :func:`load_subject` for the parameters and the errors.
    """
    solution = _sort_devices(solution)
    reference = () if truth is None else tuple(trajectories.read(Path(truth), role="truth"))
    # The truth of the session may be damaged: the report is on the solution.
    evaluation, obstacle = None, ""
    try:
        if truth is None and recording is not None:
            reference = tuple(read_truth(recording))
    except LocatkError as error:
        obstacle = f"The truth cannot be read: {error.message}."
    try:
        evaluation = _evaluate(solution, reference, align, offset_s)
    except InputError as error:
        if align != "none" or offset_s != 0.0:
            raise
        obstacle = f"The truth cannot be used: {error.message}."
    return Subject(name, solution, facts, recording, reference, evaluation, obstacle)


def _sort_devices(solution: Solution) -> Solution:
    """Return the solution with its devices in natural order, ``robot-2`` before ``robot-10``."""
    ordered = sorted(solution.trajectories, key=lambda t: natural_key(t.device))
    return replace(solution, trajectories=tuple(ordered))


def _open_session(path: str | os.PathLike[str], solution: Solution) -> Session:
    """Open the given recording of a solution; a damaged one is accepted."""
    session = Session.open(path, damaged_ok=True)
    if session.facts.get("kind") == "solution":
        raise FormatError(
            "a solution, not a session", file=path, hint="Give the recording that was solved"
        )
    system = session.facts.get("system", solution.system)
    if system != solution.system:
        raise InputError(
            f"a session of {system}, but the solution is of {solution.system}",
            file=path,
            hint="Give the recording that was solved",
        )
    return session


def find_session(path: Path, facts: Mapping[str, str], solution: Solution) -> Session | None:
    """Return the session that the solution names, in its folder; None if there is none.

    A file of this name from another time is another recording.
    """
    source = facts.get("source", "")
    if not source or Path(source).name != source:
        return None
    candidate = path.parent / source
    try:
        if not candidate.is_file() or candidate.samefile(path):
            return None
        session = Session.open(candidate, damaged_ok=True)
    except (LocatkError, OSError):
        return None
    is_session = session.facts.get("kind") != "solution"
    return session if is_session and overlap_in_time(session, solution) else None


def _evaluate(
    solution: Solution,
    truth: tuple[Trajectory, ...],
    align: str,
    offset_s: float | Literal["auto"],
) -> Evaluation | None:
    """Evaluate the solution; None if no device has truth, or lengths cannot be compared."""
    if is_unscaled(solution) and not align.startswith("sim"):
        return None
    solved = [t for t in map(with_finite_positions, solution.trajectories) if len(t)]
    pairs, _ = pair_devices(solved, [t for t in map(with_finite_positions, truth) if len(t)])
    if not pairs:
        return None
    return evaluate(pairs, EvaluationOptions(align=align, offset_s=offset_s))
