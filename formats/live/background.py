"""Long computations beside the solver, in a process of low priority.

A thread of Python code would delay the solver by 5 ms at a time (the switch interval of the
interpreter), and numpy holds the lock of the interpreter in small calls too.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from locatk.core.errors import LocatkError
from locatk.core.streaming.events import BackgroundTask

NICENESS = 19


class BackgroundWorker:
    """Runs one task at a time.

    Parameters
    ----------
    is_synchronous : bool
        Run tasks at once and in this process: for a replay whose time stands still meanwhile, so
        that its result does not depend on the speed of the machine.
    """

    def __init__(self, *, is_synchronous: bool = False) -> None:
        self._is_synchronous = is_synchronous
        self._executor: ProcessPoolExecutor | None = None
        self._task: BackgroundTask | None = None
        self._future: Future[Any] | None = None

    @property
    def is_idle(self) -> bool:
        """Return whether a task can be started."""
        return self._task is None

    def start(self, task: BackgroundTask) -> None:
        """Start a task."""
        self._task = task
        if self._is_synchronous:
            self._future = Future()
            try:
                self._future.set_result(task.function(*task.arguments))
            except Exception as error:
                self._future.set_exception(error)
            return
        try:
            self._future = self._submit(task)
        except BrokenProcessPool:  # Its process ended while it was idle.
            self._discard_process()
            self._future = self._submit(task)

    def _submit(self, task: BackgroundTask) -> Future[Any]:
        if self._executor is None:
            self._executor = ProcessPoolExecutor(
                1, multiprocessing.get_context("spawn"), _lower_priority
            )
        return self._executor.submit(task.function, *task.arguments)

    def _discard_process(self) -> None:
        if self._executor is not None:
            self._executor.shutdown(wait=False)
            self._executor = None

    def result(self) -> tuple[BackgroundTask, Any] | None:
        """Return a finished task with its result or exception, once; None if there is none.

        A task whose process was ended by the system (such as for want of memory) has a LocatkError.
        """
        if self._task is None or self._future is None or not self._future.done():
            return None
        task, future = self._task, self._future
        self._task = self._future = None
        error = future.exception()
        if isinstance(error, BrokenProcessPool):
            self._discard_process()
            error = LocatkError(
                f"the process of the {task.name} was ended", hint="Free some memory"
            )
        return task, future.result() if error is None else error

    def close(self) -> None:
        """End the process, whatever it does."""
        if self._executor is None:
            return
        processes = list((getattr(self._executor, "_processes", None) or {}).values())
        self._executor.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            with contextlib.suppress(Exception):
                process.terminate()


def _lower_priority() -> None:
    """Leave signals of the terminal to the main process, and the processor too."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with contextlib.suppress(AttributeError, OSError):
        os.nice(NICENESS)
