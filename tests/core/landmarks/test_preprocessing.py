"""Preprocessing: invalid readings, odometry at each sample, and visits of simulated sessions."""

from __future__ import annotations

import functools
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.landmarks.detection.trace import OdometryDrift
from locatk.core.landmarks.halls import HallSamples, HallSensors
from locatk.core.landmarks.landmark import Geometry
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.landmarks.preprocessing import (
    SATURATION_FRACTION,
    HallRecording,
    VisitSegment,
    check_odometry,
    preprocess,
    remove_invalid_readings,
    segment_visits,
)
from locatk.core.landmarks.simulation.session import (
    Errors,
    SimulatedSession,
    SimulationOptions,
    simulate,
)
from locatk.core.solution import SolverWarning

Array = NDArray[np.float64]

CODES = np.random.default_rng(3).integers(0, 16, (6, 6))

GEOMETRY = Geometry()


# ---- invalid readings


def recorded(field: Array) -> HallSamples:
    time_ns = np.arange(len(field), dtype=np.int64) * 5_000_000
    return HallSamples("robot", HallSensors(), time_ns, field)


def valid_readings(field: Array, step_m: float = 1e-3) -> tuple[Array, list[SolverWarning]]:
    return remove_invalid_readings(recorded(field), np.full(len(field) - 1, step_m))


def waves() -> Array:
    """Return fields of 25 mT whose peaks are about 14 samples wide, as of fast robots."""
    rng = np.random.default_rng(2)
    rotation = np.linspace(0, 60, 400)[:, None] + np.arange(4)
    return np.asarray(0.025 * np.sin(rotation) + rng.normal(0, 1.5e-4, rotation.shape))


def test_spikes_are_removed_and_counted() -> None:
    field = waves()
    at = [(50, 0), (51, 2), (200, 3), (333, 0)]
    for row, column in at:
        field[row, column] += 0.06 if field[row, column] > 0 else -0.06
    kept, warnings = valid_readings(field)
    assert [tuple(where) for where in np.argwhere(np.isnan(kept))] == at
    assert warnings == [SolverWarning("spikes", "robot: 4 single readings jump; left out")]


def test_noise_has_no_spikes() -> None:
    rng = np.random.default_rng(5)
    field = waves() + rng.normal(0, 2e-3, (400, 4))
    assert not np.isnan(valid_readings(field)[0]).any()
    field[77, 1] += 0.06
    assert np.argwhere(np.isnan(valid_readings(field)[0])).tolist() == [[77, 1]]


def test_rounding_is_noise() -> None:
    """A reading that is rounded to the next step, and back, is no spike."""
    step_t = 3e-3
    rest = np.random.default_rng(1).normal(1e-3, 0.2e-3, (200, 4))
    field = step_t * np.round(np.vstack([rest, waves()]) / step_t)
    field[50, 2] = step_t
    _, warnings = valid_readings(field)
    assert "spikes" not in [each.code for each in warnings]


def test_a_bar_that_is_passed_within_a_sample_is_no_spike() -> None:
    """At 12.5 Hz a robot of 0.2 m/s moves 16 mm from sample to sample."""
    x = 0.016 * np.arange(-6, 7)
    field = np.tile(0.025 * np.exp(-0.5 * (x / 0.01) ** 2)[:, None], 4)
    assert not np.isnan(valid_readings(field, step_m=0.016)[0]).any()
    assert np.isnan(valid_readings(field, step_m=0.001)[0][6]).all()


def test_valid_readings_are_kept() -> None:
    field = waves()
    kept, warnings = valid_readings(field)
    assert (kept == field).all()
    assert warnings == []


def test_unknown_range_is_detected() -> None:
    field = np.clip(waves(), -0.02, 0.02)
    kept, warnings = valid_readings(field)
    assert (np.isnan(kept) == (np.abs(field) >= SATURATION_FRACTION * 0.02)).all()
    assert [each.code for each in warnings] == ["range_from_data", "saturated"]
    assert "readings end at 20 mT" in warnings[0].message


# ---- visits of a recording


