r"""Maximum-likelihood fit of one pass: magnets, height and path of the array together.

Problem
-------
The samples of a pass are the fields of M magnets, measured by an array that moves along its x axis
by an unknown step between samples, on a background of its own for each sensor and axis. Unknowns:

- positions of the magnets (2 M), height, skew (time between the conversions of two axes) and crab
  angle (between the array's x axis and its path): the nonlinear ones;
- moments (3 M) and backgrounds (a few Legendre polynomials per channel), which enter linearly;
- the path (n) and its mean step.

Method
------
Moments and backgrounds are solved for whenever the other unknowns are tried (variable projection;
Golub and Pereyra, SIAM J. Numer. Anal. 10 (1973) 413). The path couples only neighbouring samples,
so that its block of the normal equations is tridiagonal; it is eliminated before the rest is
solved, and an iteration costs little more than one evaluation of the field::

              others   path
            [  G       C    ]   others: positions, height, skew, crab, moments, mean step,
            [  C^T     T    ]           backgrounds; T is tridiagonal

:func:`locatk.core.least_squares.minimize` runs the damped iterations.

Priors: a step has about the mean length unless samples were lost (a Cauchy distribution: the
published recordings step by 2.1 mm, and by 9 mm when the host was busy); magnets are flat, and the
array moves along its x axis. The last two are *nuisances*: they are fixed at zero until a score
test shows that the samples contradict that, because each costs accuracy if it is zero.

Outliers are down-weighted by Student's t distribution after the first convergence.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded
from scipy.linalg.lapack import dposv
from scipy.ndimage import median_filter
from scipy.sparse import csr_array

from locatk.core.errors import DegenerateError
from locatk.core.least_squares import Indices, cauchy_loss, minimize
from locatk.core.polaris.detection.field_model import MagnetOffsets
from locatk.core.polaris.detection.motion import MOTION_GROUPS, BarPoses, Motion
from locatk.core.polaris.detection.window import PassPriors, PassWindow, trend_basis
from locatk.core.robust import SIGMA_PER_MEDIAN_ABSOLUTE, robust_sigma

Array = NDArray[np.float64]

BUILD_NUISANCES = ("crab", "tilt")
NUISANCES = (*BUILD_NUISANCES, *MOTION_GROUPS)
"""Unknowns that are fixed at zero until the samples contradict that: a path that is oblique to the
bar, magnets that are not flat, and the groups of :mod:`locatk.core.polaris.detection.motion`."""

COARSE_NUISANCES = ("curve", "attitude")
"""Those that a coarse fit estimates: without them it takes the residual for further magnets."""

WAVE_NUISANCES = ("height", "rocking")
"""Motions that are estimated only if errors of real sensors do not explain the residual: their many
unknowns follow such errors, and change the magnets more than the residual."""

GLOBAL_UNKNOWNS = ("height_m", "skew_periods", "crab_rad")
"""Attributes of :class:`PassState` that hold one number for the whole pass."""

FIXING_WEIGHT = 1e18
"""Information that fixes an unknown: far above that of any sample, in the units used here."""

FIXED_SIGMA_FRACTION = 1e-6
"""Standard deviation of a nuisance that is fixed, relative to the prior one."""

MAX_STEP_HEIGHTS = 0.7
"""Largest change of a magnet's position in one step of the fit, in heights: the derivatives are
useless farther away."""

HEIGHT_STEP_RATIOS = (0.7, 1.4)
"""Range of the height after a step of the fit, relative to the height before."""

MOMENT_SIGMA_FACTOR = 3.0
"""Standard deviation of the horizontal components of a moment, relative to the expected one."""

STUDENT_FREEDOM = 4.0
"""Degrees of freedom of Student's t distribution, by which samples are weighted."""

REWEIGHTING_ROUNDS = 2
"""Number of fits with reweighted samples."""

OUTLIER_SIGMAS, MAX_OUTLIER_FRACTION = 3.5, 0.002
"""Residual beyond which a sample is an outlier, and the fraction of such samples from which they
are reweighted: four times that of a normal distribution."""

MIN_NUISANCE_GAIN = 9.0
"""Decrease of the cost beyond the number of unknowns from which crab or tilt are estimated."""

MIN_MOTION_EVIDENCE = 18.4
"""Twice the logarithm of the Bayes factor from which a motion is estimated: a factor of 10,000,
which leaves a hundred to one if one pass of a hundred has such a motion."""

FIXED_WORK_UNKNOWNS, MOTION_WORK_UNKNOWNS = 110, 4
"""Unknowns that would take as much time as the part of an iteration that does not depend on their
number, and as a coefficient of the motion; measured."""

MIN_EXPLAINED_FRACTION = 0.15
"""Fraction of the squares beyond the noise that a motion explains at least: one that leaves more
than the rest is not their cause: magnets are missing."""

MAX_SENSOR_RESIDUAL_SIGMAS = 1.3
"""Rms residual up to which the errors of real sensors (gains, axes) explain it; above it, attitude
and height are estimated, and weak sources added. The published recordings reach 1.26."""

MAX_MOTION_RESIDUAL_SIGMAS = 2.0
"""Rms residual up to which a motion is believed, that from which a tag is refused: above it, the
samples have another cause, which a motion would only hide."""

MIN_WAVE_RESIDUAL_SIGMAS = 1.0
"""Rms residual from which height and rocking are tested, which have many unknowns: below it, they
have nothing to explain."""

CLUSTER_HEIGHTS = 1.0
"""Length of path within which the errors of a sensor's samples are correlated, in heights: half the
width of a magnet's field."""

COARSE_ITERATIONS, COARSE_GAIN_FRACTION = 20, 1e-3
"""Steps that a coarse fit tries, and the relative decrease of the cost that ends it."""

FINE_ITERATIONS, FINE_GAIN_FRACTION = 45, 4e-5
"""The same for the final fit."""

REWEIGHTED_ITERATIONS, NUISANCE_ITERATIONS = 8, 15
"""Steps tried by a fit that continues from a minimum: with new weights, with another nuisance."""

MAX_LOG_ODDS = 60.0
"""Bound of twice the logarithm of a Bayes factor, before it is exponentiated."""

RELATIVE_RIDGE = 1e-13
"""Added to the unit diagonal of scaled normal equations."""


@dataclass(frozen=True)
class PassState:
    """Unknowns of one pass.

    Attributes
    ----------
    position_m : (M, 2) ndarray
        Positions of the magnets.
    moment_am2 : (M, 3) ndarray
    path_m : (n,) ndarray
        Position of the array along the track at each sample.
    mean_step_m : float
        Mean distance moved in a sample period.
    height_m, skew_periods, crab_rad : float
        See :class:`~locatk.core.polaris.detection.window.PassPriors`.
    motion : Motion or None
        Curve, attitude and height along the path; None if it is straight and level.
    free : frozenset of str
        :data:`NUISANCES` that are estimated.
    """

    position_m: Array
    moment_am2: Array
    path_m: Array
    mean_step_m: float
    height_m: float
    skew_periods: float = 0.0
    crab_rad: float = 0.0
    motion: Motion | None = None
    free: frozenset[str] = frozenset()

    @property
    def bar_poses(self) -> BarPoses | None:
        """Poses of the bar at each sample; None if the path is straight and level."""
        if self.motion is None or self.motion.is_straight:
            return None
        return self.motion.poses(self.path_m, self.crab_rad)


