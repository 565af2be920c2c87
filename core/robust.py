"""Estimating in the presence of outliers: random sampling, damped steps and robust scale."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Costed(Protocol):
    """Normal equations at a state, with the robust cost there."""

    @property
    def cost(self) -> float: ...


State = TypeVar("State")
System = TypeVar("System", bound=Costed)

LEAST_DAMPING, MOST_DAMPING = 1e-9, 1e6

LEAST_GAIN = 1e-6
"""Share of the cost: a step that gains less is the last."""

POOL = 256
"""Correspondences from which samples are drawn, at most: enough to be fair, and it bounds
the memory."""


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
    pool = rng.permutation(n)[:POOL]
    dice = rng.random((trials, len(pool)))
    picks = pool[np.argpartition(dice, min(sample, len(pool)) - 1, axis=1)[:, :sample]]
    scored = np.linspace(0, n - 1, min(n, 600)).astype(int)
    models = fit(a[picks], b[picks])
    errors = np.abs(residuals(models, a[scored], b[scored]))
    cost = np.sum(np.minimum(np.nan_to_num(errors, nan=np.inf) / gate, 1.0) ** 2, axis=-1)
    model = models[int(np.argmin(cost))]
    inliers = np.abs(residuals(model, a, b)) < gate
    for _ in range(10):
        if np.count_nonzero(inliers) < sample:
            break
        model = fit(a[inliers], b[inliers])
        fresh = np.abs(residuals(model, a, b)) < gate
        if np.array_equal(fresh, inliers):
            break
        inliers = fresh
    return model, inliers


def descend(
    state: State,
    system: System,
    attempt: Callable[[State, System, float, int], tuple[State, System]],
    *,
    damping: float,
    iterations: int,
) -> tuple[State, System, int]:
    """Follow damped steps down to the least cost (Levenberg 1944, Marquardt 1963).

    Parameters
    ----------
    state
        Where to start.
    system
        The normal equations there.
    attempt : callable
        From a state, its system, the damping and the number of the step (from 1) to the next
        state and the system there.
    damping : float
        To begin with; a tenth after each step that gains, ten times as much after one that
        does not.
    iterations : int
        Steps, at most.

    Returns
    -------
    state, system, steps
        Of the least cost that was found.
    """
    steps = 0
    while steps < iterations:
        steps += 1
        trial, found = attempt(state, system, damping, steps)
        if found.cost < system.cost:
            gain = (system.cost - found.cost) / max(system.cost, 1e-30)
            state, system = trial, found
            damping = max(damping / 10, LEAST_DAMPING)
            if gain < LEAST_GAIN:
                break
        else:
            damping *= 10
            if damping > MOST_DAMPING:
                break
    return state, system, steps


def robust_sigma(residuals: Array) -> float:
    """Standard deviation estimated from the median absolute value (1.4826 MAD about
    zero); ``nan`` values are left out, 0.0 where nothing is left."""
    finite = np.abs(residuals[np.isfinite(residuals)])
    return float(1.4826 * np.median(finite)) if len(finite) else 0.0
