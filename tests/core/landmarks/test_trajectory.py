"""Trajectory of a robot during, between and outside of its visits, against simulated truth."""

from __future__ import annotations

import functools
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.geometry import heading_from_quaternion
from locatk.core.landmarks import solver
from locatk.core.landmarks.localization.cell_filter import select_visits_on_map
from locatk.core.landmarks.localization.odometry_path import OdometryPath
from locatk.core.landmarks.localization.smoothing import (
    RobotMeasurements,
    VisitMeasurement,
    VisitPose,
    landmark_priors,
    link_visits,
    measure_visits,
    smooth,
)
from locatk.core.landmarks.localization.trajectory import estimate_trajectory, pose_probability
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.landmarks.preprocessing import VisitSegment
from locatk.core.landmarks.simulation.session import (
    NONE,
    Errors,
    SimulatedSession,
    SimulationOptions,
    simulate,
)
from locatk.core.landmarks.solver import SolveOptions
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

FLOOR = FloorMap(np.random.default_rng(5).integers(0, 16, (8, 8)))


@functools.cache
def session(seed: int, clean: bool = False) -> tuple[SimulatedSession, Trajectory]:
    errors = NONE if clean else Errors()
    options = SimulationOptions(
        strategy="path",
        cells=((1, 1), (1, 4), (3, 4), (3, 2), (5, 2)),
        errors=errors,
        rate_hz=40,
        stop_s=0.2,
        seed=seed,
    )
    one = simulate(FLOOR, options)
    result = solver.solve(one.samples, FLOOR, odometry=one.odometry)
    assert len(result.trajectories) == 1
    return one, result.trajectories[0]


@functools.cache
def identified(seed: int, clean: bool = False) -> solver.IdentifiedRecording:
    one = session(seed, clean)[0]
    return solver.identify_recording(one.samples[0], one.odometry[0], FLOOR, SolveOptions())


def test_a_pose_is_as_probable_as_the_less_probable_neighbouring_visit() -> None:
    segments = [SimpleNamespace(time_ns=np.array(each)) for each in ([10, 12, 14], [20, 24], [30])]
    time_ns = np.array([3, 10, 12, 14, 17, 20, 23, 24, 27, 30, 40])
    found = pose_probability(time_ns, segments, [0.9, 1.0, 0.8], 0.5)
    expected = [0.9, 0.9, 0.9, 0.9, 0.9, 1.0, 1.0, 1.0, 0.8, 0.8, 0.8]
    np.testing.assert_allclose(found, 0.5 * np.array(expected))


@pytest.mark.slow
def test_probabilities_of_poses_agree_with_the_facts() -> None:
    one, trajectory = session(1)
    facts = solver.solve(one.samples, FLOOR, odometry=one.odometry).facts.robots["robot"]
    assert trajectory.min_probability == pytest.approx(facts.probability)
    assert facts.provisional == trajectory.is_provisional


def measured(
    segments: list[VisitSegment], recording: solver.IdentifiedRecording
) -> RobotMeasurements:
    """Return visits that are linked by the odometry."""
    path, drift = OdometryPath.of(recording.odometry), recording.priors.drift
    visits = [VisitMeasurement(one, (0, 0), np.zeros(3), drift) for one in segments]
    links = [link_visits(one, other, path, drift) for one, other in pairwise(visits)]
    return RobotMeasurements(visits, links)


def errors_of(one: SimulatedSession, trajectory: Trajectory) -> tuple[Array, Array]:
    """Errors (n, 3), and their normalised squares (n,)."""
    truth, start = one.truth[0], one.truth[0].time_ns[0]
    heading = np.unwrap(heading_from_quaternion(truth.quaternion))
    true = np.column_stack(
        [
            np.interp(trajectory.time_ns - start, truth.time_ns - start, column)
            for column in (*truth.position[:, :2].T, heading)
        ]
    )
    off = (
        np.column_stack(
            [trajectory.position[:, :2], heading_from_quaternion(trajectory.quaternion)]
        )
        - true
    )
    off[:, 2] = np.remainder(off[:, 2] + np.pi, 2 * np.pi) - np.pi
    rows = np.array([0, 1, 5])
    covariance = trajectory.covariance[:, rows[:, None], rows]
    return off, np.einsum("ni,ni->n", off, np.linalg.solve(covariance, off[..., None])[..., 0])


@pytest.mark.slow
def test_times_are_those_of_the_odometry() -> None:
    one, trajectory = session(0)
    assert trajectory.frame == "map"
    np.testing.assert_array_equal(trajectory.time_ns, one.odometry[0].time_ns)


@pytest.mark.slow
def test_errors_are_about_a_millimetre() -> None:
    for seed in range(3):
        off = errors_of(*session(seed))[0]
        assert np.hypot(*off[:, :2].T).mean() < 1.5e-3
        assert np.degrees(np.sqrt((off[:, 2] ** 2).mean())) < 0.5


@pytest.mark.slow
def test_session_without_errors() -> None:
    off = errors_of(*session(3, clean=True))[0]
    # Odometry and samples are interpolated.
    assert np.hypot(*off[:, :2].T).max() < 3e-4
    assert np.abs(off[:, 2]).max() < 5e-3


