"""Estimation in the presence of outliers: consensus by random sampling, and robust scale."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MAX_SAMPLED_CORRESPONDENCES = 256
"""Maximum number of correspondences from which samples are drawn; it bounds the memory."""

MAX_SCORED_CORRESPONDENCES = 600
"""Maximum number of correspondences on which candidate models are compared."""

MAX_REFITS = 10
"""Maximum number of refits on the inliers; two or three are usual until these are stable."""

SIGMA_PER_MEDIAN_ABSOLUTE = 1.4826
"""Standard deviation of a normal distribution, relative to its median absolute value: the inverse
of its quantile at 3/4."""


def consensus(
    fit: Callable[[Array, Array], Array],
    residuals: Callable[[Array, Array, Array], Array],
    a: Array,
    b: Array,
    *,
    sample_size: int,
    gate: float,
    trials: int = 300,
    seed: int = 0,
) -> tuple[Array, NDArray[np.bool_]]:
    """Fit the model with the most correspondences within a gate (RANSAC), refined on them.

    Parameters
    ----------
    fit : callable
        From corresponding points (..., n, d), (..., n, d) to models (..., p, q).
    residuals : callable
        From models (..., p, q) and points (n, d), (n, d) to residuals (..., n).
    a, b : (n, d) ndarray
        Correspondences.
    sample_size : int
        Number of correspondences that determine a model.
    gate : float
        Residual up to which a correspondence agrees, in the unit of ``residuals``.
    trials : int
        Random samples; all are fitted and scored in one batch.
    seed : int
        Seed of the random samples: equal inputs and seeds give equal results.

    Returns
    -------
    model : (p, q) ndarray
    inliers : (n,) bool ndarray

    Notes
    -----
    Fischler and Bolles 1981, scored by truncated squares (MSAC, Torr and Zisserman 2000),
    then refitted until the set of inliers is stable.
    """
    rng = np.random.default_rng(seed)
    n = len(a)
    pool = rng.permutation(n)[:MAX_SAMPLED_CORRESPONDENCES]
    keys = rng.random((trials, len(pool)))
    samples = pool[np.argpartition(keys, min(sample_size, len(pool)) - 1, axis=1)[:, :sample_size]]
    scored = np.linspace(0, n - 1, min(n, MAX_SCORED_CORRESPONDENCES)).astype(int)
    models = fit(a[samples], b[samples])
    errors = np.abs(residuals(models, a[scored], b[scored]))
    cost = np.sum(np.minimum(np.nan_to_num(errors, nan=np.inf) / gate, 1.0) ** 2, axis=-1)
    model = models[int(np.argmin(cost))]
    inliers = np.abs(residuals(model, a, b)) < gate
    for _ in range(MAX_REFITS):
        if np.count_nonzero(inliers) < sample_size:
            break
        model = fit(a[inliers], b[inliers])
        updated = np.abs(residuals(model, a, b)) < gate
        if np.array_equal(updated, inliers):
            break
        inliers = updated
    return model, inliers


def robust_sigma(residuals: Array) -> float:
    """Estimate a standard deviation about zero from the median absolute value.

    ``nan`` values are left out; 0.0 if no other value is left.
    """
    finite = np.abs(residuals[np.isfinite(residuals)])
    return float(SIGMA_PER_MEDIAN_ABSOLUTE * np.median(finite)) if len(finite) else 0.0
