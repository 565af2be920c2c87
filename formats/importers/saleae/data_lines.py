"""Data lines of a logic analyser, whatever file they come from, and which of them is light.

A line tells its edges in pieces, so that one that is not light is never held whole.

Light of Lighthouse V2 is biphase-mark code of 6 Mbit/s: in a burst, runs of 83 and 167 ns,
two short ones for a one and a long one for a zero, so about two short runs to a long one. A
clock has runs of one length only; serial data without return has a quarter of its runs at
three bits and more; bus traffic does not pause between bursts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError, LocatkError, MissingDataError
from locatk.core.lighthouse.recording import NANOSECONDS_PER_S, Edges

Ticks = NDArray[np.int64]

LEAST_RATE_HZ = 24e6
"""Below, a run of 83 ns is no two samples any more."""

MOST_EDGES = 100_000_000
"""Of one line, 0.8 GB: forty minutes of two stations are some 100 million."""

SHORT_NS = (40.0, 126.0)
LONG_NS = (126.0, 220.0)
"""Runs of half a bit and of a bit, a sample of 24 MHz more or less."""

BURST_NS = 1000.0
"""A longer run is a pause between bursts."""

LEAST_RUNS = 50
LEAST_SHARE = 0.8
SHORT_SHARE = (0.4, 0.8)
MOST_BUSY = 0.5

SAMPLE = 4096
"""Edges that the resolution is found from."""

WHOLE_MHZ = 320
"""With finer steps, a nanosecond more or less is always one of them."""


class Piece(NamedTuple):
    """Some edges of a line, in order.

    Attributes
    ----------
    tick : (n,) int64 ndarray
    rises : bool
        Whether the first of them is from low to high.
    end_tick : int
        Until when the line is told with this piece.
    """

    tick: Ticks
    rises: bool
    end_tick: int


@dataclass(frozen=True)
class Line:
    """One data line of a capture.

    Attributes
    ----------
    name : str
        As the capture calls it.
    number : int or None
        Input of the analyser, where the capture tells it.
    rate_hz : float
        Ticks a second.
    resolution_hz : float or None
        What the times resolve; None where only the times themselves show it.
    start_ns : int
        Tick 0, in nanoseconds since the epoch; 0 where unknown.
    pieces : callable
        Reads the line anew, piece by piece; raises what its reader raises.
    """

    name: str
    number: int | None
    rate_hz: float
    resolution_hz: float | None
    start_ns: int
    pieces: Callable[[], Iterator[Piece]]

    def __str__(self) -> str:
        if self.number is None or self.name == f"Channel {self.number}":
            return f"'{self.name}'"
        return f"'{self.name}' (channel {self.number})"

    def read(self) -> Edges:
        """The whole line.

        Raises
        ------
        InputError
            It has more than `MOST_EDGES` edges, or what its reader raises.
        """
        ticks: list[Ticks] = []
        rises, end, count = True, 1, 0
        for piece in self.pieces():
            rises = piece.rises if not count and len(piece.tick) else rises
            count += len(piece.tick)
            if count > MOST_EDGES:
                raise InputError(
                    f"more than {MOST_EDGES:,} edges on line {self}",
                    hint="export a shorter part of the capture",
                )
            ticks.append(piece.tick)
            end = piece.end_tick
        tick = np.concatenate(ticks) if ticks else np.zeros(0, np.int64)
        resolution = self.resolution_hz or resolution_of(tick[:SAMPLE])
        return Edges(tick, self.rate_hz, resolution, rises, end, self.start_ns)


@dataclass
class Tally:
    """How long the runs of a line are, counted piece by piece.

    Attributes
    ----------
    edges, short, long, quick : int
        Edges; runs of half a bit, of a bit, of less than a pause.
    busy_ns, span_ns : float
        Total of the quick runs; from the first edge to the last.
    first : (n,) int64 ndarray
        The first `SAMPLE` edges, or some less.
    """

    rate_hz: float
    edges: int = 0
    short: int = 0
    long: int = 0
    quick: int = 0
    busy_ns: float = 0.0
    span_ns: float = 0.0
    first: Ticks = field(default_factory=lambda: np.zeros(0, np.int64))
    _last: int | None = None

    @classmethod
    def of(cls, line: Line) -> Tally:
        """Read a line without holding it; a fast clock no further than could be read at all."""
        tally = cls(line.rate_hz)
        for piece in line.pieces():
            tally.add(piece.tick)
            if tally.edges > MOST_EDGES:
                break
        return tally

    def add(self, tick: Ticks) -> None:
        """Count the edges that come next."""
        if not len(tick):
            return
        before = tick[0] if self._last is None else self._last
        ns = np.diff(tick, prepend=before) * (NANOSECONDS_PER_S / self.rate_hz)
        ns = ns[1:] if self._last is None else ns
        quick = ns[ns < BURST_NS]
        self.edges += len(tick)
        self.quick += len(quick)
        self.short += int(np.count_nonzero((quick >= SHORT_NS[0]) & (quick < SHORT_NS[1])))
        self.long += int(np.count_nonzero((quick >= LONG_NS[0]) & (quick <= LONG_NS[1])))
        self.busy_ns += float(quick.sum())
        self.span_ns += float(ns.sum())
        self._last = int(tick[-1])
        if len(self.first) < SAMPLE:
            self.first = np.concatenate([self.first, tick[: SAMPLE - len(self.first)]])

    @property
    def is_light(self) -> bool:
        """Whether the runs are those of biphase-mark code of 6 Mbit/s in bursts."""
        coded = self.short + self.long
        return (
            coded >= LEAST_RUNS
            and coded >= LEAST_SHARE * self.quick
            and SHORT_SHARE[0] * coded <= self.short <= SHORT_SHARE[1] * coded
            and self.busy_ns <= MOST_BUSY * self.span_ns
        )

    def __str__(self) -> str:
        if self.edges < 2:
            return f"{self.edges} edge{'s' * (self.edges != 1)}"
        share = (self.short + self.long) / (self.edges - 1)
        return f"{self.edges:,} edges, {share:.0%} of the runs of 83 or 167 ns"


def resolution_of(tick: Ticks) -> float:
    """Sampling rate that times in nanoseconds show, in Hz.

    Parameters
    ----------
    tick : (n,) int64 ndarray
        Ascending; rounded to a nanosecond, or multiples of it.

    Returns
    -------
    float
        The lower of two: 1e9 over the greatest common divisor of all steps; the lowest rate
        of whole MHz, to `WHOLE_MHZ`, of which all times are multiples, but for their rounding
        (24 MHz: 41.67 ns). 1e9 where there are too few edges to tell.
    """
    if len(tick) < LEAST_RUNS:
        return float(NANOSECONDS_PER_S)
    since = tick - tick[0]
    exact = NANOSECONDS_PER_S / int(np.gcd.reduce(since))
    for mhz in range(1, WHOLE_MHZ + 1):
        samples = since * mhz
        away = np.abs(samples - 1000 * np.round(samples / 1000))
        if np.all(away <= mhz * 1.001):  # both ends are rounded, by half a nanosecond each
            return min(exact, mhz * 1e6)
    return exact


def clean_name(text: str) -> str:
    """Name of a line for one line of a terminal: printable, of 60 characters at most."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())[:60]


@contextmanager
def readable(path: Path) -> Iterator[None]:
    """What goes wrong in reading a file as MissingDataError."""
    try:
        yield
    except LocatkError:
        raise
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise MissingDataError(
            f"cannot read: {reason}", file=path, hint="check the path"
        ) from error