@dataclass(frozen=True)
class PassFit:
    """Result of a fit.

    Attributes
    ----------
    state : PassState
    residual : (n, N, 3) ndarray
        In standard deviations of the noise; ``nan`` if there is no sample.
    rms_sigma : float
        Rms of the residual, corrected for the number of unknowns.
    robust_sigma : float
        The same from the median, which outliers do not change.
    shared_square : float
        Mean square of the part of the residual that all sensors share, in units of the noise; 1
        if that is noise alone.
    covariance : (3 M, 3 M) ndarray
        Of x, y and angle of each magnet, in m and rad, for the noise as stated. It includes the
        prior uncertainty of crab and tilt, also while they are fixed at zero. ``nan`` after a
        coarse fit, like the next three.
    motion_covariance : (1 + K, 1 + K) ndarray
        Of crab and the coefficients of the motion.
    path_sigma_m : (n,) ndarray
        Of the path relative to the sample with the strongest field; 0 if the path is known.
    height_sigma_m : float
    significance : (M,) ndarray
        Square of each horizontal moment in standard deviations; ``inf`` after a coarse fit.
    converged : bool
    """

    state: PassState
    residual: Array
    rms_sigma: float
    robust_sigma: float
    shared_square: float
    covariance: Array
    motion_covariance: Array
    path_sigma_m: Array
    height_sigma_m: float
    significance: Array
    converged: bool


def fit_coarse(window: PassWindow, start: PassState, priors: PassPriors) -> PassFit:
    """Improve an initial guess, without outlier rejection and covariance.

    Of the nuisances, only :data:`COARSE_NUISANCES` are estimated, and only if the samples show
    any.

    Raises
    ------
    DegenerateError
        The samples do not determine the magnets.
    """
    weight = sample_weights(window)
    with _degenerate_on_numerical_errors():
        problem = PassProblem(window, priors, weight, start)
        equations, converged = _minimize(problem, start, COARSE_ITERATIONS, COARSE_GAIN_FRACTION)
        if problem.rms_residual(equations.projected) > MAX_SENSOR_RESIDUAL_SIGMAS:
            problem, equations, converged, _ = _estimate_nuisances(
                problem, equations, converged, COARSE_NUISANCES, COARSE_GAIN_FRACTION
            )
        return _result(problem, equations.projected, weight, converged, tests=None)


def fit_pass(
    window: PassWindow,
    start: PassState,
    priors: PassPriors,
    nuisances: tuple[str, ...] = NUISANCES,
) -> PassFit:
    """Return the most likely state near an initial guess, with its covariance.

    Outliers are down-weighted, and ``nuisances`` are estimated if the samples show any.

    Raises
    ------
    DegenerateError
        The samples do not determine the magnets.
    """
    weight = sample_weights(window)
    gain = FINE_GAIN_FRACTION
    with _degenerate_on_numerical_errors():
        problem = PassProblem(window, priors, weight, start)
        equations, converged = _minimize(problem, start, FINE_ITERATIONS, gain)
        if _has_outliers(problem.residual(equations.projected)):
            for _ in range(REWEIGHTING_ROUNDS):
                problem, equations, converged = _reweight(problem, equations, weight)
        straight, straight_equations, straight_converged = problem, equations, converged
        problem, equations, converged, tests = _estimate_nuisances(
            problem, equations, converged, nuisances, gain
        )
        if (problem.free - straight.free) & {*MOTION_GROUPS}:
            # Samples that only a wrong motion had made outliers count again.
            problem, equations, converged = _reweight(problem, equations, weight)
            tests = _test_nuisances(problem, equations.projected, nuisances)
            if problem.rms_residual(equations.projected) > MAX_MOTION_RESIDUAL_SIGMAS:
                problem, equations, converged, tests = _estimate_nuisances(
                    straight, straight_equations, straight_converged, BUILD_NUISANCES, gain
                )
        return _result(problem, equations.projected, weight, converged, tests)


def further_moments(
    window: PassWindow, fit: PassFit, priors: PassPriors, position_m: Array
) -> tuple[Array, Array]:
    """Estimate the moments of further magnets at given positions from the residual of a fit.

    Each is estimated as if there was no other one.

    Parameters
    ----------
    window, fit, priors
    position_m : (K, 2) ndarray
        In the frame of the fit.

    Returns
    -------
    moment_am2, sigma_am2 : (K,) ndarray
        Magnitude of the horizontal moment, and its standard deviation along the direction that the
        samples determine worst; ``inf`` if they do not determine it.
    """
    state = fit.state
    problem = PassProblem(window, priors, sample_weights(window), state)
    poses = state.bar_poses
    fields = problem.magnet_offsets(replace(state, position_m=position_m), poses).unit_fields()
    if poses is not None:
        fields = fields @ poses.rotation.transpose(0, 2, 1)[None, None]
    horizontal = fields[..., :2].reshape(*problem.shape, -1)
    rows = problem.whiten(horizontal)
    # Backgrounds explain a part of them.
    levels = problem.background_inverse @ (problem.background.transpose(0, 2, 1) @ rows)
    rows = (rows - problem.background @ levels).reshape(-1, len(position_m), 2).swapaxes(0, 1)
    residual = np.nan_to_num(fit.residual).reshape(len(fit.residual), -1).T.ravel()
    information = rows.swapaxes(1, 2) @ rows
    least = np.linalg.eigvalsh(information)[:, 0]
    sigma = 1 / np.sqrt(np.maximum(least, 1e-300))
    is_determined = least > 0
    moment = np.full(len(position_m), np.inf)
    right = rows[is_determined].swapaxes(1, 2) @ residual
    moment[is_determined] = np.linalg.norm(
        np.linalg.solve(information[is_determined], right[..., None])[..., 0], axis=1
    )
    return moment, np.where(is_determined, sigma, np.inf)


def _reweight(
    problem: PassProblem, equations: PassEquations, weight: Array
) -> tuple[PassProblem, PassEquations, bool]:
    """Fit again with samples weighted by their residuals; with equal weights without outliers."""
    projected = equations.projected
    if _has_outliers(problem.unweighted_residual(projected, weight)):
        weight = weight * _student_weights(problem, projected, weight)
    problem = PassProblem(problem.window, problem.priors, weight, projected.state)
    equations, converged = _minimize(
        problem, projected.state, REWEIGHTED_ITERATIONS, FINE_GAIN_FRACTION
    )
    return problem, equations, converged


