"""Trajectory of a robot at the times of its odometry, from the poses of its visits.

Within a visit the odometry is corrected by the estimated errors. Between two visits the remaining
difference is distributed in proportion to the variance of the random walk (a Brownian bridge). If
a wheel slipped between them, at an unknown moment, each pose is the mean of dead reckoning from
both visits. If the robot was carried between them, there are no poses. Before the first and after
the last visit the trajectory is dead reckoning.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import quaternion_from_heading
from locatk.core.landmarks.detection.trace import (
    CONSTANT_ERROR_COUNT,
    compose,
    planar_rotation,
    relative,
    walk_units,
)
from locatk.core.landmarks.localization.odometry_path import OdometryPath
from locatk.core.landmarks.localization.smoothing import (
    MIN_ODOMETRY_SIGMA,
    POSE_SIZE,
    OdometryLink,
    RobotMeasurements,
    VisitMeasurement,
    VisitPose,
    odometry_link,
)
from locatk.core.landmarks.preprocessing import VisitSegment
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]
TimedPoses = tuple[NDArray[np.int64], Array, Array]
"""Times (n,), poses (n, 3) in the frame of the map, and their covariances (n, 3, 3)."""

FITTED_WALK_FRACTION = 0.4
"""Variance of a random walk about the straight line that fits it best, relative to that about the
line between its ends: span^2 / 15 and span^2 / 6 on average."""


def estimate_trajectory(
    device: str,
    robot: RobotMeasurements,
    estimates: list[VisitPose],
    odometry: Trajectory,
    slipped_links: Collection[int] = (),
) -> Trajectory:
    """Estimate the poses of a robot on the map at the times of its odometry.

    Parameters
    ----------
    device : str
        Name of the robot.
    robot : RobotMeasurements
    estimates : list of VisitPose
        Of each visit.
    odometry : Trajectory
    slipped_links : collection of int
        Links between whose visits a wheel slipped.

    Returns
    -------
    Trajectory
        In the frame ``"map"``. Height, roll and pitch are 0; their covariance is ``nan``. There
        are no poses between two visits without a link.
    """
    path = OdometryPath.of(odometry)
    visits = [_Visit(*each) for each in zip(robot.visits, estimates, strict=True)]
    parts = [_before(visits[0], path)]
    for k, link in enumerate(robot.links):
        parts.append(_during(visits[k], path))
        if link is not None:
            bridge = _between_with_slip if k in slipped_links else _between
            parts.append(bridge(visits[k], visits[k + 1], link))
    parts += [_during(visits[-1], path), _after(visits[-1], path)]
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


@dataclass(frozen=True)
class _Visit:
    """Measurement and estimate of one visit."""

    measurement: VisitMeasurement
    estimate: VisitPose

    @property
    def segment(self) -> VisitSegment:
        return self.measurement.segment

    def bin_pose(self, index: int) -> tuple[Array, Array]:
        """Return pose (3,) and covariance (3, 3) at one bin."""
        trace = self.measurement.trace
        pose, covariance = _to_map(self.estimate, trace.pose[[index]], trace.correction[[index]])
        return pose[0], covariance[0]


def _during(visit: _Visit, path: OdometryPath) -> TimedPoses:
    """Correct the odometry during a visit."""
    segment, bin_ns = visit.segment, visit.segment.time_ns
    inside = path.between(bin_ns[0] - 1, bin_ns[-1] + 1)
    time_ns, pose = path.time_ns[inside], path.pose[inside]
    index = np.interp(time_ns - bin_ns[0], bin_ns - bin_ns[0], np.arange(len(bin_ns)))
    low = np.minimum(index.astype(int), max(len(bin_ns) - 2, 0))
    high = np.minimum(low + 1, len(bin_ns) - 1)
    fraction = (index - low)[:, None, None]
    trace = visit.measurement.trace
    by_errors, change = trace.correction, (trace.pose - segment.trace.pose)[:, :, None]
    correction, change = (
        (1 - fraction) * each[low] + fraction * each[high] for each in (by_errors, change)
    )
    local = relative(pose, segment.origin) + change[:, :, 0]
    pose, covariance = _to_map(visit.estimate, local, correction)
    within_units = FITTED_WALK_FRACTION * _covariance_within_units(by_errors, correction)
    return time_ns, pose, covariance + within_units


def _between(visit: _Visit, following: _Visit, link: OdometryLink) -> TimedPoses:
    """Fit the odometry between two visits to the poses at both ends."""
    start, start_covariance = visit.bin_pose(-1)
    end, end_covariance = following.bin_pose(0)
    local = link.without_constant_errors(visit.estimate.corrections)
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
    fraction = _walk_fraction(walk)[:, None, None]
    covariance = (1 - fraction) * start_covariance + fraction * end_covariance + bridge
    covariance = covariance + _covariance_within_units(link.correction, link.correction)
    return link.time_ns, compose(start, local)[1:-1], covariance[1:-1]


def _between_with_slip(visit: _Visit, following: _Visit, link: OdometryLink) -> TimedPoses:
    """Return the mean of dead reckoning from both visits, and its covariance.

    The slip is equally likely at any effort of the path: a pose is that of the first visit's dead
    reckoning with the probability of a later slip.
    """
    forward, forward_covariance = _dead_reckoning(visit, -1, link)
    reverse = slice(None, None, -1)
    velocity = None if link.velocity is None else link.velocity[reverse]
    local = relative(link.pose[reverse], link.pose[-1])
    if velocity is not None:
        velocity = velocity @ planar_rotation(link.pose[-1, 2])
    back = odometry_link(link.time_ns[reverse], local, link.drift, velocity)
    backward, backward_covariance = (
        each[reverse] for each in _dead_reckoning(following, 0, back, is_reversed=True)
    )
    fraction = _walk_fraction(link.correction[:, :, CONSTANT_ERROR_COUNT:])[:, None]
    difference = backward - forward
    difference[:, 2] = np.remainder(difference[:, 2] + np.pi, 2 * np.pi) - np.pi
    pose = forward + fraction * difference
    fraction = fraction[:, None]
    covariance = (1 - fraction) * forward_covariance + fraction * backward_covariance
    spread = difference[:, :, None] * difference[:, None]
    covariance = covariance + fraction * (1 - fraction) * spread
    return link.time_ns, pose[1:-1], covariance[1:-1]


def _covariance_within_units(unit_correction: Array, correction: Array) -> Array:
    """Return the covariances (n, 3, 3) of the random walk about its linear ramps.

    Between the ends of a unit it is a Brownian bridge, with the variance span^2 f (1 - f) at the
    fraction f.

    Parameters
    ----------
    unit_correction : (k, 3, m) ndarray
        Corrections along whole units, see :class:`.trace.Trace`.
    correction : (n, 3, m) ndarray
        The same at the poses.
    """
    units = walk_units(correction.shape[2])
    covariance = np.zeros((len(correction), POSE_SIZE, POSE_SIZE))
    for row, columns in zip((2, 0, 1), units.T, strict=True):
        ramp = unit_correction[:, row, columns]
        value = correction[:, row, columns]
        variance = (value - ramp.min(axis=0)) * (ramp.max(axis=0) - value)
        covariance[:, row, row] = variance.sum(axis=1)
    return covariance


def _walk_fraction(walk: Array) -> Array:
    """Return the variance (n,) of the random walk relative to that at the end."""
    variance = np.einsum("nim,nim->n", walk, walk)
    return np.asarray(variance / max(variance[-1], 1e-300))


def _before(visit: _Visit, path: OdometryPath) -> TimedPoses:
    """Dead reckoning backward from the first visit."""
    first_ns = visit.segment.time_ns[0]
    before = path.between(path.time_ns[0] - 1, first_ns)
    link = _open_link(visit, 0, path.time_ns[before][::-1], path)
    pose, covariance = _dead_reckoning(visit, 0, link, is_reversed=True)
    return path.time_ns[before], pose[:0:-1], covariance[:0:-1]


def _after(visit: _Visit, path: OdometryPath) -> TimedPoses:
    """Dead reckoning from the last visit."""
    after = path.between(visit.segment.time_ns[-1], path.time_ns[-1] + 1)
    link = _open_link(visit, -1, path.time_ns[after], path)
    pose, covariance = _dead_reckoning(visit, -1, link)
    return path.time_ns[after], pose[1:], covariance[1:]


def _open_link(
    visit: _Visit, index: int, time_ns: NDArray[np.int64], path: OdometryPath
) -> OdometryLink:
    """Return the link from one bin of a visit along all poses of the odometry at some times."""
    segment = visit.segment
    start = segment.odometry_pose(index)
    pose = relative(np.vstack([start, path.pose_at(time_ns)]), start)
    velocity = path.velocity(np.append(segment.time_ns[index], time_ns)) @ planar_rotation(start[2])
    drift = visit.measurement.drift
    return odometry_link(time_ns, pose, drift, velocity)


def _dead_reckoning(
    visit: _Visit, index: int, link: OdometryLink, *, is_reversed: bool = False
) -> tuple[Array, Array]:
    """Continue from one bin of a visit along a link.

    Returns
    -------
    pose : (n, 3) ndarray
    covariance : (n, 3, 3) ndarray
    """
    start, start_covariance = visit.bin_pose(index)
    # Curvature has the opposite sign on a path that is traversed backward.
    sign = np.array([1.0, 1.0, -1.0 if is_reversed else 1.0, 1.0])
    constant_errors = sign * visit.estimate.corrections[:CONSTANT_ERROR_COUNT]
    local = link.without_constant_errors(constant_errors)
    by_constant = link.correction[:, :, :CONSTANT_ERROR_COUNT] * sign
    walk = link.correction[:, :, CONSTANT_ERROR_COUNT:]
    columns = slice(POSE_SIZE, POSE_SIZE + CONSTANT_ERROR_COUNT)
    constant_covariance = visit.estimate.covariance[columns, columns]
    own = by_constant @ constant_covariance @ by_constant.swapaxes(1, 2)
    own = own + walk @ walk.swapaxes(1, 2)
    rotation = planar_rotation(start[2])
    by_start = _gradient_by_pose(rotation, local)
    covariance = by_start @ start_covariance @ by_start.swapaxes(1, 2) + rotation @ own @ rotation.T
    covariance = covariance + _covariance_within_units(link.correction, link.correction)
    return compose(start, local), covariance


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
