"""Orderly end of commands that run until a signal stops them."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType

STOP_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP")
"""Signals of Ctrl-C, of a stopped service, and of a closed terminal."""

REPEAT_DELAY_S = 1.0
"""Time after which another Ctrl-C interrupts the command [s]; earlier ones are duplicates."""


@contextlib.contextmanager
def asked_to_stop(stop: Callable[[], None]) -> Iterator[None]:
    """Call ``stop`` at the first of :data:`STOP_SIGNALS` in the context.

    Signals may arrive in groups: a closed terminal sends SIGHUP twice, and wrappers forward
    signals that the process group has received already. They have no effect; only a Ctrl-C after
    :data:`REPEAT_DELAY_S` acts as usual. Ignored signals (nohup) stay ignored.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    first_time_s: list[float] = []
    numbers = [getattr(signal, name) for name in STOP_SIGNALS if hasattr(signal, name)]
    handlers = {number: signal.getsignal(number) for number in numbers}
    handlers = {number: old for number, old in handlers.items() if old != signal.SIG_IGN}

    def handle(number: int, frame: FrameType | None) -> None:
        if not first_time_s:
            first_time_s.append(time.monotonic())
            stop()
        elif number == signal.SIGINT and time.monotonic() - first_time_s[0] > REPEAT_DELAY_S:
            signal.default_int_handler(number, frame)

    for number in handlers:
        signal.signal(number, handle)
    try:
        yield
    finally:
        for number, old in handlers.items():
            signal.signal(number, old)
