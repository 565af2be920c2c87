"""Trajectories of rigid devices in continuous time, from their rough poses.

Each sweep counts at its own time; stations, light planes and photodiodes are uncertain
(:mod:`locatk.core.lighthouse.motion`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import Similarity, quaternion_from_matrix
from locatk.core.inertial import InertialSamples
from locatk.core.lighthouse.devices.device_sweeps import rotation_limits_ns
from locatk.core.lighthouse.devices.tracking import MAX_POSE_SIGMA_M_RAD, TrackedDevice
from locatk.core.lighthouse.motion.frames import fix_frame
from locatk.core.lighthouse.motion.parameters import STATION_PARAMETERS, make_parameters
from locatk.core.lighthouse.motion.solver import PathEstimate, estimate_paths
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.scene import Scene
from locatk.core.lighthouse.scene.model import JOINT_PARAMETERS
from locatk.core.lighthouse.scene.reframing import transform_trajectory
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
Mask = NDArray[np.bool_]

MIN_SWEEP_RATE = 4.0
"""Fewest accepted sweeps in the two rotations around a pose."""

MIN_FRAME_MARKERS = 3
"""Fewest visited markers that define a frame."""


def refine_tracks(
    tracked: Sequence[TrackedDevice],
    receivers: Mapping[str, Receiver],
    scene: Scene,
    *,
    is_estimated: bool,
    interval_ns: int | None = None,
    imu: Sequence[InertialSamples] = (),
) -> tuple[Scene, tuple[TrackedDevice, ...], tuple[str, ...]]:
    """Estimate trajectories in continuous time, and the stations with them.

    Parameters
    ----------
    tracked : sequence of TrackedDevice
        With rough poses in ``scene``.
    receivers : mapping of str to Receiver
    scene : Scene
    is_estimated : bool
        True if the scene was estimated from the same sweeps. Otherwise it is returned unchanged.
    interval_ns : int, optional
        Time from pose to pose; by default, a rotation of the fastest station.
    imu : sequence of InertialSamples

    Returns
    -------
    scene : Scene
    tracked : tuple of TrackedDevice
    contradicting : tuple of str
        Devices whose IMU contradicts the light and was not used.
    """
    channels = tracked[0].channels
    levers = [receivers[device.trajectory.device].position_m for device in tracked]
    first = np.cumsum([0, *map(len, levers)])[:-1].tolist()
    fastest_ns, _ = rotation_limits_ns(channels)
    common = make_parameters(
        scene,
        channels,
        np.nan_to_num(np.concatenate(levers)),
        is_estimated=is_estimated,
        size_m=_scene_size(scene, tracked),
    )
    by_device = {samples.device: samples for samples in imu}
    estimate = estimate_paths(
        [device.sweeps for device in tracked],
        first,
        [device.trajectory for device in tracked],
        common,
        fastest_ns // 2,
        [by_device.get(device.trajectory.device) for device in tracked],
    )
    if estimate is None:
        return scene, tuple(tracked), ()
    to_frame = Similarity.identity()
    if is_estimated:
        on_marker = _marker_knots(estimate, scene, tracked)
        has_markers = len(np.unique(on_marker[on_marker >= 0])) >= MIN_FRAME_MARKERS
        is_fixed = on_marker >= 0 if has_markers else np.ones(len(estimate.path), bool)
        estimate = fix_frame(estimate, is_fixed, with_scale=has_markers)
        # The first station keeps its pose: it defines the frame of a scene without markers.
        positions, rotations, _ = estimate.common.stations
        turn = common.rotations[0] @ rotations[0].T
        to_frame = Similarity(1.0, turn, common.positions[0] - turn @ positions[0])
        scene = refined_scene(scene, channels, estimate).transformed(to_frame)
    covariance = pose_covariances(estimate)
    refined, begin = [], 0
    for number, device in enumerate(tracked):
        end = begin + len(device.sweeps)
        own = (estimate.sweep >= begin) & (estimate.sweep < end)
        residual, is_used = np.full(end - begin, np.nan), np.zeros(end - begin, bool)
        residual[estimate.sweep[own] - begin] = estimate.residual[own]
        is_used[estimate.sweep[own] - begin] = estimate.is_used[own]
        begin = end
        knots = _pose_knots(estimate, number, interval_ns or fastest_ns)
        rotation = estimate.path.rotation
        assert rotation is not None
        is_determined = np.all(
            np.sqrt(np.einsum("kii->ki", covariance[knots])) < MAX_POSE_SIGMA_M_RAD, axis=1
        )
        is_supported = _used_nearby(estimate, 2)[knots] >= MIN_SWEEP_RATE
        kept = knots[is_determined & is_supported]
        trajectory = Trajectory(
            device.trajectory.device,
            device.trajectory.frame,
            estimate.time_ns[kept],
            estimate.path.position[kept],
            quaternion_from_matrix(rotation[kept]),
            covariance[kept],
        )
        rejected = dict(device.rejected)
        rejected["pose_not_determined"] = int(np.count_nonzero(is_supported & ~is_determined))
        rejected["sweep_contradicts_pose"] = int(np.count_nonzero(np.isfinite(residual) & ~is_used))
        refined.append(
            replace(
                device,
                trajectory=transform_trajectory(trajectory, to_frame, scene.frame),
                residual=residual,
                is_used=is_used,
                sigma_rad=estimate.sigma_rad,
                rejected={reason: count for reason, count in rejected.items() if count},
            )
        )
    return scene, tuple(refined), estimate.contradicting_imus


def _scene_size(scene: Scene, tracked: Sequence[TrackedDevice]) -> float:
    """Return the median distance of the devices from the stations."""
    centre = np.mean([s.position for s in scene.stations], axis=0)
    offset = np.concatenate([device.trajectory.position for device in tracked]) - centre
    return float(np.median(np.linalg.norm(offset, axis=1))) if len(offset) else 1.0


def _marker_knots(
    estimate: PathEstimate, scene: Scene, tracked: Sequence[TrackedDevice]
) -> IntArray:
    """Return the number of the marker on which a device is at each knot, or -1."""
    number = np.full(len(estimate.path), -1)
    names = [device.trajectory.device for device in tracked]
    for k, marker in enumerate(scene.markers):
        for visit in marker.visits:
            if visit.device not in names or visit.start_ns is None or visit.end_ns is None:
                continue
            is_visit = estimate.device == names.index(visit.device)
            is_visit &= (estimate.time_ns >= visit.start_ns) & (estimate.time_ns <= visit.end_ns)
            number[is_visit] = k
    return number


def refined_scene(scene: Scene, channels: Sequence[int], estimate: PathEstimate) -> Scene:
    """Return a scene with the estimated stations and their joint covariance."""
    positions, rotations, calibrations = estimate.common.stations
    order = {channel: i for i, channel in enumerate(channels)}
    stations = []
    rows: list[IntArray] = []
    for station in scene.stations:
        i = order.get(station.channel)
        if i is None:
            return scene
        first = i * STATION_PARAMETERS
        pose = slice(first, first + 6)
        calibration = calibrations[i]
        if station.calibration.is_generic:
            calibration = replace(calibration, source="estimated")
        stations.append(
            replace(
                station,
                position=positions[i],
                rotation=rotations[i],
                calibration=calibration,
                covariance=estimate.common_covariance[pose, pose],
            )
        )
        rows.append(first + np.arange(JOINT_PARAMETERS))
    index = np.concatenate(rows)
    joint = estimate.common_covariance[np.ix_(index, index)]
    return replace(scene, stations=tuple(stations), covariance=joint)


def pose_covariances(estimate: PathEstimate) -> Array:
    """Return the covariances (k, 6, 6) of the poses, rotations in the axes of the frame."""
    factor = _square_root(estimate.common_covariance)
    shared = estimate.response @ factor
    covariance = estimate.pose_covariance + shared @ shared.mT
    k, n = covariance.shape[:2]
    full = np.full((k, 6, 6), np.nan)
    full[:, :n, :n] = covariance
    if estimate.path.rotation is not None:
        to_frame = np.zeros((k, 6, 6))
        to_frame[:, :3, :3], to_frame[:, 3:, 3:] = np.eye(3), estimate.path.rotation
        full = to_frame @ full @ to_frame.mT
    return full


def _square_root(covariance: Array) -> Array:
    """Return a factor F (m, m) of a covariance F F^T that may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _pose_knots(estimate: PathEstimate, device: int, interval_ns: int) -> IntArray:
    """Return the knots of a device at which poses are given, one in each interval."""
    knots = np.flatnonzero(estimate.device == device)
    interval = estimate.time_ns[knots] // interval_ns
    return knots[np.r_[True, np.diff(interval) > 0]] if len(knots) else knots


def _used_nearby(estimate: PathEstimate, knots: int) -> IntArray:
    """Return the number of accepted sweeps within some knots of each knot."""
    count = np.bincount(estimate.knot[estimate.is_used], minlength=len(estimate.path))
    total = np.concatenate([[0], np.cumsum(count)])
    index = np.arange(len(count))
    low, high = np.maximum(index - knots, 0), np.minimum(index + knots, len(count))
    return np.asarray(total[high] - total[low])