def _estimate_nuisances(
    problem: PassProblem,
    equations: PassEquations,
    converged: bool,
    allowed: tuple[str, ...],
    min_gain: float,
) -> tuple[PassProblem, PassEquations, bool, NuisanceTests]:
    """Estimate nuisances one after the other, while the samples show another one.

    A motion that explains little of the residual is dropped: a fit from a wrong initial guess would
    spend all effort on them.
    """
    while True:
        tests = _test_nuisances(problem, equations.projected, allowed)
        if tests.significant is None:
            return problem, equations, converged, tests
        extended = problem.with_free(problem.free | {tests.significant})
        state = replace(tests.state, free=extended.free)
        fitted, has_converged = _minimize(extended, state, NUISANCE_ITERATIONS, min_gain)
        gain = equations.projected.cost - fitted.projected.cost
        if tests.significant in MOTION_GROUPS and gain < tests.min_motion_gain:
            return problem, equations, converged, tests
        problem, equations, converged = extended, fitted, has_converged


@contextmanager
def _degenerate_on_numerical_errors() -> Iterator[None]:
    """Raise :class:`DegenerateError` for singular matrices and for overflows."""
    try:
        with np.errstate(divide="raise", over="raise", invalid="raise"):
            yield
    except (np.linalg.LinAlgError, FloatingPointError):
        raise DegenerateError("the samples do not determine the magnets") from None


def sample_weights(window: PassWindow) -> Array:
    """Return the inverse variances (n, N, 3) of the averaged samples; 0 if missing."""
    is_finite = np.isfinite(window.field_t)
    return np.asarray(is_finite * window.counts[:, None, None] / window.noise_t**2)


def _minimize(
    problem: PassProblem, start: PassState, max_iterations: int, min_gain: float
) -> tuple[PassEquations, bool]:
    """Return the equations at the minimum near ``start``, and whether the fit converged."""
    effort = problem.window.effort
    iterations = min(max_iterations, effort.affordable_iterations(problem.work(start)))
    minimum = minimize(problem, start, max_iterations=iterations, min_gain=min_gain)
    return minimum.equations, bool(minimum.converged[0])


# ---- the model and its normal equations


@dataclass(frozen=True)
class ProjectedState:
    """State with the best moments and backgrounds, and its residual.

    Attributes
    ----------
    state : PassState
    poses : BarPoses or None
        None if the path is straight and level.
    offsets : MagnetOffsets
    unit_fields : (3 N, n, 3 M) ndarray
        Fields of unit moments in units of the noise.
    cross : (3 N, D, 3 M) ndarray
        Their products with the backgrounds.
    residual : (3 N, n) ndarray
        In units of the noise.
    cost : float
        Weighted squares and priors.
    """

    state: PassState
    poses: BarPoses | None
    offsets: MagnetOffsets
    unit_fields: Array
    cross: Array
    residual: Array
    cost: float


@dataclass(frozen=True)
class ReducedEquations:
    """Normal equations at a state, from which the path is eliminated.

    Attributes
    ----------
    hessian, descent : (q, q), (q,) ndarray
        Unknowns: x of the magnets, their y, :data:`GLOBAL_UNKNOWNS`, moments, the mean step,
        backgrounds. The descent is the negative gradient.
    first_moment : int
        Index of the first moment.
    full_diagonal : (q,) ndarray
        Diagonal of the Hessian before the path was eliminated; the damping is relative to it.
    path, coupling : (n,), (n, q) ndarray or None
        The path's step is ``path - coupling @ x``; None if the path is known.
    band : (2, n) ndarray or None
        Tridiagonal block of the path.
    inner, along, background : (C, n, k), (C, n), (C, n, D) ndarray
        Derivatives of the samples, in units of their noise, by the unknowns before the mean step,
        by the path, and by the backgrounds.
    """

    hessian: Array
    descent: Array
    first_moment: int
    full_diagonal: Array
    inner: Array
    along: Array
    background: Array
    path: Array | None = None
    coupling: Array | None = None
    band: Array | None = None

    def sample_changes(self, changes: Array) -> Array:
        """Return the changes (C, n, k) of the samples by changes (q, k) of the unknowns.

        The path changes with the unknowns as it does in the fit.
        """
        size, terms = self.inner.shape[2], self.background.shape[2]
        levels = changes[size + 1 :].reshape(len(self.inner), terms, -1)
        rows = self.inner @ changes[:size] + self.background @ levels
        if self.coupling is not None:
            rows -= self.along[:, :, None] * (self.coupling @ changes)
        return np.asarray(rows)


class PassEquations:
    """Equations of one pass for :func:`~locatk.core.least_squares.minimize`.

    The derivatives are computed only if a step is asked for: not for trials that are rejected.
    """

    def __init__(self, problem: PassProblem, projected: ProjectedState) -> None:
        self.problem, self.projected = problem, projected
        self.cost = np.array([projected.cost])

    @functools.cached_property
    def reduced(self) -> ReducedEquations:
        """Normal equations without the path."""
        return self.problem.reduce(self.projected)

    def solve(self, damping: Array, problems: Indices) -> PassStep:
        """Return the damped step."""
        reduced = self.reduced
        hessian = reduced.hessian.copy()
        hessian[np.diag_indices(len(hessian))] += damping[0] * reduced.full_diagonal
        change = solve_scaled(hessian, reduced.descent)
        m = len(self.projected.state.position_m)
        largest = np.abs(change[: 2 * m]).max(initial=0.0)
        limit = MAX_STEP_HEIGHTS * self.projected.state.height_m
        change *= min(1.0, limit / max(largest, 1e-12))
        if reduced.path is None or reduced.coupling is None:
            return PassStep(change, reduced.first_moment, None, 0.0)
        path = reduced.path - reduced.coupling @ change
        return PassStep(change, reduced.first_moment, path, change[reduced.first_moment + 3 * m])


@dataclass(frozen=True)
class PassStep:
    """Step of the unknowns before the moments (first in ``change``), path and mean step."""

    change: Array
    first_moment: int
    path_m: Array | None
    mean_step_m: float


