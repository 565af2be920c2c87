"""Simulated rooms: mounted stations, free paths, and light that something stops."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from locatk.core.errors import InputError
from locatk.core.lighthouse.calibration import GENERIC_CALIBRATION
from locatk.core.lighthouse.room import Obstacle, RobotSize, Room
from locatk.core.lighthouse.scene import Marker, Scene, Station
from locatk.core.lighthouse.simulation import SimulationOptions, simulate
from locatk.core.lighthouse.simulation.rooms import RoomLight, RoomPath, mounted_stations
from locatk.core.lighthouse.solver import solve
from locatk.core.polygons import rectangle
from tests.core.lighthouse.rooms import looking_at

NO_MARKERS = np.zeros((0, 3))
L_SHAPE = np.array([[0, 0], [5, 0], [5, 2.5], [2.5, 2.5], [2.5, 5], [0, 5.0]])
TABLE = Obstacle(rectangle(0.8, 0.6, (1.0, 1.2)), 0.6, 0.7)
PILLAR = Obstacle(np.array([[3.2, 0.8], [3.6, 0.8], [3.4, 1.3]]), 0.0, 2.6)
ROOM = Room(
    L_SHAPE,
    2.6,
    (0.1, 0.8),
    obstacles=(TABLE, PILLAR),
    robots=RobotSize(3, 0.15, 0.3),
)


def scene_of(room: Room, corners: np.ndarray) -> Scene:
    stations = []
    for channel, corner in enumerate(corners, 1):
        position = np.append(corner, room.height_m - 0.2)
        rotation = looking_at(position, np.append(room.outline_m.mean(axis=0), 0.0))
        covariance = np.diag([0.03**2] * 2 + [0.01**2] + [0.02**2] * 3)
        stations.append(
            Station(channel, position, rotation, GENERIC_CALIBRATION, covariance=covariance)
        )
    return Scene(
        tuple(stations),
        planar=room.is_planar,
        floor_z=room.photodiode_z_m[0],
        scale="design",
        frame="room",
        frame_source="design",
        room=room,
    )


def inside(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Whether points (n, 2) are inside a polygon, by counting its edges to the right of each."""
    result = np.zeros(len(points), bool)
    for (x1, y1), (x2, y2) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        between = (y1 > points[:, 1]) != (y2 > points[:, 1])
        with np.errstate(divide="ignore", invalid="ignore"):
            x = x1 + (points[:, 1] - y1) * (x2 - x1) / (y2 - y1)
        result ^= between & (points[:, 0] < x)
    return result


def test_paths_keep_away_from_walls_and_obstacles() -> None:
    rng = np.random.default_rng(1)
    path = RoomPath(rng, ROOM, 120.0, 0.4, NO_MARKERS)
    time_s = np.arange(0, 120.0, 0.02)
    position = path.position(time_s)
    speed = np.linalg.norm(np.diff(position, axis=0), axis=1) / 0.02
    assert 0.35 < speed.max() < 0.401
    assert np.ptp(position[:, 0]) > 3
    assert np.ptp(position[:, 2]) > 0.5
    assert position[:, 2].min() >= 0.1
    assert position[:, 2].max() <= 0.8
    for angle in np.linspace(0, 2 * np.pi, 12, endpoint=False):
        rim = position[:, :2] + 0.149 * np.array([np.cos(angle), np.sin(angle)])
        assert np.all(inside(rim, L_SHAPE))
        assert not np.any(inside(rim, PILLAR.outline_m))
        assert not np.any(inside(rim, TABLE.outline_m))  # Robots reach up to 0.8 m.
    moving = speed > 0.05
    along = np.diff(position, axis=0)[moving]
    heading = path.heading(time_s[1:][moving])
    turn = heading - np.arctan2(along[:, 1], along[:, 0])
    assert np.max(np.abs(np.angle(np.exp(1j * turn)))) < 0.02


def test_no_place_for_a_robot_is_an_error() -> None:
    full = replace(ROOM, robots=RobotSize(1, 2.4, 0.3))
    with pytest.raises(InputError, match="no free place"):
        RoomPath(np.random.default_rng(0), full, 10.0, 0.4, NO_MARKERS)


def test_light_is_blocked_as_by_stepping_along_the_ray() -> None:
    rng = np.random.default_rng(2)
    paths = [RoomPath(rng, ROOM, 40.0, 0.4, NO_MARKERS) for _ in range(3)]
    light = RoomLight(ROOM, paths)
    stations = np.array([[0.02, 0.02, 2.4], [4.98, 2.48, 2.4], [0.02, 4.9, 1.0], [2.4, 2.4, 0.2]])
    wrong, blocked_count = 0, 0
    for station in stations:
        time_s = rng.uniform(0, 40.0, 300)
        points = paths[0].position(time_s)
        blocked = light.blocked(0, station)(points, time_s)
        fraction = np.linspace(0, 1, 1501)[1:-1]
        for point, now_s, is_blocked in zip(points, time_s, blocked, strict=True):
            ray = station + fraction[:, None] * (point - station)
            hit = ~inside(ray[:, :2], L_SHAPE)
            for solid in ROOM.obstacles:
                is_level = (ray[:, 2] > solid.low_m) & (ray[:, 2] < solid.high_m)
                hit |= is_level & inside(ray[:, :2], solid.outline_m)
            for other in paths[1:]:
                x, y, _ = other.position(np.array(now_s))
                hit |= (np.hypot(ray[:, 0] - x, ray[:, 1] - y) < 0.15) & (ray[:, 2] < 0.3)
            wrong += bool(hit.any()) != is_blocked
            blocked_count += is_blocked
    assert blocked_count > 100
    assert wrong <= 3  # Rays that graze an edge between two steps.


