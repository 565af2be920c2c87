"""One function over many jobs: whatever dies on the way, each job has one result.

The engine knows neither files nor solvers. A job that ends its process (the kernel takes its
memory, a library crashes) takes the jobs beside it along, and nothing tells which it was.
So all that were under way are run again, each alone; the one that ends its process alone,
and again, is the one.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, TypeVar

J = TypeVar("J")

DEATHS = 2
"""So many processes a job may end, alone in them, before it is given up."""


@dataclass(frozen=True)
class Pool:
    """Where jobs run.

    Attributes
    ----------
    open : callable
        ``open(n)`` gives an executor of ``n`` workers; leaving its context by an exception ends
        them at once.
    width : int or None
        Jobs under way at a time; None leaves it to the executor.
    watched : bool
        A worker that dies breaks the executor, so that its death is seen. Elsewhere the executor
        replaces it unseen.
    """

    open: Callable[[int], AbstractContextManager[Executor]]
    width: int | None
    watched: bool = True


@dataclass(frozen=True)
class Lost:
    """In place of a result: why there is none, and what to do about it."""

    reason: str
    hint: str = "It may need more memory than there is: try it alone"


def run(
    function: Callable[[J], Any],
    jobs: Sequence[J],
    pool: Pool,
    *,
    clean: Callable[[J], None] = lambda job: None,
) -> Generator[tuple[int, Any], None, None]:
    """Run ``function`` on each job; yield (number of the job, result) as they come.

    Parameters
    ----------
    function : callable
        Of a module, so that other processes find it. It may be called again for a job whose
        worker died, and is to tell of failures in its result.
    jobs : sequence
        What it is called with.
    pool : Pool
        Where.
    clean : callable
        Called with each job that may have been cut off in the middle, to remove what it left.

    Yields
    ------
    (int, object)
        Each job once; its result is :class:`Lost` where its worker died time and again, where
        the cluster gave it up, or where ``function`` raised.
    """
    queue = deque(range(len(jobs)))
    suspects: deque[int] = deque()
    deaths: Counter[int] = Counter()
    while queue or suspects:
        alone = bool(suspects)
        width = 1 if alone else (pool.width or len(jobs))
        flying: dict[Future[Any], int] = {}
        try:
            with pool.open(width) as executor:
                source = suspects if alone else queue
                while source or flying:
                    while source and len(flying) < width:
                        flying[executor.submit(function, jobs[source[0]])] = source[0]
                        source.popleft()
                    done, _ = wait(flying, return_when=FIRST_COMPLETED)
                    broken = [f for f in done if isinstance(_error(f), BrokenExecutor)]
                    for future in done.difference(broken):
                        number = flying.pop(future)
                        if not pool.watched:
                            clean(jobs[number])
                        error = _error(future)
                        yield number, future.result() if error is None else _lost(error)
                    if broken:
                        raise _BrokenPool
        except (_BrokenPool, BrokenExecutor):
            fallen = sorted(flying.values())
            for number in fallen:
                clean(jobs[number])
            if len(fallen) == 1:
                [number] = fallen
                deaths[number] += 1
                if deaths[number] >= DEATHS:
                    yield number, Lost(f"its process died {DEATHS} times")
                    continue
            suspects.extendleft(reversed(fallen))
        except BaseException:
            for number in flying.values():
                clean(jobs[number])
            raise


def in_order(results: Iterator[tuple[int, Any]]) -> Iterator[tuple[int, list[Any]]]:
    """How many results are in, and those whose turn has come, for each that comes in."""
    early: dict[int, Any] = {}
    turn = 0
    for count, (number, result) in enumerate(results, 1):
        early[number] = result
        ready = []
        while turn in early:
            ready.append(early.pop(turn))
            turn += 1
        yield count, ready


class _BrokenPool(Exception):
    """A worker died."""


def _error(future: Future[Any]) -> BaseException | None:
    """What a finished future raises."""
    return _Cancelled() if future.cancelled() else future.exception()


class _Cancelled(Exception):
    """The executor dropped the job."""


def _lost(error: BaseException) -> Lost:
    if isinstance(error, _Cancelled):
        hint = "See that it runs, and do again what is left"
        return Lost("the connection to the scheduler was lost", hint)
    if type(error).__name__ == "KilledWorker":  # of distributed, which need not be there
        return Lost("its worker died time and again")
    told = " ".join(str(error).split())
    return Lost(f"{type(error).__name__}: {told}", "Please report it")
