"""First estimate of the position of windows: the most likely phases of columns and rows vote.

Each dot contributes the log likelihood ratio of both of its bits (0 if the dot is missing). Each
column and row is correlated with all 63 phases of the main sequence. The differences of adjacent
phases vote, weighted by the margins of both, for all positions in the four secondary sequences.
Then the pattern at the winning position is compared with every dot.
:mod:`~locatk.core.dots.identification.decoding` evaluates the result.
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
from locatk.core.dots.codec.lookup import POSSIBLE_SHIFTS
from locatk.core.kernels import kernels

Bits = NDArray[np.float32]
Integers = NDArray[np.int64]

LOG_HYPOTHESES = math.log(4 * MAIN_SEQUENCE_LENGTH * SECTION_LENGTH)
"""Logarithm of the number of hypotheses per axis: orientations, sections and positions."""

MAX_WINDOW_LINES = 64
"""Largest number of columns and of rows of a window."""

MAX_LIKELY_PHASE_GAP = 2.0
"""Phases whose correlation is less than this below the best are likely ones of a line; the
correlation is twice a log likelihood, so that they are within a factor e."""

MAIN_SEQUENCE_SIGNS = 2.0 * MAIN_SEQUENCE.astype(np.float32) - 1.0


class WindowEstimates(NamedTuple):
    """Estimates for n windows, with x before y in each last axis of two.

    Attributes
    ----------
    rotation : (n,) int64 ndarray
    position, shift : (n, 2) int64 ndarray
        Of the printed corner, modulo :data:`~locatk.core.dots.codec.SECTION_LENGTH`, and of the
        phases, modulo 63.
    wrong : (n, 2) int64 ndarray
        Number of bits that differ from the pattern at the position.
    first, last : (n, 2) int64 ndarray
        First and last printed column and row with dots.
    log_odds : (n, 2) float64 ndarray
        Log odds of the position against random bits.
    order_log_odds : (n, 2) float64 ndarray
        Log odds against columns (or rows) of the main sequence in any order, as on a sheet of
        another codec.
    lead : (n, 2) float64 ndarray
        Lead of the best residue in votes; the least of the four sequences.
    """

    rotation: Integers
    position: Integers
    shift: Integers
    wrong: Integers
    first: Integers
    last: Integers
    log_odds: NDArray[np.float64]
    order_log_odds: NDArray[np.float64]
    lead: NDArray[np.float64]


def estimate_windows(column_bits: Bits, row_bits: Bits, codec: Codec) -> WindowEstimates:
    """Estimate rotation and position of windows (n, length, length) by voting."""
    if kernels is None:
        return estimate_windows_numpy(column_bits, row_bits, codec)
    n, length, _ = column_bits.shape
    integers, reals = np.empty((n, 11), np.int64), np.empty((n, 6))
    kernels.read_windows(
        np.ascontiguousarray(column_bits),
        np.ascontiguousarray(row_bits),
        *(n, length),
        *kernel_tables(codec),
        *(SECTION_LENGTH, sequences.MIN_SHIFT, LOG_HYPOTHESES),
        *(integers, reals),
    )
    by_axis = integers[:, 1:].reshape(n, 2, 5)
    return WindowEstimates(
        rotation=integers[:, 0],
        position=by_axis[..., 0],
        shift=by_axis[..., 1],
        wrong=by_axis[..., 2],
        first=by_axis[..., 3],
        last=by_axis[..., 4],
        log_odds=reals[:, 0:2],
        order_log_odds=reals[:, 2:4],
        lead=reals[:, 4:6],
    )


def estimate_windows_numpy(column_bits: Bits, row_bits: Bits, codec: Codec) -> WindowEstimates:
    """Estimate windows as :func:`estimate_windows`, without the compiled kernel."""
    rotation = rotation_scores(column_bits, row_bits).argmax(axis=0)
    return estimate_rotated_windows(column_bits, row_bits, rotation, codec)


def rotation_scores(column_bits: Bits, row_bits: Bits) -> Bits:
    """Return the fit (4, n) of the main sequence to windows at each rotation.

    After a quarter turn the printed rows are columns, one of both axes being reversed with its bits
    inverted; no string of seven bits occurs in the main sequence in both ways.
    """
    forwards, backwards = _templates(column_bits.shape[1])
    fits = [
        (bits @ template).max(axis=2).sum(axis=1)
        for bits in (column_bits.transpose(0, 2, 1), row_bits)
        for template in (forwards, backwards)
    ]
    return np.stack([fits[a] + fits[b] for a, b in ((0, 2), (2, 1), (1, 3), (3, 0))])


def estimate_rotated_windows(
    column_bits: Bits, row_bits: Bits, rotation: Integers, codec: Codec
) -> WindowEstimates:
    """Estimate the position of windows of known rotation."""
    printed = rotate_to_print(column_bits, row_bits, rotation)
    axes = []
    for lines in (printed[0].transpose(0, 2, 1), printed[1]):
        scores = phase_scores(lines)
        position, shift, lead = vote_position(scores, codec)
        log_odds, wrong = compare_with_pattern(position, shift, lines, codec)
        order_log_odds = compare_with_any_order(position, shift, scores, codec)
        has_dots = (lines != 0).any(axis=2)
        count = has_dots.shape[1]
        is_empty = ~has_dots.any(axis=1)
        first = np.where(is_empty, count, has_dots.argmax(axis=1))
        last = np.where(is_empty, -1, count - 1 - has_dots[:, ::-1].argmax(axis=1))
        axes.append((position, shift, wrong, first, last, log_odds, order_log_odds, lead))
    position, shift, wrong, first, last, log_odds, order_log_odds, lead = (
        np.stack(pair, axis=1) for pair in zip(*axes, strict=True)
    )
    return WindowEstimates(
        rotation, position, shift, wrong, first, last, log_odds, order_log_odds, lead
    )


@functools.lru_cache(8)
def _templates(length: int) -> tuple[Bits, Bits]:
    """Return the main sequence from each phase (length, 63), forwards, and backwards inverted."""
    forwards = MAIN_SEQUENCE_SIGNS[
        np.add.outer(np.arange(length), np.arange(MAIN_SEQUENCE_LENGTH)) % MAIN_SEQUENCE_LENGTH
    ]
    return forwards, np.ascontiguousarray(-forwards[::-1])


def phase_scores(lines: Bits) -> Bits:
    """Return the correlation (n, length, 63) of each line with the main sequence at each phase."""
    result: Bits = lines @ _templates(lines.shape[2])[0]
    return result


def rotate_to_print(column_bits: Bits, row_bits: Bits, rotation: Integers) -> tuple[Bits, Bits]:
    """Return column and row bits as printed: windows and displacements rotated back."""
    columns, rows = np.empty_like(column_bits), np.empty_like(row_bits)
    for quarters in range(4):
        # A quarter turn exchanges the bits.
        column, row = (row_bits, column_bits) if quarters % 2 else (column_bits, row_bits)
        chosen = rotation == quarters
        if chosen.any():
            # The column bit is inverted after two and three quarter turns, the row bit after one
            # and two.
            column_sign = -1 if quarters in (2, 3) else 1
            row_sign = -1 if quarters in (1, 2) else 1
            columns[chosen] = np.rot90(column[chosen], -quarters, (1, 2)) * column_sign
            rows[chosen] = np.rot90(row[chosen], -quarters, (1, 2)) * row_sign
    return columns, rows


def vote_position(scores: Bits, codec: Codec) -> tuple[Integers, Integers, NDArray[np.float64]]:
    """Return position, shift of the phases and lead (n,) by the best phase of each line.

    ``scores`` (n, length, 63) are :func:`phase_scores`.
    """
    n, length, _ = scores.shape
    phase = scores.argmax(axis=2)
    best_two = np.partition(scores, MAIN_SEQUENCE_LENGTH - 2, axis=2)[..., -2:]
    margin = best_two[..., 1] - best_two[..., 0]

    difference = (phase[:, 1:] - phase[:, :-1]) % MAIN_SEQUENCE_LENGTH
    weight = np.minimum(margin[:, 1:], margin[:, :-1])
    residues, lead = np.empty((n, 4), np.int64), np.full(n, np.inf)
    tables = zip(digit_tables(), ballot_tables(codec, length - 1), strict=True)
    for k, (digits, ballots) in enumerate(tables):
        votes = (digits[difference] * weight[..., None]).reshape(n, len(ballots)) @ ballots
        residues[:, k] = votes.argmax(axis=1)
        best_two = np.partition(votes, votes.shape[1] - 2, axis=1)[:, -2:]
        lead = np.minimum(lead, best_two[:, 1] - best_two[:, 0])
    position = codec.position(residues)
    shifts = (phase - following_phases(position, length, codec)) % MAIN_SEQUENCE_LENGTH
    shift_votes = np.bincount(
        (shifts + MAIN_SEQUENCE_LENGTH * np.arange(n)[:, None]).ravel(),
        margin.ravel(),
        MAIN_SEQUENCE_LENGTH * n,
    )
    return position, shift_votes.reshape(n, MAIN_SEQUENCE_LENGTH).argmax(axis=1), lead


def following_phases(position: Integers, length: int, codec: Codec) -> Integers:
    """Return the phases (..., length) of lines from ``position`` on, across the section's end."""
    return codec.phases((position[..., None] + np.arange(length)) % SECTION_LENGTH)


