"""A first reading of windows: the likeliest phases of columns and rows vote for a place.

Each dot gives the logarithm of how much likelier either of its bits is one than zero (0
where the dot is missing); each column and row is correlated with all 63 phases of the main
sequence; the differences of neighbouring phases vote, by how sure both are, for all places
of the four secondary sequences. Then the pattern at the winning place is compared with
every dot. :mod:`~locatk.core.dots.identification.decoding` says what to think of the result.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.codec import (
    MAIN_SEQUENCE,
    MAIN_SEQUENCE_LENGTH,
    SECTION_LENGTH,
    Codec,
    sequences,
)
from locatk.core.kernels import kernels

PLACES = math.log(4 * MAIN_SEQUENCE_LENGTH * SECTION_LENGTH)
"""Logarithm of the number of hypotheses an axis."""

LONGEST = 64
"""Most columns and rows of a window."""

SIGNS = 2.0 * MAIN_SEQUENCE.astype(np.float32) - 1.0


class Reading(NamedTuple):
    """A reading of n windows, x before y in each last axis of two.

    Attributes
    ----------
    rotation : (n,) int64 ndarray
    place, shift : (n, 2) int64 ndarray
        Of the printed corner, modulo :data:`SECTION_LENGTH`; of the phases, modulo 63.
    wrong : (n, 2) int64 ndarray
        Bits that differ from the pattern there.
    first, last : (n, 2) int64 ndarray
        Printed columns and rows in which dots are seen.
    odds : (n, 2) float64 ndarray
        Logarithm of the odds for the place against random bits.
    order : (n, 2) float64 ndarray
        The same against columns (or rows) of the main sequence in any order, as a sheet of
        another codec has them.
    lead : (n, 2) float64 ndarray
        Least votes, over the four sequences, by which the best residue is ahead.
    """

    rotation: NDArray[np.int64]
    place: NDArray[np.int64]
    shift: NDArray[np.int64]
    wrong: NDArray[np.int64]
    first: NDArray[np.int64]
    last: NDArray[np.int64]
    odds: NDArray[np.float64]
    order: NDArray[np.float64]
    lead: NDArray[np.float64]


def read(x_bits: NDArray[np.float32], y_bits: NDArray[np.float32], codec: Codec) -> Reading:
    """First reading of (n, length, length) windows: the likeliest phases vote."""
    if kernels is None:
        return read_numpy(x_bits, y_bits, codec)
    n, length, _ = x_bits.shape
    whole, odds = np.empty((n, 11), np.int64), np.empty((n, 6))
    kernels.read_windows(
        np.ascontiguousarray(x_bits),
        np.ascontiguousarray(y_bits),
        *(n, length),
        *kernel_tables(codec),
        *(SECTION_LENGTH, sequences.SMALLEST_SHIFT, PLACES),
        *(whole, odds),
    )
    place, shift, wrong, first, last = np.moveaxis(whole[:, 1:].reshape(n, 2, 5), 2, 0)
    evidence = np.moveaxis(odds.reshape(n, 3, 2), 1, 0)
    return Reading(whole[:, 0], place, shift, wrong, first, last, *evidence)


def read_numpy(x_bits: NDArray[np.float32], y_bits: NDArray[np.float32], codec: Codec) -> Reading:
    """First reading without the compiled kernel."""
    return read_turned(x_bits, y_bits, turns(x_bits, y_bits).argmax(axis=0), codec)


def turns(x_bits: NDArray[np.float32], y_bits: NDArray[np.float32]) -> NDArray[np.float32]:
    """(4, n) how well the main sequence fits at each rotation.

    Seen after a quarter turn what was rows reads as columns, forwards or, for one of both,
    backwards and inverted; no string of seven is in the sequence in both ways.
    """
    forwards, backwards = _templates(x_bits.shape[1])
    fits = [
        (bits @ template).max(axis=2).sum(axis=1)
        for bits in (x_bits.transpose(0, 2, 1), y_bits)
        for template in (forwards, backwards)
    ]
    return np.stack([fits[a] + fits[b] for a, b in ((0, 2), (2, 1), (1, 3), (3, 0))])


def read_turned(
    x_bits: NDArray[np.float32],
    y_bits: NDArray[np.float32],
    rotation: NDArray[np.int64],
    codec: Codec,
) -> Reading:
    """Reading at known rotations."""
    printed = turned(x_bits, y_bits, rotation)
    answers = []
    for bits in (printed[0].transpose(0, 2, 1), printed[1]):
        fits = scores(bits)
        place, shift, lead = vote(fits, codec)
        odds, wrong = compare(place, shift, bits, codec)
        order = in_order(place, shift, fits, codec)
        seen = (bits != 0).any(axis=2)
        first = np.where(seen.any(axis=1), seen.argmax(axis=1), seen.shape[1])
        last = np.where(seen.any(axis=1), seen.shape[1] - 1 - seen[:, ::-1].argmax(axis=1), -1)
        answers.append((place, shift, wrong, first, last, odds, order, lead))
    place, shift, wrong, first, last, odds, order, lead = (
        np.stack(pair, axis=1) for pair in zip(*answers, strict=True)
    )
    return Reading(rotation, place, shift, wrong, first, last, odds, order, lead)


@functools.lru_cache(8)
def _templates(length: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(length, 63) main sequence from each phase; read backwards and inverted likewise."""
    forwards = SIGNS[
        np.add.outer(np.arange(length), np.arange(MAIN_SEQUENCE_LENGTH)) % MAIN_SEQUENCE_LENGTH
    ]
    return forwards, np.ascontiguousarray(-forwards[::-1])


