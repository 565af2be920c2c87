"""Channels on which more than one base station sends.

Stations on one channel send the same sequences, so that no sweep shows which of them sent it. A
position from sweeps of both is wrong, and nothing in it shows that. Two observations do:

**Time.** The time of a sweep minus the duration of its count is a time at which the rotor was at
its zero. The zeros of one rotor are whole rotations apart; those of two rotors differ by an
arbitrary phase. A reflection has the phase of its rotor. This needs the times of single sweeps,
as reported by a Lighthouse deck or a logic analyser.

**Counts.** If all sweeps of a report have the time of the report, their phase is unknown. The angle
of a light plane then jumps between two levels, one for each station (or for a station and its
reflection, which is as wrong), and is never between them. A photodiode that oscillates passes
through the angles between its turning points: all sweeps together decide if they are empty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.channels import CHANNELS, TICK_HZ, TICKS_PER_COUNT, period_ticks
from locatk.core.lighthouse.epochs import (
    MAX_PLANE_DELAY_TURNS,
    MIN_PLANE_DELAY_TURNS,
)
from locatk.core.lighthouse.recording import UNKNOWN, Sweeps

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

MAX_PHASE_INTERVAL_S = 1.0
"""Longest time between two rotations whose phases are compared [s]: four reports at 3 Hz."""

NEIGHBOURS = 8
"""Number of rotations before and after that one is compared with."""

MIN_CONFLICTS = 4
"""Smallest number of sweeps whose phases show a second station."""

MAX_PHASE_CONFLICT_FRACTION = 0.02
"""Fraction of sweeps with another phase than those around them above which a second station sends.
If 10 % of the sweeps have random counts, 0.1 % have such a phase, by chance."""

WINDOW_SWEEPS = 9
"""Number of successive angles of a light plane in which two levels are looked for."""

MAX_ANGLE_INTERVAL_S = 0.5
"""Longest time between two angles of a window [s]: reports at 2 Hz. In a longer time a robot can
be carried elsewhere and back."""

MIN_LEVEL_SWITCHES, MIN_LEVEL_SWEEPS = 3, 3
"""Smallest number of changes of level in a window, and of angles on each level. A robot that turns
around between two places changes twice. Of 10 % of outliers, two are in one window of five."""

MIN_LEVEL_GAP_RAD = float(np.radians(3.0))
"""Smallest gap between two levels [rad], above the errors of single angles."""

MIN_GAP_RATIO = 2.0
"""Smallest gap between two levels, relative to the range of angles on each. The middle half of all
angles is then empty, in which a harmonic oscillation is for a third of the time."""

ALIASED_PERIODS = (4, 6)
"""Periods [reports], with their divisors, in which an oscillation can appear at two levels: its
frequency is a multiple of 1/2, 1/3, 1/4, or 1/6 of that of the reports. With other periods the
angles are at three levels or more."""

ONE_STATION_WINDOW_FRACTION, TWO_STATION_WINDOW_FRACTION = 0.05, 0.4
"""Expected fractions of windows with two levels. One photodiode and one station: of independent
draws from a harmonic oscillation, which is the worst case, 3.8 % of the windows have two levels; of
random positions (uniform draws) 1.0 %. Two stations that are received equally often in random
order: 66 %, of which the robot's motion and outliers blur about a half."""

MIN_LOG_EVIDENCE = float(np.log(1e6))
"""Logarithm of the likelihood ratio from which two stations are taken for proven: a million to one,
since a false alarm costs the whole channel."""

DOUBLED_CHANNEL_HINT = "Set each station to a channel of its own"


@dataclass(frozen=True)
class DoubledChannels:
    """Channels on which more than one station sends, ascending.

    Attributes
    ----------
    proven : tuple of int
        All sweeps of the channel together prove a second station.
    possible : tuple of int
        Some sweeps look like those of a second station, which may be hidden most of the time. So
        do sweeps of a photodiode that moves to and fro between two places within a report.
    """

    proven: tuple[int, ...]
    possible: tuple[int, ...]


def find_doubled_channels(sweeps: Sweeps) -> DoubledChannels:
    """Find the channels on which more than one station sends."""
    proven, possible = [], []
    for channel in np.unique(sweeps.channel).tolist():
        if channel not in CHANNELS:
            continue
        has_two_phases, evidence, alternating_evidence = _compare_hypotheses(sweeps, channel)
        if has_two_phases or evidence > MIN_LOG_EVIDENCE:
            proven.append(channel)
        elif alternating_evidence > MIN_LOG_EVIDENCE:
            possible.append(channel)
    return DoubledChannels(tuple(proven), tuple(possible))


