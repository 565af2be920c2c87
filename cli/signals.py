"""Commands that run until they are told to stop, and then finish what they do."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType

KINDS = ("SIGINT", "SIGTERM", "SIGHUP")
"""Ctrl-C, the end of a service, a terminal that was closed."""

AGAIN_S = 1.0


@contextlib.contextmanager
def asked_to_stop(stop: Callable[[], None]) -> Iterator[None]:
    """Let the first of these signals call ``stop``.

    Others may follow at once: a terminal that is closed sends SIGHUP twice, and wrappers
    send on what the group has got already. They change nothing; only a Ctrl-C that comes
    :data:`AGAIN_S` later is as always. Signals that are ignored (nohup) stay so.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    first: list[float] = []
    kinds = [getattr(signal, name) for name in KINDS if hasattr(signal, name)]
    before = {kind: signal.getsignal(kind) for kind in kinds}
    before = {kind: usual for kind, usual in before.items() if usual != signal.SIG_IGN}

    def note(number: int, frame: FrameType | None) -> None:
        if not first:
            first.append(time.monotonic())
            stop()
        elif number == signal.SIGINT and time.monotonic() - first[0] > AGAIN_S:
            signal.default_int_handler(number, frame)

    for kind in before:
        signal.signal(kind, note)
    try:
        yield
    finally:
        for kind, usual in before.items():
            signal.signal(kind, usual)
