"""Sparse least squares over a session: derivatives, and comparison with the truth."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.landmarks.detection.fit import ModelPriors
from locatk.core.landmarks.detection.hypotheses import Hypothesis, LandmarkFit, VisitHypotheses
from locatk.core.landmarks.detection.trace import (
    Trace,
    compose,
    correct_constant_errors,
    odometry_corrections,
    relative,
    sensor_positions,
)
from locatk.core.landmarks.field import landmark_field
from locatk.core.landmarks.landmark import Geometry, rotated, signs
from locatk.core.landmarks.localization.cell_filter import CellEstimate, IdentifiedVisit
from locatk.core.landmarks.localization.smoothing import (
    LandmarkPrior,
    RobotMeasurements,
    SmoothingSystem,
    VisitMeasurement,
    bin_pose_with_gradient,
    landmark_priors,
    odometry_link,
    relative_pose_with_gradient,
    smooth,
)
from locatk.core.landmarks.map.floor import AsBuiltLandmark, Cell, FloorMap
from locatk.core.landmarks.preprocessing import VisitSegment

Array = NDArray[np.float64]

GEOMETRY = Geometry()

PRIORS = ModelPriors()

SENSORS = GEOMETRY.circle_m * np.array([[1.0, 0], [0, 1.0], [-1.0, 0], [0, -1.0]])

CODES: dict[Cell, int] = {(0, 0): 7, (0, 1): 12, (1, 1): 10}

POSES: dict[Cell, Array] = {
    (0, 0): np.zeros(3),
    (0, 1): np.array([0.2, 0.0, 0.0]),
    (1, 1): np.array([0.2, 0.2, 0.0]),
}


def true_path() -> list[Array]:
    """Return poses near each of three landmarks, in the frame of the map."""
    line = np.linspace(-0.06, 0.06, 31)
    along = np.column_stack([line, 0.004 + 0.05 * line, np.full(31, 0.05)])
    up = np.column_stack([0.196 - 0.05 * line, 0.2 + line, np.full(31, 1.62)])
    return [along, along + [0.2, 0.006, 0.0], up]


def session(
    drift: float = 0.0, seed: int | None = None
) -> tuple[RobotMeasurements, dict[Cell, LandmarkPrior]]:
    """A robot whose odometry is too long by ``drift``; noise of fields with a seed."""
    parts = true_path()
    measured = [part * [1 + drift, 1 + drift, 1] for part in parts]
    visits, links = [], []
    for number, (true, own, cell) in enumerate(zip(parts, measured, CODES, strict=True)):
        local = sensor_positions(true, SENSORS) - POSES[cell][:2]
        value = landmark_field(GEOMETRY, CODES[cell], local)
        if seed is not None:
            sigma = math.hypot(PRIORS.noise_t, PRIORS.model_error_t)
            value = value + np.random.default_rng([seed, number]).normal(0, sigma, value.shape)
        observed = relative(own, own[15])
        trace = Trace(
            observed,
            odometry_corrections(observed, 15, PRIORS.drift),
            value,
            SENSORS,
            np.ones(len(observed)),
            15,
        )
        guess = true[15] + [0.001, -0.001, 0.01]
        segment = VisitSegment(0, 31, 1000 * number + np.arange(31), trace, own[15])
        visits.append(VisitMeasurement(segment, cell, guess, PRIORS.drift))
    for one, other in pairwise(measured):
        between = np.linspace(one[-1], other[0], 20)
        time_ns = np.arange(18, dtype=np.int64)
        links.append(odometry_link(time_ns, relative(between, between[0]), PRIORS.drift))
    sigma = np.array([1.5e-3, 1.5e-3, 0.012])
    landmarks = {
        cell: LandmarkPrior(POSES[cell], sigma, signs(code), np.full(4, 0.04))
        for cell, code in CODES.items()
    }
    return RobotMeasurements(visits, links), landmarks


def test_derivatives_of_relative_poses() -> None:
    random = np.random.default_rng(0)
    pose, mark = random.normal(size=3), random.normal(size=3)
    _, by_pose, by_mark = relative_pose_with_gradient(pose, mark)
    for slope, ahead in (
        (by_pose, lambda d: relative_pose_with_gradient(pose + d, mark)[0]),
        (by_mark, lambda d: relative_pose_with_gradient(pose, mark + d)[0]),
    ):
        own = np.column_stack([(ahead(d) - ahead(-d)) / 2e-6 for d in 1e-6 * np.eye(3)])
        np.testing.assert_allclose(slope, own, atol=1e-8)


def test_derivatives_of_a_bin() -> None:
    trace = session()[0].visits[0].trace
    random = np.random.default_rng(1)
    own = random.normal(size=3 + trace.correction.shape[2] - 4)
    constant = random.normal(size=4)
    slope = bin_pose_with_gradient(trace, -1, own, constant)[1]
    both = np.concatenate([own, constant])
    count = len(own)
    for k, step in enumerate(1e-6 * np.eye(len(both))):
        ahead, behind = both + step, both - step
        value = (
            bin_pose_with_gradient(trace, -1, ahead[:count], ahead[count:])[0]
            - bin_pose_with_gradient(trace, -1, behind[:count], behind[count:])[0]
        ) / 2e-6
        np.testing.assert_allclose(slope[:, k], value, atol=1e-7)


@pytest.mark.parametrize("kind", ["field", "link"])
def test_derivatives_of_all_rows(kind: str) -> None:
    """By every unknown, including those on which no row depends."""
    robot, landmarks = session(0.01)
    system = SmoothingSystem([robot], landmarks, GEOMETRY, PRIORS)
    random = np.random.default_rng(2)
    state = system.initial_state() + 0.3 * random.normal(size=system.size) * system.prior_weight
    for cell in landmarks:  # their derivatives are approximate otherwise
        state[system.landmark_columns[cell][3 + 4 :]] = 0.0

    def rows(at: Array) -> tuple[NDArray[np.intp], Array, Array]:
        return system.field_rows(at, 0, 1) if kind == "field" else system.link_rows(at, 0, 1)

    unknowns, jacobian, _ = rows(state)
    analytic = np.zeros((len(jacobian), system.size))
    for column, k in enumerate(unknowns):
        analytic[:, k] += jacobian[:, column]
    numeric = np.empty_like(analytic)
    for k in range(system.size):
        step = np.zeros(system.size)
        step[k] = 1e-6
        numeric[:, k] = (rows(state + step)[2] - rows(state - step)[2]) / 2e-6
    # The derivatives of links by constant errors of odometry are approximate.
    size = np.abs(numeric).max()
    np.testing.assert_allclose(
        analytic / size, numeric / size, atol=1e-6 if kind == "field" else 5e-3
    )


def test_faultless_sessions_give_the_truth() -> None:
    robot, landmarks = session()
    result = smooth([robot], landmarks, GEOMETRY, PRIORS)
    for stay, true in zip(result.visits[0], true_path(), strict=True):
        np.testing.assert_allclose(stay.pose, true[15], atol=2e-5)
    for cell, mark in result.landmarks.items():
        np.testing.assert_allclose(mark.pose, POSES[cell], atol=2e-5)
    assert result.residual_sigma < 0.05


def test_scale_of_odometry_is_estimated() -> None:
    robot, landmarks = session(0.02)
    result = smooth([robot], landmarks, GEOMETRY, PRIORS)
    scale = result.visits[0][0].corrections[0] * PRIORS.drift.scale
    assert scale == pytest.approx(-0.02, abs=0.006)
    for stay, true in zip(result.visits[0], true_path(), strict=True):
        np.testing.assert_allclose(stay.pose[:2], true[15, :2], atol=3e-4)


def test_displaced_landmark_is_moved() -> None:
    """Neighbours and odometry contradict its pose on the map."""
    robot, landmarks = session()
    off = np.array([0.004, -0.003, 0.0])
    landmarks[(0, 1)] = replace(landmarks[(0, 1)], pose=POSES[(0, 1)] + off)
    result = smooth([robot], landmarks, GEOMETRY, PRIORS)
    shift = result.landmarks[(0, 1)].pose - landmarks[(0, 1)].pose
    assert shift[:2] @ -off[:2] / (off[:2] @ off[:2]) > 0.3


def test_covariance_agrees_with_the_scatter() -> None:
    """Noise only: the covariance also allows for errors of bars, gains and odometry."""
    squares = []
    for seed in range(15):
        robot, landmarks = session(seed=seed)
        result = smooth([robot], landmarks, GEOMETRY, PRIORS)
        assert 0.8 < result.residual_sigma < 1.2
        for stay, true in zip(result.visits[0], true_path(), strict=True):
            off = stay.pose - true[15]
            squares.append(off @ np.linalg.solve(stay.covariance[:3, :3], off))
    assert 0.001 < np.mean(squares) < 3.5


def test_misfit_widens_the_covariance() -> None:
    robot, landmarks = session(seed=3)
    good = smooth([robot], landmarks, GEOMETRY, PRIORS)
    trusting = replace(
        PRIORS,
        noise_t=PRIORS.noise_t / 10,
        model_error_t=PRIORS.model_error_t / 10,
        relative_model_error=0,
    )
    bad = smooth([robot], landmarks, GEOMETRY, trusting)
    assert bad.residual_sigma > 5
    ratio = bad.visits[0][1].covariance[0, 0] / good.visits[0][1].covariance[0, 0]
    assert ratio > 1


def test_two_runs_share_landmarks() -> None:
    """Measurements of one robot improve the landmarks of the other."""
    robot, landmarks = session(seed=4)
    alone = smooth([robot], landmarks, GEOMETRY, PRIORS)
    both = smooth([robot, session(seed=5)[0]], landmarks, GEOMETRY, PRIORS)
    for cell in CODES:
        assert both.landmarks[cell].covariance[0, 0] < alone.landmarks[cell].covariance[0, 0]
    assert compose(both.visits[1][0].pose, np.zeros(3)).shape == (3,)


def test_links_take_large_constant_errors_exactly() -> None:
    """Curvature of eight standard deviations, and a second visit where the path then ends."""
    robot, landmarks = session()
    system = SmoothingSystem([robot], landmarks, GEOMETRY, PRIORS)
    state = system.initial_state()
    constant = np.array([0.0, 0.0, 8.0, 0.0])
    state[system.robot_columns[0][-4:]] = constant
    first, second = robot.visits[:2]
    start = bin_pose_with_gradient(first.trace, -1, state[system.visit_columns[0][0]], constant)[0]
    path = correct_constant_errors(robot.links[0].pose, constant, PRIORS.drift)
    end = compose(start, path[-1])
    local = second.trace.pose[0] + second.trace.correction[0][:, :4] @ constant
    pose = np.array([0.0, 0.0, end[2] - local[2]])
    pose[:2] = end[:2] - compose(pose, local)[:2]
    state[system.visit_columns[0][1][:3]] = pose
    assert np.abs(system.link_rows(state, 0, 0)[2]).max() < 1e-6


# ---- priors of landmarks


def identified(code: int, quarters: int, faulty_bar: int = -1) -> IdentifiedVisit:
    """Return a visit to the cell (0, 0)."""
    fit = LandmarkFit(
        code, 0.0, np.zeros(30), np.eye(30), signs(code), np.ones(4), 1.0, faulty_bar, 1.0
    )
    one = Hypothesis(code, 1.0, np.zeros(3), np.eye(3), signs(code), np.ones(4), fit)
    hypotheses = VisitHypotheses("robot", 0, 0, 5, np.zeros(3), (one,))
    segment = VisitSegment(0, 5, np.arange(5), session()[0].visits[0].trace, np.zeros(3))
    return IdentifiedVisit(segment, hypotheses, CellEstimate((0, 0), quarters, 0, 1.0, 1.0))


def floor_with(strength: list[float], sigma: float = 0.01) -> FloorMap:
    """Return a map of one landmark as built."""
    built = AsBuiltLandmark(1e-3, -2e-3, 0.01, np.array(strength), np.full(7, sigma))
    return FloorMap(np.array([[7]]), built={(0, 0): built})


def test_prior_of_a_landmark_is_that_of_the_map() -> None:
    prior = landmark_priors([identified(7, 0)], FloorMap(np.array([[7]])), PRIORS)[0, 0]
    assert prior.strength.tolist() == signs(7).tolist()
    assert prior.sigma.tolist() == [1.5e-3, 1.5e-3, 0.012]
    built = landmark_priors([identified(7, 0)], floor_with([0.9, 1.1, 1.0, -0.8]), PRIORS)[0, 0]
    assert built.pose == pytest.approx([1e-3, -2e-3, 0.01])
    assert built.strength.tolist() == [0.9, 1.1, 1.0, -0.8]
    assert built.strength_sigma.tolist() == [0.01] * 4
    unknown = landmark_priors([identified(7, 0)], floor_with([1, 1, 1, -1], np.nan), PRIORS)[0, 0]
    assert unknown.sigma.tolist() == [1.5e-3, 1.5e-3, 0.012]
    assert unknown.strength_sigma.tolist() == [PRIORS.strength] * 4


def test_strengths_as_built_are_not_used_if_the_bar_reads_otherwise() -> None:
    floor = floor_with([-0.9, 1.1, 0.1, -0.8])
    prior = landmark_priors([identified(7, 0)], floor, PRIORS)[0, 0]
    assert prior.strength.tolist() == [1.0, 1.1, 0.1, -0.8]
    assert prior.strength_sigma.tolist() == [PRIORS.strength, 0.01, 0.01, 0.01]


def test_faulty_bar_has_a_weak_prior_in_the_frame_of_the_map() -> None:
    floor = FloorMap(np.array([[7]]))
    visit = identified(int(rotated(7, -1)), 1, faulty_bar=0)
    prior = landmark_priors([visit], floor, PRIORS)[0, 0]
    assert prior.strength.tolist() == [1.0, 0.0, 1.0, -1.0]
    assert prior.strength_sigma.tolist() == [PRIORS.strength, 0.5, *[PRIORS.strength] * 2]
    # A later visit that explains the landmark without a fault takes precedence.
    both = landmark_priors([visit, identified(7, 0)], floor, PRIORS)[0, 0]
    assert both.strength.tolist() == signs(7).tolist()
    # A bar that is known to be missing keeps its strength.
    missing = landmark_priors([visit], floor_with([1.0, 0.05, 1.0, -1.0]), PRIORS)[0, 0]
    assert missing.strength.tolist() == [1.0, 0.05, 1.0, -1.0]
