"""Minima, covariances and stopping criteria of the least-squares solver, against scipy."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.optimize import least_squares

from locatk.core.least_squares import (
    MAX_DAMPING_REACHED,
    RUNNING,
    SMALL_GAIN,
    SMALL_STEP,
    DenseEquations,
    SchurEquations,
    SchurStep,
    cauchy_loss,
    minimize,
)

Array = NDArray[np.float64]


class Parameters(np.ndarray):
    """States (m, p) as an array."""

    def take(self, indices: NDArray[np.generic]) -> Parameters:  # type: ignore[override]
        return np.array(self)[indices].view(Parameters)

    def put(self, indices: NDArray[np.generic], other: Array) -> None:  # type: ignore[override]
        self[indices] = other


@dataclass
class Decays:
    """Decaying exponentials a exp(-b t) + c, one per problem."""

    time: Array
    value: Array  # (m, n)
    loss_scale: float = np.inf
    prior_mean: float = 0.0
    prior_sigma: float = np.inf
    evaluations: int = 0

    def model(self, state: Array) -> tuple[Array, Array]:
        a, b, c = (state[:, [k]] for k in range(3))
        shape = np.exp(-b * self.time)
        return a * shape + c, np.stack([shape, -a * self.time * shape, np.ones_like(shape)], -1)

    def linearize(self, state: Array, problems: NDArray[np.int64]) -> DenseEquations:
        self.evaluations += 1
        predicted, jacobian = self.model(np.asarray(state))
        residual = predicted - self.value[problems]
        if np.isfinite(self.loss_scale):
            loss, weight = cauchy_loss(residual, self.loss_scale)
        else:
            loss, weight = 0.5 * residual**2, np.ones_like(residual)
        root = np.sqrt(weight)
        equations = DenseEquations.from_weighted(
            residual, residual * root, jacobian * root[..., None], loss.sum(axis=1)
        )
        if np.isfinite(self.prior_sigma):
            deviation = np.asarray(state)[:, 2:] - self.prior_mean
            equations.add_prior(slice(2, 3), deviation, np.array([self.prior_sigma]))
        return equations

    def retract(self, state: Parameters, step: Array) -> Parameters:
        return (np.asarray(state) + step).view(Parameters)


TRUE = np.array([[2.0, 1.3, 0.5], [1.0, 0.4, -0.2], [3.0, 2.5, 1.0], [0.7, 0.9, 0.0]])
START = np.tile([1.0, 1.0, 0.0], (4, 1)).view(Parameters)


def decays(noise: float = 0.01, outliers: bool = False, **options: float) -> Decays:
    rng = np.random.default_rng(3)
    time = np.linspace(0, 3, 40)
    problem = Decays(time, np.zeros((4, 40)), **options)
    value = problem.model(TRUE)[0] + rng.normal(0, noise, (4, 40))
    if outliers:
        value[:, ::9] += 2.0
    problem.value = value
    return problem


@pytest.mark.parametrize("loss_scale", [np.inf, 0.03])
def test_minima_are_those_of_scipy(loss_scale: float) -> None:
    problem = decays(outliers=np.isfinite(loss_scale), loss_scale=loss_scale)
    minimum = minimize(problem, START, 4, min_gain=1e-14, max_iterations=200)
    for k in range(4):

        def residual(x: Array, k: int = k) -> Array:
            return problem.model(x[None])[0][0] - problem.value[k]

        peer = least_squares(
            residual,
            np.asarray(minimum.state)[k] * 1.02,
            loss="cauchy" if np.isfinite(loss_scale) else "linear",
            f_scale=loss_scale if np.isfinite(loss_scale) else 1.0,
            xtol=1e-14,
            ftol=1e-14,
            gtol=1e-14,
        )
        np.testing.assert_allclose(np.asarray(minimum.state)[k], peer.x, atol=2e-6)
        assert minimum.equations.cost[k] == pytest.approx(peer.cost, rel=1e-8)


def test_outliers_have_little_weight() -> None:
    robust = minimize(decays(outliers=True, loss_scale=0.03), START, 4)
    plain = minimize(decays(outliers=True), START, 4)
    assert np.abs(robust.state - TRUE).max() < 0.05
    assert np.abs(plain.state - TRUE).max() > 0.2


def test_a_batch_equals_its_problems_one_by_one() -> None:
    together = minimize(decays(), START, 4)
    for k in range(4):
        problem = decays()
        problem.value = problem.value[[k]]
        alone = minimize(problem, START[[k]], 1)
        np.testing.assert_allclose(alone.state, together.state[[k]], rtol=1e-12)
        assert alone.iterations[0] == together.iterations[k]
        assert alone.status[0] == together.status[k]


def test_the_start_is_not_changed() -> None:
    start = START.copy()
    minimize(decays(), start, 4)
    np.testing.assert_array_equal(start, START)


def test_each_problem_stops_by_itself() -> None:
    start = START.copy()
    start[0] = TRUE[0]
    minimum = minimize(decays(noise=1e-9), start, 4)
    assert minimum.iterations[0] < minimum.iterations[1:].max()
    assert minimum.converged.all()


def test_damping_falls_after_a_good_step() -> None:
    # With the damping left at 100 each step covers 1 % of the way: 460 steps for two digits.
    minimum = minimize(decays(), START, 4, damping=100.0, min_gain=1e-12, max_iterations=40)
    exact = minimize(decays(), START, 4, min_gain=1e-12)
    assert minimum.converged.all()
    np.testing.assert_allclose(minimum.state, exact.state, atol=1e-5)


def test_damping_rises_after_a_bad_step() -> None:
    # Undamped Gauss-Newton diverges on the arctangent from |x| > 1.39.
    @dataclass
    class Arctangent:
        def linearize(self, state: Array, _: NDArray[np.int64]) -> DenseEquations:
            x = np.asarray(state)
            jacobian = (1 / (1 + x**2))[..., None]
            cost = 0.5 * np.arctan(x)[:, 0] ** 2
            return DenseEquations.from_weighted(np.arctan(x), np.arctan(x), jacobian, cost)

        def retract(self, state: Array, step: Array) -> Parameters:
            return (np.asarray(state) + step).view(Parameters)

    start = np.array([[10.0], [-3.0]]).view(Parameters)
    minimum = minimize(Arctangent(), start, 2, damping=1e-6)
    assert np.abs(minimum.state).max() < 1e-3


def test_a_cost_of_nan_is_no_improvement() -> None:
    @dataclass
    class Root(Decays):
        def linearize(self, state: Array, _: NDArray[np.int64]) -> DenseEquations:
            x = np.asarray(state)
            with np.errstate(invalid="ignore"):
                residual = np.sqrt(x) - 1.0
                jacobian = (0.5 / np.sqrt(x))[..., None]
            cost = 0.5 * residual[:, 0] ** 2
            return DenseEquations.from_weighted(residual, residual, jacobian, cost)

    # The first step from 9 leads to -3.
    problem = Root(np.zeros(1), np.zeros((1, 1)))
    minimum = minimize(problem, np.array([[9.0]]).view(Parameters), 1, damping=1e-9)
    assert minimum.state[0, 0] == pytest.approx(1.0, abs=1e-3)


def test_why_problems_stopped() -> None:
    assert minimize(decays(), START, 4).status.tolist() == [SMALL_GAIN] * 4
    assert minimize(decays(), START, 4, max_iterations=1).status.tolist() == [RUNNING] * 4
    exact = minimize(decays(), START, 4, min_gain=0.0, min_step=1e-3)
    assert exact.status.tolist() == [SMALL_STEP] * 4
    again = minimize(decays(), minimize(decays(), START, 4, min_gain=0.0).state, 4, min_gain=0.0)
    assert again.status.tolist() == [MAX_DAMPING_REACHED] * 4


def test_a_prior_pulls_by_its_sigma() -> None:
    loose = minimize(decays(prior_mean=5.0, prior_sigma=1e6), START, 4, min_gain=1e-12)
    tight = minimize(decays(prior_mean=5.0, prior_sigma=1e-6), START, 4, min_gain=1e-12)
    free = minimize(decays(), START, 4, min_gain=1e-12)
    np.testing.assert_allclose(loose.state, free.state, atol=1e-6)
    np.testing.assert_allclose(tight.state[:, 2], 5.0, atol=1e-6)


def test_the_information_is_that_of_the_scatter() -> None:
    minimum = minimize(decays(), START, 4, min_gain=1e-12)
    jacobian = decays().model(np.asarray(minimum.state))[1]
    expected = np.swapaxes(jacobian, 1, 2) @ jacobian
    np.testing.assert_allclose(minimum.equations.hessian, expected, rtol=1e-9)


def test_cauchy_loss_and_weight() -> None:
    residual = np.array([0.0, 1e-6, 2.0, -2.0, 9.0, 1e3])
    loss, weight = cauchy_loss(residual, 2.0, cutoff=10.0)
    assert weight.tolist()[2:] == [0.5, 0.5, pytest.approx(1 / (1 + 20.25)), 0.0]
    assert loss[1] == pytest.approx(0.5e-12)
    assert loss[5] == cauchy_loss(np.array(10.0), 2.0)[0]
    step = 1e-6
    slope = cauchy_loss(residual[2:5] + step, 2.0)[0] - cauchy_loss(residual[2:5] - step, 2.0)[0]
    np.testing.assert_allclose(slope / (2 * step), weight[2:5] * residual[2:5], rtol=1e-6)


# ---- elimination


SHARED, BLOCKS, DIMS = 4, 6, 2


def arrow(
    seed: int = 0, free: NDArray[np.bool_] | None = None, gauge: Array | None = None
) -> tuple[SchurEquations, Array, Array]:
    """Random equations with the whole matrix (p + k d, p + k d) and gradient."""
    rng = np.random.default_rng(seed)
    size = SHARED + BLOCKS * DIMS
    by_shared = rng.normal(size=(BLOCKS, 5, SHARED))
    if gauge is not None:
        by_shared -= by_shared @ gauge @ gauge.T
    by_block = rng.normal(size=(BLOCKS, 5, DIMS))
    residual = rng.normal(size=(BLOCKS, 5))
    jacobian = np.concatenate([by_shared.reshape(-1, SHARED), block_diag(*by_block)], axis=1)
    matrix = jacobian.T @ jacobian
    gradient = jacobian.T @ residual.ravel()
    assert matrix.shape == (size, size)
    equations = SchurEquations(
        np.array([0.5 * np.sum(residual**2)]),
        matrix[:SHARED, :SHARED],
        gradient[:SHARED],
        np.swapaxes(by_block, 1, 2) @ by_block,
        gradient[SHARED:].reshape(BLOCKS, DIMS),
        np.swapaxes(by_shared, 1, 2) @ by_block,
        np.ones(SHARED, bool) if free is None else free,
        np.zeros((SHARED, 0)) if gauge is None else gauge,
    )
    return equations, matrix, gradient


@pytest.mark.parametrize("damping", [0.0, 0.1, 10.0])
def test_elimination_solves_the_whole_system(damping: float) -> None:
    equations, matrix, gradient = arrow()
    step = equations.solve(np.array([damping]))
    matrix = matrix + damping * np.diag(np.diag(matrix))
    whole = -np.linalg.solve(matrix, gradient)
    np.testing.assert_allclose(step.shared, whole[:SHARED], rtol=1e-9)
    np.testing.assert_allclose(step.blocks.ravel(), whole[SHARED:], rtol=1e-9)


def test_covariance_of_shared_parameters_is_that_of_the_whole_inverse() -> None:
    equations, matrix, _ = arrow()
    expected = np.linalg.inv(matrix)[:SHARED, :SHARED]
    np.testing.assert_allclose(equations.covariance(), expected, rtol=1e-8)


def test_parameters_that_are_not_free_stay() -> None:
    free = np.array([True, False, True, True])
    equations, matrix, gradient = arrow(free=free)
    kept = np.r_[free, np.ones(BLOCKS * DIMS, bool)]
    whole = -np.linalg.solve(matrix[np.ix_(kept, kept)], gradient[kept])
    step = equations.solve(np.zeros(1))
    assert step.shared[1] == 0
    np.testing.assert_allclose(step.shared[free], whole[:3], rtol=1e-9)
    np.testing.assert_allclose(step.blocks.ravel(), whole[3:], rtol=1e-9)
    covariance = equations.covariance()
    assert not covariance[1].any()
    expected = np.linalg.inv(matrix[np.ix_(kept, kept)])[:3, :3]
    np.testing.assert_allclose(covariance[np.ix_(free, free)], expected, rtol=1e-8)


def test_no_step_and_no_variance_along_the_gauge() -> None:
    gauge = np.linalg.qr(np.random.default_rng(5).normal(size=(SHARED, 1)))[0]
    equations, matrix, gradient = arrow(gauge=gauge)
    step = equations.solve(np.zeros(1))
    assert abs(gauge[:, 0] @ step.shared) < 1e-9
    whole = np.r_[step.shared, step.blocks.ravel()]
    np.testing.assert_allclose(matrix @ whole, -gradient, atol=1e-9)
    covariance = equations.covariance()
    np.testing.assert_allclose(covariance @ gauge, 0, atol=1e-12)
    full = np.linalg.pinv(matrix, rcond=1e-12, hermitian=True)
    # The pseudo-inverse constrains all unknowns; ours only the shared ones. Both agree on what
    # does not depend on the gauge.
    projection = np.eye(SHARED) - gauge @ gauge.T
    inside = projection @ full[:SHARED, :SHARED] @ projection
    np.testing.assert_allclose(covariance, inside, atol=1e-9)


def test_the_gauge_is_held_against_rounding() -> None:
    gauge = np.linalg.qr(np.random.default_rng(5).normal(size=(SHARED, 1)))[0]
    equations, _, _ = arrow(gauge=gauge)
    exact = equations.solve(np.zeros(1)).shared
    # What rounding and robust weights leave along the gauge would be a step of a hundred.
    rounded = replace(
        equations,
        hessian=equations.hessian + 1e-6 * gauge @ gauge.T,
        gradient=equations.gradient + 1e-4 * gauge[:, 0],
    )
    step = rounded.solve(np.zeros(1)).shared
    np.testing.assert_allclose(step, exact, atol=1e-3)
    np.testing.assert_allclose(rounded.covariance(), equations.covariance(), atol=1e-9)


def test_a_block_that_nothing_observed_stays() -> None:
    equations, _, _ = arrow()
    blank = [np.copy(a) for a in (equations.block_hessian, equations.block_gradient)]
    blank[0][2], blank[1][2] = 0.0, 0.0
    coupling = equations.coupling.copy()
    coupling[2] = 0.0
    step = SchurEquations(
        equations.cost, equations.hessian, equations.gradient, *blank, coupling,
        equations.free, equations.gauge,
    ).solve(np.array([1e-3]))  # fmt: skip
    assert np.isfinite(step.shared).all()
    np.testing.assert_array_equal(step.blocks[2], 0.0)


@dataclass
class Valley:
    """Rosenbrock's valley with y eliminated: residuals 10 (y - x^2) and 1 - x."""

    def linearize(self, state: Array, _: NDArray[np.int64]) -> SchurEquations:
        x, y = state
        residual = np.array([10 * (y - x**2), 1 - x])
        by_x, by_y = np.array([-20 * x, -1.0]), np.array([10.0, 0.0])
        return SchurEquations(
            np.array([0.5 * residual @ residual]),
            np.array([[by_x @ by_x]]),
            np.array([by_x @ residual]),
            np.array([[[by_y @ by_y]]]),
            np.array([[by_y @ residual]]),
            np.array([[[by_x @ by_y]]]),
            np.ones(1, bool),
            np.zeros((1, 0)),
        )

    def retract(self, state: Array, step: SchurStep) -> Array:
        return state + np.array([step.shared[0], step.blocks[0, 0]])

    def retract_blocks(self, state: Array, step: Array) -> Array:
        return state + np.array([0.0, step[0, 0]])


def test_inner_iterations_need_fewer_steps_in_a_valley() -> None:
    start = np.array([-1.9, 2.0])
    plain = minimize(Valley(), start, min_gain=1e-12, max_iterations=100)
    inner = minimize(Valley(), start, min_gain=1e-12, inner_iterations_after=0)
    np.testing.assert_allclose(plain.state, [1, 1], atol=1e-5)
    np.testing.assert_allclose(inner.state, [1, 1], atol=1e-5)
    assert inner.iterations[0] < 0.6 * plain.iterations[0]
