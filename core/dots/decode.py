"""Soft decoding: the place of a window of the pattern from all dots that are seen of it.

Each dot gives the logarithm of how much likelier either of its bits is one than zero (0
where the dot is missing); each column and row is correlated with all 63 phases of the main
sequence; the differences of neighbouring phases vote, by how sure both are, for all places
of the four secondary sequences. Then the pattern at the winning place is compared with
every dot; where that leaves a doubt, the likeliest few places are, and share the confidence.

The evidence for an axis is the logarithm of how much likelier its dots are at that place
than if their bits were random. Before the dots are seen, one of ``4 * 63 * RANGE`` places,
sections and orientations is as likely as the next; by this the evidence is lowered, so
that random bits pass a confidence of 1 - p with a probability below p, however many places
were tried.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots import sequences
from locatk.core.dots.codec import MAIN, PERIOD, RANGE, Codec
from locatk.core.errors import InputError
from locatk.core.kernels import kernels

PLACES = math.log(4 * PERIOD * RANGE)
"""Logarithm of the number of hypotheses an axis."""

THRESHOLD = 0.999
"""Least confidence of an accepted answer."""

SURE = 40.0
"""Log odds from which no other place can come near, wrong bits or not."""

LONGEST = 64
"""Most columns and rows of a window."""

NARROW = 16
"""Columns up to which a window is worth a second look when it cannot be read."""

LIST = 6
"""Residues of each secondary sequence that are joined into candidates."""

CANDIDATES = 48
"""Places that are compared with the whole window."""

SIGNS = 2.0 * MAIN.astype(np.float32) - 1.0


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
        Whether dots are seen on both sides of the border of a section.
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
    x_bits, y_bits = _square(column_bits), _square(row_bits)
    reading = _read(x_bits, y_bits, codec)
    confidence = _settle(reading, x_bits, y_bits, codec)
    doubtful = np.flatnonzero(confidence < THRESHOLD)
    if len(doubtful) and x_bits.shape[1] <= NARROW:
        # In small windows a few wrong bits may hide which way is up.
        windows = x_bits[doubtful], y_bits[doubtful]
        second = np.argsort(-_turns(*windows), axis=0)[1]
        other = _read_turned(*windows, second, codec)
        other_confidence = _settle(other, *windows, codec)
        better = other_confidence > confidence[doubtful]
        for mine, its in zip(reading, other, strict=True):
            mine[doubtful[better]] = its[better]
        confidence[doubtful[better]] = other_confidence[better]
    return _decoded(reading, confidence, np.count_nonzero(x_bits, axis=(1, 2)))


class Reading(NamedTuple):
    """A reading of n windows, x before y in each last axis of two.

    Attributes
    ----------
    rotation : (n,) int64 ndarray
    place, shift : (n, 2) int64 ndarray
        Of the printed corner, modulo :data:`RANGE`; of the phases, modulo 63.
    wrong : (n, 2) int64 ndarray
        Bits that differ from the pattern there.
    first, last : (n, 2) int64 ndarray
        Printed columns and rows in which dots are seen.
    odds : (n, 2) float64 ndarray
        Logarithm of the odds for the place against random bits.
    """

    rotation: NDArray[np.int64]
    place: NDArray[np.int64]
    shift: NDArray[np.int64]
    wrong: NDArray[np.int64]
    first: NDArray[np.int64]
    last: NDArray[np.int64]
    odds: NDArray[np.float64]


def _read(x_bits: NDArray[np.float32], y_bits: NDArray[np.float32], codec: Codec) -> Reading:
    """First reading of (n, length, length) windows: the likeliest phases vote."""
    if kernels is None:
        return read_numpy(x_bits, y_bits, codec)
    n, length, _ = x_bits.shape
    whole, odds = np.empty((n, 11), np.int64), np.empty((n, 2))
    kernels.read_windows(
        np.ascontiguousarray(x_bits),
        np.ascontiguousarray(y_bits),
        *(n, length),
        *kernel_tables(codec),
        *(RANGE, sequences.SMALLEST_SHIFT, PLACES),
        *(whole, odds),
    )
    columns = whole[:, 1:].reshape(n, 2, 5)
    return Reading(whole[:, 0], *(columns[..., k] for k in range(5)), odds)


def read_numpy(x_bits: NDArray[np.float32], y_bits: NDArray[np.float32], codec: Codec) -> Reading:
    """First reading without the compiled kernel."""
    return _read_turned(x_bits, y_bits, _turns(x_bits, y_bits).argmax(axis=0), codec)


def _turns(x_bits: NDArray[np.float32], y_bits: NDArray[np.float32]) -> NDArray[np.float32]:
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


def _read_turned(
    x_bits: NDArray[np.float32],
    y_bits: NDArray[np.float32],
    rotation: NDArray[np.int64],
    codec: Codec,
) -> Reading:
    """Reading at known rotations."""
    printed = _turned(x_bits, y_bits, rotation)
    answers = []
    for bits in (printed[0].transpose(0, 2, 1), printed[1]):
        place, shift = _vote(_scores(bits), codec)
        odds, wrong = _compare(place, shift, bits, codec)
        seen = (bits != 0).any(axis=2)
        first = np.where(seen.any(axis=1), seen.argmax(axis=1), seen.shape[1])
        last = np.where(seen.any(axis=1), seen.shape[1] - 1 - seen[:, ::-1].argmax(axis=1), -1)
        answers.append((place, shift, wrong, first, last, odds))
    place, shift, wrong, first, last, odds = (
        np.stack(pair, axis=1) for pair in zip(*answers, strict=True)
    )
    return Reading(rotation, place, shift, wrong, first, last, odds)


def _settle(
    reading: Reading, x_bits: NDArray[np.float32], y_bits: NDArray[np.float32], codec: Codec
) -> NDArray[np.float64]:
    """Confidence (n,) of a reading; in doubt a search finds a better one, put in its place."""
    rivals = np.zeros_like(reading.odds)
    for axis in range(2):
        doubtful = np.flatnonzero((reading.odds[:, axis] < SURE) & (reading.wrong[:, axis] > 0))
        if not len(doubtful):
            continue
        printed = _turned(x_bits[doubtful], y_bits[doubtful], reading.rotation[doubtful])
        bits = printed[1] if axis else printed[0].transpose(0, 2, 1)
        place, shift, rivals[doubtful, axis] = _search(_scores(bits), codec)
        reading.place[doubtful, axis], reading.shift[doubtful, axis] = place, shift
        odds, wrong = _compare(place, shift, bits, codec)
        reading.odds[doubtful, axis], reading.wrong[doubtful, axis] = odds, wrong
    with np.errstate(over="ignore"):
        result: NDArray[np.float64] = (1 / (1 + rivals + np.exp(-reading.odds))).prod(axis=1)
    return result


def _decoded(reading: Reading, confidence: NDArray[np.float64], dots: NDArray[np.int64]) -> Decoded:
    place = reading.place
    # A corner that no dot holds may lie before the first place.
    wraps = place + reading.first >= RANGE
    straddles: NDArray[np.bool_] = ~wraps & (reading.last >= 0) & (place + reading.last >= RANGE)
    at = np.where(wraps, place - RANGE, place)
    return Decoded(
        x=at[:, 0],
        y=at[:, 1],
        section=(reading.shift - place[:, ::-1]) % PERIOD,
        rotation=reading.rotation,
        dots=dots,
        corrected=reading.wrong.sum(axis=1),
        confidence=confidence,
        border=straddles[:, 0] | straddles[:, 1],
    )


def _square(bits: NDArray[np.float32]) -> NDArray[np.float32]:
    n, rows, columns = bits.shape
    if max(rows, columns) > LONGEST:
        raise InputError(f"a window of {columns} x {rows} places, more than {LONGEST}")
    if rows == columns:
        return bits
    length = max(rows, columns)
    result = np.zeros((n, length, length), np.float32)
    result[:, :rows, :columns] = bits
    return result


@functools.lru_cache(8)
def _templates(length: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(length, 63) main sequence from each phase; read backwards and inverted likewise."""
    forwards = SIGNS[np.add.outer(np.arange(length), np.arange(PERIOD)) % PERIOD]
    return forwards, np.ascontiguousarray(-forwards[::-1])


