"""Soft decoding: position, section and rotation of windows of the pattern, from all of their dots.

The evidence for a position on an axis is the logarithm of how much likelier its dots are there than
if their bits were random. Without the dots each of ``4 * 63 * SECTION_LENGTH`` orientations,
sections and positions is equally likely; the logarithm of their number is subtracted from the
evidence, so that random bits pass a confidence of 1 - p with a probability below p, whatever the
number of hypotheses tested. A sheet of another codec has no random bits: columns of the main
sequence in any order are another hypothesis.

:mod:`~locatk.core.dots.identification.phase_voting` estimates a position first. A few wrong bits in
a small window may result in two positions that differ in the phase of a single column; neither the
votes nor the evidence for one position alone reveal the other. In doubt a search therefore lists
candidates, from all phases of all columns and from combinations of the phases of the least certain
columns, and compares the whole window with each; the likelihoods of the others reduce the
confidence.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.codec import MAIN_SEQUENCE_LENGTH, SECTION_LENGTH, Codec, sequences
from locatk.core.dots.codec.lookup import decode_exact
from locatk.core.dots.identification.phase_voting import (
    LOG_HYPOTHESES,
    MAX_LIKELY_PHASE_GAP,
    MAX_WINDOW_LINES,
    Bits,
    Integers,
    WindowEstimates,
    ballot_tables,
    compare_with_any_order,
    compare_with_pattern,
    digit_tables,
    estimate_rotated_windows,
    estimate_windows,
    following_phases,
    kernel_tables,
    phase_scores,
    rotate_to_print,
    rotation_scores,
)
from locatk.core.dots.identification.rival_codecs import (
    CoreLines,
    core_lines,
    has_rivals,
    other_codecs,
    rival_likelihood,
)
from locatk.core.errors import InputError
from locatk.core.kernels import kernels

MIN_CONFIDENCE = 0.999
"""Least confidence of an accepted result."""

MIN_CODE_CONFIDENCE = 0.5
"""Confidence below which a window contains no position of the codec; between this and the threshold
the position is doubtful."""

MIN_LOG_ODDS = math.log(MIN_CONFIDENCE / (1 - MIN_CONFIDENCE))
"""Log odds of :data:`MIN_CONFIDENCE`."""

OTHER_CODEC_ODDS = 0.01
"""Prior odds that the sheet is one of another codec, if nothing but its dots is known."""

AGREEING_AXIS_FRACTION = 0.04
"""Fraction of the positions of a related codec at which one axis agrees with the selected codec
and the other has columns that fit no position: of the 241 positions of the sequence in which
``libdots`` and ``anoto`` differ, ten with eight columns."""

UNLISTED_RIVALS_FACTOR = 2.0
"""Ratio of the likelihood of all rivals of a position to that of those in the list: a list of the
first search contains half of what one of twenty times its width does (44 to 58 % on average, in
windows of 8 x 8 with one or two wrong bits)."""

CERTAIN_LOG_ODDS = 40.0
"""Log odds beyond which no other position is nearly as likely, even if bits are wrong."""

MAX_CERTAIN_WRONG_FRACTION = 0.08
"""Fraction of wrong bits beyond which another position may be as likely, whatever the odds."""

MIN_CERTAIN_LEAD = 16.0
"""Lead in votes from which no other position can be the right one; a lead below it may rest on a
single bit (twice 8) of a single line."""

MAX_SMALL_WINDOW_LINES = 16
"""Columns and rows up to which a window is decoded by look-up, if no bit is wrong."""

MAX_SMALL_WINDOW_DOTS = 128
"""Dots up to which a window is small, half of those of 16 columns and rows: short lines and wrong
bits may hide its rotation or its position, so that the second rotation, misread columns and more
candidates are tried too."""

MIN_EXACT_LINES = 8
"""Columns and rows from which a window without a wrong bit has one position only."""

FIRST_BEAM_WIDTH, SECOND_BEAM_WIDTH = 48, 256
"""Number of candidates of the first search, and of the second one of windows with few dots."""

MISREAD_COLUMNS = 4
"""Number of columns, the least certain ones, whose alternative phases are combined."""

PHASES_PER_MISREAD_COLUMN = 3
"""Number of phases of such a column that are tried, most likely first."""

MIN_MARGINAL_PROBABILITY = 1e-4
"""Added to the marginal probability of a digit, so that one misread column excludes no residue."""


@dataclass(frozen=True)
class DecodedWindows:
    """Results for n windows; the first axis of each array is the window.

    Attributes
    ----------
    x, y : (n,) int64 ndarray
        Grid coordinates of the printed window's upper left corner. If no dots are observed there
        the corner may be outside of the section, with a negative coordinate.
    section : (n, 2) int64 ndarray
    rotation : (n,) int64 ndarray
        Counter-clockwise quarter turns of the print in the image.
    dots : (n,) int64 ndarray
        Number of dots.
    corrected : (n,) int64 ndarray
        Number of wrong bits.
    confidence : (n,) float64 ndarray
        Probability that the result is right; accept from :data:`MIN_CONFIDENCE` on.
    border : (n,) bool ndarray
        Whether there are dots on both sides of the border of a section; such a window has no
        confidence.
    rival_odds : (n,) float64 ndarray
        Odds that the window is one of another codec at another position, included in the
        confidence.
    """

    x: Integers
    y: Integers
    section: Integers
    rotation: Integers
    dots: Integers
    corrected: Integers
    confidence: NDArray[np.float64]
    border: NDArray[np.bool_]
    rival_odds: NDArray[np.float64]

    def select(self, indices: NDArray[np.int64]) -> DecodedWindows:
        """Return the results for some of the windows."""
        return DecodedWindows(*(getattr(self, f.name)[indices] for f in fields(DecodedWindows)))


def identify_windows(
    column_bits: Bits,
    row_bits: Bits,
    codec: Codec,
    *,
    is_thorough: bool = True,
    other_codec_odds: float = OTHER_CODEC_ODDS,
) -> DecodedWindows:
    """Decode position, section and rotation of n windows.

    Parameters
    ----------
    column_bits, row_bits : (n, rows, columns) float32 ndarray
        As observed, in any rotation: log likelihood ratio that the dot is displaced left or down
        (column bit 1), and right or down (row bit 1); 0 without a dot. Bits of symbols that are
        certain: plus or minus 7.
    codec : Codec
    is_thorough : bool
        Search small windows twice if they have no certain position.
    other_codec_odds : float
        Prior odds that the sheet is one of another known codec; 0 if its codec is certain.

    Raises
    ------
    InputError
        A window has more than :data:`~.phase_voting.MAX_WINDOW_LINES` columns or rows.
    """
    _, rows, columns = column_bits.shape
    if max(rows, columns) > MAX_WINDOW_LINES:
        raise InputError(f"a window of {columns} x {rows} positions, more than {MAX_WINDOW_LINES}")
    if MIN_EXACT_LINES <= min(rows, columns) <= max(rows, columns) <= MAX_SMALL_WINDOW_LINES:
        result = _decode_exact(column_bits, row_bits, codec)
        doubtful = np.flatnonzero(result.confidence < MIN_CONFIDENCE)
    else:
        result = _decode_soft(column_bits, row_bits, codec, is_thorough)
        doubtful = np.empty(0, np.intp)
    if len(doubtful):
        soft = _decode_soft(column_bits[doubtful], row_bits[doubtful], codec, is_thorough)
        for field in fields(DecodedWindows):
            getattr(result, field.name)[doubtful] = getattr(soft, field.name)
    if other_codec_odds:
        decoded = np.flatnonzero(result.confidence >= MIN_CODE_CONFIDENCE)
        odds = other_codec_odds * _rival_likelihood(result, column_bits, row_bits, decoded, codec)
        result.rival_odds[decoded] = odds
        result.confidence[decoded] /= 1 + result.confidence[decoded] * odds
    return result


def _decode_exact(column_bits: Bits, row_bits: Bits, codec: Codec) -> DecodedWindows:
    """Decode windows without a missing or wrong dot by look-up; others get no confidence."""
    weakest = np.minimum(np.abs(column_bits), np.abs(row_bits)).min(axis=(1, 2))
    symbols = (column_bits > 0) + 2 * (row_bits > 0).astype(np.uint8)
    exact = decode_exact(symbols, codec)
    n, rows, columns = symbols.shape
    # A lower bound: all bits as uncertain as the least certain one.
    gain = math.log(2) - np.log1p(np.exp(-weakest.astype(np.float64)))
    log_odds = rows * columns * gain - LOG_HYPOTHESES
    return DecodedWindows(
        exact.x,
        exact.y,
        exact.section,
        exact.rotation,
        dots=np.full(n, rows * columns),
        corrected=np.zeros(n, np.int64),
        confidence=np.where(exact.ok & (weakest > 0), (1 + np.exp(-log_odds)) ** -2, 0.0),
        border=np.zeros(n, np.bool_),
        rival_odds=np.zeros(n),
    )


def _decode_soft(
    column_bits: Bits, row_bits: Bits, codec: Codec, is_thorough: bool
) -> DecodedWindows:
    """Decode windows with missing or wrong dots."""
    windows = _pad_to_square(column_bits), _pad_to_square(row_bits)
    length = windows[0].shape[1]
    estimates = estimate_windows(*windows, codec)
    confidence = resolve_doubts(estimates, *windows, codec)
    dots = np.count_nonzero(windows[0], axis=(1, 2))
    doubtful = np.flatnonzero((confidence < MIN_CONFIDENCE) & (dots <= MAX_SMALL_WINDOW_DOTS))
    if is_thorough and len(doubtful):
        scores = rotation_scores(windows[0][doubtful], windows[1][doubtful])
        evidence = 0.5 * scores - sum(_random_evidence(bits[doubtful]) for bits in windows)
        # Both axes need that much, even if each line had its best phase.
        is_possible = evidence > 2 * (LOG_HYPOTHESES + MIN_LOG_ODDS)
        for rotation in np.argsort(-scores, axis=0)[:2]:
            kept = is_possible[rotation, np.arange(len(doubtful))]
            if not kept.any():
                continue
            chosen = doubtful[kept]
            part = windows[0][chosen], windows[1][chosen]
            other = estimate_rotated_windows(*part, rotation[kept], codec)
            other_confidence = resolve_doubts(other, *part, codec, beam_width=SECOND_BEAM_WIDTH)
            better = other_confidence > confidence[chosen]
            for values, other_values in zip(estimates, other, strict=True):
                values[chosen[better]] = other_values[better]
            confidence[chosen[better]] = other_confidence[better]
    _, rows, columns = column_bits.shape
    return as_decoded(estimates, confidence, dots, (length - rows, length - columns))


def resolve_doubts(
    estimates: WindowEstimates,
    column_bits: Bits,
    row_bits: Bits,
    codec: Codec,
    *,
    beam_width: int = FIRST_BEAM_WIDTH,
) -> NDArray[np.float64]:
    """Return the confidence (n,) of estimates; search for better ones if in doubt.

    A better position and its evidence replace those in ``estimates``.
    """
    rivals = np.zeros_like(estimates.log_odds)
    is_doubtful = (estimates.wrong > 0) & (estimates.log_odds < CERTAIN_LOG_ODDS)
    is_doubtful |= estimates.lead < MIN_CERTAIN_LEAD
    dots = np.count_nonzero(column_bits, axis=(1, 2))
    is_doubtful |= estimates.wrong > MAX_CERTAIN_WRONG_FRACTION * dots[:, None]
    if is_doubtful.any():
        is_small = dots <= MAX_SMALL_WINDOW_DOTS
        for axis in range(2):
            if axis:
                # The second axis cannot save a window whose first axis has no position.
                alternatives = _alternatives(estimates, rivals)
                is_doubtful[:, axis] &= alternatives[:, 0] < 1 - MIN_CONFIDENCE
            for kind in (is_small, ~is_small):
                doubtful = np.flatnonzero(is_doubtful[:, axis] & kind)
                rivals[doubtful, axis] = _search_axis(
                    estimates,
                    doubtful,
                    axis,
                    (column_bits, row_bits),
                    codec,
                    try_misread_columns=kind is is_small,
                    beam_width=beam_width,
                )
    with np.errstate(over="ignore"):
        foreign = OTHER_CODEC_ODDS * np.exp(-estimates.order_log_odds.sum(axis=1))
    likelihood = 1 / (1 + _alternatives(estimates, rivals))
    result: NDArray[np.float64] = likelihood[:, 0] * likelihood[:, 1] / (1 + foreign)
    return result


def _alternatives(estimates: WindowEstimates, rivals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the odds (n, 2) against the position on each axis."""
    foreign = OTHER_CODEC_ODDS * AGREEING_AXIS_FRACTION
    with np.errstate(over="ignore"):
        result: NDArray[np.float64] = UNLISTED_RIVALS_FACTOR * rivals + np.exp(-estimates.log_odds)
        result += foreign * np.exp(-estimates.order_log_odds)
    return result


