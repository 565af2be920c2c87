"""Coarse time offset between clocks that may differ by months, by correlating the motions.

An offset is in seconds and is added to the stamps of the estimate.
:func:`estimate_coarse_offset` finds the part of the truth that the estimate belongs to;
:func:`locatk.core.evaluation.time_offset.estimate_offset` refines the offset.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.evaluation.association import MAX_GAP_S, Pairs, interpolate_positions
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

CoarseMethod = Literal["motion", "first stamps"]
"""``motion`` if the motions were correlated. ``first stamps`` if they differ too much: then the
first stamps of estimate and truth were then assumed to be simultaneous."""

MIN_STEP_S = 0.05
"""Shortest sampling interval of the correlation. The fine search resolves the rest."""

MAX_SAMPLES = 2**17
"""Largest number of samples of a motion, which bounds memory and time of the Fourier transforms;
longer recordings are sampled at longer intervals."""

MIN_OVERLAP_FRACTION = 0.5
"""Fraction of the shorter trajectory that must overlap the longer one."""

MIN_COMMON_MOTION_FRACTION = 0.5
"""Common fraction of the motions from which on a coarse offset is accepted."""

MIN_COARSE_SPAN_S = 0.25
COARSE_SPAN_STEPS = 3
"""Search span of the fine search around an offset by motion: this many sampling intervals, but not
less than the minimum."""

ALTERNATIVE_RATIO = 2.0
ALTERNATIVE_MARGIN_FRACTION = 3e-4
"""An offset is an alternative if its fraction of motion that is not common is at most that of the
best offset times this ratio plus this margin."""

MIN_MOTION_RATIO = 1e-6
"""Sum of squares of a motion, relative to the largest over all lags, up to which it is rounding of
the Fourier transforms."""


@dataclass(frozen=True)
class CoarseOffset:
    """Coarse time offset between the clocks of estimate and truth.

    Attributes
    ----------
    offset_s : float
    span_s : float
        Largest error of the offset, to either side.
    method : str
        See :data:`CoarseMethod`.
    alternatives : int
        Number of other offsets at which the motions fit as well: a drive that repeats itself, or
        that was recorded several times, has some.
    """

    offset_s: float
    span_s: float
    method: CoarseMethod
    alternatives: int = 0


def clocks_agree(pairs: Pairs) -> bool:
    """Return True if estimate and truth of most pairs overlap by their stamps.

    A pair agrees if at least half of the shorter trajectory overlaps the longer one.
    """
    agreeing = 0
    stamps = [(e.time_ns, t.time_ns) for e, t in pairs if len(e) and len(t)]
    for estimate_ns, truth_ns in stamps:
        overlap = min(estimate_ns[-1], truth_ns[-1]) - max(estimate_ns[0], truth_ns[0])
        shorter = min(estimate_ns[-1] - estimate_ns[0], truth_ns[-1] - truth_ns[0])
        agreeing += bool(overlap >= MIN_OVERLAP_FRACTION * shorter)
    return 2 * agreeing >= len(stamps)


def estimate_coarse_offset(
    pairs: Pairs, *, align: str = "none", span_s: float = 1.0, max_gap_s: float = MAX_GAP_S
) -> CoarseOffset:
    """Find the offset at which the motions agree best, among all with at least half overlap.

    Both trajectories are sampled evenly. For every shift by whole samples, the fraction of the
    motion that estimate and truth have in common is computed, after the best translation and
    rotation in the plane (in space for ``se3`` and ``sim3``), or without any for ``none``, by
    correlating all coordinates with the fast Fourier transform. If no shift explains half of the
    motion, the first stamps are assumed to be simultaneous.

    Parameters
    ----------
    pairs : sequence of (Trajectory, Trajectory)
    align : str
        One of :data:`locatk.core.evaluation.alignment.ALIGNMENTS`.
    span_s : float
        Assumed error of the first stamps.
    max_gap_s : float
        Longer gaps are not bridged.

    Raises
    ------
    InputError
        No pair has poses in both estimate and truth.
    """
    pairs = [(e, t) for e, t in pairs if len(e) and len(t)]
    if not pairs:
        raise InputError("there are no poses to find a time offset from")
    start_ns = min(int(e.time_ns[0]) for e, _ in pairs)
    true_start_ns = min(int(t.time_ns[0]) for _, t in pairs)
    longest_ns = max(
        max(int(e.time_ns[-1]) - start_ns, int(t.time_ns[-1]) - true_start_ns) for e, t in pairs
    )
    step_ns = max(round(MIN_STEP_S * 1e9), -(-longest_ns // MAX_SAMPLES))
    sums: list[Array] = []
    for estimate, truth in pairs:
        # Without alignment both are in one frame, and positions count as well as the shape.
        true_centre = truth.position.mean(axis=0)
        centre = true_centre if align == "none" else estimate.position.mean(axis=0)
        sampled = _sample(estimate, centre, start_ns, step_ns, longest_ns, max_gap_s)
        true_sampled = _sample(truth, true_centre, true_start_ns, step_ns, longest_ns, max_gap_s)
        correlations = _correlate(*sampled, *true_sampled)
        sums = (
            correlations if not sums else [a + b for a, b in zip(sums, correlations, strict=True)]
        )
    lags = np.arange(-(len(sums[0]) // 2), (len(sums[0]) + 1) // 2)
    common = _common_motion(sums, align)
    best = int(np.argmax(common))
    base_s = (true_start_ns - start_ns) / 1e9
    if not common[best] >= MIN_COMMON_MOTION_FRACTION:
        return CoarseOffset(base_s, span_s, "first stamps")
    step_s = step_ns / 1e9
    return CoarseOffset(
        base_s + int(lags[best]) * step_s,
        max(MIN_COARSE_SPAN_S, COARSE_SPAN_STEPS * step_s),
        "motion",
        _count_peaks(common) - 1,
    )


def _sample(
    trajectory: Trajectory,
    centre: Array,
    start_ns: int,
    step_ns: int,
    longest_ns: int,
    max_gap_s: float,
) -> tuple[Array, Array]:
    """Sample positions relative to ``centre`` evenly.

    Returns the positions (m, 3), zero if unknown, and an indicator (m,) of the known ones, 0 or 1.
    """
    time_ns = start_ns + step_ns * np.arange(longest_ns // step_ns + 1)
    positions, is_known = np.zeros((len(time_ns), 3)), np.zeros(len(time_ns))
    index, interpolated = interpolate_positions(trajectory, time_ns, max_gap_s)
    positions[index] = interpolated - centre
    is_known[index] = 1.0
    return positions, is_known


def _correlate(
    estimate: Array, estimate_known: Array, truth: Array, truth_known: Array
) -> list[Array]:
    """Sum over the overlap at every lag: count, estimate, truth, their squares, and products.

    At lag k, sample i of the estimate coincides with sample i + k of the truth. Lags ascend from
    minus to plus half of the length.
    """
    size = 1 << int(2 * len(estimate_known) - 1).bit_length()

    def spectrum(values: Array) -> NDArray[np.complex128]:
        return np.fft.rfft(values, size, axis=0)

    e, t = spectrum(estimate), spectrum(truth)
    e_known, t_known = spectrum(estimate_known), spectrum(truth_known)
    e_squares, t_squares = spectrum(np.sum(estimate**2, axis=1)), spectrum(np.sum(truth**2, axis=1))

    def lagged_sum(a: NDArray[np.complex128], b: NDArray[np.complex128]) -> Array:
        return np.asarray(np.fft.fftshift(np.fft.irfft(np.conj(a) * b, size, axis=0), axes=0))

    return [
        lagged_sum(e_known, t_known),
        lagged_sum(e, t_known[:, None]),
        lagged_sum(e_known[:, None], t),
        lagged_sum(e_squares, t_known),
        lagged_sum(e_known, t_squares),
        np.stack([lagged_sum(e[:, [k]], t) for k in range(3)], axis=1),
    ]


def _common_motion(sums: list[Array], align: str) -> Array:
    """Fraction of the motion that is common to both at each lag; -1 if too little overlaps."""
    count, estimate, truth, estimate_squares, truth_squares, product = sums
    overlaps = count >= MIN_OVERLAP_FRACTION * count.max()
    n = np.where(overlaps, np.maximum(count, 1.0), 1.0)
    scatter = product - estimate[:, :, None] * truth[:, None, :] / n[:, None, None]
    # Sums of squares about the mean of the overlap; rounding of the FFT can make them negative.
    motion = np.maximum(estimate_squares - np.sum(estimate**2, axis=1) / n, 0.0)
    true_motion = np.maximum(truth_squares - np.sum(truth**2, axis=1) / n, 0.0)
    has_scale = align.startswith("sim")
    total = 2 * np.sqrt(motion * true_motion) if has_scale else motion + true_motion
    if align == "none":
        distance = estimate_squares + truth_squares - 2 * np.einsum("nkk->n", product)
        return _fraction(total - distance, total, overlaps)
    if align in ("se3", "sim3"):
        common = np.full(len(n), 0.0)
        # The best rotation attains the sum of the singular values (Umeyama, eq. 40).
        values = np.linalg.svd(scatter[overlaps], compute_uv=False)
        sign = np.sign(np.linalg.det(scatter[overlaps]))
        common[overlaps] = values[:, 0] + values[:, 1] + sign * values[:, 2]
    else:
        cosine = scatter[:, 0, 0] + scatter[:, 1, 1]
        sine = scatter[:, 0, 1] - scatter[:, 1, 0]
        common = np.hypot(cosine, sine) + scatter[:, 2, 2]
    return _fraction(2 * common, total, overlaps)


def _fraction(common: Array, total: Array, overlaps: NDArray[np.bool_]) -> Array:
    """Common motion over all motion; -1 without overlap or motion."""
    is_still = total <= MIN_MOTION_RATIO * max(float(total[overlaps].max()), 1e-300)
    return np.where(overlaps & ~is_still, common / np.where(is_still, 1.0, total), -1.0)


def _count_peaks(common: Array) -> int:
    """Count the separate offsets that fit as well as the best, from the fit at every lag.

    A peak extends to twice the limit at its top, so that noise does not split it.
    """
    left, middle, right = common[:-2], common[1:-1], common[2:]
    # The maximum is between samples: that of a parabola through three of them.
    is_peak = (middle >= left) & (middle > right) & (left > -1) & (right > -1)
    curvature = np.where(is_peak, 2 * middle - left - right, 1.0)
    peaks = np.where(is_peak, middle + (right - left) ** 2 / (8 * curvature), middle)
    misfit = 1 - np.minimum(np.concatenate([common[:1], peaks, common[-1:]]), 1.0)
    limit = ALTERNATIVE_RATIO * misfit.min() + ALTERNATIVE_MARGIN_FRACTION
    is_near = np.concatenate([[False], misfit <= 2 * limit, [False]])
    starts = np.flatnonzero(~is_near[:-1] & is_near[1:])
    ends = np.flatnonzero(is_near[:-1] & ~is_near[1:])
    return sum(bool(misfit[a:b].min() <= limit) for a, b in zip(starts, ends, strict=True))
