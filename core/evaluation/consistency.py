"""Consistency of an estimate: do its covariances fit its errors?

The normalized estimation error squared (NEES) of a pose is e' C^-1 e, with its error e (position,
and rotation vector of R_estimate R_truth^-1, both along the axes of the frame) and its reported
covariance C. If the errors are normal and the covariances right, it is chi-squared distributed
with as many degrees of freedom as e has components (Bar-Shalom, Li and Kirubarajan, Estimation
with Applications to Tracking and Navigation, 2001, section 5.4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import (
    Similarity,
    rotation_vector_from_quaternion,
    transform_covariance,
)

Array = NDArray[np.float64]

MIN_CONDITIONAL_VARIANCE_RATIO = 1e-12
"""Ratio of a component's variance given the components before it to its variance, below which these
determine the component and it is not counted."""

CHI2_95_QUANTILES = (np.nan, 3.841459, 5.991465, 7.814728, 9.487729, 11.070498, 12.591587)
CHI2_MEDIANS = (np.nan, 0.454936, 1.386294, 2.365974, 3.356694, 4.351460, 5.348121)
"""95 % and 50 % quantiles of the chi-squared distribution with 0 to 6 degrees of freedom. They are
tabulated because importing scipy takes longer than the whole computation; a test compares them."""

MAX_CONSISTENT_ERROR_RATIO = 1.5
"""Ratio of actual to reported errors, or its inverse, up to which covariances count as consistent:
the poses of one drive share errors, so that their mean deviates more than that of independent
draws."""

NORMAL_95_QUANTILE = 1.959964
"""Half width of the central 95 % interval of the standard normal distribution."""


@dataclass(frozen=True)
class Consistency:
    """Summary of the normalized errors squared (NEES) of n poses with covariance.

    Attributes
    ----------
    n : int
        Number of poses that report a covariance.
    mean : float
        Sum of the NEES divided by the sum of the degrees of freedom: 1 if the covariances are
        right, 4 if all sigmas are half of the right ones.
    low, high : float
        Central 95 % interval of this mean for independent poses. The poses of one drive are
        rarely independent, and the mean then deviates more.
    median : float
        Median of the NEES over the median of their chi-squared distribution: 1 as well, but
        robust against a few outliers.
    inside : float
        Fraction of the poses inside their own 95 % region.
    dof : float
        Mean degrees of freedom of a pose.
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
        """Ratio of the actual errors to the reported ones."""
        return float(np.sqrt(self.mean))

    def describe(self) -> str:
        """Return the verdict on the covariances for people, in one clause."""
        ratio = self.ratio
        errors = f"errors are {_ratio_text(ratio)} times as large as predicted"
        if self.mean > self.high and self.median < self.mean / 2:
            by_median = _ratio_text(np.sqrt(self.median))
            errors += f", mostly because of a few poses (by the median {by_median})"
        within_limit = 1 / MAX_CONSISTENT_ERROR_RATIO < ratio < MAX_CONSISTENT_ERROR_RATIO
        if self.low <= self.mean <= self.high or within_limit:
            return f"covariances fit: {errors}"
        return f"covariances are too {'small' if ratio > 1 else 'large'}: {errors}"


def _ratio_text(ratio: float) -> str:
    return "less than 0.01" if ratio < 0.01 else f"{ratio:.0f}" if ratio >= 10 else f"{ratio:.2g}"


