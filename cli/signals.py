"""Commands that run until they are told to stop, and then finish what they do."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator

KINDS = ("SIGINT", "SIGTERM", "SIGHUP")
"""Ctrl-C, the end of a service, a terminal that was closed."""


@contextlib.contextmanager
def asked_to_stop(stop: Callable[[], None]) -> Iterator[list[int]]:
    """Let the first of these signals call ``stop``; a second one is as always.

    The list is of those that came. Signals that are ignored (nohup) stay so.
    """
    caught: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield caught
        return
    kinds = [getattr(signal, name) for name in KINDS if hasattr(signal, name)]
    before = {kind: signal.getsignal(kind) for kind in kinds}
    before = {kind: usual for kind, usual in before.items() if usual != signal.SIG_IGN}

    def restore() -> None:
        for kind, usual in before.items():
            signal.signal(kind, usual)

    def note(number: int, _: object) -> None:
        caught.append(number)
        stop()
        restore()

    for kind in before:
        signal.signal(kind, note)
    try:
        yield caught
    finally:
        restore()
