"""Many stations: chains, rings and islands of common sight, known and unknown distances."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.geometry import umeyama
from locatk.core.lighthouse.calibration import (
    FACTORY_UNITS,
    GENERIC_CALIBRATION,
    MODEL_SIGMA_RAD,
    ideal_angles,
)
from locatk.core.lighthouse.light_planes import rays as rays_of
from locatk.core.lighthouse.scene import Scene, estimation, registration
from locatk.core.lighthouse.scene.bundle_adjustment import adjust_bundle
from locatk.core.lighthouse.scene.estimation import StationsEstimate, estimate_stations
from locatk.core.lighthouse.scene.registration import StationRegistration
from locatk.core.lighthouse.scene.two_view import estimate_station_pair
from locatk.core.lighthouse.simulation import SimulationOptions, simulate
from locatk.core.lighthouse.solver import solve

Array = NDArray[np.float64]

MEAN_M = {True: 3e-3, False: 6e-3}
"""Mean error of places on a floor and in space that a generic calibration leaves, over a few
metres."""

STATION_M = 0.06


def hall(world: Any, number: int, length: float) -> tuple[Any, ...]:
    """Stations in turn on both sides of a hall, with factory calibrations of real units."""
    rng = np.random.default_rng(number)
    found = []
    for k in range(number):
        x = length * (k + 0.5) / number
        place = np.array([x, 2.4 * (-1) ** k, rng.uniform(1.8, 2.6)])
        aim = np.array([x + rng.normal(0, 0.3), 0.0, 0.2])
        planes = world.planes_of(FACTORY_UNITS[k % len(FACTORY_UNITS)])
        found.append(world.Lamp(k + 1, place, world.look(place, aim, rng.normal(0, 0.03)), planes))
    return tuple(found)


def along(number: int, length: float, flat: bool) -> Array:
    """A winding drive from one end of the hall to the other."""
    t = np.linspace(0, 1, number)
    z = np.zeros(number) if flat else 0.4 + 0.3 * np.sin(57 * t)
    return np.stack([t * length, 0.9 * np.sin(40 * t), z], axis=1)


def seen_by(lamps: Any, points: Array) -> Array:
    true = np.stack([lamp.angles(points) for lamp in lamps], axis=1)
    return true + np.random.default_rng(0).normal(0, 1e-4, true.shape)


def only(angles: Array, *sights: tuple[int, ...]) -> Array:
    """Angles of the places dealt out in turn to sets of stations that see them."""
    masked = np.full_like(angles, np.nan)
    turn = np.arange(len(angles)) * len(sights) // len(angles)
    for k, columns in enumerate(sights):
        rows = np.flatnonzero(turn == k)
        masked[np.ix_(rows, columns)] = angles[np.ix_(rows, columns)]
    return masked


def nearest(lamps: Any, points: Array, angles: Array, number: int) -> Array:
    """Angles of the nearest stations alone."""
    away = np.stack([np.linalg.norm(points - lamp.position, axis=1) for lamp in lamps], axis=1)
    rank = np.argsort(np.argsort(away, axis=1), axis=1)
    return np.where((rank < number)[..., None], angles, np.nan)


def run(angles: Array, planar: bool | None = None) -> StationsEstimate:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return estimate_stations(
            angles, (GENERIC_CALIBRATION,) * angles.shape[1], sigma=MODEL_SIGMA_RAD, planar=planar
        )


def check(found: StationsEstimate, lamps: Any, points: Array, mean_m: float) -> None:
    """Places and stations are right, after the similarity of the places."""
    rig = found.adjustment.state
    true = points[found.chosen]
    to = umeyama(rig.points, true)
    assert np.mean(np.linalg.norm(to.apply(rig.points) - true, axis=1)) < mean_m
    for k, column in enumerate(found.stations):
        away = np.linalg.norm(to.apply(rig.positions[k]) - lamps[column].position)
        assert away < STATION_M, f"station {column} is {away:.3f} m off"
        np.testing.assert_allclose(
            to.rotation @ rig.rotations[k], lamps[column].rotation, atol=0.04
        )


@pytest.mark.parametrize("flat", [True, False])
def test_three_stations_of_which_no_place_sees_all(world: Any, flat: bool) -> None:
    # Each pair gives a direction; three of them close a triangle.
    lamps = world.lamps(1, 2, 5)
    points = world.curve(300, flat=flat)
    angles = seen_by(lamps, points)
    for k in range(3):
        angles[k::3, k] = np.nan
    found = run(angles)
    assert found.planar is flat
    assert found.stations == (0, 1, 2)
    check(found, lamps, points, MEAN_M[flat])


@pytest.mark.slow
@pytest.mark.parametrize("flat", [True, False])
def test_four_stations_in_pairs_only(world: Any, flat: bool) -> None:
    lamps = world.lamps(1, 2, 5, 16)
    points = world.curve(120, flat=flat)
    angles = np.full((120, 4, 2), np.nan)
    every = seen_by(lamps, points)
    for k, pair in enumerate([(0, 1), (1, 2), (2, 3), (0, 3), (0, 2), (1, 3)]):
        angles[k::6, pair] = every[k::6, pair]
    found = run(angles)
    assert found.stations == (0, 1, 2, 3)
    check(found, lamps, points, MEAN_M[flat])


def test_a_chain_on_a_floor_needs_no_place_of_three(world: Any) -> None:
    # The height over the floor is the measure that both pairs share.
    lamps = world.lamps(1, 2, 5)
    points = world.curve(300, flat=True)
    found = run(only(seen_by(lamps, points), (0, 1), (1, 2)))
    assert found.stations == (0, 1, 2)
    check(found, lamps, points, MEAN_M[True])


def test_a_chain_in_space_takes_its_scale_from_few_places_of_three(world: Any) -> None:
    lamps = world.lamps(1, 2, 5)
    points = world.curve(300, flat=False)
    every = seen_by(lamps, points)
    angles = only(every, (0, 1), (1, 2))
    angles[148:153] = every[148:153]
    found = run(angles)
    assert found.stations == (0, 1, 2)
    check(found, lamps, points, 2 * MEAN_M[False])


def test_without_positions_of_three_stations_the_distance_is_unknown(world: Any) -> None:
    lamps = world.lamps(1, 2, 5)
    points = world.curve(300, flat=False)
    found = run(only(seen_by(lamps, points), (0, 1), (1, 2)))
    assert len(found.stations) == 2
    (reason,) = found.left_out.values()
    assert "distance is unknown" in reason
    check(found, lamps, points, MEAN_M[False])


@pytest.mark.slow
@pytest.mark.parametrize("flat", [True, False])
def test_of_two_islands_the_larger_is_solved(world: Any, flat: bool) -> None:
    lamps = (*world.lamps(1, 2, 5), *hall(world, 2, 3.0))
    points = world.curve(300, flat=flat)
    # The small group has the most places.
    angles = only(seen_by(lamps, points), (0, 1, 2), (3, 4), (3, 4))
    found = run(angles)
    assert found.stations == (0, 1, 2)
    assert set(found.left_out) == {3, 4}
    assert all("group" in reason for reason in found.left_out.values())
    check(found, lamps, points, 2 * MEAN_M[flat])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "length", "flat"), [(6, 9.0, True), (6, 9.0, False), (16, 24.0, False)]
)
def test_a_hall_of_stations_of_which_three_see_a_place(
    world: Any, number: int, length: float, flat: bool
) -> None:
    lamps = hall(world, number, length)
    points = along(25 * number, length, flat)
    found = run(nearest(lamps, points, seen_by(lamps, points), 3))
    assert found.planar is flat
    assert found.stations == tuple(range(number))
    assert found.left_out == {}
    # Errors of calibration bend a hall over its length, by a thousandth.
    check(found, lamps, points, 1e-3 * length)


@pytest.mark.slow
def test_a_stretch_that_is_flat_does_not_make_a_floor(world: Any) -> None:
    lamps = world.lamps(1, 2, 5, 16)
    points = world.curve(400, flat=False)
    points[:200, 2] = 0.0
    angles = only(seen_by(lamps, points), (0, 1), (0, 1, 2), (1, 2, 3), (0, 2, 3))
    found = run(angles)
    assert found.planar is False
    assert found.stations == (0, 1, 2, 3)


def test_a_station_that_saw_a_corner_is_not_guessed(world: Any) -> None:
    lamps = world.lamps(1, 2, 5)
    points = world.curve(300, flat=True)
    angles = seen_by(lamps, points)
    angles[:293, 2] = np.nan  # seven places along 10 cm
    found = run(angles)
    assert found.stations == (0, 1)
    assert set(found.left_out) == {2}


@pytest.mark.slow
def test_narrow_fields_of_bodies_are_not_called_floors(world: Any) -> None:
    # Photodiodes on a body of 8 cm, three metres off: a homography fits to 0.6 mrad.
    lamps = world.lamps(1, 2)
    rng = np.random.default_rng(4)
    points = rng.normal(0, 0.025, (40, 3)) + [0.0, 0.0, 0.3]
    assert run(seen_by(lamps, points)).planar is False


# ---- whole sessions


@pytest.mark.slow
@pytest.mark.parametrize("planar", [True, False])
def test_hiding_a_station_moves_poses_by_millimetres(planar: bool) -> None:
    """Users of other tools report jumps of 50 to 100 mm when a station is hidden."""
    session = simulate(
        SimulationOptions(stations=4, planar=planar, duration_s=60, occlusion=0.2, seed=3)
    )
    for station in solve(session.sweeps, session.scene).facts.verification.stations:
        assert station.against == "others"
        assert station.residual_rad < 5e-4
        assert station.jump_median_m < 1e-3
        assert station.jump_95_m < 3e-3


def test_omitted_stations_are_named_with_channel_and_reason(world: Any) -> None:
    lamps = world.lamps(1, 2, 5)
    drive = world.drive(lamps, world.curve(300, flat=False))
    drive.counts[:150, 2] = np.nan
    drive.counts[150:, 0] = np.nan
    solution = solve(drive.sweeps, Scene(markers=world.markers_of(lamps[:2], world.square)))
    left = [s for s in (1, 5) if solution.artifact.station(s) is None]
    assert len(left) == 1
    (warning,) = [w for w in solution.warnings if w.code == "stations_left_out"]
    assert f"channel {left[0]} " in warning.message
    assert "distance is unknown" in warning.message


def test_received_serial_numbers_are_kept(world: Any) -> None:
    lamps = world.lamps(1, 2)
    drive = world.drive(lamps, world.curve(120, flat=True))
    solution = solve(drive.sweeps, Scene(ids={2: 0x0FF22226}))
    assert [s.id for s in solution.artifact.stations] == [None, 0x0FF22226]
    assert [row.id for row in solution.detections] == [None, "0ff22226"]


# ---- published: four stations and a tracker, poses of the stations by libsurvive


@pytest.mark.slow
def test_recorded_stations_predict_each_other(recorded_tracker: Any) -> None:
    """Stations, calibrations and sweeps of four real units agree, in our model."""
    solution = solve(recorded_tracker.sweeps, recorded_tracker.scene)
    stations = solution.facts.verification.stations
    assert [s.channel for s in stations] == [1, 4, 8, 12]
    for station in stations:
        assert station.against == "others"
        assert station.residual_rad < 1e-3
        assert station.jump_median_m < 1.5e-3
        assert station.jump_95_m < 2.5e-3
    assert all(w.code != "wrong_station" for w in solution.warnings)


@pytest.mark.slow
def test_a_recorded_station_that_is_moved_in_the_scene_is_named(recorded_tracker: Any) -> None:
    stations = tuple(
        replace(s, position=s.position + ([0.05, 0.0, 0.0] if s.channel == 8 else [0.0] * 3))
        for s in recorded_tracker.scene.stations
    )
    solution = solve(recorded_tracker.sweeps, replace(recorded_tracker.scene, stations=stations))
    (warning,) = [w for w in solution.warnings if w.code == "wrong_station"]
    assert "channel 8 " in warning.message


# ---- growth of the work


@pytest.mark.slow
def test_the_work_grows_with_the_number_of_stations(
    world: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Twice as many stations, all of which are received everywhere, are about twice the work."""
    work = []

    def counted(angles: Array, *arguments: Any, **options: Any) -> Any:
        adjustment = adjust_bundle(angles, *arguments, **options)
        work[-1] += angles.size * adjustment.iterations
        return adjustment

    monkeypatch.setattr(registration, "adjust_bundle", counted)
    for number in (6, 12):
        work.append(0)
        lamps = hall(world, number, 6.0)
        found = run(seen_by(lamps, along(90, 6.0, True)), planar=True)
        assert len(found.stations) == number
    assert work[1] < 2.6 * work[0]


