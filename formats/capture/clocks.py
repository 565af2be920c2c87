"""The host's clock of a recording: anchored once to the epoch, never set back."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from locatk.core.clock_sync import RATE_LIMIT, TickClock
from locatk.formats.devices.decoder import Ticks

Ints = NDArray[np.int64]


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


MIN_KEPT_READS = 1 << 16
"""So many reads are remembered at least: decoders that look for the start of a frame hold
records back."""


class ArrivalTimes:
    """Places in a stream of bytes, and when each was read.

    Parameters
    ----------
    byte_ns : float
        How long one byte takes on the wire. Frames that came in one read are told apart by
        the bytes between their ends.
    """

    def __init__(self, byte_ns: float = 0.0) -> None:
        self.byte_ns = byte_ns
        self._end = np.zeros(2 * MIN_KEPT_READS, np.int64)
        self._time = np.zeros(2 * MIN_KEPT_READS, np.int64)
        self._count = 0

    def add(self, end: int, time_ns: int) -> None:
        """The bytes up to ``end`` had arrived at ``time_ns``; both never descend."""
        if self._count == len(self._end):
            for array in (self._end, self._time):
                array[:MIN_KEPT_READS] = array[-MIN_KEPT_READS:]
            self._count = MIN_KEPT_READS
        self._end[self._count] = end
        self._time[self._count] = time_ns
        self._count += 1

    def read_ns(self, end: Ints) -> Ints:
        """(n,) when the reads were that brought the bytes before ``end`` (n,)."""
        return self._time[self._place(end)]

    def wire_ns(self, end: Ints) -> Ints:
        """(n,) when the last byte before ``end`` (n,) was on the wire, as near as is known:
        earlier than its read by the bytes that came after it, never before the read before.
        """
        place = self._place(end)
        late = (self.byte_ns * (self._end[place] - end)).astype(np.int64)
        before = np.where(place > 0, self._time[place - 1], np.iinfo(np.int64).min)
        return np.maximum(self._time[place] - late, np.minimum(before, self._time[place]))

    def _place(self, end: Ints) -> Ints:
        found = np.searchsorted(self._end[: self._count], end, side="left")
        return np.minimum(found, self._count - 1)


RATE_WINDOW_NS = 5_000_000_000
"""Over so much time ticks are compared with arrivals, twice: what comes late at the end of
one window is missing in the next."""


class DeviceClock:
    """Times of what one device measured.

    Parameters
    ----------
    ticks : Ticks

    Attributes
    ----------
    ticks : Ticks
    clock : TickClock
    rate : float or None
        By how much its clock runs faster than it says, where it cannot be believed.
    """

    def __init__(self, ticks: Ticks) -> None:
        self.ticks = ticks
        self.clock = TickClock(ticks.hz, ticks.bits)
        self.rate: float | None = None
        self._last: dict[str, tuple[int, int]] = {}
        self._ticked = self._passed = 0
        self._before: float | None = None

    def times(self, topic: str, tick: Ints, read_ns: Ints) -> Ints | None:
        """Host times (n,) of ``tick`` (n,), none later than its arrival; None where the clock
        cannot be believed. ``topic`` tells the streams of the device apart."""
        self._compare(topic, tick, read_ns)
        if self.rate is not None:
            return None
        return np.minimum(self.clock.times(tick, read_ns), read_ns)

    def restart(self) -> None:
        """The device was away."""
        self.clock.restart()
        self._last.clear()
        self._ticked = self._passed = 0
        self._before = self.rate = None

    def _compare(self, topic: str, tick: Ints, read_ns: Ints) -> None:
        last = self._last.get(topic)
        if last is not None:
            tick_step = np.diff(tick, prepend=last[0])
            time_step = np.diff(read_ns, prepend=last[1])
            most_ns = np.inf
            if self.ticks.bits < 63:
                tick_step &= (1 << self.ticks.bits) - 1
                most_ns = 0.5e9 * (1 << self.ticks.bits) / self.ticks.hz
            # Over a silence, or backward, nobody knows how often the counter began anew.
            usable = (tick_step >= 0) & (time_step < most_ns)
            usable &= tick_step * (1e9 / self.ticks.hz) < most_ns
            self._ticked += int(tick_step[usable].sum())
            self._passed += int(time_step[usable].sum())
        self._last[topic] = (int(tick[-1]), int(read_ns[-1]))
        if self._passed >= RATE_WINDOW_NS * len(self._last):
            self._judge(1e9 * self._ticked / self.ticks.hz / self._passed)
            self._ticked = self._passed = 0

    def _judge(self, rate: float) -> None:
        off = (rate - 1.0, (self._before or rate) - 1.0)
        if self._before is not None and (min(off) > RATE_LIMIT or max(off) < -RATE_LIMIT):
            self.rate = rate
        self._before = rate
