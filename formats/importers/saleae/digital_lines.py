"""Digital lines of a logic analyser, and detection of those that carry light.

A line yields its edges in segments, so that one without light is never in memory as a whole.

Light of Lighthouse V2 is biphase-mark code of 6 Mbit/s: in a burst, runs of 83 and 167 ns,
two short ones for a one and a long one for a zero, hence about two short runs to a long one. A
clock has runs of a single length. In non-return-to-zero serial data, a quarter of the runs are
three bits or longer. Bus traffic has no pauses between bursts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.lighthouse.recording import NANOSECONDS_PER_S, Edges

Ticks = NDArray[np.int64]

MIN_RATE_HZ = 24e6
"""Lowest sampling rate at which a run of 83 ns has two samples."""

MAX_EDGES = 100_000_000
"""Most edges of a line, 0.8 GB: about forty minutes of two stations."""

SHORT_RUN_NS = (40.0, 126.0)
LONG_RUN_NS = (126.0, 220.0)
"""Lengths of runs of half a bit and of a bit, with an error of one sample at 24 MHz."""

MIN_PAUSE_NS = 1000.0
"""Shortest pause between bursts; every shorter run is part of a burst."""

MIN_RUNS = 50
"""Fewest runs of half a bit or a bit from which light or a resolution is detected."""

MIN_CODED_FRACTION = 0.8
"""Smallest fraction of the runs in bursts of light that are of half a bit or a bit."""

SHORT_FRACTION = (0.4, 0.8)
"""Fraction of runs of half a bit among those of half a bit and a bit; two thirds on average."""

MAX_BUSY_FRACTION = 0.5
"""Largest fraction of time in bursts: light of a station lasts some microseconds in 20 ms."""

RESOLUTION_EDGES = 4096
"""Edges from which the resolution is estimated."""

MAX_WHOLE_MHZ = 320
"""Highest rate whose steps are distinguishable from rounding to a nanosecond."""


class EdgeSegment(NamedTuple):
    """Consecutive edges of a line.

    Attributes
    ----------
    tick : (n,) int64 ndarray
    rises : bool
        True if the first edge is from low to high.
    end_tick : int
        End of the time that the segment covers.
    """

    tick: Ticks
    rises: bool
    end_tick: int


@dataclass(frozen=True)
class DigitalLine:
    """Digital line of a capture.

    Attributes
    ----------
    name : str
        Name in the capture.
    number : int or None
        Input of the analyser, if known.
    rate_hz : float
        Ticks per second.
    resolution_hz : float or None
        Sampling rate; None if it has to be estimated from the times.
    start_ns : int
        Time of tick 0, in nanoseconds since the epoch; 0 if unknown.
    segments : callable
        Reads the line again, segment by segment; raises the errors of its reader.
    """

    name: str
    number: int | None
    rate_hz: float
    resolution_hz: float | None
    start_ns: int
    segments: Callable[[], Iterator[EdgeSegment]]

    def __str__(self) -> str:
        if self.number is None or self.name == f"Channel {self.number}":
            return f"'{self.name}'"
        return f"'{self.name}' (channel {self.number})"

    def read(self) -> Edges:
        """Read the whole line.

        Raises
        ------
        InputError
            It has more than :data:`MAX_EDGES` edges. Its reader may raise other errors.
        """
        ticks: list[Ticks] = []
        rises, end, count = True, 1, 0
        for segment in self.segments():
            rises = segment.rises if not count and len(segment.tick) else rises
            count += len(segment.tick)
            if count > MAX_EDGES:
                raise InputError(
                    f"more than {MAX_EDGES:,} edges on line {self}",
                    hint="Export a shorter part of the capture",
                )
            ticks.append(segment.tick)
            end = segment.end_tick
        tick = np.concatenate(ticks) if ticks else np.zeros(0, np.int64)
        resolution = self.resolution_hz or estimate_resolution(tick[:RESOLUTION_EDGES])
        return Edges(tick, self.rate_hz, resolution, rises, end, self.start_ns)


@dataclass
class RunStatistics:
    """Statistics of the lengths of a line's runs, accumulated segment by segment.

    Attributes
    ----------
    edges, short, long, in_bursts : int
        Edges; runs of half a bit, of a bit, and in bursts.
    busy_ns, span_ns : float
        Total length of the runs in bursts; time from the first edge to the last.
    first : (n,) int64 ndarray
        The first edges, up to :data:`RESOLUTION_EDGES`.
    """

    rate_hz: float
    edges: int = 0
    short: int = 0
    long: int = 0
    in_bursts: int = 0
    busy_ns: float = 0.0
    span_ns: float = 0.0
    first: Ticks = field(default_factory=lambda: np.zeros(0, np.int64))
    _last: int | None = None

    @classmethod
    def of(cls, line: DigitalLine) -> RunStatistics:
        """Read a line without keeping it, up to :data:`MAX_EDGES`."""
        statistics = cls(line.rate_hz)
        for segment in line.segments():
            statistics.add(segment.tick)
            if statistics.edges > MAX_EDGES:
                break
        return statistics

    def add(self, tick: Ticks) -> None:
        """Add the next edges."""
        if not len(tick):
            return
        before = tick[0] if self._last is None else self._last
        ns = np.diff(tick, prepend=before) * (NANOSECONDS_PER_S / self.rate_hz)
        ns = ns[1:] if self._last is None else ns
        in_bursts = ns[ns < MIN_PAUSE_NS]
        self.edges += len(tick)
        self.in_bursts += len(in_bursts)
        self.short += int(
            np.count_nonzero((in_bursts >= SHORT_RUN_NS[0]) & (in_bursts < SHORT_RUN_NS[1]))
        )
        self.long += int(
            np.count_nonzero((in_bursts >= LONG_RUN_NS[0]) & (in_bursts <= LONG_RUN_NS[1]))
        )
        self.busy_ns += float(in_bursts.sum())
        self.span_ns += float(ns.sum())
        self._last = int(tick[-1])
        if len(self.first) < RESOLUTION_EDGES:
            self.first = np.concatenate([self.first, tick[: RESOLUTION_EDGES - len(self.first)]])

    @property
    def is_light(self) -> bool:
        """True if the runs are those of biphase-mark code of 6 Mbit/s in bursts."""
        coded = self.short + self.long
        return (
            coded >= MIN_RUNS
            and coded >= MIN_CODED_FRACTION * self.in_bursts
            and SHORT_FRACTION[0] * coded <= self.short <= SHORT_FRACTION[1] * coded
            and self.busy_ns <= MAX_BUSY_FRACTION * self.span_ns
        )

    def __str__(self) -> str:
        if self.edges < 2:
            return f"{self.edges} edge{'s' * (self.edges != 1)}"
        coded_fraction = (self.short + self.long) / (self.edges - 1)
        return f"{self.edges:,} edges, {coded_fraction:.0%} of the runs have 83 or 167 ns"


def estimate_resolution(tick: Ticks) -> float:
    """Estimate the sampling rate from times in nanoseconds, in Hz.

    Parameters
    ----------
    tick : (n,) int64 ndarray
        Ascending; rounded to a nanosecond, or multiples of it.

    Returns
    -------
    float
        The lower of two rates: 1e9 divided by the greatest common divisor of all steps, and the
        lowest rate in whole MHz, up to :data:`MAX_WHOLE_MHZ`, of whose period all times are
        multiples except for their rounding (24 MHz: 41.67 ns). With too few edges, 1e9.
    """
    if len(tick) < MIN_RUNS:
        return float(NANOSECONDS_PER_S)
    since = tick - tick[0]
    exact = NANOSECONDS_PER_S / int(np.gcd.reduce(since))
    for mhz in range(1, MAX_WHOLE_MHZ + 1):
        samples = since * mhz
        error = np.abs(samples - 1000 * np.round(samples / 1000))
        # Both ends are rounded, by half a nanosecond each.
        if np.all(error <= mhz * 1.001):
            return min(exact, mhz * 1e6)
    return exact


def clean_name(text: str) -> str:
    """Return a name for one line of a terminal: printable, with at most 60 characters."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())[:60]