def compare_with_pattern(
    position: Integers, shift: Integers, lines: Bits, codec: Codec
) -> tuple[NDArray[np.float64], Integers]:
    """Return the log odds (n,) of a position against random bits, and the wrong bits (n,)."""
    n, length, _ = lines.shape
    phase = following_phases(position, length, codec) + shift[:, None]
    window, line, step = np.nonzero(lines)
    index = (phase[window, line] + step) % MAIN_SEQUENCE_LENGTH
    agreement = lines[window, line, step] * MAIN_SEQUENCE_SIGNS[index]
    gain = math.log(2) - np.log1p(np.exp(-agreement))
    log_odds = np.asarray(np.bincount(window, gain, n) - LOG_HYPOTHESES, np.float64)
    wrong = np.bincount(window[agreement < 0], minlength=n).astype(np.int64)
    return log_odds, wrong


def compare_with_any_order(
    position: Integers, shift: Integers, scores: Bits, codec: Codec
) -> NDArray[np.float64]:
    """Return the log odds (n,) of a position against lines of the main sequence in any order.

    A free line has one of its likely phases, of 63; a line of the code has no choice once the
    position is chosen. So a line of few dots, which fits many phases, contributes little.
    ``scores`` are :func:`phase_scores`.
    """
    phase = (following_phases(position, scores.shape[1], codec) + shift[:, None]) % (
        MAIN_SEQUENCE_LENGTH
    )
    at_position = np.take_along_axis(scores, phase[..., None], axis=2)[..., 0].astype(np.float64)
    best = scores.max(axis=2)
    likely = (scores > best[..., None] - MAX_LIKELY_PHASE_GAP).sum(axis=2)
    gain = np.log(MAIN_SEQUENCE_LENGTH / likely) - 0.5 * (best - at_position)
    result: NDArray[np.float64] = np.where(best > 0, gain, 0.0).sum(axis=1) - LOG_HYPOTHESES
    return result


