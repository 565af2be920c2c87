"""A batch of sessions under way: answers in the order of the sessions, and what they add up to."""

from __future__ import annotations

import contextlib
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, failures
from locatk.cli.solve.jobs import Job, failed, solve_file
from locatk.core.errors import LocatkError

if TYPE_CHECKING:
    from locatk.formats.pipeline.engine import Pool

PRELOAD = ("locatk.cli.systems", "locatk.formats.sessions.observations", "scipy.optimize")
"""Imported once for all processes: half a second each."""


def solve_all(jobs: Sequence[Job], *, workers: int, scheduler: str | None, as_json: bool) -> None:
    """Solve, tell of each session, and end with the exit status of them all.

    Parameters
    ----------
    jobs : sequence of Job
        The sessions.
    workers : int
        Processes; 0 for one a core, 1 for this one.
    scheduler : str or None
        Address of the Dask scheduler that runs them instead.
    as_json : bool
        A line of JSON a session.
    """
    from locatk.formats.pipeline import locations as places
    from locatk.formats.pipeline import pools

    with contextlib.ExitStack() as stack:
        if scheduler is not None:
            pool = pools.cluster(scheduler)
        else:
            if any(places.is_url(job.source) or places.is_url(job.target) for job in jobs):
                # One for them all: what a killed process left goes with it.
                scratch = stack.enter_context(tempfile.TemporaryDirectory(prefix="locatk-"))
                jobs = [replace(job, scratch=scratch) for job in jobs]
            workers = min(workers or pools.cores(), len(jobs))
            pool = pools.serial() if workers == 1 else pools.processes(workers, PRELOAD)
        if len(jobs) == 1:
            _solve_one(jobs, pool, as_json)
        else:
            _solve_several(jobs, pool, as_json)


def _solve_one(jobs: Sequence[Job], pool: Pool, as_json: bool) -> None:
    with console.working("Solving"):
        [answer] = [answer for _, ready in answers(jobs, pool) for answer in ready]
    if "error" in answer:
        console.detail(answer["trace"].rstrip())
        raise LocatkError(**answer["error"])
    _tell(answer, as_json)
    losses = answer["losses"]
    for loss in losses[1:]:
        console.warn(loss)
    if losses:
        raise failures.Incomplete(losses[0])


def _solve_several(jobs: Sequence[Job], pool: Pool, as_json: bool) -> None:
    total, told, bad, partly = len(jobs), 0, 0, 0
    status = Status(total, as_json)
    try:
        status.show(0)
        for done, ready in answers(jobs, pool):
            status.wipe()
            for answer in ready:
                _tell(answer, as_json)
                for loss in answer["losses"]:
                    console.warn(loss)
                bad += "error" in answer
                partly += "error" not in answer and bool(answer["losses"])
                told += 1
            status.show(done)
    except KeyboardInterrupt:
        status.wipe()
        console.say(
            f"Interrupted after {told} of {total} sessions. Hint: The same command with --resume "
            "does the rest."
        )
        raise
    status.wipe()
    if bad == total:
        raise click.ClickException(f"none of the {total} sessions could be solved")
    if bad or partly:
        parts = [f"{bad} of {total} sessions could not be solved"] if bad else []
        parts += [f"{partly} of {total} are solved in part"] if partly else []
        raise failures.Incomplete(", ".join(parts))


def _tell(answer: dict[str, Any], as_json: bool) -> None:
    """What is told of one session, but for what was lost."""
    if as_json:
        console.emit_json({"version": 1, "sessions": [answer["entry"]]})
    if "error" in answer:
        if answer["trace"]:
            console.detail(answer["trace"].rstrip())
        return
    console.result(answer["text"])
    for note in answer["notes"]:
        console.say(note)


def answers(jobs: Sequence[Job], pool: Pool) -> Iterator[tuple[int, list[dict[str, Any]]]]:
    """How many jobs are done, and the answers whose turn has come, in the order of ``jobs``."""
    from locatk.formats.pipeline import locations as places
    from locatk.formats.pipeline.engine import Lost, in_order, run

    def clean(job: Job) -> None:
        places.remove_parts(job.target)

    told = 0
    with contextlib.closing(run(solve_file, jobs, pool, clean=clean)) as results:
        for count, ready in in_order(results):
            found = []
            for answer in ready:
                if isinstance(answer, Lost):
                    lost = LocatkError(answer.reason, file=jobs[told].session, hint=answer.hint)
                    answer = failed(jobs[told], lost)
                found.append(answer)
                told += 1
            yield count, found


class Status:
    """How far a batch is, on the last line of a terminal; wiped before something is said."""

    def __init__(self, total: int, as_json: bool) -> None:
        busy = console.talks() and sys.stderr.isatty()
        self._shown = busy and total > 1 and not (as_json and sys.stdout.isatty())
        self._total = total

    def show(self, done: int) -> None:
        if self._shown:
            full = 30 * done // self._total
            bar = "#" * full + "-" * (30 - full)
            click.echo(f"\rSolving  [{bar}]  {done}/{self._total}", err=True, nl=False)

    def wipe(self) -> None:
        if self._shown:
            click.echo("\r\x1b[K", err=True, nl=False)