def _search_axis(
    estimates: WindowEstimates,
    doubtful: Integers,
    axis: int,
    bits: tuple[Bits, Bits],
    codec: Codec,
    *,
    try_misread_columns: bool,
    beam_width: int,
) -> NDArray[np.float64]:
    """Search the positions of doubtful windows (k,) on an axis, and replace those in ``estimates``.

    Return the likelihood (k,) of rivals; 0 for windows that cannot be accepted in any case.
    """
    rivals = np.zeros(len(doubtful))
    if not len(doubtful):
        return rivals
    printed = rotate_to_print(bits[0][doubtful], bits[1][doubtful], estimates.rotation[doubtful])
    lines = printed[1] if axis else printed[0].transpose(0, 2, 1)
    scores = phase_scores(lines)
    kept = is_decodable(lines, scores)
    if not kept.any():
        return rivals
    doubtful, lines, scores = doubtful[kept], lines[kept], scores[kept]
    position, shift, rivals[kept] = search_position(
        scores, codec, try_misread_columns=try_misread_columns, beam_width=beam_width
    )
    estimates.position[doubtful, axis], estimates.shift[doubtful, axis] = position, shift
    log_odds, wrong = compare_with_pattern(position, shift, lines, codec)
    estimates.log_odds[doubtful, axis], estimates.wrong[doubtful, axis] = log_odds, wrong
    estimates.order_log_odds[doubtful, axis] = compare_with_any_order(
        position, shift, scores, codec
    )
    return rivals


