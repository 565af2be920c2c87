"""Estimate the period and the phase over time of each base station's rotor.

An identified burst determines a time at which the rotor was at its zero: its own time minus the
duration of its sequence index. The rotor of a station rotates with the constancy of a crystal and
wanders about it by some microseconds. The bursts of a station must therefore agree on one period,
and successive bursts on one phase. Bursts that do not were identified wrongly.

Bursts that agree on one phase, without a longer gap, form a segment. A station that was hidden for
long, or was switched off and on, starts another segment. Two simultaneous segments are two
stations on one channel. Their light cannot be separated reliably, so such a channel is reported
and gets no rotor.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from locatk.core.lighthouse.channels import (
    CHANNELS,
    TICK_HZ,
    TICKS_PER_COUNT,
    channel_of,
    period_ticks,
)
from locatk.core.lighthouse.doubled_channels import count_phase_conflicts

Array = NDArray[np.float64]

MIN_VOTE_EVIDENCE_BITS = 28.0
"""Evidence from which a burst may vote for a rotor. A single burst of it may be noise; several
that agree are not."""

MIN_SEGMENT_BURSTS = 4
"""Number of agreeing bursts that form a segment."""

MAX_CLOCK_ERROR_PPM = 200.0
"""Largest relative deviation of a period from nominal: clocks of station and recorder together."""

MAX_ROTOR_RESIDUAL_S = 2e-6
"""Largest distance of a burst from the estimated phase; beyond it, it was identified wrongly.
Single bursts scatter by 0.13 us at 1 m and by 0.5 us at 4 m (recordings take1 and about_4m of
Bitcraze lighthouse-fpga)."""

MAX_LINK_ERROR_S = 3e-6
"""Largest deviation of the time between two linked bursts from whole rotations."""

MAX_LINK_DRIFT_PPM = 2.0
"""Growth of :data:`MAX_LINK_ERROR_S` with the time between the bursts."""

MAX_LINK_NEIGHBOURS = 8
"""A burst is compared with this many bursts before and after it."""

MAX_GAP_ROTATIONS = 50
"""Rotations without a burst after which a segment ends."""

PERIOD_BASELINES_ROTATIONS = (4, MAX_GAP_ROTATIONS)
"""Baselines over which the period is measured, in ascending order of precision."""

MIN_RESTART_SHIFT_S = 20e-6
"""Phase shift after a gap from which a rotor counts as restarted."""

KNOT_SPACING_S = 0.5
"""Time between the knots of the phase curve."""

SMOOTHNESS_WEIGHT = 3.0
"""Weight of the squared second differences of the phase curve, relative to the mean number of
bursts per knot. With 3 a knot averages over some seconds."""

SMOOTHING_ITERATIONS = 4
"""Iterations of the reweighted least-squares fit of the phase curve."""

HUBER_SIGMAS = 2.0
"""Residual, in robust standard deviations, from which a burst gets less weight."""

MAX_SECOND_ROTOR_FRACTION = 0.1
"""If more than this fraction of a channel's bursts agrees on another phase at the same time, two
stations send on the channel."""


@dataclass(frozen=True)
class Rotor:
    """Rotation of a base station over a recording.

    Attributes
    ----------
    channel : int
        1 to 16.
    period_tick : float
        Mean duration of a rotation, in ticks of the recorder.
    zero_tick : float
        Start of rotation 0, in ticks of the recorder.
    knot_tick : (k,) ndarray
        Times at which ``wander_tick`` is given, in ticks of the recorder.
    wander_tick : (k,) ndarray
        Delay of the rotor's zero relative to ``zero_tick + k period_tick``, in ticks. It is
        interpolated linearly, over gaps too.
    burst_count : int
        Number of bursts that agree.
    restart_count : int
        Number of gaps after which the rotor had another phase.
    sigma_tick : float
        Standard deviation of a burst, in ticks.
    """

    channel: int
    period_tick: float
    zero_tick: float
    knot_tick: Array
    wander_tick: Array
    burst_count: int
    restart_count: int
    sigma_tick: float

    @property
    def ticks_per_bit(self) -> float:
        """Duration of a bit of this station, in ticks of the recorder."""
        return self.period_tick * TICKS_PER_COUNT / float(period_ticks(self.channel))

    def rotation_and_phase(self, tick: Array) -> tuple[NDArray[np.int64], Array]:
        """Return rotation number and phase (0 to below 1 rotation) at times in recorder ticks."""
        wander = np.interp(tick, self.knot_tick, self.wander_tick)
        rotations = (tick - self.zero_tick - wander) / self.period_tick
        whole = np.floor(rotations)
        return whole.astype(np.int64), rotations - whole

    def start_tick(self, rotation: NDArray[np.int64]) -> Array:
        """Return the start of rotations, in ticks of the recorder."""
        tick = self.zero_tick + rotation * self.period_tick
        return tick + np.interp(tick, self.knot_tick, self.wander_tick)

    def period_48mhz_ticks(self, rate_hz: float) -> float:
        """Return the period in ticks of 48 MHz; the recorder has ``rate_hz`` ticks per second."""
        return self.period_tick / rate_hz * TICK_HZ

    def period_deviation_ppm(self, rate_hz: float) -> float:
        """Return the deviation of the period from nominal, in parts per million."""
        return (self.period_48mhz_ticks(rate_hz) / float(period_ticks(self.channel)) - 1) * 1e6


@dataclass(frozen=True)
class RotorSet:
    """Rotors of all base stations of a recording.

    Attributes
    ----------
    rotors : dict of int to Rotor
        By channel.
    doubled_channels : tuple of int
        Channels on which more than one station sends. They have no rotor.
    """

    rotors: dict[int, Rotor]
    doubled_channels: tuple[int, ...]


def find_rotors(
    tick: Array,
    polynomial: NDArray[np.int32],
    index: NDArray[np.int64],
    evidence_bits: Array,
    rate_hz: float,
) -> RotorSet:
    """Find the rotors that bursts agree on.

    Parameters
    ----------
    tick : (n,) ndarray
        Start of the first bit of each burst, ascending, in ticks of the recorder.
    polynomial, index : (n,) ndarray
        As identified. Bursts with polynomial -1 are ignored.
    evidence_bits : (n,) ndarray
        See :class:`~locatk.core.lighthouse.demodulation.identification.SequenceMatches`.
    rate_hz : float
        Ticks of the recorder per second.
    """
    rotors: dict[int, Rotor] = {}
    doubled = []
    is_vote = (polynomial >= 0) & (evidence_bits >= MIN_VOTE_EVIDENCE_BITS)
    channels = np.where(is_vote, channel_of(polynomial), 0)
    for channel in CHANNELS:
        rows = np.flatnonzero(channels == channel)
        if len(rows) < MIN_SEGMENT_BURSTS:
            continue
        period = _estimate_period(channel, tick[rows], index[rows], rate_hz)
        # Zeros of right identifications ascend in time; those of wrong ones are arbitrary.
        zero = rotor_zero_ticks(tick[rows], index[rows], channel, period)
        order = np.argsort(zero, kind="stable")
        segments, excluded = _select_disjoint(_link_segments(zero[order], period, rate_hz))
        if not segments:
            continue
        # Two rotors whose phases cross during the recording are linked to one segment.
        conflicts, paired = count_phase_conflicts(
            tick[rows] / rate_hz,
            rotor_zero_ticks(tick[rows], index[rows], channel, period) / rate_hz,
            period / rate_hz,
        )
        # Of two rotors, the bursts of both are in conflict.
        if (
            excluded > MAX_SECOND_ROTOR_FRACTION * sum(map(len, segments))
            or conflicts > 2 * MAX_SECOND_ROTOR_FRACTION * paired
        ):
            doubled.append(channel)
            continue
        rows = rows[order]
        segment_rows = [rows[segment] for segment in segments]
        rotors[channel] = _fit_rotor(channel, tick, index, segment_rows, period, rate_hz)
    return RotorSet(rotors, tuple(doubled))


def rotor_zero_ticks(
    tick: Array, index: NDArray[np.int64], channel: int, period_tick: float
) -> Array:
    """Return the time of the rotor's zero according to each burst, in ticks of the recorder.

    One clock of the station drives bits and rotations. The duration of ``index`` therefore
    deviates from nominal by the same factor as the period.
    """
    return tick - index * (period_tick * TICKS_PER_COUNT / float(period_ticks(channel)))


def _estimate_period(channel: int, tick: Array, index: NDArray[np.int64], rate_hz: float) -> float:
    """Return the period on which most pairs of bursts agree, refined over longer baselines."""
    nominal = period = float(period_ticks(channel)) / TICK_HZ * rate_hz
    for baseline in PERIOD_BASELINES_ROTATIONS:
        zero = np.sort(rotor_zero_ticks(tick, index, channel, period))
        partner = np.searchsorted(zero, zero + (baseline + 0.5) * period) - 1
        interval = zero[partner] - zero
        rotations = np.rint(interval / period)
        is_pair = rotations > 0
        candidates = interval[is_pair] / rotations[is_pair]
        is_plausible = np.abs(candidates - nominal) < MAX_CLOCK_ERROR_PPM * 1e-6 * nominal
        candidates = candidates[is_plausible]
        if len(candidates):
            period = _densest_median(candidates, 2 * MAX_LINK_ERROR_S * rate_hz / baseline)
    return period


def _densest_median(values: Array, width: float) -> float:
    """Return the median of the values in the interval of a given width that contains most."""
    ordered = np.sort(values)
    number = np.searchsorted(ordered, ordered + width, side="right") - np.arange(len(ordered))
    first = int(np.argmax(number))
    return float(np.median(ordered[first : first + number[first]]))


def _link_segments(zero: Array, period: float, rate_hz: float) -> list[NDArray[np.int64]]:
    """Link zeros (n,), ascending, to segments if they differ by whole rotations.

    Returns the rows of each segment, ascending; the longest segment comes first.
    """
    pairs = [np.zeros((2, 0), np.int64)]
    for ahead in range(1, min(MAX_LINK_NEIGHBOURS, len(zero) - 1) + 1):
        interval = zero[ahead:] - zero[:-ahead]
        error = np.abs(interval - np.rint(interval / period) * period)
        agrees = error < MAX_LINK_ERROR_S * rate_hz + MAX_LINK_DRIFT_PPM * 1e-6 * interval
        row = np.flatnonzero(agrees & (interval < (MAX_GAP_ROTATIONS + 0.5) * period))
        pairs.append(np.stack([row, row + ahead]))
    link = np.concatenate(pairs, axis=1)
    graph = coo_array((np.ones(link.shape[1]), (link[0], link[1])), (len(zero), len(zero)))
    _, component = connected_components(graph, directed=False)
    order = np.argsort(component, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(component[order])) + 1)
    segments = (rows for rows in parts if len(rows) >= MIN_SEGMENT_BURSTS)
    return sorted(segments, key=len, reverse=True)


def _select_disjoint(segments: list[NDArray[np.int64]]) -> tuple[list[NDArray[np.int64]], int]:
    """Select segments that do not overlap in time, long ones first.

    Returns the selected segments, ascending, and the number of rows in the excluded ones.
    """
    selected: list[NDArray[np.int64]] = []
    excluded = 0
    for rows in segments:
        k = bisect_left(selected, rows[0], key=lambda segment: int(segment[0]))
        starts_after = k == 0 or selected[k - 1][-1] < rows[0]
        if starts_after and (k == len(selected) or rows[-1] < selected[k][0]):
            selected.insert(k, rows)
        else:
            excluded += len(rows)
    return selected, excluded


def _fit_rotor(
    channel: int,
    tick: Array,
    index: NDArray[np.int64],
    segments: list[NDArray[np.int64]],
    period: float,
    rate_hz: float,
) -> Rotor:
    """Fit the mean period and the phase curve to the bursts of all segments of a rotor."""
    # All segments share one period; each has its own phase.
    for _ in range(2):
        numerator = denominator = 0.0
        for rows in segments:
            zero = rotor_zero_ticks(tick[rows], index[rows], channel, period)
            rotation, delay = _unwrap_delay(zero, period)
            rotation -= rotation.mean()
            numerator += float(rotation @ delay)
            denominator += float(rotation @ rotation)
        if denominator > 0:
            period += numerator / denominator
    first = segments[0][:1]
    zero_tick = float(rotor_zero_ticks(tick[first], index[first], channel, period)[0])
    knots: list[Array] = []
    wander: list[Array] = []
    residuals: list[Array] = []
    restarts = 0
    for rows in segments:
        zero = rotor_zero_ticks(tick[rows], index[rows], channel, period)
        shift = zero[0] - zero_tick
        delay = shift - np.rint(shift / period) * period + _unwrap_delay(zero, period)[1]
        times, curve = _smooth_delay(zero, delay, float(zero[-1] + period), rate_hz)
        residuals.append(delay - np.interp(zero, times, curve))
        if knots:
            jump = curve[0] - wander[-1][-1]
            jump -= np.rint(jump / period) * period
            gap = times[0] - knots[-1][-1]
            max_jump = MIN_RESTART_SHIFT_S * rate_hz + MAX_LINK_DRIFT_PPM * 1e-6 * gap
            restarts += int(abs(jump) > max_jump)
        knots.append(times)
        wander.append(curve)
    residual = np.concatenate(residuals)
    inliers = residual[np.abs(residual) < MAX_ROTOR_RESIDUAL_S * rate_hz]
    return Rotor(
        channel,
        period,
        zero_tick,
        np.maximum.accumulate(np.concatenate(knots)),
        np.concatenate(wander),
        burst_count=len(inliers),
        restart_count=restarts,
        sigma_tick=float(np.sqrt(np.sum(inliers**2) / max(1, len(inliers)))),
    )


def _unwrap_delay(zero: Array, period: float) -> tuple[Array, Array]:
    """Return rotation number and delay relative to a constant rotor of a segment's zeros (n,)."""
    rotation = np.cumsum(np.rint(np.diff(zero, prepend=zero[0]) / period))
    return rotation, zero - zero[0] - rotation * period


