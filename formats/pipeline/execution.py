"""Execution of one function over many jobs, on a machine or a Dask cluster.

Each job has exactly one result, even if processes die. A job that kills its process (out of
memory, a crash in a library) also ends the jobs that run at the same time, and the system does
not report which one was the cause. Therefore all interrupted jobs run again, one at a time; the
job that kills its process again is given up.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import multiprocessing
import os
import signal
import sys
import tempfile
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from multiprocessing import forkserver, resource_tracker
from typing import Any, TypeVar

from locatk.core.errors import InputError
from locatk.formats.extras import requires_extra
from locatk.formats.output import tool_version
from locatk.formats.pipeline.file_access import short_reason

Job = TypeVar("Job")
T = TypeVar("T")

MAX_FAILED_STARTS = 3
"""Number of times in a row that no worker can be started, before all jobs are given up."""

RESTART_DELAY_S = 0.5
"""Time after which a worker is started again [s]: a killed fork server takes some milliseconds to
end."""

MAX_DEATHS = 2
"""Number of processes that a job may kill while it runs alone, before it is given up."""

CLUSTER_RETRIES = 2
"""Number of times a cluster calls the function again if it raises."""

SCHEDULER_TIMEOUT_S = 20
"""Longest time until a scheduler and its first worker respond."""

MAX_SOCKET_FOLDER_BYTES = 70
"""Longest path of the temporary folder in which the fork server opens a socket.

The path of a socket has at most 107 bytes (unix(7)), of which multiprocessing uses 32.
"""

SINGLE_THREAD_ENVIRONMENT = dict.fromkeys(
    (
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "VECLIB_MAXIMUM_THREADS",
        "OPENCV_FOR_THREADS_NUM",
    ),
    "1",
)
"""Environment of a process that computes with one thread."""


@dataclass(frozen=True)
class Pool:
    """Workers that run jobs.

    Attributes
    ----------
    open : callable
        ``open(n)`` is a context with an executor of ``n`` workers; an exception in the context
        ends them at once.
    width : int or None
        Number of jobs that run at a time; None leaves it to the executor.
    detects_deaths : bool
        A worker that dies breaks the executor. Otherwise the executor replaces it silently.
    """

    open: Callable[[int], AbstractContextManager[Executor]]
    width: int | None
    detects_deaths: bool = True


@dataclass(frozen=True)
class LostJob:
    """Result of a job that was given up: the reason, and a remedy."""

    reason: str
    hint: str = "The memory may be too small: solve it alone"


class _BrokenPool(Exception):
    """A worker died, or could not be started."""


class _FailedStart(_BrokenPool):
    """A worker could not be started."""


class _Cancelled(Exception):
    """The executor dropped the job."""


def run_jobs(
    function: Callable[[Job], Any],
    jobs: Sequence[Job],
    pool: Pool,
    *,
    clean: Callable[[Job], None] = lambda job: None,
) -> Generator[tuple[int, Any], None, None]:
    """Run ``function`` on each job and yield the results as they arrive.

    Parameters
    ----------
    function : callable
        A function of a module, which other processes can import. It may be called again for a job
        whose worker died, and reports failures in its result.
    jobs : sequence
        Its arguments.
    pool : Pool
        The workers.
    clean : callable
        Called with each job that may have been interrupted, to remove partial output.

    Yields
    ------
    (int, object)
        Index of the job, each once, and its result: :class:`LostJob` if its worker died
        repeatedly, if the cluster gave it up, or if ``function`` raised.
    """
    unfinished: set[int] = set()
    try:
        with contextlib.closing(_run_jobs(function, jobs, pool, clean, unfinished)) as results:
            for index, result in results:
                unfinished.discard(index)
                yield index, result
    except BaseException:
        for index in unfinished:
            clean(jobs[index])
        raise


def _run_jobs(
    function: Callable[[Job], Any],
    jobs: Sequence[Job],
    pool: Pool,
    clean: Callable[[Job], None],
    submitted: set[int],
) -> Generator[tuple[int, Any], None, None]:
    """Run jobs as :func:`run_jobs`, and add the index of each to ``submitted`` before it runs."""
    queue = deque(range(len(jobs)))
    suspects: deque[int] = deque()
    deaths: Counter[int] = Counter()
    failed_starts = 0
    while queue or suspects:
        source = suspects or queue
        width = 1 if suspects else (pool.width or len(jobs))
        running: dict[Future[Any], int] = {}
        try:
            with pool.open(width) as executor:
                while source or running:
                    while source and len(running) < width:
                        submitted.add(source[0])
                        running[_submit(executor, function, jobs[source[0]])] = source[0]
                        source.popleft()
                    done, _ = wait(running, return_when=FIRST_COMPLETED)
                    broken = [f for f in done if isinstance(_exception(f), BrokenExecutor)]
                    for future in done.difference(broken):
                        index, failed_starts = running.pop(future), 0
                        if not pool.detects_deaths:
                            clean(jobs[index])
                        error = _exception(future)
                        yield index, future.result() if error is None else _lost_job(error)
                    if broken:
                        raise _BrokenPool
        except (_BrokenPool, BrokenExecutor) as error:
            interrupted = sorted(running.values())
            failed_starts += not interrupted
            if failed_starts >= MAX_FAILED_STARTS:
                hint = "Check the limit of processes (`ulimit -u`), or solve with --jobs 1"
                lost = LostJob(f"no process could be started ({short_reason(error)})", hint)
                yield from ((index, lost) for index in (*suspects, *queue))
                return
            if not interrupted:
                time.sleep(RESTART_DELAY_S)
            for index in interrupted:
                clean(jobs[index])
            if len(interrupted) == 1 and not isinstance(error, _FailedStart):
                [index] = interrupted
                deaths[index] += 1
                if deaths[index] >= MAX_DEATHS:
                    yield index, LostJob(f"its process died {MAX_DEATHS} times")
                    continue
            suspects.extendleft(reversed(interrupted))


def _submit(executor: Executor, function: Callable[[Job], Any], job: Job) -> Future[Any]:
    """Submit a job, which may start a worker; raise _FailedStart if that fails."""
    try:
        return executor.submit(function, job)
    except (EOFError, OSError) as error:  # The fork server died, or processes are limited.
        raise _FailedStart(short_reason(error)) from error


@contextlib.contextmanager
def _deferred_interrupts() -> Iterator[None]:
    """Let Ctrl-C and SIGTERM take effect at the end of the block.

    A start of a worker that an exception interrupts leaves a process that the executor does not
    know, so that nothing ends it before it writes.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    received: list[int] = []
    previous = {
        number: signal.signal(number, lambda number, frame: received.append(number))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler or signal.SIG_DFL)
        if received:
            signal.raise_signal(received[0])