def is_decodable(lines: Bits, scores: Bits) -> NDArray[np.bool_]:
    """Return whether windows (n,) could be accepted if each line had its best phase."""
    best = scores.max(axis=2)
    evidence = 0.5 * best.sum(axis=1) - _random_evidence(lines)
    likely = (scores > best[..., None] - MAX_LIKELY_PHASE_GAP).sum(axis=2)
    order = np.log(MAIN_SEQUENCE_LENGTH / likely).sum(axis=1)
    result: NDArray[np.bool_] = (evidence > LOG_HYPOTHESES + MIN_LOG_ODDS) & (
        order > LOG_HYPOTHESES + MIN_LOG_ODDS + math.log(OTHER_CODEC_ODDS * AGREEING_AXIS_FRACTION)
    )
    return result


def _random_evidence(bits: Bits) -> NDArray[np.float64]:
    """Return the log likelihood (n,) of windows of random bits, where half the sum of the bits'
    correlation with a pattern is that of the pattern.
    """
    flat = bits.reshape(len(bits), -1)
    window, dot = np.nonzero(flat)
    evidence = np.log(np.cosh(0.5 * flat[window, dot]))
    result: NDArray[np.float64] = np.bincount(window, evidence, len(flat)).astype(np.float64)
    return result


def as_decoded(
    estimates: WindowEstimates,
    confidence: NDArray[np.float64],
    dots: Integers,
    padding: tuple[int, int],
) -> DecodedWindows:
    """Return the results of square windows whose last rows and columns are ``padding``."""
    position = estimates.position
    # A corner without dots may be before the first position of the section.
    wraps = position + estimates.first >= SECTION_LENGTH
    crosses: NDArray[np.bool_] = (
        ~wraps & (estimates.last >= 0) & (position + estimates.last >= SECTION_LENGTH)
    )
    corner = np.where(wraps, position - SECTION_LENGTH, position)
    before = _printed_padding(estimates.rotation, padding)
    border = crosses[:, 0] | crosses[:, 1]
    return DecodedWindows(
        x=corner[:, 0] + before[:, 0],
        y=corner[:, 1] + before[:, 1],
        section=(estimates.shift - corner[:, ::-1]) % MAIN_SEQUENCE_LENGTH,
        rotation=estimates.rotation,
        dots=dots,
        corrected=estimates.wrong.sum(axis=1),
        confidence=np.where(border, 0.0, confidence),
        border=border,
        rival_odds=np.zeros(len(dots)),
    )


