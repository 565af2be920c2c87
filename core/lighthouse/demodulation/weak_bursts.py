"""Bursts too weak to be read: do they belong to the sweep that they lie in?

At the rim of a beam the receiver follows only the long runs, and late: what is left of the
sequence is its slow part, a quarter of a bit behind. Such a fragment does not say which
sequence it is. But the burst beside it does, and so what the fragment should look like; it is
compared with that, and with many other places of the same sequence, which it should not look
like.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse import lfsr
from locatk.core.lighthouse.demodulation.bursts import Bursts
from locatk.core.lighthouse.demodulation.identification import SequenceMatches
from locatk.core.lighthouse.demodulation.soft_bits import SoftBits

Array = NDArray[np.float64]

BESIDE_S = 100e-6
"""A sweep lasts no longer, with both rims of its beam."""

DELAY_BITS = 0.25
"""By which weak light is late (measured on the two captures that are not scored)."""

SAMPLES = 8
"""A bit, of the levels that are compared."""

DECOYS = 1000
"""Other places of the sequence, one bit apart."""

CHANCE = 0.005
"""Share of the decoys that may look as much like the fragment as its own place."""

LONGEST_BITS = 400


def match_fragments(
    bursts: Bursts, bits: SoftBits, matches: SequenceMatches, read: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """The burst beside each fragment whose sequence the fragment continues.

    Parameters
    ----------
    bursts, bits, matches
        Ascending in time, one row a burst.
    read : (n,) bool ndarray
        Which bursts were read; the others are the fragments.

    Returns
    -------
    (n,) int64 ndarray
        Row of the burst that was read; -1 for all that continue none, and for those that were
        read themselves.
    """
    of = np.full(len(bursts), -1, np.int64)
    known, fragments = np.flatnonzero(read), np.flatnonzero(~read)
    if not len(known) or not len(fragments):
        return of
    begin, start = bits.tick[known], bursts.start[fragments].astype(float)
    at = np.searchsorted(begin, start)
    sides = np.stack([np.maximum(at - 1, 0), np.minimum(at, len(known) - 1)])
    nearest = sides[np.argmin(np.abs(begin[sides] - start), axis=0), np.arange(len(start))]
    close = np.abs(begin[nearest] - start) <= BESIDE_S * bursts.rate_hz
    for row, mate in zip(fragments[close], known[nearest[close]], strict=True):
        bit = (bursts.start[row] - bits.tick[mate]) / bits.ticks_per_bit + matches.index[mate]
        if chance(bursts, row, int(matches.polynomial[mate]), float(bit)) <= CHANCE:
            of[row] = mate
    return of


def chance(bursts: Bursts, row: int, polynomial: int, bit: float) -> float:
    """Share of decoys that a burst resembles as much as the place where it should stand.

    Parameters
    ----------
    bursts : Bursts
    row : int
        Of the burst.
    polynomial : int
        0 to 31.
    bit : float
        Place in the sequence at the burst's first edge, if it were not late.
    """
    edge = bursts.tick[bursts.first[row] : bursts.first[row + 1]]
    ticks_per_sample = bursts.rate_hz / 6e6 / SAMPLES
    samples = min(LONGEST_BITS * SAMPLES, int(np.ceil((edge[-1] - edge[0]) / ticks_per_sample)))
    if samples < SAMPLES:
        return 1.0
    # Amid samples: a tick of 40 MHz often lies on their borders.
    time = edge[0] + (np.arange(samples) + 0.5) * ticks_per_sample
    rising = (np.searchsorted(edge, time, side="right") - 1) % 2 == (0 if bursts.rises[row] else 1)
    level = np.where(rising, 1.0, -1.0)
    level -= level.mean()
    # Its own place first, then decoys from a bit and more than ten bits away on both sides.
    bit -= DELAY_BITS
    whole, part = int(np.floor(bit)), bit - np.floor(bit)
    half = DECOYS // 2 + 10
    length = len(time) // SAMPLES + 2
    expected = _slow_level(polynomial, whole - half, 2 * half + length)
    skip = round(part * SAMPLES + 0.5)
    rows = np.lib.stride_tricks.sliding_window_view(expected[skip:], len(time))[::SAMPLES]
    likeness = np.abs(_correlation(rows, level))
    own = likeness[half]
    decoys = np.concatenate([likeness[: half - 10], likeness[half + 10 : 2 * half]])
    return float(np.mean(decoys >= own))


def _slow_level(polynomial: int, index: int, bits: int) -> Array:
    """What is left of the level of a sequence when runs shorter than a bit are lost."""
    ones = lfsr.state_at(index + np.arange(bits), polynomial) >> (lfsr.BITS - 1)
    turns = np.full(2 * bits, -1.0)
    turns[1::2] = np.where(ones > 0, -1.0, 1.0)
    level = np.repeat(np.cumprod(turns), SAMPLES // 2)
    slow: Array = np.convolve(level, np.full(SAMPLES, 1.0 / SAMPLES), "same")
    return slow


def _correlation(rows: Array, level: Array) -> Array:
    """Pearson's coefficient of each row with ``level``, whose mean is zero."""
    size = np.sqrt(np.maximum(rows.var(axis=1) * rows.shape[1], 1e-12))
    coefficient: Array = rows @ level / (size * max(1e-6, float(np.linalg.norm(level))))
    return coefficient