def doubled_channel_message(channels: Sequence[int]) -> str:
    """Format the message about channels with more than one station."""
    whose = "its" if len(channels) == 1 else "their"
    return f"more than one station sends on {_channels_text(channels)}; {whose} sweeps are not used"


def possible_doubled_channel_message(channels: Sequence[int]) -> str:
    """Format the message about channels that may have more than one station."""
    return (
        f"more than one station may send on {_channels_text(channels)}: in part of the recording, "
        "angles jump between two levels"
    )


def _channels_text(channels: Sequence[int]) -> str:
    """Return "channel 1", or "channels 1, 2"."""
    return f"channel{'s' * (len(channels) > 1)} {', '.join(map(str, channels))}"


def _compare_hypotheses(sweeps: Sweeps, channel: int) -> tuple[bool, float, float]:
    """Compare the hypotheses of two stations and of one, over all devices.

    Returns
    -------
    has_two_phases : bool
        True if the sweeps have two phases.
    evidence, alternating_evidence : float
        Logarithm of the likelihood ratio from the angles, of all windows and of those that change
        between two ranges of angles. Photodiodes of a device share its motion and hence count as
        one; so do its two light planes, of which that with more evidence for two stations counts.
    """
    conflicts = paired = 0
    evidence = np.zeros(2)
    rows = np.flatnonzero((sweeps.channel == channel) & np.isfinite(sweeps.count))
    period_s = float(period_ticks(channel)) / TICK_HZ
    if not len(rows):
        return False, 0.0, 0.0
    rows = rows[np.argsort(sweeps.device[rows], kind="stable")]
    for own in np.split(rows, np.flatnonzero(np.diff(sweeps.device[rows])) + 1):
        if not len(own):  # No sweep of the channel has a count.
            continue
        own = own[np.argsort(sweeps.time_ns[own], kind="stable")]
        time_s = (sweeps.time_ns[own] - sweeps.time_ns[own[0]]) * 1e-9
        count_s = sweeps.count[own] * (TICKS_PER_COUNT / TICK_HZ)
        device_conflicts, device_paired = count_phase_conflicts(time_s, time_s - count_s, period_s)
        if device_paired >= MIN_PAIRED_FRACTION * len(own):
            conflicts, paired = conflicts + device_conflicts, paired + device_paired
            continue
        sensor_evidence = []
        for sensor in np.unique(sweeps.sensor[own]):
            is_own = sweeps.sensor[own] == sensor
            angle_rad = count_s[is_own] / period_s * 2 * np.pi
            plane = _assign_planes(time_s[is_own], angle_rad, sweeps.sweep[own[is_own]])
            sensor_evidence.append(
                [_angle_evidence(time_s[is_own][plane == k], angle_rad[plane == k]) for k in (0, 1)]
            )
        evidence += np.max(np.mean(sensor_evidence, axis=0), axis=0)
    has_two_phases = conflicts >= max(MIN_CONFLICTS, MAX_PHASE_CONFLICT_FRACTION * paired)
    return has_two_phases, float(evidence[0]), float(evidence[1])


def _is_paired(time_s: Array, zero_s: Array, period_s: float) -> Mask:
    """Return a mask of the sweeps (n,) that agree with one of the other plane in their rotation."""
    is_paired = np.zeros(len(time_s), bool)
    for lag in range(1, min(2 * NEIGHBOURS, len(time_s) - 1) + 1):
        interval_s = time_s[lag:] - time_s[:-lag]
        if np.min(interval_s) >= period_s:
            break  # Sweeps further apart are of different rotations, too.
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
        return (error_s < tolerance_s) & (interval_s < MAX_PHASE_INTERVAL_S)

    # Different from both: where the clock of the host is corrected, phases change continuously.
    differs_before = ~agrees(before, zero_s[:, None])
    differs_after = ~agrees(zero_s[:, None], after)
    is_conflict = np.zeros(len(zero_s), bool)
    rows = np.flatnonzero(differs_before.any(axis=1) & differs_after.any(axis=1))
    before, after = before[rows], after[rows]
    for k in range(NEIGHBOURS):
        differs = differs_before[rows, k, None] & differs_after[rows]
        is_conflict[rows] |= np.any(agrees(before[:, k, None], after) & differs, axis=1)
    return int(size[is_conflict].sum()), paired


