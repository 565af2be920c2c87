"""The likeliest place of a window whose lines of dots do not agree, and its rivals.

A few wrong bits in a small window may leave two places that differ in the phase of a single
column: neither the vote nor the evidence for one place alone shows the other. So candidates
are listed, from all phases of all columns and from all readings of the few columns that are
least sure, and compared as a whole; what the losers weigh goes into the confidence.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.codec import MAIN_SEQUENCE_LENGTH, Codec
from locatk.core.dots.identification.phase_voting import ballot_tables, digit_tables, phases_ahead

LIST = 6
"""Residues of each secondary sequence that are joined into candidates."""

CANDIDATES = 48
"""Most candidates by joined residues."""

MISREAD = 4
"""Columns, the least sure ones, all of whose readings are tried together."""

RANKS = 3
"""Phases of such a column that are tried, likeliest first."""


def search(
    scores: NDArray[np.float32], codec: Codec, *, narrow: bool
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Likeliest place (n,) and shift (n,), and how likely the rest is relative to it (n,).

    Parameters
    ----------
    scores : (n, length, 63) float32 ndarray
        Fit of each column (or row) to the main sequence from each phase on.
    codec : Codec
    narrow : bool
        Try the least sure columns as misread too; in wide windows they leave no rival.
    """
    n, length, _ = scores.shape
    places = _by_marginals(scores, codec)
    if narrow:
        places = np.concatenate([places, _by_misread_columns(scores, codec)], axis=1)
    places = np.sort(places, axis=1)
    again = places[:, 1:] == places[:, :-1]
    phases = phases_ahead(places, length, codec)
    steps = np.arange(length)
    # One shift at a time: (n, candidates, length) scores are picked for each of 63.
    row = np.arange(n)[:, None, None]
    joint = np.stack(
        [
            scores[row, steps, (phases + k) % MAIN_SEQUENCE_LENGTH].sum(axis=2)
            for k in range(MAIN_SEQUENCE_LENGTH)
        ],
        axis=2,
    ).astype(np.float64)
    joint[:, 1:][again] = -np.inf
    joint = 0.5 * joint.reshape(n, -1)
    winner = joint.argmax(axis=1)
    rivals = np.exp(joint - joint.max(axis=1, keepdims=True)).sum(axis=1) - 1
    which, shift = np.divmod(winner, MAIN_SEQUENCE_LENGTH)
    return places[np.arange(n), which], shift, rivals


def _by_marginals(scores: NDArray[np.float32], codec: Codec) -> NDArray[np.int64]:
    """(n, candidates) places from the best residues of each secondary sequence, joined.

    The differences of two columns have the circular correlation of both columns' phases,
    and each digit its marginal.
    """
    n, length, _ = scores.shape
    posterior = np.exp(0.5 * (scores - scores.max(axis=2, keepdims=True)).astype(np.float64))
    posterior /= posterior.sum(axis=2, keepdims=True)
    spectrum = np.fft.rfft(posterior, axis=2)
    difference = np.fft.irfft(
        spectrum[:, 1:] * spectrum[:, :-1].conj(), MAIN_SEQUENCE_LENGTH, axis=2
    )
    totals, residues = np.zeros((n, 1)), np.zeros((n, 1, 0), np.int64)
    for digits, votes in zip(digit_tables(), ballot_tables(codec, length - 1), strict=True):
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
    return codec.place(residues)


def _by_misread_columns(scores: NDArray[np.float32], codec: Codec) -> NDArray[np.int64]:
    """(n, RANKS ** MISREAD) places of all readings of the least sure columns."""
    n, length, _ = scores.shape
    ranked = np.argsort(-scores, axis=2)[:, :, :RANKS]
    fit = np.take_along_axis(scores, ranked, axis=2)
    unsure = np.argsort(fit[..., 0] - fit[..., 1], axis=1)[:, :MISREAD]
    rank = np.indices((RANKS,) * MISREAD).reshape(MISREAD, -1).T
    phases = np.repeat(ranked[:, None, :, 0], len(rank), axis=1)
    window = np.arange(n)[:, None, None]
    phases[window, np.arange(len(rank))[:, None], unsure[:, None]] = ranked[
        window, unsure[:, None], rank
    ]
    difference = (phases[..., 1:] - phases[..., :-1]) % MAIN_SEQUENCE_LENGTH
    residues = [
        (digits[difference].reshape(n, len(rank), -1) @ votes).argmax(axis=2)
        for digits, votes in zip(digit_tables(), ballot_tables(codec, length - 1), strict=True)
    ]
    return codec.place(np.stack(residues, axis=2))
