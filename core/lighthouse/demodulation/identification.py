"""Identify the polynomial and the sequence index of each burst of soft bits.

Under the right polynomial each bit follows from the 17 before it. For each of the 32 polynomials,
the longest run of bits that follow from their predecessors is searched. If it is long enough, the
index of its first 17 bits is looked up (:mod:`~locatk.core.lighthouse.lfsr`), which gives the index
of the first bit of the burst. This hypothesis is then compared with the whole burst, bit by bit. A
match or a mismatch adds positive or negative evidence according to the reliability of the bit, in
bits (log2 of a likelihood ratio). The stretch of the burst with the highest sum is used, so that
noise at its ends has no effect (as local sequence alignments are scored; Karlin and Altschul,
Proc. Natl. Acad. Sci. 87, 1990).

A polynomial and an index are one of 2^22 hypotheses, and a burst has many stretches. Noise
therefore reaches evidence of S bits with a probability of about 2^(27 - S) per burst
(:func:`false_match_probability`; a test compares it with random bits). The number of tolerated
mismatches grows with the number of known bits.

Windows that were sampled at a fixed rate, as by the SPI of a microcontroller, are identified one
by one (:func:`read_windows`). If their times were recorded,
:mod:`~locatk.core.lighthouse.demodulation.rotor` finds the rotors that they agree on.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from locatk.core.kernels import kernels
from locatk.core.lighthouse import lfsr
from locatk.core.lighthouse.channels import POLYNOMIAL_COUNT
from locatk.core.lighthouse.demodulation.soft_bits import (
    MAX_SOFT_BIT,
    SoftBits,
    demodulate_bursts,
    split_windows,
)

Array = NDArray[np.float64]

MAX_UNKNOWN_SOFT_BIT = 3
"""A soft bit of at most this absolute value is unknown: it ends a run, and counts neither as a
match nor as a mismatch."""

MIN_PREDICTED_BITS = 8
"""Successive bits that must follow from the 17 before them for a polynomial to be considered. In
noise one polynomial in eight has such a run."""

EVIDENCE_STEPS_PER_BIT = 32
"""Steps in which a bit of evidence is counted. Integers make sums exact."""

MAX_LOG_ODDS = 4.0
"""Natural logarithm of the odds of a soft bit of the largest value: one bit in 55 is wrong."""

HYPOTHESES_BITS = 27
"""Number of polynomials, indices and stretches that noise can match, as a power of two."""

MIN_STANDALONE_EVIDENCE_BITS = 40.0
"""Evidence from which a burst is accepted without a rotor: one in 8,000 bursts of noise."""

MAX_ERROR_FRACTION = 0.2
"""Largest fraction of mismatches among the known bits of the stretch that agrees."""

EARLY_EXIT_EVIDENCE_BITS = 45.0
"""Evidence beyond which the compiled implementation tries no other hypothesis, provided that the
rest of the burst is too short for one with more evidence."""

BURSTS_PER_CHUNK = 512
"""Bursts that the numpy implementation processes together."""

WINDOWS_PER_BLOCK = 2048
"""Windows that are processed together, so that the working memory fits into the cache."""

_LOG_ODDS = np.arange(MAX_SOFT_BIT + 1) / MAX_SOFT_BIT * MAX_LOG_ODDS
MATCH_EVIDENCE = np.rint(EVIDENCE_STEPS_PER_BIT * np.log2(2 / (1 + np.exp(-_LOG_ODDS)))).astype(
    np.int32
)
"""Evidence (65,) of a soft bit of each absolute value that matches, in steps."""

MISMATCH_EVIDENCE = np.rint(EVIDENCE_STEPS_PER_BIT * np.log2(2 / (1 + np.exp(_LOG_ODDS)))).astype(
    np.int32
)
"""Evidence (65,) of a soft bit of each absolute value that does not match, in steps."""


@dataclass(frozen=True)
class SequenceMatches:
    """Best hypothesis for each burst.

    Attributes
    ----------
    polynomial : (n,) int32 ndarray
        0 to 31; -1 if there is no evidence for any.
    index : (n,) int64 ndarray
        Index of the burst's first bit in the sequence; -1 without a polynomial.
    evidence_bits : (n,) float64 ndarray
        Evidence for the hypothesis. :data:`MIN_STANDALONE_EVIDENCE_BITS` suffices on its own.
    begin, end : (n,) int32 ndarray
        Range of bits that agrees.
    known_bits, wrong_bits : (n,) int32 ndarray
        Number of bits in that range that are not unknown, and of those that do not match.
    """

    polynomial: NDArray[np.int32]
    index: NDArray[np.int64]
    evidence_bits: Array
    begin: NDArray[np.int32]
    end: NDArray[np.int32]
    known_bits: NDArray[np.int32]
    wrong_bits: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.polynomial)

    @property
    def is_consistent(self) -> NDArray[np.bool_]:
        """Mask (n,) of the bursts with few mismatches for their number of known bits."""
        return np.asarray(
            (self.polynomial >= 0) & (self.wrong_bits <= MAX_ERROR_FRACTION * self.known_bits)
        )

    def is_certain(
        self, min_evidence_bits: float = MIN_STANDALONE_EVIDENCE_BITS
    ) -> NDArray[np.bool_]:
        """Return a mask (n,) of the consistent bursts with at least this evidence."""
        return self.is_consistent & (self.evidence_bits >= min_evidence_bits)


def false_match_probability(evidence_bits: float) -> float:
    """Return the probability that a burst of noise reaches this evidence by chance."""
    return float(min(1.0, 2.0 ** (HYPOTHESES_BITS - evidence_bits)))


# ---- all hypotheses


def identify_sequences(bits: SoftBits, polynomials: int = POLYNOMIAL_COUNT) -> SequenceMatches:
    """Find the best polynomial and index of each burst.

    Parameters
    ----------
    bits : SoftBits
    polynomials : int
        Try only the first ``polynomials``: 4 if the channels are known to be 1 and 2.

    Returns
    -------
    SequenceMatches
    """
    if kernels is None:
        return identify_sequences_numpy(bits, polynomials)
    states, index = lfsr.tables()
    table = _empty_table(len(bits))
    kernels.light_places(
        np.ascontiguousarray(bits.value, np.int8),
        np.ascontiguousarray(bits.first, np.int64),
        states,
        index,
        lfsr.TAPS.astype(np.int32),
        polynomials,
        MATCH_EVIDENCE,
        MISMATCH_EVIDENCE,
        MAX_UNKNOWN_SOFT_BIT,
        MIN_PREDICTED_BITS,
        EVIDENCE_STEPS_PER_BIT,
        int(EARLY_EXIT_EVIDENCE_BITS * EVIDENCE_STEPS_PER_BIT),
        table,
    )
    return _matches_of_table(table)


def identify_sequences_numpy(
    bits: SoftBits, polynomials: int = POLYNOMIAL_COUNT
) -> SequenceMatches:
    """Find the best polynomial and index; numpy implementation of :func:`identify_sequences`."""
    table = _empty_table(len(bits))
    for rows in _chunks_by_length(bits, lfsr.REGISTER_BITS + MIN_PREDICTED_BITS):
        value, size = _padded_rows(bits, rows), np.diff(bits.first)[rows]
        table[rows] = _best_hypotheses(value, size, polynomials)
    return _matches_of_table(table)


# ---- expected hypotheses


def match_expected(
    bits: SoftBits, polynomial: NDArray[np.int32], index: NDArray[np.int64], radius_bits: int
) -> SequenceMatches:
    """Find the best match of each burst in the neighbourhood of expected indices.

    Parameters
    ----------
    bits : SoftBits
    polynomial, index : (n, h) ndarray
        Hypotheses for each burst: polynomial, and expected index of the burst's first bit.
    radius_bits : int
        Indices up to this many bits before and after the expected one are tried.

    Returns
    -------
    SequenceMatches
    """
    if kernels is None:
        return match_expected_numpy(bits, polynomial, index, radius_bits)
    table = _empty_table(len(bits))
    kernels.light_expected(
        np.ascontiguousarray(bits.value, np.int8),
        np.ascontiguousarray(bits.first, np.int64),
        lfsr.tables()[0],
        np.ascontiguousarray(polynomial, np.int32),
        np.ascontiguousarray(index, np.int64),
        polynomial.shape[1],
        radius_bits,
        MATCH_EVIDENCE,
        MISMATCH_EVIDENCE,
        MAX_UNKNOWN_SOFT_BIT,
        table,
    )
    return _matches_of_table(table)


def match_expected_numpy(
    bits: SoftBits, polynomial: NDArray[np.int32], index: NDArray[np.int64], radius_bits: int
) -> SequenceMatches:
    """Find the best match near expected indices; numpy implementation of :func:`match_expected`."""
    table = _empty_table(len(bits))
    for rows in _chunks_by_length(bits, 1):
        value, size = _padded_rows(bits, rows), np.diff(bits.first)[rows]
        best = table[rows]
        for column in range(polynomial.shape[1]):
            for step in range(-radius_bits, radius_bits + 1):
                trial_index = np.mod(index[rows, column] + step, lfsr.SEQUENCE_LENGTH)
                trial = _score_hypotheses(value, size, polynomial[rows, column], trial_index)
                is_better = trial[:, 2] > best[:, 2]
                best[is_better] = trial[is_better]
        table[rows] = best
    return _matches_of_table(table)


# ---- both implementations fill a table with the columns of SequenceMatches; evidence is in steps


def _empty_table(n: int) -> NDArray[np.int32]:
    """Return a table (n, 7) of bursts without a match."""
    table = np.zeros((n, 7), np.int32)
    table[:, 0:2] = -1
    return table


def _matches_of_table(table: NDArray[np.int32]) -> SequenceMatches:
    """Convert a table (n, 7) to SequenceMatches."""
    polynomial, index, score, begin, end, known_bits, wrong_bits = table.T
    return SequenceMatches(
        polynomial.copy(),
        index.astype(np.int64),
        score / EVIDENCE_STEPS_PER_BIT,
        begin.copy(),
        end.copy(),
        known_bits.copy(),
        wrong_bits.copy(),
    )


def _chunks_by_length(bits: SoftBits, min_bits: int) -> Iterator[NDArray[np.int64]]:
    """Yield indices of bursts with at least ``min_bits`` bits, in chunks of similar length."""
    size = np.diff(bits.first)
    order = np.argsort(size, kind="stable")
    order = order[size[order] >= min_bits]
    for k in range(0, len(order), BURSTS_PER_CHUNK):
        yield order[k : k + BURSTS_PER_CHUNK]


def _padded_rows(bits: SoftBits, rows: NDArray[np.int64]) -> NDArray[np.int8]:
    """Return the soft bits of some bursts as rows of equal length, padded with zeros."""
    size = np.diff(bits.first)[rows]
    column = np.arange(size.max())
    source = np.minimum(bits.first[rows][:, None] + column, len(bits.value) - 1)
    return np.where(column < size[:, None], bits.value[source], 0).astype(np.int8)


def _best_hypotheses(
    value: NDArray[np.int8], size: NDArray[np.int64], polynomials: int
) -> NDArray[np.int32]:
    """Return the table of the best hypotheses; of equal ones the lower polynomial."""
    best = _empty_table(len(value))
    runs = value.shape[1] - lfsr.REGISTER_BITS
    is_one = (value > 0).astype(np.int32)
    is_known = np.abs(value.astype(np.int32)) > MAX_UNKNOWN_SOFT_BIT
    state = np.zeros((len(value), runs), np.int32)
    is_usable = is_known[:, lfsr.REGISTER_BITS :].copy()
    for k in range(lfsr.REGISTER_BITS):
        state = state << 1 | is_one[:, k : k + runs]
        is_usable &= is_known[:, k : k + runs]
    # State 0 follows from itself under all polynomials, and no station sends it.
    is_usable &= state != 0
    for polynomial in range(polynomials):
        parity = np.bitwise_count(state & lfsr.TAPS[polynomial]) & 1
        is_predicted = is_usable & (parity == is_one[:, lfsr.REGISTER_BITS :])
        start, length = _longest_run(is_predicted)
        rows = np.flatnonzero(length >= MIN_PREDICTED_BITS)
        if not len(rows):
            continue
        index = lfsr.indices(state[rows, start[rows]], polynomial) - start[rows]
        trial = _score_hypotheses(
            value[rows], size[rows], polynomial, np.mod(index, lfsr.SEQUENCE_LENGTH)
        )
        is_better = trial[:, 2] > best[rows, 2]
        best[rows[is_better]] = trial[is_better]
    return best


def _longest_run(mask: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return start and length (n,) of the longest run of True in each row, the first of equals."""
    column = np.arange(mask.shape[1])
    last_false = np.maximum.accumulate(np.where(mask, -1, column), axis=1)
    length = np.where(mask, column - last_false, 0)
    end = np.argmax(length, axis=1)
    longest = length[np.arange(len(mask)), end]
    return end - longest + 1, longest


