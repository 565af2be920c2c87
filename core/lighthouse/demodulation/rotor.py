"""The rotor of each station: its period, and its phase followed over time.

A decoded burst tells when the rotor was at its zero: its own time less the time that its
index takes. A station's rotor turns with a crystal's constancy, wanders about it by some
microseconds, and starts at another moment than any accident would name. So the bursts of a
station must agree on one period, and from one to the next on one phase; those that do not were
decoded wrong.

Bursts of one phase, without a longer silence, are a stretch. A station that was out of sight
for long, or was switched off and on, makes another one. Two stretches at the same time are two
stations on one channel. No light tells them apart for good, so that all that is said of such a
channel is that it happens.
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

Array = NDArray[np.float64]

SEED = 28.0
"""Evidence in bits from which on a burst may vote for a rotor: an accident alone, but not
together."""

LEAST_BURSTS = 4
"""That agree make a stretch of a rotor."""

CLOCKS_PPM = 200.0
"""Clocks of station and recorder together are off by at most this."""

AGREE_S = 2e-6
"""From the followed phase: a burst farther away was decoded wrong. Single bursts scatter by
0.13 us at 1 m and by 0.5 us at 4 m (Bitcraze's recordings)."""

LINK_S = 3e-6
LINK_PPM = 2.0
"""Slack between two bursts of one rotor, and what it grows by with the time between them."""

NEIGHBOURS = 8
"""Bursts before and after to which one may link."""

SILENCE = 50
"""Rotations without a burst after which a stretch ends."""

BASELINES = (4, SILENCE)
"""Rotations over which the period is measured, in the steps in which it is found."""

RESTART_S = 20e-6
"""A rotor that comes back farther than this from where it should be started again."""

KNOT_S = 0.5
"""Between the knots of the followed phase."""

STIFFNESS = 3.0
"""Weight of smoothness against agreement: with it a knot averages over some seconds."""

SECOND_SHARE = 0.1
"""Of a channel's bursts agree on another phase: a second station on it."""


@dataclass(frozen=True)
class Rotor:
    """A station's rotor, followed over a recording.

    Attributes
    ----------
    channel : int
        1 to 16.
    period : float
        Mean length of a rotation, in ticks of the recorder.
    zero : float
        When rotation 0 began, in ticks of the recorder.
    knots : (k,) ndarray
        Times, in ticks of the recorder, at which ``wander`` is given.
    wander : (k,) ndarray
        By how much the rotor's zero is later there than ``zero + k period``, in ticks. Over
        silences it goes straight to where the rotor comes back.
    bursts : int
        That agree.
    restarts : int
        How often it came back from a silence with another phase.
    sigma : float
        Standard deviation of one of them, in ticks.
    """

    channel: int
    period: float
    zero: float
    knots: Array
    wander: Array
    bursts: int
    restarts: int
    sigma: float

    @property
    def ticks_per_bit(self) -> float:
        """Length of a bit of its station, in ticks of the recorder."""
        return self.period * TICKS_PER_COUNT / float(period_ticks(self.channel))

    def turn(self, tick: Array) -> tuple[NDArray[np.int64], Array]:
        """Rotation and place in it, 0 to below 1, of times in ticks of the recorder."""
        turns = (tick - self.zero - np.interp(tick, self.knots, self.wander)) / self.period
        whole = np.floor(turns)
        return whole.astype(np.int64), turns - whole

    def start(self, rotation: NDArray[np.int64]) -> Array:
        """When rotations began, in ticks of the recorder."""
        tick = self.zero + rotation * self.period
        return tick + np.interp(tick, self.knots, self.wander)

    def period_ticks(self, rate_hz: float) -> float:
        """Its period in ticks of 48 MHz of a recorder with ``rate_hz`` ticks a second."""
        return self.period / rate_hz * TICK_HZ

    def ppm(self, rate_hz: float) -> float:
        """By how much its rotations last longer than nominal, in parts per million."""
        return (self.period_ticks(rate_hz) / float(period_ticks(self.channel)) - 1) * 1e6


@dataclass(frozen=True)
class RotorSet:
    """The rotors of a recording.

    Attributes
    ----------
    rotors : dict of int to Rotor
        By channel.
    doubled : tuple of int
        Channels on which more than one station sends; they have no rotor.
    """

    rotors: dict[int, Rotor]
    doubled: tuple[int, ...]


def find_rotors(
    tick: Array,
    polynomial: NDArray[np.int32],
    index: NDArray[np.int64],
    evidence: Array,
    rate_hz: float,
) -> RotorSet:
    """Rotors that bursts agree on.

    Parameters
    ----------
    tick : (n,) ndarray
        When the first bit of each burst began, ascending, in ticks of the recorder.
    polynomial, index : (n,) ndarray
        As decoded; bursts with polynomial -1 are passed over.
    evidence : (n,) ndarray
        In bits (:class:`~locatk.core.lighthouse.demodulation.identification.SequenceMatches`).
    rate_hz : float
        Ticks of the recorder a second.
    """
    rotors: dict[int, Rotor] = {}
    doubled = []
    votes = (polynomial >= 0) & (evidence >= SEED)
    channel = np.where(votes, channel_of(polynomial), 0)
    for number in CHANNELS:
        mine = np.flatnonzero(channel == number)
        if len(mine) < LEAST_BURSTS:
            continue
        period = _period(number, tick[mine], index[mine], rate_hz)
        # Right ones ascend in time; wrong ones are anywhere.
        start = zeros(tick[mine], index[mine], number, period)
        order = np.argsort(start, kind="stable")
        stretches, second = _apart(_stretches(start[order], period, rate_hz))
        if not stretches:
            continue
        if second > SECOND_SHARE * sum(map(len, stretches)):
            doubled.append(number)
            continue
        mine = mine[order]
        parts = [mine[rows] for rows in stretches]
        rotors[number] = _followed(number, tick, index, parts, period, rate_hz)
    return RotorSet(rotors, tuple(doubled))


def zeros(tick: Array, index: NDArray[np.int64], channel: int, period: float) -> Array:
    """When the rotor was at its zero, by each burst, in ticks of the recorder.

    The station counts bits and rotations by one clock: ``index`` lasts as much longer than
    nominal as the rotation does.
    """
    return tick - index * (period * TICKS_PER_COUNT / float(period_ticks(channel)))


def _period(channel: int, tick: Array, index: NDArray[np.int64], rate_hz: float) -> float:
    """The period on which most pairs of bursts agree, by ever longer baselines."""
    nominal = period = float(period_ticks(channel)) / TICK_HZ * rate_hz
    for rotations in BASELINES:
        start = np.sort(zeros(tick, index, channel, period))
        far = np.searchsorted(start, start + (rotations + 0.5) * period) - 1
        step = start[far] - start
        turns = np.rint(step / period)
        some = turns > 0
        each = step[some] / turns[some]
        each = each[np.abs(each - nominal) < CLOCKS_PPM * 1e-6 * nominal]
        if len(each):
            period = _densest(each, 2 * LINK_S * rate_hz / rotations)
    return period


def _densest(values: Array, width: float) -> float:
    """Median in the interval of a given width that holds most values."""
    ordered = np.sort(values)
    number = np.searchsorted(ordered, ordered + width, side="right") - np.arange(len(ordered))
    at = int(np.argmax(number))
    return float(np.median(ordered[at : at + number[at]]))


def _stretches(start: Array, period: float, rate_hz: float) -> list[NDArray[np.int64]]:
    """Rows of zeros (n,), ascending in time, that link one to the next by whole rotations; each
    ascending, those with most rows first."""
    pairs = [np.zeros((2, 0), np.int64)]
    for ahead in range(1, min(NEIGHBOURS, len(start) - 1) + 1):
        step = start[ahead:] - start[:-ahead]
        off = np.abs(step - np.rint(step / period) * period)
        near = off < LINK_S * rate_hz + LINK_PPM * 1e-6 * step
        row = np.flatnonzero(near & (step < (SILENCE + 0.5) * period))
        pairs.append(np.stack([row, row + ahead]))
    link = np.concatenate(pairs, axis=1)
    graph = coo_array((np.ones(link.shape[1]), (link[0], link[1])), (len(start), len(start)))
    _, of = connected_components(graph, directed=False)
    order = np.argsort(of, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(of[order])) + 1)
    return sorted((rows for rows in parts if len(rows) >= LEAST_BURSTS), key=len, reverse=True)


