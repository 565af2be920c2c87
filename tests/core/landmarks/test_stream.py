"""Causal landmarks solver on simulated drives, compared with the offline solver and the truth."""

from __future__ import annotations

import copy
import dataclasses
import functools
import math
import pickle
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.geometry import heading_from_quaternion, quaternion_from_heading
from locatk.core.landmarks import stream as stream_module
from locatk.core.landmarks import visit_stream
from locatk.core.landmarks.detection.hypotheses import VisitHypotheses, detect_landmark
from locatk.core.landmarks.detection.trace import OdometryDrift, compose
from locatk.core.landmarks.halls import HallSamples
from locatk.core.landmarks.map.floor import AsBuiltLandmark, FloorMap
from locatk.core.landmarks.preprocessing import preprocess, segment_visits
from locatk.core.landmarks.results import LandmarkDetection
from locatk.core.landmarks.sensor_statistics import MAX_STATISTIC_SAMPLES, SensorStatistics
from locatk.core.landmarks.simulation.session import (
    Aims,
    Faults,
    SimulatedSession,
    SimulationOptions,
    simulate,
)
from locatk.core.landmarks.solver import SolveOptions, solve
from locatk.core.landmarks.stream import LandmarksStream
from locatk.core.landmarks.visit_stream import CompletedVisit, VisitStream
from locatk.core.solution import Solution
from locatk.core.streaming.events import (
    DetectionEvent,
    Fix,
    StateChange,
    StreamEvent,
    TrackingState,
    WarningEvent,
)
from locatk.core.trajectory import PROVISIONAL_PROBABILITY, Trajectory

Array = NDArray[np.float64]
Observations = HallSamples | Trajectory

CODES = np.random.default_rng(11).integers(0, 16, (12, 12))

FLOOR = FloorMap(CODES)

ROUTE = ((2, 2), (2, 6), (5, 6))

OTHER_ROUTE = ((9, 9), (9, 5), (6, 5))


@functools.cache
def drive(route: tuple[tuple[int, int], ...] = ROUTE, **options: Any) -> SimulatedSession:
    given_options = {
        "strategy": "path",
        "cells": route,
        "rate_hz": 100.0,
        "stop_s": 0.1,
        "seed": 1,
        "aims": Aims(),
    } | options
    return simulate(FLOOR, SimulationOptions(**given_options))


def part(observations: Observations, start: int, stop: int) -> Observations:
    if isinstance(observations, HallSamples):
        return replace(
            observations,
            time_ns=observations.time_ns[start:stop],
            field_t=observations.field_t[start:stop],
        )
    return observations.select(np.arange(start, min(stop, len(observations))))


def in_time(*recordings: Observations, period_ns: int = 20_000_000) -> Iterator[Observations]:
    """Observations in the order of time, cut into short pieces."""
    first = min(int(each.time_ns[0]) for each in recordings)
    last = max(int(each.time_ns[-1]) for each in recordings)
    edges = np.arange(first, last + 2 * period_ns, period_ns)
    cuts = [np.searchsorted(each.time_ns, edges).tolist() for each in recordings]
    for k in range(len(edges) - 1):
        for each, cut in zip(recordings, cuts, strict=True):
            if cut[k + 1] > cut[k]:
                yield part(each, cut[k], cut[k + 1])


def live(
    stream: LandmarksStream, pieces: Iterator[Observations] | Sequence[Observations]
) -> list[StreamEvent]:
    events = [event for piece in pieces for event in stream.push(piece)]
    return [*events, *stream.finish()]


@functools.cache
def live_drive() -> tuple[StreamEvent, ...]:
    one = drive()
    return tuple(live(LandmarksStream(FLOOR), in_time(one.samples[0], one.odometry[0])))


@functools.cache
def offline_drive() -> Solution:
    one = drive()
    return solve(one.samples, FLOOR, odometry=one.odometry)


def detections(events: Sequence[StreamEvent]) -> list[LandmarkDetection]:
    return [event.detection for event in events if isinstance(event, DetectionEvent)]


def fixes(events: Sequence[StreamEvent]) -> list[Fix]:
    return [event for event in events if isinstance(event, Fix)]


def warning_codes(events: Sequence[StreamEvent]) -> list[str]:
    return [event.warning.code for event in events if isinstance(event, WarningEvent)]


