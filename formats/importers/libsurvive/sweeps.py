"""Times, rotor angles and planes of the sweeps that one device of a recording received.

libsurvive writes two times into each line: the timecode of the light (the device's 48 MHz counter,
32 bits, wrapping every 89 s), and the host's clock when the line was written, which is later by
milliseconds and in bursts. Because the whole recording is available, one line of host time over
ticks is fitted for all of it: times between sweeps are then as exact as the counter.
(:mod:`locatk.core.clock_sync` does this while a recording grows.)
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from locatk.core.lighthouse.channels import TICK_HZ, period_ticks
from locatk.core.lighthouse.demodulation.tracker_syncs import TrackerRotor, fit_rotor
from locatk.core.lighthouse.recording import UNKNOWN
from locatk.formats.importers.libsurvive.rec_file import Columns, RecFile

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

TIMECODE_WRAP_TICKS = 1 << 32

MAX_CLOCK_DIFFERENCE_S = 10.0
"""Largest spread of the difference to the host's clock within one run of the counter.

Hosts stall, and clocks that differ by 380 ppm were observed.
"""

SHORT_WRAP_TICKS = 1 << 24
"""Wrap of the 24 bits that trackers send.

The host adds the upper eight (``fix_time24`` of ``driver_vive.c`` in cntools/libsurvive), and does
so wrongly for some milliseconds after each wrap of the 32 bits.
"""

DELAY_WINDOW_LINES = 101
"""Neighbouring lines from which the usual delay of a line is estimated."""

MAX_EARLY_S = 0.2
"""A line that is earlier than its neighbours by more has a damaged time."""

MIN_RUN_LINES = 100
"""Fewest lines of a run of the counter; fewer are damaged lines."""

MAX_RUNS = 16
"""Most runs of a recording. A tracker that restarts begins a new one."""

ENVELOPE_BIN_S = 0.5
"""Interval of which the earliest line counts in the fit of the rate."""

MAX_RATE_DIFFERENCE = 1e-3
"""Largest plausible relative difference between the clocks of device and host."""

MAX_WRAP_ERROR = 1 / 8
"""Largest distance of a wrong upper part from whole wraps of 24 bits; else the host stalled."""

HISTOGRAM_BINS = 64
"""Bins of the counter's circle in the search for a run."""

AMBIGUOUS_REVOLUTIONS = (0.41, 0.59)
"""Rotor angles at which a sweep can be of either plane, in revolutions.

One plane points ahead at a third of a revolution, the other at two thirds, and each is received up
to a quarter of a revolution before and after.
"""

MIN_PLANE_SEPARATION_REVOLUTIONS = 0.125
"""Smallest rotor angle between the passes of the two planes over a device, in revolutions."""

MAX_AGE_PERIODS = 50
"""Periods of the rotor, a second, in which a device cannot move from one plane to the other."""

MAX_REJECTED_FRACTION = 0.1
"""Fraction of wrong syncs above which there is a warning."""

MIN_SIDE_REVOLUTIONS = 0.5
"""Rotor angle from which on an unambiguous sweep is of the second plane, in revolutions."""


# ---- clock of the device


@dataclass(frozen=True)
class CounterRun:
    """Part of a recording in which the counter of a device did not restart.

    Attributes
    ----------
    index : (n,) int64 ndarray
        Its lines.
    tick : (n,) int64 ndarray
        Their unwrapped timecodes.
    start_s : float
        Time of tick 0 by the host's clock.
    rate : float
        Seconds of the host's clock in one second of the counter.
    lag_s : float
        Median delay of the lines.
    repaired : int
        Timecodes with wrong upper bits, which were corrected.
    """

    index: NDArray[np.int64]
    tick: Ints
    start_s: float
    rate: float
    lag_s: float
    repaired: int

    def host_ns(self, tick: Array) -> NDArray[np.int64]:
        """Return the host's time of (fractional) ticks, in nanoseconds."""
        seconds = self.start_s + self.rate * (tick / TICK_HZ)
        return np.rint(seconds * 1e9).astype(np.int64)


