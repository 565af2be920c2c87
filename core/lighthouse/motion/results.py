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
    path, n = estimate.path, estimate.path.pose_size
    covariance = pose_covariances(estimate, knots)
    sigma = np.sqrt(np.einsum("kii->ki", covariance)[:, :n])
    is_determined = np.all(sigma < MAX_POSE_SIGMA[:n], axis=1)
    is_sparse = _used_nearby(estimate, 2)[knots] < MIN_USED_SWEEPS
    is_determined &= ~is_sparse | np.all(sigma[:, :3] < MAX_SPARSE_SIGMA_M, axis=1)
    kept, covariance = knots[is_determined], covariance[is_determined]
    undetermined = int(np.count_nonzero(~is_determined))
    time_ns, position = estimate.time_ns[kept], path.position[kept]
    if path.rotation is None:
        own = covariance[:, :3, :3]
        return PathTrajectory(
            Trajectory.from_positions(name, frame, time_ns, position, own), undetermined
        )
    quaternion = quaternion_from_matrix(path.rotation[kept])
    trajectory = Trajectory(name, frame, time_ns, position, quaternion, covariance)
    return PathTrajectory(trajectory, undetermined)


def refined_scene(
    scene: Scene, channels: Sequence[int], estimate: PathEstimate, covariance: Array
) -> Scene:
    """Return a scene with the estimated stations and their joint covariance.

    ``covariance`` (m, m) is that of the common parameters in the frame of the poses.
    """
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
                covariance=covariance[pose, pose],
            )
        )
        rows.append(first + np.arange(JOINT_PARAMETERS))
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
