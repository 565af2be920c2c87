"""Which station sent these bits, and at which turn of its rotor.

Under the right polynomial each bit follows from the 17 before it. So for each of the 32 the
longest run of bits is sought that follow one from the other; where there is a long one, its
first 17 bits tell, by one look-up, where they stand in the sequence (:mod:`~locatk.core.lighthouse.lfsr`), and so
where the first bit of the burst stands. That place is then held against the whole burst, bit
by bit: a match or a contradiction counts by how sure the bit is, in bits of evidence, and the
stretch of the burst that agrees best is taken, so that noise at its ends does not matter (as
local alignments are scored; Karlin and Altschul 1990).

A place and a polynomial are one of 2^22, and a burst has many stretches, so that evidence of
S bits is an accident with a probability of about 2^(27 - S) in a burst of noise
(:func:`false_rate`; a test holds it against random bits). The number of contradictions allowed
grows with the number of known bits.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.kernels import kernels
from locatk.core.lighthouse import lfsr
from locatk.core.lighthouse.channels import POLYNOMIALS
from locatk.core.lighthouse.demodulation.soft_bits import CERTAIN, SoftBits

UNKNOWN = 3
"""A soft bit up to this size is unknown: it ends a run, and is counted neither as right nor as
wrong."""

FOLLOW = 8
"""So many successive bits must follow from the 17 before them for a polynomial to be
considered: noise has as many under one in eight."""

STEPS = 32
"""Steps in which a bit of evidence is counted, so that sums are exact."""

STEEPNESS = 4.0
"""Odds of a soft bit at its largest are exp(4): a bit in 55 is wrong all the same."""

HYPOTHESES_BITS = 27
"""Polynomials, places and stretches that noise can agree with, as a power of two."""

ALONE = 40.0
"""Evidence in bits with which a burst stands on its own: one in 8,000 bursts of noise."""

ERROR_SHARE = 0.2
"""Contradictions allowed among the known bits of the stretch that agrees."""

FASTEST = 45.0
"""Evidence beyond which the compiled twin asks no other place, if the rest of the burst is too
short for one with more."""

CHUNK = 512

_LEVELS = np.arange(CERTAIN + 1) / CERTAIN * STEEPNESS
MATCH = np.rint(STEPS * np.log2(2 / (1 + np.exp(-_LEVELS)))).astype(np.int32)
MISS = np.rint(STEPS * np.log2(2 / (1 + np.exp(_LEVELS)))).astype(np.int32)
"""Evidence of a soft bit of each size that matches or contradicts."""


@dataclass(frozen=True)
class SequenceMatches:
    """The best explanation of each burst.

    Attributes
    ----------
    polynomial : (n,) int32 ndarray
        0 to 31; -1 where nothing speaks for any.
    index : (n,) int64 ndarray
        Of the burst's first bit in the sequence; -1 where there is no polynomial.
    evidence : (n,) float64 ndarray
        In bits; :data:`ALONE` is enough without knowing anything else.
    begin, end : (n,) int32 ndarray
        The stretch of bits that agrees.
    known, wrong : (n,) int32 ndarray
        Bits in that stretch that are not unknown, and those of them that contradict.
    """

    polynomial: NDArray[np.int32]
    index: NDArray[np.int64]
    evidence: NDArray[np.float64]
    begin: NDArray[np.int32]
    end: NDArray[np.int32]
    known: NDArray[np.int32]
    wrong: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.polynomial)

    @property
    def consistent(self) -> NDArray[np.bool_]:
        """(n,) which have few enough contradictions for their known bits."""
        return np.asarray((self.polynomial >= 0) & (self.wrong <= ERROR_SHARE * self.known))

    def certain(self, evidence: float = ALONE) -> NDArray[np.bool_]:
        """(n,) which are consistent and have at least so much evidence."""
        return self.consistent & (self.evidence >= evidence)


def false_rate(evidence: float) -> float:
    """Chance that a burst of noise reaches ``evidence`` in bits under any polynomial."""
    return float(min(1.0, 2.0 ** (HYPOTHESES_BITS - evidence)))


def identify_sequences(bits: SoftBits, polynomials: int = POLYNOMIALS) -> SequenceMatches:
    """Polynomial and place of each burst.

    Parameters
    ----------
    bits : SoftBits
    polynomials : int
        Only the first so many are tried: 4 where the channels are known to be 1 and 2.

    Returns
    -------
    SequenceMatches
    """
    if kernels is None:
        return identify_numpy(bits, polynomials)
    states, index = lfsr.tables()
    rows = np.zeros((len(bits), 7), np.int32)
    rows[:, 0:2] = -1
    kernels.light_places(
        np.ascontiguousarray(bits.value, np.int8),
        np.ascontiguousarray(bits.first, np.int64),
        states,
        index,
        lfsr.TAPS.astype(np.int32),
        polynomials,
        MATCH,
        MISS,
        UNKNOWN,
        FOLLOW,
        STEPS,
        int(FASTEST * STEPS),
        rows,
    )
    return _matches(rows)


def expect(
    bits: SoftBits, polynomial: NDArray[np.int32], index: NDArray[np.int64], reach: int
) -> SequenceMatches:
    """The best explanation of each burst near a place that is expected.

    Parameters
    ----------
    bits : SoftBits
    polynomial, index : (n, h) ndarray
        What each burst may be, and the place of its first bit.
    reach : int
        Bits before and after, at which it may stand as well.
    """
    if kernels is None:
        return expect_numpy(bits, polynomial, index, reach)
    rows = np.zeros((len(bits), 7), np.int32)
    rows[:, 0:2] = -1
    kernels.light_expected(
        np.ascontiguousarray(bits.value, np.int8),
        np.ascontiguousarray(bits.first, np.int64),
        lfsr.tables()[0],
        np.ascontiguousarray(polynomial, np.int32),
        np.ascontiguousarray(index, np.int64),
        polynomial.shape[1],
        reach,
        MATCH,
        MISS,
        UNKNOWN,
        rows,
    )
    return _matches(rows)


def expect_numpy(
    bits: SoftBits, polynomial: NDArray[np.int32], index: NDArray[np.int64], reach: int
) -> SequenceMatches:
    """The same in numpy; :func:`expect` where nothing is compiled."""
    rows = np.zeros((len(bits), 7), np.int32)
    rows[:, 0:2] = -1
    for chosen in _alike(bits, 1):
        value, size = _padded(bits, chosen), np.diff(bits.first)[chosen]
        best = rows[chosen]
        for column in range(polynomial.shape[1]):
            for step in range(-reach, reach + 1):
                place = np.mod(index[chosen, column] + step, lfsr.LENGTH)
                trial = _scored(value, size, polynomial[chosen, column], place)
                better = trial[:, 2] > best[:, 2]
                best[better] = trial[better]
        rows[chosen] = best
    return _matches(rows)


def _matches(rows: NDArray[np.int32]) -> SequenceMatches:
    polynomial, index, score, begin, end, known, wrong = rows.T
    return SequenceMatches(
        polynomial.copy(),
        index.astype(np.int64),
        score / STEPS,
        begin.copy(),
        end.copy(),
        known.copy(),
        wrong.copy(),
    )


def identify_numpy(bits: SoftBits, polynomials: int = POLYNOMIALS) -> SequenceMatches:
    """The same in numpy; :func:`identify_sequences` where nothing is compiled."""
    rows = np.zeros((len(bits), 7), np.int32)
    rows[:, 0:2] = -1
    for chosen in _alike(bits, lfsr.BITS + FOLLOW):
        value, size = _padded(bits, chosen), np.diff(bits.first)[chosen]
        rows[chosen] = _best(value, size, polynomials)
    return _matches(rows)


def _alike(bits: SoftBits, least: int) -> Iterator[NDArray[np.int64]]:
    """Bursts of at least so many bits, some at a time, those of a length together."""
    size = np.diff(bits.first)
    order = np.argsort(size, kind="stable")
    order = order[size[order] >= least]
    for k in range(0, len(order), CHUNK):
        yield order[k : k + CHUNK]


def _padded(bits: SoftBits, chosen: NDArray[np.int64]) -> NDArray[np.int8]:
    """Soft bits of the chosen bursts as rows, unknown beyond their ends."""
    size = np.diff(bits.first)[chosen]
    place = np.arange(size.max())
    at = np.minimum(bits.first[chosen][:, None] + place, len(bits.value) - 1)
    return np.where(place < size[:, None], bits.value[at], 0).astype(np.int8)


def _best(value: NDArray[np.int8], size: NDArray[np.int64], polynomials: int) -> NDArray[np.int32]:
    """Rows of the best place under any polynomial; of equals the lower polynomial."""
    best = np.zeros((len(value), 7), np.int32)
    best[:, 0:2] = -1
    runs = value.shape[1] - lfsr.BITS
    hard = (value > 0).astype(np.int32)
    sure = np.abs(value.astype(np.int32)) > UNKNOWN
    window = np.zeros((len(value), runs), np.int32)
    whole = sure[:, lfsr.BITS :].copy()
    for k in range(lfsr.BITS):
        window = window << 1 | hard[:, k : k + runs]
        whole &= sure[:, k : k + runs]
    # State 0 follows from itself under all polynomials, and is none of a station's.
    whole &= window != 0
    for polynomial in range(polynomials):
        parity = np.bitwise_count(window & lfsr.TAPS[polynomial]) & 1
        start, length = _longest_run(whole & (parity == hard[:, lfsr.BITS :]))
        some = np.flatnonzero(length >= FOLLOW)
        if not len(some):
            continue
        state = window[some, start[some]]
        place = np.mod(lfsr.indices(state, polynomial) - start[some], lfsr.LENGTH)
        rows = _scored(value[some], size[some], polynomial, place)
        better = rows[:, 2] > best[some, 2]
        best[some[better]] = rows[better]
    return best


def _longest_run(true: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Start and length (n,) of the longest run in each row (n, k), the first of equals."""
    column = np.arange(true.shape[1])
    head = np.maximum.accumulate(np.where(true, -1, column), axis=1)
    length = np.where(true, column - head, 0)
    end = np.argmax(length, axis=1)
    longest = length[np.arange(len(true)), end]
    return end - longest + 1, longest