class PassProblem:
    """Fit of one pass as a problem for :func:`~locatk.core.least_squares.minimize`.

    Rows are ordered by channel (sensor and axis), then by sample, so that each channel's
    background is a block of its own.

    Parameters
    ----------
    window : PassWindow
    priors : PassPriors
    weight : (n, N, 3) ndarray
        Inverse variance of each sample, 0 if missing.
    start : PassState
        Its mean step determines how much steps may differ.
    """

    def __init__(
        self, window: PassWindow, priors: PassPriors, weight: Array, start: PassState
    ) -> None:
        self.window, self.priors = window, priors
        self.jitter_m = priors.jitter_fraction * abs(start.mean_step_m) + 1e-6
        self.free = start.free
        self.gaps = np.diff(window.time_periods)
        n, sensors, _ = window.field_t.shape
        self.shape = (3 * sensors, n)
        self.root = np.ascontiguousarray(np.sqrt(weight).reshape(n, -1).T)
        # A shared field has covariance tau^2 u u^T besides the unit noise of each axis; a mean of
        # several samples has less of both.
        information = (self.root.reshape(-1, 3, n) ** 2).sum(axis=0)
        self.shared_excess = window.common_t**2 / window.counts * information
        self.shared_factor = (1 - 1 / np.sqrt(1 + self.shared_excess)) / np.maximum(
            information, 1e-300
        )
        # The fields are used near zero, where weights that change from sample to sample cannot
        # turn a level into a signal.
        field = np.nan_to_num(window.field_t).reshape(n, -1).T
        level = (field * self.root).sum(axis=1) / np.maximum(self.root.sum(axis=1), 1e-300)
        self.target = self.whiten(field - level[:, None])
        # Positions are relative to the sample with the strongest field; the variance of the path
        # is zero there.
        self.reference = int(np.argmax(median_filter((self.target**2).sum(axis=0), 5)))
        # (C, n, D). The ridge serves channels without samples, whose background is undetermined.
        basis = trend_basis(window.time_periods, window.trend_terms)
        self.background = self.root[:, :, None] * basis
        gram = self.background.transpose(0, 2, 1) @ self.background
        gram += 1e-9 * max(float(gram.max(initial=0.0)), 1e-300) * np.eye(window.trend_terms)
        self.background_inverse = np.linalg.inv(gram)
        self.background_hessian = np.zeros((gram[..., 0].size, gram[..., 0].size))
        for channel, block in enumerate(gram):
            inside = slice(channel * window.trend_terms, (channel + 1) * window.trend_terms)
            self.background_hessian[inside, inside] = block

    def with_free(self, free: frozenset[str]) -> PassProblem:
        """Return the same problem with other nuisances estimated."""
        problem = copy.copy(self)
        problem.free = free
        return problem

    def work(self, state: PassState) -> float:
        """Return the work of an iteration, in samples times unknowns."""
        columns = MOTION_WORK_UNKNOWNS * len(self.motion_columns(state))
        unknowns = 6 * len(state.position_m) + columns
        return float(np.prod(self.shape) * (unknowns + FIXED_WORK_UNKNOWNS))

    def linearize(self, state: PassState, problems: Indices) -> PassEquations:
        """Return the equations at a state."""
        self.window.effort.spent += self.work(state)
        return PassEquations(self, self.project(state))

    def retract(self, state: PassState, step: PassStep) -> PassState:
        """Return the state after a step."""
        m = len(state.position_m)
        values = {
            name: getattr(state, name) + step.change[2 * m + k]
            for k, name in enumerate(GLOBAL_UNKNOWNS)
        }
        low, high = (ratio * state.height_m for ratio in HEIGHT_STEP_RATIOS)
        values["height_m"] = float(np.clip(values["height_m"], low, high))
        motion, columns = state.motion, self.motion_columns(state)
        if motion is not None and len(columns):
            change = np.zeros(len(motion.coefficients))
            start = 2 * m + len(GLOBAL_UNKNOWNS)
            change[columns] = step.change[start : start + len(columns)]
            motion = motion.with_added(change)
        return replace(
            state,
            motion=motion,
            position_m=state.position_m + step.change[: 2 * m].reshape(2, m).T,
            path_m=state.path_m if step.path_m is None else state.path_m + step.path_m,
            mean_step_m=state.mean_step_m + step.mean_step_m,
            **values,
        )

    def whiten(self, rows: Array) -> Array:
        """Scale rows (C, n) or (C, n, k) to unit noise, and reduce the part that sensors share.

        A background of each channel remains one of each channel, exactly if the weights do not
        change with time.
        """
        is_wide = rows.ndim == 3
        root = self.root[..., None] if is_wide else self.root
        scaled = rows * root
        if not self.window.common_t:
            return scaled
        scaled = scaled.reshape(-1, 3, *rows.shape[1:])
        root = root.reshape(-1, 3, *root.shape[1:])
        factor = self.shared_factor[..., None] if is_wide else self.shared_factor
        shared = factor * (root * scaled).sum(axis=0)
        return np.asarray((scaled - root * shared).reshape(rows.shape))

    def shared_square(self, projected: ProjectedState) -> float:
        """Return the mean square of the part of the residual that all sensors share.

        It is in units of the noise, as it was before :meth:`whiten` reduced it.
        """
        n = self.shape[1]
        root = self.root.reshape(-1, 3, n)
        information = (root**2).sum(axis=0)
        square = (root * projected.residual.reshape(-1, 3, n)).sum(axis=0) ** 2
        square *= 1 + self.shared_excess
        is_observed = information > 0
        return float((square[is_observed] / information[is_observed]).mean())

    def rms_residual(self, projected: ProjectedState) -> float:
        """Return the rms of the residual in units of the noise, outliers included."""
        residual = self.unweighted_residual(projected, sample_weights(self.window))
        return float(np.sqrt(np.nanmean(residual**2)))

    def residual(self, projected: ProjectedState) -> Array:
        """Return the weighted residual (n, N, 3), ``nan`` if there is no sample."""
        observed = np.where(self.root > 0, projected.residual, np.nan)
        return observed.T.reshape(self.window.field_t.shape)

    def unweighted_residual(self, projected: ProjectedState, weight: Array) -> Array:
        """Return the residual (n, N, 3) as if all samples had the given weights."""
        used = self.root.T.reshape(weight.shape)
        return self.residual(projected) * np.sqrt(weight) / np.where(used > 0, used, 1.0)

    def motion_columns(self, state: PassState) -> NDArray[np.intp]:
        """Return the indices (k,) of the coefficients of the motion that are estimated."""
        if state.motion is None:
            return np.zeros(0, np.intp)
        ranges = (part for name, part in state.motion.groups.items() if name in self.free)
        return np.concatenate([np.zeros(0, np.intp), *(np.arange(r.start, r.stop) for r in ranges)])

    def magnet_offsets(self, state: PassState, poses: BarPoses | None) -> MagnetOffsets:
        """Return the offsets from the magnets to the sensors at each sample."""
        sensors = self.window.sensors_m
        skew = np.outer(self.window.axis_order * state.skew_periods, self.local_step(state))
        position = state.position_m
        if poses is not None:
            offset = np.empty((len(state.path_m), len(position), 3))
            offset[..., :2] = poses.position_m[:, None, :2] - position
            offset[..., 2] = poses.position_m[:, 2:] + state.height_m
            x, y, z = np.moveaxis(offset @ poses.rotation, -1, 0)
            # Sensors on the inside of a curve move less.
            speed = 1 - poses.yaw_rate * sensors[:, 1, None]
            along = skew * speed[:, None]
            return MagnetOffsets.from_components(
                along[..., None] + (sensors[:, 0, None, None] + x)[:, None],
                (sensors[:, 1, None, None] + y)[:, None],
                (sensors[:, 2, None, None] + z)[:, None],
            )
        along = state.path_m + skew
        across = np.tan(state.crab_rad) * (state.path_m if state.crab_rad else np.zeros(1))
        return MagnetOffsets.from_components(
            along[:, :, None] + (sensors[:, 0, None] - position[:, 0])[:, None, None],
            across[:, None] + (sensors[:, 1, None] - position[:, 1])[:, None, None],
            state.height_m,
        )

    def clusters(self, state: PassState) -> tuple[csr_array, csr_array]:
        """Return two partitions of the samples, as matrices (clusters, C n) of ones.

        Samples of a cluster may have errors in common: a sensor over a stretch of the path (field
        of a magnet), and a sensor over the whole path (its gains and axes).
        """
        length = CLUSTER_HEIGHTS * state.height_m
        stretch = np.floor((state.path_m - state.path_m.min()) / length)
        if not stretch.max() < len(stretch):
            # Only stretches with samples: a fit that diverges has a path of kilometres.
            stretch = np.unique(stretch, return_inverse=True)[1]
        stretch = stretch.astype(np.intp)
        sensor = np.arange(self.shape[0])[:, None] // 3
        partitions = (sensor * (int(stretch.max()) + 1) + stretch, sensor + 0 * stretch)
        first, second = (
            csr_array((np.ones(each.size), (each.ravel(), np.arange(each.size))))
            for each in partitions
        )
        return first, second

    def local_step(self, state: PassState) -> Array:
        """Return the step (n,) of a sample period around each sample, by a running median."""
        if len(state.path_m) < 3:
            return np.full(len(state.path_m), state.mean_step_m)
        steps = np.diff(state.path_m) / self.gaps
        padded = np.concatenate([steps[:1], steps[:1], steps, steps[-1:], steps[-1:]])
        # Sorting four values takes a quarter of the time of numpy's median, with the same result.
        ascending = np.sort(np.lib.stride_tricks.sliding_window_view(padded, 4), axis=1)
        return np.asarray((ascending[:, 1] + ascending[:, 2]) / 2)

    def project(self, state: PassState) -> ProjectedState:
        """Solve for the moments and backgrounds, given all other unknowns."""
        poses = state.bar_poses
        offsets = self.magnet_offsets(state, poses)
        fields = offsets.unit_fields(self.window.disc_correction_m2)
        if poses is not None:
            # Moments are constant in the axes of the floor.
            fields = fields @ poses.rotation.transpose(0, 2, 1)[None, None]
        m = fields.shape[3]
        unit_fields = self.whiten(fields.reshape(*self.shape, 3 * m))
        transposed = self.background.transpose(0, 2, 1)
        cross, level = transposed @ unit_fields, transposed @ self.target[:, :, None]
        solved = self.background_inverse @ np.concatenate([cross, level], axis=2)
        flat, flat_cross = unit_fields.reshape(-1, 3 * m), cross.reshape(-1, 3 * m)
        hessian = flat.T @ flat - flat_cross.T @ solved[..., :-1].reshape(-1, 3 * m)
        hessian[np.diag_indices(3 * m)] += self.moment_information(m)
        right = flat.T @ self.target.ravel() - flat_cross.T @ solved[..., -1].ravel()
        moments = np.linalg.solve(hessian, right)
        levels = solved[..., -1:] - solved[..., :-1] @ moments[:, None]
        residual = self.target - unit_fields @ moments - (self.background @ levels)[..., 0]
        state = replace(state, moment_am2=moments.reshape(m, 3))
        cost = (residual**2).sum() + self.moment_information(m) @ moments**2
        cost += self.prior_cost(state)
        return ProjectedState(state, poses, offsets, unit_fields, cross, residual, float(cost))

    def moment_information(self, m: int) -> Array:
        """Return the prior inverse variances (3 M,) of the moments."""
        horizontal = MOMENT_SIGMA_FACTOR * self.priors.moment_am2
        tilt = self.priors.tilt_sigma * (1.0 if "tilt" in self.free else FIXED_SIGMA_FRACTION)
        vertical = tilt * self.priors.moment_am2
        return np.tile(1 / np.array([horizontal, horizontal, vertical]) ** 2, m)

    def global_prior(self, name: str) -> tuple[float, float]:
        """Return mean and standard deviation of a global unknown."""
        priors = self.priors
        if name == "height_m":
            return priors.height_m
        if name == "skew_periods":
            return priors.skew_periods if np.any(self.window.axis_order) else (0.0, 1e-9)
        return 0.0, priors.crab_sigma_rad * (1.0 if "crab" in self.free else FIXED_SIGMA_FRACTION)

    def prior_cost(self, state: PassState) -> float:
        """Return the cost of the priors, except for that of the moments."""
        cost = 0.0
        for name in GLOBAL_UNKNOWNS:
            mean, sigma = self.global_prior(name)
            cost += ((getattr(state, name) - mean) / sigma) ** 2
        if state.motion is not None:
            cost += float(((state.motion.coefficients / state.motion.sigmas) ** 2).sum())
        if self.window.path_m is None:
            excess, scale = self.excess_steps(state)
            cost += 2 * float(np.log1p(excess**2 / scale**2).sum())
        return cost

    def excess_steps(self, state: PassState) -> tuple[Array, Array]:
        """Return the deviations (n - 1,) of the steps from the mean one, and their half widths."""
        excess = np.diff(state.path_m) - state.mean_step_m * self.gaps
        return excess, self.jitter_m * np.sqrt(self.gaps)

    def _motion_fields(self, totals: Array, fields: Array, velocity: Array, rate: Array) -> Array:
        """Return the derivatives (N, 3, n, k) of the fields by motions of the bar.

        With the gradient G of the field f at a sensor s, a velocity v and a rotation w of the bar
        change the field in its axes by ``G (v + w x s) - w x f``.

        Parameters
        ----------
        totals : (N, 3, n, 3) ndarray
            Gradients of the fields of all magnets.
        fields : (N, 3, n) ndarray
            Fields of all magnets.
        velocity, rate : (n, 3, k) ndarray
            In the axes of the bar.
        """
        by_x, by_y, by_z = np.moveaxis(totals, -1, 0)
        s_x, s_y, s_z = self.window.sensors_m.T[:, :, None, None]
        # Rotations about the axes of the bar: w x s, and -w x f.
        by_rotation = np.stack(
            [
                by_z * s_y - by_y * s_z,
                by_x * s_z - by_z * s_x,
                by_y * s_x - by_x * s_y,
            ],
            axis=-1,
        )
        f_x, f_y, f_z = fields.swapaxes(0, 1)
        by_rotation[:, 1, :, 0] += f_z
        by_rotation[:, 2, :, 0] -= f_y
        by_rotation[:, 0, :, 1] -= f_z
        by_rotation[:, 2, :, 1] += f_x
        by_rotation[:, 0, :, 2] += f_y
        by_rotation[:, 1, :, 2] -= f_x
        sensors, axes, n, _ = totals.shape
        both = np.concatenate([totals, by_rotation], axis=-1).reshape(-1, n, 6).swapaxes(0, 1)
        changes = both @ np.concatenate([velocity, rate], axis=1)
        return np.asarray(changes.swapaxes(0, 1).reshape(sensors, axes, n, -1))

    def reduce(self, projected: ProjectedState) -> ReducedEquations:
        """Return the normal equations at a state, from which the path is eliminated."""
        channels, n = self.shape
        state = projected.state
        m = len(state.position_m)
        moments = state.moment_am2
        if projected.poses is not None:
            moments = moments @ projected.poses.rotation
        by_x, by_y, by_z = projected.offsets.gradients(moments)
        # Sums over few magnets: a product takes a quarter of the time of a sum.
        total_x, total_y, total_z = (by @ np.ones(m) for by in (by_x, by_y, by_z))
        tangent = np.tan(state.crab_rad)
        columns_free = self.motion_columns(state)
        g = 2 * m + len(GLOBAL_UNKNOWNS)
        p = g + len(columns_free)
        columns = np.empty((*total_x.shape, p))
        skewed = np.outer(self.window.axis_order, self.local_step(state))
        if state.motion is None or (projected.poses is None and not len(columns_free)):
            np.negative(by_x, out=columns[..., :m])
            np.negative(by_y, out=columns[..., m : 2 * m])
            columns[..., 2 * m] = total_z
            columns[..., 2 * m + 1] = total_x * skewed
            columns[..., 2 * m + 2] = total_y * (state.path_m * (1 + tangent**2))
            along = total_x + tangent * total_y
        else:
            poses = projected.poses or state.motion.poses(state.path_m, state.crab_rad)
            for axis, inside in enumerate((slice(m), slice(m, 2 * m))):
                x, y, z = poses.rotation[:, axis].T[..., None]
                columns[..., inside] = -(x * by_x + y * by_y + z * by_z)
            totals = np.stack([total_x, total_y, total_z], axis=-1)
            columns[..., 2 * m] = np.einsum("sani,ni->san", totals, poses.rotation[:, 2])
            speed = 1 - poses.yaw_rate * self.window.sensors_m[:, 1, None]
            columns[..., 2 * m + 1] = total_x * skewed * speed[:, None]
            velocity, rate = state.motion.derivatives(state.path_m, state.crab_rad, columns_free)
            moved = self._motion_fields(totals, projected.offsets.fields(moments), velocity, rate)
            along = moved[..., 0]
            columns[..., 2 * m + 2 :] = moved[..., 1:]
        inner = np.concatenate(
            [self.whiten(columns.reshape(channels, n, p)), projected.unit_fields], axis=2
        )
        along = self.whiten(along.reshape(channels, n))
        # Order: positions and globals (p), moments (up to q), the mean step, backgrounds.
        q = inner.shape[2]
        size = q + 1 + len(self.background_hessian)
        hessian, descent = np.zeros((size, size)), np.zeros(size)
        flat = inner.reshape(-1, q)
        hessian[:q, :q] = flat.T @ flat
        transposed = self.background.transpose(0, 2, 1)
        cross = np.concatenate([transposed @ inner[..., :p], projected.cross], axis=2)
        cross = cross.reshape(-1, q)
        hessian[:q, q + 1 :], hessian[q + 1 :, :q] = cross.T, cross
        hessian[q + 1 :, q + 1 :] = self.background_hessian
        descent[:q] = flat.T @ projected.residual.ravel()
        descent[q + 1 :] = (transposed @ projected.residual[:, :, None]).ravel()
        for index, name in enumerate(GLOBAL_UNKNOWNS, 2 * m):
            mean, sigma = self.global_prior(name)
            hessian[index, index] += 1 / sigma**2
            descent[index] -= (getattr(state, name) - mean) / sigma**2
        if state.motion is not None and len(columns_free):
            indices = np.arange(g, p)
            information = 1 / state.motion.sigmas[columns_free] ** 2
            hessian[indices, indices] += information
            descent[indices] -= information * state.motion.coefficients[columns_free]
        indices = np.arange(p, q)
        hessian[indices, indices] += self.moment_information(m)
        descent[p:q] -= self.moment_information(m) * state.moment_am2.ravel()
        if self.window.path_m is not None:
            hessian[q, q] += FIXING_WEIGHT
            return ReducedEquations(
                hessian, descent, p, np.diag(hessian), inner, along, self.background
            )
        # The path: a tridiagonal block, coupled with all other unknowns.
        coupling = np.zeros((size, n))
        coupling[:q] = np.einsum("cn,cnq->qn", along, inner)
        coupling[q + 1 :] = (along[:, :, None] * self.background).transpose(0, 2, 1).reshape(-1, n)
        excess, scale = self.excess_steps(state)
        weight = 2 / (scale**2 + excess**2)
        band = np.zeros((2, n))
        band[1] = (along**2).sum(axis=0)
        band[1, :-1] += weight
        band[1, 1:] += weight
        band[0, 1:] = -weight
        band[1, self.reference] += FIXING_WEIGHT
        path_descent = (along * projected.residual).sum(axis=0)
        path_descent[:-1] += weight * excess
        path_descent[1:] -= weight * excess
        hessian[q, q] += weight @ self.gaps**2
        descent[q] += weight @ (self.gaps * excess)
        coupling[q, :-1] += weight * self.gaps
        coupling[q, 1:] -= weight * self.gaps
        solved = solveh_banded(
            band, np.column_stack([coupling.T, path_descent]), check_finite=False
        )
        return ReducedEquations(
            hessian=hessian - coupling @ solved[:, :-1],
            descent=descent - coupling @ solved[:, -1],
            first_moment=p,
            full_diagonal=np.diag(hessian),
            inner=inner,
            along=along,
            background=self.background,
            path=solved[:, -1],
            coupling=solved[:, :-1],
            band=band,
        )


