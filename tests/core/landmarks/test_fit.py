"""The fit of one visit: derivatives against differences, evidence against integrals."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from locatk.core.landmarks.detection.fit import POSE, Fitted, Priors, Problem, descend
from locatk.core.landmarks.detection.trace import Drift, Trace, compose, corrections
from locatk.core.landmarks.landmark import Geometry, signs
from locatk.core.landmarks.simulation.floor import bar_fields
from locatk.core.landmarks.simulation.passes import sensor_points

Array = NDArray[np.float64]

GEOMETRY = Geometry()

LEVER = np.array([[0.025, 0.0], [0.0, 0.024], [-0.026, 0.0], [0.003, -0.025]])

MARK = np.array([0.004, -0.006, 0.21])

STRENGTH = np.array([1.03, 0.96, -1.01, 0.99])


def way() -> Array:
    """An arc through the middle and a turn there, as seen from its 30th pose."""
    bend = np.linspace(-1, 1, 41)
    arc = np.column_stack([0.09 * bend, 0.01 * bend**2, 0.2 * bend])
    turn = np.repeat(arc[20:21], 15, axis=0) + np.linspace(0, 1.5, 15)[:, None] * [0, 0, 1]
    return np.concatenate([arc[:21], turn])


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
    seen = np.column_stack(
        [(poses[:, :2] - mark[:2]) @ [[cos, -sin], [sin, cos]], poses[:, 2] - mark[2]]
    )
    place = sensor_points(seen, SENSORS, GEOMETRY.sensor_height_m)
    return np.asarray(
        np.einsum("nsk,k->ns", bar_fields(GEOMETRY, middle, axes, place[:, :, None]), strength)
    )


class Four:
    """What the simulator asks of sensors."""

    position_m = LEVER

    def __len__(self) -> int:
        return len(LEVER)


SENSORS = Four()


def trace_of(poses: Array, values: Array, reference: int = 30) -> Trace:
    return Trace(
        poses,
        corrections(poses, reference, Drift()),
        values,
        LEVER,
        np.ones(len(poses)),
        reference,
    )


@pytest.fixture(scope="module")
def trace() -> Trace:
    values = true_fields(way(), MARK, STRENGTH)
    values[3, 1] = np.nan
    return trace_of(way(), values)


def problem_of(trace: Trace, *strengths: Array) -> Problem:
    laid = np.array(strengths)
    return Problem(trace, GEOMETRY, Priors(), laid, np.full(laid.shape, 0.04))


def differences(problem: Problem, at: Array) -> tuple[Array, Array]:
    """Derivatives as told, and as differences of the residuals."""
    told = problem.residuals(at, jacobian=True)[1]
    own = np.empty_like(told)
    for k in range(problem.size):
        step = np.zeros(problem.size)
        step[k] = 1e-6 if k < POSE else 1e-4
        ahead = problem.residuals(at + step, jacobian=False)[0]
        behind = problem.residuals(at - step, jacobian=False)[0]
        own[..., k] = (ahead - behind) / (2 * step[k])
    return told, own


def test_derivatives_by_every_parameter(trace: Trace) -> None:
    problem = problem_of(trace, signs(7), signs(10))
    at = np.random.default_rng(0).normal(size=(2, problem.size)) * 0.7
    at[:, :POSE] = MARK + np.array([[0.003, 0.001, 0.1], [-0.004, 0.0, -0.1]])
    places = slice(POSE + 2 * 4 + 4, POSE + 2 * 4 + 12)
    at[:, places] = 0.0  # elsewhere the push of a bar is of first order, its slope of none
    told, own = differences(problem, at)
    largest = np.abs(own).max(axis=(0, 1))
    assert largest.min() > 1e-3
    np.testing.assert_allclose(np.abs(told - own).max(axis=(0, 1)) / largest, 0, atol=1e-6)


def test_pushed_bars_keep_the_derivatives_near(trace: Trace) -> None:
    problem = problem_of(trace, signs(7))
    at = np.random.default_rng(1).normal(size=(1, problem.size))
    at[:, :POSE] = MARK
    told, own = differences(problem, at)
    assert np.abs(told - own).max() / np.abs(own).max() < 0.25


def test_silent_samples_weigh_nothing(trace: Trace) -> None:
    residual, slope = problem_of(trace, signs(7)).residuals(
        np.array([[*MARK, *[0.0] * (problem_of(trace, signs(7)).size - POSE)]]), jacobian=True
    )
    row = 3 * 4 + 1
    assert residual[0, row] == 0
    assert not slope[0, row].any()
    assert np.isfinite(slope).all()


def test_a_descent_ends_at_the_landmark(trace: Trace) -> None:
    """From a centimetre and 15 degrees away, through the field of magpylib."""
    problem = problem_of(trace, signs(0b1011))
    start = problem.start(MARK + np.array([[0.008, -0.006, 0.25]]))
    fitted = descend(problem, start)
    # The bars' strengths are 1 to 4 % off, which priors hold.
    np.testing.assert_allclose(fitted.parameters[0, :2], MARK[:2], atol=2e-4)
    assert fitted.parameters[0, 2] == pytest.approx(MARK[2], abs=5e-3)
    span = slice(POSE + 8, POSE + 12)
    strength = signs(0b1011) + 0.04 * fitted.parameters[0, span]
    np.testing.assert_allclose(strength, STRENGTH, atol=0.02)


def test_descents_know_nothing_of_each_other(trace: Trace) -> None:
    both = problem_of(trace, signs(0b1011), signs(0b0011))
    starts = both.start(MARK + np.array([[0.008, -0.006, 0.25], [0.0, 0.002, 0.1]]))
    together = descend(both, starts)
    for k in range(2):
        alone = descend(both.chosen(np.array([k])), starts[[k]])
        np.testing.assert_allclose(alone.cost, together.cost[[k]], rtol=1e-9)


def test_the_information_is_that_of_the_scatter() -> None:
    """Places found from many noisy traces scatter as the covariance says."""
    clean = true_fields(way(), MARK, np.array([1.0, 1.0, -1.0, 1.0]))
    random = np.random.default_rng(5)
    priors = Priors()
    sigma = np.sqrt(priors.noise_t**2 + priors.floor_t**2 + (priors.model * clean) ** 2)
    squares = []
    for _ in range(60):
        gain = 1 + priors.gain * random.normal(size=4)
        value = gain * clean + priors.offset_t * random.normal(size=4)
        trace = trace_of(way(), value + sigma * random.normal(size=clean.shape))
        problem = problem_of(trace, signs(0b1011))
        fitted = descend(problem, problem.start(MARK[None]))
        spread = np.linalg.inv(fitted.information[0])[:POSE, :POSE]
        off = fitted.parameters[0, :POSE] - MARK
        squares.append(off @ np.linalg.solve(spread, off))
    # Bars and odometry are without the errors that the fit allows for: it is cautious.
    assert 0.3 < np.mean(squares) < 3.6


def test_evidence_is_an_integral_of_the_posterior() -> None:
    """Of a problem that is linear in its unknowns Laplace's approximation is exact."""
    # y = a u + noise with u from N(0, 1): y comes from N(0, s^2 + a^2).
    y, s = 1.7, 0.5
    found, want = [], []
    for a in (0.3, 2.0):
        u = a * y / (s**2 + a**2)
        cost = ((y - a * u) / s) ** 2 / 2 + u**2 / 2
        matrix = np.array([[[1 + (a / s) ** 2]]])
        fitted = Fitted(np.array([[u]]), np.array([cost]), matrix)
        found.append(float(fitted.evidence()[0]))
        want.append(stats.norm.logpdf(y, scale=math.hypot(s, a)))
    assert found[1] - found[0] == pytest.approx(want[1] - want[0], rel=1e-12)


def test_a_frame_may_lie_anywhere(trace: Trace) -> None:
    """Turned and moved as a whole, a trace costs the same."""
    frame = np.array([0.3, -0.2, 1.1])
    moved = compose(frame, way())
    other = trace_of(moved, trace.value_t)
    costs = []
    for one, mark in ((trace, MARK), (other, compose(frame, MARK))):
        problem = problem_of(one, signs(0b1011))
        costs.append(descend(problem, problem.start(mark[None])).cost[0])
    assert costs[0] == pytest.approx(costs[1], rel=2e-3)