def _scored(
    value: NDArray[np.int8],
    size: NDArray[np.int64],
    polynomial: int | NDArray[np.int32],
    place: NDArray[np.int64],
) -> NDArray[np.int32]:
    """Rows of a place (n,) each, under one polynomial or one each."""
    width = value.shape[1]
    states = lfsr.state_at(place[:, None] + np.arange(width), np.reshape(polynomial, (-1, 1)))
    expected = states >> (lfsr.BITS - 1)
    strength = np.abs(value.astype(np.int32))
    right = (value > 0) == (expected > 0)
    gain = np.where(right, MATCH[strength], MISS[strength])
    gain = np.where(np.arange(width) < size[:, None], gain, 0)
    total = np.concatenate([np.zeros((len(value), 1), np.int64), np.cumsum(gain, axis=1)], axis=1)
    height = total - np.minimum.accumulate(total, axis=1)
    end = np.argmax(height, axis=1)
    column = np.arange(width + 1)
    begin = np.argmin(np.where(column <= end[:, None], total, np.iinfo(np.int64).max), axis=1)
    inside = (column[:-1] >= begin[:, None]) & (column[:-1] < end[:, None])
    known = inside & (strength > UNKNOWN)
    rows = np.empty((len(value), 7), np.int32)
    rows[:, 0], rows[:, 1] = polynomial, place
    rows[:, 2] = height[np.arange(len(value)), end]
    rows[:, 3], rows[:, 4] = begin, end
    rows[:, 5] = np.count_nonzero(known, axis=1)
    rows[:, 6] = np.count_nonzero(known & ~right, axis=1)
    return rows
