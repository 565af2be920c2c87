"""Online synchronization of a device's tick counter with the clock of the host.

A sample is measured at a tick of the device's counter and arrives at the host after a delay that is
never negative and often varies: USB polls once per millisecond, a busy host reads in bursts. The
line of host time over ticks is therefore the one that touches the arrivals from below: an edge of
their lower convex hull (Zhang, Liu, Xia: Clock synchronization algorithms for network measurements,
INFOCOM 2002). It is fitted to the smallest delay in every :data:`BIN_S` over the last
:data:`WINDOW_S`, so that memory is bounded and the drift of a warming clock is followed.

The smallest delay itself is not observable: times are late by it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Times = NDArray[np.int64]
Array = NDArray[np.float64]

BIN_S = 0.5
"""Time over which only the arrival of the smallest delay is kept."""

WINDOW_S = 120.0
"""Time over which the line is fitted."""

MIN_FIT_S = 2.0
"""Shortest time over which a rate is estimated; before, it is the nominal one."""

RATE_LIMIT = 0.1
"""Largest relative difference from the nominal rate that is accepted: ceramic resonators deviate by
less than a percent, RC oscillators by a few."""

SETTLE_S = 1.0
"""Time over which the mapping approaches a better line, so that times do not jump."""

SLEW_LIMIT = 0.25
"""Largest relative change of the rate during that approach, which takes longer if necessary."""

JUMP_S = 1.0
"""Smallest difference from host time of a wrong tick, or of a clock that was set. For a counter
that wraps within 16 s it is a sixteenth of its period."""

MAX_LAG_S = 2.0
"""Longest time for which ticks may lag by more than a jump because the host was busy. After that
the counter is assumed to have stopped."""

MIN_AGREEING_JUMPS = 3
"""Number of successive jumping ticks that must agree to be taken for a restart of the device; fewer
are taken for wrong ticks."""

MAX_KNOTS = 256
"""Largest number of corners of the mapping that are kept for late ticks."""

MAX_DELAYS = 4096
"""Number of last delays from which the jitter is computed."""

MAX_DELAYS_PER_CALL = 64
"""About the number of delays of one call that count for the jitter."""

_PIECE_NS = int(BIN_S * 1e9)

_NOMINAL_RATE_UNCERTAINTY = 0.02
_LEARNED_RATE_UNCERTAINTY = 1e-4
"""Relative uncertainty of the rate, for predictions by host time after a silence."""


@dataclass
class _Era:
    """State between two starts of the device.

    Ticks are relative to one of the first, host times in ns to its arrival: both are small enough
    for float64 to resolve nanoseconds over months.
    """

    tick: int
    arrival_ns: int
    rate: float
    """Nanoseconds per tick."""
    learned: bool = False
    origin: float = 0.0
    """Host time of tick 0 on the line."""
    start: float = 0.0
    """The same, as long as the window included tick 0."""
    newest: float = -np.inf
    newest_arrival: float = 0.0
    late_since: float = np.inf
    earliest: dict[int, tuple[float, float]] = field(default_factory=dict)
    """Tick and arrival of the smallest delay, by bin."""
    knots: Array = field(default_factory=lambda: np.zeros((0, 2)))
    """Corners (tick, host time) of the mapping: departures from a line, arrivals at the next."""
    target: tuple[float, float] = (0.0, 0.0)
    """The line that it follows from the last corner on: host time of tick 0, and rate."""
    departure: float = 0.0
    """Tick at which it left the last line."""

    def mapped(self, x: Array) -> Array:
        """Return the host times of ticks."""
        knots, (origin, rate) = self.knots, self.target
        line: Array = origin + rate * x
        if x.min() >= knots[-1, 0]:
            return line
        line = np.where(x < knots[0, 0], knots[0, 1] + rate * (x - knots[0, 0]), line)
        inside = np.interp(x, knots[:, 0], knots[:, 1])
        return np.where((x < knots[0, 0]) | (x > knots[-1, 0]), line, inside)

    def follow(self) -> None:
        """Let the mapping approach the current line, from the newest mapped tick on."""
        origin, rate = self.origin, self.rate
        if not len(self.knots):
            self.target, self.knots = (origin, rate), np.array([(0.0, origin)])
            return
        departure = max(self.newest, self.knots[0, 0])
        time = float(self.mapped(np.array([departure]))[0])
        kept = self.knots[self.knots[:, 0] < departure][-MAX_KNOTS:]
        distance = abs(time - (origin + rate * departure))
        arrival = departure + max(SETTLE_S * 1e9, distance / SLEW_LIMIT) / rate
        self.knots = np.vstack([kept, (departure, time), (arrival, origin + rate * arrival)])
        self.target, self.departure = (origin, rate), departure


class TickClock:
    """Map a device's ticks to host time, from the ticks and their times of arrival.

    The mapping is online and causal: a call uses the arrivals up to it. Between two starts of the
    device it is continuous and ascends with the ticks; it approaches a better estimate gradually
    (:data:`SETTLE_S`, :data:`SLEW_LIMIT`).

    Parameters
    ----------
    hz : float
        Nominal rate of the counter.
    bits : int
        Width of the counter, which wraps to 0; 63 or more for a counter that never wraps. The
        number of wraps during a silence follows from host time. For short counters (24 bits at
        24 MHz wrap every 0.7 s) this requires a known rate: an error of 1 % is tolerable for half a
        minute.

    Attributes
    ----------
    tick_count : int
        Number of ticks so far.
    restarts : int
        Number of detected restarts of the device.
    outliers : int
        Number of ticks that fit neither the ticks before nor those after; they are mapped to their
        times of arrival.
    """

    def __init__(self, hz: float, bits: int = 64) -> None:
        if not (np.isfinite(hz) and hz > 0 and bits > 0):
            raise ValueError(f"a counter of {bits} bits at {hz} Hz is impossible")
        self._nominal = 1e9 / hz
        self._wrap = 1 << bits if bits < 63 else 0
        wrap_ns = self._wrap * self._nominal or np.inf
        self._jump = min(JUMP_S * 1e9, wrap_ns / 16)
        self._first_jump = min(JUMP_S * 1e9, wrap_ns / 2)
        self._bin = BIN_S * hz
        self._era: _Era | None = None
        self._pending: list[tuple[int, int]] = []
        self._delays = np.zeros(MAX_DELAYS)
        self._n_delays = 0
        self.tick_count = 0
        self.restarts = 0
        self.outliers = 0

    @property
    def offset_ns(self) -> int | None:
        """Host time minus device time at the first tick since the last start, in ns."""
        if self._era is None:
            return None
        era = self._era
        return era.arrival_ns + round(era.start) - round(era.tick * self._nominal)

    @property
    def drift_ppm(self) -> float | None:
        """Relative deviation of the device's rate from the nominal one, in ppm.

        Positive for a fast device, over the last :data:`WINDOW_S`; None until it is estimated.
        """
        if self._era is None or not self._era.learned:
            return None
        return (self._nominal / self._era.rate - 1) * 1e6

    @property
    def jitter_ns(self) -> tuple[float, float] | None:
        """Median and 95th percentile of the last delays beyond the smallest one, in ns."""
        if not self._n_delays:
            return None
        delays = self._delays[: min(self._n_delays, MAX_DELAYS)]
        median, p95 = np.percentile(delays, [50, 95])
        return float(median), float(p95)

    def restart(self) -> None:
        """Forget the mapping and start again with the next tick, as after replugging the device.

        It does not count in :attr:`restarts`.
        """
        self._era = None
        self._pending = []

    def times(self, ticks: Times, arrival_ns: Times) -> Times:
        """Map ticks to host times (n,) in ns.

        Parameters
        ----------
        ticks : (n,) int64 ndarray
            As received, in the order of arrival. Streams that share the clock may be out of order
            relative to each other by less than half of the counter's range.
        arrival_ns : (n,) int64 ndarray
            Host time of each reception; never descending.
        """
        n = len(ticks)
        self.tick_count += n
        if n == 1:
            mapped = self._map_single(int(ticks[0]), int(arrival_ns[0]))
            if mapped is not None:
                return np.array([mapped], np.int64)
        out = np.empty(n, np.int64)
        if n and arrival_ns[-1] - arrival_ns[0] < _PIECE_NS:
            self._map(ticks, arrival_ns, out)
        elif n:
            # A recording in one call is mapped in pieces, as it would have been while it arrived.
            piece = (arrival_ns - arrival_ns[0]) // _PIECE_NS
            edges = [0, *(np.flatnonzero(np.diff(piece)) + 1).tolist(), n]
            for start, stop in pairwise(edges):
                self._map(ticks[start:stop], arrival_ns[start:stop], out[start:stop])
        return out

    def _map_single(self, tick: int, arrival_ns: int) -> int | None:
        """Map one tick that fits the mapping and does not change its line; otherwise return None.

        The result and the state are those of :meth:`_map_consistent`. With numbers instead of
        arrays it takes a tenth of the time, which counts if each sample is mapped as it arrives.
        """
        era = self._era
        if era is None or self._pending:
            return None
        x = float(tick - era.tick)
        arrival = float(arrival_ns - era.arrival_ns)
        if self._wrap:
            expected = (arrival - era.origin) / era.rate
            x += round((expected - x) / self._wrap) * self._wrap
        delay = arrival - (era.origin + era.rate * x)
        max_early, max_late = self._tolerance(era, arrival)
        is_ordinary = -max_early <= delay <= max_late and x >= era.newest - max_early / era.rate
        previous = era.earliest.get(int(x // self._bin))
        origin, rate = era.target
        (x0, y0), (x1, y1) = era.knots[-2:].tolist() if len(era.knots) > 1 else ((0, 0), (0, 0))
        if not is_ordinary or previous is None or x < x0:
            return None
        new_origin = era.origin + min(delay, 0.0)
        if new_origin != origin and era.newest > era.departure + self._bin / 10:
            return None
        if arrival - previous[1] < era.rate * (x - previous[0]):
            era.earliest[int(x // self._bin)] = (x, arrival)
        era.origin, era.late_since = new_origin, np.inf
        if min(era.earliest) <= 0:
            era.start = new_origin
        mapped = origin + rate * x if x >= x1 else (y1 - y0) / (x1 - x0) * (x - x0) + y0
        era.newest, era.newest_arrival = max(era.newest, x), arrival
        self._delays[self._n_delays % MAX_DELAYS] = arrival - mapped
        self._n_delays += 1
        return era.arrival_ns + round(mapped)

    def _map(self, ticks: Times, arrival_ns: Times, out: Times) -> None:
        """Map one piece into ``out``."""
        done = 0
        while done < len(ticks):
            done += self._map_consistent(ticks[done:], arrival_ns[done:], out[done:])

    def _map_consistent(self, ticks: Times, arrival_ns: Times, out: Times) -> int:
        """Map the leading ticks that all fit the mapping, or all do not; return their number."""
        era = self._era = self._era or self._begin(ticks, arrival_ns)
        x = self._unwrap(era, ticks, arrival_ns).astype(float)
        arrival = (arrival_ns - era.arrival_ns).astype(float)
        delay = arrival - (era.origin + era.rate * x)
        min_delay, last = float(delay.min()), float(arrival[-1])
        max_early, max_late = self._tolerance(era, last)
        min_tick = era.newest - max_early / era.rate
        if min_delay < -max_early or x.min() < min_tick:
            is_jump = (delay < -max_early) | (x < min_tick)
            count = int(np.argmin(is_jump == is_jump[0])) or len(x)
            if is_jump[0]:
                return self._map_jumps(ticks[:count], arrival_ns[:count], out)
            x, arrival, delay = x[:count], arrival[:count], delay[:count]
            min_delay, last = float(delay.min()), float(arrival[-1])
        self.outliers += len(self._pending)
        self._pending = []
        is_late = min_delay > max_late
        era.late_since = min(era.late_since, float(arrival[0])) if is_late else np.inf
        if last - era.late_since >= MAX_LAG_S * 1e9:
            self.restarts += 1
            self.restart()
            return 0
        newest = max(era.newest, float(x.max()))
        self._learn(era, x, arrival, delay)
        mapped = era.mapped(x)
        era.newest, era.newest_arrival = newest, last
        out[: len(x)] = era.arrival_ns + np.rint(mapped).astype(np.int64)
        delays = (arrival - mapped)[:: 1 + len(x) // MAX_DELAYS_PER_CALL]
        self._delays[(self._n_delays + np.arange(len(delays))) % MAX_DELAYS] = delays
        self._n_delays += len(delays)
        return len(x)

    def _tolerance(self, era: _Era, arrival: float) -> tuple[float, float]:
        """Largest earliness and lateness of ticks, in ns."""
        uncertainty = _LEARNED_RATE_UNCERTAINTY if era.learned else _NOMINAL_RATE_UNCERTAINTY
        drift = uncertainty * max(arrival - era.newest_arrival, 0.0)
        # The first arrivals may have been very late, which makes the next ones early.
        return (self._jump if era.learned else self._first_jump) + drift, self._jump + drift

    def _begin(self, ticks: Times, arrival_ns: Times) -> _Era:
        last = int(np.searchsorted(arrival_ns, arrival_ns[0], "right")) - 1
        return _Era(int(ticks[last]), int(arrival_ns[last]), self._nominal)

    def _unwrap(self, era: _Era, ticks: Times, arrival_ns: Times) -> Times:
        """Unwrap ticks relative to the first of the era.

        Ticks that arrived together are unwrapped relative to each other, and the last of them by
        host time: a late read contains old ticks and ends with a recent one.
        """
        ticks = ticks - era.tick
        if not self._wrap:
            return ticks
        half = self._wrap >> 1
        relative = np.zeros(len(ticks), np.int64)
        steps = ((ticks[1:] - ticks[:-1] + half) & (self._wrap - 1)) - half
        np.cumsum(steps, out=relative[1:])
        boundaries = np.flatnonzero(arrival_ns[1:] != arrival_ns[:-1])
        ends = np.append(boundaries, len(ticks) - 1)
        expected = (arrival_ns[ends] - era.arrival_ns - era.origin) / era.rate
        wraps = np.rint((expected - ticks[ends]) / self._wrap).astype(np.int64)
        base = ticks[ends] + wraps * self._wrap - relative[ends]
        if not len(boundaries):
            return relative + base[0]
        return relative + np.repeat(base, np.diff(ends, prepend=-1))

    def _map_jumps(self, ticks: Times, arrival_ns: Times, out: Times) -> int:
        """Process ticks that do not fit: wrong ones, or the first after a restart.

        Returns the number of processed ticks.
        """
        for index, sample in enumerate(zip(ticks.tolist(), arrival_ns.tolist(), strict=True)):
            out[index] = sample[1]
            if self._pending and not self._agree(self._pending[-1], sample):
                self.outliers += len(self._pending)
                self._pending = []
            self._pending.append(sample)
            if len(self._pending) == MIN_AGREEING_JUMPS:
                first = np.array(self._pending, np.int64)
                self.restarts += 1
                self.restart()
                self._map(first[:, 0], first[:, 1], np.empty(len(first), np.int64))
                return index + 1
        return len(ticks)

    def _agree(self, first: tuple[int, int], second: tuple[int, int]) -> bool:
        """Return True if two ticks differ by the same time as their arrivals."""
        ticks = second[0] - first[0]
        elapsed = second[1] - first[1]
        if self._wrap:
            ticks += round((elapsed / self._nominal - ticks) / self._wrap) * self._wrap
        tolerance = self._jump + _NOMINAL_RATE_UNCERTAINTY * elapsed
        return abs(ticks * self._nominal - elapsed) < tolerance

    def _learn(self, era: _Era, x: Array, arrival: Array, delay: Array) -> None:
        """Update the smallest delays of the bins, and correct the line."""
        bins = np.floor_divide(x, self._bin)
        has_new_bin = False
        edges = [0, len(x)]
        if bins[0] != bins[-1] or len(x) > 2:
            edges[1:1] = (np.flatnonzero(bins[1:] != bins[:-1]) + 1).tolist()
        for start, stop in pairwise(edges):
            earliest = start + int(delay[start:stop].argmin())
            key, point = int(bins[earliest]), (float(x[earliest]), float(arrival[earliest]))
            previous = era.earliest.get(key)
            has_new_bin |= previous is None
            if previous is None or point[1] - previous[1] < era.rate * (point[0] - previous[0]):
                era.earliest[key] = point
        if has_new_bin:
            self._fit(era)
        else:
            era.origin += min(float(delay.min()), 0.0)
        is_settling = era.newest <= era.departure + self._bin / 10
        if has_new_bin or (era.origin != era.target[0] and not is_settling):
            era.follow()
        if min(era.earliest) <= 0:
            era.start = era.origin

    def _fit(self, era: _Era) -> None:
        """Fit the line below the points of the window.

        The newest bin is left out, because it may not contain its smallest delay yet.
        """
        keys = sorted(era.earliest)
        newest = keys[-2] if len(keys) > 1 else keys[-1]
        for key in keys:
            if key >= newest - WINDOW_S / BIN_S:
                break
            del era.earliest[key]
        points = sorted(point for key, point in era.earliest.items() if key <= newest)
        x = np.array([point[0] for point in points])
        y = np.array([point[1] for point in points])
        span = x[-1] - x[0]
        if span * self._nominal >= MIN_FIT_S * 1e9:
            # The edge over the middle minimizes the sum of delays; an edge later in the window
            # better represents the current rate of the clock.
            slope = lower_hull_slope(x - x[0], y - y[0] - self._nominal * (x - x[0]), span * 2 / 3)
            if abs(slope) <= RATE_LIMIT * self._nominal:
                era.rate, era.learned = self._nominal + slope, True
        last = era.earliest[keys[-1]]
        era.origin = min(float((y - era.rate * x).min()), last[1] - era.rate * last[0])


def lower_hull_slope(x: Array, y: Array, abscissa: float) -> float:
    """Slope of the lower convex hull of points with ascending ``x`` at an abscissa."""
    hull: list[tuple[float, float]] = []
    for point in zip(x.tolist(), y.tolist(), strict=True):
        while len(hull) > 1:
            (ax, ay), (bx, by) = hull[-2:]
            if (bx - ax) * (point[1] - ay) > (point[0] - ax) * (by - ay):
                break
            hull.pop()
        hull.append(point)
    for (ax, ay), (bx, by) in pairwise(hull):
        if bx >= abscissa:
            return (by - ay) / (bx - ax)
    return 0.0
