"""Read, solve, write: one session or many, on the cores of a machine or on a Dask cluster.

Examples
--------
>>> from locatk.formats.pipeline import SolveRequest, solve_file
>>> report = solve_file("run.mcap", request=SolveRequest(method="paper"))  # doctest: +SKIP
"""

from locatk.formats.pipeline.batch import (
    OutputConflictError,
    check_outputs,
    plan_jobs,
    plan_outputs,
    solve_batch,
)
from locatk.formats.pipeline.outcome import Outcome, SolveFailure, SolveReport, summarize
from locatk.formats.pipeline.session_search import find_sessions
from locatk.formats.pipeline.solving import SolveJob, default_output, solve_file
from locatk.formats.pipeline.systems import (
    SYSTEMS,
    SolvedSession,
    SolveRequest,
    check_artifacts,
    solve_session,
)

__all__ = [
    "SYSTEMS",
    "Outcome",
    "OutputConflictError",
    "SolveFailure",
    "SolveJob",
    "SolveReport",
    "SolveRequest",
    "SolvedSession",
    "check_artifacts",
    "check_outputs",
    "default_output",
    "find_sessions",
    "plan_jobs",
    "plan_outputs",
    "solve_batch",
    "solve_file",
    "solve_session",
    "summarize",
]