def test_a_station_too_far_away_is_not_received() -> None:
    hall = Room(rectangle(20, 4), 3.0)
    light = RoomLight(hall, [])
    points = np.array([[6.5, 2, 0.5], [8.0, 2, 0.5]])
    assert light.blocked(0, np.array([0.05, 2, 2.5]))(points, np.zeros(2)).tolist() == [False, True]


def test_stations_of_a_design_are_mounted_by_its_covariance() -> None:
    design = scene_of(ROOM, L_SHAPE[[0, 2]])
    errors = []
    for seed in range(300):
        first, _ = mounted_stations(np.random.default_rng(seed), design)
        turn = first.rotation @ design.stations[0].rotation.T
        angle = [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
        errors.append(np.r_[first.position - design.stations[0].position, np.array(angle) / 2])
    np.testing.assert_allclose(
        np.std(errors, axis=0), [0.03, 0.03, 0.01, 0.02, 0.02, 0.02], rtol=0.15
    )
    solved = replace(design, frame_source="floor")
    (station, _) = mounted_stations(np.random.default_rng(0), solved)
    assert station is solved.stations[0]


def test_a_session_in_a_room_contains_the_design_and_is_solved_in_its_frame() -> None:
    flat = replace(ROOM, photodiode_z_m=(0.1, 0.1))
    design = scene_of(flat, L_SHAPE[[0, 1, 4]])
    options = SimulationOptions(robots=2, duration_s=25.0, room=design, noise_rad=1e-4, seed=3)
    session = simulate(options)
    assert session.scene.stations is design.stations
    assert session.scene.markers == ()
    assert {t.frame for t in session.truth} == {"room"}
    assert [s.channel for s in session.true_scene.stations] == [1, 2, 3]
    assert not np.allclose(session.true_scene.stations[0].position, design.stations[0].position)
    solution = solve(session.sweeps, session.scene)
    errors = []
    for track, truth in zip(solution.trajectories, session.truth, strict=True):
        true = [np.interp(track.time_ns, truth.time_ns, x) for x in truth.position.T]
        errors.append(track.position - np.stack(true, axis=1))
    error = np.concatenate(errors)
    sigma_m = solution.facts.frame.origin_sigma_m
    assert 0.01 < sigma_m < 0.06
    assert np.linalg.norm(error.mean(axis=0)) < 3 * sigma_m
    assert np.linalg.norm(np.std(error, axis=0)) < 0.03


def test_the_first_robot_visits_the_markers_of_a_room_and_they_fix_the_frame() -> None:
    flat = replace(ROOM, photodiode_z_m=(0.1, 0.1))
    places = [[0.4, 0.4, 0.1], [4.6, 0.4, 0.1], [2.1, 2.1, 0.1], [0.4, 4.6, 0.1]]
    markers = tuple(Marker(f"m{k}", np.array(place)) for k, place in enumerate(places))
    design = replace(scene_of(flat, L_SHAPE[[0, 1, 4]]), markers=markers)
    options = SimulationOptions(robots=2, duration_s=30.0, room=design, noise_rad=1e-4, seed=3)
    session = simulate(options)
    truth = session.truth[0]
    for marker, place in zip(session.scene.markers, places, strict=True):
        (visit,) = marker.visits
        is_there = (truth.time_ns > visit.start_ns) & (truth.time_ns < visit.end_ns)
        assert visit.device == "robot-1"
        assert np.count_nonzero(is_there) > 50
        assert np.abs(truth.position[is_there] - place).max() < 1e-9
    solution = solve(session.sweeps, session.scene)
    assert solution.artifact.scale == "markers"
    for track, path in zip(solution.trajectories, session.truth, strict=True):
        true = [np.interp(track.time_ns, path.time_ns, x) for x in path.position.T]
        error = np.linalg.norm(track.position - np.stack(true, axis=1), axis=1)
        # Without markers, the mounting errors of the stations move the frame by centimetres.
        assert np.quantile(error, 0.95) < 0.012


@pytest.mark.parametrize(
    ("scene", "flying", "message"),
    [
        (Scene(), False, "no room"),
        (Scene(room=ROOM), False, "no stations"),
        (scene_of(ROOM, L_SHAPE[:2]), True, "flights"),
    ],
)
def test_scenes_in_which_nothing_can_be_simulated_are_refused(
    scene: Scene, flying: bool, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        SimulationOptions(room=scene, flying=flying, planar=False)
