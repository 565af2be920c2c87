"""Drives and flights of the simulators of landmarks and Lighthouse, which share no code with the
filters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.geometry import (
    quaternion_from_heading,
    quaternion_inverse,
    quaternion_multiply,
    rotation_vector_from_quaternion,
)
from locatk.core.inertial import InertialSamples
from locatk.core.landmarks.simulation.options import Errors
from locatk.core.landmarks.simulation.sensors import TRACK_M, odometry
from locatk.core.lighthouse.simulation.inertia import measure_inertia
from locatk.core.lighthouse.simulation.paths import DrivenPath, FlownPath
from locatk.core.simulation import SESSION_START_NS
from locatk.core.streaming.events import Fix, LiveEvent, PoseEstimate
from locatk.core.streaming.tracker import DeviceTracker
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Drive:
    """Drive or flight with truth, what carries its poses, and its fixes."""

    path: DrivenPath | FlownPath
    motion: Trajectory | InertialSamples
    fixes: tuple[Fix, ...]

    def errors(self, events: Sequence[LiveEvent]) -> tuple[Array, Array]:
        """Return errors (n, 6) and covariances (n, 6, 6) of the poses with a heading."""
        poses = [e for e in events if isinstance(e, PoseEstimate) and e.has_orientation]
        time_s = np.array([pose.time_ns - SESSION_START_NS for pose in poses]) * 1e-9
        position = np.array([pose.position for pose in poses])
        quaternion = np.array([pose.quaternion for pose in poses])
        rotation = quaternion_multiply(quaternion, quaternion_inverse(self.path.quaternion(time_s)))
        error = np.column_stack(
            [position - self.path.position(time_s), rotation_vector_from_quaternion(rotation)]
        )
        return error, np.array([pose.covariance for pose in poses])

    def nees(self, events: Sequence[LiveEvent], components: Sequence[int]) -> Array:
        """Return the normalized errors squared, divided by the number of components."""
        error, covariance = self.errors(events)
        index = np.array(components)
        error, covariance = error[:, index], covariance[:, index[:, None], index]
        normalized = np.linalg.solve(covariance, error[..., None])[..., 0]
        return np.einsum("ni,ni->n", error, normalized) / len(index)


def simulate_drive(
    seed: int,
    *,
    duration_s: float = 30.0,
    fix_interval_s: float = 0.5,
    sigma_m: float = 2e-3,
    sigma_rad: float = 0.01,
    common_m: float = 0.0,
    has_heading: bool = True,
    tick_m: float = 0.0,
    rate_hz: float = 50.0,
    errors: Errors | None = None,
) -> Drive:
    """Simulate a drive on a floor with wheel odometry."""
    rng = np.random.default_rng(seed)
    path = DrivenPath(rng, True, duration_s, np.zeros((0, 3)))
    time_s = np.arange(0.0, duration_s, 0.25 / rate_hz)
    poses = np.column_stack([path.position(time_s)[:, :2], np.unwrap(path.heading(time_s))])
    wheels, _ = odometry(poses, errors or Errors(), rng)
    wheels, time_s = wheels[::4], time_s[::4]
    if tick_m:
        wheels = _count_ticks(wheels, tick_m)
    n = len(time_s)
    motion = Trajectory(
        "robot",
        "odometry",
        SESSION_START_NS + np.rint(1e9 * time_s).astype(np.int64),
        np.column_stack([wheels[:, :2], np.zeros(n)]),
        quaternion_from_heading(wheels[:, 2]),
        np.broadcast_to(np.full((6, 6), np.nan), (n, 6, 6)),
    )
    fix_s = np.arange(0.11, duration_s - 0.2, fix_interval_s)
    fix_s = fix_s + rng.uniform(0, 0.3, len(fix_s)) * fix_interval_s
    sigma = np.array([sigma_m, sigma_m, sigma_rad])
    shared = np.array([common_m, common_m, 0.0]) * rng.normal(size=3)
    truth = np.column_stack([path.position(fix_s)[:, :2], path.heading(fix_s)])
    fixes = truth + rng.normal(size=truth.shape) * sigma + shared
    plane = np.array([0, 1, 5] if has_heading else [0, 1])
    covariance, common = np.full((2, 6, 6), np.nan)
    variance = np.append(sigma[:2], sigma_rad)[: len(plane)] ** 2
    shared_variance = np.array([common_m, common_m, 0.0])[: len(plane)] ** 2
    covariance[plane[:, None], plane] = np.diag(variance + shared_variance)
    common[plane[:, None], plane] = np.diag(shared_variance)
    return Drive(
        path,
        motion,
        tuple(
            Fix(
                "robot",
                "floor",
                SESSION_START_NS + int(1e9 * at),
                np.append(pose[:2], 0.0),
                quaternion_from_heading(pose[2] if has_heading else 0.0),
                covariance,
                common if common_m else None,
            )
            for at, pose in zip(fix_s, fixes, strict=True)
        ),
    )


def _count_ticks(poses: Array, tick_m: float) -> Array:
    """Return the odometry (n, 3) of wheels with encoders of a resolution."""
    step = np.diff(poses, axis=0)
    half = poses[:-1, 2] + step[:, 2] / 2
    chord = step[:, 0] * np.cos(half) + step[:, 1] * np.sin(half)
    side = step[:, 2] * TRACK_M / 2
    wheels = np.cumsum(np.column_stack([chord - side, chord + side]), axis=0)
    counted = np.diff(np.vstack([[0.0, 0.0], np.round(wheels / tick_m) * tick_m]), axis=0)
    ahead, rotation = counted.mean(axis=1), np.diff(counted, axis=1)[:, 0] / TRACK_M
    heading = np.r_[0.0, np.cumsum(rotation)]
    middle = heading[:-1] + rotation / 2
    return np.column_stack(
        [
            np.r_[0.0, np.cumsum(ahead * np.cos(middle))],
            np.r_[0.0, np.cumsum(ahead * np.sin(middle))],
            heading,
        ]
    )


def simulate_flight(
    seed: int,
    *,
    duration_s: float = 20.0,
    fix_interval_s: float = 0.1,
    sigma_m: float = 2e-3,
    sigma_rad: float = 0.02,
    imu_hz: float = 100.0,
) -> Drive:
    """Simulate a flight of a quadrotor with an IMU."""
    rng = np.random.default_rng(seed)
    path = FlownPath(rng, duration_s, np.zeros((0, 3)), 1.0)
    samples = measure_inertia(rng, "robot", path, duration_s, imu_hz)
    fix_s = np.arange(0.107, duration_s - 0.2, fix_interval_s)
    position = path.position(fix_s) + sigma_m * rng.normal(size=(len(fix_s), 3))
    rotation = sigma_rad * rng.normal(size=(len(fix_s), 3)) / 2
    tilt = np.column_stack([rotation, np.sqrt(1 - np.sum(rotation**2, axis=1))])
    quaternion = quaternion_multiply(tilt, path.quaternion(fix_s))
    covariance = np.diag(np.r_[np.full(3, sigma_m**2), np.full(3, sigma_rad**2)])
    return Drive(
        path,
        samples,
        tuple(
            Fix("robot", "room", SESSION_START_NS + int(1e9 * at), *pose, covariance)
            for at, *pose in zip(fix_s, position, quaternion, strict=True)
        ),
    )


def motion_part(motion: Trajectory | InertialSamples, part: slice) -> Trajectory | InertialSamples:
    """Return some samples of a motion."""
    if isinstance(motion, Trajectory):
        return motion.select(np.arange(len(motion))[part])
    return InertialSamples(
        motion.device, motion.time_ns[part], motion.acceleration[part], motion.angular_rate[part]
    )


def track_drive(
    tracker: DeviceTracker, drive: Drive, *, delay_s: float = 0.0, every: int = 1
) -> list[LiveEvent]:
    """Return the events of a drive whose fixes arrive with a delay.

    ``every`` is the number of samples of the motion that arrive at once.
    """
    arrivals: list[tuple[int, int, int]] = [
        (fix.time_ns + int(1e9 * delay_s), 0, index) for index, fix in enumerate(drive.fixes)
    ]
    stamps = drive.motion.time_ns
    for first in range(0, len(stamps), every):
        arrivals.append((int(stamps[min(first + every, len(stamps)) - 1]), 1, first))
    events: list[LiveEvent] = []
    for _, kind, index in sorted(arrivals):
        if kind == 0:
            events += tracker.fix(drive.fixes[index])
            continue
        part = motion_part(drive.motion, slice(index, index + every))
        if isinstance(part, Trajectory):
            events += tracker.odometry(part)
        else:
            events += tracker.inertial(part)
    return events


@pytest.fixture
def drive() -> Callable[..., Drive]:
    """Return the simulator of drives."""
    return simulate_drive


@pytest.fixture
def flight() -> Callable[..., Drive]:
    """Return the simulator of flights."""
    return simulate_flight


@pytest.fixture
def track() -> Callable[..., list[LiveEvent]]:
    """Return the function that passes a drive to a tracker."""
    return track_drive


@pytest.fixture
def part_of() -> Callable[[Trajectory | InertialSamples, slice], Trajectory | InertialSamples]:
    """Return the function that cuts a motion."""
    return motion_part
