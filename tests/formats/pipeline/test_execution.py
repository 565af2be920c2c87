"""Execution of jobs: each has one result, even if processes die."""

from __future__ import annotations

import contextlib
import errno
import importlib
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from functools import partial
from multiprocessing import forkserver
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from locatk.formats.output import remove_stale_parts
from locatk.formats.pipeline import execution
from locatk.formats.pipeline.execution import (
    MAX_FAILED_STARTS,
    LostJob,
    Pool,
    in_order,
    processes,
    run_jobs,
    this_process,
)

JOBS = """
import os, signal, time
from pathlib import Path

def work(job):
    folder, number, how = job
    with open(folder / f"calls-{number}", "a") as stream:
        stream.write("x")
    if how == "deadly" or (how == "once" and (folder / f"calls-{number}").stat().st_size == 1):
        os.kill(os.getpid(), signal.SIGKILL)
    if how == "exit":
        os._exit(0)
    if how == "raise":
        raise ValueError("no good")
    if how == "late":
        time.sleep(0.3)
    if how == "write":
        from locatk.formats.output import atomic_write

        # The system frees the memory of a killed process before it releases its locks.
        memory = b"x" * (256 << 20)
        with atomic_write(folder / "output"):
            time.sleep(60)
    return number * number

def environment(name):
    return os.environ.get(name)
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """Jobs that other processes can import."""
    (tmp_path / "locatk_test_jobs.py").write_text(JOBS)
    monkeypatch.syspath_prepend(tmp_path)
    importlib.invalidate_caches()
    yield importlib.import_module("locatk_test_jobs")
    import sys

    del sys.modules["locatk_test_jobs"]


def calls(folder: Path, number: int) -> int:
    path = folder / f"calls-{number}"
    return path.stat().st_size if path.exists() else 0


@pytest.mark.slow
@pytest.mark.parametrize("pool", [this_process(), processes(3)], ids=["serial", "processes"])
def test_each_job_has_its_result(module: ModuleType, tmp_path: Path, pool: Pool) -> None:
    kinds = ["late", "", "raise", "", "late", ""]
    jobs = [(tmp_path, number, how) for number, how in enumerate(kinds)]
    results = dict(run_jobs(module.work, jobs, pool))
    assert results == {
        0: 0,
        1: 1,
        2: LostJob("ValueError: no good", "Please report it"),
        3: 9,
        4: 16,
        5: 25,
    }
    assert [calls(tmp_path, number) for number in results] == [1] * 6


@pytest.mark.slow
def test_a_deadly_job_takes_no_other_along(module: ModuleType, tmp_path: Path) -> None:
    kinds = ["late", "deadly", "late", "", "once", "exit", "", ""]
    jobs = [(tmp_path, number, how) for number, how in enumerate(kinds)]
    cleaned: list[int] = []
    found = list(run_jobs(module.work, jobs, processes(2), clean=lambda j: cleaned.append(j[1])))
    assert sorted(number for number, _ in found) == list(range(8))  # nothing lost, nothing twice
    results = dict(found)
    died = LostJob("its process died 2 times")
    assert [n for n, result in results.items() if result == died] == [1, 5]
    assert {n: r for n, r in results.items() if r != died} == {n: n * n for n in (0, 2, 3, 4, 6, 7)}
    assert {1, 4, 5} <= set(cleaned)
    assert calls(tmp_path, 1) <= 3  # with others, then twice alone
    assert calls(tmp_path, 7) == 1  # after all deaths: left in peace


@pytest.mark.slow
def test_workers_have_our_environment_but_one_thread(
    module: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.setenv("LOCATK_TEST", "later than the server that forks")
    names = ["OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "LOCATK_TEST"]
    found = dict(run_jobs(module.environment, names, processes(1)))
    assert found == {0: "1", 1: "1", 2: "later than the server that forks"}
    assert os.environ["OMP_NUM_THREADS"] == "7"


@pytest.mark.slow
def test_an_interrupt_ends_the_workers(module: ModuleType, tmp_path: Path) -> None:
    jobs = [(tmp_path, 0, ""), (tmp_path, 1, "late"), (tmp_path, 2, "late"), (tmp_path, 3, "late")]
    cleaned: list[int] = []
    results = run_jobs(module.work, jobs, processes(2), clean=lambda job: cleaned.append(job[1]))
    next(results)
    with pytest.raises(KeyboardInterrupt):
        results.throw(KeyboardInterrupt())
    assert calls(tmp_path, 3) == 0
    assert 1 in cleaned


def test_results_are_yielded_in_order() -> None:
    came = iter([(2, "c"), (0, "a"), (3, "d"), (1, "b")])
    assert list(in_order(came)) == [(1, []), (2, ["a"]), (3, []), (4, ["b", "c", "d"])]


class _FailingExecutor(Executor):
    """Executor whose fork server has died: the first ``failures`` submissions fail."""

    failures = 0

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        if _FailingExecutor.failures:
            _FailingExecutor.failures -= 1
            raise EOFError
        future: Future[Any] = Future()
        future.set_result(function(*args, **kwargs))
        return future


@pytest.mark.parametrize("failures", [1, 2])
def test_a_dead_fork_server_is_started_again(
    failures: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(execution, "RESTART_DELAY_S", 0.0)
    _FailingExecutor.failures = failures
    results = dict(run_jobs(abs, [-1, -2, -3], Pool(lambda width: _FailingExecutor(), 2)))
    assert results == {0: 1, 1: 2, 2: 3}


class _LimitedExecutor(Executor):
    """Executor that refuses every second submission while the first job runs."""

    def __init__(self) -> None:
        self._submissions = 0

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        self._submissions += 1
        if self._submissions == 2:
            raise OSError(errno.EAGAIN, "Resource temporarily unavailable")
        future: Future[Any] = Future()
        finish = partial(future.set_result, function(*args, **kwargs))
        threading.Timer(0.01, finish).start()
        return future


def test_a_process_that_is_refused_is_no_death_of_another(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(execution, "MAX_DEATHS", 1)
    pool = Pool(lambda width: contextlib.nullcontext(_LimitedExecutor()), 2)
    assert dict(run_jobs(abs, [-1, -2, -3], pool)) == {0: 1, 1: 2, 2: 3}


def test_all_jobs_are_given_up_without_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(execution, "RESTART_DELAY_S", 0.0)
    _FailingExecutor.failures = 1000
    results = dict(run_jobs(abs, [-1, -2, -3], Pool(lambda width: _FailingExecutor(), 2)))
    assert sorted(results) == [0, 1, 2]
    assert {result.reason for result in results.values()} == {
        "no process could be started (EOFError)"
    }
    assert 1000 - _FailingExecutor.failures == MAX_FAILED_STARTS


@pytest.mark.slow
@pytest.mark.skipif(
    "forkserver" not in multiprocessing.get_all_start_methods(), reason="no fork server"
)
def test_a_killed_fork_server_loses_no_job(module: ModuleType, tmp_path: Path) -> None:
    jobs = [(tmp_path, number, "late") for number in range(4)]
    results = run_jobs(module.work, jobs, processes(2))
    found = [next(results)]
    os.kill(forkserver._forkserver._forkserver_pid, signal.SIGKILL)  # type: ignore[attr-defined]
    assert dict([*found, *results]) == {n: n * n for n in range(4)}


@pytest.mark.slow
def test_files_of_workers_that_end_slowly_are_removed(module: ModuleType, tmp_path: Path) -> None:
    def clean(job: Any) -> None:
        remove_stale_parts(tmp_path / "output")

    jobs = [(tmp_path, 0, ""), (tmp_path, 1, "write")]
    results = run_jobs(module.work, jobs, processes(2), clean=clean)
    assert next(results) == (0, 0)
    deadline = time.monotonic() + 20
    while not list(tmp_path.glob(".output.*")):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    results.close()
    assert list(tmp_path.glob(".output.*")) == []


def interrupt(job: int) -> None:
    signal.raise_signal(signal.SIGINT)


def test_a_job_in_this_process_is_interrupted() -> None:
    cleaned: list[int] = []
    done: list[int] = []

    def work(job: int) -> None:
        interrupt(job)
        done.append(job)

    with pytest.raises(KeyboardInterrupt):
        list(run_jobs(work, [7, 8], this_process(), clean=cleaned.append))
    assert (done, cleaned) == ([], [7])


def test_the_start_of_a_worker_is_not_interrupted(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[int] = []

    def start(executor: Any) -> None:
        interrupt(0)
        started.append(0)

    monkeypatch.setattr(ProcessPoolExecutor, "_start_executor_manager_thread", start)
    monkeypatch.setattr(ProcessPoolExecutor, "_adjust_process_count", lambda executor: None)
    cleaned: list[int] = []
    with pytest.raises(KeyboardInterrupt):
        list(run_jobs(abs, [7, 8], processes(2), clean=cleaned.append))
    assert (started, cleaned) == ([0], [7])
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


class _DyingExecutor(Executor):
    """Executor whose worker dies with each job."""

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_exception(BrokenExecutor())
        return future


def test_an_interrupt_after_the_death_of_a_worker_leaves_no_files() -> None:
    cleaned: list[int] = []

    def clean(job: int) -> None:
        cleaned.append(job)
        if len(cleaned) == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        list(run_jobs(abs, [7, 8], Pool(lambda width: _DyingExecutor(), 2), clean=clean))
    assert sorted(cleaned[1:]) == [7, 8]
