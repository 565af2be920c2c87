"""Numbers over time that pictures and pages show: errors, and what the solver expects of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.evaluation import Evaluation
from locatk.core.solution import Solution

Array = NDArray[np.float64]

NORMAL_95 = 1.959964
"""Half the width of the interval that holds 95 % of a normal distribution, in sigmas."""

_QUANTILE_95 = 1.644854
"""Below it lie 95 % of a standard normal distribution."""


MOST_ROOM = 3
"""By how much a scale is widened, at most, to show where values were expected to be."""

MOST_BANDS = 3
"""Of more devices, what their covariances expect is not drawn: it would cover all else."""


@dataclass(frozen=True)
class Series:
    """One number a pose: times (n,) in ns and values (n,), in metres."""

    time_ns: NDArray[np.int64]
    value: Array


def errors(evaluation: Evaluation) -> dict[str, Series]:
    """Errors of each device."""
    series = {}
    for k, name in enumerate(evaluation.devices):
        mine = evaluation.device == k
        series[name] = Series(evaluation.time_ns[mine], evaluation.errors[mine])
    return series


def sigmas(solution: Solution) -> dict[str, Series]:
    """Standard deviations of positions, over the axes that are known; else left out."""
    series = {}
    for t in solution.trajectories:
        variances = np.einsum("nii->ni", t.covariance[:, :3, :3])
        known, variance = np.isfinite(variances).any(axis=1), np.nansum(variances, axis=1)
        if np.any(known):
            series[t.device] = Series(t.time_ns[known], np.sqrt(variance[known]))
    return series


def expected(solution: Solution, evaluation: Evaluation) -> dict[str, Series]:
    """Below what 95 % of the errors of each device should lie, by its covariances."""
    value = expected_error(scored_covariance(solution, evaluation))
    found = {}
    for k, name in enumerate(evaluation.devices):
        mine = evaluation.device == k
        found[name] = Series(evaluation.time_ns[mine], value[mine])
    return found


def scored_covariance(solution: Solution, evaluation: Evaluation) -> Array:
    """(n, 3, 3) covariances of the scored positions in the frame of the truth, in m^2.

    ``nan`` in the rows and columns of axes that the solver does not know, before the
    alignment, and where a scored pose is not in the solution.
    """
    found = np.full((evaluation.n, 3, 3), np.nan)
    by_name = {t.device: t for t in solution.trajectories}
    for k, name in enumerate(evaluation.devices):
        mine = np.flatnonzero(evaluation.device == k)
        t = by_name.get(name)
        if t is None or not len(t):
            continue
        row = np.minimum(np.searchsorted(t.time_ns, evaluation.time_ns[mine]), len(t) - 1)
        same = t.time_ns[row] == evaluation.time_ns[mine]
        found[mine[same]] = t.covariance[row[same], :3, :3]
    to = evaluation.alignment
    if evaluation.align == "none":
        return found
    turn = to.scale * to.rotation
    # An unknown axis stays unknown where the rotation is about it, and only there.
    unknown = np.isnan(np.einsum("nii->ni", found))
    turned = turn @ np.nan_to_num(found) @ turn.T
    mixed = (unknown.astype(float) @ np.abs(to.rotation).T) > 1e-9
    turned[mixed] = np.nan
    turned.swapaxes(1, 2)[mixed] = np.nan
    return turned


def expected_error(covariance: Array) -> Array:
    """Below what 95 % of position errors should lie, (n,) in metres, by covariances (n, 3, 3).

    Over the axes that are known; ``nan`` where none is. The squared length of a normal
    error is taken as a multiple of chi-squared with the same mean and variance (Box, Ann.
    Math. Stat. 25 (1954) 290), whose quantile is Wilson and Hilferty's (PNAS 17 (1931)
    684): within 2 % of the length for one axis, 1 % for more.
    """
    filled = np.nan_to_num(covariance)
    mean = np.einsum("nii->n", filled)
    spread = np.einsum("nij,nij->n", filled, filled)
    known = np.isfinite(np.einsum("nii->ni", covariance)).any(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        freedom = mean**2 / spread
        part = 2 / (9 * freedom)
        quantile = (1 - part + _QUANTILE_95 * np.sqrt(part)) ** 3
    squared = np.where(spread > 0, mean * quantile, 0.0)
    return np.where(known, np.sqrt(squared), np.nan)


def usual_top(values: Array, edges: Array | None = None) -> float:
    """Upper end of a scale that shows all but wild values; these are named beside it.

    Where the ``edges`` of what was expected are not too far above, they are shown too.
    """
    finite = values[np.isfinite(values)]
    if not len(finite):
        return 1.0
    usual = 1.5 * float(np.percentile(finite, 98))
    top = 1.05 * min(float(finite.max()), usual) or 1.0
    if edges is None or not np.isfinite(edges).any():
        return top
    return max(top, min(1.2 * float(np.nanmedian(edges)), MOST_ROOM * top))
