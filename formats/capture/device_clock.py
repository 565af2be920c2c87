"""The clock of one device, for as long as it can be believed.

:class:`locatk.core.clock_sync.TickClock` learns by how many ppm a clock is off. A device that
counts twice as fast as it says is another matter: a firmware that means milliseconds, or a
recording that is played faster. Its ticks tell nothing of the host's time.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.clock_sync import RATE_LIMIT, TickClock
from locatk.formats.devices.decoder import Ticks

Ints = NDArray[np.int64]

WINDOW_NS = 5_000_000_000
"""Over so much time ticks are compared with arrivals, twice: what comes late at the end of
one window is missing in the next."""


class DeviceTime:
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
        if self._passed >= WINDOW_NS * len(self._last):
            self._judge(1e9 * self._ticked / self.ticks.hz / self._passed)
            self._ticked = self._passed = 0

    def _judge(self, rate: float) -> None:
        off = (rate - 1.0, (self._before or rate) - 1.0)
        if self._before is not None and (min(off) > RATE_LIMIT or max(off) < -RATE_LIMIT):
            self.rate = rate
        self._before = rate
