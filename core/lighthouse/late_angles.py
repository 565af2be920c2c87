"""Times of the light of rotor angles that were logged later.

A Crazyflie logs the angles of both planes of a rotation together, when the next pulse of light
arrives: 0.5 to 14 ms after the second sweep, by a clock that may be 1 % slow. The angles
themselves tell the time more accurately. A sweep with rotor angle ``a`` happens a fraction of
``a / 2 pi`` of a rotation after the rotor's zero, and the zeros are a period apart. The rate of the
clock and the phases of the rotors are therefore found from all angles together: first the rate
at which the rotors appear most regular, then the line below the delayed stamps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.clock_line import ClockLine, fit_clock_line
from locatk.core.lighthouse.channels import TICK_HZ, TICKS_PER_COUNT, period_ticks
from locatk.core.lighthouse.plane_labels import FRAME_S, MAX_PULSE_GAP_TICKS, PULSE_HZ

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

COUNT_S = TICKS_PER_COUNT / TICK_HZ
"""Duration of an LFSR step [s]."""

GROUP_GAP_S = MAX_PULSE_GAP_TICKS / PULSE_HZ
"""Time without light after which the next pulse completes a passage [s], and with it the angles."""

MAX_DELAY_TURNS = 0.7
"""Longest time from the second sweep to the event [rotations]: with one station, the next light is
the first sweep of the next rotation, after two thirds."""

MIN_POSSIBLE_FRACTION = 0.9
"""Fraction of the delays of a station that must be possible. The others follow a hidden pulse."""

MAX_EQUAL_DIFFERENCE = 0.005
"""Difference of such fractions that is insignificant."""

DELAY_BINS = 100
"""Resolution of delays, in parts of a rotation."""

COARSE_SPAN_S = 60.0
"""Part of a recording in which the rate is searched [s]."""

RATE_STEPS_PER_TURN = 20
"""Rates that are tried for each rotation by which they change the end of the recording."""

MIN_SPAN_S = 20.0
"""Shortest recording of several stations in which smallest delays occur at the beginning and at the
end [s]. They need the light of another station soon after the second sweep, and two rotors take up
to 9.6 s for all their relative phases (channels 1 and 2)."""

MIN_EVENTS = 20
"""Events of a station that are needed to find the phase of its rotor."""


@dataclass(frozen=True)
class DatedAngles:
    """Times of late angles.

    Attributes
    ----------
    time_s : (n,) ndarray
        Time of the light, in seconds of a reference clock that agrees with nominal rotors; ``nan``
        for angles of a station with too few events.
    clock : ClockLine
        Mapping of the reference clock to the clock of the events. Its rate is an estimate only in
        recordings of :data:`MIN_SPAN_S`; times of shorter ones are off by milliseconds.
    """

    time_s: Array
    clock: ClockLine


def date_late_angles(
    event_s: Array,
    channel: IntArray,
    plane: IntArray,
    count: Array,
    rates: Sequence[tuple[float, float]],
    resolution_s: float = 0.0,
) -> DatedAngles | None:
    """Determine when the light of logged angles was received.

    Parameters
    ----------
    event_s : (n,) ndarray
        Time of each event. The angles of one rotation have equal times.
    channel : (n,) int64 ndarray
        1 to 16.
    plane : (n,) int64 ndarray
        0 or 1.
    count : (n,) ndarray
        LFSR steps since the rotor's zero.
    rates : sequence of (low, high)
        Ranges of the rate of the events' clock.
    resolution_s : float
        Step of the times, of which each is the middle.

    Returns
    -------
    DatedAngles or None
        None if no station has enough events.
    """
    time_s = np.full(len(event_s), np.nan)
    stations: dict[int, tuple[IntArray, Array, Array, IntArray]] = {}
    for value in np.unique(channel).tolist():
        rows = np.flatnonzero(channel == value)
        group_s, group = np.unique(event_s[rows], return_inverse=True)
        if len(group_s) >= MIN_EVENTS:
            planes_s = COUNT_S * _mean_counts(group, plane[rows], count[rows])
            stations[value] = (rows, group_s, planes_s, group)
    if not stations:
        return None
    rate = _most_regular_rate(
        [(s, planes[1], _period_s(value)) for value, (_, s, planes, _) in stations.items()], rates
    )
    lines: list[tuple[int, ClockLine]] = []
    for value, (rows, group_s, planes_s, group) in stations.items():
        period_s = _period_s(value)
        turn = _number_turns(group_s, planes_s[1], period_s, rate)
        if turn is None:
            continue
        rotor_s = turn * period_s
        # The light after a rotation of the only station is its next first sweep.
        next_s = rotor_s + (
            period_s + planes_s[0] if len(stations) == 1 else planes_s[1] + GROUP_GAP_S
        )
        line = fit_clock_line(next_s + FRAME_S, group_s, resolution_s=resolution_s)
        if line is None:
            continue
        time_s[rows] = line.offset_s + line.rate * (rotor_s[group] + COUNT_S * count[rows])
        lines.append((len(rows), line))
    if not lines:
        return None
    weights, fitted = zip(*lines, strict=True)
    common = float(np.average([line.rate for line in fitted], weights=weights))
    is_long = len(stations) == 1 or float(np.ptp(event_s)) >= MIN_SPAN_S
    is_estimated = is_long and all(line.is_estimated for line in fitted)
    return DatedAngles(time_s / common, ClockLine(0.0, common, is_estimated))


def _period_s(channel: int) -> float:
    return float(period_ticks(channel)) / TICK_HZ


def _mean_counts(group: IntArray, plane: IntArray, count: Array) -> Array:
    """Return the mean counts (2, m) of both planes in each group of angles.

    If one is missing, it follows from the other and the median difference of the planes.
    """
    means = np.full((2, int(group.max()) + 1), np.nan)
    for k in (0, 1):
        is_mine = plane == k
        number = np.bincount(group[is_mine], minlength=means.shape[1])
        total = np.bincount(group[is_mine], count[is_mine], minlength=means.shape[1])
        means[k] = np.where(number > 0, total / np.maximum(number, 1), np.nan)
    difference = means[1] - means[0]
    typical = np.nanmedian(difference) if np.isfinite(difference).any() else 0.0
    missing = np.isnan(means)
    return np.where(missing, means[::-1] + np.array([[-typical], [typical]]), means)


def _most_regular_rate(
    stations: Sequence[tuple[Array, Array, float]], rates: Sequence[tuple[float, float]]
) -> float:
    """Return the rate of the clock at which the delays of all stations are possible.

    It is searched at the beginning of the recording, and then refined with more and more of it. The
    worst station decides: an event also occurs at the light of another station, so that at a wrong
    rate, which makes up for the difference of their periods, one of them appears more regular, and
    the other one less.
    """
    start_s = min(float(group_s[0]) for group_s, _, _ in stations)
    duration_s = max(float(group_s[-1]) for group_s, _, _ in stations) - start_s
    span_s = COARSE_SPAN_S
    while True:
        step = (
            min(period_s for _, _, period_s in stations)
            / max(min(span_s, duration_s), 1.0)
            / RATE_STEPS_PER_TURN
        )
        tried = np.concatenate(
            [np.linspace(low, high, 2 + int((high - low) / step)) for low, high in rates]
        )
        possible = np.ones(len(tried))
        for group_s, second_s, period_s in stations:
            n = int(np.searchsorted(group_s, start_s + span_s, side="right"))
            elapsed_s = group_s[:n] - start_s
            for k, rate in enumerate(tried if n else ()):
                turns = (elapsed_s / rate - second_s[:n]) / period_s
                possible[k] = min(possible[k], _possible_fraction(turns)[0])
        best = float(tried[_middle_of_maximum(possible)])
        if span_s >= duration_s:
            return best
        rates = [(best - 5 * step, best + 5 * step)]
        span_s *= 4


def _middle_of_maximum(values: Array) -> int:
    """Return the middle of the range around the first maximum in which values are nearly equal."""
    peak = int(np.argmax(values))
    low = np.flatnonzero(values < values[peak] - MAX_EQUAL_DIFFERENCE)
    before, after = low[low < peak], low[low > peak]
    first = int(before[-1]) + 1 if len(before) else 0
    last = int(after[0]) - 1 if len(after) else len(values) - 1
    return (first + last) // 2


def _possible_fraction(turns: Array) -> tuple[float, float]:
    """Return the largest fraction of delays within :data:`MAX_DELAY_TURNS`, and their smallest one.

    ``turns`` (n,) are delays with an unknown constant; whole rotations are ignored.
    """
    bins = np.bincount(
        ((turns % 1) * DELAY_BINS).astype(np.int64) % DELAY_BINS, minlength=DELAY_BINS
    )
    sums = np.concatenate([[0], np.cumsum(np.tile(bins, 2))])
    width = round(MAX_DELAY_TURNS * DELAY_BINS)
    inside = sums[width : width + DELAY_BINS] - sums[:DELAY_BINS]
    # Of equal arcs the middle one is taken: wrong delays are then on both sides of it.
    best = np.exp(2j * np.pi * np.flatnonzero(inside == inside.max()) / DELAY_BINS)
    first = round(float(np.angle(best.mean())) / (2 * np.pi) * DELAY_BINS) % DELAY_BINS
    return float(inside[first] / len(turns)), first / DELAY_BINS


def _number_turns(group_s: Array, second_s: Array, period_s: float, rate: float) -> IntArray | None:
    """Return the rotation of each event; None if most delays are impossible."""
    turns = (group_s / rate - second_s) / period_s
    fraction, first = _possible_fraction(turns)
    if fraction < MIN_POSSIBLE_FRACTION:
        return None
    margin = (1 - MAX_DELAY_TURNS) / 2
    return np.floor(turns - first + margin).astype(np.int64)
