"""Streams of all systems with faults that inputs can have: no exception, and valid poses."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from locatk.core.geometry import quaternion_from_heading
from locatk.core.inertial import InertialSamples
from locatk.core.streaming.events import Fix, PoseEstimate
from locatk.core.streaming.localizer import LiveLocalizer
from locatk.core.streaming.tracker import DeviceTracker
from locatk.core.trajectory import Trajectory

sys.path.insert(0, str(Path(__file__).parent))

import stress

MAX_FAULTS = 6

SEEDS = {
    "landmarks": (66,),
    "polaris": (4,),
    "dots": (1, 2, 3),
    "photodiodes": (1, 2),
    "rigid": (8, 18),
}
"""Seeds of faults; those of landmarks, Polaris and rigid devices found errors."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("system", "seed"), [(system, seed) for system, seeds in SEEDS.items() for seed in seeds]
)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_faults_of_the_input(system: str, seed: int) -> None:
    case = stress.case(system)
    rng = np.random.default_rng(seed)
    pieces = stress.faulty(case.pieces, rng, int(rng.integers(1, MAX_FAULTS + 1)))
    localizer = LiveLocalizer(case.stream())
    stress.play(localizer, pieces)
    assert stress.size_of(localizer) < stress.MAX_BYTES


@pytest.mark.slow
@pytest.mark.parametrize("system", SEEDS)
def test_observations_after_their_time_was_complete(system: str) -> None:
    """They may be left out, but later ones are used as before."""
    case = stress.case(system)
    middle = len(case.pieces) // 4
    localizer = LiveLocalizer(case.stream())
    pieces = list(case.pieces)
    ahead_ns = int(stress.times(pieces[middle])[-1]) + 300_000_000
    events = stress.play(localizer, [*pieces[:middle], ahead_ns, *pieces[middle:]])
    assert any(isinstance(event, PoseEstimate) for event in events)


# ---- trackers


def drive_of(times_ns: list[int], positions_m: list[float]) -> Trajectory:
    n = len(times_ns)
    position = np.zeros((n, 3))
    position[:, 0] = positions_m
    return Trajectory(
        "robot",
        "odom",
        np.array(times_ns),
        position,
        quaternion_from_heading(np.zeros(n)),
        np.full((n, 6, 6), np.nan),
    )


def fix_at(time_ns: int, x_m: float = 0.0) -> Fix:
    covariance = np.full((6, 6), np.nan)
    plane = np.array([0, 1, 5])
    covariance[plane[:, None], plane] = np.diag([1e-6, 1e-6, 1e-4])
    quaternion = np.array([0.0, 0.0, 0.0, 1.0])
    return Fix("robot", "floor", time_ns, np.array([x_m, 0.0, 0.0]), quaternion, covariance)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e12, 1e200])
@pytest.mark.parametrize("column", ["position", "quaternion"])
def test_a_damaged_pose_of_the_odometry_is_left_out(value: float, column: str) -> None:
    tracker = DeviceTracker("robot")
    tracker.fix(fix_at(0))
    damaged = drive_of([20_000_000], [0.01])
    getattr(damaged, column)[0, 1] = value
    tracker.odometry(drive_of([0, 10_000_000], [0.0, 0.005]))
    assert tracker.odometry(damaged) == []
    events = tracker.odometry(drive_of([30_000_000], [0.015]))
    stress.check_poses(events)
    (pose,) = events
    assert isinstance(pose, PoseEstimate)
    assert pose.position[0] == pytest.approx(0.015, abs=2e-3)
    assert tracker.counts["bad_motions"] == 1


@pytest.mark.parametrize("variance", [np.inf, 1e200, 1e12])
def test_an_unlimited_variance_of_the_heading_keeps_the_covariance_valid(variance: float) -> None:
    tracker = DeviceTracker("robot")
    tracker.fix(fix_at(0))
    odometry = drive_of([0, 10_000_000, 20_000_000], [0.0, 0.005, 0.01])
    odometry.covariance[:, 5, 5] = [0.0, 0.0, variance]
    events = tracker.odometry(odometry)
    assert len([event for event in events if isinstance(event, PoseEstimate)]) > 1
    stress.check_poses(events)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e6, -1e200])
def test_a_damaged_reading_of_an_imu_keeps_the_last_one(value: float) -> None:
    tracker = DeviceTracker("robot")
    n = 30
    samples = InertialSamples(
        "robot",
        10_000_000 * np.arange(n),
        np.tile([0.0, 0.0, 9.80665], (n, 1)),
        np.zeros((n, 3)),
    )
    samples.acceleration[15, 0] = value
    samples.angular_rate[16, 2] = value
    pose = dataclasses.replace(fix_at(50_000_000), covariance=np.diag([1e-6] * 3 + [1e-4] * 3))
    events: list[Any] = []
    for k in range(n):
        events += tracker.inertial(
            InertialSamples(
                "robot",
                samples.time_ns[k : k + 1],
                samples.acceleration[k : k + 1],
                samples.angular_rate[k : k + 1],
            )
        )
        if k == 6:
            events += tracker.fix(pose)
    stress.check_poses(events)
    last = [event for event in events if isinstance(event, PoseEstimate)][-1]
    assert last.time_ns == samples.time_ns[-1]
    assert np.abs(last.position).max() < 0.1


def test_extrapolation_of_samples_that_arrived_together_is_limited() -> None:
    """Two samples a microsecond apart tell no speed."""
    tracker = DeviceTracker("robot")
    tracker.fix(fix_at(0))
    tracker.odometry(drive_of([0, 100_000_000, 200_000_000, 200_001_000], [0, 0.01, 0.02, 0.03]))
    events = tracker.fix(fix_at(300_000_000, 0.04))
    stress.check_poses(events)
    (pose,) = (event for event in events if isinstance(event, PoseEstimate))
    assert pose.position[0] == pytest.approx(0.04, abs=0.001)
    assert tracker.counts["refused_fixes"] == 0


def test_covariance_grows_without_fixes() -> None:
    tracker = DeviceTracker("robot")
    tracker.fix(fix_at(0))
    times_ns = [20_000_000 * k for k in range(50)]
    events = tracker.odometry(drive_of(times_ns, [0.005 * k for k in range(50)]))
    poses = [event for event in events if isinstance(event, PoseEstimate)]
    variance = np.array([np.diagonal(pose.covariance)[[0, 1, 5]] for pose in poses])
    assert len(poses) > 40
    assert (np.diff(variance, axis=0) > 0).all()
