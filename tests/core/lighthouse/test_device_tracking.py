"""Guards of device tracking, one function at a time, and the verification of stations."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from locatk.core.geometry import rotation_exp
from locatk.core.lighthouse.calibration import IDEAL_CALIBRATION, Calibration, predict_angles
from locatk.core.lighthouse.devices import tracking
from locatk.core.lighthouse.devices.device_sweeps import DeviceSweeps, make_windows
from locatk.core.lighthouse.devices.pose_fit import DeviceStates, PoseFit, SweepObservations
from locatk.core.lighthouse.devices.tracking import (
    FAILED,
    MAX_SEED_MARGIN,
    SOLVED,
    UNSOLVED,
    EpochStates,
    TrackingProblem,
    angle_noise,
    choose_hypothesis,
    estimate_initial_poses,
    find_conflicting_seed,
    from_behind_fraction,
    is_accepted,
    is_ambiguous,
    pose_covariance,
    propagate,
    resolve_conflicts,
    solve_seeds,
    track_device,
    track_devices,
    truncated_cost,
)
from locatk.core.lighthouse.devices.verification import (
    SEGMENT_COUNT,
    SEGMENT_NS,
    select_inner_poses,
    select_segments,
)
from locatk.core.lighthouse.noise import CALIBRATION_SIGMA_RAD
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.trajectory import Trajectory
from locatk.formats.benchmarks.lighthouse.flights import make_flight

Array = NDArray[np.float64]

PERIOD_NS = 20_000_000
FLAT = 0.05 * np.array([[1.0, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0], [0.3, 0.1, 0]])
COPLANAR = Receiver(FLAT)
TWO_STATIONS = (
    np.array([[-2.0, 0.0, 1.5], [2.0, 0.5, 1.5]]),
    rotation_exp(np.array([[0.0, 0.6, 0.0], [0.0, 0.0, np.pi]])) @ np.eye(3),
    (IDEAL_CALIBRATION, IDEAL_CALIBRATION),
)
ONE_STATION = (np.zeros((1, 3)), np.eye(3)[None], (IDEAL_CALIBRATION,))


def problem_at_rest(
    stations: Any,
    position: Any,
    rotation: Array,
    *,
    receiver: Receiver = COPLANAR,
    rotations: int = 30,
) -> TrackingProblem:
    """Return noise-free sweeps of a device at rest, in windows of two rotations."""
    sensor_position = np.asarray(position) + receiver.position_m @ rotation.T
    rows = []
    for k in range(rotations):
        for s in range(len(stations[2])):
            local = (sensor_position - stations[0][s]) @ stations[1][s]
            angles = predict_angles(local, stations[2][s])
            rows += [
                (k * PERIOD_NS + s * 3_000_000 + p * 6_000_000 + i * 1000, i, s, p, angles[i, p])
                for i, p in np.ndindex(angles.shape)
            ]
    time_ns, sensor, station, plane, angle = np.array(sorted(rows)).T
    sweeps = DeviceSweeps(
        time_ns.astype(np.int64),
        sensor.astype(np.int64),
        station.astype(np.int64),
        plane.astype(np.int64),
        angle,
    )
    windows = make_windows(sweeps, PERIOD_NS, PERIOD_NS)
    return TrackingProblem(sweeps, receiver, stations, windows, PERIOD_NS)


def states_of(
    rotation_vectors: Any, seed: list[int], margin: list[float], rate: Any = None
) -> EpochStates:
    """Return solved epochs with given orientations."""
    vectors = np.asarray(rotation_vectors, float)
    rates = np.zeros((len(vectors), 6)) if rate is None else np.asarray(rate, float)
    poses = DeviceStates(np.zeros((len(vectors), 3)), rotation_exp(vectors), rates)
    return EpochStates(poses, np.full(len(vectors), SOLVED), np.array(seed), margin)


JUMP = [[0.0, 0, 0], [0, 0, 0], [0, 0, 0.5], [0, 0, 0.5]]
TIME_NS = np.arange(4) * PERIOD_NS


@pytest.mark.parametrize(("margin", "expected"), [([100.0, 5.0], 1), ([5.0, 100.0], 0)])
def test_of_two_conflicting_seeds_the_one_with_less_margin_is_found(
    margin: list[float], expected: int
) -> None:
    states = states_of(JUMP, [0, 0, 1, 1], margin)
    assert find_conflicting_seed(TIME_NS, states, set()) == expected
    assert find_conflicting_seed(TIME_NS, states, {expected}) is None


def test_neighbours_within_the_plausible_rotation_do_not_conflict() -> None:
    for angle, is_conflict in ((0.33, False), (0.37, True)):
        vectors = np.array(JUMP) * angle / 0.5
        seed = find_conflicting_seed(TIME_NS, states_of(vectors, [0, 0, 1, 1], [9, 5]), set())
        assert (seed is not None) == is_conflict


def test_epochs_of_one_seed_do_not_conflict() -> None:
    assert find_conflicting_seed(TIME_NS, states_of(JUMP, [0, 0, 0, 0], [9.0]), set()) is None


def test_a_rotation_that_the_rates_predict_is_no_conflict() -> None:
    rate = np.zeros((4, 6))
    rate[1, 5] = 0.5 / (PERIOD_NS * 1e-9)
    states = states_of(JUMP, [0, 0, 1, 1], [9.0, 5.0], rate)
    assert find_conflicting_seed(TIME_NS, states, set()) is None


def test_poses_before_and_after_a_pause_do_not_conflict() -> None:
    states = states_of(JUMP, [0, 0, 1, 1], [9.0, 5.0])
    for pause_ns, is_conflict in ((220_000_000, True), (280_000_000, False)):
        time_ns = TIME_NS + np.where(np.arange(4) > 1, pause_ns - PERIOD_NS, 0)
        assert (find_conflicting_seed(time_ns, states, set()) is not None) == is_conflict


def corrupted(problem: TrackingProblem) -> tuple[EpochStates, NDArray[np.int64], Array]:
    """Solve a problem, then replace the second half by a wrong orientation of a weaker seed."""
    states = EpochStates.initial(np.ones(len(problem.windows), bool))
    estimate_initial_poses(problem, states)
    assert np.all(states.status == SOLVED)
    states.seed[:] = 0
    half = np.arange(len(problem.windows) // 2, len(problem.windows))
    correct = states.poses.rotation.copy()
    wrong = states.poses.take(half)
    wrong.rotation[:] = rotation_exp([0.0, 0.0, 0.6]) @ wrong.rotation
    states.poses.put(half, wrong)
    states.seed[half] = 1
    states.seed_margin[:] = [100.0, 1.0]
    return states, half, correct


def test_a_conflict_is_resolved_from_the_more_certain_seed() -> None:
    problem = problem_at_rest(TWO_STATIONS, [0.1, 0.0, 0.3], np.eye(3))
    states, half, correct = corrupted(problem)
    resolve_conflicts(problem, states)
    assert np.all(states.seed[half] == 0)
    assert states.poses.rotation == pytest.approx(correct, abs=1e-3)


def test_epochs_that_the_other_seed_does_not_explain_keep_their_poses(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem = problem_at_rest(TWO_STATIONS, [0.1, 0.0, 0.3], np.eye(3))
    states, half, _ = corrupted(problem)
    wrong = states.poses.rotation.copy()
    monkeypatch.setattr(tracking, "is_accepted", lambda o, r: np.zeros(len(r), bool))
    resolve_conflicts(problem, states)
    assert np.all(states.status == SOLVED)
    assert np.all(states.seed[half] == 1)
    assert np.array_equal(states.poses.rotation, wrong)


def test_the_margin_is_that_of_the_best_hypothesis_of_another_orientation() -> None:
    rotation = rotation_exp(np.array([[2.0, 0, 0], [0, 0, 0], [0.1, 0, 0], [0, 3.0, 0]]))
    cost = np.array([9.0, 3.0, 3.5, 7.0])
    assert choose_hypothesis(cost, rotation) == (1, 4.0)
    assert choose_hypothesis(cost[1:3], rotation[1:3]) == (0, MAX_SEED_MARGIN)


@pytest.mark.parametrize(
    ("inliers", "outliers", "accepted"),
    [(8, 0, True), (7, 0, False), (9, 6, True), (8, 6, False), (60, 40, True), (59, 41, False)],
)
def test_a_pose_needs_enough_inliers(inliers: int, outliers: int, accepted: bool) -> None:
    residual = np.r_[np.full(inliers, 9e-3), np.full(outliers, -1.1e-2), [np.nan] * 3][None]
    shape = residual.shape
    none = np.zeros(shape, np.int64)
    is_sweep = np.isfinite(residual)
    observations = SweepObservations(
        np.zeros((*shape, 3)), none, none, np.zeros(shape), np.zeros(shape), is_sweep
    )
    assert is_accepted(observations, residual).tolist() == [accepted]


def test_an_exact_pose_with_outliers_costs_less_than_one_that_misses_everything() -> None:
    is_valid = np.ones((2, 12), bool)
    exact = np.r_[np.zeros(8), np.full(4, 0.3)]
    compromise = np.full(12, 8e-3)
    costs = truncated_cost(np.stack([exact, compromise]), is_valid, 0.01)
    assert costs[0] < costs[1]
    assert truncated_cost(np.full((1, 12), np.nan), is_valid[:1], 0.01)[0] == pytest.approx(
        truncated_cost(np.full((1, 12), 5.0), is_valid[:1], 0.01)[0]
    )


def test_poses_are_propagated_over_failed_epochs_but_not_over_pauses() -> None:
    problem = problem_at_rest(TWO_STATIONS, [0.1, 0.0, 0.3], np.eye(3), rotations=40)
    m = len(problem.windows)
    for gap, is_reached in ((5, True), (20, False)):
        states = EpochStates.initial(np.ones(m, bool))
        estimate_initial_poses(problem, states)
        states.status[1:] = UNSOLVED
        states.status[2 : 2 + gap] = FAILED
        propagate(problem, states)
        assert states.status[1] == SOLVED
        assert np.all(states.status[2 : 2 + gap] == FAILED)
        assert np.all((states.status[2 + gap :] == SOLVED) == is_reached)


TILT = rotation_exp([0.0, np.radians(-90 + 45), 0.0])
"""Orientation of a coplanar device whose plane is inclined by 45 degrees to the light."""


def test_the_fraction_of_light_from_behind_depends_on_the_orientation() -> None:
    receiver = Receiver(FLAT, np.tile([0.0, 0.0, 1.0], (5, 1)))
    below = problem_at_rest(TWO_STATIONS, [0.1, 0.0, 0.3], np.eye(3), receiver=receiver)
    epochs = np.arange(3)
    position = np.tile([0.1, 0.0, 0.3], (3, 1))
    for vector, fraction in (([0.0, 0, 0], 0.0), ([np.pi, 0, 0], 1.0)):
        poses = DeviceStates.at_rest(position, np.tile(rotation_exp(vector), (3, 1, 1)))
        assert from_behind_fraction(below, epochs, poses).tolist() == [fraction] * 3
    without = problem_at_rest(TWO_STATIONS, [0.1, 0.0, 0.3], np.eye(3))
    assert from_behind_fraction(without, epochs, poses).tolist() == [0.0] * 3


def test_a_seed_that_is_lit_from_behind_ranks_last() -> None:
    """A coplanar device has two poses. The true one explains the angles best; with normals that
    face away from the station in it, the other one is chosen."""
    position = [2.5, 0.0, 0.0]
    seeds = {}
    for name, normal in (("none", None), ("front", [-1.0, 0, 0]), ("behind", [1.0, 0, 0])):
        in_device = None if normal is None else np.tile(np.array(normal) @ TILT, (5, 1))
        receiver = Receiver(FLAT, in_device)
        problem = problem_at_rest(ONE_STATION, position, TILT, receiver=receiver)
        states = EpochStates.initial(np.ones(len(problem.windows), bool))
        solve_seeds(problem, states, np.array([10]), minimal_sets=False)
        assert states.status[10] == SOLVED
        seeds[name] = states.poses.rotation[10]
        assert 0.0 < abs(states.seed_margin[0]) < MAX_SEED_MARGIN
    assert seeds["none"] == pytest.approx(TILT, abs=1e-3)
    assert seeds["front"] == pytest.approx(TILT, abs=1e-3)
    assert np.trace(seeds["behind"].T @ TILT) < 1 + 2 * np.cos(0.5)


def test_epochs_of_a_seed_with_little_margin_are_ambiguous() -> None:
    states = states_of(JUMP, [0, 1, 1, 2], [9.9, 10.1, MAX_SEED_MARGIN])
    assert is_ambiguous(states, np.arange(4)).tolist() == [True, False, False, False]


# ---- noise and covariance


def test_the_noise_that_repeats_from_rotation_to_rotation_is_separated() -> None:
    rng = np.random.default_rng(0)
    rotations, sensors = 400, 20
    time_ns, sensor = (
        v.ravel() for v in np.meshgrid(np.arange(rotations) * PERIOD_NS, np.arange(sensors))
    )
    order = np.argsort(time_ns, kind="stable")
    time_ns, sensor = time_ns[order], sensor[order]
    zero = np.zeros(len(time_ns), np.int64)
    lasting, passing = 4e-4 * rng.choice([-1.0, 1.0], sensors), 3e-4
    residual = lasting[sensor] + rng.normal(0, passing, len(sensor))
    sweeps = DeviceSweeps(time_ns, sensor, zero, zero, zero * 0.0)
    windows = np.arange(len(sensor)).reshape(-1, 4 * sensors)
    total, repeated = angle_noise(sweeps, residual, np.ones(len(sensor), bool), windows)
    inflation = np.sqrt(4 * sensors / (4 * sensors - 12))
    # The median absolute value of the sum of a constant of either sign and Gaussian noise.
    expected = 1.4826 * np.median(np.abs(residual)) * inflation
    assert total == pytest.approx(expected, rel=1e-9)
    assert repeated == pytest.approx(np.sqrt(total**2 - passing**2), rel=0.03)
    # Only sweeps of consecutive rotations are compared.
    sparse = DeviceSweeps(time_ns * 2, sensor, zero, zero, zero * 0.0)
    assert angle_noise(sparse, residual, np.ones(len(sensor), bool), windows) == (total, total)


def covariance_of(
    calibration: Calibration, lasting_sigma: float, acceleration: float = 0.0
) -> Array:
    """Return the covariance of three epochs with an information of 1e8, times 1e8.

    That of the turn about the first axis is zero in the last epoch.
    """
    problem = problem_at_rest(
        (np.zeros((1, 3)), np.eye(3)[None], (calibration,)), [2.0, 0, 0], np.eye(3), rotations=3
    )
    m = len(problem.windows)
    rate = np.zeros((m, 6))
    rate[:, 0] = acceleration * problem.windows.time_ns * 1e-9
    poses = DeviceStates(np.zeros((m, 3)), np.tile(np.eye(3), (m, 1, 1)), rate)
    information = np.tile(1e8 * np.eye(12), (m, 1, 1))
    information[-1, 9, 9] = information[-1, 3, 3] = 0.0
    fit = PoseFit(poses, np.zeros((m, 1)), information, np.zeros(m))
    return 1e8 * pose_covariance(problem, np.arange(m), fit, 2e-4, 3e-4, lasting_sigma)


def test_the_covariance_contains_lasting_noise_calibration_and_unmodelled_motion() -> None:
    factory = replace(IDEAL_CALIBRATION, source="factory")
    generic = replace(IDEAL_CALIBRATION, source="generic")
    variance = covariance_of(factory, 0.0)[1]
    assert variance == pytest.approx(np.eye(6) * 3e-4**2 / 2e-4**2)
    # A window contains two rotations, in both of which lasting errors are the same.
    with_lasting = covariance_of(factory, 2e-4)[1] - variance
    assert with_lasting == pytest.approx(np.eye(6) * 2e-4**2 / 2e-4**2)
    with_calibration = covariance_of(generic, 0.0)[1] - variance
    assert with_calibration == pytest.approx(np.eye(6) * 2 * CALIBRATION_SIGMA_RAD**2 / 2e-4**2)
    accelerated = covariance_of(factory, 0.0, acceleration=5.0)
    displacement = 0.5 * 5.0 * (PERIOD_NS * 1e-9) ** 2 / 3
    assert accelerated[1, 0, 0] - variance[0, 0] == pytest.approx(1e8 * displacement**2, rel=1e-6)
    assert accelerated[1, 1, 1] == pytest.approx(variance[1, 1])
    # A turn that no sweep determines is not known, and the rest of the pose is.
    undetermined = covariance_of(factory, 0.0)[-1] / 1e8
    assert undetermined[3, 3] > 10.0
    assert undetermined[0, 0] == pytest.approx(variance[0, 0] / 1e8)


@pytest.mark.parametrize(("scale", "is_determined"), [(1.0, True), (0.1, False)])
def test_poses_with_a_large_covariance_are_rejected(scale: float, is_determined: bool) -> None:
    receiver = Receiver(scale * FLAT)
    problem = problem_at_rest(ONE_STATION, [15.0, 0, 0], TILT, receiver=receiver)
    tracked = track_device("a", "floor", problem.sweeps, receiver, ONE_STATION, (1,))
    number = len(tracked.trajectory) + tracked.rejected.get("pose_not_determined", 0)
    assert number >= 29
    assert (len(tracked.trajectory) == number) == is_determined
    assert (len(tracked.trajectory) == 0) == (not is_determined)


def test_epochs_with_too_few_sweeps_within_the_final_gate_are_rejected(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem = problem_at_rest(TWO_STATIONS, [0.1, 0.0, 0.3], np.eye(3))

    def has_enough(sweeps: DeviceSweeps, window_sweeps: NDArray[np.int64]) -> NDArray[np.bool_]:
        calls.append(window_sweeps)
        return np.arange(len(window_sweeps)) >= (0 if len(calls) == 1 else 4)

    calls: list[NDArray[np.int64]] = []
    monkeypatch.setattr(tracking, "has_enough_sweeps", has_enough)
    tracked = track_device("a", "floor", problem.sweeps, problem.receiver, TWO_STATIONS, (1, 2))
    assert len(calls) == 2
    assert len(tracked.trajectory) == len(calls[1]) - 4
    assert tracked.rejected == {"moment_with_too_few_sweeps": 4}


@pytest.mark.slow
def test_initial_poses_of_an_inexact_scene_have_the_right_orientations() -> None:
    """With the noise of exact geometry, a quarter of the orientations is wrong."""
    flight = make_flight(10, motion="agile", duration_s=3.0, geometry="given")
    (track,) = track_devices(flight.sweeps, flight.receivers, flight.scene)
    _, rotation = flight.true_poses(track.trajectory.time_ns)
    error = (Rotation.from_quat(track.trajectory.quaternion) * rotation.inv()).magnitude()
    assert len(error) > 145
    assert np.mean(error > 0.5) < 0.05


# ---- verification


def test_segments_bound_the_number_of_verified_sweeps() -> None:
    time_ns = np.arange(0, 3600 * 10**9, 10**7)  # an hour at 100 Hz
    zero = np.zeros(len(time_ns), np.int32)
    sweeps = Sweeps(("device",), time_ns, zero, zero, zero + 1, zero, zero, zero.astype(float))
    selected, middle_ns = select_segments(sweeps)
    assert len(middle_ns) == SEGMENT_COUNT
    assert len(selected) == SEGMENT_COUNT * SEGMENT_NS // 10**7
    closest = np.abs(selected.time_ns[:, None] - middle_ns[None]).min(axis=1)
    assert closest.max() <= SEGMENT_NS // 2


def test_only_poses_in_the_middle_of_a_segment_are_verified() -> None:
    middle_ns = np.array([100, 200]) * 10**6
    offset_ns = np.array([-11, -9, 0, 9, 11]) * 10**6
    time_ns = (middle_ns[:, None] + offset_ns).ravel()
    n = len(time_ns)
    trajectory = Trajectory(
        "device", "floor", time_ns, np.zeros((n, 3)), np.tile([0.0, 0, 0, 1], (n, 1)),
        np.zeros((n, 6, 6)),
    )  # fmt: skip
    inner = select_inner_poses(trajectory, middle_ns)
    assert inner.time_ns.tolist() == [91000000, 100000000, 109000000,
                                      191000000, 200000000, 209000000]  # fmt: skip
