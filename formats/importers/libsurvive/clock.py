"""A tracker's 48 MHz counter against the host's clock, over a whole recording.

libsurvive writes both into each line: when the light was (timecode, 32 bits, starting again
every 89 s) and when the host wrote the line, which is later, by milliseconds and in bursts.
Here the recording is known to its end, so that one line of host time over ticks holds for
all of it: times between sweeps are then as exact as the counter. (What runs while a recording
grows is :mod:`locatk.core.clock_sync`.)
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from locatk.core.lighthouse.channels import TICK_HZ

Array = NDArray[np.float64]
Ticks = NDArray[np.int64]

WRAP = 1 << 32

LATE_S = 10.0
"""Lines of one run of the counter are within so many seconds of each other in their
difference from the host's clock: hosts stall, and clocks were seen 380 ppm apart."""

SHORT_WRAP = 1 << 24
"""Trackers send 24 bits, the host adds the upper eight (``fix_time24`` of ``driver_vive.c``),
at times wrongly: for some milliseconds whenever the 32 bits start again."""

ABOUT = 101
"""Lines about one that tell how late it may be."""

EARLY_S = 0.2
"""A line this much earlier than those about it was damaged."""

RUN_LINES = 100
RUNS = 16
"""A tracker that starts again counts anew. Fewer lines than these are no run, but damaged."""

BIN_S = 0.5
RATE_LIMIT = 1e-3
"""Relative difference of rates up to which one is believed."""


@dataclass(frozen=True)
class Run:
    """A stretch in which the counter did not start again.

    Attributes
    ----------
    index : (n,) int64 ndarray
        The lines of it.
    tick : (n,) int64 ndarray
        Their timecodes, unwrapped.
    start_s : float
        Host's time of tick 0.
    rate : float
        Seconds of the host in one of the counter.
    lag_s : float
        Median of how late lines were written.
    repaired : int
        Timecodes whose upper bits were wrong.
    """

    index: NDArray[np.int64]
    tick: Ticks
    start_s: float
    rate: float
    lag_s: float
    repaired: int

    def host_ns(self, tick: Array) -> NDArray[np.int64]:
        """Host's time of ``tick`` (may be fractional), in nanoseconds."""
        seconds = self.start_s + self.rate * (tick / TICK_HZ)
        return np.rint(seconds * 1e9).astype(np.int64)


def runs(host_s: Array, timecode: Ticks) -> list[Run]:
    """Unwrap the timecodes of one device.

    Parameters
    ----------
    host_s : (n,) float64 ndarray
        When each line was written.
    timecode : (n,) int64 ndarray
        0 to 2^32 - 1.

    Returns
    -------
    list of Run
        In order of time. Lines of no run have a timecode or time that fits to nothing.
    """
    found: list[Run] = []
    expected = np.rint(host_s * TICK_HZ).astype(np.int64)
    late = (timecode - expected) % WRAP
    rest = np.arange(len(late))
    least = min(RUN_LINES, max(len(late) // 2, 1))
    while len(rest) >= least and len(found) < RUNS:
        centre = _most_common(late[rest])
        off = (late[rest] - centre + WRAP // 2) % WRAP - WRAP // 2
        inside = np.abs(off) < LATE_S * TICK_HZ
        if np.count_nonzero(inside) < least:
            break
        index = rest[inside]
        tick = expected[index] + centre + off[inside]
        usual = _usual_delay(tick, host_s[index])
        wrong = _upper_bits(tick, host_s[index], usual)
        found.append(_run(index, tick - wrong * SHORT_WRAP, host_s[index], wrong, usual))
        rest = rest[~inside]
    return sorted(found, key=lambda run: float(host_s[run.index].min()))


def _most_common(values: Ticks) -> int:
    """Where on the circle most values are."""
    width = WRAP // 64
    counted = np.bincount(values // width, minlength=64)
    # A heap on the border of two bins counts as one.
    pairs = counted + np.roll(counted, -1)
    first = int(np.argmax(pairs)) * width
    near = (values - first) % WRAP
    return (first + int(np.median(near[near < 2 * width]))) % WRAP


def _usual_delay(tick: Ticks, host_s: Array) -> Array:
    """By how much the lines about each were later than their ticks, in seconds."""
    order = np.argsort(host_s, kind="stable")
    usual = np.zeros(len(tick))
    usual[order] = median_filter(host_s[order] - tick[order] / TICK_HZ, ABOUT, mode="nearest")
    return usual


def _upper_bits(tick: Ticks, host_s: Array, usual: Array) -> Ticks:
    """By how many turns of 24 bits each tick is ahead of the lines about it."""
    ahead = (usual - (host_s - tick / TICK_HZ)) * (TICK_HZ / SHORT_WRAP)
    turns = np.rint(ahead)
    # Of a host that stalled lines are late by anything.
    turns[np.abs(ahead - turns) > 1 / 8] = 0
    return turns.astype(np.int64)


def _run(index: NDArray[np.int64], tick: Ticks, host_s: Array, wrong: Ticks, usual: Array) -> Run:
    """The line that touches the arrivals from below, over the middle of the run."""
    # No line is written before its light: the time of one that comes so early is damaged.
    sound = np.flatnonzero(host_s - tick / TICK_HZ > usual - EARLY_S)
    x = (tick - tick[0]) / TICK_HZ
    x0 = float(tick[0]) / TICK_HZ
    delay = host_s - x
    rate = 1.0
    bins = np.floor((x - x.min()) / BIN_S).astype(np.int64)[sound]
    order = np.lexsort((delay[sound], bins))
    first = sound[order[np.r_[True, np.diff(bins[order]) > 0]]]
    slope = _lower_edge(x[first], delay[first])
    if abs(slope) <= RATE_LIMIT:
        rate += slope
    late = host_s - rate * x
    at = float(late[sound].min())
    lag = float(np.median(late)) - at
    return Run(index, tick, at - rate * x0, rate, lag, int(np.count_nonzero(wrong)))


def _lower_edge(x: Array, y: Array) -> float:
    """Steepness of the lower convex hull of points in order of ``x`` over their middle."""
    hull: list[tuple[float, float]] = []
    for px, py in zip(x.tolist(), y.tolist(), strict=True):
        while len(hull) > 1:
            (ax, ay), (bx, by) = hull[-2:]
            if (bx - ax) * (py - ay) > (px - ax) * (by - ay):
                break
            hull.pop()
        hull.append((px, py))
    middle = (hull[0][0] + hull[-1][0]) / 2
    for (ax, ay), (bx, by) in pairwise(hull):
        if bx >= middle and bx > ax:
            return (by - ay) / (bx - ax)
    return 0.0
