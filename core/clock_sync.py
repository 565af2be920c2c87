"""A device's tick counter mapped to the host's time, while both run.

A sample is measured when the device's counter says; it arrives later, by a delay that is
never negative and often changes: USB polls once a millisecond, a busy host reads in bursts.
So the line of host time over ticks is the one that touches the arrivals from below: an edge
of their lower convex hull (Zhang, Liu, Xia: Clock synchronization algorithms for network
measurements, INFOCOM 2002). It is taken over the last :data:`WINDOW_S`, of the least delay
in every :data:`BIN_S`, so that memory is bounded and a clock that warms up is followed.

The least delay itself cannot be seen: times are late by it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Times = NDArray[np.int64]
Array = NDArray[np.float64]

BIN_S = 0.5
WINDOW_S = 120.0

LEARN_S = 2.0
"""Over less than this the rate is the nominal one."""

RATE_LIMIT = 0.1
"""Relative difference from the nominal rate up to which a rate is believed: resonators are
off by less than a percent, an RC oscillator by a few."""

SETTLE_S = 1.0
"""A better line is taken over within this time, so that times do not jump ..."""

SLEW_LIMIT = 0.25
"""... unless they had to run slower or faster than this, relatively; then it takes longer."""

JUMP_S = 1.0
"""Ticks that differ from host time by more (of a counter that starts again within 16 s: by
more than a sixteenth of that) are of a clock that was set, or wrong."""

LATE_S = 2.0
"""For so long ticks may lag behind by more than that: the host was busy. After that the
counter has stood still."""

AGREEING = 3
"""Ticks that jump are of a device that has restarted where so many agree, else wrong."""

KNOTS = 256
DELAYS = 4096
_PIECE_NS = int(BIN_S * 1e9)

_UNLEARNT = 0.02
_LEARNT = 1e-4
"""Relative doubt about the rate, for what host time tells after a silence."""


@dataclass
class _Era:
    """From one start of the device to the next. Ticks count from one of the first, host
    times in ns from its arrival: small enough for float64 to tell nanoseconds over months."""

    tick: int
    arrival_ns: int
    rate: float
    """Nanoseconds a tick."""
    learnt: bool = False
    at: float = 0.0
    """Host time of tick 0 on the line."""
    start: float = 0.0
    """The same, as long as the window reached back to it."""
    newest: float = -np.inf
    newest_arrival: float = 0.0
    late_since: float = np.inf
    least: dict[int, tuple[float, float]] = field(default_factory=dict)
    """Tick and arrival of the least delay, by bin."""
    knots: Array = field(default_factory=lambda: np.zeros((0, 2)))
    """Corners of the mapping: where it left a line, and where it meets the next ..."""
    aim: tuple[float, float] = (0.0, 0.0)
    """... which it follows from there: host time of tick 0, and rate."""
    turned: float = 0.0
    """Tick at which it left the last line."""

    def mapped(self, x: Array) -> Array:
        """Host times of ticks."""
        knots, (at, rate) = self.knots, self.aim
        line: Array = at + rate * x
        if x.min() >= knots[-1, 0]:
            return line
        line = np.where(x < knots[0, 0], knots[0, 1] + rate * (x - knots[0, 0]), line)
        inside = np.interp(x, knots[:, 0], knots[:, 1])
        return np.where((x < knots[0, 0]) | (x > knots[-1, 0]), line, inside)

    def follow(self) -> None:
        """Let the mapping go over to the line, from the newest tick that was mapped on."""
        at, rate = self.at, self.rate
        if not len(self.knots):
            self.aim, self.knots = (at, rate), np.array([(0.0, at)])
            return
        here = max(self.newest, self.knots[0, 0])
        now = float(self.mapped(np.array([here]))[0])
        kept = self.knots[self.knots[:, 0] < here][-KNOTS:]
        there = here + max(SETTLE_S * 1e9, abs(now - (at + rate * here)) / SLEW_LIMIT) / rate
        self.knots = np.vstack([kept, (here, now), (there, at + rate * there)])
        self.aim, self.turned = (at, rate), here


class TickClock:
    """Times of measurement from a device's ticks and the times at which they arrived.

    Online and causal: the answer to a call uses what came up to it. Within one start of the
    device the mapping is continuous and ascends with the ticks; a better estimate is taken
    over gradually (:data:`SETTLE_S`, :data:`SLEW_LIMIT`).

    Parameters
    ----------
    hz : float
        Nominal rate of the counter.
    bits : int
        After so many bits it starts at 0 again; 63 or more: never. How often it did so in a
        silence is told by host time, which for short counters (24 bits at 24 MHz start
        again every 0.7 s) asks that the rate is known: a rate 1 % off is enough for half a
        minute.

    Attributes
    ----------
    ticks_seen : int
    restarts : int
        How often the device was found to have started again.
    outliers : int
        Ticks that fit neither before nor after: their times are those of their arrival.
    """

    def __init__(self, hz: float, bits: int = 64) -> None:
        if not (np.isfinite(hz) and hz > 0 and bits > 0):
            raise ValueError(f"no counter of {bits} bits at {hz} Hz")
        self._nominal = 1e9 / hz
        self._wrap = 1 << bits if bits < 63 else 0
        wrap_ns = self._wrap * self._nominal or np.inf
        self._jump = min(JUMP_S * 1e9, wrap_ns / 16)
        self._first = min(JUMP_S * 1e9, wrap_ns / 2)
        self._bin = BIN_S * hz
        self._era: _Era | None = None
        self._pending: list[tuple[int, int]] = []
        self._delays = np.zeros(DELAYS)
        self._n_delays = 0
        self.ticks_seen = 0
        self.restarts = 0
        self.outliers = 0

    @property
    def offset_ns(self) -> int | None:
        """Host time minus the device's time when it was first heard since its last start."""
        if self._era is None:
            return None
        era = self._era
        return era.arrival_ns + round(era.start) - round(era.tick * self._nominal)

    @property
    def drift_ppm(self) -> float | None:
        """How much faster than nominal the device runs by the host's clock, over the last
        :data:`WINDOW_S`; None until it is learnt."""
        if self._era is None or not self._era.learnt:
            return None
        return (self._nominal / self._era.rate - 1) * 1e6

    @property
    def jitter_ns(self) -> tuple[float, float] | None:
        """Median and 95th percentile of how much more than the least delay the last
        arrivals were late."""
        if not self._n_delays:
            return None
        median, most = np.percentile(self._delays[: min(self._n_delays, DELAYS)], [50, 95])
        return float(median), float(most)

    def restart(self) -> None:
        """Start anew with the next tick, as after the device was plugged in again. Not counted
        in :attr:`restarts`."""
        self._era = None
        self._pending = []

    def times(self, ticks: Times, arrival_ns: Times) -> Times:
        """Host times at which ticks were, in ns.

        Parameters
        ----------
        ticks : (n,) int64 ndarray
            As received, in the order of arrival. Streams that share the clock may be out of
            order among each other, by less than half of the counter's range.
        arrival_ns : (n,) int64 ndarray
            When each was received, by the host's clock; never descending.
        """
        n = len(ticks)
        self.ticks_seen += n
        out = np.empty(n, np.int64)
        if n and arrival_ns[-1] - arrival_ns[0] < _PIECE_NS:
            self._map(ticks, arrival_ns, out)
        elif n:
            # In pieces, so that a recording in one call is mapped as it was while it came.
            part = (arrival_ns - arrival_ns[0]) // _PIECE_NS
            edges = [0, *(np.flatnonzero(np.diff(part)) + 1).tolist(), n]
            for start, stop in pairwise(edges):
                self._map(ticks[start:stop], arrival_ns[start:stop], out[start:stop])
        return out

    def _map(self, ticks: Times, arrival_ns: Times, out: Times) -> None:
        """Map one piece into ``out``."""
        done = 0
        while done < len(ticks):
            done += self._map_some(ticks[done:], arrival_ns[done:], out[done:])

    def _map_some(self, ticks: Times, arrival_ns: Times, out: Times) -> int:
        """Map the first of them, all that fit alike; how many they were."""
        era = self._era = self._era or self._begin(ticks, arrival_ns)
        x = self._unwrap(era, ticks, arrival_ns).astype(float)
        arrival = (arrival_ns - era.arrival_ns).astype(float)
        delay = arrival - (era.at + era.rate * x)
        least, last = float(delay.min()), float(arrival[-1])
        early, late = self._slack(era, last)
        before = era.newest - early / era.rate
        if least < -early or x.min() < before:
            jumps = (delay < -early) | (x < before)
            some = int(np.argmin(jumps == jumps[0])) or len(x)
            if jumps[0]:
                return self._map_jumps(ticks[:some], arrival_ns[:some], out)
            x, arrival, delay = x[:some], arrival[:some], delay[:some]
            least, last = float(delay.min()), float(arrival[-1])
        self.outliers += len(self._pending)
        self._pending = []
        era.late_since = np.inf if least <= late else min(era.late_since, float(arrival[0]))
        if last - era.late_since >= LATE_S * 1e9:
            self.restarts += 1
            self.restart()
            return 0
        newest = max(era.newest, float(x.max()))
        self._learn(era, x, arrival, delay)
        mapped = era.mapped(x)
        era.newest, era.newest_arrival = newest, last
        out[: len(x)] = era.arrival_ns + np.rint(mapped).astype(np.int64)
        lags = (arrival - mapped)[:: 1 + len(x) // 64]
        self._delays[(self._n_delays + np.arange(len(lags))) % DELAYS] = lags
        self._n_delays += len(lags)
        return len(x)

    def _slack(self, era: _Era, arrival: float) -> tuple[float, float]:
        """How early and how late ticks may be, in ns."""
        doubt = _LEARNT if era.learnt else _UNLEARNT
        passed = doubt * max(arrival - era.newest_arrival, 0.0)
        # The first arrivals may have been late by much, so that the next are early.
        return (self._jump if era.learnt else self._first) + passed, self._jump + passed

    def _begin(self, ticks: Times, arrival_ns: Times) -> _Era:
        last = int(np.searchsorted(arrival_ns, arrival_ns[0], "right")) - 1
        return _Era(int(ticks[last]), int(arrival_ns[last]), self._nominal)

    def _unwrap(self, era: _Era, ticks: Times, arrival_ns: Times) -> Times:
        """Ticks since the first of the era. What arrived together is unwrapped to the
        nearest, its last tick to what host time tells: a read that was late holds old
        ticks, and ends with a fresh one."""
        ticks = ticks - era.tick
        if not self._wrap:
            return ticks
        half = self._wrap >> 1
        chain = np.zeros(len(ticks), np.int64)
        steps = ((ticks[1:] - ticks[:-1] + half) & (self._wrap - 1)) - half
        np.cumsum(steps, out=chain[1:])
        parts = np.flatnonzero(arrival_ns[1:] != arrival_ns[:-1])
        ends = np.append(parts, len(ticks) - 1)
        expected = (arrival_ns[ends] - era.arrival_ns - era.at) / era.rate
        rounds = np.rint((expected - ticks[ends]) / self._wrap).astype(np.int64)
        base = ticks[ends] + rounds * self._wrap - chain[ends]
        if not len(parts):
            return chain + base[0]
        return chain + np.repeat(base, np.diff(ends, prepend=-1))

    def _map_jumps(self, ticks: Times, arrival_ns: Times, out: Times) -> int:
        """Ticks that do not fit: wrong ones, or the first of a new start; how many."""
        for number, one in enumerate(zip(ticks.tolist(), arrival_ns.tolist(), strict=True)):
            out[number] = one[1]
            if self._pending and not self._agree(self._pending[-1], one):
                self.outliers += len(self._pending)
                self._pending = []
            self._pending.append(one)
            if len(self._pending) == AGREEING:
                first = np.array(self._pending, np.int64)
                self.restarts += 1
                self.restart()
                self._map(first[:, 0], first[:, 1], np.empty(len(first), np.int64))
                return number + 1
        return len(ticks)

    def _agree(self, one: tuple[int, int], other: tuple[int, int]) -> bool:
        """Whether ticks are as far apart as their arrivals."""
        ticks = other[0] - one[0]
        passed = other[1] - one[1]
        if self._wrap:
            ticks += round((passed / self._nominal - ticks) / self._wrap) * self._wrap
        return abs(ticks * self._nominal - passed) < self._jump + _UNLEARNT * passed

    def _learn(self, era: _Era, x: Array, arrival: Array, delay: Array) -> None:
        """Take the least delays into their bins, and correct the line."""
        bins = np.floor_divide(x, self._bin)
        opened = False
        edges = [0, len(x)]
        if bins[0] != bins[-1] or len(x) > 2:
            edges[1:1] = (np.flatnonzero(bins[1:] != bins[:-1]) + 1).tolist()
        for start, stop in pairwise(edges):
            least = start + int(delay[start:stop].argmin())
            key, point = int(bins[least]), (float(x[least]), float(arrival[least]))
            known = era.least.get(key)
            opened |= known is None
            if known is None or point[1] - known[1] < era.rate * (point[0] - known[0]):
                era.least[key] = point
        if opened:
            self._fit(era)
        else:
            era.at += min(float(delay.min()), 0.0)
        if opened or (era.at != era.aim[0] and era.newest > era.turned + self._bin / 10):
            era.follow()
        if min(era.least) <= 0:
            era.start = era.at

    def _fit(self, era: _Era) -> None:
        """Lay the line under the points of the window, but for those of the bin that was
        opened last: it has only begun to find the least delay."""
        keys = sorted(era.least)
        newest = keys[-2] if len(keys) > 1 else keys[-1]
        for key in keys:
            if key >= newest - WINDOW_S / BIN_S:
                break
            del era.least[key]
        points = sorted(point for key, point in era.least.items() if key <= newest)
        x = np.array([point[0] for point in points])
        y = np.array([point[1] for point in points])
        span = x[-1] - x[0]
        if span * self._nominal >= LEARN_S * 1e9:
            # The edge over the middle has the least sum of delays; one that is later in the
            # window is nearer to what the clock does now.
            steepness = _edge(x - x[0], y - y[0] - self._nominal * (x - x[0]), span * 2 / 3)
            if abs(steepness) <= RATE_LIMIT * self._nominal:
                era.rate, era.learnt = self._nominal + steepness, True
        last = era.least[keys[-1]]
        era.at = min(float((y - era.rate * x).min()), last[1] - era.rate * last[0])


def _edge(x: Array, y: Array, where: float) -> float:
    """Steepness of the lower convex hull of points with ascending ``x`` at ``where``."""
    hull: list[tuple[float, float]] = []
    for point in zip(x.tolist(), y.tolist(), strict=True):
        while len(hull) > 1:
            (ax, ay), (bx, by) = hull[-2:]
            if (bx - ax) * (point[1] - ay) > (point[0] - ax) * (by - ay):
                break
            hull.pop()
        hull.append(point)
    for (ax, ay), (bx, by) in pairwise(hull):
        if bx >= where:
            return (by - ay) / (bx - ax)
    return 0.0
