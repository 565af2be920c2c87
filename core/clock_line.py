"""Line between two clocks, from readings of one that are late by varying times.

A program that stamps data when it receives them is late by at least a constant, and sometimes by
much more. The line below all stamps is therefore the mapping between the clocks, up to that
constant. :mod:`locatk.core.clock_sync` does the same while a recording runs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.clock_sync import lower_hull_slope

Array = NDArray[np.float64]

MIN_SPAN_S = 2.0
"""Shortest recording from which a rate is estimated [s]: delays of a millisecond then change it by
5e-4."""

MAX_RATE_ERROR = 0.03
"""Largest deviation of a rate from 1. The largest known is 1.2 %, of the Crazyflie's clock."""

MAX_EARLINESS_S = 0.02
"""Time before the median of all delays from which on a reading is wrong [s]."""

MIN_READINGS = 10


@dataclass(frozen=True)
class ClockLine:
    """Mapping of a reference clock to another one: ``other = offset_s + rate * reference``.

    Attributes
    ----------
    offset_s : float
    rate : float
        Seconds of the other clock per second of the reference.
    is_estimated : bool
        False if the rate was assumed to be 1, because the recording is too short.
    """

    offset_s: float
    rate: float
    is_estimated: bool = True

    def to_reference(self, other_s: Array) -> Array:
        """Return the reference's times of times of the other clock."""
        return (other_s - self.offset_s) / self.rate


def fit_clock_line(
    reference_s: Array, late_s: Array, *, resolution_s: float = 0.0
) -> ClockLine | None:
    """Fit the line below the readings of a clock that were taken too late.

    Of the lines with no reading below it, this one minimizes the sum of the delays. Readings that
    are far from the others are ignored.

    Parameters
    ----------
    reference_s, late_s : (n,) ndarray
        Time of each event by the reference, and the other clock's time when it was stamped.
    resolution_s : float
        Step of the stamps, of which each is the middle. The smallest delays are too small by half
        of it.

    Returns
    -------
    ClockLine or None
        None if fewer than ten readings agree on a line with a rate near 1.
    """
    order = np.argsort(reference_s, kind="stable")
    x, y = reference_s[order], late_s[order]
    if len(x) < MIN_READINGS:
        return None
    start_s, span_s = float(x[0]), float(x[-1] - x[0])
    x = x - start_s
    if span_s < MIN_SPAN_S:
        delay = y - x
        near = delay >= np.median(delay) - MAX_EARLINESS_S
        offset_s = float(delay[near].min()) + resolution_s / 2
        return ClockLine(offset_s - start_s, 1.0, is_estimated=False)
    rate = _robust_rate(x, y)
    delay = y - rate * x
    is_near = delay >= np.median(delay) - MAX_EARLINESS_S
    x, y, delay = x[is_near], y[is_near], delay[is_near]
    rate += lower_hull_slope(x, delay, float(np.median(x)))
    if abs(rate - 1) > MAX_RATE_ERROR:
        return None
    offset_s = float(np.min(y - rate * x)) + resolution_s / 2
    return ClockLine(offset_s - rate * start_s, rate)


def _robust_rate(x: Array, y: Array) -> float:
    """Return the median slope between readings half of the recording apart."""
    half = len(x) // 2
    run, rise = x[half : 2 * half] - x[:half], y[half : 2 * half] - y[:half]
    is_long = run > (x[-1] - x[0]) / 10
    return float(np.median(rise[is_long] / run[is_long])) if is_long.any() else 1.0


def unwrap_counter(
    ticks: NDArray[np.int64], clock_s: Array, hz: float, bits: int
) -> NDArray[np.int64]:
    """Continue a counter over its wraps.

    Parameters
    ----------
    ticks : (n,) int64 ndarray
        Readings of the counter, approximately in the order of time.
    clock_s : (n,) ndarray
        Time of each by another clock. It decides how often the counter wrapped since the reading
        before, and must be right to half of its range.
    hz : float
    bits : int
        Width of the counter.
    """
    size = 1 << bits
    step = np.diff(ticks)
    expected = np.diff(clock_s) * hz
    wraps = np.rint((expected - step) / size).astype(np.int64)
    return np.concatenate([ticks[:1], ticks[0] + np.cumsum(step + wraps * size)]).astype(np.int64)
