"""Sessions in a batch: one job a file, wherever it runs, and what is told of each.

:func:`solve_file` is all that happens to one session; it depends on its job alone, writes its
output as a whole or not at all, and answers with a small dictionary, so that it may run in any
process on any machine, and again where a process died.
"""

from __future__ import annotations

import contextlib
import math
import shlex
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from locatk.cli import console, failures, options
from locatk.core.errors import InputError, LocatkError, OutputExistsError

if TYPE_CHECKING:
    from locatk.cli.systems import Request
    from locatk.core.solution import Solution


@dataclass(frozen=True)
class Job:
    """One session to solve.

    Attributes
    ----------
    session, output : str
        As the user named them, or would have; what is told names these.
    source, target : str
        The same as absolute paths or URLs.
    request : Request
        What was asked of the solver.
    options_sha256 : str
        Digest of the request and of the files in it.
    overwrite, resume : bool
        As the options.
    detections : bool
        Whether the answer holds what was seen.
    save_scene : str or None
        Where to write the solved scene, too.
    carried : tuple of (str, str, bytes)
        Files of the request that travel with the job: option, name, content.
    scratch : str or None
        Folder for temporary files.
    """

    session: str
    output: str
    source: str
    target: str
    request: Request
    options_sha256: str
    overwrite: bool = False
    resume: bool = False
    detections: bool = False
    save_scene: str | None = None
    carried: tuple[tuple[str, str, bytes], ...] = ()
    scratch: str | None = None


def solve_file(job: Job) -> dict[str, Any]:
    """Solve one session and write its solution.

    Returns
    -------
    dict
        ``entry``: the session of ``--json``, with ``error`` and ``hint`` where it failed;
        ``losses``: a line each; of what was solved ``text`` and ``notes``; of what failed
        ``error`` (arguments of LocatkError) and ``trace``.
    """
    names: dict[str, str] = {job.source: job.session, job.target: job.output}
    try:
        with contextlib.ExitStack() as stack:
            return _solved(job, stack, names)
    except LocatkError as error:
        return failed(job, error, names)
    except OSError as error:
        told = error.strerror or str(error)
        return failed(job, LocatkError(told, file=error.filename or job.session), names)
    except MemoryError:
        hint = "Solve shorter sessions, or fewer at once"
        return failed(job, LocatkError("not enough memory", file=job.session, hint=hint), names)
    except Exception as error:  # the others are to be solved none the less
        told = f"internal error, {type(error).__name__}: {error}"
        hint = "Please report it, with the traceback that -v shows"
        return failed(job, LocatkError(told, file=job.session, hint=hint), names)


def _solved(job: Job, stack: contextlib.ExitStack, names: dict[str, str]) -> dict[str, Any]:
    from locatk.cli.systems import Solved, solve_session
    from locatk.formats.artifacts import scene as artifacts
    from locatk.formats.pipeline import locations as places
    from locatk.formats.pipeline import pools
    from locatk.formats.pipeline import provenance as made
    from locatk.formats.sessions import solutions

    for place in (job.session, job.output):
        if not places.is_text(place):
            raise InputError("its name is not UTF-8", file=place, hint="Rename it")
    scratch = job.scratch or pools.worker_folder()
    path = stack.enter_context(places.local(job.source, scratch))
    names[str(path)] = job.session
    request = job.request
    for option, name, content in job.carried:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="locatk-", dir=scratch))
        copy = Path(folder) / name
        copy.write_bytes(content)
        names[str(copy)] = str(getattr(request, option))
        changed: dict[str, Any] = {option: copy}
        request = replace(request, **changed)

    facts = {**made.source_facts(path), "options_sha256": job.options_sha256}

    def there() -> tuple[Solution | None, bool]:
        """What is at the target: the same solution, and whether it may be made again."""
        with places.local(job.target, scratch) as old:
            return made.same_solution(old, facts), made.is_ours(old, path.name)

    overwrite, before = job.overwrite, None
    # Without --resume it is there only if an attempt whose worker was lost had written it.
    if places.exists(job.target) and (job.resume or not overwrite):
        before, ours = there()
        if before is None:
            overwrite = overwrite or (job.resume and ours)
            places.check(job.target, overwrite=overwrite)
    elif not places.is_url(job.target):  # its folder may have gone since
        places.check(job.target, overwrite=overwrite)
    if before is not None:
        solved = Solved(before, math.nan)
    else:
        solved = solve_session(path, request)
        facts["command"] = command_line(path.name, job.request)
        try:
            with places.writing(job.target, scratch, overwrite=overwrite) as target:
                names[str(target)] = job.output
                solutions.write_solution(
                    target, solved.solution, source=path, facts=facts, overwrite=overwrite
                )
        except OutputExistsError:  # by a worker that was only thought to be lost?
            before, _ = there()
            if before is None:
                raise
    if job.save_scene is not None and (before is None or not Path(job.save_scene).exists()):
        artifacts.write_scene(job.save_scene, solved.solution.artifact, overwrite=job.overwrite)
    return _told(job, solved)


