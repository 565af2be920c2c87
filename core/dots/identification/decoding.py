"""Soft decoding: the place of a window of the pattern from all dots that are seen of it.

The evidence for an axis is the logarithm of how much likelier its dots are at a place than
if their bits were random. Before the dots are seen, one of ``4 * 63 * RANGE`` places,
sections and orientations is as likely as the next; by this the evidence is lowered, so
that random bits pass a confidence of 1 - p with a probability below p, however many places
were tried. A sheet of another codec is no random bits: columns of the main sequence in any
order are a hypothesis too. Where wrong bits leave a doubt, the likeliest few places are
compared with the whole window, and share the confidence.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.codec import MAIN_SEQUENCE_LENGTH, SECTION_LENGTH, Codec
from locatk.core.dots.codec.lookup import decode_exact
from locatk.core.dots.identification.phase_voting import (
    LONGEST,
    PLACES,
    Reading,
    compare,
    in_order,
    read,
    read_turned,
    scores,
    turned,
    turns,
)
from locatk.core.dots.identification.search import search
from locatk.core.errors import InputError

THRESHOLD = 0.999
"""Least confidence of an accepted answer."""

ENOUGH = math.log(THRESHOLD / (1 - THRESHOLD))
"""Log odds of :data:`THRESHOLD`."""

STRANGE = 0.01
"""How much likelier than a sheet of another codec it is to see one of this."""

UNLISTED = 3.0
"""How much more the rivals of a place weigh than those that were found."""

SURE = 40.0
"""Log odds from which no other place can come near, wrong bits or not."""

MANY = 0.08
"""Share of wrong bits from which another place may be as near, whatever the odds."""

AHEAD = 10.0
"""Votes by which a place leads that no other can share; the margin of a line or less."""

NARROW = 16
"""Columns up to which a window is worth a second look when it cannot be read."""

PLAIN = 8
"""Columns and rows from which a window without a wrong bit has one place only."""


@dataclass(frozen=True)
class Decoded:
    """Answers for n windows; each array's first axis is the window.

    Attributes
    ----------
    x, y : (n,) int64 ndarray
        Grid coordinates of the printed window's upper left corner. The corner itself may
        lie outside of the range where no dot is seen there; below 0 then.
    section : (n, 2) int64 ndarray
    rotation : (n,) int64 ndarray
        Quarter turns counter-clockwise by which the printed pattern is seen turned.
    dots : (n,) int64 ndarray
        Dots seen.
    corrected : (n,) int64 ndarray
        Bits that were seen wrong.
    confidence : (n,) float64 ndarray
        Probability that the answer is right; accept from :data:`THRESHOLD` on.
    border : (n,) bool ndarray
        Whether dots are seen on both sides of the border of a section; such a window has no
        confidence.
    """

    x: NDArray[np.int64]
    y: NDArray[np.int64]
    section: NDArray[np.int64]
    rotation: NDArray[np.int64]
    dots: NDArray[np.int64]
    corrected: NDArray[np.int64]
    confidence: NDArray[np.float64]
    border: NDArray[np.bool_]


def decode(
    column_bits: NDArray[np.float32], row_bits: NDArray[np.float32], codec: Codec
) -> Decoded:
    """Place, section and orientation of n windows.

    Parameters
    ----------
    column_bits, row_bits : (n, rows, columns) float32 ndarray
        As seen, upright or not: logarithm of the likelihood ratio that the dot lies left
        or down (column bit 1), and right or down (row bit 1); 0 where no dot is seen.
        Bits of symbols that are known for sure: plus or minus 4.
    codec : Codec

    Raises
    ------
    InputError
        A window has more than :data:`LONGEST` columns or rows.
    """
    _, rows, columns = column_bits.shape
    if max(rows, columns) > LONGEST:
        raise InputError(f"a window of {columns} x {rows} places, more than {LONGEST}")
    if not PLAIN <= min(rows, columns) <= max(rows, columns) <= NARROW:
        return _decode_soft(column_bits, row_bits, codec)
    plain = _decode_plain(column_bits, row_bits, codec)
    doubtful = np.flatnonzero(plain.confidence < THRESHOLD)
    if len(doubtful):
        soft = _decode_soft(column_bits[doubtful], row_bits[doubtful], codec)
        for field in fields(Decoded):
            getattr(plain, field.name)[doubtful] = getattr(soft, field.name)
    return plain


def _decode_plain(
    column_bits: NDArray[np.float32], row_bits: NDArray[np.float32], codec: Codec
) -> Decoded:
    """Windows in which no dot is missing or wrong, by look-ups; the rest has no confidence."""
    least = np.minimum(np.abs(column_bits), np.abs(row_bits)).min(axis=(1, 2))
    symbols = (column_bits > 0) + 2 * (row_bits > 0).astype(np.uint8)
    exact = decode_exact(symbols, codec)
    n, rows, columns = symbols.shape
    # No bit is less sure than the least sure one.
    odds = rows * columns * (math.log(2) - np.log1p(np.exp(-least.astype(np.float64)))) - PLACES
    return Decoded(
        exact.x,
        exact.y,
        exact.section,
        exact.rotation,
        dots=np.full(n, rows * columns),
        corrected=np.zeros(n, np.int64),
        confidence=np.where(exact.ok & (least > 0), (1 + np.exp(-odds)) ** -2, 0.0),
        border=np.zeros(n, np.bool_),
    )


def _decode_soft(
    column_bits: NDArray[np.float32], row_bits: NDArray[np.float32], codec: Codec
) -> Decoded:
    x_bits, y_bits = _square(column_bits), _square(row_bits)
    reading = read(x_bits, y_bits, codec)
    confidence = _settle(reading, x_bits, y_bits, codec)
    doubtful = np.flatnonzero(confidence < THRESHOLD)
    if len(doubtful) and x_bits.shape[1] <= NARROW:
        # In small windows a few wrong bits may hide which way is up.
        windows = x_bits[doubtful], y_bits[doubtful]
        second = np.argsort(-turns(*windows), axis=0)[1]
        other = read_turned(*windows, second, codec)
        other_confidence = _settle(other, *windows, codec)
        better = other_confidence > confidence[doubtful]
        for mine, its in zip(reading, other, strict=True):
            mine[doubtful[better]] = its[better]
        confidence[doubtful[better]] = other_confidence[better]
    _, rows, columns = column_bits.shape
    length = x_bits.shape[1]
    return _decoded(reading, confidence, x_bits, (length - rows, length - columns))


def _settle(
    reading: Reading, x_bits: NDArray[np.float32], y_bits: NDArray[np.float32], codec: Codec
) -> NDArray[np.float64]:
    """Confidence (n,) of a reading; in doubt a search finds a better one, put in its place."""
    rivals = np.zeros_like(reading.odds)
    for axis in range(2):
        odds, wrong = reading.odds[:, axis], reading.wrong[:, axis]
        doubt = (wrong > 0) & (odds < SURE) | (reading.lead[:, axis] < AHEAD)
        if wrong.any():
            doubt |= wrong > MANY * np.count_nonzero(x_bits, axis=(1, 2))
        doubtful = np.flatnonzero(doubt)
        if not len(doubtful):
            continue
        printed = turned(x_bits[doubtful], y_bits[doubtful], reading.rotation[doubtful])
        lines = printed[1] if axis else printed[0].transpose(0, 2, 1)
        fits, narrow = scores(lines), x_bits.shape[1] <= NARROW
        # Evidence if every line were at its best phase: where that is not enough, no place is.
        bound = 0.5 * fits.max(axis=2).sum(axis=1) - np.log(np.cosh(0.5 * lines)).sum(axis=(1, 2))
        hope = bound > PLACES + ENOUGH
        if not hope.any():
            continue
        doubtful, lines, fits = doubtful[hope], lines[hope], fits[hope]
        place, shift, rivals[doubtful, axis] = search(fits, codec, narrow=narrow)
        reading.place[doubtful, axis], reading.shift[doubtful, axis] = place, shift
        odds, wrong = compare(place, shift, lines, codec)
        reading.odds[doubtful, axis], reading.wrong[doubtful, axis] = odds, wrong
        reading.order[doubtful, axis] = in_order(place, shift, fits, codec)
    with np.errstate(over="ignore"):
        others = UNLISTED * rivals + np.exp(-reading.odds) + STRANGE * np.exp(-reading.order)
    result: NDArray[np.float64] = (1 / (1 + others)).prod(axis=1)
    return result


def _decoded(
    reading: Reading,
    confidence: NDArray[np.float64],
    bits: NDArray[np.float32],
    unused: tuple[int, int],
) -> Decoded:
    """``bits`` are those of the square window; the last ``unused`` rows, columns are filling."""
    place = reading.place
    # A corner that no dot holds may lie before the first place.
    wraps = place + reading.first >= SECTION_LENGTH
    straddles: NDArray[np.bool_] = (
        ~wraps & (reading.last >= 0) & (place + reading.last >= SECTION_LENGTH)
    )
    at = np.where(wraps, place - SECTION_LENGTH, place)
    # Which printed sides the filling lies before, seen below and to the right, by rotation.
    rows, columns = unused
    before = np.array([[0, 0], [rows, 0], [columns, rows], [0, columns]])[reading.rotation]
    border = straddles[:, 0] | straddles[:, 1]
    return Decoded(
        x=at[:, 0] + before[:, 0],
        y=at[:, 1] + before[:, 1],
        section=(reading.shift - at[:, ::-1]) % MAIN_SEQUENCE_LENGTH,
        rotation=reading.rotation,
        dots=np.count_nonzero(bits, axis=(1, 2)),
        corrected=reading.wrong.sum(axis=1),
        confidence=np.where(border, 0.0, confidence),
        border=border,
    )


def _square(bits: NDArray[np.float32]) -> NDArray[np.float32]:
    n, rows, columns = bits.shape
    if rows == columns:
        return bits
    length = max(rows, columns)
    result = np.zeros((n, length, length), np.float32)
    result[:, :rows, :columns] = bits
    return result
