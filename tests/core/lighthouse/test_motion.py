"""Paths in continuous time, against dense matrices, numerical derivatives and simulated flights.

The flights are those of the benchmark, whose motion, light planes and faults are modelled
independently of the solver.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from locatk.core.kernels import kernels
from locatk.core.lighthouse import solve
from locatk.core.lighthouse.calibration import (
    FACTORY_LINEAR_PARAMETERS,
    GENERIC_CALIBRATION,
    TILT,
    Calibration,
)
from locatk.core.lighthouse.devices import solver as device_solver
from locatk.core.lighthouse.devices.tracking import TrackedDevice
from locatk.core.lighthouse.devices.trajectories import refine_tracks
from locatk.core.lighthouse.motion.consistency import (
    agrees_with_most,
    find_contested,
    find_contradictions,
    residual_statistics,
)
from locatk.core.lighthouse.motion.equations import (
    WEAK_RATE_SIGMA,
    NormalEquations,
    PathSweeps,
    assemble,
    couple,
    couple_numpy,
    linearize,
)
from locatk.core.lighthouse.motion.frames import PathFrame
from locatk.core.lighthouse.motion.layout import without_flips
from locatk.core.lighthouse.motion.parameters import (
    FACTORY_SIGMA,
    GIVEN_POSITION_SIGMA_M,
    GIVEN_ROTATION_SIGMA_RAD,
    STATION_PARAMETERS,
    CommonParameters,
    gauge_directions,
    make_parameters,
    scene_size,
)
from locatk.core.lighthouse.motion.path import Path, prior_information
from locatk.core.lighthouse.motion.results import pose_covariances
from locatk.core.lighthouse.motion.solver import PathEstimate, PathProblem
from locatk.core.lighthouse.receiver import DECK
from locatk.core.lighthouse.scene import Scene, Station
from locatk.core.trajectory import Trajectory
from locatk.formats.benchmarks.lighthouse.flight_scores import score_flight, summarize
from locatk.formats.benchmarks.lighthouse.flights import Flight, make_flight

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

SIGMA_RAD = 1e-4
POWER = np.array([2.0, 20.0])

# ---- interpolation and prior


def transition(span_s: float) -> Array:
    return np.array([[1.0, span_s], [0.0, 1.0]])


def noise(span_s: float) -> Array:
    t = span_s
    return np.array([[t**3 / 3, t**2 / 2], [t**2 / 2, t]])


def make_path(time_s: Array, position: Array, velocity: Array, **rotation: Array) -> Path:
    return Path(time_s, np.ones(len(time_s) - 1, bool), position, velocity, **rotation)


def test_a_cubic_is_interpolated_exactly() -> None:
    time_s = np.array([0.0, 0.3, 1.0, 1.2])
    cubic = np.random.default_rng(0).normal(size=(4, 3))
    power, slope = np.arange(4), np.array([0.0, 1.0, 2.0, 3.0])
    position = time_s[:, None] ** power @ cubic
    velocity = (slope * time_s[:, None] ** np.maximum(power - 1, 0)) @ cubic
    path = make_path(time_s, position, velocity)
    query_s = np.array([0.0, 0.1, 0.3, 0.55, 0.99, 1.15, 1.2])
    knot = np.array([0, 0, 1, 1, 1, 2, 2])
    found, rotation = path.poses(knot, path.hermite_weights(knot, query_s))
    assert rotation is None
    np.testing.assert_allclose(found, query_s[:, None] ** power @ cubic, atol=1e-12)


def test_interpolation_is_the_mean_of_the_gaussian_process() -> None:
    # Barfoot, State Estimation for Robotics, chapter 11: x(t) = Lambda x_k + Psi x_(k+1).
    time_s = np.array([0.2, 0.9])
    path = make_path(time_s, np.zeros((2, 3)), np.zeros((2, 3)))
    for query_s in (0.3, 0.5, 0.85):
        before, after = query_s - time_s[0], time_s[1] - query_s
        psi = noise(before) @ transition(after).T @ np.linalg.inv(noise(before + after))
        lam = transition(before) - psi @ transition(before + after)
        weights = path.hermite_weights(np.array([0]), np.array([query_s]))[0]
        np.testing.assert_allclose(weights, np.concatenate([lam[0], psi[0]]), atol=1e-12)


def test_prior_information_is_that_of_the_dense_covariance() -> None:
    span_s = np.array([0.01, 0.4, 2.0])
    for t, found in zip(span_s, prior_information(span_s), strict=True):
        first = np.array([[0.5, 0.1], [0.1, 0.3]])
        step = transition(t)
        dense = np.block(
            [[first, first @ step.T], [step @ first, step @ first @ step.T + noise(t)]]
        )
        expected = np.linalg.inv(dense)
        expected[:2, :2] -= np.linalg.inv(first)
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())


def test_rotations_pass_both_knots_with_their_rates() -> None:
    rng = np.random.default_rng(1)
    first = Rotation.random(random_state=2)
    rotation = np.stack([first, first * Rotation.from_rotvec([0.2, -0.15, 0.1])])
    matrices = np.stack([r.as_matrix() for r in rotation])
    spin = rng.normal(size=(2, 3))
    zero = np.zeros((2, 3))
    path = make_path(np.array([0.0, 0.25]), zero, zero, rotation=matrices, spin=spin)
    step_s = 1e-5
    query_s = np.array([0.0, step_s, 0.25 - step_s, 0.25])
    knot = np.zeros(4, np.int64)
    _, found = path.poses(knot, path.hermite_weights(knot, query_s))
    assert found is not None
    np.testing.assert_allclose(found[0], matrices[0], atol=1e-12)
    np.testing.assert_allclose(found[3], matrices[1], atol=1e-12)
    for k, a, b in ((0, 0, 1), (1, 2, 3)):
        rate = Rotation.from_matrix(found[a].T @ found[b]).as_rotvec() / step_s
        # The step has an error of its order, and the rate at the end one of turn^4 / 720.
        np.testing.assert_allclose(rate, spin[k], atol=5e-4)


# ---- normal equations


def make_scene(calibrations: tuple[Calibration, ...] | None = None) -> Scene:
    """Return three stations on channels 1, 2, 4 that look at the origin."""
    stations = []
    for k, position in enumerate([[2.0, 1.5, 1.8], [-2.2, 0.4, 2.0], [0.3, -2.1, 1.5]]):
        forward = -np.array(position) + [0.0, 0.0, 0.4]
        forward /= np.linalg.norm(forward)
        left = np.cross([0.0, 0.0, 1.0], forward)
        left /= np.linalg.norm(left)
        rotation = np.stack([forward, left, np.cross(forward, left)], axis=1)
        calibration = GENERIC_CALIBRATION if calibrations is None else calibrations[k]
        stations.append(Station((1, 2, 4)[k], np.array(position), rotation, calibration))
    return Scene(tuple(stations))


def factory() -> Calibration:
    return replace(GENERIC_CALIBRATION, source="factory")


class Problem:
    """Sweeps on a short path, with states and parameters off the optimum."""

    def __init__(
        self, *, is_rigid: bool, is_estimated: bool, knots: int = 5, is_exact: bool = False
    ) -> None:
        rng = np.random.default_rng(3)
        levers = DECK.position_m if is_rigid else np.zeros((0, 3))
        common = make_parameters(
            make_scene((factory(),) * 3),
            [1, 2, 4],
            levers,
            is_estimated=is_estimated,
            size_m=2.5,
        )
        time_s = 0.1 * np.arange(knots)
        line = np.stack([0.2 * time_s - 0.1, 0.1 * np.sin(3 * time_s), 0.4 + 0 * time_s], axis=1)
        velocity = np.stack([0.2 + 0 * time_s, 0.3 * np.cos(3 * time_s), 0 * time_s], axis=1)
        rotation: dict[str, Array] = {}
        if is_rigid:
            # Small turns: derivatives by rotations are those at a turn of zero.
            base = Rotation.from_rotvec([0.1, -0.2, 0.3])
            turn = 0.0 if is_exact else 1e-4
            small = Rotation.from_rotvec(turn * rng.normal(size=(knots, 3)))
            rotation = {"rotation": (base * small).as_matrix(), "spin": np.zeros((knots, 3))}
        self.path = make_path(time_s, line, velocity, **rotation)
        diodes = max(len(levers), 1)
        cells = np.stack(np.meshgrid(range(knots - 1), range(3), range(2), range(diodes)), -1)
        knot, station, plane, diode = cells.reshape(-1, 4).T
        knot, station, plane, diode = np.repeat([knot, station, plane, diode], 2, axis=1)
        order = np.argsort(knot, kind="stable")
        knot, station, plane, diode = knot[order], station[order], plane[order], diode[order]
        query_s = time_s[knot] + 0.1 * rng.random(len(knot))
        zero = np.zeros(len(knot))
        weights = self.path.hermite_weights(knot, query_s)
        self.sweeps = PathSweeps(knot, weights, station, plane, diode, zero)
        angle = linearize(self.sweeps, self.path, common).residual
        angle = angle + SIGMA_RAD * rng.normal(size=len(knot))
        self.sweeps = replace(self.sweeps, angle=angle)
        self.common = common
        if not is_exact:
            sigma = np.sqrt(np.diagonal(np.linalg.inv(common.information)))
            sigma[: 3 * STATION_PARAMETERS].reshape(3, -1)[:, :6] = np.repeat([1e-3, 1e-6], 3)
            self.common = common.stepped(rng.normal(size=len(sigma)) * sigma)
        self.power = np.tile(POWER, (knots - 1, 1))
        self.weight = np.full(len(knot), SIGMA_RAD**-2)

    def equations(self, *, with_common: bool = True) -> NormalEquations:
        residuals = linearize(self.sweeps, self.path, self.common)
        return assemble(
            self.sweeps,
            residuals,
            self.weight,
            self.path,
            self.power,
            self.common,
            with_common=with_common,
        )

    def whitened(self, change: Array) -> Array:
        """Return all errors in standard deviations after a change of states and parameters."""
        k, d = len(self.path), 2 * self.path.pose_size
        path = self.path.stepped(change[: k * d].reshape(k, d))
        common = self.common.stepped(change[k * d :])
        parts = [linearize(self.sweeps, path, common).residual * np.sqrt(self.weight)]
        error = path.prior_errors()
        for span, e in zip(np.diff(path.time_s), error, strict=True):
            inverse = np.linalg.cholesky(np.linalg.inv(noise(span)))
            sigma = np.sqrt(np.repeat(POWER, 3)[: path.pose_size])
            parts.append((inverse.T @ e / sigma).ravel())
        rates = [path.velocity] if path.spin is None else [path.velocity, path.spin]
        rate = np.concatenate(rates, axis=1)
        parts.append((rate / WEAK_RATE_SIGMA[: path.pose_size]).ravel())
        parts.append(np.linalg.cholesky(common.information).T @ common.value)
        return np.concatenate(parts)

    def jacobian(self) -> Array:
        count = 2 * self.path.pose_size * len(self.path) + len(self.common.value)
        step = 1e-6
        columns = [
            (self.whitened(step * row) - self.whitened(-step * row)) / (2 * step)
            for row in np.eye(count)
        ]
        return np.stack(columns, axis=1)


def null_space(directions: Array) -> Array:
    """Return an orthonormal basis of what is orthogonal to directions (m, g)."""
    if not directions.shape[1]:
        return np.eye(len(directions))
    return np.linalg.svd(directions.T)[2][directions.shape[1] :].T


@pytest.fixture(
    scope="module",
    params=[(True, True), (True, False), (False, True), (False, False)],
    ids=["rigid, estimated", "rigid, given", "point, estimated", "point, given"],
)
def problem(request: pytest.FixtureRequest) -> Problem:
    is_rigid, is_estimated = request.param
    return Problem(is_rigid=is_rigid, is_estimated=is_estimated)


@pytest.fixture(scope="module")
def jacobian(problem: Problem) -> Array:
    return problem.jacobian()


def test_the_gradient_is_that_of_the_cost(problem: Problem, jacobian: Array) -> None:
    errors = problem.whitened(np.zeros(jacobian.shape[1]))
    expected = jacobian.T @ errors
    equations = problem.equations()
    found = np.concatenate([equations.gradient.ravel(), equations.common_gradient])
    # In units of the information of each unknown; turns from knot to knot are neglected.
    scale = np.sqrt(np.sum(jacobian**2, axis=0)) * np.linalg.norm(errors)
    tolerance = 1e-5 if problem.path.rotation is None else 1e-3
    np.testing.assert_allclose(found / scale, expected / scale, atol=tolerance)
    held = problem.equations(with_common=False)
    np.testing.assert_allclose(held.gradient, equations.gradient)


def dense_covariance(problem: Problem, jacobian: Array) -> Array:
    """Return the covariance of states and parameters without the gauge."""
    gauge = problem.common.gauge
    directions = np.zeros((jacobian.shape[1], gauge.shape[1]))
    directions[-len(gauge) :] = gauge
    basis = null_space(directions)
    reduced = jacobian @ basis
    scale = np.linalg.norm(reduced, axis=0)
    inverse = np.linalg.inv((reduced / scale).T @ (reduced / scale))
    return np.asarray(basis @ (inverse / scale / scale[:, None]) @ basis.T)


def test_steps_and_covariances_are_those_of_dense_matrices(
    problem: Problem, jacobian: Array
) -> None:
    # Errors of one standard deviation, so that steps are of that order.
    gradient = jacobian.T @ np.random.default_rng(0).normal(size=len(jacobian))
    equations = problem.equations()
    count = equations.gradient.size
    equations = replace(
        equations,
        gradient=gradient[:count].reshape(equations.gradient.shape),
        common_gradient=gradient[count:],
    )
    covariance = dense_covariance(problem, jacobian)
    sigma = np.sqrt(np.diagonal(covariance))
    expected = -covariance @ gradient
    states, common = equations.step()
    found = np.concatenate([states.ravel(), common])
    tolerance = 2e-2
    assert np.max(np.abs(found - expected) / sigma) < tolerance
    np.testing.assert_allclose(problem.common.gauge.T @ common, 0.0, atol=1e-9)

    shared, response = equations.covariances()
    flat = response.reshape(-1, len(common))
    full = np.block([[flat @ shared @ flat.T, flat @ shared], [shared @ flat.T, shared]])
    k, d = states.shape
    diagonal, _ = equations.states.inverse_blocks
    for i in range(k):
        rows = slice(i * d, (i + 1) * d)
        full[rows, rows] += diagonal[i]
    is_known = np.ones_like(full, bool)
    block = np.kron(np.eye(k), np.ones((d, d))) > 0
    is_known[: k * d, : k * d] = block
    difference = (full - covariance) / sigma / sigma[:, None]
    assert np.abs(difference[is_known]).max() < tolerance

    own = jacobian[:, : k * d]
    inverse = np.linalg.inv(own.T @ own)
    error = equations.states_step().ravel() + inverse @ gradient[: k * d]
    assert np.max(np.abs(error) / np.sqrt(np.diagonal(inverse))) < tolerance


def test_rejected_and_missing_sweeps_have_no_effect() -> None:
    problem = Problem(is_rigid=True, is_estimated=False)
    problem.weight[::3] = 0.0
    expected = problem.equations()
    rng = np.random.default_rng(0)
    angle = problem.sweeps.angle.copy()
    angle[::3] = np.where(rng.random(len(angle[::3])) < 0.5, np.nan, 1.0)
    problem.sweeps = replace(problem.sweeps, angle=angle)
    found = problem.equations()
    np.testing.assert_array_equal(found.gradient, expected.gradient)
    np.testing.assert_array_equal(found.common_gradient, expected.common_gradient)
    np.testing.assert_array_equal(found.step()[0], expected.step()[0])


def test_a_pause_separates_the_states() -> None:
    problem = Problem(is_rigid=True, is_estimated=False)
    problem.sweeps = replace(problem.sweeps, knot=problem.sweeps.knot)
    problem.weight[problem.sweeps.knot == 1] = 0.0
    problem.path = replace(problem.path, is_linked=np.array([True, False, True, True]))
    _, above = problem.equations().states.inverse_blocks
    np.testing.assert_allclose(above[1], 0.0, atol=1e-15)
    assert np.abs(above[0]).max() > 1e-9


@pytest.mark.skipif(kernels is None, reason="the compiled kernels were not built")
def test_the_compiled_products_are_those_of_sparse_matrices(problem: Problem) -> None:
    residuals = linearize(problem.sweeps, problem.path, problem.common)
    k, count = len(problem.path), len(problem.common.value)
    jacobian = np.random.default_rng(0).normal(size=(len(problem.sweeps), 24))
    arguments = (problem.sweeps.knot, jacobian, residuals.column, residuals.by_common, k, count)
    for found, expected in zip(couple(*arguments), couple_numpy(*arguments), strict=True):
        assert found.shape == expected.shape
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


def test_a_device_may_start_when_another_one_ends() -> None:
    problem = Problem(is_rigid=True, is_estimated=False)
    is_linked = np.array([True, False, True, True])
    problem.weight[problem.sweeps.knot == 1] = 0.0
    changes = []
    for shift_s in (0.0, problem.path.time_s[2] - problem.path.time_s[1]):
        time_s = problem.path.time_s - shift_s * (np.arange(5) > 1)
        problem.path = replace(problem.path, is_linked=is_linked, time_s=time_s)
        changes.append(problem.equations().step()[0])
    np.testing.assert_allclose(changes[0][:2], changes[1][:2], rtol=1e-6)
    assert np.isfinite(changes[1]).all()


@pytest.mark.parametrize("kind", ["bias", "lever"])
def test_columns_of_biases_and_photodiodes(kind: str) -> None:
    problem = Problem(is_rigid=True, is_estimated=False)
    sweeps, common = problem.sweeps, problem.common
    before = linearize(sweeps, problem.path, common).residual
    change = np.zeros(len(common.value))
    is_own = (sweeps.station == 2) & (sweeps.plane == 1) & (sweeps.photodiode == 3)
    if kind == "bias":
        column = common.bias_columns(np.array([2]), np.array([1]), np.array([3]))[0]
        change[column] = 1e-4
        moved = linearize(sweeps, problem.path, common.stepped(change)).residual - before
        np.testing.assert_allclose(moved, 1e-4 * is_own, atol=1e-14)
        # All biases are different parameters after those of stations and photodiodes.
        cells = np.stack(np.meshgrid(range(3), range(2), range(4)), -1).reshape(-1, 3).T
        columns = np.sort(common.bias_columns(*cells))
        first = 3 * STATION_PARAMETERS + 12
        np.testing.assert_array_equal(columns, np.arange(first, len(common.value)))
    else:
        columns = common.lever_columns(np.array([3]))[0]
        change[columns] = 0.001, -0.002, 0.003
        stepped = common.stepped(change)
        np.testing.assert_allclose(stepped.levers[3] - common.levers[3], change[columns])
        np.testing.assert_array_equal(stepped.levers[:3], common.levers[:3])
        moved = linearize(sweeps, problem.path, stepped).residual - before
        assert np.all((np.abs(moved) > 0) == (sweeps.photodiode == 3))


# ---- prior of the common parameters


def covariance_of(common: CommonParameters) -> Array:
    return np.linalg.inv(common.information)


def parameters(scene: Scene, channels: list[int], *, is_estimated: bool = False) -> Array:
    common = make_parameters(
        scene, channels, DECK.position_m, is_estimated=is_estimated, size_m=2.0
    )
    return covariance_of(common)


def test_priors_of_factory_and_generic_stations() -> None:
    scene = make_scene((factory(), GENERIC_CALIBRATION, factory()))
    covariance = parameters(scene, [1, 2, 4])
    sigma = np.sqrt(np.diagonal(covariance))
    by_station = sigma[: 3 * STATION_PARAMETERS].reshape(3, STATION_PARAMETERS)
    pose = np.repeat([GIVEN_POSITION_SIGMA_M, GIVEN_ROTATION_SIGMA_RAD], 3)
    np.testing.assert_allclose(by_station[:, :6], np.tile(pose, (3, 1)), rtol=1e-6)
    np.testing.assert_allclose(by_station[0, 7:13], FACTORY_SIGMA[1:], rtol=1e-6)
    np.testing.assert_allclose(by_station[0, 13:20], FACTORY_SIGMA, rtol=1e-6)
    # The phase of the first plane is zero by definition, in each unit.
    assert by_station[:, 6].max() < 1.1e-6
    spread = FACTORY_LINEAR_PARAMETERS.std(axis=0, ddof=1)
    np.testing.assert_allclose(by_station[1, 7:20], spread.ravel()[1:], rtol=1e-6)
    assert by_station[1, 6 + TILT] > 1.5 * by_station[0, 6 + TILT]


def test_given_covariances_are_used_unless_the_scene_is_from_the_same_sweeps() -> None:
    rng = np.random.default_rng(0)
    factor = 0.01 * rng.normal(size=(6, 6))
    given = factor @ factor.T
    scene = make_scene()
    stations = (scene.stations[0], replace(scene.stations[1], covariance=given), scene.stations[2])
    scene = replace(scene, stations=stations)
    second = slice(STATION_PARAMETERS, STATION_PARAMETERS + 6)
    np.testing.assert_allclose(
        parameters(scene, [1, 2, 4])[second, second], given, rtol=1e-5, atol=1e-10
    )
    first = slice(0, 6)
    np.testing.assert_allclose(
        parameters(scene, [2, 4])[first, first], given, rtol=1e-5, atol=1e-10
    )
    found = parameters(scene, [1, 2, 4], is_estimated=True)[second, second]
    np.testing.assert_allclose(np.sqrt(np.diagonal(found)), [2, 2, 2, 1, 1, 1], rtol=1e-6)


def test_the_joint_covariance_follows_the_order_of_the_channels() -> None:
    rng = np.random.default_rng(0)
    factor = 1e-3 * rng.normal(size=(60, 60))
    joint = factor @ factor.T
    scene = replace(make_scene(), covariance=joint)
    found = parameters(scene, [4, 1])
    index = np.concatenate([np.arange(20), STATION_PARAMETERS + np.arange(20)])
    rows = np.concatenate([40 + np.arange(20), np.arange(20)])
    np.testing.assert_allclose(
        found[np.ix_(index, index)], joint[np.ix_(rows, rows)], rtol=1e-4, atol=1e-9
    )
    # Estimated from the same sweeps: nothing is known of it.
    found = parameters(scene, [4, 1], is_estimated=True)
    assert np.abs(found[:6, STATION_PARAMETERS : STATION_PARAMETERS + 6]).max() < 1e-9


def test_no_sweep_depends_on_the_gauge() -> None:
    problem = Problem(is_rigid=False, is_estimated=True, is_exact=True)
    directions = problem.common.gauge
    assert directions.shape[1] == 7
    np.testing.assert_allclose(directions.T @ directions, np.eye(7), atol=1e-12)
    jacobian = problem.jacobian()[: len(problem.sweeps)]
    # The states that follow each motion cancel it.
    count = jacobian.shape[1] - len(directions)
    by_gauge = jacobian[:, count:] @ directions
    left = by_gauge - jacobian[:, :count] @ np.linalg.lstsq(jacobian[:, :count], by_gauge)[0]
    assert np.abs(left).max() < 1e-4 * np.abs(by_gauge).max()
    rigid = Problem(is_rigid=True, is_estimated=True).common.gauge
    assert rigid.shape[1] == 6
    assert Problem(is_rigid=True, is_estimated=False).common.gauge.shape[1] == 0


# ---- frame of the covariances


def motions(offset: Array) -> Array:
    """Return the changes (n, 3, 6) of points by translations and rotations."""
    turns = [np.cross(axis, offset) for axis in np.eye(3)]
    shifts = np.broadcast_to(np.eye(3), (len(offset), 3, 3))
    return np.concatenate([shifts, np.stack(turns, axis=2)], axis=2)


@pytest.fixture(scope="module")
def moved() -> tuple[PathEstimate, PathEstimate, Mask]:
    """Return an estimate with unknown stations, the same in the frame of poses, and these."""
    problem = Problem(is_rigid=True, is_estimated=True, knots=9)
    equations = problem.equations()
    covariance, response = equations.covariances()
    k, count = len(problem.path), len(problem.sweeps)
    estimate = PathEstimate(
        problem.path,
        np.zeros(k, np.int64),
        np.arange(k, dtype=np.int64),
        problem.common,
        covariance,
        equations.states.inverse_blocks[0][:, :6, :6],
        response[:, :6],
        np.arange(count),
        np.zeros(count),
        np.ones(count, bool),
        problem.sweeps.knot,
        SIGMA_RAD,
        np.zeros(2, bool),
    )
    is_fixed = np.arange(k) % 3 != 1
    frame = PathFrame.of(estimate, is_fixed, with_scale=False)
    return estimate, frame.apply(estimate), is_fixed


def test_chosen_poses_do_not_move_together(
    moved: tuple[PathEstimate, PathEstimate, Mask],
) -> None:
    before, after, is_fixed = moved

    def common_motion(estimate: PathEstimate) -> Array:
        position = estimate.path.position[is_fixed]
        basis = motions(position - position.mean(axis=0)).reshape(-1, 6)
        response = estimate.response[is_fixed, :3].reshape(len(basis), -1)
        fitted = np.linalg.lstsq(basis, response)[0]
        return np.sqrt(np.diagonal(fitted @ before.common_covariance @ fitted.T))

    assert common_motion(before).min() > 1e-5
    assert common_motion(after).max() < 1e-9


def test_shape_keeps_its_variance(moved: tuple[PathEstimate, PathEstimate, Mask]) -> None:
    before, after, is_fixed = moved
    frame = PathFrame.of(before, is_fixed, with_scale=False)
    own_covariance = {id(before): before.common_covariance}
    own_covariance[id(after)] = frame.station_covariance(before)
    position, rotation = before.path.position, before.path.rotation
    assert rotation is not None
    stations = before.common.stations[0]

    def shape_sigmas(estimate: PathEstimate) -> Array:
        """Return standard deviations of distances, relative turns, and station distances."""
        covariance = before.common_covariance
        rows = []
        for i, j in ((0, 8), (1, 4), (3, 7)):
            unit = (position[i] - position[j]) / np.linalg.norm(position[i] - position[j])
            rows.append(unit @ (estimate.response[i, :3] - estimate.response[j, :3]))
            turns = [rotation[k] @ estimate.response[k, 3:] for k in (i, j)]
            rows += list(turns[0] - turns[1])
        variance = np.array([row @ covariance @ row for row in rows])
        own = own_covariance[id(estimate)]
        between = own[:3, :3] + own[34:37, 34:37] - own[:3, 34:37] - own[34:37, :3]
        unit = (stations[0] - stations[1]) / np.linalg.norm(stations[0] - stations[1])
        return np.sqrt(np.append(variance, unit @ between @ unit))

    np.testing.assert_allclose(shape_sigmas(after), shape_sigmas(before), rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("with_scale", [False, True])
def test_covariances_in_another_frame_are_those_of_the_same_estimate(
    moved: tuple[PathEstimate, PathEstimate, Mask], with_scale: bool
) -> None:
    before, _, is_fixed = moved
    after = PathFrame.of(before, is_fixed, with_scale=with_scale).apply(before)
    knots = np.arange(len(before.path))
    shared = after.response @ before.common_covariance @ after.response.mT
    covariance = pose_covariances(after, knots)
    turn = np.zeros_like(covariance)
    assert after.path.rotation is not None
    turn[:, :3, :3], turn[:, 3:, 3:] = np.eye(3), after.path.rotation
    expected = turn @ (before.pose_covariance + shared) @ turn.mT
    np.testing.assert_allclose(covariance, expected, rtol=1e-6, atol=1e-12)
    assert np.linalg.eigvalsh(covariance).min() > 0.0
    assert np.trace(covariance[4, :3, :3]) < np.trace(pose_covariances(before, knots)[4, :3, :3])


# ---- rough trajectories


def spinning(kinds: str, step_s: float = 0.1) -> Trajectory:
    """Return poses: ``.`` a slow rotation, ``f`` and ``g`` flipped about two axes."""
    flips = {".": [0.0, 0.0, 0.0], "f": [2.0, 0.0, 0.0], "g": [0.0, 2.5, 0.0]}
    n = len(kinds)
    slow = Rotation.from_rotvec(
        np.stack([0 * np.arange(n), 0 * np.arange(n), 0.02 * np.arange(n)], 1)
    )
    rotation = slow * Rotation.from_rotvec([flips[kind] for kind in kinds])
    time_ns = np.rint(np.arange(n) * step_s * 1e9).astype(np.int64)
    return Trajectory(
        "device", "floor", time_ns, np.zeros((n, 3)), rotation.as_quat(), np.zeros((n, 6, 6))
    )


@pytest.mark.parametrize(
    ("kinds", "left_out"),
    [
        ("." * 20, ""),
        ("." * 20 + "fff" + "." * 10, "fff"),
        ("." * 10 + "fff" + "." * 20, "fff"),
        ("fff" + "." * 20 + "ff", "fffff"),
        ("." * 20 + "ff" + "ggg" + "." + "f" + "." * 5 + "gg", "ffgggfgg"),
        # Longer than three seconds: the device has really turned.
        ("." * 50 + "f" * 35 + "." * 40, ""),
        ("." * 50 + "f" * 20 + "." * 40, "f" * 20),
        (".", ""),
    ],
)
def test_short_flips_are_left_out(kinds: str, left_out: str) -> None:
    trajectory = spinning(kinds)
    kept = without_flips(trajectory).time_ns
    is_out = ~np.isin(trajectory.time_ns, kept)
    assert "".join(np.array(list(kinds))[is_out]) == left_out


def test_a_flip_after_a_pause_is_kept() -> None:
    trajectory = spinning("." * 20 + "f" * 5)
    time_ns = trajectory.time_ns.copy()
    time_ns[20:] += 4_000_000_000
    assert len(without_flips(replace(trajectory, time_ns=time_ns))) == 25


def test_a_device_may_turn_while_it_is_hidden() -> None:
    trajectory = spinning("." * 20 + "f" * 5)
    turned = Rotation.from_rotvec([0.9, 0.0, 0.0])
    quaternion = trajectory.quaternion.copy()
    quaternion[20:] = (Rotation.from_quat(quaternion[:5]) * turned).as_quat()
    time_ns = trajectory.time_ns.copy()
    assert len(without_flips(replace(trajectory, quaternion=quaternion))) == 20
    time_ns[20:] += 400_000_000
    assert len(without_flips(replace(trajectory, quaternion=quaternion, time_ns=time_ns))) == 25


def test_a_single_wrong_pose_after_a_pause_is_left_out() -> None:
    """It follows from the pose before the pause, but not the poses after it from it."""
    trajectory = spinning("." * 40)
    time_ns, quaternion = trajectory.time_ns.copy(), trajectory.quaternion.copy()
    time_ns[20:] += 500_000_000
    quaternion[20] = (
        Rotation.from_quat(quaternion[20]) * Rotation.from_rotvec([0.9, 0, 0])
    ).as_quat()
    kept = without_flips(replace(trajectory, time_ns=time_ns, quaternion=quaternion))
    assert np.array_equal(kept.time_ns, np.delete(time_ns, 20))


# ---- outliers


def contradictions(wrong: dict[int, float], rejected: list[int]) -> tuple[list[int], list[int]]:
    """Return the sweeps to reject and to reinstate, if some are wrong and some are rejected."""
    problem = Problem(is_rigid=True, is_estimated=False, knots=12, is_exact=True)
    angle = problem.sweeps.angle.copy()
    angle[list(wrong)] += list(wrong.values())
    problem.sweeps = replace(problem.sweeps, angle=angle)
    problem.weight[rejected] = 0.0
    for _ in range(3):
        equations = problem.equations(with_common=False)
        problem.path = problem.path.stepped(equations.states_step())
    residuals = linearize(problem.sweeps, problem.path, problem.common)
    is_used = problem.weight > 0
    consistency = residual_statistics(
        problem.sweeps, residuals, equations.states, SIGMA_RAD, is_used
    )
    leaving, returning = find_contradictions(problem.sweeps, consistency, is_used)
    return np.flatnonzero(leaving).tolist(), np.flatnonzero(returning).tolist()


def test_single_wrong_sweeps_are_found() -> None:
    assert contradictions({}, []) == ([], [])
    assert contradictions({250: 5e-3}, []) == ([250], [])
    # Far apart, each is found at once.
    assert contradictions({20: 5e-3, 500: -4e-3}, []) == ([20, 500], [])


def test_rejected_sweeps_come_back_if_they_agree() -> None:
    assert contradictions({}, [250]) == ([], [250])
    assert contradictions({250: 5e-3}, [250]) == ([], [])
    assert contradictions({250: 5e-3}, [250, 251]) == ([], [251])


def sweeps_of_knots(per_knot: int, knots: int = 60) -> PathSweeps:
    """Return sweeps of which only knots and stations, two by turns, are known."""
    knot = np.repeat(np.arange(knots), per_knot)
    station = np.arange(len(knot)) % 2
    return cast(PathSweeps, np.rec.fromarrays([knot, station], names="knot,station"))


@pytest.mark.parametrize(
    ("rejected", "contested"), [([], False), ([30], False), ([30, 31, 32], True)]
)
def test_short_runs_of_rejected_sweeps_are_contested(rejected: list[int], contested: bool) -> None:
    sweeps = sweeps_of_knots(4)
    result = find_contested(sweeps, ~np.isin(sweeps.knot, rejected))
    assert result[sweeps.knot == 30].all() == contested
    assert not result[(sweeps.knot < 20) | (sweeps.knot > 42)].any()


def test_a_station_whose_sweeps_mostly_contradict_agrees_nowhere() -> None:
    sweeps = sweeps_of_knots(4)
    agrees = np.ones(len(sweeps), bool)
    reflected = (sweeps.station == 1) & (sweeps.knot >= 20) & (sweeps.knot < 40)
    agrees[reflected] = False
    agrees[np.flatnonzero(reflected)[::4]] = True
    result = agrees_with_most(sweeps, agrees)
    assert not result[(sweeps.station == 1) & (sweeps.knot > 23) & (sweeps.knot < 36)].any()
    assert result[sweeps.station == 0].all()


@pytest.mark.slow
def test_reflections_that_agree_with_each_other_are_rejected_together() -> None:
    """Without the comparison by stations the median is 16 mm."""
    flight = make_flight(1, motion="slow", duration_s=12.0, geometry="unknown", reflections=0.1)
    solution = solve(flight.sweeps, flight.scene, receivers=flight.receivers)
    score = score_flight(flight, solution.trajectories[0])
    assert summarize(score)["rigid median"] < 9.0


# ---- independent flights


@pytest.fixture(scope="module", params=[0.0, 0.1], ids=["all right", "wrong sweeps"])
def flown(request: pytest.FixtureRequest) -> tuple[Flight, Trajectory, Scene, TrackedDevice]:
    """Return a flight under unknown stations, its solution, and its sweeps after the estimation."""
    flight = make_flight(2, motion="slow", duration_s=12.0, geometry="unknown", wrong=request.param)
    tracks: list[TrackedDevice] = []

    def record(*args: Any, **options: Any) -> Any:
        refined = refine_tracks(*args, **options)
        tracks.extend(refined[1])
        return refined

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(device_solver, "refine_tracks", record)
        solution = solve(flight.sweeps, flight.scene, receivers=flight.receivers)
    (trajectory,), (track,) = solution.trajectories, tracks
    assert isinstance(solution.artifact, Scene)
    return flight, trajectory, solution.artifact, track


@pytest.mark.slow
def test_flights_under_unknown_stations(
    flown: tuple[Flight, Trajectory, Scene, TrackedDevice],
) -> None:
    flight, trajectory, scene, _ = flown
    score = score_flight(flight, trajectory, scene)
    figures = summarize(score)
    assert figures["rigid median"] < 8.0
    assert figures["coverage"] > 0.98
    assert 0.2 < figures["aligned NEES"] < 4.0
    assert not score.is_far.any()
    assert not score.is_invalid.any()


@pytest.mark.slow
def test_wrong_sweeps_of_a_flight_are_rejected(
    flown: tuple[Flight, Trajectory, Scene, TrackedDevice],
) -> None:
    flight, _, _, track = flown
    sensors = np.int64(4)
    used = (track.sweeps.time_ns * sensors + track.sweeps.sensor)[track.is_used]
    is_used = np.isin(flight.sweeps.time_ns * sensors + flight.sweeps.sensor, used)
    assert np.mean(is_used[~flight.is_wrong]) > 0.98
    if flight.options.wrong:
        assert flight.is_wrong.sum() > 500
        assert np.mean(is_used[flight.is_wrong]) < 0.05


# ---- guards


def test_motions_that_keep_a_floor_are_no_errors_of_a_planar_scene() -> None:
    positions = np.array([[-1.0, 0.5, 2.0], [1.5, 0.2, 1.7], [0.3, -2.0, 2.2]])
    count = len(positions) * 34
    directions = gauge_directions(positions, count, with_scale=True, floor_z=0.4)
    assert directions.shape == (count, 4)

    def distance(shift: Array, turn: float = 0.0) -> float:
        """Return the distance of a motion of all stations from the directions."""
        whole = np.zeros((len(positions), 34))
        whole[:, :3], whole[:, 5] = shift, turn
        flat = whole.ravel()
        return float(np.linalg.norm(directions @ (directions.T @ flat) - flat))

    assert distance(np.array([1.0, 0.0, 0.0])) < 1e-9
    assert distance(positions - [0.0, 0.0, 0.4]) < 1e-9
    assert distance(np.cross([0.0, 0.0, 1.0], positions), turn=1.0) < 1e-9
    # The floor determines heights.
    assert distance(np.array([0.0, 0.0, 1.0])) > 0.05
    assert distance(positions) > 0.05


def test_a_station_that_contradicts_the_others_is_left_out() -> None:
    problem = Problem(is_rigid=True, is_estimated=False)
    estimation = PathProblem(problem.sweeps, problem.common, problem.path)
    estimation.leave_out_stations()
    assert not estimation.is_left_out.any()
    is_first = problem.sweeps.station == 0
    moved = replace(problem.sweeps, angle=problem.sweeps.angle + 0.2 * is_first)
    estimation = PathProblem(moved, problem.common, problem.path)
    estimation.leave_out_stations()
    assert estimation.is_left_out.tolist() == [True, False, False]
    assert np.array_equal(estimation.is_testable, ~is_first)
    # If no station agrees with the path, none is accused.
    lost = replace(problem.sweeps, angle=problem.sweeps.angle + 0.2)
    estimation = PathProblem(lost, problem.common, problem.path)
    estimation.leave_out_stations()
    assert not estimation.is_left_out.any()


def test_the_power_of_a_motion_does_not_depend_on_its_place() -> None:
    """A device in the middle of four stations is as far from them as one below."""
    corners = np.array([[2.0, 2.0, 2.0], [-2.0, 2.0, 2.0], [-2.0, -2.0, 2.0], [2.0, -2.0, 2.0]])
    near = np.random.default_rng(0).normal(0.0, 0.05, (50, 3))
    assert scene_size(corners, near + [0.0, 0.0, 2.0]) == pytest.approx(2.83, abs=0.05)
    assert scene_size(corners, near) == pytest.approx(3.46, abs=0.05)


def test_windows_do_not_cross_from_one_path_to_another() -> None:
    linked = np.array([True, True, False, True, True, True])
    zeros = np.zeros((7, 3))
    path = Path(np.arange(7) * 0.01, linked, zeros, zeros)
    values = np.array([[1.0, 2.0, 0.0, 8.0, 16.0, 32.0], np.ones(6)])
    sums = path.window_sums(values, 3)
    # The step between the paths ends the first one.
    np.testing.assert_allclose(sums[0], [3, 3, 2, 24, 56, 48])
    np.testing.assert_allclose(sums[1], [2, 3, 2, 2, 3, 2])
    np.testing.assert_allclose(path.window_sums(values, 100)[0], [3, 3, 3, 56, 56, 56])
