"""Localization of an array: poses over each tag and between tags, and headings to steer."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import heading_from_quaternion, quaternion_from_heading, wrap_angle
from locatk.core.polaris.array import Samples
from locatk.core.polaris.identification.tags import TagObservation
from locatk.core.polaris.magnets import DetectedMagnets
from locatk.core.polaris.results import HeadingCorrection
from locatk.core.polaris.tag import PlanarPose
from locatk.core.solution import SolverWarning
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

MAX_PATH_SIGMA_M = 0.01
"""Standard deviation of the path from which no pose is returned [m]."""

POSE_MARGIN_M = 0.03
"""Distance before the first and after the last magnet of a tag within which poses are returned."""

HEIGHT_SCALE_SIGMA = 0.025
"""Standard deviation of the scale of a height, besides its noise. The height has the scale of a
path from the field alone; the true one was 0.985 to 1.043 times as long on the 57 recordings of the
authors of the paper (docs/polaris.md). Wheels are no better."""

MAX_REST_STEP_RATIO, MIN_JUMP_STEP_RATIO = 0.2, 2.0
"""Ratios of a step to the usual one up to which the array may have rested, and from which two steps
in opposite directions are no motion: a robot that turns back has small steps in between."""

MIN_GAP_PERIODS = 5
"""Time between poses, in usual intervals, from which odometry fills the gap."""

PLANAR_COMPONENTS = (0, 1, 5)
"""Indices of x, y and heading in the covariance of a pose."""


@dataclass(frozen=True)
class Localization:
    """Poses of one array.

    Attributes
    ----------
    trajectories : tuple of Trajectory
        One or none.
    heading_corrections : tuple of HeadingCorrection
    warnings : tuple of SolverWarning
    """

    trajectories: tuple[Trajectory, ...] = ()
    heading_corrections: tuple[HeadingCorrection, ...] = ()
    warnings: tuple[SolverWarning, ...] = ()


def localize(
    samples: Samples,
    observations: Sequence[TagObservation],
    odometry: Trajectory | None = None,
) -> Localization:
    """Estimate the poses of an array while it was over identified tags.

    The frame is that of the site if tags have positions on it, else that of the first tag.

    Parameters
    ----------
    samples : Samples
    observations : sequence of TagObservation
        Identified tags in order of time.
    odometry : Trajectory, optional
        It fills the gaps between tags.
    """
    if not observations:
        return Localization()
    first = observations[0]
    frame = "site"
    if not any(each.tags is not None and each.tags.site for each in observations):
        frame = f"tag-{first.tag_id}"
    parts, warnings = [], []
    for observation in observations:
        site_pose = observation.site_pose
        is_first = observation.tags is first.tags and observation.tag_id == first.tag_id
        if frame != "site" and is_first:
            site_pose = PlanarPose(0.0, 0.0, 0.0)
        if site_pose is not None:
            poses = poses_over_tag(samples, observation, site_pose)
            if len(poses.time_ns):
                parts.append(poses)
        else:
            location = "on the site" if frame == "site" else f"in the frame of {frame}"
            message = f"tag {observation.tag_id} has no position {location}"
            warnings.append(SolverWarning("tag_not_on_site", message).about(samples.device))
    if not parts:
        return Localization(warnings=tuple(warnings))
    trajectory = _concatenate(samples.device, frame, parts)
    if odometry is not None:
        trajectory = _fill_gaps(trajectory, odometry)
    corrections = _heading_corrections(samples, observations)
    return Localization((trajectory,), corrections, tuple(warnings))


def distance_along(odometry: Trajectory, time_ns: NDArray[np.int64]) -> Array:
    """Return the distance (n,) that a robot had driven forward by its odometry [m].

    Driving backward counts as negative, by the heading of the odometry. The distance is nan before
    its first and after its last pose.
    """
    step = np.diff(odometry.position[:, :2], axis=0)
    heading = heading_from_quaternion(odometry.quaternion)
    forward = np.column_stack([np.cos(heading), np.sin(heading)])
    forward_step = (step * (forward[1:] + forward[:-1]) / 2).sum(axis=1)
    distance = np.concatenate([[0.0], np.cumsum(forward_step)])
    interpolated = np.interp(time_ns, odometry.time_ns, distance, left=np.nan, right=np.nan)
    return np.asarray(interpolated)


@dataclass(frozen=True)
class PlanarPoses:
    """Times (n,), positions (n, 3), headings (n,) and covariances (n, 6, 6)."""

    time_ns: NDArray[np.int64]
    position: Array
    heading: Array
    covariance: Array

    def select(self, rows: slice) -> PlanarPoses:
        """Return some of the poses."""
        return PlanarPoses(
            self.time_ns[rows], self.position[rows], self.heading[rows], self.covariance[rows]
        )


def poses_over_tag(
    samples: Samples, observation: TagObservation, tag_pose: PlanarPose
) -> PlanarPoses:
    """Return the poses of an array over one tag, with the covariance of match, path and tag."""
    magnets, match = observation.magnets, observation.match
    if match is None:
        raise ValueError("an identified tag has a match")
    along = magnets.position_m[list(match.magnets), 0]
    is_over = magnets.path_m >= along.min() - POSE_MARGIN_M
    is_over &= magnets.path_m <= along.max() + POSE_MARGIN_M
    path_sigma_m = _path_sigma(magnets, along.min(), along.max())
    is_over &= path_sigma_m < MAX_PATH_SIGMA_M
    count, n = len(is_over), int(is_over.sum())
    lateral = np.zeros(count) if magnets.lateral_m is None else magnets.lateral_m
    rotated = np.zeros(count) if magnets.heading_rad is None else magnets.heading_rad
    path = np.column_stack([magnets.path_m, lateral])[is_over]
    heading = tag_pose.heading_rad - match.heading_rad
    cos, sin = np.cos(heading), np.sin(heading)
    rotation = np.array([[cos, -sin], [sin, cos]])
    by_heading = np.array([[-sin, -cos], [cos, -sin]])
    offset = path - [match.x_m, match.y_m]
    # The array moves along its x axis, but for a crab of a few degrees.
    direction = np.column_stack([np.cos(rotated), np.sin(rotated)])[is_over]
    position = np.empty((n, 3))
    position[:, :2] = offset @ rotation.T + [tag_pose.x_m, tag_pose.y_m]
    position[:, 2] = magnets.height_m
    # Derivative of x, y and heading by the match (x, y, heading) and the path.
    jacobian = np.zeros((n, 3, 4))
    jacobian[:, :2, :2] = -rotation
    jacobian[:, :2, 2] = -offset @ by_heading.T
    jacobian[:, :2, 3] = direction @ rotation.T
    jacobian[:, 2, 2] = -1.0
    inner = np.zeros((n, 4, 4))
    inner[:, :3, :3] = match.covariance
    inner[:, 3, 3] = path_sigma_m[is_over] ** 2
    covariance = np.full((n, 6, 6), np.nan)
    covariance[np.ix_(range(n), PLANAR_COMPONENTS, PLANAR_COMPONENTS)] = (
        jacobian @ inner @ jacobian.transpose(0, 2, 1)
    )
    by_tag = np.tile(np.eye(3), (n, 1, 1))
    by_tag[:, :2, 2] = offset @ by_heading.T
    covariance[np.ix_(range(n), PLANAR_COMPONENTS, PLANAR_COMPONENTS)] += (
        by_tag @ observation.site_covariance @ by_tag.transpose(0, 2, 1)
    )
    if magnets.motion_covariance is not None:
        by_motion = np.eye(3)
        by_motion[:2, :2] = rotation
        covariance[np.ix_(range(n), PLANAR_COMPONENTS, PLANAR_COMPONENTS)] += (
            by_motion @ magnets.motion_covariance[is_over] @ by_motion.T
        )
    covariance[:, 2, :], covariance[:, :, 2] = 0.0, 0.0
    covariance[:, 2, 3:5] = covariance[:, 3:5, 2] = np.nan
    scale_sigma_m = HEIGHT_SCALE_SIGMA * magnets.height_m
    covariance[:, 2, 2] = magnets.height_sigma_m**2 + scale_sigma_m**2
    time = samples.time_ns[magnets.first : magnets.stop][is_over]
    return PlanarPoses(time, position, heading + rotated[is_over], covariance)


def _path_sigma(magnets: DetectedMagnets, first_m: float, last_m: float) -> Array:
    """Return the standard deviation (n,) of a path over magnets from ``first_m`` to ``last_m``.

    It is that of the fit, zero for a path without one, with two exceptions:

    - Farther than its height before the first magnet or after the last one, fields fade, and the
      path follows its prior. In a pass with rests, that is a rest, but the array may have moved.
    - If the path jumps there and back within a sample, by far more than the usual step, that sample
      is at a wrong minimum of the fit or has a wrong time. Its standard deviation is infinite.
    """
    path, sigma = magnets.path_m, np.nan_to_num(magnets.path_sigma_m)
    step = np.diff(path)
    if not sigma.any() or not step.any():
        return sigma
    # Half of the distance was covered by smaller steps.
    ascending = np.sort(np.abs(step))
    distance = np.cumsum(ascending)
    usual_step_m = ascending[np.searchsorted(distance, distance[-1] / 2)]
    is_moving = np.abs(step) > MAX_REST_STEP_RATIO * usual_step_m
    starts = np.flatnonzero(np.append(True, is_moving))
    counts = np.diff(np.append(starts, len(path)))
    # A uniform motion has this rms distance from its first position.
    moved_m = np.repeat(np.where(counts > 1, counts, 0) * usual_step_m / np.sqrt(3), counts)
    is_outside = (path < first_m - magnets.height_m) | (path > last_m + magnets.height_m)
    sigma = np.hypot(sigma, np.where(is_outside, moved_m, 0.0))
    is_large = np.abs(step) > MIN_JUMP_STEP_RATIO * usual_step_m
    is_jump = is_large[:-1] & is_large[1:] & (step[:-1] * step[1:] < 0)
    sigma[1:-1][is_jump] = np.inf
    return np.asarray(sigma)


def _concatenate(device: str, frame: str, parts: Sequence[PlanarPoses]) -> Trajectory:
    """Join the poses over all tags in order of time; of equal times the first pose is kept."""
    time_ns = np.concatenate([part.time_ns for part in parts])
    _, first = np.unique(time_ns, return_index=True)  # The passes of two tags may overlap.
    heading = np.concatenate([part.heading for part in parts])
    return Trajectory(
        device,
        frame,
        time_ns[first],
        np.concatenate([part.position for part in parts])[first],
        quaternion_from_heading(heading[first]),
        np.concatenate([part.covariance for part in parts])[first],
    )


def _fill_gaps(poses: Trajectory, odometry: Trajectory) -> Trajectory:
    """Fill the gaps between tags by odometry."""
    interval = np.median(np.diff(poses.time_ns)) if len(poses) > 1 else 0
    gaps = np.flatnonzero(np.diff(poses.time_ns) > MIN_GAP_PERIODS * interval)
    heading = heading_from_quaternion(poses.quaternion)
    parts = [PlanarPoses(poses.time_ns, poses.position, heading, poses.covariance)]
    for gap in gaps:
        start_ns, end_ns = poses.time_ns[[gap, gap + 1]]
        if odometry.time_ns[0] <= start_ns and end_ns <= odometry.time_ns[-1]:
            parts.append(_poses_in_gap(poses, heading, int(gap), odometry))
    return _concatenate(poses.device, poses.frame, parts)


def _poses_in_gap(poses: Trajectory, heading: Array, gap: int, odometry: Trajectory) -> PlanarPoses:
    """Return the poses of odometry between the poses ``gap`` and ``gap + 1``.

    Odometry continues from the pose before the gap. Its error at the pose after the gap is
    distributed over the distance.
    """
    start_ns, end_ns = poses.time_ns[[gap, gap + 1]]
    is_inside = (odometry.time_ns > start_ns) & (odometry.time_ns < end_ns)
    time = np.concatenate([[start_ns], odometry.time_ns[is_inside], [end_ns]])
    x, y, odometry_heading, distance = (
        np.interp(time, odometry.time_ns, values)
        for values in (
            odometry.position[:, 0],
            odometry.position[:, 1],
            np.unwrap(heading_from_quaternion(odometry.quaternion)),
            distance_along(odometry, odometry.time_ns),
        )
    )
    rotation = heading[gap] - odometry_heading[0]
    cos, sin = np.cos(rotation), np.sin(rotation)
    dx, dy = x - x[0], y - y[0]
    planar = poses.position[gap, :2] + np.column_stack([cos * dx - sin * dy, sin * dx + cos * dy])
    propagated_heading = odometry_heading + rotation
    total = max(abs(distance[-1] - distance[0]), 1e-9)
    fraction = np.clip(np.abs(distance - distance[0]) / total, 0, 1)
    position_error = poses.position[gap + 1, :2] - planar[-1]
    heading_error = wrap_angle(heading[gap + 1] - propagated_heading[-1])
    height = poses.position[gap, 2] + fraction * np.diff(poses.position[gap : gap + 2, 2])
    # Known at both ends; in between, the error of odometry may have any distribution.
    inside = slice(1, -1)
    weight = fraction[inside, None, None]
    covariance = (1 - weight) * poses.covariance[gap] + weight * poses.covariance[gap + 1]
    spread = (fraction * (1 - fraction))[inside]
    covariance[:, 0, 0] += spread * (position_error @ position_error)
    covariance[:, 1, 1] += spread * (position_error @ position_error)
    covariance[:, 5, 5] += spread * heading_error**2
    return PlanarPoses(
        time[inside],
        np.column_stack([planar + fraction[:, None] * position_error, height])[inside],
        (propagated_heading + fraction * heading_error)[inside],
        covariance,
    )


def _heading_corrections(
    samples: Samples, observations: Sequence[TagObservation]
) -> tuple[HeadingCorrection, ...]:
    """Return the rotations that point the robot from each tag to the next one.

    One for every two different tags in a row that have positions on the site (Polaris, section
    8.3.7).
    """
    on_site = [
        (observation, observation.tag_id, observation.site_pose)
        for observation in observations
        if observation.tag_id is not None and observation.site_pose is not None
    ]
    corrections = []
    for (observation, from_tag, tag_pose), (_, to_tag, target) in itertools.pairwise(on_site):
        if tag_pose == target:
            continue
        poses = poses_over_tag(samples, observation, tag_pose)
        if not len(poses.time_ns):
            continue
        last = poses.select(slice(-1, None))
        correction = heading_correction(samples.device, from_tag, last, to_tag, target)
        if correction is not None:
            corrections.append(correction)
    return tuple(corrections)


def heading_correction(
    device: str, from_tag: int, last: PlanarPoses, to_tag: int, target: PlanarPose
) -> HeadingCorrection | None:
    """Return the rotation that points the robot from a tag to another one.

    Parameters
    ----------
    device : str
    from_tag, to_tag : int
        Ids of the tags.
    last : PlanarPoses
        Last pose of the array over the first tag.
    target : PlanarPose
        Pose of the second tag.

    Returns
    -------
    HeadingCorrection or None
        None if the robot is at the second tag already.
    """
    offset = np.array([target.x_m, target.y_m]) - last.position[0, :2]
    distance = float(np.hypot(*offset))
    if distance == 0:
        return None
    rotation = np.arctan2(offset[1], offset[0]) - last.heading[0]
    # Derivative of the rotation by position and heading.
    gradient = np.array([offset[1], -offset[0], -(distance**2)]) / distance**2
    covariance = last.covariance[0][np.ix_(PLANAR_COMPONENTS, PLANAR_COMPONENTS)]
    return HeadingCorrection(
        device=device,
        time_s=float(last.time_ns[0]) * 1e-9,
        from_tag=from_tag,
        to_tag=to_tag,
        rotation_rad=float(wrap_angle(rotation)),
        sigma_rotation_rad=float(np.sqrt(gradient @ covariance @ gradient)),
        distance_m=distance,
    )