def solve_scaled(matrix: Array, right: Array) -> Array:
    """Solve a positive definite system whose unknowns have very different units.

    Raises
    ------
    LinAlgError
        The matrix is not positive definite.
    """
    diagonal = np.diag(matrix)
    if not (np.all(np.isfinite(matrix)) and np.all(diagonal > 0)):
        raise np.linalg.LinAlgError("the matrix is not positive definite")
    scale = 1 / np.sqrt(diagonal)
    scaled = matrix * scale[:, None] * scale
    scaled[np.diag_indices(len(matrix))] += RELATIVE_RIDGE
    # LAPACK itself: for a hundred unknowns scipy's wrappers take longer than the solution.
    _, solved, info = dposv(scaled, (right.T * scale).T)
    if info:
        raise np.linalg.LinAlgError("the matrix is not positive definite")
    return np.asarray((solved.T * scale).T)


# ---- outliers, nuisances, covariance


def _has_outliers(residual: Array) -> bool:
    """Return whether more samples are far off than in a normal distribution."""
    size = np.abs(residual[np.isfinite(residual)])
    limit = OUTLIER_SIGMAS * max(1.0, SIGMA_PER_MEDIAN_ABSOLUTE * float(np.median(size)))
    return bool(np.mean(size > limit) > MAX_OUTLIER_FRACTION)


