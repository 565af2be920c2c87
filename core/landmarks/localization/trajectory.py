"""Trajectory of a robot at the times of its odometry, from the poses of its visits.

Within a visit the odometry is corrected by the estimated errors. Between two visits the remaining
difference is distributed in proportion to the variance of the random walk (a Brownian bridge).
Before the first and after the last visit the trajectory is dead reckoning.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import quaternion_from_heading
from locatk.core.landmarks.detection.fit import ModelPriors
from locatk.core.landmarks.detection.trace import (
    CONSTANT_ERROR_COUNT,
    compose,
    correct_constant_errors,
    planar_rotation,
    relative,
)
from locatk.core.landmarks.localization.smoothing import (
    MIN_ODOMETRY_SIGMA,
    POSE_SIZE,
    VisitPose,
    odometry_between,
    odometry_link,
)
from locatk.core.landmarks.preprocessing import VisitSegment, planar_poses
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]
TimedPoses = tuple[NDArray[np.int64], Array, Array]
"""Times (n,), poses (n, 3) in the frame of the map, and their covariances (n, 3, 3)."""


def estimate_trajectory(
    device: str,
    segments: list[VisitSegment],
    estimates: list[VisitPose],
    odometry: Trajectory,
    priors: ModelPriors,
) -> Trajectory:
    """Estimate the poses of a robot on the map at the times of its odometry.

    Parameters
    ----------
    device : str
    segments : list of VisitSegment
        At least one, in order of time.
    estimates : list of VisitPose
        Of each segment.
    odometry : Trajectory
    priors : ModelPriors

    Returns
    -------
    Trajectory
        In the frame ``"map"``. Height, roll and pitch are 0; their covariance is ``nan``.
    """
    visits = list(zip(segments, estimates, strict=True))
    parts = [_before(*visits[0], odometry, priors)]
    for visit, following in pairwise(visits):
        parts += [_during(*visit, odometry), _between(visit, following, odometry, priors)]
    parts += [_during(*visits[-1], odometry), _after(*visits[-1], odometry, priors)]
    time_ns, pose, planar_covariance = (np.concatenate(each) for each in zip(*parts, strict=True))
    covariance = np.full((len(pose), 6, 6), np.nan)
    rows = np.array([0, 1, 5])
    covariance[:, rows[:, None], rows] = planar_covariance
    position = np.column_stack([pose[:, :2], np.zeros(len(pose))])
    quaternion = quaternion_from_heading(pose[:, 2])
    return Trajectory(device, "map", time_ns, position, quaternion, covariance)


def pose_probability(
    time_ns: NDArray[np.int64],
    segments: Sequence[VisitSegment],
    probabilities: Sequence[float],
    map_probability: float,
) -> Array:
    """Return the probability (n,) that each pose is not of another position or floor.

    Between two visits it is that of the less probable one, because dead reckoning connects both.

    Parameters
    ----------
    time_ns : (n,) int64 ndarray
        Times of the poses.
    segments : sequence of VisitSegment
        The visits of :func:`estimate_trajectory`.
    probabilities : sequence of float
        Posterior probability of the cell of each visit.
    map_probability : float
        Posterior probability that the robot is on this floor.
    """
    of_visit = np.array(probabilities)
    starts = np.array([segment.time_ns[0] for segment in segments])
    ends = np.array([segment.time_ns[-1] for segment in segments])
    begun = np.maximum(np.searchsorted(starts, time_ns, side="right") - 1, 0)
    unfinished = np.minimum(np.searchsorted(ends, time_ns), len(segments) - 1)
    return map_probability * np.minimum(of_visit[begun], of_visit[unfinished])


def _during(segment: VisitSegment, estimate: VisitPose, odometry: Trajectory) -> TimedPoses:
    """Correct the odometry during a visit."""
    bin_ns = segment.time_ns
    is_inside = (odometry.time_ns >= bin_ns[0]) & (odometry.time_ns <= bin_ns[-1])
    time_ns, pose = odometry.time_ns[is_inside], planar_poses(odometry)[is_inside]
    index = np.interp(time_ns - bin_ns[0], bin_ns - bin_ns[0], np.arange(len(bin_ns)))
    low = np.minimum(index.astype(int), max(len(bin_ns) - 2, 0))
    high = np.minimum(low + 1, len(bin_ns) - 1)
    fraction = (index - low)[:, None, None]
    by_errors = segment.trace.correction
    correction = (1 - fraction) * by_errors[low] + fraction * by_errors[high]
    return time_ns, *_to_map(estimate, relative(pose, segment.origin), correction)


def _between(
    visit: tuple[VisitSegment, VisitPose],
    following: tuple[VisitSegment, VisitPose],
    odometry: Trajectory,
    priors: ModelPriors,
) -> TimedPoses:
    """Fit the odometry between two visits to the poses at both ends."""
    time_ns, path = odometry_between(odometry, visit[0], following[0])
    link = odometry_link(path, priors)
    start, start_covariance = _bin_pose(*visit, -1)
    end, end_covariance = _bin_pose(*following, 0)
    constant_errors = visit[1].corrections[:CONSTANT_ERROR_COUNT]
    local = correct_constant_errors(link.pose, constant_errors, priors.drift)
    walk = link.correction[:, :, CONSTANT_ERROR_COUNT:]
    rotation = planar_rotation(start[2])
    difference = rotation.T @ (end - start) - local[-1]
    difference[2] = np.remainder(difference[2] + np.pi, 2 * np.pi) - np.pi
    last = walk[-1]
    gain = last.T @ np.linalg.inv(last @ last.T + np.diag(MIN_ODOMETRY_SIGMA**2))
    local = local + walk @ (gain @ difference)
    conditional = np.eye(walk.shape[2]) - gain @ last
    bridge = rotation @ (walk @ conditional @ walk.swapaxes(1, 2)) @ rotation.T
    # The covariances of the ends are interpolated by the variance of the walk.
    variance = np.einsum("nim,nim->n", walk, walk)
    fraction = (variance / max(variance[-1], 1e-300))[:, None, None]
    covariance = (1 - fraction) * start_covariance + fraction * end_covariance + bridge
    return time_ns, compose(start, local)[1:-1], covariance[1:-1]


def _before(
    segment: VisitSegment, estimate: VisitPose, odometry: Trajectory, priors: ModelPriors
) -> TimedPoses:
    """Dead reckoning backward from the first visit."""
    is_before = odometry.time_ns < segment.time_ns[0]
    path = planar_poses(odometry)[is_before][::-1]
    pose, covariance = _dead_reckoning(segment, estimate, 0, path, priors, is_reversed=True)
    return odometry.time_ns[is_before], pose[::-1], covariance[::-1]


def _after(
    segment: VisitSegment, estimate: VisitPose, odometry: Trajectory, priors: ModelPriors
) -> TimedPoses:
    """Dead reckoning from the last visit."""
    is_after = odometry.time_ns > segment.time_ns[-1]
    path = planar_poses(odometry)[is_after]
    return odometry.time_ns[is_after], *_dead_reckoning(
        segment, estimate, -1, path, priors, is_reversed=False
    )


def _dead_reckoning(
    segment: VisitSegment,
    estimate: VisitPose,
    index: int,
    path: Array,
    priors: ModelPriors,
    *,
    is_reversed: bool,
) -> tuple[Array, Array]:
    """Continue from one bin of a visit along poses (n, 3) of the odometry.

    Returns
    -------
    pose : (n, 3) ndarray
    covariance : (n, 3, 3) ndarray
    """
    link = odometry_link(np.vstack([segment.odometry_pose(index), path]), priors)
    start, start_covariance = _bin_pose(segment, estimate, index)
    # Curvature has the opposite sign on a path that is traversed backward.
    sign = np.array([1.0, 1.0, -1.0 if is_reversed else 1.0])
    constant_errors = sign * estimate.corrections[:CONSTANT_ERROR_COUNT]
    local = correct_constant_errors(link.pose, constant_errors, priors.drift)
    by_constant = link.correction[:, :, :CONSTANT_ERROR_COUNT] * sign
    walk = link.correction[:, :, CONSTANT_ERROR_COUNT:]
    columns = slice(POSE_SIZE, POSE_SIZE + CONSTANT_ERROR_COUNT)
    constant_covariance = estimate.covariance[columns, columns]
    own = by_constant @ constant_covariance @ by_constant.swapaxes(1, 2)
    own = own + walk @ walk.swapaxes(1, 2)
    rotation = planar_rotation(start[2])
    by_start = _gradient_by_pose(rotation, local)
    covariance = by_start @ start_covariance @ by_start.swapaxes(1, 2) + rotation @ own @ rotation.T
    return compose(start, local)[1:], covariance[1:]


def _bin_pose(segment: VisitSegment, estimate: VisitPose, index: int) -> tuple[Array, Array]:
    """Return pose (3,) and covariance (3, 3) at one bin of a visit."""
    trace = segment.trace
    pose, covariance = _to_map(estimate, trace.pose[[index]], trace.correction[[index]])
    return pose[0], covariance[0]


def _to_map(estimate: VisitPose, local: Array, correction: Array) -> tuple[Array, Array]:
    """Transform poses (n, 3) by odometry from the frame of a visit to that of the map."""
    local = local + correction @ estimate.corrections
    rotation = planar_rotation(estimate.pose[2])
    jacobian = np.concatenate([_gradient_by_pose(rotation, local), rotation @ correction], axis=2)
    covariance = jacobian @ estimate.covariance @ jacobian.swapaxes(1, 2)
    return compose(estimate.pose, local), covariance


def _gradient_by_pose(rotation: Array, local: Array) -> Array:
    """Return the derivatives (n, 3, 3) of ``compose(pose, local)`` by the pose."""
    arm = local @ rotation.T
    gradient = np.tile(np.eye(POSE_SIZE), (len(local), 1, 1))
    gradient[:, 0, 2], gradient[:, 1, 2] = -arm[:, 1], arm[:, 0]
    return gradient
