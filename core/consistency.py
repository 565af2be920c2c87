"""Whether the covariances of an estimate fit its errors.

The normalised estimation error squared of a pose is e' C^-1 e, with its error e (position,
and rotation vector of R_estimate R_truth^-1, both along the axes of the frame) and its reported
covariance C. Where the errors are normal and the covariances right, it is chi-squared with as
many degrees of freedom as e has components (Bar-Shalom, Li and Kirubarajan, Estimation with
Applications to Tracking and Navigation, 2001, section 5.4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import Similarity
from locatk.core.orientation import rotation_vector

Array = NDArray[np.float64]

SINGULAR = 1e-12
"""What is left of a variance, given the components before it, below which a component is told
by these and counts no more."""

EDGES = (np.nan, 3.841459, 5.991465, 7.814728, 9.487729, 11.070498, 12.591587)
MEDIANS = (np.nan, 0.454936, 1.386294, 2.365974, 3.356694, 4.351460, 5.348121)
"""95 % and 50 % quantiles of chi-squared by degrees of freedom, 0 to 6. Written down: scipy,
against which a test holds them, takes longer to import than all else here to compute."""

FITTING = 1.5
"""Errors that differ by no more from what covariances say are no reason to distrust them: the
poses of one drive share errors, so that their mean strays further than that of draws."""

NORMAL = 1.959964
"""Of 95 %, in both directions."""


@dataclass(frozen=True)
class Consistency:
    """Normalised errors squared (NEES) of n poses with covariance.

    Attributes
    ----------
    n : int
        Poses that report a covariance.
    mean : float
        Sum of the NEES over the sum of the degrees of freedom: 1 where the covariances are
        right, 4 where all sigmas are half of what they should be.
    low, high : float
        In which 95 % of such means lie where the poses are independent. Those of one drive
        seldom are, and the mean then strays further.
    median : float
        Of NEES over the median of their chi-squared distribution: 1 as well, and hardly moved
        by a few poses that are far off.
    inside : float
        Share of the poses that lie in their own 95 % region.
    dof : float
        Mean degrees of freedom a pose.
    """

    n: int
    mean: float
    low: float
    high: float
    median: float
    inside: float
    dof: float

    @property
    def ratio(self) -> float:
        """How many times as large the errors are as the covariances say."""
        return float(np.sqrt(self.mean))

    def words(self) -> str:
        """What it says of the covariances, in one clause."""
        ratio = self.ratio
        errors = f"errors are {_times(ratio)} times as large as they say"
        if self.mean > self.high and self.median < self.mean / 2:
            errors += f", most of it by a few poses (by the median {_times(np.sqrt(self.median))})"
        if self.low <= self.mean <= self.high or 1 / FITTING < ratio < FITTING:
            return f"covariances fit: {errors}"
        return f"covariances are too {'small' if ratio > 1 else 'large'}: {errors}"


def _times(ratio: float) -> str:
    return "less than 0.01" if ratio < 0.01 else f"{ratio:.0f}" if ratio >= 10 else f"{ratio:.2g}"


def nees(
    offsets: Array,
    turns: Array | None,
    covariance: Array,
    alignment: Similarity,
    truth_covariance: Array | None = None,
) -> tuple[Array, NDArray[np.int64]]:
    """Normalised errors squared of poses and their degrees of freedom.

    Parameters
    ----------
    offsets : (n, 3) ndarray
        Aligned estimate minus truth, in metres, in the frame of the truth.
    turns : (n, 4) ndarray or None
        Aligned orientation times the inverse of the true one; nan where one is not told.
    covariance : (n, 6, 6) ndarray
        As reported, in the frame of the estimate. Components without a positive variance do
        not take part, nor those that the others determine.
    alignment : Similarity
        From estimate to truth; through its rotation and scale, errors are brought into the
        frame of the covariance.
    truth_covariance : (n, 6, 6) ndarray, optional
        Of the truth in its frame; what of it is nan counts as zero.

    Returns
    -------
    nees : (n,) ndarray
        ``nan`` where no component is known.
    dof : (n,) int ndarray
    """
    n = len(offsets)
    back = alignment.rotation  # rows times this: turned from the truth's frame to the estimate's
    error = np.full((6, n), np.nan)
    error[:3] = (offsets @ back / alignment.scale).T
    if turns is not None:
        error[3:] = (rotation_vector(turns) @ back).T
    spread = np.empty((6, 6, n))
    extra = None if truth_covariance is None else _turned(truth_covariance, back, alignment.scale)
    for i in range(6):
        for j in range(i + 1):
            spread[i, j] = covariance[:, i, j]
            if extra is not None:
                spread[i, j] += extra[:, i, j]
    return _squared(error, spread)


def _turned(covariance: Array, back: Array, scale: float) -> Array:
    """Covariances of the truth (n, 6, 6) along the axes and in the unit of the estimate."""
    turn = np.zeros((6, 6))
    turn[:3, :3], turn[3:, 3:] = back.T / scale, back.T
    return np.asarray(turn @ np.where(np.isfinite(covariance), covariance, 0.0) @ turn.T)


def _squared(error: Array, spread: Array) -> tuple[Array, NDArray[np.int64]]:
    """e' C^-1 e for all poses at once: C = L D L', column by column.

    ``error`` is (6, n), ``spread`` (6, 6, n) with its lower half filled.
    """
    n = error.shape[1]
    total, dof = np.zeros(n), np.zeros(n, np.int64)
    lower: list[list[Array]] = []  # L without its diagonal
    pivots: list[Array] = []  # D
    left: list[Array] = []  # L^-1 e
    for i in range(6):
        known = np.isfinite(spread[i, i]) & (spread[i, i] > 0) & np.isfinite(error[i])
        row: list[Array] = []
        rest = np.where(known, error[i], 0.0)
        pivot = np.where(known, spread[i, i], 0.0)
        for j in range(i):
            product = spread[i, j].copy()
            for k in range(j):
                product -= row[k] * pivots[k] * lower[j][k]
            with np.errstate(divide="ignore", invalid="ignore"):
                factor = np.where(known & (pivots[j] > 0), product / pivots[j], 0.0)
            factor[~np.isfinite(factor)] = 0.0  # a correlation that is not known
            row.append(factor)
            rest = rest - factor * left[j]
            pivot = pivot - factor * factor * pivots[j]
        counts = known & (pivot > SINGULAR * np.where(known, spread[i, i], 1.0))
        pivot = np.where(counts, pivot, 0.0)
        total += np.where(counts, rest * rest / np.where(counts, pivot, 1.0), 0.0)
        dof += counts
        lower.append(row)
        pivots.append(pivot)
        left.append(np.where(counts, rest, 0.0))
    return np.where(dof > 0, total, np.nan), dof


def consistency(values: Array, dof: NDArray[np.int64]) -> Consistency | None:
    """Summary of the NEES (n,) of poses; None where no pose has one."""
    known = np.isfinite(values) & (dof > 0)
    if not known.any():
        return None
    values, dof = values[known], dof[known]
    total = int(dof.sum())
    return Consistency(
        n=len(values),
        mean=float(values.sum() / total),
        low=mean_quantile(total, -NORMAL),
        high=mean_quantile(total, NORMAL),
        median=float(np.median(values / np.array(MEDIANS)[dof])),
        inside=float(np.mean(values <= np.array(EDGES)[dof])),
        dof=total / len(values),
    )


def mean_quantile(dof: int, normal: float) -> float:
    """Chi-squared over ``dof`` where the normal distribution is at ``normal``.

    Wilson and Hilferty, PNAS 17 (1931) 684; 1 % off at 10 degrees of freedom, 0.1 % from 100
    on.
    """
    ninth = 2 / (9 * dof)
    return max(0.0, float((1 - ninth + normal * np.sqrt(ninth)) ** 3))