def _score_hypotheses(
    value: NDArray[np.int8],
    size: NDArray[np.int64],
    polynomial: int | NDArray[np.int32],
    index: NDArray[np.int64],
) -> NDArray[np.int32]:
    """Return the table (n, 7) of one hypothesis per burst.

    Parameters
    ----------
    value : (n, k) int8 ndarray
        Soft bits, padded.
    size : (n,) int64 ndarray
        Number of bits of each burst.
    polynomial : int or (n,) int32 ndarray
        One for all bursts, or one each.
    index : (n,) int64 ndarray
        Of the first bit in the sequence.
    """
    width = value.shape[1]
    states = lfsr.state_at(index[:, None] + np.arange(width), np.reshape(polynomial, (-1, 1)))
    expected = states >> (lfsr.REGISTER_BITS - 1)
    strength = np.abs(value.astype(np.int32))
    is_match = (value > 0) == (expected > 0)
    gain = np.where(is_match, MATCH_EVIDENCE[strength], MISMATCH_EVIDENCE[strength])
    gain = np.where(np.arange(width) < size[:, None], gain, 0)
    # The stretch with the largest sum (Kadane): largest rise of the cumulative sum.
    total = np.concatenate([np.zeros((len(value), 1), np.int64), np.cumsum(gain, axis=1)], axis=1)
    rise = total - np.minimum.accumulate(total, axis=1)
    end = np.argmax(rise, axis=1)
    column = np.arange(width + 1)
    begin = np.argmin(np.where(column <= end[:, None], total, np.iinfo(np.int64).max), axis=1)
    is_inside = (column[:-1] >= begin[:, None]) & (column[:-1] < end[:, None])
    is_known = is_inside & (strength > MAX_UNKNOWN_SOFT_BIT)
    table = np.empty((len(value), 7), np.int32)
    table[:, 0], table[:, 1] = polynomial, index
    table[:, 2] = rise[np.arange(len(value)), end]
    table[:, 3], table[:, 4] = begin, end
    table[:, 5] = np.count_nonzero(is_known, axis=1)
    table[:, 6] = np.count_nonzero(is_known & ~is_match, axis=1)
    return table


