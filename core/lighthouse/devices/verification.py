"""Verification of the stations of a scene with rigid devices.

In short segments of the recording, each station is left out once. The poses are then estimated
from the other stations, and predict at which rotor angles the station should have crossed the
photodiodes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.geometry import matrix_from_quaternion
from locatk.core.lighthouse.calibration import predict_angles
from locatk.core.lighthouse.devices.device_sweeps import received_channels, select_device_sweeps
from locatk.core.lighthouse.devices.tracking import track_devices
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.lighthouse.results import StationVerification
from locatk.core.lighthouse.scene import Scene, Station
from locatk.core.robust import robust_sigma
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

SEGMENT_COUNT = 60
"""Number of segments, evenly distributed over the recording. It bounds the computing time to half a
second per station, however long the recording is."""

SEGMENT_NS = 60_000_000
"""Length of a segment: three rotations. Poses in its middle are compared."""

MAX_TIME_OFFSET_NS = 10_000_000
"""Maximum time between a pose and a sweep that it predicts. At half a metre per second a device
moves 5 mm in it, before and after the pose alike."""


def verify_devices(
    sweeps: Sweeps,
    receivers: Mapping[str, Receiver],
    scene: Scene,
    trajectories: Sequence[Trajectory],
) -> tuple[StationVerification, ...]:
    """Compare each station of a scene with the poses that the other stations determine.

    Parameters
    ----------
    sweeps : Sweeps
    receivers : mapping of str to Receiver
        By device.
    scene : Scene
        With stations.
    trajectories : sequence of Trajectory
        Of all devices with a receiver, from all stations.

    Returns
    -------
    tuple of StationVerification
        One per station that was received, by ascending channel; empty for a single station.
    """
    received = received_channels(sweeps, receivers)
    channels = [c for c in received if scene.station(c) is not None]
    if len(channels) < 2:
        return ()
    segment_sweeps, middle_ns = select_segments(sweeps)
    return tuple(
        _verify_station(segment_sweeps, middle_ns, receivers, scene, trajectories, channel)
        for channel in channels
    )


def select_segments(sweeps: Sweeps) -> tuple[Sweeps, IntArray]:
    """Select the sweeps in ``SEGMENT_COUNT`` segments of the recording.

    Returns
    -------
    selected : Sweeps
    middle_ns : (k,) int64 ndarray
        Middle of each segment, ascending.
    """
    first_ns, last_ns = int(sweeps.time_ns.min()), int(sweeps.time_ns.max())
    last_start_ns = max(first_ns, last_ns - SEGMENT_NS)
    start_ns = np.linspace(first_ns, last_start_ns, SEGMENT_COUNT).astype(np.int64)
    segment = np.searchsorted(start_ns, sweeps.time_ns, side="right") - 1
    selected = sweeps.take(sweeps.time_ns - start_ns[segment] < SEGMENT_NS)
    return selected, start_ns + SEGMENT_NS // 2


def _verify_station(
    sweeps: Sweeps,
    middle_ns: IntArray,
    receivers: Mapping[str, Receiver],
    scene: Scene,
    trajectories: Sequence[Trajectory],
    channel: int,
) -> StationVerification:
    """Compare one station with the poses that the others determine."""
    station = scene.station(channel)
    assert station is not None
    other_stations = tuple(s for s in scene.stations if s.channel != channel)
    undetermined = StationVerification(channel, "others", 0, None, None, None, None, None)
    try:
        tracked = track_devices(
            sweeps.take(sweeps.channel != channel),
            receivers,
            replace(scene, stations=other_stations),
        )
    except DegenerateError:
        return undetermined
    complete = {trajectory.device: trajectory for trajectory in trajectories}
    residuals, distances, jumps = [], [], []
    for device in tracked:
        trajectory = select_inner_poses(device.trajectory, middle_ns)
        if len(trajectory) == 0:
            continue
        receiver = receivers[trajectory.device]
        residual, distance = _predict_sweeps(sweeps, receiver, trajectory, station)
        residuals.append(residual)
        distances.append(distance)
        jumps.append(_position_jumps(trajectory, complete[trajectory.device]))
    if not residuals:
        return undetermined
    residual, distance, jump = (np.concatenate(part) for part in (residuals, distances, jumps))
    is_predicted = np.isfinite(residual)
    if not np.any(is_predicted):
        return undetermined
    return StationVerification(
        channel,
        "others",
        int(np.count_nonzero(is_predicted)),
        robust_sigma(residual),
        robust_sigma(residual * distance),
        float(np.median(jump)) if len(jump) else None,
        float(np.percentile(jump, 95)) if len(jump) else None,
        robust_sigma(np.concatenate([device.residual[device.is_used] for device in tracked])),
    )


def select_inner_poses(trajectory: Trajectory, middle_ns: IntArray) -> Trajectory:
    """Select the poses close to the middle of a segment: they have sweeps before and after them."""
    if len(trajectory) == 0:
        return trajectory
    closest = _closest(middle_ns, trajectory.time_ns)
    is_inner = np.abs(middle_ns[closest] - trajectory.time_ns) < MAX_TIME_OFFSET_NS
    return replace(
        trajectory,
        time_ns=trajectory.time_ns[is_inner],
        position=trajectory.position[is_inner],
        quaternion=trajectory.quaternion[is_inner],
        covariance=trajectory.covariance[is_inner],
    )


def _predict_sweeps(
    sweeps: Sweeps, receiver: Receiver, trajectory: Trajectory, station: Station
) -> tuple[Array, Array]:
    """Compare the sweeps of a station with the poses of a device.

    Returns
    -------
    residual : (n,) ndarray
        Predicted minus observed angle in radians of the sweeps close to a pose.
    distance : (n,) ndarray
        Of their photodiodes from the station in metres.
    """
    number = sweeps.devices.index(trajectory.device)
    selected, _ = select_device_sweeps(sweeps, number, receiver, [station.channel])
    pose = _closest(trajectory.time_ns, selected.time_ns)
    is_close = np.abs(trajectory.time_ns[pose] - selected.time_ns) < MAX_TIME_OFFSET_NS
    selected, pose = selected.take(is_close), pose[is_close]
    rotation = matrix_from_quaternion(trajectory.quaternion[pose])
    sensor_position = receiver.position_m[selected.sensor]
    position = trajectory.position[pose] + (rotation @ sensor_position[:, :, None])[..., 0]
    in_station = (position - station.position) @ station.rotation
    predicted = predict_angles(in_station, station.calibration)
    residual = predicted[np.arange(len(selected)), selected.plane] - selected.angle
    return residual, np.linalg.norm(in_station, axis=1)


def _position_jumps(reduced: Trajectory, complete: Trajectory) -> Array:
    """Return how far positions (n,) move in metres if a station is left out."""
    if len(complete) == 0:
        return np.zeros(0)
    closest = _closest(complete.time_ns, reduced.time_ns)
    is_close = np.abs(complete.time_ns[closest] - reduced.time_ns) < MAX_TIME_OFFSET_NS
    displacement = reduced.position[is_close] - complete.position[closest[is_close]]
    distance: Array = np.linalg.norm(displacement, axis=1)
    return distance


def _closest(time_ns: IntArray, query_ns: IntArray) -> IntArray:
    """Return the index of the ascending ``time_ns`` closest to each query."""
    after = np.clip(np.searchsorted(time_ns, query_ns), 0, len(time_ns) - 1)
    before = np.maximum(after - 1, 0)
    is_before = query_ns - time_ns[before] < time_ns[after] - query_ns
    return np.where(is_before, before, after)
