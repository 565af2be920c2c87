"""Long recordings, stations that are moved during a recording, and the times of poses."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from locatk.core.errors import InputError
from locatk.core.geometry import umeyama
from locatk.core.lighthouse import SolveOptions, solve
from locatk.core.lighthouse.motion import moves as moves_module
from locatk.core.lighthouse.motion import recording
from locatk.core.lighthouse.motion.moves import find_moves, moved_stations
from locatk.core.lighthouse.motion.parameters import STATION_PARAMETERS
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.trajectory import Trajectory
from locatk.formats.benchmarks.lighthouse.flights import DEVICE, Flight, make_flight

SHORT_S = 3.0
"""Duration of the flight of fast tests [s]: the end of a longer one, which begins with a rest."""


def in_parts(monkeypatch: pytest.MonkeyPatch, flight: Flight, knots: int) -> Trajectory:
    """Return the trajectory of a flight whose scene is estimated from some of its knots."""
    monkeypatch.setattr(recording, "MAX_SAMPLE_KNOTS", knots)
    monkeypatch.setattr(recording, "SAMPLE_WINDOW_S", 2.0)
    monkeypatch.setattr(recording, "PART_S", 3.0)
    return solve_flight(flight)


def solve_flight(flight: Flight) -> Trajectory:
    solution = solve(flight.sweeps, flight.scene, receivers=flight.receivers)
    assert not [w for w in solution.warnings if w.code == "paths_not_estimated"]
    return solution.trajectories[0]


def errors(flight: Flight, trajectory: Trajectory, *, with_scale: bool = False) -> np.ndarray:
    """Return the distances (n,) from the true positions after alignment."""
    truth, _ = flight.true_poses(trajectory.time_ns)
    aligned = umeyama(trajectory.position, truth, with_scale=with_scale).apply(trajectory.position)
    return np.asarray(np.linalg.norm(aligned - truth, axis=1))


@pytest.mark.slow
@pytest.mark.parametrize(("geometry", "diodes"), [("given", 4), ("unknown", 4), ("given", 1)])
def test_parts_are_as_accurate_as_the_whole(
    monkeypatch: pytest.MonkeyPatch, geometry: str, diodes: int
) -> None:
    flight = make_flight(7, duration_s=12.0, motion="slow", geometry=geometry, diodes=diodes)
    whole = solve_flight(flight)
    parts = in_parts(monkeypatch, flight, 700)
    assert np.array_equal(parts.time_ns, whole.time_ns)
    # Another path was estimated, with similar errors and covariances: other windows know the
    # stations, given to 10 mm, from other sweeps.
    assert not np.array_equal(parts.position, whole.position)
    # Given stations alone determine the scale of single photodiodes.
    error, expected = (errors(flight, t, with_scale=diodes == 1) for t in (parts, whole))
    assert np.median(error) < 1.3 * np.median(expected) + 1.5e-3
    assert np.max(error) < 1.5 * np.max(expected) + 2e-3
    ratio = parts.sigma[:, :3] / whole.sigma[:, :3]
    assert 0.8 < np.median(ratio) < 1.6
    # No jump where parts meet.
    step = np.linalg.norm(np.diff(parts.position, axis=0) - np.diff(whole.position, axis=0), axis=1)
    assert step.max() < 2e-3


@pytest.mark.slow
def test_a_part_without_agreement_has_no_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    flight = make_flight(7, duration_s=12.0, motion="slow", geometry="given")
    follow, calls = recording.follow_path, []

    def fail_once(*arguments: object, **options: object) -> recording.PathEstimate:
        calls.append(arguments)
        if len(calls) == 2:
            raise recording.DegenerateError("")
        return follow(*arguments, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(recording, "follow_path", fail_once)
    trajectory = in_parts(monkeypatch, flight, 700)
    gap_s = 1e-9 * np.diff(trajectory.time_ns).max()
    assert 2.9 < gap_s < 3.1
    assert errors(flight, trajectory).max() < 0.01


def two_devices(flight: Flight, is_second: np.ndarray) -> tuple[Sweeps, dict[str, Receiver]]:
    """Return the sweeps of a flight, those of ``is_second`` (n,) as a second device, ``other``."""
    sweeps = replace(flight.sweeps, devices=(DEVICE, "other"), device=is_second.astype(np.int32))
    return sweeps, dict.fromkeys(sweeps.devices, flight.receivers[DEVICE])


@pytest.mark.parametrize("rate_hz", [None, pytest.param(50.0, marks=pytest.mark.slow)])
def test_each_device_has_its_part_of_the_poses(
    short_flight: Flight, monkeypatch: pytest.MonkeyPatch, rate_hz: float | None
) -> None:
    """One flight as that of two devices, whose paths meet."""
    flight = short_flight
    middle_ns = int(np.median(flight.sweeps.time_ns))
    sweeps, receivers = two_devices(flight, flight.sweeps.time_ns >= middle_ns)
    monkeypatch.setattr(recording, "MAX_SAMPLE_KNOTS", 200)
    solution = solve(sweeps, flight.scene, SolveOptions(rate_hz=rate_hz), receivers=receivers)
    assert not [w for w in solution.warnings if w.code == "paths_not_estimated"]
    first, second = solution.trajectories
    assert len(first) == pytest.approx(len(second), rel=0.1)
    assert len(first) + len(second) > 0.95 * SHORT_S * 50.0
    assert first.time_ns.max() <= middle_ns + 20e6
    assert second.time_ns.min() >= middle_ns - 20e6
    for trajectory in (first, second):
        assert errors(flight, trajectory).max() < 0.01


def test_a_device_without_agreement_has_no_poses() -> None:
    """Most sweeps of the second device are rejected; the first agrees with all."""
    device = np.repeat([0, 1], 30)
    estimate = SimpleNamespace(
        sweep=np.arange(60),
        is_left_out=np.zeros(1, bool),
        is_used=(device == 0) | (np.arange(60) % 6 == 0),
        device=np.repeat([0, 1], 5),
    )
    sweeps = np.rec.fromarrays([np.zeros(30, np.int64)], names="station")
    paths = SimpleNamespace(sweeps=[sweeps, sweeps], start=[range(9), range(9)])
    sample = recording.PathSample(cast(recording.PathEstimate, estimate), (0, 1), True)
    good, bad = (
        recording.PathRecording._of_sample(cast(recording.PathRecording, paths), k, sample)
        for k in range(2)
    )
    assert good.knots.tolist() == list(range(5))
    assert good.rows.tolist() == list(range(30))
    assert bad.estimate is None
    assert bad.rough_poses == 9


# ---- moved stations


@pytest.mark.slow
@pytest.mark.parametrize(("geometry", "seed"), [("given", 1), ("unknown", 5)])
def test_a_moved_station_is_named(geometry: str, seed: int) -> None:
    flight = make_flight(
        seed, duration_s=22.0, motion="slow", geometry=geometry, is_station_moved=True
    )
    solution = solve(flight.sweeps, flight.scene, receivers=flight.receivers)
    (warning,) = [w for w in solution.warnings if w.code == "station_moved"]
    assert "was moved during the recording" in warning.message


def estimate_of(positions: np.ndarray, rotations: np.ndarray) -> recording.PathEstimate:
    """Return an estimate of stations, known to 1 mm and 1 mrad."""
    count = len(positions) * STATION_PARAMETERS
    sigma = np.tile(np.r_[np.full(6, 1e-3), np.zeros(STATION_PARAMETERS - 6)], len(positions))
    common = SimpleNamespace(positions=positions, stations=(positions, rotations, ()))
    return cast(
        recording.PathEstimate,
        SimpleNamespace(
            common=common,
            common_covariance=np.diag(sigma**2) if count else np.zeros((0, 0)),
            is_left_out=np.zeros(len(positions), bool),
        ),
    )


def test_motions_of_the_whole_scene_are_no_moves() -> None:
    rng = np.random.default_rng(5)
    positions = rng.normal(size=(3, 3))
    rotations = Rotation.random(3, rng).as_matrix()
    turn, shift = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    first = estimate_of(positions, rotations)
    assert find_moves(first, estimate_of(positions @ turn.T + shift, turn @ rotations)) == []
    moved = positions.copy()
    moved[1] += [0.0, 0.03, 0.0]
    moves = find_moves(first, estimate_of(moved @ turn.T + shift, turn @ rotations))
    assert [move.stations for move in moves] == [(0, 1), (1, 2)]
    assert moved_stations(moves, 3) == (1,)
    assert moves[0].distance_m == pytest.approx(0.03)
    # Within the covariance, there is none.
    moved[1] = positions[1] + [0.0, 0.006, 0.0]
    assert find_moves(first, estimate_of(moved, rotations)) == []


def test_the_covariance_of_a_relative_pose_is_that_of_samples() -> None:
    rng = np.random.default_rng(6)
    positions, rotations = rng.normal(size=(2, 3)), Rotation.random(2, rng).as_matrix()
    _, relative, covariance = moves_module._relative_pose(estimate_of(positions, rotations), 0, 1)
    samples = []
    for change in rng.normal(0.0, 1e-3, (4000, 2, 6)):
        place = positions + change[:, :3]
        turned = Rotation.from_rotvec(change[:, 3:]).as_matrix() @ rotations
        step = turned[0].T @ (place[1] - place[0])
        turn = Rotation.from_matrix(turned[0].T @ turned[1] @ relative.T).as_rotvec()
        samples.append(np.r_[step, turn])
    expected = np.cov(np.array(samples).T)
    np.testing.assert_allclose(covariance, expected, atol=0.1 * np.abs(expected).max())


# ---- times of poses


@pytest.fixture(scope="module")
def short_flight() -> Flight:
    flight = make_flight(12, duration_s=7.0, motion="agile", geometry="given")
    time_ns = flight.sweeps.time_ns
    return replace(flight, sweeps=flight.sweeps.take(time_ns > time_ns.max() - 1e9 * SHORT_S))


@pytest.fixture(scope="module")
def usual(short_flight: Flight) -> Trajectory:
    """Trajectory of the short flight at the usual rate."""
    return solve_flight(short_flight)


@pytest.mark.parametrize(
    "rate_hz", [pytest.param(7.0, marks=pytest.mark.slow), 400.0,
                pytest.param(math.inf, marks=pytest.mark.slow)]
)  # fmt: skip
def test_poses_between_sweeps_are_as_good_as_their_covariance(
    short_flight: Flight, usual: Trajectory, rate_hz: float
) -> None:
    flight = short_flight
    options = SolveOptions(rate_hz=rate_hz)
    solution = solve(flight.sweeps, flight.scene, options, receivers=flight.receivers)
    (trajectory,) = solution.trajectories
    if math.isinf(rate_hz):
        assert np.isin(trajectory.time_ns, flight.sweeps.time_ns).all()
        assert len(trajectory) > 0.95 * len(np.unique(flight.sweeps.time_ns))
    else:
        number = trajectory.time_ns * (rate_hz * 1e-9)
        assert np.abs(number - np.rint(number)).max() < 1e-3
        assert len(trajectory) == pytest.approx(SHORT_S * rate_hz, abs=0.03 * SHORT_S * rate_hz + 1)
    assert np.median(errors(flight, trajectory)) < 1.2 * np.median(errors(flight, usual)) + 2e-4
    assert errors(flight, trajectory).max() < 1.5 * errors(flight, usual).max() + 1e-3
    truth, turns = flight.true_poses(trajectory.time_ns)
    to_truth = umeyama(trajectory.position, truth, with_scale=False).rotation
    turned = Rotation.from_matrix(to_truth) * Rotation.from_quat(trajectory.quaternion)
    off = (turned * turns.inv()).magnitude()
    assert np.median(off) < np.radians(1.5)
    sigma = np.interp(trajectory.time_ns, usual.time_ns, usual.sigma[:, 0])
    assert 0.8 < np.median(trajectory.sigma[:, 0] / sigma) < 1.2


@pytest.mark.slow
def test_parts_have_each_pose_of_a_grid_once(
    short_flight: Flight, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = SolveOptions(rate_hz=130.0)
    flight = short_flight
    whole = solve(flight.sweeps, flight.scene, options, receivers=flight.receivers)
    monkeypatch.setattr(recording, "MAX_SAMPLE_KNOTS", 150)
    monkeypatch.setattr(recording, "PART_S", 0.9)
    parts = solve(flight.sweeps, flight.scene, options, receivers=flight.receivers)
    times = parts.trajectories[0].time_ns
    assert len(times) > 0.9 * 130.0 * SHORT_S
    assert np.all(np.diff(times) > 0)
    assert np.array_equal(times, whole.trajectories[0].time_ns)


def test_a_rate_is_positive_and_not_of_the_published_method() -> None:
    with pytest.raises(InputError, match="not positive"):
        SolveOptions(rate_hz=0.0)
    with pytest.raises(InputError, match="published method"):
        SolveOptions(method="paper", rate_hz=10.0)
