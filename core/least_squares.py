r"""Nonlinear least squares: Levenberg-Marquardt for batches of problems, and with elimination.

A solver minimizes the sum of the losses of the residuals, plus Gaussian priors,

.. math:: F(x) = \sum_i \rho(r_i(x)) + \tfrac12 \sum_j (x_j - \mu_j)^2 / \sigma_j^2,

by damped Gauss-Newton steps :math:`(H + \lambda\,\mathrm{diag}\,H)\,\delta = -g` with
:math:`H = J^T W J`, :math:`g = J^T W r` (Levenberg, Q. Appl. Math. 2 (1944) 164; Marquardt, SIAM
J. 11 (1963) 431). The loss is :math:`\rho(r) = r^2 / 2`, or a robust one by iterative
reweighting: W holds :math:`\rho'(r) / r`. The damping of a problem falls tenfold after a step
that lowers its cost and rises tenfold after one that does not.

Two forms of normal equations share one loop, :func:`minimize`:

:class:`DenseEquations`
    m independent problems of p parameters each. All step together in a few array operations;
    each has a damping of its own and stops by itself.
:class:`SchurEquations`
    One problem whose parameters are p shared ones and k blocks of d that couple with the shared
    ones only (poses of cameras, and points; see Triggs et al., Bundle adjustment - a modern
    synthesis, 2000, section 6). The Hessian is an arrow,

    ::

              shared   blocks
            [  H_ss  |  H_s1 H_s2 ... H_sk ]   shared
            [  H_1s  |  H_11               ]
            [  ...   |        ...          ]   blocks
            [  H_ks  |               H_kk  ]

    so that the blocks are eliminated one by one (Schur complement): a step costs products of
    small matrices and one solve of p unknowns. Directions that no residual depends on (the
    gauge) are constrained.

The caller supplies analytic Jacobians and the retraction of a step onto its own type of state, so
that rotations are updated on their manifold.

Notes
-----
The reason for an implementation of our own is batching. For poses of twelve unknowns from 60
angles each (500 epochs, the same residuals and Jacobians), a pose takes 0.7 ms here in one batch,
5 ms with a factor written in Python in GTSAM, and 38 ms with ``scipy.optimize.least_squares``; the
minima agree to 1 um. scipy also does not use the arrow (its sparse ``tr_solver="lsmr"`` iterates
on the whole Jacobian), and it returns no covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Generic, Protocol, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
State = TypeVar("State")

MIN_DAMPING, MAX_DAMPING = 1e-9, 1e6
"""Range of the damping factor (ratio to the diagonal of H). A problem that needs more cannot
improve any further."""

DAMPING_FACTOR = 10.0
"""Change of the damping after a step."""

RELATIVE_RIDGE = 1e-12
"""Added to the diagonal of each small matrix, relative to its largest element, so that parameters
that no residual determines keep their values."""

ABSOLUTE_RIDGE = 1e-300
"""Added as well, for matrices of zeros (a point that nothing observed)."""

RANK_TOLERANCE = 1e-14
"""Relative size of singular values that count as zero when the reduced system is solved."""

RUNNING, SMALL_GAIN, SMALL_STEP, MAX_DAMPING_REACHED = range(4)
"""Status of a problem: iterations ran out, or the criterion that stopped it."""


class Equations(Protocol):
    """Normal equations of one or several problems at a state."""

    @property
    def cost(self) -> Array:
        """(m,) objective of each problem."""

    def solve(self, damping: Array, problems: Indices) -> Any:
        """Return the damped step of the problems with these indices, of all in the equations."""


class Problem(Protocol[State]):
    """Batch of independent least-squares problems over one type of state.

    A state of several problems has ``take(indices)``, which returns some of them as a copy, and
    ``put(indices, other)``, which overwrites some in place.
    """

    def linearize(self, state: State, problems: Indices) -> Any:
        """Return the :class:`Equations` of the problems with indices ``problems``.

        The rows of ``state`` are the states of these problems, in the same order.
        """

    def retract(self, state: State, step: Any) -> State:
        """Return the state after a step of :meth:`Equations.solve`."""


class BlockProblem(Problem[State], Protocol):
    """Problem with eliminated blocks, for inner iterations."""

    def retract_blocks(self, state: State, step: Array) -> State:
        """Return the state after a step (k, d) of the blocks alone."""


@dataclass(frozen=True)
class Minimum(Generic[State]):
    """Result of :func:`minimize`.

    Attributes
    ----------
    state : State
        States of least cost, of all problems.
    equations : DenseEquations or SchurEquations
        Normal equations there.
    iterations : (m,) int ndarray
        Steps tried.
    status : (m,) int ndarray
        :data:`SMALL_GAIN` or :data:`SMALL_STEP`; :data:`MAX_DAMPING_REACHED` if no step lowers the
        cost any further; :data:`RUNNING` if iterations ran out.
    """

    state: State
    equations: Any
    iterations: Indices
    status: Indices

    @property
    def converged(self) -> NDArray[np.bool_]:
        """(m,) whether each problem stopped before its iterations ran out."""
        return self.status != RUNNING


def minimize(
    problem: Problem[State],
    start: State,
    size: int = 1,
    *,
    damping: float = 1e-3,
    max_iterations: int = 50,
    min_gain: float = 1e-6,
    min_step: float = 0.0,
    inner_iterations_after: int | None = None,
) -> Minimum[State]:
    """Minimize the costs of a batch of problems by the Levenberg-Marquardt method.

    Parameters
    ----------
    problem : Problem
    start : State
        Initial guess of all problems; it is not changed.
    size : int
        Number of problems m.
    damping : float
        Initial damping.
    max_iterations : int
        Steps tried per problem.
    min_gain : float
        A problem has converged when a step lowers its cost by less than this fraction.
    min_step : float
        A problem has converged when the Euclidean norm of its step is smaller (dense equations
        only).
    inner_iterations_after : int, optional
        After this many iterations, the eliminated blocks take a step of their own after each step
        (Schur equations only; the problem is a :class:`BlockProblem`). That doubles the work of
        an iteration and shortens the path through curved valleys (inner iterations in Ceres
        Solver; Ruhe and Wedin, SIAM Rev. 22 (1980) 318).

    Returns
    -------
    Minimum
    """
    active = np.arange(size)
    state: Any = start
    if size != 1:
        state = state.take(active)
    equations = problem.linearize(state, active)
    dampings = np.full(size, damping)
    iterations = np.zeros(size, np.int64)
    status = np.full(size, RUNNING, np.int64)
    for iteration in range(1, max_iterations + 1):
        if not len(active):
            break
        step = equations.solve(dampings[active], active)
        before = state if size == 1 else state.take(active)
        trial: Any = problem.retract(before, step)
        after = problem.linearize(trial, active)
        if inner_iterations_after is not None and iteration > inner_iterations_after:
            blocks = cast(BlockProblem[State], problem)
            trial = blocks.retract_blocks(trial, after.solve_blocks())
            after = problem.linearize(trial, active)
        cost = equations.cost[active]
        # A cost of nan is no improvement.
        improved = after.cost < cost
        gain = (cost - after.cost) / np.maximum(cost, np.finfo(float).tiny)
        if size == 1:
            state, equations = (trial, after) if improved[0] else (state, equations)
        elif np.any(improved):
            state.put(active[improved], trial.take(improved))
            equations.put(active[improved], after, improved)
        iterations[active] = iteration
        lower = np.maximum(dampings[active] / DAMPING_FACTOR, MIN_DAMPING)
        dampings[active] = np.where(improved, lower, dampings[active] * DAMPING_FACTOR)
        reason = np.where(improved & (gain < min_gain), SMALL_GAIN, RUNNING)
        if min_step > 0:
            reason[np.linalg.norm(step, axis=1) < min_step] = SMALL_STEP
        reason[dampings[active] > MAX_DAMPING] = MAX_DAMPING_REACHED
        status[active] = reason
        active = active[reason == RUNNING]
    return Minimum(state, equations, iterations, status)


@dataclass
class DenseEquations:
    """Normal equations of m independent problems of p parameters.

    Attributes
    ----------
    cost : (m,) ndarray
    gradient : (m, p) ndarray
    hessian : (m, p, p) ndarray
        Gauss-Newton approximation, without damping: the information matrix of the parameters.
    residual : (m, n) ndarray
        In standard deviations, before weighting.
    """

    cost: Array
    gradient: Array
    hessian: Array
    residual: Array

    @classmethod
    def from_weighted(
        cls, residual: Array, weighted: Array, jacobian: Array, cost: Array
    ) -> DenseEquations:
        """Build the equations from weighted residuals and Jacobians.

        Parameters
        ----------
        residual : (m, n) ndarray
            Before weighting; it is stored as it is.
        weighted : (m, n) ndarray
            Residuals times the square roots of their weights.
        jacobian : (m, n, p) ndarray
            Derivatives of the residuals times the same roots.
        cost : (m,) ndarray
        """
        transposed = np.swapaxes(jacobian, -1, -2)
        gradient = (transposed @ weighted[..., None])[..., 0]
        return cls(cost, gradient, transposed @ jacobian, residual)

    def add_prior(self, parameters: slice, deviation: Array, sigma: Array) -> None:
        """Add a Gaussian prior on some parameters.

        ``deviation`` (m, q) is their difference from the mean, ``sigma`` (q,) the standard
        deviation.
        """
        diagonal = np.einsum("mii->mi", self.hessian)
        diagonal[:, parameters] += sigma**-2.0
        self.gradient[:, parameters] += deviation / sigma**2
        self.cost = self.cost + 0.5 * np.sum((deviation / sigma) ** 2, axis=1)

    def solve(self, damping: Array, problems: Indices) -> Array:
        """Return the damped steps (k, p) of the chosen problems (k,)."""
        matrix = self.hessian[problems]
        _damp(matrix, damping[:, None])
        step = -np.linalg.solve(matrix, self.gradient[problems][..., None])[..., 0]
        return step.astype(np.float64, copy=False)

    def put(self, problems: Indices, other: DenseEquations, chosen: NDArray[np.bool_]) -> None:
        """Replace the equations of some problems by chosen ones of ``other``."""
        self.cost[problems] = other.cost[chosen]
        self.gradient[problems] = other.gradient[chosen]
        self.hessian[problems] = other.hessian[chosen]
        self.residual[problems] = other.residual[chosen]


@dataclass(frozen=True)
class SchurStep:
    """Step of the shared parameters (p,) and of the blocks (k, d)."""

    shared: Array
    blocks: Array


@dataclass(frozen=True)
class SchurEquations:
    """Normal equations of one problem with p shared parameters and k blocks of d.

    Attributes
    ----------
    cost : (1,) ndarray
    hessian : (p, p) ndarray
    gradient : (p,) ndarray
        Both of the shared parameters.
    block_hessian : (k, d, d) ndarray
    block_gradient : (k, d) ndarray
    coupling : (k, p, d) ndarray
        Mixed part of the Hessian.
    free : (p,) bool ndarray
        Shared parameters that are estimated; the others stay.
    gauge : (p, g) ndarray
        Orthonormal directions of the shared parameters that no residual depends on. Steps avoid
        them, and the covariance is zero along them: it holds in the frame that they fix.
    residual, weight : ndarray
        Residuals in standard deviations before weighting, and robust weights, in the caller's
        shape.
    """

    cost: Array
    hessian: Array
    gradient: Array
    block_hessian: Array
    block_gradient: Array
    coupling: Array
    free: NDArray[np.bool_]
    gauge: Array
    residual: Array = field(default_factory=lambda: np.zeros(0))
    weight: Array = field(default_factory=lambda: np.zeros(0))

    def solve(self, damping: Array, problems: Indices | None = None) -> SchurStep:
        """Return the damped step of all parameters."""
        reduced, right, inverses = self._reduced(float(damping[0]))
        # A penalty of the size of the matrix keeps the step out of the gauge directions.
        gauge = self.gauge
        reduced = reduced + np.max(np.diag(reduced), initial=0.0) * gauge @ gauge.T
        shared = np.zeros(len(right))
        inside = np.ix_(self.free, self.free)
        shared[self.free] = -np.linalg.lstsq(reduced[inside], right[self.free], RANK_TOLERANCE)[0]
        back = self.block_gradient + np.einsum("kpd,p->kd", self.coupling, shared)
        return SchurStep(shared, -(inverses @ back[..., None])[..., 0])

    def solve_blocks(self) -> Array:
        """Return the undamped step (k, d) of the blocks, the shared parameters being fixed."""
        matrix = self.block_hessian.copy()
        _damp(matrix, 0.0)
        step = -np.linalg.solve(matrix, self.block_gradient[..., None])[..., 0]
        return step.astype(np.float64, copy=False)

    def covariance(self) -> Array:
        """Return the covariance (p, p) of the shared parameters, with all blocks estimated.

        It is zero for parameters that are not free and along the gauge.
        """
        reduced, _, _ = self._reduced(0.0)
        projection = np.diag(self.free.astype(float)) - self.gauge @ self.gauge.T
        inside = projection @ reduced @ projection
        return np.asarray(projection @ np.linalg.pinv(inside, hermitian=True) @ projection)

    def _reduced(self, damping: float) -> tuple[Array, Array, Array]:
        """Return Schur complement (p, p), its right side (p,), and the inverses of the blocks."""
        p = len(self.gradient)
        full = self.hessian.copy()
        full[np.diag_indices(p)] *= 1.0 + damping
        blocks = self.block_hessian.copy()
        _damp(blocks, damping)
        inverses = np.linalg.inv(blocks).astype(np.float64, copy=False)
        # One product of (p, k d) matrices: several times as fast as a sum over blocks.
        eliminated = (self.coupling @ inverses).transpose(1, 0, 2).reshape(p, -1)
        full -= eliminated @ self.coupling.transpose(1, 0, 2).reshape(p, -1).T
        right = self.gradient - eliminated @ self.block_gradient.ravel()
        return full, right, inverses


def _damp(matrices: Array, damping: Array | float) -> None:
    """Scale the diagonals of matrices (..., p, p) by ``1 + damping``, and add a ridge."""
    diagonal = np.einsum("...ii->...i", matrices)
    diagonal *= 1.0 + damping
    largest = np.max(diagonal, axis=-1, keepdims=True, initial=0.0)
    diagonal += RELATIVE_RIDGE * largest + ABSOLUTE_RIDGE


def cauchy_loss(
    residual: Array, scale: Array | float, cutoff: float = np.inf
) -> tuple[Array, Array]:
    """Return the Cauchy loss of residuals and their weights.

    Parameters
    ----------
    residual : ndarray
        In standard deviations.
    scale : ndarray or float
        Residual at which the weight is one half; broadcasts against ``residual``.
    cutoff : float
        Residuals beyond it have the weight 0 and the loss of the cutoff: the loss is truncated.

    Returns
    -------
    loss, weight : ndarray
        ``scale**2 / 2 * log(1 + (residual / scale)**2)``, and ``1 / (1 + (residual / scale)**2)``.
    """
    size = np.abs(residual)
    ratio = (np.minimum(size, cutoff) / scale) ** 2
    weight = np.where(size > cutoff, 0.0, 1.0 / (1.0 + ratio))
    return np.asarray(0.5 * np.square(scale) * np.log1p(ratio)), weight
