"""Maximum likelihood of one pass: magnets, height and the way of the array, all at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

from locatk.core.errors import DegenerateError
from locatk.core.polaris.detection.fit_problem import (
    FIXED,
    GLOBALS,
    NUISANCES,
    Normal,
    Problem,
    Trial,
    solve_scaled,
)
from locatk.core.polaris.detection.window import Priors, State, Window
from locatk.core.robust import robust_sigma

Array = NDArray[np.float64]

ROBUST_FREEDOM = 4.0
"""Degrees of freedom of Student's t by which samples are weighted once the fit stands."""

REWEIGHTED = 2
"""How often."""

SEEN = 9.0
"""Squares, in units of the noise, by which a nuisance must explain the samples better to be
believed. Before that it only widens the covariance: none of them is the rule, and each
costs accuracy where it is none."""


@dataclass(frozen=True)
class Fitted:
    """The best of the hypotheses near a start.

    Attributes
    ----------
    state : State
    residual : (n, N, 3) ndarray
        In standard deviations of the noise; ``nan`` where there is no sample.
    cost : float
        Weighted squares and priors.
    sigma : float
        Rms of the residual over the degrees of freedom.
    usual_sigma : float
        The same by the median, which no outlier moves.
    shared : float
        Mean square of what all sensors share of it, in units of the noise: 1 where that is
        noise alone.
    covariance : (3 M, 3 M) ndarray
        Of x, y and angle of each magnet, in m and rad, with the noise as stated.
    path_sigma_m : (n,) ndarray
        Of the path against where most is felt, with the noise as stated; 0 where it is known.
    height_sigma_m : float
    converged : bool
    """

    state: State
    residual: Array
    cost: float
    sigma: float
    usual_sigma: float
    shared: float
    covariance: Array
    path_sigma_m: Array
    height_sigma_m: float
    converged: bool


def fit(
    window: Window,
    start: State,
    priors: Priors,
    *,
    iterations: int = 30,
    tolerance: float = 4e-5,
    final: bool = True,
) -> Fitted:
    """The most likely state near ``start``.

    ``final`` asks for all of it: outliers weighted down, nuisances where the samples show
    any, and the covariance.

    Raises
    ------
    DegenerateError
        The samples do not determine it.
    """
    weight = np.isfinite(window.field_t) * window.counts[:, None, None] / window.noise_t**2
    try:
        with np.errstate(divide="raise", over="raise", invalid="raise"):
            return _fit(window, start, priors, weight, iterations, tolerance, final)
    except (np.linalg.LinAlgError, FloatingPointError):
        raise DegenerateError("the samples do not determine the magnets") from None


def _fit(
    window: Window,
    start: State,
    priors: Priors,
    weight: Array,
    iterations: int,
    tolerance: float,
    final: bool,
) -> Fitted:
    problem = Problem(window, priors, weight, start)
    trial, converged = _descend(problem, problem.project(start), iterations, tolerance)
    if not final:
        return _fitted(problem, trial, weight, converged, None)
    if _outliers(_residual(problem, trial)):
        for _ in range(REWEIGHTED):
            problem = _reweighted(problem, trial, weight, start)
            trial, converged = _descend(problem, problem.project(trial.state), 5, tolerance)
    while True:
        normal = _all_free(problem, trial)
        seen = _seen(problem, normal, len(start.place_m))
        if not seen:
            return _fitted(problem, trial, weight, converged, normal)
        problem.free |= {seen}
        trial, converged = _descend(problem, problem.project(trial.state), 10, tolerance)


def _descend(
    problem: Problem, trial: Trial, iterations: int, tolerance: float
) -> tuple[Trial, bool]:
    damping = 1e-3
    for _ in range(iterations):
        normal = problem.normal(trial)
        while True:
            fresh = problem.project(problem.step(trial, normal, damping))
            if fresh.cost <= trial.cost:
                break
            damping *= 8
            if damping > 1e6:
                return trial, True
        gain = trial.cost - fresh.cost
        trial, damping = fresh, max(damping / 10, 1e-9)
        if gain < tolerance * trial.cost:
            return trial, True
    return trial, False


def _residual(problem: Problem, trial: Trial) -> Array:
    """(n, N, 3) residual in standard deviations, ``nan`` where there is no sample."""
    shown = np.where(problem.root > 0, trial.residual, np.nan)
    return shown.T.reshape(problem.window.field_t.shape)