def scores(bits: NDArray[np.float32]) -> NDArray[np.float32]:
    """(n, length, 63) fit of each line to the main sequence from each phase on."""
    result: NDArray[np.float32] = bits @ _templates(bits.shape[2])[0]
    return result


def turned(
    x_bits: NDArray[np.float32], y_bits: NDArray[np.float32], rotation: NDArray[np.int64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Column and row bits as printed: turned back, dots' directions with them."""
    x, y = np.empty_like(x_bits), np.empty_like(y_bits)
    for turn in range(4):
        column, row = (y_bits, x_bits) if turn % 2 else (x_bits, y_bits)
        of = rotation == turn
        if of.any():
            # The column bit changes its sign on the second half turn, the row bit between.
            x[of] = np.rot90(column[of], -turn, (1, 2)) * (-1 if turn in (2, 3) else 1)
            y[of] = np.rot90(row[of], -turn, (1, 2)) * (-1 if turn in (1, 2) else 1)
    return x, y


def vote(
    scores: NDArray[np.float32], codec: Codec
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Place, shift of the phases and lead (n,) by the likeliest phase of each column."""
    n, length, _ = scores.shape
    phase = scores.argmax(axis=2)
    best_two = np.partition(scores, MAIN_SEQUENCE_LENGTH - 2, axis=2)[..., -2:]
    margin = best_two[..., 1] - best_two[..., 0]

    difference = (phase[:, 1:] - phase[:, :-1]) % MAIN_SEQUENCE_LENGTH
    weight = np.minimum(margin[:, 1:], margin[:, :-1])
    residues, lead = np.empty((n, 4), np.int64), np.full(n, np.inf)
    tables = zip(digit_tables(), ballot_tables(codec, length - 1), strict=True)
    for k, (digits, places) in enumerate(tables):
        votes = (digits[difference] * weight[..., None]).reshape(n, len(places)) @ places
        residues[:, k] = votes.argmax(axis=1)
        best_two = np.partition(votes, votes.shape[1] - 2, axis=1)[:, -2:]
        lead = np.minimum(lead, best_two[:, 1] - best_two[:, 0])
    place = codec.place(residues)
    shifts = (phase - phases_ahead(place, length, codec)) % MAIN_SEQUENCE_LENGTH
    ballots = np.bincount(
        (shifts + MAIN_SEQUENCE_LENGTH * np.arange(n)[:, None]).ravel(),
        margin.ravel(),
        MAIN_SEQUENCE_LENGTH * n,
    )
    return place, ballots.reshape(n, MAIN_SEQUENCE_LENGTH).argmax(axis=1), lead


def phases_ahead(place: NDArray[np.int64], length: int, codec: Codec) -> NDArray[np.int64]:
    """(..., length) phases of the lines from ``place`` on, around the range's end."""
    return codec.phases((place[..., None] + np.arange(length)) % SECTION_LENGTH)


def compare(
    place: NDArray[np.int64], shift: NDArray[np.int64], bits: NDArray[np.float32], codec: Codec
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Log odds (n,) that ``bits`` are those at ``place``, and how many of them are wrong."""
    n, length, _ = bits.shape
    phase = phases_ahead(place, length, codec) + shift[:, None]
    window, column, row = np.nonzero(bits)
    agreement = (
        bits[window, column, row] * SIGNS[(phase[window, column] + row) % MAIN_SEQUENCE_LENGTH]
    )
    gain = math.log(2) - np.log1p(np.exp(-agreement))
    odds = np.asarray(np.bincount(window, gain, n) - PLACES, np.float64)
    wrong = np.bincount(window[agreement < 0], minlength=n).astype(np.int64)
    return odds, wrong


def in_order(
    place: NDArray[np.int64],
    shift: NDArray[np.int64],
    fits: NDArray[np.float32],
    codec: Codec,
) -> NDArray[np.float64]:
    """Log odds (n,) of the lines at ``place`` against lines of the main sequence in any order.

    A line that is free takes one of its likely phases (those within a factor e of the best),
    of 63; one of the code has no choice, once the place is chosen. So a line of few dots,
    which fits many phases, says little. ``fits`` are :func:`scores`.
    """
    phase = (phases_ahead(place, fits.shape[1], codec) + shift[:, None]) % MAIN_SEQUENCE_LENGTH
    here = np.take_along_axis(fits, phase[..., None], axis=2)[..., 0].astype(np.float64)
    top = fits.max(axis=2)
    likely = (fits > top[..., None] - 2).sum(axis=2)
    gain = np.where(top > 0, np.log(MAIN_SEQUENCE_LENGTH / likely) - 0.5 * (top - here), 0.0)
    result: NDArray[np.float64] = gain.sum(axis=1) - PLACES
    return result


@functools.cache
def digit_tables() -> tuple[NDArray[np.float32], ...]:
    """Four (63, base) tables: one at the digit of a difference; none for impossible ones."""
    tables = []
    for weight, base in zip(sequences.WEIGHTS, sequences.BASES, strict=True):
        table = np.zeros((MAIN_SEQUENCE_LENGTH, base), np.float32)
        for difference in range(sequences.SMALLEST_SHIFT, MAIN_SEQUENCE_LENGTH - 4):
            digit = (difference - sequences.SMALLEST_SHIFT) // weight % base
            table[difference, digit] = 1
        tables.append(table)
    return tuple(tables)


@functools.lru_cache(16)
def ballot_tables(codec: Codec, length: int) -> tuple[NDArray[np.float32], ...]:
    """Four (length * base, period) tables: which digits a place expects at each step."""
    tables = []
    for digits, base in zip(codec.digits, sequences.BASES, strict=True):
        ahead = digits[np.add.outer(np.arange(length), np.arange(len(digits))) % len(digits)]
        table = ahead[:, None, :] == np.arange(base)[:, None]
        tables.append(table.reshape(length * base, -1).astype(np.float32))
    return tuple(tables)


@functools.lru_cache(16)
def kernel_tables(codec: Codec) -> tuple[NDArray[np.generic], ...]:
    """What the compiled kernel needs to know of a codec; see `Code` in core/_kernels.c."""
    widest = 2 * max(len(digits) for digits in codec.digits)
    masks = np.zeros((4, max(sequences.BASES), widest), np.float32)
    digit = np.full((4, MAIN_SEQUENCE_LENGTH), -1, np.int8)
    for k, (digits, table) in enumerate(zip(codec.digits, digit_tables(), strict=True)):
        ahead = digits[np.arange(widest) % len(digits)]
        masks[k] = ahead == np.arange(len(masks[k]))[:, None]
        possible, value = np.nonzero(table)
        digit[k, possible] = value
    prefixes = [np.concatenate([[0], np.cumsum(d, dtype=np.int64)]) for d in codec.digits]
    return (
        np.array([len(digits) for digits in codec.digits], np.int64),
        np.array(sequences.WEIGHTS, np.int64),
        np.concatenate(prefixes),
        codec.place(np.eye(4, dtype=np.int64)),
        SIGNS[np.arange(LONGEST + MAIN_SEQUENCE_LENGTH) % MAIN_SEQUENCE_LENGTH],
        digit,
        masks,
    )