def unwrap_timecodes(host_s: Array, timecode: Ints) -> list[CounterRun]:
    """Unwrap the timecodes of one device.

    Parameters
    ----------
    host_s : (n,) float64 ndarray
        Time at which each line was written.
    timecode : (n,) int64 ndarray
        0 to 2^32 - 1.

    Returns
    -------
    list of CounterRun
        In order of time. Lines that belong to no run have a damaged timecode or time.
    """
    runs: list[CounterRun] = []
    expected = np.rint(host_s * TICK_HZ).astype(np.int64)
    offset = (timecode - expected) % TIMECODE_WRAP_TICKS
    rest = np.arange(len(offset))
    min_lines = min(MIN_RUN_LINES, max(len(offset) // 2, 1))
    while len(rest) >= min_lines and len(runs) < MAX_RUNS:
        centre = _most_common(offset[rest])
        difference = (
            offset[rest] - centre + TIMECODE_WRAP_TICKS // 2
        ) % TIMECODE_WRAP_TICKS - TIMECODE_WRAP_TICKS // 2
        is_inside = np.abs(difference) < MAX_CLOCK_DIFFERENCE_S * TICK_HZ
        if np.count_nonzero(is_inside) < min_lines:
            break
        index = rest[is_inside]
        tick = expected[index] + centre + difference[is_inside]
        usual_s = _usual_delay(tick, host_s[index])
        wraps = _wrong_wraps(tick, host_s[index], usual_s)
        tick = tick - wraps * SHORT_WRAP_TICKS
        repaired = int(np.count_nonzero(wraps))
        runs.append(_fit_run(index, tick, host_s[index], repaired, usual_s))
        rest = rest[~is_inside]
    return sorted(runs, key=lambda run: float(host_s[run.index].min()))


def _most_common(values: Ints) -> int:
    """Return the centre of the largest cluster of values on the circle of the counter."""
    width = TIMECODE_WRAP_TICKS // HISTOGRAM_BINS
    counts = np.bincount(values // width, minlength=HISTOGRAM_BINS)
    # Pairs of bins, so that a cluster on the border of two counts as one.
    pairs = counts + np.roll(counts, -1)
    first = int(np.argmax(pairs)) * width
    distance = (values - first) % TIMECODE_WRAP_TICKS
    return (first + int(np.median(distance[distance < 2 * width]))) % TIMECODE_WRAP_TICKS


def _usual_delay(tick: Ints, host_s: Array) -> Array:
    """Return the median delay of the neighbours of each line behind their ticks, in seconds."""
    order = np.argsort(host_s, kind="stable")
    usual_s = np.zeros(len(tick))
    usual_s[order] = median_filter(
        host_s[order] - tick[order] / TICK_HZ, DELAY_WINDOW_LINES, mode="nearest"
    )
    return usual_s


def _wrong_wraps(tick: Ints, host_s: Array, usual_s: Array) -> Ints:
    """Return the number of wraps of 24 bits by which each tick is ahead of its neighbours."""
    ahead = (usual_s - (host_s - tick / TICK_HZ)) * (TICK_HZ / SHORT_WRAP_TICKS)
    wraps = np.rint(ahead)
    # Lines of a host that stalled are late by any time.
    wraps[np.abs(ahead - wraps) > MAX_WRAP_ERROR] = 0
    return wraps.astype(np.int64)


def _fit_run(index: Ints, tick: Ints, host_s: Array, repaired: int, usual_s: Array) -> CounterRun:
    """Fit the line that touches the arrivals from below, at the middle of the run."""
    # No line is written before its light: a line that comes too early has a damaged time.
    valid = np.flatnonzero(host_s - tick / TICK_HZ > usual_s - MAX_EARLY_S)
    x = (tick - tick[0]) / TICK_HZ
    x0 = float(tick[0]) / TICK_HZ
    delay = host_s - x
    rate = 1.0
    bins = np.floor((x - x.min()) / ENVELOPE_BIN_S).astype(np.int64)[valid]
    order = np.lexsort((delay[valid], bins))
    first = valid[order[np.r_[True, np.diff(bins[order]) > 0]]]
    slope = _lower_edge(x[first], delay[first])
    if abs(slope) <= MAX_RATE_DIFFERENCE:
        rate += slope
    delay_s = host_s - rate * x
    first_s = float(delay_s[valid].min())
    lag_s = float(np.median(delay_s)) - first_s
    return CounterRun(index, tick, first_s - rate * x0, rate, lag_s, repaired)


def _lower_edge(x: Array, y: Array) -> float:
    """Return the slope of the lower convex hull of points in order of ``x`` at their middle."""
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


# ---- sweeps


@dataclass
class DeviceSweeps:
    """Sweeps that one device received.

    Attributes
    ----------
    row : (n,) int64 ndarray
        Row of each kept sweep among the recording's sweeps.
    time_ns : (n,) int64 ndarray
        By the host's clock.
    revolution : (n,) float64 ndarray
        Rotor angle since its zero, 0 to 1.
    bit : (n,) int64 ndarray
        Slow bit of the rotation, -1 if unknown.
    plane : (n,) int64 ndarray
        0, 1, or -1 if ambiguous.
    rotors : dict of int to list of TrackerRotor
        By channel (from 0), one a run of the device's counter.
    warnings : list of str
    unplaced : int
        Lines with a timecode that contradicts their time.
    rotorless : int
        Sweeps far from any sync.
    repaired : int
        Timecodes with wrong upper bits, which were corrected.
    lag_s, ppm : float
        Median delay of the lines, and rate of the device's clock relative to the host's.
    """

    row: Ints
    time_ns: Ints
    revolution: Array
    bit: Ints
    plane: Ints
    rotors: dict[int, list[TrackerRotor]] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    unplaced: int = 0
    rotorless: int = 0
    repaired: int = 0
    lag_s: float = 0.0
    ppm: float = 0.0


def read_device_sweeps(recording: RecFile, device: int) -> DeviceSweeps:
    """Return the times, rotor angles and planes of the sweeps of ``recording.devices[device]``."""
    rows = np.flatnonzero(recording.sweeps.device == device)
    sweeps = recording.sweeps.take(rows)
    syncs = recording.syncs.take(recording.syncs.device == device)
    name = recording.devices[device]
    result = DeviceSweeps(rows[:0], rows[:0], np.zeros(0), rows[:0], rows[:0])
    runs = unwrap_timecodes(
        np.concatenate([syncs.host_s, sweeps.host_s]),
        np.concatenate([syncs.timecode, sweeps.timecode]),
    )
    result.unplaced = len(syncs) + len(rows) - sum(len(run.index) for run in runs)
    if len(runs) > 1:
        result.warnings.append(f"the counter of {name} restarted {len(runs) - 1} times")
    parts = [_read_run(run, syncs, sweeps, rows, name, result) for run in runs]
    if parts:
        result.row, result.time_ns, result.bit, result.plane = (
            np.concatenate([part[k] for part, _ in parts]) for k in range(4)
        )
        result.revolution = np.concatenate([revolution for _, revolution in parts])
    return result


def _read_run(
    run: CounterRun,
    syncs: Columns,
    sweeps: Columns,
    rows: Ints,
    name: str,
    result: DeviceSweeps,
) -> tuple[tuple[Ints, Ints, Ints, Ints], Array]:
    """Return row, time, bit and plane, and the rotor angle, of the sweeps of one run."""
    is_sync = run.index < len(syncs)
    sync = syncs.take(run.index[is_sync])
    sync_tick = run.tick[is_sync].astype(np.float64)
    chosen = run.index[~is_sync] - len(syncs)
    sweep = sweeps.take(chosen)
    # Sweeps are timed at 96 MHz: the flag is the half tick.
    tick = run.tick[~is_sync] + 0.5 * sweep.flag
    n = len(sweep)
    revolution, bit, plane = np.full(n, np.nan), np.full(n, UNKNOWN), np.full(n, UNKNOWN)
    for channel in np.unique(sync.channel).tolist():
        of_channel = sync.channel == channel
        period = float(period_ticks(channel + 1))
        rotor = fit_rotor(sync_tick[of_channel], sync.flag[of_channel], period)
        sync_count = int(np.count_nonzero(of_channel))
        if rotor is None:
            result.warnings.append(
                f"channel {channel + 1}: the {sync_count} syncs received by {name} fit no rotor"
            )
            continue
        result.rotors.setdefault(channel, []).append(rotor)
        if rotor.rejected > MAX_REJECTED_FRACTION * sync_count:
            result.warnings.append(
                f"channel {channel + 1}: {rotor.rejected} of {sync_count} syncs received by {name} "
                "do not fit one rotor; is a second station on this channel?"
            )
        of_channel = np.flatnonzero(sweep.channel == channel)
        revolution[of_channel], bit[of_channel] = rotor.phase_and_bit(tick[of_channel])
        plane[of_channel] = assign_planes(
            revolution[of_channel], tick[of_channel], rotor.period_tick
        )
    kept = np.isfinite(revolution)
    result.rotorless += n - int(np.count_nonzero(kept))
    result.repaired += run.repaired
    result.lag_s, result.ppm = run.lag_s, (1 / run.rate - 1) * 1e6
    columns = (rows[chosen][kept], run.host_ns(tick)[kept], bit[kept], plane[kept])
    return columns, revolution[kept]


def assign_planes(revolution: Array, tick: Array, period: float) -> Ints:
    """Return the plane (n,) of each sweep of one channel: 0, 1, or -1 if ambiguous.

    Near the middle of the revolution, other sweeps decide: a device is small and slow, so that its
    photodiodes meet a plane at nearly the same angle as shortly before or after, and the other
    plane at least :data:`MIN_PLANE_SEPARATION_REVOLUTIONS` away.

    Parameters
    ----------
    revolution : (n,) float64 ndarray
        Rotor angle, 0 to 1, or ``nan``.
    tick : (n,) float64 ndarray
    period : float
        Period of the rotor, in ticks.
    """
    plane = (revolution > MIN_SIDE_REVOLUTIONS).astype(np.int64)
    low, high = AMBIGUOUS_REVOLUTIONS
    ambiguous = np.flatnonzero((revolution > low) & (revolution < high))
    if not len(ambiguous):
        return plane
    plane[ambiguous] = UNKNOWN
    is_possible = np.ones((len(ambiguous), 2), bool)
    for k in (0, 1):
        certain = np.flatnonzero((plane == k) & np.isfinite(revolution))
        certain = certain[np.argsort(tick[certain], kind="stable")]
        if not len(certain):
            continue
        after = np.minimum(np.searchsorted(tick[certain], tick[ambiguous]), len(certain) - 1)
        separation = np.full(len(ambiguous), np.inf)
        for other in (certain[np.maximum(after - 1, 0)], certain[after]):
            is_recent = np.abs(tick[other] - tick[ambiguous]) < MAX_AGE_PERIODS * period
            difference = np.abs(revolution[other] - revolution[ambiguous])
            separation = np.minimum(separation, np.where(is_recent, difference, np.inf))
        # Without a recent sweep of a plane, its angle is unknown.
        is_near = separation < MIN_PLANE_SEPARATION_REVOLUTIONS / 2
        is_possible[:, k] = is_near | np.isinf(separation)
    is_unique = is_possible[:, 0] != is_possible[:, 1]
    plane[ambiguous[is_unique]] = is_possible[is_unique, 1]
    return plane
