"""Values over time in figures: errors, their expectation by the covariances, and the time axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.evaluation import Evaluation
from locatk.core.solution import Solution
from locatk.formats.sessions.reader import Session

Array = NDArray[np.float64]

ONE_SIDED_95_QUANTILE = 1.644854
"""95 % quantile of the standard normal distribution."""

MAX_AXIS_EXTENSION = 4
"""Factor by which a value axis is extended, at most, to include the expected values; the values
themselves fill at least a quarter of the axis."""

MARK_SPACE = 1.2
"""Factor by which a value axis is extended for marks at its limit, so that they cover no values."""

AXIS_MARGIN = 1.05
"""Ratio of the upper limit of an axis to the largest value below it."""

MAX_LIMIT_MARKS = 40
"""Number of marks along a time axis that indicate where a curve lies beyond the scale."""

MAX_EXPECTED_DEVICES = 3
"""Number of devices up to which expected errors are drawn; of more devices they would cover the
errors."""

MAX_TIME_DIFFERENCE_NS = 5_000_000_000
"""Time by which poses may precede or follow the messages of their recording: stamps of a device may
be filtered or delayed."""

MIN_GAP_NS = 500_000_000
"""Time without poses from which a line is interrupted."""

MIN_GAP_INTERVALS = 3
"""Factor of the median interval from which a line is interrupted, for devices with rare poses."""


@dataclass(frozen=True)
class Series:
    """One value per pose: times (n,) in ns and values (n,)."""

    time_ns: NDArray[np.int64]
    value: Array

    def scaled(self, factor: float) -> Series:
        """Return the series with all values multiplied by ``factor``."""
        return Series(self.time_ns, factor * self.value)


def split_by_device(
    evaluation: Evaluation, value: Array, mask: NDArray[np.bool_] | None = None
) -> dict[str, Series]:
    """Return values (n,) of the scored poses by device, optionally only those in ``mask`` (n,)."""
    series = {}
    for index, name in enumerate(evaluation.devices):
        selected = evaluation.device == index
        if mask is not None:
            selected &= mask
        series[name] = Series(evaluation.time_ns[selected], value[selected])
    return series


def position_sigmas(solution: Solution) -> dict[str, Series]:
    """Return the standard deviation [m] of positions by device, over the known axes."""
    series = {}
    for t in solution.trajectories:
        variances = np.einsum("nii->ni", t.covariance[:, :3, :3])
        is_known = np.isfinite(variances).any(axis=1)
        if np.any(is_known):
            sigma = np.sqrt(np.nansum(variances, axis=1)[is_known])
            series[t.device] = Series(t.time_ns[is_known], sigma)
    return series


def expected_errors(solution: Solution, evaluation: Evaluation) -> dict[str, Series]:
    """Return the bounds [m] of 95 % of the errors, by device, according to the covariances."""
    return split_by_device(evaluation, error_quantile_95(scored_covariance(solution, evaluation)))


def scored_covariance(solution: Solution, evaluation: Evaluation) -> Array:
    """Return the covariances (n, 3, 3) in m^2 of the scored positions, in the frame of the truth.

    ``nan`` in the rows and columns of unknown axes, and of scored poses that are not in the
    solution.
    """
    covariance = np.full((evaluation.n, 3, 3), np.nan)
    by_name = {t.device: t for t in solution.trajectories}
    for index, name in enumerate(evaluation.devices):
        rows = np.flatnonzero(evaluation.device == index)
        t = by_name.get(name)
        if t is None or not len(t):
            continue
        nearest = np.minimum(np.searchsorted(t.time_ns, evaluation.time_ns[rows]), len(t) - 1)
        is_same = t.time_ns[nearest] == evaluation.time_ns[rows]
        covariance[rows[is_same]] = t.covariance[nearest[is_same], :3, :3]
    if evaluation.align == "none":
        return covariance
    to_truth = evaluation.alignment
    jacobian = to_truth.scale * to_truth.rotation
    # An unknown axis stays unknown if the rotation is about it, and only then.
    is_unknown = np.isnan(np.einsum("nii->ni", covariance))
    rotated = jacobian @ np.nan_to_num(covariance) @ jacobian.T
    is_mixed = (is_unknown.astype(float) @ np.abs(to_truth.rotation).T) > 1e-9
    rotated[is_mixed] = np.nan
    rotated.swapaxes(1, 2)[is_mixed] = np.nan
    return rotated


def error_quantile_95(covariance: Array) -> Array:
    """Return the 95 % quantiles (n,) in m of the lengths of normal errors.

    ``covariance`` (n, 3, 3) in m^2; unknown axes are left out, and the quantile is ``nan`` if all
    are unknown. The squared length is approximated by a multiple of chi-squared with the same mean
    and variance (Box, Ann. Math. Stat. 25 (1954) 290), whose quantile is that of Wilson and
    Hilferty (PNAS 17 (1931) 684): within 2 % of the length for one axis, 1 % for more.
    """
    filled = np.nan_to_num(covariance)
    mean = np.einsum("nii->n", filled)
    half_variance = np.einsum("nij,nij->n", filled, filled)
    is_known = np.isfinite(np.einsum("nii->ni", covariance)).any(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        freedom = mean**2 / half_variance
        term = 2 / (9 * freedom)
        quantile = (1 - term + ONE_SIDED_95_QUANTILE * np.sqrt(term)) ** 3
    squared = np.where(half_variance > 0, mean * quantile, 0.0)
    return np.where(is_known, np.sqrt(squared), np.nan)


def axis_limit(values: Array, expected: Array | None = None) -> float:
    """Return the upper limit of an axis that shows all values but extreme outliers.

    The axis is extended to those of the ``expected`` values that leave the values readable
    (:data:`MAX_AXIS_EXTENSION`). Larger ones lie beyond the scale: see :func:`peaks_beyond`.
    """
    bounds = np.zeros(0) if expected is None else expected[np.isfinite(expected)]
    limit = AXIS_MARGIN * _max_without_outliers(values[np.isfinite(values)])
    is_readable = (AXIS_MARGIN * bounds <= MAX_AXIS_EXTENSION * limit) | (limit == 0)
    limit = max(limit, AXIS_MARGIN * _max_without_outliers(bounds[is_readable]))
    if (bounds > limit).any():
        limit *= MARK_SPACE
    return limit or 1.0


def _max_without_outliers(values: Array) -> float:
    """Return the largest of finite values (n,), but at most 1.5 times their 98 % quantile."""
    if not len(values):
        return 0.0
    return min(float(values.max()), 1.5 * float(np.percentile(values, 98)))


def peaks_beyond(series: Series, limit: float) -> NDArray[np.int64]:
    """Return the ascending indices of values beyond a scale, the largest in each part of the time.

    The time is divided into :data:`MAX_LIMIT_MARKS` equal parts.
    """
    beyond = np.flatnonzero(series.value > limit)
    if not len(beyond):
        return beyond
    elapsed_ns = series.time_ns[beyond] - series.time_ns[0]
    part_ns = int(series.time_ns[-1] - series.time_ns[0]) // MAX_LIMIT_MARKS + 1
    part = elapsed_ns // part_ns
    order = np.lexsort((series.value[beyond], part))
    is_largest = np.diff(part[order], append=MAX_LIMIT_MARKS) > 0
    return np.sort(beyond[order[is_largest]])


# ---- time


def pose_span_ns(solution: Solution) -> tuple[int, int] | None:
    """Return the times of the first and the last pose, None if there is no pose."""
    ends = [(int(t.time_ns[0]), int(t.time_ns[-1])) for t in solution.trajectories if len(t)]
    return (min(a for a, _ in ends), max(b for _, b in ends)) if ends else None


def overlap_in_time(session: Session, solution: Solution) -> bool:
    """Return whether the poses are from the time of a recording, if both times are known."""
    poses = pose_span_ns(solution)
    if poses is None or session.start_ns is None or session.end_ns is None:
        return True
    first, last = poses
    return (
        last >= session.start_ns - MAX_TIME_DIFFERENCE_NS
        and first <= session.end_ns + MAX_TIME_DIFFERENCE_NS
    )


def origin_ns(session: Session | None, solution: Solution) -> int:
    """Return the origin of all time axes: the start of the recording, else the first pose."""
    if session is not None and session.start_ns is not None and overlap_in_time(session, solution):
        return session.start_ns
    poses = pose_span_ns(solution)
    return 0 if poses is None else poses[0]


def interrupt_at_gaps(
    rows: Array, time_ns: NDArray[np.int64], kept: NDArray[np.int64] | None = None
) -> Array:
    """Return rows (n, k) with a row of ``nan`` inserted wherever poses are missing.

    ``time_ns`` are the times of all poses; ``kept`` are the indices of ``rows`` among them if the
    rows were thinned, so that omitted poses are not mistaken for missing ones.
    """
    interval = np.diff(time_ns)
    longest = MIN_GAP_NS
    if len(interval):
        longest = max(longest, MIN_GAP_INTERVALS * int(np.median(interval)))
    gap_count = np.concatenate([[0], np.cumsum(interval > longest)])[: len(time_ns)]
    gaps = np.flatnonzero(np.diff(gap_count if kept is None else gap_count[kept])) + 1
    return np.insert(rows, gaps, np.nan, axis=0)