def _apart(stretches: list[NDArray[np.int64]]) -> tuple[list[NDArray[np.int64]], int]:
    """Stretches, ascending, of which no two are at the same time, the long ones first taken; and
    the number of rows in the others."""
    taken: list[NDArray[np.int64]] = []
    others = 0
    for rows in stretches:
        at = bisect_left(taken, rows[0], key=lambda each: int(each[0]))
        before = at == 0 or taken[at - 1][-1] < rows[0]
        if before and (at == len(taken) or rows[-1] < taken[at][0]):
            taken.insert(at, rows)
        else:
            others += len(rows)
    return taken, others


def _followed(
    channel: int,
    tick: Array,
    index: NDArray[np.int64],
    stretches: list[NDArray[np.int64]],
    period: float,
    rate_hz: float,
) -> Rotor:
    """The rotor whose bursts the rows of ``stretches`` are."""
    # One slope for all: a stretch may begin at any phase.
    for _ in range(2):
        above = below = 0.0
        for rows in stretches:
            turns, late = _late(zeros(tick[rows], index[rows], channel, period), period)
            turns -= turns.mean()
            above, below = above + float(turns @ late), below + float(turns @ turns)
        if below > 0:
            period += above / below
    zero = float(zeros(tick[stretches[0][:1]], index[stretches[0][:1]], channel, period)[0])
    knots: list[Array] = []
    wander: list[Array] = []
    off: list[Array] = []
    restarts = 0
    for rows in stretches:
        start = zeros(tick[rows], index[rows], channel, period)
        shift = start[0] - zero
        late = shift - np.rint(shift / period) * period + _late(start, period)[1]
        times, curve = _smooth(start, late, float(start[-1] + period), rate_hz)
        off.append(late - np.interp(start, times, curve))
        if knots:
            jump = curve[0] - wander[-1][-1]
            jump -= np.rint(jump / period) * period
            slack = RESTART_S * rate_hz + LINK_PPM * 1e-6 * (times[0] - knots[-1][-1])
            restarts += int(abs(jump) > slack)
        knots.append(times)
        wander.append(curve)
    far = np.concatenate(off)
    near = far[np.abs(far) < AGREE_S * rate_hz]
    return Rotor(
        channel,
        period,
        zero,
        np.maximum.accumulate(np.concatenate(knots)),
        np.concatenate(wander),
        bursts=len(near),
        restarts=restarts,
        sigma=float(np.sqrt(np.sum(near**2) / max(1, len(near)))),
    )


