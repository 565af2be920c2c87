"""One session from recording to solution: read, solve, write.

A :class:`SolveJob` is all that is needed to solve one session. :func:`run_job` depends on the job
alone and writes its output completely or not at all, so that it may run in any process on any
machine, and again if a process died. :func:`solve_file` is the same for a single call.
"""

from __future__ import annotations

import contextlib
import tempfile
import traceback
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from locatk.core.errors import InputError, LocatkError, OutputExistsError
from locatk.core.printable import is_one_line
from locatk.core.solution import Solution
from locatk.formats.artifacts import scene as scene_files
from locatk.formats.pipeline import execution, file_access, file_names, provenance
from locatk.formats.pipeline.outcome import (
    Outcome,
    SolveFailure,
    SolveReport,
    portable_error,
    summarize,
)
from locatk.formats.pipeline.systems import SolveRequest, solve_session
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.solutions import write_solution


@dataclass(frozen=True)
class SolveJob:
    """One session to solve.

    Attributes
    ----------
    session, output : str
        Locations as the user gave them, for messages.
    source, target : str
        The same as absolute paths or URLs.
    request : SolveRequest
        Options of the solver.
    options_sha256 : str
        Digest of the request and of the files in it.
    overwrite : bool
        Replace an existing output.
    resume : bool
        Keep an output that is the same solution, and replace an outdated one.
    scene_output : Path, optional
        Additional file for the estimated scene (.toml).
    carried_files : tuple of (str, str, bytes)
        Files of the request that travel with the job: name of the option, file name, content.
    scratch : str, optional
        Folder for temporary files.
    with_detections : bool
        The report contains all detections and facts. Otherwise it contains only what the tables
        of `locatk solve` show, which travels faster between processes.
    """

    session: str
    output: str
    source: str
    target: str
    request: SolveRequest
    options_sha256: str
    overwrite: bool = False
    resume: bool = False
    scene_output: Path | None = None
    carried_files: tuple[tuple[str, str, bytes], ...] = ()
    scratch: str | None = None
    with_detections: bool = True


def plan_job(
    session: str,
    output: str,
    request: SolveRequest,
    *,
    options_sha256: str | None = None,
    **fields: Any,
) -> SolveJob:
    """Return the job for a session.

    Parameters
    ----------
    session, output : str
        Locations as the user gave them.
    request : SolveRequest
    options_sha256 : str, optional
        Digest of the request, if it is known from another job; computed by default.
    fields
        Further attributes of :class:`SolveJob`.
    """
    return SolveJob(
        session,
        output,
        file_names.absolute(session),
        file_names.absolute(output),
        request,
        options_sha256 or provenance.options_digest(request),
        **fields,
    )


def default_output(session: str) -> str:
    """Return the location of the solution in the folder of the session."""
    return file_names.sibling(session, f"{file_names.stem(session)}-solved.mcap")


def solve_file(
    session: str | Path,
    output: str | Path | None = None,
    request: SolveRequest | None = None,
    *,
    overwrite: bool = False,
    resume: bool = False,
) -> SolveReport:
    """Solve a recorded session and write its solution.

    Parameters
    ----------
    session : path or URL
        Session (.mcap) of any system.
    output : path or URL, optional
        Solution to write; ``<session>-solved.mcap`` by default.
    request : SolveRequest, optional
        Options of the solver.
    overwrite : bool
        Replace an existing output.
    resume : bool
        Keep the output if it was solved from the same session with the same options and version.

    Raises
    ------
    LocatkError
        The session cannot be read or solved, or the output cannot be written. A note of the
        exception (PEP 678) contains the traceback of its cause.

    Examples
    --------
    >>> report = solve_file("run.mcap", "solved.mcap")  # doctest: +SKIP
    >>> report.poses  # doctest: +SKIP
    1200
    """
    location = str(session)
    job = plan_job(
        location,
        default_output(location) if output is None else str(output),
        request or SolveRequest(),
        overwrite=overwrite,
        resume=resume,
    )
    if not resume:
        file_access.check_writable(job.target, overwrite=overwrite)
    outcome = run_job(job)
    if isinstance(outcome, SolveFailure):
        outcome.error.add_note(outcome.traceback)
        raise outcome.error
    return outcome