def _rival_likelihood(
    decoded: DecodedWindows,
    column_bits: Bits,
    row_bits: Bits,
    chosen: NDArray[np.intp],
    codec: Codec,
) -> NDArray[np.float64]:
    """Return how likely other codecs are, relative to the ``chosen`` (m,) decoded windows.

    It is the mean over the other known codecs, so that its product with the prior odds that the
    sheet is one of these are the posterior odds against the decoded position.
    """
    result = np.zeros(len(chosen))
    if not len(chosen):
        return result
    _, rows, columns = column_bits.shape
    length = max(rows, columns)
    bits = _pad_to_square(column_bits[chosen]), _pad_to_square(row_bits[chosen])
    rotation, section = decoded.rotation[chosen], decoded.section[chosen]
    corner = np.stack([decoded.x[chosen], decoded.y[chosen]], axis=1)
    corner -= _printed_padding(rotation, (length - rows, length - columns))
    core = core_lines(bits[0] != 0, rotation, decoded.corrected[chosen])
    others = other_codecs(codec)
    for other, is_possible in zip(others, has_rivals(core, corner, codec).T, strict=True):
        k = np.flatnonzero(is_possible)
        if len(k):
            printed = rotate_to_print(bits[0][k], bits[1][k], rotation[k])
            result[k] += rival_likelihood(
                np.stack([printed[0].transpose(0, 2, 1), printed[1]], axis=1),
                corner[k] % SECTION_LENGTH,
                (section[k] + corner[k, ::-1]) % MAIN_SEQUENCE_LENGTH,
                CoreLines(*(v[k] for v in core)),
                (codec, other),
            ) / len(others)
    return result


