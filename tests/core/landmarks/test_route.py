"""The way of a robot between and beside its visits, against the truth of simulations."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.geometry import heading_from_quaternion
from locatk.core.landmarks import solver
from locatk.core.landmarks.localization import trajectory as route
from locatk.core.landmarks.localization.smoothing import StayPose
from locatk.core.landmarks.map.floor import FloorMap
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
    found = solver.solve(one.samples, FLOOR, odometry=one.odometry)
    assert len(found.trajectories) == 1
    return one, found.trajectories[0]


def errors_of(one: SimulatedSession, told: Trajectory) -> tuple[Array, Array]:
    """Errors (n, 3), and their normalised squares (n,)."""
    truth, start = one.truth[0], one.truth[0].time_ns[0]
    heading = np.unwrap(heading_from_quaternion(truth.quaternion))
    true = np.column_stack(
        [
            np.interp(told.time_ns - start, truth.time_ns - start, column)
            for column in (*truth.position[:, :2].T, heading)
        ]
    )
    off = np.column_stack([told.position[:, :2], heading_from_quaternion(told.quaternion)]) - true
    off[:, 2] = np.remainder(off[:, 2] + np.pi, 2 * np.pi) - np.pi
    rows = np.array([0, 1, 5])
    covariance = told.covariance[:, rows[:, None], rows]
    return off, np.einsum("ni,ni->n", off, np.linalg.solve(covariance, off[..., None])[..., 0])


@pytest.mark.slow
def test_a_pose_for_each_pose_of_odometry() -> None:
    one, told = session(0)
    assert told.frame == "map"
    np.testing.assert_array_equal(told.time_ns, one.odometry[0].time_ns)


@pytest.mark.slow
def test_errors_are_a_millimetre() -> None:
    for seed in range(3):
        off = errors_of(*session(seed))[0]
        assert np.hypot(*off[:, :2].T).mean() < 1.5e-3
        assert np.degrees(np.sqrt((off[:, 2] ** 2).mean())) < 0.5


@pytest.mark.slow
def test_without_errors_there_are_none() -> None:
    off = errors_of(*session(7, clean=True))[0]
    # Odometry and samples are interpolated.
    assert np.hypot(*off[:, :2].T).max() < 3e-4
    assert np.abs(off[:, 2]).max() < 5e-3


@pytest.mark.slow
def test_covariances_are_honest_all_the_way() -> None:
    squares = np.concatenate([errors_of(*session(seed))[1] for seed in range(4)])
    assert 0.3 < squares.mean() < 5
    assert np.quantile(squares, 0.99) < 20
    for seed in range(4):
        rows = np.array([0, 1, 5])
        spread = session(seed)[1].covariance
        assert np.linalg.eigvalsh(spread[:, rows[:, None], rows]).min() > 0
        assert np.isnan(spread[:, 2]).all()


def test_no_jumps_where_parts_meet() -> None:
    """Steps are those of the odometry, to a fraction of a millimetre."""
    one, told = session(1)
    own = one.odometry[0]
    steps = np.hypot(*np.diff(told.position[:, :2], axis=0).T)
    want = np.hypot(*np.diff(own.position[:, :2], axis=0).T)
    assert np.abs(steps - want).max() < 4e-4


def test_what_lies_before_and_after_all_visits_is_told_less_sure() -> None:
    """Half a metre of odometry alone, by a floor of which the map knows one end."""
    one = session(2)[0]
    recording = solver.read(one.samples[0], one.odometry[0], FLOOR, SolveOptions())
    usable = solver.on_map(recording, FLOOR)
    marks = solver.expected(usable, FLOOR, recording.priors)
    middle = usable[2:4]
    smoothed = solver.smooth.smooth(
        [solver.as_run(middle, recording, FLOOR)], marks, FLOOR.geometry, recording.priors
    )
    told = route.poses(
        "robot",
        [item.visit for item in middle],
        smoothed.stays[0],
        recording.odometry,
        recording.priors,
    )
    off, squares = errors_of(one, told)
    inside = (told.time_ns >= middle[0].visit.time_ns[0]) & (
        told.time_ns <= middle[-1].visit.time_ns[-1]
    )
    for end in (0, -1):
        assert told.sigma[end, :2].max() > 2 * told.sigma[inside, :2].max()
    assert squares.mean() < 8
    # The parts before are as near to the truth as those after: odometry runs backwards right.
    assert np.hypot(*off[0, :2]) < 0.03
    assert np.hypot(*off[-1, :2]) < 0.06


@pytest.mark.slow
def test_the_way_before_runs_odometry_backwards() -> None:
    """Constant errors that are known are taken off in both directions alike."""
    one = session(3, clean=True)[0]
    recording = solver.read(one.samples[0], one.odometry[0], FLOOR, SolveOptions())
    item = recording.seen[2]
    width = item.visit.trace.correction.shape[2]
    wrong = np.zeros(width)
    wrong[2] = 1.5  # curvature
    stay = StayPose(np.array([0.3, 0.2, 0.4]), wrong, np.eye(3 + width) * 1e-8)
    told = route.poses("robot", [item.visit], [stay], recording.odometry, recording.priors)
    # A way whose curvature is 1.5 sigma more, all along.
    heading = np.unwrap(heading_from_quaternion(told.quaternion))
    own = np.unwrap(heading_from_quaternion(recording.odometry.quaternion))
    step = np.hypot(*np.diff(recording.odometry.position[:, :2], axis=0).T)
    way = np.concatenate([[0], np.cumsum(step)])
    bend = 1.5 * recording.priors.drift.curvature_radpm
    want = own + bend * way
    off = heading - want
    np.testing.assert_allclose(off, off[0], atol=2e-3)


@pytest.mark.slow
def test_odometry_in_another_frame_is_the_same() -> None:
    one, told = session(4)
    own = one.odometry[0]
    c, s = np.cos(2.0), np.sin(2.0)
    turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    half = np.array([0, 0, np.sin(1.0), np.cos(1.0)])
    x, y, z, w = own.quaternion.T
    turned = np.column_stack([x, y, w * half[2] + z * half[3], w * half[3] - z * half[2]])
    moved = replace(own, position=own.position @ turn + [5, -3, 0], quaternion=turned)
    again = solver.solve(one.samples, FLOOR, odometry=[moved]).trajectories[0]
    np.testing.assert_allclose(again.position, told.position, atol=2e-5)


def test_a_misfit_of_odometry_is_spread_over_the_way() -> None:
    """Between two visits that are farther apart than odometry tells."""
    one = session(3, clean=True)[0]
    recording = solver.read(one.samples[0], one.odometry[0], FLOOR, SolveOptions())
    pair = [item.visit for item in (recording.seen[1], recording.seen[5])]
    off = np.array([0.003, -0.002])
    stays = []
    for number, visit in enumerate(pair):
        pose = visit.origin + [*(number * off), 0.0]
        width = visit.trace.correction.shape[2]
        stays.append(StayPose(pose, np.zeros(width), np.eye(3 + width) * 1e-8))
    told = route.poses("robot", pair, stays, recording.odometry, recording.priors)
    shift = told.position[:, :2] - recording.odometry.position[:, :2]
    between = (told.time_ns > pair[0].time_ns[-1]) & (told.time_ns < pair[1].time_ns[0])
    assert between.sum() > 20
    before = told.time_ns <= pair[0].time_ns[-1]
    np.testing.assert_allclose(shift[before][-1], 0, atol=2e-4)
    np.testing.assert_allclose(shift[told.time_ns >= pair[1].time_ns[0]][0], off, atol=2e-4)
    share = shift[between] @ off / (off @ off)
    assert share[0] < 0.2
    assert share[-1] > 0.8
    assert np.abs(np.diff(share)).max() < 0.2
