"""From edges to soft bits: biphase mark at 6 Mbit/s, burst by burst.

A station changes its light at the border of every bit, and once more in the middle of a one
(facts/lighthouse.md 2.3): two chips a bit, at 12 MHz. Its crystal is right to some parts in a
million, so that within a burst the chips lie on a rigid grid of which only the phase is
unknown. Rising and falling edges are delayed differently by the receiver; each kind tells its
own phase, and their difference is taken out.

What a chip holds is the mean level over it, which a late or missing edge blunts and does not
turn over. A bit is a one where its chips differ. Borders change always, so that the chip
before tells of the first and the chip after of the second once more: where they disagree, the
bit is uncertain, and an uncertain bit counts little in what follows
(:mod:`.identify`). A run-length decoder, which the paper and its peers use, has to decide at
each run, and loses the rest of the burst with a run that it misread.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.kernels import kernels
from locatk.core.lighthouse.bursts import Bursts

Array = NDArray[np.float64]

BIT_HZ = 6e6
CHIP_HZ = 2 * BIT_HZ

CERTAIN = 64
"""Of a soft bit: what a clean one reaches."""

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
    # A burst has as many bits as it lasts, and one or two at its ends.
    longest = int(LONGEST_S * CHIP_HZ) + 4
    lasting = np.zeros(n)
    lasting[readable] = bursts.take(readable).duration_s
    first = np.zeros(n + 1, np.int64)
    value = np.empty(int(np.sum(lasting * BIT_HZ + 4)), np.int8)
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
    size = np.diff(bursts.first)
    readable = _readable(bursts)
    some = np.flatnonzero(readable)
    if not len(some):
        return SoftBits(np.zeros(0, np.int8), np.zeros(n + 1, np.int64), np.zeros(n), 2 * chip)
    kept = bursts if len(some) == n else bursts.take(readable)
    burst = np.repeat(np.arange(len(some)), size[some])
    origin = kept.start
    rising = (np.arange(len(kept.tick)) - kept.first[burst]) % 2 == 0
    rising = np.where(kept.rises[burst], rising, ~rising)
    time, phase = _aligned((kept.tick - origin[burst]).astype(float), burst, rising, chip)
    # The grid of chips, from one before the first edge to one after the last.
    # Edges lie on it, so that rounding is safe where floor and ceil would toss a coin.
    begin = np.rint((time[kept.first[:-1]] - phase) / chip) - 1
    count = np.rint((time[kept.first[1:] - 1] - phase) / chip) + 1 - begin
    count = count.astype(np.int64)
    offset = np.concatenate([[0], np.cumsum(count)])
    mean = _mean_levels(kept, time, rising, burst, phase + begin * chip, count, offset, chip)
    # Which chips pair to bits: borders of bits change always, their middles half of the time.
    change = np.abs(np.diff(mean))
    place = np.arange(len(change)) - np.repeat(offset[:-1], count)[: len(change)]
    inside = np.repeat(np.arange(len(count)), count)
    within = inside[1:] == inside[:-1]
    sums = [
        np.bincount(inside[:-1][m], change[m], len(count))
        for m in (within & (place % 2 == 1), within & (place % 2 == 0))
    ]
    odd = (sums[1] > sums[0]).astype(np.int64)
    bits = (count - odd) // 2
    first = np.concatenate([[0], np.cumsum(bits)])
    at = np.arange(first[-1]) - np.repeat(first[:-1], bits)
    left = np.repeat(offset[:-1] + odd, bits) + 2 * at
    a, b = mean[left], mean[left + 1]
    head, tail = at == 0, at == np.repeat(bits, bits) - 1
    a, b = (
        np.where(head, a, (a - np.where(head, 0.0, np.roll(b, 1))) / 2),
        np.where(tail, b, (b - np.where(tail, 0.0, np.roll(a, -1))) / 2),
    )
    value = np.rint(np.clip(-a * b, -1.0, 1.0) * CERTAIN).astype(np.int8)
    all_bits, tick = np.zeros(n, np.int64), np.zeros(n)
    all_bits[some] = bits
    tick[some] = origin + phase + (begin + odd) * chip
    return SoftBits(value, np.concatenate([[0], np.cumsum(all_bits)]), tick, 2 * chip)


def _aligned(
    time: Array, burst: NDArray[np.int64], rising: NDArray[np.bool_], chip: float
) -> tuple[Array, Array]:
    """Edges with the difference of both directions taken out, and the phase of each burst."""
    n = int(burst[-1]) + 1
    angle = 2 * np.pi / chip * time
    wave = [(np.cos(angle), np.sin(angle), chosen) for chosen in (rising, ~rising)]
    turn = [
        np.arctan2(
            np.bincount(burst[m], s[m], n),
            np.bincount(burst[m], c[m], n),
        )
        for c, s, m in wave
    ]
    skew = turn[0] - turn[1]
    skew -= 2 * np.pi * np.rint(skew / (2 * np.pi))
    skew *= chip / (2 * np.pi)
    time = time + np.where(rising, -0.5, 0.5) * skew[burst]
    time = _ascending(time, burst)
    return time, turn[0] * chip / (2 * np.pi) - 0.5 * skew


def _ascending(time: Array, burst: NDArray[np.int64]) -> Array:
    """A pulse shorter than the difference of the directions vanishes; none turns around."""
    far = 1.0 + np.ptp(time)
    ordered: Array = np.maximum.accumulate(time + burst * far) - burst * far
    return ordered


def _mean_levels(
    bursts: Bursts,
    time: Array,
    rising: NDArray[np.bool_],
    burst: NDArray[np.int64],
    begin: Array,
    count: NDArray[np.int64],
    offset: NDArray[np.int64],
    chip: float,
) -> Array:
    """Mean level over each chip, -1 to 1, of all bursts one after the other.

    The integral of the level is linear between edges; its difference over a chip is the mean.
    """
    level = np.where(rising, 1.0, -1.0)
    step = np.zeros(len(time))
    same = burst[1:] == burst[:-1]
    step[1:] = np.where(same, level[:-1] * np.diff(time), 0.0)
    total = np.cumsum(step)
    total -= total[bursts.first[burst]]
    row = np.repeat(np.arange(len(count)), count + 1)
    number = np.arange(len(row)) - (offset[:-1] + np.arange(len(count)))[row]
    border = begin[row] + number * chip
    # Edges of all bursts on one axis, far apart, for one search.
    far = (
        4 * chip + max(float(np.max(border)), float(np.max(time))) - min(0.0, float(np.min(border)))
    )
    before = np.searchsorted(time + burst * far, border + row * far, side="right") - 1
    outside = before < bursts.first[row]
    before = np.maximum(before, bursts.first[row])
    held = np.where(outside, -level[before], level[before])
    integral = total[before] + held * (border - time[before])
    mean: Array = np.delete(np.diff(integral), (offset[1:] + np.arange(len(count)))[:-1]) / chip
    return mean