@pytest.mark.slow
def test_covariances_agree_with_the_errors() -> None:
    squares = np.concatenate([errors_of(*session(seed))[1] for seed in range(3)])
    assert 0.3 < squares.mean() < 5
    assert np.quantile(squares, 0.99) < 20
    for seed in range(3):
        rows = np.array([0, 1, 5])
        spread = session(seed)[1].covariance
        assert np.linalg.eigvalsh(spread[:, rows[:, None], rows]).min() > 0
        assert np.isnan(spread[:, 2]).all()


@pytest.mark.slow
def test_trajectory_is_continuous() -> None:
    """Steps are those of the odometry, to a fraction of a millimetre."""
    one, trajectory = session(1)
    own = one.odometry[0]
    steps = np.hypot(*np.diff(trajectory.position[:, :2], axis=0).T)
    want = np.hypot(*np.diff(own.position[:, :2], axis=0).T)
    assert np.abs(steps - want).max() < 4e-4


@pytest.mark.slow
def test_dead_reckoning_before_and_after_all_visits() -> None:
    """Half a metre of odometry on both sides of two visits."""
    one = session(2)[0]
    recording = identified(2)
    on_map = select_visits_on_map(recording.visits, FLOOR)
    landmarks = landmark_priors(on_map, FLOOR, recording.priors)
    middle = on_map[2:4]
    measurements = measure_visits(middle, recording.odometry, recording.priors, FLOOR)
    smoothed = smooth([measurements], landmarks, FLOOR.geometry, recording.priors)
    trajectory = estimate_trajectory("robot", measurements, smoothed.visits[0], recording.odometry)
    off, squares = errors_of(one, trajectory)
    inside = (trajectory.time_ns >= middle[0].segment.time_ns[0]) & (
        trajectory.time_ns <= middle[-1].segment.time_ns[-1]
    )
    for end in (0, -1):
        assert trajectory.sigma[end, :2].max() > 2 * trajectory.sigma[inside, :2].max()
    assert squares.mean() < 8
    # Backward dead reckoning is as accurate as forward.
    assert np.hypot(*off[0, :2]) < 0.03
    assert np.hypot(*off[-1, :2]) < 0.06


@pytest.mark.slow
def test_backward_dead_reckoning_removes_constant_errors() -> None:
    """Known constant errors are removed in both directions."""
    recording = identified(3, clean=True)
    item = recording.visits[2]
    width = item.segment.trace.correction.shape[2]
    corrections = np.zeros(width)
    corrections[2] = 1.5  # curvature
    estimate = VisitPose(np.array([0.3, 0.2, 0.4]), corrections, np.eye(3 + width) * 1e-8)
    robot = measured([item.segment], recording)
    trajectory = estimate_trajectory("robot", robot, [estimate], recording.odometry)
    # The whole path has 1.5 sigma more curvature.
    heading = np.unwrap(heading_from_quaternion(trajectory.quaternion))
    own = np.unwrap(heading_from_quaternion(recording.odometry.quaternion))
    step = np.hypot(*np.diff(recording.odometry.position[:, :2], axis=0).T)
    path = np.concatenate([[0], np.cumsum(step)])
    curvature = 1.5 * recording.priors.drift.curvature_rad_per_m
    want = own + curvature * path
    off = heading - want
    np.testing.assert_allclose(off, off[0], atol=2e-3)


@pytest.mark.slow
def test_frame_of_odometry_does_not_matter() -> None:
    one, trajectory = session(0)
    own = one.odometry[0]
    c, s = np.cos(2.0), np.sin(2.0)
    rotation = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    half = np.array([0, 0, np.sin(1.0), np.cos(1.0)])
    x, y, z, w = own.quaternion.T
    rotated = np.column_stack([x, y, w * half[2] + z * half[3], w * half[3] - z * half[2]])
    moved = replace(own, position=own.position @ rotation + [5, -3, 0], quaternion=rotated)
    again = solver.solve(one.samples, FLOOR, odometry=[moved]).trajectories[0]
    np.testing.assert_allclose(again.position, trajectory.position, atol=2e-5)


@pytest.mark.slow
def test_difference_of_odometry_is_distributed_between_visits() -> None:
    """Two visits are farther apart than by odometry."""
    recording = identified(3, clean=True)
    pair = [item.segment for item in (recording.visits[1], recording.visits[5])]
    off = np.array([0.003, -0.002])
    estimates = []
    for number, visit in enumerate(pair):
        pose = visit.origin + [*(number * off), 0.0]
        width = visit.trace.correction.shape[2]
        estimates.append(VisitPose(pose, np.zeros(width), np.eye(3 + width) * 1e-8))
    robot = measured(pair, recording)
    trajectory = estimate_trajectory("robot", robot, estimates, recording.odometry)
    shift = trajectory.position[:, :2] - recording.odometry.position[:, :2]
    between = (trajectory.time_ns > pair[0].time_ns[-1]) & (trajectory.time_ns < pair[1].time_ns[0])
    assert between.sum() > 20
    before = trajectory.time_ns <= pair[0].time_ns[-1]
    np.testing.assert_allclose(shift[before][-1], 0, atol=2e-4)
    np.testing.assert_allclose(shift[trajectory.time_ns >= pair[1].time_ns[0]][0], off, atol=2e-4)
    fraction = shift[between] @ off / (off @ off)
    assert fraction[0] < 0.2
    assert fraction[-1] > 0.8
    assert np.abs(np.diff(fraction)).max() < 0.2