@functools.cache
def digit_tables() -> tuple[Bits, ...]:
    """Return four tables (63, base): one at the digit of a shift; zeros for impossible shifts."""
    tables = []
    for weight, base in zip(sequences.DIGIT_WEIGHTS, sequences.DIGIT_BASES, strict=True):
        table = np.zeros((MAIN_SEQUENCE_LENGTH, base), np.float32)
        for shift in POSSIBLE_SHIFTS:
            table[shift, (shift - sequences.MIN_SHIFT) // weight % base] = 1
        tables.append(table)
    return tuple(tables)


@functools.lru_cache(16)
def ballot_tables(codec: Codec, length: int) -> tuple[Bits, ...]:
    """Return four tables (length * base, period): the digits of each position at each step."""
    tables = []
    for digits, base in zip(codec.digits, sequences.DIGIT_BASES, strict=True):
        steps = np.add.outer(np.arange(length), np.arange(len(digits)))
        following = digits[steps % len(digits)]
        table = following[:, None, :] == np.arange(base)[:, None]
        tables.append(table.reshape(length * base, -1).astype(np.float32))
    return tuple(tables)


@functools.lru_cache(16)
def kernel_tables(codec: Codec) -> tuple[NDArray[np.generic], ...]:
    """Return the tables of a codec for the compiled kernel; see `Code` in core/_kernels.c."""
    width = 2 * max(len(digits) for digits in codec.digits)
    masks = np.zeros((4, max(sequences.DIGIT_BASES), width), np.float32)
    digit = np.full((4, MAIN_SEQUENCE_LENGTH), -1, np.int8)
    for k, (digits, table) in enumerate(zip(codec.digits, digit_tables(), strict=True)):
        following = digits[np.arange(width) % len(digits)]
        masks[k] = following == np.arange(len(masks[k]))[:, None]
        possible, value = np.nonzero(table)
        digit[k, possible] = value
    prefixes = [np.concatenate([[0], np.cumsum(d, dtype=np.int64)]) for d in codec.digits]
    return (
        np.array([len(digits) for digits in codec.digits], np.int64),
        np.array(sequences.DIGIT_WEIGHTS, np.int64),
        np.concatenate(prefixes),
        codec.position(np.eye(4, dtype=np.int64)),
        MAIN_SEQUENCE_SIGNS[
            np.arange(MAX_WINDOW_LINES + MAIN_SEQUENCE_LENGTH) % MAIN_SEQUENCE_LENGTH
        ],
        digit,
        masks,
    )