@functools.cache
def session(pitch_m: float = 0.2, noise_t: float = 1.5e-4) -> SimulatedSession:
    floor = FloorMap(CODES, pitch_m=pitch_m)
    path = ((1, 1), (1, 4), (3, 4))
    errors = Errors(noise_t=noise_t, offset_t=2e-4)
    return simulate(
        floor, SimulationOptions(strategy="path", cells=path, errors=errors, rate_hz=60, seed=4)
    )


def visits_of(one: SimulatedSession) -> list[VisitSegment]:
    run = preprocess(one.samples[0], one.odometry[0])
    return segment_visits(run, one.floor.geometry, OdometryDrift(), one.floor.pitch_m)


@pytest.mark.parametrize("pitch_m", [0.16, 0.2, 0.3])
@pytest.mark.parametrize("noise_t", [2e-5, 1.5e-4])
def test_one_visit_per_landmark(pitch_m: float, noise_t: float) -> None:
    one = session(pitch_m, noise_t)
    want = [(1, 1), (1, 2), (1, 3), (1, 4), (2, 4), (3, 4)]
    assert [event.cell for event in one.events] == want
    result = visits_of(one)
    assert len(result) == len(want)
    for visit, event in zip(result, one.events, strict=True):
        assert one.samples[0].time_ns[visit.first] <= event.nearest_ns
        assert one.samples[0].time_ns[visit.stop - 1] >= event.nearest_ns
    for before, after in pairwise(result):
        assert before.stop <= after.first


def test_reference_is_near_the_landmark() -> None:
    one = session()
    truth = one.truth[0]
    # The first and the last one are left or reached at rest on the landmark.
    for visit, event in list(zip(visits_of(one), one.events, strict=True))[1:-1]:
        at = np.searchsorted(truth.time_ns, visit.time_ns[visit.trace.reference])
        away = np.hypot(*(truth.position[at, :2] - one.floor.position(event.cell)))
        assert away < event.nearest_m + 0.025


