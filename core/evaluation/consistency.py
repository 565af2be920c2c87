"""Consistency of an estimate: do its covariances fit its errors?

The normalized estimation error squared (NEES) of a pose is e' C^-1 e, with its error e (position,
and rotation vector of R_estimate R_truth^-1, both along the axes of the frame) and its reported
covariance C. If the errors are normal and the covariances right, it is chi-squared distributed
with as many degrees of freedom as e has components (Bar-Shalom, Li and Kirubarajan, Estimation
with Applications to Tracking and Navigation, 2001, section 5.4).

Poses of one drive share errors. The mean NEES of correlated errors deviates from 1 as that of fewer
independent ones: if w_i are the normalized errors, with covariance 1 and autocorrelation rho_j,

    var(sum w_i^2) = 2 n (1 + 2 sum_j (1 - j/n) rho_j^2),

and a chi-squared variable of n / (1 + 2 sum_j ...) degrees of freedom, scaled to the same mean, has
the same variance (Satterthwaite). :func:`shared_error_length` estimates the denominator.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

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

MAX_UNRESERVED_SIGMA_RATIO = 2.0
"""Ratio of actual to reported sigmas, or its inverse, that the errors must exclude for a verdict
without reservation. Eight independent numbers exclude it, by the quantiles of chi-squared."""

MIN_RATIO_IN_WORDS = 1.1
"""Ratio of sigmas from which on it is a factor in texts, and not a difference in percent."""

MAX_LENGTH_ITERATIONS, LENGTH_TOLERANCE = 100, 1e-4
"""Limits of the fixed-point iteration in :func:`shared_error_length`, which ascends steadily."""

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
        Central 95 % interval of this mean for as many independent errors, if the covariances are
        right.
    median : float
        Median of the NEES over the median of their chi-squared distribution: 1 as well, but
        robust against a few outliers.
    inside : float
        Fraction of the poses inside their own 95 % region.
    dof : float
        Mean degrees of freedom of a pose.
    independent : float
        Effective number of independent errors, from their autocorrelation.
    """

    n: int
    mean: float
    low: float
    high: float
    median: float
    inside: float
    dof: float
    independent: float

    @property
    def verdict(self) -> str:
        """``"fit"`` if the mean NEES is in its interval, else ``"too_small"`` or ``"too_large"``.

        The latter refer to the sigmas.
        """
        if self.low <= self.mean <= self.high:
            return "fit"
        return "too_small" if self.mean > 1 else "too_large"

    @property
    def sigma_ratio(self) -> float:
        """Ratio of the actual errors to the reported sigmas: 1.4 if these are 1.4 times too small.

        That of all errors, even if the verdict is ``"fit"``.
        """
        return float(np.sqrt(self.mean))

    @property
    def sigma_ratio_interval(self) -> tuple[float, float]:
        """95 % confidence interval of :attr:`sigma_ratio`; the second may be infinite."""
        low = float(np.sqrt(self.mean / self.high))
        return low, float(np.sqrt(self.mean / self.low)) if self.low > 0 else np.inf

    def describe(self) -> str:
        """Return the verdict on the covariances for people, in one clause."""
        low, high = self.sigma_ratio_interval
        independent = f"{self.independent:.0f} independent error{'s' * (self.independent >= 1.5)}"
        nees = f"NEES {self.mean:.3g} per degree of freedom"
        band = f"{self.low:.2f} to {self.high:.2f}"
        if self.verdict == "fit":
            limit = MAX_UNRESERVED_SIGMA_RATIO
            if 1 / limit <= low and high <= limit:
                return f"covariances fit: {nees}, {band} expected of {independent}"
            most = "any number of" if np.isinf(high) else f"{high:.2g}"
            return (
                f"covariances fit as far as {independent} can show: {nees}, {band} expected; the "
                f"right sigmas may be {low:.2g} to {most} times the reported ones"
            )
        ratio, size = self.sigma_ratio, self.verdict.replace("_", " ")
        text = f"sigmas are {_excess(ratio)} {size}: {nees}, {band} expected of {independent}"
        if self.verdict == "too_small" and self.median < self.mean / 2:
            text += (
                f", mostly because of a few poses (by the median: {np.sqrt(self.median):.2g} times)"
            )
        return text

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON form."""
        low, high = self.sigma_ratio_interval
        return {
            **asdict(self),
            "verdict": self.verdict,
            "sigma_ratio": self.sigma_ratio,
            "sigma_ratio_low": low,
            "sigma_ratio_high": high if np.isfinite(high) else None,
        }


def _excess(ratio: float) -> str:
    """Return how much larger or smaller the one sigma is, as a factor or in percent."""
    factor = max(ratio, 1 / ratio) if ratio > 0 else np.inf
    if factor < MIN_RATIO_IN_WORDS:
        return f"{max(round(100 * (factor - 1)), 1)} %"
    if factor > 100:
        return "more than 100 times"
    return f"{factor:.0f} times" if factor >= 10 else f"{factor:.2g} times"


def normalize_errors(
    residuals: Array,
    rotation_errors: Array | None,
    covariance: Array,
    alignment: Similarity,
    truth_covariance: Array | None = None,
) -> Array:
    """Normalize the errors of poses by their covariances, so that these become the identity.

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
    (n, 6) ndarray
        L^-1 e with C = L L'; ``nan`` for components that are not counted. The sum of their squares
        is the NEES (:func:`nees_of`).
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
    return _whiten(error, total_covariance)