def _told(job: Job, solved: Any) -> dict[str, Any]:
    from locatk.cli.solve import detections_text as seen
    from locatk.cli.solve import text as solve_text

    entry = solve_text.entry(job.session, job.output, solved)
    if not job.detections:
        del entry["detections"]
    if job.resume:
        entry["resumed"] = math.isnan(solved.solve_s)
    return {
        "entry": console.plain(entry),
        "text": solve_text.text(job.session, job.output, solved),
        "notes": solve_text.notes(job.session, solved),
        "losses": [f"{job.session}: {loss}" for loss in seen.lost(solved.solution)],
    }


def failed(job: Job, error: LocatkError, names: dict[str, str] | None = None) -> dict[str, Any]:
    """What :func:`solve_file` answers where there is no solution."""

    def named(text: str | None) -> str | None:
        for path, name in sorted((names or {}).items(), reverse=True):
            text = text and text.replace(path, name)
        return text

    parts = {
        "file": named(error.file),
        "where": error.where,
        "hint": named(error.hint),
    }
    message = named(error.message) or ""
    told = LocatkError(message, **parts)  # type: ignore[arg-type]
    return {
        "entry": {"session": job.session, "error": message, "hint": parts["hint"]},
        "losses": [failures.describe(told)],
        "error": {"message": message, **parts},
        "trace": "" if sys.exc_info()[0] is None else traceback.format_exc(),
    }


def command_line(session: str, request: Request) -> str:
    """The command that makes the same solution, with the names of files and not their folders:
    the same session and options give the same bytes wherever they are solved."""
    words = ["locatk", "solve", session]
    for field in fields(request):
        value = getattr(request, field.name)
        if value is not None:
            text = value.name if isinstance(value, Path) else str(value)
            words += [f"--{field.name.replace('_', '-')}", text]
    return shlex.join(words)


def plan_outputs(sessions: Sequence[str], output: str | None, *, many: bool) -> list[str]:
    """Where each session's solution goes: ``output``, a file of the session's name in it, or
    beside the session where there is no ``output``.

    A folder for several sessions (or ``many`` that were looked for) is made.
    """
    from locatk.formats.pipeline import locations as places

    if output is None:
        return [beside(session) for session in sessions]
    url = places.is_url(output)
    is_file = output.endswith(".mcap") if url or many else True
    if len(sessions) == 1 and is_file and (url or not Path(output).is_dir()):
        return [output]
    if len(sessions) > 1 and output.endswith(".mcap") and (url or not Path(output).is_dir()):
        raise click.UsageError(f"{len(sessions)} sessions need a folder: -o names one file.")
    stems = [_stem(session) for session in sessions]
    twins = [name for name, count in Counter(stems).items() if count > 1]
    if twins:
        same = [session for session, stem in zip(sessions, stems, strict=True) if stem == twins[0]]
        raise click.UsageError(
            f"{same[0]} and {same[1]} would have the same output: leave out -o, or give them "
            "names of their own."
        )
    if not url:
        options.make_folder(Path(output))
    return [places.within(output, f"{stem}.mcap") for stem in stems]


def beside(session: str) -> str:
    """Where the solution of a session goes if nobody says."""
    from locatk.formats.pipeline import locations as places

    return places.beside(session, f"{_stem(session)}-solved.mcap")


def _stem(session: str) -> str:
    from locatk.formats.pipeline import locations as places

    return Path(places.name_of(session)).stem


def guard_outputs(
    outputs: Sequence[str], inputs: Sequence[str], *, overwrite: bool, resume: bool
) -> None:
    """Refuse outputs before any work, as :func:`locatk.cli.options.guard_output` does for one.

    With ``resume`` what is there is looked at when its turn comes.
    """
    from locatk.formats.pipeline import locations as places

    read = {_identity(place) for place in inputs}
    twins = [place for place, count in Counter(map(_identity, outputs)).items() if count > 1]
    if twins:
        raise click.UsageError("Several sessions have the same output.")

    def check(output: str) -> None:
        if _identity(output) in read:
            raise OutputExistsError(
                "the output is one of the inputs", file=output, hint="Choose another -o"
            )
        places.check(output, overwrite=overwrite or resume)

    with ThreadPoolExecutor(16) as threads:
        for _ in threads.map(check, outputs):
            pass
    stores = [output for output in outputs if places.is_url(output)]
    for output in {places.beside(output, ""): output for output in stores}.values():
        places.check_bucket(output)


def _identity(place: str) -> tuple[int, int] | str:
    """Equal for two names of one file."""
    from locatk.formats.pipeline import locations as places

    if not places.is_url(place):
        with contextlib.suppress(OSError):
            found = Path(place).stat()
            return found.st_dev, found.st_ino
    return places.absolute(place)


def plan(
    sessions: Sequence[str], outputs: Sequence[str], request: Request, *, travels: bool, **more: Any
) -> list[Job]:
    """A job for each session; with ``travels`` the files of the request go along, ``more`` are
    fields of :class:`Job`."""
    from locatk.formats.pipeline import locations as places
    from locatk.formats.pipeline import provenance as made

    asked = {field.name: getattr(request, field.name) for field in fields(request)}
    files = {name: value for name, value in asked.items() if isinstance(value, Path)}
    carried = tuple((name, file.name, file.read_bytes()) for name, file in files.items())
    digest = made.options_digest(asked)
    return [
        Job(
            session,
            output,
            places.absolute(session),
            places.absolute(output),
            request,
            digest,
            carried=carried if travels else (),
            **more,
        )
        for session, output in zip(sessions, outputs, strict=True)
    ]
