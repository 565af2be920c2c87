"""Independent flights, the scores of their poses, and the figures of devices in motion."""

from __future__ import annotations

import ast
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from locatk.core.lighthouse import solve
from locatk.core.lighthouse.calibration import Calibration, predict_angles
from locatk.core.lighthouse.receiver import DECK
from locatk.core.trajectory import Trajectory
from locatk.formats.benchmarks.lighthouse import flight_scores, flights, motion
from locatk.formats.benchmarks.lighthouse.flight_scores import score_flight, score_trajectory
from locatk.formats.benchmarks.lighthouse.flights import START_NS, Flight, make_flight

Array = NDArray[np.float64]

ALLOWED_IMPORTS = {
    "locatk.core.inertial": {"InertialSamples"},
    "locatk.core.lighthouse.calibration": {"Calibration"},
    "locatk.core.lighthouse.receiver": {"DECK", "Receiver"},
    "locatk.core.lighthouse.recording": {"Sweeps"},
    "locatk.core.lighthouse.scene": {"Marker", "MarkerVisit", "Scene", "Station"},
}
"""Classes of results, which the generator may use."""

QUICK = {"motion": "slow", "duration_s": 8.0}


# ---- the generator


def test_the_generator_shares_no_model_with_the_solver() -> None:
    tree = ast.parse(Path(flights.__file__).read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            assert not any(name.name.startswith("locatk") for name in node.names)
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("locatk"):
            names = {name.name for name in node.names}
            assert names <= ALLOWED_IMPORTS[node.module or ""], node.module


def test_its_light_planes_agree_with_those_of_the_solver() -> None:
    rng = np.random.default_rng(3)
    azimuth, elevation = rng.uniform(-1.0, 1.0, 500), rng.uniform(-0.7, 0.7, 500)
    points = np.stack(
        [np.cos(azimuth), np.sin(azimuth), np.tan(elevation)], axis=1
    ) * rng.uniform(0.5, 5, (500, 1))  # fmt: skip
    for unit in make_flight(5, **QUICK, stations=4).units:
        own = flights.libsurvive_angles(np.repeat(points[:, None], 2, axis=1), unit.factory)
        np.testing.assert_allclose(
            own, predict_angles(points, Calibration(unit.factory, "factory")), atol=1e-13
        )


def crossing_errors(flight: Flight, *, moved: bool = True) -> Array:
    """Return the measured angles minus those of the planes through the true photodiodes [rad].

    ``moved`` is False for the pose of each station before it was displaced.
    """
    sweeps = flight.sweeps
    position, rotation = flight.true_poses(sweeps.time_ns)
    diodes = DECK.position_m if flight.receivers else np.zeros((1, 3))
    position = position + rotation.apply(diodes[sweeps.sensor])
    errors = np.zeros(len(sweeps))
    for unit in flight.units:
        own = sweeps.channel == unit.channel
        time_s = (sweeps.time_ns[own] - START_NS) * 1e-9
        local = unit.to_local(position[own], time_s if moved else np.zeros(len(time_s)))
        plane = sweeps.sweep[own]
        angle = unit.angles(np.repeat(local[:, None], 2, axis=1))[np.arange(len(plane)), plane]
        period = flights.PERIOD_TICKS[unit.channel] / 8
        # Straight ahead is a third of a rotation for the first plane and two thirds for the second.
        measured = 2 * np.pi * (sweeps.count[own] / period - (1 + plane) / 3)
        errors[own] = measured - angle
    return errors


@pytest.mark.parametrize("kind", flights.MOTIONS)
@pytest.mark.parametrize("diodes", [1, 4])
def test_counts_are_those_of_planes_through_the_photodiodes_at_their_time(
    kind: str, diodes: int
) -> None:
    flight = make_flight(1, motion=kind, duration_s=8.0, diodes=diodes, deck_error=0.0)
    errors = crossing_errors(flight)
    noise = np.hypot(flights.ANGLE_NOISE_RAD, flights.COMMON_NOISE_RAD)
    rounding = 2 * np.pi / (959000 / 8) / np.sqrt(12)
    expected = np.sqrt(noise**2 + rounding**2 * (1 + (diodes > 1) / 16))
    assert errors.std() == pytest.approx(expected, rel=0.1)
    assert abs(errors.mean()) < 5e-6
    assert not flight.is_wrong.any()
    rate_hz = len(flight.sweeps) / 8.0 / diodes
    assert 100 < rate_hz < 201


def test_rounding_is_common_to_the_photodiodes_of_a_group(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flights, "ANGLE_NOISE_RAD", 0.0)
    monkeypatch.setattr(flights, "COMMON_NOISE_RAD", 0.0)
    flight = make_flight(1, **QUICK, deck_error=0.0)
    sweeps, errors = flight.sweeps, crossing_errors(flight)
    step = 2 * np.pi / (959000 / 8)
    # At rest the rounding of a photodiode is always the same.
    is_moving = np.abs((sweeps.time_ns - START_NS) * 1e-9 - 4.0) < 2.0
    uniform = step / np.sqrt(12) * np.sqrt(1 + 1 / 16)
    assert errors[is_moving].std() == pytest.approx(uniform, rel=0.05)
    is_pair = (np.diff(sweeps.time_ns) < 300_000) & (np.diff(sweeps.channel) == 0)
    assert is_pair.sum() > 1000
    # Within a group only the rounding of the 24 MHz time stamps differs, a quarter of a step.
    assert np.abs(np.diff(errors)[is_pair]).max() < 0.26 * step
    assert np.mean(sweeps.count == np.rint(sweeps.count)) < 0.6


@pytest.mark.slow
def test_equal_seeds_give_equal_flights_and_other_motions_leave_the_stations() -> None:
    first, second = make_flight(2, **QUICK), make_flight(2, **QUICK)
    np.testing.assert_array_equal(first.sweeps.count, second.sweeps.count)
    np.testing.assert_array_equal(first.imu.acceleration, second.imu.acceleration)
    other = make_flight(2, motion="agile", duration_s=8.0)
    np.testing.assert_array_equal(first.units[0].parameters, other.units[0].parameters)
    np.testing.assert_array_equal(
        first.scene.stations[1].position, other.scene.stations[1].position
    )
    assert not np.array_equal(first.units[0].factory, make_flight(3, **QUICK).units[0].factory)


def test_wrong_sweeps_have_the_requested_number_and_are_marked() -> None:
    flight = make_flight(4, **QUICK, wrong=0.1, deck_error=0.0)
    errors = np.abs(crossing_errors(flight))
    assert flight.is_wrong.mean() == pytest.approx(0.1, abs=0.005)
    assert errors[~flight.is_wrong].max() < 4e-4
    assert np.mean(errors[flight.is_wrong] > 1.5e-3) > 0.95


@pytest.mark.slow
def test_reflections_come_in_runs_and_are_seen_behind_walls() -> None:
    flight = make_flight(4, motion="slow", duration_s=30.0, reflections=0.15, deck_error=0.0)
    errors = np.abs(crossing_errors(flight))
    assert 0.06 < flight.is_wrong.mean() < 0.2
    assert errors[~flight.is_wrong].max() < 4e-4
    assert np.median(errors[flight.is_wrong]) > 0.1
    own = (flight.sweeps.channel == 1) & (flight.sweeps.sweep == 0)
    runs = np.count_nonzero(np.diff(flight.is_wrong[own].astype(int)) == 1)
    assert runs < flight.is_wrong[own].sum() / 10


def test_a_moved_station_keeps_its_light_but_not_its_pose() -> None:
    flight = make_flight(6, **QUICK, is_station_moved=True, deck_error=0.0)
    unit = flight.units[-1]
    assert np.abs(crossing_errors(flight)).max() < 4e-4
    before = np.abs(crossing_errors(flight, moved=False))
    is_moved = (flight.sweeps.time_ns - START_NS) * 1e-9 > unit.moved_s
    is_moved &= flight.sweeps.channel == unit.channel
    assert before[~is_moved].max() < 4e-4
    assert np.median(before[is_moved]) > 2e-3


@pytest.mark.slow
def test_hidden_stations_and_the_back_of_the_deck_receive_nothing() -> None:
    visible = make_flight(7, **QUICK)
    hidden = make_flight(7, motion="slow", duration_s=40.0, occlusion=0.3)
    assert len(hidden.sweeps) / 40 < 0.85 * len(visible.sweeps) / 8
    carried = make_flight(8, motion="hand", duration_s=30.0)
    position, rotation = carried.true_poses(carried.sweeps.time_ns)
    station = np.stack([carried.units[c - 1].position for c in carried.sweeps.channel])
    ray = station - position
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    assert np.sum(ray * rotation.apply([0.0, 0.0, 1.0]), axis=1).min() > 0.03


@pytest.mark.slow
def test_given_geometry_and_factory_data_differ_from_the_truth() -> None:
    offsets, tilts = [], []
    for seed in range(8):
        flight = make_flight(seed, motion="hover", duration_s=5.0)
        for unit, station in zip(flight.units, flight.scene.stations, strict=True):
            offsets.append(np.linalg.norm(station.position - unit.position))
            tilts.extend((unit.parameters - unit.factory)[:, flights.TILT])
            np.testing.assert_allclose(station.calibration.sweeps, unit.factory, atol=2e-3)
    assert 0.01 < np.mean(offsets) < 0.025
    assert 2e-4 < np.std(tilts) < 8e-4
    unknown = make_flight(0, **QUICK, geometry="unknown").scene
    assert (unknown.stations, len(unknown.calibrations)) == ((), 2)
    assert not make_flight(0, **QUICK, geometry="unknown", calibration=False).scene.calibrations


def test_the_device_rests_on_its_markers_before_the_flight() -> None:
    flight = make_flight(5, motion="slow", duration_s=22.0, geometry="unknown", has_markers=True)
    assert len(flight.scene.markers) == 4
    errors = []
    for marker in flight.scene.markers:
        [visit] = marker.visits
        assert visit.start_ns is not None
        assert visit.end_ns is not None
        inside_ns = np.arange(visit.start_ns + 200_000_000, visit.end_ns - 200_000_000, 10**8)
        position, _ = flight.true_poses(inside_ns)
        assert np.ptp(position, axis=0).max() < 1e-6
        errors.append(marker.position - position[0])
    assert 5e-4 < np.std(errors) < 5e-3
    start_s, _ = flight.motion.flying_s
    assert visit.end_ns == START_NS + round(start_s * 1e9)
    time_ns = START_NS + np.arange(0, 22 * 10**9, 10**7)
    position, _ = flight.true_poses(time_ns)
    assert np.linalg.norm(np.diff(position, axis=0), axis=1).max() < 0.03
    assert position[:, 2].max() > 0.4
    assert flight.sweeps.time_ns[0] < START_NS + 10**8


@pytest.mark.slow
def test_the_imu_measures_the_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("GYRO_BIAS_RADPS", "GYRO_NOISE_RADPS", "ACCELERATION_BIAS_MPS2",
                 "ACCELERATION_NOISE_MPS2", "VIBRATION_MPS2", "IMU_MOUNTING_RAD"):  # fmt: skip
        monkeypatch.setattr(flights, name, 0.0)
    monkeypatch.setattr(flights, "IMU_DELAY_S", (0.0, 0.0))
    monkeypatch.setattr(flights, "IMU_HZ", 1000.0)
    flight = make_flight(9, **QUICK)
    imu = flight.imu
    position, truth = flight.true_poses(imu.time_ns)
    np.testing.assert_allclose(np.linalg.norm(imu.acceleration[:1000], axis=1), 9.81, atol=1e-3)
    assert imu.acceleration[0, 2] > 9.8
    # Dead reckoning with the mean of neighbouring samples follows the truth.
    step_s = 1e-3
    rate = (imu.angular_rate[1:] + imu.angular_rate[:-1]) / 2
    attitude = truth[0]
    velocity, place = np.zeros(3), position[0]
    for k, turn in enumerate(Rotation.from_rotvec(rate * step_s)):
        force = attitude.apply(imu.acceleration[k]) - [0.0, 0.0, 9.81]
        place = place + velocity * step_s + 0.5 * force * step_s**2
        attitude = attitude * turn
        velocity = velocity + 0.5 * step_s * (
            force + attitude.apply(imu.acceleration[k + 1]) - [0.0, 0.0, 9.81]
        )
    assert (attitude * truth[-1].inv()).magnitude() < 1e-3
    assert np.linalg.norm(place - position[-1]) < 0.01


@pytest.mark.slow
def test_exact_knowledge_is_solved_to_the_noise() -> None:
    flight = make_flight(3, **QUICK, geometry="exact", deviation=0.0, diodes=1)
    solution = solve(flight.sweeps, flight.scene)
    score = score_flight(flight, solution.trajectories[0], solution.artifact)
    # 70 microradians at 2.5 m are 0.18 mm. The solver does not know that the factory data are exact
    # here, so that the shape of the path is determined better than its place.
    assert np.median(score.raw_m) < 3e-3
    assert np.median(score.similarity_m) < 0.5e-3


# ---- scores


@pytest.fixture(scope="module")
def flight() -> Flight:
    return make_flight(11, motion="slow", duration_s=20.0)


def estimate(
    flight: Flight, sigma_m: float = 0.002, reported_m: float | None = None, seed: int = 0
) -> Trajectory:
    """Return the truth every 20 ms with noise, from take-off to landing."""
    start_s, end_s = flight.motion.flying_s
    time_ns = START_NS + np.round(np.arange(start_s, end_s, 0.02) * 1e9 + 5e6).astype(np.int64)
    position, rotation = flight.true_poses(time_ns)
    noise, turns = np.random.default_rng(seed).normal(0, sigma_m, (2, *position.shape))
    rotation = Rotation.from_rotvec(turns) * rotation
    covariance = np.tile(np.eye(6), (len(time_ns), 1, 1)) * (reported_m or sigma_m) ** 2
    return Trajectory("flight", "floor", time_ns, position + noise, rotation.as_quat(), covariance)


def test_honest_covariances_have_a_nees_of_one(flight: Flight) -> None:
    score = score_flight(flight, estimate(flight), flight.scene)
    figures = flight_scores.summarize(score)
    for name in ("raw NEES", "raw NEES median", "aligned NEES", "aligned NEES median"):
        assert figures[name] == pytest.approx(1.0, abs=0.15), name
    assert figures["coverage"] == 1.0
    assert (figures["beyond"], figures["far"], figures["invalid"]) == (0.0, 0.0, 0.0)
    assert figures["rigid median"] == pytest.approx(2 * 1.538, rel=0.1)
    # Metres and radians have the same standard deviation.
    assert figures["orientation"] == pytest.approx(np.degrees(0.002 * 1.538), rel=0.1)
    assert figures["turn NEES"] == pytest.approx(1.0, abs=0.15)
    optimistic = score_flight(flight, estimate(flight, reported_m=0.0002), flight.scene)
    assert flight_scores.summarize(optimistic)["aligned NEES"] == pytest.approx(100, rel=0.15)
    assert flight_scores.exceeds_sigmas(optimistic.aligned_nees).mean() > 0.8


def test_a_rigid_motion_and_a_scale_are_aligned(flight: Flight) -> None:
    exact = estimate(flight, 1e-6)
    rotation = Rotation.from_rotvec([0.3, -0.2, 1.0])
    moved = replace(
        exact,
        position=rotation.apply(1.02 * exact.position) + [1.0, 2.0, 3.0],
        quaternion=(rotation * Rotation.from_quat(exact.quaternion)).as_quat(),
    )
    score = score_flight(flight, moved, with_scale=True)
    assert score.raw_m.min() > 1.0
    assert 1e-3 < np.median(score.rigid_m) < 0.05
    assert score.similarity_m.max() < 1e-5
    assert score.turn_rad.max() < 2e-5
    assert np.mean(score.turn_nees) == pytest.approx(1.0, rel=0.1)
    # Errors and variances have the scale of the trajectory, in which the noise is larger.
    assert np.mean(score.aligned_nees) == pytest.approx(1.02**2, rel=0.05)


def test_the_frame_of_the_first_station_is_no_alignment(flight: Flight) -> None:
    exact = estimate(flight)
    unit = flight.units[0]
    inverse = unit.rotation.T
    stations = tuple(
        replace(
            station,
            position=inverse @ (true.position - unit.position),
            rotation=inverse @ true.rotation,
        )
        for station, true in zip(flight.scene.stations, flight.units, strict=True)
    )
    local = replace(exact, position=(exact.position - unit.position) @ unit.rotation)
    scene = replace(flight.scene, stations=stations)
    score = score_flight(flight, local, scene)
    assert np.mean(score.station_nees) == pytest.approx(1.0, abs=0.15)
    # An error of the frame that an alignment removes remains.
    tilted = replace(local, position=Rotation.from_rotvec([0, 0, 0.01]).apply(local.position))
    score = score_flight(flight, tilted, scene)
    assert np.mean(score.station_nees) > 5
    assert np.mean(score.aligned_nees) < 1.2


@pytest.mark.slow
def test_the_projection_removes_only_what_the_alignment_absorbs(flight: Flight) -> None:
    exact = estimate(flight, 1e-9)
    truth = exact.position
    rng = np.random.default_rng(1)
    # Errors of 20 mm of the frame, and 5 mm along a mode that no rigid motion describes.
    shared = np.zeros((len(truth), 3, 4))
    shared[:, range(3), range(3)] = 0.02
    shared[:, 0, 3] = 0.005 * np.sin(3 * truth[:, 1])
    covariance = np.tile(np.eye(6) * 0.001**2, (len(truth), 1, 1))
    covariance[:, :3, :3] += shared @ shared.mT
    aligned, projected = [], []
    for _ in range(60):
        noise = rng.normal(0, 0.001, truth.shape) + shared @ rng.normal(size=4)
        noisy = replace(exact, position=truth + noise, covariance=covariance)
        score = score_flight(flight, noisy, shared=shared)
        aligned.append(np.mean(score.aligned_nees))
        projected.append(np.mean(score.projected_nees))
    assert np.mean(aligned) < 0.1
    assert np.mean(projected) == pytest.approx(1.0, abs=0.25)


def test_covariances_that_are_none_are_counted(flight: Flight) -> None:
    exact = estimate(flight)
    covariance = exact.covariance.copy()
    covariance[0, 0, 0] = -1e-6
    covariance[1, 1, 1] = np.nan
    covariance[2, 0, 1] = covariance[2, 1, 0] = 1.5 * covariance[2, 0, 0]
    covariance[3, 4, 4] = np.nan
    covariance[4, 3:, :] = covariance[4, :, 3:] = np.nan  # a single photodiode
    covariance[5, 2, :] = covariance[5, :, 2] = 0.0  # a known height
    covariance[6] = np.nan
    score = score_flight(flight, replace(exact, covariance=covariance))
    assert score.is_invalid[:8].tolist() == [True, True, True, True, False, False, True, False]
    assert np.isnan(score.raw_nees[6]).all()
    assert np.isnan(score.raw_nees[5]).tolist() == [False, False, True]


def test_coverage_counts_intervals_without_a_pose(flight: Flight) -> None:
    exact = estimate(flight)
    score = score_flight(flight, exact.select(np.arange(len(exact)) % 4 != 0))
    assert score.is_covered.mean() == pytest.approx(0.75, abs=0.01)
    start_ns = int(exact.time_ns[0])
    twice = score_trajectory(exact, flight.true_poses, (start_ns, start_ns + 40_000_000_000))
    assert twice.is_covered.mean() == pytest.approx(0.4, abs=0.01)


# ---- figures


def test_figures_count_refused_flights_and_judge_both_sides_of_the_nees(flight: Flight) -> None:
    case = motion.Case("a case", "made up", (), "raw", is_precise=True)
    score = score_flight(flight, estimate(flight, reported_m=0.02))
    rows = {row.name: row for row in motion.case_figures(case, [score], ["no light"])}
    assert rows["motion, a case: coverage"].value == pytest.approx(50.0)
    assert rows["motion, a case: coverage"].met is False
    assert "no light" in rows["motion, a case: coverage"].how
    assert rows["motion, a case: NEES, factor from 1"].value == pytest.approx(100.0, rel=0.15)
    assert rows["motion, a case: NEES, factor from 1"].met is False
    assert rows["motion, a case: median"].value == pytest.approx(3.08, rel=0.1)
    assert rows["motion, a case: median"].met
    assert rows["motion, a case: p95"].met
    refused = motion.case_figures(case, [], ["no light"])
    assert [row.value for row in refused] == [None] * len(rows)
    assert all("no light" in row.how for row in refused)


def test_far_poses_and_excluded_ones_are_counted(flight: Flight) -> None:
    exact = estimate(flight)
    position = exact.position.copy()
    position[:8] += [0.0, 0.0, 0.2]
    case = motion.Case("a case", "made up", (), "raw")
    score = score_flight(flight, replace(exact, position=position))
    rows = {row.name: row for row in motion.case_figures(case, [score])}
    percent = 100 * 8 / len(exact)
    assert rows["motion, a case: over 50 mm"].value == pytest.approx(percent)
    assert rows["motion, a case: beyond 5 sigma"].value == pytest.approx(percent)
    assert rows["motion, a case: over 50 mm"].met is False
    assert rows["motion, a case: beyond 5 sigma"].met is False
    # Errors of the frame count only without an alignment.
    shifted = score_flight(flight, replace(exact, position=exact.position + 0.1))
    for alignment, value in (("no", 100.0), ("rigid", 0.0)):
        rows_of = motion.case_figures(replace(case, alignment=alignment), [shifted])
        assert [r.value for r in rows_of if "over 50" in r.name or "sigma" in r.name] == [value] * 2