def _student_weights(problem: PassProblem, projected: ProjectedState, weight: Array) -> Array:
    """Return weights (n, N, 3) of samples by Student's t distribution of their residuals.

    They are those of a Cauchy loss whose scale is the square root of the degrees of freedom.
    """
    residual = np.nan_to_num(problem.unweighted_residual(projected, weight))
    sigma = max(1.0, robust_sigma(residual[weight > 0]))
    _, factor = cauchy_loss(residual, np.sqrt(STUDENT_FREEDOM) * sigma)
    return (STUDENT_FREEDOM + 1) / STUDENT_FREEDOM * factor


@dataclass(frozen=True)
class NuisanceTests:
    """Score tests of the nuisances that are fixed at zero.

    Attributes
    ----------
    state : PassState
        Its motion has coefficients, all of them zero if it is straight.
    motion_columns : (k,) ndarray
        Coefficients of the motion that are unknowns.
    reduced : ReducedEquations
        Crab and tilt are free, and motions that are not estimated are fixed.
    changes : (q, k) ndarray
        Changes of the unknowns if one of k motions was estimated.
    evidence : (k,) ndarray
        Twice the logarithms of the Bayes factors for these motions.
    significant : str or None
        Nuisance to estimate next.
    min_motion_gain : float
        Decrease of the cost by a motion that is one.
    """

    state: PassState
    motion_columns: NDArray[np.intp]
    reduced: ReducedEquations
    changes: Array
    evidence: Array
    significant: str | None
    min_motion_gain: float

    def likely_changes(self) -> Array:
        """Return the changes times the square roots of the probabilities of their motions.

        A motion that is fixed at zero, but is no less likely than none, would change the unknowns
        (Bayesian model averaging; Hoeting et al., Stat. Sci. 14 (1999) 382, Eq. 3).
        """
        odds = np.exp(np.minimum(self.evidence, MAX_LOG_ODDS) / 2)
        return np.asarray(self.changes * np.sqrt(odds / (1 + odds.sum())))


