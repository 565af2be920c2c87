"""Channels on which more than one base station sends.

Stations on one channel send the same sequences, so that no sweep shows which of them sent it. A
position from sweeps of both is wrong, and nothing in it shows that. Two observations do:

**Time.** The time of a sweep minus the duration of its count is a time at which the rotor was at
its zero. The zeros of one rotor are whole rotations apart; those of two rotors differ by an
arbitrary phase. A reflection has the phase of its rotor. This needs the times of single sweeps,
as reported by a Lighthouse deck or a logic analyser.

**Counts.** If all sweeps of a report have the time of the report, their phase is unknown. A
photodiode that moves slowly then has one count for each light plane of a station, which repeats
from report to report. One rotor has two planes: four counts that repeat are of two stations, or of
one and its reflection, which is as wrong.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.channels import CHANNELS, TICK_HZ, TICKS_PER_COUNT, period_ticks
from locatk.core.lighthouse.epochs import MIN_PLANE_DELAY_TURNS
from locatk.core.lighthouse.recording import Sweeps

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MAX_PAIR_ERROR_S = 20e-6
"""Largest difference between the zeros of two sweeps of one rotation [s]. Clocks of station and
receiver that differ by 200 ppm cause 4 us; the zeros of two arbitrary sweeps agree as closely in
0.2 % of all cases."""

MIN_PAIRED_FRACTION = 0.5
"""Smallest fraction of sweeps that agree with another one of their rotation if times are those of
single sweeps. If they are those of reports, agreement is by chance."""

MAX_PHASE_DRIFT_PPM = 250.0
"""Largest deviation of a rotor from its nominal period in the clock of the receiver."""

PHASE_WINDOW_S = 1.0
"""Longest time between two rotations whose phases are compared [s]: two reports at 3 Hz."""

COUNT_WINDOW_S = 0.5
"""Longest time between two sweeps whose counts are compared [s]: five reports at 10 Hz."""

SAME_COUNT_RAD = float(np.radians(3.0))
"""Largest difference between counts of one plane [rad]: a robot that moves by 0.5 m/s at 2 m from a
station changes its angle by this much in 0.2 s. Of faster motion nothing is concluded."""

NEIGHBOURS = 8
"""Number of sweeps, or of rotations, before and after that one is compared with: two reports about
two stations, and a margin."""

MIN_CONFLICTS = 4
"""Smallest number of sweeps that show a second station."""

MAX_PHASE_CONFLICT_FRACTION = 0.02
"""Fraction of sweeps with another phase than those around them above which a second station sends.
If 10 % of the sweeps have random counts, 0.1 % have such a phase, by chance."""

MAX_COUNT_CONFLICT_FRACTION = 0.2
"""Fraction of sweeps among more than two pairs of repeating counts above which a second station
sends. In simulated recordings (six seeds, reports at 3 to 10 Hz) it is up to 0.05 with 10 % of
outliers and 0.14 with 30 %, and 0.4 to 0.97 with a second station; in the published recordings of
one and two stations it is below 0.001, and 0.29 or more if both stations get one channel."""

DOUBLED_CHANNEL_HINT = "Set each station to a channel of its own"


def find_doubled_channels(sweeps: Sweeps) -> tuple[int, ...]:
    """Find the channels on which more than one station sends, ascending."""
    return tuple(
        channel
        for channel in np.unique(sweeps.channel).tolist()
        if channel in CHANNELS and _is_doubled(sweeps, channel)
    )


def doubled_channel_message(channels: Sequence[int]) -> str:
    """Format the message about channels with more than one station."""
    listed = ", ".join(map(str, channels))
    return f"more than one station sends on channel {listed}; its sweeps are not used"


def _is_doubled(sweeps: Sweeps, channel: int) -> bool:
    """Return True if the sweeps of a channel, over all devices, show a second station."""
    phases = counts = (0, 0)
    rows = np.flatnonzero((sweeps.channel == channel) & np.isfinite(sweeps.count))
    period_s = float(period_ticks(channel)) / TICK_HZ
    for device in np.unique(sweeps.device[rows]).tolist():
        own = rows[sweeps.device[rows] == device]
        own = own[np.lexsort((sweeps.count[own], sweeps.time_ns[own]))]
        time_s = (sweeps.time_ns[own] - sweeps.time_ns[own[0]]) * 1e-9
        count_s = sweeps.count[own] * (TICKS_PER_COUNT / TICK_HZ)
        conflicts, paired = count_phase_conflicts(time_s, time_s - count_s, period_s)
        if paired >= MIN_PAIRED_FRACTION * len(own):
            phases = phases[0] + conflicts, phases[1] + paired
            continue
        for sensor in np.unique(sweeps.sensor[own]):
            is_own = sweeps.sensor[own] == sensor
            angle_rad = count_s[is_own] / period_s * 2 * np.pi
            conflicts, repeating = _count_angle_conflicts(time_s[is_own], angle_rad)
            counts = counts[0] + conflicts, counts[1] + repeating
    return any(
        conflicts >= max(MIN_CONFLICTS, fraction * total)
        for (conflicts, total), fraction in (
            (phases, MAX_PHASE_CONFLICT_FRACTION),
            (counts, MAX_COUNT_CONFLICT_FRACTION),
        )
    )


def _is_paired(time_s: Array, zero_s: Array, period_s: float) -> Mask:
    """Return a mask of the sweeps (n,) that agree with one of the other plane in their rotation."""
    is_paired = np.zeros(len(time_s), bool)
    for lag in range(1, min(2 * NEIGHBOURS, len(time_s) - 1) + 1):
        interval_s = time_s[lag:] - time_s[:-lag]
        is_pair = (interval_s > MIN_PLANE_DELAY_TURNS * period_s) & (interval_s < period_s)
        is_pair &= np.abs(zero_s[lag:] - zero_s[:-lag]) < MAX_PAIR_ERROR_S
        is_paired[lag:] |= is_pair
        is_paired[:-lag] |= is_pair
    return is_paired


def _neighbours(values: Array) -> tuple[Array, Array]:
    """Return the values before and after each of ``values`` (n,), both (n, k), padded by nan."""
    padded = np.pad(values, NEIGHBOURS, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * NEIGHBOURS + 1)
    return windows[:, :NEIGHBOURS], windows[:, NEIGHBOURS + 1 :]


def count_phase_conflicts(time_s: Array, zero_s: Array, period_s: float) -> tuple[int, int]:
    """Count the sweeps of a channel whose phase differs from two others that agree.

    Parameters
    ----------
    time_s, zero_s : (n,) ndarray
        Times of the sweeps, ascending, and of the zero of the rotor according to each.
    period_s : float
        Duration of a rotation.

    Returns
    -------
    conflicts, paired
        ``paired`` are the sweeps that agree with one of the other plane in their rotation; only
        these are compared. The two others are before and after.
    """
    zero_s = np.sort(zero_s[_is_paired(time_s, zero_s, period_s)])
    paired = len(zero_s)
    if paired == 0:
        return 0, 0
    # One zero for each rotation, from the sweeps of all photodiodes.
    first = np.flatnonzero(np.diff(zero_s, prepend=-np.inf) > MAX_PAIR_ERROR_S)
    size, zero_s = np.diff(np.append(first, paired)), zero_s[first]
    before, after = _neighbours(zero_s)

    def agrees(first: Array, second: Array) -> Mask:
        interval_s = second - first
        error_s = np.abs(interval_s - np.rint(interval_s / period_s) * period_s)
        tolerance_s = MAX_PAIR_ERROR_S + MAX_PHASE_DRIFT_PPM * 1e-6 * interval_s
        return (error_s < tolerance_s) & (interval_s < PHASE_WINDOW_S)

    differs_after = (after - zero_s[:, None] < PHASE_WINDOW_S) & ~agrees(zero_s[:, None], after)
    is_conflict = np.zeros(len(zero_s), bool)
    for k in range(NEIGHBOURS):
        is_conflict |= np.any(agrees(before[:, k, None], after) & differs_after, axis=1)
    return int(size[is_conflict].sum()), paired


def _count_angle_conflicts(time_s: Array, angle_rad: Array) -> tuple[int, int]:
    """Count the sweeps of one photodiode among four or more angles that repeat.

    An angle repeats if a sweep before and one after have it.

    Returns
    -------
    conflicts, total
        ``total`` are the sweeps among any angles that repeat.
    """
    (angle_before, angle_after), (before_s, after_s) = _neighbours(angle_rad), _neighbours(time_s)
    angle_before = np.where(time_s[:, None] - before_s < COUNT_WINDOW_S, angle_before, np.nan)
    angle_after = np.where(after_s - time_s[:, None] < COUNT_WINDOW_S, angle_after, np.nan)
    repeats = np.zeros(angle_before.shape, bool)
    for k in range(NEIGHBOURS):
        repeats |= np.abs(angle_before - angle_after[:, k, None]) < SAME_COUNT_RAD
    repeated = np.sort(np.where(repeats, angle_before, np.nan), axis=1)
    groups = np.any(repeats, axis=1) + np.sum(np.diff(repeated, axis=1) > SAME_COUNT_RAD, axis=1)
    return int(np.count_nonzero(groups >= 4)), int(np.count_nonzero(groups))
