"""Rivals of a decoded window: the same dots at another position of another codec.

The codecs differ in one of their four secondary sequences only, and these have long strings in
common. A window of such a string has a position in each codec, and its dots alone do not reveal
which one was printed. (Of all windows of 8 x 8 dots of ``libdots``, 12 % are windows of ``anoto``
elsewhere.)
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.codec import (
    CODEC_NAMES,
    MAIN_SEQUENCE_LENGTH,
    SECTION_LENGTH,
    Codec,
    codec,
)
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


class CoreLines(NamedTuple):
    """Lines of n windows whose dots determine their phases, of columns and rows (n, 2) as printed.

    Attributes
    ----------
    first, lines : (n, 2) int64 ndarray
        The first one, and the number of lines up to the last one.
    needed : (n, 2) int64 ndarray
        Number of lines that a rival explains.
    """

    first: Integers
    lines: Integers
    needed: Integers


def core_lines(has_dot: NDArray[np.bool_], rotation: Integers, wrong: Integers) -> CoreLines:
    """Return the core lines of square windows (n, length, length), as observed.

    ``wrong`` (n,) is the number of wrong bits of each window.
    """
    length = has_dot.shape[1]
    dots = np.stack([has_dot.sum(axis=1), has_dot.sum(axis=2)], axis=1)
    is_core = dots >= BITS_PER_STRING
    count = is_core.sum(axis=2)
    first = is_core.argmax(axis=2)
    last = np.where(count > 0, length - 1 - is_core[:, :, ::-1].argmax(axis=2), 0)
    dots_per_line = np.maximum((dots * is_core).sum(axis=2) // np.maximum(count, 1), 1)
    hidden = -(-DOTS_PER_WRONG_BIT * wrong[:, None] // dots_per_line)
    lines = last - first + 1
    # A quarter turn makes columns of rows, and one of both axes is reversed.
    is_reversed = np.array([[0, 0], [0, 1], [1, 1], [1, 0]], np.bool_)[rotation]
    first = np.where(is_reversed, length - 1 - last, first)
    result = np.stack([first, lines, np.maximum(count - hidden, 1)])
    quarter = rotation % 2 > 0
    result[:, quarter] = result[:, quarter, ::-1]
    return CoreLines(*result)


def has_rivals(core: CoreLines, position: Integers, own: Codec) -> NDArray[np.bool_]:
    """Return which other codecs (n, others) may have windows at ``position`` (n, 2) elsewhere.

    They explain enough core lines of both axes, and those of one of them at another position.
    """
    residue = (position + core.first) % len(own.digits[-1])
    pairs = zip(core.lines.ravel().tolist(), residue.ravel().tolist(), strict=True)
    common = np.array([_common_lines(own, count)[k] for count, k in pairs])
    common = common.reshape(*residue.shape, -1, 2)
    is_explained = common >= core.needed[..., None, None]
    return np.logical_and(is_explained[..., 0].all(axis=1), is_explained[..., 1].any(axis=1))


def rival_likelihood(
    lines: Bits, position: Integers, shift: Integers, core: CoreLines, codecs: tuple[Codec, Codec]
) -> NDArray[np.float64]:
    """Return how likely another codec at other positions is, relative to the decoded ones (n,).

    Parameters
    ----------
    lines : (n, 2, length, length) float32 ndarray
        Soft bits of the columns, and of the rows, as printed; 0 without a dot.
    position, shift : (n, 2) int64 ndarray
        Of the first column and row, and of the phases, as in
        :class:`~.phase_voting.WindowEstimates`.
    core : CoreLines
    codecs : pair of Codec
        The one in which the windows were decoded, and the other one.
    """
    own, other = codecs
    length = len(own.digits[-1])
    lines = lines.reshape(-1, *lines.shape[2:])
    position, shift, first, count, needed = (v.ravel() for v in (position, shift, *core))
    start = (position + first) % length
    counts = _difference_counts(own, other)
    common = counts[:, :, start + count] - counts[:, :, start]
    candidate, value, axis = np.nonzero(common >= needed)
    residues = np.empty((len(axis), 4), np.int64)
    for k, digits in enumerate(own.digits):
        residues[:, k] = position[axis] % len(digits)
    residues[:, 3] = (residues[:, 3] + candidate) % length
    positions = other.position(residues)
    # On a line that both explain they have the same phase.
    steps = np.arange(count.max())
    difference = _phase_differences(own, other)[candidate[:, None], start[axis, None] + steps]
    line = first[axis] + (difference == value[:, None]).argmax(axis=1)
    phase = own.phases((position[axis] + line) % SECTION_LENGTH) + shift[axis]
    shifts = (phase - other.phases((positions + line) % SECTION_LENGTH)) % MAIN_SEQUENCE_LENGTH
    rival_log_odds, _ = compare_with_pattern(positions, shifts, lines[axis], other)
    log_odds, _ = compare_with_pattern(position, shift, lines, own)
    ratio = np.exp(np.minimum(rival_log_odds - log_odds[axis], MAX_LOG_LIKELIHOOD_RATIO))
    same, every = (
        np.bincount(axis, weights, len(position)).reshape(-1, 2).prod(axis=1)
        for weights in (ratio * (candidate == 0), ratio)
    )
    result: NDArray[np.float64] = every - same
    return result


@functools.cache
def other_codecs(own: Codec) -> tuple[Codec, ...]:
    """Return the other known codecs."""
    return tuple(codec(name) for name in CODEC_NAMES if name != own.name)


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
def _common_lines(own: Codec, count: int) -> Integers:
    """Return how many of ``count`` lines from each residue (241, others, 2) on others explain.

    The first number is that of the best position of the other codec, the second that of the best
    one that is not the same position.
    """
    length = len(own.digits[-1])
    numbers = []
    for other in other_codecs(own):
        counts = _difference_counts(own, other)
        common = (counts[:, :, count : count + length] - counts[:, :, :length]).max(axis=1)
        numbers.append([common.max(axis=0), common[1:].max(axis=0)])
    return np.array(numbers, np.int64).transpose(2, 0, 1)