def _printed_padding(rotation: Integers, padding: tuple[int, int]) -> Integers:
    """Return the width (n, 2) on the printed left and top of rows and columns of padding.

    In the image they are below and on the right.
    """
    rows, columns = padding
    widths = np.array([[0, 0], [rows, 0], [columns, rows], [0, columns]])
    result: Integers = widths[rotation]
    return result


def _pad_to_square(bits: Bits) -> Bits:
    """Add missing dots below or on the right so that windows are square."""
    n, rows, columns = bits.shape
    if rows == columns:
        return bits
    length = max(rows, columns)
    result = np.zeros((n, length, length), np.float32)
    result[:, :rows, :columns] = bits
    return result


# ---- search among many candidates


def search_position(
    scores: Bits, codec: Codec, *, try_misread_columns: bool, beam_width: int = FIRST_BEAM_WIDTH
) -> tuple[Integers, Integers, NDArray[np.float64]]:
    """Search the most likely position on an axis of n windows.

    Parameters
    ----------
    scores : (n, length, 63) float32 ndarray
        :func:`~.phase_voting.phase_scores` of the columns (or rows).
    codec : Codec
    try_misread_columns : bool
        Combine phases of the least certain columns too; in large windows they leave no rival.
    beam_width : int

    Returns
    -------
    position, shift : (n,) int64 ndarray
    rivals : (n,) float64 ndarray
        Likelihood of the other candidates relative to this one.
    """
    if kernels is None:
        return search_position_numpy(
            scores, codec, try_misread_columns=try_misread_columns, beam_width=beam_width
        )
    n, length, _ = scores.shape
    positions, rivals = np.empty((n, 2), np.int64), np.empty(n)
    kernels.search_positions(
        np.ascontiguousarray(scores),
        *(n, length),
        *kernel_tables(codec),
        *(SECTION_LENGTH, sequences.MIN_SHIFT),
        *(beam_width, MISREAD_COLUMNS if try_misread_columns else 0, PHASES_PER_MISREAD_COLUMN),
        *(MIN_MARGINAL_PROBABILITY, positions, rivals),
    )
    return positions[:, 0], positions[:, 1], rivals


def search_position_numpy(
    scores: Bits, codec: Codec, *, try_misread_columns: bool, beam_width: int = FIRST_BEAM_WIDTH
) -> tuple[Integers, Integers, NDArray[np.float64]]:
    """Search positions as :func:`search_position`, without the compiled kernel."""
    n, length, _ = scores.shape
    candidates = _likely_candidates(scores, codec, beam_width)
    if try_misread_columns:
        misread = _candidates_from_misread_columns(scores, codec)
        candidates = np.concatenate([candidates, misread], axis=1)
    candidates = np.sort(candidates, axis=1)
    is_repeated = candidates[:, 1:] == candidates[:, :-1]
    phases = following_phases(candidates, length, codec)
    # The scores of all shifts from each phase on are contiguous in a doubled row of scores.
    doubled = np.concatenate([scores, scores[..., :-1]], axis=2)
    shifted = np.lib.stride_tricks.sliding_window_view(doubled, MAIN_SEQUENCE_LENGTH, axis=2)
    window = np.arange(n)[:, None]
    joint = np.zeros((*candidates.shape, MAIN_SEQUENCE_LENGTH))
    for column in range(length):
        joint += shifted[window, column, phases[..., column]]
    joint[:, 1:][is_repeated] = -np.inf
    log_likelihood = 0.5 * joint.reshape(n, -1)
    best = log_likelihood.argmax(axis=1)
    largest = log_likelihood.max(axis=1, keepdims=True)
    rivals = np.exp(log_likelihood - largest).sum(axis=1) - 1
    index, shift = np.divmod(best, MAIN_SEQUENCE_LENGTH)
    return candidates[np.arange(n), index], shift, rivals