def _unweighted(problem: Problem, trial: Trial, weight: Array) -> Array:
    """The residual (n, N, 3) as if no sample had been weighted down."""
    used = problem.root.T.reshape(weight.shape)
    return _residual(problem, trial) * np.sqrt(weight) / np.where(used > 0, used, 1.0)


def _outliers(residual: Array) -> bool:
    """Whether samples stand out that a normal distribution does not have."""
    z = np.abs(residual[np.isfinite(residual)])
    return bool(np.mean(z > 3.5 * max(1.0, 1.4826 * float(np.median(z)))) > 0.002)


def _reweighted(problem: Problem, trial: Trial, weight: Array, start: State) -> Problem:
    """The same with samples weighted by Student's t of their own residual."""
    z = np.nan_to_num(_unweighted(problem, trial, weight))
    scale = max(1.0, float(np.median(np.abs(z[weight > 0])) * 1.4826))
    share = (ROBUST_FREEDOM + 1) / (ROBUST_FREEDOM + (z / scale) ** 2)
    return Problem(problem.window, problem.priors, weight * share, start)


def _all_free(problem: Problem, trial: Trial) -> Normal:
    """Normal equations in which no nuisance is taken for zero."""
    closed, problem.free = problem.free, frozenset(NUISANCES)
    normal = problem.normal(trial)
    problem.free = closed
    return normal


def _seen(problem: Problem, normal: Normal, magnets: int) -> str:
    """The nuisance that would explain the samples best, "" where none is needed.

    A score test: the fall of the cost is predicted from the normal equations in which it
    is free.
    """
    places = {
        "crab": [2 * magnets + GLOBALS.index("crab_rad")],
        "tilt": [normal.moments + 3 * k + 2 for k in range(magnets)],
    }
    closed = [name for name in NUISANCES if name not in problem.free]
    gains = {}
    for name in closed:
        gram = normal.gram.copy()
        for other in closed:
            if other != name:
                at = places[other]
                gram[at, at] *= FIXED
        gain = float(normal.side @ solve_scaled(gram, normal.side))
        gains[name] = gain - len(places[name])
    best = max(gains, key=gains.__getitem__, default="")
    return best if best and gains[best] > SEEN else ""


def _fitted(
    problem: Problem, trial: Trial, weight: Array, converged: bool, normal: Normal | None
) -> Fitted:
    window, state = problem.window, trial.state
    residual = _unweighted(problem, trial, weight)
    count = int(np.isfinite(residual).sum())
    unknowns = 5 * len(state.place_m) + len(problem.background_gram)
    if window.path_m is None:
        unknowns += len(window.frames)
    share = np.sqrt(count / max(count - unknowns, 1))
    sigma = float(np.sqrt(np.nansum(residual**2) / max(count, 1)) * share)
    usual = robust_sigma(residual) * float(share)
    shared = problem.shared_square(trial)
    if normal is None:
        size = 3 * len(state.place_m)
        nothing = np.full((size, size), np.nan)
        path = np.full(len(window.frames), np.nan)
        return Fitted(
            state, residual, trial.cost, sigma, usual, shared, nothing, path, np.nan, converged
        )
    covariance, path, height = _covariances(normal, state)
    return Fitted(
        state, residual, trial.cost, sigma, usual, shared, covariance, path, height, converged
    )


def _covariances(normal: Normal, state: State) -> tuple[Array, Array, float]:
    """Covariance (3 M, 3 M) of places and angles; standard deviations of path and height."""
    m = len(state.place_m)
    full = solve_scaled(normal.gram, np.eye(len(normal.gram)))
    # From x, y and moment to x, y and angle.
    jacobian = np.zeros((3 * m, len(full)))
    square = (state.moment_am2[:, :2] ** 2).sum(axis=1)
    for k in range(m):
        jacobian[3 * k, k] = jacobian[3 * k + 1, m + k] = 1.0
        at = normal.moments + 3 * k
        jacobian[3 * k + 2, at] = -state.moment_am2[k, 1] / square[k]
        jacobian[3 * k + 2, at + 1] = state.moment_am2[k, 0] / square[k]
    path = np.zeros(len(state.path_m))
    if normal.band is not None and normal.coupling is not None:
        own = solveh_banded(normal.band, np.eye(len(path)), check_finite=False)
        through = np.einsum("nq,qr,nr->n", normal.coupling, full, normal.coupling, optimize=True)
        path = np.sqrt(np.maximum(np.diag(own) + through, 0.0))
    height = float(np.sqrt(full[2 * m, 2 * m]))
    return jacobian @ full @ jacobian.T, path, height
