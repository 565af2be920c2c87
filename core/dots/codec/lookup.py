"""Hard decoding: windows of symbols to positions by look-ups alone, as the paper has it.

papers/dots.txt II-A: every column is found in the main sequence, the shifts from column to
column are taken apart into digits, and the places of those digits in the four secondary
sequences make the position by the Chinese remainder theorem; the rows give the other axis.
Nothing is corrected: every dot of a window has to agree with the answer. Where bits may be
wrong or missing, soft decoding is the tool.
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

Whole = NDArray[np.int64]

ORDER = 6
"""Bits that fix a place in the main sequence, and dots a side of the smallest window."""

STRING = 5
"""Digits that fix a place in a secondary sequence."""

ONE_WAY = 7
"""Bits from which on the main sequence reads in one direction only (facts/dots.md 2.3)."""

_CYCLE = np.array([UP, LEFT, DOWN, RIGHT], np.uint8)
_TURNED = np.empty((4, 4), np.uint8)
"""What each symbol becomes; a row for each number of quarter turns."""
for _quarters in range(4):
    _TURNED[_quarters, _CYCLE] = np.roll(_CYCLE, -_quarters)


def _lines(length: int) -> NDArray[np.uint8]:
    """(63, length) lines of bits, one from each place of the main sequence."""
    return MAIN_SEQUENCE[
        np.add.outer(np.arange(MAIN_SEQUENCE_LENGTH), np.arange(length)) % MAIN_SEQUENCE_LENGTH
    ]


_POWERS = 1 << np.arange(ORDER - 1, -1, -1, dtype=np.uint8)
_PHASE = np.full(1 << ORDER, -1, np.int64)
"""Place of each six bits in the main sequence, -1 for 111111, which is not in it."""
_PHASE[_lines(ORDER) @ _POWERS] = np.arange(MAIN_SEQUENCE_LENGTH)

SHIFTS = np.arange(5, 59)
"""Shifts from line to line that have digits; the others belong to no pattern."""


@dataclass(frozen=True, eq=False)
class Exact:
    """What :func:`decode_exact` read, an entry a window; all -1 where ``ok`` is False.

    Attributes
    ----------
    x, y : (n,) int64 ndarray
        Grid coordinates of the dot that was printed at the window's upper left.
    section : (n, 2) int64 ndarray
        u and v, each 0..62.
    rotation : (n,) int64 ndarray
        Quarter turns counter-clockwise by which the print appears turned in the window,
        0..3: what was seen is ``turn(printed, rotation)``.
    ok : (n,) bool ndarray
        Every dot agrees, with one answer and no other.
    """

    x: Whole
    y: Whole
    section: Whole
    rotation: Whole
    ok: NDArray[np.bool_]


def turn(symbols: NDArray[np.uint8], quarters: int) -> NDArray[np.uint8]:
    """Windows (..., rows, columns) turned counter-clockwise, and their symbols with them.

    After one quarter turn an UP dot points LEFT. ``quarters`` may be negative.
    """
    result: NDArray[np.uint8] = _TURNED[quarters % 4][np.rot90(symbols, quarters, axes=(-2, -1))]
    return result


def decode_exact(
    windows: ArrayLike, codec: Codec, rotations: tuple[int, ...] | None = None
) -> Exact:
    """Positions of windows of symbols in which no dot is missing or wrong.

    Parameters
    ----------
    windows : (n, rows, columns) array_like of whole numbers
        Symbols as they were seen; 6 or more rows and columns.
    codec : Codec
    rotations : tuple of int, optional
        Quarter turns that are possible. By default all four from 7 x 7 dots on, and none
        (``(0,)``) below: 62 of the 63 strings of six bits are also strings of the main
        sequence upside down (facts/dots.md 2.3). So 6 x 6 dots that are turned by 90 or
        180 degrees make a valid, wrong position in 37 or 16 of 100 windows; who
        does not know how they lie asks for ``(0, 1, 2, 3)``, and gets those windows read
        that only one turn fits, 39 of 100.

    Returns
    -------
    Exact
        ``ok`` is False where a dot disagrees, where several turns or places agree (libdots'
        repeated digits, in fewer than eight dots a side), and where the window would
        reach across the border of the section. From 8 x 8 dots on one wrong bit is
        always found. In smaller windows, or with more wrong bits, errors may make
        another valid window, which nothing distinguishes from a true one.

    Raises
    ------
    InputError
        The windows are too small, or hold what is no symbol.
    """
    seen = np.asarray(windows)
    if seen.ndim != 3 or min(seen.shape[1:]) < ORDER:
        raise InputError(
            f"windows of shape {seen.shape}, not (n, rows, columns) of at least 6 x 6 dots"
        )
    if seen.size and not (seen.dtype.kind in "iu" and seen.min() >= 0 and seen.max() <= DOWN):
        raise InputError(f"symbols that are not whole numbers 0..{DOWN}")
    if rotations is None:
        rotations = (0, 1, 2, 3) if min(seen.shape[1:]) >= ONE_WAY else (0,)
    seen = seen.astype(np.uint8, copy=False)
    read = np.full((5, len(seen)), -1, np.int64)
    answers = np.zeros(len(seen), np.int64)
    for rotation in sorted({r % 4 for r in rotations}):
        which, position, number = _decode(seen, rotation, codec)
        read[:4, which] = position
        read[4, which] = rotation
        answers[which] += number
    ok = answers == 1
    read[:, ~ok] = -1
    return Exact(read[0], read[1], read[2:4].T.copy(), read[4], ok)


def _decode(
    seen: NDArray[np.uint8], rotation: int, codec: Codec
) -> tuple[NDArray[np.intp], Whole, Whole]:
    """Windows that can be read as turned so.

    Returns their numbers (m,), x, y, u and v (4, m), and of how many places each could be (m,).
    """
    # The first column and row sort out nearly all that is turned otherwise, cheaply.
    back = np.rot90(seen, -rotation, axes=(1, 2))
    upright = _TURNED[-rotation % 4]
    first = _phases(upright[back[:, :, 0]] & 1) | _phases(upright[back[:, 0]] >> 1)
    which = np.flatnonzero(first >= 0)
    printed = upright[back[which]]
    columns, rows = _phases((printed & 1).swapaxes(1, 2)), _phases(printed >> 1)
    whole = (columns >= 0).all(axis=1) & (rows >= 0).all(axis=1)
    which, columns, rows = which[whole], columns[whole], rows[whole]
    x, ways_x = _places(columns, codec)
    y, ways_y = _places(rows, codec)
    number = ways_x * ways_y
    found = number > 0
    u = (columns[:, 0] - y - codec.phases(x)) % MAIN_SEQUENCE_LENGTH
    v = (rows[:, 0] - x - codec.phases(y)) % MAIN_SEQUENCE_LENGTH
    return which[found], np.stack([x, y, u, v])[:, found], number[found]


def _phases(bits: NDArray[np.integer]) -> Whole:
    """Place in the main sequence at which each line of bits (..., length) begins, or -1."""
    phase = _PHASE[bits[..., :ORDER] @ _POWERS]
    agree = (_lines(bits.shape[-1])[phase] == bits).all(axis=-1)
    result: Whole = np.where(agree, phase, -1)
    return result


def _places(phases: Whole, codec: Codec) -> tuple[Whole, Whole]:
    """Place (n,) of the first of some adjoining lines (n, lines), and of how many it could be."""
    shift: Whole = np.diff(phases, axis=1) % MAIN_SEQUENCE_LENGTH
    possible = (shift >= SHIFTS[0]) & (shift <= SHIFTS[-1])
    residues, choices = [], [possible.all(axis=1)]
    lookups = zip(digits_of(shift), sequences.BASES, strings(codec), codec.digits, strict=True)
    for digits, base, table, sequence in lookups:
        code = digits[:, :STRING] @ base ** np.arange(STRING)[::-1]
        candidates = table[code]  # (n, most times that any string occurs)
        along = np.add.outer(np.arange(len(sequence)), np.arange(shift.shape[1]))
        agree = (sequence[along % len(sequence)][candidates] == digits[:, None]).all(axis=2)
        agree &= candidates >= 0
        choices.append(agree.sum(axis=1))
        residues.append(candidates.max(axis=1, where=agree, initial=-1))
    place = codec.place(np.stack(residues, axis=-1))
    ways: Whole = np.prod(choices, axis=0)
    ways[place + phases.shape[1] > SECTION_LENGTH] = 0
    return place, ways


def digits_of(shifts: Whole) -> tuple[Whole, ...]:
    """The four digits of shifts from line to line, each of the shape of ``shifts``.

    papers/dots.txt II-A, "basis" equation. For what is not in :data:`SHIFTS` the
    answer means nothing.
    """
    rest = np.clip(shifts, SHIFTS[0], SHIFTS[-1]) - sequences.SMALLEST_SHIFT
    return tuple(
        rest // weight % base
        for weight, base in zip(sequences.WEIGHTS, sequences.BASES, strict=True)
    )


@functools.cache
def strings(codec: Codec) -> tuple[Whole, ...]:
    """For each secondary sequence, where each string of five digits occurs, -1 for nowhere.

    (base^5, times) each; only libdots' fourth sequence has strings that occur twice.
    """
    tables = []
    for sequence, base in zip(codec.digits, sequences.BASES, strict=True):
        along = np.add.outer(np.arange(len(sequence)), np.arange(STRING)) % len(sequence)
        codes = sequence[along] @ base ** np.arange(STRING)[::-1]
        table: Whole = np.full((base**STRING, np.bincount(codes).max()), -1, np.int64)
        for place, code in enumerate(codes):
            table[code, np.argmin(table[code])] = place
        tables.append(table)
    return tuple(tables)
