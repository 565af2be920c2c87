"""What a report is about: a solution, and all that is at hand to judge it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from locatk.core.evaluation import Evaluation
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory
from locatk.formats.sessions.reader import Session


@dataclass(frozen=True)
class Subject:
    """One solution of a report.

    Attributes
    ----------
    name : str
        How the report calls it, as in ``"run-solved.mcap"``.
    solution : Solution
    facts : mapping of str to str
        The metadata record of its file: tool version, command, source.
    session : Session or None
        The recording that was solved, for raw signals; None where it is not at hand.
    truth : tuple of Trajectory
        Reference poses; empty where there are none.
    evaluation : Evaluation or None
        Against that truth.
    """

    name: str
    solution: Solution
    facts: Mapping[str, str] = field(default_factory=dict)
    session: Session | None = None
    truth: tuple[Trajectory, ...] = ()
    evaluation: Evaluation | None = None