def _late(start: Array, period: float) -> tuple[Array, Array]:
    """Rotation of each zero of a stretch from its first one, and by how much it is later than
    a constant rotor says."""
    turns = np.cumsum(np.rint(np.diff(start, prepend=start[0]) / period))
    return turns, start - start[0] - turns * period


def _smooth(tick: Array, late: Array, last: float, rate_hz: float) -> tuple[Array, Array]:
    """Knots of a smooth curve through ``late``, to the end of the last rotation: least squares
    with a penalty on bends.

    Robust by Huber's weights, so that a wrong burst within reach does not pull.
    """
    span = KNOT_S * rate_hz
    first = float(tick[0])
    count = int(np.ceil((last - first) / span)) + 2
    knots = first + span * np.arange(count)
    place = (tick - first) / span
    left = np.minimum(place.astype(np.int64), count - 2)
    share = place - left
    wander = np.zeros(count)
    weight = np.ones(len(tick))
    for _ in range(4):
        band = np.zeros((3, count))
        right = np.zeros(count)
        np.add.at(band[2], left, weight * (1 - share) ** 2)
        np.add.at(band[2], left + 1, weight * share**2)
        np.add.at(band[1], left + 1, weight * share * (1 - share))
        np.add.at(right, left, weight * (1 - share) * late)
        np.add.at(right, left + 1, weight * share * late)
        _bend_penalty(band, STIFFNESS * max(1.0, len(tick) / count))
        wander = solveh_banded(band, right)
        off = late - np.interp(tick, knots, wander)
        scale = 1.4826 * float(np.median(np.abs(off))) + 1e-3
        weight = np.minimum(1.0, 2 * scale / np.maximum(np.abs(off), 1e-12))
    # Beyond, something else may follow.
    end = np.interp(last, knots, wander)
    inside = knots < last
    return np.append(knots[inside], last), np.append(wander[inside], end)


def _bend_penalty(band: Array, stiffness: float) -> None:
    """Add ``stiffness`` times the squared second differences to upper bands (3, k); with fewer
    than three knots, or no data at some, a little weight holds them at zero."""
    count = band.shape[1]
    band[2] += 1e-9 * (band[2].max() + 1.0)
    if count < 3:
        return
    middle = np.arange(1, count - 1)
    np.add.at(band[2], middle - 1, stiffness)
    np.add.at(band[2], middle, 4 * stiffness)
    np.add.at(band[2], middle + 1, stiffness)
    np.add.at(band[1], middle, -2 * stiffness)
    np.add.at(band[1], middle + 1, -2 * stiffness)
    np.add.at(band[0], middle + 1, stiffness)
