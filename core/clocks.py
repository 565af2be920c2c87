"""Time offsets between the clock of an estimate and that of its truth.

An offset is in seconds and is added to the stamps of the estimate. Clocks may be months apart:
:func:`coarse_offset` finds where the two belong to each other at all, and
:func:`estimate_offset` then refines.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.alignment import fit_alignment
from locatk.core.association import MAX_GAP_S, Pairs, Rows, ascending, between, take
from locatk.core.errors import DegenerateError, InputError
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

MIN_POINTS = 10
"""A time offset is not estimated from fewer points."""

GRID_S = 0.05
MOST_CELLS = 2**17
"""Step of time of the coarse search, and how many of them: a longer recording is searched in
longer steps."""

LEAST_SHARE = 0.5
"""Part of the shorter of the two that must overlap at a coarse offset."""

LEAST_FIT = 0.5
"""Part of the motion that must be the same in both, for a coarse offset to be believed."""

ALIKE = (2.0, 3e-4)
"""What is not common to both motions, as a multiple of what it is at the best offset and as a part
of the motion: with no more than the sum of both, another offset fits as well."""


def clocks_agree(pairs: Pairs) -> bool:
    """Whether estimate and truth of most pairs are of the same time, by their stamps.

    They are where at least half of the shorter one overlaps the longer.
    """
    agree = 0
    known = [(e.time_ns, t.time_ns) for e, t in pairs if len(e) and len(t)]
    for mine, true in known:
        overlap = min(mine[-1], true[-1]) - max(mine[0], true[0])
        agree += bool(overlap >= LEAST_SHARE * min(mine[-1] - mine[0], true[-1] - true[0]))
    return 2 * agree >= len(known)


@dataclass(frozen=True)
class Coarse:
    """Where the clocks of estimate and truth belong to each other.

    Attributes
    ----------
    offset_s : float
    span_s : float
        By how much that may be wrong, to either side.
    by : str
        What it was found by: ``"motion"`` or ``"first stamps"``.
    alike : int
        Other offsets at which the motions agree as well: of a drive that repeats itself, or of
        one that was recorded several times, there are some.
    """

    offset_s: float
    span_s: float
    by: str
    alike: int = 0


def coarse_offset(
    pairs: Pairs, *, align: str = "none", span_s: float = 1.0, max_gap_s: float = MAX_GAP_S
) -> Coarse:
    """Offset at which the motions agree best, of all where at least half overlaps.

    Both trajectories are sampled evenly. At every shift by whole samples, the part of the
    motion that estimate and truth have in common is computed, after the best turn in the
    plane (in space for ``se3`` and ``sim3``) and shift, or as they are for ``none``, by
    correlating all coordinates with the fast Fourier transform. Where no shift explains half
    of the motion, the first stamps are laid on each other.

    Parameters
    ----------
    pairs : sequence of (Trajectory, Trajectory)
    align : str
        One of :data:`locatk.core.alignment.ALIGNMENTS`.
    span_s : float
        How wrong the first stamps may be.
    max_gap_s : float
        Longer gaps are not bridged.

    Raises
    ------
    InputError
        Estimate or truth has no pose.
    """
    pairs = [(e, t) for e, t in pairs if len(e) and len(t)]
    if not pairs:
        raise InputError("there are no poses to find a time offset from")
    start = min(int(e.time_ns[0]) for e, _ in pairs)
    true_start = min(int(t.time_ns[0]) for _, t in pairs)
    longest = max(
        max(int(e.time_ns[-1]) - start, int(t.time_ns[-1]) - true_start) for e, t in pairs
    )
    step_ns = max(round(GRID_S * 1e9), -(-longest // MOST_CELLS))
    sums: list[Array] = []
    for estimate, truth in pairs:
        # Where nothing is fitted, both are in one frame and the places count, not their shape.
        middle = truth.position.mean(axis=0)
        own = middle if align == "none" else estimate.position.mean(axis=0)
        mine = _sampled(estimate, own, start, step_ns, longest, max_gap_s)
        true = _sampled(truth, middle, true_start, step_ns, longest, max_gap_s)
        found = _correlations(*mine, *true)
        sums = found if not sums else [a + b for a, b in zip(sums, found, strict=True)]
    lags = np.arange(-(len(sums[0]) // 2), (len(sums[0]) + 1) // 2)
    fit = _common_motion(sums, align)
    best = int(np.argmax(fit))
    base = (true_start - start) / 1e9
    if fit[best] >= LEAST_FIT:
        step = step_ns / 1e9
        offset_s = base + int(lags[best]) * step
        return Coarse(offset_s, max(0.25, 3 * step), "motion", _peaks(fit) - 1)
    return Coarse(base, span_s, "first stamps")


def _sampled(
    trajectory: Trajectory,
    middle: Array,
    start: int,
    step_ns: int,
    longest: int,
    max_gap_s: float,
) -> tuple[Array, Array]:
    """Positions (cells, 3), from ``middle``, at even stamps, zero where unknown; and where
    they are known (cells,), as 0 and 1."""
    time = start + step_ns * np.arange(longest // step_ns + 1)
    positions, known = np.zeros((len(time), 3)), np.zeros(len(time))
    index, there = _places(trajectory, time, max_gap_s)
    positions[index] = there - middle
    known[index] = 1.0
    return positions, known


def _places(
    trajectory: Trajectory, time_ns: NDArray[np.int64], max_gap_s: float
) -> tuple[Rows, Array]:
    """Rows of the stamps (n,) at which a trajectory is known, and its positions (k, 3) there.

    As :func:`locatk.core.association.associate` interpolates, without orientations.
    """
    if len(trajectory) == 0:
        return np.zeros(0, np.int64), np.zeros((0, 3))
    index, before, after, share = between(time_ns, trajectory.time_ns, max_gap_s)
    column = share[:, None]
    return index, (1 - column) * trajectory.position[before] + column * trajectory.position[after]


def _correlations(mine: Array, known: Array, true: Array, true_known: Array) -> list[Array]:
    """Sums over the overlap at every lag: count, estimate, truth, their squares, and products.

    At lag k, sample i of the estimate meets sample i + k of the truth. Lags ascend from
    minus to plus half of the length.
    """
    size = 1 << int(2 * len(known) - 1).bit_length()

    def spectrum(values: Array) -> NDArray[np.complex128]:
        return np.fft.rfft(values, size, axis=0)

    e, t = spectrum(mine), spectrum(true)
    ek, tk = spectrum(known), spectrum(true_known)
    e2, t2 = spectrum(np.sum(mine**2, axis=1)), spectrum(np.sum(true**2, axis=1))

    def lagged(a: NDArray[np.complex128], b: NDArray[np.complex128]) -> Array:
        return np.asarray(np.fft.fftshift(np.fft.irfft(np.conj(a) * b, size, axis=0), axes=0))

    return [
        lagged(ek, tk),
        lagged(e, tk[:, None]),
        lagged(ek[:, None], t),
        lagged(e2, tk),
        lagged(ek, t2),
        np.stack([lagged(e[:, [k]], t) for k in range(3)], axis=1),
    ]


def _common_motion(sums: list[Array], align: str) -> Array:
    """Part of the motion that is common to both at each lag; -1 where too little overlaps."""
    count, mine, true, mine2, true2, product = sums
    enough = count >= LEAST_SHARE * count.max()
    n = np.where(enough, np.maximum(count, 1.0), 1.0)
    spread = product - mine[:, :, None] * true[:, None, :] / n[:, None, None]
    # Sums of squares, from the mean of the overlap; of FFTs, so that zero may come out below it.
    moved = np.maximum(mine2 - np.sum(mine**2, axis=1) / n, 0.0)
    truly = np.maximum(true2 - np.sum(true**2, axis=1) / n, 0.0)
    size = 2 * np.sqrt(moved * truly) if align.startswith("sim") else moved + truly
    if align == "none":
        apart = mine2 + true2 - 2 * np.einsum("nkk->n", product)
        return _part(size - apart, size, enough)
    if align in ("se3", "sim3"):
        common = np.full(len(n), 0.0)
        # The sum of the singular values is what the best turn reaches (Umeyama, eq. 40).
        values = np.linalg.svd(spread[enough], compute_uv=False)
        sign = np.sign(np.linalg.det(spread[enough]))
        common[enough] = values[:, 0] + values[:, 1] + sign * values[:, 2]
    else:
        along = spread[:, 0, 0] + spread[:, 1, 1]
        across = spread[:, 0, 1] - spread[:, 1, 0]
        common = np.hypot(along, across) + spread[:, 2, 2]
    return _part(2 * common, size, enough)


def _part(common: Array, size: Array, enough: NDArray[np.bool_]) -> Array:
    """Common motion by all motion, -1 where there is not enough of it."""
    still = size <= 1e-6 * max(float(size[enough].max()), 1e-300)
    return np.where(enough & ~still, common / np.where(still, 1.0, size), -1.0)


def _peaks(fit: Array) -> int:
    """How many separate offsets fit as well as the best, from the fit at every lag.

    A peak ends where twice as much is not common as may be at the top of one, so that noise
    does not split it.
    """
    left, middle, right = fit[:-2], fit[1:-1], fit[2:]
    # The top lies between samples: that of a parabola through three of them.
    top = (middle >= left) & (middle > right) & (left > -1) & (right > -1)
    curve = np.where(top, 2 * middle - left - right, 1.0)
    tops = np.where(top, middle + (right - left) ** 2 / (8 * curve), middle)
    apart = 1 - np.minimum(np.concatenate([fit[:1], tops, fit[-1:]]), 1.0)
    limit = ALIKE[0] * apart.min() + ALIKE[1]
    near = np.concatenate([[False], apart <= 2 * limit, [False]])
    starts, ends = np.flatnonzero(~near[:-1] & near[1:]), np.flatnonzero(near[:-1] & ~near[1:])
    return sum(bool(apart[a:b].min() <= limit) for a, b in zip(starts, ends, strict=True))


def estimate_offset(
    pairs: Pairs,
    *,
    align: str = "none",
    span_s: float = 1.0,
    max_gap_s: float = MAX_GAP_S,
    around_s: float = 0.0,
) -> float:
    """Time offset that makes the mean error smallest, common to all pairs.

    Do not score the poses that it was estimated from: give it other recordings, or let
    :func:`locatk.core.metrics.evaluate` hold a part out.

    Parameters
    ----------
    pairs : sequence of (Trajectory, Trajectory)
        Estimate and truth of each device.
    align : str
        Fitted anew at each offset.
    span_s : float
        Offsets not further than this from ``around_s`` are searched: every 20 ms, then
        finer around the best.
    max_gap_s : float
        See :func:`locatk.core.association.associate`.
    around_s : float
        The middle of the search.

    Returns
    -------
    float
        Seconds to add to the stamps of the estimate.

    Raises
    ------
    InputError
        Too few poses have truth at all offsets searched, or the best offset lies at the
        end of the span.
    DegenerateError
        The error hardly depends on the offset: the device stood still.
    """
    if not span_s > 0:
        raise InputError(f"the span of time offsets must be positive, not {span_s}")
    # Whole nanoseconds: months in seconds, as a float, resolve 2 ns.
    middle_ns = round(around_s * 1e9)
    offsets = np.linspace(-span_s, span_s, 2 * max(5, round(span_s / 0.02)) + 1)
    for _, truth in pairs:
        ascending(truth, "truth")
    pairs = [(_later(e, middle_ns), t) for e, t in pairs]
    pairs = [(_where_always(e, t, offsets, max_gap_s), t) for e, t in pairs]
    poses = sum(len(e) for e, _ in pairs)
    if poses < MIN_POINTS:
        raise InputError(
            f"only {poses} poses have truth at all time offsets within {span_s:g} s",
            hint="give the offset",
        )

    def error(offset: float) -> float:
        placed = [_places(t, e.time_ns + round(offset * 1e9), max_gap_s) for e, t in pairs]
        estimate = np.concatenate(
            [e.position[index] for (e, _), (index, _) in zip(pairs, placed, strict=True)]
        )
        truth = np.concatenate([there for _, there in placed])
        moved = fit_alignment(estimate, truth, fitted).apply(estimate)
        return float(np.mean(np.linalg.norm(moved - truth, axis=1)))

    # Laid on one pose, the error of that pose would decide on the offset.
    fitted = "se3" if align == "origin" else align
    errors = np.array([error(o) for o in offsets])
    best = int(np.argmin(errors))
    if min(errors[0], errors[-1]) <= 1.05 * errors[best] + 1e-12:
        if np.ptp(errors) <= 0.05 * errors[best] + 1e-12:
            raise DegenerateError(
                "the error does not depend on the time offset: the devices hardly moved, "
                "or evenly straight on or in a circle, or the frames differ",
                hint="give the offset, or the alignment that brings the frames together",
            )
        if best in (0, len(offsets) - 1):
            raise InputError(
                f"the best time offset lies at the end of the span of {span_s:g} s",
                hint="give the offset, or check the clocks",
            )
    best = min(max(best, 1), len(offsets) - 2)
    fine = _golden_section(error, float(offsets[best - 1]), float(offsets[best + 1]))
    return middle_ns / 1e9 + fine


def _later(trajectory: Trajectory, shift_ns: int) -> Trajectory:
    """The same poses with their stamps shifted."""
    if shift_ns == 0:
        return trajectory
    return Trajectory(
        trajectory.device,
        trajectory.frame,
        trajectory.time_ns + shift_ns,
        trajectory.position,
        trajectory.quaternion,
        trajectory.covariance,
    )


def _where_always(
    estimate: Trajectory, truth: Trajectory, offsets: Array, max_gap_s: float
) -> Trajectory:
    """Poses with truth at every offset: the same poses are compared at each."""
    seen = np.zeros(len(estimate), int)
    for offset in offsets:
        index, _ = _places(truth, estimate.time_ns + round(offset * 1e9), max_gap_s)
        seen[index] += 1
    return take(estimate, seen == len(offsets))


def _golden_section(
    function: Callable[[float], float], low: float, high: float, tolerance: float = 1e-4
) -> float:
    """Minimum of a function with one valley between ``low`` and ``high``."""
    ratio = (np.sqrt(5) - 1) / 2
    left, right = high - ratio * (high - low), low + ratio * (high - low)
    at_left, at_right = function(left), function(right)
    while high - low > tolerance:
        if at_left < at_right:
            high, right, at_right = right, left, at_left
            left = high - ratio * (high - low)
            at_left = function(left)
        else:
            low, left, at_left = left, right, at_right
            right = low + ratio * (high - low)
            at_right = function(right)
    return (low + high) / 2
