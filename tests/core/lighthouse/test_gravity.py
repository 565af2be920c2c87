"""Gravity: directions of accelerometers, their mean, and levelled scenes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from locatk.core.geometry import Similarity, quaternion_from_matrix, rotation_exp, umeyama
from locatk.core.inertial import InertialSamples
from locatk.core.lighthouse.results import LighthouseFacts
from locatk.core.lighthouse.scene import Marker, MarkerVisit, Scene, Station
from locatk.core.lighthouse.scene.estimation import estimate_stations
from locatk.core.lighthouse.scene.gravity import (
    STATION_UP_SIGMA_RAD,
    UpMeasurement,
    angles_between,
    estimate_up,
    up_from_acceleration,
)
from locatk.core.lighthouse.scene.levelling import (
    inertial_ups,
    level_solution,
    marker_frame_sigmas,
)
from locatk.core.lighthouse.scene.reframing import transform_trajectory
from locatk.core.lighthouse.scene.standstills import Standstill
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory

from .rooms import IDEAL, looking_at, measured_up, room, rotor_angles

UP = np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize("pitch_deg", [-30.0, 0.0, 25.0])
@pytest.mark.parametrize("roll_deg", [-20.0, 0.0, 40.0])
def test_the_accelerometer_of_a_tilted_station(pitch_deg: float, roll_deg: float) -> None:
    pitch, roll = np.radians([pitch_deg, roll_deg])
    # Axes of the station in the room: forward, left, up.
    station = rotation_exp([0, 0, 0.7]) @ rotation_exp([0, pitch, 0]) @ rotation_exp([roll, 0, 0])
    # The accelerometer has x right, y up, z back; at rest it measures 1 g upwards.
    axes = np.stack([-station[:, 1], station[:, 2], -station[:, 0]], axis=1)
    sent = axes.T @ UP
    sent = np.rint(127 * sent / np.max(np.abs(sent))).astype(int)
    up = up_from_acceleration(sent.tolist())
    assert up is not None
    assert np.degrees(angles_between(station @ up, UP)) < 0.6  # A step is 0.45 degrees.


def test_no_direction_without_acceleration() -> None:
    assert up_from_acceleration((0, 0, 0)) is None


@pytest.mark.parametrize("count", [1, 2, 4])
def test_the_mean_of_stations_is_as_certain_as_it_says(count: int) -> None:
    rng = np.random.default_rng(count)
    squares = []
    for _ in range(400):
        stations = room(rng, count).stations
        measured = [
            UpMeasurement("", s.rotation @ measured_up(rng, s, STATION_UP_SIGMA_RAD))
            for s in stations
        ]
        estimate = estimate_up(measured)
        assert estimate is not None
        if estimate.direction is not None and not estimate.contradicting:
            squares.append((angles_between(estimate.direction, UP) / estimate.sigma_rad) ** 2)
    assert len(squares) > 390
    # Mean of chi-square with two degrees of freedom; its standard error is 0.1.
    assert 1.6 < np.mean(squares) < 2.4


def test_a_tilted_station_is_named_and_not_used() -> None:
    tilted = rotation_exp([0.3, 0.0, 0.0])[:, 2]
    up = estimate_up([UpMeasurement(n, d) for n, d in (("a", UP), ("b", tilted), ("c", UP))])
    assert up is not None
    assert (up.used, up.contradicting) == (("a", "c"), ("b",))
    assert up.direction == pytest.approx(UP)
    up = estimate_up([UpMeasurement("a", UP), UpMeasurement("b", tilted)])
    assert up is not None
    assert up.direction is None
    assert set(up.contradicting) == {"a", "b"}
    assert estimate_up([]) is None


def test_a_certain_measurement_counts_more() -> None:
    other = rotation_exp([0.05, 0.0, 0.0])[:, 2]
    up = estimate_up([UpMeasurement("station", other), UpMeasurement("imu", UP, 0.01)])
    assert up is not None
    assert up.direction is not None
    expected = 0.05 * (0.01 / STATION_UP_SIGMA_RAD) ** 2 / (1 + (0.01 / STATION_UP_SIGMA_RAD) ** 2)
    assert angles_between(up.direction, UP) == pytest.approx(expected, rel=0.01)


# ---- mirrored arrangements of two stations over a floor


@pytest.mark.parametrize("seed", [41, 60])
def test_gravity_decides_between_mirrored_arrangements(seed: int) -> None:
    """Of 98 random rooms with a narrow field 19 are ambiguous, in these two with the wrong roll."""
    rng = np.random.default_rng(seed)
    positions = [
        np.array([2.2 * np.cos(azimuth), 2.2 * np.sin(azimuth), rng.uniform(1.5, 2.5)])
        for azimuth in rng.uniform(0, 2 * np.pi, 2)
    ]
    rolls = rng.normal(0, 0.5, 2)
    stations = [
        Station(k, position, looking_at(position, rng.normal(0, 0.3, 3) * [1, 1, 0], roll), IDEAL)
        for k, (position, roll) in enumerate(zip(positions, rolls, strict=True), 1)
    ]
    points = np.c_[rng.uniform(-0.4, 0.4, (60, 2)), np.zeros(60)]
    angles = np.stack([rotor_angles(s, points) for s in stations], axis=1)
    angles += rng.normal(0, 3e-4, angles.shape)
    truth = stations[0].rotation.T @ stations[1].rotation
    ups = np.stack([measured_up(rng, s, STATION_UP_SIGMA_RAD) for s in stations])

    def relative_error_deg(directions: np.ndarray | None) -> float:
        estimate = estimate_stations(
            angles, (IDEAL, IDEAL), sigma=1e-3, planar=True, ups=directions, seed=seed
        )
        decided_by = None if directions is None else "gravity"
        assert estimate.facts.candidate_decided_by == decided_by
        first, second = estimate.adjustment.state.rotations
        return float(np.degrees(np.arccos((np.trace(first.T @ second @ truth.T) - 1) / 2)))

    assert relative_error_deg(None) > 60.0
    assert relative_error_deg(ups) < 2.0
    one = ups.copy()
    one[1] = np.nan
    assert relative_error_deg(one) < 2.0


# ---- level frames


def solution_in_station_frame(rng: np.random.Generator, scene: Scene) -> tuple[Solution, Scene]:
    """Solution of a room in the frame of its first station, and the directions stations sent."""
    first = scene.stations[0]
    to = Similarity(1.0, first.rotation.T, -first.rotation.T @ first.position)
    solved = replace(
        scene.transformed(to), frame="station-1", frame_source="station", scale="device"
    )
    position = to.apply(rng.uniform(-1, 1, (5, 3)))
    time_ns = np.arange(5, dtype=np.int64)
    point = Trajectory.from_positions(
        "point", "station-1", time_ns, position, np.tile(1e-6 * np.diag([1.0, 4, 9]), (5, 1, 1))
    )
    body = replace(point, device="body", covariance=np.tile(1e-6 * np.eye(6), (5, 1, 1)))
    prior = Scene(
        ups={s.channel: measured_up(rng, s, STATION_UP_SIGMA_RAD) for s in scene.stations}
    )
    return (
        Solution("lighthouse", "bundle", (point, body), artifact=solved, facts=LighthouseFacts()),
        prior,
    )


def test_a_scene_in_a_station_frame_is_levelled() -> None:
    squares = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        truth = room(rng, 3, roll_rad=0.4)
        solution, prior = solution_in_station_frame(rng, truth)
        levelled = level_solution(solution, prior)
        scene = levelled.artifact
        if scene.frame_source != "gravity":
            continue  # Three sigma happen.
        to_truth = truth.stations[0].rotation @ scene.stations[0].rotation.T
        error_rad = float(angles_between(to_truth[:, 2], UP))
        squares.append((error_rad / scene.level_sigma_rad) ** 2)
        assert scene.stations[0].position == pytest.approx(np.zeros(3), abs=1e-9)
        assert scene.stations[0].rotation[1, 0] == pytest.approx(0.0, abs=1e-9)
        assert scene.stations[0].rotation[0, 0] > 0
        assert scene.is_level
        assert not scene.is_on_floor
        # The devices move with the stations.
        for before, after in zip(solution.trajectories, levelled.trajectories, strict=True):
            own = solution.artifact.stations[1]
            moved = scene.stations[1]
            seen = (before.position - own.position) @ own.rotation
            assert (after.position - moved.position) @ moved.rotation == pytest.approx(seen)
            assert after.frame == scene.frame == "station-1-level"
        assert "level_by_gravity" in [w.code for w in levelled.warnings]
        assert levelled.facts.frame.level_sigma_rad == scene.level_sigma_rad
    assert len(squares) > 55
    assert 1.4 < np.mean(squares) < 2.6  # chi-square with two degrees of freedom


def test_a_given_scene_is_not_moved() -> None:
    rng = np.random.default_rng(5)
    solution, prior = solution_in_station_frame(rng, room(rng, 2))
    given = replace(prior, stations=solution.artifact.stations)
    assert level_solution(solution, given).artifact.stations[1].position == pytest.approx(
        solution.artifact.stations[1].position
    )


def test_without_directions_nothing_changes() -> None:
    rng = np.random.default_rng(5)
    solution, _ = solution_in_station_frame(rng, room(rng, 2))
    levelled = level_solution(solution, Scene())
    assert levelled.artifact.frame_source == "station"
    assert levelled.warnings == ()


def codes(rng: np.random.Generator, scene: Scene, ups: Scene) -> list[str]:
    prior = Scene(ups={s.channel: measured_up(rng, s, 0.01) for s in ups.stations})
    solution = Solution("lighthouse", "bundle", (), artifact=scene, facts=LighthouseFacts())
    return [warning.code for warning in level_solution(solution, prior).warnings]


def test_markers_with_z_down_are_reported() -> None:
    rng = np.random.default_rng(8)
    scene = room(rng, 2)
    assert codes(rng, scene, scene) == []
    # x and y of the markers clockwise: the scene is turned over.
    over = scene.transformed(Similarity(1.0, np.diag([1.0, -1.0, -1.0]), np.zeros(3)))
    assert codes(rng, over, scene) == ["frame_not_level"]
    tilted = scene.transformed(Similarity(1.0, rotation_exp([0.15, 0, 0]), np.zeros(3)))
    assert codes(rng, tilted, scene) == ["frame_not_level"]


def test_a_station_that_was_tilted_is_reported() -> None:
    rng = np.random.default_rng(9)
    scene = room(rng, 4)
    first = scene.stations[2]
    moved = replace(first, rotation=rotation_exp([0, 0.4, 0]) @ first.rotation)
    wrong = replace(scene, stations=(*scene.stations[:2], moved, scene.stations[3]))
    assert codes(rng, wrong, scene) == ["up_contradicts_others"]


def test_a_station_that_looks_down_has_a_heading() -> None:
    down = rotation_exp([0, np.pi / 2 - 0.01, 0])
    scene = Scene((Station(1, np.zeros(3), down, IDEAL),), frame_source="station")
    to = Similarity(1.0, down.T, np.zeros(3))
    solved = replace(scene.transformed(to), frame_source="station")
    prior = Scene(ups={1: down.T @ UP})
    solution = Solution("lighthouse", "bundle", (), artifact=solved)
    levelled = level_solution(solution, prior).artifact.stations[0]
    # Its top points along x.
    assert levelled.rotation[:, 2] == pytest.approx([1.0, 0.0, 0.0], abs=0.02)


def test_points_keep_their_covariance_without_orientation() -> None:
    rng = np.random.default_rng(11)
    to = Similarity(2.0, rotation_exp([0.4, 0.2, 1.0]), rng.normal(size=3))
    own = np.diag([1.0, 4.0, 9.0])
    track = replace(
        Trajectory.from_positions("a", "f", np.arange(2), np.ones((2, 3)), np.tile(own, (2, 1, 1))),
        probability=np.array([0.5, 0.9]),
    )
    moved = transform_trajectory(track, to, "g")
    assert moved.covariance[0, :3, :3] == pytest.approx(4 * to.rotation @ own @ to.rotation.T)
    assert np.all(np.isnan(moved.covariance[0, 3:, :]))
    assert moved.quaternion.tolist() == track.quaternion.tolist()
    assert moved.probability is not None


def test_the_frame_of_markers_is_as_certain_as_it_says() -> None:
    """Against frames fitted to markers with random errors."""
    rng = np.random.default_rng(12)
    points = np.array([[1.0, 2, 0], [3, 2, 0], [3, 4, 0.5], [1, 4, 0]])
    markers = [Marker(str(k), p, (MarkerVisit("r", 0, 1),)) for k, p in enumerate(points)]
    sigmas = marker_frame_sigmas(markers, 0.005)
    levels, headings, origins, scales = [], [], [], []
    for _ in range(500):
        to = umeyama(points, points + rng.normal(0, 0.005, points.shape))
        levels.append(to.rotation[:2, 2])
        headings.append(to.rotation[1, 0])
        origins.append(to.apply([0.0, 0.0, 0.0]))
        scales.append(to.scale - 1)
    worst = [np.sqrt(np.linalg.eigvalsh(np.cov(np.array(v).T))[-1]) for v in (levels, origins)]
    assert sigmas[0] == pytest.approx(worst[0], rel=0.15)
    assert sigmas[1] == pytest.approx(np.std(headings), rel=0.15)
    # The error of the scale also moves a distant origin.
    assert sigmas[2] == pytest.approx(worst[1], rel=0.3)
    assert sigmas[3] == pytest.approx(np.std(scales), rel=0.15)
    assert marker_frame_sigmas(markers[:2], None) == (None, None, None, None)


# ---- devices with an IMU


def test_an_imu_at_rest_levels_the_frame() -> None:
    rng = np.random.default_rng(20)
    truth = room(rng, 2, roll_rad=0.4)
    solution, _ = solution_in_station_frame(rng, truth)
    to_room = truth.stations[0].rotation
    second = 10**9
    # The device lies on its side, and rests in the middle of the recording.
    in_room = rotation_exp([1.2, 0.3, 0.5])
    time_ns = np.arange(0, 6 * second, second // 10)
    count = len(time_ns)
    track = Trajectory(
        "cf",
        "station-1",
        time_ns,
        np.zeros((count, 3)),
        np.tile(quaternion_from_matrix(to_room.T @ in_room), (count, 1)),
        np.tile(1e-6 * np.eye(6), (count, 1, 1)),
    )
    is_resting = (time_ns >= 2 * second) & (time_ns <= 4 * second)
    force = np.where(is_resting[:, None], 9.7 * in_room.T @ UP, [5.0, 5.0, 5.0])
    force[25] = np.nan
    imu = InertialSamples("cf", time_ns, force, np.zeros((count, 3)))
    rest = Standstill("cf", 2 * second, 4 * second)
    (up,) = inertial_ups([imu], [track], [rest])
    assert up.source == "the IMU of cf"
    assert up.direction == pytest.approx(to_room.T @ UP)
    levelled = level_solution(replace(solution, trajectories=(track,)), Scene(), [up])
    first = levelled.artifact.stations[0]
    assert first.rotation[2] == pytest.approx(truth.stations[0].rotation[2])
    assert np.degrees(levelled.artifact.level_sigma_rad) == pytest.approx(1.0)
    # Neither a moving device, nor one without orientation, nor another device says anything.
    moving = Standstill("cf", 0, second)
    assert inertial_ups([imu], [track], [moving]) == []
    point = Trajectory.from_positions("cf", "f", time_ns, np.zeros((count, 3)))
    assert inertial_ups([imu], [point], [rest]) == []
    assert inertial_ups([imu], [replace(track, device="other")], [rest]) == []