def _likely_candidates(scores: Bits, codec: Codec, beam_width: int) -> Integers:
    """Return the positions (n, candidates) that the shifts between adjacent columns make likely.

    The probability of a shift from one column to the next is the circular correlation of the
    probabilities of both phases. A beam search selects the residue of one secondary sequence after
    the other; digits of sequences that are not yet selected are marginalized.
    """
    n, length, _ = scores.shape
    posterior = np.exp(0.5 * (scores - scores.max(axis=2, keepdims=True)).astype(np.float64))
    posterior /= posterior.sum(axis=2, keepdims=True)
    spectrum = np.fft.rfft(posterior, axis=2)
    probability = np.fft.irfft(
        spectrum[:, 1:] * spectrum[:, :-1].conj(), MAIN_SEQUENCE_LENGTH, axis=2
    )
    window = np.arange(n)[:, None]
    # Axes: window, entry of the beam, step, then the digits of the last to the first sequence.
    bases = sequences.DIGIT_BASES
    shifts = slice(sequences.MIN_SHIFT, sequences.MIN_SHIFT + math.prod(bases))
    joint = (
        np.maximum(probability[:, None, :, shifts], 0)
        .astype(np.float32)
        .reshape(n, 1, length - 1, *bases[::-1])
    )
    residues = np.zeros((n, 1, 0), np.int64)
    for digits, base, ballots in zip(
        codec.digits, bases, ballot_tables(codec, length - 1), strict=True
    ):
        marginal = joint.reshape(*joint.shape[:3], -1, base).sum(axis=3)
        votes = np.log(marginal + MIN_MARGINAL_PROBABILITY).reshape(n, -1, len(ballots)) @ ballots
        votes = votes.reshape(n, -1)
        width = min(beam_width, votes.shape[1])
        kept = np.argpartition(-votes, width - 1, axis=1)[:, :width]
        entry, residue = np.divmod(kept, len(digits))
        residues = np.concatenate([residues[window, entry], residue[..., None]], axis=2)
        following = digits[(residue[..., None] + np.arange(length - 1)) % len(digits)]
        step = np.arange(length - 1)
        joint = joint[window[..., None], entry[..., None], step, ..., following]
    return codec.position(residues)


def _candidates_from_misread_columns(scores: Bits, codec: Codec) -> Integers:
    """Return positions (n, candidates) for all combinations of phases of uncertain columns.

    Columns without dots are not uncertain but unknown; they do not vote.
    """
    n, length, _ = scores.shape
    ranked = np.argsort(-scores, axis=2, kind="stable")[:, :, :PHASES_PER_MISREAD_COLUMN]
    score = np.take_along_axis(scores, ranked, axis=2)
    has_dots = (scores != 0).any(axis=2)
    lead = np.where(has_dots, score[..., 0] - score[..., 1], np.inf)
    uncertain = np.argsort(lead, axis=1, kind="stable")[:, :MISREAD_COLUMNS]
    is_step = (has_dots[:, 1:] & has_dots[:, :-1])[:, None, :, None]
    rank = np.indices((PHASES_PER_MISREAD_COLUMN,) * MISREAD_COLUMNS)
    rank = rank.reshape(MISREAD_COLUMNS, -1).T
    phases = np.repeat(ranked[:, None, :, 0], len(rank), axis=1)
    window = np.arange(n)[:, None, None]
    phases[window, np.arange(len(rank))[:, None], uncertain[:, None]] = ranked[
        window, uncertain[:, None], rank
    ]
    shift = (phases[..., 1:] - phases[..., :-1]) % MAIN_SEQUENCE_LENGTH
    residues = [
        ((digits[shift] * is_step).reshape(n, len(rank), -1) @ ballots).argmax(axis=2)
        for digits, ballots in zip(digit_tables(), ballot_tables(codec, length - 1), strict=True)
    ]
    return codec.position(np.stack(residues, axis=2))