@pytest.mark.slow
def test_all_are_refined_before_a_station_is_given_up(world: Any) -> None:
    lamps = hall(world, 5, 6.0)
    points = along(150, 6.0, True)
    angles = seen_by(lamps, points)
    generic = (GENERIC_CALIBRATION,) * 5
    rays = np.stack([rays_of(ideal_angles(angles[:, k], GENERIC_CALIBRATION)) for k in range(5)], 1)
    start = estimate_station_pair(
        angles, rays, generic, (0, 1), sigma=MODEL_SIGMA_RAD, planar=True, marker_misfit=None
    )

    class Reluctant(StationRegistration):
        """Resects the last two stations only if all others were refined after the third."""

        refined = 0

        def _refine(self) -> None:
            super()._refine()
            self.refined = len(self.registered)

        def _resect(self, *arguments: Any) -> Any:
            is_reliable = len(self.registered) < 4 or self.refined == len(self.registered)
            return super()._resect(*arguments) if is_reliable else None

    stations = Reluctant(angles, rays, generic, start, MODEL_SIGMA_RAD)
    assert stations.register_all(lambda i, j: None) == {}
    assert stations.refined == 5


def test_a_scene_is_estimated_from_a_bounded_number_of_keyframes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Only they determine its cost, so that a recording may be long."""
    recording = simulate(SimulationOptions(duration_s=40.0, stations=3))
    marked = Scene(markers=recording.scene.markers)
    monkeypatch.setattr(estimation, "MAX_KEYFRAMES", 250)
    numbers = []

    def counted(angles: Array, *arguments: Any, **options: Any) -> Any:
        numbers.append(len(angles))
        return estimate_stations(angles, *arguments, **options)

    monkeypatch.setattr(estimation, "estimate_stations", counted)
    solution = solve(recording.sweeps, marked)
    assert numbers == [250]
    assert solution.poses > 350
    (truth,), (solved,) = recording.truth, solution.trajectories
    true = np.stack([np.interp(solved.time_ns, truth.time_ns, c) for c in truth.position.T], 1)
    assert np.median(np.linalg.norm(solved.position - true, axis=1)) < 2e-3
