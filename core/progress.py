"""Progress of long computations, for a caller that shows it.

A stage reports how many of its items are done. The observer belongs to the context of the call
(:mod:`contextvars`), so that solvers need no parameter for it, and calls in other threads and
processes report nothing unless they are observed themselves.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from typing import TypeVar

T = TypeVar("T")

Observer = Callable[[str, int, int], None]
"""Takes the name of the items (as in ``"frames"``), how many are done, and their total."""

_observer: ContextVar[Observer | None] = ContextVar("observer", default=None)


@contextlib.contextmanager
def observed(observer: Observer) -> Iterator[None]:
    """Return a context manager; ``observer`` is called with the progress of computations in it."""
    token = _observer.set(observer)
    try:
        yield
    finally:
        _observer.reset(token)


def report(items: str, done: int, total: int) -> None:
    """Report that ``done`` of ``total`` items are done."""
    observer = _observer.get()
    if observer is not None:
        observer(items, done, total)


def track(sequence: Sequence[T], items: str) -> Iterator[T]:
    """Yield the elements of a sequence.

    Reports how many ``items`` are done before each element, and after the last one.
    """
    for done, element in enumerate(sequence):
        report(items, done, len(sequence))
        yield element
    report(items, len(sequence), len(sequence))
