"""Pools for :mod:`.engine`: this process, the cores of this machine, a Dask cluster."""

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
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from functools import partial
from typing import Any, TypeVar

from locatk.core.errors import InputError, LocatkError
from locatk.formats.output import tool_version
from locatk.formats.pipeline.engine import Pool

T = TypeVar("T")

RETRIES = 2
"""How often a cluster calls the function again where it raises."""

PATIENCE_S = 20
"""How long a scheduler and the first worker may take to answer."""

LONGEST_FOLDER = 70
"""Bytes in the path of the temporary folder, in which the server of processes has a socket:
the path of a socket has 107 at most, and 32 are its own."""

ONE_THREAD = dict.fromkeys(
    (
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "VECLIB_MAXIMUM_THREADS",
        "OPENCV_FOR_THREADS_NUM",
    ),
    "1",
)
"""Environment of workers: there are as many of them as cores."""


def serial() -> Pool:
    """This process, one job after the other."""
    return Pool(lambda width: _Here(), 1)


def processes(workers: int, preload: tuple[str, ...] = ()) -> Pool:
    """Processes of this machine.

    Parameters
    ----------
    workers : int
        How many; one for each core where it is 0.
    preload : tuple of str
        Modules that are imported once for all of them, where the system can share them.
    """
    return Pool(partial(_processes, preload=preload), workers or cores())


def cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def cluster(address: str) -> Pool:
    """Workers of a Dask scheduler at ``address``, as ``tcp://host:8786``; needs ``distributed``.

    Opening it raises InputError where nobody answers, no worker comes, or one has another
    locatk than this one.
    """
    return Pool(lambda width: _cluster(address), None, watched=False)


def worker_folder() -> str | None:
    """The folder for temporary files of the Dask worker that runs this; None outside of one.

    Dask removes what a killed worker left there.
    """
    distributed = sys.modules.get("distributed")
    if distributed is None:
        return None
    try:
        return str(distributed.get_worker().local_directory)
    except ValueError:
        return None


class _Here(Executor):
    """An executor that runs each call when it is submitted."""

    def submit(self, function: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        future: Future[T] = Future()
        try:
            future.set_result(function(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


@contextlib.contextmanager
def _processes(width: int, preload: tuple[str, ...]) -> Iterator[Executor]:
    # Never a plain fork: threads of libraries would leave their locks behind.
    forkserver = (
        "forkserver" in multiprocessing.get_all_start_methods()
        and len(os.fsencode(tempfile.gettempdir())) <= LONGEST_FOLDER
    )
    context = multiprocessing.get_context("forkserver" if forkserver else "spawn")
    if forkserver:
        context.set_forkserver_preload(list(preload))
    ours = dict(os.environ)
    # With protobuf 6, each schema of foxglove warns that it was generated for protobuf 5.
    quiet = "ignore:Protobuf gencode version:UserWarning"
    warned = ",".join(filter(None, (ours.get("PYTHONWARNINGS"), quiet)))
    with _environment({**ONE_THREAD, "PYTHONWARNINGS": warned}):
        if forkserver:
            _start_server()
        environment = {**ours, **ONE_THREAD}
        executor = ProcessPoolExecutor(
            width, mp_context=context, initializer=_begin, initargs=(environment,)
        )
        try:
            yield executor
        except BaseException as error:
            for worker in list((executor._processes or {}).values()):
                worker.kill()
            if forkserver and not isinstance(error, Exception):
                _end_server()
            raise
        finally:
            executor.shutdown(cancel_futures=True)


def _start_server() -> None:
    """Start the process that forks workers, deaf to Ctrl-C: that goes to all of a terminal, and
    would be answered with a traceback while it imports."""
    from multiprocessing import forkserver

    if threading.current_thread() is not threading.main_thread():
        forkserver.ensure_running()
        return
    heard = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        forkserver.ensure_running()
    finally:
        signal.signal(signal.SIGINT, heard)


def _end_server() -> None:
    """End it now: workers that it was asked for would not find what they share with us."""
    from multiprocessing import forkserver

    pid = forkserver._forkserver._forkserver_pid  # type: ignore[attr-defined]
    if pid is not None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def _begin(environment: Mapping[str, str]) -> None:
    """First call in a worker."""
    os.environ.clear()  # the server that forks may be older than the environment
    os.environ.update(environment)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the one that started us
    threading.Thread(target=_follow_parent, daemon=True).start()


def _follow_parent() -> None:
    """End this process with the one that started it, however that ends."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextlib.contextmanager
def _environment(changes: Mapping[str, str]) -> Iterator[None]:
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


@contextlib.contextmanager
def _cluster(address: str) -> Iterator[Executor]:
    try:
        import distributed
    except ImportError:
        raise LocatkError(
            "a scheduler needs dask, which is not installed",
            hint='Install it: pip install "locatk[dask]"',
        ) from None
    # It logs with tracebacks what is told here in one line.
    for name in [
        name for name in logging.root.manager.loggerDict if name.startswith("distributed")
    ]:
        logging.getLogger(name).setLevel(logging.CRITICAL)
    hint = f"Start `dask scheduler`, and `dask worker {address}` where it is to run"
    try:
        asyncio.run(_greet(address))
        client = distributed.Client(address, timeout=PATIENCE_S, set_as_default=False)
    except Exception as error:  # whatever the bytes of another server lead to
        told = "it does not answer" if isinstance(error, TimeoutError) else _short(error)
        raise InputError(f"no Dask scheduler at {address} ({told})", hint=hint) from None
    with client:
        try:
            client.wait_for_workers(1, timeout=PATIENCE_S)
        except TimeoutError:
            raise InputError(f"no worker at the scheduler {address}", hint=hint) from None
        _check_versions(client)
        executor = client.get_executor(retries=RETRIES, pure=False)
        try:
            yield executor
        except BaseException:
            executor.shutdown(wait=False)
            raise


async def _greet(address: str) -> None:
    """Connect as a client does, and no longer than :data:`PATIENCE_S`: a client waits for ever
    where something else than Dask listens, and takes 40 s to be gone where it cannot begin."""
    from distributed.comm import connect
    from distributed.security import Security

    async def asked() -> Any:
        comm = await connect(address, PATIENCE_S, **Security().get_connection_args("client"))
        try:
            await comm.write({"op": "identity", "reply": True})
            return await comm.read()
        finally:
            comm.abort()

    kind = (await asyncio.wait_for(asked(), PATIENCE_S + 1)).get("type")
    if kind != "Scheduler":
        raise ValueError(f"it is a {kind}")


def _check_versions(client: Any) -> None:
    """Refuse workers that would solve otherwise than this machine, and a scheduler that cannot
    read what is to be done."""
    hint = "Install the same locatk on all machines"
    try:
        who = "the scheduler"
        versions = {who: client.run_on_scheduler(tool_version)}
        who = "a worker"
        versions |= {f"the worker {name}": v for name, v in client.run(tool_version).items()}
    except Exception as error:
        raise InputError(f"{who} cannot run locatk ({_short(error)})", hint=hint) from None
    for place, version in versions.items():
        if version != tool_version():
            raise InputError(f"locatk {version} at {place}, {tool_version()} here", hint=hint)


def _short(error: BaseException) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
