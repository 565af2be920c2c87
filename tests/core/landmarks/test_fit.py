"""Fit of one visit: derivatives against differences, evidence against integrals."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from locatk.core.landmarks.detection.fit import (
    ModelPriors,
    VisitFitProblem,
    VisitFits,
    fit_visit,
)
from locatk.core.landmarks.detection.trace import (
    OdometryDrift,
    Trace,
    compose,
    odometry_corrections,
)
from locatk.core.landmarks.landmark import Geometry, signs
from locatk.core.landmarks.simulation.floor import bar_fields
from locatk.core.landmarks.simulation.passes import sensor_points

Array = NDArray[np.float64]

GEOMETRY = Geometry()

LEVER = np.array([[0.025, 0.0], [0.0, 0.024], [-0.026, 0.0], [0.003, -0.025]])

MARK = np.array([0.004, -0.006, 0.21])

STRENGTH = np.array([1.03, 0.96, -1.01, 0.99])


def path() -> Array:
    """Return an arc through the centre, then a rotation there."""
    bend = np.linspace(-1, 1, 41)
    arc = np.column_stack([0.09 * bend, 0.01 * bend**2, 0.2 * bend])
    rotation = np.repeat(arc[20:21], 15, axis=0) + np.linspace(0, 1.5, 15)[:, None] * [0, 0, 1]
    return np.concatenate([arc[:21], rotation])


def true_fields(poses: Array, mark: Array, strength: Array) -> Array:
    """(n, 4) by magpylib."""
    angle = np.arange(4) * math.pi / 2
    middle = np.zeros((4, 3))
    middle[:, :2] = GEOMETRY.radius_m * np.column_stack([np.cos(angle), np.sin(angle)])
    middle[:, 2] = -GEOMETRY.bar_height_m / 2
    c, s = np.cos(angle + math.pi / 2), np.sin(angle + math.pi / 2)
    axes = np.zeros((4, 3, 3))
    axes[:, 0, 0], axes[:, 0, 1], axes[:, 1, 0], axes[:, 1, 1], axes[:, 2, 2] = c, -s, s, c, 1
    cos, sin = math.cos(mark[2]), math.sin(mark[2])
    local = np.column_stack(
        [(poses[:, :2] - mark[:2]) @ [[cos, -sin], [sin, cos]], poses[:, 2] - mark[2]]
    )
    position = sensor_points(local, SENSORS, GEOMETRY.sensor_height_m)
    return np.asarray(
        np.einsum("nsk,k->ns", bar_fields(GEOMETRY, middle, axes, position[:, :, None]), strength)
    )


class Four:
    """Sensors as the simulator uses them."""

    position_m = LEVER

    def __len__(self) -> int:
        return len(LEVER)


SENSORS = Four()


def trace_of(poses: Array, values: Array, reference: int = 30) -> Trace:
    return Trace(
        poses,
        odometry_corrections(poses, reference, OdometryDrift(), np.gradient(poses, 0.01, axis=0)),
        values,
        LEVER,
        np.ones(len(poses)),
        reference,
    )


@pytest.fixture(scope="module")
def trace() -> Trace:
    values = true_fields(path(), MARK, STRENGTH)
    values[3, 1] = np.nan
    return trace_of(path(), values)


def problem_of(trace: Trace, *strengths: Array) -> VisitFitProblem:
    installed = np.array(strengths)
    neighbours = np.random.default_rng(2).normal(0, 1e-4, (len(strengths), *trace.field_t.shape, 2))
    return VisitFitProblem(
        trace, GEOMETRY, ModelPriors(), installed, np.full(installed.shape, 0.04), neighbours
    )


def differences(problem: VisitFitProblem, at: Array) -> tuple[Array, Array]:
    """Return analytic derivatives, and differences of the residuals."""
    analytic = problem.residuals(at, jacobian=True)[1]
    numeric = np.empty_like(analytic)
    for k in range(problem.layout.size):
        step = np.zeros(problem.layout.size)
        step[k] = 1e-6 if k < 3 else 1e-4
        ahead = problem.residuals(at + step, jacobian=False)[0]
        behind = problem.residuals(at - step, jacobian=False)[0]
        numeric[..., k] = (ahead - behind) / (2 * step[k])
    return analytic, numeric


def test_derivatives_by_every_parameter(trace: Trace) -> None:
    problem = problem_of(trace, signs(7), signs(10))
    at = np.random.default_rng(0).normal(size=(2, problem.layout.size)) * 0.7
    at[:, :3] = MARK + np.array([[0.003, 0.001, 0.1], [-0.004, 0.0, -0.1]])
    # The displacement of bars is modelled to first order, and its derivative is neglected.
    at[:, problem.layout.bar_position] = 0.0
    analytic, numeric = differences(problem, at)
    largest = np.abs(numeric).max(axis=(0, 1))
    assert largest.min() > 1e-3
    np.testing.assert_allclose(np.abs(analytic - numeric).max(axis=(0, 1)) / largest, 0, atol=1e-6)


def test_derivatives_with_displaced_bars_are_approximate(trace: Trace) -> None:
    problem = problem_of(trace, signs(7))
    at = np.random.default_rng(1).normal(size=(1, problem.layout.size))
    at[:, :3] = MARK
    analytic, numeric = differences(problem, at)
    assert np.abs(analytic - numeric).max() / np.abs(numeric).max() < 0.25


def test_missing_samples_have_no_weight(trace: Trace) -> None:
    residual, slope = problem_of(trace, signs(7)).residuals(
        np.array([[*MARK, *[0.0] * (problem_of(trace, signs(7)).layout.size - 3)]]), jacobian=True
    )
    row = 3 * 4 + 1
    assert residual[0, row] == 0
    assert not slope[0, row].any()
    assert np.isfinite(slope).all()


def test_fit_converges_to_the_landmark(trace: Trace) -> None:
    """From a centimetre and 15 degrees away, through the field of magpylib."""
    problem = problem_of(trace, signs(0b1011))
    start = problem.initial_parameters(MARK + np.array([[0.008, -0.006, 0.25]]))
    fitted = fit_visit(problem, start)
    # The strengths of the bars deviate by 1 to 4 % and are constrained by priors.
    np.testing.assert_allclose(fitted.parameters[0, :2], MARK[:2], atol=2e-4)
    assert fitted.parameters[0, 2] == pytest.approx(MARK[2], abs=5e-3)
    span = problem.layout.strength
    strength = signs(0b1011) + 0.04 * fitted.parameters[0, span]
    np.testing.assert_allclose(strength, STRENGTH, atol=0.02)


def test_hypotheses_of_a_batch_are_independent(trace: Trace) -> None:
    both = problem_of(trace, signs(0b1011), signs(0b0011))
    starts = both.initial_parameters(MARK + np.array([[0.008, -0.006, 0.25], [0.0, 0.002, 0.1]]))
    together = fit_visit(both, starts)
    for k in range(2):
        alone = fit_visit(both.take(np.array([k])), starts[[k]])
        np.testing.assert_allclose(alone.cost, together.cost[[k]], rtol=1e-9)


def test_information_agrees_with_the_scatter() -> None:
    """Poses from many noisy traces scatter as the covariance states."""
    clean = true_fields(path(), MARK, np.array([1.0, 1.0, -1.0, 1.0]))
    random = np.random.default_rng(5)
    priors = ModelPriors()
    sigma = np.sqrt(
        priors.noise_t**2 + priors.model_error_t**2 + (priors.relative_model_error * clean) ** 2
    )
    squares = []
    for _ in range(60):
        gain = 1 + priors.gain * random.normal(size=4)
        value = gain * clean + priors.offset_t * random.normal(size=4)
        trace = trace_of(path(), value + sigma * random.normal(size=clean.shape))
        problem = problem_of(trace, signs(0b1011))
        fitted = fit_visit(problem, problem.initial_parameters(MARK[None]))
        spread = np.linalg.inv(fitted.information[0])[:3, :3]
        off = fitted.parameters[0, :3] - MARK
        squares.append(off @ np.linalg.solve(spread, off))
    # The fit allows for errors of bars and odometry that are not simulated.
    assert 0.3 < np.mean(squares) < 3.6


def test_log_evidence_is_the_integral_of_the_posterior() -> None:
    """Laplace's approximation is exact for a problem that is linear in its unknowns."""
    # y = a u + noise with u from N(0, 1): y comes from N(0, s^2 + a^2).
    y, s = 1.7, 0.5
    result, want = [], []
    for a in (0.3, 2.0):
        u = a * y / (s**2 + a**2)
        cost = ((y - a * u) / s) ** 2 / 2 + u**2 / 2
        matrix = np.array([[[1 + (a / s) ** 2]]])
        fitted = VisitFits(np.array([[u]]), np.array([cost]), matrix)
        result.append(float(fitted.log_evidence()[0]))
        want.append(stats.norm.logpdf(y, scale=math.hypot(s, a)))
    assert result[1] - result[0] == pytest.approx(want[1] - want[0], rel=1e-12)


def test_cost_does_not_depend_on_the_frame(trace: Trace) -> None:
    """A rigid motion of the whole trace does not change the cost."""
    frame = np.array([0.3, -0.2, 1.1])
    moved = compose(frame, path())
    other = trace_of(moved, trace.field_t)
    costs = []
    for one, mark in ((trace, MARK), (other, compose(frame, MARK))):
        problem = problem_of(one, signs(0b1011))
        costs.append(fit_visit(problem, problem.initial_parameters(mark[None])).cost[0])
    assert costs[0] == pytest.approx(costs[1], rel=2e-3)


def test_thinned_trace_has_the_weight_of_all_samples(trace: Trace) -> None:
    costs = []
    for one in (trace, trace.thinned(12)):
        problem = problem_of(one, signs(0b1011))
        residual = problem.residuals(
            problem.initial_parameters(MARK + [[0.003, 0.0, 0.05]]), jacobian=False
        )[0]
        costs.append(float((residual**2).sum()))
    assert costs[1] == pytest.approx(costs[0], rel=0.3)
