"""The rotor of each station: its period, and its phase followed over time.

A decoded burst tells when the rotor was at its zero: its own time less the time that its
index takes. A station's rotor turns with a crystal's constancy, wanders by a microsecond in a
minute, and starts at another moment than any accident would name. So the bursts of a station
must agree on one period and one phase; those that do not were decoded wrong.

Two stations that send on one channel show as two phases. No light tells them apart for good,
so that all that is said of such a channel is that it happens.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

from locatk.core.lighthouse.channels import CHANNELS, TICK_HZ, channel_of, period_ticks

Array = NDArray[np.float64]

SEED = 28.0
"""Evidence in bits from which on a burst may vote for a rotor: an accident alone, but not
together."""

LEAST_BURSTS = 4
"""That agree make a rotor."""

CLOCKS_PPM = 200.0
"""Clocks of station and recorder together are off by at most this."""

AGREE_S = 2e-6
"""From the followed phase: a burst farther away was decoded wrong. Single bursts scatter by
0.13 us at 1 m and by 0.5 us at 4 m (Bitcraze's recordings)."""

LINE_REACH_S = (20e-6, 10e-6)
"""From a rotor of constant speed, in the steps in which it is found: its wander is heard."""

CURVE_REACH_S = (8e-6, 3e-6)
"""From the followed phase, in the steps in which it is found."""

LINK_S = 3e-6
"""Slack between two bursts of one rotor a few rotations apart."""

NEIGHBOURS = 8

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
        By how much the rotor's zero is later there than ``zero + k period``, in ticks.
    bursts : int
        That agree.
    sigma : float
        Standard deviation of one of them, in ticks.
    """

    channel: int
    period: float
    zero: float
    knots: Array
    wander: Array
    bursts: int
    sigma: float

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
class Found:
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
) -> Found:
    """Rotors that bursts agree on.

    Parameters
    ----------
    tick : (n,) ndarray
        When the first bit of each burst began, ascending, in ticks of the recorder.
    polynomial, index : (n,) ndarray
        As decoded; bursts with polynomial -1 are passed over.
    evidence : (n,) ndarray
        In bits (:class:`.identify.Matches`).
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
        rotor, agree = _follow(number, tick[mine], index[mine], rate_hz)
        if rotor is None:
            continue
        rest = mine[~agree]
        other, _ = _follow(number, tick[rest], index[rest], rate_hz)
        if other is not None and other.bursts > SECOND_SHARE * rotor.bursts:
            doubled.append(number)
        else:
            rotors[number] = rotor
    return Found(rotors, tuple(doubled))


def zeros(tick: Array, index: NDArray[np.int64], channel: int, period: float) -> Array:
    """When the rotor was at its zero, by each burst, in ticks of the recorder.

    The station counts bits and rotations by one clock: ``index`` lasts as much longer than
    nominal as the rotation does.
    """
    return tick - index * (period * 8 / float(period_ticks(channel)))


def _follow(
    channel: int, tick: Array, index: NDArray[np.int64], rate_hz: float
) -> tuple[Rotor | None, NDArray[np.bool_]]:
    """The rotor that most bursts agree on, and which those are."""
    none = np.zeros(len(tick), bool)
    period = float(period_ticks(channel)) / TICK_HZ * rate_hz
    linked = _linked(zeros(tick, index, channel, period), period, rate_hz)
    if np.count_nonzero(linked) < LEAST_BURSTS:
        return None, none
    line = _line(channel, tick[linked], index[linked], period, rate_hz)
    if line is None:
        return None, none
    period, zero = line
    for reach_s in LINE_REACH_S:
        start = zeros(tick, index, channel, period)
        rotation, late = _late(start, period, zero)
        near = np.abs(late) < reach_s * rate_hz
        if np.count_nonzero(near) < LEAST_BURSTS:
            return None, none
        if np.ptp(rotation[near]) == 0:
            return None, none
        slope, shift = np.polyfit(rotation[near], late[near], 1)
        period, zero = period + float(slope), zero + float(shift)
    start = zeros(tick, index, channel, period)
    _, late = _late(start, period, zero)
    knots, wander = np.zeros(1), np.zeros(1)
    for reach_s in CURVE_REACH_S:
        near = np.abs(late - np.interp(start, knots, wander)) < reach_s * rate_hz
        if np.count_nonzero(near) < LEAST_BURSTS:
            return None, none
        knots, wander = _smooth(start[near], late[near], rate_hz)
    off = late - np.interp(start, knots, wander)
    agree = np.abs(off) < AGREE_S * rate_hz
    number = int(np.count_nonzero(agree))
    if number < LEAST_BURSTS:
        return None, none
    sigma = float(np.sqrt(np.mean(off[agree] ** 2)))
    return Rotor(channel, period, zero, knots, wander, number, sigma), agree


def _late(start: Array, period: float, zero: float) -> tuple[Array, Array]:
    """Rotation of each zero, and by how much it is later than a constant rotor says."""
    rotation = np.rint((start - zero) / period)
    return rotation, start - zero - rotation * period


def _linked(start: Array, period: float, rate_hz: float) -> NDArray[np.bool_]:
    """Which zeros (n,), ascending in time, are whole rotations away from some near neighbour."""
    linked = np.zeros(len(start), bool)
    for ahead in range(1, min(NEIGHBOURS, len(start) - 1) + 1):
        step = start[ahead:] - start[:-ahead]
        off = np.abs(step - np.rint(step / period) * period)
        near = off < LINK_S * rate_hz + CLOCKS_PPM * 1e-6 * np.abs(step)
        # Accidents link over long silences, where the slack is no test any more.
        near &= np.abs(step) < 50 * period
        linked[ahead:] |= near
        linked[:-ahead] |= near
    return linked


def _line(
    channel: int, tick: Array, index: NDArray[np.int64], period: float, rate_hz: float
) -> tuple[float, float] | None:
    """Period and zero of the line through most zeros, by ever longer baselines."""
    nominal = period
    for _ in range(3):
        start = zeros(tick, index, channel, period)
        # From each burst to the farthest one to which rotations can be counted without doubt.
        reach = period / (8 * CLOCKS_PPM * 1e-6)
        far = np.searchsorted(start, start + reach, side="right") - 1
        far = np.clip(far, 0, len(start) - 1)
        step = start[far] - start
        rotations = np.rint(step / period)
        some = rotations > 0
        if not np.any(some):
            return None
        slope = np.median((step[some] - rotations[some] * period) / rotations[some])
        if abs(period + slope - nominal) > CLOCKS_PPM * 1e-6 * nominal:
            return None
        period += float(slope)
    start = zeros(tick, index, channel, period)
    phase = np.angle(np.exp(2j * np.pi * (start - start[0]) / period)) / (2 * np.pi) * period
    middle = _densest(phase, LINE_REACH_S[0] * rate_hz)
    return period, float(start[0] + middle)


def _densest(values: Array, width: float) -> float:
    """Middle of the interval of a given width that holds most values."""
    ordered = np.sort(values)
    number = np.searchsorted(ordered, ordered + width, side="right") - np.arange(len(ordered))
    at = int(np.argmax(number))
    return float(np.median(ordered[at : at + number[at]]))


def _smooth(tick: Array, late: Array, rate_hz: float) -> tuple[Array, Array]:
    """Knots of a smooth curve through ``late``: least squares with a penalty on bends.

    Robust by Huber's weights, so that a wrong burst within reach does not pull.
    """
    span = KNOT_S * rate_hz
    first, last = float(tick.min()), float(tick.max())
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
    return knots, wander


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
