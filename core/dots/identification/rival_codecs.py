"""Rivals of a decoded window: the same dots at another position of another codec.

The codecs differ in one of their four secondary sequences only, and these have long strings in
common. A window of such a string has a position in each codec, and its dots alone do not reveal
which one was printed. (Of all windows of 8 x 8 dots of ``libdots``, 12 % are windows of ``anoto``
elsewhere.)
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.codec import CODEC_NAMES, MAIN_SEQUENCE_LENGTH, SECTION_LENGTH, Codec, codec
from locatk.core.dots.codec.lookup import BITS_PER_STRING
from locatk.core.dots.codec.sequences import DIGIT_WEIGHTS
from locatk.core.dots.identification.phase_voting import (
    MAX_WINDOW_LINES,
    Bits,
    Integers,
    compare_with_pattern,
)

DOTS_PER_WRONG_BIT = 8
"""Dots of lines with another phase that one wrong bit may hide. Two strings of the main sequence
differ in at least a quarter of their bits (2 of 8, 4 of 16), and a rival that explains the dots
nearly as well turns half of these from wrong to right."""

PHASE_DIFFERENCES = MAIN_SEQUENCE_LENGTH // math.gcd(MAIN_SEQUENCE_LENGTH, DIGIT_WEIGHTS[-1])
"""Number of different phases of a line that differ by a multiple of the fourth digit's weight."""

MAX_LOG_LIKELIHOOD_RATIO = 50.0
"""Largest log likelihood of a rival relative to the decoded position; more has no effect."""


@dataclass(frozen=True)
class PrintedWindows:
    """Bits of n windows as printed, with their decoded positions.

    Attributes
    ----------
    lines : pair of (n, length, length) float32 ndarray
        Soft bits of the columns, and of the rows; 0 without a dot.
    position, shift : (n, 2) int64 ndarray
        Of the first column and row, and of the phases, as in
        :class:`~.phase_voting.WindowEstimates`.
    """

    lines: tuple[Bits, Bits]
    position: Integers
    shift: Integers


def rival_likelihood(windows: PrintedWindows, wrong: Integers, own: Codec) -> NDArray[np.float64]:
    """Return how likely other codecs at other positions are, relative to the decoded ones (n,).

    It is the mean over the other known codecs, so that its product with the prior odds that the
    sheet is one of these are the posterior odds against the decoded position. ``wrong`` (n,) is
    the number of wrong bits of each window.
    """
    result = np.zeros(len(wrong))
    first, count, needed = np.stack([_core_lines(lines, wrong) for lines in windows.lines], axis=2)
    residue = (windows.position + first) % len(own.digits[-1])
    others = [codec(name) for name in CODEC_NAMES if name != own.name]
    for other in others:
        anywhere, elsewhere = np.zeros_like(count), np.zeros_like(count)
        for lines in np.unique(count):
            chosen = count == lines
            tables = _common_lines(own, other, int(lines))
            anywhere[chosen], elsewhere[chosen] = (table[residue[chosen]] for table in tables)
        has_any, has_other = (anywhere >= needed).all(axis=1), (elsewhere >= needed).any(axis=1)
        for k in np.flatnonzero(has_any & has_other):
            same, every = np.transpose(
                [
                    _rival_likelihoods(
                        windows.lines[axis][k],
                        int(windows.position[k, axis]),
                        int(windows.shift[k, axis]),
                        CoreLines(*(int(v[k, axis]) for v in (first, count, needed))),
                        (own, other),
                    )
                    for axis in range(2)
                ]
            )
            result[k] += (every.prod() - same.prod()) / len(others)
    return result


class CoreLines(NamedTuple):
    """Lines whose dots determine their phases: first and number; and how many a rival explains."""

    first: int
    lines: int
    needed: int


