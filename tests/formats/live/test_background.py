"""Long computations beside the solver."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from typing import Any

import pytest

from locatk.core.errors import InputError, LocatkError
from locatk.core.streaming.events import BackgroundTask
from locatk.formats.live.background import NICENESS, BackgroundWorker


def finished(worker: BackgroundWorker, timeout_s: float = 30.0) -> Any:
    """Wait for the result of a task."""
    end = time.monotonic() + timeout_s
    while (result := worker.result()) is None:
        assert time.monotonic() < end
        time.sleep(0.01)
    assert worker.is_idle
    assert worker.result() is None
    return result[1]


def run(worker: BackgroundWorker, function: Any, *arguments: Any) -> Any:
    worker.start(BackgroundTask("scene", function, arguments))
    return finished(worker)


@pytest.fixture
def worker() -> Iterator[BackgroundWorker]:
    worker = BackgroundWorker()
    yield worker
    worker.close()


def is_running(process: int) -> bool:
    """Return whether a process exists and is no zombie."""
    try:
        with open(f"/proc/{process}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.slow
def test_tasks_run_in_another_process_that_yields_to_this_one(worker: BackgroundWorker) -> None:
    process = run(worker, os.getpid)
    assert process != os.getpid()
    assert run(worker, os.getpid) == process
    if hasattr(os, "nice"):
        assert run(worker, os.nice, 0) == min(os.nice(0) + NICENESS, 19)
    # Ctrl-C on a terminal is for the session only.
    assert run(worker, signal.getsignal, signal.SIGINT) == signal.SIG_IGN
    error = run(worker, int, "x")
    assert isinstance(error, ValueError)

    # A process that the system ends, at work and while it is idle.
    killed = run(worker, os.kill, process, signal.SIGKILL)
    assert isinstance(killed, LocatkError)
    assert "scene" in str(killed)
    second = run(worker, os.getpid)
    assert second != process
    os.kill(second, signal.SIGKILL)
    end = time.monotonic() + 10
    while is_running(second) and time.monotonic() < end:
        time.sleep(0.01)
    time.sleep(0.05)
    third = run(worker, os.getpid)
    assert isinstance(third, int | LocatkError)  # The pool may not yet have noticed.
    third = run(worker, os.getpid)
    assert isinstance(third, int)

    # The end of the session does not wait for a task.
    worker.start(BackgroundTask("scene", time.sleep, (60.0,)))
    begun = time.monotonic()
    worker.close()
    end = time.monotonic() + 10
    while is_running(third) and time.monotonic() < end:
        time.sleep(0.01)
    assert not is_running(third)
    assert time.monotonic() - begun < 30


def test_tasks_of_replays_are_done_at_once() -> None:
    worker = BackgroundWorker(is_synchronous=True)
    worker.start(BackgroundTask("scene", os.getpid, ()))
    assert not worker.is_idle
    assert worker.result() == (BackgroundTask("scene", os.getpid, ()), os.getpid())
    assert worker.is_idle
    failing = BackgroundTask("scene", _fail, ())
    worker.start(failing)
    finished_task = worker.result()
    assert finished_task is not None
    assert isinstance(finished_task[1], InputError)
    worker.close()


def _fail() -> None:
    raise InputError("no light")