def test_bins_are_means_of_their_samples() -> None:
    one = session()
    run = preprocess(one.samples[0], one.odometry[0])
    for visit in visits_of(one):
        assert visit.trace.weight.sum() == visit.stop - visit.first
        own = (run.samples.field_t - run.offset_t)[visit.first : visit.stop].sum(axis=0)
        reported = visit.trace.weight @ visit.trace.field_t
        np.testing.assert_allclose(reported, own, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(visit.trace.pose[visit.trace.reference], 0, atol=1e-12)


def test_rest_adds_no_bins() -> None:
    options = SimulationOptions(
        strategy="path", cells=((1, 1), (1, 2)), stop_s=60, rate_hz=60, seed=1
    )
    for visit in visits_of(simulate(FloorMap(CODES), options)):
        assert len(visit.trace) < 150


def test_offsets_and_noise_are_estimated() -> None:
    """Offsets include the Earth's field; the noise of the sensors is not given."""
    one = session()
    silent = replace(one.samples[0], sensors=replace(one.samples[0].sensors, noise_t=float("nan")))
    run = preprocess(silent, one.odometry[0])
    assert run.noise_t == pytest.approx(1.5e-4, rel=0.25)
    away = np.hypot(
        *(one.truth[0].position[:, None, :2] - [one.floor.position(c) for c in one.floor.cells()]).T
    ).min(axis=0)
    quiet = one.samples[0].field_t[away > 0.13]
    if len(quiet) > 50:
        np.testing.assert_allclose(run.offset_t, np.median(quiet, axis=0), atol=1e-4)


def test_saturated_readings_are_removed() -> None:
    one = session()
    limit = 0.02
    clipped = replace(
        one.samples[0],
        sensors=replace(one.samples[0].sensors, range_t=limit),
        field_t=np.clip(one.samples[0].field_t, -limit, limit),
    )
    run = preprocess(clipped, one.odometry[0])
    gone = np.isnan(run.samples.field_t).sum()
    assert gone == (np.abs(clipped.field_t) >= 0.999 * limit)[: len(run.samples)].sum()
    assert "saturated" in [each.code for each in run.warnings]


@pytest.mark.parametrize("value", [np.nan, 1e-3])
def test_dead_sensors_are_removed_and_named(value: float) -> None:
    one = session()
    field = one.samples[0].field_t.copy()
    field[:, 2] = value
    run = preprocess(replace(one.samples[0], field_t=field), one.odometry[0])
    assert np.isnan(run.samples.field_t[:, 2]).all()
    assert not np.isnan(run.samples.field_t[:, :2]).any()
    assert any(
        each.code in ("sensor_silent", "sensor_constant") and "rear" in each.message
        for each in run.warnings
    )


def test_no_sensor_at_all_is_an_error() -> None:
    one = session()
    blind = replace(one.samples[0], field_t=np.full_like(one.samples[0].field_t, np.nan))
    with pytest.raises(InputError, match="no hall sensor"):
        preprocess(blind, one.odometry[0])


def test_odometry_is_required() -> None:
    one = session()
    with pytest.raises(InputError, match="no odometry of robot"):
        preprocess(one.samples[0], None)
    later = replace(one.odometry[0], time_ns=one.odometry[0].time_ns + 10**12)
    with pytest.raises(InputError, match="covers none"):
        preprocess(one.samples[0], later)


def test_samples_without_odometry_are_left_out() -> None:
    one, own = session(), session().odometry[0]
    half = len(own) // 2
    short = replace(
        own,
        time_ns=own.time_ns[:half],
        position=own.position[:half],
        quaternion=own.quaternion[:half],
        covariance=own.covariance[:half],
    )
    run = preprocess(one.samples[0], short)
    assert run.samples.time_ns[-1] <= short.time_ns[-1]
    left = len(one.samples[0]) - len(run.samples)
    (warning,) = [each for each in run.warnings if each.code == "samples_without_odometry"]
    assert f"{left} samples without odometry" in warning.message


@pytest.mark.parametrize("factor", [1000, 100])
def test_odometry_in_another_unit_is_an_error(factor: float) -> None:
    one = session()
    other = replace(one.odometry[0], position=one.odometry[0].position * factor)
    with pytest.raises(InputError):
        check_odometry(preprocess(one.samples[0], other), GEOMETRY)


def test_odometry_in_metres_is_accepted() -> None:
    check_odometry(preprocess(session().samples[0], session().odometry[0]), GEOMETRY)


# ---- guards


def line_recording(length_m: float, field_t: float) -> HallRecording:
    """Return a straight path over one field of 40 mm half width."""
    x = np.linspace(-length_m / 2, length_m / 2, 400)
    pose = np.column_stack([x, np.zeros(400), np.zeros(400)])
    time_ns = np.arange(400, dtype=np.int64) * 5_000_000
    field = field_t * np.exp(-((np.linspace(-5, 5, 400)) ** 2))[:, None] * np.ones(4)
    return HallRecording(
        HallSamples("robot", HallSensors(), time_ns, field), pose, np.zeros(4), 1e-5
    )


@pytest.mark.parametrize(("length_m", "is_accepted"), [(0.4, True), (2e-3, True), (0.5e-3, False)])
def test_odometry_at_rest_is_an_error_if_the_field_changes(
    length_m: float, is_accepted: bool
) -> None:
    recording = line_recording(length_m, 0.01)
    if is_accepted:
        check_odometry(recording, GEOMETRY)
    else:
        with pytest.raises(InputError, match="does not move"):
            check_odometry(recording, GEOMETRY)


@pytest.mark.parametrize(("thresholds", "count"), [(0.45, 0), (0.55, 1)])
def test_visits_need_a_strong_field(thresholds: float, count: int) -> None:
    recording = line_recording(0.4, thresholds * GEOMETRY.threshold_t)
    assert len(segment_visits(recording, GEOMETRY, OdometryDrift())) == count


def test_steep_fields_are_no_spikes() -> None:
    """A step between two levels is no deviation from both neighbours; a lone reading is one."""
    field = np.full((9, 4), 1e-3)
    field[4:] = 20e-3
    assert not np.isnan(valid_readings(field)[0]).any()
    field[7, 1] = 60e-3
    assert np.argwhere(np.isnan(valid_readings(field)[0])).tolist() == [[7, 1]]


def test_removed_sensor_is_reported() -> None:
    recording = line_recording(0.4, 0.01).without_sensor(2)
    assert np.isnan(recording.samples.field_t).all(axis=0).tolist() == [False, False, True, False]
    (warning,) = recording.warnings
    assert warning.code == "sensor_left_out"
    assert "rear" in warning.message


def test_odometry_at_rest_is_an_error_also_if_each_sensor_lost_a_reading() -> None:
    recording = line_recording(0.5e-3, 0.01)
    field = recording.samples.field_t.copy()
    field[0] = np.nan
    recording = replace(recording, samples=replace(recording.samples, field_t=field))
    with pytest.raises(InputError, match="does not move"):
        check_odometry(recording, GEOMETRY)


def test_rotation_moves_sensors_on_any_side_of_the_robot() -> None:
    recording = line_recording(0.5e-3, 0.01)
    behind = replace(recording.samples.sensors, position_m=np.array([[-0.05, 0.0]] * 4))
    pose = recording.pose.copy()
    pose[:, 2] = np.linspace(0, 6, len(pose))
    samples = replace(recording.samples, sensors=behind)
    check_odometry(replace(recording, samples=samples, pose=pose), GEOMETRY)


def test_noise_of_alternating_sensors_is_assumed() -> None:
    session = simulate(FloorMap(CODES), SimulationOptions(seed=1, rate_hz=100.0))
    samples = session.samples[0]
    field = samples.field_t.copy()
    field[::2, :2] = field[1::2, 2:] = np.nan
    sensors = replace(samples.sensors, noise_t=np.nan)
    turns = replace(samples, field_t=field, sensors=sensors)
    assert np.isfinite(preprocess(turns, session.odometry[0]).noise_t)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_invalid_poses_are_left_out_and_reported(value: float) -> None:
    run = session()
    odometry = run.odometry[0]
    position = odometry.position.copy()
    invalid = [3, len(position) // 2]
    position[invalid, [0, 1]] = value
    recording = preprocess(run.samples[0], replace(odometry, position=position))
    assert recording.warnings[0].code == "odometry_invalid"
    assert "2 poses" in recording.warnings[0].message
    assert recording.odometry is not None
    assert len(recording.odometry) == len(odometry) - 2
    whole = preprocess(run.samples[0], odometry)
    assert len(recording.pose) == len(whole.pose)
    np.testing.assert_allclose(recording.pose, whole.pose, atol=2e-4)
    with pytest.raises(InputError, match="no valid odometry"):
        preprocess(run.samples[0], replace(odometry, position=np.full_like(position, value)))


@pytest.mark.parametrize("later_ns", [1, 0, -1_000_000])
def test_poses_whose_times_do_not_increase_are_left_out(later_ns: int) -> None:
    run = session()
    odometry = run.odometry[0]
    time_ns = odometry.time_ns.copy()
    time_ns[20] = time_ns[19] + later_ns
    recording = preprocess(run.samples[0], replace(odometry, time_ns=time_ns))
    assert [each.code for each in recording.warnings] == ["odometry_invalid"]
    assert recording.odometry is not None
    assert len(recording.odometry) == len(odometry) - 1
    whole = preprocess(run.samples[0], odometry)
    np.testing.assert_allclose(recording.pose, whole.pose, atol=2e-4)


def test_samples_at_a_long_gap_of_invalid_poses_are_left_out() -> None:
    run = session()
    odometry = run.odometry[0]
    steps = np.diff(odometry.position[:, :2], axis=0)
    moved = np.r_[0.0, np.cumsum(np.hypot(*steps.T))]
    is_invalid = (moved > moved[-1] / 2) & (moved < moved[-1] / 2 + 0.1)
    quaternion = np.where(is_invalid[:, None], np.nan, odometry.quaternion)
    recording = preprocess(run.samples[0], replace(odometry, quaternion=quaternion))
    is_kept = np.isin(run.samples[0].time_ns, recording.samples.time_ns)
    is_between = np.interp(run.samples[0].time_ns, odometry.time_ns, 1.0 * is_invalid) == 1
    assert is_between.sum() > 10
    assert not is_kept[is_between].any()
    assert is_kept.sum() >= (~is_between).sum() - 4