def in_order(results: Iterator[tuple[int, Any]]) -> Iterator[tuple[int, list[Any]]]:
    """Yield the number of results so far, and the results that are next in order of their index."""
    early: dict[int, Any] = {}
    next_index = 0
    for count, (index, result) in enumerate(results, 1):
        early[index] = result
        ready = []
        while next_index in early:
            ready.append(early.pop(next_index))
            next_index += 1
        yield count, ready


def _exception(future: Future[Any]) -> BaseException | None:
    """Return the exception of a finished future."""
    return _Cancelled() if future.cancelled() else future.exception()


def _lost_job(error: BaseException) -> LostJob:
    if isinstance(error, _Cancelled):
        hint = "Check that it runs, and repeat the command with --resume"
        return LostJob("the connection to the scheduler was lost", hint)
    if type(error).__name__ == "KilledWorker":  # Of distributed, which is optional.
        return LostJob("its worker died repeatedly")
    message = " ".join(str(error).split())
    return LostJob(f"{type(error).__name__}: {message}", "Please report it")


# ---- this process


def this_process() -> Pool:
    """Return a pool that runs one job after the other in this process."""
    return Pool(lambda width: _InlineExecutor(), 1)


class _InlineExecutor(Executor):
    """Executor that runs each call when it is submitted."""

    def submit(self, function: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        future: Future[T] = Future()
        try:
            future.set_result(function(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


# ---- processes of this machine


def processes(workers: int, preload: tuple[str, ...] = ()) -> Pool:
    """Return a pool of processes of this machine.

    Parameters
    ----------
    workers : int
        Number of processes; 0 for one per core.
    preload : tuple of str
        Modules that are imported once for all processes, if the system can share them.
    """
    return Pool(partial(_open_processes, preload=preload), workers or available_cores())


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class _ProcessExecutor(ProcessPoolExecutor):
    """Executor whose start of a worker is not interrupted."""

    def submit(self, function: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        with _deferred_interrupts():
            return super().submit(function, *args, **kwargs)


@contextlib.contextmanager
def _open_processes(width: int, preload: tuple[str, ...]) -> Iterator[Executor]:
    # A plain fork would copy locks that threads of libraries hold.
    has_forkserver = (
        "forkserver" in multiprocessing.get_all_start_methods()
        and len(os.fsencode(tempfile.gettempdir())) <= MAX_SOCKET_FOLDER_BYTES
    )
    context = multiprocessing.get_context("forkserver" if has_forkserver else "spawn")
    if has_forkserver:
        context.set_forkserver_preload(list(preload))
    environment = dict(os.environ)
    # With protobuf 6, each schema of foxglove warns that it was generated for protobuf 5.
    quiet = "ignore:Protobuf gencode version:UserWarning"
    warning_filters = ",".join(filter(None, (environment.get("PYTHONWARNINGS"), quiet)))
    with _changed_environment({**SINGLE_THREAD_ENVIRONMENT, "PYTHONWARNINGS": warning_filters}):
        if has_forkserver:
            _start_forkserver()
        executor = _ProcessExecutor(
            width,
            mp_context=context,
            initializer=_initialize_worker,
            initargs=({**environment, **SINGLE_THREAD_ENVIRONMENT},),
        )
        try:
            yield executor
        except BaseException:
            for worker in list((executor._processes or {}).values()):
                worker.kill()
            raise
        finally:
            # Until its workers have ended, which the fork server reports, their outputs are locked.
            executor.shutdown(cancel_futures=True)


def _start_forkserver() -> None:
    """Start the fork server with Ctrl-C blocked, in the server and for the moment here.

    A terminal sends Ctrl-C to all processes, and the server would print a traceback if it is
    still importing. A Ctrl-C that arrives meanwhile takes effect at the end.
    """
    resource_tracker.ensure_running()  # Its start would unblock the signal.
    previous = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous)


def _initialize_worker(environment: Mapping[str, str]) -> None:
    """Set up a worker process."""
    os.environ.clear()  # The fork server may be older than the environment.
    os.environ.update(environment)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # The main process handles Ctrl-C.
    threading.Thread(target=_exit_with_parent, daemon=True).start()


def _exit_with_parent() -> None:
    """End this process when its parent ends, for whatever reason."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextlib.contextmanager
def _changed_environment(changes: Mapping[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in changes}
    os.environ.update(changes)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


# ---- Dask cluster (extra ``locatk[dask]``; distributed is optional and slow to import)


def dask_cluster(address: str) -> Pool:
    """Return a pool of the workers of the Dask scheduler at ``address``, as ``tcp://host:8786``.

    Opening the pool raises LocatkError if ``distributed`` is not installed, and InputError if the
    scheduler or its workers do not respond or have another version of locatk.
    """
    return Pool(lambda width: _open_cluster(address), None, detects_deaths=False)


def worker_folder() -> str | None:
    """Return the temporary folder of the Dask worker that runs this; None in other processes.

    Dask removes the files that a killed worker left there.
    """
    distributed = sys.modules.get("distributed")
    if distributed is None:
        return None
    try:
        return str(distributed.get_worker().local_directory)
    except ValueError:
        return None


@contextlib.contextmanager
def _open_cluster(address: str) -> Iterator[Executor]:
    with requires_extra("dask", "a scheduler"):
        import distributed
    # distributed logs tracebacks of errors that are reported here in one line.
    for name in [
        name for name in logging.root.manager.loggerDict if name.startswith("distributed")
    ]:
        logging.getLogger(name).setLevel(logging.CRITICAL)
    hint = f"Start `dask scheduler`, and `dask worker {address}` on the machines that solve"
    try:
        asyncio.run(_check_scheduler(address))
        client = distributed.Client(address, timeout=SCHEDULER_TIMEOUT_S, set_as_default=False)
    except Exception as error:  # Another server may send arbitrary bytes.
        reason = "no response" if isinstance(error, TimeoutError) else short_reason(error)
        raise InputError(f"no Dask scheduler at {address} ({reason})", hint=hint) from None
    with client:
        try:
            client.wait_for_workers(1, timeout=SCHEDULER_TIMEOUT_S)
        except TimeoutError:
            raise InputError(f"no worker at the scheduler {address}", hint=hint) from None
        _check_versions(client)
        executor = client.get_executor(retries=CLUSTER_RETRIES, pure=False)
        try:
            yield executor
        except BaseException:
            executor.shutdown(wait=False)
            raise


async def _check_scheduler(address: str) -> None:
    """Connect to a scheduler as a client does, within :data:`SCHEDULER_TIMEOUT_S`.

    A client waits forever if another server listens, and takes 40 s to close if it cannot start.
    """
    from distributed.comm import connect
    from distributed.security import Security

    async def identity() -> Any:
        connection = Security().get_connection_args("client")
        comm = await connect(address, SCHEDULER_TIMEOUT_S, **connection)
        try:
            await comm.write({"op": "identity", "reply": True})
            return await comm.read()
        finally:
            comm.abort()

    kind = (await asyncio.wait_for(identity(), SCHEDULER_TIMEOUT_S + 1)).get("type")
    if kind != "Scheduler":
        raise ValueError(f"it is a {kind}")


def _check_versions(client: Any) -> None:
    """Refuse a scheduler and workers with another version of locatk than this machine."""
    hint = "Install the same locatk on all machines"
    member = "the scheduler"
    try:
        versions = {member: client.run_on_scheduler(tool_version)}
        member = "a worker"
        versions |= {f"the worker {name}": v for name, v in client.run(tool_version).items()}
    except Exception as error:
        raise InputError(f"{member} cannot run locatk ({short_reason(error)})", hint=hint) from None
    for member, version in versions.items():
        if version != tool_version():
            raise InputError(f"locatk {version} at {member}, {tool_version()} here", hint=hint)