def pose_at(trajectory: Trajectory, time_ns: int) -> Array:
    start = trajectory.time_ns[0]
    heading = np.unwrap(heading_from_quaternion(trajectory.quaternion))
    columns = (*trajectory.position[:, :2].T, heading)
    return np.array([np.interp(time_ns - start, trajectory.time_ns - start, c) for c in columns])


def pose_of(fix: Fix) -> Array:
    return np.array([*fix.position[:2], float(heading_from_quaternion(fix.quaternion))])


def difference(first: Array, second: Array) -> Array:
    result = first - second
    result[2] = math.remainder(result[2], math.tau)
    return result


def covariance_of(fix: Fix) -> Array:
    return fix.covariance[np.ix_([0, 1, 5], [0, 1, 5])]


def exact(value: Any) -> Any:
    """Everything that a value contains, such that == compares it bit for bit."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if dataclasses.is_dataclass(value):
        return type(value).__name__, [
            exact(getattr(value, item.name)) for item in dataclasses.fields(value)
        ]
    if isinstance(value, tuple | list):
        return [exact(each) for each in value]
    return value.hex() if isinstance(value, float) else value


def carried(first: SimulatedSession, second: SimulatedSession) -> tuple[HallSamples, Trajectory]:
    """Two drives as one: the robot is lifted in between, and its odometry does not notice."""
    samples, odometry = first.samples[0], first.odometry[0]
    later, later_odometry = second.samples[0], second.odometry[0]
    delay_ns = int(max(samples.time_ns[-1], odometry.time_ns[-1])) + 500_000_000
    end = np.array([*odometry.position[-1, :2], heading_from_quaternion(odometry.quaternion[-1])])
    pose = compose(
        end,
        np.column_stack(
            [later_odometry.position[:, :2], heading_from_quaternion(later_odometry.quaternion)]
        ),
    )
    return replace(
        samples,
        time_ns=np.concatenate([samples.time_ns, later.time_ns - later.time_ns[0] + delay_ns]),
        field_t=np.concatenate([samples.field_t, later.field_t]),
    ), replace(
        odometry,
        time_ns=np.concatenate(
            [odometry.time_ns, later_odometry.time_ns - later.time_ns[0] + delay_ns]
        ),
        position=np.concatenate(
            [odometry.position, np.column_stack([pose[:, :2], np.zeros(len(pose))])]
        ),
        quaternion=np.concatenate([odometry.quaternion, quaternion_from_heading(pose[:, 2])]),
        covariance=np.concatenate([odometry.covariance, later_odometry.covariance]),
    )


# ---- agreement with the offline solver and with the truth


@pytest.mark.slow
def test_cells_equal_those_of_the_offline_solver() -> None:
    offline = {round(one.time_s, 1): one for one in offline_drive().detections}
    cells = {round(one.time_s, 1): one for one in detections(live_drive())}
    assert len(cells) >= 7
    assert cells.keys() == offline.keys()
    certain = [time for time, one in cells.items() if one.cell is not None]
    assert len(certain) >= 5
    for time in certain:
        assert cells[time].cell == offline[time].cell
        assert cells[time].code == offline[time].code
        assert cells[time].refused == ""
    for time in cells.keys() - set(certain):
        assert cells[time].refused == "not_localised"


@pytest.mark.slow
def test_fixes_agree_with_the_smoothed_trajectory_and_with_the_truth() -> None:
    trajectory, truth = offline_drive().trajectories[0], drive().truth[0]
    all_fixes = fixes(live_drive())
    assert len(all_fixes) >= 5
    nees = []
    for fix in all_fixes:
        own = covariance_of(fix)
        off = difference(pose_of(fix), pose_at(trajectory, fix.time_ns))
        assert (np.abs(off) < 3 * np.sqrt(np.diag(own))).all()
        error = difference(pose_of(fix), pose_at(truth, fix.time_ns))
        nees.append(error @ np.linalg.solve(own, error))
        assert np.isnan(fix.covariance[2:5]).all()
        assert fix.frame == "map"
    assert 0.3 < np.mean(nees) < 6


@pytest.mark.slow
def test_the_landmarks_uncertainty_is_part_of_a_fix() -> None:
    """Displacing a landmark on the map displaces the fix, and its uncertainty is added."""
    cell = (2, 6)
    sigma = np.array([8e-3, 5e-3, 0.05, *[0.05] * 4])
    built = AsBuiltLandmark(0.004, -0.003, 0.0, np.full(4, np.nan), sigma)
    floor = replace(FLOOR, built={cell: built})
    one = drive()
    events = live(LandmarksStream(floor), in_time(one.samples[0], one.odometry[0]))
    times = [
        event.time_ns
        for event in live_drive()
        if isinstance(event, DetectionEvent) and event.detection.cell == cell
    ]
    (before,) = [fix for fix in fixes(live_drive()) if fix.time_ns in times]
    (after,) = [fix for fix in fixes(events) if fix.time_ns in times]
    np.testing.assert_allclose(after.position - before.position, [0.004, -0.003, 0], atol=1e-9)
    added = np.diag(covariance_of(after) - covariance_of(before))
    nominal = np.array([1.5e-3, 1.5e-3, 0.012])
    np.testing.assert_allclose(added[2], sigma[2] ** 2 - nominal[2] ** 2, rtol=1e-6)
    assert (added[:2] >= sigma[:2] ** 2 - nominal[:2] ** 2 - 1e-12).all()


@pytest.mark.slow
def test_provisional_until_certain() -> None:
    probabilities = [fix.probability for fix in fixes(live_drive())]
    certain = [each >= PROVISIONAL_PROBABILITY for each in probabilities]
    assert not certain[0]
    assert certain[-1]
    assert certain == sorted(certain)
    by_time = {
        event.time_ns: event.detection
        for event in live_drive()
        if isinstance(event, DetectionEvent)
    }
    for fix in fixes(live_drive()):
        assert by_time[fix.time_ns].cell_probability == fix.probability


@pytest.mark.slow
def test_estimate_follows_when_the_robot_leaves_the_landmark() -> None:
    """The event comes with the observations of the next 0.06 s, at 0.1 m/s and 50 Hz odometry."""
    one = drive()
    samples, odometry = one.samples[0], one.odometry[0]
    strongest = np.abs(samples.field_t).max(axis=1)
    has_field = samples.time_ns[strongest > 9.5e-4]  # 6 sigma of the noise, and the offset
    stream = LandmarksStream(FLOOR)
    waits = []
    for piece in in_time(samples, odometry, period_ns=10_000_000):
        for _ in detections(stream.push(piece)):
            now = int(piece.time_ns[-1])
            waits.append(now - int(has_field[np.searchsorted(has_field, now, "right") - 1]))
    assert len(waits) >= 7
    assert np.median(waits) < 60e6
    assert max(waits) < 100e6


@pytest.mark.slow
def test_wrong_floor_never_becomes_certain() -> None:
    other = FloorMap(np.random.default_rng(100).integers(0, 16, (12, 12)))
    one = drive()
    events = live(LandmarksStream(other), in_time(one.samples[0], one.odometry[0]))
    assert all(fix.probability < PROVISIONAL_PROBABILITY for fix in fixes(events))
    assert warning_codes(events).count("map_contradicted") == 1
    lost = [event for event in events if isinstance(event, StateChange)]
    assert [event.state for event in lost] == [TrackingState.LOST]
    late = [event for event in events if isinstance(event, Fix) and event.time_ns > lost[0].time_ns]
    assert not late


@pytest.mark.slow
def test_kidnapped_robot_is_found_again() -> None:
    second = drive((), waypoints=((1.75, 1.83), (1.75, 1.6), (0.9, 1.6), (0.9, 1.0)), seed=2)
    samples, odometry = carried(drive(), second)
    events = live(LandmarksStream(FLOOR), in_time(samples, odometry))
    start_ns = int(samples.time_ns[np.flatnonzero(np.diff(samples.time_ns) > 4e8)[0]])
    after = [fix for fix in fixes(events) if fix.time_ns > start_ns]
    certain = [fix for fix in after if fix.probability >= PROVISIONAL_PROBABILITY]
    shift_ns = int(samples.time_ns[len(drive().samples[0])] - second.samples[0].time_ns[0])
    assert certain
    for fix in certain:
        true = pose_at(second.truth[0], fix.time_ns - shift_ns)
        assert np.abs(difference(pose_of(fix), true)[:2]).max() < 0.01


@pytest.mark.slow
def test_robot_that_returns_revises_its_visit() -> None:
    """It leaves a landmark and returns to it: the filter has one reading of it, as offline."""
    one = drive((), waypoints=((0.3, 0.4), (0.68, 0.4), (0.52, 0.4), (1.3, 0.4)), stop_s=0.0)
    visits = completed_visits(new_visit_stream(), in_time(one.samples[0], one.odometry[0]))
    assert [visit.is_revised for visit in visits].count(True) >= 1
    stream = LandmarksStream(FLOOR)
    events = live(stream, in_time(one.samples[0], one.odometry[0]))
    offline = solve(one.samples, FLOOR, odometry=one.odometry)
    assert len(detections(events)) > len(offline.detections)
    cells = stream._robots["robot"].cells
    assert cells is not None
    assert len(cells.model.visits) == len(offline.detections)
    expected = [each.cell for each in offline.detections]
    assert all(each.cell in expected for each in detections(events) if each.cell is not None)
    for fix in fixes(events):
        error = difference(pose_of(fix), pose_at(one.truth[0], fix.time_ns))
        assert np.abs(error[:2]).max() < 0.01


# ---- cuts and interleaving


def random_pieces(
    samples: HallSamples, odometry: Trajectory, seed: int, advance: Callable[[int], Any]
) -> Iterator[Observations]:
    """Pieces of any size, each kind in order of time; in between the time is known at times."""
    random = np.random.default_rng(seed)
    recordings: list[Observations] = [samples, odometry]
    position = [0, 0]
    mean = random.choice([3, 50, 1000], 2)
    while any(p < len(each) for p, each in zip(position, recordings, strict=True)):
        k = int(random.integers(2))
        stop = min(position[k] + 1 + int(random.exponential(mean[k])), len(recordings[k]))
        if stop > position[k]:
            yield part(recordings[k], position[k], stop)
            position[k] = stop
        missing = [
            int(each.time_ns[p])
            for p, each in zip(position, recordings, strict=True)
            if p < len(each)
        ]
        if missing and random.random() < 0.1:
            advance(min(missing) - 1)


def completed_visits(stream: VisitStream, pieces: Iterator[Observations]) -> list[CompletedVisit]:
    visits = []
    for piece in pieces:
        if isinstance(piece, HallSamples):
            stream.push_samples(piece)
        else:
            stream.push_odometry(piece)
        visits += list(stream.visits())
    return visits + list(stream.visits(is_finished=True))


def new_visit_stream() -> VisitStream:
    return VisitStream("robot", FLOOR.geometry, FLOOR.pitch_m, OdometryDrift())


@functools.cache
def visits_in_time() -> list[Any]:
    one = drive()
    visits = completed_visits(new_visit_stream(), in_time(one.samples[0], one.odometry[0]))
    assert len(visits) >= 7
    return [exact(visit) for visit in visits]


@pytest.mark.slow
@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_visits_do_not_depend_on_cuts_and_interleaving(seed: int) -> None:
    one, stream, early = drive(), new_visit_stream(), []
    pieces = random_pieces(
        one.samples[0],
        one.odometry[0],
        seed,
        lambda time_ns: early.extend(stream.visits(time_ns)),
    )
    visits = completed_visits(stream, pieces)
    merged = sorted([*early, *visits], key=lambda visit: visit.segment.stop)
    assert [exact(visit) for visit in merged] == visits_in_time()


@pytest.mark.slow
@settings(max_examples=4, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_events_do_not_depend_on_cuts_and_interleaving(seed: int) -> None:
    one, stream = drive(), LandmarksStream(FLOOR)
    events: list[StreamEvent] = []

    def advance(time_ns: int) -> None:
        events.extend(stream.advance(time_ns))

    for piece in random_pieces(one.samples[0], one.odometry[0], seed, advance):
        events.extend(stream.push(piece))
    events += stream.finish()
    assert exact(events) == exact(list(live_drive()))


@pytest.mark.slow
def test_advance_releases_a_visit_without_later_samples() -> None:
    """After the sensors fell silent, odometry shows that the robot has left."""
    one = drive(((2, 2), (2, 3)), stop_s=0.0)
    samples, odometry = one.samples[0], one.odometry[0]
    whole = completed_visits(new_visit_stream(), in_time(samples, odometry))
    count = whole[0].segment.stop  # The first landmark has just been left.
    stream = new_visit_stream()
    stream.push_samples(part(samples, 0, count))
    stream.push_odometry(odometry)
    assert not list(stream.visits())  # Another sample may follow.
    released = list(stream.visits(int(odometry.time_ns[-1])))
    assert [visit.segment.first for visit in released] == [whole[0].segment.first]


@pytest.mark.slow
def test_robots_do_not_influence_each_other() -> None:
    one = drive()
    other = drive(OTHER_ROUTE, seed=2, device="other")
    stream = LandmarksStream(FLOOR)
    events = live(
        stream,
        in_time(one.samples[0], other.samples[0], one.odometry[0], other.odometry[0]),
    )
    own = [event for event in events if event.device == "robot"]
    assert exact(own) == exact(list(live_drive()))
    assert len(fixes(events)) > len(fixes(own))


# ---- segments


@pytest.mark.slow
def test_segments_begin_as_offline() -> None:
    one = drive()
    recording = preprocess(one.samples[0], one.odometry[0])
    offline = segment_visits(recording, FLOOR.geometry, OdometryDrift(), FLOOR.pitch_m)
    visits = completed_visits(new_visit_stream(), in_time(one.samples[0], one.odometry[0]))
    assert len(visits) == len(offline)
    for visit, expected in zip(visits, offline, strict=True):
        # Within a step of 5 mm, of the offset that was not yet known, and of the margin.
        assert abs(visit.segment.first - expected.first) <= 10
        assert visit.segment.stop <= expected.stop + 10
        assert visit.segment.trace.reference == pytest.approx(expected.trace.reference, abs=3)


@pytest.mark.slow
def test_poses_within_a_visit_are_those_of_the_offline_interpolation() -> None:
    """Only the last two intervals of the odometry are interpolated without their followers."""
    one = drive()
    recording = preprocess(one.samples[0], one.odometry[0])
    for visit in completed_visits(new_visit_stream(), in_time(one.samples[0], one.odometry[0])):
        times = visit.recording.samples.time_ns
        own = np.searchsorted(recording.samples.time_ns, times)
        error = visit.recording.pose - recording.pose[own]
        error[:, 2] -= 2 * np.pi * np.round(error[0, 2] / (2 * np.pi))
        np.testing.assert_allclose(error[: len(times) // 2], 0, atol=1e-12)
        assert np.abs(error).max() < 1e-3


# ---- sensors


def test_statistics_agree_with_the_offline_preprocessing() -> None:
    samples = drive().samples[0]
    recording = preprocess(samples, drive().odometry[0])
    statistics = SensorStatistics(replace(samples.sensors, noise_t=math.nan))
    for start in range(0, len(samples), 7):
        statistics.add_raw(samples.field_t[start : start + 7])
        statistics.add_valid(samples.field_t[start : start + 7])
    np.testing.assert_allclose(statistics.offset_t, recording.offset_t, atol=4e-6)
    unknown = replace(samples, sensors=replace(samples.sensors, noise_t=math.nan))
    expected = preprocess(unknown, drive().odometry[0]).noise_t
    assert statistics.noise_t == pytest.approx(expected, rel=0.03)
    assert not statistics.is_constant.any()
    assert not statistics.is_silent.any()


@pytest.mark.slow
def test_statistics_follow_an_offset_that_drifts() -> None:
    sensors = drive().samples[0].sensors
    statistics, random = SensorStatistics(sensors), np.random.default_rng(3)
    for offset_t in (1e-4, -2e-4):
        for _ in range(4 * MAX_STATISTIC_SAMPLES // 500):
            statistics.add_valid(offset_t + 1e-4 * random.standard_normal((500, 4)))
        np.testing.assert_allclose(statistics.offset_t, offset_t, atol=2e-5)


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (lambda field: _with_column(field, 1, np.nan), "sensor_silent"),
        (lambda field: _with_column(field, 1, 3e-4), "sensor_constant"),
        (lambda field: _with_spike(field), "spikes"),
        (lambda field: np.clip(field, -8e-3, 8e-3), "saturated"),
    ],
)
@pytest.mark.slow
def test_invalid_readings_are_left_out_with_a_warning(
    change: Callable[[Array], Array], code: str
) -> None:
    one = drive()
    samples = replace(one.samples[0], field_t=change(one.samples[0].field_t.copy()))
    events = live(LandmarksStream(FLOOR), in_time(samples, one.odometry[0]))
    offline = solve([samples], FLOOR, odometry=one.odometry)
    assert code in [warning.code for warning in offline.warnings]
    assert warning_codes(events).count(code) == 1
    by_time = {round(each.time_s, 1): each.cell for each in offline.detections}
    located = [each for each in detections(events) if each.cell is not None]
    assert len(located) >= 4
    assert all(by_time.get(round(each.time_s, 1), each.cell) == each.cell for each in located)


def _with_column(field: Array, column: int, value: float) -> Array:
    field[:, column] = value
    return field


def _with_spike(field: Array) -> Array:
    field[100::150, 2] += 0.03
    return field


@pytest.mark.slow
def test_lag_of_the_odometry_is_removed() -> None:
    one = drive(((2, 2), (2, 4), (4, 4), (4, 2), (6, 2)), stop_s=0.5, seed=5)
    late = one.odometry[0].shifted(60_000_000)
    stream = LandmarksStream(FLOOR)
    events = live(stream, in_time(one.samples[0], late))
    assert "odometry_lag" in warning_codes(events)
    assert stream._robots["robot"].visits.lag_ns == pytest.approx(60e6, abs=15e6)
    known = LandmarksStream(FLOOR, SolveOptions(odometry_lag_s=0.06))
    assert "odometry_lag" not in warning_codes(live(known, in_time(one.samples[0], late)))
    assert known._robots["robot"].visits.lag_ns == 60_000_000


@pytest.mark.slow
def test_wrong_order_of_the_sensors_is_named_by_a_task() -> None:
    one = drive(((2, 2), (2, 4), (4, 4)), faults=Faults(swapped=(("front", "left"),)))
    stream = LandmarksStream(FLOOR)
    events = [
        event for piece in in_time(one.samples[0], one.odometry[0]) for event in stream.push(piece)
    ]
    assert not [fix for fix in fixes(events) if fix.probability >= PROVISIONAL_PROBABILITY]
    tasks = list(iter(stream.background_task, None))
    (task,) = [each for each in tasks if each.name == "sensors of robot"]
    function, arguments = pickle.loads(pickle.dumps((task.function, task.arguments)))
    with pytest.raises(InputError, match="wrong order") as error:
        function(*arguments)
    assert warning_codes(stream.complete(task, error.value)) == ["sensors_wrong"]


@pytest.mark.slow
def test_scale_of_the_readings_is_corrected_by_a_task() -> None:
    one = drive(((2, 2), (2, 8), (6, 8)))
    samples = replace(
        one.samples[0],
        field_t=2.5 * one.samples[0].field_t,
        sensors=replace(one.samples[0].sensors, noise_t=math.nan),
    )
    stream, events, tasks = LandmarksStream(FLOOR), [], 0
    for piece in in_time(samples, one.odometry[0]):
        events += stream.push(piece)
        for task in iter(stream.background_task, None):
            tasks += task.name == "sensors of robot"
            events += stream.complete(task, task.function(*task.arguments))
    assert warning_codes(events).count("sensor_scale") == 1
    assert fixes(events)[-1].probability >= PROVISIONAL_PROBABILITY
    assert tasks == 1


@pytest.mark.slow
def test_opposite_polarity_is_reported_by_a_task() -> None:
    visits = tuple(
        stream_module.IdentifiedVisit(None, visit)  # type: ignore[arg-type]
        for visit in _visits_of_the_drive()
    )
    flipped = FloorMap(15 - CODES)
    warnings = stream_module.check_polarity("robot", visits, flipped, 0.02, OdometryDrift())
    assert [warning.code for warning in warnings] == ["polarity_exchanged"]


@functools.cache
def _visits_of_the_drive() -> tuple[VisitHypotheses, ...]:
    one, priors = drive(), SolveOptions().priors
    recording = preprocess(one.samples[0], one.odometry[0])
    priors = replace(priors, noise_t=recording.noise_t, pitch_m=FLOOR.pitch_m)
    segments = segment_visits(recording, FLOOR.geometry, priors.drift, FLOOR.pitch_m)
    return tuple(
        detect_landmark(segment, recording, FLOOR.geometry, priors) for segment in segments
    )


# ---- without map, and other input


@pytest.mark.slow
def test_without_a_map_landmarks_are_detected() -> None:
    one = drive()
    events = live(LandmarksStream(None), in_time(one.samples[0], one.odometry[0]))
    assert not fixes(events)
    assert warning_codes(events) == ["no_map"]
    expected = solve(one.samples, None, odometry=one.odometry).detections
    assert [each.pattern for each in detections(events)] == [each.pattern for each in expected]


def test_published_method_is_refused() -> None:
    with pytest.raises(InputError, match="paper"):
        LandmarksStream(FLOOR, SolveOptions("paper"))


def test_other_observations_are_ignored() -> None:
    stream = LandmarksStream(FLOOR)
    assert stream.push(object()) == []
    assert stream.push(part(drive().samples[0], 0, 0)) == []
    assert stream.finish() == []
    assert stream.background_task() is None


def test_odometry_or_samples_alone_give_no_event() -> None:
    one = drive()
    for observations in (one.samples[0], one.odometry[0]):
        assert live(LandmarksStream(FLOOR), [observations]) == []


# ---- memory


def repeated(one: SimulatedSession, times: int) -> Iterator[Observations]:
    """Drive again and again, on and on."""
    samples, odometry = one.samples[0], one.odometry[0]
    period_ns = int(samples.time_ns[-1] - samples.time_ns[0]) + 20_000_000
    pose = np.column_stack([odometry.position[:, :2], heading_from_quaternion(odometry.quaternion)])
    origin = np.zeros(3)
    for k in range(times):
        moved = compose(origin, pose)
        yield from in_time(
            replace(samples, time_ns=samples.time_ns + k * period_ns),
            replace(
                odometry,
                time_ns=odometry.time_ns + k * period_ns,
                position=np.column_stack([moved[:, :2], np.zeros(len(moved))]),
                quaternion=quaternion_from_heading(moved[:, 2]),
            ),
            period_ns=200_000_000,
        )
        origin = moved[-1]


@pytest.mark.slow
def test_memory_does_not_grow_on_a_long_drive(monkeypatch: pytest.MonkeyPatch) -> None:
    known = _visits_of_the_drive()

    def detect(segment: Any, *_: Any) -> VisitHypotheses:
        one = copy.deepcopy(known[len(sizes) % len(known)])
        time_ns = int(segment.time_ns[segment.trace.reference])
        return replace(one, time_ns=time_ns, odometry=segment.origin)

    monkeypatch.setattr(stream_module, "detect_landmark", detect)
    stream, sizes = LandmarksStream(FLOOR), []
    for piece in repeated(drive(), 24):
        if detections(stream.push(piece)):
            sizes.append(len(pickle.dumps(stream)))
    assert len(sizes) > 150
    assert max(sizes[120:]) < 1.15 * max(sizes[70:120])


@pytest.mark.slow
@pytest.mark.parametrize("is_turning", [False, True])
def test_memory_does_not_grow_while_a_robot_stays_on_a_landmark(
    monkeypatch: pytest.MonkeyPatch, is_turning: bool
) -> None:
    monkeypatch.setattr(visit_stream, "MAX_VISIT_ROWS", 2000)
    count, random = 16_000, np.random.default_rng(4)
    time_ns = np.arange(count) * 10_000_000
    sensors = drive().samples[0].sensors
    field = 0.01 + 1e-4 * random.standard_normal((count, 4))
    heading = 0.02 * np.arange(count // 2) * is_turning
    odometry = Trajectory(
        "robot",
        "odometry",
        time_ns[::2],
        np.zeros((count // 2, 3)),
        quaternion_from_heading(heading),
        np.full((count // 2, 6, 6), np.nan),
    )
    stream, sizes, visits = new_visit_stream(), [], 0
    for piece in in_time(
        HallSamples("robot", sensors, time_ns, field), odometry, period_ns=1_000_000_000
    ):
        if isinstance(piece, HallSamples):
            stream.push_samples(piece)
        else:
            stream.push_odometry(piece)
        visits += len(list(stream.visits()))
        sizes.append(len(pickle.dumps(stream)))
    assert max(sizes) < 1.5e6
    assert max(sizes[-100:]) <= 1.02 * max(sizes[100:-100])
    assert (visits > 5) == is_turning
    if not is_turning:
        assert stream._rows.size < visit_stream.MAX_STEP_ROWS + 100


@pytest.mark.slow
def test_observations_that_wait_for_others_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(visit_stream, "MAX_WAITING_NS", 1_000_000_000)
    one = drive()
    for observations in (one.samples[0], one.odometry[0]):
        stream, sizes = LandmarksStream(FLOOR), []
        for piece in in_time(observations, period_ns=100_000_000):
            stream.push(piece)
            sizes.append(len(pickle.dumps(stream)))
        assert max(sizes[20:]) < 1.3 * max(sizes[10:20])
