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
"""Takes the name of the items, the number of those that are done, and their total."""

_observer: ContextVar[Observer | None] = ContextVar("observer", default=None)


@contextlib.contextmanager
def observed(observer: Observer) -> Iterator[None]:
    """Call ``observer`` with the progress of computations in this context."""
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
    """Yield the elements of a sequence, and report each that is done."""
    for done, element in enumerate(sequence):
        report(items, done, len(sequence))
        yield element
    report(items, len(sequence), len(sequence))
