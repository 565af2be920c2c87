"""The host's clock of a recording: anchored once to the epoch, never set back."""

from __future__ import annotations

import time
from collections.abc import Callable


def steady_ns() -> int:
    """Nanoseconds of a clock that nobody sets; it runs on while the machine sleeps, where
    the system has such a clock."""
    boot = getattr(time, "CLOCK_BOOTTIME", None)
    return time.monotonic_ns() if boot is None else time.clock_gettime_ns(boot)


class HostClock:
    """Nanoseconds since 1970 that only ever grow.

    The wall clock is read once. When somebody, or NTP, sets it later, the times of the
    recording stay as they were and :meth:`stepped_ns` tells by how much the two differ.

    Parameters
    ----------
    steady, wall : callable
        The clocks, in ns; tests give their own.
    """

    def __init__(
        self,
        steady: Callable[[], int] = steady_ns,
        wall: Callable[[], int] = time.time_ns,
    ) -> None:
        self._steady, self._wall = steady, wall
        self._anchor = wall() - steady()

    def now(self) -> int:
        """Time in ns since the epoch."""
        return self._anchor + self._steady()

    def stepped_ns(self) -> int:
        """By how much the wall clock was set since the start; positive when forward."""
        return self._wall() - self.now()