def _whiten(error: Array, covariance: Array) -> Array:
    """Compute D^-1/2 L^-1 e of all poses at once by C = L D L', column by column.

    ``error`` is (6, n); ``covariance`` is (6, 6, n), of which the lower triangle is used.
    """
    normalized = np.full((error.shape[1], 6), np.nan)
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
        normalized[counts, i] = remainder[counts] / np.sqrt(pivot[counts])
        lower.append(row)
        pivots.append(pivot)
        whitened.append(np.where(counts, remainder, 0.0))
    return normalized


def nees_of(normalized: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return the NEES (n,) of normalized errors (n, 6), ``nan`` if none is known, and their dof."""
    dof = np.isfinite(normalized).sum(axis=1)
    return np.where(dof > 0, np.nansum(normalized**2, axis=1), np.nan), dof


def summarize_consistency(series: Sequence[Array]) -> Consistency | None:
    """Summarize normalized errors; None if no pose has one.

    Parameters
    ----------
    series : sequence of (n, 6) ndarray
        Normalized errors of each device (or run), in the order of time. Errors of different
        devices and components count as independent.
    """
    nees, dof = nees_of(np.concatenate(series))
    is_known = dof > 0
    if not is_known.any():
        return None
    nees, dof = nees[is_known], dof[is_known]
    total_dof = int(dof.sum())
    columns = [column[np.isfinite(column)] for each in series for column in each.T]
    shared = sum(len(each) * shared_error_length(each) for each in columns if len(each))
    effective_dof = total_dof**2 / shared
    return Consistency(
        n=len(nees),
        mean=float(nees.sum() / total_dof),
        low=reduced_chi2_quantile(effective_dof, -NORMAL_95_QUANTILE),
        high=reduced_chi2_quantile(effective_dof, NORMAL_95_QUANTILE),
        median=float(np.median(nees / np.array(CHI2_MEDIANS)[dof])),
        inside=float(np.mean(nees <= np.array(CHI2_95_QUANTILES)[dof])),
        dof=total_dof / len(nees),
        independent=effective_dof * len(nees) / total_dof,
    )


def shared_error_length(errors: Array) -> float:
    """Estimate how many successive errors (n,) share one random value; 1 if all are independent.

    The model are passes: errors are equal until they change to an independent value, with a
    probability of 1 - a from each pose to the next. Their autocorrelation is a^j, and the effective
    number of independent errors n (1 - a) / (1 + a). From the sum S of the squared
    autocorrelations over all lags follows a by S = (1 + a^2) / (1 - a^2).

    S is also increased by chance correlations between p passes, by (2 p + 1) / (p + 2): a
    normalized series of p independent normal numbers has E[r_j^2] = (p - j) / (p (p + 2)). The mean
    of the errors is known to be 0 and not subtracted: a constant error is shared by all. The scale
    of the errors does not matter. If errors change gradually, the result is up to twice too large.
    """
    n = len(errors)
    size = 1 << (2 * n - 1).bit_length()
    spectrum = np.abs(np.fft.rfft(errors, size)) ** 2
    # Parseval: the sum of squares over the lags is that over the frequencies.
    by_lag = (2 * np.sum(spectrum**2) - spectrum[0] ** 2 - spectrum[-1] ** 2) / size
    energy = float(errors @ errors)
    if not energy > 0:
        return float(n)
    total, length = float(by_lag) / energy**2, 1.0
    for _ in range(MAX_LENGTH_ITERATIONS):
        passes = n / length
        squares = max(total * (passes + 2) / (2 * passes + 1), 1.0)
        persistence = np.sqrt((squares - 1) / (squares + 1))
        previous, length = length, min((1 + persistence) / (1 - persistence), float(n))
        if length - previous <= LENGTH_TOLERANCE * previous:
            break
    return float(length)


def reduced_chi2_quantile(dof: float, normal_quantile: float) -> float:
    """Return the quantile of chi-squared over ``dof`` that matches a standard normal quantile.

    Wilson and Hilferty, PNAS 17 (1931) 684; the error is 1 % at 10 degrees of freedom and 0.1 %
    from 100 on.
    """
    ninth = 2 / (9 * dof)
    return max(0.0, float((1 - ninth + normal_quantile * np.sqrt(ninth)) ** 3))