def _assign_planes(
    time_s: Array, angle_rad: Array, reported_plane: NDArray[np.int32]
) -> NDArray[np.int64]:
    """Return the light plane, 0, 1 or ``UNKNOWN``, of each sweep (n,) of one photodiode.

    The largest gap between the angles of a report separates its planes if it is as large as one
    between planes. An outlier can thus exchange planes, a report of a single angle has none.
    """
    report = np.cumsum(np.diff(time_s, prepend=time_s[0]) > 0)
    ordered_rad = angle_rad[np.lexsort((angle_rad, report))]
    starts_report = np.flatnonzero(np.diff(report, prepend=-1))
    gap_rad = np.diff(ordered_rad, prepend=0.0)
    gap_rad[starts_report] = 0.0
    largest_rad = np.maximum.reduceat(gap_rad, starts_report)
    above_gap_rad = np.where(gap_rad == largest_rad[report], ordered_rad, -np.inf)
    first_above_rad = np.maximum.reduceat(above_gap_rad, starts_report)
    turns = largest_rad / (2 * np.pi)
    is_known = (turns > MIN_PLANE_DELAY_TURNS) & (turns < MAX_PLANE_DELAY_TURNS)
    plane = np.where(is_known[report], angle_rad >= first_above_rad[report], UNKNOWN)
    return np.where(reported_plane == UNKNOWN, plane, reported_plane)


def _is_aliased(times_s: Array, is_above: Mask, interval_s: float) -> Mask:
    """Return a mask of the windows (m, k) in which an oscillation in step with reports has levels.

    The level is then a function of the number of the report modulo a small period. Reports are
    ``interval_s`` apart.
    """
    report = np.rint((times_s - times_s[:, :1]) / interval_s)
    is_aliased = np.zeros(len(times_s), bool)
    for period in ALIASED_PERIODS:
        is_function = np.ones(len(times_s), bool)
        for remainder in range(period):
            is_chosen = report % period == remainder
            is_function &= ~(
                np.any(is_chosen & is_above, axis=1) & np.any(is_chosen & ~is_above, axis=1)
            )
        is_aliased |= is_function
    return is_aliased


def _angle_evidence(time_s: Array, angle_rad: Array) -> tuple[float, float]:
    """Compare two stations with one by the angles (n,) of a light plane, ascending in time.

    Returns the logarithms of the likelihood ratios of all windows of successive angles and of
    those that change between two ranges of angles, if one station does not make as many by chance.
    Windows overlap, so that each of them counts as a fraction of an observation.
    """
    if len(time_s) < WINDOW_SWEEPS:
        return 0.0, 0.0
    angles, times = (
        np.lib.stride_tricks.sliding_window_view(values, WINDOW_SWEEPS)
        for values in (angle_rad, time_s)
    )
    is_complete = np.max(np.diff(times, axis=1), axis=1) <= MAX_ANGLE_INTERVAL_S
    angles = angles[is_complete]
    ordered = np.sort(angles, axis=1)
    window = np.arange(len(angles))
    split = np.argmax(np.diff(ordered, axis=1), axis=1)
    below, above = ordered[window, split], ordered[window, split + 1]
    gap = above - below
    level_range = np.maximum(below - ordered[:, 0], ordered[:, -1] - above)
    is_above = angles > below[:, None]
    switches = np.count_nonzero(np.diff(is_above, axis=1), axis=1)
    smaller = np.minimum(split + 1, WINDOW_SWEEPS - 1 - split)
    is_alternating = (
        (switches >= MIN_LEVEL_SWITCHES) & (smaller >= MIN_LEVEL_SWEEPS) & (gap > MIN_LEVEL_GAP_RAD)
    )
    has_levels = is_alternating & (gap > MIN_GAP_RATIO * level_range)
    interval_s = np.diff(time_s)
    if np.any(interval_s > 0):
        rows = np.flatnonzero(has_levels)
        usual_s = float(np.median(interval_s[interval_s > 0]))
        has_levels[rows] = ~_is_aliased(times[is_complete][rows], is_above[rows], usual_s)
    two_levels = int(np.count_nonzero(has_levels))
    one, two = ONE_STATION_WINDOW_FRACTION, TWO_STATION_WINDOW_FRACTION

    def log_ratio(total: int) -> float:
        others = total - two_levels
        return float(
            (two_levels * np.log(two / one) + others * np.log((1 - two) / (1 - one)))
            / WINDOW_SWEEPS
        )

    evidence = log_ratio(len(angles))
    if two_levels < one * len(angles):
        return evidence, evidence
    return evidence, log_ratio(int(np.count_nonzero(is_alternating)))