def _smooth_delay(
    tick: Array, delay: Array, end_tick: float, rate_hz: float
) -> tuple[Array, Array]:
    """Fit a smooth piecewise linear curve to delays (n,); return its knots and values.

    Penalized least squares with Huber weights, so that a wrong burst has little influence. The
    curve ends at ``end_tick``, the end of the last rotation.
    """
    spacing = KNOT_SPACING_S * rate_hz
    first = float(tick[0])
    count = int(np.ceil((end_tick - first) / spacing)) + 2
    knots = first + spacing * np.arange(count)
    position = (tick - first) / spacing
    left = np.minimum(position.astype(np.int64), count - 2)
    fraction = position - left
    curve = np.zeros(count)
    weight = np.ones(len(tick))
    for _ in range(SMOOTHING_ITERATIONS):
        band = np.zeros((3, count))
        right_side = np.zeros(count)
        np.add.at(band[2], left, weight * (1 - fraction) ** 2)
        np.add.at(band[2], left + 1, weight * fraction**2)
        np.add.at(band[1], left + 1, weight * fraction * (1 - fraction))
        np.add.at(right_side, left, weight * (1 - fraction) * delay)
        np.add.at(right_side, left + 1, weight * fraction * delay)
        _add_curvature_penalty(band, SMOOTHNESS_WEIGHT * max(1.0, len(tick) / count))
        curve = solveh_banded(band, right_side)
        residual = delay - np.interp(tick, knots, curve)
        sigma = 1.4826 * float(np.median(np.abs(residual))) + 1e-3
        weight = np.minimum(1.0, HUBER_SIGMAS * sigma / np.maximum(np.abs(residual), 1e-12))
    # Another segment may follow after the end.
    end = np.interp(end_tick, knots, curve)
    is_inside = knots < end_tick
    return np.append(knots[is_inside], end_tick), np.append(curve[is_inside], end)


def _add_curvature_penalty(band: Array, weight: float) -> None:
    """Add ``weight`` times the squared second differences to upper bands (3, k), in place.

    A small diagonal keeps the system regular if there are fewer than three knots, or knots
    without data.
    """
    count = band.shape[1]
    band[2] += 1e-9 * (band[2].max() + 1.0)
    if count < 3:
        return
    middle = np.arange(1, count - 1)
    np.add.at(band[2], middle - 1, weight)
    np.add.at(band[2], middle, 4 * weight)
    np.add.at(band[2], middle + 1, weight)
    np.add.at(band[1], middle, -2 * weight)
    np.add.at(band[1], middle + 1, -2 * weight)
    np.add.at(band[0], middle + 1, weight)