def _scores(bits: NDArray[np.float32]) -> NDArray[np.float32]:
    """(n, length, 63) fit of each line to the main sequence from each phase on."""
    result: NDArray[np.float32] = bits @ _templates(bits.shape[2])[0]
    return result


def _turned(
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


def _vote(scores: NDArray[np.float32], codec: Codec) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Place (n,) and shift of the phases (n,) by the likeliest phase of each column."""
    n, length, _ = scores.shape
    phase = scores.argmax(axis=2)
    top = np.take_along_axis(scores, phase[..., None], axis=2)[..., 0]
    rivals = scores.copy()
    np.put_along_axis(rivals, phase[..., None], -np.inf, axis=2)
    margin = top - rivals.max(axis=2)

    difference = (phase[:, 1:] - phase[:, :-1]) % PERIOD
    weight = np.minimum(margin[:, 1:], margin[:, :-1])
    residues = np.empty((n, 4), np.int64)
    for k, (digits, votes) in enumerate(zip(_digits(), _ballots(codec, length - 1), strict=True)):
        ballot = digits[difference] * weight[..., None]
        residues[:, k] = (ballot.reshape(n, -1) @ votes).argmax(axis=1)
    place = codec.place(residues)
    shifts = (phase - codec.phases(place[:, None] + np.arange(length))) % PERIOD
    ballots = np.bincount(
        (shifts + PERIOD * np.arange(n)[:, None]).ravel(), margin.ravel(), PERIOD * n
    )
    return place, ballots.reshape(n, PERIOD).argmax(axis=1)


def _search(
    scores: NDArray[np.float32], codec: Codec
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Likeliest place (n,) and shift (n,), and how likely the rest is relative to it (n,).

    All phases of a column stay in play: the differences of two columns have the circular
    correlation of both posteriors, and each digit its marginal. The best few residues of
    each secondary sequence, joined, are compared with all columns at all shifts.
    """
    n, length, _ = scores.shape
    posterior = np.exp(0.5 * (scores - scores.max(axis=2, keepdims=True)).astype(np.float64))
    posterior /= posterior.sum(axis=2, keepdims=True)
    spectrum = np.fft.rfft(posterior, axis=2)
    difference = np.fft.irfft(spectrum[:, 1:] * spectrum[:, :-1].conj(), PERIOD, axis=2)
    totals, residues = np.zeros((n, 1)), np.zeros((n, 1, 0), np.int64)
    for digits, votes in zip(_digits(), _ballots(codec, length - 1), strict=True):
        marginal = np.log(np.maximum(difference, 0) @ digits + 1e-4)
        votes_of = marginal.reshape(n, -1) @ votes
        best = np.argsort(-votes_of, axis=1)[:, :LIST]
        sums = totals[:, :, None] + np.take_along_axis(votes_of, best, axis=1)[:, None]
        kept = np.argsort(-sums.reshape(n, -1), axis=1)[:, :CANDIDATES]
        totals = np.take_along_axis(sums.reshape(n, -1), kept, axis=1)
        old, new = np.divmod(kept, best.shape[1])
        residues = np.concatenate(
            [
                np.take_along_axis(residues, old[..., None], axis=1),
                np.take_along_axis(best, new, axis=1)[..., None],
            ],
            axis=2,
        )
    places = codec.place(residues)
    steps = np.arange(length)
    phases = codec.phases(places[..., None] + steps)
    # One shift at a time: (n, candidates, length) scores are picked for each of 63.
    row = np.arange(n)[:, None, None]
    joint = np.stack(
        [scores[row, steps, (phases + k) % PERIOD].sum(axis=2) for k in range(PERIOD)], axis=2
    ).astype(np.float64)
    joint = 0.5 * joint.reshape(n, -1)
    winner = joint.argmax(axis=1)
    rivals = np.exp(joint - joint.max(axis=1, keepdims=True)).sum(axis=1) - 1
    which, shift = np.divmod(winner, PERIOD)
    return places[np.arange(n), which], shift, rivals


def _compare(
    place: NDArray[np.int64], shift: NDArray[np.int64], bits: NDArray[np.float32], codec: Codec
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Log odds (n,) that ``bits`` are those at ``place``, and how many of them are wrong."""
    n, length, _ = bits.shape
    steps = np.arange(length)
    phase = codec.phases(place[:, None] + steps) + shift[:, None]
    window, column, row = np.nonzero(bits)
    agreement = bits[window, column, row] * SIGNS[(phase[window, column] + row) % PERIOD]
    gain = math.log(2) - np.log1p(np.exp(-agreement))
    odds = np.bincount(window, gain.astype(np.float64), n) - PLACES
    wrong = np.bincount(window[agreement < 0], minlength=n).astype(np.int64)
    return odds, wrong


@functools.cache
def _digits() -> tuple[NDArray[np.float32], ...]:
    """Four (63, base) tables: one at the digit of a difference; none for impossible ones."""
    tables = []
    for weight, base in zip(sequences.WEIGHTS, sequences.BASES, strict=True):
        table = np.zeros((PERIOD, base), np.float32)
        for difference in range(sequences.SMALLEST_SHIFT, PERIOD - 4):
            digit = (difference - sequences.SMALLEST_SHIFT) // weight % base
            table[difference, digit] = 1
        tables.append(table)
    return tuple(tables)


@functools.lru_cache(16)
def _ballots(codec: Codec, length: int) -> tuple[NDArray[np.float32], ...]:
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
    digit = np.full((4, PERIOD), -1, np.int8)
    for k, (digits, table) in enumerate(zip(codec.digits, _digits(), strict=True)):
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
        SIGNS[np.arange(LONGEST + PERIOD) % PERIOD],
        digit,
        masks,
    )
