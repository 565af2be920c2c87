"""Many sessions: outputs, jobs, and their outcomes in the order of the sessions."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections import Counter
from collections.abc import Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from locatk.core.errors import InputError, LocatkError, OutputExistsError
from locatk.formats.files import read_bytes
from locatk.formats.pipeline import execution, file_access, file_names, provenance
from locatk.formats.pipeline.outcome import Outcome, SolveFailure
from locatk.formats.pipeline.solving import SolveJob, default_output, plan_job, run_job
from locatk.formats.pipeline.systems import SolveRequest

PRELOADED_MODULES = (
    "locatk.formats.pipeline.systems",
    "locatk.formats.sessions.observations",
    "scipy.optimize",
)
"""Modules imported once for all worker processes: half a second each."""


class OutputConflictError(InputError):
    """Option ``-o`` that does not suit the number or the names of the sessions."""


FILE_ENDINGS = (".csv", ".html", ".json", ".parquet", ".pdf", ".png", ".toml", ".tum", ".txt")
"""Endings that no new folder of solutions has: its name was meant as that of a file."""


def plan_outputs(
    sessions: Sequence[str], output: str | None, *, is_folder: bool = False
) -> list[str]:
    """Return the location of the solution of each session.

    Parameters
    ----------
    sessions : sequence of str
        Paths or URLs.
    output : str or None
        File for one session; folder for several, which :func:`check_outputs` creates; None for a
        file in the folder of each session.
    is_folder : bool
        ``output`` is a folder even for one session, because the user named a folder or pattern.

    Raises
    ------
    OutputConflictError
        A file for several sessions, two sessions with the same output, or a folder with the name of
        a file.
    OutputExistsError
        The folder is a file.
    """
    if output is None:
        return [default_output(session) for session in sessions]
    is_url = file_names.is_url(output)
    is_file = output.endswith(".mcap") if is_url or is_folder else True
    if len(sessions) == 1 and is_file and (is_url or not Path(output).is_dir()):
        return [output]
    if len(sessions) > 1 and output.endswith(".mcap") and (is_url or not Path(output).is_dir()):
        raise OutputConflictError(f"{len(sessions)} sessions need a folder, but -o names a file")
    if output.lower().endswith(FILE_ENDINGS) and (is_url or not Path(output).is_dir()):
        name = file_names.file_name(output)
        raise OutputConflictError(
            f"-o is a folder for the solutions here, and {name!r} is the name of a file; "
            "`locatk export` writes tables of the solutions in a folder"
        )
    by_stem: dict[str, str] = {}
    for session in sessions:
        stem = file_names.stem(session)
        if stem in by_stem:
            raise OutputConflictError(
                f"{by_stem[stem]} and {session} would have the same output: leave out -o, or "
                "rename one"
            )
        by_stem[stem] = session
    if not is_url:
        folder = Path(output)
        if folder.exists() and not folder.is_dir():
            raise OutputExistsError(
                "there are several outputs, but -o is a file", file=folder, hint="Name a folder"
            )
    return [file_names.within(output, f"{stem}.mcap") for stem in by_stem]


def check_outputs(
    outputs: Sequence[str],
    inputs: Sequence[str],
    *,
    overwrite: bool,
    resume: bool,
    folder: str | None = None,
) -> None:
    """Refuse outputs that cannot or must not be written, before the work starts.

    Parameters
    ----------
    outputs, inputs : sequence of str
        Locations.
    overwrite : bool
        Existing outputs may be replaced.
    resume : bool
        Existing outputs are checked when their session is next.
    folder : str, optional
        Folder that contains all outputs. If it is missing, it is created after the checks.

    Raises
    ------
    OutputConflictError
        Two sessions have the same output.
    OutputExistsError, MissingDataError, InputError
        See :func:`locatk.formats.pipeline.file_access.check_writable`; also if an output is one of
        the inputs.
    """
    input_keys = {file_names.file_key(location) for location in inputs}
    counts = Counter(file_names.file_key(location) for location in outputs)
    if any(count > 1 for count in counts.values()):
        raise OutputConflictError("several sessions have the same output")

    is_new_folder = folder is not None and not (file_names.is_url(folder) or os.path.isdir(folder))

    def check(output: str) -> None:
        if file_names.file_key(output) in input_keys:
            raise OutputExistsError(
                "the output is one of the inputs", file=output, hint="Choose another -o"
            )
        if not is_new_folder:
            file_access.check_writable(output, overwrite=overwrite or resume)

    with ThreadPoolExecutor(file_access.MAX_REQUESTS) as threads:
        list(threads.map(check, outputs))
    stored = [output for output in outputs if file_names.is_url(output)]
    for output in {output.rpartition("/")[0]: output for output in stored}.values():
        file_access.check_bucket(output)
    if folder is not None and is_new_folder:
        os.makedirs(folder, exist_ok=True)


def plan_jobs(
    sessions: Sequence[str],
    outputs: Sequence[str],
    request: SolveRequest,
    *,
    is_remote: bool = False,
    **options: Any,
) -> list[SolveJob]:
    """Return a job for each session.

    Parameters
    ----------
    is_remote : bool
        Other machines run the jobs: the files of the request travel with them.
    options
        Further attributes of :class:`SolveJob`.

    Raises
    ------
    MissingDataError, InputError
        A file of the request cannot be read.
    """
    carried = []
    if is_remote:
        for field in fields(request):
            value = getattr(request, field.name)
            if isinstance(value, Path):
                carried.append((field.name, value.name, read_bytes(value)))
    options["options_sha256"] = provenance.options_digest(request)
    options["carried_files"] = tuple(carried)
    return [
        plan_job(session, output, request, **options)
        for session, output in zip(sessions, outputs, strict=True)
    ]


def solve_batch(
    jobs: Sequence[SolveJob], *, workers: int = 1, scheduler: str | None = None
) -> Generator[tuple[int, list[Outcome]], None, None]:
    """Run jobs and yield their outcomes in the order of ``jobs``.

    Closing the generator, or an exception in it, ends the workers and removes partial outputs.

    Parameters
    ----------
    jobs : sequence of SolveJob
    workers : int
        Processes of this machine; 0 for one per core, 1 for this process.
    scheduler : str, optional
        Address of a Dask scheduler that runs the jobs instead.

    Yields
    ------
    (int, list of SolveReport or SolveFailure)
        Number of finished jobs, and the outcomes that are next in order.

    Raises
    ------
    LocatkError
        The scheduler is not available (:func:`locatk.formats.pipeline.execution.dask_cluster`).
    """
    with contextlib.ExitStack() as stack:
        if scheduler is not None:
            pool = execution.dask_cluster(scheduler)
        else:
            ends = (location for job in jobs for location in (job.source, job.target))
            if any(map(file_names.is_url, ends)):
                # The folder is removed with all files that killed processes left in it.
                scratch = stack.enter_context(tempfile.TemporaryDirectory(prefix="locatk-"))
                jobs = [replace(job, scratch=scratch) for job in jobs]
            workers = min(workers or execution.available_cores(), len(jobs))
            pool = (
                execution.this_process()
                if workers == 1
                else execution.processes(workers, PRELOADED_MODULES)
            )
        results = stack.enter_context(
            contextlib.closing(
                execution.run_jobs(run_job, jobs, pool, clean=_remove_partial_output)
            )
        )
        remaining = iter(jobs)
        for count, ready in execution.in_order(results):
            yield count, [_outcome(result, next(remaining)) for result in ready]


def _remove_partial_output(job: SolveJob) -> None:
    file_access.remove_partial_files(job.target)


def _outcome(result: Any, job: SolveJob) -> Outcome:
    """Return a result of :func:`run_job`; a failure if its worker was lost."""
    if isinstance(result, execution.LostJob):
        error = LocatkError(result.reason, file=job.session, hint=result.hint)
        return SolveFailure(job.session, error)
    outcome: Outcome = result
    return outcome
