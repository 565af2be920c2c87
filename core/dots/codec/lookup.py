"""Hard decoding: positions of windows of symbols by look-up tables alone.

Every column is looked up in the main sequence, the shifts from column to column are decomposed into
digits, and the positions of those digits in the four secondary sequences give x by the Chinese
remainder theorem; the rows give y (Hostettler et al. 2016, II-A). Nothing is corrected: every dot
of a window has to agree with the result. If bits may be wrong or missing, use soft decoding
(:mod:`~locatk.core.dots.identification.decoding`).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from locatk.core.dots.codec import sequences
from locatk.core.dots.codec.pattern import (
    DOWN,
    LEFT,
    MAIN_SEQUENCE,
    MAIN_SEQUENCE_LENGTH,
    RIGHT,
    SECTION_LENGTH,
    UP,
    Codec,
)
from locatk.core.errors import InputError

Integers = NDArray[np.int64]

BITS_PER_STRING = 6
"""Bits that determine a phase of the main sequence (its order), and dots per side of the smallest
window."""

DIGITS_PER_STRING = 5
"""Digits that determine a position in a secondary sequence (its order)."""

MIN_ORIENTED_BITS = 7
"""Number of bits from which no string of the main sequence, reversed and inverted, occurs in it. Of
the 63 strings of six bits 62 do."""

_CYCLE = np.array([UP, LEFT, DOWN, RIGHT], np.uint8)
_ROTATED_SYMBOLS = np.empty((4, 4), np.uint8)
"""Symbols after 0 to 3 counter-clockwise quarter turns: one row per number of turns."""
for _quarters in range(4):
    _ROTATED_SYMBOLS[_quarters, _CYCLE] = np.roll(_CYCLE, -_quarters)


def _main_sequence_strings(length: int) -> NDArray[np.uint8]:
    """Return the (63, length) strings of the main sequence from each phase on."""
    return MAIN_SEQUENCE[
        np.add.outer(np.arange(MAIN_SEQUENCE_LENGTH), np.arange(length)) % MAIN_SEQUENCE_LENGTH
    ]


_BIT_WEIGHTS = 1 << np.arange(BITS_PER_STRING - 1, -1, -1, dtype=np.uint8)
_PHASE_OF_CODE = np.full(1 << BITS_PER_STRING, -1, np.int64)
"""Phase of each string of six bits, as a number, in the main sequence; -1 for 111111, which does
not occur."""
_PHASE_OF_CODE[_main_sequence_strings(BITS_PER_STRING) @ _BIT_WEIGHTS] = np.arange(
    MAIN_SEQUENCE_LENGTH
)

POSSIBLE_SHIFTS = np.arange(5, 59)
"""Shifts from line to line that have digits; no pattern contains the others."""


@dataclass(frozen=True, eq=False)
class ExactWindows:
    """Result of :func:`decode_exact` for n windows; all entries are -1 if ``ok`` is False.

    Attributes
    ----------
    x, y : (n,) int64 ndarray
        Grid coordinates of the dot that was printed at the window's upper left.
    section : (n, 2) int64 ndarray
        u and v, each 0..62.
    rotation : (n,) int64 ndarray
        Counter-clockwise quarter turns 0..3 of the print in the window: the observed symbols are
        ``rotate_symbols(printed, rotation)``.
    ok : (n,) bool ndarray
        Every dot agrees, with exactly one result.
    """

    x: Integers
    y: Integers
    section: Integers
    rotation: Integers
    ok: NDArray[np.bool_]


def rotate_symbols(symbols: NDArray[np.uint8], quarters: int) -> NDArray[np.uint8]:
    """Rotate windows (..., rows, columns) counter-clockwise, and their symbols with them.

    After one quarter turn an UP dot points LEFT. ``quarters`` may be negative.
    """
    result: NDArray[np.uint8] = _ROTATED_SYMBOLS[quarters % 4][
        np.rot90(symbols, quarters, axes=(-2, -1))
    ]
    return result


def decode_exact(
    windows: ArrayLike, codec: Codec, rotations: tuple[int, ...] | None = None
) -> ExactWindows:
    """Return the positions of windows of symbols without a missing or wrong dot.

    Parameters
    ----------
    windows : (n, rows, columns) array_like of whole numbers
        Observed symbols; 6 or more rows and columns.
    codec : Codec
    rotations : tuple of int, optional
        Possible quarter turns. Default: all four from 7 x 7 dots on, and none (``(0,)``) below,
        because 62 of the 63 strings of six bits are also strings of the main sequence when reversed
        and inverted: 6 x 6 dots rotated by 90 or 180 degrees have a valid, wrong position in 37 or
        16 of 100 windows. If the rotation is unknown, pass ``(0, 1, 2, 3)``; then the windows
        that fit one rotation only are decoded, 39 of 100.

    Returns
    -------
    ExactWindows
        ``ok`` is False if a dot disagrees, if several rotations or positions agree (repeated digits
        of ``libdots``, in fewer than eight dots per side), or if the window would extend across the
        border of the section. From 8 x 8 dots on a single wrong bit is always detected. In smaller
        windows, or with more wrong bits, errors may result in another valid window, which cannot be
        distinguished from the true one.

    Raises
    ------
    InputError
        The windows are too small, or contain a value that is no symbol.
    """
    observed = np.asarray(windows)
    if observed.ndim != 3 or min(observed.shape[1:]) < BITS_PER_STRING:
        raise InputError(
            f"windows of shape {observed.shape}, not (n, rows, columns) of at least 6 x 6 dots"
        )
    is_integer = observed.dtype.kind in "iu"
    if observed.size and not (is_integer and observed.min() >= 0 and observed.max() <= DOWN):
        raise InputError(f"symbols that are not whole numbers 0..{DOWN}")
    if rotations is None:
        is_oriented = min(observed.shape[1:]) >= MIN_ORIENTED_BITS
        rotations = (0, 1, 2, 3) if is_oriented else (0,)
    observed = observed.astype(np.uint8, copy=False)
    decoded = np.full((5, len(observed)), -1, np.int64)
    results = np.zeros(len(observed), np.int64)
    for rotation in sorted({r % 4 for r in rotations}):
        index, position, count = _decode_at_rotation(observed, rotation, codec)
        decoded[:4, index] = position
        decoded[4, index] = rotation
        results[index] += count
    ok = results == 1
    decoded[:, ~ok] = -1
    return ExactWindows(decoded[0], decoded[1], decoded[2:4].T.copy(), decoded[4], ok)


def _decode_at_rotation(
    observed: NDArray[np.uint8], rotation: int, codec: Codec
) -> tuple[NDArray[np.intp], Integers, Integers]:
    """Decode the windows that are valid at a rotation.

    Returns their indices (m,), x, y, u and v (4, m), and the number of positions (m,) that each
    agrees with.
    """
    # The first column and row exclude nearly all windows of another rotation at little cost.
    rotated = np.rot90(observed, -rotation, axes=(1, 2))
    printed_symbol = _ROTATED_SYMBOLS[-rotation % 4]
    first_column = _phases_of(printed_symbol[rotated[:, :, 0]] & 1)
    first_row = _phases_of(printed_symbol[rotated[:, 0]] >> 1)
    index = np.flatnonzero((first_column | first_row) >= 0)
    printed = printed_symbol[rotated[index]]
    columns, rows = _phases_of((printed & 1).swapaxes(1, 2)), _phases_of(printed >> 1)
    is_valid = (columns >= 0).all(axis=1) & (rows >= 0).all(axis=1)
    index, columns, rows = index[is_valid], columns[is_valid], rows[is_valid]
    x, count_x = _positions_of(columns, codec)
    y, count_y = _positions_of(rows, codec)
    count = count_x * count_y
    has_position = count > 0
    u = (columns[:, 0] - y - codec.phases(x)) % MAIN_SEQUENCE_LENGTH
    v = (rows[:, 0] - x - codec.phases(y)) % MAIN_SEQUENCE_LENGTH
    return index[has_position], np.stack([x, y, u, v])[:, has_position], count[has_position]


def _phases_of(bits: NDArray[np.integer]) -> Integers:
    """Return the phase of the main sequence of each line of bits (..., length), or -1."""
    phase = _PHASE_OF_CODE[bits[..., :BITS_PER_STRING] @ _BIT_WEIGHTS]
    agrees = (_main_sequence_strings(bits.shape[-1])[phase] == bits).all(axis=-1)
    result: Integers = np.where(agrees, phase, -1)
    return result


def _positions_of(phases: Integers, codec: Codec) -> tuple[Integers, Integers]:
    """Return the position (n,) of the first of adjacent lines (n, lines), and how many agree."""
    shift: Integers = np.diff(phases, axis=1) % MAIN_SEQUENCE_LENGTH
    is_possible = (shift >= POSSIBLE_SHIFTS[0]) & (shift <= POSSIBLE_SHIFTS[-1])
    residues, counts = [], [is_possible.all(axis=1)]
    tables = zip(
        digits_of(shift), sequences.DIGIT_BASES, digit_strings(codec), codec.digits, strict=True
    )
    for digits, base, table, sequence in tables:
        code = digits[:, :DIGITS_PER_STRING] @ base ** np.arange(DIGITS_PER_STRING)[::-1]
        candidates = table[code]  # (n, largest number of occurrences of a string)
        following = np.add.outer(np.arange(len(sequence)), np.arange(shift.shape[1]))
        expected = sequence[following % len(sequence)][candidates]
        agrees = (expected == digits[:, None]).all(axis=2) & (candidates >= 0)
        counts.append(agrees.sum(axis=1))
        residues.append(candidates.max(axis=1, where=agrees, initial=-1))
    position = codec.position(np.stack(residues, axis=-1))
    count: Integers = np.prod(counts, axis=0)
    count[position + phases.shape[1] > SECTION_LENGTH] = 0
    return position, count


def digits_of(shifts: Integers) -> tuple[Integers, ...]:
    """Return the four digits of shifts from line to line, each of the shape of ``shifts``.

    Inverse of the "basis" equation (Hostettler et al. 2016, II-A). The digits of shifts that are
    not in :data:`POSSIBLE_SHIFTS` have no meaning.
    """
    rest = np.clip(shifts, POSSIBLE_SHIFTS[0], POSSIBLE_SHIFTS[-1]) - sequences.MIN_SHIFT
    return tuple(
        rest // weight % base
        for weight, base in zip(sequences.DIGIT_WEIGHTS, sequences.DIGIT_BASES, strict=True)
    )


@functools.cache
def digit_strings(codec: Codec) -> tuple[Integers, ...]:
    """Return for each secondary sequence the positions of each string of five digits.

    The tables are (base^5, occurrences), padded with -1; only the fourth sequence of ``libdots``
    has strings that occur twice.
    """
    tables = []
    for sequence, base in zip(codec.digits, sequences.DIGIT_BASES, strict=True):
        following = np.add.outer(np.arange(len(sequence)), np.arange(DIGITS_PER_STRING))
        strings = sequence[following % len(sequence)]
        codes = strings @ base ** np.arange(DIGITS_PER_STRING)[::-1]
        table: Integers = np.full((base**DIGITS_PER_STRING, np.bincount(codes).max()), -1, np.int64)
        for position, code in enumerate(codes):
            table[code, np.argmin(table[code])] = position
        tables.append(table)
    return tuple(tables)
