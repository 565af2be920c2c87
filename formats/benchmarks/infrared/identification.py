"""Is the polynomial right, and the place, for every window that a station can send?"""

from __future__ import annotations

import numpy as np

from locatk.core.lighthouse import lfsr
from locatk.core.lighthouse.channels import POLYNOMIAL_COUNT
from locatk.core.lighthouse.demodulation.identification import (
    MIN_STANDALONE_EVIDENCE_BITS,
    SequenceMatches,
    identify_sequences,
)
from locatk.core.lighthouse.demodulation.soft_bits import MAX_SOFT_BIT, SoftBits
from locatk.formats.benchmarks import Figure
from locatk.formats.benchmarks.timing import SEED

BITS = 60
"""Of a window: as many as the peers look at."""

NOISE = 100_000
NOISE_BITS = 150


def figures() -> list[Figure]:
    """No data is needed."""
    wrong = sum(wrong_places(polynomial) for polynomial in range(POLYNOMIAL_COUNT))
    return [
        Figure("windows of 60 clean bits told wrong", float(wrong), "windows",
               f"of {POLYNOMIAL_COUNT * lfsr.SEQUENCE_LENGTH:,}: every place of all "
               f"{POLYNOMIAL_COUNT} sequences; the peer tells 7 of the 21 polynomials wrong that "
               "its own test tries", 0.0),
        Figure("noise taken for a station", 100 * noise_share(), "%",
               f"{NOISE:,} bursts of {NOISE_BITS} random bits, each by its own evidence", 0.05),
    ]  # fmt: skip


def wrong_places(polynomial: int) -> int:
    """Windows of one sequence whose polynomial or place is told wrong."""
    return int(np.count_nonzero(~_right(polynomial)))


def _right(polynomial: int) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    index = np.arange(lfsr.SEQUENCE_LENGTH)
    words = lfsr.bits_at(index, polynomial, BITS)
    shift = np.arange(BITS - 1, -1, -1, dtype=np.uint64)
    ones = (words[:, None] >> shift & np.uint64(1)).astype(np.int8)
    found: SequenceMatches = identify_sequences(_sure(ones))
    return np.asarray(
        found.is_certain() & (found.polynomial == polynomial) & (found.index == index)
    )


def noise_share() -> float:
    """Share of bursts of random bits that reach the evidence of a station's."""
    rng = np.random.default_rng(SEED)
    sign = rng.integers(0, 2, (NOISE, NOISE_BITS))
    size = rng.integers(0, MAX_SOFT_BIT + 1, (NOISE, NOISE_BITS))
    value = np.where(sign > 0, size, -size).astype(np.int8)
    return float(np.mean(identify_sequences(_rows(value)).is_certain(MIN_STANDALONE_EVIDENCE_BITS)))


def _sure(ones: np.ndarray[tuple[int, ...], np.dtype[np.int8]]) -> SoftBits:
    return _rows(np.where(ones > 0, MAX_SOFT_BIT, -MAX_SOFT_BIT).astype(np.int8))


def _rows(value: np.ndarray[tuple[int, ...], np.dtype[np.int8]]) -> SoftBits:
    n, bits = value.shape
    return SoftBits(value.ravel(), np.arange(n + 1) * bits, np.zeros(n), 1.0)
