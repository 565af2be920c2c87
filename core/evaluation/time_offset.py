"""Time offset between the clocks of an estimate and of its truth.

An offset is in seconds and is added to the stamps of the estimate. It is estimated on a part of the
recording that is then not scored (:func:`estimate_held_out_offset`). Clocks that differ by more
than the search span are first brought together by the motion of the whole recording
(:mod:`locatk.core.evaluation.coarse_offset`), which is too coarse to flatter a score.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError, InputError, LocatkError
from locatk.core.evaluation.alignment import fit_alignment
from locatk.core.evaluation.association import (
    MAX_GAP_S,
    Pairs,
    associate,
    interpolate_positions,
    require_ascending,
)
from locatk.core.evaluation.coarse_offset import (
    CoarseMethod,
    CoarseOffset,
    clocks_agree,
    estimate_coarse_offset,
)
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

HELD_OUT_PARTS = ((0.0, 0.25), (0.25, 0.5), (0.5, 0.75), (0.75, 1.0))
"""Parts of the recording on which a time offset may be estimated, as fractions of the poses with
truth."""

MIN_SPEED_RATIO = 0.5
"""Speed in the part on which a time offset is estimated, relative to that of the fastest part: if
devices rest for most of it, errors of position outweigh those of time."""

MIN_POSES = 10
"""Smallest number of poses from which a time offset is estimated."""

GRID_STEP_S = 0.02
"""Step of the grid search for a time offset, before the golden-section search."""

MIN_GRID_STEPS = 5
"""Smallest number of grid steps to either side of the middle."""

OFFSET_TOLERANCE_S = 1e-4
"""Width of the interval at which the golden-section search ends."""

FLAT_ERROR_FRACTION = 0.05
"""Relative increase of the mean error from its minimum that is not significant: an error that grows
by no more towards an end of the span does not determine the offset."""

FLAT_ERROR_M = 1e-12
"""The same for an estimate without errors, where the fraction is of rounding alone."""


@dataclass(frozen=True)
class TimeOffset:
    """Time offset of an evaluation and its origin.

    Attributes
    ----------
    offset_s : float
        Added to the stamps of the estimate.
    source : str
        ``"none"``, ``"given"``, or ``"held-out"`` if it was estimated on a part of the recording.
    held_out : (float, float) or None
        That part, as fractions of the poses with truth.
    coarse_method : str or None
        Method by which different clocks were brought together first; None if they agreed. See
        :data:`~locatk.core.evaluation.coarse_offset.CoarseMethod`.
    alternatives : int
        Number of other offsets that fit the motion as well.
    """

    offset_s: float = 0.0
    source: Literal["none", "given", "held-out"] = "none"
    held_out: tuple[float, float] | None = None
    coarse_method: CoarseMethod | None = None
    alternatives: int = 0

    @classmethod
    def given(cls, offset_s: float) -> TimeOffset:
        """Return a given offset, of which zero is none."""
        return cls(float(offset_s), "given") if offset_s != 0.0 else cls()

    def describe(self) -> str:
        """Return the origin of the offset as text; do not test its wording."""
        if self.held_out is None:
            return self.source
        start, end = self.held_out
        text = f"held-out {start:.0%} to {end:.0%} of the recording, not scored"
        if self.coarse_method is not None:
            text += f"; clocks brought together by {self.coarse_method}"
            if self.alternatives:
                text += f", which fits other offsets as well ({self.alternatives})"
        return text


def estimate_held_out_offset(
    pairs: Pairs,
    *,
    align: str = "none",
    held_out: tuple[float, float] | None = None,
    span_s: float = 1.0,
    max_gap_s: float = MAX_GAP_S,
) -> tuple[TimeOffset, list[Mask]]:
    """Estimate a time offset from a part of the recording.

    Parameters
    ----------
    pairs : sequence of (Trajectory, Trajectory)
        Estimate and truth of each device.
    align, span_s, max_gap_s
        See :func:`estimate_offset`.
    held_out : (float, float), optional
        The part, as fractions of the poses with truth; by default the first of
        :data:`HELD_OUT_PARTS` in which devices are fast (:data:`MIN_SPEED_RATIO`) and the offset
        can be estimated.

    Returns
    -------
    offset : TimeOffset
    masks : list of (n,) bool ndarray
        Poses of each estimate in that part; they must not be scored.

    Raises
    ------
    InputError, DegenerateError
        No part determines the offset; the error is that of the first part. Or the clocks cannot be
        brought together, or ``held_out`` is no proper part.
    """
    coarse: CoarseOffset | None = None
    around_s = 0.0
    if not clocks_agree(pairs):
        coarse = estimate_coarse_offset(pairs, align=align, span_s=span_s, max_gap_s=max_gap_s)
        around_s, span_s = coarse.offset_s, coarse.span_s
    parts = HELD_OUT_PARTS if held_out is None else (held_out,)
    masks_of_parts = [_held_out_masks(pairs, part, max_gap_s, around_s) for part in parts]
    speeds = [_median_speed(pairs, masks, max_gap_s, around_s) for masks in masks_of_parts]
    # Slow parts remain a last resort: they come after the fast ones, each in order of time.
    order = np.argsort(np.array(speeds) < MIN_SPEED_RATIO * max(speeds), kind="stable")
    first_error: LocatkError | None = None
    for k in order:
        training = [(e.select(m), t) for (e, t), m in zip(pairs, masks_of_parts[k], strict=True)]
        try:
            offset_s = estimate_offset(
                training, align=align, span_s=span_s, max_gap_s=max_gap_s, around_s=around_s
            )
        except (InputError, DegenerateError) as error:
            first_error = first_error or error
            continue
        if coarse is None:
            offset = TimeOffset(offset_s, "held-out", parts[k])
        else:
            offset = TimeOffset(offset_s, "held-out", parts[k], coarse.method, coarse.alternatives)
        return offset, masks_of_parts[k]
    assert first_error is not None
    if coarse is not None and coarse.method == "first stamps":
        raise InputError(
            "the motions of estimate and truth are too unlike to bring their clocks together",
            hint="give the offset, or the alignment that brings their frames together",
        )
    raise first_error


def _median_speed(pairs: Pairs, masks: Sequence[Mask], max_gap_s: float, around_s: float) -> float:
    """Median speed of the truth at the masked poses, in m/s.

    It is the median because a robot that is carried seems to move at a very high speed.
    """
    speeds = [np.zeros(1)]
    for (estimate, truth), mask in zip(pairs, masks, strict=True):
        m = associate(estimate.select(mask), truth, offset_s=around_s, max_gap_s=max_gap_s)
        if len(m) and len(truth) > 1:
            steps = np.linalg.norm(np.diff(truth.position, axis=0), axis=1)
            speed = steps / (np.diff(truth.time_ns) / 1e9)
            speeds.append(speed[np.minimum(m.before, len(speed) - 1)])
    return float(np.median(np.concatenate(speeds)))


def _held_out_masks(
    pairs: Pairs, held_out: tuple[float, float], max_gap_s: float, around_s: float
) -> list[Mask]:
    """Masks (n,) of the poses of each estimate in a part of the recording."""
    start, end = held_out
    if not (0 <= start < end <= 1) or (start, end) == (0, 1):
        raise InputError(
            f"the held-out part {start:g} to {end:g} is no proper part of the recording",
            hint="give two ascending fractions of 0 to 1 that leave something to score",
        )
    with_truth_ns = np.sort(
        np.concatenate(
            [associate(e, t, offset_s=around_s, max_gap_s=max_gap_s).time_ns for e, t in pairs]
        )
    )
    if len(with_truth_ns) == 0:
        raise InputError(
            "no pose of the estimate has truth at its time", hint="check the time stamps"
        )
    # The part is an interval of time, not of rows: it holds out all devices at that time.
    start_ns = with_truth_ns[int(start * len(with_truth_ns))]
    stop = int(np.ceil(end * len(with_truth_ns)))
    stop_ns = with_truth_ns[stop] if stop < len(with_truth_ns) else with_truth_ns[-1] + 1
    return [(e.time_ns >= start_ns) & (e.time_ns < stop_ns) for e, _ in pairs]


def estimate_offset(
    pairs: Pairs,
    *,
    align: str = "none",
    span_s: float = 1.0,
    max_gap_s: float = MAX_GAP_S,
    around_s: float = 0.0,
) -> float:
    """Estimate the common time offset of all pairs that minimizes the mean error.

    Do not score the poses from which it is estimated: use other recordings, or
    :func:`estimate_held_out_offset`.

    Parameters
    ----------
    pairs : sequence of (Trajectory, Trajectory)
        Estimate and truth of each device.
    align : str
        Fitted again at each offset.
    span_s : float
        Largest difference from ``around_s``: a grid of about :data:`GRID_STEP_S` is searched, then
        more finely around its best offset.
    max_gap_s : float
        See :func:`locatk.core.evaluation.association.associate`.
    around_s : float
        Centre of the search.

    Returns
    -------
    float
        Seconds to add to the stamps of the estimate.

    Raises
    ------
    InputError
        Too few poses have truth at all offsets searched, or the best offset is at the end of the
        span.
    DegenerateError
        The error hardly depends on the offset: the device was at rest.
    """
    if not span_s > 0:
        raise InputError(f"the span of time offsets must be positive, not {span_s}")
    # Whole nanoseconds, because months in seconds as a float resolve only 2 ns.
    around_ns = round(around_s * 1e9)
    steps = max(MIN_GRID_STEPS, round(span_s / GRID_STEP_S))
    offsets = np.linspace(-span_s, span_s, 2 * steps + 1)
    for _, truth in pairs:
        require_ascending(truth, "truth")
    pairs = [(e.shifted(around_ns), t) for e, t in pairs]
    pairs = [(_with_truth_at_all(e, t, offsets, max_gap_s), t) for e, t in pairs]
    poses = sum(len(e) for e, _ in pairs)
    if poses < MIN_POSES:
        raise InputError(
            f"only {poses} poses have truth at all time offsets within {span_s:g} s",
            hint="give the offset",
        )

    # An alignment with one pose would let the error of that pose decide on the offset.
    fitted = "se3" if align == "origin" else align

    def mean_error(offset_s: float) -> float:
        matches = [
            interpolate_positions(t, e.time_ns + round(offset_s * 1e9), max_gap_s) for e, t in pairs
        ]
        estimate = np.concatenate(
            [e.position[index] for (e, _), (index, _) in zip(pairs, matches, strict=True)]
        )
        truth = np.concatenate([positions for _, positions in matches])
        aligned = fit_alignment(estimate, truth, fitted).apply(estimate)
        return float(np.mean(np.linalg.norm(aligned - truth, axis=1)))

    errors = np.array([mean_error(offset_s) for offset_s in offsets])
    best = int(np.argmin(errors))
    flat = FLAT_ERROR_FRACTION * errors[best] + FLAT_ERROR_M
    if min(errors[0], errors[-1]) <= errors[best] + flat:
        if np.ptp(errors) <= flat:
            raise DegenerateError(
                "the error does not depend on the time offset: the devices hardly moved, "
                "or evenly straight on or in a circle, or the frames differ",
                hint="give the offset, or the alignment that brings the frames together",
            )
        if best in (0, len(offsets) - 1):
            raise InputError(
                f"the best time offset is at the end of the span of {span_s:g} s",
                hint="give the offset, or check the clocks",
            )
    best = min(max(best, 1), len(offsets) - 2)
    fine_s = _golden_section(mean_error, float(offsets[best - 1]), float(offsets[best + 1]))
    return around_ns / 1e9 + fine_s


def _with_truth_at_all(
    estimate: Trajectory, truth: Trajectory, offsets: Array, max_gap_s: float
) -> Trajectory:
    """Select the poses with truth at every offset, so that the same poses are compared."""
    count = np.zeros(len(estimate), int)
    for offset_s in offsets:
        index, _ = interpolate_positions(truth, estimate.time_ns + round(offset_s * 1e9), max_gap_s)
        count[index] += 1
    return estimate.select(count == len(offsets))


def _golden_section(
    function: Callable[[float], float],
    low: float,
    high: float,
    tolerance: float = OFFSET_TOLERANCE_S,
) -> float:
    """Find the minimum of a unimodal function between ``low`` and ``high``."""
    ratio = (np.sqrt(5) - 1) / 2
    left, right = high - ratio * (high - low), low + ratio * (high - low)
    value_left, value_right = function(left), function(right)
    while high - low > tolerance:
        if value_left < value_right:
            high, right, value_right = right, left, value_left
            left = high - ratio * (high - low)
            value_left = function(left)
        else:
            low, left, value_left = left, right, value_right
            right = low + ratio * (high - low)
            value_right = function(right)
    return (low + high) / 2