def _test_nuisances(
    problem: PassProblem, projected: ProjectedState, allowed: tuple[str, ...]
) -> NuisanceTests:
    """Predict the decrease of the cost by each nuisance from the equations in which it is free.

    An oblique path is the simplest motion, and is not taken for a curve. Vertical moments come
    last, because an attitude of the bar would look like them.
    """
    state = projected.state
    motion = state.motion
    if motion is None:
        middle = float(np.median(state.position_m[:, 0]))
        motion = Motion.straight(state.path_m, middle, state.height_m)
        state = replace(state, motion=motion)
        projected = replace(projected, state=state)
    rms = problem.rms_residual(projected)
    fixed = [name for name in BUILD_NUISANCES if name not in problem.free]
    motions = _testable_motions(problem, rms, allowed)
    tested = problem.with_free(problem.free.union(fixed, motions))
    reduced = tested.reduce(projected)
    indices = _nuisance_indices(tested, state, reduced.first_moment)
    held = np.concatenate([np.zeros(0, np.intp), *(indices[name] for name in motions)])
    reduced.hessian[held, held] *= FIXING_WEIGHT
    excess = float((projected.residual**2).sum() - (problem.root > 0).sum())
    min_gain = MIN_EXPLAINED_FRACTION * max(excess, 0.0)
    base = solve_scaled(reduced.hessian, reduced.descent)
    evidence, changes = np.zeros(len(motions)), np.zeros((len(base), len(motions)))
    clusters, sigmas = problem.clusters(state), motion.group_sigmas
    for k, name in enumerate(motions):
        evidence[k], changes[:, k] = _test_motion(
            projected, reduced, base, indices[name], sigmas[name], min_gain, clusters
        )
    significant = None
    build_gains = {
        name: _build_gain(reduced, indices, name, fixed) for name in fixed if name in allowed
    }
    if build_gains.get("crab", 0.0) > MIN_NUISANCE_GAIN:
        significant = "crab"
    elif motions and evidence.max() > MIN_MOTION_EVIDENCE:
        best = motions[int(np.argmax(evidence))]
        if best not in WAVE_NUISANCES or rms > MAX_SENSOR_RESIDUAL_SIGMAS:
            significant = best
    is_level = "attitude" not in problem.free
    if significant is None and is_level and build_gains.get("tilt", 0.0) > MIN_NUISANCE_GAIN:
        significant = "tilt"
    columns = tested.motion_columns(state)
    return NuisanceTests(state, columns, reduced, changes, evidence, significant, min_gain)


def _testable_motions(
    problem: PassProblem, rms_sigma: float, allowed: tuple[str, ...]
) -> list[str]:
    """Return the motions that are fixed, and of which the samples may show something."""
    motions = [name for name in MOTION_GROUPS if name in allowed and name not in problem.free]
    if problem.window.path_m is not None:
        # Errors of a path that was given would be taken for a curve.
        motions = [name for name in motions if name != "curve"]
    if rms_sigma < MIN_WAVE_RESIDUAL_SIGMAS:
        motions = [name for name in motions if name not in WAVE_NUISANCES]
    return motions


def _build_gain(
    reduced: ReducedEquations,
    indices: dict[str, NDArray[np.intp]],
    name: str,
    fixed: list[str],
) -> float:
    """Return the decrease of the cost by crab or tilt beyond the number of its unknowns."""
    others = [indices[other] for other in fixed if other != name]
    hessian = reduced.hessian.copy()
    for held in others:
        hessian[held, held] *= FIXING_WEIGHT
    gain = float(reduced.descent @ solve_scaled(hessian, reduced.descent))
    return gain - len(indices[name])


