"""Which truth belongs to which pose: matching in time, in space and between clocks.

A time offset is in seconds and is *added to the stamps of the estimate*: an estimate
stamped t is compared with the truth at t + offset. (Shifting a camera's clock by
+0.318 s, as the authors of the DotBot data do, is an offset of -0.318 s here.)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError, InputError
from locatk.core.geometry import Similarity, umeyama
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

ALIGNMENTS = ("none", "se2", "se3", "sim2", "sim3")
"""What may be fitted between estimate and truth. ``se2`` turns about z and shifts in x
and y, ``se3`` is any rigid motion; ``sim2`` and ``sim3`` also scale. Least squares over
the scored points, all equal (Umeyama), never a reflection. ``se2`` and ``sim2`` do not
shift along z. ``se3`` and ``sim3`` can turn a planar estimate over, and so hide that it
is mirrored."""

MAX_GAP_S = 0.5
"""Default for the longest gap in the truth that is bridged by interpolation."""

MIN_POINTS = 10
"""A time offset is not estimated from fewer points."""


@dataclass(frozen=True)
class Association:
    """Poses of one estimate for which there is truth.

    Attributes
    ----------
    index : (n,) int ndarray
        Rows of the estimate.
    time_ns : (n,) int64 ndarray
        Their stamps, as in the estimate.
    estimate, truth : (n, 3) ndarray
        Positions in metres, each in its own frame.
    """

    index: NDArray[np.int64]
    time_ns: NDArray[np.int64]
    estimate: Array
    truth: Array

    def __len__(self) -> int:
        return len(self.index)

    def take(self, keep: NDArray[np.bool_]) -> Association:
        """Only the poses where ``keep`` (n,) is true."""
        return Association(
            self.index[keep], self.time_ns[keep], self.estimate[keep], self.truth[keep]
        )


def associate(
    estimate: Trajectory,
    truth: Trajectory,
    *,
    offset_s: float = 0.0,
    max_gap_s: float = MAX_GAP_S,
) -> Association:
    """Match each pose of an estimate with the truth at its time.

    The truth is interpolated linearly between its two neighbours in time. It is never
    extrapolated, and gaps longer than ``max_gap_s`` are not bridged: poses there are
    left out.

    Raises
    ------
    InputError
        The stamps of the truth do not ascend.
    """
    if np.any(truth.time_ns[1:] <= truth.time_ns[:-1]):
        raise InputError(
            f"the stamps of the truth of device {truth.device!r} do not ascend",
            hint="sort it and drop repeated stamps",
        )
    time = estimate.time_ns + round(offset_s * 1e9)
    if len(truth) == 0:
        empty = np.zeros(0, np.int64)
        return Association(empty, empty, np.zeros((0, 3)), np.zeros((0, 3)))
    after = np.searchsorted(truth.time_ns, time)  # first truth stamp at or after each pose
    after_safe = np.minimum(after, len(truth) - 1)
    before = np.maximum(after - 1, 0)
    exact = truth.time_ns[after_safe] == time
    # Differences of int64 nanoseconds: no digit of the epoch is lost.
    gap = truth.time_ns[after_safe] - truth.time_ns[before]
    inside = (after > 0) & (after < len(truth)) & (gap <= round(max_gap_s * 1e9))
    index = np.flatnonzero(inside | exact)
    before, after = np.where(exact, after_safe, before)[index], after_safe[index]
    gap = np.maximum(truth.time_ns[after] - truth.time_ns[before], 1)
    share = ((time[index] - truth.time_ns[before]) / gap)[:, None]
    position = (1 - share) * truth.position[before] + share * truth.position[after]
    return Association(index, estimate.time_ns[index], estimate.position[index], position)


def fit_alignment(estimate: Array, truth: Array, align: str) -> Similarity:
    """Transform named ``align`` that brings ``estimate`` (n, 3) closest to ``truth`` (n, 3).

    Raises
    ------
    InputError
        ``align`` is not one of :data:`ALIGNMENTS`.
    DegenerateError
        The points do not determine it (all in one place, on a line).
    """
    if align not in ALIGNMENTS:
        raise InputError(f"unknown alignment {align!r}", hint=f"use one of {', '.join(ALIGNMENTS)}")
    if align == "none":
        return Similarity.identity()
    if len(estimate) < 2:
        raise DegenerateError(f"alignment {align!r} needs two poses or more, not {len(estimate)}")
    with_scale = align.startswith("sim")
    if align.endswith("3"):
        return umeyama(estimate, truth, with_scale=with_scale)
    flat = umeyama(estimate[:, :2], truth[:, :2], with_scale=with_scale)
    rotation, translation = np.eye(3), np.zeros(3)
    rotation[:2, :2], translation[:2] = flat.rotation, flat.translation
    return Similarity(flat.scale, rotation, translation)


Pairs = Sequence[tuple[Trajectory, Trajectory]]
"""Estimate and truth, one pair a device."""


def estimate_offset(
    pairs: Pairs,
    *,
    align: str = "none",
    span_s: float = 1.0,
    max_gap_s: float = MAX_GAP_S,
) -> float:
    """Time offset that makes the mean error smallest, common to all pairs.

    Do not score the poses that it was estimated from: give it other recordings, or let
    :func:`evaluate` hold a part out.

    Parameters
    ----------
    pairs : sequence of (Trajectory, Trajectory)
        Estimate and truth of each device.
    align : str
        Fitted anew at each offset.
    span_s : float
        Offsets from ``-span_s`` to ``span_s`` are searched: every 20 ms, then finer
        around the best.
    max_gap_s : float
        See :func:`associate`.

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
    offsets = np.linspace(-span_s, span_s, 2 * max(5, round(span_s / 0.02)) + 1)
    pairs = [(_where_always(e, t, offsets, max_gap_s), t) for e, t in pairs]
    poses = sum(len(e) for e, _ in pairs)
    if poses < MIN_POINTS:
        raise InputError(
            f"only {poses} poses have truth at all time offsets within {span_s:g} s",
            hint="narrow the span, hold out a longer part, or give the offset",
        )

    def error(offset: float) -> float:
        matched = [associate(e, t, offset_s=offset, max_gap_s=max_gap_s) for e, t in pairs]
        estimate = np.concatenate([m.estimate for m in matched])
        truth = np.concatenate([m.truth for m in matched])
        moved = fit_alignment(estimate, truth, align).apply(estimate)
        return float(np.mean(np.linalg.norm(moved - truth, axis=1)))

    errors = np.array([error(o) for o in offsets])
    best = int(np.argmin(errors))
    if min(errors[0], errors[-1]) <= 1.05 * errors[best] + 1e-12:
        if np.ptp(errors) <= 0.05 * errors[best] + 1e-12:
            raise DegenerateError(
                "the error does not depend on the time offset: the devices hardly moved",
                hint="give the offset, or hold out a part with motion",
            )
        if best in (0, len(offsets) - 1):
            raise InputError(
                f"the best time offset lies at the end of the span of {span_s:g} s",
                hint="widen the span, or check the clocks",
            )
    best = min(max(best, 1), len(offsets) - 2)
    return _golden_section(error, float(offsets[best - 1]), float(offsets[best + 1]))


def _where_always(
    estimate: Trajectory, truth: Trajectory, offsets: Array, max_gap_s: float
) -> Trajectory:
    """Poses with truth at every offset: the same poses are compared at each."""
    seen = np.zeros(len(estimate), int)
    for offset in offsets:
        seen[associate(estimate, truth, offset_s=float(offset), max_gap_s=max_gap_s).index] += 1
    return take(estimate, seen == len(offsets))


def take(trajectory: Trajectory, keep: NDArray[np.bool_]) -> Trajectory:
    """Only the poses where ``keep`` (n,) is true."""
    return Trajectory(
        trajectory.device,
        trajectory.frame,
        trajectory.time_ns[keep],
        trajectory.position[keep],
        trajectory.quaternion[keep],
        trajectory.covariance[keep],
    )


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
