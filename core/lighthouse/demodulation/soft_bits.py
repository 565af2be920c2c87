"""From edges to soft bits: biphase mark at 6 Mbit/s, burst by burst.

A station changes its light at the border of every bit, and once more in the middle of a one
(facts/lighthouse.md 2.3): two chips a bit, at 12 MHz. Its crystal is right to some parts in a
million, so that within a burst the chips lie on a rigid grid of which only the phase is
unknown. Rising and falling edges are delayed differently by the receiver; each kind tells its
own phase, and their difference is taken out, be it as long as a chip.

What a chip holds is the mean level over it, which a late or missing edge blunts and does not
turn over. The level changes at each border of bits, from one chip to the next; where it changes
upward at both borders of a bit, or downward, it changed back between them: a one. The product
of both changes tells the bit and how sure it is, and an uncertain bit counts little in what
follows (:mod:`~locatk.core.lighthouse.demodulation.identification`). A run-length decoder, which the paper and its peers use, has to
decide at each run, and loses the rest of the burst with a run that it misread.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.kernels import kernels
from locatk.core.lighthouse.demodulation.bursts import Bursts

Array = NDArray[np.float64]

BIT_HZ = 6e6
CHIP_HZ = 2 * BIT_HZ

CERTAIN = 64
"""Of a soft bit: what a clean one reaches."""

TURN = 4096
"""Parts of a chip in which the phase of an edge is told, so that sums are exact."""

LONGEST_RUN = 3.0
"""In chips: a longer run counts as so long when both directions are compared."""

EVEN = 1e-3
"""Bits start at the second chip only where more than this speaks for it."""

LONGEST_S = 500e-6
"""Of a burst: a longer one is no sweep, which takes 10 to 60 us, and has no bits."""


@dataclass(frozen=True)
class SoftBits:
    """Bits of many bursts with how sure they are, one after the other.

    Attributes
    ----------
    value : (m,) int8 ndarray
        -64 (surely 0) to 64 (surely 1); 0 is unknown.
    first : (n + 1,) int64 ndarray
        Burst i has the values ``first[i]`` to ``first[i + 1]``.
    tick : (n,) float64 ndarray
        Start of the first bit, in ticks of the recorder.
    ticks_per_bit : float
        Nominal length of a bit, in ticks of the recorder.
    """

    value: NDArray[np.int8]
    first: NDArray[np.int64]
    tick: Array
    ticks_per_bit: float

    def __len__(self) -> int:
        return len(self.tick)


def soft_bits(bursts: Bursts) -> SoftBits:
    """Demodulate all bursts.

    Parameters
    ----------
    bursts : Bursts

    Returns
    -------
    SoftBits
        One row a burst; a burst of fewer than two edges, or one that is too long, has no bits.
    """
    if kernels is None:
        return soft_bits_numpy(bursts)
    return _compiled(bursts)


def _compiled(bursts: Bursts) -> SoftBits:
    assert kernels is not None
    n = len(bursts)
    ticks_per_chip = bursts.rate_hz / CHIP_HZ
    readable = _readable(bursts)
    longest = int(LONGEST_S * CHIP_HZ) + 4
    # A burst has as many bits as it lasts, and one or two at its ends.
    begin, end = bursts.first[:-1][readable], bursts.first[1:][readable] - 1
    lasting = np.sum(bursts.tick[end] - bursts.tick[begin]) / bursts.rate_hz
    first = np.zeros(n + 1, np.int64)
    value = np.empty(int(lasting * BIT_HZ) + 4 * len(begin), np.int8)
    tick = np.zeros(n)
    kernels.light_bits(
        np.ascontiguousarray(bursts.tick, np.int64),
        np.ascontiguousarray(bursts.first, np.int64),
        np.ascontiguousarray(bursts.rises, np.uint8),
        readable.astype(np.uint8),
        ticks_per_chip,
        longest,
        value,
        first,
        tick,
    )
    return SoftBits(value[: first[-1]], first, tick, 2 * ticks_per_chip)


def _readable(bursts: Bursts) -> NDArray[np.bool_]:
    """Which bursts (n,) can hold bits."""
    some = np.diff(bursts.first) > 1
    last = bursts.tick[np.maximum(bursts.first[1:] - 1, 0)[some]]
    some[some] = last - bursts.tick[bursts.first[:-1][some]] <= LONGEST_S * bursts.rate_hz
    return some


def soft_bits_numpy(bursts: Bursts) -> SoftBits:
    """The same in numpy; :func:`soft_bits` where nothing is compiled."""
    n = len(bursts)
    chip = bursts.rate_hz / CHIP_HZ
    some = np.flatnonzero(_readable(bursts))
    if not len(some):
        return SoftBits(np.zeros(0, np.int8), np.zeros(n + 1, np.int64), np.zeros(n), 2 * chip)
    kept = bursts.take(_readable(bursts))
    burst = np.repeat(np.arange(len(some)), np.diff(kept.first))
    time = (kept.tick - kept.start[burst]).astype(float) * (1 / chip)
    first_kind = (np.arange(len(time)) - kept.first[burst]) % 2 == 0
    begin, skew = _grid(time, burst, first_kind)
    time = time + np.where(first_kind, -0.5, 0.5) * skew[burst]
    time = _ascending(time, burst)
    count = _rounded(time[kept.first[1:] - 1] - begin).astype(np.int64) + 1
    rising = np.where(kept.rises[burst], first_kind, ~first_kind)
    mean, offset = _mean_levels(time - begin[burst], rising, burst, kept.rises, count)
    # Which chips pair to bits: borders of bits change always, their middles half of the time.
    change = np.abs(np.diff(mean))
    inside = np.repeat(np.arange(len(count)), count)
    place = np.arange(len(change)) - offset[inside[:-1]]
    within = inside[1:] == inside[:-1]
    of_middles, of_borders = (
        np.bincount(inside[:-1][m], change[m], len(count))
        for m in (within & (place % 2 == 0), within & (place % 2 == 1))
    )
    odd = (of_middles > of_borders + EVEN).astype(np.int64)
    bits = (count - odd) // 2
    first = np.concatenate([[0], np.cumsum(bits)])
    at = np.arange(first[-1]) - np.repeat(first[:-1], bits)
    left = np.repeat(offset + odd, bits) + 2 * at
    # The changes at both borders of a bit; at the ends of the burst twice its own chip.
    a, b = mean[left], mean[left + 1]
    before = np.where(at == 0, 2 * a, a - np.roll(b, 1))
    after = np.where(at == np.repeat(bits, bits) - 1, -2 * b, np.roll(a, -1) - b)
    value = np.rint(np.clip(before * after / 4, -1.0, 1.0) * CERTAIN).astype(np.int8)
    all_bits, tick = np.zeros(n, np.int64), np.zeros(n)
    all_bits[some] = bits
    tick[some] = kept.start + (begin + odd) * chip
    return SoftBits(value, np.concatenate([[0], np.cumsum(all_bits)]), tick, 2 * chip)


def _grid(
    time: Array, burst: NDArray[np.int64], first_kind: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Where the chips of each burst begin, one before its first edge, and by how much edges of
    the first edge's direction come later than the others; all in chips.

    Phases leave whole chips open, which the runs tell: what one direction is late shortens the
    runs that it begins and lengthens the others.
    """
    n = int(burst[-1]) + 1
    place = np.floor((time - np.floor(time)) * TURN + 0.5).astype(np.int64) % TURN
    wave = np.rint(np.sin(2 * np.pi / TURN * np.arange(TURN + TURN // 4)) * 2**14)
    phase = [
        np.arctan2(
            np.bincount(burst[m], wave[place[m]], n),
            np.bincount(burst[m], wave[place[m] + TURN // 4], n),
        )
        / (2 * np.pi)
        for m in (first_kind, ~first_kind)
    ]
    run = np.minimum(np.diff(time), LONGEST_RUN)
    whole = burst[1:] == burst[:-1]
    mean = []
    for m in (whole & first_kind[:-1], whole & ~first_kind[:-1]):
        number = np.bincount(burst[:-1][m], minlength=n)
        mean.append(np.bincount(burst[:-1][m], run[m], n) / np.maximum(number, 1))
    told = np.where(mean[1] > 0, np.clip((mean[1] - mean[0]) / 2, -0.5, 0.5), 0.0)
    skew = phase[0] - phase[1]
    skew -= _rounded(skew - told)
    return phase[0] - 0.5 * skew - 1, skew


def _rounded(value: Array) -> Array:
    """The nearest whole number. Halves, which sampled times often are, go up for sure."""
    whole: Array = np.floor(value + (0.5 + 1e-6))
    return whole


def _ascending(time: Array, burst: NDArray[np.int64]) -> Array:
    """A pulse shorter than the difference of the directions vanishes; none turns around."""
    far = 1.0 + np.ptp(time)
    ordered: Array = np.maximum.accumulate(time + burst * far) - burst * far
    return ordered


def _mean_levels(
    place: Array,
    rising: NDArray[np.bool_],
    burst: NDArray[np.int64],
    rises: NDArray[np.bool_],
    count: NDArray[np.int64],
) -> tuple[Array, NDArray[np.int64]]:
    """Mean level over each chip, -1 to 1, of all bursts one after the other, and the first chip
    of each.

    An edge changes the mean of its own chip by a part, and of all later ones whole.
    """
    offset = np.concatenate([[0], np.cumsum(count)])[:-1]
    chip = place.astype(np.int64)
    late = place - chip
    # Each burst has a chip more here, which takes what its last edge leaves for later.
    at = (offset + np.arange(len(count)))[burst] + chip
    jump = np.where(rising, 2.0, -2.0)
    total = len(count) + int(count.sum())
    change = np.bincount(at, jump * (1 - late), total) + np.bincount(at + 1, jump * late, total)
    spare = np.cumsum(count + 1) - 1
    level = np.cumsum(change)
    ends = np.concatenate([[0.0], level[spare[:-1]]])
    base = np.where(rises, -1.0, 1.0) - ends
    mean: Array = np.delete(level, spare) + np.repeat(base, count)
    return mean, offset