# ---- windows


@dataclass(frozen=True)
class WindowMatches:
    """Identified windows of samples.

    Attributes
    ----------
    matches : SequenceMatches
        Polynomial, and index of the first bit, of each window.
    first_bit_sample : (n,) float64 ndarray
        Start of that bit, in samples from the start of its window. It may be negative, and is
        ``nan`` for a window without bits.
    """

    matches: SequenceMatches
    first_bit_sample: Array


def read_windows(
    windows: NDArray[np.uint8], rate_hz: float = 32e6, polynomials: int = POLYNOMIAL_COUNT
) -> WindowMatches:
    """Find the polynomial and the index of each window of samples.

    Parameters
    ----------
    windows : (n, w) uint8 ndarray
        One row per window, the first sample in the highest bit of the first byte. The paper's
        windows have 64 bytes at 32 MS/s (section III).
    rate_hz : float
        Samples per second, 24 million or more.
    polynomials : int
        Try only the first ``polynomials``.

    Raises
    ------
    InputError
        The rate is too low, or ``windows`` is not a 2D array of bytes.
    """
    parts, starts = [], []
    for k in range(0, max(len(windows), 1), WINDOWS_PER_BLOCK):
        bits = demodulate_bursts(split_windows(windows[k : k + WINDOWS_PER_BLOCK], rate_hz))
        parts.append(identify_sequences(bits, polynomials))
        start = bits.start_tick - 8 * windows.shape[1] * np.arange(len(bits))
        starts.append(np.where(np.diff(bits.first) > 0, start, np.nan))
    columns = (np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(SequenceMatches))
    return WindowMatches(SequenceMatches(*columns), np.concatenate(starts))
