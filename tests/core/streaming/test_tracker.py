"""Poses, states and corrections of one device."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from locatk.core.geometry import heading_from_quaternion, quaternion_from_heading
from locatk.core.streaming.events import (
    ArtifactUpdate,
    Correction,
    Fix,
    LiveEvent,
    PoseEstimate,
    StateChange,
    TrackingState,
)
from locatk.core.streaming.planar_filter import OdometryNoise
from locatk.core.streaming.tracker import (
    DEFAULT_SETTINGS,
    DeviceTracker,
    StateReason,
    TrackerSettings,
    independent_covariance,
)
from locatk.core.trajectory import Trajectory

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND


def make_fix(
    time_s: float, x: float = 0.0, y: float = 0.0, heading: float = 0.0, **changes: Any
) -> Fix:
    covariance = np.full((6, 6), np.nan)
    plane = np.ix_([0, 1, 5], [0, 1, 5])
    covariance[plane] = np.diag([1e-6, 1e-6, 1e-4])
    fix = Fix(
        "robot",
        "floor",
        START + round(time_s * SECOND),
        np.array([x, y, 0.0]),
        quaternion_from_heading(heading),
        covariance,
    )
    return replace(fix, **changes)


def make_odometry(time_s: Any, x: Any, y: Any = 0.0, heading: Any = 0.0) -> Trajectory:
    time_s, x, y, heading = np.broadcast_arrays(np.atleast_1d(time_s), x, y, heading)
    n = len(time_s)
    return Trajectory(
        "robot",
        "odometry",
        START + np.rint(time_s * SECOND).astype(np.int64),
        np.column_stack([x, y, np.zeros(n)]),
        quaternion_from_heading(heading),
        np.full((n, 6, 6), np.nan),
    )


def poses(events: list[LiveEvent]) -> list[PoseEstimate]:
    return [event for event in events if isinstance(event, PoseEstimate)]


def states(events: list[LiveEvent]) -> list[tuple[float, str, str]]:
    return [
        (round((event.time_ns - START) / SECOND, 6), event.state.value, event.reason)
        for event in events
        if isinstance(event, StateChange)
    ]


def fingerprint(events: list[LiveEvent]) -> list[Any]:
    """Return events with the bytes of their arrays, to compare them exactly."""
    return [
        tuple(
            value.tobytes() if isinstance(value, np.ndarray) else repr(value)
            for value in (getattr(event, name) for name in event.__dataclass_fields__)
        )
        for event in events
    ]


def test_fix_passes_unchanged_without_motion() -> None:
    tracker = DeviceTracker("robot")
    fix = make_fix(0.0, 1.0, 2.0, 3.0, probability=0.9999)
    change, pose = tracker.fix(fix)
    assert isinstance(change, StateChange)
    assert change.state is TrackingState.TRACKING
    assert isinstance(pose, PoseEstimate)
    for name in ("device", "frame", "time_ns", "position", "quaternion", "covariance"):
        assert getattr(pose, name) is getattr(fix, name)
    assert (pose.probability, pose.state, pose.reason) == (0.9999, TrackingState.TRACKING, "")


def test_a_pose_at_each_sample_and_each_newer_fix() -> None:
    tracker = DeviceTracker("robot")
    events = tracker.odometry(make_odometry([0.0, 0.1], [0.0, 0.1]))
    assert poses(events) == []
    events = tracker.fix(make_fix(0.1, 5.0, 1.0, np.pi / 2))
    events += tracker.odometry(make_odometry([0.2, 0.3], [0.2, 0.3]))
    events += tracker.fix(make_fix(0.33, 5.0, 1.23, np.pi / 2))
    times = [(pose.time_ns - START) / SECOND for pose in poses(events)]
    assert times == [0.1, 0.2, 0.3, 0.33]
    position = np.array([pose.position[:2] for pose in poses(events)])
    np.testing.assert_allclose(position[:, 0], 5.0, atol=1e-6)
    np.testing.assert_allclose(position[:, 1], [1.0, 1.1, 1.2, 1.23], atol=1e-3)


def test_published_times_strictly_increase(drive: Any, track: Any) -> None:
    events = track(DeviceTracker("robot"), drive(0, duration_s=4.0), delay_s=0.17)
    times = [pose.time_ns for pose in poses(events)]
    assert len(times) > 150
    assert all(np.diff(times) > 0)


def test_states_follow_the_age_of_the_fix() -> None:
    tracker = DeviceTracker("robot", TrackerSettings(fix_timeout_s=0.25, lost_timeout_s=1.0))
    time_s = np.arange(0.0, 0.8, 0.1)
    events = tracker.odometry(make_odometry(time_s[:1], time_s[:1]))
    events += tracker.fix(make_fix(0.05))
    events += tracker.odometry(make_odometry(time_s[1:], time_s[1:]))
    events += tracker.advance(START + 5 * SECOND)
    events += tracker.fix(make_fix(5.5))
    assert states(events) == [
        (0.0, "lost", "no fix yet"),
        (0.05, "tracking", ""),
        (0.3, "dead reckoning", "no recent fix"),
        (1.7, "lost", "no fix and no motion data"),
        (5.5, "tracking", ""),
    ]
    reckoned = [pose for pose in poses(events) if pose.state is TrackingState.DEAD_RECKONING]
    assert {pose.reason for pose in reckoned} == {"no recent fix"}
    assert [round((pose.time_ns - START) / SECOND, 3) for pose in reckoned] == [0.4, 0.5, 0.6, 0.7]
    sigma = np.array([pose.sigma[[0, 1, 5]] for pose in poses(events)[1:8]])
    assert (np.diff(sigma, axis=0) > 0).all()


def test_without_motion_a_silent_device_is_lost() -> None:
    tracker = DeviceTracker("robot")
    events = tracker.fix(make_fix(0.0))
    events += tracker.advance(START + SECOND)
    assert states(events) == [(0.0, "tracking", "")]
    events = tracker.advance(START + 2 * SECOND)
    assert states(events) == [(1.0, "lost", "no fix and no motion data")]


def test_the_reason_of_the_stream_is_shown() -> None:
    tracker = DeviceTracker("robot")
    report = StateChange("robot", START, TrackingState.LOST, "off_sheet")
    events = tracker.take_reason(report)
    events += tracker.fix(make_fix(0.1))
    events += tracker.take_reason(replace(report, time_ns=START + SECOND // 5))
    events += tracker.advance(START + 3 * SECOND)
    events += tracker.take_reason(replace(report, time_ns=START + 4 * SECOND, reason="no_grid"))
    events += tracker.fix(make_fix(5.0))
    assert states(events) == [
        (0.0, "lost", "off_sheet"),
        (0.1, "tracking", ""),
        (1.1, "lost", "off_sheet"),
        (4.0, "lost", "no_grid"),
        (5.0, "tracking", ""),
    ]


def test_lost_beyond_the_limit_of_sigma() -> None:
    tracker = DeviceTracker("robot", TrackerSettings(max_sigma_m=0.05))
    tracker.odometry(make_odometry(0.0, 0.0))
    tracker.fix(make_fix(0.0))
    time_s = np.arange(0.1, 60.0, 0.1)
    events = tracker.odometry(make_odometry(time_s, 0.2 * time_s))
    assert states(events)[-1][1:] == ("lost", "sigma above the limit")
    assert all(pose.sigma[:2].max() <= 0.05 for pose in poses(events))
    lost_ns = states(events)[-1][0]
    assert all((pose.time_ns - START) / SECOND < lost_ns for pose in poses(events))
    distance = float(0.2 * time_s[-1])
    again = tracker.fix(make_fix(float(time_s[-1]) + 0.05, distance + 0.01))
    assert states(again)[-1][1] == "tracking"


def test_provisional_until_a_fix_is_certain() -> None:
    tracker = DeviceTracker("robot")
    events = tracker.fix(make_fix(0.0, probability=0.6))
    events += tracker.fix(make_fix(0.1, probability=0.9995))
    assert states(events) == [
        (0.0, "provisional", "other positions are possible"),
        (0.1, "tracking", ""),
    ]


def test_a_certain_fix_replaces_a_provisional_pose_at_once() -> None:
    tracker = DeviceTracker("robot")
    tracker.odometry(make_odometry([0.0, 0.1], [0.0, 0.1]))
    tracker.fix(make_fix(0.1, 3.0, probability=0.6))
    events = tracker.odometry(make_odometry([0.2], [0.2]))
    assert poses(events)[0].state is TrackingState.PROVISIONAL
    events = tracker.fix(make_fix(0.21, 0.2, 4.0, probability=1.0), "tag 77")
    (correction,) = [event for event in events if isinstance(event, Correction)]
    assert correction.reason == "tag 77"
    np.testing.assert_allclose(correction.displacement_m, [0.2 - 3.11, 4.0, 0.0], atol=1e-2)
    (pose,) = poses(events)
    assert (pose.reset_counter, pose.state) == (1, TrackingState.TRACKING)
    np.testing.assert_allclose(pose.position[:2], [0.2, 4.0], atol=1e-6)


def test_a_single_wrong_fix_is_refused() -> None:
    tracker = DeviceTracker("robot")
    tracker.odometry(make_odometry([0.0, 0.1], 0.0))
    tracker.fix(make_fix(0.1))
    events = tracker.fix(make_fix(0.15, 1.0))
    np.testing.assert_allclose(poses(events)[0].position, 0.0, atol=1e-3)
    assert tracker.rejected["refused_fixes"] == 1
    assert not any(isinstance(event, Correction) for event in events)


def test_decoded_fixes_start_anew_at_once() -> None:
    tracker = DeviceTracker("robot", DEFAULT_SETTINGS["polaris"])
    tracker.odometry(make_odometry([0.0, 0.1], 0.0))
    tracker.fix(make_fix(0.1))
    events = tracker.fix(make_fix(0.15, 1.0))
    np.testing.assert_allclose(poses(events)[0].position, [1.0, 0.0, 0.0])
    assert sum(isinstance(event, Correction) for event in events) == 1


@pytest.mark.parametrize("with_odometry", [True, False])
def test_another_frame_starts_anew(with_odometry: bool) -> None:
    tracker = DeviceTracker("robot")
    if with_odometry:
        tracker.odometry(make_odometry([0.0, 0.1], 0.0))
    tracker.fix(make_fix(0.1))
    events = tracker.fix(make_fix(0.15, 7.0, frame="other"))
    (correction,) = [event for event in events if isinstance(event, Correction)]
    assert correction.reason == "frame other"
    assert np.isnan(correction.displacement_m).all()
    (pose,) = poses(events)
    assert (pose.frame, pose.reset_counter, pose.position[0]) == ("other", 1, 7.0)
    (pose,) = poses(tracker.fix(make_fix(0.2, 7.0, frame="other")))
    assert pose.reset_counter == 1


def test_a_new_artifact_starts_anew() -> None:
    tracker = DeviceTracker("robot")
    tracker.odometry(make_odometry([0.0, 0.1], 0.0))
    tracker.fix(make_fix(0.1))
    tracker.use_artifact(ArtifactUpdate(START, 2, None))
    events = tracker.fix(make_fix(0.15, 0.002))
    (correction,) = [event for event in events if isinstance(event, Correction)]
    assert correction.reason == "scene version 2"
    np.testing.assert_allclose(correction.displacement_m, [0.002, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(poses(events)[0].position, [0.002, 0.0, 0.0])


def test_odometry_that_restarts_loses_the_pose() -> None:
    tracker = DeviceTracker("robot")
    tracker.odometry(make_odometry([0.0, 0.1], [7.0, 7.1]))
    tracker.fix(make_fix(0.1))
    events = tracker.odometry(make_odometry([0.2, 0.3], [0.0, 0.1]))
    assert states(events) == [(0.2, "lost", "jump of the odometry")]
    assert poses(events) == []
    events = tracker.fix(make_fix(0.31, 1.0))
    assert poses(events)[0].reset_counter == 1
    assert states(events)[-1][1] == "tracking"


def test_invalid_odometry_is_counted() -> None:
    tracker = DeviceTracker("robot")
    tracker.odometry(make_odometry([0.0, 0.1, 0.1, 0.05, 0.2], [0.0, 0.1, 0.1, 0.0, np.nan]))
    assert tracker.rejected["bad_motions"] == 3


def test_heading_wraps() -> None:
    """Ten rotations of the robot, with fixes of headings between -pi and pi."""
    tracker = DeviceTracker("robot")
    time_s = np.arange(0.0, 20.0, 0.05)
    heading = np.pi * time_s
    events: list[LiveEvent] = []
    for index, at in enumerate(time_s.tolist()):
        events += tracker.odometry(make_odometry(at, 0.0, 0.0, heading[index]))
        if index % 7 == 0:
            events += tracker.fix(make_fix(at, 0.0, 0.0, heading[index]))
    assert tracker.rejected["refused_fixes"] == 0
    estimates = poses(events)
    true = np.pi * np.array([(pose.time_ns - START) / SECOND for pose in estimates])
    found = heading_from_quaternion(np.array([pose.quaternion for pose in estimates]))
    np.testing.assert_allclose(np.exp(1j * found), np.exp(1j * true), atol=1e-3)


def test_headings_at_half_a_rotation() -> None:
    """Fixes of 179 and -179 degrees of a robot at rest agree."""
    tracker = DeviceTracker("robot")
    tracker.odometry(make_odometry(0.0, 0.0))
    for index in range(1, 20):
        tracker.odometry(make_odometry(index / 10, 0.0))
        tracker.fix(make_fix(index / 10, heading=np.pi + 0.01 * (-1) ** index))
    assert tracker.rejected["refused_fixes"] == 0
    (pose,) = poses(tracker.odometry(make_odometry(2.0, 0.0)))
    np.testing.assert_allclose(
        abs(float(heading_from_quaternion(pose.quaternion))), np.pi, atol=1e-2
    )


def test_a_fix_before_the_first_odometry_is_used() -> None:
    tracker = DeviceTracker("robot")
    tracker.fix(make_fix(0.05, 5.0))
    events = tracker.odometry(make_odometry([0.0, 0.1, 0.2], [0.0, 0.1, 0.2]))
    np.testing.assert_allclose([pose.position[0] for pose in poses(events)], [5.05, 5.15])


def test_a_fix_in_a_silence_of_the_odometry_is_used_after_it() -> None:
    """It passes as it is, because it is too late to extrapolate the motion."""
    tracker = DeviceTracker("robot")
    tracker.odometry(make_odometry([0.0, 0.1], [0.0, 0.1]))
    fix = make_fix(0.5, 5.0)
    (pose,) = poses(tracker.fix(fix))
    assert pose.covariance is fix.covariance
    (pose,) = poses(tracker.odometry(make_odometry(0.52, 0.52)))
    np.testing.assert_allclose(pose.position[0], 5.02, atol=1e-3)


def test_provisional_fixes_do_not_replace_a_certain_pose_at_once() -> None:
    tracker = DeviceTracker("robot", DEFAULT_SETTINGS["polaris"])
    tracker.odometry(make_odometry([0.0, 0.1], 0.0))
    tracker.fix(make_fix(0.1))
    resets = [
        poses(tracker.fix(make_fix(0.1 + index / 100, 3.0, probability=0.6)))[0].reset_counter
        for index in (1, 2, 3)
    ]
    assert resets == [0, 0, 1]


def test_a_refused_fix_raises_the_covariance_after_motion_only() -> None:
    """Wheels may have slipped; at rest, the fix is wrong."""
    for distance, low, high in ((0.2, 1.5, 100.0), (0.0, 0.99, 1.1)):
        tracker = DeviceTracker("robot")
        tracker.odometry(make_odometry(0.0, 0.0))
        tracker.fix(make_fix(0.0))
        (before,) = poses(tracker.odometry(make_odometry(0.1, distance)))
        (after,) = poses(tracker.fix(make_fix(0.1001, 3.0)))
        assert low < after.sigma[5] / before.sigma[5] < high


def test_odometry_connects_positions_without_heading(drive: Any, track: Any) -> None:
    """The heading follows from two positions; before, positions pass as they are."""
    case = drive(3, has_heading=False, fix_interval_s=0.1, duration_s=8.0)
    events = track(DeviceTracker("robot"), case)
    known = [pose.has_orientation for pose in poses(events)]
    assert not known[0]
    assert all(known[known.index(True) :])
    error, _ = case.errors(events)
    assert np.abs(error[:, 5]).max() < 0.3
    assert np.abs(error[:, :2]).max() < 0.02


@pytest.mark.parametrize("delay_s", [0.05, 0.3, 2.0])
def test_late_fix_equals_processing_in_order(drive: Any, track: Any, delay_s: float) -> None:
    case = drive(5, duration_s=4.0, fix_interval_s=0.3)
    in_order, late = DeviceTracker("robot"), DeviceTracker("robot")
    last = poses(track(in_order, case))[-1]
    delayed = poses(track(late, case, delay_s=delay_s))[-1]
    sample = case.motion.select(np.array([-1]))
    sample = replace(sample, time_ns=sample.time_ns + SECOND // 50)
    last, delayed = poses(in_order.odometry(sample))[0], poses(late.odometry(sample))[0]
    np.testing.assert_allclose(delayed.position, last.position, rtol=0, atol=1e-12)
    np.testing.assert_allclose(delayed.quaternion, last.quaternion, rtol=0, atol=1e-12)
    np.testing.assert_allclose(delayed.covariance, last.covariance, rtol=1e-9, atol=1e-15)


@pytest.mark.slow
def test_late_inertial_fix_equals_processing_in_order(flight: Any, track: Any) -> None:
    case = flight(5, duration_s=6.0, fix_interval_s=0.25)
    last, delayed = (
        poses(track(DeviceTracker("robot"), case, delay_s=delay_s))[-1] for delay_s in (0.0, 0.15)
    )
    np.testing.assert_allclose(delayed.position, last.position, rtol=0, atol=1e-9)
    np.testing.assert_allclose(delayed.covariance, last.covariance, rtol=1e-6, atol=1e-12)


@pytest.mark.slow
def test_a_fix_older_than_the_history_is_refused() -> None:
    tracker = DeviceTracker("robot")
    time_s = np.arange(0.0, 60.0, 0.02)
    tracker.odometry(make_odometry(time_s[:2], 0.0))
    tracker.fix(make_fix(0.02))
    tracker.odometry(make_odometry(time_s[2:], 0.0))
    assert tracker.fix(make_fix(1.0, 0.3)) == []
    assert tracker.rejected["late_fixes"] == 1


def test_late_fixes_of_a_slow_polaris_pass_are_used() -> None:
    """A tag of 0.3 m at 0.05 m/s, with odometry at 100 Hz."""
    tracker = DeviceTracker("robot", DEFAULT_SETTINGS["polaris"])
    time_s = np.arange(0.0, 30.0, 0.01)
    tracker.odometry(make_odometry(time_s, 0.05 * time_s))
    tracker.fix(make_fix(24.0, 1.2))
    assert tracker.rejected["late_fixes"] == 0
    (pose,) = poses(tracker.odometry(make_odometry(30.0, 1.5)))
    np.testing.assert_allclose(pose.position[0], 1.5, atol=1e-6)


@pytest.mark.slow
@settings(
    max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(cuts=st.lists(st.integers(1, 99), max_size=8), seed=st.integers(0, 3))
def test_any_pieces_of_odometry_give_the_same_events(
    drive: Any, cuts: list[int], seed: int
) -> None:
    case = drive(seed, duration_s=2.0, fix_interval_s=0.5)
    whole, pieces = DeviceTracker("robot"), DeviceTracker("robot")
    for tracker in (whole, pieces):
        tracker.odometry(case.motion.select(np.arange(1)))
    expected = whole.fix(case.fixes[0]) + whole.odometry(case.motion.select(np.arange(1, 100)))
    events = pieces.fix(case.fixes[0])
    edges = sorted({1, *cuts, 100})
    for first, last in itertools.pairwise(edges):
        events += pieces.odometry(case.motion.select(np.arange(first, last)))
    assert fingerprint(events) == fingerprint(expected)


def test_fewer_samples_of_odometry_give_the_same_covariance() -> None:
    """Noise has a variance per metre and radian."""
    sigma = []
    for count in (4, 40, 400):
        tracker = DeviceTracker("robot", TrackerSettings(fix_timeout_s=10.0))
        angle = np.linspace(0.0, 1.0, count + 1)
        path = make_odometry(4 * angle, np.sin(angle), 1 - np.cos(angle), angle)
        tracker.odometry(path.select(np.arange(1)))
        tracker.fix(make_fix(0.0))
        sigma.append(poses(tracker.odometry(path.select(np.arange(1, count + 1))))[-1].sigma)
    np.testing.assert_allclose(sigma[1], sigma[2], rtol=1e-3)
    np.testing.assert_allclose(sigma[0], sigma[2], rtol=3e-2)


def test_noise_of_the_heading_displaces_within_a_step() -> None:
    """On a straight line, any number of samples gives q d^3 / 3 of the lateral variance."""
    noise = OdometryNoise(
        scale=0.0,
        rotation_scale=0.0,
        drift_rad_per_m=0.0,
        distance_m=0.0,
        heading_rad=0.02,
        slip_m=0.0,
        slip_rad=0.0,
    )
    for count in (1, 10, 100):
        tracker = DeviceTracker("robot", TrackerSettings(fix_timeout_s=10.0, odometry=noise))
        tracker.odometry(make_odometry(0.0, 0.0))
        fix = make_fix(0.0)
        fix.covariance[5, 5] = 1e-12
        tracker.fix(fix)
        time_s = np.arange(1, count + 1) / count
        pose = poses(tracker.odometry(make_odometry(time_s, 1.5 * time_s)))[-1]
        np.testing.assert_allclose(pose.covariance[1, 1], 1e-6 + 0.02**2 * 1.5**3 / 3, rtol=1e-6)


@pytest.mark.slow
def test_covariances_are_symmetric_and_positive(drive: Any, flight: Any, track: Any) -> None:
    for case, index in ((drive(2, common_m=3e-3), [0, 1, 5]), (flight(2), range(6))):
        for pose in poses(track(DeviceTracker("robot"), case)):
            covariance = pose.covariance[np.ix_(index, index)]
            np.testing.assert_allclose(covariance, covariance.T, rtol=1e-6, atol=1e-15)
            assert np.linalg.eigvalsh(covariance).min() > 0


def test_common_errors_stay_in_the_published_covariance() -> None:
    common = np.full((6, 6), np.nan)
    common[np.ix_([0, 1, 5], [0, 1, 5])] = np.diag([4e-6, 4e-6, 0.0])
    tracker = DeviceTracker("robot")
    tracker.odometry(make_odometry(0.0, 0.0))
    pose = None
    for index in range(1, 50):
        fix = make_fix(index / 100, common_covariance=common)
        fix.covariance[0, 0] = fix.covariance[1, 1] = 5e-6
        (pose,) = poses(tracker.fix(fix))
        if index == 1:
            np.testing.assert_allclose(pose.covariance[0, 0], 5e-6, rtol=1e-3)
        tracker.odometry(make_odometry(index / 100 + 0.001, 0.0))
    assert pose is not None
    assert 4e-6 < pose.covariance[0, 0] < 4.1e-6


def test_independent_covariance_is_positive() -> None:
    """A common part that is larger than the total, by rounding of its source, leaves a little."""
    fix = make_fix(0.0)
    fix = replace(fix, common_covariance=1.1 * fix.covariance)
    rest = independent_covariance(fix)
    plane = np.ix_([0, 1, 5], [0, 1, 5])
    np.testing.assert_allclose(rest[plane], 1e-3 * fix.covariance[plane], rtol=1e-6, atol=1e-15)
    assert np.isnan(rest[2]).all()


def test_reasons_are_few_words() -> None:
    assert all(len(str(reason).split()) <= 6 for reason in StateReason)


@pytest.mark.slow
def test_memory_is_flat_in_ten_hours() -> None:
    """Odometry at 1 Hz: more samples than the history keeps, many times over."""
    tracker = DeviceTracker("robot", TrackerSettings(fix_timeout_s=10.0, max_sigma_m=10.0))
    sizes = []
    for hour in range(10):
        time_s = hour * 3600 + np.arange(0.0, 3600.0)
        events: list[LiveEvent] = []
        for index in range(0, 3600, 10):
            part = time_s[index : index + 10]
            events += tracker.odometry(make_odometry(part, 0.1 * part))
            events += tracker.fix(make_fix(float(part[-1]), 0.1 * float(part[-1])))
        history = tracker._history
        assert history is not None
        sizes.append((history.nbytes, len(history)))
        assert len(poses(events)) == (3600 if hour else 3591)
    assert len(set(sizes)) == 1
    assert tracker.rejected["refused_fixes"] == 0
