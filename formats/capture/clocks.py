"""Clocks of a recording: the host's, arrival times of bytes, and tick counters of devices."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from locatk.core.clock_sync import RATE_LIMIT, TickClock
from locatk.formats.devices.interface import Ticks

Ints = NDArray[np.int64]


def steady_ns() -> int:
    """Return nanoseconds of a monotonic clock.

    It includes the time in which the machine sleeps, if the system has such a clock.
    """
    boot = getattr(time, "CLOCK_BOOTTIME", None)
    return time.monotonic_ns() if boot is None else time.clock_gettime_ns(boot)


class HostClock:
    """Nanoseconds since 1970 that never decrease.

    The wall clock is read once. If it is set later, by hand or NTP, the times of the recording do
    not change, and :meth:`stepped_ns` returns the difference.

    Parameters
    ----------
    steady, wall : callable
        Monotonic clock and wall clock, in ns.
    """

    def __init__(
        self,
        steady: Callable[[], int] = steady_ns,
        wall: Callable[[], int] = time.time_ns,
    ) -> None:
        self._steady, self._wall = steady, wall
        self._anchor = wall() - steady()

    def now(self) -> int:
        """Return the time in ns since the epoch."""
        return self._anchor + self._steady()

    def stepped_ns(self) -> int:
        """Return the time by which the wall clock was set since the start; positive if forward."""
        return self._wall() - self.now()


class ReplayClock(HostClock):
    """Clock of a replay whose bytes have the times of their recording: that of the newest byte."""

    def __init__(self) -> None:
        super().__init__()
        self._time_ns: int | None = None

    def set(self, time_ns: int) -> None:
        """Set the time to that of a byte; it never decreases."""
        self._time_ns = max(time_ns, self._time_ns or 0)

    def now(self) -> int:
        """Return the time in ns since the epoch: that of the host before the first byte."""
        return super().now() if self._time_ns is None else self._time_ns

    def stepped_ns(self) -> int:
        """Return 0: the wall clock does not matter."""
        return 0


MIN_KEPT_READS = 1 << 16
"""Reads whose times are kept: decoders that search for the start of a frame hold records back."""


class ArrivalTimes:
    """Times at which the bytes of a stream were read.

    Parameters
    ----------
    byte_ns : float
        Transmission time of one byte, which separates frames of one read.
    """

    def __init__(self, byte_ns: float = 0.0) -> None:
        self.byte_ns = byte_ns
        self._end = np.zeros(2 * MIN_KEPT_READS, np.int64)
        self._time = np.zeros(2 * MIN_KEPT_READS, np.int64)
        self._count = 0

    def add(self, end: int, time_ns: int) -> None:
        """Add a read: the bytes up to ``end`` had arrived at ``time_ns``; neither may decrease."""
        if self._count == len(self._end):
            for array in (self._end, self._time):
                array[:MIN_KEPT_READS] = array[-MIN_KEPT_READS:]
            self._count = MIN_KEPT_READS
        self._end[self._count] = end
        self._time[self._count] = time_ns
        self._count += 1

    def read_ns(self, end: Ints) -> Ints:
        """Return the times (n,) of the reads with the bytes before ``end`` (n,)."""
        return self._time[self._read_index(end)]

    def wire_ns(self, end: Ints) -> Ints:
        """Return estimated times (n,) on the wire of the last byte before ``end`` (n,).

        That is the time of its read, minus the transmission time of the bytes after it, but not
        before the previous read.
        """
        index = self._read_index(end)
        late = (self.byte_ns * (self._end[index] - end)).astype(np.int64)
        before = np.where(index > 0, self._time[index - 1], np.iinfo(np.int64).min)
        return np.maximum(self._time[index] - late, np.minimum(before, self._time[index]))

    def _read_index(self, end: Ints) -> Ints:
        index = np.searchsorted(self._end[: self._count], end, side="left")
        return np.minimum(index, self._count - 1)


RATE_WINDOW_NS = 5_000_000_000
"""Duration of the two windows in which ticks are compared with arrival times: a delay at the end
of one window makes the next one shorter."""


class DeviceClock:
    """Clock model of one device, as long as its tick rate is plausible.

    :class:`locatk.core.clock_sync.TickClock` estimates drifts in ppm. The ticks of a device whose
    rate is far from the nominal one, such as a firmware that counts milliseconds or a recording
    that is replayed faster, are not related to the host's time.

    Parameters
    ----------
    ticks : Ticks

    Attributes
    ----------
    ticks : Ticks
    model : TickClock
    rate : float or None
        Ratio of its tick rate to the nominal one, if that is not plausible.
    """

    def __init__(self, ticks: Ticks) -> None:
        self.ticks = ticks
        self.model = TickClock(ticks.hz, ticks.bits)
        self.rate: float | None = None
        self._last: dict[str, tuple[int, int]] = {}
        self._ticked = self._passed = 0
        self._before: float | None = None

    def times(self, topic: str, tick: Ints, read_ns: Ints) -> Ints | None:
        """Return host times (n,) of ``tick`` (n,), none after its arrival.

        Return None if the tick rate is implausible. ``topic`` separates the streams of the device.
        """
        if len(tick) == 1:
            self._compare_single(topic, int(tick[0]), int(read_ns[0]))
        else:
            self._compare(topic, tick, read_ns)
        if self.rate is not None:
            return None
        return np.minimum(self.model.times(tick, read_ns), read_ns)

    def restart(self) -> None:
        """Restart the model after a reconnect."""
        self.model.restart()
        self._last.clear()
        self._ticked = self._passed = 0
        self._before = self.rate = None

    def _compare_single(self, topic: str, tick: int, read_ns: int) -> None:
        """Compare one tick as :meth:`_compare`, in a tenth of the time."""
        last = self._last.get(topic)
        if last is not None:
            tick_step, time_step = tick - last[0], read_ns - last[1]
            max_step_ns = float("inf")
            if self.ticks.bits < 63:
                tick_step &= (1 << self.ticks.bits) - 1
                max_step_ns = 0.5e9 * (1 << self.ticks.bits) / self.ticks.hz
            is_usable = tick_step >= 0 and time_step < max_step_ns
            if is_usable and tick_step * (1e9 / self.ticks.hz) < max_step_ns:
                self._ticked += tick_step
                self._passed += time_step
        self._last[topic] = (tick, read_ns)
        if self._passed >= RATE_WINDOW_NS * len(self._last):
            self._judge(1e9 * self._ticked / self.ticks.hz / self._passed)
            self._ticked = self._passed = 0

    def _compare(self, topic: str, tick: Ints, read_ns: Ints) -> None:
        last = self._last.get(topic)
        if last is not None:
            tick_step = np.diff(tick, prepend=last[0])
            time_step = np.diff(read_ns, prepend=last[1])
            max_step_ns = np.inf
            if self.ticks.bits < 63:
                tick_step &= (1 << self.ticks.bits) - 1
                max_step_ns = 0.5e9 * (1 << self.ticks.bits) / self.ticks.hz
            # After a long silence, or backward, the number of wraps of the counter is unknown.
            usable = (tick_step >= 0) & (time_step < max_step_ns)
            usable &= tick_step * (1e9 / self.ticks.hz) < max_step_ns
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
