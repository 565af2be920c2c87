"""Estimation in the presence of outliers: consensus by random sampling, and robust scale."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


MAX_SAMPLED = 256
"""Number of correspondences from which samples are drawn, at most; it bounds the memory."""

MAX_SCORED = 600
"""Number of correspondences on which candidate models are compared, at most."""

MAX_REFITS = 10
"""Number of refits on the inliers, which settle in two or three."""


def consensus(
    fit: Callable[[Array, Array], Array],
    residuals: Callable[[Array, Array, Array], Array],
    a: Array,
    b: Array,
    *,
    sample: int,
    gate: float,
    trials: int = 300,
    seed: int = 0,
) -> tuple[Array, NDArray[np.bool_]]:
    """Model with the most correspondences within a gate (RANSAC), refined on them.

    Parameters
    ----------
    fit : callable
        From corresponding points (..., n, d), (..., n, d) to models (..., p, q).
    residuals : callable
        From models (..., p, q) and points (n, d), (n, d) to residuals (..., n).
    a, b : (n, d) ndarray
        Correspondences.
    sample : int
        How many determine a model.
    gate : float
        Residual up to which a correspondence agrees, in the unit of ``residuals``.
    trials : int
        Random samples; all are fitted and scored in one batch.
    seed : int
        Same seed, same answer.

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
    pool = rng.permutation(n)[:MAX_SAMPLED]
    keys = rng.random((trials, len(pool)))
    samples = pool[np.argpartition(keys, min(sample, len(pool)) - 1, axis=1)[:, :sample]]
    scored = np.linspace(0, n - 1, min(n, MAX_SCORED)).astype(int)
    models = fit(a[samples], b[samples])
    errors = np.abs(residuals(models, a[scored], b[scored]))
    cost = np.sum(np.minimum(np.nan_to_num(errors, nan=np.inf) / gate, 1.0) ** 2, axis=-1)
    model = models[int(np.argmin(cost))]
    inliers = np.abs(residuals(model, a, b)) < gate
    for _ in range(MAX_REFITS):
        if np.count_nonzero(inliers) < sample:
            break
        model = fit(a[inliers], b[inliers])
        updated = np.abs(residuals(model, a, b)) < gate
        if np.array_equal(updated, inliers):
            break
        inliers = updated
    return model, inliers


def robust_sigma(residuals: Array) -> float:
    """Standard deviation estimated from the median absolute value (1.4826 MAD about
    zero); ``nan`` values are left out, 0.0 where nothing is left."""
    finite = np.abs(residuals[np.isfinite(residuals)])
    return float(1.4826 * np.median(finite)) if len(finite) else 0.0
