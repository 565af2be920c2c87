"""Trajectories and scenes from estimated paths, with covariances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import quaternion_from_matrix
from locatk.core.lighthouse.motion.parameters import STATION_PARAMETERS
from locatk.core.lighthouse.motion.solver import PathEstimate
from locatk.core.lighthouse.scene import Scene
from locatk.core.lighthouse.scene.model import JOINT_PARAMETERS
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
Mask = NDArray[np.bool_]

MIN_USED_SWEEPS = 4
"""Fewest accepted sweeps in the rotation around a pose."""

MAX_POSE_SIGMA = np.repeat([1.0, 0.5], 3)
"""Largest standard deviations of a pose, in m and rad."""

MAX_SPARSE_SIGMA_M = 0.02
"""Largest standard deviation of a position without :data:`MIN_USED_SWEEPS`, which follows from the
motion before and after it."""


MAX_SPAN_NS = 1_000_000_000
"""Longest time between neighbouring knots."""


@dataclass(frozen=True)
class PathTrajectory:
    """Trajectory of a device, and the number of poses that were left out.

    Attributes
    ----------
    trajectory : Trajectory
    undetermined : int
        Poses with too large a covariance.
    """

    trajectory: Trajectory
    undetermined: int


def make_trajectory(
    estimate: PathEstimate, knots: IntArray, name: str, frame: str, interval_ns: int
) -> PathTrajectory:
    """Return the poses of a device at some of its knots, one in each interval."""
    if len(knots):
        interval = estimate.time_ns[knots] // interval_ns
        knots = knots[np.r_[True, np.diff(interval) > 0]]
    path = estimate.path
    rotation = None if path.rotation is None else path.rotation[knots]
    return _determined_poses(
        name,
        frame,
        estimate.time_ns[knots],
        path.position[knots],
        rotation,
        pose_covariances(estimate, knots),
        _used_nearby(estimate, 2)[knots],
    )


def interpolate_trajectory(
    estimate: PathEstimate, knots: IntArray, time_ns: IntArray, name: str, frame: str
) -> PathTrajectory:
    """Return the poses of a device at ascending times (n,) that are between neighbouring knots.

    ``knots`` (k,) are all those of the device. Covariances are interpolated linearly.
    """
    path, knot_ns = estimate.path, estimate.time_ns[knots]
    row = np.searchsorted(knot_ns, time_ns, side="right") - 1
    is_inside = (row >= 0) & (row < len(knots) - 1)
    row, time_ns = row[is_inside], time_ns[is_inside]
    span_ns = knot_ns[row + 1] - knot_ns[row]
    # Gaps in which the motion is interpolated have knots; longer ones have none.
    is_near = path.is_linked[knots[row]] & (span_ns == np.diff(knot_ns).min(initial=MAX_SPAN_NS))
    row, time_ns, span_ns = row[is_near], time_ns[is_near], span_ns[is_near]
    knot, since_ns = knots[row], time_ns - knot_ns[row]
    weights = path.hermite_weights(knot, path.time_s[knot] + 1e-9 * since_ns)
    position, rotation = path.poses(knot, weights)
    covariance = pose_covariances(estimate, knots)
    fraction = (since_ns / span_ns)[:, None, None]
    return _determined_poses(
        name,
        frame,
        time_ns,
        position,
        rotation,
        (1 - fraction) * covariance[row] + fraction * covariance[row + 1],
        _used_nearby(estimate, 2)[knot],
    )


def _determined_poses(
    name: str,
    frame: str,
    time_ns: IntArray,
    position: Array,
    rotation: Array | None,
    covariance: Array,
    used_sweeps: IntArray,
) -> PathTrajectory:
    """Return the poses whose covariance is small enough for the number of accepted sweeps."""
    n = 3 if rotation is None else 6
    sigma = np.sqrt(np.einsum("kii->ki", covariance)[:, :n])
    kept = np.all(sigma < MAX_POSE_SIGMA[:n], axis=1)
    is_sparse = used_sweeps < MIN_USED_SWEEPS
    kept &= ~is_sparse | np.all(sigma[:, :3] < MAX_SPARSE_SIGMA_M, axis=1)
    undetermined = int(np.count_nonzero(~kept))
    time_ns, position, covariance = time_ns[kept], position[kept], covariance[kept]
    if rotation is None:
        own = covariance[:, :3, :3]
        return PathTrajectory(
            Trajectory.from_positions(name, frame, time_ns, position, own), undetermined
        )
    quaternion = quaternion_from_matrix(rotation[kept])
    trajectory = Trajectory(name, frame, time_ns, position, quaternion, covariance)
    return PathTrajectory(trajectory, undetermined)


def refined_scene(
    scene: Scene, channels: Sequence[int], estimate: PathEstimate, covariance: Array
) -> Scene:
    """Return a scene with the estimated stations and their joint covariance.

    Stations that are not estimated keep their pose; then there is no joint covariance.
    ``covariance`` (m, m) is that of the common parameters in the frame of the poses.
    """
    positions, rotations, calibrations = estimate.common.stations
    order = {channel: i for i, channel in enumerate(channels)}
    stations = []
    rows: list[IntArray] = []
    for station in scene.stations:
        i = order.get(station.channel)
        if i is None:
            stations.append(station)
            continue
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
                covariance=covariance[pose, pose],
            )
        )
        rows.append(first + np.arange(JOINT_PARAMETERS))
    if len(rows) < len(stations):
        return replace(scene, stations=tuple(stations), covariance=None)
    index = np.concatenate(rows)
    joint = covariance[np.ix_(index, index)]
    return replace(scene, stations=tuple(stations), covariance=joint)


def pose_covariances(estimate: PathEstimate, knots: IntArray) -> Array:
    """Return the covariances (p, 6, 6) of the poses at knots (p,).

    Rotations are in the axes of the frame; those of single photodiodes are ``nan``.
    """
    factor = _square_root(estimate.common_covariance)
    shared = estimate.response[knots] @ factor
    covariance = estimate.pose_covariance[knots] + shared @ shared.mT
    count, n = covariance.shape[:2]
    full = np.full((count, 6, 6), np.nan)
    full[:, :n, :n] = covariance
    if estimate.path.rotation is not None:
        to_frame = np.zeros((count, 6, 6))
        to_frame[:, :3, :3], to_frame[:, 3:, 3:] = np.eye(3), estimate.path.rotation[knots]
        full = to_frame @ full @ to_frame.mT
    return full


def _square_root(covariance: Array) -> Array:
    """Return a factor F (m, m) of a covariance F F^T that may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _used_nearby(estimate: PathEstimate, knots: int) -> IntArray:
    """Return the number of accepted sweeps within some knots of each knot."""
    count = np.bincount(estimate.knot[estimate.is_used], minlength=len(estimate.path))
    total = np.concatenate([[0], np.cumsum(count)])
    index = np.arange(len(count))
    low, high = np.maximum(index - knots, 0), np.minimum(index + knots, len(count))
    return np.asarray(total[high] - total[low])