def _core_lines(lines: Bits, wrong: Integers) -> Integers:
    """Return :class:`CoreLines` (3, n) of windows with ``wrong`` bits."""
    dots = np.count_nonzero(lines, axis=2)
    is_core = dots >= BITS_PER_STRING
    first = is_core.argmax(axis=1)
    count = np.where(
        is_core.any(axis=1), lines.shape[1] - is_core[:, ::-1].argmax(axis=1) - first, 1
    )
    dots_per_line = np.maximum(
        (dots * is_core).sum(axis=1) // np.maximum(is_core.sum(axis=1), 1), 1
    )
    missing = np.arange(lines.shape[1])
    missing = ((missing >= first[:, None]) & (missing < (first + count)[:, None]) & ~is_core).sum(
        axis=1
    )
    hidden = -(-DOTS_PER_WRONG_BIT * wrong // dots_per_line)
    return np.stack([first, count, np.maximum(count - missing - hidden, 1)])


def _rival_likelihoods(
    lines: Bits, position: int, shift: int, core: CoreLines, codecs: tuple[Codec, Codec]
) -> tuple[float, float]:
    """Return likelihoods of another codec on one axis, relative to that of the decoded position.

    The first is that of the same position, the second the sum over all positions that explain the
    needed number of core lines.
    """
    own, other = codecs
    length = len(own.digits[-1])
    start = (position + core.first) % length
    difference = _phase_differences(own, other)[:, start : start + core.lines]
    agrees = difference[:, None] == np.arange(PHASE_DIFFERENCES)[:, None]
    candidate, value = np.nonzero(agrees.sum(axis=2) >= core.needed)
    residues = np.empty((len(candidate), 4), np.int64)
    residues[:, :3] = [position % len(digits) for digits in own.digits[:3]]
    residues[:, 3] = (position + candidate) % length
    positions = other.position(residues)
    # On a line that both explain they have the same phase.
    line = core.first + agrees[candidate, value].argmax(axis=1)
    phase = own.phases((position + line) % SECTION_LENGTH) + shift
    shifts = (phase - other.phases((positions + line) % SECTION_LENGTH)) % MAIN_SEQUENCE_LENGTH
    repeated = np.broadcast_to(lines, (len(candidate), *lines.shape))
    rival_log_odds, _ = compare_with_pattern(positions, shifts, repeated, other)
    log_odds, _ = compare_with_pattern(np.array([position]), np.array([shift]), lines[None], own)
    likelihood = np.exp(np.minimum(rival_log_odds - log_odds, MAX_LOG_LIKELIHOOD_RATIO))
    return float(likelihood[candidate == 0].sum()), float(likelihood.sum())


@functools.lru_cache(8)
def _phase_differences(own: Codec, other: Codec) -> Integers:
    """Return the difference of the phases of two codecs (offset of their residues, residue).

    It is in steps of the weight of the fourth digit, up to a constant for each offset. Lines of
    equal difference can be explained by both codecs at once. Residues of the decoded position
    continue beyond the end of the sequence, as windows do.
    """
    length = len(own.digits[-1])
    index = np.arange(length + MAX_WINDOW_LINES)
    own_sum, other_sum = (
        np.concatenate([[0], np.cumsum(c.digits[-1][np.arange(3 * length) % length])])
        for c in (own, other)
    )
    result: Integers = (other_sum[np.add.outer(np.arange(length), index)] - own_sum[index]) % (
        PHASE_DIFFERENCES
    )
    return result


@functools.lru_cache(8)
def _difference_counts(own: Codec, other: Codec) -> NDArray[np.int16]:
    """Return how often each difference (offset, difference, residue) occurred before a residue."""
    difference = _phase_differences(own, other)[:, None]
    is_difference = difference == np.arange(PHASE_DIFFERENCES)[:, None]
    counts = np.cumsum(is_difference, axis=2, dtype=np.int16)
    return np.pad(counts, ((0, 0), (0, 0), (1, 0)))


@functools.lru_cache(256)
def _common_lines(own: Codec, other: Codec, count: int) -> tuple[Integers, Integers]:
    """Return how many of ``count`` lines from each residue (241,) on another codec explains.

    The first table is of the best position of the other codec, the second of the best one that is
    not the same position.
    """
    counts = _difference_counts(own, other)
    length = len(own.digits[-1])
    common = (counts[:, :, count : count + length] - counts[:, :, :length]).max(axis=1)
    return common.max(axis=0).astype(np.int64), common[1:].max(axis=0).astype(np.int64)