def compute_nees(
    residuals: Array,
    rotation_errors: Array | None,
    covariance: Array,
    alignment: Similarity,
    truth_covariance: Array | None = None,
) -> tuple[Array, NDArray[np.int64]]:
    """Compute the normalized errors squared of poses and their degrees of freedom.

    Parameters
    ----------
    residuals : (n, 3) ndarray
        Aligned estimate minus truth, in metres, in the frame of the truth.
    rotation_errors : (n, 4) ndarray or None
        Quaternion of the aligned orientation times the inverse of the true one; nan if unknown.
    covariance : (n, 6, 6) ndarray
        As reported, in the frame of the estimate. Components without a positive variance are left
        out, and so are those that are determined by the others.
    alignment : Similarity
        From estimate to truth; its rotation and scale transform errors into the frame of the
        covariance.
    truth_covariance : (n, 6, 6) ndarray, optional
        Covariance of the truth in its frame; its nan entries count as zero.

    Returns
    -------
    nees : (n,) ndarray
        ``nan`` if no component is known.
    dof : (n,) int ndarray
    """
    n = len(residuals)
    # Rows times this matrix are rotated from the frame of the truth to that of the estimate.
    to_estimate = alignment.rotation
    error = np.full((6, n), np.nan)
    error[:3] = (residuals @ to_estimate / alignment.scale).T
    if rotation_errors is not None:
        error[3:] = (rotation_vector_from_quaternion(rotation_errors) @ to_estimate).T
    total_covariance = np.empty((6, 6, n))
    added = None
    if truth_covariance is not None:
        known_covariance = np.where(np.isfinite(truth_covariance), truth_covariance, 0.0)
        added = transform_covariance(known_covariance, 1 / alignment.scale, to_estimate.T)
    for i in range(6):
        for j in range(i + 1):
            total_covariance[i, j] = covariance[:, i, j]
            if added is not None:
                total_covariance[i, j] += added[:, i, j]
    return _mahalanobis_squared(error, total_covariance)


def _mahalanobis_squared(error: Array, covariance: Array) -> tuple[Array, NDArray[np.int64]]:
    """Compute e' C^-1 e of all poses at once by C = L D L', column by column.

    ``error`` is (6, n); ``covariance`` is (6, 6, n), of which the lower triangle is used.
    """
    n = error.shape[1]
    nees, dof = np.zeros(n), np.zeros(n, np.int64)
    lower: list[list[Array]] = []  # L without its diagonal
    pivots: list[Array] = []  # D
    whitened: list[Array] = []  # L^-1 e
    for i in range(6):
        variance = covariance[i, i]
        is_known = np.isfinite(variance) & (variance > 0) & np.isfinite(error[i])
        row: list[Array] = []
        remainder = np.where(is_known, error[i], 0.0)
        pivot = np.where(is_known, variance, 0.0)
        for j in range(i):
            product = covariance[i, j].copy()
            for k in range(j):
                product -= row[k] * pivots[k] * lower[j][k]
            with np.errstate(divide="ignore", invalid="ignore"):
                factor = np.where(is_known & (pivots[j] > 0), product / pivots[j], 0.0)
            factor[~np.isfinite(factor)] = 0.0  # unknown correlations count as zero
            row.append(factor)
            remainder = remainder - factor * whitened[j]
            pivot = pivot - factor * factor * pivots[j]
        min_pivot = MIN_CONDITIONAL_VARIANCE_RATIO * np.where(is_known, variance, 1.0)
        counts = is_known & (pivot > min_pivot)
        pivot = np.where(counts, pivot, 0.0)
        nees += np.where(counts, remainder * remainder / np.where(counts, pivot, 1.0), 0.0)
        dof += counts
        lower.append(row)
        pivots.append(pivot)
        whitened.append(np.where(counts, remainder, 0.0))
    return np.where(dof > 0, nees, np.nan), dof


def summarize_nees(nees: Array, dof: NDArray[np.int64]) -> Consistency | None:
    """Summarize the NEES (n,) of poses; None if no pose has one."""
    is_known = np.isfinite(nees) & (dof > 0)
    if not is_known.any():
        return None
    nees, dof = nees[is_known], dof[is_known]
    total_dof = int(dof.sum())
    return Consistency(
        n=len(nees),
        mean=float(nees.sum() / total_dof),
        low=reduced_chi2_quantile(total_dof, -NORMAL_95_QUANTILE),
        high=reduced_chi2_quantile(total_dof, NORMAL_95_QUANTILE),
        median=float(np.median(nees / np.array(CHI2_MEDIANS)[dof])),
        inside=float(np.mean(nees <= np.array(CHI2_95_QUANTILES)[dof])),
        dof=total_dof / len(nees),
    )


def reduced_chi2_quantile(dof: int, normal_quantile: float) -> float:
    """Return the quantile of chi-squared over ``dof`` that matches a standard normal quantile.

    Wilson and Hilferty, PNAS 17 (1931) 684; the error is 1 % at 10 degrees of freedom and 0.1 %
    from 100 on.
    """
    ninth = 2 / (9 * dof)
    return max(0.0, float((1 - ninth + normal_quantile * np.sqrt(ninth)) ** 3))