def _test_motion(
    projected: ProjectedState,
    reduced: ReducedEquations,
    base: Array,
    own: NDArray[np.intp],
    sigmas: Array,
    min_gain: float,
    clusters: tuple[csr_array, ...],
) -> tuple[float, Array]:
    """Return the evidence for a motion, and the change (q,) of the unknowns by it.

    ``base`` (q,) is the step without it, ``own`` are its indices, and ``sigmas`` its priors.

    The unit of the gain is not the noise but the variance of the score among clusters of samples
    that the motion leaves unexplained (White, Econometrica 50 (1982) 1, section 3), because errors
    of gains and axes of the sensors would else look like a motion.
    """
    hessian = reduced.hessian.copy()
    hessian[own, own] /= FIXING_WEIGHT
    right = np.column_stack([reduced.descent, np.eye(len(hessian))[:, own]])
    solved = solve_scaled(hessian, right)
    gain = float(reduced.descent @ (solved[:, 0] - base))
    covariance = solved[own, 1:]
    occam = 2 * np.log(sigmas).sum() - np.linalg.slogdet(covariance)[1]
    evidence = gain - occam
    if gain < min_gain:
        evidence = -np.inf
    if evidence > 0:
        # Unit variances and no correlations, if the residual was noise.
        inverse_root = np.linalg.inv(np.linalg.cholesky(covariance))
        changes = reduced.sample_changes(solved)
        remaining = projected.residual - changes[..., 0]
        rows = changes[..., 1:] @ inverse_root.T * remaining[..., None]
        unit = max(
            1.0,
            *(float((cluster_sums(each, rows) ** 2).sum(axis=0).mean()) for each in clusters),
        )
        evidence = gain / unit - (occam - len(own) * np.log(unit))
    return evidence, solved[:, 0] - base


def cluster_sums(clusters: csr_array, rows: Array) -> Array:
    """Return the sums (K, k) of rows (C, n, k) over K clusters."""
    return np.asarray(clusters @ rows.reshape(clusters.shape[1], -1))


def _nuisance_indices(
    problem: PassProblem, state: PassState, first_moment: int
) -> dict[str, NDArray[np.intp]]:
    """Return the indices in the normal equations of the unknowns of each free nuisance."""
    m = len(state.position_m)
    indices = {
        "crab": np.array([2 * m + GLOBAL_UNKNOWNS.index("crab_rad")]),
        "tilt": first_moment + 3 * np.arange(m) + 2,
    }
    start = 2 * m + len(GLOBAL_UNKNOWNS)
    groups = {} if state.motion is None else state.motion.groups
    for name, part in groups.items():
        if name in problem.free:
            indices[name] = np.arange(start, start + part.stop - part.start)
            start += part.stop - part.start
    return indices


def _result(
    problem: PassProblem,
    projected: ProjectedState,
    weight: Array,
    converged: bool,
    tests: NuisanceTests | None,
) -> PassFit:
    """Collect the result of a fit; without ``tests`` there are no covariances."""
    window, state = problem.window, projected.state
    m, n = len(state.position_m), len(window.time_periods)
    residual = problem.unweighted_residual(projected, weight)
    count = int(np.isfinite(residual).sum())
    unknowns = 5 * m + len(problem.background_hessian)
    if window.path_m is None:
        unknowns += n
    correction = float(np.sqrt(count / max(count - unknowns, 1)))
    covariances: dict[str, Any] = {
        "covariance": np.full((3 * m, 3 * m), np.nan),
        "motion_covariance": np.full((1, 1), np.nan),
        "path_sigma_m": np.full(n, np.nan),
        "height_sigma_m": np.nan,
        "significance": np.full(m, np.inf),
    }
    if tests is not None:
        state = tests.state
        covariances = _covariances(tests, projected.residual, problem.clusters(state))
    return PassFit(
        state=state,
        residual=residual,
        rms_sigma=float(np.sqrt(np.nansum(residual**2) / max(count, 1))) * correction,
        robust_sigma=robust_sigma(residual) * correction,
        shared_square=problem.shared_square(projected),
        converged=converged,
        **covariances,
    )


def _covariances(
    tests: NuisanceTests, residual: Array, clusters: tuple[csr_array, ...]
) -> dict[str, Any]:
    """Return the attributes of :class:`PassFit` that describe the accuracy.

    Where residuals are correlated within clusters, the standard deviations are those of the
    sandwich estimator (Liang and Zeger, Biometrika 73 (1986) 13), which are never taken smaller
    than those of the model.
    """
    state, reduced = tests.state, tests.reduced
    m = len(state.position_m)
    full = solve_scaled(reduced.hessian, np.eye(len(reduced.hessian)))
    jacobian = _outputs_jacobian(state, reduced)
    covariance = jacobian @ full @ jacobian.T
    # A residual that is larger everywhere scales the whole covariance later.
    relative = residual / max(1.0, robust_sigma(residual))
    rows = reduced.sample_changes(full @ jacobian.T) * relative[..., None]
    variance = np.diag(covariance)
    for each in clusters:
        variance = np.maximum(variance, (cluster_sums(each, rows) ** 2).sum(axis=0))
    inflation = np.sqrt(variance / np.diag(covariance))
    changes = jacobian @ tests.likely_changes()
    covariance = inflation[:, None] * covariance * inflation + changes @ changes.T
    assert state.motion is not None
    motion = np.zeros((1 + len(state.motion.coefficients),) * 2)
    estimated = np.append(0, 1 + tests.motion_columns)
    motion[np.ix_(estimated, estimated)] = covariance[3 * m :, 3 * m :]
    horizontal = reduced.first_moment + 3 * np.arange(m)[:, None] + [0, 1]
    of_moments = full[horizontal[:, :, None], horizontal[:, None, :]]
    moments = state.moment_am2[:, :2, None]
    return {
        "covariance": covariance[: 3 * m, : 3 * m],
        "motion_covariance": motion,
        "path_sigma_m": _path_sigma(state, reduced, full),
        "height_sigma_m": float(np.sqrt(full[2 * m, 2 * m])),
        "significance": (moments * np.linalg.solve(of_moments, moments)).sum(axis=(1, 2)),
    }


def _outputs_jacobian(state: PassState, reduced: ReducedEquations) -> Array:
    """Return the derivatives of x, y and angle of each magnet, of crab, and of the motion."""
    m, crab = len(state.position_m), 2 * len(state.position_m) + GLOBAL_UNKNOWNS.index("crab_rad")
    jacobian = np.zeros((3 * m + reduced.first_moment - crab, len(reduced.hessian)))
    square = (state.moment_am2[:, :2] ** 2).sum(axis=1)
    for k in range(m):
        jacobian[3 * k, k] = jacobian[3 * k + 1, m + k] = 1.0
        moment = reduced.first_moment + 3 * k
        jacobian[3 * k + 2, moment] = -state.moment_am2[k, 1] / square[k]
        jacobian[3 * k + 2, moment + 1] = state.moment_am2[k, 0] / square[k]
    jacobian[3 * m :, crab : reduced.first_moment] = np.eye(reduced.first_moment - crab)
    return jacobian


def _path_sigma(state: PassState, reduced: ReducedEquations, full: Array) -> Array:
    """Return the standard deviations (n,) of the path; 0 if it is known."""
    if reduced.band is None or reduced.coupling is None:
        return np.zeros(len(state.path_m))
    own = solveh_banded(reduced.band, np.eye(len(state.path_m)), check_finite=False)
    coupled = np.einsum("nq,qr,nr->n", reduced.coupling, full, reduced.coupling, optimize=True)
    return np.sqrt(np.maximum(np.diag(own) + coupled, 0.0))