def run_job(job: SolveJob) -> Outcome:
    """Solve the session of a job and write its solution; every exception gives a failure."""
    user_names: dict[str, str] = {job.source: job.session, job.target: job.output}
    try:
        with contextlib.ExitStack() as stack:
            return _run_steps(job, stack, user_names)
    except Exception as error:  # The other sessions of a batch are solved nevertheless.
        known = _as_known_error(error, job.session)
        cause = portable_error(known or _internal_error(error, job.session), user_names)
        is_internal = known is None
        return SolveFailure(job.session, cause, traceback.format_exc(), is_internal)


def _as_known_error(error: Exception, session: str) -> LocatkError | None:
    """Return an error with a message for people; None for an error of the program."""
    if isinstance(error, LocatkError):
        return error
    if isinstance(error, OSError):
        return LocatkError(error.strerror or str(error), file=error.filename or session)
    if isinstance(error, MemoryError):
        hint = "Solve shorter sessions, or fewer at a time"
        return LocatkError("not enough memory", file=session, hint=hint)
    return None


def _internal_error(error: Exception, session: str) -> LocatkError:
    return LocatkError(
        f"internal error, {type(error).__name__}: {error}",
        file=session,
        hint="Please report it, with its traceback",
    )


def _run_steps(
    job: SolveJob, stack: contextlib.ExitStack, user_names: dict[str, str]
) -> SolveReport:
    """Fetch, solve and write; enter the names of temporary files into ``user_names``."""
    for location in (job.session, job.output):
        if not file_names.is_utf8(location):
            raise InputError("the file name is not UTF-8", file=location, hint="Rename the file")
        if not is_one_line(location):
            raise InputError("a line end in the file name", file=location, hint="Rename the file")
    scratch = job.scratch or execution.worker_folder()
    path = stack.enter_context(file_access.local(job.source, scratch))
    user_names[str(path)] = job.session
    request = _unpack_files(job, scratch, stack, user_names)
    Session.open(path)  # A damaged file is refused before all of its bytes are read.
    facts = {**provenance.source_facts(path), "options_sha256": job.options_sha256}

    def existing_solution() -> tuple[Solution | None, bool]:
        """Return the solution at the target if it is of this job, and if it may be replaced."""
        with file_access.local(job.target, scratch) as old:
            return (
                provenance.same_solution(old, facts),
                provenance.is_replaceable(old, path.name),
            )

    overwrite, existing, solve_s = job.overwrite, None, None
    # Callers check the output first: if it exists now, an earlier attempt at this job, whose worker
    # was lost, may have written it.
    if file_access.exists(job.target) and (job.resume or not overwrite):
        existing, is_replaceable = existing_solution()
        if existing is None:
            overwrite = overwrite or (job.resume and is_replaceable)
            file_access.check_writable(job.target, overwrite=overwrite)
    elif not file_names.is_url(job.target):  # Its folder may be gone since the batch began.
        file_access.check_writable(job.target, overwrite=overwrite)
    if existing is not None:
        solution = existing
    else:
        solved = solve_session(path, request)
        solution, solve_s = solved.solution, solved.solve_s
        facts["command"] = provenance.command_line(path.name, job.request)
        try:
            with file_access.writing(job.target, scratch, overwrite=overwrite) as target:
                user_names[str(target)] = job.output
                write_solution(target, solution, source=path, facts=facts, overwrite=overwrite)
        except OutputExistsError:
            # A worker that was considered lost may have written the same solution meanwhile.
            existing, _ = existing_solution()
            if existing is None:
                raise
    if job.scene_output is not None and (existing is None or not job.scene_output.exists()):
        scene_files.write_scene(job.scene_output, solution.artifact, overwrite=job.overwrite)
    return summarize(
        job.session, job.output, solution, solve_s, with_detections=job.with_detections
    )


def _unpack_files(
    job: SolveJob,
    scratch: str | None,
    stack: contextlib.ExitStack,
    user_names: dict[str, str],
) -> SolveRequest:
    """Write the carried files to temporary folders and return the request with their paths."""
    request = job.request
    for option, name, content in job.carried_files:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="locatk-", dir=scratch))
        copy = Path(folder) / name
        copy.write_bytes(content)
        user_names[str(copy)] = str(getattr(request, option))
        changes: dict[str, Any] = {option: copy}
        request = replace(request, **changes)
    return request
