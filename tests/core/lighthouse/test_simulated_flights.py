"""Simulated flights: attitude, IMU, and the disturbances of stations.

Sweeps are compared with the light planes of the independent generator of the benchmark.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from locatk.core.errors import InputError
from locatk.core.lighthouse.channels import period_counts
from locatk.core.lighthouse.receiver import DECK
from locatk.core.lighthouse.simulation import SimulatedSession, SimulationOptions, simulate
from locatk.core.simulation import SESSION_START_NS
from locatk.formats.benchmarks.lighthouse.flights import libsurvive_angles

Array = NDArray[np.float64]

FLIGHT = SimulationOptions(
    planar=False, flying=True, receiver=DECK, report_hz=120.0, noise_rad=0.0, robots=2,
    duration_s=12.0, seed=2,
)  # fmt: skip
HALF_COUNT_RAD = np.pi / float(period_counts(1))


def seconds(time_ns: NDArray[np.int64]) -> Array:
    return (time_ns - SESSION_START_NS) * 1e-9


def crossing_errors(session: SimulatedSession, robot: int = 1) -> tuple[Array, NDArray[np.int64]]:
    """Return the measured angles of a robot minus the predicted ones, and the rows of its sweeps.

    Planes are distinguished by the smaller error.
    """
    truth, sweeps = session.truth[robot], session.sweeps
    rows = np.flatnonzero(sweeps.device == robot)
    time_s = seconds(sweeps.time_ns[rows])
    position = CubicSpline(seconds(truth.time_ns), truth.position)(time_s)
    attitude = RotationSpline(seconds(truth.time_ns), Rotation.from_quat(truth.quaternion))
    position = position + attitude(time_s).apply(DECK.position_m[sweeps.sensor[rows]])
    errors = np.full(len(rows), np.inf)
    for station in session.true_scene.stations:
        own = sweeps.channel[rows] == station.channel
        local = (position[own] - station.position) @ station.rotation
        angles = libsurvive_angles(np.repeat(local[:, None], 2, axis=1), station.calibration.sweeps)
        fraction = sweeps.count[rows[own]] / period_counts(station.channel)
        both = 2 * np.pi * (fraction[:, None] - np.array([1, 2]) / 3) - angles
        errors[own] = both[np.arange(len(both)), np.argmin(np.abs(both), axis=1)]
    return errors, rows


@pytest.fixture(scope="module")
def session() -> SimulatedSession:
    return simulate(FLIGHT)


def test_sweeps_are_received_at_the_photodiodes_of_a_tilting_aircraft(
    session: SimulatedSession,
) -> None:
    errors, _ = crossing_errors(session)
    assert len(errors) > 12 * 2 * 2 * 45 * 4
    # Whole counts, and what the spline between samples of the truth adds.
    assert np.abs(errors).max() < HALF_COUNT_RAD + 5e-6
    tilt = Rotation.from_quat(session.truth[1].quaternion).as_matrix()[:, 2, 2]
    assert np.degrees(np.arccos(tilt.min())) > 3.0


def test_aircraft_rest_climb_and_push_along_their_acceleration(session: SimulatedSession) -> None:
    truth = session.truth[1]
    time_s, path = seconds(truth.time_ns), CubicSpline(seconds(truth.time_ns), truth.position)
    resting = (time_s < 0.9) | (time_s > 11.1)
    np.testing.assert_array_equal(truth.position[resting, 2], 0.0)
    assert truth.position[:, 2].max() > 0.3
    flying = (time_s > 3.1) & (time_s < 8.9)
    assert np.linalg.norm(path(time_s, 1)[flying], axis=1).max() <= FLIGHT.speed_mps * 1.001
    push = path(time_s, 2) + [0.0, 0.0, 9.80665]
    up = Rotation.from_quat(truth.quaternion).apply([0.0, 0.0, 1.0])
    cosine = np.sum(push * up, axis=1)[flying] / np.linalg.norm(push[flying], axis=1)
    assert np.degrees(np.arccos(np.clip(cosine.min(), -1, 1))) < 0.1
    fast = simulate(replace(FLIGHT, speed_mps=2.0, report_hz=1.0)).truth[1]
    speed = np.linalg.norm(CubicSpline(time_s, fast.position)(time_s, 1)[flying], axis=1)
    assert 0.8 < speed.max() <= 2.002


@pytest.mark.slow
def test_the_imu_measures_the_flight() -> None:
    session = simulate(replace(FLIGHT, imu_hz=500.0, report_hz=1.0))
    for imu, truth in zip(session.imu, session.truth, strict=True):
        assert imu.device == truth.device
        time_s = seconds(imu.time_ns)
        np.testing.assert_allclose(np.diff(time_s), 0.002, atol=1e-9)
        attitude = RotationSpline(seconds(truth.time_ns), Rotation.from_quat(truth.quaternion))
        path = CubicSpline(seconds(truth.time_ns), truth.position)
        flying = (time_s > 8.1) & (time_s < 10.9)  # both robots
        force = attitude(time_s).inv().apply(path(time_s, 2) + [0.0, 0.0, 9.80665])
        error = (imu.acceleration - force)[flying]
        assert np.abs(error.mean(axis=0)).max() < 0.35
        assert error.std(axis=0) == pytest.approx(np.full(3, 0.3), rel=0.15)
        error = (imu.angular_rate - attitude(time_s, 1))[flying]
        assert np.abs(error.mean(axis=0)).max() < 0.035
        assert np.abs(error - error.mean(axis=0)).max() < 0.02
        assert np.linalg.norm(imu.acceleration[:100], axis=1).mean() == pytest.approx(9.81, abs=0.4)
    assert simulate(replace(FLIGHT, imu_hz=0.0, report_hz=1.0)).imu == ()


@pytest.mark.slow
def test_reflections_replace_the_light_in_runs() -> None:
    session = simulate(replace(FLIGHT, reflections=0.2, duration_s=20.0))
    errors, rows = crossing_errors(session)
    is_wrong = session.is_outlier[rows]
    assert np.abs(errors[~is_wrong]).max() < HALF_COUNT_RAD + 5e-6
    assert np.median(np.abs(errors[is_wrong])) > 0.05
    # A part of the reflections is outside the beam of the station.
    assert 0.1 < session.is_outlier.mean() < 0.22
    own = np.flatnonzero((session.sweeps.channel[rows] == 1) & (session.sweeps.sensor[rows] == 0))
    starts = np.count_nonzero(np.diff(is_wrong[own].astype(int)) == 1)
    assert 3 <= starts <= 40


@pytest.mark.slow
def test_a_station_is_turned_in_the_middle() -> None:
    session = simulate(replace(FLIGHT, station_turn_rad=0.03))
    errors, rows = crossing_errors(session)
    is_turned = session.sweeps.channel[rows] == 2
    is_turned &= seconds(session.sweeps.time_ns[rows]) > 6.0
    assert np.abs(errors[~is_turned]).max() < HALF_COUNT_RAD + 5e-6
    assert np.median(np.abs(errors[is_turned])) > 0.015


@pytest.mark.slow
def test_factory_data_differ_from_the_light_planes_by_the_requested_error() -> None:
    options = replace(
        FLIGHT, receiver=None, report_hz=1.0, stations=16, robots=1, factory_data=True
    )
    exact = simulate(options)
    session = simulate(replace(options, calibration_error_rad=1e-3))
    stations = session.true_scene.stations
    assert set(session.scene.calibrations) == {s.channel for s in stations}
    difference = np.stack(
        [s.calibration.sweeps - session.scene.calibrations[s.channel].sweeps for s in stations]
    )
    assert difference[..., :2].std() == pytest.approx(1e-3, rel=0.3)
    assert np.all(difference[..., 2:] == 0.0)
    for station in exact.true_scene.stations:
        known = exact.scene.calibrations[station.channel]
        np.testing.assert_array_equal(station.calibration.sweeps, known.sweeps)
    assert simulate(replace(options, factory_data=False)).scene.calibrations == {}


def test_flights_need_space() -> None:
    with pytest.raises(InputError, match="flying"):
        SimulationOptions(flying=True)
